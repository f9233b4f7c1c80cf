"""Where edges come near what a grid samples, such as the wall of a vessel. Theory: docs/theory/collision.md.

Distances from a grid are not convex: an edge is sampled first, and searched around the lowest sample. Most edges of a
line in a vessel are farther from its wall than anybody asks, which few samples tell; slopes are compared without the
roots and quotients of a unit normal, unless they are so close to their bound that rounding might decide.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from softwarp.kernels.collision import geometry, shapes

SAMPLES = 9  # of an edge before it is searched
DOUBTFUL = 0.2  # part of the square of a bound within which slopes are compared anew, as everywhere else
EARLY = 5  # halvings that ask whether what is left of an edge is near at all


@cache
def functions(real: Any) -> SimpleNamespace:
    """Functions for one scalar type: ``grid_of``, ``near_part`` and ``turn_near``."""
    types = geometry.structures(real)
    vec3, Scene = types.vec3, types.Scene
    shape = shapes.functions(real)
    grid, grid_distance = shape.grid, shape.grid_distance

    @wp.func
    def grid_of(scene: Scene, target: int):
        """Samples of a grid: where they begin, nodes by axis, origin and spacing."""
        nodes = wp.vec3i(scene.target_grid[target, 1], scene.target_grid[target, 2], scene.target_grid[target, 3])
        return scene.target_grid[target, 0], nodes, scene.grid_origin[target], scene.grid_spacing[target]

    @wp.func
    def most_change(d: vec3):
        """Largest change of the distance along d, in the axes of the grid.

        No two samples differ by more than they are apart, so its slope along each axis is 1 at most.
        """
        return wp.abs(d[0]) + wp.abs(d[1]) + wp.abs(d[2])

    @wp.func
    def near_part(
        value: wp.array(dtype=real),
        first: int,
        nodes: wp.vec3i,
        origin: vec3,
        spacing: real,
        start: vec3,
        d: vec3,
        length: real,
        radius: real,
        reach: real,
        care: real,
    ):
        """Ends of the part of a line where it may touch, between the neighbours of its lowest sample, in a grid's axes.

        They are -1 and 0 where there is none: where an end is nearest, or all of the line is farther than ``care``, or
        than ``reach`` by its middle. That comes first, then samples halfway to the ends, the ends, and those between,
        until it is told. A line of no length is a point, all of which may touch.
        """
        lowest = grid_distance(value, first, nodes, origin, spacing, start + real(0.5) * d)
        at = int(wp.static(SAMPLES // 2))
        k = int(2)
        apart = int(4)
        between = real(0.25)  # the farthest from a sample that a place of the line lies, as a part of it
        most = most_change(d)
        is_far = lowest - real(0.5) * length - radius > reach
        if length <= real(0.0):
            is_far = lowest - radius > care
            k = int(SAMPLES)
            apart = 2
        while k >= 0 and not is_far:
            while k < wp.static(SAMPLES):
                f = grid_distance(value, first, nodes, origin, spacing, start + real(k) / real(SAMPLES - 1) * d)
                if f < lowest or (f == lowest and k < at):
                    lowest = f
                    at = k
                k += apart
            is_far = lowest - between * most - radius > care
            k = wp.where(apart == 4, 0, wp.where(apart == 8, 1, -1))
            apart = wp.where(apart == 4, 8, 2)
            between *= real(0.5)
        low = real(-1.0)
        high = real(0.0)
        if not is_far and at > 0 and at < wp.static(SAMPLES - 1):
            low = real(at - 1) / real(SAMPLES - 1)
            high = real(at + 1) / real(SAMPLES - 1)
        return low, high

    @wp.func
    def slope_at(scene: Scene, target: int, p: vec3, d: vec3):
        """Distance, its change along d times the spacing, and the square of its gradient times that of the spacing.

        Within the grid, as the last value tells; the cell is that of ``shapes.grid``.
        """
        first, nodes, origin, spacing = grid_of(scene, target)
        cell = wp.vec3i()
        t = vec3()
        inside = bool(True)
        for c in range(3):
            u = (p[c] - origin[c]) / spacing
            if not (u >= real(0.0) and u <= real(nodes[c] - 1)):
                inside = False
                u = real(0.0)
            cell[c] = wp.min(int(u), nodes[c] - 2)
            t[c] = u - real(cell[c])
        sx, sy = nodes[1] * nodes[2], nodes[2]
        b = first + cell[0] * sx + cell[1] * sy + cell[2]
        f00 = scene.grid_value[b]
        f01 = scene.grid_value[b + 1]
        f10 = scene.grid_value[b + sy]
        f11 = scene.grid_value[b + sy + 1]
        x00 = scene.grid_value[b + sx] - f00
        x01 = scene.grid_value[b + sx + 1] - f01
        x10 = scene.grid_value[b + sx + sy] - f10
        x11 = scene.grid_value[b + sx + sy + 1] - f11
        gx = x00 + t[1] * (x10 - x00)
        gx += t[2] * (x01 + t[1] * (x11 - x01) - gx)
        f00 += t[0] * x00
        f01 += t[0] * x01
        f10 += t[0] * x10
        f11 += t[0] * x11
        y0 = f10 - f00
        f0 = f00 + t[1] * y0
        gz = f01 + t[1] * (f11 - f01) - f0
        gy = y0 + t[2] * (f11 - f01 - y0)
        g = vec3(gx, gy, gz)
        return f0 + t[2] * gz, wp.dot(g, d), wp.dot(g, g), inside

    @wp.func
    def turn_near(
        scene: Scene,
        target: int,
        start: vec3,
        d: vec3,
        length: real,
        low: real,
        high: real,
        bound: real,
        halvings: int,
        care: real,
    ):
        """Bracket of halvings of the place where the slope comes to ``bound``, as ``shape_touches.turn_of`` has it.

        Both ends are -1 where the first halvings tell that all between them is farther than ``care``.
        """
        left = low
        right = high
        most = most_change(d)
        middle = bound * wp.abs(bound) * length * length
        k = int(0)
        while k < halvings:
            t = real(0.5) * (left + right)
            p = start + t * d
            f, along, square, inside = slope_at(scene, target, p, d)
            excess = along * wp.abs(along) - middle * square
            falls = excess < real(0.0)
            if not inside or not (wp.abs(excess) > real(DOUBTFUL) * wp.abs(middle) * square):
                first, nodes, origin, spacing = grid_of(scene, target)
                f, n = grid(scene.grid_value, first, nodes, origin, spacing, p)
                slope = wp.dot(n, d) / length
                falls = slope < bound or (slope == bound and bound > real(0.0))
            k += 1
            if k <= wp.static(EARLY) and f - real(0.5) * (right - left) * most > care:
                left = real(-1.0)
                right = real(-1.0)
                k = halvings
            elif falls:
                left = t
            else:
                right = t
        return left, right

    return SimpleNamespace(grid_of=grid_of, near_part=near_part, turn_near=turn_near)
