"""Rotations and the logarithm of rigid motions on the elements of a variant. Theory: docs/theory/rod.md, frames.md.

Quaternions are (x, y, z, w) and unit; a rotation vector v stands for the turn by |v| about v. A rigid motion h = (R, d)
with R = exp [phi]x has the logarithm (u, phi), with u = A d, A = 1 - [phi]x / 2 + c [phi]x^2. Everything is written for
elementwise arithmetic, smooth and accurate at phi = 0 without a branch.
"""

from functools import cache
from math import pi
from types import SimpleNamespace
from typing import Any

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.algebra.vectors import algebra


def _zeta_minus_one(s: int) -> float:
    """Riemann zeta(s) - 1 for s >= 2: the first terms and the Euler-Maclaurin formula for the rest."""
    n = 200
    head = sum(k**-s for k in range(n - 1, 1, -1))
    tail = n / (s - 1) + 1 / 2 + s / (12 * n) - s * (s + 1) * (s + 2) / (720 * n**3)
    return head + tail * n**-s


def _series(count: int) -> tuple[float, ...]:
    """Coefficients 2 (zeta(2k) - 1) / (2 pi)^(2k), k = 1, 2, ..., of c(y) - 2 / (4 pi^2 - y), y = |phi|^2."""
    return tuple(2.0 * _zeta_minus_one(2 * k) / (2.0 * pi) ** (2 * k) for k in range(1, count + 1))


def logarithm_series(real: Any) -> tuple[tuple[float, ...], float]:
    """Coefficients of c(y) - 2 / (pole - y), good to half a rounding error up to |phi| = pi, and the pole."""
    return _series(14 if real is wp.float64 else 7), 4.0 * pi * pi


@cache
def rotations(variant: Variant) -> SimpleNamespace:
    """Quaternions, turns, and the logarithm of rigid motions for one variant."""
    S = variant.S
    real = variant.real
    mul, fma, div, sqrt, sin, cos = variant.mul, variant.fma, variant.div, variant.sqrt, variant.sin, variant.cos
    a = algebra(variant)
    Vector, Symmetric, vector, rows = a.Vector, a.Symmetric, a.vector, a.rows
    read_vector, write_vector = a.read_vector, a.write_vector
    add, subtract, scaled, dot, cross, apply = a.add, a.subtract, a.scaled, a.dot, a.cross, a.apply
    is_double = real is wp.float64
    arc_terms = 12 if is_double else 5  # of atan(t)/t, t^2 < 0.04: below half a rounding error
    terms = logarithm_series(real)[0]
    series_terms, series = len(terms), wp.types.vector(len(terms), real)(*reversed(terms))

    @wp.struct
    class Quaternion:
        u: Vector  # x, y, z
        w: S

    @wp.struct
    class Motion:
        """Logarithm of a relative rigid motion with what its derivative needs."""

        u: Vector  # m
        phi: Vector  # rad
        angle2: S  # |phi|^2
        c: S  # (1 - |phi|/2 cot(|phi|/2)) / |phi|^2
        dc: S  # derivative of c with respect to |phi|^2
        ddc: S  # second derivative of c with respect to |phi|^2

    @wp.func
    def quaternion(u: Vector, w: S):
        q = Quaternion()
        q.u = u
        q.w = w
        return q

    @wp.func
    def read_quaternion(a: wp.array2d(dtype=S), w: int, row: int):
        return quaternion(read_vector(a, w, row), a[w, row + 3])

    @wp.func
    def write_quaternion(a: wp.array2d(dtype=S), w: int, row: int, q: Quaternion):
        write_vector(a, w, row, q.u)
        a[w, row + 3] = q.w

    @wp.func
    def conjugate(q: Quaternion):
        return quaternion(vector(-q.u.x, -q.u.y, -q.u.z), q.w)

    @wp.func
    def turn(q: Quaternion, v: Vector):
        """R(q) v = v + 2 w (u x v) + 2 u x (u x v), u the vector part."""
        t = cross(q.u, v)
        t = add(t, t)
        return add(add(v, scaled(t, q.w)), cross(q.u, t))

    @wp.func
    def after(p: Quaternion, q: Quaternion):
        """The turn q followed by the turn p."""
        u = add(add(scaled(q.u, p.w), scaled(p.u, q.w)), cross(p.u, q.u))
        return quaternion(u, mul(p.w, q.w) - dot(p.u, q.u))

    @wp.func
    def exponential(v: Vector):
        """Quaternion of a rotation vector; sin(a/2)/a by its series where the angle is small."""
        half = sqrt(dot(v, v)) * real(0.5)
        guarded = wp.max(half, S(real(1.0e-6)))
        scale = div(sin(guarded), guarded) * real(0.5)  # 1 to rounding below the guard
        return quaternion(scaled(v, scale), cos(half))

    @wp.func
    def normalized(q: Quaternion):
        """q / |q|."""
        scale = div(S(real(1.0)), sqrt(fma(q.w, q.w, dot(q.u, q.u))))
        return quaternion(scaled(q.u, scale), mul(q.w, scale))

    @wp.func
    def turned_inertia(q: Quaternion, J: Symmetric, v: Vector):
        """R J R' v."""
        return turn(q, apply(J, turn(conjugate(q), v)))

    @wp.func
    def inverse_turn(q: Quaternion):
        """R' as a matrix."""
        one = S(real(1.0))
        two = real(2.0)
        qx = q.u.x * two
        qy = q.u.y * two
        qz = q.u.z * two
        xx = mul(q.u.x, qx)
        yy = mul(q.u.y, qy)
        zz = mul(q.u.z, qz)
        xy = mul(q.u.x, qy)
        xz = mul(q.u.x, qz)
        yz = mul(q.u.y, qz)
        sx = mul(q.w, qx)
        sy = mul(q.w, qy)
        sz = mul(q.w, qz)
        return rows(
            vector(one - yy - zz, xy + sz, xz - sy),
            vector(xy - sz, one - xx - zz, yz + sx),
            vector(xz + sy, yz - sx, one - xx - yy),
        )

    @wp.func
    def rotation_vector(p: Quaternion, q: Quaternion):
        """log(R(p)' R(q)), at most a half turn, from quaternions of any sign.

        Three halvings take the angle to at most pi / 8, where atan(t) is a short series in t = tan(angle / 16).
        """
        v = subtract(subtract(scaled(q.u, p.w), scaled(p.u, q.w)), cross(p.u, q.u))
        s = mul(p.w, q.w) + dot(p.u, q.u)
        one = S(real(1.0))
        sign = wp.sign(s)
        norm = sqrt(dot(v, v) + mul(s, s))
        t = scaled(v, div(sign, norm + wp.abs(s)))  # tan(angle / 4) along the axis
        t = scaled(t, div(one, one + sqrt(one + dot(t, t))))
        t = scaled(t, div(one, one + sqrt(one + dot(t, t))))
        y = dot(t, t)
        ratio = S(real(0.0))
        for k in range(wp.static(arc_terms)):
            ratio = S(real(1.0) / real(2 * (wp.static(arc_terms) - k) - 1)) - mul(y, ratio)
        return scaled(t, ratio * real(16.0))

    @wp.func
    def logarithm(d: Vector, phi: Vector):
        """Motion with the translation d in axes 1 and the rotation vector phi."""
        y = dot(phi, phi)
        c = S(real(0.0))
        dc = S(real(0.0))
        ddc = S(real(0.0))  # half of it
        for k in range(wp.static(series_terms)):
            ddc = mul(ddc, y) + dc
            dc = mul(dc, y) + c
            c = mul(c, y) + S(series[k])
        pole = div(S(real(1.0)), S(real(wp.static(4.0 * pi * pi))) - y)
        motion = Motion()
        pole2 = mul(pole, pole)
        motion.c = c + pole * real(2.0)
        motion.dc = dc + pole2 * real(2.0)
        motion.ddc = ddc * real(2.0) + mul(pole2, pole) * real(4.0)
        turned = cross(phi, d)
        motion.u = add(subtract(d, scaled(turned, S(real(0.5)))), scaled(cross(phi, turned), motion.c))
        motion.phi = phi
        motion.angle2 = y
        return motion

    return SimpleNamespace(
        Quaternion=Quaternion,
        Motion=Motion,
        quaternion=quaternion,
        read_quaternion=read_quaternion,
        write_quaternion=write_quaternion,
        conjugate=conjugate,
        turn=turn,
        after=after,
        exponential=exponential,
        normalized=normalized,
        turned_inertia=turned_inertia,
        inverse_turn=inverse_turn,
        rotation_vector=rotation_vector,
        logarithm=logarithm,
    )
