"""Tractions: dead loads per area of faces. Equations: docs/theory/traction.md."""

from __future__ import annotations

from softwarp.kernels.elements import traction
from softwarp.model.tractions import TractionModel
from softwarp.solvers.terms.term import Term
from softwarp.solvers.workspace.shard import Shard


class TractionTerm(Term):
    """Tractions on soft bodies of one shard.

    Args:
        shard: Worlds.
        model: Tractions.
    """

    follows_paths = has_exact_tangent = True

    def __init__(self, shard: Shard, model: TractionModel) -> None:
        super().__init__(shard)
        self.model = model
        self.k = traction.kernels(shard.variant)

    def load(self) -> None:
        """Flags for commands that are not finite."""
        self.shard.check_finite(self.shard.input["command_traction"], 3 * self.model.count)

    def weigh(self) -> None:
        """Add to the external forces of the nodes of loaded faces."""
        s, m = self.shard, self.model
        inputs = [m.loaded_node, m.entry_start, m.entry_traction, m.entry_share, s.input["command_traction"].S]
        s.each(self.k.add_tractions, m.loaded_node.size, inputs, [s.work.node_external.S])
