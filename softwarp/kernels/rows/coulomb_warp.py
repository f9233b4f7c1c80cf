"""The Gauss-Seidel of ``coulomb`` on a GPU: 32 threads of a warp share the rows of one world.

Sums over a row are split among the threads and added in a fixed order, so results repeat to the bit; every thread then
solves the small problem of the visited contact itself. Matrix and vectors have a world's entries side by side.
Theory: docs/theory/coulomb.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.rows import coulomb
from softwarp.kernels.rows.coulomb import (
    BEYOND,
    DAMPING,
    GRAM,
    HISTORY,
    LONGEST,
    MEMORY,
    NEAR,
    RESTART,
    STALL,
    STALLED,
)

WIDTH = 32  # threads of a warp
BLOCK = 128  # threads of a block; worlds in it do not wait for each other
FEW_WORLDS = 512  # up to which a world has a block, and so a multiprocessor's cache, to itself
BLOCKS = 4  # at once on a multiprocessor, which bounds the registers of a thread


@wp.func_native("__syncwarp();")
def meet():
    """Wait for the threads of the warp; their writes are visible after it."""


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Gauss-Seidel of the ``cuda`` variant for one scalar type."""
    real = variant.real
    module = variant.module("coulomb_warp")
    module.options["fast_math"] = True  # divisions of the contact laws to 2 ulp; a quarter less time
    base = coulomb.kernels(variant)
    reciprocal, tangent_solution, solve_gram = base.reciprocal, base.tangent_solution, base.solve_gram

    @wp.func_native("return __shfl_xor_sync(0xffffffffu, value, offset);")
    def exchange(value: real, offset: int) -> real:
        """The value of the thread whose number differs in the bits of ``offset``."""

    @wp.func
    def warp_sum(value: real):
        """Sum over the threads, the same bits in each."""
        total = value
        total += exchange(total, 16)
        total += exchange(total, 8)
        total += exchange(total, 4)
        total += exchange(total, 2)
        total += exchange(total, 1)
        return total

    @wp.func
    def block_product(
        delassus: wp.array2d(dtype=real),
        change: wp.array2d(dtype=real),
        w: int,
        thread: int,
        begin: int,
        order: int,
        total: int,
    ):
        """Three rows of W times the change; four columns at a time, so that their loads are under way together."""
        s0 = real(0.0)
        s1 = real(0.0)
        s2 = real(0.0)
        for j in range(thread, total, wp.static(4 * WIDTH)):
            for step in range(4):
                column = j + wp.static(WIDTH) * step
                d = real(0.0)
                if column < total:
                    d = change[w, column]
                p = begin + wp.min(column, total - 1)
                s0 += delassus[w, p] * d
                s1 += delassus[w, p + order] * d
                s2 += delassus[w, p + 2 * order] * d
        return warp_sum(s0), warp_sum(s1), warp_sum(s2)

    @wp.func
    def row_law(
        delassus: wp.array2d(dtype=real),
        gap: wp.array2d(dtype=real),
        compliance: wp.array2d(dtype=real),
        lower: wp.array2d(dtype=real),
        upper: wp.array2d(dtype=real),
        floor: wp.array2d(dtype=real),
        ceiling: wp.array2d(dtype=real),
        value: wp.array2d(dtype=real),
        change: wp.array2d(dtype=real),
        w: int,
        thread: int,
        order: int,
        total: int,
        i: int,
    ):
        """Bring one static row to its law; returns the correction [m] that this took."""
        s = real(0.0)
        for j in range(thread, total, wp.static(WIDTH)):
            s += delassus[w, i * order + j] * change[w, j]
        s = warp_sum(s)
        soft = compliance[w, i]
        hard = delassus[w, i * order + i]
        old = value[w, i]
        g = gap[w, i] + s
        law = wp.min(wp.max(old - (g + soft * old) * reciprocal(hard + soft), lower[w, i]), upper[w, i])
        unit = reciprocal(hard)
        new = wp.min(wp.max(law, old + (floor[w, i] - g) * unit), old + (ceiling[w, i] - g) * unit)
        diagonal = hard + wp.where(new == law, soft, real(0.0))
        moved = change[w, i] + (new - old)
        meet()
        if thread == 0:
            value[w, i] = new
            change[w, i] = moved
        meet()
        return wp.abs(new - old) * diagonal

    @wp.func
    def contact_law(
        delassus: wp.array2d(dtype=real),
        gap: wp.array2d(dtype=real),
        mu: wp.array2d(dtype=real),
        compliance: wp.array2d(dtype=real),
        value: wp.array2d(dtype=real),
        change: wp.array2d(dtype=real),
        curve: wp.array2d(dtype=real),
        w: int,
        thread: int,
        order: int,
        rows: int,
        total: int,
        contact: int,
    ):
        """Bring one contact to Signorini's and then to Coulomb's law; returns the correction [m] that this took."""
        i = rows + 3 * contact
        begin = i * order
        corner = begin + i
        # Loads first: the warp would wait for each of them behind the exchanges.
        old0 = value[w, i]
        old1 = value[w, i + 1]
        old2 = value[w, i + 2]
        g0 = gap[w, i]
        g1 = gap[w, i + 1]
        g2 = gap[w, i + 2]
        w00 = delassus[w, corner]
        w10 = delassus[w, corner + order]
        w20 = delassus[w, corner + 2 * order]
        w11 = delassus[w, corner + order + 1]
        w12 = delassus[w, corner + 2 * order + 1]
        w22 = delassus[w, corner + 2 * order + 2]
        soft = compliance[w, contact]
        slope = mu[w, contact]
        bend = curve[w, contact]
        s0, s1, s2 = block_product(delassus, change, w, thread, begin, order, total)
        diagonal = w00 + soft
        new0 = wp.max(old0 - (g0 + s0 + soft * old0) * reciprocal(diagonal), real(0.0))
        step0 = new0 - old0
        g1 += s1 + w10 * step0
        g2 += s2 + w20 * step0
        new1, new2, bend = tangent_solution(w11, w12, w22, g1, g2, old1, old2, slope * new0, bend)
        step1 = new1 - old1
        step2 = new2 - old2
        meet()
        if thread == 0:
            curve[w, contact] = bend
            value[w, i] = new0
            value[w, i + 1] = new1
            value[w, i + 2] = new2
            change[w, i] += step0
            change[w, i + 1] += step1
            change[w, i + 2] += step2
        meet()
        slide = wp.max(wp.abs(step1), wp.abs(step2))
        return wp.max(wp.abs(step0) * diagonal, slide * (w11 + w22))

    @wp.func
    def note_sweep(
        delassus: wp.array2d(dtype=real),
        change: wp.array2d(dtype=real),
        history: wp.array2d(dtype=real),
        gram: wp.array2d(dtype=real),
        value: wp.array2d(dtype=real),
        w: int,
        thread: int,
        order: int,
        total: int,
        sweep: int,
        best: real,
    ):
        """``remember`` of ``coulomb``; every thread keeps its share of the vectors."""
        square = real(0.0)
        for i in range(thread, total, wp.static(WIDTH)):
            f = change[w, i] - history[w, i]
            square += f * f * delassus[w, i * order + i]
        square = warp_sum(square)
        slot = sweep % wp.static(MEMORY)
        keep = real(1.0)
        grown = square > best * real(wp.static(RESTART))
        if grown:
            keep = real(0.0)
            for k in range(3, wp.static(HISTORY)):
                for i in range(thread, total, wp.static(WIDTH)):
                    history[w, k * order + i] = real(0.0)
            for k in range(thread, wp.static(MEMORY * MEMORY), wp.static(WIDTH)):
                gram[w, k] = real(0.0)
        if sweep == 0:
            keep = real(0.0)
        new = (3 + slot) * order
        end = new + wp.static(MEMORY) * order
        for i in range(thread, total, wp.static(WIDTH)):
            f = change[w, i] - history[w, i]
            if grown:
                f = history[w, 2 * order + i]
                value[w, i] += history[w, order + i] - change[w, i]
                change[w, i] = history[w, order + i]
            history[w, new + i] = (f - history[w, 2 * order + i]) * keep
            history[w, end + i] = (change[w, i] - history[w, order + i]) * keep
            history[w, order + i] = change[w, i]
            history[w, 2 * order + i] = f
        meet()
        for k in range(wp.static(MEMORY)):
            g = real(0.0)
            b = real(0.0)
            for i in range(thread, total, wp.static(WIDTH)):
                weight = delassus[w, i * order + i]
                weighted = history[w, (3 + k) * order + i] * weight
                moved = history[w, (3 + wp.static(MEMORY) + k) * order + i] * weight
                g += weighted * history[w, new + i] + moved * history[w, end + i] * real(wp.static(DAMPING))
                b += weighted * history[w, 2 * order + i]
            g = warp_sum(g)
            b = warp_sum(b)
            if thread == 0:
                gram[w, wp.static(MEMORY) * k + slot] = g
                gram[w, wp.static(MEMORY) * slot + k] = g
                gram[w, wp.static(2 * MEMORY * MEMORY) + k] = b
        return wp.min(best, square)

    @wp.func
    def guess(
        delassus: wp.array2d(dtype=real),
        history: wp.array2d(dtype=real),
        gram: wp.array2d(dtype=real),
        value: wp.array2d(dtype=real),
        change: wp.array2d(dtype=real),
        w: int,
        thread: int,
        order: int,
        total: int,
    ):
        """Start the next sweep where the remembered ones, linearly combined, would have had no correction."""
        way = real(0.0)
        correction = real(0.0)
        for i in range(thread, total, wp.static(WIDTH)):
            step = real(0.0)
            for k in range(wp.static(MEMORY)):
                share = gram[w, wp.static(2 * MEMORY * MEMORY) + k]
                step -= history[w, (3 + wp.static(MEMORY) + k) * order + i] * share
            step = wp.clamp(step, real(wp.static(-BEYOND)), real(wp.static(BEYOND)))
            history[w, i] = step
            weight = delassus[w, i * order + i]
            way += step * step * weight
            correction += history[w, 2 * order + i] * history[w, 2 * order + i] * weight
        way = warp_sum(way) + real(1.0e-30)
        scale = wp.min(wp.sqrt(warp_sum(correction) * real(wp.static(LONGEST * LONGEST)) / way), real(1.0))
        for i in range(thread, total, wp.static(WIDTH)):
            step = history[w, i] * scale
            change[w, i] += step
            value[w, i] += step

    @wp.func
    def begin_world(
        multiplier: wp.array2d(dtype=real),
        force: wp.array2d(dtype=real),
        value: wp.array2d(dtype=real),
        change: wp.array2d(dtype=real),
        curve: wp.array2d(dtype=real),
        history: wp.array2d(dtype=real),
        gram: wp.array2d(dtype=real),
        w: int,
        thread: int,
        order: int,
        rows: int,
        total: int,
    ):
        """Load the multipliers and empty the memory."""
        for i in range(thread, total, wp.static(WIDTH)):
            change[w, i] = real(0.0)
            if i < rows:
                value[w, i] = multiplier[w, i]
            else:
                value[w, i] = force[w, i - rows]
            for k in range(1, wp.static(HISTORY)):
                history[w, k * order + i] = real(0.0)
        for contact in range(thread, (total - rows) // 3, wp.static(WIDTH)):
            curve[w, contact] = real(0.0)
        for k in range(thread, wp.static(GRAM), wp.static(WIDTH)):
            gram[w, k] = real(0.0)

    @wp.kernel(module=module, enable_backward=False, launch_bounds=(BLOCK, BLOCKS))
    def gauss_seidel(
        # Model
        bounded_row: wp.array(dtype=wp.int32),
        rows: int,
        order: int,
        sweeps: int,
        tolerance: real,
        # Workspace in
        pack_count_in: wp.array2d(dtype=wp.int32),
        delassus_in: wp.array2d(dtype=real),
        gap_in: wp.array2d(dtype=real),
        compliance_in: wp.array2d(dtype=real),
        lower_in: wp.array2d(dtype=real),
        upper_in: wp.array2d(dtype=real),
        floor_in: wp.array2d(dtype=real),
        ceiling_in: wp.array2d(dtype=real),
        mu_in: wp.array2d(dtype=real),
        softness_in: wp.array2d(dtype=real),
        # Workspace out
        value_out: wp.array2d(dtype=real),
        multiplier_out: wp.array2d(dtype=real),
        force_out: wp.array2d(dtype=real),
        change_out: wp.array2d(dtype=real),
        curve_out: wp.array2d(dtype=real),
        history_out: wp.array2d(dtype=real),
        gram_out: wp.array2d(dtype=real),
        residual_out: wp.array2d(dtype=real),
    ):
        """Accelerated sweeps over bounded static rows (``multiplier``) and contacts (``force``) of one world."""
        w, thread = wp.tid()
        count = pack_count_in[w, 0]
        total = rows + 3 * count
        begin_world(
            multiplier_out,
            force_out,
            value_out,
            change_out,
            curve_out,
            history_out,
            gram_out,
            w,
            thread,
            order,
            rows,
            total,
        )
        meet()
        best = real(1.0e30)
        worst = real(0.0)
        is_active = bool(True)
        mark = real(1.0e30)
        lowest = real(1.0e30)
        for sweep in range(sweeps):
            if is_active:
                for i in range(thread, total, wp.static(WIDTH)):
                    history_out[w, i] = change_out[w, i]
                worst = real(0.0)
                for k in range(bounded_row.shape[0]):
                    moved = row_law(
                        delassus_in,
                        gap_in,
                        compliance_in,
                        lower_in,
                        upper_in,
                        floor_in,
                        ceiling_in,
                        value_out,
                        change_out,
                        w,
                        thread,
                        order,
                        total,
                        bounded_row[k],
                    )
                    worst = wp.max(worst, moved)
                for contact in range(count):
                    moved = contact_law(
                        delassus_in,
                        gap_in,
                        mu_in,
                        softness_in,
                        value_out,
                        change_out,
                        curve_out,
                        w,
                        thread,
                        order,
                        rows,
                        total,
                        contact,
                    )
                    worst = wp.max(worst, moved)
                is_active = worst > tolerance
                lowest = wp.min(lowest, worst)
                if sweep % wp.static(STALL) == wp.static(STALL - 1):
                    if lowest > mark * real(wp.static(STALLED)) and worst <= tolerance * real(wp.static(NEAR)):
                        is_active = False
                    mark = lowest
                if is_active and sweep + 1 < sweeps:
                    best = note_sweep(
                        delassus_in, change_out, history_out, gram_out, value_out, w, thread, order, total, sweep, best
                    )
                    meet()
                    if sweep + 2 < sweeps:
                        if thread == 0:
                            solve_gram(gram_out, w)
                        meet()
                        guess(delassus_in, history_out, gram_out, value_out, change_out, w, thread, order, total)
                        meet()
        for i in range(thread, total, wp.static(WIDTH)):
            if i < rows:
                multiplier_out[w, i] = value_out[w, i]
            else:
                force_out[w, i - rows] = value_out[w, i]
        if thread == 0:
            residual_out[w, 0] = worst

    return SimpleNamespace(gauss_seidel=gauss_seidel)
