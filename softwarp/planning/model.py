"""What a planner needs to know of the world: start from a state, step many (state, action) pairs, run sequences.

Planners assume rewards in [0, 1] and a discount gamma. A state in which an episode ended earns a constant reward per
step for ever, its ``rest``: that is what "no further reward" becomes when rewards are scaled into [0, 1].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Transitions:
    """Outcome of steps, one entry per (state, action) pair; all of shape (n,)."""

    states: Ints  # names of the states reached, for further steps
    rewards: Floats  # in [0, 1]
    ended: Bools  # nothing follows
    rest: Floats  # reward per step of the time after the end, in [0, 1]; 0 where the episode goes on
    success: Bools  # the goal is met
    distance: Floats  # to the goal [m]; NaN where the model measures none
    likeness: Ints | None = None  # (n, k), equal rows for states that may be taken as one; None or k = 0: no two are


@dataclass(frozen=True)
class Rollouts:
    """Outcome of sequences of actions, one row per sequence."""

    rewards: Floats  # in [0, 1], shape (n, horizon); those after the end are ``rest``
    lengths: Ints  # actions until the end, shape (n,); the horizon where the episode goes on
    ended: Bools  # whether it ended within the horizon, shape (n,)
    rest: Floats  # reward per step after the horizon, shape (n,); 0 where the episode goes on
    success: Bools  # the goal is met at the end, shape (n,)
    distance: Floats  # to the goal at the end [m], shape (n,)

    def values(self, gamma: float, *, beyond: bool = True) -> Floats:
        """Discounted sums of rewards, shape (n,).

        Args:
            gamma: Discount.
            beyond: Include the time after an end for ever: lower bounds of what can be had. False: up to the horizon,
                where sequences that go on count as much as those that ended, and what follows is not known of either.
        """
        horizon = self.rewards.shape[1]
        sums: Floats = self.rewards @ gamma ** np.arange(horizon)
        if beyond:
            sums += self.rest * gamma**horizon / (1.0 - gamma)
        return sums


class PlanningModel(Protocol):
    """A deterministic simulator that planners may use as they like; it is never the environment that asks.

    States are named by integers, valid until the next start. Trees use ``step_many`` and discrete actions; sequences
    are discrete, int64 (n, horizon), or continuous in [-1, 1], float64 (n, horizon, action_size).
    """

    @property
    def action_count(self) -> int:
        """Number of discrete actions; 0 if there are continuous ones only."""
        ...

    @property
    def action_size(self) -> int:
        """Length of a continuous action; 0 if there are discrete ones only."""
        ...

    @property
    def worlds(self) -> int:
        """Steps that the model takes together; batches of this size, or multiples, cost least."""
        ...

    @property
    def root(self) -> int:
        """Name of the state that planning starts from."""
        ...

    @property
    def horizon(self) -> int:
        """Actions left from the root until the episode is cut off."""
        ...

    @property
    def transitions(self) -> int:
        """Steps taken since the start, an action each; those taken to visit a state anew included."""
        ...

    def step_many(self, states: Ints, actions: Ints) -> Transitions:
        """Take action i in state i, for all i; both of shape (n,)."""
        ...

    def roll_out(self, states: Ints, actions: Ints | Floats) -> Rollouts:
        """Take a sequence of actions from each state; the states on the way are not kept."""
        ...
