"""Directional derivatives of ``large`` and ``warped`` tetrahedra in a step. Theory: docs/theory/adjoint.md.

With a rotation R that turns by dR = R [w], M = R'F and eps = sym M - 1, the forces h R s(eps) + k gamma R s(sym R'Y) of
``turned_adjoint`` change by

    R ([w] (h s(eps) + k gamma s(sym R'Y)) + h s(sym dM) + k gamma s(sym dYr) + d(k gamma) s(sym R'Y)),
    dM = R'D - [w] M,   dYr = -[w] R'Y,

where D is the direction of F. The frame of two edges e, f with e1 || e, e3 || e x f turns by w with e2.w = -e3.de/|e|,
e3.w = e2.de/|e| and e1.w = (e3.df + (e2.w) (e1.f)) / (e2.f).
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.algebra.vectors import algebra
from softwarp.kernels.elements import access, corotational, turned_adjoint


@cache
def kernels(variant: Variant, is_large: bool) -> SimpleNamespace:
    """Directional derivatives of tets with the law ``large``, or else ``warped``."""
    at = access.functions(variant)
    inner = at.inner
    S, T, real, world_fastest = variant.S, inner.S, variant.real, variant.world_fastest
    mul, div, sqrt, any_positive = inner.mul, inner.div, inner.sqrt, inner.any_positive
    module = variant.module(f"directional.{'large' if is_large else 'warped'}")
    a, f = algebra(inner), turned_adjoint.functions(inner)
    depth_below = corotational.functions(inner).depth_below
    Vector, Matrix, row_x, row_y, row_z = a.Vector, a.Matrix, a.row_x, a.row_y, a.row_z
    add, scaled, dot, cross = a.add, a.scaled, a.dot, a.cross
    matmul, matvec, crossmul, summed, symmetric_part = a.matmul, a.matvec, a.crossmul, a.summed, a.symmetric_part
    transposed = a.transposed
    times, ddot, shifted, stress, axial = f.times, f.ddot, f.shifted, f.stress, f.axial
    skew, unturned, tensor_cross, guarded = f.skew, f.unturned, f.tensor_cross, f.guarded
    edges, gradients, of_body, of_tet, of_scene = at.edges, at.gradients, at.of_body, at.of_tet, at.of_scene
    write_corners = at.write_corners
    shared = turned_adjoint.shared(variant, is_large)
    rotation, squares = shared.rotation, shared.squares

    @wp.func
    def spin_of_edges(e: Vector, f_: Vector, de: Vector, df: Vector):
        """How the frame of two edges turns, in world axes."""
        one = T(real(1.0))
        inverse = div(one, sqrt(dot(e, e)))
        e1 = scaled(e, inverse)
        e3 = cross(e1, f_)
        e3 = scaled(e3, div(one, sqrt(dot(e3, e3))))
        e2 = cross(e3, e1)
        second = -mul(dot(e3, de), inverse)
        third = mul(dot(e2, de), inverse)
        first = div(dot(e3, df) + mul(second, dot(e1, f_)), dot(e2, f_))
        return add(add(scaled(e1, first), scaled(e2, second)), scaled(e3, third))

    @wp.kernel(module=module, enable_backward=False)
    def tet_direction(
        # Model
        tet_index: wp.array(dtype=wp.int32),
        tet_node: wp.array2d(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        tet_gradient: wp.array2d(dtype=real),
        tet_volume: wp.array(dtype=real),
        tet_size: wp.array(dtype=real),
        tet_frame: wp.array2d(dtype=real),
        body_guard: wp.array(dtype=real),
        # Workspace in
        body_mu_in: wp.array2d(dtype=S),
        body_lam_in: wp.array2d(dtype=S),
        body_stiffness_in: wp.array2d(dtype=S),
        mu_slope_in: wp.array2d(dtype=S),
        lam_slope_in: wp.array2d(dtype=S),
        stiffness_slope_in: wp.array2d(dtype=S),
        node_x_in: wp.array2d(dtype=S),
        node_v_in: wp.array2d(dtype=S),
        x_slope_in: wp.array2d(dtype=S),
        h: real,
        # Workspace out
        corner_out: wp.array2d(dtype=S),
    ):
        """What one tet, or eight, add to the right-hand side at their corners."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        one = T(real(1.0))
        g = gradients(tet_gradient, tet_index, item)
        e = edges(node_x_in, w, tet_node, tet_index, item)
        de = edges(x_slope_in, w, tet_node, tet_index, item)
        F = crossmul(e, g)
        D = crossmul(de, g)
        R = rotation(e, gradients(tet_frame, tet_index, item), F)
        M = crossmul(R, F)
        Dr = crossmul(R, D)
        Yr = crossmul(R, crossmul(edges(node_v_in, w, tet_node, tet_index, item), g))
        mu = of_body(body_mu_in, w, tet_body, tet_index, item)
        lam = of_body(body_lam_in, w, tet_body, tet_index, item)
        k = of_body(body_stiffness_in, w, tet_body, tet_index, item)
        dmu = of_body(mu_slope_in, w, tet_body, tet_index, item)
        dlam = of_body(lam_slope_in, w, tet_body, tet_index, item)
        dk = of_body(stiffness_slope_in, w, tet_body, tet_index, item)
        guard = of_scene(body_guard, tet_body, tet_index, item)
        strain = shifted(symmetric_part(M), -one)
        Ys = symmetric_part(Yr)
        upright = Matrix()
        depth = depth_below(guard, e, of_tet(tet_size, tet_index, item))
        if any_positive(depth):
            stiff = mu + mu + lam
            G = times(tensor_cross(F, F), T(real(0.5)))
            gamma, by_gamma, push, slope = guarded(F, G, squares(g), depth, guard)
            upright = summed(times(G, mul(slope, ddot(G, D))), times(tensor_cross(F, D), push))
            upright = summed(times(upright, stiff * h), times(G, mul(push, dmu + dmu + dlam) * h))
            dk = mul(dk, gamma) + mul(k, ddot(by_gamma, D))
            k = mul(k, gamma)
        spin = axial(Dr)
        if wp.static(is_large):
            spin = matvec(transposed(R), spin_of_edges(row_x(e), row_y(e), row_x(de), row_y(de)))
        else:
            spin = unturned(symmetric_part(M), spin)
        turn = skew(spin)
        dM = symmetric_part(summed(Dr, times(matmul(turn, M), -one)))
        dY = symmetric_part(times(matmul(turn, Yr), -one))
        held = times(stress(strain, mu, lam), one * h)
        held = summed(held, times(stress(Ys, mu, lam), k))
        force = matmul(turn, held)
        force = summed(force, stress(summed(times(dM, one * h), times(dY, k)), mu, lam))
        force = summed(force, times(stress(Ys, mu, lam), dk))
        force = summed(force, stress(summed(times(strain, one * h), times(Ys, k)), dmu, dlam))
        force = times(summed(matmul(R, force), upright), -of_tet(tet_volume, tet_index, item))
        b = matvec(force, row_x(g))
        c = matvec(force, row_y(g))
        write_corners(corner_out, w, tet_index, item, b, c, matvec(force, row_z(g)))

    return SimpleNamespace(tet_direction=tet_direction)
