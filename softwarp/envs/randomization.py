"""Counter-based random numbers and the distributions drawn at reset.

A draw depends on (seed, world, episode, stream) alone, never on who drew before: world 5 gets the same goal in its
third episode whatever the batch size and whenever its neighbours were reset. The generator is Philox-4x32-10 written on
int64 tensors, so that one source serves CPU and CUDA and gives the same bits on both.

Reference: Salmon, Moraes, Dror, Shaw (2011), Parallel Random Numbers: As Easy as 1, 2, 3.
"""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

_MASK = 0xFFFFFFFF
_MULTIPLIERS = (0xD2511F53, 0xCD9E8D57)
_WEYL = (0x9E3779B9, 0xBB67AE85)
_ROUNDS = 10


def philox4x32(counter: tuple[Tensor, Tensor, Tensor, Tensor], key: tuple[Tensor, Tensor]) -> Tensor:
    """Four random 32-bit words per counter, as int64 in [0, 2^32).

    Args:
        counter: Four int64 tensors of one shape, each value in [0, 2^32).
        key: Two more such tensors, broadcast against the counter's.

    Returns:
        Words, shape (*counter shape, 4).
    """
    c0, c1, c2, c3 = counter
    one = [1] * c0.dim()
    multiplied, mixed = torch.stack((c2, c0)), torch.stack((c1, c3))  # each pair goes through the rounds as one tensor
    multipliers, rounds = _constants(c0.device)
    multipliers = multipliers.reshape(2, *one)
    keys = (torch.stack(torch.broadcast_tensors(*key)) + rounds.reshape(_ROUNDS, 2, *one)) & _MASK
    for round_key in keys:
        # The 64-bit product wraps, but its two 32-bit halves are exact: shift arithmetically, then mask.
        product = multiplied * multipliers
        multiplied = ((product >> 32 & _MASK) ^ mixed ^ round_key).flip(0)
        mixed = product & _MASK
    (c2, c0), (c1, c3) = multiplied, mixed
    return torch.stack((c0, c1, c2, c3), dim=-1)


@functools.cache
def _constants(device: torch.device) -> tuple[Tensor, Tensor]:
    """Multipliers (2,) and the keys' increments (round, 2); kept, since a captured step cannot bring them there."""
    with torch.inference_mode(False):
        rounds = torch.arange(_ROUNDS).reshape(-1, 1) * torch.tensor(_WEYL)
        return torch.tensor(_MULTIPLIERS[::-1]).to(device), rounds.to(device)


def uniform(seed: Tensor, world: Tensor, episode: Tensor, stream: int, count: int) -> Tensor:
    """Uniform numbers in [0, 1), shape (world, count), float32, from (seed, world, episode, stream).

    Args:
        seed: Seed of every row, non-negative, int64 (world,).
        world: Owner of every row, int64 (world,).
        episode: Episode number of every row, int64 (world,).
        stream: Which quantity is drawn; use another number for each.
        count: Numbers per world.
    """
    blocks = torch.arange(-(-count // 4), device=world.device)
    shape = (world.shape[0], blocks.shape[0])
    counter = (
        blocks.expand(shape),
        torch.full(shape, stream, dtype=torch.int64, device=world.device),
        (episode & _MASK)[:, None].expand(shape),
        (world & _MASK)[:, None].expand(shape),
    )
    key = ((seed & _MASK)[:, None], (seed >> 32 & _MASK)[:, None])
    words = philox4x32(counter, key).flatten(1)[:, :count]
    return (words >> 8).to(torch.float32) * 2.0**-24  # 24 bits fit a float32 exactly, so 1.0 never occurs


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
