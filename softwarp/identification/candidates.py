"""Residuals of candidates in batches of one size, what diverges, and derivatives by differences."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from softwarp import checks, notices
from softwarp.identification.parameters import FloatArray, Space

Residuals = Callable[[FloatArray], ArrayLike]
Jacobian = Callable[[FloatArray], ArrayLike]


class Candidates:
    """Evaluates candidates, each a place in the unit cube.

    Args:
        space: The parameters.
        residuals: Values (candidate, parameter) to residuals (candidate, measurement); rows that are not finite stand
            for candidates that diverged.
        batch: Candidates of every call, the last of which are repeated where fewer are asked for; None calls with as
            many as there are.
        jacobian: Values (parameter,) to derivatives (measurement, parameter) per unit of the values; None takes
            differences.
    """

    def __init__(self, space: Space, residuals: Residuals, batch: int | None, jacobian: Jacobian | None) -> None:
        self.space, self.residuals, self.jacobian = space, residuals, jacobian
        self.batch = None if batch is None else checks.count(batch, "fit: batch")
        self.count = 0  # evaluated
        self.failed = 0  # of them diverged
        self.measurements = 0
        self.least = np.inf  # RMS of the best
        self.begun = time.monotonic()

    def __call__(self, u: FloatArray) -> FloatArray:
        """Residuals (candidate, measurement) of places (candidate, parameter); rows of nan for what diverged."""
        size = self.batch or max(len(u), 1)
        rows = [self._call(u[first : first + size], size) for first in range(0, len(u), size)]
        found = np.concatenate(rows)
        is_bad = ~np.isfinite(found).all(axis=1)
        found[is_bad] = np.nan
        self.failed += int(is_bad.sum())
        return found

    def _call(self, u: FloatArray, size: int) -> FloatArray:
        missing = size - len(u)
        filled = np.concatenate([u, np.repeat(u[-1:], missing, axis=0)]) if missing else u
        told = self.residuals(self.space.values(filled))
        array = checks.as_array(told)
        if array.dtype.kind not in "fiu" or array.ndim != 2 or len(array) != size or not array.shape[1]:
            need = f"return one row of residuals per candidate, shape ({size}, measurements)"
            raise ValueError(checks.refusal("fit: residuals", need, told))
        if self.measurements not in (0, array.shape[1]):
            raise ValueError(
                f"fit: residuals returned {array.shape[1]} measurements, and {self.measurements} before; their number "
                "must not change: fill what is missing with nan to drop the candidate, or with 0"
            )
        self.measurements = array.shape[1]
        self.count += len(u)
        result = np.array(array[: len(u)], dtype=np.float64)
        self._tell(result)
        return result

    def _tell(self, found: FloatArray) -> None:
        rms = np.sqrt(np.mean(found**2, axis=1))
        if np.isfinite(rms).any():
            self.least = min(self.least, float(np.nanmin(rms)))
        notices.progress("identification", f"{self.count} candidates, least RMS residual {self.least:.4g}")

    def neighbours(self, u: FloatArray) -> FloatArray:
        """The places on both sides of u that central differences need, within the cube, shape (2 parameter, ...)."""
        step = np.diag(self.space.steps())
        return np.asarray(np.clip(np.concatenate([u + step, u - step]), 0.0, 1.0))

    def derivative(
        self, u: FloatArray, centre: FloatArray, sides: FloatArray | None = None, around: FloatArray | None = None
    ) -> FloatArray:
        """dr/du, shape (measurement, parameter).

        Central differences of second order; where one side diverged, or lies beyond a bound, of first order.

        Args:
            u: Where, shape (parameter,).
            centre: Residuals there, shape (measurement,).
            sides: ``neighbours(u)``, if their residuals are known.
            around: These residuals, shape (2 parameter, measurement).

        Raises:
            FloatingPointError: If both sides of a parameter diverged; the message names it.
            ValueError: If the user's derivatives have another shape or are not finite.
        """
        if self.jacobian is not None:
            values = self.space.values(u)
            shape = (len(centre), len(self.space))
            told = checks.array(self.jacobian(values), "fit: what jacobian returns", shape)
            return np.asarray(told * self.space.slopes(values))
        if sides is None or around is None:
            sides = self.neighbours(u)
            around = self(sides)
        result = np.empty((len(centre), len(u)))
        for i, name in enumerate(self.space.names):
            ends = []
            for row in (i, i + len(u)):
                is_good = np.isfinite(around[row]).all() and sides[row, i] != u[i]
                ends.append((sides[row, i], around[row]) if is_good else (u[i], centre))
            (high, above), (low, below) = ends
            if high == low:
                value = float(self.space.values(u)[i])
                raise FloatingPointError(
                    f"fit: residuals diverge on both sides of {name} = {value:.6g}, so it has no derivative there; "
                    "narrow its bounds, make its step smaller, or let the simulation take smaller steps"
                )
            result[:, i] = (above - below) / (high - low)
        return result
