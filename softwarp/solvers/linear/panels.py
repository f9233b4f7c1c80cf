"""Panels of the factor: dense groups of columns, and the rounds in which one thread block works through them.

Columns along a path of the elimination tree that nearly share their pattern become one panel with a common list of
rows, at the price of some blocks that hold zeros. Panels that do not depend on each other share a round. Runs once per
structure, on the host. Theory: docs/theory/cholesky.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from softwarp.model.codes import PANEL_FIRST_STEP, PANEL_IDENTITY, PANEL_UPDATE
from softwarp.model.structure import Symbolic

IntArray = NDArray[np.int32]
Table = NDArray[np.integer[Any]]

WIDTH = 16  # columns of a panel, at most; benchmarks/trunk.py
ZERO_SHARE = 0.4  # blocks of a panel that may be zeros, per block of L in it
ZERO_COUNT = 40  # blocks that may be zeros in any case


@dataclass(frozen=True)
class Limits:
    """What a round may hold, in 3x3 blocks.

    Attributes:
        items: Blocks that the threads keep in registers.
        slots: Blocks of the columns in elimination, which pass through shared memory.
        stage: Blocks of L that a substitution reads, in shared memory.
    """

    items: int
    slots: int
    stage: int


@dataclass(frozen=True)
class Panels:
    """Schedule of factorisation and substitutions; every index is in elimination order.

    An item is a 3x3 block that a round computes. A panel of k columns and r rows below them has items for the inverse
    of its triangle, the triangle itself, the rows below it, and the update of those rows by each other, which is left
    for the panel above. An update that has no room in the panel's round is made in later ones, which read the columns
    of L again. Items of a round are sorted by their last step, so that those which are done sooner leave whole
    warps idle. The blocks of a column in elimination lie in slots: the inverse of the pivot, then one for
    each row of the panel's inverse, of its triangle and below it, of which the first two kinds overlap.
    """

    size: int  # block rows n
    lower_rows: int  # scalars that hold L of one world
    update_rows: int  # scalars that hold updates of one world
    round_count: int
    turn_count: int  # rounds with columns, which are the turns of a substitution
    column_limit: int  # columns of a turn, at most
    row_count: int  # rows of all panels, each with its part of a sum in forward substitution

    round_item: IntArray  # (round + 1,) ranges of items
    round_width: IntArray  # (round,) columns of the widest panel
    round_late: IntArray  # (round + 1,) ranges of late rows
    turn_column: IntArray  # (turn + 1,) ranges in the columns
    turn_row: IntArray  # (turn + 1,) ranges in the rows
    turn_lower: IntArray  # (turn + 1,) ranges in L

    item_source: IntArray  # (item, 4) children from and to, block of A (-1 none, PANEL_IDENTITY), target or -1
    item_place: IntArray  # (item, 4) slots of the two rows, steps (last, first, whether an update), target's stride
    child: IntArray  # (child, 2) place and stride of a block among the updates
    late_row: IntArray  # (late row, 4) slot, place in L, rows and columns of the panel

    panel: IntArray  # (panel, 4) panels in order of rounds: first column, columns, panel above or -1, rows
    column_panel: IntArray  # (n,) panel of each column
    position: IntArray  # (n,) place of each block row among the columns
    column: IntArray  # (n, 4) columns in order of rounds: block row, t, k, place of the panel's inverse
    column_lower: IntArray  # (n, 4) place of the panel's rows in L, their number, first of them, first column
    column_part: IntArray  # (n + 1,) ranges in part
    row: IntArray  # (row, 4) rows in order of rounds: place in L, rows of the panel, its columns, the first of them
    row_part: IntArray  # (row + 1,) ranges in part
    row_index: IntArray  # (row,) place of the block row among the columns
    part: IntArray  # (part,) rows of the panels below that belong to a column or row


def fits(symbolic: Symbolic, limits: Limits) -> bool:
    """Whether every column can be a panel of its own."""
    below = int(np.bincount(symbolic.l_col[symbolic.size :], minlength=symbolic.size).max(initial=0))
    return _fits(1, below, limits)


_schedules: WeakKeyDictionary[Symbolic, dict[Limits, Panels]] = WeakKeyDictionary()


def schedule(symbolic: Symbolic, limits: Limits) -> Panels:
    """Group the columns of a structure into panels, and these into rounds; once for all systems that have it."""
    made = _schedules.setdefault(symbolic, {})
    if limits not in made:
        made[limits] = _schedule(symbolic, limits)
    return made[limits]


def _schedule(symbolic: Symbolic, limits: Limits) -> Panels:
    n = symbolic.size
    structure = [symbolic.l_row[symbolic.col_start[j] : symbolic.col_start[j + 1]] for j in range(n)]
    groups = _amalgamate(structure, symbolic.parent, limits)
    rows = [structure[columns[-1]] for columns in groups]
    panel_of = {column: p for p, columns in enumerate(groups) for column in columns}
    above = [panel_of.get(int(symbolic.parent[columns[-1]]), -1) for columns in groups]
    is_late = [
        _size(len(columns), below.size, limits)[0] == len(columns) * (len(columns) + below.size + 1) and below.size > 0
        for columns, below in zip(groups, rows, strict=True)
    ]
    rounds = _rounds(groups, rows, above, is_late, limits)
    return _Writer(symbolic, groups, rows, above, is_late, rounds).write()


def _size(width: int, below: int, limits: Limits) -> tuple[int, int, int]:
    """Items, slots and blocks of L of a panel in its round, with its update if there is room for it."""
    columns, update = width * (width + below + 1), below * (below + 1) // 2
    items = columns if columns + update > limits.items else columns + update
    return items, width + below + 2, width * (width + below)


def _fits(width: int, below: int, limits: Limits) -> bool:
    items, slots, stage = _size(width, below, limits)
    return items <= limits.items and slots <= limits.slots and stage <= limits.stage


def _amalgamate(structure: list[IntArray], parent: IntArray, limits: Limits) -> list[list[int]]:
    """Paths of columns whose dense hull holds few zeros; a column joins the longest path that ends below it."""
    n = len(structure)
    panel_of = [-1] * n
    groups: list[list[int]] = []
    blocks: list[int] = []  # of L in a group
    children: list[list[int]] = [[] for _ in range(n)]
    for j in range(n):
        below = structure[j].size
        best = -1
        for child in children[j]:
            p = panel_of[child]
            width = len(groups[p]) + 1
            hull, true = width * (width + 1) // 2 + width * below, blocks[p] + 1 + below
            is_path = groups[p][-1] == child and width <= WIDTH and _fits(width, below, limits)
            if is_path and hull - true <= max(ZERO_SHARE * true, ZERO_COUNT):
                if best < 0 or len(groups[p]) > len(groups[best]):
                    best = p
        if best < 0:
            best = len(groups)
            groups.append([])
            blocks.append(0)
        groups[best].append(j)
        blocks[best] += 1 + below
        panel_of[j] = best
        if parent[j] >= 0:
            children[parent[j]].append(j)
    return groups


@dataclass
class _Round:
    """What a round works on: whole panels, or ranges (panel, from, to) of late updates."""

    panels: list[int]
    updates: list[tuple[int, int, int]]


def _rounds(
    groups: list[list[int]], rows: list[IntArray], above: list[int], is_late: list[bool], limits: Limits
) -> list[_Round]:
    """Panels of one height in the tree of panels, as many in a round as there is room for, then their late updates."""
    height = np.zeros(len(groups), dtype=np.int32)
    for p in sorted(range(len(groups)), key=lambda q: groups[q][-1]):
        if above[p] >= 0:
            height[above[p]] = max(height[above[p]], height[p] + 1)
    rounds: list[_Round] = []
    room = np.array([limits.items, limits.slots, limits.stage])
    for level in range(int(height.max(initial=-1)) + 1):
        panels = sorted(np.flatnonzero(height == level).tolist(), key=lambda q: (-len(groups[q]), groups[q][0]))
        free = np.zeros(3, dtype=np.int64)
        for p in panels:
            size = np.array(_size(len(groups[p]), rows[p].size, limits))
            if (size > free).any():
                rounds.append(_Round([], []))
                free = room
            rounds[-1].panels.append(p)
            free = free - size
        free_items = free_slots = 0
        for p in panels:
            begin, end = 0, rows[p].size * (rows[p].size + 1) // 2 if is_late[p] else 0
            while begin < end:
                if free_items == 0 or free_slots < rows[p].size:
                    rounds.append(_Round([], []))
                    free_items, free_slots = limits.items, limits.slots
                count = min(free_items, end - begin)
                rounds[-1].updates.append((p, begin, begin + count))
                begin, free_items, free_slots = begin + count, free_items - count, free_slots - rows[p].size
    return rounds


class _Writer:
    """Index arrays of a schedule, round by round.

    Args:
        symbolic: Structure.
        groups: Columns of every panel.
        rows: Rows below every panel.
        above: Panel that holds the first of them, or -1.
        is_late: Whether a panel's update has rounds of its own.
        rounds: All rounds.
    """

    def __init__(
        self,
        symbolic: Symbolic,
        groups: list[list[int]],
        rows: list[IntArray],
        above: list[int],
        is_late: list[bool],
        rounds: list[_Round],
    ) -> None:
        self.symbolic, self.groups, self.rows, self.rounds = symbolic, groups, rows, rounds
        self.above, self.is_late = above, is_late
        widths = np.array([len(columns) for columns in groups], dtype=np.int64)
        counts = np.array([below.size for below in rows], dtype=np.int64)
        sequence = np.array([p for entry in rounds for p in entry.panels], dtype=np.int64)

        def places(sizes: NDArray[np.int64]) -> list[int]:
            """Where each panel begins when all follow each other in order of rounds."""
            begin = np.zeros_like(sizes)
            begin[sequence] = np.cumsum(sizes[sequence]) - sizes[sequence]
            return [int(value) for value in begin]

        self.lower_place = places(9 * widths * (counts + widths))
        self.row_place, self.column_place = places(counts), places(widths)
        self.children: list[list[int]] = [[] for _ in groups]
        for p in sequence.tolist():
            if above[p] >= 0:
                self.children[above[p]].append(p)
        self.update_place, self.update_rows = self._place_updates()
        self.place_of = np.full(symbolic.size, -1, dtype=np.int64)  # of block rows in the list at hand
        self.source = np.full(symbolic.size, -1, dtype=np.int64)  # of blocks in the column at hand
        self.first_block = symbolic.l_source[: symbolic.size]  # of A, on the diagonal
        self.child_count = 0
        self.item_source: list[IntArray] = []
        self.item_place: list[IntArray] = []
        self.child: list[IntArray] = []
        self.late_row: list[IntArray] = []
        self.column: list[IntArray] = []
        self.column_lower: list[IntArray] = []
        self.row: list[IntArray] = []
        self.column_part: list[tuple[Table, Table]] = []  # number of each, and all of them
        self.row_part: list[tuple[Table, Table]] = []

    def _place_updates(self) -> tuple[list[int], int]:
        """Memory of the updates, each of which is kept until the round of the panel above has read it."""
        place = [0] * len(self.groups)
        used: list[tuple[int, int, int]] = []  # begin, end, panel
        limit = 0
        last = {p: turn for turn, entry in enumerate(self.rounds) for p in entry.panels}
        last |= {p: turn for turn, entry in enumerate(self.rounds) for p, _, _ in entry.updates}
        for turn, entry in enumerate(self.rounds):
            for p in entry.panels:
                size = 9 * self.rows[p].size * (self.rows[p].size + 1) // 2
                begin = 0
                for other_begin, other_end, _ in sorted(used):
                    if other_begin - begin >= size:
                        break
                    begin = max(begin, other_end)
                place[p] = begin
                used.append((begin, begin + size, p))
                limit = max(limit, begin + size)
            touched = {*entry.panels, *(p for p, _, _ in entry.updates)}
            read = {child for p in touched if last[p] == turn for child in self.children[p]}
            used = [held for held in used if held[2] not in read]
        return place, limit

    def write(self) -> Panels:
        """All rounds."""
        items, late, columns, rows, lower = [0], [0], [0], [0], [0]
        for entry in self.rounds:
            slot, begin, late_rows = 0, len(self.item_source), 0
            for p in entry.panels:
                self._items(p, slot)
                self._substitution(p)
                slot += len(self.groups[p]) + self.rows[p].size + 2
            for p, first, last in entry.updates:
                self._late_items(p, slot, first, last)
                slot += self.rows[p].size
                late_rows += self.rows[p].size
            late.append(late[-1] + late_rows)
            source, place = (np.concatenate(table[begin:]) for table in (self.item_source, self.item_place))
            order = np.argsort(-(place[:, 2] % PANEL_FIRST_STEP), kind="stable")
            self.item_source[begin:], self.item_place[begin:] = [source[order]], [place[order]]
            items.append(items[-1] + len(order))
            if entry.panels:
                width = [len(self.groups[p]) for p in entry.panels]
                count = [self.rows[p].size for p in entry.panels]
                columns.append(columns[-1] + sum(width))
                rows.append(rows[-1] + sum(count))
                lower.append(lower[-1] + sum(9 * k * (k + r) for k, r in zip(width, count, strict=True)))
        largest = max(lower[-1], self.update_rows, self.child_count)
        if largest > np.iinfo(np.int32).max:
            raise OverflowError(f"the factor of a world has {largest} entries, more than its index can tell apart")
        widths = [
            max(len(self.groups[p]) for p in [*entry.panels, *(p for p, _, _ in entry.updates)])
            for entry in self.rounds
        ]
        column = _table(self.column, 4)
        position = np.empty(self.symbolic.size, dtype=np.int32)
        position[column[:, 0]] = np.arange(self.symbolic.size, dtype=np.int32)
        panel = self._panels()
        index = [self.rows[p] for entry in self.rounds for p in entry.panels]
        counts, parts = zip(*self.column_part, *self.row_part, strict=True)
        part_start = np.concatenate(([0], np.cumsum(np.concatenate(counts))))
        return Panels(
            size=self.symbolic.size,
            lower_rows=lower[-1],
            update_rows=self.update_rows,
            round_count=len(self.rounds),
            turn_count=len(lower) - 1,
            column_limit=int(np.diff(columns).max(initial=0)),
            row_count=rows[-1],
            round_item=np.array(items, dtype=np.int32),
            round_width=np.array(widths, dtype=np.int32),
            round_late=np.array(late, dtype=np.int32),
            turn_column=np.array(columns, dtype=np.int32),
            turn_row=np.array(rows, dtype=np.int32),
            turn_lower=np.array(lower, dtype=np.int32),
            item_source=_table(self.item_source, 4),
            item_place=_table(self.item_place, 4),
            child=_table(self.child, 2),
            late_row=_table(self.late_row, 4),
            panel=panel,
            column_panel=np.repeat(np.arange(len(panel), dtype=np.int32), panel[:, 1]),
            position=position,
            column=column,
            column_lower=_table(self.column_lower, 4),
            column_part=part_start[: len(column) + 1].astype(np.int32),
            row=_table(self.row, 4),
            row_part=part_start[len(column) :].astype(np.int32),
            row_index=position[np.concatenate([np.empty(0, dtype=np.int32), *index])],
            part=np.concatenate(parts).astype(np.int32),
        )

    def _panels(self) -> IntArray:
        """Panels in order of rounds."""
        sequence = [p for entry in self.rounds for p in entry.panels]
        number = {p: at for at, p in enumerate(sequence)} | {-1: -1}
        values = [
            (self.column_place[p], len(self.groups[p]), number[self.above[p]], self.rows[p].size) for p in sequence
        ]
        return np.array(values, dtype=np.int32).reshape(-1, 4)

    def _items(self, p: int, slot: int) -> None:
        """Items of a panel, whose first slot is ``slot``: inverse, triangle, rows below, and their update."""
        group, below = np.array(self.groups[p], dtype=np.int64), self.rows[p].astype(np.int64)
        k, r = group.size, below.size
        lower, inverse = self.lower_place[p], self.lower_place[p] + 9 * k * r
        hull = np.concatenate((group, below))
        source: list[IntArray] = []
        place: list[IntArray] = []
        i, j = np.tril_indices(k + r, m=k)  # row by row
        column = np.lexsort((i, j))
        i, j = i[column], j[column]
        begin, end = self._blocks_below(p, hull[i], hull[j])
        block = self._blocks_of(hull, group)[i, j]
        last = 0
        for t in range(k):
            q = np.arange(t + 1)
            source.append(_rows(0, 0, np.where(q == t, PANEL_IDENTITY, -1), inverse + q * k + t))
            place.append(_rows(slot + 1 + q, slot + t + 2, t + PANEL_FIRST_STEP * q, k * k))
            first, last = last, last + k + r - t
            at = i[first:last] - k
            target = np.where(at >= 0, lower + 9 * t * r + at, -1)
            source.append(_rows(begin[first:last], end[first:last], block[first:last], target))
            place.append(_rows(slot + 2 + k + at, slot + t + 2, t, r))
        self.item_source += source
        self.item_place += place
        if not self.is_late[p]:
            self._update_items(p, slot + 2 + k, 0, r * (r + 1) // 2)

    def _update_items(self, p: int, slot: int, first: int, last: int) -> None:
        """Items of a range of a panel's update, whose rows have the slots from ``slot`` on."""
        below, k = self.rows[p], len(self.groups[p])
        r = below.size
        if first == last:
            return
        a, b = _pairs(r, first, last)
        begin, end = self._blocks_below(p, below[a], below[b])
        self.item_source.append(_rows(begin, end, -1, self.update_place[p] + np.arange(first, last)))
        self.item_place.append(_rows(slot + a, slot + b, k + PANEL_UPDATE, r * (r + 1) // 2))

    def _late_items(self, p: int, slot: int, first: int, last: int) -> None:
        """``_update_items`` of a round of its own, and what it reads of L."""
        self._update_items(p, slot, first, last)
        r, a = self.rows[p].size, np.arange(self.rows[p].size)
        self.late_row.append(_rows(slot + a, self.lower_place[p] + a, r, len(self.groups[p])))

    def _blocks_of(self, hull: Table, group: Table) -> Table:
        """Blocks of A that are blocks (hull, group) of L, or -1."""
        symbolic = self.symbolic
        blocks = np.full((hull.size, group.size), -1, dtype=np.int64)
        for t, j in enumerate(group.tolist()):
            begin, end = symbolic.col_start[j], symbolic.col_start[j + 1]
            rows = symbolic.l_row[begin:end]
            self.source[rows] = symbolic.l_source[begin:end]
            self.source[j] = self.first_block[j]
            blocks[:, t] = self.source[hull]
            self.source[rows] = self.source[j] = -1
        return blocks

    def _met(self, p: int, i: Table) -> Iterator[tuple[int, Table]]:
        """Panels below a panel, and where each has these block rows among its own, or -1."""
        for child in self.children[p]:
            rows = self.rows[child]
            self.place_of[rows] = np.arange(rows.size)
            yield child, self.place_of[i]
            self.place_of[rows] = -1

    def _blocks_below(self, p: int, i: Table, j: Table) -> tuple[Table, Table]:
        """Ranges of the updates of blocks (i, j) by the panels below a panel."""
        block: list[Table] = [np.empty(0, dtype=np.int64)]
        update: list[IntArray] = [np.empty((0, 2), dtype=np.int32)]
        for child, at in self._met(p, np.stack((i, j))):
            met = np.flatnonzero((at >= 0).all(axis=0))
            (a, b), r = at[:, met], self.rows[child].size
            block.append(met)
            update.append(_rows(self.update_place[child] + b * r - b * (b - 1) // 2 + a - b, r * (r + 1) // 2))
        blocks = np.concatenate(block)
        self.child.append(np.concatenate(update)[np.argsort(blocks, kind="stable")])
        end = self.child_count + np.cumsum(np.bincount(blocks, minlength=i.size))
        begin = np.concatenate(([self.child_count], end[:-1]))[: i.size]
        self.child_count += blocks.size
        return begin, end

    def _substitution(self, p: int) -> None:
        """Columns and rows of a panel."""
        group, below = np.array(self.groups[p], dtype=np.int64), self.rows[p].astype(np.int64)
        k, r, lower = group.size, below.size, self.lower_place[p]
        self.column.append(_rows(group, np.arange(k), k, lower + 9 * k * r))
        self.column_lower.append(_rows(np.full(k, lower), r, self.row_place[p], self.column_place[p]))
        self.column_part.append(self._parts_below(p, group))
        self.row.append(_rows(lower + np.arange(r), r, k, self.column_place[p]))
        self.row_part.append(self._parts_below(p, below))

    def _parts_below(self, p: int, i: Table) -> tuple[Table, Table]:
        """Number of the rows of panels below a panel that are block rows i, and these rows, one i after the other."""
        index: list[Table] = [np.empty(0, dtype=np.int64)]
        part: list[Table] = [np.empty(0, dtype=np.int64)]
        for child, at in self._met(p, i):
            met = np.flatnonzero(at >= 0)
            index.append(met)
            part.append(self.row_place[child] + at[met])
        indices = np.concatenate(index)
        return np.bincount(indices, minlength=i.size), np.concatenate(part)[np.argsort(indices, kind="stable")]


def _pairs(count: int, first: int, last: int) -> tuple[Table, Table]:
    """Rows and columns of a range of the blocks of a lower triangle, column after column."""
    column = np.arange(count)
    start = column * count - column * (column - 1) // 2
    pair = np.arange(first, last)
    b = np.searchsorted(start, pair, side="right") - 1
    return pair - start[b] + b, b


def _rows(*values: Table | int) -> IntArray:
    """Rows of a table, from its columns, the first of which is an array or, like the others, a number for all."""
    count = max((value.size for value in values if isinstance(value, np.ndarray)), default=1)
    rows = np.empty((count, len(values)), dtype=np.int32)
    for n, value in enumerate(values):
        rows[:, n] = value
    return rows


def _table(values: list[IntArray], width: int) -> IntArray:
    return np.concatenate([np.empty((0, width), dtype=np.int32), *values])
