"""A soft rod that swings about a hinge at its root. Scene only; the task is ``tasks/stem_pendulum.py``.

Frame: z is up, the hinge lies in the origin, all motion is in the x-z plane. The angle of the root is 0 upright and
grows towards -x, counter-clockwise for whoever looks along +y; the tip of the straight rod is at L (-sin, 0, cos). A
motor and a weak spring turn the root.

With E I the bending stiffness, a rod of this weight m g sags by m g L^3 / (8 E I), four tenths of its length, when it
is held level; upright it does not buckle (m g L^2 / (E I) is 3.3 of 7.8).

Reference: SofaGym, scene of StemPendulum.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from softwarp import meshing
from softwarp.builder import ModelBuilder
from softwarp.envs.options.stem_pendulum import PendulumConfig
from softwarp.scene import Joint, Rod


@dataclass(frozen=True)
class PendulumScene:
    """Ids of what was added to the builder."""

    rod: Rod
    hinge: Joint  # spring and motor; its position is the angle of the root


def build_pendulum_scene(config: PendulumConfig, builder: ModelBuilder) -> PendulumScene:
    """Add the rod, upright, with its hinge."""
    rod = builder.add_rod(
        meshing.straight(config.length, config.segments),
        radius=config.radius,
        youngs=config.youngs,
        nu=config.nu,
        density=config.density,
        normal=(1.0, 0.0, 0.0),
        rayleigh=config.rayleigh,
        name="rod",
    )
    stiffness = config.root_stiffness
    hinge = builder.add_joint(
        None, (rod, 0), "hinge", axis=(0.0, -1.0, 0.0), control="position", stiffness=stiffness, name="hinge"
    )
    return PendulumScene(rod, hinge)


def straight_poses(angle: Tensor, arc_length: Tensor) -> Tensor:
    """Poses of points along the straight rod.

    Args:
        angle: Of the root [rad], shape (world,).
        arc_length: Of the points, from the root [m], shape (point,).

    Returns:
        Positions [m] and quaternions x y z w, shape (world, point, 7).
    """
    turn = angle[:, None].expand(-1, arc_length.shape[0])
    zero, half = torch.zeros_like(turn), 0.5 * turn
    x, z = -turn.sin() * arc_length, turn.cos() * arc_length
    return torch.stack((x, zero, z, zero, -half.sin(), zero, half.cos()), dim=-1)
