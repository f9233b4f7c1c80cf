"""Constants of quadratic tetrahedra."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softwarp.model.fields import shared

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class QuadraticLayout:
    """Quadratic elements of all soft bodies. Host only."""

    nodes: IntArray  # (element, 10) corners, then edge nodes 01 02 03 12 13 23
    body: IntArray  # (element,)
    laws: NDArray[Any]  # kernel law of every element
    products: FloatArray  # (element, 10, 10) integrals of N_a N_b [m^3]
    lumped: FloatArray  # (element, 10) positive nodal volumes [m^3]
    stiffness: FloatArray  # (element, 4) factors of the modulus at Gauss points


@dataclass
class QuadraticModel:
    """Quadratic tetrahedra: four linear ones each, point 4 element + q; element forces after those of membranes."""

    # Host
    layout: QuadraticLayout

    # Device
    law_points: dict[str, wp.array] = shared("Gauss point", doc="element kernel -> indices of its points")
    element_node: wp.array = shared("element", doc="nodes, (element, 10)")
    point_tet: wp.array = shared("Gauss point", doc="its corners: 4 point + k, (point, 4)")
    point_body: wp.array = shared("Gauss point", doc="body of the element")
    point_gradient: wp.array = shared("Gauss point", unit="1/m", doc="rest gradients of L_1 to L_3, (point, 9)")
    point_volume: wp.array = shared("Gauss point", unit="m^3", doc="share of the rest volume, times its factor")
    point_size: wp.array = shared("Gauss point", unit="m^3", doc="rest volume of its linear tet")
    point_frame: wp.array = shared("Gauss point", doc="rest frame for the large rotation, by rows, (point, 9)")
    large_entry_start: wp.array = shared("block", doc="ranges in large_entry, (block + 1,)")
    large_entry: wp.array = shared("entry", doc="256 element + 16 a + b: its blocks in a block of A, large rotation")
    stored_entry_start: wp.array = shared("block", doc="ranges in stored_entry, (block + 1,)")
    stored_entry: wp.array = shared("entry", doc="16 point + 4 k + m for elements that store their stiffness")
    stored_weight: wp.array = shared("entry", doc="product of the corners' weights")
    weight_node: wp.array = shared("weight", doc="nodes whose weight is not that of their lumped mass")
    weight_volume: wp.array = shared("weight", unit="m^3", doc="how much more volume pulls at them")
    mass_body: wp.array = shared("block", doc="body whose consistent mass changes a block of A")
    mass_volume: wp.array = shared("block", unit="m^3", doc="consistent less lumped mass per density")
    mass_row: wp.array = shared("mass row", doc="dofs with consistent mass")
    mass_row_start: wp.array = shared("mass row", doc="ranges in mass_column, (mass row + 1,)")
    mass_row_body: wp.array = shared("mass row", doc="their bodies")
    mass_column: wp.array = shared("mass column", doc="dofs that they share mass with, themselves included")
    mass_column_node: wp.array = shared("mass column", doc="nodes of these dofs")
    mass_column_volume: wp.array = shared("mass column", unit="m^3", doc="consistent less lumped mass per density")

    @property
    def count(self) -> int:
        """Elements."""
        return len(self.layout.nodes)

    @property
    def nodes(self) -> IntArray:
        """Nodes of every element, shape (element, 10)."""
        return self.layout.nodes
