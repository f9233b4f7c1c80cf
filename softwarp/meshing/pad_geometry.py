"""The pad: a hollow silicone frustum whose wide, thin front bulges when its chamber is inflated.

Frame: the front lies in z = 0 and faces +z, the body reaches back to z = -28 mm, the axis is x = y = 0. Dimensions [m]
measured on the gripper mesh of SofaGym's CatchTheObject scene; source and comparison: assets/pad/README.md.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softwarp.meshing.resolutions import check_name
from softwarp.meshing.tets import FloatArray, IntArray, TetMesh, orient

DEPTH = 0.028  # from front to back
FRONT_HALF, BACK_HALF = 0.035, 0.021  # half widths of the outer faces
FRONT_WALL, BACK_WALL = 0.0035, 0.007  # thickness in front of and behind the chamber
CHAMBER_FRONT_HALF, CHAMBER_BACK_HALF = 0.028, 0.014  # half widths of the chamber
# Cells across, cells deep, layers of the wall, and the power that draws lines of nodes towards the rim: with it the
# coarse mesh is as stiff as the published one. Linear tetrahedra of its size are far too stiff in bending.
DETAILS = {"coarse": (4, 1, 1, 0.84), "medium": (8, 3, 1, 1.0), "fine": (12, 4, 2, 1.0)}

Node = tuple[int, int, int]


@dataclass(frozen=True)
class PadMesh:
    """A pad and its chamber.

    Attributes:
        mesh: The solid.
        cavity_vertices: Vertices of the chamber's wall [m], each one a node of the mesh, shape (v, 3).
        cavity_triangles: Its triangles, outward from the air, shape (t, 3), indices of the vertices.
    """

    mesh: TetMesh
    cavity_vertices: FloatArray
    cavity_triangles: IntArray


def pad(resolution: str = "coarse") -> PadMesh:
    """The hollow frustum, front at z = 0 [m].

    The wall is the surface of a box, cut into n x n cells across and m deep, drawn out between the outer frustum and
    the chamber. A quarter turn about z and the mirrors x = 0, y = 0 and x = y map the mesh to itself, tetrahedra
    included.

    Args:
        resolution: "coarse" (100 nodes, nearest to the published mesh), "medium" (452) or "fine" (1446).

    Raises:
        MeshError: If the name is unknown.
    """
    check_name(resolution, DETAILS, "pad")
    across, deep, layers, power = DETAILS[resolution]
    box = itertools.product(range(across + 1), range(across + 1), range(deep + 1))
    grid = [node for node in box if _is_on_surface(node, across, deep)]
    number = {node: i for i, node in enumerate(grid)}
    triangles = np.array([[number[node] for node in corner] for corner in _triangles(across, deep)])
    skin, wall = (_frustum(grid, across, deep, power, outer=outer) for outer in (True, False))
    nodes = np.concatenate([skin + (wall - skin) * (k / layers) for k in range(layers + 1)])
    # Prisms are cut alike on both sides of a common face, and symmetrically, if corners are ranked by symmetric keys.
    rank = np.array([_rank(node, across) for node in grid])
    tets = np.concatenate([_cut_prisms(triangles, rank, k * len(grid), len(grid)) for k in range(layers)])
    mesh = TetMesh(nodes, orient(nodes, tets), f"pad {resolution}")
    return PadMesh(mesh, wall, triangles.astype(np.int32))


def _is_on_surface(node: Node, across: int, deep: int) -> bool:
    i, j, k = node
    return i in (0, across) or j in (0, across) or k in (0, deep)


def _frustum(grid: list[Node], across: int, deep: int, power: float, *, outer: bool) -> FloatArray:
    """Positions [m] of the surface grid on the outer frustum or on the chamber's wall."""
    ijk = np.array(grid, dtype=np.float64)
    front, back = (0.0, -DEPTH) if outer else (-FRONT_WALL, BACK_WALL - DEPTH)
    wide, narrow = (FRONT_HALF, BACK_HALF) if outer else (CHAMBER_FRONT_HALF, CHAMBER_BACK_HALF)
    depth = ijk[:, 2:] / deep
    place = 2.0 * ijk[:, :2] / across - 1.0
    sideways = np.sign(place) * np.abs(place) ** power * (wide + (narrow - wide) * depth)
    return np.concatenate([sideways, front + (back - front) * depth], axis=1)


def _triangles(across: int, deep: int) -> list[tuple[Node, Node, Node]]:
    """Outward triangles of the box whose cells are counted from the front (k = 0) back; z decreases with k."""
    cells = range(across)
    quads = [((i, j, 0), (i + 1, j, 0), (i + 1, j + 1, 0), (i, j + 1, 0)) for i in cells for j in cells]
    quads += [tuple((i, j, deep) for i, j, _ in reversed(quad)) for quad in tuple(quads)]  # type: ignore[misc]
    for i, k in itertools.product(cells, range(deep)):
        side = [(i, k), (i, k + 1), (i + 1, k + 1), (i + 1, k)]
        quads.append(tuple((a, 0, b) for a, b in side))  # type: ignore[arg-type]
        quads.append(tuple((a, across, b) for a, b in reversed(side)))  # type: ignore[arg-type]
        quads.append(tuple((0, a, b) for a, b in reversed(side)))  # type: ignore[arg-type]
        quads.append(tuple((across, a, b) for a, b in side))  # type: ignore[arg-type]
    result = []
    for quad in quads:
        # The diagonal starts at the corner nearest to the axis and the front, so that mirrors keep it.
        first = min(range(4), key=lambda c: (_radius(quad[c], across), quad[c][2]))
        a, b, c, d = (quad[(first + n) % 4] for n in range(4))
        result += [(a, b, c), (a, c, d)]
    return result


def _radius(node: Node, across: int) -> int:
    return abs(2 * node[0] - across) + abs(2 * node[1] - across)


def _rank(node: Node, across: int) -> int:
    """A number that symmetric nodes share and neighbours do not."""
    u, v = sorted((abs(2 * node[0] - across), abs(2 * node[1] - across)))
    return (node[2] * (across + 1) + v) * (across + 1) + u


def _cut_prisms(triangles: NDArray[np.int64], rank: NDArray[np.int64], start: int, stride: int) -> IntArray:
    """Three tetrahedra between each triangle of a layer, whose nodes begin at ``start``, and the next layer's."""
    order = np.argsort(rank[triangles], axis=1)
    a, b, c = (start + np.take_along_axis(triangles, order, axis=1)).T
    tets = ((a, b, c, c + stride), (a, b, b + stride, c + stride), (a, a + stride, b + stride, c + stride))
    return np.stack([np.stack(tet, axis=1) for tet in tets], axis=1).reshape(-1, 4).astype(np.int32)
