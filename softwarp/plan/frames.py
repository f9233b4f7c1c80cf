"""From rigid bodies, rods and attachments to frames: masters, what they carry, inertia. Host only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softwarp.model.codes import Spin
from softwarp.model.handles import Handle, Rod
from softwarp.scene.checks import to_local
from softwarp.scene.parts import Scene
from softwarp.shapes.base import quaternion_product, rotation_matrix

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]
IDENTITY = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


@dataclass(frozen=True)
class SegmentArrays:
    """Segments of all rods, under the names that ``FrameModel`` declares."""

    seg_length: FloatArray
    seg_section: FloatArray
    seg_scale: FloatArray
    seg_rest: FloatArray


@dataclass(frozen=True)
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
    segments: SegmentArrays
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

    def carries_whole(self, corners: IntArray) -> NDArray[np.bool_]:
        """Whether one frame carries all nodes of elements (element, corner)."""
        frame = self.node_frame[corners]
        return np.asarray((frame[:, 0] >= 0) & (frame == frame[:, :1]).all(axis=1))

    def inertia_in_master(self) -> FloatArray:
        """Inertia of every frame in the axes of its master, (frame, 3, 3)."""
        turns = np.array([rotation_matrix(q) for q in self.offset[:, 3:]]).reshape(-1, 3, 3)
        return np.asarray(turns @ self.inertia @ turns.transpose(0, 2, 1))


@dataclass
class _Draft:
    """Frames while they are collected: rigid bodies, rod nodes, centres of mass, then blended frames."""

    base: int  # first rod node
    rod_start: IntArray
    off_centre: list[int]  # rigid bodies whose centre of mass has a frame of its own
    blend_ends: IntArray
    blend_place: FloatArray
    pose: FloatArray
    twist: FloatArray
    owner: IntArray
    volume: FloatArray
    inertia: FloatArray
    free: NDArray[np.bool_]
    parent: dict[int, int]  # frame that carries a frame

    @property
    def count(self) -> int:
        """Frames."""
        return len(self.pose)

    @property
    def first_centre(self) -> int:
        """First frame of a centre of mass."""
        return self.base + int(self.rod_start[-1])

    @property
    def first_blend(self) -> int:
        """First blended frame."""
        return self.first_centre + len(self.off_centre)


def layout(scene: Scene, node_start: IntArray, nodes: FloatArray) -> FrameLayout:
    """Number the frames of a scene and resolve its attachments.

    Raises:
        ValueError: If a part is attached twice, or to itself over other parts.
    """
    draft = _draft(scene)
    _place_rigids(draft, scene)
    _place_rods(draft, scene)
    _place_blends(draft)
    pose, count, base, rod_start = draft.pose, draft.count, draft.base, draft.rod_start
    carried = _welds(scene, node_start, rod_start, draft.parent)
    for number, (part, place) in enumerate(scene.guides()):
        carried[int(node_start[-1]) + number] = _nearest_frame(scene, base, rod_start, part, place)
    master = np.array([_root(f, draft.parent, scene) for f in range(count)], dtype=np.int32)
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
    segment_frames, segment_rod = _segment_frames(scene, base, rod_start)
    has_mass = np.concatenate([carried_nodes < node_start[-1], draft.volume[slaves] > 0.0])
    is_bound = np.zeros(count, dtype=bool)  # masters that segments, soft nodes or joints hold
    is_bound[master[segment_frames]] = True
    is_bound[node_frame[carried_nodes[carried_nodes < node_start[-1]]]] = True
    is_bound[master[_jointed(scene)]] = True
    spin = _spin(draft.free, master, is_bound, carried_frame[has_mass])
    for r, _ in scene.telescopes:  # nodes do not spin about their line, whatever momentum they have
        spin[base + rod_start[r] : base + rod_start[r + 1]] = Spin.AS_SOLVED
    turns = (master == np.arange(count)) & is_bound & draft.free[:, 3:].all(axis=1)
    return FrameLayout(
        node_count=node_count,
        body_node_count=int(node_start[-1]),
        rigid_count=base,
        rod_start=rod_start,
        pose=pose,
        twist=draft.twist,
        master=master,
        offset=offset,
        owner=draft.owner,
        volume=draft.volume,
        inertia=draft.inertia,
        free=draft.free,
        spin=spin,
        turning=np.flatnonzero(turns).astype(np.int32),
        carried_slot=np.concatenate([carried_nodes, node_count + 2 * slaves]).astype(np.int32),
        carried_frame=carried_frame,
        carried_offset=np.array(carried_offset).reshape(-1, 3),
        node_frame=node_frame,
        segment_frames=segment_frames,
        segment_rod=segment_rod,
        segments=_segments(scene),
        radius=_radius(scene, rod_start),
        is_kinematic=np.array([r.kinematic for r in scene.rigids], dtype=bool),
        blend_ends=draft.blend_ends,
        blend_place=draft.blend_place,
    )


def _draft(scene: Scene) -> _Draft:
    """Room for the frames of a scene."""
    rigids, base = scene.rigids, len(scene.rigids)
    rod_start = np.concatenate([[0], np.cumsum([len(r.geometry.positions) for r in scene.rods])]).astype(np.int32)
    off_centre = [i for i, r in enumerate(rigids) if r.mass > 0.0 and np.abs(r.centre).max() > 1e-9]
    blend_ends, blend_place = _blends(scene, base, rod_start)
    count = base + int(rod_start[-1]) + len(off_centre) + len(blend_ends)
    return _Draft(
        base=base,
        rod_start=rod_start,
        off_centre=off_centre,
        blend_ends=blend_ends,
        blend_place=blend_place,
        pose=np.tile(IDENTITY, (count, 1)),
        twist=np.zeros((count, 6)),
        owner=np.zeros(count, dtype=np.int32),
        volume=np.zeros(count),
        inertia=np.zeros((count, 3, 3)),
        free=np.ones((count, 6), dtype=bool),
        parent={},
    )


def _place_rigids(draft: _Draft, scene: Scene) -> None:
    """Rigid bodies, with their mass in a frame of its own where it lies off the body's origin."""
    for i, rigid in enumerate(scene.rigids):
        draft.pose[i], draft.twist[i], draft.owner[i], draft.free[i] = rigid.pose, rigid.twist, i, rigid.free
        heavy = i
        if i in draft.off_centre:
            heavy = draft.first_centre + draft.off_centre.index(i)
            draft.pose[heavy] = rigid.pose
            draft.pose[heavy, :3] += rotation_matrix(rigid.pose[3:]) @ rigid.centre
            draft.parent[heavy], draft.owner[heavy] = i, i
        if rigid.mass > 0.0:
            draft.volume[heavy], draft.inertia[heavy] = 1.0, rigid.inertia / rigid.mass


def _place_rods(draft: _Draft, scene: Scene) -> None:
    """Nodes of rods."""
    for r, rod in enumerate(scene.rods):
        frames = draft.base + np.arange(draft.rod_start[r], draft.rod_start[r + 1])
        g = rod.geometry
        draft.pose[frames, :3], draft.pose[frames, 3:] = g.positions, g.quaternions
        draft.owner[frames], draft.volume[frames] = draft.base + r, g.node_volume
        draft.inertia[frames] = np.einsum("ni,ij->nij", g.node_inertia, np.eye(3))
        draft.free[frames] = ~rod.clamped[:, None]
    owner = draft.base + len(scene.rods)
    for r, _ in scene.telescopes:  # every node is an owner of its own, whose density is its mass
        frames = draft.base + np.arange(draft.rod_start[r], draft.rod_start[r + 1])
        draft.owner[frames] = owner + np.arange(len(frames))
        owner += len(frames)


def _place_blends(draft: _Draft) -> None:
    """Frames within segments that contact cuts into pieces."""
    places = zip(draft.blend_ends.tolist(), draft.blend_place.tolist(), strict=True)
    for frame, (ends, (s, length)) in enumerate(places, draft.first_blend):
        draft.pose[frame] = blended(draft.pose[ends[0]], draft.pose[ends[1]], s, length)
        draft.parent[frame], draft.owner[frame] = ends[0], draft.owner[ends[0]]


def _radius(scene: Scene, rod_start: IntArray) -> FloatArray:
    """Larger radius of the segments at every rod node [m]."""
    radius = np.zeros(int(rod_start[-1]))
    for r, rod in enumerate(scene.rods):
        g = rod.geometry
        ends = np.asarray(np.broadcast_to(g.radius, len(g.length)), dtype=np.float64)
        radius[rod_start[r] : rod_start[r + 1]] = np.maximum(np.append(ends, ends[-1]), np.append(ends[0], ends))
    return radius


def _blends(scene: Scene, base: int, rod_start: IntArray) -> tuple[IntArray, FloatArray]:
    """Frames within segments that contact cuts into pieces."""
    ends: list[tuple[int, int]] = []
    place: list[tuple[float, float]] = []
    for r, rod in enumerate(scene.rods):
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


def _welds(scene: Scene, node_start: IntArray, rod_start: IntArray, parent: dict[int, int]) -> dict[int, int]:
    """Fill ``parent`` (frame -> frame) and return node -> frame."""
    base = len(scene.rigids)
    carried: dict[int, int] = {}
    for weld in scene.welds:
        to = np.array([weld.to]) if not weld.to_rod else base + rod_start[weld.to] + weld.to_node
        if weld.kind == "nodes":
            body = scene.bodies[weld.part]
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
                raise ValueError(f"{_frame_name(scene, int(frame))} is attached twice; attach every part to one other")
            parent[int(frame)] = int(to[0])
    return carried


def guide_points(scene: Scene) -> FloatArray:
    """Positions of all guides [m], (guide, 3): nodes without mass, behind those of the soft bodies."""
    return np.array([place for _, place in scene.guides()], dtype=np.float64).reshape(-1, 3)


def _nearest_frame(scene: Scene, base: int, rod_start: IntArray, part: Handle, place: FloatArray) -> int:
    if not isinstance(part, Rod):
        return int(part)
    distance = np.linalg.norm(scene.rods[part].geometry.positions - place, axis=1)
    return int(base + rod_start[part] + distance.argmin())


def _root(frame: int, parent: dict[int, int], scene: Scene) -> int:
    seen = [frame]
    while seen[-1] in parent:
        seen.append(parent[seen[-1]])
        if seen[-1] in seen[:-1]:
            raise ValueError(f"{_frame_name(scene, frame)} is attached to itself over other parts; cut the loop")
    return seen[-1]


def _frame_name(scene: Scene, frame: int) -> str:
    if frame < len(scene.rigids):
        return f"rigid body {scene.rigids[frame].name!r}"
    node = frame - len(scene.rigids)
    for rod in scene.rods:
        if node < len(rod.geometry.positions):
            return f"rod {rod.name!r}, node {node}"
        node -= len(rod.geometry.positions)
    raise AssertionError(f"frame {frame} belongs to no part")


def _segment_frames(scene: Scene, base: int, rod_start: IntArray) -> tuple[IntArray, IntArray]:
    """Frames at the ends of every segment, and its rod."""
    frames, rods = [np.empty((0, 2), dtype=np.int32)], [np.empty(0, dtype=np.int32)]
    for r in range(len(scene.rods)):
        first = base + np.arange(rod_start[r], rod_start[r + 1] - 1)
        frames.append(np.stack([first, first + 1], axis=1).astype(np.int32))
        rods.append(np.full(len(first), r, dtype=np.int32))
    return np.concatenate(frames), np.concatenate(rods)


def _segments(scene: Scene) -> SegmentArrays:
    """Lengths, sections and rest strains of all segments."""
    geometry = [rod.geometry for rod in scene.rods]
    return SegmentArrays(
        seg_length=np.concatenate([np.empty(0), *(g.length for g in geometry)]),
        seg_section=np.concatenate([np.empty((0, 5)), *(g.section for g in geometry)]),
        seg_scale=np.concatenate([np.empty(0), *(rod.scale for rod in scene.rods)]),
        seg_rest=np.concatenate([np.empty((0, 6)), *(g.rest for g in geometry)]),
    )


def _jointed(scene: Scene) -> IntArray:
    """Rigid bodies with joints."""
    sides = [part for spec in scene.joints for part in (spec.parent, spec.child) if part is not None]
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


def relative(master: FloatArray, pose: FloatArray) -> FloatArray:
    """Pose in the axes of another one."""
    inverse = master[3:] * np.array([-1.0, -1.0, -1.0, 1.0])
    return np.concatenate([to_local(master, pose[:3]), quaternion_product(inverse, pose[3:])])
