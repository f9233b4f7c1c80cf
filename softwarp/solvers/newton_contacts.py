"""Contacts in the adjoint of a step that Newton's method has solved: all of them are found where it ends.

Equations: docs/theory/adjoint.md.
"""

from __future__ import annotations

import warp as wp

from softwarp.kernels.rows import end_adjoint
from softwarp.kernels.rows.touch_adjoint import AT_END
from softwarp.kernels.step import stage_adjoint
from softwarp.model.gradients import Gradients
from softwarp.solvers.contact_adjoint import ContactAdjoint
from softwarp.solvers.system import System
from softwarp.solvers.workspace.rows import Rows


class EndContacts(ContactAdjoint):
    """Contacts with geometry and distances of the end of a step, as of ``ContactAdjoint``.

    Gradients by the places of then are told by ``meet``, before those by the start are known, and the others added to
    these by ``to_state``.

    Args:
        system: Worlds, with contacts.
        h: Step [s].
        gradients: Arrays of these worlds.
    """

    def __init__(self, system: System, h: float, gradients: Gradients) -> None:
        super().__init__(system, h, gradients)
        s, g = self.shard, gradients
        self.k_end, self.k_stage = end_adjoint.kernels(s.variant), stage_adjoint.kernels(s.variant)
        self.look.real.fill_(AT_END)
        self.ahead = s.rows(3 * self.contacts.capacity)
        self.by_x, self.by_pose = wp.zeros_like(g.node_x), wp.zeros_like(g.frame_pose)
        self.by_start = [wp.zeros_like(each) for each in (g.node_v, g.frame_twist, g.command_body_velocity)]

    def meet(self, p: Rows, node_bar: Rows, there: Rows | None, sooner: Rows) -> None:
        """Add gradients by places, and by the velocities that have led there.

        Args:
            p: Adjoint of the velocities of dofs.
            node_bar: Of nodes where the step ends.
            there: Place and turn of frames there, if there are any.
            sooner: Velocities of dofs that lead there.
        """
        s, c = self.shard, self.contacts
        self.find_way(p, self.way)
        for part in (self.by_x, self.by_pose, *self.by_start):
            part.zero_()
        moving = self._motion(p)
        self._find_parts(moving, c.axes, 9, at_end=True)
        by_v, by_twist, by_command = self.by_start
        outputs = [self.by_x, by_v, self.gradients.pair_mu, self.by_pose, by_twist, by_command]
        self._gather(moving[0], outputs, at_end=False)
        s.each_real(self.k_end.add_places, self.by_x.shape[1], [s.lanes, self.by_x], [node_bar.real])
        if there is not None:
            inputs = [s.lanes, self.by_pose, s.work.pose.real]
            s.each_real(self.k_end.add_poses, self.by_pose.shape[1] // 7, inputs, [there.real])
        s.each_real(self.k_end.ways, c.capacity, [c.count.real, self.parts.real], [self.ahead.real])
        self.spare.copy_from(c.multiplier)
        c.multiplier.copy_from(self.ahead)
        self.laws.add_forces(sooner, self.h)
        c.multiplier.copy_from(self.spare)

    def to_state(self, p: Rows) -> None:
        """Add the gradients by velocities of the start, and by those of kinematic bodies; needs ``meet``."""
        g = self.gradients
        for part, total in zip(self.by_start, (g.node_v, g.frame_twist, g.command_body_velocity), strict=True):
            if part.size:
                wp.launch(self.k_stage.add, dim=part.shape, inputs=[part], outputs=[total], device=self.shard.device)
