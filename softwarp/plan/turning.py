"""The same factor from another end: its columns ordered so that those that contacts touch come last.

The filled pattern of a factor is a chordal graph, whose largest cliques form a tree. Any of them can be its root: with
the columns of the root last, and before them those that every other clique has beyond its neighbour towards the root,
nothing else is filled, so that the factorisation has as many products as before. What depends on the root is the
way of a contact's columns to it, along which the contact costs a substitution. Theory: docs/theory/cholesky.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softwarp.model.structure import IntArray

FloatArray = NDArray[np.float64]

FEW = 64  # columns, up to which an order makes no difference that could be measured
MOST_ROOTS = 12  # that are looked at in a tree
WORTH = 0.02  # of all products with contacts, that another order has to save


@dataclass(frozen=True)
class _Forest:
    """Largest cliques of a filled pattern.

    Attributes:
        members: Columns of every clique.
        above: Neighbour of every clique towards the root, -1 for a root.
        shared: Columns that it shares with that one.
        below: Neighbours on the other side.
        weight: Weight of the columns of a clique, and of those behind it, that lie beyond ``above``.
    """

    members: list[IntArray]
    above: list[int]
    shared: list[IntArray]
    below: list[list[int]]
    weight: FloatArray


def turn(structure: list[IntArray], touch: FloatArray, contacts: int) -> IntArray | None:
    """An order of the columns of a factor, with the same fill, in which contacts cost least.

    Args:
        structure: Rows below the diagonal of every column, ascending.
        touch: How many ends of a contact are expected at every column.
        contacts: Contacts to expect at a time.

    Returns:
        Columns in their new order; None where that gains too little.
    """
    if len(structure) <= FEW or not touch.any():
        return None
    forest = _forest(structure, touch)
    roots = [clique for clique, above in enumerate(forest.above) if above < 0]
    before, after = _Order(forest, touch), _Order(forest, touch)
    before.keep(structure)
    for root in roots:
        after.follow(min(_candidates(forest, root), key=lambda clique: after.follow(clique).cost(contacts)))
    # Costs of trees add up, so that each can be looked at by itself.
    sizes = np.array([rows.size for rows in structure], dtype=np.float64)
    products = 0.5 * float((sizes * (sizes + 1)).sum()) + before.cost(contacts)
    if before.cost(contacts) - after.cost(contacts) < WORTH * products:
        return None
    return after.columns()


def _forest(structure: list[IntArray], touch: FloatArray) -> _Forest:
    """Column j and its rows are part of the clique of a column before it that has just one row more."""
    clique = np.full(len(structure), -1)
    members: list[IntArray] = []
    last: list[int] = []
    weight: list[float] = []
    for column, rows in enumerate(structure):
        if clique[column] < 0:
            clique[column] = len(members)
            members.append(np.concatenate([[column], rows]).astype(np.int32))
            last.append(column)
            weight.append(0.0)
        last[clique[column]] = column
        weight[clique[column]] += touch[column]
        if rows.size and clique[rows[0]] < 0 and structure[rows[0]].size + 1 == rows.size:
            clique[rows[0]] = clique[column]
    shared = [structure[column] for column in last]
    above = [int(clique[rows[0]]) if rows.size else -1 for rows in shared]
    below: list[list[int]] = [[] for _ in members]
    for number in sorted(range(len(members)), key=lambda number: last[number]):
        if above[number] >= 0:
            below[above[number]].append(number)
            weight[above[number]] += weight[number]
    return _Forest(members, above, shared, below, np.array(weight))


def _candidates(forest: _Forest, root: int) -> list[int]:
    """A root and some of the cliques from there to a leaf, always to where the most weight is."""
    found = [root]
    while forest.weight[root] > 0.0 and forest.below[found[-1]]:
        found.append(max(forest.below[found[-1]], key=lambda clique: forest.weight[clique]))
    chosen = np.unique(np.linspace(0, len(found) - 1, MOST_ROOTS).astype(int))
    return [found[place] for place in chosen]


class _Order:
    """An order of the columns of some or all trees of a forest.

    Args:
        forest: Cliques.
        touch: How many ends of a contact are expected at every column.
    """

    def __init__(self, forest: _Forest, touch: FloatArray) -> None:
        self.forest, self.touch = forest, touch
        self.steps, self.blocks = np.zeros(touch.size), np.zeros(touch.size)  # from a column to its root
        self.parts: dict[int, list[IntArray]] = {}  # columns of every tree, by its old root
        self.burden, self.is_shared = touch.copy(), np.zeros(touch.size, dtype=bool)

    def keep(self, structure: list[IntArray]) -> None:
        """The order that the structure has."""
        for column in range(len(structure) - 1, -1, -1):
            rows = structure[column]
            above = rows[0] if rows.size else None
            self.steps[column] = 1.0 + (0.0 if above is None else self.steps[above])
            self.blocks[column] = rows.size + (0.0 if above is None else self.blocks[above])

    def follow(self, root: int) -> _Order:
        """Order the tree that a clique is part of with this one as its root."""
        forest = self.forest
        top = root
        while forest.above[top] >= 0:
            top = forest.above[top]
        parts = []
        waiting = [(root, -1)]
        while waiting:  # from the root on, the last subtree first, so that the result reversed is a postorder
            clique, origin = waiting.pop()
            shared = self._shared(clique, origin)
            self.is_shared[shared] = True
            own = forest.members[clique][~self.is_shared[forest.members[clique]]]
            self.is_shared[shared] = False
            onward = [(other, clique) for other in self._neighbours(clique) if other != origin]
            own = self._sorted(own, onward, top)
            first = -1 if shared.size == 0 else shared[np.argmax(self.steps[shared])]
            below = shared.size + np.arange(own.size)  # rows below every own column, from the last one on
            self.steps[own[::-1]] = np.arange(1, own.size + 1) + (0.0 if first < 0 else self.steps[first])
            self.blocks[own[::-1]] = np.cumsum(below) + (0.0 if first < 0 else self.blocks[first])
            parts.append(own)
            waiting += onward
        self.parts[top] = parts[::-1]
        return self

    def _neighbours(self, clique: int) -> list[int]:
        above = self.forest.above[clique]
        return [*([] if above < 0 else [above]), *self.forest.below[clique]]

    def _shared(self, clique: int, other: int) -> IntArray:
        """Columns in both of two neighbours."""
        if other < 0:
            return np.zeros(0, dtype=np.int32)
        return self.forest.shared[clique if self.forest.above[clique] == other else other]

    def _sorted(self, own: IntArray, onward: list[tuple[int, int]], top: int) -> IntArray:
        """Own columns of a clique, those last from which most of the weight is reached: its way begins there."""
        if own.size == 1:
            return own
        forest = self.forest
        for other, clique in onward:
            is_above = forest.above[clique] == other
            behind = forest.weight[top] - forest.weight[clique] if is_above else forest.weight[other]
            self.burden[self._shared(other, clique)] += behind
        result = own[np.argsort(self.burden[own], kind="stable")]
        for other, clique in onward:
            shared = self._shared(other, clique)
            self.burden[shared] = self.touch[shared]
        return result

    def cost(self, contacts: int) -> float:
        """Products of blocks in the sides of contacts and in what each two of them share."""
        pairs = 0.5 * contacts * (contacts + 1)
        return float(self.touch @ (contacts * self.blocks + pairs * self.steps))

    def columns(self) -> IntArray:
        """Columns in this order."""
        parts = [part for top in sorted(self.parts) for part in self.parts[top]]
        return np.concatenate(parts).astype(np.int32)
