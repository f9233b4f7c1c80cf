"""Ways through mazes on the device: where a ball is in its maze, how far it still has to go, and where it turns next.

Distances are along the middles of the corridors. From a cell c with distance D_c from its middle to the goal, a ball
that is a length t >= 0 towards an open side, behind which the middle lies D_n from the goal, has ``min(t, D_n - D_c + p
- t)`` farther to go, p the pitch: less where the way leads there, more where it does not. The lengths towards all open
sides add up, so that the distance is continuous where a way turns, and exact on the middles.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from softwarp.meshing import Maze
from softwarp.meshing.maze_geometry import DIRECTIONS

_ASIDE = 1.0e-6  # m


class MazeWays:
    """Tables of mazes that have the same cells and measures.

    Args:
        mazes: One or more.
        device: Of the tables.

    Attributes:
        centres: Middles of the cells [m], (cell, 2).
        neighbours: Cells behind the open sides east, north, west, south, -1 for a wall, (maze, cell, 4).
    """

    def __init__(self, mazes: Sequence[Maze], device: Any) -> None:
        first = mazes[0]
        self.columns, self.rows, self.pitch = first.columns, first.rows, first.pitch
        self.centres = torch.tensor(first.centres, dtype=torch.float32, device=device)
        self.neighbours = torch.tensor(np.stack([maze.neighbours for maze in mazes]), device=device)
        self._steps = torch.tensor(np.stack([maze.steps for maze in mazes]), dtype=torch.float32, device=device)
        self._turn = torch.tensor(np.stack([_turns(maze) for maze in mazes]), device=device)
        self._unit = torch.tensor(DIRECTIONS, dtype=torch.float32, device=device)
        self._lowest = -0.5 * self.pitch * torch.tensor([self.columns, self.rows], dtype=torch.float32, device=device)
        self._last = torch.tensor([self.columns - 1, self.rows - 1], device=device)
        self._stride = torch.tensor([self.rows, 1], device=device)
        self._side = torch.arange(4, device=device)

    @property
    def cells(self) -> int:
        """Cells of a maze."""
        return self.columns * self.rows

    def cell_of(self, place: Tensor) -> Tensor:
        """The cell of places in the plane [m], (..., 2) -> (...)."""
        step = torch.floor((place - self._lowest) / self.pitch).nan_to_num().long()
        step = torch.minimum(step.clamp_min(0), self._last)
        cell: Tensor = (step * self._stride).sum(dim=-1)
        return cell

    def place_on(self, cell: Tensor, side: Tensor, along: Tensor) -> Tensor:
        """Places on the middles [m]: ``along`` [m] from the middle of a cell towards a side, (world,) -> (world, 2)."""
        place: Tensor = self.centres[cell] + along[:, None] * self._unit[side]
        return place

    def openings(self, maze: Tensor, place: Tensor) -> Tensor:
        """Whether the sides of a place's cell are open, bool (world, 4)."""
        return self.neighbours[maze, self.cell_of(place)] >= 0

    def steps_between(self, maze: Tensor, one: Tensor, other: Tensor) -> Tensor:
        """Fewest steps between cells, (world,) or (world, k)."""
        return self._steps[maze.reshape(-1, *[1] * (one.dim() - 1)), one, other]

    def remaining(self, maze: Tensor, place: Tensor, cell: Tensor, side: Tensor, along: Tensor) -> Tensor:
        """Length of the way from places to goals ``along`` [m] from a cell's middle towards a side, (world,) [m]."""
        at = self.cell_of(place)
        around = self.neighbours[maze, at]
        cells = torch.cat((at[:, None], around), dim=1)
        far = self._to_goal(maze, cells.clamp_min(0), cell, side, along)
        off = place - self.centres[at]
        t = (off @ self._unit.T).clamp(0.0, 0.5 * self.pitch)
        extra = torch.minimum(t, far[:, 1:] - far[:, :1] + self.pitch - t)
        goal_at = torch.where(along > 0.0, self.neighbours[maze, cell, side], cell)  # the other end of its stretch
        here = (at == cell)[:, None] & (self._side == side[:, None])
        there = ((at == goal_at) & (along > 0.0))[:, None] & (self._side == ((side + 2) % 4)[:, None])
        to_goal = torch.where(here, along[:, None], self.pitch - along[:, None])
        extra = torch.where(here | there, (t - to_goal).abs() - to_goal, extra)
        total: Tensor = far[:, 0] + torch.where(around >= 0, extra, torch.zeros_like(extra)).sum(dim=1)
        return total

    def _to_goal(self, maze: Tensor, cells: Tensor, cell: Tensor, side: Tensor, along: Tensor) -> Tensor:
        """Distance from the middles of cells (world, k) to a goal [m]."""
        behind = self.neighbours[maze, cell, side].clamp_min(0)
        near = along[:, None] + self.pitch * self.steps_between(maze, cells, cell[:, None].expand_as(cells))
        round_ = self.pitch - along[:, None]
        round_ = round_ + self.pitch * self.steps_between(maze, cells, behind[:, None].expand_as(cells))
        return torch.where((along > 0.0)[:, None], torch.minimum(near, round_), near)

    def waypoints(
        self, maze: Tensor, place: Tensor, cell: Tensor, side: Tensor, along: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The next two places where the way to a goal turns, or the goal itself, (world, 2) each [m]."""
        at, goal = self.cell_of(place), self.place_on(cell, side, along)
        behind = self.neighbours[maze, cell, side].clamp_min(0)
        near = along + self.pitch * self.steps_between(maze, at, cell)
        round_ = self.pitch - along + self.pitch * self.steps_between(maze, at, behind)
        last = torch.where((along > 0.0) & (round_ < near), behind, cell)  # the cell from which the goal is entered
        first = self._turn[maze, last, at]
        second = self._turn[maze, last, first]
        ways = [torch.where((turn == last)[:, None], goal, self.centres[turn]) for turn in (first, second)]
        # In a ring the way from a place may go on through another side than that from the middle of its cell.
        around = self.neighbours[maze, at]
        far = self._to_goal(maze, torch.cat((at[:, None], around), dim=1).clamp_min(0), cell, side, along)
        t = ((place - self.centres[at]) @ self._unit.T).clamp(0.0, 0.5 * self.pitch)
        gain = (far[:, :1] + t - (far[:, 1:] + self.pitch - t)).masked_fill(around < 0, 0.0)
        most, through = gain.max(dim=1)
        entered = around.gather(1, through[:, None])[:, 0].clamp_min(0)
        is_ahead = ((self.centres[first] - self.centres[at]) * self._unit[through]).sum(dim=1) > 0.5 * self.pitch
        is_other = ((most > _ASIDE) & ~is_ahead & (at != last))[:, None]
        after = self._turn[maze, last, entered]
        others = [torch.where((turn == last)[:, None], goal, self.centres[turn]) for turn in (entered, after)]
        return torch.where(is_other, others[0], ways[0]), torch.where(is_other, others[1], ways[1])


def _turns(maze: Maze) -> np.ndarray[Any, np.dtype[np.int64]]:
    """For every goal and cell the cell where the way from the latter first turns, or the goal, (cell, cell)."""
    count = maze.columns * maze.rows
    goal, cell = np.arange(count)[:, None], np.arange(count)[None]
    beside = maze.neighbours[cell[0]]  # (cell, 4)
    steps = np.where(beside[None] >= 0, maze.steps[goal[:, :, None], beside[None].clip(0)], count)
    ahead = np.where(goal == cell, -1, np.argmin(steps, axis=2))  # side to leave by, (goal, cell)
    turn = np.where(goal == cell, cell, beside[cell[0], ahead.clip(0)])
    while True:
        on = ahead[goal, turn]
        goes_on = (on == ahead) & (on >= 0)
        if not goes_on.any():
            return np.asarray(turn, dtype=np.int64)
        after = np.where(goes_on, beside[turn, on.clip(0)], turn)
        turn = after
