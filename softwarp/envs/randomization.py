"""Counter-based random numbers and the distributions drawn at reset.

A draw depends on (seed, world, episode, stream) alone, never on who drew before: world 5 gets the same goal in its
third episode whatever the batch size and whenever its neighbours were reset, on every device. The generator is
Philox-4x32-10 (kernels/algebra/philox.py).
"""

from __future__ import annotations

import functools
import math

import torch
import warp as wp
from torch import Tensor

from softwarp import interop
from softwarp.kernels.algebra.lanes import variant
from softwarp.kernels.algebra.philox import kernels
from softwarp.threads import begin


def uniform(seed: Tensor, world: Tensor, episode: Tensor, stream: int, count: int) -> Tensor:
    """Uniform numbers in [0, 1), shape (world, count), float32, from (seed, world, episode, stream).

    Args:
        seed: Seed of every row, non-negative, int64 (world,).
        world: Owner of every row, int64 (world,).
        episode: Episode number of every row, int64 (world,).
        stream: Which quantity is drawn; use another number for each.
        count: Numbers per world.
    """
    begin()
    device = wp.device_from_torch(seed.device)
    u = torch.empty((len(seed), count), device=seed.device)
    with interop.on_torch_stream(str(device)):
        kernel = kernels(variant("cuda" if device.is_cuda else "scalar", "float32")).uniform
        inputs = [stream, *(wp.from_torch(part, requires_grad=False) for part in (seed, world, episode))]
        outputs = [wp.from_torch(u, requires_grad=False)]
        wp.launch(kernel, dim=(len(seed), -(-count // 4)), inputs=inputs, outputs=outputs, device=device)
    return u


def in_range(u: Tensor, bounds: tuple[float, float]) -> Tensor:
    """Map uniform numbers [0, 1) to [low, high), linearly."""
    low, high = bounds
    return low + (high - low) * u


def direction_in_cone(u: Tensor, axis: tuple[float, float, float], half_angle: float) -> Tensor:
    """Unit vectors, uniform on the spherical cap around ``axis``.

    Args:
        u: Uniform numbers, shape (world, 2).
        axis: Centre of the cap; need not be a unit vector, must not be zero.
        half_angle: Opening of the cap [rad], in [0, pi].

    Returns:
        Directions, shape (world, 3), dtype of ``u``.
    """
    frame = _frame(tuple(axis), u.dtype, u.device)
    cos = 1.0 - (1.0 - math.cos(half_angle)) * u[:, 0]
    sin = (1.0 - cos.square()).clamp_min(0.0).sqrt()
    phi = 2.0 * math.pi * u[:, 1]
    return torch.stack((sin * phi.cos(), sin * phi.sin(), cos), dim=-1) @ frame


@functools.cache
def _frame(axis: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Two tangents and the direction of an axis as rows; kept, since a captured step cannot bring them there."""
    with torch.inference_mode(False):
        centre = torch.tensor(axis, dtype=torch.float64)
        centre = centre / centre.norm()
        helper = torch.eye(3, dtype=torch.float64)[int(centre.abs().argmin())]
        side = torch.linalg.cross(centre, helper)
        side = side / side.norm()
        return torch.stack((side, torch.linalg.cross(centre, side), centre)).to(device, dtype)
