"""Half-solved sides of contacts of eight worlds in SIMD lanes, strip by strip of L, on a CPU in float32.

Layout and results are those of ``contact``, up to rounding. A strip of L (``kernels.linear.cholesky_strips``) is read
for all contacts of a pack, and a block of a side once for all columns of the strip. Theory: docs/theory/contact.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import variant, vec8
from softwarp.kernels.linear.cholesky_strips import MINUS, TYPES, UNDEFINE


@wp.func_native(
    TYPES
    + MINUS
    + """
const lane_t* const l = (const lane_t*)&wp::index(lower, w, 0);
const lane_t* const inverse = (const lane_t*)&wp::index(diagonal, w, 0);
const int* const start = col_start.data;
for (int strip = 0; strip < strips; ++strip) {
    const int above = strip_start.data[strip], end = strip_start.data[strip + 1];
    const int below = start[end] - start[end - 1];
    const int* const rows = l_row.data + start[end - 1];
    for (int contact = begin; contact < count; ++contact) {
        const int* const on_path = &wp::index(place, w, contact * size);
        if (on_path[end - 1] < 0) continue;
        lane_t* const y = (lane_t*)&wp::index(side_out, w, 9 * contact * path_limit);
        int first = end - 1;
        while (first > above && on_path[first - 1] >= 0) --first;
        const int width = end - first;
        const lane_t* base[8];
        lane_t z[72];
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
}
"""
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
    + """
const lane_t* const y = (const lane_t*)&wp::index(side, w, 0);
lane_t* const out = (lane_t*)&wp::index(delassus_out, w, 0);
for (int c = begin; c < count; ++c)
    for (int axis = 0; axis < 3; ++axis)
        for (int j = 0; j < 3 * (c + 1); ++j)
            out[(long)(row_count + 3 * c + axis) * order + row_count + j] = lane_t{};
for (int low = 0; low < size; low += SPAN)
    for (int c = begin; c < count; ++c) {
        const int* const mine = &wp::index(path, w, c * path_limit);
        int first = 0, end = wp::index(path_size, w, c);
        while (first < end) {
            const int middle = (first + end) / 2;
            if (mine[middle] < low) first = middle + 1; else end = middle;
        }
        const int limit = wp::index(path_size, w, c);
        for (int d = 0; d <= c; ++d) {
            const int* const theirs = &wp::index(place, w, d * size);
            lane_t* const t = out + (long)(row_count + 3 * c) * order + row_count + 3 * d;
            lane_t* const u = t + order;
            lane_t* const v = u + order;
            lane_t s0 = t[0], s1 = t[1], s2 = t[2], s3 = u[0], s4 = u[1], s5 = u[2], s6 = v[0], s7 = v[1], s8 = v[2];
            for (int k = first; k < limit && mine[k] < low + SPAN; ++k) {
                const int other = theirs[mine[k]];
                if (other < 0) continue;
                const lane_t* const a = y + 9 * (c * path_limit + k);
                const lane_t* const b = y + 9 * (d * path_limit + other);
                for (int r = 0; r < 9; r += 3) {
                    s0 += a[r] * b[r]; s1 += a[r] * b[r + 1]; s2 += a[r] * b[r + 2];
                    s3 += a[r + 1] * b[r]; s4 += a[r + 1] * b[r + 1]; s5 += a[r + 1] * b[r + 2];
                    s6 += a[r + 2] * b[r]; s7 += a[r + 2] * b[r + 1]; s8 += a[r + 2] * b[r + 2];
                }
            }
            t[0] = s0; t[1] = s1; t[2] = s2; u[0] = s3; u[1] = s4; u[2] = s5; v[0] = s6; v[1] = s7; v[2] = s8;
        }
    }
for (int i = row_count + 3 * begin; i < row_count + 3 * count; ++i)
    for (int j = row_count; j < row_count + 3 * ((i - row_count) / 3 + 1); ++j) {
        const lane_t value = out[(long)i * order + j] * scale;
        out[(long)i * order + j] = value;
        if (j < row_count + 3 * ((i - row_count) / 3)) out[(long)j * order + i] = value;
    }
""".replace("SPAN", str(SPAN))
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
