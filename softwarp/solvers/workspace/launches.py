"""Launch shapes and arrays of the worlds of one shard."""

from __future__ import annotations

from typing import Any

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.step import transfer
from softwarp.solvers.workspace import rows
from softwarp.solvers.workspace.rows import Rows


class Launches:
    """How kernels run on the worlds of one shard.

    Args:
        variant: Scalar type and memory order.
        world_count: Worlds.
        device: Warp device.

    Attributes:
        packs, lanes: Arrangement of the worlds.
        width: Elements of a row.
        k_state: Kernels of ``kernels.step.transfer``.
    """

    def __init__(self, variant: Variant, world_count: int, device: Any) -> None:
        self.variant, self.world_count, self.device = variant, world_count, device
        self.packs, self.lanes = rows.shape(variant, world_count)
        self.width = self.packs * self.lanes if variant.world_fastest else self.packs
        self.k_state = transfer.kernels(variant)

    def rows(self, count: int) -> Rows:
        """Zeroed array of some rows."""
        return rows.allocate(self.variant, self.world_count, count, self.device)

    def integers(self, count: int) -> Rows:
        """The same of integers."""
        return rows.allocate(self.variant, self.world_count, count, self.device, wp.int32)

    def each(self, kernel: Any, items: int, inputs: list[Any], outputs: list[Any]) -> None:
        """Launch a kernel of elements over (w, item)."""
        if items:
            dim = self.variant.dim(self.width, items)
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def each_world(self, kernel: Any, inputs: list[Any], outputs: list[Any], threads: int = 256) -> None:
        """Launch a kernel of elements over w, on a GPU in blocks of some threads."""
        wp.launch(kernel, dim=self.width, inputs=inputs, outputs=outputs, device=self.device, block_dim=threads)

    def each_real(self, kernel: Any, items: int | None, inputs: list[Any], outputs: list[Any]) -> None:
        """Launch a kernel of single worlds over (pack, item, lane), or over (pack, lane)."""
        dim = (self.packs, self.lanes) if items is None else (self.packs, items, self.lanes)
        if items != 0:
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def place(self, value: Rows, count: int, target: Rows, first: int) -> None:
        """Copy ``count`` rows to those of ``target`` from ``first`` on."""
        parts = self.variant.parts(count)
        self.each_real(self.k_state.place_rows, parts, [first, count, value.real], [target.real])

    def add(self, value: Rows, target: Rows, count: int) -> None:
        """Add the first ``count`` rows to those of ``target``."""
        self.each_real(self.k_state.add_rows, self.variant.parts(count), [count, value.real], [target.real])
