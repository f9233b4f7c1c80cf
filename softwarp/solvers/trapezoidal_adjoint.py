"""The adjoint of a step of the trapezoidal rule: two stages, each extrapolated. Theory: docs/theory/adjoint.md."""

from __future__ import annotations

from dataclasses import fields

import warp as wp

from softwarp.model import memory
from softwarp.model.gradients import FRAMES, MEMORIES, MODES, STATE, Gradients
from softwarp.solvers.adjoint import StepAdjoint
from softwarp.solvers.adjoint_index import AdjointIndex
from softwarp.solvers.implicit_euler import ImplicitEuler
from softwarp.solvers.leaning_adjoint import LeaningFrames
from softwarp.solvers.second_order import ALL, PredictedEuler, SecondOrder
from softwarp.solvers.second_order_adjoint import SecondOrderAdjoint
from softwarp.solvers.stage_adjoint import StageAdjoint


class EarlierAdjoint(StageAdjoint):
    """The first of two linearisations of a stage, whose velocities are those that the later one is made with.

    Attributes:
        later: The other one; gradients by its ``ahead`` are those by what this one finds.
    """

    later: StageAdjoint

    def _seed(self, *, first: bool = True) -> None:
        StepAdjoint._seed(self, first=first)
        s, m, y = self.shard, self.model, self.system.linear.y
        inputs = [m.dof_free, self.later.ahead.real]
        s.each_real(self.k_stage.add_ahead, m.dof_count, inputs, [self.seed.real, y.real])
        if isinstance(self.frames, LeaningFrames):
            self.frames.turn_seed(self.seed, y, self.solved_v)
            s.work.dof_v.copy_from(self.solved_v)


class LaterAdjoint(StageAdjoint):
    """A stage of two linearisations, the second about where the first leads to; see ``StageAdjoint``.

    Args:
        step: Takes the stage; its system has the state that it starts from.
        gradients: Arrays of these worlds, read and written.
        index: Of the model.
        rest: Whether gradients by the rest shape are asked for.
    """

    follows = 0.0

    def __init__(self, step: PredictedEuler, gradients: Gradients, index: AdjointIndex, *, rest: bool) -> None:
        super().__init__(step.system, step.h, step.pace, self._recall, gradients, index, rest=rest)
        self.found_v = self.shard.rows(self.shard.dof_room)
        self.earlier = EarlierAdjoint(step.system, step.h, step.pace, step.predict, gradients, index, rest=rest)
        self.earlier.later = self
        names = [*STATE, *FRAMES, *MEMORIES, *MODES]
        names += [field.name for field in fields(gradients) if field.name.startswith("command_")]
        parts = [getattr(gradients, name) for name in names]
        self.sums = [
            (part, memory.zeros(part.shape, part.dtype, step.system.shard.device)) for part in parts if part.size
        ]

    def _recall(self) -> None:
        """The velocities that the first solution has led to."""
        self.shard.work.dof_v.copy_from(self.found_v)

    def solve_again(self) -> None:
        """Both solutions."""
        self.earlier.solve_again()
        self.found_v.copy_from(self.earlier.final_v)
        super().solve_again()

    def pull(self, *, parameters: bool = True) -> None:
        """Of the second solution, then of the first one, which has no gradients but by what it finds."""
        super().pull(parameters=parameters)
        for bar, total in self.sums:
            wp.copy(total, bar)
            bar.zero_()
        self.earlier.solve_again()
        self.earlier.pull(parameters=parameters)
        for bar, total in self.sums:
            wp.launch(self.k_stage.add, dim=bar.shape, inputs=[total], outputs=[bar], device=self.shard.device)


class TrapezoidalAdjoint(SecondOrderAdjoint):
    """Pulls gradients by the end of a step of the trapezoidal rule back to its start; see ``SecondOrderAdjoint``."""

    def __init__(self, stepper: SecondOrder, gradients: Gradients, index: AdjointIndex, *, rest: bool = False) -> None:
        super().__init__(stepper, gradients, index, rest=rest)
        device = stepper.shard.device
        self.starts, self.stops = (
            [
                {name: memory.zeros(array.shape, array.dtype, device) for name, array in held.items()}
                for _ in stepper.stages
            ]
            for held in (stepper.arrays, self.ends)
        )

    @property
    def steps(self) -> list[ImplicitEuler | PredictedEuler]:
        """What the adjoints are of."""
        return self.stepper.steps

    def _stage(self, step: ImplicitEuler | PredictedEuler, index: AdjointIndex) -> StepAdjoint:
        if isinstance(step, PredictedEuler):
            return LaterAdjoint(step, self.gradients, index, rest=self.rest)
        return super()._stage(step, index)

    def _step(self, *, parameters: bool) -> None:
        stepper = self.stepper
        stepper.rough.zero_()
        stepper.keep()
        for array in self.sums.values():
            array.zero_()
        for number, (start, stop) in enumerate(zip(self.starts, self.stops, strict=True)):
            self._copy(ALL, stepper.arrays, start)
            stepper.solve(number)
            self._copy(ALL, {name: stepper.arrays[name] for name in stop}, stop)
            stepper.extrapolate(number)
        self._take_carried()
        modes = self.pulls[0].modes
        if modes is not None:
            modes.take(at_end=True)
        for number in reversed(range(len(stepper.stages))):
            stage = stepper.stages[number]
            self._copy(ALL, self.starts[number], stepper.arrays)
            self._split(stage.factor)
            if self.frames is not None:
                self._split_frames(self.frames, number, self.starts[number], self.stops[number])
            self._pull(self.pulls[number], stage, parameters)
            self._add(self.commands, self.sums)
            self._add(self.rests, self.moved)
        for name, total in self.sums.items():
            wp.copy(self.commands[name], total)

    def _take_carried(self) -> None:
        """What is by carried nodes and frames at the end of the step, where they follow from what carries them."""
        model, of_stage, arrays = self.frames, self.pulls[0].frames, self.stepper.arrays
        if model is None or of_stage is None or not model.carried_count:
            return
        s, g = self.stepper.shard, self.gradients
        inputs = [s.model.node_count, model.frame_master, model.frame_offset, of_stage.item_start, of_stage.item]
        inputs += [model.carried_slot, model.carried_offset, of_stage.rest_pose, *(arrays[name] for name in FRAMES)]
        bars = [g.node_x, g.node_v, *(getattr(g, name) for name in FRAMES), g.rest_x]
        worlds = g.frame_pose.shape[0]
        wp.launch(self.k_frames.take_carried, dim=(worlds, model.count), inputs=inputs, outputs=bars, device=s.device)
