"""The directional derivative of a step that looks at contacts where it leads to, after that of its first solution.

Equations: docs/theory/adjoint.md.
"""

from __future__ import annotations

import warp as wp

from softwarp.model.gradients import Gradients
from softwarp.solvers.adjoint_index import AdjointIndex
from softwarp.solvers.contact_directional import ContactDirection
from softwarp.solvers.directional import StepDirection
from softwarp.solvers.look_adjoint import FirstSolution
from softwarp.solvers.system import System


class LookStepDirection(StepDirection):
    """Pushes slopes through a step that looks once at contacts where its first solution leads to.

    Where no contact of all worlds has anything of that look, the first solution is left out.
    """

    def __init__(self, system: System, h: float, slopes: Gradients, factors: Gradients, index: AdjointIndex) -> None:
        super().__init__(system, h, slopes, factors, index)
        assert self.direction is not None
        s, m = self.shard, self.model
        self.first, self.contacts = FirstSolution.of(system, h), self.direction.contacts
        self.v, self.row_force = s.rows(3 * m.dof_room), s.rows(max(m.row_count, 1))
        self.contact_force, self.end_slope = s.rows(3 * self.contacts.capacity), s.rows(3 * m.node_count)
        self.direction.u, self.direction.normal = self.first.u, self.first.normal
        self.is_first = False

    def linearise(self) -> None:
        """As of ``StepDirection``."""
        super().linearise()
        w = self.shard.work
        self.v.copy_from(w.dof_v)
        self.row_force.copy_from(w.multiplier)
        self.contact_force.copy_from(self.contacts.multiplier)
        self.first.find_any()

    def push(self) -> None:
        """As of ``StepDirection``."""
        self._bring()
        wp.capture_if(self.first.any, self._along_first)
        self._along()
        self._arrive()

    def _along_first(self) -> None:
        """Slopes of the first solution."""
        assert self.direction is not None
        w = self.shard.work
        self.first.place()
        self._linearise()
        self.is_first = True
        self._along()
        self.is_first = False
        self.direction.u_slope.copy_from(self.p)
        w.dof_v.copy_from(self.v)
        w.multiplier.copy_from(self.row_force)
        self.contacts.multiplier.copy_from(self.contact_force)
        self._linearise()

    def _along_contacts(self, contact: ContactDirection) -> None:
        contact.look = self.first.no_look if self.is_first else self.first.look
        contact.begin(self.shard.work.dof_v)
        contact.along(self.slope["node_x"], self.slope["node_v"])
        if not self.is_first:
            wp.capture_if(self.first.any, lambda: self._along_ends(contact))
        contact.push(self.seed)

    def _along_ends(self, contact: ContactDirection) -> None:
        """What contacts look at where the first solution leads to."""
        s, m, w, x, v = self.shard, self.model, self.shard.work, self.slope["node_x"], self.slope["node_v"]
        inputs = [self.h, m.node_dof, x.real, contact.u_slope.real]
        s.each_real(contact.k_slopes.lead, m.node_count, inputs, [self.end_slope.real])
        w.dof_v.copy_from(self.first.u)
        self.system.peek(self.h)
        w.dof_v.copy_from(self.v)
        contact.along(self.end_slope, v, at_end=True)
        self._start_over()
