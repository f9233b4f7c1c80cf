"""Sharp edges and corners of a surface, which a lattice cuts off: nodes beside them are moved onto them."""

from __future__ import annotations

import numpy as np

from softwarp.meshing.surfaces import surface_edges
from softwarp.meshing.tets import FloatArray, IntArray, boundary, min_dihedral, tet_volumes

SHARP = 35.0  # degree between the normals of two triangles
REACH = 1.0  # cells within which a node moves
LEAST = 12.0  # degree; no move may leave a smaller angle
SPACING = 0.125  # cells between the points by which edges are searched
ROUNDS = 100


def sharpen(
    nodes: FloatArray, tets: IntArray, vertices: FloatArray, triangles: IntArray, cell: FloatArray
) -> FloatArray:
    """Move nodes of the boundary onto sharp edges and corners; moves that would spoil an element are taken back.

    Args:
        nodes: Positions [m], shape (node, 3).
        tets: Corners of positive volume, shape (tet, 4).
        vertices: Of the surface [m], shape (v, 3).
        triangles: Its corners, outward, shape (t, 3).
        cell: Edges of a cell of the lattice [m], shape (3,).

    Returns:
        New positions [m], shape (node, 3).
    """
    ends, corners = _features(vertices, triangles)
    if not len(ends):
        return nodes
    skin = np.unique(boundary(tets, "mesh")[0])
    size = float(cell.min())
    result = nodes
    for points in (corners, _along(ends, SPACING * size)):
        if len(points):
            result = _snap(result, tets, skin, points, REACH * size)
    return result


def _features(vertices: FloatArray, triangles: IntArray) -> tuple[FloatArray, FloatArray]:
    """Sharp edges (edge, 2, 3) and the vertices where they end, branch or turn (corner, 3)."""
    ends, opposite = surface_edges(triangles)
    x, (i, j), (k, other) = vertices, ends.T, opposite.T
    first = np.cross(x[j] - x[i], x[k] - x[i])
    second = np.cross(x[i] - x[j], x[other] - x[j])
    sine, cosine = np.linalg.norm(np.cross(first, second), axis=1), np.einsum("ij,ij->i", first, second)
    sharp = ends[np.degrees(np.arctan2(sine, cosine)) > SHARP]
    if not len(sharp):
        return np.zeros((0, 2, 3)), np.zeros((0, 3))
    way = x[sharp[:, 1]] - x[sharp[:, 0]]
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    count = np.bincount(sharp.reshape(-1), minlength=len(x))
    total = np.zeros_like(x)
    np.add.at(total, sharp[:, 0], way)
    np.add.at(total, sharp[:, 1], -way)
    turns = np.linalg.norm(total, axis=1) > 2.0 * np.sin(np.radians(0.5 * SHARP))  # of two edges in line it vanishes
    is_corner = (count > 0) & ((count != 2) | turns)
    return x[sharp], x[is_corner]


def _along(ends: FloatArray, spacing: float) -> FloatArray:
    """Points on edges, at most this far apart [m]."""
    count = np.maximum(np.ceil(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / spacing).astype(int), 1)
    edge = np.repeat(np.arange(len(ends)), count + 1)
    rank = np.arange(len(edge)) - np.repeat(np.cumsum(count + 1) - count - 1, count + 1)
    part = (rank / count[edge])[:, None]
    return np.asarray(ends[edge, 0] + part * (ends[edge, 1] - ends[edge, 0]))


def _snap(nodes: FloatArray, tets: IntArray, skin: IntArray, points: FloatArray, reach: float) -> FloatArray:
    """Move nodes of the skin to points within reach, each point's nearest node, as far as elements allow.

    Of an element that would be spoilt the node with the longest way stays where it was, until all are good.
    """
    from scipy.spatial import cKDTree

    target = nodes.copy()
    away, index = cKDTree(points).query(nodes[skin])
    near = np.flatnonzero((away < reach) & (away > 1e-9 * reach))
    # No two nodes may meet: of those that would move to one point, the nearest does.
    order = near[np.argsort(away[near])]
    chosen = order[np.unique(index[order], return_index=True)[1]]
    target[skin[chosen]] = points[index[chosen]]
    moved = np.zeros(len(nodes), dtype=bool)
    moved[skin[chosen]] = True
    around = np.flatnonzero(moved[tets].any(axis=1))
    least = np.minimum(min_dihedral(nodes, tets[around]), LEAST)
    way = np.linalg.norm(target - nodes, axis=1)
    for _ in range(ROUNDS):
        now = np.where(moved[:, None], target, nodes)
        with np.errstate(invalid="ignore", divide="ignore"):
            angle = min_dihedral(now, tets[around])
        bad = (tet_volumes(now, tets[around]) <= 0.0) | ~(angle >= least)
        if not bad.any():
            return np.asarray(now)
        corners = tets[around[bad]]
        longest = np.argmax(np.where(moved[corners], way[corners], -1.0), axis=1)
        moved[corners[np.arange(len(corners)), longest]] = False
    return nodes
