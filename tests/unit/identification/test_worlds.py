"""Candidates as worlds: what is written where, what is read back, what is refused."""

import numpy as np
import pytest

import softwarp as sw
from softwarp.identification import Parameter, Worlds

MODULUS = Parameter("modulus", 1e4, 1e6, scale="log", target="rod_youngs", item=1)


@pytest.fixture(scope="module")
def sim():
    builder = sw.ModelBuilder()
    for y in (0.0, 0.1):
        rod = builder.add_rod([(0, y, 0), (0.1, y, 0)], radius=0.01, youngs=1e5)
        builder.fix(rod, nodes=[0])
    soft = builder.add_tets(
        sw.meshing.box((0.1, 0.1, 0.1), (1, 1, 1)), material=sw.Yeoh(c10=1e4, bulk=2e5), density=1e3
    )
    builder.fix(soft, box=((-1, -1, -1), (1, 1, 0)))
    return sw.Simulation(builder.finalize(num_worlds=7))


def test_write(sim):
    """Three candidates of two experiments; the world that is left over repeats the last."""
    parameters = [MODULUS, Parameter("c10", 1e3, 1e5, target="law.c10", item=0), Parameter("own", 0.0, 1.0)]
    parameters.append(Parameter("g", -20.0, 0.0, target="gravity", item=2))
    worlds = Worlds(sim, parameters, experiments=2)
    assert worlds.candidates == 3
    values = np.array([[2e4, 2e3, 0.1, -1.0], [3e4, 3e3, 0.2, -2.0], [4e4, 4e3, 0.3, -3.0]])
    worlds.write(values)
    expected = np.array([0, 0, 1, 1, 2, 2, 2])
    np.testing.assert_allclose(sim.params.rod_youngs[:, 1], values[expected, 0])
    np.testing.assert_allclose(sim.params.rod_youngs[:, 0], 1e5)
    np.testing.assert_allclose(sim.law_parameter(0, "c10"), values[expected, 1])
    np.testing.assert_allclose(sim.params.gravity[:, 2], values[expected, 3])
    np.testing.assert_allclose(sim.params.gravity[:, 0], 0.0)
    np.testing.assert_allclose(worlds.column(values, "own"), values[expected, 2])
    np.testing.assert_allclose(worlds.commands([[1.0, 2.0], [3.0, 4.0]])[2:4], [[1.0, 2.0], [3.0, 4.0]])


def test_gather(sim):
    """Rows of a candidate hold its experiments; a world that failed makes its candidate nan."""
    worlds = Worlds(sim, [MODULUS], experiments=2)
    read = np.arange(14.0).reshape(7, 2)
    np.testing.assert_allclose(worlds.gather(read)[1], [4.0, 5.0, 6.0, 7.0])
    sim.status[3] = int(sw.Status.NONFINITE)
    found = worlds.gather(read)
    assert np.isnan(found[1, 2:]).all()
    assert np.isfinite(found[[0, 2]]).all()
    sim.status[3] = int(sw.Status.OK)


@pytest.mark.parametrize(
    ("parameter", "message"),
    [
        ({"target": "rod_young"}, "'p': target 'rod_young' is no array of sim.params; did you mean 'rod_youngs'"),
        ({"target": "rod_youngs", "item": 2}, "'p': item of 'rod_youngs'.*at most 1"),
        ({"target": "cable_stiffness"}, "'p': this scene has nothing that target 'cable_stiffness'"),
        ({"target": "law.c10"}, "'p': item, the body"),
        ({"target": "law.c11", "item": 0}, "c11"),
    ],
)
def test_bad_targets(sim, parameter, message):
    with pytest.raises(ValueError, match=message):
        Worlds(sim, [Parameter("p", 0.0, 1.0, **parameter)])


def test_bad_counts(sim):
    with pytest.raises(ValueError, match="experiments"):
        Worlds(sim, [MODULUS], experiments=8)
    worlds = Worlds(sim, [MODULUS], experiments=2)
    with pytest.raises(ValueError, match=r"2 candidates for 3 of 7 worlds; call fit with batch=3"):
        worlds.write(np.full((2, 1), 1e5))
    with pytest.raises(ValueError, match=r"one row per experiment \(2\)"):
        worlds.commands([1.0])
    with pytest.raises(ValueError, match="'modulu' is no parameter; did you mean 'modulus'"):
        worlds.column(np.full((3, 1), 1e5), "modulu")


@pytest.mark.parametrize("values", [[[2e4], [np.nan], [2e4]], np.full((3, 2), 2e4), [2e4] * 3, "2e4"])
def test_bad_values(sim, values):
    """What is no finite number for every candidate and parameter is written nowhere."""
    worlds = Worlds(sim, [MODULUS], experiments=2)
    before = sim.params.rod_youngs.clone()
    with pytest.raises(ValueError, match=r"Worlds.write: values must be a finite number, in shape \(n, 1\)"):
        worlds.write(values)
    assert (sim.params.rod_youngs == before).all()


@pytest.mark.parametrize("read", [np.zeros((5, 2)), 1.0])
def test_readings_of_other_worlds(sim, read):
    with pytest.raises(ValueError, match=r"Worlds.gather: per_world must have one row per world \(7\)"):
        Worlds(sim, [MODULUS], experiments=2).gather(read)
