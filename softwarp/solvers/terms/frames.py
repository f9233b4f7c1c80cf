"""Frames: rigid bodies and rod nodes, what they carry and what is prescribed. Equations: docs/theory/frames.md."""

from __future__ import annotations

from typing import Any

import warp as wp

from softwarp.kernels.elements import assembly, norms
from softwarp.kernels.frames import inertia as frame_inertia
from softwarp.kernels.frames import momentum, motion, prescribed
from softwarp.model.frames import FrameModel
from softwarp.model.resolution import resolved_sizes
from softwarp.solvers.terms.term import Pace, Term
from softwarp.solvers.workspace.shard import Shard


class FrameTerm(Term):
    """Frames of one shard.

    Args:
        shard: Worlds.
        model: Frames.
    """

    refreshes = True

    def __init__(self, shard: Shard, model: FrameModel) -> None:
        super().__init__(shard)
        self.model = model
        variant = shard.variant
        self.k = motion.kernels(variant)
        self.k_inertia = frame_inertia.kernels(variant)
        self.k_assembly = assembly.kernels(variant)
        self.k_command = prescribed.command_kernels(variant)
        self.k_state = momentum.kernels(variant)

    def load(self) -> None:
        """Poses, twists and what they carry at the start of the step."""
        s, i, w = self.shard, self.shard.input, self.shard.work
        if self.model.rigid_count:
            w.held_pose.copy_from(i["held_pose"])
            w.seen_pose.copy_from(i["seen_pose"])
            s.place(i["body_mass"], self.model.rigid_count, w.owner_density, 0)
        for name in ("command_frame_force", "command_body_pose", "command_body_velocity"):
            s.check_finite(i[name], i[name].real.shape[1])
        self.start_over()

    def start_over(self) -> None:
        """Poses and twists of the start of the step, and what frames carry there."""
        i, w = self.shard.input, self.shard.work
        w.pose.copy_from(i["pose0"])
        w.twist.copy_from(i["twist0"])
        self._carry()

    def scale(self, h: float) -> None:
        """Matrix factors of rigid bodies, after those of rods; inertia of all masters."""
        s, i, w, m = self.shard, self.shard.input, self.shard.work, self.model
        if s.model.telescopes is not None:  # their nodes have slid
            self._carry()
        first = s.model.body_count + m.rod_count
        inputs = [first, i["body_damping"].S, i["body_damping"].S, h]
        outputs = [w.body_mass.S, w.body_stiffness.S, w.body_damping.S]
        s.each(self.k_assembly.damping_scales, m.rigid_count, inputs, outputs)
        inputs = [m.source_start, m.source, m.source_lever, m.source_inertia, m.frame_owner, m.frame_volume]
        inputs += [m.owner_body, s.model.node_body, s.model.node_volume]
        inputs += [i["density"].S, w.owner_density.S, w.body_mass.S]
        s.each(self.k_inertia.compound, m.count, inputs, [w.compound.S])

    def command(self, h: float, pace: Pace) -> None:
        """Velocities of prescribed scalars."""
        s, i, w, m = self.shard, self.shard.input, self.shard.work, self.model
        inputs = [m.kinematic_frame, m.frame_dof, i["pose0"].real, i["seen_pose"].real]
        inputs += [i["command_body_pose"].real, i["command_body_velocity"].real]
        inputs += [i["body_max_speed"].real, i["body_max_spin"].real, w.lag.real, h, pace.ahead]
        outputs = [w.held_pose.real, w.seen_pose.real, w.prescribed_v.real]
        s.each_real(self.k_command.kinematic_command, m.kinematic_frame.size, inputs, outputs)
        if m.kinematic_frame.size:
            inputs = [m.kinematic_frame, m.frame_dof, s.model.extent, w.prescribed_v.real, h]
            s.each_real(self.k_command.commanded_way, None, inputs, [w.commanded.real])

    def forces(self) -> None:
        """Internal and external force and moment of every frame; needs those of segments."""
        s, i, w, m = self.shard, self.shard.input, self.shard.work, self.model
        inputs = [m.frame_owner, m.frame_volume, m.corner_start, m.corner]
        inputs += [w.owner_density.S, i["gravity"].S, i["command_frame_force"].S, w.segment_force.S]
        s.each(self.k_inertia.frame_forces, m.count, inputs, [w.frame_internal.S, w.frame_external.S])

    def tangent(self, h: float) -> None:
        """Inertia of masters."""
        s, w, m = self.shard, self.shard.work, self.model
        inputs = [m.frame_block, m.frame_master, w.compound.S, s.input["pose0"].S]
        s.each(self.k_inertia.frame_mass, m.count, inputs, [w.a.S])

    def slot_velocities(self) -> None:
        """Velocities of nodes and frames, those that frames carry among them."""
        s, w, m = self.shard, self.shard.work, self.model
        inputs = [m.slot_dof, m.slot_carried, m.carried_dof, s.felt["dof_v"].S, w.lever.S]
        s.each(self.k.slot_velocity, m.slot_dof.size, inputs, [w.slot_v.S])

    def right_hand_side(self, f_scale: float, inertia: bool, moving: bool) -> None:
        """Rows of b that belong to frames, from the forces of nodes and of their own."""
        s, w, m = self.shard, self.shard.work, self.model
        inputs = [m.frame_dof, m.frame_spin, m.source_start, m.source, m.source_lever, w.compound.S]
        inputs += [w.node_internal.S, w.node_external.S, w.frame_internal.S, w.frame_external.S, w.lever.S]
        inputs += [s.input["pose0"].S, s.felt["twist0"].S, s.felt["dof_v"].S, f_scale, 1.0 if inertia else 0.0]
        inputs.append(moving or s.leaning)
        s.each(self.k_inertia.frame_right_hand_side, m.count, inputs, [w.frame_momentum.S, w.b.S])

    def rotation_step(self, x_scale: float) -> None:
        """Make rotations in ``u`` changes of angular velocity at the present velocities."""
        s, w, m = self.shard, self.shard.work, self.model
        inputs = [m.turning_frame, m.frame_dof, w.dof_v.S, x_scale]
        s.each(self.k.rotation_step, m.turning_frame.size, inputs, [w.u.S])

    def norms(self, f_scale: float) -> None:
        """Add the size of what should balance at frames."""
        s, w, m = self.shard, self.shard.work, self.model
        inputs = [m.count, len(m.segment_frames), w.frame_external.S, w.frame_momentum.S, w.segment_force.S, f_scale]
        if s.variant.world_fastest:
            k = norms.kernels(s.variant)
            s.each(k.frame_squares, norms.PARTS, inputs, [w.norm_part.S])
            s.each_world(k.frame_norms, [w.norm_part.S], [w.norm.S])
        else:
            s.each_world(self.k_inertia.frame_norms, inputs, [w.norm.S])

    def move(self, x_scale: float) -> None:
        """Trial poses, levers and carried nodes."""
        s, w, m = self.shard, self.shard.work, self.model
        inputs = [m.frame_master, m.frame_dof, s.input["pose0"].S, w.dof_v.S, x_scale]
        s.each(self.k.trial_pose, m.count, inputs, [w.pose.S])
        self._carry()

    def commit(self, h: float) -> None:
        """Twists of masters at the end of the step."""
        s, w, m = self.shard, self.shard.work, self.model
        inputs = [m.frame_spin, m.frame_dof, s.model.dof_free, s.input["pose0"].real, w.dof_v.real]
        inputs += [w.compound.real, h]
        s.each_real(self.k_state.move_on, m.count, inputs, [w.pose.real, w.twist.real])

    def check(self, h: float) -> None:
        """What masters carry; flags for frames that went too far."""
        s, w, m = self.shard, self.shard.work, self.model
        self._carry()
        reach = s.options.reach * s.model.extent
        inputs = [m.frame_size, s.input["pose0"].real, w.pose.real, w.twist.real, w.commanded.real, reach]
        inputs.append(resolved_sizes(s.model.precision))
        s.each_real(self.k_state.check_frames, m.count, inputs, [w.flag.real])

    def write(self) -> None:
        """Poses and twists of good worlds, and what they carry."""
        s, w, state = self.shard, self.shard.work, self.shard.state
        pairs: list[tuple[Any, wp.array, wp.array]] = [
            (w.pose, state.frame_pose, state.good_pose),
            (w.twist, state.frame_twist, state.good_twist),
        ]
        if self.model.rigid_count:
            pairs += [(w.held_pose, state.held_pose, state.held_pose)]
            pairs += [(w.seen_pose, state.seen_pose, state.seen_pose)]
        for value, target, good in pairs:
            parts = s.variant.parts(target.shape[1])
            s.each_real(self.k_state.commit_state, parts, [s.lanes, w.flag.real, value.real], [target, good])
        self._write_carried(state.good_x, state.good_v)

    def refresh(self) -> None:
        """What frames carry, where poses and twists were written by hand."""
        s, w, state = self.shard, self.shard.work, self.shard.state
        for value, target in ((w.pose, state.frame_pose), (w.twist, state.frame_twist)):
            parts = s.variant.parts(target.shape[1])
            s.each_real(self.k_state.commit_state, parts, [s.lanes, w.flag.real, value.real], [target, target])
        self._write_carried(state.node_x, state.node_v)

    def _write_carried(self, good_x: wp.array, good_v: wp.array) -> None:
        s, w, m, state = self.shard, self.shard.work, self.model, self.shard.state
        inputs = [s.model.node_count, m.carried_slot, m.carried_frame, s.lanes, w.flag.real]
        inputs += [w.twist.real, w.lever.real, w.x.real]
        outputs = [state.node_x, state.node_v, good_x, good_v]
        s.each_real(self.k_state.commit_carried, m.carried_count, inputs, outputs)

    def _carry(self) -> None:
        """What masters carry, from their poses and twists."""
        s, w, m = self.shard, self.shard.work, self.model
        inputs = [m.welded_frame, m.frame_master, m.frame_offset]
        s.each(self.k.carry_frames, m.welded_frame.size, inputs, [w.pose.S, w.twist.S])
        inputs = [m.blend_frame, m.blend_ends, m.blend_place]
        s.each(self.k.blend_frames, m.blend_frame.size, inputs, [w.pose.S, w.twist.S])
        inputs = [s.model.node_count, m.carried_slot, m.carried_frame, m.carried_offset, w.pose.S]
        s.each(self.k.carry, m.carried_count, inputs, [w.lever.S, w.x.S])
