"""Narrow phase against shapes: which points and edges of near couples touch, and how. Theory: docs/theory/collision.md.

``find`` marks keys, ``measure`` computes the geometry of those that became contacts; both call the same functions.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from softwarp.kernels import contact_scene, shapes
from softwarp.kernels.contact_scene import (
    BARY,
    CORNER,
    DISTANCE,
    EDGE,
    EDGES,
    FACE,
    FIRST,
    FLAT,
    FRAME,
    GRID,
    KEY,
    MASK,
    NODE,
    NORMAL,
    PAIR,
    POINT_A,
    POINT_B,
    RIM,
    SHARE,
    TARGET,
    TOUCH_ROWS,
    WIDTH,
)
from softwarp.kernels.lanes import Variant

BISECTIONS = 12  # halvings of an edge
LEVEL = 1.0e-3  # slope of the distance along an edge up to which it counts as parallel
STRETCH = 0.05  # part of an edge that must run parallel for the two ends of that part to be told apart
ALIGNED = 1.0e-3  # component of a normal up to which it counts as zero
UNSURE = 2.0  # times the inset: distance below which the normal of a corner is taken at its inset
MARGIN = 1.5  # times the way of a step that is looked ahead


@cache
def functions(scalar: Any) -> SimpleNamespace:
    """Distance of points and edges from shapes, in world coordinates."""
    real = scalar
    types = contact_scene.structures(real)
    vec3, vec4 = types.vec3, types.vec4
    Scene, Motion, Touch = types.Scene, types.Motion, types.Touch
    place = contact_scene.functions(real)
    point_x, point_v, frame_v, turned = place.point_x, place.point_v, place.frame_v, place.turned
    shape = shapes.functions(real)
    to_local, rotate, primitive, grid = shape.to_local, shape.rotate, shape.distance, shape.grid

    @wp.func
    def region_of(kind: int, size: vec3, p: vec3, n: vec3):
        """Which part of a shape is nearest to p, from the normal there: CORNER, EDGE or FACE."""
        region = int(FACE)
        if kind == 2:  # capsule: its axis is an edge, the ends of the axis are corners
            region = int(EDGE)
            if wp.abs(p[2]) >= real(0.5) * size[1]:
                region = int(CORNER)
        elif kind == 3:  # box
            zeros = int(0)
            for c in range(3):
                if wp.abs(n[c]) < real(ALIGNED):
                    zeros += 1
            if zeros == 1:
                region = int(EDGE)
            elif zeros == 0:
                region = int(CORNER)
        elif kind == 4:  # cylinder: caps are faces, the mantle is an edge (its axis, rounded), rims are corners
            if wp.abs(n[2]) < real(ALIGNED):
                region = int(EDGE)
            elif wp.abs(n[2]) < real(1.0) - real(ALIGNED):
                region = int(CORNER)
        return region

    @wp.func
    def shape_distance(scene: Scene, target: int, x: vec3, q: vec4, p: vec3):
        """Signed distance of p from a shape at the pose (x, q), normal in world axes, region."""
        kind = scene.target_kind[target]
        size = scene.target_size[target]
        local = to_local(x, q, p)
        d = real(0.0)
        n = vec3()
        if kind == wp.static(GRID):
            nodes = wp.vec3i(scene.target_grid[target, 1], scene.target_grid[target, 2], scene.target_grid[target, 3])
            d, n = grid(
                scene.grid_value,
                scene.target_grid[target, 0],
                nodes,
                scene.grid_origin[target],
                scene.grid_spacing[target],
                local,
            )
        else:
            d, n = primitive(kind, size, local)
        return d, rotate(q, n), region_of(kind, size, local, n)

    @wp.func
    def fan_normal(scene: Scene, motion: Motion, pack: int, lane: int, point: int):
        """Unit normal of a soft surface at one of its points: the mean of the triangles around it, by area."""
        n = vec3()
        for k in range(scene.fan_start[point], scene.fan_start[point + 1]):
            face = scene.fan[k]
            a = point_x(scene, motion, pack, lane, scene.face_corner[face, 0])
            b = point_x(scene, motion, pack, lane, scene.face_corner[face, 1])
            c = point_x(scene, motion, pack, lane, scene.face_corner[face, 2])
            n += wp.cross(b - a, c - a)
        return wp.normalize(n)

    @wp.func
    def point_inset(scene: Scene, motion: Motion, pack: int, lane: int, point: int):
        """From a corner to a place a little inside its body, where the nearest face is the one that it meets."""
        inset = scene.point_inset[point]
        if scene.point_kind[point] == wp.static(FRAME):
            inset = turned(motion, pack, lane, scene.point_index[point], inset)
        elif scene.point_kind[point] == wp.static(NODE) and inset[0] > real(0.0):
            inset = -inset[0] * fan_normal(scene, motion, pack, lane, point)
        return inset

    @wp.func
    def around_rim(quarter: int, axis: vec3, n: vec3):
        """Unit vector from the middle of a rim to its point nearest to a plane of normal n, turned by quarters."""
        e = wp.dot(n, axis) * axis - n
        least = int(0)
        for c in range(1, 3):
            if wp.abs(axis[c]) < wp.abs(axis[least]):
                least = c
        other = vec3()
        other[least] = real(1.0)
        other -= axis[least] * axis
        if wp.dot(e, e) < real(1.0e-8):
            e = other
        e = wp.normalize(e)
        f = wp.cross(axis, e)
        if quarter == 1:
            e = f
        elif quarter == 2:
            e = -e
        elif quarter == 3:
            e = -f
        return e

    @wp.func
    def touch_point(scene: Scene, motion: Motion, pack: int, lane: int, point: int, target: int, x: vec3, q: vec4):
        """One point against one shape. Close to boxes and cylinders the normal is that at the inset point."""
        touch = Touch()
        a = point_x(scene, motion, pack, lane, point)
        d, n, region = shape_distance(scene, target, x, q, a)
        inset = vec3()
        kind = scene.target_kind[target]
        if scene.point_kind[point] == wp.static(RIM):
            frame = scene.point_index[point]
            arm = turned(motion, pack, lane, frame, scene.point_axis[point])
            radius = wp.length(arm)
            e = around_rim(scene.point_quarter[point], arm / radius, n)
            a += radius * e
            depth = scene.point_inset[point]
            inset = turned(motion, pack, lane, frame, depth) - wp.length(depth) * e
            d, n, region = shape_distance(scene, target, x, q, a)
        is_close = (kind == 3 or kind == 4) and d < real(UNSURE) * wp.length(scene.point_inset[point])
        if is_close:
            if scene.point_kind[point] != wp.static(RIM):
                inset = point_inset(scene, motion, pack, lane, point)
            d, n, region = shape_distance(scene, target, x, q, a + inset)
            d -= wp.dot(n, inset)
        touch.distance = d - scene.point_radius[point]
        touch.normal = n
        touch.a = a
        touch.b = a - d * n
        touch.region = region
        return touch

    @wp.func
    def edge_end(
        scene: Scene, target: int, x: vec3, q: vec4, o: vec3, d: vec3, inverse: real, sign: real, low: real, high: real
    ):
        """Halve [low, high]: at low the distance falls (sign 1) or is level, at high it no longer falls, or rises.

        Sign 1 finds where it stops to fall, sign -1 where it begins to rise, seen from below and from above.
        """
        a = low
        b = high
        for k in range(wp.static(BISECTIONS)):
            t = real(0.5) * (a + b)
            f, n, region = shape_distance(scene, target, x, q, o + t * d)
            if wp.dot(n, d) * inverse < -sign * real(LEVEL):
                a = t
            else:
                b = t
        return a, b

    @wp.func
    def touch_line(
        scene: Scene,
        motion: Motion,
        pack: int,
        lane: int,
        edge: int,
        target: int,
        x: vec3,
        q: vec4,
        side: int,
        inset: vec3,
    ):
        """One edge, searched along a line moved by ``inset``; distance 1e15 without a minimum between the ends.

        The distance of a convex shape is convex along the edge. Where its lowest part is level, both ends of this part
        touch, one for each ``side``. Where it has a kink, the normal is across edge and kink.
        """
        touch = Touch()
        touch.distance = real(1.0e15)
        p0 = point_x(scene, motion, pack, lane, scene.edge_point[edge, 0])
        d = point_x(scene, motion, pack, lane, scene.edge_point[edge, 1]) - p0
        length = wp.length(d)
        radius = scene.edge_radius[edge]
        if length > real(0.0):
            inverse = real(1.0) / length
            o = p0 + inset
            f, n0, region = shape_distance(scene, target, x, q, o)
            f1, n1, r1 = shape_distance(scene, target, x, q, o + d)
            n = n0
            s0 = wp.dot(n0, d) * inverse
            s1 = wp.dot(n1, d) * inverse
            falls = s0 < -real(LEVEL)
            rises = s1 > real(LEVEL)
            stop_a = real(0.0)
            stop_b = real(0.0)
            rise_a = real(1.0)
            rise_b = real(1.0)
            if falls and s1 >= -real(LEVEL):
                stop_a, stop_b = edge_end(scene, target, x, q, o, d, inverse, real(1.0), real(0.0), real(1.0))
            if rises and s0 <= real(LEVEL):
                rise_a, rise_b = edge_end(scene, target, x, q, o, d, inverse, real(-1.0), stop_a, real(1.0))
            t = real(-1.0)
            if rise_a - stop_b > real(STRETCH):
                if side == 0 and stop_b > real(0.0):
                    t = stop_b
                elif side == 1 and rise_a < real(1.0):
                    t = rise_a
                if t > real(0.0):
                    f, n, region = shape_distance(scene, target, x, q, o + t * d)
                    region = region | wp.static(FLAT)
            elif side == 0 and falls and rises:
                fa, na, ra = shape_distance(scene, target, x, q, o + stop_a * d)
                fb, nb, rb = shape_distance(scene, target, x, q, o + rise_b * d)
                sa = wp.min(wp.dot(na, d) * inverse, -real(LEVEL))
                sb = wp.max(wp.dot(nb, d) * inverse, real(LEVEL))
                n = (sb * na - sa * nb) / (sb - sa)
                across = wp.length(n)
                if across > real(0.1):
                    n = n / across
                    t = (fa - fb + (sb * rise_b - sa * stop_a) * length) / ((sb - sa) * length)
                    t = wp.clamp(t, stop_a, rise_b)
                    f = wp.min(fa + sa * (t - stop_a) * length, wp.min(fa, fb)) / across
                    region = ra
            if t > real(0.0) and t < real(1.0):
                f -= wp.dot(n, inset)
                touch.distance = f - radius
                touch.normal = n
                touch.a = p0 + t * d
                touch.b = touch.a - f * n
                touch.share = t
                touch.region = region
        return touch

    @wp.func
    def edge_inset(scene: Scene, motion: Motion, pack: int, lane: int, edge: int, target: int):
        """From an edge to a line a little inside its body; 0 for round edges and round targets."""
        inset = vec3()
        kind = scene.target_kind[target]
        if kind == 3 or kind == 4:
            point = scene.edge_point[edge, 0]
            inset = scene.edge_inset[edge]
            if scene.point_kind[point] == wp.static(NODE):
                depth = inset[0]
                inset = vec3()
                if depth > real(0.0):
                    for k in range(2):
                        face = scene.edge_face[edge, k]
                        if face >= 0:
                            a = point_x(scene, motion, pack, lane, scene.face_corner[face, 0])
                            b = point_x(scene, motion, pack, lane, scene.face_corner[face, 1])
                            c = point_x(scene, motion, pack, lane, scene.face_corner[face, 2])
                            inset -= wp.normalize(wp.cross(b - a, c - a))
                    inset = depth * wp.normalize(inset)
            else:
                inset = turned(motion, pack, lane, scene.point_index[point], inset)
        return inset

    @wp.func
    def touch_edge(
        scene: Scene,
        motion: Motion,
        pack: int,
        lane: int,
        edge: int,
        target: int,
        x: vec3,
        q: vec4,
        side: int,
        reach: real,
    ):
        """One edge against one shape; close to it, normals are those at the inset edge."""
        touch = Touch()
        touch.distance = real(1.0e15)
        half = real(0.5)
        p0 = point_x(scene, motion, pack, lane, scene.edge_point[edge, 0])
        p1 = point_x(scene, motion, pack, lane, scene.edge_point[edge, 1])
        f, n, region = shape_distance(scene, target, x, q, half * (p0 + p1))
        if f - half * wp.length(p1 - p0) - scene.edge_radius[edge] < reach:
            none = vec3()
            inset = edge_inset(scene, motion, pack, lane, edge, target)
            touch = touch_line(scene, motion, pack, lane, edge, target, x, q, side, inset)
            if touch.distance < real(1.0e14) and wp.dot(inset, inset) > real(0.0):
                near = real(UNSURE) * wp.length(inset)
                other = touch_line(scene, motion, pack, lane, edge, target, x, q, side, none)
                if touch.distance > near:
                    touch = other
                elif (touch.region & other.region & wp.static(FLAT)) != 0 and wp.length(other.a - touch.a) < near:
                    shift = other.a - touch.a  # the place of the true edge, the normal of the inset one
                    touch.a = other.a
                    touch.b = touch.b + shift
                    touch.share = other.share
        return touch

    @wp.func
    def touch_shape(
        scene: Scene, motion: Motion, pack: int, lane: int, couple: int, key: int, x: vec3, q: vec4, reach: real
    ):
        """The feature of a key against its shape."""
        touch = Touch()
        width = scene.couple[couple, wp.static(WIDTH)]
        offset = key - scene.couple[couple, wp.static(KEY)]
        feature = scene.couple[couple, wp.static(FIRST)] + offset / width
        target = scene.couple[couple, wp.static(TARGET)]
        if scene.couple[couple, wp.static(EDGES)] != 0:
            touch = touch_edge(scene, motion, pack, lane, feature, target, x, q, offset % width, reach)
        else:
            touch = touch_point(scene, motion, pack, lane, feature, target, x, q)
        return touch

    @wp.func
    def feature_v(scene: Scene, motion: Motion, pack: int, lane: int, couple: int, key: int, a: vec3, share: real):
        """Velocity of the feature of a key at a."""
        width = scene.couple[couple, wp.static(WIDTH)]
        feature = scene.couple[couple, wp.static(FIRST)] + (key - scene.couple[couple, wp.static(KEY)]) / width
        v = vec3()
        if scene.couple[couple, wp.static(EDGES)] != 0:
            v = (real(1.0) - share) * point_v(scene, motion, pack, lane, scene.edge_point[feature, 0], a)
            v += share * point_v(scene, motion, pack, lane, scene.edge_point[feature, 1], a)
        else:
            v = point_v(scene, motion, pack, lane, feature, a)
        return v

    return SimpleNamespace(
        touch_shape=touch_shape,
        feature_v=feature_v,
        point_inset=point_inset,
        around_rim=around_rim,
        frame_v=frame_v,
    )


@cache
def writer(scalar: Any) -> SimpleNamespace:
    """A touch into the rows of its contact."""
    real = scalar
    types = contact_scene.structures(real)
    Touch = types.Touch

    @wp.func
    def write_touch(pack: int, c: int, lane: int, touch: Touch, touch_out: wp.array3d(dtype=real)):
        """Store a touch."""
        row = c * wp.static(TOUCH_ROWS)
        for k in range(3):
            touch_out[pack, row + wp.static(NORMAL) + k, lane] = touch.normal[k]
            touch_out[pack, row + wp.static(POINT_A) + k, lane] = touch.a[k]
            touch_out[pack, row + wp.static(POINT_B) + k, lane] = touch.b[k]
        touch_out[pack, row + wp.static(DISTANCE), lane] = touch.distance
        touch_out[pack, row + wp.static(SHARE), lane] = touch.share
        touch_out[pack, row + wp.static(BARY), lane] = touch.u
        touch_out[pack, row + wp.static(BARY) + 1, lane] = touch.v

    return SimpleNamespace(write_touch=write_touch)


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Search and measurement of one variant, on single worlds."""
    real = variant.real
    module = variant.module("proximity")
    types = contact_scene.structures(real)
    Scene, Motion = types.Scene, types.Motion
    place = contact_scene.functions(real)
    target_x, target_q = place.target_x, place.target_q
    near = functions(real)
    touch_shape, feature_v, frame_v = near.touch_shape, near.feature_v, near.frame_v
    write_touch = writer(real).write_touch

    @wp.kernel(module=module, enable_backward=False)
    def find(
        # Model
        scene: Scene,
        chunk_list: wp.array(dtype=wp.int32),
        chunk_key: wp.array(dtype=wp.int32),
        chunk_couple: wp.array(dtype=wp.int32),
        # Workspace in
        motion: Motion,
        reach_in: wp.array3d(dtype=real),
        pair_distance_in: wp.array3d(dtype=real),
        pair_alarm_in: wp.array3d(dtype=real),
        slack: real,
        h: real,
        # Workspace out
        chunk_hits_out: wp.array3d(dtype=wp.int32),
        hit_out: wp.array3d(dtype=wp.int32),
    ):
        """Mark the keys of one chunk that touch their shape: 0, else -1. Chunks of far couples are not entered."""
        pack, item, lane = wp.tid()
        chunk = chunk_list[item]
        couple = chunk_couple[chunk]
        reach = reach_in[pack, couple, lane]
        hits = int(0)
        if reach >= real(0.0):
            target = scene.couple[couple, wp.static(TARGET)]
            pair = scene.couple[couple, wp.static(PAIR)]
            mask = scene.couple[couple, wp.static(MASK)]
            x = target_x(scene, motion, pack, lane, target)
            q = target_q(scene, motion, pack, lane, target)
            limit = wp.max(pair_distance_in[pack, pair, lane], pair_alarm_in[pack, pair, lane]) + slack
            for key in range(chunk_key[chunk], chunk_key[chunk + 1]):
                touch = touch_shape(scene, motion, pack, lane, couple, key, x, q, reach)
                hit = int(-1)
                if touch.distance <= reach and (touch.region & mask) == touch.region:
                    v = feature_v(scene, motion, pack, lane, couple, key, touch.a, touch.share)
                    v -= frame_v(motion, pack, lane, scene.target_frame[target], touch.b)
                    if touch.distance <= limit + real(MARGIN) * h * wp.length(v):
                        if touch.distance >= -scene.target_depth[target]:
                            hit = 0
                            hits += 1
                hit_out[pack, key, lane] = hit
        chunk_hits_out[pack, chunk, lane] = hits

    @wp.kernel(module=module, enable_backward=False)
    def measure(
        # Model
        scene: Scene,
        # Workspace in
        motion: Motion,
        reach_in: wp.array3d(dtype=real),
        count_in: wp.array3d(dtype=wp.int32),
        key_in: wp.array3d(dtype=wp.int32),
        couple_in: wp.array3d(dtype=wp.int32),
        # Workspace out
        touch_out: wp.array3d(dtype=real),
    ):
        """Geometry of one contact with a shape."""
        pack, c, lane = wp.tid()
        if c < count_in[pack, 0, lane]:
            couple = couple_in[pack, c, lane]
            target = scene.couple[couple, wp.static(TARGET)]
            kind = scene.target_kind[target]
            if kind < 5 or kind == wp.static(GRID):
                x = target_x(scene, motion, pack, lane, target)
                q = target_q(scene, motion, pack, lane, target)
                reach = reach_in[pack, couple, lane]
                touch = touch_shape(scene, motion, pack, lane, couple, key_in[pack, c, lane], x, q, reach)
                write_touch(pack, c, lane, touch, touch_out)

    return SimpleNamespace(find=find, measure=measure)
