"""Natural modes against closed forms of beams and bars, and against what steps of a ring-down do."""

import numpy as np
import pytest

import softwarp as sw
from softwarp import meshing

YOUNGS, DENSITY, LENGTH, SIDE = 1.0e6, 1000.0, 0.4, 0.02
BENDING = {"clamped": (1.87510, 4.69409, 7.85476), "free": (4.73004, 7.85320, 10.99561)}  # beta L
RAYLEIGH = (0.5, 0.001)


def bar(*, clamped=True, element="p2", cells=(10, 1, 1), worlds=1, nu=0.0, method="warped", **options):
    """A square bar along x, of a material without lateral contraction unless told."""
    builder = sw.ModelBuilder(gravity=options.pop("gravity", (0.0, 0.0, 0.0)))
    mesh, material = meshing.box((LENGTH, SIDE, SIDE), cells), sw.Corotational(YOUNGS, nu, method=method)
    given = {"rayleigh": RAYLEIGH} | options
    body = builder.add_tets(mesh, material=material, density=DENSITY, element=element, **given)
    if clamped:
        builder.fix(body, box=((-1.0, -1.0, -1.0), (1.0e-9, 1.0, 1.0)))
    return sw.Simulation(builder.finalize(worlds, precision="float64"), dt=0.005)


@pytest.mark.parametrize("ends", BENDING)
def test_bending_and_stretching(ends):
    """Pairs of bending modes as of Euler and Bernoulli, whom shear lowers by up to 1.3 % here; six zeros if free."""
    modes = bar(clamped=ends == "clamped").modes(14 if ends == "free" else 8)
    still = 6 if ends == "free" else 0
    assert (modes.frequency[:still] == 0.0).all() and (modes.ratio[:still] == 0.0).all()
    speed = np.sqrt(YOUNGS * SIDE**2 / (12.0 * DENSITY)) / (2.0 * np.pi * LENGTH**2)
    for k, beta in enumerate(BENDING[ends][:2]):
        pair = modes.frequency[still + 2 * k : still + 2 * k + 2]
        assert pair == pytest.approx(beta**2 * speed, rel=0.014)
    along = np.abs(modes.shape[:, :, 0]).sum(axis=1) / np.abs(modes.shape).sum(axis=(1, 2))
    if ends == "clamped":  # the first mode along the axis: a quarter wave, v = sqrt(E / rho)
        first = int(np.flatnonzero(along > 0.99)[0])
        assert modes.frequency[first] == pytest.approx(np.sqrt(YOUNGS / DENSITY) / (4.0 * LENGTH), rel=1e-4)


def test_shapes_and_damping_ratios():
    """Orthonormal with the mass to 1e-10, K has squares of omega; each world's (alpha/omega + beta omega)/2."""
    sim = bar(worlds=3)
    sim.params.youngs[1] *= 4.0
    sim.params.rayleigh_mass[2] = 0.0
    soft, stiff, light = (sim.modes(5, world=world) for world in range(3))
    np.testing.assert_allclose(stiff.frequency, 2.0 * soft.frequency, rtol=1e-8)
    for world, modes in enumerate((soft, stiff)):
        omega = 2.0 * np.pi * modes.frequency
        flat = modes.shape.reshape(5, -1)
        np.testing.assert_allclose(flat @ (sim.mass_matrix(world) @ flat.T), np.eye(5), atol=1e-10)
        stiffness = flat @ (sim.stiffness_matrix(world) @ flat.T)
        np.testing.assert_allclose(stiffness, np.diag(omega**2), atol=1e-8 * omega[-1] ** 2)
        np.testing.assert_allclose(modes.ratio, 0.5 * (RAYLEIGH[0] / omega + RAYLEIGH[1] * omega), rtol=1e-6)
    np.testing.assert_allclose(light.ratio, np.pi * RAYLEIGH[1] * light.frequency, rtol=1e-6)


def test_stress_changes_frequencies():
    """About the sagged state the default rotation has the modes of ``polar``, whose tangent is that of an energy."""
    found = []
    for method in ("warped", "polar"):
        sim = bar(method=method, nu=0.3, cells=(8, 1, 1), gravity=(0.0, 0.0, -2.0))
        rest = sim.modes(4).frequency
        assert sim.solve_static(tolerance=1e-10).converged.all()
        found.append(sim.modes(4).frequency)
        assert np.abs(found[-1] / rest - 1.0).max() > 0.01
    np.testing.assert_allclose(*found, rtol=1e-6)


@pytest.mark.parametrize("element", ["p1", "p2"])
def test_ring_down_is_that_of_the_mode(element):
    """Steps from a mode's shape shrink by |1 / (1 - h lambda)|: material and backward Euler as ``damping`` tells."""
    sim = bar(element=element, cells=(12, 2, 2) if element == "p1" else (8, 1, 1))
    modes = sim.modes(3)
    shape, omega, ratio = modes.shape[2], 2.0 * np.pi * modes.frequency[2], modes.ratio[2]
    sim.dt = h = 0.05 / omega
    start = sim.node_x[0].numpy().copy()
    sim.node_x[0] += sim.node_x.new_tensor(1e-6 / np.abs(shape).max() * shape)
    weight = sim.mass_matrix() @ shape.ravel()
    amplitude = []
    for _ in range(400):
        sim.step()
        amplitude.append(weight @ (sim.node_x[0].numpy() - start).ravel())
    peak = np.abs(np.array(amplitude))
    tops = [k for k in range(1, 399) if peak[k] >= peak[k - 1] and peak[k] > peak[k + 1]]
    rate = np.polyfit(tops, np.log(peak[tops]), 1)[0]
    pole = omega * complex(-ratio, np.sqrt(1.0 - ratio**2))
    assert rate == pytest.approx(-np.log(abs(1.0 - h * pole)), rel=0.01)
    assert -rate / (omega * h) == pytest.approx(modes.damping(h)[2], rel=0.05)


def test_rayleigh_factors_of_two_modes():
    """A bar with the factors of two ratios has these ratios at its modes."""
    frequency = bar().modes(8).frequency
    factors = sw.rayleigh((frequency[0], 0.06), (frequency[4], 0.03))
    ratio = bar(rayleigh=factors).modes(8).ratio
    assert ratio[[0, 4]] == pytest.approx([0.06, 0.03], rel=1e-6)
    assert min(factors) > 0.0


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (((8.0, 0.05), (8.0, 0.06)), "must differ in frequency, got 8 and 8 Hz"),
        (((8.0, 0.05), (16.0, 0.2)), "negative factor of mass; the larger may be at most 2 times the smaller"),
        (((8.0, 0.2), (16.0, 0.05)), "negative factor of stiffness"),
        (((-8.0, 0.05), (16.0, 0.05)), "frequency of the first mode"),
        (((8.0, 0.05), (16.0, float("nan"))), "damping ratio of the second mode"),
        (((8.0,), (16.0, 0.05)), "rayleigh: first must be a frequency"),
    ],
)
def test_bad_ratios_are_told(given, told):
    with pytest.raises(ValueError, match=told):
        sw.rayleigh(*given)


def test_scenes_without_modes_are_told():
    sim = bar(cells=(1, 1, 1), element="p1")
    with pytest.raises(ValueError, match="modes: count, of 12 free coordinates"):
        sim.modes(13)
    with pytest.raises(ValueError, match="world of 1"):
        sim.modes(1, world=1)
    assert len(sim.modes(12).frequency) == 12
    builder = sw.ModelBuilder()
    builder.add_rigid(sw.Sphere(0.1), mass=1.0)
    with pytest.raises(ValueError, match="modes: the scene has 0 rods and 1 rigid bodies"):
        sw.Simulation(builder.finalize(1)).modes(1)
