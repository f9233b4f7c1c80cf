"""PPO with memory: it remembers what it no longer sees, and learning sees what acting saw."""

import pytest
import torch

from softwarp.policies.policy import Memory, NetworkConfig
from softwarp.training.checkpoints import build_policy, policy_content
from softwarp.training.evaluation import run_episodes
from softwarp.training.ppo import PPO, PPOConfig
from tests.unit.training.reach import HiddenGoal, PointReach

MEMORY = NetworkConfig(hidden=[32], recurrent=16)


def make(env, network=MEMORY, **config):
    torch.manual_seed(0)
    return PPO(env, network, PPOConfig(**config))


@pytest.mark.parametrize("discrete", [False, True])
def test_learning_sees_the_probabilities_of_acting(discrete):
    """The sequence pass over a batch with resets in it gives the log-probabilities that the rollout stored."""
    ppo = make(PointReach(6, discrete=discrete, max_episode_steps=5), horizon=12)
    ppo.update(0.0)
    data = ppo.collect()
    assert data["is_first"].any()
    seen = ppo._with_features(data)
    again = ppo.policy.head(seen["observation"]).log_prob(seen["action"])
    torch.testing.assert_close(again, seen["action_log_prob"], atol=1e-5, rtol=1e-5)


def test_whole_episodes_at_once_are_the_same_as_step_by_step():
    """The fused pass, which knows no beginnings, from any memory, with its gradients."""
    torch.manual_seed(0)
    memory, inputs, begin = Memory(5, 7), torch.randn(4, 9, 5), torch.randn(4, 14)
    gradients = []
    for is_first in (None, torch.zeros(4, 9, dtype=torch.bool)):
        memory.zero_grad()
        output = memory.run(inputs, begin, is_first)
        output.square().sum().backward()
        gradients.append([output, *(parameter.grad.clone() for parameter in memory.parameters())])
    for fused, stepped in zip(*gradients, strict=True):
        torch.testing.assert_close(fused, stepped, rtol=1e-4, atol=1e-5)


def test_memory_is_cleared_where_episodes_begin():
    """Stored memory is zero after a reset and not zero elsewhere; under next it is the one that continues."""
    ppo = make(PointReach(6, max_episode_steps=5, terminate=False), horizon=12, stagger=False)
    batch = ppo.rollout.collect()
    done = batch["next", "done"][:, :-1, 0]
    memory, after = batch["memory"], batch["next", "memory"]
    assert memory[:, 1:][done].abs().max() == 0.0
    assert torch.equal(memory[:, 1:][~done], after[:, :-1][~done])
    assert after.abs().amax(-1).min() > 0.0


@pytest.mark.slow
def test_remembers_a_goal_that_it_saw_once():
    """With memory the policy comes to hidden goals; without it, it cannot know where they are."""
    success = {}
    for units in (16, 0):
        network = NetworkConfig(hidden=[32], recurrent=units)
        ppo = make(HiddenGoal(64, max_episode_steps=8), network, horizon=16, learning_rate=3e-3)
        for k in range(40):
            ppo.update(k / 40)
        success[units] = run_episodes(HiddenGoal(64, seed=7, max_episode_steps=8), ppo.policy, seed=7).summary()[
            "success"
        ]
    assert success[16] > 0.6
    assert success[16] > 2.0 * success[0]


def test_rebuilt_policy_acts_the_same():
    """A checkpoint's content restores networks and memory."""
    ppo = make(HiddenGoal(8), horizon=4)
    ppo.update(0.0)
    rebuilt = build_policy(policy_content(ppo.policy))
    one, other = (run_episodes(HiddenGoal(8, seed=3), policy, seed=3) for policy in (ppo.policy.eval(), rebuilt))
    assert torch.equal(one.returns, other.returns)
