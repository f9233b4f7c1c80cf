"""Bounds of actuators for inverse control, from their limits and rates. Theory: docs/theory/inverse.md.

Every actuator is a row of multipliers: effort in newtons, displacement in metres. Where a displacement is commanded,
the command may lie between the actuator's limits (``stop``), and no farther from what is measured (``now``) than its
rate allows in the time until the next command (``way``). ``base``, ``unit`` and ``spring`` make a command of an effort
x or a displacement d: base + unit x, or base + unit (d + spring x).
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.lanes import Variant

NO_BOUND = 1.0e15


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels that write the bounds of one kind of actuator each, in double precision."""
    real = variant.real
    wide = wp.float64
    module = variant.module("actuator")

    @wp.func
    def finite(value: real):
        """A bound that no arithmetic can overflow."""
        return wp.clamp(wide(value), -wide(wp.static(NO_BOUND)), wide(wp.static(NO_BOUND)))

    @wp.kernel(module=module, enable_backward=False)
    def cable_bounds(
        world_count: int,
        period: wide,
        # Model
        actuator: wp.array(dtype=wp.int32),
        cable: wp.array(dtype=wp.int32),
        cable_force_control: wp.array(dtype=wp.int32),
        # Workspace in
        min_displacement_in: wp.array3d(dtype=real),
        max_displacement_in: wp.array3d(dtype=real),
        min_tension_in: wp.array3d(dtype=real),
        max_tension_in: wp.array3d(dtype=real),
        max_rate_in: wp.array3d(dtype=real),
        displacement_in: wp.array3d(dtype=real),
        multiplier_in: wp.array3d(dtype=real),
        # Workspace out
        effort_low_out: wp.array2d(dtype=wide),
        effort_high_out: wp.array2d(dtype=wide),
        way_low_out: wp.array2d(dtype=wide),
        way_high_out: wp.array2d(dtype=wide),
        stop_low_out: wp.array2d(dtype=wide),
        stop_high_out: wp.array2d(dtype=wide),
        now_out: wp.array2d(dtype=wide),
    ):
        """A cable: tension and displacement. A slack one may shorten beyond its limit, as it does by itself."""
        pack, item, lane = wp.tid()
        world = pack * displacement_in.shape[2] + lane
        if world >= world_count:
            return
        c = cable[item]
        i = actuator[item]
        effort_low_out[world, i] = finite(min_tension_in[pack, c, lane])
        effort_high_out[world, i] = finite(max_tension_in[pack, c, lane])
        measured = finite(displacement_in[pack, c, lane])
        now_out[world, i] = measured
        low = finite(min_displacement_in[pack, c, lane])
        high = finite(max_displacement_in[pack, c, lane])
        reach = wp.min(finite(max_rate_in[pack, c, lane]) * period, wide(wp.static(NO_BOUND)))
        is_slack = wide(multiplier_in[pack, c, lane]) <= wide(0.0)
        if cable_force_control[c] != 0:
            low = -wide(wp.static(NO_BOUND))
            reach = wide(wp.static(NO_BOUND))
        elif is_slack and effort_low_out[world, i] >= wide(0.0):
            high = wp.max(high, measured + reach)
        stop_low_out[world, i] = low
        stop_high_out[world, i] = high
        way_low_out[world, i] = wp.min(wp.max(low, measured - reach), measured + reach)
        way_high_out[world, i] = wp.max(wp.min(high, measured + reach), measured - reach)

    return SimpleNamespace(cable_bounds=cable_bounds)
