"""PPO on a point that moves to a goal: it learns, and its advantages treat ends of episodes as they should."""

import math

import pytest
import torch
from torchrl.envs import check_env_specs

from softwarp.policies.policy import NetworkConfig
from softwarp.training.evaluation import run_episodes
from softwarp.training.ppo import PPO, PPOConfig
from tests.unit.training.reach import PointReach


@pytest.mark.parametrize("discrete", [False, True])
def test_env_passes_torchrl_check(discrete):
    """The environment that these tests stand on keeps TorchRL's contract."""
    check_env_specs(PointReach(3, discrete=discrete))


@pytest.mark.parametrize("discrete", [False, True])
@pytest.mark.parametrize("schedule", ["linear", "adaptive"])
def test_learns_to_reach(discrete, schedule):
    """After 15 updates nearly every unseen goal is reached; before them hardly any is."""
    torch.manual_seed(0)
    ppo = PPO(PointReach(64, discrete=discrete), NetworkConfig(hidden=[32, 32]), PPOConfig(schedule=schedule))
    held_out = PointReach(64, seed=7, discrete=discrete)
    before = run_episodes(held_out, ppo.policy, seed=7).summary()
    for k in range(15):
        metrics = ppo.update(k / 15)
    after = run_episodes(held_out, ppo.policy, seed=7).summary()
    assert before["success"] < 0.2
    assert after["success"] > 0.9
    assert after["distance"] < 0.03
    assert all(value == value for value in metrics.values())


def test_truncation_bootstraps_and_termination_does_not():
    """With gamma = 0.9, lambda = 1 and V = 1 everywhere, two steps of reward 2 give known advantages.

    running:     A = 2 + 0.9 * (2 + 0.9 V) - V
    truncated:   the first step bootstraps from V of its own last observation and stops: A = 2 + 0.9 V - V
    terminated:  A = 2 - V
    """
    from tensordict import TensorDict
    from torchrl.objectives.value import GAE

    def advantage(terminated, done):
        flags = torch.tensor([[[terminated], [False]]]), torch.tensor([[[done], [False]]])
        one = torch.ones(1, 2, 1)
        after = TensorDict({"state_value": one, "reward": 2.0 * one, "terminated": flags[0], "done": flags[1]}, [1, 2])
        batch = TensorDict({"state_value": one.clone(), "next": after}, [1, 2])
        return float(GAE(gamma=0.9, lmbda=1.0, value_network=None)(batch)["advantage"][0, 0])

    assert advantage(False, False) == pytest.approx(2.0 + 0.9 * (2.0 + 0.9) - 1.0)
    assert advantage(False, True) == pytest.approx(2.0 + 0.9 - 1.0)
    assert advantage(True, True) == pytest.approx(2.0 - 1.0)


def test_rollout_of_ppo_bootstraps_from_the_last_observation():
    """Targets of ``collect``: r + gamma V(s') at a time limit, s' before the reset, and r alone at a goal."""
    for terminates in (False, True):
        torch.manual_seed(0)
        env = PointReach(16, max_episode_steps=3, terminate=terminates)
        ppo = PPO(env, NetworkConfig(hidden=[16]), PPOConfig(horizon=30, gae_lambda=0.0, gamma=0.5, stagger=False))
        with torch.no_grad():
            ppo.policy.value_norm.update(torch.randn(100) * 3.0 + 7.0)
        scale = ppo.policy.value_norm.std, ppo.policy.value_norm.mean.clone()
        data = ppo.collect()
        batch = ppo.rollout.buffer.transpose(0, 1)
        after, ends = batch["next"], batch["next", "terminated"]
        values = (
            scale[0] * ppo.policy.critic.module(ppo.policy.observation_norm(after["observation"])) + scale[1].float()
        )
        target = after["reward"] + 0.5 * ~ends * values
        assert bool((after["done"] & ~ends).any()) and bool(ends.any()) == terminates
        torch.testing.assert_close(ppo.policy.value_norm.inverse(data["value_target"]), target.reshape(-1, 1))


def test_a_batch_of_one_transition_is_learned_from():
    """One world, one step: the advantage has no spread and changes nothing, the critic learns."""
    ppo = PPO(PointReach(1), NetworkConfig(hidden=[8]), PPOConfig(horizon=1))
    assert math.isfinite(ppo.update(0.0)["loss_critic"])
    assert all(bool(parameter.isfinite().all()) for parameter in ppo.policy.parameters())


def test_epochs_stop_at_the_divergence_limit():
    """A tiny limit ends the epochs after the first, a limit of 0 never does."""
    for limit, epochs in ((1e-9, 1), (0.0, 5)):
        torch.manual_seed(0)
        config = PPOConfig(target_kl=limit, epochs=5, horizon=8)
        ppo = PPO(PointReach(16), NetworkConfig(hidden=[16]), config)
        assert ppo.update(0.0)["epochs"] == epochs


def test_warm_up_leaves_the_adaptive_rate_alone():
    """A policy that is not trained does not move; its rate rises afterwards only."""
    config = PPOConfig(horizon=4, schedule="adaptive", warmup_updates=2, epochs=2, target_kl=1e6)
    ppo = PPO(PointReach(8), NetworkConfig(hidden=[8]), config)
    rates = [ppo.update(0.0)["learning_rate"] for _ in range(3)]
    assert rates == pytest.approx([1e-3, 1e-3, 1e-3 * 1.5**2])


def test_linear_schedule_falls_with_progress():
    """The learning rate is the configured one at the start and 5 % of it at the end."""
    ppo = PPO(PointReach(8), NetworkConfig(hidden=[8]), PPOConfig(horizon=4, learning_rate=1e-3))
    assert ppo.update(0.0)["learning_rate"] == pytest.approx(1e-3)
    assert ppo.update(1.0)["learning_rate"] == pytest.approx(5e-5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"horizon": 0}, r"algo.horizon: must be at least 1, got 0"),
        ({"value": 0.0}, r"algo.value: must be positive, got 0"),
        ({"learning_rate": -1.0}, r"algo.learning_rate: must be positive, got -1"),
        ({"gamma": 1.5}, r"algo.gamma: must lie in \[0, 1\], got 1.5"),
        ({"schedule": "cosine"}, r"algo.schedule: 'cosine' is unknown; choose from constant, linear, adaptive"),
        ({"schedule": "adaptive", "target_kl": 0.0}, r"adaptive needs algo.target_kl > 0"),
        ({"entropy": float("nan")}, r"algo: entropy must be a finite number, got nan"),
    ],
)
def test_bad_settings_are_refused(options, message):
    """The message names setting, value and requirement."""
    with pytest.raises(ValueError, match=message):
        PPOConfig(**options)
