"""Quadratic tetrahedra in the linear system of a shard. Equations: docs/theory/quadratic.md."""

from __future__ import annotations

from typing import TYPE_CHECKING

from softwarp.kernels.elements import corotational, hyperelastic, quadratic, warped
from softwarp.kernels.elements import turning as turning_kernels
from softwarp.model.codes import TURNED
from softwarp.model.quadratic import QuadraticModel
from softwarp.solvers.workspace.rows import Rows

if TYPE_CHECKING:
    from softwarp.solvers.system import System


class QuadraticSystem:
    """Workspace and launches for the quadratic elements of one shard: linear tetrahedra at their Gauss points.

    Args:
        system: Owner of the linear system.
        model: Elements.
        first: Row of ``System.tet_force`` at which their forces begin; they end at ``end``.
    """

    def __init__(self, system: System, model: QuadraticModel, first: int) -> None:
        self.system, self.model, self.first = system, model, first
        self.k = quadratic.kernels(system.variant)
        self.k_inertia = quadratic.inertia_kernels(system.variant)
        self.end = first + 3 * quadratic.NODES * model.count
        self.points = quadratic.POINTS * model.count
        self.turned = [law for law in model.law_points if law in TURNED]
        self.stored = [law for law in model.law_points if law not in TURNED]
        is_large = bool(self.turned)
        r = system._rows
        self.corner, self.force = r(12 * self.points), r(12 * self.points)
        self.corner_v = r(12 * self.points if system.model.frames is not None else 1)
        self.gradient = r(12 * self.points if is_large else 1)
        self.shape_gradient = r(30 * self.points if is_large else 1)
        self.stiffness = r(90 * self.points if self.stored else 1)

    @property
    def turning_points(self) -> int:
        """Gauss points with room for turning matrices: all, if one element needs them."""
        return self.points if self.turned else 0

    def forces(self) -> None:
        """Forces of the ten nodes of every element, after those of membranes."""
        s, m, b = self.system, self.model, self.system.body
        s.each(self.k.point_corners, m.count, [m.element_node, s.x.S], [self.corner.S])
        for law, points in m.law_points.items():
            shared = [points, m.point_tet, m.point_body, m.point_gradient, m.point_volume]
            if law in TURNED:
                kernel = (corotational if law == "large" else warped).kernels(s.variant).tet_force
                inputs = [*shared, m.point_frame, b["mu"].S, b["lam"].S, self.corner.S]
                s.each(kernel, points.size, inputs, [self.gradient.S, self.force.S])
            else:
                kernels = hyperelastic.kernels(s.variant, law, s.options.project_tangent)
                inputs = [*shared, b["mu"].real, b["lam"].real, self.corner.real]
                s.each_real(kernels.tet_force, points.size, inputs, [self.force.real])
        s.each(self.k.spread_force, m.count, [self.first, self.force.S], [s.tet_force.S])

    def weigh(self) -> None:
        """Consistent weight of the nodes; needs that of their lumped mass."""
        s, m, i = self.system, self.model, self.system.input
        inputs = [m.weight_node, m.weight_volume, s.model.node_body, i["density"].S, i["gravity"].S]
        s.each(self.k_inertia.add_weight, m.weight_node.size, inputs, [s.node_external.S])

    def tangent(self, inertia: bool) -> None:
        """Add the stiffness of all elements to A, and with ``inertia`` what makes their mass consistent."""
        s, m, b = self.system, self.model, self.system.body
        blocks = len(s.model.symbolic.a_row)
        if inertia:
            inputs = [m.mass_block, m.mass_body, m.mass_volume, s.input["density"].S, b["mass"].S]
            s.each(self.k_inertia.block_inertia, m.mass_block.size, inputs, [s.a.S])
        for law in self.turned:
            points = m.law_points[law]
            s.each(self.k.spread_gradient, points.size, [points, self.gradient.S], [self.shape_gradient.S])
        if self.turned:
            inputs = [quadratic.TURNED_ROWS, quadratic.TURNED_BITS]
            inputs += [m.point_body, m.large_entry_start, m.large_entry]
            inputs += [b["mu"].S, b["lam"].S, b["stiffness"].S, self.shape_gradient.S]
            s.each(corotational.kernels(s.variant).block_stiffness, blocks, inputs, [s.a.S])
        for law in self.stored:
            kernels = hyperelastic.kernels(s.variant, law, s.options.project_tangent)
            points = m.law_points[law]
            inputs = [points, m.point_tet, m.point_body, m.point_gradient, m.point_volume]
            inputs += [b["mu"].real, b["lam"].real, self.corner.real]
            s.each_real(kernels.tet_stiffness, points.size, inputs, [self.stiffness.real])
        if self.stored:
            inputs = [m.point_body, m.stored_entry_start, m.stored_entry, m.stored_weight]
            inputs += [b["stiffness"].S, self.stiffness.S]
            s.each(self.k.stored_stiffness, blocks, inputs, [s.a.S])

    def turn(self, a_upper: Rows, turning: Rows, node_turning: Rows) -> None:
        """Add what the rotations of elements depend on positions to A and, transposed, to ``a_upper``."""
        s, m, b = self.system, self.model, self.system.body
        turn = turning_kernels.kernels(s.variant)
        for law in self.turned:
            points, kernel = m.law_points[law], turn.tet_turning if law == "large" else turn.warped_turning
            inputs = [points, m.point_tet, m.point_body, m.point_gradient, m.point_volume, m.point_frame]
            inputs += [b["mu"].real, b["lam"].real, self.corner.real]
            s.each_real(kernel, points.size, inputs, [turning.real])
        k = quadratic.turning_kernels(s.variant)
        s.each(k.spread_turning, self.points, [turning.S], [node_turning.S])
        inputs = [m.large_entry_start, m.large_entry, node_turning.S]
        s.each(k.block_turning, len(s.model.symbolic.a_row), inputs, [s.a.S, a_upper.S])

    def corner_velocities(self, slot_v: Rows) -> Rows:
        """Velocities of the points' corners from those of slots."""
        s, m = self.system, self.model
        s.each(self.k.point_corners, m.count, [m.element_node, slot_v.S], [self.corner_v.S])
        return self.corner_v

    def momentum(self) -> None:
        """Add to b what the consistent mass changes in M (v0 - m_scale (1 - d_scale) v)."""
        s, m, b = self.system, self.model, self.system.body
        inputs = [m.mass_row, m.mass_row_start, m.mass_row_body, m.mass_column, m.mass_column_node]
        inputs += [m.mass_column_volume, s.input["density"].S, b["mass"].S, b["damping"].S, s.input["v0"].S, s.dof_v.S]
        s.each(self.k_inertia.add_momentum, m.mass_row.size, inputs, [s.b.S])
