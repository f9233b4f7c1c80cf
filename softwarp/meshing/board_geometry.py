"""The board: a silicone tray whose floor is a thin skin over air chambers, three by three of them.

Frame: the origin is the middle of the bottom, z is up, the floor lies in z = 10 mm, a rim of 10 mm all round stands
20 mm higher. Dimensions [m] measured on the board mesh of SofaGym's BubbleMotion scene; source and comparison:
assets/bubble_motion/README.md.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softwarp import checks
from softwarp.meshing.prisms import cut_prisms, split_quads
from softwarp.meshing.resolutions import check_name
from softwarp.meshing.solid import CavityWall, SolidMesh
from softwarp.meshing.surfaces import voids
from softwarp.meshing.tets import FloatArray, IntArray, MeshError, compact, orient

CELLS = 3  # chambers in a row
HALF, RECESS_HALF = 0.050, 0.040  # half widths of the board and of its floor
FLOOR, TOP = 0.010, 0.030  # heights of the floor and of the rim
CHAMBER_BOTTOM, SKIN = 0.0025, 0.001  # height of the chambers' floors, thickness of the skin over them
WALL = 0.0015  # between two chambers, and between a chamber and the rim
CHAMBER = (2.0 * RECESS_HALF - (CELLS + 1) * WALL) / CELLS  # width
PITCH = CHAMBER + WALL  # from a chamber to the next

# Intervals across a chamber (even, for symmetry), layers of the skin, of the chamber's height and of the bottom.
DETAILS = {"coarse": (2, 1, 1, 1), "medium": (4, 2, 1, 1), "fine": (8, 3, 2, 1), "graded": (4, 2, 1, 1)}
GRADED = ("graded",)  # whose intervals are narrower beside the walls, where the floor bends most


def chamber_centres() -> FloatArray:
    """Middles of the chambers in the plane [m], shape (9, 2); y changes fastest."""
    line = PITCH * (np.arange(CELLS) - 0.5 * (CELLS - 1))
    return np.array(list(itertools.product(line, line)))


@dataclass(frozen=True)
class _Grid:
    """Lines of nodes that cut the floor into bricks.

    Attributes:
        lines: Places along x and along y [m], (line,).
        own: Number of the chamber between a line and the next, -1 over a wall, (line - 1,).
        levels: Heights of the layers of nodes [m], (level,).
        hollow: Layers of bricks that chambers take up, (level - 1,).
        rank: A number for every node of a level that mirror images share and neighbours do not, (line, line).
    """

    lines: FloatArray
    own: NDArray[np.int64]
    levels: FloatArray
    hollow: NDArray[np.bool_]
    rank: NDArray[np.int64]


def board(resolution: str = "coarse", *, skin: float = SKIN, rim: bool = True) -> SolidMesh:
    """The tray with its nine chambers ``cell_0`` ... ``cell_8``, in rows along y, the first row at low x [m].

    A quarter turn about z and the mirrors x = 0, y = 0 and x = y map the mesh to itself, tetrahedra included.

    Args:
        resolution: "coarse", "medium", "fine", or "graded": as many as medium, narrower beside the walls.
        skin: Thickness of the floor over the chambers, whose height gives way [m]; more than 0, less than 7 mm.
        rim: Whether the rim belongs to it; without, the board is a plate that is as high as its floor.

    Returns:
        The solid; ``add_cavity(body, solid.cavities["cell_4"])`` makes a chamber of the middle cell.

    Raises:
        MeshError: If the name is unknown or the skin leaves no chamber.
        ValueError: If ``rim`` is neither True nor False.
    """
    check_name(resolution, DETAILS, "board")
    try:
        checks.number(skin, "board: skin [m]", above=0.0, below=FLOOR - CHAMBER_BOTTOM - 5e-4)
    except ValueError as error:
        raise MeshError(str(error)) from None
    rim = checks.flag(rim, "board: rim")
    grid = _grid(resolution, skin)
    nodes, tets = _floor(grid)
    more_nodes, more_tets = _border(grid, rim=rim)
    nodes, tets = compact(np.concatenate([nodes, more_nodes]), np.concatenate([tets, more_tets]))
    tets = orient(nodes, tets)
    return SolidMesh(nodes, tets, f"board {resolution}", cavities=_chambers(nodes, tets), wall=min(skin, WALL))


def _grid(resolution: str, skin: float) -> _Grid:
    across, thick, high, deep = DETAILS[resolution]
    place = 2.0 * np.arange(across + 1) / across - 1.0
    if resolution in GRADED:
        place = np.sin(0.5 * np.pi * place)
    middles = PITCH * (np.arange(CELLS) - 0.5 * (CELLS - 1))
    cells = np.concatenate([middle + 0.5 * CHAMBER * place for middle in middles])
    lines = np.concatenate([[-RECESS_HALF], cells, [RECESS_HALF]])
    own = np.full(len(lines) - 1, -1)
    for cell in range(CELLS):
        first = 1 + cell * (across + 1)
        own[first : first + across] = cell
    ceiling = FLOOR - skin
    parts = (
        np.linspace(0.0, CHAMBER_BOTTOM, deep + 1)[:-1],
        np.linspace(CHAMBER_BOTTOM, ceiling, high + 1)[:-1],
        np.linspace(ceiling, FLOOR, thick + 1),
    )
    hollow = np.repeat([False, True, False], (deep, high, thick))
    return _Grid(lines, own, np.concatenate(parts), hollow, _rank(len(lines), across))


def _rank(count: int, across: int) -> NDArray[np.int64]:
    """Nodes in the middle of a chamber come first, so that diagonals run outwards from there."""
    step = np.arange(count)
    within = np.abs(2 * ((step - 1) % (across + 1)) - across)
    within[[0, -1]] = across + 1  # the recess's own border
    line = within * (count + 1) + np.abs(2 * step - (count - 1))
    high, low = np.maximum(line[:, None], line[None, :]), np.minimum(line[:, None], line[None, :])
    return np.asarray(high * (int(line.max()) + 1) + low)


def _floor(grid: _Grid) -> tuple[FloatArray, IntArray]:
    """Bricks under the floor, without those of the chambers, cut into tetrahedra."""
    count = len(grid.lines)
    x, y = (part.ravel() for part in np.meshgrid(grid.lines, grid.lines, indexing="ij"))
    nodes = np.concatenate([np.stack([x, y, np.full_like(x, z)], axis=1) for z in grid.levels])
    rank = grid.rank.ravel()
    bricks = list(itertools.product(range(count - 1), repeat=2))
    corner = np.array([i * count + j for i, j in bricks])
    halves = split_quads([(c, c + count, c + count + 1, c + 1) for c in corner.tolist()], rank).reshape(-1, 2, 3)
    is_wall = np.array([min(grid.own[i], grid.own[j]) < 0 for i, j in bricks])
    layer = np.arange(2 * len(rank))
    tets = [
        cut_prisms((halves[is_wall] if is_hollow else halves).reshape(-1, 3), rank, layer + k * len(rank))
        for k, is_hollow in enumerate(grid.hollow)
    ]
    return nodes, np.concatenate(tets)


def _border(grid: _Grid, *, rim: bool) -> tuple[FloatArray, IntArray]:
    """What surrounds the recess: a section, fans of triangles, drawn along the recess's edge.

    Its own nodes follow those of the floor: outside at the bottom and at the height of the floor, then the rim's top
    outside and inside, each all the way round.
    """
    count, top = len(grid.lines), len(grid.levels) - 1
    last = count - 1
    way = [(i, 0) for i in range(last)] + [(last, j) for j in range(last)]
    way += [(i, last) for i in range(last, 0, -1)] + [(0, j) for j in range(last, 0, -1)]
    inner = np.array([[grid.lines[i], grid.lines[j]] for i, j in way])
    outer = inner * (HALF / RECESS_HALF)
    rings = [(outer, 0.0), (outer, FLOOR), *([(outer, TOP), (inner, TOP)] if rim else [])]
    nodes = np.concatenate([np.column_stack([place, np.full(len(place), z)]) for place, z in rings])

    edge = np.array([i * count + j for i, j in way])[:, None] + count**2 * np.arange(top + 1)
    own = count**2 * (top + 1) + np.arange(len(way))[:, None] + len(way) * np.arange(len(rings))
    section = np.concatenate([edge, own], axis=1)
    below, beside, outside, inside = top + 1 + np.arange(4)
    triangles = [(k, k + 1, below) for k in range(top)] + [(top, below, beside)]
    triangles += [(top, beside, outside), (top, outside, inside)] if rim else []
    tets = []
    for a, b in itertools.pairwise([*range(len(way)), 0]):
        first, second = sorted((a, b), key=lambda k: grid.rank[way[k]])  # the side of the floor is cut alike
        stations = np.concatenate([section[first], section[second]])
        tets.append(cut_prisms(np.array(triangles), np.arange(section.shape[1]), stations))
    return nodes, np.concatenate(tets)


def _chambers(nodes: FloatArray, tets: IntArray) -> dict[str, CavityWall]:
    """Walls of the chambers, in the order of ``chamber_centres``."""
    found = {}
    for triangles in voids(nodes, tets):
        vertices, corners = compact(nodes, triangles)
        middle = vertices[:, :2].min(axis=0) + vertices[:, :2].max(axis=0)
        number = int(np.argmin(np.linalg.norm(chamber_centres() - 0.5 * middle, axis=1)))
        found[number] = (vertices, corners, np.unique(triangles).astype(np.int32))
    named = ((f"cell_{number}", found[number]) for number in sorted(found))
    return {name: CavityWall(vertices, corners, name, node) for name, (vertices, corners, node) in named}
