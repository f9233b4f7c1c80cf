"""What reduces a body, and its file."""

from __future__ import annotations

import hashlib
import json
import operator
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from softwarp import checks
from softwarp.io.atomic import atomic_path
from softwarp.io.bounded import DamagedFileError, parse_json, read_arrays
from softwarp.reduction.basis import deforming
from softwarp.reduction.packing import RESOLUTION, pack, unpack
from softwarp.remembered import Remembered

FORMAT = "softwarp.reduction"
VERSION = 4  # 4: quadratic elements; 3: a floating frame; 2: packed modes, of a mesh that the file does not hold
FIRST_VERSION = 1
FIXED_VERSION, FLOATING_VERSION = 2, 3  # of files that earlier versions of softwarp read too
MOST_RIGID = 6
ORTHONORMAL = 1e-2  # how far products of modes in mass may be from those of orthonormal ones
SAME = 1e-6  # of the body's size: how far nodes of the same mesh may be apart
FloatArray = NDArray[np.float64]
Frame = Literal["fixed", "floating"]
FRAMES: tuple[Frame, ...] = ("fixed", "floating")
Element = Literal["p1", "p2"]
ELEMENTS: tuple[Element, ...] = ("p1", "p2")
PIECES, POINTS = 8, 4  # linear tets between the nodes of a quadratic element, and its Gauss points
_THIN = "membrane:"  # begins the names of membranes' weights in a file
_before: Remembered[FloatArray] = Remembered(4)  # modes of compact files, and products of modes in mass


class ReductionFileError(ValueError):
    """A file that holds no reduction, or one of another version."""


class Mesh(Protocol):
    """What ``load`` reads of a mesh, as ``softwarp.meshing.SolidMesh`` has it."""

    @property
    def nodes(self) -> FloatArray:
        """Positions [m], (node, 3)."""

    @property
    def tets(self) -> NDArray[np.int32]:
        """Corners, (tet, 4)."""


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
        tet_weight: Weights of the tets; 0 for those left out, (tet,). Of quadratic elements those of their Gauss
            points, four of each.
        membrane_weight: Weights of the triangles of every membrane on the body.
        report: Numbers of the training, for people: tolerances, residuals, held-out errors.
        share: Part of the body's mass at every node, (node,); None in files of version 1, which do not tell it.
        frame: ``fixed``, or ``floating``: the modes live in axes that move and turn with the body, which six rigid
            modes beside these do.
        element: ``p1``, or ``p2`` for quadratic ones; ``tets`` then has the eight pieces of each.
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
    share: FloatArray | None = None
    frame: Frame = "fixed"
    element: Element = "p1"

    def __post_init__(self) -> None:
        """Refuse parts that do not fit each other."""
        nodes, tets = len(self.nodes), len(self.tets)
        checks.choice(self.element, f"reduction {self.name!r}: element", ELEMENTS)
        wanted = {"nodes": (nodes, 3), "tets": (tets, 4), "modes": (len(self.modes), nodes, 3)}
        wanted["tet_weight"] = (self.element_count,)
        if self.share is not None:
            wanted["share"] = (nodes,)
        wanted["singular_values"] = (self.singular_values.size,)
        parts = [(name, getattr(self, name), shape) for name, shape in wanted.items()]
        parts += [(f"weights of membrane {name!r}", w, (w.size,)) for name, w in self.membrane_weight.items()]
        for name, value, shape in parts:
            if value.shape != shape or not np.isfinite(value).all():
                raise ValueError(f"reduction {self.name!r}: {name} must be finite, of shape {shape}, got {value.shape}")
        if not isinstance(self.name, str) or not self.name:
            raise ValueError(f"reduction {self.name!r}: name must be that of a body")
        checks.choice(self.frame, f"reduction {self.name!r}: frame", FRAMES)
        self._check_numbers()
        if self.turns and self.rigid:
            raise ValueError(
                f"reduction {self.name!r}: a floating frame moves the body rigidly itself, and {self.rigid} modes are "
                "rigid; leave them out"
            )
        if self.turns and self.element == "p2":
            raise ValueError(f"reduction {self.name!r}: quadratic elements ('p2') have no floating frame")
        if len(self.modes) == 0 or (self.tets.size and not 0 <= self.tets.min() <= self.tets.max() < nodes):
            raise ValueError(f"reduction {self.name!r}: it needs a mode, and tets of its {nodes} nodes")

    def __repr__(self) -> str:
        """What it is of and how large; its arrays are for whoever asks for them."""
        kept = int(np.count_nonzero(self.tet_weight))
        of = "elements" if self.element == "p1" else "Gauss points"
        return (
            f"Reduction of body {self.name!r}: {len(self.modes)} modes of {len(self.nodes)} nodes in a {self.frame} "
            f"frame, {kept} of {self.tet_weight.size} {of}"
        )

    def _check_numbers(self) -> None:
        """Refuse counts and masses that no body has."""
        label, modes = f"reduction {self.name!r}", len(self.modes)
        if not 0 <= self.rigid <= min(MOST_RIGID, modes):
            raise ValueError(
                f"{label}: rigid must be in [0, {min(MOST_RIGID, modes)}], modes among its {modes}, got {self.rigid}"
            )
        if self.share is not None and (self.share.min() < 0.0 or abs(self.share.sum() - 1.0) > 1e-3):
            raise ValueError(
                f"{label}: share must be parts of the mass at nodes that sum to 1, got {self.share.sum():g}"
            )

    @property
    def singles(self) -> tuple[int, int]:
        """Tets and membrane triangles that count."""
        thin = sum(int((w > 0.0).sum()) for w in self.membrane_weight.values())
        return int((self.tet_weight > 0.0).sum()), thin

    @property
    def element_count(self) -> int:
        """Tets, or Gauss points of quadratic ones."""
        return len(self.tets) if self.element == "p1" else POINTS * (len(self.tets) // PIECES)

    @property
    def what(self) -> str:
        """Name of what has weights."""
        return "tets" if self.element == "p1" else "Gauss points"

    @property
    def places(self) -> FloatArray:
        """Where they are at rest [m], (element, 3); of a Gauss point the middle of the piece at its corner."""
        pieces = self.tets if self.element == "p1" else self.tets.reshape(-1, PIECES, 4)[:, :POINTS].reshape(-1, 4)
        return np.asarray(self.nodes[pieces].mean(axis=1))

    @property
    def turns(self) -> bool:
        """Whether the body can turn as a whole by more than infinitesimal angles: in a floating frame."""
        return self.frame == "floating"

    def everything(self) -> Self:
        """The same modes with all elements, each as it is: without hyper-reduction."""
        thin = {name: np.ones_like(w) for name, w in self.membrane_weight.items()}
        return type(self)(**{**vars(self), "tet_weight": np.ones(self.element_count), "membrane_weight": thin})

    def floated(self) -> Self:
        """The same in a floating frame: modes without rigid motion, those left out that were nothing else.

        Good for a body that hardly turned while it was trained; its modes of deformation are what they were.

        Raises:
            ValueError: If the nodes' masses are not known.
        """
        if self.turns:
            return self
        if self.share is None:
            raise ValueError(f"reduction {self.name!r}: it does not know the nodes' masses; train it again")
        modes, kept = deforming(self.modes, self.nodes, self.share)
        report = dict(self.report)
        if "amplitudes" in report:
            report["amplitudes"] = [report["amplitudes"][k] for k in kept]
        changed = {"modes": modes, "rigid": 0, "frame": "floating", "report": report}
        return type(self)(**{**vars(self), **changed})

    def told(self) -> str:
        """A sentence or two for people."""
        tets, thin = self.singles
        triangles = sum(len(w) for w in self.membrane_weight.values())
        text = f"body {self.name!r}: {len(self.modes)} modes ({self._rigid_told()}) of {len(self.nodes)} nodes, "
        text += f"{tets} of {self.element_count} {self.what}"
        return text + (f", {thin} of {triangles} membrane triangles" if triangles else "")

    def _rigid_told(self) -> str:
        return "in a floating frame" if self.turns else f"{self.rigid} rigid"

    def save(self, path: str | os.PathLike[str], *, compact: bool = False, resolution: float = RESOLUTION) -> None:
        """Write an ``.npz`` file, whole or not at all.

        Args:
            path: Of the file.
            compact: Modes to ``resolution`` of the motion that they were made from, of a symmetric body one half, and
                of the mesh what tells it from others: a tenth as large. ``load`` then needs the mesh.
            resolution: Of a compact file's modes [m].

        Raises:
            ValueError: If it is to be compact and the masses are not known, or the resolution is not positive.
            WriteError: If it cannot be written.
        """
        version = FLOATING_VERSION if self.turns else FIXED_VERSION
        version = version if self.element == "p1" else VERSION
        about = {"format": FORMAT, "version": version, "name": self.name, "rigid": self.rigid, "frame": self.frame}
        about |= {} if self.element == "p1" else {"element": self.element}
        about["report"] = dict(self.report)
        arrays: dict[str, Any] = {"singular_values": self.singular_values, "tet_weight": self.tet_weight}
        arrays |= {_THIN + name: w for name, w in self.membrane_weight.items()}
        if self.share is not None:
            arrays["share"] = self.share
        checks.number(resolution, "resolution", above=0.0)
        if compact:
            if self.share is None:
                raise ValueError(f"reduction {self.name!r}: it does not know the nodes' masses; train it again")
            about["mesh"] = _digest(self.tets)
            packed = pack(self.modes[self.rigid :], self._sizes(), self.nodes, resolution)
            arrays |= {"rigid_modes": self.modes[: self.rigid], "nodes": self.nodes.astype(np.float32), **packed}
        else:
            arrays |= {"nodes": self.nodes, "tets": self.tets, "modes": self.modes}
        about["digest"] = _digest_of(about, arrays)
        text = np.frombuffer(json.dumps(about).encode(), dtype=np.uint8)
        with atomic_path(path) as scratch, scratch.open("wb") as out:
            (np.savez_compressed if compact else np.savez)(out, about=text, **arrays)

    def _sizes(self) -> list[float] | None:
        """How large the amplitudes of modes besides rigid ones were [m]."""
        told = self.report.get("amplitudes")
        return None if told is None or len(told) != len(self.modes) else list(told[self.rigid :])

    @classmethod
    def load(cls, path: str | os.PathLike[str], mesh: Mesh | None = None) -> Self:
        """Read a file of ``save``.

        Args:
            path: Of the file.
            mesh: Of the body, for a compact file, which does not hold it.

        Raises:
            ReductionFileError: If it is missing, damaged, of something else, of a later version or of another mesh, or
                needs a mesh that was not given.
        """
        source = Path(path)
        arrays, about = _read(source)
        try:
            nodes, tets, modes = arrays["nodes"], arrays.get("tets"), arrays.get("modes")
            if tets is None or modes is None:
                nodes, tets = _given(source, about, nodes, mesh)
                modes = _unpacked(arrays, nodes)
            thin = {name.removeprefix(_THIN): w for name, w in arrays.items() if name.startswith(_THIN)}
            found = cls(
                name=about["name"],
                nodes=nodes,
                tets=tets.astype(np.int32),
                modes=modes.astype(np.float64),
                rigid=operator.index(about["rigid"]),
                singular_values=arrays["singular_values"],
                tet_weight=arrays["tet_weight"],
                membrane_weight=thin,
                report=dict(about["report"]),
                share=arrays.get("share"),
                frame=about.get("frame", "fixed"),
                element=about.get("element", "p1"),
            )
            _check_whole(source, about, arrays, modes)
            return found
        except ReductionFileError:
            raise
        except (KeyError, TypeError, AttributeError, ValueError, IndexError) as error:
            raise _damaged(source, error) from error


def read_about(path: str | os.PathLike[str]) -> dict[str, Any]:
    """What a file of ``Reduction.save`` tells without its modes: ``name`` of the body, ``report``.

    Raises:
        ReductionFileError: If it is missing, damaged, of something else or of a later version.
    """
    source = Path(path)
    about = _read(source)[1]
    if not isinstance(about.get("name"), str) or not isinstance(about.get("report"), dict):
        raise _damaged(source, "it has no name or report")
    return about


def _read(source: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Arrays of a file, and what it tells of them."""
    if not source.is_file():
        raise ReductionFileError(f"{source}: there is no such file; softwarp reduce env=... out={source} makes one")
    try:
        arrays = read_arrays(source)
        about = parse_json(arrays.pop("about").tobytes())
        if about.get("format") != FORMAT:
            raise ReductionFileError(f"{source}: it holds no reduction")
        if operator.index(about["version"]) < FIRST_VERSION:
            raise _damaged(source, f"version {about['version']}, below {FIRST_VERSION}")
        if about["version"] > VERSION:
            raise ReductionFileError(
                f"{source}: it has version {about['version']}, and this softwarp reads up to {VERSION}; update it, "
                "or make the file again with softwarp reduce"
            )
    except ReductionFileError:
        raise
    except (DamagedFileError, KeyError, TypeError, AttributeError, ValueError) as error:
        raise _damaged(source, error) from error
    return arrays, about


def _damaged(source: Path, error: object) -> ReductionFileError:
    return ReductionFileError(f"{source}: it is damaged or no reduction ({error}); make it again with softwarp reduce")


def _given(
    source: Path, about: Mapping[str, Any], nodes: NDArray[Any], mesh: Mesh | None
) -> tuple[FloatArray, NDArray[np.int32]]:
    """Mesh that was given for a file without one, if it is the one that the file belongs to."""
    if mesh is None:
        raise ReductionFileError(
            f"{source}: it does not hold the mesh of body {about['name']!r}; give it: Reduction.load(path, mesh)"
        )
    ours, tets = np.asarray(mesh.nodes, dtype=np.float64), np.asarray(mesh.tets, dtype=np.int32)
    size = float(np.ptp(nodes, axis=0).max())
    if ours.shape != nodes.shape or np.abs(ours - nodes).max() > SAME * size or _digest(tets) != about["mesh"]:
        raise ReductionFileError(
            f"{source}: the reduction belongs to another mesh of body {about['name']!r}, of {len(nodes)} nodes; the "
            f"one here has {len(ours)} nodes and {len(tets)} tets; train it for this mesh"
        )
    return ours, tets


def _unpacked(arrays: Mapping[str, NDArray[Any]], nodes: FloatArray) -> FloatArray:
    """Modes of a compact file."""
    rigid, share = arrays["rigid_modes"].reshape(-1, *nodes.shape), arrays["share"]
    given = arrays["unit"], arrays["parity"], arrays["planes"], nodes, rigid, share
    return _before(lambda: unpack(*given), *given).copy()


def _digest_of(about: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> str:
    """Of all that a file holds, but for this."""
    told = {key: value for key, value in about.items() if key != "digest"}
    found = hashlib.sha256(json.dumps(told, sort_keys=True).encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        found.update(f"{name} {array.dtype.str} {array.shape}".encode())
        found.update(array.tobytes())
    return found.hexdigest()


def _check_whole(
    source: Path, about: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], modes: NDArray[Any]
) -> None:
    """Refuse a file of which something was cut off or changed.

    Older files, without a digest, are known by what their report tells of the modes, and by their products in mass.
    """
    if "digest" in about and about["digest"] != _digest_of(about, arrays):
        raise _damaged(source, "its arrays are not those that were saved: something was cut off, added or changed")
    sizes = dict(about["report"]).get("amplitudes")
    if sizes is not None and len(sizes) != len(modes):
        raise _damaged(source, f"it was made with {len(sizes)} modes and holds {len(modes)}")
    share = arrays.get("share")
    if "digest" in about or share is None or share.shape != modes.shape[1:2]:
        return
    products = _before(lambda: np.einsum("inx,n,jnx->ij", modes, share, modes, optimize=True), modes, share)
    wrong = float(np.abs(products - np.eye(len(modes))).max())
    if not wrong <= ORTHONORMAL:
        raise _damaged(source, f"its modes are not orthonormal in mass, by {wrong:.2g}")


def _digest(tets: NDArray[np.int32]) -> str:
    return hashlib.sha256(np.ascontiguousarray(tets, dtype="<i4").tobytes()).hexdigest()
