"""Frames: rigid bodies and rod nodes as two 3-blocks, translation and rotation. Theory: docs/theory/frames.md.

A frame has a pose (position X, quaternion q) and a twist (velocity V of its origin, angular velocity w), both in world
axes; a step turns it by exp(h w). Its unknowns belong to its *master*: itself, or the frame that it is welded to. What a
master carries (nodes, welded frames) moves with V + w x r and gives its mass m and momentum m v at the lever r:

    A_tt = sum m_s m 1,  A_rt = sum m_s m [r],  A_rr = sum m_s (R I R' - m [r][r]),   m_s = 1 + h alpha
    b_t = sum h f + m v0,  b_r = sum h tau + R0 I R0' w0 + r x (h f + m v0)

The inertia is that of the start of the step, so that the angular momentum R I R' w is what external moments change.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels import rotation
from softwarp.kernels.lanes import Variant


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Motion of frames and of what they carry."""
    S = variant.S
    real = variant.real
    mul = variant.mul
    world_fastest = variant.world_fastest
    module = variant.module("frames")
    rot = rotation.functions(variant)
    turn, product, exponential, normalized = rot.turn, rot.product, rot.exponential, rot.normalized
    cross = rot.cross

    @wp.kernel(module=module, enable_backward=False)
    def trial_pose(
        # Model
        frame_master: wp.array(dtype=wp.int32),
        frame_dof: wp.array(dtype=wp.int32),
        frame_offset: wp.array2d(dtype=real),
        # Workspace in
        pose0_in: wp.array2d(dtype=S),
        dof_v_in: wp.array2d(dtype=S),
        x_scale: real,
        # Workspace out
        pose_out: wp.array2d(dtype=S),
    ):
        """Pose of one frame: its master's moved by x_scale (V, w), then its offset."""
        w, frame = wp.tid()
        if wp.static(world_fastest):
            frame, w = wp.tid()
        master = frame_master[frame]
        m = 7 * master
        t = 3 * frame_dof[2 * frame]
        r = 3 * frame_dof[2 * frame + 1]
        x0 = pose0_in[w, m] + dof_v_in[w, t] * x_scale
        x1 = pose0_in[w, m + 1] + dof_v_in[w, t + 1] * x_scale
        x2 = pose0_in[w, m + 2] + dof_v_in[w, t + 2] * x_scale
        e0, e1, e2, e3 = exponential(
            dof_v_in[w, r] * x_scale, dof_v_in[w, r + 1] * x_scale, dof_v_in[w, r + 2] * x_scale
        )
        q0, q1, q2, q3 = product(
            e0, e1, e2, e3, pose0_in[w, m + 3], pose0_in[w, m + 4], pose0_in[w, m + 5], pose0_in[w, m + 6]
        )
        q0, q1, q2, q3 = normalized(q0, q1, q2, q3)
        if master != frame:
            d0, d1, d2 = turn(
                q0, q1, q2, q3, S(frame_offset[frame, 0]), S(frame_offset[frame, 1]), S(frame_offset[frame, 2])
            )
            x0 += d0
            x1 += d1
            x2 += d2
            q0, q1, q2, q3 = product(
                q0,
                q1,
                q2,
                q3,
                S(frame_offset[frame, 3]),
                S(frame_offset[frame, 4]),
                S(frame_offset[frame, 5]),
                S(frame_offset[frame, 6]),
            )
        row = 7 * frame
        pose_out[w, row] = x0
        pose_out[w, row + 1] = x1
        pose_out[w, row + 2] = x2
        pose_out[w, row + 3] = q0
        pose_out[w, row + 4] = q1
        pose_out[w, row + 5] = q2
        pose_out[w, row + 6] = q3

    @wp.kernel(module=module, enable_backward=False)
    def carry(
        # Model
        node_count: int,
        carried_slot: wp.array(dtype=wp.int32),
        carried_frame: wp.array(dtype=wp.int32),
        carried_offset: wp.array2d(dtype=real),
        # Workspace in
        pose_in: wp.array2d(dtype=S),
        # Workspace out
        lever_out: wp.array2d(dtype=S),
        node_x_out: wp.array2d(dtype=S),
    ):
        """Lever [m] of one carried slot in world axes; a carried node's position."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        m = 7 * carried_frame[item]
        d0, d1, d2 = turn(
            pose_in[w, m + 3],
            pose_in[w, m + 4],
            pose_in[w, m + 5],
            pose_in[w, m + 6],
            S(carried_offset[item, 0]),
            S(carried_offset[item, 1]),
            S(carried_offset[item, 2]),
        )
        lever_out[w, 3 * item] = d0
        lever_out[w, 3 * item + 1] = d1
        lever_out[w, 3 * item + 2] = d2
        slot = carried_slot[item]
        if slot < node_count:
            node_x_out[w, 3 * slot] = pose_in[w, m] + d0
            node_x_out[w, 3 * slot + 1] = pose_in[w, m + 1] + d1
            node_x_out[w, 3 * slot + 2] = pose_in[w, m + 2] + d2

    @wp.kernel(module=module, enable_backward=False)
    def slot_velocity(
        # Model
        slot_dof: wp.array(dtype=wp.int32),
        slot_carried: wp.array(dtype=wp.int32),
        carried_dof: wp.array(dtype=wp.int32),
        # Workspace in
        dof_v_in: wp.array2d(dtype=S),
        lever_in: wp.array2d(dtype=S),
        # Workspace out
        slot_v_out: wp.array2d(dtype=S),
    ):
        """Velocity of one slot: its dof's, V + w x r if a frame carries it, 0 if it is fixed."""
        w, slot = wp.tid()
        if wp.static(world_fastest):
            slot, w = wp.tid()
        row = 3 * slot
        v0 = S(real(0.0))
        v1 = S(real(0.0))
        v2 = S(real(0.0))
        item = slot_carried[slot]
        if item >= 0:
            t = 3 * carried_dof[2 * item]
            r = 3 * carried_dof[2 * item + 1]
            c0, c1, c2 = cross(
                dof_v_in[w, r],
                dof_v_in[w, r + 1],
                dof_v_in[w, r + 2],
                lever_in[w, 3 * item],
                lever_in[w, 3 * item + 1],
                lever_in[w, 3 * item + 2],
            )
            v0 = dof_v_in[w, t] + c0
            v1 = dof_v_in[w, t + 1] + c1
            v2 = dof_v_in[w, t + 2] + c2
        else:
            dof = slot_dof[slot]
            if dof >= 0:
                v0 = dof_v_in[w, 3 * dof]
                v1 = dof_v_in[w, 3 * dof + 1]
                v2 = dof_v_in[w, 3 * dof + 2]
        slot_v_out[w, row] = v0
        slot_v_out[w, row + 1] = v1
        slot_v_out[w, row + 2] = v2

    return SimpleNamespace(trial_pose=trial_pose, carry=carry, slot_velocity=slot_velocity)


@cache
def inertia_kernels(variant: Variant) -> SimpleNamespace:
    """Mass, momentum and forces of frames in the linear system."""
    S = variant.S
    real = variant.real
    mul, sqrt = variant.mul, variant.sqrt
    world_fastest = variant.world_fastest
    module = variant.module("frames.inertia")
    rot = rotation.functions(variant)
    cross, turned_inertia = rot.cross, rot.turned_inertia

    @wp.kernel(module=module, enable_backward=False)
    def frame_forces(
        # Model
        frame_owner: wp.array(dtype=wp.int32),
        frame_volume: wp.array(dtype=real),
        corner_start: wp.array(dtype=wp.int32),
        corner: wp.array(dtype=wp.int32),
        # Workspace in
        owner_density_in: wp.array2d(dtype=S),
        gravity_in: wp.array2d(dtype=S),
        wrench_in: wp.array2d(dtype=S),
        element_force_in: wp.array2d(dtype=S),
        # Workspace out
        frame_mass_out: wp.array2d(dtype=S),
        internal_out: wp.array2d(dtype=S),
        external_out: wp.array2d(dtype=S),
    ):
        """Mass [kg], internal force and moment, and external ones (gravity, command) of one frame."""
        w, frame = wp.tid()
        if wp.static(world_fastest):
            frame, w = wp.tid()
        mass = owner_density_in[w, frame_owner[frame]] * frame_volume[frame]
        frame_mass_out[w, frame] = mass
        for half in range(2):
            slot = 2 * frame + half
            for c in range(3):
                total = S(real(0.0))
                for p in range(corner_start[slot], corner_start[slot + 1]):
                    total += element_force_in[w, 3 * corner[p] + c]
                row = 6 * frame + 3 * half + c
                internal_out[w, row] = total
                external = wrench_in[w, row]
                if half == 0:
                    external += mul(mass, gravity_in[w, c])
                external_out[w, row] = external

    @wp.kernel(module=module, enable_backward=False)
    def frame_mass(
        # Model
        frame_block: wp.array2d(dtype=wp.int32),
        frame_source_start: wp.array(dtype=wp.int32),
        frame_source: wp.array2d(dtype=wp.int32),
        frame_owner: wp.array(dtype=wp.int32),
        owner_body: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        frame_inertia: wp.array2d(dtype=real),
        # Workspace in
        body_mass_scale_in: wp.array2d(dtype=S),
        owner_density_in: wp.array2d(dtype=S),
        node_mass_in: wp.array2d(dtype=S),
        frame_mass_in: wp.array2d(dtype=S),
        pose0_in: wp.array2d(dtype=S),
        lever_in: wp.array2d(dtype=S),
        # Workspace out
        a_out: wp.array2d(dtype=S),
    ):
        """Add the inertia of one master and of all that it carries to its three blocks of A.

        A source is (kind, index, carried): kind 0 a node, 1 a frame; carried -1 for the master itself.
        """
        w, frame = wp.tid()
        if wp.static(world_fastest):
            frame, w = wp.tid()
        zero = S(real(0.0))
        one = S(real(1.0))
        tt = 9 * frame_block[frame, 0]
        rr = 9 * frame_block[frame, 1]
        tr = 9 * frame_block[frame, 2]
        for p in range(frame_source_start[frame], frame_source_start[frame + 1]):
            index = frame_source[p, 1]
            item = frame_source[p, 2]
            mass = zero
            if frame_source[p, 0] == 0:
                mass = mul(node_mass_in[w, index], body_mass_scale_in[w, node_body[index]])
            else:
                owner = frame_owner[index]
                scale = body_mass_scale_in[w, owner_body[owner]]
                mass = mul(frame_mass_in[w, index], scale)
                density = mul(owner_density_in[w, owner], scale)
                q = 7 * index + 3
                for c in range(3):
                    e0 = zero
                    e1 = zero
                    e2 = zero
                    if c == 0:
                        e0 = one
                    if c == 1:
                        e1 = one
                    if c == 2:
                        e2 = one
                    j0, j1, j2 = turned_inertia(
                        pose0_in[w, q],
                        pose0_in[w, q + 1],
                        pose0_in[w, q + 2],
                        pose0_in[w, q + 3],
                        density * frame_inertia[index, 0],
                        density * frame_inertia[index, 1],
                        density * frame_inertia[index, 2],
                        density * frame_inertia[index, 3],
                        density * frame_inertia[index, 4],
                        density * frame_inertia[index, 5],
                        e0,
                        e1,
                        e2,
                    )
                    a_out[w, rr + c] += j0
                    a_out[w, rr + 3 + c] += j1
                    a_out[w, rr + 6 + c] += j2
            a_out[w, tt] += mass
            a_out[w, tt + 4] += mass
            a_out[w, tt + 8] += mass
            if item >= 0:
                r0 = lever_in[w, 3 * item]
                r1 = lever_in[w, 3 * item + 1]
                r2 = lever_in[w, 3 * item + 2]
                sign = real(1.0)
                if frame_block[frame, 3] != 0:
                    sign = real(-1.0)  # the stored block is (t, r), the transpose
                m0 = mul(mass, r0)
                m1 = mul(mass, r1)
                m2 = mul(mass, r2)
                a_out[w, tr + 1] += m2 * (-sign)
                a_out[w, tr + 2] += m1 * sign
                a_out[w, tr + 3] += m2 * sign
                a_out[w, tr + 5] += m0 * (-sign)
                a_out[w, tr + 6] += m1 * (-sign)
                a_out[w, tr + 7] += m0 * sign
                a_out[w, rr] += mul(m1, r1) + mul(m2, r2)
                a_out[w, rr + 4] += mul(m0, r0) + mul(m2, r2)
                a_out[w, rr + 8] += mul(m0, r0) + mul(m1, r1)
                a_out[w, rr + 1] += -mul(m0, r1)
                a_out[w, rr + 3] += -mul(m0, r1)
                a_out[w, rr + 2] += -mul(m0, r2)
                a_out[w, rr + 6] += -mul(m0, r2)
                a_out[w, rr + 5] += -mul(m1, r2)
                a_out[w, rr + 7] += -mul(m1, r2)

    @wp.kernel(module=module, enable_backward=False)
    def source_force(
        # Model
        node_count: int,
        frame_owner: wp.array(dtype=wp.int32),
        owner_body: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        source: wp.array2d(dtype=wp.int32),
        frame_inertia: wp.array2d(dtype=real),
        # Workspace in
        body_mass_scale_in: wp.array2d(dtype=S),
        owner_density_in: wp.array2d(dtype=S),
        node_mass_in: wp.array2d(dtype=S),
        node_internal_in: wp.array2d(dtype=S),
        node_external_in: wp.array2d(dtype=S),
        node_v0_in: wp.array2d(dtype=S),
        frame_mass_in: wp.array2d(dtype=S),
        internal_in: wp.array2d(dtype=S),
        external_in: wp.array2d(dtype=S),
        twist0_in: wp.array2d(dtype=S),
        pose0_in: wp.array2d(dtype=S),
        slot_v_in: wp.array2d(dtype=S),
        f_scale: real,
        inertia: real,
        moving: bool,
        # Workspace out
        source_b_out: wp.array2d(dtype=S),
        source_momentum_out: wp.array2d(dtype=S),
    ):
        """Force impulse plus momentum (3), then moment impulse plus spin (3), of one source about its own origin."""
        w, p = wp.tid()
        if wp.static(world_fastest):
            p, w = wp.tid()
        index = source[p, 1]
        row = 6 * p
        if source[p, 0] == 0:
            mass = node_mass_in[w, index] * inertia
            scale = body_mass_scale_in[w, node_body[index]]
            for c in range(3):
                k = 3 * index + c
                momentum = mul(mass, node_v0_in[w, k])
                source_momentum_out[w, row + c] = momentum
                source_momentum_out[w, row + 3 + c] = S(real(0.0))
                value = (node_external_in[w, k] - node_internal_in[w, k]) * f_scale + momentum
                if moving:
                    value -= mul(mul(mass, scale), slot_v_in[w, k])
                source_b_out[w, row + c] = value
                source_b_out[w, row + 3 + c] = S(real(0.0))
        else:
            owner = frame_owner[index]
            scale = body_mass_scale_in[w, owner_body[owner]]
            mass = frame_mass_in[w, index] * inertia
            density = owner_density_in[w, owner] * inertia
            slot = 3 * (node_count + 2 * index)
            t = 6 * index
            spin0 = S(real(0.0))
            spin1 = S(real(0.0))
            spin2 = S(real(0.0))
            for half in range(2):
                for c in range(3):
                    k = t + 3 * half + c
                    source_b_out[w, row + 3 * half + c] = (external_in[w, k] - internal_in[w, k]) * f_scale
            for c in range(3):
                momentum = mul(mass, twist0_in[w, t + c])
                source_momentum_out[w, row + c] = momentum
                source_b_out[w, row + c] += momentum
                if moving:
                    source_b_out[w, row + c] -= mul(mul(mass, scale), slot_v_in[w, slot + c])
            for turn in range(2):
                if turn == 0 or moving:
                    w0 = twist0_in[w, t + 3]
                    w1 = twist0_in[w, t + 4]
                    w2 = twist0_in[w, t + 5]
                    factor = density
                    if turn == 1:
                        w0 = slot_v_in[w, slot + 3]
                        w1 = slot_v_in[w, slot + 4]
                        w2 = slot_v_in[w, slot + 5]
                        factor = -mul(density, scale)
                    spin0, spin1, spin2 = turned_inertia(
                        pose0_in[w, 7 * index + 3],
                        pose0_in[w, 7 * index + 4],
                        pose0_in[w, 7 * index + 5],
                        pose0_in[w, 7 * index + 6],
                        factor * frame_inertia[index, 0],
                        factor * frame_inertia[index, 1],
                        factor * frame_inertia[index, 2],
                        factor * frame_inertia[index, 3],
                        factor * frame_inertia[index, 4],
                        factor * frame_inertia[index, 5],
                        w0,
                        w1,
                        w2,
                    )
                    source_b_out[w, row + 3] += spin0
                    source_b_out[w, row + 4] += spin1
                    source_b_out[w, row + 5] += spin2
                    if turn == 0:
                        source_momentum_out[w, row + 3] = spin0
                        source_momentum_out[w, row + 4] = spin1
                        source_momentum_out[w, row + 5] = spin2

    @wp.kernel(module=module, enable_backward=False)
    def gather_sources(
        # Model
        frame_dof: wp.array(dtype=wp.int32),
        frame_source_start: wp.array(dtype=wp.int32),
        frame_source: wp.array2d(dtype=wp.int32),
        # Workspace in
        source_in: wp.array2d(dtype=S),
        lever_in: wp.array2d(dtype=S),
        # Workspace out
        dof_out: wp.array2d(dtype=S),
    ):
        """Force and moment of all sources about one master's origin, at its two dofs."""
        w, frame = wp.tid()
        if wp.static(world_fastest):
            frame, w = wp.tid()
        begin = frame_source_start[frame]
        end = frame_source_start[frame + 1]
        if begin < end:
            t = 3 * frame_dof[2 * frame]
            r = 3 * frame_dof[2 * frame + 1]
            for c in range(3):
                dof_out[w, t + c] = S(real(0.0))
                dof_out[w, r + c] = S(real(0.0))
            for p in range(begin, end):
                row = 6 * p
                for c in range(3):
                    dof_out[w, t + c] += source_in[w, row + c]
                    dof_out[w, r + c] += source_in[w, row + 3 + c]
                item = frame_source[p, 2]
                if item >= 0:
                    c0, c1, c2 = cross(
                        lever_in[w, 3 * item],
                        lever_in[w, 3 * item + 1],
                        lever_in[w, 3 * item + 2],
                        source_in[w, row],
                        source_in[w, row + 1],
                        source_in[w, row + 2],
                    )
                    dof_out[w, r] += c0
                    dof_out[w, r + 1] += c1
                    dof_out[w, r + 2] += c2

    @wp.kernel(module=module, enable_backward=False)
    def frame_norms(
        # Model
        frame_count: int,
        source_count: int,
        segment_count: int,
        # Workspace in
        external_in: wp.array2d(dtype=S),
        source_momentum_in: wp.array2d(dtype=S),
        segment_force_in: wp.array2d(dtype=S),
        f_scale: real,
        # Workspace out
        norm_out: wp.array2d(dtype=S),
    ):
        """Add forces, moments and momenta of frames to the size of the forces that should balance (row 1)."""
        w = wp.tid()
        total = mul(norm_out[w, 1], norm_out[w, 1])
        for row in range(6 * frame_count):
            f = external_in[w, row] * f_scale
            total += mul(f, f)
        for row in range(6 * source_count):
            total += mul(source_momentum_in[w, row], source_momentum_in[w, row])
        for row in range(12 * segment_count):
            f = segment_force_in[w, row] * f_scale
            total += mul(f, f)
        norm_out[w, 1] = sqrt(total)

    return SimpleNamespace(
        frame_forces=frame_forces,
        frame_mass=frame_mass,
        source_force=source_force,
        gather_sources=gather_sources,
        frame_norms=frame_norms,
    )
