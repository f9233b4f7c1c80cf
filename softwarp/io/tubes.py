"""Tubes around rods: the curve that a rod's segments describe, swept with its radius."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp.shapes.base import rotation_matrix

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]

_SMALL = 1e-2  # rad; below it series of two terms are exact to 1e-11


def rod_curve(positions: ArrayLike, quaternions: ArrayLike, fine: int) -> tuple[Floats, Floats]:
    """Points along rods between their nodes, on curves of constant strain: the shape that the simulator means.

    The frame at part s of a segment is that of its first node moved by exp(s xi), where exp(xi) leads to the second
    one (docs/theory/rod.md).

    Args:
        positions: Nodes of one rod [m], shape (..., n, 3).
        quaternions: Orientations x y z w of their sections, shape (..., n, 4).
        fine: Pieces per segment.

    Returns:
        Points [m], shape (..., m, 3) with m = (n - 1) fine + 1, and axes d1, d2, d3 as columns, shape (..., m, 3, 3).
    """
    x, q = np.asarray(positions, dtype=np.float64), np.asarray(quaternions, dtype=np.float64)
    R = rotation_matrix(q / np.maximum(np.linalg.norm(q, axis=-1, keepdims=True), np.finfo(np.float64).tiny))
    first, inverse = R[..., :-1, :, :], np.swapaxes(R[..., :-1, :, :], -1, -2)
    k = _rotation_vector(inverse @ R[..., 1:, :, :])
    d = np.einsum("...ij,...j->...i", inverse, x[..., 1:, :] - x[..., :-1, :])
    angle = np.linalg.norm(k, axis=-1, keepdims=True)
    u = d - 0.5 * np.cross(k, d) + _inverse_factor(angle) * np.cross(k, np.cross(k, d))
    points, axes = [x[..., :1, :]], [R[..., :1, :, :]]
    s = (np.arange(1, fine + 1) / fine)[:, None]
    k, u, angle = k[..., None, :], u[..., None, :], angle[..., None, :]
    way = s * u + _bend(angle, s) * np.cross(k, u) + _lag(angle, s) * np.cross(k, np.cross(k, u))
    turn = _exponential(s * k)
    inner = x[..., :-1, None, :] + np.einsum("...ij,...kj->...ki", first, way)
    frames = first[..., None, :, :] @ turn
    points.append(inner.reshape(*inner.shape[:-3], -1, 3))
    axes.append(frames.reshape(*frames.shape[:-4], -1, 3, 3))
    return np.concatenate(points, axis=-2), np.concatenate(axes, axis=-3)


def sweep(positions: ArrayLike, quaternions: ArrayLike, radius: ArrayLike, sides: int, fine: int) -> Floats:
    """Vertices of the tube around one rod, ring after ring, then the middles of its two ends.

    Args:
        positions: Nodes [m], shape (..., n, 3).
        quaternions: Orientations x y z w of their sections, shape (..., n, 4).
        radius: Radius at the nodes [m], shape (n,).
        sides: Corners of a ring, the first one along d1.
        fine: Pieces per segment.

    Returns:
        Vertices [m], shape (..., ((n - 1) fine + 1) sides + 2, 3).
    """
    points, axes = rod_curve(positions, quaternions, fine)
    node = np.arange(len(np.atleast_1d(radius)))
    r = np.interp(np.arange(points.shape[-2]) / fine, node, np.atleast_1d(radius))
    angle = 2.0 * np.pi * np.arange(sides) / sides
    around = np.stack([np.cos(angle), np.sin(angle)])  # (2, sides)
    ring = np.einsum("...mic,cs,m->...msi", axes[..., :2], around, r) + points[..., None, :]
    ends = points[..., [0, -1], :]
    return np.concatenate([ring.reshape(*ring.shape[:-3], -1, 3), ends], axis=-2)


def tube_triangles(nodes: int, sides: int, fine: int) -> Ints:
    """Outward triangles of a tube's vertices as ``sweep`` orders them, shape (t, 3)."""
    rings = (nodes - 1) * fine + 1
    i = np.arange(sides)
    j = (i + 1) % sides
    bottom, top, last = rings * sides, rings * sides + 1, (rings - 1) * sides
    parts = [
        np.column_stack([np.full(sides, bottom), j, i]),
        np.column_stack([last + i, last + j, np.full(sides, top)]),
    ]
    for a in range(0, last, sides):
        b = a + sides
        parts += [np.column_stack([a + i, a + j, b + j]), np.column_stack([a + i, b + j, b + i])]
    return np.concatenate(parts).astype(np.int32)


def stripe(nodes: int, sides: int, fine: int) -> NDArray[np.bool_]:
    """Vertices of two stripes, along d1 and opposite, that show a tube's twist from all sides, shape (v,)."""
    rings = (nodes - 1) * fine + 1
    away = np.abs((2 * np.arange(sides) + sides // 2) % sides - sides // 2)  # from d1 or -d1, in half steps
    return np.concatenate([np.tile(away * 6 <= sides, rings), np.zeros(2, dtype=bool)])


def pieces_per_segment(segments: int) -> int:
    """Pieces that make a rod of so many segments look smooth."""
    return int(np.clip(-(-48 // max(segments, 1)), 1, 12))


def _rotation_vector(R: Floats) -> Floats:
    """Rotation vectors of matrices, shape (..., 3), for turns below pi."""
    axial = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1)
    sine = 0.5 * np.linalg.norm(axial, axis=-1, keepdims=True)
    cosine = 0.5 * (np.trace(R, axis1=-2, axis2=-1)[..., None] - 1.0)
    angle = np.arctan2(sine, cosine)
    return np.asarray(np.where(sine > 1e-9, angle / np.maximum(sine, 1e-300), 1.0) * 0.5 * axial)


def _exponential(k: Floats) -> Floats:
    """Rotation matrices of rotation vectors."""
    angle = np.linalg.norm(k, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(k, -1, 0)
    zero = np.zeros_like(x)
    K = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*x.shape, 3, 3)
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * K + _bend(angle, 1.0) * (K @ K))


def _bend(angle: Floats, s: Floats | float) -> Floats:
    """(1 - cos(s angle)) / angle^2."""
    return np.asarray(0.5 * s**2 * np.sinc(0.5 * s * angle / np.pi) ** 2)


def _lag(angle: Floats, s: Floats | float) -> Floats:
    """(s angle - sin(s angle)) / angle^3."""
    t = np.maximum(angle, _SMALL)
    series = s**3 / 6.0 - s**5 * angle**2 / 120.0
    return np.asarray(np.where(angle > _SMALL, (s * t - np.sin(s * t)) / t**3, series))


def _inverse_factor(angle: Floats) -> Floats:
    """(1 - (angle / 2) cot(angle / 2)) / angle^2."""
    t = np.maximum(angle, _SMALL)
    return np.asarray(np.where(angle > _SMALL, (1.0 - 0.5 * t / np.tan(0.5 * t)) / t**2, 1.0 / 12.0 + angle**2 / 720.0))
