"""Soft bodies: their elements, which nodes are held and what pulls at them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp import checks, meshing
from softwarp.meshing import MeshError
from softwarp.meshing.quadratic import POINTS
from softwarp.model.handles import Rod, SoftBody
from softwarp.scene.checks import Box, corners, factors, node_indices, vector
from softwarp.scene.materials import Corotational, Material
from softwarp.scene.parts import BodySpec, ContactSurface, FloatArray, IntArray, Scene

ELEMENTS = ("p1", "p2")
SMALL, LARGE = 0.002, 2.0  # m; a body beyond is likely given in another unit


def add_tets(
    scene: Scene,
    nodes: ArrayLike | meshing.TetMesh | meshing.QuadraticMesh,
    tets: ArrayLike | None,
    *,
    material: Material,
    element: Literal["p1", "p2"] | None,
    density: float | None,
    total_mass: float | None,
    lumping: Literal["volume", "uniform"],
    rayleigh: tuple[float, float],
    relaxation: tuple[float, float] = (0.0, 0.0),
    stiffness: ArrayLike | None = None,
    name: str | None,
    contact_surface: Any = None,
) -> SoftBody:
    """Add a soft body of linear or quadratic tetrahedra."""
    label = scene.new_name(name, f"body{len(scene.bodies)}")
    checks.choice(lumping, f"body {label!r}: lumping", ("volume", "uniform"))
    damping = factors(rayleigh, f"body {label!r}: rayleigh")
    mesh, quadratic = _as_mesh(nodes, tets, element, label)
    _doubt_unit(mesh.bounds, label)
    _check_law(material, label)
    value = _density(density, total_mass, material, (quadratic or mesh).volume, label)
    if quadratic is not None and lumping != "volume":
        raise ValueError(f"body {label!r}: lumping must be 'volume' for element 'p2', got {lumping!r}")
    given: dict[str, Any] = {
        "mesh": mesh,
        "material": material,
        "density": value,
        "lumping": lumping,
        "rayleigh": damping,
    }
    given["relaxation"] = _relaxation(relaxation, label)
    given["elements"] = None if quadratic is None else quadratic.elements
    if stiffness is not None:
        count = len(mesh.tets) if quadratic is None else len(quadratic.elements)
        given["stiffness"] = _stiffness(stiffness, count, label, points=quadratic is not None)
    return _append(scene, label, contact_surface, **given)


def add_hexes(
    scene: Scene,
    nodes: ArrayLike | meshing.HexMesh,
    hexes: ArrayLike | None,
    *,
    material: Material,
    density: float | None,
    total_mass: float | None,
    lumping: Literal["volume", "uniform"],
    rayleigh: tuple[float, float],
    stiffness: ArrayLike | None = None,
    name: str | None,
    contact_surface: Any = None,
    thin: bool | ArrayLike = False,
) -> SoftBody:
    """Add a soft body of hexahedra with incompatible modes."""
    label = scene.new_name(name, f"body{len(scene.bodies)}")
    checks.choice(lumping, f"body {label!r}: lumping", ("volume", "uniform"))
    damping = factors(rayleigh, f"body {label!r}: rayleigh")
    if isinstance(nodes, meshing.HexMesh):
        if hexes is not None:
            raise ValueError(f"body {label!r}: hexes are given twice; a HexMesh has its own, leave hexes out")
    else:
        if hexes is None:
            raise ValueError(f"body {label!r}: hexes are missing; pass nodes and hexes, or a HexMesh")
        nodes = meshing.HexMesh(nodes, hexes, label)  # type: ignore[arg-type]
    _doubt_unit(nodes.bounds, label)
    _check_law(material, label)
    if not isinstance(material, Corotational) or material.method != "warped":
        told = f"{type(material).__name__}({material.method!r})" if isinstance(material, Corotational) else material
        raise ValueError(
            f"body {label!r}: hexahedra know the law Corotational of method 'warped' only, got {told}; take that, or "
            "tetrahedra: add_tets(mesh.linear(), ...)"
        )
    value = _density(density, total_mass, material, nodes.volume, label)
    given: dict[str, Any] = {
        "mesh": nodes.linear(),
        "hexes": nodes.hexes,
        "thin": _walls(thin, len(nodes.hexes), label),
        "material": material,
        "density": value,
        "lumping": lumping,
    }
    if stiffness is not None:
        given["stiffness"] = _stiffness(stiffness, len(nodes.hexes), label)
    return _append(scene, label, contact_surface, rayleigh=damping, relaxation=(0.0, 0.0), **given)


def _check_law(material: Any, label: str) -> None:
    if not isinstance(material, Material) or not material.law:
        told = f"Corotational, NeoHookean, Yeoh or Material.silicone(name), got {type(material).__name__}"
        raise TypeError(f"body {label!r}: material must be a material with a law, such as {told}")


def _append(scene: Scene, label: str, contact_surface: Any, *, mesh: meshing.TetMesh, **given: Any) -> SoftBody:
    """Add a body that nothing holds or pulls at yet."""
    count = len(mesh.nodes)
    scene.bodies.append(
        BodySpec(
            name=label,
            mesh=mesh,
            fixed=np.zeros(count, dtype=bool),
            locked=np.zeros((count, 3), dtype=bool),
            load=np.zeros((count, 3)),
            contact_surface=None if contact_surface is None else _contact_surface(contact_surface, mesh, label),
            **given,
        )
    )
    return SoftBody(len(scene.bodies) - 1)


def _density(density: float | None, total_mass: float | None, material: Material, volume: float, label: str) -> float:
    """Density of a body of some volume [m^3] that is given its density or its mass."""
    if density is None and total_mass is None:
        density = material.density
    if (density is None) == (total_mass is None):
        raise ValueError(f"body {label!r}: give exactly one of density [kg/m^3] and total_mass [kg]")
    given = density if density is not None else total_mass
    value = checks.number(given, f"body {label!r}: mass and density", above=0.0)
    return float(value if density is not None else value / volume)


def _relaxation(value: Any, label: str) -> tuple[float, float]:
    """Ratio and time of a Maxwell branch, both 0 where there is none."""
    ratio, time = factors(value, f"body {label!r}: relaxation")
    if (ratio > 0.0) != (time > 0.0):
        raise ValueError(
            f"body {label!r}: relaxation must have both a ratio and a time [s] above 0, or none, got {value!r}"
        )
    return ratio, time


def _stiffness(value: ArrayLike, count: int, label: str, *, points: bool = False) -> FloatArray:
    """Factors of the modulus, (m,) of elements, (m, 4) where they have Gauss points."""
    shapes = [(count,), (count, POINTS)] if points else [(count,)]
    told = " or ".join(map(str, shapes))
    found = checks.array(
        value, f"body {label!r}: stiffness", *shapes, above=0.0, need=f"be positive and finite, of shape {told}"
    )
    return np.repeat(found[:, None], POINTS, axis=1) if points and found.ndim == 1 else found


def _walls(value: bool | ArrayLike, count: int, label: str) -> NDArray[np.bool_]:
    """Which hexahedra have the modes of walls, (hex,)."""
    found = checks.as_array(value)
    if found.dtype.kind != "b" or found.shape not in ((), (count,)):
        need = f"be True, False, or one of the two for each hexahedron, of shape ({count},)"
        raise ValueError(checks.refusal(f"body {label!r}: thin", need, value))
    return np.full(count, found)


def _contact_surface(value: Any, mesh: meshing.TetMesh, label: str) -> ContactSurface:
    """Points and triangles that a body touches with, carried by its tets.

    Raises:
        MeshError: If points lie farther from the body than their spacing, or triangles look inwards.
    """
    name = f"body {label!r}: contact_surface"
    triangles = np.empty((0, 3), dtype=np.int32)
    if isinstance(value, tuple | list) and len(value) == 2 and np.ndim(value[0]) == 2:
        value = meshing.SurfaceMesh(value[0], value[1], name)
    if isinstance(value, np.ndarray | tuple | list):
        points = checks.as_array(value)
        if points.shape == (0, 3):
            raise MeshError(f"{name}: has no points; give some, a surface, or None for the boundary")
        spacing = meshing.mean_edge(mesh.nodes, meshing.tet_surface(mesh.tets))
    else:
        surface = meshing.as_surface(value, name=name)
        used, corner = np.unique(surface.triangles, return_inverse=True)
        points, triangles = surface.nodes[used], corner.reshape(-1, 3).astype(np.int32)
        if len(triangles) == 0:
            raise MeshError(
                f"{name}: has no triangles; give a surface, points of shape (k, 3), or None for the boundary"
            )
        spacing = meshing.mean_edge(points, triangles)
        sides = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
        is_closed = bool((np.unique(sides, axis=0, return_counts=True)[1] == 2).all())
        if is_closed and meshing.surface_volume(points, triangles) <= 0.0:
            raise MeshError(f"{name}: its triangles look inwards; swap two corners of each, as surface[:, ::-1]")
    tet, weight = meshing.embed(mesh.nodes, mesh.tets, points, name=name, snap=spacing)
    return ContactSurface(np.asarray(points, dtype=np.float64), triangles, mesh.tets[tet].astype(np.int32), weight)


def fix(scene: Scene, body: int, nodes: ArrayLike | None, box: Box | None, axes: str) -> IntArray:
    """Hold nodes of a soft body, or nodes of a rod with their sections, where they are."""
    is_rod = isinstance(body, Rod)
    spec, where, held = scene.nodes_of(body)
    if (nodes is None) == (box is None):
        raise ValueError(f"body {spec.name!r}: fix takes exactly one of nodes and box")
    if box is not None:
        low, high = corners(box, f"body {spec.name!r}")
        chosen = np.flatnonzero(((where >= low) & (where <= high)).all(axis=1)).astype(np.int32)
        if chosen.size == 0:
            bounds = np.array2string(np.array([where.min(axis=0), where.max(axis=0)]), precision=4)
            raise ValueError(f"body {spec.name!r}: no node lies in box {box!r}; the body spans {bounds} m")
    else:
        chosen = node_indices(nodes, len(held), f"body {spec.name!r}: fixed nodes")
    if not isinstance(axes, str) or not axes or set(axes) - set("xyz") or (is_rod and set(axes) != set("xyz")):
        allowed = "'xyz'" if is_rod else "letters of 'xyz'"
        raise ValueError(f"body {spec.name!r}: axes to fix must be {allowed}, got {axes!r}")
    if set(axes) == set("xyz"):
        held[chosen] = True
    else:
        scene.soft(body).locked[np.ix_(chosen, np.array(["xyz".index(axis) for axis in axes]))] = True
    return chosen


def add_point_load(scene: Scene, body: int, nodes: ArrayLike, force: Sequence[float]) -> IntArray:
    """Add a constant dead load, shared equally by nodes."""
    spec = scene.soft(body)
    chosen = node_indices(nodes, len(spec.fixed), f"body {spec.name!r}: loaded nodes")
    spec.load[chosen] += vector(force, f"body {spec.name!r}: force") / chosen.size
    start = sum(len(other.fixed) for other in scene.bodies[:body])
    return (start + chosen).astype(np.int32)


def _refuse_surface(nodes: Any, tets: ArrayLike | None, label: str) -> None:
    """Refuse triangles in place of tetrahedra, and say how to fill them."""
    way_out = "fill it: add_tets(meshing.tetrahedralize(surface, edge_length=...), ...)"
    if tets is not None and checks.as_array(tets).shape[1:] == (3,):
        raise MeshError(
            f"mesh {label!r}: corners must have shape (tetrahedron, 4), got a surface of triangles; {way_out}"
        )
    if tets is None and (isinstance(nodes, meshing.SurfaceMesh | str | Path) or hasattr(nodes, "faces")):
        told = f"{nodes.name!r} is a surface" if isinstance(nodes, meshing.SurfaceMesh) else "a surface was given"
        raise MeshError(f"body {label!r}: tets are missing, {told}; {way_out}")


def _doubt_unit(bounds: FloatArray, label: str) -> None:
    """Warn of a body that is larger or smaller than soft robots are."""
    size = float(np.ptp(bounds, axis=0).max())
    if not SMALL <= size <= LARGE:
        told = "larger than 2 m" if size > LARGE else "smaller than 2 mm"
        way_out = "millimetres become metres with scale=1e-3 of read_mesh or meshing.tetrahedralize"
        if size < SMALL:
            way_out = "it may have been scaled twice"
        warnings.warn(
            f"body {label!r} is {told}: it spans {size:.3g} m. Lengths are metres; {way_out}", UserWarning, stacklevel=4
        )


def _as_mesh(
    nodes: ArrayLike | meshing.TetMesh | meshing.QuadraticMesh, tets: ArrayLike | None, element: str | None, label: str
) -> tuple[meshing.TetMesh, meshing.QuadraticMesh | None]:
    """The linear tets of a body, and its quadratic ones if it has such."""
    if tets is not None and checks.as_array(tets).shape[1:] == (10,):
        nodes = meshing.QuadraticMesh(nodes, tets, label)  # type: ignore[arg-type]
    is_quadratic = isinstance(nodes, meshing.QuadraticMesh)
    _refuse_surface(nodes, tets, label)
    if element is not None:
        checks.choice(element, f"body {label!r}: element", ELEMENTS)
    if is_quadratic and element == "p1":
        raise ValueError(f"body {label!r}: a QuadraticMesh has element 'p2'; pass its linear() for 'p1'")
    if isinstance(nodes, meshing.QuadraticMesh):
        return nodes.linear(), nodes
    if isinstance(nodes, meshing.TetMesh):
        mesh = nodes
    elif tets is None:
        raise ValueError(f"body {label!r}: tets are missing; pass nodes and tets, or a TetMesh")
    else:
        mesh = meshing.TetMesh(nodes, tets, label)  # type: ignore[arg-type]
    meshing.check_tets(mesh.nodes, mesh.tets, name=label)
    if element != "p2":
        return mesh, None
    quadratic = meshing.elevate(mesh)
    return quadratic.linear(), quadratic
