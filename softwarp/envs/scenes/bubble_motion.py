"""A ball on a soft floor over nine air chambers, inside a rim. Scene only; task: ``tasks/bubble_motion.py``.

Frame: z is up, the origin is the middle of the board's bottom, the floor of 80 x 80 mm lies in z = 10 mm. The board is
held at its bottom and along the rim, which is a rigid body that stands on it, so that only the floor moves. Chambers
are counted in rows along y, the first row at low x. The ball is a rigid sphere that rolls.

Reference: SofaGym, scene of BubbleMotion.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, cast

import numpy as np

from softwarp import meshing, shapes
from softwarp.builder import ModelBuilder
from softwarp.envs.options.bubble_motion import RECESS_HALF, BubbleSceneConfig
from softwarp.meshing.board_geometry import FLOOR, HALF, TOP
from softwarp.scene import RigidBody
from softwarp.scene.materials import Corotational

CONTACT_CAPACITY = {"coarse": 24, "medium": 48, "fine": 128, "graded": 48}  # per world

_QUIET = 1.0e-3  # kg/m^3: the mass of a board without mass, whose inertia nobody can measure
_NEAR = 1.0e-6  # m


@dataclass(frozen=True)
class BubbleScene:
    """Ids of what was added to the builder."""

    board: int
    chambers: tuple[int, ...]  # nine
    ball: RigidBody
    rim: RigidBody


def build_bubble_scene(
    config: BubbleSceneConfig, builder: ModelBuilder, *, start: tuple[float, float, float] = (0.0, 0.0, 0.021)
) -> BubbleScene:
    """Add board, rim and ball to a builder.

    Args:
        config: Options.
        builder: What the scene is added to.
        start: Start of the ball's middle [m].
    """
    inertia = None if config.ball_inertia is None else (config.ball_inertia,) * 3
    ball = builder.add_rigid(
        shapes.Sphere(config.ball_radius), mass=config.ball_mass, inertia=inertia, pose=start, name="ball"
    )
    rim = builder.add_rigid(rim_shape(), kinematic=True, name="rim")
    board, chambers = _add_board(config, builder)
    for part in (board, rim):
        builder.add_contact(ball, part, mu=config.mu, contact_distance=config.contact_distance)
    return BubbleScene(board, chambers, ball, rim)


def _add_board(config: BubbleSceneConfig, builder: ModelBuilder) -> tuple[int, tuple[int, ...]]:
    """The plate with its chambers, held at the bottom and under the rim."""
    solid = meshing.board(config.mesh, skin=config.skin, rim=False)
    board = builder.add_tets(
        solid,
        material=Corotational(config.youngs, config.nu, method=config.rotation),
        element=cast('Literal["p1", "p2"]', config.element),
        density=max(config.density, _QUIET),
        rayleigh=config.rayleigh,
        name="board",
    )
    x, y, z = builder.bodies[board].mesh.nodes.T
    is_under_rim = (z > FLOOR - _NEAR) & (np.maximum(abs(x), abs(y)) > RECESS_HALF - _NEAR)
    builder.fix(board, nodes=np.flatnonzero((z < _NEAR) | is_under_rim))
    return board, tuple(builder.add_cavity(board, wall, min_pressure=0.0) for wall in solid.cavities.values())


def rim_shape() -> shapes.Compound:
    """Four walls around the recess, on the floor."""
    width, rise, middle = HALF - RECESS_HALF, TOP - FLOOR, 0.5 * (FLOOR + TOP)
    along, across = shapes.Box((width, 2.0 * HALF, rise)), shapes.Box((2.0 * RECESS_HALF, width, rise))
    place = 0.5 * (HALF + RECESS_HALF)
    sides = [(along, (sign * place, 0.0, middle)) for sign in (-1.0, 1.0)]
    return shapes.Compound(sides + [(across, (0.0, sign * place, middle)) for sign in (-1.0, 1.0)])
