"""What reduces a body, and its file."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from softwarp.io.atomic import atomic_path
from softwarp.io.bounded import DamagedFileError, parse_json, read_arrays

FORMAT = "softwarp.reduction"
VERSION = 1
FloatArray = NDArray[np.float64]
_THIN = "membrane:"  # begins the names of membranes' weights in a file


class ReductionFileError(ValueError):
    """A file that holds no reduction, or one of another version."""


@dataclass(frozen=True)
class Reduction:
    """Modes of a soft body and the elements that stand for all, with the mesh that they belong to.

    Attributes:
        name: Name of the body.
        nodes: Mesh at rest [m], (node, 3).
        tets: Its tetrahedra, (tet, 4).
        modes: Displacements of all nodes, (mode, node, 3); orthonormal in mass, see ``Basis``.
        rigid: Rigid modes among the first ones.
        singular_values: Of the motion besides rigid modes [m].
        tet_weight: Weights of the tets; 0 for those left out, (tet,).
        membrane_weight: Weights of the triangles of every membrane on the body.
        report: Numbers of the training, for people: tolerances, residuals, held-out errors.
    """

    name: str
    nodes: FloatArray
    tets: NDArray[np.int32]
    modes: FloatArray
    rigid: int
    singular_values: FloatArray
    tet_weight: FloatArray
    membrane_weight: Mapping[str, FloatArray] = field(default_factory=dict)
    report: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse parts that do not fit each other."""
        nodes, tets = len(self.nodes), len(self.tets)
        wanted = {"nodes": (nodes, 3), "tets": (tets, 4), "modes": (len(self.modes), nodes, 3), "tet_weight": (tets,)}
        for name, shape in wanted.items():
            value = getattr(self, name)
            if value.shape != shape or not np.isfinite(value).all():
                raise ValueError(f"reduction {self.name!r}: {name} must be finite, of shape {shape}, got {value.shape}")
        if len(self.modes) == 0 or (self.tets.size and not 0 <= self.tets.min() <= self.tets.max() < nodes):
            raise ValueError(f"reduction {self.name!r}: it needs a mode, and tets of its {nodes} nodes")

    @property
    def singles(self) -> tuple[int, int]:
        """Tets and membrane triangles that count."""
        thin = sum(int((w > 0.0).sum()) for w in self.membrane_weight.values())
        return int((self.tet_weight > 0.0).sum()), thin

    @property
    def turns(self) -> bool:
        """Whether the body can turn as a whole by more than infinitesimal angles."""
        return False

    def everything(self) -> Self:
        """The same modes with all elements, each as it is: without hyper-reduction."""
        thin = {name: np.ones_like(w) for name, w in self.membrane_weight.items()}
        return type(self)(**{**vars(self), "tet_weight": np.ones(len(self.tets)), "membrane_weight": thin})

    def told(self) -> str:
        """A sentence or two for people."""
        tets, thin = self.singles
        triangles = sum(len(w) for w in self.membrane_weight.values())
        text = f"body {self.name!r}: {len(self.modes)} modes ({self.rigid} rigid) of {len(self.nodes)} nodes, "
        text += f"{tets} of {len(self.tets)} tets"
        return text + (f", {thin} of {triangles} membrane triangles" if triangles else "")

    def save(self, path: str | os.PathLike[str], *, compact: bool = False) -> None:
        """Write an ``.npz`` file, whole or not at all.

        Args:
            path: Of the file.
            compact: Modes in single precision, all of it compressed: half as large, modes orthonormal to 1e-7.

        Raises:
            WriteError: If it cannot be written.
        """
        about = {"format": FORMAT, "version": VERSION, "name": self.name, "rigid": self.rigid}
        about["report"] = dict(self.report)
        arrays: dict[str, Any] = {
            "nodes": self.nodes,
            "tets": self.tets,
            "modes": self.modes.astype(np.float32 if compact else np.float64),
            "singular_values": self.singular_values,
            "tet_weight": self.tet_weight,
        }
        arrays |= {_THIN + name: w for name, w in self.membrane_weight.items()}
        text = np.frombuffer(json.dumps(about).encode(), dtype=np.uint8)
        with atomic_path(path) as scratch, scratch.open("wb") as out:
            (np.savez_compressed if compact else np.savez)(out, about=text, **arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read a file of ``save``.

        Raises:
            ReductionFileError: If it is missing, damaged, of something else or of a later version.
        """
        source = Path(path)
        if not source.is_file():
            raise ReductionFileError(f"{source}: there is no such file; softwarp reduce env=... out={source} makes one")
        try:
            arrays = read_arrays(source)
            about = parse_json(arrays.pop("about").tobytes())
            if about.get("format") != FORMAT:
                raise ReductionFileError(f"{source}: it holds no reduction")
            if about["version"] > VERSION:
                raise ReductionFileError(
                    f"{source}: it has version {about['version']}, and this softwarp reads up to {VERSION}; update it, "
                    "or make the file again with softwarp reduce"
                )
            thin = {name.removeprefix(_THIN): w for name, w in arrays.items() if name.startswith(_THIN)}
            return cls(
                name=str(about["name"]),
                nodes=arrays["nodes"],
                tets=arrays["tets"].astype(np.int32),
                modes=arrays["modes"].astype(np.float64),
                rigid=int(about["rigid"]),
                singular_values=arrays["singular_values"],
                tet_weight=arrays["tet_weight"],
                membrane_weight=thin,
                report=dict(about["report"]),
            )
        except ReductionFileError:
            raise
        except (DamagedFileError, KeyError, TypeError, AttributeError, ValueError) as error:
            raise ReductionFileError(
                f"{source}: it is damaged or no reduction ({error}); make it again with softwarp reduce"
            ) from error
