"""Objects that overlap before a simulation starts, found on the host: a solver would push them apart violently."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp.kernels.algebra.lanes import variant
from softwarp.model.codes import SUM_OF_POINTS, Target
from softwarp.model.contact import CollisionScene, Entity, Topology
from softwarp.shapes.base import Kind, rotation_matrix
from softwarp.solvers.collision.detector import Detector, PairParameters
from softwarp.solvers.workspace import rows

if TYPE_CHECKING:
    from softwarp.solvers.workspace.rows import Rows

FloatArray = NDArray[np.float64]
DEEPEST = 1.0e14  # finite penetration limit of the check [m]: whatever is inside counts


@dataclass(frozen=True)
class Overlap:
    """Two objects of a contact pair that overlap.

    Attributes:
        a, b: Names of the objects.
        pair: Their contact pair.
        depth: Deepest penetration of a corner or an edge [m].
        limit: Half of the smallest side of the smaller object [m].
        is_engulfed: Whether the centre of one lies inside the other.
    """

    a: str
    b: str
    pair: int
    depth: float
    limit: float
    is_engulfed: bool

    @property
    def is_deep(self) -> bool:
        """Whether contact forces could push the objects out on the wrong side."""
        return self.is_engulfed or self.depth > self.limit

    def __str__(self) -> str:
        """One line for an error message."""
        inside = "the centre of one lies inside the other" if self.is_engulfed else f"more than {self.limit:.3g} m"
        by = f" by {self.depth:.3g} m" if self.depth > 0.0 else ""  # none where no surface cuts the other
        return f"{self.a!r} and {self.b!r} overlap{by} at the start ({inside}); move them apart"


def initial_overlaps(scene: CollisionScene, topology: Topology, x: ArrayLike, pose: ArrayLike) -> list[Overlap]:
    """Every overlap of two different objects of a pair, in one world.

    Args:
        scene: Objects and pairs.
        topology: How nodes and frames hang together.
        x: Node positions [m], shape (3 node,) or (node, 3).
        pose: Poses of frames, shape (7 frame,) or (frame, 7).

    Returns:
        Overlaps, the deepest first.
    """
    poses = np.asarray(pose, dtype=np.float64).reshape(-1, 7)
    depth = _depths(scene, topology, np.asarray(x, dtype=np.float64).reshape(-1), poses)
    nodes = topology.places(x).reshape(-1)
    found = []
    pairs = {tuple(sorted((c.a, c.b))): c.pair for c in scene.couples if not c.own}
    for (i, j), pair in pairs.items():
        a, b = scene.entities[i], scene.entities[j]
        engulfed = any(
            _is_inside(scene, one, _centre(scene, other, nodes, poses), nodes, poses) for one, other in ((a, b), (b, a))
        )
        deepest = depth.get((i, j), 0.0)
        if deepest > 0.0 or engulfed:
            found.append(Overlap(a.name, b.name, pair, deepest, min(a.radius, b.radius), engulfed))
    return sorted(found, key=lambda overlap: (-overlap.depth, overlap.a, overlap.b))


def refuse_deep(scene: CollisionScene, topology: Topology, x: ArrayLike, pose: ArrayLike) -> None:
    """Refuse a start in which contact forces could push objects out on the wrong side.

    Args:
        scene: Objects and pairs.
        topology: How nodes and frames hang together.
        x: Node positions [m], shape (node, 3).
        pose: Poses of frames, shape (frame, 7).

    Raises:
        ValueError: Naming the two objects and the depth of the overlap.
    """
    nodes = topology.places(x).reshape(-1)
    poses = np.asarray(pose, dtype=np.float64).reshape(-1, 7)
    pairs = {(c.a, c.b) for c in scene.couples if not c.own}
    if not any(_may_be_deep(scene, scene.entities[a], scene.entities[b], nodes, poses) for a, b in pairs):
        return  # spares the kernels of the exact search in nearly every scene
    deep = [overlap for overlap in initial_overlaps(scene, topology, x, poses) if overlap.is_deep]
    if deep:
        more = f" ({len(deep)} pairs overlap deeply)" if len(deep) > 1 else ""
        raise ValueError(f"contact: {deep[0]}{more}")


def _may_be_deep(scene: CollisionScene, a: Entity, b: Entity, nodes: FloatArray, poses: FloatArray) -> bool:
    """Whether the boxes of two objects overlap by more than a deep overlap needs along every axis."""
    limit = min(a.radius, b.radius)
    if Kind.PLANE in (a.kind, b.kind):
        plane, other = (a, b) if a.kind == Kind.PLANE else (b, a)
        target = scene.targets.array("x", np.float64, (3,))[plane.target]
        turn = rotation_matrix(scene.targets.array("q", np.float64, (4,))[plane.target])
        position, R = _place(plane, poses)
        normal = R @ turn[:, 2]
        low, high = _box(scene, other, nodes, poses)
        lowest = (normal @ (low + high) - np.abs(normal) @ (high - low)) / 2.0
        return bool(normal @ (position + R @ target) - lowest > limit)
    first, second = _box(scene, a, nodes, poses), _box(scene, b, nodes, poses)
    overlap = np.minimum(first[1], second[1]) - np.maximum(first[0], second[0])
    return bool((overlap > limit).all())


def _box(scene: CollisionScene, entity: Entity, nodes: FloatArray, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Corners of a box around an object in world axes [m]."""
    if entity.frame == SUM_OF_POINTS:
        points = _vertices(scene, entity, nodes, poses)
        around = entity.radius if entity.kind == Target.CHAIN else 0.0
        return points.min(axis=0) - around, points.max(axis=0) + around
    position, R = _place(entity, poses)
    centre, half = position + R @ entity.centre, np.abs(R) @ entity.extent
    return centre - half, centre + half


def _depths(
    scene: CollisionScene, topology: Topology, nodes: FloatArray, poses: FloatArray
) -> dict[tuple[int, int], float]:
    """Deepest penetration of features by pair of objects [m]."""
    exact = variant("scalar", "float64")

    def filled(values: FloatArray) -> Rows:
        result = rows.allocate(exact, 1, max(values.size, 1), "cpu")
        if values.size:
            result.real.assign(values.reshape(1, -1, 1))
        return result

    detector = Detector(exact, 1, scene, topology, max(scene.key_count, 1), "cpu")
    detector.scene.target_depth.fill_(DEEPEST)
    zero = filled(np.zeros(max(scene.pair_count, 1)))
    laws = PairParameters(zero, zero, zero, zero, zero)
    at, still, turning = filled(poses.reshape(-1)), filled(np.zeros_like(nodes)), filled(np.zeros(6 * len(poses)))
    detector.find(filled(nodes), at, still, turning, 0.0, laws)
    count = int(detector.contacts.count.real.numpy()[0, 0, 0])
    gap = detector.contacts.gap.real.numpy()[0, :count, 0]
    owner = detector.couple.real.numpy()[0, :count, 0]
    depth: dict[tuple[int, int], float] = {}
    for g, number in zip(gap, owner, strict=True):
        couple = scene.couples[int(number)]
        objects = (min(couple.a, couple.b), max(couple.a, couple.b))
        if not couple.own and g < 0.0:
            depth[objects] = max(depth.get(objects, 0.0), -float(g))
    return depth


def _place(entity: Entity, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Position and rotation of the frame of a rigid object."""
    if entity.frame < 0:
        return np.zeros(3), np.eye(3)
    return poses[entity.frame, :3], rotation_matrix(poses[entity.frame, 3:])


def _vertices(scene: CollisionScene, entity: Entity, nodes: FloatArray, poses: FloatArray) -> FloatArray:
    """Positions of an object's points [m]."""
    some = np.arange(*entity.points)
    index = scene.points.array("index", np.int64)[some]
    if entity.kind in (Target.SOFT, Target.POINTS):
        return np.asarray(nodes.reshape(-1, 3)[index])
    if entity.kind == Target.CHAIN:
        return np.asarray(poses[index, :3])
    position, R = _place(entity, poses)
    local: FloatArray = scene.points.array("local", np.float64, (3,))[some]
    return np.asarray(local @ R.T + position)


def _centre(scene: CollisionScene, entity: Entity, nodes: FloatArray, poses: FloatArray) -> FloatArray | None:
    """Middle of an object [m]; None for planes, and for rods, whose nodes are points anyway."""
    if entity.kind in (Kind.PLANE, Target.CHAIN, Target.POINTS):
        return None
    if entity.frame == SUM_OF_POINTS:
        return np.asarray(_vertices(scene, entity, nodes, poses).mean(axis=0))
    position, R = _place(entity, poses)
    return np.asarray(position + R @ entity.centre)


def _is_inside(
    scene: CollisionScene, entity: Entity, p: FloatArray | None, nodes: FloatArray, poses: FloatArray
) -> bool:
    """Whether a point lies inside an object."""
    if p is None or entity.kind in (Target.CHAIN, Target.POINTS):
        return False
    if entity.kind in (Target.SOFT, Kind.MESH):
        first, last = scene.targets.array("faces", np.int64, (2,))[entity.target]
        corner = scene.faces.array("corner", np.int64, (3,))[first:last] - entity.points[0]
        return _winding(_vertices(scene, entity, nodes, poses)[corner] - p) > 0.5
    position, R = _place(entity, poses)
    row: dict[str, Any] = {name: values[entity.target] for name, values in scene.targets.rows.items()}
    local = rotation_matrix(row["q"]).T @ (R.T @ (p - position) - np.asarray(row["x"]))
    if entity.kind == Kind.GRID:
        start, *samples = row["grid"]
        values = np.concatenate(scene.grid_values)[start : start + int(np.prod(samples))].reshape(samples)
        cell = np.round((local - row["origin"]) / row["spacing"]).astype(int)
        return bool(
            np.all((cell >= 0) & (cell < samples)) and values[tuple(np.clip(cell, 0, np.array(samples) - 1))] < 0.0
        )
    return _primitive_depth(entity.kind, np.asarray(row["size"], dtype=np.float64), local) > 0.0


def _primitive_depth(kind: int, size: FloatArray, p: FloatArray) -> float:
    """How far a local point is below the surface of a primitive, at most [m]."""
    away = float(np.linalg.norm(p))
    if kind == Kind.PLANE:
        return float(-p[2])
    if kind == Kind.SPHERE:
        return float(size[0]) - away
    if kind == Kind.CAPSULE:
        half = 0.5 * float(size[1])
        return float(size[0] - np.linalg.norm(p - np.array([0.0, 0.0, np.clip(p[2], -half, half)])))
    if kind == Kind.CYLINDER:
        return float(min(size[0] - np.hypot(p[0], p[1]), 0.5 * size[1] - abs(p[2])))
    return float(np.min(0.5 * size - np.abs(p)))


def _winding(corner: FloatArray) -> float:
    """Winding number of triangles about the origin (Van Oosterom and Strackee 1983), corners (t, 3, 3)."""
    a, b, c = (corner[:, k] for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    top = np.sum(a * np.cross(b, c), axis=1)
    bottom = la * lb * lc + np.sum(a * b, axis=1) * lc + np.sum(b * c, axis=1) * la + np.sum(c * a, axis=1) * lb
    return float(np.arctan2(top, bottom).sum() / (2.0 * np.pi))
