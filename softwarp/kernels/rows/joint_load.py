"""Forces that joints exert, rates of their coordinates, and the stiffness of their forces.

Theory: docs/theory/joint.md.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.rows.joint import functions
from softwarp.model.codes import JointCoordinate, JointRow

NEAR = 1.0e-5  # lengths from a limit at which a coordinate counts as there


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Forces of joints, velocities, and the stiffness that forces give to bodies that turn."""
    real = variant.real
    module = variant.module("joint_load")
    vec3 = wp.types.vector(3, real)
    f = functions(variant)
    side, axis_of, vector_at = f.side, f.axis_of, single.functions(variant).vector_at

    @wp.kernel(module=module, enable_backward=False)
    def joint_load(
        first_row: int,
        # Model
        row_entry_start: wp.array(dtype=wp.int32),
        row_kind: wp.array(dtype=wp.int32),
        joint_row_start: wp.array(dtype=wp.int32),
        joint_frame: wp.array2d(dtype=wp.int32),
        joint_free: wp.array(dtype=wp.int32),
        joint_scale: wp.array(dtype=real),
        joint_length: wp.array(dtype=real),
        # Workspace in
        row_in: wp.array3d(dtype=real),
        multiplier_in: wp.array3d(dtype=real),
        target_in: wp.array3d(dtype=real),
        lower_in: wp.array3d(dtype=real),
        upper_in: wp.array3d(dtype=real),
        compliance_in: wp.array3d(dtype=real),
        floor_in: wp.array3d(dtype=real),
        ceiling_in: wp.array3d(dtype=real),
        travel_in: wp.array3d(dtype=real),
        # Workspace out
        force_out: wp.array3d(dtype=real),
        reaction_out: wp.array3d(dtype=real),
        own_multiplier_out: wp.array3d(dtype=real),
    ):
        """Motor force of one joint, force and moment about the anchor that its rows exert on the child; multipliers.

        At a limit the motor has the force of its law, and the limit the rest.
        """
        pack, joint, lane = wp.tid()
        motor = real(0.0)
        force = vec3()
        moment = vec3()
        turns_free = joint_free[joint] == wp.static(JointCoordinate.ANGLE)
        for row in range(joint_row_start[joint], joint_row_start[joint + 1]):
            kind = row_kind[row]
            entry = 3 * row_entry_start[first_row + row]
            if joint_frame[joint, 0] >= 0:
                entry += 6
            k = first_row + row
            multiplier = multiplier_in[pack, k, lane]
            own_multiplier_out[pack, row, lane] = multiplier
            if (
                kind == wp.static(JointRow.TILT)
                or kind == wp.static(JointRow.LOCK)
                or (kind == wp.static(JointRow.FREE) and turns_free)
            ):
                moment += vector_at(row_in, pack, lane, entry + 3) * multiplier
            else:
                force += vector_at(row_in, pack, lane, entry) * multiplier
            if kind == wp.static(JointRow.FREE):
                motor = wp.clamp(multiplier, lower_in[pack, k, lane], upper_in[pack, k, lane])
                gap = travel_in[pack, joint, lane] * joint_scale[joint] - target_in[pack, k, lane]
                near = real(wp.static(NEAR)) * joint_length[joint]
                is_stopped = gap < floor_in[pack, k, lane] + near or gap > ceiling_in[pack, k, lane] - near
                if is_stopped and compliance_in[pack, k, lane] > real(0.0):
                    motor = -gap / compliance_in[pack, k, lane]
                    motor = wp.clamp(motor, lower_in[pack, k, lane], upper_in[pack, k, lane])
                motor = motor * joint_scale[joint]
        force_out[pack, joint, lane] = motor
        for c in range(3):
            reaction_out[pack, 6 * joint + c, lane] = force[c]
            reaction_out[pack, 6 * joint + 3 + c, lane] = moment[c]

    @wp.kernel(module=module, enable_backward=False)
    def mean_velocity(
        # Workspace in
        travel_in: wp.array3d(dtype=real),
        h: real,
        # Workspace out
        velocity_out: wp.array3d(dtype=real),
    ):
        """dq/dt of one joint in the step."""
        pack, joint, lane = wp.tid()
        velocity_out[pack, joint, lane] = travel_in[pack, joint, lane] / h

    @wp.func
    def point_velocity(
        pose: wp.array3d(dtype=real), twist: wp.array3d(dtype=real), pack: int, lane: int, frame: int, x: vec3
    ):
        """Velocity of a point that moves with a frame, and the frame's angular velocity; the world stands still."""
        v = vec3()
        w = vec3()
        if frame >= 0:
            w = vector_at(twist, pack, lane, 6 * frame + 3)
            lever = x - vector_at(pose, pack, lane, 7 * frame)
            v = vector_at(twist, pack, lane, 6 * frame) + wp.cross(w, lever)
        return v, w

    @wp.kernel(module=module, enable_backward=False)
    def twist_velocity(
        # Model
        joint_frame: wp.array2d(dtype=wp.int32),
        joint_place: wp.array2d(dtype=real),
        joint_free: wp.array(dtype=wp.int32),
        # Workspace in
        pose_in: wp.array3d(dtype=real),
        twist_in: wp.array3d(dtype=real),
        # Workspace out
        velocity_out: wp.array3d(dtype=real),
    ):
        """dq/dt of one joint from the twists of its sides."""
        pack, joint, lane = wp.tid()
        parent = joint_frame[joint, 0]
        child = joint_frame[joint, 1]
        xp, qp = side(joint_place, pose_in, pack, lane, joint, 0, parent)
        xc, qc = side(joint_place, pose_in, pack, lane, joint, 7, child)
        vp, wp_ = point_velocity(pose_in, twist_in, pack, lane, parent, xc)
        vc, wc = point_velocity(pose_in, twist_in, pack, lane, child, xc)
        value = real(0.0)
        if joint_free[joint] == wp.static(JointCoordinate.ANGLE):
            value = wp.dot(axis_of(qp), wc - wp_)
        if joint_free[joint] == wp.static(JointCoordinate.WAY):
            value = wp.dot(axis_of(qp), vc - vp)
        velocity_out[pack, joint, lane] = value

    @wp.kernel(module=module, enable_backward=False)
    def joint_stiffness(
        # Model
        joint_frame: wp.array2d(dtype=wp.int32),
        joint_place: wp.array2d(dtype=real),
        turned_frame: wp.array(dtype=wp.int32),
        turned_start: wp.array(dtype=wp.int32),
        turned_side: wp.array(dtype=wp.int32),
        frame_block: wp.array2d(dtype=wp.int32),
        # Workspace in
        pose_in: wp.array3d(dtype=real),
        reaction_in: wp.array3d(dtype=real),
        scale: real,
        # Workspace out
        a_out: wp.array3d(dtype=real),
    ):
        """Add (F . r)+ (1 - r r' / r^2) of all joint forces F at levers r to the rotation block of one master.

        It is the restoring part of how the moment r x F changes when the frame turns, exact for a hanging pendulum.
        """
        pack, item, lane = wp.tid()
        frame = turned_frame[item]
        block = 9 * frame_block[frame, 1]
        x = vector_at(pose_in, pack, lane, 7 * frame)
        for p in range(turned_start[item], turned_start[item + 1]):
            joint = turned_side[p] // 2
            force = vector_at(reaction_in, pack, lane, 6 * joint)
            if turned_side[p] % 2 == 0:
                force = -force
            xc, _ = side(joint_place, pose_in, pack, lane, joint, 7, joint_frame[joint, 1])
            r = xc - x
            square = wp.dot(r, r)
            if square > real(0.0):
                factor = wp.max(wp.dot(force, r), real(0.0)) * scale / square
                for i in range(3):
                    for j in range(3):
                        value = -r[i] * r[j]
                        if i == j:
                            value += square
                        a_out[pack, block + 3 * i + j, lane] += factor * value

    return SimpleNamespace(
        joint_load=joint_load,
        mean_velocity=mean_velocity,
        twist_velocity=twist_velocity,
        joint_stiffness=joint_stiffness,
    )
