"""Adjoint of joints in a step: by the poses of their sides, by velocities that rows are linearised about, by commands.

A row with the force T, its adjoint q and the velocities v of its sides has, linearised about v*,

    S = h T H p - q (g(x0 + h v*) + h H (v - v*)),

a function of poses, v, v* and p that Warp differentiates. Theory: docs/theory/adjoint.md.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.rows.joint import NO_STIFFNESS
from softwarp.kernels.rows.joint import functions as of_joints
from softwarp.model.codes import RIGID_SERVO, JointControl, JointRow

SIDES = 36  # numbers of a row: places, turns, velocities, linearised velocities or differences, of parent and child
SLACK = {wp.float64: 1.0e-9, wp.float32: 1.0e-4}  # share of a force that counts as none


@single_worlds
def functions(variant: Variant) -> SimpleNamespace:
    """S of one row and its gradients, for one scalar type."""
    real = variant.real
    one, f = single.functions(variant), of_joints(variant)
    vec3, quat, exponential = one.vec3, one.quat, one.exponential
    wrapped, coordinate, geometry = f.wrapped, f.coordinate, f.geometry

    @wp.func
    def rate(turns: bool, n: vec3, length: real, rp: vec3, rc: vec3, Vp: vec3, wp_: vec3, Vc: vec3, wc: vec3):
        """H v of one row, with levers from both sides' origins to where its force acts."""
        if turns:
            return length * wp.dot(n, wc - wp_)
        return wp.dot(n, Vc + wp.cross(wc, rc) - Vp - wp.cross(wp_, rp))

    @wp.func
    def value(
        kind: int,
        axis: int,
        free: int,
        length: real,
        ap: vec3,
        bp: quat,
        ac: vec3,
        bc: quat,
        Xp: vec3,
        Qp: quat,
        Xc: vec3,
        Qc: quat,
        Kp: vec3,
        kp: vec3,
        Kc: vec3,
        kc: vec3,
        Vp: vec3,
        vp: vec3,
        Vc: vec3,
        vc: vec3,
        Pp: vec3,
        pp: vec3,
        Pc: vec3,
        pc: vec3,
        push: real,
        q: real,
        gap_weight: real,
        by_coordinate: real,
        h: real,
    ):
        """S of one row, with the share ``gap_weight`` of its gap, and the coordinate at the start in a weight.

        Places a and axes b in the sides X, Q; velocities that it is linearised about K, k; velocities V, v; adjoint P,
        p; ``push`` is h T. Capital letters are of origins, small ones of spins.
        """
        xp = Xp + wp.quat_rotate(Qp, ap)
        qp = Qp * bp
        xc = Xc + wp.quat_rotate(Qc, ac)
        qc = Qc * bc
        turns, n, at = geometry(kind, axis, free, xp, qp, xc, qc)
        rp = xc - Xp
        rc = xc - Xc
        moved = rate(turns, n, length, rp, rc, Vp - Kp, vp - kp, Vc - Kc, vc - kc)
        total = push * rate(turns, n, length, rp, rc, Pp, pp, Pc, pc) - q * h * moved
        ep = exponential(h * kp)
        ec = exponential(h * kc)
        xp1 = Xp + h * Kp + wp.quat_rotate(ep, wp.quat_rotate(Qp, ap))
        xc1 = Xc + h * Kc + wp.quat_rotate(ec, wp.quat_rotate(Qc, ac))
        other, m, gap = geometry(kind, axis, free, xp1, ep * qp, xc1, ec * qc)
        if kind == wp.static(JointRow.FREE):
            gap -= at
            if turns:
                gap = wrapped(gap)
            total += by_coordinate * coordinate(free, xp, qp, xc, qc)
        if turns:
            gap = gap * length
        return total - q * gap_weight * gap

    @wp.kernel(module=variant.module("adjoint.joints"), enable_backward=True)
    def reach(
        # Samples in
        kind_in: wp.array(dtype=wp.int32),
        vector_in: wp.array(dtype=vec3),
        turn_in: wp.array(dtype=quat),
        number_in: wp.array(dtype=real),
        # Samples out
        value_out: wp.array(dtype=real),
    ):
        """Makes Warp differentiate ``value``; nobody launches it, as of ``elements.adjoint``."""
        sample = wp.tid()
        i = kind_in[sample]
        a = vector_in[sample]
        q = turn_in[sample]
        b = number_in[sample]
        value_out[sample] = value(i, i, i, b, a, q, a, q, a, q, a, q, a, a, a, a, a, a, a, a, a, a, a, a, b, b, b, b, b)

    return SimpleNamespace(value=value, reach=reach)


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type, on single worlds."""
    real = variant.real
    module = variant.module("adjoint.joints")
    one, f = single.functions(variant), functions(variant)
    vec3, quat, vector_at, quat_at, put = one.vec3, one.quat, one.vector_at, one.quat_at, one.put
    value = f.value

    @wp.kernel(module=module, enable_backward=False)
    def row_states(
        first_row: int,
        projects: bool,
        h: real,
        # Model
        row_entry_start: wp.array(dtype=wp.int32),
        entry_dof: wp.array(dtype=wp.int32),
        row_is_held: wp.array(dtype=wp.int32),
        # Workspace in
        displacement_in: wp.array3d(dtype=real),
        row_in: wp.array3d(dtype=real),
        v_in: wp.array3d(dtype=real),
        target_in: wp.array3d(dtype=real),
        lower_in: wp.array3d(dtype=real),
        upper_in: wp.array3d(dtype=real),
        softness_in: wp.array3d(dtype=real),
        multiplier_in: wp.array3d(dtype=real),
        # Workspace out
        active_out: wp.array3d(dtype=wp.int32),
        compliance_out: wp.array3d(dtype=real),
        mode_out: wp.array3d(dtype=wp.int32),
    ):
        """Whether one row follows its target (1), is stopped by its lower (2) or upper (3) limit, or is at a bound (0).

        A limit has what the motor's force at this gap leaves. ``projects``: only rows without bounds count.
        """
        pack, row, lane = wp.tid()
        k = first_row + row
        mode = int(1)
        compliance = softness_in[pack, k, lane]
        if row_is_held[row] == 0:
            force = multiplier_in[pack, k, lane]
            lower = lower_in[pack, k, lane]
            upper = upper_in[pack, k, lane]
            gap = displacement_in[pack, k, lane] - target_in[pack, k, lane]
            for entry in range(row_entry_start[k], row_entry_start[k + 1]):
                v = vector_at(v_in, pack, lane, 3 * entry_dof[entry])
                gap += h * wp.dot(vector_at(row_in, pack, lane, 3 * entry), v)
            motor = force
            if compliance > real(0.0):
                motor = -gap / compliance
            motor = wp.clamp(motor, lower, upper)
            slack = real(wp.static(SLACK[real])) * (wp.abs(force) + wp.abs(motor))
            if force > motor + slack:
                mode = 2
            elif force < motor - slack:
                mode = 3
            elif force <= lower + slack or force >= upper - slack:
                mode = 0
            if mode > 1:
                compliance = real(0.0)
            if projects:
                mode = 0
        active_out[pack, k, lane] = wp.where(mode > 0, 1, 0)
        compliance_out[pack, k, lane] = compliance
        mode_out[pack, row, lane] = mode

    @wp.kernel(module=module, enable_backward=False)
    def commands(
        first_row: int,
        lanes: int,
        recovery: real,
        h: real,
        lapse: real,
        # Model
        joint_row_start: wp.array(dtype=wp.int32),
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
        mode_in: wp.array3d(dtype=wp.int32),
        q_in: wp.array3d(dtype=real),
        bound_bar_in: wp.array3d(dtype=real),
        multiplier_in: wp.array3d(dtype=real),
        # State out
        reference_bar_out: wp.array2d(dtype=real),
        target_bar_out: wp.array2d(dtype=real),
        force_bar_out: wp.array2d(dtype=real),
        stiffness_bar_out: wp.array2d(dtype=real),
        damping_bar_out: wp.array2d(dtype=real),
        # Workspace out
        coordinate_out: wp.array3d(dtype=real),
    ):
        """Gradients by what one motor is told, by its reference, at the end and then at the start, and its coordinate.

        Those by the stiffness and damping of a servo are added to.
        A target counts where neither limits nor rates overrule it; see ``rows.joint.joint_command``.
        """
        pack, joint, lane = wp.tid()
        world = wp.min(pack * lanes + lane, target_bar_out.shape[0] - 1)
        by_target = real(0.0)
        by_force = real(0.0)
        by_start = real(0.0)
        by_q = real(0.0)
        by_stiffness = real(0.0)
        by_damping = real(0.0)
        by_reference = reference_bar_out[world, joint]
        for row in range(joint_row_start[joint], joint_row_start[joint + 1]):
            if row_kind[row] == wp.static(JointRow.FREE):
                control = joint_control[joint]
                scale = joint_scale[joint]
                mode = mode_in[pack, row, lane]
                q = q_in[pack, first_row + row, lane]
                at = position0_in[pack, joint, lane]
                low = min_position_in[pack, joint, lane]
                high = max_position_in[pack, joint, lane]
                rate = max_rate_in[pack, joint, lane]
                command = target_command_in[pack, joint, lane]
                if mode == 2 and (low - at) * scale < recovery * h:
                    by_q -= q * scale
                if mode == 3 and (high - at) * scale > -recovery * h:
                    by_q -= q * scale
                if control == wp.static(JointControl.POSITION):
                    kp = stiffness_in[pack, joint, lane]
                    total = wp.max(kp + damping_in[pack, joint, lane] / h, real(wp.static(NO_STIFFNESS)))
                    start = reference0_in[pack, joint, lane]
                    is_rigid = kp >= real(wp.static(RIGID_SERVO))
                    if mode == 1:
                        by_reference += q * (kp / total) * scale
                        by_q -= q * (kp / total) * scale
                        if not is_rigid:
                            by_force += q * scale / total
                            inner = wp.clamp(command, start - rate * lapse, start + rate * lapse)
                            way = wp.clamp(inner, low, high) - at
                            force = multiplier_in[pack, first_row + row, lane] * scale
                            force -= force_command_in[pack, joint, lane]
                            share = q * scale / (total * total)
                            if kp + damping_in[pack, joint, lane] / h > real(wp.static(NO_STIFFNESS)):
                                by_stiffness += share * (way * (total - kp) + force)
                                by_damping += share * (force - way * kp) / h
                    lag = real(0.0)
                    most = rate * lapse
                    if is_rigid:
                        start = at
                        most = rate * h
                        lag = lag_in[pack, 0, lane]
                        command = command - lag * (command - at)
                    inner = wp.clamp(command, start - most, start + most)
                    if inner >= low and inner <= high:
                        if inner == command:
                            by_target += by_reference - lag * by_reference
                            by_q += lag * by_reference
                        elif is_rigid:
                            by_q += by_reference
                        else:
                            by_start += by_reference
                elif control == wp.static(JointControl.VELOCITY):
                    if mode == 1:
                        reference = wp.clamp(at + wp.clamp(command, -rate, rate) * h, low, high)
                        if reference > low and reference < high:
                            if wp.abs(command) <= rate:
                                by_target += q * h * scale
                        else:
                            by_q -= q * scale
                elif control == wp.static(JointControl.FORCE):
                    feed = force_command_in[pack, joint, lane]
                    if mode == 0 and wp.abs(feed) <= max_force_in[pack, joint, lane]:
                        by_force += bound_bar_in[pack, first_row + row, lane] / scale
        coordinate_out[pack, joint, lane] = by_q
        if pack * lanes + lane < target_bar_out.shape[0]:
            target_bar_out[world, joint] = by_target
            force_bar_out[world, joint] = by_force
            stiffness_bar_out[world, joint] = stiffness_bar_out[world, joint] + by_stiffness
            damping_bar_out[world, joint] = damping_bar_out[world, joint] + by_damping
            reference_bar_out[world, joint] = by_start

    @wp.kernel(module=module, enable_backward=False)
    def energies(
        first_row: int,
        lanes: int,
        given_row: int,
        taken_row: int,
        h: real,
        # Model
        joint_row_start: wp.array(dtype=wp.int32),
        row_kind: wp.array(dtype=wp.int32),
        joint_control: wp.array(dtype=wp.int32),
        joint_scale: wp.array(dtype=real),
        # Workspace in
        stiffness_in: wp.array3d(dtype=real),
        damping_in: wp.array3d(dtype=real),
        share_in: wp.array3d(dtype=real),
        correction_in: wp.array3d(dtype=real),
        needed_in: wp.array3d(dtype=real),
        # State out
        stiffness_bar_out: wp.array2d(dtype=real),
        damping_bar_out: wp.array2d(dtype=real),
    ):
        """Add what the compliance C of one servo has by both energies, -k' dC k of multipliers k."""
        pack, joint, lane = wp.tid()
        world = pack * lanes + lane
        if world >= stiffness_bar_out.shape[0] or joint_control[joint] != wp.static(JointControl.POSITION):
            return
        kp = stiffness_in[pack, joint, lane]
        total = kp + damping_in[pack, joint, lane] / h
        if kp < real(wp.static(RIGID_SERVO)) and total > real(wp.static(NO_STIFFNESS)):
            for row in range(joint_row_start[joint], joint_row_start[joint + 1]):
                if row_kind[row] == wp.static(JointRow.FREE):
                    given = correction_in[pack, first_row + row, lane]
                    taken = needed_in[pack, first_row + row, lane]
                    value = share_in[pack, given_row, lane] * given * given
                    value += share_in[pack, taken_row, lane] * taken * taken
                    value *= joint_scale[joint] * joint_scale[joint] / (total * total)
                    stiffness_bar_out[world, joint] = stiffness_bar_out[world, joint] + value
                    damping_bar_out[world, joint] = damping_bar_out[world, joint] + value / h

    @wp.func
    def turn_of(q: quat, g: quat):
        """Gradient by a turn of a frame from that by its quaternion."""
        u = vec3(q[0], q[1], q[2])
        by_u = vec3(g[0], g[1], g[2])
        return real(0.5) * (q[3] * by_u + wp.cross(u, by_u) - g[3] * u)

    @wp.kernel(module=module, enable_backward=False)
    def rows_adjoint(
        first_row: int,
        projects: bool,
        weighs: bool,
        h: real,
        # Model
        row_joint: wp.array(dtype=wp.int32),
        row_kind: wp.array(dtype=wp.int32),
        row_axis: wp.array(dtype=wp.int32),
        joint_frame: wp.array2d(dtype=wp.int32),
        joint_place: wp.array2d(dtype=real),
        joint_free: wp.array(dtype=wp.int32),
        joint_length: wp.array(dtype=real),
        # Workspace in
        pose0_in: wp.array3d(dtype=real),
        known_in: wp.array3d(dtype=real),
        difference_in: wp.array3d(dtype=real),
        twist_in: wp.array3d(dtype=real),
        free_in: wp.array3d(dtype=real),
        p_in: wp.array3d(dtype=real),
        multiplier_in: wp.array3d(dtype=real),
        q_in: wp.array3d(dtype=real),
        coordinate_in: wp.array3d(dtype=real),
        # Workspace out
        side_out: wp.array3d(dtype=real),
    ):
        """Gradients of S of one row: see ``SIDES``.

        Where it ``projects`` velocities, rows that hold parts ask H (v - D) = 0 with the differences D instead. Where
        it ``weighs`` energies of corrections, rows of free coordinates have no gap, and the twists ``free_in``.
        """
        pack, row, lane = wp.tid()
        joint = row_joint[row]
        kind = row_kind[row]
        parent = joint_frame[joint, 0]
        child = joint_frame[joint, 1]
        ap = vec3(joint_place[joint, 0], joint_place[joint, 1], joint_place[joint, 2])
        bp = quat(joint_place[joint, 3], joint_place[joint, 4], joint_place[joint, 5], joint_place[joint, 6])
        ac = vec3(joint_place[joint, 7], joint_place[joint, 8], joint_place[joint, 9])
        bc = quat(joint_place[joint, 10], joint_place[joint, 11], joint_place[joint, 12], joint_place[joint, 13])
        none = vec3()
        Xp = none
        Qp = quat(real(0.0), real(0.0), real(0.0), real(1.0))
        Kp = none
        kp = none
        Vp = none
        vp = none
        Pp = none
        pp = none
        is_projected = projects and kind != wp.static(JointRow.FREE)
        c = 6 * child
        Kc = vector_at(known_in, pack, lane, c)
        kc = vector_at(known_in, pack, lane, c + 3)
        weight = real(1.0)
        if is_projected:
            weight = real(0.0)
            Kc = vector_at(difference_in, pack, lane, c)
            kc = vector_at(difference_in, pack, lane, c + 3)
        if parent >= 0:
            Xp = vector_at(pose0_in, pack, lane, 7 * parent)
            Qp = quat_at(pose0_in, pack, lane, 7 * parent + 3)
            d = 6 * parent
            Kp = vector_at(known_in, pack, lane, d)
            kp = vector_at(known_in, pack, lane, d + 3)
            if is_projected:
                Kp = vector_at(difference_in, pack, lane, d)
                kp = vector_at(difference_in, pack, lane, d + 3)
            Vp = vector_at(twist_in, pack, lane, d)
            vp = vector_at(twist_in, pack, lane, d + 3)
            Pp = vector_at(p_in, pack, lane, d)
            pp = vector_at(p_in, pack, lane, d + 3)
        Xc = vector_at(pose0_in, pack, lane, 7 * child)
        Qc = quat_at(pose0_in, pack, lane, 7 * child + 3)
        Vc = vector_at(twist_in, pack, lane, c)
        vc = vector_at(twist_in, pack, lane, c + 3)
        by_q = real(0.0)
        if kind == wp.static(JointRow.FREE):
            by_q = coordinate_in[pack, joint, lane]
            if weighs:
                weight = real(0.0)
                Kp = none
                kp = none
                Kc = none
                kc = none
                Vc = vector_at(free_in, pack, lane, c)
                vc = vector_at(free_in, pack, lane, c + 3)
                if parent >= 0:
                    Vp = vector_at(free_in, pack, lane, 6 * parent)
                    vp = vector_at(free_in, pack, lane, 6 * parent + 3)
        g = wp.grad(value)(
            kind,
            row_axis[row],
            joint_free[joint],
            joint_length[joint],
            ap,
            bp,
            ac,
            bc,
            Xp,
            Qp,
            Xc,
            Qc,
            Kp,
            kp,
            Kc,
            kc,
            Vp,
            vp,
            Vc,
            vc,
            Pp,
            pp,
            vector_at(p_in, pack, lane, c),
            vector_at(p_in, pack, lane, c + 3),
            h * multiplier_in[pack, first_row + row, lane],
            q_in[pack, first_row + row, lane],
            weight,
            by_q,
            h,
        )
        out = wp.static(SIDES) * row
        put(side_out, pack, lane, out, g[8])
        put(side_out, pack, lane, out + 3, turn_of(Qp, g[9]))
        put(side_out, pack, lane, out + 6, g[10])
        put(side_out, pack, lane, out + 9, turn_of(Qc, g[11]))
        put(side_out, pack, lane, out + 12, g[16])
        put(side_out, pack, lane, out + 15, g[17])
        put(side_out, pack, lane, out + 18, g[18])
        put(side_out, pack, lane, out + 21, g[19])
        put(side_out, pack, lane, out + 24, g[12])
        put(side_out, pack, lane, out + 27, g[13])
        put(side_out, pack, lane, out + 30, g[14])
        put(side_out, pack, lane, out + 33, g[15])

    @wp.kernel(module=module, enable_backward=False)
    def gather(
        projects: bool,
        weighs: bool,
        # Model
        frame_side_start: wp.array(dtype=wp.int32),
        frame_side: wp.array(dtype=wp.int32),
        row_kind: wp.array(dtype=wp.int32),
        # Workspace in
        side_in: wp.array3d(dtype=real),
        # Workspace out
        place_out: wp.array3d(dtype=real),
        velocity_out: wp.array3d(dtype=real),
        known_out: wp.array3d(dtype=real),
        difference_out: wp.array3d(dtype=real),
    ):
        """Add what the rows have for one frame; a side is 2 row for a parent, 2 row + 1 for a child."""
        pack, frame, lane = wp.tid()
        for i in range(frame_side_start[frame], frame_side_start[frame + 1]):
            row = frame_side[i] // 2
            side = wp.static(SIDES) * row + 6 * (frame_side[i] % 2)
            is_free = row_kind[row] == wp.static(JointRow.FREE)
            is_projected = projects and not is_free
            for c in range(6):
                k = 6 * frame + c
                place_out[pack, k, lane] = place_out[pack, k, lane] + side_in[pack, side + c, lane]
                if weighs and is_free:
                    continue
                velocity_out[pack, k, lane] = velocity_out[pack, k, lane] + side_in[pack, side + 12 + c, lane]
                value = side_in[pack, side + 24 + c, lane]
                if is_projected:
                    difference_out[pack, k, lane] = difference_out[pack, k, lane] + value
                else:
                    known_out[pack, k, lane] = known_out[pack, k, lane] + value

    return SimpleNamespace(
        row_states=row_states, commands=commands, energies=energies, rows_adjoint=rows_adjoint, gather=gather
    )
