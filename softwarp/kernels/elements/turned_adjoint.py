"""Gradients of ``large`` and ``warped`` tetrahedra in a step. Theory: docs/theory/adjoint.md; ``adjoint``.

With a rotation R, M = R'F, eps = sym M - 1 and s(e) = 2 mu e + lam tr(e) 1, a tet has the forces P = R s(eps), and in
A the tangent V k gamma s(sym R'Y) : R'X, which leaves out how R turns; the gradient does not. For

    S = h s(eps) : R'X + k gamma s(sym R'Y) : R'X

it is h R s(sym R'X) by F at a fixed R, and by R with Xs = sym R'X, Ys = sym R'Y

    h (F s(Xs) + X s(eps)) + k gamma (X s(Ys) + Y s(Xs)).

The rotation of ``large`` turns with two edges as ``turning`` has it, that of ``warped`` with F as ``adjoint`` has it.
Below the guard of ``corotational`` there are the forces of an energy U(J), and gamma grows.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.elements import adjoint
from softwarp.kernels.elements.corotational import GUARD, GUARD_GROWTH, GUARD_RAMP, GUARD_TANGENT


@cache
def kernels(variant: Variant, is_large: bool) -> SimpleNamespace:
    """Gradients of tets with the law ``large``, or else ``warped``."""
    f, turned = adjoint.functions(variant), adjoint.polar(variant)
    real, vec3, mat33 = variant.real, f.vec3, f.mat33
    module = variant.module(f"adjoint.{'large' if is_large else 'warped'}")
    decomposed, gradient_at, gradient_of, edge = f.decomposed, f.gradient_at, f.gradient_of, f.edge
    tensor_cross, put_corners = f.tensor_cross, f.put_corners
    axial, turning = turned.axial, turned.turning
    put = single.functions(variant).put

    @wp.func
    def symmetric(A: mat33):
        return real(0.5) * (A + wp.transpose(A))

    @wp.func
    def stress(e: mat33, mu: real, lam: real):
        return real(2.0) * mu * e + lam * wp.trace(e) * wp.identity(n=3, dtype=real)

    @wp.func
    def upright(J: real, guard: real):
        """U'(J) over lam + 2 mu."""
        depth = wp.max(real(0.0), guard - J)
        relative = wp.min(depth / guard, real(1.0))
        return -real(GUARD) * (depth + real(GUARD_GROWTH) * depth * relative * relative)

    @wp.func
    def gamma(F: mat33, N: mat33, guard: real):
        """Factor of the stiffness; N = sum g g' over the four corners."""
        G = real(0.5) * tensor_cross(F, F)
        depth = wp.max(real(0.0), guard - wp.determinant(F))
        relative = wp.min(depth / guard, real(1.0))
        slope = real(1.0) + real(3.0 * GUARD_GROWTH) * relative * relative
        widened = wp.max(wp.ddot(G * N, G) / wp.trace(N), real(1.0))
        return real(1.0) + wp.min(depth * real(GUARD_RAMP), real(1.0)) * slope * widened * real(GUARD_TANGENT)

    @wp.func
    def rest_frame(values: wp.array2d(dtype=real), tet: int):
        return wp.matrix_from_rows(
            gradient_at(values, tet, 0), gradient_at(values, tet, 1), gradient_at(values, tet, 2)
        )

    @wp.func
    def rotation(e: vec3, f_: vec3, R0: mat33, F: mat33):
        """R, and for ``warped`` what its spin follows from."""
        if wp.static(is_large):
            e1 = wp.normalize(e)
            e3 = wp.normalize(wp.cross(e1, f_))
            return wp.matrix_from_cols(e1, wp.cross(e3, e1), e3) * wp.transpose(R0), mat33()
        U, s, V = decomposed(F)
        return U * wp.transpose(V), turning(U, s, V)

    @wp.func
    def by_edges(t: vec3, e: vec3, f_: vec3):
        """Gradients by the two edges that turn the frame by w, from that by w."""
        length = wp.length(e)
        e1 = e / length
        e3 = wp.normalize(wp.cross(e1, f_))
        e2 = wp.cross(e3, e1)
        second = e3 * (wp.dot(e1, t) / wp.dot(f_, e2))
        first = (e2 * wp.dot(e3, t) - e3 * wp.dot(e2, t)) / length - (wp.dot(f_, e1) / length) * second
        return first, second

    @wp.func
    def guarded(F: mat33, X: mat33, N: mat33, guard: real, stiff: real, h: real, k: real, tangent: real):
        """The guard's part by F and by lam + 2 mu, which is ``stiff``; ``tangent`` is s(Ys) : Xs."""
        J = wp.determinant(F)
        G = real(0.5) * tensor_cross(F, F)
        along = wp.ddot(G, X)
        slope, other = wp.grad(upright)(J, guard)
        push = upright(J, guard)
        by_F, by_N, by_guard = wp.grad(gamma)(F, N, guard)
        by_F = k * tangent * by_F + h * stiff * (slope * along * G + push * tensor_cross(F, X))
        return by_F, h * push * along

    @wp.kernel(module=module, enable_backward=False)
    def tet_adjoint(
        # Model
        tet_index: wp.array(dtype=wp.int32),
        tet_node: wp.array2d(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        tet_gradient: wp.array2d(dtype=real),
        tet_volume: wp.array(dtype=real),
        tet_frame: wp.array2d(dtype=real),
        body_guard: wp.array(dtype=real),
        # Workspace in
        body_mu_in: wp.array3d(dtype=real),
        body_lam_in: wp.array3d(dtype=real),
        body_stiffness_in: wp.array3d(dtype=real),
        node_x_in: wp.array3d(dtype=real),
        node_v_in: wp.array3d(dtype=real),
        node_p_in: wp.array3d(dtype=real),
        h: real,
        # Workspace out
        corner_out: wp.array3d(dtype=real),
        parameter_out: wp.array3d(dtype=real),
    ):
        """Gradient by the corners of one tet, by mu and lam, and -V gamma s(Ys) : Xs."""
        pack, item, lane = wp.tid()
        tet = tet_index[item]
        body = tet_body[tet]
        mu = body_mu_in[pack, body, lane]
        lam = body_lam_in[pack, body, lane]
        k = body_stiffness_in[pack, body, lane]
        guard = body_guard[body]
        g1 = gradient_at(tet_gradient, tet, 0)
        g2 = gradient_at(tet_gradient, tet, 1)
        g3 = gradient_at(tet_gradient, tet, 2)
        g0 = g1 + g2 + g3
        N = wp.outer(g0, g0) + wp.outer(g1, g1) + wp.outer(g2, g2) + wp.outer(g3, g3)
        F = gradient_of(node_x_in, pack, lane, tet_node, tet_gradient, tet)
        X = gradient_of(node_p_in, pack, lane, tet_node, tet_gradient, tet)
        Y = gradient_of(node_v_in, pack, lane, tet_node, tet_gradient, tet)
        e = edge(node_x_in, pack, lane, tet_node, tet, 1)
        f_ = edge(node_x_in, pack, lane, tet_node, tet, 2)
        R0 = wp.matrix_from_rows(
            gradient_at(tet_frame, tet, 0), gradient_at(tet_frame, tet, 1), gradient_at(tet_frame, tet, 2)
        )
        R, inverse = rotation(e, f_, R0, F)
        strain = symmetric(wp.transpose(R) * F) - wp.identity(n=3, dtype=real)
        Xs = symmetric(wp.transpose(R) * X)
        Ys = symmetric(wp.transpose(R) * Y)
        sX = stress(Xs, mu, lam)
        sY = stress(Ys, mu, lam)
        is_low = wp.determinant(F) < guard
        stretched = real(1.0)
        if is_low:
            stretched = gamma(F, N, guard)
        tangent = wp.ddot(sX, Ys)
        by_R = h * (F * sX + X * stress(strain, mu, lam)) + k * stretched * (X * sY + Y * sX)
        by_F = h * (R * sX)
        by_stiff = real(0.0)
        if is_low:
            more_F, by_stiff = guarded(F, X, N, guard, lam + real(2.0) * mu, h, k, tangent)
            by_F += more_F
        along_e = vec3()
        along_f = vec3()
        if wp.static(is_large):
            along_e, along_f = by_edges(axial(by_R * wp.transpose(R)), e, f_)
        else:
            by_F += R * wp.skew(inverse * axial(wp.transpose(R) * by_R))
        volume = -tet_volume[tet]
        b = volume * (by_F * g1 + along_e)
        c = volume * (by_F * g2 + along_f)
        put_corners(corner_out, pack, lane, tet, b, c, volume * (by_F * g3))
        twice = real(2.0) * (h * wp.ddot(strain, Xs) + k * stretched * wp.ddot(Xs, Ys))
        traces = wp.trace(Xs) * (h * wp.trace(strain) + k * stretched * wp.trace(Ys))
        row = wp.static(adjoint.ROWS) * tet
        put(parameter_out, pack, lane, row, volume * vec3(twice + real(2.0) * by_stiff, traces + by_stiff, real(0.0)))
        parameter_out[pack, row + wp.static(adjoint.PARAMETERS), lane] = volume * stretched * tangent

    return SimpleNamespace(tet_adjoint=tet_adjoint)
