"""Optimistic planning of deterministic systems: expand the leaf whose upper bound is the greatest.

A node at depth d with discounted rewards nu on its way has the upper bound b = nu + gamma^d / (1 - gamma), as a step
earns at most 1; a node at which the episode ended has b = nu = its exact value. With ``batch`` = k the k best leaves
are expanded together, all their actions as worlds of one step; k = 1 is the algorithm of the paper. The tree depends on
k alone, not on the size of the model's pool.

Where the way to a goal first leads away from it, a budget may end before the tree has passed that place, and plan
after plan goes to and fro. With ``patience`` = p a plan spends up to p budgets as long as nothing in its tree is nearer
to the goal than its root, by ``NEARER`` at least. The distance at the root is known of trees that were kept.

Of nodes that are alike (``Transitions.likeness``), one is expanded, the first that comes: bounds fall on the way down,
so it has the greatest bound of all. The others stay, and are leaves again where a kept tree has lost that one.

References: Hren and Munos (2008), Optimistic Planning of Deterministic Systems; Leurent and Maillard (2020),
Monte-Carlo Graph Search: the Value of Merging Similar States.
"""

from __future__ import annotations

import heapq
import math

import numpy as np

from softwarp.planning.model import Ints, PlanningModel
from softwarp.planning.options import OPDConfig
from softwarp.planning.search import Clock, Progress, Search, require_choices
from softwarp.planning.tree import Tree

NEARER = 0.05  # of the distance at the root


class OPD:
    """Optimistic planner for discrete actions.

    Equal bounds are taken in the order of their nodes, so a search is repeatable.
    """

    def __init__(self, config: OPDConfig | None = None) -> None:
        self.config = config or OPDConfig()
        self.forget()

    def forget(self) -> None:
        """Drop the tree."""
        self._tree: Tree | None = None
        self._heap: list[tuple[float, int]] = []
        self._merged: list[int] = []  # leaves like nodes that were expanded
        self._seen: set[bytes] = set()  # likeness of these
        self._plan: list[int] = []

    @property
    def expected_state(self) -> int | None:
        """State in the model from which the kept tree goes on; None without a tree."""
        return None if self._tree is None else self._tree.state[0]

    def advance(self, actions: int) -> None:
        """Go down the tree along the last plan; the state reached is the root of what is kept."""
        if not self.config.reuse or self._tree is None or actions > len(self._plan):
            self.forget()
            return
        if actions == 0:
            return
        tree, number = self._tree.below(self._plan[actions - 1])
        leaves = [number[node] for node in (*(node for _, node in self._heap), *self._merged) if node in number]
        self._heap = [(-self._bound(tree, leaf), leaf) for leaf in leaves]
        heapq.heapify(self._heap)
        self._merged, self._seen = [], {tree.likeness[node] for node in range(len(tree)) if tree.visits[node]} - {b""}
        self._tree, self._plan = tree, []

    def plan(self, model: PlanningModel, *, progress: Progress | None = None) -> Search:
        """Expand leaves until the budget is spent; the plan leads to the node with the greatest lower bound."""
        count = require_choices(model, "opd")
        clock = Clock(self.config, model, progress, cost=count)
        if self._tree is None:
            self._tree = Tree(self.config.gamma, model.root)
            if model.horizon > 0:
                self._heap = [(-self._bound(self._tree, 0), 0)]
        tree = self._tree
        best = self._best(tree)
        while self._heap and not (self.config.until_success and tree.success[best]):
            if clock.is_over() and not (self._is_stuck(tree) and clock.extend(self.config.patience)):
                break
            number = min(self.config.batch, clock.steps_left // count)
            leaves = self._take(tree, number)
            if not leaves:
                break
            for node in self._expand(model, tree, leaves, count):
                if self._is_better(tree, node, best):
                    best = node
            clock.steps += len(leaves) * count
            clock.show(f"depth {max(tree.depth[leaf] for leaf in leaves) + 1}  value {tree.value[best]:.3f}")
        self._plan = tree.line(best)
        actions: Ints = np.array(tree.path(best), dtype=np.int64)
        spent = (clock.expansions, clock.transitions, clock.seconds)
        return Search(actions, tree.value[best], tree.success[best], *spent, tree, self._plan)

    def _take(self, tree: Tree, count: int) -> list[int]:
        """Up to ``count`` leaves of the greatest bounds, those left out that are like nodes expanded before."""
        leaves: list[int] = []
        while self._heap and len(leaves) < count:
            leaf = heapq.heappop(self._heap)[1]
            likeness = tree.likeness[leaf] if self.config.merge else b""
            if likeness and likeness in self._seen:
                self._merged.append(leaf)
                continue
            if likeness:
                self._seen.add(likeness)
            leaves.append(leaf)
        return leaves

    def _expand(self, model: PlanningModel, tree: Tree, leaves: list[int], count: int) -> list[int]:
        """Add all children of leaves; those at which episodes go on become leaves."""
        states = np.repeat(np.array([tree.state[leaf] for leaf in leaves]), count)
        outcome = model.step_many(states, np.tile(np.arange(count), len(leaves)))
        added = []
        for index in range(len(states)):
            node = tree.add(leaves[index // count], index % count)
            tree.fill(node, outcome, index)
            added.append(node)
            if not tree.ended[node]:
                heapq.heappush(self._heap, (-self._bound(tree, node), node))
        for leaf in leaves:
            tree.visits[leaf] += 1
        return added

    def _is_stuck(self, tree: Tree) -> bool:
        """Whether nothing in the tree is nearer to the goal than the root; unknown distances are no reason to go on."""
        first, *rest = tree.distance
        return math.isfinite(first) and not any(distance <= (1.0 - NEARER) * first for distance in rest)

    def _bound(self, tree: Tree, node: int) -> float:
        gamma = self.config.gamma
        return tree.value[node] + gamma ** tree.depth[node] / (1.0 - gamma)

    def _best(self, tree: Tree) -> int:
        """Node with the greatest lower bound, the first of equals on a walk from branch to branch."""
        best = 0
        for node in tree.walk():
            if self._is_better(tree, node, best):
                best = node
        return best

    def _is_better(self, tree: Tree, node: int, best: int) -> bool:
        """Greater value; with ``until_success`` a plan that meets the goal comes before any that does not."""
        if self.config.until_success and tree.success[node] != tree.success[best]:
            return tree.success[node]
        return tree.value[node] > tree.value[best]
