"""How far a line may swing in one linearised step. Theory: docs/theory/telescope.md, "Swings"."""

from math import cos
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.algebra.single import functions
from softwarp.kernels.frames.tube_section import PLAN_ROWS

MOST_TURN = 2.8  # rad, of a segment's ends against each other: beyond pi its strain is that of the other way round
CHANGE = 1.0  # rad, up to which a step changes that without a closer look, where MOST_TURN leaves as much


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels on single worlds."""
    real = variant.real
    world_fastest = variant.world_fastest
    module = variant.module("restraint")
    f = functions(variant)
    vec3, quat, vector_at, quat_at, put = f.vec3, f.quat, f.vector_at, f.quat_at, f.put
    exponential, logarithm = f.exponential, f.logarithm

    @wp.func
    def way_between(u: wp.array3d(dtype=real), a: int, b: int, scale: real, pack: int, lane: int):
        """Square of the difference of two dofs' ways."""
        square = real(0.0)
        for c in range(3):
            difference = scale * (u[pack, 3 * b + c, lane] - u[pack, 3 * a + c, lane])
            square += difference * difference
        return square

    @wp.func
    def square_of_swing(
        u: wp.array3d(dtype=real),
        frame_dof: wp.array(dtype=wp.int32),
        frame: int,
        h: real,
        length: real,
        pack: int,
        lane: int,
    ):
        """Of the segment behind a frame: by the ways of its ends, or by half of what these turn against each other."""
        swing = way_between(u, frame_dof[2 * frame], frame_dof[2 * frame + 2], h / length, pack, lane)
        turn = way_between(u, frame_dof[2 * frame + 1], frame_dof[2 * frame + 3], h, pack, lane)
        return wp.max(swing, real(0.25) * turn)

    @wp.func
    def share_within(most_swing: real, largest: real):
        """Part of the way of a world in which the square of the largest swing is ``largest``."""
        share = real(1.0)
        if largest > most_swing * most_swing:
            share = most_swing / wp.sqrt(largest)
        return share

    @wp.kernel(module=module, enable_backward=False)
    def swing_of_segment(
        h: real,
        # Model
        piece_telescope: wp.array(dtype=wp.int32),
        piece_place: wp.array(dtype=wp.int32),
        pieces: wp.array(dtype=wp.int32),
        base_frame: wp.array(dtype=wp.int32),
        frame_dof: wp.array(dtype=wp.int32),
        radius: wp.array(dtype=real),
        # Workspace in
        plan_in: wp.array3d(dtype=real),
        u_in: wp.array3d(dtype=real),
        # Workspace out
        square_out: wp.array3d(dtype=real),
    ):
        """Square of the swing of one segment, as ``share_of_way`` has it; for a GPU, where a world has too many."""
        pack, segment, lane = wp.tid()
        item = piece_telescope[segment]
        n = pieces[item]
        length = wp.max(plan_in[pack, wp.static(PLAN_ROWS) * item + 1, lane] / real(n), radius[item])
        frame = base_frame[item] + piece_place[segment]
        square_out[pack, segment, lane] = square_of_swing(u_in, frame_dof, frame, h, length, pack, lane)

    @wp.kernel(module=module, enable_backward=False)
    def share_of_segments(
        most_swing: real,
        count: int,
        # Workspace in
        square_in: wp.array3d(dtype=real),
        # Workspace out
        share_out: wp.array3d(dtype=real),
        swing_out: wp.array3d(dtype=real),
    ):
        """What ``share_of_way`` finds, from the squares of all segments."""
        pack, lane = wp.tid()
        largest = real(0.0)
        for segment in range(count):
            largest = wp.max(largest, square_in[pack, segment, lane])
        share_out[pack, 0, lane] = share_within(most_swing, largest)
        swing_out[pack, 0, lane] = wp.sqrt(largest)

    @wp.kernel(module=module, enable_backward=False)
    def share_of_way(
        h: real,
        most_swing: real,
        # Model
        pieces: wp.array(dtype=wp.int32),
        base_frame: wp.array(dtype=wp.int32),
        frame_dof: wp.array(dtype=wp.int32),
        radius: wp.array(dtype=real),
        # Workspace in
        plan_in: wp.array3d(dtype=real),
        u_in: wp.array3d(dtype=real),
        # Workspace out
        share_out: wp.array3d(dtype=real),
        swing_out: wp.array3d(dtype=real),
    ):
        """Part of its way that a world goes: what swings no segment of its telescopes by more than ``most_swing``.

        A segment swings by the difference of the ways of its ends per length; one that is shorter than the line's
        radius counts as that long. It swings against its ends by half of what they turn against each other, at least.
        Velocities that are not finite are left for others to find. Told is the largest swing on the whole way, too.
        """
        pack, lane = wp.tid()
        largest = real(0.0)
        for item in range(pieces.shape[0]):
            n = pieces[item]
            length = wp.max(plan_in[pack, wp.static(PLAN_ROWS) * item + 1, lane] / real(n), radius[item])
            for place in range(n):
                frame = base_frame[item] + place
                largest = wp.max(largest, square_of_swing(u_in, frame_dof, frame, h, length, pack, lane))
        share_out[pack, 0, lane] = share_within(most_swing, largest)
        swing_out[pack, 0, lane] = wp.sqrt(largest)

    @wp.kernel(module=module, enable_backward=False)
    def hold_back(
        # Model
        dof_free: wp.array2d(dtype=real),
        # Workspace in
        share_in: wp.array3d(dtype=real),
        # Workspace out
        u_out: wp.array3d(dtype=real),
    ):
        """What is not prescribed goes a share of its way."""
        pack, part, lane = wp.tid()
        share = share_in[pack, 0, lane]
        if share < real(1.0):
            first = int(0)
            last = dof_free.shape[0]
            if wp.static(world_fastest):
                first = part
                last = part + 1
            for dof in range(first, last):
                for c in range(3):
                    if dof_free[dof, c] != real(0.0):
                        u_out[pack, 3 * dof + c, lane] = share * u_out[pack, 3 * dof + c, lane]

    @wp.func
    def turned_back(rest: quat, most: real):
        """A turn whose scalar part is below ``most`` about the same axis, but by less."""
        v = vec3(rest[0], rest[1], rest[2])
        v = v * (wp.sqrt(wp.max(real(1.0) - most * most, real(0.0))) / wp.length(v))
        return quat(v[0], v[1], v[2], most)

    @wp.func
    def is_near_most(now: real, turn: real):
        """Whether a closer look is due at ends that are turned so far, and that a step turns by so much: squared."""
        return now < real(wp.static(cos(0.5 * (MOST_TURN - CHANGE)))) or turn > real(CHANGE * CHANGE)

    @wp.kernel(module=module, enable_backward=False)
    def turn_of_segment(
        h: real,
        # Model
        piece_telescope: wp.array(dtype=wp.int32),
        piece_place: wp.array(dtype=wp.int32),
        base_frame: wp.array(dtype=wp.int32),
        frame_dof: wp.array(dtype=wp.int32),
        # Workspace in
        pose_in: wp.array3d(dtype=real),
        u_in: wp.array3d(dtype=real),
        # Workspace out
        near_out: wp.array3d(dtype=real),
    ):
        """1 for a segment that ``hold_turns`` would look at closer as things are; for a GPU, where few are, 0 else."""
        pack, segment, lane = wp.tid()
        frame = base_frame[piece_telescope[segment]] + piece_place[segment]
        p = quat_at(pose_in, pack, lane, 7 * frame + 3)
        q = quat_at(pose_in, pack, lane, 7 * frame + 10)
        turn = way_between(u_in, frame_dof[2 * frame + 1], frame_dof[2 * frame + 3], h, pack, lane)
        near_out[pack, segment, lane] = wp.where(is_near_most(wp.abs(wp.dot(p, q)), turn), real(1.0), real(0.0))

    @wp.kernel(module=module, enable_backward=False)
    def hold_turns(
        h: real,
        # Model
        pieces: wp.array(dtype=wp.int32),
        base_frame: wp.array(dtype=wp.int32),
        frame_dof: wp.array(dtype=wp.int32),
        dof_free: wp.array2d(dtype=real),
        # Workspace in
        pose_in: wp.array3d(dtype=real),
        near_in: wp.array3d(dtype=real),
        # Workspace out
        u_out: wp.array3d(dtype=real),
    ):
        """No segment's ends turn against each other by more than ``MOST_TURN``, or more than they do already.

        From the base on, the far end is turned back to that, about the axis that it was to turn about. A GPU follows
        the line only where ``turn_of_segment`` has found something to look at, or the end before has just been turned.
        """
        pack, lane = wp.tid()
        if wp.static(world_fastest):
            nearest = real(0.0)
            for segment in range(near_in.shape[1]):
                nearest = wp.max(nearest, near_in[pack, segment, lane])
            if nearest == real(0.0):
                return
        segment = int(-1)
        for item in range(pieces.shape[0]):
            follows = bool(not world_fastest)
            for place in range(pieces[item]):
                segment += 1
                if wp.static(world_fastest):
                    if not follows and near_in[pack, segment, lane] == real(0.0):
                        continue
                    follows = False
                frame = base_frame[item] + place
                a = frame_dof[2 * frame + 1]
                b = frame_dof[2 * frame + 3]
                p = quat_at(pose_in, pack, lane, 7 * frame + 3)
                q = quat_at(pose_in, pack, lane, 7 * frame + 10)
                now = wp.abs(wp.dot(p, q))
                turn = way_between(u_out, a, b, h, pack, lane)
                if is_near_most(now, turn):
                    start = wp.quat_inverse(p) * q
                    if start[3] < real(0.0):
                        start = -start
                    p = exponential(h * vector_at(u_out, pack, lane, 3 * a)) * p
                    end = wp.quat_inverse(p) * (exponential(h * vector_at(u_out, pack, lane, 3 * b)) * q)
                    if wp.dot(start, end) < real(0.0):
                        end = -end
                    most = wp.min(real(wp.static(cos(0.5 * MOST_TURN))), start[3])
                    free = dof_free[b, 0] * dof_free[b, 1] * dof_free[b, 2]
                    if end[3] < most and free != real(0.0):
                        back = p * turned_back(end, most) * wp.quat_inverse(q)
                        put(u_out, pack, lane, 3 * b, logarithm(back) / h)
                        follows = True

    return SimpleNamespace(
        turn_of_segment=turn_of_segment,
        hold_turns=hold_turns,
        swing_of_segment=swing_of_segment,
        share_of_segments=share_of_segments,
        share_of_way=share_of_way,
        hold_back=hold_back,
    )
