"""Where the contacts of a scene are expected, for its elimination order. Host only; theory: docs/theory/cholesky.md."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softwarp.model.handles import Handle, RigidBody, Rod
from softwarp.plan.contact import SOFT_CONTACTS, outer_skin
from softwarp.plan.frames import FrameLayout
from softwarp.plan.soft import SoftLayout
from softwarp.scene.parts import Scene
from softwarp.shapes.base import rotation_matrix

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

NEAR = 0.75  # of the contacts, expected where parts are near each other at the start; the others may be anywhere


def expected_touch(scene: Scene, soft: SoftLayout, frames: FrameLayout | None) -> FloatArray:
    """How many ends of a contact are expected at every slot: nodes, then translations and rotations of frames.

    Every pair of parts brings as many contacts as any other. On a soft body's skin, or on a rod, three quarters of
    them are expected at the nodes nearest to the box around the other part, as many as a pair may have contacts. Where
    all are as near, as on a floor or in a vessel, all count alike.

    Returns:
        Shares, (slot,); 0 where nothing moves, and on rigid bodies, which A couples with hardly anything.
    """
    result = np.zeros(len(soft.nodes) if frames is None else frames.slot_count)
    for pair in scene.pairs:
        for part, other in ((pair.a, pair.b), (pair.b, pair.a)):
            own, places = _places(scene, part, soft, frames)
            if own.size == 0:
                continue
            away = _distance(places, _box(scene, other, soft, frames))
            is_near = away <= np.sort(away)[min(SOFT_CONTACTS, away.size) - 1]
            result[own] += (NEAR * is_near / is_near.sum() + (1.0 - NEAR) / away.size) / len(scene.pairs)
    return result


def _places(scene: Scene, part: Handle, soft: SoftLayout, frames: FrameLayout | None) -> tuple[IntArray, FloatArray]:
    """Slots of a soft body or a rod that something can touch and move, and where they are [m]; none of rigid bodies."""
    if isinstance(part, RigidBody):
        return np.zeros(0, dtype=np.int64), np.zeros((0, 3))
    if isinstance(part, Rod):
        assert frames is not None
        own = frames.rigid_count + np.arange(frames.rod_start[part], frames.rod_start[part + 1])
        return frames.node_count + 2 * frames.master[own].astype(np.int64), frames.pose[own, :3]
    own = np.unique(outer_skin(scene, part)).astype(np.int64) + int(soft.node_start[part])
    own = own[~soft.fixed[own]]
    return own, soft.nodes[own]


def _box(
    scene: Scene, part: Handle, soft: SoftLayout, frames: FrameLayout | None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Box around a part: its origin and axes, and its lowest and highest corner in them [m]."""
    if isinstance(part, RigidBody):
        assert frames is not None
        shape, pose = scene.rigids[part].shape, frames.pose[int(part)]
        bounds = np.zeros((2, 3)) if shape is None else np.asarray(shape.bounds)
        return pose[:3], rotation_matrix(pose[3:]), bounds
    if isinstance(part, Rod):
        _, places = _places(scene, part, soft, frames)
    else:
        places = soft.nodes[soft.node_start[part] : soft.node_start[part + 1]]
    return np.zeros(3), np.eye(3), np.stack([places.min(axis=0), places.max(axis=0)])


def _distance(places: FloatArray, box: tuple[FloatArray, FloatArray, FloatArray]) -> FloatArray:
    """Distances from a box [m], 0 inside."""
    origin, axes, (low, high) = box
    local = (places - origin) @ axes
    return np.asarray(np.linalg.norm(np.maximum(np.maximum(low - local, local - high), 0.0), axis=1))
