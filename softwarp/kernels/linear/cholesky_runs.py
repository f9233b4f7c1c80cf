"""Block Cholesky of one large world at a time on a CPU in float32, strip by strip, five rows to a SIMD register.

A column of L is a matrix of three columns, row by row, whose blocks follow each other. A register takes five of its
rows; the product with a 3x3 block is three permutations and multiply-adds, and blocks of neighbouring columns share the
permutations. Results are those of ``cholesky``, up to rounding: sums are taken in another order, which depends on the
structure alone. Theory, symbols and checks: docs/theory/cholesky.md; schedule: ``solvers.linear.strips.runs``.
The functions are C++ for the compiler's vector types.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import variant

MOST = 8  # columns of a strip

# Values behind the rows that are asked for are read and written back, those of columns to the right among them, which
# are written later. What is read of L for a product is zero there, so that nothing comes from them.
_TYPES = """
#pragma clang fp contract(fast)
typedef float wide_t __attribute__((vector_size(64), aligned(4), may_alias));
typedef int mask_t __attribute__((vector_size(64), aligned(4), may_alias));
#define AT(T, place) (*(T*)(place))
#define PICK(v, ...) __builtin_shufflevector(v, v, __VA_ARGS__, 15)
#define THRICE(m) m, m, m
#define SPREAD(v, m) PICK(v, THRICE(m), THRICE(3 + m), THRICE(6 + m), THRICE(9 + m), THRICE(12 + m))
#define REPEAT(v, a, b, c) PICK(v, a, b, c, a, b, c, a, b, c, a, b, c, a, b, c)
// Where numbers f to f + 14 of `size` are, a multiple of three.
#define INSIDE(f, size) ((f) + 15 <= (size) ? whole : part[((size) - (f)) / 3])
#define MASKS \\
    mask_t whole = {}, part[5] = {}; \\
    for (int i_ = 0; i_ < 15; ++i_) { \\
        whole[i_] = -1; \\
        for (int k_ = 0; k_ < 5; ++k_) part[k_][i_] = i_ < 3 * k_ ? -1 : 0; \\
    }
// Registers that a product with the transpose of a block takes.
#define PATTERN(z, block) { \\
    wide_t b_ = {}; \\
    __builtin_memcpy(&b_, block, 9 * sizeof(float)); \\
    (z)[0] = REPEAT(b_, 0, 3, 6); (z)[1] = REPEAT(b_, 1, 4, 7); (z)[2] = REPEAT(b_, 2, 5, 8); \\
}
// t[u] -= sum over columns c of L_c Z_cu', for `size` numbers; the pattern of Z_cu is the one with number c stride + u.
#define MINUS(count, columns, size, from, t, z, stride) \\
    for (int f_ = 0; f_ < (size); f_ += 15) { \\
        wide_t s_[count], p_[count]; \\
        const mask_t in_ = INSIDE(f_, size); \\
        for (int u_ = 0; u_ < (count); ++u_) { s_[u_] = AT(wide_t, t[u_] + f_); p_[u_] = wide_t{}; } \\
        for (int c_ = 0; c_ < (columns); ++c_) { \\
            const wide_t a_ = (wide_t)(AT(const mask_t, from[c_] + f_) & in_); \\
            const wide_t a0_ = SPREAD(a_, 0), a1_ = SPREAD(a_, 1), a2_ = SPREAD(a_, 2); \\
            for (int u_ = 0; u_ < (count); ++u_) { \\
                const wide_t* const z_ = (z) + 3 * (c_ * (stride) + u_); \\
                s_[u_] -= a0_ * z_[0]; \\
                p_[u_] += a1_ * z_[1]; \\
                p_[u_] += a2_ * z_[2]; \\
            } \\
        } \\
        for (int u_ = 0; u_ < (count); ++u_) AT(wide_t, t[u_] + f_) = s_[u_] - p_[u_]; \\
    }
"""
_END = """
#undef AT
#undef PICK
#undef THRICE
#undef SPREAD
#undef REPEAT
#undef INSIDE
#undef MASKS
#undef PATTERN
#undef MINUS
"""


@wp.func_native(
    _TYPES
    + """
const float* const a = &wp::index(a_in, w, 0);
float* const l = &wp::index(lower_out, w, 0);
float* const inverse = &wp::index(diagonal_out, w, 0);
const int* const start = col_start.data;
MASKS
wide_t z[8 * 8 * 3];
for (int strip = 0; strip < strips; ++strip) {
    const int first = strip_start.data[strip];
    const int width = strip_start.data[strip + 1] - first;
    const int count = width + start[first + width] - start[first + width - 1];
    for (int j = first; j < first + width; ++j)
        for (int b = start[j] - 1; b < start[j + 1]; ++b) {
            float* const t = l + 9 * (b < start[j] ? j : b);
            const int from = source_of.data[b < start[j] ? j : b];
            if (from >= 0) __builtin_memcpy(t, a + 9 * from, 9 * sizeof(float));
            else __builtin_memset(t, 0, 9 * sizeof(float));
        }
    for (int s = strip_source.data[strip]; s < strip_source.data[strip + 1]; ++s) {
        const int* const given = source.data + 6 * s;
        const int k = given[0], columns = given[1], top = given[2], own = given[3];
        const int* const number = place.data + given[4];
        const float *base[8], *from[8];
        float* column[8];  // where row 0 of the strip would be
        for (int u = 0; u < own; ++u) column[u] = l + 9 * (start[first + number[u]] - number[u] - 1);
        for (int c = 0; c < columns; ++c) {
            base[c] = l + 9 * (start[k + c] + columns - 1 - c + top);
            for (int u = 0; u < own; ++u) PATTERN(z + 3 * (c * own + u), base[c] + 9 * u)
        }
        for (int r = 0; r < own; ++r) {
            for (int c = 0; c < columns; ++c) from[c] = base[c] + 9 * r;
            for (int u = 0; u <= r; ++u) {
                float* const t[1] = {u == r ? l + 9 * (first + number[r]) : column[u] + 9 * number[r]};
                MINUS(1, columns, 9, from, t, z + 3 * u, own)
            }
        }
        for (int q = given[5]; q < given[11]; ++q) {
            const int size = 9 * run.data[3 * q + 2];
            for (int c = 0; c < columns; ++c) from[c] = base[c] + 9 * run.data[3 * q];
            for (int u = 0; u < own; u += 4) {
                float* t[4];
                for (int i = 0; i < 4; ++i) t[i] = column[u + i < own ? u + i : u] + 9 * run.data[3 * q + 1];
                const wide_t* const y = z + 3 * u;
                switch (own - u) {
                    case 1: MINUS(1, columns, size, from, t, y, own) break;
                    case 2: MINUS(2, columns, size, from, t, y, own) break;
                    case 3: MINUS(3, columns, size, from, t, y, own) break;
                    default: MINUS(4, columns, size, from, t, y, own)
                }
            }
        }
    }
    for (int j = 0; j < width; ++j) {
        const float* base[8];
        float* const d = l + 9 * (first + j);
        float* const below = l + 9 * start[first + j];
        const int size = 9 * (count - j - 1);
        if (j > 0) {
            float* t[1] = {d};
            for (int c = 0; c < j; ++c) {
                base[c] = l + 9 * (start[first + c] + j - c - 1);
                PATTERN(z + 3 * c, base[c])
            }
            MINUS(1, j, 9, base, t, z, 1)
            for (int c = 0; c < j; ++c) base[c] += 9;
            t[0] = below;
            MINUS(1, j, size, base, t, z, 1)
        }
        const float i00 = 1.0f / __builtin_sqrtf(d[0]);
        const float l10 = d[3] * i00, l20 = d[6] * i00;
        const float i11 = 1.0f / __builtin_sqrtf(d[4] - l10 * l10);
        const float l21 = (d[7] - l20 * l10) * i11;
        const float i22 = 1.0f / __builtin_sqrtf(d[8] - l20 * l20 - l21 * l21);
        const float i10 = -(l10 * i00 * i11), i21 = -(l21 * i11 * i22);
        const float i20 = -((l20 * i00 + l21 * i10) * i22);
        float* const out = inverse + 6 * (first + j);
        out[0] = i00; out[1] = i10; out[2] = i11; out[3] = i20; out[4] = i21; out[5] = i22;
        const float block[9] = {i00, 0.0f, 0.0f, i10, i11, 0.0f, i20, i21, i22};
        PATTERN(z, block)
        for (int f = 0; f < size; f += 15) {
            const mask_t in = INSIDE(f, size), v = AT(mask_t, below + f);
            const wide_t x = (wide_t)(v & in);
            const wide_t product = SPREAD(x, 0) * z[0] + SPREAD(x, 1) * z[1] + SPREAD(x, 2) * z[2];
            AT(mask_t, below + f) = ((mask_t)product & in) | (v & ~in);
        }
    }
}
"""
    + _END
)
def factor_runs(
    w: int,
    strips: int,
    strip_start: wp.array(dtype=wp.int32),
    strip_source: wp.array(dtype=wp.int32),
    source: wp.array2d(dtype=wp.int32),
    place: wp.array(dtype=wp.int32),
    run: wp.array2d(dtype=wp.int32),
    col_start: wp.array(dtype=wp.int32),
    source_of: wp.array(dtype=wp.int32),
    a_in: wp.array2d(dtype=wp.float32),
    lower_out: wp.array2d(dtype=wp.float32),
    diagonal_out: wp.array2d(dtype=wp.float32),
):
    """L and the inverses of its diagonal blocks; ``source_of`` is the block of A that a block of L starts from."""


@wp.func_native(
    _TYPES
    + """
const float* const l = &wp::index(lower, w, 0);
const float* const inverse = &wp::index(diagonal, w, 0);
float* const y = &wp::index(y_out, w, 0);
const int* const start = col_start.data;
wide_t z[8];
for (int strip = 0; strip < strips; ++strip) {
    const int first = strip_start.data[strip];
    const int width = strip_start.data[strip + 1] - first;
    const int below = start[first + width] - start[first + width - 1];
    const int* const rows = l_row.data + start[first + width - 1];
    const float* base[8];
    for (int j = 0; j < width; ++j) {
        float* const x = y + 3 * (first + j);
        float v0 = x[0], v1 = x[1], v2 = x[2];
        for (int c = 0; c < j; ++c) {
            const float* const b = l + 9 * (start[first + c] + j - c - 1);
            const float* const s = y + 3 * (first + c);
            v0 -= b[0] * s[0] + b[1] * s[1] + b[2] * s[2];
            v1 -= b[3] * s[0] + b[4] * s[1] + b[5] * s[2];
            v2 -= b[6] * s[0] + b[7] * s[1] + b[8] * s[2];
        }
        const float* const d = inverse + 6 * (first + j);
        x[0] = d[0] * v0;
        x[1] = d[1] * v0 + d[2] * v1;
        x[2] = d[3] * v0 + d[4] * v1 + d[5] * v2;
        const wide_t s = {x[0], x[1], x[2]};
        z[j] = REPEAT(s, 0, 1, 2);
        base[j] = l + 9 * (start[first + j] + width - 1 - j);
    }
    for (int r = 0; r < below; r += 5) {
        const int count = below - r < 5 ? below - r : 5;
        float sum[20];
        for (int f = 0; f < 9 * count; f += 15) {
            wide_t s = {};
            for (int c = 0; c < width; ++c) s += AT(const wide_t, base[c] + 9 * r + f) * z[c];
            for (int i = 0; i < 5; ++i) sum[f / 3 + i] = s[3 * i] + s[3 * i + 1] + s[3 * i + 2];
        }
        for (int i = 0; i < count; ++i)
            for (int m = 0; m < 3; ++m) y[3 * rows[r + i] + m] -= sum[3 * i + m];
    }
}
"""
    + _END
)
def forward_runs(
    w: int,
    strips: int,
    strip_start: wp.array(dtype=wp.int32),
    l_row: wp.array(dtype=wp.int32),
    col_start: wp.array(dtype=wp.int32),
    lower: wp.array2d(dtype=wp.float32),
    diagonal: wp.array2d(dtype=wp.float32),
    y_out: wp.array2d(dtype=wp.float32),
):
    """``y <- L^-1 y`` for the first right-hand side."""


@wp.func_native(
    _TYPES
    + """
const float* const l = &wp::index(lower, w, 0);
const float* const inverse = &wp::index(diagonal, w, 0);
const int* const start = col_start.data;
const long stride = 3 * size;
MASKS
wide_t z[8 * 3];
for (int strip = 0; strip < strips; ++strip) {
    const int first = strip_start.data[strip];
    const int width = strip_start.data[strip + 1] - first;
    const int below = start[first + width] - start[first + width - 1];
    const int* const rows = l_row.data + start[first + width - 1];
    const float *base[8], *from[8];
    for (int c = 0; c < width; ++c) base[c] = l + 9 * (start[first + c] + width - 1 - c);
    for (int group = 0; group < groups; ++group) {
        float* const y = &wp::index(y_out, w, 0) + 3 * stride * group;
        for (int j = 0; j < width; ++j) {
            float solved[9];
            for (int side = 0; side < 3; ++side) {
                float* const x = y + side * stride + 3 * (first + j);
                float v0 = x[0], v1 = x[1], v2 = x[2];
                for (int c = 0; c < j; ++c) {
                    const float* const b = l + 9 * (start[first + c] + j - c - 1);
                    const float* const s = y + side * stride + 3 * (first + c);
                    v0 -= b[0] * s[0] + b[1] * s[1] + b[2] * s[2];
                    v1 -= b[3] * s[0] + b[4] * s[1] + b[5] * s[2];
                    v2 -= b[6] * s[0] + b[7] * s[1] + b[8] * s[2];
                }
                const float* const d = inverse + 6 * (first + j);
                solved[3 * side] = x[0] = d[0] * v0;
                solved[3 * side + 1] = x[1] = d[1] * v0 + d[2] * v1;
                solved[3 * side + 2] = x[2] = d[3] * v0 + d[4] * v1 + d[5] * v2;
            }
            PATTERN(z + 3 * j, solved)
        }
        for (int r = 0; r < below; r += 5) {
            const int count = below - r < 5 ? below - r : 5;
            float sum[61] = {};
            float* const t[1] = {sum};
            for (int c = 0; c < width; ++c) from[c] = base[c] + 9 * r;
            MINUS(1, width, 9 * count, from, t, z, 1)
            for (int i = 0; i < count; ++i) {
                float* const x = y + 3 * rows[r + i];
                for (int side = 0; side < 3; ++side)
                    for (int m = 0; m < 3; ++m) x[side * stride + m] += sum[9 * i + 3 * m + side];
            }
        }
    }
}
"""
    + _END
)
def forward_runs3(
    w: int,
    size: int,
    groups: int,
    strips: int,
    strip_start: wp.array(dtype=wp.int32),
    l_row: wp.array(dtype=wp.int32),
    col_start: wp.array(dtype=wp.int32),
    lower: wp.array2d(dtype=wp.float32),
    diagonal: wp.array2d(dtype=wp.float32),
    y_out: wp.array2d(dtype=wp.float32),
):
    """``forward_runs`` for groups of three right-hand sides, all of them while a strip is at hand."""


@wp.func_native(
    _TYPES
    + """
const float* const l = &wp::index(lower, w, 0);
const float* const inverse = &wp::index(diagonal, w, 0);
float* const y = &wp::index(y_out, w, 0);
const int* const start = col_start.data;
MASKS
for (int strip = strips - 1; strip >= 0; --strip) {
    const int first = strip_start.data[strip];
    const int width = strip_start.data[strip + 1] - first;
    const int below = start[first + width] - start[first + width - 1];
    const int* const rows = l_row.data + start[first + width - 1];
    const float* base[8];
    wide_t s[8] = {};
    for (int c = 0; c < width; ++c) base[c] = l + 9 * (start[first + c] + width - 1 - c);
    for (int r = 0; r < below; r += 5) {
        const int count = below - r < 5 ? below - r : 5;
        float x[26] = {};
        for (int i = 0; i < count; ++i) __builtin_memcpy(x + 3 * i, y + 3 * rows[r + i], 3 * sizeof(float));
        for (int f = 0; f < 9 * count; f += 15) {
            const wide_t v = AT(const wide_t, x + f / 3);
            const wide_t u = PICK(v, 0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4);
            const mask_t in = INSIDE(f, 9 * count);
            for (int c = 0; c < width; ++c) s[c] += (wide_t)(AT(const mask_t, base[c] + 9 * r + f) & in) * u;
        }
    }
    for (int j = width - 1; j >= 0; --j) {
        float* const x = y + 3 * (first + j);
        float v[3];
        for (int m = 0; m < 3; ++m)
            v[m] = x[m] - ((s[j][m] + s[j][3 + m]) + (s[j][6 + m] + s[j][9 + m]) + s[j][12 + m]);
        const float* b = l + 9 * start[first + j];
        for (int r = j + 1; r < width; ++r, b += 9)
            for (int m = 0; m < 3; ++m) {
                const float* const t = y + 3 * (first + r);
                v[m] -= b[m] * t[0] + b[3 + m] * t[1] + b[6 + m] * t[2];
            }
        const float* const d = inverse + 6 * (first + j);
        x[0] = d[0] * v[0] + d[1] * v[1] + d[3] * v[2];
        x[1] = d[2] * v[1] + d[4] * v[2];
        x[2] = d[5] * v[2];
    }
}
"""
    + _END
)
def backward_runs(
    w: int,
    strips: int,
    strip_start: wp.array(dtype=wp.int32),
    l_row: wp.array(dtype=wp.int32),
    col_start: wp.array(dtype=wp.int32),
    lower: wp.array2d(dtype=wp.float32),
    diagonal: wp.array2d(dtype=wp.float32),
    y_out: wp.array2d(dtype=wp.float32),
):
    """``y <- L^-T y`` for the first right-hand side."""


@cache
def kernels() -> SimpleNamespace:
    """Compile-once set of kernels of one world in float32."""
    module = variant("scalar").module("cholesky_runs")

    @wp.kernel(module=module, enable_backward=False)
    def factor_pack(
        # Symbolic
        strips: int,
        strip_start: wp.array(dtype=wp.int32),
        strip_source: wp.array(dtype=wp.int32),
        source: wp.array2d(dtype=wp.int32),
        place: wp.array(dtype=wp.int32),
        run: wp.array2d(dtype=wp.int32),
        col_start: wp.array(dtype=wp.int32),
        l_source: wp.array(dtype=wp.int32),
        # Workspace in
        a_in: wp.array2d(dtype=wp.float32),
        # Workspace out
        lower_out: wp.array2d(dtype=wp.float32),
        diagonal_out: wp.array2d(dtype=wp.float32),
    ):
        """Factorise one world."""
        w = wp.tid()
        factor_runs(
            w,
            strips,
            strip_start,
            strip_source,
            source,
            place,
            run,
            col_start,
            l_source,
            a_in,
            lower_out,
            diagonal_out,
        )

    @wp.kernel(module=module, enable_backward=False)
    def forward_pack(
        # Symbolic
        strips: int,
        strip_start: wp.array(dtype=wp.int32),
        l_row: wp.array(dtype=wp.int32),
        col_start: wp.array(dtype=wp.int32),
        # Workspace in
        lower_in: wp.array2d(dtype=wp.float32),
        diagonal_in: wp.array2d(dtype=wp.float32),
        # Workspace out
        y_out: wp.array2d(dtype=wp.float32),
    ):
        """Forward substitution of the first right-hand side of one world."""
        w = wp.tid()
        forward_runs(w, strips, strip_start, l_row, col_start, lower_in, diagonal_in, y_out)

    @wp.kernel(module=module, enable_backward=False)
    def forward_pack3(
        # Symbolic
        size: int,
        groups: int,
        strips: int,
        strip_start: wp.array(dtype=wp.int32),
        l_row: wp.array(dtype=wp.int32),
        col_start: wp.array(dtype=wp.int32),
        # Workspace in
        lower_in: wp.array2d(dtype=wp.float32),
        diagonal_in: wp.array2d(dtype=wp.float32),
        # Workspace out
        y_out: wp.array2d(dtype=wp.float32),
    ):
        """Forward substitution of groups of three right-hand sides of one world."""
        w = wp.tid()
        forward_runs3(w, size, groups, strips, strip_start, l_row, col_start, lower_in, diagonal_in, y_out)

    @wp.kernel(module=module, enable_backward=False)
    def backward_pack(
        # Symbolic
        strips: int,
        strip_start: wp.array(dtype=wp.int32),
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
        backward_runs(w, strips, strip_start, l_row, col_start, lower_in, diagonal_in, y_out)

    return SimpleNamespace(
        factor_pack=factor_pack, forward_pack=forward_pack, forward_pack3=forward_pack3, backward_pack=backward_pack
    )
