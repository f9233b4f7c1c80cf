"""Stress relaxation of soft bodies: a Maxwell branch with memories. Theory: docs/theory/relaxation.md.

Beside the law's force f(x) acts g K y, where the memory y [m] follows dy/dt = v - y / tau, that is
    y = (y0 + h v) r,  r = tau / (tau + h)
in a step. So K in A gets the factor h (h + beta'), beta' = beta + g r h, and b loses h g r K y0. Steps find the latter
without a product of their own: damping already takes h beta' K v from b, and mass M (1 + h alpha) v. Velocities that
*lean*, v + e y0 with e = g r / beta', and momentum M (v0 + (1 + h alpha) e y0) leave just h g r K y0 more.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.frames.inertia import COMPOUND_ROWS


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels on single worlds."""
    real = variant.real
    one = single.functions(variant)
    quat_at, logarithm = one.quat_at, one.logarithm
    module = variant.module("relaxation")

    @wp.kernel(module=module, enable_backward=False)
    def scales(
        bodies: int,
        h: real,
        # Workspace in
        ratio_in: wp.array3d(dtype=real),
        time_in: wp.array3d(dtype=real),
        rayleigh_stiffness_in: wp.array3d(dtype=real),
        # Workspace out
        stiffness_out: wp.array3d(dtype=real),
        damping_out: wp.array3d(dtype=real),
        beta_out: wp.array3d(dtype=real),
        keep_out: wp.array3d(dtype=real),
        lean_out: wp.array3d(dtype=real),
    ):
        """Factor of K, its share that damps, beta', r and e of all soft bodies; the largest r and e come after them.

        Statics, h <= 0, know no relaxation.
        """
        pack, lane = wp.tid()
        keep = real(0.0)
        lean = real(0.0)
        for body in range(bodies):
            beta = rayleigh_stiffness_in[pack, body, lane]
            r = real(0.0)
            e = real(0.0)
            if h > real(0.0):
                time = time_in[pack, body, lane]
                r = time / (time + h)
                c = ratio_in[pack, body, lane] * r
                beta += c * h
                if c > real(0.0):
                    e = c / beta
                stiffness_out[pack, body, lane] = h * (h + beta)
                damping_out[pack, body, lane] = beta / (h + beta)
            beta_out[pack, body, lane] = beta
            keep_out[pack, body, lane] = r
            lean_out[pack, body, lane] = e
            keep = wp.max(keep, r)
            lean = wp.max(lean, e)
        keep_out[pack, bodies, lane] = keep
        lean_out[pack, bodies, lane] = lean

    @wp.kernel(module=module, enable_backward=False)
    def lean_nodes(
        # Model
        node_body: wp.array(dtype=wp.int32),
        # Workspace in
        lean_in: wp.array3d(dtype=real),
        mass_scale_in: wp.array3d(dtype=real),
        v0_in: wp.array3d(dtype=real),
        memory_in: wp.array3d(dtype=real),
        # Workspace out
        v0_out: wp.array3d(dtype=real),
    ):
        """Start velocity of one node that stands for its momentum and memory."""
        pack, node, lane = wp.tid()
        body = node_body[node]
        share = lean_in[pack, body, lane] * mass_scale_in[pack, body, lane]
        for c in range(3):
            row = 3 * node + c
            v0_out[pack, row, lane] = v0_in[pack, row, lane] + share * memory_in[pack, row, lane]

    @wp.kernel(module=module, enable_backward=False)
    def lean_frames(
        bodies: int,
        # Workspace in
        lean_in: wp.array3d(dtype=real),
        compound_in: wp.array3d(dtype=real),
        twist0_in: wp.array3d(dtype=real),
        memory_in: wp.array3d(dtype=real),
        # Workspace out
        twist0_out: wp.array3d(dtype=real),
    ):
        """The same for one frame; what it carries has the same 1 + h alpha."""
        pack, frame, lane = wp.tid()
        share = lean_in[pack, bodies, lane]
        mass = compound_in[pack, wp.static(COMPOUND_ROWS) * frame, lane]
        if mass > real(0.0):
            share *= compound_in[pack, wp.static(COMPOUND_ROWS) * frame + 10, lane] / mass
        for c in range(6):
            row = 6 * frame + c
            twist0_out[pack, row, lane] = twist0_in[pack, row, lane] + share * memory_in[pack, row, lane]

    @wp.kernel(module=module, enable_backward=False)
    def lean_dofs(
        node_count: int,
        bodies: int,
        # Model
        dof_node: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        # Workspace in
        lean_in: wp.array3d(dtype=real),
        node_memory_in: wp.array3d(dtype=real),
        frame_memory_in: wp.array3d(dtype=real),
        dof_v_in: wp.array3d(dtype=real),
        # Workspace out
        dof_v_out: wp.array3d(dtype=real),
    ):
        """v + e y of one dof."""
        pack, dof, lane = wp.tid()
        slot = dof_node[dof]
        for c in range(3):
            y = real(0.0)  # of modes
            if slot < node_count:
                y = lean_in[pack, node_body[slot], lane] * node_memory_in[pack, 3 * slot + c, lane]
            elif 3 * (slot - node_count) + c < frame_memory_in.shape[1]:
                y = lean_in[pack, bodies, lane] * frame_memory_in[pack, 3 * (slot - node_count) + c, lane]
            dof_v_out[pack, 3 * dof + c, lane] = dof_v_in[pack, 3 * dof + c, lane] + y

    @wp.kernel(module=module, enable_backward=False)
    def remember_nodes(
        # Model
        node_body: wp.array(dtype=wp.int32),
        # Workspace in
        keep_in: wp.array3d(dtype=real),
        memory_in: wp.array3d(dtype=real),
        x0_in: wp.array3d(dtype=real),
        x_in: wp.array3d(dtype=real),
        # Workspace out
        memory_out: wp.array3d(dtype=real),
    ):
        """Memory of one node after the step."""
        pack, node, lane = wp.tid()
        r = keep_in[pack, node_body[node], lane]
        for c in range(3):
            row = 3 * node + c
            way = x_in[pack, row, lane] - x0_in[pack, row, lane]
            memory_out[pack, row, lane] = (memory_in[pack, row, lane] + way) * r

    @wp.kernel(module=module, enable_backward=False)
    def remember_frames(
        bodies: int,
        # Workspace in
        keep_in: wp.array3d(dtype=real),
        memory_in: wp.array3d(dtype=real),
        pose0_in: wp.array3d(dtype=real),
        pose_in: wp.array3d(dtype=real),
        # Workspace out
        memory_out: wp.array3d(dtype=real),
    ):
        """Memory of one frame after the step; of turning [rad] as of moving."""
        pack, frame, lane = wp.tid()
        r = keep_in[pack, bodies, lane]
        q0 = quat_at(pose0_in, pack, lane, 7 * frame + 3)
        q = quat_at(pose_in, pack, lane, 7 * frame + 3)
        turn = logarithm(q * wp.quat_inverse(q0))
        for c in range(3):
            way = pose_in[pack, 7 * frame + c, lane] - pose0_in[pack, 7 * frame + c, lane]
            memory_out[pack, 6 * frame + c, lane] = (memory_in[pack, 6 * frame + c, lane] + way) * r
            memory_out[pack, 6 * frame + 3 + c, lane] = (memory_in[pack, 6 * frame + 3 + c, lane] + turn[c]) * r

    return SimpleNamespace(
        scales=scales,
        lean_nodes=lean_nodes,
        lean_frames=lean_frames,
        lean_dofs=lean_dofs,
        remember_nodes=remember_nodes,
        remember_frames=remember_frames,
    )
