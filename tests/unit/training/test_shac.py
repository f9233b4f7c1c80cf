"""SHAC: targets in closed form, the limit of actions, and that a window left half way is found again."""

from __future__ import annotations

from typing import Any

import pytest
import torch

import softwarp as sw
from softwarp.policies.policy import NetworkConfig
from softwarp.training.algorithms import make_algorithm
from softwarp.training.gradient_rollout import Window, _Within, bounded
from softwarp.training.options import SHACConfig
from softwarp.training.shac import SHAC


class Left(Exception):
    """A run is to end."""


def made(seed: int = 0, **options: Any) -> SHAC:
    """On three worlds of a coarse Diamond, windows of four actions."""
    torch.manual_seed(seed)
    env = sw.make("Diamond", num_worlds=3, seed=seed, mesh="coarse", max_episode_steps=6)
    config = SHACConfig(**({"horizon": 4, "critic_epochs": 2, "minibatches": 2} | options))
    algorithm = make_algorithm(env, NetworkConfig(hidden=[16]), config)
    assert isinstance(algorithm, SHAC)
    return algorithm


@pytest.fixture(scope="module")
def shac() -> SHAC:
    """One that learned nothing."""
    return made(gamma=0.9, td_lambda=0.5)


def test_targets_are_discounted_sums(shac: SHAC, monkeypatch: pytest.MonkeyPatch) -> None:
    """World 0 goes on, world 1 is terminated by its first action, world 2 is truncated there; values are 10."""
    no, first = torch.zeros(3, dtype=torch.bool), torch.tensor([False, True, False])
    cut = torch.tensor([False, True, True])
    window = Window(torch.zeros(0), {}, torch.zeros(0), terminated=[first, no], done=[cut, no])
    rewards = torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    monkeypatch.setattr(shac, "_values", lambda window: (torch.full((2, 3), 10.0), rewards))
    last = rewards[1] + 0.9 * 10.0
    expected = [1.0 + 0.9 * (0.5 * 10.0 + 0.5 * float(last[0])), 2.0, 3.0 + 0.9 * 10.0]
    torch.testing.assert_close(shac._targets(window), torch.stack([torch.tensor(expected), last]))


def test_gradients_beyond_the_limits_lead_back_inside() -> None:
    """Descent goes against the gradient: outward ones are dropped."""
    sample = torch.tensor([2.0, 2.0, -2.0, -2.0, 0.5], requires_grad=True)
    limited = _Within.apply(sample)
    assert limited.tolist() == [1.0, 1.0, -1.0, -1.0, 0.5]
    limited.backward(torch.tensor([1.0, -1.0, 1.0, -1.0, 3.0]))
    assert sample.grad is not None
    assert sample.grad.tolist() == [1.0, 0.0, 0.0, -1.0, 3.0]


def test_no_world_outvotes_the_others() -> None:
    """A gradient of 1e5 medians keeps its direction and counts four; worlds that are not finite count nothing."""
    torch.manual_seed(1)
    direction = torch.nn.functional.normalize(torch.randn(9, 3), dim=-1)
    by = direction * torch.tensor([1.0, 1.1, 0.9, 3.0, 1.0, 1e5, 0.0, float("inf"), float("nan")])[:, None]
    found = bounded(by)
    torch.testing.assert_close(found[:5], by[:5])
    torch.testing.assert_close(found[5], 4.0 * direction[5])  # the lower median of six
    assert found[6:].tolist() == [[0.0] * 3] * 3
    assert bounded(torch.zeros(2, 3)).tolist() == [[0.0] * 3] * 2


def test_the_actor_follows_the_gradient_of_the_return(shac: SHAC) -> None:
    """The actor's loss falls along its own gradient, as much as the gradient says."""
    shac.policy.observation_norm.update(torch.stack(shac.rollout.collect_window().seen))
    start, noise = shac.rollout.state_dict(), torch.randn(4, 3, 4)
    weight = shac.actor_parameters[2]

    def loss() -> tuple[float, torch.Tensor]:
        shac.rollout.load_state_dict({**start, "begun": {"noise": noise}})
        before = [item.detach().clone() for item in shac.actor_parameters]
        value = shac._improve(shac.rollout.collect_window())["loss_actor"]
        gradient = weight.grad.clone()
        with torch.no_grad():
            for item, held in zip(shac.actor_parameters, before, strict=True):
                item.copy_(held)
        return value, gradient

    shac.config.max_grad_norm = 1e9
    _, gradient = loss()
    change = 2e-2 * gradient / gradient.norm()
    ends = []
    for sign in (1.0, -1.0):
        with torch.no_grad():
            weight.add_(sign * change)
        ends.append(loss()[0])
        with torch.no_grad():
            weight.sub_(sign * change)
    expected = float((gradient * change).sum())
    assert 0.5 * (ends[0] - ends[1]) == pytest.approx(expected, rel=0.05)


# In the window, at its end, between minibatches.
@pytest.mark.parametrize("looks", [2, *(pytest.param(k, marks=pytest.mark.slow) for k in (7, 10))])
def test_an_update_left_half_way_goes_on_with_the_same_bits(looks: int) -> None:
    """What another continues from a saved state equals what was never stopped: weights, statistics, optimiser."""
    whole = made()
    for _ in range(2):
        whole.update(0.0)
    parts, left = made(), looks

    def pulse() -> None:
        nonlocal left
        left -= 1
        if left == 0:
            raise Left

    parts.feel(pulse)
    updates = 0
    with pytest.raises(Left):
        while True:
            parts.update(0.0)
            updates += 1
    state, random = parts.state_dict(), torch.get_rng_state()
    other = made(seed=7)
    other.load_state_dict(state)
    torch.set_rng_state(random)
    while updates < 2:
        other.update(0.0)
        updates += 1
    assert other.rollout.steps == whole.rollout.steps
    for key, value in whole.state_dict()["policy"].items():
        assert torch.equal(value, other.policy.state_dict()[key]), key
    for key, value in whole.slow_critic.state_dict().items():
        assert torch.equal(value, other.slow_critic.state_dict()[key]), key
    states = whole.optimizer.state_dict()["state"], other.optimizer.state_dict()["state"]
    for index, held in states[0].items():
        assert all(torch.equal(value, states[1][index][name]) for name, value in held.items())


def test_networks_and_environments_that_do_not_fit_are_refused() -> None:
    """By name, with the way out."""
    env = sw.make("Diamond", num_worlds=1, seed=0, mesh="coarse")
    with pytest.raises(ValueError, match=r"network.recurrent: algo=shac has networks of its own"):
        make_algorithm(env, NetworkConfig(recurrent=4), SHACConfig())
    with pytest.raises(ValueError, match="CartPole: steps of this environment have no gradient"):
        make_algorithm(sw.make("CartPole", num_worlds=1, seed=0), NetworkConfig(), SHACConfig())
