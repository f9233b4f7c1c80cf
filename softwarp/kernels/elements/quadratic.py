"""Quadratic tetrahedra as linear ones at their Gauss points. Theory, symbols and checks: docs/theory/quadratic.md.

With barycentric coordinates L_k the deformation gradient at a point is F = sum_k y_k grad L_k', where
y_k = sum_a (dN_a / dL_k) x_a. Each of the four Gauss points is thus a linear tetrahedron with the corners y_k and a
quarter of the element's volume, and the kernels of every law serve it as they are. What they return goes back to the
ten nodes by the same weights: f_a = sum_k (dN_a / dL_k) h_k, and blocks of the stiffness by their products.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single, wide
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.algebra.vectors import algebra
from softwarp.kernels.elements import corotational
from softwarp.meshing.quadratic import FAR, NEAR

NODES = 10
POINTS = 4
TURNING_ROWS = 180  # per point: B of the ten nodes, then O


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels between nodes and Gauss points for one scalar type."""
    S = variant.S
    real = variant.real
    mul = variant.mul
    world_fastest = variant.world_fastest
    module = variant.module("quadratic")
    turned = algebra(variant)
    isotropic = corotational.kernels(variant).isotropic
    # dN_a / dL_k at point q: 4 L_k - 1 at corner k, 4 L_m at the node between k and m
    far_corner = wp.constant(real(4.0 * FAR - 1.0))
    far_edge = wp.constant(real(4.0 * FAR))
    near_more = wp.constant(real(4.0 * (NEAR - FAR)))

    @wp.func
    def edge_node(k: int, m: int):
        """Local number of the node between corners k and m."""
        low = wp.min(k, m)
        return (low * (5 - low)) // 2 + wp.max(k, m) + 3

    @wp.kernel(module=module, enable_backward=False)
    def point_corners(
        # Model
        element_node: wp.array2d(dtype=wp.int32),
        # Workspace in
        node_in: wp.array2d(dtype=S),
        # Workspace out
        corner_out: wp.array2d(dtype=S),
    ):
        """Corners y_k of the four tetrahedra that stand for one element, less a vector that they share.

        Nodes are taken relative to the first one, so that rounding is that of the element's size.
        """
        w, element = wp.tid()
        if wp.static(world_fastest):
            element, w = wp.tid()
        origin = 3 * element_node[element, 0]
        for c in range(3):
            x0 = node_in[w, origin + c]
            for k in range(4):
                corner = node_in[w, 3 * element_node[element, k] + c] - x0
                around = S(real(0.0))
                for other in range(1, 4):
                    m = (k + other) % 4
                    around += node_in[w, 3 * element_node[element, edge_node(k, m)] + c] - x0
                value = corner * far_corner + around * far_edge
                for q in range(4):
                    near = corner
                    if q != k:
                        near = node_in[w, 3 * element_node[element, edge_node(k, q)] + c] - x0
                    corner_out[w, 48 * element + 12 * q + 3 * k + c] = value + near * near_more

    @wp.kernel(module=module, enable_backward=False)
    def spread_force(
        first: int,
        # Workspace in
        point_force_in: wp.array2d(dtype=S),
        # Workspace out
        element_force_out: wp.array2d(dtype=S),
    ):
        """Forces dE/dx [N] of the ten nodes, at rows ``first`` onwards, from those of the points' corners."""
        w, element = wp.tid()
        if wp.static(world_fastest):
            element, w = wp.tid()
        row = 48 * element
        out = first + 30 * element
        for c in range(3):
            for k in range(4):
                total = S(real(0.0))
                for q in range(4):
                    total += point_force_in[w, row + 12 * q + 3 * k + c]
                near = point_force_in[w, row + 15 * k + c]
                element_force_out[w, out + 3 * k + c] = total * far_corner + near * near_more
            for k in range(3):
                for m in range(k + 1, 4):
                    total = S(real(0.0))
                    for q in range(4):
                        total += point_force_in[w, row + 12 * q + 3 * k + c]
                        total += point_force_in[w, row + 12 * q + 3 * m + c]
                    near = point_force_in[w, row + 12 * m + 3 * k + c] + point_force_in[w, row + 12 * k + 3 * m + c]
                    element_force_out[w, out + 3 * edge_node(k, m) + c] = total * far_edge + near * near_more

    gather = 4 if wide.is_wide(variant) else 1  # points that one thread of ``spread_gradient`` serves

    if wide.is_wide(variant):

        @wp.func
        def spread(point_gradient: wp.array2d(dtype=S), w: int, point: int, shape_gradient_out: wp.array2d(dtype=S)):
            """Gradients of the ten shape functions at all points of an element, of one world in float32."""
            wide.spread_gradients(point_gradient, w, point // 4, far_corner, far_edge, near_more, shape_gradient_out)

    else:

        @wp.func
        def spread(point_gradient: wp.array2d(dtype=S), w: int, point: int, shape_gradient_out: wp.array2d(dtype=S)):
            """Gradients of the ten shape functions; row 12 a + 4 c + q is component c of a at point q."""
            q = point % 4
            row = 12 * point
            out = 120 * (point // 4) + q
            for k in range(4):
                factor = far_corner
                if k == q:
                    factor += near_more
                for c in range(3):
                    shape_gradient_out[w, out + 12 * k + 4 * c] = point_gradient[w, row + 3 * k + c] * factor
            for k in range(3):
                for m in range(k + 1, 4):
                    of_k = far_edge
                    of_m = far_edge
                    if m == q:
                        of_k += near_more
                    if k == q:
                        of_m += near_more
                    for c in range(3):
                        value = point_gradient[w, row + 3 * k + c] * of_k
                        value += point_gradient[w, row + 3 * m + c] * of_m
                        shape_gradient_out[w, out + 12 * edge_node(k, m) + 4 * c] = value

    @wp.kernel(module=module, enable_backward=False)
    def spread_gradient(
        # Model
        point_index: wp.array(dtype=wp.int32),
        # Workspace in
        point_gradient_in: wp.array2d(dtype=S),
        # Workspace out
        shape_gradient_out: wp.array2d(dtype=S),
    ):
        """Turned gradients of the ten shape functions times sqrt(V) at ``gather`` Gauss points, from those of L_k."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        spread(point_gradient_in, w, point_index[wp.static(gather) * item], shape_gradient_out)

    @wp.func
    def outer_each(gradient: wp.array2d(dtype=S), w: int, begin: int, end: int, entry: wp.array(dtype=wp.int32)):
        """Sum of ``g_a g_b'`` over pairs of nodes and points; an entry is 256 element + 16 a + b."""
        x = turned.Matrix()
        for p in range(begin, end):
            row = 120 * (entry[p] >> 8)
            i = row + 12 * ((entry[p] >> 4) & 15)
            j = row + 12 * (entry[p] & 15)
            for q in range(4):
                left = turned.vector(gradient[w, i + q], gradient[w, i + 4 + q], gradient[w, i + 8 + q])
                right = turned.vector(gradient[w, j + q], gradient[w, j + 4 + q], gradient[w, j + 8 + q])
                x = turned.add_outer(x, left, right)
        return x

    @wp.func
    def outer_wide(
        gradient: wp.array2d(dtype=wp.float32), w: int, begin: int, end: int, entry: wp.array(dtype=wp.int32)
    ):
        """The same for one world in float32."""
        x = wide.point_outer_sum(gradient, w, begin, end, entry)
        return turned.rows(
            turned.vector(x[0], x[1], x[2]), turned.vector(x[3], x[4], x[5]), turned.vector(x[6], x[7], x[8])
        )

    outer_sum = outer_wide if wide.is_wide(variant) else outer_each

    @wp.kernel(module=module, enable_backward=False)
    def block_stiffness(
        # Model
        point_body: wp.array(dtype=wp.int32),
        entry_start: wp.array(dtype=wp.int32),
        entry: wp.array(dtype=wp.int32),
        # Workspace in
        body_mu_in: wp.array2d(dtype=S),
        body_lam_in: wp.array2d(dtype=S),
        body_stiffness_scale_in: wp.array2d(dtype=S),
        shape_gradient_in: wp.array2d(dtype=S),
        # Workspace out
        a_out: wp.array2d(dtype=S),
    ):
        """Add the stiffness of all turned elements around one 3x3 block of A, as in ``corotational``."""
        w, block = wp.tid()
        if wp.static(world_fastest):
            block, w = wp.tid()
        begin = entry_start[block]
        end = entry_start[block + 1]
        if begin < end:
            X = outer_sum(shape_gradient_in, w, begin, end, entry)
            body = point_body[4 * (entry[begin] >> 8)]
            scale = body_stiffness_scale_in[w, body]
            mu = mul(scale, body_mu_in[w, body])
            lam = mul(scale, body_lam_in[w, body])
            turned.add_matrix(a_out, w, 9 * block, isotropic(X, mu, lam))

    return SimpleNamespace(
        gather=gather,
        edge_node=edge_node,
        point_corners=point_corners,
        spread_force=spread_force,
        spread_gradient=spread_gradient,
        block_stiffness=block_stiffness,
    )


@cache
def turning_kernels(variant: Variant) -> SimpleNamespace:
    """Kernels that bring the turning of ``large`` tetrahedra (``turning``) from Gauss points to nodes."""
    S = variant.S
    real = variant.real
    mul = variant.mul
    world_fastest = variant.world_fastest
    module = variant.module("quadratic.turning")
    k_nodes = kernels(variant)
    edge_node = k_nodes.edge_node
    far_corner = wp.constant(real(4.0 * FAR - 1.0))
    far_edge = wp.constant(real(4.0 * FAR))
    near_more = wp.constant(real(4.0 * (NEAR - FAR)))

    @wp.func
    def corner_value(turning: wp.array2d(dtype=S), w: int, first: int, corner: int):
        """One entry of B or O of a corner; those of all corners sum to zero."""
        value = S(real(0.0))
        if corner == 0:
            for other in range(3):
                value -= turning[w, first + 9 * other]
        else:
            value = turning[w, first + 9 * (corner - 1)]
        return value

    @wp.kernel(module=module, enable_backward=False)
    def spread_turning(
        # Workspace in
        point_turning_in: wp.array2d(dtype=S),
        # Workspace out
        node_turning_out: wp.array2d(dtype=S),
    ):
        """B and then O of the ten nodes at one Gauss point, 90 entries each, from those of its corners."""
        w, point = wp.tid()
        if wp.static(world_fastest):
            point, w = wp.tid()
        q = point % 4
        for part in range(2):
            for entry in range(9):
                first = 54 * point + 27 * part + entry
                out = 180 * point + 90 * part + entry
                for k in range(4):
                    value = corner_value(point_turning_in, w, first, k)
                    factor = far_corner
                    if k == q:
                        factor += near_more
                    node_turning_out[w, out + 9 * k] = value * factor
                    for m in range(k + 1, 4):
                        other = corner_value(point_turning_in, w, first, m)
                        of_k = far_edge
                        of_m = far_edge
                        if m == q:
                            of_k += near_more
                        if k == q:
                            of_m += near_more
                        node_turning_out[w, out + 9 * edge_node(k, m)] = value * of_k + other * of_m

    @wp.func
    def entry_product(turning: wp.array2d(dtype=S), w: int, left: int, right: int):
        """One entry of B O: a row of B, from ``left``, times a column of O, from ``right``."""
        total = mul(turning[w, left], turning[w, right])
        total += mul(turning[w, left + 1], turning[w, right + 3])
        return total + mul(turning[w, left + 2], turning[w, right + 6])

    @wp.kernel(module=module, enable_backward=False)
    def block_turning(
        scale: real,
        # Model
        entry_start: wp.array(dtype=wp.int32),
        entry: wp.array(dtype=wp.int32),
        # Workspace in
        node_turning_in: wp.array2d(dtype=S),
        # Workspace out
        a_out: wp.array2d(dtype=S),
        a_upper_out: wp.array2d(dtype=S),
    ):
        """Add B_a O_b around one 3x3 block (i, j), and the transpose of that of (j, i), scaled; see ``turning``.

        An entry is 256 element + 16 a + b.
        """
        w, block = wp.tid()
        if wp.static(world_fastest):
            block, w = wp.tid()
        for r in range(3):
            for c in range(3):
                below = S(real(0.0))
                above = S(real(0.0))
                for p in range(entry_start[block], entry_start[block + 1]):
                    for q in range(4):
                        point = 180 * (4 * (entry[p] >> 8) + q)
                        a = point + 9 * ((entry[p] >> 4) & 15)
                        b = point + 9 * (entry[p] & 15)
                        below += entry_product(node_turning_in, w, a + 3 * r, b + 90 + c)
                        above += entry_product(node_turning_in, w, b + 3 * c, a + 90 + r)
                a_out[w, 9 * block + 3 * r + c] += mul(S(scale), below)
                a_upper_out[w, 9 * block + 3 * r + c] += mul(S(scale), above)

    return SimpleNamespace(spread_turning=spread_turning, block_turning=block_turning)


@cache
def inertia_kernels(variant: Variant) -> SimpleNamespace:
    """Kernels that make the lumped mass of the nodes consistent, for one scalar type.

    The consistent mass per density is the lumped one plus C, with C_ij = sum of (integral N_a N_b dV - lumped) over
    elements without nodes that frames carry. Its rows are few: those of the blocks of A.
    """
    S = variant.S
    real = variant.real
    mul = variant.mul
    world_fastest = variant.world_fastest
    module = variant.module("quadratic.inertia")

    @wp.kernel(module=module, enable_backward=False)
    def add_weight(
        # Model
        weight_node: wp.array(dtype=wp.int32),
        weight_volume: wp.array(dtype=real),
        node_body: wp.array(dtype=wp.int32),
        # Workspace in
        density_in: wp.array2d(dtype=S),
        gravity_in: wp.array2d(dtype=S),
        # Workspace out
        node_external_out: wp.array2d(dtype=S),
    ):
        """Add to the weight of a node what its consistent load has more than its lumped mass."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        node = weight_node[item]
        mass = density_in[w, node_body[node]] * weight_volume[item]
        for c in range(3):
            node_external_out[w, 3 * node + c] += mul(mass, gravity_in[w, c])

    @wp.kernel(module=module, enable_backward=False)
    def add_momentum(
        # Model
        row_dof: wp.array(dtype=wp.int32),
        row_start: wp.array(dtype=wp.int32),
        row_body: wp.array(dtype=wp.int32),
        column_dof: wp.array(dtype=wp.int32),
        column_node: wp.array(dtype=wp.int32),
        column_volume: wp.array(dtype=real),
        # Workspace in
        density_in: wp.array2d(dtype=S),
        body_mass_scale_in: wp.array2d(dtype=S),
        body_damping_scale_in: wp.array2d(dtype=S),
        node_v0_in: wp.array2d(dtype=S),
        dof_v_in: wp.array2d(dtype=S),
        moving: bool,
        # Workspace out
        b_out: wp.array2d(dtype=S),
    ):
        """b += rho C (v0 - m_scale (1 - d_scale) v) for one free node; ``moving`` says that v is not zero."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        dof = row_dof[item]
        body = row_body[item]
        p0 = S(real(0.0))
        p1 = S(real(0.0))
        p2 = S(real(0.0))
        for p in range(row_start[item], row_start[item + 1]):
            i = 3 * column_node[p]
            volume = column_volume[p]
            p0 += node_v0_in[w, i] * volume
            p1 += node_v0_in[w, i + 1] * volume
            p2 += node_v0_in[w, i + 2] * volume
        if moving:
            keep = mul(body_mass_scale_in[w, body], S(real(1.0)) - body_damping_scale_in[w, body])
            for p in range(row_start[item], row_start[item + 1]):
                j = 3 * column_dof[p]
                share = keep * column_volume[p]
                p0 -= mul(share, dof_v_in[w, j])
                p1 -= mul(share, dof_v_in[w, j + 1])
                p2 -= mul(share, dof_v_in[w, j + 2])
        density = density_in[w, body]
        b_out[w, 3 * dof] += mul(density, p0)
        b_out[w, 3 * dof + 1] += mul(density, p1)
        b_out[w, 3 * dof + 2] += mul(density, p2)

    return SimpleNamespace(add_weight=add_weight, add_momentum=add_momentum)


@single_worlds
def adjoint_kernels(variant: Variant) -> SimpleNamespace:
    """What the adjoint of a step needs of the consistent mass. Arrays are those of single worlds: (pack, row, lane)."""
    real = variant.real
    one = single.functions(variant)
    vec3, vector_at, add_to = one.vec3, one.vector_at, one.add_to

    @wp.kernel(module=variant.module("adjoint.quadratic"), enable_backward=False)
    def add_mass(
        # Model
        row_dof: wp.array(dtype=wp.int32),
        row_start: wp.array(dtype=wp.int32),
        column_dof: wp.array(dtype=wp.int32),
        dof_node: wp.array(dtype=wp.int32),
        column_volume: wp.array(dtype=real),
        # Workspace in
        dof_p_in: wp.array3d(dtype=real),
        # Workspace out
        node_mass_p_out: wp.array3d(dtype=real),
    ):
        """Add C p of one free node."""
        pack, item, lane = wp.tid()
        total = vec3()
        for k in range(row_start[item], row_start[item + 1]):
            total += column_volume[k] * vector_at(dof_p_in, pack, lane, 3 * column_dof[k])
        add_to(node_mass_p_out, pack, lane, 3 * dof_node[row_dof[item]], total)

    return SimpleNamespace(add_mass=add_mass)
