"""Half-solved sides of contacts of eight worlds in SIMD lanes, strip by strip of L, on a CPU in float32.

Layout and results are those of ``contact``, up to rounding. A strip of L (``kernels.linear.cholesky_strips``) is read
for all contacts of a pack, and a block of a side once for all columns of the strip. Theory: docs/theory/contact.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import variant, vec8
from softwarp.kernels.linear.cholesky_strips import MINUS, TYPES, UNDEFINE

# Contacts in pairs, where registers have 512 bits: what is read of L serves both. They are asked for, as compilers
# halve them on processors that have them.
PAIRS = """
#ifdef __AVX512F__
#define PAIRED 1
#else
#define PAIRED 0
#endif
typedef float pair_t __attribute__((vector_size(64), may_alias));
#define FIRST 0, 1, 2, 3, 4, 5, 6, 7
#define SECOND 8, 9, 10, 11, 12, 13, 14, 15
#define BOTH(p, q) __builtin_shufflevector((p), (q), FIRST, SECOND)
#define TWICE(p) __builtin_shufflevector((p), (p), FIRST, FIRST)
#define PART(p, half) __builtin_shufflevector((p), (p), half)
"""
UNPAIR = "".join(f"\n#undef {name}" for name in ("PAIRED", "FIRST", "SECOND", "BOTH", "TWICE", "PART")) + "\n"


WIDTH = 8  # columns of a strip, at most: a side is read and written once for all of them
AT_ONCE = 16  # pairs that take a strip's rows together
ROWS = 8


@wp.func_native(
    TYPES
    + MINUS
    + PAIRS
    + """
struct Pair {
    int first;
    lane_t *y, *other;
    const int *on_path, *on_other;
    pair_t z[9 * WIDTH];
};
struct Strip {
    const lane_t *l, *inverse;
    const int *start, *rows;
    int end, below;

    void single(int first, lane_t* y, const int* on_path) const {
        #pragma clang fp contract(fast)
        const int width = end - first;
        const lane_t* base[WIDTH];
        alignas(64) lane_t z[9 * WIDTH];
        for (int j = 0; j < width; ++j) {
            lane_t* const x = y + 9 * on_path[first + j];
            MINUS(x, j, l + 9 * (start[first + c] + j - c - 1), z + 9 * c, 3, 1)
            const lane_t* const d = inverse + 6 * (first + j);
            for (int s = 0; s < 3; ++s) {
                const lane_t x0 = x[s], x1 = x[3 + s], x2 = x[6 + s];
                lane_t* const q = z + 9 * j + s;
                x[s] = q[0] = d[0] * x0;
                x[3 + s] = q[3] = d[1] * x0 + d[2] * x1;
                x[6 + s] = q[6] = d[3] * x0 + d[4] * x1 + d[5] * x2;
            }
            base[j] = l + 9 * (start[first + j] + width - 1 - j);
        }
        for (int r = 0; r < below; ++r)
            MINUS(y + 9 * on_path[rows[r]], width, base[c] + 9 * r, z + 9 * c, 3, 1)
    }

    static inline __attribute__((always_inline, min_vector_width(512))) void minus(
        pair_t* t, int columns, const lane_t* const* left, const pair_t* z
    ) {
        #pragma clang fp contract(fast)
        pair_t s0 = t[0], s1 = t[1], s2 = t[2], s3 = t[3], s4 = t[4], s5 = t[5], s6 = t[6], s7 = t[7], s8 = t[8];
        for (int c = 0; c < columns; ++c, z += 9)
            for (int m = 0; m < 3; ++m) {
                const lane_t* const b = left[c] + m;
                const pair_t z0 = z[3 * m], z1 = z[3 * m + 1], z2 = z[3 * m + 2];
                const pair_t b0 = TWICE(b[0]), b1 = TWICE(b[3]), b2 = TWICE(b[6]);
                s0 -= b0 * z0; s1 -= b0 * z1; s2 -= b0 * z2;
                s3 -= b1 * z0; s4 -= b1 * z1; s5 -= b1 * z2;
                s6 -= b2 * z0; s7 -= b2 * z1; s8 -= b2 * z2;
            }
        t[0] = s0; t[1] = s1; t[2] = s2; t[3] = s3; t[4] = s4; t[5] = s5; t[6] = s6; t[7] = s7; t[8] = s8;
    }

    __attribute__((min_vector_width(512))) void top(Pair& p) const {
        #pragma clang fp contract(fast)
        const lane_t* base[WIDTH];
        pair_t t[9];
        for (int j = 0; j < end - p.first; ++j) {
            lane_t *const x = p.y + 9 * p.on_path[p.first + j], *const o = p.other + 9 * p.on_other[p.first + j];
            for (int i = 0; i < 9; ++i) t[i] = BOTH(x[i], o[i]);
            for (int c = 0; c < j; ++c) base[c] = l + 9 * (start[p.first + c] + j - c - 1);
            minus(t, j, base, p.z);
            const lane_t* const d = inverse + 6 * (p.first + j);
            for (int s = 0; s < 3; ++s) {
                const pair_t x0 = t[s], x1 = t[3 + s], x2 = t[6 + s];
                pair_t* const q = p.z + 9 * j + s;
                q[0] = TWICE(d[0]) * x0;
                q[3] = TWICE(d[1]) * x0 + TWICE(d[2]) * x1;
                q[6] = TWICE(d[3]) * x0 + TWICE(d[4]) * x1 + TWICE(d[5]) * x2;
            }
            for (int i = 0; i < 9; ++i) {
                x[i] = PART(p.z[9 * j + i], FIRST);
                o[i] = PART(p.z[9 * j + i], SECOND);
            }
        }
    }

    __attribute__((min_vector_width(512))) void rest(const Pair& p, int from, int to) const {
        const int width = end - p.first;
        const lane_t* base[WIDTH];
        pair_t t[9];
        for (int r = from; r < to; ++r) {
            lane_t *const x = p.y + 9 * p.on_path[rows[r]], *const o = p.other + 9 * p.on_other[rows[r]];
            for (int i = 0; i < 9; ++i) t[i] = BOTH(x[i], o[i]);
            for (int c = 0; c < width; ++c) base[c] = l + 9 * (start[p.first + c] + width - 1 - c + r);
            minus(t, width, base, p.z);
            for (int i = 0; i < 9; ++i) {
                x[i] = PART(t[i], FIRST);
                o[i] = PART(t[i], SECOND);
            }
        }
    }

    void all(Pair* pairs, int count) const {
        for (int i = 0; i < count; ++i) top(pairs[i]);
        for (int r = 0; r < below; r += ROWS)
            for (int i = 0; i < count; ++i) rest(pairs[i], r, r + ROWS < below ? r + ROWS : below);
    }
};
Strip s = {(const lane_t*)&wp::index(lower, w, 0), (const lane_t*)&wp::index(diagonal, w, 0), col_start.data};
auto side = [&](int contact) { return (lane_t*)&wp::index(side_out, w, 9 * contact * path_limit); };
auto places = [&](int contact) { return (const int*)&wp::index(place, w, contact * size); };
Pair pairs[PAIRED ? AT_ONCE : 1];
for (int strip = 0; strip < strips; ++strip) {
    const int above = strip_start.data[strip];
    s.end = strip_start.data[strip + 1];
    s.below = s.start[s.end] - s.start[s.end - 1];
    s.rows = l_row.data + s.start[s.end - 1];
    int waiting[WIDTH], found = 0;
    for (int& contact : waiting) contact = -1;
    for (int contact = begin; contact < count; ++contact) {
        const int* const on_path = places(contact);
        if (on_path[s.end - 1] < 0) continue;
        int first = s.end - 1;
        while (first > above && on_path[first - 1] >= 0) --first;
        int& partner = waiting[first - above];
        if (!PAIRED) {
            s.single(first, side(contact), on_path);
        } else if (partner < 0) {
            partner = contact;
        } else {
            Pair& p = pairs[found++];
            p.first = first;
            p.y = side(partner); p.on_path = places(partner);
            p.other = side(contact); p.on_other = on_path;
            partner = -1;
            if (found == AT_ONCE) { s.all(pairs, found); found = 0; }
        }
    }
    s.all(pairs, found);
    for (int i = 0; PAIRED && i < s.end - above; ++i)
        if (waiting[i] >= 0) s.single(above + i, side(waiting[i]), places(waiting[i]));
}
""".replace("WIDTH", str(WIDTH))
    .replace("ROWS", str(ROWS))
    .replace("AT_ONCE", str(AT_ONCE))
    + UNPAIR
    + UNDEFINE
)
def substitute_strips(
    w: int,
    size: int,
    path_limit: int,
    strips: int,
    begin: int,
    count: int,
    strip_start: wp.array(dtype=wp.int32),
    l_row: wp.array(dtype=wp.int32),
    col_start: wp.array(dtype=wp.int32),
    place: wp.array2d(dtype=wp.int32),
    lower: wp.array2d(dtype=vec8),
    diagonal: wp.array2d(dtype=vec8),
    side_out: wp.array2d(dtype=vec8),
):
    """``Y_c <- L^-1 Y_c`` of contacts ``begin`` to ``count``; what follows a column of a path lies on the path."""


SPAN = 24  # rows of the tree for which the sides of a pack's contacts stay in a core's own cache


@wp.func_native(
    TYPES
    + PAIRS
    + """
struct Products {
    const lane_t* y;
    lane_t* out;
    const int *path, *path_size, *place;
    int size, path_limit, row_count, order;

    const int* places(int contact) const { return place + (long)contact * size; }
    lane_t* block(int c, int d) const { return out + (long)(row_count + 3 * c) * order + row_count + 3 * d; }

    static void add(lane_t* t, lane_t* u, lane_t* v, const lane_t* a, const lane_t* b, int rows) {
        #pragma clang fp contract(fast)
        lane_t s0 = t[0], s1 = t[1], s2 = t[2], s3 = u[0], s4 = u[1], s5 = u[2], s6 = v[0], s7 = v[1], s8 = v[2];
        for (int k = 0; k < rows; ++k, a += 9, b += 9)
            for (int r = 0; r < 9; r += 3) {
                s0 += a[r] * b[r]; s1 += a[r] * b[r + 1]; s2 += a[r] * b[r + 2];
                s3 += a[r + 1] * b[r]; s4 += a[r + 1] * b[r + 1]; s5 += a[r + 1] * b[r + 2];
                s6 += a[r + 2] * b[r]; s7 += a[r + 2] * b[r + 1]; s8 += a[r + 2] * b[r + 2];
            }
        t[0] = s0; t[1] = s1; t[2] = s2; u[0] = s3; u[1] = s4; u[2] = s5; v[0] = s6; v[1] = s7; v[2] = s8;
    }

    void single(int c, int low) const {
        #pragma clang fp contract(fast)
        const int* const mine = path + (long)c * path_limit;
        int first = 0, end = path_size[c];
        while (first < end) {
            const int middle = (first + end) / 2;
            if (mine[middle] < low) first = middle + 1; else end = middle;
        }
        const int limit = path_size[c];
        for (end = first; end < limit && mine[end] < low + SPAN; ++end);
        if (first == end) return;
        const int row = mine[first], rows = end - first;
        const bool is_run = mine[end - 1] - row == rows - 1;
        const lane_t* const a = y + 9 * (c * path_limit + first);
        for (int d = 0; d <= c; ++d) {
            const int* const theirs = places(d);
            lane_t *const t = block(c, d), *const u = t + order, *const v = u + order;
            if (is_run && theirs[row] >= 0 && theirs[row + rows - 1] - theirs[row] == rows - 1) {
                add(t, u, v, a, y + 9 * (d * path_limit + theirs[row]), rows);
                continue;
            }
            for (int k = first; k < end; ++k) {
                const int other = theirs[mine[k]];
                if (other >= 0) add(t, u, v, y + 9 * (c * path_limit + k), y + 9 * (d * path_limit + other), 1);
            }
        }
    }

    __attribute__((min_vector_width(512))) void both(int c, int low) const {
        #pragma clang fp contract(fast)
        const int *const mine = places(c), *const next = places(c + 1);
        pair_t a[SPAN][9];
        int row[SPAN], rows = 0;
        for (int k = low; k < low + SPAN && k < size; ++k) {
            if (mine[k] < 0 && next[k] < 0) continue;
            const lane_t none[9] = {};
            const lane_t* const p = mine[k] < 0 ? none : y + 9 * (c * path_limit + mine[k]);
            const lane_t* const q = next[k] < 0 ? none : y + 9 * ((c + 1) * path_limit + next[k]);
            for (int i = 0; i < 9; ++i) a[rows][i] = BOTH(p[i], q[i]);
            row[rows++] = k;
        }
        if (rows == 0) return;
        for (int d = 0; d <= c + 1; ++d) {
            const int* const theirs = places(d);
            lane_t *const t = block(c, d), *const u = block(c + 1, d);
            pair_t s[9];
            for (int i = 0; i < 9; ++i) s[i] = BOTH(t[i / 3 * order + i % 3], u[i / 3 * order + i % 3]);
            for (int k = 0; k < rows; ++k) {
                const int other = theirs[row[k]];
                if (other < 0) continue;
                const lane_t* const b = y + 9 * (d * path_limit + other);
                for (int r = 0; r < 9; r += 3) {
                    const pair_t b0 = TWICE(b[r]), b1 = TWICE(b[r + 1]), b2 = TWICE(b[r + 2]);
                    const pair_t a0 = a[k][r], a1 = a[k][r + 1], a2 = a[k][r + 2];
                    s[0] += a0 * b0; s[1] += a0 * b1; s[2] += a0 * b2;
                    s[3] += a1 * b0; s[4] += a1 * b1; s[5] += a1 * b2;
                    s[6] += a2 * b0; s[7] += a2 * b1; s[8] += a2 * b2;
                }
            }
            for (int i = 0; i < 9; ++i) {
                t[i / 3 * order + i % 3] = PART(s[i], FIRST);
                u[i / 3 * order + i % 3] = PART(s[i], SECOND);
            }
        }
    }
};
const Products p = {
    (const lane_t*)&wp::index(side, w, 0), (lane_t*)&wp::index(delassus_out, w, 0), &wp::index(path, w, 0),
    &wp::index(path_size, w, 0), &wp::index(place, w, 0), size, path_limit, row_count, order
};
lane_t* const out = p.out;
for (int c = begin; c < count; ++c)
    for (int axis = 0; axis < 3; ++axis)
        for (int j = 0; j < 3 * (c + 1); ++j)
            out[(long)(row_count + 3 * c + axis) * order + row_count + j] = lane_t{};
for (int low = 0; low < size; low += SPAN) {
    int c = begin;
    for (; PAIRED && c + 1 < count; c += 2) p.both(c, low);
    for (; c < count; ++c) p.single(c, low);
}
for (int i = row_count + 3 * begin; i < row_count + 3 * count; ++i)
    for (int j = row_count; j < row_count + 3 * ((i - row_count) / 3 + 1); ++j) {
        const lane_t value = out[(long)i * order + j] * scale;
        out[(long)i * order + j] = value;
        if (j < row_count + 3 * ((i - row_count) / 3)) out[(long)j * order + i] = value;
    }
""".replace("SPAN", str(SPAN))
    + UNPAIR
)
def contact_products(
    w: int,
    size: int,
    path_limit: int,
    row_count: int,
    order: int,
    begin: int,
    count: int,
    path_size: wp.array2d(dtype=wp.int32),
    path: wp.array2d(dtype=wp.int32),
    place: wp.array2d(dtype=wp.int32),
    side: wp.array2d(dtype=vec8),
    scale: wp.float32,
    delassus_out: wp.array2d(dtype=vec8),
):
    """W of contacts ``begin`` to ``count`` with all up to them, and its mirror image."""


@wp.func_native(
    TYPES
    + """
lane_t* const out = (lane_t*)&wp::index(delassus_out, w, 0);
const lane_t* const x = (const lane_t*)&wp::index(side, w, 9 * contact * path_limit);
const int* const mine = &wp::index(path, w, contact * path_limit);
const int length = wp::index(path_size, w, contact);
const int i = row_count + 3 * contact;
for (int row = 0; row < row_count; row += 3) {
    const int others = row_count - row < 3 ? row_count - row : 3;
    const lane_t* y[3];
    for (int n = 0; n < 3; ++n) y[n] = (const lane_t*)&wp::index(sides, w, 3 * size * (1 + row + (n < others ? n : 0)));
    lane_t s[9] = {};
    for (int k = 0; k < length; ++k)
        for (int r = 0; r < 3; ++r) {
            const lane_t* const a = x + 9 * k + 3 * r;
            for (int n = 0; n < 3; ++n) {
                const lane_t b = y[n][3 * mine[k] + r];
                s[3 * n] += a[0] * b;
                s[3 * n + 1] += a[1] * b;
                s[3 * n + 2] += a[2] * b;
            }
        }
    for (int n = 0; n < others; ++n)
        for (int axis = 0; axis < 3; ++axis) {
            const lane_t value = s[3 * n + axis] * scale;
            out[(long)(row + n) * order + i + axis] = value;
            out[(long)(i + axis) * order + row + n] = value;
        }
}
"""
)
def row_products(
    w: int,
    size: int,
    path_limit: int,
    row_count: int,
    order: int,
    contact: int,
    path_size: wp.array2d(dtype=wp.int32),
    path: wp.array2d(dtype=wp.int32),
    side: wp.array2d(dtype=vec8),
    sides: wp.array2d(dtype=vec8),
    scale: wp.float32,
    delassus_out: wp.array2d(dtype=vec8),
):
    """W of one contact with the static rows, whose half-solved ``sides`` begin behind the first."""


@cache
def kernels() -> SimpleNamespace:
    """Compile-once set of kernels of packs of eight worlds."""
    module = variant("lanes").module("contact_strips")

    @wp.kernel(module=module, enable_backward=False)
    def substitute(
        # Symbolic
        size: int,
        path_limit: int,
        strips: int,
        strip_start: wp.array(dtype=wp.int32),
        l_row: wp.array(dtype=wp.int32),
        col_start: wp.array(dtype=wp.int32),
        # Workspace in
        pack_first_in: wp.array2d(dtype=wp.int32),
        pack_count_in: wp.array2d(dtype=wp.int32),
        place_in: wp.array2d(dtype=wp.int32),
        lower_in: wp.array2d(dtype=vec8),
        diagonal_in: wp.array2d(dtype=vec8),
        # Workspace out
        side_out: wp.array2d(dtype=vec8),
    ):
        """Half-solved sides of the contacts of one pack."""
        w = wp.tid()
        substitute_strips(
            w,
            size,
            path_limit,
            strips,
            pack_first_in[w, 0],
            pack_count_in[w, 0],
            strip_start,
            l_row,
            col_start,
            place_in,
            lower_in,
            diagonal_in,
            side_out,
        )

    @wp.kernel(module=module, enable_backward=False)
    def delassus(
        # Symbolic
        size: int,
        path_limit: int,
        row_count: int,
        order: int,
        # Workspace in
        pack_first_in: wp.array2d(dtype=wp.int32),
        pack_count_in: wp.array2d(dtype=wp.int32),
        path_size_in: wp.array2d(dtype=wp.int32),
        path_in: wp.array2d(dtype=wp.int32),
        place_in: wp.array2d(dtype=wp.int32),
        side_in: wp.array2d(dtype=vec8),
        y_in: wp.array2d(dtype=vec8),
        scale: wp.float32,
        # Workspace out
        delassus_out: wp.array2d(dtype=vec8),
    ):
        """Rows of W of the contacts of one pack, with each other and with static rows."""
        w = wp.tid()
        first = pack_first_in[w, 0]
        count = pack_count_in[w, 0]
        contact_products(
            w,
            size,
            path_limit,
            row_count,
            order,
            first,
            count,
            path_size_in,
            path_in,
            place_in,
            side_in,
            scale,
            delassus_out,
        )
        for contact in range(first, count):
            row_products(
                w,
                size,
                path_limit,
                row_count,
                order,
                contact,
                path_size_in,
                path_in,
                side_in,
                y_in,
                scale,
                delassus_out,
            )

    return SimpleNamespace(substitute=substitute, delassus=delassus)
