"""Rows that repeat others share their multipliers evenly. Theory: docs/theory/delassus.md.

Where rows of H depend on each other, W has directions n with W n = 0, along which multipliers change and nothing moves:
sweeps leave there what they find first, all at one row. Of all multipliers with the same effect those of least norm are
told instead. With W = L D L' in the order of the rows, a row whose pivot vanishes is a combination c of earlier ones,
n = e - c, and multipliers lose their parts along all such n.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.rows.delassus import dependent_pivot

CLOSED = 10.0  # tolerances within which the gap of a row is closed that may share


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels on single worlds."""
    real, module = variant.real, variant.module("sharing")
    vanishing = dependent_pivot(variant)

    @wp.func
    def dot(a: wp.array3d(dtype=real), pack: int, lane: int, i: int, j: int, count: int):
        """Product of two vectors of some entries that begin at i and j."""
        s = real(0.0)
        for k in range(count):
            s += a[pack, i + k, lane] * a[pack, j + k, lane]
        return s

    @wp.kernel(module=module, enable_backward=False)
    def share_rows(
        # Model
        rows: int,
        order: int,
        contact_row: int,
        tolerance: real,
        bounded_row: wp.array(dtype=wp.int32),
        # Workspace in
        contact_count_in: wp.array3d(dtype=wp.int32),
        delassus_in: wp.array3d(dtype=real),
        gap_in: wp.array3d(dtype=real),
        compliance_in: wp.array3d(dtype=real),
        lower_in: wp.array3d(dtype=real),
        upper_in: wp.array3d(dtype=real),
        # Workspace out
        factor_out: wp.array3d(dtype=real),
        null_out: wp.array3d(dtype=real),
        way_out: wp.array3d(dtype=real),
        multiplier_out: wp.array3d(dtype=real),
        change_out: wp.array3d(dtype=real),
    ):
        """Bring the first ``rows`` multipliers, and their change, to least norm; no gap moves by a tolerance [m].

        Rows take part that are rigid, between bounds that differ, and whose gap, ``gap_in`` + W change, is closed; all
        go as far as every bound lets them. ``factor_out`` and ``null_out`` have rows^2 entries.
        """
        pack, lane = wp.tid()
        total = contact_row + 3 * contact_count_in[pack, 0, lane]
        found = int(0)
        for i in range(rows):
            hard = delassus_in[pack, i * order + i, lane]
            gap = gap_in[pack, i, lane]
            for b in range(bounded_row.shape[0]):
                j = bounded_row[b]
                gap += delassus_in[pack, i * order + j, lane] * change_out[pack, j, lane]
            for j in range(contact_row, total):
                gap += delassus_in[pack, i * order + j, lane] * change_out[pack, j, lane]
            value = multiplier_out[pack, i, lane]
            takes_part = lower_in[pack, i, lane] < upper_in[pack, i, lane]
            takes_part = takes_part and value >= lower_in[pack, i, lane] and value <= upper_in[pack, i, lane]
            takes_part = takes_part and wp.abs(gap) <= real(wp.static(CLOSED)) * tolerance
            takes_part = takes_part and compliance_in[pack, i, lane] <= real(wp.static(vanishing)) * hard
            # Row i of L D, with D on the diagonal; D = 0 marks a row that does not lead
            for j in range(i):
                s = real(0.0)
                if takes_part and factor_out[pack, j * rows + j, lane] > real(0.0):
                    s = delassus_in[pack, i * order + j, lane]
                    for k in range(j):
                        d = factor_out[pack, k * rows + k, lane]
                        if d > real(0.0):
                            s -= factor_out[pack, i * rows + k, lane] * factor_out[pack, j * rows + k, lane] / d
                factor_out[pack, i * rows + j, lane] = s
            pivot = hard
            for k in range(i):
                d = factor_out[pack, k * rows + k, lane]
                if d > real(0.0):
                    pivot -= factor_out[pack, i * rows + k, lane] * factor_out[pack, i * rows + k, lane] / d
            leads = takes_part and pivot > real(wp.static(vanishing)) * hard
            factor_out[pack, i * rows + i, lane] = wp.where(leads, pivot, real(0.0))
            if takes_part and not leads and hard > real(0.0):
                # n = e_i - c, with L' c = D^-1 (row i of L D), made orthogonal to those before
                first = found * rows
                for k in range(rows):
                    null_out[pack, first + k, lane] = wp.where(k == i, real(1.0), real(0.0))
                for back in range(i):
                    k = i - 1 - back
                    d = factor_out[pack, k * rows + k, lane]
                    if d > real(0.0):
                        c = -factor_out[pack, i * rows + k, lane] / d
                        for m in range(k + 1, i):
                            if factor_out[pack, m * rows + m, lane] > real(0.0):
                                c -= factor_out[pack, m * rows + k, lane] / d * null_out[pack, first + m, lane]
                        null_out[pack, first + k, lane] = c
                for other in range(found):
                    near = dot(null_out, pack, lane, first, other * rows, rows)
                    for k in range(rows):
                        null_out[pack, first + k, lane] -= near * null_out[pack, other * rows + k, lane]
                unit = real(1.0) / wp.sqrt(dot(null_out, pack, lane, first, first, rows))
                for k in range(rows):
                    null_out[pack, first + k, lane] *= unit
                found += 1
        if found == 0:
            return
        for k in range(rows):
            way_out[pack, k, lane] = real(0.0)
        for n in range(found):
            part = real(0.0)
            for k in range(rows):
                part += null_out[pack, n * rows + k, lane] * multiplier_out[pack, k, lane]
            for k in range(rows):
                way_out[pack, k, lane] -= part * null_out[pack, n * rows + k, lane]
        share = real(1.0)
        for item in range(bounded_row.shape[0] + total - contact_row):
            i = contact_row + item - bounded_row.shape[0]
            if item < bounded_row.shape[0]:
                i = bounded_row[item]
            moved = real(0.0)
            for k in range(rows):
                moved += delassus_in[pack, i * order + k, lane] * way_out[pack, k, lane]
            if wp.abs(moved) * share > tolerance:
                share = tolerance / wp.abs(moved)
        for k in range(rows):
            way = way_out[pack, k, lane]
            if way > real(0.0):
                share = wp.min(share, (upper_in[pack, k, lane] - multiplier_out[pack, k, lane]) / way)
            if way < real(0.0):
                share = wp.min(share, (lower_in[pack, k, lane] - multiplier_out[pack, k, lane]) / way)
        for k in range(rows):
            step = share * way_out[pack, k, lane]
            multiplier_out[pack, k, lane] += step
            change_out[pack, k, lane] += step

    return SimpleNamespace(share_rows=share_rows)
