"""Inertia of reduced bodies with a floating frame, and what becomes of their velocities when the frame turns.

With D_lk = sum of volume phi_l phi_k' and amplitudes q (1 for the place at rest, phi_0 = X), G_k = sum_l q_l D_lk is
what the places y = X + Phi q have with mode k. All of the mass matrix that the state changes follows from it:

    S = sum_k q_k G_k = sum of volume y y',   J = tr S - S,   C_k = sum of volume y x phi_k, antisymmetric part of G_k.

Theory: docs/theory/reduction.md, "A floating frame".
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.elements import mode_sums
from softwarp.model.floating import RIGID

MEANS = 2  # passes that the mean velocity of turning within a step is found in


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels of one scalar type."""
    return SimpleNamespace(**vars(_by_modes(variant)), **vars(_by_worlds(variant)))


@cache
def _by_modes(variant: Variant) -> SimpleNamespace:
    """Sums over modes, as a device does them best."""
    S, real, world_fastest = variant.S, variant.real, variant.world_fastest
    module = variant.module("floating_moments")
    displace = mode_sums.functions(variant).displace

    @wp.kernel(module=module, enable_backward=False)
    def moments(
        # Model
        moment_first: wp.array(dtype=wp.int32),
        moment_wide: wp.array(dtype=wp.int32),
        moment_stride: wp.array(dtype=wp.int32),
        moments: wp.array(dtype=real),
        # Workspace in
        wide_in: wp.array2d(dtype=S),
        # Workspace out
        moment_out: wp.array2d(dtype=S),
    ):
        """Sum of amplitudes times D_lk over the modes l of one mode k, row by row."""
        w, k = wp.tid()
        if wp.static(world_fastest):
            k, w = wp.tid()
        stride = moment_stride[k]
        for c in range(3):
            at = moment_first[k] + 3 * c * stride
            displace(moments, at, stride, wide_in, w, moment_wide[k], moment_out, 9 * k + 3 * c)

    return SimpleNamespace(moments=moments)


@single_worlds
def _by_worlds(variant: Variant) -> SimpleNamespace:
    """Kernels on single worlds."""
    real = variant.real
    module = variant.module("floating_inertia")
    one = single.functions(variant)
    vec3, mat33, vector_at, quat_at = one.vec3, one.mat33, one.vector_at, one.quat_at
    put, put_quat, add_to, exponential = one.put, one.put_quat, one.add_to, one.exponential

    @wp.func
    def moment_at(moment: wp.array3d(dtype=real), pack: int, lane: int, k: int):
        """G of one mode."""
        a = vector_at(moment, pack, lane, 9 * k)
        b = vector_at(moment, pack, lane, 9 * k + 3)
        c = vector_at(moment, pack, lane, 9 * k + 6)
        return wp.matrix_from_rows(a, b, c)

    @wp.func
    def coupling(moment: wp.array3d(dtype=real), pack: int, lane: int, k: int):
        """C of one mode."""
        G = moment_at(moment, pack, lane, k)
        return vec3(G[1, 2] - G[2, 1], G[2, 0] - G[0, 2], G[0, 1] - G[1, 0])

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
        S = moment_at(moment, pack, lane, at)
        for k in range(wp.static(RIGID), modes):
            S += mode_q[pack, first + k, lane] * moment_at(moment, pack, lane, at + k)
        return wp.trace(S) * wp.identity(n=3, dtype=real) - real(0.5) * (S + wp.transpose(S))

    @wp.func
    def spin_of_modes(
        moment: wp.array3d(dtype=real),
        mode_v: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        at: int,
        first: int,
        modes: int,
    ):
        """Angular momentum per density that amplitudes have as they change, in the body's axes."""
        total = vec3()
        for k in range(wp.static(RIGID), modes):
            total += mode_v[pack, first + k, lane] * coupling(moment, pack, lane, at + k)
        return total

    @wp.func
    def drag_at(wide_drag: wp.array3d(dtype=real), pack: int, lane: int, count: int, k: int):
        """k_scale K of turning and one wide mode."""
        return vec3(wide_drag[pack, k, lane], wide_drag[pack, count + k, lane], wide_drag[pack, 2 * count + k, lane])

    @wp.kernel(module=module, enable_backward=False)
    def turning_tangent(
        wide_count: int,
        # Model
        pair: wp.array(dtype=wp.int32),
        pair_body: wp.array(dtype=wp.int32),
        pair_mode: wp.array(dtype=wp.int32),
        pair_block: wp.array(dtype=wp.int32),
        body: wp.array(dtype=wp.int32),
        first: wp.array(dtype=wp.int32),
        modes: wp.array(dtype=wp.int32),
        moment_start: wp.array(dtype=wp.int32),
        radius: wp.array(dtype=real),
        first_wide: wp.array(dtype=wp.int32),
        # Workspace in
        body_mass_scale_in: wp.array3d(dtype=real),
        body_damping_scale_in: wp.array3d(dtype=real),
        wide_drag_in: wp.array3d(dtype=real),
        turning_drag_in: wp.array3d(dtype=real),
        density_in: wp.array3d(dtype=real),
        turn0_in: wp.array3d(dtype=real),
        mode_q0_in: wp.array3d(dtype=real),
        moment_in: wp.array3d(dtype=real),
        # Workspace out
        a_out: wp.array3d(dtype=real),
    ):
        """Set the block of A of what turns one body and a later block, or of the former alone."""
        pack, item, lane = wp.tid()
        f = pair_body[item]
        mode = pair_mode[item]
        at = moment_start[f]
        mass = body_mass_scale_in[pack, body[f], lane] * density_in[pack, body[f], lane] / radius[f]
        R = wp.quat_to_matrix(wp.normalize(quat_at(turn0_in, pack, lane, 4 * f)))
        damping = body_damping_scale_in[pack, body[f], lane]
        block = mat33()
        drag = mat33()
        if mode < wp.static(RIGID):
            J = inertia(moment_in, mode_q0_in, pack, lane, at, first[f], modes[f])
            block = (R * J * wp.transpose(R)) / radius[f]
            drag = R * moment_at(turning_drag_in, pack, lane, f) * wp.transpose(R)
        else:
            rows = wp.matrix_from_rows(
                coupling(moment_in, pack, lane, at + mode),
                coupling(moment_in, pack, lane, at + mode + 1),
                coupling(moment_in, pack, lane, at + mode + 2),
            )
            block = rows * wp.transpose(R)
            k = first_wide[f] + mode
            drag = wp.matrix_from_rows(
                drag_at(wide_drag_in, pack, lane, wide_count, k),
                drag_at(wide_drag_in, pack, lane, wide_count, k + 1),
                drag_at(wide_drag_in, pack, lane, wide_count, k + 2),
            ) * wp.transpose(R)
        block = mass * block + damping * drag
        code = pair_block[pair[item]]
        if code % 2 == 1:
            block = wp.transpose(block)
        for r in range(3):
            for c in range(3):
                a_out[pack, 9 * (code // 2) + 3 * r + c, lane] = block[r, c]

    @wp.func
    def add_momentum(
        moment: wp.array3d(dtype=real),
        mode_q: wp.array3d(dtype=real),
        mode_v: wp.array3d(dtype=real),
        mode_dof: wp.array(dtype=wp.int32),
        pack: int,
        lane: int,
        at: int,
        first: int,
        modes: int,
        block: int,
        radius: real,
        R: mat33,
        factor: real,
        b: wp.array3d(dtype=real),
    ):
        """b += factor M v of what turns the body and its coupling to the modes."""
        spin = wp.transpose(R) * vector_at(mode_v, pack, lane, first + 3) / radius
        momentum = inertia(moment, mode_q, pack, lane, at, first, modes) * spin
        momentum += spin_of_modes(moment, mode_v, pack, lane, at, first, modes)
        add_to(b, pack, lane, 3 * mode_dof[block + 1], R * momentum * (factor / radius))
        for k in range(wp.static(RIGID), modes):
            row = 3 * mode_dof[block + k // 3] + k % 3
            b[pack, row, lane] = b[pack, row, lane] + factor * wp.dot(spin, coupling(moment, pack, lane, at + k))

    @wp.func
    def add_drag(
        turning_drag: wp.array3d(dtype=real),
        wide_drag: wp.array3d(dtype=real),
        mode_v: wp.array3d(dtype=real),
        mode_dof: wp.array(dtype=wp.int32),
        pack: int,
        lane: int,
        f: int,
        count: int,
        wide: int,
        first: int,
        modes: int,
        block: int,
        R: mat33,
        factor: real,
        b: wp.array3d(dtype=real),
    ):
        """b += factor k_scale K v of turning and its coupling to the modes."""
        spin = wp.transpose(R) * vector_at(mode_v, pack, lane, first + 3)
        total = moment_at(turning_drag, pack, lane, f) * spin
        for k in range(wp.static(RIGID), modes):
            d = drag_at(wide_drag, pack, lane, count, wide + k)
            total += mode_v[pack, first + k, lane] * d
            row = 3 * mode_dof[block + k // 3] + k % 3
            b[pack, row, lane] = b[pack, row, lane] + factor * wp.dot(d, spin)
        add_to(b, pack, lane, 3 * mode_dof[block + 1], R * total * factor)

    @wp.kernel(module=module, enable_backward=False)
    def turning_momentum(
        wide_count: int,
        # Model
        body: wp.array(dtype=wp.int32),
        first: wp.array(dtype=wp.int32),
        modes: wp.array(dtype=wp.int32),
        block: wp.array(dtype=wp.int32),
        mode_dof: wp.array(dtype=wp.int32),
        moment_start: wp.array(dtype=wp.int32),
        radius: wp.array(dtype=real),
        first_wide: wp.array(dtype=wp.int32),
        # Workspace in
        body_mass_scale_in: wp.array3d(dtype=real),
        body_damping_scale_in: wp.array3d(dtype=real),
        wide_drag_in: wp.array3d(dtype=real),
        turning_drag_in: wp.array3d(dtype=real),
        density_in: wp.array3d(dtype=real),
        turn0_in: wp.array3d(dtype=real),
        mode_q0_in: wp.array3d(dtype=real),
        mode_v0_in: wp.array3d(dtype=real),
        mode_v_in: wp.array3d(dtype=real),
        moment_in: wp.array3d(dtype=real),
        moving: bool,
        # Workspace out
        b_out: wp.array3d(dtype=real),
    ):
        """Add to b what ``reduction.right_hand_side`` leaves out for one body: inertia that its state changes."""
        pack, f, lane = wp.tid()
        n = body[f]
        density = density_in[pack, n, lane]
        q = wp.normalize(quat_at(turn0_in, pack, lane, 4 * f))
        R = wp.quat_to_matrix(q)
        at = moment_start[f]
        add_momentum(
            moment_in, mode_q0_in, mode_v0_in, mode_dof, pack, lane, at, first[f], modes[f], block[f], radius[f],
            R, density, b_out,
        )  # fmt: skip
        if moving:
            damping = real(1.0) - body_damping_scale_in[pack, n, lane]
            keep = -density * body_mass_scale_in[pack, n, lane] * damping
            add_momentum(
                moment_in, mode_q0_in, mode_v_in, mode_dof, pack, lane, at, first[f], modes[f], block[f], radius[f],
                R, keep, b_out,
            )  # fmt: skip
            # b has damping times A v, in which turning has its part of damping only.
            rest = -body_damping_scale_in[pack, n, lane] * damping
            add_drag(
                turning_drag_in, wide_drag_in, mode_v_in, mode_dof, pack, lane, f, wide_count, first_wide[f], first[f],
                modes[f], block[f], R, rest, b_out,
            )  # fmt: skip

    @wp.kernel(module=module, enable_backward=False)
    def turn_on(
        # Model
        first: wp.array(dtype=wp.int32),
        modes: wp.array(dtype=wp.int32),
        block: wp.array(dtype=wp.int32),
        mode_dof: wp.array(dtype=wp.int32),
        moment_start: wp.array(dtype=wp.int32),
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
        # Workspace out
        mode_v_out: wp.array3d(dtype=real),
        turn_out: wp.array3d(dtype=real),
    ):
        """Turn one body on, by the mean of its angular velocities before and after, and find the latter.

        Its linear and angular momentum stay what they are; the momentum of its modes is that of the nodes, which keep
        their velocities while the modes turn beneath them: so centrifugal and Coriolis forces come about.
        """
        pack, f, lane = wp.tid()
        at = moment_start[f]
        n = first[f]
        last = modes[f]
        q0 = wp.normalize(quat_at(turn0_in, pack, lane, 4 * f))
        before = vector_at(dof_v_in, pack, lane, 3 * mode_dof[block[f] + 1]) / radius[f]
        spin = wp.quat_rotate_inv(q0, before)
        momentum = inertia(start_moment_in, mode_q0_in, pack, lane, at, n, last) * spin
        for k in range(wp.static(RIGID), last):
            rate = dof_v_in[pack, 3 * mode_dof[block[f] + k // 3] + k % 3, lane]
            momentum += rate * coupling(start_moment_in, pack, lane, at + k)
        momentum = wp.quat_rotate(q0, momentum)
        J = inertia(moment_in, mode_q_in, pack, lane, at, n, last)
        for k in range(wp.static(RIGID), last):
            c = coupling(moment_in, pack, lane, at + k)
            J -= wp.outer(c, c) / volume[f]
        after = before
        q = q0
        for pass_ in range(wp.static(MEANS)):
            turn = (before + after) * (real(0.5) * x_scale)
            q = q0
            if wp.length_sq(turn) > real(0.0):
                q = wp.normalize(exponential(turn) * q0)
            Q = wp.quat_to_matrix(wp.quat_inverse(q) * q0)
            W = Q * wp.skew(spin)
            rest = wp.quat_rotate_inv(q, momentum)
            for k in range(wp.static(RIGID), last):
                G = moment_at(start_moment_in, pack, lane, at + k)
                H = moment_at(moment_rate_in, pack, lane, at + k)
                p = wp.ddot(W, wp.transpose(G)) + wp.ddot(Q, wp.transpose(H))
                mode_v_out[pack, n + k, lane] = p / volume[f]
                rest -= coupling(moment_in, pack, lane, at + k) * (p / volume[f])
            now = wp.inverse(J) * rest
            for k in range(wp.static(RIGID), last):
                less = wp.dot(coupling(moment_in, pack, lane, at + k), now) / volume[f]
                mode_v_out[pack, n + k, lane] = mode_v_out[pack, n + k, lane] - less
            after = wp.quat_rotate(q, now)
        put(mode_v_out, pack, lane, n + 3, after * radius[f])
        put_quat(turn_out, pack, lane, 4 * f, q)

    return SimpleNamespace(turning_tangent=turning_tangent, turning_momentum=turning_momentum, turn_on=turn_on)
