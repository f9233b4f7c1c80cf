"""Multiplier rows in a linear solve: H and its transpose, and the laws of cables, chambers, joints and contacts.

Theory: docs/theory/delassus.md, docs/theory/contact.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import warp as wp

from softwarp.kernels.rows import cable, cable_block, delassus, held_sweeps, looks
from softwarp.model.codes import USUAL_SLOTS
from softwarp.solvers.collision import contact_list
from softwarp.solvers.linear.cholesky import LinearSolver
from softwarp.solvers.looks import FurtherLooks
from softwarp.solvers.response import ContactResponse, StaticLaws
from softwarp.solvers.sharing import Sharing, may_repeat
from softwarp.solvers.subspace import touch_struct
from softwarp.solvers.terms.contact import ContactTerm
from softwarp.solvers.terms.term import Term
from softwarp.solvers.workspace import rows
from softwarp.solvers.workspace.rows import Rows
from softwarp.solvers.workspace.shard import Shard

FURTHER_SWEEPS = 25  # over contacts, at most, in passes that look again: they begin with the forces of the one before,
# and a GPU waits for the world with the most sweeps


class StaticRows:
    """Rows besides contacts: those of cables, then chambers, then joints.

    Args:
        shard: Worlds.
        linear: Solver whose right-hand sides 1, 2 ... are the transposed rows.
        terms: Terms that bring rows in.
    """

    def __init__(self, shard: Shard, linear: LinearSolver, terms: Sequence[Term]) -> None:
        self.shard, self.linear, self.terms = shard, linear, terms
        self.count = shard.model.row_count
        self.k = delassus.kernels(shard.variant)
        self.k_cable = cable.kernels(shard.variant)

    def into_sides(self) -> None:
        """H from the gradients by points, and its transpose among the right-hand sides."""
        s, m, w, y = self.shard, self.shard.model, self.shard.work, self.linear.y
        inputs = [m.dof_count, m.entry_dof, m.entry_row, m.entry_start, m.entry_point, m.entry_weight]
        inputs += [m.entry_item, m.dof_free, w.point_gradient.S, w.lever.S]
        entries = m.entry_start.size - 1 if self.count else 0
        s.each(self.k_cable.cable_rows, entries, inputs, [w.row.S, y.S])
        for term in self.terms:
            term.sides(y)

    def add_forces(self, target: Rows, f_scale: float, free: wp.array | None = None) -> None:
        """target += f_scale H' multiplier, at scalars that are 1 in ``free`` (dof, 3); None takes unknown ones."""
        s, m, w = self.shard, self.shard.model, self.shard.work
        if self.count:
            inputs = [m.dof_entry_start, m.dof_entry, m.entry_row, m.dof_free if free is None else free]
            inputs += [w.row.S, w.multiplier.S, f_scale]
            s.each(self.k.row_force, m.dof_count, inputs, [target.S])

    def free_gaps(self, x_scale: float, gap: Rows) -> None:
        """Gaps before new multipliers."""
        s, m, w = self.shard, self.shard.model, self.shard.work
        inputs = [m.dof_count, m.row_entry_start, m.entry_dof, w.row.S, w.u.S, self.linear.y.S]
        inputs += [w.displacement.S, w.target.S, x_scale]
        s.each(self.k.free_gap, self.count, inputs, [gap.S])

    def measure_gaps(self) -> None:
        """Gaps at the present displacements and multipliers."""
        s, w = self.shard, self.shard.work
        inputs = [w.displacement.S, w.target.S, w.compliance.S, w.floor.S, w.ceiling.S, w.multiplier.S]
        s.each(self.k.row_gap, self.count, inputs, [w.gap.S])


class Multipliers:
    """Multipliers in a linear solve without any rows; with rows, one of the classes below.

    Args:
        rows: Rows besides contacts.

    Attributes:
        response: Solver of laws with compliance and contact, or None.
        further: Looks at contacts beyond these, in worlds that need them, where the options allow any.
        corrections: Passes of a linear solve in which contacts are measured anew.
        contact_forces: Multipliers of contacts, one array or none.
        overflow: Contacts that found no place, (1).
    """

    def __init__(self, rows_: StaticRows) -> None:
        self.rows, self.shard, self.linear = rows_, rows_.shard, rows_.linear
        self.response: ContactResponse | None = None
        self.further: FurtherLooks | None = None
        self.corrections = 0
        self.contact_forces: tuple[Rows, ...] = ()
        shard = self.shard
        self.sharing = Sharing(shard) if may_repeat(shard.model) else None
        self.overflow = rows.allocate(shard.variant, shard.world_count, 1, shard.device, wp.int32)

    @property
    def exist(self) -> bool:
        """Whether there are rows at all."""
        return self.rows.count > 0 or bool(self.contact_forces)

    def looks_ahead_of(self, velocities: Rows, part: float) -> bool:
        """Whether the next solve, which corrects ``velocities``, looks at contacts where it leads to.

        ``part`` of what swings a line too far for a linearisation is what it may go, as of ``System.restrain``.
        """
        return False

    def add_forces(self, target: Rows, f_scale: float) -> None:
        """target += f_scale H' multiplier of all rows."""
        self.rows.add_forces(target, f_scale)

    def respond(self, f_scale: float, x_scale: float, correction: int) -> None:
        """Half-solve the right-hand side, with the forces that the laws want.

        Args:
            f_scale: Factor of forces.
            x_scale: Factor from unknowns to positions.
            correction: Number of the pass; the first one, 0, has a new factor.
        """
        self.linear.forward(1)


class BoundedMultipliers(Multipliers):
    """Rows with bounds and nothing else, as of cables: projected Gauss-Seidel on W."""

    def respond(self, f_scale: float, x_scale: float, correction: int) -> None:
        """W in the first pass; multipliers, and their change in side 0."""
        s, w, m, static, linear = self.shard, self.shard.work, self.shard.model, self.rows, self.linear
        y, k, count, is_first = linear.y, static.k, static.count, correction == 0
        static.add_forces(y, f_scale)
        linear.forward(1 + count if is_first else 1)
        sweeps = s.options.gauss_seidel_iterations
        panels = linear.panels
        if panels is not None and count <= cable_block.MOST_ROWS and self.sharing is None:
            inputs = [m.dof_count, count, m.delassus_pair, m.row_entry_start, m.entry_dof, panels.index["column"]]
            inputs += [panels.threads, is_first, sweeps, panels.half, w.row.S, w.u.S, w.displacement.S, w.target.S]
            inputs += [w.lower_bound.S, w.upper_bound.S, f_scale, x_scale]
            outputs = [w.delassus.S, w.multiplier.S, w.residual.S, y.S]
            panels.cooperate(cable_block.kernels(s.variant).solve_rows, inputs, outputs)
            return
        if is_first:
            inputs = [m.dof_count, count, m.delassus_pair, y.S, f_scale * x_scale]
            s.each(k.delassus, len(m.delassus_pair), inputs, [w.delassus.S])
        static.free_gaps(x_scale, w.gap)
        free = self.sharing.keep(w.gap) if self.sharing is not None else w.gap
        inputs = [sweeps, w.delassus.S, w.lower_bound.S, w.upper_bound.S]
        outputs = [w.gap.S, w.multiplier.S, w.change.S, w.residual.S]
        if s.variant.world_fastest and count <= held_sweeps.MOST_ROWS:
            held = held_sweeps.kernels(s.variant, count)
            s.each_world(held.gauss_seidel, inputs, outputs, threads=held_sweeps.THREADS)
        else:
            s.each_world(k.gauss_seidel, [count, *inputs], outputs)
        if self.sharing is not None:
            tolerance = s.options.gap_tolerance(m.extent, x_scale)
            self.sharing.share(w.delassus, count, free, w.change, tolerance)
        inputs = [m.dof_count, count, w.change.S, f_scale]
        s.each(k.add_change, s.variant.parts(s.dof_rows), inputs, [y.S])


class ContactMultipliers(Multipliers):
    """Rows with compliance, rows without bounds, and contacts.

    Args:
        rows: Rows besides contacts.
        contact: Contacts, if the scene has any.
        unbounded: Static rows that are eliminated.
        peek: Trial positions of what contacts look at, after a factor times the velocities.
        measure_way: How much of the unknowns' way worlds go, in one of several Newton iterations.

    Attributes:
        guess: Velocities of the dofs that a linear solve corrects, where they are not 0.
    """

    def __init__(
        self,
        rows_: StaticRows,
        contact: ContactTerm | None,
        unbounded: Sequence[int],
        peek: Callable[[float], None],
        measure_way: Callable[[float, float], None],
    ) -> None:
        super().__init__(rows_)
        s, w, o = self.shard, self.shard.work, self.shard.options
        self.contact, self.peek, self.measure_way = contact, peek, measure_way
        self.is_iterated, self.part = o.newton_iterations > 1, 1.0
        self.k_looks = looks.kernels(s.variant)
        self.guess: Rows | None = None
        contacts = contact_list.allocate(s.variant, s.world_count, 0, s.device)
        if contact is not None:
            contacts = contact.contacts
            self.overflow, self.contact_forces = contacts.overflow, (contacts.multiplier,)
            self.corrections = o.iterated_passes if self.is_iterated else o.contact_passes
            if self.corrections and self.is_iterated:
                self.guess = s.rows(s.dof_room)
        further = s.options.further_passes if self.corrections else 0
        self.laws = ContactResponse(
            s.model.symbolic,
            self.linear.index,
            s.model.dof_free,
            s.variant,
            s.world_count,
            rows_.count,
            contacts,
            s.device,
            unbounded=unbounded,
            panels=self.linear.panels,
            laws=StaticLaws(w.compliance, w.floor, w.ceiling, w.residual),
            passes=self.corrections + further,
            slots=USUAL_SLOTS if contact is None else contact.model.slots,
            touch=touch_struct(s),
            subspace=None if contact is None else contact.subspace,
        )
        self.response = self.laws
        if contact is not None and further:
            self.further = FurtherLooks(s, contact, self.laws, self.linear.panels)

    def looks_ahead_of(self, velocities: Rows, part: float) -> bool:
        """Keep what the next solve corrects, if it looks at contacts where both lead to."""
        if self.guess is None or not self.is_iterated or not self.corrections:
            return False
        self.guess.copy_from(velocities)
        self.part = part
        return True

    def add_forces(self, target: Rows, f_scale: float) -> None:
        """target += f_scale H' multiplier of all rows."""
        self.rows.add_forces(target, f_scale)
        self.laws.add_forces(target, f_scale)

    def respond(self, f_scale: float, x_scale: float, correction: int) -> None:
        """Half-solve with the multipliers of static rows and contacts."""
        s, w, o, static, linear, laws = (
            self.shard,
            self.shard.work,
            self.shard.options,
            self.rows,
            self.linear,
            self.laws,
        )
        y, is_first = linear.y, correction == 0
        self.add_forces(y, f_scale)
        if is_first:
            laws.sides(linear)
        linear.forward(1 + static.count if is_first else 1)
        if is_first:
            laws.delassus(y, f_scale * x_scale)
        if static.count:
            static.free_gaps(x_scale, laws.gap)
        end = None
        if self.corrections and not is_first:
            end = self._look_ahead(f_scale, x_scale, again=correction > 1)
        if self.contact is not None and self.contact.subspace is not None:
            self.contact.subspace.expand(*self._moving(is_first))
        laws.gaps(
            y,
            u=w.u,
            v=w.dof_v,
            v0=w.dof_v0,
            x_scale=x_scale,
            recovery=o.recovery_speed,
            bounce_speed=o.bounce_speed,
            share=o.recovery_share(x_scale),
            end=end,
        )
        sweeps, tolerance = o.gauss_seidel_iterations, o.gap_tolerance(s.model.extent, x_scale)
        if self.further is not None and s.model.telescopes is not None and not is_first:
            sweeps = min(sweeps, FURTHER_SWEEPS)
        bounds, extent = (w.lower_bound, w.upper_bound), s.model.extent
        laws.solve(*bounds, w.multiplier, sweeps=sweeps, tolerance=tolerance, extent=extent)
        if self.sharing is not None:
            count = laws.contacts.count if laws.capacity else None
            self.sharing.share(laws.matrix, laws.order, laws.gap, laws.change, tolerance, laws.bounded, count)
        laws.add_change(y, f_scale)

    def _moving(self, is_first: bool) -> list[Rows]:
        """Velocities that are not known to be 0: unknowns so far, and what they are added to."""
        s, w = self.shard, self.shard.work
        is_known = self.guess is None and s.options.newton_iterations == 1
        starts = is_first and s.model.prescribed_dof.size == 0
        return [*([] if starts else [w.u]), *([] if is_known else [w.dof_v])]

    def _look_ahead(self, f_scale: float, x_scale: float, *, again: bool) -> Rows:
        """Distances of the contacts where the unknowns of the last pass lead to; new ones join the response."""
        assert self.contact is not None
        s, w = self.shard, self.shard.work
        if self.is_iterated:
            self.measure_way(x_scale, self.part)
            s.each_real(self.k_looks.go_part, s.dof_rows, [w.share_of_way.real, w.u.real], [w.dof_v.real])
        else:
            s.add(w.u, w.dof_v, s.dof_rows)
        self.peek(x_scale)
        end = self.contact.look(x_scale, again=again)
        if self.is_iterated:
            s.each_real(self.k_looks.extend, self.contact.model.capacity, [w.share_of_way.real], [end.real])
        if self.guess is None:
            w.dof_v.zero()
        else:
            w.dof_v.copy_from(self.guess)
        self.laws.sides(self.linear)
        self.laws.delassus(self.linear.y, f_scale * x_scale, late=True)
        return end
