"""Rotations by components, so that SIMD lanes can take the place of scalars. Theory: docs/theory/frames.md.

Quaternions are (x, y, z, w) and unit; a rotation vector v stands for the turn by |v| about v.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant


def functions(variant: Variant) -> SimpleNamespace:
    """Rotation functions on the elements of one variant."""
    S = variant.S
    real = variant.real
    mul, div, sqrt = variant.mul, variant.div, variant.sqrt
    sin, cos = variant.sin, variant.cos

    @wp.func
    def cross(a0: S, a1: S, a2: S, b0: S, b1: S, b2: S):
        """a x b."""
        return mul(a1, b2) - mul(a2, b1), mul(a2, b0) - mul(a0, b2), mul(a0, b1) - mul(a1, b0)

    @wp.func
    def dot(a0: S, a1: S, a2: S, b0: S, b1: S, b2: S):
        """a . b."""
        return mul(a0, b0) + mul(a1, b1) + mul(a2, b2)

    @wp.func
    def turn(q0: S, q1: S, q2: S, q3: S, v0: S, v1: S, v2: S):
        """R(q) v = v + 2 w (u x v) + 2 u x (u x v), u the vector part."""
        t0, t1, t2 = cross(q0, q1, q2, v0, v1, v2)
        t0 += t0
        t1 += t1
        t2 += t2
        c0, c1, c2 = cross(q0, q1, q2, t0, t1, t2)
        return v0 + mul(q3, t0) + c0, v1 + mul(q3, t1) + c1, v2 + mul(q3, t2) + c2

    @wp.func
    def product(a0: S, a1: S, a2: S, a3: S, b0: S, b1: S, b2: S, b3: S):
        """Quaternion of the turn b followed by the turn a."""
        c0, c1, c2 = cross(a0, a1, a2, b0, b1, b2)
        return (
            mul(a3, b0) + mul(b3, a0) + c0,
            mul(a3, b1) + mul(b3, a1) + c1,
            mul(a3, b2) + mul(b3, a2) + c2,
            mul(a3, b3) - dot(a0, a1, a2, b0, b1, b2),
        )

    @wp.func
    def exponential(v0: S, v1: S, v2: S):
        """Quaternion of a rotation vector; sin(a/2)/a by its series where the angle is small."""
        square = dot(v0, v1, v2, v0, v1, v2)
        half = sqrt(square) * real(0.5)
        tiny = S(real(1.0e-6))
        guarded = wp.max(half, tiny)
        scale = div(sin(guarded), guarded) * real(0.5)  # 1 to rounding below the guard
        return mul(v0, scale), mul(v1, scale), mul(v2, scale), cos(half)

    @wp.func
    def normalized(q0: S, q1: S, q2: S, q3: S):
        """q / |q|."""
        scale = div(S(real(1.0)), sqrt(mul(q0, q0) + mul(q1, q1) + mul(q2, q2) + mul(q3, q3)))
        return mul(q0, scale), mul(q1, scale), mul(q2, scale), mul(q3, scale)

    @wp.func
    def turned_inertia(q0: S, q1: S, q2: S, q3: S, ixx: S, iyy: S, izz: S, ixy: S, ixz: S, iyz: S, v0: S, v1: S, v2: S):
        """R I R' v."""
        b0, b1, b2 = turn(-q0, -q1, -q2, q3, v0, v1, v2)
        m0 = mul(ixx, b0) + mul(ixy, b1) + mul(ixz, b2)
        m1 = mul(ixy, b0) + mul(iyy, b1) + mul(iyz, b2)
        m2 = mul(ixz, b0) + mul(iyz, b1) + mul(izz, b2)
        return turn(q0, q1, q2, q3, m0, m1, m2)

    return SimpleNamespace(
        cross=cross,
        dot=dot,
        turn=turn,
        product=product,
        exponential=exponential,
        normalized=normalized,
        turned_inertia=turned_inertia,
    )
