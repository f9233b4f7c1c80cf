"""A rigid sphere pressed into an elastic half space: Hertz (catalogue 7.9)."""

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from tests.contact_cases import array, contacts

YOUNGS, RADIUS, FORCE = 1.0e6, 0.01, 0.05


def hertz(nu: float) -> tuple[float, float]:
    """Depth and contact radius [m]: F = (4/3) E* sqrt(R) depth^(3/2), a = sqrt(R depth)."""
    depth = float((0.75 * FORCE * (1 - nu * nu) / (YOUNGS * np.sqrt(RADIUS))) ** (2 / 3))
    return depth, float(np.sqrt(RADIUS * depth))


def boussinesq(x: np.ndarray, nu: float) -> np.ndarray:
    """Displacement (n, 3) of the half space z < 0 under ``FORCE`` downwards at the origin, far away from it."""
    r, z = np.hypot(x[:, 0], x[:, 1]), -x[:, 2]
    rho = np.maximum(np.hypot(r, z), 1e-9)
    factor = FORCE * (1 + nu) / (2 * np.pi * YOUNGS)
    down = factor * (z * z / rho**3 + 2 * (1 - nu) / rho)
    out = factor * (z * r / rho**3 - (1 - 2 * nu) * r / (rho * (rho + z)))
    return np.stack([out * x[:, 0], out * x[:, 1], -down * r], axis=1) / np.maximum(r, 1e-12)[:, None]


def press(nu: float, cells: int, edges: int, growth: float, precision: str = "float64") -> tuple[float, float]:
    """Force over Hertz's force at Hertz's depth, and the radius that the spread of the force stands for, over Hertz's.

    A quarter of the half space, cut off where Boussinesq's displacements are imposed: ``edges`` edges to the contact
    radius, which then grow by a factor. Hertz's pressure has the mean square radius (2/5) a^2.
    """
    depth, radius = hertz(nu)
    line = np.append(0.0, np.cumsum(radius / edges * growth ** np.arange(cells)))
    box = meshing.box((1.0, 1.0, 1.0), (cells,) * 3)
    place = np.rint(box.nodes * cells).astype(int)
    x = np.stack([line[place[:, 0]], line[place[:, 1]], -line[cells - place[:, 2]]], axis=1)
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    block = builder.add_tets(meshing.TetMesh(x, box.tets), material=sw.Corotational(YOUNGS, nu), density=1000.0)
    far = (place[:, 0] == cells) | (place[:, 1] == cells) | (place[:, 2] == 0)
    builder.fix(block, nodes=np.flatnonzero(far))
    for axis in (0, 1):
        builder.fix(block, nodes=np.flatnonzero(~far & (place[:, axis] == 0)), axes="xy"[axis])
    ball = builder.add_rigid(sw.Sphere(RADIUS), kinematic=True, pose=(0.0, 0.0, RADIUS - depth))
    builder.add_contact(block, ball, alarm_distance=1e-4)
    model = builder.finalize(1, precision=precision, contact_capacity=200)
    sim = sw.Simulation(model, dt=0.1, newton_iterations=6, recovery_time=0.0)
    sim.node_x[0, torch.as_tensor(far)] = torch.as_tensor((x + boussinesq(x, nu))[far]).to(sim.node_x)
    for _ in range(2):
        sim.step()
        sim.node_v.zero_()
    seen = contacts(sim)
    load = -seen["load"][:, 2]
    spread = load @ (seen["point"][:, 0] ** 2 + seen["point"][:, 1] ** 2) / load.sum()
    return 4.0 * float(-array(sim.contact_force(block, ball))[0, 2]) / FORCE, float(np.sqrt(2.5 * spread)) / radius


@pytest.mark.slow
@pytest.mark.parametrize(("nu", "coarse", "fine"), [(0.3, 1.131, 1.046), (0.45, 1.217, 1.095)])
def test_sphere_on_a_half_space(nu: float, coarse: float, fine: float) -> None:
    """Hertz's force at Hertz's depth, extrapolated to small edges, within 2 %; the contact radius within 3 %.

    Linear tetrahedra are too stiff, by what the parameters say with 5 and with 8 edges to the contact radius; their
    error falls with the square of the edge.
    """
    found = [press(nu, 10, 5, 1.35), press(nu, 14, 8, 1.25)]
    assert found[0][0] == pytest.approx(coarse, abs=0.005)
    assert found[1][0] == pytest.approx(fine, abs=0.005)
    assert (64 * found[1][0] - 25 * found[0][0]) / 39 == pytest.approx(1.0, abs=0.02)
    assert found[1][1] == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize(
    ("precision", "tolerance"), [("float64", 0.005), pytest.param("float32", 0.007, marks=pytest.mark.slow)]
)
def test_sphere_on_a_coarse_half_space(precision: str, tolerance: float) -> None:
    """The coarse mesh alone, in both precisions: 1.131 of Hertz's force, as above; the radius within 3 %."""
    force, radius = press(0.3, 10, 5, 1.35, precision)
    assert force == pytest.approx(1.131, abs=tolerance)
    assert radius == pytest.approx(1.0, abs=0.03)
