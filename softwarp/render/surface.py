"""How a triangle surface is shaded: smooth where it is round, with an edge where faces meet at an angle."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Ints = NDArray[np.int32]


def smooth_corners(triangles: Ints, rest: NDArray[np.float64], crease: ArrayLike) -> tuple[Ints, Ints, Ints]:
    """Group the triangles' corners into shared normals.

    Two corners at a vertex share a normal if a path of neighbouring faces joins them that never turns by more than
    ``crease`` at an edge in the rest shape.

    Args:
        triangles: Vertex indices, shape (tri, 3).
        rest: Rest positions [m], shape (vertex, 3).
        crease: Angle between the normals of neighbouring faces that makes an edge [degrees], one or one per triangle.

    Returns:
        tri_normal: Normal of each corner, shape (tri, 3).
        normal_tri_start: Normal n averages the triangles normal_tri[start[n]:start[n + 1]], shape (normal + 1,).
        normal_tri: Those triangles, shape (3 tri,).
    """
    tri = np.asarray(triangles, dtype=np.int64)
    a, b = _soft_neighbours(tri, rest, crease)
    group = np.arange(3 * len(tri))
    while True:  # every corner takes the lowest number it is linked to, until nothing changes
        lowest = group.copy()
        np.minimum.at(lowest, a, group[b])
        np.minimum.at(lowest, b, group[a])
        lowest = lowest[lowest]
        if np.array_equal(lowest, group):
            break
        group = lowest
    _, normal = np.unique(group, return_inverse=True)
    order = np.argsort(normal, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(normal))])
    return normal.reshape(-1, 3).astype(np.int32), start.astype(np.int32), (order // 3).astype(np.int32)


def _soft_neighbours(
    tri: NDArray[np.int64], rest: NDArray[np.float64], crease: ArrayLike
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of corners, numbered 3 tri + corner, at one vertex and in faces that share an edge without a crease."""
    corner = np.arange(3 * len(tri)).reshape(-1, 3)
    normal = np.cross(rest[tri[:, 1]] - rest[tri[:, 0]], rest[tri[:, 2]] - rest[tri[:, 0]])
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    tail, head = tri.ravel(), np.roll(tri, -1, axis=1).ravel()
    tail_corner, head_corner = corner.ravel(), np.roll(corner, -1, axis=1).ravel()
    # A half edge and its opposite, found by sorting both under the undirected edge's number.
    vertex_count = int(tri.max()) + 1
    forward = tail < head
    key = np.where(forward, tail * vertex_count + head, head * vertex_count + tail)
    order = np.lexsort((forward, key))
    k = np.flatnonzero((key[order][:-1] == key[order][1:]) & (forward[order][:-1] != forward[order][1:]))
    one, other = order[k], order[k + 1]
    limit = np.cos(np.radians(np.broadcast_to(crease, len(tri))))
    soft = np.einsum("ij,ij->i", normal[one // 3], normal[other // 3]) > limit[one // 3]
    one, other = one[soft], other[soft]
    return (
        np.concatenate([tail_corner[one], head_corner[one]]),
        np.concatenate([head_corner[other], tail_corner[other]]),
    )
