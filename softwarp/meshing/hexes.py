"""Hexahedral meshes: boxes, checks, and the tetrahedra that carry points of them. Lengths in metres.

A hexahedron lists its corners as VTK does: around its lower face, counter-clockwise from above, then those above them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp.meshing.tets import MeshError, TetMesh, _check_arrays, _check_members, bounding_box, box, check_tets

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int32]

CORNERS = 8
# Natural coordinates of the corners
SIGNS = np.array([[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]])
# Corners of the six faces, each counter-clockwise from outside
FACES = np.array([[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])
FLAT = 1e-6  # least Jacobian at a corner per volume of the cube over the longest edge


@dataclass(frozen=True, eq=False)
class HexMesh:
    """A solid of hexahedra, checked on construction.

    Args:
        nodes: Positions [m], shape (node, 3), float64.
        hexes: Corners in the order of VTK, shape (hex, 8), int32.
        name: What messages call it.

    Raises:
        MeshError: If ``check_hexes`` refuses the arrays.
    """

    nodes: FloatArray
    hexes: IntArray
    name: str = "mesh"

    def __post_init__(self) -> None:
        check_hexes(self.nodes, self.hexes, name=self.name)
        object.__setattr__(self, "nodes", np.ascontiguousarray(self.nodes, dtype=np.float64))
        object.__setattr__(self, "hexes", np.ascontiguousarray(self.hexes, dtype=np.int32))

    @property
    def volume(self) -> float:
        """Volume of the solid [m^3]."""
        return float(node_volumes(self.nodes, self.hexes).sum())

    @property
    def bounds(self) -> FloatArray:
        """Lowest and highest corner of the bounding box [m], shape (2, 3)."""
        return bounding_box(self.nodes)

    def linear(self) -> TetMesh:
        """The same solid as linear tetrahedra with the same nodes, six a hexahedron."""
        return TetMesh(self.nodes, split(self.hexes), self.name)


def brick(size: Sequence[float], cells: Sequence[int], *, name: str = "brick") -> HexMesh:
    """A box from the origin to ``size`` of equal hexahedra, with the nodes of ``box``.

    Args:
        size: Edge lengths (Lx, Ly, Lz) [m].
        cells: Cells along each axis (nx, ny, nz).
        name: What messages call the mesh.

    Raises:
        MeshError: If a length or a count is not positive.
    """
    nodes = box(size, cells, name=name).nodes
    nx, ny, nz = (int(n) for n in cells)
    k, j, i = np.meshgrid(np.arange(nz), np.arange(ny), np.arange(nx), indexing="ij")
    lowest = (i + (nx + 1) * (j + (ny + 1) * k)).reshape(-1, 1)
    step = (SIGNS + 1) // 2 @ np.array([1, nx + 1, (nx + 1) * (ny + 1)])
    return HexMesh(nodes, (lowest + step).astype(np.int32), name)


def check_hexes(nodes: ArrayLike, hexes: ArrayLike, *, name: str = "mesh") -> None:
    """Refuse hexahedra on which a simulation would fail or lie.

    Args:
        nodes: Positions [m], shape (node, 3).
        hexes: Corners in the order of VTK, shape (hex, 8), integer.
        name: What messages call the mesh.

    Raises:
        MeshError: As ``check_tets``, and for hexahedra whose edges make no positive volume at one of the corners.
    """
    x, h = _check_arrays(nodes, hexes, CORNERS, "hexahedron", name)
    _check_members(x, h, "hexahedron", "hexes", name)
    corner = x[h]
    longest = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).max(axis=1)
    least = np.linalg.det(corner_jacobians(corner)).min(axis=1)
    broken = np.flatnonzero(least < FLAT * (0.5 * longest) ** 3)
    if broken.size:
        raise MeshError(
            f"mesh {name!r}: {broken.size} of {len(h)} hexahedra are flat or inside out at a corner (first: "
            f"{broken[0]}, corners {h[broken[0]].tolist()}); list the corners as VTK does, the lower face counter-"
            "clockwise from above and then the upper one, or remesh"
        )
    check_tets(x, split(h), name=name)


def corner_jacobians(x: FloatArray) -> FloatArray:
    """dx/dxi [m] at the eight corners of hexahedra with corners ``x`` (hex, 8, 3); shape (hex, 8, 3, 3)."""
    return np.stack([x.transpose(0, 2, 1) @ shape_gradients(point) for point in SIGNS.astype(np.float64)], axis=1)


def shape_gradients(point: FloatArray) -> FloatArray:
    """Natural gradients of the eight shape functions (1 + s . xi) ... / 8 at one point, shape (8, 3)."""
    along = 1.0 + SIGNS * point
    x, y, z = along.T
    return np.asarray(SIGNS * np.stack([y * z, x * z, x * y], axis=1) / 8.0)


def node_volumes(nodes: FloatArray, hexes: IntArray) -> FloatArray:
    """Integrals of the shape functions over every hexahedron [m^3], shape (hex, 8)."""
    x, total = nodes[hexes], np.zeros(hexes.shape)
    for point in SIGNS / np.sqrt(3.0):
        shape = (1.0 + SIGNS * point).prod(axis=1) / 8.0
        total += np.linalg.det(x.transpose(0, 2, 1) @ shape_gradients(point))[:, None] * shape
    return total


def split(hexes: IntArray) -> IntArray:
    """Six tetrahedra between the corners of every hexahedron, (6 hex, 4), that meet those of its neighbours.

    They join the corner of the lowest number to the triangles of the three faces that it is not on, and every face is
    cut through the lowest of its corners. Reference: Dompierre et al. (1999), How to subdivide pyramids, prisms and
    hexahedra into tetrahedra.
    """
    hexes = np.asarray(hexes)
    row = np.arange(len(hexes))
    found = np.empty((len(hexes), 6, 4), dtype=np.int32)
    apex = hexes.argmin(axis=1)
    for corner in range(CORNERS):
        chosen = row[apex == corner]
        for number, face in enumerate(face for face in FACES if corner not in face):
            quad = hexes[chosen][:, face]
            first = quad.argmin(axis=1)
            turned = quad[np.arange(len(chosen))[:, None], (first[:, None] + np.arange(4)) % 4]
            for half in range(2):
                a, b, c = turned[:, 0], turned[:, 1 + half], turned[:, 2 + half]
                found[chosen, 2 * number + half] = np.stack([a, c, b, hexes[chosen, corner]], axis=1)
    return found.reshape(-1, 4)


def quad_shares(nodes: FloatArray, hexes: IntArray, triangles: IntArray) -> tuple[IntArray, FloatArray]:
    """Integrals of shape functions over halves of faces, as ``split`` cuts them, taken for halves of parallelograms.

    Args:
        nodes: Positions [m], (node, 3).
        hexes: Corners, (hex, 8).
        triangles: Halves of faces by their corners, (tri, 3).

    Returns:
        Nodes in ascending order, (n,), and their integrals [m^2], (n,): of a half the corner across the cut gets 5/12
        of its area, those on the cut a quarter each and the fourth corner of the face the rest.
    """
    quads = np.asarray(hexes)[:, FACES].reshape(-1, 4)
    first = quads.argmin(axis=1)[:, None]
    turned = quads[np.arange(len(quads))[:, None], (first + np.arange(4)) % 4]  # the cut joins numbers 0 and 2
    halves = np.concatenate([turned, turned[:, [2, 3, 0, 1]]])  # numbers 0, 1, 2 are a half's, and 3 is the fourth
    number = {tuple(half): place for place, half in enumerate(np.sort(halves[:, :3], axis=1).tolist())}
    held = halves[[number[tuple(half)] for half in np.sort(triangles, axis=1).tolist()]]
    a, b, c = (nodes[held[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    node, place = np.unique(held, return_inverse=True)
    value = area[:, None] * (np.array([3.0, 5.0, 3.0, 1.0]) / 12.0)
    return node.astype(np.int32), np.bincount(place.ravel(), value.ravel()).astype(np.float64)
