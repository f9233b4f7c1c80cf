"""Rigid bodies, rods, air chambers and joints of a scene as pictures and files need them: shapes, radii, surfaces.

All this stays the same while the parts move; arrays are plain numpy and go into trajectory files as they are.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp.io.arrays import Declared, TrajectoryError, normalise, nothing
from softwarp.model.codes import JOINT_KINDS
from softwarp.shapes import Box, Capsule, Cylinder, Kind, Plane, Shape, Sphere
from softwarp.shapes.base import rotation_matrix

if TYPE_CHECKING:
    from softwarp.model.cavities import MembraneModel
    from softwarp.model.model import Model

Array = NDArray[Any]
Floats = NDArray[np.float64]
Ints = NDArray[np.int32]


DECLARED: Declared = {
    "rigid_kinematic": (("rigid",), "bool"),
    "piece_rigid": (("piece",), "int32"),
    "piece_kind": (("piece",), "int32"),
    "piece_size": (("piece", 3), "float64"),
    "piece_pose": (("piece", 7), "float64"),
    "piece_vertex_start": (("piece_end",), "int32"),
    "piece_tri_start": (("piece_end",), "int32"),
    "piece_vertex": (("piece_vertex", 3), "float32"),
    "piece_tri": (("piece_tri", 3), "int32"),
    "rod_point_start": (("rod_end",), "int32"),
    "rod_radius": (("rod_point",), "float32"),
    "cavity_point_start": (("cavity_end",), "int32"),
    "cavity_tri": (("cavity_tri", 3), "int32"),
    "cavity_body": (("cavity",), "int32"),
    "joint_kind": (("joint",), "int32"),
    "joint_frame": (("joint", 2), "int32"),
    "joint_pose": (("joint", 7), "float64"),
}
NAMES = ("rigid_names", "rod_names", "cavity_names", "joint_names")


def _start() -> Array:
    return np.zeros(1, dtype=np.int32)


@dataclass(frozen=True, kw_only=True, eq=False)
class Parts:
    """What stays the same of rigid bodies, rods, chambers and joints.

    A rigid body consists of *pieces*, simple shapes with a pose in the body's frame; only those of meshes and distance
    grids have vertices and triangles of their own.

    Attributes:
        rigid_names: A name per rigid body.
        rod_names: A name per rod.
        cavity_names: A name per air chamber.
        joint_names: A name per joint.
        rigid_kinematic: Whether the body's motion is prescribed, shape (rigid,).
        piece_rigid: Rigid body of each piece, shape (piece,).
        piece_kind: A ``shapes.Kind``, shape (piece,).
        piece_size: Radius, radius and length, edges, or drawn edge of a plane [m], shape (piece, 3).
        piece_pose: Position [m] and quaternion x y z w in the body's frame, shape (piece, 7).
        piece_vertex_start: Ranges in ``piece_vertex``, shape (piece + 1,).
        piece_tri_start: Ranges in ``piece_tri``, shape (piece + 1,).
        piece_vertex: Vertices in the frame of the piece [m], shape (piece_vertex, 3).
        piece_tri: Outward triangles, indices counted from the piece's first vertex, shape (piece_tri, 3).
        rod_point_start: Rod r owns the nodes start[r] to start[r + 1], shape (rod + 1,).
        rod_radius: Radius at the nodes [m], shape (rod_point,).
        cavity_point_start: Chamber c owns the points start[c] to start[c + 1], shape (cavity + 1,).
        cavity_tri: Outward triangles as indices of all chambers' points, shape (cavity_tri, 3).
        cavity_body: Soft body that holds the chamber, shape (cavity,).
        joint_kind: Index into ``JOINT_KINDS``, shape (joint,).
        joint_frame: What it joins, parent and child: a rigid body, a rod node counted after those, or -1 for the world,
            shape (joint, 2).
        joint_pose: Its anchor [m] and orientation in the child's frame, its axis being z, shape (joint, 7).
    """

    rigid_names: tuple[str, ...] = ()
    rod_names: tuple[str, ...] = ()
    cavity_names: tuple[str, ...] = ()
    joint_names: tuple[str, ...] = ()
    rigid_kinematic: Array = field(default_factory=nothing)
    piece_rigid: Array = field(default_factory=nothing)
    piece_kind: Array = field(default_factory=nothing)
    piece_size: Array = field(default_factory=nothing)
    piece_pose: Array = field(default_factory=nothing)
    piece_vertex_start: Array = field(default_factory=_start)
    piece_tri_start: Array = field(default_factory=_start)
    piece_vertex: Array = field(default_factory=nothing)
    piece_tri: Array = field(default_factory=nothing)
    rod_point_start: Array = field(default_factory=_start)
    rod_radius: Array = field(default_factory=nothing)
    cavity_point_start: Array = field(default_factory=_start)
    cavity_tri: Array = field(default_factory=nothing)
    cavity_body: Array = field(default_factory=nothing)
    joint_kind: Array = field(default_factory=nothing)
    joint_frame: Array = field(default_factory=nothing)
    joint_pose: Array = field(default_factory=nothing)

    def __post_init__(self) -> None:
        sizes = self.sizes()
        normalise(self, DECLARED, sizes)
        for name in NAMES:
            object.__setattr__(self, name, tuple(getattr(self, name)))
        _check_ranges("rod_point_start", self.rod_point_start, self.rod_count, sizes["rod_point"], 2)
        _check_ranges("cavity_point_start", self.cavity_point_start, self.cavity_count, self.cavity_point_count, 4)
        _check_ranges("piece_vertex_start", self.piece_vertex_start, sizes["piece"], sizes["piece_vertex"], 0)
        _check_ranges("piece_tri_start", self.piece_tri_start, sizes["piece"], sizes["piece_tri"], 0)
        _check_indices("piece_rigid", self.piece_rigid, 0, self.rigid_count)
        _check_indices("cavity_tri", self.cavity_tri, 0, self.cavity_point_count)
        _check_indices("joint_frame", self.joint_frame, -1, self.rigid_count + self.rod_point_count)
        _check_indices("joint_kind", self.joint_kind, 0, len(JOINT_KINDS))

    def sizes(self) -> dict[str, int]:
        """Lengths of the axes that the moving arrays share with these."""
        points = {"rod_point": self.rod_point_start, "cavity_point": self.cavity_point_start}
        counts = {name.removesuffix("_names"): len(getattr(self, name)) for name in NAMES}
        return counts | {axis: int(np.asarray(start)[-1]) for axis, start in points.items()}

    @property
    def rigid_count(self) -> int:
        """Rigid bodies."""
        return len(self.rigid_names)

    @property
    def rod_count(self) -> int:
        """Rods."""
        return len(self.rod_names)

    @property
    def rod_point_count(self) -> int:
        """Nodes of all rods."""
        return int(self.rod_point_start[-1])

    @property
    def cavity_count(self) -> int:
        """Air chambers."""
        return len(self.cavity_names)

    @property
    def cavity_point_count(self) -> int:
        """Points of all chambers' surfaces."""
        return int(self.cavity_point_start[-1])

    @property
    def joint_count(self) -> int:
        """Joints."""
        return len(self.joint_names)

    def rod_points(self, rod: int) -> slice:
        """Nodes of one rod."""
        return slice(int(self.rod_point_start[rod]), int(self.rod_point_start[rod + 1]))

    def cavity_points(self, cavity: int) -> slice:
        """Points of one chamber."""
        return slice(int(self.cavity_point_start[cavity]), int(self.cavity_point_start[cavity + 1]))

    def pieces(self, rigid: int) -> list[int]:
        """Pieces of one rigid body."""
        return [int(p) for p in np.flatnonzero(self.piece_rigid == rigid)]

    def joint_line(self, joint: int, frame_pose: Array, half: float) -> Floats:
        """Anchor of a joint and the two ends of a line along its axis [m], shape (..., 3, 3).

        Args:
            joint: Which one.
            frame_pose: Poses of all rigid bodies, then of all rod nodes, shape (..., frame, 7).
            half: Distance of the ends from the anchor [m].
        """
        local = posed(self.joint_pose[joint], np.array([0.0, 0.0, half]) * np.array([[0.0], [-1.0], [1.0]]))
        return posed(frame_pose[..., int(self.joint_frame[joint, 1]), :], local)

    def piece_shape(self, piece: int) -> Shape | None:
        """The shape of a primitive piece, None for a mesh or a grid."""
        x, y, z = (float(v) for v in self.piece_size[piece])
        kind = Kind(int(self.piece_kind[piece]))
        if kind is Kind.PLANE:
            return Plane(drawn_size=x)
        if kind is Kind.SPHERE:
            return Sphere(x)
        if kind is Kind.CAPSULE:
            return Capsule(x, y)
        if kind is Kind.BOX:
            return Box((x, y, z))
        return Cylinder(x, y) if kind is Kind.CYLINDER else None

    def piece_surface(self, piece: int, resolution: int = 32) -> tuple[Floats, Ints]:
        """Outward triangles of a piece in its own frame.

        Args:
            piece: Which one.
            resolution: Corners of a full circle.

        Returns:
            Vertices [m], shape (v, 3), and corners, shape (t, 3).
        """
        shape = self.piece_shape(piece)
        if shape is not None:
            return shape.surface(resolution)
        vertices = slice(*(int(i) for i in self.piece_vertex_start[piece : piece + 2]))
        triangles = slice(*(int(i) for i in self.piece_tri_start[piece : piece + 2]))
        return self.piece_vertex[vertices].astype(np.float64), self.piece_tri[triangles]

    def piece_bounds(self, piece: int) -> Floats:
        """Corners of the box around a piece in the body's frame [m], shape (8, 3)."""
        x = self.piece_surface(piece, 16)[0]
        low, high = x.min(axis=0), x.max(axis=0)
        corners = np.array([[p, q, r] for p in (low[0], high[0]) for q in (low[1], high[1]) for r in (low[2], high[2])])
        return posed(self.piece_pose[piece], corners)

    def is_plane(self, piece: int) -> bool:
        """Whether a piece is an unbounded plane."""
        return int(self.piece_kind[piece]) == Kind.PLANE

    def rod_outline(self, rod_x: Array) -> Floats:
        """Points [m] around all rods whose nodes are at ``rod_x``, shape (..., rod_point, 3); twice as many."""
        radius = self.rod_radius[:, None]
        return np.concatenate([rod_x - radius, rod_x + radius], axis=-2).astype(np.float64)

    def rigid_outline(self, rigid_pose: Array, rigid: Iterable[int]) -> list[Floats]:
        """Corners of the boxes around the pieces of some rigid bodies [m], planes left out.

        Args:
            rigid_pose: Poses of all rigid bodies, shape (..., rigid, 7).
            rigid: Which rigid bodies; one without a shape has its origin as its outline.

        Returns:
            Arrays of shape (..., n, 3).
        """
        found = [np.empty((*rigid_pose.shape[:-2], 0, 3))]
        for body in rigid:
            pieces = self.pieces(int(body))
            solid = [posed(rigid_pose[..., body, :], self.piece_bounds(p)) for p in pieces if not self.is_plane(p)]
            found += solid if pieces else [np.asarray(rigid_pose[..., [body], :3], dtype=np.float64)]
        return found

    def scene_size(self, soft_x: Array, rigid_pose: Array, rod_x: Array) -> float:
        """Extent of what moves, soft bodies, rods and free rigid bodies, or else of all [m]; 1 for planes alone.

        It is the measure of things that are drawn without having a size: cables, goals, arrows.

        Args:
            soft_x: Points of soft bodies at rest [m], shape (n, 3).
            rigid_pose: Poses of all rigid bodies at rest, shape (..., rigid, 7).
            rod_x: Nodes of all rods at rest [m], shape (..., rod_point, 3).
        """
        free = [int(body) for body in np.flatnonzero(~self.rigid_kinematic)]
        for rigid in (free, range(self.rigid_count)):
            found = [soft_x, self.rod_outline(rod_x), *self.rigid_outline(rigid_pose, rigid)]
            points = np.concatenate([p.reshape(-1, 3) for p in found])
            points = points[np.isfinite(points).all(axis=1)]
            extent = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
            if extent > 0.0:
                return extent
        return 1.0

    def ground(self, rigid_pose: ArrayLike, up: ArrayLike) -> int | None:
        """The kinematic plane that serves as the floor of pictures: the first one that lies level, or None.

        Args:
            rigid_pose: Poses of all rigid bodies at the start, shape (rigid, 7).
            up: Unit vector against gravity.

        Returns:
            Its piece.
        """
        pose = np.asarray(rigid_pose, dtype=np.float64)
        for piece, rigid in enumerate(self.piece_rigid):
            if self.is_plane(piece) and self.rigid_kinematic[rigid]:
                turn = rotation_matrix(pose[rigid, 3:]) @ rotation_matrix(self.piece_pose[piece, 3:])
                if float(turn[:, 2] @ np.asarray(up)) > 1.0 - 1e-4:
                    return piece
        return None

    @classmethod
    def of_model(cls, model: Model) -> Parts:
        """The parts of a model."""
        given: dict[str, Any] = {"rigid_names": model.rigid_names, "rod_names": model.rod_names}
        given |= _pieces(model.rigid_shapes)
        if model.frames is not None:
            given |= {
                "rigid_kinematic": model.frames.is_kinematic,
                "rod_point_start": model.frames.rod_start,
                "rod_radius": model.frames.rod_radius,
            }
        if model.cavities is not None:
            given |= {
                "cavity_names": model.cavity_names,
                "cavity_point_start": model.cavities.starts,
                "cavity_tri": model.cavities.triangles,
                "cavity_body": model.cavities.body,
            }
        if model.joints is not None:
            given |= {
                "joint_names": model.joint_names,
                "joint_kind": np.array([JOINT_KINDS.index(kind) for kind in model.joints.kinds]),
                "joint_frame": model.joints.frames,
                "joint_pose": model.joints.joint_place.numpy()[:, 7:],
            }
        return cls(**given)


def posed(pose: ArrayLike, points: ArrayLike) -> Floats:
    """Local points [m], shape (n, 3), in the frame of their poses, shape (..., 7); shape (..., n, 3)."""
    where = np.asarray(pose, dtype=np.float64)
    R = rotation_matrix(where[..., 3:])
    return np.asarray(np.asarray(points) @ np.swapaxes(R, -1, -2) + where[..., None, :3])


class ChamberPoints:
    """Where the points of chambers are: each follows up to four nodes of a soft body, or is fixed in space."""

    def __init__(self, model: Model) -> None:
        self._node, self._weight = np.zeros((0, 4), dtype=np.int32), np.zeros((0, 4))
        self._anchor = np.zeros((0, 3))
        if model.cavities is None:
            return
        first = int(model.cable_starts[-1])
        mine = slice(first, first + int(model.cavities.starts[-1]))
        node = model.point_node.numpy()[mine]
        self._node = np.maximum(node, 0)
        self._weight = np.where(node >= 0, model.point_weight.numpy()[mine], 0.0)
        self._anchor = model.point_anchor.numpy()[mine]

    def __call__(self, node_x: Array) -> Floats:
        """Positions [m], shape (world, cavity_point, 3), for node positions of shape (world, node, 3)."""
        if not len(self._anchor):
            return np.zeros((len(node_x), 0, 3))
        moved = np.einsum("pk,wpki->wpi", self._weight, np.asarray(node_x, dtype=np.float64)[:, self._node])
        return np.asarray(moved + self._anchor)


def tri_membrane(surface: ArrayLike, membranes: MembraneModel) -> NDArray[np.int32]:
    """Membrane that covers each surface triangle, -1 for none, shape (tri,); the last one where several do."""
    covered = np.sort(np.asarray(membranes.triangles), axis=1)
    owner = membranes.tri_membrane.numpy()
    found = {tuple(corners): int(number) for corners, number in zip(covered.tolist(), owner, strict=True)}
    corners = np.sort(np.asarray(surface).reshape(-1, 3), axis=1).tolist()
    return np.array([found.get(tuple(c), -1) for c in corners], dtype=np.int32)


def _pieces(shapes: tuple[Shape | None, ...]) -> dict[str, Any]:
    """Arrays of the pieces of all rigid bodies."""
    members = [(rigid, part) for rigid, shape in enumerate(shapes) if shape is not None for part in shape.parts()]
    own = [part.shape.kind in (Kind.MESH, Kind.GRID) for _, part in members]
    surfaces = [part.shape.surface() for (_, part), has in zip(members, own, strict=True) if has]
    empty: tuple[Floats, Ints] = (np.empty((0, 3)), np.empty((0, 3), dtype=np.int32))
    rest = iter(surfaces)
    each = [next(rest) if has else empty for has in own]
    return {
        "piece_rigid": np.array([rigid for rigid, _ in members], dtype=np.int32),
        "piece_kind": np.array([int(part.shape.kind) for _, part in members], dtype=np.int32),
        "piece_size": np.array([_size(part.shape) for _, part in members]).reshape(-1, 3),
        "piece_pose": np.array([np.append(part.position, part.quaternion) for _, part in members]).reshape(-1, 7),
        "piece_vertex_start": np.concatenate([[0], np.cumsum([len(x) for x, _ in each])]),
        "piece_tri_start": np.concatenate([[0], np.cumsum([len(t) for _, t in each])]),
        "piece_vertex": np.concatenate([empty[0], *(x for x, _ in each)]),
        "piece_tri": np.concatenate([empty[1], *(t for _, t in each)]),
    }


def _size(shape: Shape) -> tuple[float, float, float]:
    return (shape.drawn_size, 0.0, 0.0) if isinstance(shape, Plane) else shape.size


def _check_ranges(name: str, start: Array, items: int, total: int, least: int) -> None:
    fits = start.size == items + 1 and start[0] == 0 and start[-1] == total and np.all(np.diff(start) >= least)
    if not fits:
        raise TrajectoryError(
            f"trajectory: {name} must rise from 0 to {total} in {items} steps of at least {least}, got {start.tolist()}"
        )


def _check_indices(name: str, values: Array, low: int, high: int) -> None:
    if values.size and not (values.min() >= low and values.max() < high):
        raise TrajectoryError(
            f"trajectory: {name} must lie in [{low}, {high}), got {values.min()} to {values.max()}; record it again"
        )
