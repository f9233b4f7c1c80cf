"""Equilibrium of scenes with rods, rigid bodies, chambers or contact: implicit steps without momentum.

A step of length h from rest minimises the energy plus |change|^2_M / (2 h^2); after it velocities are dropped. A mode
of frequency w shrinks by 1 / (1 + h^2 w^2) a step, so h grows while Newton's method converges and shrinks where it does
not, in every world by itself. Theory: docs/theory/statics.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from softwarp.kernels.step import newton
from softwarp.model.codes import StaticReason, Status
from softwarp.solvers.implicit_euler import ImplicitEuler
from softwarp.solvers.newton_control import NewtonControl
from softwarp.solvers.system import System

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]

NEWTON_ITERATIONS = 25  # per step, at most
ROUNDS = (5, 10, NEWTON_ITERATIONS)  # Newton iterations that are tried one after the other where contacts forbid a stop
FIRST_STEP, LEAST_STEP, LAST_STEP = 0.05, 1.0e-3, 1.0e4  # s
CONTACT_STEP = 1.0  # s; longest step with contacts, whose forces drown in the stiffness of longer ones
GROWTH, EASY_GROWTH, REDUCTION = 3.0, 10.0, 0.25
CEILING, COURAGE, CAREFUL_GROWTH = 0.6, 10, 2.0  # of a step that failed; doubled after so many that did not; below it
SLOW, STEADY = 0.95, 3  # ratio of ways of equal steps up to which they tell what is left, if so many agree
EASY = 4  # Newton iterations up to which a step was an easy one
ROUNDING_WAY = {"float32": 2.0e-4, "float64": 1.0e-7}  # of the extent: ways of long steps that rounding can explain
ROUNDING_MERIT = {"float32": 5.0e-3, "float64": 1.0e-7}  # relative imbalance, likewise
NEAR = 1.0e-2  # of the extent: way of an easy step below which the next is much longer
STALL_LIMIT = 4  # longest steps whose ways do not fall, after which a world within rounding has arrived
PATIENCE = 60  # the same, for a world above rounding
MOST_FAILURES = 40  # steps that fail without any progress between them
GOING_ON = -1  # instead of a reason


class Relaxation:
    """Steps of the worlds of one shard, of any length, with one control of Newton's method for all of them.

    Args:
        system: Shard, with ``Options.newton_iterations`` of its own.

    Attributes:
        settled: Worlds whose last solve has ended in equilibrium, shape (world,).
        rounds: Numbers of Newton iterations that a step is tried with, one after the other.
        longest: Longest step [s].
    """

    def __init__(self, system: System) -> None:
        self.system = system
        self.settled = np.zeros(system.world_count, dtype=bool)
        self.control = NewtonControl(system)
        self.has_contacts = bool(system.multipliers.contact_forces)
        self.longest = CONTACT_STEP if self.has_contacts else LAST_STEP
        self.rounds = ROUNDS if self.has_contacts else ROUNDS[-1:]

    def step(self, h: float, level: int, wanted: Bools, interrupted: Callable[[], bool]) -> int:
        """One step from rest; Newton iterations that it took.

        It ends with the iterate that is the last of the ``wanted`` worlds to converge. More iterations would change no
        converged world, but for the forces of its contacts: with contacts it always takes all of them, so that a world
        does not depend on its neighbours.

        Args:
            h: Length [s].
            level: Index of the number of iterations in ``rounds``.
            wanted: Worlds that count, shape (world,).
            interrupted: Whether to stop at once, asked after every iterate; the step is then of no use.
        """
        taken = -1

        def judged() -> bool:
            nonlocal taken
            taken += 1
            return interrupted() or (not self.has_contacts and bool(self.frozen()[wanted].all()))

        ImplicitEuler(self.system, h, control=self.control, iterations=self.rounds[level], judged=judged).step()
        return taken

    def frozen(self) -> Bools:
        """Worlds whose Newton iterations have converged, shape (world,); reads back to the host."""
        return self._row(newton.FROZEN) > 0.5

    def balanced(self) -> Bools:
        """Worlds that have converged, or end with an imbalance that rounding explains, shape (world,); reads back.

        The latter need not settle on one iterate where nothing but rounding is left to balance, as without loads.
        """
        return self.frozen() | (self._row(newton.WITHIN) > 0.5)

    def merit(self) -> Floats:
        """Relative imbalance of the last accepted iterate, shape (world,); reads back to the host."""
        return self._row(newton.MERIT)

    def _row(self, row: int) -> Floats:
        values = self.system.work.control.real.numpy()[:, row, :]
        return np.asarray(values.reshape(-1)[: self.system.world_count], dtype=np.float64)


class Course:
    """How far the worlds have come: length of the next step, way of the last, and why a world is done.

    Nothing here depends on other worlds.

    Args:
        settled: Worlds that the last solve brought to equilibrium, shape (world,); they begin with the longest step.
        precision: Of the model; says what rounding can explain.
        tolerance: Way of the longest step per extent of the scene below which a world has converged.
        levels: Numbers of Newton iterations that a step may be tried with.
        longest: Longest step [s].

    Attributes:
        h: Next step [s], shape (world,).
        level: Which number of Newton iterations it is tried with, shape (world,).
        way: Way of the last step per extent of the scene, shape (world,); infinite before the first that did not fail.
        reason: ``StaticReason`` or ``GOING_ON``, shape (world,).
    """

    def __init__(self, settled: Bools, precision: str, tolerance: float, levels: int, longest: float) -> None:
        worlds = len(settled)
        self.tolerance, self.levels = tolerance, levels
        self.rounding_way, self.rounding_merit = ROUNDING_WAY[precision], ROUNDING_MERIT[precision]
        self.h, self.level = np.where(settled, longest, FIRST_STEP), np.zeros(worlds, dtype=int)
        self.way = np.full(worlds, np.inf)
        self.reason = np.full(worlds, GOING_ON)
        self.longest, self._last = longest, np.full(worlds, np.inf)
        self._longest, self._best, self._most = np.zeros(worlds), np.full(worlds, np.inf), np.zeros(worlds)
        self._stalled, self._failures = np.zeros(worlds, dtype=int), np.zeros(worlds, dtype=int)
        self._ceiling, self._succeeded = np.full(worlds, longest), np.zeros(worlds, dtype=int)
        self._shortest, self._is_shrinking = np.full(worlds, np.inf), np.zeros(worlds, dtype=bool)
        self._before, self._steady = np.zeros((worlds, 2)), np.zeros(worlds, dtype=int)  # length and way of a step

    def groups(self) -> Iterator[tuple[float, int, Bools]]:
        """Step [s], level and worlds of every group of those under way that step alike."""
        todo = self.reason == GOING_ON
        h, level = self.h.copy(), self.level.copy()
        for pair in sorted({*zip(h[todo].tolist(), level[todo].tolist(), strict=True)}):
            yield *pair, todo & (h == pair[0]) & (level == pair[1])

    def judge(self, world: int, status: int, frozen: bool, taken: int, way: float, merit: float) -> bool:
        """Note how a step went; whether its result is kept.

        Args:
            world: Which.
            status: ``Status`` of the step.
            frozen: Whether its Newton iterations converged, or ended within rounding.
            taken: How many there were.
            way: Largest way of a node or frame per extent of the scene.
            merit: Relative imbalance where the iterations ended.
        """
        failed = status >= Status.NONFINITE or not np.isfinite(way)
        fair = not failed and (frozen or merit <= self.rounding_merit)
        if not (failed or fair) and self.level[world] < self.levels - 1:
            self.level[world] += 1
            return False
        self.level[world] = 0
        h = self.h[world]
        kept = fair or (not failed and h <= FIRST_STEP)
        if kept:
            self.way[world] = way
        if fair and h >= self.longest:
            self._longest[world] = h
            self._arrive(world, status, frozen, way)
        elif not fair:
            self._shorten(world, failed)
        else:
            if h > self._longest[world] or way <= 0.5 * self._shortest[world]:
                self._longest[world] = max(h, self._longest[world])
                self._shortest[world], self._failures[world] = way, 0
            self._follow_series(world, way, frozen)
            self._lengthen(world, is_easy=taken <= EASY and way <= NEAR)
        return kept

    def _lengthen(self, world: int, *, is_easy: bool) -> None:
        """A longer step is next, up to a ceiling below the last one that failed."""
        self._succeeded[world] += 1
        if self._succeeded[world] % COURAGE == 0:
            self._ceiling[world] = min(2.0 * self._ceiling[world], self.longest)
        growth = EASY_GROWTH if is_easy else GROWTH
        if self._ceiling[world] < self.longest:
            growth = CAREFUL_GROWTH
        self.h[world] = min(self.h[world] * growth, self._ceiling[world])

    def _follow_series(self, world: int, way: float, frozen: bool) -> None:
        """Where steps stay short: whether what is left of the geometric series of equal ones is small enough."""
        length, before = self._before[world]
        speed = self.h[world] / length if length > 0.0 else 1.0  # a longer step goes farther, up to its square
        ratio = way / before if before > 0.0 and speed == 1.0 else 1.0
        self._is_shrinking[world] = way < SLOW * before * max(1.0, speed) ** 2
        is_little = frozen and ratio < SLOW and way * ratio / (1.0 - ratio) <= self.tolerance
        self._steady[world] = self._steady[world] + 1 if is_little else 0
        self._before[world] = self.h[world], way
        if self._steady[world] >= STEADY:
            self.reason[world] = StaticReason.CONVERGED

    def _arrive(self, world: int, status: int, frozen: bool, way: float) -> None:
        """A step as long as they get: whether the world stands still.

        After the last length nothing is left to go but its way. After a shorter one there is the rest of the geometric
        series that the last two ways begin.
        """
        left = way
        if self.longest < LAST_STEP:
            ratio = way / self._last[world] if self._last[world] > 0.0 else 0.0
            ratio = ratio if np.isfinite(self._last[world]) else 1.0
            left = way * max(1.0, ratio / (1.0 - ratio)) if ratio < 1.0 else np.inf
        self._last[world] = way
        if way <= 0.5 * self._best[world]:
            self._best[world], self._stalled[world], self._failures[world], self._most[world] = way, 0, 0, 0.0
        else:
            self._stalled[world] += 1
        self._most[world] = max(self._most[world], way)
        there = frozen and left <= self.tolerance
        if there or (self._stalled[world] >= STALL_LIMIT and self._most[world] <= self.rounding_way):
            reached = StaticReason.CONVERGED if there else StaticReason.ROUNDING
            self.reason[world] = StaticReason.CONTACT_OVERFLOW if status == Status.CONTACT_OVERFLOW else reached
        elif self._stalled[world] >= PATIENCE:
            self.reason[world] = StaticReason.NO_EQUILIBRIUM

    def _shorten(self, world: int, failed: bool) -> None:
        """A step failed or did not converge: a shorter one is next."""
        self._failures[world] += 1
        if failed and self.h[world] <= LEAST_STEP:
            self.reason[world] = StaticReason.NOT_FINITE
        elif self._failures[world] >= MOST_FAILURES:
            self.reason[world] = StaticReason.NO_EQUILIBRIUM
        if self._is_shrinking[world]:
            self._ceiling[world], self._succeeded[world] = max(CEILING * self.h[world], LEAST_STEP), 0
        shorter = max(self.h[world] * REDUCTION, LEAST_STEP)
        if self._longest[world] == 0.0 and self.h[world] > FIRST_STEP:
            shorter = FIRST_STEP  # the longest step was too bold a start
        self.h[world] = shorter
