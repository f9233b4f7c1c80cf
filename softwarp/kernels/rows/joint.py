"""Joints between frames as multiplier rows. Theory: docs/theory/joint.md.

Each side of a joint is a frame of its own, fixed in the body (or the world) and equal on both sides at the start: an
origin, the anchor, and axes of which the third is the joint's. Rows are gaps between the two sides that vanish, and one
along the free coordinate q, the angle [rad] of a hinge or the way [m] of a slider, for motor and limits:

    gap + compliance multiplier = 0, or a bound of the motor's force, but never outside the limits.

Rows that turn are multiplied by a length, so that all gaps are in metres and all multipliers in newtons. The force of a
row acts on the child, its opposite on the parent at the same point.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant
from softwarp.model.codes import FAR, RIGID_SERVO, UNBOUNDED, JointControl, JointCoordinate, JointRow

NO_STIFFNESS = 1.0e-30
TURN = 6.283185307179586


def functions(variant: Variant) -> SimpleNamespace:
    """Functions on single worlds that the kernels of joints share."""
    real = variant.real
    one = single.functions(variant)
    vec3, quat, vector_at, quat_at = one.vec3, one.quat, one.vector_at, one.quat_at

    @wp.func
    def side(
        place: wp.array2d(dtype=real),
        pose: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        joint: int,
        first: int,
        frame: int,
    ):
        """Origin and axes (as a quaternion) of one side of a joint in the world; frame -1 is the world."""
        x = vec3(place[joint, first], place[joint, first + 1], place[joint, first + 2])
        q = quat(place[joint, first + 3], place[joint, first + 4], place[joint, first + 5], place[joint, first + 6])
        if frame >= 0:
            row = 7 * frame
            body = quat_at(pose, pack, lane, row + 3)
            x = vector_at(pose, pack, lane, row) + wp.quat_rotate(body, x)
            q = body * q
        return x, q

    @wp.func
    def wrapped(angle: real):
        """The angle in [-pi, pi] that differs by whole turns."""
        return angle - real(wp.static(TURN)) * wp.round(angle * real(wp.static(1.0 / TURN)))

    @wp.func
    def axis_of(q: quat):
        """Third axis."""
        return wp.quat_rotate(q, vec3(real(0.0), real(0.0), real(1.0)))

    @wp.func
    def coordinate(free: int, xp: vec3, qp: quat, xc: vec3, qc: quat):
        """Free coordinate between the sides, an angle within half a turn."""
        value = real(0.0)
        if free == wp.static(JointCoordinate.ANGLE):
            r = wp.quat_inverse(qp) * qc
            value = wrapped(real(2.0) * wp.atan2(r[2], r[3]))
        if free == wp.static(JointCoordinate.WAY):
            value = wp.dot(axis_of(qp), xc - xp)
        return value

    @wp.func
    def geometry(kind: int, axis: int, free: int, xp: vec3, qp: quat, xc: vec3, qc: quat):
        """Whether a row turns, the direction n of its force or moment, and its gap or coordinate.

        Axes stay parallel where one of the parent's is perpendicular to the child's third one; all stay equal where the
        vector part of the quaternion between them vanishes. Directions are the exact gradients of the gaps.
        """
        unit = vec3()
        unit[axis] = real(1.0)
        turns = free == wp.static(JointCoordinate.ANGLE)
        n = axis_of(qp)
        gap = real(0.0)
        if kind == wp.static(JointRow.POINT):
            turns = False
            n = unit
            gap = xc[axis] - xp[axis]
        elif kind == wp.static(JointRow.SIDE):
            n = wp.quat_rotate(qp, unit)
            gap = wp.dot(n, xc - xp)
        elif kind == wp.static(JointRow.TILT):
            third = axis_of(qc)
            other = wp.quat_rotate(qp, vec3(unit[1], unit[0], real(0.0)))
            sign = real(1.0) - real(2.0) * unit[0]
            n = wp.cross(third, other) * sign
            gap = wp.dot(third, other) * sign
        elif kind == wp.static(JointRow.LOCK):
            turns = True
            r = wp.quat_inverse(qp) * qc
            sign = wp.where(r[3] < real(0.0), real(-1.0), real(1.0))
            v = vec3(r[0], r[1], r[2]) * sign
            n = wp.quat_rotate(qp, unit * (r[3] * sign) + wp.cross(v, unit))
            gap = real(2.0) * v[axis]
        else:
            gap = coordinate(free, xp, qp, xc, qc)
        return turns, n, gap

    return SimpleNamespace(
        side=side,
        wrapped=wrapped,
        axis_of=axis_of,
        coordinate=coordinate,
        geometry=geometry,
    )


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Geometry and commands of joints."""
    S = variant.S
    real = variant.real
    world_fastest = variant.world_fastest
    module = variant.module("joint")
    one, f = single.functions(variant), functions(variant)
    vec3, vector_at, quat_at = one.vec3, one.vector_at, one.quat_at
    put, put_quat, exponential = one.put, one.put_quat, one.exponential
    side, wrapped, coordinate, geometry = f.side, f.wrapped, f.coordinate, f.geometry

    @wp.kernel(module=module, enable_backward=False)
    def measure_joint(
        # Model
        joint_frame: wp.array2d(dtype=wp.int32),
        joint_place: wp.array2d(dtype=real),
        joint_free: wp.array(dtype=wp.int32),
        # Workspace in
        pose0_in: wp.array3d(dtype=real),
        pose_in: wp.array3d(dtype=real),
        position_in: wp.array3d(dtype=real),
        # Workspace out
        travel_out: wp.array3d(dtype=real),
        position_out: wp.array3d(dtype=real),
    ):
        """Change of one joint's coordinate since the start of the step, less than half a turn, and the coordinate.

        ``position_in`` is that of the start of the step; it says how many turns to count.
        """
        pack, joint, lane = wp.tid()
        free = joint_free[joint]
        parent = joint_frame[joint, 0]
        child = joint_frame[joint, 1]
        xp, qp = side(joint_place, pose0_in, pack, lane, joint, 0, parent)
        xc, qc = side(joint_place, pose0_in, pack, lane, joint, 7, child)
        start = coordinate(free, xp, qp, xc, qc)
        xp, qp = side(joint_place, pose_in, pack, lane, joint, 0, parent)
        xc, qc = side(joint_place, pose_in, pack, lane, joint, 7, child)
        end = coordinate(free, xp, qp, xc, qc)
        travel = end - start
        if free == wp.static(JointCoordinate.ANGLE):
            travel = wrapped(travel)
            more = position_in[pack, joint, lane] + travel - end
            end += real(wp.static(TURN)) * wp.round(more * real(wp.static(1.0 / TURN)))
        travel_out[pack, joint, lane] = travel
        position_out[pack, joint, lane] = end

    @wp.kernel(module=module, enable_backward=False)
    def joint_rows(
        first_row: int,
        # Model
        row_entry_start: wp.array(dtype=wp.int32),
        row_joint: wp.array(dtype=wp.int32),
        row_kind: wp.array(dtype=wp.int32),
        row_axis: wp.array(dtype=wp.int32),
        joint_frame: wp.array2d(dtype=wp.int32),
        joint_place: wp.array2d(dtype=real),
        joint_free: wp.array(dtype=wp.int32),
        joint_length: wp.array(dtype=real),
        frame_master: wp.array(dtype=wp.int32),
        # Workspace in
        pose_in: wp.array3d(dtype=real),
        travel_in: wp.array3d(dtype=real),
        # Workspace out
        displacement_out: wp.array3d(dtype=real),
        row_out: wp.array3d(dtype=real),
    ):
        """Gap of one row (for limits and motors the way since the start of the step) and its 3-entries of H'."""
        pack, row, lane = wp.tid()
        joint = row_joint[row]
        kind = row_kind[row]
        axis = row_axis[row]
        parent = joint_frame[joint, 0]
        child = joint_frame[joint, 1]
        xp, qp = side(joint_place, pose_in, pack, lane, joint, 0, parent)
        xc, qc = side(joint_place, pose_in, pack, lane, joint, 7, child)
        turns, n, gap = geometry(kind, axis, joint_free[joint], xp, qp, xc, qc)
        if kind == wp.static(JointRow.FREE):
            gap = travel_in[pack, joint, lane]
        force = n
        moment = n
        if turns:
            force = vec3()
            moment = n * joint_length[joint]
            gap = gap * joint_length[joint]
        displacement_out[pack, first_row + row, lane] = gap
        entry = 3 * row_entry_start[first_row + row]
        if parent >= 0:
            lever = xc - vector_at(pose_in, pack, lane, 7 * frame_master[parent])
            put(row_out, pack, lane, entry, -force)
            put(row_out, pack, lane, entry + 3, -wp.where(turns, moment, wp.cross(lever, force)))
            entry += 6
        lever = xc - vector_at(pose_in, pack, lane, 7 * frame_master[child])
        put(row_out, pack, lane, entry, force)
        put(row_out, pack, lane, entry + 3, wp.where(turns, moment, wp.cross(lever, force)))

    @wp.func
    def speed(row: wp.array3d(dtype=real), twist: wp.array3d(dtype=real), pack: int, lane: int, entry: int, frame: int):
        """H v of the two 3-entries of one side."""
        force = wp.dot(vector_at(row, pack, lane, entry), vector_at(twist, pack, lane, 6 * frame))
        return force + wp.dot(vector_at(row, pack, lane, entry + 3), vector_at(twist, pack, lane, 6 * frame + 3))

    @wp.kernel(module=module, enable_backward=False)
    def predict_pose(
        # Model
        frame_master: wp.array(dtype=wp.int32),
        # Workspace in
        pose0_in: wp.array3d(dtype=real),
        twist_in: wp.array3d(dtype=real),
        h: real,
        # Workspace out
        pose_out: wp.array3d(dtype=real),
    ):
        """Pose of one frame after its master has moved on with a twist for a time h."""
        pack, frame, lane = wp.tid()
        master = frame_master[frame]
        w = vector_at(twist_in, pack, lane, 6 * master + 3) * h
        e = exponential(w)
        origin = vector_at(pose0_in, pack, lane, 7 * master)
        x = vector_at(pose0_in, pack, lane, 7 * frame) - origin
        x = origin + vector_at(twist_in, pack, lane, 6 * master) * h + wp.quat_rotate(e, x)
        q = e * quat_at(pose0_in, pack, lane, 7 * frame + 3)
        put(pose_out, pack, lane, 7 * frame, x)
        put_quat(pose_out, pack, lane, 7 * frame + 3, q)

    @wp.kernel(module=module, enable_backward=False)
    def predict_rows(
        first_row: int,
        # Model
        row_entry_start: wp.array(dtype=wp.int32),
        row_joint: wp.array(dtype=wp.int32),
        row_kind: wp.array(dtype=wp.int32),
        row_axis: wp.array(dtype=wp.int32),
        joint_frame: wp.array2d(dtype=wp.int32),
        joint_place: wp.array2d(dtype=real),
        joint_free: wp.array(dtype=wp.int32),
        joint_length: wp.array(dtype=real),
        frame_master: wp.array(dtype=wp.int32),
        # Workspace in
        pose0_in: wp.array3d(dtype=real),
        pose_in: wp.array3d(dtype=real),
        twist_in: wp.array3d(dtype=real),
        row_in: wp.array3d(dtype=real),
        h: real,
        # Workspace out
        displacement_out: wp.array3d(dtype=real),
        speed_out: wp.array3d(dtype=real),
    ):
        """Gap of one row at the start of the step for a linearisation that is exact where twists stay as they are.

        It is g(x0 + h v) - h H v, which differs from g(x0) by the way that points leave their tangents; and H v.
        """
        pack, row, lane = wp.tid()
        joint = row_joint[row]
        kind = row_kind[row]
        free = joint_free[joint]
        parent = joint_frame[joint, 0]
        child = joint_frame[joint, 1]
        start = real(0.0)
        if kind == wp.static(JointRow.FREE):
            xp, qp = side(joint_place, pose0_in, pack, lane, joint, 0, parent)
            xc, qc = side(joint_place, pose0_in, pack, lane, joint, 7, child)
            start = coordinate(free, xp, qp, xc, qc)
        entry = 3 * row_entry_start[first_row + row]
        known = real(0.0)
        if parent >= 0:
            known = speed(row_in, twist_in, pack, lane, entry, frame_master[parent])
            entry += 6
        known += speed(row_in, twist_in, pack, lane, entry, frame_master[child])
        xp, qp = side(joint_place, pose_in, pack, lane, joint, 0, joint_frame[joint, 0])
        xc, qc = side(joint_place, pose_in, pack, lane, joint, 7, joint_frame[joint, 1])
        turns, _, gap = geometry(kind, row_axis[row], free, xp, qp, xc, qc)
        if kind == wp.static(JointRow.FREE):
            gap -= start
            if turns:
                gap = wrapped(gap)
        if turns:
            gap = gap * joint_length[joint]
        displacement_out[pack, first_row + row, lane] = gap - known * h
        speed_out[pack, row, lane] = known

    @wp.kernel(module=module, enable_backward=False)
    def whole_gap(
        first_row: int,
        # Model
        row_entry_start: wp.array(dtype=wp.int32),
        row_joint: wp.array(dtype=wp.int32),
        row_kind: wp.array(dtype=wp.int32),
        joint_frame: wp.array2d(dtype=wp.int32),
        frame_master: wp.array(dtype=wp.int32),
        # Workspace in
        displacement_in: wp.array3d(dtype=real),
        row_in: wp.array3d(dtype=real),
        difference_in: wp.array3d(dtype=real),
        h: real,
        # Workspace out
        gap_out: wp.array3d(dtype=real),
    ):
        """What the velocities that belong to momentum have to correct: the gap and h H D; nothing of a motor."""
        pack, row, lane = wp.tid()
        joint = row_joint[row]
        gap = displacement_in[pack, first_row + row, lane]
        entry = 3 * row_entry_start[first_row + row]
        if joint_frame[joint, 0] >= 0:
            gap += speed(row_in, difference_in, pack, lane, entry, frame_master[joint_frame[joint, 0]]) * h
            entry += 6
        gap += speed(row_in, difference_in, pack, lane, entry, frame_master[joint_frame[joint, 1]]) * h
        if row_kind[row] == wp.static(JointRow.FREE):
            gap = real(0.0)
        gap_out[pack, row, lane] = gap

    @wp.kernel(module=module, enable_backward=False)
    def gather_twist(
        # Model
        frame_dof: wp.array(dtype=wp.int32),
        # Workspace in
        u_in: wp.array3d(dtype=real),
        # Workspace out
        twist_out: wp.array3d(dtype=real),
    ):
        """Velocities of dofs as the twist of one frame's master."""
        pack, frame, lane = wp.tid()
        put(twist_out, pack, lane, 6 * frame, vector_at(u_in, pack, lane, 3 * frame_dof[2 * frame]))
        put(twist_out, pack, lane, 6 * frame + 3, vector_at(u_in, pack, lane, 3 * frame_dof[2 * frame + 1]))

    @wp.kernel(module=module, enable_backward=False)
    def joint_sides(
        size: int,
        first_entry: int,
        # Model
        entry_dof: wp.array(dtype=wp.int32),
        entry_row: wp.array(dtype=wp.int32),
        dof_free: wp.array2d(dtype=real),
        # Workspace in
        row_in: wp.array2d(dtype=S),
        # Workspace out
        y_out: wp.array2d(dtype=S),
    ):
        """One 3-entry of H' among the right-hand sides; rows cannot move what is prescribed."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        entry = first_entry + item
        dof = entry_dof[entry]
        y = 3 * ((1 + entry_row[entry]) * size + dof)
        for c in range(3):
            y_out[w, y + c] = row_in[w, 3 * entry + c] * dof_free[dof, c]

    @wp.kernel(module=module, enable_backward=False)
    def joint_command(
        first_row: int,
        # Model
        row_joint: wp.array(dtype=wp.int32),
        row_kind: wp.array(dtype=wp.int32),
        joint_control: wp.array(dtype=wp.int32),
        joint_scale: wp.array(dtype=real),
        # Workspace in
        target_command_in: wp.array3d(dtype=real),
        force_command_in: wp.array3d(dtype=real),
        stiffness_in: wp.array3d(dtype=real),
        damping_in: wp.array3d(dtype=real),
        max_force_in: wp.array3d(dtype=real),
        max_rate_in: wp.array3d(dtype=real),
        min_position_in: wp.array3d(dtype=real),
        max_position_in: wp.array3d(dtype=real),
        position0_in: wp.array3d(dtype=real),
        reference0_in: wp.array3d(dtype=real),
        lag_in: wp.array3d(dtype=real),
        recovery: real,
        h: real,
        lapse: real,
        # Workspace out
        target_out: wp.array3d(dtype=real),
        lower_out: wp.array3d(dtype=real),
        upper_out: wp.array3d(dtype=real),
        compliance_out: wp.array3d(dtype=real),
        floor_out: wp.array3d(dtype=real),
        ceiling_out: wp.array3d(dtype=real),
        reference_out: wp.array3d(dtype=real),
    ):
        """Target, bounds, compliance and limits of one row; along a free coordinate they count from the step's start.

        A servo's force is kp (reference - q) - kd dq/dt + command at the end of the step, so that it has the compliance
        1 / (kp + kd / h); a rigid one leaves the part ``lag_in`` of its way to later stages of the step, and the
        reference of another moves for ``lapse`` [s]. ``recovery`` [m/s] is how fast what lies outside its limits is
        brought back.
        """
        pack, row, lane = wp.tid()
        joint = row_joint[row]
        target = real(0.0)
        lower = -real(wp.static(UNBOUNDED))
        upper = real(wp.static(UNBOUNDED))
        compliance = real(0.0)
        floor = -real(wp.static(FAR))
        ceiling = real(wp.static(FAR))
        if row_kind[row] == wp.static(JointRow.FREE):
            control = joint_control[joint]
            scale = joint_scale[joint]
            q = position0_in[pack, joint, lane]
            low = min_position_in[pack, joint, lane]
            high = max_position_in[pack, joint, lane]
            command = target_command_in[pack, joint, lane]
            feed = force_command_in[pack, joint, lane]
            limit = max_force_in[pack, joint, lane]
            rate = max_rate_in[pack, joint, lane]
            upper = limit / scale
            lower = -upper
            if control == wp.static(JointControl.POSITION):
                kp = stiffness_in[pack, joint, lane]
                total = wp.max(kp + damping_in[pack, joint, lane] / h, real(wp.static(NO_STIFFNESS)))
                start = reference0_in[pack, joint, lane]
                way = rate * lapse
                if kp >= real(wp.static(RIGID_SERVO)):
                    start = q
                    way = rate * h
                    command = command - lag_in[pack, 0, lane] * (command - q)
                reference = wp.clamp(wp.clamp(command, start - way, start + way), low, high)
                reference_out[pack, joint, lane] = reference
                target = ((reference - q) * (kp / total) + feed / total) * scale
                compliance = scale * scale / total
            elif control == wp.static(JointControl.VELOCITY):
                reference = wp.clamp(q + wp.clamp(command, -rate, rate) * h, low, high)
                reference_out[pack, joint, lane] = reference
                target = (reference - q) * scale
                if reference > low and reference < high:
                    target = wp.clamp(command, -rate, rate) * h * scale  # q may be many turns, which would round it
            else:
                upper = real(0.0)
                if control == wp.static(JointControl.FORCE):
                    upper = wp.clamp(feed, -limit, limit) / scale
                lower = upper
            floor = wp.max(wp.min((low - q) * scale, recovery * h), floor) - target
            ceiling = wp.min(wp.max((high - q) * scale, -recovery * h), ceiling) - target
        target_out[pack, first_row + row, lane] = target
        lower_out[pack, first_row + row, lane] = lower
        upper_out[pack, first_row + row, lane] = upper
        compliance_out[pack, first_row + row, lane] = compliance
        floor_out[pack, first_row + row, lane] = floor
        ceiling_out[pack, first_row + row, lane] = ceiling

    return SimpleNamespace(
        measure_joint=measure_joint,
        joint_rows=joint_rows,
        predict_pose=predict_pose,
        predict_rows=predict_rows,
        whole_gap=whole_gap,
        gather_twist=gather_twist,
        joint_sides=joint_sides,
        joint_command=joint_command,
    )
