"""Closest points of simple figures. Theory: docs/theory/collision.md, section Closest points."""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

# Parts of a triangle: its inside, its sides 01, 12, 20, its corners
INSIDE, SIDE, VERTEX = 0, 1, 4


@cache
def functions(scalar: Any) -> SimpleNamespace:
    """Functions for one scalar type: ``point_segment``, ``point_triangle``, ``segment_segment``."""
    real = scalar
    vec3 = wp.types.vector(3, real)

    @wp.func
    def point_segment(p: vec3, a: vec3, b: vec3):
        """Share t of b in the point of the segment a b nearest to p."""
        e = b - a
        square = wp.dot(e, e)
        t = real(0.0)
        if square > real(0.0):
            t = wp.clamp(wp.dot(p - a, e) / square, real(0.0), real(1.0))
        return t

    @wp.func
    def point_triangle(p: vec3, a: vec3, b: vec3, c: vec3):
        """Weights u, v of b and c in the point of the triangle nearest to p, and the part where it lies.

        The inside where p projects into the triangle, else the nearest of the points of the three sides.
        """
        e = b - a
        f = c - a
        r = p - a
        n = wp.cross(e, f)
        square = wp.dot(n, n)
        u = real(-1.0)
        v = real(0.0)
        if square > real(0.0):
            u = wp.dot(wp.cross(r, f), n) / square
            v = wp.dot(wp.cross(e, r), n) / square
        part = int(INSIDE)
        if u <= real(0.0) or v <= real(0.0) or u + v >= real(1.0):
            t0 = point_segment(p, a, b)
            t1 = point_segment(p, b, c)
            t2 = point_segment(p, c, a)
            d0 = r - t0 * e
            d1 = p - b - t1 * (c - b)
            d2 = p - c + t2 * f
            s0 = wp.dot(d0, d0)
            s1 = wp.dot(d1, d1)
            s2 = wp.dot(d2, d2)
            t = t0
            side = int(0)
            u = t0
            v = real(0.0)
            if s1 < s0 and s1 <= s2:
                t = t1
                side = int(1)
                u = real(1.0) - t1
                v = t1
            elif s2 < s0:
                t = t2
                side = int(2)
                u = real(0.0)
                v = real(1.0) - t2
            part = wp.static(SIDE) + side
            if t <= real(0.0):
                part = wp.static(VERTEX) + side
            elif t >= real(1.0):
                part = wp.static(VERTEX) + (side + 1) % 3
        return u, v, part

    @wp.func
    def segment_segment(a: vec3, b: vec3, c: vec3, d: vec3):
        """Shares s of b and t of d in the nearest points of the lines a b and c d; -1, -1 where they are parallel."""
        e = b - a
        f = d - c
        r = a - c
        ee = wp.dot(e, e)
        ff = wp.dot(f, f)
        ef = wp.dot(e, f)
        n = wp.cross(e, f)
        square = wp.dot(n, n)
        s = real(-1.0)
        t = real(-1.0)
        if square > real(1.0e-6) * ee * ff:
            er = wp.dot(e, r)
            fr = wp.dot(f, r)
            s = (ef * fr - er * ff) / square
            t = (ee * fr - ef * er) / square
        return s, t

    return SimpleNamespace(
        vec3=vec3, point_segment=point_segment, point_triangle=point_triangle, segment_segment=segment_segment
    )
