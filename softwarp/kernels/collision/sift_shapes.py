"""Which features of soft bodies are near a shape, eight at a time in SIMD registers, on a CPU in float32.

Most corners and edges of a body near a shape are apart from its box, or from its plane: that is asked as
``features.is_outside`` asks it. Most edges near a box run level along a face, or end where they are nearest, and touch
it with their corners only: the distance from the box is convex along an edge, so its slopes at both ends tell that. All
is asked with margins above rounding, so contacts are the same to the bit. A register holds one feature of eight worlds,
or eight features of one world. Theory: docs/theory/bvh.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import LANE_COUNT, variant, vec8
from softwarp.kernels.collision import geometry
from softwarp.kernels.collision.shape_touches import LEVEL
from softwarp.kernels.collision.sift import LANES
from softwarp.model.codes import CoupleColumn, Target

MARGIN = 1.0e-5  # by which this looks farther than the search, relative to coordinates

UNSURE = 0.1  # part of a slope that counts as level by which slopes may be off

# The pose of the shape in all lanes, and vectors turned by it (``sign`` 1) or back by it (-1).
POSE = f"""
auto lane_of = [](const wp::vec_t<{LANE_COUNT}, wp::float32>& v) -> lane_t {{
    lane_t s;
    __builtin_memcpy(&s, &v, sizeof(s));
    return s;
}};
const lane_t origin[3] = {{lane_of(x0), lane_of(x1), lane_of(x2)}}, w = lane_of(q3);
const lane_t axis[3] = {{lane_of(q0), lane_of(q1), lane_of(q2)}};
auto turned = [&](float sign, const lane_t (&a)[3], lane_t (&b)[3]) {{
    lane_t t[3], s[3];
    cross(axis, a, t);
    for (int c = 0; c < 3; ++c) t[c] *= 2.0f;
    cross(axis, t, s);
    for (int c = 0; c < 3; ++c) b[c] = a[c] + sign * w * t[c] + s[c];
}};
"""

# In which lanes the distance from a box may have a minimum within an edge, or run level up to a place where it rises,
# by bounds of the slopes at both ends. A face's normal is that of the axis with the largest gap; where two gaps may be
# positive, the normal is that of an edge or a corner, and unknown close to it.
_TURNS = f"""
auto turns = [&](const lane_t (&p0)[3], const lane_t (&p1)[3]) -> mask_t {{
    lane_t d[3], e[3], away[3], p[3], coordinates = {{}}, low[2], high[2];
    for (int c = 0; c < 3; ++c) {{
        d[c] = p1[c] - p0[c];
        coordinates += size(p0[c]) + size(p1[c]) + size(origin[c]) + half_size[c];
    }}
    turned(-1.0f, d, e);
    const lane_t length = __builtin_elementwise_sqrt(dot(d, d)), rounding = {MARGIN}f * coordinates;
    for (int k = 0; k < 2; ++k) {{
        lane_t gap[3], square = {{}}, along = {{}};
        for (int c = 0; c < 3; ++c) away[c] = (k ? p1[c] : p0[c]) - origin[c];
        turned(-1.0f, away, p);
        for (int c = 0; c < 3; ++c) {{
            gap[c] = size(p[c]) - half_size[c];
            const lane_t outside = most(gap[c], lane_t{{}});
            square += outside * outside;
            along += (p[c] < 0.0f ? -outside : outside) * e[c];
        }}
        const lane_t farthest = most(most(gap[0], gap[1]), gap[2]);
        const lane_t middle = least(most(gap[0], gap[1]), most(least(gap[0], gap[1]), gap[2]));
        low[k] = length;
        high[k] = -length;
        for (int c = 0; c < 3; ++c) {{
            const lane_t slope = p[c] < 0.0f ? -e[c] : e[c];
            const lane_t other = size(p[c]) > rounding ? slope : -slope;
            const mask_t may = (mask_t)(gap[c] >= farthest - 2.0f * rounding);
            low[k] = may ? least(low[k], least(slope, other)) : low[k];
            high[k] = may ? most(high[k], most(slope, other)) : high[k];
        }}
        const mask_t is_edge = (mask_t)(middle > -rounding);
        const lane_t norm = most(__builtin_elementwise_sqrt(square), rounding);
        const lane_t slope = along / norm, off = least(4.0f * rounding / norm, lane_t{{}} + 2.0f) * length;
        low[k] = is_edge ? least(low[k], slope - off) : low[k];
        high[k] = is_edge ? most(high[k], slope + off) : high[k];
    }}
    const lane_t more = {LEVEL * (1.0 + UNSURE)}f * length, less = {LEVEL * (1.0 - UNSURE)}f * length;
    const mask_t falls = (mask_t)(low[0] < -less) & (mask_t)(high[1] >= -more);
    const mask_t rises = (mask_t)(high[1] > less) & (mask_t)(low[0] <= more);
    return falls | rises;
}};
"""

_CHUNK = f"""
const lane_t reach = row(&wp::index(reach_in, pack, couple, 0), 0);
const float* const target = &wp::index(box_in, pack, 7 * object_b, 0);
const lane_t z[3] = {{lane_t{{}}, lane_t{{}}, lane_t{{}} + 1.0f}};
lane_t n[3] = {{}};
if (is_plane) turned(1.0f, z, n);
int* const hit = &wp::index(hit_out, pack, 0, 0);
mask_t some = {{}};
for (int key = begin; key < end; key += packed ? width : width * lanes) {{
    const int count = packed ? lanes : (end - key < width * lanes ? (end - key) / width : lanes);
    item_t point[2];
    lane_t radius = {{}}, p0[3], p1[3];
    for (int i = 0; i < (packed ? 1 : lanes); ++i) {{
        const int item = first + (key - first_key) / width + (i < count ? i : count - 1);
        for (int k = 0; k < 2; ++k) point[k][i] = edges ? edge_point.data[2 * item + k] : item;
        const float r = edges ? edge_radius.data[item] : point_radius.data[item];
        if (packed) radius += r;
        else radius[i] = r;
    }}
    place(point[0], p0);
    if (edges) place(point[1], p1);
    mask_t wanted = (mask_t)(reach >= 0.0f);
    lane_t above = {{}}, most_above = reach;
    for (int c = 0; c < 3; ++c) {{
        const lane_t p = edges ? 0.5f * (p0[c] + p1[c]) : p0[c];
        const lane_t half = edges ? radius + size(p1[c] - p) : radius;
        const lane_t extent = row(target, 3 + c) + reach + half, away = p - (is_plane ? origin[c] : row(target, c));
        wanted &= ~(mask_t)(size(away) > extent + {MARGIN}f * (size(p) + extent));
        above += n[c] * away - size(n[c]) * half;
        most_above += {MARGIN}f * (size(p) + size(origin[c]));
    }}
    if (is_plane) wanted &= ~(mask_t)(above > most_above);
    if (edges && is_box && any(wanted)) wanted &= turns(p0, p1);
    if (packed) {{
        for (int k = 0; k < width; ++k) __builtin_memcpy(hit + lanes * (key + k), &wanted, sizeof(wanted));
    }} else {{
        for (int i = 0; i < count; ++i) for (int k = 0; k < width; ++k) hit[key + i * width + k] = wanted[i];
        for (int i = count; i < lanes; ++i) wanted[i] = 0;
    }}
    some |= wanted;
}}
if (packed) __builtin_memcpy(&wp::index(chunk_hits_out, pack, chunk, 0), &some, sizeof(some));
else wp::index(chunk_hits_out, pack, chunk, 0) = any(some);
"""


@cache
def kernels(worlds: int) -> SimpleNamespace:
    """Kernels of packs of eight worlds, or of one world at a time, in single precision.

    Args:
        worlds: 8 or 1.
    """
    module = variant("lanes" if worlds == LANE_COUNT else "scalar").module("proximity_near")
    Scene, Motion = (getattr(geometry.structures(wp.float32), name) for name in ("Scene", "Motion"))
    place = geometry.functions(wp.float32)
    target_x, target_q = place.target_x, place.target_q

    @wp.func_native((LANES + POSE + _TURNS + _CHUNK).replace("WORLDS", str(worlds)))
    def mark_near(
        pack: int,
        chunk: int,
        couple: int,
        object_b: int,
        begin: int,
        end: int,
        first: int,
        first_key: int,
        width: int,
        edges: bool,
        is_plane: bool,
        is_box: bool,
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
        edge_point: wp.array2d(dtype=wp.int32),
        edge_radius: wp.array(dtype=wp.float32),
        position: wp.array3d(dtype=wp.float32),
        tree_box: wp.array3d(dtype=wp.float32),
        box_in: wp.array3d(dtype=wp.float32),
        reach_in: wp.array3d(dtype=wp.float32),
        chunk_hits_out: wp.array3d(dtype=wp.int32),
        hit_out: wp.array3d(dtype=wp.int32),
    ): ...

    @wp.kernel(module=module, enable_backward=False)
    def sift(
        # Model
        scene: Scene,
        chunk_list: wp.array(dtype=wp.int32),
        chunk_key: wp.array(dtype=wp.int32),
        chunk_couple: wp.array(dtype=wp.int32),
        # Workspace in
        motion: Motion,
        box_in: wp.array3d(dtype=wp.float32),
        reach_in: wp.array3d(dtype=wp.float32),
        # Workspace out
        chunk_hits_out: wp.array3d(dtype=wp.int32),
        hit_out: wp.array3d(dtype=wp.int32),
    ):
        """Mark the keys of one chunk whose features are near the shape, others 0, and the chunks that have any."""
        pack, item = wp.tid()
        chunk = chunk_list[item]
        couple = chunk_couple[chunk]
        target = scene.couple[couple, wp.static(CoupleColumn.TARGET)]
        edges = scene.couple[couple, wp.static(CoupleColumn.EDGES)] != 0
        is_plane = scene.target_kind[target] == wp.static(Target.PLANE)
        is_box = scene.target_kind[target] == wp.static(Target.BOX)
        x0 = vec8()
        x1 = vec8()
        x2 = vec8()
        q0 = vec8()
        q1 = vec8()
        q2 = vec8()
        q3 = vec8()
        if is_plane or (is_box and edges):
            for lane in range(wp.static(LANE_COUNT)):
                world = lane % wp.static(worlds)
                x = target_x(scene, motion, pack, world, target)
                q = target_q(scene, motion, pack, world, target)
                x0[lane] = x[0]
                x1[lane] = x[1]
                x2[lane] = x[2]
                q0[lane] = q[0]
                q1[lane] = q[1]
                q2[lane] = q[2]
                q3[lane] = q[3]
        mark_near(
            pack,
            chunk,
            couple,
            scene.couple[couple, wp.static(CoupleColumn.OBJECT_B)],
            chunk_key[chunk],
            chunk_key[chunk + 1],
            scene.couple[couple, wp.static(CoupleColumn.FIRST)],
            scene.couple[couple, wp.static(CoupleColumn.KEY)],
            scene.couple[couple, wp.static(CoupleColumn.WIDTH)],
            edges,
            is_plane,
            is_box,
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
            scene.edge_point,
            scene.edge_radius,
            motion.x,
            motion.tree_box,
            box_in,
            reach_in,
            chunk_hits_out,
            hit_out,
        )

    return SimpleNamespace(sift=sift)
