"""What inertia, damping, rows and loads of bodies with a floating frame add to the adjoint of a step.

With p and v of the modes, pi = R'p_w and sigma = R'w in the body's axes, J and C_k of ``floating_inertia``, a step has

    rho (pi . J s + pi . sum C_k a_k + s . sum C_k p_k) + ...,   s = sigma_0 - (1 + h alpha) sigma,   a likewise,

less the damping of turning, d (P . D v + W . D p + P . T W) with the sums D and T of ``floating_drag``. Forces f_p that
act along p of a node, and f_v along v, turn with what modes have of these: (R Phi p) x f_p, and f_p x p_w is by r.
Elements are indifferent to the frame: what they have by a turn is only what p_w and w have against it.
Theory: docs/theory/adjoint.md, "Reduced bodies".
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.model.floating import RIGID


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels of one scalar type."""
    real = variant.real
    module = variant.module("adjoint.floating_pull")
    one = single.functions(variant)
    vec3, mat33, vector_at, quat_at = one.vec3, one.mat33, one.vector_at, one.quat_at
    put, add_to = one.put, one.add_to

    @wp.func
    def matrix_at(array: wp.array3d(dtype=real), pack: int, lane: int, row: int, size: int):
        """3 x 3 block of a matrix with rows of ``size`` entries."""
        a = vector_at(array, pack, lane, row)
        b = vector_at(array, pack, lane, row + size)
        c = vector_at(array, pack, lane, row + 2 * size)
        return wp.matrix_from_rows(a, b, c)

    @wp.func
    def coupling(moment: wp.array3d(dtype=real), pack: int, lane: int, k: int):
        """C of one mode."""
        G = matrix_at(moment, pack, lane, 9 * k, 3)
        return vec3(G[1, 2] - G[2, 1], G[2, 0] - G[0, 2], G[0, 1] - G[1, 0])

    @wp.func
    def drag_at(wide_drag: wp.array3d(dtype=real), pack: int, lane: int, count: int, k: int):
        """k_scale K of turning and one wide mode."""
        return vec3(wide_drag[pack, k, lane], wide_drag[pack, count + k, lane], wide_drag[pack, 2 * count + k, lane])

    @wp.func
    def add_matrix(array: wp.array3d(dtype=real), pack: int, lane: int, row: int, m: mat33):
        """Add to a matrix in nine rows."""
        for r in range(3):
            add_to(array, pack, lane, row + 3 * r, vec3(m[r, 0], m[r, 1], m[r, 2]))

    @wp.kernel(module=module, enable_backward=False)
    def turning_bars(
        wide_count: int,
        h: real,
        lanes: int,
        asks_parameters: bool,
        # Model
        body: wp.array(dtype=wp.int32),
        first: wp.array(dtype=wp.int32),
        modes: wp.array(dtype=wp.int32),
        block: wp.array(dtype=wp.int32),
        mode_dof: wp.array(dtype=wp.int32),
        moment_start: wp.array(dtype=wp.int32),
        first_wide: wp.array(dtype=wp.int32),
        radius: wp.array(dtype=real),
        volume: wp.array(dtype=real),
        # Workspace in
        mass_scale_in: wp.array3d(dtype=real),
        damping_scale_in: wp.array3d(dtype=real),
        wide_drag_in: wp.array3d(dtype=real),
        turning_drag_in: wp.array3d(dtype=real),
        density_in: wp.array3d(dtype=real),
        gravity_in: wp.array3d(dtype=real),
        turn0_in: wp.array3d(dtype=real),
        mode_q0_in: wp.array3d(dtype=real),
        mode_v0_in: wp.array3d(dtype=real),
        dof_v_in: wp.array3d(dtype=real),
        dof_p_in: wp.array3d(dtype=real),
        start_moment_in: wp.array3d(dtype=real),
        # State out
        v_bar_out: wp.array2d(dtype=real),
        density_bar_out: wp.array2d(dtype=real),
        rayleigh_mass_bar_out: wp.array2d(dtype=real),
        gravity_bar_out: wp.array2d(dtype=real),
        # Workspace out
        turn_bar_out: wp.array3d(dtype=real),
        start_bar_out: wp.array3d(dtype=real),
        q0_bar_out: wp.array3d(dtype=real),
    ):
        """Gradients by velocities, turns, moments, density, Rayleigh's alpha and gravity of all bodies of one world."""
        pack, lane = wp.tid()
        world = pack * lanes + lane
        for f in range(body.shape[0]):
            at = moment_start[f]
            n = first[f]
            last = modes[f]
            density = density_in[pack, body[f], lane]
            scale = mass_scale_in[pack, body[f], lane]
            R = wp.quat_to_matrix(wp.normalize(quat_at(turn0_in, pack, lane, 4 * f)))
            along = 3 * mode_dof[block[f]]
            about = 3 * mode_dof[block[f] + 1]
            p_V = vector_at(dof_p_in, pack, lane, along)
            V = vector_at(dof_v_in, pack, lane, along)
            P = wp.transpose(R) * vector_at(dof_p_in, pack, lane, about)
            W = wp.transpose(R) * vector_at(dof_v_in, pack, lane, about)
            p_w = P / radius[f]
            w = W / radius[f]
            w0 = wp.transpose(R) * vector_at(mode_v0_in, pack, lane, n + 3) / radius[f]
            s = w0 - scale * w
            S = matrix_at(start_moment_in, pack, lane, 9 * at, 3)
            Cp = vec3()
            Cv = vec3()
            Ca = vec3()
            Dp = vec3()
            Dv = vec3()
            for k in range(wp.static(RIGID), last):
                row = 3 * mode_dof[block[f] + k // 3] + k % 3
                p = dof_p_in[pack, row, lane]
                v = dof_v_in[pack, row, lane]
                C = coupling(start_moment_in, pack, lane, at + k)
                D = drag_at(wide_drag_in, pack, lane, wide_count, first_wide[f] + k)
                S += mode_q0_in[pack, n + k, lane] * matrix_at(start_moment_in, pack, lane, 9 * (at + k), 3)
                Cp += p * C
                Cv += v * C
                Ca += (mode_v0_in[pack, n + k, lane] - scale * v) * C
                Dp += p * D
                Dv += v * D
            J = wp.trace(S) * wp.identity(n=3, dtype=real) - real(0.5) * (S + wp.transpose(S))
            by_p = density * (J * s + Ca)
            by_s = density * (J * p_w + Cp)
            by_J = density * wp.outer(p_w, s)
            by_S = wp.trace(by_J) * wp.identity(n=3, dtype=real) - real(0.5) * (by_J + wp.transpose(by_J))
            add_matrix(start_bar_out, pack, lane, 9 * at, by_S)
            is_there = world < v_bar_out.shape[0]
            for k in range(wp.static(RIGID), last):
                row = 3 * mode_dof[block[f] + k // 3] + k % 3
                C = coupling(start_moment_in, pack, lane, at + k)
                a = mode_v0_in[pack, n + k, lane] - scale * dof_v_in[pack, row, lane]
                by_C = density * (a * p_w + dof_p_in[pack, row, lane] * s)
                G = matrix_at(start_moment_in, pack, lane, 9 * (at + k), 3)
                q0_bar_out[pack, n + k, lane] = q0_bar_out[pack, n + k, lane] + wp.ddot(by_S, G)
                zero = real(0.0)
                by_G = mat33(zero, by_C[2], -by_C[1], -by_C[2], zero, by_C[0], by_C[1], -by_C[0], zero)
                by_G += mode_q0_in[pack, n + k, lane] * by_S
                add_matrix(start_bar_out, pack, lane, 9 * (at + k), by_G)
                if is_there:
                    v_bar_out[world, n + k] = v_bar_out[world, n + k] + density * wp.dot(C, p_w)
            T = matrix_at(turning_drag_in, pack, lane, 9 * f, 3)
            damping = -damping_scale_in[pack, body[f], lane]
            by_P = damping * (Dv + T * W)
            by_W = damping * (Dp + wp.transpose(T) * P)
            turn = wp.cross(p_w, by_p) + wp.cross(s, by_s) + wp.cross(P, by_P) + wp.cross(W, by_W)
            add_to(turn_bar_out, pack, lane, 3 * f, -(R * turn))
            if is_there:
                spin = R * by_s / radius[f]
                for c in range(3):
                    v_bar_out[world, n + c] = v_bar_out[world, n + c] + density * volume[f] * p_V[c]
                    v_bar_out[world, n + 3 + c] = v_bar_out[world, n + 3 + c] + spin[c]
                    if asks_parameters:
                        gravity_bar_out[world, c] = gravity_bar_out[world, c] + h * density * volume[f] * p_V[c]
            if is_there and asks_parameters:
                g = vector_at(gravity_in, pack, lane, 0)
                change = vector_at(mode_v0_in, pack, lane, n) - scale * V + h * g
                by_density = volume[f] * wp.dot(p_V, change) + wp.dot(p_w, J * s + Ca) + wp.dot(s, Cp)
                by_alpha = volume[f] * wp.dot(p_V, V) + wp.dot(p_w, J * w + Cv) + wp.dot(w, Cp)
                density_bar_out[world, body[f]] = density_bar_out[world, body[f]] + by_density
                held = rayleigh_mass_bar_out[world, body[f]]
                rayleigh_mass_bar_out[world, body[f]] = held - h * density * by_alpha

    @wp.kernel(module=module, enable_backward=False)
    def drag_bars(
        size: int,
        begin: int,
        # Model
        sample: wp.array(dtype=wp.int32),
        sample_body: wp.array(dtype=wp.int32),
        corner: wp.array2d(dtype=wp.int32),
        body: wp.array(dtype=wp.int32),
        block: wp.array(dtype=wp.int32),
        mode_dof: wp.array(dtype=wp.int32),
        radius: wp.array(dtype=real),
        # Workspace in
        damping_scale_in: wp.array3d(dtype=real),
        node_v_in: wp.array3d(dtype=real),
        node_p_in: wp.array3d(dtype=real),
        dof_v_in: wp.array3d(dtype=real),
        dof_p_in: wp.array3d(dtype=real),
        stiffness_in: wp.array3d(dtype=real),
        # Workspace out
        corner_out: wp.array3d(dtype=real),
    ):
        """Add the gradients by corners of one sample that velocities of turning have, which grow with the arms."""
        pack, item, lane = wp.tid()
        f = sample_body[item]
        if f >= 0:
            e = sample[item]
            about = 3 * mode_dof[block[f] + 1]
            scale = -damping_scale_in[pack, body[f], lane] / radius[f]
            p_w = scale * vector_at(dof_p_in, pack, lane, about)
            w = scale * vector_at(dof_v_in, pack, lane, about)
            v0 = vector_at(node_v_in, pack, lane, 3 * corner[e, 0])
            p0 = vector_at(node_p_in, pack, lane, 3 * corner[e, 0])
            total = vec3()
            row = 12 * (begin + e)
            for i in range(size // 3):
                Kv = vec3()
                Kp = vec3()
                for j in range(size // 3):
                    K = matrix_at(stiffness_in, pack, lane, size * size * item + 3 * (size * i + j), size)
                    Kv += K * (vector_at(node_v_in, pack, lane, 3 * corner[e, j + 1]) - v0)
                    Kp += K * (vector_at(node_p_in, pack, lane, 3 * corner[e, j + 1]) - p0)
                found = wp.cross(Kv, p_w) + wp.cross(Kp, w)
                add_to(corner_out, pack, lane, row + 3 * (i + 1), found)
                total += found
            add_to(corner_out, pack, lane, row, -total)

    @wp.kernel(module=module, enable_backward=False)
    def arm_bars(
        h: real,
        dof_count: int,
        last: int,
        # Model
        listed_start: wp.array(dtype=wp.int32),
        listed: wp.array(dtype=wp.int32),
        listed_touch: wp.array(dtype=wp.int32),
        node: wp.array(dtype=wp.int32),
        block: wp.array(dtype=wp.int32),
        mode_dof: wp.array(dtype=wp.int32),
        radius: wp.array(dtype=real),
        node_point_start: wp.array(dtype=wp.int32),
        node_point: wp.array(dtype=wp.int32),
        node_point_weight: wp.array(dtype=real),
        point_row: wp.array(dtype=wp.int32),
        corner_start: wp.array(dtype=wp.int32),
        corner: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        node_basis: wp.array(dtype=wp.int32),
        body_wide: wp.array(dtype=wp.int32),
        body_stride: wp.array(dtype=wp.int32),
        basis: wp.array(dtype=real),
        # Workspace in
        turn_in: wp.array3d(dtype=real),
        wide_p_in: wp.array3d(dtype=real),
        centre_in: wp.array3d(dtype=real),
        x_in: wp.array3d(dtype=real),
        own_v_in: wp.array3d(dtype=real),
        own_p_in: wp.array3d(dtype=real),
        dof_v_in: wp.array3d(dtype=real),
        dof_p_in: wp.array3d(dtype=real),
        point_gradient_in: wp.array3d(dtype=real),
        multiplier_in: wp.array3d(dtype=real),
        q_in: wp.array3d(dtype=real),
        external_in: wp.array3d(dtype=real),
        corner_bar_in: wp.array3d(dtype=real),
        touch_p_in: wp.array3d(dtype=real),
        touch_v_in: wp.array3d(dtype=real),
        # Workspace out
        arm_bar_out: wp.array3d(dtype=real),
        turn_bar_out: wp.array3d(dtype=real),
    ):
        """Gradients by the arms of one body's nodes and by its turn that rows, contacts and loads have.

        Elements have none by a turn: what their gradients by nodes will have is taken off. Listed nodes from ``last``
        on have loads alone, and p is found where they do.
        """
        pack, f, lane = wp.tid()
        R = wp.quat_to_matrix(wp.normalize(quat_at(turn_in, pack, lane, 4 * f)))
        centre = vector_at(centre_in, pack, lane, 3 * f)
        about = 3 * mode_dof[block[f] + 1]
        p_w = vector_at(dof_p_in, pack, lane, about) / radius[f]
        w = vector_at(dof_v_in, pack, lane, about) / radius[f]
        turn = vec3()
        for item in range(listed_start[f], listed_start[f + 1]):
            i = listed[item]
            row = 3 * node[i]
            along_p = h * vector_at(external_in, pack, lane, row)
            if i >= last:
                put(arm_bar_out, pack, lane, 3 * i, wp.cross(along_p, p_w))
                if wp.length_sq(along_p) > real(0.0):
                    stride = body_stride[node_body[i]]
                    own = vec3()
                    for k in range(stride):
                        at = node_basis[i] + k
                        shape = vec3(basis[at], basis[at + stride], basis[at + 2 * stride])
                        own += wide_p_in[pack, body_wide[node_body[i]] + k, lane] * shape
                    turn += wp.cross(R * own, along_p)
                continue
            along_v = vec3()
            for entry in range(node_point_start[node[i]], node_point_start[node[i] + 1]):
                point = node_point[entry]
                g = vector_at(point_gradient_in, pack, lane, 3 * point) * (h * node_point_weight[entry])
                along_p += g * multiplier_in[pack, point_row[point], lane]
                along_v -= g * q_in[pack, point_row[point], lane]
            touch = listed_touch[i]
            if touch >= 0:
                along_p += vector_at(touch_p_in, pack, lane, 3 * (dof_count + touch))
                along_v += vector_at(touch_v_in, pack, lane, 3 * (dof_count + touch))
            put(arm_bar_out, pack, lane, 3 * i, wp.cross(along_p, p_w) + wp.cross(along_v, w))
            turn += wp.cross(vector_at(own_p_in, pack, lane, row), along_p)
            turn += wp.cross(vector_at(own_v_in, pack, lane, row), along_v)
            by_elements = vec3()
            for entry in range(corner_start[node[i]], corner_start[node[i] + 1]):
                by_elements += vector_at(corner_bar_in, pack, lane, 3 * corner[entry])
            turn -= wp.cross(vector_at(x_in, pack, lane, row) - centre, by_elements)
        add_to(turn_bar_out, pack, lane, 3 * f, turn)

    @wp.kernel(module=module, enable_backward=False)
    def split_stiffness(
        # Workspace in
        stiffness_in: wp.array3d(dtype=real),
        damping_in: wp.array3d(dtype=real),
        # Workspace out
        elastic_out: wp.array3d(dtype=real),
        damped_out: wp.array3d(dtype=real),
    ):
        """h^2 and h beta, which are the factor of the stiffness of one body together."""
        pack, body, lane = wp.tid()
        k = stiffness_in[pack, body, lane]
        d = damping_in[pack, body, lane] * k
        elastic_out[pack, body, lane] = k - d
        damped_out[pack, body, lane] = d

    @wp.kernel(module=module, enable_backward=False)
    def join(
        size: int,
        omit: int,
        # Workspace in
        value_in: wp.array3d(dtype=real),
        # Workspace out
        total_out: wp.array3d(dtype=real),
    ):
        """Add one row, unless it is ``omit`` among ``size``."""
        pack, row, lane = wp.tid()
        if row % size != omit:
            total_out[pack, row, lane] = total_out[pack, row, lane] + value_in[pack, row, lane]

    return SimpleNamespace(
        turning_bars=turning_bars,
        drag_bars=drag_bars,
        arm_bars=arm_bars,
        split_stiffness=split_stiffness,
        join=join,
    )
