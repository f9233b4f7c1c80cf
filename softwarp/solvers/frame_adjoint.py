"""Frames in the adjoint of a step: rods, rigid bodies, and what they carry. Equations: docs/theory/adjoint.md."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from softwarp.kernels.elements import rod_adjoint
from softwarp.kernels.frames import adjoint as of_frames
from softwarp.kernels.frames import lever_adjoint
from softwarp.kernels.frames import parameter_adjoint as of_parts
from softwarp.kernels.frames import welded_adjoint as of_welded
from softwarp.model.codes import Spin
from softwarp.model.frames import FrameModel
from softwarp.model.gradients import Gradients
from softwarp.solvers.adjoint_index import AdjointIndex
from softwarp.solvers.system import System
from softwarp.solvers.terms.attachments import AttachmentTerm
from softwarp.solvers.terms.hexes import HexTerm
from softwarp.solvers.workspace.rows import Rows


class FrameAdjoint:
    """Gradients of all frames of one system.

    Args:
        system: Worlds.
        model: Frames.
        h: Step [s].
        gradients: Arrays of these worlds.

    Attributes:
        lifts: Whether frames carry nodes of soft bodies, whose forces at the start of the step count.
        inertial_v: Velocities of dofs that inertia resists, where joints make these others than those that move things.
        end_v: Velocities that frames move on with after the step, likewise.
        offset: Gradients by where carried slots are in their frames.
        volume: Gradients by the volumes of nodes, per density, beside those that elements count.
        more_share: Gradients by what compounds are made of that the state behind the step has.
        pose, force_pose: Poses at which what they carry moves with them, and at which forces act on those.
        twist0: Twists whose momentum they have at the start.
        internal: Forces of nodes that elements oppose, without damping.
    """

    def __init__(self, system: System, model: FrameModel, h: float, gradients: Gradients) -> None:
        self.shard = shard = system.shard
        self.model, self.h, self.gradients = model, h, gradients
        self.k, self.k_segment = of_frames.kernels(shard.variant), rod_adjoint.kernels(shard.variant)
        self.k_part, self.k_welded = of_parts.kernels(shard.variant), of_welded.kernels(shard.variant)
        self.k_lever = lever_adjoint.kernels(shard.variant)
        self.count = len(model.segment_frames)
        self.attachments = next(term for term in system.terms if isinstance(term, AttachmentTerm))
        self.hexes = next((term for term in system.terms if isinstance(term, HexTerm)), None)
        self.inertial_v = self.end_v = shard.work.dof_v
        self.pose = self.force_pose = shard.input["pose0"]
        self.twist0, self.internal = shard.input["twist0"], shard.work.node_internal
        self.gyrates = wp.zeros(model.count, dtype=wp.int32, device=shard.device)
        self.as_solved = wp.full(model.count, int(Spin.AS_SOLVED), dtype=wp.int32, device=shard.device)
        self.splits = False  # whether gradients by the velocities that frames move on with go to ``kept`` alone
        self.kept = shard.rows(3 * shard.model.dof_count)
        self.start, self.moved = shard.rows(6 * model.count), shard.rows(of_parts.MOVED_ROWS * model.count)
        self.share, self.more_share = (shard.rows(of_parts.SHARE_ROWS * model.count) for _ in range(2))
        segments = max(self.count, 1)
        self.corner, self.way = shard.rows(12 * segments), shard.rows(12 * segments)
        self.parameter = shard.rows(rod_adjoint.PARAMETERS * segments)
        self.frame_v, self.frame_p = shard.rows(6 * model.count), shard.rows(6 * model.count)
        self.items, self.bare = shard.rows(12 * max(model.carried_count, 1)), shard.rows(6 * model.count)
        slots, nodes = model.carried_slot.numpy(), shard.model.node_count
        self.lifts = bool((slots < shard.model.body_node_count).any())
        self.impulse, self.stiff = (shard.rows(3 * max(nodes, 1)) for _ in range(2))
        self.offset, self.volume = shard.rows(3 * max(model.carried_count, 1)), shard.rows(max(nodes, 1))
        self.no_memory = wp.zeros((1, 0, 1), dtype=shard.variant.real, device=shard.device)
        self.rest_pose = wp.array(model.rest_pose, dtype=shard.variant.real, device=shard.device)
        self.item_start, self.item = lists(model.carried_frame.numpy(), model.count, shard.device)
        self.segment_start, self.segment = lists(model.seg_rod.numpy(), model.rod_count, shard.device)
        held = np.zeros(model.count)
        held[: model.rigid_count] = model.is_kinematic
        self.is_kinematic = wp.array(held, dtype=shard.variant.real, device=shard.device)
        self._find_sources()

    def _find_sources(self) -> None:
        """Parts of compounds, and whose they are: soft bodies, rods, rigid bodies."""
        s, m = self.shard, self.model
        start, source = m.source_start.numpy(), m.source.numpy().reshape(-1, 3)
        frame = np.repeat(np.arange(m.count), np.diff(start[: m.count + 1]))
        self.source_frame = wp.array(frame, dtype=wp.int32, device=s.device)
        self.value = s.rows(2 * max(len(source), 1))
        is_node = source[:, 0] == 0
        body = np.full(len(source), -1)
        body[is_node] = s.model.node_body.numpy()[source[is_node, 1]]
        owner = np.full(len(source), -1)
        owner[~is_node] = m.frame_owner.numpy()[source[~is_node, 1]]
        rods = np.where(owner >= m.rigid_count, owner - m.rigid_count, -1)
        rigid = np.where(owner < m.rigid_count, owner, -1)
        g, i, bodies = self.gradients, s.input, s.model.body_count
        self.owners = [
            (lists(body, bodies, s.device), bodies, 0, i["density"], (g.density, g.rayleigh_mass)),
            (
                lists(rods, m.rod_count, s.device),
                m.rod_count,
                bodies,
                i["rod_density"],
                (g.rod_density, g.rod_rayleigh_mass),
            ),
            (
                lists(rigid, m.rigid_count, s.device),
                m.rigid_count,
                bodies + m.rod_count,
                i["body_mass"],
                (g.body_mass, g.body_damping),
            ),
        ]

    def seed(self, seed: Rows, y: Rows, *, carries: bool = True) -> None:
        """Gradients by the velocities of frames at the end of the step, into both right-hand sides.

        Args:
            seed: Receives them.
            y: Likewise.
            carries: Whether frames move on with their momentum there, and do not just look ahead.
        """
        s, m, g, w = self.shard, self.model, self.gradients, self.shard.work
        spin = m.frame_spin if carries else self.as_solved
        self.share.copy_from(self.more_share)
        inputs = [self.h, s.lanes, self.splits, s.model.node_count, m.frame_master, m.frame_offset]
        inputs += [spin, self.gyrates, m.frame_dof, self.item_start, self.item]
        inputs += [m.carried_slot, m.carried_offset, s.model.dof_free, g.node_x, g.node_v, g.frame_pose]
        inputs += [g.frame_twist, s.input["pose0"].real, w.compound.real, w.dof_v.real, self.end_v.real]
        outputs = [seed.real, y.real, self.kept.real, self.start.real, self.moved.real, self.bare.real]
        outputs += [self.share.real, self.offset.real]
        s.each_real(self.k.frame_seed, m.count, inputs, outputs)

    def carry(self, p: Rows, node_v: Rows, node_p: Rows) -> None:
        """Velocities and their adjoint of the nodes that frames carry."""
        s, m, w = self.shard, self.model, self.shard.work
        inputs = [s.model.node_count, m.carried_slot, m.carried_frame, m.carried_offset, m.frame_dof]
        inputs += [self.pose.real, w.dof_v.real, p.real]
        s.each_real(self.k.carried_motion, m.carried_count, inputs, [node_v.real, node_p.real])

    def lift(self, node_v: Rows, node_p: Rows) -> None:
        """What elements do along the velocities of nodes, as they feel them, and along the adjoint of these."""
        s, m, w = self.shard, self.model, self.shard.work
        if self.lifts:
            self._find_products(node_v)
            inputs = [self.h, m.carried_slot, self.internal.real, w.node_external.real, self.stiff.real]
            s.each_real(self.k.carried_impulses, m.carried_count, inputs, [self.impulse.real])
            self._find_products(node_p)

    def _find_products(self, velocity: Rows) -> None:
        """k K v of the soft bodies' elements at the nodes that frames carry."""
        s, w, second = self.shard, self.shard.work, self.shard.model.quadratic
        self.stiff.zero()
        if second is not None and any(kind.velocity is w.gauss_corner_v for kind in self.attachments.held):
            kernel = self.attachments.k_quadratic.point_corners
            s.each(kernel, second.count, [second.element_node, velocity.S], [w.gauss_corner_v.S])
        for kind in self.attachments.held:
            of_points = kind.velocity is w.gauss_corner_v
            self.attachments.products.add(
                kind, w.body_stiffness.S, kind.velocity if of_points else velocity, self.stiff
            )
        self.attachments.products.add_skin(w.body_stiffness.S, velocity, self.stiff)
        if self.hexes is not None:
            self.hexes.add_products(w.body_stiffness.S, velocity, self.stiff)

    def of_carried(self, index: AdjointIndex, p: Rows, q: Rows, node_bar: Rows) -> None:
        """What carried nodes have goes to their frames; they have no gradients of their own."""
        s, m, w, g = self.shard, self.model, self.shard.work, self.gradients
        inputs = [self.h, s.lanes, s.model.node_count, s.model.body_node_count]
        inputs += [m.carried_slot, m.carried_frame, m.carried_offset]
        inputs += [m.frame_dof, index.node_point_start, index.node_point, index.node_point_weight, index.point_row]
        inputs += [s.input["pose0"].real, w.dof_v.real, p.real, w.point_gradient.real, w.multiplier.real, q.real]
        outputs = [g.node_x, g.node_v, g.command_node_force, self.items.real, self.offset.real]
        inputs += [node_bar.real, self.impulse.real, self.stiff.real]
        s.each_real(self.k.carried_gradients, m.carried_count, inputs, outputs)

    def to_state(self, p: Rows) -> None:
        """Gradients by poses, twists and forces of frames; needs ``seed`` and ``of_carried``.

        Args:
            p: Adjoint of the velocities of dofs.
        """
        s, m, i, w, g = self.shard, self.model, self.shard.input, self.shard.work, self.gradients
        twists = [self.frame_v.real, self.frame_p.real]
        inputs = [m.frame_master, m.frame_offset, m.frame_dof, i["pose0"].real, w.dof_v.real, p.real]
        s.each_real(self.k_welded.twists, m.count, inputs, twists)
        self._to_segments()
        inputs = [self.h, s.lanes, m.frame_master, m.frame_dof, self.item_start, self.item]
        inputs += [m.corner_start, m.corner, self.is_kinematic]
        inputs += [i["pose0"].real, i["twist0"].real, w.compound.real, self.inertial_v.real, p.real]
        inputs += [self.frame_p.real, self.start.real, self.corner.real, self.items.real, self.bare.real]
        outputs = [g.frame_pose, g.frame_twist, g.command_frame_force, g.command_body_velocity]
        s.each_real(self.k.frame_gradients, m.count, inputs, outputs)

    def _to_segments(self) -> None:
        """Gradients by the ends of segments, and what welded frames have for their masters."""
        s, m, i, w = self.shard, self.model, self.shard.input, self.shard.work
        twists = [self.frame_v.real, self.frame_p.real]
        inputs = [m.seg_frame, m.seg_rod, m.seg_body, m.seg_length, m.seg_section, m.seg_scale, m.seg_rest]
        inputs += [i["rod_youngs"].real, i["rod_nu"].real, w.body_stiffness.real, self.force_pose.real]
        outputs = [self.corner.real, self.way.real, self.parameter.real]
        s.each_real(self.k_segment.segment_adjoint, self.count, [*inputs, *twists, self.h], outputs)
        inputs = [self.h, s.model.node_count, m.welded_frame, m.frame_master, m.frame_owner, m.frame_volume]
        inputs += [m.slot_carried, m.carried_offset, m.corner_start, m.corner, w.owner_density.real]
        inputs += [i["gravity"].real, i["command_frame_force"].real, self.force_pose.real, *twists]
        inputs += [self.corner.real, self.way.real]
        s.each_real(self.k_welded.gradients, m.welded_frame.size, inputs, [self.items.real])

    def _to_sources(self, p: Rows) -> None:
        """What parts of compounds have per density."""
        s, m, i = self.shard, self.model, self.shard.input
        inputs = [self.h, self.source_frame, m.source, m.source_lever, m.source_inertia, m.frame_volume]
        inputs += [s.model.node_volume, m.frame_dof, i["gravity"].real]
        inputs += [i["pose0"].real, self.force_pose.real, self.twist0.real]
        inputs += [self.inertial_v.real, p.real, self.end_v.real, self.moved.real, self.share.real]
        s.each_real(self.k_part.sources, self.source_frame.size, inputs, [self.value.real])

    def to_rest(self, p: Rows, node_v: Rows, node_p: Rows) -> None:
        """Add the gradients by the rest positions of carried nodes; ``volume`` receives those by their volumes.

        Args:
            p: Adjoint of the velocities of dofs.
            node_v: Velocities of nodes.
            node_p: Adjoint of these.
        """
        s, m, i, w = self.shard, self.model, self.shard.input, self.shard.work
        motion = self.k_lever.Motion()
        parts = i["pose0"], self.twist0, self.inertial_v, p, self.end_v, self.moved, self.share
        for name, part in zip(("pose0", "twist0", "v", "p", "end_v", "moved", "share"), parts, strict=True):
            setattr(motion, name, part.real)
        inputs = [self.source_frame, m.source, m.source_lever, s.model.node_volume, s.model.node_body, m.frame_dof]
        inputs += [i["density"].real, w.body_mass.real, motion, i["v0"].real, node_v.real, node_p.real]
        inputs += [w.compound.real, *self._share_of_memory()]
        s.each_real(self.k_lever.levers, self.source_frame.size, inputs, [self.offset.real, self.volume.real])
        inputs = [s.lanes, s.model.node_count, m.carried_slot, m.carried_frame, self.rest_pose]
        outputs = [self.gradients.rest_x, self.offset.real]
        s.each_real(self.k_lever.rest_carried, m.carried_count, inputs, outputs)

    def _share_of_memory(self) -> list[wp.array]:
        """Largest e of bodies and the memories of frames, if there are any."""
        return [self.no_memory, self.no_memory]

    def to_parameters(self, p: Rows) -> None:
        """Add the gradients by parameters and gravity; needs ``to_state``."""
        s, m, w, g = self.shard, self.model, self.shard.work, self.gradients
        self._to_sources(p)
        self.share.zero()  # of one solution
        for lists, count, first, density, outputs in self.owners:
            inputs = [self.h, s.lanes, first, *lists, density.real, w.body_mass.real, self.value.real]
            s.each_real(self.k_part.owners, count, inputs, list(outputs))
        inputs = [s.lanes, self.segment_start, self.segment, self.parameter.real]
        s.each_real(self.k_part.rods, m.rod_count, inputs, [g.rod_youngs, g.rod_nu, g.rod_rayleigh_stiffness])
        inputs = [self.h, s.lanes, m.frame_owner, m.frame_volume, w.owner_density.real, self.frame_p.real]
        s.each_real(self.k_part.weights, None, inputs, [g.gravity])


def lists(owner: np.ndarray, count: int, device: Any) -> tuple[wp.array, wp.array]:
    """Ranges by owner, and the items that have one (others are negative) in that order."""
    start = np.concatenate([[0], np.cumsum(np.bincount(owner[owner >= 0], minlength=count))])
    order = np.argsort(owner, kind="stable")[np.count_nonzero(owner < 0) :]
    return wp.array(start, dtype=wp.int32, device=device), wp.array(order, dtype=wp.int32, device=device)
