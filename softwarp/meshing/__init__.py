"""Meshes: solids, surfaces, rods, their checks, and points embedded in them. Lengths in metres."""

from softwarp.meshing.aorta_geometry import VesselTree, aorta
from softwarp.meshing.board_geometry import board
from softwarp.meshing.booleans import difference, intersection, union
from softwarp.meshing.cup_geometry import CupMesh, cup
from softwarp.meshing.diamond_geometry import diamond
from softwarp.meshing.embedding import embed
from softwarp.meshing.figurine_geometry import figurine
from softwarp.meshing.filling import tetrahedralize
from softwarp.meshing.finger_bricks import FingerBricks, finger_bricks
from softwarp.meshing.finger_geometry import FingerMesh, finger
from softwarp.meshing.hexes import HexMesh, brick, check_hexes, quad_shares
from softwarp.meshing.lumen import Lumen
from softwarp.meshing.maze_geometry import Maze, random_maze, serpentine
from softwarp.meshing.nasal_geometry import nasal_passage
from softwarp.meshing.pad_geometry import PadMesh, pad
from softwarp.meshing.quadratic import QuadraticMesh, elevate, face_middles, face_shares, surface_middles
from softwarp.meshing.quadruped_geometry import quadruped, quadruped_skin
from softwarp.meshing.revolved import revolve
from softwarp.meshing.rods import RodGeometry, arc, helix, rod_geometry, straight
from softwarp.meshing.shells import as_surface
from softwarp.meshing.solid import CavityWall, MeshReport, SolidMesh
from softwarp.meshing.surfaces import (
    MembraneGeometry,
    check_closed,
    edge_couplings,
    mean_edge,
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
    EDGES,
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
from softwarp.meshing.tripod_geometry import tripod, tripod_bricks
from softwarp.meshing.trunk_geometry import round_trunk, trunk, trunk_skin

__all__ = [
    "EDGES",
    "CavityWall",
    "CupMesh",
    "FingerBricks",
    "FingerMesh",
    "HexMesh",
    "Lumen",
    "Maze",
    "MembraneGeometry",
    "MeshError",
    "MeshReport",
    "PadMesh",
    "QuadraticMesh",
    "RodGeometry",
    "SolidMesh",
    "SurfaceMesh",
    "TetMesh",
    "VesselTree",
    "aorta",
    "arc",
    "as_surface",
    "board",
    "box",
    "brick",
    "check_closed",
    "check_hexes",
    "check_tets",
    "compact",
    "cup",
    "diamond",
    "difference",
    "edge_couplings",
    "elevate",
    "embed",
    "face_middles",
    "face_shares",
    "figurine",
    "finger",
    "finger_bricks",
    "helix",
    "intersection",
    "mean_edge",
    "membrane_geometry",
    "min_dihedral",
    "nasal_passage",
    "orient",
    "orient_surface",
    "pad",
    "quad_shares",
    "quadruped",
    "quadruped_skin",
    "radius_ratio",
    "random_maze",
    "revolve",
    "rod_geometry",
    "round_trunk",
    "serpentine",
    "straight",
    "surface_edges",
    "surface_middles",
    "surface_parts",
    "surface_rings",
    "surface_volume",
    "tet_surface",
    "tet_volumes",
    "tetrahedralize",
    "triangle_areas",
    "tripod",
    "tripod_bricks",
    "trunk",
    "trunk_skin",
    "union",
    "voids",
    "weld",
]
