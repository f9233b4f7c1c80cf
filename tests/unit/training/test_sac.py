"""SAC on a point that moves to a goal: it learns, and its losses are what they claim to be."""

import pytest
import torch

from softwarp.policies.policy import NetworkConfig
from softwarp.training.evaluation import run_episodes
from softwarp.training.sac import SAC, SACConfig
from tests.unit.training.reach import PointReach


def make(*, discrete=False, worlds=16, network=None, **config):
    torch.manual_seed(0)
    settings = SACConfig(**({"batch": 64, "warmup_steps": 64, "capacity": 4096} | config))
    return SAC(PointReach(worlds, discrete=discrete), network or NetworkConfig(hidden=[16]), settings)


@pytest.mark.parametrize("discrete", [False, True])
@pytest.mark.parametrize("bias", [1.0, pytest.param(0.0, marks=pytest.mark.slow)])
def test_learns_to_reach(discrete, bias):
    """After 10 000 steps most unseen goals are reached; before them hardly any is. So it is with AVEC."""
    network = NetworkConfig(hidden=[32, 32])
    options = {"batch": 256, "warmup_steps": 1000, "learning_rate": 1e-3, "tau": 0.02, "capacity": 100_000}
    sac = make(discrete=discrete, worlds=64, network=network, critic_bias=bias, initial_alpha=0.05, **options)
    held_out = PointReach(64, seed=7, discrete=discrete)
    before = run_episodes(held_out, sac.policy, seed=7).summary()
    for _ in range(40):
        metrics = sac.update(0.0)
    after = run_episodes(held_out, sac.policy, seed=7).summary()
    assert before["success"] < 0.3
    assert after["success"] > 0.8
    assert set(metrics) == set(sac.metrics)
    assert all(value == value for value in metrics.values())


@pytest.mark.parametrize("discrete", [False, True])
def test_critic_regresses_to_the_soft_bellman_target(discrete):
    """With bias 1 the loss is the sum over both Q of the mean squared error to r + gamma (1 - term) soft V."""
    sac = make(discrete=discrete)
    for _ in range(3):
        sac.update(0.0)
    data = sac._replayed()
    torch.manual_seed(3)
    result = sac.loss(data.clone())
    torch.manual_seed(3)
    target = sac.loss._compute_target(data) if discrete else sac.loss._compute_target_v2(data)
    ends = data["next", "terminated"].squeeze(-1)
    torch.testing.assert_close(target[ends], data["next", "reward"].squeeze(-1)[ends])
    squares = 0.0
    for net in range(2):
        critic = sac.policy.make_critic()
        sac.loss.qvalue_network_params.data[net].to_module(critic)
        values = critic(data.clone())["action_value" if discrete else "state_action_value"]
        values = values.gather(-1, data["action"].unsqueeze(-1)) if discrete else values
        squares = squares + (values.squeeze(-1) - target).square().mean()
    torch.testing.assert_close(result["loss_qvalue"], squares)


def test_gradient_steps_follow_the_ratio():
    """An update of 16 worlds x 4 steps owes 64 x ratio gradient steps; fractions are carried over."""
    sac = make(update_ratio=0.02, warmup_steps=0)
    counts = []
    taken = sac._step
    sac._step = lambda: counts.append(1) or taken()
    for _ in range(4):
        sac.update(0.0)
    assert len(counts) == int(4 * 64 * 0.02)


def test_warm_up_acts_at_random_and_learns_nothing():
    """Until the warm-up is over the networks stay as they are; actions fill their range."""
    sac = make(warmup_steps=10_000)
    before = [parameter.clone() for parameter in sac.trained]
    for _ in range(5):
        metrics = sac.update(0.0)
    assert all(torch.equal(old, new) for old, new in zip(before, sac.trained, strict=True))
    assert set(metrics) == {"learning_rate", "replay"}
    action = sac.replay.data["action"][: sac.replay.size]
    assert action.min() < -0.9
    assert action.max() > 0.9
    assert action.std() > 0.5


def test_policy_and_loss_share_their_actor():
    """A gradient step on the loss moves the policy that acts."""
    sac = make(warmup_steps=0)
    before = sac.policy.act(torch.ones(1, 4))
    for _ in range(3):
        sac.update(0.0)
    assert not torch.equal(before, sac.policy.act(torch.ones(1, 4)))


def test_schedule_leaves_the_temperature_its_own_rate():
    """The linear schedule moves the networks' rate only."""
    sac = make(schedule="linear", learning_rate=1e-3, alpha_rate=5e-3)
    assert sac.update(1.0)["learning_rate"] == pytest.approx(5e-5)
    assert sac.optimizer.param_groups[1]["lr"] == 5e-3


def test_memory_is_refused():
    """SAC replays single steps."""
    with pytest.raises(ValueError, match=r"network\.recurrent: SAC replays single steps"):
        make(network=NetworkConfig(recurrent=8))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"batch": 0}, "algo.batch: must be at least 1, got 0"),
        ({"update_ratio": 0.0}, "algo.update_ratio: must be positive, got 0"),
        ({"tau": 2.0}, r"algo.tau: must lie in \(0, 1\], got 2"),
        ({"warmup_steps": -1}, "algo.warmup_steps: must not be negative, got -1"),
        ({"schedule": "adaptive"}, "adaptive belongs to PPO"),
        ({"critic_bias": 2.0}, r"algo.critic_bias: must lie in \[0, 1\], got 2"),
    ],
)
def test_bad_settings_are_refused(options, message):
    """The message names setting, value and requirement."""
    with pytest.raises(ValueError, match=message):
        SACConfig(**options)
