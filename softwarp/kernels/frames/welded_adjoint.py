"""Adjoint of frames that are welded to others: centres of mass off an origin, attached bodies and rod nodes.

A welded frame at the lever r from its master has V + w x r and p_t + p_r x r in the place of V and p_t. What it has by
its place and turn, and what acts on it, goes to its master. Theory: docs/theory/adjoint.md.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type, on single worlds."""
    real = variant.real
    module = variant.module("adjoint.welded")
    one = single.functions(variant)
    vec3, vector_at, quat_at, put = one.vec3, one.vector_at, one.quat_at, one.put

    @wp.func
    def offset_of(offset: wp.array2d(dtype=real), item: int):
        """Place in a frame."""
        return vec3(offset[item, 0], offset[item, 1], offset[item, 2])

    @wp.kernel(module=module, enable_backward=False)
    def twists(
        # Model
        frame_master: wp.array(dtype=wp.int32),
        frame_offset: wp.array2d(dtype=real),
        frame_dof: wp.array(dtype=wp.int32),
        # Workspace in
        pose0_in: wp.array3d(dtype=real),
        v_in: wp.array3d(dtype=real),
        p_in: wp.array3d(dtype=real),
        # Workspace out
        frame_v_out: wp.array3d(dtype=real),
        frame_p_out: wp.array3d(dtype=real),
    ):
        """Twist of one frame, and its adjoint, from the dofs of its master."""
        pack, frame, lane = wp.tid()
        master = frame_master[frame]
        t = 3 * frame_dof[2 * frame]
        s = 3 * frame_dof[2 * frame + 1]
        v = vector_at(v_in, pack, lane, t)
        p = vector_at(p_in, pack, lane, t)
        w = vector_at(v_in, pack, lane, s)
        turn = vector_at(p_in, pack, lane, s)
        if master != frame:
            r = wp.quat_rotate(quat_at(pose0_in, pack, lane, 7 * master + 3), offset_of(frame_offset, frame))
            v += wp.cross(w, r)
            p += wp.cross(turn, r)
        put(frame_v_out, pack, lane, 6 * frame, v)
        put(frame_v_out, pack, lane, 6 * frame + 3, w)
        put(frame_p_out, pack, lane, 6 * frame, p)
        put(frame_p_out, pack, lane, 6 * frame + 3, turn)

    @wp.kernel(module=module, enable_backward=False)
    def gradients(
        h: real,
        nodes: int,
        # Model
        welded_frame: wp.array(dtype=wp.int32),
        frame_master: wp.array(dtype=wp.int32),
        frame_owner: wp.array(dtype=wp.int32),
        frame_volume: wp.array(dtype=real),
        slot_carried: wp.array(dtype=wp.int32),
        carried_offset: wp.array2d(dtype=real),
        corner_start: wp.array(dtype=wp.int32),
        corner: wp.array(dtype=wp.int32),
        # Workspace in
        owner_density_in: wp.array3d(dtype=real),
        gravity_in: wp.array3d(dtype=real),
        wrench_in: wp.array3d(dtype=real),
        pose0_in: wp.array3d(dtype=real),
        frame_v_in: wp.array3d(dtype=real),
        frame_p_in: wp.array3d(dtype=real),
        corner_in: wp.array3d(dtype=real),
        way_in: wp.array3d(dtype=real),
        # Workspace out
        item_out: wp.array3d(dtype=real),
    ):
        """Gradients by place, turn and velocities of its master that one welded frame has.

        As of a carried node; forces on it are weight, command and those of segments, which have moments, too.
        """
        pack, number, lane = wp.tid()
        frame = welded_frame[number]
        item = slot_carried[nodes + 2 * frame]
        q = quat_at(pose0_in, pack, lane, 7 * frame_master[frame] + 3)
        r = wp.quat_rotate(q, offset_of(carried_offset, item))
        mass = owner_density_in[pack, frame_owner[frame], lane] * frame_volume[frame]
        tense = h * (mass * vector_at(gravity_in, pack, lane, 0) + vector_at(wrench_in, pack, lane, 6 * frame))
        place = vec3()
        turn = vec3()
        bound = vec3()
        twisted = vec3()
        for i in range(corner_start[2 * frame], corner_start[2 * frame + 1]):
            seg = corner[i] / 4
            sign = real(corner[i] % 4 - 1)  # the way of a segment is from corner 0 to corner 2
            place += vector_at(corner_in, pack, lane, 3 * corner[i])
            tense -= sign * vector_at(way_in, pack, lane, 12 * seg)
            bound += sign * vector_at(way_in, pack, lane, 12 * seg + 3)
        for i in range(corner_start[2 * frame + 1], corner_start[2 * frame + 2]):
            turn += vector_at(corner_in, pack, lane, 3 * corner[i])
            twisted += vector_at(way_in, pack, lane, 12 * (corner[i] / 4) + 6 + 3 * (corner[i] % 4 / 2))
        lever = wp.cross(tense, vector_at(frame_p_in, pack, lane, 6 * frame + 3))
        lever -= wp.cross(bound, vector_at(frame_v_in, pack, lane, 6 * frame + 3))
        put(item_out, pack, lane, 12 * item, place)
        put(item_out, pack, lane, 12 * item + 3, turn + wp.cross(r, place + lever))
        put(item_out, pack, lane, 12 * item + 6, -bound)
        put(item_out, pack, lane, 12 * item + 9, wp.cross(bound, r) - twisted)

    return SimpleNamespace(twists=twists, gradients=gradients)
