"""Small models with known answers, for the tests of planners."""

import hashlib
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from softwarp.planning.model import Rollouts, Transitions

Path = tuple[int, ...]


class TreeModel:
    """A planning model whose states are the actions taken so far.

    Args:
        reward: Of the action that ended a path.
        count: Actions in each state.
        horizon: Depth at which episodes are cut off.
        ends: Paths at which the episode ends for good, with what they earn per step from then on.
        worlds: Steps taken together; ``batches`` lists how many there were each time.
    """

    action_size = 0
    root = 0

    def __init__(
        self,
        reward: Callable[[Path], float],
        count: int = 2,
        horizon: int = 50,
        ends: dict[Path, float] | None = None,
        worlds: int = 64,
    ) -> None:
        self.reward, self.action_count, self.horizon, self.worlds = reward, count, horizon, worlds
        self.ends = ends or {}
        self.paths: list[Path] = [()]
        self.transitions = 0
        self.batches: list[int] = []

    def _outcome(self, path):
        """Reward, ended, rest, success; the goal is where an end earns 1."""
        rest = self.ends.get(path, 0.0)
        return self.reward(path), path in self.ends or len(path) >= self.horizon, rest, rest == 1.0

    def step_many(self, states, actions):
        paths = [(*self.paths[state], int(action)) for state, action in zip(states, actions, strict=True)]
        names = np.arange(len(self.paths), len(self.paths) + len(paths))
        self.paths += paths
        self.transitions += len(paths)
        self.batches += [len(paths[i : i + self.worlds]) for i in range(0, len(paths), self.worlds)]
        rewards, ended, rest, success = (np.array(column) for column in zip(*map(self._outcome, paths), strict=True))
        return Transitions(names, rewards, ended, rest, success, np.full(len(paths), np.nan))

    def roll_out(self, states, actions):
        count, horizon = actions.shape[:2]
        rewards, lengths = np.zeros((count, horizon)), np.full(count, horizon)
        ended, success, rest = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool), np.zeros(count)
        for row, state in enumerate(states):
            path = self.paths[state]
            for step, action in enumerate(actions[row]):
                path = (*path, int(action))
                self.transitions += 1
                rewards[row, step], ended[row], rest[row], success[row] = self._outcome(path)
                if ended[row]:
                    rewards[row, step + 1 :], lengths[row] = rest[row], step + 1
                    break
        return Rollouts(rewards, lengths, ended, rest, success, np.full(count, np.nan))


def table(rewards: dict[Path, float]) -> Callable[[Path], float]:
    """Rewards of some paths, 0 elsewhere."""
    return lambda path: rewards.get(path, 0.0)


def scattered(path: Path) -> float:
    """A reward in [0, 1) for every path, without any order."""
    return int.from_bytes(hashlib.sha256(repr([int(action) for action in path]).encode()).digest()[:4], "big") / 2.0**32


class PointModel:
    """Continuous actions (k,) with reward 1 - |a - target_t|^2 / (4 k), so that the best sequence is ``target``."""

    action_count = 0
    root = 0
    worlds = 16

    def __init__(self, target: np.ndarray) -> None:
        self.target = target
        self.horizon, self.action_size = target.shape
        self.transitions = 0

    def step_many(self, states, actions):
        raise AssertionError("planners of sequences take no single steps")

    def roll_out(self, states, actions):
        count, horizon = actions.shape[:2]
        self.transitions += count * horizon
        rewards = 1.0 - np.square(actions - self.target[:horizon]).sum(axis=-1) / (4.0 * self.action_size)
        zero = np.zeros(count)
        far = np.abs(actions - self.target[:horizon]).max(axis=(1, 2))
        flags = np.zeros(count, dtype=bool)
        return Rollouts(rewards, np.full(count, horizon), flags, zero, far < 0.05, far)


class DoubleIntegrator:
    """A mass at 1 that a force in [-1, 1] is to bring to rest at 0: x' = x + v / 4, v' = v + a / 4.

    The reward is 1 - cost / 8 with the cost x^2 + v^2 + a^2 of the state reached.
    """

    action_count, action_size, root, worlds, horizon = 0, 1, 0, 64, 20

    def __init__(self) -> None:
        self.transitions = 0

    def costs(self, actions):
        """Cost of every step, shape (n, horizon)."""
        place, speed, costs = np.ones(len(actions)), np.zeros(len(actions)), []
        for action in actions[:, :, 0].T:
            place, speed = place + 0.25 * speed, speed + 0.25 * action
            costs.append(place**2 + speed**2 + action**2)
        return np.stack(costs, axis=1)

    def step_many(self, states, actions):
        raise AssertionError("planners of sequences take no single steps")

    def roll_out(self, states, actions):
        count, horizon = actions.shape[:2]
        self.transitions += count * horizon
        zero, flags = np.zeros(count), np.zeros(count, dtype=bool)
        rewards = 1.0 - self.costs(actions) / 8.0
        return Rollouts(rewards, np.full(count, horizon), flags, zero, flags, zero)


class CommutingModel(TreeModel):
    """States in which each action was taken equally often are alike, in whatever order."""

    def step_many(self, states, actions):
        told = super().step_many(states, actions)
        counts = [[self.paths[name].count(action) for action in range(self.action_count)] for name in told.states]
        return replace(told, likeness=np.array(counts))
