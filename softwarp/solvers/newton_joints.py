"""Joints in the adjoint of a step that Newton's method has solved: their rows hold where it ends.

Bodies move on with v - D, where D is what free turning adds to their velocities v, found from v - D itself.
Equations: docs/theory/adjoint.md.
"""

from __future__ import annotations

from softwarp.kernels.frames import gyration_adjoint
from softwarp.kernels.rows import end_adjoint, joint_adjoint
from softwarp.solvers.joint_sides import JointSides
from softwarp.solvers.leaning_adjoint import LeaningFrames
from softwarp.solvers.stage_adjoint import StageAdjoint
from softwarp.solvers.terms.joints import JointTerm
from softwarp.solvers.workspace.rows import Rows


class EndJoints(JointSides):
    """Gradients by rows of joints and by free turning, of one system.

    Args:
        owner: Adjoint of the step, of the same system.
        term: Joints.
        frames: Adjoint of its frames.
    """

    def __init__(self, owner: StageAdjoint, term: JointTerm, frames: LeaningFrames) -> None:
        super().__init__(owner.shard, term, frames)
        self.owner, self.leaning_frames, self.h = owner, frames, owner.h
        s, count = self.shard, max(term.model.count, 1)
        self.k, self.k_free = joint_adjoint.kernels(s.variant), gyration_adjoint.kernels(s.variant)
        self.k_end = end_adjoint.kernels(s.variant)
        self.kept_v, self.still = s.rows(s.dof_room), s.rows(s.dof_room)
        twists, rows = 6 * frames.model.count, s.model.row_count
        self.twist, self.p_frame, self.drift, self.bar, self.kept_bar = (s.rows(twists) for _ in range(5))
        self.by_twist, self.place, self.unused, self.none = (s.rows(twists) for _ in range(4))
        self.q, self.softness, self.nothing = (s.rows(rows) for _ in range(3))
        self.spare_share = s.rows(frames.share.real.shape[1])
        self.position, self.at_end, self.at_start = (s.rows(count) for _ in range(3))
        self.side = s.rows(joint_adjoint.SIDES * max(term.model.rows, 1))
        self.mode = s.integers(max(term.model.rows, 1))
        frames.end_v = self.kept_v

    def note_start(self) -> None:
        """Keep the coordinates at the start of the step, which commands count from."""
        self.position.copy_from(self.shard.work.joint_position)

    def find_kept(self, v: Rows) -> None:
        """Velocities that belong to momentum."""
        s, m = self.shard, self.frames.model
        self.kept_v.copy_from(v)
        inputs = [self.term.model.gyrating_frame, m.frame_dof, s.work.gyration.real]
        s.each_real(self.term.k_turn.take_gyration, self.term.gyrating, inputs, [self.kept_v.real])

    def begin(self, seed: Rows) -> None:
        """Add gradients by velocities that belong to momentum to the seed; states of rows."""
        owner, s, m, w = self.owner, self.shard, self.shard.model, self.shard.work
        s.add(self.frames.kept, seed, 3 * m.dof_count)
        self._to_frames(self.frames.kept, self.kept_bar)
        self.softness.copy_from(w.compliance)
        inputs = [self.term.first_row, False, self.h, m.row_entry_start, m.entry_dof, self.is_held]
        inputs += [w.displacement.real, w.row.real, self.still.real, w.target.real, w.lower_bound.real]
        inputs += [w.upper_bound.real, self.softness.real, w.multiplier.real]
        outputs = [owner.active.real, w.compliance.real, self.mode.real]
        s.each_real(self.k.row_states, self.term.model.rows, inputs, outputs)

    def end(self) -> None:
        """Give compliances back."""
        self.shard.work.compliance.copy_from(self.softness)

    def to_motors(self) -> None:
        """Gradients by commands, and by the coordinates that they count from."""
        owner, s, m, i, g = self.owner, self.shard, self.term.model, self.shard.input, self.owner.gradients
        inputs = [self.term.first_row, s.lanes, s.options.recovery_speed, self.h, owner.lapse]
        inputs += [m.joint_row_start, m.row_kind, m.joint_control, m.joint_scale]
        inputs += [i[f"command_joint_{name}"].real for name in ("target", "force")]
        names = ("stiffness", "damping", "max_force", "max_rate", "min_position", "max_position")
        inputs += [i[f"joint_{name}"].real for name in names]
        inputs += [self.position.real, i["joint_reference"].real, s.work.lag.real]
        inputs += [self.mode.real, owner.q.real, owner.bound.real, s.work.multiplier.real]
        outputs = [g.joint_reference, g.command_joint_target, g.command_joint_force]
        outputs += [g.joint_stiffness, g.joint_damping, self.at_start.real]
        s.each_real(self.k.commands, m.count, inputs, outputs)

    def meet(self, there: Rows, sooner: Rows, *, last: bool) -> None:
        """Add gradients by places and turns where the step ends and by the velocities that lead there.

        Args:
            there: Place and turn of frames.
            sooner: Velocities of dofs.
            last: Whether gradients by the start of the step are asked for too; needs ``to_motors``.
        """
        owner, s, w, m = self.owner, self.shard, self.shard.work, self.term.model
        rows = s.model.row_count
        s.each_real(self.k_end.of_joints, rows, [self.term.first_row, owner.q.real], [self.q.real])
        inputs = [s.model.dof_entry_start, s.model.dof_entry, s.model.entry_row, s.model.dof_free, w.row.S, self.q.S]
        s.each(owner.system.rows.k.row_force, s.model.dof_count, [*inputs, self.h], [sooner.S])
        inputs = [self.term.first_row, m.joint_row_start, m.row_kind, m.joint_scale, owner.q.real]
        s.each_real(self.k_end.by_coordinates, m.count, inputs, [self.at_end.real, self.at_start.real])
        self._to_frames(owner.p, self.p_frame)
        self._of_rows(w.pose, self.p_frame, w.multiplier, owner.q, self.at_end, there)
        self.place.zero()
        self._turn(sooner, last=last)
        if last:
            self._of_rows(s.input["pose0"], self.none, self.nothing, self.nothing, self.at_start, self.place)
            s.add(self.place, self.frames.start, 6 * self.frames.model.count)

    def _of_rows(self, pose: Rows, p: Rows, force: Rows, q: Rows, coordinate: Rows, place: Rows) -> None:
        """Add what rows have by places and turns of frames at some pose."""
        s, m, none = self.shard, self.term.model, self.none.real
        inputs = [self.term.first_row, False, False, self.h, m.row_joint, m.row_kind, m.row_axis, self.joint_frame]
        inputs += [self.joint_place, m.joint_free, m.joint_length, pose.real, none, none, none, none]
        inputs += [p.real, force.real, q.real, coordinate.real]
        s.each_real(self.k.rows_adjoint, m.rows, inputs, [self.side.real])
        inputs = [False, False, *self.sides, m.row_kind, self.side.real]
        outputs = [place.real, *(self.unused.real for _ in range(3))]
        s.each_real(self.k.gather, self.frames.model.count, inputs, outputs)

    def _turn(self, sooner: Rows, *, last: bool) -> None:
        """Gradients by free turning; inertia resists velocities without it."""
        owner, s, w, f = self.owner, self.shard, self.shard.work, self.frames.model
        frames, g, count = self.leaning_frames, self.term.model.gyrating_frame, self.term.gyrating
        s.each_real(self.term.k_turn.take_gyration, count, [g, f.frame_dof, w.gyration.real], [frames.felt_v.real])
        self._to_frames(w.dof_v, self.twist)
        self.drift.zero()
        s.each_real(self.term.k_turn.spread_difference, count, [g, w.gyration.real], [self.drift.real])
        self.bar.zero()
        inputs = [g, f.frame_dof, s.input["pose0"].real, w.compound.real, owner.p.real]
        s.each_real(self.k_free.momenta, count, inputs, [self.bar.real])
        s.each_real(self.k_end.subtract, self.bar.real.shape[1], [self.kept_bar.real], [self.bar.real])
        inputs = [self.h, g, s.input["pose0"].real, w.compound.real, self.twist.real, self.drift.real]
        s.each_real(self.k_free.settle, count, inputs, [self.bar.real])
        self.by_twist.zero()
        share = frames.share if last else self.spare_share
        outputs = [self.by_twist.real, self.unused.real, self.place.real, share.real]
        s.each_real(self.k_free.spins, count, [*inputs, self.bar.real], outputs)
        s.each_real(self.k_free.to_dofs, f.count, [f.frame_dof, s.model.dof_free, self.by_twist.real], [sooner.real])
