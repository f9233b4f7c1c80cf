"""A thick-walled tube under pressure from within, in plane strain, as Poisson's ratio nears 1/2: nothing locks."""

import numpy as np
import pytest

import softwarp as sw
from softwarp import meshing

YOUNGS, PRESSURE = 1.0e5, 1.0  # Pa; strains of 1e-5 are those of linear elasticity
INNER, OUTER = 0.01, 0.02  # m
LAWS = {"warped": sw.Corotational, "neo-Hookean": sw.NeoHookean}
NUS = (0.3, 0.49, 0.499)


def lame(radius: float, nu: float) -> float:
    """Radial displacement [m] of Lamé's tube, p a^2 (1 + nu) ((1 - 2 nu) r + b^2 / r) / (E (b^2 - a^2))."""
    shape = (1.0 - 2.0 * nu) * radius + OUTER**2 / radius
    return PRESSURE * INNER**2 * (1.0 + nu) * shape / (YOUNGS * (OUTER**2 - INNER**2))


def tube(element: str, cells: tuple[int, int, int], law: str, nu: float) -> tuple[float, float]:
    """Radial displacements of the inner and the outer wall over those of ``lame``, from a quarter of the tube."""
    block = meshing.box((1.0, 1.0, 1.0), cells)
    r, angle = INNER + (OUTER - INNER) * block.nodes[:, 0], 0.5 * np.pi * block.nodes[:, 1]
    height = 0.5 * (OUTER - INNER) * cells[2] / cells[0]
    x = np.stack([r * np.cos(angle), r * np.sin(angle), height * block.nodes[:, 2]], axis=1)
    mesh = meshing.TetMesh(x, block.tets, "tube")
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    solid = meshing.elevate(mesh, project=curved) if element == "p2" else mesh
    body = builder.add_tets(solid, material=LAWS[law](YOUNGS, nu), density=1000.0)
    nodes = np.asarray(solid.nodes)
    tiny = 1.0e-9
    for axis, name in enumerate("xyz"):
        on_plane = np.abs(nodes[:, axis]) < tiny
        if axis == 2:
            on_plane |= np.abs(nodes[:, 2] - height) < tiny
        builder.fix(body, nodes=np.flatnonzero(on_plane), axes=name)
    # the pressure as a dead load of every strip of the inner wall, along the normal in its middle
    for k in range(cells[1]):
        middle = 0.5 * np.pi * (k + 0.5) / cells[1]
        normal = np.array([np.cos(middle), np.sin(middle), 0.0])

        def strip(centres: np.ndarray, k: int = k) -> np.ndarray:
            turn = np.arctan2(centres[:, 1], centres[:, 0]) / (0.5 * np.pi) * cells[1]
            inside = np.hypot(centres[:, 0], centres[:, 1]) < INNER * (1.0 + tiny)
            level = (centres[:, 2] > tiny) & (centres[:, 2] < height - tiny)
            return inside & level & (turn > k) & (turn < k + 1)

        builder.add_traction(body, tuple(PRESSURE * normal), where=strip)
    sim = sw.Simulation(builder.finalize(1, "cpu", "float64"))
    assert bool(sim.solve_static(tolerance=1e-9).converged.all())
    moved = np.asarray(sim.node_x[0])[: len(nodes)] - nodes
    radius = np.hypot(nodes[:, 0], nodes[:, 1])
    outward = np.einsum("ij,ij->i", moved[:, :2], nodes[:, :2]) / radius
    result = []
    for wall in (INNER, OUTER):
        here = np.abs(radius - wall) < 1e-6
        result.append(float(outward[here].mean()) / lame(wall, nu))
    return result[0], result[1]


def curved(points: np.ndarray) -> np.ndarray:
    """Edge nodes of both walls onto their cylinders; those of straight faces stay."""
    moved = points.copy()
    radius = np.hypot(points[:, 0], points[:, 1])
    for wall in (INNER, OUTER):
        near = np.abs(radius - wall) < 0.04 * wall
        moved[near, :2] *= (wall / radius[near])[:, None]
    return moved


@pytest.mark.parametrize("law", [pytest.param("warped", marks=pytest.mark.slow), "neo-Hookean"])
def test_quadratic_tube_does_not_lock(law: str) -> None:
    """Two cells through the wall, six around: both walls to 1.6 %, which one from nu = 0.3 to 0.499 may lose."""
    errors = [np.abs(np.array(tube("p2", (2, 6, 1), law, nu)) - 1.0).max() for nu in NUS]
    assert max(errors) < 0.016
    assert errors[0] < 0.006


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
def test_quadratic_tube_converges(law: str) -> None:
    """Four cells through the wall, eight around: both walls to 0.4 %, whatever nu is."""
    for nu in NUS:
        np.testing.assert_allclose(tube("p2", (4, 8, 1), law, nu), 1.0, atol=4e-3)


@pytest.mark.slow
def test_linear_tube_locks() -> None:
    """What the docs say of linear elements, on (8, 16, 2) cells: 1 % stiff at nu = 0.3, a fifth at 0.499."""
    assert tube("p1", (8, 16, 2), "warped", 0.3) == pytest.approx((0.990, 0.992), abs=2e-3)
    assert tube("p1", (8, 16, 2), "warped", 0.499) == pytest.approx((0.796, 0.790), abs=5e-3)
