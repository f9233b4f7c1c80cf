"""Constants of reduced bodies: modes, the elements that stand for all, and how rows and contacts find them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softwarp.model.fields import shared
from softwarp.model.floating import FloatingModel

IntArray = NDArray[np.int32]


@dataclass
class ReductionModel:
    """Soft bodies that move in modes. Modes count body after body, each body's up to a multiple of three.

    ``listed`` counts the nodes of reduced bodies, those that a step needs within it first. A block is three modes, a
    dof of A. A sample is an element that counts; its basis are the displacements of its corners against its first one
    in every mode, component after component, each with the body's ``stride``. A chunk has samples that share nodes, and
    their modes at these (``plan.patches``).
    """

    # Host
    body: IntArray  # (reduced body,) soft body
    start: IntArray  # (reduced body + 1,) ranges of modes
    modes: IntArray  # (reduced body,) without those that fill the last block
    stride: IntArray  # (reduced body,) modes up to a multiple of 16
    active_count: int  # listed nodes that a step needs within it
    tet_samples: IntArray  # (reduced body + 1,) ranges of samples
    tri_samples: IntArray  # (reduced body + 1,)
    chunk_room: int  # entries of the stiffness of the elements of a chunk, at most
    floating: FloatingModel | None  # bodies whose modes turn with them; None without any

    # Device
    mode_dof: wp.array = shared("block", doc="dof of three modes")
    block_body: wp.array = shared("block", doc="soft body")
    block_first: wp.array = shared("block", doc="first mode of the body")
    block_modes: wp.array = shared("block", doc="modes of the body, up to a multiple of three")
    block_volume: wp.array = shared("block", doc="first entry in volume")
    volume: wp.array = shared("volume", unit="m^3", doc="mass per density, by rows of modes")
    heft: wp.array = shared("mode", unit="m^3", doc="what gravity pulls at per density, (mode, 3)")
    mode_wide: wp.array = shared("mode", doc="its place among wide modes")
    wide_mode: wp.array = shared("wide mode", doc="mode, -1 for one that fills a stride")
    wide_body: wp.array = shared("wide mode", doc="reduced body")
    body_number: wp.array = shared("reduced body", doc="soft body")
    body_node: wp.array = shared("reduced body", doc="ranges of nodes in order, (reduced body + 1,)")
    body_begin: wp.array = shared("reduced body", doc="its first node")
    body_end: wp.array = shared("reduced body", doc="node after its last one")
    body_modes: wp.array = shared("reduced body", doc="modes, up to a multiple of three")
    body_stride: wp.array = shared("reduced body", doc="modes up to a multiple of 16")
    body_wide: wp.array = shared("reduced body", doc="first wide mode")
    body_tets: wp.array = shared("reduced body", doc="ranges of tet samples, (reduced body + 1,)")
    body_tris: wp.array = shared("reduced body", doc="ranges of tri samples, (reduced body + 1,)")
    body_tet_basis: wp.array = shared("reduced body", doc="first entry in tet_basis")
    body_tri_basis: wp.array = shared("reduced body", doc="first entry in tri_basis")
    node: wp.array = shared("listed", doc="node")
    node_body: wp.array = shared("listed", doc="its reduced body")
    node_rest: wp.array = shared("listed", unit="m", doc="position at rest, (listed, 3)")
    node_basis: wp.array = shared("listed", doc="first entry in basis")
    basis: wp.array = shared("basis", doc="displacements in all modes: (listed, component, stride)")
    order: wp.array = shared("listed", doc="listed nodes body after body")
    pair_block: wp.array = shared("pair", doc="stored block of A of two blocks: 2 block, + 1 transposed")
    pair_row: wp.array = shared("pair", doc="its row among blocks")
    pair_col: wp.array = shared("pair", doc="its column, not above the row")
    pair_volume: wp.array = shared("pair", unit="m^3", doc="mass per density, (pair, 9)")
    pair_stiffness: wp.array = shared("pair", doc="first entry among mode pairs")
    pair_stride: wp.array = shared("pair", doc="stride of the body")
    tet_sample: wp.array = shared("tet sample", doc="tet")
    tet_turned: wp.array = shared("tet sample", doc="1 where its law keeps turned gradients, else 0")
    tet_stride: wp.array = shared("tet sample", doc="stride of the body")
    tet_first: wp.array = shared("tet sample", doc="first entry in tet_basis")
    tet_basis: wp.array = shared("basis", doc="(tet sample, 9, stride)")
    tri_sample: wp.array = shared("tri sample", doc="membrane triangle")
    tri_stride: wp.array = shared("tri sample", doc="stride of the body")
    tri_first: wp.array = shared("tri sample", doc="first entry in tri_basis")
    tri_basis: wp.array = shared("basis", doc="(tri sample, 6, stride)")
    body_chunk: wp.array = shared("reduced body", doc="ranges of chunks, (reduced body + 1,)")
    chunk_rows: wp.array = shared("chunk", doc="rows of modes, three for every node, without zeros")
    chunk_basis: wp.array = shared("chunk", doc="first entry in chunk_modes")
    chunk_tets: wp.array = shared("chunk", doc="ranges in tet_list, (chunk + 1,)")
    chunk_tris: wp.array = shared("chunk", doc="ranges in tri_list, (chunk + 1,)")
    tet_list: wp.array = shared("tet sample", doc="sample, and nodes of the chunk at its corners: (5,)")
    tri_list: wp.array = shared("tri sample", doc="likewise of a triangle, (4,)")
    chunk_modes: wp.array = shared("basis", doc="modes at nodes against one of each patch, then zeros")
    row_body: wp.array = shared("mode row", doc="reduced body that a row of H acts on")
    row_point: wp.array = shared("mode row", doc="first point of the row")
    row_points: wp.array = shared("mode row", doc="points of the row")
    row_basis: wp.array = shared("mode row", doc="first entry in point_basis")
    row_wide: wp.array = shared("mode row", doc="first of its wide modes among those of all such rows")
    point_basis: wp.array = shared("basis", doc="displacements at points of rows: (row, point, component, stride)")
    wide_row: wp.array = shared("wide row mode", doc="row of a wide mode of a row, for a GPU")
    entry: wp.array = shared("row entry", doc="entry of H that belongs to three modes")
    entry_wide: wp.array = shared("row entry", doc="first of their places among wide modes of rows")
    touch_listed: wp.array = shared("touch", doc="listed node that may touch something")
    touch_first: wp.array = shared("touch", doc="first dof of the body in elimination order")
    touch_begin: wp.array = shared("touch", doc="first block of the body")
    touch_end: wp.array = shared("touch", doc="the one after its last")
    touch_stride: wp.array = shared("touch", doc="stride of the body")
    touch_basis: wp.array = shared("touch", doc="first entry in basis")
    block_touch: wp.array = shared("block", doc="ranges of touching nodes of the body: first, end, (block, 2)")

    @property
    def count(self) -> int:
        """Modes, with those that fill the last block of every body."""
        return int(self.start[-1])

    @property
    def wide_count(self) -> int:
        """Modes, each body's up to its stride."""
        return int(self.stride.sum())

    @property
    def pair_room(self) -> int:
        """Entries of the bodies' stiffness in modes."""
        return int((self.stride.astype(np.int64) ** 2).sum())

    @property
    def widest(self) -> int:
        """Largest stride."""
        return int(self.stride.max(initial=0))
