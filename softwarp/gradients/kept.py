"""Solutions of steps that are kept for their adjoints. Theory: docs/theory/adjoint.md."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import warp as wp

from softwarp import interop
from softwarp.gradients.replayed import Replayed
from softwarp.solvers.adjoint import StepAdjoint
from softwarp.solvers.second_order_adjoint import SecondOrderAdjoint
from softwarp.solvers.solution import lies_elsewhere
from softwarp.threads import Workers

if TYPE_CHECKING:
    import torch

COPIED = 2  # adjoints of a place before its launches are recorded, which takes as long as some of them
MOST = 4096  # places with recordings of their own, some 30 kB for every eight worlds


class KeptSolutions:
    """What steps leave of their solution, in torch tensors, and how adjoints come by it.

    On a CPU the longest parts, L and A, are not put back to where steps have them, once adjoints have been taken a few
    times from the same place: launches are then recorded that read them there.

    Args:
        device: Warp device.
        pulls: Adjoint of each shard.
        workers: Threads for several shards.

    Attributes:
        nbytes: Of the solution of a step, of all shards [B].
    """

    def __init__(self, device: str, pulls: Sequence[StepAdjoint | SecondOrderAdjoint], workers: Workers | None) -> None:
        self._device, self._workers = device, workers
        self._pulls = [(pull, list(pull.solution)) for pull in pulls]
        self._parts = [wp.to_torch(array, requires_grad=False) for _, arrays in self._pulls for array in arrays]
        self.nbytes: int = sum(part.nbytes for part in self._parts)
        is_long = [
            any(part.ptr == getattr(holder, name).real.ptr for holder, name in pull.long_parts)
            for pull, parts in self._pulls
            if isinstance(pull, StepAdjoint)
            for part in parts
        ]
        self._long = [place for place, found in enumerate(is_long) if found]
        self._short = [place for place, found in enumerate(is_long) if not found]
        self._spare: list[list[list[torch.Tensor]]] = []
        self._uses: dict[Any, int] = {}
        self._launches: dict[Any, Replayed] = {}

    def room(self, count: int) -> list[list[torch.Tensor]]:
        """Room for the solutions of some steps."""
        for room in self._spare:
            if len(room) == count:
                self._spare = []
                return room
        self._uses, self._launches = {}, {}
        parts = [part.new_empty((count, *part.shape)).unbind(0) for part in self._parts]
        return [list(step) for step in zip(*parts, strict=True)]

    def give_back(self, room: list[list[torch.Tensor]]) -> None:
        """Room that may be taken again: touching new memory takes a system longer than copying into it."""
        self._spare = [room]

    def keep(self, solution: Sequence[torch.Tensor]) -> None:
        """Copy that of the last step."""
        interop.copy_all(solution, self._parts)

    def pull(
        self, key: tuple[bool, ...], launches: Sequence[Callable[[], None]], solution: Sequence[torch.Tensor]
    ) -> bool:
        """Take adjoints of a kept solution, from where its long parts are; False if it was put back for that instead.

        Args:
            key: Names the launches.
            launches: Adjoint of each shard.
            solution: Of the step.
        """
        at = (key, *(solution[place].data_ptr() for place in self._long))
        known = self._launches.get(at)
        if known is None and self._long and len(self._launches) < MOST:
            self._uses[at] = self._uses.get(at, 0) + 1
            if self._uses[at] > COPIED and interop.records(self._device):
                known = self._launches[at] = self._recorded(launches, solution)
        if known is None:
            interop.copy_all(self._parts, solution)
            return False
        interop.copy_all([self._parts[place] for place in self._short], [solution[place] for place in self._short])
        known()
        return True

    def _recorded(self, launches: Sequence[Callable[[], None]], solution: Sequence[torch.Tensor]) -> Replayed:
        """Launches that read long parts where they are kept."""
        rest, found = list(solution), []
        for (pull, own), launch in zip(self._pulls, launches, strict=True):
            parts, rest = rest[: len(own)], rest[len(own) :]
            if isinstance(pull, StepAdjoint):
                found.append(partial(_launch_there, pull, list(zip(own, parts, strict=True)), launch))
        return Replayed(self._device, found, self._workers, is_compiled=True)


def _launch_there(
    pull: StepAdjoint, parts: Sequence[tuple[wp.array, torch.Tensor]], launch: Callable[[], None]
) -> None:
    kept = [(own, part.data_ptr()) for own, part in parts]
    with lies_elsewhere(pull.shard.variant, pull.long_parts, kept):
        launch()
