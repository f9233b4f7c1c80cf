"""Free turning of jointed bodies within a step. Theory: docs/theory/joint.md.

A step turns a body by exp(h w) with the unknown w, which joints constrain, while a body left to itself turns by
exp(h a) with a mean angular velocity a that differs from J^-1 L wherever the axis of w moves. The difference D of the
unknowns from the velocities that belong to momentum is found from the momentum and kept apart:

    M (v - D) = M v0 + h f + h H' multiplier.

So a body without joints would move exactly as a free one, and momentum changes by forces alone. Where joints turn a
body otherwise than a free one, its energy would change at a given momentum; it may shrink, but not grow.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.frames.inertia import COMPOUND_ROWS

LARGEST = 3.0  # rad; beyond half a turn in a step, a turn no longer tells its rotation vector


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels on single worlds."""
    real = variant.real
    module = variant.module("gyration")
    one = single.functions(variant)
    vec3, mat33, quat, vector_at, quat_at = one.vec3, one.mat33, one.quat, one.vector_at, one.quat_at
    inertia_at, add_to, exponential, logarithm = one.inertia_at, one.add_to, one.exponential, one.logarithm

    @wp.func
    def about_centre(J: mat33, m: real, c: vec3):
        """Inertia about the centre of mass c from that about the origin."""
        return J - m * (wp.dot(c, c) * wp.identity(n=3, dtype=real) - wp.outer(c, c))

    @wp.func
    def turn_about(axis: int, q: quat, momentum: vec3, rate: real):
        """Turning by rate times momentum about one principal axis: orientation, and momentum in the body's axes."""
        v = vec3()
        v[axis] = momentum[axis] * rate
        e = exponential(v)
        return q * e, wp.quat_rotate_inv(e, momentum)

    @wp.func
    def free_turn(J: mat33, w: vec3, h: real):
        """Rotation vector of a free top in its axes at the start, from its angular velocity there.

        A turn about the constant momentum as if all moments were the middle one, exact, and turns about the principal
        axes of the other two for the rest, in a symmetric order. Exact for two equal moments; symplectic always.
        """
        Q = mat33()
        moments = vec3()
        wp.eig3(J, Q, moments)
        if wp.determinant(Q) < real(0.0):
            Q = -Q
        least = real(1.0e-9) * wp.max(moments[0], wp.max(moments[1], moments[2]))
        moments = wp.max(moments, vec3(least, least, least))
        momentum = wp.cw_mul(moments, wp.transpose(Q) * w)
        middle = int(0)
        if (moments[1] - moments[0]) * (moments[1] - moments[2]) <= real(0.0):
            middle = 1
        elif (moments[2] - moments[0]) * (moments[2] - moments[1]) <= real(0.0):
            middle = 2
        i = (middle + 1) % 3
        j = (middle + 2) % 3
        base = h / moments[middle]
        first = real(0.5) * (h / moments[i] - base)
        q = quat(real(0.0), real(0.0), real(0.0), real(1.0))
        q, momentum = turn_about(i, q, momentum, first)
        q, momentum = turn_about(j, q, momentum, h / moments[j] - base)
        q, momentum = turn_about(i, q, momentum, first)
        return Q * logarithm(q * exponential(momentum * base))

    @wp.kernel(module=module, enable_backward=False)
    def add_gyration(
        # Model
        gyrating_frame: wp.array(dtype=wp.int32),
        frame_dof: wp.array(dtype=wp.int32),
        # Workspace in
        pose0_in: wp.array3d(dtype=real),
        twist0_in: wp.array3d(dtype=real),
        compound_in: wp.array3d(dtype=real),
        dof_v_in: wp.array3d(dtype=real),
        u_in: wp.array3d(dtype=real),
        h: real,
        stage: int,
        # Workspace out
        difference_out: wp.array3d(dtype=real),
        b_out: wp.array3d(dtype=real),
    ):
        """D of one master, and M D on the right-hand side.

        The momentum is that of the start (stage 0), or that of the present velocities: v in a Newton iteration (1), or
        v + u in a further pass of the linear solve (2), where b has M D already and receives the change.
        """
        pack, item, lane = wp.tid()
        frame = gyrating_frame[item]
        t = 3 * frame_dof[2 * frame]
        r = 3 * frame_dof[2 * frame + 1]
        k = wp.static(COMPOUND_ROWS) * frame
        m = compound_in[pack, k, lane]
        old_t = vector_at(difference_out, pack, lane, 6 * item)
        old_r = vector_at(difference_out, pack, lane, 6 * item + 3)
        w = vector_at(twist0_in, pack, lane, 6 * frame + 3)
        if stage > 0:
            w = vector_at(dof_v_in, pack, lane, r) - old_r
        if stage > 1:
            w += vector_at(u_in, pack, lane, r)
        else:
            old_t = vec3()
            old_r = vec3()
        q = quat_at(pose0_in, pack, lane, 7 * frame + 3)
        new_t = vec3()
        new_r = vec3()
        if m > real(0.0) and wp.length(w) * h < real(wp.static(LARGEST)):
            c = vector_at(compound_in, pack, lane, k + 1) / m
            J = about_centre(inertia_at(compound_in, pack, lane, k + 4), m, c)
            turned = wp.quat_rotate(q, free_turn(J, wp.quat_rotate_inv(q, w), h))
            c = wp.quat_rotate(q, c)
            new_t = wp.cross(w, c) + (c - wp.quat_rotate(exponential(turned), c)) / h
            new_r = turned / h - w
        for i in range(3):
            difference_out[pack, 6 * item + i, lane] = new_t[i]
            difference_out[pack, 6 * item + 3 + i, lane] = new_r[i]
        dt = new_t - old_t
        dr = new_r - old_r
        s = wp.quat_rotate(q, vector_at(compound_in, pack, lane, k + 11))
        J = inertia_at(compound_in, pack, lane, k + 14)
        spin = wp.quat_rotate(q, J * wp.quat_rotate_inv(q, dr))
        add_to(b_out, pack, lane, t, dt * compound_in[pack, k + 10, lane] + wp.cross(dr, s))
        add_to(b_out, pack, lane, r, wp.cross(s, dt) + spin)

    @wp.kernel(module=module, enable_backward=False)
    def spread_difference(
        # Model
        gyrating_frame: wp.array(dtype=wp.int32),
        # Workspace in
        difference_in: wp.array3d(dtype=real),
        # Workspace out
        twist_out: wp.array3d(dtype=real),
    ):
        """D of one master among the rows of all frames."""
        pack, item, lane = wp.tid()
        for c in range(6):
            twist_out[pack, 6 * gyrating_frame[item] + c, lane] = difference_in[pack, 6 * item + c, lane]

    @wp.kernel(module=module, enable_backward=False)
    def take_gyration(
        # Model
        gyrating_frame: wp.array(dtype=wp.int32),
        frame_dof: wp.array(dtype=wp.int32),
        # Workspace in
        difference_in: wp.array3d(dtype=real),
        # Workspace out
        dof_v_out: wp.array3d(dtype=real),
    ):
        """Velocities that belong to the momentum of one master, v - D."""
        pack, item, lane = wp.tid()
        frame = gyrating_frame[item]
        add_to(dof_v_out, pack, lane, 3 * frame_dof[2 * frame], -vector_at(difference_in, pack, lane, 6 * item))
        add_to(dof_v_out, pack, lane, 3 * frame_dof[2 * frame + 1], -vector_at(difference_in, pack, lane, 6 * item + 3))

    @wp.func
    def turning_energy(q: quat, J: mat33, w: vec3):
        """w . R J R' w, twice the energy of turning."""
        v = wp.quat_rotate_inv(q, w)
        return wp.dot(v, J * v)

    @wp.kernel(module=module, enable_backward=False)
    def keep_energy(
        # Model
        gyrating_frame: wp.array(dtype=wp.int32),
        frame_dof: wp.array(dtype=wp.int32),
        # Workspace in
        compound_in: wp.array3d(dtype=real),
        pose0_in: wp.array3d(dtype=real),
        pose_in: wp.array3d(dtype=real),
        dof_v_in: wp.array3d(dtype=real),
        # Workspace out
        twist_out: wp.array3d(dtype=real),
    ):
        """Slow down one master that would turn about its centre of mass with more energy than before it moved on."""
        pack, item, lane = wp.tid()
        frame = gyrating_frame[item]
        k = wp.static(COMPOUND_ROWS) * frame
        m = compound_in[pack, k, lane]
        if m > real(0.0):
            c = vector_at(compound_in, pack, lane, k + 1) / m
            J = about_centre(inertia_at(compound_in, pack, lane, k + 4), m, c)
            w = vector_at(twist_out, pack, lane, 6 * frame + 3)
            before = vector_at(dof_v_in, pack, lane, 3 * frame_dof[2 * frame + 1])
            q = quat_at(pose_in, pack, lane, 7 * frame + 3)
            had = turning_energy(quat_at(pose0_in, pack, lane, 7 * frame + 3), J, before)
            has = turning_energy(q, J, w)
            if has > had:
                less = w * (wp.sqrt(wp.max(had, real(0.0)) / has) - real(1.0))
                add_to(twist_out, pack, lane, 6 * frame, -wp.cross(less, wp.quat_rotate(q, c)))
                add_to(twist_out, pack, lane, 6 * frame + 3, less)

    return SimpleNamespace(
        add_gyration=add_gyration,
        spread_difference=spread_difference,
        take_gyration=take_gyration,
        keep_energy=keep_energy,
    )
