"""Quadratic tetrahedra: linear ones at their Gauss points. Equations: docs/theory/quadratic.md."""

from __future__ import annotations

from softwarp.kernels.elements import hexahedral, quadratic, stored
from softwarp.model.quadratic import QuadraticModel
from softwarp.solvers.terms.term import Term, load_factor
from softwarp.solvers.terms.tets import LinearTets, TetArrays
from softwarp.solvers.workspace.rows import Rows
from softwarp.solvers.workspace.shard import Shard


class QuadraticTerm(Term):
    """Quadratic tetrahedra of soft bodies.

    Args:
        shard: Worlds.
        model: Elements; their forces follow those of linear tets and membranes.
    """

    follows_paths = has_exact_tangent = True

    def __init__(self, shard: Shard, model: QuadraticModel) -> None:
        super().__init__(shard)
        self.model = model
        self.k = quadratic.kernels(shard.variant)
        self.k_inertia = quadratic.inertia_kernels(shard.variant)
        self.k_stored = stored.kernels(shard.variant)
        self.k_turning = quadratic.turning_kernels(shard.variant)
        m, w = model, shard.work
        behind = 3 * hexahedral.CORNERS * shard.model.hex_count
        self.first = w.element_force.real.shape[1] - 3 * quadratic.NODES * m.count - behind
        arrays = (m.point_tet, m.point_body, m.point_gradient, m.point_volume, m.point_frame)
        rows = (w.gauss_corner, w.gauss_force, w.gauss_gradient, w.gauss_stiffness, w.gauss_turning)
        self.points = LinearTets(shard, TetArrays(m.law_points, *arrays, m.point_size, *rows))

    def forces(self) -> None:
        """Forces of the ten nodes of every element."""
        s, m, w = self.shard, self.model, self.shard.work
        s.each(self.k.point_corners, m.count, [m.element_node, w.x.S], [w.gauss_corner.S])
        self.points.forces()
        s.each(self.k.spread_force, m.count, [self.first, w.gauss_force.S], [w.element_force.S])

    def weigh(self) -> None:
        """Consistent weight of the nodes; needs that of their lumped mass."""
        s, m, i = self.shard, self.model, self.shard.input
        inputs = [m.weight_node, m.weight_volume, s.model.node_body, i["density"].S, i["gravity"].S]
        s.each(self.k_inertia.add_weight, m.weight_node.size, inputs, [s.work.node_external.S])

    def tangent(self, h: float) -> None:
        """Stiffness of all elements."""
        s, m, w = self.shard, self.model, self.shard.work
        for law in self.points.turned:
            chosen = m.law_points[law]
            s.each(
                self.k.spread_gradient, chosen.size // self.k.gather, [chosen, w.gauss_gradient.S], [w.gauss_shape.S]
            )
        if self.points.turned:
            inputs = [m.point_body, m.large_entry_start, m.large_entry]
            inputs += [w.body_mu.S, w.body_lam.S, w.body_stiffness.S, w.gauss_shape.S]
            s.each(self.k.block_stiffness, s.blocks, inputs, [w.a.S])
        if self.points.stored:
            self.points.stiffness()
            inputs = [m.point_body, m.stored_entry_start, m.stored_entry, m.stored_weight]
            inputs += [w.body_stiffness.S, w.gauss_stiffness.S]
            s.each(self.k_stored.weighted_stiffness, s.blocks, inputs, [w.a.S])

    def load_tangent(self, h: float) -> None:
        """The symmetric part of what ``turn`` adds, if asked for; elements whose corners frames carry go without."""
        if self.shard.options.turning_tangent:
            self._add_turning(0.5 * load_factor(h), self.shard.work.a)

    def turn(self, a_upper: Rows) -> None:
        """What the rotations of turned laws depend on positions."""
        self._add_turning(1.0, a_upper)

    def _add_turning(self, scale: float, a_upper: Rows) -> None:
        if not self.points.turned:
            return
        s, m, w = self.shard, self.model, self.shard.work
        self.points.turn()
        s.each(self.k_turning.spread_turning, quadratic.POINTS * m.count, [w.gauss_turning.S], [w.gauss_node_turning.S])
        inputs = [scale, m.large_entry_start, m.large_entry, w.gauss_node_turning.S]
        s.each(self.k_turning.block_turning, s.blocks, inputs, [w.a.S, a_upper.S])

    def right_hand_side(self, f_scale: float, inertia: bool, moving: bool) -> None:
        """What the consistent mass changes in M (v0 - m_scale (1 - d_scale) v)."""
        if not inertia:
            return
        s, m, w = self.shard, self.model, self.shard.work
        inputs = [m.mass_row, m.mass_row_start, m.mass_row_body, m.mass_column, m.mass_column_node]
        inputs += [m.mass_column_volume, s.input["density"].S, w.body_mass.S, w.body_damping.S]
        inputs += [s.felt["v0"].S, s.felt["dof_v"].S, moving or s.leaning]
        s.each(self.k_inertia.add_momentum, m.mass_row.size, inputs, [w.b.S])
