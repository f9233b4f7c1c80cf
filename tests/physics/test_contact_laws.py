"""Signorini's and Coulomb's laws on rigid and soft bodies: the validation catalogue, section 7."""

import numpy as np
import pytest

import softwarp as sw
from softwarp import meshing

G = 9.81


def slope(angle: float, azimuth: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Quaternion of a plane that falls towards ``azimuth``, and its normal."""
    axis = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    normal = [np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)]
    return np.append(np.sin(angle / 2) * axis, np.cos(angle / 2)), np.array(normal)


def on_slope(shape, angle, mu, lift, *, azimuth=0.0, worlds=1, precision="float64", dt=0.01, **options):
    """A body at rest on an inclined plane; returns the simulation and its handle."""
    builder = sw.ModelBuilder()
    turn, normal = slope(angle, azimuth)
    plane = builder.add_rigid(sw.Plane(), kinematic=True, pose=(0.0, 0.0, 0.0, *turn))
    body = builder.add_rigid(shape, density=500.0, pose=(*(lift * normal), *turn), **options)
    builder.add_contact(body, plane, mu=mu)
    return sw.Simulation(builder.finalize(worlds, precision=precision), dt=dt), body


def run(sim: sw.Simulation, steps: int) -> None:
    for _ in range(steps):
        sim.step()
    assert (sim.status == 0).all()


@pytest.mark.parametrize(("worlds", "precision"), [(1, "float64"), (9, "float32")])
@pytest.mark.parametrize(("degrees", "mu", "acceleration"), [(30, 0.5, 0.657145), (35, 0.6, 0.805256), (20, 0.5, 0.0)])
def test_incline(degrees, mu, acceleration, worlds, precision):
    """g (sin - mu cos), or rest where tan < mu (7.1)."""
    angle = np.radians(degrees)
    sim, body = on_slope(sw.Box((0.2, 0.2, 0.1)), angle, mu, 0.05, worlds=worlds, precision=precision)
    run(sim, 50)
    before = sim.body_twist[:, body, :3].norm(dim=1).clone()
    run(sim, 50)
    gained = (sim.body_twist[:, body, :3].norm(dim=1) - before) / 0.5
    np.testing.assert_allclose(gained, acceleration, atol=2e-5 if precision == "float64" else 2e-3)
    if acceleration == 0.0:
        run(sim, 900)
        drift = sim.body_pose[:, body, :3] - sim.body_pose.new_tensor(0.05 * slope(angle)[1])
        assert drift.norm(dim=1).max() < (1e-6 if precision == "float64" else 1e-5)


def test_threshold_of_sliding():
    """Bisection finds arctan mu within 0.5 %."""
    mu, low, high = 0.4, 0.2, 0.6
    for _ in range(9):
        middle = 0.5 * (low + high)
        sim, body = on_slope(sw.Box((0.2, 0.2, 0.05)), middle, mu, 0.025)
        run(sim, 60)
        slides = sim.body_twist[0, body, :3].norm() > 1e-6
        low, high = (low, middle) if slides else (middle, high)
    np.testing.assert_allclose(0.5 * (low + high), np.arctan(mu), rtol=5e-3)


def test_friction_cone_is_round():
    """The acceleration does not depend on the direction of the slope, and friction opposes the slip (7.6)."""
    angle, mu, found = np.radians(30), 0.4, []
    for azimuth in np.radians([0.0, 17.0, 45.0, 71.0, 90.0]):
        sim, body = on_slope(sw.Box((0.2, 0.2, 0.05)), angle, mu, 0.025, azimuth=azimuth)
        run(sim, 50)
        v = sim.body_twist[0, body, :3].numpy()
        found.append(np.linalg.norm(v) / 0.5)
        down = np.array([np.cos(angle) * np.cos(azimuth), np.cos(angle) * np.sin(azimuth), -np.sin(angle)])
        assert np.degrees(np.arccos(min(v @ down / np.linalg.norm(v), 1.0))) < 1.0
    np.testing.assert_allclose(found, G * (np.sin(angle) - mu * np.cos(angle)), rtol=5e-3)


def test_box_tips_before_it_slides():
    """A block of width b and height h tips where b / h < tan of the slope, if friction holds it."""
    for width, tips in ((0.05, True), (0.09, False)):
        sim, body = on_slope(sw.Box((width, 0.1, 0.2)), np.radians(20), 0.8, 0.1)
        run(sim, 100)
        cosine = float(abs(sim.body_pose[0, body, 3:] @ sim.body_pose.new_tensor(slope(0.349066)[0])))
        turned = 2.0 * np.arccos(min(cosine, 1.0))
        assert (turned > 0.3) == tips


@pytest.mark.parametrize(
    ("shape", "lift", "share"), [(sw.Sphere(0.05), 0.05, 5 / 7), (sw.Cylinder(0.05, 0.1), 0.05, 2 / 3)]
)
def test_rolling(shape, lift, share):
    """Solid sphere 5/7, cylinder 2/3 of g sin without slip (7.4)."""
    angle = np.radians(15)
    builder = sw.ModelBuilder()
    turn, normal = slope(angle)
    plane = builder.add_rigid(sw.Plane(), kinematic=True, pose=(0.0, 0.0, 0.0, *turn))
    lying = (np.sin(np.pi / 4), 0.0, 0.0, np.cos(np.pi / 4))  # the cylinder's axis along y
    body = builder.add_rigid(shape, density=1000.0, pose=(*(lift * normal), *lying))
    builder.add_contact(body, plane, mu=0.5)
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.002)
    run(sim, 250)
    np.testing.assert_allclose(sim.body_twist[0, body, :3].norm() / 0.5, share * G * np.sin(angle), rtol=5e-3)
    np.testing.assert_allclose(sim.body_twist[0, body, 4] * 0.05, sim.body_twist[0, body, :3].norm(), rtol=5e-3)


def test_bowling_ball():
    """Slides, then rolls from 2 v / (7 mu g) on with 5 v / 7 (7.4)."""
    builder = sw.ModelBuilder()
    floor = builder.add_rigid(sw.Plane(), kinematic=True)
    ball = builder.add_rigid(sw.Sphere(0.1), mass=5.0, pose=(0.0, 0.0, 0.1), velocity=(3.0, 0, 0, 0, 0, 0))
    builder.add_contact(ball, floor, mu=0.25)
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.001)
    run(sim, 340)
    assert sim.body_twist[0, ball, 4] * 0.1 < 0.98 * sim.body_twist[0, ball, 0]
    run(sim, 20)
    np.testing.assert_allclose(sim.body_twist[0, ball, 0], 2.142857, rtol=2e-3)
    np.testing.assert_allclose(sim.body_twist[0, ball, 4] * 0.1, 2.142857, rtol=2e-3)


def test_decelerating_slide_and_belt():
    """v^2 / (2 mu g) on the flat (7.2); a block dropped on a belt slips for v / (mu g) (7.3)."""
    builder = sw.ModelBuilder()
    floor = builder.add_rigid(sw.Plane(), kinematic=True)
    block = builder.add_rigid(sw.Box((0.1, 0.1, 0.05)), mass=1.0, pose=(0.0, 0.0, 0.025), velocity=(2.0, 0, 0, 0, 0, 0))
    belt = builder.add_rigid(sw.Box((10.0, 0.4, 0.1)), kinematic=True, pose=(0.0, 2.0, -0.05))
    rider = builder.add_rigid(sw.Box((0.1, 0.1, 0.05)), mass=1.0, pose=(0.0, 2.0, 0.025))
    builder.add_contact(block, floor, mu=0.4)
    builder.add_contact(rider, belt, mu=0.35)
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.001)
    sim.control.body_velocity[:, belt, 0] = 0.8
    run(sim, 225)
    assert sim.body_twist[0, rider, 0] < 0.79
    run(sim, 475)
    np.testing.assert_allclose(sim.body_pose[0, block, 0], 2.0**2 / (2 * 0.4 * G), rtol=5e-3)
    np.testing.assert_allclose(sim.body_twist[0, rider, 0], 0.8, rtol=1e-6)
    np.testing.assert_allclose(sim.body_pose[0, rider, 0], 0.0931994 + 0.8 * (0.7 - 0.232998), rtol=5e-3)


@pytest.mark.parametrize("restitution", [0.0, 0.5, 0.8])
def test_restitution(restitution):
    """A ball rises to e^2 of its height (7.7), to first order in the step; with e = 0 it stays down."""
    builder = sw.ModelBuilder()
    floor = builder.add_rigid(sw.Plane(), kinematic=True)
    ball = builder.add_rigid(sw.Sphere(0.05), mass=1.0, pose=(0.0, 0.0, 1.05))
    builder.add_contact(ball, floor, restitution=restitution)
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.001)
    run(sim, 440)
    assert sim.body_twist[0, ball, 2] < -4.0
    heights = []
    for _ in range(600):
        run(sim, 1)
        if sim.body_twist[0, ball, 2] > -1e-3:  # from the first impact on
            heights.append(sim.body_pose[0, ball, 2].item() - 0.05)
    np.testing.assert_allclose(max(heights), restitution**2, atol=1e-2 if restitution else 1e-4)


@pytest.mark.parametrize("precision", [pytest.param("float64", marks=pytest.mark.slow), "float32"])
def test_stack_of_ten(precision):
    """Ten boxes for 10 s: penetration below 1e-4 and drift below 1e-3 of their size; the floor carries all (7.8)."""
    builder = sw.ModelBuilder()
    below = floor = builder.add_rigid(sw.Plane(), kinematic=True)
    boxes = []
    for i in range(10):
        boxes.append(builder.add_rigid(sw.Box((0.1, 0.1, 0.1)), mass=1.0, pose=(0.0, 0.0, 0.05 + 0.1 * i)))
        builder.add_contact(boxes[-1], below, mu=0.5)
        below = boxes[-1]
    sim = sw.Simulation(builder.finalize(precision=precision), dt=0.01)
    run(sim, 1000)
    heights = np.append(-0.05, sim.body_pose[0, 1:, 2].double().numpy())
    assert (np.diff(heights) > 0.1 - 1e-5).all()
    assert sim.body_pose[0, 1:, :2].abs().max() < 1e-4
    np.testing.assert_allclose(sim.contact_force(boxes[0], floor)[0, 2], 10 * G, rtol=2e-3)


def soft_cube(
    builder: sw.ModelBuilder, cells: int, youngs: float, place=(0.0, 0.0, 0.0), size=0.1
) -> sw.scene.SoftBody:
    mesh = meshing.box((size,) * 3, (cells,) * 3)
    moved = meshing.TetMesh(mesh.nodes + np.asarray(place), mesh.tets, "cube")
    return builder.add_tets(moved, material=sw.NeoHookean(youngs, 0.3), density=1000.0)


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_soft_block_on_a_frictionless_plane(precision):
    """Mean sag of the top -8.78546 mm on the (4,4,4) mesh, all nodal forces compressive, 9.81 N in all (7.12)."""
    builder = sw.ModelBuilder()
    cube = soft_cube(builder, 4, 5e3)
    floor = builder.add_rigid(sw.Plane(), kinematic=True)
    builder.add_contact(cube, floor)
    sim = sw.Simulation(builder.finalize(precision=precision), dt=0.1, newton_iterations=20)
    rest = sim.model.node_rest
    for _ in range(150):
        sim.step()
    top = rest[:, 2] > 0.0999
    np.testing.assert_allclose((sim.node_x[0].double().numpy() - rest)[top, 2].mean(), -8.78546e-3, rtol=1e-4)
    np.testing.assert_allclose(sim.contact_force(cube, floor)[0], [0.0, 0.0, 9.81], atol=1e-3)
    load = sim.contact_load[0, : sim.contact_count.item(), 2].double().numpy()
    np.testing.assert_allclose([load.min(), load.max()], [0.0806, 0.6635], rtol=5e-3)


@pytest.mark.parametrize(
    ("precision", "tolerance"), [pytest.param("float64", 1e-12, marks=pytest.mark.slow), ("float32", 1e-6)]
)
def test_soft_cubes_collide_freely(precision, tolerance):
    """Momentum is conserved where two soft cubes meet without friction, and contact forces cancel (7.11)."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    left = soft_cube(builder, 2, 2e4, (0.0, 0.0, 0.0))
    right = soft_cube(builder, 2, 2e4, (0.12, 0.013, 0.021))
    builder.add_contact(left, right)
    sim = sw.Simulation(builder.finalize(precision=precision), dt=0.005)
    sim.node_v[:, :27, 0], sim.node_v[:, 27:, 0] = 0.5, -0.3
    before, _ = sim.momentum()
    before, energy, touched = before.clone(), sim.energy(), False
    for _ in range(60):
        sim.step()
        touched = touched or sim.contact_force(left, right).norm() > 0.1
        assert (sim.energy() <= energy * (1.0 + 1e-5)).all()
        energy = sim.energy()
    assert touched
    np.testing.assert_allclose(sim.momentum()[0], before, atol=tolerance)
    assert sim.node_v[0, :27, 0].mean() < 0.1 < 0.3 + sim.node_v[0, 27:, 0].mean()


def test_fast_ball_does_not_tunnel():
    """Three radii per step against a thin wall (7.5)."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    wall = builder.add_rigid(sw.Box((0.01, 1.0, 1.0)), kinematic=True)
    ball = builder.add_rigid(sw.Sphere(0.02), mass=0.1, pose=(-0.5, 0.0, 0.0), velocity=(6.0, 1.0, 0, 0, 0, 0))
    builder.add_contact(ball, wall, mu=0.2)
    sim = sw.Simulation(builder.finalize(9), dt=0.01)
    run(sim, 30)
    assert (sim.body_pose[:, ball, 0] < -0.0249).all()


@pytest.mark.slow
def test_passive_pile_never_gains_energy():
    """Boxes, balls, a rod and a soft cube fall on each other: the total energy only falls."""
    builder = sw.ModelBuilder()
    floor = builder.add_rigid(sw.Plane(), kinematic=True)
    parts = [builder.add_rigid(sw.Box((0.1, 0.08, 0.06)), mass=0.5, pose=(0.0, 0.0, 0.2))]
    parts.append(builder.add_rigid(sw.Sphere(0.05), mass=0.5, pose=(0.03, 0.02, 0.35)))
    parts.append(soft_cube(builder, 2, 5e4, (-0.05, -0.05, 0.45)))
    points = np.linspace((-0.2, 0.0, 0.65), (0.2, 0.0, 0.65), 9)
    parts.append(builder.add_rod(points, radius=0.01, youngs=1e6, density=1000.0))
    for i, part in enumerate(parts):
        builder.add_contact(part, floor, mu=0.5)
        for other in parts[:i]:
            builder.add_contact(part, other, mu=0.5)
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.002)
    energy = start = sim.energy().item()
    for _ in range(400):
        sim.step()
        assert sim.energy().item() <= energy + 1e-4 * start
        energy = sim.energy().item()
    assert energy < 0.5 * start
    assert (sim.status == 0).all()
