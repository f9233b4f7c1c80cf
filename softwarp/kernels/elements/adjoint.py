"""Gradients of linear tetrahedra in a step: by positions and by the parameters of their law. docs/theory/adjoint.md.

A step solves A v = b, in which a tet has its forces P(F) g_b and the tangent k C(F), perhaps its nearest positive
semidefinite one. With the solution v and the adjoint p of the unknowns, X = sum p_b g_b' and Y = sum v_b g_b', a tet
adds to the gradient of the loss

    -V d/dF (h P : X + k C[Y] : X)   and   -V d/dparameter (h P : X + k C[Y] : X).

The first has the third derivative of the energy. With the tensor cross product A x B, for which cof(F) = F x F / 2
(Bonet, Gil, Ortigosa 2015, A computational framework for polyconvex large strain elasticity), the derivatives of
I1 = F:F, I2 = |cof F|^2 and J = det F are

    D I1[X] = 2 F:X                 D^2 I1[X] = 2 X                               D^3 I1 = 0
    D I2[X] = 2 (F x G):X           D^2 I2[X] = 2 F x (F x X) + 2 G x X           D^3 I2[X, Y] = 2 (X x (F x Y)
    D J[X] = G:X, G = cof F         D^2 J[X] = F x X                              + Y x (F x X) + F x (X x Y))
                                                                                  D^3 J[X, Y] = X x Y

so that nothing depends on principal axes, which are not differentiable where stretches are equal. The same holds of
the polar rotation R, S = R'F: dR[X] = R [w] with (tr S 1 - S) w = axl(R'X - X'R). Laws by powers of stretches do take
principal axes, and quotients of differences that vanish together.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import lanes, principal, single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.algebra.vectors import algebra
from softwarp.kernels.elements.laws import LAWS, law_parameters

PARAMETERS = 7  # rows per tet of parameters, as many as a law has at most
ROWS = 12  # behind them one for C[Y] : X, which the gradient by Rayleigh's beta is made of; as many as of corners
APART = {wp.float64: 1.0e-4, wp.float32: 1.0e-2}  # relative difference of stretches that is far enough to divide by
LEAST_PIVOT = 1.0e-3  # of tr S 1 - S, as of the tangent of the polar law


@cache
def functions(variant: Variant) -> SimpleNamespace:
    """What all laws share: the tensor cross product, principal axes, reading and writing of tets.

    Arrays are those of single worlds, (pack, row, lane).
    """
    real = variant.real
    one = single.functions(variant)
    vec3, mat33, vector_at, put = one.vec3, one.mat33, one.vector_at, one.put
    plain = variant if variant.lanes == 1 else lanes.variant("scalar")
    a = algebra(plain)
    axes = principal.functions(plain)
    vector, rows, Matrix, Symmetric = a.vector, a.rows, a.Matrix, a.Symmetric
    singular_values, principal_axes = axes.singular_values, axes.principal_axes

    @wp.func
    def tensor_cross(A: mat33, B: mat33):
        """Symmetric and bilinear; F x F = 2 cof F."""
        x = wp.cross(A[1], B[2]) + wp.cross(B[1], A[2])
        y = wp.cross(A[2], B[0]) + wp.cross(B[2], A[0])
        z = wp.cross(A[0], B[1]) + wp.cross(B[0], A[1])
        return wp.matrix_from_rows(x, y, z)

    @wp.func
    def dense(m: Matrix):
        return mat33(m.xx, m.xy, m.xz, m.yx, m.yy, m.yz, m.zx, m.zy, m.zz)

    @wp.func
    def decomposed(F: mat33):
        """U, s and V of F = U diag(s) V'."""
        x = vector(F[0, 0], F[0, 1], F[0, 2])
        y = vector(F[1, 0], F[1, 1], F[1, 2])
        z = vector(F[2, 0], F[2, 1], F[2, 2])
        r = singular_values(rows(x, y, z))
        return wp.transpose(dense(r.u)), vec3(r.s.x, r.s.y, r.s.z), wp.transpose(dense(r.v))

    @wp.func
    def eigen(H: mat33):
        """Eigenvalues of a symmetric matrix, and eigenvectors in rows."""
        m = Symmetric()
        m.xx = H[0, 0]
        m.yy = H[1, 1]
        m.zz = H[2, 2]
        m.xy = H[0, 1]
        m.xz = H[0, 2]
        m.yz = H[1, 2]
        axes = principal_axes(m)
        return vec3(axes.m.xx, axes.m.yy, axes.m.zz), dense(rows(axes.x, axes.y, axes.z))

    @wp.func
    def gradient_at(values: wp.array2d(dtype=real), tet: int, corner: int):
        """Gradient of the shape function of corner 1, 2 or 3 (numbered from 0), or a row of the rest frame."""
        return vec3(values[tet, 3 * corner], values[tet, 3 * corner + 1], values[tet, 3 * corner + 2])

    @wp.func
    def edge(x: wp.array3d(dtype=real), pack: int, lane: int, node: wp.array2d(dtype=wp.int32), tet: int, corner: int):
        """Value of a corner less that of corner 0."""
        here = vector_at(x, pack, lane, 3 * node[tet, corner])
        return here - vector_at(x, pack, lane, 3 * node[tet, 0])

    @wp.func
    def gradient_of(
        x: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        tet_node: wp.array2d(dtype=wp.int32),
        tet_gradient: wp.array2d(dtype=real),
        tet: int,
    ):
        """sum x_b g_b' of a nodal field."""
        m = wp.outer(edge(x, pack, lane, tet_node, tet, 1), gradient_at(tet_gradient, tet, 0))
        m += wp.outer(edge(x, pack, lane, tet_node, tet, 2), gradient_at(tet_gradient, tet, 1))
        m += wp.outer(edge(x, pack, lane, tet_node, tet, 3), gradient_at(tet_gradient, tet, 2))
        return m

    @wp.func
    def put_corners(out: wp.array3d(dtype=real), pack: int, lane: int, tet: int, b: vec3, c: vec3, d: vec3):
        """Vectors of corners 1 to 3; that of corner 0 balances them."""
        put(out, pack, lane, 12 * tet, -(b + c + d))
        put(out, pack, lane, 12 * tet + 3, b)
        put(out, pack, lane, 12 * tet + 6, c)
        put(out, pack, lane, 12 * tet + 9, d)

    return SimpleNamespace(
        vec3=vec3,
        mat33=mat33,
        tensor_cross=tensor_cross,
        decomposed=decomposed,
        eigen=eigen,
        gradient_at=gradient_at,
        edge=edge,
        gradient_of=gradient_of,
        put_corners=put_corners,
    )


@cache
def polar(variant: Variant) -> SimpleNamespace:
    """Derivatives of the polar rotation."""
    f = functions(variant)
    real, vec3, mat33 = variant.real, f.vec3, f.mat33

    @wp.func
    def axial(A: mat33):
        """w of A - A' = [w]."""
        return vec3(A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1])

    @wp.func
    def turning(U: mat33, s: vec3, V: mat33):
        """Inverse of tr S 1 - S with S = V diag(s) V'."""
        pairs = vec3()
        for k in range(3):
            total = s[(k + 1) % 3] + s[(k + 2) % 3]
            if wp.abs(total) < real(LEAST_PIVOT):
                total = real(LEAST_PIVOT)
            pairs[k] = real(1.0) / total
        return V * wp.diag(pairs) * wp.transpose(V)

    @wp.func
    def spin(R: mat33, inverse: mat33, X: mat33):
        """w of dR[X] = R [w]."""
        return inverse * axial(wp.transpose(R) * X)

    @wp.func
    def second(R: mat33, inverse: mat33, F: mat33, X: mat33, Y: mat33, x: vec3, y: vec3):
        """d^2 R[X, Y] with the spins x and y of X and Y."""
        dS = wp.transpose(R) * Y - wp.skew(y) * (wp.transpose(R) * F)
        rest = axial(-(wp.skew(y) * (wp.transpose(R) * X))) - (wp.trace(dS) * x - dS * x)
        return R * (wp.skew(y) * wp.skew(x) + wp.skew(inverse * rest))

    return SimpleNamespace(axial=axial, turning=turning, spin=spin, second=second)


def contraction(variant: Variant, law: str, module: wp.Module) -> SimpleNamespace:
    """``pull(F, p, X, Y, h, k)``: gradients of h P : X + k C[Y] : X by F and by the parameters, and C[Y] : X.

    C is the exact tangent. Warp gives a function that others have called before only an empty gradient, unless a kernel
    that is to be differentiated calls it: ``reach`` of the namespace is that kernel, which nobody launches.
    """
    if LAWS[law].derivatives is not None:
        return _by_invariants(variant, law, module)
    return _by_rotation(variant) if law == "corotational" else _by_stretches(variant, law, module)


def _by_invariants(variant: Variant, law: str, module: wp.Module) -> SimpleNamespace:
    f = functions(variant)
    real, vec3, mat33, tensor_cross = variant.real, f.vec3, f.mat33, f.tensor_cross
    derivatives = LAWS[law].derivatives
    vector, nine = wp.types.vector(LAWS[law].count, real), wp.types.vector(9, real)

    @wp.func
    def contracted(I1: real, I2: real, J: real, p: vector, weight: nine):
        """Weighted sum of the derivatives of the energy."""
        return wp.dot(derivatives(I1, I2, J, p), weight)

    @wp.kernel(module=module, enable_backward=True)
    def reach(
        # Samples in
        I_in: wp.array(dtype=vec3),
        p_in: wp.array(dtype=vector),
        weight_in: wp.array(dtype=nine),
        # Samples out
        value_out: wp.array(dtype=real),
    ):
        """See ``contraction``."""
        sample = wp.tid()
        value_out[sample] = contracted(
            I_in[sample][0], I_in[sample][1], I_in[sample][2], p_in[sample], weight_in[sample]
        )

    @wp.func
    def pull(F: mat33, p: vector, X: mat33, Y: mat33, h: real, k: real):
        two = real(2.0)
        G = real(0.5) * tensor_cross(F, F)
        FX = tensor_cross(F, X)
        FY = tensor_cross(F, Y)
        FG = tensor_cross(F, G)
        I1 = wp.ddot(F, F)
        I2 = wp.ddot(G, G)
        J = wp.determinant(F)
        x1 = two * wp.ddot(F, X)  # D I[X], D I[Y] and D^2 I[X, Y]
        x2 = two * wp.ddot(FG, X)
        xj = wp.ddot(G, X)
        y1 = two * wp.ddot(F, Y)
        y2 = two * wp.ddot(FG, Y)
        yj = wp.ddot(G, Y)
        z1 = two * wp.ddot(X, Y)
        z2 = two * (wp.ddot(FX, FY) + wp.ddot(tensor_cross(G, X), Y))
        zj = wp.ddot(FX, Y)
        mixed = nine(
            z1,
            z2,
            zj,
            x1 * y1,
            x1 * y2 + x2 * y1,
            x1 * yj + xj * y1,
            x2 * y2,
            x2 * yj + xj * y2,
            xj * yj,
        )
        weight = k * mixed
        weight[0] = weight[0] + h * x1
        weight[1] = weight[1] + h * x2
        weight[2] = weight[2] + h * xj
        c1, c2, cj, by_p, _ = wp.grad(contracted)(I1, I2, J, p, weight)
        d = derivatives(I1, I2, J, p)
        X1 = h * d[0] + k * (d[3] * y1 + d[4] * y2 + d[5] * yj)  # factors of D^2 I[X], D^2 I[Y]
        X2 = h * d[1] + k * (d[4] * y1 + d[6] * y2 + d[7] * yj)
        XJ = h * d[2] + k * (d[5] * y1 + d[7] * y2 + d[8] * yj)
        Y1 = k * (d[3] * x1 + d[4] * x2 + d[5] * xj)
        Y2 = k * (d[4] * x1 + d[6] * x2 + d[7] * xj)
        YJ = k * (d[5] * x1 + d[7] * x2 + d[8] * xj)
        by_F = two * (c1 * F + c2 * FG + X1 * X + Y1 * Y) + cj * G + XJ * FX + YJ * FY
        by_F += two * tensor_cross(G, X2 * X + Y2 * Y)
        third = tensor_cross(X, FY) + tensor_cross(Y, FX) + tensor_cross(F, tensor_cross(X, Y))
        by_F += two * tensor_cross(F, X2 * FX + Y2 * FY) + k * (two * d[1] * third + d[2] * tensor_cross(X, Y))
        return by_F, by_p, wp.dot(d, mixed)

    return SimpleNamespace(pull=pull, reach=reach)


def _by_rotation(variant: Variant) -> SimpleNamespace:
    f, turned = functions(variant), polar(variant)
    real, mat33, decomposed = variant.real, f.mat33, f.decomposed
    turning, spin, second = turned.turning, turned.spin, turned.second
    vector = wp.types.vector(2, real)

    @wp.func
    def pull(F: mat33, p: vector, X: mat33, Y: mat33, h: real, k: real):
        """Of psi = mu (I1 - 2 tr S + 3) + lam/2 (tr S - 3)^2, where tr S has the derivative R."""
        mu = p[0]
        lam = p[1]
        two = real(2.0)
        U, s, V = decomposed(F)
        R = U * wp.transpose(V)
        inverse = turning(U, s, V)
        x = spin(R, inverse, X)
        y = spin(R, inverse, Y)
        dX = R * wp.skew(x)
        dY = R * wp.skew(y)
        strain = s[0] + s[1] + s[2] - real(3.0)
        pressure = lam * strain - two * mu
        along_x = wp.ddot(R, X)
        along_y = wp.ddot(R, Y)
        bent = wp.ddot(dX, Y)
        by_F = h * (two * mu * X + pressure * dX + lam * along_x * R)
        by_F += k * (pressure * second(R, inverse, F, X, Y, x, y))
        by_F += k * lam * (bent * R + along_x * dY + along_y * dX)
        by_mu = two * (h * wp.ddot(F - R, X) + k * (wp.ddot(X, Y) - bent))
        by_lam = h * strain * along_x + k * (strain * bent + along_x * along_y)
        stiffness = two * mu * wp.ddot(X, Y) + pressure * bent + lam * along_x * along_y
        return by_F, vector(by_mu, by_lam), stiffness

    return SimpleNamespace(pull=pull)


def _by_stretches(variant: Variant, law: str, module: wp.Module) -> SimpleNamespace:
    f = functions(variant)
    real, vec3, mat33, decomposed = variant.real, f.vec3, f.mat33, f.decomposed
    slopes, principal_of = LAWS[law].slopes, LAWS[law].principal
    vector = wp.types.vector(LAWS[law].count, real)
    apart = APART[real]

    @wp.func
    def value(s: vec3, p: vector, X: mat33, Y: mat33, h: real, k: real):
        """h P : X + k C[Y] : X in principal axes."""
        half = real(0.5)
        psi = slopes(s, p)
        H, minus, plus = principal_of(s, p)
        x = vec3(X[0, 0], X[1, 1], X[2, 2])
        y = vec3(Y[0, 0], Y[1, 1], Y[2, 2])
        sheared = minus[0] * (X[1, 2] + X[2, 1]) * (Y[1, 2] + Y[2, 1])
        sheared += minus[1] * (X[2, 0] + X[0, 2]) * (Y[2, 0] + Y[0, 2])
        sheared += minus[2] * (X[0, 1] + X[1, 0]) * (Y[0, 1] + Y[1, 0])
        sheared += plus[0] * (X[1, 2] - X[2, 1]) * (Y[1, 2] - Y[2, 1])
        sheared += plus[1] * (X[2, 0] - X[0, 2]) * (Y[2, 0] - Y[0, 2])
        sheared += plus[2] * (X[0, 1] - X[1, 0]) * (Y[0, 1] - Y[1, 0])
        return h * wp.dot(psi, x) + k * (wp.dot(x, H * y) + half * sheared)

    @wp.kernel(module=module, enable_backward=True)
    def reach(
        # Samples in
        s_in: wp.array(dtype=vec3),
        p_in: wp.array(dtype=vector),
        X_in: wp.array(dtype=mat33),
        # Samples out
        value_out: wp.array(dtype=real),
    ):
        """See ``contraction``."""
        sample = wp.tid()
        value_out[sample] = value(s_in[sample], p_in[sample], X_in[sample], X_in[sample], real(1.0), real(1.0))

    @wp.func
    def turns(X: mat33, Y: mat33, A: mat33, B: mat33, i: int, j: int):
        """Gradients by the turns of U and of V in the plane i, j, from those by X and Y in principal axes."""
        by_u = A * wp.transpose(X) + B * wp.transpose(Y)
        by_v = wp.transpose(X) * A + wp.transpose(Y) * B
        return by_u[j, i] - by_u[i, j], by_v[i, j] - by_v[j, i]

    @wp.func
    def pull(F: mat33, p: vector, X: mat33, Y: mat33, h: real, k: real):
        """Stretches and axes vary; where two stretches are nearly equal, those beside them take their place.

        U and V turn in the plane i, j by a sum that is (dF_ij + dF_ji)/(s_j - s_i) and a difference that is
        (dF_ij - dF_ji)/(s_i + s_j). The gradient by the sum vanishes with s_j - s_i, and their quotient is smooth.
        """
        half = real(0.5)
        U, s, V = decomposed(F)
        X0 = wp.transpose(U) * X * V
        Y0 = wp.transpose(U) * Y * V
        by_s, by_p, A, B, by_h, stiffness = wp.grad(value)(s, p, X0, Y0, h, k)  # value is linear in k
        by_F = wp.diag(by_s)
        planes = int(wp.static(3))  # a loop that stays one
        for m in range(planes):
            i = (m + 1) % 3
            j = (m + 2) % 3
            by_u, by_v = turns(X0, Y0, A, B, i, j)
            rotation = half * (by_u - by_v) / (s[i] + s[j])
            way = s[j] - s[i]
            shear = real(0.0)
            if wp.abs(way) > real(apart) * (s[i] + s[j]):
                shear = half * (by_u + by_v) / way
            else:
                middle = half * (s[i] + s[j])
                for side in range(planes - 1):
                    near = real(apart) * middle * wp.where(side == 0, real(1.0), real(-1.0))
                    t = s
                    t[i] = middle - near
                    t[j] = middle + near
                    _s, _p, A1, B1, _h, _k = wp.grad(value)(t, p, X0, Y0, h, k)
                    u1, v1 = turns(X0, Y0, A1, B1, i, j)
                    shear += half * half * (u1 + v1) / (real(2.0) * near)
            by_F[i, j] = shear + rotation
            by_F[j, i] = shear - rotation
        return U * by_F * wp.transpose(V), by_p, stiffness

    return SimpleNamespace(pull=pull, reach=reach)


@cache
def projection(variant: Variant, law: str) -> SimpleNamespace:
    """Eigenvalues and modes of the tangent C of a law, and what they make of contractions with its derivative."""
    f = functions(variant)
    real, vec3, mat33, eigen = variant.real, f.vec3, f.mat33, f.eigen
    principal_of = LAWS[law].principal
    vector = wp.types.vector(LAWS[law].count, real)
    nine = wp.types.vector(9, real)

    @wp.func
    def mode(n: int, axes: mat33):
        """One of nine orthonormal modes in principal axes: stretches along ``axes``, then shears, then rotations."""
        m = mat33()
        if n < 3:
            m = wp.diag(axes[n])
        else:
            i = (n + 1) % 3
            j = (n + 2) % 3
            m[i, j] = wp.sqrt(real(0.5))
            m[j, i] = wp.where(n < 6, m[i, j], -m[i, j])
        return m

    @wp.func
    def modes(s: vec3, p: vector):
        """Eigenvalues of C in principal axes by mode, and the axes of its stretch block."""
        H, minus, plus = principal_of(s, p)
        stretch, axes = eigen(H)
        values = nine()
        for n in range(3):
            values[n] = stretch[n]
            values[3 + n] = minus[n]
            values[6 + n] = plus[n]
        return values, axes

    @wp.func
    def along(n: int, values: nine, axes: mat33, U: mat33, V: mat33, X: mat33, Y: mat33):
        """X and Y of the contraction with the third derivative for mode n; n = 9: those of all positive modes."""
        count = int(wp.static(9))  # a loop that stays one
        A = mat33()
        B = mat33()
        m = mat33()
        if n < count:
            m = U * mode(n, axes) * wp.transpose(V)
        x = wp.ddot(m, X)
        y = wp.ddot(m, Y)
        for i in range(count):
            if values[i] >= real(0.0):
                other = U * mode(i, axes) * wp.transpose(V)
                if n < count:
                    share = values[i] / (values[i] - values[n])
                    A += share * (wp.ddot(other, X) * y + x * wp.ddot(other, Y)) * other
                else:
                    A += wp.ddot(other, X) * other
                    B += wp.ddot(other, Y) * other
        if n < count:
            B = m
        return A, B

    @wp.func
    def projected_stiffness(values: nine, axes: mat33, U: mat33, V: mat33, X: mat33, Y: mat33):
        """C+[Y] : X."""
        total = real(0.0)
        count = int(wp.static(9))
        for i in range(count):
            m = U * mode(i, axes) * wp.transpose(V)
            total += wp.max(values[i], real(0.0)) * wp.ddot(m, X) * wp.ddot(m, Y)
        return total

    return SimpleNamespace(nine=nine, mode=mode, modes=modes, along=along, projected_stiffness=projected_stiffness)


@single_worlds
def kernels(variant: Variant, law: str, project: bool, by_parameters: bool = True) -> SimpleNamespace:
    """Gradients of tets of one law of ``laws.LAWS``.

    Where a tangent C has been projected, the gradient is that of the projection: with eigenvalues c_i and modes Q_i,
    d(C+) = sum f_ij (Q_i : dC[Q_j]) Q_i Q_j', f_ij = (c_i+ - c_j+)/(c_i - c_j), which is 1 among positive ones, 0 among
    negative ones and c_i / (c_i - c_j) between the two (Daleckii and Krein). It exists unless an eigenvalue is zero.

    Args:
        variant: Scalar type and memory order.
        law: Law.
        project: Whether the step has clamped tangents to positive semidefinite ones.
        by_parameters: Whether gradients by parameters are asked for, which terms have that the law leaves out.
    """
    f = functions(variant)
    real, mat33, awake = variant.real, f.mat33, LAWS[law].awake if by_parameters else None
    module = variant.module(f"adjoint.{law}.{'spd' if project else 'exact'}{'' if by_parameters else '.alone'}")
    decomposed, gradient_at, gradient_of, put_corners = f.decomposed, f.gradient_at, f.gradient_of, f.put_corners
    pull, parameters, count = contraction(variant, law, module).pull, law_parameters(real, law), LAWS[law].count
    spectrum = projection(variant, law)
    nine, modes, along = spectrum.nine, spectrum.modes, spectrum.along
    projected_stiffness = spectrum.projected_stiffness

    @wp.kernel(module=module, enable_backward=False)
    def tet_adjoint(
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
        body_stiffness_in: wp.array3d(dtype=real),
        node_x_in: wp.array3d(dtype=real),
        node_v_in: wp.array3d(dtype=real),
        node_p_in: wp.array3d(dtype=real),
        h: real,
        # Workspace out
        corner_out: wp.array3d(dtype=real),
        parameter_out: wp.array3d(dtype=real),
    ):
        """Gradient by the corners of one tet, by its law's parameters, and -V C[Y] : X."""
        pack, item, lane = wp.tid()
        tet = tet_index[item]
        body = tet_body[tet]
        p = parameters(body_law_start, body_mu_in, body_lam_in, law_parameter_in, pack, body, lane)
        if wp.static(awake is not None):
            p = awake(p)
        F = gradient_of(node_x_in, pack, lane, tet_node, tet_gradient, tet)
        X = gradient_of(node_p_in, pack, lane, tet_node, tet_gradient, tet)
        Y = gradient_of(node_v_in, pack, lane, tet_node, tet_gradient, tet)
        k = body_stiffness_in[pack, body, lane]
        values = nine()
        axes = mat33()
        U = mat33()
        V = mat33()
        if wp.static(project):
            U, s, V = decomposed(F)
            values, axes = modes(s, p)
        is_clamped = wp.min(values) < real(0.0)
        by_F, by_p, stiffness = pull(F, p, X, Y, h, wp.where(is_clamped, real(0.0), k))
        if wp.static(project):
            if is_clamped:
                stages = int(wp.static(10))
                for n in range(stages):
                    if n == 9 or values[n] < real(0.0):
                        A, B = along(n, values, axes, U, V, X, Y)
                        more_F, more_p, _ = pull(F, p, A, B, real(0.0), k)
                        by_F += more_F
                        by_p += more_p
                stiffness = projected_stiffness(values, axes, U, V, X, Y)
        volume = -tet_volume[tet]
        by_F = volume * by_F
        b = by_F * gradient_at(tet_gradient, tet, 0)
        c = by_F * gradient_at(tet_gradient, tet, 1)
        put_corners(corner_out, pack, lane, tet, b, c, by_F * gradient_at(tet_gradient, tet, 2))
        row = wp.static(ROWS) * tet
        for n in range(wp.static(count)):
            parameter_out[pack, row + n, lane] = volume * by_p[n]
        parameter_out[pack, row + wp.static(PARAMETERS), lane] = volume * stiffness

    return SimpleNamespace(tet_adjoint=tet_adjoint)
