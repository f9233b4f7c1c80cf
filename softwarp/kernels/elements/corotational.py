"""Corotational linear tetrahedra with the rotation of the element's edges. Theory: docs/theory/corotational.md.

The frame of a tet is e1 along edge ab, e3 normal to abc, e2 = e3 x e1; Q turns the rest frame into the present one.
Strain is linear in the turned-back deformation gradient, eps = sym(Q' F) - 1, and the tangent drops dQ:
K_ab = V [lam ga gb' + mu gb ga' + mu (ga . gb) 1] with the rotated shape gradients ga = Q grad N_a. It is symmetric
positive semidefinite for every configuration. Reference: Nesme, Payan, Faure (2005); Felippa (2000).
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import wide
from softwarp.kernels.algebra.lanes import Variant

TURNED_ROWS = 12  # per tet: turned gradients of its corners
TURNED_BITS = 2  # of a corner in an entry


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels of the ``large`` corotational tet for one scalar type."""
    S = variant.S
    real = variant.real
    mul, fma, div, sqrt = variant.mul, variant.fma, variant.div, variant.sqrt
    world_fastest = variant.world_fastest
    module = variant.module("corotational")

    @wp.func
    def element_frame(e0: S, e1: S, e2: S, f0: S, f1: S, f2: S):
        """Columns of the frame spanned by the edges e = b - a and f = c - a."""
        n = div(S(real(1.0)), sqrt(mul(e0, e0) + mul(e1, e1) + mul(e2, e2)))
        a0 = mul(e0, n)
        a1 = mul(e1, n)
        a2 = mul(e2, n)
        c0 = mul(a1, f2) - mul(a2, f1)
        c1 = mul(a2, f0) - mul(a0, f2)
        c2 = mul(a0, f1) - mul(a1, f0)
        n = div(S(real(1.0)), sqrt(mul(c0, c0) + mul(c1, c1) + mul(c2, c2)))
        c0 = mul(c0, n)
        c1 = mul(c1, n)
        c2 = mul(c2, n)
        b0 = mul(c1, a2) - mul(c2, a1)
        b1 = mul(c2, a0) - mul(c0, a2)
        b2 = mul(c0, a1) - mul(c1, a0)
        return a0, a1, a2, b0, b1, b2, c0, c1, c2

    @wp.func
    def turn_back(q00: S, q01: S, q02: S, q10: S, q11: S, q12: S, q20: S, q21: S, q22: S, e0: S, e1: S, e2: S):
        """Q' e."""
        return (
            mul(q00, e0) + mul(q10, e1) + mul(q20, e2),
            mul(q01, e0) + mul(q11, e1) + mul(q21, e2),
            mul(q02, e0) + mul(q12, e1) + mul(q22, e2),
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
        xa = node_x_in[w, na]
        ya = node_x_in[w, na + 1]
        za = node_x_in[w, na + 2]
        b0 = node_x_in[w, nb] - xa
        b1 = node_x_in[w, nb + 1] - ya
        b2 = node_x_in[w, nb + 2] - za
        c0 = node_x_in[w, nc] - xa
        c1 = node_x_in[w, nc + 1] - ya
        c2 = node_x_in[w, nc + 2] - za
        d0 = node_x_in[w, nd] - xa
        d1 = node_x_in[w, nd + 1] - ya
        d2 = node_x_in[w, nd + 2] - za
        r00, r10, r20, r01, r11, r21, r02, r12, r22 = element_frame(b0, b1, b2, c0, c1, c2)

        # Q = R R0', with tet_frame holding R0 row by row
        s00 = tet_frame[tet, 0]
        s01 = tet_frame[tet, 1]
        s02 = tet_frame[tet, 2]
        s10 = tet_frame[tet, 3]
        s11 = tet_frame[tet, 4]
        s12 = tet_frame[tet, 5]
        s20 = tet_frame[tet, 6]
        s21 = tet_frame[tet, 7]
        s22 = tet_frame[tet, 8]
        q00 = r00 * s00 + r01 * s01 + r02 * s02
        q01 = r00 * s10 + r01 * s11 + r02 * s12
        q02 = r00 * s20 + r01 * s21 + r02 * s22
        q10 = r10 * s00 + r11 * s01 + r12 * s02
        q11 = r10 * s10 + r11 * s11 + r12 * s12
        q12 = r10 * s20 + r11 * s21 + r12 * s22
        q20 = r20 * s00 + r21 * s01 + r22 * s02
        q21 = r20 * s10 + r21 * s11 + r22 * s12
        q22 = r20 * s20 + r21 * s21 + r22 * s22

        # edges turned back, Q' e
        u0, u1, u2 = turn_back(q00, q01, q02, q10, q11, q12, q20, q21, q22, b0, b1, b2)
        v0, v1, v2 = turn_back(q00, q01, q02, q10, q11, q12, q20, q21, q22, c0, c1, c2)
        t0, t1, t2 = turn_back(q00, q01, q02, q10, q11, q12, q20, q21, q22, d0, d1, d2)

        g10 = tet_gradient[tet, 0]
        g11 = tet_gradient[tet, 1]
        g12 = tet_gradient[tet, 2]
        g20 = tet_gradient[tet, 3]
        g21 = tet_gradient[tet, 4]
        g22 = tet_gradient[tet, 5]
        g30 = tet_gradient[tet, 6]
        g31 = tet_gradient[tet, 7]
        g32 = tet_gradient[tet, 8]
        one = S(real(1.0))
        half = real(0.5)
        # eps = sym(Q' F) - 1 with Q' F = sum (Q' e_b) g_b'
        e00 = u0 * g10 + v0 * g20 + t0 * g30 - one
        e11 = u1 * g11 + v1 * g21 + t1 * g31 - one
        e22 = u2 * g12 + v2 * g22 + t2 * g32 - one
        e01 = (u0 * g11 + v0 * g21 + t0 * g31 + u1 * g10 + v1 * g20 + t1 * g30) * half
        e02 = (u0 * g12 + v0 * g22 + t0 * g32 + u2 * g10 + v2 * g20 + t2 * g30) * half
        e12 = (u1 * g12 + v1 * g22 + t1 * g32 + u2 * g11 + v2 * g21 + t2 * g31) * half

        body = tet_body[tet]
        volume = tet_volume[tet]
        two_mu = body_mu_in[w, body] * (volume + volume)
        pressure = mul(body_lam_in[w, body] * volume, e00 + e11 + e22)
        s_00 = mul(two_mu, e00) + pressure
        s_11 = mul(two_mu, e11) + pressure
        s_22 = mul(two_mu, e22) + pressure
        s_01 = mul(two_mu, e01)
        s_02 = mul(two_mu, e02)
        s_12 = mul(two_mu, e12)

        root = wp.sqrt(volume)
        row = tet * 12
        t_0 = S(real(0.0))
        t_1 = S(real(0.0))
        t_2 = S(real(0.0))
        r_0 = S(real(0.0))
        r_1 = S(real(0.0))
        r_2 = S(real(0.0))
        for corner in range(3):
            ga = tet_gradient[tet, 3 * corner]
            gb = tet_gradient[tet, 3 * corner + 1]
            gc = tet_gradient[tet, 3 * corner + 2]
            g0 = (q00 * ga + q01 * gb + q02 * gc) * root
            g1 = (q10 * ga + q11 * gb + q12 * gc) * root
            g2 = (q20 * ga + q21 * gb + q22 * gc) * root
            h0 = s_00 * ga + s_01 * gb + s_02 * gc
            h1 = s_01 * ga + s_11 * gb + s_12 * gc
            h2 = s_02 * ga + s_12 * gb + s_22 * gc
            f0 = mul(q00, h0) + mul(q01, h1) + mul(q02, h2)
            f1 = mul(q10, h0) + mul(q11, h1) + mul(q12, h2)
            f2 = mul(q20, h0) + mul(q21, h1) + mul(q22, h2)
            k = row + 3 * corner + 3
            tet_gradient_out[w, k] = g0
            tet_gradient_out[w, k + 1] = g1
            tet_gradient_out[w, k + 2] = g2
            tet_force_out[w, k] = f0
            tet_force_out[w, k + 1] = f1
            tet_force_out[w, k + 2] = f2
            r_0 -= g0
            r_1 -= g1
            r_2 -= g2
            t_0 -= f0
            t_1 -= f1
            t_2 -= f2
        tet_gradient_out[w, row] = r_0
        tet_gradient_out[w, row + 1] = r_1
        tet_gradient_out[w, row + 2] = r_2
        tet_force_out[w, row] = t_0
        tet_force_out[w, row + 1] = t_1
        tet_force_out[w, row + 2] = t_2

    @wp.func
    def outer_each(
        gradient: wp.array2d(dtype=S),
        w: int,
        begin: int,
        end: int,
        entry: wp.array(dtype=wp.int32),
        rows: int,
        bits: int,
    ):
        """Sum of ``g_a g_b'`` over pairs of an element's nodes; an entry is 4^bits element + 2^bits a + b."""
        mask = (1 << bits) - 1
        x00 = S(real(0.0))
        x01 = S(real(0.0))
        x02 = S(real(0.0))
        x10 = S(real(0.0))
        x11 = S(real(0.0))
        x12 = S(real(0.0))
        x20 = S(real(0.0))
        x21 = S(real(0.0))
        x22 = S(real(0.0))
        for p in range(begin, end):
            code = entry[p]
            row = (code >> (2 * bits)) * rows
            i = row + 3 * ((code >> bits) & mask)
            j = row + 3 * (code & mask)
            a0 = gradient[w, i]
            a1 = gradient[w, i + 1]
            a2 = gradient[w, i + 2]
            b0 = gradient[w, j]
            b1 = gradient[w, j + 1]
            b2 = gradient[w, j + 2]
            x00 = fma(a0, b0, x00)
            x01 = fma(a0, b1, x01)
            x02 = fma(a0, b2, x02)
            x10 = fma(a1, b0, x10)
            x11 = fma(a1, b1, x11)
            x12 = fma(a1, b2, x12)
            x20 = fma(a2, b0, x20)
            x21 = fma(a2, b1, x21)
            x22 = fma(a2, b2, x22)
        return x00, x01, x02, x10, x11, x12, x20, x21, x22

    @wp.func
    def outer_wide(
        gradient: wp.array2d(dtype=wp.float32),
        w: int,
        begin: int,
        end: int,
        entry: wp.array(dtype=wp.int32),
        rows: int,
        bits: int,
    ):
        """The same for one world in float32."""
        x = wide.outer_sum(gradient, w, begin, end, entry, rows, bits)
        return x[0], x[1], x[2], x[3], x[4], x[5], x[6], x[7], x[8]

    outer_sum = outer_wide if wide.is_wide(variant) else outer_each

    @wp.kernel(module=module, enable_backward=False)
    def block_stiffness(
        rows: int,
        bits: int,
        # Model
        tet_body: wp.array(dtype=wp.int32),
        entry_start: wp.array(dtype=wp.int32),
        entry: wp.array(dtype=wp.int32),
        # Workspace in
        body_mu_in: wp.array2d(dtype=S),
        body_lam_in: wp.array2d(dtype=S),
        body_stiffness_scale_in: wp.array2d(dtype=S),
        tet_gradient_in: wp.array2d(dtype=S),
        # Workspace out
        a_out: wp.array2d(dtype=S),
    ):
        """Add the stiffness of all turned tets, or Gauss points of quadratic ones, around one 3x3 block of A.

        An entry is 4^bits tet + 2^bits a + b, a tet has ``rows`` rows of gradients.
        With X = sum V ga gb' over the tets, the block is lam X + mu X' + mu tr(X) 1.
        """
        w, block = wp.tid()
        if wp.static(world_fastest):
            block, w = wp.tid()
        begin = entry_start[block]
        end = entry_start[block + 1]
        if begin < end:
            x00, x01, x02, x10, x11, x12, x20, x21, x22 = outer_sum(tet_gradient_in, w, begin, end, entry, rows, bits)
            body = tet_body[entry[begin] >> (2 * bits)]
            scale = body_stiffness_scale_in[w, body]
            mu = mul(scale, body_mu_in[w, body])
            lam = mul(scale, body_lam_in[w, body])
            trace = mul(mu, x00 + x11 + x22)
            both = mu + lam
            row = block * 9
            a_out[w, row] += mul(both, x00) + trace
            a_out[w, row + 1] += mul(lam, x01) + mul(mu, x10)
            a_out[w, row + 2] += mul(lam, x02) + mul(mu, x20)
            a_out[w, row + 3] += mul(lam, x10) + mul(mu, x01)
            a_out[w, row + 4] += mul(both, x11) + trace
            a_out[w, row + 5] += mul(lam, x12) + mul(mu, x21)
            a_out[w, row + 6] += mul(lam, x20) + mul(mu, x02)
            a_out[w, row + 7] += mul(lam, x21) + mul(mu, x12)
            a_out[w, row + 8] += mul(both, x22) + trace

    return SimpleNamespace(element_frame=element_frame, tet_force=tet_force, block_stiffness=block_stiffness)
