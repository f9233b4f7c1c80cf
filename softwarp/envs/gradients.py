"""Steps of an environment as a function that torch differentiates: actions to observations and rewards.

    steps = EnvSteps(env)                             # Trunk, Diamond, BubbleMotion
    now = steps.begin()                               # cuts the graph: the present is a constant
    for _ in range(16):
        led_to = steps.step(policy(now))              # led_to.reward, led_to.observation carry gradients
        loss = loss - led_to.reward.mean()
        now = led_to.now
    loss.backward()

The environment takes its own steps, captured on CUDA as always; what these started from is kept. The backward pass goes
through the sub-steps from the last to the first with the adjoint of docs/theory/adjoint.md. What an action commands,
what is observed and rewarded are the task's own formulas (``DifferentiableTask``), differentiated by torch. A world
whose episode ends starts from constants: no gradient passes a reset. Worlds that failed have gradient 0; so have those
in which contacts that repeat each other slipped, whose forces are not unique, and those in which a step was held back
because elements were inside out or nearly flat; a warning tells of the first ones.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import torch
import warp as wp
from tensordict import TensorDict
from torch import Tensor

from softwarp.envs.sums import length_of
from softwarp.gradients.refusals import missing
from softwarp.gradients.rollout import Markers
from softwarp.gradients.worlds import DifferentiableWorlds, held_flags, told_worlds
from softwarp.model.codes import Status
from softwarp.model.memory import free_bytes
from softwarp.simulation import Simulation
from softwarp.solvers.look_adjoint import FirstSolution
from softwarp.solvers.solution import solution_of

if TYPE_CHECKING:
    from softwarp.envs.base import SoftEnv

_FAILED = int(Status.NONFINITE)
_REPEATS = (
    "contacts that repeat each other slipped, as along an edge that lies flat on a face; how they share their load is "
    "not unique, and friction depends on it"
)
_HELD = "a step was held back, because elements are inside out or nearly flat; gradients know nothing of that"
_NOW = "now "  # begins the keys of what the next action starts from
ROOM = 0.25  # of a device's memory that kept factors may take


class Seen(Protocol):
    """What tasks read of the simulator after a step: a ``Simulation``, or ``Points`` that carry gradients."""

    @property
    def marker_x(self) -> Tensor:
        """Positions of markers [m], (world, marker, 3)."""

    @property
    def marker_v(self) -> Tensor:
        """Their velocities [m/s]."""

    @property
    def cable_x(self) -> Tensor:
        """Points of all cables [m], (world, point, 3)."""

    @property
    def cable_displacement(self) -> Tensor:
        """Rest length minus length [m], (world, cable)."""

    @property
    def cable_tension(self) -> Tensor:
        """Tensions [N], (world, cable)."""

    @property
    def body_pose(self) -> Tensor:
        """Positions [m] and quaternions of rigid bodies, (world, body, 7)."""

    @property
    def body_twist(self) -> Tensor:
        """Their velocities [m/s] and angular velocities [rad/s], (world, body, 6)."""


@runtime_checkable
class DifferentiableTask(Protocol):
    """An environment whose task is made of pure functions; ``held`` are tensors by name, as ``world_state`` has."""

    def gradient_refusal(self) -> str | None:
        """What of the options has no gradient, and the way out; None if all have."""

    def commands_from(
        self, seen: Seen, held: Mapping[str, Tensor], action: Tensor
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Commands of the sub-steps by their name in ``sim.control``, (substep, world, ...), and what is held then."""

    def distance_from(self, seen: Seen, held: Mapping[str, Tensor]) -> Tensor:
        """Distance to the goal [m], (world,)."""

    def observation_from(self, seen: Seen, held: Mapping[str, Tensor]) -> Tensor:
        """What is observed, (world, k)."""

    def reward_from(self, action: Tensor, previous: Tensor, distance: Tensor) -> dict[str, Tensor]:
        """Terms of the reward, (world,), by the distances [m] before and after."""


class Points:
    """Markers, cables and rigid bodies as functions of the state, with gradients.

    Args:
        maps: Of the scene.
        state: Tensors by the names that ``DifferentiableWorlds`` has for them.
    """

    def __init__(self, maps: _Maps, state: Mapping[str, Tensor]) -> None:
        self._maps, self._state = maps, state
        self._x, self.cable_tension = state["node_x"], state["cable_tension"]

    @property
    def body_pose(self) -> Tensor:
        """Positions [m] and quaternions of rigid bodies, (world, body, 7)."""
        return self._state["frame_pose"][:, : self._maps.rigid_count]

    @property
    def body_twist(self) -> Tensor:
        """Their velocities [m/s] and angular velocities [rad/s], (world, body, 6)."""
        return self._state["frame_twist"][:, : self._maps.rigid_count]

    @cached_property
    def marker_x(self) -> Tensor:
        """Positions of markers [m], (world, marker, 3)."""
        return self._maps.markers(self._x)

    @cached_property
    def marker_v(self) -> Tensor:
        """Velocities of markers [m/s], (world, marker, 3)."""
        return self._maps.markers(self._state["node_v"])

    @cached_property
    def cable_x(self) -> Tensor:
        """Points of all cables [m], (world, point, 3)."""
        return self._maps.points(self._x)

    @cached_property
    def cable_displacement(self) -> Tensor:
        """Rest length minus length [m], (world, cable)."""
        return self._maps.displacement(self.cable_x)


class _Maps:
    """From nodes to markers, points and displacements of cables (kernels/rows/cable.py)."""

    def __init__(self, env: SoftEnv) -> None:
        model, like = env.sim.model, env.sim.node_x
        self.markers, self.rigid_count = Markers(model, like), model.rigid_count

        def send(array: Any) -> Tensor:
            values = array.numpy() if isinstance(array, wp.array) else array
            return torch.as_tensor(values, device=like.device)

        node = send(model.point_node)
        self._node = node.clamp(min=0).long()
        self._weight = torch.where(node < 0, 0.0, send(model.point_weight).to(like))
        self._anchor = send(model.point_anchor).to(like)
        starts = send(model.cable_starts).long().tolist()
        closing, self._rest = (send(part).to(like) for part in (model.cable_closing_length, model.cable_rest_length))
        ends = [(cable, p) for cable in range(model.cable_count) for p in range(starts[cable] + 1, starts[cable + 1])]
        self._end = torch.tensor([p for _, p in ends], dtype=torch.int64, device=like.device)
        owner = torch.tensor([cable for cable, _ in ends], dtype=torch.int64, device=like.device)
        self._owner = torch.nn.functional.one_hot(owner, max(model.cable_count, 1)).to(like)  # (segment, cable)
        self._closing = closing[owner]

    def points(self, x: Tensor) -> Tensor:
        """Points of cables [m], (world, point, 3)."""
        return (x[:, self._node] * self._weight[..., None]).sum(dim=-2) + self._anchor

    def displacement(self, points: Tensor) -> Tensor:
        """Rest length minus length [m], (world, cable)."""
        segment = length_of(points[:, self._end] - points[:, self._end - 1])
        least = torch.maximum(segment, self._closing)
        short = torch.where(least > 0.0, (least - segment).square() / least.clamp_min(1e-30), 0.0)
        displacement: Tensor = self._rest - (segment + 0.5 * short) @ self._owner
        return displacement


@dataclass(frozen=True)
class Step:
    """What an action led to.

    Attributes:
        observation: Where it led, before any reset, (world, k); carries gradients.
        reward: Shape (world,); carries gradients.
        now: What the next action starts from: ``observation``, or the first of a new episode, (world, k).
        after: All that the environment tells, without gradients, as ``step`` has it under ``next``.
    """

    observation: Tensor
    reward: Tensor
    now: Tensor
    after: TensorDict


class EnvSteps:
    """Steps of an environment with gradients by actions, and by whatever actions depend on.

    Args:
        env: Made of a ``DifferentiableTask`` and a scene whose steps have an adjoint.
        window: Actions between two calls of ``begin``, by which kept factors are measured.
        factors: Keep the factor of every sub-step for the backward pass instead of finding it again; None: where
            those of a window fit into a quarter of the device's memory.

    Attributes:
        unsure: Worlds in which a gradient of the last backward pass is 0 because it was not unique, or because a
            sub-step was held back where elements are inside out or nearly flat, bool, (world,).

    Raises:
        ValueError: If a task, a scene or an option has no gradient; the message names it and the way out.
        MemoryError: If as many worlds again do not fit on the device.
    """

    def __init__(self, env: Any, window: int = 32, factors: bool | None = None) -> None:
        require_gradient(env)
        self.env = env
        self.worlds = DifferentiableWorlds(env.sim)
        self.maps = _Maps(env)
        self.unsure = torch.zeros_like(self.worlds.failed)
        self._warned: set[str] = set()
        needed = self.worlds.solution_bytes * env.action_repeat * window
        self.factors = needed <= ROOM * free_bytes(env.device) if factors is None else factors
        self.real = env.sim.node_x.dtype
        self._solution: list[Tensor] = []
        if self.factors:
            parts = _solutions(env.sim)
            self._solution = [wp.to_torch(part, requires_grad=False) for part in parts]
        self._held = held_flags(env.sim.systems)
        self._spare: list[list[Tensor]] = []  # room for factors on a CPU: touching new memory takes long
        self._room: list[Tensor] | None = None  # for those of the present action
        views, worlds = env.sim.state_tensors(), self.worlds
        self._state = {name: views[name] for name in worlds.names}
        self._started = {name: views[name] for name in (*worlds.names, *worlds.memory)}
        self._parameters = {name: view for name, view in env.sim.params.tensors().items() if view.numel()}
        self.begin()

    @torch.no_grad()
    def begin(self) -> Tensor:
        """Let the present be a constant; what is observed now, (world, k)."""
        env = self.env
        self.worlds.start()
        self.unsure = torch.zeros_like(self.unsure)
        self.now = {name: view.clone() for name, view in self._state.items()}
        self.seen = Points(self.maps, self.now)
        self.held = self._present_held()
        observation: Tensor = env.world_state["last_observation"].to(self.real)
        return observation

    def _present_held(self) -> dict[str, Tensor]:
        state = self.env.world_state
        return {
            name: value.to(self.real) if value.is_floating_point() else value.clone() for name, value in state.items()
        }

    def step(self, action: Tensor, cut: Tensor | None = None) -> Step:
        """One action in all worlds, then a new episode where one has ended.

        Args:
            action: (world, k), of the environment's action space; may carry gradients.
            cut: As of ``SoftEnv.step_and_reset``.
        """
        env, held = self.env, self.held
        env._guard.check_form(action.detach().to(torch.float32))
        commands, changed = env.commands_from(self.seen, held, action.to(self.real))
        told: dict[str, Any] = {"action": action.detach(), "cut": cut, "changed": changed}
        ends = _Substeps.apply(self, told, tuple(commands), *self.now.values(), *commands.values())
        led_to = dict(zip(self.now, ends, strict=True))
        seen, held = Points(self.maps, led_to), held | changed
        distance = env.distance_from(seen, held)
        reward = sum(env.reward_from(action.to(self.real), held["distance"], distance).values())
        observation = env.observation_from(seen, held)
        after, now = told["after"], told["now"]
        low, high = env._bounds["observation"]
        good = (after["world_status"] < _FAILED).squeeze(-1)
        observation = torch.where(good[:, None], observation.clamp(low, high), after["observation"].to(self.real))
        reward = torch.where(good, reward, after["reward"].squeeze(-1).to(self.real))
        carried = changed | {"distance": torch.where(good, distance, held["distance"])}
        self._go_on(led_to, carried, after["done"])
        first = torch.where(after["done"], now["observation"].to(self.real), observation)
        return Step(observation, reward, first, after)

    def _go_on(self, led_to: dict[str, Tensor], carried: dict[str, Tensor], done: Tensor) -> None:
        """Carry on from where the action led, or from constants where an episode has begun."""
        over = done.squeeze(-1)
        self.now = {
            name: torch.where(_along(over, value), self._state[name].detach().clone(), value)
            for name, value in led_to.items()
        }
        self.seen = Points(self.maps, self.now)
        present = self._present_held()
        ended = done.squeeze(-1)
        self.held = present | {
            name: torch.where(_along(ended, value), present[name], value) for name, value in carried.items()
        }

    @torch.no_grad()
    def take(self, told: dict[str, Any], names: tuple[str, ...], commands: tuple[Tensor, ...]) -> dict[str, Tensor]:
        """Have the environment take one action's sub-steps under given commands; what the adjoint needs of them."""
        env = self.env
        cut = env._no_cut if told["cut"] is None else told["cut"]
        self._names, self._changed = names, tuple(told["changed"])
        action = told["action"].to(torch.float32)
        arguments = (action, cut, *commands, *told["changed"].values())
        found: dict[str, Tensor]
        if env.captures.are_on:
            found = env._run_captured(self._captured_gradient_step, *arguments)
        else:
            env._guard.admit(action)
            if self._solution:
                self._room = self._spare.pop() if self._spare else self._make_room()
            found = {key: value.clone() for key, value in self._gradient_step(*arguments).items()}
            found |= {f"solution {place}": part for place, part in enumerate(self._room or ())}
            self._room = None
        now = {key: found.pop(key) for key in tuple(found) if key.startswith(_NOW)}
        after = {key: found.pop(key) for key in tuple(found) if key.startswith("after ")}
        told["after"] = env._batch({key.removeprefix("after "): value for key, value in after.items()})
        told["now"] = env._batch({key.removeprefix(_NOW): value for key, value in now.items()})
        return found

    def _captured_gradient_step(self, action: Tensor, *arguments: Tensor) -> dict[str, Tensor]:
        return self._gradient_step(self.env._guard.screen(action), *arguments)

    def _gradient_step(self, action: Tensor, cut: Tensor, *given: Tensor) -> dict[str, Tensor]:
        env, sim = self.env, self.env.sim
        commands = dict(zip(self._names, given, strict=False))
        for name, value in zip(self._changed, given[len(commands) :], strict=True):
            env.world_state[name].copy_(value)
        kept: dict[str, list[Tensor]] = {name: [] for name in self._started}
        room = self._room if self._room is not None else self._make_room()
        status = []
        parameters = {f"parameter {name}": view.clone() for name, view in self._parameters.items()}
        for _, flags in self._held:
            flags.zero_()
        for substep in range(env.action_repeat):
            for name, view in self._started.items():
                kept[name].append(view.clone())
            for name, values in commands.items():
                sim.control.tensors()[name].copy_(values[substep])
            sim.step()
            status.append(sim.status.clone())
            for held, part in zip(room, self._solution, strict=True):
                held[substep].copy_(part)
        env._status.copy_(torch.stack(status).amax(dim=0))
        held = told_worlds(self._held, self.worlds.failed)
        led_to = {f"end {name}": view.clone() for name, view in self._state.items()}
        after = env._cut_episodes(env._account(action), cut)
        ended = after["done"].squeeze(-1)
        if env.captures.are_on or bool(ended.any()):
            env._begin(ended)
        found = {f"start {name}": torch.stack(values) for name, values in kept.items()}
        found["held"] = held
        if self._room is None:
            found |= {f"solution {place}": part for place, part in enumerate(room)}
        found |= parameters | led_to | {f"after {key}": value for key, value in after.items()}
        return found | {f"{_NOW}{key}": value for key, value in env._present().items()}

    def _make_room(self) -> list[Tensor]:
        """Room for the solutions of an action's sub-steps."""
        return [part.new_empty((self.env.action_repeat, *part.shape)) for part in self._solution]

    def pull(
        self, record: dict[str, Tensor], names: tuple[str, ...], commands: tuple[Tensor, ...], by: tuple[Tensor, ...]
    ) -> tuple[list[Tensor], list[Tensor]]:
        """Gradients by the end of an action's sub-steps become those by its start and its commands."""
        worlds, gradients = self.worlds, self.worlds.gradients
        good = ~record["failed"]
        for name, value in zip(self._state, by, strict=True):
            gradients[name].copy_(torch.where(_along(good, value), value, 0.0))
        for name in self._parameters:
            worlds.parameters[name].copy_(record[f"parameter {name}"])
        keys = [key for key in record if key.startswith("solution ")]
        room = [record.pop(key) for key in keys] or None  # a second backward pass finds them again
        by_commands = [torch.zeros_like(value) for value in commands]
        worlds.forget()
        for substep in reversed(range(self.env.action_repeat)):
            worlds.place({name: record[f"start {name}"][substep] for name in self._started})
            for name, values in zip(names, commands, strict=True):
                worlds.control[name].copy_(values[substep])
            solution = None if room is None else [part[substep] for part in room]
            worlds.pull(solution, parameters=False)
            for name, found in zip(names, by_commands, strict=True):
                found[substep].copy_(torch.where(_along(good, found[substep]), gradients[f"command_{name}"], 0.0))
        if room is not None and good.device.type == "cpu":
            self._spare.append(room)
        unsure, held = good & (worlds.unsure | worlds.adrift), good & record["held"]
        good = good & ~unsure & ~held
        self._tell(unsure, held)
        by_commands = [torch.where(good[:, None], found.flatten(2), 0.0).reshape(found.shape) for found in by_commands]
        by_state = [torch.where(_along(good, gradients[name]), gradients[name], 0.0) for name in self._state]
        return by_state, by_commands

    def _tell(self, unsure: Tensor, held: Tensor) -> None:
        """Warn of the first worlds whose gradients are not unique, and of the first whose steps were held back."""
        self.unsure = self.unsure | unsure | held
        if len(self._warned) == 2 or not bool((unsure | held).any()):
            return
        for found, why in ((unsure, _REPEATS), (held, _HELD)):
            listed = found.nonzero().flatten().tolist()
            if not listed or why in self._warned:
                continue
            self._warned.add(why)
            warnings.warn(
                f"{type(self.env).__name__}: in world {listed[0]} and {len(listed) - 1} others {why}: gradients are 0 "
                "there, and EnvSteps.unsure names such worlds from now on",
                stacklevel=2,
            )


class _Substeps(torch.autograd.Function):
    """All sub-steps of an action as one operation."""

    @staticmethod
    def forward(
        ctx: Any, owner: EnvSteps, told: dict[str, Any], names: tuple[str, ...], *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        """The state where they led, before any reset."""
        commands = tensors[len(owner.now) :]
        record = owner.take(told, names, commands)
        record["failed"] = (told["after"]["world_status"] >= _FAILED).squeeze(-1)
        ctx.owner, ctx.names, ctx.record = owner, names, record
        ctx.save_for_backward(*commands)
        return tuple(record.pop(f"end {name}") for name in owner.now)

    @staticmethod
    def backward(ctx: Any, *by: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients by the state and by commands."""
        by_state, by_commands = ctx.owner.pull(ctx.record, ctx.names, ctx.saved_tensors, by)
        return (None, None, None, *by_state, *by_commands)


def require_gradient(env: Any) -> None:
    """Check that steps of an environment have gradients.

    Raises:
        ValueError: Naming what has none, and the way out.
    """
    name, out = type(env).__name__, "train without gradients, with algo=ppo or algo=sac"
    if not isinstance(env, DifferentiableTask):
        raise ValueError(
            f"{name}: steps of this environment have no gradient (Trunk, Diamond and BubbleMotion have); {out}"
        )
    found = env.gradient_refusal() or missing(env.sim)  # type: ignore[attr-defined]
    if found is None and env.config.inversion_penalty > 0.0:  # type: ignore[attr-defined]
        found = "inversion_penalty has no gradient; leave it out"
    integrator = env.sim.options.integrator  # type: ignore[attr-defined]
    if found is None and integrator != "euler":
        found = f"steps of integrator {integrator!r} have no gradient in environments; take integrator='euler'"
    iterations = env.sim.options.newton_iterations  # type: ignore[attr-defined]
    if found is None and iterations > 1:  # which keep no solutions, and may end before they converge
        found = f"steps with newton_iterations={iterations} have no gradient in environments; take newton_iterations=1"
    if found is not None:
        raise ValueError(f"{name}: {found}; or {out}")


def _solutions(sim: Simulation) -> list[wp.array]:
    """Arrays in which the systems of a simulation hold the solution of the last step, the first one where that counts.

    Systems that look at contacts where a first solution leads to keep it from now on, which makes their graphs anew.
    """
    looks, is_new, parts = sim.model.contact is not None and sim.options.contact_passes > 0, False, []
    for system in sim.keep_solutions():
        parts += solution_of(system)
        if looks:
            is_new = is_new or system.watch is None
            parts += FirstSolution.of(system, sim.dt).arrays
    if is_new:
        sim.dt = sim.dt
    return parts


def _along(mask: Tensor, value: Tensor) -> Tensor:
    return mask.reshape(-1, *(1,) * (value.dim() - 1))
