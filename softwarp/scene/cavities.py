"""Air chambers, and membranes glued to soft bodies."""

from __future__ import annotations

import math
import warnings
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp import checks, meshing
from softwarp.meshing.quadratic import MIDDLE_WEIGHTS
from softwarp.model.codes import CAVITY_CONTROLS
from softwarp.model.handles import Cavity, Handle
from softwarp.scene.checks import distance, limits, node_indices
from softwarp.scene.parts import BodySpec, CavitySpec, FloatArray, IntArray, MembraneSpec, Scene

ATMOSPHERE = 101325.0  # Pa
FACES = np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]])  # corners of a tet's, in any order
ON_NODE = 1e-9  # share of other nodes below which a vertex lies on a node


def add_cavity(
    scene: Scene,
    body: int,
    vertices: ArrayLike | meshing.SurfaceMesh,
    triangles: ArrayLike | None,
    control: Literal["pressure", "volume", "gas"],
    *,
    min_pressure: float,
    max_pressure: float,
    min_volume: float,
    max_volume: float,
    max_pressure_rate: float,
    max_flow: float,
    ambient: float,
    exponent: float,
    anchored: ArrayLike,
    tolerance: float | None,
    name: str | None,
) -> Cavity:
    """Add an air chamber: a closed surface in a soft body that a pressure pushes outwards."""
    spec = scene.soft(body)
    default = vertices.name if isinstance(vertices, meshing.CavityWall) else f"cavity{len(scene.cavities)}"
    label = checks.label(name, default, "name of a cavity")
    if label in [cavity.name for cavity in scene.cavities]:
        raise ValueError(f"cavity {label!r} exists already; give every cavity its own name")
    checks.choice(control, f"cavity {label!r}: control", CAVITY_CONTROLS)
    tolerance = distance(tolerance, f"cavity {label!r}: tolerance")
    vertices, triangles = _surface(spec, vertices, triangles, label)
    outward = meshing.check_closed(vertices, triangles, name=label)
    points = np.asarray(vertices, dtype=np.float64)
    free = np.ones(len(points), dtype=bool)
    if checks.as_array(anchored).size:
        free[node_indices(anchored, len(points), f"cavity {label!r}: anchored vertices")] = False
    tets, weights = _embedded(spec, points, free, tolerance, label)
    middles = np.full((len(points), 3), -1, dtype=np.int32)
    if spec.elements is not None:
        points, middles = _on_curved_faces(spec, points, free, tets, weights, outward, label)
    given = {
        "min_pressure": min_pressure,
        "max_pressure": max_pressure,
        "min_volume": min_volume,
        "max_volume": max_volume,
        "max_pressure_rate": max_pressure_rate,
        "max_flow": max_flow,
    }
    bounds = {f"cavity_{key}": value for key, value in limits(given, f"cavity {label!r}").items()}
    _check_limits(bounds, label)
    for what, value in (("ambient", ambient), ("exponent", exponent)):
        checks.number(value, f"cavity {label!r}: {what}", above=0.0)
    scene.cavities.append(
        CavitySpec(
            name=label,
            body=int(body),
            vertices=points,
            triangles=outward,
            control=control,
            parameters=bounds | {"cavity_ambient": float(ambient), "cavity_exponent": float(exponent)},
            tets=tets,
            weights=weights,
            middles=middles,
        )
    )
    return Cavity(len(scene.cavities) - 1)


def _surface(
    spec: BodySpec, vertices: ArrayLike | meshing.SurfaceMesh, triangles: ArrayLike | None, label: str
) -> tuple[ArrayLike, ArrayLike]:
    """Vertices and triangles; the wall of a cavity gets the edge nodes of a quadratic body."""
    if isinstance(vertices, meshing.SurfaceMesh):
        if triangles is not None:
            raise ValueError(f"cavity {label!r}: a surface has its triangles already; leave triangles out")
        if isinstance(vertices, meshing.CavityWall) and spec.elements is not None:
            return _with_middles(spec.mesh.nodes, spec.elements, vertices, label)
        return vertices.nodes, vertices.triangles
    if triangles is None:
        raise ValueError(
            f"cavity {label!r}: triangles are missing; pass vertices and triangles, or a surface such as "
            f"solid.cavities[name]"
        )
    return vertices, triangles


def _with_middles(
    nodes: FloatArray, elements: IntArray, wall: meshing.CavityWall, label: str
) -> tuple[FloatArray, IntArray]:
    """The six nodes of every face of a wall, and its four triangles."""
    corner = wall.node[wall.triangles]
    try:
        middle = meshing.face_middles(elements, corner)
    except meshing.MeshError as error:
        raise ValueError(
            f"cavity {label!r}: its wall belongs to another solid than the body; pass that solid's own"
        ) from error
    (a, b, c), (ab, bc, ca) = corner.T, middle.T
    rows = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    six = np.concatenate([np.stack(row, axis=1) for row in rows])
    x, t = meshing.compact(nodes, six)
    return x, t


def _embedded(
    spec: BodySpec, points: FloatArray, free: NDArray[np.bool_], tolerance: float | None, label: str
) -> tuple[IntArray, FloatArray]:
    """Tet and weights of every free vertex; -1 and zeros of one that is fixed in space."""
    tets, weights = np.full(len(points), -1, dtype=np.int32), np.zeros((len(points), 4))
    if free.any():
        tets[free], weights[free] = meshing.embed(
            spec.mesh.nodes, spec.mesh.tets, points[free], name=f"cavity {label!r}: vertex", tolerance=tolerance
        )
    return tets, weights


def _on_curved_faces(
    spec: BodySpec,
    points: FloatArray,
    free: NDArray[np.bool_],
    tets: IntArray,
    weights: FloatArray,
    outward: IntArray,
    label: str,
) -> tuple[FloatArray, IntArray]:
    """Vertices, those in the middle of quadratic edges moved out, and the nodes that carry these (v, 3), else -1.

    Warns of faces of elements whose corners alone are given.
    """
    assert spec.elements is not None
    nodes = np.take_along_axis(spec.mesh.tets[tets], weights.argmax(axis=1)[:, None], axis=1)[:, 0]
    on_node = free & (np.abs(weights.max(axis=1) - 1.0) < ON_NODE)
    carriers = np.where(on_node, nodes, -1)
    middles = meshing.surface_middles(spec.elements, carriers, outward)
    faces = np.sort(spec.elements[:, FACES].reshape(-1, 3), axis=1)
    count = len(spec.mesh.nodes)
    bare = np.isin(_key(np.sort(carriers[outward], axis=1), count), _key(faces, count)).sum()
    if bare:
        warnings.warn(
            f"cavity {label!r}: {bare} of its triangles have only the corners of faces of quadratic elements, whose "
            f"middles then feel no pressure, so that its wall moves too far. Pass a solid's own wall, "
            f"solid.cavities[name], or all six nodes of a face and its four triangles",
            UserWarning,
            stacklevel=4,
        )
    is_middle = middles[:, 0] >= 0
    moved = points.copy()
    moved[is_middle] = np.einsum("k,vkc->vc", MIDDLE_WEIGHTS, spec.mesh.nodes[middles[is_middle]])
    return moved, middles


def _key(triples: IntArray, count: int) -> NDArray[np.int64]:
    """One number for each triple of sorted nodes; below 0 where one is -1."""
    a, b, c = triples.astype(np.int64).T
    return np.where(a < 0, -1, (a * count + b) * count + c)


def _check_limits(bounds: dict[str, float], label: str) -> None:
    """Refuse limits that are not ordered, or that nothing can keep."""
    is_ordered = True
    for what in ("pressure", "volume"):
        low, high = bounds[f"cavity_min_{what}"], bounds[f"cavity_max_{what}"]
        is_ordered &= low <= high and low < math.inf and high > -math.inf
    is_ordered &= bounds["cavity_max_volume"] > 0.0
    if not is_ordered or bounds["cavity_max_pressure_rate"] < 0.0 or bounds["cavity_max_flow"] < 0.0:
        raise ValueError(
            f"cavity {label!r}: limits must be ordered, volumes above 0 and rates at least 0, got {bounds}"
        )


def add_membrane(
    scene: Scene,
    body: int,
    triangles: ArrayLike,
    *,
    thickness: float | ArrayLike,
    youngs: float,
    nu: float,
    density: float,
    name: str | None,
) -> Handle:
    """Glue a thin elastic skin to nodes of a soft body; it resists stretching, not bending."""
    spec = scene.soft(body)
    label = checks.label(name, f"membrane{len(scene.membranes)}", "name of a membrane")
    checks.number(youngs, f"{label}: youngs", above=0.0)
    checks.number(density, f"{label}: density", low=0.0)
    checks.number(nu, f"{label}: Poisson's ratio", above=-1.0, high=0.5)
    geometry = meshing.membrane_geometry(spec.mesh.nodes, triangles, thickness, name=label)
    chosen: IntArray = geometry.triangles
    scene.membranes.append(
        MembraneSpec(label, int(body), chosen, float(youngs), float(nu), geometry.thickness, float(density))
    )
    return Handle(len(scene.membranes) - 1)
