"""Adjoint of a stage of BDF2, a backward Euler step that is linearised where the start velocities lead to.

With x = x0 + h v0, k = h (h + beta) and m = 1 + h alpha a stage solves, for the velocities v at its end,

    m M v + K(x) (k v - h^2 v0) = M v0 - h f(x) + h f_ext + h H(x)' T,      d(x) + h H(x) (v - v0) + C T = target,

so that elements have v - h^2 / k v0 in the place of v, rows v - v0, and the velocities of the start count three times:
by M, by x, and by K and H. With s = A p, the seed less h H' q, K p is (s - m M p) / k. Theory: docs/theory/adjoint.md.
State arrays are ``[world, row]``; workspace arrays ``[pack, row, lane]``.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type and memory order."""
    real = variant.real
    module = variant.module("adjoint.stage")
    one = single.functions(variant)
    vec3, vector_at, put = one.vec3, one.vector_at, one.put

    @wp.kernel(module=module, enable_backward=False)
    def velocities(
        h: real,
        # Model
        node_dof: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        # Workspace in
        beta_in: wp.array3d(dtype=real),
        node_v_in: wp.array3d(dtype=real),
        start_v_in: wp.array3d(dtype=real),
        # Workspace out
        element_v_out: wp.array3d(dtype=real),
        row_v_out: wp.array3d(dtype=real),
    ):
        """What elements and rows have in the place of the velocity of one node; ``start_v_in`` is of dofs."""
        pack, node, lane = wp.tid()
        v = vector_at(node_v_in, pack, lane, 3 * node)
        dof = node_dof[node]
        v0 = vec3()
        if dof >= 0:
            v0 = vector_at(start_v_in, pack, lane, 3 * dof)
        share = h / (h + beta_in[pack, node_body[node], lane])
        put(element_v_out, pack, lane, 3 * node, v - share * v0)
        put(row_v_out, pack, lane, 3 * node, v - v0)

    @wp.kernel(module=module, enable_backward=False)
    def start_points(
        # Model
        point_cable: wp.array(dtype=wp.int32),
        # Workspace in
        point_gradient_in: wp.array3d(dtype=real),
        start_in: wp.array3d(dtype=real),
        # Workspace out
        point_bar_out: wp.array3d(dtype=real),
    ):
        """Gradient by one point of a cable where the stage started, by its displacement there."""
        pack, point, lane = wp.tid()
        here = vector_at(point_gradient_in, pack, lane, 3 * point)
        put(point_bar_out, pack, lane, 3 * point, start_in[pack, point_cable[point], lane] * here)

    @wp.kernel(module=module, enable_backward=False)
    def nodes(
        h: real,
        lanes: int,
        cable_points: int,
        # Model
        node_dof: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        dof_free: wp.array2d(dtype=real),
        node_point_start: wp.array(dtype=wp.int32),
        node_point: wp.array(dtype=wp.int32),
        node_point_weight: wp.array(dtype=real),
        # Workspace in
        density_in: wp.array3d(dtype=real),
        beta_in: wp.array3d(dtype=real),
        body_mass_in: wp.array3d(dtype=real),
        seed_in: wp.array3d(dtype=real),
        pushed_in: wp.array3d(dtype=real),
        node_p_in: wp.array3d(dtype=real),
        node_mass_p_in: wp.array3d(dtype=real),
        node_bar_in: wp.array3d(dtype=real),
        point_bar_in: wp.array3d(dtype=real),
        # State out
        x_bar_out: wp.array2d(dtype=real),
        v_bar_out: wp.array2d(dtype=real),
        force_bar_out: wp.array2d(dtype=real),
    ):
        """Gradients by the position, the velocity and the force of one node at the start of the stage.

        ``node_bar_in`` is that by x, ``pushed_in`` s of dofs, ``point_bar_in`` that by points at the start.
        """
        pack, node, lane = wp.tid()
        world = pack * lanes + lane
        if world < x_bar_out.shape[0]:
            body = node_body[node]
            mass_p = density_in[pack, body, lane] * vector_at(node_mass_p_in, pack, lane, 3 * node)
            by_x = vector_at(node_bar_in, pack, lane, 3 * node)
            by_v = vec3()
            dof = node_dof[node]
            if dof >= 0:
                seed = vector_at(seed_in, pack, lane, 3 * dof)
                pushed = vector_at(pushed_in, pack, lane, 3 * dof)
                share = h / (h + beta_in[pack, body, lane])  # h^2 / k
                by_v = h * by_x + seed - pushed + share * (pushed - body_mass_in[pack, body, lane] * mass_p)
            for i in range(node_point_start[node], node_point_start[node + 1]):
                if node_point[i] < cable_points:
                    by_x += node_point_weight[i] * vector_at(point_bar_in, pack, lane, 3 * node_point[i])
            for c in range(3):
                row = 3 * node + c
                found = mass_p[c]
                if dof >= 0:
                    found += by_v[c] * dof_free[dof, c]
                x_bar_out[world, row] = x_bar_out[world, row] + by_x[c]
                v_bar_out[world, row] = found
                force_bar_out[world, row] = h * node_p_in[pack, row, lane]

    @wp.kernel(module=module, enable_backward=False)
    def damping(
        h: real,
        lanes: int,
        # Model
        body_node_start: wp.array(dtype=wp.int32),
        node_dof: wp.array(dtype=wp.int32),
        # Workspace in
        density_in: wp.array3d(dtype=real),
        beta_in: wp.array3d(dtype=real),
        body_mass_in: wp.array3d(dtype=real),
        pushed_in: wp.array3d(dtype=real),
        start_v_in: wp.array3d(dtype=real),
        node_mass_p_in: wp.array3d(dtype=real),
        # State out
        rayleigh_stiffness_bar_out: wp.array2d(dtype=real),
    ):
        """Make the gradient by beta of one body that of h v, from that of h (v - h^2 / k v0) which elements gave."""
        pack, body, lane = wp.tid()
        world = pack * lanes + lane
        if world < rayleigh_stiffness_bar_out.shape[0]:
            total = real(0.0)
            for node in range(body_node_start[body], body_node_start[body + 1]):
                dof = node_dof[node]
                if dof >= 0:
                    mass_p = density_in[pack, body, lane] * vector_at(node_mass_p_in, pack, lane, 3 * node)
                    product = vector_at(pushed_in, pack, lane, 3 * dof) - body_mass_in[pack, body, lane] * mass_p
                    total += wp.dot(product, vector_at(start_v_in, pack, lane, 3 * dof))
            length = h + beta_in[pack, body, lane]
            change = h / (length * length) * total  # h (h^2 / k) / k
            rayleigh_stiffness_bar_out[world, body] = rayleigh_stiffness_bar_out[world, body] - change

    @wp.kernel(module=module, enable_backward=False)
    def part(
        factor: real,
        # State
        bar_in: wp.array2d(dtype=real),
        # State out
        part_out: wp.array2d(dtype=real),
        rest_out: wp.array2d(dtype=real),
    ):
        """Gradient by an extrapolated value, as those by the end of the stage before and by the start of the step."""
        world, row = wp.tid()
        bar = bar_in[world, row]
        part_out[world, row] = factor * bar
        rest_out[world, row] = bar - factor * bar

    @wp.kernel(module=module, enable_backward=False)
    def add(
        # State
        bar_in: wp.array2d(dtype=real),
        # State out
        sum_out: wp.array2d(dtype=real),
    ):
        """Add one gradient to another."""
        world, row = wp.tid()
        sum_out[world, row] = sum_out[world, row] + bar_in[world, row]

    return SimpleNamespace(
        velocities=velocities,
        start_points=start_points,
        nodes=nodes,
        damping=damping,
        part=part,
        add=add,
    )
