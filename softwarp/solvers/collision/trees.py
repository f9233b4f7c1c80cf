"""Trees of boxes over the faces of targets, built once from the shape of rest. Theory: docs/theory/bvh.md."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

IntArray = NDArray[np.integer[Any]]
FloatArray = NDArray[np.float64]

LEAF = 4  # faces of a leaf
TASK = 63  # tree nodes that one thread of a GPU refits


@dataclass
class Trees:
    """Nodes of all trees in depth-first order, tree after tree.

    Attributes:
        skip: Node after the last descendant.
        first, last: Range in ``face`` of a leaf; -1 and -1 for inner nodes.
        face: Faces leaf by leaf.
        box: Low and high corner of every node at rest [m], shape (node, 6).
    """

    skip: list[int]
    first: list[int]
    last: list[int]
    face: list[int]
    box: list[FloatArray]

    @staticmethod
    def empty() -> Trees:
        """No trees yet."""
        return Trees([], [], [], [], [])

    def add(self, faces: IntArray, low: FloatArray, high: FloatArray) -> tuple[int, int]:
        """A tree over some faces, split at the median of the longest axis of their centres.

        Args:
            faces: Numbers of the faces, shape (f,).
            low: Low corners of their boxes [m], shape (f, 3).
            high: High corners [m].

        Returns:
            Root, and the node after the last one.
        """
        root = len(self.skip)
        if len(faces):
            self._node(np.arange(len(faces)), faces, low, high)
        return root, len(self.skip)

    def _node(self, some: IntArray, faces: IntArray, low: FloatArray, high: FloatArray) -> None:
        node = len(self.skip)
        self.skip.append(-1)
        self.first.append(-1)
        self.last.append(-1)
        self.box.append(np.concatenate([low[some].min(axis=0), high[some].max(axis=0)]))
        if len(some) <= LEAF:
            self.first[node] = len(self.face)
            self.face += faces[some].tolist()
            self.last[node] = len(self.face)
        else:
            centre = low[some] + high[some]
            axis = int(np.argmax(centre.max(axis=0) - centre.min(axis=0)))
            order = some[np.argsort(centre[:, axis], kind="stable")]
            half = len(order) // 2
            self._node(order[:half], faces, low, high)
            self._node(order[half:], faces, low, high)
        self.skip[node] = len(self.skip)

    def refit_tasks(self, roots: list[tuple[int, int]]) -> tuple[list[list[int]], list[list[int]]]:
        """Nodes by thread, children first: whole subtrees of at most ``TASK`` nodes, then all above them."""
        below: list[list[int]] = []
        above: list[int] = []
        for root, end in roots:
            node = root
            while node < end:
                if self.skip[node] - node <= TASK:
                    below.append(list(range(node, self.skip[node]))[::-1])
                    node = self.skip[node]
                else:
                    above.append(node)
                    node += 1
        return below, ([above[::-1]] if above else [])
