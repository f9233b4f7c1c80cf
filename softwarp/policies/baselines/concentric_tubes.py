"""A hand-written policy for ConcentricTubeRobot: kinematics of the free tubes, corrected by where the tip is."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from softwarp.policies.baselines.scripted import Policy

NEAR = 0.003  # m between the goal and where commands lead free tubes, within which these follow from where the tip is
FADING, GAIN = 0.93, 0.25  # in an action: what is kept of that, and what is added of what the tip is away from the goal
MOST = 0.002  # m, of that, what counts
LAG = 0.6  # s, in which tubes that twist each other come to rest: where the tip is then is what counts
FAST = 0.006  # m/s, of the tip, which then follows a command; half of that is corrected
ROUNDS, FIRST_ROUNDS = 3, 12  # steps towards a place of the tip that is near, or far
DAMPING = 3.0e-4  # m, of these, per action
STEP = 1.0e-3  # of an action, for differences


def tube_baseline(env: Any) -> Policy:
    """The policy for ConcentricTubeRobot, from its observations alone.

    Far from the goal it moves to lengths and angles that bring free tubes there, which twist each other, sought from
    those of the table's nearest goal on; near it, to those that move the free tubes' tip by a part of what it will be
    away from the goal when it has come to rest, contact or not. Discrete actions bring nearest to these in two actions.

    Args:
        env: A ConcentricTubeRobot, bare or transformed.
    """
    solver = _Solver(env)

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        seen = env.decode(tensordict["observation"])
        batch = seen["tip"].shape[:-1]
        length, angle, tip, goal = (seen[name].reshape(-1, 3) for name in ("length", "angle", "tip", "goal"))
        speed = seen["tip_v"].reshape(-1, 3) if "tip_v" in seen else torch.zeros_like(tip)
        action = solver.action(length, angle, tip, goal, speed)
        return tensordict.set("action", action.reshape(*batch, *action.shape[1:]))

    return policy


class _Solver:
    """Lengths and angles, in units of an action, for places of the tip."""

    def __init__(self, env: Any) -> None:
        config = env.config
        self.line, self.twisted, self.goals = env.line, env.twisted_line, env.goals
        self.is_discrete = config.action_kind == "discrete"
        self._sought: tuple[Tensor, Tensor] | None = None  # goals of the last action, and what leads there
        self.is_nested, self.action_of = config.nested, env.action_of
        self.unit = torch.tensor((*config.insert_step, *config.turn_step))
        self.most = torch.tensor(config.max_length)
        steps = []
        for tube in range(3):
            for place, change in ((tube, 1.0), (tube + 3, 1.0), (tube + 3, -1.0), (tube, None)):
                step = torch.zeros(6)
                step[place] = -config.withdraw_step[tube] / config.insert_step[tube] if change is None else change
                steps.append(step)
        self.choices = torch.stack(steps)

    def action(self, length: Tensor, angle: Tensor, tip: Tensor, goal: Tensor, speed: Tensor) -> Tensor:
        """Actions of all worlds."""
        length, angle, tip, goal, speed = (part.double() for part in (length, angle, tip, goal, speed))
        self._move(length)
        q = torch.cat((length, angle), dim=1) / self.unit
        wish = self._wish(goal)
        length, angle = self._parts(q)
        tips = self.twisted.tips(length, angle)
        offset = self.twisted.from_tips(length, tips)[1] - goal
        waiting = 1.0 + (torch.linalg.vector_norm(speed, dim=1, keepdim=True) / FAST) ** 2
        shift = FADING * offset + GAIN * (goal - tip - LAG * speed).clamp(-MOST, MOST) / waiting
        corrected, missed = self._solve(torch.cat((length, tips), dim=1) / self.unit, goal + shift, ROUNDS)
        is_near = (torch.linalg.vector_norm(offset, dim=1) < NEAR) & (missed < MOST)
        if not self.is_discrete:
            change = (torch.where(is_near[:, None], corrected, wish) - q).clamp(-1.0, 1.0)
            pairs = change.unflatten(1, (2, 3)).transpose(1, 2).flatten(1).float()  # insertion, turn of each
            action: Tensor = self.action_of(pairs)
            return action
        aim = self.tip(q) + shift - offset
        return torch.where(is_near, self._choose(q, aim), self._approach(q, wish))

    def tip(self, q: Tensor) -> Tensor:
        """Tips of the closed form [m]."""
        x: Tensor = self.line.tip(*self._parts(q))
        return x

    def _move(self, like: Tensor) -> None:
        if self.unit.device != like.device or self.line.curved.dtype != like.dtype:
            self.line = self.line.to(like.device, like.dtype)
            self.twisted = self.twisted.to(like.device, like.dtype)
            self.unit, self.most, self.choices = (x.to(like) for x in (self.unit, self.most, self.choices))

    def _parts(self, q: Tensor) -> tuple[Tensor, Tensor]:
        return q[:, :3] * self.unit[:3], q[:, 3:] * self.unit[3:]

    def _limited(self, q: Tensor) -> Tensor:
        length = torch.minimum((q[:, :3] * self.unit[:3]).clamp_min(0.0), self.most)
        if self.is_nested:
            length = length.cummin(dim=1).values
        return torch.cat((length / self.unit[:3], q[:, 3:]), dim=1)

    def _wish(self, goal: Tensor) -> Tensor:
        """What leads to goals, which do not change from action to action, from the table's nearest goals on."""
        if self._sought is None or not torch.equal(self._sought[0], goal):
            nearest = torch.cdist(goal, self.goals.tip.to(goal)).argmin(dim=1)
            length, angle = (part.to(goal)[nearest] for part in (self.goals.length, self.goals.angle))
            start = torch.cat((length, angle), dim=1) / self.unit
            self._sought = goal.clone(), self._solve(start, goal, FIRST_ROUNDS)[0]
        return self._sought[1]

    def _solve(self, q: Tensor, aim: Tensor, rounds: int) -> tuple[Tensor, Tensor]:
        """Lengths and angles at bases, for a tip at ``aim``, from lengths and angles at tips: damped least squares.

        Also by how much they miss it [m].
        """
        count, eye = len(q), torch.eye(3).to(q)
        shifts = STEP * torch.cat((torch.zeros(1, 6), torch.eye(6))).to(q)
        for _ in range(rounds):
            shifted = self._parts((q[:, None] + shifts).flatten(0, 1))
            places = self.twisted.from_tips(*shifted)[1].unflatten(0, (count, 7))
            jacobian = (places[:, 1:] - places[:, :1]).transpose(1, 2) / STEP
            square = jacobian @ jacobian.transpose(1, 2) + DAMPING**2 * eye
            missing = (aim - places[:, 0])[..., None]
            q = self._limited(q + (jacobian.transpose(1, 2) @ torch.linalg.solve(square, missing))[..., 0].clamp(-1, 1))
        bases, places = self.twisted.from_tips(*self._parts(q))
        missed = torch.linalg.vector_norm(aim - places, dim=1)
        return torch.cat((q[:, :3], bases / self.unit[3:]), dim=1), missed

    def _approach(self, q: Tensor, wish: Tensor) -> Tensor:
        """The choice that brings nearest to a wish."""
        after = self._limited((q[:, None] + self.choices).flatten(0, 1)).unflatten(0, (len(q), -1))
        choice: Tensor = (after - wish[:, None]).abs().sum(dim=-1).argmin(dim=1)
        return choice

    def _choose(self, q: Tensor, aim: Tensor) -> Tensor:
        """The choice that brings the closed form nearest to a place, at once or with the next one."""
        worlds, kinds = len(q), len(self.choices)
        first = self._limited((q[:, None] + self.choices).flatten(0, 1))
        second = self._limited((first[:, None] + self.choices).flatten(0, 1))
        both = self.tip(torch.cat((first, second)))
        once = torch.linalg.vector_norm(both[: len(first)].unflatten(0, (worlds, kinds)) - aim[:, None], dim=-1)
        twice = both[len(first) :].unflatten(0, (worlds, kinds, kinds)) - aim[:, None, None]
        return torch.minimum(once, torch.linalg.vector_norm(twice, dim=-1).amin(dim=-1)).argmin(dim=1)
