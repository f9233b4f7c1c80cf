"""Newton's method on contact laws, and the acceleration that goes on where it has too many rows."""

from collections.abc import Iterator

import pytest

import softwarp as sw
from softwarp import meshing
from softwarp.kernels.rows import coulomb, coulomb_newton


@pytest.fixture
def few_rows(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Newton's method solves systems of up to 32 rows."""
    monkeypatch.setattr(coulomb_newton, "MOST", 32)
    coulomb.kernels.cache_clear()
    yield
    coulomb.kernels.cache_clear()


@pytest.mark.slow
def test_acceleration_goes_on_from_where_newton_leaves_a_world(few_rows: None) -> None:
    """81 contacts of a block that falls on its face: after a few sweeps more press than Newton's method takes.

    The first sweep of the acceleration has a larger correction than the last of Newton's; to take it back again and
    again let the block fall through the floor.
    """
    mesh = meshing.elevate(meshing.box((0.1,) * 3, (4,) * 3))
    builder = sw.ModelBuilder()
    block = builder.add_tets(mesh, material=sw.NeoHookean(5e3, 0.3), density=1000.0)
    builder.add_contact(block, builder.add_rigid(sw.Plane(), kinematic=True))
    model = builder.finalize(precision="float64", contact_capacity=81)
    sim = sw.Simulation(model, dt=0.1, newton_iterations=2)
    sim.step()
    assert float(sim.node_x[0, :, 2].min()) > -1e-5
    pressing = int((sim.contact_load[0, :, 2].abs() > 0.0).sum())
    lowest = sim.node_x[0, :, 2].sort().values[:pressing]  # those that press lie on the floor
    assert pressing > 32 and float(lowest[-1]) < 1e-5
