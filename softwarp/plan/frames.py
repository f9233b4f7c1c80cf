"""From rigid bodies, rods and attachments to frames: masters, what they carry, inertia. Host only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from softwarp.model.codes import Spin
from softwarp.scene.parts import Handle, Rod
from softwarp.shapes.base import quaternion_product, rotation_matrix

if TYPE_CHECKING:
    from softwarp.builder import ModelBuilder

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]
IDENTITY = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


@dataclass
class FrameLayout:
    """Frames of a scene before the elimination order is known; see ``FrameModel`` for the terms."""

    node_count: int
    body_node_count: int  # without guides
    rigid_count: int
    rod_start: IntArray
    pose: FloatArray  # (frame, 7)
    twist: FloatArray  # (frame, 6)
    master: IntArray
    offset: FloatArray  # (frame, 7)
    owner: IntArray
    volume: FloatArray
    inertia: FloatArray  # (frame, 3, 3)
    free: NDArray[np.bool_]  # (frame, 6), of masters
    spin: IntArray
    turning: IntArray  # masters that turn freely and that something holds
    carried_slot: IntArray
    carried_frame: IntArray
    carried_offset: FloatArray
    node_frame: IntArray
    segment_frames: IntArray  # (segment, 2)
    segment_rod: IntArray
    segments: dict[str, NDArray[Any]]  # length, section, scale, rest
    radius: FloatArray  # (rod node,)
    is_kinematic: NDArray[np.bool_]  # (rigid,)
    blend_ends: IntArray  # (blend, 2) frames at the ends of the segment that a blended frame lies on
    blend_place: FloatArray  # (blend, 2) place along it, 0 to 1, and its length [m]

    @property
    def first_blend(self) -> int:
        """First blended frame: they are the last ones."""
        return self.count - len(self.blend_ends)

    def rod_chain(self, rod: int) -> IntArray:
        """Frames along a rod with the blended ones between its nodes."""
        nodes = self.rigid_count + np.arange(self.rod_start[rod], self.rod_start[rod + 1])
        place = {int(frame): float(k) for k, frame in enumerate(nodes)}
        for k, (ends, (s, _)) in enumerate(zip(self.blend_ends, self.blend_place, strict=True)):
            if int(ends[0]) in place:
                place[self.first_blend + k] = place[int(ends[0])] + float(s)
        return np.array(sorted(place, key=lambda frame: place[frame]), dtype=np.int32)

    @property
    def rod_count(self) -> int:
        """Rods."""
        return len(self.rod_start) - 1

    @property
    def count(self) -> int:
        """Frames."""
        return len(self.pose)

    @property
    def corners(self) -> IntArray:
        """Slots of the corners of every segment, (segment, 4)."""
        t = self.node_count + 2 * self.segment_frames
        return np.stack([t[:, 0], t[:, 0] + 1, t[:, 1], t[:, 1] + 1], axis=1).astype(np.int32)

    @property
    def slot_count(self) -> int:
        """Nodes, then translations and rotations of frames."""
        return self.node_count + 2 * self.count

    def inertia_in_master(self) -> FloatArray:
        """Inertia of every frame in the axes of its master, (frame, 3, 3)."""
        turns = np.array([rotation_matrix(q) for q in self.offset[:, 3:]]).reshape(-1, 3, 3)
        return np.asarray(turns @ self.inertia @ turns.transpose(0, 2, 1))


def layout(builder: ModelBuilder, node_start: IntArray, nodes: FloatArray) -> FrameLayout:
    """Number the frames of a scene and resolve its attachments.

    Raises:
        ValueError: If a part is attached twice, or to itself over other parts.
    """
    rigids, rods = builder.rigids, builder.rods
    counts = [len(r.geometry.positions) for r in rods]
    rod_start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    base = len(rigids)
    off_centre = [i for i, r in enumerate(rigids) if r.mass > 0.0 and np.abs(r.centre).max() > 1e-9]
    blend_ends, blend_place = _blends(builder, base, rod_start)
    first_blend = base + int(rod_start[-1]) + len(off_centre)
    count = first_blend + len(blend_ends)
    pose = np.tile(IDENTITY, (count, 1))
    twist, inertia = np.zeros((count, 6)), np.zeros((count, 3, 3))
    volume, owner = np.zeros(count), np.zeros(count, dtype=np.int32)
    free = np.ones((count, 6), dtype=bool)
    parent: dict[int, int] = {}
    for i, rigid in enumerate(rigids):
        pose[i], twist[i], owner[i], free[i] = rigid.pose, rigid.twist, i, rigid.free
        heavy = i
        if i in off_centre:
            heavy = base + int(rod_start[-1]) + off_centre.index(i)
            pose[heavy] = rigid.pose
            pose[heavy, :3] += rotation_matrix(rigid.pose[3:]) @ rigid.centre
            parent[heavy], owner[heavy] = i, i
        if rigid.mass > 0.0:
            volume[heavy], inertia[heavy] = 1.0, rigid.inertia / rigid.mass
    radius = np.zeros(int(rod_start[-1]))
    for r, rod in enumerate(rods):
        frames = base + np.arange(rod_start[r], rod_start[r + 1])
        g = rod.geometry
        pose[frames, :3], pose[frames, 3:] = g.positions, g.quaternions
        owner[frames], volume[frames] = base + r, g.node_volume
        inertia[frames] = np.einsum("ni,ij->nij", g.node_inertia, np.eye(3))
        free[frames] = ~rod.clamped[:, None]
        ends = np.asarray(np.broadcast_to(g.radius, len(g.length)), dtype=np.float64)
        radius[rod_start[r] : rod_start[r + 1]] = np.maximum(np.append(ends, ends[-1]), np.append(ends[0], ends))
    for k, (ends, (s, length)) in enumerate(zip(blend_ends.tolist(), blend_place.tolist(), strict=True)):
        pose[first_blend + k] = blended(pose[ends[0]], pose[ends[1]], s, length)
        parent[first_blend + k], owner[first_blend + k] = ends[0], owner[ends[0]]
    carried = _welds(builder, node_start, rod_start, parent)
    for number, (part, place) in enumerate(_guides(builder)):
        carried[int(node_start[-1]) + number] = _nearest_frame(builder, base, rod_start, part, place)
    master = np.array([_root(f, parent, builder) for f in range(count)], dtype=np.int32)
    offset = np.array([relative(pose[m], pose[f]) if m != f else IDENTITY for f, m in enumerate(master)]).reshape(-1, 7)

    node_count = len(nodes)
    node_frame = np.full(node_count, -1, dtype=np.int32)
    for node, carrier in carried.items():
        node_frame[node] = master[carrier]
    slaves = np.flatnonzero(master != np.arange(count))
    carried_nodes = np.flatnonzero(node_frame >= 0)
    carried_frame = np.concatenate([node_frame[carried_nodes], master[slaves]]).astype(np.int32)
    places = np.concatenate([nodes[carried_nodes].reshape(-1, 3), pose[slaves, :3]])
    carried_offset = [to_local(pose[f], x) for f, x in zip(carried_frame, places, strict=True)]
    segment_frames, segment_rod, segments = _segments(builder, base, rod_start)
    has_mass = np.concatenate([carried_nodes < node_start[-1], volume[slaves] > 0.0])
    is_bound = np.zeros(count, dtype=bool)  # masters that segments, soft nodes or joints hold
    is_bound[master[segment_frames]] = True
    is_bound[node_frame[carried_nodes[carried_nodes < node_start[-1]]]] = True
    is_bound[master[_jointed(builder)]] = True
    spin = _spin(free, master, is_bound, carried_frame[has_mass])
    return FrameLayout(
        node_count=node_count,
        body_node_count=int(node_start[-1]),
        rigid_count=base,
        rod_start=rod_start,
        pose=pose,
        twist=twist,
        master=master,
        offset=offset,
        owner=owner,
        volume=volume,
        inertia=inertia,
        free=free,
        spin=spin,
        turning=np.flatnonzero((master == np.arange(count)) & is_bound & free[:, 3:].all(axis=1)).astype(np.int32),
        carried_slot=np.concatenate([carried_nodes, node_count + 2 * slaves]).astype(np.int32),
        carried_frame=carried_frame,
        carried_offset=np.array(carried_offset).reshape(-1, 3),
        node_frame=node_frame,
        segment_frames=segment_frames,
        segment_rod=segment_rod,
        segments=segments,
        radius=radius,
        is_kinematic=np.array([r.kinematic for r in rigids], dtype=bool),
        blend_ends=blend_ends,
        blend_place=blend_place,
    )


def _blends(builder: ModelBuilder, base: int, rod_start: IntArray) -> tuple[IntArray, FloatArray]:
    """Frames within segments that contact cuts into pieces."""
    ends: list[tuple[int, int]] = []
    place: list[tuple[float, float]] = []
    for r, rod in enumerate(builder.rods):
        for k, length in enumerate(rod.geometry.length):
            first = int(base + rod_start[r] + k)
            inner = np.arange(1, rod.contact_pieces) / rod.contact_pieces
            ends += [(first, first + 1)] * len(inner)
            place += [(float(s), float(length)) for s in inner]
    return np.array(ends, dtype=np.int32).reshape(-1, 2), np.array(place, dtype=np.float64).reshape(-1, 2)


def blended(a: FloatArray, b: FloatArray, s: float, length: float) -> FloatArray:
    """Pose at the place s of a segment between two poses: Hermite's cubic with the sections' normals as tangents."""
    tangents = [length * rotation_matrix(pose[3:])[:, 2] for pose in (a, b)]
    x = (1.0 + 2.0 * s) * (1.0 - s) ** 2 * a[:3] + s * s * (3.0 - 2.0 * s) * b[:3]
    x = x + s * (1.0 - s) ** 2 * tangents[0] - s * s * (1.0 - s) * tangents[1]
    q = (1.0 - s) * a[3:] + s * np.copysign(1.0, a[3:] @ b[3:]) * b[3:]
    return np.concatenate([x, q / np.linalg.norm(q)])


def _welds(builder: ModelBuilder, node_start: IntArray, rod_start: IntArray, parent: dict[int, int]) -> dict[int, int]:
    """Fill ``parent`` (frame -> frame) and return node -> frame."""
    base = len(builder.rigids)
    carried: dict[int, int] = {}
    for weld in builder.welds:
        to = np.array([weld.to]) if not weld.to_rod else base + rod_start[weld.to] + weld.to_node
        if weld.kind == "nodes":
            body = builder.bodies[weld.part]
            for node, frame in zip(
                node_start[weld.part] + weld.nodes, np.broadcast_to(to, weld.nodes.shape), strict=True
            ):
                if int(node) in carried:
                    raise ValueError(
                        f"body {body.name!r}: node {int(node - node_start[weld.part])} is attached twice; "
                        "attach every node to one part"
                    )
                carried[int(node)] = int(frame)
            continue
        frames = [weld.part] if weld.kind == "rigid" else list(base + rod_start[weld.part] + weld.nodes)
        for frame in frames:
            if int(frame) in parent:
                raise ValueError(
                    f"{_frame_name(builder, int(frame))} is attached twice; attach every part to one other"
                )
            parent[int(frame)] = int(to[0])
    return carried


def _guides(builder: ModelBuilder) -> list[tuple[Handle, FloatArray]]:
    """Waypoints of cables on rods and rigid bodies, in order."""
    return [
        (part, place)
        for cable in builder.cables
        for part, tet, place in zip(cable.carriers, cable.tets, cable.waypoints, strict=True)
        if tet < 0
    ]


def guide_points(builder: ModelBuilder) -> FloatArray:
    """Positions of all guides [m], (guide, 3): nodes without mass, behind those of the soft bodies."""
    return np.array([place for _, place in _guides(builder)], dtype=np.float64).reshape(-1, 3)


def _nearest_frame(builder: ModelBuilder, base: int, rod_start: IntArray, part: Handle, place: FloatArray) -> int:
    if not isinstance(part, Rod):
        return int(part)
    distance = np.linalg.norm(builder.rods[part].geometry.positions - place, axis=1)
    return int(base + rod_start[part] + distance.argmin())


def _root(frame: int, parent: dict[int, int], builder: ModelBuilder) -> int:
    seen = [frame]
    while seen[-1] in parent:
        seen.append(parent[seen[-1]])
        if seen[-1] in seen[:-1]:
            raise ValueError(f"{_frame_name(builder, frame)} is attached to itself over other parts; cut the loop")
    return seen[-1]


def _frame_name(builder: ModelBuilder, frame: int) -> str:
    if frame < len(builder.rigids):
        return f"rigid body {builder.rigids[frame].name!r}"
    node = frame - len(builder.rigids)
    for rod in builder.rods:
        if node < len(rod.geometry.positions):
            return f"rod {rod.name!r}, node {node}"
        node -= len(rod.geometry.positions)
    raise AssertionError(f"frame {frame} belongs to no part")


def _segments(
    builder: ModelBuilder, base: int, rod_start: IntArray
) -> tuple[IntArray, IntArray, dict[str, NDArray[Any]]]:
    frames, rods = [np.empty((0, 2), dtype=np.int32)], [np.empty(0, dtype=np.int32)]
    parts: dict[str, list[FloatArray]] = {
        "seg_length": [np.empty(0)],
        "seg_section": [np.empty((0, 5))],
        "seg_scale": [np.empty(0)],
        "seg_rest": [np.empty((0, 6))],
    }
    for r, rod in enumerate(builder.rods):
        first = base + np.arange(rod_start[r], rod_start[r + 1] - 1)
        frames.append(np.stack([first, first + 1], axis=1).astype(np.int32))
        rods.append(np.full(len(first), r, dtype=np.int32))
        parts["seg_length"].append(rod.geometry.length)
        parts["seg_section"].append(rod.geometry.section)
        parts["seg_scale"].append(rod.scale)
        parts["seg_rest"].append(rod.geometry.rest)
    return np.concatenate(frames), np.concatenate(rods), {k: np.concatenate(v) for k, v in parts.items()}


def _jointed(builder: ModelBuilder) -> IntArray:
    """Rigid bodies with joints."""
    sides = [part for spec in builder.joints for part in (spec.parent, spec.child) if part is not None]
    return np.array([int(part) for part, node in sides if node < 0], dtype=np.int32)


def _spin(free: NDArray[np.bool_], master: IntArray, is_bound: NDArray[np.bool_], carried_frame: IntArray) -> IntArray:
    """How each frame moves on with its momentum at the end of a step."""
    is_master = master == np.arange(len(master))
    is_loaded = np.isin(np.arange(len(master)), carried_frame)
    is_free = free.all(axis=1)
    spin = np.full(len(master), Spin.AS_SOLVED, dtype=np.int32)
    spin[is_master & free.any(axis=1)] = Spin.KEEP_MOMENTUM
    spin[is_master & is_free & is_bound & ~is_loaded] = Spin.KEEP_SPIN
    spin[is_master & is_free & ~is_bound] = Spin.FREE_TOP
    return spin


# Poses


def to_local(pose: FloatArray, point: FloatArray) -> FloatArray:
    """A point [m] in the axes of a pose."""
    return np.asarray(rotation_matrix(pose[3:]).T @ (point - pose[:3]))


def relative(master: FloatArray, pose: FloatArray) -> FloatArray:
    """Pose in the axes of another one."""
    inverse = master[3:] * np.array([-1.0, -1.0, -1.0, 1.0])
    return np.concatenate([to_local(master, pose[:3]), quaternion_product(inverse, pose[3:])])
