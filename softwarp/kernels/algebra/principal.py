"""Principal axes of symmetric matrices and of deformation gradients. Theory: docs/theory/hyperelastic.md.

Jacobi's method turns one pair of axes after the other so that the entry g between them vanishes: where d is the
difference of its diagonal, the smaller of two such angles has the tangent 2 g / (d +- sqrt(d^2 + 4 g^2)). Sweeps over
the three pairs converge quadratically. F = U diag(s) V' has V from F'F, and U by orthogonalisation of F V, longest
column first; U and V are rotations, so the smallest s has the sign of det F. There are no branches, as lanes share
them (McAdams et al., 2011, Computing the Singular Value Decomposition of 3x3 Matrices with Minimal Branching). After
three sweeps U diag(s) V' is F to 20 roundings in float32, the stretches alone to 3.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.algebra.vectors import algebra

LEAST = {wp.float32: 1.0e-30, wp.float64: 1.0e-200}  # keeps quotients of zeros defined
SWEEPS = {wp.float32: 3, wp.float64: 6}


@cache
def functions(variant: Variant) -> SimpleNamespace:
    """Eigenvalues and singular values on the elements of a variant."""
    S = variant.S
    real = variant.real
    mul, fma, div, sqrt, select = variant.mul, variant.fma, variant.div, variant.sqrt, variant.select
    least, tiny, sweeps = real(LEAST[real]), real(1.0e3 * LEAST[real] ** 0.5), SWEEPS[real]
    tenth = real(0.1 * (2.0**-23 if real is wp.float32 else 2.0**-52))  # of a rounding
    a = algebra(variant)
    Vector, Matrix, Symmetric, vector = a.Vector, a.Matrix, a.Symmetric, a.vector
    add, subtract, scaled, dot, cross = a.add, a.subtract, a.scaled, a.dot, a.cross
    rows, matmul, transposed = a.rows, a.matmul, a.transposed
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
    def turned(e: Axes):
        """Turn x and y so that xy vanishes, and give the axes the next names: y becomes x, and so on."""
        one = S(real(1.0))
        d = e.m.yy - e.m.xx
        g = e.m.xy + e.m.xy
        root = sqrt(fma(d, d, mul(g, g)))
        t = div(g, d + select(d, root, -root) + select(d, S(least), S(-least)))
        c = div(one, sqrt(fma(t, t, one)))
        s = mul(t, c)
        n = Axes()
        n.m.xx = fma(t, e.m.xy, e.m.yy)
        n.m.yy = e.m.zz
        n.m.zz = e.m.xx - mul(t, e.m.xy)
        n.m.xy = fma(s, e.m.xz, mul(c, e.m.yz))
        n.m.xz = S(real(0.0))
        n.m.yz = mul(c, e.m.xz) - mul(s, e.m.yz)
        n.x = add(scaled(e.x, s), scaled(e.y, c))
        n.y = e.z
        n.z = subtract(scaled(e.x, c), scaled(e.y, s))
        return n

    @wp.func
    def principal_axes(m: Symmetric):
        """Eigenvalues on the diagonal, in no order; eigenvectors in rows, a rotation."""
        one = S(real(1.0))
        none = S(real(0.0))
        e = Axes()
        e.m = m
        e.x = vector(one, none, none)
        e.y = vector(none, one, none)
        e.z = vector(none, none, one)
        for _ in range(3 * wp.static(sweeps)):
            e = turned(e)
        return e

    @wp.func
    def chosen(condition: S, a: Vector, b: Vector):
        return vector(select(condition, a.x, b.x), select(condition, a.y, b.y), select(condition, a.z, b.z))

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
        e = principal_axes(product_with_itself(t))
        v = rows(e.x, e.y, e.z)
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
        e = principal_axes(product_with_itself(t))
        one = S(real(1.0))
        least_square = S(least)
        last = sqrt(wp.max(e.m.zz, least_square))
        r = Singular()
        r.v = rows(e.x, e.y, e.z)
        r.s = vector(
            sqrt(wp.max(e.m.xx, least_square)),
            sqrt(wp.max(e.m.yy, least_square)),
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
