"""Path following from the start state to static equilibrium, world by world. Theory: docs/theory/statics.md.

At the path parameter t the loads are short of (1 - t) times the imbalance of the start state, and the target of every
row lies at the fraction t between its start value and its command, as imposed tensions and pressures do: the start
state solves t = 0, the equilibrium sought is t = 1. Each world walks along this path by itself: predict, correct, and
go back to its last good point if that fails.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.step import newton

# Rows of the per-world control array; the first ones are shared with Newton's method in a step.
MERIT, IMBALANCE, FROZEN, BEST, STALL = newton.MERIT, newton.IMBALANCE, newton.FROZEN, newton.BEST, newton.STALL
PSEUDO_MASS, T, T_GOOD, STRIDE, CORRECTIONS, LAST, SPREAD, BAD, FRACTION, GOOD, BACK, LOADED, PREDICTED, STUCK, ROWS = (
    newton.ROWS + i for i in range(15)
)

CONTRACTION = 0.5  # from correction to correction, or on average since the prediction, that counts as converging
NEAR = 0.05  # of the step bound: corrections below it end the work at a point of the path
FAR = 20.0  # step bounds: a correction this long is taken for a failed one
KICK = 0.02  # of the step bound: first step off an unstable equilibrium
MIN_STRIDE = 0.003  # of t
MIN_MASS = 3.0e-4  # E / (rho extent^2): first pseudo-mass
FREE, PULLED, PRESSED = range(3)  # rows: no force imposed; a tension, the upper bound; a pressure, both bounds
STALL_LIMIT = 5  # iterations without progress after which a world that is within rounding counts as converged
STUCK_LIMIT = 40  # the same for a world above rounding, which comes no nearer on this way


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Path kernels of one variant."""
    real = variant.real
    module = variant.module("statics")

    @wp.kernel(module=module, enable_backward=False)
    def begin(
        # Workspace out
        control_out: wp.array3d(dtype=real),
    ):
        """Start of the path, aiming at its end."""
        pack, lane = wp.tid()
        for row in range(wp.static(ROWS)):
            control_out[pack, row, lane] = real(0.0)
        control_out[pack, wp.static(MERIT), lane] = real(1.0)
        control_out[pack, wp.static(BEST), lane] = real(1.0e30)
        control_out[pack, wp.static(T), lane] = real(1.0)
        control_out[pack, wp.static(STRIDE), lane] = real(1.0)

    @wp.kernel(module=module, enable_backward=False)
    def finish(
        # Workspace out
        control_out: wp.array3d(dtype=real),
    ):
        """Look at every world with its whole load; one that stopped half way goes back to its last good point.

        Those that were stopped because they came no nearer have not converged.
        """
        pack, lane = wp.tid()
        if control_out[pack, wp.static(STUCK), lane] > real(0.5):
            control_out[pack, wp.static(FROZEN), lane] = real(0.0)
        control_out[pack, wp.static(GOOD), lane] = real(0.0)
        control_out[pack, wp.static(FRACTION), lane] = real(0.0)
        is_short = control_out[pack, wp.static(T), lane] < real(1.0)
        control_out[pack, wp.static(BACK), lane] = wp.where(is_short, real(1.0), real(0.0))
        control_out[pack, wp.static(T), lane] = real(1.0)

    @wp.kernel(module=module, enable_backward=False)
    def path_load(
        # Workspace in
        control_in: wp.array3d(dtype=real),
        start_imbalance_in: wp.array3d(dtype=real),
        # Workspace out
        b_out: wp.array3d(dtype=real),
    ):
        """Take (1 - t) times the start imbalance off the load."""
        pack, row, lane = wp.tid()
        missing = real(0.0)
        if control_in[pack, wp.static(LOADED), lane] < real(0.5):
            missing = real(1.0) - control_in[pack, wp.static(T), lane]
        b_out[pack, row, lane] = b_out[pack, row, lane] - missing * start_imbalance_in[pack, row, lane]

    @wp.kernel(module=module, enable_backward=False)
    def start_rows(
        # Model
        row_imposed: wp.array(dtype=wp.int32),
        # Workspace in
        displacement_in: wp.array3d(dtype=real),
        compliance_in: wp.array3d(dtype=real),
        lower_in: wp.array3d(dtype=real),
        upper_in: wp.array3d(dtype=real),
        # Workspace out
        multiplier_out: wp.array3d(dtype=real),
        value_out: wp.array3d(dtype=real),
    ):
        """Multipliers within the bounds of new commands, but pressures, and the targets that the start state meets."""
        pack, row, lane = wp.tid()
        multiplier = multiplier_out[pack, row, lane]
        if row_imposed[row] != wp.static(PRESSED):
            multiplier = wp.min(wp.max(multiplier, lower_in[pack, row, lane]), upper_in[pack, row, lane])
        multiplier_out[pack, row, lane] = multiplier
        value_out[pack, row, lane] = displacement_in[pack, row, lane] + compliance_in[pack, row, lane] * multiplier

    @wp.kernel(module=module, enable_backward=False)
    def path_command(
        # Model
        row_imposed: wp.array(dtype=wp.int32),
        # Workspace in
        control_in: wp.array3d(dtype=real),
        start_value_in: wp.array3d(dtype=real),
        start_multiplier_in: wp.array3d(dtype=real),
        # Workspace out
        target_out: wp.array3d(dtype=real),
        lower_out: wp.array3d(dtype=real),
        upper_out: wp.array3d(dtype=real),
    ):
        """Targets, and imposed tensions and pressures, at the present point of the path."""
        pack, row, lane = wp.tid()
        t = control_in[pack, wp.static(T), lane]
        start = start_value_in[pack, row, lane]
        target_out[pack, row, lane] = start + t * (target_out[pack, row, lane] - start)
        if row_imposed[row] != wp.static(FREE):
            start = start_multiplier_in[pack, row, lane]
            upper = start + t * (upper_out[pack, row, lane] - start)
            upper_out[pack, row, lane] = upper
            if row_imposed[row] == wp.static(PRESSED):
                lower_out[pack, row, lane] = upper

    @wp.kernel(module=module, enable_backward=False)
    def measure(
        row_count: int,
        # Model
        row_length: wp.array(dtype=real),
        # Workspace in
        norm_in: wp.array3d(dtype=real),
        gap_in: wp.array3d(dtype=real),
        multiplier_in: wp.array3d(dtype=real),
        lower_in: wp.array3d(dtype=real),
        upper_in: wp.array3d(dtype=real),
        # Workspace out
        control_out: wp.array3d(dtype=real),
    ):
        """Merit of the present iterate: relative force imbalance plus worst violation of a row per length of it."""
        pack, lane = wp.tid()
        imbalance = norm_in[pack, 0, lane]
        worst = real(0.0)
        for row in range(row_count):
            gap = gap_in[pack, row, lane]
            multiplier = multiplier_in[pack, row, lane]
            at_lower = multiplier <= lower_in[pack, row, lane]
            at_upper = multiplier >= upper_in[pack, row, lane]
            if not ((at_lower and gap >= real(0.0)) or (at_upper and gap <= real(0.0))):
                worst = wp.max(worst, wp.abs(gap) / row_length[row])
        control_out[pack, wp.static(IMBALANCE), lane] = imbalance
        control_out[pack, wp.static(MERIT), lane] = imbalance / (norm_in[pack, 1, lane] + real(1.0e-30)) + worst

    @wp.kernel(module=module, enable_backward=False)
    def arrive(
        dof_rows: int,
        tolerance: real,
        rounding: real,
        rounding_force: real,
        near: real,
        # Workspace in
        u_in: wp.array3d(dtype=real),
        # Workspace out
        control_out: wp.array3d(dtype=real),
    ):
        """Freeze a world at the end of the path whose imbalance and whose distance from equilibrium [m] are small.

        The distance is the length of the Newton step; steps that pseudo-mass shortened do not count. An imbalance that
        is within rounding and has stopped falling need not fall below the tolerance, if the last steps were all small.
        One that has stopped falling above it stops the world as well: where cables alone hold a body that could move
        as a whole, A is singular, and the rounding of its solutions is amplified.
        """
        pack, lane = wp.tid()
        control_out[pack, wp.static(FRACTION), lane] = real(0.0)
        control_out[pack, wp.static(GOOD), lane] = real(0.0)
        control_out[pack, wp.static(BACK), lane] = real(0.0)
        merit = control_out[pack, wp.static(MERIT), lane]
        is_end = control_out[pack, wp.static(T), lane] >= real(1.0)
        if is_end and control_out[pack, wp.static(FROZEN), lane] < real(0.5):
            largest = real(0.0)
            total = real(0.0)
            for row in range(dof_rows):
                largest = wp.max(largest, wp.abs(u_in[pack, row, lane]))
                total += u_in[pack, row, lane] * u_in[pack, row, lane]
            spread = wp.max(largest, real(0.5) * control_out[pack, wp.static(SPREAD), lane])
            control_out[pack, wp.static(SPREAD), lane] = spread
            stall = control_out[pack, wp.static(STALL), lane] + real(1.0)
            if merit < real(0.5) * control_out[pack, wp.static(BEST), lane]:
                control_out[pack, wp.static(BEST), lane] = merit
                stall = real(0.0)
            control_out[pack, wp.static(STALL), lane] = stall
            is_rounding = merit <= rounding or control_out[pack, wp.static(IMBALANCE), lane] <= rounding_force
            is_still = stall >= real(wp.static(float(STALL_LIMIT))) and is_rounding and spread <= near
            has_mass = control_out[pack, wp.static(PSEUDO_MASS), lane] > real(0.0)
            is_there = largest <= near and (merit <= tolerance or is_still)
            is_stuck = stall >= real(wp.static(float(STUCK_LIMIT)))
            if (is_there or is_stuck) and wp.isfinite(total) and not has_mass:
                control_out[pack, wp.static(FROZEN), lane] = real(1.0)
                control_out[pack, wp.static(STUCK), lane] = wp.where(is_there, real(0.0), real(1.0))

    @wp.func
    def go_back(control: wp.array3d(dtype=real), pack: int, lane: int):
        """Return to the last good point and try a shorter stride."""
        stride = wp.max(real(wp.static(MIN_STRIDE)), real(0.3) * control[pack, wp.static(STRIDE), lane])
        control[pack, wp.static(STRIDE), lane] = stride
        control[pack, wp.static(T), lane] = wp.min(real(1.0), control[pack, wp.static(T_GOOD), lane] + stride)
        control[pack, wp.static(CORRECTIONS), lane] = real(0.0)
        control[pack, wp.static(BAD), lane] = real(0.0)
        control[pack, wp.static(BACK), lane] = real(1.0)

    @wp.func
    def slide(control: wp.array3d(dtype=real), pack: int, lane: int, has_rows: bool):
        """Leave a path that does not go on: put on all loads at the last good point and let pseudo-mass brake.

        Cables stay at the fraction where they are until the world has come to rest.
        """
        control[pack, wp.static(STRIDE), lane] = real(0.0)
        go_back(control, pack, lane)
        if not has_rows:
            control[pack, wp.static(T), lane] = real(1.0)
        control[pack, wp.static(LOADED), lane] = real(1.0)
        control[pack, wp.static(CORRECTIONS), lane] = real(1.0)
        control[pack, wp.static(LAST), lane] = real(1.0e30)

    @wp.func
    def add_mass(control: wp.array3d(dtype=real), pack: int, lane: int):
        """Four times more pseudo-mass, or twice where a world slides."""
        factor = wp.where(control[pack, wp.static(LOADED), lane] > real(0.5), real(2.0), real(4.0))
        mass = factor * control[pack, wp.static(PSEUDO_MASS), lane]
        control[pack, wp.static(PSEUDO_MASS), lane] = wp.max(mass, real(wp.static(MIN_MASS)))

    @wp.func
    def lose_mass(control: wp.array3d(dtype=real), pack: int, lane: int, factor: real):
        """Less pseudo-mass; none where little is left."""
        mass = factor * control[pack, wp.static(PSEUDO_MASS), lane]
        control[pack, wp.static(PSEUDO_MASS), lane] = wp.where(mass < real(wp.static(0.1 * MIN_MASS)), real(0.0), mass)

    @wp.func
    def reach_point(control: wp.array3d(dtype=real), pack: int, lane: int, rate: real):
        """Make the present point the last good one and aim at the next, farther if this one was reached easily."""
        t = control[pack, wp.static(T), lane]
        stride = control[pack, wp.static(STRIDE), lane]
        corrections = control[pack, wp.static(CORRECTIONS), lane]
        if corrections < real(2.5):
            stride *= wp.where(rate < real(0.25), real(2.0), real(1.3))
        elif corrections > real(4.5):
            stride *= real(0.7)
        stride = wp.max(stride, real(wp.static(MIN_STRIDE)))
        lose_mass(control, pack, lane, real(0.3))
        control[pack, wp.static(STRIDE), lane] = stride
        control[pack, wp.static(T_GOOD), lane] = t
        control[pack, wp.static(T), lane] = wp.min(real(1.0), t + stride)
        control[pack, wp.static(CORRECTIONS), lane] = real(0.0)
        control[pack, wp.static(BAD), lane] = real(0.0)
        control[pack, wp.static(GOOD), lane] = real(1.0)

    @wp.func
    def leave_saddle(control: wp.array3d(dtype=real), pack: int, lane: int, largest: real, bound: real):
        """Step off an unstable equilibrium along its softest direction, which rounding has mixed into the solution."""
        control[pack, wp.static(FRACTION), lane] = real(wp.static(KICK)) * bound / (largest + real(1.0e-30))
        control[pack, wp.static(LOADED), lane] = real(1.0)
        control[pack, wp.static(STRIDE), lane] = real(wp.static(MIN_STRIDE))
        control[pack, wp.static(CORRECTIONS), lane] = real(1.0)
        control[pack, wp.static(LAST), lane] = real(1.0e30)
        add_mass(control, pack, lane)

    @wp.func
    def correct(control: wp.array3d(dtype=real), pack: int, lane: int, largest: real, bound: real, has_rows: bool):
        """Take a correction, or judge that it does not converge."""
        rate = largest / (control[pack, wp.static(LAST), lane] + real(1.0e-30))
        is_near = largest <= real(wp.static(NEAR)) * bound
        is_last_resort = control[pack, wp.static(STRIDE), lane] <= real(wp.static(1.01 * MIN_STRIDE))
        is_sliding = is_last_resort and control[pack, wp.static(LOADED), lane] > real(0.5)
        mass = control[pack, wp.static(PSEUDO_MASS), lane]
        is_slow = mass > real(wp.static(MIN_MASS)) and rate < real(1.0)
        allowed = control[pack, wp.static(PREDICTED), lane]
        allowed *= wp.pow(real(wp.static(CONTRACTION)), control[pack, wp.static(CORRECTIONS), lane])
        is_converging = is_near or rate <= real(wp.static(CONTRACTION)) or largest <= allowed or is_slow
        if largest <= bound and (is_converging or (is_last_resort and rate <= real(1.5))):
            corrections = control[pack, wp.static(CORRECTIONS), lane] + real(1.0)
            control[pack, wp.static(CORRECTIONS), lane] = corrections
            control[pack, wp.static(FRACTION), lane] = real(1.0)
            control[pack, wp.static(LAST), lane] = largest
            if largest <= real(0.3) * bound and (is_sliding or (corrections > real(3.5) and rate < real(0.9))):
                factor = wp.where(control[pack, wp.static(BAD), lane] > real(0.5), real(0.8), real(0.5))
                lose_mass(control, pack, lane, factor)
            if is_near:
                if control[pack, wp.static(T), lane] < real(1.0):
                    if not is_sliding or rate < real(0.5):
                        reach_point(control, pack, lane, rate)
                elif not is_sliding or rate < real(0.6):
                    lose_mass(control, pack, lane, real(0.3))
        elif not is_last_resort:
            go_back(control, pack, lane)
        elif control[pack, wp.static(LOADED), lane] < real(0.5):
            slide(control, pack, lane, has_rows)
        else:
            add_mass(control, pack, lane)

    @wp.kernel(module=module, enable_backward=False)
    def walk(
        dof_rows: int,
        dof_count: int,
        bound: real,
        has_rows: bool,
        # Workspace in
        u_in: wp.array3d(dtype=real),
        pivot_in: wp.array3d(dtype=real),
        contact_in: wp.array3d(dtype=real),
        # Workspace out
        control_out: wp.array3d(dtype=real),
    ):
        """Decide what a world does with the solution u: step, part of it, back, or more pseudo-mass.

        The equilibrium is stable where A has no more negative pivots than the multiplier rows hold back, the rows' own
        negative pivots (``contact_in``, which is negative if the multipliers were not found).
        """
        pack, lane = wp.tid()
        if control_out[pack, wp.static(FROZEN), lane] < real(0.5):
            largest = real(0.0)
            total = real(0.0)
            for row in range(dof_rows):
                largest = wp.max(largest, wp.abs(u_in[pack, row, lane]))
                total += u_in[pack, row, lane] * u_in[pack, row, lane]
            unstable = -contact_in[pack, 0, lane]
            for row in range(dof_count):
                unstable += pivot_in[pack, row, lane]
            is_sound = wp.isfinite(total) and wp.isfinite(unstable) and wp.abs(unstable) < real(0.5)
            is_first = control_out[pack, wp.static(CORRECTIONS), lane] < real(0.5)
            is_end = control_out[pack, wp.static(T), lane] >= real(1.0)
            is_near = largest <= real(wp.static(NEAR)) * bound
            if unstable > real(0.5) and is_end and is_near and wp.isfinite(total):
                leave_saddle(control_out, pack, lane, largest, bound)
            elif not is_sound or (not is_first and largest > real(wp.static(FAR)) * bound):
                bad = control_out[pack, wp.static(BAD), lane] + real(1.0)
                control_out[pack, wp.static(BAD), lane] = bad
                add_mass(control_out, pack, lane)
                if bad > real(4.5):
                    is_lost = control_out[pack, wp.static(STRIDE), lane] <= real(wp.static(1.01 * MIN_STRIDE))
                    if is_first:
                        is_lost = is_lost or not has_rows  # A at the good point does not know the stride
                    if not is_lost:
                        lose_mass(control_out, pack, lane, real(4.0e-3))
                        go_back(control_out, pack, lane)
                    elif control_out[pack, wp.static(LOADED), lane] < real(0.5):
                        slide(control_out, pack, lane, has_rows)
            elif is_first:
                fraction = wp.min(real(1.0), bound / (largest + real(1.0e-30)))
                good = control_out[pack, wp.static(T_GOOD), lane]
                t = control_out[pack, wp.static(T), lane]
                if fraction < real(1.0):
                    t = good + fraction * (t - good)
                control_out[pack, wp.static(T), lane] = t
                control_out[pack, wp.static(STRIDE), lane] = t - good
                control_out[pack, wp.static(FRACTION), lane] = fraction
                control_out[pack, wp.static(CORRECTIONS), lane] = real(1.0)
                control_out[pack, wp.static(LAST), lane] = fraction * largest
                control_out[pack, wp.static(PREDICTED), lane] = fraction * largest
            else:
                correct(control_out, pack, lane, largest, bound, has_rows)

    @wp.kernel(module=module, enable_backward=False)
    def advance(
        # Workspace in
        control_in: wp.array3d(dtype=real),
        step_in: wp.array3d(dtype=real),
        is_difference: bool,
        # Workspace out
        value_out: wp.array3d(dtype=real),
        reference_out: wp.array3d(dtype=real),
    ):
        """value += fraction step, or back to the reference; a good point becomes the reference.

        ``step_in`` is the step itself (``is_difference``), or the value at its end.
        """
        pack, row, lane = wp.tid()
        value = value_out[pack, row, lane]
        if control_in[pack, wp.static(BACK), lane] > real(0.5):
            value = reference_out[pack, row, lane]
        elif control_in[pack, wp.static(FRACTION), lane] > real(0.0):
            step = step_in[pack, row, lane]
            if not is_difference:
                step -= value
            value += control_in[pack, wp.static(FRACTION), lane] * step
        value_out[pack, row, lane] = value
        if control_in[pack, wp.static(GOOD), lane] > real(0.5):
            reference_out[pack, row, lane] = value

    @wp.kernel(module=module, enable_backward=False)
    def pseudo_mass(
        extent: real,
        # Workspace in
        youngs_in: wp.array3d(dtype=real),
        density_in: wp.array3d(dtype=real),
        control_in: wp.array3d(dtype=real),
        # Workspace out
        body_mass_scale_out: wp.array3d(dtype=real),
    ):
        """Factor of M in the quasi-static A: the control row times E / (rho extent^2), so that it has no scale."""
        pack, body, lane = wp.tid()
        frequency = youngs_in[pack, body, lane] / (density_in[pack, body, lane] * extent * extent)
        body_mass_scale_out[pack, body, lane] = control_in[pack, wp.static(PSEUDO_MASS), lane] * frequency

    return SimpleNamespace(
        begin=begin,
        finish=finish,
        path_load=path_load,
        start_rows=start_rows,
        path_command=path_command,
        measure=measure,
        arrive=arrive,
        walk=walk,
        advance=advance,
        pseudo_mass=pseudo_mass,
    )
