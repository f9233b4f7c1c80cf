"""Hexahedra on a CPU in float32, in SIMD registers: of one world, where ``wide.is_wide`` holds, or of eight in lanes.

A shape's stiffness is a symmetric matrix of 24 x 24 numbers, of one world three registers of eight to a row.
"""

import warp as wp

from softwarp.kernels.algebra.lanes import LANE_COUNT, vec8

_EIGHT = """
typedef float eight_t __attribute__((vector_size(32)));
typedef float four_t __attribute__((vector_size(16)));
"""


@wp.func_native(
    "#pragma clang fp contract(fast)\n"
    + _EIGHT
    + """
const float* const k = &wp::index(stiffness, w, 576 * shape);
const float* const u = &wp::index(strain, w, 24 * hex);
eight_t row, s[3] = {};
for (int j = 3; j < 24; ++j)
    for (int part = 0; part < 3; ++part) {
        __builtin_memcpy(&row, k + 24 * j + 8 * part, sizeof(row));
        s[part] += row * u[j];
    }
__builtin_memcpy(&wp::index(force_out, w, out), s, sizeof(s));
"""
)
def apply_stiffness(
    stiffness: wp.array2d(dtype=wp.float32),
    strain: wp.array2d(dtype=wp.float32),
    w: int,
    shape: int,
    hex: int,
    out: int,
    force_out: wp.array2d(dtype=wp.float32),
):
    """K u of one hexahedron, whose first corner has u = 0, to rows ``out`` onwards."""


@wp.func_native(
    "#pragma clang fp contract(fast)\n"
    + _EIGHT
    + """
float* const a = &wp::index(a_out, w, 0);
const int count = body.shape[0];
for (int hex = 0; hex < count; ++hex) {
    const float* const k = &wp::index(stiffness, w, 576 * shape.data[hex]);
    const float* const q = &wp::index(rotation, w, 9 * hex);
    const float scale = wp::index(body_scale, w, body.data[hex]) * factor.data[hex];
    const int* const place = block.data + 36 * hex;
    const four_t turn[3] = {{q[0], q[3], q[6], 0.0f}, {q[1], q[4], q[7], 0.0f}, {q[2], q[5], q[8], 0.0f}};
    float scaled[9];
    for (int i = 0; i < 9; ++i) scaled[i] = scale * q[i];
    for (int m = 0; m < 8; ++m) {
        float left[3][24];  // rows of Q K
        for (int part = 0; 8 * part < 3 * m + 3; ++part) {
            eight_t row[3];
            for (int r = 0; r < 3; ++r) __builtin_memcpy(row + r, k + 24 * (3 * m + r) + 8 * part, sizeof(eight_t));
            for (int r = 0; r < 3; ++r) {
                const eight_t s = row[0] * scaled[3 * r] + row[1] * scaled[3 * r + 1] + row[2] * scaled[3 * r + 2];
                __builtin_memcpy(left[r] + 8 * part, &s, sizeof(s));
            }
        }
        for (int n = 0; n <= m; ++n) {
            const int code = place[m * (m + 1) / 2 + n];
            if (code < 0) continue;
            float* const target = a + 9 * (code >> 1);
            four_t s[3];
            for (int r = 0; r < 3; ++r) {
                const float* const v = left[r] + 3 * n;
                s[r] = turn[0] * v[0] + turn[1] * v[1] + turn[2] * v[2];
            }
            if (code & 1)
                for (int r = 0; r < 3; ++r)
                    for (int c = 0; c < 3; ++c) target[3 * c + r] += s[r][c];
            else
                for (int r = 0; r < 3; ++r)
                    for (int c = 0; c < 3; ++c) target[3 * r + c] += s[r][c];
        }
    }
}
"""
)
def add_stiffness(
    w: int,
    body: wp.array(dtype=wp.int32),
    shape: wp.array(dtype=wp.int32),
    factor: wp.array(dtype=wp.float32),
    block: wp.array2d(dtype=wp.int32),
    body_scale: wp.array2d(dtype=wp.float32),
    stiffness: wp.array2d(dtype=wp.float32),
    rotation: wp.array2d(dtype=wp.float32),
    a_out: wp.array2d(dtype=wp.float32),
):
    """Add Q K Q' of all hexahedra to A; ``block`` has 2 block, + 1 transposed, or -1, of every pair of corners."""


_LANES = f"typedef float lane_t __attribute__((vector_size({4 * LANE_COUNT}), aligned(4), may_alias));\n"


@wp.func_native(
    "#pragma clang fp contract(fast)\n"
    + _LANES
    + """
const lane_t* const k = (const lane_t*)&wp::index(stiffness, w, 576 * shape);
const lane_t* const u = (const lane_t*)&wp::index(strain, w, 24 * hex);
lane_t* const f = (lane_t*)&wp::index(force_out, w, out);
for (int i = 3; i < 24; i += 3) {
    lane_t s[3] = {};
    for (int j = 3; j < 24; ++j)
        for (int r = 0; r < 3; ++r) s[r] += k[24 * (i + r) + j] * u[j];
    for (int r = 0; r < 3; ++r) f[i + r] = s[r];
}
"""
)
def apply_stiffness_of_lanes(
    stiffness: wp.array2d(dtype=vec8),
    strain: wp.array2d(dtype=vec8),
    w: int,
    shape: int,
    hex: int,
    out: int,
    force_out: wp.array2d(dtype=vec8),
):
    """The same of eight worlds."""


@wp.func_native(
    "#pragma clang fp contract(fast)\n"
    + _LANES
    + """
lane_t* const a = (lane_t*)&wp::index(a_out, w, 0);
const int blocks = start.shape[0] - 1;
for (int block = 0; block < blocks; ++block) {
    if (start.data[block] == start.data[block + 1]) continue;
    lane_t s[9] = {};
    for (int p = start.data[block]; p < start.data[block + 1]; ++p) {
        const int hex = entry.data[p] >> 6, m = (entry.data[p] >> 3) & 7, n = entry.data[p] & 7;
        const lane_t* const k = (const lane_t*)&wp::index(stiffness, w, 576 * shape.data[hex] + 72 * m + 3 * n);
        const lane_t* const q = (const lane_t*)&wp::index(rotation, w, 9 * hex);
        for (int r = 0; r < 3; ++r) {
            lane_t left[3];
            for (int c = 0; c < 3; ++c)
                left[c] = (q[3 * r] * k[c] + q[3 * r + 1] * k[24 + c] + q[3 * r + 2] * k[48 + c]) * factor.data[hex];
            for (int c = 0; c < 3; ++c)
                s[3 * r + c] += left[0] * q[3 * c] + left[1] * q[3 * c + 1] + left[2] * q[3 * c + 2];
        }
    }
    const int first = body.data[entry.data[start.data[block]] >> 6];
    const lane_t scale = *(const lane_t*)&wp::index(body_scale, w, first);
    for (int i = 0; i < 9; ++i) a[9 * block + i] += s[i] * scale;
}
"""
)
def add_stiffness_of_lanes(
    w: int,
    body: wp.array(dtype=wp.int32),
    shape: wp.array(dtype=wp.int32),
    factor: wp.array(dtype=wp.float32),
    start: wp.array(dtype=wp.int32),
    entry: wp.array(dtype=wp.int32),
    body_scale: wp.array2d(dtype=vec8),
    stiffness: wp.array2d(dtype=vec8),
    rotation: wp.array2d(dtype=vec8),
    a_out: wp.array2d(dtype=vec8),
):
    """The same of eight worlds, block after block of A; an entry is 64 hex + 8 m + n."""
