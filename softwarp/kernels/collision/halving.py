"""Halvings of an edge near a box, three at a time: slopes at seven places stand in one SIMD register, on a CPU.

Each halving of a bracket waits for the slope in its middle. The middles of the next three are seven places, known
beforehand; which of them three halvings would look at, the slopes then tell. Brackets have the same bits as by halvings
one by one. Theory: docs/theory/bvh.md.
"""

import warp as wp

from softwarp.kernels.collision.sift import LANES

AT_ONCE = 3  # halvings

# Its own parts of LANES: a register of places along the edge, and the slope there as ``shapes.box_slope`` has it.
_REGISTER = "".join(LANES.partition("constexpr bool")[:1])


@wp.func_native(
    _REGISTER
    + """
typedef bool bits_t __attribute__((ext_vector_type(8)));
float left = low, right = high;
const float p[3] = {start[0], start[1], start[2]}, d[3] = {way[0], way[1], way[2]};
const float half[3] = {0.5f * size[0], 0.5f * size[1], 0.5f * size[2]};
for (int round = 0; round < rounds; ++round) {
    const float t3 = 0.5f * (left + right), t1 = 0.5f * (left + t3), t5 = 0.5f * (t3 + right);
    const float t0 = 0.5f * (left + t1), t2 = 0.5f * (t1 + t3), t4 = 0.5f * (t3 + t5), t6 = 0.5f * (t5 + right);
    const lane_t t = {t0, t1, t2, t3, t4, t5, t6, t6};
    lane_t along = {}, square = {}, away = {}, slope = {};
    mask_t count = {};
    for (int c = 0; c < 3; ++c) {
        const lane_t x = p[c] + t * d[c], left = -x, gap = (x < 0.0f ? left : x) - half[c];
        const lane_t signed_gap = x < 0.0f ? -gap : gap, outside = gap > 0.0f ? signed_gap : lane_t{};
        const mask_t is_farthest = c == 0 ? (mask_t)(gap == gap) : (mask_t)(gap >= away);
        slope = is_farthest ? (x < 0.0f ? lane_t{} - d[c] : lane_t{} + d[c]) : slope;
        away = is_farthest ? gap : away;
        count -= (mask_t)(gap > 0.0f);
        along += outside * d[c];
        square += outside * outside;
    }
    slope = (count > 1 ? along / __builtin_elementwise_sqrt(square) : slope) / length;
    const mask_t is_before = (mask_t)(slope < bound) | (bound > 0.0f ? (mask_t)(slope == bound) : mask_t{});
    const bits_t bits = __builtin_convertvector(is_before, bits_t);
    unsigned char before;
    __builtin_memcpy(&before, &bits, 1);
    const bool third = before & 8, second = before & (third ? 32 : 2);
    const float middle = third ? t5 : t1;
    const bool first = before & (third ? (second ? 64 : 16) : (second ? 4 : 1));
    const float below = third ? t3 : left, above = third ? right : t3;
    const float inner = third ? (second ? t6 : t4) : (second ? t2 : t0);
    left = first ? inner : (second ? middle : below);
    right = first ? (second ? above : middle) : inner;
}
return wp::vec_t<2, wp::float32>(left, right);
"""
)
def box_halvings(
    size: wp.vec3f, start: wp.vec3f, way: wp.vec3f, length: float, low: float, high: float, bound: float, rounds: int
) -> wp.vec2f:
    """Bracket from ``low`` to ``high`` after ``AT_ONCE`` halvings in each of the ``rounds``.

    It closes on the place start + t way where the slope comes to ``bound``, as ``shape_touches.turn_of`` has it.
    """
