"""What of the multipliers of joints only corrects gaps and is kept from momentum. Theory: docs/theory/joint.md."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.model.codes import JointRow


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """What of the multipliers only corrects gaps, and does not belong to momentum."""
    S = variant.S
    real = variant.real
    mul, div, sqrt = variant.mul, variant.div, variant.sqrt
    world_fastest = variant.world_fastest
    module = variant.module("joint_momentum")

    @wp.func
    def half_solve(
        delassus: wp.array2d(dtype=S),
        inverse: wp.array2d(dtype=S),
        unbounded_row: wp.array(dtype=wp.int32),
        half: wp.array2d(dtype=S),
        w: int,
        order: int,
    ):
        """z = L^-1 g in place for W_uu + C = L D L'; returns z' D^-1 z = g' (W_uu + C)^-1 g."""
        square = S(real(0.0))
        for a in range(unbounded_row.shape[0]):
            i = unbounded_row[a] * order
            total = half[w, a]
            for b in range(a):
                total -= mul(mul(delassus[w, i + unbounded_row[b]], inverse[w, b]), half[w, b])
            half[w, a] = total
            square += mul(mul(total, total), inverse[w, a])
        return square

    @wp.kernel(module=module, enable_backward=False)
    def correction(
        first_row: int,
        order: int,
        h: real,
        # Model
        unbounded_row: wp.array(dtype=wp.int32),
        row_kind: wp.array(dtype=wp.int32),
        # Workspace in
        delassus_in: wp.array2d(dtype=S),
        inverse_in: wp.array2d(dtype=S),
        gap_in: wp.array2d(dtype=S),
        speed_in: wp.array2d(dtype=S),
        # Workspace out
        half_out: wp.array2d(dtype=S),
        share_out: wp.array2d(dtype=S),
    ):
        """Part of the multipliers that corrects gaps g and that momentum must not receive.

        The velocities that remove H v0 take the energy (h H v0)' W^-1 (h H v0) / 2 h^2 from the parts, those that
        remove g give them g' W^-1 g / 2 h^2. Momentum receives the share of these that makes both equal, at most all.
        """
        w = wp.tid()
        count = unbounded_row.shape[0]
        for a in range(count):
            half_out[w, a] = speed_in[w, unbounded_row[a] - first_row] * h
            if row_kind[unbounded_row[a] - first_row] == wp.static(JointRow.FREE):
                half_out[w, a] = S(real(0.0))
        taken = half_solve(delassus_in, inverse_in, unbounded_row, half_out, w, order)
        for a in range(count):
            half_out[w, a] = -gap_in[w, unbounded_row[a] - first_row]
        given = half_solve(delassus_in, inverse_in, unbounded_row, half_out, w, order)
        one = S(real(1.0))
        share = one - wp.min(one, sqrt(div(taken, given + S(real(1.0e-30)))))
        share_out[w, 0] = share
        for step in range(count):
            a = count - 1 - step
            total = half_out[w, a]
            for b in range(a + 1, count):
                total -= mul(delassus_in[w, unbounded_row[b] * order + unbounded_row[a]], half_out[w, b])
            half_out[w, a] = mul(total, inverse_in[w, a])
        for a in range(count):
            half_out[w, a] = mul(half_out[w, a], share)

    @wp.kernel(module=module, enable_backward=False)
    def correction_side(
        size: int,
        f_scale: real,
        # Model
        unbounded_row: wp.array(dtype=wp.int32),
        # Workspace in
        correction_in: wp.array2d(dtype=S),
        # Workspace out
        y_out: wp.array2d(dtype=S),
    ):
        """f Y correction as right-hand side 0."""
        w, row = wp.tid()
        if wp.static(world_fastest):
            row, w = wp.tid()
        total = S(real(0.0))
        for a in range(unbounded_row.shape[0]):
            total += mul(y_out[w, 3 * size * (1 + unbounded_row[a]) + row], correction_in[w, a])
        y_out[w, row] = total * f_scale

    @wp.kernel(module=module, enable_backward=False)
    def take_velocity(
        # Workspace in
        y_in: wp.array2d(dtype=S),
        # Workspace out
        dof_v_out: wp.array2d(dtype=S),
    ):
        """v -= y."""
        w, row = wp.tid()
        if wp.static(world_fastest):
            row, w = wp.tid()
        dof_v_out[w, row] -= y_in[w, row]

    return SimpleNamespace(correction=correction, correction_side=correction_side, take_velocity=take_velocity)
