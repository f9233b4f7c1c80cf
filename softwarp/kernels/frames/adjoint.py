"""Adjoint of frames in a step: how they move on with their momentum, and their forces. Theory: docs/theory/adjoint.md.

A compound with the mass matrix M, of m, s and J in world axes, has the momentum (P, L) = M (V, w), moves by h V and
turns by exp [h w]; at its new place it has M1 (V1, w1) = (P, L - h V x P). Gradients by orientations are by rotation
vectors in world axes, dR = [t] R; users have them by quaternions, along which q keeps its length. For the turn t of M

    b.dM a = t.(s x (b_t x a_r) + s x (a_t x b_r) + (J a_r) x b_r + (J b_r) x a_r).

State arrays are ``[world, row]``; workspace arrays ``[pack, row, lane]``.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.frames import momentum as of_momentum
from softwarp.kernels.frames import top_adjoint
from softwarp.kernels.frames.inertia import COMPOUND_ROWS
from softwarp.kernels.frames.parameter_adjoint import MOVED_ROWS
from softwarp.kernels.frames.parameter_adjoint import functions as of_compounds
from softwarp.model.codes import Spin


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type, on single worlds."""
    real = variant.real
    module = variant.module("adjoint.frames")
    one = single.functions(variant)
    vec3, mat33, quat, vector_at, quat_at = one.vec3, one.mat33, one.quat, one.vector_at, one.quat_at
    inertia_at, put, put_quat, exponential = one.inertia_at, one.put, one.put_quat, one.exponential
    compounds = of_compounds(variant)
    turned, momentum = compounds.turned, compounds.momentum
    add_share = compounds.add_share
    of_end = of_momentum.functions(variant)
    change_of_twist, inertia_inverse = of_end.change_of_twist, of_end.inertia_inverse
    tops = top_adjoint.functions(variant)
    top_moved, top_about_centre, top_pull = tops.moved, tops.about_centre, tops.pull

    @wp.func
    def of_world(array: wp.array2d(dtype=real), world: int, row: int):
        """Vector in three rows of a state array."""
        return vec3(array[world, row], array[world, row + 1], array[world, row + 2])

    @wp.func
    def velocities(m: real, s: vec3, J: mat33, P: vec3, L: vec3):
        """M^-1 (P, L)."""
        about = J - (wp.dot(s, s) * wp.identity(n=3, dtype=real) - wp.outer(s, s)) / m
        scale = real(1.0) / wp.trace(about)
        w = scale * (wp.inverse(scale * about) * (L - wp.cross(s, P) / m))
        return (P - wp.cross(w, s)) / m, w

    @wp.func
    def turn_bar(q: quat, by_u: vec3, by_s: real):
        """Gradient by a turn from those by the vector and the scalar part of a quaternion."""
        u = vec3(q[0], q[1], q[2])
        return real(0.5) * (q[3] * by_u + wp.cross(u, by_u) - by_s * u)

    @wp.func
    def moved_on(
        m: real, s: vec3, J: mat33, q: quat, own: mat33, P: vec3, L: vec3, V: vec3, w: vec3, free_t: vec3, free_r: vec3
    ):
        """(V, w) with the momentum P, L along free axes, and as it was along held ones."""
        V1 = V
        w1 = w
        if wp.min(wp.min(free_t), wp.min(free_r)) > real(0.0):
            V1, w1 = velocities(m, s, J, P, L)
        else:
            had_p, had_l = momentum(m, s, J, V, w)
            dV, dw = change_of_twist(P - had_p, L - had_l, m, s, q, own, free_t, free_r)
            V1 += dV
            w1 += dw
        return V1, w1

    @wp.func
    def of_momentum_bars(
        m: real, s: vec3, J: mat33, q: quat, own: mat33, by_v: vec3, by_w: vec3, free_t: vec3, free_r: vec3
    ):
        """Gradients by the momentum in ``moved_on``, and by (V, w) themselves."""
        c_t = vec3()
        c_r = vec3()
        rest_v = vec3()
        rest_w = vec3()
        if wp.min(wp.min(free_t), wp.min(free_r)) > real(0.0):
            c_t, c_r = velocities(m, s, J, by_v, by_w)
        else:
            c_t, c_r = change_of_twist(by_v, by_w, m, s, q, own, free_t, free_r)
            had_p, had_l = momentum(m, s, J, c_t, c_r)
            rest_v = by_v - had_p
            rest_w = by_w - had_l
        return c_t, c_r, rest_v, rest_w

    @wp.func
    def by_turn(s: vec3, J: mat33, bt: vec3, br: vec3, at: vec3, ar: vec3):
        """Gradient of b.M a by the turn of M."""
        return wp.cross(s, wp.cross(bt, ar) + wp.cross(at, br)) + wp.cross(J * ar, br) + wp.cross(J * br, ar)

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
    def slowed_bars(L0: vec3, L1: vec3, before: vec3, w: vec3, had: real, has: real, c: vec3, by_v: vec3, by_w: vec3):
        """Gradients through a body's slowing down to the energy that it had, f = (had / has)^1/2 and w1 = f w.

        Its spin ``before`` has the momentum L0, w has L1; c is its centre of mass. By its turn then, by w, by its turn
        at the start and by the spin before.
        """
        f = wp.sqrt(had / has)
        lost = (f - real(1.0)) * w
        by_lost = by_w - wp.cross(c, by_v)
        spun = f * wp.dot(w, by_lost)
        by_turn_then = -wp.cross(c, wp.cross(by_v, lost)) - (spun / has) * wp.cross(L1, w)
        by_fast = by_w + (f - real(1.0)) * by_lost - (spun / has) * L1
        return by_turn_then, by_fast, (spun / had) * wp.cross(L0, before), (spun / had) * L0

    @wp.func
    def slowed_masses(
        q0: quat,
        q: quat,
        before: vec3,
        w: vec3,
        had: real,
        has: real,
        m: real,
        c: vec3,
        by_v: vec3,
        by_w: vec3,
        pack: int,
        lane: int,
        frame: int,
        share: wp.array3d(dtype=real),
    ):
        """Add the same by the compound that it is."""
        f = wp.sqrt(had / has)
        a = wp.quat_rotate_inv(q0, before)
        b = wp.quat_rotate_inv(q, w)
        spun = real(0.5) * f * wp.dot(w, by_w - wp.cross(wp.quat_rotate(q, c), by_v))
        by_c = (real(1.0) - f) * wp.quat_rotate_inv(q, wp.cross(by_v, w))
        by_own = (spun / had) * wp.outer(a, a) - (spun / has) * wp.outer(b, b)
        add_share(share, pack, lane, frame, m, c, by_c, by_own)

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
        body_node_count: int,
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
        impulse_in: wp.array3d(dtype=real),
        stiff_p_in: wp.array3d(dtype=real),
        # State out
        x_bar_out: wp.array2d(dtype=real),
        v_bar_out: wp.array2d(dtype=real),
        force_bar_out: wp.array2d(dtype=real),
        # Workspace out
        item_out: wp.array3d(dtype=real),
    ):
        """Gradients by place, turn and velocities of its frame that one carried node has, which has none of its own.

        Beside those by its place there is the lever, by which forces of rows and elements do work along p and v.
        """
        pack, item, lane = wp.tid()
        world = pack * lanes + lane
        node = carried_slot[item]
        frame = carried_frame[item]
        s = 3 * frame_dof[2 * frame + 1]
        r = wp.quat_rotate(quat_at(pose0_in, pack, lane, 7 * frame + 3), offset_of(carried_offset, item))
        tense = vec3()
        bound = vec3()
        if node < body_node_count:
            tense = vector_at(impulse_in, pack, lane, 3 * node)
            bound = vector_at(stiff_p_in, pack, lane, 3 * node)
        for i in range(node_point_start[node], node_point_start[node + 1]):
            row = point_row[node_point[i]]
            gradient = h * node_point_weight[i] * vector_at(point_gradient_in, pack, lane, 3 * node_point[i])
            tense += multiplier_in[pack, row, lane] * gradient
            bound += q_in[pack, row, lane] * gradient
        place = vector_at(node_bar_in, pack, lane, 3 * node)
        lever = wp.cross(tense, vector_at(p_in, pack, lane, s)) - wp.cross(bound, vector_at(v_in, pack, lane, s))
        put(item_out, pack, lane, 12 * item, place)
        put(item_out, pack, lane, 12 * item + 3, wp.cross(r, place + lever))
        put(item_out, pack, lane, 12 * item + 6, -bound)
        put(item_out, pack, lane, 12 * item + 9, wp.cross(bound, r))
        if world < x_bar_out.shape[0]:
            for c in range(3):
                x_bar_out[world, 3 * node + c] = real(0.0)
                v_bar_out[world, 3 * node + c] = real(0.0)
                if node >= body_node_count:
                    force_bar_out[world, 3 * node + c] = real(0.0)

    @wp.kernel(module=module, enable_backward=False)
    def frame_seed(
        h: real,
        lanes: int,
        splits: bool,
        # Model
        frame_spin: wp.array(dtype=wp.int32),
        frame_gyrates: wp.array(dtype=wp.int32),
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
        end_v_in: wp.array3d(dtype=real),
        # Workspace out
        seed_out: wp.array3d(dtype=real),
        y_out: wp.array3d(dtype=real),
        kept_out: wp.array3d(dtype=real),
        start_out: wp.array3d(dtype=real),
        moved_out: wp.array3d(dtype=real),
        bare_out: wp.array3d(dtype=real),
        share_out: wp.array3d(dtype=real),
    ):
        """Gradients by the velocities of one frame's dofs, twice, and by its place and turn at the start, but for A.

        ``bare`` are those by velocities of dofs that are prescribed too. Where joints make the velocities ``end_v_in``
        that it moves on with others than those that moved it, gradients by these are ``splits`` off to ``kept``.
        """
        pack, frame, lane = wp.tid()
        world = wp.min(pack * lanes + lane, pose_bar_in.shape[0] - 1)
        t = frame_dof[2 * frame]
        r = frame_dof[2 * frame + 1]
        k = wp.static(COMPOUND_ROWS) * frame
        by_x = of_world(pose_bar_in, world, 7 * frame)
        by_u = of_world(pose_bar_in, world, 7 * frame + 3)
        by_v = of_world(twist_bar_in, world, 6 * frame)
        by_w = of_world(twist_bar_in, world, 6 * frame + 3)
        V = vector_at(v_in, pack, lane, 3 * t)
        w = vector_at(v_in, pack, lane, 3 * r)
        q0 = quat_at(pose0_in, pack, lane, 7 * frame + 3)
        e = exponential(h * w)
        q = wp.normalize(e * q0)
        by_turn_then = turn_bar(q, by_u, pose_bar_in[world, 7 * frame + 6])
        m = compound_in[pack, k, lane]
        s = wp.quat_rotate(q0, vector_at(compound_in, pack, lane, k + 1))
        s1 = wp.quat_rotate(e, s)
        J = turned(q0, inertia_at(compound_in, pack, lane, k + 4))
        J1 = turned(e, J)
        P = vec3()
        Vm = vector_at(end_v_in, pack, lane, 3 * t)
        wm = vector_at(end_v_in, pack, lane, 3 * r)
        V1 = Vm
        w1 = wm
        free_t = vec3(dof_free[t, 0], dof_free[t, 1], dof_free[t, 2])
        free_r = vec3(dof_free[r, 0], dof_free[r, 1], dof_free[r, 2])
        spin = frame_spin[frame]
        way = h * V  # that momentum is carried along; a body that turns alone keeps it about its own origin
        way = wp.where(spin == wp.static(Spin.KEEP_SPIN), vec3(), way)
        is_top = spin == wp.static(Spin.FREE_TOP) and m > real(0.0)
        keeps = spin != wp.static(Spin.AS_SOLVED) and m > real(0.0) and not is_top
        inertia = inertia_at(compound_in, pack, lane, k + 4)
        centre = vec3()
        if is_top:
            centre, inertia = top_about_centre(m, vector_at(compound_in, pack, lane, k + 1), inertia)
            q, w1 = top_moved(q0, w, inertia, inertia_inverse(inertia), h)
            by_turn_then = turn_bar(q, by_u, pose_bar_in[world, 7 * frame + 6])
        if keeps:
            P, L = momentum(m, s, J, Vm, wm)
            L -= wp.cross(way, P)
            V1, w1 = moved_on(m, s1, J1, q, inertia, P, L, Vm, wm, free_t, free_r)
        fast_w = w1
        had = real(0.0)
        has = real(0.0)
        if keeps and frame_gyrates[frame] != 0:
            centre, inertia = top_about_centre(m, vector_at(compound_in, pack, lane, k + 1), inertia)
            had = wp.dot(wm, turned(q0, inertia) * wm)
            has = wp.dot(w1, turned(q, inertia) * w1)
        is_slowed = has > had and had > real(0.0)
        if is_slowed:
            w1 = wp.sqrt(had / has) * w1
        more_x, more_t, more_v, more_w = carried_bars(
            frame_item_start, frame_item, carried_slot, carried_offset, x_bar_in, v_bar_in, world, frame, q, w1
        )
        by_x += more_x
        by_turn_then += more_t
        by_v += more_v
        by_w += more_w
        by_way = by_x
        by_spin = vec3()
        by_start = vec3()
        by_had = vec3()
        if is_slowed:
            slowed_masses(q0, q, wm, fast_w, had, has, m, centre, by_v, by_w, pack, lane, frame, share_out)
            more_t, by_w, by_start, by_had = slowed_bars(
                turned(q0, inertia) * wm,
                turned(q, inertia) * fast_w,
                wm,
                fast_w,
                had,
                has,
                wp.quat_rotate(q, centre),
                by_v,
                by_w,
            )
            by_turn_then += more_t
            w1 = fast_w
        row = wp.static(MOVED_ROWS) * frame
        for c in range(wp.static(MOVED_ROWS)):
            moved_out[pack, row + c, lane] = real(0.0)
        if keeps:
            ct, cr, rest_v, rest_w = of_momentum_bars(m, s1, J1, q, inertia, by_v, by_w, free_t, free_r)
            by_turn_then -= by_turn(s1, J1, ct, cr, V1, w1)
            put(moved_out, pack, lane, row, ct)
            ct -= wp.cross(cr, way)
            put(moved_out, pack, lane, row + 3, ct)
            put(moved_out, pack, lane, row + 6, cr)
            put(moved_out, pack, lane, row + 9, V1)
            put(moved_out, pack, lane, row + 12, w1)
            put_quat(moved_out, pack, lane, row + 15, q)
            by_start += by_turn(s, J, ct, cr, Vm, wm)
            by_v, by_w = momentum(m, s, J, ct, cr)
            by_v += rest_v
            by_w += rest_w + by_had
            if spin != wp.static(Spin.KEEP_SPIN):
                by_way -= wp.cross(P, cr)
        if is_top:
            by_start, by_v, by_w = top_pull(q0, V, w, centre, inertia, h, by_x, by_turn_then, by_v, by_w)
            by_way = vec3()
        else:
            by_start += wp.quat_rotate_inv(e, by_turn_then)
            by_spin = h * jacobian_transposed(h * w, by_turn_then)
        put(bare_out, pack, lane, 6 * frame, by_v + h * by_way)
        put(bare_out, pack, lane, 6 * frame + 3, by_w + by_spin)
        for c in range(3):
            linear = h * by_way[c] * dof_free[t, c]
            angular = by_spin[c] * dof_free[r, c]
            if splits and not is_top:
                kept_out[pack, 3 * t + c, lane] = by_v[c] * dof_free[t, c]
                kept_out[pack, 3 * r + c, lane] = by_w[c] * dof_free[r, c]
            else:
                linear += by_v[c] * dof_free[t, c]
                angular += by_w[c] * dof_free[r, c]
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
        is_kinematic: wp.array(dtype=real),
        # Workspace in
        pose0_in: wp.array3d(dtype=real),
        twist0_in: wp.array3d(dtype=real),
        compound_in: wp.array3d(dtype=real),
        v_in: wp.array3d(dtype=real),
        p_in: wp.array3d(dtype=real),
        start_in: wp.array3d(dtype=real),
        corner_in: wp.array3d(dtype=real),
        item_in: wp.array3d(dtype=real),
        bare_in: wp.array3d(dtype=real),
        # State out
        pose_bar_out: wp.array2d(dtype=real),
        twist_bar_out: wp.array2d(dtype=real),
        force_bar_out: wp.array2d(dtype=real),
        velocity_bar_out: wp.array2d(dtype=real),
    ):
        """Gradients by pose, twist, external force and commanded velocity of one frame at the start of the step.

        The start pose of a kinematic body stands for where it is held, from which its velocity takes it on.
        """
        pack, frame, lane = wp.tid()
        world = pack * lanes + lane
        if world < pose_bar_out.shape[0]:
            k = wp.static(COMPOUND_ROWS) * frame
            pt = vector_at(p_in, pack, lane, 3 * frame_dof[2 * frame])
            pr = vector_at(p_in, pack, lane, 3 * frame_dof[2 * frame + 1])
            V = vector_at(v_in, pack, lane, 3 * frame_dof[2 * frame])
            w = vector_at(v_in, pack, lane, 3 * frame_dof[2 * frame + 1])
            V0 = vector_at(twist0_in, pack, lane, 6 * frame)
            w0 = vector_at(twist0_in, pack, lane, 6 * frame + 3)
            q = quat_at(pose0_in, pack, lane, 7 * frame + 3)
            s = wp.quat_rotate(q, vector_at(compound_in, pack, lane, k + 1))
            J = turned(q, inertia_at(compound_in, pack, lane, k + 4))
            damped = turned(q, inertia_at(compound_in, pack, lane, k + 14))
            lost = wp.quat_rotate(q, vector_at(compound_in, pack, lane, k + 11))
            place = vector_at(start_in, pack, lane, 6 * frame)
            turn = vector_at(start_in, pack, lane, 6 * frame + 3)
            linear = vector_at(bare_in, pack, lane, 6 * frame)
            angular = vector_at(bare_in, pack, lane, 6 * frame + 3)
            for i in range(corner_start[2 * frame], corner_start[2 * frame + 1]):
                place += vector_at(corner_in, pack, lane, 3 * corner[i])
            for i in range(corner_start[2 * frame + 1], corner_start[2 * frame + 2]):
                turn += vector_at(corner_in, pack, lane, 3 * corner[i])
            for i in range(frame_item_start[frame], frame_item_start[frame + 1]):
                place += vector_at(item_in, pack, lane, 12 * frame_item[i])
                turn += vector_at(item_in, pack, lane, 12 * frame_item[i] + 3)
                linear += vector_at(item_in, pack, lane, 12 * frame_item[i] + 6)
                angular += vector_at(item_in, pack, lane, 12 * frame_item[i] + 9)
            if 6 * frame < velocity_bar_out.shape[1]:
                for c in range(3):
                    velocity_bar_out[world, 6 * frame + c] = is_kinematic[frame] * linear[c]
                    velocity_bar_out[world, 6 * frame + 3 + c] = is_kinematic[frame] * angular[c]
            turn += by_turn(s, J, pt, pr, V0, w0) - by_turn(lost, damped, pt, pr, V, w)
            by_q = quat(turn[0], turn[1], turn[2], real(0.0)) * q * real(2.0)
            linear, angular = momentum(compound_in[pack, k, lane], s, J, pt, pr)
            for c in range(3):
                pose_bar_out[world, 7 * frame + c] = place[c]
                twist_bar_out[world, 6 * frame + c] = linear[c]
                twist_bar_out[world, 6 * frame + 3 + c] = angular[c]
                force_bar_out[world, 6 * frame + c] = h * pt[c]
                force_bar_out[world, 6 * frame + 3 + c] = h * pr[c]
            for c in range(4):
                pose_bar_out[world, 7 * frame + 3 + c] = by_q[c]

    @wp.kernel(module=module, enable_backward=False)
    def carried_impulses(
        h: real,
        # Model
        carried_slot: wp.array(dtype=wp.int32),
        # Workspace in
        internal_in: wp.array3d(dtype=real),
        external_in: wp.array3d(dtype=real),
        stiff_v_in: wp.array3d(dtype=real),
        # Workspace out
        impulse_out: wp.array3d(dtype=real),
    ):
        """h (external - internal force) - k K v of one carried node of a soft body."""
        pack, item, lane = wp.tid()
        row = 3 * carried_slot[item]
        force = vector_at(external_in, pack, lane, row) - vector_at(internal_in, pack, lane, row)
        put(impulse_out, pack, lane, row, h * force - vector_at(stiff_v_in, pack, lane, row))

    return SimpleNamespace(
        carried_motion=carried_motion,
        carried_impulses=carried_impulses,
        carried_gradients=carried_gradients,
        frame_seed=frame_seed,
        frame_gradients=frame_gradients,
    )
