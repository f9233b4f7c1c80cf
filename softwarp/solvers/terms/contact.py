"""Contact in the linear system of a shard: detection, laws of pairs, warm start and outputs."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from softwarp.kernels.collision import output
from softwarp.kernels.collision.geometry import DISTANCE, TOUCH_ROWS
from softwarp.model.codes import SLOTS
from softwarp.model.contact import ContactModel
from softwarp.solvers.collision.detector import Detector, PairParameters

if TYPE_CHECKING:
    from softwarp.solvers.system import System

LATE = 0.1  # of the smallest alarm distance: how deep an unlisted contact must end to be listed late
MARGIN = 1.5  # of the way that gravity alone adds to a step, h^2 g


class ContactSystem:
    """Detector of one shard and what passes between it, the state and the response.

    Args:
        system: Owner of the linear system.
        model: Objects and pairs.
    """

    def __init__(self, system: System, model: ContactModel) -> None:
        self.system, self.model = system, model
        self.detector = Detector(
            system.variant, system.world_count, model.scene, model.topology, model.capacity, system.device
        )
        self.contacts = self.detector.contacts
        self.k = output.kernels(system.variant)
        self.sign = wp.array(model.couple_sign, dtype=wp.int32, device=system.device)
        i = system.input
        self.pairs = PairParameters(
            mu=i["pair_mu"],
            restitution=i["pair_restitution"],
            distance=i["pair_contact_distance"],
            alarm=i["pair_alarm_distance"],
            compliance=i["pair_compliance"],
        )
        self.nothing = system._rows(1)
        self.end = system._rows(model.capacity)  # distances less contact distances at the trial positions
        alarm = system.model.defaults["pair_alarm_distance"] - system.model.defaults["pair_contact_distance"]
        self.late_depth = LATE * float(np.min(alarm, initial=np.inf))
        self.gravity = float(np.linalg.norm(system.model.defaults["gravity"]))

    def load(self) -> None:
        """Forces of the last step as a first guess; velocities of dofs at the start of this one."""
        s, state = self.system, self.system.state
        self.detector.load(state.contact_count, state.contact_key, state.contact_force)
        inputs = [s.model.node_count, s.model.dof_node, s.input["v0"].real, s.input["twist0"].real]
        s.each_real(self.k.start_velocity, s.model.dof_count, inputs, [s.dof_v0.real])

    def find(self, h: float, moving: bool, falling: bool = True) -> None:
        """Contacts at the trial positions.

        Args:
            h: Time in which bodies come nearer with their velocities [s].
            moving: Refer gaps to the start of the step.
            falling: Let gravity bring them nearer as well.
        """
        s = self.system
        pose = self.nothing if s.frames is None else s.frames.pose
        if moving:
            self.detector.remember()
        if s.options.newton_iterations == 1:  # more iterations look again where the bodies have come to
            self.detector.slack = MARGIN * h * h * self.gravity if falling else 0.0
        self.detector.find(s.x, pose, s.input["v0"], s.input["twist0"], h, self.pairs)
        if moving:
            self._rebase(h)

    def look(self, h: float, *, again: bool) -> None:
        """Distances of contacts at the trial positions, into ``end``; what penetrates there unlisted is appended."""
        s, c, d = self.system, self.contacts, self.detector
        pose = self.nothing if s.frames is None else s.frames.pose
        d.find_late(s.x, pose, s.input["v0"], s.input["twist0"], self.late_depth, self.pairs, again=again)
        self._rebase(h)
        inputs = [TOUCH_ROWS, DISTANCE, c.count.real, c.pair.real, self.pairs.distance.real, d.touch.real]
        s.each_real(self.k.end_gap, self.model.capacity, inputs, [self.end.real])

    def _rebase(self, h: float) -> None:
        """Refer gaps of new contacts, found after a step with the present velocities, to its start."""
        s, c = self.system, self.contacts
        inputs = [SLOTS, c.first.real, c.count.real, c.dof.real, c.weight.real, c.lever.real, c.axes.real]
        s.each_real(self.k.rebase_gap, self.model.capacity, [*inputs, s.dof_v.real, h], [c.gap.real])

    def write(self) -> None:
        """Memory and outputs of good worlds into the state."""
        s, c, state, d = self.system, self.contacts, self.system.state, self.detector
        d.remember()
        d.store(s.flag, state.contact_count, state.contact_key, state.contact_force)
        inputs = [self.sign, s.lanes, s.flag.real, c.count.real, c.pair.real, d.couple.real]
        inputs += [c.axes.real, c.point.real, c.gap.real, c.multiplier.real]
        outputs = [state.contact_pair, state.contact_point, state.contact_normal, state.contact_load]
        s.each_real(self.k.write_contacts, self.model.capacity, inputs, [*outputs, state.contact_gap])
        dim = (s.world_count, self.model.count)
        inputs = [state.contact_pair, state.contact_load]
        wp.launch(self.k.sum_pairs, dim=dim, inputs=inputs, outputs=[state.pair_force], device=s.device)
