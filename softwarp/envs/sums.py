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


def mean_of(values: Tensor) -> Tensor:
    """Mean over the second axis, of shape (world, n, ...)."""
    return in_order(values.unbind(dim=1)) / values.shape[1]
