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
