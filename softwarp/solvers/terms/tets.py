"""Linear tetrahedra: those of soft bodies, and those at the Gauss points of quadratic ones.

Equations: docs/theory/corotational.md, docs/theory/hyperelastic.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.elements import access, corotational, hyperelastic, spectral, stored, turning, warped
from softwarp.model.codes import TURNED
from softwarp.solvers.terms.term import Term, load_factor
from softwarp.solvers.workspace.rows import Rows
from softwarp.solvers.workspace.shard import Shard


@dataclass(frozen=True)
class TetArrays:
    """Linear tetrahedra in the model, and their rows in the workspace.

    Attributes:
        laws: Law of the kernels -> indices of its tets.
        node, body, gradient, volume, frame: As ``Model.tet_node`` and so on.
        size: As ``Model.tet_size``.
        x: Positions that ``node`` refers to.
        force: Corner forces, 12 a tet.
        turned: Turned gradients of tets with a law in ``codes.TURNED``.
        stiffness: Ten blocks of all others.
        turning: How rotations follow positions; in exact workspaces.
    """

    laws: dict[str, wp.array]
    node: wp.array
    body: wp.array
    gradient: wp.array
    volume: wp.array
    frame: wp.array
    size: wp.array
    x: Rows
    force: Rows
    turned: Rows
    stiffness: Rows
    turning: Rows


class LinearTets:
    """Forces and element stiffness of some linear tetrahedra.

    Args:
        shard: Worlds.
        tets: Their arrays.
    """

    def __init__(self, shard: Shard, tets: TetArrays) -> None:
        self.shard, self.tets = shard, tets
        self.turned = [law for law in tets.laws if law in TURNED]
        self.stored = [law for law in tets.laws if law not in TURNED]

    def forces(self) -> None:
        """Corner forces; of turned laws also the turned gradients."""
        s, t, w = self.shard, self.tets, self.shard.work
        for law, chosen in t.laws.items():
            shared = [chosen, t.node, t.body, t.gradient, t.volume]
            if law in self.turned:
                kernel = corotational.force_kernels(s.variant) if law == "large" else warped.kernels(s.variant)
                inputs = [*shared, t.size, t.frame, s.model.body_guard, w.body_mu.S, w.body_lam.S, t.x.S]
                s.each(kernel.tet_force, self._items(chosen), inputs, [t.turned.S, t.force.S])
            else:
                inputs = [*shared, *self._law_inputs(), t.x.S]
                s.each(hyperelastic.kernels(s.variant, law).tet_force, self._items(chosen), inputs, [t.force.S])

    def stiffness(self) -> None:
        """Blocks of the tets that store their stiffness."""
        s, t = self.shard, self.tets
        for law in self.stored:
            kernel, chosen = self._spectral(law).tet_stiffness, t.laws[law]
            inputs = [chosen, t.node, t.body, t.gradient, t.volume, *self._law_inputs(), t.x.S]
            s.each(kernel, self._items(chosen), inputs, [t.stiffness.S])

    def add_stiffness(self, block: wp.array) -> None:
        """The same, added to A at once, one world or pack by one thread."""
        s, t, w = self.shard, self.tets, self.shard.work
        for law in self.stored:
            inputs = [t.laws[law], t.node, t.body, t.gradient, t.volume, block]
            inputs += [*self._law_inputs(), t.x.S, w.body_stiffness.S]
            s.each_world(self._spectral(law).add_stiffness, inputs, [w.a.S])

    def _spectral(self, law: str) -> SimpleNamespace:
        return spectral.kernels(self.shard.variant, law, self.shard.options.project_tangent)

    def _items(self, chosen: wp.array) -> int:
        """Threads for some tets."""
        per_item: int = access.functions(self.shard.variant).per_item
        return -(-int(chosen.size) // per_item)

    def _law_inputs(self) -> list[wp.array]:
        """Lame constants of all bodies, and the parameters that laws have of their own."""
        s, w = self.shard, self.shard.work
        return [s.model.body_law_start, w.body_mu.real, w.body_lam.real, s.input["law_parameter"].real]

    def turn(self) -> None:
        """How the rotations of turned laws follow positions."""
        s, t, w = self.shard, self.tets, self.shard.work
        k = turning.kernels(s.variant)
        for law in self.turned:
            chosen, kernel = t.laws[law], k.tet_turning if law == "large" else k.warped_turning
            inputs = [chosen, t.node, t.body, t.gradient, t.volume, t.frame]
            inputs += [w.body_mu.real, w.body_lam.real, t.x.real]
            s.each_real(kernel, chosen.size, inputs, [t.turning.real])


class TetTerm(Term):
    """Linear tetrahedra of soft bodies."""

    follows_paths = has_exact_tangent = True

    def __init__(self, shard: Shard) -> None:
        super().__init__(shard)
        m, w = shard.model, shard.work
        arrays = (m.tet_node, m.tet_body, m.tet_gradient, m.tet_volume, m.tet_frame)
        rows = (w.x, w.element_force, w.tet_gradient, w.tet_stiffness, w.tet_turning)
        self.tets = LinearTets(shard, TetArrays(m.law_tets, *arrays, m.tet_size, *rows))
        is_read = m.frames is not None and "stored" in m.frames.carried_blocks | m.frames.held_nodes
        is_read = is_read or m.reduction is not None
        self.adds = bool(self.tets.stored) and not shard.variant.world_fastest and not is_read

    def forces(self) -> None:
        """Corner forces of every tet."""
        self.tets.forces()

    def tangent(self, h: float) -> None:
        """Stiffness of every tet."""
        s, m, w = self.shard, self.shard.model, self.shard.work
        if self.tets.turned:
            inputs = [corotational.TURNED_ROWS, corotational.TURNED_BITS]
            inputs += [m.tet_body, m.large_entry_start, m.large_entry]
            inputs += [w.body_mu.S, w.body_lam.S, w.body_stiffness.S, w.tet_gradient.S]
            s.each(corotational.kernels(s.variant).block_stiffness, s.variant.parts(s.blocks), inputs, [w.a.S])
        if self.adds:
            self.tets.add_stiffness(m.stored_block)
        elif self.tets.stored:
            self.tets.stiffness()
            inputs = [m.tet_body, m.stored_entry_start, m.stored_entry, w.body_stiffness.S, w.tet_stiffness.S]
            s.each(stored.kernels(s.variant).block_stiffness, s.blocks, inputs, [w.a.S])

    def load_tangent(self, h: float) -> None:
        """The symmetric part of what ``turn`` adds, if asked for; elements whose corners frames carry go without."""
        if self.shard.options.turning_tangent:
            self._add_turning(0.5 * load_factor(h), self.shard.work.a)

    def turn(self, a_upper: Rows) -> None:
        """What the rotations of turned laws depend on positions."""
        self._add_turning(1.0, a_upper)

    def _add_turning(self, scale: float, a_upper: Rows) -> None:
        if not self.tets.turned:
            return
        s, m, w = self.shard, self.shard.model, self.shard.work
        self.tets.turn()
        inputs = [scale, m.large_entry_start, m.large_entry, w.tet_turning.S]
        s.each(turning.kernels(s.variant).block_turning, s.blocks, inputs, [w.a.S, a_upper.S])
