"""Directional derivatives of a step: what bodies and nodes add to its right-hand side. Theory: docs/theory/adjoint.md.

With slopes of everything that a step reads, its unknowns have the slopes dv of

    A dv - h H' dT = M dv0 + dM (v0 - (1 + h a) v) - h da M v + h (df + dW) + elements and rows,

where W is the weight of nodes. Slopes are named after what they are of. State arrays are ``[world, row]``; workspace
arrays ``[pack, row, lane]``.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type and memory order."""
    real = variant.real
    module = variant.module("directional.step")
    one = single.functions(variant)
    vector_at, put = one.vector_at, one.put

    @wp.kernel(module=module, enable_backward=False)
    def bodies(
        h: real,
        # Workspace in
        youngs_in: wp.array3d(dtype=real),
        nu_in: wp.array3d(dtype=real),
        youngs_slope_in: wp.array3d(dtype=real),
        nu_slope_in: wp.array3d(dtype=real),
        damping_slope_in: wp.array3d(dtype=real),
        # Workspace out
        mu_slope_out: wp.array3d(dtype=real),
        lam_slope_out: wp.array3d(dtype=real),
        stiffness_slope_out: wp.array3d(dtype=real),
    ):
        """Slopes of the Lame constants of one body, mu = E / 2(1 + nu) and lam = E nu / D, and of k = h (h + beta)."""
        pack, body, lane = wp.tid()
        youngs = youngs_in[pack, body, lane]
        nu = nu_in[pack, body, lane]
        dE = youngs_slope_in[pack, body, lane]
        dnu = nu_slope_in[pack, body, lane]
        unit = real(1.0)
        two = real(2.0)
        D = (unit + nu) * (unit - two * nu)
        mu_slope_out[pack, body, lane] = (dE - youngs * dnu / (unit + nu)) / (two * (unit + nu))
        lam_slope_out[pack, body, lane] = dE * nu / D + youngs * dnu * (unit + two * nu * nu) / (D * D)
        stiffness_slope_out[pack, body, lane] = h * damping_slope_in[pack, body, lane]

    @wp.kernel(module=module, enable_backward=False)
    def momenta(
        h: real,
        node_count: int,
        # Model
        dof_node: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        # Workspace in
        density_in: wp.array3d(dtype=real),
        body_mass_in: wp.array3d(dtype=real),
        v0_in: wp.array3d(dtype=real),
        dof_v_in: wp.array3d(dtype=real),
        density_slope_in: wp.array3d(dtype=real),
        damping_slope_in: wp.array3d(dtype=real),
        v_slope_in: wp.array3d(dtype=real),
        # Workspace out
        dof_out: wp.array3d(dtype=real),
    ):
        """Momentum per volume that one dof gains: rho dv0 + drho (v0 - (1 + h alpha) v) - h dalpha rho v."""
        pack, dof, lane = wp.tid()
        node = dof_node[dof]
        for c in range(3):
            value = real(0.0)
            if node < node_count:  # else it is of a frame
                body = node_body[node]
                rho = density_in[pack, body, lane]
                v = dof_v_in[pack, 3 * dof + c, lane]
                lost = v0_in[pack, 3 * node + c, lane] - body_mass_in[pack, body, lane] * v
                value = rho * v_slope_in[pack, 3 * node + c, lane] + density_slope_in[pack, body, lane] * lost
                value -= h * damping_slope_in[pack, body, lane] * rho * v
            dof_out[pack, 3 * dof + c, lane] = value

    @wp.kernel(module=module, enable_backward=False)
    def right_side(
        h: real,
        node_count: int,
        # Model
        dof_node: wp.array(dtype=wp.int32),
        dof_free: wp.array2d(dtype=real),
        node_body: wp.array(dtype=wp.int32),
        node_heft: wp.array(dtype=real),
        # Workspace in
        density_in: wp.array3d(dtype=real),
        gravity_in: wp.array3d(dtype=real),
        density_slope_in: wp.array3d(dtype=real),
        gravity_slope_in: wp.array3d(dtype=real),
        force_slope_in: wp.array3d(dtype=real),
        node_momentum_in: wp.array3d(dtype=real),
        node_sum_in: wp.array3d(dtype=real),
        # Workspace out
        side_out: wp.array3d(dtype=real),
    ):
        """Right-hand side of one dof from what its node has; 0 at prescribed scalars."""
        pack, dof, lane = wp.tid()
        node = dof_node[dof]
        for c in range(3):
            value = real(0.0)
            if node < node_count:
                body = node_body[node]
                row = 3 * node + c
                weight = density_in[pack, body, lane] * gravity_slope_in[pack, c, lane]
                weight += density_slope_in[pack, body, lane] * gravity_in[pack, c, lane]
                value = h * (force_slope_in[pack, row, lane] + node_heft[node] * weight)
                value += node_momentum_in[pack, row, lane] + node_sum_in[pack, row, lane]
            side_out[pack, 3 * dof + c, lane] = value * dof_free[dof, c]

    @wp.kernel(module=module, enable_backward=False)
    def arrive(
        h: real,
        lanes: int,
        # Model
        node_dof: wp.array(dtype=wp.int32),
        # Workspace in
        dof_slope_in: wp.array3d(dtype=real),
        # State out
        x_slope_out: wp.array2d(dtype=real),
        v_slope_out: wp.array2d(dtype=real),
    ):
        """Slopes of one node's velocity and position at the end of the step; x += h v."""
        pack, node, lane = wp.tid()
        world = pack * lanes + lane
        if world < x_slope_out.shape[0]:
            dof = node_dof[node]
            for c in range(3):
                value = real(0.0)
                if dof >= 0:
                    value = dof_slope_in[pack, 3 * dof + c, lane]
                v_slope_out[world, 3 * node + c] = value
                x_slope_out[world, 3 * node + c] = x_slope_out[world, 3 * node + c] + h * value

    @wp.kernel(module=module, enable_backward=False)
    def pressed_dofs(
        square: real,
        # Model
        dof_pressed_start: wp.array(dtype=wp.int32),
        pressed_edge: wp.array(dtype=wp.int32),
        pressed_dof: wp.array(dtype=wp.int32),
        pressed_weight: wp.array(dtype=real),
        edge_cavity: wp.array(dtype=wp.int32),
        edge_opposite: wp.array2d(dtype=wp.int32),
        dof_free: wp.array2d(dtype=real),
        # Workspace in
        point_x_in: wp.array3d(dtype=real),
        point_slope_in: wp.array3d(dtype=real),
        pressure_in: wp.array3d(dtype=real),
        pressure_slope_in: wp.array3d(dtype=real),
        dof_v_in: wp.array3d(dtype=real),
        # Workspace out
        side_out: wp.array3d(dtype=real),
    ):
        """Take from one dof what the tangent of pressures gains: blocks [ds]x with s = h^2 p0 (x_k - x_l) / 6."""
        pack, dof, lane = wp.tid()
        total = vector_at(side_out, pack, lane, 3 * dof)
        for n in range(dof_pressed_start[dof], dof_pressed_start[dof + 1]):
            edge = pressed_edge[n]
            cavity = edge_cavity[edge]
            k = 3 * edge_opposite[edge, 0]
            j = 3 * edge_opposite[edge, 1]
            way = vector_at(point_x_in, pack, lane, k) - vector_at(point_x_in, pack, lane, j)
            change = vector_at(point_slope_in, pack, lane, k) - vector_at(point_slope_in, pack, lane, j)
            change = pressure_in[pack, cavity, lane] * change + pressure_slope_in[pack, cavity, lane] * way
            v = vector_at(dof_v_in, pack, lane, 3 * pressed_dof[n])
            total -= (square / real(6.0) * pressed_weight[n]) * wp.cross(change, v)
        for c in range(3):
            total[c] = total[c] * dof_free[dof, c]
        put(side_out, pack, lane, 3 * dof, total)

    return SimpleNamespace(
        bodies=bodies, momenta=momenta, right_side=right_side, arrive=arrive, pressed_dofs=pressed_dofs
    )
