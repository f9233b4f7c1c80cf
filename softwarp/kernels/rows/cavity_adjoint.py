"""Adjoint of chambers in a step: what their rows make of commands, and their surfaces. Theory: docs/theory/adjoint.md.

With the displacement d = V / area, a row under volume or gas control obeys d + h H v + C T = target, where target and C
follow from the command and the volume at the start; ``measured`` is the sum of all gradients by d, the factor of H in
the gradient by positions. Arrays are those of ``rows.adjoint``.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.rows.cavity import EMPTY, RAREFACTION, SQUEEZE, STRIDE
from softwarp.model.codes import CavityControl


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type and memory order."""
    real = variant.real
    module = variant.module("adjoint.cavity")
    one = single.functions(variant)
    vec3, vector_at, put = one.vec3, one.vector_at, one.put

    @wp.kernel(module=module, enable_backward=False)
    def cavity_seed(
        lanes: int,
        first_row: int,
        # Model
        cavity_area: wp.array(dtype=real),
        # State
        pressure_bar_in: wp.array2d(dtype=real),
        # Workspace out
        force_bar_out: wp.array3d(dtype=real),
    ):
        """y_T of one chamber, whose row has the force pressure times area."""
        pack, cavity, lane = wp.tid()
        world = wp.min(pack * lanes + lane, pressure_bar_in.shape[0] - 1)
        force_bar_out[pack, first_row + cavity, lane] = pressure_bar_in[world, cavity] / cavity_area[cavity]

    @wp.func
    def volume_target(
        command: real, volume: real, low: real, high: real, lag: real, flow: real, way: real, grows: real
    ):
        """Slopes of the target of a row under volume control by the command and by the volume.

        ``way`` is what a linearisation goes at most, and ``grows`` its slope by the volume.
        """
        by_command = wp.where(command >= low and command <= high, real(1.0) - lag, real(0.0))
        by_volume = lag
        goal = wp.min(wp.max(command, low), high)
        goal = goal - lag * (goal - volume)
        if wp.abs(goal - volume) > flow:
            by_command = real(0.0)
            by_volume = real(1.0)
            goal = volume + wp.sign(goal - volume) * flow
        if wp.abs(goal - volume) > way:
            by_command = real(0.0)
            by_volume = real(1.0) + wp.sign(goal - volume) * grows
        return by_command, by_volume

    @wp.func
    def gas_slopes(goal: real, volume: real, ambient: real, exponent: real, pressure: real):
        """Slopes of target - C pressure - volume of a row under gas control by the goal and by the volume."""
        least = real(wp.static(EMPTY))
        gas = goal
        gas_by_goal = real(1.0)
        gas_by_volume = real(0.0)
        rare = wp.max(volume, least) * real(wp.static(RAREFACTION))
        if goal < rare:
            gas = rare
            gas_by_goal = real(0.0)
            gas_by_volume = wp.where(volume > least, real(wp.static(RAREFACTION)), real(0.0))
        dense = wp.max(volume, least)
        dense_by_gas = real(0.0)
        dense_by_volume = wp.where(volume > least, real(1.0), real(0.0))
        if dense < gas * real(wp.static(SQUEEZE)):
            dense = gas * real(wp.static(SQUEEZE))
            dense_by_gas = real(wp.static(SQUEEZE))
            dense_by_volume = real(0.0)
        absolute = ambient * wp.pow(gas / dense, exponent)
        beyond = (absolute - ambient - pressure) / absolute  # C of it, over dense / exponent
        by_gas = (dense / gas) * (real(1.0) - beyond)
        by_dense = (real(1.0) + exponent) / exponent * beyond - real(1.0)
        by_gas += by_dense * dense_by_gas
        return by_gas * gas_by_goal, by_gas * gas_by_volume + by_dense * dense_by_volume

    @wp.kernel(module=module, enable_backward=False)
    def cavity_command(
        h: real,
        lapse: real,
        lanes: int,
        first_row: int,
        is_stage: bool,
        # Model
        cavity_control: wp.array(dtype=wp.int32),
        cavity_area: wp.array(dtype=real),
        rest_volume: wp.array(dtype=real),
        # Workspace in
        pressure_command_in: wp.array3d(dtype=real),
        volume_command_in: wp.array3d(dtype=real),
        gas_command_in: wp.array3d(dtype=real),
        min_pressure_in: wp.array3d(dtype=real),
        max_pressure_in: wp.array3d(dtype=real),
        min_volume_in: wp.array3d(dtype=real),
        max_volume_in: wp.array3d(dtype=real),
        max_pressure_rate_in: wp.array3d(dtype=real),
        max_flow_in: wp.array3d(dtype=real),
        ambient_in: wp.array3d(dtype=real),
        exponent_in: wp.array3d(dtype=real),
        pressure_in: wp.array3d(dtype=real),
        start_volume_in: wp.array3d(dtype=real),
        volume_in: wp.array3d(dtype=real),
        goal_in: wp.array3d(dtype=real),
        lag_in: wp.array3d(dtype=real),
        multiplier_in: wp.array3d(dtype=real),
        q_in: wp.array3d(dtype=real),
        bound_bar_in: wp.array3d(dtype=real),
        # State out
        pressure_command_bar_out: wp.array2d(dtype=real),
        volume_command_bar_out: wp.array2d(dtype=real),
        gas_command_bar_out: wp.array2d(dtype=real),
        pressure_bar_out: wp.array2d(dtype=real),
        # Workspace out
        measured_out: wp.array3d(dtype=real),
        start_out: wp.array3d(dtype=real),
    ):
        """Gradients by the commands of one chamber and by its pressure before the step, and ``measured``.

        A commanded pressure counts where no limit and no rate in the time ``lapse`` [s] overrules it, a volume and a
        gas likewise with the flow in the step ``h`` [s]. What a rate has bounded moves with the pressure or the volume
        at the start instead, and so does the target of a volume that is too far for one linearisation. A stage has its
        rows elsewhere than where it starts: ``start`` is the factor of the volume's gradient there.
        """
        pack, cavity, lane = wp.tid()
        world = pack * lanes + lane
        none = real(0.0)
        row = first_row + cavity
        area = cavity_area[cavity]
        low = min_pressure_in[pack, cavity, lane]
        high = max_pressure_in[pack, cavity, lane]
        q = q_in[pack, row, lane]
        pressure = pressure_in[pack, cavity, lane]
        before = start_volume_in[pack, cavity, lane]
        volume = volume_in[pack, cavity, lane]
        flow = max_flow_in[pack, cavity, lane] * h
        by_pressure_command = none
        by_volume_command = none
        by_gas_command = none
        by_pressure = none
        measured = none
        start = none
        control = cavity_control[cavity]
        if control == wp.static(CavityControl.PRESSURE):
            command = pressure_command_in[pack, cavity, lane]
            way = wp.min(wp.max(command, low), high) - pressure
            value = bound_bar_in[pack, row, lane] * area
            if wp.abs(way) > max_pressure_rate_in[pack, cavity, lane] * lapse:
                by_pressure = value
            elif command >= low and command <= high:
                by_pressure_command = value
        if control == wp.static(CavityControl.VOLUME):
            rest = rest_volume[cavity]
            stride = real(wp.static(STRIDE))
            by_command, by_volume = volume_target(
                volume_command_in[pack, cavity, lane],
                before,
                min_volume_in[pack, cavity, lane],
                max_volume_in[pack, cavity, lane],
                lag_in[pack, 0, lane],
                flow,
                wp.max(before, rest) * stride,
                wp.where(before > rest, stride, none),
            )
            by_volume_command = q / area * by_command
            measured = -q
            start = q * by_volume
        if control == wp.static(CavityControl.GAS):
            ambient = ambient_in[pack, cavity, lane]
            exponent = exponent_in[pack, cavity, lane]
            found = multiplier_in[pack, row, lane] / area
            goal = goal_in[pack, cavity, lane]
            by_goal, by_volume = gas_slopes(goal, volume, ambient, exponent, found)
            if gas_command_in[pack, cavity, lane] == goal:
                by_gas_command = q / area * by_goal
            elif pressure + ambient > none:  # a flow has bounded it, around what the chamber holds
                held = before * wp.pow((pressure + ambient) / ambient, real(1.0) / exponent)
                by_pressure = q / area * by_goal * held / (exponent * (pressure + ambient))
                start = q * by_goal * held / before
            measured = q * by_volume
        if not is_stage:
            measured += start
        measured_out[pack, row, lane] = measured
        start_out[pack, row, lane] = start
        if world < pressure_bar_out.shape[0]:
            pressure_command_bar_out[world, cavity] = by_pressure_command
            volume_command_bar_out[world, cavity] = by_volume_command
            gas_command_bar_out[world, cavity] = by_gas_command
            pressure_bar_out[world, cavity] = by_pressure

    @wp.kernel(module=module, enable_backward=False)
    def cavity_points(
        first_point: int,
        first_row: int,
        # Model
        ring_start: wp.array(dtype=wp.int32),
        point_ring: wp.array2d(dtype=wp.int32),
        point_cavity: wp.array(dtype=wp.int32),
        cavity_area: wp.array(dtype=real),
        # Workspace in
        point_x_in: wp.array3d(dtype=real),
        point_gradient_in: wp.array3d(dtype=real),
        way_in: wp.array3d(dtype=real),
        measured_in: wp.array3d(dtype=real),
        # Workspace out
        point_bar_out: wp.array3d(dtype=real),
    ):
        """Gradient by one point of a chamber's surface, whose row has the gradient sum (b - x) x (c - x) / 6 area."""
        pack, item, lane = wp.tid()
        point = first_point + item
        cavity = point_cavity[item]
        x = vector_at(point_x_in, pack, lane, 3 * point)
        dx = vector_at(way_in, pack, lane, 3 * point)
        total = vec3()
        for r in range(ring_start[item], ring_start[item + 1]):
            b = 3 * point_ring[r, 0]
            c = 3 * point_ring[r, 1]
            total += wp.cross(vector_at(way_in, pack, lane, b) - dx, vector_at(point_x_in, pack, lane, c) - x)
            total += wp.cross(vector_at(point_x_in, pack, lane, b) - x, vector_at(way_in, pack, lane, c) - dx)
        total = total / (real(6.0) * cavity_area[cavity])
        total += measured_in[pack, first_row + cavity, lane] * vector_at(point_gradient_in, pack, lane, 3 * point)
        put(point_bar_out, pack, lane, 3 * point, total)

    @wp.kernel(module=module, enable_backward=False)
    def tangent_edges(
        # Model
        edge_start: wp.array(dtype=wp.int32),
        edge_block: wp.array(dtype=wp.int32),
        edge_weight: wp.array(dtype=real),
        block_row: wp.array(dtype=wp.int32),
        block_col: wp.array(dtype=wp.int32),
        # Workspace in
        dof_v_in: wp.array3d(dtype=real),
        start_v_in: wp.array3d(dtype=real),
        dof_p_in: wp.array3d(dtype=real),
        # Workspace out
        edge_bar_out: wp.array3d(dtype=real),
    ):
        """Gradient by the vector s of one surface edge, with which the tangent of pressures has blocks [s]x in A.

        A block (i, j) and its transpose give -p . A u the part -s . (u_j x p_i + p_j x u_i), with the unknowns
        u = v - v0 of a step that is linearised with the velocities v0.
        """
        pack, edge, lane = wp.tid()
        total = vec3()
        for k in range(edge_start[edge], edge_start[edge + 1]):
            i = 3 * block_row[edge_block[k]]
            j = 3 * block_col[edge_block[k]]
            first = vector_at(dof_v_in, pack, lane, i) - vector_at(start_v_in, pack, lane, i)
            second = vector_at(dof_v_in, pack, lane, j) - vector_at(start_v_in, pack, lane, j)
            here = wp.cross(second, vector_at(dof_p_in, pack, lane, i))
            here += wp.cross(vector_at(dof_p_in, pack, lane, j), first)
            total -= edge_weight[k] * here
        put(edge_bar_out, pack, lane, 3 * edge, total)

    @wp.kernel(module=module, enable_backward=False)
    def tangent_points(
        square: real,
        first_point: int,
        # Model
        point_edge_start: wp.array(dtype=wp.int32),
        point_edge: wp.array(dtype=wp.int32),
        point_side: wp.array(dtype=real),
        point_cavity: wp.array(dtype=wp.int32),
        # Workspace in
        edge_bar_in: wp.array3d(dtype=real),
        pressure_in: wp.array3d(dtype=real),
        # Workspace out
        point_bar_out: wp.array3d(dtype=real),
    ):
        """Add the gradient by one point, which s = h^2 p0 (x_k - x_l) / 6 of the edges that it is opposite to has."""
        pack, item, lane = wp.tid()
        point = 3 * (first_point + item)
        factor = square / real(6.0) * pressure_in[pack, point_cavity[item], lane]
        total = vector_at(point_bar_out, pack, lane, point)
        for k in range(point_edge_start[item], point_edge_start[item + 1]):
            total += factor * point_side[k] * vector_at(edge_bar_in, pack, lane, 3 * point_edge[k])
        put(point_bar_out, pack, lane, point, total)

    @wp.kernel(module=module, enable_backward=False)
    def tangent_pressure(
        square: real,
        lanes: int,
        # Model
        edge_cavity: wp.array(dtype=wp.int32),
        edge_opposite: wp.array2d(dtype=wp.int32),
        # Workspace in
        point_x_in: wp.array3d(dtype=real),
        edge_bar_in: wp.array3d(dtype=real),
        # State out
        pressure_bar_out: wp.array2d(dtype=real),
    ):
        """Add the gradient by the pressure of one chamber at the start of the step, which the tangent has."""
        pack, cavity, lane = wp.tid()
        world = pack * lanes + lane
        if world < pressure_bar_out.shape[0]:
            total = real(0.0)
            for edge in range(edge_cavity.shape[0]):
                if edge_cavity[edge] == cavity:
                    across = vector_at(point_x_in, pack, lane, 3 * edge_opposite[edge, 0])
                    across = across - vector_at(point_x_in, pack, lane, 3 * edge_opposite[edge, 1])
                    total += wp.dot(across, vector_at(edge_bar_in, pack, lane, 3 * edge))
            pressure_bar_out[world, cavity] = pressure_bar_out[world, cavity] + square / real(6.0) * total

    return SimpleNamespace(
        cavity_seed=cavity_seed,
        cavity_command=cavity_command,
        cavity_points=cavity_points,
        tangent_edges=tangent_edges,
        tangent_points=tangent_points,
        tangent_pressure=tangent_pressure,
    )
