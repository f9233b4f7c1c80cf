"""PPO with memory: it remembers what it no longer sees, and learning sees what acting saw."""

import pytest
import torch

from softwarp.policies.policy import NetworkConfig
from softwarp.training.checkpoints import build_policy, policy_content
from softwarp.training.evaluation import run_episodes
from softwarp.training.ppo import PPO, PPOConfig
from tests.unit.training.reach import PointReach

MEMORY = NetworkConfig(hidden=[32], recurrent=16)


class HiddenGoal(PointReach):
    """The goal is shown at the first step of an episode only."""

    def _observe(self):
        told = super()._observe()
        seen = (self.steps == 0)[:, None]
        told["observation"] = torch.where(seen, told["observation"], told["observation"] * torch.tensor([1, 1, 0, 0]))
        return told


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
    seen = ppo._with_memory(data)
    again = ppo.policy.head(seen["observation"]).log_prob(seen["action"])
    torch.testing.assert_close(again, seen["action_log_prob"], atol=1e-5, rtol=1e-5)


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
