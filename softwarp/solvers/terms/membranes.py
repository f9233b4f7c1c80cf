"""Membranes: thin triangles on nodes of soft bodies. Equations: docs/theory/membrane.md."""

from __future__ import annotations

from softwarp.kernels.elements import attachment, membrane, stored
from softwarp.model.cavities import MembraneModel
from softwarp.solvers.terms.term import Term
from softwarp.solvers.workspace.shard import Shard


class MembraneTerm(Term):
    """Membranes of one shard; their forces follow those of linear tets.

    Args:
        shard: Worlds.
        model: Membranes.
    """

    def __init__(self, shard: Shard, model: MembraneModel) -> None:
        super().__init__(shard)
        self.model = model
        self.k = membrane.kernels(shard.variant, shard.options.project_tangent)
        self.k_gather = stored.kernels(shard.variant)
        self.k_carried = attachment.kernels(shard.variant)
        self.count = len(model.triangles)

    def forces(self) -> None:
        """Corner forces of every triangle."""
        s = self.shard
        s.each(self.k.triangle_force, self.count, self._inputs(s.model.tet_count), [s.work.element_force.S])

    def stiffness(self) -> None:
        """That of all triangles."""
        s = self.shard
        s.each(self.k.triangle_stiffness, self.count, self._inputs(0), [s.work.membrane_stiffness.S])

    def tangent(self, h: float) -> None:
        """Stiffness of all triangles, those at nodes that frames carry among them."""
        s, m, w = self.shard, self.model, self.shard.work
        self.stiffness()
        inputs = [m.element_body, m.membrane_entry_start, m.membrane_entry]
        inputs += [w.body_stiffness.S, w.membrane_stiffness.S]
        s.each(self.k_gather.block_stiffness, s.blocks, inputs, [w.a.S])
        inputs = [m.element_body, m.carried_block, m.carried_start, m.carried_entry, m.carried_weight]
        inputs += [w.body_stiffness.S, w.membrane_stiffness.S, w.lever.S]
        s.each(self.k_carried.stored_stiffness, m.carried_block.size, inputs, [w.a.S])

    def _inputs(self, first: int) -> list[object]:
        m, i = self.model, self.shard.input
        shared = [first, m.tri_node, m.tri_membrane, m.tri_gradient, m.tri_volume]
        return [*shared, i["membrane_youngs"].S, i["membrane_nu"].S, self.shard.work.x.S]
