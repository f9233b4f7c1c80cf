"""End of a step for frames: moving on with momentum, checks, what is written. Theory: docs/theory/frames.md.

A step changes the momentum P = m V + w x s and L = s x V + J w of a master's compound, then moves the master by h V
and turns it by exp(h w). Its twist at the new pose follows from the momentum that it has: P is kept, and L about a
fixed point, except along axes that are held. A body that nothing elastic touches is moved as a free top instead: its
centre of mass by h P / m, its orientation by the classical Runge-Kutta method at constant angular momentum.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.frames.inertia import COMPOUND_ROWS
from softwarp.model.codes import Excess, Spin


@single_worlds
def functions(variant: Variant) -> SimpleNamespace:
    """How frames turn and take up momentum, which the adjoint of a step needs too."""
    real = variant.real
    one = single.functions(variant)
    vec3, mat33, quat = one.vec3, one.mat33, one.quat
    mat66 = wp.types.matrix((6, 6), real)
    vec6 = wp.types.vector(6, real)

    @wp.func
    def turn(q: quat, v: vec3, sign: real):
        """R(q) v, or R(q)' v with sign -1; keeps |v| although |q| is 1 to rounding only, whose mean is not."""
        u = vec3(q[0], q[1], q[2])
        c = wp.cross(u, v) * (real(2.0) / wp.dot(q, q))
        return v + c * (sign * q[3]) + wp.cross(u, c)

    @wp.func
    def turned(q: quat, m: mat33, v: vec3):
        """R M R' v."""
        return turn(q, m * turn(q, v, -real(1.0)), real(1.0))

    @wp.func
    def inertia_inverse(J: mat33):
        """J^-1; scaled by a power of two, since the determinant of a small body's inertia underflows in float32."""
        scale = real(1.0)
        for _ in range(5):
            if wp.trace(J) * scale < real(1.0e-6):
                scale *= real(1048576.0)
        return wp.inverse(J * scale) * scale

    @wp.func
    def spin_rate(q: quat, momentum: vec3, inverse: mat33):
        """dq/dt of a free top, 1/2 w q."""
        w = turned(q, inverse, momentum)
        return quat(w[0], w[1], w[2], real(0.0)) * q * real(0.5)

    @wp.func
    def free_top(q0: quat, momentum: vec3, inverse: mat33, h: real):
        """Orientation after a time h of free turning with an angular momentum about the centre of mass."""
        k1 = spin_rate(q0, momentum, inverse)
        k2 = spin_rate(q0 + k1 * (real(0.5) * h), momentum, inverse)
        k3 = spin_rate(q0 + k2 * (real(0.5) * h), momentum, inverse)
        k4 = spin_rate(q0 + k3 * h, momentum, inverse)
        return wp.normalize(q0 + (k1 + k2 * real(2.0) + k3 * real(2.0) + k4) * (h / real(6.0)))

    @wp.func
    def change_of_twist(P: vec3, L: vec3, m: real, s: vec3, q: quat, J: mat33, free_t: vec3, free_r: vec3):
        """(V, w) that adds the momentum P, L along free axes, and nothing along held ones."""
        A = mat66()
        x = vec6()
        for i in range(3):
            A[i, i] = m
            axis = vec3()
            axis[i] = real(1.0)
            spin = turned(q, J, axis)
            moment = wp.cross(s, axis)  # L = s x V + J w, and P = m V - s x w
            for j in range(3):
                A[3 + j, i] = moment[j]
                A[i, 3 + j] = moment[j]
                A[3 + j, 3 + i] = spin[j]
            x[i] = P[i]
            x[3 + i] = L[i]
        for i in range(6):
            is_free = free_t[i % 3]
            if i >= 3:
                is_free = free_r[i % 3]
            if is_free == real(0.0):
                for j in range(6):
                    A[i, j] = real(0.0)
                    A[j, i] = real(0.0)
                A[i, i] = real(1.0)
                x[i] = real(0.0)
        for k in range(6):  # Gaussian elimination; the matrix is positive definite
            for i in range(k + 1, 6):
                f = A[i, k] / A[k, k]
                for j in range(k + 1, 6):
                    A[i, j] = A[i, j] - f * A[k, j]
                x[i] = x[i] - f * x[k]
        for k in range(6):
            i = 5 - k
            for j in range(i + 1, 6):
                x[i] = x[i] - A[i, j] * x[j]
            x[i] = x[i] / A[i, i]
        return vec3(x[0], x[1], x[2]), vec3(x[3], x[4], x[5])

    return SimpleNamespace(
        turn=turn,
        turned=turned,
        inertia_inverse=inertia_inverse,
        free_top=free_top,
        change_of_twist=change_of_twist,
    )


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels on single worlds."""
    real = variant.real
    one = single.functions(variant)
    vec3, quat, vector_at, quat_at = one.vec3, one.quat, one.vector_at, one.quat_at
    inertia_at, put, put_quat = one.inertia_at, one.put, one.put_quat
    f = functions(variant)
    turn, turned, inertia_inverse, free_top = f.turn, f.turned, f.inertia_inverse, f.free_top
    change_of_twist = f.change_of_twist
    module = variant.module("frame_state")

    @wp.kernel(module=module, enable_backward=False)
    def move_on(
        # Model
        frame_spin: wp.array(dtype=wp.int32),
        frame_dof: wp.array(dtype=wp.int32),
        dof_free: wp.array2d(dtype=real),
        # Workspace in
        pose0_in: wp.array3d(dtype=real),
        dof_v_in: wp.array3d(dtype=real),
        compound_in: wp.array3d(dtype=real),
        h: real,
        # Workspace out
        pose_out: wp.array3d(dtype=real),
        twist_out: wp.array3d(dtype=real),
    ):
        """Twist of one master at the end of the step; pose of a free top.

        Twists are found by their change, since products such as J J^-1 are 1 to rounding only, whose mean is not.
        """
        pack, frame, lane = wp.tid()
        t = frame_dof[2 * frame]
        r = frame_dof[2 * frame + 1]
        V = vector_at(dof_v_in, pack, lane, 3 * t)
        w = vector_at(dof_v_in, pack, lane, 3 * r)
        k = wp.static(COMPOUND_ROWS) * frame
        m = compound_in[pack, k, lane]
        mode = frame_spin[frame]
        if mode != wp.static(Spin.AS_SOLVED) and m > real(0.0):
            q0 = quat_at(pose0_in, pack, lane, 7 * frame + 3)
            q = quat_at(pose_out, pack, lane, 7 * frame + 3)
            s_local = vector_at(compound_in, pack, lane, k + 1)
            J = inertia_at(compound_in, pack, lane, k + 4)
            s = turn(q0, s_local, real(1.0))
            P = m * V + wp.cross(w, s)
            L = wp.cross(s, V) + turned(q0, J, w)
            if mode == wp.static(Spin.KEEP_SPIN):
                w += turned(q, inertia_inverse(J), L - turned(q, J, w))
            elif mode == wp.static(Spin.KEEP_MOMENTUM):
                way = vector_at(pose_out, pack, lane, 7 * frame) - vector_at(pose0_in, pack, lane, 7 * frame)
                free_t = vec3(dof_free[t, 0], dof_free[t, 1], dof_free[t, 2])
                free_r = vec3(dof_free[r, 0], dof_free[r, 1], dof_free[r, 2])
                L -= wp.cross(way, P)
                s = turn(q, s_local, real(1.0))
                P -= m * V + wp.cross(w, s)
                L -= wp.cross(s, V) + turned(q, J, w)
                dV, dw = change_of_twist(P, L, m, s, q, J, free_t, free_r)
                V += dV
                w += dw
            else:
                centre = s_local / m
                square = wp.dot(centre, centre) * wp.identity(n=3, dtype=real)
                J -= m * (square - wp.outer(centre, centre))  # about the centre of mass
                x = vector_at(pose0_in, pack, lane, 7 * frame) + s / m + P * (h / m)
                L -= wp.cross(s, P) / m
                inverse = inertia_inverse(J)
                q = free_top(q0, L, inverse, h)
                s = turn(q, centre, real(1.0))
                w += turned(q, inverse, L - turned(q, J, w))
                V += (P - m * (V + wp.cross(w, s))) / m
                put(pose_out, pack, lane, 7 * frame, x - s)
                put_quat(pose_out, pack, lane, 7 * frame + 3, q)
        put(twist_out, pack, lane, 6 * frame, V)
        put(twist_out, pack, lane, 6 * frame + 3, w)

    @wp.func
    def of_world(array: wp.array2d(dtype=real), world: int, row: int):
        """Vector in three rows of a state array."""
        return vec3(array[world, row], array[world, row + 1], array[world, row + 2])

    @wp.kernel(module=module, enable_backward=False)
    def extrapolate_tops(
        factor: real,
        lapse: real,
        lanes: int,
        # Model
        frame_spin: wp.array(dtype=wp.int32),
        # State
        pose0_in: wp.array2d(dtype=real),
        twist0_in: wp.array2d(dtype=real),
        # Workspace in
        rough_in: wp.array3d(dtype=wp.int32),
        compound_in: wp.array3d(dtype=real),
        # State out
        pose_out: wp.array2d(dtype=real),
        twist_out: wp.array2d(dtype=real),
    ):
        """Move a free top on from a stage: its momenta in a line from those at the start, ``factor`` of the change.

        Its centre of mass goes on in a line too, and it turns freely for the time ``lapse`` [s], which is exact
        without forces. Rough worlds stay where they are.
        """
        pack, frame, lane = wp.tid()
        world = pack * lanes + lane
        k = wp.static(COMPOUND_ROWS) * frame
        m = compound_in[pack, k, lane]
        is_smooth = world < pose_out.shape[0] and rough_in[pack, 0, lane] == 0
        if is_smooth and frame_spin[frame] == wp.static(Spin.FREE_TOP) and m > real(0.0):
            row = 7 * frame
            t = 6 * frame
            x0, x1 = of_world(pose0_in, world, row), of_world(pose_out, world, row)
            V0, V1 = of_world(twist0_in, world, t), of_world(twist_out, world, t)
            w0, w1 = of_world(twist0_in, world, t + 3), of_world(twist_out, world, t + 3)
            q0 = quat()
            q1 = quat()
            for c in range(4):
                q0[c] = pose0_in[world, row + 3 + c]
                q1[c] = pose_out[world, row + 3 + c]
            centre = vector_at(compound_in, pack, lane, k + 1) / m
            J = inertia_at(compound_in, pack, lane, k + 4)
            J -= m * (wp.dot(centre, centre) * wp.identity(n=3, dtype=real) - wp.outer(centre, centre))
            inverse = inertia_inverse(J)
            s0 = turn(q0, centre, real(1.0))
            s1 = turn(q1, centre, real(1.0))
            x = x0 + s0 + factor * (x1 + s1 - x0 - s0)
            V0 += wp.cross(w0, s0)
            V = V0 + factor * (V1 + wp.cross(w1, s1) - V0)
            L0 = turned(q0, J, w0)
            L1 = turned(q1, J, w1)
            L = L0 + factor * (L1 - L0)
            q = free_top(q1, L1, inverse, lapse)
            s = turn(q, centre, real(1.0))
            w = turned(q, inverse, L)
            w += turned(q, inverse, L - turned(q, J, w))
            x -= s
            V -= wp.cross(w, s)
            for c in range(3):
                pose_out[world, row + c] = x[c]
                twist_out[world, t + c] = V[c]
                twist_out[world, t + 3 + c] = w[c]
            for c in range(4):
                pose_out[world, row + 3 + c] = q[c]

    @wp.kernel(module=module, enable_backward=False)
    def check_frames(
        # Model
        frame_size: wp.array(dtype=real),
        # Workspace in
        pose0_in: wp.array3d(dtype=real),
        pose_in: wp.array3d(dtype=real),
        twist_in: wp.array3d(dtype=real),
        commanded_in: wp.array3d(dtype=real),
        reach: real,
        resolved: real,
        # Workspace out
        flag_out: wp.array3d(dtype=wp.int32),
    ):
        """Raise flag 0 where a frame is not finite, flag 1 where it went too far: in one step, or from the origin.

        It may go ``reach`` [m] in a step, and as far as commands carry kinematic bodies; none of its coordinates may
        exceed ``resolved`` sizes of its part.
        """
        pack, frame, lane = wp.tid()
        good = bool(True)
        far = int(wp.static(int(Excess.NOTHING)))
        limit = resolved * frame_size[frame]
        for c in range(7):
            value = pose_in[pack, 7 * frame + c, lane]
            good = good and wp.isfinite(value)
            if c < 3:
                if wp.abs(value - pose0_in[pack, 7 * frame + c, lane]) > reach + commanded_in[pack, 0, lane]:
                    far = wp.static(int(Excess.WAY))
                elif wp.abs(value) > limit:
                    far = wp.max(far, wp.static(int(Excess.PLACE)))
        for c in range(6):
            good = good and wp.isfinite(twist_in[pack, 6 * frame + c, lane])
        if not good:
            flag_out[pack, 0, lane] = 1
        elif far > 0:
            wp.atomic_max(flag_out, pack, 1, lane, far)  # rare, so without a cost

    @wp.kernel(module=module, enable_backward=False)
    def commit_state(
        lanes: int,
        # Workspace in
        flag_in: wp.array3d(dtype=wp.int32),
        value_in: wp.array3d(dtype=real),
        # State out
        value_out: wp.array2d(dtype=real),
        good_out: wp.array2d(dtype=real),
    ):
        """Write one row of a good world; a failed one keeps what it had, or gets back its last good value.

        On a CPU a thread takes all rows, for finding out its index takes longer than a row; see ``Variant.parts``.
        """
        pack, part, lane = wp.tid()
        world = pack * lanes + lane
        if world < value_out.shape[0]:
            is_good = flag_in[pack, 0, lane] + flag_in[pack, 1, lane] == 0
            last = value_out.shape[1]
            if wp.static(variant.world_fastest):
                last = part + 1
            for row in range(part, last):
                if is_good:
                    value = value_in[pack, row, lane]
                    value_out[world, row] = value
                    good_out[world, row] = value
                elif not wp.isfinite(value_out[world, row]):
                    value_out[world, row] = good_out[world, row]

    @wp.kernel(module=module, enable_backward=False)
    def commit_carried(
        # Model
        node_count: int,
        carried_slot: wp.array(dtype=wp.int32),
        carried_frame: wp.array(dtype=wp.int32),
        lanes: int,
        # Workspace in
        flag_in: wp.array3d(dtype=wp.int32),
        twist_in: wp.array3d(dtype=real),
        lever_in: wp.array3d(dtype=real),
        node_x_in: wp.array3d(dtype=real),
        # State out
        node_x_out: wp.array2d(dtype=real),
        node_v_out: wp.array2d(dtype=real),
        good_x_out: wp.array2d(dtype=real),
        good_v_out: wp.array2d(dtype=real),
    ):
        """Position and velocity V + w x r of one carried node in a good world."""
        pack, item, lane = wp.tid()
        world = pack * lanes + lane
        slot = carried_slot[item]
        if slot < node_count and world < node_v_out.shape[0]:
            if flag_in[pack, 0, lane] + flag_in[pack, 1, lane] == 0:
                row = 6 * carried_frame[item]
                w = vector_at(twist_in, pack, lane, row + 3)
                v = vector_at(twist_in, pack, lane, row) + wp.cross(w, vector_at(lever_in, pack, lane, 3 * item))
                for c in range(3):
                    k = 3 * slot + c
                    node_x_out[world, k] = node_x_in[pack, k, lane]
                    good_x_out[world, k] = node_x_in[pack, k, lane]
                    node_v_out[world, k] = v[c]
                    good_v_out[world, k] = v[c]

    return SimpleNamespace(
        move_on=move_on,
        extrapolate_tops=extrapolate_tops,
        check_frames=check_frames,
        commit_state=commit_state,
        commit_carried=commit_carried,
    )
