"""Laws of ``materials`` for eight elements in SIMD lanes. Theory: docs/theory/hyperelastic.md.

One after the other, eight powers or logarithms cost more than the axes that a tangent refers to. What is native code
here says what ``materials`` says of one element, whose functions are the reference; for Ogden's law, ``ogden``.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lane_powers import POWERS
from softwarp.kernels.algebra.lanes import LANE_COUNT, vec8
from softwarp.kernels.elements.ogden import three, twelve

_GIVEN = """
lanes_t p[COUNT];
__builtin_memcpy(p, &parameters, sizeof(p));
"""
_INVARIANTS = (
    """
lanes_t I1, I2, J, found[3];
__builtin_memcpy(&I1, &x, sizeof(lanes_t));
__builtin_memcpy(&I2, &y, sizeof(lanes_t));
__builtin_memcpy(&J, &z, sizeof(lanes_t));
"""
    + _GIVEN
)
_SLOPES = (
    """
lanes_t s[3], found[3];
__builtin_memcpy(s, &x, sizeof(lanes_t));
__builtin_memcpy(s + 1, &y, sizeof(lanes_t));
__builtin_memcpy(s + 2, &z, sizeof(lanes_t));
"""
    + _GIVEN
)
# Stretch Hessian h by xx, yy, zz, xy, xz, yz, and the two shear eigenvalues of each pair of axes, by the third.
_STRETCHES = (
    """
lanes_t s[3], found[12];
__builtin_memcpy(s, &x, sizeof(lanes_t));
__builtin_memcpy(s + 1, &y, sizeof(lanes_t));
__builtin_memcpy(s + 2, &z, sizeof(lanes_t));
lanes_t* const h = found;
lanes_t* const beside = found + 3;  // by pairs of axes
lanes_t* const minus = found + 6;
lanes_t* const plus = found + 9;
const lanes_t J = s[0] * s[1] * s[2];
"""
    + _GIVEN
)
_RESULT = """
SHAPE result;
__builtin_memcpy(&result, found, sizeof(found));
return result;
"""


def _lane_law(count: int, stress: str, principal: str, by_slopes: bool = False) -> SimpleNamespace:
    """``invariants`` or ``slopes``, and ``principal``, of a law with ``count`` parameters, from their native code."""
    table = wp.types.matrix((count, LANE_COUNT), wp.float32)

    def native(given: str, body: str, rows: int) -> str:
        result = _RESULT.replace("SHAPE", f"wp::mat_t<{rows}, {LANE_COUNT}, wp::float32>")
        return POWERS + given.replace("COUNT", str(count)) + body + result

    @wp.func_native(native(_SLOPES if by_slopes else _INVARIANTS, stress, 3))
    def of_three(x: vec8, y: vec8, z: vec8, parameters: table) -> three:
        """Of I1, I2 and J: a, b and c of P = a F + b cof F + c F F'F; or, of stretches, their slopes."""

    @wp.func_native(native(_STRETCHES, principal, 12))
    def of_stretches(x: vec8, y: vec8, z: vec8, parameters: table) -> twelve:
        """Stretch Hessian by xx, yy, zz, xy, xz, yz, and the two shear eigenvalues of each pair of axes."""

    if by_slopes:
        return SimpleNamespace(slopes=of_three, principal=of_stretches)
    return SimpleNamespace(invariants=of_three, principal=of_stretches)


corotational = _lane_law(
    2,
    """
const lanes_t trace = p[1] * (s[0] + s[1] + s[2] - 3.0f);
for (int k = 0; k < 3; ++k) found[k] = 2.0f * p[0] * (s[k] - 1.0f) + trace;
""",
    """
const lanes_t trace = p[1] * (s[0] + s[1] + s[2] - 3.0f), twice = p[0] + p[0], none = twice - twice;
for (int k = 0; k < 3; ++k) {
    const lanes_t both = s[(k + 1) % 3] + s[(k + 2) % 3];
    const lanes_t total = (both < 0.0f ? -both : both) < 1.0e-3f ? none + 1.0e-3f : both;
    h[k] = p[1] + twice;
    beside[k] = p[1];
    minus[k] = twice;
    plus[k] = 2.0f * (p[0] * (total - 2.0f) + trace) / total;
}
""",
    by_slopes=True,
)

neo_hookean = _lane_law(
    2,
    """
found[0] = p[0];
found[1] = (p[1] * log_of(J) - p[0]) / J;
found[2] = I1 - I1;
""",
    """
const lanes_t c = p[0] - p[1] * log_of(J), over = 1.0f / J, both = c + p[1];
lanes_t inverse[3];
for (int k = 0; k < 3; ++k) inverse[k] = s[(k + 1) % 3] * s[(k + 2) % 3] * over;
for (int k = 0; k < 3; ++k) {
    const lanes_t shear = c * s[k] * over;
    h[k] = p[0] + both * inverse[k] * inverse[k];
    beside[2 - k] = p[1] * s[k] * over;
    minus[k] = p[0] + shear;
    plus[k] = p[0] - shear;
}
""",
)

# Of laws of isochoric invariants: j = J^(-2/3), q_i = j s_i^2 with their sum, J U' and J^2 U''.
_ISOCHORIC = """
const lanes_t j = exp_of(log_of(J) * (-2.0f / 3.0f));
const lanes_t first = p[0] * J * (J - 1.0f);
"""
_ISOCHORIC_STRETCHES = (
    _ISOCHORIC
    + """
const lanes_t both = first + p[0] * J * J, over = 1.0f / J;
lanes_t q[3], inverse[3];
for (int k = 0; k < 3; ++k) {
    q[k] = j * s[k] * s[k];
    inverse[k] = s[(k + 1) % 3] * s[(k + 2) % 3] * over;
}
const lanes_t total = q[0] + q[1] + q[2];
"""
)
_YEOH_SLOPE = """
const lanes_t strain = DISTORTION - 3.0f;
const lanes_t slope = p[1] + strain * (2.0f * p[2] + 3.0f * strain * p[3]);
"""

yeoh = _lane_law(
    4,
    _ISOCHORIC
    + _YEOH_SLOPE.replace("DISTORTION", "j * I1")
    + """
found[0] = 2.0f * slope * j;
found[1] = (first - (2.0f / 3.0f) * slope * j * I1) / J;
found[2] = I1 - I1;
""",
    _ISOCHORIC_STRETCHES
    + _YEOH_SLOPE.replace("DISTORTION", "total")
    + """
const lanes_t curvature = 2.0f * (p[2] + 3.0f * strain * p[3]), a = 2.0f * slope * j;
const lanes_t pressure = first - (2.0f / 3.0f) * slope * total, mean = (1.0f / 3.0f) * total;
lanes_t d[3];
for (int k = 0; k < 3; ++k) {
    const lanes_t shear = pressure * s[k] * over;
    minus[k] = a - shear;
    plus[k] = a + shear;
    d[k] = 2.0f * (q[k] - mean);
}
const lanes_t weight = (4.0f / 3.0f) * slope;
for (int k = 0; k < 3; ++k) {
    const lanes_t own = both - first + weight * (mean - q[k] - q[k]) + 2.0f * slope * (q[k] + mean);
    h[k] = (own + curvature * d[k] * d[k]) * inverse[k] * inverse[k];
    const int m = (k + 1) % 3, n = (k + 2) % 3;
    beside[2 - k] = (both + weight * (mean - q[m] - q[n]) + curvature * d[m] * d[n]) * s[k] * over;
}
""",
)

mooney_rivlin = _lane_law(
    3,
    _ISOCHORIC
    + """
const lanes_t a = 2.0f * p[1] * j, b = 2.0f * p[2] * j * j;
found[0] = a + b * I1;
found[1] = (first - (a * I1 + 2.0f * b * I2) * (1.0f / 3.0f)) / J;
found[2] = -b;
""",
    _ISOCHORIC_STRETCHES
    + """
lanes_t r[3];
for (int k = 0; k < 3; ++k) r[k] = q[(k + 1) % 3] * q[(k + 2) % 3];
const lanes_t A = p[1] * total, B = p[2] * (r[0] + r[1] + r[2]);
const lanes_t a = 2.0f * p[1] * j, b = 2.0f * p[2] * j * j;
const lanes_t pressure = first - (2.0f * A + 4.0f * B) * (1.0f / 3.0f);
for (int k = 0; k < 3; ++k) {
    const int m = (k + 1) % 3, n = (k + 2) % 3;
    const lanes_t shear = pressure * s[k] * over, pair = s[m] * s[n], own = p[1] * q[k], other = p[2] * r[k];
    minus[k] = a + b * (s[k] * s[k] - pair) - shear;
    plus[k] = a + b * (s[k] * s[k] + pair) + shear;
    const lanes_t square = (4.0f / 3.0f) * ((A + B) * (1.0f / 3.0f) - 2.0f * (own + other)) + both - first;
    const lanes_t more = 2.0f * (own + 3.0f * other) + (2.0f / 3.0f) * (A - B);
    h[k] = (square + more) * inverse[k] * inverse[k];
    const lanes_t mixed = p[1] * (q[m] + q[n]) + p[2] * (r[m] + r[n]);
    beside[2 - k] = ((4.0f / 3.0f) * ((A + B) * (1.0f / 3.0f) - mixed) + both) * s[k] * over;
}
""",
)
