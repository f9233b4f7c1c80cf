"""Pressurised bodies that very long steps bring to rest, against two independent codes: catalogue, section 3.

The same meshes and finer ones with the static solver: test_chambers.py.
"""

import numpy as np
import pytest
import torch

import softwarp as sw
from tests.cases import material
from tests.pneumatic_cases import BENDER_TIP, PneumaticCase, bender, cylinder_quarter, sphere_octant


def inflate(
    case: PneumaticCase,
    law: str,
    nu: float,
    control: str = "pressure",
    *,
    precision: str = "float64",
    worlds: int = 1,
    dt: float = 10.0,
    newton_iterations: int = 40,
) -> sw.Simulation:
    """The body of a case with E = 1e5 Pa and its chamber."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    body = builder.add_tets(case.mesh, material=material(law, 1e5, nu), density=1000.0)
    for axis in range(3):
        held = np.flatnonzero(case.fixed[:, axis])
        if held.size:
            builder.fix(body, nodes=held, axes="xyz"[axis])
    anchored = np.flatnonzero(case.vertex_node < 0)
    builder.add_cavity(body, case.vertices, case.triangles, control, anchored=anchored)
    return sw.Simulation(builder.finalize(worlds, precision=precision), dt=dt, newton_iterations=newton_iterations)


def settle(sim: sw.Simulation, steps: int = 4) -> None:
    """Very long steps from rest: equilibrium."""
    for _ in range(steps):
        sim.step()
        sim.node_v.zero_()
    assert (sim.status == 0).all()


def radial(sim: sw.Simulation, case: PneumaticCase, nodes: np.ndarray, axes: slice) -> float:
    """Mean radial displacement of nodes [mm]."""
    rest = case.mesh.nodes[nodes][:, axes]
    outward = rest / np.linalg.norm(rest, axis=1, keepdims=True)
    moved = sim.node_x[0, torch.as_tensor(nodes)].double().numpy()[:, axes] - rest
    return 1e3 * float((moved * outward).sum(axis=1).mean())


@pytest.mark.parametrize(
    ("n", "law", "nu", "pressure", "inner", "outer"),
    [
        (4, "nh_log", 0.3, 2e4, 2.218635, 0.939892),
        (4, "stvk", 0.3, 1e4, 0.856194, 0.299242),
        (4, "nh_log", 0.45, 2e4, 2.351647, 0.767124),
        pytest.param(8, "nh_log", 0.3, 2e4, 2.466440, 1.046048, marks=pytest.mark.slow),
    ],
)
def test_thick_sphere(n, law, nu, pressure, inner, outer):
    """Same-mesh displacements of both walls to 1e-4 (3.1)."""
    case = sphere_octant(n, n)
    sim = inflate(case, law, nu)
    sim.control.cavity_pressure[:] = pressure
    settle(sim)
    every = slice(0, 3)
    found = [radial(sim, case, case.inner, every), radial(sim, case, case.outer, every)]
    np.testing.assert_allclose(found, [inner, outer], rtol=1e-4)


@pytest.mark.parametrize(
    ("cells", "law", "inner", "outer"),
    [((4, 6, 1), "nh_log", 2.474868, 1.657812), ((8, 12, 2), "stvk", 2.082723, 1.217936)],
)
def test_thick_cylinder(cells, law, inner, outer):
    """The same in plane strain."""
    case = cylinder_quarter(*cells)
    sim = inflate(case, law, 0.3)
    sim.control.cavity_pressure[:] = 1e4
    settle(sim)
    plane = slice(0, 2)
    found = [radial(sim, case, case.inner, plane), radial(sim, case, case.outer, plane)]
    np.testing.assert_allclose(found, [inner, outer], rtol=1e-4)


@pytest.mark.parametrize(
    ("law", "tip", "volume"),
    [
        ("stvk", (0.114091, 0.089448, -0.502664), 3.0392569e-6),
        pytest.param("nh_log", (0.102838, 0.084179, -0.493837), 3.0967234e-6, marks=pytest.mark.slow),
    ],
)
def test_bender(law, tip, volume):
    """The asymmetric chamber of 3.3 at 8 kPa: tip [mm] and volume [m^3]."""
    case = bender()
    sim = inflate(case, law, 0.4)
    sim.control.cavity_pressure[:] = 8e3
    settle(sim)
    node = int(np.linalg.norm(case.mesh.nodes - np.asarray(BENDER_TIP), axis=1).argmin())
    moved = 1e3 * (sim.node_x[0, node].numpy() - case.mesh.nodes[node])
    np.testing.assert_allclose(moved, tip, atol=1e-4 * np.abs(tip).max())
    np.testing.assert_allclose(sim.cavity_volume[0, 0], volume, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("law", ["stvk", "nh_log"])
def test_volume_and_gas_control_find_the_pressure(law):
    """At the volume that a pressure causes, the other two laws have that pressure (1e-6)."""
    case = bender()
    imposed = inflate(case, law, 0.4)
    imposed.control.cavity_pressure[:] = 8e3
    settle(imposed)
    volume = imposed.cavity_volume.clone()
    by_volume = inflate(case, law, 0.4, "volume")
    rest = by_volume.cavity_volume.clone()
    for share in (0.5, 1.0):
        by_volume.control.cavity_volume[:] = rest + share * (volume - rest)
        settle(by_volume)
    np.testing.assert_allclose(by_volume.cavity_pressure, 8e3, rtol=1e-6)
    by_gas = inflate(case, law, 0.4, "gas")
    by_gas.control.cavity_gas[:] = volume * (1.0 + 8e3 / 101325.0)
    settle(by_gas, 6)
    np.testing.assert_allclose(by_gas.cavity_pressure, 8e3, rtol=1e-6)
    np.testing.assert_allclose(by_gas.node_x, imposed.node_x, atol=1e-9)


def test_equilibrium_does_not_depend_on_the_step():
    """A pressure in pascal means the same at any step (3.2), in one linearisation per step."""
    case = sphere_octant(4, 4)
    found = []
    for dt, steps in ((1e-1, 30), (1e-2, 200), (1e-3, 2000)):
        sim = inflate(case, "nh_log", 0.3, dt=dt, newton_iterations=1)
        sim.params.rayleigh_mass[:] = 20.0
        sim.control.cavity_pressure[:] = 2e4
        for _ in range(steps):
            sim.step()
        found.append(sim.node_x[0].numpy().copy())
    np.testing.assert_allclose(found[1], found[0], atol=1e-5 * 0.02)
    np.testing.assert_allclose(found[2], found[0], atol=1e-5 * 0.02)


def test_limits_and_rates():
    """A command is cut to its limits, and approached no faster than its rate."""
    case = bender()
    sim = inflate(case, "stvk", 0.4, dt=0.01, newton_iterations=1)
    sim.params.cavity_max_pressure[:] = 5e3
    sim.params.cavity_max_pressure_rate[:] = 1e5
    sim.control.cavity_pressure[:] = 8e3
    found = []
    for _ in range(8):
        sim.step()
        found.append(sim.cavity_pressure.item())
    np.testing.assert_allclose(found, [1e3, 2e3, 3e3, 4e3, 5e3, 5e3, 5e3, 5e3])


@pytest.mark.slow
def test_membrane_on_the_wall_stiffens_the_bender():
    """A glued skin on the stretching side resists: the tip moves less, and more so the thicker it is."""
    case = bender()
    moved = []
    for thickness in (None, 1e-4, 5e-4):
        builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        body = builder.add_tets(case.mesh, material=material("nh_log", 1e5, 0.4), density=1000.0)
        builder.fix(body, nodes=np.flatnonzero(case.fixed.all(axis=1)))
        builder.add_cavity(body, case.vertices, case.triangles)
        if thickness is not None:
            skin = case.mesh.surface()
            upper = skin[(case.mesh.nodes[skin][:, :, 2] > 0.0199).all(axis=1)]
            builder.add_membrane(body, upper, thickness=thickness, youngs=5e6, nu=0.4)
        sim = sw.Simulation(builder.finalize(precision="float64"), dt=10.0, newton_iterations=40)
        sim.control.cavity_pressure[:] = 4e3
        settle(sim)
        moved.append(sim.cavity_volume.item() - sim.model.cavities.rest_volume[0])
    assert moved[0] > 1.02 * moved[1] > 1.02 * moved[2]
