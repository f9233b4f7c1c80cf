"""Joints against pendulums, tops and other known motions. SI units, z up."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from scipy.special import ellipk

import softwarp as sw
from softwarp.scene import RigidBody
from tests.rigid_cases import ALONG_X, G, run


def chain(
    count: int, kind: str = "hinge", length: float = 0.1, velocity: tuple[float, ...] = (0.0,) * 6
) -> sw.ModelBuilder:
    """Rods of 0.1 kg along x, joined to the world and to each other; hinges turn about y."""
    builder = sw.ModelBuilder()
    parent = None
    for i in range(count):
        pose = (length * (i + 0.5), 0.0, 0.0, *ALONG_X)
        body = builder.add_rigid(sw.Capsule(0.1 * length, 0.8 * length), mass=0.1, pose=pose, velocity=velocity)
        builder.add_joint(parent, body, kind, anchor=(length * i, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
        parent = body
    return builder


def largest_gap(sim: sw.Simulation, length: float = 0.1) -> float:
    """Largest distance of two ends that a joint of a chain ties together [m]."""
    pose = sim.body_pose[0].double().numpy()
    axis = Rotation.from_quat(pose[:, 3:]).apply([0.0, 0.0, 1.0])
    ends = np.vstack([np.zeros(3), pose[:-1, :3] + 0.5 * length * axis[:-1]])
    return float(np.linalg.norm(pose[:, :3] - 0.5 * length * axis - ends, axis=1).max())


@pytest.mark.slow
def test_pendulum():
    """Validation 5.5: T = 4 sqrt(L/g) K(sin(theta0 / 2)), 2.152875 s for 1 m and 60 degrees; error O(h^2).

    The anchor is held to O(h^3) and the energy, O(h) beside the true one, comes back each period.
    """
    exact = 4.0 * math.sqrt(1.0 / G) * ellipk(math.sin(math.pi / 6.0) ** 2)
    assert exact == pytest.approx(2.152875, abs=1e-6)
    errors, gaps = [], []
    for dt in (0.02, 0.01):
        builder = sw.ModelBuilder()
        start = (math.sin(math.pi / 3.0), 0.0, -math.cos(math.pi / 3.0))
        bob = builder.add_rigid(mass=1.0, inertia=(1e-6, 1e-6, 1e-6), pose=start)
        builder.add_joint(None, bob, "hinge", anchor=(0.0, 0.0, 0.0), axis=(0.0, -1.0, 0.0))
        sim = sw.Simulation(builder.finalize(precision="float64"), dt=dt, threads=1)
        angle, gap, energy = [], 0.0, []
        for _ in range(round(5.0 / dt)):
            sim.step()
            angle.append(math.pi / 3.0 + float(sim.joint_position[0, 0]))
            gap = max(gap, abs(float(sim.body_pose[0, 0, :3].norm()) - 1.0))
            energy.append(float(sim.energy()[0]))
        q, t = np.array(angle), dt * np.arange(1, len(angle) + 1)
        down = np.flatnonzero((q[:-1] > 0.0) & (q[1:] <= 0.0))
        crossing = t[down] + dt * q[down] / (q[down] - q[down + 1])
        errors.append(float(np.diff(crossing).mean()) - exact)
        gaps.append(gap)
        assert max(q) < math.pi / 3.0 * 1.002
        assert abs(np.mean(energy[-round(exact / dt) :]) - energy[0]) < 0.1 * G * dt / 0.02
    assert abs(errors[1]) < 3e-4
    assert abs(errors[0]) < 4.5 * abs(errors[1])
    assert gaps[1] < 1e-6
    assert gaps[0] / gaps[1] > 6.0


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_physical_pendulum(precision):
    """Validation 6.3: omega^2 = m g d / I_pivot of a box whose origin, centre of mass and anchor all differ."""
    builder = sw.ModelBuilder()
    box = sw.Compound([(sw.Box((0.1, 0.2, 0.4)), (0.0, 0.0, -0.3))])
    body = builder.add_rigid(box, mass=2.0, pose=(0.05, 0.0, 0.0))
    builder.add_joint(None, body, "hinge", anchor=(0.05, 0.0, 0.1), axis=(0.0, 1.0, 0.0))
    sim = sw.Simulation(builder.finalize(precision=precision), dt=0.005, threads=1)
    inertia = 2.0 / 12.0 * (0.1**2 + 0.4**2) + 2.0 * 0.4**2
    period = 2.0 * math.pi / math.sqrt(2.0 * G * 0.4 / inertia)
    sim.control.body_force[0, 0, 0] = 0.05  # swings about a small angle, and is let go there
    run(sim, 0.4)
    sim.control.body_force[0, 0, 0] = 0.0
    q, t = [], []
    for _ in range(round(6.0 * period / sim.dt)):
        sim.step()
        q.append(float(sim.joint_position[0, 0]))
        t.append(float(sim.time[0]))
    q, t = np.array(q), np.array(t)
    up = np.flatnonzero((q[:-1] < 0.0) & (q[1:] >= 0.0))
    crossing = t[up] - sim.dt * q[up] / (q[up + 1] - q[up])
    assert np.diff(crossing).mean() == pytest.approx(period, rel=3e-4)
    assert np.abs(q).max() < 0.02


def double_pendulum(time: float) -> np.ndarray:
    """Angles from below and their velocities of two rods of 0.5 m and 1 kg that start horizontally."""
    length, mass = 0.5, 1.0
    inertia = mass * length**2 / 12.0

    def rate(_: float, y: np.ndarray) -> list[float]:
        a, b, va, vb = y
        off = 0.5 * mass * length**2 * math.cos(a - b)
        M = np.array([[inertia + 1.25 * mass * length**2, off], [off, inertia + 0.25 * mass * length**2]])
        swing = 0.5 * mass * length**2 * math.sin(a - b)
        force = [
            -swing * vb**2 - 1.5 * mass * G * length * math.sin(a),
            swing * va**2 - 0.5 * mass * G * length * math.sin(b),
        ]
        return [va, vb, *np.linalg.solve(M, force)]

    start = [0.5 * math.pi, 0.5 * math.pi, 0.0, 0.0]
    return np.asarray(solve_ivp(rate, (0.0, time), start, rtol=1e-11, atol=1e-12).y[:, -1])


@pytest.mark.slow
def test_double_pendulum():
    """After 1 s: angles O(h) from Lagrange's equations, velocities O(h^2); energy within O(h) of 0, not drifting."""
    exact = double_pendulum(1.0)
    found = []
    for dt in (0.01, 0.005):
        builder = sw.ModelBuilder()
        parent, inertia = None, 0.25 / 12.0
        for i in range(2):
            pose = (0.5 * (i + 0.5), 0.0, 0.0, *ALONG_X)
            body = builder.add_rigid(mass=1.0, inertia=(inertia, inertia, 1e-5), pose=pose)
            builder.add_joint(parent, body, "hinge", anchor=(0.5 * i, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
            parent = body
        sim = sw.Simulation(builder.finalize(precision="float64"), dt=dt, threads=1)
        energy = []
        for _ in range(round(1.0 / dt)):
            sim.step()
            energy.append(float(sim.energy()[0]))
        q, v = sim.joint_position[0].numpy(), sim.joint_velocity[0].numpy()
        a, va = 0.5 * math.pi - q[0], -v[0]
        found.append(np.array([a, a - q[1], va, va - v[1]]) - exact)
        assert np.abs(energy).max() < 20.0 * dt  # of 9.81 J that move to and fro
    assert np.abs(found[1][:2]).max() < 0.02
    assert np.abs(found[1][2:]).max() < 0.006
    assert (np.abs(found[0][:2]) > 1.8 * np.abs(found[1][:2])).all()
    assert (np.abs(found[0][2:]) > 3.5 * np.abs(found[1][2:])).all()


@pytest.mark.parametrize(("precision", "limit"), [("float64", 0.002), ("float32", 0.1)])
def test_gyration(precision, limit):
    """Validation 6.1 (Dzhanibekov) of a body on a ball joint at its centre: as a free one, and with its energy.

    In the body's axes: t = 5 s (2.204771, -4.488762, 1.271615), t = 10 s (0.921980, -4.915277, -0.529165).
    """
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    body = builder.add_rigid(mass=1.0, inertia=(1.0, 2.0, 3.0), velocity=(0.0, 0.0, 0.0, 0.1, 5.0, 0.0))
    builder.add_joint(None, body, "ball")
    sim = sw.Simulation(builder.finalize(precision=precision), dt=0.005, threads=1)
    start = float(sim.energy()[0])
    for time, expected in ((5.0, (2.204771, -4.488762, 1.271615)), (10.0, (0.921980, -4.915277, -0.529165))):
        run(sim, time - float(sim.time[0]))
        turn = Rotation.from_quat(sim.body_pose[0, 0, 3:].double().numpy())
        w = turn.inv().apply(sim.body_twist[0, 0, 3:].double().numpy())
        np.testing.assert_allclose(w, expected, atol=limit)
    assert float(sim.energy()[0]) == pytest.approx(start, rel=1e-3)


def test_heavy_top():
    """A fast symmetric top on a point, against the equations dR/dt = [w] R, dL/dt = c x m g; 0.3 rad per step."""
    m, reach, moments = 0.5, 0.05, np.array([2e-3, 2e-3, 9e-4])  # about the tip
    start = Rotation.from_rotvec([0.0, math.pi / 6.0, 0.0])
    spin = start.apply([0.0, 0.0, 150.0])

    def rate(_: float, y: np.ndarray) -> np.ndarray:
        turn = Rotation.from_quat(y[:4])
        w = turn.apply(turn.inv().apply(y[4:]) / moments)
        q = y[:4]
        moment = np.cross(turn.apply([0.0, 0.0, reach]), [0.0, 0.0, -G * m])
        return np.array([*(0.5 * (w * q[3] + np.cross(w, q[:3]))), -0.5 * w @ q[:3], *moment])

    y0 = np.concatenate([start.as_quat(), start.apply(moments * [0.0, 0.0, 150.0])])
    y = solve_ivp(rate, (0.0, 1.0), y0, rtol=1e-10, atol=1e-12).y[:, -1]
    expected = Rotation.from_quat(y[:4]).apply([0.0, 0.0, 1.0])
    centre = start.apply([0.0, 0.0, reach])
    builder = sw.ModelBuilder()
    own = moments - m * reach**2 * np.array([1.0, 1.0, 0.0])
    velocity = (*np.cross(spin, centre), *spin)
    top = builder.add_rigid(mass=m, inertia=own, pose=(*centre, *start.as_quat()), velocity=velocity)
    builder.add_joint(None, top, "ball", anchor=(0.0, 0.0, 0.0))
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.002, threads=1)
    energy = float(sim.energy()[0])
    run(sim, 1.0)
    axis = Rotation.from_quat(sim.body_pose[0, 0, 3:].numpy()).apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(axis, expected, atol=0.006)
    assert float(sim.energy()[0]) == pytest.approx(energy, abs=1e-3)


def test_weld_is_one_body():
    """Two half boxes welded by a joint fly as one box does; the joint reports the load in the cut."""
    pose = {}
    for is_welded in (False, True):
        builder = sw.ModelBuilder()
        spin, v = np.array([1.0, 4.0, 2.0]), np.array([0.5, 0.0, 3.0])
        places = (-0.1, 0.1) if is_welded else (0.0,)
        bodies = []
        for x in places:
            size = (0.4 / len(places), 0.1, 0.06)
            velocity = (*(v + np.cross(spin, [x, 0.0, 0.0])), *spin)
            bodies.append(builder.add_rigid(sw.Box(size), density=500.0, pose=(x, 0.0, 0.0), velocity=velocity))
        if is_welded:
            builder.add_joint(*bodies, "weld", anchor=(0.0, 0.0, 0.0))
        sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.0025, threads=1)
        run(sim, 1.0)
        pose[is_welded] = sim.body_pose[0].numpy()
    turns = [Rotation.from_quat(p[3:]) for p in (*pose[True], pose[False][0])]
    centre = 0.5 * (pose[True][0, :3] + pose[True][1, :3])
    np.testing.assert_allclose(centre, pose[False][0, :3], atol=1e-9)
    assert (turns[0].inv() * turns[1]).magnitude() < 1e-7
    assert (turns[0].inv() * turns[2]).magnitude() < 0.03


def test_joints_keep_momentum():
    """Five links in space keep linear and angular momentum, however they fold."""
    builder = chain(5, "ball", velocity=(0.0, 0.0, 0.0, 3.0, 1.0, -2.0))
    builder.gravity[:] = 0.0
    builder.joints.pop(0)
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.005, threads=1)
    linear, angular = (part.clone() for part in sim.momentum())
    run(sim, 5.0)
    np.testing.assert_allclose(sim.momentum()[0], linear, atol=1e-10)
    np.testing.assert_allclose(sim.momentum()[1], angular, rtol=0.01)


@pytest.mark.parametrize(
    ("kind", "precision"),
    [pytest.param("hinge", "float64", marks=pytest.mark.slow), ("ball", "float64"), ("ball", "float32")],
)
def test_chain_does_not_drift(kind, precision):
    """Ten links fall and whip for 10 s: ends stay together, and the energy never rises above the start's.

    Gravity works at the start of a step, so that energy may lie half a step of it, m g h v / 2, above.
    """
    velocity = (0.0, 0.3, 0.0, 0.0, 0.0, 0.0) if kind == "ball" else (0.0,) * 6
    sim = sw.Simulation(chain(10, kind, velocity=velocity).finalize(precision=precision), dt=0.005, threads=1)
    start = float(sim.energy()[0])
    for second in range(10):
        for _ in range(200):
            sim.step()
            if second > 5:
                assert largest_gap(sim) < 2e-3
        assert float(sim.energy()[0]) < start + 0.1
    assert sim.status.tolist() == [sw.Status.OK]
    run(sim, 0.01)
    assert largest_gap(sim) < 1e-3


@pytest.mark.slow
def test_violent_motion_is_passive():
    """Bodies that a joint of 0.1 m turns by 3 rad per step gain no energy."""
    sim = sw.Simulation(chain(6, "ball", velocity=(0.0, 0.0, 0.0, 200.0, 150.0, 100.0)).finalize(), dt=0.01, threads=1)
    energy = [float(sim.energy()[0])]
    for _ in range(300):
        sim.step()
        energy.append(float(sim.energy()[0]))
    assert max(energy) <= energy[0] * 1.001 + 1.0


def test_bodies_pulled_apart_come_together_without_speed():
    """A link that was put 5 cm away is back after one step, and what corrected it left no kinetic energy behind."""
    builder = chain(2)
    builder.gravity[:] = 0.0
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.01, threads=1)
    sim.body_pose[0, 1, :3] += torch.tensor([0.03, 0.0, 0.04], dtype=torch.float64)
    sim.refresh()
    for _ in range(3):
        sim.step()
    assert largest_gap(sim) < 1e-4
    assert float(sim.energy()[0]) < 1e-9


def test_reaction_is_weight():
    """A hanging chain: the first hinge carries all of it; a weld at the side of a beam carries its moment too."""
    sim = sw.Simulation(chain(4).finalize(precision="float64"), dt=0.01, threads=1)
    result = sim.solve_static()
    assert result.converged.all()
    np.testing.assert_allclose(sim.body_pose[0, :, 2], [-0.05, -0.15, -0.25, -0.35], atol=1e-6)
    np.testing.assert_allclose(sim.joint_reaction[0, :, 2], G * 0.1 * np.array([4, 3, 2, 1]), rtol=1e-6)
    builder = sw.ModelBuilder()
    beam = builder.add_rigid(sw.Box((0.4, 0.05, 0.05)), mass=3.0, pose=(0.2, 0.0, 0.0))
    builder.add_joint(None, beam, "weld", anchor=(0.0, 0.0, 0.0))
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.01, threads=1)
    run(sim, 0.2)
    np.testing.assert_allclose(sim.joint_reaction[0, 0], [0, 0, 3.0 * G, 0, -3.0 * G * 0.2, 0], atol=1e-8)


@pytest.mark.parametrize("steps", [150, pytest.param(1000, marks=pytest.mark.slow)])
def test_closed_loop(steps):
    """Four bars and four hinges, of which the last repeats rows of the others: a parallelogram keeps its shape."""
    builder = sw.ModelBuilder()

    def bar(start: tuple[float, float], end: tuple[float, float]) -> RigidBody:
        d = np.subtract(end, start)
        angle = -0.5 * math.atan2(d[1], d[0])
        centre = 0.5 * np.add(start, end)
        pose = (centre[0], 0.0, centre[1], 0.0, math.sin(angle), 0.0, math.cos(angle))
        return builder.add_rigid(sw.Box((float(np.linalg.norm(d)), 0.02, 0.02)), mass=0.5, pose=pose)

    left, right = bar((0.0, 0.0), (0.1, 0.3)), bar((0.5, 0.0), (0.6, 0.3))
    top = bar((0.1, 0.3), (0.6, 0.3))
    sides = [(None, left, 0.0, 0.0), (None, right, 0.5, 0.0), (left, top, 0.1, 0.3), (right, top, 0.6, 0.3)]
    for parent, child, x, z in sides:
        limits = (-1.1, 1.1) if child == left else (-math.inf, math.inf)  # flat at 1.25 rad, where it could fold
        builder.add_joint(parent, child, "hinge", anchor=(x, 0.0, z), axis=(0.0, 1.0, 0.0), limits=limits)
    sim = sw.Simulation(builder.finalize(), dt=0.005, threads=1)
    start = float(sim.energy()[0])
    for _ in range(steps):
        sim.step()
        q = sim.joint_position[0]
        np.testing.assert_allclose(q[1:], [q[0], -q[0], -q[0]], atol=1e-3)
        assert float(sim.body_pose[0, top, 3:6].norm()) < 1e-3
        assert float(sim.energy()[0]) < start + 0.06
    assert sim.status.tolist() == [sw.Status.OK]


def test_cart_and_pole():
    """A motor on a cart's free axis: momentum along the rail is force times time, as nothing else acts along it."""
    builder = sw.ModelBuilder()
    cart = builder.add_rigid(mass=2.0, inertia=(1.0, 1.0, 1.0), free_axes="x")
    builder.add_joint(None, cart, "slider", axis=(1.0, 0.0, 0.0), control="force", limits=(-5.0, 5.0))
    pole = builder.add_rigid(sw.Capsule(0.01, 0.5), mass=0.1, pose=(0.0, 0.0, 0.27))
    builder.add_joint(cart, pole, "hinge", anchor=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.005, threads=1)
    sim.control.joint_force[0, 0] = 1.5
    run(sim, 1.0)
    momentum = 2.0 * float(sim.body_twist[0, cart, 0]) + 0.1 * float(sim.body_twist[0, pole, 0])
    assert momentum == pytest.approx(1.5, rel=1e-6)
    assert abs(float(sim.joint_position[0, 1])) > 1.0


@pytest.mark.parametrize("precision", ["float32", pytest.param("float64", marks=pytest.mark.slow)])
def test_arm_strikes_the_floor(precision):
    """Servos at their limits, friction and stops strain an arm against the floor: all worlds go on."""
    builder = sw.ModelBuilder()
    floor = builder.add_rigid(sw.Plane(), kinematic=True, pose=(0.0, 0.0, -0.25))
    options = {"control": "position", "stiffness": 5.0, "damping": 0.05, "max_force": 0.5, "limits": (-2.0, 2.0)}
    parent = None
    for i in range(4):
        body = builder.add_rigid(sw.Capsule(0.02, 0.08), density=1000.0, pose=(0.12 * (i + 0.5), 0.0, 0.0, *ALONG_X))
        axis = (0.0, 1.0, 0.0) if i % 2 == 0 else (0.0, 0.0, 1.0)
        builder.add_joint(parent, body, "hinge", anchor=(0.12 * i, 0.0, 0.0), axis=axis, **options)
        builder.add_contact(body, floor, mu=0.6)
        parent = body
    sim = sw.Simulation(builder.finalize(8, precision=precision), dt=0.01, threads=1)
    generator = torch.Generator().manual_seed(0)
    for step in range(500):
        if step % 25 == 0:
            sim.control.joint_target[:] = 4.4 * torch.rand(8, 4, generator=generator) - 2.2
        sim.step()
        assert sim.status.tolist() == [sw.Status.OK] * 8
        assert float(sim.body_twist.norm(dim=-1).max()) < 150.0
        assert float(sim.joint_position.abs().max()) < 2.01
        assert float(sim.joint_force.abs().max()) < 0.5 + 1e-6


def test_beam_on_two_hinges():
    """A rod on a hinge and on a slider with a pin at its other end sags by 5 q L^4 / 384 E I, and each carries half."""
    youngs, radius, length, density = 1e6, 0.01, 0.5, 1000.0
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -0.1))
    points = np.linspace([0.0, 0.0, 0.0], [length, 0.0, 0.0], 21)
    rod = builder.add_rod(points, radius=radius, youngs=youngs, nu=0.3, density=density)
    shoe = builder.add_rigid(mass=1e-3, inertia=(1e-6, 1e-6, 1e-6), pose=(length, 0.0, 0.0), free_axes="x")
    builder.add_joint(None, (rod, 0), "hinge", axis=(0.0, 1.0, 0.0))
    builder.add_joint(shoe, (rod, -1), "hinge", axis=(0.0, 1.0, 0.0))
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.01, threads=1)
    assert sim.solve_static().converged.all()
    load = 0.1 * density * math.pi * radius**2
    sag = 5.0 * load * length**4 / (384.0 * youngs * 0.25 * math.pi * radius**4)
    shear = load * length**2 / (8.0 * 6.0 * 1.3 / 8.8 * youngs / 2.6 * math.pi * radius**2)
    assert float(-sim.rod_x[0, 10, 2]) == pytest.approx(sag + shear, rel=0.005)
    np.testing.assert_allclose(sim.joint_reaction[0, :, 2], 0.5 * load * length, rtol=2e-3)


def mixed(worlds: int, **options) -> sw.Simulation:
    """An arm with servo, limits, slider, ball and a rod, in float32."""
    builder = chain(3)
    last = RigidBody(2)
    foot = builder.add_rigid(sw.Sphere(0.02), mass=0.05, pose=(0.3, 0.0, 0.0))
    options_of = {"control": "position", "stiffness": 20.0, "damping": 0.2, "max_force": 1.0, "limits": (-0.05, 0.05)}
    builder.add_joint(last, foot, "slider", axis=(1.0, 0.0, 0.0), **options_of)
    rod = builder.add_rod(np.linspace([0.3, 0.0, 0.0], [0.5, 0.0, 0.0], 5), radius=0.005, youngs=1e6)
    builder.add_joint(foot, (rod, 0), "ball")
    sim = sw.Simulation(builder.finalize(worlds), dt=0.01, **options)
    generator = torch.Generator().manual_seed(3)
    sim.control.joint_target[:, 3] = 0.08 * torch.rand(9, generator=generator)[:worlds] - 0.04
    sim.params.joint_max_force[:, 3] = 2.0 * torch.rand(9, generator=generator)[:worlds]
    return sim


@pytest.mark.parametrize("path", ["scalar", "lanes"])
def test_batch_equals_alone(path):
    """World 5 of nine is bit for bit what it is with others beside it or alone, and lanes agree with single worlds."""
    sim = mixed(9, solver_path=path, threads=2)
    snapshot = sim.snapshot([5])
    for _ in range(60):
        sim.step()
    alone = mixed(1, solver_path=path)
    alone.restore(snapshot)
    for _ in range(60):
        alone.step()
    for name in ("body_pose", "body_twist", "rod_x", "joint_position", "joint_velocity", "joint_reaction"):
        assert torch.equal(getattr(sim, name)[5], getattr(alone, name)[0]), name
    assert sim.status.tolist() == [sw.Status.OK] * 9


def test_lanes_agree_with_single_worlds():
    """To rounding, before a free chain spreads it."""
    sims = [mixed(9, solver_path=path, threads=1) for path in ("scalar", "lanes")]
    for sim in sims:
        for _ in range(15):
            sim.step()
    for name in ("body_pose", "rod_x", "joint_position"):
        np.testing.assert_allclose(getattr(sims[0], name), getattr(sims[1], name), atol=2e-5)


def test_resumes_bit_for_bit():
    """A snapshot holds turns, references and warm starts."""
    sim = mixed(2, threads=1)
    for _ in range(20):
        sim.step()
    snapshot = sim.snapshot()
    for _ in range(20):
        sim.step()
    kept = {name: getattr(sim, name).clone() for name in ("body_pose", "joint_position", "joint_reference")}
    sim.restore(snapshot)
    for _ in range(20):
        sim.step()
    for name, value in kept.items():
        assert torch.equal(getattr(sim, name), value), name
