"""Constants of air chambers and of membranes glued to soft bodies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softwarp.model.fields import shared

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]


@dataclass
class CavityModel:
    """Chambers: their points follow those of the cables, their rows too."""

    # Host
    body: IntArray  # (cavity,) soft body that holds the chamber
    starts: IntArray  # (cavity + 1,) ranges of points, counted from the first chamber's first one
    triangles: IntArray  # (tri, 3) outward, same count
    tri_cavity: IntArray  # (tri,)
    rest_volume: FloatArray  # (cavity,) [m^3]

    # Device; points and rows count from those of the cables
    cavity_point_start: wp.array = shared("cavity", doc="ranges of points, (cavity + 1,)")
    cavity_area: wp.array = shared("cavity", unit="m^2", doc="area of the surface at rest")
    cavity_rest_volume: wp.array = shared("cavity", unit="m^3", doc="volume at rest")
    point_cavity: wp.array = shared("cavity point", doc="chamber of a surface point")
    cavity_control: wp.array = shared("cavity", doc="0 pressure, 1 volume, 2 gas")
    ring_start: wp.array = shared("cavity point", doc="ranges in point_ring, (cavity point + 1,)")
    point_ring: wp.array = shared("ring", doc="the other two points of every triangle around a point, (ring, 2)")
    cavity_tri_start: wp.array = shared("cavity", doc="ranges in cavity_tri, (cavity + 1,)")
    cavity_tri: wp.array = shared("tri", doc="points of every triangle, chamber after chamber, (tri, 3)")
    edge_cavity: wp.array = shared("edge", doc="chamber of a surface edge")
    edge_opposite: wp.array = shared("edge", doc="points beside the edge, (edge, 2)")
    coupling_start: wp.array = shared("block", doc="ranges in coupling_edge, (block + 1,)")
    coupling_edge: wp.array = shared("coupling", doc="edge whose tangent a block of A receives")
    coupling_weight: wp.array = shared("coupling", doc="product of the nodes' weights, negative for a transposed block")

    @property
    def count(self) -> int:
        """Chambers."""
        return len(self.starts) - 1


@dataclass
class MembraneModel:
    """Triangles with their own modulus and thickness on nodes of soft bodies; elements after the tets."""

    # Host
    names: tuple[str, ...]
    body: IntArray  # (membrane,)
    triangles: IntArray  # (tri, 3) nodes

    # Device
    tri_node: wp.array = shared("membrane tri", doc="corners, (tri, 3)")
    tri_membrane: wp.array = shared("membrane tri", doc="membrane of the triangle")
    tri_gradient: wp.array = shared("membrane tri", unit="1/m", doc="rest gradients of corners 1 and 2, (tri, 4)")
    tri_volume: wp.array = shared("membrane tri", unit="m^3", doc="area times thickness")
    element_body: wp.array = shared("membrane tri", doc="soft body that the triangle is glued to")
    membrane_entry_start: wp.array = shared("block", doc="ranges in membrane_entry, (block + 1,)")
    membrane_entry: wp.array = shared("entry", doc="16 triangle + 4 a + b: triangle blocks in a block of A")
    carried_block: wp.array = shared("carried block", doc="blocks of A with triangles that frames carry corners of")
    carried_start: wp.array = shared("carried block", doc="ranges in carried_entry")
    carried_entry: wp.array = shared("entry", doc="code, left and right item, (entry, 3)")
    carried_weight: wp.array = shared("entry", doc="ones")
    held_node: wp.array = shared("held node", doc="nodes of triangles that frames carry")
    held_start: wp.array = shared("held node", doc="ranges in held_entry")
    held_entry: wp.array = shared("entry", doc="4 triangle + corner of every triangle at such a node")
    held_weight: wp.array = shared("entry", doc="ones")

    @property
    def count(self) -> int:
        """Membranes."""
        return len(self.names)
