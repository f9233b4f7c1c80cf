"""Joints: rows between frames. Equations: docs/theory/joint.md."""

from __future__ import annotations

import warp as wp

from softwarp.kernels.frames import gyration, momentum
from softwarp.kernels.rows import joint, joint_load, joint_momentum
from softwarp.model.frames import FrameModel
from softwarp.model.joints import JointModel
from softwarp.solvers.linear.cholesky import LinearSolver
from softwarp.solvers.response import ContactResponse
from softwarp.solvers.terms.term import Pace, Term, load_factor
from softwarp.solvers.workspace.rows import Rows
from softwarp.solvers.workspace.shard import Shard


class JointTerm(Term):
    """Joints of one shard; their rows follow those of cables and chambers.

    Args:
        shard: Worlds.
        model: Joints.
        frames: Frames, whose term comes before.
    """

    refreshes = True
    responds = True
    stiffens = True  # whether A may have the restoring stiffness of joint forces

    def __init__(self, shard: Shard, model: JointModel, frames: FrameModel) -> None:
        super().__init__(shard)
        self.model, self.frames = model, frames
        self.k = joint.kernels(shard.variant)
        self.k_load = joint_load.kernels(shard.variant)
        self.k_correct = joint_momentum.kernels(shard.variant)
        self.k_turn = gyration.kernels(shard.variant)
        self.k_state = momentum.kernels(shard.variant)
        self.first_row = shard.model.first_row("joint row")
        self.first_entry = shard.model.entry_start.size - 1
        self.gyrating = int(model.gyrating_frame.size)
        self.is_linearised = shard.options.newton_iterations == 1
        self.corrections = int(self.is_linearised)

    @property
    def unbounded(self) -> list[int]:
        """Rows of joints without motors and limits."""
        return [self.first_row + int(row) for row in self.model.unbounded]

    def load(self) -> None:
        """Multipliers of the last step; flags for commands that are not finite."""
        s, i, w = self.shard, self.shard.input, self.shard.work
        s.place(i["joint_multiplier"], self.model.rows, w.multiplier, self.first_row)
        w.joint_reference.copy_from(i["joint_reference"])
        for name in ("command_joint_target", "command_joint_force"):
            s.check_finite(i[name], self.model.count)

    def measure(self) -> None:
        """Coordinates, gaps and rows at the trial poses."""
        s, m, w = self.shard, self.model, self.shard.work
        self._measure_position()
        inputs = [*self._rows(), w.pose.real, w.joint_travel.real]
        s.each_real(self.k.joint_rows, m.rows, inputs, [w.displacement.real, w.row.real])

    def command(self, h: float, pace: Pace) -> None:
        """Targets, bounds and compliances of all rows; needs ``measure`` at the start.

        That measures where an extrapolation has led between two stages, too.
        """
        s, m, i, w = self.shard, self.model, self.shard.input, self.shard.work
        inputs = [self.first_row, m.row_joint, m.row_kind, m.joint_control, m.joint_scale]
        inputs += [i[f"command_joint_{name}"].real for name in ("target", "force")]
        names = ("stiffness", "damping", "max_force", "max_rate", "min_position", "max_position")
        inputs += [i[f"joint_{name}"].real for name in names]
        inputs += [w.joint_position.real, i["joint_reference"].real]
        outputs = [w.target.real, w.lower_bound.real, w.upper_bound.real, w.compliance.real]
        outputs += [w.floor.real, w.ceiling.real, w.joint_reference.real]
        inputs += [w.lag.real, s.options.recovery_speed, h, pace.lapse]
        s.each_real(self.k.joint_command, m.rows, inputs, outputs)

    def predict(self, h: float) -> None:
        """Gaps at the start of a step that know how points leave their tangents; needs ``measure``."""
        self._predict(self.shard.input["twist0"], h, self.shard.work.joint_speed)

    def right_hand_side(self, f_scale: float, inertia: bool, moving: bool) -> None:
        """Free turning of jointed bodies, after the rows of frames."""
        self._gyrate(f_scale, 1 if moving else 0)

    def load_tangent(self, h: float) -> None:
        """Restoring stiffness of joint forces in Newton iterations, where chambers have theirs.

        A single linearisation would take it for inertia, as nothing but A has it.
        """
        if self.is_linearised or not (self.stiffens and self.shard.options.pressure_tangent):
            return
        s, m, w = self.shard, self.model, self.shard.work
        self._measure_load()
        inputs = [*self._places(), m.turned_frame, m.turned_start, m.turned_side, self.frames.frame_block]
        inputs += [w.pose.real, w.joint_reaction.real, load_factor(h)]
        s.each_real(self.k_load.joint_stiffness, int(m.turned_frame.size), inputs, [w.a.real])

    def sides(self, y: Rows) -> None:
        """Rows among the right-hand sides."""
        s = self.shard
        inputs = [s.model.dof_count, self.first_entry, s.model.entry_dof, s.model.entry_row, s.model.dof_free]
        entries = int(s.model.entry_dof.size) - self.first_entry
        s.each(self.k.joint_sides, entries, [*inputs, s.work.row.S], [y.S])

    def correct(self, h: float) -> None:
        """Gaps and gyration at the velocities ``u`` of the last pass of a linear solve."""
        if not self.is_linearised:
            return
        s, w = self.shard, self.shard.work
        self._gyrate(h, 2)
        s.each_real(self.k.gather_twist, self.frames.count, [self.frames.frame_dof, w.u.real], [w.joint_twist.real])
        self._predict(w.joint_twist, h, w.joint_other_speed)

    def release(self, h: float, linear: LinearSolver, response: ContactResponse | None) -> None:
        """Leave in the velocities of the dofs what belongs to momentum, once positions are found."""
        s, w = self.shard, self.shard.work
        if self.is_linearised and response is not None and response.unbounded.size:
            self._measure_gap(h)
            inputs = [self.first_row, response.order, h, response.unbounded, self.model.row_kind]
            inputs += [response.matrix.S, response.inverse.S, w.joint_gap.S, w.joint_speed.S]
            s.each_world(self.k_correct.correction, inputs, [w.joint_correction.S, w.joint_share.S])
            inputs = [s.model.dof_count, h, response.unbounded, w.joint_correction.S]
            s.each(self.k_correct.correction_side, s.dof_rows, inputs, [linear.y.S])
            linear.backward()
            s.each(self.k_correct.take_velocity, s.dof_rows, [linear.y.S], [w.dof_v.S])
        inputs = [self.model.gyrating_frame, self.frames.frame_dof, w.gyration.real]
        s.each_real(self.k_turn.take_gyration, self.gyrating, inputs, [w.dof_v.real])

    def commit(self, h: float) -> None:
        """Twists that gain no energy, after frames have moved on with momentum."""
        s, w = self.shard, self.shard.work
        inputs = [self.model.gyrating_frame, self.frames.frame_dof, w.compound.real, s.input["pose0"].real]
        s.each_real(self.k_turn.keep_energy, self.gyrating, [*inputs, w.pose.real, w.dof_v.real], [w.twist.real])

    def check(self, h: float) -> None:
        """Coordinates, velocities and forces at the end of the step."""
        s, w = self.shard, self.shard.work
        self._measure_position()
        self._measure_load()
        s.each_real(self.k_load.mean_velocity, self.model.count, [w.joint_travel.real, h], [w.joint_velocity.real])

    def write(self) -> None:
        """Coordinates, velocities and forces of good worlds."""
        w, state = self.shard.work, self.shard.state
        self._write(w.joint_velocity, state.joint_velocity)
        self._write(w.joint_position, state.joint_position)
        self._write(w.joint_force, state.joint_force)
        self._write(w.joint_reference, state.joint_reference)
        self._write(w.joint_reaction, state.joint_reaction)
        self._write(w.joint_multiplier, state.joint_multiplier)

    def refresh(self) -> None:
        """Coordinates of ``measure`` and velocities of the state's twists, after those of frames."""
        s, m, w = self.shard, self.model, self.shard.work
        inputs = [*self._places(), m.joint_free, w.pose.real, s.input["twist0"].real]
        s.each_real(self.k_load.twist_velocity, m.count, inputs, [w.joint_velocity.real])
        self._write(w.joint_position, s.state.joint_position)
        self._write(w.joint_velocity, s.state.joint_velocity)

    def _measure_position(self) -> None:
        s, m, w = self.shard, self.model, self.shard.work
        inputs = [*self._places(), m.joint_free, s.input["pose0"].real, w.pose.real]
        inputs.append(s.input["joint_position"].real)
        s.each_real(self.k.measure_joint, m.count, inputs, [w.joint_travel.real, w.joint_position.real])

    def _measure_gap(self, h: float) -> None:
        s, m, w = self.shard, self.model, self.shard.work
        w.joint_twist.zero()
        inputs = [m.gyrating_frame, w.gyration.real]
        s.each_real(self.k_turn.spread_difference, self.gyrating, inputs, [w.joint_twist.real])
        inputs = [self.first_row, s.model.row_entry_start, m.row_joint, m.row_kind, m.joint_frame]
        inputs += [self.frames.frame_master, w.displacement.real, w.row.real, w.joint_twist.real, h]
        s.each_real(self.k.whole_gap, m.rows, inputs, [w.joint_gap.real])

    def _predict(self, twist: Rows, h: float, speed: Rows) -> None:
        s, w, pose0 = self.shard, self.shard.work, self.shard.input["pose0"].real
        inputs = [self.frames.frame_master, pose0, twist.real, h]
        s.each_real(self.k.predict_pose, self.frames.count, inputs, [w.joint_pose.real])
        inputs = [*self._rows(), pose0, w.joint_pose.real, twist.real, w.row.real, h]
        s.each_real(self.k.predict_rows, self.model.rows, inputs, [w.displacement.real, speed.real])

    def _gyrate(self, h: float, stage: int) -> None:
        s, i, w = self.shard, self.shard.input, self.shard.work
        inputs = [self.model.gyrating_frame, self.frames.frame_dof, i["pose0"].real, i["twist0"].real]
        inputs += [w.compound.real, w.dof_v.real, w.u.real, h, stage]
        s.each_real(self.k_turn.add_gyration, self.gyrating, inputs, [w.gyration.real, w.b.real])

    def _rows(self) -> list[object]:
        s, m = self.shard, self.model
        inputs = [self.first_row, s.model.row_entry_start, m.row_joint, m.row_kind, m.row_axis, *self._places()]
        return [*inputs, m.joint_free, m.joint_length, self.frames.frame_master]

    def _places(self) -> list[wp.array]:
        return [self.model.joint_frame, self.model.joint_place]

    def _measure_load(self) -> None:
        s, m, w = self.shard, self.model, self.shard.work
        inputs = [self.first_row, s.model.row_entry_start, m.row_kind, m.joint_row_start, m.joint_frame, m.joint_free]
        inputs += [m.joint_scale, m.joint_length, w.row.real, w.multiplier.real, w.target.real, w.lower_bound.real]
        inputs += [w.upper_bound.real, w.compliance.real, w.floor.real, w.ceiling.real, w.joint_travel.real]
        outputs = [w.joint_force.real, w.joint_reaction.real, w.joint_multiplier.real]
        s.each_real(self.k_load.joint_load, m.count, inputs, outputs)

    def _write(self, value: Rows, target: wp.array) -> None:
        s = self.shard
        inputs = [s.lanes, s.work.flag.real, value.real]
        s.each_real(self.k_state.commit_state, s.variant.parts(target.shape[1]), inputs, [target, target])
