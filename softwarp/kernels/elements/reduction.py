"""Reduced bodies: nodes from modes, forces and rows onto modes, mass and right-hand side.

With amplitudes q a node is at X + Phi q; a force f at it counts as Phi' f, and A is m_scale Phi' M Phi + k_scale K_q.
The tables of modes stand twice in memory: by nodes, for sums over modes, and by blocks of three modes, for sums over
nodes. Theory: docs/theory/reduction.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.elements import assembly


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type."""
    S, real, mul = variant.S, variant.real, variant.mul
    any_positive, sqrt = variant.any_positive, variant.sqrt
    world_fastest = variant.world_fastest
    module = variant.module("reduction")
    row_product = assembly.kernels(variant).row_product

    @wp.kernel(module=module, enable_backward=False)
    def start_velocity(
        # Model
        mode_dof: wp.array(dtype=wp.int32),
        # Workspace in
        mode_v0_in: wp.array2d(dtype=S),
        # Workspace out
        dof_out: wp.array2d(dtype=S),
    ):
        """Velocities of three modes at the start of the step, at their dof."""
        w, block = wp.tid()
        if wp.static(world_fastest):
            block, w = wp.tid()
        for c in range(3):
            dof_out[w, 3 * mode_dof[block] + c] = mode_v0_in[w, 3 * block + c]

    @wp.kernel(module=module, enable_backward=False)
    def trial_amplitude(
        # Model
        mode_dof: wp.array(dtype=wp.int32),
        # Workspace in
        mode_q0_in: wp.array2d(dtype=S),
        dof_v_in: wp.array2d(dtype=S),
        x_scale: real,
        # Workspace out
        mode_q_out: wp.array2d(dtype=S),
        mode_v_out: wp.array2d(dtype=S),
    ):
        """q = q0 + x_scale v of three modes, and v."""
        w, block = wp.tid()
        if wp.static(world_fastest):
            block, w = wp.tid()
        for c in range(3):
            k = 3 * block + c
            v = dof_v_in[w, 3 * mode_dof[block] + c]
            mode_v_out[w, k] = v
            mode_q_out[w, k] = mode_q0_in[w, k] + v * x_scale

    @wp.func
    def along(basis: wp.array(dtype=real), at: int, count: int, amplitude: wp.array2d(dtype=S), w: int, first: int):
        """Sum over some modes of a component's displacement times their amplitude."""
        s = S(real(0.0))
        for k in range(count):
            s += amplitude[w, first + k] * basis[at + k]
        return s

    @wp.kernel(module=module, enable_backward=False)
    def node_positions(
        first: int,
        # Model
        node: wp.array(dtype=wp.int32),
        node_first: wp.array(dtype=wp.int32),
        node_modes: wp.array(dtype=wp.int32),
        node_basis: wp.array(dtype=wp.int32),
        node_rest: wp.array2d(dtype=real),
        basis: wp.array(dtype=real),
        # Workspace in
        mode_q_in: wp.array2d(dtype=S),
        # Workspace out
        x_out: wp.array2d(dtype=S),
    ):
        """X + Phi q of one listed node, from ``first`` on."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        i = first + item
        count = node_modes[i]
        for c in range(3):
            moved = along(basis, node_basis[i] + c * count, count, mode_q_in, w, node_first[i])
            x_out[w, 3 * node[i] + c] = moved + S(node_rest[i, c])

    @wp.kernel(module=module, enable_backward=False)
    def node_velocities(
        # Model
        node: wp.array(dtype=wp.int32),
        node_first: wp.array(dtype=wp.int32),
        node_modes: wp.array(dtype=wp.int32),
        node_basis: wp.array(dtype=wp.int32),
        basis: wp.array(dtype=real),
        # Workspace in
        mode_v_in: wp.array2d(dtype=S),
        # Workspace out
        v_out: wp.array2d(dtype=S),
    ):
        """Phi v of one listed node."""
        w, i = wp.tid()
        if wp.static(world_fastest):
            i, w = wp.tid()
        count = node_modes[i]
        for c in range(3):
            v_out[w, 3 * i + c] = along(basis, node_basis[i] + c * count, count, mode_v_in, w, node_first[i])

    @wp.kernel(module=module, enable_backward=False)
    def touch_velocities(
        dof_count: int,
        # Model
        touch_listed: wp.array(dtype=wp.int32),
        touch_begin: wp.array(dtype=wp.int32),
        node_modes: wp.array(dtype=wp.int32),
        node_basis: wp.array(dtype=wp.int32),
        mode_dof: wp.array(dtype=wp.int32),
        basis: wp.array(dtype=real),
        # Workspace out
        dof_out: wp.array2d(dtype=S),
    ):
        """Velocity of one node that may touch something, behind those of the dofs, from those of its body's modes."""
        w, i = wp.tid()
        if wp.static(world_fastest):
            i, w = wp.tid()
        listed = touch_listed[i]
        count = node_modes[listed]
        for c in range(3):
            at = node_basis[listed] + c * count
            s = S(real(0.0))
            for b in range(count // 3):
                row = 3 * mode_dof[touch_begin[i] + b]
                for r in range(3):
                    s += dof_out[w, row + r] * basis[at + 3 * b + r]
            dof_out[w, 3 * (dof_count + i) + c] = s

    @wp.kernel(module=module, enable_backward=False)
    def touch_forces(
        dof_count: int,
        # Model
        mode_dof: wp.array(dtype=wp.int32),
        touch_block: wp.array(dtype=wp.int32),
        touch_blocks: wp.array(dtype=wp.int32),
        touch_panel: wp.array(dtype=wp.int32),
        touch_basis: wp.array(dtype=real),
        # Workspace in
        dof_in: wp.array2d(dtype=S),
        # Workspace out
        target_out: wp.array2d(dtype=S),
    ):
        """Add Phi' f of the nodes that may touch something to one dof of three modes."""
        w, block = wp.tid()
        if wp.static(world_fastest):
            block, w = wp.tid()
        s0 = S(real(0.0))
        s1 = S(real(0.0))
        s2 = S(real(0.0))
        at = touch_panel[block]
        row = 3 * (dof_count + touch_block[block])
        for _ in range(3 * touch_blocks[block]):
            f = dof_in[w, row]
            s0 += f * touch_basis[at]
            s1 += f * touch_basis[at + 1]
            s2 += f * touch_basis[at + 2]
            row += 1
            at += 3
        row = 3 * mode_dof[block]
        target_out[w, row] += s0
        target_out[w, row + 1] += s1
        target_out[w, row + 2] += s2

    @wp.kernel(module=module, enable_backward=False)
    def mode_forces(
        # Model
        block_body: wp.array(dtype=wp.int32),
        block_node: wp.array(dtype=wp.int32),
        block_nodes: wp.array(dtype=wp.int32),
        block_panel: wp.array(dtype=wp.int32),
        panel: wp.array(dtype=real),
        heft: wp.array2d(dtype=real),
        # Workspace in
        density_in: wp.array2d(dtype=S),
        gravity_in: wp.array2d(dtype=S),
        node_internal_in: wp.array2d(dtype=S),
        node_external_in: wp.array2d(dtype=S),
        # Workspace out
        mode_force_out: wp.array2d(dtype=S),
    ):
        """Phi' (f_ext - f_int) on three modes; most nodes have no force besides their weight."""
        w, block = wp.tid()
        if wp.static(world_fastest):
            block, w = wp.tid()
        density = density_in[w, block_body[block]]
        s0 = S(real(0.0))
        s1 = S(real(0.0))
        s2 = S(real(0.0))
        for c in range(3):
            g = mul(density, gravity_in[w, c])
            s0 += g * heft[3 * block, c]
            s1 += g * heft[3 * block + 1, c]
            s2 += g * heft[3 * block + 2, c]
        at = block_panel[block]
        row = 3 * block_node[block]
        for _ in range(block_nodes[block]):
            fx = node_external_in[w, row] - node_internal_in[w, row]
            fy = node_external_in[w, row + 1] - node_internal_in[w, row + 1]
            fz = node_external_in[w, row + 2] - node_internal_in[w, row + 2]
            if any_positive(mul(fx, fx) + mul(fy, fy) + mul(fz, fz)):
                s0 += fx * panel[at] + fy * panel[at + 3] + fz * panel[at + 6]
                s1 += fx * panel[at + 1] + fy * panel[at + 4] + fz * panel[at + 7]
                s2 += fx * panel[at + 2] + fy * panel[at + 5] + fz * panel[at + 8]
            row += 3
            at += 9
        mode_force_out[w, 3 * block] = s0
        mode_force_out[w, 3 * block + 1] = s1
        mode_force_out[w, 3 * block + 2] = s2

    @wp.kernel(module=module, enable_backward=False)
    def mode_tangent(
        # Model
        pair_block: wp.array(dtype=wp.int32),
        pair_row: wp.array(dtype=wp.int32),
        pair_col: wp.array(dtype=wp.int32),
        pair_stiffness: wp.array(dtype=wp.int32),
        pair_stride: wp.array(dtype=wp.int32),
        pair_volume: wp.array2d(dtype=real),
        block_body: wp.array(dtype=wp.int32),
        # Workspace in
        body_mass_scale_in: wp.array2d(dtype=S),
        density_in: wp.array2d(dtype=S),
        sum_in: wp.array2d(dtype=S),
        # Workspace out
        a_out: wp.array2d(dtype=S),
    ):
        """Set the block of A of two blocks of modes: m_scale M + k_scale K, of which the lower triangle is known."""
        w, pair = wp.tid()
        if wp.static(world_fastest):
            pair, w = wp.tid()
        body = block_body[pair_row[pair]]
        mass = mul(body_mass_scale_in[w, body], density_in[w, body])
        stride = pair_stride[pair]
        target = 9 * (pair_block[pair] // 2)
        across = 1 + 2 * (pair_block[pair] % 2)  # 3 where the transpose is stored
        for r in range(3):
            for c in range(3):
                row = pair_stiffness[pair] + r * stride + c
                if c > r and pair_row[pair] == pair_col[pair]:
                    row = pair_stiffness[pair] + c * stride + r
                a_out[w, target + (4 - across) * r + across * c] = sum_in[w, row] + mass * pair_volume[pair, 3 * r + c]

    @wp.func
    def inertia(volume: wp.array(dtype=real), at: int, count: int, v: wp.array2d(dtype=S), w: int, first: int, r: int):
        """Row r of a block of M v per density."""
        return along(volume, at + r * count, count, v, w, first)

    @wp.kernel(module=module, enable_backward=False)
    def right_hand_side(
        # Model
        mode_dof: wp.array(dtype=wp.int32),
        block_body: wp.array(dtype=wp.int32),
        block_first: wp.array(dtype=wp.int32),
        block_modes: wp.array(dtype=wp.int32),
        block_volume: wp.array(dtype=wp.int32),
        volume: wp.array(dtype=real),
        neighbour_start: wp.array(dtype=wp.int32),
        neighbour: wp.array(dtype=wp.int32),
        neighbour_block: wp.array(dtype=wp.int32),
        # Workspace in
        body_mass_scale_in: wp.array2d(dtype=S),
        body_damping_scale_in: wp.array2d(dtype=S),
        density_in: wp.array2d(dtype=S),
        mode_force_in: wp.array2d(dtype=S),
        mode_v0_in: wp.array2d(dtype=S),
        mode_v_in: wp.array2d(dtype=S),
        a_in: wp.array2d(dtype=S),
        dof_v_in: wp.array2d(dtype=S),
        f_scale: real,
        inertial: real,
        moving: bool,
        # Workspace out
        b_out: wp.array2d(dtype=S),
    ):
        """b of three modes, as ``kernels.elements.assembly`` has it for nodes."""
        w, block = wp.tid()
        if wp.static(world_fastest):
            block, w = wp.tid()
        body = block_body[block]
        first = block_first[block]
        count = block_modes[block]
        density = density_in[w, body]
        dof = mode_dof[block]
        for r in range(3):
            b = mode_force_in[w, 3 * block + r] * f_scale
            if inertial > real(0.0):
                b += mul(density, inertia(volume, block_volume[block], count, mode_v0_in, w, first, r))
            b_out[w, 3 * dof + r] = b
        if inertial > real(0.0) and moving:
            damping = body_damping_scale_in[w, body]
            keep = mul(mul(density, body_mass_scale_in[w, body]), S(real(1.0)) - damping)
            r0, r1, r2 = row_product(a_in, dof_v_in, w, dof, neighbour_start, neighbour, neighbour_block)
            b_out[w, 3 * dof] -= mul(damping, r0)
            b_out[w, 3 * dof + 1] -= mul(damping, r1)
            b_out[w, 3 * dof + 2] -= mul(damping, r2)
            for r in range(3):
                mass = inertia(volume, block_volume[block], count, mode_v_in, w, first, r)
                b_out[w, 3 * dof + r] -= mul(keep, mass)

    @wp.kernel(module=module, enable_backward=False)
    def mode_rows(
        # Model
        size: int,
        entry: wp.array(dtype=wp.int32),
        entry_point: wp.array(dtype=wp.int32),
        entry_points: wp.array(dtype=wp.int32),
        entry_panel: wp.array(dtype=wp.int32),
        point_panel: wp.array(dtype=real),
        entry_dof: wp.array(dtype=wp.int32),
        entry_row: wp.array(dtype=wp.int32),
        # Workspace in
        point_gradient_in: wp.array2d(dtype=S),
        # Workspace out
        row_out: wp.array2d(dtype=S),
        y_out: wp.array2d(dtype=S),
    ):
        """One 3-entry of H' at a block of modes, from the gradient by the row's points; and among the sides."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        s0 = S(real(0.0))
        s1 = S(real(0.0))
        s2 = S(real(0.0))
        at = entry_panel[item]
        row = 3 * entry_point[item]
        for _ in range(3 * entry_points[item]):
            g = point_gradient_in[w, row]
            s0 += g * point_panel[at]
            s1 += g * point_panel[at + 1]
            s2 += g * point_panel[at + 2]
            row += 1
            at += 3
        e = entry[item]
        target = 3 * ((1 + entry_row[e]) * size + entry_dof[e])
        row_out[w, 3 * e] = s0
        row_out[w, 3 * e + 1] = s1
        row_out[w, 3 * e + 2] = s2
        y_out[w, target] = s0
        y_out[w, target + 1] = s1
        y_out[w, target + 2] = s2

    @wp.kernel(module=module, enable_backward=False)
    def force_norms(
        count: int,
        # Workspace in
        mode_force_in: wp.array2d(dtype=S),
        f_scale: real,
        # Workspace out
        norm_out: wp.array2d(dtype=S),
    ):
        """Add the forces on modes to the size of what should balance."""
        w = wp.tid()
        total = mul(norm_out[w, 1], norm_out[w, 1])
        for k in range(count):
            f = mode_force_in[w, k] * f_scale
            total += mul(f, f)
        norm_out[w, 1] = sqrt(total)

    @wp.kernel(module=module, enable_backward=False)
    def commit_nodes(
        # Model
        node: wp.array(dtype=wp.int32),
        lanes: int,
        # Workspace in
        flag_in: wp.array3d(dtype=wp.int32),
        x_in: wp.array3d(dtype=real),
        v_in: wp.array3d(dtype=real),
        # State out
        node_x_out: wp.array2d(dtype=real),
        node_v_out: wp.array2d(dtype=real),
        good_x_out: wp.array2d(dtype=real),
        good_v_out: wp.array2d(dtype=real),
    ):
        """Position and velocity of one listed node in a good world."""
        pack, i, lane = wp.tid()
        world = pack * lanes + lane
        if world < node_x_out.shape[0]:
            if flag_in[pack, 0, lane] + flag_in[pack, 1, lane] == 0:
                for c in range(3):
                    row = 3 * node[i] + c
                    node_x_out[world, row] = x_in[pack, row, lane]
                    good_x_out[world, row] = x_in[pack, row, lane]
                    node_v_out[world, row] = v_in[pack, 3 * i + c, lane]
                    good_v_out[world, row] = v_in[pack, 3 * i + c, lane]

    return SimpleNamespace(
        start_velocity=start_velocity,
        trial_amplitude=trial_amplitude,
        node_positions=node_positions,
        node_velocities=node_velocities,
        touch_velocities=touch_velocities,
        touch_forces=touch_forces,
        mode_forces=mode_forces,
        mode_tangent=mode_tangent,
        right_hand_side=right_hand_side,
        mode_rows=mode_rows,
        force_norms=force_norms,
        commit_nodes=commit_nodes,
    )
