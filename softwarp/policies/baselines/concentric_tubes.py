"""A hand-written policy for ConcentricTubeRobot: the closed form of the free tubes, corrected by where the tip is."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from softwarp.policies.baselines.scripted import Policy

NEAR = 0.003  # m from the goal, within which commands follow from where the tip is
GAIN, FINE_GAIN = 0.5, 0.2  # of what the tip is away from the goal, corrected in one action; the line lags
FINE = 0.002  # m from the goal, within which the smaller part keeps the tip from swinging about it
THERE = 0.5  # actions from what a table of goals tells, within which they do too
ROUNDS = 6  # steps towards the solution of a closed form
DAMPING = 3.0e-4  # m, of these, per action
STEP = 1.0e-3  # of an action, for differences


def tube_baseline(env: Any) -> Policy:
    """The policy for ConcentricTubeRobot, from its observations alone.

    Far from the goal it moves to the lengths and angles of the table's nearest goal, corrected by the closed form; near
    it, to those that move the closed form by as much as the tip is away from the goal, contact or not. Discrete actions
    bring nearest to these in two actions.

    Args:
        env: A ConcentricTubeRobot, bare or transformed.
    """
    solver = _Solver(env)

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        seen = env.decode(tensordict["observation"])
        batch = seen["tip"].shape[:-1]
        length, angle, tip, goal = (seen[name].reshape(-1, 3) for name in ("length", "angle", "tip", "goal"))
        action = solver.action(length, angle, tip, goal)
        return tensordict.set("action", action.reshape(*batch, *action.shape[1:]))

    return policy


class _Solver:
    """Lengths and angles, in units of an action, for places of the tip."""

    def __init__(self, env: Any) -> None:
        config = env.config
        self.line, self.goals, self.is_discrete = env.line, env.goals, config.action_kind == "discrete"
        self.is_nested = config.nested
        self.unit = torch.tensor((*config.insert_step, *config.turn_step))
        self.most = torch.tensor(config.max_length)
        steps = []
        for tube in range(3):
            for place, change in ((tube, 1.0), (tube + 3, 1.0), (tube + 3, -1.0), (tube, None)):
                step = torch.zeros(6)
                step[place] = -config.withdraw_step[tube] / config.insert_step[tube] if change is None else change
                steps.append(step)
        self.choices = torch.stack(steps)

    def action(self, length: Tensor, angle: Tensor, tip: Tensor, goal: Tensor) -> Tensor:
        """Actions of all worlds."""
        self._move(length)
        q = torch.cat((length, angle), dim=1) / self.unit
        error = goal - tip
        wish = self._solve(self._nearest(goal), goal)
        away = torch.linalg.vector_norm(error, dim=1)
        aim = self.tip(q) + torch.where(away > FINE, GAIN, FINE_GAIN)[:, None] * error
        corrected = self._solve(q, aim)
        is_near = (away < NEAR) | ((wish - q).abs().amax(dim=1) < THERE)
        if not self.is_discrete:
            change = (torch.where(is_near[:, None], corrected, wish) - q).clamp(-1.0, 1.0)
            pairs: Tensor = change.unflatten(1, (2, 3)).transpose(1, 2).flatten(1)  # insertion and turn of each tube
            return pairs
        return torch.where(is_near, self._choose(q, aim), self._approach(q, wish))

    def tip(self, q: Tensor) -> Tensor:
        """Tips of the closed form [m]."""
        x: Tensor = self.line.tip(*self._parts(q))
        return x

    def _move(self, like: Tensor) -> None:
        if self.unit.device != like.device or self.line.curved.dtype != like.dtype:
            self.line = self.line.to(like.device, like.dtype)
            self.unit, self.most, self.choices = (x.to(like) for x in (self.unit, self.most, self.choices))

    def _parts(self, q: Tensor) -> tuple[Tensor, Tensor]:
        return q[:, :3] * self.unit[:3], q[:, 3:] * self.unit[3:]

    def _limited(self, q: Tensor) -> Tensor:
        length = torch.minimum((q[:, :3] * self.unit[:3]).clamp_min(0.0), self.most)
        if self.is_nested:
            length = length.cummin(dim=1).values
        return torch.cat((length / self.unit[:3], q[:, 3:]), dim=1)

    def _nearest(self, goal: Tensor) -> Tensor:
        """What leads to the table's nearest goal."""
        nearest = torch.cdist(goal, self.goals.tip.to(goal)).argmin(dim=1)
        length, angle = (part.to(goal)[nearest] for part in (self.goals.length, self.goals.angle))
        return torch.cat((length, angle), dim=1) / self.unit

    def _solve(self, q: Tensor, aim: Tensor) -> Tensor:
        """Damped least squares from q on: a tip at ``aim`` with small changes."""
        count, eye = len(q), torch.eye(3).to(q)
        shifts = STEP * torch.cat((torch.zeros(1, 6), torch.eye(6))).to(q)
        for _ in range(ROUNDS):
            tips = self.tip((q[:, None] + shifts).flatten(0, 1)).unflatten(0, (count, 7))
            jacobian = (tips[:, 1:] - tips[:, :1]).transpose(1, 2) / STEP
            square = jacobian @ jacobian.transpose(1, 2) + DAMPING**2 * eye
            missing = (aim - tips[:, 0])[..., None]
            q = self._limited(q + (jacobian.transpose(1, 2) @ torch.linalg.solve(square, missing))[..., 0].clamp(-1, 1))
        return q

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
