"""Adjoint of the extrapolation of frames between the stages of a step of second order. Theory: docs/theory/adjoint.md.

A frame is turned on about the axis of its turn so far: with q1 = exp(phi) q0 it is at exp(c phi) q0, and phi changes by
T(phi)^-1 of the turn of its exponential. State arrays are ``[world, row]``.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.elements import rod_adjoint
from softwarp.kernels.frames import adjoint as of_frames
from softwarp.kernels.frames import momentum, top_adjoint
from softwarp.kernels.frames.inertia import COMPOUND_ROWS
from softwarp.model.codes import Spin


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type, on single worlds."""
    real = variant.real
    module = variant.module("adjoint.extrapolated")
    one = single.functions(variant)
    vec3, quat, exponential, logarithm = one.vec3, one.quat, one.exponential, one.logarithm
    vector_at, inertia_at = one.vector_at, one.inertia_at
    inertia_inverse = momentum.functions(variant).inertia_inverse
    tops = top_adjoint.functions(variant)
    about_centre, drifted, pull_extrapolated = tops.about_centre, tops.drifted, tops.pull_extrapolated
    turns, of_rods = of_frames.functions(variant), rod_adjoint.functions(variant)
    turn_bar, jacobian_transposed = turns.turn_bar, turns.jacobian_transposed
    of_world, carried_bars = turns.of_world, turns.carried_bars
    slopes, twisted = of_rods.slopes, of_rods.twisted

    @wp.func
    def turn_of(bar: wp.array2d(dtype=real), world: int, row: int, q: quat):
        """Gradient by a turn from that by a quaternion."""
        return turn_bar(q, vec3(bar[world, row], bar[world, row + 1], bar[world, row + 2]), bar[world, row + 3])

    @wp.func
    def put_turn(bar: wp.array2d(dtype=real), world: int, row: int, q: quat, turn: vec3):
        """Gradient by a quaternion, along which it keeps its length, from that by a turn."""
        found = quat(turn[0], turn[1], turn[2], real(0.0)) * q * real(2.0)
        for c in range(4):
            bar[world, row + c] = found[c]

    @wp.kernel(module=module, enable_backward=False)
    def part_frames(
        factor: real,
        lanes: int,
        # Model
        frame_master: wp.array(dtype=wp.int32),
        frame_spin: wp.array(dtype=wp.int32),
        told: wp.array(dtype=wp.int32),
        # State
        pose0_in: wp.array2d(dtype=real),
        pose1_in: wp.array2d(dtype=real),
        # Workspace in
        rough_in: wp.array3d(dtype=wp.int32),
        # State out
        pose_bar_out: wp.array2d(dtype=real),
        twist_bar_out: wp.array2d(dtype=real),
        pose_rest_out: wp.array2d(dtype=real),
        twist_rest_out: wp.array2d(dtype=real),
    ):
        """Gradients by the extrapolated pose and twist of one frame, as those by both states that these follow from.

        They are by the end of the stage before, in place, and by the start of the step. Free tops are left out, and
        rough worlds, where nothing is extrapolated.
        """
        pack, frame, lane = wp.tid()
        world = pack * lanes + lane
        if world < pose_bar_out.shape[0] and frame_master[frame] == frame and rough_in[pack, 0, lane] == 0:
            if frame_spin[frame] != wp.static(Spin.FREE_TOP):
                row = 7 * frame
                for c in range(3):
                    bar = pose_bar_out[world, row + c]
                    pose_bar_out[world, row + c] = factor * bar
                    pose_rest_out[world, row + c] = bar - factor * bar
                for c in range(6):
                    bar = twist_bar_out[world, 6 * frame + c]
                    if told[frame] != 0:  # stays, and has nothing by the start
                        continue
                    twist_bar_out[world, 6 * frame + c] = factor * bar
                    twist_rest_out[world, 6 * frame + c] = bar - factor * bar
                q0 = quat()
                q1 = quat()
                for c in range(4):
                    q0[c] = pose0_in[world, row + 3 + c]
                    q1[c] = pose1_in[world, row + 3 + c]
                phi = logarithm(q1 * wp.quat_inverse(q0))
                q = wp.normalize(exponential(phi * factor) * q0)
                g = turn_of(pose_bar_out, world, row + 3, q)
                by_phi = factor * jacobian_transposed(factor * phi, g)
                curl, _ = slopes(wp.dot(phi, phi))
                by_end = twisted(-phi, curl, by_phi)
                by_start = wp.quat_rotate_inv(exponential(factor * phi), g)
                by_start -= wp.quat_rotate_inv(exponential(phi), by_end)
                put_turn(pose_bar_out, world, row + 3, q1, by_end)
                put_turn(pose_rest_out, world, row + 3, q0, by_start)

    @wp.func
    def put_twist(bar: wp.array2d(dtype=real), world: int, row: int, linear: vec3, angular: vec3):
        """Gradients by velocity and spin."""
        for c in range(3):
            bar[world, row + c] = linear[c]
            bar[world, row + 3 + c] = angular[c]

    @wp.kernel(module=module, enable_backward=False)
    def part_tops(
        factor: real,
        lapse: real,
        lanes: int,
        # Model
        frame_master: wp.array(dtype=wp.int32),
        frame_spin: wp.array(dtype=wp.int32),
        # State
        pose0_in: wp.array2d(dtype=real),
        twist0_in: wp.array2d(dtype=real),
        pose1_in: wp.array2d(dtype=real),
        twist1_in: wp.array2d(dtype=real),
        # Workspace in
        compound_in: wp.array3d(dtype=real),
        rough_in: wp.array3d(dtype=wp.int32),
        # State out
        pose_bar_out: wp.array2d(dtype=real),
        twist_bar_out: wp.array2d(dtype=real),
        pose_rest_out: wp.array2d(dtype=real),
        twist_rest_out: wp.array2d(dtype=real),
        # Workspace out
        share_out: wp.array3d(dtype=real),
    ):
        """The same of one free top, which keeps its momenta and turns freely; see ``momentum.extrapolate_tops``.

        ``share`` receives the gradients by what it is made of.
        """
        pack, frame, lane = wp.tid()
        world = pack * lanes + lane
        k = wp.static(COMPOUND_ROWS) * frame
        m = compound_in[pack, k, lane]
        is_master = world < pose_bar_out.shape[0] and frame_master[frame] == frame and rough_in[pack, 0, lane] == 0
        if is_master and frame_spin[frame] == wp.static(Spin.FREE_TOP) and m > real(0.0):
            row = 7 * frame
            t = 6 * frame
            q0 = quat()
            q1 = quat()
            for c in range(4):
                q0[c] = pose0_in[world, row + 3 + c]
                q1[c] = pose1_in[world, row + 3 + c]
            V0 = of_world(twist0_in, world, t)
            w0 = of_world(twist0_in, world, t + 3)
            V1 = of_world(twist1_in, world, t)
            w1 = of_world(twist1_in, world, t + 3)
            centre, J = about_centre(
                m, vector_at(compound_in, pack, lane, k + 1), inertia_at(compound_in, pack, lane, k + 4)
            )
            q, _ = drifted(q0, w0, q1, w1, J, inertia_inverse(J), factor, lapse)
            by_x = of_world(pose_bar_out, world, row)
            by_turn = turn_of(pose_bar_out, world, row + 3, q)
            by_v = of_world(twist_bar_out, world, t)
            by_w = of_world(twist_bar_out, world, t + 3)
            turn0, v0, s0, turn1, v1, s1 = pull_extrapolated(
                q0,
                V0,
                w0,
                q1,
                V1,
                w1,
                centre,
                J,
                factor,
                lapse,
                by_x,
                by_turn,
                by_v,
                by_w,
                m,
                share_out,
                pack,
                lane,
                frame,
            )
            for c in range(3):
                pose_bar_out[world, row + c] = factor * by_x[c]
                pose_rest_out[world, row + c] = by_x[c] - factor * by_x[c]
            put_turn(pose_bar_out, world, row + 3, q1, turn1)
            put_turn(pose_rest_out, world, row + 3, q0, turn0)
            put_twist(twist_bar_out, world, t, v1, s1)
            put_twist(twist_rest_out, world, t, v0, s0)

    @wp.kernel(module=module, enable_backward=False)
    def take_carried(
        nodes: int,
        # Model
        frame_master: wp.array(dtype=wp.int32),
        frame_offset: wp.array2d(dtype=real),
        frame_item_start: wp.array(dtype=wp.int32),
        frame_item: wp.array(dtype=wp.int32),
        carried_slot: wp.array(dtype=wp.int32),
        carried_offset: wp.array2d(dtype=real),
        rest_pose: wp.array2d(dtype=real),
        # State
        pose_in: wp.array2d(dtype=real),
        twist_in: wp.array2d(dtype=real),
        # State out
        x_bar_out: wp.array2d(dtype=real),
        v_bar_out: wp.array2d(dtype=real),
        pose_bar_out: wp.array2d(dtype=real),
        twist_bar_out: wp.array2d(dtype=real),
        rest_bar_out: wp.array2d(dtype=real),
    ):
        """Add what is by the nodes and frames that one frame carries to what is by its pose and twist, and leave 0.

        By the rest positions of nodes, too, which have their levers from these.

        After an extrapolation these are where the frame is, whatever the stage before has led them to.
        """
        world, frame = wp.tid()
        if frame_master[frame] != frame:
            return
        row = 7 * frame
        q = quat()
        for c in range(4):
            q[c] = pose_in[world, row + 3 + c]
        by_x, by_t, by_v, by_w = carried_bars(
            frame_item_start,
            frame_item,
            carried_slot,
            carried_offset,
            frame_offset,
            nodes,
            x_bar_out,
            v_bar_out,
            pose_bar_out,
            twist_bar_out,
            world,
            frame,
            q,
            of_world(twist_in, world, 6 * frame + 3),
        )
        by_q = quat(by_t[0], by_t[1], by_t[2], real(0.0)) * q * real(2.0)
        for c in range(3):
            pose_bar_out[world, row + c] = pose_bar_out[world, row + c] + by_x[c]
            twist_bar_out[world, 6 * frame + c] = twist_bar_out[world, 6 * frame + c] + by_v[c]
            twist_bar_out[world, 6 * frame + 3 + c] = twist_bar_out[world, 6 * frame + 3 + c] + by_w[c]
        for c in range(4):
            pose_bar_out[world, row + 3 + c] = pose_bar_out[world, row + 3 + c] + by_q[c]
        for i in range(frame_item_start[frame], frame_item_start[frame + 1]):
            slot = carried_slot[frame_item[i]]
            if slot < nodes:
                if rest_bar_out.shape[1] > 0:
                    by_v = of_world(v_bar_out, world, 3 * slot)
                    by_r = of_world(x_bar_out, world, 3 * slot)
                    by_r += wp.cross(by_v, of_world(twist_in, world, 6 * frame + 3))
                    at_rest = quat(rest_pose[frame, 3], rest_pose[frame, 4], rest_pose[frame, 5], rest_pose[frame, 6])
                    by_r = wp.quat_rotate(at_rest, wp.quat_rotate_inv(q, by_r))
                    for c in range(3):
                        rest_bar_out[world, 3 * slot + c] = rest_bar_out[world, 3 * slot + c] + by_r[c]
                for c in range(3):
                    x_bar_out[world, 3 * slot + c] = real(0.0)
                    v_bar_out[world, 3 * slot + c] = real(0.0)
            else:
                welded = (slot - nodes) / 2
                for c in range(7):
                    pose_bar_out[world, 7 * welded + c] = real(0.0)
                for c in range(6):
                    twist_bar_out[world, 6 * welded + c] = real(0.0)

    return SimpleNamespace(part_frames=part_frames, part_tops=part_tops, take_carried=take_carried)
