"""Gauss' elimination of the equations of one world's contacts on a CPU, whose factors serve again.

A world's matrix lies in one piece, (world, row * column, 1), so that rows are subtracted in whole registers. Behind it,
in ``held``, are five numbers of every row: its unknown's unit, its largest entry, the right-hand side, the place of the
column's pivot or -1, and the row that was exchanged for it. Products are not fused with sums: results are to the bit
those of one number after the other, as ``contact_adjoint`` has them on a GPU.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

_BEGIN = """
#pragma clang fp contract(off)
typedef REAL wide_t __attribute__((vector_size(64), aligned(4)));
const int width = 64 / sizeof(REAL), n = total;
REAL* m = &wp::index(matrix, world, 0, 0);
REAL* unit = &wp::index(held, world, 0, 0);
REAL *size = unit + order, *y = unit + 2 * order, *place = unit + 3 * order, *other = unit + 4 * order;
auto magnitude = [](REAL x) { return x < 0 ? -x : x; };
"""
# Every unknown in its unit, and every row over its largest entry; then pivot after pivot.
_FACTOR = (
    _BEGIN
    + """
for (int i = 0; i < n; ++i) {
    REAL* row = m + i * order;
    REAL largest = 0;
    for (int j = 0; j < n; ++j) {
        row[j] *= unit[j];
        if (magnitude(row[j]) > largest) largest = magnitude(row[j]);
    }
    size[i] = largest;
    if (largest > 0) for (int j = 0; j < n; ++j) row[j] /= largest;
}
int rank = 0;
for (int k = 0; k < n; ++k) {
    int best = rank;
    for (int i = rank + 1; i < n; ++i) if (magnitude(m[i * order + k]) > magnitude(m[best * order + k])) best = i;
    if (rank == n || !(magnitude(m[best * order + k]) > least)) {
        place[k] = -1;
        continue;
    }
    const REAL pivot = m[best * order + k];
    REAL* upper = m + rank * order;
    place[k] = rank, other[rank] = best;
    if (best != rank)
        for (int j = 0; j < n; ++j) {
            const REAL kept = upper[j];
            upper[j] = m[best * order + j], m[best * order + j] = kept;
        }
    for (int i = rank + 1; i < n; ++i) {
        REAL* row = m + i * order;
        if (row[k] == 0) continue;
        const REAL factor = row[k] / pivot;
        row[k] = factor;
        int j = k + 1;
        for (; j + width <= n; j += width) {
            wide_t a, b;
            __builtin_memcpy(&a, row + j, sizeof(a));
            __builtin_memcpy(&b, upper + j, sizeof(b));
            a -= factor * b;
            __builtin_memcpy(row + j, &a, sizeof(a));
        }
        for (; j < n; ++j) row[j] -= factor * upper[j];
    }
    rank += 1;
}
"""
)
_SOLVE = (
    _BEGIN
    + """
int rank = 0;
for (int k = 0; k < n; ++k)
    if (place[k] >= 0) {
        const int best = (int)other[rank];
        const REAL kept = y[rank];
        y[rank] = y[best], y[best] = kept;
        rank += 1;
    }
for (int k = 0, r = 0; k < n; ++k) {
    if (place[k] < 0) continue;
    for (int i = r + 1; i < n; ++i)
        if (m[i * order + k] != 0) y[i] -= m[i * order + k] * y[r];
    r += 1;
}
int contradicts = 0;
for (int i = rank; i < n; ++i) contradicts |= magnitude(y[i]) > bound;  // 0 = 0, or there is no solution
for (int i = n - 1; i >= 0; --i) {
    REAL value = 0;
    if (place[i] >= 0) {
        const REAL* row = m + (int)place[i] * order;
        value = y[(int)place[i]];
        for (int j = i + 1; j < n; ++j) value -= row[j] * y[j];
        value /= row[i];
    }
    y[i] = value;
}
return contradicts;
"""
)
ROWS = 5  # of ``held`` for each unknown


@cache
def functions(real: Any) -> SimpleNamespace:
    """``factor`` and ``solve`` in one precision."""
    name = "double" if real is wp.float64 else "float"

    @wp.func_native(_FACTOR.replace("REAL", name))
    def factor(
        matrix: wp.array3d(dtype=real),
        held: wp.array3d(dtype=real),
        world: int,
        order: int,
        total: int,
        least: real,
    ):
        """Factor the first ``total`` equations, whose pivots are larger than ``least`` or left out."""

    @wp.func_native(_SOLVE.replace("REAL", name))
    def solve(
        matrix: wp.array3d(dtype=real),
        held: wp.array3d(dtype=real),
        world: int,
        order: int,
        total: int,
        bound: real,
    ) -> int:
        """Solve for the right-hand side in ``held``; whether what has no pivot contradicts by more than a bound."""

    return SimpleNamespace(factor=factor, solve=solve)
