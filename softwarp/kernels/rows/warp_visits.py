"""A GPU's visits to static rows and contacts, one after the other, which the threads of a warp take part in.

The owner of what is visited brings it to its law and tells the others its step; each moves the gaps of what it owns.
Theory: docs/theory/coulomb.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.rows import coulomb, warp_share
from softwarp.kernels.rows.coulomb import PROXIMAL
from softwarp.kernels.rows.coulomb_tiers import WIDTH
from softwarp.kernels.rows.warp_share import first_thread


@cache
def functions(variant: Variant, own_rows: int, own_contacts: int, near_rows: int) -> SimpleNamespace:
    """``visit_rows`` and ``visit_contacts`` for one scalar type; the other arguments are those of ``warp_share``."""
    real = variant.real
    base = coulomb.kernels(variant)
    reciprocal, friction = base.reciprocal, base.friction
    share = warp_share.functions(variant, own_rows, own_contacts, near_rows)
    Owned, told, column = share.Owned, share.told, share.column
    PerContact = wp.types.vector(own_contacts, real)
    Bounds = wp.types.vector(4, real)  # lower, upper, floor, ceiling

    @wp.func
    def row_law(hard: real, soft: real, gap: real, old: real, bound: Bounds):
        """New multiplier of a static row, and the correction [m] that this takes."""
        law = wp.min(wp.max(old - (gap + soft * old) * reciprocal(hard + soft), bound[0]), bound[1])
        unit = reciprocal(hard)
        new = wp.min(wp.max(law, old + (bound[2] - gap) * unit), old + (bound[3] - gap) * unit)
        return new, wp.abs(new - old) * (hard + wp.where(new == law, soft, real(0.0)))

    @wp.func
    def tangent_law(
        w11: real, w12: real, w22: real, g1: real, g2: real, old1: real, old2: real, radius: real, curve: real
    ):
        """``tangent_solution`` of ``coulomb``, which ends early where the contact sticks."""
        unit = reciprocal(w11 + w22)
        a11 = w11 * unit + real(wp.static(PROXIMAL))
        a22 = w22 * unit + real(wp.static(PROXIMAL))
        a12 = w12 * unit
        b1 = g1 * unit - a11 * old1 - a12 * old2
        b2 = g2 * unit - a12 * old1 - a22 * old2
        if curve == real(0.0):
            q = real(1.0) / (a11 * a22 - a12 * a12)
            t1 = (a12 * b2 - a22 * b1) * q
            t2 = (a12 * b1 - a11 * b2) * q
            if t1 * t1 + t2 * t2 <= radius * radius:
                return t1, t2, curve
        return friction(a11, a12, a22, b1, b2, radius, curve)

    @wp.func
    def contact_law(
        weight: Owned,
        beside: Owned,
        corner: Owned,
        gap: Owned,
        value: Owned,
        soft: real,
        mu: real,
        curve: real,
        e: int,
    ):
        """New forces of the contact whose rows are entries e to e + 2, and its friction multiplier."""
        pushed = gap[e] + soft * value[e]
        new0 = wp.max(value[e] - pushed * reciprocal(weight[e] + soft), real(0.0))
        step = new0 - value[e]
        g1 = gap[e + 1] + beside[e] * step
        g2 = gap[e + 2] + corner[e] * step
        w11 = weight[e + 1]
        w12 = beside[e + 1]
        w22 = weight[e + 2]
        new1, new2, bend = tangent_law(w11, w12, w22, g1, g2, value[e + 1], value[e + 2], mu * new0, curve)
        return new0, new1, new2, bend

    @wp.func
    def visit_rows(
        bounded_row: wp.array(dtype=wp.int32),
        delassus: wp.array2d(dtype=real),
        compliance: wp.array2d(dtype=real),
        lower: wp.array2d(dtype=real),
        upper: wp.array2d(dtype=real),
        floor: wp.array2d(dtype=real),
        ceiling: wp.array2d(dtype=real),
        weight: Owned,
        value: Owned,
        change: Owned,
        gap: Owned,
        w: int,
        thread: int,
        order: int,
        rows: int,
        count: int,
    ):
        """Bring static rows to their laws, one after the other; also returns the thread's largest correction [m]."""
        worst = real(0.0)
        for item in range(bounded_row.shape[0]):
            row = bounded_row[item]
            step = real(0.0)
            for k in range(wp.static(own_rows)):
                if row == thread + wp.static(WIDTH) * k:
                    bound = Bounds(lower[w, row], upper[w, row], floor[w, row], ceiling[w, row])
                    new, moved = row_law(weight[k], compliance[w, row], gap[k], value[k], bound)
                    step = new - value[k]
                    value[k] = new
                    change[k] += step
                    worst = wp.max(worst, moved)
            step = told(step, row % wp.static(WIDTH))
            if step != real(0.0):
                gap += column(delassus, w, order, row, thread, rows, count) * step
        return value, change, gap, worst

    @wp.func
    def visit_contacts(
        delassus: wp.array2d(dtype=real),
        weight: Owned,
        beside: Owned,
        corner: Owned,
        soft: PerContact,
        mu: PerContact,
        value: Owned,
        change: Owned,
        gap: Owned,
        curve: PerContact,
        before: real,
        w: int,
        thread: int,
        order: int,
        rows: int,
        count: int,
    ):
        """Bring contacts to their laws, one after the other; open ones that stay so are passed over together."""
        worst = before
        for k in range(wp.static(own_contacts)):
            e = wp.static(own_rows) + 3 * k
            owner = int(-1)
            is_left = bool(True)
            while is_left:
                is_loaded = value[e] != real(0.0) or value[e + 1] != real(0.0) or value[e + 2] != real(0.0)
                is_met = gap[e] < real(0.0) and thread + wp.static(WIDTH) * k < count
                owner = first_thread((is_loaded or is_met) and thread > owner)
                is_left = owner >= 0
                if is_left:
                    j = rows + 3 * (owner + wp.static(WIDTH) * k)  # columns are on their way while the owner works
                    line0 = column(delassus, w, order, j, thread, rows, count)
                    line1 = column(delassus, w, order, j + 1, thread, rows, count)
                    line2 = column(delassus, w, order, j + 2, thread, rows, count)
                    step0 = real(0.0)
                    step1 = real(0.0)
                    step2 = real(0.0)
                    if thread == owner:
                        new0, new1, new2, bend = contact_law(
                            weight, beside, corner, gap, value, soft[k], mu[k], curve[k], e
                        )
                        step0 = new0 - value[e]
                        step1 = new1 - value[e + 1]
                        step2 = new2 - value[e + 2]
                        curve[k] = bend
                        value[e] = new0
                        value[e + 1] = new1
                        value[e + 2] = new2
                        change[e] += step0
                        change[e + 1] += step1
                        change[e + 2] += step2
                        slide = wp.max(wp.abs(step1), wp.abs(step2)) * (weight[e + 1] + weight[e + 2])
                        worst = wp.max(worst, wp.max(wp.abs(step0) * (weight[e] + soft[k]), slide))
                    gap += line0 * told(step0, owner)
                    gap += line1 * told(step1, owner)
                    gap += line2 * told(step2, owner)
        return value, change, gap, curve, worst

    return SimpleNamespace(visit_rows=visit_rows, visit_contacts=visit_contacts)
