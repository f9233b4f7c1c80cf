"""Vectors, matrices and the logarithm of rigid motions on the elements of a variant. Theory: docs/theory/rod.md.

A rigid motion h = (R, d) with R = exp [phi]x has the logarithm (u, phi), with u = A d, A = 1 - [phi]x / 2 + c [phi]x^2.
Everything is written for elementwise arithmetic, smooth and accurate at phi = 0 without a branch.
"""

from math import pi
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant


def _zeta_minus_one(s: int) -> float:
    """Riemann zeta(s) - 1 for s >= 2: the first terms and the Euler-Maclaurin formula for the rest."""
    n = 200
    head = sum(k**-s for k in range(n - 1, 1, -1))
    tail = n / (s - 1) + 1 / 2 + s / (12 * n) - s * (s + 1) * (s + 2) / (720 * n**3)
    return head + tail * n**-s


def _series(count: int) -> tuple[float, ...]:
    """Coefficients 2 (zeta(2k) - 1) / (2 pi)^(2k), k = 1, 2, ..., of c(y) - 2 / (4 pi^2 - y), y = |phi|^2."""
    return tuple(2.0 * _zeta_minus_one(2 * k) / (2.0 * pi) ** (2 * k) for k in range(1, count + 1))


def algebra(variant: Variant) -> SimpleNamespace:
    """Vectors, matrices and the logarithm of rigid motions on the elements of one variant."""
    S = variant.S
    real = variant.real
    plus, minus, mul, div, sqrt = variant.add, variant.sub, variant.mul, variant.div, variant.sqrt
    is_double = real is wp.float64
    arc_terms = 12 if is_double else 5  # of atan(t)/t, t^2 < 0.04: below half a rounding error
    series = _series(14 if is_double else 7)  # up to |phi| = pi: below half a rounding error
    series_terms = len(series)

    @wp.struct
    class Vector:
        x: S
        y: S
        z: S

    @wp.struct
    class Matrix:
        xx: S
        xy: S
        xz: S
        yx: S
        yy: S
        yz: S
        zx: S
        zy: S
        zz: S

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
    def vector(x: S, y: S, z: S):
        v = Vector()
        v.x = x
        v.y = y
        v.z = z
        return v

    @wp.func
    def read_vector(a: wp.array2d(dtype=S), w: int, row: int):
        return vector(a[w, row], a[w, row + 1], a[w, row + 2])

    @wp.func
    def write_vector(a: wp.array2d(dtype=S), w: int, row: int, v: Vector):
        a[w, row] = v.x
        a[w, row + 1] = v.y
        a[w, row + 2] = v.z

    @wp.func
    def write_matrix(a: wp.array2d(dtype=S), w: int, row: int, m: Matrix):
        a[w, row] = m.xx
        a[w, row + 1] = m.xy
        a[w, row + 2] = m.xz
        a[w, row + 3] = m.yx
        a[w, row + 4] = m.yy
        a[w, row + 5] = m.yz
        a[w, row + 6] = m.zx
        a[w, row + 7] = m.zy
        a[w, row + 8] = m.zz

    @wp.func
    def add(a: Vector, b: Vector):
        return vector(plus(a.x, b.x), plus(a.y, b.y), plus(a.z, b.z))

    @wp.func
    def subtract(a: Vector, b: Vector):
        return vector(minus(a.x, b.x), minus(a.y, b.y), minus(a.z, b.z))

    @wp.func
    def scaled(a: Vector, s: S):
        return vector(mul(a.x, s), mul(a.y, s), mul(a.z, s))

    @wp.func
    def product(a: Vector, b: Vector):
        """Component by component."""
        return vector(mul(a.x, b.x), mul(a.y, b.y), mul(a.z, b.z))

    @wp.func
    def dot(a: Vector, b: Vector):
        return plus(plus(mul(a.x, b.x), mul(a.y, b.y)), mul(a.z, b.z))

    @wp.func
    def cross(a: Vector, b: Vector):
        return vector(
            minus(mul(a.y, b.z), mul(a.z, b.y)),
            minus(mul(a.z, b.x), mul(a.x, b.z)),
            minus(mul(a.x, b.y), mul(a.y, b.x)),
        )

    @wp.func
    def row_x(m: Matrix):
        return vector(m.xx, m.xy, m.xz)

    @wp.func
    def row_y(m: Matrix):
        return vector(m.yx, m.yy, m.yz)

    @wp.func
    def row_z(m: Matrix):
        return vector(m.zx, m.zy, m.zz)

    @wp.func
    def rows(x: Vector, y: Vector, z: Vector):
        m = Matrix()
        m.xx = x.x
        m.xy = x.y
        m.xz = x.z
        m.yx = y.x
        m.yy = y.y
        m.yz = y.z
        m.zx = z.x
        m.zy = z.y
        m.zz = z.z
        return m

    @wp.func
    def transposed(m: Matrix):
        return rows(vector(m.xx, m.yx, m.zx), vector(m.xy, m.yy, m.zy), vector(m.xz, m.yz, m.zz))

    @wp.func
    def summed(a: Matrix, b: Matrix):
        return rows(add(row_x(a), row_x(b)), add(row_y(a), row_y(b)), add(row_z(a), row_z(b)))

    @wp.func
    def subtracted(a: Matrix, b: Matrix):
        return rows(subtract(row_x(a), row_x(b)), subtract(row_y(a), row_y(b)), subtract(row_z(a), row_z(b)))

    @wp.func
    def symmetric_part(m: Matrix):
        half = real(0.5)
        xy = (m.xy + m.yx) * half
        xz = (m.xz + m.zx) * half
        yz = (m.yz + m.zy) * half
        return rows(vector(m.xx, xy, xz), vector(xy, m.yy, yz), vector(xz, yz, m.zz))

    @wp.func
    def mirrored(m: Matrix):
        """Symmetric to the bit: the upper triangle twice."""
        return rows(row_x(m), vector(m.xy, m.yy, m.yz), vector(m.xz, m.yz, m.zz))

    @wp.func
    def negative(m: Matrix):
        return rows(
            vector(-m.xx, -m.xy, -m.xz),
            vector(-m.yx, -m.yy, -m.yz),
            vector(-m.zx, -m.zy, -m.zz),
        )

    @wp.func
    def combination(v: Vector, m: Matrix):
        """m' v, the rows of m weighted by v."""
        return vector(
            plus(plus(mul(v.x, m.xx), mul(v.y, m.yx)), mul(v.z, m.zx)),
            plus(plus(mul(v.x, m.xy), mul(v.y, m.yy)), mul(v.z, m.zy)),
            plus(plus(mul(v.x, m.xz), mul(v.y, m.yz)), mul(v.z, m.zz)),
        )

    @wp.func
    def matmul(a: Matrix, b: Matrix):
        return rows(combination(row_x(a), b), combination(row_y(a), b), combination(row_z(a), b))

    @wp.func
    def matvec(m: Matrix, v: Vector):
        return vector(dot(row_x(m), v), dot(row_y(m), v), dot(row_z(m), v))

    @wp.func
    def weighted(d: Vector, m: Matrix):
        """diag(d) m."""
        return rows(scaled(row_x(m), d.x), scaled(row_y(m), d.y), scaled(row_z(m), d.z))

    @wp.func
    def gram(a: Matrix, b: Matrix):
        """a' b, known to be symmetric: six entries are computed."""
        m = Matrix()
        m.xx = plus(plus(mul(a.xx, b.xx), mul(a.yx, b.yx)), mul(a.zx, b.zx))
        m.xy = plus(plus(mul(a.xx, b.xy), mul(a.yx, b.yy)), mul(a.zx, b.zy))
        m.xz = plus(plus(mul(a.xx, b.xz), mul(a.yx, b.yz)), mul(a.zx, b.zz))
        m.yy = plus(plus(mul(a.xy, b.xy), mul(a.yy, b.yy)), mul(a.zy, b.zy))
        m.yz = plus(plus(mul(a.xy, b.xz), mul(a.yy, b.yz)), mul(a.zy, b.zz))
        m.zz = plus(plus(mul(a.xz, b.xz), mul(a.yz, b.yz)), mul(a.zz, b.zz))
        m.yx = m.xy
        m.zx = m.xz
        m.zy = m.yz
        return m

    @wp.func
    def crossed(a: Vector, m: Matrix):
        """[a]x m."""
        x = row_x(m)
        y = row_y(m)
        z = row_z(m)
        return rows(
            subtract(scaled(z, a.y), scaled(y, a.z)),
            subtract(scaled(x, a.z), scaled(z, a.x)),
            subtract(scaled(y, a.x), scaled(x, a.y)),
        )

    @wp.func
    def dyad(a: Vector, b: Vector, s: S, spin: Vector):
        """(a b' + b a') + s 1 - [spin]x / 2."""
        half = real(0.5)
        xy = plus(mul(a.x, b.y), mul(a.y, b.x))
        xz = plus(mul(a.x, b.z), mul(a.z, b.x))
        yz = plus(mul(a.y, b.z), mul(a.z, b.y))
        hx = spin.x * half
        hy = spin.y * half
        hz = spin.z * half
        return rows(
            vector(mul(a.x, b.x) * real(2.0) + s, xy + hz, xz - hy),
            vector(xy - hz, mul(a.y, b.y) * real(2.0) + s, yz + hx),
            vector(xz + hy, yz - hx, mul(a.z, b.z) * real(2.0) + s),
        )

    @wp.func
    def composed(a: Vector, b: Vector, s: S, spin: Vector):
        """a b' + s 1 - [spin]x."""
        return rows(
            vector(mul(a.x, b.x) + s, mul(a.x, b.y) + spin.z, mul(a.x, b.z) - spin.y),
            vector(mul(a.y, b.x) - spin.z, mul(a.y, b.y) + s, mul(a.y, b.z) + spin.x),
            vector(mul(a.z, b.x) + spin.y, mul(a.z, b.y) - spin.x, mul(a.z, b.z) + s),
        )

    @wp.func
    def inverse_turn(q: Vector, s: S):
        """R' of the unit quaternion (q, s)."""
        one = S(real(1.0))
        two = real(2.0)
        qx = q.x * two
        qy = q.y * two
        qz = q.z * two
        xx = mul(q.x, qx)
        yy = mul(q.y, qy)
        zz = mul(q.z, qz)
        xy = mul(q.x, qy)
        xz = mul(q.x, qz)
        yz = mul(q.y, qz)
        sx = mul(s, qx)
        sy = mul(s, qy)
        sz = mul(s, qz)
        return rows(
            vector(one - yy - zz, xy + sz, xz - sy),
            vector(xy - sz, one - xx - zz, yz + sx),
            vector(xz + sy, yz - sx, one - xx - yy),
        )

    @wp.func
    def rotation_vector(q1: Vector, s1: S, q2: Vector, s2: S):
        """log(R1' R2), at most a half turn, from quaternions (vector, scalar) of any sign.

        Three halvings take the angle to at most pi / 8, where atan(t) is a short series in t = tan(angle / 16).
        """
        v = subtract(subtract(scaled(q2, s1), scaled(q1, s2)), cross(q1, q2))
        s = mul(s1, s2) + dot(q1, q2)
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
            c = mul(c, y) + S(real(wp.static(series[series_terms - 1 - k])))
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
        Vector=Vector,
        Matrix=Matrix,
        Motion=Motion,
        vector=vector,
        read_vector=read_vector,
        write_vector=write_vector,
        write_matrix=write_matrix,
        add=add,
        subtract=subtract,
        scaled=scaled,
        product=product,
        dot=dot,
        cross=cross,
        combination=combination,
        transposed=transposed,
        summed=summed,
        subtracted=subtracted,
        mirrored=mirrored,
        negative=negative,
        matmul=matmul,
        matvec=matvec,
        weighted=weighted,
        gram=gram,
        crossed=crossed,
        dyad=dyad,
        composed=composed,
        symmetric_part=symmetric_part,
        inverse_turn=inverse_turn,
        rotation_vector=rotation_vector,
        logarithm=logarithm,
    )
