"""Contacts in the adjoint of a step: the transposed multiplier problem, with the active set that the step has found.

Equations: docs/theory/adjoint.md.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from softwarp.kernels.rows import (
    contact_adjoint,
    contact_equations,
    elimination,
    embedded_adjoint,
    touch_adjoint,
    touch_gather,
)
from softwarp.model import memory
from softwarp.model.gradients import Gradients
from softwarp.solvers.collision.detector import Detector
from softwarp.solvers.multipliers import ContactMultipliers
from softwarp.solvers.system import System
from softwarp.solvers.terms.contact import ContactTerm
from softwarp.solvers.workspace import rows
from softwarp.solvers.workspace.rows import Rows
from softwarp.solvers.workspace.shard import Shard

KEPT = (
    "count",
    "listed",
    "key",
    "pair",
    "dof",
    "weight",
    "lever",
    "axes",
    "gap",
    "mu",
    "restitution",
    "compliance",
    "multiplier",
)


def contact_solution(contact: ContactTerm) -> list[wp.array]:
    """What a step knows of its contacts."""
    kept = [getattr(contact.contacts, name).real for name in KEPT]
    return [*kept, contact.detector.couple.real, contact.detector.face.real]


class ContactAdjoint:
    """Forces z of the contacts of one system, beside q of its static rows.

    Args:
        system: Worlds, with contacts.
        h: Step [s].
        gradients: Arrays of these worlds.

    Attributes:
        look: What the laws of contacts look at, see ``touch_adjoint``.
        u: Velocities of the first solution, where contacts have been looked at at the end of its way.
        normal: Normals of contacts there.
        force: Gradients by the forces of contacts, in their axes.
        unsure: Not 0 in worlds whose equations have no solution, until somebody clears it.
        way: h H p of contacts and ``force``, which friction has a gradient by.
        rest_bar: Receives gradients by the rest positions of nodes that something carries, if there is room for them.
    """

    forward = False  # whether the equations are those of changes of forces
    drops_open = True  # whether what pushed in no solution is left out; nobody else may know contacts by their place
    knows_way = False  # whether ``way`` has been found from another p
    first_force: Rows | None = None  # of contacts in the first solution, where that is differentiated too
    listed: tuple[Rows, Rows] | None = None  # rows of listed nodes that take what nodes have by places and velocities
    later: Rows | None = None  # what ``push_nodes`` adds by v: of later contacts, which look where it leads to

    def __init__(self, system: System, h: float, gradients: Gradients) -> None:
        assert isinstance(system.multipliers, ContactMultipliers)
        assert system.contact is not None
        self.system, self.h, self.gradients = system, h, gradients
        self.laws, self.contacts, self.shard = system.multipliers.laws, system.contact.contacts, system.shard
        self.pairs, self.subspace = system.contact.pairs, system.contact.subspace
        s = self.shard
        self.k, self.k_laws = contact_adjoint.kernels(s.variant), contact_equations.kernels(s.variant, self.forward)
        self.z, self.mode = s.rows(3 * self.contacts.capacity), s.rows(4 * self.contacts.capacity)
        self.spare, self.offset, self.way, self.force = (s.rows(3 * self.contacts.capacity) for _ in range(4))
        self.detector = system.contact.detector
        self.unsure = memory.zeros((s.packs, 1, s.lanes), wp.int32, s.device)
        self._prepare_touches()
        order, worlds = self.laws.order, s.packs * s.lanes
        sizes = order * elimination.stride_of(order), order * elimination.ROWS
        if s.variant.world_fastest:
            self.matrix, self.held = (rows.allocate_whole(s.variant, s.world_count, n, s.device).real for n in sizes)
        else:
            self.matrix, self.held = (memory.zeros((worlds, n, 1), s.variant.real, s.device) for n in sizes)
        self.no_rest = self.rest_bar = wp.zeros((1, 0), dtype=s.variant.real, device=s.device)
        self.is_new = True  # so that factors of the equations are to be found

    def _prepare_touches(self) -> None:
        """Kernels and room for what depends on where everything is."""
        s, frames, detector = self.shard, self.shard.model.frames, self.detector
        self.k_touch, self.k_gather = touch_adjoint.kernels(s.variant), touch_gather.kernels(s.variant)
        if not self.forward:
            self.parts = s.rows(touch_adjoint.ROWS * self.contacts.capacity)
        self.top, self.fields = self.k_touch.Topology(), self.k_touch.Fields()
        self.top.node_dof, self.top.node_frame = detector.node_dof, detector.node_frame
        self.top.frame_dof, self.top.frame_master = detector.frame_dof, detector.frame_master
        kinematic = np.zeros(1 if frames is None else frames.count)
        if frames is not None:
            kinematic[: frames.rigid_count] = frames.is_kinematic
        self.is_kinematic = wp.array(kinematic, dtype=wp.int32, device=s.device)
        rest = np.zeros((1, 7)) if frames is None else frames.rest_pose
        self.rest_pose = wp.array(rest, dtype=s.variant.real, device=s.device)
        self.look, self.u, self.normal = s.integers(self.contacts.capacity), s.work.dof_v, self.contacts.axes
        self.embedded = None
        if detector.embedded_count and not self.forward:
            self.embedded = EmbeddedPoints(s, detector)
            self.top.node_dof, self.top.node_frame = self.embedded.node_dof, self.embedded.node_frame
        self.has_moving_frames = s.model.has_moving_frames  # which reads the device, as a recording cannot

    def take_listed(self, node: wp.array, by_x: Rows, by_v: Rows) -> None:
        """What nodes have is added to rows of listed ones from now on, which are all; but at the end of a way."""
        if self.embedded is None:
            self.embedded = EmbeddedPoints(self.shard, self.detector)
        self.embedded.index_listed(node.numpy())
        self.listed = by_x, by_v

    def take_rest(self, rest_bar: wp.array | None) -> None:
        """Whether gradients by the rest positions of nodes that something carries are added, and to what."""
        self.rest_bar = self.no_rest if rest_bar is None else rest_bar

    def begin(self, v: Rows, *, first: bool = True) -> None:
        """Sides of all contacts and their states.

        Args:
            v: Velocities that a solution of the step has found.
            first: Whether it is the first one that is differentiated; sides are there else.
        """
        c, s = self.contacts, self.shard
        self.is_new = True
        self._expand(v)
        self.z.zero()
        if first:
            if self.drops_open:
                self._drop_open()
            c.first.zero()
            self.laws.sides(self.system.linear)
        inputs = [self.h, c.count.real, *self._rows(), c.mu.real, c.multiplier.real, v.real]
        s.each_real(self.k.modes, c.capacity, inputs, [self.mode.real])

    def _drop_open(self) -> None:
        """Leave out contacts that pushed in no solution, which have no part in anything."""
        c, d, s = self.contacts, self.detector, self.shard
        first_force = c.multiplier if self.first_force is None else self.first_force
        outputs = [c.count.real, c.listed.real, c.key.real, c.pair.real, c.dof.real, d.couple.real, d.face.real]
        outputs += [self.look.real, c.weight.real, c.lever.real, c.axes.real, c.gap.real, c.mu.real]
        outputs += [c.restitution.real, c.compliance.real, c.multiplier.real, first_force.real, self.normal.real]
        s.each_real(self.k.drop_open, None, [9 if self.normal is c.axes else 3], outputs)

    def add_forces(self, y: Rows) -> None:
        """y -= h H' z."""
        c = self.contacts
        self.spare.copy_from(c.multiplier)
        c.multiplier.copy_from(self.z)
        self.laws.add_forces(y, -self.h)
        c.multiplier.copy_from(self.spare)

    def push_nodes(self, by_p: Rows, by_v: Rows) -> None:
        """h F and -h z on dofs, and behind them on nodes of reduced bodies, in the axes of the world."""
        c = self.contacts
        self.laws.push(self.h, by_p)
        self.spare.copy_from(c.multiplier)
        c.multiplier.copy_from(self.z)
        self.laws.push(-self.h, by_v)
        c.multiplier.copy_from(self.spare)
        if self.later is not None:
            self.shard.add(self.later, by_v, by_v.real.shape[1])

    def respond(self, y: Rows, p: Rows, q: Rows, gaps: Any, active: Rows, first: bool) -> None:
        """Change of q and z from the half-solved right-hand side, and its effect on that.

        Args:
            y: Half-solved right-hand sides.
            p: What is known of the adjoint of velocities.
            q: Adjoint of static rows, updated.
            gaps: Launches the kernel that writes the gaps of static rows, into the array that it is given.
            active: Which static rows are between their bounds.
            first: Whether the factor is a new one.
        """
        laws, c, s, h, w, k = self.laws, self.contacts, self.shard, self.h, self.shard.work, self.k_laws
        if first:
            self.is_new = True
            laws.delassus(y, h * h, whole=True)
        self._known_gaps(p)
        laws.contact_sides.free_gap(y, h, laws.gap)
        if laws.static_rows:
            gaps(laws.gap)
        inputs = [c.count.real, laws.matrix.real, w.compliance.real, c.compliance.real]
        inputs += [active.real, self.mode.real, c.mu.real, laws.gap.real, self.offset.real]
        outputs, sizes = [laws.change.real, q.real, self.z.real, self.unsure], [laws.static_rows, laws.order]
        if self.is_new:
            s.each_real(k.note_equations, None, [*sizes, *inputs, self.z.real], [self.held])
            of_worlds, items = [*sizes, c.count.real, laws.matrix.real, self.held], 1
            if s.variant.world_fastest:
                items = laws.order
            wp.launch(k.fill_matrices, s.variant.dim(s.width, items), of_worlds, [self.matrix], device=s.device)
            s.each_real(k.factor_matrix, None, [*sizes, c.count.real], [self.matrix, self.held])
        s.each_real(k.solve_again, None, [*sizes, *inputs, self.matrix], [self.held, *outputs])
        self.is_new = False
        laws.add_change(y, -h)

    def _expand(self, *velocities: Rows) -> None:
        """Velocities of nodes of reduced bodies, behind those of the dofs that they follow from."""
        if self.subspace is not None:
            self.subspace.expand(*velocities)

    def _known_gaps(self, p: Rows) -> None:
        c = self.contacts
        self._expand(p)
        inputs = [self.laws.static_rows, self.h, c.count.real, *self._rows(), p.real, self.force.real]
        self.shard.each_real(self.k.known_gaps, c.capacity, inputs, [self.laws.gap.real])

    def find_way(self, p: Rows, way: Rows) -> None:
        """h H p of all contacts, and what ``force`` has."""
        c = self.contacts
        self._expand(p)
        inputs = [0, self.h, c.count.real, *self._rows(), p.real, self.force.real]
        self.shard.each_real(self.k.known_gaps, c.capacity, inputs, [way.real])

    def to_state(self, p: Rows) -> None:
        """Add the gradients by positions, poses, velocities and friction at the start of the step.

        Args:
            p: Adjoint of velocities; of friction, ``way`` counts where it is known.
        """
        if not self.knows_way:
            self.find_way(p, self.way)
        g = self.gradients
        self._to_places(p, g.node_x, g.frame_pose, g.node_v, at_end=False)

    def to_end(self, p: Rows, x_bar: wp.array | None, pose_bar: wp.array | None, v_bar: wp.array | None = None) -> None:
        """Add those by positions and poses at the end of the first solution's way, where everything is now.

        Args:
            p: Adjoint of the velocities of the last solution.
            x_bar: Receives gradients by positions, as ``Gradients.node_x``.
            pose_bar: Likewise, as ``Gradients.frame_pose``.
            v_bar: Receives those by velocities at the start, if not ``Gradients.node_v``.
        """
        g = self.gradients
        x_bar, pose_bar = (g.node_x if x_bar is None else x_bar), (g.frame_pose if pose_bar is None else pose_bar)
        self._to_places(p, x_bar, pose_bar, g.node_v if v_bar is None else v_bar, at_end=True)

    def _to_places(self, p: Rows, x_bar: wp.array, pose_bar: wp.array, v_bar: wp.array, *, at_end: bool) -> None:
        g = self.gradients
        moving, normal = self._motion(p), self.normal if at_end else self.contacts.axes
        self._find_parts(moving, normal, 3 if at_end else 9, at_end=at_end)
        outputs = [x_bar, v_bar, g.pair_mu, pose_bar, g.frame_twist, g.command_body_velocity]
        self._gather(moving[0], outputs, at_end=at_end)

    def _find_parts(self, moving: tuple[Any, Any], normal: Rows, normal_rows: int, *, at_end: bool) -> None:
        c, s, o, d = self.contacts, self.shard, self.system.options, self.detector
        motion, fields = moving
        inputs = [self.h, o.recovery_share(self.h), o.recovery_speed, o.bounce_speed, d.node_total]
        inputs += [at_end, normal_rows, d.scene, self.top, motion, fields, self.look.real, normal.real]
        inputs += [c.count.real, c.listed.real, c.key.real, d.couple.real]
        inputs += [d.face.real, c.axes.real, c.gap.real, c.restitution.real, c.compliance.real, c.multiplier.real]
        inputs += [self.mode.real, self.z.real]
        s.each_real(self.k_touch.parts, c.capacity, inputs, [self.parts.real])

    def _gather(self, motion: Any, outputs: list[wp.array], *, at_end: bool) -> None:
        c, s, d = self.contacts, self.shard, self.detector
        inputs = [s.lanes, self.has_moving_frames, at_end, d.scene, self.top, self.is_kinematic, self.rest_pose, motion]
        inputs += [c.count.real, c.pair.real, c.key.real, d.couple.real, d.face.real]
        inputs += [c.multiplier.real, self.mode.real, self.way.real, self.parts.real]
        x_bar, v_bar, *others = outputs
        places = [x_bar, v_bar] if self.embedded is None else self.embedded.begin()
        s.each_real(self.k_gather.gather, None, inputs, [*places, *others, self.rest_bar])
        if self.listed is not None and self.embedded is not None and not at_end:
            self.embedded.spread_listed(*self.listed)
        elif self.embedded is not None:
            self.embedded.spread(x_bar, v_bar)

    def _motion(self, p: Rows) -> tuple[Any, Any]:
        """Where everything is and how it moves, and the velocities of dofs; nodes of modes have theirs by then."""
        s, w, fields = self.shard, self.shard.work, self.fields
        velocities = [p, w.dof_v, w.dof_v0, self.u]
        if self.embedded is not None:
            velocities = self.embedded.velocities(velocities)
        fields.p, fields.v, fields.v0, fields.u = (part.real for part in velocities)
        return self.detector.places(w.x, w.pose, s.input["v0"], s.input["twist0"]), fields

    def _rows(self) -> list[wp.array]:
        c = self.contacts
        return [c.dof.real, c.weight.real, c.lever.real, c.axes.real]


class EmbeddedPoints:
    """Points of collision surfaces as nodes behind all others, with dofs behind all others.

    Args:
        shard: Worlds.
        detector: Which has them.

    Attributes:
        node_dof: Of nodes, and of embedded points.
        node_frame: Frames that carry nodes; none carries embedded points.
    """

    def __init__(self, shard: Shard, detector: Detector) -> None:
        self.shard, self.detector = shard, detector
        self.k, s = embedded_adjoint.kernels(shard.variant), shard
        self.k_elements = embedded_adjoint.element_kernels(shard.variant)
        self.dofs, self.nodes, count = s.model.dof_room, int(detector.node_dof.size), detector.embedded_count
        dof = np.concatenate([detector.node_dof.numpy(), self.dofs + np.arange(count)])
        frame = np.concatenate([detector.node_frame.numpy(), np.full(count, -1)])
        self.node_dof, self.node_frame = (wp.array(part, dtype=wp.int32, device=s.device) for part in (dof, frame))
        self._held = [s.rows(3 * (self.dofs + count)) for _ in range(4)]
        size = (s.world_count, 3 * (self.nodes + count))
        self._x, self._v = (wp.zeros(size, dtype=s.variant.real, device=s.device) for _ in range(2))

    def velocities(self, given: list[Rows]) -> list[Rows]:
        """Velocities of dofs, and of embedded points behind them."""
        s, d = self.shard, self.detector
        if not d.embedded_count:
            return given
        for value, held in zip(given, self._held, strict=True):
            s.place(value, 3 * self.dofs, held, 0)
            inputs = [self.dofs, d.carrier, d.carrier_weight, d.node_dof]
            s.each(self.k_elements.embed, d.embedded_count, inputs, [held.S])
        return self._held

    def begin(self) -> list[wp.array]:
        """Room for gradients by places and velocities of nodes and embedded points, 0 at first."""
        self._x.zero_()
        self._v.zero_()
        return [self._x, self._v]

    def spread(self, x_bar: wp.array, v_bar: wp.array) -> None:
        """Add what is there now to gradients by nodes."""
        s, d = self.shard, self.detector
        for moves, whole, bar in ((False, self._x, x_bar), (True, self._v, v_bar)):
            inputs = [s.lanes, self.nodes, d.embedded_count, moves, d.carrier, d.carrier_weight, d.node_dof, whole]
            s.each_real(self.k.spread, None, inputs, [bar])

    def index_listed(self, listed: npt.NDArray[np.int32]) -> None:
        """Find what every listed node takes from nodes and embedded points."""
        d, device = self.detector, self.shard.device
        count, moves = d.embedded_count, d.node_dof.numpy() >= 0
        carrier, weight = d.carrier.numpy()[:count].reshape(-1), d.carrier_weight.numpy()[:count].reshape(-1)
        own = d.point_nodes
        node = np.concatenate([own, carrier])
        source = np.concatenate([own, self.nodes + np.repeat(np.arange(count), 4)])
        weight = np.concatenate([np.ones(len(own)), weight])
        place = np.full(self.nodes, -1)
        place[listed] = np.arange(len(listed))
        order = np.argsort(place[node], kind="stable")
        touched, start = np.unique(place[node][order], return_index=True)
        start = np.append(start, len(order))

        def integers(values: npt.NDArray[np.int64]) -> wp.array:
            return wp.array(values, dtype=wp.int32, device=device)

        self._touched = [integers(touched), integers(moves[listed[touched]]), integers(start)]
        self._touched += [
            integers(source[order]),
            wp.array(weight[order], dtype=self.shard.variant.real, device=device),
        ]

    def spread_listed(self, by_x: Rows, by_v: Rows) -> None:
        """Add it to rows of listed nodes, after ``index_listed``."""
        s = self.shard
        inputs = [s.lanes, *self._touched, self._x, self._v]
        s.each_real(self.k.spread_listed, self._touched[0].size, inputs, [by_x.real, by_v.real])
