"""Displacements from modes and forces onto modes, of one node: registers run along modes, or have worlds in lanes.

Rows of the basis have a stride of a multiple of 16, as in ``reduction``. Theory: docs/theory/reduction.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant

# Three rows of Phi times amplitudes, into three rows each; a register of sums is halved until 16 bytes are left.
# Products are fused with sums, and registers of 64 bytes asked for: both only come when a function asks. Phi is larger
# than a core's cache, so rows of the node after the next three are sent for, which takes a sixth off the time.
_COLLECT = """
typedef REAL wide_t __attribute__((vector_size(64), aligned(4)));
typedef REAL half_t __attribute__((vector_size(32), aligned(4)));
typedef REAL part_t __attribute__((vector_size(16), aligned(4)));
const int count = COUNT;  // arrays of amplitudes: what is read of Phi is used for each
struct Sum {
    static __attribute__((min_vector_width(512))) void rows(const REAL* b, const REAL** q, int stride, REAL** out) {
        #pragma clang fp contract(fast)
        wide_t s[count][3] = {}, x, y[count];
        for (int k = 0; k < stride; k += 64 / sizeof(REAL)) {
            for (int i = 0; i < count; ++i) __builtin_memcpy(y + i, q[i] + k, sizeof(*y));
            for (int c = 0; c < 3; ++c) {
                __builtin_memcpy(&x, b + c * stride + k, sizeof(x));
                __builtin_prefetch(b + c * stride + k + 12 * stride, 0, 2);
                for (int i = 0; i < count; ++i) s[i][c] += x * y[i];
            }
        }
        for (int i = 0; i < count; ++i)
            for (int c = 0; c < 3; ++c) {
                half_t h[2];
                __builtin_memcpy(h, s[i] + c, sizeof(h));
                h[0] += h[1];
                part_t p[2];
                __builtin_memcpy(p, h, sizeof(p));
                p[0] += p[1];
                REAL sum = 0;
                for (int k = 0; k < (int)(16 / sizeof(REAL)); ++k) sum += p[0][k];
                out[i][c] = sum;
            }
    }
};
const REAL* q[] = {AMPLITUDES};
REAL* out[] = {TARGETS};
Sum::rows(&wp::index(basis, at), q, stride, out);
"""
_ONE = {
    "COUNT": "1",
    "AMPLITUDES": "&wp::index(amplitude, w, first)",
    "TARGETS": "&wp::index(target_out, w, row)",
}
_BOTH = {
    "COUNT": "2",
    "AMPLITUDES": "&wp::index(amplitude, w, first), &wp::index(other, w, first)",
    "TARGETS": "&wp::index(target_out, w, row), &wp::index(other_out, w, row)",
}
# The same of eight worlds; even and odd modes apart, so that sums need not wait for each other.
_COLLECT_WORLDS = """
#pragma clang fp contract(fast)
typedef float lanes_t __attribute__((vector_size(32), aligned(4)));
const float* b = &wp::index(basis, at);
const lanes_t* q = (const lanes_t*)&wp::index(amplitude, w, first);
lanes_t* out = (lanes_t*)&wp::index(target_out, w, row);
lanes_t s[3] = {}, t[3] = {};
for (int k = 0; k < stride; k += 2)
    for (int c = 0; c < 3; ++c) {
        s[c] += q[k] * b[c * stride + k];
        t[c] += q[k + 1] * b[c * stride + k + 1];
    }
for (int c = 0; c < 3; ++c) out[c] = s[c] + t[c];
"""
# Of eight worlds two arrays of amplitudes at once: what is read of Phi is used twice.
_COLLECT_PAIR = """
#pragma clang fp contract(fast)
typedef float lanes_t __attribute__((vector_size(32), aligned(4)));
const float* b = &wp::index(basis, at);
const lanes_t* q = (const lanes_t*)&wp::index(amplitude, w, first);
const lanes_t* v = (const lanes_t*)&wp::index(other, w, first);
lanes_t* out = (lanes_t*)&wp::index(target_out, w, row);
lanes_t* out_v = (lanes_t*)&wp::index(other_out, w, row);
lanes_t s[3] = {}, t[3] = {}, y[3] = {}, z[3] = {};
for (int k = 0; k < stride; k += 2)
    for (int c = 0; c < 3; ++c) {
        const float even = b[c * stride + k], odd = b[c * stride + k + 1];
        s[c] += q[k] * even;
        y[c] += v[k] * even;
        t[c] += q[k + 1] * odd;
        z[c] += v[k + 1] * odd;
    }
for (int c = 0; c < 3; ++c) out[c] = s[c] + t[c], out_v[c] = y[c] + z[c];
"""
# Amplitudes += three rows of Phi, each times a component of a force in three rows.
_SPREAD_MODES = """
#pragma clang fp contract(fast)
typedef REAL wide_t __attribute__((vector_size(64), aligned(4)));
const int width = 64 / sizeof(REAL);
const REAL* b = &wp::index(basis, at);
const REAL* f = &wp::index(force, w, row);
REAL* out = &wp::index(target_out, w, first);
wide_t s, x, y, z;
for (int k = 0; k < stride; k += width) {
    __builtin_memcpy(&s, out + k, sizeof(s));
    __builtin_memcpy(&x, b + k, sizeof(x));
    __builtin_memcpy(&y, b + stride + k, sizeof(y));
    __builtin_memcpy(&z, b + 2 * stride + k, sizeof(z));
    s += f[0] * x + f[1] * y + f[2] * z;
    __builtin_memcpy(out + k, &s, sizeof(s));
}
"""
_SPREAD_WORLDS = """
#pragma clang fp contract(fast)
typedef float lanes_t __attribute__((vector_size(32), aligned(4)));
const float* b = &wp::index(basis, at);
const lanes_t* f = (const lanes_t*)&wp::index(force, w, row);
lanes_t* out = (lanes_t*)&wp::index(target_out, w, first);
const lanes_t x = f[0], y = f[1], z = f[2];
for (int k = 0; k < stride; ++k) out[k] += x * b[k] + y * b[stride + k] + z * b[2 * stride + k];
"""


def _collect(words: dict[str, str], real: str) -> str:
    """Native code of sums over modes for one scalar type."""
    code = _COLLECT
    for word, text in words.items():
        code = code.replace(word, text)
    return code.replace("REAL", real)


@cache
def functions(variant: Variant) -> SimpleNamespace:
    """Sums over the modes of a node, and over the components of a force at it."""
    S, real = variant.S, variant.real

    @wp.func
    def displace_each(
        basis: wp.array(dtype=real),
        at: int,
        stride: int,
        amplitude: wp.array2d(dtype=S),
        w: int,
        first: int,
        target_out: wp.array2d(dtype=S),
        row: int,
    ):
        """Displacement of one node, into three rows."""
        x = S(real(0.0))
        y = S(real(0.0))
        z = S(real(0.0))
        for k in range(stride):
            q = amplitude[w, first + k]
            x += q * basis[at + k]
            y += q * basis[at + stride + k]
            z += q * basis[at + 2 * stride + k]
        target_out[w, row] = x
        target_out[w, row + 1] = y
        target_out[w, row + 2] = z

    @wp.func
    def displace_both_each(
        basis: wp.array(dtype=real),
        at: int,
        stride: int,
        amplitude: wp.array2d(dtype=S),
        other: wp.array2d(dtype=S),
        w: int,
        first: int,
        target_out: wp.array2d(dtype=S),
        other_out: wp.array2d(dtype=S),
        row: int,
    ):
        """Displacements of one node by two arrays of amplitudes, into three rows each."""
        displace(basis, at, stride, amplitude, w, first, target_out, row)
        displace(basis, at, stride, other, w, first, other_out, row)

    if variant.world_fastest:
        displace = displace_each
        return SimpleNamespace(displace=displace, displace_both=displace_both_each, push_modes=None)
    of_worlds = variant.lanes > 1
    name = "double" if real is wp.float64 else "float"

    @wp.func_native(_COLLECT_WORLDS if of_worlds else _collect(_ONE, name))
    def displace(
        basis: wp.array(dtype=real),
        at: int,
        stride: int,
        amplitude: wp.array2d(dtype=S),
        w: int,
        first: int,
        target_out: wp.array2d(dtype=S),
        row: int,
    ):
        """Displacement of one node, into three rows."""

    @wp.func_native((_SPREAD_WORLDS if of_worlds else _SPREAD_MODES).replace("REAL", name))
    def push_modes(
        basis: wp.array(dtype=real),
        at: int,
        stride: int,
        force: wp.array2d(dtype=S),
        w: int,
        row: int,
        target_out: wp.array2d(dtype=S),
        first: int,
    ):
        """Add what a force in three rows does on every mode."""

    @wp.func_native(_COLLECT_PAIR if of_worlds else _collect(_BOTH, name))
    def displace_both(
        basis: wp.array(dtype=real),
        at: int,
        stride: int,
        amplitude: wp.array2d(dtype=S),
        other: wp.array2d(dtype=S),
        w: int,
        first: int,
        target_out: wp.array2d(dtype=S),
        other_out: wp.array2d(dtype=S),
        row: int,
    ):
        """Displacements of one node by two arrays of amplitudes, into three rows each."""

    return SimpleNamespace(displace=displace, displace_both=displace_both, push_modes=push_modes)
