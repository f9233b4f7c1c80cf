"""Frictionless, massless, inextensible cables through points of soft bodies. Theory: docs/theory/cable.md.

A cable of points p_0 .. p_m has length L = sum |p_j+1 - p_j| and displacement d = L0 - L (positive where it is pulled).
Its constraint row H = dd/dx has at point j the unit vector to the next point minus the one from the previous point,
spread to the nodes that carry the point; a tension T pulls the nodes with H' T. A segment of length l below the closing
length c counts (l^2 / c + c) / 2 and has l / c of a unit vector.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.algebra.vectors import algebra
from softwarp.model.codes import UNBOUNDED

AHEAD = 1.0e6  # m, target of a cable whose tension is imposed


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Cable kernels for one scalar type."""
    S = variant.S
    real = variant.real
    mul, div, sqrt = variant.mul, variant.div, variant.sqrt
    world_fastest = variant.world_fastest
    module = variant.module("cable")
    a = algebra(variant)
    vector, constant, read_vector = a.vector, a.constant, a.read_vector
    write_vector, add_vector = a.write_vector, a.add_vector
    add, subtract, scaled, product, dot, cross = a.add, a.subtract, a.scaled, a.product, a.dot, a.cross

    @wp.kernel(module=module, enable_backward=False)
    def cable_geometry(
        # Model
        cable_point_start: wp.array(dtype=wp.int32),
        point_node: wp.array2d(dtype=wp.int32),
        point_weight: wp.array2d(dtype=real),
        point_anchor: wp.array2d(dtype=real),
        cable_rest_length: wp.array(dtype=real),
        cable_closing_length: wp.array(dtype=real),
        # Workspace in
        node_x_in: wp.array2d(dtype=S),
        # Workspace out
        point_x_out: wp.array2d(dtype=S),
        point_gradient_out: wp.array2d(dtype=S),
        cable_displacement_out: wp.array2d(dtype=S),
    ):
        """Points, displacement and its gradient per point of one cable; anchors are added to the weighted nodes."""
        w, cable = wp.tid()
        if wp.static(world_fastest):
            cable, w = wp.tid()
        length = S(real(0.0))
        begin = cable_point_start[cable]
        end = cable_point_start[cable + 1]
        closing = S(cable_closing_length[cable])
        none = S(real(0.0))
        before = vector(none, none, none)
        for p in range(begin, end):
            x = constant(point_anchor, p, 0)
            for k in range(4):
                node = point_node[p, k]
                if node >= 0:
                    x = add(x, scaled(read_vector(node_x_in, w, 3 * node), S(point_weight[p, k])))
            write_vector(point_x_out, w, 3 * p, x)
            write_vector(point_gradient_out, w, 3 * p, vector(none, none, none))
            if p > begin:
                d = subtract(x, before)
                segment = sqrt(dot(d, d))
                least = wp.max(segment, closing)
                inverse = div(S(real(1.0)), least)
                length += segment + mul(mul(least - segment, least - segment), inverse) * real(0.5)
                d = scaled(d, inverse)
                add_vector(point_gradient_out, w, 3 * p - 3, d)
                write_vector(point_gradient_out, w, 3 * p, vector(-d.x, -d.y, -d.z))
            before = x
        cable_displacement_out[w, cable] = S(cable_rest_length[cable]) - length

    @wp.kernel(module=module, enable_backward=False)
    def cable_rows(
        # Model
        size: int,
        row_dof: wp.array(dtype=wp.int32),
        row_side: wp.array(dtype=wp.int32),
        row_start: wp.array(dtype=wp.int32),
        row_point: wp.array(dtype=wp.int32),
        row_weight: wp.array(dtype=real),
        row_item: wp.array(dtype=wp.int32),
        dof_free: wp.array2d(dtype=real),
        # Workspace in
        point_gradient_in: wp.array2d(dtype=S),
        lever_in: wp.array2d(dtype=S),
        # Workspace out
        row_out: wp.array2d(dtype=S),
        y_out: wp.array2d(dtype=S),
    ):
        """One 3-entry of H', and its place among the right-hand sides; rows cannot move what is prescribed.

        Where a frame carries the point, its rotation receives the moment of the gradient about its origin.
        """
        w, entry = wp.tid()
        if wp.static(world_fastest):
            entry, w = wp.tid()
        none = S(real(0.0))
        h = vector(none, none, none)
        for p in range(row_start[entry], row_start[entry + 1]):
            g = scaled(read_vector(point_gradient_in, w, 3 * row_point[p]), S(row_weight[p]))
            if row_item[p] >= 0:
                g = cross(read_vector(lever_in, w, 3 * row_item[p]), g)
            h = add(h, g)
        dof = row_dof[entry]
        write_vector(row_out, w, 3 * entry, h)
        write_vector(y_out, w, 3 * ((1 + row_side[entry]) * size + dof), product(h, constant(dof_free, dof, 0)))

    @wp.kernel(module=module, enable_backward=False)
    def cable_command(
        # Model
        cable_force_control: wp.array(dtype=wp.int32),
        cable_stretches: wp.array(dtype=wp.int32),
        # Workspace in
        displacement_command_in: wp.array2d(dtype=S),
        tension_command_in: wp.array2d(dtype=S),
        min_displacement_in: wp.array2d(dtype=S),
        max_displacement_in: wp.array2d(dtype=S),
        min_tension_in: wp.array2d(dtype=S),
        max_tension_in: wp.array2d(dtype=S),
        max_rate_in: wp.array2d(dtype=S),
        displacement_in: wp.array2d(dtype=S),
        lag_in: wp.array2d(dtype=S),
        h: real,
        # Workspace out
        target_out: wp.array2d(dtype=S),
        lower_out: wp.array2d(dtype=S),
        upper_out: wp.array2d(dtype=S),
    ):
        """Turn a command into a target displacement [m] and tension bounds [N].

        Length control clamps the target to the displacement limits and to the rate limit around the measured
        displacement; an inextensible cable leaves the part ``lag_in`` of its way to later stages. Force control clamps
        the tension to its limits and imposes it as the upper bound of a target that cannot be reached before
        ``max_displacement``, where the tension falls to what holds the cable there. The quasi-static mode, h <= 0, has
        no rate.
        """
        w, cable = wp.tid()
        if wp.static(world_fastest):
            cable, w = wp.tid()
        low = min_tension_in[w, cable]
        high = max_tension_in[w, cable]
        measured = displacement_in[w, cable]
        if cable_force_control[cable] != 0:
            lower_out[w, cable] = low
            upper_out[w, cable] = wp.min(wp.max(tension_command_in[w, cable], low), high)
            target_out[w, cable] = wp.min(max_displacement_in[w, cable], measured + S(real(wp.static(AHEAD))))
        else:
            target = wp.min(
                wp.max(displacement_command_in[w, cable], min_displacement_in[w, cable]),
                max_displacement_in[w, cable],
            )
            if cable_stretches[cable] == 0:
                target = target - mul(lag_in[w, 0], target - measured)
            reach = S(real(wp.static(UNBOUNDED)))
            if h > real(0.0):
                reach = max_rate_in[w, cable] * h
            target = wp.min(wp.max(target, measured - reach), measured + reach)
            target_out[w, cable] = target
            lower_out[w, cable] = low
            upper_out[w, cable] = high

    @wp.kernel(module=module, enable_backward=False)
    def stretch(
        # Model
        cable_force_control: wp.array(dtype=wp.int32),
        # Workspace in
        stiffness_in: wp.array2d(dtype=S),
        damping_in: wp.array2d(dtype=S),
        displacement_in: wp.array2d(dtype=S),
        h: real,
        # Workspace out
        target_out: wp.array2d(dtype=S),
        compliance_out: wp.array2d(dtype=S),
    ):
        """Elastic cables: T = k (d* - d) - c (d - d0) / h as a row of compliance 1 / (k + c / h) and its target."""
        w, cable = wp.tid()
        if wp.static(world_fastest):
            cable, w = wp.tid()
        if cable_force_control[cable] == 0:
            rate = S(real(0.0))
            if h > real(0.0):
                rate = div(damping_in[w, cable], S(h))
            inverse = div(S(real(1.0)), stiffness_in[w, cable] + rate)
            target = target_out[w, cable]
            target_out[w, cable] = target + mul(displacement_in[w, cable] - target, mul(rate, inverse))
            compliance_out[w, cable] = inverse

    @wp.kernel(module=module, enable_backward=False)
    def segment_stiffness(
        # Model
        cable_point_start: wp.array(dtype=wp.int32),
        point_cable: wp.array(dtype=wp.int32),
        cable_closing_length: wp.array(dtype=real),
        # Workspace in
        point_x_in: wp.array2d(dtype=S),
        tension_in: wp.array2d(dtype=S),
        # Workspace out
        segment_out: wp.array2d(dtype=S),
    ):
        """T/l (1 - u u') of the segment that ends in a point, as xx, xy, xz, yy, yz, zz [N/m]; 0 at a cable's start.

        T/c of a segment below the closing length c.
        """
        w, p = wp.tid()
        if wp.static(world_fastest):
            p, w = wp.tid()
        cable = point_cable[p]
        row = 6 * p
        if p == cable_point_start[cable]:
            for c in range(6):
                segment_out[w, row + c] = S(real(0.0))
        else:
            d0 = point_x_in[w, 3 * p] - point_x_in[w, 3 * p - 3]
            d1 = point_x_in[w, 3 * p + 1] - point_x_in[w, 3 * p - 2]
            d2 = point_x_in[w, 3 * p + 2] - point_x_in[w, 3 * p - 1]
            one = S(real(1.0))
            closing = S(cable_closing_length[cable])
            length = sqrt(mul(d0, d0) + mul(d1, d1) + mul(d2, d2))
            inverse = div(one, wp.max(length, closing))
            is_open = wp.max(wp.min((length - closing) * real(wp.static(UNBOUNDED)) + one, one), S(real(0.0)))
            d0 = mul(mul(d0, inverse), is_open)
            d1 = mul(mul(d1, inverse), is_open)
            d2 = mul(mul(d2, inverse), is_open)
            scale = mul(tension_in[w, cable], inverse)
            segment_out[w, row] = mul(scale, one - mul(d0, d0))
            segment_out[w, row + 1] = -mul(scale, mul(d0, d1))
            segment_out[w, row + 2] = -mul(scale, mul(d0, d2))
            segment_out[w, row + 3] = mul(scale, one - mul(d1, d1))
            segment_out[w, row + 4] = -mul(scale, mul(d1, d2))
            segment_out[w, row + 5] = mul(scale, one - mul(d2, d2))

    @wp.kernel(module=module, enable_backward=False)
    def block_stiffness(
        # Model
        coupling_start: wp.array(dtype=wp.int32),
        coupling_point: wp.array(dtype=wp.int32),
        coupling_weight: wp.array(dtype=real),
        # Workspace in
        segment_in: wp.array2d(dtype=S),
        # Workspace out
        a_out: wp.array2d(dtype=S),
    ):
        """Add the stiffness of all segments that tie two nodes together to one 3x3 block of A."""
        w, block = wp.tid()
        if wp.static(world_fastest):
            block, w = wp.tid()
        begin = coupling_start[block]
        end = coupling_start[block + 1]
        if begin < end:
            for r in range(3):
                for c in range(r, 3):
                    component = c + 2 * r - r // 2  # of xx, xy, xz, yy, yz, zz
                    total = S(real(0.0))
                    for p in range(begin, end):
                        total += segment_in[w, 6 * coupling_point[p] + component] * coupling_weight[p]
                    a_out[w, 9 * block + 3 * r + c] += total
                    if r != c:
                        a_out[w, 9 * block + 3 * c + r] += total

    return SimpleNamespace(
        cable_geometry=cable_geometry,
        cable_rows=cable_rows,
        cable_command=cable_command,
        stretch=stretch,
        segment_stiffness=segment_stiffness,
        block_stiffness=block_stiffness,
    )
