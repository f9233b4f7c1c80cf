"""Laws of one contact for eight worlds in SIMD lanes, on a CPU in float32. Theory: docs/theory/coulomb.md.

Steps and results are those of ``solve_contact`` of ``coulomb``, up to rounding, in C++ for the compiler's vector types:
the many short expressions of the laws took Warp's vectors, which go lane by lane, longer than the products with W.
"""

import warp as wp

from softwarp.kernels.algebra.lanes import vec8
from softwarp.kernels.linear.cholesky_strips import TYPES


def contact_law(curve_steps: int, curve_limit: float, proximal: float) -> wp.Function:
    """``solve_contact`` for lanes; arguments are constants of ``coulomb``."""
    code = (
        TYPES
        + """
#define LARGER(a, b) ((a) > (b) ? (a) : (b))
#define SMALLER(a, b) ((a) < (b) ? (a) : (b))
#define SIZE(a) LARGER(a, -(a))
const int i = rows + 3 * contact;
const lane_t* const W = (const lane_t*)&wp::index(delassus, w, i * order);
const lane_t* const W1 = W + order;
const lane_t* const W2 = W1 + order;
lane_t* const d = (lane_t*)&wp::index(change, w, 0);
lane_t* const f = (lane_t*)&wp::index(multiplier, w, 3 * contact);
const lane_t* const free_gap = (const lane_t*)&wp::index(gap, w, i);
lane_t& kept = *(lane_t*)&wp::index(curve, w, contact);
const lane_t soft = *(const lane_t*)&wp::index(compliance, w, contact);
const lane_t friction = *(const lane_t*)&wp::index(mu, w, contact);
const lane_t zero = {}, one = zero + 1.0f, tiny = zero + 1.0e-30f;
lane_t on;
__builtin_memcpy(&on, &active, sizeof(on));

lane_t s0 = {}, s1 = {}, s2 = {}, t0 = {}, t1 = {}, t2 = {};
int j = 0;
for (; j + 1 < total; j += 2) {
    s0 += W[j] * d[j]; s1 += W1[j] * d[j]; s2 += W2[j] * d[j];
    t0 += W[j + 1] * d[j + 1]; t1 += W1[j + 1] * d[j + 1]; t2 += W2[j + 1] * d[j + 1];
}
if (j < total) { s0 += W[j] * d[j]; s1 += W1[j] * d[j]; s2 += W2[j] * d[j]; }

const lane_t old0 = f[0], old1 = f[1], old2 = f[2];
const lane_t diagonal = W[i] + soft;
const lane_t g = free_gap[0] + s0 + t0 + soft * old0;
lane_t new0 = old0 - g * (diagonal / (diagonal * diagonal + 1.0e-36f));
new0 = LARGER(new0, zero);
const lane_t g1 = free_gap[1] + s1 + t1 + W1[i] * (new0 - old0);
const lane_t g2 = free_gap[2] + s2 + t2 + W2[i] * (new0 - old0);
const lane_t radius = friction * new0;

const lane_t spread = W1[i + 1] + W2[i + 2];
const lane_t unit = spread / (spread * spread + 1.0e-36f);
const lane_t a11 = W1[i + 1] * unit + PROXIMAL, a22 = W2[i + 2] * unit + PROXIMAL, a12 = W2[i + 1] * unit;
const lane_t b1 = g1 * unit - a11 * old1 - a12 * old2;
const lane_t b2 = g2 * unit - a12 * old1 - a22 * old2;
const lane_t c1 = a22 * b1 - a12 * b2, c2 = a11 * b2 - a12 * b1;
const lane_t determinant = a11 * a22 - a12 * a12, trace = a11 + a22;
lane_t bend = kept, q, new1, new2, length;
for (int step = 0; step < CURVE_STEPS; ++step) {
    q = one / (determinant + bend * (trace + bend));
    new1 = -(c1 + bend * b1) * q;
    new2 = -(c2 + bend * b2) * q;
    const lane_t square = new1 * new1 + new2 * new2;
    length = __builtin_elementwise_sqrt(square);
    const lane_t least = length * 1.0e-3f;
    const lane_t bound = LARGER(radius, least) + tiny;
    const lane_t slope = ((a22 + bend) * (new1 * new1) + (a11 + bend) * (new2 * new2) - a12 * (new1 * new2) * 2.0f) * q;
    bend += (length / bound - one) * (square / (slope + tiny));
    bend = LARGER(bend, zero);
    bend = SMALLER(bend, zero + CURVE_LIMIT);
}
q = one / (determinant + bend * (trace + bend));
new1 = -(c1 + bend * b1) * q;
new2 = -(c2 + bend * b2) * q;
length = __builtin_elementwise_sqrt(new1 * new1 + new2 * new2);
lane_t shrink = radius / LARGER(length, tiny);
shrink = SMALLER(shrink, one);

const lane_t held = one - on;
new0 = new0 * on + old0 * held;
new1 = new1 * shrink * on + old1 * held;
new2 = new2 * shrink * on + old2 * held;
kept = bend * on + kept * held;
const lane_t step0 = new0 - old0, step1 = new1 - old1, step2 = new2 - old2;
f[0] = new0; f[1] = new1; f[2] = new2;
d[i] += step0; d[i + 1] += step1; d[i + 2] += step2;
const lane_t slide1 = SIZE(step1), slide2 = SIZE(step2);
const lane_t press = SIZE(step0) * diagonal, slide = LARGER(slide1, slide2) * spread;
const lane_t worst = LARGER(press, slide);
wp::vec_t<8, wp::float32> result;
__builtin_memcpy(&result, &worst, sizeof(worst));
#undef LARGER
#undef SMALLER
#undef SIZE
return result;
"""
    )
    for name, value in (
        ("CURVE_STEPS", str(curve_steps)),
        ("CURVE_LIMIT", f"{curve_limit}f"),
        ("PROXIMAL", f"{proximal}f"),
    ):
        code = code.replace(name, value)

    @wp.func_native(code)
    def solve_contact(
        delassus: wp.array2d(dtype=vec8),
        gap: wp.array2d(dtype=vec8),
        mu: wp.array2d(dtype=vec8),
        compliance: wp.array2d(dtype=vec8),
        multiplier: wp.array2d(dtype=vec8),
        change: wp.array2d(dtype=vec8),
        curve: wp.array2d(dtype=vec8),
        w: int,
        order: int,
        rows: int,
        total: int,
        contact: int,
        active: vec8,
    ) -> vec8:
        """Bring one contact to Signorini's and then to Coulomb's law; returns the correction [m] that this took."""

    return solve_contact


def memory_products(memory: int, damping: float) -> wp.Function:
    """``products`` of ``coulomb`` for lanes; arguments are its constants."""
    code = (
        TYPES
        + """
const lane_t* const W = (const lane_t*)&wp::index(delassus, w, 0);
const lane_t* const past = (const lane_t*)&wp::index(history, w, 0);
lane_t* const sums = (lane_t*)&wp::index(gram, w, 0);
const lane_t* const correction = past + 2 * order;
const lane_t* const change = past + 3 * order;
const lane_t* const way = change + MEMORY * order;
lane_t g[MEMORY] = {}, b[MEMORY] = {};
for (int i = 0; i < total; ++i) {
    const lane_t weight = W[(long)i * order + i];
    const lane_t left = weight * change[slot * order + i], right = weight * correction[i];
    const lane_t moved = weight * way[slot * order + i] * DAMPING;
    for (int k = 0; k < MEMORY; ++k) {
        g[k] += change[k * order + i] * left + way[k * order + i] * moved;
        b[k] += change[k * order + i] * right;
    }
}
for (int k = 0; k < MEMORY; ++k) {
    sums[MEMORY * k + slot] = g[k];
    sums[MEMORY * slot + k] = g[k];
    sums[2 * MEMORY * MEMORY + k] = b[k];
}
"""
    ).replace("MEMORY", str(memory))

    @wp.func_native(code.replace("DAMPING", f"{damping}f"))
    def products(
        delassus: wp.array2d(dtype=vec8),
        history: wp.array2d(dtype=vec8),
        gram: wp.array2d(dtype=vec8),
        w: int,
        order: int,
        total: int,
        slot: int,
    ):
        """Products of the differences with the newest one, and with the last correction."""

    return products
