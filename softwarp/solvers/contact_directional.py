"""Contacts in the directional derivative of a step, with the active set that the step has found.

Equations: docs/theory/adjoint.md.
"""

from __future__ import annotations

from softwarp.kernels.rows import touch_directional
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

    Attributes:
        u_slope: Slopes of the first solution's velocities, where contacts look at where it leads to.
    """

    forward, drops_open = True, False

    def __init__(self, system: System, h: float, slopes: Gradients) -> None:
        super().__init__(system, h, slopes)
        s, capacity = self.shard, self.contacts.capacity
        self.k_slopes = touch_directional.kernels(s.variant)
        self.slopes = self.k_slopes.Slopes()
        self.change, self.pushes = s.rows(3 * capacity), s.rows(touch_directional.FORCES * capacity)
        self.u_slope = s.rows(3 * s.model.dof_count)

    def along(self, x: Rows, v: Rows, *, at_end: bool = False) -> None:
        """What slopes of the nodes' positions and velocities, and of friction, change; needs ``begin``.

        Args:
            x: Slopes of positions, where everything is now.
            v: Slopes of velocities at the start of the step.
            at_end: Whether that is where the first solution leads to, of which this adds what contacts look at.
        """
        c, s, o, d, k = self.contacts, self.shard, self.system.options, self.detector, self.k_slopes
        motion, fields = self._motion(v)
        slopes = self.slopes
        slopes.x, slopes.v, slopes.u = x.real, v.real, self.u_slope.real
        inputs = [self.h, o.recovery_share(self.h), o.recovery_speed, o.bounce_speed, d.node_total]
        inputs += [at_end, 3 if at_end else 9, touch_directional.OUTPUTS, d.scene, self.top, motion, fields, slopes]
        inputs += [self.look.real, (self.normal if at_end else c.axes).real]
        inputs += [c.count.real, c.listed.real, c.key.real, d.couple.real, d.face.real]
        inputs += [c.axes.real, c.gap.real, c.restitution.real, c.compliance.real, c.multiplier.real, self.mode.real]
        s.each_real(k.changes, c.capacity, inputs, [self.change.real, self.pushes.real])
        if at_end:
            return
        inputs = [s.lanes, self.gradients.pair_mu, c.count.real, c.pair.real, c.multiplier.real, self.mode.real]
        s.each_real(k.frictions, c.capacity, inputs, [self.offset.real])

    def push(self, side: Rows) -> None:
        """Add what forces that turn, and points that share them otherwise, push dofs with; needs ``along``."""
        c, s, d = self.contacts, self.shard, self.detector
        inputs = [d.scene, self.top, s.model.dof_free, c.count.real, c.key.real, d.couple.real, d.face.real]
        s.each_real(self.k_slopes.push_dofs, None, [*inputs, self.mode.real, self.pushes.real], [side.real])

    def _known_gaps(self, p: Rows) -> None:
        super()._known_gaps(p)
        rows = 3 * self.contacts.capacity
        inputs = [self.laws.static_rows, self.change.real]
        self.shard.each_real(self.k_slopes.take_changes, rows, inputs, [self.laws.gap.real])
