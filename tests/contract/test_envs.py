"""Promises that every environment of the table keeps with its default options."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import RewardSum, StepCounter, TransformedEnv
from torchrl.envs.transforms import Compose
from torchrl.envs.utils import check_env_specs

from softwarp.envs import registry


@pytest.fixture(scope="module", params=registry.names())
def env(request):
    return registry.make(request.param, num_worlds=3, seed=1)


def act(env, action):
    return env.step(TensorDict({"action": action}, batch_size=env.batch_size))["next"]


def play(env, count, seed=0):
    """Random actions that depend on the seed alone; observations, shape (count, world, k)."""
    torch.manual_seed(seed)
    return torch.stack([act(env, env.action_spec.rand())["observation"] for _ in range(count)])


def test_specs(env):
    check_env_specs(env)
    check_env_specs(TransformedEnv(env, Compose(StepCounter(), RewardSum())))


def test_values_lie_in_their_specs(env):
    spec = env.observation_spec["observation"]
    assert spec.space.low.isfinite().all() and spec.space.high.isfinite().all()
    env.reset()
    assert all(spec.is_in(observation) for observation in play(env, 5))


def test_same_seed_same_bits(env):
    sequences = []
    for _ in range(2):
        env.set_seed(4)
        env.reset()
        sequences.append(play(env, 3))
    assert torch.equal(*sequences)


def test_masked_reset_leaves_the_others_bit_equal(env):
    mask = torch.tensor([False, True, False])
    sequences = []
    for is_reset in (False, True):
        env.set_seed(4)
        env.reset()
        play(env, 2)
        if is_reset:
            env.reset_where(mask)
        sequences.append(play(env, 2, seed=1))
    assert torch.equal(sequences[0][:, ~mask], sequences[1][:, ~mask])
    assert not torch.equal(sequences[0][:, mask], sequences[1][:, mask])


def test_snapshot_replays_the_same_bits(env):
    env.reset()
    saved = env.snapshot()
    first = play(env, 3)
    env.restore(saved)
    assert torch.equal(first, play(env, 3))


def test_poisoned_world_is_reported_and_alone(env):
    env.reset()
    saved = env.snapshot()
    expected = play(env, 1)[0]
    env.restore(saved)
    env.sim.node_x[1] = torch.nan
    env.sim.frame_pose[1] = torch.nan
    torch.manual_seed(0)
    data = act(env, env.action_spec.rand())
    assert data["terminated"].flatten().tolist() == [False, True, False]
    assert (data["world_status"].flatten() >= 3).tolist() == [False, True, False]
    assert data["observation"].isfinite().all() and data["reward"].isfinite().all()
    assert torch.equal(data["observation"][[0, 2]], expected[[0, 2]])
    env.reset()
    assert (act(env, env.action_spec.rand())["world_status"] == 0).all()
