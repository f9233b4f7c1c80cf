"""Collision detection of a batch: which features touch which targets, as a ``ContactList``.

A detector works on all worlds of a shard at once and allocates nothing in a step::

    scene = CollisionScene()
    ball = scene.add_shape(frame, shapes.Sphere(0.05), name="ball")
    floor = scene.add_shape(WORLD, shapes.Plane(), name="floor")
    scene.pair(ball, floor)
    detector = Detector(variant, world_count, scene, Topology(...), capacity=32, device=device)
    detector.load(state.contact_count, state.contact_key, state.contact_force)  # warm start from the state
    detector.find(x, pose, v, twist, h, pairs)        # fills detector.contacts
    ...                                               # the response writes detector.contacts.multiplier
    detector.remember()                               # before another find in the same step, and before store
    detector.store(flag, state.contact_count, state.contact_key, state.contact_force)

The state must hold three arrays per world, which are the whole memory of contact: ``contact_count`` (integer, 1 row),
``contact_key`` (integer, ``capacity`` rows) and ``contact_force`` (3 ``capacity`` rows, [N], world axes, on side a).
Keys number the features of the scene against their targets, so they are the same in every step. All zero is a state
without memory.

Theory: docs/theory/collision.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from softwarp.kernels import collision, contact_scene, proximity
from softwarp.kernels.contact_scene import MESH, SOFT, TOUCH_ROWS
from softwarp.kernels.lanes import Variant
from softwarp.solvers import contact_list, rows
from softwarp.solvers.collision_scene import CollisionScene
from softwarp.solvers.rows import Rows

CHUNK_CPU, CHUNK_GPU = 64, 4  # keys that one thread searches


@dataclass(frozen=True)
class Topology:
    """How nodes and frames hang together, as host arrays.

    Attributes:
        node_dof: Dof of a node, -1 if it is fixed or a frame carries it, shape (node,).
        node_frame: Frame that carries it, else -1, shape (node,).
        frame_dof: Dofs of translation and rotation of a frame's master, -1 for none, shape (2 frame,).
        frame_master: Frame that a frame moves with, itself unless it is welded, shape (frame,).
    """

    node_dof: ArrayLike
    node_frame: ArrayLike
    frame_dof: ArrayLike
    frame_master: ArrayLike


@dataclass(frozen=True)
class PairParameters:
    """Contact laws, one row per pair.

    Attributes:
        mu: Friction coefficient.
        restitution: Coefficient of restitution.
        distance: Distance at which surfaces rest [m].
        alarm: Distance from which a pair is a contact [m]. Choose it larger than ``distance``: what is farther away
            is not seen before it moves, so a body can fall by (acceleration h^2) into an unseen neighbour.
        compliance: Compliance of the normal law [m/N].
    """

    mu: Rows
    restitution: Rows
    distance: Rows
    alarm: Rows
    compliance: Rows


class Detector:
    """Finds the contacts of the worlds of one shard.

    Args:
        variant: Scalar type and memory order.
        world_count: Worlds.
        scene: Objects and pairs; not read after this.
        topology: How nodes and frames hang together.
        capacity: Contacts that a world can hold.
        device: Warp device.
        slack: Added to every alarm distance [m], e.g. 2 h^2 times the largest free acceleration.

    Attributes:
        contacts: The list that ``find`` fills.
        key_count: Contacts that could exist at the same time.
    """

    def __init__(
        self,
        variant: Variant,
        world_count: int,
        scene: CollisionScene,
        topology: Topology,
        capacity: int,
        device: Any,
        slack: float = 0.0,
    ) -> None:
        if capacity < 1:
            raise ValueError(f"contact capacity must be at least 1 per world, got {capacity}")
        self.variant, self.device, self.capacity, self.slack = variant, device, capacity, slack
        self.packs, self.lanes = rows.shape(variant, world_count)
        self.world_count = world_count
        self.k = collision.kernels(variant)
        self.k_shape = proximity.kernels(variant)
        self.types = contact_scene.structures(variant.real)
        self.key_count = scene.key_count
        self.contacts = contact_list.allocate(variant, world_count, capacity, device)
        self.scene = self._scene(scene)
        self._topology(topology)
        self._objects(scene)
        self._chunks(scene)
        self._allocate(scene)

    # Construction

    def _device_array(self, values: Any, dtype: Any) -> wp.array:
        plain = np.int32 if dtype is wp.int32 else (np.float64 if self.variant.real is wp.float64 else np.float32)
        return wp.array(np.ascontiguousarray(values, dtype=plain), dtype=dtype, device=self.device)

    def _scene(self, scene: CollisionScene) -> Any:
        """The scene's tables as the struct that kernels read."""
        t, real = self.types, self.variant.real
        packed = t.Scene()
        columns: list[tuple[str, Any, str, Any, tuple[int, ...]]] = []
        for name in ("kind", "index", "quarter"):
            columns.append((f"point_{name}", scene.points, name, wp.int32, ()))
        for name in ("local", "inset", "axis", "rest"):
            columns.append((f"point_{name}", scene.points, name, t.vec3, (3,)))
        columns.append(("point_radius", scene.points, "radius", real, ()))
        columns += [
            ("edge_point", scene.edges, "point", wp.int32, (2,)),
            ("edge_face", scene.edges, "face", wp.int32, (2,)),
        ]
        columns += [
            ("edge_radius", scene.edges, "radius", real, ()),
            ("edge_inset", scene.edges, "inset", t.vec3, (3,)),
        ]
        for name in ("corner", "beside", "edge"):
            columns.append((f"face_{name}", scene.faces, name, wp.int32, (3,)))
        columns.append(("face_radius", scene.faces, "radius", real, ()))
        columns += [
            ("target_kind", scene.targets, "kind", wp.int32, ()),
            ("target_frame", scene.targets, "frame", wp.int32, ()),
        ]
        columns += [("target_x", scene.targets, "x", t.vec3, (3,)), ("target_q", scene.targets, "q", t.vec4, (4,))]
        columns += [
            ("target_size", scene.targets, "size", t.vec3, (3,)),
            ("target_depth", scene.targets, "depth", real, ()),
        ]
        for field, table, name, dtype, shape in columns:
            plain = np.int32 if dtype is wp.int32 else np.float64
            setattr(packed, field, self._device_array(table.array(name, plain, shape), dtype))
        start, fan = scene.fans()
        packed.fan_start, packed.fan = self._device_array(start, wp.int32), self._device_array(fan, wp.int32)
        packed.couple = self._device_array(scene.couple_table(), wp.int32)
        targets = max(len(scene.targets), 1)
        packed.target_tree = self._device_array(np.zeros((targets, 2)), wp.int32)
        packed.target_grid = self._device_array(np.zeros((targets, 4)), wp.int32)
        packed.grid_origin = self._device_array(np.zeros((targets, 3)), t.vec3)
        packed.grid_spacing = self._device_array(np.ones(targets), real)
        packed.grid_value = self._device_array(np.zeros(1), real)
        return packed

    def _topology(self, topology: Topology) -> None:
        def padded(values: ArrayLike, count: int) -> wp.array:
            host = np.asarray(values, dtype=np.int32).reshape(-1)
            return self._device_array(host if host.size else np.full(count, -1), wp.int32)

        self.node_dof, self.node_frame = padded(topology.node_dof, 1), padded(topology.node_frame, 1)
        self.frame_dof, self.frame_master = padded(topology.frame_dof, 2), padded(topology.frame_master, 1)

    def _objects(self, scene: CollisionScene) -> None:
        e = scene.entities
        self.object_count = len(e)
        self.object_frame = self._device_array([o.frame for o in e] or [-1], wp.int32)
        self.object_point = self._device_array([o.points for o in e] or [(0, 0)], wp.int32)
        self.object_centre = self._device_array([o.centre for o in e] or [np.zeros(3)], self.types.vec3)
        self.object_extent = self._device_array([o.extent for o in e] or [np.zeros(3)], self.types.vec3)

    def _chunks(self, scene: CollisionScene) -> None:
        """Cut the keys of every couple into pieces that one thread searches."""
        size = CHUNK_GPU if self.variant.world_fastest else CHUNK_CPU
        key: list[int] = []
        couple: list[int] = []
        analytic: list[int] = []
        key_end = 0
        for number, (entry, count) in enumerate(scene.key_ranges()):
            kind = scene.entities[entry.b].kind
            for begin in range(0, count, size):
                if kind < SOFT and kind != MESH:
                    analytic.append(len(key))
                key.append(key_end + begin)
                couple.append(number)
            key_end += count
        self.chunk_key = self._device_array([*key, key_end], wp.int32)
        self.chunk_count = len(couple)
        self.chunk_couple = wp.array(np.array(couple, dtype=np.int32), dtype=wp.int32, device=self.device)
        self.shape_chunks = wp.array(np.array(analytic, dtype=np.int32), dtype=wp.int32, device=self.device)

    def _allocate(self, scene: CollisionScene) -> None:
        def real(count: int) -> Rows:
            return rows.allocate(self.variant, self.world_count, max(count, 1), self.device)

        def integer(count: int) -> Rows:
            return rows.allocate(self.variant, self.world_count, max(count, 1), self.device, wp.int32)

        self.couple_count = len(scene.couples)
        self.box, self.reach = real(7 * self.object_count), real(self.couple_count)
        self.chunk_hits, self.hit = integer(self.chunk_count), integer(self.key_count)
        self.known_count, self.known_key = integer(1), integer(self.capacity)
        self.known_force = real(3 * self.capacity)
        self.couple, self.face, self.known = (integer(self.capacity) for _ in range(3))
        self.touch = real(TOUCH_ROWS * self.capacity)

    # A step

    def _launch(self, kernel: Any, items: int | None, inputs: list[Any], outputs: list[Any]) -> None:
        dim = (self.packs, self.lanes) if items is None else (self.packs, items, self.lanes)
        if items != 0:
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def find(self, x: Rows, pose: Rows, v: Rows, twist: Rows, h: float, pairs: PairParameters) -> None:
        """Fill ``contacts`` from positions and velocities, starting forces from what was loaded or remembered.

        Args:
            x: Node positions [m], 3 rows per node.
            pose: Poses of frames, 7 rows per frame.
            v: Node velocities [m/s].
            twist: Linear and angular velocities of frames [m/s, rad/s], 6 rows per frame.
            h: Time step [s]; contacts that can close within 1.5 steps are found too. 0 for a static solve.
            pairs: Contact laws of this shard's worlds.
        """
        motion = self.types.Motion()
        motion.x, motion.pose, motion.v, motion.twist = x.real, pose.real, v.real, twist.real
        self._search(motion, h, pairs)
        c = self.contacts
        inputs = [self.chunk_key, self.chunk_couple, self.scene.couple, self.capacity]
        inputs += [self.chunk_hits.real, self.hit.real, self.known_count.real, self.known_key.real]
        outputs = [c.count.real, c.overflow.real, c.key.real, c.pair.real]
        outputs += [self.couple.real, self.face.real, self.known.real]
        self._launch(self.k.collect, None, inputs, outputs)
        inputs = [self.scene, motion, self.reach.real, c.count.real, c.key.real, self.couple.real]
        self._launch(self.k_shape.measure, self.capacity, inputs, [self.touch.real])
        inputs = [c.count.real, c.pair.real, self.known.real, self.known_force.real, self.touch.real]
        inputs += [p.real for p in (pairs.distance, pairs.mu, pairs.restitution, pairs.compliance)]
        outputs = [r.real for r in (c.axes, c.gap, c.mu, c.restitution, c.compliance, c.multiplier)]
        self._launch(self.k.describe, self.capacity, inputs, outputs)
        inputs = [self.scene, self.node_dof, self.node_frame, self.frame_dof, self.frame_master, motion]
        inputs += [c.count.real, c.key.real, self.couple.real, self.face.real, self.touch.real]
        outputs = [c.point.real, c.dof.real, c.weight.real, c.lever.real]
        self._launch(self.k.slots, self.capacity, inputs, outputs)

    def _search(self, motion: Any, h: float, pairs: PairParameters) -> None:
        """Broad phase, then the chunks of near couples."""
        inputs = [self.scene, self.object_frame, self.object_point, self.object_centre, self.object_extent, motion]
        self._launch(self.k.bounds, self.object_count, inputs, [self.box.real])
        laws = [pairs.distance.real, pairs.alarm.real, self.slack, h]
        self._launch(self.k.couples, self.couple_count, [self.scene, motion, self.box.real, *laws], [self.reach.real])
        shared = [self.chunk_key, self.chunk_couple, motion, self.reach.real, *laws]
        outputs = [self.chunk_hits.real, self.hit.real]
        self._launch(self.k_shape.find, self.shape_chunks.size, [self.scene, self.shape_chunks, *shared], outputs)

    # Memory

    def remember(self) -> None:
        """Take the forces of ``contacts`` as the first guess of the next ``find``."""
        c = self.contacts
        inputs = [c.count.real, c.key.real, c.axes.real, c.multiplier.real]
        outputs = [self.known_count.real, self.known_key.real, self.known_force.real]
        self._launch(self.k.remember, self.capacity, inputs, outputs)

    def load(self, count: wp.array, key: wp.array, force: wp.array) -> None:
        """Take the first guess from the state, arrays (world, row)."""
        inputs = [count, key, force, self.world_count, self.lanes]
        outputs = [self.known_count.real, self.known_key.real, self.known_force.real]
        self._launch(self.k.load, self.capacity, inputs, outputs)

    def store(self, flag: Rows, count: wp.array, key: wp.array, force: wp.array) -> None:
        """Write what was remembered to the state of those worlds whose flags 0 and 1 are zero."""
        inputs = [self.lanes, flag.real, self.known_count.real, self.known_key.real, self.known_force.real]
        self._launch(self.k.store, self.capacity, inputs, [count, key, force])
