"""The gripper's finger with cavities in hexahedra, few enough to be fast, with moduli that make up for their size.

The grid is that of ``finger_geometry`` without the nodes in the plane z = 0: one cell across the wall between the two
cavities of a joint. Hexahedra of this size bend too little where walls fold. ``STIFFNESS`` has factors of the modulus
with which the finger moves as a converged one does; assets/gripper/coarsen.py finds them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softwarp.meshing import finger_geometry as geometry
from softwarp.meshing.hexes import SIGNS, HexMesh
from softwarp.meshing.surfaces import voids
from softwarp.meshing.tets import FloatArray, IntArray

NU = 0.48  # Poisson's ratio that the factors are fitted for
SOLID = 0.629  # of the phalanges
# Of a joint's cells, by how far from its middle they lie (three slabs), by what they are part of across (the wall
# between cavities, above or below a cavity, beside it) and by row (back, beside the cavities, palm). 1 for the air.
STIFFNESS = np.array(
    [
        [[1.851, 0.177, 0.263], [0.191, 1, 0.163], [1.005, 1.179, 1.662]],
        [[1.26, 0.925, 0.597], [1.64, 1, 1.155], [0.379, 0.306, 0.827]],
        [[1.607, 0.859, 0.627], [0.855, 1, 0.324], [0.336, 0.291, 0.296]],
    ]
)

_MIDDLE = 3  # line of nodes of the tetrahedra's grid in z = 0


@dataclass(frozen=True)
class FingerBricks:
    """A finger of hexahedra.

    Attributes:
        mesh: The solid; the mirror z = 0 maps it to itself.
        regions: Which entry of ``STIFFNESS``, flattened, each one takes, shape (hex,); 27, past its end, for phalanges.
        stiffness: Factors of the modulus, shape (hex,).
        cavities: As those of ``FingerMesh``.
        cable: Points of the cable [m], shape (6, 3), from the base to the tip.
        pull_point: Where the cable leaves the base [m], shape (3,).
        tip: Nodes at the end of the back, from negative to positive z.
        base: Nodes of the base's flange, which a hand holds.
    """

    mesh: HexMesh
    regions: IntArray
    stiffness: FloatArray
    cavities: tuple[tuple[FloatArray, IntArray], ...]
    cable: FloatArray
    pull_point: FloatArray
    tip: IntArray
    base: IntArray


def finger_bricks() -> FingerBricks:
    """The finger with cavities, 432 nodes [m]."""
    sections, hollow = geometry.bellows_finger()
    sections, hollow = np.delete(sections, _MIDDLE, axis=1), np.delete(hollow, _MIDDLE, axis=1)
    number = np.arange(np.prod(sections.shape[:3])).reshape(sections.shape[:3])
    cells = np.argwhere(hollow == 0)
    steps = ((SIGNS + 1.0) / 2.0).astype(np.int64)  # natural axes: along the finger, to positive z, to the palm
    corners = (cells[:, None] + steps[None]).transpose(2, 0, 1)
    used, hexes = np.unique(number[tuple(corners)], return_inverse=True)
    nodes = sections.reshape(-1, 3)[used]
    mesh = HexMesh(nodes, hexes.reshape(-1, 8).astype(np.int32), "finger bricks")
    regions = _regions(cells, hollow)
    stiffness = np.append(STIFFNESS.ravel(), SOLID)[regions]
    return FingerBricks(
        mesh, regions, stiffness, _cavities(mesh), *geometry.cable_path(), *geometry.tip_and_base(nodes)
    )


def _regions(cells: NDArray[np.int64], hollow: IntArray) -> IntArray:
    """Those of cells (station, column, row), shape (cell,)."""
    is_joint = hollow.max(axis=(1, 2)) > 0
    slab = np.zeros(len(hollow), dtype=np.int64)  # from the middle of the joint, in cells
    for joint in (1, 2):
        found = np.flatnonzero((hollow == 2 * joint).any(axis=(1, 2)))
        slab[found] = (np.abs(2 * np.arange(len(found)) - len(found) + 1) - 1) // 2
    station, column, row = cells.T
    part = np.abs(column - hollow.shape[1] // 2)
    return np.where(is_joint[station], (slab[station] * 3 + part) * 3 + row, STIFFNESS.size).astype(np.int32)


def _cavities(mesh: HexMesh) -> tuple[tuple[FloatArray, IntArray], ...]:
    """Vertices and triangles of each cavity: of the inner joint at negative and positive z, then of the outer one."""
    solid, found = mesh.linear(), []
    for wall in voids(solid.nodes, solid.tets):
        used, corners = np.unique(wall, return_inverse=True)
        vertices = solid.nodes[used]
        x, _, z = vertices.mean(axis=0)
        place = np.argmin(np.abs(np.array(geometry.JOINTS) - x)), z > 0.0
        found.append((place, (vertices, corners.reshape(-1, 3).astype(np.int32))))
    return tuple(cavity for _, cavity in sorted(found, key=lambda item: item[0]))
