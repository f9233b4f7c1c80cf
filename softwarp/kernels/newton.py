"""Per-world control of Newton's method in a step: accept or reject an iterate, step length, convergence.

All worlds run the same launches; a world that rejects an iterate goes back to its last accepted point with half the
step, and a converged one stands still. Theory: docs/theory/newton.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.lanes import Variant

# Rows of the per-world control array
MERIT, IMBALANCE, STEP, ACCEPTED, FROZEN, BEST, STALL, ROWS = range(8)
STALL_LIMIT = 8  # iterations without progress after which a world that is within rounding counts as converged


@cache
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

    @wp.kernel(module=module, enable_backward=False)
    def judge(
        first: bool,
        tolerance: real,
        rounding: real,
        rounding_force: real,
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
        an imbalance below ``rounding_force`` [N], has reached the precision of its coordinates and counts as converged.
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
        accepted = first or imbalance <= before or (step < real(0.1) and wp.isfinite(imbalance))
        if control_out[pack, wp.static(FROZEN), lane] > real(0.5):
            accepted = False
        elif accepted:
            control_out[pack, wp.static(STEP), lane] = real(1.0)
            control_out[pack, wp.static(IMBALANCE), lane] = imbalance
            control_out[pack, wp.static(MERIT), lane] = merit
            stall = control_out[pack, wp.static(STALL), lane] + real(1.0)
            if merit < real(0.8) * control_out[pack, wp.static(BEST), lane]:
                control_out[pack, wp.static(BEST), lane] = merit
                stall = real(0.0)
            control_out[pack, wp.static(STALL), lane] = stall
            is_rounding = merit <= rounding or (imbalance <= rounding_force and worst <= rounding)
            is_stalled = stall >= real(wp.static(float(STALL_LIMIT))) and is_rounding
            if (merit <= tolerance or is_stalled) and not first:
                control_out[pack, wp.static(FROZEN), lane] = real(1.0)
        else:
            control_out[pack, wp.static(STEP), lane] = real(0.5) * step
        control_out[pack, wp.static(ACCEPTED), lane] = wp.where(accepted, real(1.0), real(0.0))

    @wp.kernel(module=module, enable_backward=False)
    def keep(
        restore: bool,
        # Workspace in
        control_in: wp.array3d(dtype=real),
        # Workspace out
        value_out: wp.array3d(dtype=real),
        reference_out: wp.array3d(dtype=real),
    ):
        """Store an accepted iterate; ``restore`` puts a rejected world back to its last one."""
        pack, row, lane = wp.tid()
        if control_in[pack, wp.static(ACCEPTED), lane] > real(0.5):
            reference_out[pack, row, lane] = value_out[pack, row, lane]
        elif restore:
            value_out[pack, row, lane] = reference_out[pack, row, lane]

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
        if control_in[pack, wp.static(FROZEN), lane] > real(0.5):
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
        """Multipliers found at a rejected or converged iterate are dropped for those of the last accepted one."""
        pack, row, lane = wp.tid()
        moving = control_in[pack, wp.static(FROZEN), lane] < real(0.5)
        if moving and control_in[pack, wp.static(ACCEPTED), lane] > real(0.5):
            reference_out[pack, row, lane] = multiplier_out[pack, row, lane]
        else:
            multiplier_out[pack, row, lane] = reference_out[pack, row, lane]

    return SimpleNamespace(
        begin=begin,
        judge=judge,
        keep=keep,
        advance=advance,
        hold=hold,
    )
