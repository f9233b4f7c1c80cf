"""Rod segments: stretch, shear, bending and twist between frames. Equations: docs/theory/rod.md."""

from __future__ import annotations

from softwarp.kernels.elements import assembly, rod, stored
from softwarp.kernels.frames import inertia as frame_inertia
from softwarp.model.frames import FrameModel
from softwarp.solvers.terms.term import Term
from softwarp.solvers.workspace.shard import Shard


class RodTerm(Term):
    """Segments of all rods of one shard.

    Args:
        shard: Worlds.
        model: Frames, which have segments.
    """

    def __init__(self, shard: Shard, model: FrameModel) -> None:
        super().__init__(shard)
        self.model, self.count = model, len(model.segment_frames)
        self.varying = shard.model.telescopes is not None
        self.k = rod.kernels(shard.variant, shard.options.project_tangent, self.varying)
        self.k_assembly = assembly.kernels(shard.variant)
        self.k_gather = stored.kernels(shard.variant)
        self.k_inertia = frame_inertia.kernels(shard.variant)

    def load(self) -> None:
        """Densities, after those of rigid bodies."""
        s, m = self.shard, self.model
        s.place(s.input["rod_density"], m.rod_count, s.work.owner_density, m.rigid_count)

    def scale(self, h: float) -> None:
        """Matrix factors of rods, after those of soft bodies."""
        s, i, w = self.shard, self.shard.input, self.shard.work
        inputs = [s.model.body_count, i["rod_rayleigh_mass"].S, i["rod_rayleigh_stiffness"].S, h]
        outputs = [w.body_mass.S, w.body_stiffness.S, w.body_damping.S]
        s.each(self.k_assembly.damping_scales, self.model.rod_count, inputs, outputs)

    def forces(self) -> None:
        """Force and stiffness of every segment at the trial poses."""
        s, m, i, w = self.shard, self.model, self.shard.input, self.shard.work
        inputs = [0, m.seg_frame, m.seg_rod, m.seg_length, m.seg_section, m.seg_scale, m.seg_rest]
        inputs += [i["rod_youngs"].S, i["rod_nu"].S, w.segment_law.S, w.pose.S]
        s.each(self.k.element, self.count, inputs, [w.segment_force.S, w.segment_stiffness.S])

    def tangent(self, h: float) -> None:
        """Stiffness of every segment."""
        s, m, w = self.shard, self.model, self.shard.work
        inputs = [m.seg_body, m.seg_entry_start, m.seg_entry, w.body_stiffness.S, w.segment_stiffness.S]
        s.each(self.k_gather.block_stiffness, s.blocks, inputs, [w.a.S])

    def right_hand_side(self, f_scale: float, inertia: bool, moving: bool) -> None:
        """Beta K v of segments as internal forces of frames; needs the velocities of slots."""
        if not moving:
            return
        s, m, w = self.shard, self.model, self.shard.work
        inputs = [s.model.node_count, m.seg_frame, m.seg_rod, s.input["rod_rayleigh_stiffness"].S]
        inputs += [w.segment_stiffness.S, w.slot_v.S]
        s.each(self.k_inertia.segment_damping, self.count, inputs, [w.segment_damping.S])
        inputs = [m.corner_start, m.corner, w.segment_damping.S]
        s.each(self.k_inertia.add_corner_forces, 2 * m.count, inputs, [w.frame_internal.S])
