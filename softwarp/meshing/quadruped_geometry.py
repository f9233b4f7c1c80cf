"""The quadruped: a flat silicone body with four legs whose chambers, combs of thin slots, bend it upwards.

Frame: the base lies in z = 0, the origin in its middle; the robot looks along +x, so its front legs are those at
positive x and left is positive y. Its halves y > 0 and y < 0 are mirror images. Every chamber is a row of upright
slots, 0.5 mm thick, that a channel in their lower part joins; those of the front legs are fed from behind by channels
of their own. Dimensions [m] measured on the robot of SofaGym's MultiGait scene, whose x and y are ours negative: the
plan below is drawn in those axes, about the middle, and turned by half a turn in the end. Source and comparison:
assets/multi_gait/README.md.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp import checks
from softwarp.meshing.prisms import cut_prisms
from softwarp.meshing.resolutions import check_name
from softwarp.meshing.solid import CavityWall, SolidMesh
from softwarp.meshing.surfaces import voids
from softwarp.meshing.tets import FloatArray, IntArray, SurfaceMesh, compact, orient

HEIGHT = 0.0063
CHAMBER_BOTTOM, CHANNEL_TOP, CHAMBER_TOP = 0.0010, 0.0020, 0.0048  # heights
OUTLINE = ((0.02952, 0.0), (0.06785, 0.01782), (0.063695, 0.02925), (0.01479, 0.01612))  # x and y of a quarter
SLOT = 0.0005  # thickness

CENTRE_SLOTS, CENTRE_PITCH, CENTRE_X = 13, 0.0034, -0.02065  # count, from one to the next, x where the first begins
CENTRE_LENGTH = (0.0145, 0.0160, 0.0175, 0.0190, 0.0205)  # of the slots, from either end on
CENTRE_CHANNEL, CENTRE_END = 0.0015, 0.02435  # its width, and x where it ends behind the last slot

LEG_SLOTS, LEG_PITCH = 11, 0.00345
LEG_LENGTH, LEG_SHORTER = 0.0150, 0.0006  # of the slot next to the body, and how much shorter each further one is
LEG_CHANNEL = 0.0010  # its width
LEG_AXIS = math.radians(20.0)  # direction in which slots follow each other, against x
LEG_PLACE = (0.029635, 0.010395)  # middle of the near side of the first slot, of a rear leg

# Corners of the channel that feeds a front leg, on its two sides, from the leg on.
FEED = (
    ((-0.02946, 0.01087), (-0.02981, 0.00993)),
    ((-0.02440, 0.01262), (-0.02440, 0.01162)),
    ((0.02380, 0.01262), (0.02257, 0.01162)),
    ((0.02782, 0.00149), (0.02622, 0.00149)),
)

CHAMBERS = ("centre", "front_left", "front_right", "rear_left", "rear_right")


@dataclass(frozen=True)
class _Detail:
    """How finely a mesh is drawn.

    Attributes:
        row: Spacing of nodes along a slot of the middle comb [m].
        leg_row: Likewise, of a leg's.
        across: Intervals between two slots.
        feed: Intervals along the pieces of a feeding channel.
        border: Spacing of nodes along the outline [m].
        fill: Least distance of the further nodes between them [m].
        layers: Layers under the chambers, beside the channels, between these and the chambers' roof, and of the roof.
    """

    row: float
    leg_row: float
    across: int
    feed: tuple[int, int, int]
    border: float
    fill: float
    layers: tuple[int, int, int, int]


DETAILS = {
    "coarse": _Detail(0.0043, 0.0100, 1, (1, 22, 3), 0.0075, 0.0085, (1, 1, 1, 1)),
    "fine": _Detail(0.0017, 0.0017, 2, (3, 28, 5), 0.0022, 0.0018, (1, 1, 3, 2)),
}
ON_BASE = 1.0e-4  # height up to which a node is one of the base
SKIN_SPACING = 0.0110  # of the skin for contact
CLEAR = 0.6  # of the distance between filling nodes, from slots and channels


@dataclass(frozen=True)
class _Plan:
    """Half of the body, y >= 0, seen from above.

    Attributes:
        points: Nodes [m], shape (n, 2).
        triangles: Corners, shape (t, 3).
        is_slot: Whether a triangle belongs to a slot, (t,).
        is_channel: Whether it belongs to a channel between slots or to one that feeds a leg, (t,).
    """

    points: FloatArray
    triangles: IntArray
    is_slot: NDArray[np.bool_]
    is_channel: NDArray[np.bool_]


def quadruped(resolution: str = "coarse") -> SolidMesh:
    """The body with its chambers ``centre``, ``front_left``, ``front_right``, ``rear_left``, ``rear_right`` [m].

    Seen from above it is a triangulation whose edges follow every slot and channel, drawn up in layers. The mirror
    y = 0 maps the mesh to itself, tetrahedra included.

    Args:
        resolution: "coarse" (3182 nodes) or "fine" (15 377).

    Returns:
        The solid; ``add_cavity(body, solid.cavities["centre"])`` makes a chamber of the middle comb.

    Raises:
        MeshError: If the name is unknown.
    """
    check_name(resolution, DETAILS, "quadruped")
    return _solid(resolution)


@lru_cache(maxsize=len(DETAILS))
def _solid(resolution: str) -> SolidMesh:
    detail = DETAILS[resolution]
    plan = _plan(detail)
    nodes, tets = _drawn_up(plan, detail)
    nodes = nodes * [-1.0, -1.0, 1.0]
    tets = orient(nodes, tets)
    return SolidMesh(nodes, tets, f"quadruped {resolution}", cavities=_chambers(nodes, tets), wall=CHAMBER_BOTTOM)


def base_triangles(solid: SolidMesh) -> IntArray:
    """Faces of the base, nodes of the solid, shape (t, 3), seen from below."""
    triangles = solid.surface()
    return np.asarray(triangles[(solid.nodes[triangles, 2] < ON_BASE).all(axis=1)])


def quadruped_skin(spacing: float = SKIN_SPACING) -> SurfaceMesh:
    """What touches: the body's outer surface with few nodes, symmetric about y = 0 [m].

    Args:
        spacing: Distance between nodes [m], 1 mm to 1 m.

    Raises:
        ValueError: For another spacing.
    """
    spacing = checks.number(spacing, "quadruped_skin: spacing [m]", low=0.001, high=1.0)
    points, triangles = _whole(*_outline_mesh(spacing))
    count = len(points)
    nodes = np.concatenate([np.column_stack([points, np.full(count, z)]) for z in (0.0, HEIGHT)])
    flat = np.concatenate([triangles[:, ::-1], triangles + count])
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    there = {(int(a), int(b)) for a, b in edges}
    rim = np.array([edge for edge in edges if (int(edge[1]), int(edge[0])) not in there])
    a, b = rim.T
    sides = np.concatenate([np.column_stack([a, b, b + count]), np.column_stack([a, b + count, a + count])])
    return SurfaceMesh(nodes, np.concatenate([flat, sides]).astype(np.int32), "quadruped skin")


def _outline(spacing: float) -> FloatArray:
    """Nodes on the outline of the half y >= 0, from the notch at the front to the one behind, shape (n, 2)."""
    quarter = np.array(OUTLINE)
    corners = np.concatenate([quarter * [-1.0, 1.0], quarter[::-1]])
    parts = [_line(a, b, spacing)[:-1] for a, b in itertools.pairwise(corners)]
    return np.concatenate([*parts, corners[-1:]])


def _line(a: FloatArray, b: FloatArray, spacing: float) -> FloatArray:
    """Nodes from one point to another, both included, about evenly spaced."""
    parts = max(1, round(float(np.linalg.norm(b - a)) / spacing))
    share = np.arange(parts + 1)[:, None] / parts
    return np.asarray(a + share * (b - a))


def _rows(half: float, channel: float, spacing: float, *, one_sided: bool) -> FloatArray:
    """Places of nodes along a slot of some half length beside a channel of some half width."""
    parts = max(1, round((half - channel) / spacing))
    upper = np.linspace(channel, half, parts + 1)
    return np.concatenate([[0.0] if one_sided else -upper[::-1], upper])


@dataclass(frozen=True)
class _Combs:
    """Nodes of all slots and channels of the half, and the quadrangles that are hollow.

    Attributes:
        points: Nodes [m], shape (n, 2).
        slots: Corners of every slot [m], shape (slot, 4, 2).
        channels: Corners of every piece of a channel [m], shape (piece, 4, 2).
    """

    points: FloatArray
    slots: FloatArray
    channels: FloatArray


def _combs(detail: _Detail) -> _Combs:
    points: list[FloatArray] = []
    slots: list[FloatArray] = []
    channels: list[FloatArray] = []
    ends = [min(k, CENTRE_SLOTS - 1 - k, len(CENTRE_LENGTH) - 1) for k in range(CENTRE_SLOTS)]
    places = CENTRE_X + CENTRE_PITCH * np.arange(CENTRE_SLOTS)
    halves = np.array([0.5 * CENTRE_LENGTH[k] for k in ends])
    lists, across, half = (points, slots, channels), detail.across, 0.5 * CENTRE_CHANNEL
    _add_comb(*lists, detail.row, across, places, halves, half, np.eye(2), np.zeros(2), one_sided=True)
    last = float(places[-1]) + SLOT
    channels.append(_quad(last, CENTRE_END, 0.0, 0.5 * CENTRE_CHANNEL))
    points.append(np.array([[CENTRE_END, 0.0], [CENTRE_END, 0.5 * CENTRE_CHANNEL]]))

    places = LEG_PITCH * np.arange(LEG_SLOTS)
    halves = 0.5 * (LEG_LENGTH - LEG_SHORTER * np.arange(LEG_SLOTS))
    cos, sin = math.cos(LEG_AXIS), math.sin(LEG_AXIS)
    turn, place = np.array([[cos, sin], [-sin, cos]]), np.array(LEG_PLACE)
    for side in (-1.0, 1.0):
        mirror = np.array([side, 1.0])
        half = 0.5 * LEG_CHANNEL
        _add_comb(*lists, detail.leg_row, across, places, halves, half, turn * mirror, place * mirror)

    pairs = np.array(FEED)
    near = place * [-1.0, 1.0] + np.array([[0.5 * LEG_CHANNEL], [-0.5 * LEG_CHANNEL]]) * turn[1] * [-1.0, 1.0]
    pairs[0] = near  # exactly on the slot
    for a, b, parts in zip(pairs[:-1], pairs[1:], detail.feed, strict=True):
        share = np.arange(parts + 1)[:, None, None] / parts
        strip = a + share * (b - a)
        points.append(strip[1:].reshape(-1, 2))
        channels += [np.stack([p[0], q[0], q[1], p[1]]) for p, q in itertools.pairwise(strip)]
    return _Combs(np.concatenate(points), np.stack(slots), np.stack(channels))


def _add_comb(
    points: list[FloatArray],
    slots: list[FloatArray],
    channels: list[FloatArray],
    row: float,
    across: int,
    places: NDArray[np.floating[Any]],
    halves: NDArray[np.floating[Any]],
    channel: float,
    turn: FloatArray,
    origin: FloatArray,
    *,
    one_sided: bool = False,
) -> None:
    """Add a row of slots, drawn along its own first axis, and the channel through them."""
    low = 0.0 if one_sided else -channel
    for k, (place, half) in enumerate(zip(places, halves, strict=True)):
        bottom = 0.0 if one_sided else -half
        rows = _rows(half, channel, row, one_sided=one_sided)
        columns = [(place, rows), (place + SLOT, rows)]
        slots.append(_quad(place, place + SLOT, bottom, half) @ turn + origin)
        if k + 1 < len(places):
            channels.append(_quad(place + SLOT, places[k + 1], low, channel) @ turn + origin)
            other = _rows(halves[k + 1], channel, row, one_sided=one_sided)
            mean = 0.5 * (half + halves[k + 1])
            rows = rows if len(rows) <= len(other) else other
            scale = np.where(np.abs(rows) > channel, (mean - channel) / (np.abs(rows).max() - channel), 1.0)
            rows = np.sign(rows) * np.where(
                np.abs(rows) > channel, channel + (np.abs(rows) - channel) * scale, np.abs(rows)
            )
            share = np.arange(1, across) / across
            columns += [(place + SLOT + s * (places[k + 1] - place - SLOT), rows) for s in share]
        points += [np.column_stack([np.full(len(r), x), r]) @ turn + origin for x, r in columns]


def _quad(x0: float, x1: float, y0: float, y1: float) -> FloatArray:
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def _plan(detail: _Detail) -> _Plan:
    """Triangulate the half and tell what is hollow."""
    combs, border = _combs(detail), _outline(detail.border)
    points = _filled(np.concatenate([combs.points, border]), border, detail.fill, _samples(combs))
    triangles = _triangulated(points, border)
    middle = points[triangles].mean(axis=1)
    is_slot = _within_any(middle, combs.slots)
    is_channel = ~is_slot & _within_any(middle, combs.channels)
    return _Plan(points, triangles, is_slot, is_channel)


def _outline_mesh(spacing: float) -> tuple[FloatArray, IntArray]:
    """Nodes and triangles of the half without chambers."""
    border = _outline(spacing)
    points = _filled(border, border, 0.9 * spacing, border)
    return points, _triangulated(points, border)


def _samples(combs: _Combs) -> FloatArray:
    """Points all over slots and channels, as dense as a slot is thick, shape (n, 2)."""
    share = (np.arange(32) + 0.5) / 32.0
    found = []
    for a, b, c, d in np.concatenate([combs.slots, combs.channels]):
        found += [
            0.5 * (a + b) + share[:, None] * 0.5 * (c + d - a - b),
            0.5 * (a + d) + share[:, None] * 0.5 * (b + c - a - d),
        ]
    return np.concatenate(found)


def _filled(points: FloatArray, border: FloatArray, apart: float, hollow: FloatArray) -> FloatArray:
    """Add nodes on y = 0 and inside, on a lattice of triangles, where neither a node nor what is hollow is near."""
    from scipy.spatial import cKDTree

    reach = OUTLINE[0][0]
    count = round(2.0 * reach / apart)
    on_axis = np.column_stack([reach * (2.0 * np.arange(count + 1) / count - 1.0), np.zeros(count + 1)])
    far, wide = np.abs(border).max(axis=0)
    rise = 0.5 * math.sqrt(3.0) * apart
    lattice = [on_axis]
    for k in range(1, int(wide / rise) + 1):
        half = int(far / apart) + 1
        x = apart * (np.arange(-half, half + 1) + 0.5 * (k % 2))
        lattice.append(np.column_stack([x, np.full(len(x), k * rise)]))
    wanted = np.concatenate(lattice)
    wanted = wanted[_inside(wanted + [0.0, 1.0e-9], border)]
    near = (cKDTree(points).query(wanted)[0] < 0.8 * apart) | (cKDTree(hollow).query(wanted)[0] < CLEAR * apart)
    return np.concatenate([points, wanted[~near]])


def _triangulated(points: FloatArray, border: FloatArray) -> IntArray:
    """Delaunay triangles inside the outline, counter-clockwise."""
    from scipy.spatial import Delaunay

    triangles = Delaunay(points).simplices
    a, b, c = points[triangles].transpose(1, 0, 2)
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    triangles = np.where((area > 0.0)[:, None], triangles, triangles[:, ::-1])
    keep = (np.abs(area) > 1.0e-12) & _inside(points[triangles].mean(axis=1), border)
    return np.asarray(triangles[keep], dtype=np.int32)


def _inside(points: FloatArray, polygon: FloatArray) -> NDArray[np.bool_]:
    """Whether points lie in a polygon: a ray along x leaves it once more than it enters."""
    a, b = polygon, np.roll(polygon, -1, axis=0)
    x, y = points[:, None, 0], points[:, None, 1]
    crosses = (a[:, 1] > y) != (b[:, 1] > y)
    rise = np.where(b[:, 1] == a[:, 1], 1.0, b[:, 1] - a[:, 1])
    at = a[:, 0] + (y - a[:, 1]) / rise * (b[:, 0] - a[:, 0])
    return np.asarray((crosses & (at > x)).sum(axis=1) % 2 == 1)


def _within_any(points: FloatArray, quads: FloatArray) -> NDArray[np.bool_]:
    found = np.zeros(len(points), dtype=bool)
    for quad in quads:
        found |= _inside(points, quad)
    return found


def _whole(points: FloatArray, triangles: IntArray) -> tuple[FloatArray, IntArray]:
    """Both halves: nodes of the given one, then the mirror images of those that have y > 0."""
    image = _images(points)
    mirrored = points[points[:, 1] > 0.0] * [1.0, -1.0]
    return np.concatenate([points, mirrored]), np.concatenate([triangles, image[triangles][:, ::-1]])


def _images(points: FloatArray) -> IntArray:
    """Number of every node's mirror image in the whole."""
    is_off = points[:, 1] > 0.0
    image = np.arange(len(points))
    image[is_off] = len(points) + np.arange(int(is_off.sum()))
    return image.astype(np.int32)


def _drawn_up(plan: _Plan, detail: _Detail) -> tuple[FloatArray, IntArray]:
    """Layers of prisms above the plan, cut into tetrahedra, without the hollow ones."""
    points, triangles = _whole(plan.points, plan.triangles)
    count = len(points)
    rank = np.concatenate([np.arange(len(plan.points)), np.flatnonzero(plan.points[:, 1] > 0.0)])
    is_slot, is_channel = np.tile(plan.is_slot, 2), np.tile(plan.is_channel, 2)
    heights, hollow = _levels(detail, is_slot, is_channel)
    levels = np.arange(count)[None, :] + count * np.arange(len(heights))[:, None]
    if detail.layers[1] == 1:  # the top of the channels is a level of their own nodes only
        level, is_beside = detail.layers[0] + 1, np.ones(count, dtype=bool)
        is_beside[triangles[is_channel]] = False
        levels[level, is_beside] = levels[level - 1, is_beside]
    nodes = np.concatenate([np.column_stack([points, np.full(count, z)]) for z in heights])
    tets = []
    for k, is_hollow in enumerate(hollow):
        tets.append(
            cut_prisms(triangles[~is_hollow].astype(np.int64), rank, np.concatenate([levels[k], levels[k + 1]]))
        )
    every = np.concatenate(tets)
    ordered = np.sort(every, axis=1)
    nodes, every = compact(nodes, every[(np.diff(ordered, axis=1) > 0).all(axis=1)])
    return nodes, every


def _levels(
    detail: _Detail, is_slot: NDArray[np.bool_], is_channel: NDArray[np.bool_]
) -> tuple[FloatArray, list[NDArray[np.bool_]]]:
    """Heights of the layers' bounds [m], and for every layer which of its prisms are hollow."""
    bounds = (0.0, CHAMBER_BOTTOM, CHANNEL_TOP, CHAMBER_TOP, HEIGHT)
    kinds = (np.zeros_like(is_slot), is_slot | is_channel, is_slot, np.zeros_like(is_slot))
    heights, hollow = [0.0], []
    for low, high, parts, kind in zip(bounds[:-1], bounds[1:], detail.layers, kinds, strict=True):
        heights += np.linspace(low, high, parts + 1)[1:].tolist()
        hollow += [kind] * parts
    return np.array(heights), hollow


def _chambers(nodes: FloatArray, tets: IntArray) -> dict[str, CavityWall]:
    """Walls of the chambers by name."""
    found: dict[str, CavityWall] = {}
    for triangles in voids(nodes, tets):
        vertices, corners = compact(nodes, triangles)
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        name = "centre"
        if low[1] * high[1] > 0.0:
            end = "front" if high[0] > OUTLINE[0][0] else "rear"
            name = f"{end}_{'left' if low[1] > 0.0 else 'right'}"
        found[name] = CavityWall(vertices, corners, name, np.unique(triangles).astype(np.int32))
    return {name: found[name] for name in CHAMBERS}
