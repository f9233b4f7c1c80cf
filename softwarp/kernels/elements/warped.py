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
from softwarp.kernels.elements import corotational

ITERATIONS = 4
LEAST = 1.0e-2  # bound of det(tr S 1 - S), which is 8 at rest: inverted elements turn by finite angles


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Force kernel of the warped tet for one scalar type; its tangent is that of ``corotational``."""
    S = variant.S
    real = variant.real
    mul, div, any_positive = variant.mul, variant.div, variant.any_positive
    world_fastest = variant.world_fastest
    module = variant.module("corotational.warped")
    a, tet = algebra(variant), corotational.kernels(variant)
    Matrix, Symmetric, rows, vector = a.Matrix, a.Symmetric, a.rows, a.vector
    row_x, row_y, scaled, dot, apply = a.row_x, a.row_y, a.scaled, a.dot, a.apply
    transposed, matmul, crossmul = a.transposed, a.matmul, a.crossmul
    edges, constants, element_frame, write_corners = tet.edges, tet.constants, tet.element_frame, tet.write_corners
    depth_below, ratio_gradients, guarded = tet.depth_below, tet.ratio_gradients, tet.guarded
    hold_upright = tet.hold_upright

    @wp.func
    def correction(m: Matrix):
        """Rotation exp [w] for M = R' F."""
        one = S(real(1.0))
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
        scale = div(S(half), wp.max(det, S(real(LEAST))))
        t = apply(c, scaled(vector(m.zy - m.yz, m.xz - m.zx, m.yx - m.xy), scale))  # w / 2
        square = dot(t, t)
        k = div(S(real(2.0)), one + square)
        d = mul(one - square, k) * half
        p = scaled(t, k)
        return rows(
            vector(d + mul(p.x, t.x), mul(p.x, t.y) - p.z, mul(p.x, t.z) + p.y),
            vector(mul(p.y, t.x) + p.z, d + mul(p.y, t.y), mul(p.y, t.z) - p.x),
            vector(mul(p.z, t.x) - p.y, mul(p.z, t.y) + p.x, d + mul(p.z, t.z)),
        )

    @wp.func
    def stress(m: Matrix, mu: S, lam: S):
        """2 mu (sym M - 1) + lam tr(M - 1) 1."""
        one = S(real(1.0))
        two_mu = mu + mu
        pressure = mul(lam, m.xx + m.yy + m.zz - S(real(3.0)))
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
        share: real,
        # Model
        tet_index: wp.array(dtype=wp.int32),
        tet_node: wp.array2d(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        tet_gradient: wp.array2d(dtype=real),
        tet_volume: wp.array(dtype=real),
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
        tet = tet_index[item]
        e = edges(node_x_in, w, tet_node, tet)
        g = constants(tet_gradient, tet)
        F = crossmul(e, g)  # sum e_b g_b'
        # tet_frame holds the rest frame R0
        Q = matmul(element_frame(row_x(e), row_y(e)), transposed(constants(tet_frame, tet)))
        M = crossmul(Q, F)
        for _ in range(wp.static(ITERATIONS)):
            Q = matmul(Q, correction(M))
            M = crossmul(Q, F)
        body = tet_body[tet]
        volume = tet_volume[tet]
        mu = body_mu_in[w, body]
        lam = body_lam_in[w, body]
        root = S(wp.sqrt(volume))
        guard = body_guard[body]
        depth = depth_below(guard, e, volume / share)
        if any_positive(depth):
            root = mul(root, guarded(depth, guard, ratio_gradients(e, volume / share), g))
        s = stress(M, mu * volume, lam * volume)
        write_corners(Q, s, tet_gradient, root, tet_gradient_out, tet_force_out, w, tet)
        if any_positive(depth):
            hold_upright(depth, guard, ratio_gradients(e, volume / share), volume, mu, lam, tet_force_out, w, tet)

    return SimpleNamespace(tet_force=tet_force)
