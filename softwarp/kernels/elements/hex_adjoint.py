"""Gradients of hexahedra in a step: by corners and by the Lame constants. Theory: docs/theory/hexahedral.md.

With the rotation Q of a hexahedron, let y, p and v be positions of its corners, the adjoint of their velocities and
these, all from the first corner and turned back by Q', u = y - X and f = K u. Along p, positions turned back change by
d_a = p_a - w x y_a with the spin G w = axl(Q' dF), G = tr S 1 - S. So a hexahedron of a step has

    L = h f . d + k r p' K v + h V pi(J) dJ,

where r and pi are factor and pressure of the guard. In a change that turns Q by z, p and v change by -z x p_a and
-z x v_a, and u by e_a - z x y_a. With G eta = sum y_a x f_a, A = sum p_a g_a' and B = (eta . w) 1 - sym(eta w') it adds

    dL = sum alpha_a . (e_a - z x y_a) + h sum e_a . B g_a + zeta . z,        alpha_a = h ((K d)_a - f_a x w),
    zeta = h (axl(A [eta]) - axl(B S) - sum p_a x f_a) - k r sum (p_a x (K v)_a + v_a x (K p)_a),

and G z = axl(sum e_a g_a').
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import lanes, single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.algebra.vectors import algebra
from softwarp.kernels.elements import corotational, hexahedral, warped
from softwarp.kernels.elements.adjoint import PARAMETERS, ROWS
from softwarp.kernels.elements.adjoint import functions as of_tets

SIZE = 3 * hexahedral.CORNERS


# Sums in registers, of one world and of one in lanes; their order is one of the compiler's, always the same.
_PRODUCT = """
#pragma clang fp contract(fast) reassociate(on)
const REAL* const k = &wp::index(stiffness, pack, first, lane);
const int step = stiffness.strides[1] / sizeof(REAL);
REAL s[SIZE] = {};
if (step == 1) {
    for (int j = 3; j < SIZE; ++j)
        for (int i = 0; i < SIZE; ++i) s[i] += k[SIZE * j + i] * u.c[j];
} else {
    for (int j = 3; j < SIZE; ++j)
        for (int i = 0; i < SIZE; ++i) s[i] += k[step * (SIZE * j + i)] * u.c[j];
}
wp::vec_t<SIZE, REAL> f;
for (int i = 0; i < SIZE; ++i) f.c[i] = s[i];
for (int i = 0; i < 3; ++i) f.c[i] = 0;
return f;
"""
_BY_LAM = """
#pragma clang fp contract(fast) reassociate(on)
REAL total[9] = {}, value = 0;
for (int m = 1; m < SIZE / 3; ++m)
    for (int n = 1; n <= m; ++n) {
        const REAL* const e = &wp::index(blocks, shape, 9 * (m * (m + 1) / 2 + n));
        const REAL both = n < m ? 1 : 0;  // sides of a block off the diagonal
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                const REAL other = both * d.c[3 * m + i] * u.c[3 * n + j];
                total[3 * i + j] += e[3 * i + j] * (u.c[3 * m + i] * d.c[3 * n + j] + other);
            }
    }
for (int i = 0; i < 9; ++i) value += total[i];
for (int mode = 0; mode < modes; ++mode) {
    const REAL* const a = &wp::index(mode_mu, shape, SIZE * mode);
    const REAL* const b = &wp::index(mode_lam, shape, SIZE * mode);
    REAL cu = 0, cd = 0, bu = 0, bd = 0;
    for (int i = 3; i < SIZE; ++i) {
        const REAL c = mu * a[i] + lam * b[i];
        cu += c * u.c[i];
        cd += c * d.c[i];
        bu += b[i] * u.c[i];
        bd += b[i] * d.c[i];
    }
    const REAL ratio = wp::index(mode_ratio, shape, mode), over = 1 / (mu + lam * ratio);
    cu *= over;
    cd *= over;
    value -= bu * cd + cu * bd - ratio * cu * cd;
}
return value;
"""


def _native(variant: Variant, text: str) -> str:
    """A snippet for a scalar type; compilers for GPUs do not know its pragma."""
    text = text.replace("REAL", "double" if variant.real is wp.float64 else "float").replace("SIZE", str(SIZE))
    return text.replace("#pragma clang fp contract(fast) reassociate(on)\n", "") if variant.world_fastest else text


@cache
def functions(variant: Variant) -> SimpleNamespace:
    """Rotation, guard and products with K of one hexahedron; arrays are those of single worlds, (pack, row, lane)."""
    real, f = variant.real, of_tets(variant)
    vec3, mat33, tensor_cross = f.vec3, f.mat33, f.tensor_cross
    plain = variant if variant.lanes == 1 else lanes.variant("scalar")
    a, nearest = algebra(plain), hexahedral.functions(plain).nearest_rotation
    rows, vector = a.rows, a.vector
    corners_of = wp.types.vector(SIZE, real)
    vector_at = single.functions(variant).vector_at

    @wp.func
    def corner(v: corners_of, m: int):
        return vec3(v[3 * m], v[3 * m + 1], v[3 * m + 2])

    @wp.func
    def put_corner(v: corners_of, m: int, value: vec3):
        for c in range(3):
            v[3 * m + c] = value[c]
        return v

    @wp.func
    def edges(
        x: wp.array3d(dtype=real), pack: int, lane: int, hex_node: wp.array2d(dtype=wp.int32), hex: int, corners: int
    ):
        """A nodal field at the corners, from the first one."""
        d = corners_of()
        origin = vector_at(x, pack, lane, 3 * hex_node[hex, 0])
        for m in range(1, corners):
            d = put_corner(d, m, vector_at(x, pack, lane, 3 * hex_node[hex, m]) - origin)
        return d

    @wp.func
    def turned_back(d: corners_of, Q: mat33, corners: int):
        """Q' d_a."""
        y = corners_of()
        for m in range(1, corners):
            y = put_corner(y, m, wp.transpose(Q) * corner(d, m))
        return y

    @wp.func
    def gradient_of(d: corners_of, shape_gradient: wp.array2d(dtype=real), shape: int, corners: int):
        """sum d_a g_a'."""
        F = mat33()
        for m in range(1, corners):
            i = 3 * m
            g = vec3(shape_gradient[shape, i], shape_gradient[shape, i + 1], shape_gradient[shape, i + 2])
            F += wp.outer(corner(d, m), g)
        return F

    @wp.func
    def rotation(F: mat33):
        """That of the step, found as there."""
        x = vector(F[0, 0], F[0, 1], F[0, 2])
        y = vector(F[1, 0], F[1, 1], F[1, 2])
        Q = nearest(rows(x, y, vector(F[2, 0], F[2, 1], F[2, 2])))
        return mat33(Q.xx, Q.xy, Q.xz, Q.yx, Q.yy, Q.yz, Q.zx, Q.zy, Q.zz)

    @wp.func_native(_native(variant, _PRODUCT))
    def product(stiffness: wp.array3d(dtype=real), pack: int, lane: int, first: int, u: corners_of) -> corners_of:
        """K u from row ``first`` of K; the first corner has u = 0."""

    @wp.func
    def cross_sum(a: corners_of, b: corners_of, corners: int):
        """sum a_a x b_a."""
        total = vec3()
        for m in range(1, corners):
            total += wp.cross(corner(a, m), corner(b, m))
        return total

    @wp.func
    def inverse_of_turning(S: mat33):
        """Inverse of tr S 1 - S, bounded as in the step."""
        G = wp.trace(S) * wp.identity(n=3, dtype=real) - S
        C = real(0.5) * tensor_cross(G, G)
        return C / wp.max(wp.determinant(G), real(warped.LEAST))

    @wp.func
    def steepness(depth: real, guard: real):
        """(d / J0)^2 as far as it counts, and its slope by d."""
        relative = depth / guard
        if relative < real(1.0):
            return relative * relative, real(2.0) * relative / guard
        return real(1.0), real(0.0)

    @wp.func
    def pressure(depth: real, guard: real):
        """pi per lam + 2 mu, and its slope by J."""
        square, slope = steepness(depth, guard)
        growth = real(corotational.GUARD_GROWTH)
        value = depth * (real(1.0) + growth * square)
        return -real(corotational.GUARD) * value, real(corotational.GUARD) * (
            real(1.0) + growth * (square + depth * slope)
        )

    @wp.func
    def stiffened(depth: real, guard: real, F: mat33, shape_gradient: wp.array2d(dtype=real), shape: int, corners: int):
        """Factor r of the stiffness below the guard, and its gradient by F."""
        C = real(0.5) * tensor_cross(F, F)
        N = mat33()
        for m in range(corners):
            i = 3 * m
            g = vec3(shape_gradient[shape, i], shape_gradient[shape, i + 1], shape_gradient[shape, i + 2])
            N += wp.outer(g, g)
        square, slope = steepness(depth, guard)
        growth = real(3.0 * corotational.GUARD_GROWTH)
        steep = real(1.0) + growth * square
        ramp = wp.min(depth * real(corotational.GUARD_RAMP), real(1.0))
        climb = wp.where(ramp < real(1.0), real(corotational.GUARD_RAMP), real(0.0))
        widened = wp.ddot(C * N, C) / wp.trace(N)
        by_F = mat33()
        if widened > real(1.0):
            by_F = ramp * steep * real(2.0) / wp.trace(N) * tensor_cross(F, C * N)
        else:
            widened = real(1.0)
        by_F -= (climb * steep + ramp * growth * slope) * widened * C
        share = real(corotational.GUARD_TANGENT)
        return real(1.0) + share * ramp * steep * widened, share * by_F

    return SimpleNamespace(
        corners_of=corners_of,
        corner=corner,
        put_corner=put_corner,
        edges=edges,
        turned_back=turned_back,
        gradient_of=gradient_of,
        rotation=rotation,
        product=product,
        cross_sum=cross_sum,
        inverse_of_turning=inverse_of_turning,
        pressure=pressure,
        stiffened=stiffened,
    )


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Gradients of hexahedra for one scalar type and memory order."""
    f, one = functions(variant), single.functions(variant)
    real, vec3, mat33, tensor_cross = variant.real, one.vec3, one.mat33, of_tets(variant).tensor_cross
    put, corners_of, corner, put_corner, edges = one.put, f.corners_of, f.corner, f.put_corner, f.edges
    turned_back, gradient_of, rotation, product = f.turned_back, f.gradient_of, f.rotation, f.product
    cross_sum, inverse_of_turning, pressure, stiffened = f.cross_sum, f.inverse_of_turning, f.pressure, f.stiffened
    module = variant.module("adjoint.hexahedral")

    @wp.func
    def axial(A: mat33):
        """w of A - A' = [w]."""
        return vec3(A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1])

    @wp.func
    def dot(a: corners_of, b: corners_of):
        """sum a_a . b_a."""
        return wp.dot(a, b)

    @wp.func_native(_native(variant, _BY_LAM))
    def by_lam(
        blocks: wp.array2d(dtype=real),
        mode_mu: wp.array2d(dtype=real),
        mode_lam: wp.array2d(dtype=real),
        mode_ratio: wp.array2d(dtype=real),
        shape: int,
        mu: real,
        lam: real,
        modes: int,
        u: corners_of,
        d: corners_of,
    ) -> real:
        """u' dK/dlam d from the blocks of the corners and the modes."""

    @wp.kernel(module=module, enable_backward=False)
    def hex_adjoint(
        first: int,
        corners: int,
        modes: int,
        by_parameters: bool,
        h: real,
        # Model
        hex_node: wp.array2d(dtype=wp.int32),
        hex_body: wp.array(dtype=wp.int32),
        hex_shape: wp.array(dtype=wp.int32),
        hex_factor: wp.array(dtype=real),
        hex_volume: wp.array(dtype=real),
        shape_x: wp.array2d(dtype=real),
        shape_gradient: wp.array2d(dtype=real),
        shape_lam: wp.array2d(dtype=real),
        mode_mu: wp.array2d(dtype=real),
        mode_lam: wp.array2d(dtype=real),
        mode_ratio: wp.array2d(dtype=real),
        body_guard: wp.array(dtype=real),
        # Workspace in
        body_mu_in: wp.array3d(dtype=real),
        body_lam_in: wp.array3d(dtype=real),
        body_stiffness_in: wp.array3d(dtype=real),
        shape_stiffness_in: wp.array3d(dtype=real),
        node_x_in: wp.array3d(dtype=real),
        node_v_in: wp.array3d(dtype=real),
        node_p_in: wp.array3d(dtype=real),
        # Workspace out
        corner_out: wp.array3d(dtype=real),
        parameter_out: wp.array3d(dtype=real),
    ):
        """Gradient by the corners of one hexahedron, by mu and lam, and -r p' K v."""
        pack, hex, lane = wp.tid()
        shape = hex_shape[hex]
        body = hex_body[hex]
        d = edges(node_x_in, pack, lane, hex_node, hex, corners)
        F = gradient_of(d, shape_gradient, shape, corners)
        Q = rotation(F)
        S = wp.transpose(Q) * F
        y = turned_back(d, Q, corners)
        p = turned_back(edges(node_p_in, pack, lane, hex_node, hex, corners), Q, corners)
        v = turned_back(edges(node_v_in, pack, lane, hex_node, hex, corners), Q, corners)
        u = y
        for i in range(3 * corners):
            u[i] = y[i] - shape_x[shape, i]
        first_of_shape = wp.static(hexahedral.STORED_ROWS) * shape
        f = product(shape_stiffness_in, pack, lane, first_of_shape, u)
        A = gradient_of(p, shape_gradient, shape, corners)
        inverse = inverse_of_turning(S)
        w = inverse * axial(A)
        along = p
        for m in range(1, corners):
            along = put_corner(along, m, corner(p, m) - wp.cross(w, corner(y, m)))
        stiff_v = product(shape_stiffness_in, pack, lane, first_of_shape, v)
        stiff_p = product(shape_stiffness_in, pack, lane, first_of_shape, p)
        bent = product(shape_stiffness_in, pack, lane, first_of_shape, along)
        factor = hex_factor[hex]
        mu = body_mu_in[pack, body, lane]
        lam = body_lam_in[pack, body, lane]
        k = body_stiffness_in[pack, body, lane]
        work = dot(p, stiff_v)
        stiffness = work
        more = real(0.0)  # what the guard adds by lam + 2 mu
        by_F = mat33()  # what it adds, in the axes of the world
        guard = body_guard[body]
        depth = guard - wp.determinant(F)
        if depth > real(0.0):
            root, by_root = stiffened(depth, guard, F, shape_gradient, shape, corners)
            unit, slope = pressure(depth, guard)
            C = real(0.5) * tensor_cross(F, F)
            X = Q * A
            ratio = wp.ddot(C, X)
            volume = hex_volume[hex]
            more = h * volume * unit * ratio
            by_F = k * work * by_root
            by_F += h * volume * (lam + real(2.0) * mu) * (slope * ratio * C + unit * tensor_cross(F, X))
            stiffness = root * work
            k = root * k
        eta = inverse * cross_sum(y, f, corners)
        outer = wp.outer(eta, w)
        B = wp.dot(eta, w) * wp.identity(n=3, dtype=real) - real(0.5) * (outer + wp.transpose(outer))
        zeta = h * (axial(A * wp.skew(eta)) - axial(B * S) - cross_sum(p, f, corners))
        zeta -= k * (cross_sum(p, stiff_v, corners) + cross_sum(v, stiff_p, corners))
        for m in range(1, corners):
            alpha = h * (corner(bent, m) - wp.cross(corner(f, m), w))
            bent = put_corner(bent, m, alpha)
        theta = inverse * (zeta - cross_sum(y, bent, corners))
        local = h * B + wp.skew(theta)
        total = vec3()
        for m in range(1, corners):
            i = 3 * m
            g = vec3(shape_gradient[shape, i], shape_gradient[shape, i + 1], shape_gradient[shape, i + 2])
            force = -factor * (Q * (corner(bent, m) + local * g) + by_F * g)
            total += force
            put(corner_out, pack, lane, first + wp.static(SIZE) * hex + i, force)
        put(corner_out, pack, lane, first + wp.static(SIZE) * hex, -total)
        if by_parameters:
            lam_u = by_lam(shape_lam, mode_mu, mode_lam, mode_ratio, shape, mu, lam, modes, u, along)
            lam_v = by_lam(shape_lam, mode_mu, mode_lam, mode_ratio, shape, mu, lam, modes, p, v)
            mu_u = (dot(f, along) - lam * lam_u) / mu  # K is of first degree in mu and lam
            mu_v = (work - lam * lam_v) / mu
            row = wp.static(ROWS) * hex
            parameter_out[pack, row, lane] = -factor * (h * mu_u + k * mu_v + real(2.0) * more)
            parameter_out[pack, row + 1, lane] = -factor * (h * lam_u + k * lam_v + more)
            parameter_out[pack, row + wp.static(PARAMETERS), lane] = -factor * stiffness

    return SimpleNamespace(hex_adjoint=hex_adjoint)
