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

    @wp.func
    def deformation(
        x: wp.array2d(dtype=S), w: int, tri: int, tri_node: wp.array2d(dtype=wp.int32), g: wp.array2d(dtype=real)
    ):
        """The columns F e_x, F e_y of the deformation gradient."""
        a = 3 * tri_node[tri, 0]
        b = 3 * tri_node[tri, 1]
        c = 3 * tri_node[tri, 2]
        b0 = x[w, b] - x[w, a]
        b1 = x[w, b + 1] - x[w, a + 1]
        b2 = x[w, b + 2] - x[w, a + 2]
        c0 = x[w, c] - x[w, a]
        c1 = x[w, c + 1] - x[w, a + 1]
        c2 = x[w, c + 2] - x[w, a + 2]
        return (
            b0 * g[tri, 0] + c0 * g[tri, 2],
            b1 * g[tri, 0] + c1 * g[tri, 2],
            b2 * g[tri, 0] + c2 * g[tri, 2],
            b0 * g[tri, 1] + c0 * g[tri, 3],
            b1 * g[tri, 1] + c1 * g[tri, 3],
            b2 * g[tri, 1] + c2 * g[tri, 3],
        )

    @wp.func
    def moduli(youngs: S, nu: S):
        """Shear modulus and plane-stress first Lame constant [Pa]."""
        one = S(real(1.0))
        return div(youngs, (one + nu) * real(2.0)), div(mul(youngs, nu), one - mul(nu, nu))

    @wp.func
    def stress(f0: S, f1: S, f2: S, h0: S, h1: S, h2: S, mu: S, lam: S):
        """Second Piola-Kirchhoff stress xx, xy, yy [Pa] of the columns f, h of F."""
        half = real(0.5)
        one = S(real(1.0))
        exx = (mul(f0, f0) + mul(f1, f1) + mul(f2, f2) - one) * half
        eyy = (mul(h0, h0) + mul(h1, h1) + mul(h2, h2) - one) * half
        exy = (mul(f0, h0) + mul(f1, h1) + mul(f2, h2)) * half
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
        f0, f1, f2, h0, h1, h2 = deformation(node_x_in, w, tri, tri_node, tri_gradient)
        sxx, sxy, syy = stress(f0, f1, f2, h0, h1, h2, mu, lam)
        volume = tri_volume[tri]
        row = 12 * (first + tri)
        t0 = S(real(0.0))
        t1 = S(real(0.0))
        t2 = S(real(0.0))
        for b in range(2):
            gx = tri_gradient[tri, 2 * b] * volume
            gy = tri_gradient[tri, 2 * b + 1] * volume
            sx = sxx * gx + sxy * gy
            sy = sxy * gx + syy * gy
            r0 = mul(f0, sx) + mul(h0, sy)
            r1 = mul(f1, sx) + mul(h1, sy)
            r2 = mul(f2, sx) + mul(h2, sy)
            k = row + 3 * b + 3
            element_force_out[w, k] = r0
            element_force_out[w, k + 1] = r1
            element_force_out[w, k + 2] = r2
            t0 -= r0
            t1 -= r1
            t2 -= r2
        element_force_out[w, row] = t0
        element_force_out[w, row + 1] = t1
        element_force_out[w, row + 2] = t2
        for c in range(3):
            element_force_out[w, row + 9 + c] = S(real(0.0))

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
        f0, f1, f2, h0, h1, h2 = deformation(node_x_in, w, tri, tri_node, tri_gradient)
        sxx, sxy, syy = stress(f0, f1, f2, h0, h1, h2, mu, lam)
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
            p0 = f0 * ax + h0 * ay
            p1 = f1 * ax + h1 * ay
            p2 = f2 * ax + h2 * ay
            for b in range(a + 1):
                bx = tri_gradient[tri, wp.max(2 * b - 2, 0)]
                by = tri_gradient[tri, wp.max(2 * b - 1, 1)]
                if b == 0:
                    bx = -tri_gradient[tri, 0] - tri_gradient[tri, 2]
                    by = -tri_gradient[tri, 1] - tri_gradient[tri, 3]
                q0 = f0 * bx + h0 * by
                q1 = f1 * bx + h1 * by
                q2 = f2 * bx + h2 * by
                m = mu * volume
                e = lam * volume
                n = m * (ax * bx + ay * by)
                s = (sxx * (ax * bx) + sxy * (ax * by + ay * bx) + syy * (ay * by)) * volume
                k = start + ((a * (a + 1)) // 2 + b) * 9
                element_stiffness_out[w, k] = mul(n, mul(f0, f0) + mul(h0, h0)) + mul(m + e, mul(p0, q0)) + s
                element_stiffness_out[w, k + 4] = mul(n, mul(f1, f1) + mul(h1, h1)) + mul(m + e, mul(p1, q1)) + s
                element_stiffness_out[w, k + 8] = mul(n, mul(f2, f2) + mul(h2, h2)) + mul(m + e, mul(p2, q2)) + s
                c01 = mul(n, mul(f0, f1) + mul(h0, h1))
                c02 = mul(n, mul(f0, f2) + mul(h0, h2))
                c12 = mul(n, mul(f1, f2) + mul(h1, h2))
                element_stiffness_out[w, k + 1] = c01 + mul(m, mul(q0, p1)) + mul(e, mul(p0, q1))
                element_stiffness_out[w, k + 2] = c02 + mul(m, mul(q0, p2)) + mul(e, mul(p0, q2))
                element_stiffness_out[w, k + 3] = c01 + mul(m, mul(q1, p0)) + mul(e, mul(p1, q0))
                element_stiffness_out[w, k + 5] = c12 + mul(m, mul(q1, p2)) + mul(e, mul(p1, q2))
                element_stiffness_out[w, k + 6] = c02 + mul(m, mul(q2, p0)) + mul(e, mul(p2, q0))
                element_stiffness_out[w, k + 7] = c12 + mul(m, mul(q2, p1)) + mul(e, mul(p2, q1))

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
        f0, f1, f2, h0, h1, h2 = deformation(node_x_in, w, tri, tri_node, tri_gradient)
        sxx, sxy, syy = stress(f0, f1, f2, h0, h1, h2, mu, lam)
        tri_stress_out[w, 3 * tri] = sxx
        tri_stress_out[w, 3 * tri + 1] = sxy
        tri_stress_out[w, 3 * tri + 2] = syy

    return SimpleNamespace(
        triangle_force=triangle_force, triangle_stiffness=triangle_stiffness, triangle_stress=triangle_stress
    )
