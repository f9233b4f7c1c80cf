"""Which features of soft bodies must be searched, eight at a time in SIMD registers, on a CPU in float32.

Most corners and edges near another body touch nothing. A register holds one feature of eight worlds, or eight features
of one world, and goes down the tree of the target with all of them. What is asked there is weaker than what
``surface_phase`` asks, by margins far above rounding: a feature that is left out here would not have been found there,
so contacts are the same to the bit. The functions are C++ for the compiler's vector types. Theory: docs/theory/bvh.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import LANE_COUNT, variant
from softwarp.kernels.collision import geometry
from softwarp.kernels.collision.faces import SHARP
from softwarp.model.codes import FAR, CoupleColumn

FARTHER = 1.001  # what a feature must be away from a target, in distances within which it may touch, to be left alone
OUTSIDE = 2  # mark of a point whose last search found it outside its target
AHEAD = 4.0  # motions that the search of an edge looks ahead, so that the next ones can be left out
MARGIN = 1.0e-3  # by which this looks farther, relative to distances, squares and sines
ROUNDING = 1.0e-5  # likewise, relative to coordinates: of distances that two ways of computing find
SLACK = 1.0e-6  # of products of lengths, whose rounding decides where an edge meets one nearly parallel to it
PARALLEL = 1.0e-6  # squared sine of two edges below which they do not meet; as in ``closest``

# Lanes are worlds where WORLDS is 8, and features that follow one another where it is 1. ``row`` is a row of the
# workspace in all lanes, ``place`` a coordinate of points that differ between lanes where the features do.
LANES = f"""
typedef float lane_t __attribute__((vector_size({4 * LANE_COUNT}), aligned(4), may_alias));
typedef int mask_t __attribute__((vector_size({4 * LANE_COUNT}), aligned(4), may_alias));
constexpr int lanes = {LANE_COUNT};
constexpr bool packed = WORLDS == lanes;
typedef int item_t[lanes];
auto row = [](const float* rows, int number) -> lane_t {{
    lane_t v = {{}};
    if (packed) __builtin_memcpy(&v, rows + lanes * number, sizeof(v));
    else v += rows[number];
    return v;
}};
auto most = [](lane_t a, lane_t b) -> lane_t {{ return a > b ? a : b; }};
auto least = [](lane_t a, lane_t b) -> lane_t {{ return a < b ? a : b; }};
auto size = [](lane_t a) -> lane_t {{ return a < 0.0f ? -a : a; }};
auto any = [](mask_t m) -> bool {{ return __builtin_reduce_or(m) != 0; }};
auto dot = [](const lane_t (&a)[3], const lane_t (&b)[3]) -> lane_t {{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}};
auto cross = [](const lane_t (&a)[3], const lane_t (&b)[3], lane_t (&n)[3]) {{
    n[0] = a[1] * b[2] - a[2] * b[1];
    n[1] = a[2] * b[0] - a[0] * b[2];
    n[2] = a[0] * b[1] - a[1] * b[0];
}};
const float* const x = &wp::index(position, pack, 0, 0);
const float* const box = &wp::index(tree_box, pack, 0, 0);
auto place = [&](const item_t& point, lane_t (&p)[3]) {{
    for (int c = 0; c < 3; ++c) {{
        if (packed) p[c] = row(x, 3 * point_index.data[point[0]] + c);
        else for (int i = 0; i < lanes; ++i) p[c][i] = x[3 * point_index.data[point[i]] + c];
    }}
}};
"""

# Whether the faces beside an edge are one plane, in the lanes where it has two; ``face`` left and right of it.
_FLAT = f"""
auto is_flat = [&](const item_t& edge) -> mask_t {{
    lane_t n[2][3];
    mask_t both = mask_t{{}} - 1;
    for (int k = 0; k < 2; ++k) {{
        item_t corner[3];
        for (int i = 0; i < (packed ? 1 : lanes); ++i) {{
            const int face = edge_face.data[2 * edge[i] + k];
            if (face < 0) {{
                if (packed) both = mask_t{{}};
                else both[i] = 0;
            }}
            for (int j = 0; j < 3; ++j) corner[j][i] = face_corner.data[3 * (face < 0 ? 0 : face) + j];
        }}
        lane_t a[3], e[3], f[3];
        place(corner[0], a);
        place(corner[1], e);
        place(corner[2], f);
        for (int c = 0; c < 3; ++c) {{
            e[c] -= a[c];
            f[c] -= a[c];
        }}
        cross(e, f, n[k]);
    }}
    const lane_t sizes = __builtin_elementwise_sqrt(dot(n[0], n[0])) * __builtin_elementwise_sqrt(dot(n[1], n[1]));
    return both & (mask_t)(dot(n[0], n[1]) > {SHARP * (1.0 + 1.0e-5)}f * sizes);
}};
"""

# Down the tree with an edge in every lane: ``found`` where a side of a face may be met within ``bound``, ``room`` a
# distance that no face is nearer than, 0 where one may be within ``bound``. Lanes that have found no longer look.
_WALK = f"""
auto walk = [&](const lane_t (&p0)[3], const lane_t (&p1)[3], mask_t wanted, lane_t bound, lane_t ahead,
                lane_t& room) {{
    lane_t e[3], middle[3], half[3];
    for (int c = 0; c < 3; ++c) {{
        e[c] = p1[c] - p0[c];
        half[c] = 0.5f * size(e[c]);
        middle[c] = 0.5f * (p0[c] + p1[c]);
    }}
    const lane_t ee = dot(e, e);
    mask_t found = {{}};
    room = bound + ahead;
    const lane_t square_bound = {(1.0 + MARGIN) ** 2}f * bound * bound;
    lane_t outer = wanted ? room * room : lane_t{{}} - 1.0f, inner = wanted ? square_bound : lane_t{{}} - 1.0f;
    for (int node = root; node < last;) {{
        lane_t gap = {{}};
        for (int c = 0; c < 3; ++c) {{
            const lane_t low = row(box, 6 * node + c), high = row(box, 6 * node + 3 + c);
            const lane_t out = most(most(low - middle[c], middle[c] - high) - half[c], lane_t{{}});
            gap += out * out;
        }}
        const int start = tree_first.data[node];
        if (!any(gap <= outer)) {{
            node = tree_skip.data[node];
            continue;
        }}
        if (start < 0) {{
            ++node;
            continue;
        }}
        const mask_t near = gap <= inner;
        room = (gap <= outer) & ~near ? least(room, __builtin_elementwise_sqrt(gap)) : room;
        if (any(near)) {{
            room = near ? lane_t{{}} : room;
            for (int k = start; k < tree_last.data[node]; ++k) {{
                const int face = tree_face.data[k];
                for (int side = 0; side < 3; ++side) {{
                    if (face_edge.data[3 * face + side] < 0) continue;
                    const int i = point_index.data[face_corner.data[3 * face + side]];
                    const int j = point_index.data[face_corner.data[3 * face + (side + 1) % 3]];
                    lane_t f[3], r[3], n[3];
                    for (int c = 0; c < 3; ++c) {{
                        const lane_t a = row(x, 3 * i + c);
                        f[c] = row(x, 3 * j + c) - a;
                        r[c] = p0[c] - a;
                    }}
                    cross(e, f, n);
                    const lane_t square = dot(n, n), ff = dot(f, f), ef = dot(e, f), er = dot(e, r), fr = dot(f, r);
                    const lane_t s = ef * fr - er * ff, t = ee * fr - ef * er;
                    const lane_t reach = bound + face_radius.data[face], rr = dot(r, r);
                    const lane_t more = {MARGIN}f * square, small = {SLACK}f * __builtin_elementwise_sqrt(rr);
                    const lane_t by_s = more + small * ff * __builtin_elementwise_sqrt(ee);
                    const lane_t by_t = more + small * ee * __builtin_elementwise_sqrt(ff);
                    mask_t meets = near & (mask_t)(square > {PARALLEL * (1.0 - MARGIN)}f * ee * ff);
                    meets &= (mask_t)(s > -by_s) & (mask_t)(s < square + by_s);
                    meets &= (mask_t)(t > -by_t) & (mask_t)(t < square + by_t);
                    const lane_t height = dot(r, n), most_height = {1.0 + MARGIN}f * reach;
                    meets &= (mask_t)(height * height < most_height * most_height * square);
                    found |= meets;
                }}
            }}
            outer = found ? lane_t{{}} - 1.0f : outer;
            inner = found ? lane_t{{}} - 1.0f : inner;
        }}
        node = tree_skip.data[node];
    }}
    return found & wanted;
}};
"""

# Down the tree with a point in every lane: the distance of the nearest face, or ``bound`` where none is nearer.
_NEAREST = """
auto segment = [&](const lane_t (&r)[3], const lane_t (&e)[3]) -> lane_t {
    const lane_t square = dot(e, e), share = dot(r, e) / square;
    const lane_t t = least(most(square > 0.0f ? share : lane_t{}, lane_t{}), lane_t{} + 1.0f);
    lane_t away[3];
    for (int c = 0; c < 3; ++c) away[c] = r[c] - t * e[c];
    return dot(away, away);
};
auto apart = [&](const lane_t (&p)[3], int node) -> lane_t {
    lane_t gap = {};
    for (int c = 0; c < 3; ++c) {
        const lane_t out = most(most(row(box, 6 * node + c) - p[c], p[c] - row(box, 6 * node + 3 + c)), lane_t{});
        gap += out * out;
    }
    return gap;
};
auto of_leaf = [&](const lane_t (&p)[3], int node) -> lane_t {
    lane_t best = lane_t{} + 1.0e15f;
    for (int k = tree_first.data[node]; k < tree_last.data[node]; ++k) {
        const int* const corner = face_corner.data + 3 * tree_face.data[k];
        lane_t r[3], s[3], e[3], f[3], g[3], n[3], re[3], rf[3], away[3];
        for (int c = 0; c < 3; ++c) {
            const lane_t a = row(x, 3 * point_index.data[corner[0]] + c);
            const lane_t b = row(x, 3 * point_index.data[corner[1]] + c);
            const lane_t d = row(x, 3 * point_index.data[corner[2]] + c);
            r[c] = p[c] - a;
            s[c] = p[c] - b;
            e[c] = b - a;
            f[c] = d - a;
            g[c] = d - b;
        }
        cross(e, f, n);
        cross(r, f, rf);
        cross(e, r, re);
        const lane_t square = dot(n, n), u = dot(rf, n) / square, v = dot(re, n) / square;
        for (int c = 0; c < 3; ++c) away[c] = r[c] - u * e[c] - v * f[c];
        const mask_t inside = (u > 0.0f) & (v > 0.0f) & (u + v < 1.0f) & (square > 0.0f);
        const lane_t beside = least(least(segment(r, e), segment(r, f)), segment(s, g));
        const lane_t distance = __builtin_elementwise_sqrt(inside ? dot(away, away) : beside);
        best = least(distance - face_radius.data[tree_face.data[k]], best);
    }
    return best;
};
auto nearest = [&](const lane_t (&p)[3], mask_t wanted, lane_t bound) -> lane_t {
    int first = root;
    while (tree_first.data[first] < 0) {
        const int left = first + 1, right = tree_skip.data[left];
        const mask_t nearer = wanted & (mask_t)(apart(p, right) < apart(p, left));
        first = 2 * __builtin_reduce_add(nearer) < __builtin_reduce_add(wanted) ? right : left;  // that of most lanes
    }
    lane_t best = least(of_leaf(p, first), bound);
    for (int node = root; node < last;) {
        const lane_t within = most(best, lane_t{});
        const mask_t near = wanted & (mask_t)(apart(p, node) <= within * within);
        const int start = tree_first.data[node];
        if (start < 0 && any(near)) {
            ++node;
            continue;
        }
        if (start >= 0 && node != first && any(near)) best = near ? least(of_leaf(p, node), best) : best;
        node = tree_skip.data[node];
    }
    return best;
};
"""

# The features of one chunk: those of near couples, not apart from the box of the target, which may have come within
# reach since their last search; of edges those that may meet a side, of points those that have a face within reach, how
# far away then stands in ``room``. Where a look asks for what is too near only, points that were outside and cannot
# have come to the surface since are left alone.
_CHUNK = f"""
const lane_t reach = row(&wp::index(reach_in, pack, couple, 0), 0);
const lane_t touching = least(reach, most(row(&wp::index(distance_in, pack, pair, 0), 0), lane_t{{}}));
const lane_t way = row(&wp::index(moved, pack, object_a, 0), 0) + row(&wp::index(moved, pack, object_b, 0), 0);
const float* const target = &wp::index(box_in, pack, 7 * object_b, 0);
float* const room = &wp::index(room_out, pack, 0, 0);
int* const sought = &wp::index(sought_out, pack, 0, 0);
mask_t some = {{}};
for (int key = begin; key < end; key += packed ? 1 : lanes) {{
    const int count = packed ? lanes : (end - key < lanes ? end - key : lanes);
    item_t item, point[2];
    lane_t radius = {{}}, space = {{}};
    for (int i = 0; i < (packed ? 1 : lanes); ++i) {{
        item[i] = key + (i < count ? i : count - 1) + offset;
        for (int k = 0; k < 2; ++k) point[k][i] = edges ? edge_point.data[2 * item[i] + k] : item[i];
        const float r = edges ? edge_radius.data[item[i]] : point_radius.data[item[i]];
        const float more = edges ? 0.0f : wp::length(point_inset.data[item[i]]) + wp::length(point_axis.data[item[i]]);
        if (packed) {{
            radius += r;
            space += more;
        }} else {{
            radius[i] = r;
            space[i] = more;
        }}
    }}
    lane_t left = {{}};
    __builtin_memcpy(&left, room + WORLDS * key, 4 * count);
    left -= way;
    mask_t before = {{}};
    __builtin_memcpy(&before, sought + WORLDS * key, 4 * count);
    const lane_t within = is_late && !edges ? before == {OUTSIDE} ? touching : reach : reach;
    mask_t wanted = (mask_t)(reach >= 0.0f) & ~(mask_t)(left > {FARTHER}f * (within + radius + space));
    if (any(wanted)) {{
        lane_t p0[3], p1[3];
        place(point[0], p0);
        if (edges) place(point[1], p1);
        for (int c = 0; c < 3; ++c) {{
            const lane_t p = edges ? 0.5f * (p0[c] + p1[c]) : p0[c];
            const lane_t half = edges ? radius + size(p1[c] - p) : radius;
            wanted &= ~(mask_t)(size(p - row(target, c)) > (row(target, 3 + c) + reach) + half);
        }}
        if (edges && any(wanted)) {{
            const mask_t flat = wanted & is_flat(item), open = wanted & ~flat;
            lane_t distance = {{}};
            wanted = any(open) ? walk(p0, p1, open, reach + radius, {AHEAD}f * way, distance) : mask_t{{}};
            left = flat ? lane_t{{}} : open ? distance : left;
        }} else if (any(wanted)) {{
            const lane_t pad = {ROUNDING}f * (size(p0[0]) + size(p0[1]) + size(p0[2]));
            const lane_t out = most(reach + radius + space, lane_t{{}} + deepest) + pad;
            const lane_t distance = nearest(p0, wanted, out) + pad;
            const mask_t touches = wanted & (mask_t)(distance < out + pad);
            left = touches ? distance : wanted ? distance - 2.0f * pad : left;
            wanted = touches;
        }}
    }}
    __builtin_memcpy(room + WORLDS * key, &left, 4 * count);
    __builtin_memcpy(sought + WORLDS * key, &wanted, 4 * count);
    for (int i = count; i < lanes; ++i) wanted[i] = 0;
    some |= wanted;
}}
if (packed) __builtin_memcpy(&wp::index(chunk_hits_out, pack, chunk, 0), &some, 4 * lanes);
else wp::index(chunk_hits_out, pack, chunk, 0) = any(some);
"""


@cache
def kernels(worlds: int) -> SimpleNamespace:
    """Kernels of packs of eight worlds, or of one world at a time, in single precision.

    Args:
        worlds: 8 or 1.
    """
    module = variant("lanes" if worlds == LANE_COUNT else "scalar").module("proximity_sift")
    Scene, Motion = (getattr(geometry.structures(wp.float32), name) for name in ("Scene", "Motion"))

    @wp.func_native((LANES + _FLAT + _WALK + _NEAREST + _CHUNK).replace("WORLDS", str(worlds)))
    def sift_chunk(
        pack: int,
        chunk: int,
        couple: int,
        object_a: int,
        object_b: int,
        pair: int,
        begin: int,
        end: int,
        offset: int,
        edges: bool,
        root: int,
        last: int,
        deepest: float,
        is_late: bool,
        point_index: wp.array(dtype=wp.int32),
        point_inset: wp.array(dtype=wp.vec3),
        point_axis: wp.array(dtype=wp.vec3),
        point_radius: wp.array(dtype=wp.float32),
        edge_point: wp.array2d(dtype=wp.int32),
        edge_radius: wp.array(dtype=wp.float32),
        edge_face: wp.array2d(dtype=wp.int32),
        tree_skip: wp.array(dtype=wp.int32),
        tree_first: wp.array(dtype=wp.int32),
        tree_last: wp.array(dtype=wp.int32),
        tree_face: wp.array(dtype=wp.int32),
        face_corner: wp.array2d(dtype=wp.int32),
        face_edge: wp.array2d(dtype=wp.int32),
        face_radius: wp.array(dtype=wp.float32),
        position: wp.array3d(dtype=wp.float32),
        tree_box: wp.array3d(dtype=wp.float32),
        box_in: wp.array3d(dtype=wp.float32),
        reach_in: wp.array3d(dtype=wp.float32),
        moved: wp.array3d(dtype=wp.float32),
        distance_in: wp.array3d(dtype=wp.float32),
        chunk_hits_out: wp.array3d(dtype=wp.int32),
        sought_out: wp.array3d(dtype=wp.int32),
        room_out: wp.array3d(dtype=wp.float32),
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
        moved_in: wp.array3d(dtype=wp.float32),
        pair_distance_in: wp.array3d(dtype=wp.float32),
        is_late: bool,
        # Workspace out
        chunk_hits_out: wp.array3d(dtype=wp.int32),
        sought_out: wp.array3d(dtype=wp.int32),
        room_out: wp.array3d(dtype=wp.float32),
    ):
        """Mark the keys of one chunk of a tracked couple that must be searched, and the chunks that have any.

        ``is_late`` asks for what is nearer than the contact distance only, and follows a search of this step.
        """
        pack, item = wp.tid()
        chunk = chunk_list[item]
        couple = chunk_couple[chunk]
        target = scene.couple[couple, wp.static(CoupleColumn.TARGET)]
        deepest = scene.target_depth[target]
        if deepest >= wp.static(FAR):
            deepest = 0.0
        sift_chunk(
            pack,
            chunk,
            couple,
            scene.couple[couple, wp.static(CoupleColumn.OBJECT_A)],
            scene.couple[couple, wp.static(CoupleColumn.OBJECT_B)],
            scene.couple[couple, wp.static(CoupleColumn.PAIR)],
            chunk_key[chunk],
            chunk_key[chunk + 1],
            scene.couple[couple, wp.static(CoupleColumn.FIRST)] - scene.couple[couple, wp.static(CoupleColumn.KEY)],
            scene.couple[couple, wp.static(CoupleColumn.EDGES)] != 0,
            scene.target_tree[target, 0],
            scene.target_tree[target, 1],
            deepest,
            is_late,
            scene.point_index,
            scene.point_inset,
            scene.point_axis,
            scene.point_radius,
            scene.edge_point,
            scene.edge_radius,
            scene.edge_face,
            scene.tree_skip,
            scene.tree_first,
            scene.tree_last,
            scene.tree_face,
            scene.face_corner,
            scene.face_edge,
            scene.face_radius,
            motion.x,
            motion.tree_box,
            box_in,
            reach_in,
            moved_in,
            pair_distance_in,
            chunk_hits_out,
            sought_out,
            room_out,
        )

    return SimpleNamespace(sift=sift)
