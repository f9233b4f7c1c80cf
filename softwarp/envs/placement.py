"""Starts elsewhere: rigid bodies and rod nodes of some worlds put where a task's reset wants them."""

from __future__ import annotations

import torch
from torch import Tensor

from softwarp.simulation import Simulation


def place_frames(sim: Simulation, poses: Tensor, mask: Tensor, twists: Tensor | None = None) -> Tensor:
    """Move all frames of the chosen worlds, and with them all that remembers where frames were.

    Args:
        sim: Simulation whose frames move.
        poses: Position [m] and quaternion x y z w of all rigid bodies, then of all rod nodes, (world, frame, 7).
        mask: Worlds to move, bool (world,).
        twists: Velocity [m/s] and angular velocity [rad/s] of the same frames, (world, frame, 6); None leaves them.

    Returns:
        Worlds that were moved, bool (world,): those of ``mask`` whose poses and twists are finite.
    """
    sums = poses.sum(dim=(1, 2)) if twists is None else poses.sum(dim=(1, 2)) + twists.sum(dim=(1, 2))
    is_placed = mask & torch.isfinite(sums)
    chosen = is_placed[:, None, None]
    rigid = poses[:, : sim.model.rigid_count]
    places = [(sim.frame_pose, poses), (sim.good_pose, poses)]
    places += [(view, rigid) for view in (sim.held_pose, sim.seen_pose, sim.control.body_pose)]
    if twists is not None:
        places += [(sim.frame_twist, twists), (sim.good_twist, twists)]
    for view, value in places:
        torch.where(chosen, value.to(view.dtype), view, out=view)
    return is_placed
