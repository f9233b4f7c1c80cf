"""Newton's method on the laws of a world's rows and contacts on a GPU: ``coulomb_newton`` for the threads of a warp.

Every thread knows the laws, forces and gaps of what it owns. The system of a world lies in shared memory, or in the
device's where it is too large for that; threads fill the columns of what they own and then eliminate, a column each.
Theory: docs/theory/coulomb.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.rows import warp_share, warp_system
from softwarp.kernels.rows.coulomb_newton import DAMPING, EVENTS, GROWN, HEAVY, LONGEST, ON_CONE, PIVOT
from softwarp.kernels.rows.coulomb_tiers import WIDTH
from softwarp.kernels.rows.warp_share import (
    first_thread,
    lowest_bit,
    meet,
    places,
    threads_with,
    told_number,
    without_lowest,
)

TRIES = 10  # ways that are gone before a world goes on with the acceleration

NONE, FIXED, LOW, HIGH, FREE, OPEN, BARE, STICK, SLIDE = range(9)  # no law that holds; those of rows, then of contacts
GOES, RESTS, LOST, LARGE = range(4)  # what came of it: a way, nothing to solve, no solution, too many rows


@cache
def functions(
    variant: Variant, own_rows: int, own_contacts: int, near_rows: int, near_unknowns: int
) -> SimpleNamespace:
    """``follow`` for one scalar type of the ``cuda`` variant; the other arguments are those of ``warp_share``.

    Systems of up to ``near_unknowns`` lie in shared memory, which one world then has to itself.
    """
    real = variant.real
    share = warp_share.functions(variant, own_rows, own_contacts, near_rows)
    Owned, told, column, moved_gaps = share.Owned, share.told, share.column, share.moved_gaps
    warp_sum, warp_max = share.warp_sum, share.warp_max
    PerContact = wp.types.vector(own_contacts, real)
    PerRow = wp.types.vector(max(own_rows, 1), real)
    Laws = wp.types.vector(max(own_rows, 1) + own_contacts, wp.int32)  # of rows, then of contacts
    first_contact = max(own_rows, 1)
    Numbers = Laws

    systems = warp_system.functions(variant, near_unknowns)
    system_of, put, got = systems.system_of, systems.put, systems.got

    @wp.func
    def held_rows(
        bounded_row: wp.array(dtype=wp.int32),
        compliance: wp.array2d(dtype=real),
        lower: wp.array2d(dtype=real),
        upper: wp.array2d(dtype=real),
        floor: wp.array2d(dtype=real),
        ceiling: wp.array2d(dtype=real),
        weight: Owned,
        value: Owned,
        gap: Owned,
        w: int,
        thread: int,
    ):
        """Laws of the thread's static rows: between bounds, at a stop, or none that holds with equality."""
        law = Laws()
        for item in range(bounded_row.shape[0]):
            row = bounded_row[item]
            for k in range(wp.static(own_rows)):
                if row == thread + wp.static(WIDTH) * k and weight[k] > real(0.0):
                    soft = compliance[w, row]
                    wanted = value[k] - (gap[k] + soft * value[k]) / (weight[k] + soft)
                    bound = wp.clamp(wanted, lower[w, row], upper[w, row])
                    found = int(FREE)
                    if bound != wanted or wanted == lower[w, row] or wanted == upper[w, row]:
                        found = int(NONE)
                    if bound > value[k] + (ceiling[w, row] - gap[k]) / weight[k]:
                        found = int(HIGH)
                    if bound < value[k] + (floor[w, row] - gap[k]) / weight[k]:
                        found = int(LOW)
                    law[k] = found
        return law

    @wp.func
    def fill(
        system: wp.uint64,
        line: Owned,
        law: Laws,
        first: Numbers,
        mu: PerContact,
        n1: PerContact,
        n2: PerContact,
        begin: int,
    ):
        """Write what the thread owns of a line, which begins at ``begin`` and has one entry of W per row."""
        for k in range(wp.static(own_rows)):
            if law[k] > wp.static(FIXED):
                put(system, begin + first[k], line[k])
        for k in range(wp.static(own_contacts)):
            e = wp.static(own_rows) + 3 * k
            kind = law[wp.static(first_contact) + k]
            place = begin + first[wp.static(first_contact) + k]
            slides = kind == wp.static(SLIDE)
            pushed = line[e] + mu[k] * (n1[k] * line[e + 1] + n2[k] * line[e + 2])
            turned = n1[k] * line[e + 2] - n2[k] * line[e + 1]
            if kind > wp.static(OPEN):
                put(system, place, wp.where(slides, pushed, line[e]))
            if kind >= wp.static(STICK):
                put(system, place + 1, wp.where(slides, turned, line[e + 1]))
            if kind == wp.static(STICK):
                put(system, place + 2, line[e + 2])

    @wp.func
    def fill_all(
        system: wp.uint64,
        delassus: wp.array2d(dtype=real),
        law: Laws,
        first: Numbers,
        mu: PerContact,
        n1: PerContact,
        n2: PerContact,
        w: int,
        thread: int,
        order: int,
        rows: int,
        count: int,
        stride: int,
    ):
        """The matrix of the system, without right side."""
        for k in range(wp.static(own_rows)):
            owner = int(-1)
            is_left = bool(True)
            while is_left:
                owner = first_thread(law[k] > wp.static(FIXED) and thread > owner)
                is_left = owner >= 0
                if is_left:
                    begin = stride * told_number(first[k], owner)
                    line = column(delassus, w, order, owner + wp.static(WIDTH) * k, thread, rows, count)
                    fill(system, line, law, first, mu, n1, n2, begin)
        for k in range(wp.static(own_contacts)):
            left = threads_with(law[wp.static(first_contact) + k] > wp.static(OPEN))
            owner = lowest_bit(left)
            j = rows + 3 * (wp.max(owner, 0) + wp.static(WIDTH) * k)
            line0 = Owned()
            line1 = Owned()
            line2 = Owned()
            if owner >= 0:
                line0 = column(delassus, w, order, j, thread, rows, count)
                line1 = column(delassus, w, order, j + 1, thread, rows, count)
                line2 = column(delassus, w, order, j + 2, thread, rows, count)
            while owner >= 0:  # the columns of the next contact are loaded before those of this one are written
                left = without_lowest(left)
                following = lowest_bit(left)
                j = rows + 3 * (wp.max(following, owner) + wp.static(WIDTH) * k)
                next0 = column(delassus, w, order, j, thread, rows, count)
                next1 = column(delassus, w, order, j + 1, thread, rows, count)
                next2 = column(delassus, w, order, j + 2, thread, rows, count)
                kind = told_number(law[wp.static(first_contact) + k], owner)
                begin = stride * told_number(first[wp.static(first_contact) + k], owner)
                c1 = -told(n2[k], owner)
                c2 = told(n1[k], owner)
                fill(system, line0, law, first, mu, n1, n2, begin)
                if kind == wp.static(SLIDE):
                    fill(system, line1 * c1 + line2 * c2, law, first, mu, n1, n2, begin + stride)
                if kind == wp.static(STICK):
                    fill(system, line1, law, first, mu, n1, n2, begin + stride)
                    fill(system, line2, law, first, mu, n1, n2, begin + 2 * stride)
                line0 = next0
                line1 = next1
                line2 = next2
                owner = following

    @wp.func
    def complete(system: wp.uint64, right: real, extra: real, unknown: int, unknowns: int, stride: int):
        """Diagonal, right side and least pivot of one line."""
        begin = stride * unknown
        pivot = got(system, begin + unknown) * real(wp.static(1.0 + DAMPING)) + extra
        put(system, begin + unknown, pivot)
        put(system, begin + unknowns, right)
        put(system, begin + unknowns + 1, wp.abs(pivot) * real(wp.static(PIVOT)))

    @wp.func
    def lead_warp(
        system: wp.array2d(dtype=real),
        delassus: wp.array2d(dtype=real),
        bounded_row: wp.array(dtype=wp.int32),
        compliance: wp.array2d(dtype=real),
        lower: wp.array2d(dtype=real),
        upper: wp.array2d(dtype=real),
        floor: wp.array2d(dtype=real),
        ceiling: wp.array2d(dtype=real),
        weight: Owned,
        soft: PerContact,
        mu: PerContact,
        value: Owned,
        gap: Owned,
        square: real,
        extent: real,
        w: int,
        thread: int,
        order: int,
        rows: int,
        count: int,
        stride: int,
    ):
        """The way to where all laws that hold with equality are met; up to ``EVENTS`` times one ends on it.

        ``square`` is the squared correction of the sweep before. Returns the way and what came of it.
        """
        law = held_rows(bounded_row, compliance, lower, upper, floor, ceiling, weight, value, gap, w, thread)
        own = int(0)
        softness = PerRow()
        for k in range(wp.static(own_rows)):
            if law[k] != wp.static(NONE):
                own += 1
                softness[k] = compliance[w, thread + wp.static(WIDTH) * k]
        for k in range(wp.static(own_contacts)):
            e = wp.static(own_rows) + 3 * k
            if value[e] > real(0.0) and weight[e] > real(0.0):
                rubs = mu[k] > real(0.0) and weight[e + 1] + weight[e + 2] > real(0.0)
                law[wp.static(first_contact) + k] = wp.where(rubs, wp.static(STICK), wp.static(BARE))
                own += wp.where(rubs, 3, 1)
        size = int(warp_sum(real(own)))
        verdict = int(GOES)
        if size == 0:
            verdict = int(RESTS)
        if size > stride - 2:
            verdict = int(LARGE)
        start = value
        if verdict == wp.static(GOES):
            candidates = law
            slack = gap
            events = int(wp.static(EVENTS))
            for _ in range(events):
                # Unknowns, numbered along the rows of W, and directions of the contacts that slide
                first = Numbers()
                n1 = PerContact()
                n2 = PerContact()
                turn = PerContact()
                unknowns = int(0)
                for k in range(wp.static(own_rows)):
                    found = places(wp.where(law[k] > wp.static(FIXED), 1, 0), thread)
                    first[k] = unknowns + (found & 65535)
                    unknowns += found >> 16
                for k in range(wp.static(own_contacts)):
                    e = wp.static(own_rows) + 3 * k
                    kind = law[wp.static(first_contact) + k]
                    if kind >= wp.static(STICK):
                        length = wp.sqrt(value[e + 1] * value[e + 1] + value[e + 2] * value[e + 2])
                        if length >= mu[k] * value[e] * real(wp.static(1.0 - ON_CONE)):
                            kind = int(SLIDE)
                        if length == real(0.0):
                            kind = int(STICK)
                        law[wp.static(first_contact) + k] = kind
                        if kind == wp.static(SLIDE):
                            n1[k] = value[e + 1] / length
                            n2[k] = value[e + 2] / length
                            turn[k] = wp.abs(slack[e + 1] * n1[k] + slack[e + 2] * n2[k]) / length
                    wanted = wp.where(kind == wp.static(STICK), 3, wp.where(kind == wp.static(SLIDE), 2, 0))
                    found = places(wp.where(kind == wp.static(BARE), 1, wanted), thread)
                    first[wp.static(first_contact) + k] = unknowns + (found & 65535)
                    unknowns += found >> 16
                if unknowns == 0:
                    break

                lines = system_of(system, w, thread, unknowns, stride, False)
                pitch = wp.where(unknowns <= wp.static(near_unknowns), wp.static(near_unknowns + 2), stride)
                meet()
                fill_all(lines, delassus, law, first, mu, n1, n2, w, thread, order, rows, count, pitch)
                for k in range(wp.static(own_rows)):
                    if law[k] > wp.static(FIXED):
                        row = thread + wp.static(WIDTH) * k
                        give = softness[k]
                        stop = real(0.0)
                        if law[k] == wp.static(LOW):
                            stop = floor[w, row]
                            give = real(0.0)
                        if law[k] == wp.static(HIGH):
                            stop = ceiling[w, row]
                            give = real(0.0)
                        complete(lines, stop - slack[k] - give * value[k], give, first[k], unknowns, pitch)
                for k in range(wp.static(own_contacts)):
                    e = wp.static(own_rows) + 3 * k
                    kind = law[wp.static(first_contact) + k]
                    u = first[wp.static(first_contact) + k]
                    if kind > wp.static(OPEN):
                        complete(lines, -(slack[e] + soft[k] * value[e]), soft[k], u, unknowns, pitch)
                    if kind == wp.static(STICK):
                        complete(lines, -slack[e + 1], real(0.0), u + 1, unknowns, pitch)
                        complete(lines, -slack[e + 2], real(0.0), u + 2, unknowns, pitch)
                    if kind == wp.static(SLIDE):
                        slip = n2[k] * slack[e + 1] - n1[k] * slack[e + 2]
                        complete(lines, slip, turn[k], u + 1, unknowns, pitch)
                meet()
                if system_of(system, w, thread, unknowns, stride, True) != wp.uint64(0):
                    verdict = int(LOST)
                    break

                # The way, and the first law that ends on it
                step = Owned()
                share_gone = real(1.0)
                ends = int(-1)
                turned = int(FIXED)
                for k in range(wp.static(own_rows)):
                    if law[k] > wp.static(FIXED):
                        step[k] = got(lines, pitch * first[k] + unknowns)
                    if law[k] == wp.static(FREE) and step[k] != real(0.0):
                        row = thread + wp.static(WIDTH) * k
                        limit = (wp.where(step[k] > real(0.0), upper[w, row], lower[w, row]) - value[k]) / step[k]
                        if limit < share_gone:
                            share_gone = wp.max(limit, real(0.0))
                            ends = k
                            turned = int(FIXED)
                for k in range(wp.static(own_contacts)):
                    e = wp.static(own_rows) + 3 * k
                    kind = law[wp.static(first_contact) + k]
                    place = pitch * first[wp.static(first_contact) + k] + unknowns
                    if kind > wp.static(OPEN):
                        step[e] = got(lines, place)
                        if kind == wp.static(STICK):
                            step[e + 1] = got(lines, place + pitch)
                            step[e + 2] = got(lines, place + 2 * pitch)
                        if kind == wp.static(SLIDE):
                            across = got(lines, place + pitch)
                            step[e + 1] = mu[k] * n1[k] * step[e] - n2[k] * across
                            step[e + 2] = mu[k] * n2[k] * step[e] + n1[k] * across
                        if step[e] < real(0.0) and value[e] < -share_gone * step[e]:
                            share_gone = -value[e] / step[e]
                            ends = wp.static(first_contact) + k
                            turned = int(OPEN)
                        if kind == wp.static(STICK):
                            # |t|^2 - (mu n)^2 = a s^2 + 2 b s - c along the way s
                            r0 = mu[k] * value[e]
                            dr = mu[k] * step[e]
                            a = step[e + 1] * step[e + 1] + step[e + 2] * step[e + 2] - dr * dr
                            b = value[e + 1] * step[e + 1] + value[e + 2] * step[e + 2] - r0 * dr
                            c = r0 * r0 - value[e + 1] * value[e + 1] - value[e + 2] * value[e + 2]
                            root = b * b + a * c
                            under = real(0.0)
                            if root > real(0.0):
                                under = b + wp.sqrt(root)
                            if under > real(0.0) and c < share_gone * under:
                                share_gone = wp.where(c > real(0.0), c / under, real(0.0))
                                ends = wp.static(first_contact) + k
                                turned = int(SLIDE)
                gone = -warp_max(-share_gone)
                ender = first_thread(ends >= 0 and share_gone == gone)
                if thread != ender:
                    ends = int(-1)

                for k in range(wp.static(own_rows)):
                    old = value[k]
                    value[k] += gone * step[k]
                    if ends == k:
                        row = thread + wp.static(WIDTH) * k
                        value[k] = wp.where(step[k] > real(0.0), upper[w, row], lower[w, row])
                        law[k] = turned
                    step[k] = value[k] - old
                for k in range(wp.static(own_contacts)):
                    e = wp.static(own_rows) + 3 * k
                    if law[wp.static(first_contact) + k] > wp.static(OPEN):
                        press = value[e] + gone * step[e]
                        if ends == wp.static(first_contact) + k:
                            law[wp.static(first_contact) + k] = turned
                        if law[wp.static(first_contact) + k] == wp.static(OPEN) or press < real(0.0):
                            press = real(0.0)
                            law[wp.static(first_contact) + k] = int(OPEN)
                        step[e] = press - value[e]
                        value[e] = press
                        if candidates[wp.static(first_contact) + k] != wp.static(BARE):
                            t1 = value[e + 1] + gone * step[e + 1]
                            t2 = value[e + 2] + gone * step[e + 2]
                            length = wp.sqrt(t1 * t1 + t2 * t2)
                            shrink = real(1.0)
                            if length > mu[k] * press:
                                shrink = mu[k] * press / length
                            step[e + 1] = t1 * shrink - value[e + 1]
                            step[e + 2] = t2 * shrink - value[e + 2]
                            value[e + 1] = t1 * shrink
                            value[e + 2] = t2 * shrink
                if ender < 0:
                    break
                slack = moved_gaps(delassus, slack, step, w, thread, order, rows, count)

            # Forces that would carry what they act on out of the scene are no solution
            heaviest = real(0.0)
            for k in range(wp.static(own_rows)):
                if candidates[k] != wp.static(NONE):
                    heaviest = wp.max(heaviest, wp.abs(value[k]) * weight[k])
            for k in range(wp.static(own_contacts)):
                if candidates[wp.static(first_contact) + k] != wp.static(NONE):
                    e = wp.static(own_rows) + 3 * k
                    for axis in range(3):
                        heaviest = wp.max(heaviest, wp.abs(value[e + axis]) * weight[e + axis])
            if not (warp_max(heaviest) <= extent * real(wp.static(HEAVY))):
                verdict = int(LOST)
        way = value - start
        length = warp_sum(wp.dot(wp.cw_mul(way, way), weight))
        if length > square * real(wp.static(LONGEST * LONGEST)):
            way = way * (real(wp.static(LONGEST)) * wp.sqrt(square / length))
        return way, verdict

    @wp.func
    def follow(
        system: wp.array2d(dtype=real),
        delassus: wp.array2d(dtype=real),
        bounded_row: wp.array(dtype=wp.int32),
        compliance: wp.array2d(dtype=real),
        lower: wp.array2d(dtype=real),
        upper: wp.array2d(dtype=real),
        floor: wp.array2d(dtype=real),
        ceiling: wp.array2d(dtype=real),
        weight: Owned,
        soft: PerContact,
        mu: PerContact,
        value: Owned,
        change: Owned,
        last_end: Owned,
        gap: Owned,
        square: real,
        least: real,
        waits: bool,
        tries: int,
        is_last: bool,
        extent: real,
        w: int,
        thread: int,
        order: int,
        rows: int,
        count: int,
        stride: int,
    ):
        """Newton's method: judge the last way, if one ``waits`` for that, and go the next one."""
        verdict = int(RESTS)
        is_wrong = waits and not (square <= least * real(wp.static(GROWN)))
        if is_wrong:
            value += last_end - change
            change = last_end
        last_end = change
        if not is_last:
            if is_wrong or tries >= wp.static(TRIES):
                verdict = int(LOST)
            else:
                least = wp.min(least, square)
                tries += 1
                way, found = lead_warp(
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
                    gap,
                    square,
                    extent,
                    w,
                    thread,
                    order,
                    rows,
                    count,
                    stride,
                )
                verdict = found
                if found == wp.static(GOES):
                    change += way
                    value += way
        return value, change, last_end, least, tries, verdict

    return SimpleNamespace(follow=follow)
