"""Worlds of a GPU that step in two halves at the same time: the bits that they have in one."""

import pytest
import torch

from softwarp.envs import registry
from softwarp.solvers import partition
from tests.env_replays import assert_equal, random_actions, stepped

pytestmark = pytest.mark.cuda
N = 72  # two shards of 64 and 8 worlds


def made(monkeypatch, least, **options):
    """Quadrupeds whose shards have so many worlds at least."""
    monkeypatch.setattr(partition, "GPU_WORLDS", least)
    env = registry.make("MultiGaitReduced", num_worlds=N, device="cuda:0", seed=1, **options)
    assert len(env.sim.systems) == (2 if least <= N // 2 else 1)
    return env


@pytest.mark.parametrize("capture", [False, True])
def test_shards_have_the_same_bits(monkeypatch, capture):
    """Some actions with resets, launched by the simulator and recorded by torch."""
    whole, halves = (made(monkeypatch, n, capture=capture, max_episode_steps=4) for n in (N, 32))
    actions = random_actions(whole, 6)
    assert_equal(stepped(halves, actions), stepped(whole, actions))


def test_several_steps_at_once(monkeypatch):
    """The worst status and the states of three steps by one call."""
    whole, halves = (made(monkeypatch, n, capture=False) for n in (N, 32))
    for env in (whole, halves):
        env.reset()
        for _ in range(3):
            env.sim.step(3)
    for name in ("node_x", "mode_v", "status", "contact_count"):
        assert torch.equal(getattr(whole.sim, name), getattr(halves.sim, name))
