"""What lies between the stages of a second-order step: states kept, extrapolated and chosen world by world.

Theory: docs/theory/second_order.md. State arrays are ``[world, row]``; workspace arrays ``[pack, row, lane]``.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.model.codes import Spin, Status


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type and memory order; a thread has one world, on a GPU one row of it."""
    real = variant.real
    world_fastest = variant.world_fastest
    one = single.functions(variant)
    quat, exponential, logarithm = one.quat, one.exponential, one.logarithm
    module = variant.module("stages")

    @wp.func
    def rows_of(part: int, count: int):
        """First and last row of a thread."""
        if wp.static(world_fastest):
            return part, part + 1
        return 0, count

    @wp.kernel(module=module, enable_backward=False)
    def choose(
        which: int,
        lanes: int,
        # State
        value_in: wp.array2d(dtype=real),
        # Workspace in
        code_in: wp.array3d(dtype=wp.int32),
        # State out
        value_out: wp.array2d(dtype=real),
    ):
        """Copy the rows of worlds with the code ``which``; of all where it is negative."""
        pack, part, lane = wp.tid()
        world = pack * lanes + lane
        if world < value_out.shape[0] and (which < 0 or code_in[pack, 0, lane] == which):
            first, last = rows_of(part, value_out.shape[1])
            for row in range(first, last):
                value_out[world, row] = value_in[world, row]

    @wp.kernel(module=module, enable_backward=False)
    def choose_integers(
        which: int,
        lanes: int,
        # State
        value_in: wp.array2d(dtype=wp.int32),
        # Workspace in
        code_in: wp.array3d(dtype=wp.int32),
        # State out
        value_out: wp.array2d(dtype=wp.int32),
    ):
        """The same for integers."""
        pack, part, lane = wp.tid()
        world = pack * lanes + lane
        if world < value_out.shape[0] and (which < 0 or code_in[pack, 0, lane] == which):
            first, last = rows_of(part, value_out.shape[1])
            for row in range(first, last):
                value_out[world, row] = value_in[world, row]

    @wp.kernel(module=module, enable_backward=False)
    def extrapolate(
        factor: real,
        lanes: int,
        # State
        start_in: wp.array2d(dtype=real),
        # Workspace in
        rough_in: wp.array3d(dtype=wp.int32),
        # State out
        value_out: wp.array2d(dtype=real),
    ):
        """Value <- start + factor (value - start) of a smooth world."""
        pack, part, lane = wp.tid()
        world = pack * lanes + lane
        if world < value_out.shape[0] and rough_in[pack, 0, lane] == 0:
            first, last = rows_of(part, value_out.shape[1])
            for row in range(first, last):
                start = start_in[world, row]
                value_out[world, row] = start + factor * (value_out[world, row] - start)

    @wp.kernel(module=module, enable_backward=False)
    def extrapolate_frames(
        factor: real,
        lanes: int,
        # Model
        frame_spin: wp.array(dtype=wp.int32),
        told: wp.array(dtype=wp.int32),
        # State
        pose0_in: wp.array2d(dtype=real),
        twist0_in: wp.array2d(dtype=real),
        # Workspace in
        rough_in: wp.array3d(dtype=wp.int32),
        # State out
        pose_out: wp.array2d(dtype=real),
        twist_out: wp.array2d(dtype=real),
    ):
        """The same for frames: positions and twists in a line, orientations about the axis of the turn so far.

        Free tops are left to ``kernels.frames.momentum``. Frames that are ``told`` their twists keep them.
        """
        pack, part, lane = wp.tid()
        world = pack * lanes + lane
        if world < pose_out.shape[0] and rough_in[pack, 0, lane] == 0:
            first, last = rows_of(part, frame_spin.shape[0])
            for frame in range(first, last):
                if frame_spin[frame] != wp.static(Spin.FREE_TOP):
                    row = 7 * frame
                    q0 = quat()
                    q1 = quat()
                    for c in range(3):
                        x0 = pose0_in[world, row + c]
                        pose_out[world, row + c] = x0 + factor * (pose_out[world, row + c] - x0)
                    if told[frame] == 0:
                        for c in range(6):
                            v0 = twist0_in[world, 6 * frame + c]
                            twist_out[world, 6 * frame + c] = v0 + factor * (twist_out[world, 6 * frame + c] - v0)
                    for c in range(4):
                        q0[c] = pose0_in[world, row + 3 + c]
                        q1[c] = pose_out[world, row + 3 + c]
                    turn = logarithm(q1 * wp.quat_inverse(q0))
                    q = wp.normalize(exponential(turn * factor) * q0)
                    for c in range(4):
                        pose_out[world, row + 3 + c] = q[c]

    @wp.kernel(module=module, enable_backward=False)
    def hold(
        lanes: int,
        # Model
        node_count: int,
        held_dof: wp.array(dtype=wp.int32),
        dof_node: wp.array(dtype=wp.int32),
        dof_free: wp.array2d(dtype=real),
        # State out
        node_v_out: wp.array2d(dtype=real),
        twist_out: wp.array2d(dtype=real),
    ):
        """Velocity <- 0 along the axes on which one dof is held, as backward Euler leaves it."""
        pack, item, lane = wp.tid()
        world = pack * lanes + lane
        dof = held_dof[item]
        slot = dof_node[dof]
        for c in range(3):
            if dof_free[dof, c] == real(0.0):
                if slot < node_count:
                    if world < node_v_out.shape[0]:
                        node_v_out[world, 3 * slot + c] = real(0.0)
                elif world < twist_out.shape[0]:
                    twist_out[world, 3 * (slot - node_count) + c] = real(0.0)

    @wp.kernel(module=module, enable_backward=False)
    def predict(
        # Model
        node_count: int,
        first_mode: int,
        dof_node: wp.array(dtype=wp.int32),
        # Workspace in
        node_v0_in: wp.array3d(dtype=real),
        twist0_in: wp.array3d(dtype=real),
        mode_v0_in: wp.array3d(dtype=real),
        rough_in: wp.array3d(dtype=wp.int32),
        # Workspace out
        dof_v_out: wp.array3d(dtype=real),
    ):
        """First guess of the velocity of one dof: that of the start, and 0 in a rough world."""
        pack, dof, lane = wp.tid()
        slot = dof_node[dof]
        for c in range(3):
            v = real(0.0)
            if rough_in[pack, 0, lane] == 0:
                if slot < node_count:
                    v = node_v0_in[pack, 3 * slot + c, lane]
                elif slot >= first_mode:
                    v = mode_v0_in[pack, 3 * (slot - first_mode) + c, lane]
                else:
                    v = twist0_in[pack, 3 * (slot - node_count) + c, lane]
            dof_v_out[pack, 3 * dof + c, lane] = v

    @wp.kernel(module=module, enable_backward=False)
    def judge(
        # Workspace in
        listed_in: wp.array3d(dtype=wp.int32),
        reserve_in: wp.array3d(dtype=wp.int32),
        # Workspace out
        rough_out: wp.array3d(dtype=wp.int32),
    ):
        """A world is rough if parts of it touch or may touch before the step is over."""
        pack, lane = wp.tid()
        if listed_in[pack, 0, lane] + reserve_in[pack, 0, lane] > 0:
            rough_out[pack, 0, lane] = 1

    @wp.kernel(module=module, enable_backward=False)
    def judge_nodes(
        h: real,
        limit: real,
        # Model
        pair_node: wp.array2d(dtype=wp.int32),
        pair_length: wp.array(dtype=real),
        # Workspace in
        x0_in: wp.array3d(dtype=real),
        v0_in: wp.array3d(dtype=real),
        x_in: wp.array3d(dtype=real),
        # Workspace out
        rough_out: wp.array3d(dtype=wp.int32),
    ):
        """A world is rough if a stage of length h [s] strained an edge by more than its first velocities would have."""
        pack, part, lane = wp.tid()
        first, last = rows_of(part, pair_length.shape[0])
        for pair in range(first, last):
            i = 3 * pair_node[pair, 0]
            j = 3 * pair_node[pair, 1]
            square = real(0.0)
            for c in range(3):
                way = x_in[pack, i + c, lane] - x0_in[pack, i + c, lane] - h * v0_in[pack, i + c, lane]
                other = x_in[pack, j + c, lane] - x0_in[pack, j + c, lane] - h * v0_in[pack, j + c, lane]
                square += (way - other) * (way - other)
            most = limit * pair_length[pair]
            if not square <= most * most:
                rough_out[pack, 0, lane] = 1

    @wp.kernel(module=module, enable_backward=False)
    def judge_frames(
        h: real,
        limit: real,
        # Model
        pair_frame: wp.array2d(dtype=wp.int32),
        pair_length: wp.array(dtype=real),
        # Workspace in
        pose0_in: wp.array3d(dtype=real),
        twist0_in: wp.array3d(dtype=real),
        pose_in: wp.array3d(dtype=real),
        # Workspace out
        rough_out: wp.array3d(dtype=wp.int32),
    ):
        """The same for segments of rods."""
        pack, part, lane = wp.tid()
        first, last = rows_of(part, pair_length.shape[0])
        for pair in range(first, last):
            square = real(0.0)
            for c in range(3):
                i = 7 * pair_frame[pair, 0] + c
                j = 7 * pair_frame[pair, 1] + c
                way = pose_in[pack, i, lane] - pose0_in[pack, i, lane]
                way -= h * twist0_in[pack, 6 * pair_frame[pair, 0] + c, lane]
                other = pose_in[pack, j, lane] - pose0_in[pack, j, lane]
                other -= h * twist0_in[pack, 6 * pair_frame[pair, 1] + c, lane]
                square += (way - other) * (way - other)
            most = limit * pair_length[pair]
            if not square <= most * most:
                rough_out[pack, 0, lane] = 1

    @wp.kernel(module=module, enable_backward=False)
    def gather(
        # Workspace in
        rough_in: wp.array3d(dtype=wp.int32),
        # Workspace out
        any_out: wp.array(dtype=wp.int32),
    ):
        """Whether any world is rough."""
        pack, lane = wp.tid()
        if rough_in[pack, 0, lane] != 0:
            any_out[0] = 1

    @wp.kernel(module=module, enable_backward=False)
    def set_lag(
        smooth: real,
        rough: real,
        # Workspace in
        rough_in: wp.array3d(dtype=wp.int32),
        # Workspace out
        lag_out: wp.array3d(dtype=real),
    ):
        """Part of a commanded way that is left to later stages."""
        pack, lane = wp.tid()
        lag_out[pack, 0, lane] = wp.where(rough_in[pack, 0, lane] != 0, rough, smooth)

    @wp.kernel(module=module, enable_backward=False)
    def note(
        first: bool,
        which: int,
        lanes: int,
        # State
        status_in: wp.array2d(dtype=wp.int32),
        # Workspace in
        code_in: wp.array3d(dtype=wp.int32),
        # Workspace out
        worst_out: wp.array3d(dtype=wp.int32),
    ):
        """Worst status of the stages so far of worlds with a code, or of all; remarks, below 0, outdo none."""
        pack, lane = wp.tid()
        world = pack * lanes + lane
        if world < status_in.shape[0] and (which < 0 or code_in[pack, 0, lane] == which):
            status = status_in[world, 0]
            worst = worst_out[pack, 0, lane]
            if first or status > worst or (status < 0 and worst == 0):
                worst_out[pack, 0, lane] = status

    @wp.kernel(module=module, enable_backward=False)
    def finish(
        h: real,
        lanes: int,
        # State
        time0_in: wp.array2d(dtype=real),
        # Workspace in
        worst_in: wp.array3d(dtype=wp.int32),
        # State out
        status_out: wp.array2d(dtype=wp.int32),
        time_out: wp.array2d(dtype=real),
        # Workspace out
        failed_out: wp.array3d(dtype=wp.int32),
    ):
        """Status and time of the whole step."""
        pack, lane = wp.tid()
        world = pack * lanes + lane
        if world < status_out.shape[0]:
            worst = worst_in[pack, 0, lane]
            failed = worst >= wp.static(int(Status.NONFINITE))
            failed_out[pack, 0, lane] = wp.where(failed, 1, 0)
            status_out[world, 0] = worst
            time_out[world, 0] = wp.where(failed, time0_in[world, 0], time0_in[world, 0] + h)

    return SimpleNamespace(
        choose=choose,
        choose_integers=choose_integers,
        extrapolate=extrapolate,
        extrapolate_frames=extrapolate_frames,
        hold=hold,
        predict=predict,
        judge=judge,
        judge_nodes=judge_nodes,
        judge_frames=judge_frames,
        gather=gather,
        set_lag=set_lag,
        note=note,
        finish=finish,
    )
