"""A solid made from a surface: its tetrahedra, the walls of its cavities, and how well it fits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from softwarp.meshing.nearest import nearest
from softwarp.meshing.quadratic import QuadraticMesh, elevate
from softwarp.meshing.shells import Shells
from softwarp.meshing.surfaces import surface_volume, triangle_areas
from softwarp.meshing.tets import (
    EDGES,
    FloatArray,
    IntArray,
    SurfaceMesh,
    TetMesh,
    min_dihedral,
    radius_ratio,
)

SAMPLES = 4000  # points of a surface from which the distance to another one is measured, besides its vertices


@dataclass(frozen=True, eq=False)
class CavityWall(SurfaceMesh):
    """The wall of a cavity in a solid; ``builder.add_cavity(body, wall)`` makes a chamber of it.

    Args:
        nodes: Vertices [m], shape (vertex, 3).
        triangles: Corners, outward from the air, shape (tri, 3).
        name: Of the cavity.
        node: Node of the solid under every vertex, shape (vertex,).
    """

    node: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int32))

    @property
    def volume(self) -> float:
        """Volume of the air [m^3]."""
        return surface_volume(self.nodes, self.triangles)


@dataclass(frozen=True)
class MeshReport:
    """How good a solid is, and how well it stands for the surface it was made from.

    Attributes:
        name: Of the solid.
        method: Mesher.
        nodes: Number of nodes.
        tets: Number of tetrahedra.
        volume: Volume [m^3].
        volume_error: (volume - that inside the surface) / that inside the surface.
        deviation: Largest distance [m] between the two surfaces, either way.
        mean_deviation: Mean distance [m].
        dihedral: Smallest angle between two faces of a tetrahedron [degree].
        radius_ratio: Worst ``meshing.radius_ratio``; 1 is a regular tetrahedron.
        edges: Shortest, mean and longest edge [m].
        wall: Thickness of the thinnest wall [m]; infinite where there is none.
        cavities: Volume of every cavity [m^3].
    """

    name: str
    method: str
    nodes: int
    tets: int
    volume: float
    volume_error: float
    deviation: float
    mean_deviation: float
    dihedral: float
    radius_ratio: float
    edges: tuple[float, float, float]
    wall: float
    cavities: dict[str, float]

    def __str__(self) -> str:
        shortest, mean, longest = self.edges
        lines = [
            f"solid {self.name!r} ({self.method}): {self.nodes} nodes, {self.tets} tetrahedra",
            f"volume           {self.volume:.4g} m^3, {100.0 * self.volume_error:+.2f} % of the surface's",
            f"surface deviates {self.deviation:.3g} m at most, {self.mean_deviation:.3g} m on average",
            f"edges            {shortest:.3g} to {longest:.3g} m, {mean:.3g} m on average",
            f"worst element    {self.dihedral:.1f} degrees between faces, radius ratio {self.radius_ratio:.2f}",
        ]
        if np.isfinite(self.wall):
            lines.append(f"thinnest wall    {self.wall:.3g} m, {self.wall / mean:.1f} edges")
        lines += [f"cavity {name!r:9} {volume:.4g} m^3" for name, volume in self.cavities.items()]
        return "\n".join(lines)


@dataclass(frozen=True, eq=False)
class SolidMesh(TetMesh):
    """A solid that was made from a surface; goes to ``add_tets`` as it is.

    Args:
        nodes: Positions [m], shape (node, 3).
        tets: Corners, shape (tet, 4), positive volume.
        name: What messages call it.
        shells: The surface that it was made from.
        cavities: Wall of every cavity, by name.
        method: Mesher.
        wall: Thickness of its thinnest wall [m].
    """

    shells: Shells | None = None
    cavities: Mapping[str, CavityWall] = field(default_factory=dict)
    method: str = ""
    wall: float = np.inf

    @cached_property
    def quality(self) -> MeshReport:
        """Counts, quality of the elements, and distance from the surface that the solid was made from."""
        edge = np.unique(np.sort(self.tets[:, EDGES], axis=2).reshape(-1, 2), axis=0)
        length = np.linalg.norm(self.nodes[edge[:, 0]] - self.nodes[edge[:, 1]], axis=1)
        there, back = self._deviations()
        given = self._given.volume
        return MeshReport(
            name=self.name,
            method=self.method,
            nodes=len(self.nodes),
            tets=len(self.tets),
            volume=self.volume,
            volume_error=self.volume / given - 1.0,
            deviation=float(max(there.max(), back.max())),
            mean_deviation=float(0.5 * (there.mean() + back.mean())),
            dihedral=float(min_dihedral(self.nodes, self.tets).min()),
            radius_ratio=float(radius_ratio(self.nodes, self.tets).min()),
            edges=(float(length.min()), float(length.mean()), float(length.max())),
            wall=self.wall,
            cavities={name: wall.volume for name, wall in self.cavities.items()},
        )

    def report(self) -> MeshReport:
        """``quality``; print it for a text."""
        return self.quality

    @property
    def _given(self) -> Shells:
        """The surface that the solid was made from."""
        if self.shells is None:
            raise ValueError(f"solid {self.name!r} was made without a surface; use meshing.tetrahedralize")
        return self.shells

    def project(self, points: FloatArray) -> FloatArray:
        """Nearest points of the surface that the solid was made from [m], shape (n, 3)."""
        surface = self._given.surface
        return nearest(surface.nodes, surface.triangles, np.asarray(points, dtype=np.float64), self._cell)[0]

    def curved(self) -> QuadraticMesh:
        """Quadratic elements whose edge nodes lie on the surface, with straight edges where elements would fold."""
        return elevate(self, project=self.project, straighten=True)

    def picture(self, path: str | Path, *, size: int = 640) -> Path:
        """Write a picture of the surface and of a cut: every element has the colour of its smallest angle.

        Args:
            path: File ending in .png or .jpg.
            size: Width of each of the two views [pixels].
        """
        from softwarp.meshing.mesh_picture import write

        return write(self, Path(path), size)

    @property
    def _cell(self) -> float:
        """Edge of the cubes in which points are compared with the surface [m]."""
        return float(np.ptp(self.nodes, axis=0).max()) / 8.0

    def _deviations(self) -> tuple[FloatArray, FloatArray]:
        """Distances of points of the own surface from the given one, and back [m]."""
        given, own = self._given.surface, self.surface()
        result = []
        for (x, t), (y, s) in (
            ((self.nodes, own), (given.nodes, given.triangles)),
            ((given.nodes, given.triangles), (self.nodes, own)),
        ):
            points = _samples(x, t)
            result.append(np.linalg.norm(points - nearest(y, s, points, self._cell)[0], axis=1))
        return result[0], result[1]


def _samples(x: FloatArray, t: IntArray) -> FloatArray:
    """Points spread evenly over triangles."""
    share = np.cumsum(triangle_areas(x, t))
    rng = np.random.default_rng(0)
    pick = np.searchsorted(share, rng.uniform(0.0, share[-1], SAMPLES))
    u, v = np.sqrt(rng.uniform(size=SAMPLES)), rng.uniform(size=SAMPLES)
    weights = np.column_stack([1.0 - u, u * (1.0 - v), u * v])
    return np.asarray(np.einsum("nk,nkc->nc", weights, x[t[pick]]))
