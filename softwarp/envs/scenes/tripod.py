"""A flat silicone tripod whose legs three servo arms hold and bend down, a rigid plate in its middle. Scene only.

Frame: z is up. SofaGym's Maze scene has y up: its (x, y, z) is our (x, -z, y). The star lies flat between z = 25 and
30 mm, its legs along +y and 120 degrees to both sides. Servo i stands below the end of leg i, 60 mm from the axis; its
arm points up, turns about the servo's axis across the leg, and carries the end of the leg: exactly, as a rigid body
carries nodes. The setup motion moves the servos inwards and turns the arms outwards, until the legs' ends stand almost
upright and carry the middle like a table. Angles are 0 in the flat state, negative outwards.

Reference: Tripod tutorial of SoftRobots for SOFA, and SofaGym's Maze scene.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import torch
from numpy.typing import NDArray

from softwarp import meshing, shapes
from softwarp.advice import nearest
from softwarp.builder import ModelBuilder
from softwarp.envs.options.tripod import RESOLUTIONS, SERVOS, TripodSceneConfig
from softwarp.model.handles import Joint, RigidBody, SoftBody
from softwarp.scene.materials import Corotational
from softwarp.simulation import Simulation

FloatArray = NDArray[np.float64]

HEIGHT = 0.030  # m, of the flat star's upper face
ARM = 0.025  # m, from a servo's axis to the middle of the box in which its arm holds nodes
GRIP = (0.045, 0.030, 0.015)  # m, of that box: across the leg, along it, upwards
PLATE_REACH = 0.0075  # m, from the middle of the upper face, within which nodes belong to the plate
SETUP_STEPS = 20  # of 10 ms
PIN = (0.010, 0.010, 0.002)  # m, size of what pictures show of a plate without a shape
PIN_MASS, PIN_INERTIA = 1.0e-6, (1.0e-10, 1.0e-10, 1.0e-10)  # kg, kg m^2: next to those of the nodes that it carries


@dataclass(frozen=True)
class TripodScene:
    """Ids of what was added to the builder; of three, the one at +y comes first, then counterclockwise from above."""

    body: SoftBody
    plate: RigidBody
    bases: tuple[RigidBody, ...]
    arms: tuple[RigidBody, ...]
    motors: tuple[Joint, ...]
    middle: int  # marker on the axis, in the upper face


def build_tripod_scene(
    config: TripodSceneConfig, builder: ModelBuilder, plate: dict[str, Any] | None = None
) -> TripodScene:
    """Add the flat star, its plate, and the servos to a builder.

    Args:
        config: Options.
        builder: What the scene is added to.
        plate: Options of ``ModelBuilder.add_rigid`` for the plate; None makes a small one almost without mass in the
            middle of the star's upper face.
    """
    body = add_star(config, builder)
    nodes = builder.bodies[body].mesh.nodes
    top = np.array([0.0, 0.0, HEIGHT])
    small: dict[str, Any] = {"shape": shapes.Box(PIN), "mass": PIN_MASS, "inertia": PIN_INERTIA, "pose": tuple(top)}
    middle = builder.add_rigid(**(small if plate is None else plate), name="plate")
    builder.attach(body, np.flatnonzero(np.linalg.norm(nodes - top, axis=1) <= PLATE_REACH), to=middle)
    bases, arms, motors = [], [], []
    for servo in range(SERVOS):
        base, arm, motor = _add_servo(config, builder, servo)
        builder.attach(body, held_nodes(config, nodes, servo), to=arm)
        bases.append(base)
        arms.append(arm)
        motors.append(motor)
    marker = builder.add_marker(middle, tuple(top), name="middle")
    return TripodScene(body, middle, tuple(bases), tuple(arms), tuple(motors), marker)


def add_star(config: TripodSceneConfig, builder: ModelBuilder) -> SoftBody:
    """The star itself, flat, of the configured elements."""
    law = Corotational(config.youngs, config.nu, method=config.rotation)
    given: dict[str, Any] = {"material": law, "total_mass": config.total_mass, "rayleigh": config.rayleigh}
    given["name"] = "tripod"
    if config.element == "walls":
        return builder.add_hexes(tripod_walls(), thin=True, **given)
    element = cast('Literal["p1", "p2"]', config.element)
    lumping = cast('Literal["volume", "uniform"]', config.lumping if element == "p1" else "volume")
    return builder.add_tets(tripod_mesh(config), element=element, lumping=lumping, **given)


def _add_servo(config: TripodSceneConfig, builder: ModelBuilder, servo: int) -> tuple[RigidBody, RigidBody, Joint]:
    """Base, arm and motor of one servo; the frames of both bodies lie on its axis."""
    pose = (*servo_place(config.radius, config.servo_height, servo), *_quaternion(servo))
    base = builder.add_rigid(_base_shape(), kinematic=True, pose=pose, name=f"servo_{servo}")
    arm = builder.add_rigid(_arm_shape(), mass=config.arm_mass, pose=pose, name=f"arm_{servo}")
    motor = builder.add_joint(
        base,
        arm,
        axis=tuple(turn(servo)[:, 0]),
        limits=config.joint_limits,
        control="position",
        max_force=config.max_torque,
        max_rate=config.max_speed,
        name=f"motor_{servo}",
    )
    return base, arm, motor


def tripod_mesh(config: TripodSceneConfig) -> meshing.TetMesh:
    """The generated mesh of a resolution, or the file that ``config.mesh`` names, in its place.

    Raises:
        ValueError: If it is neither; the message lists the resolutions.
        MeshError: If the file holds no usable tetrahedra.
    """
    if config.mesh in RESOLUTIONS:
        made = meshing.tripod(config.mesh)
        return meshing.TetMesh(made.nodes + np.array([0.0, 0.0, HEIGHT]), made.tets, made.name)
    if not Path(config.mesh).is_file():
        advice = nearest(config.mesh, RESOLUTIONS)
        raise ValueError(f"tripod mesh {config.mesh!r} is neither a file nor one of {', '.join(RESOLUTIONS)}; {advice}")
    from softwarp.io.mesh import read_mesh

    mesh = read_mesh(config.mesh, scale=config.mesh_scale)
    x, y, z = mesh.nodes.T
    return meshing.TetMesh(np.stack([x, -y, HEIGHT - z], axis=1), mesh.tets, name=Path(config.mesh).name)


def tripod_walls() -> meshing.HexMesh:
    """The generated hexahedra in their place."""
    made = meshing.tripod_bricks()
    return meshing.HexMesh(made.nodes + np.array([0.0, 0.0, HEIGHT]), made.hexes, made.name)


def held_nodes(config: TripodSceneConfig, nodes: FloatArray, servo: int) -> NDArray[np.int64]:
    """Nodes of the flat star inside the box around the end of a servo's arm."""
    middle = servo_place(config.radius, config.servo_height, servo) + np.array([0.0, 0.0, ARM])
    local = (nodes - middle) @ turn(servo)
    return np.flatnonzero((np.abs(local) <= 0.5 * np.array(GRIP) + 1.0e-9).all(axis=1))


def turn(servo: int) -> FloatArray:
    """Axes of a servo's frame in columns: x along its axis, y outwards, z up."""
    angle = 2.0 * math.pi * servo / SERVOS
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def servo_place(radius: float, height: float, servo: int) -> FloatArray:
    """Where a servo's axis meets the plane of its leg [m], (3,)."""
    return np.asarray(turn(servo) @ np.array([0.0, radius, height]))


def _quaternion(servo: int) -> tuple[float, float, float, float]:
    half = math.pi * servo / SERVOS
    return 0.0, 0.0, math.sin(half), math.cos(half)


def _base_shape() -> shapes.Compound:
    """A small servo motor: 12 mm along the leg, 23 mm across it, inwards of and below its axis."""
    return shapes.Compound([(shapes.Box((0.023, 0.012, 0.024)), (0.0, -0.010, -0.007))])


def _arm_shape() -> shapes.Compound:
    """The arm: a bar from the axis to the plate that holds the leg."""
    bar = shapes.Box((0.006, 0.005, ARM))
    return shapes.Compound(
        [(bar, (0.0, 0.0, 0.5 * ARM)), (shapes.Box((0.032, 0.012, 0.003)), (0.0, -0.011, ARM + 0.001))]
    )


def set_up(sim: Simulation, scene: TripodScene, config: TripodSceneConfig) -> None:
    """Move the servos inwards and turn the arms, in all worlds, during 0.2 s; the tripod is not at rest then.

    The joints' limits become those of the servos, which need not let through the flat state.
    """
    start = sim.control.body_pose.clone()
    steps = max(1, round(SETUP_STEPS * 0.01 / sim.dt))
    inwards = torch.tensor(
        np.stack([-config.advance * turn(servo)[:, 1] for servo in range(SERVOS)]),
        dtype=start.dtype,
        device=start.device,
    )
    bases = torch.tensor(scene.bases, device=start.device)
    motors = torch.tensor(scene.motors, device=start.device)
    for step in range(steps):
        share = (step + 1) / steps
        sim.control.body_pose[:, bases, :3] = start[:, bases, :3] + share * inwards
        sim.control.joint_target[:, motors] = share * config.angle
        sim.step()
    sim.params.joint_min_position[:, motors] = config.min_angle
    sim.params.joint_max_position[:, motors] = config.max_angle
