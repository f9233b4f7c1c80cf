"""Rigid bodies against theory: tops, pendulums, compounds, locked axes, commands.

Numbers are those of the validation catalogue, sections 5 and 6, unless a formula is given.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import ellipk

import softwarp as sw
from softwarp import meshing
from tests import rod_cases as rods
from tests.rigid_cases import spinning, vector

POINT = (1e-12, 1e-12, 1e-12)  # kg m^2, hardly any


def turn(sim: sw.Simulation, body: int = 0) -> Rotation:
    return Rotation.from_quat(sim.body_pose[0, body, 3:].double().numpy())


def spin(sim: sw.Simulation, body: int = 0) -> np.ndarray:
    """Angular velocity in the body's axes [rad/s]."""
    return turn(sim, body).inv().apply(sim.body_twist[0, body, 3:].double().numpy())


# Free motion


DZHANIBEKOV = {
    1.0: (0.892657, 4.920687, -0.512132),
    2.0: (4.484199, -2.214038, -2.588309),
    5.0: (2.204771, -4.488762, 1.271615),
    10.0: (0.921980, -4.915277, -0.529165),
}


@pytest.mark.parametrize(
    ("precision", "dt", "tolerance", "drift"),
    [("float64", 1e-3, 1e-6, 1e-9), ("float64", 1e-2, 3e-4, 1e-7), ("float32", 1e-3, 2e-2, 1e-4)],
)
def test_spin_about_the_middle_axis(precision: str, dt: float, tolerance: float, drift: float) -> None:
    """I = (1, 2, 3), w = (0.1, 5, 0): the body turns over; its angular velocity in its own axes as in 6.1.

    Angular momentum and energy keep their values, and the quaternion its length, over 10 s. The motion passes near an
    unstable spin, which makes fifty of every error between two flips: what float32 can do is 0.1 rad/s.
    """
    inertia = np.array([1.0, 2.0, 3.0])
    sim = spinning(inertia, (0.1, 5.0, 0.0), dt=dt, precision=precision)
    momentum, energy = inertia * spin(sim), 0.5 * inertia @ spin(sim) ** 2
    for time, expected in DZHANIBEKOV.items():
        while float(sim.time[0]) < time - 0.5 * dt:
            sim.step()
        assert spin(sim) == pytest.approx(expected, abs=5.0 * tolerance)
    now = turn(sim).apply(inertia * spin(sim))
    assert np.linalg.norm(now - momentum) < drift * np.linalg.norm(momentum)
    assert 0.5 * inertia @ spin(sim) ** 2 == pytest.approx(energy, rel=drift)
    assert float(sim.body_pose[0, 0, 3:].norm()) == pytest.approx(1.0, abs=1e-6)


def test_spin_turns_over_in_the_period_of_theory() -> None:
    """Flips every 3.670484 s: half of T = 4 K(0.99960016) / rate (6.1)."""
    sim = spinning((1.0, 2.0, 3.0), (0.1, 5.0, 0.0), dt=2e-3)
    times, before = [], 5.0
    for step in range(6000):
        sim.step()
        now = spin(sim)[1]
        if now * before < 0.0:
            times.append(2e-3 * (step + before / (before - now)))
        before = now
    assert np.diff(times) == pytest.approx(np.full(len(times) - 1, 3.670484), abs=2e-4)
    assert len(times) == 3


def test_small_body_turns_like_a_large_one() -> None:
    """A free top's motion depends on ratios of its moments; those of 7e-15 kg m^2 have a product that underflows."""
    tops = []
    for size in (1.0, 2.0**-47):
        sim = spinning([size, 2.0 * size, 3.0 * size], (0.1, 4.0, 0.2), dt=0.01, precision="float32")
        for _ in range(100):
            sim.step()
        tops.append((turn(sim), spin(sim)))
    (one, w), (two, v) = tops
    assert w[0] != pytest.approx(0.1, abs=0.05)
    assert (one.inv() * two).magnitude() < 1e-5
    np.testing.assert_allclose(v, w, rtol=1e-5)


@pytest.mark.parametrize("bound", [False, True], ids=["free", "carrying"])
def test_symmetric_top(bound: bool) -> None:
    """I_1 = I_2: w turns about the axis at (I_3 - I_1) w_3 / I_1 in the body's axes (6.2).

    To 1e-8 for a body alone; a body that carries a soft one (here of hardly any mass) turns to first order in dt.
    """
    inertia, start, dt = np.array([2.0, 2.0, 3.0]), np.array([0.5, 0.0, 4.0]), 1e-3
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    body = builder.add_rigid(mass=1.0, inertia=inertia, velocity=(0.0, 0.0, 0.0, *start))
    if bound:
        mesh = meshing.box((0.1, 0.1, 0.1), (1, 1, 1))
        soft = builder.add_tets(mesh, material=sw.Corotational(1e3, 0.3), density=1e-6)
        builder.attach(soft, box=((-1.0, -1.0, -1.0), (1.0, 1.0, 0.01)), to=body)
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=dt)
    for _ in range(1000):
        sim.step()
    angle = (inertia[2] - inertia[0]) * start[2] / inertia[0]
    expected = [0.5 * np.cos(angle), 0.5 * np.sin(angle), 4.0]
    assert spin(sim) == pytest.approx(expected, abs=5e-3 if bound else 1e-8)


@pytest.mark.parametrize("centre", [(0.0, 0.0, 0.0), (0.3, -0.2, 0.1)])
@pytest.mark.parametrize("iterations", [1, 4])
def test_free_fall(centre: tuple[float, float, float], iterations: int) -> None:
    """The centre of mass of a spinning body is at x_0 + n h v_0 + g h^2 n (n + 1) / 2 exactly: 4.95405 m (5.3)."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    vertices, faces = cube(np.asarray(centre))
    velocity = (0.5, -0.2, 1.0, 1.0, 2.0, -3.0)
    builder.add_rigid(meshing_surface(vertices, faces), density=1000.0, velocity=velocity)
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.01, newton_iterations=iterations)
    start = np.asarray(centre)
    speed = np.array([0.5, -0.2, 1.0]) + np.cross(velocity[3:], start)
    for _ in range(100):
        sim.step()
    position = sim.body_pose[0, 0, :3].numpy() + turn(sim).apply(start)
    assert position == pytest.approx(start + speed - [0.0, 0.0, 4.95405], abs=1e-9)
    now = sim.body_twist[0, 0].numpy()
    assert now[3:] == pytest.approx(velocity[3:], abs=1e-9)  # the weight has no moment about the centre
    velocity_of_centre = now[:3] + np.cross(now[3:], turn(sim).apply(start))
    assert velocity_of_centre == pytest.approx(speed - [0.0, 0.0, 9.81], abs=1e-9)


def cube(centre: np.ndarray, size: float = 0.2) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a cube."""
    mesh = meshing.box((size, size, size), (1, 1, 1))
    return mesh.nodes - 0.5 * size + centre, mesh.surface()


def meshing_surface(vertices: np.ndarray, faces: np.ndarray) -> sw.shapes.Mesh:
    return sw.shapes.Mesh(vertices, faces)


# Compounds


def test_inertia_of_shapes() -> None:
    """A moment tau turns a body by w = h I^-1 tau in the first step; I of a box, a sphere, a rod of parts (6.4)."""
    mass, tau, h = 2.0, np.array([3e-5, -2e-5, 5e-5]), 0.01
    known = {
        sw.Box((0.1, 0.2, 0.3)): mass / 12.0 * np.array([0.2**2 + 0.3**2, 0.1**2 + 0.3**2, 0.1**2 + 0.2**2]),
        sw.Sphere(0.1): np.full(3, 0.4 * mass * 0.1**2),
        sw.Cylinder(0.1, 0.4): mass * np.array([0.0025 + 0.16 / 12.0, 0.0025 + 0.16 / 12.0, 0.005]),
    }
    for shape, inertia in known.items():
        builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        builder.add_rigid(shape, mass=mass)
        sim = sw.Simulation(builder.finalize(precision="float64"), dt=h)
        sim.control.body_force[0, 0] = vector(1.0, 2.0, 3.0, *tau)
        sim.set_initial()
        sim.step()
        assert spin(sim) == pytest.approx(h * tau / inertia, rel=1e-6)
        assert sim.body_twist[0, 0, :3].tolist() == pytest.approx([0.005, 0.01, 0.015])
        sim.reset()
        sim.params.body_mass.mul_(3.0)  # the inertia scales with the mass
        sim.step()
        assert spin(sim) == pytest.approx(h * tau / (3.0 * inertia), rel=1e-6)


SLANT = Rotation.from_rotvec([0.4, 0.7, -0.2])


def dumbbell(kind: str, dt: float, gravity: Sequence[float] = (0.0, 0.0, 0.0)) -> sw.Simulation:
    """Two spheres 0.4 m apart and a slanting box between them, as one body, or as parts on one of the spheres."""
    pose = np.array([0.1, -0.2, 0.3, *Rotation.from_rotvec([0.3, -0.5, 0.8]).as_quat()])
    frame = Rotation.from_quat(pose[3:])
    places = np.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0], [0.2, 0.05, 0.0]])
    shapes = [sw.Sphere(0.05), sw.Sphere(0.08), sw.Box((0.3, 0.02, 0.06))]
    masses = [0.5, 1.2, 0.3]
    slants = [Rotation.identity(), Rotation.identity(), SLANT]
    builder = sw.ModelBuilder(gravity=gravity)
    speed, spin_ = np.array([0.3, 0.1, -0.2]), np.array([2.0, -3.0, 1.0])
    if kind == "one":
        parts = [shape.inertia(mass=mass) for shape, mass in zip(shapes, masses, strict=True)]
        centre = np.average(places, axis=0, weights=masses)
        levers = places - centre
        tensor = sum(
            slant.as_matrix() @ part[2] @ slant.as_matrix().T
            + mass * (lever @ lever * np.eye(3) - np.outer(lever, lever))
            for part, mass, lever, slant in zip(parts, masses, levers, slants, strict=True)
        )
        at = pose.copy()
        at[:3] += frame.apply(centre)
        velocity = (*(speed + np.cross(spin_, frame.apply(centre))), *spin_)
        builder.add_rigid(mass=sum(masses), inertia=tensor, pose=at, velocity=velocity)
    else:
        for i, (shape, mass, place) in enumerate(zip(shapes, masses, places, strict=True)):
            at = np.concatenate([pose[:3] + frame.apply(place), (frame * slants[i]).as_quat()])
            builder.add_rigid(shape, mass=mass, pose=at, velocity=(*speed, *spin_) if i == 0 else (0.0,) * 6)
            if i:
                builder.attach(sw.scene.RigidBody(i), to=sw.scene.RigidBody(0))
    return sw.Simulation(builder.finalize(precision="float64"), dt=dt)


@pytest.mark.parametrize("gravity", [(0.0, 0.0, 0.0), (0.0, 1.0, -9.81)])
def test_compound_equals_one_body(gravity: tuple[float, float, float]) -> None:
    """Attached bodies move as the one body with their mass, centre and inertia, to rounding."""
    one, parts = dumbbell("one", 0.01, gravity), dumbbell("parts", 0.01, gravity)
    centre = np.array([0.4 * 1.2 + 0.2 * 0.3, 0.05 * 0.3, 0.0]) / 2.0
    for _ in range(100):
        one.step()
        parts.step()
    found = parts.body_pose[0, 0, :3].numpy() + turn(parts).apply(centre)
    assert np.abs(found - one.body_pose[0, 0, :3].numpy()).max() < 1e-11
    assert (turn(parts) * turn(one).inv()).magnitude() < 1e-11
    assert np.abs((parts.body_twist[0, 0, 3:] - one.body_twist[0, 0, 3:]).numpy()).max() < 1e-10
    assert (turn(parts, 2) * (turn(parts) * SLANT).inv()).magnitude() < 1e-12
    for body, place in ((1, [0.4, 0.0, 0.0]), (2, [0.2, 0.05, 0.0])):
        lever = turn(parts).apply(place)
        assert parts.body_pose[0, body, :3].numpy() == pytest.approx(parts.body_pose[0, 0, :3].numpy() + lever)
        twist = parts.body_twist[0, 0].numpy()
        assert parts.body_twist[0, body, :3].numpy() == pytest.approx(twist[:3] + np.cross(twist[3:], lever))


def test_moment_of_an_off_centre_force() -> None:
    """A force on a part at the lever r turns the whole by J^-1 (r x f) about the common centre."""
    parts = dumbbell("parts", 0.01)
    one = dumbbell("one", 0.01)
    force = np.array([1.0, -2.0, 0.5])
    parts.control.body_force[0, 1, :3] = vector(*force)
    centre = np.array([0.4 * 1.2 + 0.2 * 0.3, 0.05 * 0.3, 0.0]) / 2.0
    lever = turn(parts).apply(np.array([0.4, 0.0, 0.0]) - centre)
    one.control.body_force[0, 0] = vector(*force, *np.cross(lever, force))
    for sim in (parts, one):
        sim.step()
    assert (parts.body_twist[0, 0, 3:] - one.body_twist[0, 0, 3:]).abs().max() < 1e-12


# Held axes


def test_cart_and_spindle() -> None:
    """``free_axes``: forces along held axes do nothing, those along free ones accelerate by F / m and tau / I."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    tilt = Rotation.from_rotvec([0.4, 0.2, -0.7])
    inertia = np.array([0.2, 0.3, 0.4])
    for axes in ("x", ("rz",), ("y", "rx")):
        builder.add_rigid(mass=2.0, inertia=inertia, free_axes=axes, pose=(0.0, 0.0, 0.0, *tilt.as_quat()))
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.01)
    sim.control.body_force[0, :] = vector(3.0, 1.0, 2.0, 0.1, 0.2, 0.3)
    world = tilt.as_matrix() @ np.diag(inertia) @ tilt.as_matrix().T
    sim.step()
    expected = 0.01 * np.array(
        [
            [1.5, 0.0, 0.0, 0.0, 0.0, 0.0],
            [0.0, 0.0, 0.0, 0.0, 0.0, 0.3 / world[2, 2]],
            [0.0, 0.5, 0.0, 0.1 / world[0, 0], 0.0, 0.0],
        ]
    )
    np.testing.assert_allclose(sim.body_twist[0].numpy(), expected, atol=1e-14)
    for _ in range(99):
        sim.step()
    assert sim.body_pose[0, 0].tolist() == pytest.approx([1.5 * 1e-4 * 5050.0, 0.0, 0.0, *tilt.as_quat()], abs=1e-12)
    assert sim.body_pose[0, 1, :3].abs().max() == 0.0
    axis = (turn(sim, 1) * tilt.inv()).as_rotvec()
    assert axis == pytest.approx([0.0, 0.0, 0.3 / world[2, 2] * 1e-4 * 5050.0], abs=1e-9)


def pendulum(kind: str, dt: float, angle: float, iterations: int = 1) -> sw.Simulation:
    """A point mass below a pivot that turns about y: one body with its centre off the pivot, or a body on a pivot."""
    lever, mass = 1.0, 0.5
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    q = Rotation.from_rotvec([0.0, -angle, 0.0])
    at = np.concatenate([q.apply([0.0, 0.0, -lever]), q.as_quat()])
    pose = np.array([0.0, 0.0, 0.0, *q.as_quat()])
    if kind == "one body":
        vertices, faces = cube(np.array([0.0, 0.0, -lever]), 0.01)
        shape = sw.shapes.Mesh(vertices, faces)
        builder.add_rigid(shape, mass=mass, pose=pose, free_axes=("ry",))
    else:
        pivot = builder.add_rigid(mass=1e-9, inertia=POINT, pose=pose, free_axes=("ry",))
        bob = builder.add_rigid(sw.Box((0.01, 0.01, 0.01)), mass=mass, pose=at)
        builder.attach(bob, to=pivot)
    return sw.Simulation(builder.finalize(precision="float64"), dt=dt, newton_iterations=iterations)


@pytest.mark.parametrize("kind", ["one body", "attached"])
@pytest.mark.parametrize("iterations", [1, 8])
def test_small_pendulum(kind: str, iterations: int) -> None:
    """w^2 = m g d / I_pivot (6.3).

    One iteration takes the moment of the weight at the start, which makes x_{n+1} = (2 - w^2 h^2) x_n - x_{n-1} and
    keeps the amplitude; more iterations make it backward Euler.
    """
    h = 0.01
    sim = pendulum(kind, h, 1e-3, iterations=iterations)
    omega = np.sqrt(9.81 / (1.0 + 0.01**2 / 6.0))
    values = []
    for _ in range(300):
        sim.step()
        values.append(-turn(sim).as_rotvec()[1])
    expected = [2.0 - (omega * h) ** 2, 1.0] if iterations == 1 else rods.backward_euler(omega, h)
    assert rods.recurrence(values) == pytest.approx(expected, abs=2e-9)


def test_large_pendulum() -> None:
    """T = 4 sqrt(L / g) K(sin(30 deg)) = 2.152875 s from 60 degrees (5.5); first order in dt."""
    assert 4.0 * np.sqrt(1.0 / 9.81) * ellipk(0.25) == pytest.approx(2.152875, abs=1e-6)
    periods = []
    for h in (2e-3, 1e-3):
        sim, crossings, before, step = pendulum("attached", h, np.pi / 3.0), [], 1.0, 0
        while len(crossings) < 2:
            sim.step()
            step += 1
            now = float(-turn(sim).as_rotvec()[1])
            if now * before < 0.0:
                crossings.append(h * (step - 1 + before / (before - now)))
            before = now
        periods.append(2.0 * (crossings[1] - crossings[0]))
    limit = 2.0 * periods[1] - periods[0]
    assert periods[1] == pytest.approx(2.152875, rel=3e-3)
    assert limit == pytest.approx(2.152875, rel=3e-4)


@pytest.mark.parametrize("kind", ["one body", "attached"])
def test_flywheel_keeps_its_speed(kind: str) -> None:
    """A mass at 1 m from a held axis without gravity: its speed does not decay, unlike that of a point on a spring."""
    sim = pendulum(kind, 0.01, 0.0)
    sim.params.gravity.zero_()
    sim.body_twist[0, 0, 4] = 20.0
    for _ in range(200):
        sim.step()
    assert float(sim.body_twist[0, 0, 4]) == pytest.approx(20.0, rel=1e-10)


def test_precession_of_a_heavy_top() -> None:
    """A fast top whose axis is level precesses at m g d / I_3 w_3 and neither rises nor falls: 2 % at w h = 0.075."""
    mass, lever, inertia, fast, dt = 1.0, 0.1, np.array([0.002, 0.002, 0.003]), 150.0, 5e-4
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    tilt = Rotation.from_rotvec([0.5 * np.pi, 0.0, 0.0])  # the axis lies along -y, in the horizontal plane
    axis = tilt.apply([0.0, 0.0, 1.0])
    rate = mass * 9.81 * lever / (inertia[2] * fast)  # exact for a horizontal axis
    spin_ = fast * axis + np.array([0.0, 0.0, rate])
    pivot = builder.add_rigid(
        mass=1e-9,
        inertia=POINT,
        pose=(0.0, 0.0, 0.0, *tilt.as_quat()),
        free_axes=("rx", "ry", "rz"),
        velocity=(0.0, 0.0, 0.0, *spin_),
    )
    wheel = builder.add_rigid(mass=mass, inertia=inertia, pose=(*(lever * axis), *tilt.as_quat()))
    builder.attach(wheel, to=pivot)
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=dt)
    for _ in range(1000):
        sim.step()
    now = turn(sim).apply([0.0, 0.0, 1.0])
    assert abs(now[2]) < 0.02
    turned = np.arctan2(axis[0] * now[1] - axis[1] * now[0], axis[0] * now[0] + axis[1] * now[1])
    assert turned == pytest.approx(rate * 0.5, rel=0.02)


def test_damping() -> None:
    """Mass-proportional damping divides velocity and spin by 1 + h a in every step."""
    sim = spinning((1.0, 1.0, 1.0), (0.0, 0.0, 3.0), dt=0.01, damping=2.0, speed=(1.0, 0.0, 0.0))
    for _ in range(50):
        sim.step()
    factor = 1.02**-50.0
    assert sim.body_twist[0, 0].tolist() == pytest.approx([factor, 0.0, 0.0, 0.0, 0.0, 3.0 * factor], abs=1e-12)


# Commands


def kinematic(**options: Any) -> sw.Simulation:
    builder = sw.ModelBuilder()
    builder.add_rigid(sw.Box((0.1, 0.1, 0.1)), kinematic=True, pose=(0.0, 0.0, 0.5), **options)
    return sw.Simulation(builder.finalize(precision="float64"), dt=0.01)


def test_kinematic_body_follows_its_pose() -> None:
    """A commanded pose is reached in the next step, by the shorter turn, whatever the forces; then it is held."""
    sim = kinematic()
    sim.control.body_force[0, 0] = vector(1e3, 1e3, 1e3, 1e3, 1e3, 1e3)
    q = Rotation.from_rotvec([0.0, 0.0, 2.5])
    target = vector(0.2, -0.1, 0.7, *(-q.as_quat()))  # the other sign, the same turn
    sim.control.body_pose[0, 0] = target
    sim.step()
    assert sim.body_pose[0, 0, :3].tolist() == pytest.approx([0.2, -0.1, 0.7], abs=1e-14)
    assert (turn(sim) * q.inv()).magnitude() < 1e-12
    assert sim.body_twist[0, 0].tolist() == pytest.approx([20.0, -10.0, 20.0, 0.0, 0.0, 250.0], abs=1e-9)
    sim.step()
    assert sim.body_pose[0, 0, :3].tolist() == pytest.approx([0.2, -0.1, 0.7], abs=1e-14)
    assert float(sim.body_twist[0, 0].abs().max()) < 1e-9


def test_kinematic_body_follows_its_velocity() -> None:
    """Velocity and spin commands add to the pose that is held: after n steps n h v and a turn by n h w."""
    sim = kinematic()
    sim.control.body_velocity[0, 0] = vector(0.3, 0.0, -0.1, 0.0, 2.0, 0.0)
    for _ in range(100):
        sim.step()
    assert sim.body_pose[0, 0, :3].tolist() == pytest.approx([0.3, 0.0, 0.4], abs=1e-12)
    assert turn(sim).as_rotvec() == pytest.approx([0.0, 2.0, 0.0], abs=1e-12)
    assert sim.body_twist[0, 0].tolist() == pytest.approx([0.3, 0.0, -0.1, 0.0, 2.0, 0.0], abs=1e-9)
    sim.control.body_velocity.zero_()
    sim.control.body_pose[0, 0, 0] = -1.0
    sim.step()
    assert sim.body_pose[0, 0, :3].tolist() == pytest.approx([-1.0, 0.0, 0.5], abs=1e-12)
    sim.control.body_velocity[0, 0, 1] = 0.2
    for _ in range(10):  # the pose command is followed once, not in every step
        sim.step()
    assert sim.body_pose[0, 0, :3].tolist() == pytest.approx([-1.0, 0.02, 0.5], abs=1e-12)


def test_kinematic_limits() -> None:
    """``max_speed`` and ``max_spin`` hold exactly until the pose is reached, and then it is."""
    sim = kinematic(max_speed=0.5, max_spin=1.0)
    q = Rotation.from_rotvec([0.0, 0.1, 0.0]).as_quat()
    sim.control.body_pose[0, 0] = vector(0.03, 0.04, 0.5, *q)
    places, speeds, turns = [], [], []
    for _ in range(12):
        sim.step()
        turns.append(turn(sim).as_rotvec()[1])
        places.append(float(sim.body_pose[0, 0, :2].norm()))
        speeds.append(float(sim.body_twist[0, 0, :3].norm()))
    expected = np.minimum(0.005 * np.arange(1, 13), 0.05)
    assert places == pytest.approx(expected, abs=1e-12)
    assert speeds[:10] == pytest.approx([0.5] * 10)
    assert turns == pytest.approx(np.minimum(0.01 * np.arange(1, 13), 0.1), abs=1e-9)
    assert turn(sim).as_rotvec() == pytest.approx([0.0, 0.1, 0.0], abs=1e-9)
    sim.params.body_max_speed.fill_(100.0)
    sim.control.body_pose[0, 0, 0] = 0.9
    sim.step()
    assert float(sim.body_pose[0, 0, 0]) == pytest.approx(0.9)


def test_commanded_jump_is_no_divergence() -> None:
    """A body that is commanded 1 km away in one step is not a failed world, nor is what it carries."""
    builder = sw.ModelBuilder()
    body = builder.add_rigid(sw.Box((0.1, 0.1, 0.1)), kinematic=True)
    soft = builder.add_tets(meshing.box((0.1, 0.1, 0.1), (1, 1, 1)), material=sw.Corotational(1e5, 0.3), density=1e3)
    builder.attach(soft, nodes=range(8), to=body)
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.01)
    sim.control.body_pose[0, 0, 0] = 1000.0
    sim.step()
    assert int(sim.status[0]) == sw.Status.OK
    assert float(sim.body_pose[0, 0, 0]) == pytest.approx(1000.0)
    assert float(sim.node_x[0, :, 0].min()) == pytest.approx(1000.0)
    free = spinning((1.0, 1.0, 1.0), (0.0, 0.0, 0.0), dt=0.01, speed=(1e4, 0.0, 0.0))
    free.step()
    assert int(free.status[0]) == sw.Status.DIVERGED
