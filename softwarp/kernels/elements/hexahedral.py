"""Corotational hexahedra with incompatible modes. Theory, symbols and checks: docs/theory/hexahedral.md.

A hexahedron has the stiffness K of its rest shape, in axes of its own, and turns with the rotation Q nearest to the
mean F of its deformation gradient there. With y = Q' x and u = y - X, both from the first corner, its energy is
u' K u / 2. Forces are those of this energy: with f = K u, t = sum y_a x f_a and (tr S 1 - S) h = t for S = Q' F,

    f_a -> Q (f_a + g_a x h),

where g_a are the mean gradients of the corners' functions, and what they add balances moments. The tangent Q K Q' keeps
Q as it is. The guard of ``corotational`` acts on J = det F. Reference: Taylor, Beresford, Wilson (1976), A
non-conforming element for stress analysis.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import wide, wide_hexes
from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.algebra.vectors import algebra
from softwarp.kernels.elements import attachment, corotational, warped

CORNERS = 8
STORED_ROWS = 576  # of a shape: K by rows
ITERATIONS = warped.ITERATIONS
SAME = 1.0e-37  # Pa^2, square of a difference between moduli that are equal


@cache
def functions(variant: Variant) -> SimpleNamespace:
    """How blocks are read and turned, and how elements turn."""
    S = variant.S
    a = algebra(variant)
    Matrix, rows, read_vector = a.Matrix, a.rows, a.read_vector
    matmul, crossmul, transposed, row_x, row_y = a.matmul, a.crossmul, a.transposed, a.row_x, a.row_y
    element_frame = corotational.functions(variant).element_frame
    correction = warped.functions(variant).correction

    @wp.func
    def read_matrix(values: wp.array2d(dtype=S), w: int, row: int):
        """Nine numbers, row by row."""
        return rows(read_vector(values, w, row), read_vector(values, w, row + 3), read_vector(values, w, row + 6))

    @wp.func
    def read_block(stiffness: wp.array2d(dtype=S), w: int, shape: int, m: int, n: int):
        """K_mn of one shape."""
        i = shape * wp.static(STORED_ROWS) + 72 * m + 3 * n
        return rows(read_vector(stiffness, w, i), read_vector(stiffness, w, i + 24), read_vector(stiffness, w, i + 48))

    @wp.func
    def turned_block(
        stiffness: wp.array2d(dtype=S),
        rotation: wp.array2d(dtype=S),
        hex_shape: wp.array(dtype=wp.int32),
        w: int,
        code: int,
    ):
        """Q K_mn Q' of one hexahedron."""
        Q = read_matrix(rotation, w, 9 * (code >> 6))
        K = read_block(stiffness, w, hex_shape[code >> 6], (code >> 3) & 7, code & 7)
        return matmul(matmul(Q, K), transposed(Q))

    @wp.func
    def nearest_rotation(F: Matrix):
        """The rotation of the polar decomposition, from the axes of the first two columns as a start."""
        columns = transposed(F)
        Q = element_frame(row_x(columns), row_y(columns))
        M = crossmul(Q, F)
        for _ in range(wp.static(ITERATIONS)):
            Q = matmul(Q, correction(M))
            M = crossmul(Q, F)
        return Q

    return SimpleNamespace(
        read_matrix=read_matrix, turned_block=turned_block, read_block=read_block, nearest_rotation=nearest_rotation
    )


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels of hexahedra for one scalar type."""
    S, real, world_fastest = variant.S, variant.real, variant.world_fastest
    mul, div, sqrt, any_positive, select = variant.mul, variant.div, variant.sqrt, variant.any_positive, variant.select
    module = variant.module("hexahedral")
    a, f = algebra(variant), functions(variant)
    Vector, Matrix, Symmetric, rows = a.Vector, a.Matrix, a.Symmetric, a.rows
    row_x, row_y, row_z, transposed, crossmul = a.row_x, a.row_y, a.row_z, a.transposed, a.crossmul
    add, subtract, scaled, cross, matvec, apply = a.add, a.subtract, a.scaled, a.cross, a.matvec, a.apply
    dot = a.dot
    read_vector, write_vector, add_vector, constant = a.read_vector, a.write_vector, a.add_vector, a.constant
    add_outer, add_matrix, write_matrix, combination = a.add_outer, a.add_matrix, a.write_matrix, a.combination
    transformed = attachment.functions(variant).transformed
    read_matrix, read_block, turned_block = f.read_matrix, f.read_block, f.turned_block
    nearest_rotation = f.nearest_rotation

    @wp.kernel(module=module, enable_backward=False)
    def shape_stiffness(
        corners: int,
        modes: int,
        # Model
        shape_body: wp.array(dtype=wp.int32),
        shape_mu: wp.array2d(dtype=real),
        shape_lam: wp.array2d(dtype=real),
        mode_mu: wp.array2d(dtype=real),
        mode_lam: wp.array2d(dtype=real),
        mode_ratio: wp.array2d(dtype=real),
        # Workspace in
        body_mu_in: wp.array2d(dtype=S),
        body_lam_in: wp.array2d(dtype=S),
        # Workspace out
        shape_moduli_out: wp.array2d(dtype=S),
        shape_stiffness_out: wp.array2d(dtype=S),
    ):
        """K = mu K_mu + lam K_lam - sum (mu a + lam b) (mu a + lam b)' / (mu + lam s) of one shape [N/m].

        It stays where it was found with these moduli before.
        """
        w, shape = wp.tid()
        if wp.static(world_fastest):
            shape, w = wp.tid()
        mu = body_mu_in[w, shape_body[shape]]
        lam = body_lam_in[w, shape_body[shape]]
        by_mu = mu - shape_moduli_out[w, 2 * shape]
        by_lam = lam - shape_moduli_out[w, 2 * shape + 1]
        same = S(real(wp.static(SAME))) - (mul(by_mu, by_mu) + mul(by_lam, by_lam))
        if any_positive(select(same, S(real(0.0)), S(real(1.0)))):
            shape_moduli_out[w, 2 * shape] = mu
            shape_moduli_out[w, 2 * shape + 1] = lam
            place = int(0)
            for m in range(corners):
                for n in range(m + 1):
                    for entry in range(9):
                        value = mul(mu, S(shape_mu[shape, place])) + mul(lam, S(shape_lam[shape, place]))
                        for mode in range(modes):
                            i = 24 * mode + 3 * m + entry // 3
                            j = 24 * mode + 3 * n + entry % 3
                            left = mul(mu, S(mode_mu[shape, i])) + mul(lam, S(mode_lam[shape, i]))
                            right = mul(mu, S(mode_mu[shape, j])) + mul(lam, S(mode_lam[shape, j]))
                            value -= div(mul(left, right), mu + mul(lam, S(mode_ratio[shape, mode])))
                        row = 3 * m + entry // 3
                        column = 3 * n + entry % 3
                        shape_stiffness_out[w, wp.static(STORED_ROWS) * shape + 24 * row + column] = value
                        shape_stiffness_out[w, wp.static(STORED_ROWS) * shape + 24 * column + row] = value
                        place += 1

    @wp.func
    def mean_gradient(
        x: wp.array2d(dtype=S),
        w: int,
        hex_node: wp.array2d(dtype=wp.int32),
        hex: int,
        shape_gradient: wp.array2d(dtype=real),
        shape: int,
        corners: int,
    ):
        """F = sum (x_a - x_0) g_a' over the corners."""
        origin = read_vector(x, w, 3 * hex_node[hex, 0])
        F = Matrix()
        for m in range(1, corners):
            d = subtract(read_vector(x, w, 3 * hex_node[hex, m]), origin)
            F = add_outer(F, d, constant(shape_gradient, shape, 3 * m))
        return F

    @wp.func
    def balance(M: Matrix, t: Vector):
        """h of (tr S 1 - S) h = t with the symmetric part S of M."""
        half = real(0.5)
        sxy = (M.xy + M.yx) * half
        sxz = (M.xz + M.zx) * half
        syz = (M.yz + M.zy) * half
        gx = M.yy + M.zz
        gy = M.xx + M.zz
        gz = M.xx + M.yy
        c = Symmetric()  # cofactors
        c.xx = mul(gy, gz) - mul(syz, syz)
        c.yy = mul(gx, gz) - mul(sxz, sxz)
        c.zz = mul(gx, gy) - mul(sxy, sxy)
        c.xy = mul(sxy, gz) + mul(syz, sxz)
        c.xz = mul(sxz, gy) + mul(syz, sxy)
        c.yz = mul(syz, gx) + mul(sxy, sxz)
        det = mul(gx, c.xx) - mul(sxy, c.xy) - mul(sxz, c.xz)
        return apply(c, scaled(t, div(S(real(1.0)), wp.max(det, S(real(wp.static(warped.LEAST)))))))

    @wp.func
    def apply_each(
        stiffness: wp.array2d(dtype=S),
        strain: wp.array2d(dtype=S),
        w: int,
        shape: int,
        hex: int,
        out: int,
        force: wp.array2d(dtype=S),
    ):
        """K u of one hexahedron, whose first corner has u = 0, to rows ``out`` onwards."""
        corners = int(wp.static(CORNERS))
        for m in range(1, corners):
            f = Vector()
            for n in range(1, corners):
                f = add(f, matvec(read_block(stiffness, w, shape, m, n), read_vector(strain, w, 24 * hex + 3 * n)))
            write_vector(force, w, out + 3 * m, f)

    apply_stiffness = apply_each
    if wide.is_wide(variant):
        apply_stiffness = wide_hexes.apply_stiffness
    elif variant.lanes > 1:
        apply_stiffness = wide_hexes.apply_stiffness_of_lanes

    @wp.func
    def cofactor(M: Matrix):
        """dJ/dM of J = det M."""
        c = transposed(M)
        return transposed(rows(cross(row_y(c), row_z(c)), cross(row_z(c), row_x(c)), cross(row_x(c), row_y(c))))

    @wp.func
    def guarded(depth: S, guard: S, C: Matrix, shape_gradient: wp.array2d(dtype=real), shape: int, corners: int):
        """Root of the factor that the stiffness has where the volume ratio lies ``depth`` below the guard."""
        one = S(real(1.0))
        wider = S(real(0.0))
        plain = S(real(0.0))
        for m in range(corners):
            g = constant(shape_gradient, shape, 3 * m)
            slope = matvec(C, g)
            wider += dot(slope, slope)
            plain += dot(g, g)
        relative = wp.min(div(depth, guard), one)
        steep = one + mul(relative, relative) * real(3.0 * corotational.GUARD_GROWTH)
        ramp = wp.min(depth * real(corotational.GUARD_RAMP), one)
        widened = wp.max(div(wider, plain), one)
        return sqrt(one + mul(mul(ramp, steep), widened) * real(corotational.GUARD_TANGENT))

    @wp.func
    def guard_pressure(depth: S, guard: S, mu: S, lam: S):
        """dE/dJ per volume [Pa]: -k (lam + 2 mu) d (1 + 4 min(d / J0, 1)^2)."""
        relative = wp.min(div(depth, guard), S(real(1.0)))
        steep = depth + mul(depth, mul(relative, relative)) * real(corotational.GUARD_GROWTH)
        return mul(steep, lam + mu + mu) * real(-corotational.GUARD)

    @wp.kernel(module=module, enable_backward=False)
    def hex_force(
        first: int,
        corners: int,
        # Model
        hex_node: wp.array2d(dtype=wp.int32),
        hex_body: wp.array(dtype=wp.int32),
        hex_shape: wp.array(dtype=wp.int32),
        hex_factor: wp.array(dtype=real),
        hex_volume: wp.array(dtype=real),
        shape_x: wp.array2d(dtype=real),
        shape_gradient: wp.array2d(dtype=real),
        body_guard: wp.array(dtype=real),
        # Workspace in
        body_mu_in: wp.array2d(dtype=S),
        body_lam_in: wp.array2d(dtype=S),
        shape_stiffness_in: wp.array2d(dtype=S),
        node_x_in: wp.array2d(dtype=S),
        # Workspace out
        hex_rotation_out: wp.array2d(dtype=S),
        hex_strain_out: wp.array2d(dtype=S),
        element_force_out: wp.array2d(dtype=S),
    ):
        """Elastic corner forces dE/dx [N], at rows ``first`` onwards, Q and u [m] of one hexahedron.

        Q comes with the root of the factor that the guard gives the stiffness.
        """
        w, hex = wp.tid()
        if wp.static(world_fastest):
            hex, w = wp.tid()
        shape = hex_shape[hex]
        F = mean_gradient(node_x_in, w, hex_node, hex, shape_gradient, shape, corners)
        Q = nearest_rotation(F)
        M = crossmul(Q, F)
        origin = read_vector(node_x_in, w, 3 * hex_node[hex, 0])
        strain = 24 * hex
        write_vector(hex_strain_out, w, strain, Vector())
        for m in range(1, corners):
            d = subtract(read_vector(node_x_in, w, 3 * hex_node[hex, m]), origin)
            u = subtract(combination(d, Q), constant(shape_x, shape, 3 * m))
            write_vector(hex_strain_out, w, strain + 3 * m, u)
        out = first + 24 * hex
        apply_stiffness(shape_stiffness_in, hex_strain_out, w, shape, hex, out, element_force_out)
        torque = Vector()
        for m in range(1, corners):
            force = read_vector(element_force_out, w, out + 3 * m)
            y = add(read_vector(hex_strain_out, w, strain + 3 * m), constant(shape_x, shape, 3 * m))
            torque = add(torque, cross(y, force))
        h = balance(M, torque)
        factor = S(hex_factor[hex])
        body = hex_body[hex]
        guard = S(body_guard[body])
        C = cofactor(M)
        depth = wp.max(S(real(0.0)), guard - dot(row_x(M), row_x(C)))
        root = S(real(1.0))
        pressure = S(real(0.0))
        if any_positive(depth):
            root = guarded(depth, guard, C, shape_gradient, shape, corners)
            pressure = guard_pressure(depth, guard, body_mu_in[w, body], body_lam_in[w, body]) * hex_volume[hex]
        P = rows(scaled(row_x(C), pressure), scaled(row_y(C), pressure), scaled(row_z(C), pressure))
        write_matrix(
            hex_rotation_out, w, 9 * hex, rows(scaled(row_x(Q), root), scaled(row_y(Q), root), scaled(row_z(Q), root))
        )
        total = Vector()
        for m in range(1, corners):
            g = constant(shape_gradient, shape, 3 * m)
            force = add(add(read_vector(element_force_out, w, out + 3 * m), cross(g, h)), matvec(P, g))
            force = matvec(Q, scaled(force, factor))
            total = add(total, force)
            write_vector(element_force_out, w, out + 3 * m, force)
        write_vector(element_force_out, w, out, scaled(total, S(real(-1.0))))

    @wp.kernel(module=module, enable_backward=False)
    def block_stiffness(
        # Model
        hex_body: wp.array(dtype=wp.int32),
        hex_shape: wp.array(dtype=wp.int32),
        hex_factor: wp.array(dtype=real),
        hex_block: wp.array2d(dtype=wp.int32),
        entry_start: wp.array(dtype=wp.int32),
        entry: wp.array(dtype=wp.int32),
        # Workspace in
        body_stiffness_scale_in: wp.array2d(dtype=S),
        shape_stiffness_in: wp.array2d(dtype=S),
        hex_rotation_in: wp.array2d(dtype=S),
        # Workspace out
        a_out: wp.array2d(dtype=S),
    ):
        """Add Q K_mn Q' of all hexahedra around one 3x3 block of A, on a CPU around all."""
        w, part = wp.tid()
        begin_block = int(0)
        end_block = entry_start.shape[0] - 1
        if wp.static(world_fastest):
            part, w = wp.tid()
            begin_block = part
            end_block = part + 1
        if wp.static(wide.is_wide(variant)):
            wide_hexes.add_stiffness(
                w,
                hex_body,
                hex_shape,
                hex_factor,
                hex_block,
                body_stiffness_scale_in,
                shape_stiffness_in,
                hex_rotation_in,
                a_out,
            )
            return
        if wp.static(variant.lanes > 1):
            wide_hexes.add_stiffness_of_lanes(
                w,
                hex_body,
                hex_shape,
                hex_factor,
                entry_start,
                entry,
                body_stiffness_scale_in,
                shape_stiffness_in,
                hex_rotation_in,
                a_out,
            )
            return
        for block in range(begin_block, end_block):
            for p in range(entry_start[block], entry_start[block + 1]):
                code = entry[p]
                scale = body_stiffness_scale_in[w, hex_body[code >> 6]] * hex_factor[code >> 6]
                K = turned_block(shape_stiffness_in, hex_rotation_in, hex_shape, w, code)
                K = rows(scaled(row_x(K), scale), scaled(row_y(K), scale), scaled(row_z(K), scale))
                add_matrix(a_out, w, 9 * block, K)

    @wp.kernel(module=module, enable_backward=False)
    def carried_stiffness(
        # Model
        hex_body: wp.array(dtype=wp.int32),
        hex_shape: wp.array(dtype=wp.int32),
        hex_factor: wp.array(dtype=real),
        block: wp.array(dtype=wp.int32),
        entry_start: wp.array(dtype=wp.int32),
        entry: wp.array2d(dtype=wp.int32),
        # Workspace in
        body_stiffness_scale_in: wp.array2d(dtype=S),
        shape_stiffness_in: wp.array2d(dtype=S),
        hex_rotation_in: wp.array2d(dtype=S),
        lever_in: wp.array2d(dtype=S),
        # Workspace out
        a_out: wp.array2d(dtype=S),
    ):
        """The same for hexahedra with corners that frames carry; an entry is (64 hex + 8 m + n, left, right)."""
        w, place = wp.tid()
        if wp.static(world_fastest):
            place, w = wp.tid()
        for p in range(entry_start[place], entry_start[place + 1]):
            code = entry[p, 0]
            scale = body_stiffness_scale_in[w, hex_body[code >> 6]] * hex_factor[code >> 6]
            K = turned_block(shape_stiffness_in, hex_rotation_in, hex_shape, w, code)
            K = rows(scaled(row_x(K), scale), scaled(row_y(K), scale), scaled(row_z(K), scale))
            add_matrix(a_out, w, 9 * block[place], transformed(K, lever_in, w, entry[p, 1], entry[p, 2]))

    @wp.kernel(module=module, enable_backward=False)
    def held_damping(
        corners: int,
        # Model
        hex_node: wp.array2d(dtype=wp.int32),
        hex_body: wp.array(dtype=wp.int32),
        hex_shape: wp.array(dtype=wp.int32),
        hex_factor: wp.array(dtype=real),
        held_node: wp.array(dtype=wp.int32),
        entry_start: wp.array(dtype=wp.int32),
        entry: wp.array(dtype=wp.int32),
        # Workspace in
        rayleigh_stiffness_in: wp.array2d(dtype=S),
        shape_stiffness_in: wp.array2d(dtype=S),
        hex_rotation_in: wp.array2d(dtype=S),
        slot_v_in: wp.array2d(dtype=S),
        # Workspace out
        node_internal_out: wp.array2d(dtype=S),
    ):
        """Add beta K v of hexahedra at one carried node; an entry is 8 hex + corner."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        for p in range(entry_start[item], entry_start[item + 1]):
            hex = entry[p] >> 3
            Q = read_matrix(hex_rotation_in, w, 9 * hex)
            total = Vector()
            for n in range(corners):
                v = combination(read_vector(slot_v_in, w, 3 * hex_node[hex, n]), Q)
                total = add(total, matvec(read_block(shape_stiffness_in, w, hex_shape[hex], entry[p] & 7, n), v))
            beta = rayleigh_stiffness_in[w, hex_body[hex]] * hex_factor[hex]
            add_vector(node_internal_out, w, 3 * held_node[item], matvec(Q, scaled(total, beta)))

    return SimpleNamespace(
        shape_stiffness=shape_stiffness,
        hex_force=hex_force,
        block_stiffness=block_stiffness,
        carried_stiffness=carried_stiffness,
        held_damping=held_damping,
    )
