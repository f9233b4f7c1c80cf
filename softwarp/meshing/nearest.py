"""Nearest points of triangles, exactly, on the host."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softwarp.meshing.tets import FloatArray, IntArray

PAIRS = 500_000  # points times triangles that are compared at once; bounds the memory
ROUND_UP = 1.0 + 1e-9  # widens bounds by more than rounding


def nearest(
    vertices: FloatArray, triangles: IntArray, points: FloatArray, cell: float
) -> tuple[FloatArray, NDArray[np.int64], IntArray]:
    """The nearest point of a surface to every point.

    Points are handled cube by cube of edge ``cell``. With the middles m of the triangles and their reach rho around
    them, a cube of centre c and half diagonal r needs only the triangles with |c - m| - rho <= min |c - m| + 2 r, and a
    point p only those with |p - m| - rho <= min |p - m|.

    Args:
        vertices: Positions [m], shape (v, 3).
        triangles: Corners, shape (t, 3), each with an area.
        points: Positions [m], shape (n, 3).
        cell: Edge of a cube [m]; any positive value gives the same points.

    Returns:
        Nearest points [m], shape (n, 3), the triangle of each, shape (n,), and where in it the point lies, shape (n,),
        as in ``closest``.
    """
    corner = vertices[triangles]
    middle = corner.mean(axis=1)
    reach = np.linalg.norm(corner - middle[:, None], axis=2).max(axis=1) * ROUND_UP
    where, triangle = np.empty((len(points), 3)), np.empty(len(points), dtype=np.int64)
    feature = np.empty(len(points), dtype=np.int32)
    if not len(points):
        return where, triangle, feature
    cube = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    _, inverse = np.unique(cube, axis=0, return_inverse=True)
    order = np.argsort(inverse.reshape(-1), kind="stable")
    for group in np.split(order, np.flatnonzero(np.diff(inverse.reshape(-1)[order])) + 1):
        p = points[group]
        c = 0.5 * (p.min(axis=0) + p.max(axis=0))
        r = float(np.linalg.norm(p - c, axis=1).max()) * ROUND_UP
        away = np.linalg.norm(middle - c, axis=1)
        near = np.flatnonzero(away - reach <= away.min() + 2.0 * r)
        rows = max(1, PAIRS // len(near))
        for first in range(0, len(p), rows):
            some = group[first : first + rows]
            where[some], which, feature[some] = _among(points[some], corner[near], middle[near], reach[near])
            triangle[some] = near[which]
    return where, triangle, feature


def _among(
    p: FloatArray, corner: FloatArray, middle: FloatArray, reach: FloatArray
) -> tuple[FloatArray, NDArray[np.int64], IntArray]:
    """``nearest`` among a few triangles."""
    away = np.linalg.norm(p[:, None] - middle, axis=2)
    point, triangle = np.nonzero(away - reach <= away.min(axis=1, keepdims=True))
    found, feature = closest(p[point], corner[triangle])
    between = p[point] - found
    square = np.einsum("ij,ij->i", between, between)
    order = np.lexsort((square, point))  # the pairs of each point with the nearest triangle first
    best = order[np.searchsorted(point, np.arange(len(p)))]
    return found[best], triangle[best], feature[best]


def closest(p: FloatArray, corner: FloatArray) -> tuple[FloatArray, IntArray]:
    """Nearest point of triangles and where it lies: corner 0-2, edge 3-5 (ab, bc, ca), face 6 (Ericson, 2005).

    Args:
        p: Points [m], shape (..., 3).
        corner: Corners of a triangle for each [m], shape (..., 3, 3).
    """
    a, b, c = corner[..., 0, :], corner[..., 1, :], corner[..., 2, :]

    def dot(u: FloatArray, v: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("...i,...i->...", u, v))

    ab, ac = b - a, c - a
    d1, d2 = dot(ab, p - a), dot(ac, p - a)
    d3, d4 = dot(ab, p - b), dot(ac, p - b)
    d5, d6 = dot(ab, p - c), dot(ac, p - c)
    wa, wb, wc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    at_corner = [(d1 <= 0) & (d2 <= 0), (d3 >= 0) & (d4 <= d3), (d6 >= 0) & (d5 <= d6)]
    on_edge = [
        (wc <= 0) & (d1 >= 0) & (d3 <= 0),
        (wa <= 0) & (d4 - d3 >= 0) & (d5 - d6 >= 0),
        (wb <= 0) & (d2 >= 0) & (d6 <= 0),
    ]
    feature = np.select([*at_corner, *on_edge], list(range(6)), 6).astype(np.int32)
    with np.errstate(divide="ignore", invalid="ignore"):
        t_ab, t_bc, t_ca = d1 / (d1 - d3), (d4 - d3) / ((d4 - d3) + (d5 - d6)), d2 / (d2 - d6)
        v, w = wb / (wa + wb + wc), wc / (wa + wb + wc)
    zero, one = np.zeros_like(d1), np.ones_like(d1)
    v = np.choose(feature, [zero, one, zero, t_ab, 1.0 - t_bc, zero, v])
    w = np.choose(feature, [zero, zero, one, zero, t_bc, t_ca, w])
    return a + v[..., None] * ab + w[..., None] * ac, feature
