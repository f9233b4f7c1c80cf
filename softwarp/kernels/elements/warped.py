"""Corotational tetrahedra with the polar rotation, found by iteration in lanes. Theory: docs/theory/corotational.md.

Forces are those of the polar law of ``hyperelastic``; what a step keeps for its tangent is what ``corotational`` keeps
for ``large``, whose gather kernels serve both. From the rotation of the edges as a start, R becomes the rotation
nearest to F: with M = R' F and its symmetric part S, the rotation vector w of (tr S 1 - S) w = axl(M - M') makes
R exp [w] nearly that rotation. Convergence is cubic; 4 iterations leave rounding at stretches of 0.5 to 1.5. The
exponential is taken by Cayley's formula, a rotation for any w, so inverted elements keep one too.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.elements import corotational

ITERATIONS = 4
LEAST = 1.0e-2  # bound of det(tr S 1 - S), which is 8 at rest: inverted elements turn by finite angles


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Force kernel of the warped tet for one scalar type; its tangent is that of ``corotational``."""
    S = variant.S
    real = variant.real
    mul, fma, div = variant.mul, variant.fma, variant.div
    world_fastest = variant.world_fastest
    module = variant.module("corotational.warped")
    element_frame = corotational.kernels(variant).element_frame

    @wp.func
    def transposed_product(
        a00: S,
        a01: S,
        a02: S,
        a10: S,
        a11: S,
        a12: S,
        a20: S,
        a21: S,
        a22: S,
        b00: S,
        b01: S,
        b02: S,
        b10: S,
        b11: S,
        b12: S,
        b20: S,
        b21: S,
        b22: S,
    ):
        """A' B, row by row."""
        return (
            fma(a20, b20, fma(a10, b10, mul(a00, b00))),
            fma(a20, b21, fma(a10, b11, mul(a00, b01))),
            fma(a20, b22, fma(a10, b12, mul(a00, b02))),
            fma(a21, b20, fma(a11, b10, mul(a01, b00))),
            fma(a21, b21, fma(a11, b11, mul(a01, b01))),
            fma(a21, b22, fma(a11, b12, mul(a01, b02))),
            fma(a22, b20, fma(a12, b10, mul(a02, b00))),
            fma(a22, b21, fma(a12, b11, mul(a02, b01))),
            fma(a22, b22, fma(a12, b12, mul(a02, b02))),
        )

    @wp.func
    def product(
        a00: S,
        a01: S,
        a02: S,
        a10: S,
        a11: S,
        a12: S,
        a20: S,
        a21: S,
        a22: S,
        b00: S,
        b01: S,
        b02: S,
        b10: S,
        b11: S,
        b12: S,
        b20: S,
        b21: S,
        b22: S,
    ):
        """A B, row by row."""
        return (
            fma(a02, b20, fma(a01, b10, mul(a00, b00))),
            fma(a02, b21, fma(a01, b11, mul(a00, b01))),
            fma(a02, b22, fma(a01, b12, mul(a00, b02))),
            fma(a12, b20, fma(a11, b10, mul(a10, b00))),
            fma(a12, b21, fma(a11, b11, mul(a10, b01))),
            fma(a12, b22, fma(a11, b12, mul(a10, b02))),
            fma(a22, b20, fma(a21, b10, mul(a20, b00))),
            fma(a22, b21, fma(a21, b11, mul(a20, b01))),
            fma(a22, b22, fma(a21, b12, mul(a20, b02))),
        )

    @wp.func
    def correction(m00: S, m01: S, m02: S, m10: S, m11: S, m12: S, m20: S, m21: S, m22: S):
        """Rotation exp [w] for M = R' F, row by row."""
        one = S(real(1.0))
        half = real(0.5)
        s01 = (m01 + m10) * half
        s02 = (m02 + m20) * half
        s12 = (m12 + m21) * half
        g00 = m11 + m22  # G = tr S 1 - S
        g11 = m00 + m22
        g22 = m00 + m11
        c00 = mul(g11, g22) - mul(s12, s12)  # its cofactors
        c11 = mul(g00, g22) - mul(s02, s02)
        c22 = mul(g00, g11) - mul(s01, s01)
        c01 = mul(s01, g22) + mul(s12, s02)
        c02 = mul(s02, g11) + mul(s12, s01)
        c12 = mul(s12, g00) + mul(s01, s02)
        det = mul(g00, c00) - mul(s01, c01) - mul(s02, c02)
        scale = div(S(half), wp.max(det, S(real(LEAST))))
        a0 = mul(m21 - m12, scale)
        a1 = mul(m02 - m20, scale)
        a2 = mul(m10 - m01, scale)
        t0 = mul(c00, a0) + mul(c01, a1) + mul(c02, a2)  # t = w / 2
        t1 = mul(c01, a0) + mul(c11, a1) + mul(c12, a2)
        t2 = mul(c02, a0) + mul(c12, a1) + mul(c22, a2)
        square = mul(t0, t0) + mul(t1, t1) + mul(t2, t2)
        k = div(S(real(2.0)), one + square)
        d = mul(one - square, k) * half
        p0 = mul(t0, k)
        p1 = mul(t1, k)
        p2 = mul(t2, k)
        return (
            d + mul(p0, t0),
            mul(p0, t1) - p2,
            mul(p0, t2) + p1,
            mul(p1, t0) + p2,
            d + mul(p1, t1),
            mul(p1, t2) - p0,
            mul(p2, t0) - p1,
            mul(p2, t1) + p0,
            d + mul(p2, t2),
        )

    @wp.kernel(module=module, enable_backward=False)
    def tet_force(
        # Model
        tet_index: wp.array(dtype=wp.int32),
        tet_node: wp.array2d(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        tet_gradient: wp.array2d(dtype=real),
        tet_volume: wp.array(dtype=real),
        tet_frame: wp.array2d(dtype=real),
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
        na = tet_node[tet, 0] * 3
        nb = tet_node[tet, 1] * 3
        nc = tet_node[tet, 2] * 3
        nd = tet_node[tet, 3] * 3
        b0 = node_x_in[w, nb] - node_x_in[w, na]
        b1 = node_x_in[w, nb + 1] - node_x_in[w, na + 1]
        b2 = node_x_in[w, nb + 2] - node_x_in[w, na + 2]
        c0 = node_x_in[w, nc] - node_x_in[w, na]
        c1 = node_x_in[w, nc + 1] - node_x_in[w, na + 1]
        c2 = node_x_in[w, nc + 2] - node_x_in[w, na + 2]
        d0 = node_x_in[w, nd] - node_x_in[w, na]
        d1 = node_x_in[w, nd + 1] - node_x_in[w, na + 1]
        d2 = node_x_in[w, nd + 2] - node_x_in[w, na + 2]
        # F = sum (x_b - x_a) g_b' over the other corners
        f00 = b0 * tet_gradient[tet, 0] + c0 * tet_gradient[tet, 3] + d0 * tet_gradient[tet, 6]
        f01 = b0 * tet_gradient[tet, 1] + c0 * tet_gradient[tet, 4] + d0 * tet_gradient[tet, 7]
        f02 = b0 * tet_gradient[tet, 2] + c0 * tet_gradient[tet, 5] + d0 * tet_gradient[tet, 8]
        f10 = b1 * tet_gradient[tet, 0] + c1 * tet_gradient[tet, 3] + d1 * tet_gradient[tet, 6]
        f11 = b1 * tet_gradient[tet, 1] + c1 * tet_gradient[tet, 4] + d1 * tet_gradient[tet, 7]
        f12 = b1 * tet_gradient[tet, 2] + c1 * tet_gradient[tet, 5] + d1 * tet_gradient[tet, 8]
        f20 = b2 * tet_gradient[tet, 0] + c2 * tet_gradient[tet, 3] + d2 * tet_gradient[tet, 6]
        f21 = b2 * tet_gradient[tet, 1] + c2 * tet_gradient[tet, 4] + d2 * tet_gradient[tet, 7]
        f22 = b2 * tet_gradient[tet, 2] + c2 * tet_gradient[tet, 5] + d2 * tet_gradient[tet, 8]
        r00, r10, r20, r01, r11, r21, r02, r12, r22 = element_frame(b0, b1, b2, c0, c1, c2)

        # Q = R R0', with tet_frame holding R0 row by row
        q00 = r00 * tet_frame[tet, 0] + r01 * tet_frame[tet, 1] + r02 * tet_frame[tet, 2]
        q01 = r00 * tet_frame[tet, 3] + r01 * tet_frame[tet, 4] + r02 * tet_frame[tet, 5]
        q02 = r00 * tet_frame[tet, 6] + r01 * tet_frame[tet, 7] + r02 * tet_frame[tet, 8]
        q10 = r10 * tet_frame[tet, 0] + r11 * tet_frame[tet, 1] + r12 * tet_frame[tet, 2]
        q11 = r10 * tet_frame[tet, 3] + r11 * tet_frame[tet, 4] + r12 * tet_frame[tet, 5]
        q12 = r10 * tet_frame[tet, 6] + r11 * tet_frame[tet, 7] + r12 * tet_frame[tet, 8]
        q20 = r20 * tet_frame[tet, 0] + r21 * tet_frame[tet, 1] + r22 * tet_frame[tet, 2]
        q21 = r20 * tet_frame[tet, 3] + r21 * tet_frame[tet, 4] + r22 * tet_frame[tet, 5]
        q22 = r20 * tet_frame[tet, 6] + r21 * tet_frame[tet, 7] + r22 * tet_frame[tet, 8]
        m00, m01, m02, m10, m11, m12, m20, m21, m22 = transposed_product(
            q00, q01, q02, q10, q11, q12, q20, q21, q22, f00, f01, f02, f10, f11, f12, f20, f21, f22
        )
        for _ in range(wp.static(ITERATIONS)):
            t00, t01, t02, t10, t11, t12, t20, t21, t22 = correction(m00, m01, m02, m10, m11, m12, m20, m21, m22)
            q00, q01, q02, q10, q11, q12, q20, q21, q22 = product(
                q00, q01, q02, q10, q11, q12, q20, q21, q22, t00, t01, t02, t10, t11, t12, t20, t21, t22
            )
            m00, m01, m02, m10, m11, m12, m20, m21, m22 = transposed_product(
                q00, q01, q02, q10, q11, q12, q20, q21, q22, f00, f01, f02, f10, f11, f12, f20, f21, f22
            )

        one = S(real(1.0))
        body = tet_body[tet]
        volume = tet_volume[tet]
        mu = body_mu_in[w, body] * volume
        two_mu = mu + mu
        pressure = mul(body_lam_in[w, body] * volume, m00 + m11 + m22 - S(real(3.0)))
        s00 = mul(two_mu, m00 - one) + pressure
        s11 = mul(two_mu, m11 - one) + pressure
        s22 = mul(two_mu, m22 - one) + pressure
        s01 = mul(mu, m01 + m10)
        s02 = mul(mu, m02 + m20)
        s12 = mul(mu, m12 + m21)
        root = wp.sqrt(volume)
        row = tet * 12
        for c in range(3):
            tet_gradient_out[w, row + c] = S(real(0.0))
            tet_force_out[w, row + c] = S(real(0.0))
        for corner in range(3):
            ga = tet_gradient[tet, 3 * corner]
            gb = tet_gradient[tet, 3 * corner + 1]
            gc = tet_gradient[tet, 3 * corner + 2]
            h0 = s00 * ga + s01 * gb + s02 * gc
            h1 = s01 * ga + s11 * gb + s12 * gc
            h2 = s02 * ga + s12 * gb + s22 * gc
            k = row + 3 * corner + 3
            tet_gradient_out[w, k] = (q00 * ga + q01 * gb + q02 * gc) * root
            tet_gradient_out[w, k + 1] = (q10 * ga + q11 * gb + q12 * gc) * root
            tet_gradient_out[w, k + 2] = (q20 * ga + q21 * gb + q22 * gc) * root
            tet_force_out[w, k] = mul(q00, h0) + mul(q01, h1) + mul(q02, h2)
            tet_force_out[w, k + 1] = mul(q10, h0) + mul(q11, h1) + mul(q12, h2)
            tet_force_out[w, k + 2] = mul(q20, h0) + mul(q21, h1) + mul(q22, h2)
            for c in range(3):
                tet_gradient_out[w, row + c] -= tet_gradient_out[w, k + c]
                tet_force_out[w, row + c] -= tet_force_out[w, k + c]

    return SimpleNamespace(tet_force=tet_force)
