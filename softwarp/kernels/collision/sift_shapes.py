"""Which features of soft bodies are near a shape, eight at a time in SIMD registers, on a CPU in float32.

Most corners and edges of a body near a shape are apart from its box, or from its plane, and only that is asked here: as
``features.is_outside`` asks it, with a margin above rounding, so contacts are the same to the bit. A register holds one
feature of eight worlds, or eight features of one world. Theory: docs/theory/bvh.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import LANE_COUNT, variant, vec8
from softwarp.kernels.collision import geometry, shapes
from softwarp.kernels.collision.sift import LANES
from softwarp.model.codes import CoupleColumn, Target

MARGIN = 1.0e-5  # by which this looks farther than the search, relative to coordinates

_CHUNK = f"""
auto lane_of = [](const wp::vec_t<{LANE_COUNT}, wp::float32>& v) -> lane_t {{
    lane_t s;
    __builtin_memcpy(&s, &v, sizeof(s));
    return s;
}};
const lane_t reach = row(&wp::index(reach_in, pack, couple, 0), 0);
const float* const target = &wp::index(box_in, pack, 7 * object_b, 0);
const lane_t n[3] = {{lane_of(n0), lane_of(n1), lane_of(n2)}}, origin[3] = {{lane_of(x0), lane_of(x1), lane_of(x2)}};
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
    rotate = shapes.functions(wp.float32).rotate

    @wp.func_native((LANES + _CHUNK).replace("WORLDS", str(worlds)))
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
        x0: vec8,
        x1: vec8,
        x2: vec8,
        n0: vec8,
        n1: vec8,
        n2: vec8,
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
        is_plane = scene.target_kind[target] == wp.static(Target.PLANE)
        x0 = vec8()
        x1 = vec8()
        x2 = vec8()
        n0 = vec8()
        n1 = vec8()
        n2 = vec8()
        if is_plane:
            for lane in range(wp.static(LANE_COUNT)):
                world = lane % wp.static(worlds)
                x = target_x(scene, motion, pack, world, target)
                n = rotate(target_q(scene, motion, pack, world, target), wp.vec3(0.0, 0.0, 1.0))
                x0[lane] = x[0]
                x1[lane] = x[1]
                x2[lane] = x[2]
                n0[lane] = n[0]
                n1[lane] = n[1]
                n2[lane] = n[2]
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
            scene.couple[couple, wp.static(CoupleColumn.EDGES)] != 0,
            is_plane,
            x0,
            x1,
            x2,
            n0,
            n1,
            n2,
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
