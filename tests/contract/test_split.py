"""Worlds on several devices behind one call: the episodes and fits are those of one device."""

import pytest
import torch

from softwarp.envs import registry
from softwarp.envs.split import SplitEnv
from softwarp.policies.actor_critic import ActorCritic
from softwarp.policies.baselines import scripted
from softwarp.policies.baselines.table import RULES
from softwarp.policies.policy import NetworkConfig, Spaces
from softwarp.training.evaluation import run_episodes

WORLDS, EPISODES = 7, 11  # odd, and a second batch of which a part is wanted


def make(device, worlds):
    return registry.make("CartPole", num_worlds=worlds, device=device, max_episode_steps=25, solver_path="lanes")


def trained(env):
    torch.manual_seed(1)
    return ActorCritic(Spaces.of(env), NetworkConfig(hidden=[16], recurrent=4))


def test_episodes_on_two_devices_are_those_of_one():
    """["cpu", "cpu"] with 4 and 3 worlds: a network with memory, random actions and a rule that knows its worlds."""
    whole, split = make("cpu", WORLDS), SplitEnv(make, ["cpu", "cpu"], WORLDS)
    assert [part.num_worlds for part in split.parts] == [4, 3]
    rule = next(iter(RULES["CartPole"].values()))
    first = split.parts[0]
    pairs = [(trained(whole), trained(first)), (rule(whole), split.split(rule))]
    pairs += [tuple(scripted.random(Spaces.of(env), 3) for env in (whole, first))]
    found = []
    for alone, shared in pairs:
        one = run_episodes(whole, alone, seed=5, episodes=EPISODES)
        other = run_episodes(split, shared, seed=5, episodes=EPISODES)
        for name, column in vars(one).items():
            assert torch.equal(column.nan_to_num(), getattr(other, name).nan_to_num()), name
        found.append(one.returns)
    assert not torch.equal(found[0], found[2])  # the policies do differ
    assert len(set(found[2].tolist())) > WORLDS  # and so do the episodes


def test_more_devices_than_worlds_are_refused():
    """Every device needs a world."""
    with pytest.raises(ValueError, match="devices: 2 for 1 worlds; give each a world at least"):
        SplitEnv(make, ["cpu", "cpu"], 1)
