"""Exact multipliers of few rows by an active set, for compliances that are neither symmetric nor definite.

With the solution u = u0 + Z lambda of the linear system, Z = A^-1 H', the gaps of the rows are g + W lambda with
g = d + H u0 - target and W = H Z. Theory: docs/theory/statics.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Active set kernels for one scalar type."""
    S = variant.S
    real = variant.real
    mul = variant.mul
    world_fastest = variant.world_fastest
    module = variant.module("active_set")

    @wp.kernel(module=module, enable_backward=False)
    def compliance(
        # Model
        size: int,
        count: int,
        row_entry_start: wp.array(dtype=wp.int32),
        entry_dof: wp.array(dtype=wp.int32),
        # Workspace in
        row_in: wp.array2d(dtype=S),
        y_in: wp.array2d(dtype=S),
        displacement_in: wp.array2d(dtype=S),
        target_in: wp.array2d(dtype=S),
        # Workspace out
        gap_out: wp.array2d(dtype=S),
        compliance_out: wp.array2d(dtype=S),
    ):
        """Side 0 gives the gap of one row without multipliers, side 1 + j the entry W_ij."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        row = item // (1 + count)
        side = item % (1 + count)
        total = S(real(0.0))
        for entry in range(row_entry_start[row], row_entry_start[row + 1]):
            y = 3 * (size * side + entry_dof[entry])
            for c in range(3):
                total += mul(row_in[w, 3 * entry + c], y_in[w, y + c])
        if side == 0:
            gap_out[w, row] = displacement_in[w, row] + total - target_in[w, row]
        else:
            compliance_out[w, count * row + side - 1] = total

    @wp.kernel(module=module, enable_backward=False)
    def add_own(
        # Model
        count: int,
        # Workspace in
        own_in: wp.array2d(dtype=S),
        # Workspace out
        compliance_out: wp.array2d(dtype=S),
    ):
        """W + C: rows that give way themselves, as cables that stretch and gas do."""
        w, row = wp.tid()
        if wp.static(world_fastest):
            row, w = wp.tid()
        compliance_out[w, count * row + row] = compliance_out[w, count * row + row] + own_in[w, row]

    @wp.func
    def solve_active(
        matrix: wp.array3d(dtype=real),
        is_active: wp.array3d(dtype=real),
        value: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        count: int,
    ):
        """Gauss elimination among the active rows, right-hand side and result in ``value``; counts negative pivots."""
        negative = real(0.0)
        for k in range(count):
            if is_active[pack, k, lane] > real(0.5):
                pivot = matrix[pack, count * k + k, lane]
                if pivot < real(0.0):
                    negative += real(1.0)
                for i in range(k + 1, count):
                    if is_active[pack, i, lane] > real(0.5):
                        factor = matrix[pack, count * i + k, lane] / pivot
                        for j in range(k + 1, count):
                            matrix[pack, count * i + j, lane] -= factor * matrix[pack, count * k + j, lane]
                        value[pack, i, lane] -= factor * value[pack, k, lane]
        for back in range(count):
            k = count - 1 - back
            if is_active[pack, k, lane] > real(0.5):
                total = value[pack, k, lane]
                for j in range(k + 1, count):
                    if is_active[pack, j, lane] > real(0.5):
                        total -= matrix[pack, count * k + j, lane] * value[pack, j, lane]
                value[pack, k, lane] = total / matrix[pack, count * k + k, lane]
        return negative

    @wp.func
    def load_active(
        compliance: wp.array3d(dtype=real),
        gap: wp.array3d(dtype=real),
        is_active: wp.array3d(dtype=real),
        matrix: wp.array3d(dtype=real),
        value: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        count: int,
        regular: real,
    ):
        """Equations of the active rows; the others keep their multipliers in ``value``."""
        for i in range(count):
            for j in range(count):
                matrix[pack, count * i + j, lane] = compliance[pack, count * i + j, lane]
            matrix[pack, count * i + i, lane] *= real(1.0) + regular
        for i in range(count):
            if is_active[pack, i, lane] > real(0.5):
                total = -gap[pack, i, lane]
                for j in range(count):
                    if is_active[pack, j, lane] < real(0.5):
                        total -= compliance[pack, count * i + j, lane] * value[pack, j, lane]
                value[pack, i, lane] = total

    @wp.kernel(module=module, enable_backward=False)
    def active_set(
        count: int,
        epsilon: real,
        length: real,
        # Workspace in
        compliance_in: wp.array3d(dtype=real),
        gap_in: wp.array3d(dtype=real),
        lower_in: wp.array3d(dtype=real),
        upper_in: wp.array3d(dtype=real),
        multiplier_in: wp.array3d(dtype=real),
        # Workspace out
        is_active_out: wp.array3d(dtype=real),
        matrix_out: wp.array3d(dtype=real),
        value_out: wp.array3d(dtype=real),
        contact_out: wp.array3d(dtype=real),
    ):
        """Multipliers within their bounds whose gaps are zero, or of the sign that their bound allows.

        All rows that are wrong change at once while their number falls, otherwise only the last of them (Judice and
        Pires, 1994). ``contact_out`` counts the negative pivots of W among the active rows, or is -1 without a result.
        """
        pack, lane = wp.tid()
        for i in range(count):
            value = multiplier_in[pack, i, lane]
            is_free = value > lower_in[pack, i, lane] and value < upper_in[pack, i, lane]
            is_active_out[pack, i, lane] = wp.where(is_free, real(1.0), real(0.0))
            value_out[pack, i, lane] = wp.min(wp.max(value, lower_in[pack, i, lane]), upper_in[pack, i, lane])
        contact_out[pack, 0, lane] = real(-1.0)
        fewest = count + 1
        patience = int(3)
        searching = bool(True)
        rounds = int(0)
        while searching and rounds < 8 + 4 * count:
            rounds += 1
            load_active(compliance_in, gap_in, is_active_out, matrix_out, value_out, pack, lane, count, epsilon)
            negative = solve_active(matrix_out, is_active_out, value_out, pack, lane, count)
            scale = real(0.0)
            for i in range(count):
                scale = wp.max(scale, wp.abs(value_out[pack, i, lane]))
            wrong = int(0)
            last = int(-1)
            for i in range(count):
                value = value_out[pack, i, lane]
                low = lower_in[pack, i, lane]
                high = upper_in[pack, i, lane]
                flag = real(0.0)
                if is_active_out[pack, i, lane] > real(0.5):
                    if value < low - epsilon * scale or value > high + epsilon * scale:
                        flag = real(1.0)
                elif low < high:
                    gap = gap_in[pack, i, lane]
                    for j in range(count):
                        gap += compliance_in[pack, count * i + j, lane] * value_out[pack, j, lane]
                    if (value <= low and gap < -epsilon * length) or (value >= high and gap > epsilon * length):
                        flag = real(1.0)
                matrix_out[pack, i, lane] = flag
                if flag > real(0.5):
                    wrong += 1
                    last = i
            patience = wp.where(wrong < fewest, 3, patience - 1)
            fewest = wp.min(fewest, wrong)
            for i in range(count):
                is_wrong = matrix_out[pack, i, lane] > real(0.5)
                if is_wrong and (patience > 0 or i == last):
                    is_active_out[pack, i, lane] = real(1.0) - is_active_out[pack, i, lane]
                clamped = wp.min(wp.max(value_out[pack, i, lane], lower_in[pack, i, lane]), upper_in[pack, i, lane])
                value_out[pack, i, lane] = clamped
            if wrong == 0:
                contact_out[pack, 0, lane] = negative
                searching = bool(False)

    @wp.kernel(module=module, enable_backward=False)
    def combine(
        # Model
        size: int,
        count: int,
        # Workspace in
        y_in: wp.array2d(dtype=S),
        value_in: wp.array2d(dtype=S),
        # Workspace out
        u_out: wp.array2d(dtype=S),
    ):
        """u = u0 + Z lambda."""
        w, row = wp.tid()
        if wp.static(world_fastest):
            row, w = wp.tid()
        total = y_in[w, row]
        for i in range(count):
            total += mul(y_in[w, 3 * size * (1 + i) + row], value_in[w, i])
        u_out[w, row] = total

    return SimpleNamespace(compliance=compliance, add_own=add_own, active_set=active_set, combine=combine)
