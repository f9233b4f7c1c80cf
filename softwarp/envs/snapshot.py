"""Saved worlds of an environment, and how worlds are named."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from softwarp import checks
from softwarp.snapshot import Snapshot

Worlds = int | Sequence[int] | range | Tensor | None


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

    def of_worlds(self, worlds: Worlds) -> EnvSnapshot:
        """Some of its worlds alone.

        Args:
            worlds: Numbers, or a mask of bool, (world,).

        Raises:
            ValueError: If one was not saved.
        """
        every = self.tensors["step_count"]
        index = world_index(worlds, torch.ones(self.num_worlds, dtype=torch.bool, device=every.device))
        arrays = {
            name: array[index.to(array.device)] if len(array) > 1 else array for name, array in self.sim.arrays.items()
        }
        tensors = {name: tensor[index.to(tensor.device)] for name, tensor in self.tensors.items()}
        return replace(self, sim=replace(self.sim, arrays=arrays), tensors=tensors)

    def state_dict(self) -> dict[str, Any]:
        """Nothing but tensors and text, fit for ``torch.load(weights_only=True)``."""
        sim = {"fingerprint": self.sim.fingerprint, "precision": self.sim.precision, "arrays": self.sim.arrays}
        return {"env": self.env, "sim": sim, "tensors": self.tensors}

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any]) -> EnvSnapshot:
        """The snapshot that ``state_dict`` was taken of.

        Raises:
            ValueError: If it is something else.
        """
        try:
            sim, tensors = Snapshot(**state["sim"]), dict(state["tensors"])
            told = {"env": state["env"], "fingerprint": sim.fingerprint, "precision": sim.precision}
            arrays = [*sim.arrays.items(), *tensors.items()]
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"snapshot: not the state_dict of one ({type(error).__name__}: {error})") from error
        wrong = [name for name, text in told.items() if not isinstance(text, str)]
        wrong += [name for name, tensor in arrays if not isinstance(tensor, Tensor) or tensor.ndim == 0]
        if wrong or not sim.arrays or "step_count" not in tensors:
            raise ValueError(f"snapshot: not the state_dict of one ({', '.join(map(str, wrong)) or 'arrays'} missing)")
        return cls(state["env"], sim, tensors)

    def check_fit(self, env: str, world_state: Mapping[str, Tensor], count: int) -> None:
        """Raise ValueError if it cannot be put into ``count`` worlds of an environment that holds ``world_state``."""
        if self.env != env or _kinds(self.tensors) != _kinds(world_state):
            raise ValueError(f"snapshot of {self.env} does not fit this {env}; save one with the same options")
        if any(len(tensor) != self.num_worlds for tensor in self.tensors.values()):
            raise ValueError(f"snapshot of {self.env} is damaged: its tensors are of different numbers of worlds")
        if self.num_worlds not in (1, count):
            raise ValueError(f"snapshot holds {self.num_worlds} worlds, cannot fill {count}; give 1 or as many")


def _kinds(tensors: Mapping[str, Tensor]) -> dict[str, tuple[torch.dtype, torch.Size]]:
    """Type of each tensor, and its shape without the axis of worlds."""
    return {name: (tensor.dtype, tensor.shape[1:]) for name, tensor in tensors.items()}


def world_index(worlds: Worlds, every: Tensor) -> Tensor:
    """World numbers as an int64 tensor.

    Args:
        worlds: Numbers or a mask; None means all.
        every: True for each world there is, bool (world,), on the device wanted.

    Raises:
        ValueError: If a world does not exist or a mask has another shape.
    """
    count, device = len(every), every.device
    if worlds is None:
        return torch.arange(count, device=device)
    try:
        index = torch.as_tensor(list(worlds) if isinstance(worlds, range) else worlds, device=device)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise ValueError(checks.refusal("worlds", "be numbers of worlds or a mask", worlds)) from None
    if (index.is_floating_point() or index.is_complex()) and index.numel():
        raise ValueError(checks.refusal("worlds", "be numbers of worlds or a mask", worlds))
    if index.dtype == torch.bool:
        if index.shape != (count,):
            raise ValueError(f"a mask of worlds must have shape ({count},), got {tuple(index.shape)}")
        return torch.nonzero(index).flatten()
    index = index.reshape(-1).to(torch.int64)
    if index.numel() and not 0 <= int(index.min()) <= int(index.max()) < count:
        raise ValueError(f"worlds must lie in [0, {count - 1}], got {index.tolist()}")
    return index
