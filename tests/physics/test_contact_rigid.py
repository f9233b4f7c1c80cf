"""Rigid bodies in contact: Signorini's and Coulomb's laws, rolling, bouncing, stacks (catalogue 7.1 to 7.8, 7.13)."""

import itertools
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import shapes
from tests import contact_cases as cases
from tests.cases import in_float64, quick
from tests.contact_cases import LYING, UPRIGHT, G, array, contacts, on_slope, pair, run, slope

BRICK = sw.Box((0.2, 0.2, 0.1))
both = pytest.mark.parametrize("precision", ["float64", "float32"])


def turn_gravity(sim: sw.Simulation, angles: np.ndarray, azimuth: Any = 0.0) -> None:
    """Gravity as on slopes of some angles, one per world, that fall towards an azimuth."""
    c, s = np.cos(azimuth) * np.ones_like(angles), np.sin(azimuth) * np.ones_like(angles)
    values = G * np.stack([np.sin(angles) * c, np.sin(angles) * s, -np.cos(angles)], axis=1)
    sim.params.gravity.copy_(torch.as_tensor(values).reshape(sim.params.gravity.shape))


def speed(sim: sw.Simulation, body: int, world: int = 0) -> float:
    return float(sim.body_twist[world, body, :3].norm())


def solid_box(half_width: float, height: float) -> shapes.Mesh:
    """A square block as a triangle mesh, its bottom at z = 0."""
    vertices, triangles = sw.Box((2 * half_width, 2 * half_width, height)).surface()
    return sw.RigidMesh(vertices + [0.0, 0.0, height / 2], triangles)


# Slopes and belts (7.1 to 7.3)


@pytest.mark.parametrize(("precision", "worlds"), [("float64", 1), ("float32", 1), ("float32", 9)])
def test_what_sticks_does_not_creep(precision: str, worlds: int) -> None:
    """tan 20 = 0.36 < mu = 0.5: no motion in 10 s (7.1), in a world alone and in worlds side by side."""
    sim, body, _ = on_slope(BRICK, np.radians(20), 0.5, 0.05, precision=precision, worlds=worlds)
    start = array(sim.body_pose[:, body])
    run(sim, 1000)
    assert np.linalg.norm(array(sim.body_pose[:, body]) - start, axis=1).max() < 1e-6


@in_float64("degrees, mu, expected", [(30, 0.5, 0.657145), (35, 0.6, 0.805256), (30, 0.0, 4.905)])
def test_slide(degrees: float, mu: float, expected: float, precision: str) -> None:
    """g (sin - mu cos); backward Euler has the exact speed under a constant force (7.1)."""
    sim, body, _ = on_slope(BRICK, np.radians(degrees), mu, 0.05, precision=precision)
    run(sim, 100)
    assert speed(sim, body) == pytest.approx(expected, rel=5e-6 if precision == "float64" else 1e-4)


@in_float64("mu", [0.1, 0.5, 0.9], single=1)
def test_threshold_of_sliding(mu: float, precision: str) -> None:
    """41 worlds on slopes around each other narrow it down twice: arctan mu within 0.5 % (7.1); it is 0.02 %."""
    sim, body, _ = pair(sw.Plane(), BRICK, (0.0, 0.0, 0.05), mu=mu, precision=precision, worlds=41)
    low, high = 0.0, np.radians(80)
    for _ in range(3):
        angles = np.linspace(low, high, sim.num_worlds)
        sim.reset()
        turn_gravity(sim, angles)
        run(sim, 80)
        first = int(np.argmax(array(sim.body_twist[:, body, 0]) > 1e-4))
        assert (array(sim.body_twist[first:, body, 0]) > 1e-4).all()
        low, high = angles[first - 1], angles[first]
    assert low == pytest.approx(np.arctan(mu), rel=5e-4)
    assert high == pytest.approx(np.arctan(mu), rel=5e-4)


def test_threshold_on_a_plane_that_is_tilted() -> None:
    """Bisection with the plane's own pose instead of gravity's, towards an odd azimuth."""
    mu, low, high = 0.4, 0.2, 0.6
    for _ in range(9):
        middle = 0.5 * (low + high)
        sim, body, _ = on_slope(BRICK, middle, mu, 0.05, azimuth=0.7)
        run(sim, 60)
        low, high = (low, middle) if speed(sim, body) > 1e-4 else (middle, high)
    assert middle == pytest.approx(np.arctan(mu), rel=5e-3)


@pytest.mark.parametrize(
    ("ratio", "tips"), [(0.5, True), pytest.param(0.58, True, marks=pytest.mark.slow), (0.62, False), (0.7, False)]
)
def test_block_tips_before_it_slides(ratio: float, tips: bool) -> None:
    """On a slope a block of width b and height h tips at arctan b/h and slides at arctan mu = arctan 0.6 (7.1)."""
    mu, height = 0.6, 0.2
    block = sw.Box((ratio * height, ratio * height, height))
    sim, body, _ = pair(sw.Plane(), block, (0.0, 0.0, height / 2), mu=mu, worlds=41)
    critical = np.arctan(min(ratio, mu))
    angles = critical + np.linspace(-0.02, 0.02, 41)
    turn_gravity(sim, angles)
    run(sim, 150)
    tilt = np.abs(array(sim.body_pose[:, body, 4]))
    moved = np.abs(array(sim.body_pose[:, body, 0])) + tilt > 3e-3
    first = int(np.argmax(moved))
    assert angles[first] == pytest.approx(critical, abs=0.002)
    assert (tilt[first] > 0.02) == tips


@both
def test_friction_cone_is_round(precision: str) -> None:
    """The acceleration on a 30 degree slope does not depend on its azimuth (7.6); a pyramid would differ by 41 %."""
    azimuths = np.radians(np.arange(0.0, 91.0, 7.5))
    sim, body, _ = pair(sw.Plane(), BRICK, (0.0, 0.0, 0.05), mu=0.5, precision=precision, worlds=len(azimuths))
    turn_gravity(sim, np.full(len(azimuths), np.radians(30)), azimuths)
    run(sim, 100)
    v = array(sim.body_twist[:, body])
    along = v[:, 0] * np.cos(azimuths) + v[:, 1] * np.sin(azimuths)
    np.testing.assert_allclose(along, 0.657145, rtol=1e-4)
    np.testing.assert_allclose(v[:, 0] * np.sin(azimuths) - v[:, 1] * np.cos(azimuths), 0.0, atol=2e-4)


@in_float64("dt", [0.01, 0.001])
def test_decelerating_slide(dt: float, precision: str) -> None:
    """v0^2 / (2 mu g) in v0 / (mu g), first order in the step (7.2)."""
    v0, mu = 2.0, 0.3
    options, rigid = {"dt": dt}, {"velocity": (v0, 0, 0, 0, 0, 0)}
    sim, body, _ = pair(sw.Plane(), BRICK, (0.0, 0.0, 0.05), mu=mu, precision=precision, options=options, rigid=rigid)
    steps = 0
    while speed(sim, body) > 1e-4:
        run(sim, 1)
        steps += 1
    assert steps * dt == pytest.approx(v0 / (mu * G), abs=1.5 * dt)
    assert float(sim.body_pose[0, body, 0]) == pytest.approx(v0**2 / (2 * mu * G), abs=0.6 * v0 * dt)


@in_float64("belt", ["plane", "box", "mesh"], single=2)
def test_belt(belt: str, precision: str) -> None:
    """A block put down on a belt slips for v / (mu g) and is then v^2 / (2 mu g) behind: 0.233 s, 93.2 mm (7.3)."""
    v, mu, dt = 0.8, 0.35, 0.002
    thick = sw.Box((4.0, 1.0, 0.2))
    target = {"plane": sw.Plane(), "box": thick, "mesh": sw.RigidMesh(*thick.surface())}[belt]
    options, pose = {"dt": dt}, (0.0, 0.0, 0.0 if belt == "plane" else -0.1)
    sim, body, ground = pair(
        target, BRICK, (0.0, 0.0, 0.05), target_pose=pose, mu=mu, precision=precision, options=options
    )
    sim.control.body_velocity[:, ground, 0] = v
    steps = 0
    while speed(sim, body) < v - 1e-4:
        run(sim, 1)
        steps += 1
    assert steps * dt == pytest.approx(0.232998, abs=1.5 * dt)
    assert float(sim.body_pose[0, body, 0]) == pytest.approx(0.0931994, abs=1.1 * v * dt)
    run(sim, 100)
    assert speed(sim, body) == pytest.approx(v, rel=1e-5)
    assert np.abs(array(sim.contact_force(body, ground))[0, :2]).max() < 1e-3 * G * 4.0


# Rolling (7.4, 7.5)


ROUND = {
    "sphere": (sw.Sphere(0.05), None, UPRIGHT, 5 / 7),
    "cylinder": (sw.Cylinder(0.05, 0.1), None, LYING, 2 / 3),
    "hollow sphere": (sw.Sphere(0.05), 2 / 3, UPRIGHT, 3 / 5),
    "hoop": (sw.Cylinder(0.05, 0.02), 1.0, LYING, 1 / 2),
}


@in_float64("name", ROUND)
def test_rolling_down_a_slope(name: str, precision: str) -> None:
    """a = g sin theta / (1 + I / (m r^2)) at 15 degrees, without slip (7.4)."""
    shape, factor, attitude, share = ROUND[name]
    angle, r = np.radians(15), 0.05
    turn, normal = slope(angle)
    rigid = {} if factor is None else {"density": None, "mass": 1.0, "inertia": (factor * r * r,) * 3}
    pose = (*(r * normal), *attitude)
    sim, body, _ = pair(sw.Plane(), shape, pose, target_pose=(0, 0, 0, *turn), mu=0.5, precision=precision, rigid=rigid)
    run(sim, 50)
    tolerance = 1e-5 if precision == "float64" else 2e-4
    assert speed(sim, body) == pytest.approx(0.5 * share * G * np.sin(angle), rel=tolerance)
    assert speed(sim, body) == pytest.approx(r * float(sim.body_twist[0, body, 3:].norm()), rel=tolerance)
    assert float(array(sim.body_pose[0, body, :3]) @ normal) == pytest.approx(r, abs=1e-6 * r)


def test_rolling_needs_friction() -> None:
    """Below mu = (2/7) tan theta a sphere slides with g (sin - mu cos) and spins up with 5 mu g cos / (2 r) (7.4)."""
    angle, r = np.radians(15), 0.05
    least = 2 / 7 * np.tan(angle)
    assert least == pytest.approx(0.0765569, rel=1e-6)
    for mu in (0.05, 0.98 * least, 1.02 * least):
        sim, body, _ = on_slope(sw.Sphere(r), angle, mu, r)
        run(sim, 50)
        v, w = speed(sim, body) / 0.5, float(sim.body_twist[0, body, 3:].norm()) / 0.5
        if mu > least:
            assert (v, r * w) == pytest.approx((1.813582,) * 2, rel=1e-6)
        else:
            assert v == pytest.approx(G * (np.sin(angle) - mu * np.cos(angle)), rel=1e-6)
            assert w == pytest.approx(5 * mu * G * np.cos(angle) / (2 * r), rel=1e-6)


@both
def test_bowling_ball(precision: str) -> None:
    """v0 = 3 without spin, mu = 0.25: rolls from 0.349498 s on, after 0.898708 m, with 5 v0 / 7, for good (7.4)."""
    dt = 0.002
    options, rigid = {"dt": dt}, {"velocity": (3.0, 0, 0, 0, 0, 0)}
    sim, body, _ = pair(
        sw.Plane(), sw.Sphere(0.1), (0, 0, 0.1), mu=0.25, precision=precision, options=options, rigid=rigid
    )
    steps = 0
    while float(sim.body_twist[0, body, 0] - 0.1 * sim.body_twist[0, body, 4]) > 1e-4:
        run(sim, 1)
        steps += 1
    assert steps * dt == pytest.approx(0.349498, abs=1.5 * dt)
    assert float(sim.body_pose[0, body, 0]) == pytest.approx(0.898708, abs=0.6 * 3.0 * dt)
    run(sim, 500)
    assert speed(sim, body) == pytest.approx(15 / 7, rel=1e-6 if precision == "float64" else 2e-5)


def maze(angles: tuple[float, float], start: tuple[float, float], wall_mu: float = 0.0, speed: Any = (0, 0, 0)) -> Any:
    """A ball of 2 cm on a plate of 40 cm with walls, tilted about x, then y: simulation, ball, walls, plate, axes."""
    (a, b), r, half, thick = angles, 0.02, 0.2, 0.02
    first, second = (np.sin(a / 2), 0, 0, np.cos(a / 2)), (0, np.sin(b / 2), 0, np.cos(b / 2))
    axes = cases.turned(second, cases.turned(first, np.eye(3)))
    q = np.array([np.sin(a / 2) * np.cos(b / 2), np.cos(a / 2) * np.sin(b / 2), -np.sin(a / 2) * np.sin(b / 2)])
    turn = (*q, np.cos(a / 2) * np.cos(b / 2))
    builder = sw.ModelBuilder()
    plate = builder.add_rigid(
        sw.Box((2 * half + 2 * thick,) * 2 + (0.05,)), kinematic=True, pose=(*(-0.025 * axes[2]), *turn)
    )
    ball = builder.add_rigid(
        sw.Sphere(r),
        density=1000,
        pose=tuple(np.array([*start, r]) @ axes),
        velocity=(*(np.array(speed) @ axes), 0, 0, 0),
    )
    builder.add_contact(ball, plate, mu=0.5)
    walls = []
    for axis in (0, 1):
        for side in (-1, 1):
            size, centre = [2 * half + 2 * thick] * 2 + [0.06], np.array([0.0, 0.0, 0.03])
            size[axis], centre[axis] = thick, side * (half + thick / 2)
            walls.append(builder.add_rigid(sw.Box(tuple(size)), kinematic=True, pose=(*(centre @ axes), *turn)))
            builder.add_contact(ball, walls[-1], mu=wall_mu)
    return sw.Simulation(builder.finalize(1, precision="float64"), dt=0.01), ball, walls, plate, axes


def test_ball_on_a_tilted_plate() -> None:
    """Acceleration 5/7 of g's component in the plate, in both directions (7.5)."""
    sim, ball, _, _, axes = maze((0.03, 0.05), (0.0, 0.0))
    run(sim, 30)
    np.testing.assert_array_less(np.abs(axes @ axes.T - np.eye(3)), 1e-12)
    expected = 5 / 7 * axes @ np.array([0.0, 0.0, -G])
    v = axes @ array(sim.body_twist[0, ball, :3]) / 0.3
    np.testing.assert_allclose(v[:2], expected[:2], rtol=1e-9)
    assert expected[1] == pytest.approx(-5 / 7 * G * np.sin(0.03), rel=2e-3)
    assert abs(v[2]) < 1e-12


@pytest.mark.parametrize(("wall_mu", "share"), [(0.0, 5 / 7), (0.3, None)])
def test_ball_along_a_wall(wall_mu: float, share: float | None) -> None:
    """A wall carries m g sin alpha; the ball rolls along it with 5/7, with friction at the wall it is slower (7.5)."""
    sim, ball, walls, _, axes = maze((0.05, 0.05), (0.0, -0.18), wall_mu)
    run(sim, 30)
    down, mass = axes @ np.array([0.0, 0.0, -G]), 4 / 3 * np.pi * 0.02**3 * 1000
    v = axes @ array(sim.body_twist[0, ball, :3]) / 0.3
    push = axes @ array(sim.contact_force(ball, walls[2]))[0]
    assert abs(v[1]) < 1e-9
    if share:
        assert v[0] == pytest.approx(share * down[0], rel=1e-9)
        assert push[1] == pytest.approx(-mass * down[1], rel=2e-3)
    else:
        assert v[0] < 0.9 * 5 / 7 * down[0]


def test_ball_rests_in_a_corner() -> None:
    """It comes to lie against two walls and stays there to the bit (7.5)."""
    sim, ball, walls, plate, axes = maze((0.03, 0.05), (0.05, -0.03))
    run(sim, 2000)
    place = array(sim.body_pose[0, ball])
    np.testing.assert_allclose(axes @ place[:3], (0.18, -0.18, 0.02), atol=1e-9)
    run(sim, 500)
    np.testing.assert_allclose(array(sim.body_pose[0, ball]), place, atol=1e-12)
    mass = 4 / 3 * np.pi * 0.02**3 * 1000
    total = sum(array(sim.contact_force(ball, part))[0] for part in (plate, *walls))
    np.testing.assert_allclose(total, (0.0, 0.0, mass * G), atol=1e-9 * G)


def thin(name: str) -> Any:
    flat = sw.Box((0.3, 0.3, 0.005))
    return {
        "plane": sw.Plane(),
        "box": flat,
        "sphere": sw.Sphere(0.03),
        "capsule": sw.Capsule(0.01, 0.2),
        "cylinder": sw.Cylinder(0.1, 0.005),
        "mesh": sw.RigidMesh(*flat.surface()),
        "grid": partial(cases.grid, (0.3, 0.3, 0.05), 0.01),
    }[name]


@pytest.mark.parametrize(
    ("name", "precision"),
    quick(
        itertools.product(("plane", "box", "sphere", "capsule", "cylinder", "mesh", "grid"), ("float64", "float32")),
        lambda name, precision: precision == "float32" or name == "box",
    ),
)
def test_fast_ball_does_not_tunnel(name: str, precision: str) -> None:
    """v dt = 3 radii against targets as thin as an eighth of the ball, from many phases of the step (7.5)."""
    r, v, dt, worlds = 0.02, 6.0, 0.01, 16
    target = cases.made(thin(name))
    direction = np.array([0.0, 0.0, -1.0])
    if name in ("plane", "box", "mesh"):
        direction = np.array([0.3, 0.2, -1.0]) / np.linalg.norm([0.3, 0.2, -1.0])
    rigid = {"velocity": (*(v * direction), 0, 0, 0)}
    sim, body, _ = pair(
        target, sw.Sphere(r), (0, 0, 0.4), gravity=(0, 0, 0), precision=precision, worlds=worlds, rigid=rigid
    )
    sim.body_pose[:, body, :3] += (
        torch.linspace(0.0, v * dt, worlds, dtype=torch.float64)[:, None] * torch.as_tensor(direction)
    ).to(sim.body_pose.dtype)
    sim.body_pose[:, body, :2] += torch.as_tensor(0.4 * direction[:2] / direction[2]).to(sim.body_pose.dtype)
    path = []
    for _ in range(40):
        run(sim, 1)
        path.append(array(sim.body_pose[:, body, :3]))
    gaps = shapes.distances(target, np.array([0, 0, 0, *UPRIGHT], dtype=float), np.concatenate(path)) - r
    assert gaps.min() > (-1e-9 if precision == "float64" else -1e-7)
    assert gaps.min() < 1e-6  # it has arrived


@both
@pytest.mark.parametrize("dt", [0.01, pytest.param(0.002, marks=pytest.mark.slow)])
def test_tumbling_cubes_do_not_tunnel(dt: float, precision: str) -> None:
    """Cubes thrown at a thin plate, up to 2 sizes per step and 60 rad/s, stay on their side of it."""
    size, worlds, generator = 0.05, 16, np.random.default_rng(1)
    sim, body, _ = pair(
        sw.Box((20.0, 20.0, 0.01)),
        sw.Box((size,) * 3),
        (0, 0, 0.3),
        mu=0.3,
        precision=precision,
        worlds=worlds,
        options={"dt": dt},
    )
    twist = np.concatenate([generator.uniform(-3, 3, (worlds, 2)), generator.uniform(-10, -5, (worlds, 1))], axis=1)
    twist = np.concatenate([twist, generator.uniform(-35, 35, (worlds, 3))], axis=1)
    sim.body_twist[:, body] = torch.as_tensor(twist).to(sim.body_twist.dtype)
    corners, lowest = sw.Box((size,) * 3).surface()[0], np.inf
    for _ in range(int(0.3 / dt)):
        run(sim, 1)
        for pose in array(sim.body_pose[:, body]):
            lowest = min(lowest, float((cases.turned(tuple(pose[3:]), corners)[:, 2] + pose[2]).min()))
    assert lowest > 0.005 - 0.2 * size
    run(sim, int(1.5 / dt))
    height = array(sim.body_pose[:, body, 2])
    assert height.min() > 0.005 + 0.499 * size


# Laws (7.6, 7.7)


RESTING = {
    "box": (sw.Box((0.1,) * 3), 0.05, UPRIGHT),
    "sphere": (sw.Sphere(0.05), 0.05, UPRIGHT),
    "cylinder": (sw.Cylinder(0.05, 0.1), 0.05, UPRIGHT),
    "lying cylinder": (sw.Cylinder(0.05, 0.1), 0.05, LYING),
    "lying capsule": (sw.Capsule(0.03, 0.1), 0.03, LYING),
    "mesh": (solid_box(0.05, 0.1), 0.0, UPRIGHT),
    "grid": (partial(cases.grid, (0.1,) * 3, 0.005), 0.05, UPRIGHT),
    "compound": (
        sw.Compound([(sw.Box((0.1, 0.1, 0.05)), (0, 0, 0.025)), (sw.Sphere(0.03), (0, 0, 0.07))]),
        0.0,
        UPRIGHT,
    ),
}
GROUNDS = {
    "plane": (sw.Plane(), 0.0),
    "box": (sw.Box((0.4, 0.4, 0.1)), 0.05),
    "mesh": (sw.RigidMesh(*sw.Box((0.4, 0.4, 0.1)).surface()), 0.05),
    "grid": (partial(cases.grid, (0.4, 0.4, 0.1), 0.01), 0.05),
    "cylinder": (sw.Cylinder(0.2, 0.1), 0.05),
}


@pytest.mark.parametrize(
    ("name", "ground", "precision"),
    quick(
        itertools.product(RESTING, GROUNDS, ("float64", "float32")),
        lambda name, ground, precision: precision == "float64" or ground == "plane",
    ),
)
def test_rest(name: str, ground: str, precision: str) -> None:
    """After a drop of 1 cm: gap 0 to 1e-6 of the size, sum of normal forces m g, lambda >= 0, lambda gap = 0 (7.6)."""
    (shape, lift, attitude), (target, top) = RESTING[name], GROUNDS[ground]
    shape, target = cases.made(shape), cases.made(target)
    pose = (0.003, 0.002, top + lift + 0.01, *attitude)
    sim, body, other = pair(target, shape, pose, mu=0.5, precision=precision)
    run(sim, 200)
    weight = shape.inertia(density=1000.0).mass * G
    seen = contacts(sim)
    normal = np.einsum("ij,ij->i", seen["load"], seen["normal"])
    assert (normal >= 0.0).all()
    assert abs(float(sim.body_pose[0, body, 2]) - top - lift) < 1e-7
    assert np.abs(seen["gap"]).min() < 1e-7
    assert np.abs(normal * np.maximum(seen["gap"], 0.0)).max() < 1e-8 * weight
    tolerance = 1e-6 if precision == "float64" else 5e-6
    np.testing.assert_allclose(array(sim.contact_force(body, other))[0], (0, 0, weight), atol=tolerance * weight)
    np.testing.assert_allclose(array(sim.contact_force(other, body))[0], (0, 0, -weight), atol=tolerance * weight)
    assert np.abs(array(sim.body_twist[0, body])).max() < 5e-5


def test_cone_and_dissipation() -> None:
    """Bodies thrown about: forces inside the cone to 1e-6, against the slip within 1 degree where they slip (7.6)."""
    generator, mu, slipping = np.random.default_rng(0), 0.4, 0
    for shape in (sw.Box((0.1, 0.06, 0.08)), sw.Cylinder(0.04, 0.1), sw.Capsule(0.03, 0.08), sw.Sphere(0.05)):
        sim, body, _ = pair(sw.Plane(), shape, (0, 0, 0.1), mu=mu, options={"dt": 0.0004})
        sim.body_twist[0, body] = torch.as_tensor(generator.uniform(-3, 3, 6) + [3, 2, 0, 0, 0, 0])
        for _ in range(800):
            before = array(sim.body_pose[0, body, :3])
            run(sim, 1)
            seen, twist = contacts(sim), array(sim.body_twist[0, body])
            for n, f, p in zip(seen["normal"], seen["load"], seen["point"], strict=True):
                normal = float(f @ n)
                tangent = f - normal * n
                assert normal >= 0.0
                assert np.linalg.norm(tangent) <= mu * normal * (1 + 1e-6) + 1e-12
                v = twist[:3] + np.cross(twist[3:], p - before)
                slip = v - (v @ n) * n
                if normal > 1e-3 and np.linalg.norm(slip) > 0.3:
                    slipping += 1
                    assert np.linalg.norm(tangent) == pytest.approx(mu * normal, rel=1e-6)
                    assert -tangent @ slip / np.linalg.norm(tangent) / np.linalg.norm(slip) > np.cos(np.radians(1.0))
    assert slipping > 200


@in_float64("e", [0.0, 0.5, 0.9], single=1)
def test_restitution(e: float, precision: str) -> None:
    """Heights e^2n h0, total time sqrt(2 h0 / g) (1 + e) / (1 - e); e = 0 does not rebound by 1e-4 h0 (7.7)."""
    h0, dt = 0.5, 0.001
    sim, body, _ = pair(
        sw.Plane(), sw.Sphere(0.05), (0, 0, 0.05 + h0), restitution=e, precision=precision, options={"dt": dt}
    )
    fall = np.sqrt(2 * h0 / G)
    steps = int({0.0: 1.0, 0.5: 1.2, 0.9: 2.2}[e] / dt)
    heights = []
    for _ in range(steps):
        run(sim, 1)
        heights.append(float(sim.body_pose[0, body, 2]) - 0.05)
    z = np.array(heights)
    assert z.min() > -1e-7
    if e == 0.0:
        assert z[int(fall / dt) + 2 :].max() < 1e-4 * h0
        return
    peaks = z[1:-1][(z[1:-1] > z[:-2]) & (z[1:-1] >= z[2:]) & (z[1:-1] > 1e-3)] / h0
    np.testing.assert_allclose(peaks[:3], e ** (2 * np.arange(1, 4)), atol=5 * dt)
    if e == 0.5:
        moving = np.flatnonzero(z > 1e-3 * h0)[-1] * dt
        assert moving == pytest.approx(fall * (1 + e) / (1 - e), rel=0.05)


@pytest.mark.parametrize(("bounce_speed", "after"), [(0.05, 0.05), (0.2, 0.0)])
def test_slow_approaches_do_not_bounce(bounce_speed: float, after: float) -> None:
    """A ball that comes at 0.1 m/s leaves with half of it, e = 0.5, unless that is below ``bounce_speed``."""
    sim, body, _ = pair(
        sw.Plane(),
        sw.Sphere(0.05),
        (0, 0, 0.055),
        gravity=(0.0, 0.0, 0.0),
        rigid={"velocity": (0, 0, -0.1, 0, 0, 0)},
        options={"bounce_speed": bounce_speed},
        restitution=0.5,
    )
    run(sim, 20)
    assert float(sim.body_twist[0, body, 2]) == pytest.approx(after, abs=1e-9)


def test_restitution_of_two_free_bodies() -> None:
    """Equal spheres exchange e of their relative speed: v = (1 -+ e) v0 / 2, momentum to rounding."""
    for e in (0.0, 0.6, 1.0):
        builder = sw.ModelBuilder(gravity=(0, 0, 0))
        a = builder.add_rigid(sw.Sphere(0.05), density=1000, pose=(0, 0, 0), velocity=(1, 0, 0, 0, 0, 0))
        b = builder.add_rigid(sw.Sphere(0.05), density=1000, pose=(0.15, 0, 0))
        builder.add_contact(a, b, restitution=e)
        sim = sw.Simulation(builder.finalize(1, precision="float64"), dt=0.001)
        run(sim, 200)
        v = array(sim.body_twist[0, :, 0])
        np.testing.assert_allclose(v, ((1 - e) / 2, (1 + e) / 2), atol=1e-9)


def test_compliance_is_a_spring() -> None:
    """On a compliant contact a sphere rests m g C below the surface and carries m g (7.6)."""
    compliance = 1e-4
    sim, body, ground = pair(sw.Plane(), sw.Sphere(0.05), (0, 0, 0.05), compliance=compliance)
    run(sim, 300)
    weight = 4 / 3 * np.pi * 0.05**3 * 1000 * G
    assert 0.05 - float(sim.body_pose[0, body, 2]) == pytest.approx(weight * compliance, rel=1e-6)
    assert float(sim.contact_force(body, ground)[0, 2]) == pytest.approx(weight, rel=1e-6)


@both
def test_contact_distance(precision: str) -> None:
    """Surfaces rest at the contact distance; the alarm distance only says from where they are looked at."""
    distance = 0.004
    for alarm in (None, 0.005, 0.03):
        sim, body, _ = pair(
            sw.Plane(),
            sw.Box((0.1,) * 3),
            (0, 0, 0.08),
            contact_distance=distance,
            alarm_distance=alarm,
            precision=precision,
        )
        gaps, seen = [], []
        for _ in range(100):
            run(sim, 1)
            gaps.append(float(sim.body_pose[0, body, 2]) - 0.05)
            seen.append(int(sim.contact_count[0]))
        assert gaps[-1] == pytest.approx(distance, abs=1e-7)
        assert min(gaps) > distance - 1e-7
        first = int(np.argmax(np.array(seen) > 0))
        reach = {None: 0.004 + 0.001, 0.005: 0.005, 0.03: 0.03}[alarm]
        before = 0.03 if first == 0 else gaps[first - 1]
        assert before < reach + 1.5 * 0.01 * np.sqrt(2 * G * 0.03) + 1.5 * G * 1e-4 + 1e-6
        assert before > 0.5 * reach
    with pytest.raises(ValueError, match="alarm_distance"):
        pair(sw.Plane(), sw.Sphere(0.1), (0, 0, 1), contact_distance=0.01, alarm_distance=0.005)
