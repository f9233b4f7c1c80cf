"""End of a step for frames: twists after the turn, checks, and what is written to the state. Theory: docs/theory/frames.md.

A step first changes the angular momentum L = R0 I R0' w, then lets the frame turn. A body that nothing but contacts and
joints touches turns as a free top with constant L (classical Runge-Kutta); any other frame turns by exp(h w), and its
angular velocity follows from L at its new orientation.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.lanes import Variant

AS_SOLVED, KEEP_MOMENTUM, FREE_TOP = range(3)


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels on single worlds."""
    real = variant.real
    vec3 = wp.types.vector(3, real)
    mat33 = wp.types.matrix((3, 3), real)
    quat = wp.types.quaternion(real)
    module = variant.module("frame_state")

    @wp.func
    def quat_at(array: wp.array3d(dtype=real), pack: int, lane: int, row: int):
        """Quaternion in four rows."""
        return quat(
            array[pack, row, lane], array[pack, row + 1, lane], array[pack, row + 2, lane], array[pack, row + 3, lane]
        )

    @wp.func
    def symmetric(values: wp.array2d(dtype=real), row: int):
        """Matrix of xx, yy, zz, xy, xz, yz."""
        return mat33(
            values[row, 0],
            values[row, 3],
            values[row, 4],
            values[row, 3],
            values[row, 1],
            values[row, 5],
            values[row, 4],
            values[row, 5],
            values[row, 2],
        )

    @wp.func
    def turn(q: quat, v: vec3, sign: real):
        """R(q) v, or R(q)' v with sign -1; keeps |v| although |q| is 1 to rounding only, whose mean is not."""
        u = vec3(q[0], q[1], q[2])
        c = wp.cross(u, v) * (real(2.0) / wp.dot(q, q))
        return v + c * (sign * q[3]) + wp.cross(u, c)

    @wp.func
    def turned(q: quat, m: mat33, v: vec3):
        """R M R' v."""
        return turn(q, m * turn(q, v, -real(1.0)), real(1.0))

    @wp.func
    def spin_rate(q: quat, momentum: vec3, inverse: mat33):
        """dq/dt of a free top, 1/2 w q."""
        w = turned(q, inverse, momentum)
        return quat(w[0], w[1], w[2], real(0.0)) * q * real(0.5)

    @wp.kernel(module=module, enable_backward=False)
    def turn_frames(
        # Model
        node_count: int,
        frame_spin: wp.array(dtype=wp.int32),
        frame_inertia: wp.array2d(dtype=real),
        frame_inverse_inertia: wp.array2d(dtype=real),
        # Workspace in
        pose0_in: wp.array3d(dtype=real),
        slot_v_in: wp.array3d(dtype=real),
        h: real,
        # Workspace out
        pose_out: wp.array3d(dtype=real),
        twist_out: wp.array3d(dtype=real),
    ):
        """Twist of one frame at the end of the step; orientation of a free top."""
        pack, frame, lane = wp.tid()
        slot = 3 * (node_count + 2 * frame)
        w = vec3()
        for c in range(3):
            twist_out[pack, 6 * frame + c, lane] = slot_v_in[pack, slot + c, lane]
            w[c] = slot_v_in[pack, slot + 3 + c, lane]
        mode = frame_spin[frame]
        if mode != wp.static(AS_SOLVED):
            row = 7 * frame + 3
            q0 = quat_at(pose0_in, pack, lane, row)
            inertia = symmetric(frame_inertia, frame)
            inverse = symmetric(frame_inverse_inertia, frame)
            momentum = turned(q0, inertia, w)
            q = quat_at(pose_out, pack, lane, row)
            if mode == wp.static(FREE_TOP):
                k1 = spin_rate(q0, momentum, inverse)
                k2 = spin_rate(q0 + k1 * (real(0.5) * h), momentum, inverse)
                k3 = spin_rate(q0 + k2 * (real(0.5) * h), momentum, inverse)
                k4 = spin_rate(q0 + k3 * h, momentum, inverse)
                q = wp.normalize(q0 + (k1 + k2 * real(2.0) + k3 * real(2.0) + k4) * (h / real(6.0)))
                for c in range(4):
                    pose_out[pack, row + c, lane] = q[c]
            w += turned(q, inverse, momentum - turned(q, inertia, w))  # I I^-1 is 1 to rounding only
        for c in range(3):
            twist_out[pack, 6 * frame + 3 + c, lane] = w[c]

    @wp.kernel(module=module, enable_backward=False)
    def check_frames(
        # Workspace in
        pose0_in: wp.array3d(dtype=real),
        pose_in: wp.array3d(dtype=real),
        twist_in: wp.array3d(dtype=real),
        reach: real,
        # Workspace out
        flag_out: wp.array3d(dtype=wp.int32),
    ):
        """Raise flag 0 where a frame is not finite, flag 1 where it moved farther than ``reach`` [m] in one step."""
        pack, frame, lane = wp.tid()
        good = bool(True)
        far = bool(False)
        for c in range(7):
            value = pose_in[pack, 7 * frame + c, lane]
            good = good and wp.isfinite(value)
            if c < 3 and wp.abs(value - pose0_in[pack, 7 * frame + c, lane]) > reach:
                far = True
        for c in range(6):
            good = good and wp.isfinite(twist_in[pack, 6 * frame + c, lane])
        if not good:
            flag_out[pack, 0, lane] = 1
        elif far:
            flag_out[pack, 1, lane] = 1

    @wp.kernel(module=module, enable_backward=False)
    def commit_state(
        lanes: int,
        # Workspace in
        flag_in: wp.array3d(dtype=wp.int32),
        value_in: wp.array3d(dtype=real),
        # State out
        value_out: wp.array2d(dtype=real),
        good_out: wp.array2d(dtype=real),
    ):
        """Write one row of a good world; a failed one keeps what it had, or gets back its last good value."""
        pack, row, lane = wp.tid()
        world = pack * lanes + lane
        if world < value_out.shape[0]:
            if flag_in[pack, 0, lane] + flag_in[pack, 1, lane] == 0:
                value_out[world, row] = value_in[pack, row, lane]
                good_out[world, row] = value_in[pack, row, lane]
            elif not wp.isfinite(value_out[world, row]):
                value_out[world, row] = good_out[world, row]

    @wp.kernel(module=module, enable_backward=False)
    def commit_carried(
        # Model
        node_count: int,
        carried_slot: wp.array(dtype=wp.int32),
        lanes: int,
        # Workspace in
        flag_in: wp.array3d(dtype=wp.int32),
        slot_v_in: wp.array3d(dtype=real),
        # State out
        node_v_out: wp.array2d(dtype=real),
        good_v_out: wp.array2d(dtype=real),
    ):
        """Velocity of one carried node in a good world."""
        pack, item, lane = wp.tid()
        world = pack * lanes + lane
        slot = carried_slot[item]
        if slot < node_count and world < node_v_out.shape[0]:
            if flag_in[pack, 0, lane] + flag_in[pack, 1, lane] == 0:
                for c in range(3):
                    node_v_out[world, 3 * slot + c] = slot_v_in[pack, 3 * slot + c, lane]
                    good_v_out[world, 3 * slot + c] = slot_v_in[pack, 3 * slot + c, lane]

    return SimpleNamespace(
        turn_frames=turn_frames, check_frames=check_frames, commit_state=commit_state, commit_carried=commit_carried
    )
