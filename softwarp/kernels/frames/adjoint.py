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
from softwarp.kernels.frames.gyration_adjoint import slowing
from softwarp.kernels.frames.inertia import COMPOUND_ROWS
from softwarp.kernels.frames.parameter_adjoint import MOVED_ROWS
from softwarp.kernels.frames.parameter_adjoint import functions as of_compounds
from softwarp.model.codes import Spin


@single_worlds
def functions(variant: Variant) -> SimpleNamespace:
    """Gradients by turns and by what frames carry, for one scalar type."""
    real = variant.real
    one = single.functions(variant)
    vec3, mat33, quat = one.vec3, one.mat33, one.quat

    @wp.func
    def turn_bar(q: quat, by_u: vec3, by_s: real):
        """Gradient by a turn from those by the vector and the scalar part of a quaternion."""
        u = vec3(q[0], q[1], q[2])
        return real(0.5) * (q[3] * by_u + wp.cross(u, by_u) - by_s * u)

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
    def of_world(array: wp.array2d(dtype=real), world: int, row: int):
        """Vector in three rows of a state array."""
        return vec3(array[world, row], array[world, row + 1], array[world, row + 2])

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
        frame_offset: wp.array2d(dtype=real),
        nodes: int,
        x_bar: wp.array2d(dtype=real),
        v_bar: wp.array2d(dtype=real),
        pose_bar: wp.array2d(dtype=real),
        twist_bar: wp.array2d(dtype=real),
        world: int,
        frame: int,
        q: quat,
        w: vec3,
    ):
        """Gradients by place, turn, velocity and spin of one frame, from those by the nodes and frames that it carries.

        Slots from ``nodes`` on are welded frames, each with a translation and a rotation.
        """
        by_x = vec3()
        by_t = vec3()
        by_v = vec3()
        by_w = vec3()
        for i in range(frame_item_start[frame], frame_item_start[frame + 1]):
            item = frame_item[i]
            slot = carried_slot[item]
            r = wp.quat_rotate(q, offset_of(carried_offset, item))
            x = vec3()
            v = vec3()
            if slot < nodes:
                x = of_world(x_bar, world, 3 * slot)
                v = of_world(v_bar, world, 3 * slot)
            else:
                welded = (slot - nodes) / 2
                x = of_world(pose_bar, world, 7 * welded)
                v = of_world(twist_bar, world, 6 * welded)
                turned_q = q * quat(
                    frame_offset[welded, 3], frame_offset[welded, 4], frame_offset[welded, 5], frame_offset[welded, 6]
                )
                by_u = of_world(pose_bar, world, 7 * welded + 3)
                by_t += turn_bar(turned_q, by_u, pose_bar[world, 7 * welded + 6])
                by_w += of_world(twist_bar, world, 6 * welded + 3)
            by_x += x
            by_t += wp.cross(r, x + wp.cross(v, w))
            by_v += v
            by_w += wp.cross(r, v)
        return by_x, by_t, by_v, by_w

    return SimpleNamespace(
        turn_bar=turn_bar,
        by_turn=by_turn,
        jacobian_transposed=jacobian_transposed,
        of_world=of_world,
        offset_of=offset_of,
        carried_bars=carried_bars,
    )


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type, on single worlds."""
    real = variant.real
    module = variant.module("adjoint.frames")
    one = single.functions(variant)
    vec3, mat33, quat, vector_at, quat_at = one.vec3, one.mat33, one.quat, one.vector_at, one.quat_at
    inertia_at, put, add_to, exponential = one.inertia_at, one.put, one.add_to, one.exponential
    compounds = of_compounds(variant)
    turned, momentum = compounds.turned, compounds.momentum
    put_moved, put_offset = compounds.put_moved, compounds.put_offset
    turns = functions(variant)
    turn_bar, by_turn, jacobian_transposed = turns.turn_bar, turns.by_turn, turns.jacobian_transposed
    of_world, offset_of, carried_bars = turns.of_world, turns.offset_of, turns.carried_bars
    slowed = slowing(variant).slowed
    of_end = of_momentum.functions(variant)
    change_of_twist, inertia_inverse = of_end.change_of_twist, of_end.inertia_inverse
    tops = top_adjoint.functions(variant)
    top_moved, top_about_centre, top_pull = tops.moved, tops.about_centre, tops.pull

    @wp.func
    def velocities(m: real, s: vec3, J: mat33, P: vec3, L: vec3):
        """M^-1 (P, L)."""
        about = J - (wp.dot(s, s) * wp.identity(n=3, dtype=real) - wp.outer(s, s)) / m
        scale = real(1.0) / wp.trace(about)
        w = scale * (wp.inverse(scale * about) * (L - wp.cross(s, P) / m))
        return (P - wp.cross(w, s)) / m, w

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
    def put_both(out: wp.array3d(dtype=real), pack: int, lane: int, t: int, r: int, linear: vec3, angular: vec3):
        """Write what both dofs of a frame have."""
        put(out, pack, lane, 3 * t, linear)
        put(out, pack, lane, 3 * r, angular)

    @wp.kernel(module=module, enable_backward=False)
    def carried_motion(
        nodes: int,
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
        if carried_slot[item] >= nodes:
            return
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
        nodes: int,
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
        offset_out: wp.array3d(dtype=real),
    ):
        """Gradients by place, turn and velocities of its frame that one carried node has, which has none of its own.

        Those by where it is in its frame are added to. Beside those by its place there is the lever, by which forces of
        rows and elements do work along p and v.
        """
        pack, item, lane = wp.tid()
        world = pack * lanes + lane
        node = carried_slot[item]
        if node >= nodes:
            return
        frame = carried_frame[item]
        s = 3 * frame_dof[2 * frame + 1]
        q = quat_at(pose0_in, pack, lane, 7 * frame + 3)
        r = wp.quat_rotate(q, offset_of(carried_offset, item))
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
        add_to(offset_out, pack, lane, 3 * item, wp.quat_rotate_inv(q, place + lever))
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
        nodes: int,
        # Model
        frame_master: wp.array(dtype=wp.int32),
        frame_offset: wp.array2d(dtype=real),
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
        offset_out: wp.array3d(dtype=real),
    ):
        """Gradients by the velocities of one frame's dofs, twice, and by its place and turn at the start, but for A.

        ``bare`` are those by velocities of dofs that are prescribed too. Where joints make the velocities ``end_v_in``
        that it moves on with others than those that moved it, gradients by these are ``splits`` off to ``kept``.
        A welded frame has none of its own.
        """
        pack, frame, lane = wp.tid()
        if frame_master[frame] != frame:
            return
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
        m = compound_in[pack, k, lane]
        s = wp.quat_rotate(q0, vector_at(compound_in, pack, lane, k + 1))
        s1 = wp.quat_rotate(e, s)
        J = turned(q0, inertia_at(compound_in, pack, lane, k + 4))
        J1 = turned(e, J)
        Vm = vector_at(end_v_in, pack, lane, 3 * t)
        wm = vector_at(end_v_in, pack, lane, 3 * r)
        V1 = Vm
        w1 = wm
        free_t = vec3(dof_free[t, 0], dof_free[t, 1], dof_free[t, 2])
        free_r = vec3(dof_free[r, 0], dof_free[r, 1], dof_free[r, 2])
        spin = frame_spin[frame]
        # the way of momentum; a body that turns alone keeps it about its own origin
        way = wp.where(spin == wp.static(Spin.KEEP_SPIN), vec3(), h * V)
        is_top = spin == wp.static(Spin.FREE_TOP) and m > real(0.0)
        P, L = momentum(m, s, J, Vm, wm)
        keeps = spin != wp.static(Spin.AS_SOLVED) and m > real(0.0) and not is_top
        inertia = inertia_at(compound_in, pack, lane, k + 4)
        centre = vec3()
        if is_top:
            centre, inertia = top_about_centre(m, vector_at(compound_in, pack, lane, k + 1), inertia)
            q, w1 = top_moved(q0, w, inertia, inertia_inverse(inertia), h)
        by_turn_then = turn_bar(q, by_u, pose_bar_in[world, 7 * frame + 6])
        if keeps:
            V1, w1 = moved_on(m, s1, J1, q, inertia, P, L - wp.cross(way, P), Vm, wm, free_t, free_r)
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
            frame_item_start,
            frame_item,
            carried_slot,
            carried_offset,
            frame_offset,
            nodes,
            x_bar_in,
            v_bar_in,
            pose_bar_in,
            twist_bar_in,
            world,
            frame,
            q,
            w1,
        )
        for i in range(frame_item_start[frame], frame_item_start[frame + 1]):
            item = frame_item[i]
            put_offset(offset_out, pack, lane, item, x_bar_in, v_bar_in, world, carried_slot[item], nodes, q, w1)
        by_x += more_x
        by_turn_then += more_t
        by_v += more_v
        by_w += more_w
        by_way = by_x
        by_spin = vec3()
        by_start = vec3()
        by_had = vec3()
        if is_slowed:
            more_t, by_w, by_start, by_had = slowed(
                q0, q, wm, fast_w, had, has, m, centre, inertia, by_v, by_w, pack, lane, frame, share_out
            )
            by_turn_then += more_t
            w1 = fast_w
        row = wp.static(MOVED_ROWS) * frame
        for c in range(wp.static(MOVED_ROWS)):
            moved_out[pack, row + c, lane] = real(0.0)
        if keeps:
            ct, cr, rest_v, rest_w = of_momentum_bars(m, s1, J1, q, inertia, by_v, by_w, free_t, free_r)
            by_turn_then -= by_turn(s1, J1, ct, cr, V1, w1)
            put_moved(moved_out, pack, lane, row, ct, ct - wp.cross(cr, way), cr, V1, w1, q)
            ct -= wp.cross(cr, way)
            by_start += by_turn(s, J, ct, cr, Vm, wm)
            by_v, by_w = momentum(m, s, J, ct, cr)
            by_v += rest_v
            by_w += rest_w + by_had
            if spin != wp.static(Spin.KEEP_SPIN):
                by_way -= wp.cross(P, cr)
        if is_top:
            by_start, by_v, by_w = top_pull(
                q0, V, w, centre, inertia, h, by_x, by_turn_then, by_v, by_w, m, share_out, pack, lane, frame
            )
            by_way = vec3()
        else:
            by_start += wp.quat_rotate_inv(e, by_turn_then)
            by_spin = h * jacobian_transposed(h * w, by_turn_then)
        put_both(bare_out, pack, lane, 2 * frame, 2 * frame + 1, by_v + h * by_way, by_w + by_spin)
        linear = wp.cw_mul(h * by_way, free_t)
        angular = wp.cw_mul(by_spin, free_r)
        if splits and not is_top:
            put_both(kept_out, pack, lane, t, r, wp.cw_mul(by_v, free_t), wp.cw_mul(by_w, free_r))
        else:
            linear += wp.cw_mul(by_v, free_t)
            angular += wp.cw_mul(by_w, free_r)
        put_both(seed_out, pack, lane, t, r, linear, angular)
        put_both(y_out, pack, lane, t, r, linear, angular)
        put_both(start_out, pack, lane, 2 * frame, 2 * frame + 1, by_x, by_start)

    @wp.kernel(module=module, enable_backward=False)
    def frame_gradients(
        h: real,
        lanes: int,
        # Model
        frame_master: wp.array(dtype=wp.int32),
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
        frame_p_in: wp.array3d(dtype=real),
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

        The start pose of a kinematic body stands for where it is held, from which its velocity takes it on. A welded
        frame is where its master is, and has gradients by what acts on it alone.
        """
        pack, frame, lane = wp.tid()
        world = pack * lanes + lane
        if world < pose_bar_out.shape[0] and frame_master[frame] != frame:
            for c in range(6):
                pose_bar_out[world, 7 * frame + c] = real(0.0)
                twist_bar_out[world, 6 * frame + c] = real(0.0)
                force_bar_out[world, 6 * frame + c] = h * frame_p_in[pack, 6 * frame + c, lane]
                if 6 * frame < velocity_bar_out.shape[1]:
                    velocity_bar_out[world, 6 * frame + c] = real(0.0)
            pose_bar_out[world, 7 * frame + 6] = real(0.0)
        elif world < pose_bar_out.shape[0]:
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
        """h (external - internal force) - k K v of one carried node."""
        pack, item, lane = wp.tid()
        row = 3 * carried_slot[item]
        if row < impulse_out.shape[1]:
            force = vector_at(external_in, pack, lane, row) - vector_at(internal_in, pack, lane, row)
            put(impulse_out, pack, lane, row, h * force - vector_at(stiff_v_in, pack, lane, row))

    return SimpleNamespace(
        carried_motion=carried_motion,
        carried_impulses=carried_impulses,
        carried_gradients=carried_gradients,
        frame_seed=frame_seed,
        frame_gradients=frame_gradients,
    )
