"""Vectors and matrices on the elements of a variant: the algebra of element and frame kernels.

One source serves one world, eight worlds in SIMD lanes and a GPU thread. Sums are taken in the order in which they are
written here, from x to z, so that a formula gives the same bits wherever it stands.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant


@cache
def algebra(variant: Variant) -> SimpleNamespace:
    """Structs and functions of one variant; the same ones for all that ask, so that files can share functions."""
    S = variant.S
    real = variant.real
    plus, minus, mul, fma = variant.add, variant.sub, variant.mul, variant.fma

    # Three floats would pass between functions as a pair and a single one, and stay so where these are inlined. What is
    # larger passes in memory, which the compiler sees through: that saves a fifth of the time of a tetrahedron.
    if variant.name == "scalar" and real is wp.float32:

        @wp.struct
        class Vector:
            x: S
            y: S
            z: S
            unused: wp.vec2f

    else:

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
    class Symmetric:
        xx: S
        yy: S
        zz: S
        xy: S
        xz: S
        yz: S

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
    def add_vector(a: wp.array2d(dtype=S), w: int, row: int, v: Vector):
        a[w, row] += v.x
        a[w, row + 1] += v.y
        a[w, row + 2] += v.z

    @wp.func
    def constant(a: wp.array2d(dtype=real), i: int, k: int):
        """Three numbers that all worlds share."""
        return vector(S(a[i, k]), S(a[i, k + 1]), S(a[i, k + 2]))

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
    def add_matrix(a: wp.array2d(dtype=S), w: int, row: int, m: Matrix):
        a[w, row] += m.xx
        a[w, row + 1] += m.xy
        a[w, row + 2] += m.xz
        a[w, row + 3] += m.yx
        a[w, row + 4] += m.yy
        a[w, row + 5] += m.yz
        a[w, row + 6] += m.zx
        a[w, row + 7] += m.zy
        a[w, row + 8] += m.zz

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
        return fma(a.z, b.z, fma(a.y, b.y, mul(a.x, b.x)))

    @wp.func
    def dot_onto(s: S, a: Vector, b: Vector):
        """s + a . b, term by term."""
        return fma(a.z, b.z, fma(a.y, b.y, fma(a.x, b.x, s)))

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
            fma(v.z, m.zx, fma(v.y, m.yx, mul(v.x, m.xx))),
            fma(v.z, m.zy, fma(v.y, m.yy, mul(v.x, m.xy))),
            fma(v.z, m.zz, fma(v.y, m.yz, mul(v.x, m.xz))),
        )

    @wp.func
    def matmul(a: Matrix, b: Matrix):
        return rows(combination(row_x(a), b), combination(row_y(a), b), combination(row_z(a), b))

    @wp.func
    def matvec(m: Matrix, v: Vector):
        return vector(dot(row_x(m), v), dot(row_y(m), v), dot(row_z(m), v))

    @wp.func
    def crossmul(a: Matrix, b: Matrix):
        """a' b."""
        return matmul(transposed(a), b)

    @wp.func
    def outer(a: Vector, b: Vector):
        """a b'."""
        return rows(scaled(b, a.x), scaled(b, a.y), scaled(b, a.z))

    @wp.func
    def add_outer(m: Matrix, a: Vector, b: Vector):
        """m + a b'."""
        return rows(
            vector(fma(a.x, b.x, m.xx), fma(a.x, b.y, m.xy), fma(a.x, b.z, m.xz)),
            vector(fma(a.y, b.x, m.yx), fma(a.y, b.y, m.yy), fma(a.y, b.z, m.yz)),
            vector(fma(a.z, b.x, m.zx), fma(a.z, b.y, m.zy), fma(a.z, b.z, m.zz)),
        )

    @wp.func
    def apply(m: Symmetric, v: Vector):
        """m v."""
        return vector(
            fma(m.xz, v.z, fma(m.xy, v.y, mul(m.xx, v.x))),
            fma(m.yz, v.z, fma(m.yy, v.y, mul(m.xy, v.x))),
            fma(m.zz, v.z, fma(m.yz, v.y, mul(m.xz, v.x))),
        )

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

    return SimpleNamespace(
        Vector=Vector,
        Matrix=Matrix,
        Symmetric=Symmetric,
        vector=vector,
        read_vector=read_vector,
        write_vector=write_vector,
        add_vector=add_vector,
        constant=constant,
        write_matrix=write_matrix,
        add_matrix=add_matrix,
        add=add,
        subtract=subtract,
        scaled=scaled,
        product=product,
        dot=dot,
        dot_onto=dot_onto,
        cross=cross,
        row_x=row_x,
        row_y=row_y,
        row_z=row_z,
        rows=rows,
        transposed=transposed,
        summed=summed,
        subtracted=subtracted,
        symmetric_part=symmetric_part,
        mirrored=mirrored,
        negative=negative,
        combination=combination,
        matmul=matmul,
        matvec=matvec,
        crossmul=crossmul,
        outer=outer,
        add_outer=add_outer,
        apply=apply,
        weighted=weighted,
        gram=gram,
        crossed=crossed,
        dyad=dyad,
        composed=composed,
    )
