"""The adjoint of a stage of BDF2, which is linearised where its start velocities lead to.

Theory: docs/theory/adjoint.md.
"""

from __future__ import annotations

from collections.abc import Callable

from softwarp.kernels.step import stage_adjoint
from softwarp.model.gradients import Gradients
from softwarp.solvers.adjoint import StepAdjoint
from softwarp.solvers.adjoint_index import AdjointIndex
from softwarp.solvers.contact_adjoint import ContactAdjoint
from softwarp.solvers.leaning_adjoint import LeaningFrames
from softwarp.solvers.mode_adjoint import StageModes
from softwarp.solvers.system import System
from softwarp.solvers.terms.term import Pace
from softwarp.solvers.workspace.rows import Rows


class StartContacts(ContactAdjoint):
    """Contacts as they are at the start of a stage that is linearised elsewhere.

    Attributes:
        solved_v: Velocities of dofs as the stage has found them.
    """

    solved_v: Rows

    def begin(self, v: Rows, *, first: bool = True) -> None:
        """As of ``ContactAdjoint``, with these velocities."""
        super().begin(self.solved_v, first=first)
        if self.subspace is not None:  # nodes of modes have theirs by now
            v.copy_from(self.solved_v)

    def to_state(self, p: Rows) -> None:
        """As of ``ContactAdjoint``; everything is at the start of the stage afterwards."""
        self.shard.work.x.copy_from(self.shard.input["x0"])
        for term in self.system.terms:
            term.start_over()
        super().to_state(p)


class StageAdjoint(StepAdjoint):
    """Pulls gradients by the end of a stage back to its start.

    The unknown rotation of a frame comes on top of the one that its start velocities lead to, about which the stage is
    linearised; what it moves on with is found from that. So there are velocities as solved, and final ones.

    Args:
        system: Worlds; of its state, commands and parameters those that the stage started from.
        h: Length of the stage [s].
        pace: What it does of the commands.
        predict: Writes the velocities that it is linearised with.
        gradients: Arrays of these worlds, read and written.
        index: Of the model.
        judge: Called once contacts are known.
        heed: Writes 1 where velocities that the stage is linearised with may not be 0, else 0; without, 1 is there.
        rest: Whether gradients by the rest shape are asked for.

    Attributes:
        follows: 1 if it is linearised with the velocities of its start, else 0.
        ahead: Gradients by the velocities of dofs that it is linearised with.
    """

    predicts = True
    touches: type[ContactAdjoint] = StartContacts
    follows = 1.0
    keeps = False  # contacts of the iterates that have led here

    def __init__(
        self,
        system: System,
        h: float,
        pace: Pace,
        predict: Callable[[], None],
        gradients: Gradients,
        index: AdjointIndex,
        judge: Callable[[], None] | None = None,
        heed: Callable[[Rows], None] | None = None,
        *,
        rest: bool = False,
    ) -> None:
        super().__init__(system, h, gradients, index, rest=rest)
        assert self.leaning is not None
        self.start_v = self.leaning.start_v
        self.look, self.predict, self.judge, self.heed = pace.look, predict, judge, heed
        self.pace = pace
        s = self.shard
        self.k_stage = stage_adjoint.kernels(s.variant)
        self.lapse, self.is_stage = pace.lapse, True
        self.solved_v, self.final_v = s.rows(s.dof_room), s.rows(s.dof_room)
        self.ahead, self.heeds, self.other_seed = s.rows(s.dof_rows), s.rows(1), s.rows(s.dof_rows)
        self.heeds.real.fill_(1.0)
        if isinstance(self.contact, StartContacts):
            self.contact.solved_v = self.solved_v
        if isinstance(self.frames, LeaningFrames):
            self.frames.heeds = self.heeds
            self.frames.end_v, self.frames.ahead, self.frames.follows = self.final_v, self.ahead, self.follows
        self.displacement = s.rows(s.work.displacement.real.shape[1])
        self.volume = s.rows(s.work.cavity_volume.real.shape[1])
        self.start_gradient = s.rows(s.work.point_gradient.real.shape[1])
        self.start_point = s.rows(s.work.point_gradient.real.shape[1])
        self.stage_modes = None
        if self.modes is not None:
            self.stage_modes = StageModes(self.modes, self.k_stage)
            self.leaning.more_products = self.stage_modes.add_products

    def prepare(self, *, without: tuple[str, ...] = ()) -> None:
        """All that ``pull`` needs of the stage but its solution."""
        system, h, w = self.system, self.h, self.shard.work
        system.load(without=without)
        system.scale(h)
        system.measure_rows()
        if self.model.row_count:
            self.displacement.copy_from(w.displacement)
            self.volume.copy_from(w.cavity_volume)
            self.start_gradient.copy_from(w.point_gradient)
        system.command(h, self.pace)
        self._note_start()
        if isinstance(self.contact, StartContacts):
            system.find_contacts(h, moving=False, look=self.look)
        if self.judge is not None:
            self.judge()
        if self.heed is not None:
            self.heed(self.heeds)
        if self.leaning is not None:
            self.leaning.load()
        self.predict()
        self.start_v.copy_from(w.dof_v)
        system.move(h)
        if isinstance(self.frames, LeaningFrames):
            self.frames.place()
        system.measure_rows()
        system.row_laws()
        if self.contact is not None and not isinstance(self.contact, StartContacts):
            system.find_contacts(h, moving=True, look=self.look, keeps=self.keeps)

    def solve_again(self) -> None:
        """Take the stage as far as its solution, from the system's state; the state stays as it is."""
        system, h = self.system, self.h
        self.prepare()
        self._find_forces()
        system.tangent()
        system.right_hand_side(h, inertia=True, moving=True)
        system.solve(h, h)
        self.solved_v.copy_from(self.start_v)
        self.shard.add(self.shard.work.u, self.solved_v, self.shard.dof_rows)
        system.rotation_step(h)
        system.add_unknowns()
        self.final_v.copy_from(self.shard.work.dof_v)

    def _seed(self, *, first: bool = True) -> None:
        super()._seed(first=first)
        if isinstance(self.frames, LeaningFrames):
            self.frames.early.zero()
            if first:  # what looks ahead turns by velocities as they are solved
                self.frames.turn_seed(self.seed, self.system.linear.y, self.solved_v)
            self.shard.work.dof_v.copy_from(self.solved_v)

    def _to_state(self) -> None:
        s, m, i, w, g, x = self.shard, self.model, self.shard.input, self.shard.work, self.gradients, self.index
        assert self.leaning is not None
        if m.row_count:
            inputs = [x.point_row, self.start_gradient.real, self.start.real]
            s.each_real(self.k_stage.start_points, len(m.point_node), inputs, [self.start_point.real])
            if self.frames is not None:
                f = self.frames
                inputs = [m.node_count, f.item_start, f.item, f.model.carried_slot, f.model.carried_offset]
                inputs += [x.node_point_start, x.node_point, x.node_point_weight, i["pose0"].real]
                outputs = [f.start.real, f.offset.real]
                s.each_real(self.k_stage.start_frames, f.model.count, [*inputs, self.start_point.real], outputs)
        inputs = [m.corner_start, m.corner, x.node_point_start, x.node_point, x.node_point_weight]
        inputs += [self.corner.S, self.point.S]
        s.each(self.k.node_sums, s.variant.parts(m.node_count), inputs, [self.node_bar.S])
        seed = self._meet()
        inputs = [self.h, self.follows, s.lanes, m.node_dof, m.node_body, m.dof_free]
        inputs += [x.node_point_start, x.node_point, x.node_point_weight]
        inputs += [
            self.heeds.real,
            i["density"].real,
            s.felt["beta"].real,
            w.body_mass.real,
            seed.real,
            self.leaning.pushed.real,
        ]
        inputs += [self.node_p.real, self.node_mass_p.real, self.node_bar.real, self.start_point.real]
        outputs = [g.node_x, g.node_v, g.command_node_force, self.ahead.real]
        s.each_real(self.k_stage.nodes, m.node_count, inputs, outputs)
        if self.stage_modes is not None:
            scalars = (self.h, self.follows)
            self.stage_modes.to_state(*scalars, self.heeds, seed, self.leaning.pushed, self.node_bar, self.ahead)
        self._to_tractions()

    def _feel(self) -> None:
        super()._feel()
        if self.stage_modes is not None and self.leaning is not None:
            self.stage_modes.velocities(self.leaning, self.node_v)

    def _note_start(self) -> None:
        """Keep what is measured at the start of the stage, before it is where its velocities lead to."""

    def _meet(self) -> Rows:
        """Add what others have where the stage is linearised, and tell the seed less what they have as solved."""
        if self.contact is None:
            return self.seed
        self.other_seed.copy_from(self.seed)
        self.contact.add_forces(self.other_seed)
        return self.other_seed
