"""Fits of models whose answer is known: a line with its covariance, an exponential, candidates that diverge."""

import numpy as np
import pytest

from softwarp.identification import Parameter, fit, leave_out

X = np.linspace(0.0, 1.0, 21)
LINE = [Parameter("slope", -10.0, 10.0), Parameter("offset", -10.0, 10.0)]


def line(noise):
    """Residuals of y = 2 x + 1 plus noise, measured at X."""
    measured = 2.0 * X + 1.0 + noise
    return lambda values: values[:, :1] * X + values[:, 1:2] - measured


@pytest.fixture
def noise(rng):
    return 0.1 * rng.standard_normal(len(X))


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def decay(values):
    """Residuals of exp(-rate x) against rate 3; rates above 30 diverge."""
    found = np.exp(-values[:, :1] * X) - np.exp(-3.0 * X)
    found[values[:, 0] > 30.0, 4] = np.nan
    return found


def test_covariance_of_a_line(noise):
    """Values and covariance of linear least squares: (A'A)^-1 A'y and s^2 (A'A)^-1, s^2 = r'r / (m - p)."""
    found = fit(LINE, line(noise))
    A = np.stack([X, np.ones_like(X)], axis=1)
    y = 2.0 * X + 1.0 + noise
    values, rest, *_ = np.linalg.lstsq(A, y)
    covariance = rest[0] / (len(X) - 2) * np.linalg.inv(A.T @ A)
    np.testing.assert_allclose(list(found.values.values()), values, rtol=1e-6)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-5)
    np.testing.assert_allclose(found.correlation[0, 1], covariance[0, 1] / np.sqrt(covariance.diagonal().prod()))
    half = 2.0930 * np.sqrt(covariance[0, 0])  # Student's t of 19 degrees of freedom, two-sided 95 %
    np.testing.assert_allclose(found.interval["slope"], (values[0] - half, values[0] + half), rtol=1e-4)
    np.testing.assert_allclose(found.rmse, np.sqrt(rest[0] / len(X)), rtol=1e-6)
    np.testing.assert_allclose(found.jacobian, A, atol=1e-9)
    assert found.converged
    assert np.isnan(found.held_out_rmse)


def test_intervals_cover(rng):
    """Of 200 sets of noise about 95 % of the intervals hold the true slope: between 90 and 99 of 100."""
    inside = 0
    for _ in range(200):
        low, high = fit(LINE, line(0.1 * rng.standard_normal(len(X)))).interval["slope"]
        inside += low <= 2.0 <= high
    assert 180 <= inside <= 198


def test_known_noise(noise):
    """With the standard deviation given the covariance is (A'A)^-1 sigma^2, whatever the residuals are."""
    found = fit(LINE, line(noise), noise=0.3)
    A = np.stack([X, np.ones_like(X)], axis=1)
    np.testing.assert_allclose(found.covariance, 0.09 * np.linalg.inv(A.T @ A), rtol=1e-5)


@pytest.mark.parametrize("batch", [None, 1, 4, 64])
@pytest.mark.parametrize("method", ["least_squares", "evolution"])
def test_decay(batch, method):
    """The exponential's rate on a logarithmic scale, in batches of any size, which are always full."""
    sizes = set()

    def residuals(values):
        sizes.add(len(values))
        return decay(values)

    rate = Parameter("rate", 0.1, 100.0, scale="log", start=1.0)
    found = fit([rate], residuals, batch=batch, method=method, generations=12, samples=0)
    assert found.values["rate"] == pytest.approx(3.0, rel=1e-5)
    assert batch is None or sizes == {batch}


def test_diverged_candidates_are_left_out():
    """Most samples, and the first step from the start, diverge; the fit is the same and tells how many did."""
    rate = Parameter("rate", 0.1, 1e6, scale="log", start=29.0)
    found = fit([rate], decay, samples=64)
    assert found.values["rate"] == pytest.approx(3.0, rel=1e-5)
    assert 20 < found.failed < 64


def test_one_side_diverges():
    """At the edge of what converges a derivative is taken from the other side."""
    rate = Parameter("rate", 1.0, 100.0, scale="log", start=29.9)
    assert fit([rate], decay, max_iterations=1).jacobian.shape == (len(X), 1)


def test_start_that_diverges_is_refused():
    rate = Parameter("rate", 0.1, 100.0, scale="log", start=50.0)
    with pytest.raises(ValueError, match=r"start are not finite \(rate = 50\).*samples=64"):
        fit([rate], decay)
    assert fit([rate], decay, samples=16).values["rate"] == pytest.approx(3.0, rel=1e-5)


def test_both_sides_diverge():
    def needle(values):
        return np.where(np.abs(values[:, :1] - 0.5) < 1e-9, 1.0, np.nan) * np.ones((1, 3))

    with pytest.raises(FloatingPointError, match=r"both sides of width = 0\.5"):
        fit([Parameter("width", 0.0, 1.0)], needle)


def test_bounds(noise):
    """A true value outside the bounds ends at the bound, which is told."""
    found = fit([Parameter("slope", -1.0, 1.5), LINE[1]], line(noise))
    assert found.values["slope"] == pytest.approx(1.5, abs=1e-3)
    assert found.at_bound == ("slope",)
    assert "at its bound" in found.table()


@pytest.mark.parametrize("as_mask", [True, False])
def test_held_out(noise, as_mask):
    """What is held out has no effect on the values, and its error is told."""
    wrong = noise.copy()
    wrong[:5] += 100.0
    held = np.arange(len(X)) < 5 if as_mask else np.arange(5)
    found, clean = fit(LINE, line(wrong), held_out=held), fit(LINE, line(noise), held_out=held)
    assert found.values == pytest.approx(clean.values)
    assert found.held_out_rmse == pytest.approx(100.0, rel=0.01)
    assert clean.held_out_rmse < 0.3


def test_held_out_function(noise):
    found = fit(LINE, line(noise), held_out=lambda values: values[:, :1] * 2.0 + values[:, 1:] - 15.0)
    assert found.held_out_rmse == pytest.approx(10.0, abs=0.5)


def test_jacobian_of_the_user(noise):
    """Derivatives per unit of the values, also on a logarithmic scale, replace all differences."""
    called = []

    def jacobian(values):
        called.append(values)
        return -X[:, None] * np.exp(-values * X)[:, None]

    rate = Parameter("rate", 0.1, 100.0, scale="log", start=1.0)
    found, by_differences = fit([rate], decay, jacobian=jacobian), fit([rate], decay)
    assert found.values["rate"] == pytest.approx(3.0, rel=1e-6)
    assert found.evaluations < by_differences.evaluations / 2
    assert called


def test_what_is_not_told_has_no_interval(noise):
    """A parameter without effect has an infinite interval; the others keep theirs."""
    idle = Parameter("idle", 0.0, 1.0)
    found, alone = fit([*LINE, idle], line(noise)), fit(LINE, line(noise))
    assert found.interval["idle"] == (-np.inf, np.inf)
    assert np.isnan(found.correlation[2]).all()
    np.testing.assert_allclose(found.interval["slope"], alone.interval["slope"], rtol=0.02)
    assert found.as_dict()["interval"]["idle"] == [None, None]


def test_leave_out(noise):
    """Every group's error by the others, and what they found."""
    left = leave_out(LINE, line(noise), [np.arange(i, 21, 3) for i in range(3)])
    assert left.rmse.shape == (3,)
    assert left.values.shape == (3, 2)
    assert 0.05 < left.total < 0.2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"low": 2.0, "high": 1.0}, "'E': high must be above 2"),
        ({"low": 0.0, "scale": "log"}, "'E': low must be positive on a logarithmic scale"),
        ({"start": 5.0}, r"'E': start must lie in \[0, 1\]"),
        ({"scale": "cubic"}, "'E': scale"),
        ({"step": 0.0}, "'E': step"),
    ],
)
def test_bad_parameters(arguments, message):
    with pytest.raises(ValueError, match=message):
        Parameter("E", **{"low": 0.0, "high": 1.0} | arguments)


@pytest.mark.parametrize(
    ("parameters", "residuals", "options", "message"),
    [
        ([], None, {}, "at least one"),
        ([LINE[0], LINE[0]], None, {}, "'slope' is given twice"),
        (LINE, None, {"start": {"slop": 1.0}}, "'slop', which is no parameter; did you mean 'slope'"),
        (LINE, lambda values: values[:, 0], {}, r"shape \(1, measurements\)"),
        (LINE, lambda values: values, {}, "2 parameters need more than 2 measurements, got 2"),
        (LINE, None, {"method": "newton"}, "method"),
        (LINE, None, {"held_out": [21]}, "held_out"),
        (LINE, None, {"held_out": np.zeros(3, dtype=bool)}, r"shape \(21,\)"),
        (LINE, None, {"noise": -1.0}, "noise"),
        (LINE, None, {"batch": 0}, "batch"),
        (LINE, None, {"start": [1.0, 2.0]}, r"start must be values by name, .* got \[1.0, 2.0\]"),
        (LINE, None, {"jacobian": 3}, "jacobian must be a function of values"),
    ],
)
def test_bad_arguments(parameters, residuals, options, message):
    with pytest.raises((ValueError, TypeError), match=message):
        fit(parameters, residuals or line(0.0 * X), **options)


def test_residuals_that_change_their_number():
    sizes = iter([3, 4])
    with pytest.raises(ValueError, match="returned 4 measurements, and 3 before"):
        fit([LINE[0]], lambda values: np.ones((len(values), next(sizes))) * values)
