"""Prescribed unknowns: kinematic bodies, clamped rod nodes and locked axes. Theory: docs/theory/frames.md.

With P the projection on unknown scalars and v_p the prescribed velocities, A u = b becomes
    (P A P + 1 - P) u = P (b - A c) + c,   c = (1 - P) (v_p - v),
v the velocity that u is added to. The structure of A does not change, so any world may prescribe other values.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.elements import assembly


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Elimination of prescribed scalars from the linear system."""
    S = variant.S
    real = variant.real
    world_fastest = variant.world_fastest
    module = variant.module("prescribed")
    row_product = assembly.kernels(variant).row_product

    @wp.kernel(module=module, enable_backward=False)
    def prescribed_change(
        # Model
        prescribed_dof: wp.array(dtype=wp.int32),
        dof_free: wp.array2d(dtype=real),
        # Workspace in
        prescribed_v_in: wp.array2d(dtype=S),
        dof_v_in: wp.array2d(dtype=S),
        # Workspace out
        change_out: wp.array2d(dtype=S),
    ):
        """c of the module docstring for one dof with prescribed scalars."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        dof = prescribed_dof[item]
        for c in range(3):
            row = 3 * dof + c
            change_out[w, row] = (prescribed_v_in[w, row] - dof_v_in[w, row]) * (real(1.0) - dof_free[dof, c])

    @wp.kernel(module=module, enable_backward=False)
    def known_to_right(
        # Model
        touched_dof: wp.array(dtype=wp.int32),
        dof_free: wp.array2d(dtype=real),
        neighbour_start: wp.array(dtype=wp.int32),
        neighbour: wp.array(dtype=wp.int32),
        neighbour_block: wp.array(dtype=wp.int32),
        # Workspace in
        a_in: wp.array2d(dtype=S),
        change_in: wp.array2d(dtype=S),
        # Workspace out
        b_out: wp.array2d(dtype=S),
    ):
        """b <- P (b - A c) + c for one dof with prescribed scalars, or a neighbour of one."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        dof = touched_dof[item]
        row = 3 * dof
        r0, r1, r2 = row_product(a_in, change_in, w, dof, neighbour_start, neighbour, neighbour_block)
        b_out[w, row] = (b_out[w, row] - r0) * dof_free[dof, 0] + change_in[w, row]
        b_out[w, row + 1] = (b_out[w, row + 1] - r1) * dof_free[dof, 1] + change_in[w, row + 1]
        b_out[w, row + 2] = (b_out[w, row + 2] - r2) * dof_free[dof, 2] + change_in[w, row + 2]

    @wp.kernel(module=module, enable_backward=False)
    def mask_blocks(
        # Model
        masked_block: wp.array(dtype=wp.int32),
        a_row: wp.array(dtype=wp.int32),
        a_col: wp.array(dtype=wp.int32),
        dof_free: wp.array2d(dtype=real),
        # Workspace out
        a_out: wp.array2d(dtype=S),
    ):
        """A <- P A P + 1 - P for one block."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        block = masked_block[item]
        i = a_row[block]
        j = a_col[block]
        for r in range(3):
            for c in range(3):
                row = 9 * block + 3 * r + c
                a_out[w, row] = a_out[w, row] * (dof_free[i, r] * dof_free[j, c])
                if i == j and r == c:
                    a_out[w, row] += S(real(1.0) - dof_free[i, r])

    @wp.kernel(module=module, enable_backward=False)
    def clear_known(
        # Model
        prescribed_dof: wp.array(dtype=wp.int32),
        dof_free: wp.array2d(dtype=real),
        # Workspace out
        y_out: wp.array2d(dtype=S),
    ):
        """y <- P y for one dof with prescribed scalars."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        dof = prescribed_dof[item]
        for c in range(3):
            y_out[w, 3 * dof + c] = y_out[w, 3 * dof + c] * dof_free[dof, c]

    return SimpleNamespace(
        clear_known=clear_known,
        prescribed_change=prescribed_change,
        known_to_right=known_to_right,
        mask_blocks=mask_blocks,
    )


@single_worlds
def command_kernels(variant: Variant) -> SimpleNamespace:
    """Commands of kinematic bodies."""
    real = variant.real
    one = single.functions(variant)
    vec3, quat, vector_at, quat_at = one.vec3, one.quat, one.vector_at, one.quat_at
    put, put_quat, exponential, logarithm = one.put, one.put_quat, one.exponential, one.logarithm
    module = variant.module("prescribed.command")

    @wp.func
    def pose_at(array: wp.array3d(dtype=real), pack: int, lane: int, row: int):
        """Position and normalised quaternion in seven rows; a zero quaternion stands for no turn."""
        x = vector_at(array, pack, lane, row)
        q = quat_at(array, pack, lane, row + 3)
        length = wp.length(q)
        if length < real(1.0e-6):
            q = quat(real(0.0), real(0.0), real(0.0), real(1.0))
        else:
            q = q / length
        return x, q

    @wp.func
    def limited(v: vec3, limit: real):
        """v, no longer than a limit."""
        length = wp.length(v)
        if length > limit:
            return v * (limit / length)
        return v

    @wp.kernel(module=module, enable_backward=False)
    def kinematic_command(
        # Model
        kinematic_frame: wp.array(dtype=wp.int32),
        frame_dof: wp.array(dtype=wp.int32),
        # Workspace in
        pose0_in: wp.array3d(dtype=real),
        seen_in: wp.array3d(dtype=real),
        command_pose_in: wp.array3d(dtype=real),
        command_velocity_in: wp.array3d(dtype=real),
        max_speed_in: wp.array3d(dtype=real),
        max_spin_in: wp.array3d(dtype=real),
        lag_in: wp.array3d(dtype=real),
        h: real,
        ahead: real,
        # Workspace out
        held_out: wp.array3d(dtype=real),
        seen_out: wp.array3d(dtype=real),
        prescribed_v_out: wp.array3d(dtype=real),
    ):
        """Velocities that bring one kinematic body to its held pose, as fast as its limits allow.

        The held pose follows every change of the pose command and moves for ``ahead`` [s] with the velocity command.
        The part ``lag_in`` of the way to it is left to later stages of the step.
        """
        pack, item, lane = wp.tid()
        frame = kinematic_frame[item]
        row = 7 * frame
        changed = bool(False)
        for c in range(7):
            command = command_pose_in[pack, row + c, lane]
            if command != seen_in[pack, row + c, lane]:
                changed = True
            seen_out[pack, row + c, lane] = command
        x, q = pose_at(held_out, pack, lane, row)
        if changed:
            x, q = pose_at(command_pose_in, pack, lane, row)
        v = vector_at(command_velocity_in, pack, lane, 6 * frame)
        spin = vector_at(command_velocity_in, pack, lane, 6 * frame + 3)
        x = x + v * ahead
        q = wp.normalize(exponential(spin * ahead) * q)
        put(held_out, pack, lane, row, x)
        put_quat(held_out, pack, lane, row + 3, q)
        x0, q0 = pose_at(pose0_in, pack, lane, row)
        v = (x - x0) / h
        spin = logarithm(q * wp.quat_inverse(q0)) / h
        lag = lag_in[pack, 0, lane]
        v = limited(v - v * lag, max_speed_in[pack, frame, lane])
        spin = limited(spin - spin * lag, max_spin_in[pack, frame, lane])
        put(prescribed_v_out, pack, lane, 3 * frame_dof[2 * frame], v)
        put(prescribed_v_out, pack, lane, 3 * frame_dof[2 * frame + 1], spin)

    @wp.kernel(module=module, enable_backward=False)
    def commanded_way(
        # Model
        kinematic_frame: wp.array(dtype=wp.int32),
        frame_dof: wp.array(dtype=wp.int32),
        extent: real,
        # Workspace in
        prescribed_v_in: wp.array3d(dtype=real),
        h: real,
        # Workspace out
        commanded_out: wp.array3d(dtype=real),
    ):
        """Longest way [m] that kinematic bodies take points within ``extent`` [m] in this step."""
        pack, lane = wp.tid()
        way = real(0.0)
        for item in range(kinematic_frame.shape[0]):
            frame = kinematic_frame[item]
            v = vector_at(prescribed_v_in, pack, lane, 3 * frame_dof[2 * frame])
            spin = vector_at(prescribed_v_in, pack, lane, 3 * frame_dof[2 * frame + 1])
            way = wp.max(way, h * (wp.length(v) + extent * wp.length(spin)))
        commanded_out[pack, 0, lane] = way

    return SimpleNamespace(kinematic_command=kinematic_command, commanded_way=commanded_way)
