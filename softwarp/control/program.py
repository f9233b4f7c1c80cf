"""Small convex quadratic programs, many at once: min x' P x / 2 + q' x, low <= G x <= high.

The alternating direction method of multipliers; rows are scaled to length 1. Reference: Stellato, Banjac, Goulart,
Bemporad, Boyd (2020), OSQP: an operator splitting solver for quadratic programs.
"""

from __future__ import annotations

import torch
from torch import Tensor

ROUNDS = 150
WEIGHT = 0.1  # of the rows' penalty, per mean of P's diagonal
PROXIMAL = 1.0e-6  # likewise
RELAXATION = 1.6


def minimise(p: Tensor, q: Tensor, g: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Solutions, (world, n); rows that cannot all hold are met as well as the last rounds do.

    Args:
        p: Symmetric, positive definite, (world, n, n).
        q: (world, n).
        g: Rows, (world, m, n); those of zeros are ignored.
        low: (world, m).
        high: (world, m), not below ``low``.
    """
    size = torch.linalg.vector_norm(g, dim=2)
    is_row = size > 0.0
    scale = torch.where(is_row, 1.0 / size.clamp_min(1.0e-300), torch.zeros_like(size))
    g = g * scale[..., None]
    zero = torch.zeros_like(size)
    low, high = torch.where(is_row, low * scale, zero), torch.where(is_row, high * scale, zero)
    mean = torch.diagonal(p, dim1=1, dim2=2).mean(dim=1)
    p, q = p / mean[:, None, None], q / mean[:, None]
    eye = torch.eye(q.shape[1]).to(q)
    x, z, y = torch.zeros_like(q), zero.clamp(low, high), zero
    inverse = torch.linalg.inv(p + PROXIMAL * eye + WEIGHT * g.transpose(1, 2) @ g)
    for _ in range(ROUNDS):
        x = _times(inverse, PROXIMAL * x - q + _times(g.transpose(1, 2), WEIGHT * z - y))
        mixed = RELAXATION * _times(g, x) + (1.0 - RELAXATION) * z
        z = (mixed + y / WEIGHT).clamp(low, high)
        y = y + WEIGHT * (mixed - z)
    return x


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    product: Tensor = (matrix @ vector[..., None])[..., 0]
    return product
