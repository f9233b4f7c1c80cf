"""Ogden's law for eight elements in SIMD lanes: what ``materials`` says of one. Theory: docs/theory/hyperelastic.md.

The law takes three logarithms and up to nine exponentials of an element, which one by one cost a step more than all
else. It is native code, as Warp's own loops over lanes reach the vector unit in short expressions only.
"""

import warp as wp

from softwarp.kernels.algebra.lane_powers import POWERS
from softwarp.kernels.algebra.lanes import LANE_COUNT, vec8

TERMS = 3
parameters = wp.types.matrix((1 + 2 * TERMS, LANE_COUNT), wp.float32)  # bulk, mu_1, alpha_1, .., alpha_3 in rows
three = wp.types.matrix((3, LANE_COUNT), wp.float32)
twelve = wp.types.matrix((12, LANE_COUNT), wp.float32)

# e_i = ln s_i less their mean, and the Kirchhoff stresses t_i; ``alpha`` is half of a term's exponent. What only large
# strains need is left out where no lane has them.
_STRESSES = f"""
{POWERS}
auto near_ratio = [](lanes_t y) -> lanes_t {{  // sinh(x)/x by y = x^2, to a rounding where that is below 1/4
    const lanes_t near = y * (1.0f / 5040.0f) + 1.0f / 120.0f;
    return (near * y + 1.0f / 6.0f) * y + 1.0f;
}};
auto is_any = [](whole_t holds) -> bool {{
    unsigned long long part[sizeof(whole_t) / 8], all = 0;
    __builtin_memcpy(part, &holds, sizeof(part));
    for (unsigned long long one : part) all |= one;
    return all != 0;
}};
const lanes_t none = {{}};
lanes_t s[3], e[3], q[{1 + 2 * TERMS}], t[3] = {{none, none, none}};
__builtin_memcpy(s, &x, sizeof(lanes_t));
__builtin_memcpy(s + 1, &y, sizeof(lanes_t));
__builtin_memcpy(s + 2, &z, sizeof(lanes_t));
__builtin_memcpy(q, &p, sizeof(q));
for (int i = 0; i < 3; ++i) e[i] = log_of(s[i]);
const lanes_t middle = (e[0] + e[1] + e[2]) * (1.0f / 3.0f);
for (int i = 0; i < 3; ++i) e[i] -= middle;
for (int term = 0; term < {TERMS}; ++term) {{
    const lanes_t twice = q[2 * term + 1] + q[2 * term + 1], alpha = 0.5f * q[2 * term + 2];
    if (!is_any(twice != 0.0f)) continue;
    lanes_t root[3], square[3], strain[3];  // exp(x), x^2, and (exp(2 x) - 1) e / (2 x) of x = alpha e/2
    root[0] = exp_of(alpha * e[0]);
    root[1] = exp_of(alpha * e[1]);
    root[2] = 1.0f / (root[0] * root[1]);  // the three e_i add up to none
    for (int i = 0; i < 3; ++i) {{
        square[i] = alpha * alpha * e[i] * e[i];
        strain[i] = e[i] * root[i] * near_ratio(square[i]);
    }}
    if (is_any((square[0] >= 0.25f) | (square[1] >= 0.25f) | (square[2] >= 0.25f))) {{
        const lanes_t over_alpha = 0.5f / alpha;
        for (int i = 0; i < 3; ++i)
            strain[i] = square[i] < 0.25f ? strain[i] : (root[i] * root[i] - 1.0f) * over_alpha;
    }}
    const lanes_t mean = (strain[0] + strain[1] + strain[2]) * (1.0f / 3.0f);
    for (int i = 0; i < 3; ++i) t[i] += twice * (strain[i] - mean);
    CHANGES
}}
const lanes_t J = s[0] * s[1] * s[2], first = q[0] * J * (J - 1.0f);  // J U'
for (int i = 0; i < 3; ++i) t[i] += first;
"""

_SLOPES = """
lanes_t psi[3];
for (int i = 0; i < 3; ++i) psi[i] = t[i] / s[i];
wp::mat_t<3, LANES, wp::float32> result;
__builtin_memcpy(&result, psi, sizeof(psi));
return result;
"""

# s_j dt_i/ds_j by xx, yy, zz, xy, xz, yz, and (t_i - t_j)/(e_i - e_j) of each pair of axes, by the third.
_CHANGES = """
    lanes_t power[3];
    for (int i = 0; i < 3; ++i) power[i] = twice * (1.0f / 3.0f) * root[i] * root[i];
    const lanes_t share = (power[0] + power[1] + power[2]) * (1.0f / 3.0f);
    for (int i = 0; i < 3; ++i) h[i] += power[i] + share;
    h[3] += share - power[0] - power[1];
    h[4] += share - power[0] - power[2];
    h[5] += share - power[1] - power[2];
    for (int m = 0; m < 3; ++m) {
        const int i = (m + 1) % 3, j = (m + 2) % 3;
        const lanes_t x = alpha * (e[i] - e[j]);
        lanes_t ratio = root[i] * root[j] * near_ratio(x * x);
        if (is_any(x * x >= 0.25f))
            ratio = x * x < 0.25f ? ratio : 0.5f * (root[i] * root[i] - root[j] * root[j]) / x;
        slope[m] += twice * ratio;
    }
"""

# Stretch Hessian, then (psi_i - psi_j)/(s_i - s_j) and (psi_i + psi_j)/(s_i + s_j), equal stretches as all others.
_PRINCIPAL = """
lanes_t c[12], over[3];
const lanes_t over_J = 1.0f / J;
for (int m = 0; m < 3; ++m) {
    const int i = (m + 1) % 3, j = (m + 2) % 3;
    const lanes_t d = 0.5f * (e[i] - e[j]);
    lanes_t sinh = near_ratio(d * d);  // over d
    if (is_any(d * d >= 0.25f)) {
        const lanes_t ratio = __builtin_elementwise_sqrt(s[i] / s[j]);
        sinh = d * d < 0.25f ? sinh : 0.5f * (ratio - 1.0f / ratio) / d;
    }
    const lanes_t cosh = __builtin_elementwise_sqrt(d * d * sinh * sinh + 1.0f);
    const lanes_t mean = 0.5f * (t[i] + t[j]), tanh = d * sinh / cosh;  // (s_i - s_j)/(s_i + s_j)
    over[m] = s[m] * over_J;  // 1/(s_i s_j)
    c[6 + m] = (slope[m] * cosh / sinh - mean) * over[m];
    c[9 + m] = (mean - 0.5f * (t[i] - t[j]) * tanh) * over[m];
}
const lanes_t both = first + q[0] * J * J;  // and J^2 U''
for (int i = 0; i < 3; ++i) {
    const lanes_t inverse = s[(i + 1) % 3] * s[(i + 2) % 3] * over_J;
    c[i] = (h[i] - t[i] + both) * inverse * inverse;
}
c[3] = (h[3] + both) * over[2];
c[4] = (h[4] + both) * over[1];
c[5] = (h[5] + both) * over[0];
wp::mat_t<12, LANES, wp::float32> result;
__builtin_memcpy(&result, c, sizeof(c));
return result;
"""
_SUMS = "typedef float sum_t __attribute__((vector_size(4 * LANES)));\nsum_t h[6] = {}, slope[3] = {};\n"


@wp.func_native(_STRESSES.replace("CHANGES", "") + _SLOPES.replace("LANES", str(LANE_COUNT)))
def slopes(x: vec8, y: vec8, z: vec8, p: parameters) -> three:
    """psi_i = (t_i + J U') / s_i of the stretches x, y and z."""


@wp.func_native((_SUMS + _STRESSES.replace("CHANGES", _CHANGES) + _PRINCIPAL).replace("LANES", str(LANE_COUNT)))
def principal(x: vec8, y: vec8, z: vec8, p: parameters) -> twelve:
    """Stretch Hessian by xx, yy, zz, xy, xz, yz, and the two shear eigenvalues of each pair of axes."""
