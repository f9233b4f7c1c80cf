"""The batched quadratic program: enumerated solutions, another solver, optimality, conflicts, batches."""

from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import nnls

from softwarp.kernels.algebra.lanes import variant
from softwarp.kernels.inverse import program

FAR = 1.0e15
K = program.kernels(variant("scalar", "float64"))


def solve(effect, compliance, gap, low, high, *, soft=0.0, epsilon=1.0e-3):
    """Solve a batch: effect (w, e, n), compliance (w, n, n), gap (w, e), bounds of n efforts and n displacements."""
    worlds, e, n = effect.shape
    q = 2 * n

    def zeros(count, dtype=wp.float64):
        return wp.zeros((worlds, count), dtype=dtype, device="cpu")

    def given(values):
        return wp.array(np.ascontiguousarray(values.reshape(worlds, -1)), dtype=wp.float64, device="cpu")

    hessian, linear, normal = zeros(n * n), zeros(n), zeros(q * n)
    weight = wp.full(e, 1.0, dtype=wp.float64, device="cpu")
    parts = np.concatenate([gap, np.zeros_like(gap)], axis=1)
    inputs = [n, q, e, epsilon, 1.0e9, weight, given(effect), given(compliance), given(parts)]
    wp.launch(K.assemble, dim=worlds, inputs=inputs, outputs=[hessian, linear, normal], device="cpu")
    softness = np.broadcast_to(np.concatenate([np.zeros(n), np.full(n, soft)]), (worlds, q))
    outputs = [zeros(n * n), zeros(q * n), zeros(q), zeros(q * q), zeros(q), zeros(n + q), zeros(q, wp.int32), zeros(q)]
    multiplier, x, outcome = zeros(q), zeros(n), zeros(1, wp.int32)
    inputs = [n, q, hessian, linear, normal, given(low), given(high), given(softness)]
    outputs += [multiplier, x, outcome]
    wp.launch(K.dual_active_set, dim=worlds, inputs=inputs, outputs=outputs, device="cpu")
    return SimpleNamespace(
        x=x.numpy(),
        multiplier=multiplier.numpy(),
        outcome=outcome.numpy()[:, 0],
        hessian=hessian.numpy().reshape(worlds, n, n),
        linear=linear.numpy(),
        normal=normal.numpy().reshape(worlds, q, n),
    )


def problems(worlds, effectors, actuators, seed):
    """Random problems as a robot gives them: effect and compliance are blocks of one definite matrix."""
    rng = np.random.default_rng(seed)
    factor = rng.standard_normal((worlds, effectors + actuators + 1, effectors + actuators))
    w = np.einsum("wki,wkj->wij", factor, factor)
    gap = 2.0 * rng.standard_normal((worlds, effectors))
    low, high = np.full((worlds, 2 * actuators), -FAR), np.full((worlds, 2 * actuators), FAR)
    low[:, :actuators] = 0.0
    high[:, :actuators] = rng.uniform(0.1, 1.0, (worlds, actuators))
    low[:, actuators:] = -rng.uniform(0.2, 2.0, (worlds, actuators))
    high[:, actuators:] = rng.uniform(0.2, 2.0, (worlds, actuators))
    return w[:, :effectors, effectors:], w[:, effectors:, effectors:], gap, low, high


@pytest.mark.parametrize(
    ("epsilon", "upper", "expected"),
    [
        (1.0e-3, 10.0, (0.9989297917, 0.0, 1.9918146881)),
        (1.0e-3, 1.2, (0.9990004571, 0.0, 1.2)),
        (0.1, 10.0, (0.9064177276, 0.0, 1.4124722385)),
    ],
)
def test_enumerated_solutions(epsilon, upper, expected):
    """Two effectors, three actuators with efforts in [0, upper]: the best of all active sets."""
    effect = np.array([[[0.8, -0.3, 0.1], [0.2, 0.5, -0.4]]])
    compliance = np.array([[[1.0, 0.2, 0.1], [0.2, 0.9, 0.15], [0.1, 0.15, 1.1]]])
    low = np.array([[0.0] * 3 + [-FAR] * 3])
    high = np.array([[upper] * 3 + [FAR] * 3])
    found = solve(effect, compliance, np.array([[-1.0, 0.6]]), low, high, epsilon=epsilon)
    assert found.outcome[0] == program.SOLVED
    np.testing.assert_allclose(found.x[0], expected, atol=1e-8)


@pytest.mark.parametrize(("effectors", "actuators"), [(3, 4), (3, 8), (6, 4), (3, 1), (2, 12)])
def test_against_non_negative_least_squares(effectors, actuators):
    """The dual, min 1/2 |L^-1 A' m|^2 + c |m|^2 / 2 - m' (b + A G^-1 q) over m >= 0, by SciPy's active set method.

    With the factor R of A G^-1 A' + diag(c), which soft displacements and tiny c on efforts make definite, it is
    min |R' m - R^-1 (b + A G^-1 q)|. Agreement to 1e-6 of the efforts' bounds.
    """
    data = problems(60, effectors, actuators, seed=effectors + 10 * actuators)
    soft = 1.0e-6
    found = solve(*data, soft=soft)
    assert (found.outcome == program.SOLVED).all()
    low, high = data[3:]
    for w in range(60):
        kept_low, kept_high = low[w] > -FAR, high[w] < FAR
        rows = np.concatenate([found.normal[w][kept_low], -found.normal[w][kept_high]])
        bound = np.concatenate([low[w][kept_low], -high[w][kept_high]])
        c = np.concatenate([np.zeros(actuators), np.full(actuators, soft)])
        c = np.concatenate([c[kept_low], c[kept_high]]) + 1.0e-12
        factor = cho_factor(found.hessian[w])
        gram = rows @ cho_solve(factor, rows.T) + np.diag(c)
        right = bound + rows @ cho_solve(factor, found.linear[w])
        lower = np.linalg.cholesky(gram)
        m, _ = nnls(lower.T, np.linalg.solve(lower, right), maxiter=10_000)
        x = cho_solve(factor, rows.T @ m - found.linear[w])
        np.testing.assert_allclose(found.x[w], x, atol=2e-6)


@pytest.mark.parametrize(("effectors", "actuators"), [(3, 4), (3, 8), (1, 16)])
def test_optimality(effectors, actuators):
    """G x + q = A' m, bounds kept, multipliers of the bound's sign and only there, all relative to the data."""
    soft = 1.0e-6
    data = problems(200, effectors, actuators, seed=7)
    low, high = data[3:]
    found = solve(*data, soft=soft)
    assert (found.outcome == program.SOLVED).all()
    m, x = found.multiplier, found.x
    gradient = np.einsum("wij,wj->wi", found.hessian, x) + found.linear
    scale = np.abs(found.linear).max(axis=1, keepdims=True)
    assert np.abs(gradient - np.einsum("wki,wk->wi", found.normal, m)).max() < 1e-9 * scale.max()
    value = np.einsum("wki,wk->wi", found.normal.transpose(0, 2, 1), x)
    slack = np.concatenate([np.zeros((200, actuators)), np.full((200, actuators), soft)], axis=1) * np.abs(m)
    assert (value >= low - slack - 1e-7).all() and (value <= high + slack + 1e-7).all()
    at_low, at_high = m > 0.0, m < 0.0
    np.testing.assert_allclose((value + slack)[at_low], low[at_low], atol=1e-7)
    np.testing.assert_allclose((value - slack)[at_high], high[at_high], atol=1e-7)
    assert at_low.any() and at_high.any()


def test_conflict_is_answered_by_the_nearest_displacement():
    """One actuator, effort in [0, 1], displacement d = x must reach 3: it pulls with all it may."""
    one = np.ones((1, 1, 1))
    found = solve(one, one, np.zeros((1, 1)), np.array([[0.0, 3.0]]), np.array([[1.0, FAR]]), soft=1.0e-6)
    assert found.outcome[0] == program.SOLVED
    assert found.x[0, 0] == pytest.approx(1.0, abs=1e-9)


def test_conflict_of_a_stiff_robot_is_answered_as_well():
    """Effort at most 0.1 N, a displacement of at least 5 at 10 per newton, and a Hessian of 5e-9: 0.1 N, not stuck.

    What the soft row gains is its softness alone, far below the rounding of 10^2 / 5e-9.
    """
    effect, compliance = np.array([[[7.0e-5]]]), np.array([[[10.0]]])
    low, high = np.array([[0.0, 5.0]]), np.array([[0.1, FAR]])
    found = solve(effect, compliance, np.array([[-0.01]]), low, high, soft=1.0e-6, epsilon=1.0e-4)
    assert found.outcome[0] == program.SOLVED
    np.testing.assert_allclose(found.x, 0.1, rtol=1e-4)


def test_equal_actuators_share():
    """Two actuators of the same effect and energy pull alike, whatever they add up to."""
    effect, compliance = np.ones((1, 1, 2)), np.ones((1, 2, 2))
    low, high = np.array([[0.0, 0.0, -FAR, -FAR]]), np.array([[FAR, FAR, FAR, FAR]])
    found = solve(effect, compliance, np.array([[-2.0]]), low, high)
    assert found.x[0, 0] == pytest.approx(found.x[0, 1], rel=1e-3)
    assert found.x[0].sum() == pytest.approx(2.0 / 1.001, rel=1e-6)


def test_fixed_efforts():
    """Equal bounds leave nothing to choose; the other actuator does what it can."""
    data = problems(40, 3, 4, seed=3)
    low, high = data[3].copy(), data[4].copy()
    low[:, 4:], high[:, 4:] = -FAR, FAR
    low[:, 1] = high[:, 1] = 0.3
    found = solve(*data[:3], low, high)
    assert (found.outcome == program.SOLVED).all()
    np.testing.assert_allclose(found.x[:, 1], 0.3, atol=1e-9)


def test_world_equals_alone():
    """Bits of a world do not depend on the batch."""
    data = problems(9, 3, 8, seed=1)
    together = solve(*data, soft=1.0e-6)
    alone = solve(*(part[4:5] for part in data), soft=1.0e-6)
    np.testing.assert_array_equal(together.x[4], alone.x[0])
    np.testing.assert_array_equal(together.multiplier[4], alone.multiplier[0])


def test_numbers_that_are_not_finite_do_not_hang():
    """NaN in, no claim of a solution out; neighbours are right."""
    data = problems(3, 3, 4, seed=5)
    whole = solve(*data)
    data[2][1, 0] = np.nan
    found = solve(*data)
    np.testing.assert_array_equal(found.x[[0, 2]], whole.x[[0, 2]])
    assert not np.isfinite(found.x[1]).all()
