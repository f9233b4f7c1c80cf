"""Motion of frames and of what they carry. Theory: docs/theory/frames.md.

A frame has a pose (position X, unit quaternion q) and a twist (velocity V of its origin, angular velocity w), both in
world axes; a step turns it by exp(h w). Its unknowns belong to its *master*: itself, or the frame that it is welded to.
A point at the lever r from its master moves with V + w x r.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.algebra.rotation import rotations
from softwarp.kernels.algebra.vectors import algebra


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels of frames' motion."""
    S = variant.S
    real = variant.real
    mul, fma, div = variant.mul, variant.fma, variant.div
    world_fastest = variant.world_fastest
    module = variant.module("frames")
    a, turns = algebra(variant), rotations(variant)
    vector, constant, read_vector, write_vector = a.vector, a.constant, a.read_vector, a.write_vector
    add, scaled, dot, cross = a.add, a.scaled, a.dot, a.cross
    Quaternion, quaternion = turns.Quaternion, turns.quaternion
    read_quaternion, write_quaternion = turns.read_quaternion, turns.write_quaternion
    turn, after, exponential = turns.turn, turns.after, turns.exponential
    normalized, logarithm = turns.normalized, turns.logarithm

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
            step = scaled(read_vector(dof_v_in, w, t), S(x_scale))
            turning = exponential(scaled(read_vector(dof_v_in, w, r), S(x_scale)))
            write_vector(pose_out, w, m, add(read_vector(pose0_in, w, m), step))
            write_quaternion(pose_out, w, m + 3, normalized(after(turning, read_quaternion(pose0_in, w, m + 3))))

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
        q = read_quaternion(pose_out, w, m + 3)
        offset = turn(q, constant(frame_offset, frame, 0))
        turned = after(q, quaternion(constant(frame_offset, frame, 3), S(frame_offset[frame, 6])))
        write_vector(pose_out, w, row, add(read_vector(pose_out, w, m), offset))
        write_quaternion(pose_out, w, row + 3, turned)
        row = 6 * frame
        m = 6 * frame_master[frame]
        spin = read_vector(twist_out, w, m + 3)
        write_vector(twist_out, w, row, add(read_vector(twist_out, w, m), cross(spin, offset)))
        write_vector(twist_out, w, row + 3, spin)

    @wp.func
    def likeness(p: Quaternion, q: Quaternion):
        """Scalar product of two quaternions, negative where one of them stands for the other way round."""
        return fma(p.w, q.w, dot(p.u, q.u))

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
        axis = vector(none, none, S(real(1.0)))
        p = read_quaternion(pose_out, w, a + 3)
        q = read_quaternion(pose_out, w, b + 3)
        near = (real(1.0) + real(2.0) * s) * r * r
        far = s * s * (real(3.0) - real(2.0) * s)
        start = s * r * r * length
        end = -s * s * r * length
        x = add(scaled(read_vector(pose_out, w, a), S(near)), scaled(read_vector(pose_out, w, b), S(far)))
        x = add(add(x, scaled(turn(p, axis), S(start))), scaled(turn(q, axis), S(end)))
        same = likeness(p, q)
        sign = div(same, wp.max(wp.max(same, -same), S(real(1.0e-12))))
        write_vector(pose_out, w, row, x)
        u = add(scaled(p.u, S(r)), scaled(scaled(q.u, sign), S(s)))
        write_quaternion(pose_out, w, row + 3, normalized(quaternion(u, p.w * r + mul(sign, q.w) * s)))
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
        lever = turn(read_quaternion(pose_in, w, m + 3), constant(carried_offset, item, 0))
        write_vector(lever_out, w, 3 * item, lever)
        slot = carried_slot[item]
        if slot < node_count:
            write_vector(node_x_out, w, 3 * slot, add(read_vector(pose_in, w, m), lever))

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
        item = slot_carried[slot]
        dof = slot_dof[slot]
        if item >= 0:
            v = read_vector(dof_v_in, w, 3 * carried_dof[2 * item])
            spin = read_vector(dof_v_in, w, 3 * carried_dof[2 * item + 1])
            write_vector(slot_v_out, w, 3 * slot, add(v, cross(spin, read_vector(lever_in, w, 3 * item))))
        elif dof >= 0:
            write_vector(slot_v_out, w, 3 * slot, read_vector(dof_v_in, w, 3 * dof))
        else:
            none = S(real(0.0))
            write_vector(slot_v_out, w, 3 * slot, vector(none, none, none))

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
        angle = scaled(read_vector(dof_v_in, w, row), S(x_scale))
        write_vector(u_out, w, row, logarithm(read_vector(u_out, w, row), angle).u)

    return SimpleNamespace(
        trial_pose=trial_pose,
        carry_frames=carry_frames,
        blend_frames=blend_frames,
        carry=carry,
        slot_velocity=slot_velocity,
        rotation_step=rotation_step,
    )
