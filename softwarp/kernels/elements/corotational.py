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
from softwarp.kernels.elements import access

TURNED_ROWS = 12  # per tet: turned gradients of its corners
TURNED_BITS = 2  # of a corner in an entry
GUARD = 10.0  # k in lam + 2 mu; 20 with the same tangents blows up now and then: benchmarks/soak.py
GUARD_GROWTH = 4.0  # of the pressure k d (1 + 4 (d / J0)^2) up to J = 0
GUARD_TANGENT = 160.0  # share in the factor of K_ab of the pressure's slope: 16 times that of k
GUARD_RAMP = 20.0  # the factor has grown to that where J is 1/20 below J0


@cache
def functions(variant: Variant) -> SimpleNamespace:
    """Frames, strains, stresses and the guard on the elements of a variant."""
    S = variant.S
    real = variant.real
    mul, div, sqrt = variant.mul, variant.div, variant.sqrt
    a = algebra(variant)
    Vector, Matrix, Symmetric = a.Vector, a.Matrix, a.Symmetric
    rows, row_x, row_y, row_z, transposed = a.rows, a.row_x, a.row_y, a.row_z, a.transposed
    add, scaled, dot, dot_onto, cross = a.add, a.scaled, a.dot, a.dot_onto, a.cross

    @wp.func
    def element_frame(e: Vector, f: Vector):
        """Frame spanned by the edges e = b - a and f = c - a, in columns."""
        e1 = scaled(e, div(S(real(1.0)), sqrt(dot(e, e))))
        e3 = cross(e1, f)
        e3 = scaled(e3, div(S(real(1.0)), sqrt(dot(e3, e3))))
        return transposed(rows(e1, cross(e3, e1), e3))

    @wp.func
    def turned_strain(turned: Matrix, g: Matrix):
        """eps = sym(Q' F) - 1 from the edges turned back and the gradients, both in rows: Q' F = sum (Q' e_b) g_b'."""
        u = transposed(turned)
        v = transposed(g)
        one = S(real(1.0))
        half = real(0.5)
        eps = Symmetric()
        eps.xx = dot(row_x(u), row_x(v)) - one
        eps.yy = dot(row_y(u), row_y(v)) - one
        eps.zz = dot(row_z(u), row_z(v)) - one
        eps.xy = dot_onto(dot(row_x(u), row_y(v)), row_y(u), row_x(v)) * half
        eps.xz = dot_onto(dot(row_x(u), row_z(v)), row_z(u), row_x(v)) * half
        eps.yz = dot_onto(dot(row_y(u), row_z(v)), row_z(u), row_y(v)) * half
        return eps

    @wp.func
    def stress(eps: Symmetric, mu: S, lam: S):
        """2 mu eps + lam tr(eps) 1."""
        two_mu = mu + mu
        pressure = mul(lam, eps.xx + eps.yy + eps.zz)
        s = Symmetric()
        s.xx = mul(two_mu, eps.xx) + pressure
        s.yy = mul(two_mu, eps.yy) + pressure
        s.zz = mul(two_mu, eps.zz) + pressure
        s.xy = mul(two_mu, eps.xy)
        s.xz = mul(two_mu, eps.xz)
        s.yz = mul(two_mu, eps.yz)
        return s

    @wp.func
    def volume_ratio(e: Matrix, volume: S):
        """J = det(edges) / 6 V of a tet with the rest volume V."""
        return div(dot(row_x(e), cross(row_y(e), row_z(e))), volume * real(6.0))

    @wp.func
    def depth_below(guard: S, e: Matrix, volume: S):
        """How far J lies below the guard's, or 0."""
        return wp.max(S(real(0.0)), guard - volume_ratio(e, volume))

    @wp.func
    def ratio_gradients(e: Matrix, volume: S):
        """dJ/dx [1/m] of corners 1 to 3, in rows; a sixth of e_2 x e_3 over V, and so on."""
        by_volume = div(S(real(1.0)), volume * real(6.0))
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
    def guarded(depth: S, guard: S, ratio_gradient: Matrix, gradient: Matrix):
        """Root of the factor that the stiffness of an element has below the guard."""
        one = S(real(1.0))
        relative = wp.min(div(depth, guard), S(real(1.0)))
        slope = one + mul(relative, relative) * real(3.0 * GUARD_GROWTH)
        widened = div(square_of_corners(ratio_gradient), square_of_corners(gradient))
        ramp = wp.min(depth * real(GUARD_RAMP), one)
        return sqrt(one + mul(mul(ramp, slope), wp.max(widened, one)) * real(GUARD_TANGENT))

    @wp.func
    def upright_forces(depth: S, guard: S, ratio_gradient: Matrix, volume: S, mu: S, lam: S):
        """The guard's forces -V p dJ/dx of corners 1 to 3, in rows."""
        relative = wp.min(div(depth, guard), S(real(1.0)))
        steep = depth + mul(depth, mul(relative, relative)) * real(GUARD_GROWTH)
        pressure = mul(mul(steep, lam + mu + mu), volume) * real(-GUARD)
        return rows(
            scaled(row_x(ratio_gradient), pressure),
            scaled(row_y(ratio_gradient), pressure),
            scaled(row_z(ratio_gradient), pressure),
        )

    return SimpleNamespace(
        element_frame=element_frame,
        turned_strain=turned_strain,
        stress=stress,
        volume_ratio=volume_ratio,
        depth_below=depth_below,
        ratio_gradients=ratio_gradients,
        guarded=guarded,
        upright_forces=upright_forces,
    )


@cache
def force_kernels(variant: Variant) -> SimpleNamespace:
    """Forces of ``large`` tets, and what others with a rotation share with them."""
    at = access.functions(variant)
    inner = at.inner
    S, T, real, world_fastest = variant.S, inner.S, variant.real, variant.world_fastest
    mul, sqrt, any_positive = inner.mul, inner.sqrt, inner.any_positive
    module = variant.module("corotational.force")
    a, f = algebra(inner), functions(inner)
    Matrix, Symmetric = a.Matrix, a.Symmetric
    row_x, row_y, row_z, scaled, matvec, apply = a.row_x, a.row_y, a.row_z, a.scaled, a.matvec, a.apply
    matmul, transposed, summed = a.matmul, a.transposed, a.summed
    rows = a.rows
    element_frame, turned_strain, stress = f.element_frame, f.turned_strain, f.stress
    depth_below, ratio_gradients, guarded = f.depth_below, f.ratio_gradients, f.guarded
    upright_forces = f.upright_forces
    edges, gradients, of_body, of_tet, of_scene = at.edges, at.gradients, at.of_body, at.of_tet, at.of_scene
    write_corners = at.write_corners

    @wp.func
    def write_turned(
        Q: Matrix,
        s: Symmetric,
        e: Matrix,
        g: Matrix,
        mu: T,
        lam: T,
        guard: T,
        volume: T,
        whole: T,
        w: int,
        tet_index: wp.array(dtype=wp.int32),
        item: int,
        gradient: wp.array2d(dtype=S),
        force: wp.array2d(dtype=S),
    ):
        """Forces Q s g_b and turned gradients root(V) Q g_b, with the guard where J lies below it.

        ``volume`` is what counts, ``whole`` the volume of the tet.
        """
        root = sqrt(volume)
        forces = rows(matvec(Q, apply(s, row_x(g))), matvec(Q, apply(s, row_y(g))), matvec(Q, apply(s, row_z(g))))
        depth = depth_below(guard, e, whole)
        if any_positive(depth):
            slopes = ratio_gradients(e, whole)
            root = mul(root, guarded(depth, guard, slopes, g))
            forces = summed(forces, upright_forces(depth, guard, slopes, volume, mu, lam))
        turned = rows(
            scaled(matvec(Q, row_x(g)), root), scaled(matvec(Q, row_y(g)), root), scaled(matvec(Q, row_z(g)), root)
        )
        write_corners(gradient, w, tet_index, item, row_x(turned), row_y(turned), row_z(turned))
        write_corners(force, w, tet_index, item, row_x(forces), row_y(forces), row_z(forces))

    @wp.kernel(module=module, enable_backward=False)
    def tet_force(
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
        node_x_in: wp.array2d(dtype=S),
        # Workspace out
        tet_gradient_out: wp.array2d(dtype=S),
        tet_force_out: wp.array2d(dtype=S),
    ):
        """Elastic corner forces dE/dx [N] and turned shape gradients times sqrt(V) [m^1/2] of one tet.

        It counts with the volume V; ``tet_size`` is its own, four times that at one of four Gauss points.
        """
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        e = edges(node_x_in, w, tet_node, tet_index, item)
        g = gradients(tet_gradient, tet_index, item)
        # tet_frame holds the rest frame R0
        Q = matmul(element_frame(row_x(e), row_y(e)), transposed(gradients(tet_frame, tet_index, item)))
        volume = of_tet(tet_volume, tet_index, item)
        mu = of_body(body_mu_in, w, tet_body, tet_index, item)
        lam = of_body(body_lam_in, w, tet_body, tet_index, item)
        guard = of_scene(body_guard, tet_body, tet_index, item)
        s = stress(turned_strain(matmul(e, Q), g), mul(mu, volume), mul(lam, volume))  # rows Q' e_b
        write_turned(
            Q,
            s,
            e,
            g,
            mu,
            lam,
            guard,
            volume,
            of_tet(tet_size, tet_index, item),
            w,
            tet_index,
            item,
            tet_gradient_out,
            tet_force_out,
        )

    return SimpleNamespace(tet_force=tet_force, write_turned=write_turned)


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Stiffness of turned tets for one scalar type."""
    S, mul, world_fastest = variant.S, variant.mul, variant.world_fastest
    module = variant.module("corotational")
    a = algebra(variant)
    Matrix, vector, read_vector, add_matrix = a.Matrix, a.vector, a.read_vector, a.add_matrix
    rows, add_outer = a.rows, a.add_outer

    @wp.func
    def outer_sum(
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
    def isotropic(X: Matrix, mu: S, lam: S):
        """lam X + mu X' + mu tr(X) 1."""
        trace = mul(mu, X.xx + X.yy + X.zz)
        both = mu + lam
        return rows(
            vector(mul(both, X.xx) + trace, mul(lam, X.xy) + mul(mu, X.yx), mul(lam, X.xz) + mul(mu, X.zx)),
            vector(mul(lam, X.yx) + mul(mu, X.xy), mul(both, X.yy) + trace, mul(lam, X.yz) + mul(mu, X.zy)),
            vector(mul(lam, X.zx) + mul(mu, X.xz), mul(lam, X.zy) + mul(mu, X.yz), mul(both, X.zz) + trace),
        )

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
        """Add the stiffness of all turned tets around one 3x3 block of A, on a CPU around all.

        An entry is 4^bits tet + 2^bits a + b, a tet has ``rows_of_tet`` rows of gradients.
        With X = sum V ga gb' over the tets, the block is lam X + mu X' + mu tr(X) 1.
        """
        w, part = wp.tid()
        first = int(0)
        last = entry_start.shape[0] - 1
        if wp.static(world_fastest):
            part, w = wp.tid()
            first = part
            last = part + 1
        if wp.static(wide.is_wide(variant)):
            wide.add_isotropic(
                w,
                rows_of_tet,
                bits,
                tet_body,
                entry_start,
                entry,
                body_mu_in,
                body_lam_in,
                body_stiffness_scale_in,
                tet_gradient_in,
                a_out,
            )
            return
        for block in range(first, last):
            begin = entry_start[block]
            end = entry_start[block + 1]
            if begin < end:
                X = outer_sum(tet_gradient_in, w, begin, end, entry, rows_of_tet, bits)
                body = tet_body[entry[begin] >> (2 * bits)]
                scale = body_stiffness_scale_in[w, body]
                mu = mul(scale, body_mu_in[w, body])
                lam = mul(scale, body_lam_in[w, body])
                add_matrix(a_out, w, 9 * block, isotropic(X, mu, lam))

    return SimpleNamespace(isotropic=isotropic, block_stiffness=block_stiffness)
