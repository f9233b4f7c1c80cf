"""Adjoint of contacts and joints that Newton's method finds where a step ends. Theory: docs/theory/adjoint.md.

Their gradients by places and poses of there are passed on to the start of the step, and to the velocities that lead
there. State arrays are ``[world, row]``; workspace arrays ``[pack, row, lane]``.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.rows.touch_adjoint import AHEAD, ROWS
from softwarp.model.codes import JointRow


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type, on single worlds."""
    real = variant.real
    module = variant.module("adjoint.ends")
    one = single.functions(variant)
    vec3, quat_at, put = one.vec3, one.quat_at, one.put

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
            value = parts_in[pack, wp.static(ROWS) * contact + wp.static(AHEAD), lane]
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
        ways=ways,
        add_places=add_places,
        add_poses=add_poses,
        of_joints=of_joints,
        by_coordinates=by_coordinates,
        subtract=subtract,
    )
