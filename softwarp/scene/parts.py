"""What the builder collects: the handles that its methods return, and one record per part."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from softwarp import meshing, shapes

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int32]
AXES = ("x", "y", "z", "rx", "ry", "rz")


class Handle(int):
    """Index of a part among the parts of its kind; indexes the views of a simulation directly."""

    kind = "part"

    def __repr__(self) -> str:
        """For messages, such as ``rigid body 2``."""
        return f"{self.kind} {int(self)}"


class SoftBody(Handle):
    """A body of tetrahedra, from ``add_tets``."""

    kind = "soft body"


class RigidBody(Handle):
    """A rigid body, from ``add_rigid``; index of ``body_pose``."""

    kind = "rigid body"


class Rod(Handle):
    """A rod, from ``add_rod``; ``Model.rod_nodes`` gives its nodes in ``rod_x``."""

    kind = "rod"


class Cavity(Handle):
    """An air chamber, from ``add_cavity``."""

    kind = "cavity"


class Joint(Handle):
    """A joint, from ``add_joint``."""

    kind = "joint"


class ContactPair(Handle):
    """Two parts that may touch, from ``add_contact``."""

    kind = "contact pair"


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


@dataclass
class CavitySpec:
    """One air chamber as given to the builder."""

    name: str
    body: int
    vertices: FloatArray  # (v, 3) at rest [m]
    triangles: IntArray  # (t, 3) outward
    control: Literal["pressure", "volume", "gas"]
    limits: dict[str, float]
    exponent: float  # of the gas law
    ambient: float  # absolute pressure outside [Pa]
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
