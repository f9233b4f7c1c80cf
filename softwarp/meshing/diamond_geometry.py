"""The diamond: a hollow silicone body of four bent legs between a base and a top, with the axis of symmetry along z.

A leg leaves the base outwards, bends at the elbow, to which its cable is tied, and returns to the top. The dimensions
[m] were measured on the mesh of the DiamondRobot example of the SoftRobots plugin for SOFA, which SofaGym reuses;
source and comparison: assets/diamond/README.md.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from softwarp.meshing.prisms import cut_prisms, split_quads
from softwarp.meshing.resolutions import check_name
from softwarp.meshing.tets import FloatArray, MeshError, TetMesh, orient

HUB_HALF = 0.017  # half width of the square blocks at the base and at the top where the legs meet
TOP_MIDDLE = (0.1139, 0.1257)  # height of the top's middle, inside and outside

# Cross-sections of a leg from the base to the top: distance from the axis and height of its inner edge, the same of its
# outer edge, and half its width.
SECTIONS = (
    (HUB_HALF, -0.0096, HUB_HALF, -0.0370, HUB_HALF),
    (0.0280, -0.0094, 0.0270, -0.0370, 0.0140),
    (0.0400, -0.0060, 0.0420, -0.0343, 0.0132),
    (0.0500, 0.0016, 0.0590, -0.0253, 0.0125),
    (0.0622, 0.0138, 0.0775, -0.0100, 0.0115),
    (0.0755, 0.0271, 0.0880, 0.0160, 0.0106),
    (0.0864, 0.0380, 0.0959, 0.0385, 0.0096),
    (0.0893, 0.0450, 0.0971, 0.0450, 0.0092),
    (0.0855, 0.0528, 0.0925, 0.0560, 0.0097),
    (0.0680, 0.0612, 0.0760, 0.0695, 0.0113),
    (0.0520, 0.0677, 0.0570, 0.0850, 0.0126),
    (0.0395, 0.0760, 0.0380, 0.1002, 0.0135),
    (0.0310, 0.0915, 0.0295, 0.1070, 0.0138),
    (0.0235, 0.1035, 0.0225, 0.1128, 0.0150),
    (HUB_HALF, 0.1084, HUB_HALF, 0.1173, HUB_HALF),
)

# Factors of the modulus with which quadratic elements of the coarse mesh move as converged ones do: rows of SECTIONS
# and factors there, linear in between, for nu = 0.45. assets/diamond/coarsen.py fits them.
COARSE_STIFFNESS = ((2.0, 6.0, 8.0, 12.0), (0.868, 1.090, 0.621, 0.549))

# Rows of SECTIONS between which the outer face of an elbow carries the end of a cable, 17 mm high, where it is spread.
PATCH_ROWS = slice(6, 9)
OFF_PATCH = 0.0005  # m, how far a node may lie from the middle of a quarter of it: on a facet between curved sections

# Cells through the thickness of a leg, across it, and between two rows of SECTIONS.
DETAILS = {"coarse": (1, 2, 1), "medium": (2, 4, 2), "fine": (3, 6, 3)}


def diamond(resolution: str = "medium") -> TetMesh:
    """The four-legged body: base at z = -37 mm, elbows 97 mm from the axis at z = 45 mm, top at z = 126 mm [m].

    A quarter turn about z and the mirrors x = 0, y = 0 and x = y map the mesh to itself, tetrahedra included, so that
    symmetric commands give symmetric motion. A node lies at the outer middle of each elbow and at the middle of the
    top. Linear tetrahedra are too stiff in the bending of the thin elbows, so finer meshes are softer:
    assets/diamond/README.md.

    Args:
        resolution: "coarse" (348 nodes), "medium" (1770) or "fine" (4984).

    Returns:
        The mesh, named after the resolution.

    Raises:
        MeshError: If the name is unknown.
    """
    check_name(resolution, DETAILS, "diamond")
    layers, across, parts = DETAILS[resolution]
    sections = _refined(parts)
    base = _block(sections[0], (sections[0][1], sections[0][3]), layers, across)
    top = _block(sections[-1], TOP_MIDDLE, layers, across)
    leg = _leg(sections[1:-1], layers, across)

    plane, plane_rank = _block_triangles(across)
    side, side_rank = _side_triangles(layers, across)
    column = len(base) // (layers + 1)  # nodes of one layer of a block
    tets = [cut_prisms(plane, plane_rank, k * column + np.arange(2 * column)) for k in range(layers)]
    tets += [cells + len(base) for cells in tets]
    nodes = [base, top]
    for turn in range(4):
        start = sum(map(len, nodes))
        nodes.append(leg @ _quarter_turn(turn).T)
        own = start + np.arange(len(leg)).reshape(len(sections) - 2, -1)
        rim = _rim(turn, layers, across)
        stations = np.concatenate([rim[None], own, len(base) + rim[None]])
        for low, high in itertools.pairwise(stations):
            tets.append(cut_prisms(side, side_rank, np.concatenate([low, high])))
    every = np.concatenate(nodes)
    return TetMesh(every, orient(every, np.concatenate(tets)), f"diamond {resolution}")


def diamond_places(resolution: str = "medium") -> FloatArray:
    """Where the tetrahedra of ``diamond`` lie along a leg, in rows of ``SECTIONS``, shape (tet,).

    They are the middles of the intervals that tetrahedra lie in; those of the two blocks are where legs begin and end.
    """
    check_name(resolution, DETAILS, "diamond")
    layers, across, parts = DETAILS[resolution]
    rows = len(SECTIONS) - 1
    block, slab = 6 * layers * across**2, 6 * layers * across  # tets: two triangles a cell, three a prism
    leg = np.repeat((np.arange(parts * rows) + 0.5) / parts, slab)
    return np.concatenate([np.repeat([0.0, float(rows)], block), *[leg] * 4])


def elbow_patch(nodes: FloatArray, side: tuple[float, float]) -> tuple[NDArray[np.int64], FloatArray]:
    """Nodes in the middles of the four quarters of an elbow's outer face, and the parts of its area around them.

    Args:
        nodes: Of a mesh [m], (node, 3): linear "medium" or quadratic "coarse" ones have such nodes.
        side: Direction of the leg, in the plane.

    Raises:
        MeshError: If there is no node in the middle of a quarter.
    """
    rows = np.array(SECTIONS)[PATCH_ROWS]
    out, across = np.array([*side, 0.0]), np.array([-side[1], side[0], 0.0])
    middles, areas = [], []
    for low, high in itertools.pairwise(rows):
        x, z, half = 0.5 * (low + high)[2:]
        middles += [x * out + sign * 0.5 * half * across + [0.0, 0.0, z] for sign in (-1.0, 1.0)]
        areas += [half * float(np.hypot(*(high - low)[2:4]))] * 2
    off = np.linalg.norm(nodes[None] - np.array(middles)[:, None], axis=2)
    if off.min(axis=1).max() > OFF_PATCH:
        raise MeshError("diamond: no node lies in the middle of each quarter of an elbow's outer face; refine the mesh")
    return off.argmin(axis=1), np.array(areas) / sum(areas)


def coarse_stiffness() -> FloatArray:
    """Factors of the modulus for quadratic elements of ``diamond("coarse")``, shape (tet,): ``COARSE_STIFFNESS``."""
    return np.interp(diamond_places("coarse"), *COARSE_STIFFNESS)


def _refined(parts: int) -> FloatArray:
    """``SECTIONS`` with each interval cut into equal parts, shape (section, 5)."""
    table = np.array(SECTIONS)
    share = np.arange(parts * (len(table) - 1) + 1) / parts
    rows = np.arange(len(table))
    return np.stack([np.interp(share, rows, column) for column in table.T], axis=1)


def _across(count: int) -> FloatArray:
    """Lines across a leg, from -1 to 1."""
    return np.linspace(-1.0, 1.0, count + 1)


def _leg(sections: FloatArray, layers: int, across: int) -> FloatArray:
    """Nodes [m] of the leg along +x between the blocks: section by section, layers from inside, then across."""
    depth = np.linspace(0.0, 1.0, layers + 1)[None, :, None]
    inner_r, inner_z, outer_r, outer_z, half = (column[:, None, None] for column in sections.T)
    x = inner_r + (outer_r - inner_r) * depth
    z = inner_z + (outer_z - inner_z) * depth
    y = half * _across(across)
    return np.stack(np.broadcast_arrays(x, y, z), axis=-1).reshape(-1, 3)


def _block(section: FloatArray, middle: tuple[float, float], layers: int, across: int) -> FloatArray:
    """Nodes [m] where the legs meet, layer by layer from inside; the faces are rounded from the middle to the rim."""
    line = HUB_HALF * _across(across)
    x, y = (grid.ravel() for grid in np.meshgrid(line, line, indexing="ij"))
    rounding = (np.maximum(np.abs(x), np.abs(y)) / HUB_HALF) ** 2
    inner = middle[0] + (section[1] - middle[0]) * rounding
    outer = middle[1] + (section[3] - middle[1]) * rounding
    depths = np.linspace(0.0, 1.0, layers + 1)
    return np.concatenate([np.stack([x, y, inner + (outer - inner) * depth], axis=1) for depth in depths])


def _quarter_turn(turn: int) -> FloatArray:
    """Rotation about z by that many quarter turns, exact."""
    cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[turn]
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _rim(turn: int, layers: int, across: int) -> NDArray[np.int64]:
    """Nodes of a block at the side where a leg begins, in the order of the leg's sections."""
    side = np.arange(across + 1) - across / 2.0
    place = np.stack([np.full(across + 1, across / 2.0), side], axis=1) @ _quarter_turn(turn)[:2, :2].T
    column, row = np.round(place + across / 2.0).astype(np.int64).T
    one = column * (across + 1) + row
    return np.concatenate([one + layer * (across + 1) ** 2 for layer in range(layers + 1)])


def _block_triangles(across: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Triangles of one layer of a block and a rank of its nodes that mirror images share and neighbours do not."""
    steps = np.arange(across + 1)
    offset = np.abs(2 * steps - across)
    far = np.maximum(offset[:, None], offset[None, :])
    near = np.minimum(offset[:, None], offset[None, :])
    rank = (far * (across + 1) + near).ravel()
    corner = [(i * (across + 1) + j) for i in range(across) for j in range(across)]
    return split_quads([(c, c + across + 1, c + across + 2, c + 1) for c in corner], rank), rank


def _side_triangles(layers: int, across: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Triangles of a leg's section and a rank of its nodes; their edges are those of the blocks' sides."""
    offset = np.abs(2 * np.arange(across + 1) - across)
    rank = (np.arange(layers + 1)[:, None] * (across + 1) + offset[None, :]).ravel()
    corner = [k * (across + 1) + j for k in range(layers) for j in range(across)]
    return split_quads([(c, c + 1, c + across + 2, c + across + 1) for c in corner], rank), rank
