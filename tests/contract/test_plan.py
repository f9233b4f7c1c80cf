"""``softwarp plan`` as a user types it, and what its planners promise on CartStemContact."""

import gc
import json
import math
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from experiments import verbs
from experiments.plan import make_model
from experiments.verbs import PlanConfig
from softwarp import cli
from softwarp.envs import registry
from softwarp.planning import plans
from softwarp.planning.cem import CEM, CEMConfig
from softwarp.planning.env_model import EnvModel, ModelConfig
from softwarp.planning.execution import execute
from softwarp.planning.opd import OPD, OPDConfig
from softwarp.planning.state_store import digests

DISCRETE = {"action_kind": "discrete", "solver_path": "lanes"}


def run(capsys, *arguments):
    assert cli.main(["plan", *arguments]) == 0, capsys.readouterr().err
    return capsys.readouterr()


@pytest.mark.parametrize(
    "planner",
    ["opd", *(pytest.param(name, marks=pytest.mark.slow) for name in ("uct", "olop", "kl_olop", "cem", "mppi"))],
)
def test_every_planner_plans_and_replays(tmp_path, monkeypatch, capsys, planner):
    """A small budget with each planner: plan file, picture, summary; the file replays to the same states."""
    monkeypatch.chdir(tmp_path)
    kind = "continuous" if planner in ("cem", "mppi") else "discrete"
    settings = [f"planner={planner}", f"env.action_kind={kind}", "model.hold=2", "planner.expansions=64"]
    settings += ["planner.population=16"] if kind == "continuous" else ["planner.batch=4"]
    files = ["out=plan.json", "picture=plan.png", "summary=all.json"]
    told = run(capsys, "env=cart_stem_contact", "env.max_episode_steps=6", *settings, *files)
    assert f"{planner} on CartStemContact: goal " in told.out
    assert "%  plan 1, step 0/6  " in told.err
    content = json.loads(Path("plan.json").read_text())
    assert len(content["actions"]) == len(content["steps"]) <= 6
    assert content["steps"][-1]["done"]
    assert (content["tree"] is None) == (kind == "continuous")
    if planner == "opd":  # the tree of the first search, though later ones went on with it
        assert content["tree"]["nodes"] == 1 + 7 * content["cost"]["expansions"]
    assert Path("plan.png").stat().st_size > 10_000
    (episode,) = json.loads(Path("all.json").read_text())["episodes"]
    assert episode["distance"] == content["steps"][-1]["distance"]
    assert "all states are those of the plan, to the bit" in run(capsys, "--replay", "plan.json").out


@pytest.mark.slow
def test_planners_of_trees_take_the_discrete_actions_of_tasks_with_many_commands(tmp_path, monkeypatch, capsys):
    """Five levels of four cables are 625 commands: the task's own eight actions are taken, unless others are named."""
    monkeypatch.chdir(tmp_path)
    small = ["env=diamond", "env.mesh=coarse", "planner=opd", "planner.expansions=2", "env.max_episode_steps=2"]
    told = run(capsys, *small, "summary=all.json")
    assert "Diamond: env.action_kind=discrete, as opd chooses from a list of actions" in told.out
    assert json.loads(Path("all.json").read_text())["env"]["action_kind"] == "discrete"
    assert cli.main(["plan", *small, "env.action_kind=absolute"]) == 2
    assert "planner opd: needs 2 or more discrete actions" in capsys.readouterr().err


@pytest.mark.slow  # seconds, of them most for the vessel
def test_tubes_tell_the_force_on_the_wall(tmp_path, monkeypatch, capsys):
    """MPPI pushes a catheter for three actions; the summary and the report tell what the wall bore."""
    monkeypatch.chdir(tmp_path)
    settings = ["planner=mppi", "planner.horizon=2", "planner.population=4", "planner.expansions=8", "replan=1"]
    told = run(capsys, "env=catheter_beam", "env.max_episode_steps=3", *settings, "summary=all.json").out
    (episode,) = json.loads(Path("all.json").read_text())["episodes"]
    assert episode["steps"] == 3 and episode["force"] > 0.0
    assert f"largest {episode['force']:.2f} N" in told


def test_presets_are_taken_and_told_and_can_be_left_out(capsys):
    """Those of the environment and planner that are named; what is given comes before them."""
    named = ["--cfg", "job", "env=concentric_tube_robot", "planner=opd"]
    shown = OmegaConf.create(run(capsys, *named, "planner.patience=3").out)
    assert (shown.planner.gamma, shown.planner.patience, list(shown.model.strides)) == (0.8, 3, [1, 4])
    assert (shown.env.success_tolerance, shown.replan) == (0.003, 2)
    shown = OmegaConf.create(run(capsys, *named, "preset=none").out)
    assert (shown.planner.gamma, shown.planner.patience, list(shown.model.strides)) == (0.95, 1, [1])
    assert verbs.preset_of(["env=catheter_beam"]) == ["preset=catheter_beam_cem"]
    assert verbs.preset_of(["env=catheter_beam", "planner=opd"]) == verbs.preset_of([]) == []


@pytest.mark.slow  # 15 s
def test_tubes_are_planned_to_goals_that_a_narrow_tree_does_not_see(tmp_path, monkeypatch, capsys):
    """A goal at which tubes turn by two radians before anything comes nearer: met within 3 mm, in some 5000 steps."""
    monkeypatch.chdir(tmp_path)
    settings = ["env=concentric_tube_robot", "planner=opd", "env.goals=list", "env.goal_list=[[0.0035,0.011,0.0367]]"]
    told = run(capsys, *settings, "summary=all.json").out
    assert "preset=concentric_tube_robot_opd" in told and "goal met in 1 of 1" in told
    (episode,) = json.loads(Path("all.json").read_text())["episodes"]
    assert episode["distance"] <= 0.003 and episode["transitions"] < 10_000


@pytest.mark.slow  # half a minute
def test_a_catheter_is_planned_to_an_outlet(tmp_path, monkeypatch, capsys):
    """CEM with its preset, from turns of the instruments that are drawn: at the outlet within 5 mm, and gently."""
    monkeypatch.chdir(tmp_path)
    told = run(capsys, "env=catheter_beam", "env.outlet=0", "seed=100", "summary=all.json").out
    assert "preset=catheter_beam_cem" in told and "goal met in 1 of 1" in told
    (episode,) = json.loads(Path("all.json").read_text())["episodes"]
    assert episode["distance"] <= 0.005 and episode["force"] < 0.5


def test_settings_are_shown(capsys):
    """Those of planner, model and environment with the values that overrides give them, as YAML."""
    shown = OmegaConf.create(run(capsys, "--cfg", "job", "planner=opd", "env=diamond", "planner.batch=3").out)
    assert (shown.planner.name, shown.planner.batch, shown.planner.seconds) == ("opd", 3, math.inf)
    assert (shown.env.name, shown.model.hold, shown.replan) == ("Diamond", 1, 0)


@pytest.mark.slow
def test_interrupted_run_leaves_the_files_of_what_it_did(tmp_path, monkeypatch, capsys):
    """Stopped in the third of five episodes: the first one's plan and picture, and the outcome of two."""
    monkeypatch.chdir(tmp_path)
    plan_script, calls = cli.experiment("plan"), []

    def stopped(*arguments, **options):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return execute(*arguments, **options)

    monkeypatch.setattr(plan_script, "execute", stopped)
    settings = ["planner.expansions=64", "planner.population=16", "env.max_episode_steps=2", "episodes=5"]
    assert cli.main(["plan", *settings, "out=plan.json", "picture=plan.png", "summary=all.json"]) == 130
    assert len(json.loads(Path("all.json").read_text())["episodes"]) == 2
    assert len(plans.Plan.load("plan.json").steps) == 2
    assert Path("plan.png").stat().st_size > 10_000
    assert "interrupted" in capsys.readouterr().err


def test_a_plan_that_no_longer_holds_is_told(tmp_path, monkeypatch, capsys):
    """Exit code 1 and the first state that differs, where a setting of the environment was changed by hand."""
    monkeypatch.chdir(tmp_path)
    run(capsys, "planner.expansions=64", "planner.population=16", "env.max_episode_steps=4", "out=plan.json")
    content = json.loads(Path("plan.json").read_text())
    content["actions"][1] = [-content["actions"][1][0]]
    Path("plan.json").write_text(json.dumps(content))
    assert cli.main(["plan", "--replay", "plan.json"]) == 1
    assert "state 2 is the first that differs from the plan" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (
            ["planner=opt"],
            "softwarp plan: planner: there is no 'opt'; did you mean 'opd' or 'olop'?",
        ),
        (["planner=cem", "planner.elite=3"], "there is no 'planner.elite'; did you mean 'planner.elites' or"),
        (["planner=opd", "planner.gamma=1.5"], "planner.gamma: must lie in (0, 1), got 1.5"),
        (
            ["planner=cem", "env.action_kind=discrete"],
            "planner cem: needs continuous actions, the model has 7 discrete",
        ),
        (["planner=opd", "model.levels=300"], "planner opd: needs 2 or more discrete actions, the model has 0"),
        (["picture=plan.bmp"], "picture=plan.bmp: needs the ending .png or .svg or .pdf"),
        (["episodes=0"], "episodes: must be at least 1, got 0"),
        (["--replay", "nowhere.json"], "plan nowhere.json does not exist"),
        (["--replay", "nowhere.json", "seed=1"], "setting 'seed=1': a saved plan has its settings"),
    ],
)
def test_bad_input_is_told_in_a_line(tmp_path, monkeypatch, capsys, arguments, told):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["plan", *arguments]) == 2
    assert told in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.slow
def test_repeated_planning_keeps_no_memory():
    """Ten searches after ten others: the same pool and rows, and no tree left behind, which would be 40 kB each."""
    env = registry.make("CartStemContact", seed=1, **DISCRETE)
    env.reset()
    model = EnvModel(env, ModelConfig(memory=1.0), worlds=14)
    planner = OPD(OPDConfig(expansions=20, batch=2))

    def search():
        model.start(env.snapshot(0))
        planner.forget()
        planner.plan(model)

    for _ in range(10):
        search()
    block = model._store._block.data_ptr()
    planner.forget()
    gc.collect()
    tracemalloc.start()
    for _ in range(2):
        search()
    planner.forget()
    gc.collect()
    before, _ = tracemalloc.get_traced_memory()
    for _ in range(10):
        search()
    planner.forget()
    gc.collect()
    after, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert after - before < 60_000  # bytes; Torch's own caches of small objects still fill up a little
    assert model._store._block.data_ptr() == block


def test_pools_on_two_devices_plan_as_one_does():
    """CEM's worlds on ["cpu", "cpu"], an odd number of them: the same plan, values and count of steps as on one."""
    env = registry.make("CartStemContact", seed=3, action_kind="continuous", solver_path="lanes", max_episode_steps=5)
    env.reset()
    found = []
    for devices in (None, ["cpu", "cpu"]):
        model = EnvModel(env, worlds=11, devices=devices)
        model.start(env.snapshot(0))
        search = CEM(CEMConfig(expansions=200, population=11, elites=3, seed=1)).plan(model)
        found.append((search.actions.tolist(), search.value, search.transitions, model.transitions, search.history))
    assert found[0] == found[1]
    with pytest.raises(ValueError, match="devices: 2 for 1 worlds"):
        EnvModel(env, worlds=1, devices=["cpu", "cpu"])


@pytest.mark.cuda
def test_plans_on_a_device_replay_there():
    """Pool, rows and replay on one GPU; the plan leads to the state of its tree's node, to the bit."""
    env = registry.make("CartStemContact", seed=1, device="cuda:0", action_kind="discrete")
    env.reset()
    model = EnvModel(env, worlds=28)
    model.start(env.snapshot(0))
    found = OPD(OPDConfig(expansions=12, batch=4)).plan(model)
    plan = plans.write_down(found, model, {"name": "opd"})
    assert plans.replay(plan, device="cuda:0") == plan.steps
    assert digests(model.state(found.tree.state[found.nodes[-1]]))[0] == plan.steps[-1].state


@pytest.mark.slow
def test_ten_thousand_expansions():
    """Memory is that of the rows, 284 MiB for 70 000 nodes of 4 250 bytes, and of the tree's columns, some 40 MiB."""
    env = registry.make("CartStemContact", seed=0, goals="behind", **DISCRETE)
    env.reset()
    model = EnvModel(env, ModelConfig(memory=320.0), worlds=56)
    model.start(env.snapshot(0))
    found = OPD(OPDConfig(expansions=50)).plan(model)
    resident = _resident()
    model.start(env.snapshot(0))
    found = OPD(OPDConfig(expansions=10_000)).plan(model)
    assert found.expansions == 10_000
    assert len(found.tree) == 70_001
    assert _resident() - resident < 284.0 + 80.0
    assert max(found.tree.depth) >= 10


@pytest.mark.slow
def test_goals_behind_the_obstacle():
    """CartStemContact, 100 random starts and goals: at least 95 % are met; a direct approach meets about 20 %.

    Success is the environment's own flag at the end of its episode.
    """
    config = PlanConfig(planner=CEMConfig(until_success=True))
    env = registry.make("CartStemContact", seed=7, solver_path="lanes")
    model, planner = make_model(env, config), CEM(config.planner)
    met, behind = [], []
    for _ in range(100):
        env.reset()
        behind.append(bool(env.is_behind()))
        met.append(execute(env, model, planner).success)
        assert met[-1] == bool(env.world_state["success"])
    assert sum(behind) > 70
    assert np.mean(met) >= 0.95
    assert np.mean(np.array(met)[behind]) >= 0.95


def _resident():
    """Memory of this process [MiB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20
