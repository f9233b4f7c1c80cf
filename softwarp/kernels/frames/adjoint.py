"""Adjoint of frames in a step: how rod nodes move on, their momentum and their forces. Theory: docs/theory/adjoint.md.

A frame with the inertia J in world axes at the start turns by E = exp [h w] and keeps its angular momentum J w, so that
its angular velocity becomes E a, a = J^-1 E' J w. Gradients by orientations are by rotation vectors in world axes,
dR = [t] R; users have them by quaternions, along which q keeps its length. With T, the left Jacobian of exp,

    d(E a) = T h dw x E a + E J^-1 (E' (dJ w + J dw - T h dw x J w) - dJ a),   b.dJ a = t.((J a) x b + (J b) x a).

State arrays are ``[world, row]``; workspace arrays ``[pack, row, lane]``.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.elements.rod_adjoint import PARAMETERS
from softwarp.kernels.frames.inertia import COMPOUND_ROWS
from softwarp.model.codes import Spin


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type, on single worlds."""
    real = variant.real
    module = variant.module("adjoint.frames")
    one = single.functions(variant)
    vec3, mat33, quat, vector_at, quat_at = one.vec3, one.mat33, one.quat, one.vector_at, one.quat_at
    inertia_at, put, exponential = one.inertia_at, one.put, one.exponential

    @wp.func
    def of_world(array: wp.array2d(dtype=real), world: int, row: int):
        """Vector in three rows of a state array."""
        return vec3(array[world, row], array[world, row + 1], array[world, row + 2])

    @wp.func
    def turned(q: quat, J: mat33):
        """R J R'."""
        R = wp.quat_to_matrix(q)
        return R * J * wp.transpose(R)

    @wp.func
    def by_turn(J: mat33, b: vec3, a: vec3):
        """Gradient of b.J a by the turn of J."""
        return wp.cross(J * a, b) + wp.cross(J * b, a)

    @wp.func
    def jacobian_transposed(v: vec3, x: vec3):
        """T(v)' x, T = 1 + (1 - cos a)/a^2 [v] + (a - sin a)/a^3 [v]^2."""
        y = wp.dot(v, v)
        first = real(0.5) - y / real(24.0)
        second = real(1.0) / real(6.0) - y / real(120.0)
        if y > real(1.0e-4):
            a = wp.sqrt(y)
            first = (real(1.0) - wp.cos(a)) / y
            second = (a - wp.sin(a)) / (a * y)
        c = wp.cross(v, x)
        return x - first * c + second * wp.cross(v, c)

    @wp.func
    def offset_of(carried_offset: wp.array2d(dtype=real), item: int):
        """Place of a carried node in its frame."""
        return vec3(carried_offset[item, 0], carried_offset[item, 1], carried_offset[item, 2])

    @wp.func
    def carried_bars(
        frame_item_start: wp.array(dtype=wp.int32),
        frame_item: wp.array(dtype=wp.int32),
        carried_slot: wp.array(dtype=wp.int32),
        carried_offset: wp.array2d(dtype=real),
        x_bar: wp.array2d(dtype=real),
        v_bar: wp.array2d(dtype=real),
        world: int,
        frame: int,
        q: quat,
        w: vec3,
    ):
        """Gradients by place, turn, velocity and spin of one frame, from those by the nodes that it carries."""
        by_x = vec3()
        by_t = vec3()
        by_v = vec3()
        by_w = vec3()
        for i in range(frame_item_start[frame], frame_item_start[frame + 1]):
            item = frame_item[i]
            r = wp.quat_rotate(q, offset_of(carried_offset, item))
            x = of_world(x_bar, world, 3 * carried_slot[item])
            v = of_world(v_bar, world, 3 * carried_slot[item])
            by_x += x
            by_t += wp.cross(r, x + wp.cross(v, w))
            by_v += v
            by_w += wp.cross(r, v)
        return by_x, by_t, by_v, by_w

    @wp.kernel(module=module, enable_backward=False)
    def carried_motion(
        # Model
        carried_slot: wp.array(dtype=wp.int32),
        carried_frame: wp.array(dtype=wp.int32),
        carried_offset: wp.array2d(dtype=real),
        frame_dof: wp.array(dtype=wp.int32),
        # Workspace in
        pose0_in: wp.array3d(dtype=real),
        v_in: wp.array3d(dtype=real),
        p_in: wp.array3d(dtype=real),
        # Workspace out
        node_v_out: wp.array3d(dtype=real),
        node_p_out: wp.array3d(dtype=real),
    ):
        """Velocity V + w x r and adjoint p_t + p_r x r of one carried node."""
        pack, item, lane = wp.tid()
        frame = carried_frame[item]
        t = 3 * frame_dof[2 * frame]
        s = 3 * frame_dof[2 * frame + 1]
        r = wp.quat_rotate(quat_at(pose0_in, pack, lane, 7 * frame + 3), offset_of(carried_offset, item))
        v = vector_at(v_in, pack, lane, t) + wp.cross(vector_at(v_in, pack, lane, s), r)
        p = vector_at(p_in, pack, lane, t) + wp.cross(vector_at(p_in, pack, lane, s), r)
        put(node_v_out, pack, lane, 3 * carried_slot[item], v)
        put(node_p_out, pack, lane, 3 * carried_slot[item], p)

    @wp.kernel(module=module, enable_backward=False)
    def carried_gradients(
        h: real,
        lanes: int,
        # Model
        carried_slot: wp.array(dtype=wp.int32),
        carried_frame: wp.array(dtype=wp.int32),
        carried_offset: wp.array2d(dtype=real),
        frame_dof: wp.array(dtype=wp.int32),
        node_point_start: wp.array(dtype=wp.int32),
        node_point: wp.array(dtype=wp.int32),
        node_point_weight: wp.array(dtype=real),
        point_row: wp.array(dtype=wp.int32),
        # Workspace in
        pose0_in: wp.array3d(dtype=real),
        v_in: wp.array3d(dtype=real),
        p_in: wp.array3d(dtype=real),
        point_gradient_in: wp.array3d(dtype=real),
        multiplier_in: wp.array3d(dtype=real),
        q_in: wp.array3d(dtype=real),
        node_bar_in: wp.array3d(dtype=real),
        # State out
        x_bar_out: wp.array2d(dtype=real),
        v_bar_out: wp.array2d(dtype=real),
        force_bar_out: wp.array2d(dtype=real),
        # Workspace out
        item_out: wp.array3d(dtype=real),
    ):
        """Gradients by place and turn of its frame that one carried node of rows has, which has none of its own.

        Beside those by its place, rows h T H p - h q H v have levers, which turn.
        """
        pack, item, lane = wp.tid()
        world = pack * lanes + lane
        node = carried_slot[item]
        frame = carried_frame[item]
        s = 3 * frame_dof[2 * frame + 1]
        r = wp.quat_rotate(quat_at(pose0_in, pack, lane, 7 * frame + 3), offset_of(carried_offset, item))
        tense = vec3()
        bound = vec3()
        for i in range(node_point_start[node], node_point_start[node + 1]):
            row = point_row[node_point[i]]
            gradient = h * node_point_weight[i] * vector_at(point_gradient_in, pack, lane, 3 * node_point[i])
            tense += multiplier_in[pack, row, lane] * gradient
            bound += q_in[pack, row, lane] * gradient
        place = vector_at(node_bar_in, pack, lane, 3 * node)
        lever = wp.cross(tense, vector_at(p_in, pack, lane, s)) - wp.cross(bound, vector_at(v_in, pack, lane, s))
        put(item_out, pack, lane, 6 * item, place)
        put(item_out, pack, lane, 6 * item + 3, wp.cross(r, place + lever))
        if world < x_bar_out.shape[0]:
            for c in range(3):
                x_bar_out[world, 3 * node + c] = real(0.0)
                v_bar_out[world, 3 * node + c] = real(0.0)
                force_bar_out[world, 3 * node + c] = real(0.0)

    @wp.kernel(module=module, enable_backward=False)
    def frame_seed(
        h: real,
        lanes: int,
        # Model
        frame_spin: wp.array(dtype=wp.int32),
        frame_dof: wp.array(dtype=wp.int32),
        frame_item_start: wp.array(dtype=wp.int32),
        frame_item: wp.array(dtype=wp.int32),
        carried_slot: wp.array(dtype=wp.int32),
        carried_offset: wp.array2d(dtype=real),
        dof_free: wp.array2d(dtype=real),
        # State
        x_bar_in: wp.array2d(dtype=real),
        v_bar_in: wp.array2d(dtype=real),
        pose_bar_in: wp.array2d(dtype=real),
        twist_bar_in: wp.array2d(dtype=real),
        # Workspace in
        pose0_in: wp.array3d(dtype=real),
        compound_in: wp.array3d(dtype=real),
        v_in: wp.array3d(dtype=real),
        # Workspace out
        seed_out: wp.array3d(dtype=real),
        y_out: wp.array3d(dtype=real),
        start_out: wp.array3d(dtype=real),
    ):
        """Gradients by the velocities of one frame's dofs, twice, and by its place and turn at the start, but for A."""
        pack, frame, lane = wp.tid()
        world = wp.min(pack * lanes + lane, pose_bar_in.shape[0] - 1)
        t = frame_dof[2 * frame]
        r = frame_dof[2 * frame + 1]
        k = wp.static(COMPOUND_ROWS) * frame
        by_x = of_world(pose_bar_in, world, 7 * frame)
        by_u = of_world(pose_bar_in, world, 7 * frame + 3)
        by_v = of_world(twist_bar_in, world, 6 * frame)
        by_w = of_world(twist_bar_in, world, 6 * frame + 3)
        w = vector_at(v_in, pack, lane, 3 * r)
        q0 = quat_at(pose0_in, pack, lane, 7 * frame + 3)
        e = exponential(h * w)
        q = wp.normalize(e * q0)
        u = vec3(q[0], q[1], q[2])
        by_turn_then = real(0.5) * (q[3] * by_u + wp.cross(u, by_u) - pose_bar_in[world, 7 * frame + 6] * u)
        J = mat33()
        inverse = mat33()
        momentum = vec3()
        a = w
        keeps = frame_spin[frame] == wp.static(Spin.KEEP_SPIN) and compound_in[pack, k, lane] > real(0.0)
        if keeps:
            J = turned(q0, inertia_at(compound_in, pack, lane, k + 4))
            inverse = wp.inverse(J * (real(1.0) / wp.trace(J))) * (real(1.0) / wp.trace(J))
            momentum = J * w
            a = inverse * wp.quat_rotate_inv(e, momentum)
        more_x, more_t, more_v, more_w = carried_bars(
            frame_item_start,
            frame_item,
            carried_slot,
            carried_offset,
            x_bar_in,
            v_bar_in,
            world,
            frame,
            q,
            wp.quat_rotate(e, a),
        )
        by_x += more_x
        by_turn_then += more_t
        by_v += more_v
        by_w += more_w
        by_start = wp.quat_rotate_inv(e, by_turn_then)
        by_spin = by_w
        if keeps:
            b = inverse * wp.quat_rotate_inv(e, by_w)
            forth = wp.quat_rotate(e, b)
            by_turn_then += wp.cross(wp.quat_rotate(e, a), by_w) - wp.cross(momentum, forth)
            by_start += by_turn(J, forth, w) - by_turn(J, b, a)
            by_spin = J * forth
        by_spin += h * jacobian_transposed(h * w, by_turn_then)
        for c in range(3):
            linear = (by_v[c] + h * by_x[c]) * dof_free[t, c]
            angular = by_spin[c] * dof_free[r, c]
            seed_out[pack, 3 * t + c, lane] = linear
            y_out[pack, 3 * t + c, lane] = linear
            seed_out[pack, 3 * r + c, lane] = angular
            y_out[pack, 3 * r + c, lane] = angular
        put(start_out, pack, lane, 6 * frame, by_x)
        put(start_out, pack, lane, 6 * frame + 3, by_start)

    @wp.kernel(module=module, enable_backward=False)
    def frame_gradients(
        h: real,
        lanes: int,
        # Model
        frame_dof: wp.array(dtype=wp.int32),
        frame_item_start: wp.array(dtype=wp.int32),
        frame_item: wp.array(dtype=wp.int32),
        corner_start: wp.array(dtype=wp.int32),
        corner: wp.array(dtype=wp.int32),
        # Workspace in
        pose0_in: wp.array3d(dtype=real),
        twist0_in: wp.array3d(dtype=real),
        compound_in: wp.array3d(dtype=real),
        v_in: wp.array3d(dtype=real),
        p_in: wp.array3d(dtype=real),
        start_in: wp.array3d(dtype=real),
        corner_in: wp.array3d(dtype=real),
        item_in: wp.array3d(dtype=real),
        # State out
        pose_bar_out: wp.array2d(dtype=real),
        twist_bar_out: wp.array2d(dtype=real),
        force_bar_out: wp.array2d(dtype=real),
    ):
        """Gradients by pose, twist and external force of one frame at the start of the step."""
        pack, frame, lane = wp.tid()
        world = pack * lanes + lane
        if world < pose_bar_out.shape[0]:
            k = wp.static(COMPOUND_ROWS) * frame
            pt = vector_at(p_in, pack, lane, 3 * frame_dof[2 * frame])
            pr = vector_at(p_in, pack, lane, 3 * frame_dof[2 * frame + 1])
            w = vector_at(v_in, pack, lane, 3 * frame_dof[2 * frame + 1])
            w0 = vector_at(twist0_in, pack, lane, 6 * frame + 3)
            q = quat_at(pose0_in, pack, lane, 7 * frame + 3)
            J = turned(q, inertia_at(compound_in, pack, lane, k + 4))
            damped = turned(q, inertia_at(compound_in, pack, lane, k + 14))
            place = vector_at(start_in, pack, lane, 6 * frame)
            turn = vector_at(start_in, pack, lane, 6 * frame + 3)
            for i in range(corner_start[2 * frame], corner_start[2 * frame + 1]):
                place += vector_at(corner_in, pack, lane, 3 * corner[i])
            for i in range(corner_start[2 * frame + 1], corner_start[2 * frame + 2]):
                turn += vector_at(corner_in, pack, lane, 3 * corner[i])
            for i in range(frame_item_start[frame], frame_item_start[frame + 1]):
                place += vector_at(item_in, pack, lane, 6 * frame_item[i])
                turn += vector_at(item_in, pack, lane, 6 * frame_item[i] + 3)
            turn += by_turn(J, pr, w0) - by_turn(damped, pr, w)
            by_q = quat(turn[0], turn[1], turn[2], real(0.0)) * q * real(2.0)
            linear = compound_in[pack, k, lane] * pt
            angular = J * pr
            for c in range(3):
                pose_bar_out[world, 7 * frame + c] = place[c]
                twist_bar_out[world, 6 * frame + c] = linear[c]
                twist_bar_out[world, 6 * frame + 3 + c] = angular[c]
                force_bar_out[world, 6 * frame + c] = h * pt[c]
                force_bar_out[world, 6 * frame + 3 + c] = h * pr[c]
            for c in range(4):
                pose_bar_out[world, 7 * frame + 3 + c] = by_q[c]

    @wp.kernel(module=module, enable_backward=False)
    def rods(
        h: real,
        lanes: int,
        # Model
        rod_frame_start: wp.array(dtype=wp.int32),
        rod_segment_start: wp.array(dtype=wp.int32),
        rod_segment: wp.array(dtype=wp.int32),
        frame_dof: wp.array(dtype=wp.int32),
        # Workspace in
        density_in: wp.array3d(dtype=real),
        gravity_in: wp.array3d(dtype=real),
        pose0_in: wp.array3d(dtype=real),
        twist0_in: wp.array3d(dtype=real),
        compound_in: wp.array3d(dtype=real),
        v_in: wp.array3d(dtype=real),
        p_in: wp.array3d(dtype=real),
        parameter_in: wp.array3d(dtype=real),
        # State out
        youngs_bar_out: wp.array2d(dtype=real),
        nu_bar_out: wp.array2d(dtype=real),
        density_bar_out: wp.array2d(dtype=real),
        rayleigh_mass_bar_out: wp.array2d(dtype=real),
        rayleigh_stiffness_bar_out: wp.array2d(dtype=real),
    ):
        """Add the gradients by the parameters of one rod."""
        pack, rod, lane = wp.tid()
        world = pack * lanes + lane
        if world < youngs_bar_out.shape[0]:
            g = vector_at(gravity_in, pack, lane, 0)
            density = density_in[pack, rod, lane]
            by_density = real(0.0)
            by_alpha = real(0.0)
            for frame in range(rod_frame_start[rod], rod_frame_start[rod + 1]):
                k = wp.static(COMPOUND_ROWS) * frame
                t = 3 * frame_dof[2 * frame]
                r = 3 * frame_dof[2 * frame + 1]
                pt = vector_at(p_in, pack, lane, t)
                pr = vector_at(p_in, pack, lane, r)
                V = vector_at(v_in, pack, lane, t)
                w = vector_at(v_in, pack, lane, r)
                q = quat_at(pose0_in, pack, lane, 7 * frame + 3)
                mass = compound_in[pack, k, lane]
                J = turned(q, inertia_at(compound_in, pack, lane, k + 4))
                damped = turned(q, inertia_at(compound_in, pack, lane, k + 14))
                if density > real(0.0):
                    gain = mass * (vector_at(twist0_in, pack, lane, 6 * frame) + h * g)
                    gain -= compound_in[pack, k + 10, lane] * V
                    spun = J * vector_at(twist0_in, pack, lane, 6 * frame + 3) - damped * w
                    by_density += (wp.dot(pt, gain) + wp.dot(pr, spun)) / density
                by_alpha -= h * (mass * wp.dot(pt, V) + wp.dot(pr, J * w))
            by_youngs = real(0.0)
            by_nu = real(0.0)
            by_beta = real(0.0)
            for i in range(rod_segment_start[rod], rod_segment_start[rod + 1]):
                row = wp.static(PARAMETERS) * rod_segment[i]
                by_youngs += parameter_in[pack, row, lane]
                by_nu += parameter_in[pack, row + 1, lane]
                by_beta += parameter_in[pack, row + 2, lane]
            youngs_bar_out[world, rod] = youngs_bar_out[world, rod] + by_youngs
            nu_bar_out[world, rod] = nu_bar_out[world, rod] + by_nu
            density_bar_out[world, rod] = density_bar_out[world, rod] + by_density
            rayleigh_mass_bar_out[world, rod] = rayleigh_mass_bar_out[world, rod] + by_alpha
            rayleigh_stiffness_bar_out[world, rod] = rayleigh_stiffness_bar_out[world, rod] + by_beta

    @wp.kernel(module=module, enable_backward=False)
    def weights(
        h: real,
        lanes: int,
        # Model
        rod_frame_start: wp.array(dtype=wp.int32),
        frame_dof: wp.array(dtype=wp.int32),
        # Workspace in
        compound_in: wp.array3d(dtype=real),
        p_in: wp.array3d(dtype=real),
        # State out
        gravity_bar_out: wp.array2d(dtype=real),
    ):
        """Add the gradient by gravity of one world's rods."""
        pack, lane = wp.tid()
        world = pack * lanes + lane
        if world < gravity_bar_out.shape[0]:
            total = vec3()
            last = rod_frame_start[rod_frame_start.shape[0] - 1]
            for frame in range(rod_frame_start[0], last):
                mass = compound_in[pack, wp.static(COMPOUND_ROWS) * frame, lane]
                total += h * mass * vector_at(p_in, pack, lane, 3 * frame_dof[2 * frame])
            for c in range(3):
                gravity_bar_out[world, c] = gravity_bar_out[world, c] + total[c]

    return SimpleNamespace(
        carried_motion=carried_motion,
        carried_gradients=carried_gradients,
        frame_seed=frame_seed,
        frame_gradients=frame_gradients,
        rods=rods,
        weights=weights,
    )
