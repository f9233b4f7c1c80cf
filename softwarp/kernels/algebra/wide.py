"""Blocks and rows of one world on a CPU in float32, in SIMD registers of sixteen numbers.

A world by itself has no neighbours to share a register with, as in ``lanes``, so its parallelism lies in 3x3 blocks:
number 3 r + c of ``A B'`` is the sum over m of number 3 r + m of A times number 3 c + m of B, so that each m takes two
permutations and a multiply-add; those of B are kept where it has many products. A register is filled with the seven
numbers behind a block of L as well, which nothing depends on; L and right-hand sides therefore end with ``PAD`` rows
that are never used. The functions are C++ for the compiler's vector types, which it maps on whatever registers the
processor has. Used where ``is_wide`` holds.
"""

import warp as wp

from softwarp.kernels.algebra.lanes import Variant

PAD = 16  # rows behind the last that is used
SIDES = 16  # right-hand sides that go through a forward substitution together
wide = wp.types.vector(16, wp.float32)

# A function leaves its result in s.
_BEGIN = """
typedef float wide_t __attribute__((vector_size(64)));
typedef float four_t __attribute__((vector_size(16)));
#define PICK(v, ...) __builtin_shufflevector(v, v, __VA_ARGS__, 0, 0, 0, 0, 0, 0, 0)
#define ROWS(v, m) PICK(v, m, m, m, 3 + m, 3 + m, 3 + m, 6 + m, 6 + m, 6 + m)
#define COLUMNS(v, m) PICK(v, m, 3 + m, 6 + m, m, 3 + m, 6 + m, m, 3 + m, 6 + m)
#define LOAD(v, source) __builtin_memcpy(&v, source, sizeof(v))
"""
_UNDEFINE = """
#undef PICK
#undef ROWS
#undef COLUMNS
#undef LOAD
"""
_END = (
    _UNDEFINE
    + """
wp::vec_t<16, wp::float32> result;
__builtin_memcpy(&result, &s, sizeof(s));
return result;
"""
)


def is_wide(variant: Variant) -> bool:
    """Whether a variant is one world at a time on a CPU in float32."""
    return variant.name == "scalar" and variant.real is wp.float32


# t -= L Z' for one block t, where L points to a block of each of some columns and z holds the columns of theirs of Z
# as COLUMNS has them: those are permuted once for all blocks t below each other. A strip has up to four columns
# (``solvers.linear.strips``); registers hold what the compiler knows the number of.
_MINUS = """
#define STORE(target, s) __builtin_memcpy(target, &s, 9 * sizeof(float))
#define HOLD(columns, Z) \\
    for (int c = 0; c < (columns); ++c) { \\
        LOAD(b, Z); \\
        z[c][0] = COLUMNS(b, 0); z[c][1] = COLUMNS(b, 1); z[c][2] = COLUMNS(b, 2); \\
    }
#define MINUS(target, columns, L) { \\
    float* const t_ = (target); \\
    wide_t s_, u_ = {}; \\
    LOAD(s_, t_); \\
    for (int c = 0; c < (columns); ++c) { \\
        LOAD(a, L); \\
        s_ -= ROWS(a, 0) * z[c][0]; \\
        u_ -= ROWS(a, 1) * z[c][1]; \\
        s_ -= ROWS(a, 2) * z[c][2]; \\
    } \\
    s_ += u_; \\
    STORE(t_, s_); \\
}
#define EACH_WIDTH(columns, BODY) \\
    if ((columns) == 1) BODY(1) else if ((columns) == 2) BODY(2) else if ((columns) == 3) BODY(3) else BODY(4)
"""


@wp.func_native(
    "#pragma clang fp contract(fast)\n"
    + _BEGIN
    + _MINUS
    + """
const float* const matrix = &wp::index(a_in, w, 0);
float* const l = &wp::index(lower_out, w, 0);
float* const inverse = &wp::index(diagonal_out, w, 0);
const int* const start = col_start.data;
wide_t a, b, z[4][3];
for (int strip = 0; strip < strips; ++strip) {
    const int first = strip_start.data[strip];
    const int width = strip_start.data[strip + 1] - first;
    const int count = width + start[first + width] - start[first + width - 1];
    for (int j = first; j < first + width; ++j)
        for (int r = 0; r <= start[j + 1] - start[j]; ++r) {
            const int block = r == 0 ? j : start[j] + r - 1;
            const int from = source_of.data[block];
            if (from >= 0) __builtin_memcpy(l + 9 * block, matrix + 9 * from, 9 * sizeof(float));
            else __builtin_memset(l + 9 * block, 0, 9 * sizeof(float));
        }
    for (int s = strip_source.data[strip]; s < strip_source.data[strip + 1]; ++s) {
        const int* const given = source.data + 5 * s;
        const int k = given[0], columns = given[1], top = given[2], own = given[3];
        const int* const number = place.data + given[4];
        const int rows = start[k + columns] - start[k + columns - 1] - top;
        const float* base[4];
        for (int c = 0; c < columns; ++c) base[c] = l + 9 * (start[k + c] + columns - 1 - c + top);
        for (int u = 0; u < own; ++u) {
            const int j = number[u];
            float* const pivot = l + 9 * (first + j);
            float* const below = l + 9 * (start[first + j] - j - 1);
#define STRIP(C) { \\
            HOLD(C, base[c] + 9 * u) \\
            MINUS(pivot, C, base[c] + 9 * u) \\
            for (int r = u + 1; r < rows; ++r) MINUS(below + 9 * number[r], C, base[c] + 9 * r) \\
        }
            EACH_WIDTH(columns, STRIP)
#undef STRIP
        }
    }
    for (int j = 0; j < width; ++j) {
        float* const below = l + 9 * (start[first + j] - j - 1);
        float* const d = l + 9 * (first + j);
        if (j > 0) {
            const float* base[3];
            for (int c = 0; c < j; ++c) base[c] = l + 9 * (start[first + c] - c - 1);
#define STRIP(C) { \\
            HOLD(C, base[c] + 9 * j) \\
            MINUS(d, C, base[c] + 9 * j) \\
            for (int r = j + 1; r < count; ++r) MINUS(below + 9 * r, C, base[c] + 9 * r) \\
        }
            if (j == 1) STRIP(1) else if (j == 2) STRIP(2) else STRIP(3)
#undef STRIP
        }
        const float i00 = 1.0f / __builtin_sqrtf(d[0]);
        const float l10 = d[3] * i00, l20 = d[6] * i00;
        const float i11 = 1.0f / __builtin_sqrtf(d[4] - l10 * l10);
        const float l21 = (d[7] - l20 * l10) * i11;
        const float i22 = 1.0f / __builtin_sqrtf(d[8] - l20 * l20 - l21 * l21);
        const float i10 = -(l10 * i00 * i11), i21 = -(l21 * i11 * i22);
        const float i20 = -((l20 * i00 + l21 * i10) * i22);
        const float six[6] = {i00, i10, i11, i20, i21, i22};
        __builtin_memcpy(inverse + 6 * (first + j), six, sizeof(six));
        const wide_t scale = {i00, 0.0f, 0.0f, i10, i11, 0.0f, i20, i21, i22};
        const wide_t z0 = COLUMNS(scale, 0), z1 = COLUMNS(scale, 1), z2 = COLUMNS(scale, 2);
        float* const end = l + 9 * start[first + j + 1];
        for (float* t = l + 9 * start[first + j]; t < end; t += 9) {
            LOAD(a, t);
            wide_t s = ROWS(a, 0) * z0;
            s += ROWS(a, 1) * z1;
            s += ROWS(a, 2) * z2;
            STORE(t, s);
        }
    }
}
#undef STORE
#undef HOLD
#undef MINUS
#undef EACH_WIDTH
"""
    + _UNDEFINE
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
    a_in: wp.array2d(dtype=wp.float32),
    lower_out: wp.array2d(dtype=wp.float32),
    diagonal_out: wp.array2d(dtype=wp.float32),
):
    """What ``cholesky_strips.factor_strips`` does, for one world."""


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


# A register holds the same row of SIDES right-hand sides: sums along a row of blocks then need no permutations.
@wp.func_native(f"""
#pragma clang fp contract(fast)
typedef float sides_t __attribute__((vector_size({4 * SIDES}), aligned(4), may_alias));
const float* const l = &wp::index(lower, w, 0);
const float* const inverse = &wp::index(diagonal, w, 0);
const int* const start = row_start.data;
const long stride = 3 * size;
float* const flat = &wp::index(together_out, w, 0);
sides_t* const z = (sides_t*)flat;
for (int first = 0; first < sides; first += {SIDES}) {{
    const int count = sides - first < {SIDES} ? sides - first : {SIDES};
    float* const y = &wp::index(y_out, w, first * stride);
    for (long r = 0; r < stride; ++r) {{
        z[r] = sides_t{{}};
        for (int side = 0; side < count; ++side) flat[{SIDES} * r + side] = y[side * stride + r];
    }}
    for (int i = 0; i < size; ++i) {{
        sides_t s0 = z[3 * i], s1 = z[3 * i + 1], s2 = z[3 * i + 2];
        sides_t t0 = {{}}, t1 = {{}}, t2 = {{}}, u0 = {{}}, u1 = {{}}, u2 = {{}};
        for (int p = start[i]; p < start[i + 1]; ++p) {{
            const int b = row_block.data[p];
            const float* const a = l + 9 * b;
            const sides_t* const x = z + 3 * l_col.data[b];
            const sides_t x0 = x[0], x1 = x[1], x2 = x[2];
            s0 -= a[0] * x0; s1 -= a[3] * x0; s2 -= a[6] * x0;
            t0 -= a[1] * x1; t1 -= a[4] * x1; t2 -= a[7] * x1;
            u0 -= a[2] * x2; u1 -= a[5] * x2; u2 -= a[8] * x2;
        }}
        s0 += t0 + u0; s1 += t1 + u1; s2 += t2 + u2;
        const float* const d = inverse + 6 * i;
        z[3 * i] = d[0] * s0;
        z[3 * i + 1] = d[1] * s0 + d[2] * s1;
        z[3 * i + 2] = d[3] * s0 + d[4] * s1 + d[5] * s2;
    }}
    for (long r = 0; r < stride; ++r)
        for (int side = 0; side < count; ++side) y[side * stride + r] = flat[{SIDES} * r + side];
}}
""")
def forward_sides(
    w: int,
    size: int,
    sides: int,
    l_col: wp.array(dtype=wp.int32),
    row_start: wp.array(dtype=wp.int32),
    row_block: wp.array(dtype=wp.int32),
    lower: wp.array2d(dtype=wp.float32),
    diagonal: wp.array2d(dtype=wp.float32),
    together_out: wp.array2d(dtype=wp.float32),
    y_out: wp.array2d(dtype=wp.float32),
):
    """``y <- L^-1 y`` for all right-hand sides; ``together_out`` has room for ``SIDES`` of them, row by row."""


@wp.func_native("""
typedef float four_t __attribute__((vector_size(16)));
const float* f = &wp::index(force, w, 0);
four_t s = {}, a = {};
for (int p = begin; p < end; ++p) {
    __builtin_memcpy(&a, f + 3 * corner.data[p], 3 * sizeof(float));
    s += a;
}
return wp::vec_t<3, wp::float32>(s[0], s[1], s[2]);
""")
def corner_sum(
    force: wp.array2d(dtype=wp.float32), w: int, begin: int, end: int, corner: wp.array(dtype=wp.int32)
) -> wp.vec3f:
    """Sum of the forces of some corners of elements."""


@wp.func_native(
    _BEGIN
    + """
const float* const g = &wp::index(gradient, w, 0);
const float* const stiff = &wp::index(body_scale, w, 0);
const float* const body_mu = &wp::index(mu, w, 0);
const float* const body_lam = &wp::index(lam, w, 0);
float* const matrix = &wp::index(a_out, w, 0);
const int mask = (1 << bits) - 1;
const wide_t one = {1.0f, 0.0f, 0.0f, 0.0f, 1.0f, 0.0f, 0.0f, 0.0f, 1.0f};
for (int block = 0; block < entry_start.shape[0] - 1; ++block) {
    const int begin = entry_start.data[block], end = entry_start.data[block + 1];
    if (begin == end) continue;
    wide_t s = {}, target = {};
    four_t a, b;
    for (int p = begin; p < end; ++p) {
        const int code = entry.data[p];
        const float* const element = g + rows * (code >> (2 * bits));
        LOAD(a, element + 3 * ((code >> bits) & mask));
        LOAD(b, element + 3 * (code & mask));
        s += PICK(a, 0, 0, 0, 1, 1, 1, 2, 2, 2) * PICK(b, 0, 1, 2, 0, 1, 2, 0, 1, 2);
    }
    const int body = tet_body.data[entry.data[begin] >> (2 * bits)];
    const float m = stiff[body] * body_mu[body], l = stiff[body] * body_lam[body];
    const float trace = m * (s[0] + s[4] + s[8]);
    const wide_t straight = l + m * one, across = m - m * one;
    __builtin_memcpy(&target, matrix + 9 * block, 9 * sizeof(float));
    target += straight * s + (across * PICK(s, 0, 3, 6, 1, 4, 7, 2, 5, 8) + trace * one);
    __builtin_memcpy(matrix + 9 * block, &target, 9 * sizeof(float));
}
"""
    + _UNDEFINE
)
def add_isotropic(
    w: int,
    rows: int,
    bits: int,
    tet_body: wp.array(dtype=wp.int32),
    entry_start: wp.array(dtype=wp.int32),
    entry: wp.array(dtype=wp.int32),
    mu: wp.array2d(dtype=wp.float32),
    lam: wp.array2d(dtype=wp.float32),
    body_scale: wp.array2d(dtype=wp.float32),
    gradient: wp.array2d(dtype=wp.float32),
    a_out: wp.array2d(dtype=wp.float32),
):
    """What ``corotational.block_stiffness`` adds to all blocks of A, for one world.

    One more row of gradients behind the last is read, and not used.
    """


@wp.func_native(
    _BEGIN
    + """
const float* g = &wp::index(gradient, w, 0);
four_t sum[9] = {}, a[3], b[3];
for (int p = begin; p < end; ++p) {
    const int code = entry.data[p];
    const float* element = g + 120 * (code >> 8);
    __builtin_memcpy(a, element + 12 * ((code >> 4) & 15), sizeof(a));
    __builtin_memcpy(b, element + 12 * (code & 15), sizeof(b));
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c) sum[3 * r + c] += a[r] * b[c];
}
wide_t s = {};
for (int i = 0; i < 9; ++i) s[i] = (sum[i][0] + sum[i][1]) + (sum[i][2] + sum[i][3]);
"""
    + _END
)
def point_outer_sum(
    gradient: wp.array2d(dtype=wp.float32),
    w: int,
    begin: int,
    end: int,
    entry: wp.array(dtype=wp.int32),
) -> wide:
    """Sum of ``g_a g_b'`` over pairs of a quadratic element's nodes and its four points.

    An entry is 256 element + 16 a + b; gradients are those of ``spread_gradients``.
    """


@wp.func_native(
    _BEGIN
    + """
const float* h = &wp::index(point_gradient, w, 48 * element);
float* g = &wp::index(shape_gradient_out, w, 120 * element);
const int low[6] = {0, 0, 0, 1, 1, 2}, high[6] = {1, 2, 3, 2, 3, 3};
four_t corner[4][3], weight[4];
for (int k = 0; k < 4; ++k) {
    weight[k] = four_t{} + far_edge;
    weight[k][k] += near_more;
    for (int c = 0; c < 3; ++c) {
        const float* first = h + 3 * k + c;
        corner[k][c] = four_t{first[0], first[12], first[24], first[36]};
        const four_t value = corner[k][c] * (weight[k] + (far_corner - far_edge));
        __builtin_memcpy(g + 12 * k + 4 * c, &value, sizeof(value));
    }
}
for (int edge = 0; edge < 6; ++edge) {
    const int k = low[edge], m = high[edge];
    for (int c = 0; c < 3; ++c) {
        const four_t value = corner[k][c] * weight[m] + corner[m][c] * weight[k];
        __builtin_memcpy(g + 48 + 12 * edge + 4 * c, &value, sizeof(value));
    }
}
"""
    + _UNDEFINE
)
def spread_gradients(
    point_gradient: wp.array2d(dtype=wp.float32),
    w: int,
    element: int,
    far_corner: float,
    far_edge: float,
    near_more: float,
    shape_gradient_out: wp.array2d(dtype=wp.float32),
):
    """Gradients of the ten shape functions of a quadratic element from those of L_k at its points.

    Number 12 a + 4 c + q of the 120 is component c of node a at point q.
    """


# FACTOR is empty, or a weight of every entry.
_BLOCKS = """
const float* k = &wp::index(stiffness, w, 0);
wide_t s = {}, t = {}, u = {};
for (int p = begin; p < end; ++p) {
    const int code = entry.data[p];
    const int a = (code >> 2) & 3, b = code & 3;
    const float* tet = k + 90 * (code >> 4);
    if (a >= b) {
        __builtin_memcpy(&u, tet + 9 * (a * (a + 1) / 2 + b), 9 * sizeof(float));
        s += u FACTOR;
    } else {
        __builtin_memcpy(&u, tet + 9 * (b * (b + 1) / 2 + a), 9 * sizeof(float));
        t += u FACTOR;
    }
}
s += PICK(t, 0, 3, 6, 1, 4, 7, 2, 5, 8);
"""


@wp.func_native(_BEGIN + _BLOCKS.replace("FACTOR", "* weight.data[p]") + _END)
def weighted_block_sum(
    stiffness: wp.array2d(dtype=wp.float32),
    w: int,
    begin: int,
    end: int,
    entry: wp.array(dtype=wp.int32),
    weight: wp.array(dtype=wp.float32),
) -> wide:
    """Weighted sum of stored blocks; an entry is 16 tet + 4 a + b, a tet has 90 rows: its lower blocks."""


@wp.func_native(_BEGIN + _BLOCKS.replace("FACTOR", "") + _END)
def block_sum(
    stiffness: wp.array2d(dtype=wp.float32), w: int, begin: int, end: int, entry: wp.array(dtype=wp.int32)
) -> wide:
    """The same without weights."""


@wp.func_native(
    _BEGIN
    + """
const float* l = &wp::index(a, w, 0);
const float* v = &wp::index(x, w, 0);
wide_t s = {}, t = {}, u = {};
four_t q = {};
for (int p = begin; p < end; ++p) {
    const int code = block.data[p];
    __builtin_memcpy(&q, v + 3 * column.data[p], 3 * sizeof(float));
    __builtin_memcpy(&u, l + 9 * (code >= 0 ? code : ~code), 9 * sizeof(float));
    if (code >= 0) s += u * PICK(q, 0, 1, 2, 0, 1, 2, 0, 1, 2);
    else t += u * PICK(q, 0, 0, 0, 1, 1, 1, 2, 2, 2);
}
s += PICK(t, 0, 3, 6, 1, 4, 7, 2, 5, 8);
"""
    + _END
)
def symmetric_row_sum(
    a: wp.array2d(dtype=wp.float32),
    x: wp.array2d(dtype=wp.float32),
    w: int,
    begin: int,
    end: int,
    column: wp.array(dtype=wp.int32),
    block: wp.array(dtype=wp.int32),
) -> wide:
    """Sums of products along a block row of A x; entry r is 3 r to 3 r + 2.

    A block whose bitwise not is given is transposed.
    """


@wp.func_native("""
typedef float wide_t __attribute__((vector_size(64)));
wide_t p, q, sum[4] = {};
int k = 0;
const float* x = &wp::index(array, w, a);
const float* y = &wp::index(array, w, b);
for (; k + 64 <= count; k += 64) {
    for (int i = 0; i < 4; ++i) {
        __builtin_memcpy(&p, x + k + 16 * i, sizeof(p));
        __builtin_memcpy(&q, y + k + 16 * i, sizeof(q));
        sum[i] += p * q;
    }
}
p = sum[0] + sum[1] + (sum[2] + sum[3]);
float total = 0.0f;
for (int i = 0; i < 16; ++i) total += p[i];
for (; k < count; ++k) total += x[k] * y[k];
return total;
""")
def dot(array: wp.array2d(dtype=wp.float32), w: int, a: int, b: int, count: int) -> wp.float32:
    """Sum of the products of ``count`` rows from a on with those from b on."""


@wp.func_native("""
typedef float wide_t __attribute__((vector_size(64)));
wide_t p, q;
int k = 0;
float* x = &wp::index(array_out, w, a);
const float* y = &wp::index(array_out, w, b);
for (; k + 16 <= count; k += 16) {
    __builtin_memcpy(&p, x + k, sizeof(p));
    __builtin_memcpy(&q, y + k, sizeof(q));
    p += q * factor;
    __builtin_memcpy(x + k, &p, sizeof(p));
}
for (; k < count; ++k) x[k] += y[k] * factor;
""")
def add_scaled(array_out: wp.array2d(dtype=wp.float32), w: int, a: int, b: int, count: int, factor: wp.float32):
    """Add ``factor`` times the ``count`` rows from b on to those from a on."""


@wp.func_native("""
typedef float wide_t __attribute__((vector_size(64)));
const float* a = &wp::index(matrix, w, begin);
const float* b = a + stride;
const float* c = b + stride;
const float* x = &wp::index(vector, w, 0);
wide_t sum[2][3] = {}, p, q;
int k = 0;
for (; k + 32 <= count; k += 32)
    for (int i = 0; i < 2; ++i) {
        __builtin_memcpy(&q, x + k + 16 * i, sizeof(q));
        __builtin_memcpy(&p, a + k + 16 * i, sizeof(p));
        sum[i][0] += p * q;
        __builtin_memcpy(&p, b + k + 16 * i, sizeof(p));
        sum[i][1] += p * q;
        __builtin_memcpy(&p, c + k + 16 * i, sizeof(p));
        sum[i][2] += p * q;
    }
wp::vec_t<3, wp::float32> result;
for (int r = 0; r < 3; ++r) {
    p = sum[0][r] + sum[1][r];
    float total = 0.0f;
    for (int i = 0; i < 8; ++i) total += p[i] + p[8 + i];
    const float* row = a + r * stride;
    for (int i = k; i < count; ++i) total += row[i] * x[i];
    result[r] = total;
}
return result;
""")
def three_rows(
    matrix: wp.array2d(dtype=wp.float32),
    vector: wp.array2d(dtype=wp.float32),
    w: int,
    begin: int,
    stride: int,
    count: int,
) -> wp.vec3f:
    """Products of ``count`` numbers of a vector with three rows of a matrix, which lie ``stride`` apart."""


@wp.func_native("""
typedef float wide_t __attribute__((vector_size(64)));
const float* a = &wp::index(matrix, w, begin);
const float* x = &wp::index(vector, w, 0);
wide_t sum = {}, p, q;
int k = 0;
for (; k + 16 <= count; k += 16) {
    __builtin_memcpy(&p, a + k, sizeof(p));
    __builtin_memcpy(&q, x + k, sizeof(q));
    sum += p * q;
}
float total = 0.0f;
for (int i = 0; i < 8; ++i) total += sum[i] + sum[8 + i];
for (; k < count; ++k) total += a[k] * x[k];
return total;
""")
def one_row(
    matrix: wp.array2d(dtype=wp.float32), vector: wp.array2d(dtype=wp.float32), w: int, begin: int, count: int
) -> wp.float32:
    """Product of ``count`` numbers of a vector with those of a matrix from ``begin`` on."""
