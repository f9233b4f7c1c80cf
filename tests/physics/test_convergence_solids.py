"""Locking and convergence of solids, element by element: Cook's membrane, the inflated sphere, nu near 1/2.

Catalogue 2.1, 2.3, 3.1 and 1.6. Same-mesh numbers were computed with scikit-fem (quadratic tetrahedra with 11 points of
integration) and CalculiX (with 4 points, as here); the two differ by 1e-4.
"""

import numpy as np
import pytest

from softwarp import meshing
from tests import cases, element_cases, pneumatic_cases
from tests.element_cases import elevated, exact_sphere

# Catalogue 2.1: displacement [m] of the tip, quadratic elements, end load 25 N
CANTILEVER = {
    ("stvk", 20): (-0.2561987, 0.0001987, -0.6058654),
    ("nh_log", 20): (-0.2535794, 0.0001620, -0.6061943),
    ("corot", 20): (-0.2539825, 0.0001710, -0.6055254),
    ("stvk", 40): (-0.2570996, 0.0000310, -0.6071172),
    ("nh_log", 40): (-0.2544134, 0.0000211, -0.6073586),
}


@pytest.mark.parametrize(
    ("law", "along"),
    [pytest.param(*key, marks=() if key == ("nh_log", 20) else pytest.mark.slow) for key in CANTILEVER],
)
def test_quadratic_cantilever_same_mesh(law: str, along: int) -> None:
    """Large deflection on 2 or 4 cells through the thickness, to the 1e-4 that points of integration make of |u|."""
    case = element_cases.loaded_beam("p2", law, (along, along // 10, along // 10))
    assert bool(case.sim.solve_static().converged.all())
    expected = np.array(CANTILEVER[law, along])
    error = np.abs(case.displacements()[case.node(cases.TIP)] - expected)
    assert error.max() < 2e-4 * np.linalg.norm(expected)


def linear_tip(element: str, nu: float) -> float:
    """u_z [m] of the tip per 25 N at small loads, cells (20, 2, 2)."""
    mesh = elevated(meshing.box((1.0, 0.1, 0.1), (20, 2, 2)), element)
    case = cases.body(mesh, "corot", 1e6, nu, fixed=cases.on_plane(mesh, 0, 0.0))
    case.load(element_cases.traction(mesh, cases.on_plane(mesh, 0, 1.0), (0.0, 0.0, -25e-4)))
    case.sim.solve_static(tolerance=1e-9)
    return 1e4 * case.displacements()[case.node(cases.TIP), 2]


# Cells (20, 2, 2), linear elasticity: 0.49 from catalogue 1.6, 0.499 from a NumPy assembly that gives 0.49 as well
INCOMPRESSIBLE = {
    ("p1", 0.49): -0.1051590,
    ("p1", 0.499): -0.0211941,
    ("p2", 0.49): -0.9618203,
    ("p2", 0.499): -0.9523731,
}


@pytest.mark.parametrize(("element", "nu"), INCOMPRESSIBLE)
def test_cantilever_near_incompressibility(element: str, nu: float) -> None:
    """Linear elements lose nearly all of the bending as nu -> 1/2, quadratic ones a few per cent (1.6)."""
    measured = linear_tip(element, nu)
    assert measured == pytest.approx(INCOMPRESSIBLE[element, nu], rel=2e-4)
    if element == "p2":
        assert measured < -0.92  # beam theory: -1.008


# Catalogue 2.3: displacement of the corner (48, 60, 0), quadratic elements
COOK = {
    ("stvk", (8, 8, 2)): (-7.3683, 7.9098),
    ("nh_log", (8, 8, 2)): (-7.4086, 8.1767),
    ("stvk", (16, 16, 2)): (-7.4497, 7.9515),
    ("nh_log", (16, 16, 2)): (-7.4917, 8.2192),
}


def cook(element: str, law: str, cells: tuple[int, int, int], nu: float = 0.3) -> np.ndarray:
    """Displacement (u_x, u_y) of the corner (48, 60, 0)."""
    case = element_cases.cook(element, law, cells, nu)
    assert bool(case.sim.solve_static(tolerance=1e-7).converged.all())
    return case.displacements()[case.node((48.0, 60.0, 0.0)), :2]


@pytest.mark.parametrize(
    ("law", "cells"),
    [pytest.param(*key, marks=() if key[0] == "nh_log" and key[1][0] <= 8 else pytest.mark.slow) for key in COOK],
)
def test_quadratic_cook_same_mesh(law: str, cells: tuple[int, int, int]) -> None:
    """Catalogue 2.3, to the 1e-3 that points of integration may make."""
    np.testing.assert_allclose(cook("p2", law, cells), COOK[law, cells], rtol=1e-3)


@pytest.mark.parametrize(("element", "coarse", "fine", "order"), [("p1", 6, 12, 1.0), ("p2", 3, 6, 1.5)])
def test_cook_converges(element: str, coarse: int, fine: int, order: float) -> None:
    """u_y of the corner tends to 8.23 (nh_log), quadratic elements faster than linear ones of half the edge.

    The clamped corner is singular, so orders stay below those of smooth solutions.
    """
    errors = [abs(cook(element, "nh_log", (n, n, n // 3))[1] / 8.23 - 1.0) for n in (coarse, fine)]
    assert np.log2(errors[0] / errors[1]) > order
    assert errors[1] < {"p1": 0.18, "p2": 0.02}[element]


YOUNGS = 1.0e5


def test_exact_sphere() -> None:
    """The boundary value problem against the catalogue's numbers (3.1): 1e-5; nu -> 1/2 against the closed form: 0.2 %.

    p = mu (2 / b + 1 / (2 b^4) - 2 / a - 1 / (2 a^4)) with b^3 = 1 + (a^3 - 1) A^3 / B^3.
    """
    np.testing.assert_allclose(exact_sphere(0.3, 2.0e4), (2.571350, 1.090583), rtol=1e-5)
    np.testing.assert_allclose(exact_sphere(0.45, 2.0e4), (2.813751, 0.956425), rtol=1e-5)
    a = 1.0 + exact_sphere(0.4999, 2.0e4)[0] / 10.0
    b = (1.0 + (a**3 - 1.0) / 8.0) ** (1.0 / 3.0)
    pressure = YOUNGS / 3.0 * (2.0 / b + 0.5 / b**4 - 2.0 / a - 0.5 / a**4)
    assert pressure == pytest.approx(2.0e4, rel=2e-3)


def sphere(element: str, n: int, law: str, nu: float, pressure: float, curved: bool = True) -> list[float]:
    """Mean radial displacements [mm] of elements' corners in the inner and the outer wall of the octant (n, n)."""
    case = pneumatic_cases.sphere_octant(n, n, element=element, curved=curved)
    sim = pneumatic_cases.statics(pneumatic_cases.builder_of(case, law, YOUNGS, nu))
    sim.control.cavity_pressure.fill_(pressure)
    pneumatic_cases.settle(sim)
    corner = np.unique(case.mesh.tets if case.quadratic is None else case.quadratic.elements[:, :4])
    walls = (np.intersect1d(nodes, corner) for nodes in (case.inner, case.outer))
    return [1e3 * pneumatic_cases.radial(case, sim, nodes) for nodes in walls]


@pytest.mark.parametrize(
    ("law", "pressure", "n", "expected"),
    [
        ("stvk", 1.0e4, 4, (0.938867, 0.312717)),
        pytest.param("nh_log", 2.0e4, 8, (2.532041, 1.069251), marks=pytest.mark.slow),
    ],
)
def test_quadratic_sphere_same_mesh(law: str, pressure: float, n: int, expected: tuple[float, float]) -> None:
    """Catalogue 3.1 with straight edges: 1e-3. CalculiX C3D10, with 4 points as here, has 0.938266, 0.312586."""
    np.testing.assert_allclose(sphere("p2", n, law, 0.3, pressure, curved=False), expected, rtol=1e-3)


# Element, edges per arc, largest errors of the inner and outer wall at nu = 0.3, 0.49 and 0.499
SPHERES = [("p1", 4, (0.15, 0.23, 0.24)), ("p1", 8, (0.05, 0.11, 0.125)), ("p2", 4, (0.04, 0.065, 0.07))]


@pytest.mark.parametrize(
    ("element", "n", "errors"),
    [pytest.param(*case, marks=() if case[:2] == ("p1", 4) else pytest.mark.slow) for case in SPHERES],
)
def test_sphere_near_incompressibility(element: str, n: int, errors: tuple[float, float, float]) -> None:
    """Thick sphere under 20 kPa against the exact solution as nu -> 1/2; 75 unknown nodes with p1 (4, 4), 405 else."""
    for nu, largest in zip((0.3, 0.49, 0.499), errors, strict=True):
        error = np.array(sphere(element, n, "nh_log", nu, 2.0e4)) / exact_sphere(nu, 2.0e4) - 1.0
        assert np.abs(error).max() < largest


@pytest.mark.slow
def test_quadratic_sphere_converges() -> None:
    """Curved faces, (4, 4) and (6, 6), nu = 0.3 and 0.499: the inner wall to 1.5 %, faster than with the cube of h."""
    for nu in (0.3, 0.499):
        exact = exact_sphere(nu, 2.0e4)[0]
        errors = [abs(sphere("p2", n, "nh_log", nu, 2.0e4)[0] / exact - 1.0) for n in (4, 6)]
        assert errors[1] < 0.015
        assert np.log(errors[0] / errors[1]) / np.log(1.5) > 3.0
