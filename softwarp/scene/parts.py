"""What a scene consists of: one record per part, and ``Scene``, the lists of them that plans read."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from softwarp import checks, meshing, shapes
from softwarp.model.floating import RIGID
from softwarp.model.handles import Handle, RigidBody, Rod, SoftBody
from softwarp.scene.composite import TubeTable
from softwarp.scene.materials import Material

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int32]
AXES = ("x", "y", "z", "rx", "ry", "rz")


@dataclass
class ContactSurface:
    """What of a soft body touches instead of its boundary: points that its tets carry, and triangles between them."""

    points: FloatArray  # (point, 3) at rest [m]
    triangles: IntArray  # (tri, 3) numbers of points; none where the points themselves touch
    node: IntArray  # (point, 4) nodes of the body that carry a point
    weight: FloatArray  # (point, 4)


@dataclass
class ReductionSpec:
    """Modes in which a soft body moves instead of node by node, and the elements that stand for all of them."""

    modes: FloatArray  # (mode, node, 3) displacements
    tet_weight: FloatArray  # (tet,) or (Gauss point of quadratic ones,) from 0 on; 1 counts one as it is
    membrane_weight: dict[str, FloatArray]  # of the triangles of every membrane on the body, by its name
    floating: bool = False  # whether the modes live in a frame that turns with the body, six rigid ones before them

    @property
    def count(self) -> int:
        """Modes with rigid ones of a floating frame."""
        return len(self.modes) + (RIGID if self.floating else 0)


@dataclass(frozen=True)
class PointTets:
    """Gauss points of a reduced body's quadratic elements as linear tets between nodes of their own."""

    nodes: FloatArray  # (n, 3) corners of the tets, four each; they count behind the nodes of the mesh
    tets: IntArray  # (point, 4)
    node_volume: FloatArray  # (all nodes,) lumped volumes [m^3] of the elements; none at those of ``nodes``
    inertia: Any  # (all nodes, all nodes) their consistent mass per density [m^3], SciPy CSR


@dataclass
class BodySpec:
    """One soft body as given to the builder."""

    name: str
    mesh: meshing.TetMesh
    material: Material
    density: float  # [kg/m^3]
    lumping: str
    rayleigh: tuple[float, float]
    relaxation: tuple[float, float]  # stiffness of a Maxwell branch per that of the law, and its time [s]
    fixed: NDArray[np.bool_]
    locked: NDArray[np.bool_]  # (n, 3) single axes
    load: FloatArray  # (n, 3) [N]
    elements: IntArray | None = None  # (m, 10) quadratic ones; the mesh then has the linear tets between their nodes
    hexes: IntArray | None = None  # (m, 8) hexahedra; the mesh then has the linear tets between their nodes
    thin: NDArray[np.bool_] | None = None  # (m,) which hexahedra have the modes of walls; None where there are none
    contact_surface: ContactSurface | None = None  # what touches; None for the boundary of the mesh
    stiffness: FloatArray | None = None  # factors of the modulus, (m,) of elements, (m, 4) of quadratic ones' points
    reduction: ReductionSpec | None = None  # modes that it moves in; None for node by node
    points: PointTets | None = None  # what stands for the elements of a reduced body once it is planned

    @property
    def is_linear(self) -> bool:
        """Whether the tets of its mesh are its elements."""
        return self.elements is None and self.hexes is None

    @property
    def nodes(self) -> FloatArray:
        """Those of the mesh, then those of ``points``, (node, 3) [m]."""
        return self.mesh.nodes if self.points is None else np.concatenate([self.mesh.nodes, self.points.nodes])

    @property
    def tets(self) -> IntArray:
        """Linear tets that resist, (tet, 4); of other elements those between their nodes, which do not."""
        return self.mesh.tets if self.points is None else self.points.tets


@dataclass
class RigidSpec:
    """One rigid body as given to the builder; its frame is the one its shape is described in."""

    name: str
    shape: shapes.Shape | None
    mass: float  # [kg], 0 for a kinematic body without one
    centre: FloatArray  # (3,) centre of mass in the body's frame [m]
    inertia: FloatArray  # (3, 3) about the centre, axes of the body's frame [kg m^2]
    pose: FloatArray  # (7,) position [m] and quaternion x y z w
    free: NDArray[np.bool_]  # (6,) unknown axes, world; none for a kinematic body
    kinematic: bool
    max_speed: float  # [m/s] of a kinematic body
    max_spin: float  # [rad/s]
    damping: float  # [1/s]
    twist: FloatArray  # (6,) initial


@dataclass
class TelescopeSpec:
    """Tubes that share the centre line of a rod where they overlap."""

    table: TubeTable
    port: FloatArray  # (7,) position [m] and quaternion x y z w; tubes leave it along its z axis
    lengths: FloatArray  # (tube,) deployed at the start [m]
    angles: FloatArray  # (tube,) at the base, at the start [rad]
    floor: float  # shortest length at which it is shown [m]
    windup: bool  # whether what is not deployed twists as well
    max_speed: FloatArray  # (tube,) [m/s]
    max_spin: FloatArray  # (tube,) [rad/s]

    def parameters(self) -> list[dict[str, float]]:
        """First values of the tubes by their names in ``Parameters``."""
        t = self.table
        columns = {"tube_youngs": t.youngs, "tube_nu": t.nu, "tube_density": t.density}
        columns |= {
            "tube_curvature": np.ones(t.count),
            "tube_max_speed": self.max_speed,
            "tube_max_spin": self.max_spin,
        }
        return [{name: float(values[k]) for name, values in columns.items()} for k in range(t.count)]


@dataclass
class RodSpec:
    """One rod as given to the builder."""

    name: str
    geometry: meshing.RodGeometry
    youngs: float  # [Pa]
    nu: float
    density: float  # [kg/m^3]
    rayleigh: tuple[float, float]
    scale: FloatArray  # (segment,) factors on all stiffnesses
    clamped: NDArray[np.bool_]  # (node,) frames held in space
    contact_pieces: int  # straight pieces that a segment is cut into for contact
    telescope: TelescopeSpec | None = None  # tubes that make it up; its own section and modulus are then nominal


@dataclass
class CableSpec:
    """One cable as given to the builder; the pull point is fixed in space."""

    name: str
    carriers: list[Handle]  # part that carries a waypoint
    waypoints: FloatArray
    pull_point: FloatArray | None
    force_control: bool
    parameters: dict[str, float]  # its limits, by their names in ``Parameters``
    tets: IntArray  # (p,) tet of the soft body, -1 for a waypoint on a rod or a rigid body
    weights: FloatArray  # (p, 4)
    closing_length: float  # [m]
    patches: dict[int, IntArray] = field(default_factory=dict)  # nodes that carry a waypoint

    @property
    def is_elastic(self) -> bool:
        """Whether it stretches."""
        return bool(np.isfinite(self.parameters["cable_stiffness"]))

    @property
    def guides(self) -> list[tuple[Handle, FloatArray]]:
        """Waypoints on rods and rigid bodies, with their parts."""
        points = zip(self.carriers, self.tets, self.waypoints, strict=True)
        return [(part, place) for part, tet, place in points if tet < 0]


@dataclass
class MarkerSpec:
    """One marker as given to the builder."""

    name: str
    body: int
    tet: int
    weights: FloatArray
    frame: tuple[Handle, int] | None = None  # rigid body, or rod and its node, that carries it instead
    local: FloatArray = field(default_factory=lambda: np.zeros(3))  # in the frame's axes [m]


@dataclass
class CavitySpec:
    """One air chamber as given to the builder."""

    name: str
    body: int
    vertices: FloatArray  # (v, 3) at rest [m]
    triangles: IntArray  # (t, 3) outward
    control: Literal["pressure", "volume", "gas"]
    parameters: dict[str, float]  # limits and gas law, by their names in ``Parameters``
    tets: IntArray  # (v,) tet that carries a vertex, -1 for one that is fixed in space
    weights: FloatArray  # (v, 4)
    middles: IntArray  # (v, 3) node in the middle of a quadratic edge under a vertex, and the edge's ends; else -1


@dataclass
class MembraneSpec:
    """One membrane as given to the builder."""

    name: str
    body: int
    triangles: IntArray  # (t, 3) nodes of the body
    youngs: float  # [Pa]
    nu: float
    thickness: FloatArray  # (t,) [m]
    density: float  # [kg/m^3]


@dataclass
class TractionSpec:
    """A load per area on faces of a soft body as given to the builder."""

    name: str
    body: int
    node: IntArray  # (n,) nodes of the body
    share: FloatArray  # (n,) integrals of their shape functions over the faces at rest [m^2]
    value: FloatArray  # (3,) at the start, world axes [Pa]


@dataclass
class Weld:
    """A frame or nodes that another frame carries."""

    kind: Literal["nodes", "rod", "rigid"]
    part: int
    nodes: IntArray  # of the soft body or rod; empty for a rigid body
    to_rod: bool
    to: int
    to_node: IntArray  # rod node per carried node, or (-1,)


@dataclass
class JointSpec:
    """A joint between two frames, or one and the world, as given to the builder."""

    name: str
    kind: Literal["hinge", "slider", "ball", "weld"]
    parent: tuple[Handle, int] | None  # a rigid body, or a rod and its node; None for the world
    child: tuple[Handle, int]
    anchor: FloatArray  # (3,) at the start [m]
    axis: FloatArray  # (3,) unit
    limits: tuple[float, float]  # [rad] or [m]
    control: Literal["none", "position", "velocity", "force"]
    stiffness: float  # [N m/rad] or [N/m], infinite for a rigid servo
    damping: float  # [N m s/rad] or [N s/m]
    max_force: float  # [N m] or [N]
    max_rate: float  # [rad/s] or [m/s]


@dataclass
class PairSpec:
    """Two parts that may touch; the same one twice for self-contact."""

    name: str
    a: Handle
    b: Handle
    values: dict[str, float]


def _earth() -> FloatArray:
    return np.array([0.0, 0.0, -9.81])


@dataclass
class Scene:
    """All parts of a scene, in the order in which they were added; a handle is an index of its kind's list."""

    gravity: FloatArray = field(default_factory=_earth)  # (3,) [m/s^2]
    bodies: list[BodySpec] = field(default_factory=list)
    rigids: list[RigidSpec] = field(default_factory=list)
    rods: list[RodSpec] = field(default_factory=list)
    welds: list[Weld] = field(default_factory=list)
    cables: list[CableSpec] = field(default_factory=list)
    markers: list[MarkerSpec] = field(default_factory=list)
    cavities: list[CavitySpec] = field(default_factory=list)
    membranes: list[MembraneSpec] = field(default_factory=list)
    tractions: list[TractionSpec] = field(default_factory=list)
    joints: list[JointSpec] = field(default_factory=list)
    pairs: list[PairSpec] = field(default_factory=list)

    def soft(self, body: int) -> BodySpec:
        """The soft body behind a handle or a plain index.

        Raises:
            ValueError: If there is no such soft body.
        """
        is_other = isinstance(body, (bool, Handle)) and not isinstance(body, SoftBody)
        if is_other or not isinstance(body, (int, np.integer)) or not 0 <= body < len(self.bodies):
            raise ValueError(f"body {body!r} is no soft body; the builder has bodies 0 .. {len(self.bodies) - 1}")
        return self.bodies[int(body)]

    def part(self, part: int) -> Handle:
        """Handle of a rigid body, a rod or a soft body; a plain index means a soft body.

        Raises:
            ValueError: If there is no such part.
        """
        if isinstance(part, (RigidBody, Rod)):
            count = len(self.rigids) if isinstance(part, RigidBody) else len(self.rods)
            if not 0 <= part < count:
                raise ValueError(f"{part!r} does not exist; the builder has {count}")
            return part
        self.soft(part)
        return SoftBody(part)

    def nodes_of(self, body: int) -> tuple[BodySpec | RodSpec, FloatArray, NDArray[np.bool_]]:
        """A soft body or a rod, where its nodes are at rest [m], and which of them are held."""
        if isinstance(body, Rod):
            if not 0 <= body < len(self.rods):
                raise ValueError(f"{body!r} does not exist; the builder has {len(self.rods)} rods")
            rod = self.rods[body]
            return rod, rod.geometry.positions, rod.clamped
        soft = self.soft(body)
        return soft, soft.mesh.nodes, soft.fixed

    @property
    def telescopes(self) -> list[tuple[int, TelescopeSpec]]:
        """Telescopes and the rods that they are."""
        return [(number, rod.telescope) for number, rod in enumerate(self.rods) if rod.telescope is not None]

    def guides(self) -> list[tuple[Handle, FloatArray]]:
        """Points of rows on rods and rigid bodies, with their parts; in the order of the rows."""
        return [guide for cable in self.cables for guide in cable.guides]

    def parameters(self) -> dict[str, list[dict[str, float]]]:
        """First values that parts bring along, by their names in ``Parameters``, for every item that these count."""
        return {
            "cable": [cable.parameters for cable in self.cables],
            "elastic cable": [cable.parameters for cable in self.cables],
            "relaxing body": [
                {"relaxation_ratio": body.relaxation[0], "relaxation_time": body.relaxation[1]} for body in self.bodies
            ],
            "cavity": [cavity.parameters for cavity in self.cavities],
            "tube": [tube for _, spec in self.telescopes for tube in spec.parameters()],
        }

    def name_of(self, part: Handle) -> str:
        """Name of a rigid body, a rod or a soft body."""
        if isinstance(part, RigidBody):
            return self.rigids[part].name
        return self.rods[part].name if isinstance(part, Rod) else self.bodies[part].name

    def new_name(self, name: str | None, default: str) -> str:
        """Name of a new body.

        Raises:
            ValueError: If another body has it.
        """
        label = checks.label(name, default)
        taken = [spec.name for group in (self.bodies, self.rigids, self.rods) for spec in group]
        if label in taken:
            raise ValueError(f"body {label!r} exists already; give every body its own name")
        return label
