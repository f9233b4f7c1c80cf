"""Derivative of the rotation of ``large`` tets, for their exact tangent. Theory: docs/theory/corotational.md.

The forces are f_a = V Q S g_a with S = 2 mu eps + lam tr(eps) 1 and eps = sym(Q' F) - 1. Their derivative at a fixed
frame is the stiffness of ``corotational``. When the frame turns by the vector w, they change by w x f_a + V Q S_w g_a,
where S_w is the stress of the strain -sym(Q' [w] F), that is by B_a w with a 3x3 matrix B_a. The edges e = b - a and
f = c - a turn the frame by w = sum_n O_n dx_n. The rest of the tangent is thus B_a O_b, which is not symmetric: these
forces have no energy. With the frame e1, e2, e3, |e| = l and f = f1 e1 + f2 e2,

    w = e1 (e3.df - (f1 / l) e3.de) / f2 - e2 (e3.de) / l + e3 (e2.de) / l.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant

TURNING_ROWS = 54  # per tet: B of corners 1 to 3, then O of these; both sum to zero over the four corners


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Turning kernels for one scalar type."""
    S = variant.S
    real = variant.real
    mul = variant.mul
    world_fastest = variant.world_fastest
    module = variant.module("turning")
    one = single.functions(variant)
    vec3, mat33, vector_at = one.vec3, one.mat33, one.vector_at

    @wp.func
    def edge(x: wp.array3d(dtype=real), pack: int, lane: int, a: int, b: int):
        """x_b - x_a."""
        return vector_at(x, pack, lane, 3 * b) - vector_at(x, pack, lane, 3 * a)

    @wp.func
    def row(values: wp.array2d(dtype=real), i: int, k: int):
        """Three neighbouring entries."""
        return vec3(values[i, k], values[i, k + 1], values[i, k + 2])

    @wp.func
    def stress(G: mat33, mu: real, lam: real):
        """2 mu sym(G) + lam tr(G) 1."""
        return mu * (G + wp.transpose(G)) + lam * wp.trace(G) * wp.identity(n=3, dtype=real)

    @wp.func
    def turned_force(Q: mat33, F: mat33, strained: mat33, g: vec3, k: int, mu: real, lam: real):
        """Change of the force on a corner with the gradient g, per volume, where the frame turns about axis k."""
        axis = vec3()
        axis[k] = real(1.0)
        turned = stress(-(wp.transpose(Q) * (wp.skew(axis) * F)), mu, lam)
        return wp.cross(axis, Q * (strained * g)) + Q * (turned * g)

    @wp.kernel(module=module, enable_backward=False)
    def tet_turning(
        # Model
        tet_index: wp.array(dtype=wp.int32),
        tet_node: wp.array2d(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        tet_gradient: wp.array2d(dtype=real),
        tet_volume: wp.array(dtype=real),
        tet_frame: wp.array2d(dtype=real),
        # Workspace in
        body_mu_in: wp.array3d(dtype=real),
        body_lam_in: wp.array3d(dtype=real),
        node_x_in: wp.array3d(dtype=real),
        # Workspace out
        tet_turning_out: wp.array3d(dtype=real),
    ):
        """B [N] and O [1/m] of corners 1 to 3 of one tet, row by row."""
        pack, item, lane = wp.tid()
        tet = tet_index[item]
        mu = body_mu_in[pack, tet_body[tet], lane]
        lam = body_lam_in[pack, tet_body[tet], lane]
        e = edge(node_x_in, pack, lane, tet_node[tet, 0], tet_node[tet, 1])
        f = edge(node_x_in, pack, lane, tet_node[tet, 0], tet_node[tet, 2])
        d = edge(node_x_in, pack, lane, tet_node[tet, 0], tet_node[tet, 3])
        length = wp.length(e)
        e1 = e / length
        e3 = wp.normalize(wp.cross(e1, f))
        e2 = wp.cross(e3, e1)
        R0 = wp.matrix_from_rows(row(tet_frame, tet, 0), row(tet_frame, tet, 3), row(tet_frame, tet, 6))
        Q = wp.matrix_from_cols(e1, e2, e3) * wp.transpose(R0)
        F = wp.outer(e, row(tet_gradient, tet, 0))
        F += wp.outer(f, row(tet_gradient, tet, 3))
        F += wp.outer(d, row(tet_gradient, tet, 6))
        strained = stress(wp.transpose(Q) * F - wp.identity(n=3, dtype=real), mu, lam)
        for corner in range(3):
            for k in range(3):
                column = turned_force(Q, F, strained, row(tet_gradient, tet, 3 * corner), k, mu, lam)
                for c in range(3):
                    tet_turning_out[pack, 54 * tet + 9 * corner + 3 * c + k, lane] = tet_volume[tet] * column[c]
        f2 = wp.dot(f, e2)
        by_f = wp.outer(e1, e3) / f2
        by_e = (wp.outer(e3, e2) - wp.outer(e2, e3)) / length - (wp.dot(f, e1) / length) * by_f
        for r in range(3):
            for c in range(3):
                tet_turning_out[pack, 54 * tet + 27 + 3 * r + c, lane] = by_e[r, c]
                tet_turning_out[pack, 54 * tet + 36 + 3 * r + c, lane] = by_f[r, c]
                tet_turning_out[pack, 54 * tet + 45 + 3 * r + c, lane] = real(0.0)

    @wp.kernel(module=module, enable_backward=False)
    def warped_turning(
        # Model
        tet_index: wp.array(dtype=wp.int32),
        tet_node: wp.array2d(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        tet_gradient: wp.array2d(dtype=real),
        tet_volume: wp.array(dtype=real),
        tet_frame: wp.array2d(dtype=real),
        # Workspace in
        body_mu_in: wp.array3d(dtype=real),
        body_lam_in: wp.array3d(dtype=real),
        node_x_in: wp.array3d(dtype=real),
        # Workspace out
        tet_turning_out: wp.array3d(dtype=real),
    ):
        """The same of one ``warped`` tet, whose rotation is the polar one: O_b = Q (tr S 1 - S)^-1 [g_b] Q'."""
        pack, item, lane = wp.tid()
        tet = tet_index[item]
        mu = body_mu_in[pack, tet_body[tet], lane]
        lam = body_lam_in[pack, tet_body[tet], lane]
        e = edge(node_x_in, pack, lane, tet_node[tet, 0], tet_node[tet, 1])
        f = edge(node_x_in, pack, lane, tet_node[tet, 0], tet_node[tet, 2])
        d = edge(node_x_in, pack, lane, tet_node[tet, 0], tet_node[tet, 3])
        F = wp.outer(e, row(tet_gradient, tet, 0))
        F += wp.outer(f, row(tet_gradient, tet, 3))
        F += wp.outer(d, row(tet_gradient, tet, 6))
        U, s, V = wp.svd3(F)
        Q = U * wp.transpose(V)
        one = wp.identity(n=3, dtype=real)
        strained = stress(wp.transpose(Q) * F - one, mu, lam)
        pairs = vec3()
        for k in range(3):
            pairs[k] = real(1.0) / wp.max(s[(k + 1) % 3] + s[(k + 2) % 3], real(1.0e-3))
        turn = U * wp.diag(pairs) * wp.transpose(V)
        for corner in range(3):
            g = row(tet_gradient, tet, 3 * corner)
            omega = turn * wp.skew(g) * wp.transpose(Q)
            for k in range(3):
                column = turned_force(Q, F, strained, g, k, mu, lam)
                for c in range(3):
                    tet_turning_out[pack, 54 * tet + 9 * corner + 3 * c + k, lane] = tet_volume[tet] * column[c]
                    tet_turning_out[pack, 54 * tet + 27 + 9 * corner + 3 * c + k, lane] = omega[c, k]

    @wp.func
    def corner_value(turning: wp.array2d(dtype=S), w: int, first: int, corner: int, entry: int):
        """Entry of B or O of a corner; those of all corners sum to zero."""
        value = S(real(0.0))
        if corner == 0:
            for other in range(3):
                value -= turning[w, first + 9 * other + entry]
        else:
            value = turning[w, first + 9 * (corner - 1) + entry]
        return value

    @wp.func
    def product(turning: wp.array2d(dtype=S), w: int, tet: int, a: int, b: int, r: int, c: int):
        """Entry (r, c) of B_a O_b."""
        total = S(real(0.0))
        for k in range(3):
            left = corner_value(turning, w, 54 * tet, a, 3 * r + k)
            total += mul(left, corner_value(turning, w, 54 * tet + 27, b, 3 * k + c))
        return total

    @wp.kernel(module=module, enable_backward=False)
    def block_turning(
        scale: real,
        # Model
        entry_start: wp.array(dtype=wp.int32),
        entry: wp.array(dtype=wp.int32),
        # Workspace in
        tet_turning_in: wp.array2d(dtype=S),
        # Workspace out
        a_out: wp.array2d(dtype=S),
        a_upper_out: wp.array2d(dtype=S),
    ):
        """Add B_a O_b of all tets around one 3x3 block (i, j), and the transpose of that of block (j, i), scaled.

        Both may go to the same A, which then has twice the symmetric part.
        """
        w, block = wp.tid()
        if wp.static(world_fastest):
            block, w = wp.tid()
        for r in range(3):
            for c in range(3):
                below = S(real(0.0))
                above = S(real(0.0))
                for p in range(entry_start[block], entry_start[block + 1]):
                    a = (entry[p] >> 2) & 3
                    b = entry[p] & 3
                    below += product(tet_turning_in, w, entry[p] >> 4, a, b, r, c)
                    above += product(tet_turning_in, w, entry[p] >> 4, b, a, c, r)
                a_out[w, 9 * block + 3 * r + c] += mul(S(scale), below)
                a_upper_out[w, 9 * block + 3 * r + c] += mul(S(scale), above)

    return SimpleNamespace(tet_turning=tet_turning, warped_turning=warped_turning, block_turning=block_turning)
