"""Triangles between rings of points around an axis."""

from __future__ import annotations

import numpy as np

from softwarp.meshing.tets import IntArray


def band(low: IntArray, high: IntArray) -> IntArray:
    """Triangles between two rings, outward if the second lies above or outside, shape (2 corners, 3)."""
    a, b, c, d = low, np.roll(low, -1), high, np.roll(high, -1)
    return np.concatenate([np.stack((a, b, d), axis=1), np.stack((a, d, c), axis=1)])


def fan(ring: IntArray, centre: int) -> IntArray:
    """Triangles between a ring and a point, looking down, shape (corner, 3)."""
    return np.stack((np.roll(ring, -1), ring, np.full_like(ring, centre)), axis=1)
