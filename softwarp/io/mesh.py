"""Mesh files: linear or quadratic tetrahedra from .vtk, .vtu and .msh; surfaces from these, .stl, .obj, .ply, .off."""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp import checks, meshing
from softwarp.advice import close_to
from softwarp.io.mesh_limits import check_declared
from softwarp.meshing import MeshError, QuadraticMesh, SurfaceMesh, TetMesh
from softwarp.meshing.surface_files import SURFACE_FILES, parsed, read_triangles

__all__ = ["read_mesh"]

_CELL_FORMATS = {".vtk": "meshio.vtk", ".vtu": "meshio.vtu", ".msh": "meshio.gmsh"}
_SUFFIXES = (*_CELL_FORMATS, *SURFACE_FILES)
_BOUNDARY_CELLS = {"vertex", "line", "triangle", "quad"}  # cells that may accompany tetrahedra
_BOUNDARY_CELLS_10 = _BOUNDARY_CELLS | {"line3", "triangle6"}
_TO_OURS = [0, 1, 2, 3, 4, 6, 7, 5, 8, 9]  # files have the edge nodes 01 12 02 03 13 23
_MIRRORED = [0, 1, 3, 2, 4, 8, 7, 6, 5, 9]  # corners 2 and 3 exchanged, in the order of files


def read_mesh(
    path: str | Path, scale: float = 1.0, *, orient: bool = False, compact: bool = False
) -> TetMesh | QuadraticMesh | SurfaceMesh:
    """Read a mesh file; nodes and corners keep the order of the file.

    A file with tetrahedra gives a ``TetMesh``, one with 10-node tetrahedra a ``QuadraticMesh``; points, lines,
    triangles and quads beside them, which gmsh and others write for the boundary, are left out. A file with triangles
    alone gives a ``SurfaceMesh``. The corners of .stl triangles are welded, as that format repeats them, and triangles
    that shrink to a line or point in this are dropped; polygons of an .obj are cut into triangles.

    Args:
        path: File ending in .vtk, .vtu, .msh (gmsh), .stl, .obj, .ply or .off.
        scale: Metres per unit of the file, e.g. 0.001 for millimetres.
        orient: Exchange two corners of inverted tetrahedra instead of refusing them.
        compact: Drop nodes that no element uses instead of refusing them.

    Returns:
        The mesh in metres, named after the file.

    Raises:
        FileNotFoundError: If there is no such file.
        MeshError: If the file is empty, broken, of another format, holds other elements, or fails ``check_tets``.
    """
    try:
        path = Path(checks.path(path, "read_mesh: path"))
    except ValueError as error:
        raise MeshError(str(error)) from None
    _check_path(path)
    try:
        what, advice = f"mesh {path.name!r}: scale", "0.001 reads millimetres"
        scale = checks.number(scale, what, above=0.0, high=checks.FARTHEST, advice=advice)
    except ValueError as error:
        raise MeshError(str(error)) from None
    nodes, corners = _read_cells(path) if path.suffix.lower() in _CELL_FORMATS else read_triangles(path)
    nodes = np.asarray(nodes, dtype=np.float64) * scale

    usable = corners.size > 0 and corners.min() >= 0 and corners.max() < len(nodes)  # else the constructor refuses
    if compact and usable:
        nodes, corners = meshing.compact(nodes, corners)
    if corners.shape[1] == 3:
        return SurfaceMesh(nodes, corners.astype(np.int32), path.name)
    if corners.shape[1] == 10:
        if orient and usable:
            corners = _orient_quadratic(nodes, corners)
        return QuadraticMesh(nodes, corners[:, _TO_OURS].astype(np.int32), path.name)
    if orient and usable:
        corners = meshing.orient(nodes, corners)
    return TetMesh(nodes, corners.astype(np.int32), path.name)


def _check_path(path: Path) -> None:
    """Refuse what cannot be a mesh file before any parser sees it."""
    if path.is_dir():
        raise MeshError(f"mesh {str(path)!r} is a folder; name a file in it that ends in {', '.join(_SUFFIXES)}")
    if not path.exists():
        near = close_to(path.name, _names(path.parent))
        hint = f"nearest in its folder: {', '.join(near)}" if near else "check the path and the working directory"
        raise FileNotFoundError(f"mesh {str(path)!r} does not exist; {hint}")
    if path.suffix.lower() not in _SUFFIXES:
        raise MeshError(
            f"mesh {path.name!r}: cannot read files ending in {path.suffix!r}; convert it to one of "
            f"{', '.join(_SUFFIXES)}, for example with the command: meshio convert {path.name} {path.stem}.vtu"
        )
    if path.stat().st_size == 0:
        raise MeshError(f"mesh {path.name!r}: the file is empty; write or download it again")


def _names(folder: Path) -> list[str]:
    """Names of the mesh files in a folder, which need not exist."""
    return sorted(p.name for p in folder.iterdir() if p.suffix.lower() in _SUFFIXES) if folder.is_dir() else []


def _read_cells(path: Path) -> tuple[NDArray[Any], NDArray[Any]]:
    """Nodes and corners of the tetrahedra, or of the triangles where there are no tetrahedra."""
    if path.suffix.lower() == ".msh":
        _check_gmsh_sections(path)
    check_declared(path)
    # The reader of the format itself: meshio.read prints and ends the process on a broken file.
    reader = importlib.import_module(_CELL_FORMATS[path.suffix.lower()])
    mesh = parsed(path, lambda: reader.read(str(path)))

    cells: dict[str, list[NDArray[Any]]] = {}
    for block in mesh.cells:
        if len(block.data):
            cells.setdefault(block.type, []).append(np.asarray(block.data))
    kept = next((kind for kind in ("tetra10", "tetra") if kind in cells), "triangle")
    beside = {"tetra10": _BOUNDARY_CELLS_10, "tetra": _BOUNDARY_CELLS, "triangle": _BOUNDARY_CELLS - {"quad"}}
    allowed = beside[kept] | {kept}
    if kept not in cells or not cells.keys() <= allowed:
        counts = ", ".join(f"{sum(map(len, blocks))} {kind}" for kind, blocks in sorted(cells.items())) or "no elements"
        raise MeshError(
            f"mesh {path.name!r} holds {counts}; only 4-node tetrahedra (tetra), 10-node ones (tetra10), "
            f"or triangles alone for a surface, can be read. Remesh with these, or cut the other elements into them"
        )
    return mesh.points, np.concatenate(cells[kept])


def _orient_quadratic(nodes: NDArray[Any], corners: NDArray[Any]) -> NDArray[Any]:
    """Nodes of elements in the order of files, mirrored where the volume between the corners is negative."""
    inverted = meshing.tet_volumes(nodes, corners[:, :4]) < 0.0
    return np.where(inverted[:, None], corners[:, _MIRRORED], corners)


def _check_gmsh_sections(path: Path) -> None:
    """Refuse a .msh file with an unclosed section: the parser would search for its end for ever."""
    content = path.read_bytes()
    if content.lstrip().startswith(b"("):
        raise MeshError(
            f"mesh {path.name!r} is an Ansys file; export it from gmsh, or with meshio.write(..., file_format='gmsh')"
        )
    opened = re.findall(rb"^\$(?!End)([A-Za-z]\w*)[ \t\r]*$", content, flags=re.MULTILINE)
    if b"MeshFormat" not in opened:
        raise MeshError(f"mesh {path.name!r}: not a gmsh file, the section $MeshFormat is missing; export it from gmsh")
    for section in opened:
        if not re.search(rb"^\$End" + section + rb"[ \t\r]*$", content, flags=re.MULTILINE):
            raise MeshError(
                f"mesh {path.name!r}: section ${section.decode()} has no end: the file is cut short; write it "
                f"or download it again"
            )
