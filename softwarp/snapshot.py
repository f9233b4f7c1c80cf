"""States taken out of a simulation: in memory, on disk, and back into any world of any batch of the same scene."""

from __future__ import annotations

import json
import os
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from softwarp import checks

if TYPE_CHECKING:
    import torch

FORMAT = "softwarp-snapshot"
VERSION = 1


@dataclass(frozen=True)
class Snapshot:
    """State, commands and parameters of some worlds.

    Attributes:
        fingerprint: Scene that the arrays belong to.
        precision: ``float32`` or ``float64``.
        arrays: Copies of all batched arrays, keyed ``container.name``, with the world axis first.
    """

    fingerprint: str
    precision: str
    arrays: dict[str, torch.Tensor]

    @property
    def num_worlds(self) -> int:
        """Worlds in the snapshot."""
        return int(next(iter(self.arrays.values())).shape[0])

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write an ``.npz`` file; an existing one is replaced only when the new one is complete.

        Raises:
            OSError: If the folder does not exist or cannot be written; the message names it.
        """
        target = Path(path)
        header = {"format": FORMAT, "version": VERSION, "fingerprint": self.fingerprint, "precision": self.precision}
        arrays = {key: value.detach().cpu().numpy() for key, value in self.arrays.items()}
        try:
            handle, temporary = tempfile.mkstemp(dir=target.parent, suffix=".tmp")
        except OSError as error:
            raise OSError(f"cannot write snapshot {target}: {error.strerror}; choose a writable folder") from error
        try:
            with os.fdopen(handle, "wb") as stream:
                np.savez(stream, header=np.array(json.dumps(header)), **arrays)  # type: ignore[arg-type]
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(temporary, target)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Snapshot:
        """Read a file written by ``save``.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: If it is not a snapshot, is damaged, or comes from a newer version.
        """
        import torch

        target = Path(checks.path(path, "snapshot: path"))
        if not target.is_file():
            raise FileNotFoundError(f"snapshot {target} does not exist")
        try:
            with np.load(target, allow_pickle=False) as data:
                header = json.loads(str(data["header"]))
                arrays = {key: torch.from_numpy(data[key]) for key in data.files if key != "header"}
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(f"{target} is not a complete softwarp snapshot ({error}); save it again") from error
        if header.get("format") != FORMAT:
            raise ValueError(f"{target} is not a softwarp snapshot")
        if header.get("version") != VERSION:
            raise ValueError(
                f"{target} has snapshot version {header.get('version')}, this softwarp reads {VERSION}; save it again"
            )
        return cls(header["fingerprint"], header["precision"], arrays)
