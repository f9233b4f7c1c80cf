"""Sums over few entries, in one order whatever the number of worlds.

Torch adds along an axis in an order that on a GPU depends on the shape of the batch, so that a world in a batch would
not have the bits of that world alone.
"""

import functools
from collections.abc import Iterable

import torch
from torch import Tensor


def in_order(parts: Iterable[Tensor]) -> Tensor:
    """Sum one by one."""
    return functools.reduce(torch.add, parts)


def length_of(vector: Tensor) -> Tensor:
    """Euclidean length along the last axis, which is short; its gradient at 0 is 0."""
    square = in_order(part.square() for part in vector.unbind(dim=-1))
    if square.requires_grad:
        square = square.clamp_min(torch.finfo(square.dtype).tiny)
    return square.sqrt()


def total(values: Tensor) -> Tensor:
    """Sum along the last axis, which may be long: halves are added until one is left, shape (...)."""
    while values.shape[-1] > 1:
        half = (values.shape[-1] + 1) // 2
        rest = torch.nn.functional.pad(values[..., half:], (0, 2 * half - values.shape[-1]))
        values = values[..., :half] + rest
    return values[..., 0]


def mean_of(values: Tensor) -> Tensor:
    """Mean over the second axis, of shape (world, n, ...)."""
    return in_order(values.unbind(dim=1)) / values.shape[1]
