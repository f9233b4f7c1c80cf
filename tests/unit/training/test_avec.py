"""AVEC: the gradient of the residual variance, and the offset that it leaves free."""

import pytest
import torch

from softwarp.policies.policy import NetworkConfig
from softwarp.training.algorithm import recentre, shift_output
from softwarp.training.ppo import PPO, PPOConfig
from softwarp.training.sac import SAC, SACConfig
from tests.unit.training.reach import PointReach


@pytest.mark.parametrize("bias", [0.0, 0.25, 1.0])
@pytest.mark.parametrize("weighted", [False, True])
def test_gradient_is_that_of_variance_and_mean(bias, weighted):
    """Mean squares to the recentred target have the gradient of Var(e) + bias mean(e)^2 (by autograd, float64)."""
    torch.manual_seed(0)
    target = torch.randn(2, 50, dtype=torch.float64)
    weight = torch.rand(50, dtype=torch.float64) if weighted else None
    share = (torch.ones(50, dtype=torch.float64) if weight is None else weight) / 50.0
    one, other = (torch.randn(2, 50, dtype=torch.float64, generator=torch.manual_seed(1)) for _ in range(2))
    one.requires_grad_(), other.requires_grad_()
    (share * (one - recentre(one, target, bias, weight)).square()).sum().backward()

    error = other - target
    mean = (share * error).sum(-1, keepdim=True) / share.sum()
    (share * ((error - mean).square() + bias * mean.square())).sum().backward()
    torch.testing.assert_close(one.grad, other.grad)


def test_torchrl_loss_of_ppo_is_the_residual_variance():
    """With bias 0 an offset of the critic leaves the loss alone; with bias 1 it does not."""
    losses = {}
    for bias in (0.0, 1.0):
        torch.manual_seed(0)
        ppo = PPO(PointReach(16), NetworkConfig(hidden=[16]), PPOConfig(horizon=8, critic_bias=bias))
        data = ppo.collect()
        values = [ppo.loss(data)["loss_critic"].detach()]
        shift_output(ppo.policy.critic, torch.tensor(3.0))
        values.append(ppo.loss(data)["loss_critic"].detach())
        losses[bias] = values
        error = data["value_target"] - ppo.policy.critic.module(data["observation"])
        if bias == 0.0:
            torch.testing.assert_close(values[1], 0.5 * error.var(unbiased=False))
    torch.testing.assert_close(*losses[0.0])
    assert losses[1.0][1] > losses[1.0][0] + 1.0


@pytest.mark.parametrize("shift", [True, False])
def test_ppo_puts_the_mean_error_back(shift):
    """After an update the mean error over the batch is zero if the offset is shifted back."""
    torch.manual_seed(0)
    config = PPOConfig(horizon=8, critic_bias=0.0, shift_critic=shift)
    ppo = PPO(PointReach(16), NetworkConfig(hidden=[16]), config)
    shift_output(ppo.policy.critic, torch.tensor(5.0))
    data = ppo.collect()
    ppo.learn(data)
    error = float((data["value_target"] - ppo.policy.critic.module(data["observation"])).mean().detach())
    assert (abs(error) < 1e-4) == shift


@pytest.mark.parametrize("discrete", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_sac_offsets_are_drawn_back(discrete):
    """Q-functions that start off by 5 come back when their offset is shifted, and stay there when it is not.

    Without discount their target is the reward, 64 gradient steps of 0.1 leave 0.9^64 = 0.1 % of the offset.
    """
    offsets = {}
    for shift in (True, False):
        torch.manual_seed(0)
        config = SACConfig(critic_bias=0.0, shift_critic=shift, tau=0.1, gamma=0.0, batch=64, warmup_steps=0)
        sac = SAC(PointReach(16, discrete=discrete), NetworkConfig(hidden=[16]), config)
        with torch.no_grad():
            sac.last_bias.add_(5.0)
        for _ in range(8):
            sac.update(0.0)
        offsets[shift] = float(sac.loss.mean_error.abs().max())
    assert offsets[True] < 0.5
    assert offsets[False] > 3.0


@pytest.mark.parametrize("config", [PPOConfig(horizon=8), PPOConfig(horizon=8, critic_bias=0.0)])
def test_rewards_can_be_scaled(config):
    """With scaled rewards the unit of the reward does not matter: the same learning, to rounding."""
    metrics = []
    for unit in (1.0, 1000.0):
        torch.manual_seed(0)
        config.scale_rewards = True
        env = PointReach(16)
        step = env._step
        env._step = lambda td, step=step, unit=unit: step(td).apply(
            lambda name, value, unit=unit: unit * value if name == "reward" else value, named=True
        )
        ppo = PPO(env, NetworkConfig(hidden=[16]), config)
        metrics.append([ppo.update(0.0) for _ in range(3)][-1])
    for name in ("loss_critic", "loss_objective", "kl"):
        assert metrics[0][name] == pytest.approx(metrics[1][name], rel=1e-2, abs=1e-5), name
