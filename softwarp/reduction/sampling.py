"""Elements that stand for all of a body: energy-conserving sampling and weighting. Theory: docs/theory/reduction.md.

Reference:
    Farhat, Avery, Chapman & Cortial (2014), Dimensional reduction of nonlinear finite element dynamic models with
    finite rotations and energy-based mesh sampling and weighting for computational efficiency. The weights solve a
    non-negative least-squares problem with the active set of Lawson & Hanson (1974), ended early.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softwarp import checks

FloatArray = NDArray[np.float64]
Told = Callable[[int, float], None]


@dataclass(frozen=True)
class Sampling:
    """Weights of elements.

    Attributes:
        weight: 0 where an element is left out, (element,).
        residual: |G weight - G 1| reached, relative.
    """

    weight: FloatArray
    residual: float

    @property
    def count(self) -> int:
        """Elements that count."""
        return int((self.weight > 0.0).sum())


def sample_elements(
    contributions: NDArray[np.floating],
    tolerance: float,
    *,
    size: float | None = None,
    most: int | None = None,
    told: Told | None = None,
) -> Sampling:
    """Few elements with weights from 0 on whose forces sum up to those of all.

    Finds a sparse w >= 0 with |G w - G 1| <= tolerance size: the element whose column is most along the residual joins,
    least squares on those that have joined, and elements that this makes negative leave again.

    Args:
        contributions: G, what each element adds to the forces on modes in every training state, (row, element).
        tolerance: Relative residual to end at, above 0 and below 1; usual are 0.01 to 0.1.
        size: What the tolerance refers to; None takes |G 1|.
        most: Elements to end at; None allows all.
        told: Called with the elements that count and the residual, now and then.

    Raises:
        ValueError: If no element has a force, or the tolerance is so large that none would be kept.
    """
    checks.number(tolerance, "tolerance of elements", above=0.0, below=1.0)
    G = np.asarray(contributions)
    if G.ndim != 2 or G.size == 0 or not np.isfinite(G).all():
        raise ValueError(checks.refusal("contributions", "be finite, of shape (row, element)", G.shape))
    goal = G.sum(axis=1, dtype=np.float64)
    size = float(np.linalg.norm(goal)) if size is None else size
    if size == 0.0 or not goal.any():
        raise ValueError("no element has a force in the training states; excite the body with its actuators")
    single = G.astype(np.float32)
    elements, most = G.shape[1], G.shape[1] if most is None else most
    active: list[int] = []
    columns = np.empty((G.shape[0], 0))
    gram = np.empty((0, 0))
    weight = np.empty(0)
    residual = goal.copy()
    is_in, barred = np.zeros(elements, dtype=bool), np.zeros(elements, dtype=bool)
    while np.linalg.norm(residual) > tolerance * size and len(active) < most:
        slope = single.T @ residual.astype(np.float32)
        slope[is_in | barred] = -np.inf
        best = int(np.argmax(slope))
        if not slope[best] > 0.0:
            break
        column = G[:, best].astype(np.float64)
        along = columns.T @ column
        gram = np.block([[gram, along[:, None]], [along[None, :], np.array([[column @ column]])]])
        columns = np.column_stack([columns, column])
        active.append(best)
        is_in[best] = True
        weight, kept = _least_squares(gram, columns, goal, np.append(weight, 0.0))
        if not kept[-1]:
            barred[best] = True  # rounding: it left as it came
        elif barred.any():
            barred[:] = False
        if not kept.all():
            is_in[np.array(active)[~kept]] = False
            active = [a for a, keep in zip(active, kept, strict=True) if keep]
            columns, gram, weight = columns[:, kept], gram[np.ix_(kept, kept)], weight[kept]
        residual = goal - columns @ weight
        if told is not None:
            told(len(active), float(np.linalg.norm(residual)) / size)
    result = np.zeros(elements)
    result[active] = weight
    return Sampling(result, float(np.linalg.norm(residual)) / size)


def _least_squares(
    gram: FloatArray, columns: FloatArray, goal: FloatArray, start: FloatArray
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Weights of least squares, none negative, and which columns keep one; the inner loop of Lawson and Hanson."""
    kept = np.ones(len(start), dtype=bool)
    weight, target = start.copy(), columns.T @ goal
    for _ in range(len(start)):
        index = np.flatnonzero(kept)
        solved = _solve(gram[np.ix_(index, index)], target[index])
        if (solved > 0.0).all():
            weight[:] = 0.0
            weight[index] = solved
            break
        now = weight[index]
        falling = solved <= 0.0
        step = np.min(now[falling] / np.maximum(now[falling] - solved[falling], 1e-300))
        weight[index] = now + step * (solved - now)
        leaving = index[falling & (weight[index] <= 1e-12 * max(float(weight.max()), 1e-300))]
        kept[leaving if leaving.size else index[np.argmin(np.where(falling, weight[index], np.inf))]] = False
        weight[~kept] = 0.0
    return weight, kept


def _solve(gram: FloatArray, target: FloatArray) -> FloatArray:
    """Solution of a symmetric system, by least squares where columns repeat each other."""
    from scipy.linalg import LinAlgError, cho_factor, cho_solve

    try:
        return np.asarray(cho_solve(cho_factor(gram, check_finite=False), target, check_finite=False))
    except LinAlgError:
        return np.asarray(np.linalg.lstsq(gram, target, rcond=1e-12)[0])
