"""Block Cholesky of eight worlds in SIMD lanes, strip by strip of neighbouring columns, on a CPU in float32.

Results are those of ``cholesky``, up to rounding: sums are taken in another order, which depends on the structure
alone. A strip's blocks are gathered where they will lie: each begins as its block of A, loses the products of all
strips to the left, then those within the strip. Theory, symbols and schedule: docs/theory/cholesky.md,
``solvers.linear.strips``. The functions are C++ for the compiler's vector types.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import LANE_COUNT, variant, vec8

WIDTH = 4  # columns of a strip, at most; eight are no faster

# Arithmetic on these goes lane by lane: nothing mixes worlds. A product and the sum that it is added to become one
# instruction with one rounding, which Warp's compiler leaves out unless it is told.
TYPES = f"""
#pragma clang fp contract(fast)
typedef float lane_t __attribute__((vector_size({4 * LANE_COUNT}), aligned(4), may_alias));
"""

# t -= L Z, summed over columns c, for which L and Z point to 3x3 blocks; t and L are row by row. With strides 1 and 3 Z
# is read transposed, as a block of L that a product of the factor ends with; with 3 and 1 row by row, as of a side.
MINUS = """
#define MINUS(t, columns, L, Z, ZR, ZC) { \\
    lane_t* const t_ = (t); \\
    lane_t s0 = t_[0], s1 = t_[1], s2 = t_[2], s3 = t_[3], s4 = t_[4]; \\
    lane_t s5 = t_[5], s6 = t_[6], s7 = t_[7], s8 = t_[8]; \\
    for (int c = 0; c < (columns); ++c) { \\
        const lane_t* const l_ = (L); \\
        const lane_t* const z_ = (Z); \\
        for (int m = 0; m < 3; ++m) { \\
            const lane_t z0 = z_[(ZR) * m], z1 = z_[(ZR) * m + (ZC)], z2 = z_[(ZR) * m + 2 * (ZC)]; \\
            s0 -= l_[m] * z0; s1 -= l_[m] * z1; s2 -= l_[m] * z2; \\
            s3 -= l_[3 + m] * z0; s4 -= l_[3 + m] * z1; s5 -= l_[3 + m] * z2; \\
            s6 -= l_[6 + m] * z0; s7 -= l_[6 + m] * z1; s8 -= l_[6 + m] * z2; \\
        } \\
    } \\
    t_[0] = s0; t_[1] = s1; t_[2] = s2; t_[3] = s3; t_[4] = s4; t_[5] = s5; t_[6] = s6; t_[7] = s7; t_[8] = s8; \\
}
"""
UNDEFINE = "\n#undef MINUS\n"


@wp.func_native(
    TYPES
    + MINUS
    + """
const lane_t* const a = (const lane_t*)&wp::index(a_in, w, 0);
lane_t* const l = (lane_t*)&wp::index(lower_out, w, 0);
lane_t* const inverse = (lane_t*)&wp::index(diagonal_out, w, 0);
const int* const start = col_start.data;
for (int strip = 0; strip < strips; ++strip) {
    const int first = strip_start.data[strip];
    const int width = strip_start.data[strip + 1] - first;
    const int count = width + start[first + width] - start[first + width - 1];
    for (int j = first; j < first + width; ++j)
        for (int r = 0; r <= start[j + 1] - start[j]; ++r) {
            const int b = r == 0 ? j : start[j] + r - 1;
            const int from = source_of.data[b];
            for (int i = 0; i < 9; ++i) l[9 * b + i] = from >= 0 ? a[9 * from + i] : lane_t{};
        }
    for (int s = strip_source.data[strip]; s < strip_source.data[strip + 1]; ++s) {
        const int* const given = source.data + 5 * s;
        const int k = given[0], columns = given[1], top = given[2], own = given[3];
        const int* const number = place.data + given[4];
        const int rows = start[k + columns] - start[k + columns - 1] - top;
        const lane_t* base[8];
        for (int c = 0; c < columns; ++c) base[c] = l + 9 * (start[k + c] + columns - 1 - c + top);
        for (int r = 0; r < rows; ++r)
            for (int u = 0; u < own && u <= r; ++u) {
                const int j = number[u];
                lane_t* const t = l + 9 * (r == u ? first + j : start[first + j] + number[r] - j - 1);
                MINUS(t, columns, base[c] + 9 * r, base[c] + 9 * u, 1, 3)
            }
    }
    for (int j = 0; j < width; ++j) {
        const lane_t* base[8];
        for (int c = 0; c < j; ++c) base[c] = l + 9 * (start[first + c] - c - 1);
        if (j > 0)
            for (int r = j; r < count; ++r) {
                lane_t* const t = l + 9 * (r == j ? first + j : start[first + j] + r - j - 1);
                MINUS(t, j, base[c] + 9 * r, base[c] + 9 * j, 1, 3)
            }
        const lane_t* const d = l + 9 * (first + j);
        const lane_t i00 = 1.0f / __builtin_elementwise_sqrt(d[0]);
        const lane_t l10 = d[3] * i00, l20 = d[6] * i00;
        const lane_t i11 = 1.0f / __builtin_elementwise_sqrt(d[4] - l10 * l10);
        const lane_t l21 = (d[7] - l20 * l10) * i11;
        const lane_t i22 = 1.0f / __builtin_elementwise_sqrt(d[8] - l20 * l20 - l21 * l21);
        const lane_t i10 = -(l10 * i00 * i11), i21 = -(l21 * i11 * i22);
        const lane_t i20 = -((l20 * i00 + l21 * i10) * i22);
        lane_t* const out = inverse + 6 * (first + j);
        out[0] = i00; out[1] = i10; out[2] = i11; out[3] = i20; out[4] = i21; out[5] = i22;
        for (int b = start[first + j]; b < start[first + j + 1]; ++b)
            for (lane_t* t = l + 9 * b; t < l + 9 * b + 9; t += 3) {
                const lane_t t0 = t[0], t1 = t[1], t2 = t[2];
                t[0] = t0 * i00;
                t[1] = t0 * i10 + t1 * i11;
                t[2] = t0 * i20 + t1 * i21 + t2 * i22;
            }
    }
}
"""
    + UNDEFINE
)
def factor_strips(
    w: int,
    strips: int,
    strip_start: wp.array(dtype=wp.int32),
    strip_source: wp.array(dtype=wp.int32),
    source: wp.array2d(dtype=wp.int32),
    place: wp.array(dtype=wp.int32),
    col_start: wp.array(dtype=wp.int32),
    source_of: wp.array(dtype=wp.int32),
    a_in: wp.array2d(dtype=vec8),
    lower_out: wp.array2d(dtype=vec8),
    diagonal_out: wp.array2d(dtype=vec8),
):
    """L and the inverses of its diagonal blocks; ``source_of`` is the block of A that a block of L starts from."""


@wp.func_native(
    TYPES
    + """
const lane_t* const l = (const lane_t*)&wp::index(lower, w, 0);
const lane_t* const inverse = (const lane_t*)&wp::index(diagonal, w, 0);
lane_t* const y = (lane_t*)&wp::index(y_out, w, 0);
const int* const start = col_start.data;
for (int strip = 0; strip < strips; ++strip) {
    const int first = strip_start.data[strip];
    const int width = strip_start.data[strip + 1] - first;
    const int below = start[first + width] - start[first + width - 1];
    const int* const rows = l_row.data + start[first + width - 1];
    lane_t z[24];
    const lane_t* base[8];
    for (int j = 0; j < width; ++j) {
        lane_t v0 = y[3 * (first + j)], v1 = y[3 * (first + j) + 1], v2 = y[3 * (first + j) + 2];
        for (int c = 0; c < j; ++c) {
            const lane_t* const b = l + 9 * (start[first + c] + j - c - 1);
            for (int m = 0; m < 3; ++m) {
                v0 -= b[m] * z[3 * c + m];
                v1 -= b[3 + m] * z[3 * c + m];
                v2 -= b[6 + m] * z[3 * c + m];
            }
        }
        const lane_t* const d = inverse + 6 * (first + j);
        z[3 * j] = d[0] * v0;
        z[3 * j + 1] = d[1] * v0 + d[2] * v1;
        z[3 * j + 2] = d[3] * v0 + d[4] * v1 + d[5] * v2;
        for (int m = 0; m < 3; ++m) y[3 * (first + j) + m] = z[3 * j + m];
        base[j] = l + 9 * (start[first + j] + width - 1 - j);
    }
    for (int r = 0; r < below; ++r) {
        lane_t* const t = y + 3 * rows[r];
        lane_t s0 = t[0], s1 = t[1], s2 = t[2];
        for (int c = 0; c < width; ++c) {
            const lane_t* const b = base[c] + 9 * r;
            for (int m = 0; m < 3; ++m) {
                s0 -= b[m] * z[3 * c + m];
                s1 -= b[3 + m] * z[3 * c + m];
                s2 -= b[6 + m] * z[3 * c + m];
            }
        }
        t[0] = s0; t[1] = s1; t[2] = s2;
    }
}
"""
)
def forward_strips(
    w: int,
    strips: int,
    strip_start: wp.array(dtype=wp.int32),
    l_row: wp.array(dtype=wp.int32),
    col_start: wp.array(dtype=wp.int32),
    lower: wp.array2d(dtype=vec8),
    diagonal: wp.array2d(dtype=vec8),
    y_out: wp.array2d(dtype=vec8),
):
    """``y <- L^-1 y`` for the first right-hand side."""


@wp.func_native(
    TYPES
    + MINUS
    + """
const lane_t* const l = (const lane_t*)&wp::index(lower, w, 0);
const lane_t* const inverse = (const lane_t*)&wp::index(diagonal, w, 0);
const int* const start = col_start.data;
const long stride = 3 * size;
for (int strip = 0; strip < strips; ++strip) {
    const int first = strip_start.data[strip];
    const int width = strip_start.data[strip + 1] - first;
    const int below = start[first + width] - start[first + width - 1];
    const int* const rows = l_row.data + start[first + width - 1];
    const lane_t* base[8];
    for (int c = 0; c < width; ++c) base[c] = l + 9 * (start[first + c] + width - 1 - c);
    for (int group = 0; group < groups; ++group) {
        lane_t* const y = (lane_t*)&wp::index(y_out, w, 0) + 3 * stride * group;
        lane_t z[72], v[9];
        for (int j = 0; j < width; ++j) {
            lane_t* const x = y + 3 * (first + j);
            for (int m = 0; m < 3; ++m)
                for (int side = 0; side < 3; ++side) v[3 * m + side] = x[side * stride + m];
            MINUS(v, j, l + 9 * (start[first + c] + j - c - 1), z + 9 * c, 3, 1)
            const lane_t* const d = inverse + 6 * (first + j);
            for (int side = 0; side < 3; ++side) {
                lane_t* const q = z + 9 * j + side;
                q[0] = d[0] * v[side];
                q[3] = d[1] * v[side] + d[2] * v[3 + side];
                q[6] = d[3] * v[side] + d[4] * v[3 + side] + d[5] * v[6 + side];
                for (int m = 0; m < 3; ++m) x[side * stride + m] = q[3 * m];
            }
        }
        for (int r = 0; r < below; ++r) {
            lane_t* const x = y + 3 * rows[r];
            for (int m = 0; m < 3; ++m)
                for (int side = 0; side < 3; ++side) v[3 * m + side] = x[side * stride + m];
            MINUS(v, width, base[c] + 9 * r, z + 9 * c, 3, 1)
            for (int m = 0; m < 3; ++m)
                for (int side = 0; side < 3; ++side) x[side * stride + m] = v[3 * m + side];
        }
    }
}
"""
    + UNDEFINE
)
def forward_strips3(
    w: int,
    size: int,
    groups: int,
    strips: int,
    strip_start: wp.array(dtype=wp.int32),
    l_row: wp.array(dtype=wp.int32),
    col_start: wp.array(dtype=wp.int32),
    lower: wp.array2d(dtype=vec8),
    diagonal: wp.array2d(dtype=vec8),
    y_out: wp.array2d(dtype=vec8),
):
    """``forward_strips`` for groups of three right-hand sides, all of them while a strip is at hand."""


@wp.func_native(
    TYPES
    + """
const lane_t* const l = (const lane_t*)&wp::index(lower, w, 0);
const lane_t* const inverse = (const lane_t*)&wp::index(diagonal, w, 0);
lane_t* const y = (lane_t*)&wp::index(y_out, w, 0);
const int* const start = col_start.data;
for (int strip = strips - 1; strip >= 0; --strip) {
    const int first = strip_start.data[strip];
    const int width = strip_start.data[strip + 1] - first;
    const int below = start[first + width] - start[first + width - 1];
    const int* const rows = l_row.data + start[first + width - 1];
    for (int j = width - 1; j >= 0; --j) {
        const lane_t* b = l + 9 * start[first + j];
        lane_t v0 = y[3 * (first + j)], v1 = y[3 * (first + j) + 1], v2 = y[3 * (first + j) + 2];
        for (int r = j + 1; r < width + below; ++r, b += 9) {
            const lane_t* const x = y + 3 * (r < width ? first + r : rows[r - width]);
            for (int m = 0; m < 3; ++m) {
                v0 -= b[3 * m] * x[m];
                v1 -= b[3 * m + 1] * x[m];
                v2 -= b[3 * m + 2] * x[m];
            }
        }
        const lane_t* const d = inverse + 6 * (first + j);
        y[3 * (first + j)] = d[0] * v0 + d[1] * v1 + d[3] * v2;
        y[3 * (first + j) + 1] = d[2] * v1 + d[4] * v2;
        y[3 * (first + j) + 2] = d[5] * v2;
    }
}
"""
)
def backward_strips(
    w: int,
    strips: int,
    strip_start: wp.array(dtype=wp.int32),
    l_row: wp.array(dtype=wp.int32),
    col_start: wp.array(dtype=wp.int32),
    lower: wp.array2d(dtype=vec8),
    diagonal: wp.array2d(dtype=vec8),
    y_out: wp.array2d(dtype=vec8),
):
    """``y <- L^-T y`` for the first right-hand side."""


@cache
def kernels() -> SimpleNamespace:
    """Compile-once set of kernels of packs of eight worlds."""
    module = variant("lanes").module("cholesky_strips")

    @wp.kernel(module=module, enable_backward=False)
    def factor_pack(
        # Symbolic
        strips: int,
        strip_start: wp.array(dtype=wp.int32),
        strip_source: wp.array(dtype=wp.int32),
        source: wp.array2d(dtype=wp.int32),
        place: wp.array(dtype=wp.int32),
        col_start: wp.array(dtype=wp.int32),
        l_source: wp.array(dtype=wp.int32),
        # Workspace in
        a_in: wp.array2d(dtype=vec8),
        # Workspace out
        lower_out: wp.array2d(dtype=vec8),
        diagonal_out: wp.array2d(dtype=vec8),
    ):
        """Factorise one pack."""
        w = wp.tid()
        factor_strips(
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
    def forward_pack(
        # Symbolic
        strips: int,
        strip_start: wp.array(dtype=wp.int32),
        l_row: wp.array(dtype=wp.int32),
        col_start: wp.array(dtype=wp.int32),
        # Workspace in
        lower_in: wp.array2d(dtype=vec8),
        diagonal_in: wp.array2d(dtype=vec8),
        # Workspace out
        y_out: wp.array2d(dtype=vec8),
    ):
        """Forward substitution of the first right-hand side of one pack."""
        w = wp.tid()
        forward_strips(w, strips, strip_start, l_row, col_start, lower_in, diagonal_in, y_out)

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
        lower_in: wp.array2d(dtype=vec8),
        diagonal_in: wp.array2d(dtype=vec8),
        # Workspace out
        y_out: wp.array2d(dtype=vec8),
    ):
        """Forward substitution of groups of three right-hand sides of one pack."""
        w = wp.tid()
        forward_strips3(w, size, groups, strips, strip_start, l_row, col_start, lower_in, diagonal_in, y_out)

    @wp.kernel(module=module, enable_backward=False)
    def backward_pack(
        # Symbolic
        strips: int,
        strip_start: wp.array(dtype=wp.int32),
        l_row: wp.array(dtype=wp.int32),
        col_start: wp.array(dtype=wp.int32),
        # Workspace in
        lower_in: wp.array2d(dtype=vec8),
        diagonal_in: wp.array2d(dtype=vec8),
        # Workspace out
        y_out: wp.array2d(dtype=vec8),
    ):
        """Backward substitution of the first right-hand side of one pack."""
        w = wp.tid()
        backward_strips(w, strips, strip_start, l_row, col_start, lower_in, diagonal_in, y_out)

    return SimpleNamespace(
        factor_pack=factor_pack, forward_pack=forward_pack, forward_pack3=forward_pack3, backward_pack=backward_pack
    )
