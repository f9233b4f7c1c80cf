"""Ways through branching vessels on the device: where a tip is, how far it still has to go, and where it goes next.

Distances are along the centre lines. A place belongs to the nearest point of them, and is then projected onto the line
through that point along the vessel, by half a step to either side: so the way left changes steadily.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from softwarp.envs.sums import in_order
from softwarp.meshing import VesselTree

_FAR = 1.0e3  # m, where points stand that only fill up a row


class VesselWays:
    """Tables of vessels with equally many outlets.

    Args:
        trees: One or more.
        ahead: How far ahead the places are that ``look_ahead`` tells [m].
        device: Of the tables.
    """

    def __init__(self, trees: Sequence[VesselTree], ahead: Sequence[float], device: Any) -> None:
        self.outlets = len(trees[0].outlets)
        if any(len(tree.outlets) != self.outlets for tree in trees):
            raise ValueError(f"vessels must have equally many outlets, got {[len(tree.outlets) for tree in trees]}")
        most = max(len(tree.points) for tree in trees)

        def table(parts: Sequence[NDArray[Any]], fill: float, dtype: torch.dtype) -> Tensor:
            """Rows of all vessels, filled up to equal lengths along the points."""
            full = [np.pad(x, [(0, most - len(x)), *[(0, 0)] * (x.ndim - 1)], constant_values=fill) for x in parts]
            return torch.tensor(np.stack(full), dtype=dtype, device=device)

        self.points = table([tree.points for tree in trees], _FAR, torch.float32)  # (vessel, point, 3)
        self.axes = self.points.permute(2, 0, 1).contiguous()  # the same by coordinate
        self.direction = table([tree.direction for tree in trees], 0.0, torch.float32)
        self.radius = table([tree.radius for tree in trees], 0.0, torch.float32)  # m, of the lumen, (vessel, point)
        # Ways, whether a step along the vessel makes them shorter, and points ahead: (vessel, point, outlet, ...)
        self.ways = table([tree.ways.T for tree in trees], 0.0, torch.float32)
        gain = [np.where(tree.ways[:, tree.parent] > tree.ways, -1.0, 1.0).T for tree in trees]
        self.gain = table(gain, 0.0, torch.float32)
        look = [np.stack([tree.ahead(way).T for way in ahead], axis=2) for tree in trees]
        self.ahead = table(look, 0, torch.int64)
        choices = [tree.choices for tree in trees]
        to_fork = [np.abs(t.length[:, None] - t.length[fork.T]) for t, (fork, _) in zip(trees, choices, strict=True)]
        self.to_fork = table(to_fork, 0.0, torch.float32)
        self.side = table([side.transpose(1, 0, 2) for _, side in choices], 0.0, torch.float32)
        self.room = table([_room(tree) for tree in trees], 0.0, torch.float32)  # m, to the nearest end, (vessel, point)
        self.goals = torch.stack([self.points[k, torch.as_tensor(t.outlets)] for k, t in enumerate(trees)])
        self.half_step = 0.5 * float(np.linalg.norm(np.diff(trees[0].points[:2], axis=0)))

    def locate(self, vessel: Tensor, place: Tensor) -> tuple[Tensor, Tensor]:
        """Nearest point of the centre lines, and how far beyond it along the vessel a place is [m], (world,) each.

        Args:
            vessel: Vessel of every world, int64 (world,).
            place: In the vessel's frame [m], (world, 3).
        """
        rows = (axis if len(axis) == 1 else axis[vessel] for axis in self.axes)
        square = in_order((row - at[:, None]).square_() for row, at in zip(rows, place.unbind(dim=1), strict=True))
        point = square.argmin(dim=1)
        away = place - self.points[vessel, point]
        u = self.direction[vessel, point]
        beyond = away[:, 0] * u[:, 0] + away[:, 1] * u[:, 1] + away[:, 2] * u[:, 2]
        return point, beyond.clamp(-self.half_step, self.half_step)

    def remaining(self, vessel: Tensor, outlet: Tensor, located: tuple[Tensor, Tensor]) -> Tensor:
        """Way to an outlet [m], (world,)."""
        point, beyond = located
        return self.ways[vessel, point, outlet] + self.gain[vessel, point, outlet] * beyond

    def leads_on(self, vessel: Tensor, outlet: Tensor, located: tuple[Tensor, Tensor]) -> Tensor:
        """1 where the way to an outlet leads along the vessel, -1 where back out of a wrong branch, (world,)."""
        return -self.gain[vessel, located[0], outlet]

    def look_ahead(self, vessel: Tensor, outlet: Tensor, located: tuple[Tensor, Tensor]) -> Tensor:
        """Places farther on along the way to an outlet, at most the outlet [m], (world, place, 3)."""
        ahead = self.ahead[vessel, located[0], outlet]
        return self.points[vessel[:, None], ahead]

    def along(self, vessel: Tensor, outlet: Tensor, located: tuple[Tensor, Tensor]) -> Tensor:
        """Unit vector of the vessel where a place is, towards an outlet, (world, 3)."""
        point = located[0]
        return -self.gain[vessel, point, outlet][:, None] * self.direction[vessel, point]

    def aside(self, vessel: Tensor, located: tuple[Tensor, Tensor], place: Tensor) -> Tensor:
        """From the centre line to a place across it [m], (world, 3)."""
        point, beyond = located
        return place - self.points[vessel, point] - beyond[:, None] * self.direction[vessel, point]

    def next_fork(self, vessel: Tensor, outlet: Tensor, located: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """Way to the fork at which the way to an outlet next takes a branch, or to the outlet, and to which side.

        Returns:
            The way [m], (world,), and unit vectors from the other branches to that one, zero if none, (world, 3).
        """
        point, beyond = located
        way = self.to_fork[vessel, point, outlet] + self.gain[vessel, point, outlet] * beyond
        return way.clamp_min(0.0), self.side[vessel, point, outlet]

    def room_left(self, vessel: Tensor, located: tuple[Tensor, Tensor]) -> Tensor:
        """Way from a place to the nearest end of the vessel ahead of it [m], (world,)."""
        return self.room[vessel, located[0]] - located[1]


def _room(tree: VesselTree) -> NDArray[np.float64]:
    """Way from every point to the nearest end behind it [m]."""
    room = np.full(len(tree.points), np.inf)
    followed = np.zeros(len(tree.points), dtype=bool)
    followed[tree.parent[1:]] = True
    room[~followed] = 0.0
    for i in range(len(room) - 1, 0, -1):
        before = tree.parent[i]
        room[before] = min(room[before], room[i] + tree.length[i] - tree.length[before])
    return room
