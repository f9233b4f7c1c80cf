"""Frames in the linear system of a shard: rod segments, rigid bodies, what they carry and what is prescribed.

``System`` calls these operations at the stages of the same names. Equations: docs/theory/frames.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

from softwarp.kernels.elements import attachment, hyperelastic, rod
from softwarp.kernels.frames import inertia as frame_inertia
from softwarp.kernels.frames import momentum, motion, prescribed
from softwarp.solvers.workspace.rows import Rows

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
        self.k = motion.kernels(variant)
        self.k_inertia = frame_inertia.kernels(variant)
        self.k_rod = rod.kernels(variant, system.options.project_tangent)
        self.k_gather = hyperelastic.gather_kernels(variant)
        self.k_carried = attachment.kernels(variant)
        self.k_command = prescribed.command_kernels(variant)
        self.k_state = momentum.kernels(variant)
        segments, count, slots = len(model.segment_frames), model.count, int(model.slot_dof.size)
        self.pose, self.twist = r(7 * count), r(6 * count)
        self.lever, self.slot_v = r(3 * max(model.carried_count, 1)), r(3 * slots)
        self.seg_force, self.seg_damping = r(12 * max(segments, 1)), r(12 * max(segments, 1))
        self.seg_stiffness = r(90 * max(segments, 1))
        self.compound = r(frame_inertia.COMPOUND_ROWS * count)
        self.internal, self.external, self.momentum = r(6 * count), r(6 * count), r(6 * count)
        self.density = r(model.rigid_count + model.rod_count)
        self.held, self.seen = r(7 * max(model.rigid_count, 1)), r(7 * max(model.rigid_count, 1))

    # Stages

    def load(self) -> None:
        """Start values of a step; needs ``System.load``."""
        s, i = self.system, self.system.input
        self.pose.copy_from(i["pose0"])
        self.twist.copy_from(i["twist0"])
        if self.model.rigid_count:
            self.held.copy_from(i["held_pose"])
            self.seen.copy_from(i["seen_pose"])
            s.place(i["body_mass"], self.model.rigid_count, self.density, 0)
        if self.model.rod_count:
            s.place(i["rod_density"], self.model.rod_count, self.density, self.model.rigid_count)
        for name in ("command_frame_force", "command_body_pose", "command_body_velocity"):
            count = i[name].real.shape[1]
            s.check_finite(i[name].real, count)
        self._carry()

    def scale(self, h: float) -> None:
        """Matrix factors of rods and rigid bodies, after those of the soft bodies; inertia of all masters."""
        s, i, b = self.system, self.system.input, self.system.body
        soft, rods = s.model.body_count, self.model.rod_count
        inputs = [soft, i["rod_rayleigh_mass"].S, i["rod_rayleigh_stiffness"].S, h]
        outputs = [b["mass"].S, b["stiffness"].S, b["damping"].S]
        s.each(s.k.damping_scales, rods, inputs, outputs)
        inputs = [soft + rods, i["body_damping"].S, i["body_damping"].S, h]
        s.each(s.k.damping_scales, self.model.rigid_count, inputs, outputs)
        m = self.model
        inputs = [m.source_start, m.source, m.source_lever, m.source_inertia, m.frame_owner, m.frame_volume]
        inputs += [m.owner_body, s.model.node_body, s.model.node_volume]
        inputs += [i["density"].S, self.density.S, b["mass"].S]
        s.each(self.k_inertia.compound, m.count, inputs, [self.compound.S])

    def command(self, h: float) -> None:
        """Velocities of prescribed scalars."""
        s, m, i = self.system, self.model, self.system.input
        inputs = [m.kinematic_frame, m.frame_dof, i["pose0"].real, i["seen_pose"].real]
        inputs += [i["command_body_pose"].real, i["command_body_velocity"].real]
        inputs += [i["body_max_speed"].real, i["body_max_spin"].real, h]
        outputs = [self.held.real, self.seen.real, s.prescribed_v.real]
        s.each_real(self.k_command.kinematic_command, m.kinematic_frame.size, inputs, outputs)
        if m.kinematic_frame.size:
            inputs = [m.kinematic_frame, m.frame_dof, s.model.extent, s.prescribed_v.real, h]
            s.each_real(self.k_command.commanded_way, None, inputs, [s.commanded.real])

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
        s.each(self.k_inertia.frame_forces, m.count, inputs, [self.internal.S, self.external.S])

    def tangent(self) -> None:
        """Add inertia, segments and carried elements to A."""
        s, m, b = self.system, self.model, self.system.body
        blocks = len(s.model.symbolic.a_row)
        if len(m.segment_frames):
            inputs = [m.seg_body, m.seg_entry_start, m.seg_entry, b["stiffness"].S, self.seg_stiffness.S]
            s.each(self.k_gather.block_stiffness, blocks, inputs, [s.a.S])
        for kind, lists in m.carried_blocks.items():
            body, _, kept = self._elements(kind)
            inputs, kernel = [body, *lists], self.k_carried.stored_stiffness
            if kind.endswith("large"):
                inputs, kernel = [*inputs, b["mu"].S, b["lam"].S], self.k_carried.turned_stiffness
            s.each(kernel, lists[0].size, [*inputs, b["stiffness"].S, kept.S, self.lever.S], [s.a.S])
        inputs = [m.frame_block, m.frame_master, self.compound.S, s.input["pose0"].S]
        s.each(self.k_inertia.frame_mass, m.count, inputs, [s.a.S])

    def _elements(self, kind: str) -> tuple[wp.array, wp.array, Rows]:
        """Body and corners of elements of a kind, and what they keep for their stiffness."""
        s, q = self.system, self.system.quadratic
        if q is not None and kind.startswith("quadratic"):
            return q.model.point_body, q.model.point_tet, q.gradient if kind.endswith("large") else q.stiffness
        if kind == "segment":
            return self.model.seg_body, self.model.seg_frame, self.seg_stiffness
        return s.model.tet_body, s.model.tet_node, s.tet_gradient if kind == "large" else s.tet_stiffness

    def right_hand_side(self, f_scale: float, inertia: float, moving: bool) -> None:
        """Rows of b that belong to frames; needs ``tangent``."""
        s, m = self.system, self.model
        if moving:
            self._damp()
        inputs = [m.frame_dof, m.frame_spin, m.source_start, m.source, m.source_lever, self.compound.S]
        inputs += [s.node_internal.S, s.node_external.S, self.internal.S, self.external.S, self.lever.S]
        inputs += [s.input["pose0"].S, s.input["twist0"].S, s.dof_v.S, f_scale, inertia, moving]
        s.each(self.k_inertia.frame_right_hand_side, m.count, inputs, [self.momentum.S, s.b.S])

    def _damp(self) -> None:
        """Add beta K v of segments, and of elements at carried nodes, to the internal forces of frames and those nodes.

        Nodes that no frame carries have theirs from the product with A.
        """
        s, m, i = self.system, self.model, self.system.input
        inputs = [m.slot_dof, m.slot_carried, m.carried_dof, s.dof_v.S, self.lever.S]
        s.each(self.k.slot_velocity, m.slot_dof.size, inputs, [self.slot_v.S])
        segments = len(m.segment_frames)
        if segments:
            inputs = [s.model.node_count, m.seg_frame, m.seg_rod, i["rod_rayleigh_stiffness"].S]
            inputs += [self.seg_stiffness.S, self.slot_v.S]
            s.each(self.k_inertia.segment_damping, segments, inputs, [self.seg_damping.S])
            inputs = [m.corner_start, m.corner, self.seg_damping.S]
            s.each(self.k_inertia.add_corner_forces, 2 * m.count, inputs, [self.internal.S])
        for kind, lists in m.held_nodes.items():
            body, node, kept = self._elements(kind)
            inputs, kernel, velocity = [body, node, *lists], self.k_carried.stored_damping, self.slot_v
            if kind.endswith("large"):
                inputs, kernel = [*inputs, s.body["mu"].S, s.body["lam"].S], self.k_carried.turned_damping
            if s.quadratic is not None and kind.startswith("quadratic"):
                velocity = s.quadratic.corner_velocities(self.slot_v)
            inputs += [i["rayleigh_stiffness"].S, kept.S, velocity.S]
            s.each(kernel, lists[0].size, inputs, [s.node_internal.S])
        if s.membranes is not None:
            s.membranes.damp(self.slot_v)

    def rotation_step(self, x_scale: float) -> None:
        """Make rotations in ``System.u`` changes of angular velocity at the present velocities."""
        s, m = self.system, self.model
        inputs = [m.turning_frame, m.frame_dof, s.dof_v.S, x_scale]
        s.each(self.k.rotation_step, m.turning_frame.size, inputs, [s.u.S])

    def force_norms(self, f_scale: float) -> None:
        """Add the size of what should balance at frames to the norms of ``System.imbalance``."""
        s, m = self.system, self.model
        inputs = [m.count, len(m.segment_frames), self.external.S, self.momentum.S]
        s.each_world(self.k_inertia.frame_norms, [*inputs, self.seg_force.S, f_scale], [s.norm.S])

    def move(self, x_scale: float) -> None:
        """Trial poses, levers and carried nodes."""
        s, m = self.system, self.model
        inputs = [m.frame_master, m.frame_dof, s.input["pose0"].S, s.dof_v.S, x_scale]
        s.each(self.k.trial_pose, m.count, inputs, [self.pose.S])
        self._carry()

    def commit(self, h: float) -> None:
        """Twists at the end of the step; checks."""
        s, m = self.system, self.model
        inputs = [m.frame_spin, m.frame_dof, s.model.dof_free, s.input["pose0"].real, s.dof_v.real]
        inputs += [self.compound.real, h]
        s.each_real(self.k_state.move_on, m.count, inputs, [self.pose.real, self.twist.real])
        if s.joints is not None:
            s.joints.keep_energy()
        self._carry()
        reach = s.options.reach * s.model.extent
        inputs = [s.input["pose0"].real, self.pose.real, self.twist.real, s.commanded.real, reach]
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
            parts = s.variant.parts(target.shape[1])
            s.each_real(k.commit_state, parts, [s.lanes, s.flag.real, value.real], [target, good])
        self._write_carried(state.good_x, state.good_v)

    def refresh(self) -> None:
        """What frames carry into the state, where poses and twists were written by hand; needs ``load``."""
        s, k, state = self.system, self.k_state, self.system.state
        for value, target in ((self.pose, state.frame_pose), (self.twist, state.frame_twist)):
            parts = s.variant.parts(target.shape[1])
            s.each_real(k.commit_state, parts, [s.lanes, s.flag.real, value.real], [target, target])
        self._write_carried(state.node_x, state.node_v)

    def _write_carried(self, good_x: wp.array, good_v: wp.array) -> None:
        s, m, state = self.system, self.model, self.system.state
        inputs = [s.model.node_count, m.carried_slot, m.carried_frame, s.lanes, s.flag.real]
        inputs += [self.twist.real, self.lever.real, s.x.real]
        outputs = [state.node_x, state.node_v, good_x, good_v]
        s.each_real(self.k_state.commit_carried, m.carried_count, inputs, outputs)

    def _carry(self) -> None:
        """What masters carry, from their poses and twists."""
        s, m = self.system, self.model
        inputs = [m.welded_frame, m.frame_master, m.frame_offset]
        s.each(self.k.carry_frames, m.welded_frame.size, inputs, [self.pose.S, self.twist.S])
        inputs = [m.blend_frame, m.blend_ends, m.blend_place]
        s.each(self.k.blend_frames, m.blend_frame.size, inputs, [self.pose.S, self.twist.S])
        inputs = [s.model.node_count, m.carried_slot, m.carried_frame, m.carried_offset, self.pose.S]
        s.each(self.k.carry, m.carried_count, inputs, [self.lever.S, s.x.S])
