"""Contacts in the adjoint of a step: the transposed multiplier problem, with the active set that the step has found.

Equations: docs/theory/adjoint.md.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from softwarp.kernels.rows import contact_adjoint
from softwarp.model.gradients import Gradients
from softwarp.solvers.multipliers import ContactMultipliers
from softwarp.solvers.system import System
from softwarp.solvers.workspace import rows
from softwarp.solvers.workspace.rows import Rows

KEPT = (
    "count",
    "listed",
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


class ContactAdjoint:
    """Forces z of the contacts of one system, beside q of its static rows.

    Args:
        system: Worlds, with contacts.
        h: Step [s].
        gradients: Arrays of these worlds.
    """

    forward = False  # whether the equations are those of changes of forces

    def __init__(self, system: System, h: float, gradients: Gradients) -> None:
        assert isinstance(system.multipliers, ContactMultipliers)
        assert system.contact is not None
        self.system, self.h, self.gradients = system, h, gradients
        self.laws, self.contacts, self.shard = system.multipliers.laws, system.contact.contacts, system.shard
        self.pairs = system.contact.pairs
        s = self.shard
        self.k = contact_adjoint.kernels(s.variant, self.forward)
        self.z, self.mode = s.rows(3 * self.contacts.capacity), s.rows(4 * self.contacts.capacity)
        self.spare, self.offset = (s.rows(3 * self.contacts.capacity) for _ in range(2))
        self.pairs_model = system.contact.model
        self._index()
        self.matrix = rows.allocate_whole(s.variant, s.world_count, self.laws.order**2, s.device)

    def _index(self) -> None:
        """Whose the dofs of frames are, and which frames are touched."""
        s, frames, scene = self.shard, self.shard.model.frames, self.pairs_model.scene
        dofs = np.full(s.model.dof_count, -1)
        targets, kinematic = (np.zeros(1 if frames is None else frames.count) for _ in range(2))
        if frames is not None:
            own = np.flatnonzero(frames.master == np.arange(frames.count))
            held = frames.frame_dof.numpy().reshape(-1, 2)[own]
            dofs[held] = 2 * own[:, None] + (0, 1)
            named = [scene.entities[couple.b].frame for couple in scene.couples]
            kinematic[: frames.rigid_count] = frames.is_kinematic
            targets[[frame for frame in named if frame >= 0]] = 1
        self.dof_frame = wp.array(dofs, dtype=wp.int32, device=s.device)
        self.is_target = wp.array(targets, dtype=wp.int32, device=s.device)
        self.is_kinematic = wp.array(kinematic, dtype=wp.int32, device=s.device)
        self.pose0 = s.input["pose0"].real if frames is not None else self.z.real

    @property
    def solution(self) -> list[wp.array]:
        """What a step knows of its contacts."""
        return [getattr(self.contacts, name).real for name in KEPT]

    def begin(self, v: Rows) -> None:
        """Sides of all contacts and their states; ``v`` are the velocities that the step has found."""
        c, s = self.contacts, self.shard
        self.z.zero()
        c.first.zero()
        self.laws.sides(self.system.linear)
        inputs = [self.h, c.count.real, *self._rows(), c.mu.real, c.multiplier.real, v.real]
        s.each_real(self.k.modes, c.capacity, inputs, [self.mode.real])

    def add_forces(self, y: Rows) -> None:
        """y -= h H' z."""
        c = self.contacts
        self.spare.copy_from(c.multiplier)
        c.multiplier.copy_from(self.z)
        self.laws.add_forces(y, -self.h)
        c.multiplier.copy_from(self.spare)

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
        laws, c, s, h, w = self.laws, self.contacts, self.shard, self.h, self.shard.work
        if first:
            laws.delassus(y, h * h)
        self._known_gaps(p)
        laws.contact_sides.free_gap(y, h, laws.gap)
        if laws.static_rows:
            gaps(laws.gap)
        inputs = [laws.static_rows, laws.order, c.count.real, laws.matrix.real, w.compliance.real, c.compliance.real]
        inputs += [active.real, self.mode.real, c.mu.real, laws.gap.real, self.offset.real]
        outputs = [self.matrix.real, laws.change.real, q.real, self.z.real]
        s.each_real(self.k.solve, None, inputs, outputs)
        laws.add_change(y, -h)

    def _known_gaps(self, p: Rows) -> None:
        c = self.contacts
        inputs = [self.laws.static_rows, self.h, c.count.real, *self._rows(), p.real]
        self.shard.each_real(self.k.known_gaps, c.capacity, inputs, [self.laws.gap.real])

    def to_state(self, p: Rows) -> None:
        """Add the gradients by positions, velocities and friction at the start of the step."""
        c, s, m, o, g = self.contacts, self.shard, self.shard.model, self.system.options, self.gradients
        scalars = [self.h, s.lanes, o.recovery_share(self.h), o.recovery_speed, o.bounce_speed, m.has_moving_frames]
        inputs = [*scalars, m.dof_node, self.dof_frame, self.is_target, self.is_kinematic, self.pose0]
        inputs += [c.count.real, c.listed.real, c.pair.real, *self._rows(), c.gap.real]
        inputs += [self.pairs.distance.real, c.restitution.real]
        inputs += [c.compliance.real, c.multiplier.real, self.mode.real, self.z.real, p.real, s.work.dof_v.real]
        inputs.append(s.work.dof_v0.real)
        outputs = [g.node_x, g.node_v, g.pair_mu, g.frame_pose, g.frame_twist, g.command_body_velocity]
        s.each_real(self.k.gradients, None, inputs, outputs)

    def _rows(self) -> list[wp.array]:
        c = self.contacts
        return [c.dof.real, c.weight.real, c.lever.real, c.axes.real]
