"""Contacts as users see them: points, normals, forces per contact and per pair. Theory: docs/theory/contact.md."""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant, single_worlds

NO_PAIR = -1

_COPY_ROW = """
const size_t size = 3 * out.shape[2] * sizeof(out.data[0]);
memcpy(&wp::index(out, w, 3 * dof, 0), &wp::index(source, w, 3 * place, 0), size);
"""


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels on single worlds."""
    real, world_fastest = variant.real, variant.world_fastest
    vec3 = wp.types.vector(3, real)
    module = variant.module("contact_output")

    @wp.func_native(_COPY_ROW)
    def copy_row(source: wp.array3d(dtype=real), out: wp.array3d(dtype=real), w: int, place: int, dof: int):
        """Three entries of all worlds of a pack, on a CPU, where they lie together."""

    @wp.kernel(module=module, enable_backward=False)
    def start_velocity(
        dof_count: int,
        # Model
        node_count: int,
        first_mode: int,
        dof_node: wp.array(dtype=wp.int32),
        # Workspace in
        node_v0_in: wp.array3d(dtype=real),
        twist0_in: wp.array3d(dtype=real),
        mode_v0_in: wp.array3d(dtype=real),
        # Workspace out
        dof_v0_out: wp.array3d(dtype=real),
    ):
        """Velocity of one dof at the start of the step, on a CPU of all dofs and worlds of a pack."""
        pack, part, lane = wp.tid()
        if wp.static(world_fastest):
            dof = part
            slot = dof_node[dof]
            for c in range(3):
                if slot < node_count:
                    dof_v0_out[pack, 3 * dof + c, lane] = node_v0_in[pack, 3 * slot + c, lane]
                elif slot >= first_mode:
                    dof_v0_out[pack, 3 * dof + c, lane] = mode_v0_in[pack, 3 * (slot - first_mode) + c, lane]
                else:
                    dof_v0_out[pack, 3 * dof + c, lane] = twist0_in[pack, 3 * (slot - node_count) + c, lane]
        elif lane == 0:
            for dof in range(dof_count):
                slot = dof_node[dof]
                if slot < node_count:
                    copy_row(node_v0_in, dof_v0_out, pack, slot, dof)
                elif slot >= first_mode:
                    copy_row(mode_v0_in, dof_v0_out, pack, slot - first_mode, dof)
                else:
                    copy_row(twist0_in, dof_v0_out, pack, slot - node_count, dof)

    @wp.kernel(module=module, enable_backward=False)
    def rebase_gap(
        # Model
        slots: int,
        # Workspace in
        first_in: wp.array3d(dtype=wp.int32),
        count_in: wp.array3d(dtype=wp.int32),
        dof_in: wp.array3d(dtype=wp.int32),
        weight_in: wp.array3d(dtype=real),
        lever_in: wp.array3d(dtype=real),
        axes_in: wp.array3d(dtype=real),
        dof_v_in: wp.array3d(dtype=real),
        x_scale: real,
        # Workspace out
        gap_out: wp.array3d(dtype=real),
    ):
        """Gap of one contact found at a trial state, referred to the start: less x_scale times its normal velocity."""
        pack, contact, lane = wp.tid()
        if contact >= first_in[pack, 0, lane] and contact < count_in[pack, 0, lane]:
            n = vec3()
            for c in range(3):
                n[c] = axes_in[pack, 9 * contact + c, lane]
            total = real(0.0)
            for k in range(slots):
                entry = slots * contact + k
                dof = dof_in[pack, entry, lane]
                if dof >= 0:
                    u = vec3()
                    r = vec3()
                    for c in range(3):
                        u[c] = dof_v_in[pack, 3 * dof + c, lane]
                        r[c] = lever_in[pack, 3 * entry + c, lane]
                    total += wp.dot(n, u * weight_in[pack, entry, lane] + wp.cross(u, r))
            gap_out[pack, contact, lane] = gap_out[pack, contact, lane] - x_scale * total

    @wp.kernel(module=module, enable_backward=False)
    def end_gap(
        # Model
        touch_rows: int,
        distance_row: int,
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        pair_in: wp.array3d(dtype=wp.int32),
        pair_distance_in: wp.array3d(dtype=real),
        touch_in: wp.array3d(dtype=real),
        # Workspace out
        end_out: wp.array3d(dtype=real),
    ):
        """Measured distance of one contact less its contact distance."""
        pack, contact, lane = wp.tid()
        if contact < count_in[pack, 0, lane]:
            distance = touch_in[pack, touch_rows * contact + distance_row, lane]
            end_out[pack, contact, lane] = distance - pair_distance_in[pack, pair_in[pack, contact, lane], lane]

    @wp.kernel(module=module, enable_backward=False)
    def write_contacts(
        # Model
        couple_sign: wp.array(dtype=wp.int32),
        lanes: int,
        # Workspace in
        flag_in: wp.array3d(dtype=wp.int32),
        count_in: wp.array3d(dtype=wp.int32),
        pair_in: wp.array3d(dtype=wp.int32),
        couple_in: wp.array3d(dtype=wp.int32),
        axes_in: wp.array3d(dtype=real),
        point_in: wp.array3d(dtype=real),
        gap_in: wp.array3d(dtype=real),
        multiplier_in: wp.array3d(dtype=real),
        # State out
        contact_pair_out: wp.array2d(dtype=wp.int32),
        contact_point_out: wp.array2d(dtype=real),
        contact_normal_out: wp.array2d(dtype=real),
        contact_load_out: wp.array2d(dtype=real),
        contact_gap_out: wp.array2d(dtype=real),
    ):
        """One contact of a good world: pair (-1 for none), point, normal towards part a, force on part a, gap."""
        pack, contact, lane = wp.tid()
        world = pack * lanes + lane
        if world < contact_pair_out.shape[0]:
            if flag_in[pack, 0, lane] + flag_in[pack, 1, lane] == 0:
                is_used = contact < count_in[pack, 0, lane]
                pair = int(wp.static(NO_PAIR))
                sign = real(0.0)
                if is_used:
                    pair = pair_in[pack, contact, lane]
                    sign = real(couple_sign[couple_in[pack, contact, lane]])
                contact_pair_out[world, contact] = pair
                contact_gap_out[world, contact] = wp.where(is_used, gap_in[pack, contact, lane], real(0.0))
                for c in range(3):
                    row = 3 * contact + c
                    point = real(0.0)
                    normal = real(0.0)
                    force = real(0.0)
                    if is_used:
                        point = point_in[pack, row, lane]
                        normal = sign * axes_in[pack, 9 * contact + c, lane]
                        for axis in range(3):
                            along = axes_in[pack, 9 * contact + 3 * axis + c, lane]
                            force += along * multiplier_in[pack, 3 * contact + axis, lane]
                    contact_point_out[world, row] = point
                    contact_normal_out[world, row] = normal
                    contact_load_out[world, row] = sign * force

    @wp.kernel(module=module, enable_backward=False)
    def sum_pairs(
        # State
        contact_pair_in: wp.array2d(dtype=wp.int32),
        contact_load_in: wp.array2d(dtype=real),
        # State out
        pair_force_out: wp.array2d(dtype=real),
    ):
        """Force on part a of one pair [N]."""
        world, pair = wp.tid()
        for c in range(3):
            total = real(0.0)
            for contact in range(contact_pair_in.shape[1]):
                if contact_pair_in[world, contact] == pair:
                    total += contact_load_in[world, 3 * contact + c]
            pair_force_out[world, 3 * pair + c] = total

    return SimpleNamespace(
        start_velocity=start_velocity,
        rebase_gap=rebase_gap,
        end_gap=end_gap,
        write_contacts=write_contacts,
        sum_pairs=sum_pairs,
    )
