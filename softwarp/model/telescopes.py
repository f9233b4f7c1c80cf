"""Constants of telescopes: tubes, their sections, and the nodes and segments of their common line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softwarp.model.fields import shared

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]


@dataclass
class TelescopeModel:
    """Telescopes in the order of their rods; tubes, nodes and segments count on from one to the next."""

    # Host
    rod: IntArray  # (telescope,)
    tube_start: IntArray  # (telescope + 1,)
    start_length: FloatArray  # (tube,) deployed at the start [m]
    start_angle: FloatArray  # (tube,) at the start [rad]
    start_base: FloatArray  # (telescope,) angle of its frame at the port at the start [rad]
    start_windup: FloatArray  # (windup,) at the start [rad]
    outer_radius: FloatArray  # (tube,) [m]

    # Device
    first_tube: wp.array = shared("telescope", doc="ranges of tubes, (telescope + 1,)")
    base_frame: wp.array = shared("telescope", doc="frame at the port")
    base_dof: wp.array = shared("telescope", doc="dofs of its translation and rotation, (2 telescope,)")
    pieces: wp.array = shared("telescope", doc="segments of its line")
    first_windup: wp.array = shared("telescope", doc="first angle in windup: that of its first tube at the port")
    first_owner: wp.array = shared("telescope", doc="owner of the mass of its first node")
    floor: wp.array = shared("telescope", unit="m", doc="shortest length of its line")
    hidden_twists: wp.array = shared("telescope", doc="1 if what is not deployed twists")
    port: wp.array = shared("telescope", unit="m", doc="position and quaternion, (7 telescope,)")
    node_telescope: wp.array = shared("telescope node", doc="telescope of a node")
    node_place: wp.array = shared("telescope node", doc="number of the node along it, from the port on")
    piece_telescope: wp.array = shared("telescope segment", doc="telescope of a segment")
    piece_place: wp.array = shared("telescope segment", doc="number of the segment along it")
    piece_segment: wp.array = shared("telescope segment", doc="which segment of all rods it is")
    plain_segment: wp.array = shared("plain segment", doc="segments of rods that are no telescopes")
    tube_telescope: wp.array = shared("tube", doc="telescope of a tube")
    tube_whole: wp.array = shared("tube", unit="m", doc="whole length")
    tube_area: wp.array = shared("tube", doc="area, shear area, second moment, torsion constant; (4 tube,)")
    section_start: wp.array = shared("tube", doc="ranges of sections, (tube + 1,)")
    section_end: wp.array = shared("section", unit="m", doc="where it ends, from the tube's base")
    section_ratio: wp.array = shared("section", doc="modulus per that of the tube")
    section_curvature: wp.array = shared("section", unit="1/m", doc="bending and twist, (3 section,)")

    @property
    def count(self) -> int:
        """Telescopes."""
        return len(self.rod)

    @property
    def tube_count(self) -> int:
        """Tubes of all telescopes."""
        return len(self.start_length)

    @property
    def windup_count(self) -> int:
        """Angles of all tubes at all nodes: a tube has them side by side, from the port on."""
        return len(self.start_windup)

    @property
    def node_count(self) -> int:
        """Nodes of all telescopes."""
        return int(self.node_place.size)

    @property
    def piece_count(self) -> int:
        """Segments of all telescopes."""
        return int(self.piece_place.size)
