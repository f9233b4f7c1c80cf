"""A pneumatic quadruped on a floor with friction. Scene only; the task is ``tasks/multi_gait_full.py``.

Frame: z is up, x is the direction in which it crawls, the origin is the middle of the base, which lies in z = 0; the
floor lies below it by the distance at which surfaces rest on each other. Five chambers swell upwards; a stiff skin
keeps the base from stretching, so that a body whose chambers are filled bends its ends down. What touches the floor is
a surface of its own, with few points: contacts cost much more than elements.

Reference: SofaGym, MultiGait scene, and the quadruped of SOFA's plugin for model order reduction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, cast

import numpy as np
from numpy.typing import NDArray

from softwarp import meshing, shapes
from softwarp.builder import ModelBuilder
from softwarp.envs.options.multi_gait_full import MultiGaitSceneConfig
from softwarp.meshing.quadruped_geometry import CHAMBERS, base_triangles, quadruped_skin
from softwarp.model.handles import RigidBody, SoftBody
from softwarp.scene.materials import Corotational, Material, NeoHookean, StableNeoHookean

# Places [m] on the base of the points that tell where the robot is: three of every leg, from the body outwards, and
# five along the axis of the body.
_LEG = ((0.0305, 0.0090), (0.0470, 0.0165), (0.0640, 0.0235))
_AXIS = (-0.0240, -0.0120, 0.0, 0.0120, 0.0240)
TRACKED: NDArray[np.float64] = np.array(
    [(sx * x, sy * y) for sx in (-1.0, 1.0) for sy in (-1.0, 1.0) for x, y in _LEG] + [(x, 0.0) for x in _AXIS]
)
AXIS_ENDS = (12, 16)  # of the tracked points, at the rear legs and at the front legs


@dataclass(frozen=True)
class MultiGaitScene:
    """Ids of what was added to the builder.

    Attributes:
        body: The robot.
        floor: What it crawls on.
        chambers: Cavities in the order of ``CHAMBERS``: centre, front left, front right, rear left, rear right.
        tracked: Nodes of the base next to ``TRACKED``, shape (17,).
        base: Triangles of the stiff skin, nodes of the body, shape (t, 3).
    """

    body: SoftBody
    floor: RigidBody
    chambers: tuple[int, ...]
    tracked: tuple[int, ...]
    base: NDArray[np.int32]


def build_multi_gait_scene(config: MultiGaitSceneConfig, builder: ModelBuilder) -> MultiGaitScene:
    """Add robot and floor to a builder."""
    solid = meshing.quadruped(config.mesh)
    floor = builder.add_rigid(shapes.Plane(), kinematic=True, pose=(0.0, 0.0, -config.contact_distance), name="floor")
    body = builder.add_tets(
        solid,
        material=_material(config),
        total_mass=config.body_mass,
        lumping=cast('Literal["volume", "uniform"]', config.lumping),
        rayleigh=config.rayleigh,
        contact_surface=quadruped_skin(config.contact_spacing),
        name="quadruped",
    )
    base = base_triangles(solid)
    builder.add_membrane(
        body, base, thickness=config.base_thickness, youngs=config.base_youngs, nu=config.base_nu, name="base"
    )
    chambers = tuple(builder.add_cavity(body, solid.cavities[name], control="volume") for name in CHAMBERS)
    builder.add_contact(
        body,
        floor,
        mu=config.mu,
        contact_distance=config.contact_distance,
        alarm_distance=config.alarm_distance,
    )
    under = np.unique(base)
    away = np.linalg.norm(solid.nodes[under, None, :2] - TRACKED[None], axis=2)
    tracked = tuple(int(node) for node in under[away.argmin(axis=0)])
    return MultiGaitScene(body, floor, chambers, tracked, base)


def _material(config: MultiGaitSceneConfig) -> Material:
    """Silicone of the body. Walls stretch to twice their length and more, where only the neo-Hookean laws hold."""
    if config.law == "corotational":
        return Corotational(config.youngs, config.nu, method=config.rotation)
    return {"neo_hookean": NeoHookean, "stable_neo_hookean": StableNeoHookean}[config.law](config.youngs, config.nu)
