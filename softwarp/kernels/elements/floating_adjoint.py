"""Adjoint of a step of reduced bodies with a floating frame. Theory: docs/theory/adjoint.md, "Reduced bodies".

Gradients by a turn t of R, dR = [t] R, are vectors in the world's axes. A node is at c + r, r = R y, with the velocity
V + w x r + R Phi v, so that gradients by it go to the centre, to turning and, in the body's axes, to the modes. What
turns the body on at the end of a step (``floating_inertia.turn_on``) is differentiated backwards here, pass by pass;
sums over modes with the constants D_lk are gathered in gradients by G_k = sum_l q_l D_lk first.

Arrays of states are ``[world, row]``, others those of single worlds, (pack, row, lane).
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.elements.floating_inertia import MEANS
from softwarp.model.floating import RIGID


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels of one scalar type."""
    real, world_fastest = variant.real, variant.world_fastest
    module = variant.module("adjoint.floating")
    one = single.functions(variant)
    vec3, mat33, quat, vector_at, quat_at = one.vec3, one.mat33, one.quat, one.vector_at, one.quat_at
    put, add_to, exponential = one.put, one.add_to, one.exponential

    @wp.func
    def matrix_at(array: wp.array3d(dtype=real), pack: int, lane: int, row: int):
        """Matrix in nine rows."""
        a = vector_at(array, pack, lane, row)
        b = vector_at(array, pack, lane, row + 3)
        c = vector_at(array, pack, lane, row + 6)
        return wp.matrix_from_rows(a, b, c)

    @wp.func
    def add_matrix(array: wp.array3d(dtype=real), pack: int, lane: int, row: int, m: mat33):
        """Add to a matrix in nine rows."""
        for r in range(3):
            add_to(array, pack, lane, row + 3 * r, vec3(m[r, 0], m[r, 1], m[r, 2]))

    @wp.func
    def world_at(array: wp.array2d(dtype=real), world: int, row: int):
        """Vector in three rows of a state array."""
        return vec3(array[world, row], array[world, row + 1], array[world, row + 2])

    @wp.func
    def axial(m: mat33):
        """w of w . t = m : [t]."""
        return vec3(m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1])

    @wp.func
    def rotation(turn: wp.array3d(dtype=real), pack: int, lane: int, f: int):
        """R of one body."""
        return wp.quat_to_matrix(wp.normalize(quat_at(turn, pack, lane, 4 * f)))

    @wp.func
    def inertia(
        moment: wp.array3d(dtype=real),
        mode_q: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        at: int,
        first: int,
        modes: int,
    ):
        """J in the body's axes per density."""
        S = matrix_at(moment, pack, lane, 9 * at)
        for k in range(wp.static(RIGID), modes):
            S += mode_q[pack, first + k, lane] * matrix_at(moment, pack, lane, 9 * (at + k))
        return wp.trace(S) * wp.identity(n=3, dtype=real) - real(0.5) * (S + wp.transpose(S))

    @wp.func
    def by_inertia(
        moment: wp.array3d(dtype=real),
        mode_q: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        at: int,
        first: int,
        modes: int,
        by_J: mat33,
        moment_bar: wp.array3d(dtype=real),
        mode_bar: wp.array3d(dtype=real),
    ):
        """Add the gradients by moments and amplitudes that J has."""
        by_S = wp.trace(by_J) * wp.identity(n=3, dtype=real) - real(0.5) * (by_J + wp.transpose(by_J))
        add_matrix(moment_bar, pack, lane, 9 * at, by_S)
        for k in range(wp.static(RIGID), modes):
            G = matrix_at(moment, pack, lane, 9 * (at + k))
            mode_bar[pack, first + k, lane] = mode_bar[pack, first + k, lane] + wp.ddot(by_S, G)
            add_matrix(moment_bar, pack, lane, 9 * (at + k), mode_q[pack, first + k, lane] * by_S)

    @wp.func
    def by_coupling(c: vec3):
        """Gradient by G from that by C, its antisymmetric part."""
        return mat33(real(0.0), c[2], -c[1], -c[2], real(0.0), c[0], c[1], -c[0], real(0.0))

    @wp.func
    def carried(
        start_moment: wp.array3d(dtype=real),
        moment: wp.array3d(dtype=real),
        rate: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        at: int,
        last: int,
        Q: mat33,
        W: mat33,
    ):
        """sum C_k p_k of modes, which keep the momentum p_k of nodes, beneath which the frame turns by Q."""
        total = vec3()
        for k in range(wp.static(RIGID), last):
            G = matrix_at(start_moment, pack, lane, 9 * (at + k))
            H = matrix_at(rate, pack, lane, 9 * (at + k))
            p = wp.ddot(W, wp.transpose(G)) + wp.ddot(Q, wp.transpose(H))
            total += p * axial(wp.transpose(matrix_at(moment, pack, lane, 9 * (at + k))))
        return total

    @wp.func
    def jacobian(v: vec3):
        """T of exp[v + d] = exp[T d] exp[v]."""
        angle = wp.length(v)
        a = real(0.5)
        b = real(1.0) / real(6.0)
        if angle > real(1.0e-2):
            a = (real(1.0) - wp.cos(angle)) / (angle * angle)
            b = (angle - wp.sin(angle)) / (angle * angle * angle)
        else:
            square = angle * angle
            a = real(0.5) - square / real(24.0) + square * square / real(720.0)
            b = real(1.0) / real(6.0) - square / real(120.0) + square * square / real(5040.0)
        W = wp.skew(v)
        return wp.identity(n=3, dtype=real) + a * W + b * W * W

    @wp.kernel(module=module, enable_backward=False)
    def take_turns(
        lanes: int,
        # Workspace in
        turn_in: wp.array3d(dtype=real),
        # State out
        turn_bar_out: wp.array2d(dtype=real),
        # Workspace out
        bar_out: wp.array3d(dtype=real),
    ):
        """Gradient by the turn of one frame, from that by its quaternion, which becomes 0."""
        pack, f, lane = wp.tid()
        world = pack * lanes + lane
        found = vec3()
        if world < turn_bar_out.shape[0]:
            q = wp.normalize(quat_at(turn_in, pack, lane, 4 * f))
            u = vec3(turn_bar_out[world, 4 * f], turn_bar_out[world, 4 * f + 1], turn_bar_out[world, 4 * f + 2])
            s = turn_bar_out[world, 4 * f + 3]
            v = vec3(q[0], q[1], q[2])
            found = real(0.5) * (q[3] * u - s * v + wp.cross(v, u))
            for c in range(4):
                turn_bar_out[world, 4 * f + c] = real(0.0)
        put(bar_out, pack, lane, 3 * f, found)

    @wp.kernel(module=module, enable_backward=False)
    def give_turns(
        lanes: int,
        # Workspace in
        turn_in: wp.array3d(dtype=real),
        bar_in: wp.array3d(dtype=real),
        # State out
        turn_bar_out: wp.array2d(dtype=real),
    ):
        """Gradient by the quaternion of one frame, along which it keeps its length."""
        pack, f, lane = wp.tid()
        world = pack * lanes + lane
        if world < turn_bar_out.shape[0]:
            t = vector_at(bar_in, pack, lane, 3 * f)
            q = wp.normalize(quat_at(turn_in, pack, lane, 4 * f))
            found = quat(t[0], t[1], t[2], real(0.0)) * q * real(2.0)
            for c in range(4):
                turn_bar_out[world, 4 * f + c] = found[c]

    @wp.kernel(module=module, enable_backward=False)
    def node_bars(
        # Model
        listed_start: wp.array(dtype=wp.int32),
        listed: wp.array(dtype=wp.int32),
        node: wp.array(dtype=wp.int32),
        first: wp.array(dtype=wp.int32),
        radius: wp.array(dtype=real),
        # Workspace in
        turn_in: wp.array3d(dtype=real),
        centre_in: wp.array3d(dtype=real),
        x_in: wp.array3d(dtype=real),
        v_in: wp.array3d(dtype=real),
        mode_v_in: wp.array3d(dtype=real),
        arm_bar_in: wp.array3d(dtype=real),
        # Workspace out
        x_bar_out: wp.array3d(dtype=real),
        v_bar_out: wp.array3d(dtype=real),
        rigid_out: wp.array3d(dtype=real),
        turn_bar_out: wp.array3d(dtype=real),
    ):
        """Gradients by the nodes of one body, listed, go to its axes; sums by centre, velocity, spin and turn.

        ``arm_bar_in`` are those by r that do not move with the centre.
        """
        pack, f, lane = wp.tid()
        R = rotation(turn_in, pack, lane, f)
        centre = vector_at(centre_in, pack, lane, 3 * f)
        V = vector_at(mode_v_in, pack, lane, first[f])
        spin = vector_at(mode_v_in, pack, lane, first[f] + 3) / radius[f]
        by_centre = vec3()
        by_V = vec3()
        by_spin = vec3()
        by_turn = vec3()
        for item in range(listed_start[f], listed_start[f + 1]):
            i = listed[item]
            row = 3 * node[i]
            r = vector_at(x_in, pack, lane, row) - centre
            u = vector_at(v_in, pack, lane, row) - V - wp.cross(spin, r)
            by_x = vector_at(x_bar_out, pack, lane, 3 * i)
            by_v = vector_at(v_bar_out, pack, lane, 3 * i)
            by_r = by_x + wp.cross(by_v, spin) + vector_at(arm_bar_in, pack, lane, 3 * i)
            by_centre += by_x
            by_V += by_v
            by_spin += wp.cross(r, by_v)
            by_turn += wp.cross(r, by_r) + wp.cross(u, by_v)
            put(x_bar_out, pack, lane, 3 * i, wp.transpose(R) * by_r)
            put(v_bar_out, pack, lane, 3 * i, wp.transpose(R) * by_v)
        put(rigid_out, pack, lane, 9 * f, by_centre)
        put(rigid_out, pack, lane, 9 * f + 3, by_V)
        put(rigid_out, pack, lane, 9 * f + 6, by_spin / radius[f])
        add_to(turn_bar_out, pack, lane, 3 * f, by_turn)

    @wp.kernel(module=module, enable_backward=False)
    def place_bars(
        # Model
        listed_start: wp.array(dtype=wp.int32),
        listed: wp.array(dtype=wp.int32),
        node: wp.array(dtype=wp.int32),
        # Workspace in
        turn_in: wp.array3d(dtype=real),
        centre_in: wp.array3d(dtype=real),
        x_in: wp.array3d(dtype=real),
        arm_bar_in: wp.array3d(dtype=real),
        # Workspace out
        x_bar_out: wp.array3d(dtype=real),
        rigid_out: wp.array3d(dtype=real),
        turn_bar_out: wp.array3d(dtype=real),
    ):
        """``node_bars`` where velocities of nodes have no gradients."""
        pack, f, lane = wp.tid()
        R = rotation(turn_in, pack, lane, f)
        centre = vector_at(centre_in, pack, lane, 3 * f)
        by_centre = vec3()
        by_turn = vec3()
        for item in range(listed_start[f], listed_start[f + 1]):
            i = listed[item]
            by_x = vector_at(x_bar_out, pack, lane, 3 * i)
            by_r = by_x + vector_at(arm_bar_in, pack, lane, 3 * i)
            by_centre += by_x
            by_turn += wp.cross(vector_at(x_in, pack, lane, 3 * node[i]) - centre, by_r)
            put(x_bar_out, pack, lane, 3 * i, wp.transpose(R) * by_r)
        put(rigid_out, pack, lane, 9 * f, by_centre)
        add_to(turn_bar_out, pack, lane, 3 * f, by_turn)

    @wp.kernel(module=module, enable_backward=False)
    def rigid_bars(
        by_velocities: bool,
        # Model
        first_wide: wp.array(dtype=wp.int32),
        # Workspace in
        rigid_in: wp.array3d(dtype=real),
        # Workspace out
        wide_out: wp.array3d(dtype=real),
    ):
        """Gradients by the rigid modes of one body, in the places of the others' sums."""
        pack, f, lane = wp.tid()
        along = vector_at(rigid_in, pack, lane, 9 * f)
        about = vec3()
        if by_velocities:
            along = vector_at(rigid_in, pack, lane, 9 * f + 3)
            about = vector_at(rigid_in, pack, lane, 9 * f + 6)
        put(wide_out, pack, lane, first_wide[f], along)
        put(wide_out, pack, lane, first_wide[f] + 3, about)

    @wp.kernel(module=module, enable_backward=False)
    def turn_back(
        lanes: int,
        # Model
        first: wp.array(dtype=wp.int32),
        modes: wp.array(dtype=wp.int32),
        block: wp.array(dtype=wp.int32),
        mode_dof: wp.array(dtype=wp.int32),
        moment_start: wp.array(dtype=wp.int32),
        moment_stride: wp.array(dtype=wp.int32),
        radius: wp.array(dtype=real),
        volume: wp.array(dtype=real),
        # Workspace in
        turn0_in: wp.array3d(dtype=real),
        dof_v_in: wp.array3d(dtype=real),
        mode_q0_in: wp.array3d(dtype=real),
        mode_q_in: wp.array3d(dtype=real),
        start_moment_in: wp.array3d(dtype=real),
        moment_in: wp.array3d(dtype=real),
        moment_rate_in: wp.array3d(dtype=real),
        x_scale: real,
        # State out
        q_bar_out: wp.array2d(dtype=real),
        v_bar_out: wp.array2d(dtype=real),
        # Workspace out
        turn_bar_out: wp.array3d(dtype=real),
        start_bar_out: wp.array3d(dtype=real),
        end_bar_out: wp.array3d(dtype=real),
        rate_bar_out: wp.array3d(dtype=real),
        q0_bar_out: wp.array3d(dtype=real),
        q1_bar_out: wp.array3d(dtype=real),
    ):
        """``turn_on`` of one body backwards: gradients by what it has found become those by what it was given.

        That by velocities of modes is overwritten by that by unknowns; that by the turn at the end by that at the
        start. Those by moments of the start and of the end and by their rates, and by amplitudes through J, are set.
        """
        pack, f, lane = wp.tid()
        world = wp.min(pack * lanes + lane, v_bar_out.shape[0] - 1)
        at = moment_start[f]
        n = first[f]
        last = modes[f]
        none = mat33()
        for k in range(moment_stride[at]):
            for c in range(9):
                start_bar_out[pack, 9 * (at + k) + c, lane] = real(0.0)
                end_bar_out[pack, 9 * (at + k) + c, lane] = real(0.0)
                rate_bar_out[pack, 9 * (at + k) + c, lane] = real(0.0)
        for k in range(last):
            q0_bar_out[pack, n + k, lane] = real(0.0)
            q1_bar_out[pack, n + k, lane] = real(0.0)
        q0 = wp.normalize(quat_at(turn0_in, pack, lane, 4 * f))
        R0 = wp.quat_to_matrix(q0)
        before = vector_at(dof_v_in, pack, lane, 3 * mode_dof[block[f] + 1]) / radius[f]
        spin = wp.transpose(R0) * before
        J0 = inertia(start_moment_in, mode_q0_in, pack, lane, at, n, last)
        L0 = J0 * spin
        J = inertia(moment_in, mode_q_in, pack, lane, at, n, last)
        for k in range(wp.static(RIGID), last):
            rate = dof_v_in[pack, 3 * mode_dof[block[f] + k // 3] + k % 3, lane]
            L0 += rate * axial(wp.transpose(matrix_at(start_moment_in, pack, lane, 9 * (at + k))))
            c1 = axial(wp.transpose(matrix_at(moment_in, pack, lane, 9 * (at + k))))
            J -= wp.outer(c1, c1) / volume[f]
        L = R0 * L0
        inverse = wp.inverse(J)
        middle = before  # what passes have found before the last one
        for pass_ in range(wp.static(MEANS) - 1):
            turn = (before + middle) * (real(0.5) * x_scale)
            q = wp.normalize(exponential(turn) * q0)
            R = wp.quat_to_matrix(q)
            Q = wp.transpose(R) * R0
            W = Q * wp.skew(spin)
            rest = wp.transpose(R) * L
            rest -= carried(start_moment_in, moment_in, moment_rate_in, pack, lane, at, last, Q, W) / volume[f]
            middle = R * (inverse * rest)
        by_after = world_at(v_bar_out, world, n + 3) * radius[f]
        by_end_turn = vector_at(turn_bar_out, pack, lane, 3 * f)
        by_before = vec3()
        by_turn0 = vec3()
        by_L = vec3()
        by_spin = vec3()
        by_J = none
        for step in range(wp.static(MEANS)):
            share = real(1.0)  # of gradients by velocities, which the last pass has
            way = before + middle
            if step > 0:
                share = real(0.0)
                way = before + before
            turn = way * (real(0.5) * x_scale)
            E = wp.quat_to_matrix(wp.normalize(exponential(turn)))
            R = E * R0
            Q = wp.transpose(R) * R0
            W = Q * wp.skew(spin)
            rest = wp.transpose(R) * L
            rest -= carried(start_moment_in, moment_in, moment_rate_in, pack, lane, at, last, Q, W) / volume[f]
            now = inverse * rest
            by_turn = share * by_end_turn + wp.cross(R * now, by_after)
            by_now = wp.transpose(R) * by_after
            for k in range(wp.static(RIGID), last):
                c1 = axial(wp.transpose(matrix_at(moment_in, pack, lane, 9 * (at + k))))
                by_now -= c1 * (share * v_bar_out[world, n + k] / volume[f])
            by_rest = inverse * by_now
            by_J -= wp.outer(by_rest, now)
            by_L += R * by_rest
            by_turn -= wp.cross(L, R * by_rest)
            by_W = none
            by_Q = none
            for k in range(wp.static(RIGID), last):
                G = matrix_at(start_moment_in, pack, lane, 9 * (at + k))
                H = matrix_at(moment_rate_in, pack, lane, 9 * (at + k))
                c1 = axial(wp.transpose(matrix_at(moment_in, pack, lane, 9 * (at + k))))
                p = wp.ddot(W, wp.transpose(G)) + wp.ddot(Q, wp.transpose(H))
                by_v = share * v_bar_out[world, n + k]
                by_p = (by_v - wp.dot(c1, by_rest)) / volume[f]
                by_c = (by_v * now + p * by_rest) / (-volume[f])
                by_W += by_p * wp.transpose(G)
                by_Q += by_p * wp.transpose(H)
                add_matrix(start_bar_out, pack, lane, 9 * (at + k), by_p * wp.transpose(W))
                add_matrix(rate_bar_out, pack, lane, 9 * (at + k), by_p * wp.transpose(Q))
                add_matrix(end_bar_out, pack, lane, 9 * (at + k), by_coupling(by_c))
            by_Q += by_W * wp.transpose(wp.skew(spin))
            by_spin += axial(wp.transpose(Q) * by_W)
            turned = axial(R * by_Q * wp.transpose(R0))
            by_turn0 += turned
            by_turn -= turned
            by_way = (real(0.5) * x_scale) * (wp.transpose(jacobian(turn)) * by_turn)
            by_turn0 += wp.transpose(E) * by_turn
            by_before += by_way
            by_after = by_way
        by_before += by_after
        by_L0 = wp.transpose(R0) * by_L
        by_turn0 += wp.cross(L, by_L)
        by_spin += J0 * by_L0
        by_before += R0 * by_spin
        by_turn0 -= wp.cross(before, R0 * by_spin)
        by_inertia(
            start_moment_in, mode_q0_in, pack, lane, at, n, last, wp.outer(by_L0, spin), start_bar_out, q0_bar_out
        )
        by_inertia(moment_in, mode_q_in, pack, lane, at, n, last, by_J, end_bar_out, q1_bar_out)
        is_there = pack * lanes + lane < v_bar_out.shape[0]
        for k in range(wp.static(RIGID), last):
            rate = dof_v_in[pack, 3 * mode_dof[block[f] + k // 3] + k % 3, lane]
            c1 = axial(wp.transpose(matrix_at(moment_in, pack, lane, 9 * (at + k))))
            by_c1 = (by_J + wp.transpose(by_J)) * c1 / (-volume[f])
            add_matrix(end_bar_out, pack, lane, 9 * (at + k), by_coupling(by_c1))
            add_matrix(start_bar_out, pack, lane, 9 * (at + k), by_coupling(rate * by_L0))
            c0 = axial(wp.transpose(matrix_at(start_moment_in, pack, lane, 9 * (at + k))))
            if is_there:
                v_bar_out[world, n + k] = wp.dot(c0, by_L0)
        if is_there:
            for c in range(3):
                v_bar_out[world, n + 3 + c] = by_before[c] / radius[f]
                q_bar_out[world, n + 3 + c] = real(0.0)
        put(turn_bar_out, pack, lane, 3 * f, by_turn0)

    @wp.kernel(module=module, enable_backward=False)
    def trial_back(
        lanes: int,
        # Model
        first: wp.array(dtype=wp.int32),
        block: wp.array(dtype=wp.int32),
        mode_dof: wp.array(dtype=wp.int32),
        radius: wp.array(dtype=real),
        # Workspace in
        dof_v_in: wp.array3d(dtype=real),
        x_scale: real,
        # State out
        q_bar_out: wp.array2d(dtype=real),
        v_bar_out: wp.array2d(dtype=real),
        # Workspace out
        turn_bar_out: wp.array3d(dtype=real),
    ):
        """``floating.trial_frame`` of one body backwards: gradients by its turn go to its spin and to its start."""
        pack, f, lane = wp.tid()
        world = pack * lanes + lane
        turn = vector_at(dof_v_in, pack, lane, 3 * mode_dof[block[f] + 1]) * (x_scale / radius[f])
        by_turn = vector_at(turn_bar_out, pack, lane, 3 * f)
        by_spin = (x_scale / radius[f]) * (wp.transpose(jacobian(turn)) * by_turn)
        if world < v_bar_out.shape[0]:
            for c in range(3):
                v_bar_out[world, first[f] + 3 + c] = by_spin[c]
                q_bar_out[world, first[f] + 3 + c] = real(0.0)
        E = wp.quat_to_matrix(wp.normalize(exponential(turn)))
        put(turn_bar_out, pack, lane, 3 * f, wp.transpose(E) * by_turn)

    @wp.func
    def turn_field(
        turn: mat33,
        v: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        row: int,
        along: vec3,
        about: vec3,
        r: vec3,
        own_out: wp.array3d(dtype=real),
        out: wp.array3d(dtype=real),
    ):
        """What modes have at one node, in the world's axes, and all of it."""
        own = turn * vector_at(v, pack, lane, row)
        put(own_out, pack, lane, row, own)
        put(out, pack, lane, row, own + along + wp.cross(about, r))

    @wp.kernel(module=module, enable_backward=False)
    def turn_fields(
        last: int,
        # Model
        listed: wp.array(dtype=wp.int32),
        listed_body: wp.array(dtype=wp.int32),
        node: wp.array(dtype=wp.int32),
        block: wp.array(dtype=wp.int32),
        mode_dof: wp.array(dtype=wp.int32),
        radius: wp.array(dtype=real),
        # Workspace in
        turn_in: wp.array3d(dtype=real),
        centre_in: wp.array3d(dtype=real),
        x_in: wp.array3d(dtype=real),
        dof_v_in: wp.array3d(dtype=real),
        dof_p_in: wp.array3d(dtype=real),
        # Workspace out
        own_v_out: wp.array3d(dtype=real),
        own_p_out: wp.array3d(dtype=real),
        node_v_out: wp.array3d(dtype=real),
        node_p_out: wp.array3d(dtype=real),
    ):
        """v and p of one listed node before ``last``: what its modes have, in the world's axes, and all of it.

        On a CPU of all these.
        """
        pack, part, lane = wp.tid()
        begin = int(0)
        end = listed.shape[0]
        if wp.static(world_fastest):
            begin = part
            end = part + 1
        known = int(-1)
        R = mat33()
        c = vec3()
        v = vec3()
        w = vec3()
        p = vec3()
        q = vec3()
        for item in range(begin, end):
            f = listed_body[item]
            if f != known:
                known = f
                R = rotation(turn_in, pack, lane, f)
                c = vector_at(centre_in, pack, lane, 3 * f)
                along = 3 * mode_dof[block[f]]
                about = 3 * mode_dof[block[f] + 1]
                v = vector_at(dof_v_in, pack, lane, along)
                w = vector_at(dof_v_in, pack, lane, about) / radius[f]
                p = vector_at(dof_p_in, pack, lane, along)
                q = vector_at(dof_p_in, pack, lane, about) / radius[f]
            if listed[item] < last:
                row = 3 * node[listed[item]]
                r = vector_at(x_in, pack, lane, row) - c
                turn_field(R, node_v_out, pack, lane, row, v, w, r, own_v_out, node_v_out)
                turn_field(R, node_p_out, pack, lane, row, p, q, r, own_p_out, node_p_out)

    return SimpleNamespace(
        take_turns=take_turns,
        give_turns=give_turns,
        node_bars=node_bars,
        place_bars=place_bars,
        rigid_bars=rigid_bars,
        turn_back=turn_back,
        trial_back=trial_back,
        turn_fields=turn_fields,
    )
