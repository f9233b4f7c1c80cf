"""Exponential and logarithm of eight lanes in native code; the C library takes one number at a time.

Polynomials on a reduced range, to two roundings of float32 (Cephes Mathematical Library, S. L. Moshier): exp(x) is 2^n
times the exponential of what is left of x, at most ln 2 / 2; ln(x) is that of a mantissa between sqrt(1/2) and sqrt(2)
and of its power of two, and not a number where x is not positive. Arguments of exp end at +-87, where float32 does.
"""

import warp as wp

from softwarp.kernels.algebra.lanes import LANE_COUNT, vec8

# Types, ``exp_of`` and ``log_of`` for native functions in lanes.
POWERS = f"""
typedef float lanes_t __attribute__((vector_size({4 * LANE_COUNT})));
typedef int whole_t __attribute__((vector_size({4 * LANE_COUNT})));
auto exp_of = [](lanes_t x) -> lanes_t {{
    const lanes_t none = {{}};
    x = x > 87.0f ? none + 87.0f : x;  // what is not a number stays so
    x = x < -87.0f ? none - 87.0f : x;
    const lanes_t shift = none + 12582912.0f;  // 1.5 2^23: a sum with it has no fraction
    const lanes_t n = (x * 1.44269504088896341f + shift) - shift;
    const lanes_t r = x - n * 0.693359375f + n * 2.12194440e-4f;
    lanes_t y = r * 1.9875691500e-4f + 1.3981999507e-3f;
    y = y * r + 8.3334519073e-3f;
    y = y * r + 4.1665795894e-2f;
    y = y * r + 1.6666665459e-1f;
    y = y * r + 5.0000001201e-1f;
    y = y * r * r + r + 1.0f;
    const whole_t power = (__builtin_convertvector(n == n ? n : none, whole_t) + 127) << 23;
    lanes_t scale;
    __builtin_memcpy(&scale, &power, sizeof(scale));
    return y * scale;
}};
auto log_of = [](lanes_t x) -> lanes_t {{
    whole_t bits;
    __builtin_memcpy(&bits, &x, sizeof(bits));
    whole_t whole = ((bits >> 23) & 255) - 126;
    bits = (bits & 0x007fffff) | 0x3f000000;  // mantissa in [0.5, 1)
    lanes_t m;
    __builtin_memcpy(&m, &bits, sizeof(m));
    const whole_t is_low = m < 0.707106781186547524f;  // -1 where it is
    whole += is_low;
    const lanes_t r = (is_low ? m + m : m) - 1.0f;
    const lanes_t n = __builtin_convertvector(whole, lanes_t);
    lanes_t y = r * 7.0376836292e-2f - 1.1514610310e-1f;
    y = y * r + 1.1676998740e-1f;
    y = y * r - 1.2420140846e-1f;
    y = y * r + 1.4249322787e-1f;
    y = y * r - 1.6668057665e-1f;
    y = y * r + 2.0000714765e-1f;
    y = y * r - 2.4999993993e-1f;
    y = y * r + 3.3333331174e-1f;
    y = y * r * r * r - n * 2.12194440e-4f - r * r * 0.5f + r + n * 0.693359375f;
    const lanes_t none = {{}};
    return x > 0.0f ? y : none / none;
}};
"""

_OF_ONE = f"""
lanes_t x;
__builtin_memcpy(&x, &a, sizeof(x));
const lanes_t y = CALL(x);
wp::vec_t<{LANE_COUNT}, wp::float32> result;
__builtin_memcpy(&result, &y, sizeof(result));
return result;
"""


@wp.func_native(POWERS + _OF_ONE.replace("CALL", "exp_of"))
def exp_lanes(a: vec8) -> vec8:
    """exp(a)."""


@wp.func_native(POWERS + _OF_ONE.replace("CALL", "log_of"))
def log_lanes(a: vec8) -> vec8:
    """ln(a)."""
