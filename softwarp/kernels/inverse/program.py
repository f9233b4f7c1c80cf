"""The quadratic program of inverse control and a dual active set method for it. Theory: docs/theory/inverse.md.

Unknown are the efforts x of the actuators (multipliers of their rows, [N]). The effectors' gaps are g + E x, the
actuators' displacements d + D x [m]:

    min 1/2 |g + E x|^2 + 1/2 eps s x' D x   with   low_i <= a_i x <= high_i  (+ soft_i times its multiplier),

s = |E'E|_inf / |D|_inf, with rows a_i of the identity (bounds on effort) and of D (bounds on displacement). A soft row
may be violated by its compliance times its multiplier, so that the problem always has a solution; others never are. One
thread solves one world, in double precision, because eps makes E'E + eps s D as ill-conditioned as 1e8.
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.model.codes import FAR_FROM, Outcome

SOLVED, STUCK = 0, 1  # of ``outcome``
TINY = 1.0e-12  # of the largest diagonal entry, added to it: equal actuators share their effort
ACCURACY = 1.0e-9  # violations below this part of the unconstrained solution's size do not count


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one order of memory; all numbers are float64."""
    real = wp.float64
    module = variant.module("inverse")

    @wp.func
    def factor(matrix: wp.array2d(dtype=real), w: int, n: int, stride: int):
        """Cholesky factor of a symmetric matrix in place, lower triangle; pivots that vanish become tiny."""
        for j in range(n):
            pivot = matrix[w, j * stride + j]
            floor = pivot * real(1.0e-14) + real(1.0e-300)
            for k in range(j):
                pivot -= matrix[w, j * stride + k] * matrix[w, j * stride + k]
            pivot = wp.sqrt(wp.max(pivot, floor))
            matrix[w, j * stride + j] = pivot
            for i in range(j + 1, n):
                total = matrix[w, i * stride + j]
                for k in range(j):
                    total -= matrix[w, i * stride + k] * matrix[w, j * stride + k]
                matrix[w, i * stride + j] = total / pivot

    @wp.func
    def forward(
        factor_in: wp.array2d(dtype=real), vector: wp.array2d(dtype=real), w: int, n: int, stride: int, first: int
    ):
        """v <- L^-1 v for the n entries from ``first`` on."""
        for i in range(n):
            total = vector[w, first + i]
            for k in range(i):
                total -= factor_in[w, i * stride + k] * vector[w, first + k]
            vector[w, first + i] = total / factor_in[w, i * stride + i]

    @wp.func
    def backward(
        factor_in: wp.array2d(dtype=real), vector: wp.array2d(dtype=real), w: int, n: int, stride: int, first: int
    ):
        """v <- L^-T v for the n entries from ``first`` on."""
        for back in range(n):
            i = n - 1 - back
            total = vector[w, first + i]
            for k in range(i + 1, n):
                total -= factor_in[w, k * stride + i] * vector[w, first + k]
            vector[w, first + i] = total / factor_in[w, i * stride + i]

    @wp.func
    def dot(a: wp.array2d(dtype=real), a_first: int, b: wp.array2d(dtype=real), b_first: int, w: int, n: int):
        """Scalar product of n entries."""
        total = real(0.0)
        for k in range(n):
            total += a[w, a_first + k] * b[w, b_first + k]
        return total

    @wp.kernel(module=module, enable_backward=False)
    def collect(
        n: int,
        effector_rows: int,
        first_effector: int,
        order: int,
        world_count: int,
        # Model
        actuator_row: wp.array(dtype=wp.int32),
        # Workspace in
        matrix_in: wp.array3d(dtype=variant.real),
        free_gap_in: wp.array3d(dtype=variant.real),
        target_in: wp.array3d(dtype=variant.real),
        multiplier_in: wp.array3d(dtype=variant.real),
        effort_low_in: wp.array2d(dtype=real),
        effort_high_in: wp.array2d(dtype=real),
        way_low_in: wp.array2d(dtype=real),
        way_high_in: wp.array2d(dtype=real),
        # Workspace out
        effort_out: wp.array2d(dtype=real),
        effect_out: wp.array2d(dtype=real),
        compliance_out: wp.array2d(dtype=real),
        way_out: wp.array2d(dtype=real),
        gap_out: wp.array2d(dtype=real),
        low_out: wp.array2d(dtype=real),
        high_out: wp.array2d(dtype=real),
    ):
        """Blocks of W, gaps and bounds of one world, in double precision and for efforts instead of their changes."""
        pack, lane = wp.tid()
        world = pack * matrix_in.shape[2] + lane
        if world >= world_count:
            return
        for i in range(n):
            effort_out[world, i] = real(multiplier_in[pack, actuator_row[i], lane])
        for i in range(n):
            row = actuator_row[i]
            way = real(free_gap_in[pack, row, lane]) + real(target_in[pack, row, lane])
            for j in range(n):
                entry = real(matrix_in[pack, row * order + actuator_row[j], lane])
                compliance_out[world, i * n + j] = entry
                way -= entry * effort_out[world, j]
            way_out[world, i] = way
            low_out[world, i] = effort_low_in[world, i]
            high_out[world, i] = effort_high_in[world, i]
            low_out[world, n + i] = way_low_in[world, i] - way
            high_out[world, n + i] = way_high_in[world, i] - way
        for e in range(effector_rows):
            row = first_effector + e
            brought = real(0.0)
            for i in range(n):
                entry = real(matrix_in[pack, row * order + actuator_row[i], lane])
                effect_out[world, e * n + i] = entry
                brought += entry * effort_out[world, i]
            gap_out[world, e] = real(free_gap_in[pack, row, lane])
            gap_out[world, effector_rows + e] = -brought

    @wp.kernel(module=module, enable_backward=False)
    def assemble(
        n: int,
        rows: int,
        effector_rows: int,
        epsilon: real,
        max_step: real,
        # Model
        effector_weight: wp.array(dtype=real),
        # Workspace in
        effect_in: wp.array2d(dtype=real),
        compliance_in: wp.array2d(dtype=real),
        gap_in: wp.array2d(dtype=real),
        # Workspace out
        hessian_out: wp.array2d(dtype=real),
        linear_out: wp.array2d(dtype=real),
        normal_out: wp.array2d(dtype=real),
    ):
        """G = E'E + eps s D, q = E'g, and the rows of the identity and of D.

        ``gap_in`` has two parts: the gap with the present efforts, which is shortened to ``max_step`` [m], and what of
        it these efforts bring about, negative.
        """
        w = wp.tid()
        size = real(0.0)
        for e in range(effector_rows):
            g = gap_in[w, e] * effector_weight[e]
            size += g * g
        share = wp.min(real(1.0), max_step / wp.max(wp.sqrt(size), real(1.0e-300)))
        most_effect = real(0.0)
        most_compliance = real(0.0)
        for i in range(n):
            total = real(0.0)
            for e in range(effector_rows):
                weight = effector_weight[e] * effector_weight[e]
                total += weight * effect_in[w, e * n + i] * (gap_in[w, e] * share + gap_in[w, effector_rows + e])
            linear_out[w, i] = total
            effect = real(0.0)
            compliance = real(0.0)
            for j in range(n):
                total = real(0.0)
                for e in range(effector_rows):
                    weight = effector_weight[e] * effector_weight[e]
                    total += weight * effect_in[w, e * n + i] * effect_in[w, e * n + j]
                hessian_out[w, i * n + j] = total
                effect += wp.abs(total)
                compliance += wp.abs(compliance_in[w, i * n + j])
            most_effect = wp.max(most_effect, effect)
            most_compliance = wp.max(most_compliance, compliance)
        scale = most_effect / wp.max(most_compliance, real(1.0e-300))
        diagonal = real(1.0e-300)
        for i in range(n):
            for j in range(n):
                mean = real(0.5) * (compliance_in[w, i * n + j] + compliance_in[w, j * n + i])
                hessian_out[w, i * n + j] += epsilon * scale * mean
                normal_out[w, i * n + j] = wp.where(i == j, real(1.0), real(0.0))
            diagonal = wp.max(diagonal, hessian_out[w, i * n + i])
        for i in range(n):
            hessian_out[w, i * n + i] += diagonal * real(wp.static(TINY))
        for k in range((rows - n) * n):
            normal_out[w, n * n + k] = compliance_in[w, k]

    @wp.func
    def most_violated(
        n: int,
        rows: int,
        limit: real,
        normal: wp.array2d(dtype=real),
        low: wp.array2d(dtype=real),
        high: wp.array2d(dtype=real),
        size: wp.array2d(dtype=real),
        multiplier: wp.array2d(dtype=real),
        x: wp.array2d(dtype=real),
        w: int,
    ):
        """Row without a multiplier that is farthest beyond a bound for what moving it costs, or -1; and the side."""
        chosen = int(-1)
        side = real(1.0)
        worst = limit
        for row in range(rows):
            if multiplier[w, row] == real(0.0):
                value = dot(normal, row * n, x, 0, w, n)
                length = wp.sqrt(wp.max(size[w, row], real(1.0e-300)))
                below = wp.where(low[w, row] > -real(wp.static(FAR_FROM)), (low[w, row] - value) / length, real(0.0))
                above = wp.where(high[w, row] < real(wp.static(FAR_FROM)), (value - high[w, row]) / length, real(0.0))
                if below > worst:
                    worst = below
                    chosen = row
                    side = real(1.0)
                if above > worst:
                    worst = above
                    chosen = row
                    side = real(-1.0)
        return chosen, side

    @wp.func
    def step_direction(
        n: int,
        count: int,
        rows: int,
        row: int,
        side: real,
        soft: wp.array2d(dtype=real),
        half: wp.array2d(dtype=real),
        active: wp.array2d(dtype=wp.int32),
        sign: wp.array2d(dtype=real),
        gram: wp.array2d(dtype=real),
        rate: wp.array2d(dtype=real),
        step: wp.array2d(dtype=real),
        w: int,
    ):
        """How active multipliers fall and x moves per unit of a new multiplier; the new row's gain per unit.

        With N the active normals and M = N' G^-1 N + soft: rate = M^-1 N' G^-1 a, step = L^-1 (a - N rate).
        """
        for i in range(count):
            a = active[w, i]
            for j in range(i + 1):
                b = active[w, j]
                total = dot(half, a * n, half, b * n, w, n) * sign[w, i] * sign[w, j]
                gram[w, i * rows + j] = wp.where(i == j, total + soft[w, a], total)
            rate[w, i] = dot(half, a * n, half, row * n, w, n) * sign[w, i] * side
            step[w, n + i] = rate[w, i]
        factor(gram, w, count, rows)
        forward(gram, rate, w, count, rows, 0)
        backward(gram, rate, w, count, rows, 0)
        gain = soft[w, row]
        for k in range(n):
            value = side * half[w, row * n + k]
            gain += value * value
            for i in range(count):
                value -= rate[w, i] * sign[w, i] * half[w, active[w, i] * n + k]
            step[w, k] = value
        for i in range(count):
            gain -= rate[w, i] * step[w, n + i]
        return gain

    @wp.kernel(module=module, enable_backward=False)
    def dual_active_set(
        n: int,
        rows: int,
        # Workspace in
        hessian_in: wp.array2d(dtype=real),
        linear_in: wp.array2d(dtype=real),
        normal_in: wp.array2d(dtype=real),
        low_in: wp.array2d(dtype=real),
        high_in: wp.array2d(dtype=real),
        soft_in: wp.array2d(dtype=real),
        # Workspace out
        chol_out: wp.array2d(dtype=real),
        half_out: wp.array2d(dtype=real),
        size_out: wp.array2d(dtype=real),
        gram_out: wp.array2d(dtype=real),
        rate_out: wp.array2d(dtype=real),
        step_out: wp.array2d(dtype=real),
        active_out: wp.array2d(dtype=wp.int32),
        sign_out: wp.array2d(dtype=real),
        multiplier_out: wp.array2d(dtype=real),
        x_out: wp.array2d(dtype=real),
        outcome_out: wp.array2d(dtype=wp.int32),
    ):
        """Minimum by the method of Goldfarb and Idnani (1983): dual feasible throughout, one violated row at a time.

        ``multiplier_out`` is positive at a lower bound, negative at an upper one and zero elsewhere.
        """
        w = wp.tid()
        for k in range(n * n):
            chol_out[w, k] = hessian_in[w, k]
        factor(chol_out, w, n, n)
        for i in range(n):
            x_out[w, i] = -linear_in[w, i]
        forward(chol_out, x_out, w, n, n, 0)
        limit = real(wp.static(ACCURACY)) * wp.sqrt(dot(x_out, 0, x_out, 0, w, n)) + real(1.0e-15)
        backward(chol_out, x_out, w, n, n, 0)
        for row in range(rows):
            for k in range(n):
                half_out[w, row * n + k] = normal_in[w, row * n + k]
            forward(chol_out, half_out, w, n, n, row * n)
            size_out[w, row] = dot(half_out, row * n, half_out, row * n, w, n) + soft_in[w, row]
            multiplier_out[w, row] = real(0.0)
        count = int(0)
        outcome_out[w, 0] = wp.static(STUCK)
        row = int(-1)
        side = real(1.0)
        fresh = real(0.0)
        for _round in range(12 * rows):
            if row < 0:
                row, side = most_violated(
                    n, rows, limit, normal_in, low_in, high_in, size_out, multiplier_out, x_out, w
                )
                fresh = real(0.0)
                if row < 0:
                    outcome_out[w, 0] = wp.static(SOLVED)
                    break
            gain = step_direction(
                n, count, rows, row, side, soft_in, half_out, active_out, sign_out, gram_out, rate_out, step_out, w
            )
            bound = wp.where(side > real(0.0), low_in[w, row], -high_in[w, row])
            short = bound - side * dot(normal_in, row * n, x_out, 0, w, n) - soft_in[w, row] * fresh
            length = real(1.0e300)
            if gain > real(1.0e-11) * size_out[w, row] or soft_in[w, row] > real(0.0):
                length = wp.max(short, real(0.0)) / wp.max(gain, soft_in[w, row])  # soft rows gain that much at least
            leaving = int(-1)
            for i in range(count):
                held = multiplier_out[w, active_out[w, i]] * sign_out[w, i]
                if rate_out[w, i] > real(0.0) and held < length * rate_out[w, i]:
                    length = held / rate_out[w, i]
                    leaving = i
            if length > real(1.0e299):
                break  # hard rows that exclude each other
            backward(chol_out, step_out, w, n, n, 0)
            for i in range(n):
                x_out[w, i] += length * step_out[w, i]
            fresh += length
            for i in range(count):
                held = multiplier_out[w, active_out[w, i]] * sign_out[w, i] - length * rate_out[w, i]
                multiplier_out[w, active_out[w, i]] = sign_out[w, i] * wp.max(held, real(1.0e-300))
            if leaving >= 0:
                multiplier_out[w, active_out[w, leaving]] = real(0.0)
                count -= 1
                for i in range(leaving, count):
                    active_out[w, i] = active_out[w, i + 1]
                    sign_out[w, i] = sign_out[w, i + 1]
            else:
                active_out[w, count] = row
                sign_out[w, count] = side
                multiplier_out[w, row] = side * wp.max(fresh, real(1.0e-300))
                count += 1
                row = -1

    @wp.kernel(module=module, enable_backward=False)
    def conclude(
        n: int,
        effector_rows: int,
        tolerance: real,
        max_step: real,
        share: real,
        # Model
        effector_weight: wp.array(dtype=real),
        is_effort: wp.array(dtype=wp.int32),
        # Workspace in
        overflow_in: wp.array3d(dtype=wp.int32),
        outcome_in: wp.array2d(dtype=wp.int32),
        multiplier_in: wp.array2d(dtype=real),
        effort_in: wp.array2d(dtype=real),
        effect_in: wp.array2d(dtype=real),
        compliance_in: wp.array2d(dtype=real),
        way_in: wp.array2d(dtype=real),
        gap_in: wp.array2d(dtype=real),
        low_in: wp.array2d(dtype=real),
        high_in: wp.array2d(dtype=real),
        way_low_in: wp.array2d(dtype=real),
        way_high_in: wp.array2d(dtype=real),
        stop_low_in: wp.array2d(dtype=real),
        stop_high_in: wp.array2d(dtype=real),
        now_in: wp.array2d(dtype=real),
        base_in: wp.array2d(dtype=real),
        spring_in: wp.array2d(dtype=real),
        unit_in: wp.array2d(dtype=real),
        # Workspace out
        x_out: wp.array2d(dtype=real),
        predicted_out: wp.array2d(dtype=real),
        displacement_out: wp.array2d(dtype=real),
        command_out: wp.array2d(dtype=real),
        status_out: wp.array2d(dtype=wp.int32),
    ):
        """What the efforts lead to, the commands that ask for them, and how the target fares.

        A command asks for ``share`` of the change in effort, or of the displacement that goes with it, within its
        bounds and beside what a spring takes.
        """
        w = wp.tid()
        lanes = overflow_in.shape[2]
        good = outcome_in[w, 0] == wp.static(SOLVED) and overflow_in[w // lanes, 0, w % lanes] == 0
        for i in range(n):
            good = good and wp.isfinite(x_out[w, i])
        for i in range(n):
            x_out[w, i] = wp.where(good, wp.clamp(x_out[w, i], low_in[w, i], high_in[w, i]), effort_in[w, i])
        error = real(0.0)
        asked = real(0.0)
        for e in range(effector_rows):
            gap = gap_in[w, e] + gap_in[w, effector_rows + e]
            for i in range(n):
                gap += effect_in[w, e * n + i] * x_out[w, i]
            predicted_out[w, e] = gap
            weight = effector_weight[e] * effector_weight[e]
            error += weight * gap * gap
            asked += weight * gap_in[w, e] * gap_in[w, e]
        moving = bool(False)
        conflict = real(0.0)
        for i in range(n):
            way = way_in[w, i]
            for j in range(n):
                way += compliance_in[w, i * n + j] * x_out[w, j]
            displacement_out[w, i] = way
            held = multiplier_in[w, n + i]
            if held > real(0.0):
                moving = moving or (is_effort[i] == 0 and way_low_in[w, i] > stop_low_in[w, i])
                conflict = wp.max(conflict, way_low_in[w, i] - way)
            if held < real(0.0):
                moving = moving or (is_effort[i] == 0 and way_high_in[w, i] < stop_high_in[w, i])
                conflict = wp.max(conflict, way - way_high_in[w, i])
            if is_effort[i] != 0:
                moving = moving or (multiplier_in[w, i] > real(0.0) and low_in[w, i] > stop_low_in[w, i])
                moving = moving or (multiplier_in[w, i] < real(0.0) and high_in[w, i] < stop_high_in[w, i])
            way = wp.where(good, wp.clamp(way, way_low_in[w, i], way_high_in[w, i]), now_in[w, i])
            value = now_in[w, i] + share * (way - now_in[w, i])
            if is_effort[i] != 0:
                value = effort_in[w, i] + share * (x_out[w, i] - effort_in[w, i])
                value = wp.clamp(value, low_in[w, i], high_in[w, i])
            else:
                value += spring_in[w, i] * x_out[w, i]
            command_out[w, i] = base_in[w, i] + value * unit_in[w, i]
        status = wp.static(Outcome.REACHED)
        if error > tolerance * tolerance:
            status = wp.static(Outcome.UNREACHABLE)
            is_shortened = asked > max_step * max_step
            if moving or (is_shortened and wp.sqrt(error) < wp.sqrt(asked) - real(0.5) * max_step):
                status = wp.static(Outcome.MOVING)
        if conflict > tolerance:
            status = wp.static(Outcome.CONFLICT)
        if not good:
            status = wp.static(Outcome.FAILED)
        status_out[w, 0] = status

    return SimpleNamespace(collect=collect, assemble=assemble, dual_active_set=dual_active_set, conclude=conclude)
