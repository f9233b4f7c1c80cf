"""One call of a rollout on its way through the worlds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from softwarp import interop
from softwarp.gradients.refusals import Diverged
from softwarp.gradients.rest import RestShape
from softwarp.gradients.worlds import DifferentiableWorlds
from softwarp.model.codes import TURNED
from softwarp.model.model import Model

Tensors = Mapping[str, torch.Tensor]


@dataclass(frozen=True)
class Plan:
    """What the tensors of a call are: their names, which commands move, and how many steps there are."""

    names: tuple[str, ...]
    moving: frozenset[str]
    steps: int
    every: int
    factors: bool
    rest: RestShape | None


class Call:
    """One call's tensors on the way into the worlds."""

    def __init__(self, worlds: DifferentiableWorlds, plan: Plan, tensors: Tensors) -> None:
        self.worlds, self.plan, self.tensors = worlds, plan, tensors
        self.commands = [name.removeprefix("control.") for name in plan.names if name.startswith("control.")]
        self._commands = [tensors[f"control.{name}"].unbind(0) for name in plan.moving]
        self._commanded = [worlds.control[name] for name in plan.moving]

    def begin(self) -> None:
        """Everything that holds from the start on."""
        worlds = self.worlds
        worlds.start()
        groups = {"state": worlds.state, "params": worlds.parameters, "control": worlds.control}
        for name, value in self.tensors.items():
            group, _, own = name.partition(".")
            if own == "rest_x" and self.plan.rest is not None:
                self.plan.rest.check(value)
            elif own not in self.plan.moving or group != "control":
                groups[group][own].copy_(value)
        model = worlds.model
        is_placed = any(name.startswith(("state.body", "state.rod")) for name in self.tensors)
        leads = model.joints is not None or (model.frames is not None and model.frames.welded_frame.size)
        if (is_placed and leads) or model.reduction is not None:  # the way back goes by nodes that modes have placed
            worlds.refresh()

    def command(self, step: int) -> None:
        """Commands of one step."""
        interop.copy_all(self._commanded, [value[step] for value in self._commands])

    def between(
        self, first: dict[str, torch.Tensor], step: int, room: list[list[torch.Tensor]] | None
    ) -> list[dict[str, torch.Tensor]]:
        """States at the starts of the ``every`` steps after a kept one; their solutions too, if there is room."""
        worlds, states = self.worlds, [first]
        if self.plan.every > 1:
            worlds.place(first)
        for offset in range(self.plan.every if room is not None else self.plan.every - 1):
            self.command(step + offset)
            worlds.step()
            states.append(worlds.kept())
            if room is not None:
                worlds.kept_solutions.keep(room[offset])
        return states


def push(call: Call, directions: Sequence[Tensors]) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """Take all steps of a call, and push slopes of its tensors through them.

    Args:
        call: Steps and tensors.
        directions: Slopes of the call's tensors by their names, of every direction those that are not 0.

    Returns:
        Kept states, one tensor (state, world, ...) for each of ``worlds.names``, and slopes, (direction, state, ...).
    """
    worlds, plan = call.worlds, call.plan
    call.begin()
    still, moving, now = [], [], []
    for direction in directions:
        parts: dict[str, dict[str, torch.Tensor]] = {"state": {}, "params": {}, "control": {}, "moving": {}}
        for name, slope in direction.items():
            group, _, own = name.partition(".")
            if own == "rest_x" and plan.rest is not None:
                parts["params"] |= plan.rest.slopes(slope)
            elif group == "control" and slope.ndim > worlds.control[own].ndim:
                parts["moving"][f"command_{own}"] = slope
            else:
                parts[group][f"command_{own}" if group == "control" else own] = slope
        still.append(parts["params"] | parts["control"])
        moving.append(parts["moving"])
        now.append(parts["state"])
    count = plan.steps // plan.every
    kept = [worlds.state[name].new_empty((count, *worlds.state[name].shape)) for name in worlds.names]
    slopes = [value.new_empty((len(directions), *value.shape)) for value in kept]
    for step in range(plan.steps):
        call.command(step)
        moved = [{name: slope[step] for name, slope in each.items()} for each in moving]
        now = worlds.step_along([a | b | c for a, b, c in zip(still, moved, now, strict=True)])
        if (step + 1) % plan.every == 0:
            place = step // plan.every
            for name, values, along in zip(worlds.names, kept, slopes, strict=True):
                values[place].copy_(worlds.state[name])
                for slope, each in zip(along, now, strict=True):
                    slope[place].copy_(each[name])
    check_steps(call)
    if any("params.rest_x" in direction for direction in directions):
        check_guard(worlds.pressed, worlds.model)
    check_adrift(worlds)
    check_unsure(worlds)
    return kept, slopes


def check_steps(call: Call) -> None:
    """Refuse what would make the gradients of the steps that have been taken mean nothing."""
    worlds, plan = call.worlds, call.plan
    _check_failed(worlds.failed)
    _check_unfinished(worlds.unfinished)
    if worlds.holds_back:
        _check_held(worlds.held)
    if "control.body_velocity" in plan.names:
        _check_lagging(worlds.lagging)
    _check_room(worlds.state["contact_overflow"], worlds.model)
    if plan.rest is not None and "params.rest_x" in plan.names:
        check_guard(worlds.pressed, worlds.model)


def _check_failed(failed: torch.Tensor) -> None:
    worlds = failed.nonzero().flatten().tolist()
    if worlds:
        listed = ", ".join(map(str, worlds[:8])) + (" ..." if len(worlds) > 8 else "")
        raise Diverged(
            f"rollout: a step failed in {len(worlds)} of {len(failed)} worlds ({listed}), whose gradient would mean "
            "nothing; take a shorter dt or milder commands and parameters there"
        )


def _check_unfinished(unfinished: torch.Tensor) -> None:
    worlds = unfinished.nonzero().flatten().tolist()
    if worlds:
        raise Diverged(
            f"rollout: Newton's iterations of a step ended above their tolerance in world {worlds[0]} and "
            f"{len(worlds) - 1} others; a gradient is that of a step that has converged: take more newton_iterations, "
            "a larger newton_tolerance, a shorter dt, or newton_iterations=1"
        )


def _check_held(held: torch.Tensor) -> None:
    worlds = held.nonzero().flatten().tolist()
    if worlds:
        raise Diverged(
            f"rollout: steps were held back in world {worlds[0]} and {len(worlds) - 1} others, where elements are "
            "inside out or nearly flat (Simulation.compression), of which a gradient knows nothing; start from where "
            "none are, or take a shorter dt or milder commands there"
        )


def check_adrift(worlds: DifferentiableWorlds) -> None:
    """Refuse gradients that did not come to stay."""
    found = worlds.adrift.nonzero().flatten().tolist()
    if found:
        raise Diverged(
            f"rollout: the gradient of a step of Newton's method in world {found[0]} and {len(found) - 1} others is "
            "not found by going on, as near where something buckles, or where contacts repeat each other; take a "
            "shorter dt, or newton_iterations=1"
        )


def check_unsure(worlds: DifferentiableWorlds) -> None:
    """Refuse gradients where forces of contacts are not unique and motions depend on them."""
    found = worlds.unsure.nonzero().flatten().tolist()
    if not found:
        return
    told = f"rollout: in world {found[0]} and {len(found) - 1} others "
    if worlds.model.reduction is not None:
        raise Diverged(
            f"{told}a reduced body slipped on more contacts than its modes tell apart, so that how they share its "
            "load is not unique, and friction depends on it; give the pair a compliance, or the reduction more modes "
            "for contact"
        )
    raise Diverged(
        f"{told}contacts that repeat each other slipped, as along an edge that lies flat on a face, so that how they "
        "share their load is not unique, and friction depends on it; give the pair a compliance"
    )


def _check_lagging(lagging: torch.Tensor) -> None:
    worlds = lagging.nonzero().flatten().tolist()
    if worlds:
        raise RuntimeError(
            f"rollout: in world {worlds[0]} and {len(worlds) - 1} others a kinematic body moved otherwise than its "
            "body_velocity says, which then has no gradient; keep it within max_speed and max_spin, and let a new "
            "body_pose be reached before"
        )


def _check_room(overflow: torch.Tensor, model: Model) -> None:
    missed = int(overflow.max())
    if missed and model.contact is not None:
        raise RuntimeError(
            f"rollout: {missed} contacts of a step found no place among {model.contact.capacity}; "
            f"finalize with contact_capacity={model.contact.capacity + missed} or more"
        )


def check_guard(compression: torch.Tensor, model: Model) -> None:
    """Refuse gradients by the rest shape where a guard against inversion has had a part in the forces."""
    worlds = (compression.cpu() > 1.0 - highest_guard(model)).nonzero().flatten().tolist()
    if worlds:
        raise RuntimeError(
            f"rollout: {len(worlds)} worlds, world {worlds[0]} among them, had elements so flat that the guard of "
            "their law held them, where rest shapes have no gradient; take milder commands, or a hyperelastic law"
        )


def highest_guard(model: Model) -> float:
    """Volume ratio below which some element has a guard; a large negative number without."""
    guards, held = model.body_guard.numpy(), [(model.tet_body, model.law_tets)]
    if model.quadratic is not None:
        held.append((model.quadratic.point_body, model.quadratic.law_points))
    turned = [(bodies, tets) for bodies, laws in held for law, tets in laws.items() if law in TURNED]
    return float(max((guards[bodies.numpy()[tets.numpy()]].max() for bodies, tets in turned), default=-1e15))
