"""Constants of tractions: what a load per area on faces of soft bodies gives their nodes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softwarp.model.fields import shared

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]


@dataclass
class TractionModel:
    """Tractions and the nodes that they pull at."""

    # Host
    names: tuple[str, ...]
    body: IntArray  # (traction,)
    area: FloatArray  # (traction,) of its faces at rest [m^2]
    start: FloatArray  # (traction, 3) command at the start [Pa]

    # Device
    loaded_node: wp.array = shared("loaded node", doc="nodes of loaded faces, each once")
    entry_start: wp.array = shared("loaded node", doc="ranges in entry_traction, (loaded node + 1,)")
    entry_traction: wp.array = shared("traction entry", doc="traction that pulls at the node")
    entry_share: wp.array = shared("traction entry", unit="m^2", doc="integral of the node's shape function")

    @property
    def count(self) -> int:
        """Tractions."""
        return len(self.names)
