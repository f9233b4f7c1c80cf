"""Constants of joints between rigid bodies, rod nodes and the world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softwarp.model.fields import shared

IntArray = NDArray[np.int32]


@dataclass
class JointModel:
    """Joints and their multiplier rows, which follow those of cables and chambers; they count from the first one."""

    # Host
    kinds: tuple[str, ...]
    frames: IntArray  # (joint, 2) parent or -1, child
    rows: int
    unbounded: IntArray  # rows that are eliminated
    velocity_controlled: NDArray[np.bool_]  # (joint,)

    # Device
    joint_frame: wp.array = shared("joint", doc="frames of parent (-1: the world) and child, (joint, 2)")
    joint_place: wp.array = shared("joint", unit="m", doc="joint's pose in the parent and in the child, (joint, 14)")
    joint_free: wp.array = shared("joint", doc="free coordinate: 0 none, 1 angle, 2 way")
    joint_control: wp.array = shared("joint", doc="0 none, 1 position, 2 velocity, 3 force")
    joint_length: wp.array = shared("joint", unit="m", doc="length that rows which turn are multiplied by")
    joint_scale: wp.array = shared("joint", doc="metres of a row per unit of the free coordinate: the length, or 1")
    joint_row_start: wp.array = shared("joint", doc="ranges of rows, (joint + 1,)")
    row_joint: wp.array = shared("joint row", doc="joint of a row")
    row_kind: wp.array = shared("joint row", doc="what the row holds: model.codes.JointRow")
    row_axis: wp.array = shared("joint row", doc="axis of the world, or of the joint, that it acts along")
    gyrating_frame: wp.array = shared("gyrating", doc="rigid bodies with joints that are free to turn and move")
    turned_frame: wp.array = shared("turned", doc="masters that joints turn")
    turned_start: wp.array = shared("turned", doc="ranges in turned_side, (turned + 1,)")
    turned_side: wp.array = shared("side", doc="2 joint for its parent, 2 joint + 1 for its child")

    @property
    def count(self) -> int:
        """Joints."""
        return len(self.kinds)
