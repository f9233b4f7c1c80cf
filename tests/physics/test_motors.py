"""Motors, limits and springs of joints against servos and other known motions. SI units, z up."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import softwarp as sw
from tests.rigid_cases import ALONG_X, G, run


def wheel(precision: str = "float64", dt: float = 0.01, worlds: int = 1, **options) -> sw.Simulation:
    """A wheel of 0.02 kg m^2 on a hinge to the world, without gravity."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    body = builder.add_rigid(mass=1.0, inertia=(0.02, 0.02, 0.02))
    builder.add_joint(None, body, "hinge", axis=(0.0, 1.0, 0.0), **options)
    return sw.Simulation(builder.finalize(worlds, precision=precision), dt=dt, threads=1)


def test_servo_overshoots():
    """Validation 6.5: exp(-pi zeta / sqrt(1 - zeta^2)) = 37.23 % for zeta = 0.3, less O(h) of backward Euler."""
    kp, zeta = 8.0, 0.3
    exact = math.exp(-math.pi * zeta / math.sqrt(1.0 - zeta**2))
    errors = []
    for dt in (0.002, 0.001):
        sim = wheel(dt=dt, control="position", stiffness=kp, damping=2.0 * zeta * math.sqrt(kp * 0.02))
        sim.control.joint_target[:] = 0.5
        highest = 0.0
        for _ in range(round(0.4 / dt)):
            sim.step()
            highest = max(highest, float(sim.joint_position[0, 0]))
        errors.append(exact - (highest / 0.5 - 1.0))
    assert 0.0 < errors[1] < 0.013
    assert errors[0] == pytest.approx(2.0 * errors[1], rel=0.05)


@pytest.mark.parametrize(("precision", "limit"), [("float64", 1e-12), ("float32", 1e-6)])
def test_servo_saturates_exactly(precision, limit):
    """A motor at its limit adds h f / I to the speed each step; once it can, it is where it should be and stands."""
    sim = wheel(precision, control="position", max_force=0.1)
    sim.control.joint_target[:] = 0.4
    for step in range(1, 31):
        sim.step()
        assert float(sim.joint_force[0, 0]) == pytest.approx(0.1, rel=1e-6)
        assert float(sim.joint_velocity[0, 0]) == pytest.approx(step * 0.05, rel=1e-5)
    sim = wheel(precision, control="position", max_rate=2.0)
    sim.control.joint_target[:] = 1.0
    for step in range(1, 56):
        sim.step()
        assert float(sim.joint_position[0, 0]) == pytest.approx(min(0.02 * step, 1.0), abs=50.0 * limit)
    assert abs(float(sim.joint_velocity[0, 0])) <= 1e3 * limit


@pytest.mark.parametrize(("precision", "limit"), [("float64", 1e-12), ("float32", 3e-7)])
def test_rigid_servo_reaches_its_target(precision, limit):
    """Validation 6.5: a kinematic servo is at its target after one step, with the torque that this takes."""
    sim = wheel(precision, control="position")
    sim.control.joint_target[:] = 1.234
    sim.step()
    assert float(sim.joint_position[0, 0]) == pytest.approx(1.234, abs=limit)
    assert float(sim.joint_force[0, 0]) == pytest.approx(0.02 * 1.234 / 0.01**2, rel=1e-5)
    sim.step()
    assert float(sim.joint_position[0, 0]) == pytest.approx(1.234, abs=limit)


def test_arm_of_rigid_servos_reaches_its_targets(rng):
    """Six servos in a row, under gravity and in space: angles are exact, whatever the arm weighs."""
    builder = sw.ModelBuilder()
    parent = None
    for i in range(6):
        body = builder.add_rigid(sw.Capsule(0.02, 0.06), mass=1.0, pose=(0.1 * (i + 0.5), 0.0, 0.0, *ALONG_X))
        axis = ((0, 0, 1), (0, 1, 0), (1, 0, 0))[i % 3]
        builder.add_joint(parent, body, "hinge", anchor=(0.1 * i, 0.0, 0.0), axis=axis, control="position")
        parent = body
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.01, threads=1)
    target = torch.as_tensor(rng.uniform(-1.0, 1.0, 6))
    for step in range(1, 101):
        sim.control.joint_target[:] = min(0.02 * step, 1.0) * target
        sim.step()
    np.testing.assert_allclose(sim.joint_position[0], target, atol=1e-9)
    turn = Rotation.identity()
    for i, angle in enumerate(target.tolist()):
        turn = turn * Rotation.from_rotvec(np.array(((0, 0, 1), (0, 1, 0), (1, 0, 0))[i % 3]) * angle)
    assert (
        turn.inv() * Rotation.from_quat(sim.body_pose[0, 5, 3:]) * Rotation.from_quat(ALONG_X).inv()
    ).magnitude() < 1e-6


def test_velocity_control():
    """A motor speeds up at its limit, then holds its velocity over a hundred turns; a blocked one exerts the limit."""
    sim = wheel("float32", control="velocity", max_force=0.1)
    sim.control.joint_target[:] = 30.0
    run(sim, 3.0)
    assert float(sim.joint_velocity[0, 0]) == pytest.approx(15.0, rel=5e-5)
    run(sim, 20.0)
    assert float(sim.joint_velocity[0, 0]) == pytest.approx(30.0, rel=1e-5)
    assert float(sim.joint_position[0, 0]) == pytest.approx(0.5 * 5.0 * 6.0**2 + 30.0 * 17.0, rel=2e-3)
    sim.control.body_force[0, 0, 4] = -5.0
    run(sim, 0.1)
    assert float(sim.joint_force[0, 0]) == pytest.approx(0.1, rel=1e-6)


def test_force_control():
    """A force within its limit is exerted exactly, and beyond it the limit is."""
    sim = wheel(control="force", max_force=0.2)
    for command, force in ((0.1, 0.1), (-3.0, -0.2)):
        sim.reset()
        sim.control.joint_force[:] = command
        run(sim, 0.1)
        assert float(sim.joint_velocity[0, 0]) == pytest.approx(force / 0.02 * 0.1, rel=1e-6)
        assert float(sim.joint_force[0, 0]) == pytest.approx(force, rel=1e-12)


def slider(precision: str = "float64", worlds: int = 1, solver: dict | None = None, **options) -> sw.Simulation:
    builder = sw.ModelBuilder()
    body = builder.add_rigid(sw.Box((0.1, 0.1, 0.1)), mass=1.0)
    builder.add_joint(None, body, "slider", axis=(0.0, 0.0, 1.0), **options)
    return sw.Simulation(builder.finalize(worlds, precision=precision), dt=0.01, threads=1, **(solver or {}))


@pytest.mark.parametrize(("precision", "limit"), [("float64", 1e-9), ("float32", 1e-6)])
def test_slider_stops_at_its_limit(precision, limit):
    """It falls to the limit, never below it, and the limit carries its weight; pushed up, it leaves it."""
    sim = slider(precision, limits=(-0.1, 0.2))
    lowest = 0.0
    for _ in range(60):
        sim.step()
        lowest = min(lowest, float(sim.joint_position[0, 0]))
    assert lowest == pytest.approx(-0.1, abs=limit)
    assert float(sim.joint_position[0, 0]) == pytest.approx(-0.1, abs=limit)
    assert float(sim.joint_reaction[0, 0, 2]) == pytest.approx(G, rel=1e-5)
    sim.control.body_force[0, 0, 2] = 2.0 * G
    run(sim, 0.1)
    assert float(sim.joint_velocity[0, 0]) == pytest.approx(0.1 * G, rel=1e-5)
    run(sim, 1.0)
    assert float(sim.joint_position[0, 0]) == pytest.approx(0.2, abs=limit)


@pytest.mark.parametrize(("solver", "speed"), [({}, 0.5), ({"recovery_speed": 0.2}, 0.2)])
def test_slider_is_brought_back(solver, speed):
    """What lies outside its limits, because they have moved, comes back at the recovery speed, 0.5 m/s, and rests."""
    sim = slider(limits=(-0.1, 0.2), solver=solver)
    run(sim, 1.0)
    sim.params.joint_min_position[:] = 0.0
    for step in range(1, 20):
        sim.step()
        assert float(sim.joint_position[0, 0]) == pytest.approx(-0.1 + 0.01 * speed * step, abs=1e-9)
    run(sim, 1.0)
    assert float(sim.joint_position[0, 0]) == pytest.approx(0.0, abs=1e-9)


def test_spring():
    """A servo with target 0 is a spring with a damper: m g / k below its rest, from there the damped oscillation."""
    sim = slider(control="position", stiffness=400.0, damping=2.0)
    run(sim, 8.0)
    assert float(sim.joint_position[0, 0]) == pytest.approx(-G / 400.0, abs=1e-6)
    assert float(sim.joint_force[0, 0]) == pytest.approx(G, rel=1e-4)


def test_static_servo():
    """A servo sags until its torque balances the weight, kp q = -m g l cos q, in the static solve and by steps."""
    builder = sw.ModelBuilder()
    arm = builder.add_rigid(sw.Box((0.2, 0.02, 0.02)), mass=1.0, pose=(0.1, 0.0, 0.0))
    options = {"control": "position", "stiffness": 10.0, "damping": 1.0}
    builder.add_joint(None, arm, "hinge", anchor=(0.0, 0.0, 0.0), axis=(0.0, -1.0, 0.0), **options)
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.01, threads=1)
    assert sim.solve_static().converged.all()
    static = float(sim.joint_position[0, 0])
    assert 10.0 * static == pytest.approx(-G * 0.1 * math.cos(static), rel=1e-6)
    sim.reset()
    run(sim, 8.0)
    assert float(sim.joint_position[0, 0]) == pytest.approx(static, abs=1e-6)
