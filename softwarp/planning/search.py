"""What all planners share: settings, the budget, and the result."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from softwarp.planning.model import Floats, Ints, PlanningModel
from softwarp.planning.options import PlannerConfig
from softwarp.planning.tree import Tree

Progress = Callable[[float, str], None]  # part of the budget that is spent, in [0, 1], and the state in words


@dataclass
class Search:
    """Outcome of a search.

    Attributes:
        actions: Sequence of actions that the planner recommends; int64 (n,) or float64 (n, action_size).
        value: Its discounted sum of rewards in [0, 1], a lower bound of what follows it included; exact for models that
            are deterministic, save for OLOP's, which is an estimate.
        success: Whether the goal is met at its end; None where the planner has not followed it so far.
        expansions: Spent budget.
        transitions: Model steps taken.
        seconds: Time taken.
        tree: The tree; None for planners that keep none.
        nodes: Of the tree, along the actions.
        history: Best value after every round of a planner of sequences.
    """

    actions: Ints | Floats
    value: float
    success: bool | None
    expansions: float
    transitions: int
    seconds: float
    tree: Tree | None = None
    nodes: list[int] = field(default_factory=list)
    history: list[dict[str, float]] = field(default_factory=list)


class Planner(Protocol):
    """A search method with its settings."""

    config: Any

    @property
    def expected_state(self) -> int | None:
        """State in the model from which a kept tree goes on; None if the next plan may start from any state."""
        ...

    def plan(self, model: PlanningModel, *, progress: Progress | None = None) -> Search:
        """Search from the model's root."""
        ...

    def advance(self, actions: int) -> None:
        """Tell that so many actions of the last plan were carried out; the next plan may start from what is left."""
        ...

    def forget(self) -> None:
        """Start the next plan from nothing: another episode, or a state that no plan foresaw."""
        ...


class Clock:
    """Counts a budget down and shows how much is spent; ``cost`` is how many model steps an expansion takes."""

    def __init__(self, config: PlannerConfig, model: PlanningModel, progress: Progress | None, *, cost: int) -> None:
        self._config, self._progress, self._cost = config, progress, cost
        self._model, self._start_steps = model, model.transitions
        self._start = time.perf_counter()
        self.steps = 0  # model steps that count
        self.budgets = 1  # of expansions that may be spent

    @property
    def expansions(self) -> float:
        """Spent expansions."""
        return self.steps / self._cost

    @property
    def seconds(self) -> float:
        """Time since the start [s]."""
        return time.perf_counter() - self._start

    @property
    def transitions(self) -> int:
        """Model steps since the start, repeated ones included."""
        return self._model.transitions - self._start_steps

    @property
    def steps_left(self) -> int:
        """Model steps that the budget still allows."""
        return self.budgets * self._config.expansions * self._cost - self.steps

    def extend(self, most: int) -> bool:
        """Allow another budget of expansions, ``most`` in all; whether there is one, and time for it."""
        if self.budgets >= most or self.seconds >= self._config.seconds:
            return False
        self.budgets += 1
        return True

    def is_over(self) -> bool:
        """Whether the budget is spent; the first round is always made, so that there is a plan."""
        return self.steps > 0 and (self.steps_left <= 0 or self.seconds >= self._config.seconds)

    def show(self, text: str) -> None:
        """Report progress."""
        if self._progress is not None:
            spent = max(self.expansions / (self.budgets * self._config.expansions), self.seconds / self._config.seconds)
            self._progress(min(spent, 1.0), text)


def require_choices(model: PlanningModel, planner: str) -> int:
    """Number of the model's discrete actions.

    Raises:
        ValueError: If there are not at least two.
    """
    if model.action_count < 2:
        raise ValueError(
            f"planner {planner}: needs 2 or more discrete actions, the model has {model.action_count}; choose discrete "
            f"actions (env.action_kind=discrete), fewer model.levels, or a planner of continuous ones, cem or mppi"
        )
    return model.action_count


def require_continuous(model: PlanningModel, planner: str) -> int:
    """Length of the model's continuous action.

    Raises:
        ValueError: If its actions are discrete.
    """
    if model.action_size < 1:
        raise ValueError(
            f"planner {planner}: needs continuous actions, the model has {model.action_count} discrete ones; choose a "
            f"continuous env.action_kind or a planner of trees, such as opd"
        )
    return model.action_size


def repeated(state: int, count: int) -> Ints:
    """A state's name, as often as there are actions to take in it."""
    return np.full(count, state, dtype=np.int64)
