"""Adjoint of how a free top moves on, and is extrapolated between stages. Theory: docs/theory/adjoint.md.

A free top has the angular momentum L = R J R' w about its centre of mass c, which the step keeps. From its velocities
(V, w) and its orientation q0 follow, with the classical Runge-Kutta method for q,

    x1 = x0 + h (V + w x c0) + c0 - c1,   w1 = R1 J^-1 R1' L,   V1 = V + w x c0 - w1 x c1,

where c0 and c1 are c in world axes at q0 and q. Nothing of a single body depends on its mass, with which J and L grow
alike; where one carries others, c and J depend on all masses.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.frames import momentum, parameter_adjoint


@single_worlds
def functions(variant: Variant) -> SimpleNamespace:
    """The motion of a free top and its gradients, for one scalar type."""
    real = variant.real
    one = single.functions(variant)
    vec3, mat33, quat = one.vec3, one.mat33, one.quat
    f = momentum.functions(variant)
    add_share = parameter_adjoint.functions(variant).add_share
    turn, turned, inertia_inverse, free_top = f.turn, f.turned, f.inertia_inverse, f.free_top

    @wp.func
    def moved(q0: quat, w: vec3, J: mat33, inverse: mat33, h: real):
        """Orientation and angular velocity of a free top after a time h."""
        L = turned(q0, J, w)
        q = free_top(q0, L, inverse, h)
        return q, turned(q, inverse, L)

    @wp.func
    def value(
        q0: quat,
        V: vec3,
        w: vec3,
        centre: vec3,
        J: mat33,
        inverse: mat33,
        h: real,
        by_x: vec3,
        by_q: quat,
        by_v: vec3,
        by_w: vec3,
    ):
        """What a free top comes to, less its place at the start, in weights of the results."""
        q, w1 = moved(q0, w, J, inverse, h)
        c0 = turn(q0, centre, real(1.0))
        c1 = turn(q, centre, real(1.0))
        centre_v = V + wp.cross(w, c0)
        total = wp.dot(by_x, h * centre_v + c0 - c1) + wp.dot(by_q, q)
        return total + wp.dot(by_v, centre_v - wp.cross(w1, c1)) + wp.dot(by_w, w1)

    @wp.func
    def about_centre(m: real, s: vec3, J: mat33):
        """Centre of mass, and inertia about it, of a compound in its own axes."""
        centre = s / m
        square = wp.dot(centre, centre) * wp.identity(n=3, dtype=real)
        return centre, J - m * (square - wp.outer(centre, centre))

    @wp.func
    def turn_of(q: quat, by_q: quat):
        """Gradient by a turn from that by a quaternion."""
        u = vec3(q[0], q[1], q[2])
        by_u = vec3(by_q[0], by_q[1], by_q[2])
        return real(0.5) * (q[3] * by_u + wp.cross(u, by_u) - by_q[3] * u)

    @wp.func
    def to_compound(
        share: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        frame: int,
        m: real,
        centre: vec3,
        by_centre: vec3,
        inverse: mat33,
        by_J: mat33,
        by_inverse: mat33,
    ):
        """Add gradients by centre, inertia and its inverse to the share of what a compound of mass m is made of."""
        total = by_J - wp.transpose(inverse) * by_inverse * wp.transpose(inverse)
        add_share(share, pack, lane, frame, m, centre, by_centre, real(0.5) * (total + wp.transpose(total)))

    @wp.func
    def pull(
        q0: quat,
        V: vec3,
        w: vec3,
        centre: vec3,
        J: mat33,
        h: real,
        by_x: vec3,
        by_turn: vec3,
        by_v: vec3,
        by_w: vec3,
        m: real,
        share: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        frame: int,
    ):
        """Gradients by the turn at the start and by (V, w), from those by place, turn and twist at the end.

        Those by what the compound of mass m is made of are added to its ``share``.
        """
        inverse = inertia_inverse(J)
        q, _ = moved(q0, w, J, inverse, h)
        by_q = quat(by_turn[0], by_turn[1], by_turn[2], real(0.0)) * q * real(2.0)
        g0, gV, gw, gc, gJ, gi, gh, gx, gq, gv, g1 = wp.grad(value)(
            q0, V, w, centre, J, inverse, h, by_x, by_q, by_v, by_w
        )
        to_compound(share, pack, lane, frame, m, centre, gc, inverse, gJ, gi)
        return turn_of(q0, g0), gV, gw

    @wp.func
    def drifted(q0: quat, w0: vec3, q1: quat, w1: vec3, J: mat33, inverse: mat33, factor: real, lapse: real):
        """Orientation and angular velocity that a free top is extrapolated to."""
        L0 = turned(q0, J, w0)
        L1 = turned(q1, J, w1)
        q = free_top(q1, L1, inverse, lapse)
        return q, turned(q, inverse, L0 + factor * (L1 - L0))

    @wp.func
    def extrapolated(
        q0: quat,
        V0: vec3,
        w0: vec3,
        q1: quat,
        V1: vec3,
        w1: vec3,
        centre: vec3,
        J: mat33,
        inverse: mat33,
        factor: real,
        lapse: real,
        by_x: vec3,
        by_q: quat,
        by_v: vec3,
        by_w: vec3,
    ):
        """What a free top is extrapolated to, but for its places, in weights of the results."""
        q, w = drifted(q0, w0, q1, w1, J, inverse, factor, lapse)
        s0 = turn(q0, centre, real(1.0))
        s1 = turn(q1, centre, real(1.0))
        s = turn(q, centre, real(1.0))
        V = V0 + wp.cross(w0, s0)
        V += factor * (V1 + wp.cross(w1, s1) - V) - wp.cross(w, s)
        total = wp.dot(by_x, s0 + factor * (s1 - s0) - s) + wp.dot(by_q, q)
        return total + wp.dot(by_v, V) + wp.dot(by_w, w)

    @wp.func
    def pull_extrapolated(
        q0: quat,
        V0: vec3,
        w0: vec3,
        q1: quat,
        V1: vec3,
        w1: vec3,
        centre: vec3,
        J: mat33,
        factor: real,
        lapse: real,
        by_x: vec3,
        by_turn: vec3,
        by_v: vec3,
        by_w: vec3,
        m: real,
        share: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        frame: int,
    ):
        """Gradients by turn and twist at both states that a free top is extrapolated from, beside those by places.

        Those by what the compound of mass m is made of are added to its ``share``.
        """
        inverse = inertia_inverse(J)
        q, _ = drifted(q0, w0, q1, w1, J, inverse, factor, lapse)
        by_q = quat(by_turn[0], by_turn[1], by_turn[2], real(0.0)) * q * real(2.0)
        g0, gV0, gw0, g1, gV1, gw1, gc, gJ, gi, gf, gl, gx, gq, gv, gw = wp.grad(extrapolated)(
            q0, V0, w0, q1, V1, w1, centre, J, inverse, factor, lapse, by_x, by_q, by_v, by_w
        )
        to_compound(share, pack, lane, frame, m, centre, gc, inverse, gJ, gi)
        return turn_of(q0, g0), gV0, gw0, turn_of(q1, g1), gV1, gw1

    @wp.kernel(module=variant.module("adjoint.frames"), enable_backward=True)
    def reach(
        # Samples in
        vector_in: wp.array(dtype=vec3),
        turn_in: wp.array(dtype=quat),
        matrix_in: wp.array(dtype=mat33),
        h: real,
        # Samples out
        value_out: wp.array(dtype=real),
    ):
        """Makes Warp differentiate ``value``; nobody launches it, as of ``elements.adjoint``."""
        sample = wp.tid()
        a = vector_in[sample]
        q = turn_in[sample]
        m = matrix_in[sample]
        value_out[sample] = value(q, a, a, a, m, m, h, a, q, a, a)

    @wp.kernel(module=variant.module("adjoint.extrapolated"), enable_backward=True)
    def reach_extrapolated(
        # Samples in
        vector_in: wp.array(dtype=vec3),
        turn_in: wp.array(dtype=quat),
        matrix_in: wp.array(dtype=mat33),
        h: real,
        # Samples out
        value_out: wp.array(dtype=real),
    ):
        """The same of ``extrapolated``."""
        sample = wp.tid()
        a = vector_in[sample]
        q = turn_in[sample]
        m = matrix_in[sample]
        value_out[sample] = extrapolated(q, a, a, q, a, a, a, m, m, h, h, a, q, a, a)

    return SimpleNamespace(
        moved=moved,
        about_centre=about_centre,
        pull=pull,
        drifted=drifted,
        pull_extrapolated=pull_extrapolated,
        reach=reach,
        reach_extrapolated=reach_extrapolated,
    )
