"""Saved worlds of an environment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from softwarp.snapshot import Snapshot


@dataclass(frozen=True)
class EnvSnapshot:
    """Everything that the future of some worlds depends on: simulator, timers, goals, random counters."""

    env: str
    sim: Snapshot
    tensors: dict[str, Tensor]

    @property
    def num_worlds(self) -> int:
        """How many worlds were saved."""
        return self.tensors["step_count"].shape[0]

    def state_dict(self) -> dict[str, Any]:
        """Nothing but tensors and text, fit for ``torch.load(weights_only=True)``."""
        sim = {"fingerprint": self.sim.fingerprint, "precision": self.sim.precision, "arrays": self.sim.arrays}
        return {"env": self.env, "sim": sim, "tensors": self.tensors}

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any]) -> EnvSnapshot:
        """The snapshot that ``state_dict`` was taken of."""
        return cls(state["env"], Snapshot(**state["sim"]), dict(state["tensors"]))

    def check_fit(self, env: str, world_state: Mapping[str, Tensor], count: int) -> None:
        """Raise ValueError if it cannot be put into ``count`` worlds of an environment that holds ``world_state``."""
        if self.env != env or _shapes(self.tensors) != _shapes(world_state):
            raise ValueError(f"snapshot of {self.env} does not fit this {env}; save one with the same options")
        if self.num_worlds not in (1, count):
            raise ValueError(f"snapshot holds {self.num_worlds} worlds, cannot fill {count}; give 1 or as many")


def _shapes(tensors: Mapping[str, Tensor]) -> dict[str, torch.Size]:
    """Shape of each tensor without the axis of worlds."""
    return {name: tensor.shape[1:] for name, tensor in tensors.items()}
