"""From a closed surface to a solid of tetrahedra that simulates. See docs/concepts/meshes.md."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from typing import Any, Literal

import numpy as np

from softwarp import checks
from softwarp.meshing import meshers
from softwarp.meshing.cavity_walls import cavity_walls
from softwarp.meshing.lattice import Crossings, Lattice, crossings, families, in_cells, lattice_around, stuff
from softwarp.meshing.sharp import sharpen
from softwarp.meshing.shells import Shells, as_surface, shells_of
from softwarp.meshing.solid import CavityWall, SolidMesh
from softwarp.meshing.tets import FloatArray, IntArray, MeshError, compact, min_dihedral, orient
from softwarp.meshing.walls import Thinnest, measure

METHODS = ("auto", "lattice", "tetwild", "gmsh")
MOST_POINTS = 30_000_000  # of a lattice
LEAST_ANGLE = 1.0  # degree; a flatter tetrahedron makes steps fail
FEWEST = 1.0  # edges across the thinnest wall
SINGLE = 1.7  # edges across it, below which a single element is, and bending is told to be too stiff
ENOUGH = 2.0  # edges across it that are advised
ROUNDING = 0.01  # of an edge by which a wall may be thinner than it should: facets of round walls, files in float32

Method = Literal["auto", "lattice", "tetwild", "gmsh"]


def tetrahedralize(
    surface: Any,
    *,
    edge_length: float,
    cavities: Mapping[str, Any] | None = None,
    method: Method = "auto",
    scale: float = 1.0,
    sharp_edges: bool = True,
    strict: bool = True,
    name: str | None = None,
) -> SolidMesh:
    """Fill a closed surface with tetrahedra: what ``add_tets`` takes.

    Args:
        surface: Path of a .stl, .obj, .ply or .off file, a ``SurfaceMesh``, a ``trimesh.Trimesh``, or (vertices,
            triangles). A shell inside another one becomes a cavity, ``"cavity 0"`` and so on, however it is turned;
            several shells side by side become one body.
        edge_length: Mean edge of the tetrahedra [m], at most about half of the thinnest wall.
        cavities: Further surfaces inside, by name, of the same kinds and in the same unit.
        method: ``lattice`` is softwarp's own mesher: fast, all angles above 10 degrees, nodes on the surface. It needs
            walls of one to two edges at least. ``tetwild`` takes any wall and keeps sharp edges, is a hundred times
            slower, and needs the package pytetwild (``pip install "softwarp[tetwild]"``). ``gmsh`` runs the program of
            that name, which is under the GPL and not part of softwarp: install it yourself. ``auto`` is ``lattice``,
            and ``tetwild`` for what is too thin for it, where that is installed.
        scale: Metres per unit of the surface, e.g. 0.001 for millimetres.
        sharp_edges: Whether ``lattice`` moves nodes onto sharp edges and corners where elements stay good; else it
            cuts them off, by less than an edge.
        strict: Whether to refuse a solid with other holes, cavities or parts than the surface has.
        name: What messages call the solid; None takes the name of the file.

    Returns:
        The solid. ``solid.cavities[name]`` goes to ``add_cavity``; ``print(solid.report())`` tells how good it is.

    Raises:
        FileNotFoundError: If a path leads nowhere.
        ImportError: If the package of a method is missing.
        MeshError: If a surface is open, badly oriented or crosses itself, a wall is too thin for the edges, or the
            result would not simulate; the message tells the place and what would do.
    """
    outer = as_surface(surface, scale=scale, name=name)
    label = outer.name
    try:
        checks.choice(method, f"surface {label!r}: method", METHODS)
        checks.flag(sharp_edges, f"surface {label!r}: sharp_edges")
        checks.flag(strict, f"surface {label!r}: strict")
        edge = checks.number(edge_length, f"surface {label!r}: edge_length [m]", above=0.0, high=checks.FARTHEST)
        if not isinstance(cavities, Mapping | None):
            raise ValueError(
                checks.refusal(f"surface {label!r}: cavities", "be surfaces by name, {name: surface}", cavities)
            )
    except ValueError as error:
        raise MeshError(str(error)) from None
    inner = {str(key): as_surface(value, scale=scale, name=str(key)) for key, value in (cavities or {}).items()}
    shells = shells_of(outer, inner)
    lattice = _lattice(shells, edge)
    points, triangles = shells.surface.nodes, shells.surface.triangles
    met = [crossings(family, in_cells(lattice, points), triangles) for family in families()]
    wall, gap = measure(lattice, met, points, triangles, label)

    def attempt(way: str) -> tuple[FloatArray, IntArray, dict[str, CavityWall]]:
        _check_walls(label, wall, edge, way)
        x, t = _mesh(shells, edge, way, lattice, met, sharp_edges)
        return x, t, cavity_walls(shells, x, t, edge, wall, gap, strict=strict)

    chosen = "lattice" if method == "auto" else method
    try:
        nodes, tets, walls = attempt(chosen)
    except MeshError:
        if method != "auto" or not meshers.has_tetwild():
            raise
        chosen = "tetwild"
        nodes, tets, walls = attempt(chosen)
    angle = float(min_dihedral(nodes, tets).min())
    if angle < LEAST_ANGLE:
        raise MeshError(
            f"surface {label!r}: method {chosen!r} left a tetrahedron with faces {angle:.2g} degrees apart, on which "
            f"steps fail; take another edge_length than {edge:g} m, or method='lattice'"
        )
    return SolidMesh(nodes, tets, label, shells, walls, chosen, wall.width)


def _lattice(shells: Shells, edge: float) -> Lattice:
    """A lattice around the surface, if it is neither too coarse nor too fine.

    Raises:
        MeshError: If it is.
    """
    low, high = shells.surface.bounds
    extent, label = high - low, shells.surface.name
    if edge > 0.5 * float(extent.max()):
        raise MeshError(
            f"surface {label!r}: edge_length must be at most half of its extent of {extent.max():.4g} m, got {edge:g}; "
            f"check its unit (scale=0.001 reads millimetres)"
        )
    if _points(extent, edge) > MOST_POINTS:
        coarse = edge
        while _points(extent, coarse) > MOST_POINTS:
            coarse *= 1.02
        raise MeshError(
            f"surface {label!r}: edge_length={edge:g} m is too short for an extent of {extent.max():.4g} m: about "
            f"{_points(extent, edge):.2g} points; take {_two_digits(coarse, math.ceil)} m or more, or check its unit "
            f"(scale=0.001 reads millimetres)"
        )
    return lattice_around(low, high, edge)


def _points(extent: FloatArray, edge: float) -> float:
    """About how many points a lattice of this edge [m] has around a box of this extent [m]."""
    return 2.0 * float(np.prod(extent / edge + 3.0))


def _two_digits(length: float, towards: Callable[[float], int]) -> str:
    """A positive length as somebody types it, rounded up or down: advice that is followed must not be refused again."""
    unit = 10.0 ** (math.floor(math.log10(length)) - 1)
    return f"{towards(length / unit) * unit:.2g}"


def _check_walls(label: str, wall: Thinnest, edge: float, method: str) -> None:
    """Refuse walls that the lattice would lose, and warn of those with a single element across."""
    if wall.width >= (SINGLE - ROUNDING) * edge:
        return
    advised = f"edge_length={_two_digits(wall.width / ENOUGH, math.floor)}"
    told = (
        f"surface {label!r}: its thinnest wall, {wall.width:.3g} m at {_text(wall.place)} m, is "
        f"{wall.width / edge:.2g} edges thick"
    )
    if wall.width < (FEWEST - ROUNDING) * edge and method == "lattice":
        finer = f"take {advised}" if wall.width > 1e-3 * edge else "join the touching parts"
        raise MeshError(
            f"{told} with edge_length={edge:g}, and the lattice needs one edge at least; {finer}, or "
            f"method='tetwild' (pip install \"softwarp[tetwild]\")"
        )
    warnings.warn(
        f"{told}: bending of it is too stiff with one linear element across; take {advised}, or element='p2'",
        UserWarning,
        stacklevel=4,
    )


def _mesh(
    shells: Shells, edge: float, method: str, lattice: Lattice, met: list[Crossings], sharp_edges: bool
) -> tuple[FloatArray, IntArray]:
    """Nodes and tetrahedra of one method."""
    points, triangles, label = shells.surface.nodes, shells.surface.triangles, shells.surface.name
    if method == "tetwild":
        nodes, tets = meshers.tetwild(points, triangles, edge)
    elif method == "gmsh":
        nodes, tets = meshers.gmsh(shells, edge)
    else:
        nodes, tets = stuff(lattice, met)
    if not len(tets):
        raise MeshError(
            f"surface {label!r}: no point of a lattice of edge_length={edge:g} m lies inside; take shorter edges"
        )
    if method == "lattice" and sharp_edges:
        nodes = sharpen(nodes, tets, points, triangles, lattice.cell)
    nodes, tets = compact(nodes, tets)
    return nodes, orient(nodes, tets)


def _text(x: FloatArray) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in x) + ")"
