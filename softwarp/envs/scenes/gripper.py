"""A hand with two soft fingers over an object on the floor. Scene only; the task is ``tasks/gripper.py``.

Frame: z is up, the floor lies in z = 0. The hand is driven: its origin goes to commanded places and turns about z. Its
fingers hang in its x-z plane, mirror images of each other, their tips 65 degrees from x and 169 mm apart; their bases
move exactly with the hand, and so do the points that the cables leave from. An object stands in the origin.

Reference: SofaGym, Gripper scene, whose y is our z. ``GripperConfig.paper`` lists what differs by default.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp import meshing, shapes
from softwarp.builder import ModelBuilder
from softwarp.envs.options.gripper import GripperSceneConfig
from softwarp.model.handles import RigidBody, SoftBody
from softwarp.scene.materials import Corotational

TILT = math.radians(65.0)  # of a finger against the hand's x axis, downwards
APART = 0.045  # m, from the hand's origin to a finger's
SIDES = (1.0, -1.0)  # of x
PALM = ((0.090, 0.030, 0.012), 0.036)  # m, size of the plate that pictures show, and its height above the origin
OUTSIDE = 0.001  # m, how far a cable may run outside the facets
CAPACITY = {"soft_cube": 128, "cube": 96, "sphere": 64, "capsule": 64, "figurine": 192}  # contacts of a world
ALARM = 0.0005  # m, how near beyond the contact distance a pair is looked at, besides what motion adds
SAMPLES = 0.05  # spacing of the samples of the figurine's distance, in its size
LYING = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))  # turns a capsule's axis from z to y


@dataclass(frozen=True)
class GripperScene:
    """Ids of what was added to the builder; of two, the one at positive x comes first."""

    hand: RigidBody
    floor: RigidBody
    fingers: tuple[SoftBody, SoftBody]
    cables: tuple[int, int]
    tips: tuple[int, int]  # markers at the fingers' ends
    cavities: tuple[int, ...]  # of the first finger, then of the second; empty without touch
    object: SoftBody | RigidBody
    holds: tuple[int, int]  # contact pairs of fingers and object
    object_pairs: tuple[int, ...]  # all contact pairs of the object

    @property
    def is_soft(self) -> bool:
        """Whether the object is a soft body."""
        return isinstance(self.object, SoftBody)


def build_gripper_scene(config: GripperSceneConfig, builder: ModelBuilder) -> GripperScene:
    """Add hand, fingers, floor and object to a builder."""
    size, height = PALM
    hand = builder.add_rigid(
        shapes.Compound([(shapes.Box(size), (0.0, 0.0, height))]),
        kinematic=True,
        pose=(0.0, 0.0, config.hand_start),
        max_speed=config.max_speed,
        max_spin=config.max_spin,
        name="hand",
    )
    floor = builder.add_rigid(shapes.Plane(), kinematic=True, name="floor")
    fingers, cables, tips, cavities = [], [], [], []
    for side, name in zip(SIDES, ("right", "left"), strict=True):
        is_brick = config.element == "bricks"
        source = meshing.finger_bricks() if is_brick else meshing.finger(config.mesh, config.finger)
        finger, cable, tip = _add_finger(config, builder, source, hand, side, name)
        fingers.append(finger)
        cables.append(cable)
        tips.append(tip)
        if config.touch:
            cavities += _close_cavities(config, builder, source, finger, side, name)
    thing = _add_object(config, builder)
    distance = config.contact_distance

    def touch(a: int, b: int, mu: float) -> int:
        return builder.add_contact(a, b, mu=mu, contact_distance=distance, alarm_distance=distance + ALARM)

    mu = config.mu[1]
    holds = [touch(finger, thing, mu) for finger in fingers]
    pairs = [*holds, touch(thing, floor, mu)]
    for finger in fingers:
        touch(finger, floor, 0.8)
    touch(fingers[0], fingers[1], 0.8)
    return GripperScene(
        hand,
        floor,
        (fingers[0], fingers[1]),
        (cables[0], cables[1]),
        (tips[0], tips[1]),
        tuple(cavities),
        thing,
        (holds[0], holds[1]),
        tuple(pairs),
    )


def placed(points: ArrayLike, side: float, height: float) -> NDArray[np.float64]:
    """Points of the generated finger on a side of the hand whose origin lies at a height [m]."""
    x, y, z = np.asarray(points, dtype=np.float64).T
    cos, sin = math.cos(TILT), math.sin(TILT)
    return np.stack([side * (cos * x + sin * y + APART), -side * z, height - sin * x + cos * y], axis=-1)


def _add_finger(
    config: GripperSceneConfig,
    builder: ModelBuilder,
    source: meshing.FingerMesh | meshing.FingerBricks,
    hand: RigidBody,
    side: float,
    name: str,
) -> tuple[SoftBody, int, int]:
    """One finger, its base held by the hand, its cable and the marker at its end."""
    nodes = placed(source.mesh.nodes, side, config.hand_start)
    given: dict[str, Any] = {
        "material": Corotational(config.youngs, config.nu, method=config.rotation),
        "total_mass": config.finger_mass,
        "rayleigh": config.rayleigh,
        "name": f"{name}_finger",
    }
    if isinstance(source, meshing.FingerBricks):
        finger = builder.add_hexes(nodes, source.mesh.hexes, stiffness=source.stiffness, **given)
    else:
        element = cast('Literal["p1", "p2"]', config.element)
        finger = builder.add_tets(nodes, source.mesh.tets, element=element, **given)
    held = source.base
    if config.element == "p2":  # the middles of edges between held nodes as well
        where = builder.bodies[finger].mesh.nodes
        flange = placed([[meshing.finger_geometry.FLANGE[1], 0.0, 0.0]], side, config.hand_start)[0]
        along = placed([[1.0, 0.0, 0.0]], side, 0.0)[0] - placed([[0.0, 0.0, 0.0]], side, 0.0)[0]
        held = np.flatnonzero((where - flange) @ along < 1.0e-6).astype(np.int32)
    builder.attach(finger, nodes=held, to=hand)
    points = np.concatenate([source.pull_point[None], source.cable])
    cable = builder.add_cable(
        [hand] + [finger] * len(source.cable),
        placed(points, side, config.hand_start),
        control="length",
        min_tension=config.min_tension,
        min_displacement=0.0,
        max_displacement=config.max_displacement,
        tolerance=OUTSIDE,
        name=f"{name}_cable",
    )
    ends, half = source.tip, len(source.tip) // 2
    middle = 0.5 * (nodes[ends[half]] + nodes[ends[-1 - half]])
    tip = builder.add_marker(finger, middle, tolerance=OUTSIDE, name=f"{name}_tip")
    return finger, cable, tip


def _close_cavities(
    config: GripperSceneConfig,
    builder: ModelBuilder,
    source: meshing.FingerMesh | meshing.FingerBricks,
    finger: SoftBody,
    side: float,
    name: str,
) -> list[int]:
    """The four cavities of a finger with the air that they hold at rest."""
    joints = ("inner", "outer")
    return [
        builder.add_cavity(
            finger,
            placed(vertices, side, config.hand_start),
            triangles,
            control="gas",
            name=f"{name}_{joints[number // 2]}_{number % 2}",
        )
        for number, (vertices, triangles) in enumerate(source.cavities)
    ]


def _add_object(config: GripperSceneConfig, builder: ModelBuilder) -> SoftBody | RigidBody:
    """What is to be held, at rest in the origin."""
    size, mass = config.object_size, 0.5 * sum(config.object_mass)
    if config.object == "soft_cube":
        cube = meshing.box((size,) * 3, (config.object_cells,) * 3)
        return builder.add_tets(
            cube.nodes + [-0.5 * size, -0.5 * size, config.contact_distance],
            cube.tets,
            material=Corotational(0.5 * sum(config.object_youngs), config.object_nu, method="warped"),
            total_mass=mass,
            name="object",
        )
    shape = object_shape(config.object, size)
    lowest = -0.5 * size if config.object == "capsule" else float(shape.bounds[0, 2])
    turned = LYING if config.object == "capsule" else (0.0, 0.0, 0.0, 1.0)
    pose = (0.0, 0.0, config.contact_distance - lowest, *turned)
    return builder.add_rigid(shape, mass=mass, pose=pose, name="object")


def object_shape(kind: str, size: float) -> shapes.Shape:
    """A rigid object about its centre of mass."""
    if kind == "cube":
        return shapes.Box((size, size, size))
    if kind == "sphere":
        return shapes.Sphere(0.5 * size)
    if kind == "capsule":
        return shapes.Capsule(0.5 * size, size)
    surface = meshing.figurine(size)
    centre = shapes.Mesh(surface.nodes, surface.triangles).centre
    return shapes.SDF.from_mesh(surface.nodes - centre, surface.triangles, SAMPLES * size, name=kind)
