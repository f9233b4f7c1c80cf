"""What is nearest to what in a touch, as functions that Warp differentiates. Theory: docs/theory/adjoint.md.

A *form* is the part of a target that is nearest: a plane through three points, a line through two, a point, or a ring
around the first point with the axis and the radius of the second. Its points move with nodes or with a frame, so
distance and normal are functions of points alone. Which form it is, is found by the functions of detection.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from softwarp.kernels.collision import box_edges, closest, faces, features, geometry, shape_touches, shapes
from softwarp.kernels.collision.closest import INSIDE, SIDE, VERTEX
from softwarp.kernels.collision.shape_touches import LEVEL, UNSURE
from softwarp.model.codes import FAR, FLAT, Carrier, CoupleColumn, Target

PLANE, LINE, POINT, RING = range(4)  # forms
# Ways to touch: a point or a fixed place of an edge, an edge at a kink or at what is round, two edges
NEAREST, KINK, ROUND, SIDES = range(4)


@cache
def structures(scalar: Any) -> SimpleNamespace:
    """Structs of one scalar type: ``Form``, ``Feature``, ``Meeting`` and ``Touch``."""
    real = scalar
    vec3 = wp.types.vector(3, real)

    @wp.struct
    class Form:
        kind: int  # PLANE, LINE, POINT or RING
        part: int  # of a triangle
        sign: real  # -1 behind a side or corner
        radius: real
        b0: vec3
        b1: vec3
        b2: vec3

    @wp.struct
    class Feature:
        way: int  # NEAREST, KINK, ROUND or SIDES
        a0: vec3
        a1: vec3  # a0 again for points, the tip of axis times radius for rims
        rim: int  # whether it is one, with a0 in its middle
        quarter: int  # turns of its point from the nearest one to a plane
        inset: vec3
        ball: real
        probe: real  # place along an edge where the distance is measured
        share: real  # and where it touches
        low: real  # brackets of a kink
        high: real

    @wp.struct
    class Meeting:
        feature: Feature
        form: Form
        second: Form  # of the feature's own place on a face, or behind a kink
        face: int  # of a soft surface, else -1
        has_foot: int  # whether ``second`` differs from ``form`` there
        c0: vec3  # corners of that face
        c1: vec3
        c2: vec3

    @wp.struct
    class Touch:  # or what a sum has by its parts
        n: vec3
        d: real
        a: vec3
        b: vec3
        s: real  # weight of an edge's second point
        u: real  # weights of a face's second and third corner
        v: real

    return SimpleNamespace(Form=Form, Feature=Feature, Meeting=Meeting, Touch=Touch)


@cache
def functions(scalar: Any) -> SimpleNamespace:
    """The touch of a meeting, and a weighted sum of its parts, whose gradient by all points ``wp.grad`` finds."""
    real = scalar
    vec3 = wp.types.vector(3, real)
    own = structures(real)
    Form, Feature, Meeting, Touch = own.Form, own.Feature, own.Meeting, own.Touch
    around_rim = features.functions(real).around_rim

    @wp.func
    def distance_to(form: Form, p: vec3):
        """Distance of p from the surface around a form, and the normal there."""
        n = vec3()
        d = real(0.0)
        if form.kind == wp.static(PLANE):
            n = wp.normalize(wp.cross(form.b1 - form.b0, form.b2 - form.b0))
            d = wp.dot(p - form.b0, n)
        else:
            away = p - form.b0
            e = form.b1 - form.b0
            if form.kind == wp.static(LINE):
                away = away - e * (wp.dot(away, e) / wp.dot(e, e))
            if form.kind == wp.static(RING):
                across = away - e * (wp.dot(away, e) / wp.dot(e, e))
                away = away - wp.normalize(across) * wp.length(e)
            length = wp.length(away)
            if length > real(0.0):
                n = away * (form.sign / length)
            d = form.sign * length
        return d - form.radius, n

    @wp.func
    def nearest(f: Feature, form: Form):
        """A point, or fixed places of an edge, and what is nearest to it; without weights."""
        touch = Touch()
        at = f.a0 + f.probe * (f.a1 - f.a0)
        a = f.a0 + f.share * (f.a1 - f.a0)
        if f.rim != 0:
            arm = f.a1 - f.a0
            radius = wp.length(arm)
            n = wp.normalize(wp.cross(form.b1 - form.b0, form.b2 - form.b0))
            at = f.a0 + radius * around_rim(f.quarter, arm / radius, n)
            a = at
        d, n = distance_to(form, at + f.inset)
        away = d - wp.dot(n, f.inset)
        touch.n = n
        touch.d = away - f.ball
        touch.a = a
        touch.b = a - away * n
        touch.s = f.share
        return touch

    @wp.func
    def weights_at(part: int, p: vec3, c0: vec3, c1: vec3, c2: vec3):
        """Weights u, v of a triangle's second and third corner in the point nearest to p, on a part of it."""
        u = real(0.0)
        v = real(0.0)
        if part == wp.static(INSIDE):
            e = c1 - c0
            f = c2 - c0
            n = wp.cross(e, f)
            u = wp.dot(wp.cross(p - c0, f), n) / wp.dot(n, n)
            v = wp.dot(wp.cross(e, p - c0), n) / wp.dot(n, n)
        elif part == wp.static(SIDE):
            u = wp.dot(p - c0, c1 - c0) / wp.dot(c1 - c0, c1 - c0)
        elif part == wp.static(SIDE + 1):
            v = wp.dot(p - c1, c2 - c1) / wp.dot(c2 - c1, c2 - c1)
            u = real(1.0) - v
        elif part == wp.static(SIDE + 2):
            v = wp.dot(p - c0, c2 - c0) / wp.dot(c2 - c0, c2 - c0)
        elif part == wp.static(VERTEX + 1):
            u = real(1.0)
        elif part == wp.static(VERTEX + 2):
            v = real(1.0)
        return u, v

    @wp.func
    def sides(f: Feature, form: Form):
        """Two edges."""
        touch = Touch()
        e = f.a1 - f.a0
        g = form.b1 - form.b0
        r = f.a0 - form.b0
        c = wp.cross(e, g)
        eg = wp.dot(e, g)
        s = (eg * wp.dot(g, r) - wp.dot(e, r) * wp.dot(g, g)) / wp.dot(c, c)
        t = (wp.dot(e, e) * wp.dot(g, r) - eg * wp.dot(e, r)) / wp.dot(c, c)
        n = wp.normalize(c) * form.sign
        a = f.a0 + s * e
        away = wp.dot(r, n) - form.radius
        touch.n = n
        touch.d = away - f.ball
        touch.a = a
        touch.b = a - away * n
        touch.s = s
        if form.part == wp.static(SIDE):
            touch.u = t
        elif form.part == wp.static(SIDE + 1):
            touch.u = real(1.0) - t
            touch.v = t
        else:
            touch.v = real(1.0) - t
        return touch

    @wp.func
    def kink(f: Feature, form: Form, second: Form):
        """An edge whose distance falls at ``low`` and rises at ``high``: the tangents meet between.

        As ``shape_touches.at_kink``.
        """
        touch = Touch()
        d = f.a1 - f.a0
        length = wp.length(d)
        level = real(wp.static(LEVEL))
        fa, na = distance_to(form, f.a0 + f.low * d + f.inset)
        fv, nv = distance_to(second, f.a0 + f.high * d + f.inset)
        sa = wp.min(wp.dot(na, d) / length, -level)
        sb = wp.max(wp.dot(nv, d) / length, level)
        mean = (na * sb - nv * sa) / (sb - sa)
        across = wp.length(mean)
        n = mean / across
        s = wp.clamp((fa - fv + (sb * f.high - sa * f.low) * length) / ((sb - sa) * length), f.low, f.high)
        lowest = wp.min(fa + sa * (s - f.low) * length, wp.min(fa, fv)) / across
        away = lowest - wp.dot(n, f.inset)
        a = f.a0 + s * d
        touch.n = n
        touch.d = away - f.ball
        touch.a = a
        touch.b = a - away * n
        touch.s = s
        return touch

    @wp.func
    def rounded(f: Feature, form: Form):
        """An edge whose distance from one round form falls at ``low`` and rises at ``high``.

        As ``shape_touches.level_place``.
        """
        touch = Touch()
        d = f.a1 - f.a0
        _fa, na = distance_to(form, f.a0 + f.low * d + f.inset)
        _fv, nv = distance_to(form, f.a0 + f.high * d + f.inset)
        across = wp.normalize(na * wp.dot(nv, d) - nv * wp.dot(na, d))
        before = wp.length(wp.cross(na, across)) * wp.dot(nv, across)
        behind = wp.length(wp.cross(nv, across)) * wp.dot(na, across)
        s = f.low + (f.high - f.low) * before / (before + behind)
        a = f.a0 + s * d
        least, n = distance_to(form, a + f.inset)
        away = least - wp.dot(n, f.inset)
        touch.n = n
        touch.d = away - f.ball
        touch.a = a
        touch.b = a - away * n
        touch.s = s
        return touch

    @wp.func
    def touch_of(m: Meeting):
        """The touch of a meeting."""
        touch = Touch()
        if m.feature.way == wp.static(NEAREST):
            touch = nearest(m.feature, m.form)
            if m.face >= 0:
                u, v = weights_at(m.second.part, touch.a, m.c0, m.c1, m.c2)
                touch.u = u
                touch.v = v
            if m.has_foot != 0:
                away, n = distance_to(m.second, m.feature.a0)
                touch.b = touch.a - away * n
        elif m.feature.way == wp.static(KINK):
            touch = kink(m.feature, m.form, m.second)
        elif m.feature.way == wp.static(ROUND):
            touch = rounded(m.feature, m.form)
        else:
            touch = sides(m.feature, m.form)
        return touch

    @wp.func
    def touch_sum(m: Meeting, by: Touch):
        """Sum of the parts of a touch with weights."""
        t = touch_of(m)
        total = wp.dot(by.n, t.n) + by.d * t.d + wp.dot(by.a, t.a) + wp.dot(by.b, t.b)
        return total + by.s * t.s + by.u * t.u + by.v * t.v

    return SimpleNamespace(touch_of=touch_of, touch_sum=touch_sum)


@cache
def finders(scalar: Any) -> SimpleNamespace:
    """Which forms the touch of a contact has, from where everything is."""
    real = scalar
    types = geometry.structures(real)
    vec3, vec4, Scene, Motion = types.vec3, types.vec4, types.Scene, types.Motion
    place, own = geometry.functions(real), features.functions(real)
    point_x, frame_x, frame_q, turned = place.point_x, place.frame_x, place.frame_q, place.turned
    target_x, target_q, target_of = place.target_x, place.target_q, place.target_of
    point_inset, edge_inset, around_rim = own.point_inset, own.edge_inset, own.around_rim
    shape = shapes.functions(real)
    to_local, to_world = shape.to_local, shape.to_world
    box_edge = box_edges.functions(real).box_edge
    point_triangle = closest.functions(real).point_triangle
    corner_x = faces.functions(real).corner_x
    search = shape_touches.functions(real)
    part_of, brackets_of = search.part_of, search.brackets_of
    touch_line, is_unsure = search.touch_line, search.is_unsure
    shape_distance = search.shape_distance
    own_types = structures(real)
    Form, Feature, Meeting = own_types.Form, own_types.Feature, own_types.Meeting

    @wp.func
    def across(n: vec3):
        """A vector across an axis n of a box or cylinder."""
        return vec3(n[1], n[2], n[0])

    @wp.func
    def of_box(size: vec3, p: vec3, form: Form):
        """The face, edge or corner of a box that is nearest to p."""
        corner = vec3()
        free = vec3()
        outside = int(0)
        face = int(0)
        for c in range(3):
            side = wp.where(p[c] < real(0.0), real(-1.0), real(1.0))
            corner[c] = real(0.5) * side * size[c]
            excess = wp.abs(p[c]) - real(0.5) * size[c]
            if excess > real(0.0):
                outside += 1
            else:
                free[c] = real(1.0)
            if excess >= wp.abs(p[face]) - real(0.5) * size[face]:
                face = c
        form.b0 = corner
        if outside <= 1:
            n = vec3()
            n[face] = wp.where(p[face] < real(0.0), real(-1.0), real(1.0))
            form.kind = wp.static(PLANE)
            form.b1 = corner + across(n)
            form.b2 = corner + wp.cross(n, across(n))
        elif outside == 2:
            form.kind = wp.static(LINE)
            form.b1 = corner + free
        return form

    @wp.func
    def of_cylinder(size: vec3, p: vec3, form: Form):
        """The cap, mantle or rim of a cylinder that is nearest to p."""
        a = wp.sqrt(p[0] * p[0] + p[1] * p[1]) - size[0]
        b = wp.abs(p[2]) - real(0.5) * size[1]
        n = vec3(real(0.0), real(0.0), wp.where(p[2] < real(0.0), real(-1.0), real(1.0)))
        middle = n * (real(0.5) * size[1])
        if a > real(0.0) and b > real(0.0):
            form.kind = wp.static(RING)
            form.b0 = middle
            form.b1 = middle + n * size[0]
        elif b >= a:
            form.kind = wp.static(PLANE)
            form.b0 = middle
            form.b1 = middle + across(n)
            form.b2 = middle + wp.cross(n, across(n))
        else:
            form.kind = wp.static(LINE)
            form.radius = size[0]
            form.b1 = n
        return form

    @wp.func
    def of_shape(scene: Scene, target: int, x: vec3, q: vec4, at: vec3):
        """Form of a shape at the pose (x, q) that is nearest to a place."""
        kind = scene.target_kind[target]
        size = scene.target_size[target]
        p = to_local(x, q, at)
        form = Form()
        form.kind = wp.static(POINT)
        form.sign = real(1.0)
        up = vec3(real(0.0), real(0.0), real(1.0))
        if kind == wp.static(Target.PLANE):
            form.kind = wp.static(PLANE)
            form.b1 = across(up)
            form.b2 = wp.cross(up, across(up))
        elif kind == wp.static(Target.SPHERE):
            form.radius = size[0]
        elif kind == wp.static(Target.CAPSULE):
            half = real(0.5) * size[1]
            form.radius = size[0]
            if wp.abs(p[2]) < half:
                form.kind = wp.static(LINE)
                form.b1 = up
            else:
                form.b0 = up * wp.clamp(p[2], -half, half)
        elif kind == wp.static(Target.BOX):
            form = of_box(size, p, form)
        elif kind == wp.static(Target.CYLINDER):
            form = of_cylinder(size, p, form)
        form.b0 = to_world(x, q, form.b0)
        form.b1 = to_world(x, q, form.b1)
        form.b2 = to_world(x, q, form.b2)
        return form

    @wp.func
    def corner_at(scene: Scene, motion: Motion, pack: int, lane: int, target: int, point: int):
        """Corner of a face in world axes."""
        x = corner_x(scene, motion, pack, lane, target, point)
        if scene.target_kind[target] == wp.static(Target.MESH):
            frame = scene.target_frame[target]
            x = to_world(frame_x(motion, pack, lane, frame), frame_q(motion, pack, lane, frame), x)
        return x

    @wp.func
    def of_face(scene: Scene, motion: Motion, pack: int, lane: int, target: int, face: int, p: vec3, n: vec3):
        """Form of a triangle that is nearest to p, whose normal is n if it is a side or a corner."""
        form = Form()
        form.sign = real(1.0)
        form.radius = scene.face_radius[face]
        a = corner_at(scene, motion, pack, lane, target, scene.face_corner[face, 0])
        b = corner_at(scene, motion, pack, lane, target, scene.face_corner[face, 1])
        c = corner_at(scene, motion, pack, lane, target, scene.face_corner[face, 2])
        u, v, part = point_triangle(p, a, b, c)
        form.part = part
        form.b0 = a
        form.b1 = b
        form.b2 = c
        if part != wp.static(INSIDE):
            form.kind = wp.static(LINE)
            first = part - wp.static(SIDE)
            if part >= wp.static(VERTEX):
                form.kind = wp.static(POINT)
                first = part - wp.static(VERTEX)
            if first == 1:
                form.b0 = b
                form.b1 = c
            elif first == 2:
                form.b0 = c
                form.b1 = a
            if wp.dot(p - a - u * (b - a) - v * (c - a), n) < real(0.0):
                form.sign = real(-1.0)
        return form

    @wp.func
    def plane_of(scene: Scene, motion: Motion, pack: int, lane: int, target: int, face: int):
        """Form of the plane of a triangle."""
        form = Form()
        form.sign = real(1.0)
        form.radius = scene.face_radius[face]
        form.b0 = corner_at(scene, motion, pack, lane, target, scene.face_corner[face, 0])
        form.b1 = corner_at(scene, motion, pack, lane, target, scene.face_corner[face, 1])
        form.b2 = corner_at(scene, motion, pack, lane, target, scene.face_corner[face, 2])
        return form

    @wp.func
    def point_on_shape(scene: Scene, motion: Motion, pack: int, lane: int, point: int, target: int):
        """A point that touches a shape; as ``shape_touches.touch_point``."""
        x = target_x(scene, motion, pack, lane, target)
        q = target_q(scene, motion, pack, lane, target)
        found = Feature()
        found.a0 = point_x(scene, motion, pack, lane, point)
        found.a1 = found.a0
        found.ball = scene.point_radius[point]
        kind = scene.target_kind[target]
        if kind == wp.static(Target.BOX) or kind == wp.static(Target.CYLINDER):
            d, n, _region = shape_distance(scene, target, x, q, found.a0)
            if d < real(UNSURE) * wp.length(scene.point_inset[point]):
                found.inset = point_inset(scene, motion, pack, lane, point, found.a0)
        return found, of_shape(scene, target, x, q, found.a0 + found.inset)

    @wp.func
    def edge_on_shape(scene: Scene, motion: Motion, pack: int, lane: int, edge: int, target: int, side: int):
        """An edge that touches a shape, with its form before and behind; as ``shape_touches.touch_edge``."""
        x = target_x(scene, motion, pack, lane, target)
        q = target_q(scene, motion, pack, lane, target)
        found = Feature()
        found.a0 = point_x(scene, motion, pack, lane, scene.edge_point[edge, 0])
        found.a1 = point_x(scene, motion, pack, lane, scene.edge_point[edge, 1])
        found.ball = scene.edge_radius[edge]
        d = found.a1 - found.a0
        kind = scene.target_kind[target]
        near = real(0.0)
        if kind == wp.static(Target.BOX) or kind == wp.static(Target.CYLINDER):
            near = real(UNSURE) * wp.length(scene.edge_inset[edge])
        none = vec3()
        far = real(FAR)
        low, high = part_of(scene, target, x, q, found.a0, d, found.ball, far, far)
        brackets = brackets_of(scene, target, x, q, found.a0, d, found.ball, far, far, low, high)
        touch = touch_line(brackets, found.a0, d, none, found.ball, side)
        found.share = touch.share
        found.probe = touch.share
        level = touch.region & wp.static(FLAT)
        if is_unsure(touch, near):
            found.inset = edge_inset(scene, motion, pack, lane, edge)
            brackets = brackets_of(
                scene, target, x, q, found.a0 + found.inset, d, found.ball, near, far, real(0.0), real(1.0)
            )
            other = touch_line(brackets, found.a0, d, found.inset, found.ball, side)
            if (other.region & level) == 0 or wp.length(other.a - touch.a) >= near:
                found.share = other.share
            found.probe = other.share
            level = other.region & wp.static(FLAT)
        found.way = wp.static(NEAREST)
        before = of_shape(scene, target, x, q, found.a0 + found.probe * d + found.inset)
        behind = before
        if level == 0:
            found.way = wp.static(KINK)
            found.low = brackets.a.t
            found.high = brackets.v.t
            before = of_shape(scene, target, x, q, found.a0 + found.low * d + found.inset)
            behind = of_shape(scene, target, x, q, found.a0 + found.high * d + found.inset)
            if brackets.lowest.t >= real(0.0):
                found.way = wp.static(ROUND)
        return found, before, behind

    @wp.func
    def point_on_face(scene: Scene, motion: Motion, pack: int, lane: int, point: int, target: int, mark: int, n: vec3):
        """A point that touches a face, whose normal is that at its inset and whose place is its own foot."""
        found = Feature()
        found.a0 = point_x(scene, motion, pack, lane, point)
        found.a1 = found.a0
        found.ball = scene.point_radius[point]
        is_rim = scene.point_kind[point] == wp.static(Carrier.RIM)
        at = found.a0
        if is_rim:
            arm = turned(motion, pack, lane, scene.point_index[point], scene.point_axis[point])
            found.rim = 1
            found.quarter = scene.point_quarter[point]
            found.a1 = found.a0 + arm
            at = found.a0 + wp.length(arm) * around_rim(found.quarter, arm / wp.length(arm), n)
        elif mark % 3 == 1:
            found.inset = point_inset(scene, motion, pack, lane, point, found.a0)
        form = of_face(scene, motion, pack, lane, target, mark / 3, at + found.inset, n)
        foot = form
        if is_rim:
            form = plane_of(scene, motion, pack, lane, target, mark / 3)
        elif mark % 3 == 1 and scene.target_kind[target] == wp.static(Target.SOFT):
            foot = of_face(scene, motion, pack, lane, target, mark / 3, found.a0, n)
        return found, form, foot

    @wp.func
    def edges_across(scene: Scene, motion: Motion, pack: int, lane: int, edge: int, b0: vec3, b1: vec3, n: vec3):
        """An edge that touches another one, from b0 to b1, with the normal n across both."""
        found = Feature()
        found.way = wp.static(SIDES)
        found.a0 = point_x(scene, motion, pack, lane, scene.edge_point[edge, 0])
        found.a1 = point_x(scene, motion, pack, lane, scene.edge_point[edge, 1])
        found.ball = scene.edge_radius[edge]
        form = Form()
        form.part = wp.static(SIDE)
        form.b0 = b0
        form.b1 = b1
        form.sign = wp.where(wp.dot(wp.cross(found.a1 - found.a0, b1 - b0), n) < real(0.0), real(-1.0), real(1.0))
        return found, form

    @wp.func
    def edge_on_side(scene: Scene, motion: Motion, pack: int, lane: int, edge: int, target: int, mark: int, n: vec3):
        """An edge that touches a side of a face."""
        b0 = corner_at(scene, motion, pack, lane, target, scene.face_corner[mark / 3, mark % 3])
        b1 = corner_at(scene, motion, pack, lane, target, scene.face_corner[mark / 3, (mark % 3 + 1) % 3])
        found, form = edges_across(scene, motion, pack, lane, edge, b0, b1, n)
        form.radius = scene.face_radius[mark / 3]
        form.part = wp.static(SIDE) + mark % 3
        return found, form

    @wp.func
    def edge_on_box(scene: Scene, motion: Motion, pack: int, lane: int, edge: int, target: int, mark: int, n: vec3):
        """An edge that touches an edge of a box."""
        x = target_x(scene, motion, pack, lane, target)
        q = target_q(scene, motion, pack, lane, target)
        start, way, _outward = box_edge(scene.target_size[target], mark - 1)
        return edges_across(scene, motion, pack, lane, edge, to_world(x, q, start), to_world(x, q, start + way), n)

    @wp.func
    def meeting_of(scene: Scene, motion: Motion, pack: int, lane: int, couple: int, key: int, mark: int, n: vec3):
        """What meets in a contact with the normal n, of its key and its mark."""
        found = Meeting()
        target = target_of(scene, motion, pack, lane, couple)
        kind = scene.target_kind[target]
        offset = key - scene.couple[couple, wp.static(CoupleColumn.KEY)]
        width = scene.couple[couple, wp.static(CoupleColumn.WIDTH)]
        feature = scene.couple[couple, wp.static(CoupleColumn.FIRST)] + offset / width
        is_edge = scene.couple[couple, wp.static(CoupleColumn.EDGES)] != 0
        found.face = -1
        if kind == wp.static(Target.SOFT) or kind == wp.static(Target.MESH):
            if kind == wp.static(Target.SOFT):
                face = mark / 3
                found.face = face
                found.c0 = corner_at(scene, motion, pack, lane, target, scene.face_corner[face, 0])
                found.c1 = corner_at(scene, motion, pack, lane, target, scene.face_corner[face, 1])
                found.c2 = corner_at(scene, motion, pack, lane, target, scene.face_corner[face, 2])
            if is_edge:
                own, form = edge_on_side(scene, motion, pack, lane, feature, target, mark, n)
                found.feature = own
                found.form = form
                found.second = form
            else:
                own, form, foot = point_on_face(scene, motion, pack, lane, feature, target, mark, n)
                found.feature = own
                found.form = form
                found.second = foot
                if found.face >= 0 and mark % 3 == 1 and own.rim == 0:
                    found.has_foot = 1
        elif is_edge and mark > 0 and kind == wp.static(Target.BOX):
            own, form = edge_on_box(scene, motion, pack, lane, feature, target, mark, n)
            found.feature = own
            found.form = form
            found.second = form
        elif is_edge:
            own, form, behind = edge_on_shape(scene, motion, pack, lane, feature, target, offset % width)
            found.feature = own
            found.form = form
            found.second = behind
        else:
            own, form = point_on_shape(scene, motion, pack, lane, feature, target)
            found.feature = own
            found.form = form
            found.second = form
        return found

    return SimpleNamespace(meeting_of=meeting_of)
