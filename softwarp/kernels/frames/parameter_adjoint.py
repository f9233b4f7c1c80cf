"""Gradients of frames by what they are made of: masses, densities, damping, and stiffness of rods.

Theory: docs/theory/adjoint.md.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.elements.rod_adjoint import PARAMETERS

SHARE_ROWS = 10  # of a frame: by mass, first moment and inertia of its compound, in its own axes (xx yy zz xy xz yz)
MOVED_ROWS = 19  # of a frame: c of its momentum, then of that at the start, by turns; V1 and w1; its quaternion then


@single_worlds
def functions(variant: Variant) -> SimpleNamespace:
    """Mass matrices of compounds in world axes."""
    one = single.functions(variant)
    real, vec3, mat33, quat = variant.real, one.vec3, one.mat33, one.quat
    put, put_quat = one.put, one.put_quat

    @wp.func
    def turned(q: quat, J: mat33):
        """R J R'."""
        R = wp.quat_to_matrix(q)
        return R * J * wp.transpose(R)

    @wp.func
    def momentum(m: real, s: vec3, J: mat33, V: vec3, w: vec3):
        """M (V, w)."""
        return m * V + wp.cross(w, s), wp.cross(s, V) + J * w

    @wp.func
    def add_share(
        share: wp.array3d(dtype=real), pack: int, lane: int, frame: int, m: real, c: vec3, by_c: vec3, by_own: mat33
    ):
        """Add to gradients by a compound's m, m c and J what its centre c and the inertia about that have.

        The latter is J - m (c.c 1 - c c'), and ``by_own`` symmetric.
        """
        whole = by_own[0, 0] + by_own[1, 1] + by_own[2, 2]
        pulled = by_own * c
        by_s = (by_c - real(2.0) * m * (whole * c - pulled)) / m
        row = wp.static(SHARE_ROWS) * frame
        by_m = -(whole * wp.dot(c, c) - wp.dot(c, pulled)) - wp.dot(by_s, c)
        share[pack, row, lane] = share[pack, row, lane] + by_m
        for i in range(3):
            share[pack, row + 1 + i, lane] = share[pack, row + 1 + i, lane] + by_s[i]
            share[pack, row + 4 + i, lane] = share[pack, row + 4 + i, lane] + by_own[i, i]
        share[pack, row + 7, lane] = share[pack, row + 7, lane] + real(2.0) * by_own[0, 1]
        share[pack, row + 8, lane] = share[pack, row + 8, lane] + real(2.0) * by_own[0, 2]
        share[pack, row + 9, lane] = share[pack, row + 9, lane] + real(2.0) * by_own[1, 2]

    @wp.func
    def of_share(share: wp.array3d(dtype=real), pack: int, lane: int, frame: int, m: real, s: vec3, J: mat33):
        """What a part of a compound has by these."""
        row = wp.static(SHARE_ROWS) * frame
        total = m * share[pack, row, lane]
        for i in range(3):
            total += s[i] * share[pack, row + 1 + i, lane] + J[i, i] * share[pack, row + 4 + i, lane]
        total += J[0, 1] * share[pack, row + 7, lane] + J[0, 2] * share[pack, row + 8, lane]
        return total + J[1, 2] * share[pack, row + 9, lane]

    @wp.func
    def put_moved(
        moved: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        row: int,
        c: vec3,
        c0: vec3,
        cr: vec3,
        V1: vec3,
        w1: vec3,
        q: quat,
    ):
        """Write what a frame moves on with, see ``MOVED_ROWS``."""
        put(moved, pack, lane, row, c)
        put(moved, pack, lane, row + 3, c0)
        put(moved, pack, lane, row + 6, cr)
        put(moved, pack, lane, row + 9, V1)
        put(moved, pack, lane, row + 12, w1)
        put_quat(moved, pack, lane, row + 15, q)

    @wp.func
    def put_offset(
        offset: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        item: int,
        x_bar: wp.array2d(dtype=real),
        v_bar: wp.array2d(dtype=real),
        world: int,
        slot: int,
        nodes: int,
        q: quat,
        w: vec3,
    ):
        """Write the gradient by where a carried node is in its frame, from those by its place and its velocity."""
        by_r = vec3()
        if slot < nodes:
            row = 3 * slot
            by_v = vec3(v_bar[world, row], v_bar[world, row + 1], v_bar[world, row + 2])
            by_r = vec3(x_bar[world, row], x_bar[world, row + 1], x_bar[world, row + 2]) + wp.cross(by_v, w)
        put(offset, pack, lane, 3 * item, wp.quat_rotate_inv(q, by_r))

    return SimpleNamespace(
        turned=turned,
        momentum=momentum,
        add_share=add_share,
        of_share=of_share,
        put_moved=put_moved,
        put_offset=put_offset,
    )


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type, on single worlds."""
    real = variant.real
    module = variant.module("adjoint.compounds")
    one, f = single.functions(variant), functions(variant)
    vec3, mat33, vector_at, quat_at = one.vec3, one.mat33, one.vector_at, one.quat_at
    turned, momentum, of_share = f.turned, f.momentum, f.of_share

    @wp.kernel(module=module, enable_backward=False)
    def sources(
        h: real,
        # Model
        source_frame: wp.array(dtype=wp.int32),
        source: wp.array2d(dtype=wp.int32),
        source_lever: wp.array2d(dtype=real),
        source_inertia: wp.array2d(dtype=real),
        frame_volume: wp.array(dtype=real),
        node_volume: wp.array(dtype=real),
        frame_dof: wp.array(dtype=wp.int32),
        # Workspace in
        gravity_in: wp.array3d(dtype=real),
        pose0_in: wp.array3d(dtype=real),
        force_pose_in: wp.array3d(dtype=real),
        twist0_in: wp.array3d(dtype=real),
        v_in: wp.array3d(dtype=real),
        p_in: wp.array3d(dtype=real),
        end_v_in: wp.array3d(dtype=real),
        moved_in: wp.array3d(dtype=real),
        share_in: wp.array3d(dtype=real),
        # Workspace out
        value_out: wp.array3d(dtype=real),
    ):
        """p.M (V0, w0), with what its weight adds, and p.M (V, w) of one part of a compound, per density.

        The first has too how the compound moves on, c.d(P, L1) - c.dM1 (V1, w1), which depends on its parts' shares;
        it moves on with the velocities ``end_v_in``. So do its free turning and its slowing down, by ``share_in``.
        Nodes of soft bodies have their weights elsewhere.
        """
        pack, item, lane = wp.tid()
        frame = source_frame[item]
        volume = real(0.0)
        weight = real(0.0)
        if source[item, 0] == 0:
            volume = node_volume[source[item, 1]]
        else:
            volume = frame_volume[source[item, 1]]
            weight = volume
        q = quat_at(pose0_in, pack, lane, 7 * frame + 3)
        x = vec3(source_lever[item, 0], source_lever[item, 1], source_lever[item, 2])
        o = vec3(source_inertia[item, 3], source_inertia[item, 4], source_inertia[item, 5])
        J = mat33(
            source_inertia[item, 0],
            o[0],
            o[1],
            o[0],
            source_inertia[item, 1],
            o[2],
            o[1],
            o[2],
            source_inertia[item, 2],
        )
        J += volume * (wp.dot(x, x) * wp.identity(n=3, dtype=real) - wp.outer(x, x))
        turning = of_share(share_in, pack, lane, frame, volume, volume * x, J)
        row = wp.static(MOVED_ROWS) * frame
        cr = vector_at(moved_in, pack, lane, row + 6)
        q1 = quat_at(moved_in, pack, lane, row + 15)
        P, L = momentum(volume, volume * wp.quat_rotate(q1, x), turned(q1, J), vector_at(moved_in, pack, lane, row), cr)
        on = -wp.dot(P, vector_at(moved_in, pack, lane, row + 9)) - wp.dot(L, vector_at(moved_in, pack, lane, row + 12))
        J = turned(q, J)
        s = volume * wp.quat_rotate(q, x)
        t = 3 * frame_dof[2 * frame]
        r = 3 * frame_dof[2 * frame + 1]
        pt = vector_at(p_in, pack, lane, t)
        P, L = momentum(volume, s, J, pt, vector_at(p_in, pack, lane, r))
        had = wp.dot(P, vector_at(twist0_in, pack, lane, 6 * frame))
        had += wp.dot(L, vector_at(twist0_in, pack, lane, 6 * frame + 3))
        V = vector_at(v_in, pack, lane, t)
        w = vector_at(v_in, pack, lane, r)
        has = wp.dot(P, V) + wp.dot(L, w)
        P, L = momentum(volume, s, J, vector_at(moved_in, pack, lane, row + 3), cr)
        had += (
            turning + on + wp.dot(P, vector_at(end_v_in, pack, lane, t)) + wp.dot(L, vector_at(end_v_in, pack, lane, r))
        )
        pt += wp.cross(
            vector_at(p_in, pack, lane, r), wp.quat_rotate(quat_at(force_pose_in, pack, lane, 7 * frame + 3), x)
        )
        value_out[pack, 2 * item, lane] = had + h * weight * wp.dot(pt, vector_at(gravity_in, pack, lane, 0))
        value_out[pack, 2 * item + 1, lane] = has

    @wp.kernel(module=module, enable_backward=False)
    def owners(
        h: real,
        lanes: int,
        first: int,
        # Model
        owner_source_start: wp.array(dtype=wp.int32),
        owner_source: wp.array(dtype=wp.int32),
        # Workspace in
        density_in: wp.array3d(dtype=real),
        body_mass_in: wp.array3d(dtype=real),
        value_in: wp.array3d(dtype=real),
        # State out
        density_bar_out: wp.array2d(dtype=real),
        damping_bar_out: wp.array2d(dtype=real),
    ):
        """Add the gradients by density, or mass, and by mass-proportional damping that one owner has in compounds."""
        pack, owner, lane = wp.tid()
        world = pack * lanes + lane
        if world < density_bar_out.shape[0]:
            scale = body_mass_in[pack, first + owner, lane]
            by_density = real(0.0)
            by_alpha = real(0.0)
            for i in range(owner_source_start[owner], owner_source_start[owner + 1]):
                has = value_in[pack, 2 * owner_source[i] + 1, lane]
                by_density += value_in[pack, 2 * owner_source[i], lane] - scale * has
                by_alpha -= h * density_in[pack, owner, lane] * has
            density_bar_out[world, owner] = density_bar_out[world, owner] + by_density
            damping_bar_out[world, owner] = damping_bar_out[world, owner] + by_alpha

    @wp.kernel(module=module, enable_backward=False)
    def rods(
        lanes: int,
        # Model
        rod_segment_start: wp.array(dtype=wp.int32),
        rod_segment: wp.array(dtype=wp.int32),
        # Workspace in
        parameter_in: wp.array3d(dtype=real),
        # State out
        youngs_bar_out: wp.array2d(dtype=real),
        nu_bar_out: wp.array2d(dtype=real),
        rayleigh_stiffness_bar_out: wp.array2d(dtype=real),
    ):
        """Add the gradients by the stiffness of one rod."""
        pack, rod, lane = wp.tid()
        world = pack * lanes + lane
        if world < youngs_bar_out.shape[0]:
            total = vec3()
            for i in range(rod_segment_start[rod], rod_segment_start[rod + 1]):
                total += vector_at(parameter_in, pack, lane, wp.static(PARAMETERS) * rod_segment[i])
            youngs_bar_out[world, rod] = youngs_bar_out[world, rod] + total[0]
            nu_bar_out[world, rod] = nu_bar_out[world, rod] + total[1]
            rayleigh_stiffness_bar_out[world, rod] = rayleigh_stiffness_bar_out[world, rod] + total[2]

    @wp.kernel(module=module, enable_backward=False)
    def weights(
        h: real,
        lanes: int,
        # Model
        frame_owner: wp.array(dtype=wp.int32),
        frame_volume: wp.array(dtype=real),
        # Workspace in
        owner_density_in: wp.array3d(dtype=real),
        frame_p_in: wp.array3d(dtype=real),
        # State out
        gravity_bar_out: wp.array2d(dtype=real),
    ):
        """Add the gradient by gravity of one world's frames."""
        pack, lane = wp.tid()
        world = pack * lanes + lane
        if world < gravity_bar_out.shape[0]:
            total = vec3()
            for frame in range(frame_owner.shape[0]):
                mass = owner_density_in[pack, frame_owner[frame], lane] * frame_volume[frame]
                total += h * mass * vector_at(frame_p_in, pack, lane, 6 * frame)
            for c in range(3):
                gravity_bar_out[world, c] = gravity_bar_out[world, c] + total[c]

    return SimpleNamespace(sources=sources, owners=owners, rods=rods, weights=weights)
