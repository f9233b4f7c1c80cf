"""Elements that share nodes, in patches: rows of modes at their nodes, each read once. Host only.

Theory: docs/theory/reduction.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp.model.codes import CHUNK_ROWS

IntArray = NDArray[np.int64]
MOST = CHUNK_ROWS // 3 + 1  # nodes of a patch; one of them has no rows


@dataclass(frozen=True)
class Chunk:
    """Patches that are summed up together. Corners count its nodes; those that others are counted against come last.

    Attributes:
        node: Node of every three rows.
        against: Node that it is counted against, of the same patch.
        elements: Of every kind, numbers of those here, (element,).
        corners: Of every kind, their corners, (element, corner).
    """

    node: IntArray
    against: IntArray
    elements: tuple[IntArray, ...]
    corners: tuple[IntArray, ...]


def chunks(kinds: Sequence[NDArray[Any]]) -> list[Chunk]:
    """All elements of a body in chunks of at most ``CHUNK_ROWS`` rows.

    Args:
        kinds: Nodes of the elements of every kind, (element, corner).
    """
    found: list[Chunk] = []
    waiting: list[_Patch] = []
    for patch in _patches(kinds):
        if waiting and 3 * (sum(len(p.nodes) - 1 for p in waiting) + len(patch.nodes) - 1) > CHUNK_ROWS:
            found.append(_chunk(waiting, kinds))
            waiting = []
        waiting.append(patch)
    if waiting:
        found.append(_chunk(waiting, kinds))
    return found


@dataclass(frozen=True)
class _Patch:
    """Elements, by kind and number, and their nodes."""

    elements: list[tuple[int, int]]
    nodes: list[int]


def _patches(kinds: Sequence[NDArray[Any]]) -> Iterator[_Patch]:
    """Patches that grow from element to element, by those first that bring the fewest nodes."""
    elements = [(kind, number) for kind, corners in enumerate(kinds) for number in range(len(corners))]
    corners = [tuple(int(n) for n in kinds[kind][number]) for kind, number in elements]
    touching: dict[int, list[int]] = {}
    for element, nodes in enumerate(corners):
        for node in nodes:
            touching.setdefault(node, []).append(element)
    is_left, widest = [True] * len(elements), max(of.shape[1] for of in kinds)
    for seed in range(len(elements)):
        if is_left[seed]:
            queues: list[list[int]] = [[] for _ in range(widest + 1)]
            chosen, inside = _grown(seed, corners, touching, is_left, queues)
            yield _Patch([elements[e] for e in chosen], inside)


def _grown(
    seed: int,
    corners: list[tuple[int, ...]],
    touching: dict[int, list[int]],
    is_left: list[bool],
    queues: list[list[int]],
) -> tuple[list[int], list[int]]:
    """Elements of one patch, which are then left no more, and its nodes; ``queues`` are empty, one for every count."""
    missing: dict[int, int] = {seed: len(corners[seed])}
    queues[missing[seed]].append(seed)
    chosen: list[int] = []
    nodes: dict[int, None] = {}
    while True:
        element = _next(queues, missing, is_left)
        if element is None or len(nodes) + missing[element] > MOST:
            return chosen, list(nodes)
        is_left[element] = False
        chosen.append(element)
        for node in corners[element]:
            if node in nodes:
                continue
            nodes[node] = None
            for other in touching[node]:
                if is_left[other]:
                    missing[other] = missing.get(other, len(corners[other])) - 1
                    queues[missing[other]].append(other)


def _next(queues: list[list[int]], missing: dict[int, int], is_left: list[bool]) -> int | None:
    """The element that brings the fewest nodes, of those the one that was met last; None without any."""
    for count, queue in enumerate(queues):
        while queue:
            element = queue.pop()
            if is_left[element] and missing[element] == count:
                return element
    return None


def _chunk(patches: list[_Patch], kinds: Sequence[NDArray[Any]]) -> Chunk:
    """Patches with rows for all nodes but the first of each."""
    node = [n for patch in patches for n in patch.nodes[1:]]
    against = [patch.nodes[0] for patch in patches for _ in patch.nodes[1:]]
    elements: list[list[int]] = [[] for _ in kinds]
    corners: list[list[list[int]]] = [[] for _ in kinds]
    first = 0
    for patch in patches:
        place = {patch.nodes[0]: len(node)} | {n: first + k for k, n in enumerate(patch.nodes[1:])}
        first += len(patch.nodes) - 1
        for kind, number in patch.elements:
            elements[kind].append(number)
            corners[kind].append([place[int(n)] for n in kinds[kind][number]])
    sizes = [of.shape[1] for of in kinds]
    return Chunk(
        np.array(node, dtype=np.int64),
        np.array(against, dtype=np.int64),
        tuple(np.array(of, dtype=np.int64) for of in elements),
        tuple(np.array(c, dtype=np.int64).reshape(-1, size) for c, size in zip(corners, sizes, strict=True)),
    )
