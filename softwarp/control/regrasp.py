"""Starting over where inverse control of tubes stalls: draw back, turn, come out a little, and go on from there.

``TubeController`` finds a local minimum. The usual one is of tubes that are hidden: one that is not out moves nothing
when it turns, so that nothing tells to which side it should be turned before it comes out. Once a world has stalled for
a few periods, its tubes are drawn back to the port, turned to other angles, and pushed out by parts of the distance to
the target, the innermost farthest; from there the controller goes on. The angles are those of an additive recurrence,
which fills the range evenly however many starts are made, the same in every run:

    angle_k = turn (2 frac(1/2 + i / g^(k+1)) - 1),    g^(n+1) = g + 1,

for tube k of n at start i. The wall bears less while tubes are drawn back; coming out again, it may bear more than the
controller's limit, which is not looked at then: only the part ``out`` of the way is made so.

Reference: Roberts (2018), The Unreasonable Effectiveness of Quasirandom Sequences, for the recurrence.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from softwarp import checks
from softwarp.control.tubes import TubeController, TubeSolution
from softwarp.model.codes import Outcome

CONTROLLED, BACK, OUT = range(3)  # what a world does
SAME = 0.02  # of what a period allows, within which commands are reached
LONGEST = 40  # periods of drawing back, and of coming out, after which the control goes on in any case


class Regrasp:
    """Looks after the stalls of a ``TubeController``, world by world.

    Args:
        controller: That stalls; it tells what a period allows.
        restarts: Largest number of starts in a row without a target reached; 0 never starts over.
        wait: Periods of a stall before a start.
        out: Part of the distance from port to target that the innermost tube comes out by.
        turn: Largest angle of starts [rad].

    Raises:
        ValueError: If one of these is outside its range.
    """

    def __init__(
        self, controller: TubeController, *, restarts: int = 4, wait: int = 3, out: float = 0.4, turn: float = 2.5
    ) -> None:
        self.controller = controller
        self.restarts = checks.count(restarts, "regrasp: restarts", low=0)
        self.wait = checks.count(wait, "regrasp: wait", low=1)
        self.out = checks.number(out, "regrasp: out", above=0.0, high=1.0)
        self.turn = checks.number(turn, "regrasp: turn", above=0.0, high=math.pi)
        present, count = controller.present(), controller.response.count
        numbers = torch.arange(1.0, count + 1.0, dtype=torch.float64, device=present.device)
        self._rates = _root(count) ** -numbers
        self._shares = self.out * (1.0 - (numbers - 1.0) / count)
        self._start = torch.zeros_like(present)
        worlds = torch.zeros(len(present), dtype=torch.int64, device=present.device)
        self.starts, self.phase, self._stalled, self._spent = (worlds.clone() for _ in range(4))

    def begin(self, mask: Tensor) -> None:
        """Forget stalls and starts of worlds that begin anew, bool (world,)."""
        for held in (self.starts, self.phase, self._stalled, self._spent):
            held.masked_fill_(mask, 0)

    def command(self, solution: TubeSolution, targets: Tensor) -> Tensor:
        """Commands of this period, (world, 2 tube): the controller's, or those of a start.

        Args:
            solution: What the controller found.
            targets: Where the tip is to come [m], (world, 3).
        """
        present = self.controller.present()
        self.starts.masked_fill_(solution.outcome == Outcome.REACHED, 0)
        stalls = (solution.outcome == Outcome.UNREACHABLE) & (self.phase == CONTROLLED)
        self._stalled = torch.where(stalls, self._stalled + 1, 0)
        leaves = (self._stalled >= self.wait) & (self.starts < self.restarts)
        self.starts += leaves
        self._start = torch.where(leaves[:, None], self._next(targets.to(present)), self._start)
        self._enter(leaves, BACK)
        command, doing = solution.command, self.phase.clone()
        for phase, goal in ((BACK, self._drawn_back(present)), (OUT, self._start)):
            is_in = doing == phase
            moved = self.controller.towards(present, goal)
            command = torch.where(is_in[:, None], moved, command)
            arrived = self.controller.apart(moved, goal) < SAME
            self._enter(is_in & (arrived | (self._spent >= LONGEST)), (phase + 1) % 3)
        self._spent += 1
        return command

    def _enter(self, mask: Tensor, phase: int) -> None:
        self.phase.masked_fill_(mask, phase)
        for held in (self._spent, self._stalled):
            held.masked_fill_(mask, 0)

    def _next(self, targets: Tensor) -> Tensor:
        """Lengths and angles of the next starts, (world, 2 tube)."""
        response = self.controller.response
        port = response.sim.rod_x[:, response.nodes.start].to(targets)
        far = torch.linalg.vector_norm(targets - port, dim=1, keepdim=True)
        angle = self.turn * (2.0 * torch.frac(0.5 + self.starts[:, None] * self._rates) - 1.0)
        return torch.cat((far * self._shares, angle), dim=1)

    def _drawn_back(self, present: Tensor) -> Tensor:
        """Tubes in the port, turned as they are to come out."""
        count = self.controller.response.count
        return torch.cat((torch.zeros_like(present[:, :count]), self._start[:, count:]), dim=1)


def _root(count: int) -> float:
    """g of g^(count + 1) = g + 1, by fixed-point iteration."""
    root = 2.0
    for _ in range(64):
        root = (1.0 + root) ** (1.0 / (count + 1))
    return root
