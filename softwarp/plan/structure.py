"""Structure of the linear system: numbering of unknowns, blocks of A, entries of H and all gather lists. Host only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from softwarp.model.structure import GatherLists, Symbolic
from softwarp.plan.frames import FrameLayout
from softwarp.plan.ordering import analyze

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]
Kind = Literal["large", "stored", "quadraticlarge", "quadraticstored", "hex", "membrane", "segment"]


@dataclass(frozen=True)
class ModeBlocks:
    """Amplitudes of modes in the place of the nodes of reduced bodies, as 3-blocks.

    Attributes:
        node_body: Reduced body of every node, -1 for none, (node,).
        start: Ranges of the blocks of every reduced body, (reduced body + 1,).
        centre: Where these bodies are [m], (reduced body, 3).
    """

    node_body: IntArray
    start: IntArray
    centre: FloatArray

    @property
    def count(self) -> int:
        """Blocks."""
        return int(self.start[-1])


class Slots:
    """Unknowns behind the slots of a scene, before and after the elimination order is known.

    Slots are nodes, then translations and rotations of frames, then blocks of modes.

    Args:
        fixed: Nodes that are held, (node,).
        locked: Axes of nodes that are held, (node, 3).
        frames: Frames of the scene, or None.
        modes: Modes of reduced bodies, whose nodes have no unknowns, or None.
    """

    def __init__(
        self,
        fixed: NDArray[np.bool_],
        locked: NDArray[np.bool_],
        frames: FrameLayout | None,
        modes: ModeBlocks | None = None,
    ) -> None:
        self.frames, self.locked = frames, locked
        is_own = ~fixed if frames is None else ~fixed & (frames.node_frame < 0)
        if modes is not None:
            is_own &= modes.node_body < 0
        own = np.flatnonzero(is_own)
        self.first_mode = len(fixed) if frames is None else frames.slot_count
        count = self.first_mode + (0 if modes is None else modes.count)
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
        blocks = np.arange(self.first_mode, count)
        self.unknown[blocks] = len(self.slot) + np.arange(blocks.size)
        self.slot = np.concatenate([self.slot, blocks])
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


@dataclass(frozen=True)
class Elements:
    """Elements of one kind.

    Attributes:
        kind: How they keep their stiffness.
        corners: Their nodes as slots, -1 for none, shape (element, 4), (element, 8) or (element, 10).
        number: Numbers that codes of their blocks use, shape (element,).
    """

    kind: Kind
    corners: IntArray
    number: NDArray[Any]

    def chosen(self, keep: NDArray[np.bool_]) -> Elements:
        """Some of them; their numbers stay."""
        return Elements(self.kind, self.corners[keep], self.number[keep])


@dataclass(frozen=True)
class Points:
    """Points that multiplier rows act on, under the names that ``Model`` declares: of cables, then of chambers."""

    point_node: IntArray  # (point, 4) nodes that carry it, -1 for none
    point_weight: FloatArray  # (point, 4)
    point_anchor: FloatArray  # (point, 3) of a point fixed in space [m]

    def followed_by(self, other: Points) -> Points:
        """These points, then others."""
        return Points(
            np.concatenate([self.point_node, other.point_node]),
            np.concatenate([self.point_weight, other.point_weight]),
            np.concatenate([self.point_anchor, other.point_anchor]),
        )


@dataclass(frozen=True)
class ElementLists:
    """Which blocks of A receive the element blocks of one kind, and which carried nodes their forces."""

    start: IntArray  # (block + 1,) ranges in entry, of elements that keep all their unknowns
    entry: IntArray  # n n element + n a + b of element blocks with n corners
    carried: GatherLists  # the same of elements with corners that frames carry
    held: GatherLists  # n element + corner at every carried node


@dataclass(frozen=True)
class Unknowns:
    """Unknowns in elimination order, under the names that ``Model`` declares."""

    dof_node: IntArray
    node_dof: IntArray
    dof_free: FloatArray
    prescribed_dof: NDArray[Any]
    touched_dof: NDArray[Any]
    masked_block: NDArray[Any]
    block_row: IntArray
    block_col: IntArray


@dataclass(frozen=True)
class Neighbours:
    """Full rows of A, under the names that ``Model`` declares."""

    neighbour_start: IntArray
    neighbour: IntArray
    neighbour_block: IntArray


@dataclass(frozen=True)
class Couplings:
    """What taut cables add to A, under the names that ``Model`` declares."""

    coupling_start: IntArray
    coupling_point: IntArray
    coupling_weight: FloatArray


@dataclass(frozen=True)
class RowEntries:
    """Sparsity of H, under the names that ``Model`` declares."""

    entry_dof: IntArray
    entry_row: IntArray
    entry_start: IntArray
    entry_point: IntArray
    entry_weight: FloatArray
    entry_item: IntArray
    row_entry_start: IntArray
    dof_entry_start: IntArray
    dof_entry: IntArray


@dataclass(frozen=True)
class Structure:
    """Elimination order and all index lists that follow from it."""

    symbolic: Symbolic
    slots: Slots
    unknowns: Unknowns
    neighbours: Neighbours
    couplings: Couplings
    rows: RowEntries
    lists: dict[Kind, ElementLists]

    def model_arrays(self) -> dict[str, Any]:
        """Arrays of ``Model`` that depend on the elimination order."""
        large, stored = self.lists["large"], self.lists["stored"]
        return {
            **vars(self.unknowns),
            **vars(self.neighbours),
            **vars(self.couplings),
            **vars(self.rows),
            "large_entry_start": large.start,
            "large_entry": large.entry,
            "stored_entry_start": stored.start,
            "stored_entry": stored.entry,
            "stored_block": _blocks_of_tets(stored),
        }


def structure(
    nodes: FloatArray,
    fixed: NDArray[np.bool_],
    locked: NDArray[np.bool_],
    elements: Sequence[Elements],
    row_starts: IntArray,
    points: Points,
    joint_frames: IntArray,
    frames: FrameLayout | None = None,
    with_segments: int = 0,
    contacts: int = 0,
    modes: ModeBlocks | None = None,
    touch: FloatArray | None = None,
    ties: IntArray | None = None,
) -> Structure:
    """Order the unknowns of a scene and list what every block of A and every entry of H receives.

    Args:
        nodes: Rest positions [m], (node, 3).
        fixed: Nodes that are held.
        locked: Axes of nodes that are held, (node, 3).
        elements: All elements, ``large`` and ``stored`` ones among them.
        row_starts: Ranges of the points of every cable and cavity.
        points: Points of cables and cavities.
        joint_frames: Frames (parent or -1, child) of every joint row.
        frames: Frames of the scene.
        with_segments: Cables whose segments' ends A couples.
        contacts: Contacts to expect at a time.
        modes: Modes of reduced bodies.
        touch: How many ends of a contact are expected at every slot but those of modes.
        ties: Pairs of nodes that A couples besides those of elements, (tie, 2).
    """
    slots = Slots(fixed, locked, frames, modes)
    segment, carrier, share = _segments(row_starts[: with_segments + 1], points)
    share = share if with_segments else share[:0]
    edges = [slots.edges(part.corners) for part in elements if len(part.corners)]
    edges += _segment_edges(slots, carrier, share)
    if ties is not None:
        edges.append(slots.unknown[ties])
    where = nodes[slots.slot[slots.slot < len(nodes)]]
    if frames is not None:
        own = slots.slot[(slots.slot >= len(nodes)) & (slots.slot < slots.first_mode)] - len(nodes)
        edges.append(np.stack([slots.unknown[len(nodes) + own[1::2]], slots.unknown[len(nodes) + own[::2]]], axis=1))
        where = np.concatenate([where, frames.pose[own // 2, :3]])
    if modes is not None:
        edges += _mode_edges(slots, modes)
        where = np.concatenate([where, np.repeat(modes.centre, np.diff(modes.start), axis=0)])
    pairs = np.concatenate(edges) if edges else np.empty((0, 2), dtype=np.int64)
    if touch is not None:
        touch = touch[slots.slot]
    symbolic = analyze(pairs[(pairs >= 0).all(axis=1)].astype(np.int32), slots.size, where, contacts, touch)
    slots.ordered(symbolic.position)
    return Structure(
        symbolic=symbolic,
        slots=slots,
        unknowns=_unknowns(symbolic, slots, len(nodes)),
        neighbours=_neighbours(symbolic),
        couplings=_couplings(symbolic, slots.unknown, segment, carrier, share),
        rows=_row_entries(row_starts, points, slots, joint_frames, modes),
        lists={part.kind: _element_lists(symbolic, slots, part) for part in elements},
    )


def _mode_edges(slots: Slots, modes: ModeBlocks) -> list[NDArray[np.int64]]:
    """Pairs of unknowns: all modes of a body are coupled."""
    edges = []
    for first, end in zip(modes.start[:-1], modes.start[1:], strict=True):
        low, high = np.tril_indices(int(end - first), -1)
        unknown = slots.unknown[slots.first_mode + np.arange(first, end)]
        edges.append(np.stack([unknown[low], unknown[high]], axis=1))
    return edges


def _segment_edges(slots: Slots, carrier: NDArray[Any], share: FloatArray) -> list[NDArray[np.int64]]:
    """Pairs of unknowns that taut cable segments couple."""
    if len(share) == 0:
        return []
    low, high = np.tril_indices(8, -1)
    used = (share[:, low] != 0.0) & (share[:, high] != 0.0)
    return [slots.unknown[np.stack([carrier[:, low][used], carrier[:, high][used]], axis=1)]]


def _unknowns(symbolic: Symbolic, slots: Slots, node_count: int) -> Unknowns:
    """Numbering, dofs with prescribed scalars, those coupled to them, and the blocks of A that change."""
    dof_free = slots.free()
    is_bound = (dof_free == 0.0).any(axis=1)
    masked = np.flatnonzero(is_bound[symbolic.a_row] | is_bound[symbolic.a_col])
    return Unknowns(
        dof_node=slots.slot[symbolic.order].astype(np.int32),
        node_dof=slots.unknown[:node_count].astype(np.int32),
        dof_free=dof_free,
        prescribed_dof=np.flatnonzero(is_bound),
        touched_dof=np.unique(np.concatenate([symbolic.a_row[masked], symbolic.a_col[masked]])),
        masked_block=masked,
        block_row=symbolic.a_row,
        block_col=symbolic.a_col,
    )


def lists(keys: NDArray[Any], values: NDArray[Any], count: int) -> tuple[IntArray, IntArray]:
    """Group ``values`` by ``keys`` into (start, list); values keep their order within a key."""
    order = np.argsort(keys, kind="stable")
    start = np.searchsorted(keys[order], np.arange(count + 1))
    return start.astype(np.int32), values[order].astype(np.int32)


def _element_lists(symbolic: Symbolic, slots: Slots, elements: Elements) -> ElementLists:
    """Entries of all elements of one kind; those with corners that frames carry go elsewhere."""
    plain = ~slots.borrowed[elements.corners].any(axis=1)
    start, entry = _block_entries(symbolic, slots.unknown, elements.corners[plain], elements.number[plain])
    corners, number = elements.corners[~plain], elements.number[~plain]
    carried = _carried_blocks(symbolic, slots, corners, number)
    return ElementLists(start, entry, carried, _held_nodes(slots, corners, number))


def _block_entries(
    symbolic: Symbolic, unknown: NDArray[Any], corners: IntArray, number: NDArray[Any]
) -> tuple[IntArray, IntArray]:
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
            codes.append(n * n * number[keep] + n * a + b)
    return lists(np.concatenate(keys), np.concatenate(codes), len(symbolic.a_row))


def _blocks_of_tets(stored: ElementLists) -> IntArray:
    """The other way round: of every tet up to the last that stores its stiffness, where its blocks K_ab, a >= b, go."""
    block = np.repeat(np.arange(len(stored.start) - 1), np.diff(stored.start))
    tet, a, b = stored.entry >> 4, (stored.entry >> 2) & 3, stored.entry & 3
    high, low = np.maximum(a, b), np.minimum(a, b)
    found = np.full((int(tet.max(initial=-1)) + 1, 10), -1, dtype=np.int32)
    found[tet, high * (high + 1) // 2 + low] = 2 * block + (a < b)
    return found


def _carried_blocks(symbolic: Symbolic, slots: Slots, corners: IntArray, number: NDArray[Any]) -> GatherLists:
    """Entries (block of an element, left item, right item) of elements with corners that frames carry, by block.

    A block all of whose scalars are prescribed is left out: nobody reads it, and that of a kinematic body would sum up
    everything fixed to it.
    """
    keys, codes, n = [], [], corners.shape[1]
    held = (slots.free() == 0.0).all(axis=1)
    for element, index in zip(corners, number, strict=True):
        sides = [slots.sides(int(slot)) if slot >= 0 else [] for slot in element]
        for a in range(n):
            for b in range(n):
                for i, left in sides[a]:
                    for j, right in sides[b]:
                        if i >= j and not (held[i] and held[j]):
                            keys.append((i, j))
                            codes.append((n * n * int(index) + n * a + b, left, right))
    pairs = np.array(keys, dtype=np.int64).reshape(-1, 2)
    code = np.array(codes, dtype=np.int32).reshape(-1, 3)
    blocks, inverse = np.unique(block_of(symbolic, pairs[:, 0], pairs[:, 1]), return_inverse=True)
    start, order = lists(inverse, np.arange(len(code)), len(blocks))
    return GatherLists(blocks.astype(np.int32), start, code[order], np.ones(len(order)))


def _held_nodes(slots: Slots, corners: IntArray, number: NDArray[Any]) -> GatherLists:
    """Corners (n element + corner) of such elements at every node that a frame carries."""
    slot, n = corners.ravel(), corners.shape[1]
    held = np.flatnonzero((slot >= 0) & (slot < len(slots.locked)) & (slots.item[slot] >= 0))
    nodes, place = np.unique(slot[held], return_inverse=True)
    start, entry = lists(place, n * np.repeat(number, n)[held] + held % n, len(nodes))
    return GatherLists(nodes.astype(np.int32), start, entry, np.ones(len(entry)))


def block_of(symbolic: Symbolic, i: NDArray[Any], j: NDArray[Any]) -> NDArray[np.int64]:
    """Stored blocks of A at rows i and columns j, i >= j."""
    n = symbolic.size
    lower = symbolic.a_col[n:].astype(np.int64) * n + symbolic.a_row[n:]
    block = i.astype(np.int64)
    off = i != j
    block[off] = n + np.searchsorted(lower, j[off].astype(np.int64) * n + i[off])
    return block


def _segments(row_starts: IntArray, points: Points) -> tuple[IntArray, NDArray[Any], FloatArray]:
    """For every cable segment its second point, the nodes of both ends (segment, 8) and their shares in its vector."""
    node, weight = points.point_node, points.point_weight
    second = np.setdiff1d(np.arange(row_starts[-1]), row_starts).astype(np.int32)
    carrier = np.concatenate([node[second - 1], node[second]], axis=1)
    share = np.concatenate([-weight[second - 1], weight[second]], axis=1).astype(np.float64)
    return second, carrier, np.where(carrier >= 0, share, 0.0)


def _couplings(
    symbolic: Symbolic, unknown: NDArray[Any], segment: IntArray, carrier: NDArray[Any], share: FloatArray
) -> Couplings:
    """For every stored block (i, j) of A the segments whose stiffness it receives, with the weights s_i s_j."""
    if len(share) == 0:
        return Couplings(np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros(0))
    dof = np.where(share != 0.0, unknown[carrier], -1).astype(np.int64)
    i, j = np.repeat(dof, 8, axis=1), np.tile(dof, (1, 8))
    weight = (share[:, :, None] * share[:, None, :]).reshape(len(share), 64)
    point = np.broadcast_to(segment[:, None], i.shape)
    keep = (i >= 0) & (j >= 0) & (i >= j)
    size = int(segment.max()) + 1
    unique, inverse = np.unique(block_of(symbolic, i[keep], j[keep]) * size + point[keep], return_inverse=True)
    start = np.searchsorted(unique // size, np.arange(len(symbolic.a_row) + 1)).astype(np.int32)
    total = np.bincount(inverse, weight[keep]).astype(np.float64)
    return Couplings(start, (unique % size).astype(np.int32), total)


def _neighbours(symbolic: Symbolic) -> Neighbours:
    """Full rows of A from its stored lower triangle."""
    n = symbolic.size
    block = np.arange(len(symbolic.a_row))
    row = np.concatenate([symbolic.a_row, symbolic.a_col[n:]])
    col = np.concatenate([symbolic.a_col, symbolic.a_row[n:]])
    code = np.concatenate([block, ~block[n:]])
    order = np.lexsort((col, row))
    start = np.searchsorted(row[order], np.arange(n + 1))
    return Neighbours(start.astype(np.int32), col[order].astype(np.int32), code[order].astype(np.int32))


def _row_entries(
    row_starts: IntArray, points: Points, slots: Slots, joint_frames: IntArray, modes: ModeBlocks | None
) -> RowEntries:
    """Sparsity of H: one entry per row and unknown. Those of cables and cavities sum points, those of joints follow.

    Entries of modes sum nothing here; ``kernels.elements.reduction`` fills them.
    """
    count, dofs = len(row_starts) - 1, max(slots.size, 1)
    point = np.repeat(np.arange(len(points.point_node)), 4)
    row_of_point = np.repeat(np.arange(count), np.diff(row_starts))
    carrier, weights = points.point_node.ravel().astype(np.int64), points.point_weight.ravel()
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
    of_modes = np.empty(0, dtype=np.int64)
    if modes is not None:
        body = modes.node_body[carrier]
        touched = np.unique(np.stack([row_of_point[point], body], axis=1)[used & (body >= 0)], axis=0)
        blocks = [(int(r), np.arange(modes.start[b], modes.start[b + 1])) for r, b in touched]
        of_modes = np.concatenate([of_modes, *(r * dofs + slots.unknown[slots.first_mode + k] for r, k in blocks)])
    unique, inverse = np.unique(np.concatenate([key, of_modes]), return_inverse=True)
    entry_start, contribution = lists(inverse[: len(key)], np.arange(len(key)), unique.size)
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
    return RowEntries(
        entry_dof=entry_dof,
        entry_row=entry_row,
        entry_start=entry_start,
        entry_point=points_of[contribution].astype(np.int32),
        entry_weight=weight[contribution],
        entry_item=item[contribution].astype(np.int32),
        row_entry_start=np.searchsorted(entry_row, np.arange(row_count + 1)).astype(np.int32),
        dof_entry_start=dof_entry_start,
        dof_entry=dof_entry,
    )
