"""Adjoint of contacts in a step, with the active set of the step. Theory: docs/theory/adjoint.md.

A contact has the relative velocity s = sum w_k v_k and pushes with the force F = l_n n + F_t. The step found

    open    l = 0
    stick   g* + h n.s + C l_n = 0,   h s_t = 0
    slip    g* + h n.s + C l_n = 0,   F_t = -mu l_n s_t / |s_t|.

With the gaps g = h H p of the adjoint p of velocities and z, its forces, A p + h H' z = y, and

    open    z = 0
    stick   g_n = C z_n,   g_t = 0
    slip    g_n = C z_n - mu r.g_t,   z_t = k (1 - r r') g_t,   r = F_t / |F_t|,   k = mu l_n / (h |s_t|),

as the friction of what slips follows its pressure, and turns with its direction. That couples pressure and friction in
one direction only, so the matrix is not symmetric: W of all rows is eliminated with pivots. At a switch the gradient
is that of one side: what just touches without force is open, what just slips sticks.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.model.codes import SLOTS

SLIPS = {wp.float64: 1.0e-8, wp.float32: 1.0e-4}  # relative distance of friction from its bound up to which it slips


@single_worlds
def functions(variant: Variant) -> SimpleNamespace:
    """How contacts move, of single worlds."""
    real = variant.real
    one = single.functions(variant)
    vec3, vector_at = one.vec3, one.vector_at

    @wp.func
    def motion(
        dof: wp.array3d(dtype=wp.int32),
        weight: wp.array3d(dtype=real),
        lever: wp.array3d(dtype=real),
        u: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        contact: int,
    ):
        """sum w_k u_k + u_k x r_k of one contact, in world axes, and how what it stands on turns."""
        total = vec3()
        spin = vec3()
        for slot in range(wp.static(SLOTS)):
            item = wp.static(SLOTS) * contact + slot
            row = dof[pack, item, lane]
            if row >= 0:
                here = vector_at(u, pack, lane, 3 * row)
                total += weight[pack, item, lane] * here + wp.cross(here, vector_at(lever, pack, lane, 3 * item))
                if weight[pack, item, lane] == real(0.0):
                    spin = here
        return total, spin

    @wp.func
    def along(axes: wp.array3d(dtype=real), pack: int, lane: int, contact: int, v: vec3):
        """Components of a vector of the world."""
        n = vector_at(axes, pack, lane, 9 * contact)
        s = vector_at(axes, pack, lane, 9 * contact + 3)
        t = vector_at(axes, pack, lane, 9 * contact + 6)
        return vec3(wp.dot(n, v), wp.dot(s, v), wp.dot(t, v))

    return SimpleNamespace(motion=motion, along=along)


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type, on single worlds: (pack, row, lane)."""
    real = variant.real
    module = variant.module("adjoint.contact")
    one = single.functions(variant)
    vec3, vector_at = one.vec3, one.vector_at
    found = functions(variant)
    motion, along = found.motion, found.along

    @wp.kernel(module=module, enable_backward=False)
    def known_gaps(
        rows: int,
        h: real,
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        dof_in: wp.array3d(dtype=wp.int32),
        weight_in: wp.array3d(dtype=real),
        lever_in: wp.array3d(dtype=real),
        axes_in: wp.array3d(dtype=real),
        p_in: wp.array3d(dtype=real),
        force_in: wp.array3d(dtype=real),
        # Workspace out
        gap_out: wp.array3d(dtype=real),
    ):
        """h H p of one contact, with what is known of p, and the gradient by its force; 0 where there is no contact."""
        pack, contact, lane = wp.tid()
        g = vec3()
        if contact < count_in[pack, 0, lane]:
            u, _ = motion(dof_in, weight_in, lever_in, p_in, pack, lane, contact)
            g = h * along(axes_in, pack, lane, contact, u) + vector_at(force_in, pack, lane, 3 * contact)
        for a in range(3):
            gap_out[pack, rows + 3 * contact + a, lane] = g[a]

    @wp.kernel(module=module, enable_backward=False)
    def modes(
        h: real,
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        dof_in: wp.array3d(dtype=wp.int32),
        weight_in: wp.array3d(dtype=real),
        lever_in: wp.array3d(dtype=real),
        axes_in: wp.array3d(dtype=real),
        mu_in: wp.array3d(dtype=real),
        multiplier_in: wp.array3d(dtype=real),
        v_in: wp.array3d(dtype=real),
        # Workspace out
        mode_out: wp.array3d(dtype=real),
    ):
        """Whether one contact was open (0), stuck (1) or slipped (2); of what slipped k, and r in its tangents."""
        pack, contact, lane = wp.tid()
        mode = real(0.0)
        k = real(0.0)
        r = vec3()
        if contact < count_in[pack, 0, lane]:
            force = vector_at(multiplier_in, pack, lane, 3 * contact)
            if force[0] > real(0.0):
                mode = real(1.0)
                friction = wp.sqrt(force[1] * force[1] + force[2] * force[2])
                radius = mu_in[pack, contact, lane] * force[0]
                u, _ = motion(dof_in, weight_in, lever_in, v_in, pack, lane, contact)
                s = along(axes_in, pack, lane, contact, u)
                speed = wp.sqrt(s[1] * s[1] + s[2] * s[2])
                if friction >= radius * (real(1.0) - real(wp.static(SLIPS[real]))) and speed > real(0.0):
                    mode = real(2.0)
                    k = radius / (h * speed)
                    r = vec3(real(0.0), -s[1] / speed, -s[2] / speed)
        mode_out[pack, 4 * contact, lane] = mode
        mode_out[pack, 4 * contact + 1, lane] = k
        mode_out[pack, 4 * contact + 2, lane] = r[1]
        mode_out[pack, 4 * contact + 3, lane] = r[2]

    @wp.func
    def shift(array: wp.array3d(dtype=real), pack: int, lane: int, start: int, end: int, width: int):
        """Copy the rows of one contact to those of another."""
        for row in range(width):
            array[pack, width * end + row, lane] = array[pack, width * start + row, lane]

    @wp.func
    def shift_integers(array: wp.array3d(dtype=wp.int32), pack: int, lane: int, start: int, end: int, width: int):
        """The same of integers."""
        for row in range(width):
            array[pack, width * end + row, lane] = array[pack, width * start + row, lane]

    @wp.kernel(module=module, enable_backward=False)
    def drop_open(
        normal_rows: int,
        # Workspace out
        count_out: wp.array3d(dtype=wp.int32),
        listed_out: wp.array3d(dtype=wp.int32),
        key_out: wp.array3d(dtype=wp.int32),
        pair_out: wp.array3d(dtype=wp.int32),
        dof_out: wp.array3d(dtype=wp.int32),
        couple_out: wp.array3d(dtype=wp.int32),
        face_out: wp.array3d(dtype=wp.int32),
        look_out: wp.array3d(dtype=wp.int32),
        weight_out: wp.array3d(dtype=real),
        lever_out: wp.array3d(dtype=real),
        axes_out: wp.array3d(dtype=real),
        gap_out: wp.array3d(dtype=real),
        mu_out: wp.array3d(dtype=real),
        restitution_out: wp.array3d(dtype=real),
        softness_out: wp.array3d(dtype=real),
        multiplier_out: wp.array3d(dtype=real),
        first_force_out: wp.array3d(dtype=real),
        normal_out: wp.array3d(dtype=real),
    ):
        """Leave out the contacts of one world that pushed in no solution, as nothing has a gradient by them.

        Others keep their order; places that become free are neutral. Arrays may be the same.
        """
        pack, lane = wp.tid()
        kept = int(0)
        listed = int(0)
        count = count_out[pack, 0, lane]
        for contact in range(count):
            pushes = multiplier_out[pack, 3 * contact, lane] > real(0.0)
            if pushes or first_force_out[pack, 3 * contact, lane] > real(0.0):
                if kept < contact:
                    shift_integers(key_out, pack, lane, contact, kept, 1)
                    shift_integers(pair_out, pack, lane, contact, kept, 1)
                    shift_integers(dof_out, pack, lane, contact, kept, wp.static(SLOTS))
                    shift_integers(couple_out, pack, lane, contact, kept, 1)
                    shift_integers(face_out, pack, lane, contact, kept, 1)
                    shift_integers(look_out, pack, lane, contact, kept, 1)
                    shift(weight_out, pack, lane, contact, kept, wp.static(SLOTS))
                    shift(lever_out, pack, lane, contact, kept, wp.static(3 * SLOTS))
                    shift(axes_out, pack, lane, contact, kept, 9)
                    shift(gap_out, pack, lane, contact, kept, 1)
                    shift(mu_out, pack, lane, contact, kept, 1)
                    shift(restitution_out, pack, lane, contact, kept, 1)
                    shift(softness_out, pack, lane, contact, kept, 1)
                    shift(multiplier_out, pack, lane, contact, kept, 3)
                    shift(first_force_out, pack, lane, contact, kept, 3)
                    shift(normal_out, pack, lane, contact, kept, normal_rows)
                kept += 1
                if contact < listed_out[pack, 0, lane]:
                    listed += 1
        for contact in range(kept, count):
            gap_out[pack, contact, lane] = real(1.0)
            mu_out[pack, contact, lane] = real(0.0)
            for row in range(wp.static(SLOTS)):
                dof_out[pack, wp.static(SLOTS) * contact + row, lane] = -1
                weight_out[pack, wp.static(SLOTS) * contact + row, lane] = real(0.0)
            for row in range(wp.static(3 * SLOTS)):
                lever_out[pack, wp.static(3 * SLOTS) * contact + row, lane] = real(0.0)
            for row in range(9):
                axes_out[pack, 9 * contact + row, lane] = real(0.0)
            for row in range(3):
                multiplier_out[pack, 3 * contact + row, lane] = real(0.0)
                first_force_out[pack, 3 * contact + row, lane] = real(0.0)
        count_out[pack, 0, lane] = kept
        listed_out[pack, 0, lane] = listed

    return SimpleNamespace(known_gaps=known_gaps, modes=modes, drop_open=drop_open)
