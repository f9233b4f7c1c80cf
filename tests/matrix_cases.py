"""Symmetric block matrices on a given structure, and their dense form."""

import numpy as np

from softwarp.model.structure import Symbolic


def random_blocks(symbolic: Symbolic, rng: np.random.Generator) -> np.ndarray:
    """Stored blocks of a symmetric, diagonally dominant matrix."""
    blocks = rng.standard_normal((len(symbolic.a_row), 3, 3))
    diagonal = slice(0, symbolic.size)
    degree = 6.0 * (np.bincount(symbolic.a_row, minlength=symbolic.size) + np.bincount(symbolic.a_col)) + 2.0
    blocks[diagonal] = blocks[diagonal] + blocks[diagonal].transpose(0, 2, 1)
    blocks[diagonal] += degree[:, None, None] * np.eye(3)
    return blocks


def dense(symbolic: Symbolic, blocks: np.ndarray) -> np.ndarray:
    n = symbolic.size
    matrix = np.zeros((n, 3, n, 3))
    matrix[symbolic.a_row, :, symbolic.a_col, :] = blocks
    lower = slice(n, None)
    matrix[symbolic.a_col[lower], :, symbolic.a_row[lower], :] = blocks[lower].transpose(0, 2, 1)
    return matrix.reshape(3 * n, 3 * n)


def without_pivot(symbolic: Symbolic, blocks: np.ndarray) -> np.ndarray:
    """Lower a diagonal entry in the middle until elimination leaves a negative pivot; where all other unknowns are."""
    kept = np.arange(3 * symbolic.size) != 3 * (symbolic.size // 2) + 1
    unknown = int(np.flatnonzero(~kept)[0])
    matrix = dense(symbolic, blocks)
    column = matrix[:unknown, unknown]
    pivot = matrix[unknown, unknown] - column @ np.linalg.solve(matrix[:unknown, :unknown], column)
    blocks[unknown // 3, unknown % 3, unknown % 3] -= pivot + 0.5
    return kept


def check_held(
    matrix: np.ndarray, kept: np.ndarray, halves: np.ndarray, solution: np.ndarray, right: np.ndarray, atol: float
) -> None:
    """A solution, and the half-solved sides, in which the unknown without a pivot is held and all others are exact."""
    lower = np.linalg.cholesky(matrix[np.ix_(kept, kept)])
    np.testing.assert_allclose(halves[:, kept], np.linalg.solve(lower, right[:, kept].T).T, atol=atol)
    np.testing.assert_allclose((matrix @ solution)[kept], right[0, kept], atol=100 * atol)
    assert not halves[:, ~kept].any()
    assert not solution[~kept].any()
