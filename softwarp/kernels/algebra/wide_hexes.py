"""Hexahedra of one world on a CPU in float32, in SIMD registers. Used where ``wide.is_wide`` holds.

A shape's stiffness is a symmetric matrix of 24 x 24 numbers, three registers of eight to a row.
"""

import warp as wp

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
