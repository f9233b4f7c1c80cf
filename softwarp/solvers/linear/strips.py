"""Strips of the factor: neighbouring columns with the same rows below, which a CPU takes through a step together.

A block of L on its own reads two blocks for each of its products, and with eight worlds in lanes a factor is larger
than a core's own cache, so the arithmetic waits. Columns j, j + 1 ... that each are the parent of the one before, with
its rows but for the first, form a *strip* of up to ``WIDTH`` columns. All products of two strips read a block once for
every column of the other one, in the order in which blocks lie in memory. Nothing is stored twice or filled in. Runs
once per simulation, on the host. Theory: docs/theory/cholesky.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from softwarp.model.structure import IntArray, Symbolic

WIDTH = 4  # columns; eight are no faster
NAMES = ("strip_start", "strip_source", "source", "place")  # of the arrays, as kernels take them


@dataclass(frozen=True)
class Strips:
    """Schedule of a factorisation by strips; columns and rows are in elimination order.

    A row of a strip is numbered from its first column on: 0, 1 ... are rows of its own columns, then come those below.
    Where a *source*, a strip further left, has rows among a strip's own columns, the two have products.
    """

    strip_start: IntArray  # (strip + 1,) first column
    strip_source: IntArray  # (strip + 1,) ranges in source
    source: IntArray  # (source, 5) first column, columns, first row below, rows in the strip's columns, start in place
    place: IntArray  # (place,) row of the strip, for a source's rows from the first one on


def schedule(symbolic: Symbolic) -> Strips:
    """Divide the columns into strips, and list the sources of each."""
    start = _starts(symbolic)
    rows = [_rows_below(symbolic, int(end) - 1) for end in start[1:]]
    strip_of = np.repeat(np.arange(start.size - 1), np.diff(start))
    number = np.zeros(symbolic.size, dtype=np.int32)
    sources: list[list[tuple[int, int, int, int]]] = [[] for _ in rows]
    for k, below in enumerate(rows):
        above = strip_of[below]
        cuts = np.flatnonzero(np.diff(above, prepend=-1))
        for cut, end in pairwise([*cuts, below.size]):
            sources[above[cut]].append((k, int(cut), int(end - cut), below.size))
    listed, place, strip_source = [], [], [0]
    length = 0
    for strip, first in enumerate(start[:-1]):
        width = int(start[strip + 1] - first)
        number[first : first + width] = np.arange(width)
        number[rows[strip]] = width + np.arange(rows[strip].size)
        for k, cut, count, size in sources[strip]:
            listed.append((int(start[k]), int(start[k + 1] - start[k]), cut, count, length))
            place.append(number[rows[k][cut:]])
            length += size - cut
        strip_source.append(len(listed))
    return Strips(
        strip_start=start,
        strip_source=np.array(strip_source, dtype=np.int32),
        source=np.array(listed, dtype=np.int32).reshape(-1, 5),
        place=np.concatenate([np.zeros(0, dtype=np.int32), *place]).astype(np.int32),
    )


def _starts(symbolic: Symbolic) -> IntArray:
    """First columns of all strips, and the number of columns."""
    count = np.diff(symbolic.col_start)
    start = [0] if symbolic.size else []
    for j in range(1, symbolic.size):
        is_next = symbolic.parent[j - 1] == j and count[j - 1] == count[j] + 1
        if not is_next or j - start[-1] == WIDTH:
            start.append(j)
    return np.array([*start, symbolic.size], dtype=np.int32)


def _rows_below(symbolic: Symbolic, column: int) -> IntArray:
    return symbolic.l_row[symbolic.col_start[column] : symbolic.col_start[column + 1]]
