"""Gradients of tetrahedra of laws P = mu F + U'(J) cof F, eight at a time on a CPU. Theory: docs/theory/adjoint.md.

With G = cof F, a = U'(J), b = U'', e = U''' and the tensor cross product of ``adjoint``, there is

    C[X] = mu X + a F x X + b (G:X) G,

and C[B] : A at fixed A and B has by F the gradient

    D(A, B) = (e (G:A) (G:B) + b (F x A):B) G + b F x ((G:B) A + (G:A) B) + a A x B,

so that h P : X + k C[Y] : X has h C[X] + k D(X, Y). Where the step has clamped a tangent, the sum of Daleckii and Krein
(``adjoint.kernels``) takes the place of D(X, Y). All of it stands in principal axes, F = diag(s), where the modes of C
are three stretches, whose block is b g g' + a s_k beside mu on the diagonal, and of every pair of axes the sum with the
eigenvalue mu - a s_k and the difference with mu + a s_k, k being the third axis.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import principal
from softwarp.kernels.algebra.lane_powers import log_lanes
from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.algebra.vectors import algebra
from softwarp.kernels.elements import access, turned_adjoint
from softwarp.kernels.elements.adjoint import PARAMETERS

LAWS = ("neo_hookean", "stable_neo_hookean")


@cache
def volumes(variant: Variant, law: str) -> SimpleNamespace:
    """U of a law: its derivatives by J, and those of these by the Lame constants."""
    S, real, mul, div = variant.S, variant.real, variant.mul, variant.div
    log = log_lanes if variant.lanes > 1 else wp.log

    @wp.struct
    class Volume:
        """U', U'' and U''', and the first two by mu and lam."""

        a: S
        b: S
        e: S
        a_mu: S
        a_lam: S
        b_mu: S
        b_lam: S

    @wp.func
    def neo_hookean(J: S, mu: S, lam: S):
        """U = lam/2 (ln J)^2 - mu ln J."""
        one = S(real(1.0))
        log_j = log(J)
        over = div(one, J)
        square = mul(over, over)
        slope = mul(lam, log_j) - mu
        u = Volume()
        u.a = mul(slope, over)
        u.b = mul(lam - slope, square)
        u.e = mul(slope * real(2.0) - lam * real(3.0), mul(square, over))
        u.a_mu = -over
        u.a_lam = mul(log_j, over)
        u.b_mu = square
        u.b_lam = mul(one - log_j, square)
        return u

    @wp.func
    def stable_neo_hookean(J: S, mu: S, lam: S):
        """U = (lam + mu)/2 (J - 1)^2 - mu J."""
        one = S(real(1.0))
        u = Volume()
        u.b = lam + mu
        u.a = mul(u.b, J - one) - mu
        u.e = S(real(0.0))
        u.a_mu = J - one - one
        u.a_lam = J - one
        u.b_mu = one
        u.b_lam = one
        return u

    return SimpleNamespace(Volume=Volume, of=neo_hookean if law == "neo_hookean" else stable_neo_hookean)


@cache
def functions(variant: Variant, law: str) -> SimpleNamespace:
    """Sums of D(A, B) in principal axes, the modes of C, and what a clamped tangent makes of X and Y."""
    S, real, mul, fma, div = variant.S, variant.real, variant.mul, variant.fma, variant.div
    any_positive, select = variant.any_positive, variant.select
    a, f = algebra(variant), turned_adjoint.functions(variant)
    Vector, Matrix, Symmetric, vector, rows = a.Vector, a.Matrix, a.Symmetric, a.vector, a.rows
    scaled, dot, product = a.scaled, a.dot, a.product
    summed, matvec, combination = a.summed, a.matvec, a.combination
    times, ddot, tensor_cross = f.times, f.ddot, f.tensor_cross
    principal_axes = principal.functions(variant).principal_axes
    Volume = volumes(variant, law).Volume
    root = real(0.5**0.5)

    @wp.struct
    class Sums:
        """Over pairs A, B: of A x B, of (G:B) A + (G:A) B, of (F x A):B, of (G:A) (G:B) and of A:B."""

        crossed: Matrix
        along: Matrix
        bent: S
        both: S
        inner: S

    @wp.struct
    class Modes:
        """Of all nine, a number each: of the stretches, and of the sums and differences by the axis they leave out."""

        stretch: Vector
        plus: Vector
        minus: Vector

    @wp.func
    def across(s: Vector, m: Matrix):
        """F x m with F = diag(s)."""
        return rows(
            vector(fma(s.y, m.zz, mul(s.z, m.yy)), -mul(s.z, m.yx), -mul(s.y, m.zx)),
            vector(-mul(s.z, m.xy), fma(s.z, m.xx, mul(s.x, m.zz)), -mul(s.x, m.zy)),
            vector(-mul(s.y, m.xz), -mul(s.x, m.yz), fma(s.x, m.yy, mul(s.y, m.xx))),
        )

    @wp.func
    def diagonal(m: Matrix):
        return vector(m.xx, m.yy, m.zz)

    @wp.func
    def with_pair(t: Sums, s: Vector, g: Vector, A: Matrix, B: Matrix):
        """The sums and one pair more."""
        along_a = dot(g, diagonal(A))
        along_b = dot(g, diagonal(B))
        t.crossed = summed(t.crossed, tensor_cross(A, B))
        t.along = summed(t.along, summed(times(A, along_b), times(B, along_a)))
        t.bent += ddot(across(s, A), B)
        t.both += mul(along_a, along_b)
        t.inner += ddot(A, B)
        return t

    @wp.func
    def by_modes(e: Matrix, m: Matrix):
        """Shares of the modes, of which the stretches have the rows of e."""
        c = Modes()
        c.stretch = matvec(e, diagonal(m))
        c.plus = vector((m.yz + m.zy) * root, (m.zx + m.xz) * root, (m.xy + m.yx) * root)
        c.minus = vector((m.yz - m.zy) * root, (m.zx - m.xz) * root, (m.xy - m.yx) * root)
        return c

    @wp.func
    def from_modes(e: Matrix, c: Modes):
        """The matrix with these shares."""
        d = combination(c.stretch, e)
        p = scaled(c.plus, S(root))
        m = scaled(c.minus, S(root))
        return rows(
            vector(d.x, p.z + m.z, p.y - m.y), vector(p.z - m.z, d.y, p.x + m.x), vector(p.y + m.y, p.x - m.x, d.z)
        )

    @wp.func
    def held(c: Vector):
        """1 where an eigenvalue is not negative, else 0."""
        one = S(real(1.0))
        none = S(real(0.0))
        return vector(select(-c.x, none, one), select(-c.y, none, one), select(-c.z, none, one))

    @wp.func
    def share(c: S, other: S, weight: S):
        """weight c / (c - other) of an eigenvalue c that is not negative and another that is, else 0."""
        none = S(real(0.0))
        apart = select(-c, none, weight)
        return div(mul(apart, c), select(-c, S(real(1.0)), c - other))

    @wp.func
    def shares(c: Vector, other: S, x: Vector, y: Vector, of_x: S, of_y: S):
        """Those of three modes, times what of X and Y belongs to them and to the other."""
        return vector(
            share(c.x, other, fma(x.x, of_y, mul(of_x, y.x))),
            share(c.y, other, fma(x.y, of_y, mul(of_x, y.y))),
            share(c.z, other, fma(x.z, of_y, mul(of_x, y.z))),
        )

    @wp.func
    def with_clamped(
        t: Sums,
        s: Vector,
        g: Vector,
        e: Matrix,
        c: Modes,
        x: Modes,
        y: Modes,
        mode: Modes,
        own: S,
        of_x: S,
        of_y: S,
    ):
        """The sums and the pairs of one mode, where its eigenvalue ``own`` is negative, with all that are not."""
        none = S(real(0.0))
        u = select(-own, of_x, none)
        v = select(-own, of_y, none)
        safe = select(-own, own, S(real(-1.0)))  # where it is not clamped shares are 0 anyway, yet must be numbers
        n = Modes()
        n.stretch = shares(c.stretch, safe, x.stretch, y.stretch, u, v)
        n.plus = shares(c.plus, safe, x.plus, y.plus, u, v)
        n.minus = shares(c.minus, safe, x.minus, y.minus, u, v)
        return with_pair(t, s, g, from_modes(e, n), from_modes(e, mode))

    @wp.func
    def only(axis: int):
        """Unit vector."""
        one = S(real(1.0))
        none = S(real(0.0))
        v = vector(none, none, none)
        if axis == 0:
            v.x = one
        if axis == 1:
            v.y = one
        if axis == 2:
            v.z = one
        return v

    @wp.func
    def component(v: Vector, axis: int):
        if axis == 0:
            return v.x
        if axis == 1:
            return v.y
        return v.z

    @wp.func
    def least(c: Modes):
        one = wp.min(wp.min(c.stretch.x, c.stretch.y), c.stretch.z)
        two = wp.min(wp.min(c.plus.x, c.plus.y), c.plus.z)
        return wp.min(wp.min(one, two), wp.min(wp.min(c.minus.x, c.minus.y), c.minus.z))

    @wp.func
    def projected(s: Vector, g: Vector, u: Volume, mu: S, X: Matrix, Y: Matrix):
        """Sums of all pairs that a clamped tangent leaves, and C+[Y] : X."""
        none = S(real(0.0))
        h = Symmetric()
        h.xx = fma(u.b, mul(g.x, g.x), mu)
        h.yy = fma(u.b, mul(g.y, g.y), mu)
        h.zz = fma(u.b, mul(g.z, g.z), mu)
        h.xy = fma(u.b, mul(g.x, g.y), mul(u.a, s.z))
        h.xz = fma(u.b, mul(g.x, g.z), mul(u.a, s.y))
        h.yz = fma(u.b, mul(g.y, g.z), mul(u.a, s.x))
        axes = principal_axes(h)
        e = rows(axes.x, axes.y, axes.z)
        c = Modes()
        c.stretch = vector(axes.m.xx, axes.m.yy, axes.m.zz)
        c.plus = vector(mu - mul(u.a, s.x), mu - mul(u.a, s.y), mu - mul(u.a, s.z))
        c.minus = vector(mu + mul(u.a, s.x), mu + mul(u.a, s.y), mu + mul(u.a, s.z))
        x = by_modes(e, X)
        y = by_modes(e, Y)
        t = Sums()
        stiffness = none
        A = X
        B = Y
        if any_positive(-least(c)):
            for kind in range(int(wp.static(3))):
                own = c.stretch
                of_x = x.stretch
                of_y = y.stretch
                if kind == 1:
                    own = c.plus
                    of_x = x.plus
                    of_y = y.plus
                if kind == 2:
                    own = c.minus
                    of_x = x.minus
                    of_y = y.minus
                for axis in range(int(wp.static(3))):
                    value = component(own, axis)
                    if any_positive(-value):
                        mode = Modes()
                        if kind == 0:
                            mode.stretch = only(axis)
                        if kind == 1:
                            mode.plus = only(axis)
                        if kind == 2:
                            mode.minus = only(axis)
                        t = with_clamped(t, s, g, e, c, x, y, mode, value, component(of_x, axis), component(of_y, axis))
            n = Modes()
            n.stretch = product(x.stretch, held(c.stretch))
            n.plus = product(x.plus, held(c.plus))
            n.minus = product(x.minus, held(c.minus))
            A = from_modes(e, n)
            n.stretch = product(y.stretch, held(c.stretch))
            n.plus = product(y.plus, held(c.plus))
            n.minus = product(y.minus, held(c.minus))
            B = from_modes(e, n)
        t = with_pair(t, s, g, A, B)
        stiffness = dot(product(x.stretch, y.stretch), product(c.stretch, held(c.stretch)))
        stiffness += dot(product(x.plus, y.plus), product(c.plus, held(c.plus)))
        stiffness += dot(product(x.minus, y.minus), product(c.minus, held(c.minus)))
        return t, stiffness

    return SimpleNamespace(Sums=Sums, across=across, diagonal=diagonal, with_pair=with_pair, projected=projected)


@cache
def kernels(variant: Variant, law: str, project: bool, by_parameters: bool = True) -> SimpleNamespace:
    """Gradients of tets of one law of ``LAWS``, by corners alone or by parameters too, on a CPU.

    Args:
        variant: Scalar type, of a CPU.
        law: Law.
        project: Whether the step has clamped tangents to positive semidefinite ones.
        by_parameters: Whether those by mu and lam are asked for, and -V C[Y] : X.
    """
    at = access.functions(variant)
    inner = at.inner
    S, T, real, mul = variant.S, inner.S, variant.real, inner.mul
    name = f"adjoint.volumetric.{law}.{'spd' if project else 'exact'}{'' if by_parameters else '.corners'}"
    module = variant.module(name)
    a, f, p = algebra(inner), functions(inner, law), principal.functions(inner)
    vector, row_x, row_y, row_z = a.vector, a.row_x, a.row_y, a.row_z
    matvec, matmul, crossmul = a.matvec, a.matmul, a.crossmul
    transposed, summed, scaled, dot = a.transposed, a.summed, a.scaled, a.dot
    times = turned_adjoint.functions(inner).times
    Sums, across, diagonal, with_pair, projected = f.Sums, f.across, f.diagonal, f.with_pair, f.projected
    edges, gradients, of_body, of_tet = at.edges, at.gradients, at.of_body, at.of_tet
    write_corner, write_corners = at.write_corner, at.write_corners
    volume_of = volumes(inner, law).of
    decomposed = p.stretches if law == "neo_hookean" else p.singular_values  # it has no stress where J <= 0

    @wp.kernel(module=module, enable_backward=False)
    def tet_adjoint(
        # Model
        tet_index: wp.array(dtype=wp.int32),
        tet_node: wp.array2d(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        tet_gradient: wp.array2d(dtype=real),
        tet_volume: wp.array(dtype=real),
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
        """Gradient by the corners of one tet, or of eight, by mu and lam, and -V C[Y] : X."""
        w, item = wp.tid()
        none = T(real(0.0))
        step = T(h)
        q = gradients(tet_gradient, tet_index, item)
        r = decomposed(crossmul(edges(node_x_in, w, tet_node, tet_index, item), q))
        back = transposed(r.v)
        X = matmul(r.u, matmul(crossmul(edges(node_p_in, w, tet_node, tet_index, item), q), back))
        Y = matmul(r.u, matmul(crossmul(edges(node_v_in, w, tet_node, tet_index, item), q), back))
        mu = of_body(body_mu_in, w, tet_body, tet_index, item)
        lam = of_body(body_lam_in, w, tet_body, tet_index, item)
        k = of_body(body_stiffness_in, w, tet_body, tet_index, item)
        volume = of_tet(tet_volume, tet_index, item)
        s = r.s
        g = vector(mul(s.y, s.z), mul(s.z, s.x), mul(s.x, s.y))
        u = volume_of(mul(g.x, s.x), mu, lam)
        t = Sums()
        stiffness = none
        if wp.static(project):
            t, stiffness = projected(s, g, u, mu, X, Y)
        else:
            t = with_pair(t, s, g, X, Y)
            stiffness = mul(mu, t.inner) + mul(u.a, t.bent) + mul(u.b, t.both)
        along = dot(g, diagonal(X))
        bent = across(s, summed(times(t.along, mul(k, u.b)), times(X, mul(step, u.a))))
        bent = summed(bent, summed(times(t.crossed, mul(k, u.a)), times(X, mul(step, mu))))
        outward = mul(k, mul(u.e, t.both) + mul(u.b, t.bent)) + mul(step, mul(u.b, along))
        bent.xx += mul(outward, g.x)
        bent.yy += mul(outward, g.y)
        bent.zz += mul(outward, g.z)
        by_F = times(crossmul(r.u, matmul(bent, r.v)), -volume)
        b = matvec(by_F, row_x(q))
        write_corners(corner_out, w, tet_index, item, b, matvec(by_F, row_y(q)), matvec(by_F, row_z(q)))
        if wp.static(by_parameters):
            pushed = mul(step, along) + mul(k, t.bent)
            both = mul(k, t.both)
            by_mu = mul(step, dot(s, diagonal(X))) + mul(k, t.inner) + mul(u.a_mu, pushed) + mul(u.b_mu, both)
            by_lam = mul(u.a_lam, pushed) + mul(u.b_lam, both)
            found = scaled(vector(by_mu, by_lam, none), -volume)
            write_corner(parameter_out, w, tet_index, item, 0, found)
            found = vector(none, mul(stiffness, -volume), none)
            write_corner(parameter_out, w, tet_index, item, wp.static(PARAMETERS - 1), found)

    return SimpleNamespace(tet_adjoint=tet_adjoint)
