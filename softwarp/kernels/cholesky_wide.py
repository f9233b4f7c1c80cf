"""Block Cholesky of one world at a time on a CPU in float32, with products of 3x3 blocks in one register of 16 numbers.

The same sums as in ``cholesky``, taken over a block's nine numbers at once: number 3 r + c of ``L_ik L_jk'`` is the sum
over m of number 3 r + m of L_ik times number 3 c + m of L_jk, so that each m takes two permutations and a multiply-add.
A register is filled with the seven numbers behind a block of L as well, which nothing depends on; L and y therefore end
with ``PAD`` rows that are never used. Theory, symbols and checks: docs/theory/cholesky.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels import cholesky
from softwarp.kernels.lanes import variant

PAD = 16  # rows behind the last that is used
wide = wp.types.vector(16, wp.float32)

# Vector types of the compiler, which it maps on whatever registers the processor has; the result is left in s.
_BEGIN = """
typedef float wide_t __attribute__((vector_size(64)));
typedef float four_t __attribute__((vector_size(16)));
#define PICK(v, ...) __builtin_shufflevector(v, v, __VA_ARGS__, 0, 0, 0, 0, 0, 0, 0)
#define ROWS(v, m) PICK(v, m, m, m, 3 + m, 3 + m, 3 + m, 6 + m, 6 + m, 6 + m)
#define COLUMNS(v, m) PICK(v, m, 3 + m, 6 + m, m, 3 + m, 6 + m, m, 3 + m, 6 + m)
#define LOAD(v, source) __builtin_memcpy(&v, source, sizeof(v))
"""
_END = """
#undef PICK
#undef ROWS
#undef COLUMNS
#undef LOAD
wp::vec_t<16, wp::float32> result;
__builtin_memcpy(&result, &s, sizeof(s));
return result;
"""


@wp.func_native(
    _BEGIN
    + """
const float* l = &wp::index(lower, w, 0);
wide_t s = {}, t = {}, u = {}, a, b;
for (int p = begin; p < end; ++p) {
    LOAD(a, l + 9 * left.data[p]);
    LOAD(b, l + 9 * right.data[p]);
    s += ROWS(a, 0) * COLUMNS(b, 0);
    t += ROWS(a, 1) * COLUMNS(b, 1);
    u += ROWS(a, 2) * COLUMNS(b, 2);
}
s += t + u;
"""
    + _END
)
def pair_sum(
    lower: wp.array2d(dtype=wp.float32),
    w: int,
    begin: int,
    end: int,
    left: wp.array(dtype=wp.int32),
    right: wp.array(dtype=wp.int32),
) -> wide:
    """Sum of ``L_ik L_jk'`` over pairs of blocks."""


@wp.func_native(
    _BEGIN
    + """
wide_t s, a = {};
__builtin_memcpy(&a, &wp::index(array, w, row), 9 * sizeof(float));
LOAD(s, &sum);
s = a - s;
"""
    + _END
)
def load_minus(array: wp.array2d(dtype=wp.float32), w: int, row: int, sum: wide) -> wide:
    """The block in nine rows from ``row`` on, minus ``sum``."""


@wp.func_native(
    _BEGIN
    + """
wide_t s, a, b;
LOAD(a, &block);
LOAD(b, &inverse);
s = ROWS(a, 0) * COLUMNS(b, 0);
s += ROWS(a, 1) * COLUMNS(b, 1);
s += ROWS(a, 2) * COLUMNS(b, 2);
__builtin_memcpy(&wp::index(lower_out, w, row), &s, 9 * sizeof(float));
"""
    + _END
)
def store_product(lower_out: wp.array2d(dtype=wp.float32), w: int, row: int, block: wide, inverse: wide) -> wide:
    """Write ``B Li'`` to nine rows of L from ``row`` on."""


@wp.func_native(
    _BEGIN
    + """
const float* l = &wp::index(lower, w, 0);
const float* x = &wp::index(y, w, 0);
wide_t s = {}, a;
four_t v;
for (int p = begin; p < end; ++p) {
    LOAD(a, l + 9 * block.data[p]);
    LOAD(v, x + 3 * column.data[block.data[p]]);
    s += a * PICK(v, 0, 1, 2, 0, 1, 2, 0, 1, 2);
}
"""
    + _END
)
def row_sum(
    lower: wp.array2d(dtype=wp.float32),
    y: wp.array2d(dtype=wp.float32),
    w: int,
    begin: int,
    end: int,
    block: wp.array(dtype=wp.int32),
    column: wp.array(dtype=wp.int32),
) -> wide:
    """Sums of products of L_ij and y_j along a row of blocks, to be added by threes: entry r is 3 r to 3 r + 2."""


@wp.func_native(
    _BEGIN
    + """
const float* l = &wp::index(lower, w, 0);
const float* x = &wp::index(y, w, 0);
wide_t s = {}, a;
four_t v;
for (int b = begin; b < end; ++b) {
    LOAD(a, l + 9 * b);
    LOAD(v, x + 3 * row.data[b]);
    s += a * PICK(v, 0, 0, 0, 1, 1, 1, 2, 2, 2);
}
"""
    + _END
)
def column_sum(
    lower: wp.array2d(dtype=wp.float32),
    y: wp.array2d(dtype=wp.float32),
    w: int,
    begin: int,
    end: int,
    row: wp.array(dtype=wp.int32),
) -> wide:
    """Sums of products of L_ij' and x_i along a column of blocks; entry c is the sum of c, 3 + c and 6 + c."""


@wp.func_native(
    _BEGIN
    + """
const float* l = &wp::index(lower, w, 0);
const float* x = &wp::index(y, w, offset);
wide_t s = {}, t = {}, u = {}, a, b;
four_t v0, v1, v2;
for (int p = begin; p < end; ++p) {
    const float* v = x + 3 * column.data[block.data[p]];
    LOAD(a, l + 9 * block.data[p]);
    LOAD(v0, v);
    LOAD(v1, v + stride);
    LOAD(v2, v + 2 * stride);
    b = __builtin_shufflevector(__builtin_shufflevector(v0, v1, 0, 1, 2, 4, 5, 6, 0, 0),
                                __builtin_shufflevector(v2, v2, 0, 1, 2, 0, 0, 0, 0, 0),
                                0, 1, 2, 3, 4, 5, 8, 9, 10, 0, 0, 0, 0, 0, 0, 0);
    s += ROWS(a, 0) * COLUMNS(b, 0);
    t += ROWS(a, 1) * COLUMNS(b, 1);
    u += ROWS(a, 2) * COLUMNS(b, 2);
}
s += t + u;
"""
    + _END
)
def row_sum3(
    lower: wp.array2d(dtype=wp.float32),
    y: wp.array2d(dtype=wp.float32),
    w: int,
    offset: int,
    stride: int,
    begin: int,
    end: int,
    block: wp.array(dtype=wp.int32),
    column: wp.array(dtype=wp.int32),
) -> wide:
    """Sum of ``L_ij y_j`` along a row of blocks for three right-hand sides; entry r of side s at 3 r + s."""


@cache
def kernels() -> SimpleNamespace:
    """Compile-once set of kernels of one world in float32; arguments are those of the kernels of ``cholesky``."""
    scalar = variant("scalar")
    module = scalar.module("cholesky_wide")
    shared = cholesky.kernels(scalar)
    diagonal_inverse, store_solved = shared.diagonal_inverse, shared.store_solved

    @wp.func
    def block_update(
        a: wp.array2d(dtype=wp.float32),
        lower: wp.array2d(dtype=wp.float32),
        w: int,
        block: int,
        l_source: wp.array(dtype=wp.int32),
        pair_start: wp.array(dtype=wp.int32),
        pair_left: wp.array(dtype=wp.int32),
        pair_right: wp.array(dtype=wp.int32),
    ):
        """``A_ij - sum_k L_ik L_jk'`` of one block."""
        sum = pair_sum(lower, w, pair_start[block], pair_start[block + 1], pair_left, pair_right)
        if l_source[block] >= 0:
            return load_minus(a, w, 9 * l_source[block], sum)
        return -sum

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
        a_in: wp.array2d(dtype=wp.float32),
        # Workspace out
        lower_out: wp.array2d(dtype=wp.float32),
        diagonal_out: wp.array2d(dtype=wp.float32),
    ):
        """Factorise one world column by column."""
        w = wp.tid()
        for j in range(size):
            s = block_update(a_in, lower_out, w, j, l_source, pair_start, pair_left, pair_right)
            i00, i10, i11, i20, i21, i22 = diagonal_inverse(s[0], s[3], s[4], s[6], s[7], s[8])
            d = j * 6
            diagonal_out[w, d] = i00
            diagonal_out[w, d + 1] = i10
            diagonal_out[w, d + 2] = i11
            diagonal_out[w, d + 3] = i20
            diagonal_out[w, d + 4] = i21
            diagonal_out[w, d + 5] = i22
            inverse = wide()
            inverse[0] = i00
            inverse[3] = i10
            inverse[4] = i11
            inverse[6] = i20
            inverse[7] = i21
            inverse[8] = i22
            for block in range(col_start[j], col_start[j + 1]):
                t = block_update(a_in, lower_out, w, block, l_source, pair_start, pair_left, pair_right)
                store_product(lower_out, w, 9 * block, t, inverse)

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
            s = row_sum(lower_in, y_out, w, row_start[i], row_start[i + 1], row_block, l_col)
            t = 3 * i
            y0 = y_out[w, t] - (s[0] + s[1] + s[2])
            y1 = y_out[w, t + 1] - (s[3] + s[4] + s[5])
            y2 = y_out[w, t + 2] - (s[6] + s[7] + s[8])
            store_solved(y_out, w, t, y0, y1, y2, diagonal_in, i * 6)

    @wp.kernel(module=module, enable_backward=False)
    def forward_world3(
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
        """Forward substitution of three consecutive right-hand sides of one world."""
        w, group = wp.tid()
        offset = 9 * size * group
        stride = 3 * size
        for i in range(size):
            s = row_sum3(lower_in, y_out, w, offset, stride, row_start[i], row_start[i + 1], row_block, l_col)
            for side in range(3):
                t = offset + side * stride + 3 * i
                y0 = y_out[w, t] - s[side]
                y1 = y_out[w, t + 1] - s[3 + side]
                y2 = y_out[w, t + 2] - s[6 + side]
                store_solved(y_out, w, t, y0, y1, y2, diagonal_in, i * 6)

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
            s = column_sum(lower_in, y_out, w, col_start[j], col_start[j + 1], l_row)
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
        forward_world3=forward_world3,
        backward_world=backward_world,
    )
