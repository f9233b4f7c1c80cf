"""Unsymmetric factorisation and the multiplier solver against dense linear algebra."""

import itertools

import numpy as np
import pytest
import warp as wp

from softwarp.kernels.algebra.lanes import variant
from softwarp.kernels.rows import active_set
from softwarp.model.structure import Symbolic
from softwarp.plan.ordering import analyze
from softwarp.solvers.linear.cholesky import LinearSolver, upload
from softwarp.solvers.linear.lu import LUSolver
from softwarp.solvers.workspace.rows import allocate, shape

VARIANTS = [("scalar", "float64", 1e-11), ("scalar", "float32", 1e-4), ("lanes", "float32", 1e-4)]
each_variant = pytest.mark.parametrize(("name", "precision", "tolerance"), VARIANTS)


def random_matrix(rng: np.random.Generator, symbolic: Symbolic, definite: bool) -> tuple[np.ndarray, np.ndarray]:
    """Stored blocks, and transposed blocks above the diagonal, of an unsymmetric matrix with strong diagonal blocks."""
    below, above = rng.standard_normal((2, len(symbolic.a_row), 3, 3))
    n = symbolic.size
    sign = np.ones(n) if definite else rng.choice([-1.0, 1.0], n)
    below[:n] += 30.0 * sign[:, None, None] * np.eye(3)
    above[:n] = below[:n]
    return below, above


def dense(symbolic: Symbolic, below: np.ndarray, above: np.ndarray) -> np.ndarray:
    n = symbolic.size
    matrix = np.zeros((n, 3, n, 3))
    matrix[symbolic.a_col, :, symbolic.a_row] = above.transpose(0, 2, 1)
    matrix[symbolic.a_row, :, symbolic.a_col] = below
    return matrix.reshape(3 * n, 3 * n)


@each_variant
@pytest.mark.parametrize("definite", [True, False])
def test_solution_and_pivots(
    name: str, precision: str, tolerance: float, definite: bool, rng: np.random.Generator
) -> None:
    """A x = b for several worlds and sides; the count of negative pivots is the sum over the diagonal blocks' signs."""
    symbolic = analyze(rng.integers(0, 40, (90, 2)).astype(np.int32), 40)
    chosen, worlds, sides, n = variant(name, precision), 3, 4, symbolic.size
    solver = LUSolver(LinearSolver(symbolic, upload(symbolic, "cpu"), chosen, worlds, sides, "cpu"))
    packs, lanes = shape(chosen, worlds)
    matrices = [random_matrix(rng, symbolic, definite) for _ in range(packs * lanes)]
    right = rng.standard_normal((packs * lanes, sides, 3 * n))

    def rows(values: list[np.ndarray]) -> wp.array:
        array = allocate(chosen, worlds, values[0].size, "cpu")
        stacked = np.array([value.ravel() for value in values]).reshape(packs, lanes, -1).transpose(0, 2, 1)
        array.real.assign(np.ascontiguousarray(stacked, dtype=wp.dtype_to_numpy(chosen.real)))
        return array

    y = np.zeros((packs * lanes, solver.y.real.shape[1]))
    y[:, : sides * 3 * n] = right.reshape(packs * lanes, -1)
    solver.y.copy_from(rows(list(y)))
    solver.factor(rows([m[0] for m in matrices]), rows([m[1] for m in matrices]))
    solver.solve(sides)
    found = solver.y.real.numpy().transpose(0, 2, 1).reshape(packs * lanes, -1)[:, : sides * 3 * n]
    pivots = solver.pivot.real.numpy().transpose(0, 2, 1).reshape(packs * lanes, -1).sum(axis=1)
    for world in range(worlds):
        matrix = dense(symbolic, *matrices[world])
        expected = np.linalg.solve(matrix, right[world].T).T
        np.testing.assert_allclose(found[world].reshape(sides, -1), expected, atol=tolerance)
        assert pivots[world] == (np.linalg.eigvals(matrix).real < 0.0).sum()


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_columns_and_lists_of_pairs_give_the_same_bits(precision: str, rng: np.random.Generator) -> None:
    """Both ways of a CPU add the same products in the same order."""
    symbolic = analyze(rng.integers(0, 60, (150, 2)).astype(np.int32), 60)
    chosen, n = variant("scalar", precision), symbolic.size
    solver = LUSolver(LinearSolver(symbolic, upload(symbolic, "cpu"), chosen, 1, 1, "cpu"))
    stored = [allocate(chosen, 1, 9 * len(symbolic.a_row), "cpu") for _ in range(2)]
    for array, blocks in zip(stored, random_matrix(rng, symbolic, True), strict=True):
        array.real.assign(blocks.reshape(1, -1, 1).astype(wp.dtype_to_numpy(chosen.real)))
    found = []
    solver.linear.send_pairs()
    for column in (solver.column, None):
        solver.column = column
        solver.factor(*stored)
        found.append((solver.lower.real.numpy().copy(), solver.upper.real.numpy()[:, 9 * n :].copy()))
    for columns, pairs in zip(*found, strict=True):
        np.testing.assert_array_equal(columns, pairs)


def brute_force(W: np.ndarray, gap: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The only multipliers of a P-matrix that fulfil the law of every row, by trying all combinations."""
    count = len(gap)
    for states in itertools.product((0, 1, 2), repeat=count):
        state = np.array(states)
        value = np.where(state == 0, low, np.where(state == 2, high, 0.0))
        free = state == 1
        if free.any():
            value[free] = np.linalg.solve(W[np.ix_(free, free)], -(gap + W @ value)[free])
        rest = gap + W @ value
        inside = (value >= low - 1e-12) & (value <= high + 1e-12)
        lawful = np.where(state == 0, rest >= -1e-12, np.where(state == 2, rest <= 1e-12, True))
        if (inside & lawful).all():
            return value
    raise AssertionError("no solution")


@pytest.mark.parametrize("count", [1, 2, 5])
def test_multipliers_fulfil_their_laws(count: int, rng: np.random.Generator) -> None:
    """Random unsymmetric P-matrices, rows at both bounds and between."""
    chosen, worlds = variant("scalar", "float64"), 40
    factor = rng.standard_normal((worlds, count, count))
    skew = rng.standard_normal((worlds, count, count))
    W = factor @ factor.transpose(0, 2, 1) + 0.2 * np.eye(count) + 0.5 * (skew - skew.transpose(0, 2, 1))
    gap = rng.standard_normal((worlds, count))
    low, high = -rng.uniform(0.0, 0.5, (worlds, count)), rng.uniform(0.0, 1.0, (worlds, count))

    def rows(values: np.ndarray) -> wp.array:
        array = allocate(chosen, worlds, values[0].size, "cpu")
        array.real.assign(values.reshape(worlds, -1, 1))
        return array.real

    zero = np.zeros((worlds, count))
    value, contact = rows(zero), rows(zero[:, :1])
    inputs = [count, 1e-13, 1.0, rows(W), rows(gap), rows(low), rows(high), rows(zero)]
    outputs = [rows(zero), rows(np.zeros((worlds, count * count))), value, contact]
    wp.launch(active_set.kernels(chosen).active_set, dim=(worlds, 1), inputs=inputs, outputs=outputs, device="cpu")
    for world in range(worlds):
        expected = brute_force(W[world], gap[world], low[world], high[world])
        np.testing.assert_allclose(value.numpy()[world, :, 0], expected, atol=1e-10)
    assert (contact.numpy() == 0.0).all()
