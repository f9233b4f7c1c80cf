"""What a fit found, and how sure that is.

With residuals r of m measurements, their derivatives J by p places in the unit cube and s^2 = r'r / (m - p) the
covariance of the places is s^2 (J'J)^-1; intervals are t s_i with Student's t of m - p degrees of freedom, taken in the
scale of the parameter. Where the standard deviation of the measurements is given, r and J are divided by it, s = 1 and
t is that of the normal distribution. Reference: G. A. F. Seber, C. J. Wild, Nonlinear Regression (1989), chapter 5.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from softwarp.identification.parameters import FloatArray, Space

RANK = 1.0e-8  # singular values below this part of the largest tell nothing
CONFIDENCE = 0.95
NEAR_BOUND = 1.0e-6  # part of the bounds


@dataclass(frozen=True, eq=False)
class Fit:
    """Parameters that were found.

    Attributes:
        values: By name, in the units of the parameters.
        interval: 95 % confidence intervals by name; infinite where the measurements do not tell the parameter. They
            hold for independent errors of the measurements and a right model: a model that is wrong in shape is not
            put right by them.
        covariance: Of the values, shape (parameter, parameter).
        correlation: Of the values, shape (parameter, parameter); nan where a variance is infinite or zero.
        rmse: Root of the mean square residual of what was fitted, in the unit of the residuals.
        held_out_rmse: The same of what was held out; nan where nothing was.
        residuals: Of all measurements, those held out included, shape (measurement,).
        jacobian: Derivatives of the fitted ones by the values, shape (fitted measurement, parameter).
        at_bound: Names of parameters that stopped at a bound; their intervals mean little.
        evaluations: Candidates that were evaluated.
        failed: Of these diverged.
        seconds: Time it took [s].
        converged: Whether the tolerance was met.
        message: Why the search stopped.
        units: Of the parameters, by name.
    """

    values: dict[str, float]
    interval: dict[str, tuple[float, float]]
    covariance: FloatArray
    correlation: FloatArray
    rmse: float
    held_out_rmse: float
    residuals: FloatArray
    jacobian: FloatArray
    at_bound: tuple[str, ...]
    evaluations: int
    failed: int
    seconds: float
    converged: bool
    message: str
    units: dict[str, str]

    def table(self) -> str:
        """Values with intervals and what came of the fit, as Markdown."""
        lines = ["| parameter | value | 95 % interval | unit |", "|---|---|---|---|"]
        for name, value in self.values.items():
            low, high = self.interval[name]
            mark = " (at its bound)" if name in self.at_bound else ""
            lines.append(f"| {name} | {value:.5g}{mark} | {low:.5g} to {high:.5g} | {self.units[name]} |")
        held = "" if np.isnan(self.held_out_rmse) else f", held out {self.held_out_rmse:.4g}"
        lines.append(
            f"\nRMS residual {self.rmse:.4g}{held}; {self.evaluations} candidates, {self.failed} of them diverged, "
            f"{self.seconds:.1f} s; {self.message}"
        )
        return "\n".join(lines)

    def as_dict(self) -> dict[str, Any]:
        """All but the residuals and their derivatives, for JSON; None for what is not finite."""
        return {
            "values": self.values,
            "interval": {name: [_finite(end) for end in ends] for name, ends in self.interval.items()},
            "unit": self.units,
            "correlation": [[_finite(value) for value in row] for row in self.correlation.tolist()],
            "rmse": self.rmse,
            "held_out_rmse": _finite(self.held_out_rmse),
            "at_bound": list(self.at_bound),
            "evaluations": self.evaluations,
            "failed": self.failed,
            "seconds": round(self.seconds, 2),
            "converged": self.converged,
            "message": self.message,
        }


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Errors of what was left out of a fit, group by group.

    Attributes:
        rmse: Of every group, by the fit to all others, shape (group,).
        values: What these fits found, shape (group, parameter).
    """

    rmse: FloatArray
    values: FloatArray

    @property
    def total(self) -> float:
        """Root of the mean square of the groups' errors."""
        return float(np.sqrt(np.mean(self.rmse**2)))


def covariance_of_places(J: FloatArray, r: FloatArray, is_weighted: bool) -> FloatArray:
    """s^2 (J'J)^-1, infinite on the diagonal of parameters that a direction without any effect contains.

    Args:
        J: Derivatives, shape (measurement, parameter).
        r: Residuals, shape (measurement,).
        is_weighted: Whether both are in standard deviations, so that s = 1.
    """
    m, p = J.shape
    variance = 1.0 if is_weighted else float(r @ r) / (m - p)
    _, size, directions = np.linalg.svd(J, full_matrices=False)
    is_seen = size > RANK * max(float(size[0]), np.finfo(np.float64).tiny)
    scaled = directions[is_seen] / size[is_seen, None]
    covariance = variance * (scaled.T @ scaled)
    is_lost = (np.abs(directions[~is_seen]) > np.sqrt(RANK)).any(axis=0)
    covariance[is_lost, is_lost] = np.inf
    return np.asarray(covariance)


def intervals(space: Space, u: FloatArray, covariance: FloatArray, freedom: float) -> dict[str, tuple[float, float]]:
    """Intervals of the values by name, from the covariance of places with so many degrees of freedom."""
    quantile = float(stats.t.ppf(0.5 + 0.5 * CONFIDENCE, freedom))  # of the normal distribution for infinitely many
    half = quantile * np.sqrt(np.diag(covariance))
    found = {}
    for parameter, place, h in zip(space.parameters, u, half, strict=True):
        if np.isinf(h):
            found[parameter.name] = (0.0 if parameter.scale == "log" else -np.inf, np.inf)
        else:
            with np.errstate(over="ignore"):
                found[parameter.name] = (float(parameter.value(place - h)), float(parameter.value(place + h)))
    return found


def correlation_of(covariance: FloatArray) -> FloatArray:
    """Correlation coefficients; nan where a variance is infinite or zero."""
    deviation = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        found = covariance / np.outer(deviation, deviation)
    is_lost = ~np.isfinite(deviation) | (deviation == 0.0)
    found[is_lost], found[:, is_lost] = np.nan, np.nan
    return np.asarray(found)


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
