"""Touches of points and edges with shapes, in world coordinates. Theory: docs/theory/collision.md."""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from softwarp.kernels.collision import edges_in_grids, features, geometry, shapes
from softwarp.kernels.collision.halving import AT_ONCE, box_halvings
from softwarp.model.codes import FACE, FAR, FAR_FROM, FLAT, Carrier, CoupleColumn, Target

BISECTIONS = 4 * AT_ONCE  # halvings of an edge
LEVEL = 1.0e-3  # slope of the distance along an edge up to which it counts as parallel
STRETCH = 0.05  # part of an edge that must run parallel for the two ends of that part to be told apart
UNSURE = 2.0  # times the inset: distance below which the normal of a corner is taken at its inset


@cache
def functions(scalar: Any, at_once: bool = False) -> SimpleNamespace:
    """Distance of points and edges from shapes, in world coordinates.

    ``at_once`` is for a CPU in single precision: some halvings of an edge together.
    """
    real = scalar
    types = geometry.structures(real)
    vec3, vec4 = types.vec3, types.vec4
    Scene, Motion, Touch, Sample, Brackets = types.Scene, types.Motion, types.Touch, types.Sample, types.Brackets
    place = geometry.functions(real)
    point_x, turned = place.point_x, place.turned
    own = features.functions(real)
    point_inset, edge_inset, around_rim = own.point_inset, own.edge_inset, own.around_rim
    shape = shapes.functions(real)
    to_local, rotate, primitive, grid = shape.to_local, shape.rotate, shape.distance, shape.grid
    rotate_back, box_slope = shape.rotate_back, shape.box_slope
    in_grid = edges_in_grids.functions(real)
    grid_of, near_part, turn_near = in_grid.grid_of, in_grid.near_part, in_grid.turn_near

    region_of, region_within = shape.region_of, shape.region_within

    @wp.func
    def local_distance(scene: Scene, target: int, local: vec3):
        """Signed distance from a shape, normal and region, in the shape's axes."""
        kind = scene.target_kind[target]
        size = scene.target_size[target]
        d = real(0.0)
        n = vec3()
        if kind == wp.static(Target.GRID):
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
        return d, n, region_of(kind, size, local, n)

    @wp.func
    def shape_distance(scene: Scene, target: int, x: vec3, q: vec4, p: vec3):
        """Signed distance of p from a shape at the pose (x, q), normal in world axes, region."""
        d, n, region = local_distance(scene, target, to_local(x, q, p))
        return d, rotate(q, n), region

    @wp.func
    def touch_point(scene: Scene, motion: Motion, pack: int, lane: int, point: int, target: int, x: vec3, q: vec4):
        """One point against one shape. Close to boxes and cylinders the normal is that at the inset point."""
        touch = Touch()
        a = point_x(scene, motion, pack, lane, point)
        inset = vec3()
        kind = scene.target_kind[target]
        is_rim = scene.point_kind[point] == wp.static(Carrier.RIM)
        stage = int(0)  # the point or the middle of its rim, the point of the rim, its inset
        while stage < 3:
            d, n, region = shape_distance(scene, target, x, q, a + inset)
            touch.region = region
            touch.distance = d - wp.dot(n, inset)
            touch.normal = n
            if stage == 0 and is_rim:
                arm = turned(motion, pack, lane, scene.point_index[point], scene.point_axis[point])
                radius = wp.length(arm)
                e = around_rim(scene.point_quarter[point], arm / radius, n)
                a += radius * e
                stage = 1
            else:
                near = real(UNSURE) * wp.length(scene.point_inset[point])
                if (
                    stage < 2
                    and (kind == wp.static(Target.BOX) or kind == wp.static(Target.CYLINDER))
                    and touch.distance < near
                ):
                    inset = point_inset(scene, motion, pack, lane, point, a)
                    stage = 2
                else:
                    stage = 3
        if wp.dot(inset, inset) > real(0.0) and touch.region == wp.static(FACE):
            border = real(0.25) * wp.length(inset)
            touch.region = region_within(kind, scene.target_size[target], to_local(x, q, a), border)
        touch.a = a
        touch.b = a - touch.distance * touch.normal
        touch.distance = touch.distance - scene.point_radius[point]
        return touch

    @wp.func
    def at_kink(a: Sample, v: Sample, level: real, length: real):
        """Where the tangents at a place that falls and one that rises meet, with the normal across edge and kink.

        ``t`` is -1 where the two normals nearly cancel.
        """
        best = Sample()
        best.t = real(-1.0)
        sa = wp.min(a.slope, -level)
        sb = wp.max(v.slope, level)
        mean = (sb * a.n - sa * v.n) / (sb - sa)
        across = wp.length(mean)
        if across > real(0.1):
            best.n = mean / across
            best.t = (a.f - v.f + (sb * v.t - sa * a.t) * length) / ((sb - sa) * length)
            best.t = wp.clamp(best.t, a.t, v.t)
            best.f = wp.min(a.f + sa * (best.t - a.t) * length, wp.min(a.f, v.f)) / across
            best.region = a.region
        return best

    @wp.func
    def lowest_place(
        a: Sample, b: Sample, u: Sample, v: Sample, falls: bool, rises: bool, side: int, level: real, length: real
    ):
        """Where an edge touches for one ``side``, from the brackets a b and u v; ``t`` is -1 where it does not."""
        best = Sample()
        best.t = real(-1.0)
        if u.t - b.t > real(STRETCH):
            if side == 0 and falls:
                best = b
            elif side == 1 and rises:
                best = u
            best.region = best.region | wp.static(FLAT)
        elif side == 0 and falls and rises:
            best = at_kink(a, v, level, length)
        return best

    @wp.func
    def level_place(a: Sample, v: Sample):
        """Where a line is nearest to an edge or a corner, between a place that falls and one that rises.

        The normal there is across the line; the way from there is the tangent of the angle by which normals turn.
        """
        n = wp.normalize(v.slope * a.n - a.slope * v.n)
        before = wp.dot(a.n, n)
        behind = wp.dot(v.n, n)
        t = v.t
        if before > real(0.0) and behind > real(0.0):
            from_a = wp.length(wp.cross(a.n, n)) * behind
            from_v = wp.length(wp.cross(v.n, n)) * before
            t = wp.clamp(a.t + (v.t - a.t) * from_a / (from_a + from_v), a.t, v.t)
        return t

    @wp.func
    def turn_of(
        scene: Scene, target: int, start: vec3, d: vec3, length: real, low: real, high: real, bound: real, care: real
    ):
        """Bracket of halvings of the place where the slope comes to ``bound``.

        Before, slopes are less than a negative bound, and not greater than a positive one. Both ends are -1 where all
        between ``low`` and ``high`` turns out to be farther than ``care``.
        """
        if scene.target_kind[target] == wp.static(Target.GRID):
            left, right = turn_near(scene, target, start, d, length, low, high, bound, wp.static(BISECTIONS), care)
            return left, right
        if wp.static(at_once):
            if scene.target_kind[target] == wp.static(Target.BOX):
                rounds = wp.static(BISECTIONS // AT_ONCE)
                ends = box_halvings(scene.target_size[target], start, d, length, low, high, bound, rounds)
                return ends[0], ends[1]
        left = low
        right = high
        halvings = int(0)
        while halvings < wp.static(BISECTIONS):
            t = real(0.5) * (left + right)
            slope = real(0.0)
            p = start + t * d
            if scene.target_kind[target] == wp.static(Target.BOX):
                slope = box_slope(scene.target_size[target], p, d) / length
            else:
                _d, n, _region = local_distance(scene, target, p)
                slope = wp.dot(n, d) / length
            if slope < bound or (slope == bound and bound > real(0.0)):
                left = t
            else:
                right = t
            halvings += 1
        return left, right

    @wp.func
    def part_of(
        scene: Scene, target: int, x: vec3, q: vec4, start: vec3, d: vec3, radius: real, reach: real, care: real
    ):
        """Ends of the part of a line start + t d where it may touch, the first one -1 if none may.

        Nothing need be found that is farther than ``care``. Only grids are asked; ``reach`` is for the line's middle.
        """
        low = real(0.0)
        high = real(1.0)
        if scene.target_kind[target] == wp.static(Target.GRID):
            first, nodes, origin, spacing = grid_of(scene, target)
            local_start, local_d = to_local(x, q, start), rotate_back(q, d)
            length = wp.length(d)
            low, high = near_part(
                scene.grid_value, first, nodes, origin, spacing, local_start, local_d, length, radius, reach, care
            )
        return low, high

    @wp.func
    def line_of(scene: Scene, motion: Motion, pack: int, lane: int, edges: bool, feature: int):
        """Start, way and radius of an edge, or of a point, whose way is 0."""
        start = vec3()
        way = vec3()
        radius = real(0.0)
        if edges:
            start = point_x(scene, motion, pack, lane, scene.edge_point[feature, 0])
            way = point_x(scene, motion, pack, lane, scene.edge_point[feature, 1]) - start
            radius = scene.edge_radius[feature]
        else:
            start = point_x(scene, motion, pack, lane, feature)
            radius = scene.point_radius[feature]
        return start, way, radius

    @wp.func
    def brackets_of(
        scene: Scene,
        target: int,
        x: vec3,
        q: vec4,
        start: vec3,
        d: vec3,
        radius: real,
        reach: real,
        care: real,
        low: real,
        high: real,
    ):
        """Where the distance along a line start + t d stops to fall and begins to rise; not at all where it does not.

        The distance of a convex shape is convex along the edge: one bracket closes on the place where it stops to fall,
        one on that where it begins to rise. Grids are searched in the part from ``low`` to ``high`` that ``part_of``
        finds, as long as any of it may be within ``care``. Between the two, a last look is at where the distance from
        one round part of a shape is least.
        """
        length = wp.length(d)
        local_start = to_local(x, q, start)
        local_d = rotate_back(q, d)
        level = real(LEVEL)
        end = int(7)  # looks: the middle, both ends; then the brackets: a and b, u and v; the last one
        a = Sample()  # still falls
        b = Sample()  # falls no longer
        u = Sample()  # does not rise yet
        v = Sample()  # rises
        falls = bool(False)
        rises = bool(False)
        round_place = Sample()
        round_place.t = real(-1.0)
        left = real(0.0)
        right = real(0.0)
        t = real(0.5)
        k = int(0)
        if length <= real(0.0):
            k = end + 1
        elif scene.target_kind[target] == wp.static(Target.GRID):
            t = low
            k = wp.where(low < real(0.0), end + 1, 1)
        while k <= end:
            here = Sample()
            here.t = t
            f, n, region = local_distance(scene, target, local_start + t * local_d)
            here.f = f
            here.n = n
            here.region = region
            here.slope = wp.dot(n, local_d) / length
            if k == 0:
                if here.f - real(0.5) * length - radius > reach:
                    k = end
                t = real(0.0)
            elif k == 1:
                a = here
                b = here
                t = high
            elif k == 2:
                u = here
                v = here
                falls = a.slope < -level and v.slope >= -level
                rises = v.slope > level and a.slope <= level
                if falls:
                    left, right = turn_of(scene, target, local_start, local_d, length, low, high, -level, care + radius)
                    t = left
                elif rises:
                    k = 4
                else:
                    k = end
            elif k == 3:
                a = here
                t = right
            elif k == 4:
                b = here
                if not rises:
                    k = end
            elif k == 5:
                u = here
                t = right
            elif k == 6:
                v = here
                t = level_place(a, v)
                if not falls or a.region != v.region or v.region == wp.static(FACE):
                    k = end
            else:
                round_place = here
            if k == 4:
                u = a
                left, right = turn_of(scene, target, local_start, local_d, length, a.t, high, level, care + radius)
                t = left
            if (k == 2 or k == 4) and t < real(0.0):
                falls = False
                rises = False
                k = end
            k += 1
        found = Brackets()
        found.a = a
        found.b = b
        found.u = u
        found.v = v
        found.falls = falls
        found.rises = rises
        found.lowest = round_place
        if falls or rises:
            found.lowest.n = rotate(q, round_place.n)
            found.a.n = rotate(q, a.n)
            found.b.n = rotate(q, b.n)
            found.u.n = rotate(q, u.n)
            found.v.n = rotate(q, v.n)
        return found

    @wp.func
    def touch_line(found: Brackets, p0: vec3, d: vec3, inset: vec3, radius: real, side: int):
        """An edge p0 + t d, searched along a line moved by ``inset``; face -1 without a minimum between the ends.

        If its brackets are apart the edge runs level between them, and both ends of this part touch, one for each
        ``side``. If they meet there may be a kink: the normal is across edge and kink.
        """
        touch = Touch()
        touch.distance = real(FAR)
        best = Sample()
        best.t = real(-1.0)
        touch.face = -1
        if found.falls or found.rises:
            touch.face = 0
            best = lowest_place(
                found.a, found.b, found.u, found.v, found.falls, found.rises, side, real(LEVEL), wp.length(d)
            )
            if found.lowest.t >= real(0.0) and side == 0 and found.u.t - found.b.t <= real(STRETCH):
                best = found.lowest
        if best.t > real(0.0) and best.t < real(1.0):
            away = best.f - wp.dot(best.n, inset)
            touch.distance = away - radius
            touch.normal = best.n
            touch.a = p0 + best.t * d
            touch.b = touch.a - away * best.n
            touch.share = best.t
            touch.region = best.region
        return touch

    @wp.func
    def is_unsure(touch: Touch, near: real):
        """Whether an edge is so close that its normal is taken at its inset."""
        return touch.face >= 0 and near > real(0.0) and (touch.distance <= near or touch.distance > real(FAR_FROM))

    @wp.func
    def with_inset(touch: Touch, other: Touch, near: real):
        """The touch of an edge, given that of its inset."""
        result = other
        apart = wp.length(other.a - touch.a)
        if (touch.region & other.region & wp.static(FLAT)) != 0 and apart < near:
            result.b = other.b + touch.a - other.a  # the place of the true edge, the normal of the inset one
            result.a = touch.a
            result.share = touch.share
        return result

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
        reach: real,
        care: real,
        low: real,
        high: real,
    ):
        """Both sides of one edge against one shape; close to boxes and cylinders, normals are those at its inset."""
        p0 = point_x(scene, motion, pack, lane, scene.edge_point[edge, 0])
        d = point_x(scene, motion, pack, lane, scene.edge_point[edge, 1]) - p0
        radius = scene.edge_radius[edge]
        near = real(0.0)
        if scene.target_kind[target] == wp.static(Target.BOX) or scene.target_kind[target] == wp.static(
            Target.CYLINDER
        ):
            near = real(UNSURE) * wp.length(scene.edge_inset[edge])
        found = brackets_of(scene, target, x, q, p0, d, radius, reach, care, low, high)
        first = touch_line(found, p0, d, vec3(), radius, 0)
        second = touch_line(found, p0, d, vec3(), radius, 1)
        is_first = is_unsure(first, near)
        is_second = is_unsure(second, near)
        if is_first or is_second:
            inset = edge_inset(scene, motion, pack, lane, edge)
            found = brackets_of(scene, target, x, q, p0 + inset, d, radius, near, real(FAR), real(0.0), real(1.0))
            if is_first:
                first = with_inset(first, touch_line(found, p0, d, inset, radius, 0), near)
            if is_second:
                second = with_inset(second, touch_line(found, p0, d, inset, radius, 1), near)
        return first, second

    @wp.func
    def touch_shape(
        scene: Scene,
        motion: Motion,
        pack: int,
        lane: int,
        couple: int,
        key: int,
        x: vec3,
        q: vec4,
        reach: real,
        care: real,
        low: real,
        high: real,
    ):
        """The feature of a key against its shape, and the other side of it where it is an edge.

        Of an edge the part from ``low`` to ``high``; nothing need be found that is farther than ``care``.
        """
        touch = Touch()
        other = Touch()
        width = scene.couple[couple, wp.static(CoupleColumn.WIDTH)]
        offset = key - scene.couple[couple, wp.static(CoupleColumn.KEY)]
        feature = scene.couple[couple, wp.static(CoupleColumn.FIRST)] + offset / width
        target = scene.couple[couple, wp.static(CoupleColumn.TARGET)]
        if scene.couple[couple, wp.static(CoupleColumn.EDGES)] != 0:
            touch, other = touch_edge(scene, motion, pack, lane, feature, target, x, q, reach, care, low, high)
            if offset % width == 1:
                return other, touch
        else:
            touch = touch_point(scene, motion, pack, lane, feature, target, x, q)
        return touch, other

    return SimpleNamespace(
        touch_shape=touch_shape,
        shape_distance=shape_distance,
        line_of=line_of,
        part_of=part_of,
        near_part=near_part,
        grid_of=grid_of,
        brackets_of=brackets_of,
        touch_line=touch_line,
        is_unsure=is_unsure,
    )
