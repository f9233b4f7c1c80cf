"""Corners and edges of soft bodies against boxes, one of eight worlds at a time in SIMD registers, on a CPU in float32.

``search`` finds what ``shape_touches.touch_shape`` finds of a feature and a box, with the same bits: the same looks and
halvings, for the features that ``sift_shapes`` has marked, and marks those that touch as ``shapes_phase.find`` does.
Theory: docs/theory/collision.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import LANE_COUNT, variant, vec8
from softwarp.kernels.collision import geometry
from softwarp.kernels.collision.geometry import BARY, DISTANCE, NORMAL, POINT_A, POINT_B, SHARE, TOUCH_ROWS
from softwarp.kernels.collision.shape_touches import BISECTIONS, LEVEL, STRETCH, UNSURE
from softwarp.kernels.collision.shapes import ALIGNED
from softwarp.kernels.collision.sift import LANES
from softwarp.kernels.collision.sift_shapes import POSE
from softwarp.kernels.collision.strike import HULL_ROWS
from softwarp.kernels.collision.touches import ASIDE, MARGIN
from softwarp.model.codes import CORNER, EDGE, FACE, FAR, FAR_FROM, FLAT, CoupleColumn

_REACH = "const lane_t reach = row(&wp::index(reach_in, pack, couple, 0), 0);"

# Distance from the box, normal and region at a place in its axes: ``shapes.box`` and ``region_of``.
_BOX = f"""
struct Near {{ lane_t d, n[3]; mask_t region; }};
auto norm = [&](const lane_t (&a)[3]) -> lane_t {{ return __builtin_elementwise_sqrt(dot(a, a)); }};
auto normalize = [&](lane_t (&a)[3]) {{
    const lane_t length = norm(a);
    for (int c = 0; c < 3; ++c) a[c] = length > 0.0f ? a[c] / length : lane_t{{}};
}};
auto box_at = [&](const lane_t (&p)[3]) -> Near {{
    Near near;
    lane_t gap[3], side[3], outside[3];
    for (int c = 0; c < 3; ++c) {{
        gap[c] = size(p[c]) - half_size[c];
        side[c] = p[c] < 0.0f ? lane_t{{}} - 1.0f : lane_t{{}} + 1.0f;
        outside[c] = side[c] * most(gap[c], lane_t{{}});
    }}
    const lane_t farthest = most(most(gap[0], gap[1]), gap[2]);
    const mask_t is_third = (mask_t)(gap[2] >= farthest), is_second = ~is_third & (mask_t)(gap[1] >= farthest);
    const mask_t is[3] = {{~is_third & ~is_second, is_second, is_third}};
    const mask_t is_edge = (mask_t)(least(most(gap[0], gap[1]), most(least(gap[0], gap[1]), gap[2])) > 0.0f);
    const lane_t largest = most(most(size(outside[0]), size(outside[1])), size(outside[2]));
    for (int c = 0; c < 3; ++c) outside[c] /= largest;
    const lane_t scaled = norm(outside);
    mask_t zeros = {{}};
    for (int c = 0; c < 3; ++c) {{
        near.n[c] = is_edge ? outside[c] / scaled : (is[c] ? side[c] : lane_t{{}});
        zeros -= (mask_t)(size(near.n[c]) < {ALIGNED}f);
    }}
    near.d = is_edge ? scaled * largest : farthest;
    near.region = zeros == 1 ? mask_t{{}} + {EDGE} : (zeros == 0 ? mask_t{{}} + {CORNER} : mask_t{{}} + {FACE});
    return near;
}};
auto add_normal = [&](int face, lane_t (&sum)[3]) {{
    lane_t x[3][3], e[3], f[3], n[3];
    for (int j = 0; j < 3; ++j) place({{face_corner.data[3 * face + j]}}, x[j]);
    for (int c = 0; c < 3; ++c) {{
        e[c] = x[1][c] - x[0][c];
        f[c] = x[2][c] - x[0][c];
    }}
    cross(e, f, n);
    normalize(n);
    for (int c = 0; c < 3; ++c) sum[c] += n[c];
}};
struct Touch {{ lane_t distance, normal[3], a[3], b[3], share; mask_t region, found; }};
"""

# ``shape_touches.touch_point`` of a node, with ``features.point_inset``.
_CORNER = f"""
auto touch_corner = [&](int point) -> Touch {{
    Touch touch;
    lane_t inset[3] = {{}}, away[3], local[3];
    place({{point}}, touch.a);
    for (int c = 0; c < 3; ++c) away[c] = touch.a[c] - origin[c];
    turned(-1.0f, away, local);
    Near at = box_at(local);
    touch.distance = at.d;
    const lane_t n[3] = {{at.n[0], at.n[1], at.n[2]}};
    turned(1.0f, n, touch.normal);
    touch.region = at.region;
    const mask_t is_unsure = (mask_t)(at.d < {UNSURE}f * wp::length(point_inset.data[point]));
    if (any(is_unsure)) {{
        lane_t sum[3] = {{}}, inner[3], normal[3];
        for (int k = fan_start.data[point]; k < fan_start.data[point + 1]; ++k) add_normal(fan.data[k], sum);
        normalize(sum);
        for (int c = 0; c < 3; ++c) {{
            inset[c] = -point_inset.data[point][0] * sum[c];
            away[c] = touch.a[c] + inset[c] - origin[c];
        }}
        turned(-1.0f, away, inner);
        at = box_at(inner);
        const lane_t m[3] = {{at.n[0], at.n[1], at.n[2]}};
        turned(1.0f, m, normal);
        const lane_t border = 0.25f * norm(inset);
        mask_t near = {{}};
        for (int c = 0; c < 3; ++c) near -= (mask_t)(size(local[c]) > half_size[c] - border);
        const mask_t corner = near == 3 ? mask_t{{}} + {CORNER} : mask_t{{}} + {FACE};
        const mask_t within = near == 2 ? mask_t{{}} + {EDGE} : corner;
        const mask_t is_face = (mask_t)(at.region == {FACE}) & (mask_t)(dot(inset, inset) > 0.0f);
        touch.region = is_unsure ? (is_face ? within : at.region) : touch.region;
        touch.distance = is_unsure ? at.d - dot(normal, inset) : touch.distance;
        for (int c = 0; c < 3; ++c) touch.normal[c] = is_unsure ? normal[c] : touch.normal[c];
    }}
    for (int c = 0; c < 3; ++c) touch.b[c] = touch.a[c] - touch.distance * touch.normal[c];
    touch.distance -= point_radius.data[point];
    touch.share = lane_t{{}};
    touch.found = mask_t{{}} - 1;
    return touch;
}};
"""

# A place along a line in the axes of the box, and halvings of brackets of the place where the slope comes to a bound.
_PLACES = f"""
struct Sample {{ lane_t t, f, slope, n[3]; mask_t region; }};
auto choose = [](mask_t m, const Sample& a, const Sample& b) -> Sample {{
    Sample s;
    s.t = m ? a.t : b.t;
    s.f = m ? a.f : b.f;
    s.slope = m ? a.slope : b.slope;
    for (int c = 0; c < 3; ++c) s.n[c] = m ? a.n[c] : b.n[c];
    s.region = m ? a.region : b.region;
    return s;
}};
struct Line {{ lane_t start[3], way[3], length; }};
auto at = [&](const Line& line, lane_t t) -> Sample {{
    Sample s;
    lane_t p[3];
    for (int c = 0; c < 3; ++c) p[c] = line.start[c] + t * line.way[c];
    const Near near = box_at(p);
    for (int c = 0; c < 3; ++c) s.n[c] = near.n[c];
    s.t = t; s.f = near.d; s.region = near.region;
    s.slope = dot(s.n, line.way) / line.length;
    return s;
}};
auto halve = [&](const Line& line, float bound, lane_t& left, lane_t& right) {{
    for (int k = 0; k < {BISECTIONS}; ++k) {{
        const lane_t t = 0.5f * (left + right);
        lane_t along = {{}}, square = {{}}, away = {{}}, slope = {{}};
        mask_t count = {{}};
        for (int c = 0; c < 3; ++c) {{
            const lane_t p = line.start[c] + t * line.way[c], gap = size(p) - half_size[c];
            const lane_t signed_gap = p < 0.0f ? -gap : gap, outside = gap > 0.0f ? signed_gap : lane_t{{}};
            const mask_t is_farthest = c == 0 ? mask_t{{}} - 1 : (mask_t)(gap >= away);
            slope = is_farthest ? (p < 0.0f ? -line.way[c] : line.way[c]) : slope;
            away = is_farthest ? gap : away;
            count -= (mask_t)(gap > 0.0f);
            along += outside * line.way[c];
            square += outside * outside;
        }}
        slope = (count > 1 ? along / __builtin_elementwise_sqrt(square) : slope) / line.length;
        mask_t is_before = (mask_t)(slope < bound);
        if (bound > 0.0f) is_before |= (mask_t)(slope == bound);
        left = is_before ? t : left;
        right = is_before ? right : t;
    }}
}};
"""

# ``shape_touches.brackets_of``, with normals in world axes.
_BRACKETS = f"""
struct Brackets {{ Sample a, b, u, v, lowest; mask_t falls, rises; }};
auto level_place = [&](const Sample& a, const Sample& v) -> lane_t {{
    lane_t n[3], r[3], s[3];
    for (int c = 0; c < 3; ++c) n[c] = v.slope * a.n[c] - a.slope * v.n[c];
    normalize(n);
    const lane_t before = dot(a.n, n), behind = dot(v.n, n);
    cross(a.n, n, r);
    cross(v.n, n, s);
    const lane_t from_a = norm(r) * behind, from_v = norm(s) * before;
    const lane_t t = least(most(a.t + (v.t - a.t) * from_a / (from_a + from_v), a.t), v.t);
    return (mask_t)(before > 0.0f) & (mask_t)(behind > 0.0f) ? t : v.t;
}};
auto brackets_of = [&](const lane_t (&p)[3], const lane_t (&d)[3], float radius, lane_t reach) -> Brackets {{
    Brackets found;
    Line line;
    lane_t away[3];
    for (int c = 0; c < 3; ++c) away[c] = p[c] - origin[c];
    turned(-1.0f, away, line.start);
    turned(-1.0f, d, line.way);
    line.length = norm(d);
    const lane_t zero = {{}}, one = zero + 1.0f;
    const lane_t least_here = at(line, 0.5f * one).f - 0.5f * line.length - radius;
    const mask_t near = (mask_t)(line.length > 0.0f) & ~(mask_t)(least_here > reach);
    found.a = found.b = at(line, zero);
    found.u = found.v = at(line, one);
    const lane_t low = found.a.slope, high = found.v.slope;
    found.falls = near & (mask_t)(low < -{LEVEL}f) & (mask_t)(high >= -{LEVEL}f);
    found.rises = near & (mask_t)(high > {LEVEL}f) & (mask_t)(low <= {LEVEL}f);
    found.lowest = found.a;
    found.lowest.t = zero - 1.0f;
    if (any(found.falls)) {{
        lane_t left = zero, right = one;
        halve(line, -{LEVEL}f, left, right);
        found.a = choose(found.falls, at(line, left), found.a);
        found.b = choose(found.falls, at(line, right), found.b);
    }}
    if (any(found.rises)) {{
        lane_t left = found.a.t, right = one;
        halve(line, {LEVEL}f, left, right);
        found.u = choose(found.rises, at(line, left), found.u);
        found.v = choose(found.rises, at(line, right), found.v);
        const mask_t is_same = (mask_t)(found.a.region == found.v.region) & (mask_t)(found.v.region != {FACE});
        const mask_t is_round = found.falls & found.rises & is_same;
        if (any(is_round))
            found.lowest = choose(is_round, at(line, level_place(found.a, found.v)), found.lowest);
    }}
    Sample* const places[] = {{&found.a, &found.b, &found.u, &found.v, &found.lowest}};
    for (Sample* const s : places) {{
        const lane_t n[3] = {{s->n[0], s->n[1], s->n[2]}};
        turned(1.0f, n, s->n);
    }}
    return found;
}};
"""

# ``shape_touches.touch_line`` and ``with_inset``; ``found`` where there is a minimum between the ends.
_TOUCH = f"""
auto at_kink = [&](const Sample& a, const Sample& v, lane_t length) -> Sample {{
    Sample best = a;
    const lane_t sa = least(a.slope, lane_t{{}} - {LEVEL}f), sb = most(v.slope, lane_t{{}} + {LEVEL}f);
    lane_t mean[3];
    for (int c = 0; c < 3; ++c) mean[c] = (sb * a.n[c] - sa * v.n[c]) / (sb - sa);
    const lane_t across = norm(mean);
    for (int c = 0; c < 3; ++c) best.n[c] = mean[c] / across;
    best.t = (a.f - v.f + (sb * v.t - sa * a.t) * length) / ((sb - sa) * length);
    best.t = least(most(best.t, a.t), v.t);
    best.f = least(a.f + sa * (best.t - a.t) * length, least(a.f, v.f)) / across;
    best.t = across > 0.1f ? best.t : lane_t{{}} - 1.0f;
    return best;
}};
auto touch_line = [&](const Brackets& found, const lane_t (&p)[3], const lane_t (&d)[3], const lane_t (&inset)[3],
                      float radius, int side) -> Touch {{
    const mask_t is_level = (mask_t)(found.u.t - found.b.t > {STRETCH}f);
    const mask_t has_end = is_level & (side == 0 ? found.falls : found.rises);
    Sample best = side == 0 ? found.b : found.u;
    best.t = has_end ? best.t : lane_t{{}} - 1.0f;
    best.region |= {FLAT};
    if (side == 0) {{
        const mask_t has_kink = ~is_level & found.falls & found.rises;
        if (any(has_kink)) best = choose(has_kink, at_kink(found.a, found.v, norm(d)), best);
        best = choose(~is_level & (mask_t)(found.lowest.t >= 0.0f), found.lowest, best);
    }}
    Touch touch;
    touch.found = found.falls | found.rises;
    const mask_t is_between = (mask_t)(best.t > 0.0f) & (mask_t)(best.t < 1.0f);
    const lane_t away = best.f - dot(best.n, inset);
    touch.distance = is_between ? away - radius : lane_t{{}} + {FAR}f;
    touch.share = is_between ? best.t : lane_t{{}};
    touch.region = is_between & best.region;
    for (int c = 0; c < 3; ++c) {{
        const lane_t a = p[c] + best.t * d[c];
        touch.normal[c] = is_between ? best.n[c] : lane_t{{}};
        touch.a[c] = is_between ? a : lane_t{{}};
        touch.b[c] = is_between ? a - away * best.n[c] : lane_t{{}};
    }}
    return touch;
}};
auto with_inset = [&](const Touch& touch, Touch other, lane_t near, mask_t is_unsure) -> Touch {{
    lane_t way[3];
    for (int c = 0; c < 3; ++c) way[c] = other.a[c] - touch.a[c];
    const mask_t is_flat = (mask_t)((touch.region & other.region & {FLAT}) != 0) & (mask_t)(norm(way) < near);
    for (int c = 0; c < 3; ++c) {{
        const lane_t b = is_flat ? other.b[c] + touch.a[c] - other.a[c] : other.b[c];
        other.b[c] = is_unsure ? b : touch.b[c];
        other.a[c] = is_unsure & ~is_flat ? other.a[c] : touch.a[c];
        other.normal[c] = is_unsure ? other.normal[c] : touch.normal[c];
    }}
    other.share = is_unsure & ~is_flat ? other.share : touch.share;
    other.distance = is_unsure ? other.distance : touch.distance;
    other.region = is_unsure ? other.region : touch.region;
    other.found = is_unsure ? other.found : touch.found;
    return other;
}};
auto inset_of = [&](int edge, lane_t (&inset)[3]) {{
    lane_t sum[3] = {{}};
    for (int k = 0; k < 2; ++k) {{
        const int face = edge_face.data[2 * edge + k];
        if (face >= 0) add_normal(face, sum);
    }}
    normalize(sum);
    for (int c = 0; c < 3; ++c) inset[c] = -edge_inset.data[edge][0] * sum[c];
}};
"""

_EDGE = f"""
auto touch_edge = [&](int edge, lane_t reach, Touch (&touch)[2]) {{
    lane_t p[3], d[3], inset[3] = {{}};
    place({{edge_point.data[2 * edge]}}, p);
    place({{edge_point.data[2 * edge + 1]}}, d);
    for (int c = 0; c < 3; ++c) d[c] -= p[c];
    const float radius = edge_radius.data[edge];
    const lane_t near = lane_t{{}} + {UNSURE}f * wp::length(edge_inset.data[edge]);
    const Brackets found = brackets_of(p, d, radius, reach);
    mask_t is_unsure[2];
    for (int side = 0; side < 2; ++side) {{
        Touch& t = touch[side];
        t = touch_line(found, p, d, inset, radius, side);
        const mask_t is_close = (mask_t)(t.distance <= near) | (mask_t)(t.distance > {FAR_FROM}f);
        is_unsure[side] = t.found & (mask_t)(near > 0.0f) & is_close;
    }}
    if (!any(is_unsure[0] | is_unsure[1])) return;
    inset_of(edge, inset);
    lane_t start[3];
    for (int c = 0; c < 3; ++c) start[c] = p[c] + inset[c];
    const Brackets other = brackets_of(start, d, radius, near);
    for (int side = 0; side < 2; ++side) {{
        const Touch t = touch_line(other, p, d, inset, radius, side);
        touch[side] = with_inset(touch[side], t, near, is_unsure[side]);
    }}
}};
"""

# ``features.is_outside``, ``touches.urgency`` and ``keep_touch``.
_JUDGED = f"""
auto is_outside = [&](int feature) -> mask_t {{
    const float* const target = &wp::index(box_in, pack, 7 * object_b, 0);
    lane_t p[3], other[3];
    mask_t apart = {{}};
    place({{edges ? edge_point.data[2 * feature] : feature}}, p);
    if (edges) place({{edge_point.data[2 * feature + 1]}}, other);
    for (int c = 0; c < 3; ++c) {{
        const lane_t middle = edges ? 0.5f * (p[c] + other[c]) : p[c];
        lane_t half = lane_t{{}} + (edges ? edge_radius.data[feature] : point_radius.data[feature]);
        if (edges) half += size(other[c] - middle);
        apart |= (mask_t)(size(middle - row(target, c)) > row(target, 3 + c) + reach + half);
    }}
    return apart;
}};
auto velocity = [&](int point, int c) -> lane_t {{
    return row(&wp::index(v_in, pack, 0, 0), 3 * point_index.data[point] + c);
}};
auto along = [&](const float* rows, float sign, const lane_t (&n)[3]) -> lane_t {{
    lane_t total = {{}};
    for (int c = 0; c < 3; ++c) total += most(sign * n[c] * row(rows, c), sign * n[c] * row(rows, 3 + c));
    return row(rows, 0) > row(rows, 3) ? lane_t{{}} - {FAR}f : total;
}};
const float* const hull = &wp::index(hull_in, pack, {HULL_ROWS} * couple, 0);
const lane_t rest = row(&wp::index(distance_in, pack, pair, 0), 0), alarm = row(&wp::index(alarm_in, pack, pair, 0), 0);
const lane_t limit = least(most(rest, alarm) + (is_patient ? 0.0f : slack), rest + ahead);
const float waits = is_patient ? slack : 0.0f;
auto urgency = [&](const Touch& t, int feature) -> mask_t {{
    lane_t a[3], b[3] = {{}}, apart[3];
    for (int c = 0; c < 3; ++c)
        a[c] = edges ? (1.0f - t.share) * velocity(edge_point.data[2 * feature], c) +
                           t.share * velocity(edge_point.data[2 * feature + 1], c)
                     : velocity(feature, c);
    if (frame >= 0) {{
        const float* const twist = &wp::index(twist_in, pack, 6 * frame, 0);
        const float* const pose = &wp::index(pose_in, pack, 7 * frame, 0);
        lane_t w[3], arm[3];
        for (int c = 0; c < 3; ++c) {{
            w[c] = row(twist, 3 + c);
            arm[c] = t.b[c] - row(pose, c);
        }}
        cross(w, arm, b);
        for (int c = 0; c < 3; ++c) b[c] = row(twist, c) + b[c];
    }}
    for (int c = 0; c < 3; ++c) apart[c] = a[c] - b[c];
    lane_t struck = most(along(hull, -1.0f, t.normal), -dot(a, t.normal));
    struck += most(along(hull + 6 * lanes, 1.0f, t.normal), dot(b, t.normal));
    const lane_t closing = most(most(-{MARGIN}f * dot(apart, t.normal), {ASIDE}f * norm(apart)), struck);
    const mask_t none = mask_t{{}} - 1;
    const mask_t late = (mask_t)(t.distance <= limit + waits + h * closing) ? none + 3 : none;
    const mask_t soon = (mask_t)(t.distance <= limit + h * closing) ? none + 2 : late;
    return (mask_t)(t.distance <= limit) ? none + 1 : soon;
}};
auto keep = [&](int key, const Touch& t, mask_t is_near) {{
    if (seats <= 0) return;
    const int seat = key % seats;
    float* const out = &wp::index(found_touch_out, pack, {TOUCH_ROWS} * seat, 0);
    auto store = [&](int number, lane_t value) {{
        value = is_near ? value : row(out, number);
        __builtin_memcpy(out + lanes * number, &value, sizeof(value));
    }};
    for (int c = 0; c < 3; ++c) {{
        store({NORMAL} + c, t.normal[c]);
        store({POINT_A} + c, t.a[c]);
        store({POINT_B} + c, t.b[c]);
    }}
    store({DISTANCE}, t.distance);
    store({SHARE}, t.share);
    store({BARY}, lane_t{{}});
    store({BARY} + 1, lane_t{{}});
    int* const found = &wp::index(found_key_out, pack, seat, 0);
    for (int lane = 0; lane < lanes; ++lane)
        if (is_near[lane]) found[lane] = key + 1;
}};
"""

_CHUNK = """
int* const hit = &wp::index(hit_out, pack, 0, 0);
mask_t hits = {};
for (int key = begin; key < end; key += width) {
    mask_t marked;
    __builtin_memcpy(&marked, hit + lanes * key, sizeof(marked));
    marked = (mask_t)(marked != 0);
    const int feature = first + (key - first_key) / width;
    if (any(marked)) marked &= ~is_outside(feature);
    const bool is_searched = any(marked);
    Touch touch[2];
    if (is_searched && edges) touch_edge(feature, reach, touch);
    else if (is_searched) touch[0] = touch_corner(feature);
    for (int side = 0; side < width; ++side) {
        mask_t urgent = mask_t{} - 1;
        if (is_searched) {
            const Touch& t = touch[side];
            const mask_t is_wanted = marked & t.found & (mask_t)((t.region & mask) == t.region);
            const mask_t is_near = is_wanted & (mask_t)(t.distance <= reach);
            if (any(is_near)) {
                keep(key + side, t, is_near);
                urgent = is_near & (mask_t)(t.distance >= -depth) ? urgency(t, feature) : urgent;
            }
        }
        __builtin_memcpy(hit + lanes * (key + side), &urgent, sizeof(urgent));
        hits -= (mask_t)(urgent >= 0);
    }
}
__builtin_memcpy(&wp::index(chunk_hits_out, pack, chunk, 0), &hits, sizeof(hits));
"""


@cache
def kernels() -> SimpleNamespace:
    """Kernels of packs of eight worlds."""
    module = variant("lanes").module("proximity_near")
    Scene, Motion = (getattr(geometry.structures(wp.float32), name) for name in ("Scene", "Motion"))
    place = geometry.functions(wp.float32)
    target_x, target_q = place.target_x, place.target_q

    @wp.func_native(
        (LANES + POSE + _REACH + _BOX + _CORNER + _PLACES + _BRACKETS + _TOUCH + _EDGE + _JUDGED + _CHUNK).replace(
            "WORLDS", str(LANE_COUNT)
        )
    )
    def search_features(
        pack: int,
        chunk: int,
        couple: int,
        pair: int,
        object_b: int,
        frame: int,
        begin: int,
        end: int,
        first: int,
        first_key: int,
        width: int,
        mask: int,
        edges: bool,
        is_patient: bool,
        depth: float,
        slack: float,
        h: float,
        ahead: float,
        seats: int,
        x0: vec8,
        x1: vec8,
        x2: vec8,
        q0: vec8,
        q1: vec8,
        q2: vec8,
        q3: vec8,
        half_size: wp.vec3,
        point_index: wp.array(dtype=wp.int32),
        point_radius: wp.array(dtype=wp.float32),
        point_inset: wp.array(dtype=wp.vec3),
        fan_start: wp.array(dtype=wp.int32),
        fan: wp.array(dtype=wp.int32),
        edge_point: wp.array2d(dtype=wp.int32),
        edge_face: wp.array2d(dtype=wp.int32),
        edge_radius: wp.array(dtype=wp.float32),
        edge_inset: wp.array(dtype=wp.vec3),
        face_corner: wp.array2d(dtype=wp.int32),
        position: wp.array3d(dtype=wp.float32),
        tree_box: wp.array3d(dtype=wp.float32),
        v_in: wp.array3d(dtype=wp.float32),
        pose_in: wp.array3d(dtype=wp.float32),
        twist_in: wp.array3d(dtype=wp.float32),
        box_in: wp.array3d(dtype=wp.float32),
        reach_in: wp.array3d(dtype=wp.float32),
        hull_in: wp.array3d(dtype=wp.float32),
        distance_in: wp.array3d(dtype=wp.float32),
        alarm_in: wp.array3d(dtype=wp.float32),
        chunk_hits_out: wp.array3d(dtype=wp.int32),
        hit_out: wp.array3d(dtype=wp.int32),
        found_key_out: wp.array3d(dtype=wp.int32),
        found_touch_out: wp.array3d(dtype=wp.float32),
    ): ...

    @wp.kernel(module=module, enable_backward=False)
    def search(
        # Model
        scene: Scene,
        chunk_list: wp.array(dtype=wp.int32),
        chunk_key: wp.array(dtype=wp.int32),
        chunk_couple: wp.array(dtype=wp.int32),
        # Workspace in
        motion: Motion,
        box_in: wp.array3d(dtype=wp.float32),
        reach_in: wp.array3d(dtype=wp.float32),
        hull_in: wp.array3d(dtype=wp.float32),
        pair_distance_in: wp.array3d(dtype=wp.float32),
        pair_alarm_in: wp.array3d(dtype=wp.float32),
        slack: float,
        h: float,
        ahead: float,
        seats: int,
        # Workspace out
        chunk_hits_out: wp.array3d(dtype=wp.int32),
        hit_out: wp.array3d(dtype=wp.int32),
        found_key_out: wp.array3d(dtype=wp.int32),
        found_touch_out: wp.array3d(dtype=wp.float32),
    ):
        """What ``shapes_phase.find`` does with one sifted chunk, of corners or edges of a soft body against a box."""
        pack, item = wp.tid()
        chunk = chunk_list[item]
        couple = chunk_couple[chunk]
        some = int(0)
        for lane in range(wp.static(LANE_COUNT)):
            some = some | chunk_hits_out[pack, chunk, lane]
        if some == 0:
            return
        target = scene.couple[couple, wp.static(CoupleColumn.TARGET)]
        x0 = vec8()
        x1 = vec8()
        x2 = vec8()
        q0 = vec8()
        q1 = vec8()
        q2 = vec8()
        q3 = vec8()
        for lane in range(wp.static(LANE_COUNT)):
            x = target_x(scene, motion, pack, lane, target)
            q = target_q(scene, motion, pack, lane, target)
            x0[lane] = x[0]
            x1[lane] = x[1]
            x2[lane] = x[2]
            q0[lane] = q[0]
            q1[lane] = q[1]
            q2[lane] = q[2]
            q3[lane] = q[3]
        search_features(
            pack,
            chunk,
            couple,
            scene.couple[couple, wp.static(CoupleColumn.PAIR)],
            scene.couple[couple, wp.static(CoupleColumn.OBJECT_B)],
            scene.target_frame[target],
            chunk_key[chunk],
            chunk_key[chunk + 1],
            scene.couple[couple, wp.static(CoupleColumn.FIRST)],
            scene.couple[couple, wp.static(CoupleColumn.KEY)],
            scene.couple[couple, wp.static(CoupleColumn.WIDTH)],
            scene.couple[couple, wp.static(CoupleColumn.MASK)],
            scene.couple[couple, wp.static(CoupleColumn.EDGES)] != 0,
            scene.couple[couple, wp.static(CoupleColumn.PATIENT)] != 0,
            scene.target_depth[target],
            slack,
            h,
            ahead,
            seats,
            x0,
            x1,
            x2,
            q0,
            q1,
            q2,
            q3,
            0.5 * scene.target_size[target],
            scene.point_index,
            scene.point_radius,
            scene.point_inset,
            scene.fan_start,
            scene.fan,
            scene.edge_point,
            scene.edge_face,
            scene.edge_radius,
            scene.edge_inset,
            scene.face_corner,
            motion.x,
            motion.tree_box,
            motion.v,
            motion.pose,
            motion.twist,
            box_in,
            reach_in,
            hull_in,
            pair_distance_in,
            pair_alarm_in,
            chunk_hits_out,
            hit_out,
            found_key_out,
            found_touch_out,
        )

    return SimpleNamespace(search=search)
