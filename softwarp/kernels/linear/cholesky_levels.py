"""Block Cholesky on a GPU: one thread block factorises and solves a group of worlds, level by level, in one launch.

A thread block holds ``worlds`` neighbouring worlds (so that loads coalesce) times ``workers`` threads per world. The
workers share the 3x3 blocks or rows of a level of the elimination tree and meet at a barrier after it, which costs far
less than a launch per level. Where a level has fewer rows than workers, several workers split the sum of a row; parts
are added in a fixed order, so results repeat to the bit. Theory: docs/theory/cholesky.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.linear import cholesky

THREADS = 1024  # per block; benchmarks/trunk.py
PART_ROWS = 9  # scratch rows per worker: three entries of three right-hand sides


@wp.func_native("__syncthreads();")
def barrier():
    """Wait for all threads of the block; their writes are visible after it."""


def worlds_per_block(world_count: int) -> int:
    """Full coalescing for large batches, more workers per world for small ones; benchmarks/trunk.py."""
    return 32 if world_count > 2048 else 16


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Cooperative kernels for the ``cuda`` variant of one scalar type."""
    S = variant.S
    module = variant.module("cholesky_block")
    base = cholesky.kernels(variant)
    block_update, diagonal_inverse = base.block_update, base.diagonal_inverse
    store_scaled, store_solved = base.store_scaled, base.store_solved

    @wp.kernel(module=module, enable_backward=False, launch_bounds=THREADS)
    def factor_block(
        # Symbolic
        size: int,
        level_count: int,
        level_block_start: wp.array(dtype=wp.int32),
        level_block: wp.array(dtype=wp.int32),
        l_col: wp.array(dtype=wp.int32),
        l_source: wp.array(dtype=wp.int32),
        pair_start: wp.array(dtype=wp.int32),
        pair_left: wp.array(dtype=wp.int32),
        pair_right: wp.array(dtype=wp.int32),
        world_count: int,
        worlds: int,
        # Workspace in
        a_in: wp.array2d(dtype=S),
        # Workspace out
        lower_out: wp.array2d(dtype=S),
        diagonal_out: wp.array2d(dtype=S),
    ):
        """A = L L' for the worlds of one block."""
        group, place = wp.tid()
        w = group * worlds + place % worlds
        worker = place // worlds
        workers = wp.static(THREADS) // worlds
        active = w < world_count
        for level in range(level_count):
            begin = level_block_start[level] + worker
            end = level_block_start[level + 1]
            if active:
                for item in range(begin, end, workers):
                    block = level_block[item]
                    s00, s01, s02, s10, s11, s12, s20, s21, s22 = block_update(
                        a_in, lower_out, w, block, l_source, pair_start, pair_left, pair_right
                    )
                    row = block * 9
                    lower_out[w, row] = s00
                    lower_out[w, row + 1] = s01
                    lower_out[w, row + 2] = s02
                    lower_out[w, row + 3] = s10
                    lower_out[w, row + 4] = s11
                    lower_out[w, row + 5] = s12
                    lower_out[w, row + 6] = s20
                    lower_out[w, row + 7] = s21
                    lower_out[w, row + 8] = s22
            barrier()
            if active:
                for item in range(begin, end, workers):
                    block = level_block[item]
                    j = l_col[block]
                    d = j * 9
                    i00, i10, i11, i20, i21, i22 = diagonal_inverse(
                        lower_out[w, d],
                        lower_out[w, d + 3],
                        lower_out[w, d + 4],
                        lower_out[w, d + 6],
                        lower_out[w, d + 7],
                        lower_out[w, d + 8],
                    )
                    if block < size:
                        r = j * 6
                        diagonal_out[w, r] = i00
                        diagonal_out[w, r + 1] = i10
                        diagonal_out[w, r + 2] = i11
                        diagonal_out[w, r + 3] = i20
                        diagonal_out[w, r + 4] = i21
                        diagonal_out[w, r + 5] = i22
                    else:
                        for r in range(3):
                            k = block * 9 + 3 * r
                            t0 = lower_out[w, k]
                            t1 = lower_out[w, k + 1]
                            t2 = lower_out[w, k + 2]
                            store_scaled(lower_out, w, k, t0, t1, t2, i00, i10, i11, i20, i21, i22)
            barrier()

    @wp.func
    def forward_sum3(
        lower: wp.array2d(dtype=S),
        y: wp.array2d(dtype=S),
        w: int,
        offset: int,
        stride: int,
        begin: int,
        end: int,
        step: int,
        l_col: wp.array(dtype=wp.int32),
        row_block: wp.array(dtype=wp.int32),
    ):
        """Part of ``sum_j L_ij y_j`` for three right-hand sides."""
        a0 = S(0.0)
        a1 = S(0.0)
        a2 = S(0.0)
        b0 = S(0.0)
        b1 = S(0.0)
        b2 = S(0.0)
        c0 = S(0.0)
        c1 = S(0.0)
        c2 = S(0.0)
        for p in range(begin, end, step):
            block = row_block[p]
            b = block * 9
            j = offset + 3 * l_col[block]
            for c in range(3):
                l0 = lower[w, b + c]
                l1 = lower[w, b + 3 + c]
                l2 = lower[w, b + 6 + c]
                ya = y[w, j + c]
                yb = y[w, j + stride + c]
                yc = y[w, j + 2 * stride + c]
                a0 += l0 * ya
                a1 += l1 * ya
                a2 += l2 * ya
                b0 += l0 * yb
                b1 += l1 * yb
                b2 += l2 * yb
                c0 += l0 * yc
                c1 += l1 * yc
                c2 += l2 * yc
        return a0, a1, a2, b0, b1, b2, c0, c1, c2

    @wp.kernel(module=module, enable_backward=False, launch_bounds=THREADS)
    def forward_block3(
        # Symbolic
        size: int,
        level_count: int,
        level_start: wp.array(dtype=wp.int32),
        level_col: wp.array(dtype=wp.int32),
        l_col: wp.array(dtype=wp.int32),
        row_start: wp.array(dtype=wp.int32),
        row_block: wp.array(dtype=wp.int32),
        world_count: int,
        worlds: int,
        groups: int,
        # Workspace in
        lower_in: wp.array2d(dtype=S),
        diagonal_in: wp.array2d(dtype=S),
        # Workspace out
        part_out: wp.array2d(dtype=S),
        y_out: wp.array2d(dtype=S),
    ):
        """y <- L^-1 y for ``groups`` times three right-hand sides of the worlds of one block."""
        group, place = wp.tid()
        w = group * worlds + place % worlds
        worker = place // worlds
        workers = wp.static(THREADS) // worlds
        active = w < world_count
        stride = 3 * size
        for level in range(level_count):
            first = level_start[level]
            tasks = (level_start[level + 1] - first) * groups
            split = wp.max(workers // tasks, 1)
            if active:
                for q in range(worker, tasks * split, workers):
                    task = q // split
                    i = level_col[first + task // groups]
                    offset = 3 * stride * (task % groups)
                    a0, a1, a2, b0, b1, b2, c0, c1, c2 = forward_sum3(
                        lower_in,
                        y_out,
                        w,
                        offset,
                        stride,
                        row_start[i] + q % split,
                        row_start[i + 1],
                        split,
                        l_col,
                        row_block,
                    )
                    t = offset + 3 * i
                    if split == 1:
                        d = i * 6
                        u = t + stride
                        v = u + stride
                        store_solved(
                            y_out, w, t, y_out[w, t] - a0, y_out[w, t + 1] - a1, y_out[w, t + 2] - a2, diagonal_in, d
                        )
                        store_solved(
                            y_out, w, u, y_out[w, u] - b0, y_out[w, u + 1] - b1, y_out[w, u + 2] - b2, diagonal_in, d
                        )
                        store_solved(
                            y_out, w, v, y_out[w, v] - c0, y_out[w, v + 1] - c1, y_out[w, v + 2] - c2, diagonal_in, d
                        )
                    else:
                        k = q * wp.static(PART_ROWS)
                        part_out[w, k] = a0
                        part_out[w, k + 1] = a1
                        part_out[w, k + 2] = a2
                        part_out[w, k + 3] = b0
                        part_out[w, k + 4] = b1
                        part_out[w, k + 5] = b2
                        part_out[w, k + 6] = c0
                        part_out[w, k + 7] = c1
                        part_out[w, k + 8] = c2
            barrier()
            if split > 1:
                if active:
                    for q in range(worker, 3 * tasks, workers):
                        task = q // 3
                        i = level_col[first + task // groups]
                        t = 3 * stride * (task % groups) + stride * (q % 3) + 3 * i
                        s0 = y_out[w, t]
                        s1 = y_out[w, t + 1]
                        s2 = y_out[w, t + 2]
                        for part in range(split):
                            k = (task * split + part) * wp.static(PART_ROWS) + 3 * (q % 3)
                            s0 -= part_out[w, k]
                            s1 -= part_out[w, k + 1]
                            s2 -= part_out[w, k + 2]
                        store_solved(y_out, w, t, s0, s1, s2, diagonal_in, i * 6)
                barrier()

    @wp.func
    def forward_sum(
        lower: wp.array2d(dtype=S),
        y: wp.array2d(dtype=S),
        w: int,
        begin: int,
        end: int,
        step: int,
        l_col: wp.array(dtype=wp.int32),
        row_block: wp.array(dtype=wp.int32),
    ):
        """Part of ``sum_j L_ij y_j``."""
        s0 = S(0.0)
        s1 = S(0.0)
        s2 = S(0.0)
        for p in range(begin, end, step):
            block = row_block[p]
            b = block * 9
            j = 3 * l_col[block]
            for c in range(3):
                yj = y[w, j + c]
                s0 += lower[w, b + c] * yj
                s1 += lower[w, b + 3 + c] * yj
                s2 += lower[w, b + 6 + c] * yj
        return s0, s1, s2

    @wp.func
    def backward_sum(
        lower: wp.array2d(dtype=S),
        y: wp.array2d(dtype=S),
        w: int,
        begin: int,
        end: int,
        step: int,
        l_row: wp.array(dtype=wp.int32),
    ):
        """Part of ``sum_i L_ij' x_i``."""
        s0 = S(0.0)
        s1 = S(0.0)
        s2 = S(0.0)
        for block in range(begin, end, step):
            b = block * 9
            i = 3 * l_row[block]
            for r in range(3):
                xi = y[w, i + r]
                s0 += lower[w, b + 3 * r] * xi
                s1 += lower[w, b + 3 * r + 1] * xi
                s2 += lower[w, b + 3 * r + 2] * xi
        return s0, s1, s2

    @wp.func
    def store_backward(
        y: wp.array2d(dtype=S), w: int, t: int, y0: S, y1: S, y2: S, diagonal: wp.array2d(dtype=S), d: int
    ):
        """Write ``Li' y``."""
        y[w, t] = diagonal[w, d] * y0 + diagonal[w, d + 1] * y1 + diagonal[w, d + 3] * y2
        y[w, t + 1] = diagonal[w, d + 2] * y1 + diagonal[w, d + 4] * y2
        y[w, t + 2] = diagonal[w, d + 5] * y2

    @wp.kernel(module=module, enable_backward=False, launch_bounds=THREADS)
    def substitute_block(
        # Symbolic
        backward: bool,
        level_count: int,
        level_start: wp.array(dtype=wp.int32),
        level_col: wp.array(dtype=wp.int32),
        l_row: wp.array(dtype=wp.int32),
        l_col: wp.array(dtype=wp.int32),
        col_start: wp.array(dtype=wp.int32),
        row_start: wp.array(dtype=wp.int32),
        row_block: wp.array(dtype=wp.int32),
        world_count: int,
        worlds: int,
        # Workspace in
        lower_in: wp.array2d(dtype=S),
        diagonal_in: wp.array2d(dtype=S),
        # Workspace out
        part_out: wp.array2d(dtype=S),
        y_out: wp.array2d(dtype=S),
    ):
        """y <- L^-1 y, or L^-T y if ``backward``, for the first right-hand side of the worlds of one block."""
        group, place = wp.tid()
        w = group * worlds + place % worlds
        worker = place // worlds
        workers = wp.static(THREADS) // worlds
        active = w < world_count
        for step in range(level_count):
            level = wp.where(backward, level_count - 1 - step, step)
            first = level_start[level]
            tasks = level_start[level + 1] - first
            split = wp.max(workers // tasks, 1)
            if active:
                for q in range(worker, tasks * split, workers):
                    i = level_col[first + q // split]
                    part = q % split
                    s0 = S(0.0)
                    s1 = S(0.0)
                    s2 = S(0.0)
                    if backward:
                        s0, s1, s2 = backward_sum(
                            lower_in, y_out, w, col_start[i] + part, col_start[i + 1], split, l_row
                        )
                    else:
                        s0, s1, s2 = forward_sum(
                            lower_in, y_out, w, row_start[i] + part, row_start[i + 1], split, l_col, row_block
                        )
                    k = q * 3
                    if split > 1:
                        part_out[w, k] = s0
                        part_out[w, k + 1] = s1
                        part_out[w, k + 2] = s2
                    else:
                        t = 3 * i
                        s0 = y_out[w, t] - s0
                        s1 = y_out[w, t + 1] - s1
                        s2 = y_out[w, t + 2] - s2
                        if backward:
                            store_backward(y_out, w, t, s0, s1, s2, diagonal_in, i * 6)
                        else:
                            store_solved(y_out, w, t, s0, s1, s2, diagonal_in, i * 6)
            barrier()
            if split > 1:
                if active and worker < tasks:
                    i = level_col[first + worker]
                    t = 3 * i
                    s0 = y_out[w, t]
                    s1 = y_out[w, t + 1]
                    s2 = y_out[w, t + 2]
                    for part in range(split):
                        k = (worker * split + part) * 3
                        s0 -= part_out[w, k]
                        s1 -= part_out[w, k + 1]
                        s2 -= part_out[w, k + 2]
                    if backward:
                        store_backward(y_out, w, t, s0, s1, s2, diagonal_in, i * 6)
                    else:
                        store_solved(y_out, w, t, s0, s1, s2, diagonal_in, i * 6)
                barrier()

    return SimpleNamespace(factor_block=factor_block, forward_block3=forward_block3, substitute_block=substitute_block)
