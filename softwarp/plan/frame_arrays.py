"""Frames in elimination order. Host only."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp.model.frames import FrameModel
from softwarp.model.structure import GatherLists, Symbolic
from softwarp.plan.frames import FrameLayout
from softwarp.plan.grips import KIND, grip_lists
from softwarp.plan.quadratic import carried_blocks, held_nodes
from softwarp.plan.structure import Elements, Slots, Structure, block_of, lists

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]


def frame_model(
    f: FrameLayout | None, found: Structure, bodies: int, size: FloatArray, elements: IntArray
) -> FrameModel | None:
    """Frames in elimination order; None without any.

    Args:
        f: Frames of the scene.
        found: Structure of the linear system.
        bodies: Soft bodies, whose rows come before those of rods and rigid bodies in the workspace's body arrays.
        size: Sizes of the frames' parts, from ``plan.resolution`` [m], (frame,).
        elements: Nodes of quadratic elements, (element, 10).
    """
    if f is None:
        return None
    slots = found.slots
    master_dof = master_dof_of(f, slots)
    source_start, source, lever, inertia = _sources(f)
    segment_slots = f.corners - f.node_count
    corner_start, corner = lists(segment_slots.ravel(), np.arange(segment_slots.size), 2 * f.count)
    carried, held = _carried_elements(found)
    return FrameModel(
        rigid_count=f.rigid_count,
        rod_count=f.rod_count,
        count=f.count,
        rod_start=f.rod_start,
        rest_pose=f.pose,
        rest_twist=f.twist,
        master=f.master,
        is_kinematic=f.is_kinematic,
        segment_frames=f.segment_frames,
        rod_radius=f.radius,
        carried_blocks=carried,
        held_nodes=held,
        frame_size=size,
        frame_master=f.master,
        frame_dof=master_dof.ravel(),
        frame_offset=f.offset,
        frame_owner=f.owner,
        owner_body=bodies + _owner_rows(f),
        frame_volume=f.volume,
        frame_inertia=_six(f.inertia),
        frame_spin=f.spin,
        turning_frame=f.turning,
        welded_frame=np.flatnonzero(f.master != np.arange(f.count)),
        frame_block=_frame_blocks(found.symbolic, master_dof),
        source_start=source_start,
        source=source,
        source_lever=lever,
        source_inertia=inertia,
        carried_slot=f.carried_slot,
        carried_frame=f.carried_frame,
        carried_dof=master_dof[f.carried_frame].ravel(),
        carried_offset=f.carried_offset,
        slot_dof=slots.unknown[: f.slot_count],
        slot_carried=slots.item[: f.slot_count],
        node_frame=f.node_frame,
        blend_frame=f.first_blend + np.arange(len(f.blend_ends)),
        blend_ends=f.blend_ends,
        blend_place=f.blend_place,
        corner_start=corner_start,
        corner=corner,
        seg_frame=f.segment_frames,
        seg_rod=f.segment_rod,
        seg_body=bodies + f.segment_rod,
        **vars(f.segments),
        seg_entry_start=found.lists["segment"].start,
        seg_entry=found.lists["segment"].entry,
        kinematic_frame=np.flatnonzero(f.is_kinematic),
        **vars(grip_lists(found, f, elements)),
    )


def _owner_rows(f: FrameLayout) -> IntArray:
    """Rows of owners among those of rods and rigid bodies: rigid bodies, rods, then every node of telescopes."""
    rows = np.concatenate([f.rod_count + np.arange(f.rigid_count), np.arange(f.rod_count)])
    nodes = f.rigid_count + np.arange(f.rod_start[-1])
    own = nodes[f.owner[nodes] >= len(rows)]  # in the order of their owners
    rod = np.searchsorted(f.rod_start, own - f.rigid_count, side="right") - 1
    return np.concatenate([rows, rod]).astype(np.int32)


def segment_elements(f: FrameLayout | None) -> list[Elements]:
    """Segments of rods as elements; nothing without frames."""
    return [] if f is None else [Elements("segment", f.corners, np.arange(len(f.corners)))]


def _carried_elements(found: Structure) -> tuple[dict[str, GatherLists], dict[str, GatherLists]]:
    """Blocks of A and nodes that elements with carried nodes give to, by kind.

    Membranes and hexahedra look after theirs, and the blocks of turned quadratic elements are those of grips.
    """
    carried: dict[str, GatherLists] = {}
    held: dict[str, GatherLists] = {}
    for kind, lists_of in found.lists.items():
        if kind in ("membrane", "hex"):
            continue
        is_quadratic = kind in ("quadraticlarge", "quadraticstored")
        if lists_of.carried.target.size and kind != KIND:
            carried[kind] = carried_blocks(lists_of.carried) if is_quadratic else lists_of.carried
        if lists_of.held.target.size:
            held[kind] = held_nodes(lists_of.held) if is_quadratic else lists_of.held
    return carried, held


def master_dof_of(f: FrameLayout, slots: Slots) -> IntArray:
    """Dofs of translation and rotation of every frame's master, (frame, 2)."""
    first = f.node_count + 2 * f.master
    return np.stack([slots.unknown[first], slots.unknown[first + 1]], axis=1).astype(np.int32)


def _six(matrices: FloatArray) -> FloatArray:
    """xx yy zz xy xz yz of symmetric matrices (n, 3, 3)."""
    row, column = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
    return matrices[:, row, column]


def _sources(f: FrameLayout) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """Sources of every master, itself first: ranges, what they are, their levers and their inertia."""
    found: list[list[tuple[int, int, int]]] = [[] for _ in range(f.count)]
    for frame in np.flatnonzero(f.master == np.arange(f.count)):
        found[frame].append((1, int(frame), -1))
    for item, (slot, frame) in enumerate(zip(f.carried_slot, f.carried_frame, strict=True)):
        is_node = slot < f.node_count
        if f.body_node_count <= slot < f.node_count or slot >= f.node_count + 2 * f.first_blend:
            continue  # guides have neither mass nor force of their own, nor have blended frames
        index = int(slot) if is_node else (int(slot) - f.node_count) // 2
        found[frame].append((0 if is_node else 1, index, item))
    start = np.concatenate([[0], np.cumsum([len(part) for part in found])]).astype(np.int32)
    sources = np.array([source for part in found for source in part], dtype=np.int32).reshape(-1, 3)
    is_bare = sources[:, 2] < 0
    lever = np.zeros((len(sources), 3))
    lever[~is_bare] = f.carried_offset[sources[~is_bare, 2]]
    inertia = np.where((sources[:, 0] == 1)[:, None], _six(f.inertia_in_master())[sources[:, 1] % f.count], 0.0)
    return start, sources, lever, inertia


def _frame_blocks(symbolic: Symbolic, master_dof: NDArray[Any]) -> IntArray:
    """Blocks of A of every frame's master: tt, rr, the one between, and whether that one is stored as (t, r)."""
    t, r = master_dof[:, 0], master_dof[:, 1]
    between = block_of(symbolic, np.maximum(t, r), np.minimum(t, r))
    return np.stack([t, r, between, t > r], axis=1).astype(np.int32)
