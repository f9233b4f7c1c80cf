"""The adjoint of a step of BDF2: its two stages and the extrapolation between them. Theory: docs/theory/adjoint.md."""

from __future__ import annotations

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
from softwarp.solvers.implicit_euler import ImplicitEuler
from softwarp.solvers.joint_adjoint import JointStepAdjoint
from softwarp.solvers.newton_adjoint import NewtonAdjoint
from softwarp.solvers.second_order import SecondOrder, Stage
from softwarp.solvers.stage_adjoint import StageAdjoint

MOVED = ("node_x", "node_v", *MEMORIES)  # what is extrapolated along straight lines


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

        self.pulls = [self._stage(number, index) for number in range(len(stepper.stages))]
        held = {field.name: getattr(gradients, field.name) for field in fields(Gradients)}
        names = [*MOVED, *FRAMES, *(name for name in held if name.startswith("command_"))]
        self.arrays = {name: held[name] for name in names if name in held and held[name].shape[1]}
        self.kept = {name: memory.zeros(a.shape, a.dtype, device) for name, a in self.arrays.items()}
        self.frames = model.frames if (model := system.model).has_moving_frames else None
        if self.frames is None:
            self.arrays = {name: array for name, array in self.arrays.items() if name not in FRAMES}
        frames = {name: array for name, array in self.arrays.items() if name in FRAMES}
        self.middle = {name: memory.zeros(a.shape, a.dtype, device) for name, a in frames.items()}

    def _stage(self, number: int, index: AdjointIndex) -> StepAdjoint:
        stepper, gradients, step = self.stepper, self.gradients, self.stepper.steps[number]
        if isinstance(step, ImplicitEuler):
            if step.control is None:  # beside joints, at the start
                return JointStepAdjoint(step.system, step.h, gradients, index, step.pace)
            return NewtonAdjoint(step, gradients, index)
        return StageAdjoint(stepper.system, step.h, step.pace, stepper.predict, gradients, index)

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
        of_first = self.pulls[0].frames
        if of_first is not None:
            of_first.more_share.zero()
            lapse = (first.factor - 1.0) * first.length * stepper.h
            inputs = [first.factor, lapse, s.lanes, frames.frame_master, frames.frame_spin]
            inputs += [starts[0], starts[1], ends[0], ends[1], s.work.compound.real]
            s.each_real(self.k_frames.part_tops, frames.count, inputs, [*bars, *rests, of_first.more_share.real])

    def _pull(self, pull: StepAdjoint, stage: Stage, parameters: bool) -> None:
        self.stepper.set_lag(stage)
        pull.solve_again()
        pull.pull(parameters=parameters)

    def _launch(self, kernel: Any, inputs: list[Any], outputs: list[wp.array]) -> None:
        wp.launch(kernel, dim=outputs[0].shape, inputs=inputs, outputs=outputs, device=self.stepper.shard.device)
