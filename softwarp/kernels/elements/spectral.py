"""Stiffness of isotropic tetrahedra in principal axes. Theory: docs/theory/hyperelastic.md; ``laws``.

With F = U diag(s) V', dP = U (C : U' dF V) V', where C has a 3x3 stretch block psi_ij and, for every pair of axes, the
eigenvalues (psi_i - psi_j)/(s_i - s_j) and (psi_i + psi_j)/(s_i + s_j). Clamping these at zero gives the nearest
positive semidefinite tangent. Reference: Smith, de Goes, Kim (2019), Analytic Eigensystems for Isotropic Distortion
Energies. A CPU computes eight elements at a time, of eight worlds or of one.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import lanes, principal
from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.algebra.vectors import algebra
from softwarp.kernels.elements import access
from softwarp.kernels.elements.laws import LAWS, lane_parameters, law_parameters


@cache
def tangents(variant: Variant) -> SimpleNamespace:
    """The tangent in principal axes, and a block of the stiffness made from it."""
    S = variant.S
    real = variant.real
    mul, fma, any_positive, select = variant.mul, variant.fma, variant.any_positive, variant.select
    a = algebra(variant)
    Vector, Matrix, Symmetric, vector, rows = a.Vector, a.Matrix, a.Symmetric, a.vector, a.rows
    matmul, crossmul, dot, product = a.matmul, a.crossmul, a.dot, a.product
    principal_axes = principal.functions(variant).principal_axes

    @wp.struct
    class Tangent:
        """C: the stretch block, and of every pair of axes, by the missing one, half the sum and half the difference."""

        h: Symmetric
        mean: Vector
        half: Vector

    @wp.func
    def projected(h: Symmetric):
        """Nearest positive semidefinite matrix; one that is definite stays as it is."""
        none = S(real(0.0))
        minor = mul(h.xx, h.yy) - mul(h.xy, h.xy)
        x = mul(h.yy, h.zz) - mul(h.yz, h.yz)
        y = mul(h.xy, h.zz) - mul(h.yz, h.xz)
        z = mul(h.xy, h.yz) - mul(h.yy, h.xz)
        least = wp.min(wp.min(h.xx, minor), mul(h.xx, x) - mul(h.xy, y) + mul(h.xz, z))
        unsure = select(least, S(real(-1.0)), S(real(1.0)))  # Sylvester: if all three are positive, h is definite
        if any_positive(unsure):
            axes = principal_axes(h)
            dx = wp.max(axes.m.xx, none)
            dy = wp.max(axes.m.yy, none)
            dz = wp.max(axes.m.zz, none)
            weights = vector(dx, dy, dz)
            p = vector(axes.x.x, axes.y.x, axes.z.x)
            q = vector(axes.x.y, axes.y.y, axes.z.y)
            r = vector(axes.x.z, axes.y.z, axes.z.z)
            weighted = product(p, weights)
            other = product(q, weights)
            h.xx = select(unsure, dot(weighted, p), h.xx)
            h.xy = select(unsure, dot(weighted, q), h.xy)
            h.xz = select(unsure, dot(weighted, r), h.xz)
            h.yy = select(unsure, dot(other, q), h.yy)
            h.yz = select(unsure, dot(other, r), h.yz)
            h.zz = select(unsure, dot(product(r, weights), r), h.zz)
        return h

    @wp.func
    def tangent(h: Symmetric, minus: Vector, plus: Vector, scale: S):
        """``scale`` times C."""
        half = scale * real(0.5)
        t = Tangent()
        t.h.xx = mul(h.xx, scale)
        t.h.yy = mul(h.yy, scale)
        t.h.zz = mul(h.zz, scale)
        t.h.xy = mul(h.xy, scale)
        t.h.xz = mul(h.xz, scale)
        t.h.yz = mul(h.yz, scale)
        t.mean = vector(mul(minus.x + plus.x, half), mul(minus.y + plus.y, half), mul(minus.z + plus.z, half))
        t.half = vector(mul(minus.x - plus.x, half), mul(minus.y - plus.y, half), mul(minus.z - plus.z, half))
        return t

    @wp.func
    def clamped(v: Vector):
        none = S(real(0.0))
        return vector(wp.max(v.x, none), wp.max(v.y, none), wp.max(v.z, none))

    @wp.func
    def block(t: Tangent, u: Matrix, p: Vector, q: Vector):
        """p_j C_ijkl q_l turned by U; p and q are gradients in principal axes V, ``u`` is U'."""
        x = mul(p.x, q.x)
        y = mul(p.y, q.y)
        z = mul(p.z, q.z)
        xx = fma(t.h.xx, x, fma(t.mean.z, y, mul(t.mean.y, z)))
        yy = fma(t.h.yy, y, fma(t.mean.z, x, mul(t.mean.x, z)))
        zz = fma(t.h.zz, z, fma(t.mean.y, x, mul(t.mean.x, y)))
        pxy = mul(p.x, q.y)
        pyx = mul(p.y, q.x)
        pxz = mul(p.x, q.z)
        pzx = mul(p.z, q.x)
        pyz = mul(p.y, q.z)
        pzy = mul(p.z, q.y)
        m = rows(
            vector(xx, fma(t.h.xy, pxy, mul(t.half.z, pyx)), fma(t.h.xz, pxz, mul(t.half.y, pzx))),
            vector(fma(t.h.xy, pyx, mul(t.half.z, pxy)), yy, fma(t.h.yz, pyz, mul(t.half.x, pzy))),
            vector(fma(t.h.xz, pzx, mul(t.half.y, pxz)), fma(t.h.yz, pzy, mul(t.half.x, pyz)), zz),
        )
        return crossmul(u, matmul(m, u))

    return SimpleNamespace(Tangent=Tangent, projected=projected, tangent=tangent, clamped=clamped, block=block)


@cache
def kernels(variant: Variant, law: str, project: bool) -> SimpleNamespace:
    """Element stiffness by one law.

    Args:
        variant: Scalar type and memory order.
        law: One of ``laws.LAWS``.
        project: Whether element tangents are clamped to positive semidefinite ones.
    """
    at = access.functions(variant)
    inner, entry, of_lane, member, place_of = at.inner, at.entry, at.of_lane, at.member, at.place_of
    edges, gradients, of_body = at.edges, at.gradients, at.of_body
    write_block, add_block = at.write_block, at.add_block
    per_item, mul = at.per_item, inner.mul
    S, T, real, world_fastest, lane_count = variant.S, inner.S, variant.real, variant.world_fastest, inner.lanes
    module = variant.module(f"spectral.{law}.{'spd' if project else 'exact'}")
    a, t = algebra(inner), tangents(inner)
    Vector, Matrix, Symmetric, vector = a.Vector, a.Matrix, a.Symmetric, a.vector
    row_x, row_y, row_z, matvec, crossmul = a.row_x, a.row_y, a.row_z, a.matvec, a.crossmul
    transposed, summed, negative = a.transposed, a.summed, a.negative
    Tangent, projected, tangent, clamped, block = t.Tangent, t.projected, t.tangent, t.clamped, t.block
    Singular = principal.functions(inner).Singular
    principal_of, parameters = LAWS[law].principal, law_parameters(real, law)
    vec3 = wp.types.vector(3, real)
    table = wp.types.matrix((13, lane_count), real)  # of every element: C, and its volume
    together = LAWS[law].lanes.principal if lane_count > 1 and LAWS[law].lanes else None
    gather, of_tet = lane_parameters(at, real, law, variant.lanes > 1) if together else None, at.of_tet
    decomposition = principal.functions(inner)
    decomposed = decomposition.stretches if together and LAWS[law].is_upright else decomposition.singular_values

    @wp.func
    def coefficients_each(
        s: Vector,
        w: int,
        item: int,
        tet_index: wp.array(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        tet_volume: wp.array(dtype=real),
        body_law_start: wp.array(dtype=wp.int32),
        body_mu: wp.array3d(dtype=real),
        body_lam: wp.array3d(dtype=real),
        law_parameter: wp.array3d(dtype=real),
    ):
        """Of every lane: stretch block by rows, shear eigenvalues, and the volume [m^3]."""
        c = table()
        count = int(wp.static(lane_count))
        for lane in range(count):
            tet = member(tet_index, item, lane)
            pack, place = place_of(w, lane)
            p = parameters(body_law_start, body_mu, body_lam, law_parameter, pack, tet_body[tet], place)
            H, minus, plus = principal_of(vec3(of_lane(s.x, lane), of_lane(s.y, lane), of_lane(s.z, lane)), p)
            c[0, lane] = H[0, 0]
            c[1, lane] = H[1, 1]
            c[2, lane] = H[2, 2]
            c[3, lane] = H[0, 1]
            c[4, lane] = H[0, 2]
            c[5, lane] = H[1, 2]
            for k in range(3):
                c[6 + k, lane] = minus[k]
                c[9 + k, lane] = plus[k]
            c[12, lane] = tet_volume[tet]
        return c

    @wp.func
    def coefficients_together(
        s: Vector,
        w: int,
        item: int,
        tet_index: wp.array(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        tet_volume: wp.array(dtype=real),
        body_law_start: wp.array(dtype=wp.int32),
        body_mu: wp.array3d(dtype=real),
        body_lam: wp.array3d(dtype=real),
        law_parameter: wp.array3d(dtype=real),
    ):
        """The same where the law takes all lanes at a time."""
        p = gather(w, item, tet_index, tet_body, body_law_start, body_mu, body_lam, law_parameter)
        found = together(s.x, s.y, s.z, p)
        c = table()
        for k in range(12):
            c[k] = found[k]
        c[12] = of_tet(tet_volume, tet_index, item)
        return c

    coefficients = coefficients_together if together else coefficients_each

    @wp.func
    def in_principal_axes(c: table, scale: T):
        """The tangent times ``scale``."""
        h = Symmetric()
        h.xx = entry(c, 0)
        h.yy = entry(c, 1)
        h.zz = entry(c, 2)
        h.xy = entry(c, 3)
        h.xz = entry(c, 4)
        h.yz = entry(c, 5)
        minus = vector(entry(c, 6), entry(c, 7), entry(c, 8))
        plus = vector(entry(c, 9), entry(c, 10), entry(c, 11))
        if wp.static(project):
            h = projected(h)
            minus = clamped(minus)
            plus = clamped(plus)
        return tangent(h, minus, plus, scale)

    @wp.struct
    class Blocks:
        """K_ab, a >= b, by the letters of the corners."""

        aa: Matrix
        ba: Matrix
        bb: Matrix
        ca: Matrix
        cb: Matrix
        cc: Matrix
        da: Matrix
        db: Matrix
        dc: Matrix
        dd: Matrix

    @wp.func
    def blocks(g: Matrix, r: Singular, C: Tangent):
        """Those of corners 1 to 3, and of corner 0, which balance them."""
        b = matvec(r.v, row_x(g))
        c = matvec(r.v, row_y(g))
        d = matvec(r.v, row_z(g))
        k = Blocks()
        k.bb = block(C, r.u, b, b)
        k.cb = block(C, r.u, c, b)
        k.cc = block(C, r.u, c, c)
        k.db = block(C, r.u, d, b)
        k.dc = block(C, r.u, d, c)
        k.dd = block(C, r.u, d, d)
        k.ba = negative(summed(summed(k.bb, transposed(k.cb)), transposed(k.db)))
        k.ca = negative(summed(summed(k.cb, k.cc), transposed(k.dc)))
        k.da = negative(summed(summed(k.db, k.dc), k.dd))
        k.aa = negative(summed(summed(k.ba, k.ca), k.da))
        return k

    @wp.kernel(module=module, enable_backward=False)
    def tet_stiffness(
        # Model
        tet_index: wp.array(dtype=wp.int32),
        tet_node: wp.array2d(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        tet_gradient: wp.array2d(dtype=real),
        tet_volume: wp.array(dtype=real),
        body_law_start: wp.array(dtype=wp.int32),
        # Workspace in
        body_mu_in: wp.array3d(dtype=real),
        body_lam_in: wp.array3d(dtype=real),
        law_parameter_in: wp.array3d(dtype=real),
        node_x_in: wp.array2d(dtype=S),
        # Workspace out
        tet_stiffness_out: wp.array2d(dtype=S),
    ):
        """The ten blocks K_ab, a >= b, of one tet, or of eight [N/m]."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        g = gradients(tet_gradient, tet_index, item)
        r = decomposed(crossmul(edges(node_x_in, w, tet_node, tet_index, item), g))
        found = coefficients(
            r.s,
            w,
            item,
            tet_index,
            tet_body,
            tet_volume,
            body_law_start,
            body_mu_in,
            body_lam_in,
            law_parameter_in,
        )
        k = blocks(g, r, in_principal_axes(found, entry(found, 12)))
        write_block(tet_stiffness_out, w, tet_index, item, 0, k.aa)
        write_block(tet_stiffness_out, w, tet_index, item, 9, k.ba)
        write_block(tet_stiffness_out, w, tet_index, item, 18, k.bb)
        write_block(tet_stiffness_out, w, tet_index, item, 27, k.ca)
        write_block(tet_stiffness_out, w, tet_index, item, 36, k.cb)
        write_block(tet_stiffness_out, w, tet_index, item, 45, k.cc)
        write_block(tet_stiffness_out, w, tet_index, item, 54, k.da)
        write_block(tet_stiffness_out, w, tet_index, item, 63, k.db)
        write_block(tet_stiffness_out, w, tet_index, item, 72, k.dc)
        write_block(tet_stiffness_out, w, tet_index, item, 81, k.dd)

    @wp.kernel(module=module, enable_backward=False)
    def add_stiffness(
        # Model
        tet_index: wp.array(dtype=wp.int32),
        tet_node: wp.array2d(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        tet_gradient: wp.array2d(dtype=real),
        tet_volume: wp.array(dtype=real),
        tet_block: wp.array2d(dtype=wp.int32),
        body_law_start: wp.array(dtype=wp.int32),
        # Workspace in
        body_mu_in: wp.array3d(dtype=real),
        body_lam_in: wp.array3d(dtype=real),
        law_parameter_in: wp.array3d(dtype=real),
        node_x_in: wp.array2d(dtype=S),
        body_stiffness_scale_in: wp.array2d(dtype=S),
        # Workspace out
        a_out: wp.array2d(dtype=S),
    ):
        """Add the stiffness of all tets to A, one after the other: nothing is stored, which on a CPU costs the most."""
        w = wp.tid()
        for item in range((tet_index.shape[0] + wp.static(per_item - 1)) / wp.static(per_item)):
            g = gradients(tet_gradient, tet_index, item)
            r = decomposed(crossmul(edges(node_x_in, w, tet_node, tet_index, item), g))
            found = coefficients(
                r.s,
                w,
                item,
                tet_index,
                tet_body,
                tet_volume,
                body_law_start,
                body_mu_in,
                body_lam_in,
                law_parameter_in,
            )
            scale = of_body(body_stiffness_scale_in, w, tet_body, tet_index, item)
            k = blocks(g, r, in_principal_axes(found, mul(entry(found, 12), scale)))
            add_block(a_out, w, tet_index, item, tet_block, 0, k.aa)
            add_block(a_out, w, tet_index, item, tet_block, 1, k.ba)
            add_block(a_out, w, tet_index, item, tet_block, 2, k.bb)
            add_block(a_out, w, tet_index, item, tet_block, 3, k.ca)
            add_block(a_out, w, tet_index, item, tet_block, 4, k.cb)
            add_block(a_out, w, tet_index, item, tet_block, 5, k.cc)
            add_block(a_out, w, tet_index, item, tet_block, 6, k.da)
            add_block(a_out, w, tet_index, item, tet_block, 7, k.db)
            add_block(a_out, w, tet_index, item, tet_block, 8, k.dc)
            add_block(a_out, w, tet_index, item, tet_block, 9, k.dd)

    return SimpleNamespace(tet_stiffness=tet_stiffness, add_stiffness=add_stiffness)


@cache
def evaluation_kernels(law: str) -> SimpleNamespace:
    """Energy, stress and tangent of given deformation gradients, in float64, for tests and plots."""
    module = wp.get_module(f"softwarp.kernels.elements.spectral.evaluate.{law}")
    energy_of, stress_of, principal_of = LAWS[law].energy, LAWS[law].stress, LAWS[law].principal
    exact = lanes.variant("scalar", "float64")
    a, of = algebra(exact), tangents(exact)
    Symmetric, vector, rows, matvec = a.Symmetric, a.vector, a.rows, a.matvec
    row_x, row_y, row_z = a.row_x, a.row_y, a.row_z
    projected, tangent, clamped, block = of.projected, of.tangent, of.clamped, of.block
    singular_values = principal.functions(exact).singular_values

    @wp.func
    def write_row(out: wp.array3d(dtype=wp.float64), sample: int, row: int, k: int, v: a.Vector):
        out[sample, row, k] = v.x
        out[sample, row, 3 + k] = v.y
        out[sample, row, 6 + k] = v.z

    @wp.kernel(module=module, enable_backward=False)
    def evaluate(
        # Samples in
        F_in: wp.array(dtype=wp.mat33d),
        p: wp.types.vector(LAWS[law].count, wp.float64),
        project: bool,
        # Samples out
        energy_out: wp.array(dtype=wp.float64),
        stress_out: wp.array(dtype=wp.mat33d),
        tangent_out: wp.array3d(dtype=wp.float64),
    ):
        """Energy density, stress and tangent [Pa] of one deformation gradient."""
        sample = wp.tid()
        F = F_in[sample]
        energy_out[sample] = energy_of(F, p)
        stress_out[sample] = stress_of(F, p)
        x = vector(F[0, 0], F[0, 1], F[0, 2])
        y = vector(F[1, 0], F[1, 1], F[1, 2])
        z = vector(F[2, 0], F[2, 1], F[2, 2])
        r = singular_values(rows(x, y, z))
        H, m, n = principal_of(wp.vec3d(r.s.x, r.s.y, r.s.z), p)
        h = Symmetric()
        h.xx = H[0, 0]
        h.yy = H[1, 1]
        h.zz = H[2, 2]
        h.xy = H[0, 1]
        h.xz = H[0, 2]
        h.yz = H[1, 2]
        minus = vector(m[0], m[1], m[2])
        plus = vector(n[0], n[1], n[2])
        if project:
            h = projected(h)
            minus = clamped(minus)
            plus = clamped(plus)
        t = tangent(h, minus, plus, wp.float64(1.0))
        for j in range(3):
            for k in range(3):
                ej = wp.vec3d()
                ek = wp.vec3d()
                ej[j] = wp.float64(1.0)
                ek[k] = wp.float64(1.0)
                gj = matvec(r.v, vector(ej[0], ej[1], ej[2]))
                gk = matvec(r.v, vector(ek[0], ek[1], ek[2]))
                K = block(t, r.u, gj, gk)
                write_row(tangent_out, sample, j, k, row_x(K))
                write_row(tangent_out, sample, 3 + j, k, row_y(K))
                write_row(tangent_out, sample, 6 + j, k, row_z(K))

    return SimpleNamespace(evaluate=evaluate)
