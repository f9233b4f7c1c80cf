"""Stiffness and damping of elements whose corners a frame carries. Theory: docs/theory/attachment.md.

A carried corner s at the lever r moves with J (V, w) = V - [r] w, so an element block K_st enters A as J_s' K_st J_t:
as it is between translations, with [r_s] from the left for the rotation of s's master and with -[r_t] from the right
for that of t's. Attached parts are therefore exact: no penalty, no multiplier.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import rotation
from softwarp.kernels.algebra.lanes import Variant


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Gather kernels for blocks of A that frames take part in."""
    S = variant.S
    real = variant.real
    mul = variant.mul
    world_fastest = variant.world_fastest
    module = variant.module("attachment")
    cross = rotation.functions(variant).cross

    @wp.func
    def transform_column(k0: S, k1: S, k2: S, lever: wp.array2d(dtype=S), w: int, item: int):
        """[r] k, or k where no frame's rotation stands on the left."""
        if item >= 0:
            return cross(lever[w, 3 * item], lever[w, 3 * item + 1], lever[w, 3 * item + 2], k0, k1, k2)
        return k0, k1, k2

    @wp.func
    def add_transformed(
        a: wp.array2d(dtype=S),
        w: int,
        row: int,
        k00: S,
        k01: S,
        k02: S,
        k10: S,
        k11: S,
        k12: S,
        k20: S,
        k21: S,
        k22: S,
        lever: wp.array2d(dtype=S),
        left: int,
        right: int,
    ):
        """a += J' K J for one element block."""
        if right >= 0:  # rows of K times -[r]: r x row
            r0 = lever[w, 3 * right]
            r1 = lever[w, 3 * right + 1]
            r2 = lever[w, 3 * right + 2]
            k00, k01, k02 = cross(r0, r1, r2, k00, k01, k02)
            k10, k11, k12 = cross(r0, r1, r2, k10, k11, k12)
            k20, k21, k22 = cross(r0, r1, r2, k20, k21, k22)
        k00, k10, k20 = transform_column(k00, k10, k20, lever, w, left)
        k01, k11, k21 = transform_column(k01, k11, k21, lever, w, left)
        k02, k12, k22 = transform_column(k02, k12, k22, lever, w, left)
        a[w, row] += k00
        a[w, row + 1] += k01
        a[w, row + 2] += k02
        a[w, row + 3] += k10
        a[w, row + 4] += k11
        a[w, row + 5] += k12
        a[w, row + 6] += k20
        a[w, row + 7] += k21
        a[w, row + 8] += k22

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
            a = (code >> 2) & 3
            b = code & 3
            k = (code >> 4) * 90 + ((a * (a + 1)) // 2 + b) * 9
            across = 3
            down = 1
            if a >= b:
                across = 1
                down = 3
            else:
                k = (code >> 4) * 90 + ((b * (b + 1)) // 2 + a) * 9
            add_transformed(
                a_out,
                w,
                row,
                mul(scale, stiffness_in[w, k]),
                mul(scale, stiffness_in[w, k + across]),
                mul(scale, stiffness_in[w, k + 2 * across]),
                mul(scale, stiffness_in[w, k + down]),
                mul(scale, stiffness_in[w, k + down + across]),
                mul(scale, stiffness_in[w, k + down + 2 * across]),
                mul(scale, stiffness_in[w, k + 2 * down]),
                mul(scale, stiffness_in[w, k + 2 * down + across]),
                mul(scale, stiffness_in[w, k + 2 * down + 2 * across]),
                lever_in,
                entry[p, 1],
                entry[p, 2],
            )

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
            a0 = tet_gradient_in[w, i]
            a1 = tet_gradient_in[w, i + 1]
            a2 = tet_gradient_in[w, i + 2]
            b0 = tet_gradient_in[w, j]
            b1 = tet_gradient_in[w, j + 1]
            b2 = tet_gradient_in[w, j + 2]
            trace = mul(mu, mul(a0, b0) + mul(a1, b1) + mul(a2, b2))
            add_transformed(
                a_out,
                w,
                row,
                mul(mu + lam, mul(a0, b0)) + trace,
                mul(lam, mul(a0, b1)) + mul(mu, mul(a1, b0)),
                mul(lam, mul(a0, b2)) + mul(mu, mul(a2, b0)),
                mul(lam, mul(a1, b0)) + mul(mu, mul(a0, b1)),
                mul(mu + lam, mul(a1, b1)) + trace,
                mul(lam, mul(a1, b2)) + mul(mu, mul(a2, b1)),
                mul(lam, mul(a2, b0)) + mul(mu, mul(a0, b2)),
                mul(lam, mul(a2, b1)) + mul(mu, mul(a1, b2)),
                mul(mu + lam, mul(a2, b2)) + trace,
                lever_in,
                entry[p, 1],
                entry[p, 2],
            )

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
            a0 = tet_gradient_in[w, i]
            a1 = tet_gradient_in[w, i + 1]
            a2 = tet_gradient_in[w, i + 2]
            for b in range(4):
                j = 12 * tet + 3 * b
                v = 3 * tet_node[tet, b]
                b0 = tet_gradient_in[w, j]
                b1 = tet_gradient_in[w, j + 1]
                b2 = tet_gradient_in[w, j + 2]
                v0 = slot_v_in[w, v]
                v1 = slot_v_in[w, v + 1]
                v2 = slot_v_in[w, v + 2]
                along = mul(lam, mul(b0, v0) + mul(b1, v1) + mul(b2, v2))
                across = mul(mu, mul(a0, v0) + mul(a1, v1) + mul(a2, v2))
                both = mul(mu, mul(a0, b0) + mul(a1, b1) + mul(a2, b2))
                node_internal_out[w, row] += mul(along, a0) + mul(across, b0) + mul(both, v0)
                node_internal_out[w, row + 1] += mul(along, a1) + mul(across, b1) + mul(both, v1)
                node_internal_out[w, row + 2] += mul(along, a2) + mul(across, b2) + mul(both, v2)

    return SimpleNamespace(
        stored_stiffness=stored_stiffness,
        turned_stiffness=turned_stiffness,
        stored_damping=stored_damping,
        turned_damping=turned_damping,
    )
