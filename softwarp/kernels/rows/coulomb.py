"""Block Gauss-Seidel with Signorini's and Coulomb's laws. Theory, symbols and checks: docs/theory/coulomb.md.

Rows i < R are static, rows R + 3 c .. R + 3 c + 2 the normal and the two tangents of contact c. With the free gaps g,
the compliances C and the change of the multipliers d, the gaps are g + W d + C multiplier.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import wide
from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.rows import anderson, coulomb_lanes, coulomb_newton

CURVE_STEPS = 2  # Newton steps on the friction multiplier of a contact, each time it is visited
CURVE_LIMIT = 1.0e6  # largest friction multiplier, relative to the trace of the tangential block
PROXIMAL = 1.0e-4  # proximal term of the tangential block, relative to its trace
STALL = 20  # sweeps after which a world is asked what they brought
STALLED = 0.9  # of the least correction before them, above which they brought nothing
NEAR = 10.0  # tolerances within which a world that has stalled rests
ROUNDS = 5  # times in a row that a world may have stalled, until sweeps go on without guesses between them


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Gauss-Seidel kernels for one scalar type."""
    S = variant.S
    real = variant.real
    mul, fma, div, sqrt = variant.mul, variant.fma, variant.div, variant.sqrt
    module = variant.module("coulomb")
    above, is_any = anderson.comparison(variant)

    @wp.func
    def reciprocal(a: S):
        """1 / a; 0 where a is 0, so that a row that nothing can move keeps its multiplier."""
        return div(a, mul(a, a) + S(real(1.0e-36)))

    @wp.func
    def row_product(delassus: wp.array2d(dtype=S), change: wp.array2d(dtype=S), w: int, begin: int, count: int):
        """One row of W times the change."""
        s = S(real(0.0))
        for j in range(count):
            s = fma(delassus[w, begin + j], change[w, j], s)
        return s

    @wp.func
    def block_product(
        delassus: wp.array2d(dtype=S),
        change: wp.array2d(dtype=S),
        w: int,
        begin: int,
        order: int,
        rows: int,
        total: int,
    ):
        """Three rows of W times the change; nine sums, so that additions need not wait for each other."""
        a0 = S(real(0.0))
        a1 = S(real(0.0))
        a2 = S(real(0.0))
        for j in range(rows):
            d = change[w, j]
            a0 = fma(delassus[w, begin + j], d, a0)
            a1 = fma(delassus[w, begin + order + j], d, a1)
            a2 = fma(delassus[w, begin + 2 * order + j], d, a2)
        b0 = S(real(0.0))
        b1 = S(real(0.0))
        b2 = S(real(0.0))
        c0 = S(real(0.0))
        c1 = S(real(0.0))
        c2 = S(real(0.0))
        for j in range(rows, total, 3):
            d0 = change[w, j]
            d1 = change[w, j + 1]
            d2 = change[w, j + 2]
            p = begin + j
            a0 = fma(delassus[w, p], d0, a0)
            b0 = fma(delassus[w, p + 1], d1, b0)
            c0 = fma(delassus[w, p + 2], d2, c0)
            p += order
            a1 = fma(delassus[w, p], d0, a1)
            b1 = fma(delassus[w, p + 1], d1, b1)
            c1 = fma(delassus[w, p + 2], d2, c1)
            p += order
            a2 = fma(delassus[w, p], d0, a2)
            b2 = fma(delassus[w, p + 1], d1, b2)
            c2 = fma(delassus[w, p + 2], d2, c2)
        return a0 + b0 + c0, a1 + b1 + c1, a2 + b2 + c2

    if wide.is_wide(variant):

        @wp.func
        def row_product(delassus: wp.array2d(dtype=S), change: wp.array2d(dtype=S), w: int, begin: int, count: int):
            """One row of W times the change."""
            return wide.one_row(delassus, change, w, begin, count)

        @wp.func
        def block_product(
            delassus: wp.array2d(dtype=S),
            change: wp.array2d(dtype=S),
            w: int,
            begin: int,
            order: int,
            rows: int,
            total: int,
        ):
            """Three rows of W times the change."""
            s = wide.three_rows(delassus, change, w, begin, order, total)
            return s[0], s[1], s[2]

    @wp.func
    def friction(w11: S, w12: S, w22: S, b1: S, b2: S, radius: S, curve: S):
        """Minimiser of t' W t / 2 + b' t on a disc, and its multiplier; the trace of W is about 1.

        t = -(W + curve)^-1 b with curve >= 0 and |t| <= radius, one of them an equality; Newton's method on
        1 / |t| = 1 / radius goes on from the last ``curve``.
        """
        tiny = S(real(1.0e-30))
        a1 = mul(w22, b1) - mul(w12, b2)
        a2 = mul(w11, b2) - mul(w12, b1)
        determinant = mul(w11, w22) - mul(w12, w12)
        trace = w11 + w22
        for _ in range(wp.static(CURVE_STEPS)):
            q = div(S(real(1.0)), determinant + mul(curve, trace + curve))
            t1 = -mul(a1 + mul(curve, b1), q)
            t2 = -mul(a2 + mul(curve, b2), q)
            square = mul(t1, t1) + mul(t2, t2)
            length = sqrt(square)
            bound = wp.max(radius, length * real(1.0e-3)) + tiny
            slope = mul(
                mul(w22 + curve, mul(t1, t1)) + mul(w11 + curve, mul(t2, t2)) - mul(w12, mul(t1, t2)) * real(2.0), q
            )
            curve += mul(div(length, bound) - S(real(1.0)), div(square, slope + tiny))
            curve = wp.min(wp.max(curve, S(real(0.0))), S(real(wp.static(CURVE_LIMIT))))
        q = div(S(real(1.0)), determinant + mul(curve, trace + curve))
        t1 = -mul(a1 + mul(curve, b1), q)
        t2 = -mul(a2 + mul(curve, b2), q)
        length = sqrt(mul(t1, t1) + mul(t2, t2))
        shrink = wp.min(div(radius, wp.max(length, tiny)), S(real(1.0)))
        return mul(t1, shrink), mul(t2, shrink), curve

    if variant.world_fastest:  # sweeps on a GPU are those of ``coulomb_warp``
        return SimpleNamespace(reciprocal=reciprocal, friction=friction)

    @wp.func
    def tangent_solution(w11: S, w12: S, w22: S, g1: S, g2: S, old1: S, old2: S, radius: S, curve: S):
        """New tangential forces of a contact with gaps g at the forces ``old``, and their multiplier."""
        unit = reciprocal(w11 + w22)
        a11 = mul(w11, unit) + S(real(wp.static(PROXIMAL)))
        a22 = mul(w22, unit) + S(real(wp.static(PROXIMAL)))
        a12 = mul(w12, unit)
        b1 = mul(g1, unit) - mul(a11, old1) - mul(a12, old2)
        b2 = mul(g2, unit) - mul(a12, old1) - mul(a22, old2)
        return friction(a11, a12, a22, b1, b2, radius, curve)

    @wp.func
    def solve_row(
        delassus: wp.array2d(dtype=S),
        gap: wp.array2d(dtype=S),
        compliance: wp.array2d(dtype=S),
        lower: wp.array2d(dtype=S),
        upper: wp.array2d(dtype=S),
        floor: wp.array2d(dtype=S),
        ceiling: wp.array2d(dtype=S),
        multiplier: wp.array2d(dtype=S),
        change: wp.array2d(dtype=S),
        w: int,
        order: int,
        total: int,
        i: int,
        active: S,
    ):
        """Bring one static row to its law; returns the correction [m] that this took."""
        soft = compliance[w, i]
        hard = delassus[w, i * order + i]
        old = multiplier[w, i]
        g = gap[w, i] + row_product(delassus, change, w, i * order, total)
        law = wp.min(wp.max(old - mul(g + mul(soft, old), reciprocal(hard + soft)), lower[w, i]), upper[w, i])
        unit = reciprocal(hard)
        new = wp.min(wp.max(law, old + mul(floor[w, i] - g, unit)), old + mul(ceiling[w, i] - g, unit))
        is_stopped = above(wp.max(new - law, law - new), real(0.0))
        new = mul(new, active) + mul(old, S(real(1.0)) - active)
        step = new - old
        multiplier[w, i] = new
        change[w, i] += step
        return mul(wp.max(step, -step), hard + mul(soft, S(real(1.0)) - is_stopped))

    @wp.func
    def solve_contact(
        delassus: wp.array2d(dtype=S),
        gap: wp.array2d(dtype=S),
        mu: wp.array2d(dtype=S),
        compliance: wp.array2d(dtype=S),
        multiplier: wp.array2d(dtype=S),
        change: wp.array2d(dtype=S),
        curve: wp.array2d(dtype=S),
        w: int,
        order: int,
        rows: int,
        total: int,
        contact: int,
        active: S,
    ):
        """Bring one contact to Signorini's and then to Coulomb's law; returns the correction [m] that this took."""
        i = rows + 3 * contact
        corner = i * order + i
        s0, s1, s2 = block_product(delassus, change, w, i * order, order, rows, total)
        held = S(real(1.0)) - active
        m = 3 * contact
        old0 = multiplier[w, m]
        old1 = multiplier[w, m + 1]
        old2 = multiplier[w, m + 2]
        soft = compliance[w, contact]
        diagonal = delassus[w, corner] + soft
        g = gap[w, i] + s0 + mul(soft, old0)
        new0 = wp.max(old0 - mul(g, reciprocal(diagonal)), S(real(0.0)))
        step0 = new0 - old0
        g1 = gap[w, i + 1] + s1 + mul(delassus[w, corner + order], step0)
        g2 = gap[w, i + 2] + s2 + mul(delassus[w, corner + 2 * order], step0)
        radius = mul(mu[w, contact], new0)
        w11 = delassus[w, corner + order + 1]
        w12 = delassus[w, corner + 2 * order + 1]
        w22 = delassus[w, corner + 2 * order + 2]
        new1, new2, bend = tangent_solution(w11, w12, w22, g1, g2, old1, old2, radius, curve[w, contact])
        new0 = mul(new0, active) + mul(old0, held)
        new1 = mul(new1, active) + mul(old1, held)
        new2 = mul(new2, active) + mul(old2, held)
        curve[w, contact] = mul(bend, active) + mul(curve[w, contact], held)
        step0 = new0 - old0
        step1 = new1 - old1
        step2 = new2 - old2
        multiplier[w, m] = new0
        multiplier[w, m + 1] = new1
        multiplier[w, m + 2] = new2
        change[w, i] += step0
        change[w, i + 1] += step1
        change[w, i + 2] += step2
        slide = wp.max(wp.max(step1, -step1), wp.max(step2, -step2))
        return wp.max(mul(wp.max(step0, -step0), diagonal), mul(slide, w11 + w22))

    if variant.lanes > 1:
        solve_contact = coulomb_lanes.contact_law(CURVE_STEPS, CURVE_LIMIT, PROXIMAL)

    acceleration = anderson.functions(variant)
    forget, accelerate = acceleration.forget, acceleration.accelerate
    lead = coulomb_newton.lead(variant, anderson.SUMS, anderson.VECTORS)

    @wp.kernel(module=module, enable_backward=False)
    def gauss_seidel(
        # Model
        bounded_row: wp.array(dtype=wp.int32),
        rows: int,
        order: int,
        sweeps: int,
        tolerance: real,
        extent: real,
        # Workspace in
        pack_count_in: wp.array2d(dtype=wp.int32),
        delassus_in: wp.array2d(dtype=S),
        gap_in: wp.array2d(dtype=S),
        compliance_in: wp.array2d(dtype=S),
        lower_in: wp.array2d(dtype=S),
        upper_in: wp.array2d(dtype=S),
        floor_in: wp.array2d(dtype=S),
        ceiling_in: wp.array2d(dtype=S),
        mu_in: wp.array2d(dtype=S),
        softness_in: wp.array2d(dtype=S),
        # Workspace out
        multiplier_out: wp.array2d(dtype=S),
        force_out: wp.array2d(dtype=S),
        change_out: wp.array2d(dtype=S),
        curve_out: wp.array2d(dtype=S),
        history_out: wp.array2d(dtype=S),
        gram_out: wp.array2d(dtype=S),
        residual_out: wp.array2d(dtype=S),
    ):
        """Accelerated sweeps over bounded static rows (``multiplier``) and contacts (``force``).

        A world rests once a sweep corrects no gap by more than the tolerance [m], or where some sweeps have not brought
        a correction near it down; the others of its pack go on. Where guesses between sweeps lead round and round far
        from rest, plain sweeps take over.
        """
        w = wp.tid()
        count = pack_count_in[w, 0]
        total = rows + 3 * count
        for i in range(total):
            change_out[w, i] = S(real(0.0))
        for contact in range(count):
            curve_out[w, contact] = S(real(0.0))
        forget(history_out, gram_out, w, order, total)
        best = S(real(1.0e30))
        active = S(real(1.0))
        last = S(real(0.0))
        mark = S(real(1.0e30))
        lowest = S(real(1.0e30))
        rounds = S(real(0.0))
        guesses = S(real(1.0))
        for sweep in range(sweeps):
            if is_any(active):
                for i in range(total):
                    history_out[w, i] = change_out[w, i]
                worst = S(real(0.0))
                for k in range(bounded_row.shape[0]):
                    moved = solve_row(
                        delassus_in,
                        gap_in,
                        compliance_in,
                        lower_in,
                        upper_in,
                        floor_in,
                        ceiling_in,
                        multiplier_out,
                        change_out,
                        w,
                        order,
                        total,
                        bounded_row[k],
                        active,
                    )
                    worst = wp.max(worst, moved)
                for contact in range(count):
                    moved = solve_contact(
                        delassus_in,
                        gap_in,
                        mu_in,
                        softness_in,
                        force_out,
                        change_out,
                        curve_out,
                        w,
                        order,
                        rows,
                        total,
                        contact,
                        active,
                    )
                    worst = wp.max(worst, moved)
                last = mul(worst, active) + mul(last, S(real(1.0)) - active)
                active = mul(active, above(worst, tolerance))
                lowest = wp.min(lowest, worst)
                if sweep % wp.static(STALL) == wp.static(STALL - 1):
                    is_stalled = above(lowest - mark * real(wp.static(STALLED)), real(0.0))
                    is_far = above(worst, tolerance * real(wp.static(NEAR)))
                    active = mul(active, wp.max(S(real(1.0)) - is_stalled, is_far))
                    mark = lowest
                    rounds = mul(rounds + is_stalled, is_stalled)
                    guesses = mul(guesses, S(real(1.0)) - above(rounds, real(wp.static(ROUNDS - 0.5))))
                if sweep + 1 < sweeps and is_any(mul(active, guesses)):
                    led = lead(
                        delassus_in,
                        gap_in,
                        compliance_in,
                        lower_in,
                        upper_in,
                        floor_in,
                        ceiling_in,
                        mu_in,
                        softness_in,
                        bounded_row,
                        multiplier_out,
                        force_out,
                        change_out,
                        history_out,
                        gram_out,
                        w,
                        rows,
                        order,
                        count,
                        sweep + 2 >= sweeps,
                        extent,
                        mul(active, guesses),
                    )
                    own = mul(mul(active, guesses), S(real(1.0)) - led)
                    if is_any(own):
                        best = accelerate(
                            delassus_in,
                            change_out,
                            history_out,
                            gram_out,
                            w,
                            order,
                            total,
                            rows,
                            multiplier_out,
                            force_out,
                            sweep,
                            best,
                            own,
                            sweep + 2 >= sweeps,
                        )
        residual_out[w, 0] = last

    return SimpleNamespace(gauss_seidel=gauss_seidel, reciprocal=reciprocal, friction=friction)
