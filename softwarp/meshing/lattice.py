"""Own tetrahedral mesher: isosurface stuffing of a closed surface (Labelle and Shewchuk, 2007).

A body-centred cubic lattice has points A at whole and B at half numbers of cells. Between two neighbouring B and the
four A around them lie four tetrahedra, each with two long edges (A-A and B-B, one cell) and four short ones (A-B,
sqrt(3)/2 cells). Lines of the lattice in its seven directions are cut with the triangles, exactly: that tells which
points are inside and where edges leave the solid. Points next to a cut move onto it (warping); what remains of the
tetrahedra is filled by stencils. Angles between faces then stay above 10 degrees in a cubic lattice, whatever the
surface is, and all nodes of the boundary lie on the surface.

Reference: Labelle, Shewchuk (2007), Isosurface Stuffing: Fast Tetrahedral Meshes with Good Dihedral Angles.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softwarp.meshing.tets import FloatArray, compact, orient

Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]
Cut = Callable[[Ints, Ints], Ints]  # number of the node in which an edge is cut, from its ends

MEAN_EDGE = (2.0 + 2.0 * np.sqrt(3.0)) / 6.0  # mean edge of a tetrahedron in cells
WARP_LONG, WARP_SHORT = 0.24999, 0.41189  # part of an edge within which its end is moved onto the cut; of the paper
NUDGE = np.array([1.3e-7, 2.9e-7, 4.7e-7])  # cells; keeps lattice points off planes through them
CANDIDATES = 2_000_000  # pairs of triangle and line that are looked at together; bounds the memory


@dataclass(frozen=True)
class Lattice:
    """A lattice around a surface.

    Attributes:
        origin: Position of point (0, 0, 0) [m], shape (3,).
        cell: Edges of a cell [m], shape (3,).
        shape: Number of points A along each axis.
    """

    origin: FloatArray
    cell: FloatArray
    shape: tuple[int, int, int]

    @property
    def count(self) -> int:
        """Number of points."""
        return int(np.prod(self.shape) + np.prod(np.array(self.shape) - 1))


@dataclass(frozen=True)
class Crossings:
    """Where lines of one family meet triangles.

    Attributes:
        line: Whole numbers of the line, shape (crossing, 2).
        at: Position along it [cells], shape (crossing,); sorted within a line.
        sign: 1 where the line enters the solid, -1 where it leaves, shape (crossing,).
        triangle: The triangle, shape (crossing,).
    """

    line: Ints
    at: FloatArray
    sign: Ints
    triangle: Ints


@dataclass(frozen=True)
class Family:
    """Parallel lines: x' = axes @ x has the line's two numbers and the position along it.

    Attributes:
        axes: Rows that give the two numbers and the position, shape (3, 3).
        shift: Subtracted from all three, 0 or 1/2, so that lines have whole numbers.
        step: Distance of points along a line, in its position: 1 for long edges, 1/2 for short ones.
    """

    axes: FloatArray
    shift: float
    step: float


def families() -> list[Family]:
    """Lines along the three axes through points A, then through B, and along the four diagonals through both."""
    axes = [np.roll(np.eye(3), -turn - 1, axis=0) for turn in range(3)]  # (y, z, x), (z, x, y), (x, y, z)
    diagonals = [np.array([[1.0, 0.0, -p], [0.0, 1.0, -q], [0.0, 0.0, 1.0]]) for p in (1, -1) for q in (1, -1)]
    long = [Family(rows, shift, 1.0) for shift in (0.0, 0.5) for rows in axes]
    return long + [Family(rows, 0.0, 0.5) for rows in diagonals]


def lattice_around(low: FloatArray, high: FloatArray, edge_length: float) -> Lattice:
    """A lattice of about this mean edge whose planes fit the faces of the box, one cell wider on all sides."""
    extent, cell = high - low, edge_length / MEAN_EDGE
    cells = np.maximum(np.round(extent / cell), 1.0)
    fits = np.abs(extent / cells / cell - 1.0) < 0.18
    size = np.where(fits, extent / cells, cell)
    cells = np.where(fits, cells, np.ceil(extent / cell))
    origin = 0.5 * (low + high) - (0.5 * cells + 1.0) * size
    nx, ny, nz = (int(n) + 3 for n in cells)
    return Lattice(origin, size, (nx, ny, nz))


def in_cells(lattice: Lattice, points: FloatArray) -> FloatArray:
    """Positions in cells, nudged so that no lattice point lies on a plane of the surface."""
    return np.asarray((points - lattice.origin) / lattice.cell + NUDGE)


def in_metres(lattice: Lattice, points: FloatArray) -> FloatArray:
    """The way back from ``in_cells`` [m]."""
    return np.asarray((points - NUDGE) * lattice.cell + lattice.origin)


def crossings(family: Family, points: FloatArray, triangles: NDArray[np.int32]) -> Crossings:
    """All meetings of the family's lines with triangles.

    An edge is tested in one direction whichever of its triangles asks, so that a line hits one of the two and no line
    slips through between them.

    Args:
        family: The lines.
        points: Vertices [cells], shape (v, 3).
        triangles: Corners, outward, shape (t, 3).
    """
    local = points @ family.axes.T - family.shift
    corner = local[triangles]
    first = np.ceil(corner[:, :, :2].min(axis=1)).astype(np.int64)
    count = np.maximum(np.floor(corner[:, :, :2].max(axis=1)).astype(np.int64) - first + 1, 0)
    total = count.prod(axis=1)
    ends = np.cumsum(total)
    found: list[tuple[Ints, FloatArray, Ints, Ints]] = []
    start = 0
    while start < len(triangles):
        taken = ends[start - 1] if start else 0
        stop = max(int(np.searchsorted(ends, taken + CANDIDATES, side="right")), start + 1)
        some = np.arange(start, stop)[total[start:stop] > 0]
        triangle = np.repeat(some, total[some])
        rank = np.arange(len(triangle)) - np.repeat(np.cumsum(total[some]) - total[some], total[some])
        line = first[triangle] + np.stack(np.divmod(rank, count[triangle, 1]), axis=1)
        found.append(_hits(local, triangles, triangle, line))
        start = stop
    line, at, sign, triangle = (np.concatenate(column) for column in zip(*found, strict=True))
    order = np.lexsort((at, line[:, 1], line[:, 0]))
    return Crossings(line[order], at[order], sign[order], triangle[order])


def _hits(
    local: FloatArray, triangles: NDArray[np.int32], triangle: Ints, line: Ints
) -> tuple[Ints, FloatArray, Ints, Ints]:
    """Those of the pairs (triangle, line) that meet, and where."""
    weights = np.empty((len(triangle), 3))
    inside = np.ones((2, len(triangle)), dtype=bool)  # counter-clockwise, clockwise
    for k in range(3):
        a, b = triangles[triangle, (k + 1) % 3], triangles[triangle, (k + 2) % 3]
        turned = a > b
        one, two = local[np.where(turned, b, a), :2], local[np.where(turned, a, b), :2]
        side = (two[:, 0] - one[:, 0]) * (line[:, 1] - one[:, 1]) - (two[:, 1] - one[:, 1]) * (line[:, 0] - one[:, 0])
        left = (side >= 0.0) ^ turned  # a point on the edge lies left of it in the direction of rising numbers
        inside &= np.stack([left, ~left])
        weights[:, k] = np.where(turned, -side, side)
    area = weights.sum(axis=1)
    hit = (inside[0] | inside[1]) & (area != 0.0)
    weights, area, triangle, line = weights[hit], area[hit], triangle[hit], line[hit]
    at = np.einsum("nk,nk->n", weights, local[triangles[triangle], 2]) / area
    # The normal of a counter-clockwise triangle points along the line, which then leaves the solid.
    return line, at, np.where(area > 0.0, -1, 1), triangle


@dataclass
class _Cuts:
    """Edges that leave the solid: end inside, end outside, part of the way at which they do, whether they are long."""

    inner: Ints
    outer: Ints
    part: FloatArray
    is_long: Flags


def stuff(lattice: Lattice, met: list[Crossings]) -> tuple[FloatArray, NDArray[np.int32]]:
    """Fill a solid with tetrahedra.

    Args:
        lattice: Its points.
        met: ``crossings`` of all families, in their order.

    Returns:
        Nodes [m], shape (n, 3), and corners of positive volume, shape (t, 4); empty where no point is inside.
    """
    inside = _inside(lattice, met)
    points = _points(lattice)
    cuts = _cuts(lattice, met, inside)
    sign = np.where(np.concatenate([flags.ravel() for flags in inside]), 1, -1).astype(np.int8)
    cells = _lattice_tets(lattice, sign)
    if not len(cells):
        return np.zeros((0, 3)), np.zeros((0, 4), dtype=np.int32)
    cuts = _warp(points, sign, cuts)
    where = points[cuts.inner] + cuts.part[:, None] * (points[cuts.outer] - points[cuts.inner])
    filled = _fill(lattice, cells, sign, cuts, points, where)
    nodes, corners = compact(np.concatenate([points, where]), filled)
    nodes = in_metres(lattice, nodes)
    return nodes, orient(nodes, corners)


def _points(lattice: Lattice) -> FloatArray:
    """All points [cells]: A, then B; the last axis runs fastest."""
    grids = []
    for shift in (0, 1):
        axes = [np.arange(n - shift) + 0.5 * shift for n in lattice.shape]
        grids.append(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3))
    return np.concatenate(grids)


def _inside(lattice: Lattice, met: list[Crossings]) -> list[Flags]:
    """Whether points A and B lie in the solid: lines along x enter it once more than they leave it before."""
    result = []
    for shift, found in ((0, met[0]), (1, met[3])):
        nx, ny, nz = (n - shift for n in lattice.shape)
        change = np.zeros((nx + 1, ny, nz), dtype=np.int16)
        np.add.at(change, (np.ceil(found.at).astype(np.int64), found.line[:, 0], found.line[:, 1]), found.sign)
        result.append(np.cumsum(change[:-1], axis=0) > 0)
    return result


def _cuts(lattice: Lattice, met: list[Crossings], inside: list[Flags]) -> _Cuts:
    """All edges with one end inside; the cut is the first one seen from there."""
    parts = []
    number = _numbers(lattice)
    for index, (family, found) in enumerate(zip(families(), met, strict=True)):
        if index < 6:
            axis, kind = index % 3, index // 3
            ids = np.moveaxis(number[kind], axis, 0)
            flags = np.moveaxis(inside[kind], axis, 0)
            one, two, differ = ids[:-1], ids[1:], flags[:-1] != flags[1:]
            parts.append(_first(lattice, family, found, one[differ], two[differ], flags[:-1][differ], kind * 0.5))
            continue
        p, q = -family.axes[0, 2], -family.axes[1, 2]
        for upward in (True, False):  # from A to the B above it along the diagonal, and from B to the A above
            one, two, flag = _diagonal(number, inside, (p > 0.0, q > 0.0, True), upward)
            differ = flag[0] != flag[1]
            parts.append(_first(lattice, family, found, one[differ], two[differ], flag[0][differ], 0.0))
    inner, outer, part, is_long = (np.concatenate(column) for column in zip(*parts, strict=True))
    return _Cuts(inner, outer, part, is_long)


def _numbers(lattice: Lattice) -> list[Ints]:
    """Numbers of points A and B on their grids."""
    shape = np.array(lattice.shape)
    first = int(shape.prod())
    return [np.arange(first).reshape(shape), first + np.arange(int((shape - 1).prod())).reshape(shape - 1)]


def _diagonal(
    number: list[Ints], inside: list[Flags], ways: tuple[bool, bool, bool], upward: bool
) -> tuple[Ints, Ints, Flags]:
    """Lower and upper ends of all short edges of one direction, and whether they are inside, (2, ...).

    ``ways`` tells along which axes the direction rises, ``upward`` whether the edges go up from A or from B.
    """
    # The A beside a B along the direction (upward from A: the one it comes from) is at its low or its high side.
    low = [way if upward else not way for way in ways]
    pick = tuple(slice(None, -1) if at_low else slice(1, None) for at_low in low)
    a, b = number[0][pick], number[1]
    flags = [inside[0][pick], inside[1]]
    return (a, b, np.stack(flags)) if upward else (b, a, np.stack(flags[::-1]))


def _first(
    lattice: Lattice, family: Family, found: Crossings, one: Ints, two: Ints, rises: Flags, shift: float
) -> tuple[Ints, Ints, FloatArray, Flags]:
    """Where the edges from ``one`` up to ``two`` are cut, as seen from the end inside (``one`` where ``rises``)."""
    local = _place(lattice, one) @ family.axes.T - shift
    span = 4 * max(lattice.shape)  # lines of diagonals have negative numbers, too
    cell = np.floor(found.at / family.step).astype(np.int64)
    line = found.line + span
    key = (line[:, 0] * 4 * span + line[:, 1]) * 4 * span + cell
    mine = np.round(local[:, :2]).astype(np.int64) + span
    wanted = (mine[:, 0] * 4 * span + mine[:, 1]) * 4 * span + np.round(local[:, 2] / family.step).astype(np.int64)
    left, right = np.searchsorted(key, wanted, side="left"), np.searchsorted(key, wanted, side="right")
    hit = right > left
    index = np.minimum(np.where(rises, left, right - 1), len(key) - 1)
    part = np.where(hit, (found.at[index] - local[:, 2]) / family.step, 0.5)  # rounding apart, there is always a hit
    part = np.clip(np.where(rises, part, 1.0 - part), 0.0, 1.0)
    return np.where(rises, one, two), np.where(rises, two, one), part, np.full(len(one), family.step == 1.0)


def _place(lattice: Lattice, number: Ints) -> FloatArray:
    """Positions of points [cells] from their numbers."""
    shape = np.array(lattice.shape)
    is_b = number >= shape.prod()
    at_a = np.stack(np.unravel_index(np.where(is_b, 0, number), shape), axis=-1).astype(np.float64)
    at_b = np.stack(np.unravel_index(np.where(is_b, number - shape.prod(), 0), shape - 1), axis=-1) + 0.5
    return np.asarray(np.where(is_b[:, None], at_b, at_a))


def _lattice_tets(lattice: Lattice, sign: NDArray[np.int8]) -> Ints:
    """Tetrahedra with a point inside, shape (t, 4): B, B, A, A."""
    a, b = _numbers(lattice)
    found = []
    for axis in range(3):
        A, B = np.moveaxis(a, axis, 0)[1:-1], np.moveaxis(b, axis, 0)
        pair = np.stack([B[:-1], B[1:]], axis=-1)
        ring = np.stack([A[:, :-1, :-1], A[:, 1:, :-1], A[:, 1:, 1:], A[:, :-1, 1:]], axis=-1)
        some = (sign[pair] > 0).any(axis=-1) | (sign[ring] > 0).any(axis=-1)
        pair, ring = pair[some], ring[some]
        for k in range(4):
            found.append(np.column_stack([pair, ring[:, k], ring[:, (k + 1) % 4]]))
    tets = np.concatenate(found)
    return np.asarray(tets[(sign[tets] > 0).any(axis=1)])


def _warp(points: FloatArray, sign: NDArray[np.int8], cuts: _Cuts) -> _Cuts:
    """Move points onto the nearest cut that is too close to them, and return the cuts of edges that still have one."""
    reach = np.where(cuts.is_long, WARP_LONG, WARP_SHORT)
    length = np.where(cuts.is_long, 1.0, 0.5 * np.sqrt(3.0))
    vertex = np.concatenate([cuts.inner, cuts.outer])
    other = np.concatenate([cuts.outer, cuts.inner])
    part = np.concatenate([cuts.part, 1.0 - cuts.part])
    way = part * np.tile(length, 2)
    close = np.flatnonzero(part < np.tile(reach, 2))
    close = close[np.lexsort((way[close], vertex[close]))]
    moved, first = np.unique(vertex[close], return_index=True)
    best = close[first]
    target = points[moved] + part[best, None] * (points[other[best]] - points[moved])
    points[moved] = target
    sign[moved] = 0
    keep = (sign[cuts.inner] != 0) & (sign[cuts.outer] != 0)
    return _Cuts(cuts.inner[keep], cuts.outer[keep], cuts.part[keep], cuts.is_long[keep])


def _fill(
    lattice: Lattice, tets: Ints, sign: NDArray[np.int8], cuts: _Cuts, points: FloatArray, where: FloatArray
) -> Ints:
    """Cut the tetrahedra at the surface: corners of what lies inside."""
    total = lattice.count
    key = np.minimum(cuts.inner, cuts.outer) * total + np.maximum(cuts.inner, cuts.outer)
    order = np.argsort(key)
    key = key[order]

    def cut(a: Ints, b: Ints) -> Ints:
        """Number of the node in which an edge is cut."""
        return np.asarray(total + order[np.searchsorted(key, np.minimum(a, b) * total + np.maximum(a, b))])

    rank = np.argsort(-sign[tets], axis=1, kind="stable")
    tets = np.take_along_axis(tets, rank, axis=1)
    signs = sign[tets]
    plus, minus = (signs > 0).sum(axis=1), (signs < 0).sum(axis=1)
    is_a = _Sides(lattice)

    some = tets[(minus == 0) & (plus > 0)]
    result = [some]
    one = tets[(plus == 1) & (minus > 0)]
    for k in range(1, 4):
        outside = sign[one[:, k]] < 0
        one[outside, k] = cut(one[outside, 0], one[outside, k])
    result.append(one)
    result.append(_pyramids(tets[(plus == 2) & (minus == 1)], cut, is_a))
    result.append(_truncated(tets[(plus == 3) & (minus == 1)], cut, is_a))
    result.append(_wedges(tets[(plus == 2) & (minus == 2)], cut, is_a, np.concatenate([points, where])))
    return np.concatenate(result)


class _Sides:
    """Which corner of a quadrilateral between two points inside and the cuts below them its diagonal starts from."""

    def __init__(self, lattice: Lattice) -> None:
        self.shape = np.array(lattice.shape)
        self.first = int(self.shape.prod())

    def same(self, a: Ints, b: Ints) -> Flags:
        """Whether the edge between two points is a long one."""
        return np.asarray((a < self.first) == (b < self.first))

    def parity(self, a: Ints) -> Flags:
        """Whether the sum of the whole numbers of a point is even: ends of a long edge differ in this."""
        number, shape = np.where(a < self.first, a, a - self.first), self.shape
        inner = np.stack(np.unravel_index(np.where(a < self.first, number, 0), shape))
        middle = np.stack(np.unravel_index(np.where(a < self.first, 0, number), shape - 1))
        return np.asarray(np.where(a < self.first, inner.sum(axis=0), middle.sum(axis=0)) % 2 == 0)

    def from_first(self, p: Ints, q: Ints, n: Ints) -> Flags:
        """Whether the diagonal of the face (p, q, n), n outside, starts at p; the same for both tetrahedra beside it.

        It starts at the end of the long cut edge; where both are short, parity decides.
        """
        return np.where(self.same(p, q), self.parity(p), self.same(p, n))


def _pyramids(t: Ints, cut: Cut, sides: _Sides) -> Ints:
    """Two inside, one on the surface, one outside: a quadrilateral and the point on the surface."""
    p, q, z, n = t.T
    first = sides.from_first(p, q, n)
    p, q = np.where(first, p, q), np.where(first, q, p)
    cp, cq = cut(p, n), cut(q, n)
    return np.concatenate([np.column_stack([p, q, cq, z]), np.column_stack([p, cq, cp, z])])


def _truncated(t: Ints, cut: Cut, sides: _Sides) -> Ints:
    """Three inside, one outside: a tetrahedron without its tip; diagonals start at the end of the long cut edge."""
    n = t[:, 3]
    long = np.argmax(np.stack([sides.same(t[:, k], n) for k in range(3)], axis=1), axis=1)
    rows = np.arange(len(t))
    x, y, z = t[rows, long], t[rows, (long + 1) % 3], t[rows, (long + 2) % 3]
    even = sides.parity(y)
    y, z = np.where(even, y, z), np.where(even, z, y)
    cx, cy, cz = cut(x, n), cut(y, n), cut(z, n)
    return np.concatenate([np.column_stack(c) for c in ((x, y, z, cz), (x, y, cy, cz), (x, cx, cy, cz))])


def _wedges(t: Ints, cut: Cut, sides: _Sides, where: FloatArray) -> Ints:
    """Two inside, two outside: a wedge between the triangles a = (p, cuts of p) and b = (q, cuts of q)."""
    p, q, m, n = t.T
    straight = sides.same(p, q)
    # Straight: both faces' diagonals start at the same point. Crossed: m is the one behind p's long edge.
    turned = np.where(straight, ~sides.parity(p), False)
    p, q = np.where(turned, q, p), np.where(turned, p, q)
    swap = ~straight & ~sides.same(p, m)
    m, n = np.where(swap, n, m), np.where(swap, m, n)
    a0, a1, a2, b0, b1, b2 = p, cut(p, m), cut(p, n), q, cut(q, m), cut(q, n)
    across = np.linalg.norm(where[a1] - where[b2], axis=1) < np.linalg.norm(where[a2] - where[b1], axis=1)
    choices = (
        (straight & across, ((a0, b0, b1, b2), (a0, a1, b1, b2), (a0, a1, b2, a2))),
        (straight & ~across, ((a0, b0, b1, b2), (a0, a2, a1, b1), (a0, a2, b1, b2))),
        (~straight, ((a0, a1, a2, b1), (b0, b1, b2, a2), (a0, a2, b0, b1))),
    )
    pieces = [np.column_stack(corners)[mask] for mask, group in choices for corners in group]
    return np.concatenate(pieces)
