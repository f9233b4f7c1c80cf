"""Per-world control of Newton's method in a step: accept or reject an iterate, step length, convergence.

All worlds run the same launches; a world that rejects an iterate goes back to its last accepted point with half the
step, and a converged one stands still. Theory: docs/theory/newton.md.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant, single_worlds

# Rows of the per-world control array
MERIT, IMBALANCE, STEP, ACCEPTED, FROZEN, BEST, STALL, FAILED, IMPROVED, RETURNING, WITHIN = range(11)
DEPTH, DEPTH_FIRST = range(11, 13)  # of the present iterate and the first one
STUCK, HALTED, MORE, ROWS = range(13, 17)  # has been stuck; takes no further iterations; how many it took
PROGRESS = 0.8  # of the best merit: what counts as an improvement
PATIENCE = 5.0  # iterations without progress in which an iterate may be worse than the one before
REDUCTION, RECOVERY = 0.5, 1.1  # of the share of the pressures' tangent in A after a solve that failed or did not
LEAST_SHARE = 0.1  # below it the tangent is left out for the rest of the step
DEPTH_MERIT = 0.1  # what each unit of an iterate's depth beyond the first one adds to its merit
STUCK_LIMIT = 4  # iterations without progress after which a world may take further ones
USUAL = 12  # iterations that usually suffice: with fewer at hand, none takes further ones
STALL_LIMIT = 8  # iterations without progress after which a world that is within rounding counts as converged


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Newton control kernels in the scalar view of one variant."""
    real = variant.real
    module = variant.module("newton")

    @wp.kernel(module=module, enable_backward=False)
    def begin(
        # Workspace out
        control_out: wp.array3d(dtype=real),
    ):
        """Start values of the control rows."""
        pack, lane = wp.tid()
        control_out[pack, wp.static(IMBALANCE), lane] = real(0.0)
        control_out[pack, wp.static(STEP), lane] = real(1.0)
        control_out[pack, wp.static(ACCEPTED), lane] = real(0.0)
        control_out[pack, wp.static(FROZEN), lane] = real(0.0)
        control_out[pack, wp.static(MERIT), lane] = real(1.0)
        control_out[pack, wp.static(BEST), lane] = real(1.0e30)
        control_out[pack, wp.static(STALL), lane] = real(0.0)
        control_out[pack, wp.static(FAILED), lane] = real(0.0)
        control_out[pack, wp.static(IMPROVED), lane] = real(0.0)
        control_out[pack, wp.static(RETURNING), lane] = real(0.0)
        control_out[pack, wp.static(WITHIN), lane] = real(0.0)
        control_out[pack, wp.static(DEPTH), lane] = real(0.0)
        control_out[pack, wp.static(DEPTH_FIRST), lane] = real(0.0)
        control_out[pack, wp.static(STUCK), lane] = real(0.0)
        control_out[pack, wp.static(HALTED), lane] = real(0.0)
        control_out[pack, wp.static(MORE), lane] = real(0.0)

    @wp.kernel(module=module, enable_backward=False)
    def measure_depth(
        touch_rows: int,
        distance_row: int,
        # Model
        pair_deepest: wp.array(dtype=real),
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        pair_in: wp.array3d(dtype=wp.int32),
        compliance_in: wp.array3d(dtype=real),
        pair_distance_in: wp.array3d(dtype=real),
        touch_in: wp.array3d(dtype=real),
        # Workspace out
        control_out: wp.array3d(dtype=real),
    ):
        """Depth of the present iterate: the largest of its rigid contacts, in parts of the deepest of their pair."""
        pack, lane = wp.tid()
        depth = real(0.0)
        for contact in range(count_in[pack, 0, lane]):
            if compliance_in[pack, contact, lane] == real(0.0):
                pair = pair_in[pack, contact, lane]
                distance = touch_in[pack, touch_rows * contact + distance_row, lane]
                depth = wp.max(depth, (pair_distance_in[pack, pair, lane] - distance) / pair_deepest[pair])
        control_out[pack, wp.static(DEPTH), lane] = depth

    @wp.kernel(module=module, enable_backward=False)
    def judge(
        first: bool,
        tolerance: real,
        rounding: real,
        rounding_force: real,
        monotone: bool,
        row_count: int,
        # Model
        row_size: wp.array(dtype=real),
        # Workspace in
        norm_in: wp.array3d(dtype=real),
        gap_in: wp.array3d(dtype=real),
        multiplier_in: wp.array3d(dtype=real),
        lower_in: wp.array3d(dtype=real),
        upper_in: wp.array3d(dtype=real),
        # Workspace out
        control_out: wp.array3d(dtype=real),
    ):
        """Decide on the present iterate from its force imbalance and constraint violation.

        The merit is |imbalance| / |forces that balance| plus the worst violation per cable length, where a row counts
        only if its multiplier could still move the right way. A world that stops improving below ``rounding``, or with
        an imbalance below ``rounding_force``, has reached the precision of its coordinates and counts as converged.
        An iterate may be worse than the one before as long as there has been progress lately: a long step along the
        tangent of a slender or thin body stretches it in second order, and it resists that far more than bending.
        Whether the last accepted iterate is within rounding is told, too.
        Without progress the world goes back to its best iterate, and from there the imbalance must not grow. Where the
        search is not ``monotone`` patience never ends.
        A world whose last solve failed has not converged: it stands where it did, and forces balance at a saddle too.
        Worlds that have been without progress for long are noted, and those that are halted stay as they are.
        Imbalance knows nothing of a wall that contacts of the iterate before have not held back from. So a depth beyond
        1, and beyond that of the start, adds to the merit by which an iterate is best or has converged.
        """
        pack, lane = wp.tid()
        imbalance = norm_in[pack, 0, lane]
        merit = imbalance / (norm_in[pack, 1, lane] + real(1.0e-30))
        worst = real(0.0)
        for row in range(row_count):
            gap = gap_in[pack, row, lane]
            multiplier = multiplier_in[pack, row, lane]
            at_lower = multiplier <= lower_in[pack, row, lane]
            at_upper = multiplier >= upper_in[pack, row, lane]
            if not ((at_lower and gap >= real(0.0)) or (at_upper and gap <= real(0.0))):
                worst = wp.max(worst, wp.abs(gap) / row_size[row])
        merit += worst
        before = control_out[pack, wp.static(IMBALANCE), lane]
        step = control_out[pack, wp.static(STEP), lane]
        stall = control_out[pack, wp.static(STALL), lane]
        patient = stall < real(wp.static(PATIENCE)) or not monotone
        accepted = first or imbalance <= before or ((patient or step < real(0.1)) and wp.isfinite(imbalance))
        depth = control_out[pack, wp.static(DEPTH), lane]
        if first:
            control_out[pack, wp.static(DEPTH_FIRST), lane] = depth
        beyond = wp.max(depth - wp.max(real(1.0), control_out[pack, wp.static(DEPTH_FIRST), lane]), real(0.0))
        deep = real(wp.static(DEPTH_MERIT)) * beyond
        improved = first
        returning = bool(False)
        was_solved = control_out[pack, wp.static(FAILED), lane] < real(0.5)
        if control_out[pack, wp.static(FROZEN), lane] + control_out[pack, wp.static(HALTED), lane] > real(0.5):
            accepted = False
        elif accepted:
            control_out[pack, wp.static(STEP), lane] = real(1.0)
            control_out[pack, wp.static(IMBALANCE), lane] = imbalance
            control_out[pack, wp.static(MERIT), lane] = merit
            is_rounding = merit <= rounding or (imbalance <= rounding_force and worst <= rounding)
            control_out[pack, wp.static(WITHIN), lane] = wp.where(is_rounding, real(1.0), real(0.0))
            if not first:
                stall += real(1.0)
                if merit + deep < real(wp.static(PROGRESS)) * control_out[pack, wp.static(BEST), lane]:
                    control_out[pack, wp.static(BEST), lane] = merit + deep
                    stall = real(0.0)
                    improved = True
                if stall >= real(wp.static(float(STUCK_LIMIT))):
                    control_out[pack, wp.static(STUCK), lane] = real(1.0)
                control_out[pack, wp.static(STALL), lane] = stall
                is_still = stall >= real(wp.static(float(STALL_LIMIT))) and is_rounding
                if was_solved and (merit + deep <= tolerance or (is_still and deep <= tolerance)):
                    control_out[pack, wp.static(FROZEN), lane] = real(1.0)
                elif monotone and stall == real(wp.static(PATIENCE)):
                    returning = True
                    accepted = False
                    control_out[pack, wp.static(IMBALANCE), lane] = real(1.0e30)
        else:
            control_out[pack, wp.static(STEP), lane] = real(0.5) * step
        control_out[pack, wp.static(ACCEPTED), lane] = wp.where(accepted, real(1.0), real(0.0))
        control_out[pack, wp.static(IMPROVED), lane] = wp.where(accepted and improved, real(1.0), real(0.0))
        control_out[pack, wp.static(RETURNING), lane] = wp.where(returning, real(1.0), real(0.0))

    @wp.kernel(module=module, enable_backward=False)
    def keep(
        # Workspace in
        control_in: wp.array3d(dtype=real),
        value_in: wp.array3d(dtype=real),
        # Workspace out
        reference_out: wp.array3d(dtype=real),
    ):
        """Store an accepted iterate."""
        pack, row, lane = wp.tid()
        if control_in[pack, wp.static(ACCEPTED), lane] > real(0.5):
            reference_out[pack, row, lane] = value_in[pack, row, lane]

    @wp.kernel(module=module, enable_backward=False)
    def keep_best(
        last: bool,
        # Workspace in
        control_in: wp.array3d(dtype=real),
        # Workspace out
        value_out: wp.array3d(dtype=real),
        best_out: wp.array3d(dtype=real),
    ):
        """Store the best iterate; at the ``last`` one put back a world that has not converged."""
        pack, row, lane = wp.tid()
        if control_in[pack, wp.static(IMPROVED), lane] > real(0.5):
            best_out[pack, row, lane] = value_out[pack, row, lane]
        elif last and control_in[pack, wp.static(FROZEN), lane] < real(0.5):
            value_out[pack, row, lane] = best_out[pack, row, lane]

    @wp.kernel(module=module, enable_backward=False)
    def keep_best_contacts(
        last: bool,
        # Workspace in
        control_in: wp.array3d(dtype=real),
        # Workspace out
        count_out: wp.array3d(dtype=wp.int32),
        key_out: wp.array3d(dtype=wp.int32),
        force_out: wp.array3d(dtype=real),
        best_count_out: wp.array3d(dtype=wp.int32),
        best_key_out: wp.array3d(dtype=wp.int32),
        best_force_out: wp.array3d(dtype=real),
    ):
        """The same for one of the contacts that forces are known of: key and force, and how many there are."""
        pack, c, lane = wp.tid()
        if control_in[pack, wp.static(IMPROVED), lane] > real(0.5):
            best_key_out[pack, c, lane] = key_out[pack, c, lane]
            for i in range(3):
                best_force_out[pack, 3 * c + i, lane] = force_out[pack, 3 * c + i, lane]
            if c == 0:
                best_count_out[pack, 0, lane] = count_out[pack, 0, lane]
        elif last and control_in[pack, wp.static(FROZEN), lane] < real(0.5):
            key_out[pack, c, lane] = best_key_out[pack, c, lane]
            for i in range(3):
                force_out[pack, 3 * c + i, lane] = best_force_out[pack, 3 * c + i, lane]
            if c == 0:
                count_out[pack, 0, lane] = best_count_out[pack, 0, lane]

    @wp.kernel(module=module, enable_backward=False)
    def go_back(
        # Workspace in
        control_in: wp.array3d(dtype=real),
        best_in: wp.array3d(dtype=real),
        # Workspace out
        value_out: wp.array3d(dtype=real),
        reference_out: wp.array3d(dtype=real),
    ):
        """Put a world that has lost its way back to its best iterate."""
        pack, row, lane = wp.tid()
        if control_in[pack, wp.static(RETURNING), lane] > real(0.5):
            value_out[pack, row, lane] = best_in[pack, row, lane]
            reference_out[pack, row, lane] = best_in[pack, row, lane]

    @wp.kernel(module=module, enable_backward=False)
    def check_direction(
        count: int,
        # Workspace in
        u_in: wp.array3d(dtype=real),
        # Workspace out
        control_out: wp.array3d(dtype=real),
        share_out: wp.array3d(dtype=real),
    ):
        """Whether the last solve failed, as it does on an indefinite A; then A gets less of the pressures' tangent.

        What it gets grows again from solve to solve. A world that goes back to its best iterate has not left it either.
        """
        pack, lane = wp.tid()
        if control_out[pack, wp.static(HALTED), lane] > real(0.5):
            return
        failed = real(0.0)
        for row in range(count):
            if not wp.isfinite(u_in[pack, row, lane]):
                failed = real(1.0)
        is_back = control_out[pack, wp.static(RETURNING), lane] > real(0.5)
        if control_out[pack, wp.static(ACCEPTED), lane] < real(0.5) and not is_back:
            failed = real(0.0)
        control_out[pack, wp.static(FAILED), lane] = failed
        change = wp.where(failed > real(0.5), real(wp.static(REDUCTION)), real(wp.static(RECOVERY)))
        share = wp.min(share_out[pack, 0, lane] * change, real(1.0))
        share_out[pack, 0, lane] = wp.where(share < real(wp.static(LEAST_SHARE)), real(0.0), share)

    @wp.kernel(module=module, enable_backward=False)
    def drop_failed(
        # Workspace in
        control_in: wp.array3d(dtype=real),
        # Workspace out
        value_out: wp.array3d(dtype=real),
    ):
        """Clear what a failed solve left, such as forces of contacts, and what one at a rejected iterate left in vain.

        The next step starts from them, and no step could mend forces that are not finite.
        """
        pack, row, lane = wp.tid()
        failed = control_in[pack, wp.static(FAILED), lane] > real(0.5)
        if failed or not wp.isfinite(value_out[pack, row, lane]):
            value_out[pack, row, lane] = real(0.0)

    @wp.kernel(module=module, enable_backward=False)
    def refer(
        # Workspace in
        norm_in: wp.array3d(dtype=real),
        # Workspace out
        control_out: wp.array3d(dtype=real),
    ):
        """The imbalance of an accepted iterate with the multipliers it has now, which the direction is to remove."""
        pack, lane = wp.tid()
        accepted = control_out[pack, wp.static(ACCEPTED), lane] > real(0.5)
        moving = control_out[pack, wp.static(FROZEN), lane] < real(0.5)
        if accepted and moving and control_out[pack, wp.static(FAILED), lane] < real(0.5):
            control_out[pack, wp.static(IMBALANCE), lane] = norm_in[pack, 0, lane]

    @wp.kernel(module=module, enable_backward=False)
    def advance(
        # Workspace in
        control_in: wp.array3d(dtype=real),
        u_in: wp.array3d(dtype=real),
        reference_in: wp.array3d(dtype=real),
        # Workspace out
        direction_out: wp.array3d(dtype=real),
        value_out: wp.array3d(dtype=real),
    ):
        """value = reference + step * direction, with the direction of the last accepted iterate."""
        pack, row, lane = wp.tid()
        if control_in[pack, wp.static(HALTED), lane] > real(0.5):
            return
        frozen = control_in[pack, wp.static(FROZEN), lane] > real(0.5)
        if frozen or control_in[pack, wp.static(FAILED), lane] > real(0.5):
            value_out[pack, row, lane] = reference_in[pack, row, lane]
        else:
            if control_in[pack, wp.static(ACCEPTED), lane] > real(0.5):
                direction_out[pack, row, lane] = u_in[pack, row, lane]
            step = control_in[pack, wp.static(STEP), lane]
            value_out[pack, row, lane] = reference_in[pack, row, lane] + step * direction_out[pack, row, lane]

    @wp.kernel(module=module, enable_backward=False)
    def hold(
        # Workspace in
        control_in: wp.array3d(dtype=real),
        # Workspace out
        multiplier_out: wp.array3d(dtype=real),
        reference_out: wp.array3d(dtype=real),
    ):
        """Multipliers found at a rejected or converged iterate, or in vain, are dropped for those held before."""
        pack, row, lane = wp.tid()
        moving = control_in[pack, wp.static(FROZEN), lane] + control_in[pack, wp.static(FAILED), lane] < real(0.5)
        moving = moving and control_in[pack, wp.static(HALTED), lane] < real(0.5)
        if moving and control_in[pack, wp.static(ACCEPTED), lane] > real(0.5):
            reference_out[pack, row, lane] = multiplier_out[pack, row, lane]
        else:
            multiplier_out[pack, row, lane] = reference_out[pack, row, lane]

    @wp.kernel(module=module, enable_backward=False)
    def begin_further(
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        # Workspace out
        control_out: wp.array3d(dtype=real),
        stuck_out: wp.array3d(dtype=wp.int32),
    ):
        """A world with contacts that has been stuck, and has not converged, has patience again; all others halt."""
        pack, lane = wp.tid()
        stuck = control_out[pack, wp.static(STUCK), lane] - control_out[pack, wp.static(FROZEN), lane] > real(0.5)
        stuck = stuck and count_in[pack, 0, lane] > 0
        stuck_out[pack, 0, lane] = wp.where(stuck, 1, 0)
        control_out[pack, wp.static(HALTED), lane] = wp.where(stuck, real(0.0), real(1.0))
        control_out[pack, wp.static(MORE), lane] = real(0.0)
        if stuck:
            control_out[pack, wp.static(STALL), lane] = real(0.0)

    @wp.kernel(module=module, enable_backward=False)
    def end_further(
        # Workspace in
        control_in: wp.array3d(dtype=real),
        # Workspace out
        stuck_out: wp.array3d(dtype=wp.int32),
        returns_out: wp.array3d(dtype=wp.int32),
    ):
        """A stuck world that has not converged goes back to where it was before, and keeps no contacts."""
        pack, lane = wp.tid()
        returns = stuck_out[pack, 0, lane] != 0 and control_in[pack, wp.static(FROZEN), lane] < real(0.5)
        returns_out[pack, 0, lane] = wp.where(returns, 1, 0)
        if returns:
            stuck_out[pack, 0, lane] = 0

    @wp.kernel(module=module, enable_backward=False)
    def give_back(
        # Workspace in
        returns_in: wp.array3d(dtype=wp.int32),
        before_in: wp.array3d(dtype=real),
        # Workspace out
        value_out: wp.array3d(dtype=real),
    ):
        """What a world that goes back had before."""
        pack, row, lane = wp.tid()
        if returns_in[pack, 0, lane] != 0:
            value_out[pack, row, lane] = before_in[pack, row, lane]

    @wp.kernel(module=module, enable_backward=False)
    def count_further(
        most: int,
        # Workspace out
        control_out: wp.array3d(dtype=real),
    ):
        """One more iteration has been taken; a world halts after the last."""
        pack, lane = wp.tid()
        more = control_out[pack, wp.static(MORE), lane] + real(1.0)
        control_out[pack, wp.static(MORE), lane] = more
        if more >= real(most):
            control_out[pack, wp.static(HALTED), lane] = real(1.0)

    @wp.kernel(module=module, enable_backward=False)
    def look_for_others(
        # Workspace in
        control_in: wp.array3d(dtype=real),
        spare_in: wp.array3d(dtype=wp.int32),
        # Workspace out
        idle_out: wp.array3d(dtype=wp.int32),
        left_out: wp.array(dtype=wp.int32),
    ):
        """Whether a world goes on, which then is not idle; spare ones always are."""
        pack, lane = wp.tid()
        idle = int(1)
        stays = control_in[pack, wp.static(FROZEN), lane] + control_in[pack, wp.static(HALTED), lane] > real(0.5)
        if not stays and spare_in[pack, 0, lane] == 0:
            idle = int(0)
            wp.atomic_max(left_out, 0, 1)  # few worlds
        idle_out[pack, 0, lane] = idle

    @wp.kernel(module=module, enable_backward=False)
    def hold_still(
        # Workspace in
        control_in: wp.array3d(dtype=real),
        held_in: wp.array3d(dtype=real),
        # Workspace out
        value_out: wp.array3d(dtype=real),
    ):
        """A world that has converged or halted keeps what it had."""
        pack, row, lane = wp.tid()
        if control_in[pack, wp.static(FROZEN), lane] + control_in[pack, wp.static(HALTED), lane] > real(0.5):
            value_out[pack, row, lane] = held_in[pack, row, lane]

    return SimpleNamespace(
        begin_further=begin_further,
        count_further=count_further,
        end_further=end_further,
        give_back=give_back,
        look_for_others=look_for_others,
        hold_still=hold_still,
        begin=begin,
        measure_depth=measure_depth,
        judge=judge,
        keep=keep,
        keep_best=keep_best,
        keep_best_contacts=keep_best_contacts,
        go_back=go_back,
        check_direction=check_direction,
        drop_failed=drop_failed,
        refer=refer,
        advance=advance,
        hold=hold,
    )
