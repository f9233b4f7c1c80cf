"""Tetrahedral meshes: procedural bodies, checks, surfaces, and points embedded in them. Lengths in metres."""

from softwarp.meshing.embedding import embed
from softwarp.meshing.tets import (
    MeshError,
    SurfaceMesh,
    TetMesh,
    box,
    check_tets,
    compact,
    min_dihedral,
    orient,
    radius_ratio,
    tet_surface,
    tet_volumes,
    weld,
)
from softwarp.meshing.trunk_geometry import trunk

__all__ = [
    "MeshError",
    "SurfaceMesh",
    "TetMesh",
    "box",
    "check_tets",
    "compact",
    "embed",
    "min_dihedral",
    "orient",
    "radius_ratio",
    "tet_surface",
    "tet_volumes",
    "trunk",
    "weld",
]
