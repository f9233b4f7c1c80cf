"""PPO on a point that moves to a goal: it learns, and its advantages treat ends of episodes as they should."""

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import check_env_specs

from softwarp.policies.policy import NetworkConfig
from softwarp.training.evaluation import run_episodes
from softwarp.training.ppo import PPO, PPOConfig
from tests.unit.training.reach import PointReach


@pytest.mark.parametrize("discrete", [False, True])
def test_env_passes_torchrl_check(discrete):
    """The environment that these tests stand on keeps TorchRL's contract."""
    check_env_specs(PointReach(3, discrete=discrete))


@pytest.mark.parametrize(
    ("discrete", "schedule"),
    [
        (True, "linear"),
        pytest.param(False, "adaptive", marks=pytest.mark.slow),
        pytest.param(False, "linear", marks=pytest.mark.slow),
        pytest.param(True, "adaptive", marks=pytest.mark.slow),
    ],
)
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


@pytest.mark.parametrize(("terminates", "bootstrap"), [(False, True), (True, True), (True, False)])
def test_advantages_follow_the_recursion(terminates, bootstrap):
    """Targets and advantages of ``collect`` by a loop backwards in time.

    delta = r + gamma V(s') - V(s), A = delta + gamma lambda A'; a goal leaves out V(s'), any end leaves out A', and at
    a time limit s' is the state before the reset; without bootstrap it is left out there too. Targets are A + V(s),
    advantages have mean 0 and deviation 1.
    """
    torch.manual_seed(0)
    env = PointReach(16, max_episode_steps=3, terminate=terminates)
    config = PPOConfig(horizon=30, gae_lambda=0.4, gamma=0.5, stagger=False, bootstrap=bootstrap)
    ppo = PPO(env, NetworkConfig(hidden=[16]), config)
    with torch.no_grad():
        ppo.policy.value_norm.update(torch.randn(100) * 3.0 + 7.0)
    scale, middle = ppo.policy.value_norm.std, ppo.policy.value_norm.mean.clone().float()

    def value(observation):
        return scale * ppo.policy.critic.module(ppo.policy.observation_norm(observation)) + middle

    data = ppo.collect()
    batch = ppo.rollout.buffer  # (step, world)
    after, ends, done = batch["next"], batch["next", "terminated"], batch["next", "done"]
    assert bool((done & ~ends).any()) and bool(ends.any()) == terminates
    over = ends if bootstrap else done
    change = after["reward"] + 0.5 * ~over * value(after["observation"]) - value(batch["observation"])
    advantage, rows = torch.zeros(16, 1), []
    for step in reversed(range(30)):
        advantage = change[step] + 0.5 * 0.4 * ~done[step] * advantage
        rows.append(advantage)
    expected = torch.stack(rows[::-1]).transpose(0, 1).reshape(-1, 1)
    target = expected + value(batch["observation"]).transpose(0, 1).reshape(-1, 1)
    torch.testing.assert_close(ppo.policy.value_norm.inverse(data["value_target"]), target)
    torch.testing.assert_close(data["advantage"], (expected - expected.mean()) / expected.std(), atol=1e-5, rtol=1e-4)


def even_policy(config, logits=(0.0,) * 5, offset=0.0):
    """PPO over five choices whose logits and value do not depend on the observation."""
    ppo = PPO(PointReach(4, discrete=True), NetworkConfig(hidden=[8]), config)
    last = [
        [layer for layer in net.modules() if isinstance(layer, torch.nn.Linear)][-1]
        for net in (ppo.policy.actor, ppo.policy.critic)
    ]
    with torch.no_grad():
        for layer, bias in zip(last, (torch.tensor(logits), torch.tensor([offset])), strict=True):
            layer.weight.zero_()
            layer.bias.copy_(bias)
    return ppo, *last


def transitions(ppo, choice, ratio, advantage, target):
    """Minibatch of transitions that the present policy takes ``ratio`` times as often as the old one did."""
    now = ppo.policy.head(torch.zeros(len(choice), 4)).log_prob(torch.tensor(choice)).detach()
    columns = {"action_log_prob": now - torch.tensor(ratio).log(), "action": torch.tensor(choice)}
    columns |= {"advantage": torch.tensor(advantage)[:, None], "value_target": torch.tensor(target)[:, None]}
    return TensorDict(columns | {"observation": torch.zeros(len(choice), 4)}, [len(choice)])


def test_losses_by_hand():
    """Ratios 1.5 and 0.5, advantages 1 and -1, clip 0.1, five equally likely choices, values 3 for targets 1 and 5.

    min(rho A, clip(rho) A) = 1.1, 0.5, -1.5, -0.9, so L = 0.8 / 4; entropy log 5 times -0.25; value 0.5 * 4.
    """
    ppo, *_ = even_policy(PPOConfig(clip=0.1, entropy=0.25, value=0.5), offset=3.0)
    data = transitions(ppo, [0, 1, 2, 3], [1.5, 0.5, 1.5, 0.5], [1.0, 1.0, -1.0, -1.0], [1.0, 5.0, 1.0, 5.0])
    losses = ppo.loss(data).detach()
    assert float(losses["loss_objective"]) == pytest.approx(0.2, rel=1e-5)
    assert float(losses["loss_entropy"]) == pytest.approx(-0.25 * math.log(5.0), rel=1e-5)
    assert float(losses["loss_critic"]) == pytest.approx(2.0, rel=1e-5)
    assert float(losses["clip_fraction"]) == pytest.approx(1.0)


@pytest.mark.parametrize("warmup", [0, 1])
def test_gradient_of_a_step_by_hand(warmup):
    """A step descends L_policy + L_value - c H: at the logits, with p = softmax and H its entropy, by hand.

    dL/dz_k = -mean over unclipped of A rho (1[a = k] - p_k) + c p_k (log p_k + H); while warming up, nothing of it.
    The value's offset v gets 2 c_v (v - mean target). Of four transitions the first and the last are clipped.
    """
    config = PPOConfig(clip=0.1, entropy=0.25, value=0.5, warmup_updates=warmup, max_grad_norm=1e9)
    ppo, actor, critic = even_policy(config, logits=(0.0, 0.4, -0.3, 0.2, 0.1), offset=2.0)
    choice, ratio, advantage = [0, 1, 2, 3], [1.5, 0.5, 1.5, 0.5], [1.0, 1.0, -1.0, -1.0]
    ppo._step(transitions(ppo, choice, ratio, advantage, [1.0, 5.0, 1.0, 5.0]))
    p = [0.17988, 0.26835, 0.13326, 0.21971, 0.19880]  # exp(z) / 5.55922
    entropy = -sum(q * math.log(q) for q in p)
    expected = [0.25 * q * (math.log(q) + entropy) for q in p]
    for a, weight in ((1, 0.5), (2, -1.5)):  # rho A of what is not clipped
        expected = [g - weight / 4.0 * ((k == a) - q) for k, (g, q) in enumerate(zip(expected, p, strict=True))]
    found = [0.0] * 5 if actor.bias.grad is None else actor.bias.grad.tolist()
    assert found == pytest.approx([0.0] * 5 if warmup else expected, abs=1e-4)
    assert critic.bias.grad.tolist() == pytest.approx([2.0 * 0.5 * (2.0 - 3.0)], rel=1e-5)


def test_long_gradients_are_cut():
    """The gradient over all parameters is no longer than ``max_grad_norm``, and as long as that where it was longer."""
    ppo = PPO(PointReach(8), NetworkConfig(hidden=[8]), PPOConfig(horizon=4, max_grad_norm=1e-3))
    told = ppo._step(ppo.collect())
    length = torch.stack([parameter.grad.norm() for parameter in ppo.parameters if parameter.grad is not None]).norm()
    assert float(told["grad_norm"]) > 1e-2
    assert float(length) == pytest.approx(1e-3, rel=1e-3)


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
        ({"bootstrap": False}, r"algo.bootstrap: false needs algo.stagger=false"),
        ({"entropy": float("nan")}, r"algo: entropy must be a finite number, got nan"),
    ],
)
def test_bad_settings_are_refused(options, message):
    """The message names setting, value and requirement."""
    with pytest.raises(ValueError, match=message):
        PPOConfig(**options)
