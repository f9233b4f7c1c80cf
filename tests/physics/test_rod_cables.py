"""Cables through rods and rigid bodies: the tendon formulas of the validation catalogue, section 8.1."""

import numpy as np
import pytest

import softwarp as sw

YOUNGS, RADIUS, LENGTH, OFFSET, TENSION = 1e6, 0.005, 0.2, 0.004, 0.5
BENDING, STRETCHING = YOUNGS * np.pi * RADIUS**4 / 4.0, YOUNGS * np.pi * RADIUS**2


def tendon(segments: int, control: str, worlds: int = 1, precision: str = "float64") -> sw.Simulation:
    """A straight rod along x, clamped at its start, with one parallel tendon at y = OFFSET."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    points = np.linspace((0.0, 0.0, 0.0), (LENGTH, 0.0, 0.0), segments + 1)
    rod = builder.add_rod(points, radius=RADIUS, youngs=YOUNGS, nu=0.3, density=1000.0)
    builder.fix(rod, nodes=[0])
    builder.add_cable(rod, points + (0.0, OFFSET, 0.0), control=control)
    return sw.Simulation(builder.finalize(worlds, precision=precision), dt=0.01)


def test_parallel_tendon():
    """kappa = T d / EI, strain -T / EA, pull L (kappa d - strain), tip (1 + strain) (sin kL, 1 - cos kL) / k.

    The chords of a tendon through n sections are shorter than its arc, which leaves an error of order 1/n^2.
    """
    kappa, strain = TENSION * OFFSET / BENDING, -TENSION / STRETCHING
    tip = (1.0 + strain) / kappa * np.array([np.sin(kappa * LENGTH), 1.0 - np.cos(kappa * LENGTH)])
    pull = LENGTH * (kappa * OFFSET - strain)
    np.testing.assert_allclose([*tip, pull], [0.1774525, 0.0765862, 4.5327328e-3], rtol=1e-5)  # the catalogue's values
    errors = []
    for segments in (10, 20, 40):
        sim = tendon(segments, "force")
        sim.control.cable_tension[:] = TENSION
        assert sim.solve_static().converged.all()
        errors.append(abs(sim.rod_x[0, -1, :2].numpy() - tip).max() / LENGTH)
        np.testing.assert_allclose(sim.cable_displacement[0, 0], pull, rtol=4.0 / segments**2)
    assert errors[2] < 1e-3
    assert 3.5 < errors[0] / errors[1] < 4.5
    assert 3.5 < errors[1] / errors[2] < 4.5


def test_length_control_finds_the_tension():
    """The multiplier of an imposed displacement is the tension that causes it (8.2)."""
    forced = tendon(20, "force")
    forced.control.cable_tension[:] = TENSION
    assert forced.solve_static().converged.all()
    held = tendon(20, "length")
    held.control.cable_displacement[:] = forced.cable_displacement
    assert held.solve_static().converged.all()
    np.testing.assert_allclose(held.cable_tension[0, 0], TENSION, rtol=1e-6)
    np.testing.assert_allclose(held.rod_x[0], forced.rod_x[0], atol=1e-8)
    change = 1e-8  # m; the rod is doubted where it arrives, leaves, and is called back to where it was
    held.reset()
    held.control.cable_displacement[:] = forced.cable_displacement + change
    assert held.solve_static().converged.all()
    np.testing.assert_allclose(held.cable_tension[0, 0] - TENSION, 108.4 * change, rtol=1e-3)


@pytest.mark.parametrize(("worlds", "precision"), [(1, "float64"), (9, "float32")])
def test_cable_between_rigid_bodies_is_an_atwood_machine(worlds, precision):
    """Two masses on a cable over a fixed point: a = (m1 - m2) g / (m1 + m2) (8.4)."""
    builder = sw.ModelBuilder()
    heavy = builder.add_rigid(mass=0.3, inertia=(1e-4,) * 3, pose=(0.1, 0.0, -1.0), free_axes="z")
    light = builder.add_rigid(mass=0.2, inertia=(1e-4,) * 3, pose=(-0.1, 0.0, -1.0), free_axes="z")
    post = builder.add_rigid(kinematic=True, pose=(0.0, 0.0, 0.0))
    path = [(0.1, 0.0, -1.0), (0.1, 0.0, 0.0), (-0.1, 0.0, 0.0), (-0.1, 0.0, -1.0)]
    builder.add_cable([heavy, post, post, light], path)
    sim = sw.Simulation(builder.finalize(worlds, precision=precision), dt=0.01)
    for _ in range(10):
        sim.step()
    np.testing.assert_allclose(sim.body_twist[:, heavy, 2], -0.1962, rtol=1e-3)
    np.testing.assert_allclose(sim.body_twist[:, light, 2], 0.1962, rtol=1e-3)
    np.testing.assert_allclose(sim.cable_tension, 2 * 0.3 * 0.2 / 0.5 * 9.81, rtol=1e-3)
    assert (sim.status == 0).all()


def test_cable_from_a_moving_base_through_a_soft_body():
    """A base that carries the first waypoint and the clamped nodes takes the whole robot along unchanged."""
    mesh = sw.meshing.box((0.2, 0.03, 0.03), (8, 2, 2))

    def robot(speed: float) -> sw.Simulation:
        builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        soft = builder.add_tets(mesh, material=sw.Corotational(2e5, 0.4), density=1000.0)
        base = builder.add_rigid(sw.Box((0.02, 0.03, 0.03)), kinematic=True, pose=(-0.01, 0.015, 0.015))
        builder.attach(soft, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)), to=base)
        path = [(-0.01, 0.015, 0.025), (0.05, 0.015, 0.025), (0.19, 0.015, 0.025)]
        builder.add_cable([base, soft, soft], path)
        sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.01)
        sim.node_v[..., 0] = speed
        sim.control.body_velocity[:, base, 0] = speed
        sim.control.cable_displacement[:] = 0.005
        return sim

    still, moving = robot(0.0), robot(0.3)
    for _ in range(50):
        still.step()
        moving.step()
    count = still.model.body_node_count
    shifted = still.node_x[0, :count].numpy() + (0.3 * 0.5, 0.0, 0.0)
    np.testing.assert_allclose(moving.node_x[0, :count], shifted, atol=1e-10)
    np.testing.assert_allclose(moving.cable_tension, still.cable_tension, rtol=1e-8)
    assert still.cable_tension.item() > 0.5
