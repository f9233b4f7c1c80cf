"""Structure of the linear system: numbering of unknowns, blocks of A, entries of H and all gather lists. Host only."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp.plan.frames import FrameLayout
from softwarp.plan.ordering import Symbolic, analyze

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]
Arrays = dict[str, NDArray[Any]]


class Slots:
    """Unknowns behind the slots of a scene, before and after the elimination order is known.

    Args:
        fixed: Nodes that are held, (node,).
        locked: Axes of nodes that are held, (node, 3).
        frames: Frames of the scene, or None.
    """

    def __init__(self, fixed: NDArray[np.bool_], locked: NDArray[np.bool_], frames: FrameLayout | None) -> None:
        self.frames, self.locked = frames, locked
        is_own = ~fixed if frames is None else ~fixed & (frames.node_frame < 0)
        own = np.flatnonzero(is_own)
        count = len(fixed) if frames is None else frames.slot_count
        self.unknown = np.full(count + 1, -1, dtype=np.int64)  # one more: corner -1 has no unknown
        self.unknown[own] = np.arange(own.size)
        self.slot = own  # of an unknown
        self.item = np.full(count + 1, -1, dtype=np.int64)  # carried item of a slot
        if frames is not None:
            masters = np.flatnonzero(frames.master == np.arange(frames.count))
            slots = (frames.node_count + 2 * masters[:, None] + np.arange(2)).ravel()
            self.unknown[slots] = own.size + np.arange(slots.size)
            self.slot = np.concatenate([own, slots])
            slaves = np.flatnonzero(frames.master != np.arange(frames.count))
            rotation = frames.node_count + 2 * slaves + 1
            self.unknown[rotation] = self.unknown[frames.node_count + 2 * frames.master[slaves] + 1]
            self.item[frames.carried_slot] = np.arange(len(frames.carried_slot))
        self.borrowed = np.zeros(count + 1, dtype=bool)  # slots whose unknowns belong to another one
        if frames is not None:
            self.borrowed[frames.carried_slot] = True
            self.borrowed[rotation] = True

    @property
    def size(self) -> int:
        """Unknown 3-blocks."""
        return len(self.slot)

    def ordered(self, position: IntArray) -> None:
        """Number the unknowns in elimination order from here on."""
        has = self.unknown >= 0
        self.unknown[has] = position[self.unknown[has]]

    def free(self) -> FloatArray:
        """1 for unknown and 0 for prescribed scalars of every unknown in elimination order, (unknown, 3)."""
        result = np.ones((self.size, 3))
        node_unknown = self.unknown[: len(self.locked)]
        result[node_unknown[node_unknown >= 0]] = ~self.locked[node_unknown >= 0]
        if self.frames is not None:
            masters = np.flatnonzero(self.frames.master == np.arange(self.frames.count))
            slot = self.frames.node_count + 2 * masters
            result[self.unknown[slot]] = self.frames.free[masters, :3]
            result[self.unknown[slot + 1]] = self.frames.free[masters, 3:]
        return result

    def sides(self, slot: int) -> list[tuple[int, int]]:
        """(unknown, carried item or -1) that a slot's force goes to."""
        item = int(self.item[slot])
        if item < 0:
            return [(int(self.unknown[slot]), -1)] if self.unknown[slot] >= 0 else []
        assert self.frames is not None
        t = self.frames.node_count + 2 * int(self.frames.carried_frame[item])
        return [(int(self.unknown[t]), -1), (int(self.unknown[t + 1]), item)]

    def edges(self, corners: IntArray) -> NDArray[np.int64]:
        """Pairs of unknowns that elements couple."""
        borrowed = self.borrowed[corners].any(axis=1)
        plain = corners[~borrowed]
        pairs = [(a, b) for a in range(corners.shape[1]) for b in range(a)]
        parts = [np.concatenate([self.unknown[plain[:, [a, b]]] for a, b in pairs])]
        for element in corners[borrowed]:
            found = sorted({u for slot in element if slot >= 0 for u, _ in self.sides(int(slot))})
            parts.append(np.array([(a, b) for a in found for b in found if a > b], dtype=np.int64).reshape(-1, 2))
        return np.concatenate(parts)


def structure(
    nodes: FloatArray,
    fixed: NDArray[np.bool_],
    locked: NDArray[np.bool_],
    elements: dict[str, tuple[IntArray, NDArray[Any]]],
    row_starts: IntArray,
    points: Arrays,
    joint_frames: IntArray,
    frames: FrameLayout | None = None,
    with_segments: int = 0,
    extra_pairs: IntArray | None = None,
    contacts: int = 0,
) -> tuple[Symbolic, Arrays, Slots]:
    """Elimination order and all index lists that follow from it.

    Args:
        nodes: Rest positions [m], (node, 3).
        fixed: Nodes that are held.
        locked: Axes of nodes that are held, (node, 3).
        elements: Kind (``large``, ``stored``, ``membrane``, ``segment``, or ``quadratic`` before the first two) ->
            corners as slots (n, 4) or (n, 10), -1 for none, and the indices that codes of the elements use.
        row_starts: Ranges of the points of every cable and cavity.
        points: ``point_node`` (point, 4) and ``point_weight``.
        joint_frames: Frames (parent or -1, child) of every joint row.
        frames: Frames of the scene.
        with_segments: Cables whose segments' ends A couples.
        extra_pairs: Further pairs of nodes that A couples, (pair, 2).
        contacts: Contacts to expect at a time.
    """
    slots = Slots(fixed, locked, frames)
    edges = [slots.edges(corners) for corners, _ in elements.values() if len(corners)]
    segment, carrier, share = _segments(row_starts[: with_segments + 1], points)
    if with_segments:
        low, high = np.tril_indices(8, -1)
        used = (share[:, low] != 0.0) & (share[:, high] != 0.0)
        edges.append(slots.unknown[np.stack([carrier[:, low][used], carrier[:, high][used]], axis=1)])
    if extra_pairs is not None and len(extra_pairs):
        corners = np.full((len(extra_pairs), 4), -1)
        corners[:, :2] = extra_pairs
        edges.append(slots.edges(corners.astype(np.int32)))
    where = nodes[slots.slot[slots.slot < len(nodes)]]
    if frames is not None:
        own = slots.slot[slots.slot >= len(nodes)] - len(nodes)
        edges.append(np.stack([slots.unknown[len(nodes) + own[1::2]], slots.unknown[len(nodes) + own[::2]]], axis=1))
        where = np.concatenate([where, frames.pose[own // 2, :3]])
    pairs = np.concatenate(edges) if edges else np.empty((0, 2), dtype=np.int64)
    symbolic = analyze(pairs[(pairs >= 0).all(axis=1)].astype(np.int32), slots.size, where, contacts)
    slots.ordered(symbolic.position)
    arrays: Arrays = {"dof_node": slots.slot[symbolic.order].astype(np.int32)}
    arrays["node_dof"] = slots.unknown[: len(nodes)].astype(np.int32)
    arrays |= _prescribed(symbolic, slots.free())
    for kind, (corners, index) in elements.items():
        plain = ~slots.borrowed[corners].any(axis=1)
        start, entry = _block_entries(symbolic, slots.unknown, corners[plain], index[plain])
        arrays |= {f"{kind}_entry_start": start, f"{kind}_entry": entry}
        arrays |= _borrowed_entries(symbolic, slots, kind, corners[~plain], index[~plain])
    names = ("neighbour_start", "neighbour", "neighbour_block")
    arrays |= dict(zip(names, _neighbours(symbolic), strict=True))
    arrays |= _couplings(symbolic, slots.unknown, segment, carrier, share if with_segments else share[:0])
    arrays |= _row_entries(row_starts, points, slots, joint_frames)
    return symbolic, arrays, slots


def _prescribed(symbolic: Symbolic, dof_free: FloatArray) -> Arrays:
    """Dofs with prescribed scalars, those coupled to them, and the blocks of A that change."""
    is_bound = (dof_free == 0.0).any(axis=1)
    masked = np.flatnonzero(is_bound[symbolic.a_row] | is_bound[symbolic.a_col])
    return {
        "dof_free": dof_free,
        "prescribed_dof": np.flatnonzero(is_bound),
        "touched_dof": np.unique(np.concatenate([symbolic.a_row[masked], symbolic.a_col[masked]])),
        "masked_block": masked,
        "block_row": symbolic.a_row,
        "block_col": symbolic.a_col,
    }


def lists(keys: NDArray[Any], values: NDArray[Any], count: int) -> tuple[IntArray, IntArray]:
    """Group ``values`` by ``keys`` into (start, list); values keep their order within a key."""
    order = np.argsort(keys, kind="stable")
    start = np.searchsorted(keys[order], np.arange(count + 1))
    return start.astype(np.int32), values[order].astype(np.int32)


def _block_entries(symbolic: Symbolic, unknown: NDArray[Any], corners: IntArray, index: NDArray[Any]) -> Any:
    """For every stored block (i, j) of A the element blocks whose corners are i and j.

    With n corners, block (a, b) of an element is n n element + n a + b.
    """
    keys, codes, n = [], [], corners.shape[1]
    dof = unknown[corners]
    for a in range(n):
        for b in range(n):
            i, j = dof[:, a], dof[:, b]
            keep = (i >= 0) & (j >= 0) & (i >= j)
            keys.append(block_of(symbolic, i[keep], j[keep]))
            codes.append(n * n * index[keep] + n * a + b)
    return lists(np.concatenate(keys), np.concatenate(codes), len(symbolic.a_row))


def _borrowed_entries(symbolic: Symbolic, slots: Slots, kind: str, corners: IntArray, index: NDArray[Any]) -> Arrays:
    """Entries (block of an element, left item, right item) of elements with corners that frames carry, by block."""
    keys, codes, n = [], [], corners.shape[1]
    for element, number in zip(corners, index, strict=True):
        sides = [slots.sides(int(slot)) if slot >= 0 else [] for slot in element]
        for a in range(n):
            for b in range(n):
                for i, left in sides[a]:
                    for j, right in sides[b]:
                        if i >= j:
                            keys.append((i, j))
                            codes.append((n * n * int(number) + n * a + b, left, right))
    pairs = np.array(keys, dtype=np.int64).reshape(-1, 2)
    code = np.array(codes, dtype=np.int32).reshape(-1, 3)
    blocks, inverse = np.unique(block_of(symbolic, pairs[:, 0], pairs[:, 1]), return_inverse=True)
    start, order = lists(inverse, np.arange(len(code)), len(blocks))
    names = [f"{kind}_carried_{name}" for name in ("block", "start", "entry", "weight")]
    found = (blocks.astype(np.int32), start, code[order], np.ones(len(order)))
    arrays: Arrays = dict(zip(names, found, strict=True))
    slot = corners.ravel()
    held = np.flatnonzero((slot >= 0) & (slot < len(slots.locked)) & (slots.item[slot] >= 0))
    nodes, place = np.unique(slot[held], return_inverse=True)
    start, entry = lists(place, n * np.repeat(index, n)[held] + held % n, len(nodes))
    names = [f"{kind}_held_{name}" for name in ("node", "start", "entry", "weight")]
    return arrays | dict(zip(names, (nodes.astype(np.int32), start, entry, np.ones(len(entry))), strict=True))


def block_of(symbolic: Symbolic, i: NDArray[Any], j: NDArray[Any]) -> NDArray[np.int64]:
    """Stored blocks of A at rows i and columns j, i >= j."""
    n = symbolic.size
    lower = symbolic.a_col[n:].astype(np.int64) * n + symbolic.a_row[n:]
    block = i.astype(np.int64)
    off = i != j
    block[off] = n + np.searchsorted(lower, j[off].astype(np.int64) * n + i[off])
    return block


def _segments(row_starts: IntArray, points: dict[str, NDArray[Any]]) -> tuple[IntArray, NDArray[Any], FloatArray]:
    """For every cable segment its second point, the nodes of both ends (segment, 8) and their shares in its vector."""
    node, weight = points["point_node"].reshape(-1, 4), points["point_weight"].reshape(-1, 4)
    second = np.setdiff1d(np.arange(len(node)), row_starts).astype(np.int32)
    carrier = np.concatenate([node[second - 1], node[second]], axis=1)
    share = np.concatenate([-weight[second - 1], weight[second]], axis=1).astype(np.float64)
    return second, carrier, np.where(carrier >= 0, share, 0.0)


def _couplings(
    symbolic: Symbolic, unknown: NDArray[Any], segment: IntArray, carrier: NDArray[Any], share: FloatArray
) -> dict[str, NDArray[Any]]:
    """For every stored block (i, j) of A the segments whose stiffness it receives, with the weights s_i s_j."""
    names = ("coupling_start", "coupling_point", "coupling_weight")
    if len(share) == 0:
        return dict(zip(names, (np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros(0)), strict=True))
    dof = np.where(share != 0.0, unknown[carrier], -1).astype(np.int64)
    i, j = np.repeat(dof, 8, axis=1), np.tile(dof, (1, 8))
    weight = (share[:, :, None] * share[:, None, :]).reshape(len(share), 64)
    point = np.broadcast_to(segment[:, None], i.shape)
    keep = (i >= 0) & (j >= 0) & (i >= j)
    size = int(segment.max()) + 1
    unique, inverse = np.unique(block_of(symbolic, i[keep], j[keep]) * size + point[keep], return_inverse=True)
    start = np.searchsorted(unique // size, np.arange(len(symbolic.a_row) + 1)).astype(np.int32)
    total = np.bincount(inverse, weight[keep])
    return dict(zip(names, (start, (unique % size).astype(np.int32), total), strict=True))


def _neighbours(symbolic: Symbolic) -> tuple[IntArray, IntArray, IntArray]:
    """Full rows of A from its stored lower triangle."""
    n = symbolic.size
    block = np.arange(len(symbolic.a_row))
    row = np.concatenate([symbolic.a_row, symbolic.a_col[n:]])
    col = np.concatenate([symbolic.a_col, symbolic.a_row[n:]])
    code = np.concatenate([block, ~block[n:]])
    order = np.lexsort((col, row))
    start = np.searchsorted(row[order], np.arange(n + 1))
    return start.astype(np.int32), col[order].astype(np.int32), code[order].astype(np.int32)


def _row_entries(row_starts: IntArray, points: Arrays, slots: Slots, joint_frames: IntArray) -> Arrays:
    """Sparsity of H: one entry per row and unknown. Those of cables and cavities sum points, those of joints follow."""
    count, dofs = len(row_starts) - 1, max(slots.size, 1)
    point = np.repeat(np.arange(len(points["point_node"])), 4)
    row_of_point = np.repeat(np.arange(count), np.diff(row_starts))
    carrier, weights = points["point_node"].ravel().astype(np.int64), points["point_weight"].ravel()
    used = (carrier >= 0) & (weights != 0.0)
    own = used & (slots.unknown[carrier] >= 0)
    moments = [
        (k // 4, u, carried, k)
        for k in np.flatnonzero(used & (slots.item[carrier] >= 0))
        for u, carried in slots.sides(int(carrier[k]))
    ]
    extra = np.array(moments, dtype=np.int64).reshape(-1, 4)
    points_of = np.concatenate([point[own], extra[:, 0]])
    dof_of = np.concatenate([slots.unknown[carrier[own]], extra[:, 1]])
    item = np.concatenate([np.full(int(own.sum()), -1), extra[:, 2]])
    weight = np.concatenate([weights[own], weights[extra[:, 3]]])
    key = row_of_point[points_of].astype(np.int64) * dofs + dof_of
    unique, inverse = np.unique(key, return_inverse=True)
    entry_start, contribution = lists(inverse, np.arange(inverse.size), unique.size)
    joints = [
        (count + j, int(slots.unknown[slots.frames.node_count + 2 * int(slots.frames.master[f]) + half]))
        for j, pair in enumerate(joint_frames)
        for f in pair
        if f >= 0 and slots.frames is not None
        for half in range(2)
    ]
    tail = np.array(joints, dtype=np.int64).reshape(-1, 2)
    entry_row = np.concatenate([unique // dofs, tail[:, 0]]).astype(np.int32)
    entry_dof = np.concatenate([unique % dofs, tail[:, 1]]).astype(np.int32)
    dof_entry_start, dof_entry = lists(entry_dof, np.arange(entry_dof.size), slots.size)
    row_count = count + len(joint_frames)
    return {
        "entry_dof": entry_dof,
        "entry_row": entry_row,
        "entry_start": entry_start,
        "entry_point": points_of[contribution].astype(np.int32),
        "entry_weight": weight[contribution],
        "entry_item": item[contribution].astype(np.int32),
        "row_entry_start": np.searchsorted(entry_row, np.arange(row_count + 1)).astype(np.int32),
        "dof_entry_start": dof_entry_start,
        "dof_entry": dof_entry,
    }
