"""The adjoint of a backward Euler step: gradients by all that the step reads. Theory: docs/theory/adjoint.md.

A step solves one linear system with the rows' laws. Its adjoint has the same matrix, which is symmetric, so the factor
serves both; what it adds are the derivatives of A, b and H by positions and parameters, element by element.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from softwarp.kernels.elements import adjoint_sums, traction
from softwarp.kernels.rows import adjoint as of_rows
from softwarp.kernels.rows import cavity_adjoint, cavity_surface
from softwarp.model.cavities import CavityModel
from softwarp.model.gradients import Gradients
from softwarp.solvers.adjoint_index import AdjointIndex
from softwarp.solvers.cavity_adjoint import SurfaceAdjoint
from softwarp.solvers.contact_adjoint import ContactAdjoint
from softwarp.solvers.element_adjoint import QuadraticAdjoint, TetAdjoint
from softwarp.solvers.frame_adjoint import FrameAdjoint
from softwarp.solvers.hex_adjoint import HexAdjoint
from softwarp.solvers.leaning_adjoint import Leaning, LeaningFrames
from softwarp.solvers.membrane_adjoint import MembraneAdjoint
from softwarp.solvers.mode_adjoint import ModeAdjoint
from softwarp.solvers.multipliers import BoundedMultipliers
from softwarp.solvers.solution import half_sides, solution_of
from softwarp.solvers.system import System
from softwarp.solvers.terms.membranes import MembraneTerm
from softwarp.solvers.terms.quadratic import QuadraticTerm
from softwarp.solvers.terms.reduction import ReductionTerm
from softwarp.solvers.terms.term import Pace
from softwarp.solvers.terms.tets import TetTerm
from softwarp.solvers.workspace.rows import Rows, allocate

LOADS = ("command_node_force", "v0")  # inputs that only a solution, gradients by parameters and contacts need


class StepAdjoint:
    """Pulls gradients by the end of a step back to its start, for the worlds of one system.

    Args:
        system: Worlds; of its state, commands and parameters those that the step started from.
        h: Step [s].
        gradients: Arrays of these worlds, read and written.
        index: Of the model.
        rest: Whether gradients by the rest shape are asked for.

    Attributes:
        by_forces: Whether gradients by node forces and tractions are asked for, of all nodes.
        predicts: Whether it is linearised where its start velocities lead to.
    """

    predicts = False
    touches = ContactAdjoint
    pace: Pace | None = None  # what a stage of a longer step does of the commands

    def __init__(
        self, system: System, h: float, gradients: Gradients, index: AdjointIndex, *, rest: bool = False
    ) -> None:
        self.system, self.h, self.gradients, self.index = system, h, gradients, index
        s, m = system.shard, system.model
        self.shard, self.model = s, m
        self.k = adjoint_sums.kernels(s.variant)
        self.k_rows, self.k_chambers = of_rows.kernels(s.variant), cavity_adjoint.kernels(s.variant)
        self.k_row_elements = of_rows.element_kernels(s.variant)
        self.k_surface = None if s.variant.world_fastest else cavity_surface.kernels(s.variant)
        rows, points = max(m.row_count, 1), max(len(m.point_node), 1)
        self.seed, self.p = s.rows(3 * m.dof_count), s.rows(3 * m.dof_room)
        self.node_v, self.node_p, self.node_mass_p = (s.rows(3 * m.node_count) for _ in range(3))
        self.node_bar = s.rows(3 * m.node_count)
        self.element_v = self.row_v = self.node_v
        self.corner = s.rows(s.work.element_force.real.shape[1])
        self.tets = self.quadratic = self.skin = self.modes = None
        self.hexes = HexAdjoint.of(s, system.terms)
        for term in system.terms:
            if isinstance(term, TetTerm):
                self.tets = TetAdjoint(s, term.tets.tets, m.tet_count)
            elif isinstance(term, QuadraticTerm):
                self.quadratic = QuadraticAdjoint(s, term.model, term.points.tets, term.first)
            elif isinstance(term, MembraneTerm):
                self.skin = MembraneAdjoint(s, term.model)
            elif isinstance(term, ReductionTerm):
                self.modes = ModeAdjoint(s, term, h, gradients)
        self.way, self.point = s.rows(3 * points), s.rows(3 * points)
        self.force, self.q, self.change, self.gap, self.compliant, self.bound, self.measured = (
            s.rows(rows) for _ in range(7)
        )
        self.delassus, self.factor = s.rows(rows * rows), s.rows(rows * rows)
        self.surface = None
        if m.cavities is not None and s.options.pressure_tangent:
            self.surface = SurfaceAdjoint(s, m.cavities, h)
        self.margin, self.lapse, self.rate_lapse, self.is_stage = 0.0, h, h, False
        self.start = s.rows(rows)
        self.stretches = wp.array(m.cable_elastic, dtype=wp.int32, device=s.device)
        self.displacement, self.volume = s.work.displacement, s.work.cavity_volume  # that commands are measured at
        self.final_v = s.work.dof_v
        self.stiffness = s.work.body_stiffness
        self.active = allocate(s.variant, s.world_count, rows, s.device, wp.int32)
        self.none = s.rows(rows)
        self.rest = s.rows(12 * m.tet_count) if rest else None
        self.no_volume = s.rows(m.node_count if rest else 0)
        self.frames: FrameAdjoint | None = None
        self.leaning: Leaning | None = None
        felt: LeaningFrames | None = None
        leans = self.predicts or m.relaxes
        if m.frames is not None and m.has_moving_frames:
            if leans:
                felt = LeaningFrames(system, m.frames, h, gradients, predicts=self.predicts)
            self.frames = felt or FrameAdjoint(system, m.frames, h, gradients)
        if leans:
            self.leaning = leaning = Leaning(system, h, gradients, index, felt)
            self.element_v, self.row_v = leaning.element_v, leaning.row_v
        self.contact = None if system.contact is None else self.touches(system, h, gradients)
        self.has_modes_alone = self.modes is not None and m.own_node_count == 0 and self.frames is None
        if self.modes is not None:
            self.modes.is_lone = self.has_modes_alone and self.contact is None and not self.predicts
            self.modes.has_sums = self.modes.is_lone
            if self.has_modes_alone and self.contact is not None and not leans:
                self.modes.has_sums = True
                self.contact.take_listed(self.modes.model.node, self.modes.listed, self.modes.listed_v)
        self.by_forces = True
        self.delassus_known = s.work.delassus if isinstance(system.multipliers, BoundedMultipliers) else None
        self.halves = None if self.predicts else half_sides(system)

    @property
    def solution(self) -> list[wp.array]:
        """What a step leaves behind for ``pull``; put back after ``prepare``, it stands for ``solve_again``."""
        return solution_of(self.system)

    @property
    def long_parts(self) -> list[tuple[Any, str]]:
        """What holds the parts of the solution that few launches read, and what it calls them: none on a GPU."""
        held = [(self.system.linear, "lower"), (self.shard.work, "a"), (self, "halves")]
        return [] if self.shard.variant.world_fastest else held[: 2 + (self.halves is not None)]

    def step(self) -> None:
        """Gradients by the end of the step from the system's state become those by its start."""
        self.solve_again()
        self.pull()

    def step_alone(self) -> None:
        """The same without gradients by parameters."""
        self.solve_again()
        self.pull(parameters=False)

    def pull_alone(self) -> None:
        """``pull`` without gradients by parameters."""
        self.pull(parameters=False)

    def prepare(self, *, without: tuple[str, ...] = ()) -> None:
        """All that ``pull`` needs of a step but its ``solution``, and but for some inputs by name."""
        lifts = self.frames is not None and self.frames.lifts
        turns = self.modes is not None and self.modes.frames is not None
        self._load(() if lifts or turns else without)
        if lifts:
            self._find_forces()
        elif turns:
            self.system.loads()
            for term in self.system.terms:
                if isinstance(term, TetTerm):  # some laws prepare their stiffness there
                    term.forces()
        if lifts or turns:
            self._stiffen()

    def _stiffen(self) -> None:
        """Stiffness of elements, where it is stored, that carried nodes and floating frames need."""
        for term in self.system.terms:
            if isinstance(term, TetTerm):
                term.tets.stiffness()
            elif isinstance(term, QuadraticTerm):
                term.points.stiffness()
            elif isinstance(term, MembraneTerm):
                term.stiffness()
        self._take_samples()

    def _take_samples(self) -> None:
        """Stiffness of elements in floating frames, in the world's axes, which that of A is not."""
        if self.modes is not None and self.modes.frames is not None:
            self.modes.term.take_samples()

    def _find_forces(self) -> None:
        self.system.forces()
        if isinstance(self.frames, LeaningFrames):
            self.frames.note_forces()

    def _load(self, without: tuple[str, ...] = ()) -> None:
        """What a step starts from."""
        system = self.system
        self.shard.is_settled = True
        system.load(without=without)
        self.shard.is_settled = False
        system.scale(self.h)
        system.measure_rows()
        system.command(self.h, self.pace)
        if self.leaning is not None:
            self.leaning.load()

    def prepare_alone(self) -> None:
        """``prepare`` for ``pull_alone``; a kept solution has what else velocities and node forces are good for."""
        self.prepare(without=LOADS if self.contact is None else LOADS[:1])

    def solve_again(self) -> None:
        """Take the step as far as its solution, from the system's state; the state stays as it is."""
        system, h = self.system, self.h
        self._load()
        system.find_contacts(h, moving=False, look=None if self.pace is None else self.pace.look)
        self._find_forces()
        system.tangent()
        system.right_hand_side(h, inertia=True, moving=False)
        system.solve(h, h)
        system.add_unknowns()
        self._take_samples()
        if self.contact is not None:  # which has been looked for where the step leads to
            self._start_over()

    def _start_over(self) -> None:
        """Where everything is at the start of the step."""
        self.shard.work.x.copy_from(self.shard.input["x0"])
        for term in self.system.terms:
            term.start_over()

    def pull(self, *, parameters: bool = True) -> None:
        """Gradients by the step's end become those by its start; needs ``solve_again`` or a kept solution."""
        self._seed()
        self._find()
        self.to_commands()
        self.to_start(parameters=parameters)

    def to_start(self, *, parameters: bool) -> None:
        """Gradients by positions, velocities and so on at the start of the step, from p and q of a solution."""
        if self.contact is not None:
            self.contact.take_rest(self.gradients.rest_x if parameters and self.rest is not None else None)
        self._to_elements(parameters=parameters)
        self._to_state()
        if self.frames is not None:
            self.frames.of_carried(self.index, self.p, self.q, self.node_bar)
            self.frames.to_state(self.p)
        if parameters:
            if self.leaning is not None:
                self.leaning.note()
            self._to_parameters()
            if self.frames is not None:
                self.frames.to_parameters(self.p)
        if self.leaning is not None:
            self.leaning.finish(self.node_v, self.node_mass_p, self.p, self.final_v, parameters=parameters)
        if self.contact is not None:
            self._contacts_to_state(self.contact)
        if self.modes is not None:
            self.modes.take()
            if self.modes.frames is not None:
                self.modes.frames.finish()

    def _contacts_to_state(self, contact: ContactAdjoint) -> None:
        """Gradients by positions, poses and velocities that contacts have."""
        contact.to_state(self.p)

    def _find(self) -> None:
        """p and q of the seed and of the gradients by forces."""
        if self.delassus_known is None:
            for correction in range(1 + self.system.options.refinement):
                self.solve(correction)
        elif self.halves is not None:
            self._solve_halves(self.delassus_known, self.halves)
        else:
            self._solve_known(self.delassus_known)

    def _seed(self, *, first: bool = True) -> None:
        """Right-hand sides of p and q, which become 0: ``first`` of a step's end, else of an earlier solution."""
        s, m, g = self.shard, self.model, self.gradients
        inputs = [self.h, s.lanes, m.dof_node, m.dof_free, g.node_x, g.node_v]
        s.each_real(self.k.seed, s.variant.parts(m.dof_count), inputs, [self.seed.real, self.system.linear.y.real])
        if self.modes is not None:
            self.modes.seed(self.seed, self.system.linear.y, arrives=first)
        if self.frames is not None:
            self.frames.seed(self.seed, self.system.linear.y, carries=first)
        if self.leaning is not None:
            self.leaning.seed(self.seed, self.system.linear.y)
        self.p.zero()
        self.q.zero()
        if self.contact is not None:
            self.contact.begin(self.shard.work.dof_v, first=first)
        if m.row_count:
            self.seed_forces()
            self.find_activity()

    def seed_forces(self) -> None:
        """Gradients by the forces of cables and chambers at the end of the step."""
        s, m, g = self.shard, self.model, self.gradients
        s.each_real(self.k_rows.cable_seed, m.cable_count, [s.lanes, g.cable_tension], [self.force.real])
        if m.cavities is not None:
            inputs = [s.lanes, m.first_row("cavity"), m.cavities.cavity_area, g.cavity_pressure]
            s.each_real(self.k_chambers.cavity_seed, m.cavity_count, inputs, [self.force.real])

    def find_activity(self) -> None:
        """Which rows were between their bounds."""
        w, m = self.shard.work, self.model
        inputs = [self.margin, w.lower_bound.real, w.upper_bound.real, w.multiplier.real]
        self.shard.each_real(self.k_rows.activity, m.row_count, inputs, [self.active.real])

    def solve(self, correction: int) -> None:
        """One pass for p and q; later ones correct what rounding has left."""
        system, s, m, h = self.system, self.shard, self.model, self.h
        linear, w, y = system.linear, s.work, system.linear.y
        rows, count = system.rows, m.row_count
        if correction == 0:
            y.zero()
            if self.has_modes_alone:  # products with dense modes
                inputs = [m.dof_count, m.entry_dof, m.entry_row, m.dof_free, w.row.S]
                s.each(self.k.kept_sides, m.entry_start.size - 1 if count else 0, inputs, [y.S])
            else:
                rows.into_sides()
            s.add(self.seed, y, s.dof_rows)
        else:
            system.residual(self.seed, self.p, y)
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
                inputs = [m.dof_count, count, self.index.row_pair, y.S, h * h]
                s.each(rows.k.delassus, len(self.index.row_pair), inputs, [self.delassus.S])
            self._row_gaps(self.gap)
            self._solve_rows(self.delassus)
            s.each(rows.k.add_change, s.variant.parts(s.dof_rows), [m.dof_count, count, self.change.S, -h], [y.S])
        self.add_solution()

    def _solve_halves(self, delassus: Rows, halves: Rows) -> None:
        """p and q where the step has left W and the half-solved sides of rows: by one solution."""
        s, y, k, count = self.shard, self.system.linear.y, self.k_row_elements, self.model.row_count
        self.system.linear.forward(1)
        given, size = [halves.S, y.S, self.force.S], 3 * self.model.dof_count
        s.each(k.half_gaps, s.variant.parts(count), [self.h, size, count, *given], [self.gap.S])
        self._solve_rows(delassus)
        s.each(k.add_halves, s.variant.parts(size), [-self.h, size, count, halves.S, self.change.S], [y.S])
        self.add_solution()

    def _solve_rows(self, delassus: Rows) -> None:
        """q += (W + C)^-1 gap."""
        w = self.shard.work
        inputs = [self.model.row_count, delassus.real, w.compliance.real, self.active.real, self.gap.real]
        self.shard.each_real(self.k_rows.solve, None, inputs, [self.factor.real, self.change.real, self.q.real])

    def _solve_known(self, delassus: Rows) -> None:
        """p and q where the step has left W: q from the solution without rows, so that no side is solved for.

        A pass is a solution with what p and q leave of the first equation; the first one brings q = 0, the second what
        q adds and what rounding has left, which further ones do again.
        """
        self._correct(first=True)
        for _ in range(max(1, self.system.options.refinement)):
            self._find_gaps(self.q, self.gap)
            self._solve_rows(delassus)
            self._correct(first=False)

    def _correct(self, *, first: bool) -> None:
        """p += A^-1 (seed - A p - h H' q)."""
        system, s, m, w, y = self.system, self.shard, self.model, self.shard.work, self.system.linear.y
        if not first:  # else the seed is there
            system.residual(self.seed, self.p, y)
            inputs = [m.dof_entry_start, m.dof_entry, m.entry_row, m.dof_free, w.row.S, self.q.S, -self.h]
            s.each(system.rows.k.row_force, m.dof_count, inputs, [y.S])
        system.linear.forward(1)
        self.add_solution()

    def add_solution(self) -> None:
        """p += what the half-solved right-hand side leads to."""
        linear, s = self.system.linear, self.shard
        if linear.panels is not None:
            linear.panels.backward(self.p)
        else:
            linear.backward()
            s.add(linear.y, self.p, s.dof_rows)

    def _row_gaps(self, gap: Rows) -> None:
        """y_T + h H p - C q of the static rows."""
        s, m, w, system, count = self.shard, self.model, self.shard.work, self.system, self.model.row_count
        s.each_real(self.k_rows.compliant, count, [w.compliance.real, self.q.real], [self.compliant.real])
        inputs = [m.dof_count, m.row_entry_start, m.entry_dof, w.row.S, self.p.S, system.linear.y.S]
        inputs += [self.force.S, self.compliant.S, self.h]
        s.each(system.rows.k.free_gap, count, inputs, [gap.S])

    def to_commands(self, *, follows: bool = True) -> None:
        """Gradients by commands, and by the constants of cables; none where rows do not follow any."""
        if not follows:
            self.measured.zero()
            self.start.zero()
        elif self.model.row_count:
            self.find_bounds(self.bound)
            self._of_targets()

    def _find_gaps(self, q: Rows, gap: Rows) -> None:
        """y_T + h H p - C q of the static rows."""
        s, m, w = self.shard, self.model, self.shard.work
        inputs = [self.h, m.row_entry_start, m.entry_dof, w.row.S, self.p.S, w.compliance.S, self.force.S, q.S]
        s.each(self.k_row_elements.gaps, m.row_count, inputs, [gap.S])

    def find_bounds(self, bound: Rows) -> None:
        """Gradients by the bounds of static rows."""
        self._find_gaps(self.none, self.gap)
        inputs = [self.gap.real, self.active.real]
        self.shard.each_real(self.k_rows.bounds, self.model.row_count, inputs, [bound.real])

    def _of_targets(self) -> None:
        """The same from q and the gradients by bounds."""
        s, m, i, w, g = self.shard, self.model, self.shard.input, self.shard.work, self.gradients
        limits = ("min_displacement", "max_displacement", "min_tension", "max_tension", "max_rate")
        inputs = [self.rate_lapse, s.lanes, self.is_stage, m.cable_force_control, self.stretches]
        inputs += [i["command_cable_displacement"].real, i["command_cable_tension"].real]
        inputs += [*(i[f"cable_{name}"].real for name in limits), self.displacement.real, w.lag.real]
        inputs += [w.multiplier.real, w.lower_bound.real, w.upper_bound.real, self.q.real, self.bound.real]
        outputs = [g.command_cable_displacement, g.command_cable_tension, g.cable_tension]
        outputs += [self.measured.real, self.start.real]
        s.each_real(self.k_rows.cable_command, m.cable_count, inputs, outputs)
        if m.cable_elastic.any():
            inputs = [self.rate_lapse, s.lanes, self.is_stage, m.cable_force_control]
            inputs += [i["cable_stiffness"].real, i["cable_damping"].real]
            inputs += [w.compliance.real, w.target.real, self.displacement.real, w.multiplier.real, self.q.real]
            outputs = [g.command_cable_displacement, g.cable_stiffness, g.cable_damping]
            outputs += [self.measured.real, self.start.real]
            s.each_real(self.k_rows.cable_stretch, m.cable_count, inputs, outputs)
        if m.cavities is not None:
            self._to_chambers(m.cavities)

    def _to_chambers(self, c: CavityModel) -> None:
        s, m, i, w, g = self.shard, self.model, self.shard.input, self.shard.work, self.gradients
        inputs = [self.h, self.lapse, s.lanes, m.first_row("cavity"), self.is_stage]
        inputs += [c.cavity_control, c.cavity_area, c.cavity_rest_volume]
        inputs += [i[f"command_cavity_{name}"].real for name in ("pressure", "volume", "gas")]
        inputs += [i[f"cavity_{name}"].real for name in ("min_pressure", "max_pressure", "min_volume", "max_volume")]
        inputs += [i[f"cavity_{name}"].real for name in ("max_pressure_rate", "max_flow", "ambient", "exponent")]
        inputs += [i["pressure"].real, self.volume.real, w.cavity_volume.real, w.cavity_goal.real, w.lag.real]
        inputs += [w.multiplier.real, self.q.real, self.bound.real]
        outputs = [g.command_cavity_pressure, g.command_cavity_volume, g.command_cavity_gas, g.cavity_pressure]
        outputs += [self.measured.real, self.start.real]
        s.each_real(self.k_chambers.cavity_command, m.cavity_count, inputs, outputs)

    def _to_elements(self, *, parameters: bool = True) -> None:
        s, m, w, h = self.shard, self.model, self.shard.work, self.h
        if not self.has_modes_alone:
            outputs = [self.node_v.S, self.node_p.S, self.node_mass_p.S]
            inputs = [m.node_dof, m.node_volume, w.dof_v.S, self.p.S]
            s.each(self.k.to_nodes, s.variant.parts(m.node_count), inputs, outputs)
        if self.frames is not None:  # before bodies that float take over what all nodes have
            self.frames.carry(self.p, self.node_v, self.node_p)
        if self.modes is not None:
            everywhere = self.by_forces or (self.modes.frames is not None and s.variant.world_fastest)
            self.modes.place(w.dof_v, self.p, self.node_v, self.node_p, everywhere=everywhere)
        self._feel()
        if self.leaning is not None:
            self.leaning.push(self.seed, self.q)
            if self.contact is not None and self.leaning.multiply is None:
                self.contact.add_forces(self.leaning.pushed)
            if self.surface is not None:
                self.surface.take(self.p, self.leaning.pushed)
        if self.frames is not None:
            self.frames.lift(self.element_v, self.node_p)
        elements = (self.element_v, self.node_p, self.stiffness, h, self.corner)
        frames = None if self.modes is None else self.modes.frames
        if frames is not None:
            if self.leaning is not None:
                self.leaning.lean_more(self.node_v, frames.own_v)
            nodal = (self.element_v, self.node_p, self.p, self.corner)
            frames.pull(self.tets, self.skin, *nodal, parameters=parameters)
        elif self.tets is not None:
            self.tets.pull(*elements, parameters=parameters)
        if self.quadratic is not None:
            self.quadratic.pull(*elements, parameters=parameters)
            self.quadratic.add_mass(self.p, self.node_mass_p)
        if self.hexes is not None:
            self.hexes.pull(*elements, parameters=parameters)
        if self.skin is not None and frames is None:
            self.skin.pull(*elements)
        if not m.row_count:
            return
        inputs = [h, m.point_node, m.point_weight, self.index.point_row, self.row_v.S, self.node_p.S]
        s.each(self.k.points, len(m.point_node), [*inputs, w.multiplier.S, self.q.S], [self.way.S])
        fields = [w.point_x, w.point_gradient, self.way, self.measured]
        inputs = [m.cable_point_start_device, m.point_cable, m.cable_closing_length, *(part.S for part in fields)]
        s.each(self.k_row_elements.cable_points, m.point_count, inputs, [self.point.S])
        if m.cavities is not None:
            self._to_surfaces(m.cavities, [part.real for part in fields])

    def _feel(self) -> None:
        """What elements and rows have in the place of velocities."""
        if self.leaning is not None:
            self.leaning.velocities(self.node_v)

    def _to_surfaces(self, c: CavityModel, fields: list[wp.array]) -> None:
        """Gradients by the points of chambers."""
        s, m, w, g = self.shard, self.model, self.shard.work, self.gradients
        if self.k_surface is not None:
            inputs = [m.first_row("cavity"), c.cavity_point_start, c.cavity_tri_start, c.cavity_tri, c.cavity_area]
            inputs += [w.point_x.S, w.point_gradient.S, self.way.S, self.measured.S]
            s.each(self.k_surface.points_along, m.cavity_count, inputs, [self.point.S])
        else:
            inputs = [m.point_count, m.first_row("cavity"), c.ring_start, c.point_ring, c.point_cavity, c.cavity_area]
            s.each_real(self.k_chambers.cavity_points, int(c.starts[-1]), [*inputs, *fields], [self.point.real])
        if self.surface is not None:
            start_v = self.surface.rest_v if self.leaning is None else self.leaning.start_v
            self.surface.pull(self.p, start_v, self.point, g.cavity_pressure)

    def _to_state(self) -> None:
        """Gradients by positions, velocities and forces of nodes."""
        s, m, i, g, x = self.shard, self.model, self.shard.input, self.gradients, self.index
        if self.modes is not None and self.modes.has_sums:
            self._to_modes(self.modes)
            return
        inputs = [m.corner_start, m.corner, x.node_point_start, x.node_point, x.node_point_weight]
        inputs += [self.corner.S, self.point.S]
        s.each(self.k.node_sums, s.variant.parts(m.node_count), inputs, [self.node_bar.S])
        inputs = [s.lanes, m.node_body, i["density"].real]
        inputs += [self.node_mass_p.real, self.node_bar.real]
        s.each_real(self.k.nodes, s.variant.parts(m.node_count), inputs, [g.node_x, g.node_v])
        if self.modes is not None:
            self.modes.to_state()
            self._to_floating(self.modes)
        self._to_forces()

    def _to_modes(self, modes: ModeAdjoint) -> None:
        """The same where all nodes follow modes, and elements and rows are all that nodes have a part in."""
        m, x = self.model, self.index
        inputs = [m.corner_start, m.corner, x.node_point_start, x.node_point, x.node_point_weight]
        modes.sum([*inputs, self.corner.S, self.point.S])
        modes.to_state()
        self._to_forces()
        self._to_floating(modes)

    def _to_floating(self, modes: ModeAdjoint) -> None:
        """Gradients by the turns of floating frames, if there are any."""
        if modes.frames is not None:
            if self.contact is not None:
                self.contact.push_nodes(modes.frames.touch_p, modes.frames.touch_v)
            modes.frames.to_state(self.index, self.p, modes.wide_p, self.q, self.corner)

    def _to_forces(self) -> None:
        """Gradients by the forces on nodes and by tractions, if these are asked for."""
        s, m, g = self.shard, self.model, self.gradients
        if not self.by_forces:
            return
        inputs = [self.h, s.lanes, self.node_p.real]
        s.each_real(self.k.node_forces, s.variant.parts(3 * m.node_count), inputs, [g.command_node_force])
        self._to_tractions()

    def _to_tractions(self) -> None:
        s, t, g = self.shard, self.model.tractions, self.gradients
        if t is not None:
            inputs = [s.lanes, int(t.loaded_node.size), t.loaded_node, t.entry_start, t.entry_traction, t.entry_share]
            kernel = traction.kernels(s.variant).by_tractions
            s.each_real(kernel, t.count, [*inputs, g.command_node_force], [g.command_traction])

    def _to_parameters(self) -> None:
        """Add the gradients by parameters."""
        s, m, i, w, g, x = self.shard, self.model, self.shard.input, self.shard.work, self.gradients, self.index
        scalars = [self.h, s.lanes]
        inputs = [*scalars, x.body_node_start, x.node_heft, i["density"].real, w.body_mass.real]
        inputs += [i["gravity"].real, i["v0"].real, self.node_v.real, self.node_p.real, self.node_mass_p.real]
        s.each_real(self.k.bodies, m.body_count, inputs, [g.density, g.rayleigh_mass])
        if self.tets is not None:
            self._to_moduli(x.body_tets, self.tets.parameter)
        if self.quadratic is not None:
            self._to_moduli(x.body_points, self.quadratic.points.parameter)
        if self.hexes is not None:
            self._to_moduli(x.body_hexes, self.hexes.parameter)
        if self.skin is not None:
            self.skin.to_parameters(self.h, g)
        inputs = [*scalars, m.node_count, m.node_body, x.node_heft, i["density"].real, self.node_p.real]
        s.each_real(self.k.gravity, None, inputs, [g.gravity])
        if self.modes is not None:
            self.modes.to_parameters()
        if self.rest is not None:
            self._to_rest(self.rest)

    def _to_moduli(self, of_body: tuple[wp.array, wp.array], parameter: Rows) -> None:
        """Add the gradients by the moduli and so on of all bodies, from those of their tets."""
        s, m, i, g = self.shard, self.model, self.shard.input, self.gradients
        inputs = [self.h, s.lanes, *of_body, m.body_law_start, self.index.law_count]
        inputs += [i["youngs"].real, i["nu"].real, parameter.real]
        outputs = [g.youngs, g.nu, g.law_parameter, g.rayleigh_stiffness]
        s.each_real(self.k.moduli, m.body_count, inputs, outputs)

    def _to_rest(self, rest: Rows) -> None:
        """Gradients by the rest shape; needs those by the corners of elements."""
        s, m = self.shard, self.model
        if self.frames is not None:
            self.frames.to_rest(self.p, self.node_v, self.node_p)
        if self.tets is not None:
            volume = self.no_volume if self.frames is None else self.frames.volume
            felt = (self.node_v, self.element_v, self.node_p, volume)
            self.tets.pull_rest(felt, self.stiffness, self.h, self.corner, rest)
        inputs = [s.lanes, m.corner_start, m.corner, rest.real]
        s.each_real(self.k.rest_nodes, m.node_count, inputs, [self.gradients.rest_x])
        inputs = [s.lanes, self.is_stage, self.measured.real, self.start.real]
        s.each_real(self.k_rows.rest_lengths, m.cable_count, inputs, [self.gradients.cable_rest_length])
