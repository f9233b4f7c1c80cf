"""Numeric block Cholesky of all worlds on one shared structure. Theory, symbols and checks: docs/theory/cholesky.md.

``A = L L'`` with 3x3 blocks. The diagonal blocks of ``L`` are kept as their inverses ``Li`` (lower, row by row), so the
triangular solves multiply and never divide. Rows of the arrays: block b, entry (r, c) at ``9 b + 3 r + c``; diagonal
inverse of column j at ``6 j``; entry c of right-hand side s of row i at ``3 (s n + i) + c``.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Compile-once set of kernels for one scalar type."""
    S = variant.S
    mul, fma, sqrt, div = variant.mul, variant.fma, variant.sqrt, variant.div
    module = variant.module("cholesky")

    @wp.func
    def block_gather(
        lower: wp.array2d(dtype=S),
        w: int,
        pair_begin: int,
        pair_end: int,
        pair_left: wp.array(dtype=wp.int32),
        pair_right: wp.array(dtype=wp.int32),
    ):
        """Sum of ``L_ik L_jk'`` over the pairs of one block."""
        s00 = S(0.0)
        s01 = S(0.0)
        s02 = S(0.0)
        s10 = S(0.0)
        s11 = S(0.0)
        s12 = S(0.0)
        s20 = S(0.0)
        s21 = S(0.0)
        s22 = S(0.0)
        for p in range(pair_begin, pair_end):
            i = pair_left[p] * 9
            j = pair_right[p] * 9
            for c in range(3):
                b0 = lower[w, j + c]
                b1 = lower[w, j + 3 + c]
                b2 = lower[w, j + 6 + c]
                a0 = lower[w, i + c]
                a1 = lower[w, i + 3 + c]
                a2 = lower[w, i + 6 + c]
                s00 = fma(a0, b0, s00)
                s01 = fma(a0, b1, s01)
                s02 = fma(a0, b2, s02)
                s10 = fma(a1, b0, s10)
                s11 = fma(a1, b1, s11)
                s12 = fma(a1, b2, s12)
                s20 = fma(a2, b0, s20)
                s21 = fma(a2, b1, s21)
                s22 = fma(a2, b2, s22)
        return s00, s01, s02, s10, s11, s12, s20, s21, s22

    @wp.func
    def diagonal_inverse(d00: S, d10: S, d11: S, d20: S, d21: S, d22: S):
        """Inverse of the lower Cholesky factor of a symmetric 3x3 block, row by row."""
        one = S(1.0)
        i00 = div(one, sqrt(d00))
        l10 = mul(d10, i00)
        l20 = mul(d20, i00)
        i11 = div(one, sqrt(d11 - mul(l10, l10)))
        l21 = mul(d21 - mul(l20, l10), i11)
        i22 = div(one, sqrt(d22 - mul(l20, l20) - mul(l21, l21)))
        i10 = -mul(mul(l10, i00), i11)
        i21 = -mul(mul(l21, i11), i22)
        i20 = -mul(mul(l20, i00) + mul(l21, i10), i22)
        return i00, i10, i11, i20, i21, i22

    @wp.func
    def block_update(
        a: wp.array2d(dtype=S),
        lower: wp.array2d(dtype=S),
        w: int,
        block: int,
        l_source: wp.array(dtype=wp.int32),
        pair_start: wp.array(dtype=wp.int32),
        pair_left: wp.array(dtype=wp.int32),
        pair_right: wp.array(dtype=wp.int32),
    ):
        """``A_ij - sum_k L_ik L_jk'`` of one block."""
        s00, s01, s02, s10, s11, s12, s20, s21, s22 = block_gather(
            lower, w, pair_start[block], pair_start[block + 1], pair_left, pair_right
        )
        source = l_source[block]
        t = source * 9
        if source >= 0:
            return (
                a[w, t] - s00,
                a[w, t + 1] - s01,
                a[w, t + 2] - s02,
                a[w, t + 3] - s10,
                a[w, t + 4] - s11,
                a[w, t + 5] - s12,
                a[w, t + 6] - s20,
                a[w, t + 7] - s21,
                a[w, t + 8] - s22,
            )
        return -s00, -s01, -s02, -s10, -s11, -s12, -s20, -s21, -s22

    @wp.func
    def store_scaled(
        lower: wp.array2d(dtype=S),
        w: int,
        row: int,
        s0: S,
        s1: S,
        s2: S,
        i00: S,
        i10: S,
        i11: S,
        i20: S,
        i21: S,
        i22: S,
    ):
        """Write one row of ``S Li'``."""
        lower[w, row] = mul(s0, i00)
        lower[w, row + 1] = mul(s0, i10) + mul(s1, i11)
        lower[w, row + 2] = mul(s0, i20) + mul(s1, i21) + mul(s2, i22)

    @wp.kernel(module=module, enable_backward=False)
    def factor_world(
        # Symbolic
        size: int,
        col_start: wp.array(dtype=wp.int32),
        l_source: wp.array(dtype=wp.int32),
        pair_start: wp.array(dtype=wp.int32),
        pair_left: wp.array(dtype=wp.int32),
        pair_right: wp.array(dtype=wp.int32),
        # Workspace in
        a_in: wp.array2d(dtype=S),
        # Workspace out
        lower_out: wp.array2d(dtype=S),
        diagonal_out: wp.array2d(dtype=S),
    ):
        """Factorise one world (or one pack of worlds) column by column."""
        w = wp.tid()
        for j in range(size):
            s00, s01, s02, s10, s11, s12, s20, s21, s22 = block_update(
                a_in, lower_out, w, j, l_source, pair_start, pair_left, pair_right
            )
            i00, i10, i11, i20, i21, i22 = diagonal_inverse(s00, s10, s11, s20, s21, s22)
            d = j * 6
            diagonal_out[w, d] = i00
            diagonal_out[w, d + 1] = i10
            diagonal_out[w, d + 2] = i11
            diagonal_out[w, d + 3] = i20
            diagonal_out[w, d + 4] = i21
            diagonal_out[w, d + 5] = i22
            for block in range(col_start[j], col_start[j + 1]):
                t00, t01, t02, t10, t11, t12, t20, t21, t22 = block_update(
                    a_in, lower_out, w, block, l_source, pair_start, pair_left, pair_right
                )
                row = block * 9
                store_scaled(lower_out, w, row, t00, t01, t02, i00, i10, i11, i20, i21, i22)
                store_scaled(lower_out, w, row + 3, t10, t11, t12, i00, i10, i11, i20, i21, i22)
                store_scaled(lower_out, w, row + 6, t20, t21, t22, i00, i10, i11, i20, i21, i22)

    @wp.func
    def store_solved(
        y: wp.array2d(dtype=S), w: int, t: int, y0: S, y1: S, y2: S, diagonal: wp.array2d(dtype=S), d: int
    ):
        """Write ``Li y``."""
        y[w, t] = mul(diagonal[w, d], y0)
        y[w, t + 1] = mul(diagonal[w, d + 1], y0) + mul(diagonal[w, d + 2], y1)
        y[w, t + 2] = mul(diagonal[w, d + 3], y0) + mul(diagonal[w, d + 4], y1) + mul(diagonal[w, d + 5], y2)

    @wp.func
    def forward_row(
        lower: wp.array2d(dtype=S),
        diagonal: wp.array2d(dtype=S),
        y: wp.array2d(dtype=S),
        w: int,
        i: int,
        l_col: wp.array(dtype=wp.int32),
        row_start: wp.array(dtype=wp.int32),
        row_block: wp.array(dtype=wp.int32),
    ):
        """``y_i <- Li_i (y_i - sum_j L_ij y_j)`` in place."""
        t = 3 * i
        y0 = y[w, t]
        y1 = y[w, t + 1]
        y2 = y[w, t + 2]
        for p in range(row_start[i], row_start[i + 1]):
            block = row_block[p]
            b = block * 9
            j = 3 * l_col[block]
            for c in range(3):
                yj = -y[w, j + c]
                y0 = fma(lower[w, b + c], yj, y0)
                y1 = fma(lower[w, b + 3 + c], yj, y1)
                y2 = fma(lower[w, b + 6 + c], yj, y2)
        store_solved(y, w, t, y0, y1, y2, diagonal, i * 6)

    @wp.func
    def forward_row3(
        lower: wp.array2d(dtype=S),
        diagonal: wp.array2d(dtype=S),
        y: wp.array2d(dtype=S),
        w: int,
        i: int,
        offset: int,
        stride: int,
        l_col: wp.array(dtype=wp.int32),
        row_start: wp.array(dtype=wp.int32),
        row_block: wp.array(dtype=wp.int32),
    ):
        """``forward_row`` for three right-hand sides at once, so that L is read a third as often."""
        t = offset + 3 * i
        a0 = y[w, t]
        a1 = y[w, t + 1]
        a2 = y[w, t + 2]
        b0 = y[w, t + stride]
        b1 = y[w, t + stride + 1]
        b2 = y[w, t + stride + 2]
        c0 = y[w, t + 2 * stride]
        c1 = y[w, t + 2 * stride + 1]
        c2 = y[w, t + 2 * stride + 2]
        for p in range(row_start[i], row_start[i + 1]):
            block = row_block[p]
            b = block * 9
            j = offset + 3 * l_col[block]
            for c in range(3):
                l0 = lower[w, b + c]
                l1 = lower[w, b + 3 + c]
                l2 = lower[w, b + 6 + c]
                ya = -y[w, j + c]
                yb = -y[w, j + stride + c]
                yc = -y[w, j + 2 * stride + c]
                a0 = fma(l0, ya, a0)
                a1 = fma(l1, ya, a1)
                a2 = fma(l2, ya, a2)
                b0 = fma(l0, yb, b0)
                b1 = fma(l1, yb, b1)
                b2 = fma(l2, yb, b2)
                c0 = fma(l0, yc, c0)
                c1 = fma(l1, yc, c1)
                c2 = fma(l2, yc, c2)
        d = i * 6
        store_solved(y, w, t, a0, a1, a2, diagonal, d)
        store_solved(y, w, t + stride, b0, b1, b2, diagonal, d)
        store_solved(y, w, t + 2 * stride, c0, c1, c2, diagonal, d)

    @wp.func
    def backward_row(
        lower: wp.array2d(dtype=S),
        diagonal: wp.array2d(dtype=S),
        y: wp.array2d(dtype=S),
        w: int,
        j: int,
        l_row: wp.array(dtype=wp.int32),
        col_start: wp.array(dtype=wp.int32),
    ):
        """``x_j <- Li_j' (y_j - sum_i L_ij' x_i)`` in place."""
        t = 3 * j
        y0 = y[w, t]
        y1 = y[w, t + 1]
        y2 = y[w, t + 2]
        for block in range(col_start[j], col_start[j + 1]):
            b = block * 9
            i = 3 * l_row[block]
            for r in range(3):
                xi = -y[w, i + r]
                y0 = fma(lower[w, b + 3 * r], xi, y0)
                y1 = fma(lower[w, b + 3 * r + 1], xi, y1)
                y2 = fma(lower[w, b + 3 * r + 2], xi, y2)
        d = j * 6
        y[w, t] = mul(diagonal[w, d], y0) + mul(diagonal[w, d + 1], y1) + mul(diagonal[w, d + 3], y2)
        y[w, t + 1] = mul(diagonal[w, d + 2], y1) + mul(diagonal[w, d + 4], y2)
        y[w, t + 2] = mul(diagonal[w, d + 5], y2)

    @wp.kernel(module=module, enable_backward=False)
    def forward_world(
        # Symbolic
        size: int,
        l_col: wp.array(dtype=wp.int32),
        row_start: wp.array(dtype=wp.int32),
        row_block: wp.array(dtype=wp.int32),
        # Workspace in
        lower_in: wp.array2d(dtype=S),
        diagonal_in: wp.array2d(dtype=S),
        # Workspace out
        y_out: wp.array2d(dtype=S),
    ):
        """Forward substitution of the first right-hand side of one world."""
        w = wp.tid()
        for i in range(size):
            forward_row(lower_in, diagonal_in, y_out, w, i, l_col, row_start, row_block)

    @wp.kernel(module=module, enable_backward=False)
    def forward_world3(
        # Symbolic
        size: int,
        l_col: wp.array(dtype=wp.int32),
        row_start: wp.array(dtype=wp.int32),
        row_block: wp.array(dtype=wp.int32),
        # Workspace in
        lower_in: wp.array2d(dtype=S),
        diagonal_in: wp.array2d(dtype=S),
        # Workspace out
        y_out: wp.array2d(dtype=S),
    ):
        """Forward substitution of three consecutive right-hand sides of one world."""
        w, group = wp.tid()
        for i in range(size):
            forward_row3(lower_in, diagonal_in, y_out, w, i, 9 * size * group, 3 * size, l_col, row_start, row_block)

    @wp.kernel(module=module, enable_backward=False)
    def backward_world(
        # Symbolic
        size: int,
        l_row: wp.array(dtype=wp.int32),
        col_start: wp.array(dtype=wp.int32),
        # Workspace in
        lower_in: wp.array2d(dtype=S),
        diagonal_in: wp.array2d(dtype=S),
        # Workspace out
        y_out: wp.array2d(dtype=S),
    ):
        """Backward substitution of the first right-hand side of one world."""
        w = wp.tid()
        for item in range(size):
            backward_row(lower_in, diagonal_in, y_out, w, size - 1 - item, l_row, col_start)

    return SimpleNamespace(
        factor_world=factor_world,
        forward_world=forward_world,
        forward_world3=forward_world3,
        backward_world=backward_world,
        block_update=block_update,
        diagonal_inverse=diagonal_inverse,
        store_scaled=store_scaled,
        store_solved=store_solved,
    )
