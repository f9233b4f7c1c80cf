"""Sums over elements: nodal forces, the block matrix A, its product with a vector and the right-hand side.

One implicit Euler iteration at velocity v solves  A dv = b  with, per node of a body with Rayleigh factors alpha, beta,
    A = m_scale M + k_scale K,   m_scale = 1 + h alpha,   k_scale = h (h + beta)
    b = f_scale (f_ext - f_int) + M v0 - m_scale M v - d_scale (A v - m_scale M v),   d_scale = beta / (h + beta)
and the quasi-static mode the same with m_scale a pseudo-mass factor, k_scale = f_scale = 1, M v0 = 0 and d_scale = 0.
Starting from v = 0 the first iterate is SOFA's one-linearisation step. Theory: docs/theory/implicit_euler.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import wide
from softwarp.kernels.algebra.lanes import Variant


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Assembly kernels for one scalar type."""
    S = variant.S
    real = variant.real
    mul, div, sqrt = variant.mul, variant.div, variant.sqrt
    world_fastest = variant.world_fastest
    module = variant.module("assembly")

    @wp.func_native("__builtin_memset(&wp::index(rows_out, w, 0), 0, rows_out.shape[1] * sizeof(rows_out.data[0]));")
    def clear(rows_out: wp.array2d(dtype=S), w: int):
        """Set all numbers of a world or pack to zero; on a CPU."""

    @wp.kernel(module=module, enable_backward=False)
    def body_moduli(
        # Workspace in
        youngs_in: wp.array2d(dtype=S),
        nu_in: wp.array2d(dtype=S),
        rayleigh_mass_in: wp.array2d(dtype=S),
        rayleigh_stiffness_in: wp.array2d(dtype=S),
        h: real,
        # Workspace out
        body_mu_out: wp.array2d(dtype=S),
        body_lam_out: wp.array2d(dtype=S),
        body_mass_scale_out: wp.array2d(dtype=S),
        body_stiffness_scale_out: wp.array2d(dtype=S),
        body_damping_scale_out: wp.array2d(dtype=S),
    ):
        """Lame constants and the factors of M and K in A, per body; a step h <= 0 selects the quasi-static mode."""
        w, body = wp.tid()
        if wp.static(world_fastest):
            body, w = wp.tid()
        one = S(real(1.0))
        youngs = youngs_in[w, body]
        nu = nu_in[w, body]
        mu = div(youngs, (one + nu) * real(2.0))
        body_mu_out[w, body] = mu
        body_lam_out[w, body] = div(mul(mu * real(2.0), nu), one - nu * real(2.0))
        if h > real(0.0):
            beta = rayleigh_stiffness_in[w, body]
            body_mass_scale_out[w, body] = one + rayleigh_mass_in[w, body] * h
            body_stiffness_scale_out[w, body] = (S(h) + beta) * h
            body_damping_scale_out[w, body] = div(beta, S(h) + beta)
        else:
            body_stiffness_scale_out[w, body] = one
            body_damping_scale_out[w, body] = S(real(0.0))

    @wp.kernel(module=module, enable_backward=False)
    def damping_scales(
        first: int,
        # Workspace in
        rayleigh_mass_in: wp.array2d(dtype=S),
        rayleigh_stiffness_in: wp.array2d(dtype=S),
        h: real,
        # Workspace out
        body_mass_scale_out: wp.array2d(dtype=S),
        body_stiffness_scale_out: wp.array2d(dtype=S),
        body_damping_scale_out: wp.array2d(dtype=S),
    ):
        """Factors of M and K in A for a rod or a rigid body, at row ``first`` onwards of the body arrays."""
        w, part = wp.tid()
        if wp.static(world_fastest):
            part, w = wp.tid()
        beta = rayleigh_stiffness_in[w, part]
        body_mass_scale_out[w, first + part] = S(real(1.0)) + rayleigh_mass_in[w, part] * h
        body_stiffness_scale_out[w, first + part] = (S(h) + beta) * h
        body_damping_scale_out[w, first + part] = div(beta, S(h) + beta)

    @wp.func
    def corner_sum_each(tet_force: wp.array2d(dtype=S), w: int, begin: int, end: int, corner: wp.array(dtype=wp.int32)):
        """Sum of the forces of some corners of elements."""
        f0 = S(real(0.0))
        f1 = S(real(0.0))
        f2 = S(real(0.0))
        for p in range(begin, end):
            k = 3 * corner[p]
            f0 += tet_force[w, k]
            f1 += tet_force[w, k + 1]
            f2 += tet_force[w, k + 2]
        return f0, f1, f2

    @wp.func
    def corner_sum_wide(
        tet_force: wp.array2d(dtype=wp.float32), w: int, begin: int, end: int, corner: wp.array(dtype=wp.int32)
    ):
        """The same for one world in float32."""
        s = wide.corner_sum(tet_force, w, begin, end, corner)
        return s[0], s[1], s[2]

    corner_sum = corner_sum_wide if wide.is_wide(variant) else corner_sum_each

    @wp.kernel(module=module, enable_backward=False)
    def node_forces(
        # Model
        node_body: wp.array(dtype=wp.int32),
        node_volume: wp.array(dtype=real),
        node_heft: wp.array(dtype=real),
        node_load: wp.array2d(dtype=real),
        corner_start: wp.array(dtype=wp.int32),
        corner: wp.array(dtype=wp.int32),
        # Workspace in
        density_in: wp.array2d(dtype=S),
        gravity_in: wp.array2d(dtype=S),
        node_force_in: wp.array2d(dtype=S),
        tet_force_in: wp.array2d(dtype=S),
        # Workspace out
        node_mass_out: wp.array2d(dtype=S),
        node_internal_out: wp.array2d(dtype=S),
        node_external_out: wp.array2d(dtype=S),
    ):
        """Lumped mass [kg], elastic force dE/dx [N] and external force [N] of one node, on a CPU of all."""
        w, part = wp.tid()
        first = int(0)
        last = corner_start.shape[0] - 1
        if wp.static(world_fastest):
            part, w = wp.tid()
            first = part
            last = part + 1
        for node in range(first, last):
            density = density_in[w, node_body[node]]
            node_mass_out[w, node] = density * node_volume[node]
            heavy = density * node_heft[node]
            row = 3 * node
            f0, f1, f2 = corner_sum(tet_force_in, w, corner_start[node], corner_start[node + 1], corner)
            node_internal_out[w, row] = f0
            node_internal_out[w, row + 1] = f1
            node_internal_out[w, row + 2] = f2
            for c in range(3):
                external = mul(heavy, gravity_in[w, c]) + S(node_load[node, c]) + node_force_in[w, row + c]
                node_external_out[w, row + c] = external

    @wp.kernel(module=module, enable_backward=False)
    def node_loads(
        # Model
        node_body: wp.array(dtype=wp.int32),
        node_heft: wp.array(dtype=real),
        node_load: wp.array2d(dtype=real),
        # Workspace in
        density_in: wp.array2d(dtype=S),
        gravity_in: wp.array2d(dtype=S),
        node_force_in: wp.array2d(dtype=S),
        # Workspace out
        node_external_out: wp.array2d(dtype=S),
    ):
        """Of ``node_forces`` the external force [N] alone."""
        w, part = wp.tid()
        first = int(0)
        last = node_heft.shape[0]
        if wp.static(world_fastest):
            part, w = wp.tid()
            first = part
            last = part + 1
        for node in range(first, last):
            heavy = density_in[w, node_body[node]] * node_heft[node]
            for c in range(3):
                external = mul(heavy, gravity_in[w, c]) + S(node_load[node, c]) + node_force_in[w, 3 * node + c]
                node_external_out[w, 3 * node + c] = external

    @wp.kernel(module=module, enable_backward=False)
    def block_mass(
        # Model
        size: int,
        node_count: int,
        dof_node: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        mass_body: wp.array(dtype=wp.int32),
        mass_volume: wp.array(dtype=real),
        # Workspace in
        body_mass_scale_in: wp.array2d(dtype=S),
        node_mass_in: wp.array2d(dtype=S),
        density_in: wp.array2d(dtype=S),
        # Workspace out
        a_out: wp.array2d(dtype=S),
    ):
        """Set a 3x3 block of A to its inertia: m_scale m of a node on the diagonal, zero elsewhere; on a CPU all.

        To these come m_scale rho C of a consistent mass, if ``mass_volume`` has C for every block.
        """
        w, part = wp.tid()
        first = int(0)
        last = wp.max(size, mass_volume.shape[0])
        if wp.static(world_fastest):
            part, w = wp.tid()
            first = part
            last = part + 1
        else:
            clear(a_out, w)
        for block in range(first, last):
            value = S(real(0.0))
            if block < size:
                node = dof_node[block]
                if node < node_count:
                    value = mul(body_mass_scale_in[w, node_body[node]], node_mass_in[w, node])
            if mass_volume.shape[0] > 0:
                body = mass_body[block]
                value += mul(density_in[w, body], body_mass_scale_in[w, body]) * mass_volume[block]
            if wp.static(world_fastest):
                for c in range(9):
                    a_out[w, 9 * block + c] = S(real(0.0))
            for c in range(3):
                a_out[w, 9 * block + 4 * c] = value

    @wp.func
    def row_product_each(
        a: wp.array2d(dtype=S),
        x: wp.array2d(dtype=S),
        w: int,
        i: int,
        neighbour_start: wp.array(dtype=wp.int32),
        neighbour: wp.array(dtype=wp.int32),
        neighbour_block: wp.array(dtype=wp.int32),
    ):
        """Block row i of A x; ``neighbour_block`` is negative (bitwise not) where the stored block is the transpose."""
        r0 = S(real(0.0))
        r1 = S(real(0.0))
        r2 = S(real(0.0))
        for p in range(neighbour_start[i], neighbour_start[i + 1]):
            j = 3 * neighbour[p]
            code = neighbour_block[p]
            x0 = x[w, j]
            x1 = x[w, j + 1]
            x2 = x[w, j + 2]
            if code >= 0:
                b = 9 * code
                r0 += mul(a[w, b], x0) + mul(a[w, b + 1], x1) + mul(a[w, b + 2], x2)
                r1 += mul(a[w, b + 3], x0) + mul(a[w, b + 4], x1) + mul(a[w, b + 5], x2)
                r2 += mul(a[w, b + 6], x0) + mul(a[w, b + 7], x1) + mul(a[w, b + 8], x2)
            else:
                b = 9 * (~code)
                r0 += mul(a[w, b], x0) + mul(a[w, b + 3], x1) + mul(a[w, b + 6], x2)
                r1 += mul(a[w, b + 1], x0) + mul(a[w, b + 4], x1) + mul(a[w, b + 7], x2)
                r2 += mul(a[w, b + 2], x0) + mul(a[w, b + 5], x1) + mul(a[w, b + 8], x2)
        return r0, r1, r2

    @wp.func
    def row_product_wide(
        a: wp.array2d(dtype=wp.float32),
        x: wp.array2d(dtype=wp.float32),
        w: int,
        i: int,
        neighbour_start: wp.array(dtype=wp.int32),
        neighbour: wp.array(dtype=wp.int32),
        neighbour_block: wp.array(dtype=wp.int32),
    ):
        """The same for one world in float32."""
        begin = neighbour_start[i]
        s = wide.symmetric_row_sum(a, x, w, begin, neighbour_start[i + 1], neighbour, neighbour_block)
        return s[0] + s[1] + s[2], s[3] + s[4] + s[5], s[6] + s[7] + s[8]

    row_product = row_product_wide if wide.is_wide(variant) else row_product_each

    @wp.kernel(module=module, enable_backward=False)
    def right_hand_side(
        # Model
        node_count: int,
        dof_node: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        neighbour_start: wp.array(dtype=wp.int32),
        neighbour: wp.array(dtype=wp.int32),
        neighbour_block: wp.array(dtype=wp.int32),
        # Workspace in
        body_mass_scale_in: wp.array2d(dtype=S),
        body_damping_scale_in: wp.array2d(dtype=S),
        node_mass_in: wp.array2d(dtype=S),
        node_internal_in: wp.array2d(dtype=S),
        node_external_in: wp.array2d(dtype=S),
        node_v0_in: wp.array2d(dtype=S),
        a_in: wp.array2d(dtype=S),
        dof_v_in: wp.array2d(dtype=S),
        f_scale: real,
        inertia: real,
        moving: bool,
        # Workspace out
        b_out: wp.array2d(dtype=S),
    ):
        """b of the module docstring for one free node, on a CPU for all; ``moving`` says that v is not zero."""
        w, part = wp.tid()
        first = int(0)
        last = neighbour_start.shape[0] - 1
        if wp.static(world_fastest):
            part, w = wp.tid()
            first = part
            last = part + 1
        for dof in range(first, last):
            node = dof_node[dof]
            if node < node_count:
                mass = node_mass_in[w, node]
                row = 3 * node
                b0 = (node_external_in[w, row] - node_internal_in[w, row]) * f_scale
                b1 = (node_external_in[w, row + 1] - node_internal_in[w, row + 1]) * f_scale
                b2 = (node_external_in[w, row + 2] - node_internal_in[w, row + 2]) * f_scale
                if inertia > real(0.0):
                    b0 += mul(mass, node_v0_in[w, row])
                    b1 += mul(mass, node_v0_in[w, row + 1])
                    b2 += mul(mass, node_v0_in[w, row + 2])
                    if moving:
                        body = node_body[node]
                        damping = body_damping_scale_in[w, body]
                        keep = mul(mul(mass, body_mass_scale_in[w, body]), S(real(1.0)) - damping)
                        r0, r1, r2 = row_product(a_in, dof_v_in, w, dof, neighbour_start, neighbour, neighbour_block)
                        b0 -= mul(keep, dof_v_in[w, 3 * dof]) + mul(damping, r0)
                        b1 -= mul(keep, dof_v_in[w, 3 * dof + 1]) + mul(damping, r1)
                        b2 -= mul(keep, dof_v_in[w, 3 * dof + 2]) + mul(damping, r2)
                b_out[w, 3 * dof] = b0
                b_out[w, 3 * dof + 1] = b1
                b_out[w, 3 * dof + 2] = b2

    @wp.kernel(module=module, enable_backward=False)
    def residual(
        # Model
        neighbour_start: wp.array(dtype=wp.int32),
        neighbour: wp.array(dtype=wp.int32),
        neighbour_block: wp.array(dtype=wp.int32),
        # Workspace in
        a_in: wp.array2d(dtype=S),
        b_in: wp.array2d(dtype=S),
        u_in: wp.array2d(dtype=S),
        # Workspace out
        y_out: wp.array2d(dtype=S),
    ):
        """y = b - A u, the linear residual, for iterative refinement; of one dof, on a CPU of all."""
        w, part = wp.tid()
        first = int(0)
        last = neighbour_start.shape[0] - 1
        if wp.static(world_fastest):
            part, w = wp.tid()
            first = part
            last = part + 1
        for dof in range(first, last):
            r0, r1, r2 = row_product(a_in, u_in, w, dof, neighbour_start, neighbour, neighbour_block)
            y_out[w, 3 * dof] = b_in[w, 3 * dof] - r0
            y_out[w, 3 * dof + 1] = b_in[w, 3 * dof + 1] - r1
            y_out[w, 3 * dof + 2] = b_in[w, 3 * dof + 2] - r2

    @wp.kernel(module=module, enable_backward=False)
    def trial_position(
        count: int,
        # Model
        node_dof: wp.array(dtype=wp.int32),
        # Workspace in
        node_x0_in: wp.array2d(dtype=S),
        dof_v_in: wp.array2d(dtype=S),
        x_scale: real,
        # Workspace out
        node_x_out: wp.array2d(dtype=S),
    ):
        """x = x0 + x_scale v for free nodes, x0 for fixed ones; of one node, on a CPU of ``count``."""
        w, part = wp.tid()
        first = int(0)
        last = count
        if wp.static(world_fastest):
            part, w = wp.tid()
            first = part
            last = part + 1
        for node in range(first, last):
            dof = node_dof[node]
            for c in range(3):
                x = node_x0_in[w, 3 * node + c]
                if dof >= 0:
                    x += dof_v_in[w, 3 * dof + c] * x_scale
                node_x_out[w, 3 * node + c] = x

    @wp.kernel(module=module, enable_backward=False)
    def force_norms(
        # Model
        dof_count: int,
        node_count: int,
        dof_node: wp.array(dtype=wp.int32),
        force_rows: int,
        # Workspace in
        node_mass_in: wp.array2d(dtype=S),
        node_external_in: wp.array2d(dtype=S),
        node_v0_in: wp.array2d(dtype=S),
        tet_force_in: wp.array2d(dtype=S),
        b_in: wp.array2d(dtype=S),
        f_scale: real,
        inertia: real,
        # Workspace out
        norm_out: wp.array2d(dtype=S),
    ):
        """Row 0: |b|, the imbalance; row 1: the size of the forces that should balance."""
        w = wp.tid()
        imbalance = S(real(0.0))
        external = S(real(0.0))
        for dof in range(dof_count):
            node = dof_node[dof]
            for c in range(3):
                r = b_in[w, 3 * dof + c]
                imbalance += mul(r, r)
                if node < node_count:
                    f = node_external_in[w, 3 * node + c] * f_scale
                    p = mul(node_mass_in[w, node], node_v0_in[w, 3 * node + c]) * inertia
                    external += mul(f, f) + mul(p, p)
        elastic = S(real(0.0))
        for row in range(force_rows):
            f = tet_force_in[w, row] * f_scale
            elastic += mul(f, f)
        norm_out[w, 0] = sqrt(imbalance)
        norm_out[w, 1] = sqrt(external + elastic)

    return SimpleNamespace(
        body_moduli=body_moduli,
        damping_scales=damping_scales,
        row_product=row_product,
        corner_sum=corner_sum,
        node_forces=node_forces,
        node_loads=node_loads,
        block_mass=block_mass,
        right_hand_side=right_hand_side,
        residual=residual,
        trial_position=trial_position,
        force_norms=force_norms,
    )
