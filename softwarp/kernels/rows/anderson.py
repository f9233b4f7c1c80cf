"""Anderson's acceleration of sweeps over contact laws. Theory: docs/theory/coulomb.md.

What a world remembers lies in ``history``, vectors over all rows, and ``gram``, a small matrix with its factor and its
right side. Behind them lies what Newton's method remembers (``coulomb_newton``).
"""

from collections.abc import Callable
from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.rows import coulomb_lanes, coulomb_newton

MEMORY = 5  # sweeps that the acceleration remembers
VECTORS = 3 + 2 * MEMORY  # of the acceleration, see ``remember``
HISTORY = VECTORS + coulomb_newton.VECTORS
SUMS = MEMORY * (2 * MEMORY + 1)  # its small matrix, the factor, and the right-hand side or solution
GRAM = SUMS + coulomb_newton.STATE
DAMPING = 3.0e-7  # weight of the way that an extrapolation goes beside the correction that it leaves
BEYOND = 1.0e15  # bound of an extrapolation that keeps its square finite [N]
LONGEST = 1000.0  # extrapolation, relative to the correction that it starts from
RESTART = 4.0  # growth of the squared correction that makes a world forget


def comparison(variant: Variant) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """``above(a, b)``: 1 where a > b, else 0; ``is_any(a)``: whether some world of an element has a positive value."""
    S, real, lanes = variant.S, variant.real, variant.lanes

    @wp.func
    def above(a: S, b: real):
        return wp.where(a > b, real(1.0), real(0.0))

    @wp.func
    def is_any(a: S):
        return a > real(0.0)

    @wp.func
    def above_lanes(a: S, b: real):
        result = S()
        for lane in range(wp.static(lanes)):
            result[lane] = wp.where(a[lane] > b, real(1.0), real(0.0))
        return result

    @wp.func
    def is_any_lanes(a: S):
        found = bool(False)
        for lane in range(wp.static(lanes)):
            if a[lane] > real(0.0):
                found = True
        return found

    return (above_lanes, is_any_lanes) if lanes > 1 else (above, is_any)


@cache
def functions(variant: Variant) -> SimpleNamespace:
    """``forget`` and ``accelerate`` for one scalar type on a CPU."""
    S, real = variant.S, variant.real
    mul, fma, div, sqrt = variant.mul, variant.fma, variant.div, variant.sqrt
    above, is_any = comparison(variant)
    rounding = 1.0e-10 if real is wp.float64 else 1.0e-6  # least relative pivot

    @wp.func
    def forget(history: wp.array2d(dtype=S), gram: wp.array2d(dtype=S), w: int, order: int, total: int):
        """Empty the memory of the acceleration."""
        for k in range(1, wp.static(VECTORS)):
            for i in range(total):
                history[w, k * order + i] = S(real(0.0))
        for k in range(wp.static(GRAM)):
            gram[w, k] = S(real(0.0))
        gram[w, wp.static(SUMS + coulomb_newton.LEADS)] = S(real(1.0))
        gram[w, wp.static(SUMS + coulomb_newton.FRESH)] = S(real(1.0))
        gram[w, wp.static(SUMS + coulomb_newton.BEST)] = S(real(1.0e30))

    @wp.func
    def keep_history(history: wp.array2d(dtype=S), gram: wp.array2d(dtype=S), w: int, order: int, total: int, keep: S):
        """Empty the memory where ``keep`` is 0; it is 1 elsewhere."""
        for k in range(3, wp.static(VECTORS)):
            for i in range(total):
                history[w, k * order + i] = mul(history[w, k * order + i], keep)
        for k in range(wp.static(MEMORY * MEMORY)):
            gram[w, k] = mul(gram[w, k], keep)

    @wp.func
    def products(
        delassus: wp.array2d(dtype=S),
        history: wp.array2d(dtype=S),
        gram: wp.array2d(dtype=S),
        w: int,
        order: int,
        total: int,
        slot: int,
    ):
        """Products of the remembered differences with the newest one, in ``slot``, and with the last correction."""
        new = (3 + slot) * order
        end = new + wp.static(MEMORY) * order
        for k in range(wp.static(MEMORY)):
            g = S(real(0.0))
            b = S(real(0.0))
            for i in range(total):
                weight = delassus[w, i * order + i]
                weighted = mul(history[w, (3 + k) * order + i], weight)
                moved = mul(history[w, (3 + wp.static(MEMORY) + k) * order + i], weight)
                g = fma(weighted, history[w, new + i], g)
                g = fma(moved, history[w, end + i] * real(wp.static(DAMPING)), g)
                b = fma(weighted, history[w, 2 * order + i], b)
            gram[w, wp.static(MEMORY) * k + slot] = g
            gram[w, wp.static(MEMORY) * slot + k] = g
            gram[w, wp.static(2 * MEMORY * MEMORY) + k] = b

    if variant.lanes > 1:
        products = coulomb_lanes.memory_products(MEMORY, DAMPING)

    @wp.func
    def remember(
        delassus: wp.array2d(dtype=S),
        change: wp.array2d(dtype=S),
        history: wp.array2d(dtype=S),
        gram: wp.array2d(dtype=S),
        w: int,
        order: int,
        total: int,
        rows: int,
        multiplier: wp.array2d(dtype=S),
        force: wp.array2d(dtype=S),
        sweep: int,
        best: S,
        active: S,
    ):
        """Note what a sweep did; where its correction has grown, return to the end of the last one and forget the past.

        A world that has come to rest keeps what it has, whatever the others of its pack do, and so does one that
        Newton's method leads, whose past is empty when it comes back. A sweep that no guess went before has nothing to
        return from: its correction is the one that the next are compared with. Returns the least squared correction.

        Vectors of the history: 0 where this sweep started, 1 where the last one ended, 2 the correction f of the last
        one; then, for some sweeps, the differences of f; then those of the ends. W's diagonal weighs the products.
        """
        fresh = gram[w, wp.static(SUMS + coulomb_newton.FRESH)]
        begins = mul(above(fresh, real(0.75)), active)
        plain = mul(above(fresh, real(0.25)), active)
        best = mul(best, S(real(1.0)) - plain) + plain * real(1.0e30)
        square = S(real(0.0))
        for i in range(total):
            f = change[w, i] - history[w, i]
            square = fma(mul(f, f), delassus[w, i * order + i], square)
        grown = mul(above(square - best * real(wp.static(RESTART)), real(0.0)), active)
        gram[w, wp.static(SUMS + coulomb_newton.FRESH)] = mul(fresh, S(real(1.0)) - plain) + grown * real(0.5)
        keep = S(real(1.0)) - wp.max(grown, begins)
        if is_any(grown + begins):
            keep_history(history, gram, w, order, total, keep)
        keep = mul(keep, active)
        slot = sweep % wp.static(MEMORY)
        new = (3 + slot) * order
        end = new + wp.static(MEMORY) * order
        for i in range(total):
            f = change[w, i] - history[w, i]
            back = mul(history[w, order + i] - change[w, i], grown)
            f = fma(history[w, 2 * order + i] - f, grown, f)
            change[w, i] += back
            if i < rows:
                multiplier[w, i] += back
            else:
                force[w, i - rows] += back
            history[w, new + i] = mul(f - history[w, 2 * order + i], keep)
            history[w, end + i] = mul(change[w, i] - history[w, order + i], keep)
            history[w, order + i] = change[w, i]
            history[w, 2 * order + i] = f
        products(delassus, history, gram, w, order, total, slot)
        return wp.min(best, square)

    @wp.func
    def solve_gram(gram: wp.array2d(dtype=S), w: int):
        """Least squares: the combination of differences that comes closest to the last correction."""
        count = int(wp.static(MEMORY))
        factor = count * count
        right = 2 * count * count
        for j in range(count):
            pivot = gram[w, count * j + j]
            least = pivot * real(wp.static(rounding)) + S(real(1.0e-30))
            for k in range(j):
                left = gram[w, factor + count * j + k]
                pivot -= mul(left, left)
            root = sqrt(wp.max(pivot, least))
            gram[w, factor + count * j + j] = root
            for i in range(j + 1, count):
                total = gram[w, count * i + j]
                for k in range(j):
                    total -= mul(gram[w, factor + count * i + k], gram[w, factor + count * j + k])
                gram[w, factor + count * i + j] = div(total, root)
            total = gram[w, right + j]
            for k in range(j):
                total -= mul(gram[w, factor + count * j + k], gram[w, right + k])
            gram[w, right + j] = div(total, root)
        for step in range(count):
            j = count - 1 - step
            total = gram[w, right + j]
            for k in range(j + 1, count):
                total -= mul(gram[w, factor + count * k + j], gram[w, right + k])
            gram[w, right + j] = div(total, gram[w, factor + count * j + j])

    @wp.func
    def extrapolate(
        delassus: wp.array2d(dtype=S),
        history: wp.array2d(dtype=S),
        gram: wp.array2d(dtype=S),
        w: int,
        order: int,
        total: int,
        rows: int,
        active: S,
        multiplier: wp.array2d(dtype=S),
        force: wp.array2d(dtype=S),
        change: wp.array2d(dtype=S),
    ):
        """Start the next sweep where the remembered ones, linearly combined, would have had no correction."""
        way = S(real(1.0e-30))
        correction = S(real(0.0))
        for i in range(total):
            step = S(real(0.0))
            for k in range(wp.static(MEMORY)):
                share = gram[w, wp.static(2 * MEMORY * MEMORY) + k]
                step = fma(-share, history[w, (3 + wp.static(MEMORY) + k) * order + i], step)
            step = wp.min(wp.max(step, S(real(wp.static(-BEYOND)))), S(real(wp.static(BEYOND))))
            history[w, i] = step
            weight = delassus[w, i * order + i]
            f = history[w, 2 * order + i]
            way = fma(mul(step, step), weight, way)
            correction = fma(mul(f, f), weight, correction)
        scale = sqrt(div(correction * real(wp.static(LONGEST * LONGEST)), way))
        scale = mul(wp.min(scale, S(real(1.0))), active)
        for i in range(total):
            step = mul(history[w, i], scale)
            change[w, i] += step
            if i < rows:
                multiplier[w, i] += step
            else:
                force[w, i - rows] += step

    @wp.func
    def accelerate(
        delassus: wp.array2d(dtype=S),
        change: wp.array2d(dtype=S),
        history: wp.array2d(dtype=S),
        gram: wp.array2d(dtype=S),
        w: int,
        order: int,
        total: int,
        rows: int,
        multiplier: wp.array2d(dtype=S),
        force: wp.array2d(dtype=S),
        sweep: int,
        best: S,
        active: S,
        is_last: bool,
    ):
        """Remember a sweep and, but for the last, guess where the next one starts. Returns the least correction."""
        best = remember(delassus, change, history, gram, w, order, total, rows, multiplier, force, sweep, best, active)
        if not is_last:
            solve_gram(gram, w)
            extrapolate(delassus, history, gram, w, order, total, rows, active, multiplier, force, change)
        return best

    return SimpleNamespace(forget=forget, accelerate=accelerate)
