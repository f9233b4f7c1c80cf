"""States taken out of a simulation: in memory, on disk, and back into any world of any batch of the same scene."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softwarp import checks, growth
from softwarp.io.atomic import atomic_path
from softwarp.io.bounded import DamagedFileError, parse_json, read_arrays
from softwarp.model.state import LATER

if TYPE_CHECKING:
    import torch

FORMAT = "softwarp-snapshot"
VERSION = 1
_TAKE_ANEW = "take it anew with this version"


@dataclass(frozen=True)
class Snapshot:
    """State, commands and parameters of some worlds.

    Attributes:
        fingerprint: Scene that the arrays belong to.
        precision: ``float32`` or ``float64``.
        arrays: Copies of all batched arrays, keyed ``container.name``, with the world axis first; what is equal in
            all worlds may be there once.
    """

    fingerprint: str
    precision: str
    arrays: dict[str, torch.Tensor]

    @property
    def num_worlds(self) -> int:
        """Worlds in the snapshot."""
        return int(next(iter(self.arrays.values())).shape[0])

    def contacts_held(self, room: int) -> int:
        """Contacts of the fullest world, told only where its arrays are longer than ``room``; else 0."""
        arrays = {name: self.arrays.get(f"state.{name}") for name in ("contact_pair", "contact_count")}
        known = {name: array for name, array in arrays.items() if array is not None and array.numel()}
        is_wider = len(known) == len(arrays) and known["contact_pair"].shape[-1] > room
        return growth.held(known) if is_wider else 0

    def with_room(self, room: int) -> Snapshot:
        """The same states in arrays with places for ``room`` contacts.

        Raises:
            ValueError: If a world holds more.
        """
        keys = {f"state.{name}": name for name in growth.contact_arrays()}
        other = [key for key in keys if key in self.arrays and self.arrays[key].ndim > 1]
        if room == 0 or all(self.arrays[key].shape[1] in (0, room) for key in other):
            return self
        held = self.contacts_held(room)
        if held > room:
            raise ValueError(
                f"snapshot: a world holds {held} contacts, this simulation has room for {room}; make room by "
                f"sim.grow_contacts({held}), or make it with contact_growth=True"
            )
        wide = {key: growth.fitted(keys[key], self.arrays[key], room) for key in other}
        return replace(self, arrays=self.arrays | wide)

    def check_scene(self, fingerprint: str, precision: str) -> None:
        """Refuse what belongs to another scene or precision.

        Raises:
            ValueError: Saying which.
        """
        if self.fingerprint != fingerprint:
            raise ValueError(
                "snapshot belongs to another scene (meshes, supports, cables, markers or materials differ); "
                "rebuild the scene it was taken from"
            )
        if self.precision != precision:
            raise ValueError(f"snapshot is in {self.precision}, this simulation in {precision}")

    def check_fit(self, fingerprint: str, precision: str, views: Mapping[str, torch.Tensor], count: int) -> None:
        """Refuse what cannot be put into worlds of a simulation; nothing is written.

        Args:
            fingerprint: Of the simulation's scene.
            precision: Of the simulation.
            views: Its arrays by name, shape (world, ...).
            count: Worlds to fill.

        Raises:
            ValueError: If the snapshot is of another scene, precision or version, is damaged, or holds neither one
                world nor ``count``; the message names the array at fault.
        """
        self.check_scene(fingerprint, precision)
        # What is empty here an older snapshot may not know, nor what was added later.
        known = {*self.arrays, *LATER}
        absent = [key for key, view in views.items() if key not in known and view.numel()]
        unknown = [key for key, value in self.arrays.items() if key not in views and value.numel()]
        if absent or unknown:
            wrong = f"holds {', '.join(unknown)}, which is unknown here"
            wrong = f"lacks {', '.join(absent)}" if absent else wrong
            raise ValueError(f"snapshot {wrong}: it is damaged or of another version of softwarp; {_TAKE_ANEW}")
        worlds = self.num_worlds
        for key, view in views.items():
            if view.numel() == 0 or key not in self.arrays:
                continue
            value = self.arrays[key]
            fits = value.ndim == view.ndim and value.shape[1:] == view.shape[1:] and value.shape[0] in (1, worlds)
            if not fits or value.dtype != view.dtype:
                raise ValueError(
                    f"snapshot: {key} must be {view.dtype} of shape {(worlds, *view.shape[1:])}, got {value.dtype} of "
                    f"shape {tuple(value.shape)}: it is damaged or of another version of softwarp; {_TAKE_ANEW}"
                )
        if worlds not in (1, count):
            raise ValueError(
                f"snapshot holds {worlds} worlds but {count} are to be restored; "
                "pass as many worlds, or a snapshot of one world"
            )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write an ``.npz`` file; an existing one is replaced only when the new one is complete.

        Raises:
            WriteError: If the file cannot be written there; the message says why.
        """
        header = {"format": FORMAT, "version": VERSION, "fingerprint": self.fingerprint, "precision": self.precision}
        arrays = {key: value.detach().cpu().numpy() for key, value in self.arrays.items()}
        with atomic_path(path) as scratch, scratch.open("wb") as stream:
            np.savez(stream, header=np.array(json.dumps(header)), **arrays)  # type: ignore[arg-type]

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Snapshot:
        """Read a file written by ``save``.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: If it is not a snapshot, is damaged, holds NaN, or comes from another version.
        """
        import torch

        target = Path(checks.path(path, "snapshot: path"))
        if not target.is_file():
            raise FileNotFoundError(f"snapshot {target} does not exist")
        try:
            arrays = read_arrays(target)
            header = _header(parse_json(str(arrays.pop("header"))))
            tensors = {key: torch.from_numpy(value) for key, value in arrays.items()}
            if not all(tensor.ndim for tensor in tensors.values()) or not tensors:
                raise DamagedFileError("an array has no worlds")
        except (DamagedFileError, KeyError, TypeError) as error:
            raise ValueError(f"{target} is not a complete softwarp snapshot ({error}); save it again") from error
        if header.get("format") != FORMAT:
            raise ValueError(f"{target} is not a softwarp snapshot")
        if header.get("version") != VERSION:
            raise ValueError(
                f"{target} has snapshot version {header.get('version')}, this softwarp reads {VERSION}; save it again"
            )
        undefined = [key for key, value in tensors.items() if value.is_floating_point() and value.isnan().any()]
        if undefined:
            raise ValueError(f"{target} holds NaN in {', '.join(undefined)}; take a snapshot of a sound state")
        return cls(str(header["fingerprint"]), str(header["precision"]), tensors)


def _header(content: Any) -> dict[str, Any]:
    """The header, if it says what it must.

    Raises:
        DamagedFileError: If it does not.
    """
    if not isinstance(content, dict) or not {"fingerprint", "precision"} <= content.keys():
        raise DamagedFileError("its header names no scene")
    return content
