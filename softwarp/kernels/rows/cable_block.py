"""Multipliers of cables on a GPU: one thread block per world. Theory: docs/theory/delassus.md.

The threads of a warp share each dot product of half-solved sides, which ``cholesky_panels`` leaves with a world's
entries side by side; the first warp then sweeps over the rows in shared memory. Sums are split and added in a fixed
order, so results repeat to the bit and depend on no other world.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.algebra.team import exchange_code
from softwarp.kernels.linear.cholesky_panels import THREADS, barrier, shared_memory

WARP = 32  # threads of a warp
MOST_ROWS = 48  # cables of a scene whose W the block keeps in shared memory


@wp.func_native("""
#if defined(__CUDA_ARCH__)
__syncwarp();
#endif
""")
def meet():
    """Wait for the threads of the warp; their writes are visible after it."""


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernel of one world per thread block, for variants without lanes; a CPU has one thread and warps of one."""
    S = variant.S
    module = variant.module("cable_block")
    gaps = MOST_ROWS * MOST_ROWS  # places in shared memory, after those of W
    multipliers = gaps + MOST_ROWS

    @wp.func_native(shared_memory(S, multipliers + MOST_ROWS))
    def shared(place: int, value: S, write: bool) -> S: ...

    @wp.func_native(exchange_code(S))
    def exchange(value: S, offset: int) -> S: ...

    @wp.func
    def warp_sum(value: S, width: int):
        """Sum over the threads of a warp, the same bits in each."""
        total = value
        offset = width // 2
        while offset > 0:
            total += exchange(total, offset)
            offset = offset // 2
        return total

    @wp.func
    def side_product(half: wp.array2d(dtype=S), w: int, a: int, b: int, count: int, thread: int, width: int):
        """Product of two half-solved sides; four terms at a time, so that their loads are under way together."""
        s = S(0.0)
        for begin in range(thread, count, 4 * width):
            for step in range(4):
                k = begin + step * width
                last = wp.min(k, count - 1)
                term = half[w, a + last] * half[w, b + last]
                s += wp.where(k < count, term, S(0.0))
        return warp_sum(s, width)

    @wp.func
    def row_product(
        row: wp.array2d(dtype=S),
        u: wp.array2d(dtype=S),
        w: int,
        begin: int,
        end: int,
        entry_dof: wp.array(dtype=wp.int32),
        thread: int,
        width: int,
    ):
        """``H u`` of one row."""
        s = S(0.0)
        for entry in range(begin + thread, end, width):
            dof = 3 * entry_dof[entry]
            for c in range(3):
                s += row[w, 3 * entry + c] * u[w, dof + c]
        return warp_sum(s, width)

    @wp.func
    def corrected(diagonal: S, gap: S, old: S, lower: S, upper: S):
        """Multiplier that closes the gap of a row, within its bounds."""
        return wp.min(wp.max(old - gap / (diagonal + S(1.0e-30)), lower), upper)

    @wp.func
    def sweep(count: int, thread: int, width: int, w: int, lower: wp.array2d(dtype=S), upper: wp.array2d(dtype=S)):
        """One sweep over the rows in shared memory by one warp; returns whether a multiplier changed."""
        zero = S(0.0)
        is_moved = bool(False)
        for i in range(count):
            old = shared(wp.static(multipliers) + i, zero, False)
            gap = shared(wp.static(gaps) + i, zero, False)
            new = corrected(shared(i * count + i, zero, False), gap, old, lower[w, i], upper[w, i])
            step = new - old
            is_moved = is_moved or step != zero
            meet()
            for j in range(thread, count, width):
                value = shared(wp.static(gaps) + j, zero, False) + shared(i * count + j, zero, False) * step
                shared(wp.static(gaps) + j, value, True)
            if thread == 0:
                shared(wp.static(multipliers) + i, new, True)
            meet()
        return is_moved

    @wp.kernel(module=module, enable_backward=False, launch_bounds=THREADS)
    def solve_rows(
        # Model
        size: int,
        count: int,
        pair: wp.array2d(dtype=wp.int32),
        row_entry_start: wp.array(dtype=wp.int32),
        entry_dof: wp.array(dtype=wp.int32),
        column: wp.array(dtype=wp.vec4i),
        threads: int,
        is_first: bool,
        iterations: int,
        # Workspace in
        half_in: wp.array2d(dtype=S),
        row_in: wp.array2d(dtype=S),
        u_in: wp.array2d(dtype=S),
        displacement_in: wp.array2d(dtype=S),
        target_in: wp.array2d(dtype=S),
        lower_in: wp.array2d(dtype=S),
        upper_in: wp.array2d(dtype=S),
        f_scale: S,
        x_scale: S,
        # Workspace out
        delassus_out: wp.array2d(dtype=S),
        multiplier_out: wp.array2d(dtype=S),
        residual_out: wp.array2d(dtype=S),
        y_out: wp.array2d(dtype=S),
    ):
        """W (if first), free gaps, projected Gauss-Seidel and ``y += f Y change`` of one world."""
        w, thread = wp.tid()
        zero = S(0.0)
        width = wp.min(threads, wp.static(WARP))
        lane = thread % width
        length = 3 * size
        pairs = wp.where(is_first, pair.shape[0], 0)
        for task in range(thread // width, pairs + count, threads // width):
            if task < pairs:
                i = pair[task, 0]
                j = pair[task, 1]
                s = side_product(half_in, w, length * (1 + i), length * (1 + j), length, lane, width)
                if lane == 0:
                    delassus_out[w, i * count + j] = s * (f_scale * x_scale)
                    delassus_out[w, j * count + i] = s * (f_scale * x_scale)
            else:
                i = task - pairs
                s = side_product(half_in, w, 0, length * (1 + i), length, lane, width)
                s += row_product(row_in, u_in, w, row_entry_start[i], row_entry_start[i + 1], entry_dof, lane, width)
                if lane == 0:
                    shared(wp.static(gaps) + i, displacement_in[w, i] + s * x_scale - target_in[w, i], True)
        barrier()
        for k in range(thread, count * count, threads):
            shared(k, delassus_out[w, k], True)
        for k in range(thread, count, threads):
            shared(wp.static(multipliers) + k, multiplier_out[w, k], True)
        barrier()
        if thread < width:
            for _sweep in range(iterations):
                if not sweep(count, thread, width, w, lower_in, upper_in):
                    break  # further sweeps would change nothing either
        barrier()
        for i in range(thread, count, threads):
            new = shared(wp.static(multipliers) + i, zero, False)
            diagonal = shared(i * count + i, zero, False)
            gap = shared(wp.static(gaps) + i, zero, False)
            step = corrected(diagonal, gap, new, lower_in[w, i], upper_in[w, i]) - new
            shared(wp.static(gaps) + i, wp.abs(step) * (diagonal + S(1.0e-30)), True)
            shared(wp.static(multipliers) + i, (new - multiplier_out[w, i]) * f_scale, True)
            multiplier_out[w, i] = new
        barrier()
        for k in range(thread, length, threads):
            total = half_in[w, k]
            for i in range(count):
                total += half_in[w, length * (1 + i) + k] * shared(wp.static(multipliers) + i, zero, False)
            y_out[w, 3 * column[k // 3][0] + k % 3] = total
        if thread == 0:
            worst = zero
            for i in range(count):
                worst = wp.max(worst, shared(wp.static(gaps) + i, zero, False))
            residual_out[w, 0] = worst

    return SimpleNamespace(solve_rows=solve_rows)
