"""Last millimetres of inverse control, by the exact tangent in equilibrium. Theory: docs/theory/settling.md.

With Z = A^-1 H' of all rows, sides 1 .. count of the linear solver, D = H Z is the compliance of the rows and E = H_e Z
what efforts do to effectors. Rows whose length is commanded and which are taut keep their lengths, so that commands
s of these lengths move the effectors by J s, J = E_T D_TT^-1. Tensions T are the slope of the elastic energy along s:
what of them J' does not span is co-contraction, which holds no effector; where it keeps one from arriving, it is let
go.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.model.codes import Outcome

GAIN = 0.15  # part of the distance that is asked for in a period; larger ones excite what responds slowly
LATE = 8  # times the patience, after which co-contraction is let go
RELEASE = 0.05  # part of the cables' compliance in a step by which co-contraction lengthens them in a period
LONGEST = 0.1  # part of the longest way of effectors that this lengthens a cable at most
DAMPING = 0.05  # added to the squared motion of an effector per motion of the cables
LEAST_TENSION = 1.0e-3  # N; below it a cable does not count as taut


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels of single worlds; what decides on commands is float64."""
    real = wp.float64
    narrow = variant.real
    module = variant.module("settling")

    @wp.kernel(module=module, enable_backward=False)
    def multiply(
        factor: narrow,
        # Workspace out
        value_out: wp.array3d(dtype=narrow),
    ):
        """value <- factor value."""
        pack, row, lane = wp.tid()
        value_out[pack, row, lane] = factor * value_out[pack, row, lane]

    @wp.kernel(module=module, enable_backward=False)
    def effector_response(
        size: int,
        sides: int,
        # Model
        entry_start: wp.array(dtype=wp.int32),
        entry_dof: wp.array(dtype=wp.int32),
        # Workspace in
        row_in: wp.array3d(dtype=narrow),
        y_in: wp.array3d(dtype=narrow),
        # Workspace out
        effect_out: wp.array3d(dtype=narrow),
    ):
        """Motion of one effector row by every side, entry ``sides row + side``: side 0 is free motion, the others E."""
        pack, row, lane = wp.tid()
        effector = row // 3
        axis = row % 3
        for side in range(sides):
            total = narrow(0.0)
            for entry in range(entry_start[effector], entry_start[effector + 1]):
                for c in range(3):
                    y = y_in[pack, 3 * (size * side + entry_dof[entry]) + c, lane]
                    total += row_in[pack, 9 * entry + 3 * axis + c, lane] * y
            effect_out[pack, sides * row + side, lane] = total

    @wp.kernel(module=module, enable_backward=False)
    def spread(
        count: int,
        order: int,
        # Workspace in
        gap_in: wp.array3d(dtype=narrow),
        compliance_in: wp.array3d(dtype=narrow),
        effect_in: wp.array3d(dtype=narrow),
        # Workspace out
        matrix_out: wp.array3d(dtype=narrow),
        gap_out: wp.array3d(dtype=narrow),
    ):
        """Columns of the actuators in W, and free gaps; those of effectors are the present ones so far."""
        pack, row, lane = wp.tid()
        for j in range(count):
            if row < count:
                matrix_out[pack, row * order + j, lane] = compliance_in[pack, count * row + j, lane]
            else:
                effect = effect_in[pack, (1 + count) * (row - count) + 1 + j, lane]
                matrix_out[pack, row * order + j, lane] = effect
        if row < count:
            gap_out[pack, row, lane] = gap_in[pack, row, lane]
        else:
            gap_out[pack, row, lane] = gap_out[pack, row, lane] + effect_in[pack, (1 + count) * (row - count), lane]

    @wp.kernel(module=module, enable_backward=False)
    def wait(
        world_count: int,
        values: int,
        # Control
        target_in: wp.array2d(dtype=narrow),
        # Workspace out
        seen_out: wp.array2d(dtype=narrow),
        still_out: wp.array2d(dtype=wp.int32),
    ):
        """Count the calls since the target of a world moved."""
        w = wp.tid()
        moved = bool(False)
        for k in range(values):
            moved = moved or seen_out[w, k] != target_in[w, k]
            seen_out[w, k] = target_in[w, k]
        still_out[w, 0] = wp.where(moved, 0, still_out[w, 0] + 1)

    @wp.func
    def solve(
        matrix: wp.array2d(dtype=real),
        sides: wp.array2d(dtype=real),
        w: int,
        n: int,
        stride: int,
        count: int,
        width: int,
    ):
        """sides <- matrix^-1 sides by Gauss elimination with pivots, both row by row, for ``count`` sides."""
        for k in range(n):
            best = int(k)
            for i in range(k + 1, n):
                if wp.abs(matrix[w, i * stride + k]) > wp.abs(matrix[w, best * stride + k]):
                    best = i
            for j in range(n):
                held = matrix[w, k * stride + j]
                matrix[w, k * stride + j] = matrix[w, best * stride + j]
                matrix[w, best * stride + j] = held
            for s in range(count):
                held = sides[w, k * width + s]
                sides[w, k * width + s] = sides[w, best * width + s]
                sides[w, best * width + s] = held
            pivot = matrix[w, k * stride + k]
            for i in range(n):
                if i != k:
                    factor = matrix[w, i * stride + k] / pivot
                    for j in range(k, n):
                        matrix[w, i * stride + j] -= factor * matrix[w, k * stride + j]
                    for s in range(count):
                        sides[w, i * width + s] -= factor * sides[w, k * width + s]
        for k in range(n):
            for s in range(count):
                sides[w, k * width + s] = sides[w, k * width + s] / matrix[w, k * stride + k]

    @wp.kernel(module=module, enable_backward=False)
    def sensitivity(
        count: int,
        effector_rows: int,
        world_count: int,
        # Model
        force_control: wp.array(dtype=wp.int32),
        effector_weight: wp.array(dtype=real),
        # Workspace in
        compliance_in: wp.array3d(dtype=narrow),
        effect_in: wp.array3d(dtype=narrow),
        multiplier_in: wp.array3d(dtype=narrow),
        # Workspace out
        matrix_out: wp.array2d(dtype=real),
        motion_out: wp.array2d(dtype=real),
    ):
        """J' of the taut cables under length control, entry ``effector_rows cable + row``; zero for the others."""
        pack, lane = wp.tid()
        w = pack * compliance_in.shape[2] + lane
        if w >= world_count:
            return
        for i in range(count):
            taut = force_control[i] == 0 and real(multiplier_in[pack, i, lane]) > real(wp.static(LEAST_TENSION))
            for j in range(count):
                other = force_control[j] == 0 and real(multiplier_in[pack, j, lane]) > real(wp.static(LEAST_TENSION))
                entry = real(compliance_in[pack, count * j + i, lane])
                unit = wp.where(i == j, real(1.0), real(0.0))
                matrix_out[w, i * count + j] = wp.where(taut and other, entry, unit)
            for e in range(effector_rows):
                motion = effector_weight[e] * real(effect_in[pack, (1 + count) * e + 1 + i, lane])
                motion_out[w, i * effector_rows + e] = wp.where(taut, motion, real(0.0))
        solve(matrix_out, motion_out, w, count, count, effector_rows, effector_rows)

    @wp.func
    def project(
        motion: wp.array2d(dtype=real),
        factor: wp.array2d(dtype=real),
        w: int,
        row: int,
        effector_rows: int,
        side: int,
    ):
        """Entry of J' v for one cable, v one side of ``factor``."""
        total = real(0.0)
        for e in range(effector_rows):
            total += motion[w, row * effector_rows + e] * factor[w, 2 * e + side]
        return total

    @wp.func
    def surplus(
        tension: real,
        motion: wp.array2d(dtype=real),
        factor: wp.array2d(dtype=real),
        w: int,
        row: int,
        effector_rows: int,
    ):
        """Part of a taut cable's tension that holds no effector [N]."""
        held = project(motion, factor, w, row, effector_rows, 1)
        return wp.where(tension > real(wp.static(LEAST_TENSION)), tension - held, real(0.0))

    @wp.kernel(module=module, enable_backward=False)
    def settle(
        n: int,
        effector_rows: int,
        world_count: int,
        patience: int,
        radius: real,
        tolerance: real,
        max_step: real,
        # Model
        actuator_row: wp.array(dtype=wp.int32),
        effector_weight: wp.array(dtype=real),
        # Workspace in
        error_in: wp.array3d(dtype=narrow),
        multiplier_in: wp.array3d(dtype=narrow),
        given_in: wp.array3d(dtype=narrow),
        low_in: wp.array3d(dtype=narrow),
        high_in: wp.array3d(dtype=narrow),
        compliance_in: wp.array2d(dtype=real),
        motion_in: wp.array2d(dtype=real),
        still_in: wp.array2d(dtype=wp.int32),
        # Workspace out
        gram_out: wp.array2d(dtype=real),
        side_out: wp.array2d(dtype=real),
        command_out: wp.array2d(dtype=real),
        status_out: wp.array2d(dtype=wp.int32),
    ):
        """Near a target that stands still: commands change by -GAIN J' (J J' + DAMPING)^-1 error.

        Where that has not led there for long, co-contraction is let go besides, the less the nearer the effectors are.
        """
        pack, lane = wp.tid()
        w = pack * error_in.shape[2] + lane
        if w >= world_count or still_in[w, 0] < patience:
            return
        square = real(0.0)
        for e in range(effector_rows):
            error = effector_weight[e] * real(error_in[pack, e, lane])
            square += error * error
            load = real(0.0)
            for f in range(effector_rows):
                total = wp.where(e == f, real(wp.static(DAMPING)), real(0.0))
                for a in range(n):
                    i = actuator_row[a] * effector_rows
                    total += motion_in[w, i + e] * motion_in[w, i + f]
                gram_out[w, e * effector_rows + f] = total
            for a in range(n):
                row = actuator_row[a]
                load += motion_in[w, row * effector_rows + e] * real(multiplier_in[pack, row, lane])
            side_out[w, 2 * e] = error
            side_out[w, 2 * e + 1] = load
        distance = wp.sqrt(square)
        if distance > radius:
            return
        solve(gram_out, side_out, w, effector_rows, effector_rows, 2, 2)
        largest = real(0.0)
        total = real(0.0)
        for a in range(n):
            row = actuator_row[a]
            spare = surplus(real(multiplier_in[pack, row, lane]), motion_in, side_out, w, row, effector_rows)
            largest = wp.max(largest, wp.abs(spare))
            total += spare + project(motion_in, side_out, w, row, effector_rows, 0)
        if not wp.isfinite(total):
            return
        rate = real(0.0)
        for a in range(n):
            rate += real(wp.static(RELEASE)) * compliance_in[w, a * n + a] / real(n)
        is_late = still_in[w, 0] >= wp.static(LATE) * patience and distance > tolerance
        rate = wp.where(is_late, rate * distance / radius, real(0.0))
        rate = wp.min(rate, max_step * real(wp.static(LONGEST)) / wp.max(largest, real(1.0e-300)))
        for a in range(n):
            row = actuator_row[a]
            change = project(motion_in, side_out, w, row, effector_rows, 0)
            command = real(given_in[pack, row, lane]) - real(wp.static(GAIN)) * change
            spare = surplus(real(multiplier_in[pack, row, lane]), motion_in, side_out, w, row, effector_rows)
            command -= rate * spare
            command_out[w, a] = wp.clamp(command, real(low_in[pack, row, lane]), real(high_in[pack, row, lane]))
        status_out[w, 0] = wp.where(distance > tolerance, wp.static(Outcome.MOVING), wp.static(Outcome.REACHED))

    return SimpleNamespace(
        multiply=multiply,
        effector_response=effector_response,
        spread=spread,
        wait=wait,
        sensitivity=sensitivity,
        settle=settle,
    )
