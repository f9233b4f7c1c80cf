"""Motion of frames and of what they carry. Theory: docs/theory/frames.md.

A frame has a pose (position X, unit quaternion q) and a twist (velocity V of its origin, angular velocity w), both in
world axes; a step turns it by exp(h w). Its unknowns belong to its *master*: itself, or the frame that it is welded to.
A point at the lever r from its master moves with V + w x r.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import rotation
from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.algebra.vectors import algebra


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels of frames' motion."""
    S = variant.S
    real = variant.real
    mul, div = variant.mul, variant.div
    world_fastest = variant.world_fastest
    module = variant.module("frames")
    rot = rotation.functions(variant)
    turn, product, exponential, normalized = rot.turn, rot.product, rot.exponential, rot.normalized
    cross = rot.cross
    a = algebra(variant)

    @wp.kernel(module=module, enable_backward=False)
    def trial_pose(
        # Model
        frame_master: wp.array(dtype=wp.int32),
        frame_dof: wp.array(dtype=wp.int32),
        # Workspace in
        pose0_in: wp.array2d(dtype=S),
        dof_v_in: wp.array2d(dtype=S),
        x_scale: real,
        # Workspace out
        pose_out: wp.array2d(dtype=S),
    ):
        """Pose of one master, moved by x_scale (V, w)."""
        w, frame = wp.tid()
        if wp.static(world_fastest):
            frame, w = wp.tid()
        if frame_master[frame] == frame:
            m = 7 * frame
            t = 3 * frame_dof[2 * frame]
            r = 3 * frame_dof[2 * frame + 1]
            for c in range(3):
                pose_out[w, m + c] = pose0_in[w, m + c] + dof_v_in[w, t + c] * x_scale
            e0, e1, e2, e3 = exponential(
                dof_v_in[w, r] * x_scale, dof_v_in[w, r + 1] * x_scale, dof_v_in[w, r + 2] * x_scale
            )
            q0, q1, q2, q3 = product(
                e0, e1, e2, e3, pose0_in[w, m + 3], pose0_in[w, m + 4], pose0_in[w, m + 5], pose0_in[w, m + 6]
            )
            q0, q1, q2, q3 = normalized(q0, q1, q2, q3)
            pose_out[w, m + 3] = q0
            pose_out[w, m + 4] = q1
            pose_out[w, m + 5] = q2
            pose_out[w, m + 6] = q3

    @wp.kernel(module=module, enable_backward=False)
    def carry_frames(
        # Model
        welded_frame: wp.array(dtype=wp.int32),
        frame_master: wp.array(dtype=wp.int32),
        frame_offset: wp.array2d(dtype=real),
        # Workspace out
        pose_out: wp.array2d(dtype=S),
        twist_out: wp.array2d(dtype=S),
    ):
        """Pose and twist of one welded frame from its master's."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        frame = welded_frame[item]
        row = 7 * frame
        m = 7 * frame_master[frame]
        q0 = pose_out[w, m + 3]
        q1 = pose_out[w, m + 4]
        q2 = pose_out[w, m + 5]
        q3 = pose_out[w, m + 6]
        o0 = S(frame_offset[frame, 0])
        o1 = S(frame_offset[frame, 1])
        o2 = S(frame_offset[frame, 2])
        d0, d1, d2 = turn(q0, q1, q2, q3, o0, o1, o2)
        pose_out[w, row] = pose_out[w, m] + d0
        pose_out[w, row + 1] = pose_out[w, m + 1] + d1
        pose_out[w, row + 2] = pose_out[w, m + 2] + d2
        o3 = S(frame_offset[frame, 3])
        o4 = S(frame_offset[frame, 4])
        o5 = S(frame_offset[frame, 5])
        o6 = S(frame_offset[frame, 6])
        q0, q1, q2, q3 = product(q0, q1, q2, q3, o3, o4, o5, o6)
        pose_out[w, row + 3] = q0
        pose_out[w, row + 4] = q1
        pose_out[w, row + 5] = q2
        pose_out[w, row + 6] = q3
        row = 6 * frame
        m = 6 * frame_master[frame]
        w0 = twist_out[w, m + 3]
        w1 = twist_out[w, m + 4]
        w2 = twist_out[w, m + 5]
        c0, c1, c2 = cross(w0, w1, w2, d0, d1, d2)
        twist_out[w, row] = twist_out[w, m] + c0
        twist_out[w, row + 1] = twist_out[w, m + 1] + c1
        twist_out[w, row + 2] = twist_out[w, m + 2] + c2
        twist_out[w, row + 3] = w0
        twist_out[w, row + 4] = w1
        twist_out[w, row + 5] = w2

    @wp.kernel(module=module, enable_backward=False)
    def blend_frames(
        # Model
        blend_frame: wp.array(dtype=wp.int32),
        blend_ends: wp.array2d(dtype=wp.int32),
        blend_place: wp.array2d(dtype=real),
        # Workspace out
        pose_out: wp.array2d(dtype=S),
        twist_out: wp.array2d(dtype=S),
    ):
        """Pose and twist of one frame within a segment: Hermite's cubic, quaternions and twists by the place."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        row = 7 * blend_frame[item]
        a = 7 * blend_ends[item, 0]
        b = 7 * blend_ends[item, 1]
        s = blend_place[item, 0]
        length = blend_place[item, 1]
        r = real(1.0) - s
        none = S(real(0.0))
        unit = S(real(1.0))
        a0, a1, a2 = turn(
            pose_out[w, a + 3], pose_out[w, a + 4], pose_out[w, a + 5], pose_out[w, a + 6], none, none, unit
        )
        b0, b1, b2 = turn(
            pose_out[w, b + 3], pose_out[w, b + 4], pose_out[w, b + 5], pose_out[w, b + 6], none, none, unit
        )
        near = (real(1.0) + real(2.0) * s) * r * r
        far = s * s * (real(3.0) - real(2.0) * s)
        start = s * r * r * length
        end = -s * s * r * length
        pose_out[w, row] = pose_out[w, a] * near + pose_out[w, b] * far + a0 * start + b0 * end
        pose_out[w, row + 1] = pose_out[w, a + 1] * near + pose_out[w, b + 1] * far + a1 * start + b1 * end
        pose_out[w, row + 2] = pose_out[w, a + 2] * near + pose_out[w, b + 2] * far + a2 * start + b2 * end
        same = S(real(0.0))
        for c in range(4):
            same += mul(pose_out[w, a + 3 + c], pose_out[w, b + 3 + c])
        sign = div(same, wp.max(wp.max(same, -same), S(real(1.0e-12))))
        q0 = pose_out[w, a + 3] * r + mul(sign, pose_out[w, b + 3]) * s
        q1 = pose_out[w, a + 4] * r + mul(sign, pose_out[w, b + 4]) * s
        q2 = pose_out[w, a + 5] * r + mul(sign, pose_out[w, b + 5]) * s
        q3 = pose_out[w, a + 6] * r + mul(sign, pose_out[w, b + 6]) * s
        q0, q1, q2, q3 = normalized(q0, q1, q2, q3)
        pose_out[w, row + 3] = q0
        pose_out[w, row + 4] = q1
        pose_out[w, row + 5] = q2
        pose_out[w, row + 6] = q3
        for c in range(6):
            twist_out[w, 6 * blend_frame[item] + c] = (
                twist_out[w, 6 * blend_ends[item, 0] + c] * r + twist_out[w, 6 * blend_ends[item, 1] + c] * s
            )

    @wp.kernel(module=module, enable_backward=False)
    def carry(
        # Model
        node_count: int,
        carried_slot: wp.array(dtype=wp.int32),
        carried_frame: wp.array(dtype=wp.int32),
        carried_offset: wp.array2d(dtype=real),
        # Workspace in
        pose_in: wp.array2d(dtype=S),
        # Workspace out
        lever_out: wp.array2d(dtype=S),
        node_x_out: wp.array2d(dtype=S),
    ):
        """Lever [m] of one carried slot in world axes; a carried node's position."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        m = 7 * carried_frame[item]
        d0, d1, d2 = turn(
            pose_in[w, m + 3],
            pose_in[w, m + 4],
            pose_in[w, m + 5],
            pose_in[w, m + 6],
            S(carried_offset[item, 0]),
            S(carried_offset[item, 1]),
            S(carried_offset[item, 2]),
        )
        lever_out[w, 3 * item] = d0
        lever_out[w, 3 * item + 1] = d1
        lever_out[w, 3 * item + 2] = d2
        slot = carried_slot[item]
        if slot < node_count:
            node_x_out[w, 3 * slot] = pose_in[w, m] + d0
            node_x_out[w, 3 * slot + 1] = pose_in[w, m + 1] + d1
            node_x_out[w, 3 * slot + 2] = pose_in[w, m + 2] + d2

    @wp.kernel(module=module, enable_backward=False)
    def slot_velocity(
        # Model
        slot_dof: wp.array(dtype=wp.int32),
        slot_carried: wp.array(dtype=wp.int32),
        carried_dof: wp.array(dtype=wp.int32),
        # Workspace in
        dof_v_in: wp.array2d(dtype=S),
        lever_in: wp.array2d(dtype=S),
        # Workspace out
        slot_v_out: wp.array2d(dtype=S),
    ):
        """Velocity of one slot: its dof's, V + w x r if a frame carries it, 0 if it is fixed."""
        w, slot = wp.tid()
        if wp.static(world_fastest):
            slot, w = wp.tid()
        row = 3 * slot
        v0 = S(real(0.0))
        v1 = S(real(0.0))
        v2 = S(real(0.0))
        item = slot_carried[slot]
        if item >= 0:
            t = 3 * carried_dof[2 * item]
            r = 3 * carried_dof[2 * item + 1]
            c0, c1, c2 = cross(
                dof_v_in[w, r],
                dof_v_in[w, r + 1],
                dof_v_in[w, r + 2],
                lever_in[w, 3 * item],
                lever_in[w, 3 * item + 1],
                lever_in[w, 3 * item + 2],
            )
            v0 = dof_v_in[w, t] + c0
            v1 = dof_v_in[w, t + 1] + c1
            v2 = dof_v_in[w, t + 2] + c2
        else:
            dof = slot_dof[slot]
            if dof >= 0:
                v0 = dof_v_in[w, 3 * dof]
                v1 = dof_v_in[w, 3 * dof + 1]
                v2 = dof_v_in[w, 3 * dof + 2]
        slot_v_out[w, row] = v0
        slot_v_out[w, row + 1] = v1
        slot_v_out[w, row + 2] = v2

    @wp.kernel(module=module, enable_backward=False)
    def rotation_step(
        # Model
        turning_frame: wp.array(dtype=wp.int32),
        frame_dof: wp.array(dtype=wp.int32),
        # Workspace in
        dof_v_in: wp.array2d(dtype=S),
        x_scale: real,
        # Workspace out
        u_out: wp.array2d(dtype=S),
    ):
        """From a change of rotation on top of exp(h w) to the change of w: the inverse left Jacobian at h w."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        row = 3 * frame_dof[2 * turning_frame[item] + 1]
        angle = a.scaled(a.read_vector(dof_v_in, w, row), S(x_scale))
        a.write_vector(u_out, w, row, a.logarithm(a.read_vector(u_out, w, row), angle).u)

    return SimpleNamespace(
        trial_pose=trial_pose,
        carry_frames=carry_frames,
        blend_frames=blend_frames,
        carry=carry,
        slot_velocity=slot_velocity,
        rotation_step=rotation_step,
    )
