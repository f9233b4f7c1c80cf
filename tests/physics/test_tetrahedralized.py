"""Solids made from surfaces against closed forms and against meshes made by hand."""

import numpy as np
import pytest
import trimesh

import softwarp as sw
from softwarp import meshing

YOUNGS, NU = 1e5, 0.4


def tip_drop(mesh: meshing.TetMesh, element: str) -> float:
    """Static drop [m] of the end of a cantilever of 0.2 m under its weight."""
    builder = sw.ModelBuilder()
    beam = builder.add_tets(mesh, material=sw.Corotational(YOUNGS, NU), density=100.0, element=element)
    builder.fix(beam, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)))
    builder.add_marker(beam, (0.2, 0.02, 0.02), tolerance=1e-3)
    sim = sw.Simulation(builder.finalize(precision="float64"))
    assert sim.solve_static().converged.all()
    return 0.02 - float(sim.marker_x[0, 0, 2])


def test_cantilever():
    """Euler and Bernoulli with Timoshenko's shear: w = q L^4 / 8 EI + q L^2 / 2 kGA = 15.4 mm.

    A bar filled from its twelve triangles bends like one of boxes, with linear elements too stiff by about as much.
    """
    length, side = 0.2, 0.04
    load, area, inertia = 100.0 * 9.81 * side**2, side**2, side**4 / 12.0
    shear = YOUNGS / (2.0 * (1.0 + NU))
    exact = load * length**4 / (8.0 * YOUNGS * inertia) + load * length**2 / (2.0 * 5.0 / 6.0 * shear * area)
    bar = trimesh.creation.box((length, side, side))
    bar.apply_translation((0.5 * length, 0.5 * side, 0.5 * side))
    filled = meshing.tetrahedralize(bar, edge_length=0.018)
    by_hand = meshing.box((length, side, side), (10, 2, 2))
    curved = tip_drop(filled, "p2")
    assert curved == pytest.approx(exact, rel=0.06)  # its clamp holds the cross-section, too
    assert curved == pytest.approx(tip_drop(by_hand, "p2"), rel=0.03)
    assert 0.6 * exact < tip_drop(filled, "p1") < curved


@pytest.mark.parametrize(
    ("element", "edge", "error"), [("p1", 0.0105, 0.2), pytest.param("p2", 0.016, 0.03, marks=pytest.mark.slow)]
)
def test_pressurized_shell(element, edge, error):
    """Lame: a thick sphere under inner pressure; the wall is nested shells, the load a chamber.

    u(a) = p a^3 / (E (b^3 - a^3)) ((1 - 2 nu) a + (1 + nu) b^3 / (2 a^2)), small strains. The chamber's volume grows by
    3 u(a) / a of itself.
    """
    a, b, p = 0.02, 0.05, 100.0
    shell = trimesh.util.concatenate([trimesh.creation.icosphere(4, radius=r) for r in (b, a)])
    solid = meshing.tetrahedralize(shell, edge_length=edge)
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    mesh = solid.curved() if element == "p2" else solid
    body = builder.add_tets(mesh, material=sw.Corotational(YOUNGS, NU), density=1000.0)
    chamber = builder.add_cavity(body, solid.cavities["cavity 0"])
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=1.0)  # long steps of backward Euler are static
    before = float(sim.cavity_volume[0, chamber])
    sim.control.cavity_pressure[0, chamber] = p
    for _ in range(3):
        sim.step()
    grown = float(sim.cavity_volume[0, chamber]) - before
    inner = p * a**3 / (YOUNGS * (b**3 - a**3)) * ((1.0 - 2.0 * NU) * a + (1.0 + NU) * b**3 / (2.0 * a**2))
    assert before == pytest.approx(4.0 / 3.0 * np.pi * a**3, rel=0.1)
    assert grown / before == pytest.approx(3.0 * inner / a, rel=error)


def test_pressure_in_a_closed_chamber_pushes_the_body_nowhere():
    """The pressure's forces on a closed wall add up to nothing, nor do they turn: a free hollow box stays in place."""
    box = trimesh.creation.box((0.06, 0.05, 0.04))
    solid = meshing.tetrahedralize(box, edge_length=0.008, cavities={"air": trimesh.creation.box((0.03, 0.02, 0.012))})
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    body = builder.add_tets(solid, material=sw.NeoHookean(YOUNGS, NU), density=1000.0)
    builder.add_cavity(body, solid.cavities["air"])
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.005)
    sim.control.cavity_pressure[:] = 2000.0
    mass = np.asarray(sim.mass[0].double())
    for _ in range(5):
        sim.step()
    x, v = (np.asarray(array[0].double()) for array in (sim.node_x, sim.node_v))
    moment = np.cross(x, mass[:, None] * v).sum(axis=0)
    speed = np.linalg.norm(v, axis=1).max()
    assert speed > 1e-5
    assert np.abs((mass[:, None] * v).sum(axis=0)).max() < 1e-4 * mass.sum() * speed
    assert np.abs(moment).max() < 1e-4 * mass.sum() * speed * 0.05
    assert float(sim.cavity_volume[0, 0]) > solid.cavities["air"].volume
