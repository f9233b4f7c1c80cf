"""Launches of the batched block LU: factor and solve. Theory: docs/theory/statics.md."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import warp as wp

from softwarp.kernels.linear import lu, lu_column
from softwarp.solvers.linear.cholesky import PAIRS, LinearSolver
from softwarp.solvers.workspace.rows import Rows, allocate


class LUSolver:
    """``A = L U`` of all worlds, in the memory and on the structure of a Cholesky solver that is not used otherwise.

    On a CPU a thread handles whole worlds, packs of them by lists of pairs, single ones by columns. On a GPU a level of
    the elimination tree is a launch over its blocks.

    Args:
        linear: Provides the structure, the memory of L and the right-hand sides ``y``.

    Attributes:
        is_kept: Worlds whose factor ``factor`` leaves as it is, where worlds are taken one at a time; else None.
    """

    def __init__(self, linear: LinearSolver) -> None:
        self.linear = linear
        variant, worlds, device = linear.variant, linear.world_count, linear.device
        self.kernels = lu.kernels(variant)
        blocks = 9 * linear.symbolic.block_count
        self.y = linear.y
        self.lower: Rows = linear.lower if linear.panels is None else allocate(variant, worlds, blocks, device)
        self.upper: Rows = allocate(variant, worlds, blocks, device)
        self.pivot: Rows = allocate(variant, worlds, linear.symbolic.size, device)
        self.column: Rows | None = None
        self.is_kept: wp.array | None = None
        if variant.name == "scalar":
            self.column_kernels = lu_column.kernels("float64" if variant.real is wp.float64 else "float32")
            self.column = allocate(variant, worlds, lu_column.COLUMN_ROWS * linear.symbolic.size, device)
            self.is_kept = wp.zeros(linear.width, dtype=wp.int32, device=device)
        else:
            linear.send_pairs()

    def factor(self, a: Rows, a_upper: Rows) -> None:
        """Factorise; ``a`` holds the blocks on and below the diagonal, ``a_upper`` the transposes of those above."""
        linear, k = self.linear, self.kernels
        i, symbolic = linear.index, linear.symbolic
        if self.column is not None:
            names = ("l_row", "l_col", "l_source", "col_start", "row_start", "row_block")
            inputs = [symbolic.size, *(i[name] for name in names), self.is_kept, a.S, a_upper.S]
            outputs = [self.column.S, self.lower.S, self.upper.S, self.pivot.S]
            self._launch(self.column_kernels.factor_world, linear.width, inputs, outputs)
            return
        source = [i["l_source"], *(i[name] for name in PAIRS)]
        if not linear.variant.world_fastest:
            inputs = [symbolic.size, i["col_start"], *source, a.S, a_upper.S]
            self._launch(k.factor_world, linear.width, inputs, [self.lower.S, self.upper.S, self.pivot.S])
            return
        blocks = symbolic.level_block_start
        for level, (begin, count) in enumerate(self._levels()):
            inputs = [begin, i["level_col"], *source, a.S, self.upper.S]
            self._launch(k.level_diagonal, (count, linear.width), inputs, [self.lower.S, self.pivot.S])
            first, last = int(blocks[level]), int(blocks[level + 1])
            inputs = [first, symbolic.size, i["level_block"], i["l_col"], *source, a.S, a_upper.S]
            self._launch(k.level_block, (last - first, linear.width), inputs, [self.lower.S, self.upper.S])

    def solve(self, sides: int) -> None:
        """``y <- A^-1 y`` for the first ``sides`` right-hand sides."""
        linear, k, y = self.linear, self.kernels, self.y
        i, n = linear.index, linear.symbolic.size
        if self.column is not None:
            inputs = [n, i["l_row"], i["col_start"], self.lower.S, self.upper.S, sides]
            self._launch(self.column_kernels.solve_world, linear.width, inputs, [self.column.S, y.S])
            return
        rows = [i["row_start"], i["row_block"]]
        if not linear.variant.world_fastest:
            inputs = [n, i["l_row"], i["l_col"], i["col_start"], *rows, self.lower.S, self.upper.S]
            self._launch(k.solve_world, (linear.width, sides), inputs, [y.S])
            return
        for begin, count in self._levels():
            inputs = [begin, n, i["level_col"], i["l_col"], *rows, self.lower.S]
            self._launch(k.level_forward, (count, sides, linear.width), inputs, [y.S])
        for begin, count in reversed(self._levels()):
            inputs = [begin, n, i["level_col"], i["l_row"], i["col_start"], self.lower.S, self.upper.S]
            self._launch(k.level_backward, (count, sides, linear.width), inputs, [y.S])

    def _levels(self) -> list[tuple[int, int]]:
        start = self.linear.symbolic.level_start
        return [(int(begin), int(end - begin)) for begin, end in pairwise(start)]

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.linear.device)
