"""Gradients of hexahedra in a step: by corners and by moduli. Theory: docs/theory/adjoint.md."""

from __future__ import annotations

from collections.abc import Iterable

from softwarp.kernels.elements import adjoint as of_tets
from softwarp.kernels.elements import hex_adjoint, hexahedral
from softwarp.solvers.terms.hexes import HexTerm
from softwarp.solvers.terms.term import Term
from softwarp.solvers.workspace.rows import Rows
from softwarp.solvers.workspace.shard import Shard


class HexAdjoint:
    """Gradients of all hexahedra of one shard.

    Args:
        shard: Worlds.
        term: Their forces and stiffness.

    Attributes:
        parameter: By the moduli and by Rayleigh's beta, ``adjoint.ROWS`` a hexahedron.
    """

    def __init__(self, shard: Shard, term: HexTerm) -> None:
        self.shard, self.term = shard, term
        self.k = hex_adjoint.kernels(shard.variant)
        self.parameter = shard.rows(of_tets.ROWS * term.model.count)

    @classmethod
    def of(cls, shard: Shard, terms: Iterable[Term]) -> HexAdjoint | None:
        """Those of the terms of a system; None without hexahedra."""
        return next((cls(shard, term) for term in terms if isinstance(term, HexTerm)), None)

    def pull(self, v: Rows, p: Rows, stiffness: Rows, h: float, corner: Rows, *, parameters: bool = True) -> None:
        """Gradients by corners and by parameters; as ``TetAdjoint.pull``."""
        s, t, m, w = self.shard, self.term, self.term.model, self.shard.work
        inputs = [t.first, hexahedral.CORNERS, m.mode_ratio.shape[1], parameters, h, m.hex_node, *t.elements]
        inputs += [m.hex_volume, m.shape_x, m.shape_gradient, m.shape_lam]
        inputs += [m.mode_mu, m.mode_lam, m.mode_ratio, s.model.body_guard]
        inputs += [w.body_mu.real, w.body_lam.real, stiffness.real, w.hex_stiffness.real]
        inputs += [w.x.real, v.real, p.real]
        s.each_real(self.k.hex_adjoint, m.count, inputs, [corner.real, self.parameter.real])
