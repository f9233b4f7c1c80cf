"""What tasks share in which displacement-controlled cables bring a point of a soft robot to a goal.

Action       continuous: (cable,) in [-1, 1], change of the commanded displacements in units of ``action_step``
             absolute:   (cable,) in [-1, 1], displacements from slackest to shortest, approached by ``action_step``
             discrete:   one cable is shortened or lengthened by ``action_step``; a task orders the choices
Goal         workspace: a point that was seen to be reached, jittered;  list: one of ``goal_list``
Reward       shaped: progress (d_prev - d) / progress_scale;  precision w / (1 + (d / precision_scale)^2);
             effort -effort_weight mean(a^2)

Commands move to their new values in equal parts over the sub-steps of an action.

What an action commands and what a state is worth are pure functions of tensors (``*_from``): the environment calls them
with what the simulator tells, and ``envs/gradients.py`` with tensors that carry gradients.
"""

from __future__ import annotations

import functools
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

import numpy as np
import torch
from torch import Tensor

from softwarp.envs import rewards
from softwarp.envs.base import SoftEnv
from softwarp.envs.gradients import Seen
from softwarp.envs.options.cable_reach import ACTION_KINDS as ACTION_KINDS
from softwarp.envs.options.cable_reach import GOAL_SPLITS as GOAL_SPLITS
from softwarp.envs.options.cable_reach import OBSERVATION_KINDS as OBSERVATION_KINDS
from softwarp.envs.options.cable_reach import REWARD_KINDS as REWARD_KINDS
from softwarp.envs.options.cable_reach import CableReachConfig
from softwarp.envs.sums import length_of

COMPACT_LIMIT = 10.0
STREAM_GOAL = 0  # of random numbers; tasks have their own from 1 on
_TRAIN_FRACTION = 0.8
STRETCH = 1.5  # times its way at rest: how far from where it is held a robot reaches at best, folded legs straightened

Compact = Sequence[tuple[str, int, float]]  # name, entries, divisor to order 1


class CableReach(SoftEnv):
    """Commands, goals, distance and reward of such a task.

    A task implements ``displacement_limits``, ``choices``, ``goal_table``, ``tip`` and ``tip_markers`` besides the
    scene and the observation, and calls ``setup`` and ``reset_worlds`` of this class in its own.
    """

    config: CableReachConfig

    @abstractmethod
    def displacement_limits(self) -> tuple[Tensor, Tensor]:
        """Slackest and shortest commanded displacement of every cable [m], (cable,) each."""

    @abstractmethod
    def choices(self) -> list[tuple[int, float]]:
        """Cable and sign of every discrete action; +1 shortens."""

    @abstractmethod
    def goal_table(self) -> Tensor:
        """Candidate goals [m], shape (goal, 3)."""

    @abstractmethod
    def tip(self) -> Tensor:
        """The point that is to come to the goal [m], shape (world, 3)."""

    @property
    @abstractmethod
    def tip_markers(self) -> tuple[int, ...]:
        """Markers whose mean is that point."""

    def setup(self) -> None:
        """Allocate goals, commands and constants."""
        device = self.device
        low, high = self.displacement_limits()
        self._low, self._high = low.to(device), high.to(device)
        self.goal = self.add_world_state("goal", 3)
        self.command = self.add_world_state("command", len(low))  # m
        self._start = torch.zeros_like(self.command)
        self._change = torch.zeros_like(self.command)
        self._ramp = torch.zeros_like(self.command)
        self._first_command = torch.zeros_like(self._low)
        self._choice_cable = torch.tensor([cable for cable, _ in self.choices()], device=device)
        self._choice_sign = torch.tensor([sign for _, sign in self.choices()], device=device)
        unit = torch.eye(len(low), device=device)
        self._choices = self.config.action_step * self._choice_sign[:, None] * unit[self._choice_cable]
        self._goal_table = self.goal_table().to(device)

    def reset_worlds(self, mask: Tensor) -> None:
        """New goals, first commands."""
        chosen = mask[:, None]
        torch.where(chosen, self._first_command, self.command, out=self.command)
        torch.where(chosen, self.draw_goals(), self.goal, out=self.goal)

    def shown_goals(self) -> Tensor:
        """Places of all goals that episodes may have, jitter apart."""
        return self._goal_table[:, :3]

    def draw_goals(self) -> Tensor:
        """Goals [m] of the running episodes, shape (world, 3)."""
        u = self.draw(STREAM_GOAL, 4)
        count = len(self._goal_table)
        row = (u[:, 0] * count).to(torch.int64).clamp_(max=count - 1)  # the product may round up to count
        goal = self._goal_table[row]
        if self.config.goals == "workspace":
            goal = goal + self.config.goal_jitter * (2.0 * u[:, 1:] - 1.0)
        return goal

    def listed_or_reachable(self, reachable: np.ndarray) -> Tensor:
        """``goal_list``, or the part of the reachable points (point, 3) that ``goal_split`` names."""
        if self.config.goals == "list":
            self._check_reach(np.array(self.config.goal_list))
            return torch.tensor(self.config.goal_list, dtype=torch.float32)
        return torch.from_numpy(split_part(reachable, self.config.goal_split).copy())

    def _check_reach(self, goals: np.ndarray) -> None:
        """Refuse goals [m] that lie farther from where the body is held than it could stretch."""
        model = self.sim.model
        rest = np.asarray(model.node_rest, dtype=np.float64)
        root = rest[np.asarray(model.node_fixed, dtype=bool)].mean(axis=0)
        reach = STRETCH * np.linalg.norm(rest - root, axis=1).max()
        away = np.linalg.norm(goals - root, axis=1)
        if (away > reach).any():
            goal, place = goals[away.argmax()].tolist(), [round(float(c), 4) for c in root]
            raise ValueError(
                f"{type(self.config).__name__}: points of goal_list must lie within {reach:.3g} m of {place}, where "
                f"the robot is held, so that it reaches them, got {goal}; goals='workspace' has only such"
            )

    @property
    def action_size(self) -> int:
        """One number per cable."""
        return 0 if self.config.action_kind == "discrete" else self.sim.model.cable_count

    @property
    def action_count(self) -> int:
        """Shorten or lengthen one cable."""
        return len(self.choices()) if self.config.action_kind == "discrete" else 0

    def action_names(self) -> Sequence[str]:
        """Cables, or what is done to one."""
        names = self.sim.model.cable_names
        if not self.action_count:
            return names
        return [f"{'shorten' if sign > 0.0 else 'lengthen'} {names[cable]}" for cable, sign in self.choices()]

    def apply_action(self, action: Tensor, substep: int) -> None:
        """Move the commanded displacements to their new values in equal parts."""
        if substep == 0:
            self._start.copy_(self.command)
            self._set_command(action)
            torch.sub(self.command, self._start, out=self._change)
        if substep == self.action_repeat - 1:
            self.sim.control.cable_displacement.copy_(self.command)
        else:
            torch.add(self._start, self._change, alpha=(substep + 1) / self.action_repeat, out=self._ramp)
            self.sim.control.cable_displacement.copy_(self._ramp)

    def _set_command(self, action: Tensor) -> None:
        """Displacements [m] to be reached at the end of this action."""
        self.command.copy_(self.command_from(self.sim, self.world_state, action))

    def command_from(self, seen: Seen, held: Mapping[str, Tensor], action: Tensor) -> Tensor:
        """Displacements [m] to be reached at the end of an action, shape (world, cable)."""
        config, command = self.config, held["command"]
        if config.action_kind == "discrete":
            command = command + self._choices[action]
        elif config.action_kind == "continuous":
            command = command + config.action_step * action.clamp(-1.0, 1.0)
        else:
            low, high = self._low.to(action.dtype), self._high.to(action.dtype)
            target = torch.lerp(low, high, 0.5 * (action.clamp(-1.0, 1.0) + 1.0))
            command = command + (target - command).clamp(-config.action_step, config.action_step)
        if config.clamp_commands:
            # A slack cable would ignore pulling until its command has caught up with it.
            loosest = seen.cable_displacement.to(command.dtype) - config.max_slack
            command = torch.fmax(command, torch.fmax(loosest, self._low))  # fmax: a NaN changes nothing
            command = torch.minimum(command, self._high)
        return command

    def action_for(self, command: Tensor) -> Tensor:
        """The action that takes the commanded displacements nearest to ``command`` [m], shape (world, cable).

        A discrete action moves the cable that is farthest from its wish.
        """
        wish = command.to(self.command)
        change = (wish - self.command) / self.config.action_step
        if self.config.action_kind == "discrete":
            return (change[:, self._choice_cable] * self._choice_sign).argmax(dim=-1)
        if self.config.action_kind == "absolute":
            return (2.0 * (wish - self._low) / (self._high - self._low) - 1.0).clamp(-1.0, 1.0)
        return change.clamp(-1.0, 1.0)

    # What another robot can follow: planning/tracing.py

    target_kind = "point"

    def plan_target(self) -> Tensor:
        """Where the tip is [m], (world, 3)."""
        return self.tip()

    def tracked(self) -> Tensor:
        """The tip [m], (world, 3)."""
        return self.tip()

    def task_options(self, world: int) -> dict[str, Any]:
        """The goal of a world."""
        return {"goals": "list", "goal_list": [self.goal[world].tolist()]}

    def measure_distance(self) -> Tensor:
        """Tip to goal [m]."""
        return length_of(self.goal - self.tip())

    def is_success(self, distance: Tensor) -> Tensor:
        """Within the tolerance."""
        return distance <= self.config.success_tolerance

    def reward_terms(self, action: Tensor, distance: Tensor) -> dict[str, Tensor]:
        """The shaped reward of the table at the top."""
        return self.reward_from(action, self.distance, distance)

    def reward_from(self, action: Tensor, previous: Tensor, distance: Tensor) -> dict[str, Tensor]:
        """The shaped reward of the table at the top."""
        config = self.config
        terms = {
            "progress": rewards.progress(previous, distance, config.progress_scale),
            "precision": config.precision_weight * rewards.cauchy(distance, config.precision_scale),
        }
        if self.action_size:
            terms["effort"] = config.effort_weight * rewards.effort(action.clamp(-1.0, 1.0))
        return terms


class FreeReach(CableReach):
    """Such a task of a robot that touches nothing: its steps have gradients (envs/gradients.py).

    A task implements ``tip_from`` and ``observation_from`` in place of ``tip`` and ``observe``.
    """

    def gradient_refusal(self) -> str | None:
        """What of these options has no gradient, and the way out."""
        config = self.config
        if config.action_kind == "discrete":
            return "discrete actions have no gradient; take action_kind='continuous' or 'absolute'"
        if config.reward == "paper":
            return "reward='paper' has no gradient where the goal does not come nearer; take reward='shaped'"
        return None

    def commands_from(
        self, seen: Seen, held: Mapping[str, Tensor], action: Tensor
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """What the sub-steps command, (substep, world, cable), and what is held from then on."""
        start, command = held["command"], self.command_from(seen, held, action)
        shares = [(substep + 1) / self.action_repeat for substep in range(self.action_repeat - 1)]
        parts = [torch.add(start, command - start, alpha=share) for share in shares]
        return {"cable_displacement": torch.stack([*parts, command])}, {"command": command}

    @abstractmethod
    def tip_from(self, seen: Seen) -> Tensor:
        """The point that is to come to the goal [m], shape (world, 3)."""

    @abstractmethod
    def observation_from(self, seen: Seen, held: Mapping[str, Tensor]) -> Tensor:
        """Scaled, shape (world, k)."""

    def distance_from(self, seen: Seen, held: Mapping[str, Tensor]) -> Tensor:
        """Tip to goal [m], shape (world,)."""
        goal = held["goal"]
        return length_of(goal - self.tip_from(seen).to(goal.dtype))

    def tip(self) -> Tensor:
        """The point that is to come to the goal [m], shape (world, 3)."""
        return self.tip_from(self.sim).to(torch.float32)

    def measure_distance(self) -> Tensor:
        """Tip to goal [m]."""
        return self.distance_from(self.sim, self.world_state)

    def observe(self) -> dict[str, Tensor]:
        """The kind that was asked for."""
        return {"observation": self.observation_from(self.sim, self.world_state)}


def split_part(rows: np.ndarray, split: str) -> np.ndarray:
    """The rows of a table that ``goal_split`` names."""
    cut = int(_TRAIN_FRACTION * len(rows))
    return {"train": rows[:cut], "eval": rows[cut:], "all": rows}[split]


def compact_layout(compact: Compact) -> tuple[dict[str, slice], float]:
    """Where each quantity stands in a compact observation, and metres per unit of its ``tip`` and ``goal``."""
    layout, start = {}, 0
    for name, size, _ in compact:
        layout[name] = slice(start, start + size)
        start += size
    return layout, next(divisor for name, _, divisor in compact if name == "tip")


def compact_scale(compact: Compact) -> Tensor:
    """Factor of every entry of a compact observation."""
    return torch.cat([torch.full((size,), 1.0 / divisor) for _, size, divisor in compact])


@functools.cache
def reachable_file(name: str) -> np.ndarray:
    """Points [m] that were seen in equilibrium under random commands, float32 (point, 3), in random order."""
    with resources.files("softwarp.envs").joinpath(name).open("rb") as file:
        return np.asarray(np.load(file)["tip"], dtype=np.float32)
