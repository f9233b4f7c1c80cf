"""Narrow phase against triangles and rods: points and edges in their trees. Theory: docs/theory/collision.md.

A mark is 3 face + side for an edge, and for a point 3 face + 1 if its inset was used, else 3 face; so ``measure`` needs
no second search. Hits are ``URGENCIES`` mark + urgency.
Positions are in the coordinates of the target: those of the frame for a rigid mesh, else those of the world.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.collision import faces, features, geometry, nearest, shapes, touches
from softwarp.kernels.collision.shape_touches import UNSURE
from softwarp.kernels.collision.sift import AHEAD, FARTHER, OUTSIDE
from softwarp.model.codes import BALL_RANKS, CORNER, FAR, URGENCIES, Carrier, CoupleColumn, Target


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Search and measurement of one variant, on single worlds."""
    real = variant.real
    module = variant.module("proximity_surface")
    types = geometry.structures(real)
    vec3, vec4 = types.vec3, types.vec4
    Scene, Motion, Touch, Others = types.Scene, types.Motion, types.Touch, types.Others
    place = geometry.functions(real)
    point_x, point_v, frame_v, turned = place.point_x, place.point_v, place.frame_v, place.turned
    target_of, target_x, target_q = place.target_of, place.target_x, place.target_q
    search = nearest.searches(real)
    nearest_face, nearest_side, with_other = search.nearest_face, search.nearest_side, search.with_other
    ball_faces, placed, box_gap = search.ball_faces, search.placed, search.box_gap
    single = faces.functions(real)
    touch_face, touch_side = single.touch_face, single.touch_side
    normal_of, corner_x = single.normal_of, single.corner_x
    taken_t = wp.types.vector(BALL_RANKS - 1, wp.int32)
    near = features.functions(real)
    feature_v, point_inset, around_rim = near.feature_v, near.point_inset, near.around_rim
    is_outside = near.is_outside
    to_local, rotate = shapes.functions(real).to_local, shapes.functions(real).rotate
    touching = touches.functions(real)
    write_touch, urgency = touching.write_touch, touching.urgency

    @wp.func
    def target_v(scene: Scene, motion: Motion, pack: int, lane: int, target: int, touch: Touch, edges: bool):
        """Velocity of the target at a touch."""
        v = vec3()
        if scene.target_kind[target] == wp.static(Target.MESH):
            v = frame_v(motion, pack, lane, scene.target_frame[target], touch.b)
        else:
            face = touch.face
            if edges:
                face = face / 3
            for k in range(3):
                weight = real(1.0) - touch.u - touch.v
                if k == 1:
                    weight = touch.u
                elif k == 2:
                    weight = touch.v
                point = scene.face_corner[face, k]
                if point >= 0:
                    v += weight * point_v(scene, motion, pack, lane, point, point_x(scene, motion, pack, lane, point))
        return v

    @wp.func
    def is_first(scene: Scene, couple: int, key: int, touch: Touch):
        """Whether a point has a lower number than the corner that it touches, so that one of the two counts."""
        corner = scene.face_corner[touch.face, 0]
        if touch.u >= real(0.5):
            corner = scene.face_corner[touch.face, 1]
        elif touch.v >= real(0.5):
            corner = scene.face_corner[touch.face, 2]
        return (
            corner
            > scene.couple[couple, wp.static(CoupleColumn.FIRST)]
            + key
            - scene.couple[couple, wp.static(CoupleColumn.KEY)]
        )

    @wp.func
    def urgency_of(
        scene: Scene,
        motion: Motion,
        pack: int,
        lane: int,
        couple: int,
        key: int,
        touch: Touch,
        hull: wp.array3d(dtype=real),
        limit: real,
        slack: real,
        h: real,
    ):
        """Urgency of a touch: -1 if it is too far for its speed, too deep, or on the wrong part of its target."""
        urgent = int(-1)
        mask = scene.couple[couple, wp.static(CoupleColumn.MASK)]
        target = target_of(scene, motion, pack, lane, couple)
        if touch.face >= 0 and (touch.region & mask) != 0 and touch.distance >= -scene.target_depth[target]:
            edges = scene.couple[couple, wp.static(CoupleColumn.EDGES)] != 0
            va = feature_v(scene, motion, pack, lane, couple, key, touch.a, touch.share)
            vb = target_v(scene, motion, pack, lane, target, touch, edges)
            urgent = urgency(touch, va, vb, hull, pack, couple, lane, limit, slack, h)
            if (
                scene.couple[couple, wp.static(CoupleColumn.SELF)] != 0
                and not edges
                and touch.region == wp.static(CORNER)
            ):
                if not is_first(scene, couple, key, touch):
                    urgent = -1
        return urgent

    @wp.func
    def on_rim(scene: Scene, motion: Motion, pack: int, lane: int, point: int, n: vec3):
        """Where a rim comes nearest to a plane of normal n."""
        arm = turned(motion, pack, lane, scene.point_index[point], scene.point_axis[point])
        radius = wp.length(arm)
        e = around_rim(scene.point_quarter[point], arm / radius, n)
        return point_x(scene, motion, pack, lane, point) + radius * e

    @wp.func
    def search_key(
        scene: Scene,
        motion: Motion,
        pack: int,
        lane: int,
        couple: int,
        key: int,
        feature: int,
        x: vec3,
        q: vec4,
        hull: wp.array3d(dtype=real),
        reach: real,
        alarm: real,
        limit: real,
        slack: real,
        h: real,
        clear: real,
        ahead: real,
        near: real,
        hit_out: wp.array3d(dtype=wp.int32),
    ):
        """Mark the keys of one feature; returns how many touch, and a distance that no face is nearer than.

        A point may be known to have a face ``near`` it, ``FAR`` if not.

        Stages: 0 the middle of a rim; 1 the point itself; 2 the point or its inset, rank by rank; 3 an edge, and if it
        is behind another one, whether it is inside; 4 the end.
        """
        target = target_of(scene, motion, pack, lane, couple)
        width = scene.couple[couple, wp.static(CoupleColumn.WIDTH)]
        own = scene.couple[couple, wp.static(CoupleColumn.SELF)] != 0
        edges = scene.couple[couple, wp.static(CoupleColumn.EDGES)] != 0
        hits = int(0)
        stage = int(4)
        p = vec3()
        a = vec3()
        inset = vec3()
        inside = int(0)
        known = near
        radius = scene.edge_radius[0]
        room = real(0.0)
        out = reach
        close = reach
        me = int(-1)
        rank = int(0)
        others = Others()
        touch = Touch()
        if edges:
            radius = scene.edge_radius[feature]
            touch, room = nearest_side(scene, motion, pack, lane, target, feature, x, q, reach, own, clear, ahead)
            if touch.face >= 0:
                stage = 3
                p = touch.a
                out = real(2.0) * wp.abs(touch.distance)
        else:
            radius = scene.point_radius[feature]
            a = point_x(scene, motion, pack, lane, feature)
            p = to_local(x, q, a)
            out = feature_reach(scene, edges, feature, reach)
            close = out
            if box_gap(scene, motion, pack, lane, scene.target_tree[target, 0], p, vec3()) <= out * out:
                stage = 1
                if scene.point_kind[feature] == wp.static(Carrier.RIM):
                    stage = 0
                if own:
                    me = feature
                elif scene.target_depth[target] < real(FAR):
                    out = wp.max(out, scene.target_depth[target])
            room = out
        while stage < 4:
            good = bool(True)
            best = touch
            if stage < 3 or (best.distance < real(0.0) and not own):
                limits = alarm + radius
                best = nearest_face(scene, motion, pack, lane, target, p, out, me, clear, others, rank, limits, known)
            if stage == 1 and rank == 0 and best.face >= 0:
                room = wp.max(best.distance, real(0.0))
            if stage == 3:
                good = touch.distance >= real(0.0) or own or best.distance <= real(0.0)
                stage = 4
            elif best.face < 0:
                good = False
                stage = 4
            elif stage == 0:
                good = False
                a = on_rim(scene, motion, pack, lane, feature, rotate(q, best.normal))
                p = to_local(x, q, a)
                stage = 1
            else:
                touch = best
                if stage == 1 and best.distance < real(UNSURE) * wp.length(scene.point_inset[feature]):
                    good = False
                    inside = 1
                    inset = point_inset(scene, motion, pack, lane, feature, a)
                    p = to_local(x, q, a + inset)
                    known = near + wp.length(inset)
                    stage = 2
                else:
                    stage = 2
                    others = with_other(others, best, rank)
            if good:
                result = placed(touch, x, q, inset, radius)
                urgent = urgency_of(scene, motion, pack, lane, couple, key, result, hull, limit, slack, h)
                if urgent >= 0:
                    mark = result.face
                    if not edges:
                        mark = 3 * result.face + inside
                    hit_out[pack, key + rank, lane] = wp.static(URGENCIES) * mark + urgent
                    hits += 1
                rank += 1
                out = close  # only the nearest face is of interest from deep inside
                if rank >= width:
                    stage = 4
        return hits, room

    @wp.func
    def feature_reach(scene: Scene, edges: bool, feature: int, reach: real):
        """Distance of a feature's points from a target within which it may touch."""
        out = reach
        if edges:
            out += scene.edge_radius[feature]
        else:
            out += scene.point_radius[feature]
            out += wp.length(scene.point_inset[feature]) + wp.length(scene.point_axis[feature])
        return out

    @wp.func
    def search_ball(
        scene: Scene,
        motion: Motion,
        pack: int,
        lane: int,
        couple: int,
        key: int,
        feature: int,
        x: vec3,
        q: vec4,
        hull: wp.array3d(dtype=real),
        reach: real,
        limit: real,
        slack: real,
        h: real,
        clear: real,
        hit_out: wp.array3d(dtype=wp.int32),
    ):
        """Mark the keys of a ball against a surface that is not convex; returns how many touch.

        A ball whose centre is inside leaves through the nearest face; outside it touches floor and walls alike.
        """
        target = target_of(scene, motion, pack, lane, couple)
        radius = scene.point_radius[feature]
        p = to_local(x, q, point_x(scene, motion, pack, lane, feature))
        out = reach + radius
        hits = int(0)
        inset = vec3()
        best = Touch()
        best.face = -1
        if box_gap(scene, motion, pack, lane, scene.target_tree[target, 0], p, inset) <= out * out:
            best = nearest_face(scene, motion, pack, lane, target, p, out, -1, clear, Others(), 0, real(0.0), real(FAR))
        if best.face >= 0:
            faces_near = taken_t()
            count = int(0)
            if best.distance >= real(0.0):
                faces_near = ball_faces(scene, motion, pack, lane, target, p, out, best.normal)
                count = wp.static(BALL_RANKS - 1)
            rank = int(0)
            while best.face >= 0:
                result = placed(best, x, q, inset, radius)
                urgent = urgency_of(scene, motion, pack, lane, couple, key, result, hull, limit, slack, h)
                if urgent >= 0:
                    hit_out[pack, key + rank, lane] = wp.static(URGENCIES) * 3 * best.face + urgent
                    hits += 1
                best.face = -1
                if rank < count:
                    if faces_near[rank] >= 0:
                        best = touch_face(scene, motion, pack, lane, target, faces_near[rank], p)
                rank += 1
        return hits

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
        moved_in: wp.array3d(dtype=real),
        is_sifted: bool,
        # Workspace out
        sought_out: wp.array3d(dtype=wp.int32),
        chunk_hits_out: wp.array3d(dtype=wp.int32),
        hit_out: wp.array3d(dtype=wp.int32),
        room_out: wp.array3d(dtype=real),
    ):
        """Mark the keys of one chunk with the nearest face, or side, -1 for none. Far couples are not entered.

        Features of tracked couples are left alone as long as they cannot have come within reach since their last
        search: ``room`` is a distance that the target is not nearer than, less by all that both have moved since. Which
        these are is known where ``sift`` has looked; points that were searched and found outside are marked for it.
        """
        pack, item, lane = wp.tid()
        chunk = chunk_list[item]
        couple = chunk_couple[chunk]
        reach = reach_in[pack, couple, lane]
        hits = int(0)
        is_tracked = scene.couple[couple, wp.static(CoupleColumn.TRACKED)] != 0
        sifted = is_sifted and is_tracked
        way = real(0.0)
        if is_tracked:
            way = moved_in[pack, scene.couple[couple, wp.static(CoupleColumn.OBJECT_A)], lane]
            way += moved_in[pack, scene.couple[couple, wp.static(CoupleColumn.OBJECT_B)], lane]
        if sifted:
            if chunk_hits_out[pack, chunk, lane] == 0:
                reach = real(-1.0)
        elif is_tracked:
            for key in range(chunk_key[chunk], chunk_key[chunk + 1]):
                room_out[pack, key, lane] -= way
        if reach >= real(0.0):
            target = target_of(scene, motion, pack, lane, couple)
            pair = scene.couple[couple, wp.static(CoupleColumn.PAIR)]
            width = scene.couple[couple, wp.static(CoupleColumn.WIDTH)]
            first_key = scene.couple[couple, wp.static(CoupleColumn.KEY)]
            alarm = wp.max(pair_distance_in[pack, pair, lane], pair_alarm_in[pack, pair, lane]) + slack
            clear = wp.max(real(2.0) * alarm, scene.couple_clear[couple])
            edges = scene.couple[couple, wp.static(CoupleColumn.EDGES)] != 0
            b = 7 * scene.couple[couple, wp.static(CoupleColumn.OBJECT_B)]
            none = vec3()
            centre = vec3()
            extent = vec3()
            for c in range(3):
                centre[c] = box_in[pack, b + c, lane]
                extent[c] = box_in[pack, b + 3 + c, lane] + reach
            x = target_x(scene, motion, pack, lane, target)
            q = target_q(scene, motion, pack, lane, target)
            key = int(chunk_key[chunk])
            while key < chunk_key[chunk + 1]:
                feature = scene.couple[couple, wp.static(CoupleColumn.FIRST)] + (key - first_key) / width
                slot = int(0)
                while slot < width:
                    hit_out[pack, key + slot, lane] = -1
                    slot += 1
                is_far = bool(False)
                if sifted:
                    is_far = sought_out[pack, key, lane] == 0
                else:
                    is_far = is_outside(scene, motion, pack, lane, edges, feature, centre, extent, none, reach)
                    if is_tracked and not is_far:
                        is_far = room_out[pack, key, lane] > real(FARTHER) * feature_reach(scene, edges, feature, reach)
                if not is_far:
                    near = alarm
                    waits = real(0.0)
                    if scene.couple[couple, wp.static(CoupleColumn.PATIENT)] != 0:
                        near = alarm - slack
                        waits = slack
                    near = wp.min(near, pair_distance_in[pack, pair, lane] + ahead)
                    known = real(FAR)
                    if sifted and not edges:
                        known = room_out[pack, key, lane]
                    if width == wp.static(BALL_RANKS) and not edges:
                        hits += search_ball(
                            scene,
                            motion,
                            pack,
                            lane,
                            couple,
                            key,
                            feature,
                            x,
                            q,
                            hull_in,
                            reach,
                            near,
                            waits,
                            h,
                            clear,
                            hit_out,
                        )
                    else:
                        found, room = search_key(
                            scene,
                            motion,
                            pack,
                            lane,
                            couple,
                            key,
                            feature,
                            x,
                            q,
                            hull_in,
                            reach,
                            alarm,
                            near,
                            waits,
                            h,
                            clear,
                            real(AHEAD) * way,
                            known,
                            hit_out,
                        )
                        hits += found
                        if is_tracked:
                            room_out[pack, key, lane] = room
                        if sifted and not edges:
                            if room > real(0.0) and room < feature_reach(scene, edges, feature, reach):
                                sought_out[pack, key, lane] = wp.static(OUTSIDE)
                key += width
        chunk_hits_out[pack, chunk, lane] = hits

    @wp.func
    def measure_point(
        scene: Scene, motion: Motion, pack: int, lane: int, target: int, point: int, mark: int, x: vec3, q: vec4
    ):
        """A point, or its inset and then its foot, against the face it was found to touch; a rim against its plane."""
        touch = Touch()
        a = point_x(scene, motion, pack, lane, point)
        inset = vec3()
        stage = int(1)
        is_rim = scene.point_kind[point] == wp.static(Carrier.RIM)
        n = normal_of(scene, motion, pack, lane, target, mark / 3)
        if is_rim:
            a = on_rim(scene, motion, pack, lane, point, rotate(q, n))
        if mark % 3 == 1:
            inset = point_inset(scene, motion, pack, lane, point, a)
        while stage < 3:
            best = touch_face(scene, motion, pack, lane, target, mark / 3, to_local(x, q, a + inset))
            if is_rim:
                corner = corner_x(scene, motion, pack, lane, target, scene.face_corner[mark / 3, 0])
                best.distance = wp.dot(best.a - corner, n) - scene.face_radius[mark / 3]
                best.normal = n
                best.b = best.a - best.distance * n
            if stage == 1:
                touch = placed(best, x, q, inset, scene.point_radius[point])
                stage = 3
                if mark % 3 == 1 and scene.target_kind[target] >= wp.static(Target.SOFT):
                    inset = vec3()
                    stage = 2
            else:
                touch.u = best.u
                touch.v = best.v
                touch.b = best.b
                stage = 3
        return touch

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
        face_in: wp.array3d(dtype=wp.int32),
        # Workspace out
        touch_out: wp.array3d(dtype=real),
    ):
        """Geometry of every ``parts``-th contact with a surface or a rod."""
        pack, item, lane = wp.tid()
        for c in range(first_in[pack, 0, lane] + item, count_in[pack, 0, lane], parts):
            couple = couple_in[pack, c, lane]
            target = target_of(scene, motion, pack, lane, couple)
            kind = scene.target_kind[target]
            if kind == wp.static(Target.MESH) or kind >= wp.static(Target.SOFT):
                x = target_x(scene, motion, pack, lane, target)
                q = target_q(scene, motion, pack, lane, target)
                feature = key_in[pack, c, lane] - scene.couple[couple, wp.static(CoupleColumn.KEY)]
                feature = (
                    scene.couple[couple, wp.static(CoupleColumn.FIRST)]
                    + feature / scene.couple[couple, wp.static(CoupleColumn.WIDTH)]
                )
                mark = face_in[pack, c, lane]
                touch = Touch()
                inset = vec3()
                if scene.couple[couple, wp.static(CoupleColumn.EDGES)] != 0:
                    p0 = to_local(x, q, point_x(scene, motion, pack, lane, scene.edge_point[feature, 0]))
                    p1 = to_local(x, q, point_x(scene, motion, pack, lane, scene.edge_point[feature, 1]))
                    touch = touch_side(scene, motion, pack, lane, target, mark / 3, mark % 3, p0, p1)
                    touch = placed(touch, x, q, inset, scene.edge_radius[feature])
                else:
                    touch = measure_point(scene, motion, pack, lane, target, feature, mark, x, q)
                write_touch(pack, c, lane, touch, touch_out)

    return SimpleNamespace(find=find, measure=measure)
