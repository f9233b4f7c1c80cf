"""Structure of the linear system of a step: the pattern of A and L, and lists that gather element blocks into them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

IntArray = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Symbolic:
    """Structure of ``P A P' = L L'`` for one symmetric pattern of 3x3 blocks; every index is in elimination order.

    Blocks of ``A`` and of ``L`` are numbered diagonal first: block ``j`` is the diagonal of column ``j``, and blocks
    ``n`` onwards are the strictly lower ones, column by column with ascending rows.
    """

    order: IntArray  # (n,) elimination position -> input index
    position: IntArray  # (n,) input index -> elimination position
    parent: IntArray  # (n,) next row of the column's pattern: the elimination tree, -1 at a root
    level: IntArray  # (n,) height in the elimination tree; equal levels are independent

    a_row: IntArray  # (a_block,) row of every stored block of A
    a_col: IntArray  # (a_block,)
    l_row: IntArray  # (l_block,) row of every block of L
    l_col: IntArray  # (l_block,)
    l_source: IntArray  # (l_block,) block of A it starts from, -1 for fill

    col_start: IntArray  # (n + 1,) strictly lower blocks of column j: col_start[j] .. col_start[j + 1]
    row_start: IntArray  # (n + 1,) ranges in row_block
    row_block: IntArray  # (l_block - n,) strictly lower blocks of row i, ascending columns

    pair_start: IntArray  # (l_block + 1,) ranges in pair_left, pair_right
    pair_left: IntArray  # (pair,) block (i, k) of the update L_ik L_jk' that block (i, j) receives
    pair_right: IntArray  # (pair,) block (j, k)

    level_start: IntArray  # (level_count + 1,) ranges in level_col
    level_col: IntArray  # (n,) columns sorted by level
    level_block_start: IntArray  # (level_count + 1,) ranges in level_block
    level_block: IntArray  # (l_block,) blocks of L sorted by level of their column

    @property
    def size(self) -> int:
        """Number of block rows."""
        return int(self.order.size)

    @property
    def block_count(self) -> int:
        """Blocks of L, diagonal included."""
        return int(self.l_row.size)

    @property
    def level_count(self) -> int:
        """Height of the elimination tree."""
        return int(self.level_start.size - 1)

    @property
    def flops(self) -> int:
        """Floating point operations of one numeric factorisation."""
        return 54 * int(self.pair_left.size) + 27 * (self.block_count - self.size) + 20 * self.size


class GatherLists(NamedTuple):
    """What some blocks of A, or some nodes, receive from elements with nodes that frames carry."""

    target: wp.array  # (target,) blocks of A, or carried nodes
    start: wp.array  # (target + 1,) ranges in entry
    entry: wp.array  # (entry, 3) code of an element block, left and right carried item; or (entry,) 4 element + corner
    weight: wp.array  # (entry,) that the entry counts with
