"""Least squares over batches of candidates: trust region, Sobol samples, differential evolution, gradients.

The trust region is SciPy's (``least_squares``, Branch, Coleman and Li 1999), which keeps bounds; the evolution is
SciPy's (Storn and Price 1997), whose generations are one batch; descent along gradients is SciPy's L-BFGS-B (Byrd, Lu,
Nocedal and Zhu 1995). All columns of a Jacobian by differences are one batch as well.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import differential_evolution, least_squares, minimize
from scipy.stats import qmc

from softwarp import checks, notices
from softwarp.identification.candidates import Candidates, Jacobian, Residuals
from softwarp.identification.gradients import Differentiable
from softwarp.identification.parameters import FloatArray, Parameter, Space
from softwarp.identification.result import (
    NEAR_BOUND,
    Fit,
    LeftOut,
    correlation_of,
    covariance_of_places,
    intervals,
)

METHODS = ("least_squares", "evolution", "gradient")
MANY = 64  # measurements of an experiment: a trust region's few Jacobians cost more than a descent's many gradients
POPULATION = 8  # candidates of a generation per parameter, where no batch says how many
MOST_SAMPLES = 2**20
REASONS = {0: "stopped at max_iterations", 1: "gradient", 2: "cost", 3: "step", 4: "cost and step"}


def fit(
    parameters: Sequence[Parameter],
    residuals: Residuals,
    *,
    method: Literal["least_squares", "evolution", "gradient"] | None = None,
    start: Mapping[str, float] | None = None,
    samples: int = 0,
    batch: int | None = None,
    jacobian: Jacobian | None = None,
    noise: ArrayLike | None = None,
    held_out: ArrayLike | Residuals | None = None,
    tolerance: float = 1.0e-6,
    max_iterations: int = 30,
    generations: int = 50,
    seed: int = 0,
) -> Fit:
    """Find the parameters whose residuals have the least sum of squares.

    Args:
        parameters: What is looked for, with bounds.
        residuals: Values (candidate, parameter), in the parameters' units, to model minus measurement, shape
            (candidate, measurement); a row with nan or infinity is a candidate that diverged. A ``Differentiable`` has
            exact derivatives as well.
        method: ``least_squares`` starts at one place; ``evolution`` searches all of the bounds first; ``gradient``
            descends from one place along gradients of the sum of squares, each of which costs one backward pass of
            ``Differentiable`` residuals whatever the number of measurements. None takes ``least_squares``, but
            ``gradient`` where ``Differentiable`` residuals have more than 64 measurements of an experiment.
        start: Values by name to start at, in place of the parameters' own.
        samples: Candidates of a Sobol sequence over the bounds that are tried first; the best becomes the start.
        batch: Candidates of every call of ``residuals``, filled by repeating the last: a simulation's room, as
            ``Worlds.candidates``. None calls with as many as are asked for.
        jacobian: Values (parameter,) to derivatives (measurement, parameter) of the residuals per unit of the values,
            for those who have gradients; None takes those of ``Differentiable`` residuals, or else central differences,
            all columns in one batch.
        noise: Standard deviation of the measurements, one or one each, shape (measurement,); None estimates one for
            all from the residuals. Needed where units are mixed.
        held_out: Measurements that are not fitted but whose error is told: their indices, a mask (measurement,), or
            another function like ``residuals``.
        tolerance: Relative change of cost or places at which the search ends.
        max_iterations: Of the trust region, or of the descent.
        generations: Of the evolution, at most.
        seed: Of samples and evolution.

    Raises:
        TypeError: If ``residuals`` or ``jacobian`` cannot be called, or ``start`` has no names.
        ValueError: For arguments that do not fit together, or if every candidate at the start diverged.
        FloatingPointError: If residuals diverge on both sides of a place that was found.
    """
    space = Space(parameters)
    if method is not None:
        checks.choice(method, "fit: method", METHODS)
    checks.number(tolerance, "fit: tolerance", above=0.0, below=1.0)
    checks.count(max_iterations, "fit: max_iterations")
    checks.count(generations, "fit: generations")
    checks.count(samples, "fit: samples", low=0, high=MOST_SAMPLES)
    seed = checks.seed(seed, "fit: seed")
    if not (callable(residuals) or isinstance(residuals, Differentiable)):
        raise TypeError(checks.refusal("fit: residuals", "be a function of values (candidate, parameter)", residuals))
    differentiable = residuals if isinstance(residuals, Differentiable) else None
    if not (jacobian is None or callable(jacobian)):
        raise TypeError(checks.refusal("fit: jacobian", "be a function of values (parameter,)", jacobian))
    if method == "gradient" and differentiable is None:
        raise ValueError(checks.refusal("fit: residuals", "be Differentiable for method='gradient'", residuals))
    if differentiable is not None and jacobian is None:
        jacobian = differentiable.jacobian
    begun = time.monotonic()
    candidates = Candidates(space, residuals, batch, jacobian)
    u = space.start(start)
    centre = candidates(u[None])[0]
    if method is None and differentiable is not None and candidates.measurements > MANY * differentiable.experiments:
        method = "gradient"  # a Jacobian has a backward pass for each measurement of an experiment
    problem = _Problem(candidates, _used(held_out, candidates.measurements), _deviation(noise, candidates.measurements))
    problem.require_freedom()
    if samples:
        u, centre = _best_sample(problem, u, centre, samples, seed)
    if method == "evolution":
        u, centre = _evolve(problem, u, generations, seed)
    if not np.isfinite(centre).all():
        raise ValueError(
            f"fit: the residuals at the start are not finite ({_told(space, u)}); start elsewhere, or give samples=64 "
            "to look for a start within the bounds"
        )
    if method == "gradient" and differentiable is not None:
        if candidates.measurements > 2 * len(space) * differentiable.experiments:
            candidates.jacobian = None  # differences cost less than a backward pass for every measurement
        end, centre = problem.slide(differentiable, u, centre, tolerance, max_iterations)
    else:
        end, centre = problem.descend(u, centre, tolerance, max_iterations)
    derivative = problem.derivative(end.x)
    other = held_out if callable(held_out) else None
    notices.progress_ends()
    return _result(problem, end, centre, derivative, other, begun)


def leave_out(
    parameters: Sequence[Parameter], residuals: Residuals, groups: Sequence[ArrayLike], **options: Any
) -> LeftOut:
    """Fit to all groups of measurements but one, in turn: how well the model tells what it has not seen.

    Args:
        parameters: As for ``fit``.
        residuals: Likewise.
        groups: Indices of the measurements of every group, at least two groups.
        options: Further arguments of ``fit``, but not ``held_out``.

    Raises:
        ValueError: For fewer than two groups, or ``held_out``.
    """
    if not isinstance(groups, (Sequence, np.ndarray)) or isinstance(groups, str) or len(groups) < 2:
        raise ValueError(checks.refusal("leave_out: groups", "hold the indices of at least two groups", groups))
    if "held_out" in options:
        raise ValueError("leave_out: held_out cannot be given; each group is held out in turn")
    fits = [fit(parameters, residuals, held_out=group, **options) for group in groups]
    return LeftOut(
        np.array([found.held_out_rmse for found in fits]), np.array([list(found.values.values()) for found in fits])
    )


class _Problem:
    """Weighted residuals of what is fitted.

    Args:
        candidates: Evaluate all measurements.
        used: Those that are fitted, bool (measurement,).
        deviation: Standard deviations, shape (measurement,); None for one that is not known.
    """

    def __init__(self, candidates: Candidates, used: NDArray[np.bool_], deviation: FloatArray | None) -> None:
        self.candidates, self.used, self.deviation = candidates, used, deviation
        self.weight = np.ones(int(used.sum())) if deviation is None else 1.0 / deviation[used]
        self._known: tuple[bytes, FloatArray, FloatArray] | None = None  # place, those around it, their residuals
        self._last: tuple[bytes, FloatArray] | None = None
        self._derived: tuple[bytes, FloatArray] | None = None  # place, derivatives there

    def require_freedom(self) -> None:
        """Refuse more parameters than measurements."""
        count, parameters = int(self.used.sum()), len(self.candidates.space)
        if count <= parameters:
            raise ValueError(
                f"fit: {parameters} parameters need more than {parameters} measurements, got {count}; measure more, "
                "hold out less, or fix a parameter"
            )

    def fitted(self, found: FloatArray) -> FloatArray:
        """What is minimised, (..., fitted), of residuals (..., measurement)."""
        return np.asarray(found[..., self.used] * self.weight)

    def costs(self, found: FloatArray) -> FloatArray:
        """Half the sums of squares, shape (candidate,); infinite for what diverged."""
        half = 0.5 * np.sum(self.fitted(found) ** 2, axis=-1)
        return np.where(np.isfinite(half), half, np.inf)

    def descend(self, u: FloatArray, centre: FloatArray, tolerance: float, most: int) -> tuple[Any, FloatArray]:
        """Where the trust region stopped and why, as SciPy tells it, and the residuals of all measurements there."""
        inside = np.clip(u, 1e-9, 1.0 - 1e-9)
        self._last = (inside.tobytes(), centre)
        found = least_squares(
            self._at,
            inside,
            jac=self._weighted,
            bounds=(0.0, 1.0),
            ftol=tolerance,
            xtol=tolerance,
            gtol=1e-12,
            x_scale=1.0,
            max_nfev=most,
        )
        self._at(found.x)
        assert self._last is not None
        return found, self._last[1]

    def slide(
        self, residuals: Differentiable, u: FloatArray, centre: FloatArray, tolerance: float, most: int
    ) -> tuple[SimpleNamespace, FloatArray]:
        """Where a descent along gradients stopped and why, told as ``descend`` does, and the residuals there."""
        worst = np.zeros(1)
        start = np.clip(u, 0.0, 1.0)
        self._last = (start.tobytes(), centre)

        def cost(place: FloatArray) -> tuple[float, FloatArray]:
            r = self._at(place)
            if not np.isfinite(r).all():
                return 10.0 * float(worst[0]), np.zeros(len(place))  # diverged: the line search comes back
            worst[0] = max(float(worst[0]), 0.5 * float(r @ r))
            return 0.5 * float(r @ r), self._gradient(residuals, place, r)

        if self.candidates.jacobian is None:
            return self._slide_in_metric(residuals, start, tolerance, most)
        options = {"maxiter": most, "ftol": tolerance, "gtol": 1e-12}
        found = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=[(0.0, 1.0)] * len(u), options=options)
        self._at(found.x)
        assert self._last is not None
        is_at_bound = (found.x <= 0.0) | (found.x >= 1.0)
        end = SimpleNamespace(x=found.x, status=2 if found.success else 0, active_mask=is_at_bound.astype(int))
        return end, self._last[1]

    def _gradient(self, residuals: Differentiable, place: FloatArray, r: FloatArray) -> FloatArray:
        """Gradient of half the sum of squares at the place that was evaluated last, where these are the residuals."""
        assert self._last is not None
        by = np.zeros(len(self._last[1]))
        by[self.used] = self.weight * r
        values = self.candidates.space.values(place)
        return np.asarray(residuals.pull(values, by) * self.candidates.space.slopes(values))

    def _slide_in_metric(
        self, residuals: Differentiable, u: FloatArray, tolerance: float, most: int
    ) -> tuple[SimpleNamespace, FloatArray]:
        """The same of few parameters and many measurements, in the metric J'J (Gauss) of differences at the start.

        The first step has the gradient J'r, all others the exact one; J follows the residuals by Broyden's updates
        (1965), and intervals are found from it. The search ends where a step along the exact gradient promises less
        than ``tolerance`` of the cost.
        """
        assert self._last is not None
        r, centre = self._at(u), self._last[1]
        J = self._slopes(u, centre)
        status = 0
        for number in range(most + 1):
            weighted = J[self.used] * self.weight[:, None]
            g = self._gradient(residuals, u, r) if number else weighted.T @ r
            free = ~(((u <= 0.0) & (g > 0.0)) | ((u >= 1.0) & (g < 0.0)))
            step = np.zeros(len(u))
            step[free] = -np.linalg.lstsq(weighted[:, free].T @ weighted[:, free], g[free], rcond=None)[0]
            half = 0.5 * float(r @ r)
            if number and -0.5 * float(g @ step) <= tolerance * half:
                status = 2
                break
            if number == most:
                break
            for share in 0.5 ** np.arange(12):
                place = np.clip(u + share * step, 0.0, 1.0)
                after = self._at(place)
                if np.isfinite(after).all() and float(after @ after) < 2.0 * half:
                    break
            else:
                status = 3 if number else 0
                break
            way, full = place - u, self._last[1]
            J = J + np.outer(full - centre - J @ way, way) / float(way @ way)
            u, r, centre = place, after, full
        self._last = (u.tobytes(), centre)
        self._derived = u.tobytes(), J
        is_at_bound = (u <= 0.0) | (u >= 1.0)
        return SimpleNamespace(x=u, status=status, active_mask=is_at_bound.astype(int)), centre

    def _slopes(self, u: FloatArray, centre: FloatArray) -> FloatArray:
        """Derivatives of all residuals by places, from one difference each, towards the middle of the bounds."""
        J = np.zeros((len(centre), len(u)))
        for i, step in enumerate(self.candidates.space.steps()):
            place = u.copy()
            place[i] += step if u[i] < 0.5 else -step
            J[:, i] = (self.candidates(place[None])[0] - centre) / (place[i] - u[i])
        if not np.isfinite(J).all():
            raise FloatingPointError(
                "fit: residuals diverge beside the start; narrow the bounds, or make steps smaller"
            )
        return J

    def _at(self, u: FloatArray) -> FloatArray:
        """Residuals at a place; with room in the batch the differences around it are evaluated with it."""
        key = u.tobytes()
        if self._last is None or self._last[0] != key:
            room = self.candidates.batch or 1
            if self.candidates.jacobian is None and room > 2 * len(u):
                sides = self.candidates.neighbours(u)
                rows = self.candidates(np.concatenate([u[None], sides]))
                self._known = (key, sides, rows[1:])
                self._last = (key, rows[0])
            else:
                self._last = (key, self.candidates(u[None])[0])
        return self.fitted(self._last[1])

    def derivative(self, u: FloatArray) -> FloatArray:
        """Derivatives of all residuals by places, shape (measurement, parameter), from what is known where it is."""
        key = u.tobytes()
        if self._derived is None or self._derived[0] != key:
            self._at(u)
            assert self._last is not None
            around = self._known[1:] if self._known is not None and self._known[0] == key else ()
            self._derived = key, self.candidates.derivative(u, self._last[1], *around)
        return self._derived[1]

    def _weighted(self, u: FloatArray) -> FloatArray:
        return np.asarray(self.derivative(u)[self.used] * self.weight[:, None])


def _best_sample(
    problem: _Problem, u: FloatArray, centre: FloatArray, samples: int, seed: int
) -> tuple[FloatArray, FloatArray]:
    """The best of a Sobol sequence and the start, with its residuals."""
    power = max(math.ceil(math.log2(samples)), 0)
    sequence = qmc.Sobol(len(u), seed=seed).random_base2(power)[:samples]
    found = problem.candidates(sequence)
    costs = problem.costs(found)
    best = int(np.argmin(costs))
    if costs[best] < problem.costs(centre[None])[0]:
        return sequence[best], found[best]
    return u, centre


def _evolve(problem: _Problem, u: FloatArray, generations: int, seed: int) -> tuple[FloatArray, FloatArray]:
    """The best place of a differential evolution that has the start in its first generation, with its residuals."""
    parameters = len(u)
    size = max(problem.candidates.batch or POPULATION * parameters, 5)
    first = qmc.Sobol(parameters, seed=seed).random_base2(math.ceil(math.log2(size)))[:size]
    first[0] = u

    def costs(places: FloatArray) -> FloatArray:
        """Of places (parameter, candidate), as SciPy hands them over."""
        return problem.costs(problem.candidates(np.ascontiguousarray(places.T)))

    with np.errstate(invalid="ignore"):
        found = differential_evolution(
            costs,
            [(0.0, 1.0)] * parameters,
            init=first,
            maxiter=generations,
            vectorized=True,
            updating="deferred",
            polish=False,
            seed=seed,
        )
    place = np.asarray(found.x, dtype=np.float64)
    return place, problem.candidates(place[None])[0]


def _result(
    problem: _Problem,
    end: Any,
    centre: FloatArray,
    derivative: FloatArray,
    other: Residuals | None,
    begun: float,
) -> Fit:
    candidates, space, used = problem.candidates, problem.candidates.space, problem.used
    u, code = np.asarray(end.x, dtype=np.float64), int(end.status)
    weighted = derivative[used] * problem.weight[:, None]
    is_weighted = problem.deviation is not None
    covariance = covariance_of_places(weighted, problem.fitted(centre), is_weighted)
    values, freedom = space.values(u), np.inf if is_weighted else float(used.sum() - len(u))
    slopes = space.slopes(values)
    held = centre[~used]
    if other is not None:
        held = Candidates(space, other, candidates.batch, None)(u[None])[0]
    is_near = (np.asarray(end.active_mask) != 0) | (np.minimum(u, 1.0 - u) < NEAR_BOUND)
    stuck = [name for name, near in zip(space.names, is_near, strict=True) if near]
    with np.errstate(invalid="ignore"):
        of_values = covariance * np.outer(slopes, slopes)
    return Fit(
        values=dict(zip(space.names, values.tolist(), strict=True)),
        interval=intervals(space, u, covariance, freedom),
        covariance=of_values,
        correlation=correlation_of(covariance),
        rmse=_rms(centre[used]),
        held_out_rmse=_rms(held),
        residuals=centre,
        jacobian=derivative[used] / slopes,
        at_bound=tuple(stuck),
        evaluations=candidates.count,
        failed=candidates.failed,
        seconds=time.monotonic() - begun,
        converged=code > 0,
        message=f"converged by {REASONS[code]}" if code > 0 else REASONS[0],
        units={p.name: p.unit for p in space.parameters},
    )


def _used(held_out: ArrayLike | Callable[..., Any] | None, count: int) -> NDArray[np.bool_]:
    """Which measurements are fitted, bool (measurement,)."""
    used = np.ones(count, dtype=bool)
    if held_out is None or callable(held_out):
        return used
    given = checks.as_array(held_out)
    if given.dtype == bool:
        if given.shape != (count,):
            raise ValueError(checks.refusal("fit: held_out, a mask,", f"have shape ({count},)", held_out))
        return np.asarray(~given)
    if given.size:
        used[checks.integers(held_out, "fit: held_out", (None,), high=count - 1)] = False
    return used


def _deviation(noise: ArrayLike | None, count: int) -> FloatArray | None:
    if noise is None:
        return None
    found = checks.array(noise, "fit: noise, the standard deviation of the measurements,", (), (count,), above=0.0)
    return np.broadcast_to(found, (count,)).astype(np.float64)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def _told(space: Space, u: FloatArray) -> str:
    return ", ".join(f"{name} = {value:.6g}" for name, value in zip(space.names, space.values(u), strict=True))
