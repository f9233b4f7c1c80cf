"""Adjoint of steps whose elements feel other velocities than those that they find: of stages, and with memories.

With k = h (h + beta') elements have in the place of the velocities v

    v - s v0 + d e y,    s = h / (h + beta'),  d = 1 - s,

v0 the velocities of the start in a stage that is linearised where these lead to (else 0), and y the memories of Maxwell
branches with e = g r / beta'. Rows have v - v0. With kappa = k K p of a node at the lever r its frame has s kappa and
r x s kappa by its own v0, and -d kappa likewise by e y.

The stage moves frames by h V0 and exp [h w0]: a gradient g by the turn there is exp' g by that at the start, and
h T(h w0)' g by w0. Unknown rotations u come on top of that turn, so w = w0 + T(h w0)^-1 u.
Theory: docs/theory/adjoint.md. State arrays are ``[world, row]``; workspace arrays ``[pack, row, lane]``.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.elements import rod_adjoint
from softwarp.kernels.frames import adjoint as of_frames
from softwarp.kernels.frames.inertia import COMPOUND_ROWS
from softwarp.kernels.frames.parameter_adjoint import functions as of_compounds
from softwarp.model.codes import Spin

FELT_ROWS = 12  # of a carried item: by velocity and spin of the start, then by those of the memory


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type, on single worlds."""
    real = variant.real
    module = variant.module("adjoint.leaning")
    one = single.functions(variant)
    vec3, vector_at, quat_at = one.vec3, one.vector_at, one.quat_at
    quat, inertia_at, put, add_to, exponential = one.quat, one.inertia_at, one.put, one.add_to, one.exponential
    compounds = of_compounds(variant)
    turned, momentum = compounds.turned, compounds.momentum
    turns = of_frames.functions(variant)
    by_turn, jacobian_transposed = turns.by_turn, turns.jacobian_transposed
    of_rods = rod_adjoint.functions(variant)
    slopes, twisted = of_rods.slopes, of_rods.twisted

    @wp.func
    def offset_of(offset: wp.array2d(dtype=real), item: int):
        """Place in a frame."""
        return vec3(offset[item, 0], offset[item, 1], offset[item, 2])

    @wp.kernel(module=module, enable_backward=False)
    def velocities(
        body_nodes: int,
        # Model
        node_dof: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        # Workspace in
        damping_in: wp.array3d(dtype=real),
        v_in: wp.array3d(dtype=real),
        start_v_in: wp.array3d(dtype=real),
        lean_in: wp.array3d(dtype=real),
        # Workspace out
        start_out: wp.array3d(dtype=real),
        lean_out: wp.array3d(dtype=real),
        element_v_out: wp.array3d(dtype=real),
        row_v_out: wp.array3d(dtype=real),
    ):
        """What elements and rows have in the place of the velocity of one node that no frame carries; v0 and e y."""
        pack, node, lane = wp.tid()
        v = vector_at(v_in, pack, lane, 3 * node)
        dof = node_dof[node]
        v0 = vec3()
        y = vec3()
        if dof >= 0:
            v0 = vector_at(start_v_in, pack, lane, 3 * dof)
            y = vector_at(lean_in, pack, lane, 3 * dof)
        put(start_out, pack, lane, 3 * node, v0)
        put(lean_out, pack, lane, 3 * node, y)
        put(row_v_out, pack, lane, 3 * node, v - v0)
        if node < body_nodes:
            d = damping_in[pack, node_body[node], lane]
            put(element_v_out, pack, lane, 3 * node, v - (real(1.0) - d) * v0 + d * y)

    @wp.kernel(module=module, enable_backward=False)
    def lean_more(
        # Workspace in
        element_v_in: wp.array3d(dtype=real),
        v_in: wp.array3d(dtype=real),
        # Workspace out
        own_v_out: wp.array3d(dtype=real),
    ):
        """Add to another velocity of nodes what elements have beside v."""
        pack, row, lane = wp.tid()
        more = element_v_in[pack, row, lane] - v_in[pack, row, lane]
        own_v_out[pack, row, lane] = own_v_out[pack, row, lane] + more

    @wp.kernel(module=module, enable_backward=False)
    def carried_velocities(
        nodes: int,
        body_nodes: int,
        # Model
        carried_slot: wp.array(dtype=wp.int32),
        carried_frame: wp.array(dtype=wp.int32),
        carried_offset: wp.array2d(dtype=real),
        frame_dof: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        # Workspace in
        pose_in: wp.array3d(dtype=real),
        damping_in: wp.array3d(dtype=real),
        v_in: wp.array3d(dtype=real),
        start_v_in: wp.array3d(dtype=real),
        lean_in: wp.array3d(dtype=real),
        # Workspace out
        start_out: wp.array3d(dtype=real),
        lean_out: wp.array3d(dtype=real),
        element_v_out: wp.array3d(dtype=real),
        row_v_out: wp.array3d(dtype=real),
    ):
        """The same of one node that a frame carries."""
        pack, item, lane = wp.tid()
        node = carried_slot[item]
        if node >= nodes:
            return
        frame = carried_frame[item]
        t = 3 * frame_dof[2 * frame]
        s = 3 * frame_dof[2 * frame + 1]
        r = wp.quat_rotate(quat_at(pose_in, pack, lane, 7 * frame + 3), offset_of(carried_offset, item))
        v = vector_at(v_in, pack, lane, 3 * node)
        v0 = vector_at(start_v_in, pack, lane, t) + wp.cross(vector_at(start_v_in, pack, lane, s), r)
        y = vector_at(lean_in, pack, lane, t) + wp.cross(vector_at(lean_in, pack, lane, s), r)
        put(start_out, pack, lane, 3 * node, v0)
        put(lean_out, pack, lane, 3 * node, y)
        put(row_v_out, pack, lane, 3 * node, v - v0)
        if node < body_nodes:
            d = damping_in[pack, node_body[node], lane]
            put(element_v_out, pack, lane, 3 * node, v - (real(1.0) - d) * v0 + d * y)

    @wp.kernel(module=module, enable_backward=False)
    def twists(
        predicts: real,
        # Model
        frame_master: wp.array(dtype=wp.int32),
        frame_offset: wp.array2d(dtype=real),
        frame_dof: wp.array(dtype=wp.int32),
        frame_owner: wp.array(dtype=wp.int32),
        owner_body: wp.array(dtype=wp.int32),
        # Workspace in
        pose_in: wp.array3d(dtype=real),
        damping_in: wp.array3d(dtype=real),
        v_in: wp.array3d(dtype=real),
        start_v_in: wp.array3d(dtype=real),
        lean_in: wp.array3d(dtype=real),
        p_in: wp.array3d(dtype=real),
        # Workspace out
        frame_v_out: wp.array3d(dtype=real),
        frame_p_out: wp.array3d(dtype=real),
        early_out: wp.array3d(dtype=real),
    ):
        """What segments have in the place of the twist of one frame; its adjoint; v0 + e y.

        Rods have e y in a stage only, where they damp what they move with already.
        """
        pack, frame, lane = wp.tid()
        master = frame_master[frame]
        t = 3 * frame_dof[2 * frame]
        s = 3 * frame_dof[2 * frame + 1]
        d = damping_in[pack, owner_body[frame_owner[frame]], lane]
        keep = real(1.0) - d
        v0 = vector_at(start_v_in, pack, lane, t)
        w0 = vector_at(start_v_in, pack, lane, s)
        y = vector_at(lean_in, pack, lane, t)
        turning = vector_at(lean_in, pack, lane, s)
        v = vector_at(v_in, pack, lane, t) - keep * v0 + d * y
        w = vector_at(v_in, pack, lane, s) - keep * w0 + d * turning
        v0 += predicts * y
        w0 += predicts * turning
        p = vector_at(p_in, pack, lane, t)
        turn = vector_at(p_in, pack, lane, s)
        if master != frame:
            r = wp.quat_rotate(quat_at(pose_in, pack, lane, 7 * master + 3), offset_of(frame_offset, frame))
            v += wp.cross(w, r)
            v0 += wp.cross(w0, r)
            p += wp.cross(turn, r)
        put(early_out, pack, lane, 6 * frame, v0)
        put(early_out, pack, lane, 6 * frame + 3, w0)
        put(frame_v_out, pack, lane, 6 * frame, v)
        put(frame_v_out, pack, lane, 6 * frame + 3, w)
        put(frame_p_out, pack, lane, 6 * frame, p)
        put(frame_p_out, pack, lane, 6 * frame + 3, turn)

    @wp.kernel(module=module, enable_backward=False)
    def carried_gradients(
        h: real,
        lanes: int,
        nodes: int,
        body_node_count: int,
        # Model
        carried_slot: wp.array(dtype=wp.int32),
        carried_frame: wp.array(dtype=wp.int32),
        carried_offset: wp.array2d(dtype=real),
        frame_dof: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        node_point_start: wp.array(dtype=wp.int32),
        node_point: wp.array(dtype=wp.int32),
        node_point_weight: wp.array(dtype=real),
        point_row: wp.array(dtype=wp.int32),
        # Workspace in
        pose_in: wp.array3d(dtype=real),
        damping_in: wp.array3d(dtype=real),
        v_in: wp.array3d(dtype=real),
        start_v_in: wp.array3d(dtype=real),
        lean_in: wp.array3d(dtype=real),
        p_in: wp.array3d(dtype=real),
        point_gradient_in: wp.array3d(dtype=real),
        multiplier_in: wp.array3d(dtype=real),
        q_in: wp.array3d(dtype=real),
        node_bar_in: wp.array3d(dtype=real),
        impulse_in: wp.array3d(dtype=real),
        stiff_p_in: wp.array3d(dtype=real),
        # State out
        x_bar_out: wp.array2d(dtype=real),
        v_bar_out: wp.array2d(dtype=real),
        force_bar_out: wp.array2d(dtype=real),
        # Workspace out
        item_out: wp.array3d(dtype=real),
        felt_out: wp.array3d(dtype=real),
        offset_out: wp.array3d(dtype=real),
    ):
        """As ``adjoint.carried_gradients``; ``felt`` has the gradients by velocities of the start and of the memory."""
        pack, item, lane = wp.tid()
        world = pack * lanes + lane
        node = carried_slot[item]
        if node >= nodes:
            return
        frame = carried_frame[item]
        s = 3 * frame_dof[2 * frame + 1]
        q = quat_at(pose_in, pack, lane, 7 * frame + 3)
        r = wp.quat_rotate(q, offset_of(carried_offset, item))
        w = vector_at(v_in, pack, lane, s)
        w0 = vector_at(start_v_in, pack, lane, s)
        tense = vec3()
        stiff = vec3()
        bound = vec3()
        d = real(0.0)
        if node < body_node_count:
            tense = vector_at(impulse_in, pack, lane, 3 * node)
            stiff = vector_at(stiff_p_in, pack, lane, 3 * node)
            d = damping_in[pack, node_body[node], lane]
        for i in range(node_point_start[node], node_point_start[node + 1]):
            row = point_row[node_point[i]]
            gradient = h * node_point_weight[i] * vector_at(point_gradient_in, pack, lane, 3 * node_point[i])
            tense += multiplier_in[pack, row, lane] * gradient
            bound += q_in[pack, row, lane] * gradient
        place = vector_at(node_bar_in, pack, lane, 3 * node)
        lever = wp.cross(tense, vector_at(p_in, pack, lane, s)) - wp.cross(bound, w - w0)
        lever -= wp.cross(stiff, w - (real(1.0) - d) * w0 + d * vector_at(lean_in, pack, lane, s))
        add_to(offset_out, pack, lane, 3 * item, wp.quat_rotate_inv(q, place + lever))
        put(item_out, pack, lane, 12 * item, place)
        put(item_out, pack, lane, 12 * item + 3, wp.cross(r, place + lever))
        put(item_out, pack, lane, 12 * item + 6, -bound - stiff)
        put(item_out, pack, lane, 12 * item + 9, wp.cross(bound + stiff, r))
        early = bound + (real(1.0) - d) * stiff
        row = wp.static(FELT_ROWS) * item
        put(felt_out, pack, lane, row, early)
        put(felt_out, pack, lane, row + 3, wp.cross(r, early))
        put(felt_out, pack, lane, row + 6, -d * stiff)
        put(felt_out, pack, lane, row + 9, -d * wp.cross(r, stiff))
        if world < x_bar_out.shape[0]:
            for c in range(3):
                x_bar_out[world, 3 * node + c] = real(0.0)
                v_bar_out[world, 3 * node + c] = real(0.0)
                if node >= body_node_count:
                    force_bar_out[world, 3 * node + c] = real(0.0)

    @wp.kernel(module=module, enable_backward=False)
    def welded_felt(
        nodes: int,
        # Model
        welded_frame: wp.array(dtype=wp.int32),
        frame_owner: wp.array(dtype=wp.int32),
        owner_body: wp.array(dtype=wp.int32),
        slot_carried: wp.array(dtype=wp.int32),
        # Workspace in
        damping_in: wp.array3d(dtype=real),
        item_in: wp.array3d(dtype=real),
        # Workspace out
        felt_out: wp.array3d(dtype=real),
    ):
        """Gradients by velocities of the start and of the memory that one welded frame has, from its items."""
        pack, number, lane = wp.tid()
        frame = welded_frame[number]
        item = slot_carried[nodes + 2 * frame]
        d = damping_in[pack, owner_body[frame_owner[frame]], lane]
        for c in range(6):
            value = item_in[pack, 12 * item + 6 + c, lane]
            felt_out[pack, wp.static(FELT_ROWS) * item + c, lane] = (d - real(1.0)) * value
            felt_out[pack, wp.static(FELT_ROWS) * item + 6 + c, lane] = d * value

    @wp.kernel(module=module, enable_backward=False)
    def rod_damping(
        h: real,
        # Model
        seg_frame: wp.array2d(dtype=wp.int32),
        seg_body: wp.array(dtype=wp.int32),
        # Workspace in
        damping_in: wp.array3d(dtype=real),
        stiffness_in: wp.array3d(dtype=real),
        early_in: wp.array3d(dtype=real),
        way_in: wp.array3d(dtype=real),
        # Workspace out
        parameter_out: wp.array3d(dtype=real),
    ):
        """Make the gradient by beta of one segment that at its own velocities, from that at those which it feels."""
        pack, seg, lane = wp.tid()
        f = 6 * seg_frame[seg, 0]
        g = 6 * seg_frame[seg, 1]
        way = vector_at(early_in, pack, lane, g) - vector_at(early_in, pack, lane, f)
        total = wp.dot(vector_at(way_in, pack, lane, 12 * seg + 3), way)
        total += wp.dot(vector_at(way_in, pack, lane, 12 * seg + 6), vector_at(early_in, pack, lane, f + 3))
        total += wp.dot(vector_at(way_in, pack, lane, 12 * seg + 9), vector_at(early_in, pack, lane, g + 3))
        body = seg_body[seg]
        share = (real(1.0) - damping_in[pack, body, lane]) * h / stiffness_in[pack, body, lane]
        row = wp.static(rod_adjoint.PARAMETERS) * seg + 2
        parameter_out[pack, row, lane] = parameter_out[pack, row, lane] - share * total

    @wp.kernel(module=module, enable_backward=False)
    def force_poses(
        # Model
        frame_spin: wp.array(dtype=wp.int32),
        # Workspace in
        pose_in: wp.array3d(dtype=real),
        pose0_in: wp.array3d(dtype=real),
        # Workspace out
        pose_out: wp.array3d(dtype=real),
    ):
        """Pose of one frame at which forces act on it in a stage: that of the start if it is a free top."""
        pack, frame, lane = wp.tid()
        for c in range(7):
            row = 7 * frame + c
            value = pose_in[pack, row, lane]
            if frame_spin[frame] == wp.static(Spin.FREE_TOP):
                value = pose0_in[pack, row, lane]
            pose_out[pack, row, lane] = value

    @wp.kernel(module=module, enable_backward=False)
    def turn_seed(
        h: real,
        # Model
        turning_frame: wp.array(dtype=wp.int32),
        frame_dof: wp.array(dtype=wp.int32),
        # Workspace in
        start_v_in: wp.array3d(dtype=real),
        solved_v_in: wp.array3d(dtype=real),
        # Workspace out
        seed_out: wp.array3d(dtype=real),
        y_out: wp.array3d(dtype=real),
        early_out: wp.array3d(dtype=real),
    ):
        """Seeds by the spin that one frame moves on with become those by its unknowns; what they leave by w0.

        With phi = h w0 and A = T(phi)^-1 = 1 - [phi] / 2 + c [phi]^2 the spin is w0 + A u.
        """
        pack, item, lane = wp.tid()
        frame = turning_frame[item]
        row = 3 * frame_dof[2 * frame + 1]
        w0 = vector_at(start_v_in, pack, lane, row)
        u = vector_at(solved_v_in, pack, lane, row) - w0
        s = vector_at(seed_out, pack, lane, row)
        phi = h * w0
        y = wp.dot(phi, phi)
        c, dc = slopes(y)
        pulled = twisted(-phi, c, s)
        both = wp.dot(s, phi) * wp.dot(u, phi)
        by_phi = c * (s * wp.dot(phi, u) + u * wp.dot(phi, s) - real(2.0) * wp.dot(s, u) * phi)
        by_phi += real(2.0) * dc * (both - y * wp.dot(s, u)) * phi - real(0.5) * wp.cross(u, s)
        put(seed_out, pack, lane, row, pulled)
        put(y_out, pack, lane, row, pulled)
        put(early_out, pack, lane, 3 * frame, s - pulled + h * by_phi)

    @wp.kernel(module=module, enable_backward=False)
    def frame_gradients(
        h: real,
        follows: real,
        lanes: int,
        nodes: int,
        # Model
        frame_master: wp.array(dtype=wp.int32),
        frame_spin: wp.array(dtype=wp.int32),
        frame_owner: wp.array(dtype=wp.int32),
        owner_body: wp.array(dtype=wp.int32),
        frame_dof: wp.array(dtype=wp.int32),
        frame_item_start: wp.array(dtype=wp.int32),
        frame_item: wp.array(dtype=wp.int32),
        carried_slot: wp.array(dtype=wp.int32),
        corner_start: wp.array(dtype=wp.int32),
        corner: wp.array(dtype=wp.int32),
        is_kinematic: wp.array(dtype=real),
        # Workspace in
        predicts_in: wp.array3d(dtype=real),
        damping_in: wp.array3d(dtype=real),
        pose0_in: wp.array3d(dtype=real),
        start_v_in: wp.array3d(dtype=real),
        felt_twist0_in: wp.array3d(dtype=real),
        compound_in: wp.array3d(dtype=real),
        felt_v_in: wp.array3d(dtype=real),
        p_in: wp.array3d(dtype=real),
        frame_p_in: wp.array3d(dtype=real),
        start_in: wp.array3d(dtype=real),
        corner_in: wp.array3d(dtype=real),
        way_in: wp.array3d(dtype=real),
        item_in: wp.array3d(dtype=real),
        felt_in: wp.array3d(dtype=real),
        bare_in: wp.array3d(dtype=real),
        early_in: wp.array3d(dtype=real),
        there_in: wp.array3d(dtype=real),
        sooner_in: wp.array3d(dtype=real),
        # State out
        pose_bar_out: wp.array2d(dtype=real),
        twist_bar_out: wp.array2d(dtype=real),
        force_bar_out: wp.array2d(dtype=real),
        velocity_bar_out: wp.array2d(dtype=real),
        # Workspace out
        memory_out: wp.array3d(dtype=real),
        ahead_out: wp.array3d(dtype=real),
    ):
        """As ``adjoint.frame_gradients``, and in ``memory`` the gradient by e y, of one frame.

        ``predicts`` is 1 in a stage, where segments and items act at the pose that ``start_v_in`` lead to, velocities
        of dofs, else 0, and in worlds where these are 0; forces on a free top act at that of the start. ``follows`` is
        1 if these velocities are those of the start; ``ahead`` receives the gradients by them. ``there_in`` has more by
        place and turn at that pose, ``sooner_in`` by these velocities.
        """
        pack, frame, lane = wp.tid()
        world = pack * lanes + lane
        predicts = predicts_in[pack, 0, lane]
        for c in range(6):
            memory_out[pack, 6 * frame + c, lane] = real(0.0)
        if world < pose_bar_out.shape[0] and frame_master[frame] != frame:
            for c in range(6):
                pose_bar_out[world, 7 * frame + c] = real(0.0)
                twist_bar_out[world, 6 * frame + c] = real(0.0)
                force_bar_out[world, 6 * frame + c] = h * frame_p_in[pack, 6 * frame + c, lane]
                if 6 * frame < velocity_bar_out.shape[1]:
                    velocity_bar_out[world, 6 * frame + c] = real(0.0)
            pose_bar_out[world, 7 * frame + 6] = real(0.0)
        elif world < pose_bar_out.shape[0]:
            k = wp.static(COMPOUND_ROWS) * frame
            t = 3 * frame_dof[2 * frame]
            r = 3 * frame_dof[2 * frame + 1]
            pt = vector_at(p_in, pack, lane, t)
            pr = vector_at(p_in, pack, lane, r)
            V = vector_at(felt_v_in, pack, lane, t)
            w = vector_at(felt_v_in, pack, lane, r)
            V0 = vector_at(felt_twist0_in, pack, lane, 6 * frame)
            w0 = vector_at(felt_twist0_in, pack, lane, 6 * frame + 3)
            q = quat_at(pose0_in, pack, lane, 7 * frame + 3)
            m = compound_in[pack, k, lane]
            s = wp.quat_rotate(q, vector_at(compound_in, pack, lane, k + 1))
            J = turned(q, inertia_at(compound_in, pack, lane, k + 4))
            damped = turned(q, inertia_at(compound_in, pack, lane, k + 14))
            lost = wp.quat_rotate(q, vector_at(compound_in, pack, lane, k + 11))
            place = vector_at(there_in, pack, lane, 6 * frame)  # where the stage is linearised
            turn = vector_at(there_in, pack, lane, 6 * frame + 3)
            place0 = vector_at(start_in, pack, lane, 6 * frame)
            turn0 = vector_at(start_in, pack, lane, 6 * frame + 3)
            linear = vector_at(bare_in, pack, lane, 6 * frame)
            angular = vector_at(bare_in, pack, lane, 6 * frame + 3)
            early_v = vec3()
            early_w = vector_at(early_in, pack, lane, 3 * frame)
            mind_v = vec3()
            mind_w = vec3()
            d = damping_in[pack, owner_body[frame_owner[frame]], lane]
            is_top = frame_spin[frame] == wp.static(Spin.FREE_TOP)
            for i in range(corner_start[2 * frame], corner_start[2 * frame + 1]):
                place += vector_at(corner_in, pack, lane, 3 * corner[i])
                sign = real(corner[i] % 4 - 1)  # the way of a segment is from corner 0 to corner 2
                by_v = -sign * vector_at(way_in, pack, lane, 12 * (corner[i] / 4) + 3)
                early_v += (d - real(1.0)) * by_v
                mind_v += d * by_v
            for i in range(corner_start[2 * frame + 1], corner_start[2 * frame + 2]):
                turn += vector_at(corner_in, pack, lane, 3 * corner[i])
                by_w = -vector_at(way_in, pack, lane, 12 * (corner[i] / 4) + 6 + 3 * (corner[i] % 4 / 2))
                early_w += (d - real(1.0)) * by_w
                mind_w += d * by_w
            for i in range(frame_item_start[frame], frame_item_start[frame + 1]):
                item = frame_item[i]
                row = wp.static(FELT_ROWS) * item
                if is_top and carried_slot[item] >= nodes:
                    place0 += vector_at(item_in, pack, lane, 12 * item)
                    turn0 += vector_at(item_in, pack, lane, 12 * item + 3)
                else:
                    place += vector_at(item_in, pack, lane, 12 * item)
                    turn += vector_at(item_in, pack, lane, 12 * item + 3)
                linear += vector_at(item_in, pack, lane, 12 * item + 6)
                angular += vector_at(item_in, pack, lane, 12 * item + 9)
                early_v += vector_at(felt_in, pack, lane, row)
                early_w += vector_at(felt_in, pack, lane, row + 3)
                mind_v += vector_at(felt_in, pack, lane, row + 6)
                mind_w += vector_at(felt_in, pack, lane, row + 9)
            phi = predicts * h * vector_at(start_v_in, pack, lane, r)
            early_v += vector_at(sooner_in, pack, lane, t)
            early_w += vector_at(sooner_in, pack, lane, r)
            ahead_v = predicts * (h * place + early_v)
            ahead_w = predicts * (h * jacobian_transposed(phi, turn) + early_w)
            put(ahead_out, pack, lane, t, ahead_v)
            put(ahead_out, pack, lane, r, ahead_w)
            if 6 * frame < velocity_bar_out.shape[1]:
                linear += (real(1.0) - follows) * ahead_v
                angular += (real(1.0) - follows) * ahead_w
                for c in range(3):
                    velocity_bar_out[world, 6 * frame + c] = is_kinematic[frame] * linear[c]
                    velocity_bar_out[world, 6 * frame + 3 + c] = is_kinematic[frame] * angular[c]
            turn0 += wp.quat_rotate_inv(exponential(phi), turn)
            turn0 += by_turn(s, J, pt, pr, V0, w0) - by_turn(lost, damped, pt, pr, V, w)
            by_q = quat(turn0[0], turn0[1], turn0[2], real(0.0)) * q * real(2.0)
            linear, angular = momentum(m, s, J, pt, pr)
            by_v = linear + follows * ahead_v
            by_w = angular + follows * ahead_w
            ratio = real(1.0)
            if m > real(0.0):
                ratio = compound_in[pack, k + 10, lane] / m
            lost_v, lost_w = momentum(compound_in[pack, k + 10, lane], lost, damped, pt, pr)
            put(memory_out, pack, lane, 6 * frame, mind_v + ratio * linear - lost_v)
            put(memory_out, pack, lane, 6 * frame + 3, mind_w + ratio * angular - lost_w)
            place0 += place
            for c in range(3):
                pose_bar_out[world, 7 * frame + c] = place0[c]
                twist_bar_out[world, 6 * frame + c] = by_v[c]
                twist_bar_out[world, 6 * frame + 3 + c] = by_w[c]
                force_bar_out[world, 6 * frame + c] = h * pt[c]
                force_bar_out[world, 6 * frame + 3 + c] = h * pr[c]
            for c in range(4):
                pose_bar_out[world, 7 * frame + 3 + c] = by_q[c]

    return SimpleNamespace(
        velocities=velocities,
        lean_more=lean_more,
        carried_velocities=carried_velocities,
        twists=twists,
        carried_gradients=carried_gradients,
        welded_felt=welded_felt,
        rod_damping=rod_damping,
        force_poses=force_poses,
        turn_seed=turn_seed,
        frame_gradients=frame_gradients,
    )
