"""Corotational linear tetrahedra with the rotation of the element's edges. Theory: docs/theory/corotational.md.

The frame of a tet is e1 along edge ab, e3 normal to abc, e2 = e3 x e1; Q turns the rest frame into the present one.
Strain is linear in the turned-back deformation gradient, eps = sym(Q' F) - 1, and the tangent drops dQ:
K_ab = V [lam ga gb' + mu gb ga' + mu (ga . gb) 1] with the rotated shape gradients ga = Q grad N_a. It is symmetric
positive semidefinite for every configuration. Reference: Nesme, Payan, Faure (2005); Felippa (2000).

Linear strain lets an element be pressed flat and through itself. A guard keeps it upright: the energy
V k d^2 (1/2 + (d / J0)^2) where the volume ratio J lies d below J0, and from J = 0 on V k (5/2 d^2 - J0^2), whose
pressure is five times that of k. Its tangent is a larger factor of K_ab.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import wide
from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.algebra.vectors import algebra

TURNED_ROWS = 12  # per tet: turned gradients of its corners
TURNED_BITS = 2  # of a corner in an entry
GUARD = 10.0  # k in lam + 2 mu; 20 with the same tangents blows up now and then: benchmarks/soak.py
GUARD_GROWTH = 4.0  # of the pressure k d (1 + 4 (d / J0)^2) up to J = 0
GUARD_TANGENT = 160.0  # share in the factor of K_ab of the pressure's slope: 16 times that of k
GUARD_RAMP = 20.0  # the factor has grown to that where J is 1/20 below J0


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels of the ``large`` corotational tet for one scalar type."""
    S = variant.S
    real = variant.real
    mul, div, sqrt, any_positive = variant.mul, variant.div, variant.sqrt, variant.any_positive
    world_fastest = variant.world_fastest
    module = variant.module("corotational")
    a = algebra(variant)
    Vector, Matrix, Symmetric = a.Vector, a.Matrix, a.Symmetric
    vector, read_vector, write_vector, constant = a.vector, a.read_vector, a.write_vector, a.constant
    add_matrix, add_vector, rows, row_x, row_y, row_z = a.add_matrix, a.add_vector, a.rows, a.row_x, a.row_y, a.row_z
    add, subtract, scaled, dot, dot_onto, cross = a.add, a.subtract, a.scaled, a.dot, a.dot_onto, a.cross
    transposed, matmul, matvec, apply, add_outer = a.transposed, a.matmul, a.matvec, a.apply, a.add_outer

    @wp.func
    def element_frame(e: Vector, f: Vector):
        """Frame spanned by the edges e = b - a and f = c - a, in columns."""
        e1 = scaled(e, div(S(real(1.0)), sqrt(dot(e, e))))
        e3 = cross(e1, f)
        e3 = scaled(e3, div(S(real(1.0)), sqrt(dot(e3, e3))))
        return transposed(rows(e1, cross(e3, e1), e3))

    @wp.func
    def constants(values: wp.array2d(dtype=real), i: int):
        """Nine numbers that all worlds share, row by row."""
        return rows(constant(values, i, 0), constant(values, i, 3), constant(values, i, 6))

    @wp.func
    def edges(x: wp.array2d(dtype=S), w: int, tet_node: wp.array2d(dtype=wp.int32), tet: int):
        """Edges from corner 0 to the others, in rows."""
        origin = read_vector(x, w, 3 * tet_node[tet, 0])
        return rows(
            subtract(read_vector(x, w, 3 * tet_node[tet, 1]), origin),
            subtract(read_vector(x, w, 3 * tet_node[tet, 2]), origin),
            subtract(read_vector(x, w, 3 * tet_node[tet, 3]), origin),
        )

    @wp.func
    def turned_strain(turned: Matrix, g: Matrix):
        """eps = sym(Q' F) - 1 from the edges turned back and the gradients, both in rows: Q' F = sum (Q' e_b) g_b'."""
        u = transposed(turned)
        v = transposed(g)
        one = S(real(1.0))
        half = real(0.5)
        e = Symmetric()
        e.xx = dot(row_x(u), row_x(v)) - one
        e.yy = dot(row_y(u), row_y(v)) - one
        e.zz = dot(row_z(u), row_z(v)) - one
        e.xy = dot_onto(dot(row_x(u), row_y(v)), row_y(u), row_x(v)) * half
        e.xz = dot_onto(dot(row_x(u), row_z(v)), row_z(u), row_x(v)) * half
        e.yz = dot_onto(dot(row_y(u), row_z(v)), row_z(u), row_y(v)) * half
        return e

    @wp.func
    def stress(e: Symmetric, mu: S, lam: S):
        """2 mu eps + lam tr(eps) 1."""
        two_mu = mu + mu
        pressure = mul(lam, e.xx + e.yy + e.zz)
        s = Symmetric()
        s.xx = mul(two_mu, e.xx) + pressure
        s.yy = mul(two_mu, e.yy) + pressure
        s.zz = mul(two_mu, e.zz) + pressure
        s.xy = mul(two_mu, e.xy)
        s.xz = mul(two_mu, e.xz)
        s.yz = mul(two_mu, e.yz)
        return s

    @wp.func
    def volume_ratio(e: Matrix, volume: real):
        """J = det(edges) / 6 V of a tet with the rest volume V."""
        return dot(row_x(e), cross(row_y(e), row_z(e))) * (real(1.0) / (real(6.0) * volume))

    @wp.func
    def depth_below(guard: real, e: Matrix, volume: real):
        """How far J lies below the guard's, or 0."""
        return wp.max(S(real(0.0)), S(guard) - volume_ratio(e, volume))

    @wp.func
    def ratio_gradients(e: Matrix, volume: real):
        """dJ/dx [1/m] of corners 1 to 3, in rows; a sixth of e_2 x e_3 over V, and so on."""
        by_volume = S(real(1.0) / (real(6.0) * volume))
        return rows(
            scaled(cross(row_y(e), row_z(e)), by_volume),
            scaled(cross(row_z(e), row_x(e)), by_volume),
            scaled(cross(row_x(e), row_y(e)), by_volume),
        )

    @wp.func
    def square_of_corners(g: Matrix):
        """Sum of the squares of four vectors, of which three stand in rows and the fourth balances them."""
        other = add(add(row_x(g), row_y(g)), row_z(g))
        total = dot(row_x(g), row_x(g)) + dot(row_y(g), row_y(g))
        return total + dot(row_z(g), row_z(g)) + dot(other, other)

    @wp.func
    def guarded(depth: S, guard: real, ratio_gradient: Matrix, gradient: Matrix):
        """Root of the factor that the stiffness of an element has below the guard."""
        one = S(real(1.0))
        relative = wp.min(depth * (real(1.0) / guard), S(real(1.0)))
        slope = one + mul(relative, relative) * real(3.0 * GUARD_GROWTH)
        widened = div(square_of_corners(ratio_gradient), square_of_corners(gradient))
        ramp = wp.min(depth * real(GUARD_RAMP), one)
        return sqrt(one + mul(mul(ramp, slope), wp.max(widened, one)) * real(GUARD_TANGENT))

    @wp.func
    def hold_upright(
        depth: S,
        guard: real,
        ratio_gradient: Matrix,
        volume: real,
        mu: S,
        lam: S,
        force: wp.array2d(dtype=S),
        w: int,
        tet: int,
    ):
        """Add the guard's corner forces -V p dJ/dx."""
        relative = wp.min(depth * (real(1.0) / guard), S(real(1.0)))
        steep = depth + mul(depth, mul(relative, relative)) * real(GUARD_GROWTH)
        pressure = mul(steep, lam + mu + mu) * (volume * real(-GUARD))
        b = scaled(row_x(ratio_gradient), pressure)
        c = scaled(row_y(ratio_gradient), pressure)
        d = scaled(row_z(ratio_gradient), pressure)
        row = 12 * tet
        add_vector(force, w, row, scaled(add(add(b, c), d), S(real(-1.0))))
        add_vector(force, w, row + 3, b)
        add_vector(force, w, row + 6, c)
        add_vector(force, w, row + 9, d)

    @wp.func
    def write_corners(
        Q: Matrix,
        s: Symmetric,
        tet_gradient: wp.array2d(dtype=real),
        root: S,
        gradient: wp.array2d(dtype=S),
        force: wp.array2d(dtype=S),
        w: int,
        tet: int,
    ):
        """Turned gradients ``root`` Q g_b and forces Q s g_b of corners 1 to 3; those of corner 0 balance them."""
        none = S(real(0.0))
        g_sum = vector(none, none, none)
        f_sum = vector(none, none, none)
        row = 12 * tet
        for corner in range(3):
            gb = constant(tet_gradient, tet, 3 * corner)
            turned = scaled(matvec(Q, gb), root)
            f = matvec(Q, apply(s, gb))
            write_vector(gradient, w, row + 3 * corner + 3, turned)
            write_vector(force, w, row + 3 * corner + 3, f)
            g_sum = subtract(g_sum, turned)
            f_sum = subtract(f_sum, f)
        write_vector(gradient, w, row, g_sum)
        write_vector(force, w, row, f_sum)

    @wp.kernel(module=module, enable_backward=False)
    def tet_force(
        share: real,
        # Model
        tet_index: wp.array(dtype=wp.int32),
        tet_node: wp.array2d(dtype=wp.int32),
        tet_body: wp.array(dtype=wp.int32),
        tet_gradient: wp.array2d(dtype=real),
        tet_volume: wp.array(dtype=real),
        tet_frame: wp.array2d(dtype=real),
        body_guard: wp.array(dtype=real),
        # Workspace in
        body_mu_in: wp.array2d(dtype=S),
        body_lam_in: wp.array2d(dtype=S),
        node_x_in: wp.array2d(dtype=S),
        # Workspace out
        tet_gradient_out: wp.array2d(dtype=S),
        tet_force_out: wp.array2d(dtype=S),
    ):
        """Elastic corner forces dE/dx [N] and turned shape gradients times sqrt(V) [m^1/2] of one tet.

        It counts with the volume V, ``share`` of its own: all, or a quarter at one of four Gauss points.
        """
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        tet = tet_index[item]
        e = edges(node_x_in, w, tet_node, tet)
        # tet_frame holds the rest frame R0
        Q = matmul(element_frame(row_x(e), row_y(e)), transposed(constants(tet_frame, tet)))
        turned = matmul(e, Q)  # rows Q' e_b
        body = tet_body[tet]
        volume = tet_volume[tet]
        mu = body_mu_in[w, body]
        lam = body_lam_in[w, body]
        s = stress(turned_strain(turned, constants(tet_gradient, tet)), mu * volume, lam * volume)
        root = S(wp.sqrt(volume))
        guard = body_guard[body]
        depth = depth_below(guard, e, volume / share)
        if any_positive(depth):
            root = mul(root, guarded(depth, guard, ratio_gradients(e, volume / share), constants(tet_gradient, tet)))
        write_corners(Q, s, tet_gradient, root, tet_gradient_out, tet_force_out, w, tet)
        if any_positive(depth):
            hold_upright(depth, guard, ratio_gradients(e, volume / share), volume, mu, lam, tet_force_out, w, tet)

    @wp.func
    def outer_each(
        gradient: wp.array2d(dtype=S),
        w: int,
        begin: int,
        end: int,
        entry: wp.array(dtype=wp.int32),
        rows_of_tet: int,
        bits: int,
    ):
        """Sum of ``g_a g_b'`` over pairs of an element's nodes; an entry is 4^bits element + 2^bits a + b."""
        mask = (1 << bits) - 1
        x = Matrix()
        for p in range(begin, end):
            code = entry[p]
            row = (code >> (2 * bits)) * rows_of_tet
            i = row + 3 * ((code >> bits) & mask)
            x = add_outer(x, read_vector(gradient, w, i), read_vector(gradient, w, row + 3 * (code & mask)))
        return x

    @wp.func
    def outer_wide(
        gradient: wp.array2d(dtype=wp.float32),
        w: int,
        begin: int,
        end: int,
        entry: wp.array(dtype=wp.int32),
        rows_of_tet: int,
        bits: int,
    ):
        """The same for one world in float32."""
        x = wide.outer_sum(gradient, w, begin, end, entry, rows_of_tet, bits)
        return rows(vector(x[0], x[1], x[2]), vector(x[3], x[4], x[5]), vector(x[6], x[7], x[8]))

    @wp.func
    def isotropic(X: Matrix, mu: S, lam: S):
        """lam X + mu X' + mu tr(X) 1."""
        trace = mul(mu, X.xx + X.yy + X.zz)
        both = mu + lam
        return rows(
            vector(mul(both, X.xx) + trace, mul(lam, X.xy) + mul(mu, X.yx), mul(lam, X.xz) + mul(mu, X.zx)),
            vector(mul(lam, X.yx) + mul(mu, X.xy), mul(both, X.yy) + trace, mul(lam, X.yz) + mul(mu, X.zy)),
            vector(mul(lam, X.zx) + mul(mu, X.xz), mul(lam, X.zy) + mul(mu, X.yz), mul(both, X.zz) + trace),
        )

    outer_sum = outer_wide if wide.is_wide(variant) else outer_each

    @wp.kernel(module=module, enable_backward=False)
    def block_stiffness(
        rows_of_tet: int,
        bits: int,
        # Model
        tet_body: wp.array(dtype=wp.int32),
        entry_start: wp.array(dtype=wp.int32),
        entry: wp.array(dtype=wp.int32),
        # Workspace in
        body_mu_in: wp.array2d(dtype=S),
        body_lam_in: wp.array2d(dtype=S),
        body_stiffness_scale_in: wp.array2d(dtype=S),
        tet_gradient_in: wp.array2d(dtype=S),
        # Workspace out
        a_out: wp.array2d(dtype=S),
    ):
        """Add the stiffness of all turned tets, or Gauss points of quadratic ones, around one 3x3 block of A.

        An entry is 4^bits tet + 2^bits a + b, a tet has ``rows_of_tet`` rows of gradients.
        With X = sum V ga gb' over the tets, the block is lam X + mu X' + mu tr(X) 1.
        """
        w, block = wp.tid()
        if wp.static(world_fastest):
            block, w = wp.tid()
        begin = entry_start[block]
        end = entry_start[block + 1]
        if begin < end:
            X = outer_sum(tet_gradient_in, w, begin, end, entry, rows_of_tet, bits)
            body = tet_body[entry[begin] >> (2 * bits)]
            scale = body_stiffness_scale_in[w, body]
            mu = mul(scale, body_mu_in[w, body])
            lam = mul(scale, body_lam_in[w, body])
            add_matrix(a_out, w, 9 * block, isotropic(X, mu, lam))

    return SimpleNamespace(
        element_frame=element_frame,
        constants=constants,
        edges=edges,
        volume_ratio=volume_ratio,
        depth_below=depth_below,
        ratio_gradients=ratio_gradients,
        guarded=guarded,
        hold_upright=hold_upright,
        write_corners=write_corners,
        isotropic=isotropic,
        tet_force=tet_force,
        block_stiffness=block_stiffness,
    )
