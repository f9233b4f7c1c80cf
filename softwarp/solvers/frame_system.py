"""Frames in the linear system of a shard: rod segments, rigid bodies, what they carry and what is prescribed.

``System`` calls these operations at the stages of the same names. Equations: docs/theory/frames.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

from softwarp.kernels import attachment, frame_state, frames, hyperelastic, prescribed, rod

if TYPE_CHECKING:
    from softwarp.solvers.system import System


class FrameSystem:
    """Workspace and launches for the frames of one shard.

    Args:
        system: Owner of the linear system; its model has frames.
    """

    def __init__(self, system: System) -> None:
        model = system.model.frames
        if model is None:
            raise ValueError("the scene has no frames")
        self.system, self.model = system, model
        variant, r = system.variant, system._rows
        self.k = frames.kernels(variant)
        self.k_inertia = frames.inertia_kernels(variant)
        self.k_rod = rod.kernels(variant)
        self.k_gather = hyperelastic.gather_kernels(variant)
        self.k_carried = attachment.kernels(variant)
        self.k_command = prescribed.command_kernels(variant)
        self.k_state = frame_state.kernels(variant)
        segments, count, slots = len(model.segment_frames), model.count, int(model.slot_dof.size)
        self.pose, self.twist = r(7 * count), r(6 * count)
        self.lever, self.slot_v = r(3 * max(model.carried_count, 1)), r(3 * slots)
        self.seg_force, self.seg_stiffness = r(12 * max(segments, 1)), r(90 * max(segments, 1))
        self.mass, self.internal, self.external = r(count), r(6 * count), r(6 * count)
        sources = len(model.source)
        self.source_b, self.source_momentum = r(6 * sources), r(6 * sources)
        self.density = r(model.rigid_count + model.rod_count)
        self.held, self.seen = r(7 * max(model.rigid_count, 1)), r(7 * max(model.rigid_count, 1))

    # Stages

    def load(self) -> None:
        """Start values of a step; needs ``System.load``."""
        s, i = self.system, self.system.input
        self.pose.copy_from(i["pose0"])
        if self.model.rigid_count:
            self.held.copy_from(i["held_pose"])
            self.seen.copy_from(i["seen_pose"])
            s.place(i["body_mass"], self.model.rigid_count, self.density, 0)
        if self.model.rod_count:
            s.place(i["rod_density"], self.model.rod_count, self.density, self.model.rigid_count)
        for name in ("command_frame_force", "command_body_pose", "command_body_velocity"):
            count = i[name].real.shape[1]
            s.each_real(s.k_state.check_rows, count, [i[name].real], [s.flag.real])
        self.slot_v.zero()
        self._carry()

    def scale(self, h: float) -> None:
        """Matrix factors of rods and rigid bodies, after those of the soft bodies."""
        s, i, b = self.system, self.system.input, self.system.body
        soft, rods = s.model.body_count, self.model.rod_count
        inputs = [soft, i["rod_rayleigh_mass"].S, i["rod_rayleigh_stiffness"].S, h]
        outputs = [b["mass"].S, b["stiffness"].S, b["damping"].S]
        s.each(s.k.damping_scales, rods, inputs, outputs)
        inputs = [soft + rods, i["body_damping"].S, i["body_damping"].S, h]
        s.each(s.k.damping_scales, self.model.rigid_count, inputs, outputs)

    def command(self, h: float) -> None:
        """Velocities of prescribed scalars."""
        s, m, i = self.system, self.model, self.system.input
        inputs = [m.kinematic_frame, m.frame_dof, i["pose0"].real, i["seen_pose"].real]
        inputs += [i["command_body_pose"].real, i["command_body_velocity"].real]
        inputs += [i["body_max_speed"].real, i["body_max_spin"].real, h]
        outputs = [self.held.real, self.seen.real, s.prescribed_v.real]
        s.each_real(self.k_command.kinematic_command, m.kinematic_frame.size, inputs, outputs)

    def segments(self) -> None:
        """Force and stiffness of every rod segment at the trial poses."""
        s, m, i = self.system, self.model, self.system.input
        inputs = [0, m.seg_frame, m.seg_rod, m.seg_length, m.seg_section, m.seg_scale, m.seg_rest]
        inputs += [i["rod_youngs"].S, i["rod_nu"].S, self.pose.S]
        s.each(self.k_rod.element, len(m.segment_frames), inputs, [self.seg_force.S, self.seg_stiffness.S])

    def forces(self) -> None:
        """Internal and external force and moment of every frame."""
        s, m, i = self.system, self.model, self.system.input
        inputs = [m.frame_owner, m.frame_volume, m.corner_start, m.corner]
        inputs += [self.density.S, i["gravity"].S, i["command_frame_force"].S, self.seg_force.S]
        s.each(self.k_inertia.frame_forces, m.count, inputs, [self.mass.S, self.internal.S, self.external.S])

    def tangent(self) -> None:
        """Add inertia, segments and carried elements to A."""
        s, m, b = self.system, self.model, self.system.body
        blocks = len(s.model.symbolic.a_row)
        if len(m.segment_frames):
            inputs = [m.seg_body, m.seg_entry_start, m.seg_entry, b["stiffness"].S, self.seg_stiffness.S]
            s.each(self.k_gather.block_stiffness, blocks, inputs, [s.a.S])
        for kind, (block, start, entry) in m.carried_blocks.items():
            if kind == "large":
                kernel, inputs = self.k_carried.turned_stiffness, [s.model.tet_body, block, start, entry]
                inputs += [b["mu"].S, b["lam"].S, b["stiffness"].S, s.tet_gradient.S]
            else:
                kernel, body = self.k_carried.stored_stiffness, s.model.tet_body if kind == "stored" else m.seg_body
                stiffness = s.tet_stiffness if kind == "stored" else self.seg_stiffness
                inputs = [body, block, start, entry, b["stiffness"].S, stiffness.S]
            s.each(kernel, block.size, [*inputs, self.lever.S], [s.a.S])
        inputs = [m.frame_block, m.frame_source_start, m.source, m.frame_owner, m.owner_body, s.model.node_body]
        inputs += [m.frame_inertia, b["mass"].S, self.density.S, s.node_mass.S, self.mass.S, s.input["pose0"].S]
        s.each(self.k_inertia.frame_mass, m.count, [*inputs, self.lever.S], [s.a.S])

    def right_hand_side(self, f_scale: float, inertia: float, moving: bool) -> None:
        """Rows of b that belong to frames; needs ``velocity`` where ``moving``."""
        s, m, b = self.system, self.model, self.system.body
        inputs = [s.model.node_count, m.frame_owner, m.owner_body, s.model.node_body, m.source, m.frame_inertia]
        inputs += [b["mass"].S, self.density.S, s.node_mass.S, s.node_internal.S, s.node_external.S, s.input["v0"].S]
        inputs += [self.mass.S, self.internal.S, self.external.S, s.input["twist0"].S, s.input["pose0"].S]
        inputs += [self.slot_v.S, f_scale, inertia, moving]
        outputs = [self.source_b.S, self.source_momentum.S]
        s.each(self.k_inertia.source_force, len(m.source), inputs, outputs)
        inputs = [m.frame_dof, m.frame_source_start, m.source, self.source_b.S, self.lever.S]
        s.each(self.k_inertia.gather_sources, m.count, inputs, [s.b.S])

    def velocity(self) -> None:
        """Velocity of every slot at the present dof velocities."""
        s, m = self.system, self.model
        inputs = [m.slot_dof, m.slot_carried, m.carried_dof, s.dof_v.S, self.lever.S]
        s.each(self.k.slot_velocity, m.slot_dof.size, inputs, [self.slot_v.S])

    def force_norms(self, f_scale: float) -> None:
        """Add the size of what should balance at frames to the norms of ``System.imbalance``."""
        s, m = self.system, self.model
        inputs = [m.count, len(m.source), len(m.segment_frames), self.external.S, self.source_momentum.S]
        s.each_world(self.k_inertia.frame_norms, [*inputs, self.seg_force.S, f_scale], [s.norm.S])

    def move(self, x_scale: float) -> None:
        """Trial poses, levers and carried nodes."""
        s, m = self.system, self.model
        self.velocity()  # with the levers that the velocities were solved with
        inputs = [m.frame_master, m.frame_dof, m.frame_offset, s.input["pose0"].S, s.dof_v.S, x_scale]
        s.each(self.k.trial_pose, m.count, inputs, [self.pose.S])
        self._carry()

    def commit(self, h: float) -> None:
        """Twists at the end of the step; checks."""
        s, m = self.system, self.model
        inputs = [s.model.node_count, m.frame_spin, m.frame_inertia, m.frame_inverse_inertia]
        inputs += [s.input["pose0"].real, self.slot_v.real, h]
        s.each_real(self.k_state.turn_frames, m.count, inputs, [self.pose.real, self.twist.real])
        inputs = [s.input["pose0"].real, self.pose.real, self.twist.real, s.options.reach * s.model.extent]
        s.each_real(self.k_state.check_frames, m.count, inputs, [s.flag.real])

    def write(self) -> None:
        """Good worlds into the state; needs the flags of all checks."""
        s, m, k, state = self.system, self.model, self.k_state, self.system.state
        pairs: list[tuple[Any, wp.array, wp.array]] = [
            (self.pose, state.frame_pose, state.good_pose),
            (self.twist, state.frame_twist, state.good_twist),
        ]
        if m.rigid_count:
            pairs += [(self.held, state.held_pose, state.held_pose), (self.seen, state.seen_pose, state.seen_pose)]
        for value, target, good in pairs:
            s.each_real(k.commit_state, target.shape[1], [s.lanes, s.flag.real, value.real], [target, good])
        inputs = [s.model.node_count, m.carried_slot, s.lanes, s.flag.real, self.slot_v.real]
        s.each_real(k.commit_carried, m.carried_count, inputs, [state.node_v, state.good_v])

    def _carry(self) -> None:
        s, m = self.system, self.model
        inputs = [s.model.node_count, m.carried_slot, m.carried_frame, m.carried_offset, self.pose.S]
        s.each(self.k.carry, m.carried_count, inputs, [self.lever.S, s.x.S])
