"""One environment whose worlds are divided among devices, behind the calls of one.

    env = SplitEnv(lambda device, worlds: make("Trunk", num_worlds=worlds, device=device), ["cuda:0", "cuda:1"], 4096)
    run_episodes(env, policy, seed=0)

The parts are environments of their own, stepped side by side; what they tell lies end to end on the first device, where
the policy acts for all worlds at once. World i draws what world i of a single environment draws, so the episodes are
those of one device, to the bit where the devices are alike and take the same solver path.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from softwarp import checks
from softwarp.envs.base import SoftEnv
from softwarp.threads import Workers


class SplitEnv:
    """Worlds of one task on several devices.

    It has what running episodes takes: ``batch_size``, ``device``, ``set_seed``, ``reset``, ``step`` and
    ``maybe_reset``; specs are those of ``parts[0]``, for fewer worlds.

    Args:
        make: Called with a device and a number of worlds, for every part.
        devices: One part each; a name may stand there twice.
        num_worlds: Of all parts together. The first ones have one more where they cannot be divided evenly.

    Attributes:
        parts: The environments, in the order of the worlds.

    Raises:
        ValueError: If there are no devices, or more of them than worlds.
    """

    def __init__(self, make: Callable[[str, int], SoftEnv], devices: Sequence[str], num_worlds: int) -> None:
        count = len(devices)
        if not 1 <= count <= checks.count(num_worlds, "SplitEnv: num_worlds"):
            raise ValueError(f"devices: {count} for {num_worlds} worlds; give each a world at least")
        sizes = [num_worlds // count + (place < num_worlds % count) for place in range(count)]
        self.parts = [make(device, size) for device, size in zip(devices, sizes, strict=True)]
        ends = [sum(sizes[: place + 1]) for place in range(count)]
        self._slices = [slice(end - size, end) for size, end in zip(sizes, ends, strict=True)]
        for part, own in zip(self.parts, self._slices, strict=True):
            part.first_world = own.start
        self.num_worlds = num_worlds
        self.batch_size = torch.Size([num_worlds])
        self.device = self.parts[0].device
        self._workers = Workers(count)

    def set_seed(self, seed: int) -> None:
        """World i draws from stream i of ``seed``, on whichever device it is."""
        for part in self.parts:
            part.set_seed(seed)

    def reset(self) -> TensorDictBase:
        """Start an episode in every world."""
        return self._together(lambda part, _: part.reset(), None)

    def step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Carry ``action`` (world, ...) out; where it led is put under ``next``."""
        given = TensorDict({"action": tensordict["action"]}, batch_size=self.batch_size)
        return tensordict.set("next", self._together(lambda part, own: part.step(own)["next"], given))

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Start episodes where some have ended."""
        return self._together(lambda part, own: part.maybe_reset(own), tensordict)

    def split(self, policy_of: Callable[[SoftEnv], Callable[[TensorDictBase], TensorDictBase]]) -> Any:
        """One policy out of those that know their environment, as hand-written ones do, each for its own worlds."""
        policies = [policy_of(part) for part in self.parts]

        def policy(tensordict: TensorDictBase) -> TensorDictBase:
            actions: list[Tensor] = []
            for part, own, act in zip(self.parts, self._slices, policies, strict=True):
                actions.append(act(tensordict[own].to(part.device))["action"].to(self.device))
            return tensordict.set("action", torch.cat(actions))

        return policy

    def _together(self, work: Callable[[SoftEnv, Any], TensorDictBase], given: TensorDictBase | None) -> TensorDictBase:
        """What all parts make of their share, end to end on the first device."""
        told: list[Any] = [None] * len(self.parts)

        @torch.no_grad()
        def one(place: int) -> None:
            part = self.parts[place]
            own = None if given is None else given[self._slices[place]].to(part.device)
            told[place] = work(part, own).to(self.device)

        self._workers.run(one, range(len(self.parts)), helping=True)
        shared = set(told[0].keys()).intersection(*(part.keys() for part in told))
        return torch.cat([part.select(*shared) for part in told])
