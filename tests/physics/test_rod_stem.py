"""A stem of one section: piecewise constant curvature, as the Cosserat stems of the cart tasks have it.

With curvature k and arc length s its axis is at (1 - cos(k s)) / k sideways and sin(k s) / k up, and its energy is
E I L k^2 / 2 (Renda et al. 2018, discrete Cosserat approach).
"""

import numpy as np
import pytest
from scipy.optimize import brentq

import softwarp as sw

LENGTH, RADIUS = 0.25, 0.005


def stem(youngs: float, **options) -> tuple[sw.ModelBuilder, sw.scene.RigidBody, sw.scene.Rod]:
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    cart = builder.add_rigid(kinematic=True)
    points = [(0.0, 0.0, 0.0), (0.0, 0.0, LENGTH)]
    rod = builder.add_rod(points, radius=RADIUS, youngs=youngs, nu=0.45, density=0.0, **options)
    builder.attach(rod, nodes=[0], to=cart)
    return builder, cart, rod


def arc(k: float, s: float) -> np.ndarray:
    """Sideways and upward position at arc length s [m]."""
    return np.array([(1.0 - np.cos(k * s)) / k, np.sin(k * s) / k])


def bending(youngs: float) -> float:
    return youngs * np.pi * RADIUS**4 / 4.0


@pytest.mark.parametrize("load", [1.0, 5.0, 15.0])
def test_tip_load(load):
    """E I L k = F d(tip)/dk; the stiff section hardly shears or stretches (0.3 % at the largest load)."""
    youngs = 2.7e8
    builder, _, _ = stem(youngs)
    sim = sw.Simulation(builder.finalize(precision="float64"))
    sim.control.rod_force[:, -1, 0] = load
    assert sim.solve_static(max_iterations=400).converged.all()

    def imbalance(k: float) -> float:
        slope = (arc(k + 1e-6, LENGTH)[0] - arc(k - 1e-6, LENGTH)[0]) / 2e-6
        return bending(youngs) * LENGTH * k - load * slope

    tip = arc(brentq(imbalance, 1e-3, 12.0), LENGTH)
    np.testing.assert_allclose(sim.rod_x[0, -1, [0, 2]], tip, rtol=4e-3, atol=1e-5)
    if load == 1.0:  # the tip stiffness 4 E I / L^3 of one section, where a continuous beam has 3
        np.testing.assert_allclose(load / sim.rod_x[0, -1, 0], 4.0 * bending(youngs) / LENGTH**3, rtol=0.02)


def test_heavy_tip_buckles_as_one_section():
    """Upright is stable up to the tip weight 3 E I / L^2 of one section (a continuous beam: pi^2 / 4 E I / L^2)."""
    youngs = 2.7e8
    critical = 3.0 * bending(youngs) / LENGTH**2
    for factor, falls in ((0.9, False), (1.3, True)):
        builder, _, rod = stem(youngs, rayleigh=(0.1, 0.02))
        ball = builder.add_rigid(sw.Sphere(0.005), mass=factor * critical / 9.81, pose=(0.0, 0.0, LENGTH))
        builder.attach(ball, to=rod, node=-1)
        sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.01)
        sim.params.gravity[:] = sim.params.gravity.new_tensor([0.0, 0.0, -9.81])
        sim.control.body_force[:, ball, 0] = 1e-3
        for _ in range(300):
            sim.step()
        assert (abs(sim.rod_x[0, -1, 0].item()) > 0.01) == falls


def test_stem_bends_around_an_obstacle():
    """Pushed against a diamond it stays an arc that touches the corner; E I L k balances the contact force."""
    youngs = 1e10
    builder, cart, rod = stem(youngs, contact_pieces=20)
    turn = (0.0, np.sin(np.pi / 8), 0.0, np.cos(np.pi / 8))
    diamond = builder.add_rigid(sw.Box((0.04, 0.02, 0.04)), kinematic=True, pose=(0.05, 0.0, 0.12, *turn))
    builder.add_contact(rod, diamond)
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.01)
    sim.control.body_velocity[:, cart, 0] = 0.02
    for _ in range(200):
        sim.step()
    sim.control.body_velocity.zero_()
    for _ in range(100):
        sim.step()
    base = sim.body_pose[0, cart, 0].item()
    corner = 0.05 - 0.02 * np.sqrt(2.0)
    tip = np.array([base - sim.rod_x[0, -1, 0].item(), sim.rod_x[0, -1, 2].item()])
    k = 2.0 * tip[0] / (tip @ tip)
    np.testing.assert_allclose(tip, arc(k, LENGTH), rtol=2e-3)
    s = brentq(lambda s: arc(k, s)[1] - 0.12, 0.05, 0.24)
    axis = base - arc(k, s)[0]
    np.testing.assert_allclose((corner - axis) * np.cos(k * s), RADIUS, rtol=0.15)  # chords cut corners by 0.4 mm
    force = sim.contact_force(rod, diamond)[0].numpy()[[0, 2]] * [-1.0, 1.0]
    slope = (arc(k + 1e-6, s) - arc(k - 1e-6, s)) / 2e-6
    np.testing.assert_allclose(force @ slope, bending(youngs) * LENGTH * k, rtol=0.03)
