"""Signed distance of rigid shapes, and the change of frames around it. Theory: docs/theory/shapes.md.

Distances are in the local frame of a shape, positive outside; n is the outward unit vector along which d grows fastest.
Where that is not unique (centres, axes, edges seen from inside) one of the candidates is taken, always the same.
Quaternions are (x, y, z, w) and unit.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from softwarp.model.codes import CORNER, EDGE, FACE, FAR, Target

ALIGNED = 1.0e-3  # component of a normal up to which it counts as zero


@cache
def functions(real: Any) -> SimpleNamespace:
    """Functions and probes for one scalar type, ``wp.float32`` or ``wp.float64``.

    Returns:
        ``vec3`` and ``vec4`` types; functions ``rotate``, ``rotate_back``, ``to_world``, ``to_local``, ``plane``,
        ``sphere``, ``capsule``, ``box``, ``cylinder``, ``distance``, ``grid``; kernels ``probe`` and ``probe_grid``.
    """
    vec3 = wp.types.vector(3, real)
    vec4 = wp.types.vector(4, real)
    module = wp.get_module(f"softwarp.kernels.collision.shapes.{'f64' if real is wp.float64 else 'f32'}")
    module.options["enable_backward"] = False

    @wp.func
    def rotate(q: vec4, v: vec3):
        """R(q) v = v + 2 w (u x v) + 2 u x (u x v), u the vector part."""
        u = vec3(q[0], q[1], q[2])
        t = real(2.0) * wp.cross(u, v)
        return v + q[3] * t + wp.cross(u, t)

    @wp.func
    def rotate_back(q: vec4, v: vec3):
        """R(q)' v."""
        u = vec3(q[0], q[1], q[2])
        t = real(2.0) * wp.cross(v, u)
        return v + q[3] * t + wp.cross(t, u)

    @wp.func
    def to_world(x: vec3, q: vec4, p: vec3):
        """World position of the local point p of a frame at x, turned by q."""
        return x + rotate(q, p)

    @wp.func
    def to_local(x: vec3, q: vec4, p: vec3):
        """Local position of the world point p in a frame at x, turned by q."""
        return rotate_back(q, p - x)

    @wp.func
    def direction(v: vec3, other: vec3):
        """v / |v| without underflow of short vectors, and |v|; ``other`` and 0 for the zero vector."""
        largest = wp.max(wp.max(wp.abs(v[0]), wp.abs(v[1])), wp.abs(v[2]))
        n = other
        length = real(0.0)
        if largest > real(0.0):
            scaled = v / largest
            norm = wp.sqrt(wp.dot(scaled, scaled))
            n = scaled / norm
            length = norm * largest
        return n, length

    @wp.func
    def side(a: real):
        """Sign of a, +1 for zero."""
        sign = real(1.0)
        if a < real(0.0):
            sign = real(-1.0)
        return sign

    @wp.func
    def plane(p: vec3):
        """Half space z < 0."""
        return p[2], vec3(real(0.0), real(0.0), real(1.0))

    @wp.func
    def sphere(radius: real, p: vec3):
        """Ball about the origin."""
        n, length = direction(p, vec3(real(0.0), real(0.0), real(1.0)))
        return length - radius, n

    @wp.func
    def capsule(radius: real, length: real, p: vec3):
        """Ball swept along z between the centres +-length/2."""
        half = real(0.5) * length
        n, away = direction(vec3(p[0], p[1], p[2] - wp.clamp(p[2], -half, half)), vec3(real(1.0), real(0.0), real(0.0)))
        return away - radius, n

    @wp.func
    def box(size: vec3, p: vec3):
        """Box about the origin; inside, the nearest face counts (the last of equals)."""
        none = real(0.0)
        a = wp.abs(p[0]) - real(0.5) * size[0]
        b = wp.abs(p[1]) - real(0.5) * size[1]
        c = wp.abs(p[2]) - real(0.5) * size[2]
        d = wp.max(wp.max(a, b), c)
        n = vec3(side(p[0]), none, none)
        if c >= d:
            n = vec3(none, none, side(p[2]))
        elif b >= d:
            n = vec3(none, side(p[1]), none)
        if wp.min(wp.max(a, b), wp.max(wp.min(a, b), c)) > none:  # the middle one: an edge or a corner is nearest
            outside = vec3(side(p[0]) * wp.max(a, none), side(p[1]) * wp.max(b, none), side(p[2]) * wp.max(c, none))
            n, d = direction(outside, n)
        return d, n

    @wp.func
    def region_of(kind: int, size: vec3, p: vec3, n: vec3):
        """Which part of a shape is nearest to p, from the normal there: CORNER, EDGE or FACE."""
        region = int(FACE)
        if kind == wp.static(Target.CAPSULE):  # capsule: its axis is an edge, the ends of the axis are corners
            region = int(EDGE)
            if wp.abs(p[2]) >= real(0.5) * size[1]:
                region = int(CORNER)
        elif kind == wp.static(Target.BOX):
            zeros = int(0)
            for c in range(3):
                if wp.abs(n[c]) < real(ALIGNED):
                    zeros += 1
            if zeros == 1:
                region = int(EDGE)
            elif zeros == 0:
                region = int(CORNER)
        elif kind == wp.static(
            Target.CYLINDER
        ):  # cylinder: caps are faces, the mantle is an edge (its axis, rounded), rims are corners
            if wp.abs(n[2]) < real(ALIGNED):
                region = int(EDGE)
            elif wp.abs(n[2]) < real(1.0) - real(ALIGNED):
                region = int(CORNER)
        return region

    @wp.func
    def region_within(kind: int, size: vec3, p: vec3, border: real):
        """FACE where p is close to one face of a box or to a cap only, EDGE or CORNER within ``border`` of several."""
        near = int(0)
        if kind == wp.static(Target.BOX):
            for c in range(3):
                if wp.abs(p[c]) > real(0.5) * size[c] - border:
                    near += 1
        else:
            if wp.abs(p[2]) > real(0.5) * size[1] - border:
                near += 1
            if wp.sqrt(p[0] * p[0] + p[1] * p[1]) > size[0] - border:
                near += 1
        region = int(FACE)
        if near == 2:
            region = int(EDGE)
        elif near == 3:
            region = int(CORNER)
        return region

    @wp.func
    def box_slope(size: vec3, p: vec3, d: vec3):
        """n . d for the unit gradient n of the distance from a box, as ``box`` has it."""
        outside = vec3()
        farthest = int(0)
        away = real(-FAR)
        count = int(0)
        for c in range(3):
            gap = wp.abs(p[c]) - real(0.5) * size[c]
            if gap >= away:
                away = gap
                farthest = c
            if gap > real(0.0):
                outside[c] = wp.where(p[c] < real(0.0), -gap, gap)
                count += 1
        slope = wp.where(p[farthest] < real(0.0), -d[farthest], d[farthest])
        if count > 1:
            slope = wp.dot(outside, d) / wp.length(outside)
        return slope

    @wp.func
    def cylinder(radius: real, length: real, p: vec3):
        """Cylinder about z between +-length/2; inside, the nearer of mantle and caps counts."""
        radial, rho = direction(vec3(p[0], p[1], real(0.0)), vec3(real(1.0), real(0.0), real(0.0)))
        axial = vec3(real(0.0), real(0.0), side(p[2]))
        a = rho - radius
        b = wp.abs(p[2]) - real(0.5) * length
        d = a
        n = radial
        if b >= a:
            d = b
            n = axial
        if d > real(0.0):
            n, d = direction(wp.max(a, real(0.0)) * radial + wp.max(b, real(0.0)) * axial, n)
        return d, n

    @wp.func
    def distance(kind: int, size: vec3, p: vec3):
        """Signed distance d [m] and outward unit gradient n of a primitive; ``size`` is ``Shape.size``."""
        d, n = plane(p)
        if kind == wp.static(Target.SPHERE):
            d, n = sphere(size[0], p)
        elif kind == wp.static(Target.CAPSULE):
            d, n = capsule(size[0], size[1], p)
        elif kind == wp.static(Target.BOX):
            d, n = box(size, p)
        elif kind == wp.static(Target.CYLINDER):
            d, n = cylinder(size[0], size[1], p)
        return d, n

    @wp.func
    def grid(value: wp.array(dtype=real), start: int, nodes: wp.vec3i, origin: vec3, spacing: real, p: vec3):
        """Signed distance d [m] and unit gradient n from samples, node (i, j, k) at ``start + (i ny + j) nz + k``.

        Inside the grid d is the trilinear interpolant and n its normalized gradient. Outside, with the nearest point c
        of the grid, the surface is taken to lie at s = c - d(c) n(c); then d = |p - s|, n = (p - s) / d.
        """
        cell = wp.vec3i()
        t = vec3()
        away = vec3()  # from the nearest point of the grid, exactly zero inside
        for c in range(3):
            last = nodes[c] - 1
            u = (p[c] - origin[c]) / spacing
            inside = wp.clamp(u, real(0.0), real(last))
            cell[c] = wp.min(int(inside), last - 1)
            t[c] = inside - real(cell[c])
            away[c] = (u - inside) * spacing
        sz = int(1)
        sy = nodes[2]
        sx = nodes[1] * nodes[2]
        base = start + cell[0] * sx + cell[1] * sy + cell[2] * sz
        d = real(0.0)
        g = vec3()
        for i in range(2):
            for j in range(2):
                for k in range(2):
                    f = value[base + i * sx + j * sy + k * sz]
                    si = real(2 * i - 1)
                    sj = real(2 * j - 1)
                    sk = real(2 * k - 1)
                    wi = real(1 - i) + si * t[0]
                    wj = real(1 - j) + sj * t[1]
                    wk = real(1 - k) + sk * t[2]
                    d += f * wi * wj * wk
                    g += f * vec3(si * wj * wk, wi * sj * wk, wi * wj * sk)
        n, slope = direction(g, vec3(real(0.0), real(0.0), real(1.0)))
        if wp.max(wp.max(wp.abs(away[0]), wp.abs(away[1])), wp.abs(away[2])) > real(0.0):
            n, d = direction(away + d * n, n)
        return d, n

    @wp.func
    def grid_distance(value: wp.array(dtype=real), start: int, nodes: wp.vec3i, origin: vec3, spacing: real, p: vec3):
        """The distance of ``grid`` to the bit, without its gradient, which takes half of the time."""
        cell = wp.vec3i()
        t = vec3()
        beside = bool(False)
        for c in range(3):
            last = nodes[c] - 1
            u = (p[c] - origin[c]) / spacing
            inside = wp.clamp(u, real(0.0), real(last))
            cell[c] = wp.min(int(inside), last - 1)
            t[c] = inside - real(cell[c])
            if u != inside:
                beside = True
        d = real(0.0)
        if beside:
            d, n = grid(value, start, nodes, origin, spacing, p)
        else:
            base = start + (cell[0] * nodes[1] + cell[1]) * nodes[2] + cell[2]
            for i in range(2):
                for j in range(2):
                    for k in range(2):
                        f = value[base + (i * nodes[1] + j) * nodes[2] + k]
                        wi = real(1 - i) + real(2 * i - 1) * t[0]
                        wj = real(1 - j) + real(2 * j - 1) * t[1]
                        wk = real(1 - k) + real(2 * k - 1) * t[2]
                        d += f * wi * wj * wk
        return d

    @wp.kernel(module=module, enable_backward=False)
    def probe(
        # Samples in
        kind_in: wp.array(dtype=wp.int32),
        size_in: wp.array(dtype=vec3),
        point_in: wp.array(dtype=vec3),
        # Samples out
        distance_out: wp.array(dtype=real),
        normal_out: wp.array(dtype=vec3),
    ):
        """Distance and gradient of one analytic shape at one local point."""
        sample = wp.tid()
        d, n = distance(kind_in[sample], size_in[sample], point_in[sample])
        distance_out[sample] = d
        normal_out[sample] = n

    @wp.kernel(module=module, enable_backward=False)
    def probe_grid(
        # Model
        grid_value: wp.array(dtype=real),
        grid_nodes: wp.vec3i,
        grid_origin: vec3,
        grid_spacing: real,
        # Samples in
        point_in: wp.array(dtype=vec3),
        # Samples out
        distance_out: wp.array(dtype=real),
        normal_out: wp.array(dtype=vec3),
    ):
        """Distance and gradient of a grid at one local point."""
        sample = wp.tid()
        d, n = grid(grid_value, 0, grid_nodes, grid_origin, grid_spacing, point_in[sample])
        distance_out[sample] = d
        normal_out[sample] = n

    return SimpleNamespace(
        vec3=vec3,
        vec4=vec4,
        rotate=rotate,
        rotate_back=rotate_back,
        to_world=to_world,
        to_local=to_local,
        direction=direction,
        plane=plane,
        sphere=sphere,
        capsule=capsule,
        box=box,
        box_slope=box_slope,
        region_of=region_of,
        region_within=region_within,
        cylinder=cylinder,
        distance=distance,
        grid=grid,
        grid_distance=grid_distance,
        probe=probe,
        probe_grid=probe_grid,
    )
