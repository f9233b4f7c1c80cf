"""Mazes: a floor with walls along the lines of a square lattice, and the ways through it along the corridors' middles.

Frame: the floor's upper side lies in z = 0, its middle is the origin, walls rise along +z. Cells are numbered
``column * rows + row``; columns run along x, rows along y. Dimensions [m] of the serpentine measured on the maze of
SofaGym's Maze scene; source and comparison: assets/maze/README.md.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp import checks
from softwarp.meshing.tets import FloatArray, MeshError, SurfaceMesh

SIDE = 0.060  # of the serpentine, outside
CELLS = 8  # corridors side by side
WALL, HEIGHT, FLOOR = 0.001, 0.009, 0.001  # thickness of walls, their height over the floor, thickness of the floor
CORRIDOR = (SIDE - (CELLS + 1) * WALL) / CELLS  # width
# The way of the serpentine from the cell at the lowest x and y all round, through every cell, and back.
LOOP = "RRRRRURDRUUUUULDLULDLLURURRRRULLLLLDLULDDRDLDDRURRRRRDLLDLULDLLD"

MOST_CELLS = 10_000
DIRECTIONS = ((1, 0), (0, 1), (-1, 0), (0, -1))  # east, north, west, south
_STEPS = dict(zip("RULD", DIRECTIONS, strict=True))
_ASIDE = 1.0e-9  # m


@dataclass(frozen=True, eq=False)
class Maze:
    """Corridors on a lattice of square cells.

    Args:
        east: Whether one can pass from cell (i, j) to (i + 1, j), bool, shape (columns - 1, rows).
        north: Whether one can pass from cell (i, j) to (i, j + 1), bool, shape (columns, rows - 1).
        corridor: Width of the corridors [m].
        wall: Thickness of the walls [m].
        height: Height of the walls over the floor [m].
        floor: Thickness of the floor [m].
        name: What messages call it.

    Raises:
        MeshError: If a measure is not positive, the arrays do not fit, or some cells cannot be reached from others.
    """

    east: NDArray[np.bool_]
    north: NDArray[np.bool_]
    corridor: float = CORRIDOR
    wall: float = WALL
    height: float = HEIGHT
    floor: float = FLOOR
    name: str = "maze"

    def __post_init__(self) -> None:
        """Check measures, arrays and that every cell can be reached."""
        for measure in ("corridor", "wall", "height", "floor"):
            try:
                value = checks.number(getattr(self, measure), f"{self.name}: {measure} [m]", above=0.0, high=1.0e3)
            except ValueError as error:
                raise MeshError(str(error)) from None
            object.__setattr__(self, measure, value)
        for side in ("east", "north"):
            passages = np.asarray(getattr(self, side))
            if passages.ndim != 2 or passages.dtype != np.bool_:
                raise MeshError(
                    f"{self.name}: {side} must be flags of shape (columns, rows), got {passages.dtype} {passages.shape}"
                )
            object.__setattr__(self, side, passages)
        columns, rows = self.columns, self.rows
        if self.east.shape != (columns - 1, rows) or self.north.shape != (columns, rows - 1):
            raise MeshError(
                f"{self.name}: east must have shape (columns - 1, rows) and north (columns, rows - 1), got "
                f"{self.east.shape} and {self.north.shape}"
            )
        cut_off = np.flatnonzero(self.steps[0] < 0)
        if len(cut_off):
            raise MeshError(
                f"{self.name}: {len(cut_off)} cells cannot be reached from cell (0, 0), the first of them "
                f"{divmod(int(cut_off[0]), rows)}; open a passage to them"
            )

    @property
    def columns(self) -> int:
        """Cells along x."""
        return int(self.north.shape[0])

    @property
    def rows(self) -> int:
        """Cells along y."""
        return int(self.east.shape[1])

    @property
    def pitch(self) -> float:
        """From the middle of a cell to that of the next [m]."""
        return self.corridor + self.wall

    @property
    def size(self) -> tuple[float, float, float]:
        """Outer extents [m]; z from ``-floor`` to ``height``."""
        return (
            self.columns * self.pitch + self.wall,
            self.rows * self.pitch + self.wall,
            self.floor + self.height,
        )

    @cached_property
    def centres(self) -> FloatArray:
        """Middles of the cells in the plane [m], shape (cell, 2)."""
        lines = [self.pitch * (np.arange(n) - 0.5 * (n - 1)) for n in (self.columns, self.rows)]
        return np.array(list(itertools.product(*lines)))

    @cached_property
    def neighbours(self) -> NDArray[np.int64]:
        """Cell behind the open side to the east, north, west and south, -1 where there is a wall, (cell, 4)."""
        found = np.full((self.columns, self.rows, 4), -1)
        number = np.arange(self.columns * self.rows).reshape(self.columns, self.rows)
        found[:-1, :, 0] = np.where(self.east, number[1:], -1)
        found[:, :-1, 1] = np.where(self.north, number[:, 1:], -1)
        found[1:, :, 2] = np.where(self.east, number[:-1], -1)
        found[:, 1:, 3] = np.where(self.north, number[:, :-1], -1)
        return found.reshape(-1, 4)

    @cached_property
    def steps(self) -> NDArray[np.int64]:
        """Fewest steps between any two cells, -1 where there is no way, (cell, cell)."""
        count, beside = self.columns * self.rows, self.neighbours
        found = np.full((count, count), -1)
        reached = np.eye(count, dtype=bool)  # from the row's cell
        into = np.zeros((count, count), dtype=np.float32)
        for side in range(4):
            open_cells = np.flatnonzero(beside[:, side] >= 0)
            into[open_cells, beside[open_cells, side]] = 1.0
        step = 0
        while reached.any():
            found[reached] = step
            reached = (reached.astype(np.float32) @ into > 0.0) & (found < 0)
            step += 1
        return found

    def corners(self) -> NDArray[np.int64]:
        """Cells in the four corners: low x and low y, low x and high y, high x and high y, high x and low y."""
        last, high = self.columns - 1, self.rows - 1
        return np.array([0, high, last * self.rows + high, last * self.rows])

    def check_ball(self, radius: float) -> None:
        """Refuse a ball that does not fit between the walls.

        Raises:
            MeshError: Telling the widest ball that does.
        """
        if not 2.0 * radius < self.corridor:
            raise MeshError(
                f"{self.name}: a ball of radius {radius:g} m does not fit into corridors {self.corridor:.4g} m wide; "
                f"its radius must be less than {0.5 * self.corridor:.4g} m, or the corridors wider"
            )

    def cell_of(self, point: ArrayLike) -> int:
        """The cell in whose part of the lattice a point lies, walls shared between neighbours.

        Args:
            point: x and y [m].

        Raises:
            MeshError: If it lies outside or in a wall.
        """
        place = np.asarray(point, dtype=np.float64).reshape(-1)[:2]
        if place.shape != (2,) or not np.all(np.isfinite(place)):
            raise MeshError(f"{self.name}: a point must be x and y [m], got {point!r}")
        count = np.array([self.columns, self.rows])
        step = np.floor(place / self.pitch + 0.5 * count).astype(np.int64)
        inside = np.array(self.size[:2]) * 0.5 + _ASIDE
        where = f"{self.name}: ({place[0]:.6g}, {place[1]:.6g}) m"
        if np.any(np.abs(place) > inside):
            raise MeshError(f"{where} lies outside the maze, which reaches to +-{inside[0]:.4g}, +-{inside[1]:.4g} m")
        column, row = np.clip(step, 0, count - 1)
        cell = int(column * self.rows + row)
        away = place - self.centres[cell]
        half = 0.5 * self.corridor + _ASIDE
        is_beyond = np.abs(away) > half
        if is_beyond.all() or any(
            is_beyond[axis] and self.neighbours[cell, axis + (2 if away[axis] < 0.0 else 0)] < 0 for axis in (0, 1)
        ):
            middle = self.centres[cell]
            raise MeshError(
                f"{where} lies in a wall, not in a corridor; the nearest cell's middle is ({middle[0]:.6g}, "
                f"{middle[1]:.6g}) m"
            )
        return cell

    def on_middle(self, point: ArrayLike) -> tuple[int, int, float]:
        """The nearest place on the middles of the corridors.

        Returns:
            Cell, direction 0 to 3 from its middle (an open one where the distance is not 0), distance from its middle
            [m], at most half a pitch.

        Raises:
            MeshError: If the point lies outside or in a wall.
        """
        cell = self.cell_of(point)
        away = np.asarray(point, dtype=np.float64).reshape(-1)[:2] - self.centres[cell]
        best, direction, along = float(np.linalg.norm(away)), 0, 0.0
        for side, step in enumerate(DIRECTIONS):
            reach = min(max(float(away @ step), 0.0), 0.5 * self.pitch)
            apart = float(np.linalg.norm(away - reach * np.array(step)))
            if self.neighbours[cell, side] >= 0 and apart < best - _ASIDE:
                best, direction, along = apart, side, reach
        return cell, direction, along

    def path(self, start: ArrayLike, goal: ArrayLike) -> FloatArray:
        """The shortest way between two points along the middles of the corridors.

        Args:
            start: x and y [m], anywhere in a corridor.
            goal: x and y [m], anywhere in a corridor.

        Returns:
            Corners of the way from the start's nearest place on a middle to that of the goal, shape (k, 2), k >= 1.

        Raises:
            MeshError: If a point lies outside or in a wall.
        """
        ends = [self.on_middle(point) for point in (start, goal)]
        places = [self._place(*end) for end in ends]
        if self._is_direct(*ends):
            line = np.array(places)
        else:
            ways = []
            for (a, before), (b, after) in itertools.product(*(self._doors(*end) for end in ends)):
                ways.append((before + self.pitch * float(self.steps[a, b]) + after, a, b))
            _, first, last = min(ways)
            cells = [first]
            while cells[-1] != last:
                beside = self.neighbours[cells[-1]]
                cells.append(
                    int(next(c for c in beside if c >= 0 and self.steps[c, last] < self.steps[cells[-1], last]))
                )
            line = np.concatenate([places[:1], self.centres[cells], places[1:]])
        return _without_straights(line)

    def distance(self, start: ArrayLike, goal: ArrayLike) -> float:
        """Length of ``path`` [m]."""
        return float(np.linalg.norm(np.diff(self.path(start, goal), axis=0), axis=1).sum())

    def _place(self, cell: int, direction: int, along: float) -> FloatArray:
        return np.asarray(self.centres[cell] + along * np.array(DIRECTIONS[direction]))

    def _doors(self, cell: int, direction: int, along: float) -> list[tuple[int, float]]:
        """Cells whose middles bound the stretch on which a place lies, and how far they are [m]."""
        doors = [(cell, along)]
        return doors if along <= 0.0 else [*doors, (int(self.neighbours[cell, direction]), self.pitch - along)]

    def _is_direct(self, one: tuple[int, int, float], other: tuple[int, int, float]) -> bool:
        """Whether two places lie on one stretch between two middles."""
        stretches = [{cell for cell, _ in self._doors(*end)} for end in (one, other)]
        return stretches[0] <= stretches[1] or stretches[1] <= stretches[0]

    def surface(self) -> SurfaceMesh:
        """The closed surface of floor and walls, one solid without hollows, counter-clockwise from outside.

        Lines of the lattice cut it into blocks, each as high as a wall or as the floor; what faces up, down and
        sideways between blocks of different height is two triangles each.
        """
        return _solid(self._is_wall(), *self._lines(), (-self.floor, 0.0, self.height), self.name)

    def _lines(self) -> tuple[FloatArray, FloatArray]:
        """Places along x and y where walls begin and end [m]."""
        lines = []
        for count in (self.columns, self.rows):
            edges = self.pitch * (np.arange(count + 1) - 0.5 * count)
            lines.append((edges[:, None] + np.array([-0.5, 0.5]) * self.wall).reshape(-1))
        return lines[0], lines[1]

    def _is_wall(self) -> NDArray[np.bool_]:
        """Which blocks are walls, shape (2 columns + 1, 2 rows + 1); posts stand where a wall ends."""
        wall = np.zeros((2 * self.columns + 1, 2 * self.rows + 1), dtype=bool)
        wall[[0, -1]], wall[:, [0, -1]] = True, True
        wall[2:-1:2, 1::2] = ~self.east
        wall[1::2, 2:-1:2] = ~self.north
        padded = np.pad(wall, 1)
        beside = padded[2:, 1:-1] | padded[:-2, 1:-1] | padded[1:-1, 2:] | padded[1:-1, :-2]
        wall[::2, ::2] = beside[::2, ::2]
        return wall


def serpentine(*, corridor: float = CORRIDOR, wall: float = WALL, height: float = HEIGHT, floor: float = FLOOR) -> Maze:
    """The maze of SofaGym's kind: 8 x 8 cells, and one winding corridor through all of them, back to its start.

    Args:
        corridor: Width of the corridors [m].
        wall: Thickness of the walls [m].
        height: Height of the walls over the floor [m].
        floor: Thickness of the floor [m].

    Raises:
        MeshError: If a measure is not positive.
    """
    east, north = np.zeros((CELLS - 1, CELLS), dtype=bool), np.zeros((CELLS, CELLS - 1), dtype=bool)
    i = j = 0
    for letter in LOOP:
        di, dj = _STEPS[letter]
        if di:
            east[min(i, i + di), j] = True
        else:
            north[i, min(j, j + dj)] = True
        i, j = i + di, j + dj
    return Maze(east, north, corridor, wall, height, floor, "serpentine")


def random_maze(
    columns: int = CELLS,
    rows: int = CELLS,
    *,
    seed: int,
    loops: int = 0,
    corridor: float = CORRIDOR,
    wall: float = WALL,
    height: float = HEIGHT,
    floor: float = FLOOR,
) -> Maze:
    """A random maze: between any two cells there is one way, and more with ``loops``.

    A walk goes on to a random neighbour that is new, or back where there is none; then ``loops`` of the walls that are
    left are opened. The same arguments give the same maze.

    Args:
        columns: Cells along x, at least 2.
        rows: Cells along y, at least 2.
        seed: Of all draws, not negative.
        loops: Walls that are opened, each of which closes a ring of corridors.
        corridor: Width of the corridors [m].
        wall: Thickness of the walls [m].
        height: Height of the walls over the floor [m].
        floor: Thickness of the floor [m].

    Raises:
        MeshError: If a number is out of range; there are ``(columns - 1) (rows - 1)`` walls to open.
    """
    columns, rows = _count(columns, "columns"), _count(rows, "rows")
    if columns * rows > MOST_CELLS:
        raise MeshError(f"random maze: columns * rows must be at most {MOST_CELLS}, got {columns} * {rows}")
    spare = (columns - 1) * (rows - 1)
    try:
        seed = checks.seed(seed)
        loops = checks.count(loops, "random maze: loops", low=0, high=spare)
    except ValueError as error:
        raise MeshError(str(error)) from None
    rng = np.random.default_rng(seed)
    east, north = _spanning_tree(columns, rows, rng)
    closed = [("east", *place) for place in np.argwhere(~east)] + [("north", *place) for place in np.argwhere(~north)]
    for k in rng.permutation(len(closed))[:loops]:
        side, i, j = closed[int(k)]
        (east if side == "east" else north)[i, j] = True
    return Maze(east, north, corridor, wall, height, floor, f"random maze {seed}")


def _spanning_tree(columns: int, rows: int, rng: np.random.Generator) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Passages of a maze without rings."""
    east, north = np.zeros((columns - 1, rows), dtype=bool), np.zeros((columns, rows - 1), dtype=bool)
    seen = np.zeros((columns, rows), dtype=bool)
    way = [(int(rng.integers(columns)), int(rng.integers(rows)))]
    seen[way[0]] = True
    while way:
        i, j = way[-1]
        steps = [(di, dj) for di, dj in DIRECTIONS if 0 <= i + di < columns and 0 <= j + dj < rows]
        steps = [(di, dj) for di, dj in steps if not seen[i + di, j + dj]]
        if not steps:
            way.pop()
            continue
        di, dj = steps[int(rng.integers(len(steps)))]
        if di:
            east[min(i, i + di), j] = True
        else:
            north[i, min(j, j + dj)] = True
        way.append((i + di, j + dj))
        seen[way[-1]] = True
    return east, north


def _solid(
    is_wall: NDArray[np.bool_], x: FloatArray, y: FloatArray, heights: tuple[float, float, float], name: str
) -> SurfaceMesh:
    """Closed surface of blocks between lines, which stand on one bottom and have one of two heights."""
    columns, rows = is_wall.shape
    level = np.where(is_wall, 2, 1)
    quads: list[tuple[tuple[int, int, int], ...]] = []
    for i, j in itertools.product(range(columns), range(rows)):
        corners = ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1))
        quads.append(tuple((a, b, int(level[i, j])) for a, b in corners))
        quads.append(tuple((a, b, 0) for a, b in reversed(corners)))
        for side, (di, dj) in enumerate(DIRECTIONS):
            a, b = corners[(side + 1) % 4], corners[(side + 2) % 4]  # left to right seen from that side
            is_inside = 0 <= i + di < columns and 0 <= j + dj < rows
            low = int(level[i + di, j + dj]) if is_inside else 0
            if low < level[i, j]:
                quads.append(((*a, low), (*b, low), (*b, int(level[i, j])), (*a, int(level[i, j]))))
    number: dict[tuple[int, int, int], int] = {}
    triangles = []
    for quad in quads:
        first, second, third, fourth = (number.setdefault(corner, len(number)) for corner in quad)
        triangles += [(first, second, third), (first, third, fourth)]
    nodes = np.array([(x[i], y[j], heights[k]) for i, j, k in number])
    return SurfaceMesh(nodes, np.array(triangles, dtype=np.int32), name)


def _without_straights(line: FloatArray) -> FloatArray:
    """A way without corners at which it does not turn."""
    kept = [line[0]]
    for k in range(1, len(line)):
        if np.linalg.norm(line[k] - kept[-1]) <= _ASIDE:
            continue
        if len(kept) > 1:
            before, after = kept[-1] - kept[-2], line[k] - kept[-1]
            if abs(before[0] * after[1] - before[1] * after[0]) <= _ASIDE * float(np.linalg.norm(after)):
                kept.pop()
        kept.append(line[k])
    return np.array(kept)


def _count(value: Any, name: str) -> int:
    try:
        return checks.count(value, f"random maze: {name}", low=2, high=MOST_CELLS)
    except ValueError as error:
        raise MeshError(str(error)) from None
