"""The tangent of chamber pressures: a help for Newton's method that must not change what it finds."""

import numpy as np
import pytest

import softwarp as sw
from softwarp import meshing


def inflated(pressure_tangent: bool, damping: float) -> np.ndarray:
    """Nodes [m] of a finger after five converged steps under 20 kPa."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    mesh = meshing.box((0.12, 0.03, 0.03), (8, 2, 2))
    finger = builder.add_tets(mesh, material=sw.NeoHookean(2e5, 0.4), density=1000.0, rayleigh=(0.0, damping))
    builder.fix(finger, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)))
    chamber = meshing.box((0.08, 0.01, 0.01), (2, 1, 1))
    builder.add_cavity(finger, chamber.nodes + (0.02, 0.01, 0.017), chamber.surface())
    sim = sw.Simulation(
        builder.finalize(precision="float64"), dt=0.01, newton_iterations=25, pressure_tangent=pressure_tangent
    )
    sim.control.cavity_pressure.fill_(2e4)
    for _ in range(5):
        sim.step()
    assert int(sim.status[0]) == sw.Status.OK
    return sim.node_x[0].numpy().copy()


@pytest.mark.parametrize("damping", [0.0, 0.05])
def test_tangent_does_not_change_the_answer(damping: float) -> None:
    """Converged steps are the same with and without it, also with damping: beta K v knows no pressure."""
    moved = inflated(True, damping)
    assert np.abs(moved - meshing.box((0.12, 0.03, 0.03), (8, 2, 2)).nodes).max() > 2e-4
    assert np.abs(moved - inflated(False, damping)).max() < 1e-9


def swung(pressure_tangent: bool) -> np.ndarray:
    """Angles [rad] of a pendulum beside a soft cube with an empty chamber, one linearisation per step."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    cube = builder.add_tets(meshing.box((0.1, 0.1, 0.1), (2, 2, 2)), material=sw.Corotational(1e5, 0.3), density=1000.0)
    builder.fix(cube, box=((-1.0, -1.0, -1.0), (1.0, 1.0, 1e-6)))
    chamber = meshing.box((0.04, 0.04, 0.04), (1, 1, 1))
    builder.add_cavity(cube, chamber.nodes + 0.03, chamber.surface(), control="pressure")
    bob = builder.add_rigid(sw.Sphere(0.01), mass=0.1, pose=(0.525, 0.0, -0.043))
    builder.add_joint(None, bob, "hinge", anchor=(0.5, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.01, pressure_tangent=pressure_tangent)
    found = []
    for _ in range(100):
        sim.step()
        found.append(float(sim.joint_position[0, 0]))
    return np.array(found)


def test_tangent_leaves_joints_alone() -> None:
    """A pendulum swings on beside a chamber: what forces of joints stiffen is for Newton's method alone."""
    assert np.array_equal(swung(True), swung(False))
