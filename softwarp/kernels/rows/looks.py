"""Which contacts are worked on, and further looks at them in worlds that the last one has moved far.

Theory: docs/theory/contact.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant

SWEPT = 0.01  # of the skin, what the last sweep over the contacts may have corrected where they are solved
LEAST_PART = 1.0e-3  # of a way, below which distances at its end are those of that much
NONE = 1 << 30  # first contact of a world that has none to be worked on


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels of one variant: ``pack_count`` on packs, the others on single worlds."""
    real, lanes, world_fastest = variant.real, variant.lanes, variant.world_fastest
    module = variant.module("looks")

    @wp.kernel(module=module, enable_backward=False)
    def pack_count(
        # Workspace in
        first_in: wp.array3d(dtype=wp.int32),
        count_in: wp.array3d(dtype=wp.int32),
        idle_in: wp.array3d(dtype=wp.int32),
        # Workspace out
        pack_first_out: wp.array2d(dtype=wp.int32),
        pack_count_out: wp.array2d(dtype=wp.int32),
    ):
        """Range of the contacts to be worked on among the worlds of one pack, from their first to the end.

        Idle worlds have none.
        """
        w = wp.tid()
        lowest = int(NONE)
        largest = int(0)
        for lane in range(wp.static(lanes)):
            first = int(0)
            count = int(0)
            if wp.static(world_fastest):
                first = first_in[0, 0, w]
                count = count_in[0, 0, w] * (1 - idle_in[0, 0, w])
            else:
                first = first_in[w, 0, lane]
                count = count_in[w, 0, lane] * (1 - idle_in[w, 0, lane])
            largest = wp.max(largest, count)
            if first < count:
                lowest = wp.min(lowest, first)
        pack_first_out[w, 0] = wp.min(lowest, largest)
        pack_count_out[w, 0] = largest

    @wp.kernel(module=module, enable_backward=False)
    def watch(
        dof_count: int,
        x_scale: real,
        skin: real,
        # Model
        dof_arm: wp.array(dtype=real),
        # Workspace in
        before_in: wp.array3d(dtype=real),
        now_in: wp.array3d(dtype=real),
        residual_in: wp.array3d(dtype=real),
        # Workspace out
        idle_out: wp.array3d(dtype=wp.int32),
        any_out: wp.array(dtype=wp.int32),
    ):
        """Whether the last correction of the unknowns moved nothing in a world by more than ``skin`` [m].

        Nor would have, had it had more sweeps: the last one corrected no gap by more than a hundredth of that.
        """
        pack, lane = wp.tid()
        farthest = real(0.0)
        for dof in range(dof_count):
            way = real(0.0)
            for c in range(3):
                step = now_in[pack, 3 * dof + c, lane] - before_in[pack, 3 * dof + c, lane]
                way += step * step
            farthest = wp.max(farthest, way * dof_arm[dof] * dof_arm[dof])
        if wp.max(wp.sqrt(farthest) * x_scale, residual_in[pack, 0, lane] / real(wp.static(SWEPT))) > skin:
            idle_out[pack, 0, lane] = 0
            wp.atomic_max(any_out, 0, 1)  # few worlds
        else:
            idle_out[pack, 0, lane] = 1

    @wp.kernel(module=module, enable_backward=False)
    def go_part(
        # Workspace in
        share_in: wp.array3d(dtype=real),
        u_in: wp.array3d(dtype=real),
        # Workspace out
        v_out: wp.array3d(dtype=real),
    ):
        """Velocities receive the part of the unknowns that a world goes."""
        pack, row, lane = wp.tid()
        v_out[pack, row, lane] = v_out[pack, row, lane] + share_in[pack, 0, lane] * u_in[pack, row, lane]

    @wp.kernel(module=module, enable_backward=False)
    def extend(
        # Workspace in
        share_in: wp.array3d(dtype=real),
        # Workspace out
        end_out: wp.array3d(dtype=real),
    ):
        """Distance at the end of the whole way for which that at the end of the part is 0, linear in the way."""
        pack, contact, lane = wp.tid()
        share = wp.max(share_in[pack, 0, lane], real(wp.static(LEAST_PART)))
        end_out[pack, contact, lane] = end_out[pack, contact, lane] / share

    @wp.kernel(module=module, enable_backward=False)
    def quiet(
        # Workspace in
        idle_in: wp.array3d(dtype=wp.int32),
        # Workspace out
        near_out: wp.array3d(dtype=real),
        reach_out: wp.array3d(dtype=real),
    ):
        """No couple of an idle world is near, so that nothing is searched there and nothing found.

        One that is near here, but was not where the step begins, is measured within the reach that it has here.
        """
        pack, couple, lane = wp.tid()
        if idle_in[pack, 0, lane] != 0:
            near_out[pack, couple, lane] = real(-1.0)
        reach_out[pack, couple, lane] = wp.max(reach_out[pack, couple, lane], near_out[pack, couple, lane])

    @wp.kernel(module=module, enable_backward=False)
    def hold(
        # Workspace in
        idle_in: wp.array3d(dtype=wp.int32),
        before_in: wp.array3d(dtype=real),
        # Workspace out
        now_out: wp.array3d(dtype=real),
    ):
        """An idle world keeps what it had before."""
        pack, row, lane = wp.tid()
        if idle_in[pack, 0, lane] != 0:
            now_out[pack, row, lane] = before_in[pack, row, lane]

    return SimpleNamespace(pack_count=pack_count, watch=watch, go_part=go_part, extend=extend, quiet=quiet, hold=hold)
