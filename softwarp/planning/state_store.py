"""States of tree nodes in one block of memory: packed rows of bytes on the environment's device.

A row holds what steps change: the simulator's state and commands and the environment's own tensors, random counters
included. Parameters of the worlds (``params.*``) never change in an episode and are kept once, with the root. Rows live
on the device of the worlds, so that saving and loading are copies within one memory.

The block never grows. When it is full, rows of states that no step was taken from are overwritten, the oldest first;
then those of others; row 0, the root, stays. So what was overwritten is mostly one step away from a kept state: it is
simulated anew from its nearest kept ancestor, with the same bits, see ``EnvModel``.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from dataclasses import dataclass

import torch
from torch import Tensor

from softwarp import interop
from softwarp.envs.snapshot import EnvSnapshot
from softwarp.model.memory import require
from softwarp.snapshot import Snapshot

_CONSTANT = "params."


@dataclass(frozen=True)
class _Field:
    """Where an array lies in a row."""

    key: str
    dtype: torch.dtype
    shape: torch.Size  # of one world
    begin: int  # byte
    end: int


class StateStore:
    """Rows of packed states.

    Args:
        root: Snapshot of the one world that planning starts from.
        memory: Bytes that the rows may take.
        least: Rows that there have to be at least, the root's included.

    Raises:
        ValueError: If ``memory`` is too small for ``least`` rows.
        MemoryError: If it is more than the device has free.
    """

    def __init__(self, root: EnvSnapshot, *, memory: int, least: int) -> None:
        self.fields = _layout(root)
        self.row_bytes = self.fields[-1].end
        self.rows = memory // self.row_bytes
        if self.rows < least:
            raise ValueError(
                f"states: {memory} bytes hold {self.rows} states of {self.row_bytes} bytes, planning needs {least}; "
                f"give memory of at least {least * self.row_bytes / 2**20:.3g} MiB"
            )
        device = root.tensors["step_count"].device
        asked = f"memory of {memory / 2**20:.6g} MiB"
        require(self.rows * self.row_bytes, device, asked, self.rows, "states", interop.empty_cache)
        self._block = torch.empty((self.rows, self.row_bytes), dtype=torch.uint8, device=device)
        self.set_root(root)

    def set_root(self, root: EnvSnapshot) -> None:
        """Forget all rows and keep ``root`` in row 0."""
        self._root = root
        self._block[0] = self.pack(root)[0]
        self._owner = [-1] * self.rows  # state that a row belongs to
        self._unused = 1  # first row that was never taken
        self._leaves: OrderedDict[int, None] = OrderedDict()  # rows to overwrite first, the oldest in front
        self._parents: OrderedDict[int, None] = OrderedDict()

    def fits(self, root: EnvSnapshot) -> bool:
        """Whether rows have the layout of ``root``."""
        return _layout(root) == self.fields

    def pack(self, snapshot: EnvSnapshot) -> Tensor:
        """Rows of bytes, shape (world, row_bytes)."""
        arrays = _arrays(snapshot)
        count = snapshot.num_worlds
        parts = [arrays[f.key].reshape(count, -1).contiguous().view(torch.uint8) for f in self.fields]
        return torch.cat(parts, dim=1)

    def take(self, owners: list[int]) -> tuple[list[int], list[int]]:
        """Rows for new states, and the states whose rows they were so far.

        Args:
            owners: Names of the new states; fewer than there are rows.
        """
        rows: list[int] = []
        lost: list[int] = []
        for _ in owners:
            if self._unused < self.rows:
                row, self._unused = self._unused, self._unused + 1
            else:
                row, _ = (self._leaves or self._parents).popitem(last=False)
                lost.append(self._owner[row])
            rows.append(row)
        for row, owner in zip(rows, owners, strict=True):
            self._owner[row] = owner
            self._leaves[row] = None
        return rows, lost

    def keep(self, rows: list[int]) -> None:
        """Overwrite these rows after all others: steps are taken from their states."""
        for row in rows:
            if row in self._leaves:
                del self._leaves[row]
                self._parents[row] = None

    def save(self, rows: list[int], snapshot: EnvSnapshot) -> None:
        """Keep the worlds of a snapshot in rows."""
        self._block[torch.tensor(rows, device=self._block.device)] = self.pack(snapshot)

    def load(self, rows: list[int]) -> EnvSnapshot:
        """Snapshot of the states in rows, a world each; parameters are the root's."""
        block = self._block[torch.tensor(rows, device=self._block.device)]
        arrays = {key: value for key, value in self._root.sim.arrays.items() if key.startswith(_CONSTANT)}
        tensors: dict[str, Tensor] = {}
        for f in self.fields:
            part = block[:, f.begin : f.end].clone(memory_format=torch.contiguous_format)
            value = part.view(f.dtype).reshape(len(rows), *f.shape)
            group, _, name = f.key.partition(":")
            (arrays if group == "sim" else tensors)[name] = value
        empty = {key: value for key, value in self._root.sim.arrays.items() if value.numel() == 0}
        arrays |= {key: value.expand(len(rows), *value.shape[1:]) for key, value in empty.items()}
        sim = self._root.sim
        ordered = {key: arrays[key] for key in sim.arrays}
        return EnvSnapshot(self._root.env, Snapshot(sim.fingerprint, sim.precision, ordered), tensors)


def digests(snapshot: EnvSnapshot) -> list[str]:
    """Fingerprint of every world's state, equal where and only where all bytes that steps change are equal."""
    arrays = _arrays(snapshot)
    count = snapshot.num_worlds
    keys = sorted(key for key, value in arrays.items() if value.numel())
    parts = [arrays[key].reshape(count, -1).contiguous().view(torch.uint8) for key in keys]
    rows = torch.cat(parts, dim=1).cpu().numpy()
    return [hashlib.sha256(row.tobytes()).hexdigest()[:16] for row in rows]


def _arrays(snapshot: EnvSnapshot) -> dict[str, Tensor]:
    """What a step may change, with the world axis first."""
    arrays = {f"sim:{key}": v for key, v in snapshot.sim.arrays.items() if not key.startswith(_CONSTANT)}
    return arrays | {f"env:{key}": value for key, value in snapshot.tensors.items()}


def _layout(snapshot: EnvSnapshot) -> list[_Field]:
    fields: list[_Field] = []
    begin = 0
    for key, value in _arrays(snapshot).items():
        size = value[0].numel() * value.element_size()
        if size:
            fields.append(_Field(key, value.dtype, value.shape[1:], begin, begin + size))
            begin += size
    return fields
