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
