"""Symbolic analysis of the block-sparse Cholesky factor: ordering, fill and schedules.

Runs once per model, on the host. All worlds share the result, so the numeric factorisation on the device is a fixed
list of 3x3 block operations: no search, no pivoting, no branch on data. Theory: docs/theory/cholesky.md.
"""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict
from typing import TYPE_CHECKING
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from softwarp.model.structure import Symbolic
from softwarp.plan.turning import turn

if TYPE_CHECKING:
    from scipy.sparse import csr_array

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]

LEAF_SIZES = (24, 200)  # blocks below which nested dissection stops; the second is tried with contacts only
# Blocks from which on a search for the smallest separators pays: factors of the quadruped cost three quarters with
# 3 184 blocks and two thirds with 15 379; the search takes a second and a quarter of a minute.
LARGE = 3000
LARGE_LEAF = 60
DIRECTIONS = 24  # in half a turn, that cuts of a large model are tried across
SHARES = (0.5, 0.47, 0.53, 0.44, 0.56, 0.41, 0.59, 0.38, 0.62, 0.35, 0.65)  # of the blocks on the first side
FINALISTS = 10  # cuts with the fewest blocks along them, whose separators are found

# Structures that models hold, by what they follow from: the same scene with other worlds or precision shares its own.
_analyzed: WeakValueDictionary[bytes, Symbolic] = WeakValueDictionary()
_recent: OrderedDict[bytes, Symbolic] = OrderedDict()  # the latest ones stay for scenes that are built again
_lock = threading.Lock()
MOST_RECENT = 1 << 26  # bytes of their arrays


def analyze(
    edges: IntArray,
    count: int,
    points: FloatArray | None = None,
    contacts: int = 0,
    touch: FloatArray | None = None,
) -> Symbolic:
    """Order and factorise the pattern of a symmetric block matrix symbolically.

    Args:
        edges: Off-diagonal blocks as unordered index pairs, shape (edge, 2); duplicates are allowed.
        count: Number of block rows n.
        points: Positions of the rows [m], shape (n, 3). With them, nested dissection competes with minimum degree.
        contacts: Contacts to expect at a time. Each one costs a substitution along its path to the root, and each two
            of them a product along what they share of it, so a bushy tree may pay for a larger factor.
        touch: How many ends of a contact are expected at every row; the tree is then turned towards them, whatever its
            depth, with which it takes longer on a GPU.

    Returns:
        The structure with the cheapest ordering: fewest operations, a shallower tree breaking near ties.

    Reference:
        George (1973), nested dissection; Liu (1990), the role of elimination trees in sparse factorization.
    """
    edges = _unique_edges(edges)
    places = None if points is None else np.asarray(points, dtype=np.float64)
    given = hashlib.sha256(repr((count, contacts, edges.shape, points is None)).encode() + edges.tobytes())
    given.update(b"" if places is None else places.tobytes())
    given.update(b"" if touch is None else touch.tobytes())
    digest = given.digest()
    found = _analyzed.get(digest)
    if found is None:
        found = _analyzed[digest] = _analyze(edges, count, places, contacts, touch)
    with _lock:
        _recent[digest] = found
        _recent.move_to_end(digest)
        while sum(map(_bytes, _recent.values())) > MOST_RECENT:
            _recent.popitem(last=False)
    return found


def _bytes(symbolic: Symbolic) -> int:
    return sum(array.nbytes for array in vars(symbolic).values() if isinstance(array, np.ndarray))


def _analyze(
    edges: IntArray, count: int, points: FloatArray | None, contacts: int, touch: FloatArray | None
) -> Symbolic:
    """As ``analyze``, of edges without duplicates."""
    candidates = [_minimum_degree(edges, count)]
    leaves = (LARGE_LEAF,) if count >= LARGE else LEAF_SIZES if contacts else LEAF_SIZES[:1]
    for leaf in leaves:
        if points is not None and count > leaf:
            candidates.append(_nested_dissection(edges, points, leaf, is_large=count >= LARGE))
    best: tuple[float, IntArray, list[IntArray]] | None = None
    for order in candidates:
        structure = _factor_pattern(edges, order)
        depth = int(_levels(structure).max(initial=0)) + 1
        score = _products(structure, contacts) * (1.0 + 0.002 * depth)
        if best is None or score < best[0]:
            best = (score, order, structure)
    assert best is not None
    _, order, structure = best
    turned = None if touch is None or not contacts else turn(structure, touch[order], contacts)
    if turned is not None:
        order = order[turned]
        structure = _factor_pattern(edges, order)
    return _schedule(edges, order, structure)


def _products(structure: list[IntArray], contacts: int) -> float:
    """Products of blocks in a factorisation and in the response to some contacts at average places."""
    sizes = np.array([rows.size for rows in structure], dtype=np.float64)
    products = 0.5 * float((sizes * (sizes + 1)).sum())
    if contacts:
        steps, blocks = np.ones_like(sizes), sizes.copy()  # of the path from a row to its root
        for j in range(len(structure) - 1, -1, -1):
            if structure[j].size:
                steps[j] += steps[structure[j][0]]
                blocks[j] += blocks[structure[j][0]]
        products += contacts * float(blocks.mean()) + 0.5 * contacts * (contacts + 1) * float(steps.mean())
    return products


def _unique_edges(edges: IntArray) -> IntArray:
    pairs = np.sort(np.asarray(edges, dtype=np.int64).reshape(-1, 2), axis=1)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    return np.unique(pairs, axis=0).astype(np.int32)


def _minimum_degree(edges: IntArray, count: int) -> IntArray:
    """Multiple minimum degree on A + A', as SuperLU computes it."""
    from scipy.sparse import csr_array  # SciPy loads with the first model, not with the package
    from scipy.sparse.linalg import splu

    if count < 3 or len(edges) == 0:
        return np.arange(count, dtype=np.int32)
    rows = np.concatenate([edges[:, 0], edges[:, 1], np.arange(count)])
    cols = np.concatenate([edges[:, 1], edges[:, 0], np.arange(count)])
    degree = np.bincount(edges.ravel(), minlength=count)
    values = np.concatenate([np.full(2 * len(edges), -1.0), degree + 1.0])
    matrix = csr_array((values, (rows, cols)), shape=(count, count)).tocsc()
    factor = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return np.argsort(factor.perm_c).astype(np.int32)


def _nested_dissection(edges: IntArray, points: FloatArray, leaf: int, *, is_large: bool) -> IntArray:
    """Geometric nested dissection: cut across the longest axis at the median, order the separator last.

    Large models are cut across the best of many directions and places instead.
    """
    from scipy.sparse import csr_array

    count = len(points)
    graph = csr_array(
        (np.ones(2 * len(edges), dtype=np.int8), np.vstack([edges, edges[:, ::-1]]).T), shape=(count, count)
    )
    result: list[IntArray] = []
    is_later = np.zeros(count, dtype=bool)  # separators found so far

    def visit(nodes: IntArray) -> None:
        if nodes.size <= leaf:
            result.append(_order_leaf(graph, nodes, is_later))
            return
        x = points[nodes]
        if is_large:
            is_low, separator = _best_cut(graph, nodes, x)
        else:
            along = x[:, int(np.argmax(np.ptp(x, axis=0)))]
            is_low = _first_of(np.argsort(along, kind="stable"), 0.5)
            separator = _separator(graph, nodes, is_low)
        low, high = nodes[is_low & ~separator], nodes[~is_low & ~separator]
        if low.size == 0 or high.size == 0:
            result.append(_order_leaf(graph, nodes, is_later))
            return
        is_later[nodes[separator]] = True
        visit(low)
        visit(high)
        result.append(nodes[separator])

    visit(np.arange(count, dtype=np.int32))
    return np.concatenate(result).astype(np.int32)


def _first_of(order: NDArray[np.intp], share: float) -> NDArray[np.bool_]:
    """Whether points are among a share of them that comes first in an order."""
    result = np.zeros(order.size, dtype=bool)
    result[order[: int(share * order.size)]] = True
    return result


def _distinct(values: IntArray, count: int) -> int:
    """How many of the numbers below a count there are."""
    is_there = np.zeros(count, dtype=bool)
    is_there[values] = True
    return int(is_there.sum())


def _best_cut(graph: csr_array, nodes: IntArray, x: FloatArray) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Halves and separator of the cut, across the plane of the two longest axes, that costs least.

    A separator costs its size, more where the halves differ. Cuts are first judged by the blocks beside them; of the
    best the smallest separators are found.
    """
    across = np.argsort(-np.ptp(x, axis=0), kind="stable")[:2]
    angles = np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    local = graph[nodes][:, nodes].tocoo()
    cuts = []
    for angle in angles:
        place = np.cos(angle) * x[:, across[0]] + np.sin(angle) * x[:, across[1]]
        sorted_nodes = np.argsort(place, kind="stable")
        for share in SHARES:
            is_low = _first_of(sorted_nodes, share)
            is_cut = is_low[local.row] & ~is_low[local.col]
            size = min(_distinct(end[is_cut], nodes.size) for end in (local.row, local.col))
            cuts.append((size * (0.5 + max(share, 1.0 - share)), is_low))
    order = sorted(range(len(cuts)), key=lambda k: cuts[k][0])[:FINALISTS]
    best: tuple[float, NDArray[np.bool_], NDArray[np.bool_]] | None = None
    for k in order:
        is_low = cuts[k][1]
        separator = _separator(graph, nodes, is_low)
        larger = max(int((is_low & ~separator).sum()), int((~is_low & ~separator).sum())) / nodes.size
        cost = float(separator.sum()) * (0.5 + larger)
        if best is None or cost < best[0]:
            best = (cost, is_low, separator)
    assert best is not None
    return best[1], best[2]


def _separator(graph: csr_array, nodes: IntArray, is_low: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Smallest vertex set covering every edge between the two halves: minimum vertex cover by bipartite matching."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import maximum_bipartite_matching

    local = graph[nodes][:, nodes]
    low, high = np.flatnonzero(is_low), np.flatnonzero(~is_low)
    cut = csr_array(local[low][:, high])
    match_high = maximum_bipartite_matching(cut, perm_type="column")  # per low node, or -1
    match_low = np.full(high.size, -1)
    match_low[match_high[match_high >= 0]] = np.flatnonzero(match_high >= 0)
    # Koenig: alternate from unmatched low nodes; the cover is (low not reached) + (high reached).
    low_seen = match_high < 0
    high_seen = np.zeros(high.size, dtype=bool)
    stack = list(np.flatnonzero(low_seen))
    while stack:
        i = stack.pop()
        for j in cut.indices[cut.indptr[i] : cut.indptr[i + 1]]:
            if not high_seen[j]:
                high_seen[j] = True
                partner = match_low[j]
                if partner >= 0 and not low_seen[partner]:
                    low_seen[partner] = True
                    stack.append(partner)
    result = np.zeros(nodes.size, dtype=bool)
    result[low[~low_seen]] = True
    result[high[high_seen]] = True
    return result


def _order_leaf(graph: csr_array, nodes: IntArray, is_later: NDArray[np.bool_]) -> IntArray:
    """Minimum degree of some nodes that sees the separators around them, as a clique, which their elimination fills."""
    around = np.unique(graph[nodes].indices)
    around = around[is_later[around]].astype(np.int32)
    chosen = np.concatenate([nodes, around])
    local = graph[chosen][:, chosen].tocoo()
    keep = local.row < local.col
    clique = nodes.size + np.stack(np.tril_indices(around.size, -1), axis=1)
    edges = np.concatenate([np.stack([local.row[keep], local.col[keep]], axis=1), clique])
    order = _minimum_degree(_unique_edges(edges.astype(np.int32)), chosen.size)
    return nodes[order[order < nodes.size]]


def _factor_pattern(edges: IntArray, order: IntArray) -> list[IntArray]:
    """Rows below the diagonal of every column of L, ascending (merge of children along the elimination tree)."""
    count = order.size
    position = np.empty(count, dtype=np.int32)
    position[order] = np.arange(count, dtype=np.int32)
    ends = np.sort(position[edges], axis=1) if len(edges) else np.empty((0, 2), dtype=np.int32)
    ends = ends[np.lexsort((ends[:, 1], ends[:, 0]))]
    start = np.searchsorted(ends[:, 0], np.arange(count + 1))
    children: list[list[int]] = [[] for _ in range(count)]
    structure: list[IntArray] = []
    for j in range(count):
        parts = [ends[start[j] : start[j + 1], 1]] + [structure[c][1:] for c in children[j]]
        rows = np.unique(np.concatenate(parts)).astype(np.int32)
        structure.append(rows)
        if rows.size:
            children[rows[0]].append(j)
    return structure


def _levels(structure: list[IntArray]) -> IntArray:
    level = np.zeros(len(structure), dtype=np.int32)
    for j, rows in enumerate(structure):
        if rows.size:
            level[rows[0]] = max(level[rows[0]], level[j] + 1)
    return level


def _schedule(edges: IntArray, order: IntArray, structure: list[IntArray]) -> Symbolic:
    n = order.size
    position = np.empty(n, dtype=np.int32)
    position[order] = np.arange(n, dtype=np.int32)
    level = _levels(structure)

    sizes = np.array([rows.size for rows in structure], dtype=np.int64)
    diagonal = np.arange(n, dtype=np.int32)
    l_row = np.concatenate([diagonal, *structure]).astype(np.int32)
    l_col = np.concatenate([diagonal, np.repeat(diagonal, sizes)]).astype(np.int32)
    col_start = (n + np.concatenate([[0], np.cumsum(sizes)])).astype(np.int32)

    ends = np.sort(position[edges], axis=1).astype(np.int64) if len(edges) else np.empty((0, 2), dtype=np.int64)
    ends = ends[np.lexsort((ends[:, 1], ends[:, 0]))]  # by column, then row
    a_col = np.concatenate([diagonal, ends[:, 0]]).astype(np.int32)
    a_row = np.concatenate([diagonal, ends[:, 1]]).astype(np.int32)

    lower_key = l_col[n:].astype(np.int64) * n + l_row[n:]  # ascending by construction
    l_source = np.full(l_row.size, -1, dtype=np.int32)
    l_source[:n] = diagonal
    l_source[n + np.searchsorted(lower_key, ends[:, 0] * n + ends[:, 1])] = n + np.arange(len(ends), dtype=np.int32)

    by_row = n + np.lexsort((l_col[n:], l_row[n:]))
    row_start = np.searchsorted(l_row[by_row], np.arange(n + 1)).astype(np.int32)
    row_block = by_row.astype(np.int32)
    pair_start, pair_left, pair_right = _update_pairs(l_row, l_col, col_start, row_start, row_block)

    level_col = np.argsort(level, kind="stable").astype(np.int32)
    level_count = int(level.max(initial=0)) + 1
    level_start = np.searchsorted(level[level_col], np.arange(level_count + 1)).astype(np.int32)
    block_level = level[l_col]
    level_block = np.argsort(block_level, kind="stable").astype(np.int32)
    level_block_start = np.searchsorted(block_level[level_block], np.arange(level_count + 1)).astype(np.int32)
    return Symbolic(
        order=order.astype(np.int32),
        position=position,
        parent=np.array([rows[0] if rows.size else -1 for rows in structure], dtype=np.int32),
        level=level,
        a_row=a_row,
        a_col=a_col,
        l_row=l_row,
        l_col=l_col,
        l_source=l_source,
        col_start=col_start,
        row_start=row_start,
        row_block=row_block,
        pair_start=pair_start,
        pair_left=pair_left,
        pair_right=pair_right,
        level_start=level_start,
        level_col=level_col,
        level_block_start=level_block_start,
        level_block=level_block,
    )


def _update_pairs(
    l_row: IntArray, l_col: IntArray, col_start: IntArray, row_start: IntArray, row_block: IntArray
) -> tuple[IntArray, IntArray, IntArray]:
    """All products ``L_ik L_jk'`` sorted by the block (i, j) that they update, then by column k, and their ranges.

    Those of column j are found together: of every column k with a block (j, k), the blocks from that one on.
    """
    n = col_start.size - 1
    last = col_start[l_col[row_block] + 1]
    below = last - row_block - 1  # products that block (j, k) has with those below it
    counts = np.zeros(l_row.size, dtype=np.int64)
    counts[:n] = np.diff(row_start)
    left = np.empty(int(counts.sum() + below.sum(dtype=np.int64)), dtype=np.int32)
    right = np.empty_like(left)
    left[: row_block.size] = right[: row_block.size] = row_block  # of diagonal blocks
    place = np.empty(n, dtype=np.int32)  # of a row among those of column j
    end = row_block.size
    for j in range(n):
        blocks, count = row_block[row_start[j] : row_start[j + 1]], below[row_start[j] : row_start[j + 1]]
        total = int(count.sum())
        if total == 0:
            continue
        rights = np.repeat(blocks, count)
        lefts = np.arange(total, dtype=np.int32) + np.repeat(blocks + 1 - (np.cumsum(count) - count), count)
        begin, size = int(col_start[j]), int(col_start[j + 1] - col_start[j])
        place[l_row[begin : begin + size]] = np.arange(size)
        target = place[l_row[lefts]].astype(np.min_scalar_type(size))  # 16 bits are sorted digit by digit
        by_target = np.argsort(target, kind="stable")
        counts[begin : begin + size] = np.bincount(target, minlength=size)
        left[end : end + total], right[end : end + total] = lefts[by_target], rights[by_target]
        end += total
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int32), left, right
