"""Directional derivatives of contacts in a step, with the active set of the step. Theory: docs/theory/adjoint.md.

With slopes of what a step reads, -z of forces and g = h H dv, contacts in the states of ``contact_adjoint`` obey

    open    z = 0
    stick   g_n = C z_n + S_n,   g_t = S_t
    slip    g_n = C z_n + S_n,   z_t = mu r z_n + k (1 - r r') (g_t - S_t) - dmu l_n r,

where S is what the step's start changes: -dg* along the normal, and h w x u of a plane that turns by w, at a place
that moves by u.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.rows import contact_adjoint
from softwarp.model.codes import SLOTS


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type, on single worlds: (pack, row, lane)."""
    real = variant.real
    module = variant.module("directional.contact")
    one = single.functions(variant)
    vec3, vector_at, put = one.vec3, one.vector_at, one.put
    found = contact_adjoint.functions(variant)
    motion, along = found.motion, found.along

    @wp.func
    def carried(
        dof: wp.array3d(dtype=wp.int32),
        weight: wp.array3d(dtype=real),
        dof_node: wp.array(dtype=wp.int32),
        node_count: int,
        x: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        contact: int,
    ):
        """sum w_k x_k of the nodes of one contact."""
        total = vec3()
        for slot in range(wp.static(SLOTS)):
            item = wp.static(SLOTS) * contact + slot
            if dof[pack, item, lane] >= 0:
                node = dof_node[dof[pack, item, lane]]
                if node < node_count:
                    total += weight[pack, item, lane] * vector_at(x, pack, lane, 3 * node)
        return total

    @wp.kernel(module=module, enable_backward=False)
    def changes(
        h: real,
        lanes: int,
        node_count: int,
        share: real,
        recovery: real,
        bounce_speed: real,
        # Model
        dof_node: wp.array(dtype=wp.int32),
        # State
        mu_slope_in: wp.array2d(dtype=real),
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        listed_in: wp.array3d(dtype=wp.int32),
        pair_in: wp.array3d(dtype=wp.int32),
        dof_in: wp.array3d(dtype=wp.int32),
        weight_in: wp.array3d(dtype=real),
        lever_in: wp.array3d(dtype=real),
        axes_in: wp.array3d(dtype=real),
        gap_in: wp.array3d(dtype=real),
        pair_distance_in: wp.array3d(dtype=real),
        restitution_in: wp.array3d(dtype=real),
        softness_in: wp.array3d(dtype=real),
        multiplier_in: wp.array3d(dtype=real),
        mode_in: wp.array3d(dtype=real),
        v_in: wp.array3d(dtype=real),
        v0_in: wp.array3d(dtype=real),
        x_slope_in: wp.array3d(dtype=real),
        v_slope_in: wp.array3d(dtype=real),
        # Workspace out
        change_out: wp.array3d(dtype=real),
        offset_out: wp.array3d(dtype=real),
    ):
        """S of one contact, and dmu l_n r of what slips."""
        pack, contact, lane = wp.tid()
        total = vec3()
        offset = vec3()
        if contact < count_in[pack, 0, lane] and mode_in[pack, 4 * contact, lane] > real(0.0):
            n = vector_at(axes_in, pack, lane, 9 * contact)
            distance = gap_in[pack, contact, lane]
            by_x = real(1.0)
            by_v = real(0.0)
            is_late = contact >= listed_in[pack, 0, lane]
            if distance < real(0.0) and softness_in[pack, contact, lane] == real(0.0) and not is_late:
                by_x = wp.where(share * distance < -recovery * h, real(0.0), share)
            bounce = restitution_in[pack, contact, lane]
            if bounce > real(0.0):
                u0, _ = motion(dof_in, weight_in, lever_in, v0_in, pack, lane, contact)
                before = wp.dot(n, u0)
                if before < -bounce_speed and distance + h * before <= real(0.0):
                    by_x = real(0.0)
                    by_v = h * bounce
            u = carried(dof_in, weight_in, dof_node, node_count, x_slope_in, pack, lane, contact)
            u0 = carried(dof_in, weight_in, dof_node, node_count, v_slope_in, pack, lane, contact)
            normal = -(by_x * wp.dot(n, u) + by_v * wp.dot(n, u0))
            _, spin = motion(dof_in, weight_in, lever_in, v_in, pack, lane, contact)
            pair = pair_in[pack, contact, lane]
            if distance + pair_distance_in[pack, pair, lane] > real(0.0):
                u = u - wp.dot(n, u) * n  # what is still apart will touch at its foot on the plane
            total = along(axes_in, pack, lane, contact, h * wp.cross(spin, u))
            total[0] = total[0] + normal
            if mode_in[pack, 4 * contact, lane] == real(2.0):
                world = wp.min(pack * lanes + lane, mu_slope_in.shape[0] - 1)
                friction = mu_slope_in[world, pair] * multiplier_in[pack, 3 * contact, lane]
                offset[1] = friction * mode_in[pack, 4 * contact + 2, lane]
                offset[2] = friction * mode_in[pack, 4 * contact + 3, lane]
        put(change_out, pack, lane, 3 * contact, total)
        put(offset_out, pack, lane, 3 * contact, offset)

    @wp.kernel(module=module, enable_backward=False)
    def take_changes(
        rows: int,
        # Workspace in
        change_in: wp.array3d(dtype=real),
        # Workspace out
        gap_out: wp.array3d(dtype=real),
    ):
        """g - S of one row of contacts."""
        pack, row, lane = wp.tid()
        gap_out[pack, rows + row, lane] = gap_out[pack, rows + row, lane] - change_in[pack, row, lane]

    return SimpleNamespace(changes=changes, take_changes=take_changes)
