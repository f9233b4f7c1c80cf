"""The adjoint of a step of second order: stages with an extrapolation between. Theory: docs/theory/adjoint.md."""

from __future__ import annotations

from dataclasses import fields
from functools import partial
from typing import Any

import warp as wp

from softwarp.kernels.frames import extrapolated_adjoint
from softwarp.kernels.step import stage_adjoint
from softwarp.model import memory
from softwarp.model.frames import FrameModel
from softwarp.model.gradients import FRAMES, MEMORIES, MODES, Gradients
from softwarp.solvers.adjoint import StepAdjoint
from softwarp.solvers.adjoint_index import AdjointIndex
from softwarp.solvers.implicit_euler import ImplicitEuler
from softwarp.solvers.joint_adjoint import JointStepAdjoint
from softwarp.solvers.look_adjoint import LookStageAdjoint
from softwarp.solvers.newton_adjoint import NewtonAdjoint
from softwarp.solvers.second_order import ALL, SMOOTH, THIRD, PredictedEuler, SecondOrder, Stage
from softwarp.solvers.stage_adjoint import StageAdjoint
from softwarp.solvers.workspace.rows import Rows

MOVED = ("node_x", "node_v", *MEMORIES, *MODES)  # what is extrapolated along straight lines


class SecondOrderAdjoint:
    """Pulls gradients by the end of a step of BDF2 back to its start, for the worlds of one system.

    Rough worlds have a third stage, and nothing that is extrapolated.

    Args:
        stepper: Takes the step; its system has the state that the step started from.
        gradients: Arrays of these worlds, read and written.
        index: Of the model.
        rest: Whether gradients by the rest shape are asked for.

    Attributes:
        solution: Nothing is kept of a step.
        pulls: Adjoints of the stages; the last one is that of rough worlds.
    """

    def __init__(self, stepper: SecondOrder, gradients: Gradients, index: AdjointIndex, *, rest: bool = False) -> None:
        self.stepper, self.gradients, self.rest = stepper, gradients, rest
        self.solution: list[wp.array] = []
        system, device = stepper.system, stepper.shard.device
        self.k = stage_adjoint.kernels(system.variant)
        self.k_frames = extrapolated_adjoint.kernels(system.variant)
        self.pulls = [self._stage(step, index) for step in self.steps]
        held = {field.name: getattr(gradients, field.name) for field in fields(Gradients)}
        self.all = {name: array for name, array in held.items() if array.shape[1]}
        self.frames = model.frames if (model := system.model).has_moving_frames else None
        self.commands = {name: array for name, array in self.all.items() if name.startswith("command_")}
        self.moved = {name: array for name, array in self.all.items() if name in MOVED}
        if self.frames is not None:
            self.moved |= {name: array for name, array in self.all.items() if name in FRAMES}

        def like(arrays: dict[str, wp.array]) -> dict[str, wp.array]:
            return {name: memory.zeros(array.shape, array.dtype, device) for name, array in arrays.items()}

        self.rests, self.sums, self.before = like(self.moved), like(self.commands), like(self.all)
        self.ends = {name: array for name, array in stepper.arrays.items() if name in FRAMES}
        self.ends, self.middle = like(self.ends), like(stepper.arrays)

    @property
    def steps(self) -> list[ImplicitEuler | PredictedEuler]:
        """What the adjoints are of."""
        return [*self.stepper.steps, self.stepper.third]

    def _stage(self, step: ImplicitEuler | PredictedEuler, index: AdjointIndex) -> StepAdjoint:
        if isinstance(step, PredictedEuler) and step.system.multipliers.corrections:
            return LookStageAdjoint(step, self.gradients, index, self._heed, rest=self.rest)
        if isinstance(step, PredictedEuler):
            what = (step.system, step.h, step.pace, step.predict, self.gradients, index, step.judge, self._heed)
            return StageAdjoint(*what, rest=self.rest)
        if step.control is None:  # beside joints, at the start
            return JointStepAdjoint(step.system, step.h, self.gradients, index, step.pace, rest=self.rest)
        return NewtonAdjoint(step, self.gradients, index, rest=self.rest)

    def _heed(self, target: Rows) -> None:
        """1 in smooth worlds, else 0."""
        stepper = self.stepper
        stepper.shard.each_real(stepper.k.set_lag, None, [1.0, 0.0, stepper.rough], [target.real])

    def step(self) -> None:
        """Gradients by the end of the step from the system's state become those by its start."""
        self._step(parameters=True)
        self._hold()

    def step_alone(self) -> None:
        """The same without gradients by parameters."""
        self._step(parameters=False)
        self._hold()

    def _hold(self) -> None:
        """Velocities at the start count for nothing along axes that are held."""
        self.stepper.hold(self.gradients.node_v, self.gradients.frame_twist)

    def _step(self, *, parameters: bool) -> None:
        stepper, (first, second) = self.stepper, self.stepper.stages
        stepper.rough.zero_()
        stepper.keep()
        stepper.solve(0)
        for name, array in self.ends.items():
            wp.copy(array, stepper.arrays[name])
        stepper.extrapolate(0)
        for array in self.sums.values():
            array.zero_()
        stepper.find_any()
        wp.capture_if(stepper.any, partial(self._pull_third, parameters=parameters))
        self._pull(self.pulls[1], second, parameters)
        self._add(self.commands, self.sums)
        self._split(first.factor)
        if self.frames is not None:
            self._split_frames(self.frames, 0, stepper.start, self.ends)
        stepper.give_back()
        stepper.rough.zero_()  # which the first stage judges anew on its way
        self._pull(self.pulls[0], first, parameters)
        self._add(self.sums, self.commands)
        self._add(self.rests, self.moved)

    def _pull_third(self, *, parameters: bool) -> None:
        """The third stage of rough worlds."""
        stepper = self.stepper
        self._copy(ALL, stepper.arrays, self.middle)
        stepper.solve(1)
        for array in self.commands.values():
            array.zero_()
        self._copy(ALL, self.all, self.before)
        self._pull(self.pulls[2], THIRD, parameters)
        self._copy(SMOOTH, self.before, self.all)
        self._copy(ALL, self.commands, self.sums)
        self._copy(ALL, self.middle, stepper.arrays)

    def _copy(self, which: int, source: dict[str, wp.array], target: dict[str, wp.array]) -> None:
        self.stepper.copy(which, self.stepper.rough, source, target)

    def _add(self, parts: dict[str, wp.array], totals: dict[str, wp.array]) -> None:
        for name, total in totals.items():
            self._launch(self.k.add, [parts[name]], [total])

    def _split(self, factor: float) -> None:
        """Gradients by what is extrapolated in lines become those by the end of a stage and by its start."""
        s, rough = self.stepper.shard, self.stepper.rough
        for name, bar in self.moved.items():
            if name in MOVED:
                self._launch(self.k.part, [factor, s.lanes, bar, rough], [bar, self.rests[name]])

    def _split_frames(
        self, frames: FrameModel, number: int, first: dict[str, wp.array], last: dict[str, wp.array]
    ) -> None:
        """The same of frames, with the states that they are extrapolated from behind a stage."""
        stepper, s = self.stepper, self.stepper.shard
        stage, of_stage = stepper.stages[number], self.pulls[number].frames
        starts = [first[name] for name in FRAMES]
        ends = [last[name] for name in FRAMES]
        bars = [self.moved[name] for name in FRAMES]
        rests = [self.rests[name] for name in FRAMES]
        for rest in rests:
            rest.zero_()
        inputs = [stage.factor, s.lanes, frames.frame_master, frames.frame_spin, stepper.told]
        inputs += [starts[0], ends[0], stepper.rough]
        s.each_real(self.k_frames.part_frames, frames.count, inputs, [*bars, *rests])
        if of_stage is not None:
            of_stage.more_share.zero()
            lapse = (stage.factor - 1.0) * stage.length * stepper.h
            inputs = [stage.factor, lapse, s.lanes, frames.frame_master, frames.frame_spin]
            inputs += [starts[0], starts[1], ends[0], ends[1], s.work.compound.real, stepper.rough]
            s.each_real(self.k_frames.part_tops, frames.count, inputs, [*bars, *rests, of_stage.more_share.real])

    def _pull(self, pull: StepAdjoint, stage: Stage, parameters: bool) -> None:
        self.stepper.set_lag(stage)
        pull.solve_again()
        pull.pull(parameters=parameters)

    def _launch(self, kernel: Any, inputs: list[Any], outputs: list[wp.array]) -> None:
        wp.launch(kernel, dim=outputs[0].shape, inputs=inputs, outputs=outputs, device=self.stepper.shard.device)
