"""Features: normals and insets of corners and edges, points of rims, velocities. Theory: docs/theory/collision.md."""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from softwarp.kernels.collision import geometry
from softwarp.model.codes import Carrier, CoupleColumn


@cache
def functions(scalar: Any) -> SimpleNamespace:
    """Functions of points and edges for one scalar type."""
    real = scalar
    types = geometry.structures(real)
    vec3 = types.vec3
    Scene, Motion = types.Scene, types.Motion
    place = geometry.functions(real)
    point_x, point_v, turned = place.point_x, place.point_v, place.turned

    @wp.func
    def face_normal(scene: Scene, motion: Motion, pack: int, lane: int, face: int):
        """Unit normal of a triangle in world axes; 0 for one without area."""
        a = point_x(scene, motion, pack, lane, scene.face_corner[face, 0])
        b = point_x(scene, motion, pack, lane, scene.face_corner[face, 1])
        c = point_x(scene, motion, pack, lane, scene.face_corner[face, 2])
        return wp.normalize(wp.cross(b - a, c - a))

    @wp.func
    def point_inset(scene: Scene, motion: Motion, pack: int, lane: int, point: int, a: vec3):
        """From a corner to a place a little inside its body, where the nearest face is the one that it meets.

        Nodes move against the mean normal of the triangles around them, a rim's point at a towards axis and middle.
        """
        inset = scene.point_inset[point]
        kind = scene.point_kind[point]
        if kind == wp.static(Carrier.NODE):
            mean = vec3()
            for k in range(scene.fan_start[point], scene.fan_start[point + 1]):
                mean += face_normal(scene, motion, pack, lane, scene.fan[k])
            inset = -inset[0] * wp.normalize(mean)
        else:
            inset = turned(motion, pack, lane, scene.point_index[point], inset)
            if kind == wp.static(Carrier.RIM):
                inset += wp.length(inset) * wp.normalize(point_x(scene, motion, pack, lane, point) - a)
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
    def edge_inset(scene: Scene, motion: Motion, pack: int, lane: int, edge: int):
        """From an edge to a line a little inside its body."""
        inset = scene.edge_inset[edge]
        point = scene.edge_point[edge, 0]
        if scene.point_kind[point] == wp.static(Carrier.NODE):
            n = vec3()
            k = int(0)
            while k < 2:
                face = scene.edge_face[edge, k]
                if face >= 0:
                    n += face_normal(scene, motion, pack, lane, face)
                k += 1
            inset = -inset[0] * wp.normalize(n)
        else:
            inset = turned(motion, pack, lane, scene.point_index[point], inset)
        return inset

    @wp.func
    def is_outside(
        scene: Scene,
        motion: Motion,
        pack: int,
        lane: int,
        edges: bool,
        feature: int,
        centre: vec3,
        extent: vec3,
        normal: vec3,
        reach: real,
    ):
        """Whether the box around a feature is apart from the box centre +- extent, or from a plane.

        The plane goes through the centre; its normal is 0 if there is none.
        """
        point = feature
        size = real(0.0)
        if edges:
            point = scene.edge_point[feature, 0]
            size = scene.edge_radius[feature]
        else:
            size = scene.point_radius[feature]
            if scene.point_kind[feature] == wp.static(Carrier.RIM):
                size = wp.length(scene.point_axis[feature])
        p = point_x(scene, motion, pack, lane, point)
        half = vec3(size, size, size)
        if edges:
            other = point_x(scene, motion, pack, lane, scene.edge_point[feature, 1])
            p = real(0.5) * (p + other)
            other -= p
            half += vec3(wp.abs(other[0]), wp.abs(other[1]), wp.abs(other[2]))
        apart = bool(False)
        above = real(0.0)
        for c in range(3):
            if wp.abs(p[c] - centre[c]) > extent[c] + half[c]:
                apart = True
            above += normal[c] * (p[c] - centre[c]) - wp.abs(normal[c]) * half[c]
        return apart or above > reach

    @wp.func
    def feature_v(scene: Scene, motion: Motion, pack: int, lane: int, couple: int, key: int, a: vec3, share: real):
        """Velocity of the feature of a key at a."""
        width = scene.couple[couple, wp.static(CoupleColumn.WIDTH)]
        feature = (
            scene.couple[couple, wp.static(CoupleColumn.FIRST)]
            + (key - scene.couple[couple, wp.static(CoupleColumn.KEY)]) / width
        )
        v = vec3()
        if scene.couple[couple, wp.static(CoupleColumn.EDGES)] != 0:
            v = (real(1.0) - share) * point_v(scene, motion, pack, lane, scene.edge_point[feature, 0], a)
            v += share * point_v(scene, motion, pack, lane, scene.edge_point[feature, 1], a)
        else:
            v = point_v(scene, motion, pack, lane, feature, a)
        return v

    return SimpleNamespace(
        face_normal=face_normal,
        point_inset=point_inset,
        around_rim=around_rim,
        edge_inset=edge_inset,
        is_outside=is_outside,
        feature_v=feature_v,
    )
