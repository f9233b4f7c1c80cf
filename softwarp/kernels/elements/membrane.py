"""Thin triangles in plane stress, glued to the nodes of a body or free. Theory: docs/theory/membrane.md.

St. Venant-Kirchhoff law of the strain in the plane: F = sum (x_b - x_a) g_b' (3x2), E = (F'F - 1)/2,
S = 2 mu E + lam tr(E) 1 with mu = Y / (2 (1 + nu)) and the lam of plane stress, Y nu / (1 - nu^2). A triangle resists
stretch and shear in its plane, whatever its rotation, and neither bending nor pressure across its thickness.

Elements count from ``first`` in the solver's arrays: 12 force and 90 stiffness rows each, as of a tet whose corner 3 is
missing.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.algebra.vectors import algebra

TINY = 1.0e-20  # Pa, keeps the ratio of two principal stresses defined where they are equal


@cache
def kernels(variant: Variant, project: bool) -> SimpleNamespace:
    """Membrane kernels for one scalar type.

    Args:
        variant: Scalar type and memory order.
        project: Whether compressive stress is left out of the geometric stiffness, which makes the tangent positive
            semidefinite; else the tangent is exact.
    """
    S = variant.S
    real = variant.real
    mul, div, sqrt = variant.mul, variant.div, variant.sqrt
    world_fastest = variant.world_fastest
    module = variant.module(f"membrane.{'spd' if project else 'exact'}")

    a = algebra(variant)
    Vector, vector, rows, read_vector = a.Vector, a.vector, a.rows, a.read_vector
    write_vector, write_matrix = a.write_vector, a.write_matrix
    add, subtract, scaled, dot = a.add, a.subtract, a.scaled, a.dot

    @wp.func
    def deformation(
        x: wp.array2d(dtype=S), w: int, tri: int, tri_node: wp.array2d(dtype=wp.int32), g: wp.array2d(dtype=real)
    ):
        """The columns F e_x, F e_y of the deformation gradient."""
        origin = read_vector(x, w, 3 * tri_node[tri, 0])
        b = subtract(read_vector(x, w, 3 * tri_node[tri, 1]), origin)
        c = subtract(read_vector(x, w, 3 * tri_node[tri, 2]), origin)
        return (
            add(scaled(b, S(g[tri, 0])), scaled(c, S(g[tri, 2]))),
            add(scaled(b, S(g[tri, 1])), scaled(c, S(g[tri, 3]))),
        )

    @wp.func
    def moduli(youngs: S, nu: S):
        """Shear modulus and plane-stress first Lame constant [Pa]."""
        one = S(real(1.0))
        return div(youngs, (one + nu) * real(2.0)), div(mul(youngs, nu), one - mul(nu, nu))

    @wp.func
    def stress(f: Vector, h: Vector, mu: S, lam: S):
        """Second Piola-Kirchhoff stress xx, xy, yy [Pa] of the columns f, h of F."""
        half = real(0.5)
        one = S(real(1.0))
        exx = (dot(f, f) - one) * half
        eyy = (dot(h, h) - one) * half
        exy = dot(f, h) * half
        pressure = mul(lam, exx + eyy)
        two_mu = mu + mu
        return mul(two_mu, exx) + pressure, mul(two_mu, exy), mul(two_mu, eyy) + pressure

    @wp.func
    def tension(sxx: S, sxy: S, syy: S):
        """The stress without its negative principal values."""
        zero = S(real(0.0))
        half = real(0.5)
        mean = (sxx + syy) * half
        difference = (sxx - syy) * half
        radius = sqrt(mul(difference, difference) + mul(sxy, sxy))
        low = wp.max(mean - radius, zero)
        share = div(wp.max(mean + radius, zero) - low, wp.max(radius + radius, S(real(wp.static(TINY)))))
        least = mean - radius
        return mul(share, sxx - least) + low, mul(share, sxy), mul(share, syy - least) + low

    @wp.func
    def tangent(f: Vector, h: Vector, p: Vector, q: Vector, n: S, m: S, e: S, s: S):
        """n F F' + m q p' + e p q' + s 1, with the columns f, h of F."""
        both = m + e
        xy = mul(n, mul(f.x, f.y) + mul(h.x, h.y))
        xz = mul(n, mul(f.x, f.z) + mul(h.x, h.z))
        yz = mul(n, mul(f.y, f.z) + mul(h.y, h.z))
        return rows(
            vector(
                mul(n, mul(f.x, f.x) + mul(h.x, h.x)) + mul(both, mul(p.x, q.x)) + s,
                xy + mul(m, mul(q.x, p.y)) + mul(e, mul(p.x, q.y)),
                xz + mul(m, mul(q.x, p.z)) + mul(e, mul(p.x, q.z)),
            ),
            vector(
                xy + mul(m, mul(q.y, p.x)) + mul(e, mul(p.y, q.x)),
                mul(n, mul(f.y, f.y) + mul(h.y, h.y)) + mul(both, mul(p.y, q.y)) + s,
                yz + mul(m, mul(q.y, p.z)) + mul(e, mul(p.y, q.z)),
            ),
            vector(
                xz + mul(m, mul(q.z, p.x)) + mul(e, mul(p.z, q.x)),
                yz + mul(m, mul(q.z, p.y)) + mul(e, mul(p.z, q.y)),
                mul(n, mul(f.z, f.z) + mul(h.z, h.z)) + mul(both, mul(p.z, q.z)) + s,
            ),
        )

    @wp.kernel(module=module, enable_backward=False)
    def triangle_force(
        # Model
        first: int,
        tri_node: wp.array2d(dtype=wp.int32),
        tri_membrane: wp.array(dtype=wp.int32),
        tri_gradient: wp.array2d(dtype=real),
        tri_volume: wp.array(dtype=real),
        # Workspace in
        membrane_youngs_in: wp.array2d(dtype=S),
        membrane_nu_in: wp.array2d(dtype=S),
        node_x_in: wp.array2d(dtype=S),
        # Workspace out
        element_force_out: wp.array2d(dtype=S),
    ):
        """Elastic corner forces dE/dx = V F S g [N] of one triangle; zero at the empty corner."""
        w, tri = wp.tid()
        if wp.static(world_fastest):
            tri, w = wp.tid()
        membrane = tri_membrane[tri]
        mu, lam = moduli(membrane_youngs_in[w, membrane], membrane_nu_in[w, membrane])
        f, h = deformation(node_x_in, w, tri, tri_node, tri_gradient)
        sxx, sxy, syy = stress(f, h, mu, lam)
        volume = tri_volume[tri]
        row = 12 * (first + tri)
        none = S(real(0.0))
        nothing = vector(none, none, none)
        total = nothing
        for b in range(2):
            gx = tri_gradient[tri, 2 * b] * volume
            gy = tri_gradient[tri, 2 * b + 1] * volume
            sx = sxx * gx + sxy * gy
            sy = sxy * gx + syy * gy
            force = add(scaled(f, sx), scaled(h, sy))
            write_vector(element_force_out, w, row + 3 * b + 3, force)
            total = subtract(total, force)
        write_vector(element_force_out, w, row, total)
        write_vector(element_force_out, w, row + 9, nothing)

    @wp.kernel(module=module, enable_backward=False)
    def triangle_stiffness(
        # Model
        first: int,
        tri_node: wp.array2d(dtype=wp.int32),
        tri_membrane: wp.array(dtype=wp.int32),
        tri_gradient: wp.array2d(dtype=real),
        tri_volume: wp.array(dtype=real),
        # Workspace in
        membrane_youngs_in: wp.array2d(dtype=S),
        membrane_nu_in: wp.array2d(dtype=S),
        node_x_in: wp.array2d(dtype=S),
        # Workspace out
        element_stiffness_out: wp.array2d(dtype=S),
    ):
        """The blocks K_ab, 2 >= a >= b, of one triangle [N/m]; those of the empty corner are left as they are.

        K_ab = V (mu ((ga . gb) F F' + (F gb) (F ga)') + lam (F ga) (F gb)' + (ga . S gb) 1).
        """
        w, tri = wp.tid()
        if wp.static(world_fastest):
            tri, w = wp.tid()
        membrane = tri_membrane[tri]
        mu, lam = moduli(membrane_youngs_in[w, membrane], membrane_nu_in[w, membrane])
        f, h = deformation(node_x_in, w, tri, tri_node, tri_gradient)
        sxx, sxy, syy = stress(f, h, mu, lam)
        if wp.static(project):
            sxx, sxy, syy = tension(sxx, sxy, syy)
        volume = tri_volume[tri]
        start = 90 * (first + tri)
        for a in range(3):
            ax = tri_gradient[tri, wp.max(2 * a - 2, 0)]
            ay = tri_gradient[tri, wp.max(2 * a - 1, 1)]
            if a == 0:
                ax = -tri_gradient[tri, 0] - tri_gradient[tri, 2]
                ay = -tri_gradient[tri, 1] - tri_gradient[tri, 3]
            p = add(scaled(f, S(ax)), scaled(h, S(ay)))
            for b in range(a + 1):
                bx = tri_gradient[tri, wp.max(2 * b - 2, 0)]
                by = tri_gradient[tri, wp.max(2 * b - 1, 1)]
                if b == 0:
                    bx = -tri_gradient[tri, 0] - tri_gradient[tri, 2]
                    by = -tri_gradient[tri, 1] - tri_gradient[tri, 3]
                q = add(scaled(f, S(bx)), scaled(h, S(by)))
                m = mu * volume
                e = lam * volume
                n = m * (ax * bx + ay * by)
                s = (sxx * (ax * bx) + sxy * (ax * by + ay * bx) + syy * (ay * by)) * volume
                k = start + ((a * (a + 1)) // 2 + b) * 9
                write_matrix(element_stiffness_out, w, k, tangent(f, h, p, q, n, m, e, s))

    @wp.kernel(module=module, enable_backward=False)
    def triangle_stress(
        # Model
        tri_node: wp.array2d(dtype=wp.int32),
        tri_membrane: wp.array(dtype=wp.int32),
        tri_gradient: wp.array2d(dtype=real),
        # Workspace in
        membrane_youngs_in: wp.array2d(dtype=S),
        membrane_nu_in: wp.array2d(dtype=S),
        node_x_in: wp.array2d(dtype=S),
        # Workspace out
        tri_stress_out: wp.array2d(dtype=S),
    ):
        """Second Piola-Kirchhoff stress xx, xy, yy [Pa] of one triangle in its rest axes: x along its first edge."""
        w, tri = wp.tid()
        if wp.static(world_fastest):
            tri, w = wp.tid()
        membrane = tri_membrane[tri]
        mu, lam = moduli(membrane_youngs_in[w, membrane], membrane_nu_in[w, membrane])
        f, h = deformation(node_x_in, w, tri, tri_node, tri_gradient)
        sxx, sxy, syy = stress(f, h, mu, lam)
        tri_stress_out[w, 3 * tri] = sxx
        tri_stress_out[w, 3 * tri + 1] = sxy
        tri_stress_out[w, 3 * tri + 2] = syy

    return SimpleNamespace(
        triangle_force=triangle_force, triangle_stiffness=triangle_stiffness, triangle_stress=triangle_stress
    )
