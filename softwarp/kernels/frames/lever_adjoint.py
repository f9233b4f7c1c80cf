"""Gradients of what frames carry by where it is in them at rest. Theory: docs/theory/adjoint.md, "Rest shapes".

A carried node has the lever o in its frame, which its rest position gives. A step has it in places and velocities,
whose gradients by o are in ``offset`` already, and in the mass, m (1, o, o.o 1 - o o') of the compound: what that is
good for is linear in these three.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.frames import parameter_adjoint
from softwarp.kernels.frames.inertia import COMPOUND_ROWS
from softwarp.kernels.frames.parameter_adjoint import MOVED_ROWS


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type, on single worlds."""
    real = variant.real
    module = variant.module("adjoint.levers")
    one, f = single.functions(variant), parameter_adjoint.functions(variant)
    vec3, mat33, quat, vector_at, quat_at = one.vec3, one.mat33, one.quat, one.vector_at, one.quat_at
    put, add_to, inertia_at = one.put, one.add_to, one.inertia_at
    turned, momentum, of_share = f.turned, f.momentum, f.of_share

    @wp.struct
    class Motion:
        pose0: wp.array3d(dtype=real)
        twist0: wp.array3d(dtype=real)
        v: wp.array3d(dtype=real)
        p: wp.array3d(dtype=real)
        end_v: wp.array3d(dtype=real)
        moved: wp.array3d(dtype=real)
        share: wp.array3d(dtype=real)

    @wp.func
    def worth(a: Motion, pack: int, lane: int, frame: int, t: int, r: int, m: real, s: vec3, J: mat33, scale: real):
        """What a mass m, its first moment and inertia in the axes of a frame are good for; see ``sources``."""
        row = wp.static(MOVED_ROWS) * frame
        total = of_share(a.share, pack, lane, frame, m, s, J)
        cr = vector_at(a.moved, pack, lane, row + 6)
        q1 = quat_at(a.moved, pack, lane, row + 15)
        P, L = momentum(m, wp.quat_rotate(q1, s), turned(q1, J), vector_at(a.moved, pack, lane, row), cr)
        total -= wp.dot(P, vector_at(a.moved, pack, lane, row + 9))
        total -= wp.dot(L, vector_at(a.moved, pack, lane, row + 12))
        q = quat_at(a.pose0, pack, lane, 7 * frame + 3)
        J0 = turned(q, J)
        s0 = wp.quat_rotate(q, s)
        P, L = momentum(m, s0, J0, vector_at(a.moved, pack, lane, row + 3), cr)
        total += wp.dot(P, vector_at(a.end_v, pack, lane, t)) + wp.dot(L, vector_at(a.end_v, pack, lane, r))
        P, L = momentum(m, s0, J0, vector_at(a.p, pack, lane, t), vector_at(a.p, pack, lane, r))
        total += wp.dot(P, vector_at(a.twist0, pack, lane, 6 * frame) - scale * vector_at(a.v, pack, lane, t))
        return total + wp.dot(L, vector_at(a.twist0, pack, lane, 6 * frame + 3) - scale * vector_at(a.v, pack, lane, r))

    @wp.kernel(module=module, enable_backward=False)
    def levers(
        # Model
        source_frame: wp.array(dtype=wp.int32),
        source: wp.array2d(dtype=wp.int32),
        source_lever: wp.array2d(dtype=real),
        node_volume: wp.array(dtype=real),
        node_body: wp.array(dtype=wp.int32),
        frame_dof: wp.array(dtype=wp.int32),
        # Workspace in
        density_in: wp.array3d(dtype=real),
        body_mass_in: wp.array3d(dtype=real),
        motion: Motion,
        v0_in: wp.array3d(dtype=real),
        node_v_in: wp.array3d(dtype=real),
        node_p_in: wp.array3d(dtype=real),
        compound_in: wp.array3d(dtype=real),
        lean_in: wp.array3d(dtype=real),
        memory_in: wp.array3d(dtype=real),
        # Workspace out
        offset_out: wp.array3d(dtype=real),
        volume_out: wp.array3d(dtype=real),
    ):
        """Add what the mass of one carried node has by its lever; what it has by its volume, per density.

        Of the latter that is left out which elements count for it, as for every node: p.(v0 - scale v). Where there are
        memories, their share e m' / m in momentum follows the mass, too.
        """
        pack, item, lane = wp.tid()
        if source[item, 0] == 0:
            node = source[item, 1]
            frame = source_frame[item]
            t = 3 * frame_dof[2 * frame]
            r = 3 * frame_dof[2 * frame + 1]
            scale = body_mass_in[pack, node_body[node], lane]
            mass = node_volume[node] * density_in[pack, node_body[node], lane]
            x = vec3(source_lever[item, 0], source_lever[item, 1], source_lever[item, 2])
            J = wp.dot(x, x) * wp.identity(n=3, dtype=real) - wp.outer(x, x)
            whole = worth(motion, pack, lane, frame, t, r, real(1.0), x, J, scale)
            row = 3 * node
            k = wp.static(COMPOUND_ROWS) * frame
            m = compound_in[pack, k, lane]
            if lean_in.shape[1] > 0 and m > real(0.0):
                q = quat_at(motion.pose0, pack, lane, 7 * frame + 3)
                s = wp.quat_rotate(q, vector_at(compound_in, pack, lane, k + 1))
                J0 = turned(q, inertia_at(compound_in, pack, lane, k + 4))
                P, L = momentum(m, s, J0, vector_at(motion.p, pack, lane, t), vector_at(motion.p, pack, lane, r))
                share = wp.dot(P, vector_at(memory_in, pack, lane, 6 * frame))
                share += wp.dot(L, vector_at(memory_in, pack, lane, 6 * frame + 3))
                share *= lean_in[pack, lean_in.shape[1] - 1, lane] / m
                whole += (scale - compound_in[pack, k + 10, lane] / m) * share
            change = vector_at(v0_in, pack, lane, row) - scale * vector_at(node_v_in, pack, lane, row)
            volume_out[pack, node, lane] = whole - wp.dot(vector_at(node_p_in, pack, lane, row), change)
            by_x = vec3()
            for k in range(3):
                e = vec3()
                e[k] = real(1.0)
                by_J = real(2.0) * x[k] * wp.identity(n=3, dtype=real) - wp.outer(e, x) - wp.outer(x, e)
                by_x[k] = mass * worth(motion, pack, lane, frame, t, r, real(0.0), e, by_J, scale)
            add_to(offset_out, pack, lane, 3 * source[item, 2], by_x)

    @wp.kernel(module=module, enable_backward=False)
    def rest_carried(
        lanes: int,
        nodes: int,
        # Model
        carried_slot: wp.array(dtype=wp.int32),
        carried_frame: wp.array(dtype=wp.int32),
        rest_pose: wp.array2d(dtype=real),
        # State out
        rest_bar_out: wp.array2d(dtype=real),
        # Workspace out
        offset_out: wp.array3d(dtype=real),
    ):
        """Add the gradient by the rest position of one carried node, from that by its lever, which becomes 0."""
        pack, item, lane = wp.tid()
        world = pack * lanes + lane
        node = carried_slot[item]
        if node < nodes:
            frame = carried_frame[item]
            q = quat(rest_pose[frame, 3], rest_pose[frame, 4], rest_pose[frame, 5], rest_pose[frame, 6])
            by_x = wp.quat_rotate(q, vector_at(offset_out, pack, lane, 3 * item))
            if world < rest_bar_out.shape[0]:
                for c in range(3):
                    rest_bar_out[world, 3 * node + c] = rest_bar_out[world, 3 * node + c] + by_x[c]
            put(offset_out, pack, lane, 3 * item, vec3())

    return SimpleNamespace(levers=levers, rest_carried=rest_carried, Motion=Motion)
