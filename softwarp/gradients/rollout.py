"""Steps of a simulation as a function of torch tensors. How to use it: docs/gradients.md."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch

from softwarp import checks
from softwarp.advice import nearest
from softwarp.gradients.calls import Call, Plan, check_adrift, check_steps, check_unsure, push
from softwarp.gradients.refusals import require_differentiable
from softwarp.gradients.rest import RestShape
from softwarp.gradients.worlds import DifferentiableWorlds
from softwarp.model.gradients import COMMANDS, FRAMES, MODES, PARAMETERS, STATE
from softwarp.model.model import Model
from softwarp.simulation import Simulation

Tensors = Mapping[str, torch.Tensor]
GROUPS = {"state": "state", "controls": "control", "parameters": "params"}  # arguments, and how a call names them
STARTS = (
    *("node_x", "node_v", "cavity_pressure", "body_pose", "body_twist"),
    *("rod_x", "rod_q", "rod_v", "rod_w", "mode_q", "mode_v", "mode_turn"),
)


@dataclass(frozen=True)
class States:
    """States after steps ``every``, 2 ``every`` ... of a rollout; all but ``step`` carry gradients.

    Attributes:
        step: Number of the step that led to each, (state,).
        node_x: Positions of nodes [m], (state, world, node, 3).
        node_v: Velocities [m/s], likewise.
        cable_tension: Tensions that the steps found [N], (state, world, cable).
        cavity_pressure: Gauge pressures that they found [Pa], (state, world, chamber).
        marker_x: Positions of markers [m], (state, world, marker, 3).
        rod_x: Positions of the nodes of rods [m], (state, world, rod node, 3).
        rod_q: Their orientations, unit quaternions (x, y, z, w), (state, world, rod node, 4).
        rod_v: Their velocities [m/s], (state, world, rod node, 3).
        rod_w: Their angular velocities [rad/s], likewise.
        body_pose: Positions [m] and quaternions of rigid bodies, (state, world, body, 7), where some move or carry.
        body_twist: Their velocities [m/s] and angular velocities [rad/s], (state, world, body, 6).
        mode_q: Amplitudes [m] of the modes of reduced bodies, (state, world, mode).
        mode_v: Their velocities [m/s], likewise.
        mode_turn: Quaternions of floating frames, (state, world, frame, 4).
    """

    step: torch.Tensor
    node_x: torch.Tensor
    node_v: torch.Tensor
    cable_tension: torch.Tensor
    cavity_pressure: torch.Tensor
    marker_x: torch.Tensor
    rod_x: torch.Tensor
    rod_q: torch.Tensor
    rod_v: torch.Tensor
    rod_w: torch.Tensor
    body_pose: torch.Tensor
    body_twist: torch.Tensor
    mode_q: torch.Tensor
    mode_v: torch.Tensor
    mode_turn: torch.Tensor


class Rollout:
    """A function from start states, commands and parameters to the states that steps lead to.

    The simulation says what the scene is, and what holds where nothing else is given; it is not stepped. The results
    are those of its own steps to the bit. One call, and the backward pass through it, is a loop over all worlds at
    once; worlds do not influence each other, so the gradient of a sum of losses of worlds is that of each.

    Args:
        sim: Soft bodies of tetrahedra, reduced or not, and hexahedra, with cables and chambers, rods, rigid
            bodies, and joints; steps of all integrators, with one linearisation per step or as many as solve it. Its
            ``dt`` and options are taken over now.
        rest: Make ``rest_x`` one of the parameters: gradients by the rest shape, for design.

    Raises:
        ValueError: If a part of the scene or an option has no gradient; the message names it and the way out.
        MemoryError: If as many worlds again do not fit on the device.
    """

    def __init__(self, sim: Simulation, *, rest: bool = False) -> None:
        if not isinstance(sim, Simulation):
            raise TypeError(f"gradients.Rollout: sim must be a Simulation, got {checks.shown(sim)}")
        rest = checks.flag(rest, "gradients.Rollout: rest")
        require_differentiable(sim)
        if rest and (sim.model.reduction is not None or sim.model.hexes is not None):
            beside = "hexahedra" if sim.model.reduction is None else "reduced bodies"
            raise ValueError(f"gradients.Rollout: rest shapes have no gradient beside {beside}; leave rest=True out")
        self.worlds = DifferentiableWorlds(sim, rest=rest)
        self._rest = RestShape(sim.model, self.worlds.state["node_x"]) if rest else None
        self._markers = Markers(sim.model, self.worlds.state["node_x"])

    @property
    def solution_bytes(self) -> int:
        """Memory [B] that the kept solution of one step takes, of all worlds together."""
        return self.worlds.solution_bytes

    def __call__(
        self,
        state: Tensors | None = None,
        controls: Tensors | None = None,
        parameters: Tensors | None = None,
        *,
        steps: int | None = None,
        every: int = 1,
        factors: bool = False,
    ) -> States:
        """Take steps from a state.

        The backward pass solves every step once more. With ``every`` above 1 it also takes the steps between kept
        states again, so that memory holds ``steps / every + every`` states instead of ``steps``. With ``factors`` it
        keeps the factor of every step, or of the ``every`` steps between kept states while it is at them, instead of
        solving again: ``solution_bytes`` of memory for each, and a backward pass that costs less than half.

        Args:
            state: ``node_x`` [m] and ``node_v`` [m/s], each (world, node, 3), and ``cavity_pressure`` [Pa] (world,
                chamber), which matters where a rate or a flow bounds a command and in the tangent of pressures;
                ``rod_x`` [m], ``rod_q``, ``rod_v`` [m/s] and ``rod_w`` [rad/s] of the nodes of rods;
                ``mode_q`` [m] and ``mode_v`` [m/s], each (world, mode), of reduced bodies, whose nodes follow;
                ``mode_turn``, quaternions of floating frames, (world, frame, 4);
                ``body_pose`` and ``body_twist`` of rigid bodies. Those of the simulation where left out.
            controls: ``node_force`` [N], ``rod_force`` and ``body_force`` [N] with moments [N m], ``body_velocity``
                [m/s] with spins [rad/s] of kinematic bodies that carry something, ``joint_target`` [m, rad],
                ``joint_force`` [N, N m], ``traction`` [Pa],
                ``cable_displacement`` [m], ``cable_tension`` [N], ``cavity_pressure`` [Pa], ``cavity_volume`` and
                ``cavity_gas`` [m^3], shaped as in ``sim.control``, or with a leading axis of steps.
            parameters: ``youngs``, ``nu``, ``density``, ``rayleigh_mass``, ``rayleigh_stiffness``, ``gravity`` and
                ``law_parameter``, ``relaxation_ratio`` and ``relaxation_time`` of Maxwell branches,
                ``membrane_youngs`` and ``membrane_nu``,
                ``cable_stiffness`` and ``cable_damping`` of cables that stretch,
                ``pair_mu`` of contact,
                ``rod_youngs``, ``rod_nu``, ``rod_density``, ``rod_rayleigh_mass`` and
                ``rod_rayleigh_stiffness``, ``body_mass`` and ``body_damping``, ``joint_stiffness`` and
                ``joint_damping`` of servos, shaped as in ``sim.params`` or so that
                they broadcast to that. With ``rest`` also ``rest_x`` [m], the rest positions of the model, (node, 3).
            steps: Number of steps; may be left out where a command has an axis of steps.
            every: Steps between the states that are returned and kept; divides ``steps``.
            factors: Keep factors.

        Returns:
            States after every ``every``-th step.

        Raises:
            ValueError: For names that have no gradient, shapes that do not fit, and numbers of steps that do not agree.
            Diverged: If a step failed; the message names the worlds.
        """
        plan, given = self.plan(state, controls, parameters, steps=steps, every=every, factors=factors)
        return self.states(plan, _Steps.apply(self.worlds, plan, *given.values()))

    def plan(
        self,
        state: Tensors | None,
        controls: Tensors | None,
        parameters: Tensors | None,
        *,
        steps: int | None,
        every: int,
        factors: bool = False,
    ) -> tuple[Plan, dict[str, torch.Tensor]]:
        """What a call with these arguments does, and its tensors as they fit into the worlds."""
        given: dict[str, torch.Tensor] = {}
        moving: list[str] = []
        for group, held in (("state", state), ("parameters", parameters), ("controls", controls)):
            for name, value in tensors_of(group, held).items():
                given[f"{GROUPS[group]}.{name}"] = self.fit(group, name, value, moving)
        count = _steps(steps, {name: given[f"control.{name}"] for name in moving})
        every = checks.count(every, "rollout: every")
        if count % every:
            raise ValueError(f"rollout: every must divide steps, got every={every} and steps={count}")
        factors = checks.flag(factors, "rollout: factors")
        if factors and not self.worlds.solution_bytes:
            told = (
                "newton_iterations above 1"
                if self.worlds.sim.options.integrator == "euler"
                else f"integrator {self.worlds.sim.options.integrator!r}"
            )
            raise ValueError(f"rollout: {told} keeps no factors; leave factors=True out")
        return Plan(tuple(given), frozenset(moving), count, every, factors, self._rest), given

    def fit(self, group: str, name: str, value: Any, moving: list[str]) -> torch.Tensor:
        """An argument as it fits into the worlds; ``moving`` is extended by the name of a command with steps."""
        views = self.worlds
        if name in ("body_pose", "body_twist") and self.worlds.model.has_kinematic:
            told = "where kinematic bodies are is said by commands, which have no gradient yet"
            raise ValueError(f"state {name!r} has no gradient: {told}; leave it out")
        if name == "body_velocity" and not self.worlds.model.has_moving_frames:
            told = "it has one only where something is carried, or moves freely beside them"
            raise ValueError(f"controls 'body_velocity' has no gradient: {told}; leave it out")
        if name in ("node_x", "node_v") and self.worlds.model.reduction is not None:
            if self.worlds.model.own_node_count == 0:
                told = "all nodes follow from the modes of reduced bodies"
                raise ValueError(f"state {name!r} has no gradient: {told}; give mode_{name[-1].replace('x', 'q')!s}")
        if group == "state":
            return fitted(group, name, value, STARTS, views.state)
        if group == "parameters":
            return fitted(group, name, value, *parameters_of(views.parameters, self._rest))
        return fitted(group, name, value, COMMANDS, views.control, moving)

    def slopes(self, plan: Plan, kept: Sequence[torch.Tensor], along: Sequence[torch.Tensor]) -> States:
        """Slopes of states from the tensors that a call has kept and those of theirs, (direction, ...)."""
        found = self.states(plan, along)
        if not self.worlds.model.has_moving_frames:
            return found
        pose = along[len(STATE)]  # behind positions and so on
        marked = self._markers.slopes(along[0], pose, kept[len(STATE)].expand_as(pose))
        return replace(found, marker_x=marked)

    def states(self, plan: Plan, kept: Sequence[torch.Tensor]) -> States:
        """States from the tensors of ``STATE`` that a call has kept."""
        step = torch.arange(plan.every, plan.steps + 1, plan.every)
        x, v, tension, pressure = kept[: len(STATE)]
        model, frames = self.worlds.model, dict(zip(FRAMES, kept[len(STATE) :], strict=False))
        if not model.has_moving_frames:
            frames = {name: x.new_empty((*x.shape[:-2], 0, width)) for name, width in zip(FRAMES, (7, 6), strict=True)}
        rods = slice(model.rigid_count, model.rigid_count + model.rod_node_count)
        pose, twist = (frames[name][..., rods, :] for name in FRAMES)
        bodies = dict(zip(("body_pose", "body_twist"), frames.values(), strict=True))
        parts = {name: value[..., : model.rigid_count, :] for name, value in bodies.items()}
        modes = dict(zip(self.worlds.names, kept, strict=True))
        parts |= {name: modes.get(name, x.new_empty((*x.shape[:-2], 0))) for name in MODES}
        parts["mode_turn"] = modes.get("mode_turn", x.new_empty((*x.shape[:-2], 0, 4)))
        parts |= {"rod_x": pose[..., :3], "rod_q": pose[..., 3:], "rod_v": twist[..., :3], "rod_w": twist[..., 3:]}
        marked = self._markers(x, frames["frame_pose"] if model.has_moving_frames else None)
        return States(step, x, v, tension, pressure, marked, **parts)


class _Steps(torch.autograd.Function):
    """All steps of one call as one operation."""

    @staticmethod
    def forward(ctx: Any, worlds: DifferentiableWorlds, plan: Plan, *tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Kept states, one tensor for each of ``STATE``."""
        call = Call(worlds, plan, dict(zip(plan.names, tensors, strict=True)))
        call.begin()
        start = worlds.kept()
        count = plan.steps // plan.every
        names = (*worlds.names, *worlds.memory)
        kept = [start[name].new_empty((count, *start[name].shape)) for name in names]
        room = worlds.kept_solutions.room(plan.steps) if plan.factors and plan.every == 1 else None
        for step in range(plan.steps):
            call.command(step)
            worlds.step()
            if room is not None:
                worlds.kept_solutions.keep(room[step])
            if (step + 1) % plan.every == 0:
                for name, values in zip(names, kept, strict=True):
                    values[step // plan.every].copy_(worlds.state[name])
        check_steps(call)
        ctx.worlds, ctx.plan, ctx.room = worlds, plan, room
        ctx.set_materialize_grads(False)
        fixed = [*worlds.control.values(), *worlds.parameters.values()]
        held = (values.detach() for values in kept)  # views of results that torch follows take their time
        ctx.save_for_backward(*tensors, *held, *start.values(), *(value.clone() for value in fixed))
        ctx.save_for_forward(*tensors)
        return tuple(kept[: len(worlds.names)])

    @staticmethod
    def jvp(ctx: Any, _worlds: None, _plan: None, *slopes: torch.Tensor | None) -> tuple[torch.Tensor, ...]:
        """Slopes of the kept states along those of all tensors, by taking the steps once more."""
        plan = ctx.plan
        direction = {name: slope for name, slope in zip(plan.names, slopes, strict=True) if slope is not None}
        call = Call(ctx.worlds, plan, dict(zip(plan.names, ctx.saved_tensors, strict=True)))
        _, pushed = push(call, [direction])
        return tuple(slope[0] for slope in pushed)

    @staticmethod
    def backward(ctx: Any, *by_kept: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
        """Gradients by all tensors."""
        worlds, plan, saved = ctx.worlds, ctx.plan, list(ctx.saved_tensors)
        tensors = {name: saved.pop(0) for name in plan.names}
        names = (*worlds.names, *worlds.memory)
        kept = {name: saved.pop(0).unbind(0) for name in names}
        start = {name: saved.pop(0) for name in names}
        for view in (*worlds.control.values(), *worlds.parameters.values()):
            view.copy_(saved.pop(0))
        call = Call(worlds, plan, tensors)
        gradients = worlds.gradients
        for view in gradients.values():
            view.zero_()
        by_commands = {name: torch.zeros_like(tensors[f"control.{name}"]) for name in call.commands}
        by_steps = {
            name: by.unbind(0) if name in plan.moving else (by,) * plan.steps for name, by in by_commands.items()
        }
        asked = ctx.needs_input_grad[2:]
        wanted = [name for name, is_asked in zip(plan.names, asked, strict=True) if is_asked]
        parameters = any(name.startswith("params.") for name in wanted)
        forces = any(name in ("control.node_force", "control.traction") for name in wanted)
        given = {name: by.unbind(0) for name, by in zip(worlds.names, by_kept, strict=True) if by is not None}
        velocities = "node_v" in given
        room, ctx.room = ctx.room, None  # a second backward pass finds solutions again
        if plan.factors and plan.every > 1:
            room = worlds.kept_solutions.room(plan.every)
        for segment in reversed(range(plan.steps // plan.every)):
            first = start if segment == 0 else {name: kept[name][segment - 1] for name in names}
            states = call.between(first, segment * plan.every, room if plan.every > 1 else None)
            last = {name: values[segment] for name, values in kept.items()}
            for name, by in given.items():
                gradients[name].add_(by[segment])
            for offset in reversed(range(plan.every)):
                step = segment * plan.every + offset
                worlds.place(states[offset])
                call.command(step)
                solution = None if room is None else room[step if plan.every == 1 else offset]
                end = states[offset + 1] if offset + 1 < plan.every else last
                worlds.pull(solution, parameters=parameters, forces=forces, velocities=velocities, end=end)
                for name, by_step in by_steps.items():
                    by_step[step].add_(gradients[f"command_{name}"])
        if room is not None:
            worlds.kept_solutions.give_back(room)
        check_adrift(worlds)
        check_unsure(worlds)
        found = {f"control.{name}": by for name, by in by_commands.items()}
        found |= {name: gradients[name.removeprefix("state.")].clone() for name in wanted if name.startswith("state.")}
        found |= {f"params.{name}": gradients[name].clone() for name in PARAMETERS}
        if plan.rest is not None:
            found["params.rest_x"] = plan.rest.gradient(gradients["rest_x"], gradients["cable_rest_length"])
        return (None, None, *(found[name] if name in wanted else None for name in plan.names))


def fitted(
    group: str,
    name: str,
    value: Any,
    names: tuple[str, ...],
    views: Tensors,
    moving: list[str] | None = None,
) -> torch.Tensor:
    """A given tensor in the shape, precision and place of its view, with the axis of steps that it may have."""
    if name not in names:
        raise ValueError(f"{group} {name!r} has no gradient; {nearest(name, names)}")
    view, value = views[name], torch.as_tensor(value)
    shape = tuple(view.shape)
    if moving is not None and value.ndim == view.ndim + 1:
        moving.append(name)
        shape = (value.shape[0], *shape)
    try:
        placed: torch.Tensor = value.to(view).expand(shape)
    except RuntimeError:
        also = f" or (step, {', '.join(map(str, view.shape))})" if moving is not None else ""
        need = f"have the shape {tuple(view.shape)}{also}, or broadcast to it"
        raise ValueError(checks.refusal(f"{group} {name!r}", need, value)) from None
    return placed


def tensors_of(group: str, given: Any) -> Tensors:
    """An argument of a call: tensors by their names; none for None.

    Raises:
        TypeError: For anything but a dictionary.
    """
    if given is not None and not isinstance(given, Mapping):
        raise TypeError(checks.refusal(group, "be a dictionary of tensors by their names", given))
    return given or {}


def _steps(steps: int | None, moving: Tensors) -> int:
    """Number of steps that all agree on."""
    told = {name: len(value) for name, value in moving.items()}
    if steps is not None:
        told["steps"] = checks.count(steps, "rollout: steps")
    if not told:
        raise ValueError("rollout: say steps=..., or give a command an axis of steps")
    if len(set(told.values())) > 1:
        listed = ", ".join(f"{name} has {count}" for name, count in told.items())
        raise ValueError(f"rollout: numbers of steps must agree; {listed}")
    return checks.count(next(iter(told.values())), "rollout: steps")


def parameters_of(views: Tensors, rest: RestShape | None) -> tuple[tuple[str, ...], Tensors]:
    """Names of parameters and what each must look like, the rest shape among them if it is one."""
    if rest is None:
        return PARAMETERS, views
    worlds = next(iter(views.values())).shape[0]
    return (*PARAMETERS, "rest_x"), {**views, "rest_x": rest.x.expand(worlds, *rest.x.shape)}


class Markers:
    """Positions of markers from those of nodes and, where frames carry some, from the poses of frames.

    Args:
        model: Scene.
        like: Precision and device.
    """

    def __init__(self, model: Model, like: torch.Tensor) -> None:
        node = torch.as_tensor(model.marker_node.numpy().reshape(-1, 4), device=like.device).long()
        weight = torch.as_tensor(model.marker_weight.numpy().reshape(-1, 4)).to(like)
        self._weight = torch.where(node.cpu() < 0, 0.0, weight.cpu()).to(like)
        self._node = node.clamp(min=0)
        self._frame = torch.as_tensor(model.marker_frame.numpy(), device=like.device).long().reshape(-1, 1)
        self._local = torch.as_tensor(model.marker_local.numpy().reshape(-1, 3)).to(like)

    def __call__(self, x: torch.Tensor, pose: torch.Tensor | None = None) -> torch.Tensor:
        """Positions [m]: (..., marker, 3) from (..., node, 3) and (..., frame, 7)."""
        found = self._of_nodes(x)
        if pose is None or not len(self._node):
            return found
        carried = self._turned(self._held(pose)[..., :3] + self._local, pose, pose)
        return torch.where(self._frame >= 0, carried, found)

    def slopes(self, x: torch.Tensor, pose: torch.Tensor | None, at: torch.Tensor | None) -> torch.Tensor:
        """Slopes of positions from those of nodes and of the poses that are ``at`` some."""
        found = self._of_nodes(x)
        if pose is None or at is None or not len(self._node):
            return found
        half = self._turned(self._held(pose)[..., :3], pose, at)  # the turn is a quadratic form of a quaternion
        return torch.where(self._frame >= 0, self._turned(half, at, pose), found)

    def _of_nodes(self, x: torch.Tensor) -> torch.Tensor:
        if x.shape[-2]:
            return (x[..., self._node, :] * self._weight[..., None]).sum(dim=-2)
        return x.new_zeros((*x.shape[:-2], len(self._node), 3))

    def _held(self, pose: torch.Tensor) -> torch.Tensor:
        held: torch.Tensor = pose[..., self._frame.clamp(min=0)[:, 0], :]
        return held

    def _turned(self, onto: torch.Tensor, one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
        """Add what quaternions add to arms, as a bilinear form of them."""
        first, second = self._held(one), self._held(other)
        twice = 2.0 * torch.linalg.cross(second[..., 3:6], self._local.expand_as(second[..., 3:6]))
        turned: torch.Tensor = onto + first[..., 6:] * twice + torch.linalg.cross(first[..., 3:6], twice)
        return turned
