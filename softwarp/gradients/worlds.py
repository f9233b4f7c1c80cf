"""Worlds of their own that step and that pull gradients back through these steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import TYPE_CHECKING

import warp as wp

from softwarp import interop
from softwarp.gradients.kept import KeptSolutions
from softwarp.gradients.replayed import Replayed
from softwarp.gradients.rows import RowDirections
from softwarp.model.codes import Status
from softwarp.model.gradients import (
    CONTACT,
    FLOATING,
    FRAMES,
    JOINT_MEMORY,
    JOINTS,
    KINEMATIC,
    MEMORIES,
    MODES,
    STATE,
    Ends,
    Gradients,
)
from softwarp.model.model import Model
from softwarp.model.state import Control, Parameters, State, create, worlds_slice
from softwarp.simulation import Simulation
from softwarp.solvers.adjoint import StepAdjoint
from softwarp.solvers.adjoint_index import AdjointIndex
from softwarp.solvers.directional import StepDirection
from softwarp.solvers.implicit_euler import ImplicitEuler
from softwarp.solvers.joint_adjoint import JointStepAdjoint
from softwarp.solvers.look_adjoint import LookStepAdjoint
from softwarp.solvers.look_directional import LookStepDirection
from softwarp.solvers.newton_adjoint import NewtonAdjoint
from softwarp.solvers.repeats import RepeatingEuler
from softwarp.solvers.second_order import BDF2, SecondOrder, stepper
from softwarp.solvers.second_order_adjoint import SecondOrderAdjoint
from softwarp.solvers.system import System
from softwarp.solvers.trapezoidal_adjoint import TrapezoidalAdjoint
from softwarp.threads import Workers, alone

if TYPE_CHECKING:
    import torch

Flags = list[tuple[tuple[int, int], "torch.Tensor"]]  # those of some worlds each, not 0 where there is something
LAG = 1.0e-3  # m/s and rad/s, beside commands of up to 1: what rounding may make of a velocity


class OwnArrays:
    """State, commands, parameters and gradients of as many worlds as a model has.

    Args:
        model: Scene.

    Attributes:
        worlds: State, commands and parameters.
        gradients: Those by all these.
        names: Of the arrays of ``gradients``.
        views: Torch views of the four, by name, with the names of parts of frames besides.
    """

    def __init__(self, model: Model) -> None:
        self.worlds = create(State, model), create(Control, model), create(Parameters, model)
        self.gradients = create(Gradients, model)
        state, control, parameters, gradients = (interop.views(each, model) for each in (*self.worlds, self.gradients))
        self.names = tuple(gradients)
        if model.frames is not None:
            state |= interop.frame_aliases(state, model, *FRAMES)
            gradients |= interop.frame_aliases(gradients, model, *FRAMES)
            control |= interop.force_aliases(control, model)
            named = interop.force_aliases({"frame_force": gradients["command_frame_force"]}, model)
            gradients |= {f"command_{name}": view for name, view in named.items()}
        self.views = state, control, parameters, gradients

    def part(self, worlds: slice) -> Gradients:
        """Gradients of some worlds."""
        found: Gradients = worlds_slice(self.gradients, worlds.start, worlds.stop)
        return found


class Directions:
    """Slopes of worlds, which one factor of a step pushes through it in all directions.

    Args:
        twins: Worlds of each shard and their system.
        model: Of all.
        h: Step [s].
        index: Of the model.
        workers: Threads for several shards.

    Attributes:
        slopes: Views of the direction that is pushed, named after ``Gradients``.
    """

    @alone
    def __init__(
        self,
        twins: Sequence[tuple[slice, System]],
        model: Model,
        h: float,
        index: AdjointIndex,
        workers: Workers | None,
    ) -> None:
        arrays, factors = create(Gradients, model), create(Gradients, model)
        self.slopes = interop.views(arrays, model)
        steps = []
        for each, system in twins:
            slopes, room = (worlds_slice(held, each.start, each.stop) for held in (arrays, factors))
            kind = LookStepDirection if system.multipliers.corrections else StepDirection
            steps.append(kind(system, h, slopes, room, index))
        self._linearise, self._push, self._finish = (
            Replayed(model.device, [getattr(step, name) for step in steps], workers)
            for name in ("linearise", "push", "finish")
        )

    def step(self, slopes: Sequence[dict[str, torch.Tensor]]) -> list[dict[str, torch.Tensor]]:
        """As ``DifferentiableWorlds.step_along``."""
        self._linearise()
        pushed = []
        for direction in slopes:
            for name, view in self.slopes.items():
                if name in direction:
                    view.copy_(direction[name])
                else:
                    view.zero_()
            self._push()
            pushed.append({name: self.slopes[name].clone() for name in STATE})
        self._finish()
        return pushed


class DifferentiableWorlds:
    """As many worlds as a simulation has, of the same scene, which take its steps to the bit and pull gradients back.

    Args:
        sim: What to follow; its step [s] and options are those of now.
        rest: Whether gradients by the rest shape are asked for.

    Attributes:
        state, control, parameters: Views of these worlds' arrays, as ``sim``, ``sim.control`` and ``sim.params`` have.
        gradients: Views of ``Gradients``.
        arrays: Names of these that are not parts of others.
        names: Names of what carries gradients from step to step.
        memory: Names of what else a step reads of the state, without gradients.
        pressed: Largest compression of an element in the steps since ``start``, (world,).
        failed: Worlds that a step has failed in since ``start``, bool, (world,).
        unfinished: Likewise, worlds where the iterations of a step ended above their tolerance.
        lagging: Likewise, worlds where a kinematic body had another velocity than its command.

    ``held`` names, likewise, worlds where a step was held back because elements were inside out.
    """

    @alone
    def __init__(self, sim: Simulation, *, rest: bool = False) -> None:
        import torch

        model = sim.model
        self.sim, self.model, self.h, self._has_rest = sim, model, sim.dt, rest
        room = OwnArrays(model)
        self.state, self.control, self.parameters, self.gradients = room.views
        self.arrays = room.names
        self.names: Sequence[str] = (*STATE, *FRAMES) if model.has_moving_frames else STATE
        memory = (*(CONTACT if model.contact else ()), *(KINEMATIC if model.frames else ()))
        if model.joints is not None:
            self.names, memory = (*self.names, *JOINTS), (*memory, *JOINT_MEMORY)
        if model.relaxes:
            self.names = (*self.names, *MEMORIES)
        if model.reduction is not None:
            self.names = (*self.names, *MODES)
            if model.reduction.floating is not None:
                self.names = (*self.names, *FLOATING)
        self._index = index = AdjointIndex.of(model)
        self._twins = twins = sim.make_twins(*room.worlds)
        self._held = held_flags([system for _, system in twins])
        if self._held:
            memory = (*memory, "compression")  # worlds that begin a step inverted may be held back
        self.memory = tuple(name for name in memory if name not in self.names)
        self._carried = {name: self.state[name] for name in (*self.names, *self.memory) if self.state[name].numel()}
        steppers = [stepper(system, self.h) for _, system in twins]
        parts = [room.part(each) for each, _ in twins]
        pulls = [
            _adjoint(each, part, index, rest=rest)
            for each, part in zip(steppers, parts, strict=True)
            if not isinstance(each, RepeatingEuler)  # refused before
        ]
        self._ends = self._hold_ends([(each, pull) for (each, _), pull in zip(twins, pulls, strict=True)])
        self._workers = workers = Workers(len(twins)) if len(twins) > 1 else None
        self._directions: Directions | RowDirections | None = None
        self._step = Replayed(model.device, [stepper.step for stepper in steppers], workers)
        self._refresh = Replayed(model.device, [system.refresh for _, system in twins], workers)
        launches = {
            (name, parameters, *way): [_launches(pull, of_pull, *way) for pull in pulls]
            for name in ("step", "prepare", "pull")
            for parameters, of_pull in ((True, name), (False, f"{name}_alone"))
            for way in product((True, False), repeat=3)
            if hasattr(pulls[0], of_pull)
        }
        self._pull, self._prepare, self._pull_kept = (
            {key[1:]: Replayed(model.device, each, workers) for key, each in launches.items() if key[0] == name}
            for name in ("step", "prepare", "pull")
        )
        self._of_kept = {key[1:]: each for key, each in launches.items() if key[0] == "pull"}
        self.kept_solutions = KeptSolutions(model.device, pulls, workers)
        self.pressed = torch.zeros_like(self.state["compression"])
        self.failed, self.unfinished, self.lagging = (
            torch.zeros(model.num_worlds, dtype=torch.bool, device=self.state["time"].device) for _ in range(3)
        )
        stages: list[tuple[tuple[int, int], StepAdjoint]] = [
            ((worlds.start, worlds.stop), part)
            for (worlds, _), pull in zip(twins, pulls, strict=True)
            for part in (pull.pulls if isinstance(pull, SecondOrderAdjoint) else [pull])
        ]
        self._adrift = [(at, _flags(part.adrift)) for at, part in stages if isinstance(part, NewtonAdjoint)]
        self._unsure = [(at, _flags(part.contact.unsure)) for at, part in stages if part.contact is not None]
        held = [] if model.frames is None else model.frames.is_kinematic.nonzero()[0].tolist()
        self._kinematic = torch.tensor(held, dtype=torch.long, device=self.failed.device)

    def _hold_ends(self, pulls: Sequence[tuple[slice, StepAdjoint | SecondOrderAdjoint]]) -> dict[str, torch.Tensor]:
        """Views of what says where nodes are at the end of a step, for adjoints that go by that."""
        if self.model.reduction is None or self.model.reduction.floating is None:
            return {}
        ends = create(Ends, self.model)
        for each, pull in pulls:
            if isinstance(pull, StepAdjoint) and pull.modes is not None and pull.modes.frames is not None:
                pull.modes.frames.hold(worlds_slice(ends, each.start, each.stop))
        return interop.views(ends, self.model)

    def start(self) -> None:
        """Take over state, commands and parameters of the simulation as they are now."""
        if self.sim.model is not self.model:
            raise RuntimeError("rollout: the simulation has made room for more contacts since; make the Rollout anew")
        views = self.sim.state_tensors()
        commands, parameters = self.sim.control.tensors(), self.sim.params.tensors()
        self.place({name: views[name] for name in (*self.names, *self.memory)})
        for name, value in commands.items():
            self.control[name].copy_(value)
        for name, value in parameters.items():
            self.parameters[name].copy_(value)
        self.failed.zero_()
        self.unfinished.zero_()
        self.forget()
        self.lagging.zero_()
        for _, told in self._held:
            told.zero_()
        self.pressed.zero_()
        self.state["contact_overflow"].zero_()

    def refresh(self) -> None:
        """What follows from poses that were written by hand, as coordinates of joints do."""
        self._refresh()

    def step(self) -> None:
        """Take one step."""
        self._step()
        self._watch()

    def take(self) -> None:
        """``step`` without keeping what it tells of trouble."""
        self._step()

    @property
    def directions(self) -> Directions | RowDirections:
        """What pushes slopes through steps, made when it is first asked for."""
        if self._directions is None and (
            self.model.has_moving_frames
            or self.model.relaxes
            or self.model.membranes is not None
            or self.model.hexes is not None
            or self.model.reduction is not None
            or (self.model.contact is not None and self.model.contact.topology.has_embedded)
            or not self.solution_bytes
            or self._has_rest
        ):
            self._directions = RowDirections(self)
        elif self._directions is None:
            self._directions = Directions(self._twins, self.model, self.h, self._index, self._workers)
        return self._directions

    def step_along(self, slopes: Sequence[dict[str, torch.Tensor]]) -> list[dict[str, torch.Tensor]]:
        """Take one step, and push slopes through it.

        Args:
            slopes: Of every direction those that are not 0, by names of ``Gradients``.

        Returns:
            Slopes of the state after the step, ``names``, of every direction.
        """
        pushed = self.directions.step(slopes)
        self._watch()
        return pushed

    def _watch(self) -> None:
        """Keep what a step tells of trouble."""
        self.pressed.copy_(self.pressed.maximum(self.state["compression"]))
        self.failed.logical_or_(self.state["status"] >= int(Status.NONFINITE))
        self.unfinished.logical_or_(self.state["status"] == int(Status.MAX_ITERATIONS))
        if self.model.has_kinematic and self.model.has_moving_frames:
            told = self.control["body_velocity"]
            behind = (self.state["body_twist"] - told).abs() > LAG * (1.0 + told.abs().amax())
            behind = behind[:, self._kinematic].flatten(1).any(dim=1)
            self.lagging.logical_or_(behind)

    @property
    def adrift(self) -> torch.Tensor:
        """Worlds whose gradients did not come to stay since ``start``, bool, (world,)."""
        return told_worlds(self._adrift, self.failed)

    @property
    def unsure(self) -> torch.Tensor:
        """Worlds where contacts that slipped repeated each other since ``start``, bool, (world,)."""
        return told_worlds(self._unsure, self.failed)

    @property
    def holds_back(self) -> bool:
        """Whether steps of this scene may be held back."""
        return bool(self._held)

    @property
    def held(self) -> torch.Tensor:
        """Worlds where a step was held back since ``start``, of which gradients know nothing, bool, (world,)."""
        return told_worlds(self._held, self.failed)

    def forget(self) -> None:
        """Neither ``adrift`` nor ``unsure`` has any world from now on."""
        for _, told in (*self._adrift, *self._unsure):
            told.zero_()

    def place(self, state: dict[str, torch.Tensor]) -> None:
        """Put positions, velocities, tensions and pressures in place, and the memory of contacts."""
        interop.copy_all(list(self._carried.values()), [state[name] for name in self._carried])

    def kept(self) -> dict[str, torch.Tensor]:
        """Copies of these."""
        return {name: self.state[name].clone() for name in (*self.names, *self.memory)}

    @property
    def solution_bytes(self) -> int:
        """What the solution of one step takes, factors included [B]."""
        return self.kept_solutions.nbytes

    def pull(
        self,
        solution: Sequence[torch.Tensor] | None = None,
        *,
        parameters: bool = True,
        forces: bool = True,
        velocities: bool = True,
        end: Mapping[str, torch.Tensor] | None = None,
    ) -> None:
        """Gradients by the end of the step from the present state become those by the present state, in place.

        Args:
            solution: That of this step, if it was kept; without, it is found again.
            parameters: Whether gradients by parameters are asked for, which else stay as they are.
            forces: Whether those by node forces and tractions are, which else need not be found.
            velocities: Whether there may be some by velocities of nodes at the end of the step.
            end: The state there, if it is at hand, which else floating frames find again.
        """
        is_known = end is not None and bool(self._ends)
        if end is not None:
            for name, view in self._ends.items():
                if velocities or name != "node_v":
                    view.copy_(end[name])
        follows = self.model.reduction is not None
        key = parameters, forces, velocities or not follows, is_known
        if solution is None:
            self._pull[key]()
            return
        self._prepare[key]()
        if not self.kept_solutions.pull(key, self._of_kept[key], solution):
            self._pull_kept[key]()


def _adjoint(
    steps: ImplicitEuler | SecondOrder, gradients: Gradients, index: AdjointIndex, *, rest: bool
) -> StepAdjoint | SecondOrderAdjoint:
    """What pulls gradients through the steps that ``steps`` takes."""
    if isinstance(steps, SecondOrder):
        of_stages = SecondOrderAdjoint if steps.stages is BDF2 else TrapezoidalAdjoint
        return of_stages(steps, gradients, index, rest=rest)
    if steps.control is not None:
        return NewtonAdjoint(steps, gradients, index, rest=rest)
    if steps.system.model.joints is not None:
        return JointStepAdjoint(steps.system, steps.h, gradients, index, rest=rest)
    kind = LookStepAdjoint if steps.system.multipliers.corrections else StepAdjoint
    return kind(steps.system, steps.h, gradients, index, rest=rest)


def _launches(
    pull: StepAdjoint | SecondOrderAdjoint, name: str, forces: bool, velocities: bool, is_end_known: bool
) -> Callable[[], None]:
    """A method of an adjoint, with gradients by node forces and from velocities of nodes or without."""
    method = getattr(pull, name)

    def launch() -> None:
        if isinstance(pull, StepAdjoint):
            pull.by_forces = forces
            if pull.modes is not None:
                pull.modes.by_velocities = velocities
                if pull.modes.frames is not None:
                    pull.modes.frames.is_end_known = is_end_known
        method()

    return launch


def _flags(array: wp.array) -> torch.Tensor:
    """A flag of every world, as the adjoints have them."""
    flags: torch.Tensor = wp.to_torch(array, requires_grad=False).flatten()
    return flags


def held_flags(systems: Sequence[System]) -> Flags:
    """Where the systems of all worlds, in their order, tell of steps that were held back."""
    found: Flags = []
    begin = 0
    for system in systems:
        end = begin + system.world_count
        if system.inversion is not None and system.inversion.held is not None:
            found.append(((begin, end), _flags(system.inversion.held)))
        begin = end
    return found


def told_worlds(flags: Flags, like: torch.Tensor) -> torch.Tensor:
    """Worlds that some flags tell of, bool, in the shape of ``like``, (world,)."""
    found = like.new_zeros(like.shape)
    for (begin, end), told in flags:
        found[begin:end].logical_or_(told[: end - begin] != 0)
    return found
