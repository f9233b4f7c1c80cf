"""UCT: a tree grown by bandits, its leaves valued by random sequences.

A search goes down from the root; at node s with visits n it takes an action that was not tried yet, the first such, or
else the one with the greatest

    Q(s, a) + C sqrt(ln n / n_a),

Q the mean return of the searches that took a, returns divided by their greatest possible value so that they lie in
[0, 1]. The new node is valued by a sequence of random actions to the horizon; the return goes back up the path. With
``batch`` = k the tree is searched k times before the model is asked for all new nodes and sequences at once; searches
under way count as visits that returned 0 (a virtual loss), so that they spread; k = 1 is the algorithm of the paper.

Reference: Kocsis and Szepesvari (2006), Bandit based Monte-Carlo Planning.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from softwarp.planning.model import Floats, Ints, PlanningModel, Rollouts
from softwarp.planning.options import UCTConfig
from softwarp.planning.search import Clock, Progress, Search, require_choices
from softwarp.planning.tree import Tree


@dataclass(frozen=True)
class _Visit:
    """A search that awaits its value: the path to ``node``, and the action to take there (-1: it ended)."""

    path: list[int]
    node: int
    action: int


class UCT:
    """Monte-Carlo tree search for discrete actions."""

    def __init__(self, config: UCTConfig | None = None) -> None:
        self.config = config or UCTConfig()

    @property
    def expected_state(self) -> int | None:
        """Nothing is kept from one plan to the next."""
        return None

    def advance(self, actions: int) -> None:
        """Every plan is made anew."""

    def forget(self) -> None:
        """Every plan is made anew."""

    def plan(self, model: PlanningModel, *, progress: Progress | None = None) -> Search:
        """Search until the budget is spent; the plan follows the most visited actions.

        With ``until_success`` it is the search that met the goal, random actions included, if any did.
        """
        count = require_choices(model, "uct")
        clock = Clock(self.config, model, progress, cost=count)
        rng = np.random.default_rng(self.config.seed)
        tree, horizon = Tree(self.config.gamma, model.root), min(self.config.horizon, model.horizon)
        met: int | None = None
        while horizon and met is None and not clock.is_over():
            visits = [self._descend(tree, count, horizon) for _ in range(self._searches(clock.steps_left, horizon))]
            clock.steps += self._value(model, tree, visits, horizon, rng)
            met = tree.best_success() if self.config.until_success else None
            clock.show(f"nodes {len(tree)}  mean return {tree.total[0] / max(tree.visits[0], 1):.3f}")
        line = self._recommended(tree) if met is None else tree.line(met)
        node = line[-1] if line else 0
        actions: Ints = np.array(tree.path(node), dtype=np.int64)
        spent = (clock.expansions, clock.transitions, clock.seconds)
        return Search(actions, tree.value[node], tree.success[node], *spent, tree, line)

    def _searches(self, steps_left: int, horizon: int) -> int:
        return max(1, min(self.config.batch, steps_left // horizon))

    def _descend(self, tree: Tree, count: int, horizon: int) -> _Visit:
        """Go down to a node with an action that was not tried, and count the visit as under way."""
        node, path = 0, [0]
        while not tree.ended[node] and tree.depth[node] < horizon:
            children = tree.children(node)
            if len(children) < count:
                child = tree.add(node, len(children))  # the model is asked later
                path.append(child)
                break
            node = self._choose(tree, node)
            path.append(node)
            if tree.state[node] < 0:  # under way in another search of this batch
                break
        for entry in path:
            tree.visits[entry] += 1
        last = path[-1]
        is_new = last > 0 and tree.state[last] < 0
        return _Visit(path, tree.parent[last] if is_new else last, tree.action[last] if is_new else -1)

    def _choose(self, tree: Tree, node: int) -> int:
        """Child with the greatest upper confidence bound, the first of equals."""
        log_visits = math.log(tree.visits[node])

        def bound(child: int) -> float:
            visits = tree.visits[child]
            return tree.total[child] / visits + self.config.exploration * math.sqrt(log_visits / visits)

        return max(tree.children(node), key=lambda child: (bound(child), -child))

    def _value(
        self, model: PlanningModel, tree: Tree, visits: list[_Visit], horizon: int, rng: np.random.Generator
    ) -> int:
        """Ask the model about all searches under way and back their returns up.

        Returns:
            Steps that the model took; a search through known nodes alone counts as one, so that budgets end.
        """
        new = {visit.path[-1]: visit for visit in visits if visit.action >= 0}
        if new:
            states = np.array([tree.state[visit.node] for visit in new.values()])
            outcome = model.step_many(states, np.array([visit.action for visit in new.values()]))
            for index, node in enumerate(new):
                tree.fill(node, outcome, index)
        tails = self._tails(model, tree, [visit.path[-1] for visit in visits], horizon, rng)
        best = (1.0 - self.config.gamma**horizon) / (1.0 - self.config.gamma)
        steps = 0
        for visit, (tail, length) in zip(visits, tails, strict=True):
            steps += max(1, length + (visit.action >= 0))
            value = tail
            for node in reversed(visit.path[1:]):
                value = tree.reward[node] + self.config.gamma * value
                tree.total[node] += value / best
            tree.total[0] += value / best
        return steps

    def _tails(
        self, model: PlanningModel, tree: Tree, nodes: list[int], horizon: int, rng: np.random.Generator
    ) -> list[tuple[float, int]]:
        """Return from each node on, and how many steps the model took for it; sequences of equal length go together."""
        tails: list[tuple[float, int]] = [(0.0, 0)] * len(nodes)
        gamma = self.config.gamma
        by_length: dict[int, list[int]] = {}
        for index, node in enumerate(nodes):
            left = horizon - tree.depth[node]
            if tree.ended[node]:
                tails[index] = (tree.rest[node] * (1.0 - gamma**left) / (1.0 - gamma), 0)
            elif left:
                by_length.setdefault(left, []).append(index)
        for left, chosen in sorted(by_length.items()):
            actions = rng.integers(model.action_count, size=(len(chosen), left))
            rolled = model.roll_out(np.array([tree.state[nodes[index]] for index in chosen]), actions)
            sums: Floats = rolled.rewards @ gamma ** np.arange(left)
            for entry, (index, value) in enumerate(zip(chosen, sums.tolist(), strict=True)):
                tails[index] = (value, int(rolled.lengths[entry]))
                if rolled.success[entry] and self.config.until_success:
                    _append(tree, nodes[index], actions[entry], rolled, entry)
        return tails

    def _recommended(self, tree: Tree) -> list[int]:
        """Most visited children from the root down, by mean return among equals."""
        node, line = 0, []
        while tree.children(node):
            node = max(tree.children(node), key=lambda c: (tree.visits[c], tree.total[c] / max(tree.visits[c], 1), -c))
            line.append(node)
        return line


def _append(tree: Tree, node: int, actions: Ints, rolled: Rollouts, entry: int) -> None:
    """Add the sequence that met the goal below a node."""
    for action, reward in zip(actions[: rolled.lengths[entry]], rolled.rewards[entry], strict=False):
        node = tree.add(node, int(action))
        tree.visits[node] = 1
        tree.set_reward(node, float(reward))
    tree.ended[node], tree.success[node] = bool(rolled.ended[entry]), True
    tree.distance[node], tree.rest[node] = float(rolled.distance[entry]), float(rolled.rest[entry])
    tree.set_reward(node, tree.reward[node])
