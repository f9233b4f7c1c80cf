"""Multiplier rows: Delassus matrix, projected Gauss-Seidel and the forces that rows exert.

With Y = L^-1 H' every quantity of the multiplier problem is a dot product: W = s f Y'Y is the change of the gaps per
unit multiplier, and s Y' y the free change for the half-solved right-hand side y. Multipliers are forces [N]; f is
the step that turns them into impulses and s the factor from unknowns to positions. Rows without bounds (joints) can be
eliminated: with W_uu + C = L D L' among them and Z = L^-1 W_uk, the others see W_kl - Z_k' D^-1 Z_l.
Theory: docs/theory/delassus.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import wide
from softwarp.kernels.algebra.lanes import Variant


def dependent_pivot(variant: Variant) -> float:
    """Relative pivot of a row that repeats others."""
    return 1.0e-9 if variant.real is wp.float64 else 1.0e-5


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Constraint kernels for one scalar type."""
    S = variant.S
    real = variant.real
    mul, fma, div = variant.mul, variant.fma, variant.div
    is_wide = wide.is_wide(variant)
    lanes, world_fastest = variant.lanes, variant.world_fastest
    module = variant.module("constraint")
    dependent = dependent_pivot(variant)

    @wp.func
    def dot_threefold(array: wp.array2d(dtype=S), w: int, a: int, b: int, count: int):
        """Sum of the products of ``count`` rows from a on with those from b on; count is a multiple of three."""
        s0 = S(real(0.0))
        s1 = S(real(0.0))
        s2 = S(real(0.0))
        for k in range(0, count, 3):
            s0 = fma(array[w, a + k], array[w, b + k], s0)
            s1 = fma(array[w, a + k + 1], array[w, b + k + 1], s1)
            s2 = fma(array[w, a + k + 2], array[w, b + k + 2], s2)
        return s0 + s1 + s2

    @wp.func
    def add_each(array: wp.array2d(dtype=S), w: int, a: int, b: int, count: int, factor: S):
        """Add ``factor`` times the ``count`` rows from b on to those from a on."""
        for k in range(count):
            array[w, a + k] = fma(array[w, b + k], factor, array[w, a + k])

    dot = wide.dot if is_wide else dot_threefold

    @wp.kernel(module=module, enable_backward=False)
    def delassus(
        # Model
        size: int,
        order: int,
        pair: wp.array2d(dtype=wp.int32),
        # Workspace in
        y_in: wp.array2d(dtype=S),
        scale: real,
        # Workspace out
        delassus_out: wp.array2d(dtype=S),
    ):
        """One entry W_ij (and W_ji) of the Delassus matrix, whose rows have ``order`` entries."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        i = pair[item, 0]
        j = pair[item, 1]
        a = 3 * size * (1 + i)
        b = 3 * size * (1 + j)
        value = dot(y_in, w, a, b, 3 * size) * scale
        delassus_out[w, i * order + j] = value
        delassus_out[w, j * order + i] = value

    @wp.kernel(module=module, enable_backward=False)
    def row_force(
        # Model
        dof_entry_start: wp.array(dtype=wp.int32),
        dof_entry: wp.array(dtype=wp.int32),
        entry_row: wp.array(dtype=wp.int32),
        dof_free: wp.array2d(dtype=real),
        # Workspace in
        row_in: wp.array2d(dtype=S),
        multiplier_in: wp.array2d(dtype=S),
        f_scale: real,
        # Workspace out
        b_out: wp.array2d(dtype=S),
    ):
        """b += f H' multiplier for one dof; what is prescribed takes no force."""
        w, dof = wp.tid()
        if wp.static(world_fastest):
            dof, w = wp.tid()
        for p in range(dof_entry_start[dof], dof_entry_start[dof + 1]):
            entry = dof_entry[p]
            value = multiplier_in[w, entry_row[entry]] * f_scale
            for c in range(3):
                b_out[w, 3 * dof + c] += mul(row_in[w, 3 * entry + c], value) * dof_free[dof, c]

    @wp.kernel(module=module, enable_backward=False)
    def row_gap(
        # Workspace in
        displacement_in: wp.array2d(dtype=S),
        target_in: wp.array2d(dtype=S),
        compliance_in: wp.array2d(dtype=S),
        floor_in: wp.array2d(dtype=S),
        ceiling_in: wp.array2d(dtype=S),
        multiplier_in: wp.array2d(dtype=S),
        # Workspace out
        gap_out: wp.array2d(dtype=S),
    ):
        """Shortfall of one row at the trial positions; at its floor or ceiling a row may have more than its law."""
        w, row = wp.tid()
        if wp.static(world_fastest):
            row, w = wp.tid()
        gap = displacement_in[w, row] - target_in[w, row]
        law = gap + mul(compliance_in[w, row], multiplier_in[w, row])
        gap_out[w, row] = wp.min(wp.max(law, gap - ceiling_in[w, row]), gap - floor_in[w, row])

    @wp.kernel(module=module, enable_backward=False)
    def free_gap(
        # Model
        size: int,
        row_entry_start: wp.array(dtype=wp.int32),
        entry_dof: wp.array(dtype=wp.int32),
        # Workspace in
        row_in: wp.array2d(dtype=S),
        u_in: wp.array2d(dtype=S),
        y_in: wp.array2d(dtype=S),
        displacement_in: wp.array2d(dtype=S),
        target_in: wp.array2d(dtype=S),
        x_scale: real,
        # Workspace out
        gap_out: wp.array2d(dtype=S),
    ):
        """Shortfall of one row before new multipliers: d + s H u + s Y' y - target."""
        w, row = wp.tid()
        if wp.static(world_fastest):
            row, w = wp.tid()
        total = S(real(0.0))
        for entry in range(row_entry_start[row], row_entry_start[row + 1]):
            dof = 3 * entry_dof[entry]
            for c in range(3):
                total = fma(row_in[w, 3 * entry + c], u_in[w, dof + c], total)
        total += dot(y_in, w, 3 * size * (1 + row), 0, 3 * size)
        gap_out[w, row] = displacement_in[w, row] + total * x_scale - target_in[w, row]

    @wp.kernel(module=module, enable_backward=False)
    def gauss_seidel(
        count: int,
        iterations: int,
        # Workspace in
        delassus_in: wp.array2d(dtype=S),
        lower_in: wp.array2d(dtype=S),
        upper_in: wp.array2d(dtype=S),
        # Workspace out
        gap_out: wp.array2d(dtype=S),
        multiplier_out: wp.array2d(dtype=S),
        change_out: wp.array2d(dtype=S),
        residual_out: wp.array2d(dtype=S),
    ):
        """Projected Gauss-Seidel on W change + gap = 0 with lower <= multiplier <= upper.

        A fixed number of sweeps, so that a world's result never depends on its neighbours; a world by itself leaves out
        those that would change no bit. The residual [m] is the largest correction W_ii |step| that one further
        projected sweep would ask for.
        """
        w = wp.tid()
        zero = S(real(0.0))
        for i in range(count):
            change_out[w, i] = zero
        for sweep in range(iterations):
            moved = int(0)
            for i in range(count):
                diagonal = delassus_in[w, i * count + i] + S(real(1.0e-30))
                old = multiplier_out[w, i]
                new = wp.min(wp.max(old - div(gap_out[w, i], diagonal), lower_in[w, i]), upper_in[w, i])
                step = new - old
                multiplier_out[w, i] = new
                change_out[w, i] += step
                for j in range(count):
                    gap_out[w, j] += mul(delassus_in[w, j * count + i], step)
                if wp.static(lanes == 1):
                    if step != zero:
                        moved = 1
            if wp.static(lanes == 1):
                if moved == 0:
                    break
        worst = zero
        for i in range(count):
            diagonal = delassus_in[w, i * count + i] + S(real(1.0e-30))
            old = multiplier_out[w, i]
            new = wp.min(wp.max(old - div(gap_out[w, i], diagonal), lower_in[w, i]), upper_in[w, i])
            step = mul(new - old, diagonal)
            worst = wp.max(worst, wp.max(step, -step))
        residual_out[w, 0] = worst

    @wp.kernel(module=module, enable_backward=False)
    def add_change(
        # Model
        size: int,
        count: int,
        # Workspace in
        change_in: wp.array2d(dtype=S),
        f_scale: real,
        # Workspace out
        y_out: wp.array2d(dtype=S),
    ):
        """y += f Y change, so that one backward substitution yields the constrained unknowns.

        On a CPU a thread takes all rows; see ``Variant.parts``.
        """
        w, part = wp.tid()
        last = 3 * size
        if wp.static(world_fastest):
            part, w = wp.tid()
            last = part + 1
        for i in range(count):
            change = change_in[w, i] * f_scale
            side = 3 * size * (1 + i) + part
            if wp.static(is_wide):
                wide.add_scaled(y_out, w, part, side, last - part, change)
            else:
                add_each(y_out, w, part, side, last - part, change)

    @wp.func
    def soft_inverse(pivot: S, scale: S):
        """1 / pivot, turning smoothly into 0 where the pivot falls below the scale."""
        q = div(pivot, scale)
        r = mul(q, q)
        return div(mul(q, r), mul(S(real(1.0)) + mul(r, r), scale))

    @wp.kernel(module=module, enable_backward=False)
    def factor_unbounded(
        # Model
        unbounded_row: wp.array(dtype=wp.int32),
        order: int,
        # Workspace in
        compliance_in: wp.array2d(dtype=S),
        # Workspace out
        delassus_out: wp.array2d(dtype=S),
        inverse_out: wp.array2d(dtype=S),
    ):
        """W_uu + C = L D L' in place: L D below the diagonal, D^-1 apart; rows that repeat others get D^-1 = 0."""
        w = wp.tid()
        for a in range(unbounded_row.shape[0]):
            i = unbounded_row[a] * order
            for b in range(a + 1):
                j = unbounded_row[b]
                total = delassus_out[w, i + j]
                if a == b:
                    total += compliance_in[w, j]
                scale = total * real(wp.static(dependent)) + S(real(1.0e-30))
                for k in range(b):
                    column = unbounded_row[k]
                    left = delassus_out[w, i + column]
                    total -= mul(mul(left, inverse_out[w, k]), delassus_out[w, j * order + column])
                if a == b:
                    inverse_out[w, a] = soft_inverse(total, scale)
                else:
                    delassus_out[w, i + j] = total

    @wp.func
    def free_row(item: int, row_count: int, bounded_count: int, bounded_row: wp.array(dtype=wp.int32)):
        """Row of W of an item: bounded static rows first, then those of contacts."""
        row = row_count + item - bounded_count
        if item < bounded_count:
            row = bounded_row[item]
        return row

    @wp.kernel(module=module, enable_backward=False)
    def half_column(
        # Model
        bounded_row: wp.array(dtype=wp.int32),
        unbounded_row: wp.array(dtype=wp.int32),
        row_count: int,
        order: int,
        late: bool,
        # Workspace in
        pack_first_in: wp.array2d(dtype=wp.int32),
        pack_count_in: wp.array2d(dtype=wp.int32),
        inverse_in: wp.array2d(dtype=S),
        # Workspace out
        delassus_out: wp.array2d(dtype=S),
    ):
        """Z_k = L^-1 W_uk of one other row k, in the place of W_ku."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        if item >= bounded_row.shape[0] + 3 * pack_count_in[w, 0]:
            return
        if late and item < bounded_row.shape[0] + 3 * pack_first_in[w, 0]:
            return
        k = free_row(item, row_count, bounded_row.shape[0], bounded_row) * order
        for a in range(unbounded_row.shape[0]):
            i = unbounded_row[a]
            total = delassus_out[w, k + i]
            for b in range(a):
                j = unbounded_row[b]
                total -= mul(mul(delassus_out[w, i * order + j], inverse_in[w, b]), delassus_out[w, k + j])
            delassus_out[w, k + i] = total

    @wp.kernel(module=module, enable_backward=False)
    def reduce_row(
        # Model
        bounded_row: wp.array(dtype=wp.int32),
        unbounded_row: wp.array(dtype=wp.int32),
        row_count: int,
        order: int,
        late: bool,
        # Workspace in
        pack_first_in: wp.array2d(dtype=wp.int32),
        pack_count_in: wp.array2d(dtype=wp.int32),
        inverse_in: wp.array2d(dtype=S),
        # Workspace out
        delassus_out: wp.array2d(dtype=S),
    ):
        """W_km -= Z_k' D^-1 Z_m of one row k, for all m <= k; what little is left of a diagonal stays positive."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        if item >= bounded_row.shape[0] + 3 * pack_count_in[w, 0]:
            return
        if late and item < bounded_row.shape[0] + 3 * pack_first_in[w, 0]:
            return
        k = free_row(item, row_count, bounded_row.shape[0], bounded_row)
        for other in range(item + 1):
            m = free_row(other, row_count, bounded_row.shape[0], bounded_row)
            total = delassus_out[w, k * order + m]
            floor = total * real(wp.static(dependent))
            for a in range(unbounded_row.shape[0]):
                i = unbounded_row[a]
                left = mul(delassus_out[w, k * order + i], inverse_in[w, a])
                total -= mul(left, delassus_out[w, m * order + i])
            if k == m:
                total = wp.max(total, floor)
            delassus_out[w, k * order + m] = total
            delassus_out[w, m * order + k] = total

    @wp.kernel(module=module, enable_backward=False)
    def reduce_gap(
        # Model
        bounded_row: wp.array(dtype=wp.int32),
        unbounded_row: wp.array(dtype=wp.int32),
        row_count: int,
        order: int,
        # Workspace in
        pack_count_in: wp.array2d(dtype=wp.int32),
        inverse_in: wp.array2d(dtype=S),
        delassus_in: wp.array2d(dtype=S),
        compliance_in: wp.array2d(dtype=S),
        multiplier_in: wp.array2d(dtype=S),
        # Workspace out
        gap_out: wp.array2d(dtype=S),
    ):
        """z = L^-1 (g_u + C multiplier_u) in place, and g_k -= Z_k' D^-1 z."""
        w = wp.tid()
        for a in range(unbounded_row.shape[0]):
            i = unbounded_row[a]
            total = gap_out[w, i] + mul(compliance_in[w, i], multiplier_in[w, i])
            for b in range(a):
                j = unbounded_row[b]
                total -= mul(mul(delassus_in[w, i * order + j], inverse_in[w, b]), gap_out[w, j])
            gap_out[w, i] = total
        for item in range(bounded_row.shape[0] + 3 * pack_count_in[w, 0]):
            k = free_row(item, row_count, bounded_row.shape[0], bounded_row)
            total = gap_out[w, k]
            for a in range(unbounded_row.shape[0]):
                i = unbounded_row[a]
                total -= mul(mul(delassus_in[w, k * order + i], inverse_in[w, a]), gap_out[w, i])
            gap_out[w, k] = total

    @wp.kernel(module=module, enable_backward=False)
    def unbounded_change(
        # Model
        bounded_row: wp.array(dtype=wp.int32),
        unbounded_row: wp.array(dtype=wp.int32),
        row_count: int,
        order: int,
        # Workspace in
        pack_count_in: wp.array2d(dtype=wp.int32),
        inverse_in: wp.array2d(dtype=S),
        delassus_in: wp.array2d(dtype=S),
        gap_in: wp.array2d(dtype=S),
        # Workspace out
        change_out: wp.array2d(dtype=S),
        multiplier_out: wp.array2d(dtype=S),
    ):
        """change_u = -L'^-1 D^-1 (z + Z change_k), added to the multipliers."""
        w = wp.tid()
        last = unbounded_row.shape[0] - 1
        for step in range(unbounded_row.shape[0]):
            a = last - step
            i = unbounded_row[a]
            total = gap_in[w, i]
            for item in range(bounded_row.shape[0] + 3 * pack_count_in[w, 0]):
                k = free_row(item, row_count, bounded_row.shape[0], bounded_row)
                total = fma(delassus_in[w, k * order + i], change_out[w, k], total)
            for b in range(a + 1, unbounded_row.shape[0]):
                j = unbounded_row[b]
                total = fma(delassus_in[w, j * order + i], change_out[w, j], total)
            change = -mul(total, inverse_in[w, a])
            change_out[w, i] = change
            multiplier_out[w, i] += change

    return SimpleNamespace(
        factor_unbounded=factor_unbounded,
        half_column=half_column,
        reduce_row=reduce_row,
        reduce_gap=reduce_gap,
        unbounded_change=unbounded_change,
        delassus=delassus,
        row_force=row_force,
        row_gap=row_gap,
        free_gap=free_gap,
        gauss_seidel=gauss_seidel,
        add_change=add_change,
    )
