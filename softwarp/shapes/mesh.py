"""Rigid solids bounded by triangles: checks, convexity, mass integrals, features, exact signed distance on the host."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp import checks, meshing
from softwarp.meshing import MeshError
from softwarp.meshing.nearest import closest, nearest
from softwarp.meshing.surfaces import winding
from softwarp.shapes.base import Features, FloatArray, IntArray, Kind, Shape, Solid

CONVEX = 1e-6  # volume missing to the convex hull, relative to it, up to which a mesh counts as convex
FLATNESS = 1e-6  # difference of normals, and of offsets relative to the extent, up to which triangles share a plane
SLIVER = 1e-9  # 2 area / (longest edge)^2 below which a triangle has no normal


@dataclass(frozen=True, eq=False)
class Mesh(Shape):
    """Solid bounded by closed, oriented triangles; a surface that is inward as a whole is turned over.

    Its features are all vertices, and the edges along which it protrudes by more than ``feature_angle``.

    Args:
        vertices: Positions [m], shape (v, 3), every one used.
        triangles: Corners, shape (t, 3), counter-clockwise from outside. A closed surface inside another one, and
            oriented against it, is a hollow.
        convex: Whether the solid is convex; None finds out.
        feature_angle: Angle between neighbouring faces above which the edge between them can touch [degree].
        name: What messages call the mesh.

    Raises:
        MeshError: On wrong arrays, positions that are not finite, unused vertices, triangles without area, an open,
            branching or badly oriented edge, or no volume.
        ValueError: If ``convex`` is claimed for a mesh that is not, or the angle is not between 0 and 180.
    """

    kind = Kind.MESH
    vertices: FloatArray
    triangles: IntArray
    convex: bool | None = None
    feature_angle: float = 5.0
    name: str = "mesh"

    def __post_init__(self) -> None:
        vertices, triangles = closed_surface(self.vertices, self.triangles, self.name)
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "triangles", triangles)
        checks.number(self.feature_angle, f"mesh {self.name!r}: feature_angle", above=0.0, below=180.0)
        if self.convex is not None:
            checks.flag(self.convex, f"mesh {self.name!r}: convex")
        missing = self._hollowness() if self.convex is not False else 1.0
        if self.convex is True and missing > CONVEX:
            raise ValueError(
                f"mesh {self.name!r}: is not convex, {100.0 * missing:.3g} % of its hull is empty; leave "
                f"convex=None, or use the hull: shapes.Mesh.hull(vertices)"
            )
        object.__setattr__(self, "convex", missing <= CONVEX)

    @classmethod
    def hull(cls, points: ArrayLike, *, name: str = "hull") -> Mesh:
        """Convex hull of points.

        Args:
            points: Positions [m], shape (p, 3), at least four that do not lie in one plane.
            name: What messages call the mesh.

        Raises:
            MeshError: If the points are not finite, too few, or span no volume.
        """
        from scipy.spatial import ConvexHull, QhullError

        x = checks.as_array(points)
        is_numeric = x.dtype.kind in "fiu" and x.ndim == 2 and x.shape[1] == 3 and len(x) >= 4
        x = x.astype(np.float64) if is_numeric else np.full((1, 3), np.nan)
        if not np.all(np.isfinite(x)):
            raise MeshError(f"mesh {name!r}: a hull needs at least 4 finite points of shape (p, 3) [m], got {x.shape}")
        try:
            found = ConvexHull(x)
        except QhullError as error:
            raise MeshError(
                f"mesh {name!r}: the {len(x)} points span no volume ({str(error).splitlines()[0]})"
            ) from error
        inward = np.einsum("ij,ij->i", _normals(x, found.simplices), found.equations[:, :3]) < 0.0
        triangles = np.where(inward[:, None], found.simplices[:, ::-1], found.simplices)
        vertices, corners = meshing.compact(x, triangles)
        return cls(vertices, corners, name=name)

    @property
    def size(self) -> tuple[float, float, float]:
        """Extents of the bounding box [m]."""
        x, y, z = (float(v) for v in np.ptp(self.vertices, axis=0))
        return (x, y, z)

    def _solid(self) -> Solid:
        return self._integrals

    @cached_property
    def _integrals(self) -> Solid:
        return solid_of(self.vertices, self.triangles)

    def _hollowness(self) -> float:
        """Part of the convex hull that the solid leaves empty."""
        from scipy.spatial import ConvexHull

        whole = float(ConvexHull(self.vertices).volume)
        return abs(whole - self.volume) / whole

    @cached_property
    def sheet(self) -> int:
        """A triangle that lies on another one which faces the other way, so that nothing is between; -1 for none."""
        return coincident(self.vertices, self.triangles)

    def distance(self, points: FloatArray) -> FloatArray:
        """Exact distance to the triangles."""
        return (
            signed_distance(self, points, float(np.ptp(points, axis=0).max()) / 8.0 or 1.0)
            if len(points)
            else np.zeros(0)
        )

    def features(self) -> Features:
        """All vertices, and the edges that protrude by more than ``feature_angle``."""
        ends, opposite = meshing.surface_edges(self.triangles)
        x, (i, j), (k, l) = self.vertices, ends.T, opposite.T  # noqa: E741 (triangles (i, j, k) and (j, i, l))
        first = _unit(np.cross(x[j] - x[i], x[k] - x[i]))
        second = _unit(np.cross(x[i] - x[j], x[l] - x[j]))
        angle = np.arctan2(np.linalg.norm(np.cross(first, second), axis=1), np.einsum("ij,ij->i", first, second))
        protrudes = np.einsum("ij,ij->i", first, x[l] - x[i]) < 0.0
        sharp = protrudes & (np.degrees(angle) > self.feature_angle)
        return Features.of(x, 0.0, x[ends[sharp]], 0.0)

    def surface(self, resolution: int = 32) -> tuple[FloatArray, IntArray]:
        """Its own triangles."""
        return self.vertices, self.triangles


def closed_surface(vertices: ArrayLike, triangles: ArrayLike, name: str) -> tuple[FloatArray, IntArray]:
    """Checked arrays of a closed surface, outward as a whole; hollows stay inward.

    Raises:
        MeshError: If the arrays are no closed and oriented surface around a volume, or a triangle has no area.
    """
    surface = meshing.SurfaceMesh(checks.as_array(vertices), checks.as_array(triangles), name)
    x, t = surface.nodes, surface.triangles
    corner = x[t]
    longest = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).max(axis=1)
    flat = np.flatnonzero(np.linalg.norm(_normals(x, t), axis=1) <= SLIVER * longest**2)
    if flat.size:
        raise MeshError(
            f"mesh {name!r}: {flat.size} of {len(t)} triangles have no area (first: triangle {flat[0]} with corners "
            f"{t[flat[0]].tolist()}); join coincident vertices with meshing.weld(vertices, triangles), or remesh"
        )
    part = meshing.surface_parts(t)
    inward = np.bincount(part, _cones(x, t)) < 0.0
    outward = np.where(inward[part][:, None], t[:, ::-1], t)
    outward = meshing.check_closed(x, outward, name=name)  # turned part by part, because it refuses hollows
    if inward.any() and not inward.all():
        outward = t if float(_cones(x, t).sum()) > 0.0 else t[:, ::-1]
        _check_hollows(x, outward, part, name)
    return x, np.ascontiguousarray(outward, dtype=np.int32)


def _check_hollows(x: FloatArray, t: NDArray[Any], part: IntArray, name: str) -> None:
    """Refuse an inward part that lies in no other one."""
    volume = np.bincount(part, _cones(x, t))
    for hollow in np.flatnonzero(volume < 0.0):
        first = int(np.flatnonzero(part == hollow)[0])
        if winding(x[t[first, 0]], x[t[part != hollow]]) < 0.5:
            raise MeshError(
                f"mesh {name!r}: the part with triangle {first} is inward ({volume[hollow]:.3g} m^3) and lies in no "
                f"other part, so it is no hollow; turn it over with triangles[:, ::-1]"
            )


def solid_of(vertices: FloatArray, triangles: NDArray[Any]) -> Solid:
    """Integrals over the solid inside closed outward triangles, by tetrahedra from its middle to every triangle."""
    bounds = np.stack([vertices.min(axis=0), vertices.max(axis=0)])
    middle = bounds.mean(axis=0)
    corner = (vertices - middle)[triangles]
    six_v = np.linalg.det(corner)
    volume = float(six_v.sum() / 6.0)
    total = corner.sum(axis=1)
    centre = six_v @ total / (24.0 * volume)
    second = np.einsum("t,tki,tkj->ij", six_v, corner, corner) + np.einsum("t,ti,tj->ij", six_v, total, total)
    return Solid(volume, middle + centre, second / 120.0 - volume * np.outer(centre, centre), bounds)


def coincident(x: FloatArray, t: IntArray) -> int:
    """The first triangle whose middle lies on a triangle that faces the other way, -1 for none.

    Only triangles of one plane are compared: the same normal, up to its sign, and the same offset, both rounded.
    """
    normal = _unit(_normals(x, t))
    largest = np.argmax(np.abs(normal), axis=1)
    side = np.sign(np.take_along_axis(normal, largest[:, None], 1)[:, 0])
    middle = x[t].mean(axis=1)
    size = float(np.ptp(x, axis=0).max())
    offset = np.einsum("ti,ti->t", normal, middle) * side / size
    plane = np.round(np.column_stack([normal * side[:, None], offset]) / FLATNESS)
    _, group = np.unique(plane, axis=0, return_inverse=True)
    group = group.reshape(-1)
    ups, downs = (np.bincount(group[side == sign], minlength=int(group.max()) + 1) for sign in (1.0, -1.0))
    for number in np.flatnonzero((ups > 0) & (downs > 0)):
        own = np.flatnonzero(group == number)
        up, down = own[side[own] > 0.0], own[side[own] < 0.0]
        for some, others in ((up, down), (down, up)):
            found, feature = closest(middle[some][:, None], x[t[others]][None])
            away = np.linalg.norm(found - middle[some][:, None], axis=2)
            on = ((feature == 6) & (away < FLATNESS * size)).any(axis=1)
            if on.any():
                return int(some[np.argmax(on)])
    return -1


def signed_distance(mesh: Mesh, points: FloatArray, cell: float) -> FloatArray:
    """Exact distance of points to a closed mesh, negative inside, shape (n,).

    The sign is that of the angle-weighted pseudonormal at the nearest point (Baerentzen and Aanaes, 2005).

    Args:
        mesh: The solid.
        points: Positions [m], shape (n, 3).
        cell: Edge [m] of the cubes in which points are handled; any positive value gives the same distances.
    """
    where, triangle, feature = nearest(mesh.vertices, mesh.triangles, points, cell)
    between = points - where
    side = np.einsum("ij,ij->i", between, pseudo_normals(mesh.vertices, mesh.triangles)[triangle, feature])
    return np.asarray(np.copysign(np.linalg.norm(between, axis=1), side))


def pseudo_normals(x: FloatArray, t: IntArray) -> FloatArray:
    """Normals that decide the sign at the corners of a triangle, at its edges (ab, bc, ca) and in it, (t, 7, 3)."""
    face = _unit(_normals(x, t))
    corner = x[t]
    ahead = _unit(np.roll(corner, -1, axis=1) - corner)
    behind = -np.roll(ahead, 1, axis=1)
    angle = np.arccos(np.clip(np.einsum("tki,tki->tk", ahead, behind), -1.0, 1.0))
    at_vertex = np.zeros_like(x)
    np.add.at(at_vertex, t.reshape(-1), (angle[:, :, None] * face[:, None]).reshape(-1, 3))
    start, end = t.reshape(-1).astype(np.int64), np.roll(t, -1, axis=1).reshape(-1).astype(np.int64)
    _, inverse = np.unique(np.minimum(start, end) * len(x) + np.maximum(start, end), return_inverse=True)
    at_edge = np.zeros((int(inverse.max()) + 1, 3))
    np.add.at(at_edge, inverse.reshape(-1), np.repeat(face, 3, axis=0))
    return np.concatenate([at_vertex[t], at_edge[inverse.reshape(-1, 3)], face[:, None]], axis=1)


def _cones(x: FloatArray, t: NDArray[Any]) -> FloatArray:
    """Signed volume between each triangle and the middle of all vertices [m^3], shape (t,)."""
    return np.asarray(np.linalg.det((x - x.mean(axis=0))[t]) / 6.0)


def _normals(x: FloatArray, t: NDArray[Any]) -> FloatArray:
    """Normals of twice the triangles' area [m^2], shape (t, 3)."""
    corner = x[t]
    return np.asarray(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]))


def _unit(v: FloatArray) -> FloatArray:
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))
