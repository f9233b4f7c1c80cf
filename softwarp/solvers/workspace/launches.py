"""Launch shapes and arrays of the worlds of one shard."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.solvers.workspace import rows
from softwarp.solvers.workspace.rows import Rows


class Launches:
    """What ``System`` launches kernels with; it sets the attributes.

    Attributes:
        variant: Scalar type and memory order.
        world_count: Worlds of the shard.
        packs, lanes: Their arrangement.
        width: Elements of a row.
        device: Warp device.
        k_state: Kernels of ``kernels.step.state``.
    """

    variant: Variant
    world_count: int
    packs: int
    lanes: int
    width: int
    device: Any
    k_state: SimpleNamespace

    def _rows(self, count: int) -> Rows:
        return rows.allocate(self.variant, self.world_count, count, self.device)

    def each(self, kernel: Any, items: int, inputs: list[Any], outputs: list[Any]) -> None:
        """Launch a kernel of elements over (w, item)."""
        if items:
            dim = self.variant.dim(self.width, items)
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def each_world(self, kernel: Any, inputs: list[Any], outputs: list[Any]) -> None:
        """Launch a kernel of elements over w."""
        wp.launch(kernel, dim=self.width, inputs=inputs, outputs=outputs, device=self.device)

    def each_real(self, kernel: Any, items: int | None, inputs: list[Any], outputs: list[Any]) -> None:
        """Launch a kernel of single worlds over (pack, item, lane), or over (pack, lane)."""
        dim = (self.packs, self.lanes) if items is None else (self.packs, items, self.lanes)
        if items != 0:
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def place(self, value: Rows, count: int, target: Rows, first: int) -> None:
        """Copy ``count`` rows to those of ``target`` from ``first`` on."""
        self.each_real(self.k_state.place_rows, count, [first, value.real], [target.real])
