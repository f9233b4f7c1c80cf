"""Points embedded in a tetrahedral mesh by barycentric weights: cables, markers, attachments."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp import checks
from softwarp.meshing.tets import FloatArray, IntArray, MeshError, boundary, bounding_box
from softwarp.remembered import Remembered

_before: Remembered[tuple[IntArray, FloatArray]] = Remembered(64)
ROUNDING = 1e-9  # negative weight that still counts as inside: rounding on a face shared by two tetrahedra


def embed(
    nodes: ArrayLike,
    tets: ArrayLike,
    points: ArrayLike,
    *,
    name: str = "points",
    tolerance: float | None = None,
    snap: float = 0.0,
) -> tuple[IntArray, FloatArray]:
    """Tie points to the tetrahedra that hold them: ``point = weights . nodes[tets[tet]]``.

    A point on a face or an edge takes the tetrahedron with the largest smallest weight. A point outside the mesh keeps
    its place: it is carried by the nearest tetrahedron with weights of which some are negative.

    Args:
        nodes: Positions [m], shape (node, 3).
        tets: Corners, shape (tet, 4), positive volume.
        points: Positions [m], shape (point, 3).
        name: What the points are, for messages, e.g. "cable 'north'".
        tolerance: Distance outside the mesh [m] that counts as rounding; by default 1e-6 of the mesh diagonal.
        snap: Distance outside the mesh [m] that is accepted on purpose, e.g. the sagitta of a coarse round surface.

    Returns:
        Tetrahedron of each point, shape (point,), and its weights, shape (point, 4), which sum to one.

    Raises:
        MeshError: If a point is not finite or lies farther outside; the message gives point and distance.
    """
    x, t = np.asarray(nodes, dtype=np.float64), np.asarray(tets)
    p = np.atleast_2d(checks.as_array(points))
    if p.dtype.kind not in "fiu":
        raise MeshError(f"{name}: points must be numbers [m], got {p.dtype} {p.shape}")
    p = p.astype(np.float64)
    if p.ndim != 2 or p.shape[1] != 3:
        raise MeshError(f"{name}: points must have shape (point, 3) [m], got {p.shape}")
    broken = np.flatnonzero(~np.isfinite(p).all(axis=1))
    if broken.size:
        raise MeshError(f"{name}: point {broken[0]} is not finite: {p[broken[0]].tolist()}; give a position in metres")
    low, high = bounding_box(x)
    allowed = max(float(np.linalg.norm(high - low)) * 1e-6 if tolerance is None else tolerance, snap)
    index, weights = _before(lambda: _embed(x, t, p, allowed, name), x, t, p, allowed)
    return index.copy(), weights.copy()


def _embed(x: FloatArray, t: NDArray[Any], p: FloatArray, allowed: float, name: str) -> tuple[IntArray, FloatArray]:
    index, weights = np.zeros(len(p), dtype=np.int32), np.full((len(p), 4), -1.0)
    if len(p):
        point, near = _boxes_with(x[t], p, allowed)
        held, index_held, weights_held = _deepest(x[t], near, p, point)
        index[held], weights[held] = index_held, weights_held
    outside = np.flatnonzero(weights.min(axis=1) < -ROUNDING).tolist()
    if outside:
        _attach_outside(x, t, p, outside, index, weights, allowed, name)
    return index, weights


def _boxes_with(corner: FloatArray, points: FloatArray, margin: float) -> tuple[NDArray[Any], NDArray[Any]]:
    """Points and tetrahedra in whose boxes, wider by a margin on all sides, they lie, as pairs."""
    from scipy.spatial import cKDTree  # 0.2 s

    lowest, highest = corner.min(axis=1) - margin, corner.max(axis=1) + margin
    middle, reach = 0.5 * (lowest + highest), 0.5 * (highest - lowest).max(axis=1)
    found = cKDTree(points).query_ball_point(middle, reach * (1.0 + 1e-9), p=np.inf)  # cubes that hold the boxes
    tet = np.repeat(np.arange(len(corner)), [len(some) for some in found])
    point = np.concatenate([np.empty(0, dtype=np.int64), *filter(None, found)]).astype(np.int64)
    within = ((lowest[tet] <= points[point]) & (points[point] <= highest[tet])).all(axis=1)
    return point[within], tet[within]


def _deepest(
    corner: FloatArray, candidates: NDArray[Any], points: FloatArray, point: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any], FloatArray]:
    """Of every point's candidates the one with the largest smallest weight: points, tetrahedra, weights."""
    x = corner[candidates]
    edges = np.swapaxes(x[:, 1:] - x[:, :1], 1, 2)  # columns b - a, c - a, d - a
    inner = np.linalg.solve(edges, (points[point] - x[:, 0])[:, :, None])[:, :, 0]
    weights = np.concatenate([1.0 - inner.sum(axis=1, keepdims=True), inner], axis=1)
    order = np.lexsort((candidates, -weights.min(axis=1), point))
    held, first = np.unique(point[order], return_index=True)
    best = order[first]
    return held, candidates[best], weights[best]


def _attach_outside(
    x: FloatArray,
    t: NDArray[Any],
    p: FloatArray,
    outside: list[int],
    index: IntArray,
    weights: FloatArray,
    allowed: float,
    name: str,
) -> None:
    """Give points outside the mesh the tetrahedron behind the nearest triangle, or refuse them."""
    triangles, owner = boundary(t, name)
    refused = []
    for i in outside:
        distance = _triangle_distance(p[i], x[triangles])
        nearest = distance.min()
        if nearest > allowed:
            refused.append((i, nearest))
            continue
        # An edge or a corner is equally near to several triangles: of their tetrahedra, take the one least outside.
        tied = np.unique(owner[distance <= nearest * (1.0 + 1e-9) + 1e-15])
        at, index[at], weights[at] = _deepest(x[t], tied, p, np.full(tied.size, i))
    if refused:
        low, high = bounding_box(x)
        i, nearest = max(refused, key=lambda entry: entry[1])
        others = f"; {len(refused)} of {len(p)} points lie outside, this one farthest" if len(refused) > 1 else ""
        raise MeshError(
            f"{name}: point {i} at {_text(p[i])} m lies {nearest:.4g} m outside the mesh, more than the "
            f"{allowed:.3g} m allowed{others}. Move it inside, check the unit and the placement of the mesh (box "
            f"{_text(low)} to {_text(high)} m), or carry it along with snap={nearest * 1.01:.3g}"
        )


def _triangle_distance(point: FloatArray, corner: FloatArray) -> FloatArray:
    """Distance [m] from one point to triangles given by their corners (tri, 3, 3); shape (tri,)."""
    start = corner
    edge = np.roll(corner, -1, axis=1) - start
    offset = point - start
    along = np.einsum("ijk,ijk->ij", offset, edge) / np.einsum("ijk,ijk->ij", edge, edge)
    to_edges = np.linalg.norm(offset - np.clip(along, 0.0, 1.0)[:, :, None] * edge, axis=2).min(axis=1)
    normal = np.cross(edge[:, 0], edge[:, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    above = (np.einsum("ijk,ijk->ij", np.cross(edge, offset), normal[:, None]) >= 0.0).all(axis=1)
    to_plane = np.abs(np.einsum("ij,ij->i", offset[:, 0], normal))
    return np.asarray(np.where(above, to_plane, to_edges))


def _text(x: FloatArray) -> str:
    return "(" + ", ".join(f"{value:.6g}" for value in x) + ")"
