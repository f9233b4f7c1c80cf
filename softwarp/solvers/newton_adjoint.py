"""The adjoint of a step that Newton's method has solved. Theory: docs/theory/adjoint.md."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from typing import Any

import warp as wp

from softwarp.kernels.step import newton_adjoint
from softwarp.model import memory
from softwarp.model.gradients import Gradients
from softwarp.solvers.adjoint import StepAdjoint
from softwarp.solvers.adjoint_index import AdjointIndex
from softwarp.solvers.implicit_euler import ImplicitEuler
from softwarp.solvers.leaning_adjoint import LeaningFrames
from softwarp.solvers.newton_contacts import EndContacts
from softwarp.solvers.newton_joints import EndJoints
from softwarp.solvers.stage_adjoint import StageAdjoint
from softwarp.solvers.terms.joints import JointTerm
from softwarp.solvers.workspace.rows import Rows

MOST = 400  # times that a gradient goes on
TOLERANCE = {"float32": 3.0e-6, "float64": 1.0e-12}  # of a gradient: by how much it changes last
ROUNDING = {"float32": 1.0e-3, "float64": 1.0e-9}  # likewise, where that does not become smaller any more


class NewtonAdjoint(StageAdjoint):
    """Pulls gradients by the end of a step or stage that has converged back to its start.

    The step is that of a stage which is linearised with the velocities that Newton's method has found. As these follow
    from themselves, so does the gradient by them: it goes on until it stays, as fast as Newton's method did, once with
    an exact tangent.

    Args:
        stepper: Takes the step; its system has the state that it started from.
        gradients: Arrays of these worlds, read and written.
        index: Of the model.
        rest: Whether gradients by the rest shape are asked for.

    Attributes:
        adrift: Not 0 in worlds whose gradient did not come to stay, until somebody clears it.
    """

    follows = 0.0
    keeps = True
    touches = EndContacts

    def __init__(
        self, stepper: ImplicitEuler, gradients: Gradients, index: AdjointIndex, *, rest: bool = False
    ) -> None:
        super().__init__(stepper.system, stepper.h, stepper.pace, self._recall, gradients, index, rest=rest)
        self.stepper, self.surface, s = stepper, None, self.shard
        self.k_newton = newton_adjoint.kernels(s.variant)
        self.found_v = s.rows(s.dof_room)
        self.given, self.total = s.rows(s.dof_rows), s.rows(s.dof_rows)
        self.start_frames = s.rows(6 * max(self.model.frame_count, 1))
        self.start_offset = s.rows(1 if self.frames is None else self.frames.offset.real.shape[1])
        self.control = s.rows(newton_adjoint.ROWS)
        self.sooner = s.rows(s.dof_rows)
        if self.contact is not None:
            self.contact.u = self.start_v
        term = next((term for term in self.system.terms if isinstance(term, JointTerm)), None)
        self.joints: EndJoints | None = None
        if term is not None and isinstance(self.frames, LeaningFrames):
            self.joints = EndJoints(self, term, self.frames)
        self.keeps_sides = self.contact is not None or self.joints is not None
        self.is_last = False
        self.left = memory.zeros((1,), wp.int32, s.device)
        self.adrift = memory.zeros((s.packs, 1, s.lanes), wp.int32, s.device)
        held: dict[str, Any] = {each.name: getattr(gradients, each.name) for each in fields(gradients)}
        self.aside = replace(gradients, **{name: wp.zeros_like(array) for name, array in held.items()})

    @property
    def solution(self) -> list[wp.array]:
        """Nothing is kept of a step."""
        return []

    def _recall(self) -> None:
        """The velocities that the step has found; the tangent of pressures, on which no end depends, is left out."""
        self.shard.work.dof_v.copy_from(self.found_v)
        self.shard.work.pressure_share.zero()

    def solve_again(self) -> None:
        """Take the step to its end, and linearise it there."""
        self.stepper.advance()
        self.found_v.copy_from(self.shard.work.dof_v)
        joints = self.joints
        if joints is not None:
            joints.term.stiffens = False  # A as it is without loads; no end depends on it
        super().solve_again()
        if joints is not None:
            joints.term.stiffens = True
            joints.find_kept(self.final_v)

    def _note_start(self) -> None:
        if self.joints is not None:
            self.joints.note_start()

    def pull(self, *, parameters: bool = True) -> None:
        """As of ``StepAdjoint``."""
        StepAdjoint._seed(self)
        if self.joints is not None:
            self.joints.begin(self.seed)
        if self.frames is not None:
            self.start_frames.copy_from(self.frames.start)
            self.start_offset.copy_from(self.frames.offset)
        self.given.copy_from(self.seed)
        self.total.copy_from(self.seed)
        self.control.zero()
        self.is_last = False
        if self.keeps_sides:
            self.solve(0)  # half-solved sides of all rows, and W
        self.left.fill_(1)
        wp.capture_while(self.left, self._go_on)
        self._respond()
        self.to_commands()
        self.is_last = True
        if self.joints is not None:
            self.joints.to_motors()
        self.to_start(parameters=parameters)
        if self.joints is not None:
            self.joints.end()

    def _go_on(self) -> None:
        """The gradient by the velocities that the step ends with, once more."""
        s, m, precision = self.shard, self.model, self.model.precision
        with self._aside():
            self._respond()
            self.to_commands()
            self.to_start(parameters=False)
        self.left.zero_()
        inputs = [3 * m.dof_count, TOLERANCE[precision], ROUNDING[precision], float(MOST), m.dof_free]
        inputs += [self.given.real, self.ahead.real]
        outputs = [self.total.real, self.control.real, self.adrift, self.left]
        s.each_real(self.k_newton.go_on, None, inputs, outputs)

    def _respond(self) -> None:
        """p and q of the gradient by these velocities."""
        y = self.system.linear.y
        self.seed.copy_from(self.total)
        if not self.keeps_sides:
            y.zero()
            self.shard.add(self.total, y, self.shard.dof_rows)
        if isinstance(self.frames, LeaningFrames):
            self.frames.start.copy_from(self.start_frames)
            self.frames.offset.copy_from(self.start_offset)
            self.frames.turn_seed(self.seed, y, self.solved_v)
            self.shard.work.dof_v.copy_from(self.solved_v)
        self.p.zero()
        self.q.zero()
        if not self.keeps_sides:
            self._find()
            return
        if self.contact is not None:
            self.contact.z.zero()
        for correction in range(1 + self.system.options.refinement):
            self.solve(1 + correction)  # the sides of rows stand

    def _meet(self) -> Rows:
        """Add what contacts and joints have where the step ends."""
        sooner, there = self.sooner, None
        if isinstance(self.frames, LeaningFrames):
            there, sooner = self.frames.there, self.frames.sooner
            there.zero()
        sooner.zero()
        if self.joints is not None and there is not None:
            self.joints.meet(there, sooner, last=self.is_last)
        if not isinstance(self.contact, EndContacts):
            return self.seed
        self.contact.meet(self.p, self.node_bar, there, sooner)
        self.other_seed.copy_from(self.seed)
        self.contact.add_forces(self.other_seed)
        self.shard.add(sooner, self.other_seed, self.shard.dof_rows)
        return self.other_seed

    @contextmanager
    def _aside(self) -> Iterator[None]:
        """Gradients by what the step reads are written where nobody reads them."""
        parts = [part for part in (self, self.frames, self.leaning, self.contact) if part is not None]
        held = self.gradients
        for part in parts:
            part.gradients = self.aside
        try:
            yield
        finally:
            for part in parts:
                part.gradients = held
