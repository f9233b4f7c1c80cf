"""Adjoint of a stage of BDF2, a backward Euler step that is linearised where the start velocities lead to.

With x = x0 + h v0, k = h (h + beta) and m = 1 + h alpha a stage solves, for the velocities v at its end,

    m M v + K(x) (k v - h^2 v0) = M v0 - h f(x) + h f_ext + h H(x)' T,      d(x) + h H(x) (v - v0) + C T = target,

so that elements have v - h^2 / k v0 in the place of v, rows v - v0, and the velocities of the start count three times:
by M, by x, and by K and H. With s = A p, the seed less h H' q, K p is (s - m M p) / k. Theory: docs/theory/adjoint.md.
State arrays are ``[world, row]``; workspace arrays ``[pack, row, lane]``.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type and memory order."""
    real = variant.real
    module = variant.module("adjoint.stage")
    one = single.functions(variant)
    vec3, vector_at, quat_at, put, add_to = one.vec3, one.vector_at, one.quat_at, one.put, one.add_to

    @wp.kernel(module=module, enable_backward=False)
    def start_points(
        # Model
        point_row: wp.array(dtype=wp.int32),
        # Workspace in
        point_gradient_in: wp.array3d(dtype=real),
        start_in: wp.array3d(dtype=real),
        # Workspace out
        point_bar_out: wp.array3d(dtype=real),
    ):
        """Gradient by one point of a row where the stage started, by its displacement there."""
        pack, point, lane = wp.tid()
        here = vector_at(point_gradient_in, pack, lane, 3 * point)
        put(point_bar_out, pack, lane, 3 * point, start_in[pack, point_row[point], lane] * here)

    @wp.kernel(module=module, enable_backward=False)
    def start_frames(
        nodes: int,
        # Model
        frame_item_start: wp.array(dtype=wp.int32),
        frame_item: wp.array(dtype=wp.int32),
        carried_slot: wp.array(dtype=wp.int32),
        carried_offset: wp.array2d(dtype=real),
        node_point_start: wp.array(dtype=wp.int32),
        node_point: wp.array(dtype=wp.int32),
        node_point_weight: wp.array(dtype=real),
        # Workspace in
        pose0_in: wp.array3d(dtype=real),
        point_bar_in: wp.array3d(dtype=real),
        # Workspace out
        start_out: wp.array3d(dtype=real),
        offset_out: wp.array3d(dtype=real),
    ):
        """Add what the points that one frame carries have where the stage started, by its place and turn there.

        To what carried nodes have by where they are in it, too.
        """
        pack, frame, lane = wp.tid()
        q = quat_at(pose0_in, pack, lane, 7 * frame + 3)
        place = vec3()
        turn = vec3()
        for k in range(frame_item_start[frame], frame_item_start[frame + 1]):
            item = frame_item[k]
            node = carried_slot[item]
            if node < nodes:
                total = vec3()
                for i in range(node_point_start[node], node_point_start[node + 1]):
                    total += node_point_weight[i] * vector_at(point_bar_in, pack, lane, 3 * node_point[i])
                offset = vec3(carried_offset[item, 0], carried_offset[item, 1], carried_offset[item, 2])
                place += total
                turn += wp.cross(wp.quat_rotate(q, offset), total)
                add_to(offset_out, pack, lane, 3 * item, wp.quat_rotate_inv(q, total))
        add_to(start_out, pack, lane, 6 * frame, place)
        add_to(start_out, pack, lane, 6 * frame + 3, turn)

    @wp.kernel(module=module, enable_backward=False)
    def nodes(
        h: real,
        follows: real,
        lanes: int,
        # Model
        node_dof: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        dof_free: wp.array2d(dtype=real),
        node_point_start: wp.array(dtype=wp.int32),
        node_point: wp.array(dtype=wp.int32),
        node_point_weight: wp.array(dtype=real),
        # Workspace in
        predicts_in: wp.array3d(dtype=real),
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
        # Workspace out
        ahead_out: wp.array3d(dtype=real),
    ):
        """Gradients by the position, the velocity and the force of one node at the start of the stage.

        ``node_bar_in`` is that by x, ``pushed_in`` s of dofs, ``point_bar_in`` that by points at the start; ``ahead``
        receives those by the velocities that the stage is linearised with, which ``follows`` is 1 for if they are
        those of the start; ``predicts`` is 0 in worlds where they are 0.
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
                by_x += node_point_weight[i] * vector_at(point_bar_in, pack, lane, 3 * node_point[i])
            for c in range(3):
                row = 3 * node + c
                found = mass_p[c]
                if dof >= 0:
                    found += follows * predicts_in[pack, 0, lane] * by_v[c] * dof_free[dof, c]
                    ahead_out[pack, 3 * dof + c, lane] = by_v[c]
                x_bar_out[world, row] = x_bar_out[world, row] + by_x[c]
                v_bar_out[world, row] = found
                force_bar_out[world, row] = h * node_p_in[pack, row, lane]

    @wp.kernel(module=module, enable_backward=False)
    def mode_velocities(
        # Model
        listed: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        # Workspace in
        damping_in: wp.array3d(dtype=real),
        v_in: wp.array3d(dtype=real),
        start_v_in: wp.array3d(dtype=real),
        # Workspace out
        element_v_out: wp.array3d(dtype=real),
        row_v_out: wp.array3d(dtype=real),
    ):
        """What elements and rows have in the place of the velocity of one node that follows modes."""
        pack, item, lane = wp.tid()
        node = listed[item]
        v = vector_at(v_in, pack, lane, 3 * node)
        v0 = vector_at(start_v_in, pack, lane, 3 * node)
        share = real(1.0) - damping_in[pack, node_body[node], lane]
        put(row_v_out, pack, lane, 3 * node, v - v0)
        put(element_v_out, pack, lane, 3 * node, v - share * v0)

    @wp.kernel(module=module, enable_backward=False)
    def listed_bars(
        # Model
        listed: wp.array(dtype=wp.int32),
        # Workspace in
        node_bar_in: wp.array3d(dtype=real),
        # Workspace out
        listed_out: wp.array3d(dtype=real),
    ):
        """Gradient by the position of one listed node."""
        pack, item, lane = wp.tid()
        put(listed_out, pack, lane, 3 * item, vector_at(node_bar_in, pack, lane, 3 * listed[item]))

    @wp.kernel(module=module, enable_backward=False)
    def modes(
        h: real,
        follows: real,
        lanes: int,
        # Model
        block_body: wp.array(dtype=wp.int32),
        mode_dof: wp.array(dtype=wp.int32),
        mode_wide: wp.array(dtype=wp.int32),
        # Workspace in
        predicts_in: wp.array3d(dtype=real),
        density_in: wp.array3d(dtype=real),
        beta_in: wp.array3d(dtype=real),
        body_mass_in: wp.array3d(dtype=real),
        seed_in: wp.array3d(dtype=real),
        pushed_in: wp.array3d(dtype=real),
        mass_p_in: wp.array3d(dtype=real),
        wide_bar_in: wp.array3d(dtype=real),
        # State out
        v_bar_out: wp.array2d(dtype=real),
        # Workspace out
        ahead_out: wp.array3d(dtype=real),
    ):
        """The same as of ``nodes`` by the velocity of one mode, to which rho M p is known; ``mass_p_in`` is M p."""
        pack, mode, lane = wp.tid()
        world = pack * lanes + lane
        if world < v_bar_out.shape[0]:
            body = block_body[mode / 3]
            row = 3 * mode_dof[mode / 3] + mode % 3
            pushed = pushed_in[pack, row, lane]
            share = h / (h + beta_in[pack, body, lane])
            mass_p = body_mass_in[pack, body, lane] * density_in[pack, body, lane] * mass_p_in[pack, mode, lane]
            by_v = h * wide_bar_in[pack, mode_wide[mode], lane] + seed_in[pack, row, lane] - pushed
            by_v += share * (pushed - mass_p)
            ahead_out[pack, row, lane] = by_v
            v_bar_out[world, mode] = v_bar_out[world, mode] + follows * predicts_in[pack, 0, lane] * by_v

    @wp.kernel(module=module, enable_backward=False)
    def mode_products(
        sum_rows: int,
        # Model
        body_number: wp.array(dtype=wp.int32),
        mode_start: wp.array(dtype=wp.int32),
        mode_dof: wp.array(dtype=wp.int32),
        # Workspace in
        density_in: wp.array3d(dtype=real),
        body_mass_in: wp.array3d(dtype=real),
        pushed_in: wp.array3d(dtype=real),
        mass_p_in: wp.array3d(dtype=real),
        start_v_in: wp.array3d(dtype=real),
        # Workspace out
        sum_out: wp.array3d(dtype=real),
    ):
        """Add k K p . w of the modes of one reduced body to the first of the sums over its nodes."""
        pack, number, lane = wp.tid()
        body = body_number[number]
        scale = density_in[pack, body, lane] * body_mass_in[pack, body, lane]
        total = real(0.0)
        for mode in range(mode_start[number], mode_start[number + 1]):
            row = 3 * mode_dof[mode / 3] + mode % 3
            total += (pushed_in[pack, row, lane] - scale * mass_p_in[pack, mode, lane]) * start_v_in[pack, row, lane]
        row = sum_rows * body
        sum_out[pack, row, lane] = sum_out[pack, row, lane] + total

    @wp.kernel(module=module, enable_backward=False)
    def add_ahead(
        # Model
        dof_free: wp.array2d(dtype=real),
        # Workspace in
        ahead_in: wp.array3d(dtype=real),
        # Workspace out
        seed_out: wp.array3d(dtype=real),
        y_out: wp.array3d(dtype=real),
    ):
        """Add what a later solution has of the velocities of one dof to the right-hand sides of the one before it."""
        pack, dof, lane = wp.tid()
        for c in range(3):
            more = dof_free[dof, c] * ahead_in[pack, 3 * dof + c, lane]
            seed_out[pack, 3 * dof + c, lane] = seed_out[pack, 3 * dof + c, lane] + more
            y_out[pack, 3 * dof + c, lane] = y_out[pack, 3 * dof + c, lane] + more

    @wp.kernel(module=module, enable_backward=False)
    def part(
        factor: real,
        lanes: int,
        # State
        bar_in: wp.array2d(dtype=real),
        # Workspace in
        rough_in: wp.array3d(dtype=wp.int32),
        # State out
        part_out: wp.array2d(dtype=real),
        rest_out: wp.array2d(dtype=real),
    ):
        """Gradient by an extrapolated value, as those by the end of the stage before and by the start of the step.

        In a rough world nothing is extrapolated.
        """
        world, row = wp.tid()
        bar = bar_in[world, row]
        part = bar
        if rough_in[world / lanes, 0, world % lanes] == 0:
            part = factor * bar
        part_out[world, row] = part
        rest_out[world, row] = bar - part

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
        start_points=start_points,
        start_frames=start_frames,
        nodes=nodes,
        mode_velocities=mode_velocities,
        listed_bars=listed_bars,
        modes=modes,
        mode_products=mode_products,
        add_ahead=add_ahead,
        part=part,
        add=add,
    )
