"""Stiffness and damping of elements whose corners a frame carries. Theory: docs/theory/attachment.md.

A carried corner s at the lever r moves with J (V, w) = V - [r] w, so an element block K_st enters A as J_s' K_st J_t:
as it is between translations, with [r_s] from the left for the rotation of s's master and with -[r_t] from the right
for that of t's. Attached parts are therefore exact: no penalty, no multiplier.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.algebra.vectors import algebra
from softwarp.kernels.elements import corotational, stored


@cache
def functions(variant: Variant) -> SimpleNamespace:
    """Blocks between what carries corners."""
    S = variant.S
    a = algebra(variant)
    Matrix, rows, row_x, row_y, row_z = a.Matrix, a.rows, a.row_x, a.row_y, a.row_z
    read_vector, cross, crossed = a.read_vector, a.cross, a.crossed

    @wp.func
    def transformed(K: Matrix, lever: wp.array2d(dtype=S), w: int, left: int, right: int):
        """J' K J for one element block; -1 where no frame's rotation stands on that side."""
        if right >= 0:  # rows of K times -[r]: r x row
            r = read_vector(lever, w, 3 * right)
            K = rows(cross(r, row_x(K)), cross(r, row_y(K)), cross(r, row_z(K)))
        if left >= 0:
            K = crossed(read_vector(lever, w, 3 * left), K)
        return K

    return SimpleNamespace(transformed=transformed)


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Gather kernels for blocks of A that frames take part in."""
    S = variant.S
    real = variant.real
    mul = variant.mul
    world_fastest = variant.world_fastest
    module = variant.module("attachment")
    a = algebra(variant)
    rows, row_x, row_y, row_z = a.rows, a.row_x, a.row_y, a.row_z
    read_vector, add_vector, add_matrix = a.read_vector, a.add_vector, a.add_matrix
    add, scaled, dot, outer = a.add, a.scaled, a.dot, a.outer
    isotropic = corotational.kernels(variant).isotropic
    read_block, transformed = stored.functions(variant).read_block, functions(variant).transformed

    @wp.kernel(module=module, enable_backward=False)
    def stored_stiffness(
        # Model
        element_body: wp.array(dtype=wp.int32),
        block: wp.array(dtype=wp.int32),
        entry_start: wp.array(dtype=wp.int32),
        entry: wp.array2d(dtype=wp.int32),
        entry_weight: wp.array(dtype=real),
        # Workspace in
        body_stiffness_scale_in: wp.array2d(dtype=S),
        stiffness_in: wp.array2d(dtype=S),
        lever_in: wp.array2d(dtype=S),
        # Workspace out
        a_out: wp.array2d(dtype=S),
    ):
        """Add stored element blocks to one block of A; an entry is (16 element + 4 a + b, left, right) with a weight.

        The weight is 1, or the product of two corners' shares where corners are sums of nodes.
        """
        w, place = wp.tid()
        if wp.static(world_fastest):
            place, w = wp.tid()
        row = 9 * block[place]
        for p in range(entry_start[place], entry_start[place + 1]):
            code = entry[p, 0]
            scale = body_stiffness_scale_in[w, element_body[code >> 4]] * entry_weight[p]
            K = read_block(stiffness_in, w, code)
            K = rows(scaled(row_x(K), scale), scaled(row_y(K), scale), scaled(row_z(K), scale))
            add_matrix(a_out, w, row, transformed(K, lever_in, w, entry[p, 1], entry[p, 2]))

    @wp.kernel(module=module, enable_backward=False)
    def turned_stiffness(
        # Model
        tet_body: wp.array(dtype=wp.int32),
        block: wp.array(dtype=wp.int32),
        entry_start: wp.array(dtype=wp.int32),
        entry: wp.array2d(dtype=wp.int32),
        entry_weight: wp.array(dtype=real),
        # Workspace in
        body_mu_in: wp.array2d(dtype=S),
        body_lam_in: wp.array2d(dtype=S),
        body_stiffness_scale_in: wp.array2d(dtype=S),
        tet_gradient_in: wp.array2d(dtype=S),
        lever_in: wp.array2d(dtype=S),
        # Workspace out
        a_out: wp.array2d(dtype=S),
    ):
        """The same for ``large`` tets: lam X + mu X' + mu tr(X) 1 with X = V ga gb'."""
        w, place = wp.tid()
        if wp.static(world_fastest):
            place, w = wp.tid()
        row = 9 * block[place]
        for p in range(entry_start[place], entry_start[place + 1]):
            code = entry[p, 0]
            i = (code >> 4) * 12 + 3 * ((code >> 2) & 3)
            j = (code >> 4) * 12 + 3 * (code & 3)
            body = tet_body[code >> 4]
            scale = body_stiffness_scale_in[w, body] * entry_weight[p]
            mu = mul(scale, body_mu_in[w, body])
            lam = mul(scale, body_lam_in[w, body])
            X = outer(read_vector(tet_gradient_in, w, i), read_vector(tet_gradient_in, w, j))
            K = isotropic(X, mu, lam)
            add_matrix(a_out, w, row, transformed(K, lever_in, w, entry[p, 1], entry[p, 2]))

    @wp.kernel(module=module, enable_backward=False)
    def stored_damping(
        # Model
        element_body: wp.array(dtype=wp.int32),
        element_node: wp.array2d(dtype=wp.int32),
        held_node: wp.array(dtype=wp.int32),
        entry_start: wp.array(dtype=wp.int32),
        entry: wp.array(dtype=wp.int32),
        entry_weight: wp.array(dtype=real),
        # Workspace in
        rayleigh_stiffness_in: wp.array2d(dtype=S),
        stiffness_in: wp.array2d(dtype=S),
        slot_v_in: wp.array2d(dtype=S),
        # Workspace out
        node_internal_out: wp.array2d(dtype=S),
    ):
        """Add beta K v of stored elements at one carried node; an entry is 4 element + corner with a weight."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        for p in range(entry_start[item], entry_start[item + 1]):
            element = entry[p] >> 2
            a = entry[p] & 3
            beta = rayleigh_stiffness_in[w, element_body[element]] * entry_weight[p]
            for b in range(element_node.shape[1]):
                k = element * 90 + ((a * (a + 1)) // 2 + b) * 9
                across = 1
                down = 3
                if a < b:
                    k = element * 90 + ((b * (b + 1)) // 2 + a) * 9
                    across = 3
                    down = 1
                v = 3 * element_node[element, b]
                for r in range(3):
                    total = mul(stiffness_in[w, k + down * r], slot_v_in[w, v])
                    total += mul(stiffness_in[w, k + down * r + across], slot_v_in[w, v + 1])
                    total += mul(stiffness_in[w, k + down * r + 2 * across], slot_v_in[w, v + 2])
                    node_internal_out[w, 3 * held_node[item] + r] += mul(beta, total)

    @wp.kernel(module=module, enable_backward=False)
    def turned_damping(
        # Model
        tet_body: wp.array(dtype=wp.int32),
        tet_node: wp.array2d(dtype=wp.int32),
        held_node: wp.array(dtype=wp.int32),
        entry_start: wp.array(dtype=wp.int32),
        entry: wp.array(dtype=wp.int32),
        entry_weight: wp.array(dtype=real),
        # Workspace in
        body_mu_in: wp.array2d(dtype=S),
        body_lam_in: wp.array2d(dtype=S),
        rayleigh_stiffness_in: wp.array2d(dtype=S),
        tet_gradient_in: wp.array2d(dtype=S),
        slot_v_in: wp.array2d(dtype=S),
        # Workspace out
        node_internal_out: wp.array2d(dtype=S),
    ):
        """The same for ``large`` tets: K_ab v = lam ga (gb.v) + mu gb (ga.v) + mu (ga.gb) v, times the volume."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        row = 3 * held_node[item]
        for p in range(entry_start[item], entry_start[item + 1]):
            tet = entry[p] >> 2
            i = 12 * tet + 3 * (entry[p] & 3)
            body = tet_body[tet]
            beta = rayleigh_stiffness_in[w, body] * entry_weight[p]
            mu = mul(beta, body_mu_in[w, body])
            lam = mul(beta, body_lam_in[w, body])
            ga = read_vector(tet_gradient_in, w, i)
            for b in range(4):
                gb = read_vector(tet_gradient_in, w, 12 * tet + 3 * b)
                v = read_vector(slot_v_in, w, 3 * tet_node[tet, b])
                along = mul(lam, dot(gb, v))
                across = mul(mu, dot(ga, v))
                both = mul(mu, dot(ga, gb))
                add_vector(node_internal_out, w, row, add(add(scaled(ga, along), scaled(gb, across)), scaled(v, both)))

    return SimpleNamespace(
        stored_stiffness=stored_stiffness,
        turned_stiffness=turned_stiffness,
        stored_damping=stored_damping,
        turned_damping=turned_damping,
    )
