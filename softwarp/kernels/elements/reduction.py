"""Reduced bodies: nodes from modes, mass and right-hand side; ``mode_loads`` has forces and rows onto modes.

With amplitudes q a node is at X + Phi q; a force f at it counts as Phi' f, and A is m_scale Phi' M Phi + k_scale K_q.
Rows of Phi have a stride of a multiple of 16, with zeros behind the last mode, and amplitudes stand as far apart for
them: wide modes. On a CPU registers run along the modes, or hold a world in every lane.
Theory: docs/theory/reduction.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import packs
from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.elements import assembly, mode_loads, mode_sums


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type."""
    S, real, mul = variant.S, variant.real, variant.mul
    sqrt = variant.sqrt
    world_fastest = variant.world_fastest
    module = variant.module("reduction")
    of_packs = packs.functions(real)
    are_same, store_rows = of_packs.are_same, of_packs.store_rows
    row_product, sums = assembly.kernels(variant).row_product, mode_sums.functions(variant)
    displace, displace_both = sums.displace, sums.displace_both

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

    @wp.kernel(module=module, enable_backward=False)
    def widen(
        # Model
        wide_mode: wp.array(dtype=wp.int32),
        # Workspace in
        mode_in: wp.array2d(dtype=S),
        # Workspace out
        wide_out: wp.array2d(dtype=S),
    ):
        """Number of one wide mode; 0 where it fills a stride."""
        w, k = wp.tid()
        if wp.static(world_fastest):
            k, w = wp.tid()
        mode = wide_mode[k]
        wide_out[w, k] = S(real(0.0))
        if mode >= 0:
            wide_out[w, k] = mode_in[w, mode]

    @wp.kernel(module=module, enable_backward=False)
    def widen_dofs(
        # Model
        wide_mode: wp.array(dtype=wp.int32),
        mode_dof: wp.array(dtype=wp.int32),
        # Workspace in
        dof_in: wp.array2d(dtype=S),
        # Workspace out
        wide_out: wp.array2d(dtype=S),
    ):
        """The same from an array of dofs."""
        w, k = wp.tid()
        if wp.static(world_fastest):
            k, w = wp.tid()
        mode = wide_mode[k]
        wide_out[w, k] = S(real(0.0))
        if mode >= 0:
            wide_out[w, k] = dof_in[w, 3 * mode_dof[mode // 3] + mode % 3]

    @wp.func
    def place(
        node: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        node_basis: wp.array(dtype=wp.int32),
        body_wide: wp.array(dtype=wp.int32),
        body_stride: wp.array(dtype=wp.int32),
        basis: wp.array(dtype=real),
        node_rest: wp.array2d(dtype=real),
        wide_q: wp.array2d(dtype=S),
        w: int,
        i: int,
        x: wp.array2d(dtype=S),
    ):
        """X + Phi q of listed node i."""
        body = node_body[i]
        row = 3 * node[i]
        displace(basis, node_basis[i], body_stride[body], wide_q, w, body_wide[body], x, row)
        for c in range(3):
            x[w, row + c] += S(node_rest[i, c])

    @wp.kernel(module=module, enable_backward=False)
    def node_positions(
        # Model
        node: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        node_basis: wp.array(dtype=wp.int32),
        body_wide: wp.array(dtype=wp.int32),
        body_stride: wp.array(dtype=wp.int32),
        basis: wp.array(dtype=real),
        node_rest: wp.array2d(dtype=real),
        # Workspace in
        wide_q_in: wp.array2d(dtype=S),
        # Workspace out
        x_out: wp.array2d(dtype=S),
    ):
        """X + Phi q of one listed node, for a CPU."""
        w, i = wp.tid()
        place(node, node_body, node_basis, body_wide, body_stride, basis, node_rest, wide_q_in, w, i, x_out)

    @wp.kernel(module=module, enable_backward=False)
    def start_positions(
        count: int,
        lanes: int,
        # Model
        node: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        node_basis: wp.array(dtype=wp.int32),
        body_wide: wp.array(dtype=wp.int32),
        body_stride: wp.array(dtype=wp.int32),
        basis: wp.array(dtype=real),
        node_rest: wp.array2d(dtype=real),
        # State
        mode_q_in: wp.array2d(dtype=real),
        good_mode_q_in: wp.array2d(dtype=real),
        node_x_in: wp.array2d(dtype=real),
        good_x_in: wp.array2d(dtype=real),
        # Workspace in
        wide_q_in: wp.array2d(dtype=S),
        # Workspace out
        x_out: wp.array2d(dtype=S),
    ):
        """X + Phi q of the first listed nodes, unless all worlds of a pack are where the last good step left them.

        That has placed their nodes. Reading Phi takes the time; for a CPU.
        """
        w = wp.tid()
        first = w * lanes
        last = wp.min(first + lanes, mode_q_in.shape[0])
        same = are_same(mode_q_in, good_mode_q_in, first, last)
        if same == 0 or are_same(node_x_in, good_x_in, first, last) == 0:
            for i in range(count):
                place(node, node_body, node_basis, body_wide, body_stride, basis, node_rest, wide_q_in, w, i, x_out)

    @wp.kernel(module=module, enable_backward=False)
    def touch_positions(
        # Model
        touch_listed: wp.array(dtype=wp.int32),
        node: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        node_basis: wp.array(dtype=wp.int32),
        body_wide: wp.array(dtype=wp.int32),
        body_stride: wp.array(dtype=wp.int32),
        basis: wp.array(dtype=real),
        node_rest: wp.array2d(dtype=real),
        # Workspace in
        wide_q_in: wp.array2d(dtype=S),
        # Workspace out
        x_out: wp.array2d(dtype=S),
    ):
        """X + Phi q of one node that may touch something."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        i = touch_listed[item]
        place(node, node_body, node_basis, body_wide, body_stride, basis, node_rest, wide_q_in, w, i, x_out)

    @wp.kernel(module=module, enable_backward=False)
    def node_states(
        # Model
        node: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        node_basis: wp.array(dtype=wp.int32),
        body_wide: wp.array(dtype=wp.int32),
        body_stride: wp.array(dtype=wp.int32),
        basis: wp.array(dtype=real),
        node_rest: wp.array2d(dtype=real),
        # Workspace in
        wide_q_in: wp.array2d(dtype=S),
        wide_v_in: wp.array2d(dtype=S),
        # Workspace out
        x_out: wp.array2d(dtype=S),
        v_out: wp.array2d(dtype=S),
    ):
        """X + Phi q and Phi v of one listed node, while its row of Phi is at hand; for a CPU."""
        w, i = wp.tid()
        body = node_body[i]
        at = node_basis[i]
        row = 3 * node[i]
        displace_both(basis, at, body_stride[body], wide_q_in, wide_v_in, w, body_wide[body], x_out, v_out, row)
        for c in range(3):
            x_out[w, row + c] += S(node_rest[i, c])

    @wp.kernel(module=module, enable_backward=False)
    def touch_velocities(
        dof_count: int,
        # Model
        touch_listed: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        node_basis: wp.array(dtype=wp.int32),
        body_wide: wp.array(dtype=wp.int32),
        body_stride: wp.array(dtype=wp.int32),
        basis: wp.array(dtype=real),
        # Workspace in
        wide_v_in: wp.array2d(dtype=S),
        # Workspace out
        dof_out: wp.array2d(dtype=S),
    ):
        """Velocity of one node that may touch something, behind those of the dofs."""
        w, i = wp.tid()
        if wp.static(world_fastest):
            i, w = wp.tid()
        listed = touch_listed[i]
        body = node_body[listed]
        row = 3 * (dof_count + i)
        displace(basis, node_basis[listed], body_stride[body], wide_v_in, w, body_wide[body], dof_out, row)

    @wp.kernel(module=module, enable_backward=False)
    def add_dof_forces(
        # Workspace in
        force_in: wp.array2d(dtype=S),
        # Workspace out
        target_out: wp.array2d(dtype=S),
    ):
        """Add forces on dofs that are no modes, of frames and of nodes that move by themselves."""
        w, i = wp.tid()
        if wp.static(world_fastest):
            i, w = wp.tid()
        target_out[w, i] += force_in[w, i]

    @wp.kernel(module=module, enable_backward=False)
    def mode_weight(
        # Model
        wide_mode: wp.array(dtype=wp.int32),
        wide_body: wp.array(dtype=wp.int32),
        body_number: wp.array(dtype=wp.int32),
        heft: wp.array2d(dtype=real),
        # Workspace in
        density_in: wp.array2d(dtype=S),
        gravity_in: wp.array2d(dtype=S),
        # Workspace out
        wide_force_out: wp.array2d(dtype=S),
    ):
        """Weight of one wide mode."""
        w, k = wp.tid()
        if wp.static(world_fastest):
            k, w = wp.tid()
        mode = wide_mode[k]
        s = S(real(0.0))
        if mode >= 0:
            for c in range(3):
                s += gravity_in[w, c] * heft[mode, c]
        wide_force_out[w, k] = mul(s, density_in[w, body_number[wide_body[k]]])

    @wp.kernel(module=module, enable_backward=False)
    def node_balance(
        # Model
        node: wp.array(dtype=wp.int32),
        # Workspace in
        node_internal_in: wp.array2d(dtype=S),
        node_external_in: wp.array2d(dtype=S),
        # Workspace out
        balance_out: wp.array2d(dtype=S),
    ):
        """f_ext - f_int of one listed node, without its weight; on a CPU of all."""
        w, part = wp.tid()
        first = int(0)
        last = node.shape[0]
        if wp.static(world_fastest):
            part, w = wp.tid()
            first = part
            last = part + 1
        for i in range(first, last):
            row = 3 * node[i]
            for c in range(3):
                balance_out[w, 3 * i + c] = node_external_in[w, row + c] - node_internal_in[w, row + c]

    @wp.kernel(module=module, enable_backward=False)
    def narrow(
        # Model
        mode_wide: wp.array(dtype=wp.int32),
        # Workspace in
        wide_in: wp.array2d(dtype=S),
        # Workspace out
        mode_out: wp.array2d(dtype=S),
    ):
        """Number of one mode from those of wide modes."""
        w, mode = wp.tid()
        if wp.static(world_fastest):
            mode, w = wp.tid()
        mode_out[w, mode] = wide_in[w, mode_wide[mode]]

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
        s = S(real(0.0))
        for k in range(count):
            s += v[w, first + k] * volume[at + r * count + k]
        return s

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
    def mode_entries(
        # Model
        size: int,
        entry: wp.array(dtype=wp.int32),
        entry_wide: wp.array(dtype=wp.int32),
        entry_dof: wp.array(dtype=wp.int32),
        entry_row: wp.array(dtype=wp.int32),
        # Workspace in
        wide_row_in: wp.array2d(dtype=S),
        # Workspace out
        row_out: wp.array2d(dtype=S),
        y_out: wp.array2d(dtype=S),
    ):
        """One 3-entry of H' at a block of modes, and among the sides."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        e = entry[item]
        target = 3 * ((1 + entry_row[e]) * size + entry_dof[e])
        for c in range(3):
            value = wide_row_in[w, entry_wide[item] + c]
            row_out[w, 3 * e + c] = value
            y_out[w, target + c] = value

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
        body_begin: wp.array(dtype=wp.int32),
        body_end: wp.array(dtype=wp.int32),
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
        """Position and velocity of one listed node in a good world; on a CPU of all of them, body by body.

        A failed world gets back its last good coordinates where it had been given some that are not finite.
        """
        pack, part, lane = wp.tid()
        world = pack * lanes + lane
        last = node.shape[0]
        if wp.static(world_fastest):
            last = part + 1
        else:
            failed = int(0)
            for other in range(wp.min(lanes, node_x_out.shape[0] - pack * lanes)):
                failed += flag_in[pack, 0, other] + flag_in[pack, 1, other]
            if failed == 0:
                if lane == 0:
                    for body in range(body_begin.shape[0]):
                        begin = 3 * body_begin[body]
                        end = 3 * body_end[body]
                        store_rows(x_in, pack, begin, end, node_x_out, good_x_out)
                        store_rows(v_in, pack, begin, end, node_v_out, good_v_out)
                return
        if world < node_x_out.shape[0]:
            is_good = flag_in[pack, 0, lane] + flag_in[pack, 1, lane] == 0
            for i in range(part, last):
                for c in range(3):
                    row = 3 * node[i] + c
                    if is_good:
                        x = x_in[pack, row, lane]
                        v = v_in[pack, row, lane]
                        node_x_out[world, row] = x
                        good_x_out[world, row] = x
                        node_v_out[world, row] = v
                        good_v_out[world, row] = v
                    else:
                        if not wp.isfinite(node_x_out[world, row]):
                            node_x_out[world, row] = good_x_out[world, row]
                        if not wp.isfinite(node_v_out[world, row]):
                            node_v_out[world, row] = good_v_out[world, row]

    result = SimpleNamespace(
        start_velocity=start_velocity,
        trial_amplitude=trial_amplitude,
        widen=widen,
        widen_dofs=widen_dofs,
        narrow=narrow,
        node_positions=node_positions,
        start_positions=start_positions,
        touch_positions=touch_positions,
        node_states=node_states,
        node_balance=node_balance,
        touch_velocities=touch_velocities,
        add_dof_forces=add_dof_forces,
        mode_weight=mode_weight,
        mode_tangent=mode_tangent,
        right_hand_side=right_hand_side,
        mode_entries=mode_entries,
        force_norms=force_norms,
        commit_nodes=commit_nodes,
    )
    return SimpleNamespace(**vars(result), **vars(mode_loads.kernels(variant)))
