"""Contacts as multiplier rows: half-solved right-hand sides, Delassus entries, gaps and forces.

A contact has three rows (normal, two tangents). Its right-hand sides Y_c = L^-1 P H_c' are nonzero only on the *path*
of the contact: the dofs it touches and their ancestors in the elimination tree. Entry k of a path is a 3x3 block,
component r of the dof and axis s of the contact at ``9 (path_limit c + k) + 3 r + s``. Worlds of a pack share a path,
the union of theirs; where a world has no part in it, its entries are zero. Theory: docs/theory/contact.md.
"""

from functools import cache
from types import SimpleNamespace

import numpy as np
import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.rows import touch
from softwarp.model.codes import SLOTS

ROUNDING = 4.0  # eps of a contact's largest coordinate, up to which distances measured twice differ by rounding
UNKNOWN = 1.0e12  # distance from which a measurement found nothing [m]


@cache
def kernels(variant: Variant, together: bool = False) -> SimpleNamespace:
    """Contact kernels for one scalar type.

    Args:
        variant: Scalar type.
        together: Whether the sides of a world stand together in a GPU's memory. Threads that are neighbours then work
            on neighbouring items of one world in ``delassus_contacts``, ``delassus_rows``, ``free_gap`` and
            ``add_change``.
    """
    S = variant.S
    real = variant.real
    lanes = variant.lanes
    mul, fma = variant.mul, variant.fma
    world_fastest = variant.world_fastest
    item_first = world_fastest and not together
    vec3 = wp.types.vector(3, real)
    rounding = ROUNDING * float(np.finfo(np.float64 if real is wp.float64 else np.float32).eps)
    module = variant.module("contact_together" if together else "contact")
    Touch, first_dof, own_axes, mode_row = vars(touch.functions(variant)).values()

    @wp.func
    def slot_row(
        weight: wp.array3d(dtype=real),
        lever: wp.array3d(dtype=real),
        axes: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        contact: int,
        slot: int,
        axis: int,
    ):
        """Three entries of H at one slot: n for a velocity and lever x n for a spin, n an axis of the contact."""
        a = 9 * contact + 3 * axis
        q = wp.static(SLOTS) * contact + slot
        n = vec3(axes[pack, a, lane], axes[pack, a + 1, lane], axes[pack, a + 2, lane])
        r = vec3(lever[pack, 3 * q, lane], lever[pack, 3 * q + 1, lane], lever[pack, 3 * q + 2, lane])
        return weight[pack, q, lane] * n + wp.cross(r, n)

    @wp.kernel(module=module, enable_backward=False)
    def find_path(
        # Symbolic
        size: int,
        path_limit: int,
        parent: wp.array(dtype=wp.int32),
        # Model
        dof_free: wp.array2d(dtype=real),
        modes: Touch,
        # Workspace in
        pack_first_in: wp.array2d(dtype=wp.int32),
        pack_count_in: wp.array2d(dtype=wp.int32),
        dof_in: wp.array3d(dtype=wp.int32),
        # Workspace out
        path_size_out: wp.array2d(dtype=wp.int32),
        path_out: wp.array2d(dtype=wp.int32),
        place_out: wp.array2d(dtype=wp.int32),
        side_out: wp.array2d(dtype=S),
    ):
        """Path of one contact in ascending order, the place of every dof in it (or -1), and zero right-hand sides.

        For threads of one world; packs have ``contact_lanes.find_path``.
        """
        w, contact = wp.tid()
        if wp.static(world_fastest):
            contact, w = wp.tid()
        if contact < pack_first_in[w, 0] or contact >= pack_count_in[w, 0]:
            return
        base = contact * size
        for row in range(size):
            place_out[w, base + row] = -1
        first = size
        for slot in range(int(wp.static(SLOTS))):
            dof = int(-1)
            if wp.static(world_fastest):
                dof = dof_in[0, wp.static(SLOTS) * contact + slot, w]
            else:
                dof = dof_in[w, wp.static(SLOTS) * contact + slot, 0]
            if dof >= 0:
                dof = first_dof(modes, size, dof)
                if dof_free[dof, 0] + dof_free[dof, 1] + dof_free[dof, 2] == real(0.0):
                    dof = -1
                else:
                    first = wp.min(first, dof)
            while dof >= 0:
                if place_out[w, base + dof] >= 0:
                    dof = -1
                else:
                    place_out[w, base + dof] = 0
                    dof = parent[dof]
        k = int(0)
        start = contact * path_limit
        for row in range(first, size):
            if place_out[w, base + row] >= 0:
                place_out[w, base + row] = k
                path_out[w, start + k] = row
                for c in range(9):
                    side_out[w, 9 * (start + k) + c] = S(real(0.0))
                k += 1
        path_size_out[w, contact] = k

    @wp.kernel(module=module, enable_backward=False)
    def scatter_rows(
        # Symbolic
        size: int,
        path_limit: int,
        # Model
        dof_free: wp.array2d(dtype=real),
        modes: Touch,
        # Workspace in
        pack_first_in: wp.array3d(dtype=wp.int32),
        count_in: wp.array3d(dtype=wp.int32),
        dof_in: wp.array3d(dtype=wp.int32),
        weight_in: wp.array3d(dtype=real),
        lever_in: wp.array3d(dtype=real),
        axes_in: wp.array3d(dtype=real),
        place_in: wp.array3d(dtype=wp.int32),
        # Workspace out
        side_out: wp.array3d(dtype=real),
    ):
        """Y_c = P H_c' for one contact of one world."""
        pack, contact, lane = wp.tid()
        shared = lane
        if wp.static(lanes > 1):
            shared = 0
        if contact < pack_first_in[pack, 0, shared] or contact >= count_in[pack, 0, lane]:
            return
        for slot in range(int(wp.static(SLOTS))):
            dof = dof_in[pack, wp.static(SLOTS) * contact + slot, lane]
            place = int(-1)
            if dof >= size:
                node = dof - size
                n0 = slot_row(weight_in, lever_in, axes_in, pack, lane, contact, slot, 0)
                n1 = slot_row(weight_in, lever_in, axes_in, pack, lane, contact, slot, 1)
                n2 = slot_row(weight_in, lever_in, axes_in, pack, lane, contact, slot, 2)
                own0 = own_axes(modes, node, n0, pack, lane)
                own1 = own_axes(modes, node, n1, pack, lane)
                own2 = own_axes(modes, node, n2, pack, lane)
                for block in range(modes.begin[node], modes.end[node]):
                    t = 9 * (contact * path_limit + place_in[pack, contact * size + modes.dof[block], shared])
                    h0 = mode_row(modes, block, node, n0, own0, pack, lane)
                    h1 = mode_row(modes, block, node, n1, own1, pack, lane)
                    h2 = mode_row(modes, block, node, n2, own2, pack, lane)
                    for r in range(3):
                        side_out[pack, t + 3 * r, lane] += h0[r]
                        side_out[pack, t + 3 * r + 1, lane] += h1[r]
                        side_out[pack, t + 3 * r + 2, lane] += h2[r]
            elif dof >= 0:
                place = place_in[pack, contact * size + dof, shared]
            if place >= 0:
                t = 9 * (contact * path_limit + place)
                for axis in range(3):
                    h = slot_row(weight_in, lever_in, axes_in, pack, lane, contact, slot, axis)
                    for r in range(3):
                        side_out[pack, t + 3 * r + axis, lane] += h[r] * dof_free[dof, r]

    @wp.func
    def scaled_block(diagonal: wp.array2d(dtype=S), side: wp.array2d(dtype=S), w: int, d: int, t: int):
        """``Li_j Y_j``, stored and returned."""
        i00 = diagonal[w, d]
        i10 = diagonal[w, d + 1]
        i11 = diagonal[w, d + 2]
        i20 = diagonal[w, d + 3]
        i21 = diagonal[w, d + 4]
        i22 = diagonal[w, d + 5]
        z00 = mul(i00, side[w, t])
        z01 = mul(i00, side[w, t + 1])
        z02 = mul(i00, side[w, t + 2])
        z10 = mul(i10, side[w, t]) + mul(i11, side[w, t + 3])
        z11 = mul(i10, side[w, t + 1]) + mul(i11, side[w, t + 4])
        z12 = mul(i10, side[w, t + 2]) + mul(i11, side[w, t + 5])
        z20 = mul(i20, side[w, t]) + mul(i21, side[w, t + 3]) + mul(i22, side[w, t + 6])
        z21 = mul(i20, side[w, t + 1]) + mul(i21, side[w, t + 4]) + mul(i22, side[w, t + 7])
        z22 = mul(i20, side[w, t + 2]) + mul(i21, side[w, t + 5]) + mul(i22, side[w, t + 8])
        side[w, t] = z00
        side[w, t + 1] = z01
        side[w, t + 2] = z02
        side[w, t + 3] = z10
        side[w, t + 4] = z11
        side[w, t + 5] = z12
        side[w, t + 6] = z20
        side[w, t + 7] = z21
        side[w, t + 8] = z22
        return z00, z01, z02, z10, z11, z12, z20, z21, z22

    @wp.kernel(module=module, enable_backward=False)
    def substitute(
        # Symbolic
        size: int,
        path_limit: int,
        l_row: wp.array(dtype=wp.int32),
        col_start: wp.array(dtype=wp.int32),
        # Workspace in
        pack_first_in: wp.array2d(dtype=wp.int32),
        pack_count_in: wp.array2d(dtype=wp.int32),
        path_size_in: wp.array2d(dtype=wp.int32),
        path_in: wp.array2d(dtype=wp.int32),
        place_in: wp.array2d(dtype=wp.int32),
        lower_in: wp.array2d(dtype=S),
        diagonal_in: wp.array2d(dtype=S),
        # Workspace out
        side_out: wp.array2d(dtype=S),
    ):
        """Y_c <- L^-1 Y_c for one contact, column by column along its path; rows below a path entry lie on the path."""
        w, contact = wp.tid()
        if wp.static(world_fastest):
            contact, w = wp.tid()
        if contact < pack_first_in[w, 0] or contact >= pack_count_in[w, 0]:
            return
        start = contact * path_limit
        for k in range(path_size_in[w, contact]):
            j = path_in[w, start + k]
            z00, z01, z02, z10, z11, z12, z20, z21, z22 = scaled_block(diagonal_in, side_out, w, 6 * j, 9 * (start + k))
            for block in range(col_start[j], col_start[j + 1]):
                b = 9 * block
                t = 9 * (start + place_in[w, contact * size + l_row[block]])
                for r in range(3):
                    l0 = lower_in[w, b + 3 * r]
                    l1 = lower_in[w, b + 3 * r + 1]
                    l2 = lower_in[w, b + 3 * r + 2]
                    q = t + 3 * r
                    side_out[w, q] -= mul(l0, z00) + mul(l1, z10) + mul(l2, z20)
                    side_out[w, q + 1] -= mul(l0, z01) + mul(l1, z11) + mul(l2, z21)
                    side_out[w, q + 2] -= mul(l0, z02) + mul(l1, z12) + mul(l2, z22)

    @wp.kernel(module=module, enable_backward=False)
    def delassus_contacts(
        # Symbolic
        size: int,
        path_limit: int,
        row_count: int,
        order: int,
        parts: int,
        # Workspace in
        pack_first_in: wp.array2d(dtype=wp.int32),
        pack_count_in: wp.array2d(dtype=wp.int32),
        path_size_in: wp.array2d(dtype=wp.int32),
        path_in: wp.array2d(dtype=wp.int32),
        place_in: wp.array2d(dtype=wp.int32),
        side_in: wp.array2d(dtype=S),
        scale: real,
        # Workspace out
        delassus_out: wp.array2d(dtype=S),
    ):
        """Blocks W_cd (and W_dc) of one contact c with part of the contacts d <= c."""
        w, contact, part = wp.tid()
        if wp.static(item_first):
            contact, part, w = wp.tid()
        if contact < pack_first_in[w, 0] or contact >= pack_count_in[w, 0]:
            return
        start = contact * path_limit
        steps = path_size_in[w, contact]
        for other in range(part, contact + 1, parts):
            s00 = S(real(0.0))
            s01 = S(real(0.0))
            s02 = S(real(0.0))
            s10 = S(real(0.0))
            s11 = S(real(0.0))
            s12 = S(real(0.0))
            s20 = S(real(0.0))
            s21 = S(real(0.0))
            s22 = S(real(0.0))
            for k in range(steps):
                place = place_in[w, other * size + path_in[w, start + k]]
                if place >= 0:
                    p = 9 * (start + k)
                    q = 9 * (other * path_limit + place)
                    for r in range(3):
                        a0 = side_in[w, p + 3 * r]
                        a1 = side_in[w, p + 3 * r + 1]
                        a2 = side_in[w, p + 3 * r + 2]
                        b0 = side_in[w, q + 3 * r]
                        b1 = side_in[w, q + 3 * r + 1]
                        b2 = side_in[w, q + 3 * r + 2]
                        s00 = fma(a0, b0, s00)
                        s01 = fma(a0, b1, s01)
                        s02 = fma(a0, b2, s02)
                        s10 = fma(a1, b0, s10)
                        s11 = fma(a1, b1, s11)
                        s12 = fma(a1, b2, s12)
                        s20 = fma(a2, b0, s20)
                        s21 = fma(a2, b1, s21)
                        s22 = fma(a2, b2, s22)
            i = row_count + 3 * contact
            j = row_count + 3 * other
            store_pair(delassus_out, w, order, i, j, s00 * scale, s01 * scale, s02 * scale)
            store_pair(delassus_out, w, order, i + 1, j, s10 * scale, s11 * scale, s12 * scale)
            store_pair(delassus_out, w, order, i + 2, j, s20 * scale, s21 * scale, s22 * scale)

    @wp.func
    def store_pair(delassus: wp.array2d(dtype=S), w: int, order: int, i: int, j: int, s0: S, s1: S, s2: S):
        """Write three entries of a row of W and of its mirror image."""
        delassus[w, i * order + j] = s0
        delassus[w, i * order + j + 1] = s1
        delassus[w, i * order + j + 2] = s2
        delassus[w, j * order + i] = s0
        delassus[w, (j + 1) * order + i] = s1
        delassus[w, (j + 2) * order + i] = s2

    @wp.kernel(module=module, enable_backward=False)
    def delassus_rows(
        # Symbolic
        size: int,
        path_limit: int,
        row_count: int,
        order: int,
        parts: int,
        # Workspace in
        pack_first_in: wp.array2d(dtype=wp.int32),
        pack_count_in: wp.array2d(dtype=wp.int32),
        path_size_in: wp.array2d(dtype=wp.int32),
        path_in: wp.array2d(dtype=wp.int32),
        side_in: wp.array2d(dtype=S),
        y_in: wp.array2d(dtype=S),
        scale: real,
        # Workspace out
        delassus_out: wp.array2d(dtype=S),
    ):
        """Entries of W between one contact and part of the static rows."""
        w, contact, part = wp.tid()
        if wp.static(item_first):
            contact, part, w = wp.tid()
        if contact < pack_first_in[w, 0] or contact >= pack_count_in[w, 0]:
            return
        start = contact * path_limit
        for row in range(part, row_count, parts):
            s0 = S(real(0.0))
            s1 = S(real(0.0))
            s2 = S(real(0.0))
            for k in range(path_size_in[w, contact]):
                p = 9 * (start + k)
                q = 3 * (size * (1 + row) + path_in[w, start + k])
                for r in range(3):
                    y = y_in[w, q + r]
                    s0 = fma(side_in[w, p + 3 * r], y, s0)
                    s1 = fma(side_in[w, p + 3 * r + 1], y, s1)
                    s2 = fma(side_in[w, p + 3 * r + 2], y, s2)
            i = row_count + 3 * contact
            delassus_out[w, row * order + i] = s0 * scale
            delassus_out[w, row * order + i + 1] = s1 * scale
            delassus_out[w, row * order + i + 2] = s2 * scale
            delassus_out[w, i * order + row] = s0 * scale
            delassus_out[w, (i + 1) * order + row] = s1 * scale
            delassus_out[w, (i + 2) * order + row] = s2 * scale

    @wp.kernel(module=module, enable_backward=False)
    def known_gap(
        row_count: int,
        # Workspace in
        pack_count_in: wp.array3d(dtype=wp.int32),
        listed_in: wp.array3d(dtype=wp.int32),
        count_in: wp.array3d(dtype=wp.int32),
        dof_in: wp.array3d(dtype=wp.int32),
        weight_in: wp.array3d(dtype=real),
        lever_in: wp.array3d(dtype=real),
        axes_in: wp.array3d(dtype=real),
        distance_in: wp.array3d(dtype=real),
        restitution_in: wp.array3d(dtype=real),
        softness_in: wp.array3d(dtype=real),
        v0_in: wp.array3d(dtype=real),
        v_in: wp.array3d(dtype=real),
        u_in: wp.array3d(dtype=real),
        point_in: wp.array3d(dtype=real),
        end_in: wp.array3d(dtype=real),
        is_measured: bool,
        x_scale: real,
        share: real,
        recovery: real,
        bounce_speed: real,
        # Workspace out
        gap_out: wp.array3d(dtype=real),
    ):
        """Gaps of one contact of one world from the velocities known so far: target of the normal law + s H (v + u).

        For threads of one world; packs have ``contact_lanes.known_gap``.
        ``is_measured`` takes the distance measured where these velocities lead to, if it is less than the linear one by
        more than coordinates round.
        """
        pack, contact, lane = wp.tid()
        if contact >= pack_count_in[pack, 0, lane]:
            return
        i = row_count + 3 * contact
        if contact >= count_in[pack, 0, lane]:
            gap_out[pack, i, lane] = real(1.0)
            gap_out[pack, i + 1, lane] = real(0.0)
            gap_out[pack, i + 2, lane] = real(0.0)
            return
        restitution = restitution_in[pack, contact, lane]
        before = real(0.0)
        slip = vec3()
        for slot in range(int(wp.static(SLOTS))):
            dof = dof_in[pack, wp.static(SLOTS) * contact + slot, lane]
            if dof >= 0:
                t = 3 * dof
                v = vec3(v_in[pack, t, lane], v_in[pack, t + 1, lane], v_in[pack, t + 2, lane])
                v += vec3(u_in[pack, t, lane], u_in[pack, t + 1, lane], u_in[pack, t + 2, lane])
                for axis in range(3):
                    h = slot_row(weight_in, lever_in, axes_in, pack, lane, contact, slot, axis)
                    slip[axis] += wp.dot(h, v)
                    if axis == 0 and restitution > real(0.0):
                        before += wp.dot(
                            h, vec3(v0_in[pack, t, lane], v0_in[pack, t + 1, lane], v0_in[pack, t + 2, lane])
                        )
        distance = distance_in[pack, contact, lane]
        target = distance
        is_late = contact >= listed_in[pack, 0, lane]
        if target < real(0.0) and softness_in[pack, contact, lane] == real(0.0) and not is_late:
            target = wp.max(share * target, -recovery * x_scale)
        normal = target + x_scale * slip[0]
        if restitution > real(0.0) and before < -bounce_speed and distance + x_scale * before <= real(0.0):
            normal = x_scale * (restitution * before + slip[0])
        elif is_measured:
            if end_in[pack, contact, lane] < real(wp.static(UNKNOWN)):
                p = 3 * contact
                place = wp.max(wp.abs(point_in[pack, p, lane]), wp.abs(point_in[pack, p + 1, lane]))
                place = wp.max(place, wp.abs(point_in[pack, p + 2, lane]))
                measured = end_in[pack, contact, lane] - (distance - target)
                normal = wp.min(normal, measured + place * real(wp.static(rounding)))
        gap_out[pack, i, lane] = normal
        gap_out[pack, i + 1, lane] = x_scale * slip[1]
        gap_out[pack, i + 2, lane] = x_scale * slip[2]

    @wp.kernel(module=module, enable_backward=False)
    def free_gap(
        # Symbolic
        path_limit: int,
        row_count: int,
        # Workspace in
        pack_count_in: wp.array2d(dtype=wp.int32),
        path_size_in: wp.array2d(dtype=wp.int32),
        path_in: wp.array2d(dtype=wp.int32),
        side_in: wp.array2d(dtype=S),
        y_in: wp.array2d(dtype=S),
        x_scale: real,
        # Workspace out
        gap_out: wp.array2d(dtype=S),
    ):
        """Gaps of one contact: add s Y' y, the motion without new multipliers."""
        w, contact = wp.tid()
        if wp.static(item_first):
            contact, w = wp.tid()
        if contact >= pack_count_in[w, 0]:
            return
        s0 = S(real(0.0))
        s1 = S(real(0.0))
        s2 = S(real(0.0))
        start = contact * path_limit
        for k in range(path_size_in[w, contact]):
            p = 9 * (start + k)
            q = 3 * path_in[w, start + k]
            for r in range(3):
                y = y_in[w, q + r]
                s0 = fma(side_in[w, p + 3 * r], y, s0)
                s1 = fma(side_in[w, p + 3 * r + 1], y, s1)
                s2 = fma(side_in[w, p + 3 * r + 2], y, s2)
        i = row_count + 3 * contact
        gap_out[w, i] += s0 * x_scale
        gap_out[w, i + 1] += s1 * x_scale
        gap_out[w, i + 2] += s2 * x_scale

    @wp.kernel(module=module, enable_backward=False)
    def add_change(
        # Symbolic
        size: int,
        path_limit: int,
        row_count: int,
        # Workspace in
        pack_count_in: wp.array2d(dtype=wp.int32),
        place_in: wp.array2d(dtype=wp.int32),
        side_in: wp.array2d(dtype=S),
        change_in: wp.array2d(dtype=S),
        f_scale: real,
        # Workspace out
        y_out: wp.array2d(dtype=S),
    ):
        """y += f Y_c change_c of all contacts, for one dof."""
        w, dof = wp.tid()
        if wp.static(item_first):
            dof, w = wp.tid()
        s0 = S(real(0.0))
        s1 = S(real(0.0))
        s2 = S(real(0.0))
        for contact in range(pack_count_in[w, 0]):
            place = place_in[w, contact * size + dof]
            if place >= 0:
                t = 9 * (contact * path_limit + place)
                for axis in range(3):
                    value = change_in[w, row_count + 3 * contact + axis]
                    s0 = fma(side_in[w, t + axis], value, s0)
                    s1 = fma(side_in[w, t + 3 + axis], value, s1)
                    s2 = fma(side_in[w, t + 6 + axis], value, s2)
        y_out[w, 3 * dof] += s0 * f_scale
        y_out[w, 3 * dof + 1] += s1 * f_scale
        y_out[w, 3 * dof + 2] += s2 * f_scale

    @wp.kernel(module=module, enable_backward=False)
    def add_change_on_paths(
        # Symbolic
        path_limit: int,
        row_count: int,
        # Workspace in
        pack_count_in: wp.array2d(dtype=wp.int32),
        path_size_in: wp.array2d(dtype=wp.int32),
        path_in: wp.array2d(dtype=wp.int32),
        side_in: wp.array2d(dtype=S),
        change_in: wp.array2d(dtype=S),
        f_scale: real,
        # Workspace out
        y_out: wp.array2d(dtype=S),
    ):
        """``add_change`` for all dofs, contact after contact along its path; for a CPU, where dofs share a thread."""
        w = wp.tid()
        for contact in range(pack_count_in[w, 0]):
            start = contact * path_limit
            i = row_count + 3 * contact
            change0 = change_in[w, i] * f_scale
            change1 = change_in[w, i + 1] * f_scale
            change2 = change_in[w, i + 2] * f_scale
            for k in range(path_size_in[w, contact]):
                t = 9 * (start + k)
                row = 3 * path_in[w, start + k]
                for r in range(3):
                    s = mul(side_in[w, t + 3 * r], change0) + mul(side_in[w, t + 3 * r + 1], change1)
                    y_out[w, row + r] += s + mul(side_in[w, t + 3 * r + 2], change2)

    return SimpleNamespace(
        find_path=find_path,
        scatter_rows=scatter_rows,
        substitute=substitute,
        delassus_contacts=delassus_contacts,
        delassus_rows=delassus_rows,
        known_gap=known_gap,
        free_gap=free_gap,
        add_change=add_change,
        add_change_on_paths=add_change_on_paths,
        slot_row=slot_row,
    )
