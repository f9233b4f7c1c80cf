"""Edges across the edges of a box, each by its number. Theory: docs/theory/newton.md, Contacts."""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from softwarp.kernels.collision import closest, geometry, shapes
from softwarp.kernels.collision.faces import END
from softwarp.model.codes import EDGE, FAR

BOX_EDGES = 12


@cache
def functions(scalar: Any) -> SimpleNamespace:
    """Edges of a box, and touches across them, for one scalar type."""
    real = scalar
    types = geometry.structures(real)
    vec3, vec4, Touch = types.vec3, types.vec4, types.Touch
    segment_segment = closest.functions(real).segment_segment
    shape = shapes.functions(real)
    to_local, rotate, rotate_back = shape.to_local, shape.rotate, shape.rotate_back

    @wp.func
    def box_edge(size: vec3, number: int):
        """Start and way of an edge of a box, and a vector from the middle of the box towards the edge's own middle.

        Four along each axis.
        """
        axis = number / 4
        start = vec3()
        way = vec3()
        outward = vec3()
        for c in range(3):
            if c == axis:
                way[c] = size[c]
                start[c] = real(-0.5) * size[c]
            else:
                bit = number % 2
                if c == (axis + 2) % 3:
                    bit = (number / 2) % 2
                outward[c] = wp.where(bit == 0, real(-1.0), real(1.0))
                start[c] = real(0.5) * size[c] * outward[c]
        return start, way, outward

    @wp.func
    def touch_box_edge(size: vec3, number: int, x: vec3, q: vec4, p0: vec3, d: vec3, radius: real, cone: real):
        """An edge p0 + t d against an edge of a box: distance ``FAR`` unless the nearest points are inside both.

        So it is where the normal across both leaves the box not between its two faces, to a sine of ``cone``.
        """
        touch = Touch()
        touch.distance = real(FAR)
        touch.face = -1
        start, way, outward = box_edge(size, number)
        p = to_local(x, q, p0)
        e = rotate_back(q, d)
        s, t = segment_segment(p, p + e, start, start + way)
        low = real(END)
        high = real(1.0) - low
        if s > low and s < high and t > low and t < high:
            n = wp.normalize(wp.cross(e, way))
            if wp.dot(n, outward) < real(0.0):
                n = -n
            is_between = bool(True)
            for c in range(3):
                is_between = is_between and n[c] * outward[c] >= -cone
            if is_between:
                away = wp.dot(p + s * e - start - t * way, n)
                touch.normal = rotate(q, n)
                touch.distance = away - radius
                touch.a = p0 + s * d
                touch.b = touch.a - away * touch.normal
                touch.share = s
                touch.region = wp.static(EDGE)
                touch.face = 0
        return touch

    return SimpleNamespace(box_edge=box_edge, touch_box_edge=touch_box_edge)
