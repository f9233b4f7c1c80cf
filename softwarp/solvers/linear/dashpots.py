"""Dashpots in bodies with flat or inverted elements, in float32. Theory: docs/theory/corotational.md."""

from __future__ import annotations

import numpy as np
import warp as wp

from softwarp.kernels.linear import dashpots
from softwarp.solvers.linear.free_bodies import roots
from softwarp.solvers.workspace.rows import Rows
from softwarp.solvers.workspace.shard import Shard


class Dashpots:
    """Those of one shard's worlds, along all edges of a body.

    Args:
        shard: Worlds, inputs and workspace.
        held: Receives a 1 for each world that has some in a step, (pack, 1, lane).

    Attributes:
        strength: Entry of A that each edge of a part gets, 0 without; (w, part).
    """

    def __init__(self, shard: Shard, held: wp.array) -> None:
        self.shard, self.held, m = shard, held, shard.model
        self.k = dashpots.kernels(shard.variant)
        root = roots(m.symbolic.parent)
        order = np.argsort(root, kind="stable")
        last, part, sizes = np.unique(root, return_inverse=True, return_counts=True)
        self.count = last.size

        def send(values: np.ndarray) -> wp.array:
            return wp.array(values.astype(np.int32), dtype=wp.int32, device=m.device)

        self.part_start, self.part_dof = send(np.cumsum([0, *sizes])), send(order)
        self.dof_part = send(part)
        self.strength = shard.rows(self.count)

    def dampen(self, a: Rows) -> None:
        """Add them to A."""
        s, m, w = self.shard, self.shard.model, self.shard.work
        inputs = [s.lanes, self.part_start, self.part_dof, m.dof_node, m.node_body, s.state.compression]
        inputs += [w.body_mass.real, w.node_mass.real, a.real]
        s.each_real(self.k.gauge, self.count, inputs, [self.strength.real, self.held])
        inputs = [self.dof_part, m.neighbour_start, m.neighbour, m.neighbour_block, self.strength.real]
        s.each_real(self.k.dampen, s.variant.parts(m.dof_count), inputs, [a.real])
