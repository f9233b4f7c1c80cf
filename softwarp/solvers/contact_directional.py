"""Contacts in the directional derivative of a step, with the active set that the step has found.

Equations: docs/theory/adjoint.md.
"""

from __future__ import annotations

from softwarp.kernels.rows import contact_directional
from softwarp.model.gradients import Gradients
from softwarp.solvers.contact_adjoint import ContactAdjoint
from softwarp.solvers.system import System
from softwarp.solvers.workspace.rows import Rows


class ContactDirection(ContactAdjoint):
    """Changes -z of the forces of contacts along a direction.

    Args:
        system: Worlds, with contacts.
        h: Step [s].
        slopes: Arrays of these worlds, the direction.
    """

    forward = True

    def __init__(self, system: System, h: float, slopes: Gradients) -> None:
        super().__init__(system, h, slopes)
        self.k_changes = contact_directional.kernels(self.shard.variant)
        self.change = self.shard.rows(3 * self.contacts.capacity)

    def along(self, x: Rows, v: Rows) -> None:
        """What slopes of the nodes' positions and velocities, and of friction, change; needs ``begin``."""
        c, s, m, o = self.contacts, self.shard, self.shard.model, self.system.options
        inputs = [self.h, s.lanes, m.node_count, o.recovery_share(self.h), o.recovery_speed, o.bounce_speed]
        inputs += [m.dof_node, self.gradients.pair_mu, c.count.real, c.listed.real, c.pair.real, *self._rows()]
        inputs += [c.gap.real, self.pairs.distance.real, c.restitution.real, c.compliance.real, c.multiplier.real]
        inputs += [self.mode.real, s.work.dof_v.real, s.work.dof_v0.real, x.real, v.real]
        s.each_real(self.k_changes.changes, c.capacity, inputs, [self.change.real, self.offset.real])

    def _known_gaps(self, p: Rows) -> None:
        super()._known_gaps(p)
        rows = 3 * self.contacts.capacity
        inputs = [self.laws.static_rows, self.change.real]
        self.shard.each_real(self.k_changes.take_changes, rows, inputs, [self.laws.gap.real])
