"""Adjoint of contacts in a step, with the active set of the step. Theory: docs/theory/adjoint.md.

A contact has the relative velocity s = sum w_k v_k and pushes with the force F = l_n n + F_t. The step found

    open    l = 0
    stick   g* + h n.s + C l_n = 0,   h s_t = 0
    slip    g* + h n.s + C l_n = 0,   F_t = -mu l_n s_t / |s_t|.

With the gaps g = h H p of the adjoint p of velocities and z, its forces, A p + h H' z = y, and

    open    z = 0
    stick   g_n = C z_n,   g_t = 0
    slip    g_n = C z_n - mu r.g_t,   z_t = k (1 - r r') g_t,   r = F_t / |F_t|,   k = mu l_n / (h |s_t|),

as the friction of what slips follows its pressure, and turns with its direction. That couples pressure and friction in
one direction only, so the matrix is not symmetric: W of all rows is eliminated with pivots. At a switch the gradient
is that of one side: what just touches without force is open, what just slips sticks.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.model.codes import SLOTS

SLIPS = {wp.float64: 1.0e-8, wp.float32: 1.0e-4}  # relative distance of friction from its bound up to which it slips
DEPENDENT = {wp.float64: 1.0e-13, wp.float32: 1.0e-6}  # relative pivot of a row that repeats others


@single_worlds
def functions(variant: Variant) -> SimpleNamespace:
    """How contacts move, of single worlds."""
    real = variant.real
    one = single.functions(variant)
    vec3, vector_at = one.vec3, one.vector_at

    @wp.func
    def motion(
        dof: wp.array3d(dtype=wp.int32),
        weight: wp.array3d(dtype=real),
        lever: wp.array3d(dtype=real),
        u: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        contact: int,
    ):
        """sum w_k u_k + u_k x r_k of one contact, in world axes, and how what it stands on turns."""
        total = vec3()
        spin = vec3()
        for slot in range(wp.static(SLOTS)):
            item = wp.static(SLOTS) * contact + slot
            row = dof[pack, item, lane]
            if row >= 0:
                here = vector_at(u, pack, lane, 3 * row)
                total += weight[pack, item, lane] * here + wp.cross(here, vector_at(lever, pack, lane, 3 * item))
                if weight[pack, item, lane] == real(0.0):
                    spin = here
        return total, spin

    @wp.func
    def along(axes: wp.array3d(dtype=real), pack: int, lane: int, contact: int, v: vec3):
        """Components of a vector of the world."""
        n = vector_at(axes, pack, lane, 9 * contact)
        s = vector_at(axes, pack, lane, 9 * contact + 3)
        t = vector_at(axes, pack, lane, 9 * contact + 6)
        return vec3(wp.dot(n, v), wp.dot(s, v), wp.dot(t, v))

    return SimpleNamespace(motion=motion, along=along)


@single_worlds
def kernels(variant: Variant, forward: bool = False) -> SimpleNamespace:
    """Kernels for one scalar type, on single worlds: (pack, row, lane).

    Args:
        variant: Scalar type and memory order.
        forward: Solve for the change -z of forces instead, whose equations are the transposed ones.
    """
    real = variant.real
    module = variant.module("directional.laws" if forward else "adjoint.contact")
    one = single.functions(variant)
    vec3, vector_at = one.vec3, one.vector_at
    dependent = DEPENDENT[real]
    found = functions(variant)
    motion, along = found.motion, found.along

    @wp.kernel(module=module, enable_backward=False)
    def known_gaps(
        rows: int,
        h: real,
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        dof_in: wp.array3d(dtype=wp.int32),
        weight_in: wp.array3d(dtype=real),
        lever_in: wp.array3d(dtype=real),
        axes_in: wp.array3d(dtype=real),
        p_in: wp.array3d(dtype=real),
        # Workspace out
        gap_out: wp.array3d(dtype=real),
    ):
        """h H p of one contact, with what is known of p; 0 where there is no contact."""
        pack, contact, lane = wp.tid()
        g = vec3()
        if contact < count_in[pack, 0, lane]:
            u, _ = motion(dof_in, weight_in, lever_in, p_in, pack, lane, contact)
            g = h * along(axes_in, pack, lane, contact, u)
        for a in range(3):
            gap_out[pack, rows + 3 * contact + a, lane] = g[a]

    @wp.kernel(module=module, enable_backward=False)
    def modes(
        h: real,
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        dof_in: wp.array3d(dtype=wp.int32),
        weight_in: wp.array3d(dtype=real),
        lever_in: wp.array3d(dtype=real),
        axes_in: wp.array3d(dtype=real),
        mu_in: wp.array3d(dtype=real),
        multiplier_in: wp.array3d(dtype=real),
        v_in: wp.array3d(dtype=real),
        # Workspace out
        mode_out: wp.array3d(dtype=real),
    ):
        """Whether one contact was open (0), stuck (1) or slipped (2); of what slipped k, and r in its tangents."""
        pack, contact, lane = wp.tid()
        mode = real(0.0)
        k = real(0.0)
        r = vec3()
        if contact < count_in[pack, 0, lane]:
            force = vector_at(multiplier_in, pack, lane, 3 * contact)
            if force[0] > real(0.0):
                mode = real(1.0)
                friction = wp.sqrt(force[1] * force[1] + force[2] * force[2])
                radius = mu_in[pack, contact, lane] * force[0]
                u, _ = motion(dof_in, weight_in, lever_in, v_in, pack, lane, contact)
                s = along(axes_in, pack, lane, contact, u)
                speed = wp.sqrt(s[1] * s[1] + s[2] * s[2])
                if friction >= radius * (real(1.0) - real(wp.static(SLIPS[real]))) and speed > real(0.0):
                    mode = real(2.0)
                    k = radius / (h * speed)
                    r = vec3(real(0.0), -s[1] / speed, -s[2] / speed)
        mode_out[pack, 4 * contact, lane] = mode
        mode_out[pack, 4 * contact + 1, lane] = k
        mode_out[pack, 4 * contact + 2, lane] = r[1]
        mode_out[pack, 4 * contact + 3, lane] = r[2]

    @wp.func
    def equation(
        delassus: wp.array3d(dtype=real),
        compliance: wp.array3d(dtype=real),
        softness: wp.array3d(dtype=real),
        active: wp.array3d(dtype=wp.int32),
        mode: wp.array3d(dtype=real),
        mu: wp.array3d(dtype=real),
        gap: wp.array3d(dtype=real),
        offset: wp.array3d(dtype=real),
        q: wp.array3d(dtype=real),
        z: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        rows: int,
        order: int,
        total: int,
        i: int,
        matrix_out: wp.array3d(dtype=real),
        change_out: wp.array3d(dtype=real),
    ):
        """One row of the equations for the change of q and z: coefficients, and the right-hand side in ``change``."""
        own = real(1.0)  # factors of this row of W, of the two tangents' rows, and of the unit matrix
        first = real(0.0)
        second = real(0.0)
        unit = real(0.0)
        before = real(0.0)
        pressed = real(0.0)  # share of the pressure in friction
        normal = int(-1)
        is_open = bool(False)
        t = i
        if i < rows:
            is_open = active[pack, i, lane] == 0
            unit = compliance[pack, i, lane]  # the gap has C q in it already
        else:
            contact = (i - rows) / 3
            axis = (i - rows) % 3
            t = rows + 3 * contact + 1
            state = mode[pack, 4 * contact, lane]
            k = mode[pack, 4 * contact + 1, lane]
            r1 = mode[pack, 4 * contact + 2, lane]
            r2 = mode[pack, 4 * contact + 3, lane]
            is_open = state == real(0.0)
            if axis == 0:
                unit = softness[pack, contact, lane]
                before = unit * z[pack, 3 * contact, lane]
                if state == real(2.0) and wp.static(not forward):
                    first = mu[pack, contact, lane] * r1
                    second = mu[pack, contact, lane] * r2
            elif state == real(2.0):
                unit = real(1.0)
                before = z[pack, 3 * contact + axis, lane]
                if wp.static(forward):
                    normal = t - 1
                    pressed = -mu[pack, contact, lane] * wp.where(axis == 1, r1, r2)
                    before += pressed * z[pack, 3 * contact, lane] + offset[pack, 3 * contact + axis, lane]
                own = real(0.0)
                if axis == 1:
                    first = k * (real(1.0) - r1 * r1)
                    second = -k * r1 * r2
                else:
                    first = -k * r1 * r2
                    second = k * (real(1.0) - r2 * r2)
        u = wp.min(t + 1, total - 1)
        right = own * gap[pack, i, lane] - before
        if first != real(0.0) or second != real(0.0):
            right += first * gap[pack, t, lane] + second * gap[pack, u, lane]
        for j in range(total):
            entry = own * delassus[pack, i * order + j, lane]
            if first != real(0.0) or second != real(0.0):
                entry += first * delassus[pack, t * order + j, lane] + second * delassus[pack, u * order + j, lane]
            if i == j:
                entry += unit
            if j == normal:
                entry += pressed
            if is_open:
                entry = wp.where(i == j, real(1.0), real(0.0))
            matrix_out[pack, i * order + j, lane] = entry
        change_out[pack, i, lane] = wp.where(is_open, real(0.0), right)

    @wp.func
    def swap(
        matrix_out: wp.array3d(dtype=real),
        change_out: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        order: int,
        total: int,
        i: int,
        k: int,
    ):
        """Exchange two rows."""
        for j in range(k, total):
            kept = matrix_out[pack, i * order + j, lane]
            matrix_out[pack, i * order + j, lane] = matrix_out[pack, k * order + j, lane]
            matrix_out[pack, k * order + j, lane] = kept
        right = change_out[pack, i, lane]
        change_out[pack, i, lane] = change_out[pack, k, lane]
        change_out[pack, k, lane] = right

    @wp.kernel(module=module, enable_backward=False)
    def solve(
        rows: int,
        order: int,
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        delassus_in: wp.array3d(dtype=real),
        compliance_in: wp.array3d(dtype=real),
        softness_in: wp.array3d(dtype=real),
        active_in: wp.array3d(dtype=wp.int32),
        mode_in: wp.array3d(dtype=real),
        mu_in: wp.array3d(dtype=real),
        gap_in: wp.array3d(dtype=real),
        offset_in: wp.array3d(dtype=real),
        # Workspace out
        matrix_out: wp.array3d(dtype=real),
        change_out: wp.array3d(dtype=real),
        q_out: wp.array3d(dtype=real),
        z_out: wp.array3d(dtype=real),
    ):
        """Changes of q and z, and their sums, by Gauss' elimination; rows that repeat others get none."""
        pack, lane = wp.tid()
        total = rows + 3 * count_in[pack, 0, lane]
        for i in range(total):
            equation(
                delassus_in,
                compliance_in,
                softness_in,
                active_in,
                mode_in,
                mu_in,
                gap_in,
                offset_in,
                q_out,
                z_out,
                pack,
                lane,
                rows,
                order,
                total,
                i,
                matrix_out,
                change_out,
            )
        for k in range(total):
            largest = int(k)
            for i in range(k + 1, total):
                if wp.abs(matrix_out[pack, i * order + k, lane]) > wp.abs(matrix_out[pack, largest * order + k, lane]):
                    largest = i
            if largest != k:
                swap(matrix_out, change_out, pack, lane, order, total, largest, k)
            pivot = matrix_out[pack, k * order + k, lane]
            for i in range(k + 1, total):
                entry = matrix_out[pack, i * order + k, lane]
                if entry != real(0.0) and pivot != real(0.0):
                    factor = entry / pivot
                    for j in range(k + 1, total):
                        value = matrix_out[pack, i * order + j, lane] - factor * matrix_out[pack, k * order + j, lane]
                        matrix_out[pack, i * order + j, lane] = value
                    change_out[pack, i, lane] = change_out[pack, i, lane] - factor * change_out[pack, k, lane]
        for back in range(total):
            i = total - 1 - back
            value = change_out[pack, i, lane]
            for j in range(i + 1, total):
                value -= matrix_out[pack, i * order + j, lane] * change_out[pack, j, lane]
            pivot = matrix_out[pack, i * order + i, lane]
            if wp.abs(pivot) > real(wp.static(dependent)) * delassus_in[pack, i * order + i, lane]:
                value = value / pivot
            else:
                value = real(0.0)
            change_out[pack, i, lane] = value
            if i < rows:
                q_out[pack, i, lane] = q_out[pack, i, lane] + value
            else:
                z_out[pack, i - rows, lane] = z_out[pack, i - rows, lane] + value
        for i in range(total, order):
            change_out[pack, i, lane] = real(0.0)

    @wp.func
    def add_world(array: wp.array2d(dtype=real), world: int, row: int, v: vec3):
        """Add a vector to three rows of a state array."""
        for c in range(3):
            array[world, row + c] = array[world, row + c] + v[c]

    @wp.func
    def lever_bar(
        pack: int,
        lane: int,
        dof: int,
        h: real,
        force: vec3,
        z: vec3,
        by_v: vec3,
        p_in: wp.array3d(dtype=real),
        v_in: wp.array3d(dtype=real),
        v0_in: wp.array3d(dtype=real),
    ):
        """Gradient by the lever of a frame's turn, with which its spin moves the contact."""
        total = h * wp.cross(force, vector_at(p_in, pack, lane, 3 * dof))
        total -= h * wp.cross(z, vector_at(v_in, pack, lane, 3 * dof))
        return total + wp.cross(by_v, vector_at(v0_in, pack, lane, 3 * dof))

    @wp.func
    def add_frame(
        pack: int,
        lane: int,
        world: int,
        part: int,
        place: vec3,
        turn: vec3,
        by_before: vec3,
        by_push: vec3,
        pose0_in: wp.array3d(dtype=real),
        pose_bar_out: wp.array2d(dtype=real),
        twist_bar_out: wp.array2d(dtype=real),
        velocity_bar_out: wp.array2d(dtype=real),
    ):
        """Add gradients by place or turn, by the velocity before and by the commanded one, of a part of a frame."""
        frame = part / 2
        row = 6 * frame + 3 * (part % 2)
        add_world(twist_bar_out, world, row, by_before)
        if row < velocity_bar_out.shape[1]:
            add_world(velocity_bar_out, world, row, by_push)
        add_world(pose_bar_out, world, 7 * frame, place)
        q = one.quat_at(pose0_in, pack, lane, 7 * frame + 3)
        by_q = one.quat(turn[0], turn[1], turn[2], real(0.0)) * q * real(2.0)
        for c in range(4):
            pose_bar_out[world, 7 * frame + 3 + c] = pose_bar_out[world, 7 * frame + 3 + c] + by_q[c]

    @wp.kernel(module=module, enable_backward=False)
    def gradients(
        h: real,
        lanes: int,
        share: real,
        recovery: real,
        bounce_speed: real,
        moves: bool,
        # Model
        dof_node: wp.array(dtype=wp.int32),
        dof_frame: wp.array(dtype=wp.int32),
        frame_is_target: wp.array(dtype=wp.int32),
        frame_is_kinematic: wp.array(dtype=wp.int32),
        # Workspace in
        pose0_in: wp.array3d(dtype=real),
        count_in: wp.array3d(dtype=wp.int32),
        listed_in: wp.array3d(dtype=wp.int32),
        pair_in: wp.array3d(dtype=wp.int32),
        dof_in: wp.array3d(dtype=wp.int32),
        weight_in: wp.array3d(dtype=real),
        lever_in: wp.array3d(dtype=real),
        axes_in: wp.array3d(dtype=real),
        gap_in: wp.array3d(dtype=real),
        pair_distance_in: wp.array3d(dtype=real),
        restitution_in: wp.array3d(dtype=real),
        softness_in: wp.array3d(dtype=real),
        multiplier_in: wp.array3d(dtype=real),
        mode_in: wp.array3d(dtype=real),
        z_in: wp.array3d(dtype=real),
        p_in: wp.array3d(dtype=real),
        v_in: wp.array3d(dtype=real),
        v0_in: wp.array3d(dtype=real),
        # State out
        x_bar_out: wp.array2d(dtype=real),
        v_bar_out: wp.array2d(dtype=real),
        mu_bar_out: wp.array2d(dtype=real),
        pose_bar_out: wp.array2d(dtype=real),
        twist_bar_out: wp.array2d(dtype=real),
        velocity_bar_out: wp.array2d(dtype=real),
    ):
        """Add the gradients of one world's contacts by positions, by velocities that bounce, and by friction.

        The distance from a plane changes by n . sum w_k dx_k, the speed of a turning plane with the place. Where frames
        ``move``, they have the same by their places, turns and velocities; a frame in ``dof_frame`` is 2 frame for its
        place, 2 frame + 1 for its turn, and -1 is a node.
        """
        pack, lane = wp.tid()
        world = pack * lanes + lane
        if world < x_bar_out.shape[0]:
            for contact in range(count_in[pack, 0, lane]):
                if mode_in[pack, 4 * contact, lane] > real(0.0):
                    n = vector_at(axes_in, pack, lane, 9 * contact)
                    normal = -z_in[pack, 3 * contact, lane]
                    distance = gap_in[pack, contact, lane]
                    by_x = normal
                    by_v = real(0.0)
                    is_late = contact >= listed_in[pack, 0, lane]
                    if distance < real(0.0) and softness_in[pack, contact, lane] == real(0.0) and not is_late:
                        by_x = normal * share
                        if share * distance < -recovery * h:
                            by_x = real(0.0)
                    bounce = restitution_in[pack, contact, lane]
                    if bounce > real(0.0):
                        u0, _ = motion(dof_in, weight_in, lever_in, v0_in, pack, lane, contact)
                        before = wp.dot(n, u0)
                        if before < -bounce_speed and distance + h * before <= real(0.0):
                            by_x = real(0.0)
                            by_v = normal * h * bounce
                    z = -normal * n
                    for a in range(1, 3):
                        z += z_in[pack, 3 * contact + a, lane] * vector_at(axes_in, pack, lane, 9 * contact + 3 * a)
                    pair = pair_in[pack, contact, lane]
                    depth = distance + pair_distance_in[pack, pair, lane]
                    force = vec3()
                    for a in range(3):
                        axis = vector_at(axes_in, pack, lane, 9 * contact + 3 * a)
                        force += multiplier_in[pack, 3 * contact + a, lane] * axis
                    own = vec3()
                    other = vec3()
                    is_held = bool(False)
                    for slot in range(wp.static(SLOTS)):
                        dof = dof_in[pack, wp.static(SLOTS) * contact + slot, lane]
                        if dof >= 0 and dof_frame[dof] % 2 == 1:
                            bar = lever_bar(pack, lane, dof, h, force, z, by_v * n, p_in, v_in, v0_in)
                            if frame_is_target[dof_frame[dof] / 2] != 0:
                                other = bar
                            else:
                                own = bar
                                is_held = True
                    # the place of the contact is x - share depth n for each side; see ``collision.broad.slots``
                    own_share = real(0.0)
                    other_share = real(1.0)
                    if depth <= real(0.0):
                        own_share = wp.where(is_held, real(0.5), real(0.0))
                        other_share = own_share
                    way = (by_x + other_share * wp.dot(n, other) - own_share * wp.dot(n, own)) * n
                    along_p, _ = motion(dof_in, weight_in, lever_in, p_in, pack, lane, contact)
                    along_v, _ = motion(dof_in, weight_in, lever_in, v_in, pack, lane, contact)
                    before_v, _ = motion(dof_in, weight_in, lever_in, v0_in, pack, lane, contact)
                    for slot in range(wp.static(SLOTS)):
                        item = wp.static(SLOTS) * contact + slot
                        dof = dof_in[pack, item, lane]
                        row = int(-1)
                        if dof >= 0:
                            row = 3 * dof_node[dof]
                        weight = weight_in[pack, item, lane]
                        if row >= 0 and row < x_bar_out.shape[1]:  # else it is of a frame
                            add_world(x_bar_out, world, row, weight * (way - other))
                            add_world(v_bar_out, world, row, weight * by_v * n)
                        elif dof >= 0 and moves:
                            is_target = frame_is_target[dof_frame[dof] / 2] != 0
                            lever = vector_at(lever_in, pack, lane, 3 * item)
                            place = weight * (way - other)
                            turn = vec3()
                            by_before = weight * by_v * n
                            by_push = -h * weight * z
                            if dof_frame[dof] % 2 == 1:
                                by_push = -h * wp.cross(lever, z)
                            if frame_is_kinematic[dof_frame[dof] / 2] == 0:
                                by_push = vec3()
                            if dof_frame[dof] % 2 == 1:
                                by_before = by_v * wp.cross(lever, n)
                                turn = wp.cross(lever + own_share * depth * n, way - other + own)
                                if is_target:
                                    turn = wp.cross(lever, way)
                                    turn += h * (wp.cross(force, along_p) - wp.cross(z, along_v))
                                    turn += by_v * wp.cross(n, before_v)
                                    turn += depth * wp.cross(n, other_share * other - own_share * own)
                            add_frame(
                                pack,
                                lane,
                                world,
                                dof_frame[dof],
                                place,
                                turn,
                                by_before,
                                by_push,
                                pose0_in,
                                pose_bar_out,
                                twist_bar_out,
                                velocity_bar_out,
                            )
                    if mode_in[pack, 4 * contact, lane] == real(2.0):
                        u, _ = motion(dof_in, weight_in, lever_in, p_in, pack, lane, contact)
                        g = along(axes_in, pack, lane, contact, u)
                        slip = mode_in[pack, 4 * contact + 2, lane] * g[1] + mode_in[pack, 4 * contact + 3, lane] * g[2]
                        by_mu = h * multiplier_in[pack, 3 * contact, lane] * slip
                        mu_bar_out[world, pair] = mu_bar_out[world, pair] + by_mu

    return SimpleNamespace(known_gaps=known_gaps, modes=modes, solve=solve, gradients=gradients)
