"""Lumina of vessels and cavities: a centre line with elliptical sections, its open surface, and the way along it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp import checks
from softwarp.meshing.tets import MeshError, SurfaceMesh

FloatArray = NDArray[np.float64]
AROUND = 32  # points around a section


@dataclass(frozen=True, eq=False)
class Lumen:
    """A lumen along a line of points; its sections are ellipses across the line.

    Args:
        points: Centre line [m], (n, 3), two neighbours apart.
        radius: Semi-axes of the sections [m]: a number or (n,) for circles, (n, 2) for ellipses.
        across: Direction nearest to which the first semi-axis lies; only ellipses need it.
        name: What messages call it.

    Raises:
        MeshError: For points that coincide, radii that are not positive, and an axis along the line or zero.
        ValueError: For a name that is no text.
    """

    points: FloatArray
    radius: FloatArray
    across: tuple[float, float, float] = (1.0, 0.0, 0.0)
    name: str = "lumen"

    def __post_init__(self) -> None:
        """Check and bring to shape."""
        object.__setattr__(self, "name", checks.label(self.name, "lumen"))
        what = f"lumen {self.name!r}"
        x = checks.as_array(self.points)
        if x.dtype.kind not in "fiu" or x.ndim != 2 or x.shape[1] != 3 or len(x) < 2 or not np.isfinite(x).all():
            raise MeshError(checks.refusal(f"{what}: points", "be finite numbers (n, 3), n >= 2", self.points))
        need = f"be positive numbers, one, ({len(x)},) or ({len(x)}, 2)"
        shapes = (), (len(x),), (len(x), 2)
        try:
            r = checks.array(self.radius, f"{what}: radius [m]", *shapes, above=0.0, high=checks.FARTHEST, need=need)
            across = checks.array(self.across, f"{what}: across", (3,))
        except ValueError as error:
            raise MeshError(str(error)) from None
        if not across.any():
            raise MeshError(checks.refusal(f"{what}: across", "be a direction, not zero", self.across))
        if r.ndim < 2:
            r = np.repeat(np.broadcast_to(r, (len(x),))[:, None], 2, axis=1)
        object.__setattr__(self, "points", x.astype(np.float64))
        object.__setattr__(self, "radius", r)
        steps = np.linalg.norm(np.diff(self.points, axis=0), axis=1)
        if (steps <= 1.0e-9 * max(float(steps.sum()), 1.0e-9)).any():
            raise MeshError(
                f"{what}: points {int(steps.argmin())} and {int(steps.argmin()) + 1} coincide; leave one out"
            )
        if not self.is_round:
            along = np.abs(self.tangents @ across) / np.linalg.norm(across)
            if (along > 0.999).any():
                k = int(along.argmax())
                raise MeshError(f"{what}: across must not lie along the line, got {self.across!r} at point {k}")

    @classmethod
    def through(
        cls, points: ArrayLike, radius: ArrayLike, spacing: float, *, name: str = "lumen", **options: Any
    ) -> Lumen:
        """A smooth lumen through a few places: cubic splines of points and radii over the length of their chords.

        Args:
            points: Places of the centre line [m], (k, 3), k >= 2.
            radius: Semi-axes there [m], as of ``Lumen``.
            spacing: Distance of points of the line [m], about.
            name: What messages call it.
            **options: Of ``Lumen``.
        """
        from scipy.interpolate import CubicSpline, PchipInterpolator

        rough = cls(np.asarray(points), np.asarray(radius), name=name, **options)
        spacing = checks.number(spacing, f"lumen {name!r}: spacing [m]", above=0.0)
        line, widths = CubicSpline(rough.arc, rough.points), PchipInterpolator(rough.arc, rough.radius)
        dense = np.linspace(0.0, rough.length, max(20 * len(rough.points), 200))
        way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line(dense), axis=0), axis=1))])
        place = np.interp(np.linspace(0.0, way[-1], max(round(way[-1] / spacing), 2) + 1), way, dense)
        return cls(line(place), widths(place), name=name, **options)

    @cached_property
    def arc(self) -> FloatArray:
        """Length of the line up to each point [m], (n,)."""
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.points, axis=0), axis=1))])

    @property
    def length(self) -> float:
        """Length of the line [m]."""
        return float(self.arc[-1])

    @cached_property
    def tangents(self) -> FloatArray:
        """Unit vectors along the line, (n, 3)."""
        t = np.gradient(self.points, axis=0)
        return np.asarray(t / np.linalg.norm(t, axis=1, keepdims=True))

    @property
    def is_round(self) -> bool:
        """Whether all sections are circles."""
        return bool((self.radius[:, 0] == self.radius[:, 1]).all())

    @cached_property
    def axes(self) -> FloatArray:
        """Unit vectors of the two semi-axes at each point, (n, 2, 3); of circles carried along without a twist."""
        t = self.tangents
        if self.is_round:
            side = np.eye(3)[int(np.abs(t[0]).argmin())]
            carried = []
            for along in t:
                side = side - (side @ along) * along
                side = side / np.linalg.norm(side)
                carried.append(side)
            first = np.array(carried)
        else:
            first = np.array(self.across) - (t @ np.array(self.across))[:, None] * t
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        return np.stack([first, np.cross(t, first)], axis=1)

    def along(self, points: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """How far along the line the nearest place to points is, and how far away [m], (k,) each."""
        p = np.asarray(points, dtype=np.float64).reshape(-1, 1, 3)
        start, step = self.points[:-1], np.diff(self.points, axis=0)
        t = np.clip(((p - start) * step).sum(axis=-1) / (step * step).sum(axis=-1), 0.0, 1.0)
        away = np.linalg.norm(p - start - t[..., None] * step, axis=-1)
        nearest = away.argmin(axis=1)
        row = np.arange(len(p))
        length = np.diff(self.arc)[nearest]
        return self.arc[nearest] + t[row, nearest] * length, away[row, nearest]

    def at(self, arc: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Points (k, 3) and semi-axes (k, 2) of the line at lengths along it [m]."""
        s = np.asarray(arc, dtype=np.float64).reshape(-1)
        x = np.stack([np.interp(s, self.arc, self.points[:, c]) for c in range(3)], axis=1)
        return x, np.stack([np.interp(s, self.arc, self.radius[:, c]) for c in range(2)], axis=1)

    def resampled(self, count: int) -> Lumen:
        """The same lumen with that many points at equal distances."""
        x, r = self.at(np.linspace(0.0, self.length, checks.count(count, f"lumen {self.name!r}: count", low=2)))
        return Lumen(x, r, self.across, self.name)

    def surface(self, around: int = AROUND) -> SurfaceMesh:
        """The wall, open at both ends; triangles face away from the lumen.

        Args:
            around: Points of a section, at least 8.
        """
        m = checks.count(around, f"lumen {self.name!r}: around", low=8)
        angle = 2.0 * np.pi * np.arange(m) / m
        unit = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        rings = self.points[:, None] + np.einsum("mk,nk,nkc->nmc", unit, self.radius, self.axes)
        ring, corner = np.meshgrid(np.arange(len(rings) - 1), np.arange(m), indexing="ij")
        a, b = (ring * m + corner).ravel(), (ring * m + (corner + 1) % m).ravel()
        triangles = np.concatenate([np.stack([a, b, b + m], axis=1), np.stack([a, b + m, a + m], axis=1)])
        return SurfaceMesh(rings.reshape(-1, 3), triangles, self.name)
