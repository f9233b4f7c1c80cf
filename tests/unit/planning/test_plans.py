"""Plans as files, carried out again to the bit; receding horizon; pictures."""

import json

import pytest
import torch

from softwarp.envs import registry
from softwarp.planning import picture, plans
from softwarp.planning.cem import CEM, CEMConfig
from softwarp.planning.env_model import EnvModel, ModelConfig
from softwarp.planning.execution import execute
from softwarp.planning.opd import OPD, OPDConfig
from softwarp.planning.state_store import digests


def make(kind="discrete", num_worlds=1, seed=5):
    env = registry.make(
        "CartStemContact", num_worlds=num_worlds, seed=seed, action_kind=kind, solver_path="lanes", max_episode_steps=8
    )
    env.reset()
    return env


def search(env, **settings):
    model = EnvModel(env, ModelConfig(hold=2), worlds=28)
    model.start(env.snapshot(0))
    planner = OPD(OPDConfig(**({"expansions": 12, "batch": 4} | settings)))
    return model, planner.plan(model)


def test_saved_plan_replays_to_the_same_states(tmp_path):
    """From the middle of an episode: search, save, load, carry out in a fresh environment; every state to the bit."""
    env = make()
    env.step(env.rand_action(env.reset()))
    model, found = search(env)
    plan = plans.write_down(found, model, {"name": "opd", "hold": 2, "seconds": float("inf")})
    plan.save(tmp_path / "plan.json")
    loaded = plans.Plan.load(tmp_path / "plan.json")
    assert (loaded.steps, loaded.actions, loaded.env) == (plan.steps, plan.actions, json.loads(json.dumps(plan.env)))
    assert len(loaded.steps) == 2 * len(found.actions) > 0
    assert plans.replay(loaded) == plan.steps
    # The last prediction is the state of the tree's node, reached by search and not by following the plan.
    model, found = search(env)
    assert digests(model.state(found.tree.state[found.nodes[-1]]))[0] == plan.steps[-1].state
    loaded.actions[0] = 6 - loaded.actions[0]
    assert plans.replay(loaded)[0].state != plan.steps[0].state


def test_files_hold_plain_json_and_name_an_environment(tmp_path):
    """Infinite limits of the scene go through a file that any reader of JSON takes; a class without a name has none."""
    env = registry.make("Diamond", mesh="coarse", min_tension=-float("inf"), action_kind="discrete")
    env.reset()
    model = EnvModel(env, worlds=8)
    model.start(env.snapshot(0))
    found = OPD(OPDConfig(expansions=1, batch=1)).plan(model)
    plan = plans.write_down(found, model, {"name": "opd", "seconds": float("inf")})
    plan.save(tmp_path / "plan.json")

    def refuse(name):
        raise AssertionError(f"{name} is no JSON")

    content = json.loads((tmp_path / "plan.json").read_text(), parse_constant=refuse)
    assert content["env"]["min_tension"] == "-inf"
    assert plans.replay(plans.Plan.load(tmp_path / "plan.json")) == plan.steps

    class Own(type(env)):
        pass

    model.pool.__class__ = Own
    with pytest.raises(ValueError, match=r"Own is defined in a function; define it where others can import it"):
        plans.write_down(found, model, {}, done=([], []))


def test_files_that_are_no_plans_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="does not exist; make one with softwarp plan"):
        plans.Plan.load(tmp_path / "none.json")
    (tmp_path / "cut.json").write_text('{"format": "softw')
    with pytest.raises(ValueError, match="is not a complete plan"):
        plans.Plan.load(tmp_path / "cut.json")
    (tmp_path / "other.json").write_text("[1, 2]")
    with pytest.raises(ValueError, match="is not a plan of version 1"):
        plans.Plan.load(tmp_path / "other.json")
    env = make()
    model, found = search(env)
    plans.write_down(found, model, {}).save(tmp_path / "plan.json")
    content = json.loads((tmp_path / "plan.json").read_text())
    cut = content["start"][:1000] + content["start"][1004:]
    for change in ({"start": cut}, {"start": "AAAA"}, {"start": None}, {"steps": [{"reward": 1.0}]}, {"actions": None}):
        damaged = content | change
        if change == {"actions": None}:
            del damaged["actions"]
        (tmp_path / "damaged.json").write_text(json.dumps(damaged))
        with pytest.raises(ValueError, match=r"damaged\.json is damaged .*; make it again"):
            plans.Plan.load(tmp_path / "damaged.json")


def test_files_with_other_actions_or_environments_are_refused(tmp_path):
    """One action per step, all of one shape, and that of the environment; its options are those that it has."""
    env = make()
    model, found = search(env)
    plans.write_down(found, model, {}).save(tmp_path / "plan.json")
    content = json.loads((tmp_path / "plan.json").read_text())
    actions, settings = content["actions"], content["env"]

    def load(**change):
        (tmp_path / "plan.json").write_text(json.dumps(content | change))
        return plans.Plan.load(tmp_path / "plan.json")

    for change, told in (
        ({"actions": actions[1:]}, f"there must be {len(actions)} actions, one per step"),
        ({"actions": {"a": 1}}, "one per step"),
        ({"actions": [[1], *actions[1:]]}, "actions must all be numbers, or lists of as many numbers"),
        ({"actions": ["6", *actions[1:]]}, "actions must all be numbers"),
        ({"env": []}, "env holds no name"),
        ({"env": {"name": 3}}, "env holds no name"),
    ):
        with pytest.raises(ValueError, match=told):
            load(**change)
    with pytest.raises(ValueError, match=r"takes actions of shape \(\), the plan's have \(2,\); make it again"):
        plans.replay(load(actions=[[action, 0] for action in actions]))
    with pytest.raises(ValueError, match="has no option 'num_worlds'"):
        plans.replay(load(env=settings | {"num_worlds": 2}))


def test_snapshots_as_text():
    """Every array comes back with its bits and type."""
    snapshot = make().snapshot(0)
    back = plans.decode(plans.encode(snapshot))
    assert digests(back) == digests(snapshot)
    assert all(torch.equal(back.sim.arrays[key], value) for key, value in snapshot.sim.arrays.items())


def test_receding_horizon_goes_on_with_the_kept_tree():
    """Replanning every action: all plans but the first start from the tree that is left, in the state foreseen."""
    env = make()
    model = EnvModel(env, ModelConfig(), worlds=28)
    done = execute(env, model, OPD(OPDConfig(expansions=10, batch=4)), replan=1)
    assert len(done.searches) == len(done.steps) == len(done.actions)
    assert done.reused == len(done.searches) - 1
    # Every search can be written down: it starts where it was made, not where the first one was.
    plan = plans.write_down(done.searches[2], model, {"name": "opd"})
    assert plan.steps[0] == done.steps[2]
    assert plan.tree["plan"] == done.searches[2].nodes and plan.tree["nodes"] == len(done.searches[2].tree)
    assert plans.replay(plan) == plan.steps
    with pytest.raises(ValueError, match="the world's episode is over, there is nothing to plan; reset the world"):
        execute(env, model, OPD())
    fresh = execute(make(), model, OPD(OPDConfig(expansions=10, batch=4, reuse=False)), replan=1)
    assert fresh.reused == 0
    assert len(done.searches[1].tree) > len(fresh.searches[1].tree)


def test_a_disturbed_world_is_planned_for_anew():
    """A kept tree is dropped when the world is not where it was foreseen; other worlds keep every bit."""
    env = make(num_worlds=8)
    others = digests(env.snapshot(range(1, 8)))
    model, planner = EnvModel(env, worlds=28), OPD(OPDConfig(expansions=6, batch=4))
    step, calls = env.step, []

    def push(data):
        calls.append(1)
        if len(calls) == 2:
            data["action"][0] = 0
        return step(data)

    env.step = push
    done = execute(env, model, planner, replan=1)
    assert done.reused == len(done.searches) - 2
    assert digests(env.snapshot(range(1, 8))) == others


def test_open_loop_does_what_was_predicted():
    """One plan, carried out to its end: rewards, distances, states are those of the prediction."""
    env = make("continuous")
    model = EnvModel(env, worlds=16)
    start = env.snapshot(0)
    planner = CEM(CEMConfig(expansions=256, population=16))
    done = execute(env, model, planner)
    assert len(done.searches) == 1
    model.start(start)
    actions, steps = plans.predict(done.searches[0], model)
    assert (actions, steps) == (done.actions, done.steps)
    with pytest.raises(ValueError, match="replan: must be at least 0 actions, got -1"):
        execute(env, model, planner, replan=-1)


def test_pictures(tmp_path):
    """A tree and a planner of sequences; leaves stand apart, parents between their children."""
    tree = {"parent": [-1, 0, 0, 0, 0, 4, 5], "action": [-1, 0, 1, 2, 3, 1, 2]}  # of two choices, once and four times
    assert picture.steps_of(tree, 2, [1, 4]) == [0, 2, 2, 8, 8, 10, 18]
    assert picture.layout([-1, 0, 0, 1, 1]).tolist() == [0.625, 0.25, 1.0, 0.0, 0.5]
    env = make()
    model, found = search(env)
    plan = plans.write_down(found, model, {"name": "opd", "hold": 2})
    picture.draw(plan, tmp_path / "tree.png")
    env = make("continuous")
    model = EnvModel(env, worlds=16)
    model.start(env.snapshot(0))
    found = CEM(CEMConfig(expansions=256, population=16)).plan(model)
    picture.draw(plans.write_down(found, model, {"name": "cem"}), tmp_path / "rounds.png")
    assert min((tmp_path / name).stat().st_size for name in ("tree.png", "rounds.png")) > 10_000
