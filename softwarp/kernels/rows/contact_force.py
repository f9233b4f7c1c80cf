"""Forces of contacts on the unknowns of their world, f P H' multiplier. Theory: docs/theory/contact.md."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.rows import contact as contact_rows
from softwarp.kernels.rows.warp_share import lowest_bit
from softwarp.model.codes import SLOTS

CHUNK = 8  # slots whose loop the compiler unrolls; a part of SLOTS
TOGETHER = 4  # contacts that it searches at a time: a bit of a whole number for each slot
HELD = 24  # slots that a thread may have found before it adds them
SHARING = 32  # threads that share the dofs of a world, a power of two
ALL_BITS = 2**31 - 1


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type."""
    real = variant.real
    vec3 = wp.types.vector(3, real)
    module = variant.module("contact_force")
    slot_row = contact_rows.kernels(variant).slot_row
    Held = wp.types.vector(HELD, wp.int32)

    @wp.func
    def add_slot(
        dof_free: wp.array2d(dtype=real),
        weight: wp.array3d(dtype=real),
        lever: wp.array3d(dtype=real),
        axes: wp.array3d(dtype=real),
        multiplier: wp.array3d(dtype=real),
        f_scale: real,
        pack: int,
        lane: int,
        contact: int,
        slot: int,
        dof: int,
        target_out: wp.array3d(dtype=real),
    ):
        """Add the force of one contact on the dof at one of its slots."""
        force = vec3()
        for axis in range(3):
            h = slot_row(weight, lever, axes, pack, lane, contact, slot, axis)
            force += h * (multiplier[pack, 3 * contact + axis, lane] * f_scale)
        for r in range(3):
            if dof >= dof_free.shape[0] or dof_free[dof, r] > real(0.0):
                target_out[pack, 3 * dof + r, lane] += force[r]

    @wp.kernel(module=module, enable_backward=False)
    def add_force(
        # Model
        dof_free: wp.array2d(dtype=real),
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        dof_in: wp.array3d(dtype=wp.int32),
        weight_in: wp.array3d(dtype=real),
        lever_in: wp.array3d(dtype=real),
        axes_in: wp.array3d(dtype=real),
        multiplier_in: wp.array3d(dtype=real),
        f_scale: real,
        # Workspace out
        target_out: wp.array3d(dtype=real),
    ):
        """target += f P H' multiplier of all contacts of one world, in their order; packs: ``contact_lanes``."""
        pack, lane = wp.tid()
        for contact in range(count_in[pack, 0, lane]):
            for slot in range(int(wp.static(SLOTS))):
                dof = dof_in[pack, wp.static(SLOTS) * contact + slot, lane]
                if dof >= 0:
                    add_slot(
                        dof_free,
                        weight_in,
                        lever_in,
                        axes_in,
                        multiplier_in,
                        f_scale,
                        pack,
                        lane,
                        contact,
                        slot,
                        dof,
                        target_out,
                    )

    @wp.func
    def add_slots(
        held: Held,
        count: int,
        dof_free: wp.array2d(dtype=real),
        dofs: wp.array3d(dtype=wp.int32),
        weight: wp.array3d(dtype=real),
        lever: wp.array3d(dtype=real),
        axes: wp.array3d(dtype=real),
        multiplier: wp.array3d(dtype=real),
        f_scale: real,
        pack: int,
        lane: int,
        target_out: wp.array3d(dtype=real),
    ):
        """Add the forces of contacts on dofs at the slots that are held, in their order."""
        for k in range(count):
            dof = dofs[pack, held[k], lane]
            contact = held[k] // wp.static(SLOTS)
            slot = held[k] % wp.static(SLOTS)
            add_slot(dof_free, weight, lever, axes, multiplier, f_scale, pack, lane, contact, slot, dof, target_out)

    @wp.func
    def add_own_slots(
        dof_free: wp.array2d(dtype=real),
        count: int,
        dofs: wp.array3d(dtype=wp.int32),
        weight: wp.array3d(dtype=real),
        lever: wp.array3d(dtype=real),
        axes: wp.array3d(dtype=real),
        multiplier: wp.array3d(dtype=real),
        f_scale: real,
        pack: int,
        lane: int,
        own: int,
        mask: int,
        target_out: wp.array3d(dtype=real),
    ):
        """Add the forces of contacts on dofs whose bits of ``mask`` are those of ``own``.

        A warp waits for the thread in it that has something to add, so slots are searched first and added then.
        Slots are filled from the first one on. Some contacts are searched at a time, so that their loads do not wait
        for each other, in their first slots, which are usually all.
        """
        held = Held()
        found = int(0)
        begin = int(0)
        while begin < count:
            matches = int(0)
            goes_on = bool(False)  # some contact may have more slots than the first ones
            for place in range(wp.static(CHUNK)):  # unrolled
                for other in range(wp.static(TOGETHER)):
                    dof = int(-1)
                    if begin + other < count:
                        dof = dofs[pack, wp.static(SLOTS) * (begin + other) + place, lane]
                    if dof >= 0 and dof & mask == own:
                        matches = matches | (1 << (wp.static(CHUNK) * other + place))
                    if place == wp.static(CHUNK - 1) and dof >= 0:
                        goes_on = True
            if not goes_on:
                while matches != 0:
                    bit = lowest_bit(matches)
                    matches = matches & (matches - 1)
                    held[found] = wp.static(SLOTS) * (begin + bit // wp.static(CHUNK)) + bit % wp.static(CHUNK)
                    found += 1
                    if found > wp.static(HELD - CHUNK):
                        add_slots(
                            held,
                            found,
                            dof_free,
                            dofs,
                            weight,
                            lever,
                            axes,
                            multiplier,
                            f_scale,
                            pack,
                            lane,
                            target_out,
                        )
                        found = 0
            else:
                for contact in range(begin, wp.min(begin + wp.static(TOGETHER), count)):
                    first = wp.static(SLOTS) * contact
                    end = first + wp.static(SLOTS)
                    while first < end:
                        last = int(-1)
                        for place in range(wp.static(CHUNK)):  # unrolled: these loads do not wait for each other
                            last = dofs[pack, first + place, lane]
                            if last >= 0 and last & mask == own:
                                held[found] = first + place
                                found += 1
                        if found > wp.static(HELD - CHUNK):
                            add_slots(
                                held,
                                found,
                                dof_free,
                                dofs,
                                weight,
                                lever,
                                axes,
                                multiplier,
                                f_scale,
                                pack,
                                lane,
                                target_out,
                            )
                            found = 0
                        first += wp.static(CHUNK)
                        if last < 0:
                            first = end
            begin += wp.static(TOGETHER)
        add_slots(held, found, dof_free, dofs, weight, lever, axes, multiplier, f_scale, pack, lane, target_out)

    @wp.kernel(module=module, enable_backward=False)
    def gather_force(
        # Model
        dof_free: wp.array2d(dtype=real),
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        idle_in: wp.array3d(dtype=wp.int32),
        dof_in: wp.array3d(dtype=wp.int32),
        weight_in: wp.array3d(dtype=real),
        lever_in: wp.array3d(dtype=real),
        axes_in: wp.array3d(dtype=real),
        multiplier_in: wp.array3d(dtype=real),
        f_scale: real,
        # Workspace out
        target_out: wp.array3d(dtype=real),
    ):
        """The same with a thread for every dof, for GPUs, where one for all of a world waits for each of its sums.

        Nobody asks for forces in idle worlds.
        """
        pack, dof, lane = wp.tid()
        if idle_in[pack, 0, lane] == 0:
            add_own_slots(
                dof_free,
                count_in[pack, 0, lane],
                dof_in,
                weight_in,
                lever_in,
                axes_in,
                multiplier_in,
                f_scale,
                pack,
                lane,
                dof,
                wp.static(ALL_BITS),
                target_out,
            )

    @wp.kernel(module=module, enable_backward=False)
    def share_force(
        threads: int,
        # Model
        dof_free: wp.array2d(dtype=real),
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        idle_in: wp.array3d(dtype=wp.int32),
        dof_in: wp.array3d(dtype=wp.int32),
        weight_in: wp.array3d(dtype=real),
        lever_in: wp.array3d(dtype=real),
        axes_in: wp.array3d(dtype=real),
        multiplier_in: wp.array3d(dtype=real),
        f_scale: real,
        # Workspace out
        target_out: wp.array3d(dtype=real),
    ):
        """The same where a world's threads are neighbours: a thread has some of many dofs, which few contacts touch."""
        pack, lane, thread = wp.tid()
        if idle_in[pack, 0, lane] == 0:
            add_own_slots(
                dof_free,
                count_in[pack, 0, lane],
                dof_in,
                weight_in,
                lever_in,
                axes_in,
                multiplier_in,
                f_scale,
                pack,
                lane,
                thread,
                threads - 1,
                target_out,
            )

    return SimpleNamespace(add_force=add_force, gather_force=gather_force, share_force=share_force)
