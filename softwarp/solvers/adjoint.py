"""The adjoint of a backward Euler step: gradients by all that the step reads. Theory: docs/theory/adjoint.md.

A step solves one linear system with the rows' laws. Its adjoint has the same matrix, which is symmetric, so the factor
serves both; what it adds are the derivatives of A, b and H by positions and parameters, element by element.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from softwarp.kernels.elements import access, adjoint_sums, rest_adjoint, turned_adjoint
from softwarp.kernels.elements import adjoint as of_tets
from softwarp.kernels.elements.laws import LAWS
from softwarp.kernels.rows import adjoint as of_rows
from softwarp.model.codes import TURNED
from softwarp.model.gradients import Gradients
from softwarp.model.model import Model
from softwarp.solvers.contact_adjoint import ContactAdjoint
from softwarp.solvers.system import System
from softwarp.solvers.workspace.rows import Rows, allocate


@dataclass(frozen=True)
class AdjointIndex:
    """Which tets a body has, which points a node carries, and what row a point belongs to; on the device."""

    body_node_start: wp.array
    body_tet_start: wp.array
    body_tet: wp.array
    law_count: wp.array
    node_point_start: wp.array
    node_point: wp.array
    node_point_weight: wp.array
    point_row: wp.array

    @classmethod
    def of(cls, model: Model) -> AdjointIndex:
        """From a model."""
        laws = _body_laws(model)
        tet_body = model.tet_body.numpy()
        tet_start, tet = _by(tet_body, model.body_count)
        nodes, weights = model.point_node.numpy(), model.point_weight.numpy()
        point, slot = np.nonzero(nodes >= 0)
        point_start, order = _by(nodes[point, slot], model.node_count)
        owner = [*np.repeat(np.arange(model.cable_count), np.diff(model.cable_starts))]
        if model.cavities is not None:
            owner += [*(model.first_row("cavity") + model.cavities.point_cavity.numpy())]

        def send(values: Any, dtype: Any = wp.int32) -> wp.array:
            return wp.array(np.asarray(values), dtype=dtype, device=model.device)

        return cls(
            body_node_start=send(model.body_node_start),
            body_tet_start=send(tet_start),
            body_tet=send(tet),
            law_count=send([LAWS[law].own if law in LAWS else 0 for law in laws]),
            node_point_start=send(point_start),
            node_point=send(point[order]),
            node_point_weight=send(weights[point, slot][order], model.point_weight.dtype),
            point_row=send(owner),
        )


def _by(owner: np.ndarray[Any, Any], count: int) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Ranges by owner, and the items in that order."""
    start = np.concatenate([[0], np.cumsum(np.bincount(owner, minlength=count))])
    return start, np.argsort(owner, kind="stable")


def _body_laws(model: Model) -> list[str]:
    """Kernel law of every soft body."""
    laws, tet_body = [""] * model.body_count, model.tet_body.numpy()
    for law, tets in model.law_tets.items():
        for body in np.unique(tet_body[tets.numpy()]):
            laws[body] = law
    return laws


def solution_of(system: System) -> list[wp.array]:
    """Arrays in which a system that has taken a step holds its solution, factors included."""
    w = system.shard.work
    kept = [w.dof_v.real, *system.linear.factors]
    if system.shard.model.row_count:
        kept += [w.row.real, w.multiplier.real]
    return [*kept, w.a.real] if system.options.refinement > 0 else kept


class StepAdjoint:
    """Pulls gradients by the end of a step back to its start, for the worlds of one system.

    Args:
        system: Worlds; of its state, commands and parameters those that the step started from.
        h: Step [s].
        gradients: Arrays of these worlds, read and written.
        index: Of the model.
        rest: Whether gradients by the rest shape are asked for.
    """

    def __init__(
        self, system: System, h: float, gradients: Gradients, index: AdjointIndex, *, rest: bool = False
    ) -> None:
        self.system, self.h, self.gradients, self.index = system, h, gradients, index
        s, m = system.shard, system.model
        self.shard, self.model = s, m
        self.k = adjoint_sums.kernels(s.variant)
        self.k_rows = of_rows.kernels(s.variant)
        rows, points = max(m.row_count, 1), max(len(m.point_node), 1)
        self.seed, self.p = s.rows(3 * m.dof_count), s.rows(3 * m.dof_count)
        self.node_v, self.node_p = s.rows(3 * m.node_count), s.rows(3 * m.node_count)
        self.corner, self.parameter = s.rows(12 * m.tet_count), s.rows(of_tets.ROWS * m.tet_count)
        self.way, self.point = s.rows(3 * points), s.rows(3 * points)
        self.force, self.q, self.change, self.gap, self.compliant, self.bound, self.measured = (
            s.rows(rows) for _ in range(7)
        )
        self.delassus, self.factor = s.rows(rows * rows), s.rows(rows * rows)
        self.margin, self.lapse = 0.0, h
        self.stiffness = s.work.body_stiffness
        self.active = allocate(s.variant, s.world_count, rows, s.device, wp.int32)
        self.none = s.rows(rows)
        self.rest = s.rows(12 * m.tet_count) if rest else None
        self.contact = None if system.contact is None else ContactAdjoint(system, h, gradients)

    @property
    def solution(self) -> list[wp.array]:
        """What a step leaves behind for ``pull``; put back after ``prepare``, it stands for ``solve_again``."""
        contact = [] if self.contact is None else self.contact.solution
        return [*solution_of(self.system), *contact]

    def step(self) -> None:
        """Gradients by the end of the step from the system's state become those by its start."""
        self.solve_again()
        self.pull()

    def prepare(self) -> None:
        """All that ``pull`` needs of a step but its ``solution``."""
        system = self.system
        system.load()
        system.scale(self.h)
        system.measure_rows()
        system.command(self.h)

    def solve_again(self) -> None:
        """Take the step as far as its solution, from the system's state; the state stays as it is."""
        system, h = self.system, self.h
        self.prepare()
        system.find_contacts(h, moving=False)
        system.forces()
        system.tangent()
        system.right_hand_side(h, inertia=True, moving=False)
        system.solve(h, h)
        system.add_unknowns()
        self.shard.work.x.copy_from(self.shard.input["x0"])  # contacts have been looked for where the step leads to

    def pull(self) -> None:
        """Gradients by the end of the step become those by its start; needs ``solve_again`` or a kept solution."""
        self._seed()
        for correction in range(1 + self.system.options.refinement):
            self._solve(correction)
        self._to_commands()
        self._to_elements()
        self._to_sums()
        if self.contact is not None:
            self.contact.to_state(self.p)

    def _seed(self) -> None:
        s, m, g = self.shard, self.model, self.gradients
        inputs = [self.h, s.lanes, m.dof_node, m.dof_free, g.node_x, g.node_v]
        s.each_real(self.k.seed, m.dof_count, inputs, [self.seed.real])
        self.p.zero()
        self.q.zero()
        if self.contact is not None:
            self.contact.begin(self.shard.work.dof_v)
        if not m.row_count:
            return
        w = s.work
        s.each_real(self.k_rows.cable_seed, m.cable_count, [s.lanes, g.cable_tension], [self.force.real])
        if m.cavities is not None:
            inputs = [s.lanes, m.first_row("cavity"), m.cavities.cavity_area, g.cavity_pressure]
            s.each_real(self.k_rows.cavity_seed, m.cavity_count, inputs, [self.force.real])
        inputs = [self.margin, w.lower_bound.real, w.upper_bound.real, w.multiplier.real]
        s.each_real(self.k_rows.activity, m.row_count, inputs, [self.active.real])

    def _solve(self, correction: int) -> None:
        """One pass for p and q; later ones correct what rounding has left."""
        system, s, m, h = self.system, self.shard, self.model, self.h
        linear, w, y = system.linear, s.work, system.linear.y
        rows, count = system.rows, m.row_count
        if correction == 0:
            y.zero()
            rows.into_sides()
            s.each(system.k.accumulate, s.dof_rows, [self.seed.S], [y.S])
        else:
            inputs = [m.neighbour_start, m.neighbour, m.neighbour_block, w.a.S, self.seed.S, self.p.S]
            s.each(system.k.residual, m.dof_count, inputs, [y.S])
            if count:
                inputs = [m.dof_entry_start, m.dof_entry, m.entry_row, m.dof_free, w.row.S, self.q.S, -h]
                s.each(rows.k.row_force, m.dof_count, inputs, [y.S])
            if self.contact is not None:
                self.contact.add_forces(y)
        linear.forward(1 + count if correction == 0 else 1)  # those of the rows stand
        if self.contact is not None:
            self.contact.respond(y, self.p, self.q, self._row_gaps, self.active, first=correction == 0)
        elif count:
            if correction == 0:
                inputs = [m.dof_count, count, m.delassus_pair, y.S, h * h]
                s.each(rows.k.delassus, len(m.delassus_pair), inputs, [self.delassus.S])
            self._row_gaps(self.gap)
            inputs = [count, self.delassus.real, w.compliance.real, self.active.real, self.gap.real]
            outputs = [self.factor.real, self.change.real, self.q.real]
            s.each_real(self.k_rows.solve, None, inputs, outputs)
            s.each(rows.k.add_change, s.variant.parts(s.dof_rows), [m.dof_count, count, self.change.S, -h], [y.S])
        if linear.panels is not None:
            linear.panels.backward(self.p)
        else:
            linear.backward()
            s.each(system.k.accumulate, s.dof_rows, [y.S], [self.p.S])

    def _row_gaps(self, gap: Rows) -> None:
        """y_T + h H p - C q of the static rows."""
        s, m, w, system, count = self.shard, self.model, self.shard.work, self.system, self.model.row_count
        s.each_real(self.k_rows.compliant, count, [w.compliance.real, self.q.real], [self.compliant.real])
        inputs = [m.dof_count, m.row_entry_start, m.entry_dof, w.row.S, self.p.S, system.linear.y.S]
        inputs += [self.force.S, self.compliant.S, self.h]
        s.each(system.rows.k.free_gap, count, inputs, [gap.S])

    def _to_commands(self) -> None:
        s, m, i, w, g, h = self.shard, self.model, self.shard.input, self.shard.work, self.gradients, self.h
        if not m.row_count:
            return
        inputs = [h, m.row_entry_start, m.entry_dof, w.row.real, self.p.real, self.force.real, self.active.real]
        s.each_real(self.k_rows.bounds, m.row_count, inputs, [self.bound.real])
        limits = ("min_displacement", "max_displacement", "min_tension", "max_tension", "max_rate")
        inputs = [self.lapse, s.lanes, m.cable_force_control]
        inputs += [i["command_cable_displacement"].real, i["command_cable_tension"].real]
        inputs += [*(i[f"cable_{name}"].real for name in limits), w.displacement.real, w.multiplier.real]
        inputs += [w.lower_bound.real, w.upper_bound.real, self.q.real, self.bound.real]
        outputs = [g.command_cable_displacement, g.command_cable_tension, g.cable_tension, self.measured.real]
        s.each_real(self.k_rows.cable_command, m.cable_count, inputs, outputs)
        if m.cavities is not None:
            inputs = [
                self.lapse,
                s.lanes,
                m.first_row("cavity"),
                m.cavities.cavity_area,
                i["command_cavity_pressure"].real,
            ]
            inputs += [i[f"cavity_{name}"].real for name in ("min_pressure", "max_pressure", "max_pressure_rate")]
            inputs += [i["pressure"].real, self.bound.real]
            outputs = [g.command_cavity_pressure, g.cavity_pressure, self.measured.real]
            s.each_real(self.k_rows.cavity_command, m.cavity_count, inputs, outputs)

    def _to_elements(self) -> None:
        s, m, w, h = self.shard, self.model, self.shard.work, self.h
        s.each_real(self.k.to_nodes, m.node_count, [m.node_dof, w.dof_v.real, self.p.real], self._nodal())
        per_item = access.functions(s.variant).per_item
        for law, chosen in m.law_tets.items():
            inputs = [chosen, m.tet_node, m.tet_body, m.tet_gradient, m.tet_volume]
            if law in TURNED:
                kernel = turned_adjoint.kernels(s.variant, law == "large").tet_adjoint
                inputs += [m.tet_frame, m.body_guard, w.body_mu.S, w.body_lam.S, self.stiffness.S]
                inputs += [w.x.S, self.node_v.S, self.node_p.S, h]
                s.each(kernel, -(-int(chosen.size) // per_item), inputs, [self.corner.S, self.parameter.S])
                continue
            kernel = of_tets.kernels(s.variant, law, s.options.project_tangent).tet_adjoint
            inputs += [m.body_law_start, w.body_mu.real, w.body_lam.real, s.input["law_parameter"].real]
            inputs += [self.stiffness.real, w.x.real, *self._nodal(), h]
            s.each_real(kernel, chosen.size, inputs, [self.corner.real, self.parameter.real])
        if not m.row_count:
            return
        inputs = [h, m.point_node, m.point_weight, self.index.point_row, *self._nodal()]
        s.each_real(self.k_rows.points, len(m.point_node), [*inputs, w.multiplier.real, self.q.real], [self.way.real])
        fields = [w.point_x.real, w.point_gradient.real, self.way.real, self.measured.real]
        inputs = [m.cable_point_start_device, m.point_cable, m.cable_closing_length, *fields]
        s.each_real(self.k_rows.cable_points, m.point_count, inputs, [self.point.real])
        if m.cavities is not None:
            c = m.cavities
            inputs = [m.point_count, m.first_row("cavity"), c.ring_start, c.point_ring, c.point_cavity, c.cavity_area]
            s.each_real(self.k_rows.cavity_points, int(c.starts[-1]), [*inputs, *fields], [self.point.real])

    def _nodal(self) -> list[wp.array]:
        """v and p of nodes."""
        return [self.node_v.real, self.node_p.real]

    def _to_sums(self) -> None:
        s, m, i, w, g, x = self.shard, self.model, self.shard.input, self.shard.work, self.gradients, self.index
        scalars = [self.h, s.lanes]
        inputs = [*scalars, m.node_body, m.node_volume, m.corner_start, m.corner]
        inputs += [x.node_point_start, x.node_point, x.node_point_weight]
        inputs += [i["density"].real, self.node_p.real, self.corner.real, self.point.real]
        s.each_real(self.k.nodes, m.node_count, inputs, [g.node_x, g.node_v, g.command_node_force])
        inputs = [*scalars, x.body_node_start, m.node_volume, m.node_heft, i["density"].real, w.body_mass.real]
        inputs += [i["gravity"].real, i["v0"].real, *self._nodal()]
        s.each_real(self.k.bodies, m.body_count, inputs, [g.density, g.rayleigh_mass])
        inputs = [*scalars, x.body_tet_start, x.body_tet, m.body_law_start, x.law_count]
        inputs += [i["youngs"].real, i["nu"].real, self.parameter.real]
        outputs = [g.youngs, g.nu, g.law_parameter, g.rayleigh_stiffness]
        s.each_real(self.k.moduli, m.body_count, inputs, outputs)
        inputs = [*scalars, m.node_count, m.node_body, m.node_heft, i["density"].real, self.node_p.real]
        s.each_real(self.k.gravity, None, inputs, [g.gravity])
        if self.rest is not None:
            self._to_rest(self.rest)

    def _to_rest(self, rest: Rows) -> None:
        """Gradients by the rest shape; needs those by the corners of elements."""
        s, m, i, w, g = self.shard, self.model, self.shard.input, self.shard.work, self.gradients
        for law, chosen in m.law_tets.items():
            kernel = rest_adjoint.kernels(s.variant, law, s.options.project_tangent).tet_rest
            inputs = [chosen, m.tet_node, m.tet_body, m.tet_gradient, m.tet_volume, m.body_law_start]
            inputs += [w.body_mu.real, w.body_lam.real, i["law_parameter"].real, self.stiffness.real]
            inputs += [w.body_mass.real, i["density"].real, i["gravity"].real, w.x.real, i["v0"].real]
            inputs += [*self._nodal(), self.corner.real, self.h]
            s.each_real(kernel, chosen.size, inputs, [rest.real])
        inputs = [s.lanes, m.corner_start, m.corner, rest.real]
        s.each_real(self.k.rest_nodes, m.node_count, inputs, [g.rest_x])
        s.each_real(self.k_rows.rest_lengths, m.cable_count, [s.lanes, self.measured.real], [g.cable_rest_length])
