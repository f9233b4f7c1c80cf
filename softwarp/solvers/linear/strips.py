"""Strips of the factor: neighbouring columns with the same rows below, which a CPU takes through a step together.

A block of L on its own reads two blocks for each of its products, and with eight worlds in lanes a factor is larger
than a core's own cache, so the arithmetic waits. Columns j, j + 1 ... that each are the parent of the one before, with
its rows but for the first, form a *strip* of up to ``WIDTH`` columns. All products of two strips read a block once for
every column of the other one, in the order in which blocks lie in memory. Nothing is stored twice or filled in. A
large world by itself goes strip by strip, too (``runs``). Runs once per structure, on the host. Theory:
docs/theory/cholesky.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from weakref import WeakKeyDictionary

import numpy as np

from softwarp.kernels.linear.cholesky_runs import MOST
from softwarp.kernels.linear.cholesky_strips import WIDTH
from softwarp.model.structure import IntArray, Symbolic

ALONE_FROM = 20  # products for every block of L, from which on wide strips pay for a world by itself
NAMES = ("strip_start", "strip_source", "source", "place")  # of the arrays, as kernels take them
RUN_NAMES = ("run_strip_start", "run_strip_source", "run_source", "run_place", "run")  # those for one world at a time


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


@dataclass(frozen=True)
class Runs:
    """The same for a world by itself: rows of a source that follow one another in the strip too go together.

    Strips are wider, as all columns of one share the work of its sources.
    """

    run_strip_start: IntArray  # (strip + 1,) first column
    run_strip_source: IntArray  # (strip + 1,) ranges in run_source
    run_source: IntArray  # (source + 1, 6) as Strips.source, then the first of its runs; the last one ends the list
    run_place: IntArray  # (place,) row of the strip, for those rows of a source that lie in the strip's columns
    run: IntArray  # (run, 3) first of the other rows, counted as those of the source, and of the strip; rows


def pay_alone(symbolic: Symbolic) -> bool:
    """Whether a world by itself goes by wide strips; with few products narrow ones are the faster way."""
    return symbolic.pair_left.size >= ALONE_FROM * symbolic.block_count


def runs(symbolic: Symbolic) -> Runs:
    """Strips of a world by itself, and the runs of each source."""
    strips = schedule(symbolic, MOST)
    own = strips.source[:, 3]
    size = np.diff(np.append(strips.source[:, 4], strips.place.size))
    is_own = np.arange(strips.place.size) - np.repeat(strips.source[:, 4], size) < np.repeat(own, size)
    others, first = strips.place[~is_own], np.append(0, np.cumsum(size - own))
    is_cut = np.diff(others, prepend=-2) != 1
    is_cut[first[:-1][size > own]] = True  # runs end with their source
    cuts = np.flatnonzero(is_cut)
    source = np.repeat(np.arange(own.size), size - own)[cuts]
    inside = own[source] + cuts - first[source]
    begin = np.column_stack([np.append(0, np.cumsum(own)), np.searchsorted(cuts, first)])
    return Runs(
        run_strip_start=strips.strip_start,
        run_strip_source=strips.strip_source,
        run_source=np.hstack([np.pad(strips.source[:, :4], ((0, 1), (0, 0))), begin]).astype(np.int32),
        run_place=strips.place[is_own],
        run=np.stack([inside, others[cuts], np.diff(cuts, append=others.size)], axis=1).astype(np.int32),
    )


_schedules: WeakKeyDictionary[Symbolic, dict[int, Strips]] = WeakKeyDictionary()


def schedule(symbolic: Symbolic, most: int = WIDTH) -> Strips:
    """Divide the columns into strips of some at most, and list the sources of each; once for all systems."""
    made = _schedules.setdefault(symbolic, {})
    if most not in made:
        made[most] = _schedule(symbolic, most)
    return made[most]


def _schedule(symbolic: Symbolic, most: int) -> Strips:
    start = starts(symbolic, most)
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


def starts(symbolic: Symbolic, most: int) -> IntArray:
    """First columns of all strips, and the number of columns."""
    count = np.diff(symbolic.col_start)
    start = [0] if symbolic.size else []
    for j in range(1, symbolic.size):
        is_next = symbolic.parent[j - 1] == j and count[j - 1] == count[j] + 1
        if not is_next or j - start[-1] == most:
            start.append(j)
    return np.array([*start, symbolic.size], dtype=np.int32)


def _rows_below(symbolic: Symbolic, column: int) -> IntArray:
    return symbolic.l_row[symbolic.col_start[column] : symbolic.col_start[column + 1]]
