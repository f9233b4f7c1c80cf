"""Effectors: points and orientations that control is to bring to targets. Theory: docs/theory/effector.md.

An effector is three rows of H without a multiplier of their own. For a point p = sum w_j p_j of markers, soft nodes
have the weight of their shares in p, the modes of a reduced body what its nodes do in them, and a frame that carries
markers gives v + omega x L, L = sum w_j (p_j - X). For
the orientation of a frame the rows are its angular velocity times a length, so that all gaps are in metres.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.model.codes import EffectorKind

TARGET_ROWS = 4  # of a target: position [m] and an unused entry, or quaternion x y z w


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Effector kernels for one scalar type; all on single worlds."""
    real = variant.real
    vec3 = wp.types.vector(3, real)
    quat = wp.types.quaternion(real)
    module = variant.module("effector")

    @wp.func
    def rotation_vector(q: quat):
        """Axis times angle [rad] of a unit quaternion, angle within +-pi; smooth at zero."""
        sign = wp.where(q[3] < real(0.0), real(-1.0), real(1.0))
        v = vec3(q[0], q[1], q[2]) * sign
        length = wp.length(v)
        factor = real(2.0)
        if length > real(1.0e-6):
            factor = real(2.0) * wp.atan2(length, q[3] * sign) / length
        return v * factor

    @wp.kernel(module=module, enable_backward=False)
    def effector_rows(
        world_count: int,
        lanes: int,
        size: int,
        first_side: int,
        # Model
        entry_effector: wp.array(dtype=wp.int32),
        entry_dof: wp.array(dtype=wp.int32),
        entry_block: wp.array2d(dtype=real),
        entry_frame: wp.array(dtype=wp.int32),
        part_start: wp.array(dtype=wp.int32),
        part_item: wp.array(dtype=wp.int32),
        part_weight: wp.array(dtype=real),
        dof_free: wp.array2d(dtype=real),
        # State
        marker_x_in: wp.array2d(dtype=real),
        node_x_in: wp.array2d(dtype=real),
        frame_pose_in: wp.array2d(dtype=real),
        # Workspace out
        row_out: wp.array3d(dtype=real),
        y_out: wp.array3d(dtype=real),
    ):
        """A 3x3 block of H, and its place among the right-hand sides, where prescribed scalars have none.

        ``entry_frame`` names the master whose rotation carries parts of the point: a marker, or a node as -1 - node.
        """
        pack, entry, lane = wp.tid()
        world = wp.min(pack * lanes + lane, world_count - 1)
        dof = entry_dof[entry]
        frame = entry_frame[entry]
        lever = vec3()
        if frame >= 0:
            origin = vec3(
                frame_pose_in[world, 7 * frame],
                frame_pose_in[world, 7 * frame + 1],
                frame_pose_in[world, 7 * frame + 2],
            )
            for part in range(part_start[entry], part_start[entry + 1]):
                item = part_item[part]
                p = vec3()
                for c in range(3):
                    if item >= 0:
                        p[c] = marker_x_in[world, 3 * item + c]
                    else:
                        p[c] = node_x_in[world, 3 * (-1 - item) + c]
                lever += (p - origin) * part_weight[part]
        for r in range(3):
            row = vec3()
            if frame >= 0:
                row[(r + 1) % 3] = lever[(r + 2) % 3]
                row[(r + 2) % 3] = -lever[(r + 1) % 3]
            else:
                for c in range(3):
                    row[c] = entry_block[entry, 3 * r + c]
            side = 3 * (size * (first_side + 3 * entry_effector[entry] + r) + dof)
            for c in range(3):
                row_out[pack, 9 * entry + 3 * r + c, lane] = row[c]
                y_out[pack, side + c, lane] = row[c] * dof_free[dof, c]

    @wp.kernel(module=module, enable_backward=False)
    def effector_gap(
        world_count: int,
        lanes: int,
        size: int,
        first_row: int,
        # Model
        effector_kind: wp.array(dtype=wp.int32),
        effector_frame: wp.array(dtype=wp.int32),
        effector_length: wp.array(dtype=real),
        value_start: wp.array(dtype=wp.int32),
        value_marker: wp.array(dtype=wp.int32),
        value_weight: wp.array(dtype=real),
        entry_start: wp.array(dtype=wp.int32),
        entry_dof: wp.array(dtype=wp.int32),
        # State
        marker_x_in: wp.array2d(dtype=real),
        frame_pose_in: wp.array2d(dtype=real),
        # Control
        effector_target_in: wp.array2d(dtype=real),
        # Workspace in
        row_in: wp.array3d(dtype=real),
        u_in: wp.array3d(dtype=real),
        y_in: wp.array3d(dtype=real),
        x_scale: real,
        # Workspace out
        error_out: wp.array3d(dtype=real),
        gap_out: wp.array3d(dtype=real),
    ):
        """Distance to the target now, and after the motion that the present multipliers bring about [m]."""
        pack, effector, lane = wp.tid()
        world = wp.min(pack * lanes + lane, world_count - 1)
        error = vec3()
        if effector_kind[effector] == wp.static(EffectorKind.ORIENTATION):
            frame = 7 * effector_frame[effector] + 3
            q = quat()
            goal = quat()
            for c in range(4):
                q[c] = frame_pose_in[world, frame + c]
                goal[c] = effector_target_in[world, wp.static(TARGET_ROWS) * effector + c]
            error = rotation_vector(q * wp.quat_inverse(goal)) * effector_length[effector]
        else:
            for part in range(value_start[effector], value_start[effector + 1]):
                for c in range(3):
                    error[c] += value_weight[part] * marker_x_in[world, 3 * value_marker[part] + c]
            for c in range(3):
                error[c] -= effector_target_in[world, wp.static(TARGET_ROWS) * effector + c]
        for r in range(3):
            total = real(0.0)
            for entry in range(entry_start[effector], entry_start[effector + 1]):
                for c in range(3):
                    total += row_in[pack, 9 * entry + 3 * r + c, lane] * u_in[pack, 3 * entry_dof[entry] + c, lane]
            side = 3 * size * (1 + first_row + 3 * effector + r)
            for k in range(3 * size):
                total += y_in[pack, side + k, lane] * y_in[pack, k, lane]
            error_out[pack, 3 * effector + r, lane] = error[r]
            gap_out[pack, first_row + 3 * effector + r, lane] = error[r] + total * x_scale

    return SimpleNamespace(effector_rows=effector_rows, effector_gap=effector_gap)
