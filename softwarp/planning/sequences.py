"""What planners of continuous sequences share: sample, run all samples as worlds of one batch, refine, repeat."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import numpy as np

from softwarp.planning.model import Floats, PlanningModel, Rollouts
from softwarp.planning.options import SequencesConfig
from softwarp.planning.search import Clock, Progress, Search, repeated, require_continuous


class SequencePlanner(ABC):
    """Improves a distribution of action sequences; the plan is the best sequence that was ever run.

    A method fills in ``sample`` and ``refine``. After ``advance`` the next search starts from what is left of the last
    mean, and runs what is left of the last plan beside its own first samples: a goal that a plan met is not lost.

    With ``horizon`` set, sequences are compared by what they earn within it: an end counts as long as they do, not for
    ever, beside others that go on and whose time after the horizon nobody knows.
    """

    def __init__(self, config: SequencesConfig) -> None:
        self.config = config
        self.forget()

    @property
    def expected_state(self) -> int | None:
        """The next plan may start from any state."""
        return None

    def forget(self) -> None:
        """Start the next search from the middle of the range of actions, and draws from the seed."""
        self._rng = np.random.default_rng(self.config.seed)
        self._last: Floats | None = None
        self._plan: Floats | None = None

    def advance(self, actions: int) -> None:
        """Shift the mean, whose end is repeated, and the plan."""
        if self._last is not None:
            self._last = self._last[min(actions, len(self._last) - 1) :]
        if self._plan is not None:
            self._plan = self._plan[actions:]

    @abstractmethod
    def begin(self, mean: Floats) -> None:
        """Start a search around a mean, shape (horizon, action_size)."""

    @abstractmethod
    def sample(self, count: int, rng: np.random.Generator) -> Floats:
        """Sequences in [-1, 1], shape (count, horizon, action_size)."""

    @abstractmethod
    def refine(self, samples: Floats, values: Floats) -> Floats:
        """Learn from the values of samples, shape (count,); returns the new mean."""

    def plan(self, model: PlanningModel, *, progress: Progress | None = None) -> Search:
        """Search until the budget is spent."""
        size = require_continuous(model, self.config.name)
        config, clock = self.config, Clock(self.config, model, progress, cost=1)
        horizon = min(config.horizon or model.horizon, model.horizon)
        mean = self._first_mean(horizon, size)
        self.begin(mean)
        left = self._left_of_plan(mean)
        best, best_value, best_score, met = mean, 0.0, -math.inf, False
        history: list[dict[str, float]] = []
        while horizon and not clock.is_over() and not (met and config.until_success):
            count = min(config.population, max(1, clock.steps_left // horizon))
            samples = self.sample(count, self._rng)
            if left is not None and not history:
                samples[-1] = left
            rolled = model.roll_out(repeated(model.root, count), samples)
            values = rolled.values(config.gamma, beyond=config.horizon == 0)
            clock.steps += int(rolled.lengths.sum())
            scores = values - self._cost(samples)
            index = _best(scores, rolled, prefer_success=config.until_success)
            is_found = bool(rolled.success[index])
            if (is_found and not met and config.until_success) or scores[index] > best_score:
                best, met = samples[index, : rolled.lengths[index]], is_found
                best_value, best_score = float(values[index]), scores[index]
            mean = self.refine(samples, scores)
            history.append(_summary(values, rolled, best_value))
            clock.show(f"best {best_value:.3f}  mean {values.mean():.3f}  nearest {1e3 * rolled.distance.min():.1f} mm")
        self._last, self._plan = (mean, best) if horizon else (None, None)
        spent = (clock.expansions, clock.transitions, clock.seconds)
        return Search(best, best_value, met if history else None, *spent, history=history)

    def _cost(self, samples: Floats) -> Floats:
        """What sequences lose by their distance from the nominal action, shape (count,)."""
        nominal = 0.0 if self.config.nominal is None else np.asarray(self.config.nominal)
        cost: Floats = self.config.nominal_cost * np.square(samples - nominal).mean(axis=(1, 2))
        return cost

    def _left_of_plan(self, mean: Floats) -> Floats | None:
        """The rest of the last plan, then the end of the mean; None if there is no rest."""
        if self._plan is None or not len(self._plan):
            return None
        return np.concatenate((self._plan, mean[len(self._plan) :]))[: len(mean)]

    def _first_mean(self, horizon: int, size: int) -> Floats:
        nominal = self.config.nominal
        if nominal is not None and len(nominal) != size:
            raise ValueError(f"planner.nominal: must hold {size} entries, one per entry of an action, got {nominal}")
        mean = np.zeros((horizon, size))
        if nominal is not None:
            mean[:] = nominal
        if self._last is not None and horizon:
            kept = self._last[:horizon]
            mean[: len(kept)] = kept
            if nominal is None:
                mean[len(kept) :] = kept[-1]
        return mean


def _best(values: Floats, rolled: Rollouts, *, prefer_success: bool) -> int:
    """Sequence with the greatest value, on request among those that meet the goal if any does."""
    if prefer_success and rolled.success.any():
        values = np.where(rolled.success, values, -np.inf)
    return int(np.argmax(values))


def _summary(values: Floats, rolled: Rollouts, best: float) -> dict[str, float]:
    told = {"best": best, "round_best": float(values.max()), "round_mean": float(values.mean())}
    return told | {"success": float(rolled.success.mean()), "nearest": float(rolled.distance.min())}
