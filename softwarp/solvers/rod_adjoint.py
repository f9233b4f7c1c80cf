"""Rods in the adjoint of a step: seeds of their nodes, and gradients by poses, twists and parameters.

Equations: docs/theory/adjoint.md.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from softwarp.kernels.elements import rod_adjoint
from softwarp.kernels.frames import adjoint as of_frames
from softwarp.model.frames import FrameModel
from softwarp.model.gradients import Gradients
from softwarp.solvers.adjoint_index import AdjointIndex
from softwarp.solvers.workspace.rows import Rows
from softwarp.solvers.workspace.shard import Shard


class RodAdjoint:
    """Gradients of all rods of one shard.

    Args:
        shard: Worlds.
        model: Frames, which have segments.
        h: Step [s].
        gradients: Arrays of these worlds.
    """

    def __init__(self, shard: Shard, model: FrameModel, h: float, gradients: Gradients) -> None:
        self.shard, self.model, self.h, self.gradients = shard, model, h, gradients
        self.k, self.k_segment = of_frames.kernels(shard.variant), rod_adjoint.kernels(shard.variant)
        self.count = len(model.segment_frames)
        self.start = shard.rows(6 * model.count)
        self.corner, self.parameter = shard.rows(12 * self.count), shard.rows(rod_adjoint.PARAMETERS * self.count)
        rod = model.seg_rod.numpy()
        segments = np.concatenate([[0], np.cumsum(np.bincount(rod, minlength=model.rod_count))])

        def send(values: np.ndarray) -> wp.array:
            return wp.array(values, dtype=wp.int32, device=shard.device)

        items = np.argsort(model.carried_frame.numpy(), kind="stable")
        carried = np.bincount(model.carried_frame.numpy(), minlength=model.count)
        self.item_start, self.item = send(np.concatenate([[0], np.cumsum(carried)])), send(items)
        self.items = shard.rows(6 * max(model.carried_count, 1))
        self.frame_start = send(model.rigid_count + model.rod_start)
        self.segment_start, self.segment = send(segments), send(np.argsort(rod, kind="stable"))

    def seed(self, seed: Rows, y: Rows) -> None:
        """Gradients by the velocities of frames at the end of the step, into both right-hand sides."""
        s, m, g, w = self.shard, self.model, self.gradients, self.shard.work
        inputs = [self.h, s.lanes, m.frame_spin, m.frame_dof, self.item_start, self.item, m.carried_slot]
        inputs += [m.carried_offset, s.model.dof_free, g.node_x, g.node_v, g.frame_pose, g.frame_twist]
        inputs += [s.input["pose0"].real, w.compound.real, w.dof_v.real]
        s.each_real(self.k.frame_seed, m.count, inputs, [seed.real, y.real, self.start.real])

    def carry(self, p: Rows, node_v: Rows, node_p: Rows) -> None:
        """Velocities and their adjoint of the nodes that rods carry."""
        s, m = self.shard, self.model
        inputs = [m.carried_slot, m.carried_frame, m.carried_offset, m.frame_dof, s.input["pose0"].real]
        inputs += [s.work.dof_v.real, p.real]
        s.each_real(self.k.carried_motion, m.carried_count, inputs, [node_v.real, node_p.real])

    def of_carried(self, index: AdjointIndex, p: Rows, q: Rows, node_bar: Rows) -> None:
        """What carried nodes have goes to their frames; they have no gradients of their own."""
        s, m, w, g = self.shard, self.model, self.shard.work, self.gradients
        inputs = [self.h, s.lanes, m.carried_slot, m.carried_frame, m.carried_offset, m.frame_dof]
        inputs += [index.node_point_start, index.node_point, index.node_point_weight, index.point_row]
        inputs += [s.input["pose0"].real, w.dof_v.real, p.real, w.point_gradient.real, w.multiplier.real, q.real]
        outputs = [g.node_x, g.node_v, g.command_node_force, self.items.real]
        s.each_real(self.k.carried_gradients, m.carried_count, [*inputs, node_bar.real], outputs)

    def to_state(self, p: Rows) -> None:
        """Gradients by poses, twists and forces of frames; needs ``seed`` and ``of_carried``.

        Args:
            p: Adjoint of the velocities of dofs.
        """
        s, m, i, w, g = self.shard, self.model, self.shard.input, self.shard.work, self.gradients
        inputs = [m.seg_frame, m.seg_rod, m.seg_body, m.seg_length, m.seg_section, m.seg_scale, m.seg_rest]
        inputs += [m.frame_dof, i["rod_youngs"].real, i["rod_nu"].real, w.body_stiffness.real, i["pose0"].real]
        outputs = [self.corner.real, self.parameter.real]
        s.each_real(self.k_segment.segment_adjoint, self.count, [*inputs, w.dof_v.real, p.real, self.h], outputs)
        inputs = [self.h, s.lanes, m.frame_dof, self.item_start, self.item, m.corner_start, m.corner]
        inputs += [i["pose0"].real, i["twist0"].real, w.compound.real, w.dof_v.real, p.real]
        inputs += [self.start.real, self.corner.real, self.items.real]
        s.each_real(self.k.frame_gradients, m.count, inputs, [g.frame_pose, g.frame_twist, g.command_frame_force])

    def to_parameters(self, p: Rows) -> None:
        """Add the gradients by parameters and gravity; needs ``to_state``."""
        s, m, i, w, g = self.shard, self.model, self.shard.input, self.shard.work, self.gradients
        inputs = [self.h, s.lanes, self.frame_start, self.segment_start, self.segment, m.frame_dof]
        inputs += [i["rod_density"].real, i["gravity"].real, i["pose0"].real, i["twist0"].real, w.compound.real]
        outputs = [g.rod_youngs, g.rod_nu, g.rod_density, g.rod_rayleigh_mass, g.rod_rayleigh_stiffness]
        s.each_real(self.k.rods, m.rod_count, [*inputs, w.dof_v.real, p.real, self.parameter.real], outputs)
        inputs = [self.h, s.lanes, self.frame_start, m.frame_dof, w.compound.real, p.real]
        s.each_real(self.k.weights, None, inputs, [g.gravity])
