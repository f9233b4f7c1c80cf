"""Contacts that pressed in an earlier iterate stay listed in stuck worlds. Theory: docs/theory/newton.md, Contacts.

Detection takes the nearest part of a target, and the lowest place of an edge: between two iterates, these may jump from
one part to another and back, each of which holds what the other lets through. What is kept is measured where the
bodies are, as a contact like the others, and says what is true there: where its gap is open it has no force.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.collision import box_edges, faces, features, geometry, listing, nearest, shape_touches, shapes
from softwarp.kernels.collision.box_edges import BOX_EDGES
from softwarp.kernels.collision.faces import CONE, HELD_CONE
from softwarp.kernels.collision.geometry import DISTANCE, NORMAL, SHARE, TOUCH_ROWS
from softwarp.kernels.collision.shape_touches import STRETCH
from softwarp.model.codes import FACE, FAR_FROM, CoupleColumn, Target

CREASE = 1.0e-3  # sine of the angle from which two faces form a crease, in which a point touches both
NEAR = 1.0e-2  # of an edge: distance by which what is found may differ from what is across an edge of a box
SAME = 0.99  # cosine of the angle between their normals


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels of one variant, on single worlds."""
    real = variant.real
    module = variant.module("keeping")
    types = geometry.structures(real)
    vec3, Scene, Motion = types.vec3, types.Scene, types.Motion
    place = geometry.functions(real)
    point_x, target_x, target_q, target_of = place.point_x, place.target_x, place.target_q, place.target_of
    search = shape_touches.functions(real, real is wp.float32 and not variant.world_fastest)
    line_of = search.line_of
    touch_box_edge = box_edges.functions(real).touch_box_edge
    single = faces.functions(real)
    touch_face, touch_side, is_in_cone = single.touch_face, single.touch_side, single.is_in_cone
    normal_of, corner_x = single.normal_of, single.corner_x
    leaves = nearest.searches(real).leaves
    shape = shapes.functions(real)
    to_local, rotate = shape.to_local, shape.rotate
    point_inset, edge_inset = features.functions(real).point_inset, features.functions(real).edge_inset
    lists = listing.kernels(variant)
    place_of, put = lists.place_of, lists.put

    @wp.kernel(module=module, enable_backward=False)
    def note(
        # Workspace in
        stuck_in: wp.array3d(dtype=wp.int32),
        listed_in: wp.array3d(dtype=wp.int32),
        count_in: wp.array3d(dtype=wp.int32),
        key_in: wp.array3d(dtype=wp.int32),
        couple_in: wp.array3d(dtype=wp.int32),
        face_in: wp.array3d(dtype=wp.int32),
        held_in: wp.array3d(dtype=wp.int32),
        multiplier_in: wp.array3d(dtype=real),
        # Workspace out
        known_couple_out: wp.array3d(dtype=wp.int32),
        known_face_out: wp.array3d(dtype=wp.int32),
        known_held_out: wp.array3d(dtype=wp.int32),
    ):
        """Couple and mark of one contact, and whether it has pressed in this step, in the order of ``remember``."""
        pack, c, lane = wp.tid()
        if stuck_in[pack, 0, lane] == 0:
            return
        count = count_in[pack, 0, lane]
        at = place_of(pack, lane, c, count, listed_in, key_in)
        held = int(0)
        if c < count:
            held = held_in[pack, c, lane]
            if multiplier_in[pack, 3 * c, lane] > real(0.0):
                held = int(1)
        known_couple_out[pack, at, lane] = couple_in[pack, c, lane]
        known_face_out[pack, at, lane] = face_in[pack, c, lane]
        known_held_out[pack, at, lane] = held

    @wp.func
    def insert(
        pack: int,
        count: int,
        lane: int,
        pair: int,
        key: int,
        couple: int,
        mark: int,
        known: int,
        key_out: wp.array3d(dtype=wp.int32),
        pair_out: wp.array3d(dtype=wp.int32),
        couple_out: wp.array3d(dtype=wp.int32),
        face_out: wp.array3d(dtype=wp.int32),
        known_out: wp.array3d(dtype=wp.int32),
        held_out: wp.array3d(dtype=wp.int32),
    ):
        """Put a contact behind all others of ``count`` whose keys are not greater."""
        place = int(count)
        while place > 0 and key_out[pack, wp.max(place - 1, 0), lane] > key:
            key_out[pack, place, lane] = key_out[pack, place - 1, lane]
            pair_out[pack, place, lane] = pair_out[pack, place - 1, lane]
            couple_out[pack, place, lane] = couple_out[pack, place - 1, lane]
            face_out[pack, place, lane] = face_out[pack, place - 1, lane]
            known_out[pack, place, lane] = known_out[pack, place - 1, lane]
            held_out[pack, place, lane] = held_out[pack, place - 1, lane]
            place -= 1
        put(
            pack,
            place,
            lane,
            pair,
            key,
            couple,
            mark,
            known,
            key_out,
            pair_out,
            couple_out,
            face_out,
            known_out,
        )
        held_out[pack, place, lane] = 1

    @wp.func
    def feature_of(scene: Scene, couple: int, key: int):
        """Point or edge of a key."""
        offset = key - scene.couple[couple, wp.static(CoupleColumn.KEY)]
        return (
            scene.couple[couple, wp.static(CoupleColumn.FIRST)]
            + offset / scene.couple[couple, wp.static(CoupleColumn.WIDTH)]
        )

    @wp.func
    def is_crease(scene: Scene, motion: Motion, pack: int, lane: int, target: int, face: int, other: int):
        """Whether the middle of another face lies before a face: they form a crease."""
        a = corner_x(scene, motion, pack, lane, target, scene.face_corner[face, 0])
        way = vec3()
        for k in range(3):
            way += corner_x(scene, motion, pack, lane, target, scene.face_corner[other, k]) - a
        return wp.dot(normal_of(scene, motion, pack, lane, target, face), way) > real(CREASE) * wp.length(way)

    @wp.func
    def is_before(scene: Scene, motion: Motion, pack: int, lane: int, couple: int, point: int, mark: int):
        """Whether a point lies before a face, and not deeper behind it than counts."""
        target = target_of(scene, motion, pack, lane, couple)
        x = target_x(scene, motion, pack, lane, target)
        q = target_q(scene, motion, pack, lane, target)
        a = point_x(scene, motion, pack, lane, point)
        if mark % 3 == 1:
            a += point_inset(scene, motion, pack, lane, point, a)
        touch = touch_face(scene, motion, pack, lane, target, mark / 3, to_local(x, q, a))
        return touch.region == wp.static(FACE) and touch.distance >= -scene.target_depth[target]

    @wp.func
    def is_across(
        scene: Scene,
        motion: Motion,
        pack: int,
        lane: int,
        couple: int,
        edge: int,
        mark: int,
        cone: real,
    ):
        """Whether an edge meets a side of a face within both, in a direction in which both can be touched."""
        target = target_of(scene, motion, pack, lane, couple)
        x = target_x(scene, motion, pack, lane, target)
        q = target_q(scene, motion, pack, lane, target)
        p0 = to_local(x, q, point_x(scene, motion, pack, lane, scene.edge_point[edge, 0]))
        p1 = to_local(x, q, point_x(scene, motion, pack, lane, scene.edge_point[edge, 1]))
        touch = touch_side(scene, motion, pack, lane, target, mark / 3, mark % 3, p0, p1)
        good = touch.distance < real(FAR_FROM) and touch.distance >= -scene.target_depth[target]
        if good and scene.face_corner[mark / 3, 2] >= 0:
            good = is_in_cone(scene, motion, pack, lane, target, mark / 3, mark % 3, touch.normal, cone)
        if good:
            good = leaves(scene, motion, pack, lane, edge, rotate(q, touch.normal), cone)
        return good

    @wp.func
    def is_lying(scene: Scene, motion: Motion, pack: int, lane: int, edge: int, target: int, number: int):
        """Whether an edge lies on a box's edge with the outside of its own body, and not deeper than counts."""
        x = target_x(scene, motion, pack, lane, target)
        q = target_q(scene, motion, pack, lane, target)
        start, way, radius = line_of(scene, motion, pack, lane, True, edge)
        touch = touch_box_edge(scene.target_size[target], number, x, q, start, way, radius, real(HELD_CONE))
        good = touch.face >= 0 and touch.distance >= -scene.target_depth[target]
        if good:
            if scene.edge_face[edge, 0] >= 0:
                good = leaves(scene, motion, pack, lane, edge, touch.normal, real(HELD_CONE))
            else:
                inset = edge_inset(scene, motion, pack, lane, edge)
                good = wp.dot(touch.normal, inset) >= -real(HELD_CONE) * wp.length(inset)
        return good

    @wp.kernel(module=module, enable_backward=False)
    def keep_on_faces(
        # Model
        scene: Scene,
        capacity: int,
        # Workspace in
        stuck_in: wp.array3d(dtype=wp.int32),
        motion: Motion,
        known_count_in: wp.array3d(dtype=wp.int32),
        known_key_in: wp.array3d(dtype=wp.int32),
        known_couple_in: wp.array3d(dtype=wp.int32),
        known_face_in: wp.array3d(dtype=wp.int32),
        known_held_in: wp.array3d(dtype=wp.int32),
        # Workspace out
        listed_out: wp.array3d(dtype=wp.int32),
        count_out: wp.array3d(dtype=wp.int32),
        overflow_out: wp.array3d(dtype=wp.int32),
        key_out: wp.array3d(dtype=wp.int32),
        pair_out: wp.array3d(dtype=wp.int32),
        couple_out: wp.array3d(dtype=wp.int32),
        face_out: wp.array3d(dtype=wp.int32),
        known_out: wp.array3d(dtype=wp.int32),
        held_out: wp.array3d(dtype=wp.int32),
    ):
        """List what pressed against faces and their sides, and is not listed: points in creases, edges across.

        What has no place is counted.
        """
        pack, lane = wp.tid()
        if stuck_in[pack, 0, lane] == 0:
            return
        count = count_out[pack, 0, lane]
        missed = int(0)
        for c in range(count):
            held = int(0)
            if known_out[pack, c, lane] >= 0:
                held = known_held_in[pack, known_out[pack, c, lane], lane]
            held_out[pack, c, lane] = held
        for m in range(wp.min(known_count_in[pack, 0, lane], capacity)):
            couple = known_couple_in[pack, m, lane]
            target = target_of(scene, motion, pack, lane, couple)
            kind = scene.target_kind[target]
            is_new = known_held_in[pack, m, lane] != 0 and scene.couple[couple, wp.static(CoupleColumn.SELF)] == 0
            if is_new and (kind == wp.static(Target.MESH) or kind >= wp.static(Target.SOFT)):
                edges = scene.couple[couple, wp.static(CoupleColumn.EDGES)] != 0
                key = known_key_in[pack, m, lane]
                mark = known_face_in[pack, m, lane]
                feature = feature_of(scene, couple, key)
                others = int(0)
                for c in range(count):
                    if couple_out[pack, c, lane] == couple:
                        if feature_of(scene, couple, key_out[pack, c, lane]) == feature:
                            others += 1
                            other = face_out[pack, c, lane]
                            if edges:
                                is_new = is_new and other != mark
                            elif is_new:
                                is_new = is_crease(scene, motion, pack, lane, target, mark / 3, other / 3)
                if is_new and edges:
                    cone = wp.where(others == 0, real(HELD_CONE), real(CONE))
                    is_new = is_across(scene, motion, pack, lane, couple, feature, mark, cone)
                elif is_new:
                    is_new = others > 0 and is_before(scene, motion, pack, lane, couple, feature, mark)
                if is_new and count < capacity:
                    pair = scene.couple[couple, wp.static(CoupleColumn.PAIR)]
                    insert(
                        pack,
                        count,
                        lane,
                        pair,
                        key,
                        couple,
                        mark,
                        m,
                        key_out,
                        pair_out,
                        couple_out,
                        face_out,
                        known_out,
                        held_out,
                    )
                    count += 1
                elif is_new:
                    missed += 1
        listed_out[pack, 0, lane] = count
        count_out[pack, 0, lane] = count
        overflow_out[pack, 0, lane] = wp.max(overflow_out[pack, 0, lane], missed)

    @wp.kernel(module=module, enable_backward=False)
    def mark_boxes(
        # Model
        scene: Scene,
        # Workspace in
        stuck_in: wp.array3d(dtype=wp.int32),
        motion: Motion,
        count_in: wp.array3d(dtype=wp.int32),
        key_in: wp.array3d(dtype=wp.int32),
        couple_in: wp.array3d(dtype=wp.int32),
        touch_in: wp.array3d(dtype=real),
        # Workspace out
        face_out: wp.array3d(dtype=wp.int32),
    ):
        """Mark of an edge that lies across an edge of a box, from 1 on, where detection has found it there."""
        pack, c, lane = wp.tid()
        if stuck_in[pack, 0, lane] == 0 or c >= count_in[pack, 0, lane]:
            return
        couple = couple_in[pack, c, lane]
        target = scene.couple[couple, wp.static(CoupleColumn.TARGET)]
        is_edge = scene.couple[couple, wp.static(CoupleColumn.EDGES)] != 0
        if is_edge and scene.target_kind[target] == wp.static(Target.BOX):
            edge = feature_of(scene, couple, key_in[pack, c, lane])
            x = target_x(scene, motion, pack, lane, target)
            q = target_q(scene, motion, pack, lane, target)
            start, way, radius = line_of(scene, motion, pack, lane, True, edge)
            row = wp.static(TOUCH_ROWS) * c
            n = vec3()
            for k in range(3):
                n[k] = touch_in[pack, row + wp.static(NORMAL) + k, lane]
            nearest = real(STRETCH)
            for number in range(wp.static(BOX_EDGES)):
                size = scene.target_size[target]
                touch = touch_box_edge(size, number, x, q, start, way, radius, real(HELD_CONE))
                apart = wp.abs(touch.share - touch_in[pack, row + wp.static(SHARE), lane])
                off = wp.abs(touch.distance - touch_in[pack, row + wp.static(DISTANCE), lane])
                if touch.face >= 0 and apart < nearest and off < real(NEAR) * wp.length(way):
                    if wp.dot(touch.normal, n) > real(SAME):
                        nearest = apart
                        face_out[pack, c, lane] = number + 1

    @wp.kernel(module=module, enable_backward=False)
    def keep_on_boxes(
        # Model
        scene: Scene,
        capacity: int,
        # Workspace in
        stuck_in: wp.array3d(dtype=wp.int32),
        motion: Motion,
        known_count_in: wp.array3d(dtype=wp.int32),
        known_key_in: wp.array3d(dtype=wp.int32),
        known_couple_in: wp.array3d(dtype=wp.int32),
        known_face_in: wp.array3d(dtype=wp.int32),
        known_held_in: wp.array3d(dtype=wp.int32),
        # Workspace out
        listed_out: wp.array3d(dtype=wp.int32),
        count_out: wp.array3d(dtype=wp.int32),
        overflow_out: wp.array3d(dtype=wp.int32),
        key_out: wp.array3d(dtype=wp.int32),
        pair_out: wp.array3d(dtype=wp.int32),
        couple_out: wp.array3d(dtype=wp.int32),
        face_out: wp.array3d(dtype=wp.int32),
        known_out: wp.array3d(dtype=wp.int32),
        held_out: wp.array3d(dtype=wp.int32),
    ):
        """List edges that pressed across edges of boxes, and are not listed there; what has no place is counted."""
        pack, lane = wp.tid()
        if stuck_in[pack, 0, lane] == 0:
            return
        count = count_out[pack, 0, lane]
        missed = int(0)
        for m in range(wp.min(known_count_in[pack, 0, lane], capacity)):
            couple = known_couple_in[pack, m, lane]
            target = scene.couple[couple, wp.static(CoupleColumn.TARGET)]
            mark = known_face_in[pack, m, lane]
            is_new = known_held_in[pack, m, lane] != 0 and mark > 0
            is_new = is_new and scene.couple[couple, wp.static(CoupleColumn.EDGES)] != 0
            if is_new and scene.target_kind[target] == wp.static(Target.BOX):
                key = known_key_in[pack, m, lane]
                edge = feature_of(scene, couple, key)
                for c in range(count):
                    if couple_out[pack, c, lane] == couple and face_out[pack, c, lane] == mark:
                        is_new = is_new and feature_of(scene, couple, key_out[pack, c, lane]) != edge
                if is_new:
                    is_new = is_lying(scene, motion, pack, lane, edge, target, mark - 1)
                if is_new and count < capacity:
                    pair = scene.couple[couple, wp.static(CoupleColumn.PAIR)]
                    insert(
                        pack,
                        count,
                        lane,
                        pair,
                        key,
                        couple,
                        mark,
                        m,
                        key_out,
                        pair_out,
                        couple_out,
                        face_out,
                        known_out,
                        held_out,
                    )
                    count += 1
                elif is_new:
                    missed += 1
        listed_out[pack, 0, lane] = count
        count_out[pack, 0, lane] = count
        overflow_out[pack, 0, lane] = overflow_out[pack, 0, lane] + missed

    return SimpleNamespace(note=note, mark_boxes=mark_boxes, keep_on_faces=keep_on_faces, keep_on_boxes=keep_on_boxes)
