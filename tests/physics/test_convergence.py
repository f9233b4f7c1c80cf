"""Observed orders of convergence in the edge length h and the step dt, element by element (catalogue section 12).

Linear elements: displacements O(h^2), gradients O(h). Quadratic ones: O(h^3) and O(h^2). Backward Euler: O(dt).
"""

import numpy as np
import pytest

from softwarp import meshing
from tests import cases, element_cases
from tests.element_cases import manufactured_errors

# Catalogue 12: errors of displacement and of its gradient on the unit cube, cells along an edge -> (L2, gradient)
MANUFACTURED = {
    ("p1", 4): (5.8716e-3, 6.2097e-2),
    ("p1", 8): (1.8294e-3, 3.3031e-2),
    ("p1", 16): (4.9684e-4, 1.6742e-2),
    ("p2", 2): (3.5440e-3, 4.5472e-2),
    ("p2", 4): (4.7215e-4, 1.3841e-2),
    ("p2", 8): (5.7926e-5, 3.7326e-3),
}
TOLERANCE = {"p1": 0.02, "p2": 0.07}  # quadratic elements were integrated with 11 points there, with 4 here


def check_orders(element: str, counts: tuple[int, int], at_least: tuple[float, float]) -> None:
    errors = [manufactured_errors(element, n) for n in counts]
    for n, found in zip(counts, errors, strict=True):
        np.testing.assert_allclose(found, MANUFACTURED[element, n], rtol=TOLERANCE[element])
    orders = np.log2(errors[0] / errors[1])
    assert (orders > at_least).all(), f"orders {orders}, expected {at_least}"


@pytest.mark.parametrize(
    ("element", "counts", "at_least"),
    [("p1", (4, 8), (1.65, 0.9)), pytest.param("p2", (2, 4), (2.85, 1.7), marks=pytest.mark.slow)],
)
def test_orders_in_h(element: str, counts: tuple[int, int], at_least: tuple[float, float]) -> None:
    """Manufactured solution on coarse meshes: numbers as from scikit-fem, orders on the way to 2, 1 and 3, 2."""
    check_orders(element, counts, at_least)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("element", "counts", "at_least"), [("p1", (8, 16), (1.85, 0.95)), ("p2", (4, 8), (2.95, 1.85))]
)
def test_orders_in_h_finer(element: str, counts: tuple[int, int], at_least: tuple[float, float]) -> None:
    """The same one refinement later."""
    check_orders(element, counts, at_least)


def test_body_force_of_the_manufactured_solution(rng: np.random.Generator) -> None:
    """-Div P by central differences of the stress that the material gives, at random points: 1e-6."""
    mu, lam = cases.lame(1.0, 0.3)
    law = cases.material("nh_log", 1.0, 0.3)

    def stress(X: np.ndarray) -> np.ndarray:
        return np.asarray(law.stress(np.eye(3) + element_cases.manufactured(X)[1]))

    for X in rng.uniform(0.1, 0.9, (5, 3)):
        step = 1e-4 * np.eye(3)
        divergence = sum((stress(X + step[j]) - stress(X - step[j]))[:, j] for j in range(3)) / 2e-4
        np.testing.assert_allclose(element_cases.manufactured_force(X, mu, lam), -divergence, rtol=1e-6, atol=1e-7)


def swing(element: str, dt: float, iterations: int) -> np.ndarray:
    """Displacements [m] and velocities times 0.064 s of a short neo-Hookean beam after this time under its weight.

    Stiffness damping takes away the high modes that gravity excites when it is switched on.
    """
    mesh = element_cases.elevated(meshing.box((0.4, 0.1, 0.1), (4, 1, 1)), element)
    case = cases.body(
        mesh,
        "nh_log",
        1e5,
        0.3,
        gravity=(0.0, 0.0, -9.81),
        fixed=cases.on_plane(mesh, 0, 0.0),
        rayleigh=(0.0, 0.01),
        dt=dt,
        newton_iterations=iterations,
        project_tangent=False,
    )
    case.sim.step(round(0.064 / dt))
    assert int(case.sim.status[0]) == 0
    return np.concatenate([case.displacements(), 0.064 * case.sim.node_v[0].cpu().numpy()])


@pytest.mark.parametrize(
    ("element", "iterations"),
    [("p1", 1), *(pytest.param(*case, marks=pytest.mark.slow) for case in (("p2", 1), ("p1", 8), ("p2", 8)))],
)
def test_order_in_dt(element: str, iterations: int) -> None:
    """Final state against dt / 32: backward Euler is of order 1, with its equations solved or linearised once a step.

    The reference has an error of its own: with e = c dt, differences from it are c (dt - dt_reference).
    """
    steps = np.array([4e-3, 2e-3, 1e-3])
    fine = steps[0] / 32.0
    reference = swing(element, fine, iterations)
    errors = [np.linalg.norm(swing(element, dt, iterations) - reference) for dt in steps]
    orders = np.diff(np.log(errors)) / np.diff(np.log(steps - fine))
    np.testing.assert_allclose(orders, 1.0, atol=0.15)
