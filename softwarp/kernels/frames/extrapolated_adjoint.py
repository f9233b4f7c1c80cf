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
from softwarp.model.codes import Spin


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type, on single worlds."""
    real = variant.real
    module = variant.module("adjoint.extrapolated")
    one = single.functions(variant)
    vec3, quat, exponential, logarithm = one.vec3, one.quat, one.exponential, one.logarithm
    turns, of_rods = of_frames.functions(variant), rod_adjoint.functions(variant)
    turn_bar, jacobian_transposed = turns.turn_bar, turns.jacobian_transposed
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
        # State
        pose0_in: wp.array2d(dtype=real),
        pose1_in: wp.array2d(dtype=real),
        # State out
        pose_bar_out: wp.array2d(dtype=real),
        twist_bar_out: wp.array2d(dtype=real),
        pose_rest_out: wp.array2d(dtype=real),
        twist_rest_out: wp.array2d(dtype=real),
    ):
        """Gradients by the extrapolated pose and twist of one frame, as those by both states that these follow from.

        They are by the end of the stage before, in place, and by the start of the step. Free tops are left out.
        """
        pack, frame, lane = wp.tid()
        world = pack * lanes + lane
        if world < pose_bar_out.shape[0] and frame_master[frame] == frame:
            if frame_spin[frame] != wp.static(Spin.FREE_TOP):
                row = 7 * frame
                for c in range(3):
                    bar = pose_bar_out[world, row + c]
                    pose_bar_out[world, row + c] = factor * bar
                    pose_rest_out[world, row + c] = bar - factor * bar
                for c in range(6):
                    bar = twist_bar_out[world, 6 * frame + c]
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

    return SimpleNamespace(part_frames=part_frames)
