"""SAC on a point that moves to a goal: it learns, and its losses are what they claim to be."""

import math
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict

from softwarp.policies.policy import NetworkConfig
from softwarp.training.evaluation import run_episodes
from softwarp.training.ranks import ALONE
from softwarp.training.sac import SAC, SACConfig, residual_loss
from tests.unit.training.reach import PointReach


def make(*, discrete=False, worlds=16, network=None, **config):
    torch.manual_seed(0)
    settings = SACConfig(**({"batch": 64, "warmup_steps": 64, "capacity": 4096} | config))
    return SAC(PointReach(worlds, discrete=discrete), network or NetworkConfig(hidden=[16]), settings)


@pytest.mark.slow
@pytest.mark.parametrize("discrete", [False, True])
@pytest.mark.parametrize("bias", [1.0, 0.0])
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


def last_layers(*networks):
    return [[layer for layer in net.modules() if isinstance(layer, torch.nn.Linear)][-1] for net in networks]


def constant(sac, *, now=(0.0, 0.0), slow=(0.0, 0.0)):
    """Let the actor ignore what it sees, and both Q-functions and their slow copies say the same everywhere."""
    with torch.no_grad():
        for layer in last_layers(sac.policy.actor):
            layer.weight.zero_(), layer.bias.zero_()
        for values, params in ((now, sac.loss.qvalue_network_params), (slow, sac.loss.target_qvalue_network_params)):
            keys = sorted(key for key in params.keys(True, True) if key[-1] in ("weight", "bias"))
            for kind, told in (("weight", (0.0, 0.0)), ("bias", values)):
                last = [key for key in keys if key[-1] == kind][-1]
                for net, value in enumerate(told):
                    params[last].data[net].fill_(value)


def replayed(sac, action, rewards, ends):
    """Transitions with these rewards and ends, as the loss sees them; observations are zeros."""
    n = len(rewards)
    flags = torch.tensor(ends)[:, None]
    after = {"observation": torch.zeros(n, 4), "reward": torch.tensor(rewards)[:, None]}
    after = TensorDict(after | {"terminated": flags, "done": flags.clone()}, [n])
    return TensorDict({"observation": torch.zeros(n, 4), "action": action, "next": after}, [n])


def test_soft_bellman_target_by_hand_for_choices():
    """Rewards 1 and 4, the second an end; slow Q 3 and 2, gamma 0.5, alpha 0.1, five equally likely choices.

    y = 1 + 0.5 (2 + 0.1 log 5) and 4; with Q 0 and 1 now the loss is the sum over both of the mean square.
    """
    sac = make(discrete=True, gamma=0.5, initial_alpha=0.1)
    constant(sac, now=(0.0, 1.0), slow=(3.0, 2.0))
    data = replayed(sac, torch.tensor([3, 0]), [1.0, 4.0], [False, True])
    y = 2.0 + 0.05 * math.log(5.0)
    losses = sac.loss(data).detach()
    assert float(losses["loss_qvalue"]) == pytest.approx((y**2 + 4.0**2 + (y - 1.0) ** 2 + 3.0**2) / 2.0, rel=1e-5)
    assert data["td_error"].tolist() == pytest.approx([y, 4.0], rel=1e-5)
    # The temperature falls while the entropy, log 5, is above its target.
    expected = -math.log(0.1) * (0.3 * math.log(5.0) - math.log(5.0))
    assert float(losses["loss_alpha"]) == pytest.approx(expected, rel=1e-5)
    assert float(losses["loss_actor"]) == pytest.approx(-0.1 * math.log(5.0), rel=1e-5)


def test_soft_bellman_target_by_hand_for_continuous_actions():
    """The same with a = tanh(u), u ~ N(0, s^2) in two dimensions, s = e^-1.5 where the network says nothing.

    Its entropy is 2 (log(s sqrt(2 pi e)) + E log(1 - tanh(u)^2)) by quadrature; the mean target of 20 000 draws is
    1 + 0.5 (2 + entropy) with alpha = 1, to 0.01 (their standard error is 0.004); an end leaves the reward alone.
    """
    sac = make(gamma=0.5, initial_alpha=1.0)
    constant(sac, slow=(3.0, 2.0))
    s = math.exp(-1.5)
    u = torch.linspace(-8.0, 8.0, 4001, dtype=torch.float64) * s
    weight = (-0.5 * (u / s).square()).exp()
    squash = float((weight * (1.0 - u.tanh().square()).log()).sum() / weight.sum())
    entropy = 2.0 * (math.log(s * math.sqrt(2.0 * math.pi * math.e)) + squash)
    ends = [False] * 20_000 + [True]
    data = replayed(sac, torch.zeros(20_001, 2), [1.0] * 20_001, ends)
    losses = sac.loss(data).detach()  # errors are |0 - y|
    assert float(data["td_error"][:-1].mean()) == pytest.approx(1.0 + 0.5 * (2.0 + entropy), abs=0.01)
    assert float(data["td_error"][-1]) == pytest.approx(1.0)
    assert float(losses["entropy"]) == pytest.approx(entropy, abs=0.01)


@pytest.mark.parametrize(
    ("discrete", "given", "expected"),
    [(False, None, -2.0), (True, None, 0.3 * math.log(5.0)), (False, -0.7, -0.7), (True, 0.7, 0.7)],
)
def test_target_entropy(discrete, given, expected):
    """-dim(action), 0.3 log(choices), or what is asked for."""
    assert float(make(discrete=discrete, target_entropy=given).loss.target_entropy) == pytest.approx(expected)


@pytest.mark.parametrize("discrete", [False, True])
def test_slow_copies_go_a_share_of_the_way(discrete):
    """After a gradient step each slow Q' is (1 - tau) Q' + tau Q, with Q as the step left it."""
    sac = make(discrete=discrete, tau=0.25, warmup_steps=0, update_ratio=1 / 64)
    sac.update(0.0)
    slow, fast = sac.loss.target_qvalue_network_params, sac.loss.qvalue_network_params
    before = {key: slow[key].detach().clone() for key in slow.keys(True, True)}
    sac._step()
    for key, old in before.items():
        expected = 0.75 * old + 0.25 * fast[key].detach()
        torch.testing.assert_close(slow[key].detach(), expected)
    assert any(bool((fast[key] != old).any()) for key, old in before.items())


def test_priorities_weigh_the_errors():
    """Errors 2, 4, -4 with weights 1, 0.5, 0.5 have the weighted mean 1; those of the other Q-function are all 1.

    AVEC leaves 1, 3, -5 of them: (1 + 0.5 * 9 + 0.5 * 25 + 0) / 3 = 6; half of it leaves 1.5, 3.5, -4.5 and 0.5.
    What is replayed sooner, and the offset to be put back, are those of the errors themselves.
    """
    values = torch.tensor([[3.0, 5.0, -3.0], [2.0, 2.0, 2.0]])
    target, weight = torch.ones(3), torch.tensor([1.0, 0.5, 0.5])
    for bias, expected in ((0.0, 18.0), (0.5, 18.5 + 0.5), (1.0, 20.0 + 2.0)):
        loss = SimpleNamespace(critic_bias=bias, ranks=ALONE)
        found, told = residual_loss(loss, values, target, weight)
        assert float(found) == pytest.approx(expected / 3.0)
        assert told["td_error"].tolist() == [2.0, 4.0, 4.0]
        assert loss.mean_error.tolist() == pytest.approx([2.0 / 3.0, 1.0])


def test_priority_weights_reach_the_loss():
    """What the replay hands over with its transitions weighs their errors."""
    for discrete in (False, True):
        sac = make(discrete=discrete, gamma=0.0)
        constant(sac)
        action = torch.tensor([0, 1]) if discrete else torch.zeros(2, 2)
        data = replayed(sac, action, [1.0, 2.0], [False, False]).set("priority_weight", torch.tensor([1.0, 0.25]))
        assert float(sac.loss(data)["loss_qvalue"].detach()) == pytest.approx(2.0 * (1.0 + 0.25 * 4.0) / 2.0)


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


@pytest.mark.parametrize("discrete", [False, True])
def test_long_gradients_are_cut_and_a_fixed_temperature_stays(discrete):
    """Networks get a gradient of ``max_grad_norm`` at most; without tuning the temperature is what it was."""
    sac = make(discrete=discrete, max_grad_norm=1e-3, tune_alpha=False, initial_alpha=0.3, warmup_steps=0)
    sac.update(0.0)
    told = sac._step()
    length = torch.stack([parameter.grad.norm() for parameter in sac.trained if parameter.grad is not None]).norm()
    assert float(length) == pytest.approx(1e-3, rel=1e-3)
    assert float(told["alpha"]) == pytest.approx(0.3)
    tuned = make(discrete=discrete, initial_alpha=0.3, warmup_steps=0)
    tuned.update(0.0)
    assert float(tuned._step()["alpha"]) != pytest.approx(0.3)


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
