"""Steps of second order, made of stages that are backward Euler steps. Theory: docs/theory/second_order.md."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from softwarp.kernels.frames import momentum
from softwarp.kernels.step import stages
from softwarp.model import memory
from softwarp.model.codes import SHORTEST
from softwarp.model.fields import allocate, declarations, real_of
from softwarp.model.model import Model
from softwarp.model.state import State
from softwarp.solvers.implicit_euler import ImplicitEuler
from softwarp.solvers.multipliers import ContactMultipliers
from softwarp.solvers.repeats import RepeatingEuler, repeats_steps
from softwarp.solvers.system import System
from softwarp.solvers.terms.term import Pace
from softwarp.solvers.workspace.rows import Rows

GAMMA = 1.0 - 0.5**0.5  # of a step: stages of the L-stable method of two stages
VIOLENT = 0.05  # strain of an edge by the accelerations of a stage, above which a world is rough
FAST = 0.1  # likewise by the velocities at its start
CONSERVING = 2  # linearisations of a stage that damps nothing, so that what they neglect does not grow
ALL, SMOOTH, ROUGH = -1, 0, 1  # which worlds; the latter two are codes of ``rough``
FAILED = 1  # code of ``failed``
ALONG = ("node_x", "node_v", "node_memory", "frame_memory", "mode_q", "mode_v")  # extrapolated in straight lines
MOVING = (*ALONG, "frame_pose", "frame_twist")
OWN = ("status", "time")  # arrays that ``finish`` writes
COUNTS = (*OWN, "contact_overflow")  # that a step which is taken back leaves as it has made them


@dataclass(frozen=True)
class Stage:
    """A backward Euler step within a step; times are parts of it.

    Attributes:
        length: How long it is.
        lapse, ahead: As in ``Pace``.
        lag: What it leaves of commanded ways to later stages, in worlds that are smooth and in rough ones.
        factor: By how much the motion since the last kept state is extrapolated after it, or 1.
        keep: Whether the state at its start is what the next extrapolation starts from.
    """

    length: float
    lapse: float
    ahead: float
    lag: tuple[float, float]
    factor: float = 1.0
    keep: bool = True


_FIRST = Stage(GAMMA, GAMMA, 1.0, (1.0 - GAMMA, 1.0 - GAMMA), factor=1.0 / GAMMA - 1.0)
_SECOND = Stage(GAMMA, 1.0 - GAMMA, 0.0, (0.0, 1.0 - GAMMA / (1.0 - GAMMA)), keep=False)
THIRD = Stage(1.0 - 2.0 * GAMMA, 0.0, 0.0, (0.0, 0.0), keep=False)
BDF2 = (_FIRST, _SECOND)
TRAPEZOIDAL = (
    Stage(0.25, 0.5, 1.0, (0.75, 0.75), factor=2.0),
    Stage(0.25, 0.5, 0.0, (0.5, 0.5), factor=2.0),
)


class PredictedEuler:
    """A backward Euler step, linearised about where the velocities of its start lead to.

    About its start, as ``ImplicitEuler`` does it, an inexact tangent and matrix of damping would leave an error of
    first order. Rough worlds are linearised there nevertheless: bodies that touch stop short of such a place.

    Args:
        system: Worlds.
        h: Length [s].
        pace: What it does of the commands.
        judge: Called once contacts are known.
        predict: Writes the velocities to start from.
        solves: Linearisations, the later ones about where those before lead to.
    """

    def __init__(
        self, system: System, h: float, pace: Pace, predict: Callable[[], None], judge: Callable[[], None], solves: int
    ) -> None:
        self.system, self.h, self.pace, self.solves = system, h, pace, solves
        self.predict, self.judge = predict, judge

    def step(self) -> None:
        """Advance by its length."""
        system, h = self.system, self.h
        system.load()
        system.scale(h)
        system.measure_rows()
        system.command(h, self.pace)
        system.find_contacts(h, moving=False, look=self.pace.look)
        self.judge()
        self.predict()
        for _ in range(self.solves):
            system.move(h)
            system.measure_rows()
            system.row_laws()
            system.forces()
            system.tangent()
            system.right_hand_side(h, inertia=True, moving=True)
            system.solve(h, h)
            system.rotation_step(h)
            system.add_unknowns()
        system.arrive(h)
        system.commit(h, 1.0, iterated=False)


class SecondOrder:
    """Advances the worlds of a shard by a step of second order, in place.

    Args:
        system: Worlds; their ``Options.integrator`` is the scheme.
        h: Step [s].

    Two stages make a step. A world that touches something, or may before the step is over, or whose first stage strains
    it violently, is rough: it takes three backward Euler steps instead, without extrapolation.

    Attributes:
        always: Take the third stage whether a world needs it or not, as where a recording cannot branch.
    """

    def __init__(self, system: System, h: float) -> None:
        self.system, self.h, self.always = system, h, False
        self.shard = system.shard
        self.k, self.k_frames = stages.kernels(system.variant), momentum.kernels(system.variant)
        model = system.model
        rows = {name: getattr(system.state, name) for name in declarations(State)}
        self.arrays = {name: array for name, array in rows.items() if array.shape[1]}
        self.start = {name: self._like(array) for name, array in self.arrays.items()}
        self.moving = {name: array for name, array in self.arrays.items() if name in MOVING}
        self.is_free = system.contact is None and model.row_count == 0
        self.stages = TRAPEZOIDAL if system.options.integrator == "trapezoidal" and self.is_free else BDF2
        self.base = self.start  # of extrapolations
        self.told, self.held = self._told(), self._held()
        if self._keeps_twice:
            self.base = {name: self._like(array) for name, array in self.moving.items()}
        self.smooth = {name: self._like(array) for name, array in self.arrays.items()}
        self.any = memory.zeros((1,), wp.int32, self.shard.device)
        self.pairs = _edges(model)
        self.guess = self._guess()
        self.rough, self.failed, self.worst = (self._codes() for _ in range(3))
        self.steps = [self._euler(stage, first=number == 0) for number, stage in enumerate(self.stages)]
        self.third = self._euler(THIRD, first=False)

    def _told(self) -> wp.array:
        """Frames whose twists are told them where a step ends in an extrapolation, as 1."""
        frames = self.system.model.frames
        told = np.zeros(0 if frames is None else frames.count, dtype=np.int32)
        if frames is not None and self.stages is TRAPEZOIDAL:
            told[: frames.rigid_count] = frames.is_kinematic
        return wp.array(told, dtype=wp.int32, device=self.shard.device)

    def _held(self) -> wp.array:
        """Dofs that are held along axes, but for those of kinematic bodies."""
        model = self.system.model
        held, frames = model.prescribed_dof.numpy(), model.frames
        if frames is not None:
            driven = np.flatnonzero(frames.is_kinematic)
            held = held[~np.isin((model.dof_node.numpy()[held] - model.node_count) // 2, driven)]
        return wp.array(held, dtype=wp.int32, device=self.shard.device)

    @property
    def _keeps_twice(self) -> bool:
        return sum(stage.keep for stage in self.stages) > 1

    def _guess(self) -> Rows | None:
        """Room for the velocities that stages start from, where contacts are looked at in the middle of a solve."""
        multipliers = self.system.multipliers
        if not isinstance(multipliers, ContactMultipliers) or self.system.contact is None:
            return None
        multipliers.guess = self.shard.rows(self.shard.dof_room)
        return multipliers.guess

    def _like(self, array: wp.array) -> wp.array:
        return allocate(array.shape[0], array.shape[1], array.dtype, self.shard.device)

    def _codes(self) -> wp.array:
        s = self.shard
        return memory.zeros((s.packs, 1, s.lanes), wp.int32, s.device)

    def _euler(self, stage: Stage, *, first: bool) -> ImplicitEuler | PredictedEuler:
        system, h = self.system, stage.length * self.h
        look = self.h if first else h  # the first one tells whether there is contact in the whole step
        pace = Pace(stage.lapse * self.h, stage.ahead * self.h, look)
        if system.options.newton_iterations > 1 or system.model.joints is not None:
            return ImplicitEuler(system, h, pace, self.predict if self.is_free else None)
        judge = self._judge_start if first and self.stages is BDF2 else _nothing
        solves = CONSERVING if self.stages is TRAPEZOIDAL else 1
        return PredictedEuler(system, h, pace, self.predict, judge, solves)

    def step(self) -> None:
        """Advance by one step."""
        self.rough.zero_()
        self.keep()
        for number in range(len(self.stages)):
            self.take(number)
        if self.stages is BDF2:
            self.find_any()
            if self.always:
                self._finish_rough()
            else:
                wp.capture_if(self.any, self._finish_rough)
        self._finish()
        if self.stages is TRAPEZOIDAL:
            self.system.refresh()  # it ends in an extrapolation

    def keep(self) -> None:
        """Note the state as that of the start, without velocities along axes that are held: no stage leaves any."""
        self.hold(*(getattr(self.system.state, name) for name in ("node_v", "frame_twist")))
        self.copy(ALL, self.rough, self.arrays, self.start)

    def hold(self, node_v: wp.array, twist: wp.array) -> None:
        """Velocities, or gradients by them, become 0 along axes that are held."""
        s, m = self.shard, self.system.model
        inputs = [s.lanes, m.node_count, self.held, m.dof_node, m.dof_free]
        s.each_real(self.k.hold, self.held.size, inputs, [node_v, twist])

    def give_back(self) -> None:
        """The start's state once more."""
        self.copy(ALL, self.rough, self.start, self.arrays)

    def take(self, number: int) -> None:
        """One stage, and the extrapolation behind it."""
        self.solve(number)
        self.extrapolate(number)

    def solve(self, number: int) -> None:
        """One stage."""
        stage = self.stages[number]
        if stage.keep and self._keeps_twice:
            self.copy(ALL, self.rough, self.moving, self.base)
        self.set_lag(stage)
        self.steps[number].step()
        self._note(first=number == 0, which=ALL)
        if number == 0 and self.stages is BDF2:
            self._judge_contact()
            self._judge_strain(stage.length * self.h, VIOLENT)

    def extrapolate(self, number: int) -> None:
        """The extrapolation behind a stage, if it has one."""
        if self.stages[number].factor != 1.0:
            self._extrapolate(self.stages[number])

    def find_any(self) -> None:
        """Whether any world is rough."""
        self.any.zero_()
        self.shard.each_real(self.k.gather, None, [self.rough], [self.any])

    def _finish_rough(self) -> None:
        """The third stage of rough worlds."""
        self.copy(SMOOTH, self.rough, self.arrays, self.smooth)
        self.set_lag(THIRD)
        self.third.step()
        self._note(first=False, which=ROUGH)
        self.copy(SMOOTH, self.rough, self.smooth, self.arrays)

    def set_lag(self, stage: Stage) -> None:
        """What a stage leaves to later ones, in the workspace."""
        inputs = [*stage.lag, self.rough]
        self.shard.each_real(self.k.set_lag, None, inputs, [self.system.work.lag.real])

    def _judge_start(self) -> None:
        """Whether worlds touch something, or their velocities lead too far to be linearised there."""
        self._judge_contact()
        self._judge_strain(self.stages[0].length * self.h, FAST)

    def _judge_contact(self) -> None:
        contact = self.system.contact
        if contact is not None:
            inputs = [contact.contacts.count.real, contact.detector.reserve_count.real]
            self.shard.each_real(self.k.judge, None, inputs, [self.rough])

    def _judge_strain(self, h: float, limit: float) -> None:
        """Whether the way to the trial positions, less h times the velocities of the start, strains an edge too much.

        At the start of a stage that is the way of these velocities, at its end that of accelerations.
        """
        s, i, w = self.shard, self.shard.input, self.system.work
        for kernel, (pairs, lengths), names, trial in (
            (self.k.judge_nodes, self.pairs[0], ("x0", "v0"), w.x),
            (self.k.judge_frames, self.pairs[1], ("pose0", "twist0"), w.pose),
        ):
            inputs = [h, limit, pairs, lengths, *(i[name].real for name in names), trial.real]
            s.each_real(kernel, s.variant.parts(len(lengths)), inputs, [self.rough])

    def predict(self) -> None:
        """Velocities that a stage is linearised with: those of its start, and 0 in rough worlds."""
        s, m, w = self.shard, self.system.model, self.system.work
        starts = [s.input[name].real for name in ("v0", "twist0", "mode_v0")]
        inputs = [m.node_count, m.node_count + 2 * m.frame_count, m.dof_node, *starts, self.rough]
        s.each_real(self.k.predict, m.dof_count, inputs, [w.dof_v.real])
        if self.guess is not None:
            self.guess.copy_from(w.dof_v)

    def _note(self, *, first: bool, which: int) -> None:
        inputs = [first, which, self.shard.lanes, self.arrays["status"], self.rough]
        self.shard.each_real(self.k.note, None, inputs, [self.worst])

    def _extrapolate(self, stage: Stage) -> None:
        s, m, factor, now, base = self.shard, self.system.model, stage.factor, self.arrays, self.base
        for name in ALONG:
            if name in now:
                inputs = [factor, s.lanes, base[name], self.rough]
                s.each_real(self.k.extrapolate, s.variant.parts(now[name].shape[1]), inputs, [now[name]])
        if m.frames is not None:
            start, end = ([arrays["frame_pose"], arrays["frame_twist"]] for arrays in (base, now))
            inputs = [factor, s.lanes, m.frames.frame_spin, self.told, *start, self.rough]
            s.each_real(self.k.extrapolate_frames, s.variant.parts(m.frames.count), inputs, end)
            lapse = (factor - 1.0) * stage.length * self.h
            inputs = [factor, lapse, s.lanes, m.frames.frame_spin, *start, self.rough, self.system.work.compound.real]
            s.each_real(self.k_frames.extrapolate_tops, m.frames.count, inputs, end)

    def _finish(self) -> None:
        s = self.shard
        inputs = [self.h, s.lanes, self.start["time"], self.worst]
        s.each_real(self.k.finish, None, inputs, [self.arrays["status"], self.arrays["time"], self.failed])
        back = {name: array for name, array in self.start.items() if name not in COUNTS}
        self.copy(FAILED, self.failed, back, self.arrays)

    def copy(self, which: int, code: wp.array, source: dict[str, Any], target: dict[str, Any]) -> None:
        """Copy the arrays of ``source`` to those of the same names, in worlds whose code is ``which``."""
        s = self.shard
        for name, array in source.items():
            kernel = self.k.choose_integers if array.dtype is wp.int32 else self.k.choose
            parts = s.variant.parts(array.shape[1])
            s.each_real(kernel, parts, [which, s.lanes, array, code], [target[name]])


def _edges(model: Model) -> list[tuple[wp.array, wp.array]]:
    """Pairs of nodes, and of frames, that A couples, with their distances at rest [m]."""
    slot, real = model.dof_node.numpy(), real_of(model.precision)
    ends = np.sort(np.stack([slot[model.symbolic.a_row], slot[model.symbolic.a_col]], axis=1), axis=1)
    frames = (ends - model.node_count) // 2
    is_node = ends[:, 1] < model.node_count
    is_frame = (
        (ends[:, 0] >= model.node_count)
        & (frames[:, 1] < model.frame_count)
        & ((ends - model.node_count) % 2 == 0).all(axis=1)
    )
    places = model.node_rest, np.zeros((0, 3)) if model.frames is None else model.frames.rest_pose[:, :3]
    edges = []
    for pairs, rest in ((ends[is_node], places[0]), (frames[is_frame], places[1])):
        length = np.linalg.norm(rest[pairs[:, 0]] - rest[pairs[:, 1]], axis=1)
        apart = length > SHORTEST
        pair = wp.array(pairs[apart].astype(np.int32), dtype=wp.int32, device=model.device, ndim=2)
        edges.append((pair, wp.array(length[apart], dtype=real, device=model.device)))
    return edges


def _nothing() -> None:
    """Judge no world."""


def stepper(system: System, h: float) -> ImplicitEuler | RepeatingEuler | SecondOrder:
    """What advances the worlds of a shard by steps of a length [s], as their options say."""
    if repeats_steps(system.model, system.options):
        return RepeatingEuler(system, h)
    return ImplicitEuler(system, h) if system.options.integrator == "euler" else SecondOrder(system, h)
