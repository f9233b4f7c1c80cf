"""Gradients of tetrahedra in a step: by corners and by the parameters of their laws. Theory: docs/theory/adjoint.md.

Quadratic elements are linear ones at their Gauss points (docs/theory/quadratic.md): positions, velocities and the
adjoint go to the points' corners by weights, and gradients come back to the ten nodes by the same weights.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from softwarp.kernels.elements import (
    access,
    directional,
    quadratic,
    rest_adjoint,
    turned_adjoint,
    turned_directional,
    volumetric_adjoint,
)
from softwarp.kernels.elements import adjoint as of_tets
from softwarp.kernels.elements.laws import LAWS
from softwarp.model.codes import TURNED
from softwarp.model.quadratic import QuadraticModel
from softwarp.solvers.terms.tets import TetArrays
from softwarp.solvers.workspace.rows import Rows
from softwarp.solvers.workspace.shard import Shard


@dataclass(frozen=True)
class ElementSlopes:
    """What a direction changes of elements.

    Attributes:
        x: Positions [m], of whatever the tets' corners refer to.
        mu, lam: Lame constants of bodies [Pa].
        law: Parameters of laws of their own.
        stiffness: Factor of the stiffness in A, of every body.
    """

    x: Rows
    mu: Rows
    lam: Rows
    law: Rows
    stiffness: Rows


class TetAdjoint:
    """Gradients of some linear tetrahedra.

    Args:
        shard: Worlds.
        tets: Their arrays; ``x`` are the positions that a step started from.
        count: How many there are.

    Attributes:
        parameter: By the parameters of their laws and by Rayleigh's beta, ``adjoint.ROWS`` a tet.
    """

    def __init__(self, shard: Shard, tets: TetArrays, count: int) -> None:
        self.shard, self.tets = shard, tets
        self.parameter = shard.rows(of_tets.ROWS * count)

    def pull(self, v: Rows, p: Rows, stiffness: Rows, h: float, corner: Rows, *, parameters: bool = True) -> None:
        """Gradients by corners, 12 a tet, and by parameters.

        Args:
            v: Velocities that the step has found, of whatever the tets' corners refer to.
            p: Adjoint of these.
            stiffness: Factor of the stiffness in A, of every body.
            h: Step [s].
            corner: Receives the gradients by corners.
            parameters: Whether those by parameters are asked for.
        """
        s, t, w = self.shard, self.tets, self.shard.work
        per_item = access.functions(s.variant).per_item
        for law, chosen in t.laws.items():
            inputs = [chosen, t.node, t.body, t.gradient, t.volume]
            if law in TURNED:
                kernel = turned_adjoint.kernels(s.variant, law == "large", parameters).tet_adjoint
                inputs += [t.size, t.frame, s.model.body_guard, w.body_mu.S, w.body_lam.S, stiffness.S]
                outputs = [corner.S, self.parameter.S]
                s.each(kernel, -(-int(chosen.size) // per_item), [*inputs, t.x.S, v.S, p.S, h], outputs)
                continue
            if law in volumetric_adjoint.LAWS and not s.variant.world_fastest:
                k = volumetric_adjoint.kernels(s.variant, law, s.options.project_tangent, parameters)
                inputs += [w.body_mu.S, w.body_lam.S, stiffness.S, t.x.S, v.S, p.S, h]
                s.each(k.tet_adjoint, -(-int(chosen.size) // per_item), inputs, [corner.S, self.parameter.S])
                continue
            asked = parameters or LAWS[law].awake is None
            kernel = of_tets.kernels(s.variant, law, s.options.project_tangent, asked).tet_adjoint
            inputs += [s.model.body_law_start, w.body_mu.real, w.body_lam.real, s.input["law_parameter"].real]
            inputs += [stiffness.real, t.x.real, v.real, p.real, h]
            s.each_real(kernel, chosen.size, inputs, [corner.real, self.parameter.real])

    def push(self, v: Rows, slopes: ElementSlopes, stiffness: Rows, h: float, corner: Rows) -> None:
        """What tets add, along a direction, to the right-hand side of a step at their corners; as ``pull``."""
        s, t, w = self.shard, self.tets, self.shard.work
        per_item = access.functions(s.variant).per_item
        for law, chosen in t.laws.items():
            inputs = [chosen, t.node, t.body, t.gradient, t.volume]
            if law in TURNED:
                kernel = turned_directional.kernels(s.variant, law == "large").tet_direction
                inputs += [t.size, t.frame, s.model.body_guard, w.body_mu.S, w.body_lam.S, stiffness.S]
                inputs += [slopes.mu.S, slopes.lam.S, slopes.stiffness.S, t.x.S, v.S, slopes.x.S, h]
                s.each(kernel, -(-int(chosen.size) // per_item), inputs, [corner.S])
                continue
            k = directional.kernels(s.variant, law, s.options.project_tangent)
            inputs += [s.model.body_law_start, w.body_mu.real, w.body_lam.real, s.input["law_parameter"].real]
            inputs.append(stiffness.real)
            fields = [t.x.real, v.real]
            s.each_real(k.tet_direction, chosen.size, [*inputs, *fields, slopes.x.real, h], [corner.real])
            inputs += [slopes.mu.real, slopes.lam.real, slopes.law.real, slopes.stiffness.real]
            s.each_real(k.tet_constants, chosen.size, [*inputs, *fields, h], [corner.real])

    def pull_rest(
        self, felt: tuple[Rows, Rows, Rows, Rows], stiffness: Rows, h: float, corner: Rows, rest: Rows
    ) -> None:
        """Gradients by the rest positions of corners; those by corners are there.

        Args:
            felt: Velocities of nodes, those that elements feel, p, and gradients by volumes beside all these.
            stiffness: h^2 + h beta of bodies, or what stands for it.
            h: Step [s].
            corner: Gradients by corners.
            rest: Receives them.
        """
        s, t, w, i = self.shard, self.tets, self.shard.work, self.shard.input
        for law, chosen in t.laws.items():
            kernel = rest_adjoint.kernels(s.variant, law, s.options.project_tangent).tet_rest
            inputs = [chosen, t.node, t.body, t.gradient, t.volume, s.model.body_law_start]
            inputs += [w.body_mu.real, w.body_lam.real, i["law_parameter"].real, stiffness.real]
            inputs += [w.body_mass.real, i["density"].real, i["gravity"].real, t.x.real, i["v0"].real]
            inputs += [*(part.real for part in felt), corner.real, h]
            s.each_real(kernel, chosen.size, inputs, [rest.real])


class QuadraticAdjoint:
    """Gradients of quadratic tetrahedra.

    Args:
        shard: Worlds.
        model: Elements.
        points: The linear tetrahedra at their Gauss points.
        first: Row of the forces of the first of their nodes.
    """

    def __init__(self, shard: Shard, model: QuadraticModel, points: TetArrays, first: int) -> None:
        self.shard, self.model, self.first = shard, model, first
        self.k = quadratic.kernels(shard.variant)
        self.points = TetAdjoint(shard, points, quadratic.POINTS * model.count)
        self.x, count = points.x, 12 * quadratic.POINTS * model.count
        self.v, self.p, self.corner = (shard.rows(count) for _ in range(3))

    def pull(self, v: Rows, p: Rows, stiffness: Rows, h: float, corner: Rows, *, parameters: bool = True) -> None:
        """Gradients by the nodes of elements, behind those by corners of linear ones, and by parameters of points."""
        s, m = self.shard, self.model
        for nodes, corners in ((s.work.x, self.x), (v, self.v), (p, self.p)):
            s.each(self.k.point_corners, m.count, [m.element_node, nodes.S], [corners.S])
        self.points.pull(self.v, self.p, stiffness, h, self.corner, parameters=parameters)
        s.each(self.k.spread_force, m.count, [self.first, self.corner.S], [corner.S])

    def push(self, v: Rows, slopes: ElementSlopes, stiffness: Rows, h: float, corner: Rows) -> None:
        """What elements add, along a direction, to the right-hand side of a step at their nodes; as ``pull``."""
        s, m = self.shard, self.model
        for nodes, corners in ((s.work.x, self.x), (v, self.v), (slopes.x, self.p)):
            s.each(self.k.point_corners, m.count, [m.element_node, nodes.S], [corners.S])
        self.points.push(self.v, replace(slopes, x=self.p), stiffness, h, self.corner)
        s.each(self.k.spread_force, m.count, [self.first, self.corner.S], [corner.S])

    def add_mass(self, dof_p: Rows, node_mass_p: Rows) -> None:
        """Add what the consistent mass per density has more than the lumped one, times p."""
        m = self.model
        kernel = quadratic.adjoint_kernels(self.shard.variant).add_mass
        inputs = [m.mass_row, m.mass_row_start, m.mass_column, self.shard.model.dof_node, m.mass_column_volume]
        self.shard.each_real(kernel, m.mass_row.size, [*inputs, dof_p.real], [node_mass_p.real])
