"""Frames in elimination order on a device."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp.model.frames import FrameModel
from softwarp.plan.frames import FrameLayout
from softwarp.plan.structure import Slots, block_of, lists
from softwarp.plan.upload import upload

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]
Arrays = dict[str, NDArray[Any]]


def upload_frames(f: FrameLayout, slots: Slots, symbolic: Any, arrays: Arrays, device: str, real: Any) -> FrameModel:
    """Frames in elimination order on a device."""
    base = f.node_count
    dof = slots.unknown[: f.slot_count]
    master_dof = master_dof_of(f, slots)
    sources, source_start = _sources(f)
    is_bare = sources[:, 2] < 0
    lever = np.zeros((len(sources), 3))
    lever[~is_bare] = f.carried_offset[sources[~is_bare, 2]]
    inertia = np.where((sources[:, 0] == 1)[:, None], _six(f.inertia_in_master())[sources[:, 1] % f.count], 0.0)
    bodies = int(arrays.pop("segment_body_count")[0])
    owner_body = np.concatenate([bodies + f.rod_count + np.arange(f.rigid_count), bodies + np.arange(f.rod_count)])
    segment_slots = f.corners - base
    corner_start, corner = lists(segment_slots.ravel(), np.arange(segment_slots.size), 2 * f.count)
    own: Arrays = {
        "frame_master": f.master,
        "frame_dof": master_dof.ravel(),
        "frame_offset": f.offset,
        "frame_owner": f.owner,
        "owner_body": owner_body,
        "frame_volume": f.volume,
        "frame_inertia": _six(f.inertia),
        "frame_spin": f.spin,
        "turning_frame": f.turning,
        "welded_frame": np.flatnonzero(f.master != np.arange(f.count)),
        "frame_block": _frame_blocks(symbolic, master_dof),
        "source_start": source_start,
        "source": sources,
        "source_lever": lever,
        "source_inertia": inertia,
        "carried_slot": f.carried_slot,
        "carried_frame": f.carried_frame,
        "carried_dof": master_dof[f.carried_frame].ravel(),
        "carried_offset": f.carried_offset,
        "slot_dof": dof,
        "slot_carried": slots.item[: f.slot_count],
        "node_frame": f.node_frame,
        "blend_frame": f.first_blend + np.arange(len(f.blend_ends)),
        "blend_ends": f.blend_ends,
        "blend_place": f.blend_place,
        "corner_start": corner_start,
        "corner": corner,
        "seg_frame": f.segment_frames,
        "seg_rod": f.segment_rod,
        "seg_body": bodies + f.segment_rod,
        **f.segments,
        "seg_entry_start": arrays.pop("segment_entry_start"),
        "seg_entry": arrays.pop("segment_entry"),
        "kinematic_frame": np.flatnonzero(f.is_kinematic),
    }
    kinds = {key.split("_")[0] for key in arrays}

    def of_kinds(what: str, first: str) -> dict[str, Any]:
        parts = upload({key: value for key, value in arrays.items() if f"_{what}_" in key}, device, real)
        names = [f"{what}_{part}" for part in (first, "start", "entry", "weight")]
        return {
            kind: tuple(parts[f"{kind}_{name}"] for name in names) for kind in kinds if parts[f"{kind}_{names[0]}"].size
        }

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
        carried_blocks=of_kinds("carried", "block"),
        held_nodes=of_kinds("held", "node"),
        **upload(own, device, real),
    )


def master_dof_of(f: FrameLayout, slots: Slots) -> IntArray:
    """Dofs of translation and rotation of every frame's master, (frame, 2)."""
    first = f.node_count + 2 * f.master
    return np.stack([slots.unknown[first], slots.unknown[first + 1]], axis=1).astype(np.int32)


def _six(matrices: FloatArray) -> FloatArray:
    """xx yy zz xy xz yz of symmetric matrices (n, 3, 3)."""
    row, column = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
    return matrices[:, row, column]


def _sources(f: FrameLayout) -> tuple[IntArray, IntArray]:
    """Sources of every master, itself first, and their ranges."""
    found: list[list[tuple[int, int, int]]] = [[] for _ in range(f.count)]
    for frame in np.flatnonzero(f.master == np.arange(f.count)):
        found[frame].append((1, int(frame), -1))
    for item, (slot, frame) in enumerate(zip(f.carried_slot, f.carried_frame, strict=True)):
        is_node = slot < f.node_count
        if f.body_node_count <= slot < f.node_count or slot >= f.node_count + 2 * f.first_blend:
            continue  # guides have neither mass nor force of their own, nor have blended frames
        index = int(slot) if is_node else (int(slot) - f.node_count) // 2
        found[frame].append((0 if is_node else 1, index, item))
    start = np.concatenate([[0], np.cumsum([len(part) for part in found])])
    flat = [source for part in found for source in part]
    return np.array(flat, dtype=np.int32).reshape(-1, 3), start.astype(np.int32)


def _frame_blocks(symbolic: Any, master_dof: NDArray[Any]) -> IntArray:
    """Blocks of A of every frame's master: tt, rr, the one between, and whether that one is stored as (t, r)."""
    t, r = master_dof[:, 0], master_dof[:, 1]
    between = block_of(symbolic, np.maximum(t, r), np.minimum(t, r))
    return np.stack([t, r, between, t > r], axis=1).astype(np.int32)
