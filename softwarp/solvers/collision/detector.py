"""Collision detection of a batch: which features touch which targets, as a ``ContactList``.

A detector works on all worlds of a shard at once and allocates nothing in a step::

    scene = CollisionBuilder()
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

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.collision import (
    box_features,
    broad,
    bvh,
    geometry,
    keeping,
    listing,
    shapes_phase,
    sift,
    sift_shapes,
    strike,
    surface_phase,
)
from softwarp.kernels.collision.geometry import TOUCH_ROWS
from softwarp.kernels.rows import looks
from softwarp.model import memory
from softwarp.model.codes import FAR, SUM_OF_POINTS, WORLD, Carrier, CoupleColumn, Target
from softwarp.model.contact import CollisionScene, Topology
from softwarp.solvers.collision import contact_list
from softwarp.solvers.collision.arrays import pack
from softwarp.solvers.workspace import rows
from softwarp.solvers.workspace.rows import Rows

NO_POINT = 1 << 30  # first number of an embedded point where there is none
SEATS = 4  # touches that a CPU keeps from search to measurement, times the capacity; benchmarks/contact.py
SPREAD_PARTS = 32  # threads of a GPU that share the points of an object; benchmarks/contact.py


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
        patient: Whether contacts of soft bodies within the slack wait in reserve until ``find_late`` sees them overlap.
        steady: Whether ``find`` may be asked to keep what pressed in earlier iterates of a step.

    Attributes:
        contacts: The list that ``find`` fills.
        key_count: Contacts that could exist at the same time.
        point_nodes: Nodes that are points of the scene themselves, besides those that carry embedded points.
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
        *,
        patient: bool = False,
        steady: bool = False,
    ) -> None:
        if capacity < 1:
            raise ValueError(f"contact capacity must be at least 1 per world, got {capacity}")
        self.variant, self.device, self.capacity, self.slack = variant, device, capacity, slack
        self.packs, self.lanes = rows.shape(variant, world_count)
        self.world_count = world_count
        self.k, self.k_list = broad.kernels(variant), listing.kernels(variant)
        self.k_shape = shapes_phase.kernels(variant)
        self.k_surface = surface_phase.kernels(variant)
        self.k_looks = looks.kernels(variant)
        self.k_tree = bvh.kernels(variant)
        self.k_sift = None if variant.world_fastest or variant.real is wp.float64 else sift.kernels(variant.lanes)
        self.k_near = None if self.k_sift is None else sift_shapes.kernels(variant.lanes)
        self.k_box = box_features.kernels() if self.k_near is not None and variant.lanes > 1 else None
        self.k_strike = strike.kernels(variant)
        self.k_keep: Any = keeping.kernels(variant) if steady else None
        self.types = geometry.structures(variant.real)
        self.key_count = scene.key_count
        self.contacts = contact_list.allocate(variant, world_count, capacity, device)
        self.arrays = pack(scene, variant, device, patient=patient)
        self.is_patient = patient
        self.scene = self.arrays.scene
        self._topology(topology, scene)
        self._allocate(scene)
        free = np.asarray(topology.frame_free, dtype=bool).reshape(-1)
        is_free = [o.frame > WORLD and (not free.size or free[o.frame]) for o in scene.entities]
        self.object_free = wp.array(np.array(is_free or [True], dtype=np.int32), dtype=wp.int32, device=device)

    def _topology(self, topology: Topology, scene: CollisionScene) -> None:
        def padded(values: ArrayLike, count: int) -> wp.array:
            host = np.asarray(values, dtype=np.int32).reshape(-1)
            return wp.array(host if host.size else np.full(count, -1, np.int32), dtype=wp.int32, device=self.device)

        self.node_dof, self.node_frame = padded(topology.node_dof, 1), padded(topology.node_frame, 1)
        self.frame_dof, self.frame_master = padded(topology.frame_dof, 2), padded(topology.frame_master, 1)
        blend = np.asarray(topology.frame_blend, dtype=np.int32).reshape(-1)
        self.frame_blend = padded(blend if blend.size else np.full(self.frame_master.size, -1), 1)
        ends = np.asarray(topology.blend_ends, dtype=np.int32).reshape(-1, 2)
        ends = ends if len(ends) else np.full((1, 2), -1, dtype=np.int32)
        self.blend_ends = wp.array(ends, dtype=wp.vec2i, device=self.device)
        place = np.asarray(topology.blend_place, dtype=wp.dtype_to_numpy(self.variant.real)).reshape(-1, 2)
        place = place if len(place) else np.zeros((1, 2), dtype=place.dtype)
        self.blend_place = wp.array(place, dtype=self.variant.real, device=self.device)

        self._embedded(topology, scene)

    def _embedded(self, topology: Topology, scene: CollisionScene) -> None:
        """Points carried by nodes: they follow the nodes in positions and velocities of the detector's own.

        Those hold the nodes that carry points, and that are points of the scene themselves; no others are looked at.
        """
        carrier = np.asarray(topology.carrier, dtype=np.int32).reshape(-1, 4)
        self.embedded_count = len(carrier)
        self.node_total = len(np.asarray(topology.node_dof).reshape(-1)) if self.embedded_count else NO_POINT
        weight = np.asarray(topology.carrier_weight, dtype=np.float64).reshape(-1, 4)
        some = max(self.embedded_count, 1)
        carrier, weight = np.resize(carrier, (some, 4)), np.resize(weight, (some, 4))
        self.carrier = wp.array(carrier, dtype=wp.int32, device=self.device)
        self.carrier_weight = wp.array(weight, dtype=self.variant.real, device=self.device)
        of_nodes = scene.points.array("kind", np.int32) == Carrier.NODE
        index = scene.points.array("index", np.int32)[of_nodes]
        self.point_nodes = np.unique(index[index < self.node_total])
        seen = np.unique(np.concatenate([carrier.ravel(), index]))
        nodes = seen[(seen >= 0) & (seen < self.node_total)]
        points = self.node_total + np.arange(self.embedded_count)
        self.followed = wp.array(np.concatenate([nodes, points]), dtype=wp.int32, device=self.device)
        if self.embedded_count:
            rows_ = 3 * (self.node_total + self.embedded_count)
            self.all_x, self.all_v = (
                rows.allocate(self.variant, self.world_count, rows_, self.device) for _ in range(2)
            )

    def _with_embedded(self, nodes: Rows, everything: Rows) -> Rows:
        """Positions or velocities of nodes that are looked at, and of embedded points, which come after all nodes."""
        inputs = [self.node_total, self.followed, self.carrier, self.carrier_weight, nodes.S]
        self._launch_elements(self.k_tree.embed, self.variant.parts(self.followed.size), inputs, [everything.S])
        return everything

    def _allocate(self, scene: CollisionScene) -> None:
        def real(count: int) -> Rows:
            return rows.allocate(self.variant, self.world_count, max(count, 1), self.device)

        def integer(count: int) -> Rows:
            return rows.allocate(self.variant, self.world_count, max(count, 1), self.device, wp.int32)

        sifted = np.zeros(max(self.arrays.chunk_couple.size, 1), dtype=np.int32)
        if self.k_near is not None:
            sifted[self.arrays.node_chunks.numpy()] = 1
        self.sifted = wp.array(sifted, dtype=wp.int32, device=self.device)
        self.object_count, self.couple_count = len(scene.entities), len(scene.couples)
        kinds = self.scene.target_kind.numpy()[scene.couple_table()[:, CoupleColumn.TARGET]]
        self.has_boxes = bool((kinds == Target.BOX).any())
        self.has_points = any(entity.frame == SUM_OF_POINTS for entity in scene.entities)
        self.tree_box = real(6 * self.arrays.moving_nodes)
        self.spread = real(12 * self.variant.parts(SPREAD_PARTS) * self.object_count)
        self.choice = real(scene.choice_count)
        self.box, self.reach = real(7 * self.object_count), real(self.couple_count)
        self.velocity, self.struck = real(6 * self.object_count), real(6 * self.object_count)
        tracked = self.arrays.tracked.size > 0
        self.moved = real(self.object_count)
        with memory.lasting():  # they spare searches, and of other worlds they would spare none
            self.room = real(self.key_count if tracked else 0)
            self.before = real(3 * (len(self.arrays.scene.point_index) if tracked else 0))
        self.sought = integer(self.key_count if tracked and self.k_sift is not None else 0)
        self.near, self.hull = real(self.couple_count), real(strike.HULL_ROWS * self.couple_count)
        self.chunk_hits, self.hit = integer(self.arrays.chunk_couple.size), integer(self.key_count)
        self.known_count, self.known_key = integer(1), integer(self.capacity)
        self.known_force = real(3 * self.capacity)
        self.couple, self.face, self.known = (integer(self.capacity) for _ in range(3))
        kept = self.capacity if self.k_keep is not None else 0
        self.held, self.known_held, self.known_couple, self.known_face = (integer(kept) for _ in range(4))
        self.stuck = integer(1)
        self.touch = real(TOUCH_ROWS * self.capacity)
        self.seats = 0 if self.variant.world_fastest else SEATS * self.capacity
        self.found_key, self.found_touch = integer(self.seats), real(TOUCH_ROWS * self.seats)
        waiting = self.capacity if self.is_patient else 0
        self.reserve_count, self.none, self.called = integer(1), integer(1), integer(1)
        self.reserve_key, self.reserve_couple, self.reserve_face = (integer(waiting) for _ in range(3))
        self.reserve_touch = real(TOUCH_ROWS * waiting)

    # A step

    def _launch(self, kernel: Any, items: int | None, inputs: list[Any], outputs: list[Any]) -> None:
        dim = (self.packs, self.lanes) if items is None else (self.packs, items, self.lanes)
        if items != 0:
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def _launch_elements(self, kernel: Any, items: int, inputs: list[Any], outputs: list[Any]) -> None:
        width = self.lanes if self.variant.world_fastest else self.packs
        if items:
            dim = self.variant.dim(width, items)
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def find(
        self, x: Rows, pose: Rows, v: Rows, twist: Rows, h: float, pairs: PairParameters, *, keeps: bool = False
    ) -> None:
        """Fill ``contacts`` from positions and velocities, starting forces from what was loaded or remembered.

        Args:
            x: Node positions [m], 3 rows per node.
            pose: Poses of frames, 7 rows per frame.
            v: Node velocities [m/s].
            twist: Linear and angular velocities of frames [m/s, rad/s], 6 rows per frame.
            h: Time step [s]; contacts that can close within 1.5 steps are found too. 0 for a static solve.
            pairs: Contact laws of this shard's worlds.
            keeps: Whether what pressed in earlier iterates of the step stays, where it is remembered and ``steady``.
        """
        a, motion = self.arrays, self._motion(x, pose, v, twist)
        laws = [pairs.distance.real, pairs.alarm.real, self.slack, h]
        self._near(motion, laws, self.near)
        self._strikes(motion, laws, pairs.restitution)
        self._search(motion, laws, self.reach, FAR)
        c = self.contacts
        inputs = [a.chunk_key, a.chunk_couple, self.scene.couple, self.capacity]
        inputs += [self.chunk_hits.real, self.hit.real, self.known_count.real, self.known_key.real]
        outputs = [c.listed.real, c.count.real, c.overflow.real, c.key.real, c.pair.real]
        outputs += [self.couple.real, self.face.real, self.known.real, self.reserve_count.real]
        outputs += [self.reserve_key.real, self.reserve_couple.real, self.reserve_face.real]
        self._launch(self.k_list.collect, None, inputs, outputs)
        c.first.zero()
        if self.k_keep is not None:
            if keeps:
                self._keep(motion)
            else:
                self.held.zero()
        self._describe(motion, pairs)

    def _keep(self, motion: Any) -> None:
        """List what pressed in earlier iterates of the step, too."""
        c, k, stuck = self.contacts, self.k_keep, self.stuck.real
        known = [self.known_count.real, self.known_key.real, self.known_couple.real]
        outputs = [c.listed.real, c.count.real, c.overflow.real, c.key.real, c.pair.real]
        outputs += [self.couple.real, self.face.real, self.known.real, self.held.real]
        inputs = [self.scene, self.capacity, stuck, motion, *known, self.known_face.real, self.known_held.real]
        self._launch(k.keep_on_faces, None, inputs, outputs)
        if self.has_boxes:
            self._measure(motion)
            inputs = [self.scene, stuck, motion, c.count.real, c.key.real, self.couple.real, self.touch.real]
            self._launch(k.mark_boxes, self.capacity, inputs, [self.face.real])
            inputs = [self.scene, self.capacity, stuck, motion, *known, self.known_face.real, self.known_held.real]
            self._launch(k.keep_on_boxes, None, inputs, outputs)

    def find_late(
        self, x: Rows, pose: Rows, v: Rows, twist: Rows, depth: float, pairs: PairParameters, *, again: bool
    ) -> None:
        """Append what penetrates where a step leads to, but is not listed or has turned; measure all contacts there.

        Args:
            x: Node positions at the end of the step [m].
            pose: Poses of frames there.
            v: Node velocities, those of ``find``.
            twist: Velocities of frames, likewise.
            depth: Least penetration that counts [m].
            pairs: Contact laws.
            again: Listed contacts that still penetrate have been measured at an end of this step before.
        """
        a, c, motion = self.arrays, self.contacts, self._motion(x, pose, v, twist, again=True)
        laws = [pairs.distance.real, pairs.alarm.real, 0.0, 0.0]
        self._near(motion, laws, self.near)
        self._launch(self.k_looks.quiet, self.couple_count, [c.idle.real], [self.near.real, self.reach.real])
        self._search(motion, laws, self.near, -depth)
        c.first.zero()
        self._measure(motion)
        inputs = [a.chunk_key, a.chunk_couple, self.scene.couple, self.capacity, self.chunk_hits.real, self.hit.real]
        inputs += [c.listed.real, c.axes.real, c.gap.real, self.touch.real, pairs.distance.real]
        inputs += [self.called.real, depth, again]
        outputs = [c.first.real, c.count.real, c.overflow.real, c.key.real, c.pair.real]
        outputs += [self.couple.real, self.face.real, self.known.real]
        self._launch(self.k_list.collect_late, None, inputs, outputs)
        self._describe(motion, pairs)

    def call_up(
        self, end: tuple[Rows, Rows], start: tuple[Rows, Rows], at: tuple[Rows, Rows], pairs: PairParameters
    ) -> None:
        """Append the reserve where any of it overlaps at the end of a step, with gaps and normals of its start.

        Their side is that of the start: at the end a thin wall may lie behind them.

        Args:
            end: Node positions and poses of frames at the end of the step.
            start: Those at its start.
            at: Node velocities and twists, those of ``find``.
            pairs: Contact laws.
        """
        c = self.contacts
        if self.is_patient:
            waiting = (self.none, self.reserve_count, self.reserve_key, self.reserve_couple, self.reserve_face)
            self._measure(self.places(*end, *at, again=True), waiting, self.reserve_touch, is_found=False)
            inputs = [self.scene.couple, self.capacity, self.reserve_key.real, self.reserve_couple.real]
            inputs += [self.reserve_face.real, self.reserve_touch.real, pairs.distance.real, c.idle.real]
            outputs = [self.reserve_count.real, c.first.real, c.count.real, c.overflow.real, c.key.real, c.pair.real]
            outputs += [self.couple.real, self.face.real, self.known.real]
            self._launch(self.k_list.call_up, None, inputs, outputs)
            self._describe(self.places(*start, *at, again=True), pairs, is_found=False)
            self.called.copy_from(c.first)
        else:
            self.called.copy_from(c.count)

    def _describe(self, motion: Any, pairs: PairParameters, *, is_found: bool = True) -> None:
        """Geometry, axes, laws and slots of contacts from the first new one on."""
        c = self.contacts
        self._measure(motion, is_found=is_found)
        parts = self.variant.parts(self.capacity)
        inputs = [parts, c.first.real, c.count.real, c.key.real, c.pair.real]
        inputs += [self.known.real, self.known_force.real, self.touch.real]
        inputs += [p.real for p in (pairs.distance, pairs.mu, pairs.restitution, pairs.compliance)]
        outputs = [r.real for r in (c.axes, c.gap, c.mu, c.restitution, c.compliance, c.multiplier)]
        self._launch(self.k.describe, parts, inputs, outputs)
        inputs = [self.scene, self.node_dof, self.node_frame, self.frame_dof, self.frame_master]
        inputs += [self.frame_blend, self.blend_ends, self.blend_place]
        inputs += [self.node_total, self.carrier, self.carrier_weight, parts, motion]
        inputs += [c.first.real, c.count.real, c.key.real, self.couple.real, self.face.real, self.touch.real]
        inputs += [c.gap.real]
        outputs = [c.point.real, c.dof.real, c.weight.real, c.lever.real]
        self._launch(self.k.slots, parts, inputs, outputs)

    def _measure(
        self, motion: Any, listed: tuple[Rows, ...] | None = None, touch: Rows | None = None, *, is_found: bool = True
    ) -> None:
        """Geometry of the contacts, or of others: their first, count, keys, couples and faces.

        ``is_found`` if ``motion`` is that of the last search.
        """
        a, c = self.arrays, self.contacts
        *rows_, face = listed or (c.first, c.count, c.key, self.couple, self.face)
        parts = self.variant.parts(self.capacity)
        inputs = [self.scene, parts, motion, self.reach.real, *(r.real for r in rows_)]
        outputs = [(touch or self.touch).real]
        if a.shape_chunks.size:
            found = [self.seats if is_found else 0, self.found_key.real, self.found_touch.real]
            self._launch(self.k_shape.measure, parts, [*inputs, face.real, *found], outputs)
        if a.surface_chunks.size:
            self._launch(self.k_surface.measure, parts, [*inputs, face.real], outputs)

    def _motion(self, x: Rows, pose: Rows, v: Rows, twist: Rows, *, again: bool = False) -> Any:
        """Bounds of soft bodies and rods, boxes of their trees; positions and velocities as a struct."""
        a = self.arrays
        inputs: list[Any]
        motion = self.places(x, pose, v, twist, again=again)
        if self.embedded_count:
            x, v = self.all_x, self.all_v
        if self.has_points:
            parts = self.variant.parts(SPREAD_PARTS)
            inputs = [self.scene, a.object_frame, a.object_point, parts, x.S, pose.S, v.S, twist.S]
            self._launch_elements(self.k_tree.spread_part, self.object_count * parts, inputs, [self.spread.S])
            inputs = [a.object_frame, parts, self.spread.S]
            self._launch_elements(self.k_tree.spread, self.object_count, inputs, [self.box.S, self.velocity.S])
        for first, count in ((0, a.tasks[0]), (a.tasks[0], a.tasks[1])):
            inputs = [self.scene.tree_skip, a.corner_start, a.corner_row, a.corner_radius]
            inputs += [a.task_start, a.task_node, first, x.S, pose.S]
            self._launch_elements(self.k_tree.refit, count, inputs, [self.tree_box.S])
        return motion

    def places(self, x: Rows, pose: Rows, v: Rows, twist: Rows, *, again: bool = False) -> Any:
        """Positions and velocities as a struct, those of embedded points among them.

        ``again`` takes velocities of nodes and embedded points as they were in the step's first search.
        """
        if self.embedded_count:
            x, v = self._with_embedded(x, self.all_x), self.all_v if again else self._with_embedded(v, self.all_v)
        motion = self.types.Motion()
        motion.x, motion.pose, motion.v, motion.twist = x.real, pose.real, v.real, twist.real
        motion.tree_box, motion.choice = self.tree_box.real, self.choice.real
        return motion

    def _near(self, motion: Any, laws: list[Any], reach: Rows) -> None:
        """Boxes of all objects, and which couples can be near at their present speeds."""
        a = self.arrays
        inputs = [a.object_frame, a.object_round, a.object_centre, a.object_extent, motion]
        self._launch(self.k.bounds, self.object_count, inputs, [self.box.real, self.velocity.real])
        self._launch(self.k.couples, self.couple_count, [self.scene, motion, self.box.real, *laws], [reach.real])

    def _strikes(self, motion: Any, laws: list[Any], restitution: Rows) -> None:
        """Hulls of the velocities within the step, and the reach of couples with them."""
        a = self.arrays
        lists = [self.scene, a.object_start, a.object_couple, self.object_free]
        inputs = [*lists, self.near.real, self.velocity.real, restitution.real]
        self._launch(self.k_strike.object_strikes, self.object_count, inputs, [self.struck.real])
        inputs = [*lists, motion, self.box.real, self.near.real, self.velocity.real, self.struck.real]
        inputs += [restitution.real, *laws]
        self._launch(self.k_strike.couple_strikes, self.couple_count, inputs, [self.hull.real, self.reach.real])

    def _search(self, motion: Any, laws: list[Any], reach: Rows, ahead: float) -> None:
        """Hits of the chunks of near couples, not farther than ``ahead`` beyond the contact distance."""
        a = self.arrays
        if a.tracked.size:
            parts = self.variant.parts(SPREAD_PARTS)
            inputs = [self.scene, a.object_point, a.tracked, parts, motion]
            self.moved.zero()
            self._launch(self.k.drift, parts * a.tracked.size, inputs, [self.before.real, self.moved.real])
        shared = [a.chunk_key, a.chunk_couple, motion, self.box.real, reach.real, self.hull.real, *laws, ahead]
        outputs = [self.chunk_hits.real, self.hit.real]
        if self.k_near is not None and a.node_chunks.size:
            inputs = [self.scene, a.node_chunks, a.chunk_key, a.chunk_couple, motion, self.box.real, reach.real]
            wp.launch(
                self.k_near.sift,
                dim=(self.packs, a.node_chunks.size),
                inputs=inputs,
                outputs=outputs,
                device=self.device,
            )
        if self.seats and a.shape_chunks.size:
            self.found_key.zero()
        found, chunks = [self.found_key.real, self.found_touch.real], a.shape_chunks
        if self.k_near is not None and self.k_box is not None and a.box_chunks.size:
            chunks, dim = a.other_chunks, (self.packs, a.box_chunks.size)
            inputs = [self.scene, a.box_chunks, *shared, self.seats]
            wp.launch(self.k_box.search, dim=dim, inputs=inputs, outputs=[*outputs, *found], device=self.device)
        inputs = [self.scene, chunks, *shared, self.sifted, self.seats]
        self._launch(self.k_shape.find, chunks.size, inputs, [*outputs, *found])
        if self.k_sift is not None and a.tracked_chunks.size:
            inputs = [self.scene, a.tracked_chunks, a.chunk_key, a.chunk_couple, motion, self.box.real, reach.real]
            inputs += [self.moved.real, laws[0], ahead < 0.0, self.chunk_hits.real, self.sought.real, self.room.real]
            wp.launch(self.k_sift.sift, dim=(self.packs, a.tracked_chunks.size), inputs=inputs, device=self.device)
        inputs = [self.scene, a.surface_chunks, *shared, self.moved.real, self.k_sift is not None]
        outputs = [self.sought.real, *outputs, self.room.real]
        self._launch(self.k_surface.find, a.surface_chunks.size, inputs, outputs)

    # Memory

    def remember(self, *, notes: bool = False, joins: bool = False) -> None:
        """Take the forces of ``contacts`` as the first guess of the next ``find``.

        Args:
            notes: Whether to note what has pressed, too, which that keeps.
            joins: Whether a contact that was found late once more leaves both forces; else that of the first.
        """
        c = self.contacts
        inputs = [joins, c.listed.real, c.count.real, c.key.real, c.axes.real, c.multiplier.real]
        outputs = [self.known_count.real, self.known_key.real, self.known_force.real]
        self._launch(self.k_list.remember, self.capacity, inputs, outputs)
        if notes and self.k_keep is not None:
            inputs = [self.stuck.real, c.listed.real, c.count.real, c.key.real]
            inputs += [self.couple.real, self.face.real, self.held.real]
            outputs = [self.known_couple.real, self.known_face.real, self.known_held.real]
            self._launch(self.k_keep.note, self.capacity, [*inputs, c.multiplier.real], outputs)

    def load(self, count: wp.array, key: wp.array, force: wp.array) -> None:
        """Take the first guess from the state, arrays (world, row)."""
        inputs = [count, key, force, self.world_count, self.lanes]
        outputs = [self.known_count.real, self.known_key.real, self.known_force.real, self.contacts.overflow.real]
        self._launch(self.k_list.load, self.capacity, inputs, outputs)

    def store(self, flag: Rows, count: wp.array, key: wp.array, force: wp.array) -> None:
        """Write what was remembered to the state of those worlds whose flags 0 and 1 are zero."""
        inputs = [self.lanes, flag.real, self.known_count.real, self.known_key.real, self.known_force.real]
        self._launch(self.k_list.store, self.capacity, inputs, [count, key, force])
