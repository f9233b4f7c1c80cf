"""Block LU of one world at a time on a CPU, without lists of pairs. Theory: docs/theory/statics.md.

Arguments but for the structure, results and order of sums are those of ``factor_world`` of ``lu``. A list has an entry
for every product of blocks and leads all over the factors, which is slow when they exceed the cache. Here column j is
gathered in a scratch array from the columns k with a block (j, k), whose blocks (i, k), i >= j, follow it in memory.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import variant
from softwarp.kernels.linear import lu

COLUMN_ROWS = 24  # scratch of a block row: the rows of L_ij, then those of U_ji', each filled up to four numbers

_LOAD = """
const REAL* l = &wp::index(a, w, 0);
const REAL* u = &wp::index(a_upper, w, 0);
REAL* sum = &wp::index(column_out, w, COLUMN_ROWS * row);
const REAL zero = 0;
for (int r = 0; r < 3; ++r) {
    for (int c = 0; c < 3; ++c) {
        sum[4 * r + c] = source < 0 ? zero : l[9 * source + 3 * r + c];
        sum[12 + 4 * r + c] = source < 0 ? zero : u[9 * source + 3 * r + c];
    }
}
"""

_SUBTRACT = """
typedef REAL row_t __attribute__((vector_size(4 * sizeof(REAL))));
const REAL* l = &wp::index(lower, w, 0);
const REAL* u = &wp::index(upper, w, 0);
REAL* column = &wp::index(column_out, w, 0);
for (int p = begin; p < end; ++p) {
    const int first = row_block.data[p];
    const int last = col_start.data[l_col.data[first] + 1];
    row_t x[3] = {}, y[3] = {}, s, t;
    for (int c = 0; c < 3; ++c) {
        for (int m = 0; m < 3; ++m) {
            x[m][c] = u[9 * first + 3 * c + m];
            y[m][c] = l[9 * first + 3 * c + m];
        }
    }
    for (int b = first; b < last; ++b) {
        for (int r = 0; r < 3; ++r) {
            const REAL* left = l + 9 * b + 3 * r;
            const REAL* right = u + 9 * b + 3 * r;
            REAL* sum = column + COLUMN_ROWS * l_row.data[b] + 4 * r;
            __builtin_memcpy(&s, sum, sizeof(s));
            __builtin_memcpy(&t, sum + 12, sizeof(t));
            for (int m = 0; m < 3; ++m) {
                s -= left[m] * x[m];
                t -= right[m] * y[m];
            }
            __builtin_memcpy(sum, &s, sizeof(s));
            __builtin_memcpy(sum + 12, &t, sizeof(t));
        }
    }
}
"""


@cache
def kernels(precision: str) -> SimpleNamespace:
    """Compile-once kernel of the variant ``scalar``, ``float32`` or ``float64``."""
    scalar = variant("scalar", precision)
    S = scalar.S
    module = scalar.module("lu_column")
    invert_diagonal = lu.kernels(scalar).invert_diagonal

    def native(code: str) -> str:
        return code.replace("REAL", "double" if S is wp.float64 else "float").replace("COLUMN_ROWS", str(COLUMN_ROWS))

    @wp.func_native(native(_LOAD))
    def load_block(
        column_out: wp.array2d(dtype=S),
        a: wp.array2d(dtype=S),
        a_upper: wp.array2d(dtype=S),
        w: int,
        row: int,
        source: int,
    ):
        """Begin the sums of a block row with a block of A; -1 is none."""

    @wp.func_native(native(_SUBTRACT))
    def subtract_products(
        column_out: wp.array2d(dtype=S),
        lower: wp.array2d(dtype=S),
        upper: wp.array2d(dtype=S),
        w: int,
        begin: int,
        end: int,
        row_block: wp.array(dtype=wp.int32),
        l_row: wp.array(dtype=wp.int32),
        l_col: wp.array(dtype=wp.int32),
        col_start: wp.array(dtype=wp.int32),
    ):
        """Subtract ``L_ik U_kj`` and ``U_ki' L_jk'`` for a range of blocks (j, k) of row j and all i >= j."""

    @wp.kernel(module=module, enable_backward=False)
    def factor_world(
        # Symbolic
        size: int,
        l_row: wp.array(dtype=wp.int32),
        l_col: wp.array(dtype=wp.int32),
        l_source: wp.array(dtype=wp.int32),
        col_start: wp.array(dtype=wp.int32),
        row_start: wp.array(dtype=wp.int32),
        row_block: wp.array(dtype=wp.int32),
        # Workspace in
        a_in: wp.array2d(dtype=S),
        a_upper_in: wp.array2d(dtype=S),
        # Workspace out
        column_out: wp.array2d(dtype=S),
        lower_out: wp.array2d(dtype=S),
        upper_out: wp.array2d(dtype=S),
        pivot_out: wp.array2d(dtype=S),
    ):
        """Factorise one world column by column."""
        w = wp.tid()
        for j in range(size):
            load_block(column_out, a_in, a_upper_in, w, j, l_source[j])
            for block in range(col_start[j], col_start[j + 1]):
                load_block(column_out, a_in, a_upper_in, w, l_row[block], l_source[block])
            begin, end = row_start[j], row_start[j + 1]
            subtract_products(column_out, lower_out, upper_out, w, begin, end, row_block, l_row, l_col, col_start)
            d = COLUMN_ROWS * j
            invert_diagonal(
                lower_out,
                pivot_out,
                w,
                j,
                column_out[w, d],
                column_out[w, d + 1],
                column_out[w, d + 2],
                column_out[w, d + 4],
                column_out[w, d + 5],
                column_out[w, d + 6],
                column_out[w, d + 8],
                column_out[w, d + 9],
                column_out[w, d + 10],
            )
            for block in range(col_start[j], col_start[j + 1]):
                t = 9 * block
                s = COLUMN_ROWS * l_row[block]
                for r in range(3):
                    s0 = column_out[w, s + 4 * r]
                    s1 = column_out[w, s + 4 * r + 1]
                    s2 = column_out[w, s + 4 * r + 2]
                    for c in range(3):
                        i = 9 * j + c
                        value = s0 * lower_out[w, i] + s1 * lower_out[w, i + 3] + s2 * lower_out[w, i + 6]
                        lower_out[w, t + 3 * r + c] = value
                        upper_out[w, t + 3 * r + c] = column_out[w, s + 12 + 4 * r + c]

    return SimpleNamespace(factor_world=factor_world)
