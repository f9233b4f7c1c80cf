"""Backward Euler for all worlds of a shard. Theory: docs/theory/implicit_euler.md."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import warp as wp

from softwarp.kernels.step.newton import USUAL
from softwarp.solvers.newton_control import NewtonControl
from softwarp.solvers.system import System
from softwarp.solvers.terms.term import Pace


class ImplicitEuler:
    """M dv/dt = f(x, v) + H' multiplier, one step of length ``h`` [s] at a time, in place.

    As a stage of a longer step it has another ``pace``: how far that step has come with its commands; and Newton's
    method may start from velocities that ``predict`` has written.

    A step of a static solve shares the ``control`` of other steps, and may end Newton's method early: ``judged`` is
    asked after every iterate, which makes the host wait for it, and no graph can hold it. Unless it ``tells``, worlds
    whose iterations end above their tolerance say nothing of it. ``swings`` are the parts of ``Options.most_swing``
    that iterations may swing lines by, the last one for all that follow; without any, they are free. A ``brief`` step
    ends when all its worlds have converged; its control must hold their contacts.

    With one Newton iteration this is the linearly implicit scheme of SOFA's EulerImplicitSolver followed by its
    constraint correction; with more, the nonlinear equations are solved to ``Options.newton_tolerance``.
    """

    def __init__(
        self,
        system: System,
        h: float,
        pace: Pace | None = None,
        predict: Callable[[], None] | None = None,
        *,
        control: NewtonControl | None = None,
        iterations: int | None = None,
        judged: Callable[[], bool] | None = None,
        tells: bool = True,
        swings: Sequence[float] = (),
        brief: bool = False,
    ) -> None:
        self.system = system
        self.h = h
        self.pace = Pace(h, h, h) if pace is None else pace
        self.predict = predict
        self.tolerance = system.options.newton_tolerance
        self.iterations = system.options.newton_iterations if iterations is None else iterations
        self.control = (control or NewtonControl(system, steadies=True)) if self.iterations > 1 else None
        self.judged = judged
        steadies = self.control is not None and self.control.detector is not None
        self.goes_further, self.is_further = steadies and self.iterations >= USUAL, False
        self.swings, self.brief = swings, brief
        self.tells = tells and self.control is not None

    @property
    def always(self) -> bool:
        """Whether all is done without asking which worlds need it, as where a recording cannot branch."""
        return self.system.always

    @always.setter
    def always(self, value: bool) -> None:
        self.system.always = value

    def step(self) -> None:
        """Advance by one step."""
        self.advance()
        self.finish()

    def advance(self) -> None:
        """Find the velocities at the end of the step; nothing of the state changes."""
        system, h = self.system, self.h
        system.load()
        system.scale(h)
        system.measure_rows()
        system.command(h, self.pace)
        if self.control is None:
            system.find_contacts(h, moving=False, look=self.pace.look)
            system.forces()
            system.tangent()  # A = (1 + h a) M + h (h + b) K
            system.right_hand_side(h, inertia=True, moving=False)  # b = h f(x) + M v
            system.solve(h, h)  # A v = b + h H' multiplier
            system.restrain(h)
            system.add_unknowns()
        else:
            self._iterate(self.control)

    def finish(self) -> None:
        """Go there."""
        self.system.arrive(self.h)  # x += h v
        self.system.commit(self.h, 1.0, iterated=self.tells)

    def _iterate(self, control: NewtonControl) -> None:
        control.begin()
        self.system.check_velocities()
        if self.predict is not None:
            self.predict()
        self._evaluate(control, 0)
        for iteration in range(self.iterations):
            if self.judged is not None and self.judged():
                return
            if self.brief and not self.always:
                wp.capture_if(control.left, partial(self._improve, control, iteration))
            else:
                self._improve(control, iteration)
        if control.best_contacts:
            end = partial(control.find_best_contacts, self.h, self.pace.look)
            if self.brief and not self.always:
                wp.capture_if(control.left, end)
            else:
                end()
        if self.goes_further:
            self._go_further(control)

    def _go_further(self, control: NewtonControl) -> None:
        """Worlds that got stuck may take as many iterations again, in which contacts of earlier ones stay."""
        control.begin_further()
        self.is_further = True
        if self.always:
            self._take_further(control)
        else:
            wp.capture_if(control.left, partial(self._take_further, control))
        self.is_further = False
        control.end_further()

    def _take_further(self, control: NewtonControl) -> None:
        """They take them; those that have not converged even so go back to where they were."""
        system = self.system
        if self.always:
            for _ in range(self.iterations):
                self._further(control)
        else:
            wp.capture_while(control.left, partial(self._further, control))
        control.give_up()
        system.move(self.h)
        system.measure_rows()
        system.row_laws()
        system.find_contacts(self.h, moving=True, look=self.pace.look, keeps=True)
        control.hold_still()
        control.give_back()
        system.forces()

    def _further(self, control: NewtonControl) -> None:
        """One of these iterations."""
        self._improve(control, 0)
        control.count_further(self.iterations)

    def _evaluate(self, control: NewtonControl, iteration: int) -> None:
        """Forces, tangent and merit of an iterate."""
        system, h = self.system, self.h
        moving = iteration > 0 or self.predict is not None
        if moving:
            system.move(h)
            system.measure_rows()
            system.row_laws()
        system.find_contacts(h, moving=moving, look=self.pace.look, keeps=self.is_further)
        control.hold_still()
        system.forces()
        system.tangent()
        system.right_hand_side(h, inertia=True, moving=moving)
        system.imbalance(h, inertia=True)
        control.judge(first=iteration == 0, tolerance=self.tolerance, f_scale=h)
        control.keep(last=iteration == self.iterations and not self.goes_further)
        if self.brief:
            control.look_for_others()

    def _improve(self, control: NewtonControl, iteration: int) -> None:
        """The next iterate."""
        system, h = self.system, self.h
        part = self.swings[min(iteration, len(self.swings) - 1)] if self.swings else float("inf")
        looks = system.multipliers.looks_ahead_of(system.work.dof_v, part)
        system.solve(h, h)
        if looks:
            system.peek(h)  # back from where they were taken
        if self.swings:
            system.restrain(h, part)
        system.rotation_step(h)
        control.advance(h)
        self._evaluate(control, iteration + 1)
