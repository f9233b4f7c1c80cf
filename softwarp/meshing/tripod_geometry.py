"""The tripod: a flat silicone star of three legs round a small hole, 5 mm thick, with the axis of symmetry along z.

Seen from above it is an equilateral triangle of 30 mm side, a leg of the same width on each side, and a hole in the
middle. The dimensions [m] were measured on the mesh of the Tripod tutorial of the SoftRobots plugin for SOFA, which
SofaGym's Maze reuses; source and comparison: assets/tripod/README.md.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from softwarp import checks
from softwarp.meshing.hexes import HexMesh
from softwarp.meshing.prisms import cut_prisms, split_quads
from softwarp.meshing.resolutions import check_name
from softwarp.meshing.tets import FloatArray, TetMesh, orient

LEGS = 3
WIDTH = 0.030  # of a leg, and side of the triangle between the legs
REACH = 0.055  # from the axis to the end of a leg
THICKNESS = 0.005
HOLE_RADIUS = 0.005
SIDE = 0.5 * WIDTH / math.sqrt(3.0)  # from the axis to where a leg begins
HELD = SIDE + (REACH - SIDE) * 5.0 / 6.0  # to the line from which the published mesh is held

GRADING = 0.54  # of the lengths of hexahedra along a leg
MOST_CELLS = 1000
# Cells across a leg, along it, from the hole to the leg, and through the thickness. Multiples of the coarse mesh's six
# keep a line of nodes at 47.3 mm, from where the legs of the published mesh are held.
DETAILS = {"coarse": (4, 6, 1, 1), "medium": (6, 12, 1, 2), "fine": (10, 18, 2, 3)}


def tripod(resolution: str = "coarse") -> TetMesh:
    """The flat star between z = -5 mm and z = 0, one leg along +y, the others 120 degrees to both sides of it [m].

    A third of a turn about z and the mirror x = 0 map the mesh to itself, tetrahedra included. Linear tetrahedra in one
    layer are much too stiff in bending: assets/tripod/README.md.

    Args:
        resolution: "coarse" (228 nodes), "medium" (864) or "fine" (2736).

    Returns:
        The mesh, named after the resolution.

    Raises:
        MeshError: If the name is unknown.
    """
    check_name(resolution, DETAILS, "tripod")
    across, along, inwards, layers = DETAILS[resolution]
    strip = np.concatenate([_sector(across, inwards), _leg(across, np.linspace(SIDE, REACH, along + 1))])
    plane, quads, rank = _plan(strip)
    triangles = split_quads([tuple(quad) for quad in quads], rank)
    heights = np.linspace(-THICKNESS, 0.0, layers + 1)
    nodes = np.concatenate([np.column_stack([plane, np.full(len(plane), z)]) for z in heights])
    pair = np.arange(2 * len(plane))
    tets = [cut_prisms(triangles, rank, layer * len(plane) + pair) for layer in range(layers)]
    return TetMesh(nodes, orient(nodes, np.concatenate(tets)), f"tripod {resolution}")


def tripod_bricks(across: int = 4, along: int = 6) -> HexMesh:
    """The star of ``tripod`` in one layer of hexahedra, lower face first, which are shorter where legs bend most.

    That is where they are held: arms that stand upright turn the legs' ends by a right angle, while the legs are
    stretched. From there inwards cells grow to three times the length of the outermost one.

    Args:
        across: Cells across a leg.
        along: Cells along it, up to where it is held.

    Raises:
        ValueError: If a count is not a positive integer.
    """
    across = checks.count(across, "tripod_bricks: across", high=MOST_CELLS)
    along = checks.count(along, "tripod_bricks: along", high=MOST_CELLS)
    place = np.linspace(0.0, 1.0, along + 1)
    rows = SIDE + (HELD - SIDE) * place * (1.0 + GRADING * (1.0 - place))
    strip = np.concatenate([_sector(across, 1), _leg(across, np.append(rows, REACH))])
    plane, quads, _ = _plan(strip)
    nodes = np.concatenate([np.column_stack([plane, np.full(len(plane), z)]) for z in (-THICKNESS, 0.0)])
    hexes = np.concatenate([quads, quads + len(plane)], axis=1)
    return HexMesh(nodes, hexes.astype(np.int32), "tripod walls")


def _plan(strip: FloatArray) -> tuple[FloatArray, NDArray[np.int64], NDArray[np.int64]]:
    """Points of one layer (point, 2), cells between them (cell, 4), and a rank that mirror images and legs share.

    Args:
        strip: Points of the leg along +y and of the sector inwards of it, row by row outwards, (row, across + 1, 2).
    """
    rows, across = len(strip), strip.shape[1] - 1
    column = np.abs(2 * np.arange(across + 1) - across)
    rank = np.broadcast_to(np.arange(rows)[:, None] * (across + 1) + column, (rows, across + 1))
    points: list[FloatArray] = []
    number = np.zeros((LEGS, rows, across + 1), dtype=np.int64)
    known: dict[tuple[int, int], int] = {}
    ranks: list[int] = []
    for leg in range(LEGS):
        turned = strip @ _turn(leg).T
        for row, place in itertools.product(range(rows), range(across + 1)):
            key = (round(turned[row, place, 0] * 1.0e9), round(turned[row, place, 1] * 1.0e9))
            if key not in known:
                known[key] = len(points)
                points.append(turned[row, place])
                ranks.append(int(rank[row, place]))
            number[leg, row, place] = known[key]
    quads = [
        (number[leg, r, c], number[leg, r, c + 1], number[leg, r + 1, c + 1], number[leg, r + 1, c])
        for leg, r, c in itertools.product(range(LEGS), range(rows - 1), range(across))
    ]
    return np.array(points), np.array(quads), np.array(ranks)


def _sector(across: int, inwards: int) -> FloatArray:
    """Points between the hole and the beginning of the leg along +y, row by row outwards, (row, across + 1, 2)."""
    angle = np.radians(np.linspace(60.0, -60.0, across + 1))
    hole = HOLE_RADIUS * np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
    side = np.stack([np.linspace(-0.5 * WIDTH, 0.5 * WIDTH, across + 1), np.full(across + 1, SIDE)], axis=-1)
    share = np.arange(inwards)[:, None, None] / inwards
    result: FloatArray = hole + (side - hole) * share
    return result


def _leg(across: int, y: FloatArray) -> FloatArray:
    """Points of the leg along +y at distances y from the axis, row by row outwards, (row, across + 1, 2)."""
    x = np.linspace(-0.5 * WIDTH, 0.5 * WIDTH, across + 1)
    return np.stack(np.broadcast_arrays(x[None, :], y[:, None]), axis=-1)


def _turn(leg: int) -> FloatArray:
    """Rotation about z by that many thirds of a turn; leg 1 points to -x, as the second servo of SofaGym's scene."""
    angle = 2.0 * math.pi * leg / LEGS
    return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
