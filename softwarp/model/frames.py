"""Constants of frames: rigid bodies, rod nodes, what they carry and which of their unknowns are prescribed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softwarp.model.fields import shared
from softwarp.model.structure import GatherLists

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]


@dataclass
class FrameModel:
    """Frames in the order rigid bodies, rod nodes, centres of mass that lie off their body's origin.

    *Owners* give frames their mass: rigid bodies, then rods. *Slots* are the nodes, then translation and rotation of
    every frame. *Carried* items are slots that move with a frame; *sources* of a master are itself and what it carries.
    """

    # Host
    rigid_count: int
    rod_count: int
    count: int
    rod_start: IntArray  # (rod + 1,) first rod node of every rod
    rest_pose: FloatArray  # (frame, 7)
    rest_twist: FloatArray  # (frame, 6)
    master: IntArray  # (frame,)
    is_kinematic: NDArray[np.bool_]  # (rigid,)
    segment_frames: IntArray  # (segment, 2)
    rod_radius: FloatArray  # (rod node,) for contact and pictures [m]

    # Device
    carried_blocks: dict[str, GatherLists] = shared(
        "carried block", doc="kind of element -> blocks of A with such elements that frames carry nodes of"
    )
    held_nodes: dict[str, GatherLists] = shared(
        "held node", doc="kind of element -> nodes of such elements that frames carry"
    )
    frame_size: wp.array = shared("frame", unit="m", doc="of the part: longest side of a body, median rod segment")
    frame_master: wp.array = shared("frame", doc="frame whose unknowns it shares")
    frame_dof: wp.array = shared("frame", doc="dofs of its master, (2 frame,)")
    frame_offset: wp.array = shared("frame", unit="m", doc="pose in its master, (frame, 7)")
    frame_owner: wp.array = shared("frame", doc="owner that gives it mass")
    owner_body: wp.array = shared("owner", doc="row of the owner in the workspace's body arrays")
    frame_volume: wp.array = shared("frame", unit="m^3", doc="mass per density of the owner (1 for a rigid body)")
    frame_inertia: wp.array = shared("frame", doc="inertia per density: xx yy zz xy xz yz, (frame, 6)")
    frame_spin: wp.array = shared("frame", doc="how it moves on with its momentum: model.codes.Spin")
    turning_frame: wp.array = shared("turning", doc="masters that turn freely and that something holds")
    welded_frame: wp.array = shared("welded", doc="frames that are not their own masters")
    frame_block: wp.array = shared("frame", doc="blocks of A: tt, rr, rt or tr, 1 if it is tr; (frame, 4)")
    source_start: wp.array = shared("frame", doc="ranges in source, (frame + 1,)")
    source: wp.array = shared("source", doc="kind (0 node, 1 frame), index, carried item or -1; (source, 3)")
    source_lever: wp.array = shared("source", unit="m", doc="position in the master, (source, 3)")
    source_inertia: wp.array = shared(
        "source", doc="inertia per density about itself in the master's axes: xx yy zz xy xz yz, (source, 6)"
    )
    carried_slot: wp.array = shared("carried", doc="slot that moves with a frame")
    carried_frame: wp.array = shared("carried", doc="its master")
    carried_dof: wp.array = shared("carried", doc="the master's dofs, (2 carried,)")
    carried_offset: wp.array = shared("carried", unit="m", doc="position in the master, (carried, 3)")
    slot_dof: wp.array = shared("slot", doc="dof of a slot, the master's for the rotation of a welded frame, -1: none")
    slot_carried: wp.array = shared("slot", doc="carried item of a slot, or -1")
    blend_frame: wp.array = shared("blend", doc="frame within a rod segment, for contact")
    blend_ends: wp.array = shared("blend", doc="frames at the segment's ends, (blend, 2)")
    blend_place: wp.array = shared("blend", doc="place along it, 0 to 1, and its length [m]; (blend, 2)")
    node_frame: wp.array = shared("node", doc="frame that carries a node, or -1")
    corner_start: wp.array = shared("frame slot", doc="ranges in corner of frame slots, (2 frame + 1,)")
    corner: wp.array = shared("corner", doc="4 segment + corner of every segment at a frame slot")
    seg_frame: wp.array = shared("segment", doc="frames of both ends, (segment, 2)")
    seg_rod: wp.array = shared("segment", doc="rod of the segment")
    seg_body: wp.array = shared("segment", doc="row of the rod in the workspace's body arrays")
    seg_length: wp.array = shared("segment", unit="m", doc="rest length")
    seg_section: wp.array = shared("segment", doc="A, shear area, I1, I2, J; (segment, 5)")
    seg_scale: wp.array = shared("segment", doc="factor on all stiffnesses")
    seg_rest: wp.array = shared("segment", doc="rest strains, (segment, 6)")
    seg_entry_start: wp.array = shared("block", doc="ranges in seg_entry, (block + 1,)")
    seg_entry: wp.array = shared("entry", doc="16 segment + 4 a + b: segment blocks in a block of A")
    kinematic_frame: wp.array = shared("kinematic", doc="frames of kinematic bodies")
    grip_start: wp.array = shared("grip", doc="ranges in grip_corner: what a frame carries of a quadratic element")
    grip_corner: wp.array = shared("gripped corner", doc="10 element + node")
    grip_item: wp.array = shared("gripped corner", doc="carried item of that node")
    gripped_block: wp.array = shared("gripped block", doc="blocks of A with such elements")
    gripped_start: wp.array = shared("gripped block", doc="ranges in gripped_entry")
    gripped_entry: wp.array = shared("entry", doc="element, codes of the row's and the column's side; (entry, 3)")

    @property
    def rod_node_count(self) -> int:
        """Nodes of all rods."""
        return int(self.rod_start[-1])

    @property
    def grip_count(self) -> int:
        """Pairs of a frame and a quadratic element of which it carries nodes, but not all."""
        return int(self.grip_start.size) - 1

    @property
    def carried_count(self) -> int:
        """Slots that frames carry."""
        return int(self.carried_slot.size)
