"""The adjoint of a step of BDF2: its two stages and the extrapolation between them. Theory: docs/theory/adjoint.md."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any

import warp as wp

from softwarp.kernels.frames import extrapolated_adjoint
from softwarp.kernels.step import stage_adjoint
from softwarp.model import memory
from softwarp.model.frames import FrameModel
from softwarp.model.gradients import FRAMES, MEMORIES, Gradients
from softwarp.solvers.adjoint import StepAdjoint
from softwarp.solvers.adjoint_index import AdjointIndex
from softwarp.solvers.leaning_adjoint import LeaningFrames
from softwarp.solvers.second_order import SecondOrder, Stage
from softwarp.solvers.system import System
from softwarp.solvers.terms.term import Pace

MOVED = ("node_x", "node_v", *MEMORIES)  # what is extrapolated along straight lines


class StageAdjoint(StepAdjoint):
    """Pulls gradients by the end of a stage back to its start.

    The unknown rotation of a frame comes on top of the one that its start velocities lead to, about which the stage is
    linearised; what it moves on with is found from that. So there are velocities as solved, and final ones.

    Args:
        system: Worlds; of its state, commands and parameters those that the stage started from.
        h: Length of the stage [s].
        pace: What it does of the commands.
        predict: Writes the velocities that it is linearised with.
        gradients: Arrays of these worlds, read and written.
        index: Of the model.
    """

    predicts = True

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
        assert self.leaning is not None
        self.start_v = self.leaning.start_v
        self.pace, self.predict = pace, predict
        s = self.shard
        self.k_stage = stage_adjoint.kernels(s.variant)
        self.lapse, self.is_stage = pace.lapse, True
        self.solved_v, self.final_v = s.rows(s.dof_room), s.rows(s.dof_room)
        if self.frames is not None:
            self.frames.end_v = self.final_v
        self.displacement = s.rows(s.work.displacement.real.shape[1])
        self.volume = s.rows(s.work.cavity_volume.real.shape[1])
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
            self.volume.copy_from(w.cavity_volume)
            self.start_gradient.copy_from(w.point_gradient)
        system.command(h, self.pace)
        if self.leaning is not None:
            self.leaning.load()
        self.predict()
        self.start_v.copy_from(w.dof_v)
        system.move(h)
        if isinstance(self.frames, LeaningFrames):
            self.frames.place()
        system.measure_rows()
        system.row_laws()

    def solve_again(self) -> None:
        """Take the stage as far as its solution, from the system's state; the state stays as it is."""
        system, h = self.system, self.h
        self.prepare()
        self._find_forces()
        system.tangent()
        system.right_hand_side(h, inertia=True, moving=True)
        system.solve(h, h)
        self.solved_v.copy_from(self.start_v)
        self.shard.add(self.shard.work.u, self.solved_v, self.shard.dof_rows)
        system.rotation_step(h)
        system.add_unknowns()
        self.final_v.copy_from(self.shard.work.dof_v)

    def _seed(self, *, first: bool = True) -> None:
        super()._seed(first=first)
        if isinstance(self.frames, LeaningFrames):
            self.frames.turn_seed(self.seed, self.system.linear.y, self.solved_v)
            self.shard.work.dof_v.copy_from(self.solved_v)

    def _to_state(self) -> None:
        s, m, i, w, g, x = self.shard, self.model, self.shard.input, self.shard.work, self.gradients, self.index
        assert self.leaning is not None
        if m.row_count:
            inputs = [x.point_row, self.start_gradient.real, self.start.real]
            s.each_real(self.k_stage.start_points, len(m.point_node), inputs, [self.start_point.real])
            if self.frames is not None:
                f = self.frames
                inputs = [m.node_count, f.item_start, f.item, f.model.carried_slot, f.model.carried_offset]
                inputs += [x.node_point_start, x.node_point, x.node_point_weight, i["pose0"].real]
                s.each_real(self.k_stage.start_frames, f.model.count, [*inputs, self.start_point.real], [f.start.real])
        inputs = [m.corner_start, m.corner, x.node_point_start, x.node_point, x.node_point_weight]
        s.each(self.k.node_sums, m.node_count, [*inputs, self.corner.S, self.point.S], [self.node_bar.S])
        inputs = [self.h, s.lanes, m.node_dof, m.node_body, m.dof_free]
        inputs += [x.node_point_start, x.node_point, x.node_point_weight]
        inputs += [i["density"].real, s.felt["beta"].real, w.body_mass.real, self.seed.real, self.leaning.pushed.real]
        inputs += [self.node_p.real, self.node_mass_p.real, self.node_bar.real, self.start_point.real]
        s.each_real(self.k_stage.nodes, m.node_count, inputs, [g.node_x, g.node_v, g.command_node_force])
        self._to_tractions()


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
        self.k_frames = extrapolated_adjoint.kernels(system.variant)

        def stage(each: Stage) -> StageAdjoint:
            h = each.length * stepper.h
            pace = Pace(each.lapse * stepper.h, each.ahead * stepper.h, h)
            return StageAdjoint(system, h, pace, stepper.predict, gradients, index)

        self.pulls = [stage(each) for each in stepper.stages]
        held = {field.name: getattr(gradients, field.name) for field in fields(Gradients)}
        names = [*MOVED, *FRAMES, *(name for name in held if name.startswith("command_"))]
        self.arrays = {name: held[name] for name in names if name in held and held[name].shape[1]}
        self.kept = {name: memory.zeros(a.shape, a.dtype, device) for name, a in self.arrays.items()}
        self.frames = model.frames if (model := system.model).has_moving_frames else None
        if self.frames is None:
            self.arrays = {name: array for name, array in self.arrays.items() if name not in FRAMES}
        frames = {name: array for name, array in self.arrays.items() if name in FRAMES}
        self.middle = {name: memory.zeros(a.shape, a.dtype, device) for name, a in frames.items()}

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
        stepper.solve(0)
        for name, array in self.middle.items():
            wp.copy(array, stepper.arrays[name])
        stepper.extrapolate(0)
        self._pull(self.pulls[1], second, parameters)
        for name, array in self.arrays.items():
            if name in MOVED:
                self._launch(self.k.part, [first.factor, array], [array, self.kept[name]])
            elif name not in FRAMES:
                wp.copy(self.kept[name], array)
        if self.frames is not None:
            self._split_frames(self.frames, first)
        stepper.give_back()
        self._pull(self.pulls[0], first, parameters)
        for name, array in self.arrays.items():
            self._launch(self.k.add, [self.kept[name]], [array])

    def _split_frames(self, frames: FrameModel, first: Stage) -> None:
        """Gradients by extrapolated frames become those by the end of the first stage and by the start of the step."""
        stepper, s = self.stepper, self.stepper.shard
        starts = [stepper.start[name] for name in FRAMES]
        ends = [self.middle[name] for name in FRAMES]
        bars = [self.arrays[name] for name in FRAMES]
        rests = [self.kept[name] for name in FRAMES]
        inputs = [first.factor, s.lanes, frames.frame_master, frames.frame_spin, starts[0], ends[0]]
        s.each_real(self.k_frames.part_frames, frames.count, inputs, [*bars, *rests])

    def _pull(self, pull: StageAdjoint, stage: Stage, parameters: bool) -> None:
        self.stepper.set_lag(stage)
        pull.solve_again()
        pull.pull(parameters=parameters)

    def _launch(self, kernel: Any, inputs: list[Any], outputs: list[wp.array]) -> None:
        wp.launch(kernel, dim=outputs[0].shape, inputs=inputs, outputs=outputs, device=self.stepper.shard.device)
