"""Broad phase, and rows of the contacts that were found. Theory: docs/theory/collision.md.

Every object has a box and a speed per world; a *couple* (features of one object against one target of another) is near
where the boxes come closer than the couple's reach. Near couples are searched by ``shapes_phase`` and
``surface_phase``, which mark the keys that touch; ``listing`` makes these contacts, and here they get axes, gaps and
slots.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.collision import geometry, strike
from softwarp.kernels.collision.geometry import (
    APART,
    BARY,
    DISTANCE,
    NORMAL,
    POINT_A,
    POINT_B,
    SHARE,
    TURNED,
)
from softwarp.model.codes import FAR, SLOTS, WORLD, Carrier, CoupleColumn, Target


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels of one variant, on single worlds."""
    real = variant.real
    module = variant.module("collision")
    types = geometry.structures(real)
    vec3 = types.vec3
    Scene, Motion = types.Scene, types.Motion
    place = geometry.functions(real)
    frame_x, node_x, turned, carrier_x = place.frame_x, place.node_x, place.turned, place.carrier_x
    frame_v = place.frame_v
    is_near = strike.functions(real).is_near

    @wp.kernel(module=module, enable_backward=False)
    def bounds(
        # Model
        object_frame: wp.array(dtype=wp.int32),
        object_round: wp.array(dtype=wp.int32),
        object_centre: wp.array(dtype=vec3),
        object_extent: wp.array(dtype=vec3),
        # Workspace in
        motion: Motion,
        # Workspace out
        box_out: wp.array3d(dtype=real),
        velocity_out: wp.array3d(dtype=real),
    ):
        """Box and speed limit of one rigid object: rows centre (3), half extent (3), speed; bounds of its velocities.

        ``object_frame`` is ``SUM_OF_POINTS`` for soft bodies and rods, whose points ``bvh.spread`` bounds.
        """
        pack, item, lane = wp.tid()
        frame = object_frame[item]
        extent = object_extent[item]
        centre = object_centre[item]
        speed = real(0.0)
        v = vec3()
        spin = real(0.0)
        if frame >= 0:
            half = extent
            x = frame_x(motion, pack, lane, frame)
            centre = x + turned(motion, pack, lane, frame, centre)
            if half[0] < real(FAR):
                e0 = turned(motion, pack, lane, frame, vec3(half[0], real(0.0), real(0.0)))
                e1 = turned(motion, pack, lane, frame, vec3(real(0.0), half[1], real(0.0)))
                e2 = turned(motion, pack, lane, frame, vec3(real(0.0), real(0.0), half[2]))
                for c in range(3):
                    extent[c] = wp.abs(e0[c]) + wp.abs(e1[c]) + wp.abs(e2[c])
                w = vec3(
                    motion.twist[pack, 6 * frame + 3, lane],
                    motion.twist[pack, 6 * frame + 4, lane],
                    motion.twist[pack, 6 * frame + 5, lane],
                )
                v = frame_v(motion, pack, lane, frame, centre)
                spin = wp.length(w) * wp.length(half)
                speed = wp.length(v) + spin
                if object_round[item] != 0:
                    spin = real(0.0)  # a ball's turning strikes nothing
            else:
                v = frame_v(motion, pack, lane, frame, x)
                speed = wp.length(v)
        if frame >= wp.static(WORLD):
            for c in range(3):
                box_out[pack, 7 * item + c, lane] = centre[c]
                box_out[pack, 7 * item + 3 + c, lane] = extent[c]
                velocity_out[pack, 6 * item + c, lane] = v[c] - spin
                velocity_out[pack, 6 * item + 3 + c, lane] = v[c] + spin
            box_out[pack, 7 * item + 6, lane] = speed

    @wp.kernel(module=module, enable_backward=False)
    def drift(
        # Model
        scene: Scene,
        object_point: wp.array2d(dtype=wp.int32),
        tracked: wp.array(dtype=wp.int32),
        parts: int,
        # Workspace in
        motion: Motion,
        # Workspace out
        before_out: wp.array3d(dtype=real),
        moved_out: wp.array3d(dtype=real),
    ):
        """Raise ``moved`` to the largest way [m] that a point of a tracked object has gone since the last call."""
        pack, item, lane = wp.tid()
        entity = tracked[item / parts]
        longest = real(0.0)
        for point in range(object_point[entity, 0] + item % parts, object_point[entity, 1], parts):
            node = scene.point_index[point]
            square = real(0.0)
            for c in range(3):
                x = motion.x[pack, 3 * node + c, lane]
                way = x - before_out[pack, 3 * point + c, lane]
                before_out[pack, 3 * point + c, lane] = x
                square += way * way
            if not square <= longest:
                longest = wp.where(square < real(FAR), square, real(FAR))  # from or to what is no number: far
        wp.atomic_max(moved_out, pack, entity, lane, wp.sqrt(longest))

    @wp.kernel(module=module, enable_backward=False)
    def couples(
        # Model
        scene: Scene,
        # Workspace in
        motion: Motion,
        box_in: wp.array3d(dtype=real),
        pair_distance_in: wp.array3d(dtype=real),
        pair_alarm_in: wp.array3d(dtype=real),
        slack: real,
        h: real,
        # Workspace out
        reach_out: wp.array3d(dtype=real),
    ):
        """Largest distance at which a contact of one couple can count [m], or -1 where its boxes are farther apart."""
        pack, item, lane = wp.tid()
        a = 7 * scene.couple[item, wp.static(CoupleColumn.OBJECT_A)]
        b = 7 * scene.couple[item, wp.static(CoupleColumn.OBJECT_B)]
        pair = scene.couple[item, wp.static(CoupleColumn.PAIR)]
        reach = wp.max(pair_alarm_in[pack, pair, lane], pair_distance_in[pack, pair, lane]) + slack
        reach += real(1.5) * h * (box_in[pack, a + 6, lane] + box_in[pack, b + 6, lane])
        if not is_near(scene, motion, box_in, pack, lane, item, reach):
            reach = real(-1.0)
        reach_out[pack, item, lane] = reach

    @wp.func
    def tangent(n: vec3):
        """A unit vector across n: the coordinate axis least along n, made orthogonal to it."""
        least = int(0)
        for c in range(1, 3):
            if wp.abs(n[c]) < wp.abs(n[least]):
                least = c
        e = vec3()
        e[least] = real(1.0)
        return wp.normalize(e - n[least] * n)

    @wp.func
    def used(pack: int, lane: int, count: wp.array3d(dtype=wp.int32), capacity: int):
        """Contacts up to which neutral values are read: on a CPU as many as some world of the pack has."""
        most = capacity
        if wp.static(not variant.world_fastest):
            most = count[pack, 0, lane]
            for other in range(count.shape[2]):
                most = wp.max(most, count[pack, 0, other])
        return most

    @wp.func
    def is_there(
        pack: int,
        lane: int,
        c: int,
        n: vec3,
        first: wp.array3d(dtype=wp.int32),
        key: wp.array3d(dtype=wp.int32),
        axes: wp.array3d(dtype=real),
    ):
        """Whether a contact from before the first new one has the key of contact c and nearly the normal n."""
        found = bool(False)
        for other in range(first[pack, 0, lane]):
            if key[pack, other, lane] == key[pack, c, lane]:
                normal = vec3(
                    axes[pack, 9 * other, lane], axes[pack, 9 * other + 1, lane], axes[pack, 9 * other + 2, lane]
                )
                found = found or wp.dot(normal, n) >= real(TURNED)
        return found

    @wp.kernel(module=module, enable_backward=False)
    def describe(
        # Model
        parts: int,
        # Workspace in
        first_in: wp.array3d(dtype=wp.int32),
        count_in: wp.array3d(dtype=wp.int32),
        key_in: wp.array3d(dtype=wp.int32),
        pair_in: wp.array3d(dtype=wp.int32),
        known_in: wp.array3d(dtype=wp.int32),
        known_force_in: wp.array3d(dtype=real),
        touch_in: wp.array3d(dtype=real),
        pair_distance_in: wp.array3d(dtype=real),
        pair_mu_in: wp.array3d(dtype=real),
        pair_restitution_in: wp.array3d(dtype=real),
        pair_compliance_in: wp.array3d(dtype=real),
        # Workspace out
        axes_out: wp.array3d(dtype=real),
        gap_out: wp.array3d(dtype=real),
        mu_out: wp.array3d(dtype=real),
        restitution_out: wp.array3d(dtype=real),
        compliance_out: wp.array3d(dtype=real),
        multiplier_out: wp.array3d(dtype=real),
    ):
        """Axes, gap, law and first guess of every ``parts``-th contact from the first on; neutral past the last one.

        A compliant contact that is late, of a feature that pushes along nearly the same normal already, is the same
        spring once more, as where a ball rolls on to the next face: it becomes a neutral one.
        """
        pack, item, lane = wp.tid()
        for c in range(first_in[pack, 0, lane] + item, used(pack, lane, count_in, gap_out.shape[1]), parts):
            n = vec3()
            t1 = vec3()
            t2 = vec3()
            force = vec3()
            gap = real(APART)
            mu = real(0.0)
            restitution = real(0.0)
            compliance = real(0.0)
            if c < count_in[pack, 0, lane]:
                row = c * wp.static(geometry.TOUCH_ROWS)
                for i in range(3):
                    n[i] = touch_in[pack, row + wp.static(NORMAL) + i, lane]
                t1 = tangent(n)
                t2 = wp.cross(n, t1)
                pair = pair_in[pack, c, lane]
                gap = touch_in[pack, row + wp.static(DISTANCE), lane] - pair_distance_in[pack, pair, lane]
                mu = pair_mu_in[pack, pair, lane]
                restitution = pair_restitution_in[pack, pair, lane]
                compliance = pair_compliance_in[pack, pair, lane]
                known = known_in[pack, c, lane]
                if known >= 0:
                    for i in range(3):
                        force[i] = known_force_in[pack, 3 * known + i, lane]
                if compliance > real(0.0) and is_there(pack, lane, c, n, first_in, key_in, axes_out):
                    n = vec3()
                    t1 = vec3()
                    t2 = vec3()
                    gap = real(APART)
                    mu = real(0.0)
                    restitution = real(0.0)
                    compliance = real(0.0)
            for i in range(3):
                axes_out[pack, 9 * c + i, lane] = n[i]
                axes_out[pack, 9 * c + 3 + i, lane] = t1[i]
                axes_out[pack, 9 * c + 6 + i, lane] = t2[i]
            multiplier_out[pack, 3 * c, lane] = wp.max(wp.dot(n, force), real(0.0))
            multiplier_out[pack, 3 * c + 1, lane] = wp.dot(t1, force)
            multiplier_out[pack, 3 * c + 2, lane] = wp.dot(t2, force)
            gap_out[pack, c, lane] = gap
            mu_out[pack, c, lane] = mu
            restitution_out[pack, c, lane] = restitution
            compliance_out[pack, c, lane] = compliance

    @wp.func
    def put(
        pack: int,
        lane: int,
        slot: int,
        dof: int,
        weight: real,
        lever: vec3,
        dof_out: wp.array3d(dtype=wp.int32),
        weight_out: wp.array3d(dtype=real),
        lever_out: wp.array3d(dtype=real),
    ):
        """Add to the slot of a dof, the first free one if it has none."""
        place = slot
        while dof_out[pack, place, lane] >= 0 and dof_out[pack, place, lane] != dof:
            place += 1
        dof_out[pack, place, lane] = dof
        weight_out[pack, place, lane] = weight_out[pack, place, lane] + weight
        for i in range(3):
            row = 3 * place + i
            lever_out[pack, row, lane] = lever_out[pack, row, lane] + lever[i]

    @wp.func
    def put_frame(
        pack: int,
        lane: int,
        slot: int,
        frame_dof: wp.array(dtype=wp.int32),
        frame_master: wp.array(dtype=wp.int32),
        frame: int,
        share: real,
        arm: vec3,
        dof_out: wp.array3d(dtype=wp.int32),
        weight_out: wp.array3d(dtype=real),
        lever_out: wp.array3d(dtype=real),
    ):
        """Translation with its weight, rotation with its lever: v = V + w x arm, arm from the master's origin."""
        none = vec3()
        if frame_dof[2 * frame] >= 0:
            put(pack, lane, slot, frame_dof[2 * frame], share, none, dof_out, weight_out, lever_out)
        if frame_dof[2 * frame + 1] >= 0:
            put(pack, lane, slot, frame_dof[2 * frame + 1], real(0.0), share * arm, dof_out, weight_out, lever_out)

    @wp.func
    def is_held(scene: Scene, node_frame: wp.array(dtype=wp.int32), node_count: int, point: int):
        """Whether a frame carries the point."""
        frame = int(0)
        if scene.point_kind[point] == wp.static(Carrier.NODE):
            frame = -1
            if scene.point_index[point] < node_count:
                frame = node_frame[scene.point_index[point]]
        return frame >= 0

    @wp.func
    def member(scene: Scene, couple: int, key: int, mark: int, k: int):
        """Point k of a contact, 0 and 1 of the feature, 2 to 4 of the target's face; -1 where there is none."""
        point = int(-1)
        if k < 2:
            width = scene.couple[couple, wp.static(CoupleColumn.WIDTH)]
            feature = scene.couple[couple, wp.static(CoupleColumn.FIRST)]
            feature += (key - scene.couple[couple, wp.static(CoupleColumn.KEY)]) / width
            if scene.couple[couple, wp.static(CoupleColumn.EDGES)] != 0:
                point = scene.edge_point[feature, k]
            elif k == 0:
                point = feature
        elif scene.target_kind[scene.couple[couple, wp.static(CoupleColumn.TARGET)]] > 6:
            point = scene.face_corner[mark / 3, k - 2]
        return point

    @wp.func
    def put_blend(
        pack: int,
        lane: int,
        slot: int,
        motion: Motion,
        frame_dof: wp.array(dtype=wp.int32),
        frame_master: wp.array(dtype=wp.int32),
        ends: wp.vec2i,
        s: real,
        length: real,
        share: real,
        away: vec3,
        dof_out: wp.array3d(dtype=wp.int32),
        weight_out: wp.array3d(dtype=real),
        lever_out: wp.array3d(dtype=real),
    ):
        """Both ends of a segment for a point at ``away`` from the frame blended between them at s."""
        r = real(1.0) - s
        none = vec3()
        for side in range(2):
            frame = ends[side]
            weight = (real(1.0) + real(2.0) * s) * r * r
            along = s * r * r * length
            turning = r
            if side == 1:
                weight = s * s * (real(3.0) - real(2.0) * s)
                along = -s * s * r * length
                turning = s
            tangent = turned(motion, pack, lane, frame, vec3(real(0.0), real(0.0), along))
            arm = weight * (frame_x(motion, pack, lane, frame) - frame_x(motion, pack, lane, frame_master[frame]))
            arm += tangent + turning * away
            put(pack, lane, slot, frame_dof[2 * frame], share * weight, none, dof_out, weight_out, lever_out)
            put(pack, lane, slot, frame_dof[2 * frame + 1], real(0.0), share * arm, dof_out, weight_out, lever_out)

    @wp.func
    def portion(pack: int, lane: int, row: int, k: int, single: bool, touch_in: wp.array3d(dtype=real)):
        """Weight of point k of a contact: 1 - s, s; then minus 1 - u - v, u, v."""
        s = touch_in[pack, row + wp.static(SHARE), lane]
        u = touch_in[pack, row + wp.static(BARY), lane]
        v = touch_in[pack, row + wp.static(BARY) + 1, lane]
        weight = -v
        if k == 0:
            weight = real(1.0) - s
            if single:
                weight = real(1.0)
        elif k == 1:
            weight = s
        elif k == 2:
            weight = u + v - real(1.0)
        elif k == 3:
            weight = -u
        return weight

    @wp.func
    def clear(
        pack: int,
        c: int,
        lane: int,
        point: wp.array3d(dtype=real),
        dof: wp.array3d(dtype=wp.int32),
        weight: wp.array3d(dtype=real),
        lever: wp.array3d(dtype=real),
    ):
        """A contact without a place and without dofs; slots behind the first empty one are as empty."""
        slot = c * wp.static(SLOTS)
        k = int(0)
        while k < wp.static(SLOTS):
            if dof[pack, slot + k, lane] == -1:
                break
            dof[pack, slot + k, lane] = -1
            weight[pack, slot + k, lane] = real(0.0)
            for i in range(3):
                lever[pack, 3 * (slot + k) + i, lane] = real(0.0)
            k += 1
        for i in range(3):
            point[pack, 3 * c + i, lane] = real(0.0)

    @wp.func
    def touch_vector(touch: wp.array3d(dtype=real), pack: int, row: int, lane: int):
        return vec3(touch[pack, row, lane], touch[pack, row + 1, lane], touch[pack, row + 2, lane])

    @wp.kernel(module=module, enable_backward=False)
    def slots(
        # Model
        scene: Scene,
        node_dof: wp.array(dtype=wp.int32),
        node_frame: wp.array(dtype=wp.int32),
        frame_dof: wp.array(dtype=wp.int32),
        frame_master: wp.array(dtype=wp.int32),
        frame_blend: wp.array(dtype=wp.int32),
        blend_ends: wp.array(dtype=wp.vec2i),
        blend_place: wp.array2d(dtype=real),
        node_count: int,
        carrier: wp.array2d(dtype=wp.int32),
        carrier_weight: wp.array2d(dtype=real),
        parts: int,
        # Workspace in
        motion: Motion,
        first_in: wp.array3d(dtype=wp.int32),
        count_in: wp.array3d(dtype=wp.int32),
        key_in: wp.array3d(dtype=wp.int32),
        couple_in: wp.array3d(dtype=wp.int32),
        face_in: wp.array3d(dtype=wp.int32),
        touch_in: wp.array3d(dtype=real),
        gap_in: wp.array3d(dtype=real),
        # Workspace out
        point_out: wp.array3d(dtype=real),
        dof_out: wp.array3d(dtype=wp.int32),
        weight_out: wp.array3d(dtype=real),
        lever_out: wp.array3d(dtype=real),
    ):
        """Points of every ``parts``-th contact from ``first`` on, dofs, weights and levers, merged by dof."""
        pack, item, lane = wp.tid()
        for c in range(first_in[pack, 0, lane] + item, used(pack, lane, count_in, face_in.shape[1]), parts):
            slot = c * wp.static(SLOTS)
            clear(pack, c, lane, point_out, dof_out, weight_out, lever_out)
            if c < count_in[pack, 0, lane] and gap_in[pack, c, lane] != real(APART):
                row = c * wp.static(geometry.TOUCH_ROWS)
                a = touch_vector(touch_in, pack, row + wp.static(POINT_A), lane)
                b = touch_vector(touch_in, pack, row + wp.static(POINT_B), lane)
                n = touch_vector(touch_in, pack, row + wp.static(NORMAL), lane)
                couple = couple_in[pack, c, lane]
                key = key_in[pack, c, lane]
                face = face_in[pack, c, lane]
                target = scene.couple[couple, wp.static(CoupleColumn.TARGET)]
                first = member(scene, couple, key, face, 0)
                single = scene.couple[couple, wp.static(CoupleColumn.EDGES)] == 0
                # forces of sides that touch act at one point p: where a soft side is, else between the surfaces; what
                # is still apart will touch with its own surface
                distance = touch_in[pack, row + wp.static(DISTANCE), lane]
                p = b + real(0.5) * distance * n
                if scene.point_kind[first] == wp.static(Carrier.NODE) and not is_held(
                    scene, node_frame, node_count, first
                ):
                    p = a
                elif scene.target_kind[target] == wp.static(Target.SOFT):
                    p = b
                for k in range(3):
                    point_out[pack, 3 * c + k, lane] = p[k]
                if distance > real(0.0):
                    p = b + distance * n
                # carriers of a side lie at the weighted mean of their places; what is beyond turns with them
                away = vec3()
                for k in range(5):
                    if k == 2 and distance > real(0.0):
                        p = b
                    if k == 0 or k == 2:
                        away = p
                        for j in range(k, wp.min(k + 2 + k / 2, 5)):
                            point = member(scene, couple, key, face, j)
                            if point >= 0:
                                part = wp.abs(portion(pack, lane, row, j, single, touch_in))
                                away -= part * carrier_x(scene, motion, pack, lane, point)
                    point = member(scene, couple, key, face, k)
                    if point >= 0:
                        share = portion(pack, lane, row, k, single, touch_in)
                        index = scene.point_index[point]
                        carriers = int(1)
                        if scene.point_kind[point] == wp.static(Carrier.NODE) and index >= node_count:
                            carriers = 4
                        for j in range(carriers):
                            part = share
                            node = index
                            frame = index
                            x = carrier_x(scene, motion, pack, lane, point)
                            if carriers > 1:
                                node = carrier[index - node_count, j]
                                part = share * carrier_weight[index - node_count, j]
                                x = node_x(motion, pack, lane, node)
                            if scene.point_kind[point] == wp.static(Carrier.NODE):
                                frame = node_frame[node]
                                if frame < 0 and node_dof[node] >= 0 and part != real(0.0):
                                    none = vec3()
                                    put(pack, lane, slot, node_dof[node], part, none, dof_out, weight_out, lever_out)
                            blend = int(-1)
                            if frame >= 0:
                                blend = frame_blend[frame]
                            if blend >= 0:
                                put_blend(
                                    pack,
                                    lane,
                                    slot,
                                    motion,
                                    frame_dof,
                                    frame_master,
                                    blend_ends[blend],
                                    blend_place[blend, 0],
                                    blend_place[blend, 1],
                                    part,
                                    away,
                                    dof_out,
                                    weight_out,
                                    lever_out,
                                )
                            elif frame >= 0:
                                arm = x + away - frame_x(motion, pack, lane, frame_master[frame])
                                put_frame(
                                    pack,
                                    lane,
                                    slot,
                                    frame_dof,
                                    frame_master,
                                    frame,
                                    part,
                                    arm,
                                    dof_out,
                                    weight_out,
                                    lever_out,
                                )
                frame = scene.target_frame[target]
                if frame >= 0 and scene.target_kind[target] <= wp.static(Target.GRID):
                    arm = p - frame_x(motion, pack, lane, frame_master[frame])
                    put_frame(
                        pack,
                        lane,
                        slot,
                        frame_dof,
                        frame_master,
                        frame,
                        real(-1.0),
                        arm,
                        dof_out,
                        weight_out,
                        lever_out,
                    )

    return SimpleNamespace(
        bounds=bounds,
        drift=drift,
        couples=couples,
        describe=describe,
        slots=slots,
        member=member,
        is_held=is_held,
    )
