"""Narrow phase against shapes: which points and edges of near couples touch, and how. Theory: docs/theory/collision.md.

``find`` marks keys, ``measure`` computes the geometry of those that became contacts; both call the same functions.
On a CPU ``find`` keeps what it has computed of a key within reach, in one of ``seats``, for ``measure`` at the same
place: the search of an edge takes microseconds.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.collision import box_edges, features, geometry, shape_touches, shapes, touches
from softwarp.model.codes import FAR, Carrier, CoupleColumn, Target


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Search and measurement of one variant, on single worlds."""
    real = variant.real
    module = variant.module("proximity")
    types = geometry.structures(real)
    Scene, Motion, Touch, vec3 = types.Scene, types.Motion, types.Touch, types.vec3
    place = geometry.functions(real)
    target_x, target_q, frame_v = place.target_x, place.target_q, place.frame_v
    search = shape_touches.functions(real, real is wp.float32 and not variant.world_fastest)
    touch_shape, line_of, part_of = search.touch_shape, search.line_of, search.part_of
    near_part, grid_of = search.near_part, search.grid_of
    touch_box_edge = box_edges.functions(real).touch_box_edge
    feature = features.functions(real)
    feature_v, is_outside = feature.feature_v, feature.is_outside
    shape = shapes.functions(real)
    rotate, rotate_back = shape.rotate, shape.rotate_back
    write_touch, keep_touch, kept_touch, urgency = vars(touches.functions(real)).values()

    @wp.kernel(module=module, enable_backward=False)
    def find(
        # Model
        scene: Scene,
        chunk_list: wp.array(dtype=wp.int32),
        chunk_key: wp.array(dtype=wp.int32),
        chunk_couple: wp.array(dtype=wp.int32),
        # Workspace in
        motion: Motion,
        box_in: wp.array3d(dtype=real),
        reach_in: wp.array3d(dtype=real),
        hull_in: wp.array3d(dtype=real),
        pair_distance_in: wp.array3d(dtype=real),
        pair_alarm_in: wp.array3d(dtype=real),
        slack: real,
        h: real,
        ahead: real,
        chunk_sifted_in: wp.array(dtype=wp.int32),
        seats: int,
        # Workspace out
        chunk_hits_out: wp.array3d(dtype=wp.int32),
        hit_out: wp.array3d(dtype=wp.int32),
        found_key_out: wp.array3d(dtype=wp.int32),
        found_touch_out: wp.array3d(dtype=real),
    ):
        """Mark the keys of one chunk that touch their shape by urgency, else -1. Far couples are not entered.

        Of chunks that ``sift_shapes`` has looked at only those keys are searched that it has marked.
        """
        pack, item, lane = wp.tid()
        chunk = chunk_list[item]
        couple = chunk_couple[chunk]
        reach = reach_in[pack, couple, lane]
        hits = int(0)
        sifted = chunk_sifted_in[chunk] != 0
        if sifted:
            if chunk_hits_out[pack, chunk, lane] == 0:
                reach = real(-1.0)
        if reach >= real(0.0):
            target = scene.couple[couple, wp.static(CoupleColumn.TARGET)]
            pair = scene.couple[couple, wp.static(CoupleColumn.PAIR)]
            mask = scene.couple[couple, wp.static(CoupleColumn.MASK)]
            edges = scene.couple[couple, wp.static(CoupleColumn.EDGES)] != 0
            b = 7 * scene.couple[couple, wp.static(CoupleColumn.OBJECT_B)]
            centre = vec3()
            extent = vec3()
            for c in range(3):
                centre[c] = box_in[pack, b + c, lane]
                extent[c] = box_in[pack, b + 3 + c, lane] + reach
            first = scene.couple[couple, wp.static(CoupleColumn.FIRST)]
            first_key = scene.couple[couple, wp.static(CoupleColumn.KEY)]
            width = scene.couple[couple, wp.static(CoupleColumn.WIDTH)]
            x = target_x(scene, motion, pack, lane, target)
            q = target_q(scene, motion, pack, lane, target)
            normal = vec3()
            if scene.target_kind[target] == wp.static(Target.PLANE):
                normal = rotate(q, vec3(real(0.0), real(0.0), real(1.0)))
                centre = x
            limit = wp.max(pair_distance_in[pack, pair, lane], pair_alarm_in[pack, pair, lane])
            waits = real(0.0)
            if scene.couple[couple, wp.static(CoupleColumn.PATIENT)] != 0:
                waits = slack
            else:
                limit += slack
            limit = wp.min(limit, pair_distance_in[pack, pair, lane] + ahead)
            care = wp.where(h > real(0.0) or waits > real(0.0), reach, limit)  # no hit comes of what lies beyond
            is_grid = scene.target_kind[target] == wp.static(Target.GRID)
            samples, nodes, origin, spacing = grid_of(scene, target)
            searched = int(-1)  # the last feature that has a side at all, and what its second one touches
            second = Touch()
            for key in range(chunk_key[chunk], chunk_key[chunk + 1]):
                if sifted:
                    if hit_out[pack, key, lane] == 0:
                        hit_out[pack, key, lane] = -1
                        continue
                feature = first + (key - first_key) / width
                hit = int(-1)
                is_second = (key - first_key) % width == 1
                if is_second and searched != feature:
                    hit = -1
                elif not is_outside(scene, motion, pack, lane, edges, feature, centre, extent, normal, reach):
                    touch = second
                    low = real(0.0)
                    high = real(1.0)
                    if is_grid and not is_second:  # most are far: that is told without what all others need
                        start, way, radius = line_of(scene, motion, pack, lane, edges, feature)
                        length = wp.length(way)
                        start = rotate_back(q, start - x)
                        way = rotate_back(q, way)
                        if edges or scene.point_kind[feature] != wp.static(Carrier.RIM):
                            low, high = near_part(
                                scene.grid_value,
                                samples,
                                nodes,
                                origin,
                                spacing,
                                start,
                                way,
                                length,
                                radius,
                                reach,
                                care,
                            )
                    if low < real(0.0):
                        touch = Touch()
                        touch.distance = real(FAR)
                        touch.face = -1
                    elif not is_second:
                        touch, second = touch_shape(
                            scene, motion, pack, lane, couple, key, x, q, reach, care, low, high
                        )
                    if touch.face >= 0:
                        searched = feature
                    if touch.distance <= reach and (touch.region & mask) == touch.region:
                        if touch.face >= 0:
                            keep_touch(pack, key, lane, touch, seats, found_key_out, found_touch_out)
                        if touch.distance >= -scene.target_depth[target]:
                            va = feature_v(scene, motion, pack, lane, couple, key, touch.a, touch.share)
                            vb = frame_v(motion, pack, lane, scene.target_frame[target], touch.b)
                            hit = urgency(touch, va, vb, hull_in, pack, couple, lane, limit, waits, h)
                            if hit >= 0:
                                hits += 1
                hit_out[pack, key, lane] = hit
        chunk_hits_out[pack, chunk, lane] = hits

    @wp.kernel(module=module, enable_backward=False)
    def measure(
        # Model
        scene: Scene,
        parts: int,
        # Workspace in
        motion: Motion,
        reach_in: wp.array3d(dtype=real),
        first_in: wp.array3d(dtype=wp.int32),
        count_in: wp.array3d(dtype=wp.int32),
        key_in: wp.array3d(dtype=wp.int32),
        couple_in: wp.array3d(dtype=wp.int32),
        mark_in: wp.array3d(dtype=wp.int32),
        seats: int,
        found_key_in: wp.array3d(dtype=wp.int32),
        found_touch_in: wp.array3d(dtype=real),
        # Workspace out
        touch_out: wp.array3d(dtype=real),
    ):
        """Geometry of every ``parts``-th contact with a shape, as ``find`` kept it or anew; without ``seats`` anew.

        A mark is that of ``keeping``: the edge of a box that the feature lies across, from 1 on; else 0.
        """
        pack, item, lane = wp.tid()
        for c in range(first_in[pack, 0, lane] + item, count_in[pack, 0, lane], parts):
            couple = couple_in[pack, c, lane]
            target = scene.couple[couple, wp.static(CoupleColumn.TARGET)]
            kind = scene.target_kind[target]
            if kind < wp.static(Target.MESH) or kind == wp.static(Target.GRID):
                key = key_in[pack, c, lane]
                mark = mark_in[pack, c, lane]
                if mark > 0:
                    x = target_x(scene, motion, pack, lane, target)
                    q = target_q(scene, motion, pack, lane, target)
                    edge = scene.couple[couple, wp.static(CoupleColumn.FIRST)]
                    edge += (key - scene.couple[couple, wp.static(CoupleColumn.KEY)]) / scene.couple[
                        couple, wp.static(CoupleColumn.WIDTH)
                    ]
                    start, way, radius = line_of(scene, motion, pack, lane, True, edge)
                    size = scene.target_size[target]
                    touch = touch_box_edge(size, mark - 1, x, q, start, way, radius, real(1.0))
                    write_touch(pack, c, lane, touch, touch_out)
                elif not kept_touch(pack, c, key, lane, seats, found_key_in, found_touch_in, touch_out):
                    x = target_x(scene, motion, pack, lane, target)
                    q = target_q(scene, motion, pack, lane, target)
                    reach = reach_in[pack, couple, lane]
                    low = real(0.0)
                    high = real(1.0)
                    if scene.couple[couple, wp.static(CoupleColumn.EDGES)] != 0:
                        edge = scene.couple[couple, wp.static(CoupleColumn.FIRST)]
                        edge += (key - scene.couple[couple, wp.static(CoupleColumn.KEY)]) / scene.couple[
                            couple, wp.static(CoupleColumn.WIDTH)
                        ]
                        start, way, radius = line_of(scene, motion, pack, lane, True, edge)
                        low, high = part_of(scene, target, x, q, start, way, radius, reach, real(FAR))
                    touch, _ = touch_shape(scene, motion, pack, lane, couple, key, x, q, reach, real(FAR), low, high)
                    write_touch(pack, c, lane, touch, touch_out)

    return SimpleNamespace(find=find, measure=measure)
