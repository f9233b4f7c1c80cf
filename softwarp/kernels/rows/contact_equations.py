"""Equations for z of contacts, beside q of static rows, in the adjoint of a step. Theory: docs/theory/adjoint.md.

W of all rows is eliminated with pivots, as it is not symmetric where contacts slip. One thread notes what the equations
of a world are made of, others write them, one factors them, and one solves with the factors, which serve again.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.rows import elimination

UNSOLVED = {
    wp.float64: 1.0e-7,
    wp.float32: 1.0e-3,
}  # relative size of what rounding may leave of equations that repeat others
DEPENDENT = {wp.float64: 1.0e-13, wp.float32: 1.0e-6}  # relative pivot of a row that repeats others


@single_worlds
def kernels(variant: Variant, forward: bool = False) -> SimpleNamespace:
    """Kernels for one scalar type, on single worlds: (pack, row, lane).

    Matrices and numbers of rows are those of ``elimination``.

    Args:
        variant: Scalar type and memory order.
        forward: Solve for the change -z of forces instead, whose equations are the transposed ones.
    """
    real, world_fastest = variant.real, variant.world_fastest
    module = variant.module("directional.laws" if forward else "adjoint.laws")
    dependent, unsolved = DEPENDENT[real], UNSOLVED[real]
    of_world = elimination.functions(variant)
    write_equations, factor, eliminate = of_world.write_equations, of_world.factor, of_world.solve

    @wp.func
    def place_of(pack: int, lane: int, lanes: int):
        """Where a world's matrix is."""
        if wp.static(world_fastest):
            return 0, lane
        return pack * lanes + lane, 0

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
    def unit_of(delassus: wp.array3d(dtype=real), pack: int, lane: int, order: int, i: int):
        """Of one unknown, in which rows of pressures, tensions and contacts have pivots that compare."""
        own = delassus[pack, i * order + i, lane]
        return wp.where(own > real(0.0), real(1.0) / wp.sqrt(own), real(1.0))

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
        """What the equations of one world are made of."""
        pack, lane = wp.tid()
        w, place = place_of(pack, lane, gap_in.shape[2])
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
            held_out[w, wp.static(elimination.UNIT) * order + i, place] = unit_of(delassus_in, pack, lane, order, i)
            held_out[w, wp.static(elimination.OWN) * order + i, place] = own
            held_out[w, wp.static(elimination.FIRST) * order + i, place] = first
            held_out[w, wp.static(elimination.SECOND) * order + i, place] = second
            held_out[w, wp.static(elimination.DIAGONAL) * order + i, place] = unit
            held_out[w, wp.static(elimination.PRESSED) * order + i, place] = pressed

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
        """Equations of all worlds of a pack, whose numbers of W stand side by side; on a GPU one of one world."""
        pack, item = wp.tid()
        if wp.static(world_fastest):
            item, pack = wp.tid()
        write_equations(delassus_in, count_in, held_in, pack, item, rows, order, matrix_out)

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
        w, place = place_of(pack, lane, count_in.shape[2])
        total = rows + 3 * count_in[pack, 0, lane]
        factor(matrix_out, held_out, w, place, order, total, real(wp.static(dependent)))

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
        """Changes of q and z, and their sums; rows that repeat others get none.

        Factors serve as long as nothing but the right-hand sides changes. Where equations that repeat others contradict
        them, as contacts that slip and share a load in many ways with other friction may, nothing solves them:
        ``unsure``.
        """
        pack, lane = wp.tid()
        w, place = place_of(pack, lane, gap_in.shape[2])
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
            largest = held_out[w, wp.static(elimination.LARGEST) * order + i, place]
            if largest > real(0.0):
                right = right / largest
                known = known / largest
            held_out[w, wp.static(elimination.RIGHT) * order + i, place] = right
            scale = wp.max(scale, wp.max(wp.abs(right), wp.abs(known)))
        if eliminate(matrix_in, held_out, w, place, order, total, real(wp.static(unsolved)) * scale) != 0:
            unsure_out[pack, 0, lane] = 1
        for i in range(total):
            value = held_out[w, wp.static(elimination.RIGHT) * order + i, place]
            value = value * held_out[w, wp.static(elimination.UNIT) * order + i, place]
            change_out[pack, i, lane] = value
            if i < rows:
                q_out[pack, i, lane] = q_out[pack, i, lane] + value
            else:
                z_out[pack, i - rows, lane] = z_out[pack, i - rows, lane] + value
        for i in range(total, order):
            change_out[pack, i, lane] = real(0.0)

    return SimpleNamespace(
        note_equations=note_equations,
        fill_matrices=fill_matrices,
        factor_matrix=factor_matrix,
        solve_again=solve_again,
    )
