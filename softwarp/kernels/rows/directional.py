"""Directional derivatives of rows in a step: what their forces and targets change by. Theory: docs/theory/adjoint.md.

A row between its bounds obeys d + h H v + C T = target. With slopes of what it reads, q = -dT obeys

    -h H dv + C q = -S,   S = dtarget - H dx - h dH v - dC T,

the equation that ``adjoint`` has for q, with -S for the gradient by the force. A row at a bound has dT = S, the slope
of that bound. What S has of commands and constants is diagonal: ``adjoint`` finds its factors from q = 1. Rows push on
the dofs with h dH' T more, dH = d2d/dx2 [dx]. All arrays but those of the state are single worlds'.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type and memory order."""
    real = variant.real
    module = variant.module("directional.rows")
    one = single.functions(variant)
    vec3, vector_at, put = one.vec3, one.vector_at, one.put

    @wp.kernel(module=module, enable_backward=False)
    def units(
        # Workspace in
        active_in: wp.array3d(dtype=wp.int32),
        # Workspace out
        q_out: wp.array3d(dtype=real),
        bound_out: wp.array3d(dtype=real),
    ):
        """Gradients of 1 by the target of one row, or by the bound that holds it."""
        pack, row, lane = wp.tid()
        is_active = active_in[pack, row, lane] != 0
        q_out[pack, row, lane] = wp.where(is_active, real(1.0), real(0.0))
        bound_out[pack, row, lane] = wp.where(is_active, real(0.0), real(1.0))

    @wp.kernel(module=module, enable_backward=False)
    def add_product(
        lanes: int,
        first_row: int,
        # State
        factor_in: wp.array2d(dtype=real),
        slope_in: wp.array2d(dtype=real),
        # Workspace out
        row_out: wp.array3d(dtype=real),
    ):
        """S of one row += the factor of an input times its slope."""
        pack, item, lane = wp.tid()
        world = wp.min(pack * lanes + lane, slope_in.shape[0] - 1)
        row = first_row + item
        row_out[pack, row, lane] = row_out[pack, row, lane] + factor_in[world, item] * slope_in[world, item]

    @wp.kernel(module=module, enable_backward=False)
    def points(
        # Model
        point_node: wp.array2d(dtype=wp.int32),
        point_weight: wp.array2d(dtype=real),
        # Workspace in
        node_in: wp.array3d(dtype=real),
        # Workspace out
        point_out: wp.array3d(dtype=real),
    ):
        """Of one point, what the nodes around it have."""
        pack, point, lane = wp.tid()
        total = vec3()
        for k in range(4):
            node = point_node[point, k]
            if node >= 0:
                total += point_weight[point, k] * vector_at(node_in, pack, lane, 3 * node)
        put(point_out, pack, lane, 3 * point, total)

    @wp.kernel(module=module, enable_backward=False)
    def sums(
        h: real,
        # Model
        row_point_start: wp.array(dtype=wp.int32),
        # Workspace in
        active_in: wp.array3d(dtype=wp.int32),
        measured_in: wp.array3d(dtype=real),
        point_gradient_in: wp.array3d(dtype=real),
        gradient_slope_in: wp.array3d(dtype=real),
        point_slope_in: wp.array3d(dtype=real),
        point_v_in: wp.array3d(dtype=real),
        row_in: wp.array3d(dtype=real),
        # Workspace out
        force_out: wp.array3d(dtype=real),
        bound_out: wp.array3d(dtype=real),
    ):
        """-S of one row between its bounds, else the slope of its bound; ``measured`` is the factor of H dx."""
        pack, row, lane = wp.tid()
        measured = measured_in[pack, row, lane]
        value = row_in[pack, row, lane]
        is_active = active_in[pack, row, lane] != 0
        if is_active:
            for point in range(row_point_start[row], row_point_start[row + 1]):
                gradient = vector_at(point_gradient_in, pack, lane, 3 * point)
                value += measured * wp.dot(gradient, vector_at(point_slope_in, pack, lane, 3 * point))
                turned = vector_at(gradient_slope_in, pack, lane, 3 * point)
                value -= h * wp.dot(turned, vector_at(point_v_in, pack, lane, 3 * point))
        force_out[pack, row, lane] = wp.where(is_active, -value, real(0.0))
        bound_out[pack, row, lane] = wp.where(is_active, real(0.0), value)

    @wp.kernel(module=module, enable_backward=False)
    def point_forces(
        h: real,
        # Model
        point_row: wp.array(dtype=wp.int32),
        # Workspace in
        multiplier_in: wp.array3d(dtype=real),
        gradient_slope_in: wp.array3d(dtype=real),
        # Workspace out
        point_out: wp.array3d(dtype=real),
    ):
        """h T dH of one point."""
        pack, point, lane = wp.tid()
        factor = h * multiplier_in[pack, point_row[point], lane]
        put(point_out, pack, lane, 3 * point, factor * vector_at(gradient_slope_in, pack, lane, 3 * point))

    @wp.kernel(module=module, enable_backward=False)
    def forces(
        lanes: int,
        first_row: int,
        # Model
        area: wp.array(dtype=real),
        # Workspace in
        q_in: wp.array3d(dtype=real),
        bound_in: wp.array3d(dtype=real),
        # State out
        slope_out: wp.array2d(dtype=real),
    ):
        """Slope of one tension, or, where there are areas, of one pressure."""
        pack, item, lane = wp.tid()
        world = pack * lanes + lane
        if world < slope_out.shape[0]:
            value = bound_in[pack, first_row + item, lane] - q_in[pack, first_row + item, lane]
            if area.shape[0] > 0:
                value = value / area[item]
            slope_out[world, item] = value

    return SimpleNamespace(
        units=units, add_product=add_product, points=points, sums=sums, point_forces=point_forces, forces=forces
    )
