"""Rows of joints in adjoints: whose sides they have, in the axes of masters. Theory: docs/theory/adjoint.md."""

from __future__ import annotations

import numpy as np
import warp as wp

from softwarp.shapes.base import quaternion_product, rotation_matrix
from softwarp.solvers.frame_adjoint import FrameAdjoint, lists
from softwarp.solvers.terms.joints import JointTerm
from softwarp.solvers.workspace.rows import Rows
from softwarp.solvers.workspace.shard import Shard


class JointSides:
    """Sides of the joints of one shard.

    Args:
        shard: Worlds.
        term: Joints.
        frames: Adjoint of frames, whose velocities joints make others than those that momentum receives.

    Attributes:
        is_held: 1 for rows without bounds.
        gyrates: 1 for frames that turn freely within a step.
        joint_frame, joint_place: Frames of both sides of joints and their places there, in those of masters.
        sides: Sides of rows by frames.
    """

    def __init__(self, shard: Shard, term: JointTerm, frames: FrameAdjoint) -> None:
        self.shard, self.term, self.frames = shard, term, frames
        s, m = shard, term.model
        held = np.zeros(m.rows, dtype=np.int32)
        held[m.unbounded] = 1
        self.is_held = wp.array(held, dtype=wp.int32, device=s.device)
        gyrates = np.zeros(self.frames.model.count, dtype=np.int32)
        gyrates[m.gyrating_frame.numpy()] = 1
        self.gyrates = wp.array(gyrates, dtype=wp.int32, device=s.device)
        pairs, places = self._sides_of_masters()
        self.joint_frame = wp.array(pairs, dtype=wp.int32, device=s.device)
        self.joint_place = wp.array(places, dtype=s.variant.real, device=s.device)
        sides = pairs[m.row_joint.numpy()].ravel()  # 2 row for the parent, 2 row + 1 for the child
        self.sides = lists(sides, self.frames.model.count, s.device)
        frames.splits, frames.gyrates = True, self.gyrates

    def _sides_of_masters(self) -> tuple[np.ndarray, np.ndarray]:
        """Frames of both sides of joints, (joint, 2), and their places there, (joint, 14), all in those of masters."""
        m, frames = self.term.model, self.frames.model
        pairs, places = m.frames.copy(), m.joint_place.numpy().astype(np.float64).reshape(-1, 14)
        offset = frames.frame_offset.numpy().reshape(-1, 7)
        for joint, side in np.argwhere(pairs >= 0):
            frame = pairs[joint, side]
            if frames.master[frame] != frame:
                place = places[joint, 7 * side : 7 * side + 7]
                x = offset[frame, :3] + rotation_matrix(offset[frame, 3:]) @ place[:3]
                place[:] = np.concatenate([x, quaternion_product(offset[frame, 3:], place[3:])])
                pairs[joint, side] = frames.master[frame]
        return pairs, places

    def _to_frames(self, v: Rows, twist: Rows) -> None:
        """What dofs have, as twists of frames."""
        m = self.frames.model
        self.shard.each_real(self.term.k.gather_twist, m.count, [m.frame_dof, v.real], [twist.real])
