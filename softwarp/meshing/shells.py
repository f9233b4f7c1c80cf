"""Surfaces to be filled: what users may pass for one, and the shells it falls into, each closed, oriented and named."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from softwarp import checks
from softwarp.meshing.surface_files import SURFACE_FILES, read_triangles
from softwarp.meshing.surfaces import check_closed, surface_parts, surface_volume, winding
from softwarp.meshing.tets import FloatArray, IntArray, MeshError, SurfaceMesh, TetMesh, compact, weld

PROBES = 5  # vertices of a shell that are asked which other shells they lie in
ACCEPTED = "the path of a .stl, .obj, .ply or .off file, a SurfaceMesh, a trimesh.Trimesh, or (vertices, triangles)"


@dataclass(frozen=True, eq=False)
class Shells:
    """The boundary of a solid.

    Attributes:
        surface: All triangles, counter-clockwise as seen from outside the solid: those of cavities face their air.
        part: Shell of every triangle, shape (tri,).
        cavities: Name of each shell that is a cavity, by its number, in the order of the shells.
    """

    surface: SurfaceMesh
    part: IntArray
    cavities: dict[int, str]

    @property
    def volume(self) -> float:
        """Volume of the solid [m^3]."""
        return surface_volume(self.surface.nodes, self.surface.triangles)

    def shell(self, number: int) -> tuple[FloatArray, IntArray]:
        """Vertices [m] and triangles of one shell."""
        return compact(self.surface.nodes, self.surface.triangles[self.part == number])


def as_surface(value: Any, *, scale: float = 1.0, name: str | None = None) -> SurfaceMesh:
    """A surface from anything that holds triangles, coincident vertices joined.

    Args:
        value: Path of a .stl, .obj, .ply, .off or .dae file, a ``SurfaceMesh``, a ``TetMesh`` (its boundary), a
            ``trimesh.Trimesh``, or (vertices, triangles).
        scale: Metres per unit of it, e.g. 0.001 for millimetres.
        name: What messages call it; None takes the name of the file or mesh.

    Raises:
        FileNotFoundError: If a path leads nowhere.
        MeshError: If it holds no triangles, or they are broken.
    """
    label = _label(value, name)
    try:
        factor = checks.number(
            scale, f"surface {label!r}: scale", above=0.0, high=checks.FARTHEST, advice="0.001 reads millimetres"
        )
    except ValueError as error:
        raise MeshError(str(error)) from None
    nodes, triangles = _arrays(value, label)
    points = checks.as_array(nodes)
    if points.dtype.kind in "fiu":
        points = points.astype(np.float64) * factor
    mesh = SurfaceMesh(points, checks.as_array(triangles), label)
    x, t = weld(mesh.nodes, mesh.triangles)
    corners = np.sort(t, axis=1)
    whole = (corners[:, 1:] != corners[:, :-1]).all(axis=1)
    if not whole.any():
        raise MeshError(f"surface {label!r}: every triangle shrinks to a line or a point; check its unit and scale")
    return SurfaceMesh(*compact(x, t[whole]), label)


def _label(value: Any, name: str | None) -> str:
    """What messages call a surface."""
    if name is None and isinstance(value, str | Path):
        return Path(value).name
    given = getattr(value, "name", None)
    return checks.label(name, given if isinstance(given, str) and given else "surface")


def _arrays(value: Any, label: str) -> tuple[Any, Any]:
    """Vertices and triangles as they were given."""
    if isinstance(value, str | Path):
        path = Path(value)
        if not path.exists():
            raise FileNotFoundError(f"surface {str(path)!r} does not exist; check the path and the working directory")
        if path.suffix.lower() not in SURFACE_FILES or path.is_dir():
            raise MeshError(
                f"surface {path.name!r}: files of surfaces end in {', '.join(SURFACE_FILES)}; read others with "
                f"softwarp.read_mesh and pass what it returns"
            )
        return read_triangles(path)
    if isinstance(value, SurfaceMesh):
        return value.nodes, value.triangles
    if isinstance(value, TetMesh):
        return value.nodes, value.surface()
    if hasattr(value, "to_mesh"):  # trimesh.Scene
        value = value.to_mesh()
    if hasattr(value, "vertices") and hasattr(value, "faces"):  # trimesh.Trimesh
        return np.asarray(value.vertices), np.asarray(value.faces)
    if isinstance(value, list | tuple) and len(value) == 2:
        return value[0], value[1]
    raise MeshError(f"surface {label!r}: cannot make a surface of {type(value).__name__}; give {ACCEPTED}")


def shells_of(outer: SurfaceMesh, cavities: Mapping[str, SurfaceMesh]) -> Shells:
    """Take a surface apart into shells, find out which are cavities, and orient all of them.

    A shell inside another one is a cavity, however its triangles are turned.

    Args:
        outer: Closed; one or more shells.
        cavities: Further closed shells inside it, by name.

    Raises:
        MeshError: If a surface is open or badly oriented, a named cavity does not lie inside, or a shell lies within
            a cavity.
    """
    nodes: list[FloatArray] = []
    triangles: list[IntArray] = []
    part: list[IntArray] = []
    names: list[str] = []
    count = 0
    for label, surface in [("", outer), *cavities.items()]:
        found = surface_parts(surface.triangles)
        for index in range(int(found.max()) + 1):
            x, t = compact(surface.nodes, surface.triangles[found == index])
            t = check_closed(x, t, name=surface.name)
            nodes.append(x)
            triangles.append(t + count)
            part.append(np.full(len(t), len(part), dtype=np.int32))
            names.append(label)
            count += len(x)
    inside = [_containers(nodes, triangles, k) for k in range(len(nodes))]
    hollow: dict[int, str] = {}
    unnamed = 0
    for k, (label, depth) in enumerate(zip(names, map(len, inside), strict=True)):
        if depth > 1:
            raise MeshError(
                f"surface {outer.name!r}: a shell of {len(triangles[k])} triangles lies within a cavity; mesh that "
                f"part on its own, and pass the rest without it"
            )
        if label and depth == 0:
            raise MeshError(
                f"cavity {label!r}: does not lie inside surface {outer.name!r} (its first vertex is at "
                f"{nodes[k][0].tolist()} m); move it inside, leave a wall around it, and check its scale"
            )
        if depth == 1:
            hollow[k] = label or f"cavity {unnamed}"
            unnamed += not label
            triangles[k] = triangles[k][:, ::-1]
    surface = SurfaceMesh(np.concatenate(nodes), np.concatenate(triangles), outer.name)
    _check_names(hollow, surface.name)
    return Shells(surface, np.concatenate(part), hollow)


def _containers(nodes: list[FloatArray], triangles: list[IntArray], k: int) -> list[int]:
    """Shells that hold most of a few vertices of shell k."""
    probes = nodes[k][np.linspace(0, len(nodes[k]) - 1, min(PROBES, len(nodes[k]))).astype(int)]
    result = []
    first = 0
    for j, (x, t) in enumerate(zip(nodes, triangles, strict=True)):
        low, high = x.min(axis=0), x.max(axis=0)
        if j != k and (probes >= low).all() and (probes <= high).all():
            corner = x[t - first]
            votes = [abs(winding(point, corner)) > 0.5 for point in probes]
            if 2 * sum(votes) > len(votes):
                result.append(j)
        first += len(x)
    return result


def _check_names(hollow: dict[int, str], name: str) -> None:
    """Refuse two shells of one name."""
    seen: set[str] = set()
    for label in hollow.values():
        if label in seen:
            raise MeshError(
                f"surface {name!r}: cavity {label!r} consists of several shells; give every shell its own name"
            )
        seen.add(label)
