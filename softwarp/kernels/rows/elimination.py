"""Gauss' elimination of the equations of one world's contacts, whose factors serve again.

On a CPU a world's matrix lies in one piece, (world, row * stride + column, 1), so that rows are subtracted in whole
registers, those of eight pivots at once while a number is in one; on a GPU worlds lie side by side, (1, row, world).
Behind it, in ``held``, are numbers of every row, ``ROWS`` of them: its unknown's unit, its largest entry, the
right-hand side, the place of the column's pivot or -1, the row that was exchanged for it, the column of the row's
pivot, and what makes the row of the matrix from those of W. On a CPU products are not fused with sums: results are to
the bit those of one number after the other.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from softwarp.kernels.algebra.lanes import LANE_COUNT, Variant

UNIT, LARGEST, RIGHT, PLACE, OTHER, COLUMN, OWN, FIRST, SECOND, DIAGONAL, PRESSED, ROWS = range(12)
PADDING = 16  # numbers behind a row, which registers may reach into


def stride_of(order: int) -> int:
    """Numbers from one row of the matrix to the next."""
    return order + PADDING


_BEGIN = """
#pragma clang fp contract(off)
typedef REAL wide_t __attribute__((vector_size(64), aligned(4)));
const int width = 64 / sizeof(REAL), n = total, stride = order + PADDING;
REAL* m = &wp::index(matrix, world, 0, 0);
REAL* unit = &wp::index(held, world, 0, 0);
REAL *size = unit + order, *y = unit + 2 * order, *place = unit + 3 * order, *other = unit + 4 * order;
REAL* column = unit + 5 * order;
auto magnitude = [](REAL x) { return x < 0 ? -x : x; };
"""
# Rows of the worlds of a pack, whose numbers of W stand side by side; every unknown in its unit.
_FILL = """
const int stride = order + PADDING;
struct One { enum { value = 1 }; };
struct Lanes { enum { value = LANES }; };
auto fill = [&](auto lanes) {
    constexpr int count = decltype(lanes)::value;
    REAL own[count], first[count], second[count], pressed[count];
    int most = 0;
    for (int l = 0; l < count; ++l) {
        const int total = rows + 3 * wp::index(contacts, pack, 0, l);
        most = total > most ? total : most;
    }
    for (int i = 0; i < most; ++i) {
        const int t = i < rows ? i : rows + 3 * ((i - rows) / 3) + 1, u = t + 1 < order ? t + 1 : t;
        bool leans = false, presses = false;
        REAL *row[count], *unit[count];
        for (int l = 0; l < count; ++l) {
            unit[l] = &wp::index(held, pack * count + l, 0, 0);
            row[l] = &wp::index(matrix, pack * count + l, i * stride, 0);
            own[l] = unit[l][6 * order + i], first[l] = unit[l][7 * order + i], second[l] = unit[l][8 * order + i];
            pressed[l] = unit[l][10 * order + i];
            leans |= first[l] != 0 || second[l] != 0, presses |= pressed[l] != 0;
        }
        const REAL* a = &wp::index(delassus, pack, i * order, 0);
        const REAL* b = &wp::index(delassus, pack, t * order, 0);
        const REAL* c = &wp::index(delassus, pack, u * order, 0);
        for (int j = 0; j < most; ++j) {
            REAL entry[count];
            for (int l = 0; l < count; ++l) entry[l] = own[l] * a[j * count + l];
            if (leans)
                for (int l = 0; l < count; ++l)
                    entry[l] += first[l] * b[j * count + l] + second[l] * c[j * count + l];
            for (int l = 0; l < count; ++l) row[l][j] = entry[l];
        }
        for (int l = 0; l < count; ++l) {
            row[l][i] += unit[l][9 * order + i];
            if (presses) row[l][t - 1] += pressed[l];
        }
        for (int l = 0; l < count; ++l)
            for (int j = 0; j < most; ++j) row[l][j] *= unit[l][j];
    }
};
if (delassus.shape[2] == 1) fill(One());
else fill(Lanes());
"""
# Every row over its largest entry; then pivot after pivot, of eight columns before the others follow.
_FACTOR = (
    _BEGIN
    + """
for (int i = 0; i < n; ++i) {
    REAL* row = m + i * stride;
    for (int j = n; j < n + PADDING; ++j) row[j] = 0;
    REAL largest = 0;
    wide_t most = {};
    for (int j = 0; j < n; j += width) {
        wide_t a;
        __builtin_memcpy(&a, row + j, sizeof(a));
        a = a < 0 ? -a : a;
        most = a > most ? a : most;
    }
    for (int k = 0; k < width; ++k) largest = most[k] > largest ? most[k] : largest;
    size[i] = largest;
    if (largest > 0) for (int j = 0; j < n; ++j) row[j] /= largest;
}
int rank = 0;
for (int begin = 0; begin < n; begin += 8) {
    const int end = begin + 8 < n ? begin + 8 : n, first = rank;
    for (int k = begin; k < end; ++k) {
        int best = rank;
        REAL top = rank < n ? magnitude(m[rank * stride + k]) : 0;
        for (int i = rank + 1; i < n; ++i) {
            const REAL here = magnitude(m[i * stride + k]);
            if (here > top) top = here, best = i;
        }
        if (!(top > least)) {
            place[k] = -1;
            continue;
        }
        const REAL pivot = m[best * stride + k];
        REAL* upper = m + rank * stride;
        place[k] = rank, other[rank] = best, column[rank] = k;
        if (best != rank)
            for (int j = 0; j < n; ++j) {
                const REAL kept = upper[j];
                upper[j] = m[best * stride + j], m[best * stride + j] = kept;
            }
        for (int i = rank + 1; i < n; ++i) {
            REAL* row = m + i * stride;
            const REAL factor = row[k] / pivot;
            row[k] = factor;
            for (int j = k + 1; j < end; ++j) row[j] -= factor * upper[j];
        }
        rank += 1;
    }
    for (int i = first + 1; i < n; ++i) {
        REAL* row = m + i * stride;
        const int pivots = (i < rank ? i : rank) - first;
        REAL factor[8];
        for (int q = 0; q < pivots; ++q) factor[q] = row[(int)column[first + q]];
        auto follow = [&](int many) __attribute__((always_inline)) {
            for (int j = end; j < n; j += width) {
                wide_t a, b;
                __builtin_memcpy(&a, row + j, sizeof(a));
                for (int q = 0; q < many; ++q) {
                    __builtin_memcpy(&b, m + (first + q) * stride + j, sizeof(b));
                    a -= factor[q] * b;
                }
                __builtin_memcpy(row + j, &a, sizeof(a));
            }
        };
        if (pivots == 8) follow(8);
        else follow(pivots);
    }
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
for (int begin = 0; begin < n; begin += 8) {  // eight rows at once, which do not wait for each other
    const int end = begin + 8 < n ? begin + 8 : n, before = begin < rank ? begin : rank;
    REAL value[8] = {};
    for (int q = begin; q < end; ++q) value[q - begin] = y[q];
    const REAL* row[8];
    for (int q = 0; q < 8; ++q) row[q] = m + (begin + q < n ? begin + q : begin) * stride;
    for (int r = 0; r < before; ++r) {
        const int k = (int)column[r];
        for (int q = 0; q < 8; ++q) value[q] -= row[q][k] * y[r];
    }
    for (int q = begin; q < end; ++q) {
        for (int r = before; r < q && r < rank; ++r) value[q - begin] -= row[q - begin][(int)column[r]] * y[r];
        y[q] = value[q - begin];
    }
}
int contradicts = 0;
for (int i = rank; i < n; ++i) contradicts |= magnitude(y[i]) > bound;  // 0 = 0, or there is no solution
for (int end = n; end > 0; end -= 8) {  // likewise, from the last column to the first
    const int begin = end > 8 ? end - 8 : 0;
    REAL value[8] = {};
    const REAL* row[8];
    for (int q = 0; q < 8; ++q) {
        const int at = begin + q < end ? (int)place[begin + q] : -1;
        row[q] = m + (at < 0 ? 0 : at) * stride;
        if (at >= 0) value[q] = y[at];
    }
    for (int j = n - 1; j >= end; --j)
        for (int q = 0; q < 8; ++q) value[q] -= row[q][j] * y[j];
    for (int i = end - 1; i >= begin; --i) {
        REAL found = 0;
        if (place[i] >= 0) {
            found = value[i - begin];
            for (int j = end - 1; j > i; --j) found -= row[i - begin][j] * y[j];
            found /= row[i - begin][i];
        }
        y[i] = found;
    }
}
return contradicts;
"""
)


@cache
def functions(variant: Variant) -> SimpleNamespace:
    """``write_equations``, ``factor`` and ``solve`` of one variant, of single worlds."""
    return _of_threads(variant.real) if variant.world_fastest else _in_registers(variant.real)


def _in_registers(real: Any) -> SimpleNamespace:
    name = "double" if real is wp.float64 else "float"

    def source(text: str) -> str:
        return text.replace("REAL", name).replace("PADDING", str(PADDING)).replace("LANES", str(LANE_COUNT))

    @wp.func_native(source(_FILL))
    def write_equations(
        delassus: wp.array3d(dtype=real),
        contacts: wp.array3d(dtype=wp.int32),
        held: wp.array3d(dtype=real),
        pack: int,
        item: int,
        rows: int,
        order: int,
        matrix: wp.array3d(dtype=real),
    ):
        """Write the equations of the worlds of one pack, from W and numbers of their rows in ``held``."""

    @wp.func_native(source(_FACTOR))
    def factor(
        matrix: wp.array3d(dtype=real),
        held: wp.array3d(dtype=real),
        world: int,
        lane: int,
        order: int,
        total: int,
        least: real,
    ):
        """Factor the first ``total`` equations, whose pivots are larger than ``least`` or left out."""

    @wp.func_native(source(_SOLVE))
    def solve(
        matrix: wp.array3d(dtype=real),
        held: wp.array3d(dtype=real),
        world: int,
        lane: int,
        order: int,
        total: int,
        bound: real,
    ) -> int:
        """Solve for the right-hand side in ``held``; whether what has no pivot contradicts by more than a bound."""

    return SimpleNamespace(write_equations=write_equations, factor=factor, solve=solve)


def _of_threads(real: Any) -> SimpleNamespace:
    """The same for a GPU, one thread a world; ``write_equations`` has one for each row."""

    @wp.func
    def write_equations(
        delassus: wp.array3d(dtype=real),
        contacts: wp.array3d(dtype=wp.int32),
        held: wp.array3d(dtype=real),
        w: int,
        item: int,
        rows: int,
        order: int,
        matrix: wp.array3d(dtype=real),
    ):
        total = rows + 3 * contacts[0, 0, w]
        if item < total:
            t = item
            if item >= rows:
                t = item - (item - rows) % 3 + 1
            own = held[0, wp.static(OWN) * order + item, w]
            first = held[0, wp.static(FIRST) * order + item, w]
            second = held[0, wp.static(SECOND) * order + item, w]
            for j in range(total):
                entry = own * delassus[0, item * order + j, w]
                if first != real(0.0) or second != real(0.0):
                    entry += first * delassus[0, t * order + j, w]
                    entry += second * delassus[0, (t + 1) * order + j, w]
                if item == j:
                    entry += held[0, wp.static(DIAGONAL) * order + item, w]
                if item >= rows and j == t - 1:
                    entry += held[0, wp.static(PRESSED) * order + item, w]
                entry *= held[0, wp.static(UNIT) * order + j, w]
                matrix[0, item * wp.static(PADDING) + item * order + j, w] = entry

    @wp.func
    def factor(
        matrix: wp.array3d(dtype=real),
        held: wp.array3d(dtype=real),
        w: int,
        lane: int,
        order: int,
        total: int,
        least: real,
    ):
        stride = order + wp.static(PADDING)
        for i in range(total):
            largest = real(0.0)
            for j in range(total):
                largest = wp.max(largest, wp.abs(matrix[w, i * stride + j, lane]))
            held[w, wp.static(LARGEST) * order + i, lane] = largest
            if largest > real(0.0):
                for j in range(total):
                    matrix[w, i * stride + j, lane] = matrix[w, i * stride + j, lane] / largest
        rank = int(0)
        for k in range(total):
            best = int(rank)
            top = real(0.0)
            for i in range(rank, total):
                here = wp.abs(matrix[w, i * stride + k, lane])
                if here > top:
                    top = here
                    best = i
            held[w, wp.static(PLACE) * order + k, lane] = real(-1.0)
            if top > least:
                pivot = matrix[w, best * stride + k, lane]
                held[w, wp.static(PLACE) * order + k, lane] = real(rank)
                held[w, wp.static(OTHER) * order + rank, lane] = real(best)
                held[w, wp.static(COLUMN) * order + rank, lane] = real(k)
                if best != rank:
                    for j in range(total):
                        kept = matrix[w, rank * stride + j, lane]
                        matrix[w, rank * stride + j, lane] = matrix[w, best * stride + j, lane]
                        matrix[w, best * stride + j, lane] = kept
                for i in range(rank + 1, total):
                    share = matrix[w, i * stride + k, lane] / pivot
                    matrix[w, i * stride + k, lane] = share
                    if share != real(0.0):
                        for j in range(k + 1, total):
                            of_pivot = share * matrix[w, rank * stride + j, lane]
                            matrix[w, i * stride + j, lane] = matrix[w, i * stride + j, lane] - of_pivot
                rank += 1

    @wp.func
    def solve(
        matrix: wp.array3d(dtype=real),
        held: wp.array3d(dtype=real),
        w: int,
        lane: int,
        order: int,
        total: int,
        bound: real,
    ):
        stride = order + wp.static(PADDING)
        y = wp.static(RIGHT) * order
        rank = int(0)
        for k in range(total):
            if held[w, wp.static(PLACE) * order + k, lane] >= real(0.0):
                best = int(held[w, wp.static(OTHER) * order + rank, lane])
                value = held[w, y + best, lane]
                held[w, y + best, lane] = held[w, y + rank, lane]
                for i in range(rank):
                    column = int(held[w, wp.static(COLUMN) * order + i, lane])
                    value -= matrix[w, rank * stride + column, lane] * held[w, y + i, lane]
                held[w, y + rank, lane] = value
                rank += 1
        contradicts = int(0)
        for i in range(rank, total):  # 0 = 0, or there is no solution
            value = held[w, y + i, lane]
            for r in range(rank):
                column = int(held[w, wp.static(COLUMN) * order + r, lane])
                value -= matrix[w, i * stride + column, lane] * held[w, y + r, lane]
            if wp.abs(value) > bound:
                contradicts = 1
        for back in range(total):
            i = total - 1 - back
            at = int(held[w, wp.static(PLACE) * order + i, lane])
            value = real(0.0)
            if at >= 0:
                value = held[w, y + at, lane]
                for later in range(back):
                    j = total - 1 - later
                    value -= matrix[w, at * stride + j, lane] * held[w, y + j, lane]
                value = value / matrix[w, at * stride + i, lane]
            held[w, y + i, lane] = value
        return contradicts

    return SimpleNamespace(write_equations=write_equations, factor=factor, solve=solve)
