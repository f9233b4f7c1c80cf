"""Bounds of actuators for inverse control, from their limits and rates. Theory: docs/theory/inverse.md.

Every actuator is a row of multipliers: effort in newtons, displacement in metres. Where a displacement is commanded,
the command may lie between the actuator's limits (``stop``), and no farther from what is measured (``now``) than its
rate allows in the time until the next command (``way``). ``base``, ``unit`` and ``spring`` make a command of an effort
x or a displacement d: base + unit x, or base + unit (d + spring x).
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.model.codes import FAR, RIGID_SERVO, CavityControl, JointControl


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels that write the bounds of one kind of actuator each, in double precision."""
    real = variant.real
    wide = wp.float64
    module = variant.module("actuator")

    @wp.func
    def finite(value: real):
        """A bound that no arithmetic can overflow."""
        return wp.clamp(wide(value), -wide(wp.static(FAR)), wide(wp.static(FAR)))

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
        unit_out: wp.array2d(dtype=wide),
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
        unit_out[world, i] = wide(1.0)
        low = finite(min_displacement_in[pack, c, lane])
        high = finite(max_displacement_in[pack, c, lane])
        reach = wp.min(finite(max_rate_in[pack, c, lane]) * period, wide(wp.static(FAR)))
        is_slack = wide(multiplier_in[pack, c, lane]) <= wide(0.0)
        if cable_force_control[c] != 0:
            low = -wide(wp.static(FAR))
            reach = wide(wp.static(FAR))
        elif is_slack and effort_low_out[world, i] >= wide(0.0):
            high = wp.max(high, measured + reach)
        stop_low_out[world, i] = wp.where(cable_force_control[c] != 0, effort_low_out[world, i], low)
        stop_high_out[world, i] = wp.where(cable_force_control[c] != 0, effort_high_out[world, i], high)
        way_low_out[world, i] = wp.min(wp.max(low, measured - reach), measured + reach)
        way_high_out[world, i] = wp.max(wp.min(high, measured + reach), measured - reach)

    @wp.kernel(module=module, enable_backward=False)
    def chamber_bounds(
        world_count: int,
        period: wide,
        first_row: int,
        # Model
        actuator: wp.array(dtype=wp.int32),
        cavity: wp.array(dtype=wp.int32),
        cavity_control: wp.array(dtype=wp.int32),
        cavity_area: wp.array(dtype=real),
        # Workspace in
        min_pressure_in: wp.array3d(dtype=real),
        max_pressure_in: wp.array3d(dtype=real),
        max_pressure_rate_in: wp.array3d(dtype=real),
        min_volume_in: wp.array3d(dtype=real),
        max_volume_in: wp.array3d(dtype=real),
        max_flow_in: wp.array3d(dtype=real),
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
        unit_out: wp.array2d(dtype=wide),
    ):
        """A chamber: pressure times area and volume over area; the commanded one of them has stops and a rate."""
        pack, item, lane = wp.tid()
        world = pack * displacement_in.shape[2] + lane
        if world >= world_count:
            return
        c = cavity[item]
        i = actuator[item]
        area = wide(cavity_area[c])
        none = wide(wp.static(FAR))
        low = finite(min_pressure_in[pack, c, lane]) * area
        high = finite(max_pressure_in[pack, c, lane]) * area
        measured = wide(displacement_in[pack, first_row + c, lane])
        if cavity_control[c] == wp.static(CavityControl.PRESSURE):
            now = wide(multiplier_in[pack, first_row + c, lane])
            reach = finite(max_pressure_rate_in[pack, c, lane]) * period * area
            effort_low_out[world, i] = wp.min(wp.max(low, now - reach), now + reach)
            effort_high_out[world, i] = wp.max(wp.min(high, now + reach), now - reach)
            stop_low_out[world, i] = low
            stop_high_out[world, i] = high
            way_low_out[world, i] = -none
            way_high_out[world, i] = none
            unit_out[world, i] = wide(1.0) / area
        else:
            reach = finite(max_flow_in[pack, c, lane]) * period / area
            stop_low_out[world, i] = finite(min_volume_in[pack, c, lane]) / area
            stop_high_out[world, i] = finite(max_volume_in[pack, c, lane]) / area
            effort_low_out[world, i] = low
            effort_high_out[world, i] = high
            way_low_out[world, i] = wp.min(wp.max(stop_low_out[world, i], measured - reach), measured + reach)
            way_high_out[world, i] = wp.max(wp.min(stop_high_out[world, i], measured + reach), measured - reach)
            unit_out[world, i] = area
        now_out[world, i] = measured

    @wp.kernel(module=module, enable_backward=False)
    def joint_bounds(
        world_count: int,
        period: wide,
        # Model
        actuator: wp.array(dtype=wp.int32),
        joint: wp.array(dtype=wp.int32),
        joint_control: wp.array(dtype=wp.int32),
        joint_scale: wp.array(dtype=real),
        # Workspace in
        stiffness_in: wp.array3d(dtype=real),
        max_force_in: wp.array3d(dtype=real),
        max_rate_in: wp.array3d(dtype=real),
        min_position_in: wp.array3d(dtype=real),
        max_position_in: wp.array3d(dtype=real),
        position_in: wp.array3d(dtype=real),
        force_command_in: wp.array3d(dtype=real),
        # Workspace out
        effort_low_out: wp.array2d(dtype=wide),
        effort_high_out: wp.array2d(dtype=wide),
        way_low_out: wp.array2d(dtype=wide),
        way_high_out: wp.array2d(dtype=wide),
        stop_low_out: wp.array2d(dtype=wide),
        stop_high_out: wp.array2d(dtype=wide),
        now_out: wp.array2d(dtype=wide),
        base_out: wp.array2d(dtype=wide),
        spring_out: wp.array2d(dtype=wide),
        unit_out: wp.array2d(dtype=wide),
    ):
        """A motor: the way along its free coordinate counts from where it is.

        A servo of finite stiffness is told a reference beyond the way by what its spring takes.
        """
        pack, item, lane = wp.tid()
        world = pack * position_in.shape[2] + lane
        if world >= world_count:
            return
        j = joint[item]
        i = actuator[item]
        scale = wide(joint_scale[j])
        q = wide(position_in[pack, j, lane])
        limit = finite(max_force_in[pack, j, lane]) / scale
        effort_low_out[world, i] = -limit
        effort_high_out[world, i] = limit
        stop_low_out[world, i] = (finite(min_position_in[pack, j, lane]) - q) * scale
        stop_high_out[world, i] = (finite(max_position_in[pack, j, lane]) - q) * scale
        reach = finite(max_rate_in[pack, j, lane]) * period * scale
        start = wide(0.0)
        spring_out[world, i] = wide(0.0)
        base_out[world, i] = wide(0.0)
        unit_out[world, i] = scale
        control = joint_control[j]
        if control == wp.static(JointControl.POSITION):
            base_out[world, i] = q
            unit_out[world, i] = wide(1.0) / scale
            stiffness = wide(stiffness_in[pack, j, lane])
            if stiffness < wide(wp.static(RIGID_SERVO)):
                spring_out[world, i] = scale * scale / stiffness
                base_out[world, i] = q - wide(force_command_in[pack, j, lane]) / stiffness
        elif control == wp.static(JointControl.VELOCITY):
            unit_out[world, i] = wide(1.0) / (scale * period)
        else:
            reach = wide(wp.static(FAR))
        way_low_out[world, i] = wp.min(wp.max(stop_low_out[world, i], start - reach), start + reach)
        way_high_out[world, i] = wp.max(wp.min(stop_high_out[world, i], start + reach), start - reach)
        now_out[world, i] = start
        if control == wp.static(JointControl.FORCE):
            stop_low_out[world, i] = -limit
            stop_high_out[world, i] = limit

    return SimpleNamespace(cable_bounds=cable_bounds, chamber_bounds=chamber_bounds, joint_bounds=joint_bounds)
