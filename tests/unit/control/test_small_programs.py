"""Small quadratic programs beside another solver, and with limits that cannot all hold."""

import math

import numpy as np
import torch
from scipy.optimize import minimize

from softwarp.control.program import minimise


def test_solutions_beside_another_solver() -> None:
    """Random programs of six unknowns and thirty rows whose scales lie far apart, as metres and newtons do."""
    rng = np.random.default_rng(3)
    worlds, n, m = 12, 6, 30
    root = rng.standard_normal((worlds, n + 2, n))
    p = root.transpose(0, 2, 1) @ root + 0.01 * np.eye(n)
    q = 3.0 * rng.standard_normal((worlds, n))
    g = rng.standard_normal((worlds, m, n)) * 10.0 ** rng.uniform(-3.0, 3.0, (worlds, m, 1))
    size = np.linalg.norm(g, axis=2)
    low, high = -rng.uniform(0.0, 0.5, (worlds, m)) * size, rng.uniform(0.0, 0.5, (worlds, m)) * size
    high[:, ::3] = math.inf
    g[:, 5] = 0.0  # no row at all
    x = minimise(*(torch.from_numpy(part) for part in (1e-6 * p, 1e-6 * q, g, low, high))).numpy()
    for k in range(worlds):
        held = np.flatnonzero(np.linalg.norm(g[k], axis=1) > 0.0)
        rows, least, most = (
            g[k, held] / size[k, held, None],
            low[k, held] / size[k, held],
            high[k, held] / size[k, held],
        )
        finite = np.isfinite(most)
        limits = [
            {"type": "ineq", "fun": lambda y, a=rows, b=least: a @ y - b},
            {"type": "ineq", "fun": lambda y, a=rows[finite], b=most[finite]: b - a @ y},
        ]
        cost = lambda y, k=k: 0.5 * y @ p[k] @ y + q[k] @ y  # noqa: E731
        best = minimize(cost, np.zeros(n), method="SLSQP", constraints=limits, options={"ftol": 1e-12, "maxiter": 500})
        assert best.success
        inside = np.concatenate([rows @ x[k] - least, (most - rows @ x[k])[finite]]).min()
        assert inside > -2.0e-2
        assert cost(x[k]) < best.fun + 5.0e-3 * abs(best.fun)


def test_conflicts_stay_finite_and_alone() -> None:
    """Two rows ask for opposite things in one world; the other one gets its own solution."""
    p = torch.eye(2, dtype=torch.float64).expand(2, 2, 2)
    q = torch.tensor([[-1.0, 0.0], [-1.0, 0.0]], dtype=torch.float64)
    g = torch.tensor([[[1.0, 0.0], [1.0, 0.0]]], dtype=torch.float64).expand(2, 2, 2)
    low = torch.tensor([[1.0, -2.0], [-2.0, -2.0]], dtype=torch.float64)
    high = torch.tensor([[2.0, -1.0], [0.5, 2.0]], dtype=torch.float64)
    x = minimise(p, q, g, low, high)
    assert torch.isfinite(x).all() and x[0].abs().max() < 3.0
    torch.testing.assert_close(x[1], torch.tensor([0.5, 0.0], dtype=torch.float64), atol=1e-4, rtol=0.0)
