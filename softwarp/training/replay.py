"""Replay of past transitions: a ring in the memory of the environment's device, sampled evenly or by priority.

Priorities p_i = (|error_i| + eps)^alpha; transition i is drawn with probability p_i / sum p and its loss weighted by
(N p_i / sum p)^-beta, divided by the largest weight of the batch. They need the trees of TorchRL's compiled extension;
without it sampling is even.
Reference: Schaul, Quan, Antonoglou and Silver (2016), Prioritized Experience Replay.
"""

import logging
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from softwarp import interop
from softwarp.model.memory import require

ALPHA, BETA, EPSILON = 0.6, 0.4, 1e-6  # as in the reference

log = logging.getLogger(__name__)


def has_priority_trees() -> bool:
    """Whether TorchRL's compiled extension is there; its build depends on the version of Torch."""
    try:
        from torchrl._torchrl import SumSegmentTreeFp32  # noqa: F401
    except ImportError:
        return False
    return True


class Replay:
    """The last ``capacity`` transitions."""

    def __init__(self, capacity: int, example: TensorDictBase, *, prioritized: bool = False) -> None:
        """Allocate.

        Args:
            capacity: Transitions that are kept.
            example: Transitions whose keys, shapes and types are those of all later ones, batch (n,).
            prioritized: Draw those with large errors more often, where TorchRL's extension is present.

        Raises:
            MemoryError: If so many do not fit on the device; the message tells how many do.
        """
        self.capacity = capacity
        self.device = example.device
        self.data = TensorDict({}, [capacity], device=example.device)
        parts = [example[key] for key in example.keys(True, True)]
        needed = capacity * sum(part.shape[1:].numel() * part.element_size() for part in parts)
        require(needed, example.device or "cpu", "the replay", capacity, "transitions", interop.empty_cache)
        for key in example.keys(True, True):
            self.data.set(key, example[key].new_zeros((capacity, *example[key].shape[1:])))
        self.size = 0
        self.cursor = 0
        self.largest = 1.0  # priority that new transitions start with
        self.tree: Any = None
        if prioritized and has_priority_trees():
            from torchrl._torchrl import SumSegmentTreeFp32

            self.tree = SumSegmentTreeFp32(capacity)
            log.info("replay: by priority, %d transitions", capacity)
        elif prioritized:
            log.warning(
                "replay: TorchRL's compiled extension does not fit this version of Torch, so transitions are drawn "
                "evenly and not by priority; install matching versions of torchrl and torch to have priorities"
            )

    def add(self, transitions: TensorDictBase) -> None:
        """Append transitions (n,), overwriting the oldest ones."""
        count = min(len(transitions), self.capacity)
        index = (self.cursor + torch.arange(count, device=self.device)) % self.capacity
        self.data[index] = transitions[-count:].select(*self.data.keys(True, True))
        self.cursor = (self.cursor + count) % self.capacity
        self.size = min(self.size + count, self.capacity)
        if self.tree is not None:
            self.tree[index.cpu()] = torch.full((count,), self.largest)

    def sample(self, count: int) -> TensorDictBase:
        """Transitions (count,), with ``index``, and ``priority_weight`` where drawn by priority."""
        if self.tree is None:
            index = torch.randint(self.size, (count,), device=self.device)
            return self.data[index].set("index", index)
        total = self.tree.query(0, self.capacity)
        # The tree gives a number, not a tensor, where one is asked for.
        found = torch.as_tensor(self.tree.scan_lower_bound(torch.rand(count) * total)).reshape(count)
        found = found.clamp_(max=self.size - 1)
        priority = torch.as_tensor(self.tree[found]).reshape(count)
        weight = (self.size * priority / total).clamp_min(torch.finfo(torch.float32).tiny).pow(-BETA)
        index = found.to(self.device)
        return self.data[index].set("index", index).set("priority_weight", (weight / weight.max()).to(self.device))

    def prioritize(self, index: Tensor, error: Tensor) -> None:
        """Tell the errors of transitions that were sampled."""
        if self.tree is not None:
            priority = (error.detach().abs() + EPSILON).pow(ALPHA).cpu()
            self.tree[index.cpu()] = priority
            self.largest = max(self.largest, float(priority.max()))

    def state_dict(self, *, transitions: bool = True) -> dict[str, Any]:
        """Everything, or only what an empty replay holds."""
        size = self.size if transitions else 0
        state: dict[str, Any] = {
            "data": {_text(key): self.data[key][:size].clone() for key in self.data.keys(True, True)},
            "size": size,
            "cursor": self.cursor if transitions else 0,
            "largest": self.largest,
        }
        if self.tree is not None:
            state["priority"] = torch.as_tensor(self.tree[torch.arange(size)]) if size else torch.zeros(0)
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where :meth:`state_dict` was taken.

        Raises:
            ValueError: If it does not fit, or its priorities cannot be kept here.
        """
        if state["size"] > self.capacity:
            raise ValueError(f"replay: {state['size']} transitions do not fit a capacity of {self.capacity}")
        if ("priority" in state) != (self.tree is not None):
            raise ValueError("replay: saved with priorities and restored without, or the other way round")
        self.size, self.cursor, self.largest = state["size"], state["cursor"] % self.capacity, state["largest"]
        for key in self.data.keys(True, True):
            self.data[key][: self.size] = state["data"][_text(key)]
        if self.tree is not None and self.size:
            self.tree[torch.arange(self.size)] = state["priority"]


def _text(key: str | tuple[str, ...]) -> str:
    return key if isinstance(key, str) else "/".join(key)
