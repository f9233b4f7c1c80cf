"""Constants of corotational hexahedra."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softwarp.model.fields import shared

IntArray = NDArray[np.int32]


@dataclass(frozen=True)
class HexLayout:
    """Hexahedra of all soft bodies. Host only."""

    nodes: IntArray  # (hex, 8) in the order of VTK
    body: IntArray  # (hex,)
    lumped: NDArray[Any]  # (hex, 8) nodal volumes [m^3]
    factor: NDArray[Any]  # (hex,) of the modulus
    thin: NDArray[np.bool_]  # (hex,) which have the modes of walls


@dataclass
class HexModel:
    """Hexahedra with incompatible modes; element forces after those of quadratic tets.

    Hexahedra of one body that differ by their place alone share a *shape*, with the axes of its first edges.
    """

    # Host
    layout: HexLayout

    # Device
    hex_node: wp.array = shared("hex", doc="corners in the order of VTK, (hex, 8)")
    hex_body: wp.array = shared("hex", doc="body of the hexahedron")
    hex_shape: wp.array = shared("hex", doc="its shape")
    hex_factor: wp.array = shared("hex", doc="factor of its modulus")
    hex_volume: wp.array = shared("hex", unit="m^3", doc="rest volume")
    shape_body: wp.array = shared("shape", doc="body whose moduli it has")
    shape_x: wp.array = shared("shape", unit="m", doc="corners at rest from the first, in its axes, (shape, 24)")
    shape_gradient: wp.array = shared("shape", unit="1/m", doc="mean gradients of the corners' functions, (shape, 24)")
    shape_mu: wp.array = shared("shape", unit="m", doc="dK/dmu without modes, 36 blocks a >= b, (shape, 324)")
    shape_lam: wp.array = shared("shape", unit="m", doc="dK/dlam likewise, (shape, 324)")
    mode_mu: wp.array = shared("shape", doc="what modes, 9 or 15, share with corners, per mu, (shape, 24 modes)")
    mode_lam: wp.array = shared("shape", doc="likewise per lam, (shape, 24 modes)")
    mode_ratio: wp.array = shared("shape", doc="stiffness of a mode per lam, that per mu being 1, (shape, mode)")
    entry_start: wp.array = shared("block", doc="ranges in entry, (block + 1,)")
    entry: wp.array = shared("entry", doc="64 hex + 8 a + b: its blocks in a block of A")
    hex_block: wp.array = shared("hex", doc="where K_ab, a >= b, goes: 2 block, + 1 transposed, or -1, (hex, 36)")
    carried_block: wp.array = shared("carried", doc="blocks of A with hexahedra of which frames carry corners")
    carried_start: wp.array = shared("carried", doc="ranges in carried_entry")
    carried_entry: wp.array = shared("entry", doc="such a code and the carried items on its sides, or -1, (entry, 3)")
    held_node: wp.array = shared("held", doc="nodes of hexahedra that frames carry")
    held_start: wp.array = shared("held", doc="ranges in held_entry")
    held_entry: wp.array = shared("entry", doc="8 hex + corner")
    piece_node: wp.array = shared("piece", doc="six tets between the corners of every hexahedron, (6 hex, 4)")
    piece_size: wp.array = shared("piece", unit="m^3", doc="their rest volumes")

    @property
    def count(self) -> int:
        """Hexahedra."""
        return len(self.layout.nodes)

    @property
    def nodes(self) -> IntArray:
        """Corners of every hexahedron, shape (hex, 8)."""
        return self.layout.nodes
