"""The adjoint of a step of BDF2: its two stages and the extrapolation between them. Theory: docs/theory/adjoint.md."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any

import warp as wp

from softwarp.kernels.step import stage_adjoint
from softwarp.model import memory
from softwarp.model.gradients import COMMANDS, Gradients
from softwarp.solvers.adjoint import StepAdjoint
from softwarp.solvers.adjoint_index import AdjointIndex
from softwarp.solvers.second_order import SecondOrder, Stage
from softwarp.solvers.system import System
from softwarp.solvers.terms.term import Pace

MOVED = ("node_x", "node_v")  # what is extrapolated


class StageAdjoint(StepAdjoint):
    """Pulls gradients by the end of a stage back to its start.

    Args:
        system: Worlds; of its state, commands and parameters those that the stage started from.
        h: Length of the stage [s].
        pace: What it does of the commands.
        predict: Writes the velocities that it is linearised with.
        gradients: Arrays of these worlds, read and written.
        index: Of the model.
    """

    def __init__(
        self,
        system: System,
        h: float,
        pace: Pace,
        predict: Callable[[], None],
        gradients: Gradients,
        index: AdjointIndex,
    ) -> None:
        super().__init__(system, h, gradients, index)
        self.pace, self.predict = pace, predict
        s, m = self.shard, self.model
        self.k_stage = stage_adjoint.kernels(s.variant)
        self.lapse, self.is_stage = pace.lapse, True
        self.start_v, self.pushed = s.rows(s.dof_room), s.rows(3 * m.dof_count)
        self.element_v, self.row_v = s.rows(3 * m.node_count), s.rows(3 * m.node_count)
        self.displacement = s.rows(s.work.displacement.real.shape[1])
        self.start_gradient = s.rows(s.work.point_gradient.real.shape[1])
        self.start_point = s.rows(s.work.point_gradient.real.shape[1])

    def prepare(self, *, without: tuple[str, ...] = ()) -> None:
        """All that ``pull`` needs of the stage but its solution."""
        system, h, w = self.system, self.h, self.shard.work
        system.load(without=without)
        system.scale(h)
        system.measure_rows()
        if self.model.row_count:
            self.displacement.copy_from(w.displacement)
            self.start_gradient.copy_from(w.point_gradient)
        system.command(h, self.pace)
        self.predict()
        self.start_v.copy_from(w.dof_v)
        system.move(h)
        system.measure_rows()
        system.row_laws()

    def solve_again(self) -> None:
        """Take the stage as far as its solution, from the system's state; the state stays as it is."""
        system, h = self.system, self.h
        self.prepare()
        system.forces()
        system.tangent()
        system.right_hand_side(h, inertia=True, moving=True)
        system.solve(h, h)
        system.add_unknowns()

    def _velocities(self) -> None:
        s, m, i = self.shard, self.model, self.shard.input
        inputs = [self.h, m.node_dof, m.node_body, i["rayleigh_stiffness"].real, self.node_v.real, self.start_v.real]
        s.each_real(self.k_stage.velocities, m.node_count, inputs, [self.element_v.real, self.row_v.real])

    def _to_state(self) -> None:
        s, m, i, w, g, x = self.shard, self.model, self.shard.input, self.shard.work, self.gradients, self.index
        wp.copy(self.pushed.real, self.seed.real)
        if m.row_count:
            inputs = [m.dof_entry_start, m.dof_entry, m.entry_row, m.dof_free, w.row.S, self.q.S, -self.h]
            s.each(self.system.rows.k.row_force, m.dof_count, inputs, [self.pushed.S])
            inputs = [m.point_cable, self.start_gradient.real, self.start.real]
            s.each_real(self.k_stage.start_points, m.point_count, inputs, [self.start_point.real])
        inputs = [m.corner_start, m.corner, x.node_point_start, x.node_point, x.node_point_weight]
        s.each(self.k.node_sums, m.node_count, [*inputs, self.corner.S, self.point.S], [self.node_bar.S])
        inputs = [self.h, s.lanes, m.point_count, m.node_dof, m.node_body, m.dof_free]
        inputs += [x.node_point_start, x.node_point, x.node_point_weight]
        inputs += [i["density"].real, i["rayleigh_stiffness"].real, w.body_mass.real, self.seed.real, self.pushed.real]
        inputs += [self.node_p.real, self.node_mass_p.real, self.node_bar.real, self.start_point.real]
        s.each_real(self.k_stage.nodes, m.node_count, inputs, [g.node_x, g.node_v, g.command_node_force])
        self._to_tractions()

    def _to_parameters(self) -> None:
        super()._to_parameters()
        s, m, i, w = self.shard, self.model, self.shard.input, self.shard.work
        inputs = [self.h, s.lanes, self.index.body_node_start, m.node_dof, i["density"].real]
        inputs += [i["rayleigh_stiffness"].real, w.body_mass.real, self.pushed.real, self.start_v.real]
        inputs.append(self.node_mass_p.real)
        s.each_real(self.k_stage.damping, m.body_count, inputs, [self.gradients.rayleigh_stiffness])


class SecondOrderAdjoint:
    """Pulls gradients by the end of a step back to its start, for the smooth worlds of one system.

    Rough worlds, which take other stages, have gradients that mean nothing; ``SecondOrder.rough`` tells which they are.

    Args:
        stepper: Takes the step; its system has the state that the step started from.
        gradients: Arrays of these worlds, read and written.
        index: Of the model.

    Attributes:
        solution: Nothing is kept of a step.
    """

    def __init__(self, stepper: SecondOrder, gradients: Gradients, index: AdjointIndex) -> None:
        self.stepper, self.gradients = stepper, gradients
        self.solution: list[wp.array] = []
        system, device = stepper.system, stepper.shard.device
        self.k = stage_adjoint.kernels(system.variant)

        def stage(each: Stage) -> StageAdjoint:
            h = each.length * stepper.h
            pace = Pace(each.lapse * stepper.h, each.ahead * stepper.h, h)
            return StageAdjoint(system, h, pace, stepper.predict, gradients, index)

        self.pulls = [stage(each) for each in stepper.stages]
        held = {field.name: getattr(gradients, field.name) for field in fields(Gradients)}
        names = [*MOVED, *(f"command_{name}" for name in COMMANDS)]
        self.arrays = {name: held[name] for name in names if name in held and held[name].shape[1]}
        self.kept = {name: memory.zeros(a.shape, a.dtype, device) for name, a in self.arrays.items()}

    def step(self) -> None:
        """Gradients by the end of the step from the system's state become those by its start."""
        self._step(parameters=True)

    def step_alone(self) -> None:
        """The same without gradients by parameters."""
        self._step(parameters=False)

    def _step(self, *, parameters: bool) -> None:
        stepper, (first, second) = self.stepper, self.stepper.stages
        stepper.rough.zero_()
        stepper.keep()
        stepper.take(0)
        self._pull(self.pulls[1], second, parameters)
        for name, array in self.arrays.items():
            if name in MOVED:
                self._launch(self.k.part, [first.factor, array], [array, self.kept[name]])
            else:
                wp.copy(self.kept[name], array)
        stepper.give_back()
        self._pull(self.pulls[0], first, parameters)
        for name, array in self.arrays.items():
            self._launch(self.k.add, [self.kept[name]], [array])

    def _pull(self, pull: StageAdjoint, stage: Stage, parameters: bool) -> None:
        self.stepper.set_lag(stage)
        pull.solve_again()
        pull.pull(parameters=parameters)

    def _launch(self, kernel: Any, inputs: list[Any], outputs: list[wp.array]) -> None:
        wp.launch(kernel, dim=outputs[0].shape, inputs=inputs, outputs=outputs, device=self.stepper.shard.device)
