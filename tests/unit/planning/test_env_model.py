"""An environment as a planning model: exact to the bit, a fixed pool, states that are reached again."""

import dataclasses

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from softwarp.envs import registry
from softwarp.planning.env_model import EnvModel, ModelConfig
from softwarp.planning.objective import Objective
from softwarp.planning.opd import OPD, OPDConfig
from softwarp.planning.state_store import digests
from tests.env_cases import FAST, path_of, some

ROWS = 4258  # bytes of a state of this scene


def make(**options):
    options = {"action_kind": "discrete", "solver_path": "lanes"} | options
    env = registry.make("CartStemContact", seed=3, **options)
    env.reset()
    return env


def started(env, worlds=8, **config):
    model = EnvModel(env, ModelConfig(**config), worlds=worlds)
    model.start(env.snapshot(0))
    return model


def walk(env, actions):
    """Rewards and fingerprints of the states that actions lead to."""
    rewards, states = [], []
    for action in actions:
        data = env.step(TensorDict({"action": torch.tensor([action])}, batch_size=[1]))["next"]
        rewards.append(float(data["reward"]))
        states += digests(env.snapshot(0))
    return rewards, states


def test_steps_are_those_of_the_environment():
    """Rewards scaled from [-1, 0], states equal to the bit, and the environment that asks is left as it is."""
    env = make()
    before = digests(env.snapshot(0))
    model = started(env)
    state, told = np.array([0]), []
    for action in (6, 6, 5, 0):
        outcome = model.step_many(state, np.array([action]))
        state = outcome.states
        told.append((float(outcome.rewards[0]) - 1.0, digests(model.state(int(state[0])))[0]))
    assert digests(env.snapshot(0)) == before
    rewards, states = walk(env, [6, 6, 5, 0])
    np.testing.assert_allclose([reward for reward, _ in told], rewards, rtol=1e-6)
    assert [name for _, name in told] == states


def test_held_actions_are_repeated_ones():
    """hold = 3: one action is three steps, its reward their mean."""
    env = make()
    model = started(env, hold=3)
    outcome = model.step_many(np.array([0, 0]), np.array([1, 5]))
    rewards, states = walk(env, [5, 5, 5])
    assert digests(model.state(int(outcome.states[1])))[0] == states[-1]
    assert outcome.rewards[1] == pytest.approx(1.0 + sum(rewards) / 3.0)
    assert model.horizon == 10


def test_episode_that_ends_within_a_held_action():
    """The state is the one at the end, later steps earn the rest: 1, as the reward after the goal is 0."""
    env = make(success_tolerance=0.004, goals="open")
    action = 6 if float(env.goal_x) > 0.0 else 0
    rewards, states = [], []
    while not bool(env.world_state["terminated"]):
        reward, state = walk(env, [action])
        rewards, states = rewards + reward, states + state
    assert 1 < len(rewards) < 20
    env = make(success_tolerance=0.004, goals="open")
    model = started(env, hold=30)
    outcome = model.step_many(np.array([0]), np.array([action]))
    assert outcome.ended[0]
    assert outcome.success[0]
    assert outcome.rest[0] == 1.0
    assert digests(model.state(int(outcome.states[0])))[0] == states[-1]
    assert outcome.rewards[0] == pytest.approx((len(rewards) + sum(rewards) + 30 - len(rewards)) / 30)


def test_pool_size_and_memory_do_not_change_a_tree():
    """Pools of 4 and 56 worlds, and rows for 9 states, all give one tree; what was overwritten is reached again."""
    env = make()
    trees, steps = [], []
    for worlds, memory in ((56, 64.0), (4, 64.0), (8, 9.5 * ROWS / 2**20)):
        model = started(env, worlds=worlds, memory=memory)
        found = OPD(OPDConfig(expansions=12, batch=4)).plan(model)
        trees.append(found.tree.to_dict())
        steps.append(model.transitions)
    assert model.state_bytes == ROWS
    assert trees[0] == trees[1] == trees[2]
    assert steps[0] == steps[1] == 84
    assert steps[2] > 84


@pytest.mark.slow  # test_pool_size_and_memory_do_not_change_a_tree loses states too
def test_lost_states_are_one_step_from_kept_ones():
    """Rows for a tenth of the nodes: expanded ones stay, so a lost leaf costs one step more; replanning does not add.

    60 expansions, a plan of one action carried out, 60 more: 840 nodes, 120 of them expanded, and 135 rows.
    """
    model = started(make(), worlds=14, memory=135.5 * ROWS / 2**20)
    planner = OPD(OPDConfig(expansions=60, batch=2))
    first = planner.plan(model)
    planner.advance(1)
    second = planner.plan(model)
    assert 420 < first.transitions <= 2 * 420
    assert 420 < second.transitions <= 2 * 420
    whole, again = started(make(), worlds=14), OPD(OPDConfig(expansions=60, batch=2))
    assert again.plan(whole).tree.to_dict() == first.tree.to_dict()
    again.advance(1)
    assert again.plan(whole).tree.to_dict() == second.tree.to_dict()


def test_sequences_equal_steps():
    """The same actions, run as sequences from a state of the tree and step by step."""
    model = started(make())
    actions = np.array([[6, 0, 3], [2, 2, 5]])
    start = model.step_many(np.array([0]), np.array([4])).states
    rolled = model.roll_out(np.repeat(start, 2), actions)
    states = np.repeat(start, 2)
    for step in range(3):
        outcome = model.step_many(states, actions[:, step])
        states = outcome.states
        np.testing.assert_array_equal(rolled.rewards[:, step], outcome.rewards)
    np.testing.assert_array_equal(rolled.distance, outcome.distance)
    assert rolled.lengths.tolist() == [3, 3]


def test_sequences_go_on_beside_one_that_ended():
    """Towards a goal in the open, which ends the episode, and away from it: after the end rewards are the rest, 1."""
    env = make(success_tolerance=0.004, goals="open")
    towards = 6 if float(env.goal_x) > 0.0 else 0
    model = started(env)
    rolled = model.roll_out(np.zeros(2, dtype=np.int64), np.array([[towards] * 20, [6 - towards] * 20]))
    end = rolled.lengths[0]
    assert rolled.ended.tolist() == rolled.success.tolist() == [True, False]
    assert 1 < end < 20 and rolled.lengths[1] == 20
    assert (rolled.rewards[0, end:] == 1.0).all() and (rolled.rewards[0, : end - 1] < 1.0).all()
    assert (rolled.rewards[1] < 1.0).all()
    assert model.transitions == end + 20
    assert rolled.values(0.9)[0] == pytest.approx(rolled.rewards[0] @ 0.9 ** np.arange(20) + 0.9**20 / 0.1)


def test_last_held_action_may_be_cut_short():
    """Eight steps in actions of three: a third action of two steps, after which the time is over."""
    model = started(make(max_episode_steps=8), hold=3)
    assert model.horizon == 3
    rolled = model.roll_out(np.array([0]), np.array([[3, 3, 3]]))
    assert rolled.ended[0] and rolled.lengths[0] == 3
    whole = started(make(max_episode_steps=8)).roll_out(np.array([0]), np.array([[3] * 8])).rewards[0]
    np.testing.assert_allclose(rolled.rewards[0], [whole[:3].mean(), whole[3:6].mean(), whole[6:].sum() / 3.0])


def test_time_is_over_at_the_horizon():
    """An episode that is cut off earns nothing after it, one that met the goal the most."""
    model = started(make(max_episode_steps=2))
    assert model.horizon == 2
    rolled = model.roll_out(np.array([0]), np.array([[3, 3]]))
    assert rolled.ended[0]
    assert rolled.rest[0] == 0.0
    assert rolled.values(0.9)[0] == pytest.approx(rolled.rewards[0] @ [1.0, 0.9])


def test_continuous_actions_have_levels():
    """Three levels of a single action in [-1, 1]; sequences take any value."""
    model = started(make(action_kind="continuous"), levels=3)
    assert (model.action_count, model.action_size) == (3, 1)
    assert model.choices.flatten().tolist() == [-1.0, 0.0, 1.0]
    by_level = model.step_many(np.array([0]), np.array([2]))
    rolled = model.roll_out(np.array([0]), np.array([[[1.0]]]))
    assert by_level.rewards[0] == rolled.rewards[0, 0]
    assert started(make(action_kind="continuous"), levels=300).action_count == 0


def test_new_start_forgets_the_old_states():
    """The pool and its rows are used again; only the root counts."""
    env = make()
    model = started(env)
    first = model.step_many(np.array([0]), np.array([6]))
    block = model._store._block
    walk(env, [0, 0])
    model.start(env.snapshot(0))
    assert model._store._block is block
    assert model.transitions == 0
    second = model.step_many(np.array([0]), np.array([6]))
    assert second.distance[0] != first.distance[0]
    assert second.states.tolist() == [1]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda env: started(env, memory=0.001), "planning needs 9; give memory of at least 0.0365 MiB"),
        (lambda env: started(env, memory=1e9), "memory of 1e.09 MiB needs 954 TiB for .* on cpu; .* states fit"),
        (lambda env: ModelConfig(memory=float("inf")), "model: memory must be a finite number"),
        (lambda env: EnvModel(env, worlds=4).state_bytes, "call start"),
        (lambda env: ModelConfig(hold=0), "hold: must be at least 1"),
        (lambda env: ModelConfig(levels=1), "levels: must be at least 2"),
        (lambda env: ModelConfig(reward_range=[1.0]), "reward_range: needs 2 values"),
        (lambda env: started(env, reward_range=[1.0, 0.0]), "must be .low, high. with low < high"),
        (lambda env: started(env, objective="speed"), "objective: must be one of reward, distance"),
    ],
)
def test_bad_settings_are_refused(call, message):
    with pytest.raises((ValueError, RuntimeError, MemoryError), match=message):
        call(make())


def outcome(reward=0.0, distance=0.1, terminated=False, success=False, status=0):
    columns = {"reward": [reward], "distance": [distance], "terminated": [terminated], "success": [success]}
    return TensorDict({k: torch.tensor([v]) for k, v in (columns | {"world_status": [status]}).items()}, batch_size=[1])


def test_objectives_by_hand():
    """(r + 5) / 15 for r in [-5, 10]; d0 / (d0 + d); failures earn 0, also after the end."""
    task = Objective.of("reward", (-5.0, 10.0), 0.1)
    near = Objective.of("distance", (-1.0, 1.0), 0.1)
    assert float(task.rewards(outcome(reward=1.0))) == pytest.approx(0.4)
    assert float(task.rest(outcome(terminated=True))) == pytest.approx(1.0 / 3.0)
    assert float(task.rest(outcome())) == 0.0
    assert float(near.rewards(outcome(distance=0.3))) == pytest.approx(0.25)
    assert float(near.rest(outcome(terminated=True, success=True))) == 1.0
    assert float(near.rest(outcome(terminated=True))) == 0.0
    for objective in (task, near):
        failed = outcome(reward=1.0, terminated=True, status=3)
        assert float(objective.rewards(failed)) == 0.0
        assert float(objective.rest(failed)) == 0.0


@pytest.mark.parametrize("name", some(1))
def test_every_environment_can_be_asked(name):
    """A few steps and sequences in each environment of the table; the pool has the options of the one that asks."""
    env = registry.make(name, seed=0, solver_path=path_of(name, "lanes"), **FAST.get(name, {}))
    env.reset()
    model = EnvModel(env, ModelConfig(levels=2), worlds=4)
    model.start(env.snapshot(0))
    if model.action_count:
        told = model.step_many(np.zeros(2, dtype=np.int64), np.arange(2))
        assert ((told.rewards >= 0.0) & (told.rewards <= 1.0)).all()
    if model.action_size:
        rolled = model.roll_out(np.zeros(2, dtype=np.int64), np.zeros((2, 2, model.action_size)))
        assert ((rolled.rewards >= 0.0) & (rolled.rewards <= 1.0)).all()
    assert dataclasses.replace(model.pool.config, check_actions=True) == env.config


def test_strides_are_steps_of_the_same_action():
    """Of 7 actions 7 to 13 last three strides of 2 steps: states, rewards and plan are those of 6 steps; any order."""
    env = make()
    model = started(env, worlds=2, hold=2, strides=[1, 3])
    assert model.action_count == 14
    outcome = model.step_many(np.zeros(5, dtype=np.int64), np.array([5 + 7, 1, 5, 1 + 7, 6]))
    assert model.schedule(np.array([5 + 7, 1])).tolist() == [5] * 6 + [1] * 2
    alone = started(make(), hold=2).step_many(np.zeros(3, dtype=np.int64), np.array([1, 5, 6]))
    np.testing.assert_array_equal(outcome.rewards[[1, 2, 4]], alone.rewards)
    rewards, states = walk(env, [5] * 6)
    assert digests(model.state(int(outcome.states[0])))[0] == states[-1]
    assert digests(model.state(int(outcome.states[2])))[0] == states[1]
    assert outcome.rewards[0] == pytest.approx(1.0 + sum(rewards) / 6.0)


def test_lost_states_of_strides_are_reached_again():
    """Rows for a part of the states give the tree that rows for all give."""
    trees = []
    for memory in (64.0, 9.5 * ROWS / 2**20):
        model = started(make(), worlds=8, memory=memory, strides=[1, 2])
        trees.append(OPD(OPDConfig(expansions=6, batch=4)).plan(model).tree.to_dict())
    assert trees[0] == trees[1]


def test_strides_are_for_trees():
    with pytest.raises(ValueError, match=r"strides: are for planner opd, .* not \[1, 4\]"):
        started(make(), strides=[1, 4]).roll_out(np.array([0]), np.array([[1, 2]]))
    with pytest.raises(ValueError, match=r"strides: must be different numbers of at least 1, got \[0\]"):
        ModelConfig(strides=[0])
