"""Adjoint of Newton's method in a step: gradients by the end of a step that has converged.

The velocities v* that a step ends with are those that a linearised one about them leads back to, v* = F(v*). So the
gradient s by them, beside what a loss has, y, has what F makes of it:  s = y + (dF/dv)' s, found like v*, by going on.
Theory: docs/theory/adjoint.md. Workspace arrays are ``[pack, row, lane]``.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant, single_worlds

CHANGE, COUNT, DONE, ROWS = range(4)  # of a world's control: by how much s changed last, how often, whether it is there


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type, on single worlds."""
    real = variant.real
    module = variant.module("adjoint.newton")

    @wp.kernel(module=module, enable_backward=False)
    def go_on(
        rows: int,
        tolerance: real,
        rounding: real,
        most: real,
        # Model
        dof_free: wp.array2d(dtype=real),
        # Workspace in
        given_in: wp.array3d(dtype=real),
        ahead_in: wp.array3d(dtype=real),
        # Workspace out
        total_out: wp.array3d(dtype=real),
        control_out: wp.array3d(dtype=real),
        adrift_out: wp.array3d(dtype=wp.int32),
        left_out: wp.array(dtype=wp.int32),
    ):
        """s of one world as y and what follows from the last s; whether it has to go on.

        It has not if s changed by ``tolerance`` of it or less, or no longer less than before and by ``rounding``; if it
        has not come to that at last, it is adrift. A world that is there keeps its s.
        """
        pack, lane = wp.tid()
        if control_out[pack, wp.static(DONE), lane] > real(0.5):
            return
        change = real(0.0)
        size = real(0.0)
        is_finite = bool(True)
        for row in range(rows):
            before = total_out[pack, row, lane]
            now = given_in[pack, row, lane] + dof_free[row / 3, row % 3] * ahead_in[pack, row, lane]
            change = wp.max(change, wp.abs(now - before))
            size = wp.max(size, wp.abs(now))
            is_finite = is_finite and wp.isfinite(now)
            total_out[pack, row, lane] = now
        last = control_out[pack, wp.static(CHANGE), lane]
        count = control_out[pack, wp.static(COUNT), lane] + real(1.0)
        control_out[pack, wp.static(CHANGE), lane] = change
        control_out[pack, wp.static(COUNT), lane] = count
        is_still = count > real(1.0) and change >= real(0.5) * last and change <= rounding * size
        if change <= tolerance * size or is_still:
            control_out[pack, wp.static(DONE), lane] = real(1.0)
        elif count >= most or not is_finite:
            control_out[pack, wp.static(DONE), lane] = real(1.0)
            adrift_out[pack, 0, lane] = 1
        else:
            wp.atomic_max(left_out, 0, 1)  # few worlds

    return SimpleNamespace(go_on=go_on)
