"""Geometrically exact rod segments: stretch, shear, bending and twist. Theory, symbols and checks: docs/theory/rod.md.

A segment ties frames 1 and 2 with positions x and rotations R. Its strain is constant along it (helicoidal
interpolation): with h = (R1'R2, R1'(x2 - x1)) the logarithm (u, phi) = log h gives Gamma = u / L and kappa = phi / L.
Energy L/2 [(Gamma - Gamma0)' C (Gamma - Gamma0) + (kappa - kappa0)' D (kappa - kappa0)] with C = diag(GA_s, GA_s, EA)
and D = diag(EI1, EI2, GJ). References: Simo and Vu-Quoc (1986); Sonneville, Cardona, Bruls (2014).
"""

from functools import cache
from math import pi
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.lanes import Variant

LENGTH_MIN = 1.0e-12  # m, keeps the direction of a collapsed segment finite


def _zeta_minus_one(s: int) -> float:
    """Riemann zeta(s) - 1 for s >= 2: the first terms and the Euler-Maclaurin formula for the rest."""
    n = 200
    head = sum(k**-s for k in range(n - 1, 1, -1))
    return (
        head + n ** (1 - s) / (s - 1) + n**-s / 2 + s * n ** (-s - 1) / 12 - s * (s + 1) * (s + 2) * n ** (-s - 3) / 720
    )


def _series(count: int) -> tuple[float, ...]:
    """Coefficients 2 (zeta(2k) - 1) / (2 pi)^(2k), k = 1, 2, ..., of c(y) - 2 / (4 pi^2 - y), y = |phi|^2."""
    return tuple(2.0 * _zeta_minus_one(2 * k) / (2.0 * pi) ** (2 * k) for k in range(1, count + 1))


def algebra(variant: Variant) -> SimpleNamespace:
    """Vectors, matrices and the logarithm of rigid motions on the elements of one variant."""
    S = variant.S
    real = variant.real
    mul, div, sqrt = variant.mul, variant.div, variant.sqrt
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
        return vector(a.x + b.x, a.y + b.y, a.z + b.z)

    @wp.func
    def subtract(a: Vector, b: Vector):
        return vector(a.x - b.x, a.y - b.y, a.z - b.z)

    @wp.func
    def scaled(a: Vector, s: S):
        return vector(mul(a.x, s), mul(a.y, s), mul(a.z, s))

    @wp.func
    def product(a: Vector, b: Vector):
        """Component by component."""
        return vector(mul(a.x, b.x), mul(a.y, b.y), mul(a.z, b.z))

    @wp.func
    def dot(a: Vector, b: Vector):
        return mul(a.x, b.x) + mul(a.y, b.y) + mul(a.z, b.z)

    @wp.func
    def cross(a: Vector, b: Vector):
        return vector(
            mul(a.y, b.z) - mul(a.z, b.y),
            mul(a.z, b.x) - mul(a.x, b.z),
            mul(a.x, b.y) - mul(a.y, b.x),
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
    def plus(a: Matrix, b: Matrix):
        return rows(add(row_x(a), row_x(b)), add(row_y(a), row_y(b)), add(row_z(a), row_z(b)))

    @wp.func
    def subtracted(a: Matrix, b: Matrix):
        return rows(subtract(row_x(a), row_x(b)), subtract(row_y(a), row_y(b)), subtract(row_z(a), row_z(b)))

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
            mul(v.x, m.xx) + mul(v.y, m.yx) + mul(v.z, m.zx),
            mul(v.x, m.xy) + mul(v.y, m.yy) + mul(v.z, m.zy),
            mul(v.x, m.xz) + mul(v.y, m.yz) + mul(v.z, m.zz),
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
        m.xx = mul(a.xx, b.xx) + mul(a.yx, b.yx) + mul(a.zx, b.zx)
        m.xy = mul(a.xx, b.xy) + mul(a.yx, b.yy) + mul(a.zx, b.zy)
        m.xz = mul(a.xx, b.xz) + mul(a.yx, b.yz) + mul(a.zx, b.zz)
        m.yy = mul(a.xy, b.xy) + mul(a.yy, b.yy) + mul(a.zy, b.zy)
        m.yz = mul(a.xy, b.xz) + mul(a.yy, b.yz) + mul(a.zy, b.zz)
        m.zz = mul(a.xz, b.xz) + mul(a.yz, b.yz) + mul(a.zz, b.zz)
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
        xy = mul(a.x, b.y) + mul(a.y, b.x)
        xz = mul(a.x, b.z) + mul(a.z, b.x)
        yz = mul(a.y, b.z) + mul(a.z, b.y)
        hx = spin.x * half
        hy = spin.y * half
        hz = spin.z * half
        return rows(
            vector(mul(a.x, b.x) * real(2.0) + s, xy + hz, xz - hy),
            vector(xy - hz, mul(a.y, b.y) * real(2.0) + s, yz + hx),
            vector(xz + hy, yz - hx, mul(a.z, b.z) * real(2.0) + s),
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
        for k in range(wp.static(series_terms)):
            dc = mul(dc, y) + c
            c = mul(c, y) + S(real(wp.static(series[series_terms - 1 - k])))
        pole = div(S(real(1.0)), S(real(wp.static(4.0 * pi * pi))) - y)
        motion = Motion()
        motion.c = c + pole * real(2.0)
        motion.dc = dc + mul(pole, pole) * real(2.0)
        turned = cross(phi, d)
        motion.u = add(subtract(d, scaled(turned, S(real(0.5)))), scaled(cross(phi, turned), motion.c))
        motion.phi = phi
        motion.angle2 = y
        return motion

    return SimpleNamespace(
        Vector=Vector,
        Matrix=Matrix,
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
        plus=plus,
        subtracted=subtracted,
        mirrored=mirrored,
        negative=negative,
        matmul=matmul,
        matvec=matvec,
        weighted=weighted,
        gram=gram,
        crossed=crossed,
        dyad=dyad,
        inverse_turn=inverse_turn,
        rotation_vector=rotation_vector,
        logarithm=logarithm,
    )


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Rod kernels for one scalar type."""
    S = variant.S
    real = variant.real
    mul, div, sqrt = variant.mul, variant.div, variant.sqrt
    world_fastest = variant.world_fastest
    module = variant.module("rod")
    a = algebra(variant)
    Vector, vector = a.Vector, a.vector
    read_vector, write_vector, write_matrix = a.read_vector, a.write_vector, a.write_matrix
    add, subtract, scaled, product = a.add, a.subtract, a.scaled, a.product
    dot, cross, combination = a.dot, a.cross, a.combination
    transposed, plus, negative, matmul, matvec = a.transposed, a.plus, a.negative, a.matmul, a.matvec
    subtracted, mirrored = a.subtracted, a.mirrored
    weighted, gram, crossed, dyad = a.weighted, a.gram, a.crossed, a.dyad
    inverse_turn, rotation_vector, logarithm = a.inverse_turn, a.rotation_vector, a.logarithm

    @wp.func
    def relative_rotation(pose: wp.array2d(dtype=S), w: int, f: int, g: int):
        """log(Rf' Rg)."""
        return rotation_vector(
            read_vector(pose, w, 7 * f + 3), pose[w, 7 * f + 6], read_vector(pose, w, 7 * g + 3), pose[w, 7 * g + 6]
        )

    @wp.func
    def rest_strain(seg_rest: wp.array2d(dtype=real), seg: int, row: int):
        return vector(S(seg_rest[seg, row]), S(seg_rest[seg, row + 1]), S(seg_rest[seg, row + 2]))

    @wp.func
    def turned_span(pose: wp.array2d(dtype=S), w: int, f: int, g: int):
        """Rf' (xg - xf)."""
        span = subtract(read_vector(pose, w, 7 * g), read_vector(pose, w, 7 * f))
        return matvec(inverse_turn(read_vector(pose, w, 7 * f + 3), pose[w, 7 * f + 6]), span)

    @wp.func
    def tension(axial: S, span: Vector):
        """max(N, 0) / l (1 - t t') with the direction t and length l of the span."""
        inverse = div(S(real(1.0)), wp.max(sqrt(dot(span, span)), S(real(wp.static(LENGTH_MIN)))))
        k = mul(wp.max(axial, S(real(0.0))), inverse)
        t = scaled(span, inverse)
        none = S(real(0.0))
        return dyad(t, scaled(t, k * real(-0.5)), k, vector(none, none, none))

    @wp.func
    def stiffness(seg_section: wp.array2d(dtype=real), seg: int, scale: real, youngs: S, nu: S):
        """Diagonals C [N] and D [N m^2]."""
        e = youngs * scale
        shear = div(e, nu * real(2.0) + S(real(2.0)))
        c = vector(shear * seg_section[seg, 1], shear * seg_section[seg, 1], e * seg_section[seg, 0])
        d = vector(e * seg_section[seg, 2], e * seg_section[seg, 3], shear * seg_section[seg, 4])
        return c, d

    @wp.kernel(module=module, enable_backward=False)
    def element(
        # Model
        first: int,
        seg_frame: wp.array2d(dtype=wp.int32),
        seg_rod: wp.array(dtype=wp.int32),
        seg_length: wp.array(dtype=real),
        seg_section: wp.array2d(dtype=real),
        seg_scale: wp.array(dtype=real),
        seg_rest: wp.array2d(dtype=real),
        # Workspace in
        rod_youngs_in: wp.array2d(dtype=S),
        rod_nu_in: wp.array2d(dtype=S),
        pose_in: wp.array2d(dtype=S),
        # Workspace out
        element_force_out: wp.array2d(dtype=S),
        element_stiffness_out: wp.array2d(dtype=S),
    ):
        """dE/dq [N, N m] and B' C B with the stiffening by tension of one segment, corners (t1, r1, t2, r2)."""
        w, seg = wp.tid()
        if wp.static(world_fastest):
            seg, w = wp.tid()
        f = seg_frame[seg, 0]
        g = seg_frame[seg, 1]
        span = subtract(read_vector(pose_in, w, 7 * g), read_vector(pose_in, w, 7 * f))
        back = inverse_turn(read_vector(pose_in, w, 7 * f + 3), pose_in[w, 7 * f + 6])  # R1'
        motion = logarithm(matvec(back, span), relative_rotation(pose_in, w, f, g))
        u = motion.u
        phi = motion.phi

        # d(u, phi) = (M d(x2 - x1) + (N + M [span]x) dr2 - N dr1, M (dr2 - dr1))
        half_c = motion.c * real(0.5)
        along = dot(u, phi)
        bend = mul(motion.dc, along)
        trace = (mul(motion.c, along) + mul(bend, motion.angle2)) * real(-2.0)
        M = matmul(dyad(phi, scaled(phi, half_c), S(real(1.0)) - mul(motion.c, motion.angle2), phi), back)
        N = matmul(dyad(phi, add(scaled(u, motion.c), scaled(phi, bend)), trace, u), back)

        inverse = S(real(1.0) / seg_length[seg])
        c, d = stiffness(seg_section, seg, seg_scale[seg], rod_youngs_in[w, seg_rod[seg]], rod_nu_in[w, seg_rod[seg]])
        n = product(c, subtract(scaled(u, inverse), rest_strain(seg_rest, seg, 0)))
        m = product(d, subtract(scaled(phi, inverse), rest_strain(seg_rest, seg, 3)))
        force = combination(n, M)
        moment = add(combination(n, N), combination(m, M))
        row = 12 * (first + seg)
        write_vector(element_force_out, w, row, scaled(force, S(real(-1.0))))
        write_vector(element_force_out, w, row + 3, scaled(moment, S(real(-1.0))))
        write_vector(element_force_out, w, row + 6, force)
        write_vector(element_force_out, w, row + 9, subtract(moment, cross(span, force)))

        # with C and D divided by the length, V = N + M [span]x: K = M'CM, X = M'CN, Y = M'CV, W = N'CN, Z = V'CN
        c = scaled(c, inverse)
        CM = weighted(c, M)
        K = gram(M, CM)
        X = matmul(transposed(CM), N)
        Y = subtracted(X, transposed(crossed(span, K)))
        W = gram(N, weighted(c, N))
        Z = subtracted(W, crossed(span, X))
        last = mirrored(subtracted(transposed(Z), crossed(span, Y)))
        turning = gram(M, weighted(scaled(d, inverse), M))
        T = plus(K, tension(n.z, span))

        row = 90 * (first + seg)
        write_matrix(element_stiffness_out, w, row, T)
        write_matrix(element_stiffness_out, w, row + 9, transposed(X))
        write_matrix(element_stiffness_out, w, row + 18, plus(W, turning))
        write_matrix(element_stiffness_out, w, row + 27, negative(T))
        write_matrix(element_stiffness_out, w, row + 36, negative(X))
        write_matrix(element_stiffness_out, w, row + 45, T)
        write_matrix(element_stiffness_out, w, row + 54, negative(transposed(Y)))
        write_matrix(element_stiffness_out, w, row + 63, negative(plus(Z, turning)))
        write_matrix(element_stiffness_out, w, row + 72, transposed(Y))
        write_matrix(element_stiffness_out, w, row + 81, plus(last, turning))

    @wp.kernel(module=module, enable_backward=False)
    def strain(
        # Model
        seg_frame: wp.array2d(dtype=wp.int32),
        seg_length: wp.array(dtype=real),
        # Workspace in
        pose_in: wp.array2d(dtype=S),
        # Workspace out
        seg_strain_out: wp.array2d(dtype=S),
    ):
        """Strain of one segment in its own axes: Gamma (3, at rest about (0, 0, 1)) and kappa (3) [1/m]."""
        w, seg = wp.tid()
        if wp.static(world_fastest):
            seg, w = wp.tid()
        f = seg_frame[seg, 0]
        g = seg_frame[seg, 1]
        motion = logarithm(turned_span(pose_in, w, f, g), relative_rotation(pose_in, w, f, g))
        inverse = S(real(1.0) / seg_length[seg])
        write_vector(seg_strain_out, w, 6 * seg, scaled(motion.u, inverse))
        write_vector(seg_strain_out, w, 6 * seg + 3, scaled(motion.phi, inverse))

    @wp.kernel(module=module, enable_backward=False)
    def resultant(
        # Model
        seg_rod: wp.array(dtype=wp.int32),
        seg_length: wp.array(dtype=real),
        seg_section: wp.array2d(dtype=real),
        seg_scale: wp.array(dtype=real),
        seg_rest: wp.array2d(dtype=real),
        # Workspace in
        rod_youngs_in: wp.array2d(dtype=S),
        rod_nu_in: wp.array2d(dtype=S),
        seg_strain_in: wp.array2d(dtype=S),
        # Workspace out
        seg_resultant_out: wp.array2d(dtype=S),
        seg_energy_out: wp.array2d(dtype=S),
    ):
        """Inner force (3) [N] and moment (3) [N m] in the segment's axes, and elastic energy [J], from its strain."""
        w, seg = wp.tid()
        if wp.static(world_fastest):
            seg, w = wp.tid()
        c, d = stiffness(seg_section, seg, seg_scale[seg], rod_youngs_in[w, seg_rod[seg]], rod_nu_in[w, seg_rod[seg]])
        gamma = subtract(read_vector(seg_strain_in, w, 6 * seg), rest_strain(seg_rest, seg, 0))
        kappa = subtract(read_vector(seg_strain_in, w, 6 * seg + 3), rest_strain(seg_rest, seg, 3))
        n = product(c, gamma)
        m = product(d, kappa)
        write_vector(seg_resultant_out, w, 6 * seg, n)
        write_vector(seg_resultant_out, w, 6 * seg + 3, m)
        seg_energy_out[w, seg] = (dot(n, gamma) + dot(m, kappa)) * (real(0.5) * seg_length[seg])

    return SimpleNamespace(element=element, strain=strain, resultant=resultant)
