"""softwarp transfer: from a plan on the simple maze to servo commands on the tripod, and between other robots."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from experiments import transfer as module
from experiments import verbs
from experiments.config import ConfigError
from experiments.maze_replanning import Replanner
from softwarp import cli
from softwarp.deploy import CommandFile, Player
from softwarp.envs import registry
from softwarp.planning import plans
from softwarp.planning.env_model import EnvModel
from softwarp.planning.opd import OPD, OPDConfig
from softwarp.planning.options import ModelConfig
from softwarp.planning.tracing import trace


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    """A plan to a corner of the serpentine, found by OPD; its file."""
    env = registry.make("SimpleMaze", seed=1, solver_path="lanes", goal_place=(0.0258125, 0.0258125))
    env.reset()
    model = EnvModel(env, ModelConfig(), worlds=32)
    model.start(env.snapshot(0))
    search = OPD(OPDConfig(expansions=400, until_success=True)).plan(model)
    made = plans.write_down(search, model, {"name": "opd"})
    assert made.success
    path = tmp_path_factory.mktemp("plan") / "plan.json"
    made.save(path)
    return path


@pytest.mark.slow
def test_a_plan_is_watched(plan):
    """Normals that the actions tell, places of the ball at every step, and the task for other environments."""
    made = plans.Plan.load(plan)
    watched = trace(made)
    count = len(made.actions)
    assert (watched.kind, watched.success) == ("normal", True)
    assert watched.targets.shape == (count + 1, 3) and watched.places.shape == (50 * count + 1, 2)
    np.testing.assert_allclose(watched.times, 0.5 * np.arange(count + 1))
    tilt = np.arccos(watched.targets[1:, 2])
    np.testing.assert_allclose(tilt, 0.2 * np.sqrt(2.0), atol=1e-6)
    assert np.linalg.norm(watched.places[-1] - watched.options["goal_place"]) <= 0.005
    times, targets = watched.path(0.2)
    np.testing.assert_allclose(times[:3], [0.0, 0.2, 0.5])
    np.testing.assert_allclose(targets[[0, 1, 2]], watched.targets[[0, 1, 1]])


@pytest.mark.slow
def test_from_plan_to_servos(plan, tmp_path, capsys):
    """The command: the replay meets the goal, the file can be played, and what is told stands in the summary."""
    out, summary, picture = (tmp_path / name for name in ("servos.csv", "told.json", "both.png"))
    words = [str(plan), "to=maze", f"out={out}", f"summary={summary}", f"picture={picture}", "replays=4"]
    assert cli.main(["transfer", *words]) == 0
    assert "Maze follows the plan for" in (told := capsys.readouterr().out) and "meets the goal" in told
    file = CommandFile.load(out)
    assert file.names == ("motor_0", "motor_1", "motor_2") and file.check().is_sound
    assert [channel.unit for channel in file.channels] == ["rad"] * 3
    assert file.channels[0].low == pytest.approx(-2.0225) and file.channels[0].high == pytest.approx(-0.0255)
    sent = []
    player = Player(file, dict.fromkeys(file.names, sent.append), rate=20.0)
    np.testing.assert_allclose(player.dry_run()[: len(file.values)], file.values, atol=1e-6)
    numbers = json.loads(summary.read_text())
    assert numbers["plan_success"] and numbers["within_limits"] and numbers["nominal"]["success"] == 1.0
    assert 0.0 < numbers["nominal"]["deviation"] < 0.010
    assert numbers["open"]["replays"] == 4 and 0.0 <= numbers["open"]["success"] <= 1.0
    assert picture.stat().st_size > 10_000


@pytest.mark.slow
def test_worlds_differ_and_are_the_same_again(plan):
    """The spread changes parameters and servos of worlds; the same seed gives the same replays."""
    config = verbs.transferring(str(plan), ["to=maze", "replays=3", "seed=4"])
    first, second = (module.transfer(plans.Plan.load(plan), config, set()) for _ in range(2))
    assert np.array_equal(first.replays["open"].places, second.replays["open"].places)
    assert np.array_equal(first.file.values, second.file.values)
    places = first.replays["open"].places
    assert np.abs(places[:, 0] - places[:, 1]).max() > 1e-4


@pytest.mark.slow
def test_replanning_reaches_goals():
    """Driving the simple maze itself from its measured ball, planning anew every 0.5 s: both worlds end at the goal."""
    env = registry.make("SimpleMaze", num_worlds=2, seed=0, maze="random", columns=3, rows=4, maze_seed=5)
    env.reset()
    replanner = Replanner(env.task_options(0), 0.5, 2, 2, "cpu")
    env = registry.make("SimpleMaze", num_worlds=2, seed=0, **env.task_options(0))
    env.reset()
    start = float(env.way[0])
    met = torch.zeros(2, dtype=torch.bool)
    for _ in range(12):
        normal = replanner.decide(env)
        np.testing.assert_allclose(normal.norm(dim=1), 1.0, atol=1e-6)
        action = (normal[:, 0] < 0.0).long() + 2 * (normal[:, 1] < 0.0).long()  # in the order of ``tilts``
        met |= env.step(TensorDict({"action": action}, batch_size=env.batch_size))["next", "success"][:, 0]
    assert start > 0.02 and met.all()


def test_points_are_followed_by_other_robots():
    """A Diamond's plan, made with one stiffness, followed by one a fifth stiffer and at its pace: 0.5 mm at the end."""
    env = registry.make("Diamond", seed=3, mesh="coarse")
    env.reset()
    start = env.snapshot(0)
    actions = [[0.8, 0.2, 0.0, 0.1]] * 5 + [[0.0] * 4] * 20
    steps = plans.follow(env, start, torch.tensor(actions))
    settings = {"name": "Diamond", **dataclasses.asdict(env.config)}
    made = plans.Plan(settings, {}, start, actions, steps, 0.0, {"expansions": 0, "seconds": 0.0})
    config = verbs.TransferConfig(env={"name": "Diamond", "mesh": "coarse", "youngs": 216.0e3})
    result = module.transfer(made, config, {"mesh", "youngs"})
    assert result.file.names == ("cable_north", "cable_west", "cable_south", "cable_east")
    assert {channel.unit for channel in result.file.channels} == {"m"} and result.file.check().is_sound
    way = np.linalg.norm(result.trace.places[-1] - result.trace.places[0])
    assert way > 5e-3 and result.nominal.last_deviation.max() < 5e-4
    assert np.abs(result.file.values[-1, 0] - 0.020) < 2e-3  # lengths lead to places, whatever the stiffness


def test_mistakes_are_told_early(plan, tmp_path, capsys):
    """Before Torch is loaded where that can be: no plan, its environment set, endings, unknown options and robots."""
    with pytest.raises(ConfigError, match=r"plan no\.json does not exist; make one with softwarp plan out=no\.json"):
        verbs.transferring("no.json", [])
    with pytest.raises(ConfigError, match="the plan has its environment; to=maze names who follows"):
        verbs.transferring(str(plan), ["env=maze"])
    with pytest.raises(ValueError, match=r"out=servos\.txt: needs the ending \.csv"):
        verbs.transferring(str(plan), ["out=servos.txt"])
    with pytest.raises(ConfigError, match="youngz"):
        verbs.transferring(str(plan), ["to=maze", "to.youngz=1"])
    assert cli.main(["transfer", str(plan), "to=diamond", "to.mesh=coarse"]) == 2
    assert "the plan's targets are tilts of a plate, which Maze can follow; Diamond has none" in capsys.readouterr().err
