"""Symbolic analysis and numeric factorisation against dense linear algebra."""

from itertools import pairwise

import numpy as np
import pytest
import warp as wp

from softwarp import meshing
from softwarp.kernels.algebra.lanes import variant
from softwarp.kernels.linear import cholesky_runs
from softwarp.model.structure import Symbolic
from softwarp.plan import ordering
from softwarp.plan.ordering import analyze
from softwarp.solvers.linear import strips
from softwarp.solvers.linear.cholesky import LinearSolver, upload
from softwarp.solvers.linear.lu import LUSolver
from softwarp.solvers.workspace.rows import allocate
from tests.matrix_cases import dense, random_blocks

# "runs" is that of a large world by itself on a CPU; the last is the way of many worlds on a GPU, here with one thread
# and one world to a block.
VARIANTS = [
    ("scalar", "float64", 1e-11),
    ("scalar", "float32", 1e-4),
    ("runs", "float32", 1e-4),
    ("lanes", "float32", 1e-4),
    ("cuda", "float64", 1e-11),
]


def mesh_pattern() -> tuple[np.ndarray, int, np.ndarray]:
    mesh = meshing.box((1.0, 0.4, 0.3), (6, 3, 2))
    pairs = [(a, b) for a in range(4) for b in range(a)]
    return np.concatenate([mesh.tets[:, pair] for pair in pairs]), len(mesh.nodes), mesh.nodes


def random_pattern(rng: np.random.Generator) -> tuple[np.ndarray, int, None]:
    return rng.integers(0, 40, (90, 2)).astype(np.int32), 40, None


def isolated_pattern() -> tuple[np.ndarray, int, None]:
    """Three blocks without a coupling, and none at all."""
    return np.array([[0, 2]], dtype=np.int32), 4, None


def full_pattern() -> tuple[np.ndarray, int, None]:
    """Every block coupled with every other, which makes strips as wide as they can be."""
    return np.array([(a, b) for a in range(29) for b in range(a)], dtype=np.int32), 29, None


def bar_pattern() -> tuple[np.ndarray, int, np.ndarray]:
    """A bar long enough for the two sizes of leaves to differ."""
    mesh = meshing.box((3.0, 0.4, 0.4), (30, 3, 3))
    pairs = [(a, b) for a in range(4) for b in range(a)]
    return np.concatenate([mesh.tets[:, pair] for pair in pairs]), len(mesh.nodes), mesh.nodes


@pytest.fixture(params=["mesh", "contacts", "turned", "searched", "random", "isolated", "full"])
def symbolic(request: pytest.FixtureRequest, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> Symbolic:
    if request.param == "searched":  # as models of thousands of blocks
        monkeypatch.setattr(ordering, "LARGE", 20)
        monkeypatch.setattr(ordering, "LARGE_LEAF", 8)
        monkeypatch.setattr(ordering, "_minimum_degree", lambda edges, count: np.arange(count, dtype=np.int32))
        return analyze(*mesh_pattern())
    if request.param == "contacts":
        return analyze(*mesh_pattern(), contacts=24)
    if request.param == "turned":
        edges, count, nodes = bar_pattern()
        near = nodes[:, 0] > 2.75
        return analyze(edges, count, nodes, 24, near / near.sum())
    patterns = {"mesh": mesh_pattern, "random": lambda: random_pattern(rng), "isolated": isolated_pattern}
    patterns["full"] = full_pattern
    return analyze(*patterns[request.param]())


def test_strips_have_every_product_once(symbolic: Symbolic) -> None:
    """Products of strips, and within them, are as many as the structure's; a strip's columns follow one another."""
    plan = strips.schedule(symbolic)
    width = np.diff(plan.strip_start)
    assert plan.strip_start[0] == 0
    assert plan.strip_start[-1] == symbolic.size
    assert np.all((width > 0) & (width <= strips.WIDTH))
    products = 0
    for first, columns, top, own, _ in plan.source.tolist():
        rows = int(np.diff(symbolic.col_start)[first + columns - 1]) - top
        products += columns * (own * rows - own * (own - 1) // 2)
    for first, columns in zip(plan.strip_start[:-1].tolist(), width.tolist(), strict=True):
        rows = 1 + int(np.diff(symbolic.col_start)[first])
        products += sum(j * (rows - j) for j in range(columns))
    assert products == symbolic.pair_left.size


def test_runs_are_rows_that_follow_one_another(symbolic: Symbolic) -> None:
    """Strips of a world by itself have every product once, and rows of L that a run names are the strip's."""
    plan = strips.runs(symbolic)
    below = [symbolic.l_row[begin:end] for begin, end in pairwise(symbolic.col_start.tolist())]
    starts, products = plan.run_strip_start.tolist(), 0
    for strip, (first, end) in enumerate(pairwise(starts)):
        assert 0 < end - first <= cholesky_runs.MOST
        rows = np.concatenate([np.arange(first, end), below[end - 1]])
        products += sum(j * (rows.size - j) for j in range(end - first))
        for number in range(*plan.run_strip_source[strip : strip + 2]):
            k, columns, top, own, begin, run = plan.run_source[number].tolist()
            named = [rows[plan.run_place[begin : begin + own]]]
            for at, to, count in plan.run[run : plan.run_source[number + 1, 5]].tolist():
                assert at == sum(part.size for part in named)
                named.append(rows[to : to + count])
            np.testing.assert_array_equal(np.concatenate(named), below[k + columns - 1][top:])
            count = below[k + columns - 1].size - top
            products += columns * (own * count - own * (own - 1) // 2)
    assert products == symbolic.pair_left.size


def test_large_worlds_alone_go_strip_by_strip() -> None:
    """A structure of few products keeps the list of them; one with many has strips, and their arrays on a CPU."""
    edges = np.array([(a, b) for a in range(90) for b in range(a)], dtype=np.int32)
    for symbolic, is_large in ((analyze(*mesh_pattern()), False), (analyze(edges, 90), True)):
        index = upload(symbolic, "cpu")
        assert strips.pay_alone(symbolic) == is_large == ("run" in index)
        solver = LinearSolver(symbolic, index, variant("scalar", "float32"), 1, 1, "cpu")
        assert (solver.strips is not None) == is_large


@pytest.mark.parametrize(
    ("lanes", "precision", "goes_by_pairs"),
    [("scalar", "float64", True), ("scalar", "float32", False), ("lanes", "float32", False)],
)
def test_only_who_goes_pair_by_pair_has_pairs_on_the_device(lanes: str, precision: str, goes_by_pairs: bool) -> None:
    """The longest lists of a structure, which strips do without; they come where the first solver needs them."""
    symbolic = analyze(*mesh_pattern())
    index = upload(symbolic, "cpu")
    LinearSolver(symbolic, index, variant(lanes, precision), 8, 1, "cpu")
    assert ("pair_left" in index) == goes_by_pairs
    LUSolver(LinearSolver(symbolic, index, variant("lanes", "float32"), 8, 1, "cpu"))
    assert index["pair_left"].size == symbolic.pair_left.size


def test_a_search_finds_smaller_separators() -> None:
    """A bar askew to the axes: cuts across the best of many directions leave fewer products than across an axis."""
    edges, _, nodes = bar_pattern()
    turn = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])

    def products(is_large: bool) -> float:
        order = ordering._nested_dissection(ordering._unique_edges(edges), nodes @ turn.T, 24, is_large=is_large)
        assert sorted(order) == list(range(len(nodes)))
        return ordering._products(ordering._factor_pattern(edges, order), 0)

    assert products(True) < 0.9 * products(False)


def test_contacts_weigh_paths() -> None:
    """With contacts expected, the order may factor with more products, but paths to the root are no longer."""

    def path(structure: Symbolic) -> float:
        """Mean number of blocks of L in the columns between a row and its root."""
        below = np.bincount(structure.l_col, minlength=structure.size)
        total = below.astype(float)
        for j in range(structure.size - 1, -1, -1):
            if structure.parent[j] >= 0:
                total[j] += total[structure.parent[j]]
        return float(total.mean())

    free, touched = analyze(*bar_pattern()), analyze(*bar_pattern(), contacts=24)
    assert touched.flops >= free.flops
    assert path(touched) < path(free)


def test_structure_contains_pattern_and_fill(symbolic: Symbolic) -> None:
    """L has the pattern of a dense factorisation of the permuted matrix, and every A block has its place."""
    n = symbolic.size
    assert sorted(symbolic.order) == list(range(n))
    np.testing.assert_array_equal(symbolic.order[symbolic.position], np.arange(n))
    pattern = np.eye(n, dtype=bool)
    pattern[symbolic.a_row, symbolic.a_col] = True
    for k in range(n):  # elimination: rows below k become coupled
        rows = np.flatnonzero(pattern[k + 1 :, k]) + k + 1
        for j in rows:
            pattern[rows[rows >= j], j] = True
    expected = {(int(i), int(j)) for i, j in zip(*np.nonzero(np.tril(pattern)), strict=True)}
    assert set(zip(symbolic.l_row.tolist(), symbolic.l_col.tolist(), strict=True)) == expected
    stored = symbolic.l_source >= 0
    np.testing.assert_array_equal(symbolic.l_row[stored], symbolic.a_row[symbolic.l_source[stored]])
    np.testing.assert_array_equal(symbolic.l_col[stored], symbolic.a_col[symbolic.l_source[stored]])
    assert stored.sum() == len(symbolic.a_row)


def test_levels_never_depend_on_themselves(symbolic: Symbolic) -> None:
    """A block's updates come from columns of lower levels, so a level may be computed in any order."""
    level = symbolic.level
    target = np.repeat(np.arange(symbolic.block_count), np.diff(symbolic.pair_start))
    source = symbolic.l_col[symbolic.pair_left]
    assert (level[source] < level[symbolic.l_col[target]]).all()
    np.testing.assert_array_equal(symbolic.l_row[symbolic.pair_left], symbolic.l_row[target])
    np.testing.assert_array_equal(symbolic.l_row[symbolic.pair_right], symbolic.l_col[target])


@pytest.mark.parametrize(
    ("name", "precision", "tolerance", "sides"),
    [*((*each, sides) for each in VARIANTS for sides in (1, 5)), ("scalar", "float32", 1e-4, 19)],
)
def test_solution_equals_dense(
    symbolic: Symbolic,
    name: str,
    precision: str,
    tolerance: float,
    sides: int,
    rng: np.random.Generator,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Every world has its own matrix; forward substitution of all sides and the full solve of the first."""
    if name == "runs":
        monkeypatch.setattr(strips, "ALONE_FROM", 0)
    chosen, worlds, n = variant("scalar" if name == "runs" else name, precision), 3, symbolic.size
    solver = LinearSolver(symbolic, upload(symbolic, "cpu"), chosen, worlds, sides, "cpu", "levels")
    assert (solver.levels is not None) == (name == "cuda")
    a = allocate(chosen, worlds, 9 * len(symbolic.a_row), "cpu")
    blocks = [random_blocks(symbolic, rng) for _ in range(worlds)]
    right = rng.standard_normal((worlds, sides, 3 * n))

    def fill(target: wp.array, values: list[np.ndarray]) -> None:
        data = target.numpy()
        packs, _, lanes = data.shape
        for world in range(packs * lanes):  # lanes past the last world repeat it
            value = values[min(world, worlds - 1)].ravel()
            data[world // lanes, : value.size, world % lanes] = value
        target.assign(data)

    def world_of(array: wp.array, world: int) -> np.ndarray:
        data = array.numpy()
        return data[world // data.shape[2], :, world % data.shape[2]].astype(np.float64)

    fill(a.real, blocks)
    fill(solver.y.real, list(right))
    solver.lower.real.fill_(np.nan)  # what has not been written yet is nothing to any result
    if solver.levels is not None:
        fill(solver.lower.real, [np.zeros((symbolic.block_count + 1, 3, 3))] * worlds)  # which has a block of zeros
    solver.factor(a)
    solver.forward(sides)
    halves = [world_of(solver.y.real, world)[: sides * 3 * n].reshape(sides, -1) for world in range(worlds)]
    solver.backward()
    for world in range(worlds):
        matrix = dense(symbolic, blocks[world])
        lower = np.linalg.cholesky(matrix)
        np.testing.assert_allclose(halves[world], np.linalg.solve(lower, right[world].T).T, atol=tolerance)
        solution = world_of(solver.y.real, world)[: 3 * n]
        np.testing.assert_allclose(matrix @ solution, right[world, 0], atol=100 * tolerance)
