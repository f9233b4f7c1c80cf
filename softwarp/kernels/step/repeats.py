"""Which worlds take a step again, and their rows to the places where they do and back.

Theory: docs/theory/telescope.md, "Swings".
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.model.codes import Status

COUNT, DONE, ROWS = range(3)  # of the progress through the worlds that repeat
GROUP = 64  # neighbouring worlds that are counted together


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels on single worlds; those that copy run over (place, row), of which a thread on a CPU takes all rows."""
    real = variant.real
    world_fastest = variant.world_fastest
    module = variant.module("repeats")

    @wp.func
    def rows_of(part: int, count: int):
        """Rows of one thread."""
        first = int(0)
        last = count
        if wp.static(world_fastest):
            first = part
            last = part + 1
        return first, last

    @wp.func
    def world_at(place: int, progress: wp.array(dtype=wp.int32), order: wp.array(dtype=wp.int32)):
        """World that a place takes; places past the last one repeat it."""
        return order[wp.min(progress[wp.static(DONE)] + place, progress[wp.static(COUNT)] - 1)]

    @wp.kernel(module=module, enable_backward=False)
    def choose(
        limit: real,
        lanes: int,
        world_count: int,
        # Workspace in
        swing_in: wp.array3d(dtype=real),
        # Workspace out
        again_out: wp.array3d(dtype=wp.int32),
        progress_out: wp.array(dtype=wp.int32),
        group_out: wp.array(dtype=wp.int32),
    ):
        """A world repeats its step if that swings a segment by more than ``limit`` [rad], or is not finite."""
        pack, lane = wp.tid()
        world = pack * lanes + lane
        again = int(0)
        if world < world_count:
            if not (swing_in[pack, 0, lane] <= limit):
                again = int(1)
                wp.atomic_add(progress_out, wp.static(COUNT), 1)  # of integers: the same in any order
                wp.atomic_add(group_out, world // wp.static(GROUP), 1)
        again_out[pack, 0, lane] = again

    @wp.kernel(module=module, enable_backward=False)
    def number(
        lanes: int,
        # Workspace in
        again_in: wp.array3d(dtype=wp.int32),
        group_in: wp.array(dtype=wp.int32),
        # Workspace out
        order_out: wp.array(dtype=wp.int32),
    ):
        """Worlds that repeat a step, few of all, by their numbers: chance has no say in who shares places with whom."""
        pack, lane = wp.tid()
        if again_in[pack, 0, lane] == 0:
            return
        world = pack * lanes + lane
        before = int(0)
        own = world // wp.static(GROUP)
        for group in range(own):
            before += group_in[group]
        for other in range(wp.static(GROUP) * own, world):
            before += again_in[other // lanes, 0, other % lanes]
        order_out[before] = world

    @wp.kernel(module=module, enable_backward=False)
    def go_on(
        places: int,
        # Workspace in
        fewer_in: wp.array(dtype=wp.int32),
        # Workspace out
        progress_out: wp.array(dtype=wp.int32),
        left_out: wp.array(dtype=wp.int32),
        more_out: wp.array(dtype=wp.int32),
    ):
        """Count worlds that have repeated their step, and whether more are left than each fewer places hold.

        ``places`` of them are done, 0 begins.
        """
        sample = wp.tid()
        done = int(0)
        if places > 0:
            done = progress_out[wp.static(DONE)] + places
        progress_out[wp.static(DONE)] = done
        left = wp.max(progress_out[wp.static(COUNT)] - done, 0)
        left_out[sample] = left
        for size in range(fewer_in.shape[0]):
            more_out[size] = wp.where(left > fewer_in[size], 1, 0)

    @wp.kernel(module=module, enable_backward=False)
    def spare(
        lanes: int,
        # Workspace in
        progress_in: wp.array(dtype=wp.int32),
        # Workspace out
        spare_out: wp.array3d(dtype=wp.int32),
    ):
        """Places without a world of their own, which only repeat what another one does."""
        pack, lane = wp.tid()
        has_world = progress_in[wp.static(DONE)] + pack * lanes + lane < progress_in[wp.static(COUNT)]
        spare_out[pack, 0, lane] = wp.where(has_world, 0, 1)

    @wp.kernel(module=module, enable_backward=False)
    def take(
        # State
        value_in: wp.array2d(dtype=real),
        # Workspace in
        progress_in: wp.array(dtype=wp.int32),
        order_in: wp.array(dtype=wp.int32),
        # State out
        value_out: wp.array2d(dtype=real),
    ):
        """Rows of the next worlds to their places."""
        sample, part = wp.tid()
        if wp.static(world_fastest):
            part, sample = wp.tid()
        world = world_at(sample, progress_in, order_in)
        first, last = rows_of(part, value_out.shape[1])
        for row in range(first, last):
            value_out[sample, row] = value_in[world, row]

    @wp.kernel(module=module, enable_backward=False)
    def take_integers(
        # State
        value_in: wp.array2d(dtype=wp.int32),
        # Workspace in
        progress_in: wp.array(dtype=wp.int32),
        order_in: wp.array(dtype=wp.int32),
        # State out
        value_out: wp.array2d(dtype=wp.int32),
    ):
        """The same for integers."""
        sample, part = wp.tid()
        if wp.static(world_fastest):
            part, sample = wp.tid()
        world = world_at(sample, progress_in, order_in)
        first, last = rows_of(part, value_out.shape[1])
        for row in range(first, last):
            value_out[sample, row] = value_in[world, row]

    @wp.func
    def is_given(place: int, status: wp.array2d(dtype=wp.int32), progress: wp.array(dtype=wp.int32)):
        """Whether a place has a world of its own, whose step has not failed."""
        has_world = progress[wp.static(DONE)] + place < progress[wp.static(COUNT)]
        return has_world and status[place, 0] < wp.static(int(Status.NONFINITE))

    @wp.kernel(module=module, enable_backward=False)
    def give(
        # State
        value_in: wp.array2d(dtype=real),
        status_in: wp.array2d(dtype=wp.int32),
        # Workspace in
        progress_in: wp.array(dtype=wp.int32),
        order_in: wp.array(dtype=wp.int32),
        # State out
        value_out: wp.array2d(dtype=real),
    ):
        """Rows of worlds whose repeated step is good, back from their places."""
        sample, part = wp.tid()
        if wp.static(world_fastest):
            part, sample = wp.tid()
        if is_given(sample, status_in, progress_in):
            world = world_at(sample, progress_in, order_in)
            first, last = rows_of(part, value_out.shape[1])
            for row in range(first, last):
                value_out[world, row] = value_in[sample, row]

    @wp.kernel(module=module, enable_backward=False)
    def give_integers(
        # State
        value_in: wp.array2d(dtype=wp.int32),
        status_in: wp.array2d(dtype=wp.int32),
        # Workspace in
        progress_in: wp.array(dtype=wp.int32),
        order_in: wp.array(dtype=wp.int32),
        # State out
        value_out: wp.array2d(dtype=wp.int32),
    ):
        """The same for integers."""
        sample, part = wp.tid()
        if wp.static(world_fastest):
            part, sample = wp.tid()
        if is_given(sample, status_in, progress_in):
            world = world_at(sample, progress_in, order_in)
            first, last = rows_of(part, value_out.shape[1])
            for row in range(first, last):
                value_out[world, row] = value_in[sample, row]

    return SimpleNamespace(
        choose=choose,
        number=number,
        go_on=go_on,
        spare=spare,
        take=take,
        take_integers=take_integers,
        give=give,
        give_integers=give_integers,
    )
