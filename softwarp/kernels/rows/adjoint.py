"""Adjoint of rows in a step, and of cables; ``cavity_adjoint`` has that of chambers. Theory: docs/theory/adjoint.md.

Rows that were between their bounds obey d + h H v + C T = target; with s = y_v + h y_x on the right their adjoint is

    A p + h H' q = s,   -h H p + C q = y_T   or   (W + C) q = y_T + h H A^-1 s,   W = h^2 H A^-1 H',

with q = 0 in rows whose force was at a bound, which passes y_T + h H p on to that bound instead. At a switch this is
one of the one-sided gradients. Rows depend on positions through d and H = dd/dx, which adds

    d2d/dx2 [h T p - h q v] - q H

by points. An equilibrium has the same equations with h = 1, v = 0 and the exact tangent, transposed, for A; there
W = H A^-1 H' need not be symmetric. All arrays but those of the state are single worlds': (pack, row, lane).
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import wide
from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.algebra.vectors import algebra

DEPENDENT = {wp.float64: 1.0e-12, wp.float32: 1.0e-6}  # relative pivot of a row that repeats others


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type and memory order."""
    real = variant.real
    module = variant.module("adjoint.rows")
    dependent = DEPENDENT[real]

    @wp.kernel(module=module, enable_backward=False)
    def activity(
        margin: real,
        # Workspace in
        lower_in: wp.array3d(dtype=real),
        upper_in: wp.array3d(dtype=real),
        multiplier_in: wp.array3d(dtype=real),
        # Workspace out
        active_out: wp.array3d(dtype=wp.int32),
    ):
        """Whether one row's force was between its bounds, by more than a ``margin`` of its size."""
        pack, row, lane = wp.tid()
        force = multiplier_in[pack, row, lane]
        slack = margin * wp.abs(force)
        is_active = force > lower_in[pack, row, lane] + slack and force < upper_in[pack, row, lane] - slack
        active_out[pack, row, lane] = wp.where(is_active, 1, 0)

    @wp.kernel(module=module, enable_backward=False)
    def compliant(
        # Workspace in
        compliance_in: wp.array3d(dtype=real),
        q_in: wp.array3d(dtype=real),
        # Workspace out
        out_out: wp.array3d(dtype=real),
    ):
        """C q of one row."""
        pack, row, lane = wp.tid()
        out_out[pack, row, lane] = compliance_in[pack, row, lane] * q_in[pack, row, lane]

    @wp.kernel(module=module, enable_backward=False)
    def solve(
        count: int,
        # Workspace in
        delassus_in: wp.array3d(dtype=real),
        compliance_in: wp.array3d(dtype=real),
        active_in: wp.array3d(dtype=wp.int32),
        gap_in: wp.array3d(dtype=real),
        # Workspace out
        factor_out: wp.array3d(dtype=real),
        change_out: wp.array3d(dtype=real),
        q_out: wp.array3d(dtype=real),
    ):
        """Solve (W + C) change = gap among active rows by Cholesky; q += change. Rows that repeat others get none."""
        pack, lane = wp.tid()
        for i in range(count):
            value = real(0.0)
            if active_in[pack, i, lane] != 0:
                value = gap_in[pack, i, lane]
            for j in range(i):
                entry = real(0.0)
                if active_in[pack, i, lane] != 0 and active_in[pack, j, lane] != 0:
                    entry = delassus_in[pack, i * count + j, lane]
                for k in range(j):
                    entry -= factor_out[pack, i * count + k, lane] * factor_out[pack, j * count + k, lane]
                entry = entry * factor_out[pack, j * count + j, lane]
                factor_out[pack, i * count + j, lane] = entry
                value -= entry * change_out[pack, j, lane]
            whole = delassus_in[pack, i * count + i, lane] + compliance_in[pack, i, lane]
            pivot = whole
            for k in range(i):
                pivot -= factor_out[pack, i * count + k, lane] * factor_out[pack, i * count + k, lane]
            inverse = real(0.0)
            if active_in[pack, i, lane] != 0 and pivot > real(wp.static(dependent)) * whole:
                inverse = real(1.0) / wp.sqrt(pivot)
            factor_out[pack, i * count + i, lane] = inverse
            change_out[pack, i, lane] = value * inverse
        for back in range(count):
            i = count - 1 - back
            value = change_out[pack, i, lane]
            for k in range(i + 1, count):
                value -= factor_out[pack, k * count + i, lane] * change_out[pack, k, lane]
            value = value * factor_out[pack, i * count + i, lane]
            change_out[pack, i, lane] = value
            q_out[pack, i, lane] = q_out[pack, i, lane] + value

    @wp.kernel(module=module, enable_backward=False)
    def eliminate(
        count: int,
        # Workspace in
        delassus_in: wp.array3d(dtype=real),
        compliance_in: wp.array3d(dtype=real),
        active_in: wp.array3d(dtype=wp.int32),
        gap_in: wp.array3d(dtype=real),
        # Workspace out
        matrix_out: wp.array3d(dtype=real),
        change_out: wp.array3d(dtype=real),
        q_out: wp.array3d(dtype=real),
    ):
        """Solve (W + C) q = gap among active rows, W not symmetric, by Gauss' elimination; ``change`` is -q."""
        pack, lane = wp.tid()
        for i in range(count):
            for j in range(count):
                entry = wp.where(i == j, real(1.0), real(0.0))
                if active_in[pack, i, lane] != 0 and active_in[pack, j, lane] != 0:
                    entry = delassus_in[pack, count * i + j, lane]
                    if i == j:
                        entry += compliance_in[pack, i, lane]
                matrix_out[pack, count * i + j, lane] = entry
            change_out[pack, i, lane] = wp.where(active_in[pack, i, lane] != 0, -gap_in[pack, i, lane], real(0.0))
        for k in range(count):
            for i in range(k + 1, count):
                factor = matrix_out[pack, count * i + k, lane] / matrix_out[pack, count * k + k, lane]
                for j in range(k + 1, count):
                    entry = matrix_out[pack, count * i + j, lane] - factor * matrix_out[pack, count * k + j, lane]
                    matrix_out[pack, count * i + j, lane] = entry
                change_out[pack, i, lane] = change_out[pack, i, lane] - factor * change_out[pack, k, lane]
        for back in range(count):
            i = count - 1 - back
            value = change_out[pack, i, lane]
            for j in range(i + 1, count):
                value -= matrix_out[pack, count * i + j, lane] * change_out[pack, j, lane]
            value = value / matrix_out[pack, count * i + i, lane]
            change_out[pack, i, lane] = value
            q_out[pack, i, lane] = -value

    @wp.kernel(module=module, enable_backward=False)
    def bounds(
        # Workspace in
        gap_in: wp.array3d(dtype=real),
        active_in: wp.array3d(dtype=wp.int32),
        # Workspace out
        bound_bar_out: wp.array3d(dtype=real),
    ):
        """Gradient by the bound of one row, from y_T + h H p of ``gaps``; 0 between bounds."""
        pack, row, lane = wp.tid()
        bound_bar_out[pack, row, lane] = wp.where(active_in[pack, row, lane] == 0, gap_in[pack, row, lane], real(0.0))

    @wp.kernel(module=module, enable_backward=False)
    def cable_seed(
        lanes: int,
        # State
        tension_bar_in: wp.array2d(dtype=real),
        # Workspace out
        force_bar_out: wp.array3d(dtype=real),
    ):
        """y_T of one cable."""
        pack, cable, lane = wp.tid()
        world = wp.min(pack * lanes + lane, tension_bar_in.shape[0] - 1)
        force_bar_out[pack, cable, lane] = tension_bar_in[world, cable]

    @wp.kernel(module=module, enable_backward=False)
    def cable_command(
        lapse: real,
        lanes: int,
        is_stage: bool,
        # Model
        cable_force_control: wp.array(dtype=wp.int32),
        cable_stretches: wp.array(dtype=wp.int32),
        # Workspace in
        displacement_command_in: wp.array3d(dtype=real),
        tension_command_in: wp.array3d(dtype=real),
        min_displacement_in: wp.array3d(dtype=real),
        max_displacement_in: wp.array3d(dtype=real),
        min_tension_in: wp.array3d(dtype=real),
        max_tension_in: wp.array3d(dtype=real),
        max_rate_in: wp.array3d(dtype=real),
        displacement_in: wp.array3d(dtype=real),
        lag_in: wp.array3d(dtype=real),
        multiplier_in: wp.array3d(dtype=real),
        lower_in: wp.array3d(dtype=real),
        upper_in: wp.array3d(dtype=real),
        q_in: wp.array3d(dtype=real),
        bound_bar_in: wp.array3d(dtype=real),
        # State out
        displacement_bar_out: wp.array2d(dtype=real),
        command_bar_out: wp.array2d(dtype=real),
        tension_bar_out: wp.array2d(dtype=real),
        # Workspace out
        measured_out: wp.array3d(dtype=real),
        start_out: wp.array3d(dtype=real),
    ):
        """Gradients by the commands of one cable, and ``measured``, the factor of H in the gradient by positions.

        A command counts where no limit and no rate in the time ``lapse`` [s] overrules it; a target that a rate has
        bounded moves with the measured displacement, and so does the part ``lag_in`` of the way that later stages are
        left with. A stage measures where it starts and has its rows elsewhere: ``start`` is the factor of H there. The
        tension at the start of a step is a first guess only, which nothing depends on.
        """
        pack, cable, lane = wp.tid()
        world = pack * lanes + lane
        none = real(0.0)
        q = q_in[pack, cable, lane]
        by_displacement = none
        by_tension = none
        start = none
        if cable_force_control[cable] != 0:
            command = tension_command_in[pack, cable, lane]
            is_free = command >= min_tension_in[pack, cable, lane] and command <= max_tension_in[pack, cable, lane]
            force = multiplier_in[pack, cable, lane]
            if is_free and upper_in[pack, cable, lane] - force <= force - lower_in[pack, cable, lane]:
                by_tension = bound_bar_in[pack, cable, lane]
        else:
            command = displacement_command_in[pack, cable, lane]
            low = min_displacement_in[pack, cable, lane]
            high = max_displacement_in[pack, cable, lane]
            lag = none
            if cable_stretches[cable] == 0:
                lag = lag_in[pack, 0, lane]
            way = wp.min(wp.max(command, low), high) - displacement_in[pack, cable, lane]
            way = way - lag * way
            if wp.abs(way) > max_rate_in[pack, cable, lane] * lapse:
                start = q
            else:
                start = lag * q
                if command >= low and command <= high:
                    by_displacement = q - start
        start_out[pack, cable, lane] = start
        measured_out[pack, cable, lane] = wp.where(is_stage, -q, start - q)
        if world < command_bar_out.shape[0]:
            displacement_bar_out[world, cable] = by_displacement
            command_bar_out[world, cable] = by_tension
            tension_bar_out[world, cable] = none

    @wp.kernel(module=module, enable_backward=False)
    def cable_stretch(
        lapse: real,
        lanes: int,
        is_stage: bool,
        # Model
        cable_force_control: wp.array(dtype=wp.int32),
        # Workspace in
        stiffness_in: wp.array3d(dtype=real),
        damping_in: wp.array3d(dtype=real),
        compliance_in: wp.array3d(dtype=real),
        target_in: wp.array3d(dtype=real),
        displacement_in: wp.array3d(dtype=real),
        multiplier_in: wp.array3d(dtype=real),
        q_in: wp.array3d(dtype=real),
        # State out
        displacement_bar_out: wp.array2d(dtype=real),
        stiffness_bar_out: wp.array2d(dtype=real),
        damping_bar_out: wp.array2d(dtype=real),
        # Workspace out
        measured_out: wp.array3d(dtype=real),
        start_out: wp.array3d(dtype=real),
    ):
        """Turn the gradients of one cable's command into those of an elastic one, and add those by its constants.

        With the rate r = c / ``lapse``, C = 1 / (k + r) and the target D of a cable that does not stretch, its row has
        the target d + k C (D - d) and the compliance C; d is that of the start in a stage.
        """
        pack, cable, lane = wp.tid()
        world = pack * lanes + lane
        if cable_force_control[cable] == 0:
            C = compliance_in[pack, cable, lane]
            k = stiffness_in[pack, cable, lane]
            rate = damping_in[pack, cable, lane] / lapse
            way = (target_in[pack, cable, lane] - displacement_in[pack, cable, lane]) / (k * C)  # D - d
            by_square = q_in[pack, cable, lane] * C * C
            if is_stage:
                start_out[pack, cable, lane] = q_in[pack, cable, lane] * (real(1.0) - k * C) + start_out[
                    pack, cable, lane
                ] * (k * C)
            else:
                measured_out[pack, cable, lane] = measured_out[pack, cable, lane] * k * C
            if world < stiffness_bar_out.shape[0]:
                force = multiplier_in[pack, cable, lane]
                by_k = by_square * (force + rate * way)
                by_c = by_square * (force - k * way) / lapse
                displacement_bar_out[world, cable] = displacement_bar_out[world, cable] * k * C
                stiffness_bar_out[world, cable] = stiffness_bar_out[world, cable] + by_k
                damping_bar_out[world, cable] = damping_bar_out[world, cable] + by_c

    @wp.kernel(module=module, enable_backward=False)
    def rest_lengths(
        lanes: int,
        is_stage: bool,
        # Workspace in
        measured_in: wp.array3d(dtype=real),
        start_in: wp.array3d(dtype=real),
        # State out
        length_bar_out: wp.array2d(dtype=real),
    ):
        """Add the gradient by the rest length of one cable, which its displacement grows with."""
        pack, cable, lane = wp.tid()
        world = pack * lanes + lane
        if world < length_bar_out.shape[0]:
            total = measured_in[pack, cable, lane]
            if is_stage:
                total += start_in[pack, cable, lane]
            length_bar_out[world, cable] = length_bar_out[world, cable] + total

    return SimpleNamespace(
        rest_lengths=rest_lengths,
        activity=activity,
        compliant=compliant,
        solve=solve,
        eliminate=eliminate,
        bounds=bounds,
        cable_seed=cable_seed,
        cable_command=cable_command,
        cable_stretch=cable_stretch,
    )


PIECE = 96  # numbers of a vector that meet all rows of a matrix before the next ones


@wp.func_native("""
typedef float wide_t __attribute__((vector_size(64)));
const float* a = &wp::index(matrix, w, begin);
const float* x = &wp::index(vector, w, 0);
wide_t sum = {}, p, q;
int k = first;
for (; k + 16 <= last; k += 16) {
    __builtin_memcpy(&p, a + k, sizeof(p));
    __builtin_memcpy(&q, x + k, sizeof(q));
    sum += p * q;
}
float total = 0.0f;
for (int i = 0; i < 8; ++i) total += sum[i] + sum[8 + i];
for (; k < last; ++k) total += a[k] * x[k];
return total;
""")
def _one_row(
    matrix: wp.array2d(dtype=wp.float32),
    vector: wp.array2d(dtype=wp.float32),
    w: int,
    begin: int,
    first: int,
    last: int,
) -> wp.float32:
    """Product of numbers of a vector with those of a matrix from ``begin`` on."""


@wp.func_native("""
typedef float wide_t __attribute__((vector_size(64)));
const float* a = &wp::index(matrix, w, 0);
const float* c = &wp::index(factor, w, 0);
float* y = &wp::index(vector_out, w, 0);
wide_t sum, p;
int k = 0;
for (; k + 16 <= count; k += 16) {
    __builtin_memcpy(&sum, y + k, sizeof(sum));
    for (int r = 0; r < rows; ++r) {
        __builtin_memcpy(&p, a + count * r + k, sizeof(p));
        sum += p * (scale * c[r]);
    }
    __builtin_memcpy(y + k, &sum, sizeof(sum));
}
for (; k < count; ++k)
    for (int r = 0; r < rows; ++r) y[k] += a[count * r + k] * (scale * c[r]);
""")
def _add_rows(
    vector_out: wp.array2d(dtype=wp.float32),
    matrix: wp.array2d(dtype=wp.float32),
    factor: wp.array2d(dtype=wp.float32),
    w: int,
    rows: int,
    count: int,
    scale: wp.float32,
):
    """Add rows of a matrix, of ``count`` numbers each, times factors to a vector."""


@cache
def element_kernels(variant: Variant) -> SimpleNamespace:
    """Kernels on the elements of a variant, (w, row)."""
    S, real, world_fastest = variant.S, variant.real, variant.world_fastest
    mul, fma, div, sqrt, select = variant.mul, variant.fma, variant.div, variant.sqrt, variant.select
    is_wide = wide.is_wide(variant)
    module = variant.module("adjoint.row_elements")
    a = algebra(variant)
    read_vector, write_vector = a.read_vector, a.write_vector
    add, subtract, scaled, dot = a.add, a.subtract, a.scaled, a.dot

    @wp.kernel(module=module, enable_backward=False)
    def gaps(
        h: real,
        # Model
        row_entry_start: wp.array(dtype=wp.int32),
        entry_dof: wp.array(dtype=wp.int32),
        # Workspace in
        row_in: wp.array2d(dtype=S),
        dof_p_in: wp.array2d(dtype=S),
        compliance_in: wp.array2d(dtype=S),
        force_bar_in: wp.array2d(dtype=S),
        q_in: wp.array2d(dtype=S),
        # Workspace out
        gap_out: wp.array2d(dtype=S),
    ):
        """What p and q leave of the equation of one row, y_T + h H p - C q."""
        w, row = wp.tid()
        if wp.static(world_fastest):
            row, w = wp.tid()
        value = S(real(0.0))
        for entry in range(row_entry_start[row], row_entry_start[row + 1]):
            dof = 3 * entry_dof[entry]
            for c in range(3):
                value = fma(row_in[w, 3 * entry + c], dof_p_in[w, dof + c], value)
        known = force_bar_in[w, row] - mul(compliance_in[w, row], q_in[w, row])
        gap_out[w, row] = known + value * h

    @wp.func
    def product(matrix: wp.array2d(dtype=S), vector: wp.array2d(dtype=S), w: int, begin: int, first: int, last: int):
        """Sum of the products of numbers, as many as a multiple of three, of a vector with those of a matrix."""
        x = S(real(0.0))
        y = S(real(0.0))
        z = S(real(0.0))
        for k in range(first, last, 3):
            x = fma(matrix[w, begin + k], vector[w, k], x)
            y = fma(matrix[w, begin + k + 1], vector[w, k + 1], y)
            z = fma(matrix[w, begin + k + 2], vector[w, k + 2], z)
        return x + y + z

    @wp.kernel(module=module, enable_backward=False)
    def half_gaps(
        h: real,
        size: int,
        count: int,
        # Workspace in
        half_in: wp.array2d(dtype=S),
        y_in: wp.array2d(dtype=S),
        force_bar_in: wp.array2d(dtype=S),
        # Workspace out
        gap_out: wp.array2d(dtype=S),
    ):
        """y_T + h H A^-1 y of a row, from half-solved sides of the rows and y itself, of ``size`` numbers.

        On a CPU of all rows, some numbers of y after the other, which are then at hand.
        """
        w, part = wp.tid()
        if wp.static(world_fastest):
            part, w = wp.tid()
            gap_out[w, part] = force_bar_in[w, part] + product(half_in, y_in, w, size * part, 0, size) * h
        else:
            for row in range(count):
                gap_out[w, row] = force_bar_in[w, row]
            for first in range(0, size, wp.static(PIECE)):
                last = wp.min(first + wp.static(PIECE), size)
                for row in range(count):
                    if wp.static(is_wide):
                        gap_out[w, row] += _one_row(half_in, y_in, w, size * row, first, last) * h
                    else:
                        gap_out[w, row] += product(half_in, y_in, w, size * row, first, last) * h

    @wp.kernel(module=module, enable_backward=False)
    def add_halves(
        scale: real,
        size: int,
        count: int,
        # Workspace in
        half_in: wp.array2d(dtype=S),
        change_in: wp.array2d(dtype=S),
        # Workspace out
        y_out: wp.array2d(dtype=S),
    ):
        """Add half-solved sides of ``count`` rows times their changes and ``scale`` to y; on a CPU, all numbers."""
        w, part = wp.tid()
        if wp.static(is_wide):
            _add_rows(y_out, half_in, change_in, w, count, size, scale)
        else:
            last = size
            if wp.static(world_fastest):
                part, w = wp.tid()
                last = part + 1
            for k in range(part, last):
                value = y_out[w, k]
                for row in range(count):
                    value = fma(half_in[w, size * row + k], change_in[w, row] * scale, value)
                y_out[w, k] = value

    @wp.func
    def segment(x: wp.array2d(dtype=S), way: wp.array2d(dtype=S), w: int, last: int, closing: S):
        """Change of the gradient at the first point of the cable segment that ends in point ``last``, by the ways."""
        d = subtract(read_vector(x, w, 3 * last), read_vector(x, w, 3 * last - 3))
        change = subtract(read_vector(way, w, 3 * last), read_vector(way, w, 3 * last - 3))
        length = sqrt(dot(d, d))
        inverse = div(S(real(1.0)), wp.max(length, closing))
        u = scaled(d, inverse)
        along = select(closing - length, S(real(0.0)), dot(u, change))
        return scaled(subtract(change, scaled(u, along)), inverse)

    @wp.kernel(module=module, enable_backward=False)
    def cable_points(
        # Model
        cable_point_start: wp.array(dtype=wp.int32),
        point_cable: wp.array(dtype=wp.int32),
        cable_closing_length: wp.array(dtype=real),
        # Workspace in
        point_x_in: wp.array2d(dtype=S),
        point_gradient_in: wp.array2d(dtype=S),
        way_in: wp.array2d(dtype=S),
        measured_in: wp.array2d(dtype=S),
        # Workspace out
        point_bar_out: wp.array2d(dtype=S),
    ):
        """Gradient by one point of a cable."""
        w, point = wp.tid()
        if wp.static(world_fastest):
            point, w = wp.tid()
        cable = point_cable[point]
        closing = S(cable_closing_length[cable])
        total = scaled(read_vector(point_gradient_in, w, 3 * point), measured_in[w, cable])
        if point > cable_point_start[cable]:
            total = subtract(total, segment(point_x_in, way_in, w, point, closing))
        if point + 1 < cable_point_start[cable + 1]:
            total = add(total, segment(point_x_in, way_in, w, point + 1, closing))
        write_vector(point_bar_out, w, 3 * point, total)

    return SimpleNamespace(gaps=gaps, half_gaps=half_gaps, add_halves=add_halves, cable_points=cable_points)
