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
from softwarp.kernels.rows import elimination
from softwarp.model.codes import SLOTS

SLIPS = {wp.float64: 1.0e-8, wp.float32: 1.0e-4}  # relative distance of friction from its bound up to which it slips
UNSOLVED = {
    wp.float64: 1.0e-7,
    wp.float32: 1.0e-3,
}  # relative size of what rounding may leave of equations that repeat others
DEPENDENT = {wp.float64: 1.0e-13, wp.float32: 1.0e-6}  # relative pivot of a row that repeats others


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
def kernels(variant: Variant, forward: bool = False) -> SimpleNamespace:
    """Kernels for one scalar type, on single worlds: (pack, row, lane).

    Args:
        variant: Scalar type and memory order.
        forward: Solve for the change -z of forces instead, whose equations are the transposed ones.
    """
    real = variant.real
    module = variant.module("directional.laws" if forward else "adjoint.contact")
    one = single.functions(variant)
    vec3, vector_at = one.vec3, one.vector_at
    dependent, unsolved = DEPENDENT[real], UNSOLVED[real]
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

    @wp.func
    def terms(
        compliance: wp.array3d(dtype=real),
        softness: wp.array3d(dtype=real),
        active: wp.array3d(dtype=wp.int32),
        mode: wp.array3d(dtype=real),
        mu: wp.array3d(dtype=real),
        gap: wp.array3d(dtype=real),
        offset: wp.array3d(dtype=real),
        z: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        rows: int,
        i: int,
    ):
        """One equation for the change of q and z: the right-hand side, and what its coefficients are made of.

        These are factors of its own row of W, of the two tangents' rows and of the unit matrix, and of friction what
        pressure adds.
        """
        own = real(1.0)
        first = real(0.0)
        second = real(0.0)
        unit = real(0.0)
        pressed = real(0.0)
        before = real(0.0)
        is_open = bool(False)
        t = i
        if i < rows:
            is_open = active[pack, i, lane] == 0
            unit = compliance[pack, i, lane]  # the gap has C q in it already
        else:
            contact = (i - rows) / 3
            axis = (i - rows) % 3
            t = rows + 3 * contact + 1
            state = mode[pack, 4 * contact, lane]
            k = mode[pack, 4 * contact + 1, lane]
            r1 = mode[pack, 4 * contact + 2, lane]
            r2 = mode[pack, 4 * contact + 3, lane]
            is_open = state == real(0.0)
            if axis == 0:
                unit = softness[pack, contact, lane]
                before = unit * z[pack, 3 * contact, lane]
                if state == real(2.0) and wp.static(not forward):
                    first = mu[pack, contact, lane] * r1
                    second = mu[pack, contact, lane] * r2
            elif state == real(2.0):
                unit = real(1.0)
                before = z[pack, 3 * contact + axis, lane]
                if wp.static(forward):
                    pressed = -mu[pack, contact, lane] * wp.where(axis == 1, r1, r2)
                    before += pressed * z[pack, 3 * contact, lane] + offset[pack, 3 * contact + axis, lane]
                own = real(0.0)
                if axis == 1:
                    first = k * (real(1.0) - r1 * r1)
                    second = -k * r1 * r2
                else:
                    first = -k * r1 * r2
                    second = k * (real(1.0) - r2 * r2)
        right = own * gap[pack, i, lane] - before
        if first != real(0.0) or second != real(0.0):
            right += first * gap[pack, t, lane] + second * gap[pack, t + 1, lane]
        if is_open:
            right = real(0.0)
            own = real(0.0)
            first = real(0.0)
            second = real(0.0)
            unit = real(1.0)
            pressed = real(0.0)
        return right, own, first, second, unit, pressed

    @wp.func
    def fill_row(
        delassus: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        rows: int,
        order: int,
        total: int,
        i: int,
        own: real,
        first: real,
        second: real,
        unit: real,
        pressed: real,
        matrix_out: wp.array3d(dtype=real),
    ):
        """Coefficients of one equation, from ``terms``."""
        t = i
        if i >= rows:
            t = i - (i - rows) % 3 + 1
        for j in range(total):
            entry = own * delassus[pack, i * order + j, lane]
            if first != real(0.0) or second != real(0.0):
                entry += first * delassus[pack, t * order + j, lane]
                entry += second * delassus[pack, (t + 1) * order + j, lane]
            if i == j:
                entry += unit
            if i >= rows and j == t - 1:
                entry += pressed
            matrix_out[pack, i * order + j, lane] = entry

    @wp.func
    def swap(
        matrix_out: wp.array3d(dtype=real),
        change_out: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        order: int,
        total: int,
        i: int,
        k: int,
        first: int,
    ):
        """Exchange two rows from a column on."""
        for j in range(first, total):
            kept = matrix_out[pack, i * order + j, lane]
            matrix_out[pack, i * order + j, lane] = matrix_out[pack, k * order + j, lane]
            matrix_out[pack, k * order + j, lane] = kept
        right = change_out[pack, i, lane]
        change_out[pack, i, lane] = change_out[pack, k, lane]
        change_out[pack, k, lane] = right

    @wp.func
    def unit_of(delassus: wp.array3d(dtype=real), pack: int, lane: int, order: int, i: int):
        """Of one unknown, in which rows of pressures, tensions and contacts have pivots that compare."""
        own = delassus[pack, i * order + i, lane]
        return wp.where(own > real(0.0), real(1.0) / wp.sqrt(own), real(1.0))

    @wp.kernel(module=module, enable_backward=False)
    def solve(
        rows: int,
        order: int,
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        delassus_in: wp.array3d(dtype=real),
        compliance_in: wp.array3d(dtype=real),
        softness_in: wp.array3d(dtype=real),
        active_in: wp.array3d(dtype=wp.int32),
        mode_in: wp.array3d(dtype=real),
        mu_in: wp.array3d(dtype=real),
        gap_in: wp.array3d(dtype=real),
        offset_in: wp.array3d(dtype=real),
        # Workspace out
        matrix_out: wp.array3d(dtype=real),
        change_out: wp.array3d(dtype=real),
        q_out: wp.array3d(dtype=real),
        z_out: wp.array3d(dtype=real),
        unsure_out: wp.array3d(dtype=wp.int32),
    ):
        """Changes of q and z, and their sums, by Gauss' elimination; rows that repeat others get none.

        Where equations that repeat others contradict them, as contacts that slip and share a load in many ways with
        other friction may, nothing solves them: ``unsure``.
        """
        pack, lane = wp.tid()
        total = rows + 3 * count_in[pack, 0, lane]
        for i in range(total):
            right, own, first, second, unit, pressed = terms(
                compliance_in,
                softness_in,
                active_in,
                mode_in,
                mu_in,
                gap_in,
                offset_in,
                z_out,
                pack,
                lane,
                rows,
                i,
            )
            change_out[pack, i, lane] = right
            fill_row(
                delassus_in,
                pack,
                lane,
                rows,
                order,
                total,
                i,
                own,
                first,
                second,
                unit,
                pressed,
                matrix_out,
            )
        scale = real(0.0)
        for i in range(total):
            known = real(0.0)
            if i >= rows:
                known = delassus_in[pack, i * order + i, lane] * z_out[pack, i - rows, lane]
            largest_entry = real(0.0)
            for j in range(total):
                entry_in_units = matrix_out[pack, i * order + j, lane] * unit_of(delassus_in, pack, lane, order, j)
                matrix_out[pack, i * order + j, lane] = entry_in_units
                largest_entry = wp.max(largest_entry, wp.abs(entry_in_units))
            if largest_entry > real(0.0):
                for j in range(total):
                    matrix_out[pack, i * order + j, lane] = matrix_out[pack, i * order + j, lane] / largest_entry
                change_out[pack, i, lane] = change_out[pack, i, lane] / largest_entry
                known = known / largest_entry
            scale = wp.max(scale, wp.max(wp.abs(change_out[pack, i, lane]), wp.abs(known)))
        rank = int(0)  # rows that have a pivot, each in its column; a column without one repeats those before it
        for k in range(total):
            largest = int(rank)
            for i in range(rank + 1, total):
                if wp.abs(matrix_out[pack, i * order + k, lane]) > wp.abs(matrix_out[pack, largest * order + k, lane]):
                    largest = i
            pivot = matrix_out[pack, largest * order + k, lane]
            if wp.abs(pivot) > real(wp.static(dependent)):
                if largest != rank:
                    swap(matrix_out, change_out, pack, lane, order, total, largest, rank, k)
                for i in range(rank + 1, total):
                    entry = matrix_out[pack, i * order + k, lane]
                    if entry != real(0.0):
                        factor = entry / pivot
                        for j in range(k + 1, total):
                            from_pivot = factor * matrix_out[pack, rank * order + j, lane]
                            matrix_out[pack, i * order + j, lane] = matrix_out[pack, i * order + j, lane] - from_pivot
                        change_out[pack, i, lane] = change_out[pack, i, lane] - factor * change_out[pack, rank, lane]
                if rank < k:
                    matrix_out[pack, k * order + k, lane] = real(1.0)  # nobody reads what is below a pivot
                rank += 1
            else:
                matrix_out[pack, k * order + k, lane] = real(0.0)
        for i in range(rank, total):  # 0 = 0, or there is no solution
            if wp.abs(change_out[pack, i, lane]) > real(wp.static(unsolved)) * scale:
                unsure_out[pack, 0, lane] = 1
        for back in range(total):
            i = total - 1 - back
            value = real(0.0)
            if matrix_out[pack, i * order + i, lane] != real(0.0):
                rank -= 1
                value = change_out[pack, rank, lane]
                for later in range(total - 1 - i):  # from the last one, as ``elimination`` has it
                    j = total - 1 - later
                    value -= matrix_out[pack, rank * order + j, lane] * change_out[pack, j, lane]
                value = value / matrix_out[pack, rank * order + i, lane]
            change_out[pack, i, lane] = value
        for i in range(total):
            value = change_out[pack, i, lane] * unit_of(delassus_in, pack, lane, order, i)
            change_out[pack, i, lane] = value
            if i < rows:
                q_out[pack, i, lane] = q_out[pack, i, lane] + value
            else:
                z_out[pack, i - rows, lane] = z_out[pack, i - rows, lane] + value
        for i in range(total, order):
            change_out[pack, i, lane] = real(0.0)

    result = SimpleNamespace(known_gaps=known_gaps, modes=modes, drop_open=drop_open, solve=solve)
    if variant.world_fastest:
        return result
    of_world = elimination.functions(real)
    fill, factor, eliminate = of_world.fill, of_world.factor, of_world.solve

    @wp.kernel(module=module, enable_backward=False)
    def note_equations(
        rows: int,
        order: int,
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        delassus_in: wp.array3d(dtype=real),
        compliance_in: wp.array3d(dtype=real),
        softness_in: wp.array3d(dtype=real),
        active_in: wp.array3d(dtype=wp.int32),
        mode_in: wp.array3d(dtype=real),
        mu_in: wp.array3d(dtype=real),
        gap_in: wp.array3d(dtype=real),
        offset_in: wp.array3d(dtype=real),
        z_in: wp.array3d(dtype=real),
        # Workspace out
        held_out: wp.array3d(dtype=real),
    ):
        """What the equations of one world are made of; the first step of ``solve`` on a CPU."""
        pack, lane = wp.tid()
        world = pack * gap_in.shape[2] + lane
        for i in range(rows + 3 * count_in[pack, 0, lane]):
            _right, own, first, second, unit, pressed = terms(
                compliance_in,
                softness_in,
                active_in,
                mode_in,
                mu_in,
                gap_in,
                offset_in,
                z_in,
                pack,
                lane,
                rows,
                i,
            )
            held_out[world, wp.static(elimination.UNIT) * order + i, 0] = unit_of(delassus_in, pack, lane, order, i)
            held_out[world, wp.static(elimination.OWN) * order + i, 0] = own
            held_out[world, wp.static(elimination.FIRST) * order + i, 0] = first
            held_out[world, wp.static(elimination.SECOND) * order + i, 0] = second
            held_out[world, wp.static(elimination.DIAGONAL) * order + i, 0] = unit
            held_out[world, wp.static(elimination.PRESSED) * order + i, 0] = pressed

    @wp.kernel(module=module, enable_backward=False)
    def fill_matrices(
        rows: int,
        order: int,
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        delassus_in: wp.array3d(dtype=real),
        held_in: wp.array3d(dtype=real),
        # Workspace out
        matrix_out: wp.array3d(dtype=real),
    ):
        """Equations of all worlds of a pack, whose numbers of W stand side by side."""
        pack = wp.tid()
        fill(delassus_in, count_in, held_in, pack, rows, order, matrix_out)

    @wp.kernel(module=module, enable_backward=False)
    def factor_matrix(
        rows: int,
        order: int,
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        # Workspace out
        matrix_out: wp.array3d(dtype=real),
        held_out: wp.array3d(dtype=real),
    ):
        """Factors of one world's equations."""
        pack, lane = wp.tid()
        world = pack * count_in.shape[2] + lane
        total = rows + 3 * count_in[pack, 0, lane]
        factor(matrix_out, held_out, world, order, total, real(wp.static(dependent)))

    @wp.kernel(module=module, enable_backward=False)
    def solve_again(
        rows: int,
        order: int,
        # Workspace in
        count_in: wp.array3d(dtype=wp.int32),
        delassus_in: wp.array3d(dtype=real),
        compliance_in: wp.array3d(dtype=real),
        softness_in: wp.array3d(dtype=real),
        active_in: wp.array3d(dtype=wp.int32),
        mode_in: wp.array3d(dtype=real),
        mu_in: wp.array3d(dtype=real),
        gap_in: wp.array3d(dtype=real),
        offset_in: wp.array3d(dtype=real),
        matrix_in: wp.array3d(dtype=real),
        # Workspace out
        held_out: wp.array3d(dtype=real),
        change_out: wp.array3d(dtype=real),
        q_out: wp.array3d(dtype=real),
        z_out: wp.array3d(dtype=real),
        unsure_out: wp.array3d(dtype=wp.int32),
    ):
        """The last step of ``solve`` on a CPU, for which factors serve as long as nothing else changes."""
        pack, lane = wp.tid()
        world = pack * gap_in.shape[2] + lane
        total = rows + 3 * count_in[pack, 0, lane]
        scale = real(0.0)
        for i in range(total):
            right, _own, _first, _second, _unit, _pressed = terms(
                compliance_in,
                softness_in,
                active_in,
                mode_in,
                mu_in,
                gap_in,
                offset_in,
                z_out,
                pack,
                lane,
                rows,
                i,
            )
            known = real(0.0)
            if i >= rows:
                known = delassus_in[pack, i * order + i, lane] * z_out[pack, i - rows, lane]
            largest = held_out[world, wp.static(elimination.LARGEST) * order + i, 0]
            if largest > real(0.0):
                right = right / largest
                known = known / largest
            held_out[world, wp.static(elimination.RIGHT) * order + i, 0] = right
            scale = wp.max(scale, wp.max(wp.abs(right), wp.abs(known)))
        if eliminate(matrix_in, held_out, world, order, total, real(wp.static(unsolved)) * scale) != 0:
            unsure_out[pack, 0, lane] = 1
        for i in range(total):
            value = held_out[world, wp.static(elimination.RIGHT) * order + i, 0]
            value = value * held_out[world, wp.static(elimination.UNIT) * order + i, 0]
            change_out[pack, i, lane] = value
            if i < rows:
                q_out[pack, i, lane] = q_out[pack, i, lane] + value
            else:
                z_out[pack, i - rows, lane] = z_out[pack, i - rows, lane] + value
        for i in range(total, order):
            change_out[pack, i, lane] = real(0.0)

    on_cpu = {
        "note_equations": note_equations,
        "fill_matrices": fill_matrices,
        "factor_matrix": factor_matrix,
        "solve_again": solve_again,
    }
    return SimpleNamespace(**vars(result), **on_cpu)
