"""Forces of isotropic hyperelastic tetrahedra. Theory, symbols and checks: docs/theory/hyperelastic.md.

The deformation gradient of a linear tetrahedron is F = sum (x_b - x_a) g_b', and the corner forces are V P g. The
stress of a law is P = a F + b cof F + c F F'F, with numbers a, b, c that depend on I1 = F:F, I2 = |cof F|^2 and
J = det F; or, with F = U diag(s) V', it is U diag(psi_i) V'. ``spectral`` has the tangent.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import principal
from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.algebra.vectors import algebra
from softwarp.kernels.elements import access
from softwarp.kernels.elements.laws import LAWS, lane_parameters, law_parameters


@cache
def kernels(variant: Variant, law: str) -> SimpleNamespace:
    """Forces by one law.

    Args:
        variant: Scalar type and memory order.
        law: One of ``laws.LAWS``.
    """
    return _by_slopes(variant, law) if LAWS[law].invariants is None else _by_invariants(variant, law)


def _by_invariants(variant: Variant, law: str) -> SimpleNamespace:
    at = access.functions(variant)
    inner, entry, of_lane, member, place_of = at.inner, at.entry, at.of_lane, at.member, at.place_of
    edges, gradients, write_corners, of_tet = at.edges, at.gradients, at.write_corners, at.of_tet
    S, T, real, world_fastest, lane_count = variant.S, inner.S, variant.real, variant.world_fastest, inner.lanes
    mul, module = inner.mul, variant.module(f"hyperelastic.{law}")
    invariants_of, parameters, is_cubic = LAWS[law].invariants, law_parameters(real, law), LAWS[law].is_cubic
    table = wp.types.matrix((3, lane_count), real)  # of every element: V a, V b, V c
    together = LAWS[law].lanes.invariants if lane_count > 1 and LAWS[law].lanes else None
    gather = lane_parameters(at, real, law, variant.lanes > 1) if together else None
    a = algebra(inner)
    Matrix, rows, row_x, row_y, row_z, cross, dot = a.Matrix, a.rows, a.row_x, a.row_y, a.row_z, a.cross, a.dot
    crossmul, matmul, matvec, gram, scaled, summed = a.crossmul, a.matmul, a.matvec, a.gram, a.scaled, a.summed

    @wp.func
    def coefficients_each(
        I1: T,
        I2: T,
        J: T,
        w: int,
        item: int,
        tet_index: wp.array(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        tet_volume: wp.array(dtype=real),
        body_law_start: wp.array(dtype=wp.int32),
        body_mu: wp.array3d(dtype=real),
        body_lam: wp.array3d(dtype=real),
        law_parameter: wp.array3d(dtype=real),
    ):
        """Of every lane: V a, V b, V c."""
        found = table()
        count = int(wp.static(lane_count))
        for lane in range(count):
            tet = member(tet_index, item, lane)
            pack, place = place_of(w, lane)
            p = parameters(body_law_start, body_mu, body_lam, law_parameter, pack, tet_body[tet], place)
            a, b, c = invariants_of(of_lane(I1, lane), of_lane(I2, lane), of_lane(J, lane), p)
            found[0, lane] = a * tet_volume[tet]
            found[1, lane] = b * tet_volume[tet]
            found[2, lane] = c * tet_volume[tet]
        return found

    @wp.func
    def coefficients_together(
        I1: T,
        I2: T,
        J: T,
        w: int,
        item: int,
        tet_index: wp.array(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        tet_volume: wp.array(dtype=real),
        body_law_start: wp.array(dtype=wp.int32),
        body_mu: wp.array3d(dtype=real),
        body_lam: wp.array3d(dtype=real),
        law_parameter: wp.array3d(dtype=real),
    ):
        """The same where the law takes all lanes at a time."""
        p = gather(w, item, tet_index, tet_body, body_law_start, body_mu, body_lam, law_parameter)
        volume = of_tet(tet_volume, tet_index, item)
        found = together(I1, I2, J, p)
        return wp.matrix_from_rows(mul(found[0], volume), mul(found[1], volume), mul(found[2], volume))

    coefficients = coefficients_together if together else coefficients_each

    @wp.func
    def times(m: Matrix, s: T):
        return rows(scaled(row_x(m), s), scaled(row_y(m), s), scaled(row_z(m), s))

    @wp.func
    def square(m: Matrix):
        return dot(row_x(m), row_x(m)) + dot(row_y(m), row_y(m)) + dot(row_z(m), row_z(m))

    @wp.kernel(module=module, enable_backward=False)
    def tet_force(
        # Model
        tet_index: wp.array(dtype=wp.int32),
        tet_node: wp.array2d(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        tet_gradient: wp.array2d(dtype=real),
        tet_volume: wp.array(dtype=real),
        body_law_start: wp.array(dtype=wp.int32),
        # Workspace in
        body_mu_in: wp.array3d(dtype=real),
        body_lam_in: wp.array3d(dtype=real),
        law_parameter_in: wp.array3d(dtype=real),
        node_x_in: wp.array2d(dtype=S),
        # Workspace out
        tet_force_out: wp.array2d(dtype=S),
    ):
        """Elastic corner forces dE/dx [N] of one tet, or of eight."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        g = gradients(tet_gradient, tet_index, item)
        F = crossmul(edges(node_x_in, w, tet_node, tet_index, item), g)
        G = rows(cross(row_y(F), row_z(F)), cross(row_z(F), row_x(F)), cross(row_x(F), row_y(F)))
        found = coefficients(
            square(F),
            square(G),
            dot(row_x(F), row_x(G)),
            w,
            item,
            tet_index,
            tet_body,
            tet_volume,
            body_law_start,
            body_mu_in,
            body_lam_in,
            law_parameter_in,
        )
        P = summed(times(F, entry(found, 0)), times(G, entry(found, 1)))
        if wp.static(is_cubic):
            P = summed(P, times(matmul(F, gram(F, F)), entry(found, 2)))
        b = matvec(P, row_x(g))
        c = matvec(P, row_y(g))
        d = matvec(P, row_z(g))
        write_corners(tet_force_out, w, tet_index, item, b, c, d)

    return SimpleNamespace(tet_force=tet_force)


def _by_slopes(variant: Variant, law: str) -> SimpleNamespace:
    at = access.functions(variant)
    inner, entry, of_lane, member, place_of = at.inner, at.entry, at.of_lane, at.member, at.place_of
    edges, gradients, write_corners, of_tet = at.edges, at.gradients, at.write_corners, at.of_tet
    S, real, world_fastest, lane_count, mul = variant.S, variant.real, variant.world_fastest, inner.lanes, inner.mul
    module = variant.module(f"hyperelastic.{law}")
    slopes_of, parameters, vec3 = LAWS[law].slopes, law_parameters(real, law), wp.types.vector(3, real)
    table = wp.types.matrix((3, lane_count), real)  # of every element: V psi_i
    together = LAWS[law].lanes.slopes if lane_count > 1 and LAWS[law].lanes else None
    gather = lane_parameters(at, real, law, variant.lanes > 1) if together else None
    a = algebra(inner)
    Vector, vector, row_x, row_y, row_z = a.Vector, a.vector, a.row_x, a.row_y, a.row_z
    crossmul, matvec, combination, product = a.crossmul, a.matvec, a.combination, a.product
    decomposition = principal.functions(inner)
    decomposed = decomposition.stretches if together and LAWS[law].is_upright else decomposition.singular_values

    @wp.func
    def stress_each(
        s: Vector,
        w: int,
        item: int,
        tet_index: wp.array(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        tet_volume: wp.array(dtype=real),
        body_law_start: wp.array(dtype=wp.int32),
        body_mu: wp.array3d(dtype=real),
        body_lam: wp.array3d(dtype=real),
        law_parameter: wp.array3d(dtype=real),
    ):
        """Of every lane: V psi_i."""
        c = table()
        count = int(wp.static(lane_count))
        for lane in range(count):
            tet = member(tet_index, item, lane)
            pack, place = place_of(w, lane)
            p = parameters(body_law_start, body_mu, body_lam, law_parameter, pack, tet_body[tet], place)
            psi = slopes_of(vec3(of_lane(s.x, lane), of_lane(s.y, lane), of_lane(s.z, lane)), p)
            for k in range(3):
                c[k, lane] = psi[k] * tet_volume[tet]
        return c

    @wp.func
    def stress_together(
        s: Vector,
        w: int,
        item: int,
        tet_index: wp.array(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        tet_volume: wp.array(dtype=real),
        body_law_start: wp.array(dtype=wp.int32),
        body_mu: wp.array3d(dtype=real),
        body_lam: wp.array3d(dtype=real),
        law_parameter: wp.array3d(dtype=real),
    ):
        """The same where the law takes all lanes at a time."""
        p = gather(w, item, tet_index, tet_body, body_law_start, body_mu, body_lam, law_parameter)
        volume = of_tet(tet_volume, tet_index, item)
        psi = together(s.x, s.y, s.z, p)
        return wp.matrix_from_rows(mul(psi[0], volume), mul(psi[1], volume), mul(psi[2], volume))

    principal_stress = stress_together if together else stress_each

    @wp.kernel(module=module, enable_backward=False)
    def tet_force(
        # Model
        tet_index: wp.array(dtype=wp.int32),
        tet_node: wp.array2d(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        tet_gradient: wp.array2d(dtype=real),
        tet_volume: wp.array(dtype=real),
        body_law_start: wp.array(dtype=wp.int32),
        # Workspace in
        body_mu_in: wp.array3d(dtype=real),
        body_lam_in: wp.array3d(dtype=real),
        law_parameter_in: wp.array3d(dtype=real),
        node_x_in: wp.array2d(dtype=S),
        # Workspace out
        tet_force_out: wp.array2d(dtype=S),
    ):
        """Elastic corner forces dE/dx [N] of one tet, or of eight."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        g = gradients(tet_gradient, tet_index, item)
        F = crossmul(edges(node_x_in, w, tet_node, tet_index, item), g)
        r = decomposed(F)
        psi = principal_stress(
            r.s,
            w,
            item,
            tet_index,
            tet_body,
            tet_volume,
            body_law_start,
            body_mu_in,
            body_lam_in,
            law_parameter_in,
        )
        scale = vector(entry(psi, 0), entry(psi, 1), entry(psi, 2))
        b = combination(product(scale, matvec(r.v, row_x(g))), r.u)
        c = combination(product(scale, matvec(r.v, row_y(g))), r.u)
        d = combination(product(scale, matvec(r.v, row_z(g))), r.u)
        write_corners(tet_force_out, w, tet_index, item, b, c, d)

    return SimpleNamespace(tet_force=tet_force)
