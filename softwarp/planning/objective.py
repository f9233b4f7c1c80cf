"""What a planner maximises: an environment's step outcomes as rewards in [0, 1]."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict import TensorDictBase
from torch import Tensor

from softwarp.model.codes import Status

KINDS = ("reward", "distance")
_NEAREST = 1e-6  # m, least distance at the root that others are measured by


@dataclass(frozen=True)
class Objective:
    """Scaled rewards, and what an ended episode earns for ever.

    ``reward``: the task's reward r as (r - low) / (high - low), cut to [0, 1]. An episode that terminated earns what a
    reward of 0 becomes; this keeps the order of plans by the task's own discounted return.
    ``distance``: d0 / (d0 + d) with the distance d0 at the root; 1 for ever after success.

    Both: 0 for ever once the simulation failed or the time of the episode is over.
    """

    kind: str
    low: float  # least reward of a step
    high: float  # greatest reward of a step
    first_distance: float  # m, at the root

    @classmethod
    def of(cls, kind: str, bounds: tuple[float, float], distance: float) -> Objective:
        """An objective with checked values.

        Raises:
            ValueError: If there is no such kind or the bounds are in the wrong order.
        """
        if kind not in KINDS:
            raise ValueError(f"objective: must be one of {', '.join(KINDS)}, got {kind!r}")
        if not bounds[0] < bounds[1]:
            raise ValueError(f"reward_range: must be (low, high) with low < high, got {tuple(bounds)}")
        return cls(kind, bounds[0], bounds[1], max(distance, _NEAREST))

    def rewards(self, data: TensorDictBase) -> Tensor:
        """Rewards in [0, 1] of a step's outcome, shape (world,)."""
        if self.kind == "distance":
            value: Tensor = self.first_distance / (self.first_distance + data["distance"][:, 0])
        else:
            value = (data["reward"][:, 0] - self.low) / (self.high - self.low)
        failed = data["world_status"][:, 0] >= Status.NONFINITE
        scaled: Tensor = value.double().clamp(0.0, 1.0).masked_fill(failed, 0.0)
        return scaled

    def rest(self, data: TensorDictBase) -> Tensor:
        """Reward per step after the end, 0 where a world goes on, shape (world,)."""
        ended: Tensor = data["terminated"][:, 0] & (data["world_status"][:, 0] < Status.NONFINITE)
        if self.kind == "distance":
            ended = ended & data["success"][:, 0]
            return ended.double()
        nothing = min(max(-self.low / (self.high - self.low), 0.0), 1.0)
        return ended.double() * nothing
