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

    return SimpleNamespace(substitute=substitute)
