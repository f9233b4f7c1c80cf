"""Steps whose elements feel other velocities than those that they find, in the adjoint: memories, and predicted stages.

Equations: docs/theory/adjoint.md.
"""

from __future__ import annotations

from collections.abc import Callable

import warp as wp

from softwarp.kernels.frames import leaning_adjoint, relaxation_adjoint
from softwarp.model.frames import FrameModel
from softwarp.model.gradients import Gradients
from softwarp.solvers.adjoint_index import AdjointIndex
from softwarp.solvers.frame_adjoint import FrameAdjoint
from softwarp.solvers.system import System
from softwarp.solvers.terms.relaxation import RelaxationTerm
from softwarp.solvers.workspace.rows import Rows


class LeaningFrames(FrameAdjoint):
    """Frames beside soft bodies with memories, or in a stage that is linearised where its start velocities lead to.

    Args:
        system: Worlds.
        model: Frames.
        h: Step [s].
        gradients: Arrays of these worlds.
        predicts: Whether it is such a stage.

    Attributes:
        start_v: Velocities of dofs at the start of a stage; else 0.
        lean: e y of dofs.
        mind: Gradients by e y of frames.
        felt_v: Velocities of dofs that inertia resists.
        ahead: Gradients by the velocities of dofs that a stage is linearised with.
        heeds: 1 in worlds where that stage is linearised with velocities that may not be 0, else 0.
        sooner, there: More of these that others have found, and by place and turn where these velocities lead to.
    """

    def __init__(self, system: System, model: FrameModel, h: float, gradients: Gradients, *, predicts: bool) -> None:
        super().__init__(system, model, h, gradients)
        s = self.shard
        self.k_felt, self.k_memory = leaning_adjoint.kernels(s.variant), relaxation_adjoint.kernels(s.variant)
        self.term = next((term for term in system.terms if isinstance(term, RelaxationTerm)), None)
        self.predicts, self.heeds = predicts, s.rows(1)
        self.heeds.real.fill_(float(predicts))
        self.start_v, self.lean, self.felt_v, self.ahead, self.sooner = (s.rows(s.dof_room) for _ in range(5))
        self.there = s.rows(6 * model.count)
        self.differences: Callable[[Rows], None] | None = None  # takes from velocities what no momentum has
        self.follows = 1.0  # whether such a stage is linearised with the velocities of its start
        self.felt = s.rows(leaning_adjoint.FELT_ROWS * max(model.carried_count, 1))
        self.mind, self.early = s.rows(6 * model.count), s.rows(3 * model.count)
        self.inertial_v, self.early_twist = self.felt_v, s.rows(6 * model.count)
        self.twist0, self.internal = s.felt["twist0"], s.rows(s.work.node_internal.real.shape[1])
        if predicts:
            self.pose, self.force_pose = s.rows(7 * model.count), s.rows(7 * model.count)

    def note_forces(self) -> None:
        """Keep the forces of elements, to which a right-hand side will add damping."""
        if self.lifts:
            self.internal.copy_from(self.shard.work.node_internal)

    def place(self) -> None:
        """Note the poses that a stage is linearised at."""
        s, m = self.shard, self.model
        self.pose.copy_from(s.work.pose)
        inputs = [m.frame_spin, s.work.pose.real, s.input["pose0"].real]
        s.each_real(self.k_felt.force_poses, m.count, inputs, [self.force_pose.real])

    def turn_seed(self, seed: Rows, y: Rows, solved_v: Rows) -> None:
        """Seeds by the spins that frames move on with become those by the unknowns of a stage."""
        s, m = self.shard, self.model
        self.early.zero()
        inputs = [self.h, m.turning_frame, m.frame_dof, self.start_v.real, solved_v.real]
        s.each_real(self.k_felt.turn_seed, m.turning_frame.size, inputs, [seed.real, y.real, self.early.real])

    def of_carried(self, index: AdjointIndex, p: Rows, q: Rows, node_bar: Rows) -> None:
        """What carried nodes have goes to their frames; they have no gradients of their own."""
        s, m, w, g = self.shard, self.model, self.shard.work, self.gradients
        inputs = [self.h, s.lanes, s.model.node_count, s.model.body_node_count]
        inputs += [m.carried_slot, m.carried_frame, m.carried_offset, m.frame_dof, s.model.node_body]
        inputs += [index.node_point_start, index.node_point, index.node_point_weight, index.point_row]
        inputs += [self.pose.real, w.body_damping.real, w.dof_v.real, self.start_v.real, self.lean.real, p.real]
        inputs += [w.point_gradient.real, w.multiplier.real, q.real]
        inputs += [node_bar.real, self.impulse.real, self.stiff.real]
        outputs = [g.node_x, g.node_v, g.command_node_force, self.items.real, self.felt.real, self.offset.real]
        s.each_real(self.k_felt.carried_gradients, m.carried_count, inputs, outputs)

    def to_state(self, p: Rows) -> None:
        """Gradients by poses, twists and forces of frames; needs ``seed`` and ``of_carried``.

        Args:
            p: Adjoint of the velocities of dofs.
        """
        s, m, i, w, g = self.shard, self.model, self.shard.input, self.shard.work, self.gradients
        twists = [self.frame_v.real, self.frame_p.real, self.early_twist.real]
        inputs = [float(self.predicts), m.frame_master, m.frame_offset, m.frame_dof, m.frame_owner, m.owner_body]
        inputs.append(self.force_pose.real)
        inputs += [w.body_damping.real, w.dof_v.real, self.start_v.real, self.lean.real, p.real]
        s.each_real(self.k_felt.twists, m.count, inputs, twists)
        self._to_segments()
        inputs = [self.h, m.seg_frame, m.seg_body, w.body_damping.real, w.body_stiffness.real, self.early_twist.real]
        s.each_real(self.k_felt.rod_damping, self.count, [*inputs, self.way.real], [self.parameter.real])
        inputs = [s.model.node_count, m.welded_frame, m.frame_owner, m.owner_body, m.slot_carried]
        inputs += [w.body_damping.real, self.items.real]
        s.each_real(self.k_felt.welded_felt, m.welded_frame.size, inputs, [self.felt.real])
        inputs = [self.h, self.follows, s.lanes, s.model.node_count]
        inputs += [m.frame_master, m.frame_spin, m.frame_owner, m.owner_body, m.frame_dof]
        inputs += [self.item_start, self.item, m.carried_slot, m.corner_start, m.corner, self.is_kinematic]
        inputs += [
            self.heeds.real,
            w.body_damping.real,
            i["pose0"].real,
            self.start_v.real,
            self.twist0.real,
            w.compound.real,
        ]
        inputs += [self.felt_v.real, p.real, self.frame_p.real, self.start.real, self.corner.real, self.way.real]
        inputs += [self.items.real, self.felt.real, self.bare.real, self.early.real]
        inputs += [self.there.real, self.sooner.real]
        outputs = [g.frame_pose, g.frame_twist, g.command_frame_force, g.command_body_velocity]
        outputs += [self.mind.real, self.ahead.real]
        s.each_real(self.k_felt.frame_gradients, m.count, inputs, outputs)

    def _share_of_memory(self) -> list[wp.array]:
        if self.term is None:
            return super()._share_of_memory()
        return [self.term.lean_share.real, self.shard.input["frame_memory"].real]

    def _to_sources(self, p: Rows) -> None:
        """Add what parts of compounds have by the share of memories in momentum."""
        super()._to_sources(p)
        term, s, m, i = self.term, self.shard, self.model, self.shard.input
        if term is not None:
            inputs = [s.model.body_count, self.source_frame, m.source, m.frame_volume, s.model.node_volume, m.frame_dof]
            inputs += [term.lean_share.real, i["pose0"].real, s.work.compound.real, i["frame_memory"].real, p.real]
            s.each_real(self.k_memory.sources, self.source_frame.size, inputs, [self.value.real])


class Leaning:
    """What elements, rows and inertia feel in a step, and the gradients by memories and by damping that follow.

    Args:
        system: Worlds.
        h: Step [s].
        gradients: Arrays of these worlds.
        index: Of the model.
        frames: Those of the worlds, if any move.

    Attributes:
        element_v, row_v: What elements and rows have in the place of the velocities of nodes.
        start_v, lean: Velocities of dofs at the start of a stage, else 0; and e y.
        pushed: The seed less h H' q, and less what contacts have likewise: A p, but for the tangent of pressures.
    """

    def __init__(
        self, system: System, h: float, gradients: Gradients, index: AdjointIndex, frames: LeaningFrames | None
    ) -> None:
        self.system, self.h, self.gradients, self.index, self.frames = system, h, gradients, index, frames
        s, m = system.shard, system.model
        self.shard, self.model = s, m
        self.k = leaning_adjoint.kernels(s.variant)
        self.k_memory = relaxation_adjoint.kernels(s.variant)
        self.term = next((term for term in system.terms if isinstance(term, RelaxationTerm)), None)
        nodes = 3 * m.node_count
        self.element_v, self.row_v, self.start_node, self.lean_node = (s.rows(nodes) for _ in range(4))
        self.product, self.pushed = s.rows(nodes), s.rows(3 * m.dof_count)
        self.start_v = s.rows(s.dof_room) if frames is None else frames.start_v
        self.lean = s.rows(s.dof_room) if frames is None else frames.lean
        self.still = s.rows(s.dof_room)
        self.sums = s.rows(relaxation_adjoint.SUM_ROWS * m.body_count)
        self.value = s.rows(2 * max(m.frame_count, 1))
        self.multiply: Callable[[Rows], None] | None = None  # A p, where p is not the solution of the seed alone
        self.more_products: Callable[[Rows, Rows, Rows], None] | None = None  # of modes, added to ``sums``
        self.before = wp.zeros_like(gradients.rayleigh_stiffness)
        self.bare = s.rows(6 * max(m.frame_count, 1)) if frames is None else frames.bare

    def load(self) -> None:
        """Memories at the start of a step; needs the factors of bodies."""
        term = self.term
        if term is not None:
            term.lean()
            term.lean_dofs(self.still, self.lean)

    def seed(self, seed: Rows, y: Rows) -> None:
        """Add what memories at the end of the step have by velocities to both right-hand sides."""
        term, s, m, g = self.term, self.shard, self.model, self.gradients
        if term is not None:
            inputs = [self.h, s.lanes, m.node_count, m.body_count, m.dof_node, m.dof_free, m.node_body]
            inputs += [g.node_memory, g.frame_memory, term.keep.real]
            s.each_real(self.k_memory.seed, m.dof_count, inputs, [seed.real, y.real, self.bare.real])

    def velocities(self, node_v: Rows) -> None:
        """What elements and rows feel, and inertia; ``node_v`` are velocities of nodes, those that are carried too."""
        s, m, w = self.shard, self.model, self.shard.work
        outputs = [rows.real for rows in (self.start_node, self.lean_node, self.element_v, self.row_v)]
        fields = [w.body_damping.real, node_v.real, self.start_v.real, self.lean.real]
        inputs = [m.body_node_count, m.node_dof, m.node_body, *fields]
        s.each_real(self.k.velocities, m.node_count, inputs, outputs)
        if self.frames is not None:
            f = self.frames.model
            inputs = [m.node_count, m.body_node_count, f.carried_slot, f.carried_frame, f.carried_offset, f.frame_dof]
            inputs += [m.node_body, self.frames.pose.real, *fields]
            s.each_real(self.k.carried_velocities, f.carried_count, inputs, outputs)
            self.frames.felt_v.copy_from(w.dof_v)
            s.add(self.lean, self.frames.felt_v, s.dof_rows)
            if self.frames.differences is not None:
                self.frames.differences(self.frames.felt_v)

    def lean_more(self, node_v: Rows, own_v: Rows) -> None:
        """Add what elements have beside velocities of nodes to those that they feel without turning."""
        s = self.shard
        inputs = [self.element_v.real, node_v.real]
        s.each_real(self.k.lean_more, 3 * self.model.body_node_count, inputs, [own_v.real])

    def push(self, seed: Rows, q: Rows) -> None:
        """Find s = A p: the seed less what rows have."""
        s, m, w = self.shard, self.model, self.shard.work
        if self.multiply is not None:
            self.multiply(self.pushed)
            return
        wp.copy(self.pushed.real, seed.real)
        if m.row_count:
            inputs = [m.dof_entry_start, m.dof_entry, m.entry_row, m.dof_free, w.row.S, q.S, -self.h]
            s.each(self.system.rows.k.row_force, m.dof_count, inputs, [self.pushed.S])

    def note(self) -> None:
        """Keep the gradient by damping as it is before this step's is added."""
        wp.copy(self.before, self.gradients.rayleigh_stiffness)

    def finish(self, node_v: Rows, node_mass_p: Rows, p: Rows, final_v: Rows, *, parameters: bool) -> None:
        """Gradients by memories, and by damping and relaxation.

        Args:
            node_v: Velocities of nodes.
            node_mass_p: Mass per density times p, of nodes.
            p: Adjoint of the velocities of dofs.
            final_v: Velocities of dofs at the end.
            parameters: Whether those by parameters are asked for.
        """
        term, s, m, i, w, g = self.term, self.shard, self.model, self.shard.input, self.shard.work, self.gradients
        if m.body_count == 0 or not (parameters or term is not None):
            return
        k = self.k_memory
        inputs = [m.node_dof, m.node_body, i["density"].real, w.body_mass.real, self.pushed.real, node_mass_p.real]
        s.each_real(k.products, m.body_node_count, inputs, [self.product.real])
        if self.frames is not None and self.frames.lifts:
            f = self.frames.model
            inputs = [m.body_node_count, f.carried_slot, self.frames.stiff.real]
            s.each_real(k.carried_products, f.carried_count, inputs, [self.product.real])
        bars = g.node_memory if term is not None else g.node_x
        memory = i["node_memory"] if term is not None else self.lean_node
        inputs = [self.h, s.lanes, term is not None, self.index.body_node_start, m.node_dof, bars, self.product.real]
        inputs += [self.start_node.real, self.lean_node.real, memory.real, node_v.real]
        s.each_real(k.sums, m.body_count, inputs, [self.sums.real])
        if self.more_products is not None:
            self.more_products(self.pushed, self.start_v, self.sums)
        beta = s.felt["beta"].real
        if term is None:
            inputs = [self.h, s.lanes, w.body_damping.real, beta, self.sums.real]
            s.each_real(k.by_damping, m.body_count, inputs, [g.rayleigh_stiffness])
            return
        factors = [i["relaxation_ratio"].real, beta, term.keep.real]
        inputs = [self.h, s.lanes, m.node_dof, m.node_body, *factors, self.product.real]
        s.each_real(k.node_memories, m.body_node_count, inputs, [g.node_memory])
        frames = 0
        if self.frames is not None:
            f, frames = self.frames.model, self.frames.model.count
            inputs = [self.h, s.lanes, m.body_count, f.frame_master, f.frame_dof, term.keep.real]
            inputs += [term.lean_share.real, i["frame_memory"].real, final_v.real, self.frames.mind.real]
            s.each_real(k.frame_memories, frames, inputs, [g.frame_memory, self.value.real])
        if parameters:
            inputs = [self.h, s.lanes, m.body_count, frames, self.before]
            inputs += [i["relaxation_ratio"].real, i["relaxation_time"].real]
            inputs += [w.body_damping.real, beta, term.keep.real, term.lean_share.real]
            inputs += [self.sums.real, self.value.real]
            outputs = [g.rayleigh_stiffness, g.relaxation_ratio, g.relaxation_time]
            s.each_real(k.constants, None, inputs, outputs)
