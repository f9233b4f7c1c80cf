"""Sums over finished episodes, kept on the device until somebody asks."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


class EpisodeLog:
    """Adds up how episodes went.

    Args:
        reward_names: Of the terms that make up a return.
        device: Where the sums are.
    """

    def __init__(self, reward_names: Sequence[str], device: torch.device | None) -> None:
        self.reward_names = tuple(reward_names)
        self._sums = torch.zeros(len(self.reward_names) + 6, device=device)

    def add(self, done: Tensor, reward_sums: Tensor, columns: Sequence[Tensor]) -> None:
        """Count the worlds, bool (world,), whose episode has ended; never waits for the device.

        Args:
            done: Worlds to count.
            reward_sums: Sum of every reward term over the episode, (world, term).
            columns: Steps, success, last distance [m], failure and contact overflow, each of shape (world,).
        """
        numbers = torch.stack([done.to(torch.float32), *(column.to(torch.float32) for column in columns)], dim=1)
        rows = torch.cat((reward_sums, numbers), dim=1)
        self._sums.add_(rows.masked_fill_(~done[:, None], 0.0).sum(dim=0))

    def pop(self) -> dict[str, float]:
        """What ``SoftEnv.pop_episode_log`` returns."""
        *sums, episodes, length, success, distance, failed, overflowed = self._sums.tolist()
        self._sums.zero_()
        if episodes == 0.0:
            return {"episodes": 0.0}
        log = {"episodes": episodes, "return": sum(sums) / episodes, "length": length / episodes}
        log |= {"success": success / episodes, "distance": distance / episodes}
        log |= {"failed": failed / episodes, "overflowed": overflowed / episodes}
        return log | {f"reward/{name}": total / episodes for name, total in zip(self.reward_names, sums, strict=True)}
