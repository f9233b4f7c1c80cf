"""Block Cholesky of one world at a time on a CPU in float32, its blocks in SIMD registers (``wide``).

Arguments and results are those of ``cholesky``, but that all right-hand sides of a substitution go together; sums are
taken in another order. Theory, symbols and checks: docs/theory/cholesky.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import wide
from softwarp.kernels.algebra.lanes import variant
from softwarp.kernels.linear import cholesky


@cache
def kernels() -> SimpleNamespace:
    """Compile-once set of kernels of one world in float32; most take the arguments of the kernels of ``cholesky``."""
    scalar = variant("scalar")
    module = scalar.module("cholesky_wide")
    shared = cholesky.kernels(scalar)
    store_solved = shared.store_solved

    @wp.kernel(module=module, enable_backward=False)
    def factor_world(
        # Symbolic
        strips: int,
        strip_start: wp.array(dtype=wp.int32),
        strip_source: wp.array(dtype=wp.int32),
        source: wp.array2d(dtype=wp.int32),
        place: wp.array(dtype=wp.int32),
        col_start: wp.array(dtype=wp.int32),
        l_source: wp.array(dtype=wp.int32),
        # Workspace in
        a_in: wp.array2d(dtype=wp.float32),
        # Workspace out
        lower_out: wp.array2d(dtype=wp.float32),
        diagonal_out: wp.array2d(dtype=wp.float32),
    ):
        """Factorise one world strip by strip."""
        w = wp.tid()
        wide.factor_strips(
            w,
            strips,
            strip_start,
            strip_source,
            source,
            place,
            col_start,
            l_source,
            a_in,
            lower_out,
            diagonal_out,
        )

    @wp.kernel(module=module, enable_backward=False)
    def forward_world(
        # Symbolic
        size: int,
        l_col: wp.array(dtype=wp.int32),
        row_start: wp.array(dtype=wp.int32),
        row_block: wp.array(dtype=wp.int32),
        # Workspace in
        lower_in: wp.array2d(dtype=wp.float32),
        diagonal_in: wp.array2d(dtype=wp.float32),
        # Workspace out
        y_out: wp.array2d(dtype=wp.float32),
    ):
        """Forward substitution of the first right-hand side of one world."""
        w = wp.tid()
        for i in range(size):
            s = wide.row_sum(lower_in, y_out, w, row_start[i], row_start[i + 1], row_block, l_col)
            t = 3 * i
            y0 = y_out[w, t] - (s[0] + s[1] + s[2])
            y1 = y_out[w, t + 1] - (s[3] + s[4] + s[5])
            y2 = y_out[w, t + 2] - (s[6] + s[7] + s[8])
            store_solved(y_out, w, t, y0, y1, y2, diagonal_in, i * 6)

    @wp.kernel(module=module, enable_backward=False)
    def forward_all(
        # Symbolic
        size: int,
        sides: int,
        l_col: wp.array(dtype=wp.int32),
        row_start: wp.array(dtype=wp.int32),
        row_block: wp.array(dtype=wp.int32),
        # Workspace in
        lower_in: wp.array2d(dtype=wp.float32),
        diagonal_in: wp.array2d(dtype=wp.float32),
        # Workspace out
        together_out: wp.array2d(dtype=wp.float32),
        y_out: wp.array2d(dtype=wp.float32),
    ):
        """Forward substitution of the first right-hand sides of one world, which share registers."""
        w = wp.tid()
        wide.forward_sides(w, size, sides, l_col, row_start, row_block, lower_in, diagonal_in, together_out, y_out)

    @wp.kernel(module=module, enable_backward=False)
    def backward_world(
        # Symbolic
        size: int,
        l_row: wp.array(dtype=wp.int32),
        col_start: wp.array(dtype=wp.int32),
        # Workspace in
        lower_in: wp.array2d(dtype=wp.float32),
        diagonal_in: wp.array2d(dtype=wp.float32),
        # Workspace out
        y_out: wp.array2d(dtype=wp.float32),
    ):
        """Backward substitution of the first right-hand side of one world."""
        w = wp.tid()
        for item in range(size):
            j = size - 1 - item
            s = wide.column_sum(lower_in, y_out, w, col_start[j], col_start[j + 1], l_row)
            t = 3 * j
            d = 6 * j
            y0 = y_out[w, t] - (s[0] + s[3] + s[6])
            y1 = y_out[w, t + 1] - (s[1] + s[4] + s[7])
            y2 = y_out[w, t + 2] - (s[2] + s[5] + s[8])
            y_out[w, t] = diagonal_in[w, d] * y0 + diagonal_in[w, d + 1] * y1 + diagonal_in[w, d + 3] * y2
            y_out[w, t + 1] = diagonal_in[w, d + 2] * y1 + diagonal_in[w, d + 4] * y2
            y_out[w, t + 2] = diagonal_in[w, d + 5] * y2

    return SimpleNamespace(
        factor_world=factor_world,
        forward_world=forward_world,
        forward_all=forward_all,
        backward_world=backward_world,
    )
