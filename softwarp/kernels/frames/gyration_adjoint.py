"""Adjoint of free turning in a step of jointed bodies, and of what momentum receives. Theory: docs/theory/adjoint.md.

The difference D of the unknowns from the velocities that belong to momentum is a function of the spin w and of the
orientation at the start, which Warp differentiates; the momentum of the step has A D.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.frames.gyration import LARGEST
from softwarp.kernels.frames.inertia import COMPOUND_ROWS
from softwarp.kernels.frames.parameter_adjoint import functions as of_parts
from softwarp.model.codes import JointRow

APART = {wp.float64: 1.0e-9, wp.float32: 1.0e-4}  # moments of inertia that are nearer than this share are one
SHARES = 3  # rows of a world: what momentum receives of a correction, and how its share changes with both energies


@single_worlds
def functions(variant: Variant) -> SimpleNamespace:
    """D of one body in weights, for one scalar type."""
    real = variant.real
    one = single.functions(variant)
    vec3, mat33, quat, exponential, logarithm = one.vec3, one.mat33, one.quat, one.exponential, one.logarithm

    @wp.func
    def axes_of(J: mat33):
        """Moments and axes of inertia, the middle moment last; see ``frames.gyration.free_turn``."""
        Q = mat33()
        moments = vec3()
        wp.eig3(J, Q, moments)
        if wp.determinant(Q) < real(0.0):
            Q = -Q
        least = real(1.0e-9) * wp.max(moments[0], wp.max(moments[1], moments[2]))
        moments = wp.max(moments, vec3(least, least, least))
        middle = int(0)
        if (moments[1] - moments[0]) * (moments[1] - moments[2]) <= real(0.0):
            middle = 1
        elif (moments[2] - moments[0]) * (moments[2] - moments[1]) <= real(0.0):
            middle = 2
        i = (middle + 1) % 3
        j = (middle + 2) % 3
        ordered = mat33(Q[0, i], Q[0, j], Q[0, middle], Q[1, i], Q[1, j], Q[1, middle], Q[2, i], Q[2, j], Q[2, middle])
        return ordered, vec3(moments[i], moments[j], moments[middle])

    @wp.func
    def value(q0: quat, w: vec3, c: vec3, Q: mat33, moments: vec3, h: real, bt: vec3, br: vec3):
        """D in weights: of the origin, and of the spin."""
        none = real(0.0)
        L = wp.cw_mul(moments, wp.transpose(Q) * wp.quat_rotate_inv(q0, w))
        base = h / moments[2]
        first = real(0.5) * (h / moments[0] - base)
        e = exponential(vec3(L[0] * first, none, none))
        q = e
        L1 = wp.quat_rotate_inv(e, L)
        e1 = exponential(vec3(none, L1[1] * (h / moments[1] - base), none))
        q1 = q * e1
        L2 = wp.quat_rotate_inv(e1, L1)
        e2 = exponential(vec3(L2[0] * first, none, none))
        q2 = q1 * e2
        L3 = wp.quat_rotate_inv(e2, L2)
        turn = wp.quat_rotate(q0, Q * logarithm(q2 * exponential(L3 * base)))
        arm = wp.quat_rotate(q0, c)
        origin = wp.cross(w, arm) + (arm - wp.quat_rotate(exponential(turn), arm)) / h
        return wp.dot(bt, origin) + wp.dot(br, turn / h - w)

    @wp.func
    def by_matrix(Q: mat33, moments: vec3, by_axes: mat33, by_moments: vec3):
        """Gradient by a symmetric matrix, from those by its eigenvectors and eigenvalues.

        Eigenvectors turn by Q_i.dJ Q_j / (m_j - m_i); those of one moment, which may turn freely, count as fixed.
        """
        turned = wp.transpose(Q) * by_axes
        largest = wp.max(moments[0], wp.max(moments[1], moments[2]))
        inner = mat33()
        for i in range(3):
            for j in range(3):
                if i == j:
                    inner[i, j] = by_moments[i]
                else:
                    apart = moments[j] - moments[i]
                    if wp.abs(apart) > largest * real(wp.static(APART[real])):
                        inner[i, j] = turned[i, j] / apart
        whole = Q * inner * wp.transpose(Q)
        return real(0.5) * (whole + wp.transpose(whole))

    @wp.kernel(module=variant.module("adjoint.gyration"), enable_backward=True)
    def reach(
        # Samples in
        vector_in: wp.array(dtype=vec3),
        turn_in: wp.array(dtype=quat),
        matrix_in: wp.array(dtype=mat33),
        h: real,
        # Samples out
        value_out: wp.array(dtype=real),
    ):
        """Makes Warp differentiate ``value``; nobody launches it, as of ``elements.adjoint``."""
        sample = wp.tid()
        a = vector_in[sample]
        value_out[sample] = value(turn_in[sample], a, a, matrix_in[sample], a, h, a, a)

    return SimpleNamespace(axes_of=axes_of, value=value, by_matrix=by_matrix, reach=reach)


@single_worlds
def slowing(variant: Variant) -> SimpleNamespace:
    """How a body is slowed down that would turn with more energy than before."""
    real = variant.real
    one, compounds = single.functions(variant), of_parts(variant)
    vec3, mat33, quat = one.vec3, one.mat33, one.quat
    turned, add_share = compounds.turned, compounds.add_share

    @wp.func
    def bars(L0: vec3, L1: vec3, before: vec3, w: vec3, had: real, has: real, c: vec3, by_v: vec3, by_w: vec3):
        """Gradients through a body's slowing down to the energy that it had, f = (had / has)^1/2 and w1 = f w.

        Its spin ``before`` has the momentum L0, w has L1; c is its centre of mass. By its turn then, by w, by its turn
        at the start and by the spin before.
        """
        f = wp.sqrt(had / has)
        lost = (f - real(1.0)) * w
        by_lost = by_w - wp.cross(c, by_v)
        spun = f * wp.dot(w, by_lost)
        by_turn_then = -wp.cross(c, wp.cross(by_v, lost)) - (spun / has) * wp.cross(L1, w)
        by_fast = by_w + (f - real(1.0)) * by_lost - (spun / has) * L1
        return by_turn_then, by_fast, (spun / had) * wp.cross(L0, before), (spun / had) * L0

    @wp.func
    def masses(
        q0: quat,
        q: quat,
        before: vec3,
        w: vec3,
        had: real,
        has: real,
        m: real,
        c: vec3,
        by_v: vec3,
        by_w: vec3,
        pack: int,
        lane: int,
        frame: int,
        share: wp.array3d(dtype=real),
    ):
        """Add the same by the compound that it is."""
        f = wp.sqrt(had / has)
        a = wp.quat_rotate_inv(q0, before)
        b = wp.quat_rotate_inv(q, w)
        spun = real(0.5) * f * wp.dot(w, by_w - wp.cross(wp.quat_rotate(q, c), by_v))
        by_c = (real(1.0) - f) * wp.quat_rotate_inv(q, wp.cross(by_v, w))
        by_own = (spun / had) * wp.outer(a, a) - (spun / has) * wp.outer(b, b)
        add_share(share, pack, lane, frame, m, c, by_c, by_own)

    @wp.func
    def slowed(
        q0: quat,
        q: quat,
        before: vec3,
        w: vec3,
        had: real,
        has: real,
        m: real,
        centre: vec3,
        inertia: mat33,
        by_v: vec3,
        by_w: vec3,
        pack: int,
        lane: int,
        frame: int,
        share: wp.array3d(dtype=real),
    ):
        """Both, of a compound of mass m with an inertia about its centre, in its own axes."""
        masses(q0, q, before, w, had, has, m, centre, by_v, by_w, pack, lane, frame, share)
        had_spin = turned(q0, inertia) * before
        has_spin = turned(q, inertia) * w
        return bars(had_spin, has_spin, before, w, had, has, wp.quat_rotate(q, centre), by_v, by_w)

    return SimpleNamespace(slowed=slowed)


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type, on single worlds."""
    real = variant.real
    module = variant.module("adjoint.gyration")
    one, f = single.functions(variant), functions(variant)
    vec3, vector_at, quat_at, inertia_at, add_to = one.vec3, one.vector_at, one.quat_at, one.inertia_at, one.add_to
    put = one.put
    axes_of, value, by_matrix = f.axes_of, f.value, f.by_matrix
    add_share = of_parts(variant).add_share

    @wp.kernel(module=module, enable_backward=False)
    def spins(
        h: real,
        # Model
        gyrating_frame: wp.array(dtype=wp.int32),
        # Workspace in
        pose0_in: wp.array3d(dtype=real),
        compound_in: wp.array3d(dtype=real),
        known_in: wp.array3d(dtype=real),
        before_in: wp.array3d(dtype=real),
        bar_in: wp.array3d(dtype=real),
        # Workspace out
        known_bar_out: wp.array3d(dtype=real),
        before_bar_out: wp.array3d(dtype=real),
        place_out: wp.array3d(dtype=real),
        share_out: wp.array3d(dtype=real),
    ):
        """Add the gradients by the spin that one body's D was found from, by its turn and masses, from those by D.

        The spin is that of the twists ``known_in`` less that of the differences ``before_in``.
        """
        pack, item, lane = wp.tid()
        frame = gyrating_frame[item]
        k = wp.static(COMPOUND_ROWS) * frame
        m = compound_in[pack, k, lane]
        w = vector_at(known_in, pack, lane, 6 * frame + 3) - vector_at(before_in, pack, lane, 6 * frame + 3)
        if m > real(0.0) and wp.length(w) * h < real(wp.static(LARGEST)):
            c = vector_at(compound_in, pack, lane, k + 1) / m
            square = wp.dot(c, c) * wp.identity(n=3, dtype=real)
            Q, moments = axes_of(inertia_at(compound_in, pack, lane, k + 4) - m * (square - wp.outer(c, c)))
            q0 = quat_at(pose0_in, pack, lane, 7 * frame + 3)
            bt = vector_at(bar_in, pack, lane, 6 * frame)
            br = vector_at(bar_in, pack, lane, 6 * frame + 3)
            by_q, by_w, by_c, by_axes, by_moments, _h, _t, _r = wp.grad(value)(q0, w, c, Q, moments, h, bt, br)
            u = vec3(q0[0], q0[1], q0[2])
            by_u = vec3(by_q[0], by_q[1], by_q[2])
            turn = real(0.5) * (q0[3] * by_u + wp.cross(u, by_u) - by_q[3] * u)
            add_to(known_bar_out, pack, lane, 6 * frame + 3, by_w)
            add_to(before_bar_out, pack, lane, 6 * frame + 3, -by_w)
            add_to(place_out, pack, lane, 6 * frame + 3, turn)
            add_share(share_out, pack, lane, frame, m, c, by_c, by_matrix(Q, moments, by_axes, by_moments))

    @wp.kernel(module=module, enable_backward=False)
    def settle(
        h: real,
        # Model
        gyrating_frame: wp.array(dtype=wp.int32),
        # Workspace in
        pose0_in: wp.array3d(dtype=real),
        compound_in: wp.array3d(dtype=real),
        known_in: wp.array3d(dtype=real),
        before_in: wp.array3d(dtype=real),
        # Workspace out
        bar_out: wp.array3d(dtype=real),
    ):
        """Make gradients by one body's D those by a D that is found from v - D itself, as where Newton's method ends.

        With G the slopes of D, d(D_r) = G_r (dv - d(D_r)): the part by the spin is (1 + G_r')^-1 (br - G_t' bt).
        """
        pack, item, lane = wp.tid()
        frame = gyrating_frame[item]
        k = wp.static(COMPOUND_ROWS) * frame
        m = compound_in[pack, k, lane]
        w = vector_at(known_in, pack, lane, 6 * frame + 3) - vector_at(before_in, pack, lane, 6 * frame + 3)
        if m > real(0.0) and wp.length(w) * h < real(wp.static(LARGEST)):
            c = vector_at(compound_in, pack, lane, k + 1) / m
            square = wp.dot(c, c) * wp.identity(n=3, dtype=real) - wp.outer(c, c)
            Q, moments = axes_of(inertia_at(compound_in, pack, lane, k + 4) - m * square)
            q0 = quat_at(pose0_in, pack, lane, 7 * frame + 3)
            bt = vector_at(bar_out, pack, lane, 6 * frame)
            br = vector_at(bar_out, pack, lane, 6 * frame + 3)
            whole = wp.identity(n=3, dtype=real)
            left = br
            for i in range(4):
                along = vec3()
                linear = vec3()
                if i < 3:
                    along[i] = real(1.0)
                else:
                    linear = bt
                _q, by_w, _c, _a, _m, _h, _t, _r = wp.grad(value)(q0, w, c, Q, moments, h, linear, along)
                for j in range(3):
                    if i < 3:
                        whole[j, i] = whole[j, i] + by_w[j]
                    else:
                        left[j] = left[j] - by_w[j]
            put(bar_out, pack, lane, 6 * frame + 3, wp.inverse(whole) * left)

    @wp.kernel(module=module, enable_backward=False)
    def momenta(
        # Model
        gyrating_frame: wp.array(dtype=wp.int32),
        frame_dof: wp.array(dtype=wp.int32),
        # Workspace in
        pose0_in: wp.array3d(dtype=real),
        compound_in: wp.array3d(dtype=real),
        p_in: wp.array3d(dtype=real),
        # Workspace out
        bar_out: wp.array3d(dtype=real),
    ):
        """Add A p of one body, the gradient by D in its momentum."""
        pack, item, lane = wp.tid()
        frame = gyrating_frame[item]
        k = wp.static(COMPOUND_ROWS) * frame + 10
        q = quat_at(pose0_in, pack, lane, 7 * frame + 3)
        s = wp.quat_rotate(q, vector_at(compound_in, pack, lane, k + 1))
        R = wp.quat_to_matrix(q)
        J = R * inertia_at(compound_in, pack, lane, k + 4) * wp.transpose(R)
        pt = vector_at(p_in, pack, lane, 3 * frame_dof[2 * frame])
        pr = vector_at(p_in, pack, lane, 3 * frame_dof[2 * frame + 1])
        add_to(bar_out, pack, lane, 6 * frame, compound_in[pack, k, lane] * pt + wp.cross(pr, s))
        add_to(bar_out, pack, lane, 6 * frame + 3, wp.cross(s, pt) + J * pr)

    @wp.kernel(module=module, enable_backward=False)
    def held_gaps(
        first_row: int,
        count: int,
        # Model
        row_kind: wp.array(dtype=wp.int32),
        row_is_held: wp.array(dtype=wp.int32),
        # Workspace in
        value_in: wp.array3d(dtype=real),
        factor: real,
        # Workspace out
        gap_out: wp.array3d(dtype=real),
        active_out: wp.array3d(dtype=wp.int32),
    ):
        """A number of the joints' rows among those of all rows of one world, for a solution of rows without bounds."""
        pack, lane = wp.tid()
        for row in range(count):
            k = row - first_row
            value = real(0.0)
            active = int(0)
            if k >= 0:
                active = row_is_held[k]
                if active != 0 and row_kind[k] != wp.static(JointRow.FREE):
                    value = factor * value_in[pack, k, lane]
            gap_out[pack, row, lane] = value
            active_out[pack, row, lane] = active

    @wp.kernel(module=module, enable_backward=False)
    def shares(
        rows: int,
        # Workspace in
        needed_gap_in: wp.array3d(dtype=real),
        needed_in: wp.array3d(dtype=real),
        gap_in: wp.array3d(dtype=real),
        given_in: wp.array3d(dtype=real),
        response_in: wp.array3d(dtype=real),
        kept_bar_in: wp.array3d(dtype=real),
        # Workspace out
        share_out: wp.array3d(dtype=real),
    ):
        """Share of a correction that momentum does not receive, and gradients by the energies taken and given.

        ``kept_bar`` are gradients by the velocities v - share r that momentum keeps, ``response`` is r.
        """
        pack, lane = wp.tid()
        taken = real(0.0)
        given = real(0.0)
        for row in range(rows):
            taken += needed_gap_in[pack, row, lane] * needed_in[pack, row, lane]
            given += gap_in[pack, row, lane] * given_in[pack, row, lane]
        by_share = real(0.0)
        for row in range(kept_bar_in.shape[1]):
            by_share -= response_in[pack, row, lane] * kept_bar_in[pack, row, lane]
        share = real(0.0)
        by_taken = real(0.0)
        by_given = real(0.0)
        if given > taken:
            left = wp.sqrt(wp.max(taken, real(0.0)) / (given + real(1.0e-30)))
            share = real(1.0) - left
            if taken > real(0.0):
                by_taken = -real(0.5) * by_share * left / taken
            by_given = real(0.5) * by_share * left / (given + real(1.0e-30))
        share_out[pack, 0, lane] = share
        share_out[pack, 1, lane] = by_taken
        share_out[pack, 2, lane] = by_given

    @wp.kernel(module=module, enable_backward=False)
    def add_scaled(
        # Workspace in
        share_in: wp.array3d(dtype=real),
        row: int,
        factor: real,
        value_in: wp.array3d(dtype=real),
        # Workspace out
        out_out: wp.array3d(dtype=real),
    ):
        """Add one of the world's ``shares``, or 1 for -1, times a factor and an array to another one, at one row."""
        pack, i, lane = wp.tid()
        scale = factor
        if row >= 0:
            scale *= share_in[pack, row, lane]
        out_out[pack, i, lane] = out_out[pack, i, lane] + scale * value_in[pack, i, lane]

    @wp.kernel(module=module, enable_backward=False)
    def to_dofs(
        # Model
        frame_dof: wp.array(dtype=wp.int32),
        dof_free: wp.array2d(dtype=real),
        # Workspace in
        twist_in: wp.array3d(dtype=real),
        # Workspace out
        seed_out: wp.array3d(dtype=real),
    ):
        """Add what is of one frame's twist to its dofs that are unknown."""
        pack, frame, lane = wp.tid()
        for c in range(6):
            dof = frame_dof[2 * frame + c / 3]
            row = 3 * dof + c % 3
            seed_out[pack, row, lane] = (
                seed_out[pack, row, lane] + dof_free[dof, c % 3] * twist_in[pack, 6 * frame + c, lane]
            )

    @wp.kernel(module=module, enable_backward=False)
    def add_state(
        lanes: int,
        # Workspace in
        value_in: wp.array3d(dtype=real),
        # State out
        bar_out: wp.array2d(dtype=real),
    ):
        """Add one row of the workspace to that of a state array."""
        pack, row, lane = wp.tid()
        world = pack * lanes + lane
        if world < bar_out.shape[0]:
            bar_out[world, row] = bar_out[world, row] + value_in[pack, row, lane]

    @wp.kernel(module=module, enable_backward=False)
    def collect(
        lanes: int,
        sets: int,
        # State out
        part_out: wp.array2d(dtype=real),
        total_out: wp.array2d(dtype=real),
    ):
        """Add one row of a gradient to a sum and clear it; or, to end with (``sets``), put the sum in its place."""
        pack, row, lane = wp.tid()
        world = pack * lanes + lane
        if world < part_out.shape[0]:
            if sets != 0:
                part_out[world, row] = total_out[world, row]
                total_out[world, row] = real(0.0)
            else:
                total_out[world, row] = total_out[world, row] + part_out[world, row]
                part_out[world, row] = real(0.0)

    return SimpleNamespace(
        spins=spins,
        settle=settle,
        momenta=momenta,
        held_gaps=held_gaps,
        shares=shares,
        add_scaled=add_scaled,
        to_dofs=to_dofs,
        add_state=add_state,
        collect=collect,
    )
