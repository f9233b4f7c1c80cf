"""Reward terms: small pure functions on tensors of shape (world,), each finite for finite input."""

from __future__ import annotations

from torch import Tensor

from softwarp.envs.sums import mean_of

_SMALLEST_DISTANCE = 1e-9  # m, keeps quotients finite at the goal


def progress(previous: Tensor, distance: Tensor, scale: float) -> Tensor:
    """Distance won in this step, (previous - distance) / scale.

    A difference of potentials: summed over an episode it depends on start and end alone, so circling earns nothing.
    """
    return (previous - distance) / scale


def gaussian(distance: Tensor, scale: float) -> Tensor:
    """exp(-(d / scale)^2), in (0, 1]; flat beyond about two scales."""
    return (-(distance / scale).square()).exp()


def cauchy(distance: Tensor, scale: float) -> Tensor:
    """1 / (1 + (d / scale)^2), in (0, 1]; unlike a Gaussian it still slopes several scales away."""
    return 1.0 / (1.0 + (distance / scale).square())


def effort(action: Tensor) -> Tensor:
    """Mean square of an action (world, k), as a cost: in [-1, 0] for actions in [-1, 1]."""
    return -mean_of(action.square())


def relative_progress(previous: Tensor, distance: Tensor) -> Tensor:
    """SofaGym's reach reward, min(sqrt(max((d_prev - d) / d_prev, 0)), 1); moving away costs nothing.

    Reference: SofaGym, reward of its Trunk and Diamond scenes. An agent can farm it by going back and forth.
    """
    won = (previous - distance) / previous.clamp_min(_SMALLEST_DISTANCE)
    return won.clamp(0.0, 1.0).sqrt()
