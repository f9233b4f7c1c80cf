"""Points and edges against single triangles and segments. Theory: docs/theory/collision.md, section Surfaces.

Positions are in the coordinates of the target: those of the frame for a rigid mesh, else those of the world.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from softwarp.kernels.collision import closest, geometry
from softwarp.kernels.collision.closest import INSIDE, SIDE, VERTEX
from softwarp.model.codes import CORNER, EDGE, FACE, FAR, Target

SHARP = 0.996  # cosine of the angle between faces below which the edge between them can touch (5 degrees)
CONE = 0.05  # sine by which a normal may leave the cone of an edge
HELD_CONE = 0.15  # likewise of edges that pressed in an earlier iterate of the step, see ``keeping``
END = 1.0e-3  # part at the ends of an edge that belongs to its points
BORDER = 1.0e-6  # distance relative to an edge below which the direction to the nearest point is not used


@cache
def functions(scalar: Any) -> SimpleNamespace:
    """Distance of points and edges from single faces."""
    real = scalar
    types = geometry.structures(real)
    vec3 = types.vec3
    Scene, Motion, Touch = types.Scene, types.Motion, types.Touch
    point_x = geometry.functions(real).point_x
    near = closest.functions(real)
    point_triangle, point_segment, segment_segment = near.point_triangle, near.point_segment, near.segment_segment

    @wp.func
    def corner_x(scene: Scene, motion: Motion, pack: int, lane: int, target: int, point: int):
        """Corner of a face in the coordinates of its target."""
        x = scene.point_local[point]
        if scene.target_kind[target] != wp.static(Target.MESH):
            x = point_x(scene, motion, pack, lane, point)
        return x

    @wp.func
    def normal_of(scene: Scene, motion: Motion, pack: int, lane: int, target: int, face: int):
        """Unit normal of a triangle; 0 for no triangle or one without area."""
        n = vec3()
        if face >= 0:
            a = corner_x(scene, motion, pack, lane, target, scene.face_corner[face, 0])
            b = corner_x(scene, motion, pack, lane, target, scene.face_corner[face, 1])
            c = corner_x(scene, motion, pack, lane, target, scene.face_corner[face, 2])
            n = wp.normalize(wp.cross(b - a, c - a))
        return n

    @wp.func
    def corner_normal(scene: Scene, motion: Motion, pack: int, lane: int, target: int, point: int):
        """Sum of the normals around a vertex, weighted by angle (Thuermer and Wuethrich 1998)."""
        n = vec3()
        for k in range(scene.fan_start[point], scene.fan_start[point + 1]):
            face = scene.fan[k]
            at = int(0)
            for j in range(1, 3):
                if scene.face_corner[face, j] == point:
                    at = j
            p = corner_x(scene, motion, pack, lane, target, point)
            e = corner_x(scene, motion, pack, lane, target, scene.face_corner[face, (at + 1) % 3]) - p
            f = corner_x(scene, motion, pack, lane, target, scene.face_corner[face, (at + 2) % 3]) - p
            n += wp.atan2(wp.length(wp.cross(e, f)), wp.dot(e, f)) * wp.normalize(wp.cross(e, f))
        return n

    @wp.func
    def face_gap(scene: Scene, motion: Motion, pack: int, lane: int, target: int, face: int, p: vec3):
        """Distance between a point and the surface around a face, without a sign; negative inside its skin only."""
        k = scene.face_corner[face, 2]
        a = corner_x(scene, motion, pack, lane, target, scene.face_corner[face, 0])
        b = corner_x(scene, motion, pack, lane, target, scene.face_corner[face, 1])
        away = vec3()
        if k < 0:
            away = p - a - point_segment(p, a, b) * (b - a)
        else:
            c = corner_x(scene, motion, pack, lane, target, k)
            u, v, part = point_triangle(p, a, b, c)
            away = p - a - u * (b - a) - v * (c - a)
        return wp.length(away) - scene.face_radius[face]

    @wp.func
    def touch_face(scene: Scene, motion: Motion, pack: int, lane: int, target: int, face: int, p: vec3):
        """A point against one triangle or segment: signed distance from its surface, outward normal, weights, region.

        The sign is that of the face's normal, at sides and corners of the pseudonormal (Baerentzen and Aanaes 2005).
        """
        touch = Touch()
        i = scene.face_corner[face, 0]
        j = scene.face_corner[face, 1]
        k = scene.face_corner[face, 2]
        a = corner_x(scene, motion, pack, lane, target, i)
        b = corner_x(scene, motion, pack, lane, target, j)
        if k < 0:
            u = point_segment(p, a, b)
            away = p - (a + u * (b - a))
            d = wp.length(away)
            n = vec3(real(0.0), real(0.0), real(1.0))
            if d > real(0.0):
                n = away / d
            touch.distance = d - scene.face_radius[face]
            touch.normal = n
            touch.u = u
            touch.region = int(EDGE)
            if u <= real(0.0) or u >= real(1.0):
                touch.region = int(CORNER)
        else:
            c = corner_x(scene, motion, pack, lane, target, k)
            u, v, part = point_triangle(p, a, b, c)
            n = wp.normalize(wp.cross(b - a, c - a))
            away = p - (a + u * (b - a) + v * (c - a))
            d = wp.dot(p - a, n)
            touch.region = int(FACE)
            if part != wp.static(INSIDE):
                side = vec3()
                if part < wp.static(VERTEX):
                    touch.region = int(EDGE)
                    other = scene.face_beside[face, part - wp.static(SIDE)]
                    side = n + normal_of(scene, motion, pack, lane, target, other)
                else:
                    touch.region = int(CORNER)
                    point = scene.face_corner[face, part - wp.static(VERTEX)]
                    side = corner_normal(scene, motion, pack, lane, target, point)
                d = wp.length(away)
                n = wp.normalize(side)
                if d > real(BORDER) * wp.length(b - a):
                    n = away / d
                if wp.dot(away, side) < real(0.0):
                    n = -n
                    d = -d
                    if wp.dot(n, side) < real(0.0):
                        n = wp.normalize(side)
            touch.distance = d - scene.face_radius[face]
            touch.normal = n
            touch.u = u
            touch.v = v
        touch.b = p - touch.distance * touch.normal
        touch.a = p
        touch.face = face
        return touch

    @wp.func
    def rest_gap(scene: Scene, point: int, face: int):
        """Distance at rest between a point and a face of the same surface; 0 where they share a corner."""
        gap = real(0.0)
        i = scene.face_corner[face, 0]
        j = scene.face_corner[face, 1]
        k = scene.face_corner[face, 2]
        if i != point and j != point and k != point:
            p = scene.point_rest[point]
            a = scene.point_rest[i]
            b = scene.point_rest[j]
            nearest = vec3()
            if k < 0:
                nearest = a + point_segment(p, a, b) * (b - a)
            else:
                c = scene.point_rest[k]
                u, v, part = point_triangle(p, a, b, c)
                nearest = a + u * (b - a) + v * (c - a)
            gap = wp.length(p - nearest)
        return gap

    @wp.func
    def is_in_cone(
        scene: Scene, motion: Motion, pack: int, lane: int, target: int, face: int, side: int, n: vec3, cone: real
    ):
        """Whether n leaves the edge ``side`` of a face outwards, between the normals of the two faces beside it.

        That is to a sine of ``cone``. Edges that are nearly flat, or that fold inwards, have no such normals.
        """
        a = corner_x(scene, motion, pack, lane, target, scene.face_corner[face, side])
        b = corner_x(scene, motion, pack, lane, target, scene.face_corner[face, (side + 1) % 3])
        e = wp.normalize(b - a)
        n1 = normal_of(scene, motion, pack, lane, target, face)
        other = scene.face_beside[face, side]
        good = wp.dot(n, wp.cross(n1, e)) <= cone
        if other >= 0:
            n2 = normal_of(scene, motion, pack, lane, target, other)
            good = good and wp.dot(n1, n2) < real(SHARP)
            good = good and wp.dot(n, wp.cross(e, n2)) <= cone
            good = good and wp.dot(n, n1 + n2) > real(0.0)
        return good

    @wp.func
    def is_lowest(scene: Scene, motion: Motion, pack: int, lane: int, target: int, touch: Touch):
        """Whether the side or corner that is nearest to a point outside is so for the faces around it, too.

        Then no way along the surface comes nearer, and it is a contact of a ball besides its nearest one: the end of a
        wall. Sides within a plane and those that fold inwards are none.
        """
        n = touch.normal
        good = bool(True)
        if touch.region == wp.static(EDGE):
            side = int(1)
            if touch.v <= real(0.0):
                side = 0
            elif touch.u <= real(0.0):
                side = 2
            a = corner_x(scene, motion, pack, lane, target, scene.face_corner[touch.face, side])
            b = corner_x(scene, motion, pack, lane, target, scene.face_corner[touch.face, (side + 1) % 3])
            e = wp.normalize(b - a)
            other = scene.face_beside[touch.face, side]
            good = wp.dot(n, wp.cross(normal_of(scene, motion, pack, lane, target, touch.face), e)) <= real(CONE)
            if other >= 0:
                good = good and wp.dot(n, wp.cross(e, normal_of(scene, motion, pack, lane, target, other))) <= real(
                    CONE
                )
        elif touch.region == wp.static(CORNER):
            point = scene.face_corner[touch.face, 0]
            if touch.u >= real(0.5):
                point = scene.face_corner[touch.face, 1]
            elif touch.v >= real(0.5):
                point = scene.face_corner[touch.face, 2]
            p = corner_x(scene, motion, pack, lane, target, point)
            for k in range(scene.fan_start[point], scene.fan_start[point + 1]):
                for j in range(3):
                    way = corner_x(scene, motion, pack, lane, target, scene.face_corner[scene.fan[k], j]) - p
                    good = good and wp.dot(n, way) <= real(CONE) * wp.length(way)
        return good

    @wp.func
    def touch_side(
        scene: Scene, motion: Motion, pack: int, lane: int, target: int, face: int, side: int, p0: vec3, p1: vec3
    ):
        """An edge p0 p1 against one side of a face: distance ``FAR`` unless the nearest points are inside both.

        The normal is across both, to the outside of the target's edge; between two rods, along the shortest way.
        """
        touch = Touch()
        touch.distance = real(FAR)
        i = scene.face_corner[face, side]
        j = scene.face_corner[face, (side + 1) % 3]
        a = corner_x(scene, motion, pack, lane, target, i)
        b = corner_x(scene, motion, pack, lane, target, j)
        s, t = segment_segment(p0, p1, a, b)
        low = real(END)
        high = real(1.0) - low
        if s > low and s < high and t > low and t < high:
            p = p0 + s * (p1 - p0)
            n = wp.normalize(wp.cross(p1 - p0, b - a))
            d = wp.dot(p - (a + t * (b - a)), n)
            outward = vec3()
            if scene.face_corner[face, 2] < 0:
                outward = d * n
            else:
                outward = normal_of(scene, motion, pack, lane, target, face)
                outward += normal_of(scene, motion, pack, lane, target, scene.face_beside[face, side])
            if wp.dot(outward, n) < real(0.0):
                n = -n
                d = -d
            touch.distance = d - scene.face_radius[face]
            touch.normal = n
            touch.a = p
            touch.b = p - touch.distance * n
            touch.share = s
            touch.face = 3 * face + side
            touch.region = int(EDGE)
            if side == 0:
                touch.u = t
            elif side == 1:
                touch.u = real(1.0) - t
                touch.v = t
            else:
                touch.v = real(1.0) - t
        return touch

    return SimpleNamespace(
        corner_x=corner_x,
        normal_of=normal_of,
        face_gap=face_gap,
        touch_face=touch_face,
        rest_gap=rest_gap,
        is_in_cone=is_in_cone,
        is_lowest=is_lowest,
        touch_side=touch_side,
    )
