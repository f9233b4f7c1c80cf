"""Principal axes of symmetric matrices and of deformation gradients. Theory: docs/theory/hyperelastic.md.

The deviator B of a matrix, scaled to tr B^2 = 6, has the eigenvalues 2 cos(a + 2 pi k/3) with cos 3a = det B/2. Of the
three, the one on the side of det B, 2 cos(acos|det B/2|/3) with that sign, lies 1.7 or more from both others, however
near these are to each other: a polynomial tells it, and B less it has cofactors along its axis. What is left is a
matrix of two rows in the plane across that axis; a turn by the smaller angle, the tangent of which is
2 g/(d +- sqrt(d^2 + 4 g^2)) with the difference d of its diagonal and the entry g beside it, makes g vanish.

F = U diag(s) V' has V from F'F, and U by orthogonalisation of F V, longest column first; U and V are rotations, so the
smallest s has the sign of det F. There are no branches, as lanes share them (McAdams et al., 2011, Computing the
Singular Value Decomposition of 3x3 Matrices with Minimal Branching). U diag(s) V' is F to 4 roundings.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.algebra.vectors import algebra

LEAST = {wp.float32: 1.0e-30, wp.float64: 1.0e-200}  # keeps quotients of zeros defined
# 2 cos(acos(r)/3) for r from 0 to 1, to 2e-8, by powers of r; in float64 one step of Newton's method squares that.
LARGEST = (
    1.732050829614984,
    0.33333038268348786,
    -0.0961592956176313,
    0.04881168115590241,
    -0.028654594137040232,
    0.015437627107439768,
    -0.005923973896739198,
    0.0011073596096139227,
)


@cache
def functions(variant: Variant) -> SimpleNamespace:
    """Eigenvalues and singular values on the elements of a variant."""
    S = variant.S
    real = variant.real
    mul, fma, div, sqrt, select = variant.mul, variant.fma, variant.div, variant.sqrt, variant.select
    least, tiny, refines = real(LEAST[real]), real(1.0e3 * LEAST[real] ** 0.5), real is wp.float64
    powers = wp.types.vector(len(LARGEST), real)(*reversed(LARGEST))
    tenth = real(0.1 * (2.0**-23 if real is wp.float32 else 2.0**-52))  # of a rounding
    third, sixth = real(1.0 / 3.0), real(1.0 / 6.0)
    a = algebra(variant)
    Vector, Matrix, Symmetric, vector = a.Vector, a.Matrix, a.Symmetric, a.vector
    add, subtract, scaled, dot, cross = a.add, a.subtract, a.scaled, a.dot, a.cross
    rows, matmul, transposed, apply = a.rows, a.matmul, a.transposed, a.apply
    row_x, row_y, row_z = a.row_x, a.row_y, a.row_z

    @wp.struct
    class Axes:
        """A symmetric matrix, and in rows the axes that it refers to."""

        m: Symmetric
        x: Vector
        y: Vector
        z: Vector

    @wp.struct
    class Singular:
        """F = U diag(s) V', with the transposes of U and V: axes in rows."""

        u: Matrix
        s: Vector
        v: Matrix

    @wp.func
    def chosen(condition: S, a: Vector, b: Vector):
        return vector(select(condition, a.x, b.x), select(condition, a.y, b.y), select(condition, a.z, b.z))

    @wp.func
    def largest_root(r: S):
        """The largest x with x^3 - 3 x = 2 r, for r from 0 to 1."""
        x = S(powers[0])
        for k in range(wp.static(len(LARGEST) - 1)):
            x = fma(x, r, S(powers[k + 1]))
        if wp.static(refines):
            square = mul(x, x)
            x = x - div(mul(x, square - S(real(3.0))) - r - r, mul(S(real(3.0)), square - S(real(1.0))))
        return x

    @wp.func
    def lone_axis(b: Symmetric, x: S):
        """Unit vector along the cofactors of b - x 1, which are a multiple of its square."""
        xx = b.xx - x
        yy = b.yy - x
        zz = b.zz - x
        c = Symmetric()
        c.xx = mul(yy, zz) - mul(b.yz, b.yz)
        c.yy = mul(xx, zz) - mul(b.xz, b.xz)
        c.zz = mul(xx, yy) - mul(b.xy, b.xy)
        c.xy = mul(b.xz, b.yz) - mul(b.xy, zz)
        c.xz = mul(b.xy, b.yz) - mul(b.xz, yy)
        c.yz = mul(b.xy, b.xz) - mul(b.yz, xx)
        n = chosen(c.yy - c.xx, vector(c.xy, c.yy, c.yz), vector(c.xx, c.xy, c.xz))
        n = chosen(c.zz - wp.max(c.xx, c.yy), vector(c.xz, c.yz, c.zz), n)
        return scaled(n, div(S(real(1.0)), sqrt(dot(n, n))))

    @wp.func
    def plane_across(n: Vector):
        """Two unit vectors that make a right-handed frame with the unit vector n (Duff et al., 2017)."""
        one = S(real(1.0))
        sign = select(n.z, one, -one)
        a = div(-one, sign + n.z)
        b = mul(mul(n.x, n.y), a)
        x = mul(sign, n.x)
        return vector(fma(mul(x, n.x), a, one), mul(sign, b), -x), vector(b, fma(mul(n.y, n.y), a, sign), -n.y)

    @wp.func
    def principal_axes(m: Symmetric):
        """Eigenvalues on the diagonal, in no order; eigenvectors in rows, a rotation."""
        one = S(real(1.0))
        mean = (m.xx + m.yy + m.zz) * third
        b = Symmetric()
        b.xx = m.xx - mean
        b.yy = m.yy - mean
        b.zz = -(b.xx + b.yy)  # where rounding is all that differs, m.zz - mean leaves a trace, and no lone axis
        beside = fma(m.xy, m.xy, fma(m.xz, m.xz, mul(m.yz, m.yz)))
        size = fma(b.xx, b.xx, fma(b.yy, b.yy, mul(b.zz, b.zz))) * sixth + beside * third
        size = sqrt(wp.max(size, S(least)))
        over = div(one, size)
        b.xx = mul(b.xx, over)
        b.yy = mul(b.yy, over)
        b.zz = mul(b.zz, over)
        b.xy = mul(m.xy, over)
        b.xz = mul(m.xz, over)
        b.yz = mul(m.yz, over)
        x = mul(b.yy, b.zz) - mul(b.yz, b.yz)
        y = mul(b.xy, b.zz) - mul(b.yz, b.xz)
        z = mul(b.xy, b.yz) - mul(b.yy, b.xz)
        det = mul(b.xx, x) - mul(b.xy, y) + mul(b.xz, z)
        root = largest_root(wp.min(wp.max(det, -det) * real(0.5), one))
        root = select(det, root, -root)
        n = lone_axis(b, root)
        p, q = plane_across(n)
        bp = apply(b, p)
        bq = apply(b, q)
        pp = dot(p, bp)
        qq = dot(q, bq)
        pq = dot(p, bq)
        d = qq - pp
        g = pq + pq
        t = sqrt(fma(d, d, mul(g, g)))
        t = div(g, d + select(d, t, -t) + select(d, S(least), S(-least)))
        c = div(one, sqrt(fma(t, t, one)))
        s = mul(t, c)
        axes = Axes()
        axes.m = m
        axes.m.xx = fma(size, pp - mul(t, pq), mean)
        axes.m.yy = fma(size, fma(t, pq, qq), mean)
        axes.m.zz = fma(size, root, mean)
        axes.m.xy = S(real(0.0))
        axes.m.xz = S(real(0.0))
        axes.m.yz = S(real(0.0))
        axes.x = subtract(scaled(p, c), scaled(q, s))
        axes.y = add(scaled(p, s), scaled(q, c))
        axes.z = n
        return axes

    @wp.func
    def larger_first(b: Matrix, v: Matrix):
        """The first two rows of b, and of v, with the longer one of b first; one changes its sign, as in a turn."""
        second = dot(row_y(b), row_y(b)) - dot(row_x(b), row_x(b))
        minus = S(real(-1.0))
        b_y = chosen(second, scaled(row_x(b), minus), row_y(b))
        v_y = chosen(second, scaled(row_x(v), minus), row_y(v))
        return (
            rows(chosen(second, row_y(b), row_x(b)), b_y, row_z(b)),
            rows(chosen(second, row_y(v), row_x(v)), v_y, row_z(v)),
        )

    @wp.func
    def cycled(m: Matrix):
        return rows(row_y(m), row_z(m), row_x(m))

    @wp.func
    def unit(v: Vector):
        """v over its length, and that."""
        length = sqrt(wp.max(dot(v, v), S(least)))
        return scaled(v, div(S(real(1.0)), length)), length

    @wp.func
    def product_with_itself(t: Matrix):
        """t t'."""
        c = Symmetric()
        c.xx = dot(row_x(t), row_x(t))
        c.yy = dot(row_y(t), row_y(t))
        c.zz = dot(row_z(t), row_z(t))
        c.xy = dot(row_x(t), row_y(t))
        c.xz = dot(row_x(t), row_z(t))
        c.yz = dot(row_y(t), row_z(t))
        return c

    @wp.func
    def singular_values(F: Matrix):
        """F = U diag(s) V' with rotations U and V, and the sign of det F in the smallest s, which is the last."""
        t = transposed(F)
        axes = principal_axes(product_with_itself(t))
        v = rows(axes.x, axes.y, axes.z)
        b = matmul(v, t)
        # the shortest row goes last: (x, y), (y, z), (x, y)
        b, v = larger_first(b, v)
        b, v = larger_first(cycled(b), cycled(v))
        b, v = larger_first(cycled(cycled(b)), cycled(cycled(v)))
        none = S(real(0.0))
        x, first = unit(add(row_x(b), vector(S(tiny), none, none)))
        across = chosen(S(real(0.5)) - mul(x.x, x.x), vector(none, x.z, -x.y), vector(-x.z, none, x.x))
        rest = subtract(row_y(b), scaled(x, dot(x, row_y(b))))
        z, _ = unit(cross(x, add(rest, scaled(across, first * tenth + S(tiny)))))  # a sure axis if rounding is all
        y = cross(z, x)
        r = Singular()
        r.u = rows(x, y, z)
        r.s = vector(first, dot(y, row_y(b)), dot(z, row_z(b)))
        r.v = v
        return r

    @wp.func
    def stretches(F: Matrix):
        """The same where no stretch vanishes and a mirrored F may have any: U is F V diag(1/s), with no order kept."""
        t = transposed(F)
        axes = principal_axes(product_with_itself(t))
        one = S(real(1.0))
        least_square = S(least)
        last = sqrt(wp.max(axes.m.zz, least_square))
        r = Singular()
        r.v = rows(axes.x, axes.y, axes.z)
        r.s = vector(
            sqrt(wp.max(axes.m.xx, least_square)),
            sqrt(wp.max(axes.m.yy, least_square)),
            select(dot(row_x(F), cross(row_y(F), row_z(F))), last, -last),
        )
        b = matmul(r.v, t)
        x = scaled(row_x(b), div(one, r.s.x))
        y = scaled(row_y(b), div(one, r.s.y))
        r.u = rows(x, y, scaled(row_z(b), div(one, r.s.z)))
        return r

    return SimpleNamespace(
        Axes=Axes,
        Singular=Singular,
        principal_axes=principal_axes,
        singular_values=singular_values,
        stretches=stretches,
    )
