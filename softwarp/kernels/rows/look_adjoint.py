"""Steps that look at contacts where a first solution leads to, in the adjoint. Theory: docs/theory/adjoint.md.

A contact that pushes has its normal law from the start of the step, or from a distance that was measured where the
first solution leads to; which, is found again here, as ``contact.known_gap`` has chosen. What the law has of that
solution is the seed of an adjoint of its own.
"""

from types import SimpleNamespace

import numpy as np
import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.collision.geometry import NORMAL, TOUCH_ROWS
from softwarp.kernels.rows import contact_adjoint
from softwarp.kernels.rows.contact import ROUNDING, UNKNOWN
from softwarp.kernels.rows.touch_adjoint import AT_START, BOUNCED, LATE, MEASURED


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type, on single worlds: (pack, row, lane)."""
    real, world_fastest = variant.real, variant.world_fastest
    module = variant.module("adjoint.look")
    one = single.functions(variant)
    vector_at, put = one.vector_at, one.put
    motion = contact_adjoint.functions(variant).motion
    rounding = ROUNDING * float(np.finfo(wp.dtype_to_numpy(real)).eps)

    @wp.kernel(module=module, enable_backward=False)
    def looks(
        h: real,
        share: real,
        recovery: real,
        bounce_speed: real,
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        listed_in: wp.array3d(dtype=wp.int32),
        late_in: wp.array3d(dtype=wp.int32),
        dof_in: wp.array3d(dtype=wp.int32),
        weight_in: wp.array3d(dtype=real),
        lever_in: wp.array3d(dtype=real),
        axes_in: wp.array3d(dtype=real),
        point_in: wp.array3d(dtype=real),
        gap_in: wp.array3d(dtype=real),
        restitution_in: wp.array3d(dtype=real),
        softness_in: wp.array3d(dtype=real),
        multiplier_in: wp.array3d(dtype=real),
        v0_in: wp.array3d(dtype=real),
        u_in: wp.array3d(dtype=real),
        end_in: wp.array3d(dtype=real),
        touch_in: wp.array3d(dtype=real),
        # Workspace out
        look_out: wp.array3d(dtype=wp.int32),
        normal_out: wp.array3d(dtype=real),
    ):
        """What the law of one contact looks at, and the normal where the first solution ``u`` leads to."""
        pack, contact, lane = wp.tid()
        look = int(wp.static(AT_START))
        if contact < count_in[pack, 0, lane] and multiplier_in[pack, 3 * contact, lane] > real(0.0):
            n = vector_at(axes_in, pack, lane, 9 * contact)
            way, _spin = motion(dof_in, weight_in, lever_in, u_in, pack, lane, contact)
            was, _turn = motion(dof_in, weight_in, lever_in, v0_in, pack, lane, contact)
            before = wp.dot(n, was)
            distance = gap_in[pack, contact, lane]
            bounces = restitution_in[pack, contact, lane] > real(0.0) and before < -bounce_speed
            bounces = bounces and distance + h * before <= real(0.0)
            if contact >= late_in[pack, 0, lane]:
                look = wp.where(bounces, wp.static(BOUNCED), wp.static(LATE))
            elif not bounces and end_in[pack, contact, lane] < real(wp.static(UNKNOWN)):
                target = distance
                is_new = contact >= listed_in[pack, 0, lane]
                if target < real(0.0) and softness_in[pack, contact, lane] == real(0.0) and not is_new:
                    target = wp.max(share * target, -recovery * h)
                place = real(0.0)
                for c in range(3):
                    place = wp.max(place, wp.abs(point_in[pack, 3 * contact + c, lane]))
                measured = end_in[pack, contact, lane] - (distance - target) + place * real(wp.static(rounding))
                if measured < target + h * wp.dot(n, way):
                    look = wp.static(MEASURED)
            put(
                normal_out,
                pack,
                lane,
                3 * contact,
                vector_at(touch_in, pack, lane, wp.static(TOUCH_ROWS) * contact + wp.static(NORMAL)),
            )
        look_out[pack, contact, lane] = look

    @wp.kernel(module=module, enable_backward=False)
    def any_look(
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        look_in: wp.array3d(dtype=wp.int32),
        # Workspace out
        any_out: wp.array(dtype=wp.int32),
    ):
        """Whether any contact looks at where the first solution leads to."""
        pack, contact, lane = wp.tid()
        if contact < count_in[pack, 0, lane] and look_in[pack, contact, lane] > wp.static(AT_START):
            any_out[0] = 1

    @wp.kernel(module=module, enable_backward=False)
    def ways(
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        look_in: wp.array3d(dtype=wp.int32),
        z_in: wp.array3d(dtype=real),
        # Workspace out
        way_out: wp.array3d(dtype=real),
    ):
        """z_n of a contact whose distance counts from where the first solution leads to, as a force; else 0."""
        pack, contact, lane = wp.tid()
        value = real(0.0)
        if contact < count_in[pack, 0, lane]:
            look = look_in[pack, contact, lane]
            if look == wp.static(MEASURED) or look == wp.static(LATE):
                value = z_in[pack, 3 * contact, lane]
        way_out[pack, 3 * contact, lane] = value
        way_out[pack, 3 * contact + 1, lane] = real(0.0)
        way_out[pack, 3 * contact + 2, lane] = real(0.0)

    @wp.kernel(module=module, enable_backward=False)
    def first_forces(
        # Workspace in
        listed_in: wp.array3d(dtype=wp.int32),
        force_in: wp.array3d(dtype=real),
        # Workspace out
        force_out: wp.array3d(dtype=real),
    ):
        """Forces of one contact in the first solution, which knew of those that were listed."""
        pack, contact, lane = wp.tid()
        for c in range(3):
            force = real(0.0)
            if contact < listed_in[pack, 0, lane]:
                force = force_in[pack, 3 * contact + c, lane]
            force_out[pack, 3 * contact + c, lane] = force

    @wp.func
    def rows_of(part: int, count: int):
        """First and last row of a thread."""
        if wp.static(world_fastest):
            return part, part + 1
        return 0, count

    @wp.kernel(module=module, enable_backward=False)
    def hand_over(
        lanes: int,
        # State
        part_in: wp.array2d(dtype=real),
        # State out
        bar_out: wp.array2d(dtype=real),
        total_out: wp.array2d(dtype=real),
    ):
        """Keep a gradient as it is so far, and put that by the end of the first solution's way there.

        On a GPU, a thread has one row.
        """
        pack, part, lane = wp.tid()
        world = pack * lanes + lane
        if world < bar_out.shape[0]:
            first, last = rows_of(part, bar_out.shape[1])
            for row in range(first, last):
                total_out[world, row] = bar_out[world, row]
                bar_out[world, row] = part_in[world, row]

    @wp.kernel(module=module, enable_backward=False)
    def take_back(
        lanes: int,
        # State
        total_in: wp.array2d(dtype=real),
        # State out
        bar_out: wp.array2d(dtype=real),
    ):
        """Add what a gradient was before, as ``hand_over`` has kept it."""
        pack, part, lane = wp.tid()
        world = pack * lanes + lane
        if world < bar_out.shape[0]:
            first, last = rows_of(part, bar_out.shape[1])
            for row in range(first, last):
                bar_out[world, row] = total_in[world, row] + bar_out[world, row]

    @wp.kernel(module=module, enable_backward=False)
    def take_listed(
        lanes: int,
        # Model
        node: wp.array(dtype=wp.int32),
        # State
        total_in: wp.array2d(dtype=real),
        # Workspace out
        listed_out: wp.array3d(dtype=real),
    ):
        """Add what the gradient by one listed node was before."""
        pack, item, lane = wp.tid()
        world = pack * lanes + lane
        if world < total_in.shape[0]:
            for c in range(3):
                listed_out[pack, 3 * item + c, lane] += total_in[world, 3 * node[item] + c]

    return SimpleNamespace(
        looks=looks,
        any_look=any_look,
        ways=ways,
        first_forces=first_forces,
        hand_over=hand_over,
        take_back=take_back,
        take_listed=take_listed,
    )
