"""Planning anew from the measured ball: all short sequences of tilts in copies of the simple maze, for many worlds."""

import itertools
import math
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from softwarp.envs import registry
from softwarp.envs.tasks.simple_maze import turned, turned_to

REACHED, LOST = 10.0, 10.0  # m that reaching the goal, or losing the ball, is worth against the way left


class Replanner:
    """The first tilt of the best sequence, for every world of a Maze.

    Each world has a copy of the simple maze per sequence of tilts, with its ball as it is measured. The best sequence
    reaches the goal soonest, or leaves the shortest way.

    Args:
        options: Of the plan's task, ``Trace.options``.
        seconds: Between two plans, and of an action [s].
        depth: Actions of a sequence.
        worlds: Of the Maze.
        device: Of the copies.
    """

    def __init__(self, options: dict[str, Any], seconds: float, depth: int, worlds: int, device: str) -> None:
        tilts = 4
        self.seconds, self.depth, self.worlds = seconds, depth, worlds
        self.sequences = torch.tensor(list(itertools.product(range(tilts), repeat=depth)), device=device)
        count = len(self.sequences)
        self.copies: Any = registry.make(
            "SimpleMaze", num_worlds=worlds * count, device=device, seed=0, action_kind="discrete", **options
        )
        repeat = round(seconds / self.copies.config.dt)
        self.copies.action_repeat = repeat
        self.copies.reset()
        self.copies.max_episode_steps = 2**62

    def decide(self, env: Any) -> Tensor:
        """Normals of the floor for the next action, (world, 3)."""
        copies, count = self.copies, len(self.sequences)
        place, velocity = (values[:, :2] for values in env.ball_place())
        tilt = env.seen_tilt()
        copies.put(*(values.repeat_interleave(count, dim=0) for values in (place, velocity, tilt)))
        actions = self.sequences.repeat(self.worlds, 1)
        value = torch.zeros(len(actions), device=copies.device)
        is_over = torch.zeros(len(actions), dtype=torch.bool, device=copies.device)
        for step in range(self.depth):
            given = TensorDict({"action": actions[:, step].clone()}, batch_size=copies.batch_size)
            data = copies.step(given)["next"]
            reached, ended = data["success"][:, 0], data["terminated"][:, 0]
            value = torch.where(reached & ~is_over, torch.full_like(value, REACHED - step), value)
            value = torch.where(ended & ~reached & ~is_over, torch.full_like(value, -LOST), value)
            is_over |= reached | ended
        value = torch.where(is_over, value, -copies.way)
        best = value.nan_to_num(nan=-math.inf).unflatten(0, (self.worlds, count)).argmax(dim=1)
        chosen = copies.config.max_tilt * torch.tensor(copies.tilts, device=copies.device)[self.sequences[best, 0]]
        up = torch.zeros((self.worlds, 3), device=copies.device)
        up[:, 2] = 1.0
        return turned_to(turned(chosen), up)
