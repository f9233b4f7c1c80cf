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

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.algebra.vectors import algebra
from softwarp.kernels.elements import access, corotational, warped
from softwarp.kernels.elements.adjoint import PARAMETERS
from softwarp.kernels.elements.corotational import GUARD, GUARD_GROWTH, GUARD_RAMP, GUARD_TANGENT


@cache
def functions(variant: Variant) -> SimpleNamespace:
    """Matrices, and the guard with its derivatives, on the elements of a variant."""
    S, real = variant.S, variant.real
    mul, div, select = variant.mul, variant.div, variant.select
    a = algebra(variant)
    Vector, Matrix, vector, rows = a.Vector, a.Matrix, a.vector, a.rows
    row_x, row_y, row_z, add, scaled, dot, cross = a.row_x, a.row_y, a.row_z, a.add, a.scaled, a.dot, a.cross
    matmul, summed = a.matmul, a.summed

    @wp.func
    def times(m: Matrix, s: S):
        return rows(scaled(row_x(m), s), scaled(row_y(m), s), scaled(row_z(m), s))

    @wp.func
    def ddot(m: Matrix, n: Matrix):
        return dot(row_x(m), row_x(n)) + dot(row_y(m), row_y(n)) + dot(row_z(m), row_z(n))

    @wp.func
    def trace(m: Matrix):
        return m.xx + m.yy + m.zz

    @wp.func
    def shifted(m: Matrix, s: S):
        """m + s 1."""
        return rows(
            vector(m.xx + s, m.xy, m.xz),
            vector(m.yx, m.yy + s, m.yz),
            vector(m.zx, m.zy, m.zz + s),
        )

    @wp.func
    def stress(e: Matrix, mu: S, lam: S):
        """2 mu e + lam tr(e) 1."""
        return shifted(times(e, mu + mu), mul(lam, trace(e)))

    @wp.func
    def axial(m: Matrix):
        """w of m - m' = [w]."""
        return vector(m.zy - m.yz, m.xz - m.zx, m.yx - m.xy)

    @wp.func
    def axial_of(m: Matrix, s: Matrix):
        """``axial`` of m s, where s is symmetric."""
        return vector(
            dot(row_z(m), row_y(s)) - dot(row_y(m), row_z(s)),
            dot(row_x(m), row_z(s)) - dot(row_z(m), row_x(s)),
            dot(row_y(m), row_x(s)) - dot(row_x(m), row_y(s)),
        )

    @wp.func
    def skew(w: Vector):
        none = S(real(0.0))
        return rows(vector(none, -w.z, w.y), vector(w.z, none, -w.x), vector(-w.y, w.x, none))

    @wp.func
    def unturned(S_: Matrix, w: Vector):
        """(tr S 1 - S)^-1 w, by cofactors."""
        m = shifted(times(S_, S(real(-1.0))), trace(S_))
        c = cross(row_y(m), row_z(m))
        inverse = div(S(real(1.0)), dot(row_x(m), c))
        d = cross(row_z(m), row_x(m))
        e = cross(row_x(m), row_y(m))
        return scaled(vector(dot(c, w), dot(d, w), dot(e, w)), inverse)  # it is symmetric

    @wp.func
    def tensor_cross(m: Matrix, n: Matrix):
        """Symmetric and bilinear; F x F = 2 cof F."""
        return rows(
            add(cross(row_y(m), row_z(n)), cross(row_y(n), row_z(m))),
            add(cross(row_z(m), row_x(n)), cross(row_z(n), row_x(m))),
            add(cross(row_x(m), row_y(n)), cross(row_x(n), row_y(m))),
        )

    @wp.func
    def guarded(F: Matrix, G: Matrix, N: Matrix, depth: S, guard: S):
        """gamma and its gradient by F, U' over lam + 2 mu, and its slope; N = sum g g' over four corners, G = cof F."""
        one = S(real(1.0))
        none = S(real(0.0))
        is_on = select(depth, one, none)
        relative = wp.min(div(depth, guard), one)
        square = mul(relative, relative)
        is_curved = select(one - relative, one, none)
        steep = one + square * real(wp.static(3.0 * GUARD_GROWTH))
        ramp = wp.min(depth * real(GUARD_RAMP), one)
        is_rising = select(one - depth * real(GUARD_RAMP), one, none)
        GN = matmul(G, N)
        inverse = div(one, trace(N))
        widened = mul(ddot(GN, G), inverse)
        is_wide = select(widened - one, one, none)
        wide = wp.max(widened, one)
        by_depth = mul(mul(is_rising, steep), S(real(GUARD_RAMP)))
        by_depth += mul(mul(mul(ramp, relative), is_curved), div(S(real(wp.static(6.0 * GUARD_GROWTH))), guard))
        by_wide = mul(mul(ramp, steep), mul(is_wide, inverse + inverse))
        along = summed(times(G, -mul(by_depth, wide)), times(tensor_cross(F, GN), by_wide))
        gamma = one + mul(mul(ramp, steep), wide) * real(GUARD_TANGENT)
        push = (depth + mul(depth, square) * real(GUARD_GROWTH)) * real(-GUARD)
        bent = mul(square, is_curved)
        slope = one + (square + bent + bent) * real(GUARD_GROWTH)
        return gamma, times(along, is_on * real(GUARD_TANGENT)), push, mul(is_on, slope) * real(GUARD)

    return SimpleNamespace(
        times=times,
        ddot=ddot,
        trace=trace,
        shifted=shifted,
        stress=stress,
        axial=axial,
        axial_of=axial_of,
        skew=skew,
        unturned=unturned,
        tensor_cross=tensor_cross,
        guarded=guarded,
    )


@cache
def shared(variant: Variant, is_large: bool) -> SimpleNamespace:
    """What the derivatives of a tet with the law ``large``, or else ``warped``, start from."""
    inner = access.functions(variant).inner
    a = algebra(inner)
    Matrix, row_x, row_y, row_z, add = a.Matrix, a.row_x, a.row_y, a.row_z, a.add
    matmul, crossmul, transposed, add_outer = a.matmul, a.crossmul, a.transposed, a.add_outer
    element_frame = corotational.functions(inner).element_frame
    correction = warped.kernels(variant).correction

    @wp.func
    def rotation(e: Matrix, R0: Matrix, F: Matrix):
        """R of ``large``, or the polar one from there."""
        R = matmul(element_frame(row_x(e), row_y(e)), transposed(R0))
        if wp.static(not is_large):
            for _ in range(wp.static(warped.ITERATIONS)):
                R = matmul(R, correction(crossmul(R, F)))
        return R

    @wp.func
    def squares(g: Matrix):
        """sum g g' over the four corners."""
        other = add(add(row_x(g), row_y(g)), row_z(g))
        return add_outer(crossmul(g, g), other, other)

    return SimpleNamespace(rotation=rotation, squares=squares)


@cache
def kernels(variant: Variant, is_large: bool, by_parameters: bool = True) -> SimpleNamespace:
    """Gradients of tets with the law ``large``, or else ``warped``; by corners alone, or by parameters too."""
    at = access.functions(variant)
    inner = at.inner
    S, T, real, world_fastest = variant.S, inner.S, variant.real, variant.world_fastest
    mul, div, sqrt, any_positive = inner.mul, inner.div, inner.sqrt, inner.any_positive
    module = variant.module(f"adjoint.{'large' if is_large else 'warped'}{'' if by_parameters else '.corners'}")
    a, f, frames = algebra(inner), functions(inner), corotational.functions(inner)
    Vector, Matrix, vector, rows = a.Vector, a.Matrix, a.vector, a.rows
    row_x, row_y, row_z, add, subtract, scaled = a.row_x, a.row_y, a.row_z, a.add, a.subtract, a.scaled
    dot, cross, matmul, matvec, crossmul = a.dot, a.cross, a.matmul, a.matvec, a.crossmul
    summed, symmetric_part = a.summed, a.symmetric_part
    depth_below = frames.depth_below
    times, ddot, trace, shifted, stress, axial_of = f.times, f.ddot, f.trace, f.shifted, f.stress, f.axial_of
    skew, unturned, tensor_cross, guarded = f.skew, f.unturned, f.tensor_cross, f.guarded
    edges, gradients, of_body, of_tet, of_scene = at.edges, at.gradients, at.of_body, at.of_tet, at.of_scene
    write_corner, write_corners = at.write_corner, at.write_corners
    begin = shared(variant, is_large)
    rotation, squares = begin.rotation, begin.squares

    @wp.func
    def by_edges(t: Vector, e: Vector, f_: Vector):
        """Gradients by the two edges that turn the frame by w, from that by w; that of the second in row y."""
        one = T(real(1.0))
        inverse = div(one, sqrt(dot(e, e)))
        e1 = scaled(e, inverse)
        e3 = cross(e1, f_)
        e3 = scaled(e3, div(one, sqrt(dot(e3, e3))))
        e2 = cross(e3, e1)
        second = scaled(e3, div(dot(e1, t), dot(f_, e2)))
        first = scaled(subtract(scaled(e2, dot(e3, t)), scaled(e3, dot(e2, t))), inverse)
        first = subtract(first, scaled(second, mul(dot(f_, e1), inverse)))
        return rows(first, second, second)

    @wp.kernel(module=module, enable_backward=False)
    def tet_adjoint(
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
        node_x_in: wp.array2d(dtype=S),
        node_v_in: wp.array2d(dtype=S),
        node_p_in: wp.array2d(dtype=S),
        h: real,
        # Workspace out
        corner_out: wp.array2d(dtype=S),
        parameter_out: wp.array2d(dtype=S),
    ):
        """Gradient by the corners of one tet, or of eight, by mu and lam, and -V gamma s(Ys) : Xs."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        one = T(real(1.0))
        none = T(real(0.0))
        g = gradients(tet_gradient, tet_index, item)
        e = edges(node_x_in, w, tet_node, tet_index, item)
        F = crossmul(e, g)
        X = crossmul(edges(node_p_in, w, tet_node, tet_index, item), g)
        R = rotation(e, gradients(tet_frame, tet_index, item), F)
        M = crossmul(R, F)
        Xr = crossmul(R, X)
        Yr = crossmul(R, crossmul(edges(node_v_in, w, tet_node, tet_index, item), g))
        mu = of_body(body_mu_in, w, tet_body, tet_index, item)
        lam = of_body(body_lam_in, w, tet_body, tet_index, item)
        k = of_body(body_stiffness_in, w, tet_body, tet_index, item)
        volume = of_tet(tet_volume, tet_index, item)
        guard = of_scene(body_guard, tet_body, tet_index, item)
        strain = shifted(symmetric_part(M), -one)
        Xs = symmetric_part(Xr)
        Ys = symmetric_part(Yr)
        sX = stress(Xs, mu, lam)
        sY = stress(Ys, mu, lam)
        tangent = ddot(sX, Ys)
        gamma = one
        by_F = Matrix()
        by_stiff = none
        depth = depth_below(guard, e, of_tet(tet_size, tet_index, item))
        if any_positive(depth):
            stiff = mu + mu + lam
            G = times(tensor_cross(F, F), T(real(0.5)))
            gamma, by_gamma, push, slope = guarded(F, G, squares(g), depth, guard)
            along = ddot(G, X)
            by_F = summed(times(G, mul(slope, along)), times(tensor_cross(F, X), push))
            by_F = summed(times(by_F, stiff * h), times(by_gamma, mul(k, tangent)))
            by_stiff = mul(push, along) * h
        k = mul(k, gamma)
        turn = axial_of(summed(times(M, one * h), times(Yr, k)), sX)
        turn = add(turn, axial_of(Xr, summed(times(stress(strain, mu, lam), one * h), times(sY, k))))
        turned = times(sX, one * h)
        along_edges = Matrix()
        if wp.static(is_large):
            along_edges = by_edges(matvec(R, turn), row_x(e), row_y(e))
        else:
            turned = summed(turned, skew(unturned(symmetric_part(M), turn)))
        by_F = times(summed(by_F, matmul(R, turned)), -volume)
        along_edges = times(along_edges, -volume)
        b = add(matvec(by_F, row_x(g)), row_x(along_edges))
        c = add(matvec(by_F, row_y(g)), row_y(along_edges))
        write_corners(corner_out, w, tet_index, item, b, c, matvec(by_F, row_z(g)))
        if wp.static(by_parameters):
            by_mu = (ddot(strain, Xs) * h + mul(k, ddot(Xs, Ys)) + by_stiff) * real(2.0)
            by_lam = mul(trace(Xs), trace(strain) * h + mul(k, trace(Ys))) + by_stiff
            found = scaled(vector(by_mu, by_lam, none), -volume)
            write_corner(parameter_out, w, tet_index, item, 0, found)
            found = vector(none, mul(mul(gamma, tangent), -volume), none)
            write_corner(parameter_out, w, tet_index, item, wp.static(PARAMETERS - 1), found)

    return SimpleNamespace(tet_adjoint=tet_adjoint)
