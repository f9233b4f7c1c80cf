"""The directional derivative of a backward Euler step: its tangent, along slopes of all that the step reads.

A step solves one linear system; its tangent has the same matrix, so the factor serves every direction. What stands on
the right are the derivatives of A, b and H along the direction, element by element. Theory: docs/theory/adjoint.md.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from softwarp.kernels.elements import directional_sums, traction
from softwarp.kernels.rows import directional as of_rows
from softwarp.model.cavities import CavityModel
from softwarp.model.fields import declarations
from softwarp.model.gradients import Gradients
from softwarp.solvers.adjoint import StepAdjoint
from softwarp.solvers.adjoint_index import AdjointIndex
from softwarp.solvers.contact_directional import ContactDirection
from softwarp.solvers.element_adjoint import ElementSlopes
from softwarp.solvers.system import System
from softwarp.solvers.workspace import rows
from softwarp.solvers.workspace.rows import Rows

TARGETS = ("cable_displacement", "cable_tension"), ("cavity_pressure", "cavity_volume", "cavity_gas")
CONSTANTS = ("cable_stiffness", "cable_damping")  # whose gradients are summed over steps


class StepDirection(StepAdjoint):
    """Pushes slopes by the start of a step on to its end, for the worlds of one system.

    Args:
        system: Worlds; of its state, commands and parameters those that the step started from.
        h: Step [s].
        slopes: The direction: slopes of what the step reads, under the names of gradients; those of the state become
            those of the end of the step.
        factors: Room for gradients, which the factors of commands take.
        index: Of the model.
    """

    def __init__(self, system: System, h: float, slopes: Gradients, factors: Gradients, index: AdjointIndex) -> None:
        super().__init__(system, h, factors, index)
        s, m = self.shard, self.model
        self.slopes = slopes
        self.k_push, self.k_turn = directional_sums.kernels(s.variant), of_rows.kernels(s.variant)
        self.slope = {name: _as_rows(self, name) for name in declarations(Gradients)}
        bodies = max(m.body_count, 1)
        self.elements = ElementSlopes(
            x=self.slope["node_x"],
            mu=s.rows(bodies),
            lam=s.rows(bodies),
            law=self.slope["law_parameter"],
            stiffness=s.rows(bodies),
        )
        points, count = 3 * max(len(m.point_node), 1), max(m.row_count, 1)
        self.point_slope, self.point_v, self.gradient_slope = (s.rows(points) for _ in range(3))
        self.target, self.held = s.rows(count), s.rows(count)
        self.load = s.rows(3 * m.node_count)
        starts = np.asarray(m.cable_starts)
        if m.cavities is not None:
            starts = np.concatenate([starts, m.point_count + m.cavities.starts[1:]])
        self.row_points = wp.array(starts, dtype=wp.int32, device=s.device)
        self.no_area = wp.zeros(0, dtype=s.variant.real, device=s.device)
        self.direction = None if system.contact is None else ContactDirection(system, h, slopes)
        self.contact = self.direction

    def linearise(self) -> None:
        """Solve the step, and find what all directions share; the state stays as it is."""
        self.solve_again()
        self._linearise()

    def _linearise(self) -> None:
        """What all directions share of a solution, whose velocities and forces are in place."""
        s, m, w = self.shard, self.model, self.shard.work
        outputs = [self.node_v.S, self.node_p.S, self.node_mass_p.S]
        inputs = [m.node_dof, m.node_volume, w.dof_v.S, self.p.S]
        s.each(self.k.to_nodes, s.variant.parts(m.node_count), inputs, outputs)
        if not m.row_count:
            return
        self.find_activity()
        s.each_real(self.k_turn.units, m.row_count, [self.active.real], [self.q.real, self.bound.real])
        for name in CONSTANTS:
            getattr(self.gradients, name).zero_()
        self._of_targets()
        inputs = [m.point_node, m.point_weight, self.row_v.real]
        s.each_real(self.k_turn.points, len(m.point_node), inputs, [self.point_v.real])

    def push(self) -> None:
        """Slopes by the start of the step become those by its end; needs ``linearise``."""
        self._bring()
        self._along()
        self._arrive()

    def _along(self) -> None:
        """Slopes of the unknowns and forces of a solution."""
        self._along_elements()
        if self.model.row_count:
            self._along_rows()
        self._right_side()
        self._find()

    def finish(self) -> None:
        """End the step that has been linearised; the state is that of its end, to the bit of ``step``."""
        self.system.arrive(self.h)
        self.system.commit(self.h, 1.0, iterated=False)

    def _bring(self) -> None:
        """The direction in the workspace's order of memory, where that is another one."""
        s = self.shard
        if s.variant.lanes > 1:
            for name, held in self.slope.items():
                array = getattr(self.slopes, name)
                if array.shape[1]:
                    s.each_real(s.k_state.interleave, None, [array, s.world_count, s.lanes], [held.real])

    def _along_elements(self) -> None:
        s, m, i, d, h = self.shard, self.model, self.shard.input, self.slope, self.h
        inputs = [h, i["youngs"].real, i["nu"].real, d["youngs"].real, d["nu"].real, d["rayleigh_stiffness"].real]
        outputs = [self.elements.mu.real, self.elements.lam.real, self.elements.stiffness.real]
        s.each_real(self.k_push.bodies, m.body_count, inputs, outputs)
        for elements in (self.tets, self.quadratic):
            if elements is not None:
                elements.push(self.element_v, self.elements, self.stiffness, h, self.corner)

    def _along_rows(self) -> None:
        """-S of rows between their bounds, slopes of the other ones' forces, and h dH' T of points."""
        s, m, w, f, d = self.shard, self.model, self.shard.work, self.gradients, self.slopes
        inputs = [m.point_node, m.point_weight, self.slope["node_x"].real]
        s.each_real(self.k_turn.points, len(m.point_node), inputs, [self.point_slope.real])
        along = [w.point_x, w.point_gradient, self.point_slope, self.none]
        inputs = [m.cable_point_start_device, m.point_cable, m.cable_closing_length, *(part.S for part in along)]
        s.each(self.k_row_elements.cable_points, m.point_count, inputs, [self.gradient_slope.S])
        fields = [part.real for part in along]
        products = [(0, f"command_{name}") for name in TARGETS[0]]
        if m.cable_elastic.any():
            products += [(0, name) for name in CONSTANTS]
        if m.cavities is not None:
            first = m.first_row("cavity")
            products += [(first, f"command_{name}") for name in TARGETS[1]] + [(first, "cavity_pressure")]
            self._along_surfaces(m.cavities, fields)
        self.target.zero()
        for first, name in products:
            factor, slope = getattr(f, name), getattr(d, name)
            inputs = [s.lanes, first, factor, slope]
            s.each_real(self.k_turn.add_product, factor.shape[1], inputs, [self.target.real])
        inputs = [self.h, self.row_points, self.active.real, self.measured.real, w.point_gradient.real]
        inputs += [self.gradient_slope.real, self.point_slope.real, self.point_v.real, self.target.real]
        s.each_real(self.k_turn.sums, m.row_count, inputs, [self.force.real, self.held.real])
        inputs = [self.h, self.index.point_row, w.multiplier.real, self.gradient_slope.real]
        s.each_real(self.k_turn.point_forces, len(m.point_node), inputs, [self.point.real])

    def _along_surfaces(self, c: CavityModel, fields: list[wp.array]) -> None:
        s, m = self.shard, self.model
        inputs = [m.point_count, m.first_row("cavity"), c.ring_start, c.point_ring, c.point_cavity, c.cavity_area]
        s.each_real(self.k_chambers.cavity_points, int(c.starts[-1]), [*inputs, *fields], [self.gradient_slope.real])

    def _right_side(self) -> None:
        """Everything that stands on the right of the unknowns' slopes, into ``seed`` and side 0 of the solver."""
        s, m, i, w, d, h, x = self.shard, self.model, self.shard.input, self.shard.work, self.slope, self.h, self.index
        force = d["command_node_force"]
        if m.tractions is not None:
            t = m.tractions
            self.load.copy_from(force)
            force = self.load
            inputs = [t.loaded_node, t.entry_start, t.entry_traction, t.entry_share, d["command_traction"].S]
            s.each(traction.kernels(s.variant).add_tractions, int(t.loaded_node.size), inputs, [force.S])
        inputs = [h, m.node_count, m.dof_node, m.node_body, i["density"].real, w.body_mass.real]
        inputs += [i["v0"].real, w.dof_v.real, d["density"].real, d["rayleigh_mass"].real, d["node_v"].real]
        s.each_real(self.k_push.momenta, m.dof_count, inputs, [self.p.real])
        outputs = [self.node_v.S, self.node_p.S, self.node_mass_p.S]
        inputs = [m.node_dof, m.node_volume, w.dof_v.S, self.p.S]
        s.each(self.k.to_nodes, s.variant.parts(m.node_count), inputs, outputs)
        if self.quadratic is not None:
            self.quadratic.add_mass(self.p, self.node_mass_p)
        inputs = [m.corner_start, m.corner, x.node_point_start, x.node_point, x.node_point_weight]
        inputs += [self.corner.S, self.point.S]
        s.each(self.k.node_sums, s.variant.parts(m.node_count), inputs, [self.node_bar.S])
        inputs = [h, m.node_count, m.dof_node, m.dof_free, m.node_body, x.node_heft, i["density"].real]
        inputs += [i["gravity"].real, d["density"].real, d["gravity"].real, force.real]
        inputs += [self.node_mass_p.real, self.node_bar.real]
        s.each_real(self.k_push.right_side, m.dof_count, inputs, [self.seed.real])
        if self.surface is not None:
            self.surface.push(self.point_slope, d["cavity_pressure"], self.seed)
        if m.row_count:
            inputs = [m.dof_entry_start, m.dof_entry, m.entry_row, m.dof_free, w.row.S, self.held.S, h]
            s.each(self.system.rows.k.row_force, m.dof_count, inputs, [self.seed.S])
        if self.direction is not None:
            self._along_contacts(self.direction)
        s.place(self.seed, 3 * m.dof_count, self.system.linear.y, 0)
        self.p.zero()
        self.q.zero()

    def _along_contacts(self, contact: ContactDirection) -> None:
        """What contacts have on the right."""
        contact.begin(self.shard.work.dof_v)
        contact.along(self.slope["node_x"], self.slope["node_v"])
        contact.push(self.seed)

    def _arrive(self) -> None:
        """Slopes of the state at the end of the step."""
        s, m, d = self.shard, self.model, self.slopes
        inputs = [self.h, s.lanes, m.node_dof, self.p.real]
        s.each_real(self.k_push.arrive, m.node_count, inputs, [d.node_x, d.node_v])
        if not m.row_count:
            return
        inputs = [s.lanes, 0, self.no_area, self.q.real, self.held.real]
        s.each_real(self.k_turn.forces, m.cable_count, inputs, [d.cable_tension])
        if m.cavities is not None:
            inputs = [s.lanes, m.first_row("cavity"), m.cavities.cavity_area, self.q.real, self.held.real]
            s.each_real(self.k_turn.forces, m.cavity_count, inputs, [d.cavity_pressure])


def _as_rows(step: StepDirection, name: str) -> Rows:
    """An array of the direction in the workspace's order of memory."""
    s, array = step.shard, getattr(step.slopes, name)
    if array.shape[1] == 0 or s.variant.lanes > 1:
        return s.rows(max(array.shape[1], 1))
    return rows.alias(s.variant, array)
