"""Unions, differences and intersections of closed surfaces, by trimesh with the package manifold3d."""

from __future__ import annotations

import importlib
import importlib.util
from typing import Any

import numpy as np

from softwarp.meshing.shells import as_surface, shells_of
from softwarp.meshing.tets import MeshError, SurfaceMesh


def union(*surfaces: Any, scale: float = 1.0, name: str = "union") -> SurfaceMesh:
    """What lies inside at least one of several closed surfaces.

    Args:
        surfaces: Of any kind that ``as_surface`` takes, two or more.
        scale: Metres per unit of all of them.
        name: What messages call the result.

    Raises:
        ImportError: If manifold3d is missing.
        MeshError: If a surface is open or badly oriented, or nothing is left.
    """
    return _combined("union", surfaces, scale, name)


def difference(*surfaces: Any, scale: float = 1.0, name: str = "difference") -> SurfaceMesh:
    """What lies inside the first of several closed surfaces and outside all others; as ``union``."""
    return _combined("difference", surfaces, scale, name)


def intersection(*surfaces: Any, scale: float = 1.0, name: str = "intersection") -> SurfaceMesh:
    """What lies inside all of several closed surfaces; as ``union``."""
    return _combined("intersection", surfaces, scale, name)


def _combined(operation: str, surfaces: tuple[Any, ...], scale: float, name: str) -> SurfaceMesh:
    """The surface that an operation of trimesh makes."""
    if len(surfaces) < 2:
        raise MeshError(f"{name!r}: {operation} takes two surfaces or more, got {len(surfaces)}")
    if importlib.util.find_spec("manifold3d") is None:
        raise ImportError(
            f'meshing.{operation} needs the package manifold3d; install it with pip install "softwarp[mesh]"'
        )
    import trimesh

    parts = []
    for number, value in enumerate(surfaces):
        shells = shells_of(as_surface(value, scale=scale, name=f"{name}, surface {number}"), {})
        parts.append(trimesh.Trimesh(shells.surface.nodes, shells.surface.triangles, process=False))
    made = getattr(trimesh.boolean, operation)(parts, engine="manifold")
    if not len(made.faces):
        raise MeshError(f"{name!r}: the {operation} of {len(parts)} surfaces is empty; check their places and units")
    return as_surface((np.asarray(made.vertices), np.asarray(made.faces)), name=name)
