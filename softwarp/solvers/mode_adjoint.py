"""Reduced bodies in the adjoint of a step: gradients by nodes are of modes. Equations: docs/theory/adjoint.md."""

from __future__ import annotations

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.elements import adjoint_sums, mode_adjoint, mode_loads, reduction
from softwarp.kernels.frames import relaxation_adjoint
from softwarp.model.gradients import Gradients
from softwarp.model.reduction import ReductionModel
from softwarp.solvers.floating_adjoint import FloatingAdjoint
from softwarp.solvers.leaning_adjoint import Leaning
from softwarp.solvers.subspace import each_load
from softwarp.solvers.terms.reduction import ReductionTerm
from softwarp.solvers.workspace.rows import Rows
from softwarp.solvers.workspace.shard import Shard


class ModeAdjoint:
    """Modes of the reduced bodies of one shard.

    Args:
        shard: Worlds.
        term: Their part in a step.
        h: Step [s].
        gradients: Arrays of these worlds.

    Attributes:
        has_sums: Whether all nodes follow modes, and ``sum`` has what elements and rows give them.
        is_lone: Whether they touch nothing besides; else contacts add to ``listed`` and ``listed_v``.
        by_velocities: Whether the end of a step may have gradients by velocities of nodes.
    """

    def __init__(self, shard: Shard, term: ReductionTerm, h: float, gradients: Gradients) -> None:
        self.shard, self.term, self.h, self.gradients = shard, term, h, gradients
        self.model: ReductionModel = term.model
        m = self.model
        self.k, self.k_modes = mode_adjoint.kernels(shard.variant), reduction.kernels(shard.variant)
        self.k_elements, self.k_loads = mode_adjoint.element_kernels(shard.variant), mode_loads.kernels(shard.variant)
        self.listed, self.wide = shard.rows(3 * int(m.node.size)), shard.rows(m.wide_count)
        self.wide_v, self.wide_p = shard.rows(m.wide_count), shard.rows(m.wide_count)
        self.mass_p = shard.rows(m.count)
        self.start = wp.array(m.start, dtype=wp.int32, device=shard.device)
        self.at_zero = wp.zeros_like(m.node_rest)
        self.listed_v = shard.rows(3 * int(m.node.size))
        self.k_sums = adjoint_sums.kernels(shard.variant)
        self.frames = None if m.floating is None else FloatingAdjoint(shard, term, h, gradients)
        self.has_sums, self.is_lone, self.by_velocities = False, False, True

    def take(self, *, at_end: bool = False, moves: bool = True) -> None:
        """Gradients by nodes become those by modes that they follow from.

        Args:
            at_end: Whether these are those at the end of a step, and not at its start.
            moves: Whether there may be some by velocities of nodes.
        """
        s, m, g = self.shard, self.model, self.gradients
        if self.has_sums and not at_end:  # and there are no others
            touched = None if self.is_lone else self.listed_v
            if self.frames is not None:
                self.frames.turn_bars(self.listed, touched, at_end=False)
            self._add(self.listed, g.mode_q)
            if touched is not None:
                self._add(touched, g.mode_v)
            return
        parts = s.variant.parts(int(m.node.size))
        taken = [(g.node_x, self.listed), (g.node_v, self.listed_v)]
        for by_nodes, listed in taken if moves else taken[:1]:
            s.each_real(self.k.take_nodes, parts, [m.node], [by_nodes, listed.real])
        if self.frames is not None:
            if at_end:
                self.frames.take_turns()
            self.frames.turn_bars(self.listed, self.listed_v if moves else None, at_end=at_end)
        self._add(self.listed, g.mode_q)
        if moves:
            self._add(self.listed_v, g.mode_v)

    def _add(self, listed: Rows, by_modes: wp.array) -> None:
        """by_modes += Phi' by listed nodes."""
        s, m = self.shard, self.model
        self.gather(listed)
        if self.frames is not None:
            self.frames.rigid_bars(self.wide, by_velocities=listed is self.listed_v)
        s.each_real(self.k.add_modes, m.count, [s.lanes, m.mode_wide, self.wide.real], [by_modes])

    def gather(self, listed: Rows) -> None:
        """Phi' by listed nodes, into ``wide``."""
        s, m = self.shard, self.model
        self.wide.zero()
        inputs = [m.body_node, m.order, m.node_basis, m.node_body, m.body_wide, m.body_stride, m.wide_body, m.basis]
        each_load(s, self.k_loads.add_forces, m.wide_count, len(m.body), [*inputs, listed.S], [self.wide.S])

    def seed(self, seed: Rows, y: Rows, *, arrives: bool) -> None:
        """Right-hand sides of p, from gradients by the end of a step; those by nodes are taken over first.

        Args:
            seed: Receives them.
            y: Likewise.
            arrives: Whether that is the end, and not where a look ahead has been.
        """
        moves = self.by_velocities or not arrives
        if self.frames is not None:
            self.frames.find_places(arrives=arrives, moves=moves)
        self.take(at_end=True, moves=moves)
        if self.frames is not None and arrives:
            self.frames.turn_back()
        elif self.frames is not None:
            self.frames.look_back()
        s, m, g = self.shard, self.model, self.gradients
        inputs = [self.h, s.lanes, m.mode_dof, g.mode_q, g.mode_v]
        s.each_real(self.k.seed, m.count // 3, inputs, [seed.real, y.real])

    def sum(self, sums: list[wp.array]) -> None:
        """Gradients by listed nodes from those by corners and points; those behind the active ones have none."""
        s, m = self.shard, self.model
        self.listed.zero()
        if not self.is_lone:
            self.listed_v.zero()
        inputs = [m.active_count, m.node, *sums]
        s.each(self.k_sums.listed_sums, s.variant.parts(m.active_count), inputs, [self.listed.S])

    def place(self, v: Rows, p: Rows, node_v: Rows, node_p: Rows, *, everywhere: bool = True) -> None:
        """Velocities and p of nodes, from those of dofs.

        Args:
            v: Velocities of dofs.
            p: Adjoint of these.
            node_v: Receives those of nodes.
            node_p: Likewise.
            everywhere: Whether nodes are asked for that no element or row needs, which have forces alone.
        """
        s, m, t = self.shard, self.model, self.term
        for dofs, wide in ((v, self.wide_v), (p, self.wide_p)):
            s.each(self.k_modes.widen_dofs, m.wide_count, [m.wide_mode, m.mode_dof, dofs.S], [wide.S])
        count = int(m.node.size) if everywhere else m.active_count
        t.place_both(self.at_zero, self.wide_v, self.wide_p, node_v, node_p, count)
        if self.frames is not None:
            self.frames.place(p, node_v, node_p, count)

    def to_state(self) -> None:
        """Gradients by the velocities at the start of the step; needs ``place``."""
        s, m = self.shard, self.model
        inputs = [m.block_first, m.block_modes, m.block_volume, m.volume, m.mode_wide, self.wide_p.S]
        s.each(self.k_elements.masses, m.count // 3, inputs, [self.mass_p.S])
        inputs = [s.lanes, m.block_body, s.input["density"].real, self.mass_p.real]
        s.each_real(self.k.velocities, m.count // 3, inputs, [self.gradients.mode_v])

    def to_parameters(self) -> None:
        """Add the gradients by density, Rayleigh's alpha and gravity; needs ``to_state``."""
        s, m, i, w, g = self.shard, self.model, self.shard.input, self.shard.work, self.gradients
        inputs = [self.h, s.lanes, m.body_number, self.start, m.mode_wide, m.heft]
        inputs += [i["density"].real, w.body_mass.real, i["gravity"].real, i["mode_v0"].real]
        inputs += [self.wide_v.real, self.wide_p.real, self.mass_p.real]
        s.each_real(self.k.bodies, None, inputs, [g.density, g.rayleigh_mass, g.gravity])


class StageModes:
    """What modes have of the velocities that a stage is linearised with; see ``StageAdjoint``.

    Args:
        modes: Those of the stage.
        k: Kernels of ``step.stage_adjoint``.
    """

    def __init__(self, modes: ModeAdjoint, k: SimpleNamespace) -> None:
        self.modes, self.k = modes, k

    def velocities(self, leaning: Leaning, node_v: Rows) -> None:
        """What elements and rows have in the place of velocities of nodes; needs those of ``leaning``."""
        modes = self.modes
        s, m, t = modes.shard, modes.model, modes.term
        s.each(modes.k_modes.widen_dofs, m.wide_count, [m.wide_mode, m.mode_dof, leaning.start_v.S], [modes.wide.S])
        start, spare = leaning.start_node, leaning.row_v
        t.place_both(modes.at_zero, modes.wide, modes.wide, start, spare, m.active_count)
        inputs = [m.node, s.model.node_body, s.work.body_damping.real, node_v.real, start.real]
        outputs = [leaning.element_v.real, leaning.row_v.real]
        s.each_real(self.k.mode_velocities, m.active_count, inputs, outputs)

    def to_state(
        self, h: float, follows: float, heeds: Rows, seed: Rows, pushed: Rows, node_bar: Rows, ahead: Rows
    ) -> None:
        """Gradients by the velocities of modes at the start of the stage.

        Args:
            h: Length of the stage [s].
            follows: As of ``StageAdjoint``.
            heeds: Likewise.
            seed: Of the velocities, less what contacts have.
            pushed: As of ``Leaning``.
            node_bar: Gradients by positions of nodes where the stage is linearised.
            ahead: Receives those by the velocities that it is linearised with.
        """
        modes = self.modes
        s, m, g = modes.shard, modes.model, modes.gradients
        modes.to_state()
        s.each_real(self.k.listed_bars, int(m.node.size), [m.node, node_bar.real], [modes.listed.real])
        modes.gather(modes.listed)
        inputs = [h, follows, s.lanes, m.block_body, m.mode_dof, m.mode_wide]
        inputs += [heeds.real, s.input["density"].real, s.felt["beta"].real, s.work.body_mass.real]
        inputs += [seed.real, pushed.real, modes.mass_p.real, modes.wide.real]
        s.each_real(self.k.modes, m.count, inputs, [g.mode_v, ahead.real])

    def add_products(self, pushed: Rows, start_v: Rows, sums: Rows) -> None:
        """Add what stiffness times p has along the velocities that the stage is linearised with; needs ``to_state``."""
        modes = self.modes
        s, m = modes.shard, modes.model
        inputs = [relaxation_adjoint.SUM_ROWS, m.body_number, modes.start, m.mode_dof]
        inputs += [s.input["density"].real, s.work.body_mass.real, pushed.real, modes.mass_p.real, start_v.real]
        s.each_real(self.k.mode_products, len(m.body), inputs, [sums.real])
