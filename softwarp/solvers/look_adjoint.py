"""Steps that look at contacts where they lead to, in the adjoint and its transpose: that of their first solution.

Contacts of the last solution may have distances that were measured where the first one leads to. What they have of it
seeds an adjoint of its own, with the same factor. Equations: docs/theory/adjoint.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

import warp as wp

from softwarp.kernels.rows import look_adjoint
from softwarp.model import memory
from softwarp.model.gradients import FLOATING, FRAMES, MEMORIES, MODES, STATE, Gradients
from softwarp.solvers.adjoint import StepAdjoint
from softwarp.solvers.adjoint_index import AdjointIndex
from softwarp.solvers.contact_adjoint import ContactAdjoint
from softwarp.solvers.second_order import PredictedEuler
from softwarp.solvers.stage_adjoint import StageAdjoint
from softwarp.solvers.system import System
from softwarp.solvers.workspace.rows import Rows


class FirstSolution:
    """What a step leaves of its first solution, and what contacts look at; see ``touch_adjoint``.

    Args:
        system: Worlds, with contacts.
        h: Step [s].
        guess: Velocities that solutions come on top of, in a stage that is linearised with them.

    Attributes:
        u, row, force: Velocities of the first solution, its forces of static rows and of contacts.
        look: What the normal laws of contacts look at.
        normal: Normals of contacts where the first solution leads to.
        any: Whether any contact looks there.
    """

    def __init__(self, system: System, h: float, guess: Rows | None = None) -> None:
        assert system.contact is not None
        self.guess = guess
        self.system, self.h, self.shard, self.term = system, h, system.shard, system.contact
        s, capacity = self.shard, self.term.contacts.capacity
        self.k, self.contacts = look_adjoint.kernels(s.variant), self.term.contacts
        self.term.late = s.integers(1)
        self.u, self.row = s.rows(3 * s.model.dof_room), s.rows(max(s.model.row_count, 1))
        self.force, self.normal = s.rows(3 * capacity), s.rows(3 * capacity)
        self.look, self.no_look = s.integers(capacity), s.integers(capacity)
        self.any = memory.zeros((1,), wp.int32, s.device)

    @classmethod
    def of(cls, system: System, h: float) -> FirstSolution:
        """That of a system, which keeps one."""
        kept = getattr(system.watch, "__self__", None)
        if not isinstance(kept, cls):
            kept = cls(system, h)
            system.watch = kept.keep
        return kept

    @property
    def arrays(self) -> list[wp.array]:
        """All that a step leaves."""
        return [part.real for part in (self.u, self.row, self.force, self.look, self.normal)]

    def keep(self, number: int) -> None:
        """Keep the first solution of a step; after the last one, what the laws of contacts look at."""
        s, w, c, o = self.shard, self.shard.work, self.contacts, self.system.options
        if number == 0:
            self.u.copy_from(w.u)
            if self.guess is not None:
                s.add(self.guess, self.u, s.dof_rows)
            if self.term.subspace is not None:
                self.term.subspace.expand(self.u)
            if s.model.row_count:
                self.row.copy_from(w.multiplier)
            inputs = [c.listed.real, c.multiplier.real]
            s.each_real(self.k.first_forces, c.capacity, inputs, [self.force.real])
            return
        assert self.term.late is not None
        inputs = [self.h, o.recovery_share(self.h), o.recovery_speed, o.bounce_speed]
        inputs += [c.count.real, c.listed.real, self.term.late.real, c.dof.real, c.weight.real, c.lever.real]
        inputs += [c.axes.real, c.point.real, c.gap.real, c.restitution.real, c.compliance.real, c.multiplier.real]
        inputs += [w.dof_v0.real, self.u.real, w.contact_end.real, self.term.detector.touch.real]
        s.each_real(self.k.looks, c.capacity, inputs, [self.look.real, self.normal.real])

    def find_any(self) -> None:
        """Whether any contact looks where the first solution leads to."""
        self.any.zero_()
        c = self.contacts
        self.shard.each_real(self.k.any_look, c.capacity, [c.count.real, self.look.real], [self.any])

    def place(self) -> None:
        """Put velocities and forces of the first solution in the place of those of the last one."""
        w = self.shard.work
        self.contacts.multiplier.copy_from(self.force)
        w.dof_v.copy_from(self.u)
        if self.shard.model.row_count:
            w.multiplier.copy_from(self.row)


class Looking(StepAdjoint):
    """Adjoint of what looks once at contacts where its first solution leads to; see ``StepAdjoint``.

    Worlds in which no contact that pushes has anything of that look add 0, and if there are no others, the first
    solution is left out.
    """

    first: FirstSolution

    def _look_at(self, first: FirstSolution) -> None:
        """Room, and what the first solution leaves."""
        assert self.contact is not None
        s, gradients = self.shard, self.gradients
        self.first = first
        self.k_look, self.contacts = self.first.k, self.contact.contacts
        self.v, self.extra = (s.rows(3 * self.model.dof_room) for _ in range(2))
        self.ways = s.rows(3 * self.contacts.capacity)
        turns = self.modes is not None and self.modes.frames is not None
        self.later = s.rows(3 * self.model.dof_room) if turns else None  # on nodes, which turn
        self.contact.look, self.contact.u, self.contact.normal = self.first.look, self.first.u, self.first.normal
        self.contact.first_force = self.first.force
        g = gradients
        self.before = None if self.modes is None else wp.zeros_like(g.node_v)  # what of late contacts goes to modes
        self.comes_first = False  # whether the first solution is differentiated
        names = [*STATE, *FRAMES, *MEMORIES, *MODES, *FLOATING]
        names += [f.name for f in fields(g) if f.name.startswith("command_")]
        parts = [(name, getattr(g, name)) for name in names]
        self.sums = {
            name: (part, *(wp.zeros(part.shape, dtype=part.dtype, device=s.device) for _ in range(2)))
            for name, part in parts
            if part.size
        }  # a gradient, by the end of the first solution's way, and what it was before

    def pull(self, *, parameters: bool = True) -> None:
        """As of ``StepAdjoint``."""
        super().pull(parameters=parameters)
        self.first.find_any()
        wp.capture_if(self.first.any, lambda: self._pull_first(parameters=parameters))

    def _pull_first(self, *, parameters: bool) -> None:
        """Add what contacts have of the first solution."""
        assert self.contact is not None
        s, c, k = self.shard, self.contacts, self.k_look
        self._look_back()
        s.each_real(k.ways, c.capacity, [c.count.real, self.first.look.real, self.contact.z.real], [self.ways.real])
        for bar, part, total in self.sums.values():
            s.each_real(k.hand_over, s.variant.parts(bar.shape[1]), [s.lanes, part], [bar, total])
        c.multiplier.copy_from(self.ways)
        self.extra.zero()
        self.contact.laws.add_forces(self.extra, self.h)
        if self.later is not None:
            self.contact.laws.push(self.h, self.later)
        self._place_first()
        self._seed(first=False)
        s.add(self.extra, self.seed, s.dof_rows)
        for correction in range(1 + self.system.options.refinement):
            self.solve(1 + correction)
        self.to_commands()
        self.contact.look, self.contact.later = self.first.no_look, self.later
        self.comes_first = True
        self.to_start(parameters=parameters)
        self.comes_first = False
        self.contact.look, self.contact.later = self.first.look, None
        for bar, _part, total in self.sums.values():
            s.each_real(k.take_back, s.variant.parts(bar.shape[1]), [s.lanes, total], [bar])

    def _contacts_to_state(self, contact: ContactAdjoint) -> None:
        super()._contacts_to_state(contact)
        if self.comes_first and self.before is not None and self.modes is not None:
            s, bar, m = self.shard, self.gradients.node_v, self.modes.model
            if self.modes.has_sums:
                inputs = [s.lanes, m.node, self.before]
                s.each_real(self.k_look.take_listed, int(m.node.size), inputs, [self.modes.listed_v.real])
            else:
                s.each_real(self.k_look.take_back, s.variant.parts(bar.shape[1]), [s.lanes, self.before], [bar])

    def _look_back(self) -> None:
        """Gradients by where everything is at the end of the first solution's way."""
        assert self.contact is not None
        w = self.shard.work
        self.v.copy_from(w.dof_v)
        w.dof_v.copy_from(self.first.u)
        self.system.peek(self.h)
        w.dof_v.copy_from(self.v)
        x_bar, pose_bar = (self.sums[name][1] if name in self.sums else None for name in ("node_x", "frame_pose"))
        for part in (x_bar, pose_bar, self.before):
            if part is not None:
                part.zero_()
        self.contact.to_end(self.p, x_bar, pose_bar, self.before)
        self._return()

    def _place_first(self) -> None:
        """Put what the first solution has found in the place of what the last one has."""
        self.first.place()

    def _return(self) -> None:
        """Put everything where elements and rows have it."""
        self._start_over()


class LookStepAdjoint(Looking):
    """Such a step, as of ``StepAdjoint``."""

    def __init__(
        self, system: System, h: float, gradients: Gradients, index: AdjointIndex, *, rest: bool = False
    ) -> None:
        super().__init__(system, h, gradients, index, rest=rest)
        self._look_at(FirstSolution.of(system, h))

    @property
    def solution(self) -> list[wp.array]:
        """As of ``StepAdjoint``, with the first solution and what contacts look at."""
        return [*super().solution, *self.first.arrays]


class LookStageAdjoint(Looking, StageAdjoint):
    """Such a stage of a longer step, as of ``StageAdjoint``."""

    def __init__(
        self,
        step: PredictedEuler,
        gradients: Gradients,
        index: AdjointIndex,
        heed: Callable[[Rows], None] | None = None,
        *,
        rest: bool = False,
    ) -> None:
        super().__init__(step.system, step.h, step.pace, step.predict, gradients, index, step.judge, heed, rest=rest)
        self._look_at(FirstSolution(step.system, step.h, self.start_v))

    def solve_again(self) -> None:
        """As of ``StageAdjoint``; another stage of the same worlds may have watched the last solve."""
        self.system.watch = self.first.keep
        super().solve_again()
        self.v.copy_from(self.shard.work.dof_v)
        self._return()

    def _place_first(self) -> None:
        super()._place_first()
        self.solved_v.copy_from(self.first.u)
        self.final_v.copy_from(self.first.u)

    def _return(self) -> None:
        v = self.shard.work.dof_v
        v.copy_from(self.start_v)
        self.system.move(self.h)
        v.copy_from(self.v)
