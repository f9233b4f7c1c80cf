"""Adjoint of Maxwell branches and of damping in a step: gradients by memories, and by what their factors are made of.

With beta' = beta + c h, c = g r, r = tau / (tau + h), k = h (h + beta') and kappa = k K p the elements of a body have

    by beta': -(s (kappa.v0 + kappa.e y_F) - c / (h + beta') kappa.y) / (h + beta') more than at fixed velocities,
    by c: -kappa.y / (h + beta'),

with y of its own nodes and y_F that of frames at those they carry, s = h / (h + beta') in a stage. Frames have the
largest e and r of all bodies; at the end of a step memories are r (y + h v). Theory: docs/theory/adjoint.md.
State arrays are ``[world, row]``; workspace arrays ``[pack, row, lane]``.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.frames.inertia import COMPOUND_ROWS
from softwarp.kernels.frames.parameter_adjoint import functions as of_compounds

SUM_ROWS = 4  # of a body: kappa.v0, kappa.y of its nodes, kappa.e y of frames, and what memories have by r


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type, on single worlds."""
    real = variant.real
    module = variant.module("adjoint.relaxation")
    one = single.functions(variant)
    vec3, vector_at, quat_at = one.vec3, one.vector_at, one.quat_at
    inertia_at, put = one.inertia_at, one.put
    compounds = of_compounds(variant)
    turned, momentum = compounds.turned, compounds.momentum

    @wp.kernel(module=module, enable_backward=False)
    def seed(
        h: real,
        lanes: int,
        node_count: int,
        bodies: int,
        # Model
        dof_node: wp.array(dtype=wp.int32),
        dof_free: wp.array2d(dtype=real),
        node_body: wp.array(dtype=wp.int32),
        # State
        node_bar_in: wp.array2d(dtype=real),
        frame_bar_in: wp.array2d(dtype=real),
        # Workspace in
        keep_in: wp.array3d(dtype=real),
        # Workspace out
        seed_out: wp.array3d(dtype=real),
        y_out: wp.array3d(dtype=real),
        bare_out: wp.array3d(dtype=real),
    ):
        """Add the gradients by velocities of one dof that its memory has; to ``bare`` those of prescribed ones too."""
        pack, dof, lane = wp.tid()
        world = wp.min(pack * lanes + lane, node_bar_in.shape[0] - 1)
        slot = dof_node[dof]
        for c in range(3):
            value = real(0.0)
            if slot < node_count:
                value = h * keep_in[pack, node_body[slot], lane] * node_bar_in[world, 3 * slot + c]
            elif 3 * (slot - node_count) + c < frame_bar_in.shape[1]:  # else it is of modes
                row = 3 * (slot - node_count) + c
                value = h * keep_in[pack, bodies, lane] * frame_bar_in[world, row]
                bare_out[pack, row, lane] = bare_out[pack, row, lane] + value
            value *= dof_free[dof, c]
            seed_out[pack, 3 * dof + c, lane] = seed_out[pack, 3 * dof + c, lane] + value
            y_out[pack, 3 * dof + c, lane] = y_out[pack, 3 * dof + c, lane] + value

    @wp.kernel(module=module, enable_backward=False)
    def products(
        # Model
        node_dof: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        # Workspace in
        density_in: wp.array3d(dtype=real),
        body_mass_in: wp.array3d(dtype=real),
        pushed_in: wp.array3d(dtype=real),
        node_mass_p_in: wp.array3d(dtype=real),
        # Workspace out
        product_out: wp.array3d(dtype=real),
    ):
        """kappa of one node that no frame carries; 0 if it is fixed."""
        pack, node, lane = wp.tid()
        dof = node_dof[node]
        found = vec3()
        if dof >= 0:
            mass = density_in[pack, node_body[node], lane] * body_mass_in[pack, node_body[node], lane]
            found = vector_at(pushed_in, pack, lane, 3 * dof) - mass * vector_at(node_mass_p_in, pack, lane, 3 * node)
        put(product_out, pack, lane, 3 * node, found)

    @wp.kernel(module=module, enable_backward=False)
    def carried_products(
        nodes: int,
        # Model
        carried_slot: wp.array(dtype=wp.int32),
        # Workspace in
        stiff_p_in: wp.array3d(dtype=real),
        # Workspace out
        product_out: wp.array3d(dtype=real),
    ):
        """The same of one node that a frame carries."""
        pack, item, lane = wp.tid()
        node = carried_slot[item]
        if node < nodes:
            put(product_out, pack, lane, 3 * node, vector_at(stiff_p_in, pack, lane, 3 * node))

    @wp.kernel(module=module, enable_backward=False)
    def sums(
        h: real,
        lanes: int,
        relaxes: bool,
        # Model
        body_node_start: wp.array(dtype=wp.int32),
        node_dof: wp.array(dtype=wp.int32),
        # State
        bar_in: wp.array2d(dtype=real),
        # Workspace in
        product_in: wp.array3d(dtype=real),
        start_v_in: wp.array3d(dtype=real),
        lean_in: wp.array3d(dtype=real),
        memory_in: wp.array3d(dtype=real),
        node_v_in: wp.array3d(dtype=real),
        # Workspace out
        sum_out: wp.array3d(dtype=real),
    ):
        """The four sums over the nodes of one body; ``start_v_in`` and so on are of nodes."""
        pack, body, lane = wp.tid()
        world = wp.min(pack * lanes + lane, bar_in.shape[0] - 1)
        early = real(0.0)
        own = real(0.0)
        others = real(0.0)
        kept = real(0.0)
        for node in range(body_node_start[body], body_node_start[body + 1]):
            row = 3 * node
            product = vector_at(product_in, pack, lane, row)
            early += wp.dot(product, vector_at(start_v_in, pack, lane, row))
            if relaxes:
                y = vector_at(memory_in, pack, lane, row)
                if node_dof[node] >= 0:
                    own += wp.dot(product, y)
                    bar = vec3(bar_in[world, row], bar_in[world, row + 1], bar_in[world, row + 2])
                    kept += wp.dot(bar, y + h * vector_at(node_v_in, pack, lane, row))
                else:
                    others += wp.dot(product, vector_at(lean_in, pack, lane, row))
        row = wp.static(SUM_ROWS) * body
        sum_out[pack, row, lane] = early
        sum_out[pack, row + 1, lane] = own
        sum_out[pack, row + 2, lane] = others
        sum_out[pack, row + 3, lane] = kept

    @wp.kernel(module=module, enable_backward=False)
    def by_damping(
        h: real,
        lanes: int,
        # Workspace in
        damping_in: wp.array3d(dtype=real),
        beta_in: wp.array3d(dtype=real),
        sum_in: wp.array3d(dtype=real),
        # State out
        rayleigh_stiffness_bar_out: wp.array2d(dtype=real),
    ):
        """Make the gradient by beta of one body that at its own velocities, from that at those of its elements."""
        pack, body, lane = wp.tid()
        world = pack * lanes + lane
        if world < rayleigh_stiffness_bar_out.shape[0]:
            s = real(1.0) - damping_in[pack, body, lane]
            change = s * sum_in[pack, wp.static(SUM_ROWS) * body, lane] / (h + beta_in[pack, body, lane])
            rayleigh_stiffness_bar_out[world, body] = rayleigh_stiffness_bar_out[world, body] - change

    @wp.kernel(module=module, enable_backward=False)
    def node_memories(
        h: real,
        lanes: int,
        # Model
        node_dof: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        # Workspace in
        ratio_in: wp.array3d(dtype=real),
        beta_in: wp.array3d(dtype=real),
        keep_in: wp.array3d(dtype=real),
        product_in: wp.array3d(dtype=real),
        # State out
        bar_out: wp.array2d(dtype=real),
    ):
        """Gradient by the memory of one node at the start of the step; needs ``sums``."""
        pack, node, lane = wp.tid()
        world = pack * lanes + lane
        if world < bar_out.shape[0]:
            body = node_body[node]
            r = keep_in[pack, body, lane]
            share = ratio_in[pack, body, lane] * r / (h + beta_in[pack, body, lane])
            for c in range(3):
                row = 3 * node + c
                found = real(0.0)
                if node_dof[node] >= 0:
                    found = r * bar_out[world, row] - share * product_in[pack, row, lane]
                bar_out[world, row] = found

    @wp.kernel(module=module, enable_backward=False)
    def frame_memories(
        h: real,
        lanes: int,
        bodies: int,
        # Model
        frame_master: wp.array(dtype=wp.int32),
        frame_dof: wp.array(dtype=wp.int32),
        # Workspace in
        keep_in: wp.array3d(dtype=real),
        lean_in: wp.array3d(dtype=real),
        memory_in: wp.array3d(dtype=real),
        v_in: wp.array3d(dtype=real),
        mind_in: wp.array3d(dtype=real),
        # State out
        bar_out: wp.array2d(dtype=real),
        # Workspace out
        value_out: wp.array3d(dtype=real),
    ):
        """Gradient by the memory of one frame at the start; in ``value`` those by e and by r of frames."""
        pack, frame, lane = wp.tid()
        world = pack * lanes + lane
        if world < bar_out.shape[0]:
            r = keep_in[pack, bodies, lane]
            e = lean_in[pack, bodies, lane]
            by_e = real(0.0)
            by_r = real(0.0)
            for c in range(6):
                row = 6 * frame + c
                found = real(0.0)
                if frame_master[frame] == frame:
                    y = memory_in[pack, row, lane]
                    by_e += y * mind_in[pack, row, lane]
                    v = v_in[pack, 3 * frame_dof[2 * frame + c / 3] + c % 3, lane]
                    by_r += bar_out[world, row] * (y + h * v)
                    found = r * bar_out[world, row] + e * mind_in[pack, row, lane]
                bar_out[world, row] = found
            value_out[pack, 2 * frame, lane] = by_e
            value_out[pack, 2 * frame + 1, lane] = by_r

    @wp.kernel(module=module, enable_backward=False)
    def sources(
        bodies: int,
        # Model
        source_frame: wp.array(dtype=wp.int32),
        source: wp.array2d(dtype=wp.int32),
        frame_volume: wp.array(dtype=real),
        node_volume: wp.array(dtype=real),
        frame_dof: wp.array(dtype=wp.int32),
        # Workspace in
        lean_in: wp.array3d(dtype=real),
        pose0_in: wp.array3d(dtype=real),
        compound_in: wp.array3d(dtype=real),
        memory_in: wp.array3d(dtype=real),
        p_in: wp.array3d(dtype=real),
        # Workspace out
        value_out: wp.array3d(dtype=real),
    ):
        """Add to the values of one part of a compound what it has by the share e m' / m of the memory in momentum.

        m' is the damped mass; values are those of ``parameter_adjoint.sources``.
        """
        pack, item, lane = wp.tid()
        frame = source_frame[item]
        k = wp.static(COMPOUND_ROWS) * frame
        m = compound_in[pack, k, lane]
        if m > real(0.0):
            volume = real(0.0)
            if source[item, 0] == 0:
                volume = node_volume[source[item, 1]]
            else:
                volume = frame_volume[source[item, 1]]
            q = quat_at(pose0_in, pack, lane, 7 * frame + 3)
            s = wp.quat_rotate(q, vector_at(compound_in, pack, lane, k + 1))
            J = turned(q, inertia_at(compound_in, pack, lane, k + 4))
            pt = vector_at(p_in, pack, lane, 3 * frame_dof[2 * frame])
            P, L = momentum(m, s, J, pt, vector_at(p_in, pack, lane, 3 * frame_dof[2 * frame + 1]))
            total = wp.dot(P, vector_at(memory_in, pack, lane, 6 * frame))
            total += wp.dot(L, vector_at(memory_in, pack, lane, 6 * frame + 3))
            total *= lean_in[pack, bodies, lane] * volume / m
            ratio = compound_in[pack, k + 10, lane] / m
            value_out[pack, 2 * item, lane] = value_out[pack, 2 * item, lane] - ratio * total
            value_out[pack, 2 * item + 1, lane] = value_out[pack, 2 * item + 1, lane] - total

    @wp.kernel(module=module, enable_backward=False)
    def constants(
        h: real,
        lanes: int,
        bodies: int,
        frames: int,
        # State
        damped_before_in: wp.array2d(dtype=real),
        # Workspace in
        ratio_in: wp.array3d(dtype=real),
        time_in: wp.array3d(dtype=real),
        damping_in: wp.array3d(dtype=real),
        beta_in: wp.array3d(dtype=real),
        keep_in: wp.array3d(dtype=real),
        lean_in: wp.array3d(dtype=real),
        sum_in: wp.array3d(dtype=real),
        value_in: wp.array3d(dtype=real),
        # State out
        rayleigh_stiffness_bar_out: wp.array2d(dtype=real),
        ratio_bar_out: wp.array2d(dtype=real),
        time_bar_out: wp.array2d(dtype=real),
    ):
        """Add the gradients by g and tau, and make that by beta the one at own velocities; of all bodies of a world.

        What frames have goes to the first of the bodies whose e, or r, is the largest. ``damped_before`` is the
        gradient by beta before this step.
        """
        pack, lane = wp.tid()
        world = pack * lanes + lane
        if world < ratio_bar_out.shape[0]:
            by_e = real(0.0)
            by_r = real(0.0)
            for frame in range(frames):
                by_e += value_in[pack, 2 * frame, lane]
                by_r += value_in[pack, 2 * frame + 1, lane]
            leaning = int(-1)
            keeping = int(-1)
            for body in range(bodies):
                if leaning < 0 and lean_in[pack, body, lane] == lean_in[pack, bodies, lane]:
                    leaning = body
                if keeping < 0 and keep_in[pack, body, lane] == keep_in[pack, bodies, lane]:
                    keeping = body
            for body in range(bodies):
                row = wp.static(SUM_ROWS) * body
                tau = time_in[pack, body, lane]
                g = ratio_in[pack, body, lane]
                beta = beta_in[pack, body, lane]
                r = keep_in[pack, body, lane]
                d = damping_in[pack, body, lane]
                length = h + beta
                own = sum_in[pack, row + 1, lane]
                early = sum_in[pack, row, lane] + sum_in[pack, row + 2, lane]
                change = (g * r / length * own - (real(1.0) - d) * early) / length
                by_c = -own / length
                of_r = sum_in[pack, row + 3, lane]
                if body == leaning and beta > real(0.0):
                    change -= by_e * g * r / (beta * beta)
                    by_c += by_e / beta
                if body == keeping:
                    of_r += by_r
                total = rayleigh_stiffness_bar_out[world, body] + change
                rayleigh_stiffness_bar_out[world, body] = total
                by_c += h * (total - damped_before_in[world, body])
                of_r += g * by_c
                ratio_bar_out[world, body] = ratio_bar_out[world, body] + r * by_c
                time_bar_out[world, body] = time_bar_out[world, body] + of_r * h / ((tau + h) * (tau + h))

    return SimpleNamespace(
        seed=seed,
        products=products,
        carried_products=carried_products,
        sums=sums,
        by_damping=by_damping,
        node_memories=node_memories,
        frame_memories=frame_memories,
        sources=sources,
        constants=constants,
    )
