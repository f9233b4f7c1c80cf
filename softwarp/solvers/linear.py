"""Launches of the batched block Cholesky: factor, forward and backward substitution."""

from __future__ import annotations

from typing import Any

import warp as wp

from softwarp.kernels import cholesky, cholesky_block, cholesky_wide
from softwarp.kernels.lanes import Variant
from softwarp.solvers.rows import Rows, allocate, shape
from softwarp.solvers.symbolic import Symbolic

INDEX_ARRAYS = (
    "parent",
    "l_row",
    "l_col",
    "l_source",
    "col_start",
    "row_start",
    "row_block",
    "pair_start",
    "pair_left",
    "pair_right",
    "level_start",
    "level_col",
    "level_block_start",
    "level_block",
)

SIDE_GROUP = 3  # right-hand sides that one thread carries through a forward substitution


class LinearSolver:
    """``A = L L'`` of all worlds, with right-hand sides solved in place.

    On a CPU a thread handles whole worlds; on a GPU a thread block handles a group of worlds.

    Args:
        symbolic: Shared structure.
        index: Its arrays on the device, from :func:`upload`.
        variant: Scalar type and memory order.
        world_count: Worlds of this solver.
        sides: Right-hand sides that ``forward`` can handle at once.
        device: Warp device.
    """

    def __init__(
        self,
        symbolic: Symbolic,
        index: dict[str, wp.array],
        variant: Variant,
        world_count: int,
        sides: int,
        device: Any,
    ) -> None:
        self.symbolic = symbolic
        self.index = index
        self.variant = variant
        self.device = device
        is_wide = variant.name == "scalar" and variant.real is wp.float32
        self.kernels = cholesky_wide.kernels() if is_wide else cholesky.kernels(variant)
        packs, lanes = shape(variant, world_count)
        self.width = packs * lanes if variant.world_fastest else packs
        self.world_count = world_count
        if variant.world_fastest:
            self.blocks = cholesky_block.kernels(variant)
            self.worlds = cholesky_block.worlds_per_block(world_count)
            workers = cholesky_block.THREADS // self.worlds
            self.part = allocate(variant, world_count, cholesky_block.PART_ROWS * workers, device)
        spare = cholesky_wide.PAD if is_wide else 0
        self.lower: Rows = allocate(variant, world_count, 9 * symbolic.block_count + spare, device)
        self.diagonal: Rows = allocate(variant, world_count, 6 * symbolic.size, device)
        padded = 1 if sides == 1 else SIDE_GROUP * -(-sides // SIDE_GROUP)
        self.y: Rows = allocate(variant, world_count, 3 * symbolic.size * padded + spare, device)

    def factor(self, a: Rows) -> None:
        """Factorise the matrices whose stored blocks are ``a``."""
        k, i, n = self.kernels, self.index, self.symbolic.size
        pairs = [i["pair_start"], i["pair_left"], i["pair_right"]]
        if not self.variant.world_fastest:
            inputs = [n, i["col_start"], i["l_source"], *pairs, a.S]
            self._launch(k.factor_world, self.width, inputs, [self.lower.S, self.diagonal.S])
            return
        levels = [n, self.symbolic.level_count, i["level_block_start"], i["level_block"], i["l_col"], i["l_source"]]
        inputs = [*levels, *pairs, self.world_count, self.worlds, a.S]
        self._cooperate(self.blocks.factor_block, inputs, [self.lower.S, self.diagonal.S])

    def forward(self, sides: int) -> None:
        """``y <- L^-1 y`` for the first ``sides`` right-hand sides."""
        k, i, n = self.kernels, self.index, self.symbolic.size
        rows = [i["l_col"], i["row_start"], i["row_block"], self.lower.S, self.diagonal.S]
        groups = -(-sides // SIDE_GROUP)
        if not self.variant.world_fastest:
            if sides == 1:
                self._launch(k.forward_world, self.width, [n, *rows], [self.y.S])
            else:
                self._launch(k.forward_world3, (self.width, groups), [n, *rows], [self.y.S])
            return
        if sides == 1:
            self._substitute(backward=False)
            return
        levels = [n, self.symbolic.level_count, i["level_start"], i["level_col"]]
        inputs = [*levels, *rows[:3], self.world_count, self.worlds, groups, *rows[3:]]
        self._cooperate(self.blocks.forward_block3, inputs, [self.part.S, self.y.S])

    def backward(self) -> None:
        """``y <- L^-T y`` for the first right-hand side."""
        k, i, n = self.kernels, self.index, self.symbolic.size
        columns = [i["l_row"], i["col_start"], self.lower.S, self.diagonal.S]
        if not self.variant.world_fastest:
            self._launch(k.backward_world, self.width, [n, *columns], [self.y.S])
            return
        self._substitute(backward=True)

    def _substitute(self, backward: bool) -> None:
        i = self.index
        structure = [
            i[name] for name in ("level_start", "level_col", "l_row", "l_col", "col_start", "row_start", "row_block")
        ]
        inputs = [backward, self.symbolic.level_count, *structure, self.world_count, self.worlds]
        inputs += [self.lower.S, self.diagonal.S]
        self._cooperate(self.blocks.substitute_block, inputs, [self.part.S, self.y.S])

    def _cooperate(self, kernel: Any, inputs: list[Any], outputs: list[Any]) -> None:
        threads = cholesky_block.THREADS
        dim = (-(-self.world_count // self.worlds), threads)
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device, block_dim=threads)

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)


def upload(symbolic: Symbolic, device: Any) -> dict[str, wp.array]:
    """Copy the index arrays of a structure to a device."""
    return {name: wp.array(getattr(symbolic, name), dtype=wp.int32, device=device) for name in INDEX_ARRAYS}
