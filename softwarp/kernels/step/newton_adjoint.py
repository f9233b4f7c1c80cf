"""Adjoint of Newton's method in a step: gradients by the end of a step that has converged.

The velocities v* that a step ends with are those that a linearised one about them leads back to, v* = F(v*). So the
gradient s by them, beside what a loss has, y, has what F makes of it:  s = y + (dF/dv)' s, found like v*, by going on.
Theory: docs/theory/adjoint.md. Workspace arrays are ``[pack, row, lane]``.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.rows.touch_adjoint import AHEAD
from softwarp.kernels.rows.touch_adjoint import ROWS as TOUCH_ROWS
from softwarp.model.codes import JointRow

CHANGE, COUNT, DONE, ROWS = range(4)  # of a world's control: by how much s changed last, how often, whether it is there


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type, on single worlds."""
    real = variant.real
    module = variant.module("adjoint.newton")
    one = single.functions(variant)
    vec3, quat_at, put = one.vec3, one.quat_at, one.put

    @wp.kernel(module=module, enable_backward=False)
    def go_on(
        rows: int,
        tolerance: real,
        rounding: real,
        most: real,
        # Model
        dof_free: wp.array2d(dtype=real),
        # Workspace in
        given_in: wp.array3d(dtype=real),
        ahead_in: wp.array3d(dtype=real),
        # Workspace out
        total_out: wp.array3d(dtype=real),
        control_out: wp.array3d(dtype=real),
        adrift_out: wp.array3d(dtype=wp.int32),
        left_out: wp.array(dtype=wp.int32),
    ):
        """s of one world as y and what follows from the last s; whether it has to go on.

        It has not if s changed by ``tolerance`` of it or less, or no longer less than before and by ``rounding``; if it
        has not come to that at last, it is adrift. A world that is there keeps its s.
        """
        pack, lane = wp.tid()
        if control_out[pack, wp.static(DONE), lane] > real(0.5):
            return
        change = real(0.0)
        size = real(0.0)
        is_finite = bool(True)
        for row in range(rows):
            before = total_out[pack, row, lane]
            now = given_in[pack, row, lane] + dof_free[row / 3, row % 3] * ahead_in[pack, row, lane]
            change = wp.max(change, wp.abs(now - before))
            size = wp.max(size, wp.abs(now))
            is_finite = is_finite and wp.isfinite(now)
            total_out[pack, row, lane] = now
        last = control_out[pack, wp.static(CHANGE), lane]
        count = control_out[pack, wp.static(COUNT), lane] + real(1.0)
        control_out[pack, wp.static(CHANGE), lane] = change
        control_out[pack, wp.static(COUNT), lane] = count
        is_still = count > real(1.0) and change >= real(0.5) * last and change <= rounding * size
        if change <= tolerance * size or is_still:
            control_out[pack, wp.static(DONE), lane] = real(1.0)
        elif count >= most or not is_finite:
            control_out[pack, wp.static(DONE), lane] = real(1.0)
            adrift_out[pack, 0, lane] = 1
        else:
            wp.atomic_max(left_out, 0, 1)  # few worlds

    @wp.kernel(module=module, enable_backward=False)
    def ways(
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        parts_in: wp.array3d(dtype=real),
        # Workspace out
        way_out: wp.array3d(dtype=real),
    ):
        """What the distance of one contact counts by along its normal, as a force."""
        pack, contact, lane = wp.tid()
        value = real(0.0)
        if contact < count_in[pack, 0, lane]:
            value = parts_in[pack, wp.static(TOUCH_ROWS) * contact + wp.static(AHEAD), lane]
        put(way_out, pack, lane, 3 * contact, vec3(value, real(0.0), real(0.0)))

    @wp.kernel(module=module, enable_backward=False)
    def add_places(
        lanes: int,
        # State
        x_bar_in: wp.array2d(dtype=real),
        # Workspace out
        bar_out: wp.array3d(dtype=real),
    ):
        """Add one row of a gradient by positions to that of the workspace."""
        pack, row, lane = wp.tid()
        world = pack * lanes + lane
        if world < x_bar_in.shape[0]:
            bar_out[pack, row, lane] = bar_out[pack, row, lane] + x_bar_in[world, row]

    @wp.kernel(module=module, enable_backward=False)
    def add_poses(
        lanes: int,
        # State
        pose_bar_in: wp.array2d(dtype=real),
        # Workspace in
        pose_in: wp.array3d(dtype=real),
        # Workspace out
        bar_out: wp.array3d(dtype=real),
    ):
        """Add a gradient by one frame's pose as that by its place and turn."""
        pack, frame, lane = wp.tid()
        world = pack * lanes + lane
        if world < pose_bar_in.shape[0]:
            row = 7 * frame
            q = quat_at(pose_in, pack, lane, row + 3)
            u = vec3(q[0], q[1], q[2])
            by_u = vec3(pose_bar_in[world, row + 3], pose_bar_in[world, row + 4], pose_bar_in[world, row + 5])
            turn = real(0.5) * (q[3] * by_u + wp.cross(u, by_u) - pose_bar_in[world, row + 6] * u)
            for c in range(3):
                k = 6 * frame + c
                bar_out[pack, k, lane] = bar_out[pack, k, lane] + pose_bar_in[world, row + c]
                bar_out[pack, k + 3, lane] = bar_out[pack, k + 3, lane] + turn[c]

    @wp.kernel(module=module, enable_backward=False)
    def of_joints(
        first_row: int,
        # Workspace in
        q_in: wp.array3d(dtype=real),
        # Workspace out
        q_out: wp.array3d(dtype=real),
    ):
        """q of one row if it is of a joint, else 0."""
        pack, row, lane = wp.tid()
        q_out[pack, row, lane] = wp.where(row >= first_row, q_in[pack, row, lane], real(0.0))

    @wp.kernel(module=module, enable_backward=False)
    def by_coordinates(
        first_row: int,
        # Model
        joint_row_start: wp.array(dtype=wp.int32),
        row_kind: wp.array(dtype=wp.int32),
        joint_scale: wp.array(dtype=real),
        # Workspace in
        q_in: wp.array3d(dtype=real),
        # Workspace out
        end_out: wp.array3d(dtype=real),
        start_out: wp.array3d(dtype=real),
    ):
        """Gradient by one joint's coordinate at the end of the step, and that by the start's, which it adds to."""
        pack, joint, lane = wp.tid()
        total = real(0.0)
        for row in range(joint_row_start[joint], joint_row_start[joint + 1]):
            if row_kind[row] == wp.static(JointRow.FREE):
                total += q_in[pack, first_row + row, lane] * joint_scale[joint]
        end_out[pack, joint, lane] = -total
        start_out[pack, joint, lane] = start_out[pack, joint, lane] + total

    @wp.kernel(module=module, enable_backward=False)
    def subtract(
        # Workspace in
        value_in: wp.array3d(dtype=real),
        # Workspace out
        rest_out: wp.array3d(dtype=real),
    ):
        """Take one row of an array from that of another one."""
        pack, row, lane = wp.tid()
        rest_out[pack, row, lane] = rest_out[pack, row, lane] - value_in[pack, row, lane]

    return SimpleNamespace(
        go_on=go_on,
        ways=ways,
        add_places=add_places,
        add_poses=add_poses,
        of_joints=of_joints,
        by_coordinates=by_coordinates,
        subtract=subtract,
    )
