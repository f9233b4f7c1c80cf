"""Even multipliers for rows of cables and chambers that repeat each other. Theory: docs/theory/delassus.md."""

from __future__ import annotations

import numpy as np
import warp as wp

from softwarp.kernels.rows import sharing
from softwarp.model.model import Model
from softwarp.solvers.workspace import rows
from softwarp.solvers.workspace.rows import Rows
from softwarp.solvers.workspace.shard import Shard


def may_repeat(model: Model) -> bool:
    """Whether two rows of cables and chambers act on the same dofs, as all on one reduced body do."""
    count = driven_rows(model)
    if count < 2:
        return False
    start, dof = model.row_entry_start.numpy(), model.entry_dof.numpy()
    found = [tuple(sorted(dof[start[row] : start[row + 1]].tolist())) for row in range(count)]
    return len(set(found)) < count


def driven_rows(model: Model) -> int:
    """Rows of cables and chambers; those of joints follow."""
    return model.first_row("cavity") + model.cavity_count


class Sharing:
    """Least multipliers after a solve, where rows of one shard may repeat each other.

    Args:
        shard: Worlds.
    """

    def __init__(self, shard: Shard) -> None:
        self.shard, self.count = shard, driven_rows(shard.model)
        self.k = sharing.kernels(shard.variant)
        self.factor, self.null = (shard.rows(self.count**2) for _ in range(2))
        self.way, self.gap = shard.rows(self.count), shard.rows(shard.model.row_count)
        self.none = rows.allocate(shard.variant, shard.world_count, 1, shard.device, wp.int32)
        self.all = wp.array(np.arange(shard.model.row_count), dtype=wp.int32, device=shard.device)

    def keep(self, gap: Rows) -> Rows:
        """A copy of free gaps, for sweeps that change them."""
        self.gap.copy_from(gap)
        return self.gap

    def share(
        self,
        matrix: Rows,
        order: int,
        gap: Rows,
        change: Rows,
        tolerance: float,
        bounded: wp.array | None = None,
        contacts: Rows | None = None,
    ) -> None:
        """Change multipliers where nothing moves.

        Args:
            matrix: W, whose rows have ``order`` entries.
            order: Likewise.
            gap: Gaps before the solve.
            change: What the solve changed.
            tolerance: Most that a gap may move [m].
            bounded: Rows that are not eliminated from W, if not all of them.
            contacts: How many contacts there are, if the scene has any.
        """
        s, w = self.shard, self.shard.work
        inputs = [self.count, order, s.model.row_count, tolerance, self.all if bounded is None else bounded]
        inputs += [(contacts or self.none).real, matrix.real, gap.real]
        inputs += [w.compliance.real, w.lower_bound.real, w.upper_bound.real]
        outputs = [self.factor.real, self.null.real, self.way.real, w.multiplier.real, change.real]
        s.each_real(self.k.share_rows, None, inputs, outputs)
