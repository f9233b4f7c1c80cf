"""The Gauss-Seidel of ``coulomb`` on a GPU: 32 threads of a warp share the unknowns of one world.

Each thread owns some static rows and contacts: it keeps their gaps, multipliers and changes in registers. A visited
contact is solved by its owner, which tells the others its step; each then moves the gaps of what it owns by that
column of the matrix, so that nothing is summed along a row. Contacts that are open and stay so are passed over
together. Sums over all unknowns, which the acceleration needs, are taken in a fixed order: results repeat to the bit.
A sweep is a chain of visits, each of which waits for a column of the matrix; so the lower triangle of a world with few
contacts is kept in shared memory, and worlds are told apart by their contacts (``coulomb_tiers``).
Theory: docs/theory/coulomb.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.rows import coulomb_warp_newton, warp_share, warp_visits
from softwarp.kernels.rows.anderson import BEYOND, DAMPING, LONGEST, MEMORY, RESTART
from softwarp.kernels.rows.coulomb import NEAR, STALL, STALLED
from softwarp.kernels.rows.coulomb_newton import AGAIN, REST
from softwarp.kernels.rows.coulomb_tiers import WIDTH
from softwarp.kernels.rows.coulomb_warp_newton import GOES, LARGE, RESTS

BLOCK = 128  # threads of a block; worlds in it do not wait for each other
FEW_WORLDS = 512  # up to which a world has a block, and so a multiprocessor's cache, to itself
ROOMY = 5  # contacts of a thread up to which it keeps what it knows of them in registers
NEAR_BLOCKS = 1  # of one world each, likewise
BLOCKS = 4  # at once on a multiprocessor, which bounds the registers of a thread


@cache
def kernels(
    variant: Variant, own_rows: int, own_contacts: int, near_rows: int, near_unknowns: int = 0
) -> SimpleNamespace:
    """Gauss-Seidel of the ``cuda`` variant for one scalar type.

    Args:
        variant: Scalar type.
        own_rows: Static rows that a thread owns at most: row r belongs to thread r mod 32.
        own_contacts: Contacts that a thread owns at most, likewise.
        near_rows: Rows of W that fit into shared memory, which one world then has to itself; 0 for none.
        near_unknowns: Unknowns up to which the system of Newton's method lies there too; likewise.
    """
    real = variant.real
    module = variant.module(f"coulomb_warp_{own_rows}_{own_contacts}_{near_rows}_{near_unknowns}")
    module.options["fast_math"] = True  # divisions of the contact laws to 2 ulp; a quarter less time
    if own_contacts > ROOMY:  # too many for registers in any case
        module.options["max_unroll"] = 3
    rounding = 1.0e-10 if real is wp.float64 else 1.0e-6  # least relative pivot of the acceleration
    share = warp_share.functions(variant, own_rows, own_contacts, near_rows)
    Owned, exchange, warp_sum, warp_max = share.Owned, share.exchange, share.warp_sum, share.warp_max
    load, store, bring_near = share.load, share.store, share.bring_near
    moved_gaps = share.moved_gaps
    follow = coulomb_warp_newton.functions(variant, own_rows, own_contacts, near_rows, near_unknowns).follow
    visits = warp_visits.functions(variant, own_rows, own_contacts, near_rows)
    visit_rows, visit_contacts = visits.visit_rows, visits.visit_contacts
    is_alone, at_once = max(near_rows, near_unknowns) > 0, BLOCKS if own_contacts <= BLOCKS else BLOCKS // 2
    bounds = (WIDTH, NEAR_BLOCKS) if is_alone else (BLOCK, at_once)
    owned = own_rows + 3 * own_contacts
    PerContact = wp.types.vector(own_contacts, real)
    Sums = wp.types.vector(2 * MEMORY, real)
    Memory = wp.types.vector(MEMORY, real)
    Gram = wp.types.matrix((MEMORY, MEMORY), real)

    @wp.func
    def share_out(values: Sums, offset: int):
        """One step of ``warp_sum`` for several values, whose exchanges do not wait for each other."""
        others = Sums()
        for k in range(wp.static(2 * MEMORY)):
            others[k] = exchange(values[k], offset)
        return values + others

    @wp.func
    def diagonal_of(
        delassus: wp.array2d(dtype=real), w: int, order: int, column: int, thread: int, rows: int, count: int
    ):
        """The thread's entries on the diagonal of W; with ``column`` 1 and 2, right of it."""
        share = Owned()
        for k in range(wp.static(own_rows)):
            row = thread + wp.static(WIDTH) * k
            if row < rows:
                share[k] = delassus[w, row * order + row]
        for k in range(wp.static(own_contacts)):
            contact = thread + wp.static(WIDTH) * k
            if contact < count:
                i = rows + 3 * contact
                for axis in range(3):
                    if axis + column < 3:
                        share[wp.static(own_rows) + 3 * k + axis] = delassus[w, (i + axis) * order + i + axis + column]
        return share

    @wp.func
    def per_contact(source: wp.array2d(dtype=real), w: int, thread: int, count: int):
        """The thread's share of an array with one entry per contact."""
        share = PerContact()
        for k in range(wp.static(own_contacts)):
            contact = thread + wp.static(WIDTH) * k
            if contact < count:
                share[k] = source[w, contact]
        return share

    @wp.func
    def loaded_values(
        multiplier: wp.array2d(dtype=real), force: wp.array2d(dtype=real), w: int, thread: int, rows: int, count: int
    ):
        """The thread's multipliers of static rows and of contacts."""
        value = Owned()
        for k in range(wp.static(own_rows)):
            row = thread + wp.static(WIDTH) * k
            if row < rows:
                value[k] = multiplier[w, row]
        for k in range(wp.static(own_contacts)):
            contact = thread + wp.static(WIDTH) * k
            if contact < count:
                for axis in range(3):
                    value[wp.static(own_rows) + 3 * k + axis] = force[w, 3 * contact + axis]
        return value

    @wp.func
    def store_values(
        multiplier: wp.array2d(dtype=real),
        force: wp.array2d(dtype=real),
        value: Owned,
        w: int,
        thread: int,
        rows: int,
        count: int,
    ):
        """The inverse of ``loaded_values``."""
        for k in range(wp.static(own_rows)):
            row = thread + wp.static(WIDTH) * k
            if row < rows:
                multiplier[w, row] = value[k]
        for k in range(wp.static(own_contacts)):
            contact = thread + wp.static(WIDTH) * k
            if contact < count:
                for axis in range(3):
                    force[w, 3 * contact + axis] = value[wp.static(own_rows) + 3 * k + axis]

    @wp.func
    def empty_history(history: wp.array2d(dtype=real), w: int, order: int, thread: int, rows: int, count: int):
        """Empty the memory of the acceleration."""
        nothing = Owned()
        for k in range(wp.static(2 * MEMORY)):
            store(history, nothing, w, k * order, thread, rows, count)

    @wp.func
    def updated(gram: Gram, sums: Sums, slot: int):
        """The small matrix with the products of the newest differences."""
        result = Gram()
        for i in range(wp.static(MEMORY)):
            for j in range(wp.static(MEMORY)):
                result[i, j] = wp.where(i == slot, sums[j], wp.where(j == slot, sums[i], gram[i, j]))
        return result

    @wp.func
    def solve_gram(gram: Gram, right: Memory):
        """Least squares: the combination of differences that comes closest to the last correction."""
        factor = Gram()
        inverse = Memory()
        half = Memory()
        share = Memory()
        for j in range(wp.static(MEMORY)):
            pivot = gram[j, j]
            least = pivot * real(wp.static(rounding)) + real(1.0e-30)
            total = right[j]
            for k in range(j):
                pivot -= factor[j, k] * factor[j, k]
                total -= factor[j, k] * half[k]
            inverse[j] = real(1.0) / wp.sqrt(wp.max(pivot, least))
            half[j] = total * inverse[j]
            for i in range(j + 1, wp.static(MEMORY)):
                entry = gram[i, j]
                for k in range(j):
                    entry -= factor[i, k] * factor[j, k]
                factor[i, j] = entry * inverse[j]
        for step in range(wp.static(MEMORY)):
            j = wp.static(MEMORY - 1) - step
            total = half[j]
            for k in range(j + 1, wp.static(MEMORY)):
                total -= factor[k, j] * share[k]
            share[j] = total * inverse[j]
        return share

    @wp.func
    def products(
        history: wp.array2d(dtype=real),
        weight: Owned,
        moved: Owned,
        end: Owned,
        last: Owned,
        w: int,
        thread: int,
        order: int,
        rows: int,
        count: int,
    ):
        """Products of the remembered differences with the newest, and with the last correction."""
        sums = Sums()
        weighted = wp.cw_mul(moved, weight)
        weighted_end = wp.cw_mul(end, weight) * real(wp.static(DAMPING))
        weighted_last = wp.cw_mul(last, weight)
        for k in range(wp.static(MEMORY)):
            f = load(history, w, k * order, thread, rows, count)
            e = load(history, w, (wp.static(MEMORY) + k) * order, thread, rows, count)
            sums[k] = wp.dot(f, weighted) + wp.dot(e, weighted_end)
            sums[wp.static(MEMORY) + k] = wp.dot(f, weighted_last)
        sums = share_out(sums, 16)
        sums = share_out(sums, 8)
        sums = share_out(sums, 4)
        sums = share_out(sums, 2)
        return share_out(sums, 1)

    @wp.func
    def extrapolation(
        history: wp.array2d(dtype=real),
        parts: Memory,
        weight: Owned,
        last: Owned,
        w: int,
        thread: int,
        order: int,
        rows: int,
        count: int,
    ):
        """The way to where the remembered sweeps, linearly combined, would have had no correction."""
        step = Owned()
        for k in range(wp.static(MEMORY)):
            step -= load(history, w, (wp.static(MEMORY) + k) * order, thread, rows, count) * parts[k]
        for i in range(wp.static(owned)):
            step[i] = wp.clamp(step[i], real(wp.static(-BEYOND)), real(wp.static(BEYOND)))
        way = warp_sum(wp.dot(wp.cw_mul(step, step), weight)) + real(1.0e-30)
        correction = warp_sum(wp.dot(wp.cw_mul(last, last), weight))
        return step * wp.min(wp.sqrt(correction * real(wp.static(LONGEST * LONGEST)) / way), real(1.0))

    @wp.func
    def remember_and_guess(
        history: wp.array2d(dtype=real),
        weight: Owned,
        value: Owned,
        change: Owned,
        correction: Owned,
        square: real,
        last: Owned,
        last_end: Owned,
        gram: Gram,
        best: real,
        is_fresh: bool,
        sweep: int,
        is_last: bool,
        w: int,
        thread: int,
        order: int,
        rows: int,
        count: int,
    ):
        """Note what a sweep did, take its guess back where that was bad, and guess where the next one starts.

        Returns multipliers, their change, the sweep's correction and end, and what is remembered.
        """
        f = correction
        keep = wp.where(is_fresh, real(0.0), real(1.0))
        if square > best * real(wp.static(RESTART)):
            empty_history(history, w, order, thread, rows, count)
            gram = Gram()
            keep = real(0.0)
            f = last
            value += last_end - change
            change = last_end
        best = wp.where(keep > real(0.0), wp.min(best, square), real(1.0e30))  # no guess, no return
        slot = sweep % wp.static(MEMORY)
        turn = (f - last) * keep
        end = (change - last_end) * keep
        store(history, turn, w, slot * order, thread, rows, count)
        store(history, end, w, (wp.static(MEMORY) + slot) * order, thread, rows, count)
        last_end = change
        sums = products(history, weight, turn, end, f, w, thread, order, rows, count)
        gram = updated(gram, sums, slot)
        if not is_last:  # the last sweep starts from one that is known to be good
            right = Memory()
            for i in range(wp.static(MEMORY)):
                right[i] = sums[wp.static(MEMORY) + i]
            parts = solve_gram(gram, right)
            guess = extrapolation(history, parts, weight, f, w, thread, order, rows, count)
            change += guess
            value += guess
        return value, change, f, last_end, gram, best

    @wp.func
    def solve_world(
        bounded_row: wp.array(dtype=wp.int32),
        rows: int,
        order: int,
        sweeps: int,
        tolerance: real,
        extent: real,
        stride: int,
        count: int,
        delassus: wp.array2d(dtype=real),
        free_gap: wp.array2d(dtype=real),
        compliance: wp.array2d(dtype=real),
        lower: wp.array2d(dtype=real),
        upper: wp.array2d(dtype=real),
        floor: wp.array2d(dtype=real),
        ceiling: wp.array2d(dtype=real),
        friction: wp.array2d(dtype=real),
        softness: wp.array2d(dtype=real),
        row_force: wp.array2d(dtype=real),
        contact_force: wp.array2d(dtype=real),
        moved: wp.array2d(dtype=real),
        history: wp.array2d(dtype=real),
        system: wp.array2d(dtype=real),
        residual: wp.array2d(dtype=real),
        w: int,
        thread: int,
    ):
        """Sweeps over the rows and contacts of one world; arrays are those of ``gauss_seidel``."""
        weight = diagonal_of(delassus, w, order, 0, thread, rows, count)
        beside = diagonal_of(delassus, w, order, 1, thread, rows, count)
        corner = diagonal_of(delassus, w, order, 2, thread, rows, count)
        mu = per_contact(friction, w, thread, count)
        soft = per_contact(softness, w, thread, count)
        curve = PerContact()
        value = loaded_values(row_force, contact_force, w, thread, rows, count)
        gap = load(free_gap, w, 0, thread, rows, count)
        change = Owned()
        last = Owned()  # correction of the last sweep
        last_end = Owned()  # change at its end
        gram = Gram()
        best = real(1.0e30)
        leads = bool(True)  # Newton's method does, not the acceleration
        waits = bool(False)  # for a sweep that judges the way it has gone
        is_fresh = bool(True)  # the acceleration remembers nothing
        tries = int(0)
        rest = int(0)  # sweeps until Newton's method leads again
        least = real(1.0e30)  # squared correction since it leads
        worst = real(0.0)
        is_active = bool(True)
        mark = real(1.0e30)
        lowest = real(1.0e30)
        for sweep in range(sweeps):
            if is_active:
                start = change
                value, change, gap, worst = visit_rows(
                    bounded_row,
                    delassus,
                    compliance,
                    lower,
                    upper,
                    floor,
                    ceiling,
                    weight,
                    value,
                    change,
                    gap,
                    w,
                    thread,
                    order,
                    rows,
                    count,
                )
                value, change, gap, curve, worst = visit_contacts(
                    delassus,
                    weight,
                    beside,
                    corner,
                    soft,
                    mu,
                    value,
                    change,
                    gap,
                    curve,
                    worst,
                    w,
                    thread,
                    order,
                    rows,
                    count,
                )
                worst = warp_max(worst)
                is_active = worst > tolerance
                lowest = wp.min(lowest, worst)
                if sweep % wp.static(STALL) == wp.static(STALL - 1):
                    if lowest > mark * real(wp.static(STALLED)) and worst <= tolerance * real(wp.static(NEAR)):
                        is_active = False
                    mark = lowest
                if is_active and sweep + 1 < sweeps:
                    f = change - start
                    square = warp_sum(wp.dot(wp.cw_mul(f, f), weight))
                    is_led = bool(False)
                    rest -= 1
                    if rest == 0:
                        leads = True
                        waits = False
                        tries = int(0)
                        least = real(1.0e30)
                    if leads:  # Newton's method: judge the last way and go the next one
                        before = last_end
                        value, change, last_end, least, tries, verdict = follow(
                            system,
                            delassus,
                            bounded_row,
                            compliance,
                            lower,
                            upper,
                            floor,
                            ceiling,
                            weight,
                            soft,
                            mu,
                            value,
                            change,
                            last_end,
                            gap,
                            square,
                            least,
                            waits,
                            tries,
                            sweep + 2 >= sweeps,
                            extent,
                            w,
                            thread,
                            order,
                            rows,
                            count,
                            stride,
                        )
                        is_led = verdict != wp.static(LARGE)
                        waits = verdict == wp.static(GOES)
                        if verdict > wp.static(RESTS):
                            leads = False
                            if is_led or tries > 1:
                                is_fresh = True
                            else:  # too many rows: the acceleration goes on as if not asked
                                last_end = before
                            rest = wp.where(is_led, wp.static(REST), wp.static(AGAIN))
                    if not is_led:
                        if is_fresh:
                            empty_history(history, w, order, thread, rows, count)
                            gram = Gram()
                            best = real(1.0e30)
                        value, change, last, last_end, gram, best = remember_and_guess(
                            history,
                            weight,
                            value,
                            change,
                            f,
                            square,
                            last,
                            last_end,
                            gram,
                            best,
                            is_fresh,
                            sweep,
                            sweep + 2 >= sweeps,
                            w,
                            thread,
                            order,
                            rows,
                            count,
                        )
                        is_fresh = False
                    gap = load(free_gap, w, 0, thread, rows, count)
                    gap = moved_gaps(delassus, gap, change, w, thread, order, rows, count)
        store(moved, change, w, 0, thread, rows, count)
        store_values(row_force, contact_force, value, w, thread, rows, count)
        if thread == 0:
            residual[w, 0] = worst

    @wp.kernel(module=module, enable_backward=False, launch_bounds=bounds)
    def gauss_seidel(
        # Model
        bounded_row: wp.array(dtype=wp.int32),
        rows: int,
        order: int,
        above: int,
        most: int,
        sweeps: int,
        tolerance: real,
        extent: real,
        stride: int,
        # Workspace in
        skipped_in: wp.array2d(dtype=wp.int32),
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
        multiplier_out: wp.array2d(dtype=real),
        force_out: wp.array2d(dtype=real),
        change_out: wp.array2d(dtype=real),
        history_out: wp.array2d(dtype=real),
        system_out: wp.array2d(dtype=real),
        residual_out: wp.array2d(dtype=real),
    ):
        """Accelerated sweeps over bounded static rows (``multiplier``) and contacts (``force``) of one world.

        Worlds whose contacts are not more than ``above``, or more than ``most``, are left to other kernels, and
        ``skipped`` ones to none.
        """
        w, thread = wp.tid()
        count = pack_count_in[w, 0]
        if count <= above or count > most or skipped_in[w, 0] != 0:
            return
        if wp.static(near_rows > 0):
            bring_near(delassus_in, w, order, thread, rows + 3 * count)
        solve_world(
            bounded_row,
            rows,
            order,
            sweeps,
            tolerance,
            extent,
            stride,
            count,
            delassus_in,
            gap_in,
            compliance_in,
            lower_in,
            upper_in,
            floor_in,
            ceiling_in,
            mu_in,
            softness_in,
            multiplier_out,
            force_out,
            change_out,
            history_out,
            system_out,
            residual_out,
            w,
            thread,
        )

    return SimpleNamespace(gauss_seidel=gauss_seidel)
