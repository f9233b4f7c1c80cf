"""Fits to the simulator's own measurements: what they were made with is found, within its confidence interval."""

import numpy as np
import pytest

import softwarp as sw
from softwarp.identification import Parameter, Worlds, fit

TRUE = {"youngs": 3.2e5, "damping": 1.3, "density": 1180.0}
DT, EVERY, READINGS = 0.01, 4, 25  # s; steps between two readings
DEVIATION = 2.0e-4  # m, of the readings
CANDIDATES = 16


@pytest.fixture(scope="module")
def swing():
    """Residual-free readings of a rod that is let go: (values) -> tip (candidate, reading * 2) [m]; its Worlds."""
    builder = sw.ModelBuilder()
    rod = builder.add_rod(np.linspace((0, 0, 0), (0.2, 0, 0), 9), radius=0.01, youngs=1e5, nu=0.49, density=1000.0)
    builder.fix(rod, nodes=[0])
    tip = builder.add_marker(rod, (0.2, 0, 0))
    sim = sw.Simulation(builder.finalize(num_worlds=CANDIDATES), dt=DT)
    parameters = [
        Parameter("youngs", 1e5, 1e6, scale="log", unit="Pa", target="rod_youngs", item=rod),
        Parameter("damping", 0.0, 10.0, unit="1/s", target="rod_rayleigh_mass", item=rod),
    ]
    worlds = Worlds(sim, parameters)

    def tips(values):
        sim.reset()
        worlds.write(values)
        sim.params.rod_density[...] = TRUE["density"]
        readings = []
        for _ in range(READINGS):
            sim.step(EVERY)
            readings.append(sim.marker_x[:, tip, [0, 2]].numpy().copy())
        return worlds.gather(np.concatenate(readings, axis=1))

    return tips, worlds


@pytest.mark.parametrize("seed", range(3))
def test_modulus_and_damping(swing, seed):
    """Both within 99.9 % intervals, 1.7 times those told, and these are narrow: below 1 and 10 %."""
    tips, worlds = swing
    true = np.array([TRUE["youngs"], TRUE["damping"]])
    measured = tips(np.tile(true, (CANDIDATES, 1)))[0]
    measured = measured + DEVIATION * np.random.default_rng(seed).standard_normal(measured.shape)
    found = fit(
        worlds.space.parameters,
        lambda values: tips(values) - measured,
        samples=CANDIDATES,
        batch=CANDIDATES,
        held_out=np.arange(4, len(measured), 10),
    )
    for name in ("youngs", "damping"):
        low, high = found.interval[name]
        assert abs(found.values[name] - TRUE[name]) < 1.7 * (high - low) / 2
        assert (high - low) / 2 < {"youngs": 0.01, "damping": 0.1}[name] * TRUE[name]
    assert found.converged
    assert found.rmse == pytest.approx(DEVIATION, rel=0.3)
    assert found.held_out_rmse == pytest.approx(DEVIATION, rel=0.6)
