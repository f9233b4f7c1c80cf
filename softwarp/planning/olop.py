"""Open-loop optimistic planning, OLOP and KL-OLOP: sequences of actions as arms of a bandit.

In each of M episodes a sequence of L actions is run from the root. Every prefix h keeps its visits T and the mean mu of
its last reward; U(h) bounds that mean from above, and a sequence a by the least of the bounds of its prefixes,

    B(a) = min over h of  sum_{t=1..h} gamma^(t-1) U(a_1..t) + gamma^h / (1 - gamma).

The sequence with the greatest B is run next; the plan follows the most visited prefixes. The two differ in U:

    OLOP:     mu + sqrt(2 ln M / T)
    KL-OLOP:  the greatest q in [mu, 1] with T d(mu, q) <= 2 ln M + 2 ln ln M,  d the Bernoulli divergence

Only visited prefixes are stored; B is found by recursion, as with c running over the children of h

    beta(h) = min(1 / (1 - gamma), max over c of U(c) + gamma beta(c))

is what B adds to the rewards before h, divided by gamma^h. Only the path of an episode changes by it. Sequences that
leave the stored tree go on with random actions, as any continuation has the same bound. With ``batch`` = k, k sequences
are chosen before any is run; prefixes on their way count as visited with reward 0 until the model has answered; k = 1
is the algorithm of the papers.

References: Bubeck and Munos (2010), Open Loop Optimistic Planning; Leurent and Maillard (2019), Practical Open-Loop
Optimistic Planning.
"""

from __future__ import annotations

import math

import numpy as np

from softwarp.planning.model import Ints, PlanningModel, Rollouts
from softwarp.planning.options import KLOLOPConfig as KLOLOPConfig
from softwarp.planning.options import OLOPConfig
from softwarp.planning.search import Clock, Progress, Search, repeated, require_choices
from softwarp.planning.tree import Tree

_BISECTIONS = 40
_MARGIN = 1e-12  # from 0 and 1, where the divergence is infinite


def episodes_and_length(steps: int, gamma: float) -> tuple[int, int]:
    """Greatest M with M L <= steps, L = ceil(ln M / (2 ln(1 / gamma))), and that L; both at least 1."""
    low, high = 1, steps
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if middle * _length(middle, gamma) <= steps else (low, middle - 1)
    return low, _length(low, gamma)


def _length(episodes: int, gamma: float) -> int:
    return max(1, math.ceil(math.log(episodes) / (2.0 * math.log(1.0 / gamma))))


def bernoulli_divergence(p: float, q: float) -> float:
    """d(p, q) = p ln(p / q) + (1 - p) ln((1 - p) / (1 - q)), for p and q cut to (0, 1)."""
    p, q = (min(max(value, _MARGIN), 1.0 - _MARGIN) for value in (p, q))
    return p * math.log(p / q) + (1.0 - p) * math.log((1.0 - p) / (1.0 - q))


def kl_bound(mean: float, visits: int, threshold: float) -> float:
    """Greatest q in [mean, 1] with visits d(mean, q) <= threshold, by bisection."""
    low, high = min(mean, 1.0), 1.0
    if visits * bernoulli_divergence(mean, high) <= threshold:
        return high
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if visits * bernoulli_divergence(mean, middle) <= threshold else (low, middle)
    return low


class OLOP:
    """Open-loop optimistic planner for discrete actions; ``bound`` chooses between OLOP and KL-OLOP."""

    def __init__(self, config: OLOPConfig | None = None) -> None:
        self.config = config or OLOPConfig()
        self._cap = 1.0 / (1.0 - self.config.gamma)
        self._upper: list[float] = []  # U of each node
        self._beta: list[float] = []

    @property
    def expected_state(self) -> int | None:
        """Nothing is kept from one plan to the next."""
        return None

    def advance(self, actions: int) -> None:
        """Every plan is made anew."""

    def forget(self) -> None:
        """Every plan is made anew."""

    def plan(self, model: PlanningModel, *, progress: Progress | None = None) -> Search:
        """Run episodes until the budget is spent; the plan follows the most visited prefixes.

        With ``until_success`` it is the sequence that met the goal, if any did.
        """
        count = require_choices(model, self.config.name)
        clock = Clock(self.config, model, progress, cost=count)
        rng = np.random.default_rng(self.config.seed)
        episodes, length = self._size(clock.steps_left, model.horizon)
        tree = Tree(self.config.gamma, model.root)
        self._upper, self._beta = [self._cap], [self._cap]
        met = False
        while length and not clock.is_over() and not (met and self.config.until_success):
            number = max(1, min(self.config.batch, clock.steps_left // length))
            lines = [self._choose(tree, count, length, episodes, rng) for _ in range(number)]
            actions = np.array([tree.path(line[-1]) for line in lines])
            rolled = model.roll_out(repeated(model.root, number), actions)
            for line, rewards in zip(lines, rolled.rewards.tolist(), strict=True):
                self._back_up(tree, line, rewards, episodes, count)
            self._note(tree, lines, rolled)
            met = met or bool(rolled.success.any())
            clock.steps += int(rolled.lengths.sum())
            clock.show(f"prefixes {len(tree)}  length {length}")
        return self._result(tree, clock)

    def _size(self, steps: int, horizon: int) -> tuple[int, int]:
        """Episodes and their length: as the paper derives them, or as many of a given length as the budget holds."""
        episodes, derived = episodes_and_length(steps, self.config.gamma)
        length = min(self.config.length or derived, horizon)
        return episodes if length == derived else max(1, steps // max(length, 1)), length

    def _choose(self, tree: Tree, count: int, length: int, episodes: int, rng: np.random.Generator) -> list[int]:
        """Prefixes of the sequence with the greatest bound, stored now and counted as under way."""
        node = 0
        line: list[int] = []
        while len(line) < length:
            is_known = node == 0 or tree.visits[node] > 0
            node = self._next(tree, node, count) if is_known else self._add(tree, node, int(rng.integers(count)))
            line.append(node)
        for entry in line:
            tree.visits[entry] += 1
        tree.visits[0] += 1
        self._refresh(tree, line, episodes, count)
        return line

    def _next(self, tree: Tree, node: int, count: int) -> int:
        """Child with the greatest bound; among equals the least visited one, then the first."""
        children = tree.children(node)
        if len(children) < count:  # nothing bounds an action that was never taken, but the prefix itself
            taken = {tree.action[child] for child in children}
            return self._add(tree, node, next(action for action in range(count) if action not in taken))
        cap = math.inf if node == 0 else self._cap

        def key(child: int) -> tuple[float, int, int]:
            bound = min(cap, self._upper[child] + self.config.gamma * self._beta[child])
            return (bound, -tree.visits[child], -child)

        return max(children, key=key)

    def _add(self, tree: Tree, node: int, action: int) -> int:
        self._upper.append(math.inf if self.config.bound == "hoeffding" else 1.0)
        self._beta.append(self._cap)
        return tree.add(node, action)

    def _back_up(self, tree: Tree, line: list[int], rewards: list[float], episodes: int, count: int) -> None:
        """Add an episode's rewards to its prefixes."""
        for node, reward in zip(line, rewards, strict=True):
            tree.total[node] += reward
        self._refresh(tree, line, episodes, count)

    def _note(self, tree: Tree, lines: list[list[int]], rolled: Rollouts) -> None:
        """Mean rewards and ends of the prefixes that were run."""
        for index, line in enumerate(lines):
            reached = line[rolled.lengths[index] - 1]
            tree.ended[reached], tree.success[reached] = bool(rolled.ended[index]), bool(rolled.success[index])
            tree.distance[reached], tree.rest[reached] = float(rolled.distance[index]), float(rolled.rest[index])
            for node in line:
                tree.set_reward(node, tree.total[node] / tree.visits[node])

    def _refresh(self, tree: Tree, line: list[int], episodes: int, count: int) -> None:
        """Bounds of the prefixes of an episode, from the last one up."""
        for node in reversed(line):
            self._upper[node] = self._bound(tree.total[node] / tree.visits[node], tree.visits[node], episodes)
            children = tree.children(node)
            if len(children) == count:
                best = max(self._upper[child] + self.config.gamma * self._beta[child] for child in children)
                self._beta[node] = min(self._cap, best)

    def _bound(self, mean: float, visits: int, episodes: int) -> float:
        log_episodes = math.log(max(episodes, 2))
        if self.config.bound == "hoeffding":
            return mean + math.sqrt(2.0 * log_episodes / visits)
        return kl_bound(mean, visits, 2.0 * log_episodes + 2.0 * math.log(max(log_episodes, 1.0)))

    def _result(self, tree: Tree, clock: Clock) -> Search:
        met = tree.best_success() if self.config.until_success else None
        node = met or 0
        while met is None and tree.children(node) and not tree.ended[node]:
            node = max(tree.children(node), key=lambda child: (tree.visits[child], tree.total[child], -child))
        actions: Ints = np.array(tree.path(node), dtype=np.int64)
        spent = (clock.expansions, clock.transitions, clock.seconds)
        return Search(actions, tree.value[node], tree.success[node], *spent, tree, tree.line(node))
