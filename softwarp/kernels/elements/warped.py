"""Corotational tetrahedra with the polar rotation, found by iteration in lanes. Theory: docs/theory/corotational.md.

Forces are those of the polar law of ``hyperelastic``; what a step keeps for its tangent is what ``corotational`` keeps
for ``large``, whose gather kernels serve both. From the rotation of the edges as a start, R becomes the rotation
nearest to F: with M = R' F and its symmetric part S, the rotation vector w of (tr S 1 - S) w = axl(M - M') makes
R exp [w] nearly that rotation. Convergence is cubic; 4 iterations leave rounding at stretches of 0.5 to 1.5. The
exponential is taken by Cayley's formula, a rotation for any w, so inverted elements keep one too. The guard is that of
``corotational``.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.algebra.vectors import algebra
from softwarp.kernels.elements import access, corotational

ITERATIONS = 4
LEAST = 1.0e-2  # bound of det(tr S 1 - S), which is 8 at rest: inverted elements turn by finite angles


@cache
def functions(variant: Variant) -> SimpleNamespace:
    """A step of the iteration for the rotation on the elements of a variant."""
    T, real, mul, div = variant.S, variant.real, variant.mul, variant.div
    a = algebra(variant)
    Matrix, Symmetric, rows, vector = a.Matrix, a.Symmetric, a.rows, a.vector
    scaled, dot, apply = a.scaled, a.dot, a.apply

    @wp.func
    def correction(m: Matrix):
        """Rotation exp [w] for M = R' F."""
        one = T(real(1.0))
        half = real(0.5)
        sxy = (m.xy + m.yx) * half
        sxz = (m.xz + m.zx) * half
        syz = (m.yz + m.zy) * half
        gx = m.yy + m.zz  # diagonal of G = tr S 1 - S
        gy = m.xx + m.zz
        gz = m.xx + m.yy
        c = Symmetric()  # its cofactors
        c.xx = mul(gy, gz) - mul(syz, syz)
        c.yy = mul(gx, gz) - mul(sxz, sxz)
        c.zz = mul(gx, gy) - mul(sxy, sxy)
        c.xy = mul(sxy, gz) + mul(syz, sxz)
        c.xz = mul(sxz, gy) + mul(syz, sxy)
        c.yz = mul(syz, gx) + mul(sxy, sxz)
        det = mul(gx, c.xx) - mul(sxy, c.xy) - mul(sxz, c.xz)
        scale = div(T(half), wp.max(det, T(real(LEAST))))
        t = apply(c, scaled(vector(m.zy - m.yz, m.xz - m.zx, m.yx - m.xy), scale))  # w / 2
        square = dot(t, t)
        k = div(T(real(2.0)), one + square)
        d = mul(one - square, k) * half
        p = scaled(t, k)
        return rows(
            vector(d + mul(p.x, t.x), mul(p.x, t.y) - p.z, mul(p.x, t.z) + p.y),
            vector(mul(p.y, t.x) + p.z, d + mul(p.y, t.y), mul(p.y, t.z) - p.x),
            vector(mul(p.z, t.x) - p.y, mul(p.z, t.y) + p.x, d + mul(p.z, t.z)),
        )

    return SimpleNamespace(correction=correction)


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Force kernel of the warped tet for one scalar type; its tangent is that of ``corotational``."""
    at, shared = access.functions(variant), corotational.force_kernels(variant)
    inner = at.inner
    S, T, real, world_fastest = variant.S, inner.S, variant.real, variant.world_fastest
    mul = inner.mul
    module = variant.module("corotational.warped")
    a, element_frame = algebra(inner), corotational.functions(inner).element_frame
    Matrix, Symmetric = a.Matrix, a.Symmetric
    row_x, row_y = a.row_x, a.row_y
    transposed, matmul, crossmul = a.transposed, a.matmul, a.crossmul
    edges, gradients, of_body, of_tet, of_scene = at.edges, at.gradients, at.of_body, at.of_tet, at.of_scene
    write_turned, correction = shared.write_turned, functions(inner).correction

    @wp.func
    def stress(m: Matrix, mu: T, lam: T):
        """2 mu (sym M - 1) + lam tr(M - 1) 1."""
        one = T(real(1.0))
        two_mu = mu + mu
        pressure = mul(lam, m.xx + m.yy + m.zz - T(real(3.0)))
        s = Symmetric()
        s.xx = mul(two_mu, m.xx - one) + pressure
        s.yy = mul(two_mu, m.yy - one) + pressure
        s.zz = mul(two_mu, m.zz - one) + pressure
        s.xy = mul(mu, m.xy + m.yx)
        s.xz = mul(mu, m.xz + m.zx)
        s.yz = mul(mu, m.yz + m.zy)
        return s

    @wp.kernel(module=module, enable_backward=False)
    def tet_force(
        # Model
        tet_index: wp.array(dtype=wp.int32),
        tet_node: wp.array2d(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        tet_gradient: wp.array2d(dtype=real),
        tet_volume: wp.array(dtype=real),
        tet_size: wp.array(dtype=real),
        tet_frame: wp.array2d(dtype=real),
        body_guard: wp.array(dtype=real),
        # Workspace in
        body_mu_in: wp.array2d(dtype=S),
        body_lam_in: wp.array2d(dtype=S),
        node_x_in: wp.array2d(dtype=S),
        # Workspace out
        tet_gradient_out: wp.array2d(dtype=S),
        tet_force_out: wp.array2d(dtype=S),
    ):
        """Elastic corner forces dE/dx [N] and turned shape gradients times sqrt(V) [m^1/2] of one tet."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        e = edges(node_x_in, w, tet_node, tet_index, item)
        g = gradients(tet_gradient, tet_index, item)
        F = crossmul(e, g)  # sum e_b g_b'
        # tet_frame holds the rest frame R0
        Q = matmul(element_frame(row_x(e), row_y(e)), transposed(gradients(tet_frame, tet_index, item)))
        M = crossmul(Q, F)
        for _ in range(wp.static(ITERATIONS)):
            Q = matmul(Q, correction(M))
            M = crossmul(Q, F)
        volume = of_tet(tet_volume, tet_index, item)
        mu = of_body(body_mu_in, w, tet_body, tet_index, item)
        lam = of_body(body_lam_in, w, tet_body, tet_index, item)
        guard = of_scene(body_guard, tet_body, tet_index, item)
        write_turned(
            Q,
            stress(M, mul(mu, volume), mul(lam, volume)),
            e,
            g,
            mu,
            lam,
            guard,
            volume,
            of_tet(tet_size, tet_index, item),
            w,
            tet_index,
            item,
            tet_gradient_out,
            tet_force_out,
        )

    return SimpleNamespace(tet_force=tet_force, correction=correction)
