"""Telescopes: insertion, sliding nodes, composite sections and windup. Theory: docs/theory/telescope.md.

The nodes of a telescope lie at equal distances between the port and the tip of the tube that reaches farthest, its
*carrier*, whose material frames they are. When tubes move, nodes slide along the line: they take their poses from the
old line so that the carrier's material stays where it is, with the base behind the port, and the base is then driven
to the port. Every segment gets the section of the tubes that it has, sub-interval by sub-interval.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import screw, single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.frames import tube_section
from softwarp.kernels.frames.tube_section import PLAN_ROWS

MOST_WAY = 0.005  # of a tube's whole length, in one step
MOST_TURN = 0.1  # rad at the base, in one step


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels on single worlds."""
    real = variant.real
    one = single.functions(variant)
    vec3, quat, vector_at, quat_at = one.vec3, one.quat, one.vector_at, one.quat_at
    put, put_quat, exponential, logarithm = one.put, one.put_quat, one.exponential, one.logarithm
    turning = screw.functions(variant)
    spread, gathered, about_z = turning.spread, turning.gathered, turning.about_z
    Tubes, shown = tube_section.structures(variant.real).Tubes, tube_section.functions(variant).shown
    module = variant.module("telescope")

    @wp.func
    def carrier_of(length: wp.array3d(dtype=real), pack: int, lane: int, first: int, last: int):
        """The tube that reaches farthest, the innermost of equals."""
        best = first
        for tube in range(first + 1, last):
            if length[pack, tube, lane] > length[pack, best, lane]:
                best = tube
        return best

    @wp.func
    def approach(start: real, goal: real, limit: real):
        """Towards a goal by no more than a limit; nowhere for a goal that is no number."""
        value = start
        if wp.isfinite(goal):
            value = start + wp.clamp(goal - start, -limit, limit)
        return value

    @wp.kernel(module=module, enable_backward=False)
    def advance(
        # Model
        tubes: Tubes,
        floor: wp.array(dtype=real),
        # Workspace in
        length0_in: wp.array3d(dtype=real),
        angle0_in: wp.array3d(dtype=real),
        base0_in: wp.array3d(dtype=real),
        windup0_in: wp.array3d(dtype=real),
        length_command_in: wp.array3d(dtype=real),
        angle_command_in: wp.array3d(dtype=real),
        max_speed_in: wp.array3d(dtype=real),
        max_spin_in: wp.array3d(dtype=real),
        h: real,
        # Workspace out
        length_out: wp.array3d(dtype=real),
        angle_out: wp.array3d(dtype=real),
        plan_out: wp.array3d(dtype=real),
    ):
        """Lengths and angles of the tubes of one telescope after a step, and what its nodes do; h = 0 stands still."""
        pack, item, lane = wp.tid()
        first = tubes.first_tube[item]
        last = tubes.first_tube[item + 1]
        old = carrier_of(length0_in, pack, lane, first, last)
        moves = real(0.0)
        for tube in range(first, last):
            l0 = length0_in[pack, tube, lane]
            a0 = angle0_in[pack, tube, lane]
            length = l0
            angle = a0
            if h > real(0.0):
                whole = tubes.whole[tube]
                limit = wp.min(max_speed_in[pack, tube, lane] * h, real(wp.static(MOST_WAY)) * whole)
                goal = length_command_in[pack, tube, lane]
                if wp.isfinite(goal):
                    goal = wp.clamp(goal, real(0.0), whole)
                length = approach(l0, goal, limit)
                limit = wp.min(max_spin_in[pack, tube, lane] * h, real(wp.static(MOST_TURN)))
                angle = approach(a0, angle_command_in[pack, tube, lane], limit)
            if length != l0:
                moves = real(1.0)
            length_out[pack, tube, lane] = length
            angle_out[pack, tube, lane] = angle
        new = carrier_of(length_out, pack, lane, first, last)
        row = wp.static(PLAN_ROWS) * item
        before = wp.max(length0_in[pack, old, lane], floor[item])
        after = wp.max(length_out[pack, new, lane], floor[item])
        way = length_out[pack, new, lane] - length0_in[pack, new, lane]
        if after == before and moves == real(0.0):
            way = real(0.0)
        elif length_out[pack, new, lane] <= floor[item]:
            way = after - before
        plan_out[pack, row, lane] = before
        plan_out[pack, row + 1, lane] = after
        plan_out[pack, row + 2, lane] = way
        plan_out[pack, row + 3, lane] = real(old)
        plan_out[pack, row + 4, lane] = real(new)
        plan_out[pack, row + 5, lane] = moves
        base = base0_in[pack, item, lane]
        if new != old:
            base += windup0_in[pack, tubes.first_windup[item] + (new - first) * (tubes.pieces[item] + 1), lane]
        plan_out[pack, row + 6, lane] = base

    @wp.kernel(module=module, enable_backward=False)
    def slide(
        # Model
        tubes: Tubes,
        node_telescope: wp.array(dtype=wp.int32),
        node_place: wp.array(dtype=wp.int32),
        base_frame: wp.array(dtype=wp.int32),
        port: wp.array(dtype=real),
        # Workspace in
        plan_in: wp.array3d(dtype=real),
        pose_in: wp.array3d(dtype=real),
        twist_in: wp.array3d(dtype=real),
        windup_in: wp.array3d(dtype=real),
        # Workspace out
        pose_out: wp.array3d(dtype=real),
        twist_out: wp.array3d(dtype=real),
        windup_out: wp.array3d(dtype=real),
    ):
        """Pose, twist and angles of one node where it stands on the old line."""
        pack, item, lane = wp.tid()
        telescope = node_telescope[item]
        place = node_place[item]
        n = tubes.pieces[telescope]
        base = base_frame[telescope]
        frame = base + place
        first = tubes.first_tube[telescope]
        last = tubes.first_tube[telescope + 1]
        row = wp.static(PLAN_ROWS) * telescope
        way = plan_in[pack, row + 2, lane]
        old = int(plan_in[pack, row + 3, lane])
        new = int(plan_in[pack, row + 4, lane])
        piece = plan_in[pack, row, lane] / real(n)
        s = plan_in[pack, row + 1, lane] * real(place) / real(n) - way
        k = place
        t = real(0.0)
        x = vector_at(pose_in, pack, lane, 7 * frame)
        q = quat_at(pose_in, pack, lane, 7 * frame + 3)
        v = vector_at(twist_in, pack, lane, 6 * frame)
        w = vector_at(twist_in, pack, lane, 6 * frame + 3)
        if plan_in[pack, row + 5, lane] != real(0.0):
            if s <= real(0.0):
                k = int(0)
                q0 = quat(
                    port[7 * telescope + 3], port[7 * telescope + 4], port[7 * telescope + 5], port[7 * telescope + 6]
                )
                axis = wp.quat_rotate(q0, vec3(real(0.0), real(0.0), real(1.0)))
                x = vec3(port[7 * telescope], port[7 * telescope + 1], port[7 * telescope + 2]) + s * axis
                q = quat_at(pose_in, pack, lane, 7 * base + 3)
                v = vector_at(twist_in, pack, lane, 6 * base)
                w = vector_at(twist_in, pack, lane, 6 * base + 3)
            else:
                k = wp.min(int(s / piece), n - 1)
                t = wp.min(s / piece - real(k), real(1.0))
                f = base + k
                x = vector_at(pose_in, pack, lane, 7 * f)
                q = wp.normalize(quat_at(pose_in, pack, lane, 7 * f + 3))
                qn = wp.normalize(quat_at(pose_in, pack, lane, 7 * f + 10))
                turn = logarithm(wp.quat_inverse(q) * qn)
                span = wp.quat_rotate_inv(q, vector_at(pose_in, pack, lane, 7 * f + 7) - x)
                u = gathered(turn, span)
                x = x + wp.quat_rotate(q, spread(turn * t, u * t))
                q = wp.normalize(q * exponential(turn * t))
                v = vector_at(twist_in, pack, lane, 6 * f) * (real(1.0) - t)
                v += vector_at(twist_in, pack, lane, 6 * f + 6) * t
                w = vector_at(twist_in, pack, lane, 6 * f + 3) * (real(1.0) - t)
                w += vector_at(twist_in, pack, lane, 6 * f + 9) * t
        angles = tubes.first_windup[telescope]
        beyond = wp.min(k + 1, n)
        shift = real(0.0)
        if new != old:
            r = angles + (new - first) * (n + 1)
            shift = windup_in[pack, r + k, lane] * (real(1.0) - t) + windup_in[pack, r + beyond, lane] * t
            q = wp.normalize(q * about_z(shift))
        put(pose_out, pack, lane, 7 * frame, x)
        put_quat(pose_out, pack, lane, 7 * frame + 3, q)
        put(twist_out, pack, lane, 6 * frame, v)
        put(twist_out, pack, lane, 6 * frame + 3, w)
        for tube in range(first, last):
            r = angles + (tube - first) * (n + 1)
            psi = windup_in[pack, r + k, lane] * (real(1.0) - t) + windup_in[pack, r + beyond, lane] * t
            windup_out[pack, r + place, lane] = psi - shift

    @wp.kernel(module=module, enable_backward=False)
    def follow(
        # Model
        tubes: Tubes,
        node_telescope: wp.array(dtype=wp.int32),
        node_place: wp.array(dtype=wp.int32),
        base_frame: wp.array(dtype=wp.int32),
        # Workspace in
        plan_in: wp.array3d(dtype=real),
        balanced_in: wp.array3d(dtype=real),
        pose_in: wp.array3d(dtype=real),
        twist_in: wp.array3d(dtype=real),
        # Workspace out
        pose_out: wp.array3d(dtype=real),
        twist_out: wp.array3d(dtype=real),
        windup_out: wp.array3d(dtype=real),
        base_out: wp.array3d(dtype=real),
    ):
        """Turn one node about the line to where the carrier has turned; angles are to it again.

        Torsion is in balance at all times, so that nodes do not spin about the line.
        """
        pack, item, lane = wp.tid()
        telescope = node_telescope[item]
        place = node_place[item]
        n = tubes.pieces[telescope]
        frame = base_frame[telescope] + place
        first = tubes.first_tube[telescope]
        carrier = int(plan_in[pack, wp.static(PLAN_ROWS) * telescope + 4, lane])
        row = tubes.first_windup[telescope] + place
        turn = balanced_in[pack, row + (carrier - first) * (n + 1), lane]
        q = quat_at(pose_in, pack, lane, 7 * frame + 3)
        tangent = wp.quat_rotate(q, vec3(real(0.0), real(0.0), real(1.0)))
        spin = vector_at(twist_in, pack, lane, 6 * frame + 3)
        put(twist_out, pack, lane, 6 * frame + 3, spin - tangent * wp.dot(tangent, spin))
        if turn != real(0.0):
            put_quat(pose_out, pack, lane, 7 * frame + 3, wp.normalize(q * about_z(turn)))
        for tube in range(first, tubes.first_tube[telescope + 1]):
            at = row + (tube - first) * (n + 1)
            windup_out[pack, at, lane] = balanced_in[pack, at, lane] - turn
        if place == 0:
            base_out[pack, telescope, lane] = plan_in[pack, wp.static(PLAN_ROWS) * telescope + 6, lane] + turn

    @wp.kernel(module=module, enable_backward=False)
    def drive(
        # Model
        base_frame: wp.array(dtype=wp.int32),
        base_dof: wp.array(dtype=wp.int32),
        port: wp.array(dtype=real),
        # Workspace in
        base_in: wp.array3d(dtype=real),
        pose0_in: wp.array3d(dtype=real),
        h: real,
        # Workspace out
        prescribed_v_out: wp.array3d(dtype=real),
    ):
        """Velocities that bring the base of one telescope to its port, turned as its carrier is."""
        pack, item, lane = wp.tid()
        frame = base_frame[item]
        at = vec3(port[7 * item], port[7 * item + 1], port[7 * item + 2])
        q0 = quat(port[7 * item + 3], port[7 * item + 4], port[7 * item + 5], port[7 * item + 6])
        goal = q0 * about_z(base_in[pack, item, lane])
        q = quat_at(pose0_in, pack, lane, 7 * frame + 3)
        v = (at - vector_at(pose0_in, pack, lane, 7 * frame)) / h
        put(prescribed_v_out, pack, lane, 3 * base_dof[2 * item], v)
        put(prescribed_v_out, pack, lane, 3 * base_dof[2 * item + 1], logarithm(goal * wp.quat_inverse(q)) / h)

    @wp.kernel(module=module, enable_backward=False)
    def weigh(
        # Model
        tubes: Tubes,
        node_telescope: wp.array(dtype=wp.int32),
        node_place: wp.array(dtype=wp.int32),
        first_owner: wp.array(dtype=wp.int32),
        # Workspace in
        plan_in: wp.array3d(dtype=real),
        length_in: wp.array3d(dtype=real),
        density_in: wp.array3d(dtype=real),
        # Workspace out
        owner_density_out: wp.array3d(dtype=real),
    ):
        """Mass of one node: of all tubes within half a segment on both sides."""
        pack, item, lane = wp.tid()
        telescope = node_telescope[item]
        place = node_place[item]
        row = wp.static(PLAN_ROWS) * telescope
        line = plan_in[pack, row + 1, lane]
        carrier = int(plan_in[pack, row + 4, lane])
        piece = line / real(tubes.pieces[telescope])
        low = wp.max((real(place) - real(0.5)) * piece, real(0.0))
        high = wp.min((real(place) + real(0.5)) * piece, line)
        mass = real(0.0)
        for tube in range(tubes.first_tube[telescope], tubes.first_tube[telescope + 1]):
            reach = shown(length_in, pack, lane, tube, carrier, line)
            covered = wp.clamp(reach - low, real(0.0), high - low)
            mass += density_in[pack, tube, lane] * tubes.area[4 * tube] * covered
        owner_density_out[pack, first_owner[telescope] + place, lane] = mass

    return SimpleNamespace(advance=advance, slide=slide, follow=follow, drive=drive, weigh=weigh)
