"""Block LU of one world at a time on a CPU, without lists of pairs. Theory: docs/theory/statics.md.

Arguments but for the structure, results and order of sums are those of the kernels of ``lu``. A list has an entry
for every product of blocks and leads all over the factors, which is slow when they exceed the cache. Here column j is
gathered in a scratch array from the columns k with a block (j, k), whose blocks (i, k), i >= j, follow it in memory.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import variant
from softwarp.kernels.linear import lu

COLUMN_ROWS = 24  # scratch of a block row: the rows of L_ij, then those of U_ji', each filled up to four numbers
TOGETHER = 8  # right-hand sides of a pass through the factors, which are larger than the cache

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

_SOLVE = """
typedef REAL sides_t __attribute__((vector_size(TOGETHER * sizeof(REAL))));
const REAL* l = &wp::index(lower, w, 0);
const REAL* u = &wp::index(upper, w, 0);
REAL* y = &wp::index(y_out, w, 3 * size * first);
REAL* z = &wp::index(column_out, w, 0);
sides_t v[3], s;
for (int i = 0; i < 3 * size; ++i) {
    for (int side = 0; side < TOGETHER; ++side) {
        z[TOGETHER * i + side] = side < sides ? y[3 * size * side + i] : 0;
    }
}
for (int j = 0; j < size; ++j) {
    __builtin_memcpy(v, z + 3 * TOGETHER * j, sizeof(v));
    for (int b = col_start.data[j]; b < col_start.data[j + 1]; ++b) {
        REAL* below = z + 3 * TOGETHER * l_row.data[b];
        for (int r = 0; r < 3; ++r) {
            __builtin_memcpy(&s, below + TOGETHER * r, sizeof(s));
            for (int c = 0; c < 3; ++c) {
                s -= l[9 * b + 3 * r + c] * v[c];
            }
            __builtin_memcpy(below + TOGETHER * r, &s, sizeof(s));
        }
    }
}
for (int j = size - 1; j >= 0; --j) {
    __builtin_memcpy(v, z + 3 * TOGETHER * j, sizeof(v));
    for (int b = col_start.data[j]; b < col_start.data[j + 1]; ++b) {
        const REAL* below = z + 3 * TOGETHER * l_row.data[b];
        for (int r = 0; r < 3; ++r) {
            __builtin_memcpy(&s, below + TOGETHER * r, sizeof(s));
            for (int c = 0; c < 3; ++c) {
                v[c] -= u[9 * b + 3 * r + c] * s;
            }
        }
    }
    for (int r = 0; r < 3; ++r) {
        const REAL* inverse = l + 9 * j + 3 * r;
        s = inverse[0] * v[0] + inverse[1] * v[1] + inverse[2] * v[2];
        __builtin_memcpy(z + TOGETHER * (3 * j + r), &s, sizeof(s));
    }
}
for (int i = 0; i < 3 * size; ++i) {
    for (int side = 0; side < sides; ++side) {
        y[3 * size * side + i] = z[TOGETHER * i + side];
    }
}
"""
assert 3 * TOGETHER <= COLUMN_ROWS


@cache
def kernels(precision: str) -> SimpleNamespace:
    """Compile-once kernel of the variant ``scalar``, ``float32`` or ``float64``."""
    scalar = variant("scalar", precision)
    S = scalar.S
    module = scalar.module("lu_column")
    invert_diagonal = lu.kernels(scalar).invert_diagonal

    def native(code: str) -> str:
        code = code.replace("REAL", "double" if S is wp.float64 else "float")
        return code.replace("COLUMN_ROWS", str(COLUMN_ROWS)).replace("TOGETHER", str(TOGETHER))

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
        is_kept_in: wp.array(dtype=wp.int32),
        a_in: wp.array2d(dtype=S),
        a_upper_in: wp.array2d(dtype=S),
        # Workspace out
        column_out: wp.array2d(dtype=S),
        lower_out: wp.array2d(dtype=S),
        upper_out: wp.array2d(dtype=S),
        pivot_out: wp.array2d(dtype=S),
    ):
        """Factorise one world column by column, if its factor is not to be kept."""
        w = wp.tid()
        if is_kept_in[w] != 0:
            return
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

    @wp.func_native(native(_SOLVE))
    def solve_together(
        column_out: wp.array2d(dtype=S),
        y_out: wp.array2d(dtype=S),
        lower: wp.array2d(dtype=S),
        upper: wp.array2d(dtype=S),
        w: int,
        first: int,
        sides: int,
        size: int,
        l_row: wp.array(dtype=wp.int32),
        col_start: wp.array(dtype=wp.int32),
    ):
        """``y <- A^-1 y`` for some right-hand sides from the first one on, column by column."""

    @wp.kernel(module=module, enable_backward=False)
    def solve_world(
        # Symbolic
        size: int,
        l_row: wp.array(dtype=wp.int32),
        col_start: wp.array(dtype=wp.int32),
        # Workspace in
        lower_in: wp.array2d(dtype=S),
        upper_in: wp.array2d(dtype=S),
        sides: int,
        # Workspace out
        column_out: wp.array2d(dtype=S),
        y_out: wp.array2d(dtype=S),
    ):
        """Solve for all right-hand sides of one world in place."""
        w = wp.tid()
        for group in range((sides + wp.static(TOGETHER - 1)) // wp.static(TOGETHER)):
            first = wp.static(TOGETHER) * group
            count = wp.min(sides - first, wp.static(TOGETHER))
            solve_together(column_out, y_out, lower_in, upper_in, w, first, count, size, l_row, col_start)

    return SimpleNamespace(factor_world=factor_world, solve_world=solve_world)
