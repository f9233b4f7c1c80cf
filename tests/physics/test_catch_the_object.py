"""The scene of CatchTheObject: inflated pads, the threshold of their grip, a fall with drag, a moving cart."""

import numpy as np
import pytest

import softwarp as sw
from softwarp.envs.scenes.catch_the_object import CatchSceneConfig, build_catch_scene

G, H = 9.81, 0.01


def build(height=0.235, worlds=1, **options):
    """Simulation in float64 and ids of the scene's parts."""
    config = CatchSceneConfig(**options)
    builder = sw.ModelBuilder(gravity=config.gravity)
    scene = build_catch_scene(config, builder, ball_height=height)
    sim = sw.Simulation(builder.finalize(worlds, precision="float64", contact_capacity=16), dt=H)
    return sim, scene


def run(sim, steps):
    for _ in range(steps):
        sim.step()
    assert (sim.status == 0).all()


def fronts(sim, scene):
    """Travel of the middles of both fronts towards each other [m], per world."""
    model = sim.model
    middle = [np.argmin(np.linalg.norm(model.node_rest - [x, 0.0, 0.135], axis=1)) for x in (-0.015, 0.015)]
    moved = sim.node_x[:, middle, 0].numpy() - model.node_rest[middle, 0]
    return moved * [1.0, -1.0]


def test_inflation():
    """Both fronts travel alike, by about what the published mesh does: 2.0, 4.0, 5.9, 7.7 mm at these pressures.

    The chambers grow evenly at first, dV = 2.5 cm^3 at 37.5 kPa, and faster later, as the walls turn into membranes
    that this law does not stiffen. At small pressure the work p dV / 2 is the elastic energy.
    """
    pressures = np.array([37.5e3, 75.0e3, 112.5e3, 150.0e3])
    sim, scene = build(height=3.0, worlds=4, gravity=(0.0, 0.0, 0.0))
    sim.control.cavity_pressure.copy_(sim.control.cavity_pressure.new_tensor(pressures)[:, None])
    run(sim, 60)
    travel = fronts(sim, scene)
    np.testing.assert_allclose(travel[:, 0], travel[:, 1], rtol=1e-6)
    np.testing.assert_allclose(travel[:, 0], [2.0e-3, 4.0e-3, 5.9e-3, 7.7e-3], rtol=0.06)
    grown = sim.cavity_volume.numpy() - 32.0133e-6
    np.testing.assert_allclose(grown[:, 0], grown[:, 1], rtol=1e-6)
    assert (np.diff(grown[:, 0], prepend=0.0) > 0.0).all() and (np.diff(grown[:, 0], 2, prepend=0.0) > 0.0).all()

    sim, scene = build(height=3.0, gravity=(0.0, 0.0, 0.0))
    sim.control.cavity_pressure.fill_(1.0e3)
    run(sim, 60)
    work = 0.5 * 1.0e3 * float((sim.cavity_volume - 32.0133333e-6).sum())
    np.testing.assert_allclose(float(sim.elastic_energy()[0]), work, rtol=0.01)


def test_grip_holds_above_its_threshold():
    """The ball stays between the pads if and only if their friction can carry it: 2 mu N > m g."""
    mu = 0.8
    pressures = np.linspace(74.0e3, 98.0e3, 9)
    sim, scene = build(height=0.135, worlds=len(pressures), mu=mu)
    held = sim.control.body_force[:, scene.ball, 2]
    held.fill_(G)  # carry the ball while the pads close
    for k in range(60):
        sim.control.cavity_pressure.copy_(sim.control.cavity_pressure.new_tensor(pressures)[:, None] * min(k / 20, 1.0))
        sim.step()
    force = [sim.contact_force(scene.ball, pad).numpy() for pad in scene.pads]
    normal = 0.5 * (force[0][:, 0] - force[1][:, 0])
    np.testing.assert_allclose(force[0][:, 0], -force[1][:, 0], rtol=1e-3, atol=1e-6)
    assert (np.diff(normal) >= 0.0).all()
    held.fill_(0.0)
    before = sim.body_pose[:, scene.ball, 2].numpy().copy()
    run(sim, 30)
    sunk = before - sim.body_pose[:, scene.ball, 2].numpy()
    carries = 2.0 * mu * normal / G
    assert (carries > 1.1).sum() >= 2 and (carries < 0.9).sum() >= 2
    assert (sunk[carries > 1.1] < 2e-3).all(), (sunk, carries)
    assert (sunk[carries < 0.9] > 0.02).all(), (sunk, carries)
    weight = sum(sim.contact_force(scene.ball, pad)[:, 2].numpy() for pad in scene.pads)
    np.testing.assert_allclose(weight[carries > 1.1], G, rtol=1e-3)


def test_fall_with_drag():
    """v' = g - 5 v by backward Euler, v_n = 1.962 (1 - 1.05^-n) m/s, until the ball is between the pads."""
    sim, scene = build(height=5.0)
    steps = np.arange(1, 200)
    found = []
    for _ in steps:
        sim.step()
        found.append(-float(sim.body_twist[0, scene.ball, 2]))
    np.testing.assert_allclose(found, G / 5.0 * (1.0 - 1.05**-steps), rtol=1e-9)
    assert abs(found[-1] - 1.962) < 2e-4  # terminal speed


@pytest.mark.parametrize("dropped_at", [0.0, 0.007])
def test_ball_rests_in_the_moving_cart(dropped_at):
    """Dropped without pressure the ball falls into the cart, which then takes it along.

    It slides v^2 / (2 mu g) = 5.7 mm at most until friction has given it the cart's 0.3 m/s, then stands still in it,
    drag included: 5 m v = 1.5 N against mu m g = 7.8 N.
    """
    sim, scene = build()
    sim.control.body_pose[:, scene.cart, 0] = -dropped_at
    run(sim, 60)
    np.testing.assert_allclose(sim.body_pose[0, scene.ball].numpy()[:3], [0.0, 0.0, 0.021], atol=2e-5)
    for _ in range(30):
        sim.control.body_pose[:, scene.cart, 0] += 0.3 * H
        sim.step()
    assert (sim.status == 0).all()
    ball, cart = sim.body_pose[0, scene.ball].numpy(), sim.body_pose[0, scene.cart].numpy()
    speed = sim.body_twist[0, scene.ball, :3].numpy()
    np.testing.assert_allclose(speed, [0.3, 0.0, 0.0], atol=1e-4)
    assert 0.0 < cart[0] + dropped_at - ball[0] < 0.0075
    np.testing.assert_allclose(ball[2], 0.021, atol=2e-5)
    force = sim.contact_force(scene.ball, scene.cart)[0].numpy()
    np.testing.assert_allclose(force, [1.5, 0.0, G], rtol=1e-3, atol=1e-3)
