"""From joints of a scene to rows and arrays. Host only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softwarp.model.codes import JOINT_CONTROLS, UNBOUNDED, JointCoordinate, JointRow
from softwarp.model.handles import Handle, RigidBody
from softwarp.model.joints import JointModel
from softwarp.plan.frames import FrameLayout, relative
from softwarp.plan.structure import lists
from softwarp.scene.parts import JointSpec, Scene
from softwarp.shapes.base import rotation_matrix

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]
COORDINATE = {
    "hinge": JointCoordinate.ANGLE,
    "slider": JointCoordinate.WAY,
    "ball": JointCoordinate.NOTHING,
    "weld": JointCoordinate.NOTHING,
}
Held = list[tuple[JointRow, int]]  # kind and axis of the rows of a joint
ANCHORS: Held = [(JointRow.POINT, axis) for axis in range(3)]
LOCKED: Held = [(JointRow.LOCK, axis) for axis in range(3)]
HELD: dict[str, Held] = {
    "hinge": [*ANCHORS, (JointRow.TILT, 0), (JointRow.TILT, 1)],
    "slider": [(JointRow.SIDE, 0), (JointRow.SIDE, 1), *LOCKED],
    "ball": ANCHORS,
    "weld": [*ANCHORS, *LOCKED],
}
SMALL = 1e-9  # share of a row that counts as nothing
ALIGNED = 1e-6  # rad between axes that float32 cannot tell apart


@dataclass(frozen=True)
class JointLayout:
    """Joints of a scene before the elimination order is known."""

    frames: IntArray  # (joint, 2) parent or -1, child
    place: FloatArray  # (joint, 14)
    length: FloatArray  # (joint,) [m]
    starts: IntArray  # (joint + 1,) ranges of rows
    kind: IntArray  # (row,)
    axis: IntArray  # (row,)

    @property
    def row_joint(self) -> IntArray:
        """Joint of every row."""
        return np.repeat(np.arange(len(self.frames), dtype=np.int32), np.diff(self.starts))

    @property
    def row_frames(self) -> IntArray:
        """Parent (-1: the world) and child of every row, (row, 2)."""
        return self.frames[self.row_joint].reshape(-1, 2)

    @property
    def row_size(self) -> FloatArray:
        """Length that the gap of a row is measured by [m]."""
        return self.length[self.row_joint]


def joint_layout(scene: Scene, frames: FrameLayout | None) -> JointLayout:
    """Frames, places and rows of all joints.

    Raises:
        ValueError: For a joint between parts that move as one or cannot move, or along an axis that is locked.
    """
    pairs, places, lengths, kinds, axes, starts = [], [], [], [], [], [0]
    for spec in scene.joints:
        assert frames is not None  # a joint needs a child, which is a frame
        pair = [-1 if part is None else _frame(scene, frames, part) for part in (spec.parent, spec.child)]
        _check(spec, frames, pair)
        start = _joint_pose(spec)
        places.append(np.concatenate([start if f < 0 else relative(frames.pose[f], start) for f in pair]))
        lengths.append(_length(frames, pair, spec.anchor))
        found = _rows(spec, frames, pair, rotation_matrix(start[3:]))
        kinds += [kind for kind, _ in found]
        axes += [axis for _, axis in found]
        starts.append(len(kinds))
        pairs.append(pair)
    return JointLayout(
        frames=np.array(pairs, dtype=np.int32).reshape(-1, 2),
        place=np.array(places, dtype=np.float64).reshape(-1, 14),
        length=np.array(lengths, dtype=np.float64),
        starts=np.array(starts, dtype=np.int32),
        kind=np.array(kinds, dtype=np.int32),
        axis=np.array(axes, dtype=np.int32),
    )


def joint_model(scene: Scene, joints: JointLayout, frames: FrameLayout | None) -> JointModel | None:
    """All joints; None without any."""
    if not scene.joints or frames is None:
        return None
    specs = scene.joints
    free = np.array([COORDINATE[spec.kind] for spec in specs])
    is_held = (joints.kind != JointRow.FREE) | np.array([_is_unlimited(specs[j]) for j in joints.row_joint], dtype=bool)
    sides = joints.frames.ravel()
    used = np.flatnonzero(sides >= 0)
    masters = frames.master[sides[used]]
    turned, inverse = np.unique(masters, return_inverse=True)
    turned_start, turned_side = lists(inverse, used, len(turned))
    return JointModel(
        kinds=tuple(spec.kind for spec in specs),
        frames=joints.frames,
        rows=len(joints.kind),
        unbounded=np.flatnonzero(is_held).astype(np.int32),
        velocity_controlled=np.array([spec.control == "velocity" for spec in specs], dtype=bool),
        joint_frame=joints.frames,
        joint_place=joints.place,
        joint_free=free,
        joint_control=np.array([JOINT_CONTROLS.index(spec.control) for spec in specs]),
        joint_length=joints.length,
        joint_scale=np.where(free == JointCoordinate.ANGLE, joints.length, 1.0),
        joint_row_start=joints.starts,
        row_joint=joints.row_joint,
        row_kind=joints.kind,
        row_axis=joints.axis,
        gyrating_frame=turned[(turned < frames.rigid_count) & frames.free[turned].all(axis=1)],
        turned_frame=turned,
        turned_start=turned_start,
        turned_side=turned_side,
    )


def joint_defaults(scene: Scene) -> dict[str, FloatArray]:
    """Values of the parameters of joints."""
    specs = scene.joints
    values = {
        "joint_stiffness": [spec.stiffness for spec in specs],
        "joint_damping": [spec.damping for spec in specs],
        "joint_max_force": [spec.max_force for spec in specs],
        "joint_max_rate": [spec.max_rate for spec in specs],
        "joint_min_position": [spec.limits[0] for spec in specs],
        "joint_max_position": [spec.limits[1] for spec in specs],
    }
    return {name: np.clip(np.array(value, dtype=np.float64), -UNBOUNDED, UNBOUNDED) for name, value in values.items()}


def _frame(scene: Scene, frames: FrameLayout, part: tuple[Handle, int]) -> int:
    handle, node = part
    if isinstance(handle, RigidBody):
        return int(handle)
    return len(scene.rigids) + int(frames.rod_start[handle]) + node


def _check(spec: JointSpec, frames: FrameLayout, pair: list[int]) -> None:
    masters = [int(frames.master[f]) for f in pair if f >= 0]
    if len(masters) == 2 and masters[0] == masters[1]:
        raise ValueError(
            f"joint {spec.name!r} connects parts that are attached to each other and move as one; "
            "remove the joint or the attachment"
        )
    if not any(frames.free[m].any() for m in masters):
        raise ValueError(f"joint {spec.name!r} connects parts that cannot move; remove it, or free one of them")


def _joint_pose(spec: JointSpec) -> FloatArray:
    """Anchor, and the shortest turn that brings z to the joint's axis."""
    x, y, z = spec.axis
    q = np.array([-y, x, 0.0, 1.0 + z]) if z > -0.9 else np.array([1.0 - z, 0.0, x, -y])
    return np.concatenate([spec.anchor, q / np.linalg.norm(q)])


def _length(frames: FrameLayout, pair: list[int], anchor: FloatArray) -> float:
    """Largest radius of gyration about the anchor [m] among what the joint's sides carry; 1 m without mass."""
    masters = {int(frames.master[f]) for f in pair if f >= 0}
    squares = [0.0]
    for f in np.flatnonzero(np.isin(frames.master, list(masters)) & (frames.volume > 0.0)):
        lever = frames.pose[f, :3] - anchor
        squares.append(float(lever @ lever + 0.5 * np.trace(frames.inertia[f]) / frames.volume[f]))
    return float(np.sqrt(max(squares))) or 1.0


def _is_unlimited(spec: JointSpec) -> bool:
    """Whether the row of the coordinate has no bounds, so that it can be eliminated.

    A rigid motor that nothing stops keeps to the limits by its reference, and needs no others.
    """
    is_rigid = spec.control == "velocity" or not np.isfinite(spec.stiffness)
    is_open = is_rigid or not np.isfinite(spec.limits).any()
    return spec.control in ("position", "velocity") and not np.isfinite(spec.max_force) and is_open


def _rows(spec: JointSpec, frames: FrameLayout, pair: list[int], axes: FloatArray) -> Held:
    """Kinds and axes of a joint's rows: what it holds, then motor and limits."""
    held = HELD[spec.kind]
    coordinate = [(JointRow.FREE, 2)] if spec.control != "none" or np.isfinite(spec.limits).any() else []
    master = frames.master[pair[1]]
    child = frames.free[master]
    if pair[0] < 0 and spec.kind == "hinge" and _turns_about(spec, frames, int(master), axes):
        return [(kind, axis) for kind, axis in held if kind == JointRow.POINT and child[axis]] + coordinate
    if pair[0] >= 0 or child[3:].any():
        return held + coordinate
    # The child never turns, so rows keep their directions: those that no free axis can violate are left out.
    share = {
        JointRow.POINT: np.eye(3),
        JointRow.SIDE: axes.T,
        JointRow.TILT: np.zeros((3, 3)),
        JointRow.LOCK: np.zeros((3, 3)),
    }
    held = [(kind, axis) for kind, axis in held if np.abs(share[kind][axis] * child[:3]).max() > SMALL]
    moved = axes.T[2] * child[:3] if COORDINATE[spec.kind] == JointCoordinate.WAY else np.zeros(3)
    if coordinate and np.abs(moved).max() <= SMALL:
        raise ValueError(f"joint {spec.name!r}: the free_axes of the child lock its axis; free an axis along it")
    return held + coordinate


def _turns_about(spec: JointSpec, frames: FrameLayout, frame: int, axes: FloatArray) -> bool:
    """Whether the free axes of a frame let it turn about the joint's axis through the anchor, and about no other."""
    free = frames.free[frame, 3:]
    if free.sum() != 1:
        return False
    turn, lever = np.eye(3)[free][0], spec.anchor - frames.pose[frame, :3]
    apart = [np.cross(turn, axes.T[2]), np.cross(turn, lever) / max(1.0, float(np.linalg.norm(lever)))]
    return float(np.abs(apart).max()) <= ALIGNED
