"""The gripper's finger: three silicone phalanges on two bellows joints with two air cavities each, and a plainer one.

Frame: the finger lies along x with its back in y = 3 mm and its palm towards -y, symmetric about z = 0. A cable along
y = -11 mm closes it, towards -y. A section in the y-z plane is a grid of nodes, drawn out from station to station; the
cells of cavities are left out. Dimensions [m] were measured on the finger of SofaGym's Gripper scene; source and
comparison: assets/gripper/README.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softwarp.meshing.resolutions import check_name
from softwarp.meshing.tets import FloatArray, IntArray, TetMesh, orient, tet_surface

BACK, PALM = 0.003, -0.0175  # y of the phalanges' faces
HALF_WIDTH = 0.008  # of the phalanges
CROWN = 0.0004  # how far the middle of the palm stands out, since the cable draws it in
FLANGE = (-0.0345, -0.0305, -0.0195)  # x of the base's end and of its flange, y of the flange
TIP = ((0.003, 0.0865), (0.0, 0.0855), (-0.0093, 0.0810), (-0.0175, 0.0715))  # y and x of the tip's end, row by row
JOINTS = (0.0, 0.043)  # x of their middles
JOINT_HALF = 0.0124  # half their length at the palm
SEPTUM_HALF = 0.002  # half the wall between the two cavities of a joint
# A half joint: distance from its middle, radius inside and outside. The bellows swell and narrow along the joint.
BELLOWS = ((0.0, 0.0100, 0.0118), (0.00425, 0.0050, 0.0066), (0.0085, 0.0100, 0.0118), (JOINT_HALF, 0.0054, None))
OUTER_PAD = 0.0635  # x of the section in the outer phalanx
CABLE_Y = -0.011  # of the cable
CABLE_X = (-0.0325, -0.0125, 0.0125, 0.0325, 0.0575, 0.0770)  # of its points
PULL_X = -0.040  # where it leaves the base
NOTCH = -0.003  # y of the plain finger's palm at its joints

KINDS = ("cavities", "plain")
DETAILS = {"coarse": 1, "medium": 2, "fine": 3}  # parts of every cell's edge

_COLUMNS, _ROWS = 6, 3  # cells of a section: wall, cavity, two of the septum, cavity, wall; back, cavity, palm
_HOLLOW = (1, 4)  # columns of the cavities at negative and at positive z, in the middle row
_FLOOR = (1.0, 0.5)  # where nodes lie on the arc of a cavity, from septum to side, as parts of its angle
_ARC = (1.0, 0.68, 0.5, 0.32)  # likewise on that of the wall's outside
_Z = HALF_WIDTH * np.linspace(-1.0, 1.0, _COLUMNS + 1)


@dataclass(frozen=True)
class FingerMesh:
    """A finger and its air cavities.

    Attributes:
        mesh: The solid.
        cavities: Vertices [m], each one a node of the mesh, shape (v, 3), and triangles, outward from the air, shape
            (t, 3), of each cavity: of the inner joint at negative and positive z, then of the outer joint. Empty for
            the plain finger.
        cable: Points of the cable [m], shape (6, 3), from the base to the tip.
        pull_point: Where the cable leaves the base [m], shape (3,).
        tip: Nodes at the end of the back, from negative to positive z.
        base: Nodes of the base's flange, which a hand holds.
    """

    mesh: TetMesh
    cavities: tuple[tuple[FloatArray, IntArray], ...]
    cable: FloatArray
    pull_point: FloatArray
    tip: IntArray
    base: IntArray


def finger(resolution: str = "coarse", kind: str = "cavities") -> FingerMesh:
    """A finger 121 mm long [m].

    The mirror z = 0 maps the mesh to itself, tetrahedra included.

    Args:
        resolution: "coarse" (504 nodes with cavities, as stiff as the published mesh), "medium" or "fine".
        kind: "cavities", or "plain": bending at two notches in a solid bar, with a third of the nodes.

    Raises:
        MeshError: If a name is unknown.
    """
    for what, name, known in (("resolution", resolution, DETAILS), ("kind", kind, KINDS)):
        check_name(name, known, "finger", what)
    parts = DETAILS[resolution]
    sections, hollow = bellows_finger() if kind == "cavities" else _plain_finger()
    grid = refined(sections, parts)
    cells = np.repeat(np.repeat(np.repeat(hollow, parts, axis=0), parts, axis=1), parts, axis=2)
    tets = _cut(grid.shape[:3], cells == 0)
    used, corners = np.unique(tets, return_inverse=True)
    nodes = grid.reshape(-1, 3)[used]
    mesh = TetMesh(nodes, orient(nodes, corners.reshape(-1, 4).astype(np.int32)), f"{kind} finger {resolution}")
    cavities = tuple(_wall(grid, cells, number) for number in range(1, int(hollow.max()) + 1))
    return FingerMesh(mesh, cavities, *cable_path(), *tip_and_base(nodes))


def cable_path() -> tuple[FloatArray, FloatArray]:
    """Points of the cable [m], shape (6, 3), from the base to the tip, and where it leaves the base, (3,)."""
    cable = np.stack([np.array(CABLE_X), np.full(len(CABLE_X), CABLE_Y), np.zeros(len(CABLE_X))], axis=1)
    return cable, np.array([PULL_X, CABLE_Y, 0.0])


def tip_and_base(nodes: FloatArray) -> tuple[IntArray, IntArray]:
    """Nodes at the end of the back, from negative to positive z, and those of the flange."""
    tip = np.flatnonzero((nodes[:, 0] > TIP[0][1] - 1e-9) & (nodes[:, 1] > BACK - 1e-9))
    base = np.flatnonzero(nodes[:, 0] < FLANGE[1] + 1e-9)
    return tip[np.argsort(nodes[tip, 2])].astype(np.int32), base.astype(np.int32)


def bellows_finger() -> tuple[FloatArray, IntArray]:
    """Nodes of the sections, shape (station, column, row, 3), and cells: 0 solid, else the number of a cavity."""
    sections, joint_of = [_block(x, FLANGE[2]) for x in FLANGE[:2]], [0, 0]
    profile = [(-x, inner, outer) for x, inner, outer in reversed(BELLOWS[1:])] + list(BELLOWS)
    for joint, middle in enumerate(JOINTS, start=1):
        sections += [_joint(middle + x, inner, outer) for x, inner, outer in profile]
        joint_of += [joint] * (len(profile) - 1) + [0]
    sections += [_block(OUTER_PAD, PALM), _tip(_Z)]
    cells = np.zeros((len(sections) - 1, _COLUMNS, _ROWS), dtype=np.int32)
    for place, joint in enumerate(joint_of):
        for side, column in enumerate(_HOLLOW):
            cells[place, column, 1] = 2 * joint - 1 + side if joint else 0
    return np.array(sections), cells


def _plain_finger() -> tuple[FloatArray, IntArray]:
    """A solid bar with a notch for each joint, two cells wide and three high."""
    z = np.array([-HALF_WIDTH, 0.0, HALF_WIDTH])

    def section(x: float, palm: float) -> FloatArray:
        y = BACK + (palm - BACK) * np.linspace(0.0, 1.0, _ROWS + 1)
        return _crowned(np.stack(np.broadcast_arrays(x, y[None, :], z[:, None]), axis=-1))

    sections = [section(x, FLANGE[2]) for x in FLANGE[:2]]
    for middle in JOINTS:
        inner = 0.5 * JOINT_HALF
        sections.append(section(middle - JOINT_HALF, PALM))
        sections += [section(middle + x, NOTCH) for x in (-inner, 0.0, inner)]
        sections.append(section(middle + JOINT_HALF, PALM))
    sections += [section(OUTER_PAD, PALM), _tip(z)]
    return np.array(sections), np.zeros((len(sections) - 1, len(z) - 1, _ROWS), dtype=np.int32)


def _block(x: float, palm: float) -> FloatArray:
    """Section of a phalanx, shape (column, row, 3)."""
    y = np.array([BACK, 0.0, 0.5 * PALM, palm])
    return _crowned(np.stack(np.broadcast_arrays(x, y[None, :], _Z[:, None]), axis=-1))


def _tip(z: FloatArray) -> FloatArray:
    """The slanted end of the finger."""
    y, x = np.array(TIP).T
    return _crowned(np.stack(np.broadcast_arrays(x[None, :], y[None, :], z[:, None]), axis=-1))


def _crowned(section: FloatArray) -> FloatArray:
    """A section whose palm stands out in its middle, where it is a phalanx's."""
    palm = section[:, -1]
    palm[:, 1] -= CROWN * (1.0 - (palm[:, 2] / HALF_WIDTH) ** 2) * (palm[:, 1] == PALM)
    return section


def _joint(x: float, inner: float, outer: float | None) -> FloatArray:
    """Section through the cavities of a joint; without an outer radius that of the phalanx where they end."""
    section = _block(x, PALM)
    half = section[_COLUMNS // 2 :]  # z >= 0: middle and side of the septum, side of the cavity, outside
    half[1, :, 2] = SEPTUM_HALF
    half[2, :2, 2] = inner
    half[1:3, 2, 1:] = _arc(inner, _FLOOR)
    half[0, 2, 1] = half[1, 2, 1]
    if outer is not None:
        half[3, :2, 2] = outer
        arc = _arc(outer, _ARC)
        half[1:, 3, 1:] = arc[:3]
        half[3, 2, 1:] = arc[3]
        half[0, 3, 1] = half[1, 3, 1]
    section[: _COLUMNS // 2] = half[:0:-1] * [1.0, 1.0, -1.0]
    return section


def _arc(radius: float, parts: tuple[float, ...]) -> FloatArray:
    """y and z of points on a circle about the x axis, at parts of the angle from the z axis to the septum's side."""
    angle = math.acos(SEPTUM_HALF / radius) * np.array(parts)
    return radius * np.stack([-np.sin(angle), np.cos(angle)], axis=1)


def refined(sections: FloatArray, parts: int) -> FloatArray:
    """The grid of nodes with each cell cut into equal parts along its three axes, trilinearly."""
    for axis in range(3):
        count = sections.shape[axis]
        place = np.arange(parts * (count - 1) + 1) / parts
        low = np.minimum(place.astype(np.int64), count - 2)
        share = (place - low).reshape([-1 if k == axis else 1 for k in range(4)])
        sections = np.take(sections, low, axis) * (1.0 - share) + np.take(sections, low + 1, axis) * share
    return sections


def _cut(shape: tuple[int, ...], solid: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Tetrahedra of the solid cells, six in each: its section in two triangles, each drawn out to a prism."""
    stations, columns, rows = shape
    number = np.arange(stations * columns * rows).reshape(shape)
    middle = 0.5 * (columns - 1)
    tets = []
    for i, j, k in zip(*np.nonzero(solid), strict=True):
        near, far = (j, j + 1) if abs(j + 1 - middle) > abs(j - middle) else (j + 1, j)
        # The diagonal runs from the back's middle outwards, so that the mirror keeps it; in the wall's corner it starts
        # at the cavity, as the outside is round.
        square = [(near, k), (far, k), (far, k + 1), (near, k + 1)]
        for triangle in ((0, 1, 2), (0, 2, 3)):
            # Prisms are cut alike on both sides of a common face if corners are ranked alike.
            ranked = sorted((square[c] for c in triangle), key=lambda node: (abs(2 * node[0] - columns + 1), node[1]))
            (a, b, c), (d, e, f) = ([int(number[(s, *node)]) for node in ranked] for s in (i, i + 1))
            tets += [(a, b, c, f), (a, b, e, f), (a, d, e, f)]
    return np.array(tets)


def _wall(grid: FloatArray, cells: IntArray, cavity: int) -> tuple[FloatArray, IntArray]:
    """The closed surface of a cavity: vertices, and triangles outward from the air, those of the mesh around it."""
    nodes = grid.reshape(-1, 3)
    air = orient(nodes, _cut(grid.shape[:3], cells == cavity).astype(np.int32))
    used, corners = np.unique(tet_surface(air), return_inverse=True)
    return nodes[used], corners.reshape(-1, 3).astype(np.int32)
