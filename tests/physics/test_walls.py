"""Hexahedra with the modes of walls: fields, bending, and plain ones beside them. Theory: docs/theory/hexahedral.md."""

from typing import Any

import numpy as np
import pytest

import softwarp as sw
from softwarp import meshing
from softwarp.meshing import hexes
from softwarp.plan.hexes import own_corners, shape_arrays, stiffness
from tests import cases

YOUNGS, LENGTH, WIDTH, THICK = 1.0e5, 0.1, 0.02, 0.005  # Pa, m
FORCE = 1e-5  # N


def corners(rng: np.random.Generator) -> np.ndarray:
    """Of one irregular element, (1, 8, 3)."""
    mesh = meshing.brick((1.5, 1.0, 0.5), (1, 1, 1))
    return own_corners(mesh.nodes[mesh.hexes] + 0.05 * rng.uniform(-1.0, 1.0, (1, 8, 3)))


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.49])
def test_stretches_are_exact(nu: float, rng: np.random.Generator) -> None:
    """Six rigid motions; of a linear field only what shears the thickness meets less than its stress."""
    x = corners(rng)
    arrays, (mu, lam) = shape_arrays(x, np.array([True])), cases.lame(1.0, nu)
    K = stiffness(arrays, mu, lam)[0]
    values = np.linalg.eigvalsh(K)
    assert np.abs(values[:6]).max() < 1e-12 * values[-1]
    assert values[6] > 1e-4 * values[-1] * (1.0 - 2.0 * nu)
    brick = meshing.brick((1.5, 1.0, 0.5), (1, 1, 1))
    x = own_corners(brick.nodes[brick.hexes])
    arrays = shape_arrays(x, np.array([True]))
    softened = stiffness(shape_arrays(x), mu, lam)[0] - stiffness(arrays, mu, lam)[0]
    assert np.linalg.eigvalsh(softened)[0] > -1e-12 * values[-1]
    A = np.array([[1.0, 0.4, 0.0], [0.2, -0.5, 0.0], [0.0, 0.0, 0.7]])
    stress = mu * (A + A.T) + lam * np.trace(A) * np.eye(3)
    wanted = hexes.node_volumes(x[0], np.arange(8)[None]).sum() * arrays.shape_gradient[0].reshape(8, 3) @ stress
    found = stiffness(arrays, mu, lam)[0] @ (x[0] @ A.T).ravel()
    np.testing.assert_allclose(found.reshape(8, 3), wanted, atol=1e-12)


def sag(cells: int, nu: float, *, thin: Any) -> float:
    """Of the end of a strip that is clamped at the other one [m]; its force is shared by the end's nodes."""
    mesh = meshing.brick((LENGTH, WIDTH, THICK), (cells, 1, 1))
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    body = builder.add_hexes(mesh, material=sw.Corotational(YOUNGS, nu), density=1000.0, thin=thin)
    builder.fix(body, nodes=np.flatnonzero(mesh.nodes[:, 0] < 1e-9))
    end = np.flatnonzero(mesh.nodes[:, 0] > LENGTH - 1e-9)
    builder.add_point_load(body, end, (0.0, 0.0, -FORCE))
    sim = sw.Simulation(builder.finalize(precision="float64"))
    assert sim.solve_static().converged.all()
    return float(mesh.nodes[end[0], 2] - sim.node_x[0, int(end[0]), 2])


@pytest.mark.parametrize("cells", [1, 2, 4])
def test_one_wall_bends_under_a_force_as_a_beam_does(cells: int) -> None:
    """F L^3 / 3 E I and the shear of Timoshenko's beam, from one element on; plain ones lack 1 / (4 n^2)."""
    bent = FORCE * LENGTH**3 / (3.0 * YOUNGS * WIDTH * THICK**3 / 12.0)
    sheared = FORCE * LENGTH / (5.0 / 6.0 * 0.5 * YOUNGS * WIDTH * THICK)
    assert sag(cells, 0.0, thin=True) == pytest.approx(bent + sheared, rel=3e-3)
    assert sag(cells, 0.0, thin=False) == pytest.approx(bent * (1.0 - 0.25 / cells**2), rel=5e-3)


def test_walls_stand_beside_solid_parts() -> None:
    """One flag an element: as the force is the same along a strip, each of two equal bricks brings half of the way."""
    assert sag(2, 0.0, thin=np.array([True, True])) == sag(2, 0.0, thin=True)
    plain, first, last, walls = (sag(2, 0.0, thin=np.isin([0, 1], kinds)) for kinds in ([], [0], [1], [0, 1]))
    assert plain == sag(2, 0.0, thin=False)
    assert [first - plain, last - plain] == pytest.approx([0.5 * (walls - plain)] * 2, rel=1e-3)


def test_walls_lock_less() -> None:
    """Four walls of nu = 0.49, whose clamped end cannot narrow, lack half of what four plain elements do."""
    limit = sag(16, 0.49, thin=True)
    assert limit - sag(4, 0.49, thin=True) < 0.6 * (limit - sag(4, 0.49, thin=False)) < 0.1 * limit


def test_plain_hexahedra_are_the_same_beside_walls(rng: np.random.Generator) -> None:
    """Shapes have as many modes as the one that has most; what a plain one lacks adds nothing."""
    x = np.concatenate([corners(rng), corners(rng)])
    mu, lam = cases.lame(1.0, 0.4)
    both = stiffness(shape_arrays(x, np.array([False, True])), mu, lam)
    np.testing.assert_array_equal(both[0], stiffness(shape_arrays(x[:1]), mu, lam)[0])
    np.testing.assert_allclose(both[1], stiffness(shape_arrays(x[1:], np.array([True])), mu, lam)[0], atol=1e-13)
