"""Two inflatable pads, a ball that falls between them, a cart below. Scene only; task: ``tasks/catch_the_object.py``.

Frame: z is up, all motion is in the x-z plane. The pads' fronts face each other at x = -15 mm and +15 mm, their middle
is at z = 135 mm, and the middles of their backs are clamped. The ball falls along the z axis: a point mass with drag,
which does not turn. The cart is an open box of 60 x 40 x 30 mm that follows commands along x, its bottom at z = 0.

Reference: SofaGym, scene of CatchTheObject.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, cast

import numpy as np

from softwarp import meshing, shapes
from softwarp.advice import nearest
from softwarp.builder import ModelBuilder
from softwarp.envs.options.catch_the_object import GAP, RESOLUTIONS, CatchSceneConfig
from softwarp.scene import RigidBody
from softwarp.scene.materials import Corotational

PAD_HEIGHT = 0.135  # m, middle of the pads
CLAMP = (0.020, 0.025)  # m, half extents in y and z of the clamped part of a back
CART_SIZE = (0.060, 0.040, 0.030)  # m, outside
CART_WALL, CART_FLOOR = 0.005, 0.010  # m, thickness
CONTACT_CAPACITY = {"coarse": 16, "medium": 64, "fine": 160}  # per world: what comes near a fast ball, nodes above all

_QUIET = 1.0e-3  # kg/m^3: the mass of a pad without mass, whose inertia nobody can measure


@dataclass(frozen=True)
class CatchScene:
    """Ids of what was added to the builder."""

    pads: tuple[int, int]  # at negative and at positive x
    chambers: tuple[int, int]
    ball: RigidBody
    cart: RigidBody


def build_catch_scene(config: CatchSceneConfig, builder: ModelBuilder, *, ball_height: float = 0.235) -> CatchScene:
    """Add pads, ball and cart to a builder.

    Args:
        config: Options.
        builder: What the scene is added to.
        ball_height: Start of the ball [m].
    """
    ball = builder.add_rigid(
        shapes.Sphere(config.ball_radius),
        mass=config.ball_mass,
        free_axes=("x", "y", "z"),
        damping=config.ball_damping,
        pose=(0.0, 0.0, ball_height),
        name="ball",
    )
    cart = builder.add_rigid(cart_shape(), kinematic=True, name="cart")
    pads, chambers = [], []
    for side, name in ((-1.0, "left"), (1.0, "right")):
        pad, chamber = add_pad(config, builder, side, name)
        pads.append(pad)
        chambers.append(chamber)
    for part in (*pads, cart):
        builder.add_contact(ball, part, mu=config.mu, contact_distance=config.contact_distance)
    return CatchScene((pads[0], pads[1]), (chambers[0], chambers[1]), ball, cart)


def add_pad(config: CatchSceneConfig, builder: ModelBuilder, side: float, name: str) -> tuple[int, int]:
    """One pad on a side of the x axis, clamped, with its chamber."""
    if config.mesh not in RESOLUTIONS:
        raise ValueError(f"unknown pad mesh {config.mesh!r}; {nearest(config.mesh, RESOLUTIONS)}")
    source = meshing.pad(config.mesh)
    pad = builder.add_tets(
        _placed(source.mesh.nodes, side),
        source.mesh.tets,
        material=Corotational(config.youngs, config.nu, method=config.rotation),
        element=cast('Literal["p1", "p2"]', config.element),
        density=max(config.density, _QUIET),
        rayleigh=config.rayleigh,
        name=f"{name}_pad",
    )
    back = side * (0.5 * GAP + meshing.pad_geometry.DEPTH)
    low = (back - 1e-6, -CLAMP[0], PAD_HEIGHT - CLAMP[1])
    builder.fix(pad, box=(low, (back + 1e-6, CLAMP[0], PAD_HEIGHT + CLAMP[1])))
    vertices, triangles = _placed(source.cavity_vertices, side), source.cavity_triangles
    if config.element == "p2":
        solid = builder.bodies[pad].mesh
        (wall,) = meshing.voids(solid.nodes, solid.tets)
        numbers, corners = np.unique(wall, return_inverse=True)
        vertices, triangles = solid.nodes[numbers], corners.reshape(-1, 3).astype(np.int32)
    chamber = builder.add_cavity(pad, vertices, triangles, min_pressure=0.0, name=f"{name}_chamber")
    return pad, chamber


def _placed(points: np.ndarray, side: float) -> np.ndarray:
    """Points of the generated pad, its front turned to the other one."""
    x, y, z = points.T
    return np.stack([side * (0.5 * GAP - z), -side * y, PAD_HEIGHT - x], axis=1)


def cart_shape() -> shapes.Compound:
    """The open box: a floor and four walls, the middle of its bottom in the origin."""
    length, width, height = CART_SIZE
    rise = height - CART_FLOOR
    parts = [(shapes.Box((length, width, CART_FLOOR)), (0.0, 0.0, 0.5 * CART_FLOOR))]
    for sign in (-1.0, 1.0):
        middle = CART_FLOOR + 0.5 * rise
        across = shapes.Box((CART_WALL, width, rise))
        along = shapes.Box((length - 2.0 * CART_WALL, CART_WALL, rise))
        parts.append((across, (sign * 0.5 * (length - CART_WALL), 0.0, middle)))
        parts.append((along, (0.0, sign * 0.5 * (width - CART_WALL), middle)))
    return shapes.Compound(parts)
