"""Contact: detection, laws of pairs, warm start and outputs. Equations: docs/theory/contact.md, collision.md."""

from __future__ import annotations

import numpy as np
import warp as wp

from softwarp.kernels.collision import output
from softwarp.kernels.collision.geometry import DISTANCE, TOUCH_ROWS
from softwarp.kernels.rows import contact_lanes
from softwarp.model.codes import SLOTS
from softwarp.model.contact import ContactModel
from softwarp.solvers.collision.detector import Detector, PairParameters
from softwarp.solvers.subspace import Subspace
from softwarp.solvers.terms.term import Term
from softwarp.solvers.workspace.rows import Rows
from softwarp.solvers.workspace.shard import Shard

LATE = 0.1  # of the smallest alarm distance: how deep an unlisted contact must end to be listed late
MARGIN = 1.5  # of the way that gravity alone adds to a step, h^2 g


class ContactTerm(Term):
    """Detector of one shard and what passes between it, the state and the response.

    Args:
        shard: Worlds.
        model: Objects and pairs.

    Attributes:
        late: Where somebody wants to know, receives the first contact of a look that has the geometry found there;
            int, 1 row.
    """

    responds = True

    def __init__(self, shard: Shard, model: ContactModel) -> None:
        super().__init__(shard)
        self.model = model
        self.detector = Detector(
            shard.variant,
            shard.world_count,
            model.scene,
            model.topology,
            model.capacity,
            shard.device,
            patient=shard.options.newton_iterations == 1 and shard.options.contact_passes > 0,
            steady=shard.options.newton_iterations > 1,
        )
        self.contacts = self.detector.contacts
        self.late: Rows | None = None
        self.k = output.kernels(shard.variant)
        has_modes = shard.model.dof_room > shard.model.dof_count
        self.subspace = Subspace(shard) if has_modes else None
        self.sign = wp.array(model.couple_sign, dtype=wp.int32, device=shard.device)
        i, defaults = shard.input, shard.model.defaults
        if model.scene.choice_count:
            self.detector.choice = i["body_choice"]
        self.pairs = PairParameters(
            mu=i["pair_mu"],
            restitution=i["pair_restitution"],
            distance=i["pair_contact_distance"],
            alarm=i["pair_alarm_distance"],
            compliance=i["pair_compliance"],
        )
        alarm = defaults["pair_alarm_distance"] - defaults["pair_contact_distance"]
        self.late_depth = LATE * float(np.min(alarm, initial=np.inf))
        self.gravity = float(np.linalg.norm(defaults["gravity"]))

    def load(self) -> None:
        """Forces of the last step as a first guess; velocities of dofs at the start of this one."""
        s, w, state = self.shard, self.shard.work, self.shard.state
        self.detector.load(state.contact_count, state.contact_key, state.contact_force)
        nodes, starts = s.model.node_count, [s.input[name].real for name in ("v0", "twist0", "mode_v0")]
        dofs = s.model.dof_count
        inputs = [dofs, nodes, nodes + 2 * s.model.frame_count, s.model.dof_node, *starts]
        s.each_real(self.k.start_velocity, s.variant.parts(dofs), inputs, [w.dof_v0.real])
        if self.subspace is not None:
            self.subspace.expand(w.dof_v0)
        laws = [values.real for values in vars(self.pairs).values()]
        s.each_real(s.k_state.check_pairs, self.model.count, laws, [w.flag.real])

    def find(self, h: float, look: float, *, moving: bool, falling: bool, keeps: bool = False) -> None:
        """Contacts at the trial positions."""
        s = self.shard
        if moving:
            self.detector.remember(notes=keeps, joins=s.options.iterated_passes > 0)
        if s.options.newton_iterations == 1:  # more iterations look again where the bodies have come to
            self.detector.slack = MARGIN * look * look * self.gravity if falling else 0.0
        self.detector.find(s.work.x, s.work.pose, s.input["v0"], s.input["twist0"], look, self.pairs, keeps=keeps)
        if moving:
            self._rebase(h)

    def find_kept(self, h: float, look: float) -> None:
        """Contacts at the trial positions once more, with the forces that the detector knows."""
        s = self.shard
        self.detector.find(s.work.x, s.work.pose, s.input["v0"], s.input["twist0"], look, self.pairs)
        self._rebase(h)

    def look(self, h: float, *, again: bool) -> Rows:
        """Distances less contact distances at the trial positions; what penetrates there unlisted is appended."""
        s, w, c, d = self.shard, self.shard.work, self.contacts, self.detector
        at = s.input["v0"], s.input["twist0"]
        d.call_up((w.x, w.pose), (s.input["x0"], s.input["pose0"]), at, self.pairs)
        d.find_late(w.x, w.pose, *at, self.late_depth, self.pairs, again=again)
        self._rebase(h)
        if self.late is not None:
            self.late.copy_from(c.first)
        c.first.copy_from(d.called)
        inputs = [TOUCH_ROWS, DISTANCE, c.count.real, c.pair.real, self.pairs.distance.real, d.touch.real]
        s.each_real(self.k.end_gap, self.model.capacity, inputs, [w.contact_end.real])
        return w.contact_end

    def _rebase(self, h: float) -> None:
        """Refer gaps of new contacts, found after a step with the present velocities, to its start."""
        s, c = self.shard, self.contacts
        if self.subspace is not None:
            self.subspace.expand(s.work.dof_v)
        inputs = [SLOTS, c.first.real, c.count.real, c.dof.real, c.weight.real, c.lever.real, c.axes.real]
        s.each_real(self.k.rebase_gap, self.model.capacity, [*inputs, s.work.dof_v.real, h], [c.gap.real])

    def write(self) -> None:
        """Memory and outputs of good worlds."""
        s, c, state, d, flag = self.shard, self.contacts, self.shard.state, self.detector, self.shard.work.flag
        d.remember()
        d.store(flag, state.contact_count, state.contact_key, state.contact_force)
        inputs = [flag.real, c.count.real, c.pair.real, d.couple.real]
        inputs += [c.axes.real, c.point.real, c.gap.real, c.multiplier.real]
        outputs = [state.contact_pair, state.contact_point, state.contact_normal, state.contact_load]
        outputs.append(state.contact_gap)
        if s.variant.lanes > 1:
            kernel = contact_lanes.kernels().write_contacts
            wp.launch(kernel, dim=d.packs, inputs=[self.sign, *inputs], outputs=outputs, device=s.device)
        else:
            s.each_real(self.k.write_contacts, self.model.capacity, [self.sign, s.lanes, *inputs], outputs)
        dim = (s.world_count, self.model.count)
        inputs = [state.contact_pair, state.contact_load]
        wp.launch(self.k.sum_pairs, dim=dim, inputs=inputs, outputs=[state.pair_force], device=s.device)
