"""Numeric block LU of all worlds on one shared structure, for unsymmetric tangents. Theory: docs/theory/statics.md.

``A = L U`` with 3x3 blocks, without pivoting; L has unit diagonal blocks. The pattern is symmetric, so one block index
serves both factors: block b = (i, j), i > j, holds L_ij in ``lower`` and the transpose of U_ji in ``upper``, as
``a_upper`` holds the transpose of A_ji. The inverse of U_jj stands in the diagonal block j of ``lower``. Entry (r, c)
of block b is at ``9 b + 3 r + c``; entry c of right-hand side s of row i at ``3 (s n + i) + c``.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """LU kernels for one scalar type."""
    S = variant.S
    real = variant.real
    mul, div = variant.mul, variant.div
    module = variant.module("lu")

    @wp.func
    def update(
        a: wp.array2d(dtype=S),
        left: wp.array2d(dtype=S),
        right: wp.array2d(dtype=S),
        w: int,
        block: int,
        l_source: wp.array(dtype=wp.int32),
        pair_start: wp.array(dtype=wp.int32),
        pair_left: wp.array(dtype=wp.int32),
        pair_right: wp.array(dtype=wp.int32),
    ):
        """``A_ij - sum_k X_ik Y_jk'`` of one block, with X in ``left`` and Y in ``right``."""
        s00 = S(real(0.0))
        s01 = S(real(0.0))
        s02 = S(real(0.0))
        s10 = S(real(0.0))
        s11 = S(real(0.0))
        s12 = S(real(0.0))
        s20 = S(real(0.0))
        s21 = S(real(0.0))
        s22 = S(real(0.0))
        source = l_source[block]
        if source >= 0:
            t = 9 * source
            s00 = a[w, t]
            s01 = a[w, t + 1]
            s02 = a[w, t + 2]
            s10 = a[w, t + 3]
            s11 = a[w, t + 4]
            s12 = a[w, t + 5]
            s20 = a[w, t + 6]
            s21 = a[w, t + 7]
            s22 = a[w, t + 8]
        for p in range(pair_start[block], pair_start[block + 1]):
            i = pair_left[p] * 9
            j = pair_right[p] * 9
            for c in range(3):
                b0 = right[w, j + c]
                b1 = right[w, j + 3 + c]
                b2 = right[w, j + 6 + c]
                a0 = left[w, i + c]
                a1 = left[w, i + 3 + c]
                a2 = left[w, i + 6 + c]
                s00 -= mul(a0, b0)
                s01 -= mul(a0, b1)
                s02 -= mul(a0, b2)
                s10 -= mul(a1, b0)
                s11 -= mul(a1, b1)
                s12 -= mul(a1, b2)
                s20 -= mul(a2, b0)
                s21 -= mul(a2, b1)
                s22 -= mul(a2, b2)
        return s00, s01, s02, s10, s11, s12, s20, s21, s22

    @wp.func
    def below_zero(value: S):
        """1 where a value is negative, 0 where it is positive."""
        return (S(real(1.0)) - div(value, wp.max(value, -value))) * real(0.5)

    @wp.func
    def invert_diagonal(
        lower: wp.array2d(dtype=S),
        pivot: wp.array2d(dtype=S),
        w: int,
        j: int,
        d00: S,
        d01: S,
        d02: S,
        d10: S,
        d11: S,
        d12: S,
        d20: S,
        d21: S,
        d22: S,
    ):
        """Inverse of U_jj, and how many of its three scalar pivots are negative."""
        c00 = mul(d11, d22) - mul(d12, d21)
        c10 = mul(d12, d20) - mul(d10, d22)
        c20 = mul(d10, d21) - mul(d11, d20)
        minor = mul(d00, d11) - mul(d01, d10)
        determinant = mul(d00, c00) + mul(d01, c10) + mul(d02, c20)
        inverse = div(S(real(1.0)), determinant)
        t = 9 * j
        lower[w, t] = mul(c00, inverse)
        lower[w, t + 1] = mul(mul(d02, d21) - mul(d01, d22), inverse)
        lower[w, t + 2] = mul(mul(d01, d12) - mul(d02, d11), inverse)
        lower[w, t + 3] = mul(c10, inverse)
        lower[w, t + 4] = mul(mul(d00, d22) - mul(d02, d20), inverse)
        lower[w, t + 5] = mul(mul(d02, d10) - mul(d00, d12), inverse)
        lower[w, t + 6] = mul(c20, inverse)
        lower[w, t + 7] = mul(mul(d01, d20) - mul(d00, d21), inverse)
        lower[w, t + 8] = mul(minor, inverse)
        pivot[w, j] = below_zero(d00) + below_zero(div(minor, d00)) + below_zero(div(determinant, minor))

    @wp.func
    def factor_diagonal(
        a: wp.array2d(dtype=S),
        lower: wp.array2d(dtype=S),
        upper: wp.array2d(dtype=S),
        pivot: wp.array2d(dtype=S),
        w: int,
        j: int,
        l_source: wp.array(dtype=wp.int32),
        pair_start: wp.array(dtype=wp.int32),
        pair_left: wp.array(dtype=wp.int32),
        pair_right: wp.array(dtype=wp.int32),
    ):
        """Diagonal block of a column."""
        d00, d01, d02, d10, d11, d12, d20, d21, d22 = update(
            a, lower, upper, w, j, l_source, pair_start, pair_left, pair_right
        )
        invert_diagonal(lower, pivot, w, j, d00, d01, d02, d10, d11, d12, d20, d21, d22)

    @wp.func
    def factor_block(
        a: wp.array2d(dtype=S),
        a_upper: wp.array2d(dtype=S),
        lower: wp.array2d(dtype=S),
        upper: wp.array2d(dtype=S),
        w: int,
        j: int,
        block: int,
        l_source: wp.array(dtype=wp.int32),
        pair_start: wp.array(dtype=wp.int32),
        pair_left: wp.array(dtype=wp.int32),
        pair_right: wp.array(dtype=wp.int32),
    ):
        """L_ij and U_ji' of one block below the diagonal of column j."""
        t = 9 * block
        s00, s01, s02, s10, s11, s12, s20, s21, s22 = update(
            a, lower, upper, w, block, l_source, pair_start, pair_left, pair_right
        )
        for c in range(3):
            i0 = lower[w, 9 * j + c]
            i1 = lower[w, 9 * j + 3 + c]
            i2 = lower[w, 9 * j + 6 + c]
            lower[w, t + c] = mul(s00, i0) + mul(s01, i1) + mul(s02, i2)
            lower[w, t + 3 + c] = mul(s10, i0) + mul(s11, i1) + mul(s12, i2)
            lower[w, t + 6 + c] = mul(s20, i0) + mul(s21, i1) + mul(s22, i2)
        u00, u01, u02, u10, u11, u12, u20, u21, u22 = update(
            a_upper, upper, lower, w, block, l_source, pair_start, pair_left, pair_right
        )
        upper[w, t] = u00
        upper[w, t + 1] = u01
        upper[w, t + 2] = u02
        upper[w, t + 3] = u10
        upper[w, t + 4] = u11
        upper[w, t + 5] = u12
        upper[w, t + 6] = u20
        upper[w, t + 7] = u21
        upper[w, t + 8] = u22

    @wp.func
    def unit_forward_row(
        lower: wp.array2d(dtype=S),
        y: wp.array2d(dtype=S),
        w: int,
        i: int,
        offset: int,
        l_col: wp.array(dtype=wp.int32),
        row_start: wp.array(dtype=wp.int32),
        row_block: wp.array(dtype=wp.int32),
    ):
        """``y_i <- y_i - sum_j L_ij y_j``."""
        t = offset + 3 * i
        y0 = y[w, t]
        y1 = y[w, t + 1]
        y2 = y[w, t + 2]
        for p in range(row_start[i], row_start[i + 1]):
            b = 9 * row_block[p]
            j = offset + 3 * l_col[row_block[p]]
            for c in range(3):
                value = y[w, j + c]
                y0 -= mul(lower[w, b + c], value)
                y1 -= mul(lower[w, b + 3 + c], value)
                y2 -= mul(lower[w, b + 6 + c], value)
        y[w, t] = y0
        y[w, t + 1] = y1
        y[w, t + 2] = y2

    @wp.func
    def upper_backward_row(
        lower: wp.array2d(dtype=S),
        upper: wp.array2d(dtype=S),
        y: wp.array2d(dtype=S),
        w: int,
        j: int,
        offset: int,
        l_row: wp.array(dtype=wp.int32),
        col_start: wp.array(dtype=wp.int32),
    ):
        """``x_j <- U_jj^-1 (y_j - sum_i U_ji x_i)``."""
        t = offset + 3 * j
        y0 = y[w, t]
        y1 = y[w, t + 1]
        y2 = y[w, t + 2]
        for block in range(col_start[j], col_start[j + 1]):
            b = 9 * block
            i = offset + 3 * l_row[block]
            for r in range(3):
                value = y[w, i + r]
                y0 -= mul(upper[w, b + 3 * r], value)
                y1 -= mul(upper[w, b + 3 * r + 1], value)
                y2 -= mul(upper[w, b + 3 * r + 2], value)
        for r in range(3):
            d = 9 * j + 3 * r
            y[w, t + r] = mul(lower[w, d], y0) + mul(lower[w, d + 1], y1) + mul(lower[w, d + 2], y2)

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
        a_upper_in: wp.array2d(dtype=S),
        # Workspace out
        lower_out: wp.array2d(dtype=S),
        upper_out: wp.array2d(dtype=S),
        pivot_out: wp.array2d(dtype=S),
    ):
        """Factorise one world (or one pack of worlds) column by column."""
        w = wp.tid()
        for j in range(size):
            factor_diagonal(a_in, lower_out, upper_out, pivot_out, w, j, l_source, pair_start, pair_left, pair_right)
            for block in range(col_start[j], col_start[j + 1]):
                factor_block(
                    a_in, a_upper_in, lower_out, upper_out, w, j, block, l_source, pair_start, pair_left, pair_right
                )

    @wp.kernel(module=module, enable_backward=False)
    def solve_world(
        # Symbolic
        size: int,
        l_row: wp.array(dtype=wp.int32),
        l_col: wp.array(dtype=wp.int32),
        col_start: wp.array(dtype=wp.int32),
        row_start: wp.array(dtype=wp.int32),
        row_block: wp.array(dtype=wp.int32),
        # Workspace in
        lower_in: wp.array2d(dtype=S),
        upper_in: wp.array2d(dtype=S),
        # Workspace out
        y_out: wp.array2d(dtype=S),
    ):
        """Solve for one right-hand side of one world in place."""
        w, side = wp.tid()
        offset = 3 * size * side
        for i in range(size):
            unit_forward_row(lower_in, y_out, w, i, offset, l_col, row_start, row_block)
        for i in range(size):
            upper_backward_row(lower_in, upper_in, y_out, w, size - 1 - i, offset, l_row, col_start)

    @wp.kernel(module=module, enable_backward=False)
    def level_diagonal(
        # Symbolic
        begin: int,
        level_col: wp.array(dtype=wp.int32),
        l_source: wp.array(dtype=wp.int32),
        pair_start: wp.array(dtype=wp.int32),
        pair_left: wp.array(dtype=wp.int32),
        pair_right: wp.array(dtype=wp.int32),
        # Workspace in
        a_in: wp.array2d(dtype=S),
        upper_in: wp.array2d(dtype=S),
        # Workspace out
        lower_out: wp.array2d(dtype=S),
        pivot_out: wp.array2d(dtype=S),
    ):
        """Diagonal blocks of one level of the elimination tree."""
        item, w = wp.tid()
        j = level_col[begin + item]
        factor_diagonal(a_in, lower_out, upper_in, pivot_out, w, j, l_source, pair_start, pair_left, pair_right)

    @wp.kernel(module=module, enable_backward=False)
    def level_block(
        # Symbolic
        begin: int,
        size: int,
        level_list: wp.array(dtype=wp.int32),
        l_col: wp.array(dtype=wp.int32),
        l_source: wp.array(dtype=wp.int32),
        pair_start: wp.array(dtype=wp.int32),
        pair_left: wp.array(dtype=wp.int32),
        pair_right: wp.array(dtype=wp.int32),
        # Workspace in
        a_in: wp.array2d(dtype=S),
        a_upper_in: wp.array2d(dtype=S),
        # Workspace out
        lower_out: wp.array2d(dtype=S),
        upper_out: wp.array2d(dtype=S),
    ):
        """Blocks below the diagonal of one level; needs its diagonal blocks."""
        item, w = wp.tid()
        b = level_list[begin + item]
        if b >= size:
            factor_block(
                a_in, a_upper_in, lower_out, upper_out, w, l_col[b], b, l_source, pair_start, pair_left, pair_right
            )

    @wp.kernel(module=module, enable_backward=False)
    def level_forward(
        # Symbolic
        begin: int,
        size: int,
        level_col: wp.array(dtype=wp.int32),
        l_col: wp.array(dtype=wp.int32),
        row_start: wp.array(dtype=wp.int32),
        row_block: wp.array(dtype=wp.int32),
        # Workspace in
        lower_in: wp.array2d(dtype=S),
        # Workspace out
        y_out: wp.array2d(dtype=S),
    ):
        """Forward substitution of one level, for all right-hand sides."""
        item, side, w = wp.tid()
        unit_forward_row(lower_in, y_out, w, level_col[begin + item], 3 * size * side, l_col, row_start, row_block)

    @wp.kernel(module=module, enable_backward=False)
    def level_backward(
        # Symbolic
        begin: int,
        size: int,
        level_col: wp.array(dtype=wp.int32),
        l_row: wp.array(dtype=wp.int32),
        col_start: wp.array(dtype=wp.int32),
        # Workspace in
        lower_in: wp.array2d(dtype=S),
        upper_in: wp.array2d(dtype=S),
        # Workspace out
        y_out: wp.array2d(dtype=S),
    ):
        """Backward substitution of one level, for all right-hand sides."""
        item, side, w = wp.tid()
        upper_backward_row(lower_in, upper_in, y_out, w, level_col[begin + item], 3 * size * side, l_row, col_start)

    return SimpleNamespace(
        factor_world=factor_world,
        solve_world=solve_world,
        level_diagonal=level_diagonal,
        level_block=level_block,
        level_forward=level_forward,
        level_backward=level_backward,
        invert_diagonal=invert_diagonal,
    )
