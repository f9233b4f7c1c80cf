"""Walls around a lumen: vessels and cavities of the body that instruments move in, from meshes or from centre lines."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp import checks, meshing, notices
from softwarp.meshing import MeshError
from softwarp.meshing.nearest import nearest
from softwarp.meshing.surfaces import winding
from softwarp.shapes.base import Features, FloatArray, IntArray, positive
from softwarp.shapes.grid import BLOCK, LARGEST, MARGIN, SDF, coarser, zero_level
from softwarp.shapes.mesh import pseudo_normals

WALL = 4.0  # spacings that a wall is thick unless told
PROBES = 64  # triangles that tell on which side of a surface the lumen lies
AT_ONCE = 20_000  # nodes between two looks at the clock
FAR = 1.0e3  # spacings: distance that stands for those that nothing needs


@dataclass(frozen=True, eq=False)
class Vessel(SDF):
    """Wall of a lumen as a solid, by samples of its signed distance; made by ``from_mesh`` and ``from_tubes``.

    What moves inside touches it from inside. The wall is open where the surface is: there one can leave.

    Args:
        values: Signed distance of the wall at the nodes [m], positive in the lumen.
        spacing: Distance between nodes [m].
        origin: Position of node (0, 0, 0) [m].
        mesh: None.
        inner: Vertices [m] and triangles of the inner surface, for pictures, perhaps with fewer triangles than it has.
    """

    inner: tuple[FloatArray, IntArray] | None = None

    @classmethod
    def from_mesh(  # type: ignore[override]
        cls,
        vertices: ArrayLike,
        triangles: ArrayLike,
        spacing: float,
        *,
        wall: float | None = None,
        name: str = "vessel",
    ) -> Vessel:
        """Wall outside a surface that encloses a lumen, closed or with open ends.

        On which side the lumen lies is found by winding numbers (Jacobson, Kavan, Sorkine-Hornung, 2013), whichever way
        the triangles are oriented, as long as neighbours agree.

        Args:
            vertices: Positions [m], shape (v, 3).
            triangles: Corners, shape (t, 3).
            spacing: Distance between nodes [m]; a fifth of the smallest lumen or less.
            wall: Thickness of the wall [m]; None takes four spacings. Less than what lies between two lumens, but more
                than twice what instruments penetrate: beyond its middle they are pushed out on the other side. Stiff
                ones that move fast want a diameter of the lumen.
            name: What messages call the shape.

        Raises:
            MeshError: For arrays that are no surface, triangles without area or that face another way than their
                neighbours, and a surface that encloses nothing.
            ValueError: If spacing or wall is not positive, the spacing is too large for the surface, or the grid would
                have more than 2^27 nodes.
        """
        what = f"vessel {name!r}"
        surface = meshing.SurfaceMesh(checks.as_array(vertices), checks.as_array(triangles), name)
        x, t = surface.nodes, np.asarray(surface.triangles)
        spacing = positive(what, "spacing", spacing)
        thick = WALL * spacing if wall is None else positive(what, "wall", wall)
        t = _lumen_behind(x, t, spacing, what)
        axes, origin = _axes(x.min(axis=0), x.max(axis=0), thick + MARGIN * spacing, spacing, what)
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        near = _near(x, t, axes, thick + 2.0 * spacing)
        values = np.full(len(nodes), FAR * spacing)
        normals, rims, line = pseudo_normals(x, t), _rims(t), notices.Progress()
        for some in np.array_split(near, max(len(near) // AT_ONCE, 1)):
            line.show(what, f"distances from {len(t)} triangles, node {some[0] if len(some) else 0} of {len(nodes)}")
            where, triangle, feature = nearest(x, t, nodes[some], BLOCK * spacing)
            between = nodes[some] - where
            away = np.linalg.norm(between, axis=1)
            outside = np.einsum("ij,ij->i", between, normals[triangle, feature]) > 0.0
            outside &= ~rims[triangle, feature]
            values[some] = np.where(outside, np.abs(away - 0.5 * thick) - 0.5 * thick, away)
        line.end()
        shape = (len(axes[0]), len(axes[1]), len(axes[2]))
        is_far = np.ones(len(nodes), dtype=bool)
        is_far[near] = False
        filled = _filled(values.reshape(shape), is_far.reshape(shape), spacing)
        try:
            return cls(filled, spacing, origin, None, (x, t.astype(np.int32)))
        except ValueError as error:
            advice = "take a smaller spacing, a few to the radius of the lumen"
            raise ValueError(
                f"{what}: a spacing of {spacing:g} m does not show this surface: {error}; {advice}"
            ) from None

    @classmethod
    def from_tubes(
        cls,
        tubes: Sequence[tuple[ArrayLike, ArrayLike]],
        spacing: float,
        *,
        wall: float | None = None,
        name: str = "vessel",
    ) -> Vessel:
        """Wall around the union of round tubes with varying radius.

        Args:
            tubes: Centre line [m], (n, 3), and radius [m], a number or (n,), of each. The first is open at both ends,
                the others, which begin inside it or in one another, at their last point.
            spacing: Distance between nodes [m].
            wall: Thickness of the wall [m], as of ``from_mesh``; None takes four spacings.
            name: What messages call the shape.

        Raises:
            ValueError: For lines with fewer than two points, numbers that are not finite, and a radius of less than two
                spacings.
        """
        what = f"vessel {name!r}"
        spacing = positive(what, "spacing", spacing)
        thick = WALL * spacing if wall is None else positive(what, "wall", wall)
        given = list(tubes) if isinstance(tubes, Iterable) else []
        if not given or not all(isinstance(tube, (tuple, list)) and len(tube) == 2 for tube in given):
            need = "be one pair (points, radius) or more"
            raise ValueError(checks.refusal(f"{what}: tubes", need, tubes, "give at least one tube"))
        lines = [_line(points, radius, spacing, f"{what}: tube {k}") for k, (points, radius) in enumerate(given)]
        reach = np.concatenate([np.stack([x - r[:, None], x + r[:, None]]) for x, r in lines], axis=1)
        low, high = reach[0].min(axis=0), reach[1].max(axis=0)
        axes, origin = _axes(low, high, thick + MARGIN * spacing, spacing, what)
        shape = (len(axes[0]), len(axes[1]), len(axes[2]))
        inside, rim = np.full(shape, FAR * spacing), np.full(shape, np.nan)
        for number, (x, r) in enumerate(lines):
            for k in range(len(x) - 1):
                ends = (k == 0 and number == 0, k == len(x) - 2)
                _join(inside, rim, axes, (x[k : k + 2], r[k : k + 2]), ends, thick + 2.0 * spacing)
        wall_values = np.where(inside < 0.0, -inside, np.abs(inside - 0.5 * thick) - 0.5 * thick)
        wall_values = np.where(np.isnan(rim), wall_values, rim)
        drawn, corner = zero_level(np.where(inside < FAR * spacing, inside, spacing))
        drawn = drawn * spacing + np.array(origin)
        centre = drawn[corner].mean(axis=1)
        keep = ~_beyond(centre, lines)
        return cls(wall_values, spacing, origin, None, (drawn, corner[keep]))

    def cut_open(self, towards: ArrayLike) -> Vessel:
        """The same wall, drawn without the parts whose outer side faces a direction, so that one can look into it."""
        if self.inner is None:
            return self
        x, t = self.inner
        corner = x[t]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        seen = normal @ checks.array(towards, "vessel: direction", (3,)) <= 0.0
        return Vessel(self.values, self.spacing, self.origin, None, (x, t[seen]))

    def clearance(self, points: ArrayLike) -> FloatArray:
        """Distance of points in the lumen from the wall [m], negative in the wall, shape (n,)."""
        return self.distance(np.asarray(points, dtype=np.float64).reshape(-1, 3))

    def features(self) -> Features:
        """None: what is inside touches a hollow wall with its own points and edges."""
        return Features.of(np.zeros((0, 3)))

    def surface(self, resolution: int = 32) -> tuple[FloatArray, IntArray]:
        """The inner surface, as far as it is drawn."""
        return self.inner if self.inner is not None else self._level

    @cached_property
    def bounds(self) -> FloatArray:
        """Corners of the grid [m], (2, 3): the wall fills it up to a margin."""
        origin = np.array(self.origin)
        return np.stack([origin, origin + self.spacing * (np.array(self.values.shape) - 1)])


def _line(points: ArrayLike, radius: ArrayLike, spacing: float, what: str) -> tuple[FloatArray, FloatArray]:
    """Checked centre line and radii."""
    x = checks.as_array(points)
    if x.dtype.kind not in "fiu" or x.ndim != 2 or x.shape[1] != 3 or len(x) < 2 or not np.isfinite(x).all():
        raise ValueError(checks.refusal(f"{what}: points", "be finite numbers of shape (n, 3), n >= 2", points))
    r = checks.array(radius, f"{what}: radius [m]", (), (len(x),), above=2.0 * spacing)
    return x.astype(np.float64), np.broadcast_to(r, (len(x),)).astype(np.float64)


def _axes(
    low: FloatArray, high: FloatArray, margin: float, spacing: float, what: str
) -> tuple[list[FloatArray], tuple[float, float, float]]:
    """Coordinates of the nodes of a grid along its axes, and its origin."""
    cells = np.ceil((high - low + 2.0 * margin) / spacing)
    if np.prod(cells + 1.0) > LARGEST:
        raise ValueError(
            f"{what}: a spacing of {spacing:g} m makes a grid of {' x '.join(f'{c + 1:.0f}' for c in cells)} nodes, "
            f"more than {LARGEST}; use a spacing of {coarser(high - low + 2.0 * margin):.2g} m or more"
        )
    origin = 0.5 * (low + high) - 0.5 * spacing * cells
    x, y, z = (float(c) for c in origin)
    return [origin[c] + spacing * np.arange(int(cells[c]) + 1) for c in range(3)], (x, y, z)


def _near(x: FloatArray, t: NDArray[Any], axes: list[FloatArray], reach: float) -> NDArray[np.int64]:
    """Nodes of a grid that lie within the boxes of triangles, widened by a distance."""
    shape = tuple(len(axis) for axis in axes)
    found = np.zeros(shape, dtype=bool)
    low, high = x[t].min(axis=1) - reach, x[t].max(axis=1) + reach
    first = np.stack([np.searchsorted(axis, low[:, c]) for c, axis in enumerate(axes)], axis=1)
    last = np.stack([np.searchsorted(axis, high[:, c], side="right") for c, axis in enumerate(axes)], axis=1)
    for a, b in zip(first, last, strict=True):
        found[a[0] : b[0], a[1] : b[1], a[2] : b[2]] = True
    return np.flatnonzero(found.reshape(-1))


def _filled(values: FloatArray, is_far: NDArray[np.bool_], spacing: float) -> FloatArray:
    """Distances of far nodes: to the nearest node whose own is known, and from there."""
    from scipy.ndimage import distance_transform_edt

    way, index = distance_transform_edt(is_far, return_indices=True)
    return np.where(is_far, np.abs(values[tuple(index)]) + spacing * way, values)


def _lumen_behind(x: FloatArray, t: NDArray[Any], spacing: float, what: str) -> NDArray[Any]:
    """Triangles that have the lumen behind them, turned over if need be."""
    corner = x[t]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    size = np.linalg.norm(normal, axis=1)
    flat = np.flatnonzero(size <= 1e-9 * np.linalg.norm(np.ptp(corner, axis=1), axis=1) ** 2)
    if flat.size:
        raise MeshError(
            f"{what}: {flat.size} of {len(t)} triangles have no area (first: triangle {flat[0]} with corners "
            f"{t[flat[0]].tolist()}); join coincident vertices with meshing.weld(vertices, triangles), or remesh"
        )
    _check_neighbours(t, what)
    some = np.linspace(0, len(t) - 1, min(PROBES, len(t))).astype(int)
    votes = 0.0
    for k in some:
        step = 0.5 * spacing * normal[k] / size[k]
        ahead, behind = (abs(float(winding(corner[k].mean(axis=0) + sign * step, corner))) for sign in (1.0, -1.0))
        votes += float(np.sign(behind - ahead))
    if abs(votes) < 0.5 * len(some):
        raise MeshError(
            f"{what}: the surface encloses no lumen, or its triangles do not agree on their orientation; orient them "
            "alike, and close holes but the ends"
        )
    return t if votes > 0.0 else t[:, ::-1]


def _check_neighbours(t: NDArray[Any], what: str) -> None:
    """Refuse triangles that face another way than their neighbour: the wall would lie inside the lumen there."""
    start, end = t.reshape(-1).astype(np.int64), np.roll(t, -1, axis=1).reshape(-1).astype(np.int64)
    span = int(t.max()) + 1
    _, edge, count = np.unique(
        np.minimum(start, end) * span + np.maximum(start, end), return_inverse=True, return_counts=True
    )
    _, way, same = np.unique(start * span + end, return_inverse=True, return_counts=True)
    clash = np.flatnonzero((count[edge.reshape(-1)] == 2) & (same[way.reshape(-1)] == 2))
    if clash.size:
        one = int(clash[0])
        raise MeshError(
            f"{what}: triangle {one // 3} faces another way than its neighbour along edge {start[one]}-{end[one]} "
            f"({clash.size // 2} such edges); use meshing.orient_surface(triangles)"
        )


def _rims(t: NDArray[Any]) -> NDArray[np.bool_]:
    """Corners and edges (ab, bc, ca) of triangles that lie on an open rim, and their insides, which do not, (t, 7)."""
    start, end = t.astype(np.int64), np.roll(t, -1, axis=1).astype(np.int64)
    key = np.minimum(start, end) * (int(t.max()) + 1) + np.maximum(start, end)
    _, inverse, count = np.unique(key, return_inverse=True, return_counts=True)
    edge = (count == 1)[inverse.reshape(t.shape)]
    at_rim = np.zeros(int(t.max()) + 1, dtype=bool)
    at_rim[start[edge]] = at_rim[end[edge]] = True
    return np.concatenate([at_rim[t], edge, np.zeros((len(t), 1), dtype=bool)], axis=1)


def _join(
    inside: FloatArray,
    rim: FloatArray,
    axes: list[FloatArray],
    piece: tuple[FloatArray, FloatArray],
    ends: tuple[bool, bool],
    reach: float,
) -> None:
    """Join a piece of a tube to the signed distance of a lumen; beyond its open ends note how far their rims are."""
    x, r = piece
    low, high = (x - r[:, None]).min(axis=0) - reach, (x + r[:, None]).max(axis=0) + reach
    box = tuple(
        slice(int(np.searchsorted(axis, low[c])), int(np.searchsorted(axis, high[c], side="right")))
        for c, axis in enumerate(axes)
    )
    p = np.stack(np.meshgrid(*(axis[part] for axis, part in zip(axes, box, strict=True)), indexing="ij"), axis=-1)
    along = x[1] - x[0]
    place = (p - x[0]) @ along / (along @ along)
    t = np.clip(place, 0.0, 1.0)
    away = np.linalg.norm(p - x[0] - t[..., None] * along, axis=-1)
    distance = away - (r[0] + t * (r[1] - r[0]))
    nearer = distance < inside[box]
    beyond = (ends[0] & (place < 0.0)) | (ends[1] & (place > 1.0))
    ahead = np.abs(place - t) * np.linalg.norm(along)
    across = np.sqrt(np.maximum(away**2 - ahead**2, 0.0)) - np.where(place < 0.0, r[0], r[1])
    inside[box] = np.where(nearer, distance, inside[box])
    rim[box] = np.where(nearer, np.where(beyond, np.hypot(ahead, across), np.nan), rim[box])


def _beyond(points: FloatArray, lines: Sequence[tuple[FloatArray, FloatArray]]) -> NDArray[np.bool_]:
    """Whether points lie in the round caps beyond the open ends of tubes."""
    found = np.zeros(len(points), dtype=bool)
    for number, (x, r) in enumerate(lines):
        tips = [(x[-1], x[-1] - x[-2], r[-1])] + ([(x[0], x[0] - x[1], r[0])] if number == 0 else [])
        for tip, out, radius in tips:
            ahead = (points - tip) @ (out / np.linalg.norm(out))
            found |= (ahead > 0.0) & (np.linalg.norm(points - tip, axis=1) < 1.2 * radius)
    return found
