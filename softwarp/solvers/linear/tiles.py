"""Tiles of the factor: two rows by two columns of blocks, which a thread computes at a time, for many worlds on a GPU.

A block of L on its own reads two blocks for each of its products, and a GPU waits for memory most of the time. Two
columns that follow each other in the elimination tree form a *group*; their blocks in two rows are a tile, whose four
products share four blocks. A group counts as one level, so there are about half as many of these, in substitutions
too. No block is stored that L does not have: what a tile lacks is read from a block of zeros behind the others. Where a
level has fewer tiles than there are threads for a world, the sums of long ones are split into parts. Runs once per
solver, on the host. Theory: docs/theory/cholesky.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp.model.structure import Symbolic

IntArray = NDArray[np.integer[Any]]

WORKERS = 16  # threads of a world that parts are made for; others give the same bits
SHARE = 0.5  # rows of a column per row of the column above it, from which on the two are a group
OVERHEAD = 4  # what a tile and the end of a split level cost, in products of a tile
PARTS = (4, 6, 8, 12, 16, 24, 32, 48, 64)  # products of a part that are tried
NONE = -1


@dataclass(frozen=True)
class Tiles:
    """Schedule of factorisation and substitutions by groups of one or two columns; indices are in elimination order.

    Blocks are numbered as in ``Symbolic``; the number after the last one stands for a block of zeros. Groups, tiles and
    pieces are sorted by level. The first tile of a group is its diagonal.
    """

    level_count: int
    part_count: int  # parts of the sums of one level, at most
    group_count: int  # groups of one level, at most

    level_group: IntArray  # (level + 1,) ranges in group
    group: IntArray  # (group, 4) first column, second or -1, their block or zeros, 0
    group_left: IntArray  # (group + 1,) ranges in left
    left: IntArray  # (left, 4) column k to the left, blocks (first, k) and (second, k) or zeros, 0
    group_below: IntArray  # (group + 1,) ranges in below
    below: IntArray  # (below, 4) row i below, blocks (i, first) and (i, second) or zeros, 0

    level_tile: IntArray  # (level + 1,) ranges in tile
    tile: IntArray  # (tile, 4) first column, second or -1, place of the group in its level, whether it is the diagonal
    tile_block: IntArray  # (tile, 4) blocks (row 1, col 1), (1, 2), (2, 1), (2, 2) or -1
    tile_source: IntArray  # (tile, 4) blocks of A they start from, or -1
    entry: IntArray  # (entry + 1, 4) for column k: blocks (row 1, k), (row 2, k), (col 1, k), (col 2, k) or zeros

    level_piece: IntArray  # (level + 1,) ranges in piece
    piece: IntArray  # (piece, 4) tile, range of entries, part of a sum or -1 for all of it
    level_split: IntArray  # (level + 1,) ranges in split
    split: IntArray  # (split, 4) tile, range of parts, 0


def schedule(symbolic: Symbolic) -> Tiles:
    """Group columns, and list what every tile sums up."""
    groups = _groups(symbolic)
    levels = _group_levels(symbolic, groups)
    order = np.argsort(levels, kind="stable")
    level_count = int(levels.max(initial=-1)) + 1
    level_group = np.searchsorted(levels[order], np.arange(level_count + 1))
    lists = _Lists(symbolic)
    for place, g in enumerate(order.tolist()):
        lists.add(groups[g], place - int(level_group[levels[g]]))
    return lists.finish(level_group)


def _groups(symbolic: Symbolic) -> list[tuple[int, int]]:
    """Every column with the one above it, or alone; of several below a column, the one with most rows is its mate."""
    n, parent = symbolic.size, symbolic.parent
    sizes = np.diff(symbolic.col_start)
    mate = np.full(n, NONE)  # child with most rows
    for j in range(n):
        p = parent[j]
        if p >= 0 and (mate[p] < 0 or sizes[j] > sizes[mate[p]]):
            mate[p] = j
    second = np.full(n, NONE)
    is_second = np.zeros(n, dtype=bool)
    for j in range(n):
        child = mate[j]
        if child >= 0 and not is_second[child] and sizes[child] >= SHARE * (sizes[j] + 1):
            second[child], is_second[j] = j, True
    return [(j, int(second[j])) for j in range(n) if not is_second[j]]


def _group_levels(symbolic: Symbolic, groups: list[tuple[int, int]]) -> IntArray:
    """Height of every group above those that it waits for."""
    group_of = np.empty(symbolic.size, dtype=np.int64)
    for g, (one, two) in enumerate(groups):
        group_of[one] = g
        if two >= 0:
            group_of[two] = g
    levels = np.zeros(len(groups), dtype=np.int32)
    for j in range(symbolic.size):  # ascending, so a column's group is known when the column above it asks
        p, g = symbolic.parent[j], group_of[j]
        if p >= 0 and group_of[p] != g:
            levels[group_of[p]] = max(levels[group_of[p]], levels[g] + 1)
    return levels


class _Lists:
    """Lists of a schedule, written group after group."""

    def __init__(self, symbolic: Symbolic) -> None:
        self.symbolic = symbolic
        self.zero = symbolic.block_count
        self.group: list[tuple[int, int, int, int]] = []
        self.left: list[IntArray] = []
        self.below: list[IntArray] = []
        self.tile: list[IntArray] = []
        self.block: list[IntArray] = []
        self.entry: list[IntArray] = []
        self.length: list[IntArray] = []  # entries of every tile

    def add(self, columns: tuple[int, int], place: int) -> None:
        """The group of one or two columns that is at a place of its level."""
        s = self.symbolic
        one, two = columns
        rows_one = s.l_row[s.col_start[one] : s.col_start[one + 1]]
        blocks_one = np.arange(s.col_start[one], s.col_start[one + 1])
        if two < 0:
            rows, corner, first, second = rows_one, self.zero, blocks_one, np.full(rows_one.size, NONE)
        else:  # the second column is the first row of the first, and has all of its other rows
            rows = s.l_row[s.col_start[two] : s.col_start[two + 1]]
            corner, second = int(blocks_one[0]), np.arange(s.col_start[two], s.col_start[two + 1])
            first = np.full(rows.size, NONE)
            first[np.searchsorted(rows, rows_one[1:])] = blocks_one[1:]
        self.group.append((one, two, corner, 0))
        zeros = np.where(first < 0, self.zero, first), np.where(second < 0, self.zero, second)
        self.below.append(_table(rows, *zeros, np.zeros_like(rows)))

        tiles = 1 + (rows.size + 1) // 2
        block = np.full((tiles, 2, 2), NONE)
        block[0] = (one, NONE), (corner if two >= 0 else NONE, two)
        block[1:].reshape(-1, 2)[: rows.size] = np.stack([first, second], axis=1)
        self.block.append(block.reshape(-1, 4).astype(np.int32))
        self.tile.append(_table(np.full(tiles, one), np.full(tiles, two), np.full(tiles, place), np.arange(tiles) == 0))
        self._add_entries(block, one)

    def _add_entries(self, block: IntArray, one: int) -> None:
        """Products of the tiles of a group, each with all that it needs of a column to the left."""
        s = self.symbolic
        target, r, c = np.nonzero(block >= 0)
        stored = block[target, r, c]
        begin, count = s.pair_start[stored], np.diff(s.pair_start)[stored]
        pair = np.repeat(begin - np.cumsum(count) + count, count) + np.arange(int(count.sum()))
        left, right = s.pair_left[pair], s.pair_right[pair]
        k = s.l_col[left].astype(np.int64)
        outside = k != one  # what the first column gives to the second is left to the end
        key = (np.repeat(target, count) * s.size + k)[outside]
        found, inverse = np.unique(key, return_inverse=True)
        entry = np.full((found.size, 4), self.zero, dtype=np.int32)
        entry[inverse, np.repeat(r, count)[outside]] = left[outside]
        entry[inverse, 2 + np.repeat(c, count)[outside]] = right[outside]
        self.entry.append(entry)
        self.length.append(np.bincount(found // s.size, minlength=len(block)))
        of_diagonal = entry[found < s.size]
        self.left.append(
            _table(
                found[found < s.size], of_diagonal[:, 0], of_diagonal[:, 1], np.zeros(len(of_diagonal), dtype=np.int32)
            )
        )

    def finish(self, level_group: IntArray) -> Tiles:
        """All lists, with the work of every level cut into pieces."""
        s = self.symbolic
        block = np.concatenate([*self.block, np.empty((0, 4), dtype=np.int32)])
        length = np.concatenate([*self.length, np.empty(0, dtype=np.int64)])
        start = _starts(length)
        tiles = _starts(np.array([len(b) for b in self.block], dtype=np.int64))
        pieces, splits, level_piece, level_split, parts = [], [], [0], [0], 0
        for begin, end in pairwise(level_group):
            own = np.arange(tiles[begin], tiles[end])
            piece, split, count = _cut(own, start)
            pieces.append(piece)
            splits.append(split)
            level_piece.append(level_piece[-1] + len(piece))
            level_split.append(level_split[-1] + len(split))
            parts = max(parts, count)
        none = np.full((1, 4), self.zero, dtype=np.int32)  # is read ahead and not used
        return Tiles(
            level_count=len(level_group) - 1,
            part_count=parts,
            group_count=int(np.diff(level_group).max(initial=0)),
            level_group=level_group.astype(np.int32),
            group=np.array(self.group, dtype=np.int32).reshape(-1, 4),
            group_left=_starts(np.array([len(x) for x in self.left], dtype=np.int64)),
            left=np.concatenate([*self.left, none]),
            group_below=_starts(np.array([len(x) for x in self.below], dtype=np.int64)),
            below=np.concatenate([*self.below, none]),
            level_tile=tiles[level_group],
            tile=np.concatenate([*self.tile, np.empty((0, 4), dtype=np.int32)]),
            tile_block=block,
            tile_source=np.where(block >= 0, s.l_source[block], NONE).astype(np.int32),
            entry=np.concatenate([*self.entry, none]),
            level_piece=np.array(level_piece, dtype=np.int32),
            piece=np.concatenate([*pieces, np.empty((0, 4), dtype=np.int32)]),
            level_split=np.array(level_split, dtype=np.int32),
            split=np.concatenate([*splits, np.empty((0, 4), dtype=np.int32)]),
        )


def _cut(tiles: IntArray, start: IntArray) -> tuple[IntArray, IntArray, int]:
    """Pieces of the tiles of a level, longest first, those tiles that have several, and the parts of these.

    Of some lengths that a part may have, the one whose busiest thread has least to do is taken.
    """
    length = start[tiles + 1] - start[tiles]
    best, most = _busiest(length), 0
    if tiles.size < 4 * WORKERS:
        for limit in PARTS:
            counts = np.maximum(-(-length // limit), 1)
            if (counts > 1).any():
                cost = _busiest(np.repeat(length // counts, counts)) + OVERHEAD
                if cost < best:
                    best, most = cost, limit
    counts = np.maximum(-(-length // most), 1) if most else np.ones_like(length)
    first = np.cumsum(counts) - counts
    tile, at = np.repeat(np.arange(tiles.size), counts), np.arange(int(counts.sum())) - np.repeat(first, counts)
    begin = start[tiles][tile] + at * length[tile] // counts[tile]
    end = start[tiles][tile] + (at + 1) * length[tile] // counts[tile]
    is_part = counts[tile] > 1
    part = np.where(is_part, np.cumsum(is_part) - 1, NONE)
    piece = _table(tiles[tile], begin, end, part)[np.argsort(begin - end, kind="stable")]
    several = counts > 1
    last = np.cumsum(counts[several])
    split = _table(tiles[several], last - counts[several], last, np.zeros(int(several.sum()), dtype=np.int32))
    return piece, split, int(is_part.sum())


def _busiest(length: IntArray) -> int:
    """Work of the thread that has most, if they take turns at pieces, longest first."""
    work = np.sort(length)[::-1] + OVERHEAD
    return int(work[::WORKERS].sum())


def _starts(counts: IntArray) -> IntArray:
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)


def _table(*columns: IntArray) -> IntArray:
    return np.stack([np.asarray(column) for column in columns], axis=1).astype(np.int32).reshape(-1, 4)
