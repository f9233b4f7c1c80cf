"""Inertia and forces of frames in the linear system. Theory: docs/theory/frames.md.

A master and all that it carries (nodes, welded frames) are one rigid *compound* of mass m, first moment s and inertia J
about the master's origin. In the axes at the start of the step, with m_s = 1 + h alpha for every part,

    A_tt = sum m_s m 1,  A_rt = sum m_s [s],  A_rr = sum m_s J
    b_t = sum h f + m V0 + w0 x s,  b_r = sum h (tau + r x f) + J w0 + s x V0

where forces act at the trial pose. So a step changes momentum by what forces do; how a compound moves on with its
momentum is told in kernels/frames/momentum.py.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.algebra.rotation import rotations
from softwarp.kernels.algebra.vectors import algebra
from softwarp.model.codes import Spin

COMPOUND_ROWS = 20  # of a master: m, s, J as xx yy zz xy xz yz in its axes, then the same times 1 + h alpha


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Mass, momentum and forces of frames in the linear system."""
    S = variant.S
    real = variant.real
    mul, sqrt = variant.mul, variant.sqrt
    world_fastest = variant.world_fastest
    module = variant.module("frame_inertia")
    a, turns = algebra(variant), rotations(variant)
    Vector, Symmetric, vector, constant = a.Vector, a.Symmetric, a.vector, a.constant
    read_vector, write_vector, add_vector = a.read_vector, a.write_vector, a.add_vector
    add, subtract, scaled, cross = a.add, a.subtract, a.scaled, a.cross
    Quaternion, read_quaternion = turns.Quaternion, turns.read_quaternion
    turn, turned_inertia = turns.turn, turns.turned_inertia

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
        internal_out: wp.array2d(dtype=S),
        external_out: wp.array2d(dtype=S),
    ):
        """Internal force and moment, and external ones (gravity, command), of one frame."""
        w, frame = wp.tid()
        if wp.static(world_fastest):
            frame, w = wp.tid()
        mass = owner_density_in[w, frame_owner[frame]] * frame_volume[frame]
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
    def segment_damping(
        # Model
        node_count: int,
        seg_frame: wp.array2d(dtype=wp.int32),
        seg_rod: wp.array(dtype=wp.int32),
        # Workspace in
        rod_rayleigh_stiffness_in: wp.array2d(dtype=S),
        seg_stiffness_in: wp.array2d(dtype=S),
        slot_v_in: wp.array2d(dtype=S),
        # Workspace out
        seg_damping_out: wp.array2d(dtype=S),
    ):
        """beta K v of one segment, from the ten lower blocks of K."""
        w, seg = wp.tid()
        if wp.static(world_fastest):
            seg, w = wp.tid()
        beta = rod_rayleigh_stiffness_in[w, seg_rod[seg]]
        for a in range(4):
            for r in range(3):
                total = S(real(0.0))
                for b in range(4):
                    # block (a, b) for a >= b, else the transpose of block (b, a)
                    k = 90 * seg + 9 * ((a * (a + 1)) // 2 + b) + 3 * r
                    across = 1
                    if a < b:
                        k = 90 * seg + 9 * ((b * (b + 1)) // 2 + a) + r
                        across = 3
                    v = 3 * (node_count + 2 * seg_frame[seg, b // 2] + b % 2)
                    for c in range(3):
                        total += mul(seg_stiffness_in[w, k + across * c], slot_v_in[w, v + c])
                seg_damping_out[w, 12 * seg + 3 * a + r] = mul(beta, total)

    @wp.kernel(module=module, enable_backward=False)
    def add_corner_forces(
        # Model
        corner_start: wp.array(dtype=wp.int32),
        corner: wp.array(dtype=wp.int32),
        # Workspace in
        corner_force_in: wp.array2d(dtype=S),
        # Workspace out
        internal_out: wp.array2d(dtype=S),
    ):
        """Add what all segments have at one half (translation or rotation) of a frame."""
        w, slot = wp.tid()
        if wp.static(world_fastest):
            slot, w = wp.tid()
        for p in range(corner_start[slot], corner_start[slot + 1]):
            for c in range(3):
                internal_out[w, 3 * slot + c] += corner_force_in[w, 3 * corner[p] + c]

    @wp.kernel(module=module, enable_backward=False)
    def compound(
        # Model
        source_start: wp.array(dtype=wp.int32),
        source: wp.array2d(dtype=wp.int32),
        source_lever: wp.array2d(dtype=real),
        source_inertia: wp.array2d(dtype=real),
        frame_owner: wp.array(dtype=wp.int32),
        frame_volume: wp.array(dtype=real),
        owner_body: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        node_volume: wp.array(dtype=real),
        # Workspace in
        density_in: wp.array2d(dtype=S),
        owner_density_in: wp.array2d(dtype=S),
        body_mass_scale_in: wp.array2d(dtype=S),
        # Workspace out
        compound_out: wp.array2d(dtype=S),
    ):
        """Mass, first moment and inertia of one master with all that it carries; zero for a frame that is no master."""
        w, frame = wp.tid()
        if wp.static(world_fastest):
            frame, w = wp.tid()
        row = wp.static(COMPOUND_ROWS) * frame
        for c in range(wp.static(COMPOUND_ROWS)):
            compound_out[w, row + c] = S(real(0.0))
        for p in range(source_start[frame], source_start[frame + 1]):
            index = source[p, 1]
            density = S(real(0.0))
            scale = S(real(0.0))
            volume = real(0.0)
            if source[p, 0] == 0:
                density = density_in[w, node_body[index]]
                scale = body_mass_scale_in[w, node_body[index]]
                volume = node_volume[index]
            else:
                density = owner_density_in[w, frame_owner[index]]
                scale = body_mass_scale_in[w, owner_body[frame_owner[index]]]
                volume = frame_volume[index]
            x = source_lever[p, 0]
            y = source_lever[p, 1]
            z = source_lever[p, 2]
            for half in range(2):
                k = row + 10 * half
                compound_out[w, k] += density * volume
                compound_out[w, k + 1] += density * (volume * x)
                compound_out[w, k + 2] += density * (volume * y)
                compound_out[w, k + 3] += density * (volume * z)
                compound_out[w, k + 4] += density * (source_inertia[p, 0] + volume * (y * y + z * z))
                compound_out[w, k + 5] += density * (source_inertia[p, 1] + volume * (x * x + z * z))
                compound_out[w, k + 6] += density * (source_inertia[p, 2] + volume * (x * x + y * y))
                compound_out[w, k + 7] += density * (source_inertia[p, 3] - volume * x * y)
                compound_out[w, k + 8] += density * (source_inertia[p, 4] - volume * x * z)
                compound_out[w, k + 9] += density * (source_inertia[p, 5] - volume * y * z)
                density = mul(density, scale)

    @wp.func
    def spin_of(compound: wp.array2d(dtype=S), w: int, k: int, q: Quaternion, v: Vector):
        """J v in world axes."""
        J = Symmetric()
        J.xx = compound[w, k + 4]
        J.yy = compound[w, k + 5]
        J.zz = compound[w, k + 6]
        J.xy = compound[w, k + 7]
        J.xz = compound[w, k + 8]
        J.yz = compound[w, k + 9]
        return turned_inertia(q, J, v)

    @wp.func
    def momentum(compound: wp.array2d(dtype=S), w: int, k: int, q: Quaternion, v: Vector, spin: Vector):
        """m V + w x s, and s x V + J w about the master's origin."""
        s = turn(q, read_vector(compound, w, k + 1))
        linear = add(cross(spin, s), scaled(v, compound[w, k]))
        return linear, add(spin_of(compound, w, k, q, spin), cross(s, v))

    @wp.kernel(module=module, enable_backward=False)
    def frame_mass(
        # Model
        frame_block: wp.array2d(dtype=wp.int32),
        frame_master: wp.array(dtype=wp.int32),
        # Workspace in
        compound_in: wp.array2d(dtype=S),
        pose0_in: wp.array2d(dtype=S),
        # Workspace out
        a_out: wp.array2d(dtype=S),
    ):
        """Add the damped inertia of one master's compound to its three blocks of A."""
        w, frame = wp.tid()
        if wp.static(world_fastest):
            frame, w = wp.tid()
        if frame_master[frame] == frame:
            k = wp.static(COMPOUND_ROWS) * frame + 10
            q = read_quaternion(pose0_in, w, 7 * frame + 3)
            tt = 9 * frame_block[frame, 0]
            rr = 9 * frame_block[frame, 1]
            tr = 9 * frame_block[frame, 2]
            mass = compound_in[w, k]
            a_out[w, tt] += mass
            a_out[w, tt + 4] += mass
            a_out[w, tt + 8] += mass
            s = turn(q, read_vector(compound_in, w, k + 1))
            sign = real(1.0)
            if frame_block[frame, 3] != 0:
                sign = real(-1.0)  # the stored block is (t, r), the transpose
            a_out[w, tr + 1] += s.z * (-sign)
            a_out[w, tr + 2] += s.y * sign
            a_out[w, tr + 3] += s.z * sign
            a_out[w, tr + 5] += s.x * (-sign)
            a_out[w, tr + 6] += s.y * (-sign)
            a_out[w, tr + 7] += s.x * sign
            for c in range(3):
                e = vector(S(real(c == 0)), S(real(c == 1)), S(real(c == 2)))
                column = spin_of(compound_in, w, k, q, e)
                a_out[w, rr + c] += column.x
                a_out[w, rr + 3 + c] += column.y
                a_out[w, rr + 6 + c] += column.z

    @wp.func
    def add_source_force(
        b: wp.array2d(dtype=S),
        source: wp.array2d(dtype=wp.int32),
        node_internal: wp.array2d(dtype=S),
        node_external: wp.array2d(dtype=S),
        internal: wp.array2d(dtype=S),
        external: wp.array2d(dtype=S),
        w: int,
        p: int,
        t: int,
        r: int,
        lever: Vector,
        f_scale: real,
    ):
        """Impulse of the force on one source at a lever, and its moment, to rows t and r of b."""
        row = 3 * source[p, 1]
        scale = S(f_scale)
        none = S(real(0.0))
        f = vector(none, none, none)
        if source[p, 0] == 0:
            f = scaled(subtract(read_vector(node_external, w, row), read_vector(node_internal, w, row)), scale)
        else:
            row *= 2
            f = scaled(subtract(read_vector(external, w, row), read_vector(internal, w, row)), scale)
            moment = subtract(read_vector(external, w, row + 3), read_vector(internal, w, row + 3))
            add_vector(b, w, r, scaled(moment, scale))
        add_vector(b, w, t, f)
        add_vector(b, w, r, cross(lever, f))

    @wp.kernel(module=module, enable_backward=False)
    def frame_right_hand_side(
        # Model
        frame_dof: wp.array(dtype=wp.int32),
        frame_spin: wp.array(dtype=wp.int32),
        source_start: wp.array(dtype=wp.int32),
        source: wp.array2d(dtype=wp.int32),
        source_lever: wp.array2d(dtype=real),
        # Workspace in
        compound_in: wp.array2d(dtype=S),
        node_internal_in: wp.array2d(dtype=S),
        node_external_in: wp.array2d(dtype=S),
        internal_in: wp.array2d(dtype=S),
        external_in: wp.array2d(dtype=S),
        lever_in: wp.array2d(dtype=S),
        pose0_in: wp.array2d(dtype=S),
        twist0_in: wp.array2d(dtype=S),
        dof_v_in: wp.array2d(dtype=S),
        f_scale: real,
        inertia: real,
        moving: bool,
        # Workspace out
        momentum_out: wp.array2d(dtype=S),
        b_out: wp.array2d(dtype=S),
    ):
        """b of one master: impulse of all forces, plus momentum at the start, minus that of the present velocities.

        Nothing at a free top changes with its pose; its forces have the levers of the start, as its momentum does.
        """
        w, frame = wp.tid()
        if wp.static(world_fastest):
            frame, w = wp.tid()
        begin = source_start[frame]
        end = source_start[frame + 1]
        if begin < end:
            t = 3 * frame_dof[2 * frame]
            r = 3 * frame_dof[2 * frame + 1]
            k = wp.static(COMPOUND_ROWS) * frame
            v = 6 * frame
            q = read_quaternion(pose0_in, w, 7 * frame + 3)
            P, L = momentum(compound_in, w, k, q, read_vector(twist0_in, w, v), read_vector(twist0_in, w, v + 3))
            share = S(inertia)
            write_vector(momentum_out, w, v, scaled(P, share))
            write_vector(momentum_out, w, v + 3, scaled(L, share))
            if moving:
                dP, dL = momentum(compound_in, w, k + 10, q, read_vector(dof_v_in, w, t), read_vector(dof_v_in, w, r))
                P = subtract(P, dP)
                L = subtract(L, dL)
            write_vector(b_out, w, t, scaled(P, share))
            write_vector(b_out, w, r, scaled(L, share))
            for p in range(begin, end):
                item = source[p, 2]
                none = S(real(0.0))
                lever = vector(none, none, none)
                if item >= 0:
                    lever = read_vector(lever_in, w, 3 * item)
                    if frame_spin[frame] == wp.static(Spin.FREE_TOP):
                        lever = turn(q, constant(source_lever, p, 0))
                add_source_force(
                    b_out,
                    source,
                    node_internal_in,
                    node_external_in,
                    internal_in,
                    external_in,
                    w,
                    p,
                    t,
                    r,
                    lever,
                    f_scale,
                )

    @wp.kernel(module=module, enable_backward=False)
    def frame_norms(
        # Model
        frame_count: int,
        segment_count: int,
        # Workspace in
        external_in: wp.array2d(dtype=S),
        momentum_in: wp.array2d(dtype=S),
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
            total += mul(f, f) + mul(momentum_in[w, row], momentum_in[w, row])
        for row in range(12 * segment_count):
            f = segment_force_in[w, row] * f_scale
            total += mul(f, f)
        norm_out[w, 1] = sqrt(total)

    return SimpleNamespace(
        compound=compound,
        frame_forces=frame_forces,
        segment_damping=segment_damping,
        add_corner_forces=add_corner_forces,
        frame_mass=frame_mass,
        frame_right_hand_side=frame_right_hand_side,
        frame_norms=frame_norms,
    )
