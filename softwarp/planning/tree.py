"""A search tree in columns: node 0 is the root, children follow their parents."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from softwarp.planning.model import Transitions


class Tree:
    """Nodes with what planners know of them; every list has one entry per node.

    Attributes:
        parent: Node; -1 for the root.
        action: That led here from the parent; -1 for the root.
        depth: Actions from the root.
        state: Name of the state in the model; -1 if the model was not asked for it.
        reward: Of the action that led here, in [0, 1].
        value: Lower bound: discounted rewards from the root to here, and what an end earns for ever.
        ended: Nothing follows.
        rest: Reward per step after an end; 0 elsewhere.
        success: The goal is met here.
        distance: To the goal [m].
        visits: How often a search came here.
        total: Sum of what searches that came here saw, in the planner's own scale.
        likeness: Equal for states that may be taken as one; empty where that is not known.
    """

    def __init__(self, gamma: float, state: int) -> None:
        self.gamma = gamma
        self.parent, self.action, self.depth, self.state = [-1], [-1], [0], [state]
        self.reward, self.value, self.rest, self.distance = [0.0], [0.0], [0.0], [math.nan]
        self.ended, self.success = [False], [False]
        self.visits, self.total, self.likeness = [0], [0.0], [b""]
        self._path_value = [0.0]  # value without what follows an end
        self._children: list[list[int]] = [[]]

    def __len__(self) -> int:
        return len(self.parent)

    def children(self, node: int) -> list[int]:
        """Children of a node in the order in which they were added."""
        return self._children[node]

    def add(self, parent: int, action: int) -> int:
        """Add a child that the model was not asked for; ``fill`` says what it answered."""
        node = len(self)
        columns: tuple[tuple[list[Any], Any], ...] = (
            (self.parent, parent),
            (self.action, action),
            (self.depth, self.depth[parent] + 1),
            (self.state, -1),
            (self.reward, 0.0),
            (self.value, self._path_value[parent]),
            (self.rest, 0.0),
            (self.distance, math.nan),
            (self.ended, False),
            (self.success, False),
            (self.visits, 0),
            (self.total, 0.0),
            (self.likeness, b""),
            (self._path_value, self._path_value[parent]),
            (self._children, []),
        )
        for column, item in columns:
            column.append(item)
        self._children[parent].append(node)
        return node

    def fill(self, node: int, outcome: Transitions, index: int) -> None:
        """Take entry ``index`` of what the model said for the action that leads to ``node``."""
        self.state[node] = int(outcome.states[index])
        self.rest[node] = float(outcome.rest[index])
        self.ended[node] = bool(outcome.ended[index])
        self.success[node] = bool(outcome.success[index])
        self.distance[node] = float(outcome.distance[index])
        if outcome.likeness is not None:
            self.likeness[node] = outcome.likeness[index].tobytes()
        self.set_reward(node, float(outcome.rewards[index]))

    def set_reward(self, node: int, reward: float) -> None:
        """Set a node's reward and the values that follow from it and from its parent's."""
        self.reward[node] = reward
        depth = self.depth[node]
        self._path_value[node] = self._path_value[self.parent[node]] + self.gamma ** (depth - 1) * reward
        self.value[node] = self._path_value[node] + self.gamma**depth / (1.0 - self.gamma) * self.rest[node]

    def line(self, node: int) -> list[int]:
        """Nodes from the root's child down to ``node``."""
        nodes = []
        while node > 0:
            nodes.append(node)
            node = self.parent[node]
        return nodes[::-1]

    def best_success(self) -> int | None:
        """Node of the greatest value among those that meet the goal; None if there is none."""
        met = [node for node in range(len(self)) if self.success[node]]
        return max(met, key=lambda node: (self.value[node], -node)) if met else None

    def path(self, node: int) -> list[int]:
        """Actions from the root to ``node``."""
        return [self.action[entry] for entry in self.line(node)]

    def walk(self, node: int = 0) -> Iterator[int]:
        """All nodes below and with ``node``, parents before children."""
        stack = [node]
        while stack:
            node = stack.pop()
            yield node
            stack.extend(reversed(self._children[node]))

    def below(self, node: int) -> tuple[Tree, dict[int, int]]:
        """What hangs on ``node`` as a tree of its own, and the new number of each of its nodes.

        Nodes keep their order; values count from the new root, nu' = (nu - nu_1) / gamma for every action on the way.
        """
        tree, number = Tree(self.gamma, self.state[node]), {node: 0}
        for old in sorted(self.walk(node)):  # parents come before their children
            if old != node:
                number[old] = tree.add(number[self.parent[old]], self.action[old])
            for name in ("state", "rest", "distance", "ended", "success", "visits", "total", "likeness"):
                getattr(tree, name)[number[old]] = getattr(self, name)[old]
            if old != node:
                tree.set_reward(number[old], self.reward[old])
        return tree, number

    def to_dict(self) -> dict[str, Any]:
        """Columns as plain lists, for JSON; distances that are not known are None."""
        columns = ("parent", "action", "depth", "reward", "value", "ended", "success", "visits", "total")
        told: dict[str, Any] = {"gamma": self.gamma, "nodes": len(self)}
        told |= {name: getattr(self, name) for name in columns}
        told["distance"] = [None if math.isnan(d) else d for d in self.distance]
        return told
