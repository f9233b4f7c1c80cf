"""Files of surfaces: triangles from .stl, .obj, .ply, .off and, with pycollada, .dae."""

from __future__ import annotations

import importlib.util
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp.meshing.tets import MeshError

SURFACE_FILES = (".stl", ".obj", ".ply", ".off", ".dae")


def parsed(path: Path, parser: Callable[[], Any]) -> Any:
    """The parser's result; whatever a foreign parser trips over becomes one error that names the file."""
    try:
        return parser()
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200].rstrip(": ")
        raise MeshError(
            f"mesh {path.name!r}: not a valid {path.suffix} file ({reason}); it may be cut short or of another format, "
            f"write or download it again"
        ) from error


def read_triangles(path: Path) -> tuple[NDArray[Any], NDArray[Any]]:
    """Nodes and corners of a surface file, in its own unit; corners of .stl triangles are welded.

    Of .dae files, which tell their unit, in metres; their direction of up is left as it is, as robots' files expect.

    Raises:
        ImportError: If the package for .dae files is missing.
        MeshError: If it is broken, of another format, or holds no triangles.
    """
    import trimesh

    if path.suffix.lower() == ".dae":
        return _collada(path)
    content, kind = path.read_bytes(), path.suffix.lower().lstrip(".")
    binary = kind == "stl" and len(content) == 84 + 50 * int.from_bytes(content[80:84], "little")
    if kind == "stl" and not binary:
        kind = "stl_ascii"
    is_bytes = binary or kind == "ply"
    source = io.BytesIO(content) if is_bytes else io.StringIO(content.decode(errors="replace"))
    options = {"maintain_order": True, "skip_materials": True} if kind == "obj" else {}
    mesh = parsed(path, lambda: trimesh.load_mesh(source, file_type=kind, process=False, **options))
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise MeshError(
            f"mesh {path.name!r} holds no triangles, or is cut short or of another format; export it as triangles"
        )
    if path.suffix.lower() == ".stl":
        return weld_triangles(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def _collada(path: Path) -> tuple[NDArray[Any], NDArray[Any]]:
    """Nodes [m] and corners of all meshes of a Collada file, where its scene has them."""
    import trimesh

    if importlib.util.find_spec("collada") is None:
        raise ImportError(
            f"mesh {path.name!r}: Collada files need the package pycollada: pip install 'softwarp[dae]'; or convert it "
            "to .stl or .obj"
        )
    content = path.read_bytes()
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        raise MeshError(f"mesh {path.name!r}: document types and entities are not read; write them out")
    scene = parsed(path, lambda: trimesh.load_scene(io.BytesIO(content), file_type="dae", process=False))
    mesh = parsed(path, scene.to_mesh) if scene.geometry else None
    if mesh is None or len(mesh.faces) == 0:
        raise MeshError(f"mesh {path.name!r} holds no triangles; export it as triangles")
    unit, is_scaled, _ = (scene.units or "meters").partition(" * ")
    return np.asarray(mesh.vertices) * (float(unit) if is_scaled else 1.0), np.asarray(mesh.faces)


def weld_triangles(nodes: NDArray[Any], triangles: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Join equal positions, in the order of their first appearance; drop triangles left with two equal corners."""
    _, first, inverse = np.unique(nodes, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    corners = rank[inverse.reshape(-1)][triangles]
    a, b, c = corners.T
    return nodes[first[order]], corners[(a != b) & (b != c) & (c != a)]
