"""Joints in the linear system of a shard. Equations: docs/theory/joint.md."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from softwarp.kernels.frames import gyration, momentum
from softwarp.kernels.rows import joint, joint_load, joint_momentum
from softwarp.model.joints import JointModel
from softwarp.solvers.workspace.rows import Rows

if TYPE_CHECKING:
    from softwarp.solvers.system import System
    from softwarp.solvers.terms.frames import FrameSystem


class JointSystem:
    """Workspace and launches for the joints of one shard; their rows follow those of cables and chambers.

    Args:
        system: Owner of the linear system; its frames exist already.
        model: Joints.
    """

    def __init__(self, system: System, model: JointModel) -> None:
        if system.frames is None or system.model.frames is None:
            raise ValueError("joints need frames, and the scene has none")
        self.system, self.model = system, model
        self.frames: FrameSystem = system.frames
        self.master = system.model.frames.frame_master
        self.block = system.model.frames.frame_block
        self.k = joint.kernels(system.variant)
        self.k_load = joint_load.kernels(system.variant)
        self.k_correct = joint_momentum.kernels(system.variant)
        self.k_turn = gyration.kernels(system.variant)
        self.k_state = momentum.kernels(system.variant)
        self.first_row = system.model.cable_count + system.model.cavity_count
        self.first_entry = system.model.entry_start.size - 1
        names = ("travel", "position", "velocity", "force", "reference")
        self.value = {name: system._rows(model.count) for name in names}
        self.reaction, self.multiplier = system._rows(6 * model.count), system._rows(model.rows)
        self.gyrating = int(model.gyrating_frame.size)
        self.difference = system._rows(6 * max(self.gyrating, 1))
        self.speed, self.other_speed, self.gap = (system._rows(model.rows) for _ in range(3))
        self.correction, self.share = system._rows(max(model.unbounded.size, 1)), system._rows(1)
        self.twist, self.pose = system._rows(6 * self.frames.model.count), system._rows(7 * self.frames.model.count)

    @property
    def unbounded(self) -> list[int]:
        """Static rows that are eliminated."""
        return [self.first_row + int(row) for row in self.model.unbounded]

    def load(self) -> None:
        """Multipliers of the last step; flags for commands that are not finite."""
        s, i = self.system, self.system.input
        s.place(i["joint_multiplier"], self.model.rows, s.multiplier, self.first_row)
        self.value["reference"].copy_from(i["joint_reference"])
        for name in ("command_joint_target", "command_joint_force"):
            s.check_finite(i[name].real, self.model.count)

    def measure(self) -> None:
        """Coordinates, gaps and rows at the trial poses."""
        s, m = self.system, self.model
        self._measure_position()
        inputs = [*self._rows(), self.frames.pose.real, self.value["travel"].real]
        s.each_real(self.k.joint_rows, m.rows, inputs, [s.displacement.real, s.row.real])

    def predict(self, h: float) -> None:
        """Gaps at the start of a step that know how points leave their tangents; needs ``measure``."""
        self._predict(self.system.input["twist0"], h, self.speed)

    def correct(self, h: float) -> None:
        """Gaps and gyration at the velocities ``u`` of the last pass of a linear solve."""
        s, m = self.system, self.frames.model
        self._gyrate(h, 2)
        s.each_real(self.k.gather_twist, m.count, [m.frame_dof, s.u.real], [self.twist.real])
        self._predict(self.twist, h, self.other_speed)

    def gyrate(self, h: float, moving: bool) -> None:
        """Free turning on the right-hand side, after ``FrameSystem.right_hand_side``."""
        self._gyrate(h, 1 if moving else 0)

    def release(self, h: float) -> None:
        """Leave in the velocities of the dofs what belongs to momentum, once positions are found."""
        s, r = self.system, self.system.response
        if s.options.newton_iterations == 1 and r is not None and r.unbounded.size:
            self._measure_gap(h)
            inputs = [self.first_row, r.order, h, r.unbounded, self.model.row_kind, r.matrix.S, r.inverse.S]
            inputs += [self.gap.S, self.speed.S]
            s.each_world(self.k_correct.correction, inputs, [self.correction.S, self.share.S])
            inputs = [s.model.dof_count, h, r.unbounded, self.correction.S]
            s.each(self.k_correct.correction_side, s.dof_rows, inputs, [s.linear.y.S])
            s.linear.backward()
            s.each(self.k_correct.take_velocity, s.dof_rows, [s.linear.y.S], [s.dof_v.S])
        inputs = [self.model.gyrating_frame, self.frames.model.frame_dof, self.difference.real]
        s.each_real(self.k_turn.take_gyration, self.gyrating, inputs, [s.dof_v.real])

    def keep_energy(self) -> None:
        """Twists that gain no energy, after ``FrameSystem`` has moved on with momentum."""
        s, f = self.system, self.frames
        inputs = [self.model.gyrating_frame, f.model.frame_dof, f.compound.real, s.input["pose0"].real]
        s.each_real(self.k_turn.keep_energy, self.gyrating, [*inputs, f.pose.real, s.dof_v.real], [f.twist.real])

    def command(self, h: float) -> None:
        """Targets, bounds and compliances of all rows."""
        s, m, i = self.system, self.model, self.system.input
        inputs = [self.first_row, m.row_joint, m.row_kind, m.joint_control, m.joint_scale]
        inputs += [i[f"command_joint_{name}"].real for name in ("target", "force")]
        names = ("stiffness", "damping", "max_force", "max_rate", "min_position", "max_position")
        inputs += [i[f"joint_{name}"].real for name in (*names, "position", "reference")]
        outputs = [s.target.real, s.lower_bound.real, s.upper_bound.real, s.compliance.real]
        outputs += [s.floor.real, s.ceiling.real, self.value["reference"].real]
        s.each_real(self.k.joint_command, m.rows, [*inputs, s.options.recovery_speed, h], outputs)

    def sides(self) -> None:
        """Rows among the right-hand sides."""
        s = self.system
        inputs = [s.model.dof_count, self.first_entry, s.model.entry_dof, s.model.entry_row, s.model.dof_free]
        entries = int(s.model.entry_dof.size) - self.first_entry
        s.each(self.k.joint_sides, entries, [*inputs, s.row.S], [s.linear.y.S])

    def tangent(self) -> None:
        """Add the restoring stiffness of joint forces to A."""
        s, m = self.system, self.model
        self._measure_load()
        inputs = [*self._places(), m.turned_frame, m.turned_start, m.turned_side, self.block]
        inputs += [self.frames.pose.real, self.reaction.real, s.tangent_scale]
        s.each_real(self.k_load.joint_stiffness, int(m.turned_frame.size), inputs, [s.a.real])

    def write(self, h: float) -> None:
        """Coordinates, velocities and forces of good worlds into the state."""
        s, m, v, state = self.system, self.model, self.value, self.system.state
        self._measure_position()
        self._measure_load()
        s.each_real(self.k_load.mean_velocity, m.count, [v["travel"].real, h], [v["velocity"].real])
        self._write(v["velocity"], state.joint_velocity)
        self._write(v["position"], state.joint_position)
        self._write(v["force"], state.joint_force)
        self._write(v["reference"], state.joint_reference)
        self._write(self.reaction, state.joint_reaction)
        self._write(self.multiplier, state.joint_multiplier)

    def refresh(self) -> None:
        """Coordinates of ``measure`` and velocities of the state's twists into the state."""
        s, m, v = self.system, self.model, self.value
        inputs = [*self._places(), m.joint_free, self.frames.pose.real, s.input["twist0"].real]
        s.each_real(self.k_load.twist_velocity, m.count, inputs, [v["velocity"].real])
        self._write(v["position"], s.state.joint_position)
        self._write(v["velocity"], s.state.joint_velocity)

    def _measure_position(self) -> None:
        s, m, v = self.system, self.model, self.value
        inputs = [*self._places(), m.joint_free, s.input["pose0"].real, self.frames.pose.real]
        inputs.append(s.input["joint_position"].real)
        s.each_real(self.k.measure_joint, m.count, inputs, [v["travel"].real, v["position"].real])

    def _measure_gap(self, h: float) -> None:
        s, m = self.system, self.model
        self.twist.zero()
        inputs = [m.gyrating_frame, self.difference.real]
        s.each_real(self.k_turn.spread_difference, self.gyrating, inputs, [self.twist.real])
        inputs = [self.first_row, s.model.row_entry_start, m.row_joint, m.row_kind, m.joint_frame, self.master]
        inputs += [s.displacement.real, s.row.real, self.twist.real, h]
        s.each_real(self.k.whole_gap, m.rows, inputs, [self.gap.real])

    def _predict(self, twist: Rows, h: float, speed: Rows) -> None:
        s, pose0 = self.system, self.system.input["pose0"].real
        inputs = [self.master, pose0, twist.real, h]
        s.each_real(self.k.predict_pose, self.frames.model.count, inputs, [self.pose.real])
        inputs = [*self._rows(), pose0, self.pose.real, twist.real, s.row.real, h]
        s.each_real(self.k.predict_rows, self.model.rows, inputs, [s.displacement.real, speed.real])

    def _gyrate(self, h: float, stage: int) -> None:
        s, i = self.system, self.system.input
        inputs = [self.model.gyrating_frame, self.frames.model.frame_dof, i["pose0"].real, i["twist0"].real]
        inputs += [self.frames.compound.real, s.dof_v.real, s.u.real, h, stage]
        s.each_real(self.k_turn.add_gyration, self.gyrating, inputs, [self.difference.real, s.b.real])

    def _rows(self) -> list[object]:
        s, m = self.system, self.model
        inputs = [self.first_row, s.model.row_entry_start, m.row_joint, m.row_kind, m.row_axis, *self._places()]
        return [*inputs, m.joint_free, m.joint_length, self.master]

    def _places(self) -> list[wp.array]:
        return [self.model.joint_frame, self.model.joint_place]

    def _measure_load(self) -> None:
        s, m = self.system, self.model
        inputs = [self.first_row, s.model.row_entry_start, m.row_kind, m.joint_row_start, m.joint_frame, m.joint_free]
        inputs += [m.joint_scale, m.joint_length, s.row.real, s.multiplier.real, s.target.real, s.lower_bound.real]
        inputs += [s.upper_bound.real, s.compliance.real, s.floor.real, s.ceiling.real, self.value["travel"].real]
        outputs = [self.value["force"].real, self.reaction.real, self.multiplier.real]
        s.each_real(self.k_load.joint_load, m.count, inputs, outputs)

    def _write(self, value: Rows, target: wp.array) -> None:
        s = self.system
        parts = s.variant.parts(target.shape[1])
        s.each_real(self.k_state.commit_state, parts, [s.lanes, s.flag.real, value.real], [target, target])
