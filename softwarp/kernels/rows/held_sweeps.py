"""Projected Gauss-Seidel on a few rows of many worlds on a GPU, in registers. Theory: docs/theory/delassus.md.

A thread has a world to itself, as in ``delassus.gauss_seidel``, whose arithmetic this is; but a sweep there waits for
memory at every row. With W in registers the sweeps of 4096 trunks with eight cables cost a tenth.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant

MOST_ROWS = 8  # whose W registers have room for
THREADS = 32  # per block, so that some thousand worlds are on all multiprocessors


@cache
def kernels(variant: Variant, held_rows: int) -> SimpleNamespace:
    """Sweeps over ``held_rows`` rows, for variants without lanes."""
    S, n = variant.S, held_rows
    matrix, vector = wp.types.matrix((n, n), S), wp.types.vector(n, S)

    @wp.kernel(module=variant.module(f"held_sweeps.{n}"), enable_backward=False)
    def gauss_seidel(
        iterations: int,
        # Workspace in
        delassus_in: wp.array2d(dtype=S),
        lower_in: wp.array2d(dtype=S),
        upper_in: wp.array2d(dtype=S),
        # Workspace out
        gap_out: wp.array2d(dtype=S),
        multiplier_out: wp.array2d(dtype=S),
        change_out: wp.array2d(dtype=S),
        residual_out: wp.array2d(dtype=S),
    ):
        """Projected Gauss-Seidel on W change + gap = 0 with lower <= multiplier <= upper; see ``delassus``."""
        w = wp.tid()
        zero = S(0.0)
        W = matrix()
        gap = vector()
        multiplier = vector()
        lower = vector()
        upper = vector()
        change = vector()
        for i in range(wp.static(n)):
            for j in range(wp.static(n)):
                W[i, j] = delassus_in[w, i * wp.static(n) + j]
            gap[i] = gap_out[w, i]
            multiplier[i] = multiplier_out[w, i]
            lower[i] = lower_in[w, i]
            upper[i] = upper_in[w, i]
        for sweep in range(iterations):
            moved = int(0)
            for i in range(wp.static(n)):
                old = multiplier[i]
                new = wp.min(wp.max(old - gap[i] / (W[i, i] + S(1.0e-30)), lower[i]), upper[i])
                step = new - old
                multiplier[i] = new
                change[i] += step
                for j in range(wp.static(n)):
                    gap[j] += W[j, i] * step
                if step != zero:
                    moved = 1
            if moved == 0:
                break
        worst = zero
        for i in range(wp.static(n)):
            diagonal = W[i, i] + S(1.0e-30)
            new = wp.min(wp.max(multiplier[i] - gap[i] / diagonal, lower[i]), upper[i])
            step = (new - multiplier[i]) * diagonal
            worst = wp.max(worst, wp.max(step, -step))
            gap_out[w, i] = gap[i]
            multiplier_out[w, i] = multiplier[i]
            change_out[w, i] = change[i]
        residual_out[w, 0] = worst

    return SimpleNamespace(gauss_seidel=gauss_seidel)
