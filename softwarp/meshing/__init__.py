"""Tetrahedral meshes: procedural bodies, checks, surfaces, and points embedded in them. Lengths in metres."""

from softwarp.meshing.embedding import embed
from softwarp.meshing.surfaces import (
    MembraneGeometry,
    check_closed,
    edge_couplings,
    membrane_geometry,
    orient_surface,
    surface_edges,
    surface_parts,
    surface_rings,
    surface_volume,
    triangle_areas,
    voids,
)
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
    "MembraneGeometry",
    "MeshError",
    "SurfaceMesh",
    "TetMesh",
    "box",
    "check_closed",
    "check_tets",
    "compact",
    "edge_couplings",
    "embed",
    "membrane_geometry",
    "min_dihedral",
    "orient",
    "orient_surface",
    "radius_ratio",
    "surface_edges",
    "surface_parts",
    "surface_rings",
    "surface_volume",
    "tet_surface",
    "tet_volumes",
    "triangle_areas",
    "trunk",
    "voids",
    "weld",
]
