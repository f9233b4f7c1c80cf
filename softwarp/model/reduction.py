"""Constants of reduced bodies: modes, the elements that stand for all, and how rows and contacts find them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softwarp.model.fields import shared

IntArray = NDArray[np.int32]


@dataclass
class ReductionModel:
    """Soft bodies that move in modes. Modes count body after body, each body's up to a multiple of three.

    ``listed`` counts the nodes of reduced bodies, those that a step needs within it first. A block is three modes, a
    dof of A. A sample is an element that counts; its basis are the displacements of its corners against its first one
    in every mode, component after component, each with the body's ``stride``.
    """

    # Host
    body: IntArray  # (reduced body,) soft body
    start: IntArray  # (reduced body + 1,) ranges of modes
    modes: IntArray  # (reduced body,) without those that fill the last block
    stride: IntArray  # (reduced body,) modes up to a multiple of 16
    active_count: int  # listed nodes that a step needs within it
    tet_samples: IntArray  # (reduced body + 1,) ranges of samples
    tri_samples: IntArray  # (reduced body + 1,)

    # Device
    mode_dof: wp.array = shared("block", doc="dof of three modes")
    block_body: wp.array = shared("block", doc="soft body")
    block_first: wp.array = shared("block", doc="first mode of the body")
    block_modes: wp.array = shared("block", doc="modes of the body, up to a multiple of three")
    block_volume: wp.array = shared("block", doc="first entry in volume")
    volume: wp.array = shared("volume", unit="m^3", doc="mass per density, by rows of modes")
    body_modes: wp.array = shared("reduced body", doc="modes, up to a multiple of three")
    body_stride: wp.array = shared("reduced body", doc="modes up to a multiple of 16")
    body_tets: wp.array = shared("reduced body", doc="ranges of tet samples, (reduced body + 1,)")
    body_tris: wp.array = shared("reduced body", doc="ranges of tri samples, (reduced body + 1,)")
    body_tet_basis: wp.array = shared("reduced body", doc="first entry in tet_basis")
    body_tri_basis: wp.array = shared("reduced body", doc="first entry in tri_basis")
    block_node: wp.array = shared("block", doc="first node of the body")
    block_nodes: wp.array = shared("block", doc="nodes of the body")
    block_panel: wp.array = shared("block", doc="first entry in panel")
    panel: wp.array = shared("panel", doc="modes by blocks: (block, node, component, 3)")
    heft: wp.array = shared("mode", unit="m^3", doc="what gravity pulls at per density, (mode, 3)")
    node: wp.array = shared("listed", doc="node")
    node_first: wp.array = shared("listed", doc="first mode of its body")
    node_modes: wp.array = shared("listed", doc="modes of its body, up to a multiple of three")
    node_rest: wp.array = shared("listed", unit="m", doc="position at rest, (listed, 3)")
    node_basis: wp.array = shared("listed", doc="first entry in basis")
    basis: wp.array = shared("basis", doc="modes by nodes: (listed, component, mode)")
    pair_block: wp.array = shared("pair", doc="stored block of A of two blocks: 2 block, + 1 transposed")
    pair_row: wp.array = shared("pair", doc="its row among blocks")
    pair_col: wp.array = shared("pair", doc="its column, not above the row")
    pair_volume: wp.array = shared("pair", unit="m^3", doc="mass per density, (pair, 9)")
    pair_stiffness: wp.array = shared("pair", doc="first entry among mode pairs")
    pair_stride: wp.array = shared("pair", doc="stride of the body")
    pair_body: wp.array = shared("pair", doc="reduced body")
    pair_modes: wp.array = shared("pair", doc="first mode of its row and of its column in the body, (pair, 2)")
    tet_sample: wp.array = shared("tet sample", doc="tet")
    tet_turned: wp.array = shared("tet sample", doc="1 where its law keeps turned gradients, else 0")
    tet_stride: wp.array = shared("tet sample", doc="stride of the body")
    tet_modes: wp.array = shared("tet sample", doc="modes of the body, up to a multiple of three")
    tet_first: wp.array = shared("tet sample", doc="first entry in tet_basis")
    tet_basis: wp.array = shared("basis", doc="(tet sample, 9, stride)")
    tri_sample: wp.array = shared("tri sample", doc="membrane triangle")
    tri_stride: wp.array = shared("tri sample", doc="stride of the body")
    tri_modes: wp.array = shared("tri sample", doc="modes of the body, up to a multiple of three")
    tri_first: wp.array = shared("tri sample", doc="first entry in tri_basis")
    tri_basis: wp.array = shared("basis", doc="(tri sample, 6, stride)")
    entry: wp.array = shared("row entry", doc="entry of H that belongs to three modes")
    entry_point: wp.array = shared("row entry", doc="first point of its row")
    entry_points: wp.array = shared("row entry", doc="points of its row")
    entry_panel: wp.array = shared("row entry", doc="first entry in point_panel")
    point_panel: wp.array = shared("panel", doc="modes at points of rows: (row, block, point, component, 3)")
    touch_listed: wp.array = shared("touch", doc="listed node that may touch something")
    touch_block: wp.array = shared("block", doc="first such node of the body")
    touch_blocks: wp.array = shared("block", doc="how many")
    touch_panel: wp.array = shared("block", doc="first entry in touch_basis")
    touch_basis: wp.array = shared("panel", doc="modes of these by blocks: (block, touch, component, 3)")
    touch_first: wp.array = shared("touch", doc="first dof of the body in elimination order")
    touch_begin: wp.array = shared("touch", doc="first block of the body")
    touch_end: wp.array = shared("touch", doc="the one after its last")

    @property
    def count(self) -> int:
        """Modes, with those that fill the last block of every body."""
        return int(self.start[-1])

    @property
    def pair_room(self) -> int:
        """Entries of the bodies' stiffness in modes."""
        return int((self.stride.astype(np.int64) ** 2).sum())

    @property
    def widest(self) -> int:
        """Largest stride."""
        return int(self.stride.max(initial=0))
