"""What tasks share in which three tubes or wires, one in the other, are pushed and turned at their bases.

Action       continuous: (6,) in [-1, 1], for each tube from the innermost: insertion in units of ``insert_step``
             (negative withdraws), then turn in units of ``turn_step``; with ``action_power`` p by |a|^p of these
             discrete:   12 choices, four for each tube: 0 insert, 1 turn, 2 turn back, 3 withdraw
Wall force   ``wall_force`` (2,) beside the observation, in N: the sum of the sizes of all forces on the wall, the
             largest in the action, and the largest in the episode so far
Reward       shaped: progress (d_prev - d) / progress_scale;  precision w / (1 + (d / precision_scale)^2);
             effort -effort_weight mean(a^2);  force -force_penalty (largest force in the action - force_limit)
             paper:  min(3 sqrt(max((d_best - d) / d_best, 0)), 1) with the episode's least distance so far, d_best

Commands move in equal parts over the sub-steps of an action, and are clamped to what lengths can be. With
``max_insertion_force`` nothing is inserted in sub-steps in which the wall presses the tubes back with more, along the
axis of their port; they may turn and withdraw.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor

from softwarp.envs import rewards, sums
from softwarp.envs.base import SoftEnv
from softwarp.envs.options.tubes import ACTION_KINDS as ACTION_KINDS
from softwarp.envs.options.tubes import TUBES, TubesConfig
from softwarp.model.handles import Telescope

FORCE_LIMIT = 1.0e9  # N, bound of what is told
KINDS = 4  # insert, turn, turn back, withdraw
PAPER_FACTOR = 3.0  # of SofaGym's reward
ALIKE = 0.05  # of the largest steps, within which planners take lengths and angles as equal


class TubeTask(SoftEnv):
    """Commands, tip, wall force and reward of such a task.

    A task implements ``telescope``, ``most_lengths`` and ``draw_goals`` besides the scene and the observation, and
    calls ``setup`` and ``reset_worlds`` of this class in its own.
    """

    config: TubesConfig
    tube_names: ClassVar[tuple[str, ...]] = ("inner tube", "middle tube", "outer tube")

    @property
    @abstractmethod
    def telescope(self) -> Telescope:
        """The tubes."""

    @property
    @abstractmethod
    def most_lengths(self) -> tuple[float, ...]:
        """How far each tube may be pushed out [m]."""

    @abstractmethod
    def draw_goals(self) -> Tensor:
        """Goals [m] of the running episodes, shape (world, 3)."""

    def setup(self) -> None:
        """Allocate goals, commands and constants."""
        config, device, model = self.config, self.device, self.sim.model
        self.goal = self.add_world_state("goal", 3)  # m
        self.length = self.add_world_state("length", TUBES)  # m, commanded
        self.angle = self.add_world_state("angle", TUBES)  # rad, commanded
        self.least_distance = self.add_world_state("least_distance")  # m, of the episode
        self.force = self.add_world_state("force")  # N, largest in the action
        self.peak_force = self.add_world_state("peak_force")  # N, of the episode
        self._start = torch.zeros((2, *self.length.shape), device=device)
        self._change = torch.zeros_like(self._start)
        self._nodes = model.rod_nodes(self.telescope)
        self._first = torch.tensor(config.first_lengths, device=device)
        self._most = torch.tensor(self.most_lengths, device=device)
        self._insert, self._turn = (torch.tensor(x, device=device) for x in (config.insert_step, config.turn_step))
        self._choices = torch.zeros((KINDS * TUBES, 2, TUBES), device=device)
        for tube in range(TUBES):
            for kind, change in enumerate((config.insert_step[tube], 0.0, 0.0, -config.withdraw_step[tube])):
                self._choices[KINDS * tube + kind, 0, tube] = change
            self._choices[KINDS * tube + 1, 1, tube] = config.turn_step[tube]
            self._choices[KINDS * tube + 2, 1, tube] = -config.turn_step[tube]
        self._most_force = torch.full((2,), FORCE_LIMIT)

    def reset_worlds(self, mask: Tensor) -> None:
        """New goals, tubes as at the start."""
        chosen = mask[:, None]
        torch.where(chosen, self.draw_goals(), self.goal, out=self.goal)
        torch.where(chosen, self._first, self.length, out=self.length)
        for held in (self.force, self.peak_force):
            held.masked_fill_(mask, 0.0)
        self.angle.masked_fill_(chosen, 0.0)
        self._tell(self.length, self.angle)
        torch.where(mask, self.measure_distance(), self.least_distance, out=self.least_distance)

    # Actions

    @property
    def action_size(self) -> int:
        """Insertion and turn of every tube."""
        return 0 if self.config.action_kind == "discrete" else 2 * TUBES

    @property
    def action_count(self) -> int:
        """Insert, turn, turn back and withdraw every tube."""
        return KINDS * TUBES if self.config.action_kind == "discrete" else 0

    def action_names(self) -> Sequence[str]:
        """What is done to each tube."""
        changes = ("insert", "turn", "turn back", "withdraw") if self.action_count else ("insertion", "turn")
        return [f"{name}: {change}" for name in self.tube_names for change in changes]

    def apply_action(self, action: Tensor, substep: int) -> None:
        """Move the commands to their new values in equal parts; note the forces that the wall has borne."""
        if substep == 0:
            self.force.zero_()
            self._start[0].copy_(self.length)
            self._start[1].copy_(self.angle)
            self._set_command(action)
            torch.sub(self.length, self._start[0], out=self._change[0])
            torch.sub(self.angle, self._start[1], out=self._change[1])
        else:
            torch.fmax(self.force, self.wall_force(), out=self.force)
        if math.isfinite(self.config.max_insertion_force):
            self._slip()
        if substep == self.action_repeat - 1:
            self._tell(self.length, self.angle)
        else:
            length, angle = self._start + (substep + 1) / self.action_repeat * self._change
            self._tell(length, angle)

    def _slip(self) -> None:
        """Where the wall presses back too hard, the feed slips for a sub-step: what it would insert is taken back."""
        slips = self.insertion_force() > self.config.max_insertion_force
        lost = slips[:, None] * self._change[0].clamp_min(0.0) / self.action_repeat
        self._start[0] -= lost
        self.length -= lost

    def _tell(self, length: Tensor, angle: Tensor) -> None:
        self.sim.control.tube_length.copy_(length)
        self.sim.control.tube_angle.copy_(angle)

    def changes(self, action: Tensor) -> Tensor:
        """What actions ask lengths [m] and angles [rad] to change by, (2, world, tube), limits apart."""
        if self.config.action_kind == "discrete":
            return self._choices[action].transpose(0, 1)
        pairs = _powered(action.clamp(-1.0, 1.0), self.config.action_power).unflatten(1, (TUBES, 2))
        return torch.stack((pairs[..., 0] * self._insert, pairs[..., 1] * self._turn))

    def action_of(self, share: Tensor) -> Tensor:
        """The continuous action that moves by these shares of the largest steps, (world, 2 tube)."""
        return _powered(share.clamp(-1.0, 1.0), 1.0 / self.config.action_power)

    def likeness(self) -> Tensor:
        """Lengths and angles in units of ``ALIKE`` of the largest steps, (world, 2 tube)."""
        held = torch.cat((self.length / self._insert, self.angle / self._turn), dim=1)
        return (held / ALIKE).round().to(torch.int64)

    def _set_command(self, action: Tensor) -> None:
        """Lengths and angles that are to be reached at the end of this action."""
        length, angle = self.changes(action)
        self.angle += angle
        self.length += length
        torch.minimum(self.length.clamp_(min=0.0), self._most, out=self.length)
        if self.config.nested:  # a tube that would overtake stays behind; one that would be overtaken too
            self.length.copy_(self.length.cummin(dim=1).values)

    # For inverse control: control/tubes.py

    def action_for(self, command: Tensor) -> Tensor:
        """The action that takes lengths [m] and angles [rad] to the wished ones, (world, 2 tube), or towards them."""
        length, angle = command.to(self.length).split(TUBES, dim=1)
        wish = torch.stack(((length - self.length) / self._insert, (angle - self.angle) / self._turn), dim=2)
        if self.config.action_kind == "continuous":
            return self.action_of(wish.flatten(1))
        # All of them move something, if nothing is in the way: the one that goes along the wish, however far.
        longer = (self.length[:, None] + self._choices[:, 0]).clamp(min=0.0).minimum(self._most)
        if self.config.nested:
            longer = longer.cummin(dim=2).values
        turned = (self._choices[:, 1] / self._turn).expand(len(wish), -1, -1)
        ways = torch.stack(((longer - self.length[:, None]) / self._insert, turned), dim=3)
        size = ways.square().sum(dim=(2, 3)).sqrt().clamp_min(1.0e-6)
        choice: Tensor = ((wish[:, None] * ways).sum(dim=(2, 3)) / size).argmax(dim=1)
        return choice

    # What is seen and measured

    def tip(self) -> Tensor:
        """Where the innermost tube ends [m], shape (world, 3)."""
        nodes = self.sim.rod_x[:, self._nodes].to(torch.float32)
        if self.config.nested:
            return nodes[:, -1]
        length = self.sim.tube_length.to(torch.float32)
        pieces = nodes.shape[1] - 1
        place = pieces * (length[:, 0] / length.amax(dim=1).clamp_min(1.0e-9)).clamp(0.0, 1.0)
        below = place.to(torch.int64).clamp_max(pieces - 1)
        share = (place - below)[:, None]
        rows = torch.arange(len(nodes), device=nodes.device)
        return torch.lerp(nodes[rows, below], nodes[rows, below + 1], share)

    def direction(self) -> Tensor:
        """Where the line points at its end, unit vectors (world, 3)."""
        last = self.sim.rod_x[:, self._nodes][:, -2:].to(torch.float32)
        way = last[:, 1] - last[:, 0]
        return way / sums.length_of(way)[:, None].clamp_min(1.0e-9)

    def insertion_force(self) -> Tensor:
        """Force with which the wall presses the tubes back along the axis of their port now [N], (world,)."""
        back = -self.sim.contact_load[..., 2].to(torch.float32)  # tubes are the first part of every pair here
        return sums.total(back.masked_fill(self.sim.contact_pair < 0, 0.0))

    def wall_force(self) -> Tensor:
        """Sum of the sizes of all forces on the wall now [N], (world,)."""
        size = sums.length_of(self.sim.contact_load)
        return sums.total(size.masked_fill(self.sim.contact_pair < 0, 0.0)).to(torch.float32)

    def note_force(self) -> Tensor:
        """Largest sum of wall forces in this action and in the episode [N], (world, 2)."""
        torch.fmax(self.force, self.wall_force(), out=self.force)
        torch.fmax(self.peak_force, self.force, out=self.peak_force)
        return torch.stack((self.force, self.peak_force), dim=1)

    def measure_distance(self) -> Tensor:
        """Tip to goal [m]."""
        return sums.length_of(self.goal - self.tip())

    def is_success(self, distance: Tensor) -> Tensor:
        """Within the tolerance."""
        return distance <= self.config.success_tolerance

    def is_terminated(self, distance: Tensor) -> Tensor:
        """Too much force, where that ends an episode."""
        return (self.force > self.config.force_limit) & self.config.end_on_force

    def reward_terms(self, action: Tensor, distance: Tensor) -> dict[str, Tensor]:
        """See the table at the top."""
        config, terms = self.config, {}
        self.note_force()
        if config.reward == "paper":
            won = rewards.relative_progress(self.least_distance, distance)
            terms["relative_progress"] = (PAPER_FACTOR * won).clamp_max(1.0)
        else:
            terms["progress"] = rewards.progress(self.distance, distance, config.progress_scale)
            terms["precision"] = config.precision_weight * rewards.cauchy(distance, config.precision_scale)
            if self.action_size:
                terms["effort"] = config.effort_weight * rewards.effort(action.clamp(-1.0, 1.0))
        torch.fmin(self.least_distance, distance, out=self.least_distance)
        if config.force_penalty > 0.0:
            terms["force"] = -config.force_penalty * (self.force - config.force_limit).clamp_min(0.0)
        return terms


def _powered(share: Tensor, power: float) -> Tensor:
    return share.sign() * share.abs() ** power
