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
STILL = 1.0e-3  # of the tolerance: way of a step of at least LOOSE_STEP that leaves nothing to go
EASY = 4  # Newton iterations up to which a step was an easy one
ROUNDING_WAY = {"float32": 2.0e-4, "float64": 1.0e-7}  # of the extent: ways of long steps that rounding can explain
ROUNDING_MERIT = {"float32": 5.0e-3, "float64": 1.0e-7}  # relative imbalance, likewise
NEAR = 1.0e-2  # of the extent: way of an easy step below which the next is much longer
STALL_LIMIT = 4  # longest steps whose ways do not fall, after which a world within rounding has arrived
LOOSE_STEP = 1.0  # s; so far the longest step falls where ways do not, as of bodies that are free to move
PATIENCE = 60  # the same, for a world above rounding
MOST_FAILURES = 40  # steps that fail without any progress between them
LEAP = 0.5  # of a step that went too far: the next, so that nothing is leapt over
AWAY = 30.0  # extents from the start: nothing holds the world
IDLE = 10  # short steps that go nowhere, after which a world has arrived whose softest motion is lost in rounding
STRAYED, DOUBTS = 1.0e-2, 40  # extents and steps: a world that goes less far in so many has arrived after all
MOST_INDEFINITE = 6  # steps in a row, each shorter, after which the exact tangent is not to be trusted
PUSH, MOST_PUSHES = 1.0e-4, 3  # of the extent: way of a push off an unstable equilibrium; in a solve
LEAVING, SHY = 2.0, 3  # ratio of a way to the last but one of a world that leaves by itself; saddles before a push
GOING_ON = -1  # instead of a reason


class Relaxation:
    """Steps of the worlds of one shard, of any length, with one control of Newton's method for all of them.

    Args:
        system: Shard, with ``Options.newton_iterations`` of its own.

    Attributes:
        settled: Step [s] with which the last solve found a world in equilibrium, 0 where it did not, shape (world,).
        rounds: Numbers of Newton iterations that a step is tried with, one after the other.
        longest: Longest step [s].
    """

    def __init__(self, system: System) -> None:
        self.system = system
        self.settled = np.zeros(system.world_count)
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

        The latter need not settle on one iterate where nothing but rounding is left to balance, as without loads. An
        imbalance says nothing of a world that no solve could move.
        """
        return self.frozen() | ((self._row(newton.WITHIN) > 0.5) & ~self.indefinite())

    def indefinite(self) -> Bools:
        """Worlds whose last solve failed, as it does where steps are too long to leave a saddle, shape (world,)."""
        return self._row(newton.FAILED) > 0.5

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
        settled: Step [s] with which the last solve found a world in equilibrium, shape (world,); worlds begin with it.
        precision: Of the model; says what rounding can explain.
        tolerance: Way of the longest step per extent of the scene below which a world has converged.
        levels: Numbers of Newton iterations that a step may be tried with.
        longest: Longest step [s].
        has_exact: Whether steps can take the exact tangent too, which may be indefinite, shape (world,).

    Attributes:
        h: Next step [s], shape (world,).
        level: Which number of Newton iterations it is tried with, shape (world,).
        exact: Whether it takes the exact tangent, shape (world,).
        way: Way of the last step per extent of the scene, shape (world,); infinite before the first that did not fail.
        longest: Longest step [s], shape (world,). It falls where steps of that length come to nothing.
        gone: Way since the start per extent of the scene, shape (world,).
        push: Way per extent that a push gives a world in its next step, shape (world,).
        reason: ``StaticReason`` or ``GOING_ON``, shape (world,).
        called_back: Whether a world is to stand again where it did when ``has_arrived`` told it last, shape (world,).
    """

    def __init__(
        self,
        settled: Floats,
        precision: str,
        tolerance: float,
        levels: int,
        longest: float,
        has_exact: Bools | None = None,
    ) -> None:
        worlds = len(settled)
        has_exact = np.zeros(worlds, dtype=bool) if has_exact is None else has_exact
        self.has_exact, self.exact = has_exact, np.zeros(worlds, dtype=bool)
        self._tried, self._verified = np.zeros(worlds, dtype=bool), np.zeros(worlds, dtype=bool)
        self._arrival, self._doubted = np.full(worlds, GOING_ON), np.full(worlds, GOING_ON)
        self._doubts, self._strayed = np.zeros(worlds, dtype=int), np.zeros(worlds)
        self._arrived, self.called_back = np.full(worlds, np.inf), np.zeros(worlds, dtype=bool)
        self._indefinite = np.zeros(worlds, dtype=int)
        self.tolerance, self.levels = tolerance, levels
        self.rounding_way, self.rounding_merit = ROUNDING_WAY[precision], ROUNDING_MERIT[precision]
        self.h, self.level = np.where(settled > 0.0, settled, FIRST_STEP), np.zeros(worlds, dtype=int)
        self.way = np.full(worlds, np.inf)
        self.reason = np.full(worlds, GOING_ON)
        self.longest = np.where(settled > 0.0, settled, longest)
        self.push, self._pushes = np.zeros(worlds), np.zeros(worlds, dtype=int)
        self._kept = np.full((worlds, 6), np.inf)  # ways of the last steps
        self._saddles, self._idle = np.zeros(worlds, dtype=int), np.zeros(worlds, dtype=int)
        self._last, self.gone = np.full(worlds, np.inf), np.zeros(worlds)
        self._longest, self._best, self._most = np.zeros(worlds), np.full(worlds, np.inf), np.zeros(worlds)
        self._stalled, self._failures = np.zeros(worlds, dtype=int), np.zeros(worlds, dtype=int)
        self._ceiling, self._succeeded = self.longest.copy(), np.zeros(worlds, dtype=int)
        self._shortest, self._is_shrinking = np.full(worlds, np.inf), np.zeros(worlds, dtype=bool)
        self._before, self._steady = np.zeros((worlds, 2)), np.zeros(worlds, dtype=int)  # length and way of a step

    def groups(self) -> Iterator[tuple[float, int, bool, Bools]]:
        """Step [s], level, whether the tangent is exact, and worlds of every group of those that step alike."""
        todo = self.reason == GOING_ON
        h, level, exact = self.h.copy(), self.level.copy(), self.exact.copy()
        for key in sorted({*zip(h[todo].tolist(), level[todo].tolist(), exact[todo].tolist(), strict=True)}):
            yield *key, todo & (h == key[0]) & (level == key[1]) & (exact == key[2])

    def judge(
        self,
        world: int,
        status: int,
        frozen: bool,
        taken: int,
        way: float,
        merit: float,
        indefinite: bool = False,
        gone: float = 0.0,
    ) -> bool:
        """Note how a step went; whether its result is kept.

        Args:
            world: Which.
            status: ``Status`` of the step.
            frozen: Whether its Newton iterations converged, or ended within rounding.
            taken: How many there were.
            way: Largest way of a node or frame per extent of the scene.
            merit: Relative imbalance where the iterations ended.
            indefinite: Whether the last solve failed.
            gone: Largest way since the start of the solve per extent of the scene.
        """
        failed = status >= Status.NONFINITE or not np.isfinite(way)
        if status > Status.NONFINITE and self.h[world] > FIRST_STEP:
            self._ceiling[world] = self.h[world] = LEAP * self.h[world]
            return False
        fair = not (failed or indefinite) and (frozen or merit <= self.rounding_merit)
        if not (failed or fair or indefinite) and self.level[world] < self.levels - 1:
            self.level[world] += 1
            return False
        self.level[world], self.push[world] = 0, 0.0
        if self._verify(world, indefinite) or self._try_other(world, fair or failed, indefinite):
            return False
        self._meet_saddle(world, indefinite)
        h = self.h[world]
        if fair and self._drifts(world, way):
            self._loosen(world)
            return False
        kept = fair or (not failed and h <= FIRST_STEP)
        if kept:
            self.way[world] = way
            self.gone[world] = gone
            self._kept[world] = *self._kept[world, 1:], way
        if kept and gone > AWAY:
            self.reason[world] = StaticReason.NO_EQUILIBRIUM
        elif fair and h >= self.longest[world]:
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
        if self.has_exact[world] and not self._verified[world] and 0 <= self.reason[world] <= StaticReason.ROUNDING:
            self._arrival[world], self.reason[world] = self.reason[world], GOING_ON
            self.exact[world] = True
        elif self._doubted[world] != GOING_ON:
            self._doubt(world, way if kept else 0.0)
        return kept

    def _verify(self, world: int, indefinite: bool) -> bool:
        """Whether this step was to tell if a world that has arrived is at a saddle, from which it is pushed.

        The tangent of other steps is never indefinite, and calls the straight shape of a column an equilibrium that
        should have buckled. What the exact one lacks, as the stiffness of moments that follow, may call others unstable
        that are not: they come back.
        """
        if self._arrival[world] == GOING_ON:
            return False
        self._verified[world] = True
        if indefinite:
            self.h[world], self._ceiling[world] = FIRST_STEP, self.longest[world]
            self._last[world] = self._best[world] = self._shortest[world] = np.inf
            self._longest[world], self._stalled[world], self._before[world] = 0.0, 0, 0.0
            self._doubted[world], self._arrived[world] = self._arrival[world], self.way[world]
            self._idle[world] = self._steady[world] = self._saddles[world] = 0
        else:
            self.reason[world] = self._arrival[world]
        self._arrival[world] = GOING_ON
        return True

    def _doubt(self, world: int, way: float) -> None:
        """A world that stays where it had arrived is no column that buckles: it is called back there."""
        self._strayed[world] += way
        self._doubts[world] += 1
        if self._strayed[world] > STRAYED:
            self._doubted[world] = GOING_ON
        elif self._doubts[world] >= DOUBTS and self.reason[world] in (GOING_ON, StaticReason.NO_EQUILIBRIUM):
            if not (self._leaves(world) or self._grows(world)):
                self.reason[world], self.way[world] = self._doubted[world], self._arrived[world]
                self.called_back[world] = True

    def has_arrived(self) -> Bools:
        """Worlds that stand where they have arrived, but are doubted and about to leave, shape (world,)."""
        found: Bools = (self._doubted != GOING_ON) & (self._doubts == 0)
        return found

    def _try_other(self, world: int, is_settled: bool, indefinite: bool) -> bool:
        """Whether a step that did not converge is tried again with the other tangent, before a shorter one.

        Not so where the exact one is indefinite: a shorter step leaves the place.
        """
        self._indefinite[world] = self._indefinite[world] + 1 if indefinite else 0
        stays = is_settled or (indefinite and self._indefinite[world] < MOST_INDEFINITE)
        if stays or not self.has_exact[world] or self._tried[world]:
            self._tried[world] = False
            return False
        self.exact[world] = not self.exact[world]
        self._tried[world] = True
        return True

    def _meet_saddle(self, world: int, indefinite: bool) -> None:
        """A world at rest that no longer step can leave is pushed, unless it leaves by itself.

        That is the better way: loads that bend a column by a ten-millionth are felt then, and no push leads aside, from
        where the softest of motions goes round the axis. Longer and shorter steps take turns there.
        """
        if indefinite and self.way[world] <= self.rounding_way:
            self._saddles[world] += 1
            if self._saddles[world] > SHY and not self._leaves(world):
                self._push(world)

    def _leaves(self, world: int) -> bool:
        """Whether ways grow from step to step."""
        return bool(self._kept[world, -1] > LEAVING * self._kept[world, -3])

    def _grows(self, world: int) -> bool:
        """Whether ways grow slowly: the last two beside the two four steps before, for short steps take turns."""
        return bool(self._kept[world, -2:].max() > LEAVING * self._kept[world, :2].max())

    def _push(self, world: int) -> None:
        """Give a world velocities in its next step."""
        if self._pushes[world] < MOST_PUSHES:
            self.push[world] = PUSH
            self._pushes[world] += 1

    def _lengthen(self, world: int, *, is_easy: bool) -> None:
        """A longer step is next, up to a ceiling below the last one that failed."""
        self._succeeded[world] += 1
        if self._succeeded[world] % COURAGE == 0:
            self._ceiling[world] = min(2.0 * self._ceiling[world], self.longest[world])
        growth = EASY_GROWTH if is_easy else GROWTH
        if self._ceiling[world] < self.longest[world]:
            growth = CAREFUL_GROWTH
        self.h[world] = min(self.h[world] * growth, self._ceiling[world])

    def _follow_series(self, world: int, way: float, frozen: bool) -> None:
        """Where steps stay short: whether what is left of the geometric series of equal ones is small enough."""
        length, before = self._before[world]
        speed = self.h[world] / length if length > 0.0 else 1.0  # a longer step goes farther, up to its square
        ratio = way / before if before > 0.0 and speed == 1.0 else 1.0
        self._is_shrinking[world] = way < SLOW * before * max(1.0, speed) ** 2
        is_long = self.h[world] >= LOOSE_STEP
        is_little = ratio < SLOW and way * ratio / (1.0 - ratio) <= self.tolerance
        is_little = frozen and (is_little or (is_long and way <= STILL * self.tolerance))
        self._steady[world] = self._steady[world] + 1 if is_little else 0
        self._before[world] = self.h[world], way
        if self._steady[world] >= STEADY:
            self._settle(world, StaticReason.CONVERGED)
        is_idle = frozen and way <= self.tolerance and self.h[world] >= FIRST_STEP
        self._idle[world] = self._idle[world] + 1 if is_idle else 0
        if not is_idle:
            self._saddles[world] = 0
        elif self._idle[world] >= IDLE and (is_long or self._pushes[world] >= MOST_PUSHES):
            self._settle(world, StaticReason.ROUNDING)

    def _settle(self, world: int, reason: StaticReason) -> None:
        """It has arrived; where the tangent has been indefinite, only if it comes back from pushes."""
        if self._doubted[world] == GOING_ON or self._pushes[world] >= MOST_PUSHES:
            self.reason[world] = reason
        else:
            self._push(world)

    def _arrive(self, world: int, status: int, frozen: bool, way: float) -> None:
        """A step as long as they get: whether the world stands still.

        After the last length nothing is left to go but its way. After a shorter one there is the rest of the geometric
        series that the last two ways begin.
        """
        left = way
        if self.longest[world] < LAST_STEP:
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
        elif self._stalled[world] >= STALL_LIMIT and self.longest[world] > LOOSE_STEP:
            self._loosen(world)
        elif self._stalled[world] >= PATIENCE:
            self.reason[world] = StaticReason.NO_EQUILIBRIUM

    def _drifts(self, world: int, way: float) -> bool:
        """Whether a longer step moves a world that was at rest more than shorter ones did: by rounding alone."""
        was_at_rest = self.way[world] <= self.rounding_way and self.longest[world] > LOOSE_STEP
        return bool(was_at_rest and self.h[world] > LOOSE_STEP and way > max(2.0 * self.way[world], self.tolerance))

    def _loosen(self, world: int) -> None:
        """Longest steps come to nothing: a tenth of their length is the longest from now on.

        In a step of length h the inertia of free motions drowns in h^2 K, and the rounding of forces moves them by its
        square.
        """
        self.longest[world] = max(0.1 * min(self.h[world], self.longest[world]), LOOSE_STEP)
        self.h[world] = self._ceiling[world] = self.longest[world]
        self._last[world] = self._best[world] = np.inf
        self._stalled[world], self._most[world] = 0, 0.0

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
