"""Describe a scene in Python, then ``finalize`` it into a batched model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp import meshing
from softwarp.model.model import Model
from softwarp.plan.compile import plan
from softwarp.plan.frames import to_local
from softwarp.scene.frames import node_indices
from softwarp.scene.joints import JointBuilder
from softwarp.scene.materials import Material
from softwarp.scene.parts import Handle, RigidBody, Rod, SoftBody

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int32]
Box = tuple[Sequence[float], Sequence[float]]
ELEMENTS = ("p1", "p2")


@dataclass
class BodySpec:
    """One soft body as given to the builder."""

    name: str
    mesh: meshing.TetMesh
    material: Material
    density: float  # [kg/m^3]
    lumping: str
    rayleigh: tuple[float, float]
    fixed: NDArray[np.bool_]
    locked: NDArray[np.bool_]  # (n, 3) single axes
    load: FloatArray  # (n, 3) [N]
    elements: IntArray | None = None  # (m, 10) quadratic ones; the mesh then has the linear tets between their nodes


@dataclass
class CableSpec:
    """One cable as given to the builder; the pull point is fixed in space."""

    name: str
    carriers: list[Handle]  # part that carries a waypoint
    waypoints: FloatArray
    pull_point: FloatArray | None
    force_control: bool
    limits: dict[str, float]
    tets: IntArray  # (p,) tet of the soft body, -1 for a waypoint on a rod or a rigid body
    weights: FloatArray  # (p, 4)
    closing_length: float  # [m]


@dataclass
class MarkerSpec:
    """One marker as given to the builder."""

    name: str
    body: int
    tet: int
    weights: FloatArray
    frame: tuple[Handle, int] | None = None  # rigid body, or rod and its node, that carries it instead
    local: FloatArray = field(default_factory=lambda: np.zeros(3))  # in the frame's axes [m]


class ModelBuilder(JointBuilder):
    """Collects bodies, rods, supports, cables, markers, loads and contacts of a scene. SI units.

    Args:
        gravity: Gravity [m/s^2].

    Raises:
        ValueError: From every method, for input that names no thing, lies outside its range or is not finite.
    """

    def __init__(self, gravity: Sequence[float] = (0.0, 0.0, -9.81)) -> None:
        super().__init__()
        self.gravity = _vector(gravity, "gravity")
        self.bodies: list[BodySpec] = []
        self.cables: list[CableSpec] = []
        self.markers: list[MarkerSpec] = []

    def add_tets(
        self,
        nodes: ArrayLike | meshing.TetMesh | meshing.QuadraticMesh,
        tets: ArrayLike | None = None,
        *,
        material: Material,
        element: Literal["p1", "p2"] | None = None,
        density: float | None = None,
        total_mass: float | None = None,
        lumping: Literal["volume", "uniform"] = "volume",
        rayleigh: tuple[float, float] = (0.0, 0.0),
        name: str | None = None,
    ) -> SoftBody:
        """Add a soft body of linear or quadratic tetrahedra.

        Args:
            nodes: Rest positions [m], shape (n, 3), a ``TetMesh``, or a ``QuadraticMesh``.
            tets: Corners with positive volume, shape (m, 4), or the ten nodes of quadratic elements, shape (m, 10), in
                the order of ``meshing.quadratic``; omitted for a mesh.
            material: Elastic law.
            element: ``p1``, the default, has four nodes, as in SOFA, and is too stiff in bending. ``p2`` has ten: six
                more nodes, in the middles of the edges, follow those of the mesh. A ``QuadraticMesh`` is ``p2``.
            density: Density [kg/m^3]; exactly one of ``density`` and ``total_mass``, unless the material has one.
            total_mass: Mass of the body [kg].
            lumping: ``volume`` gives a node a quarter of its tets, ``uniform`` the same mass to every node. The mass of
                ``p2`` is consistent and takes ``volume`` only.
            rayleigh: Damping factors (mass [1/s], stiffness [s]).
            name: For messages and exports.

        Returns:
            Index of the body.

        Raises:
            MeshError: If the mesh is empty, inverted, degenerate or otherwise broken.
        """
        label = self._new_name(name, f"body{len(self.bodies)}")
        mesh, quadratic = _as_mesh(nodes, tets, element, label)
        if not isinstance(material, Material) or not material.law:
            told = f"Corotational, NeoHookean, Yeoh or Material.silicone(name), got {type(material).__name__}"
            raise TypeError(f"body {label!r}: material must be a material with a law, such as {told}")
        if density is None and total_mass is None:
            density = material.density
        if (density is None) == (total_mass is None):
            raise ValueError(f"body {label!r}: give exactly one of density [kg/m^3] and total_mass [kg]")
        value = density if density is not None else float(total_mass or 0.0) / (quadratic or mesh).volume
        if not (math.isfinite(value) and value > 0.0):
            raise ValueError(
                f"body {label!r}: mass and density must be positive and finite, got {density or total_mass}"
            )
        if lumping not in ("volume", "uniform"):
            raise ValueError(f"body {label!r}: lumping must be 'volume' or 'uniform', got {lumping!r}")
        if quadratic is not None and lumping != "volume":
            raise ValueError(f"body {label!r}: lumping must be 'volume' for element 'p2', got {lumping!r}")
        if len(rayleigh) != 2 or not all(math.isfinite(r) and r >= 0.0 for r in rayleigh):
            raise ValueError(f"body {label!r}: rayleigh must be two finite factors >= 0, got {rayleigh!r}")
        count = len(mesh.nodes)
        self.bodies.append(
            BodySpec(
                name=label,
                mesh=mesh,
                material=material,
                density=float(value),
                lumping=lumping,
                rayleigh=(float(rayleigh[0]), float(rayleigh[1])),
                fixed=np.zeros(count, dtype=bool),
                locked=np.zeros((count, 3), dtype=bool),
                load=np.zeros((count, 3)),
                elements=None if quadratic is None else quadratic.elements,
            )
        )
        return SoftBody(len(self.bodies) - 1)

    def fix(self, body: int, nodes: ArrayLike | None = None, box: Box | None = None, axes: str = "xyz") -> IntArray:
        """Hold nodes of a soft body, or nodes of a rod with their sections, where they are.

        Args:
            body: From ``add_tets`` or ``add_rod``.
            nodes: Node indices within the body.
            box: Corners ((x0, y0, z0), (x1, y1, z1)) [m]; nodes inside or on it are fixed.
            axes: Axes of the world along which nodes of a soft body are held, as in ``"z"`` for a plane of symmetry.

        Returns:
            Indices of the nodes that this call fixed.
        """
        is_rod = isinstance(body, Rod)
        if is_rod and not 0 <= body < len(self.rods):
            raise ValueError(f"{body!r} does not exist; the builder has {len(self.rods)} rods")
        spec = self.rods[body] if is_rod else self._soft(body)
        where = self.rods[body].geometry.positions if is_rod else self._soft(body).mesh.nodes
        held = self.rods[body].clamped if is_rod else self._soft(body).fixed
        if (nodes is None) == (box is None):
            raise ValueError(f"body {spec.name!r}: fix takes exactly one of nodes and box")
        if box is not None:
            low, high = _vector(box[0], "box"), _vector(box[1], "box")
            if (low > high).any():
                raise ValueError(f"body {spec.name!r}: box corners must be (lowest, highest), got {box!r}")
            chosen = np.flatnonzero(((where >= low) & (where <= high)).all(axis=1)).astype(np.int32)
            if chosen.size == 0:
                bounds = np.array2string(np.array([where.min(axis=0), where.max(axis=0)]), precision=4)
                raise ValueError(f"body {spec.name!r}: no node lies in box {box!r}; the body spans {bounds} m")
        else:
            chosen = node_indices(nodes, len(held), f"body {spec.name!r}: fixed nodes")
        if not axes or set(axes) - set("xyz") or (is_rod and set(axes) != set("xyz")):
            allowed = "'xyz'" if is_rod else "letters of 'xyz'"
            raise ValueError(f"body {spec.name!r}: axes to fix must be {allowed}, got {axes!r}")
        if set(axes) == set("xyz"):
            held[chosen] = True
        else:
            self._soft(body).locked[np.ix_(chosen, np.array(["xyz".index(axis) for axis in axes]))] = True
        return chosen

    def add_cable(
        self,
        body: int | Sequence[int],
        waypoints: ArrayLike,
        pull_point: Sequence[float] | None = None,
        *,
        control: Literal["length", "force"] = "length",
        min_tension: float = 0.0,
        max_tension: float = math.inf,
        min_displacement: float = -math.inf,
        max_displacement: float = math.inf,
        max_rate: float = math.inf,
        closing_length: float = 0.0,
        tolerance: float | None = None,
        name: str | None = None,
    ) -> int:
        """Add a frictionless, inextensible cable through soft bodies, rods and rigid bodies.

        Args:
            body: Body that the cable runs through, or one per waypoint. On a rod the nearest section carries a
                waypoint, at any distance from the centre line; a rigid body carries points anywhere.
            waypoints: Points at rest [m], shape (p, 3), in order; inside a soft body that carries them.
            pull_point: First point, fixed in space [m]; without one the cable starts at its first waypoint.
            control: ``length`` imposes a displacement (shortening from rest), ``force`` a tension.
            min_tension: 0 for a cable that only pulls, ``-inf`` for a bilateral one [N].
            max_tension: Upper limit [N].
            min_displacement: Lower limit of the imposed displacement [m].
            max_displacement: Upper limit of the imposed displacement [m].
            max_rate: Largest change of the displacement per time [m/s].
            closing_length: Distance of neighbouring points [m] below which the segment between them pulls in proportion
                to it, so that material crushed by the cable comes to rest; less than every segment at rest. 0 keeps
                the full tension down to the last, where a segment has no direction and a taut cable chatters.
            tolerance: Distance [m] that a waypoint may lie outside the body's faceted surface.
            name: For messages and exports.

        Returns:
            Index of the cable.
        """
        label = name or f"cable{len(self.cables)}"
        points = np.asarray(waypoints, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise ValueError(f"{label}: waypoints must be finite with shape (p, 3), got shape {points.shape}")
        anchor = None if pull_point is None else _vector(pull_point, f"{label}: pull_point")
        path = points if anchor is None else np.vstack([anchor, points])
        if len(path) < 2:
            raise ValueError(f"{label}: a cable needs two points, got {len(path)}; add a waypoint or a pull_point")
        segments = np.linalg.norm(np.diff(path, axis=0), axis=1)
        short = np.flatnonzero(segments < 1e-9 * max(1.0, np.ptp(path)))
        if short.size:
            raise ValueError(f"{label}: points {short[0]} and {short[0] + 1} coincide; remove one")
        if not 0.0 <= closing_length < segments.min():
            raise ValueError(
                f"{label}: closing_length must be at least 0 and below its shortest segment at rest, "
                f"{segments.min():.6g} m, got {closing_length!r}"
            )
        if control not in ("length", "force"):
            raise ValueError(f"{label}: control must be 'length' or 'force', got {control!r}")
        limits = {
            "cable_min_tension": min_tension,
            "cable_max_tension": max_tension,
            "cable_min_displacement": min_displacement,
            "cable_max_displacement": max_displacement,
            "cable_max_rate": max_rate,
        }
        for key, value in limits.items():
            if math.isnan(value):
                raise ValueError(f"{label}: {key.removeprefix('cable_')} must be a number, got nan")
        if min_tension > max_tension or min_displacement > max_displacement or max_rate < 0.0:
            raise ValueError(f"{label}: limits must be ordered and max_rate >= 0, got {limits}")
        carriers = self._carriers(body, len(points), label)
        tets, weights = np.full(len(points), -1, dtype=np.int32), np.zeros((len(points), 4))
        for part in {int(c) for c in carriers if isinstance(c, SoftBody)}:
            mesh = self.bodies[part].mesh
            on = np.array([isinstance(c, SoftBody) and int(c) == part for c in carriers])
            tets[on], weights[on] = meshing.embed(
                mesh.nodes, mesh.tets, points[on], name=f"{label}: waypoint", tolerance=tolerance
            )
        self.cables.append(
            CableSpec(label, carriers, points, anchor, control == "force", limits, tets, weights, float(closing_length))
        )
        return len(self.cables) - 1

    def _carriers(self, body: int | Sequence[int], count: int, label: str) -> list[Handle]:
        """Part of every waypoint."""
        parts: list[int] = [body] * count if isinstance(body, int) else list(body)
        if len(parts) != count:
            raise ValueError(f"{label}: give one body, or one per waypoint ({count}), got {len(parts)}")
        return [self._part(part) for part in parts]

    def add_marker(
        self, body: int, point: Sequence[float], *, tolerance: float | None = None, name: str | None = None
    ) -> int:
        """Follow a material point.

        Args:
            body: Soft body, rigid body or rod that carries the point; of a rod, its nearest section does.
            point: Position at rest [m], inside a soft body.
            tolerance: Distance [m] that the point may lie outside.
            name: For messages and exports.

        Returns:
            Index of the marker.
        """
        label = name or f"marker{len(self.markers)}"
        where = _vector(point, label)[None]
        if isinstance(body, (RigidBody, Rod)):
            part = self._part(body)
            node, pose = 0, self.rigids[body].pose if isinstance(body, RigidBody) else np.zeros(7)
            if isinstance(body, Rod):
                g = self.rods[body].geometry
                node = int(np.argmin(np.linalg.norm(g.positions - where, axis=1)))
                pose = np.concatenate([g.positions[node], g.quaternions[node]])
            local = to_local(pose, where[0])
            self.markers.append(MarkerSpec(label, -1, -1, np.zeros(4), (part, node), local))
            return len(self.markers) - 1
        spec = self._soft(body)
        tets, weights = meshing.embed(spec.mesh.nodes, spec.mesh.tets, where, name=label, tolerance=tolerance)
        self.markers.append(MarkerSpec(label, body, int(tets[0]), weights[0]))
        return len(self.markers) - 1

    def add_point_load(self, body: int, nodes: ArrayLike, force: Sequence[float]) -> IntArray:
        """Add a constant dead load, shared equally by nodes.

        Args:
            body: Index from ``add_tets``.
            nodes: Node indices within the body.
            force: Total force [N].

        Returns:
            Indices of the loaded nodes within ``Simulation.node_x``, for ``control.node_force``.
        """
        spec = self._soft(body)
        chosen = node_indices(nodes, len(spec.fixed), f"body {spec.name!r}: loaded nodes")
        spec.load[chosen] += _vector(force, f"body {spec.name!r}: force") / chosen.size
        start = sum(len(other.fixed) for other in self.bodies[:body])
        return (start + chosen).astype(np.int32)

    def finalize(
        self,
        num_worlds: int = 1,
        device: str = "cpu",
        precision: Literal["float32", "float64"] = "float32",
        contact_capacity: int | None = None,
    ) -> Model:
        """Check the scene, analyse its linear system and copy it to a device.

        Args:
            num_worlds: Worlds that share this scene.
            device: Warp device, ``cpu`` or ``cuda:0``.
            precision: Scalar type of state and solver; ``float64`` is for validation.
            contact_capacity: Contacts that a world can hold; None takes 16 per pair of rigid bodies and 48 per other
                pair, or fewer where fewer can exist. A world that needs more reports ``CONTACT_OVERFLOW``.
        """
        return plan(self, num_worlds, device, precision, contact_capacity)


def _as_mesh(
    nodes: ArrayLike | meshing.TetMesh | meshing.QuadraticMesh, tets: ArrayLike | None, element: str | None, label: str
) -> tuple[meshing.TetMesh, meshing.QuadraticMesh | None]:
    """The linear tets of a body, and its quadratic ones if it has such."""
    if tets is not None and np.shape(tets)[1:] == (10,):
        nodes = meshing.QuadraticMesh(np.asarray(nodes, dtype=np.float64), np.asarray(tets), label)
    is_quadratic = isinstance(nodes, meshing.QuadraticMesh)
    if element not in (None, *ELEMENTS):
        raise ValueError(f"body {label!r}: element must be one of {', '.join(ELEMENTS)}, got {element!r}")
    if is_quadratic and element == "p1":
        raise ValueError(f"body {label!r}: a QuadraticMesh has element 'p2'; pass its linear() for 'p1'")
    if isinstance(nodes, meshing.QuadraticMesh):
        return nodes.linear(), nodes
    if isinstance(nodes, meshing.TetMesh):
        mesh = nodes
    elif tets is None:
        raise ValueError(f"body {label!r}: tets are missing; pass nodes and tets, or a TetMesh")
    else:
        mesh = meshing.TetMesh(np.asarray(nodes, dtype=np.float64), np.asarray(tets, dtype=np.int32), label)
    meshing.check_tets(mesh.nodes, mesh.tets, name=label)
    if element != "p2":
        return mesh, None
    quadratic = meshing.elevate(mesh)
    return quadratic.linear(), quadratic


def _vector(value: Sequence[float], name: str) -> FloatArray:
    array = np.asarray(value, dtype=np.float64)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise ValueError(f"{name} must be three finite numbers, got {value!r}")
    return array
