"""The tripod on its servo arms: symmetry, weight, work of the motors, and where its plate stands."""

import math

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import Status
from softwarp.envs.options.tripod import TripodSceneConfig
from softwarp.envs.scenes.tripod import SERVOS, build_tripod_scene, set_up

G = 9.81
HOME = -1.4965  # rad, of SofaGym's setup motion


def tripod(*, angle=HOME, precision="float64", num_worlds=1, newton_iterations=6, **options):
    """The tripod after its setup motion, not yet at rest, without limits of torque."""
    config = TripodSceneConfig(**({"angle": angle, "max_torque": math.inf} | options))
    builder = sw.ModelBuilder(gravity=config.gravity)
    scene = build_tripod_scene(config, builder)
    sim = sw.Simulation(builder.finalize(num_worlds, precision=precision), 0.01, newton_iterations)
    set_up(sim, scene, config)
    return sim, scene


def turn_to(sim, angles, steps=20):
    """Turn the servos, then let the tripod come to rest."""
    start, end = sim.joint_position.clone(), torch.as_tensor(angles).to(sim.joint_position)
    for step in range(steps):
        sim.control.joint_target.copy_(torch.lerp(start, end.expand_as(start), (step + 1) / steps))
        sim.step()
    assert sim.solve_static(max_iterations=100).converged.all()


def plate(sim, scene):
    """Middle of the plate [mm] and the slopes of its normal, nx / nz and ny / nz, of world 0."""
    x, y, z, w = sim.frame_pose[0, scene.plate, 3:].tolist()
    normal = np.array([2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y)])
    return 1e3 * sim.marker_x[0, scene.middle].numpy(), normal[:2] / normal[2]


@pytest.fixture(scope="module")
def rested():
    """At rest under equal angles of -1 rad, polar elements, whose force is the derivative of their energy."""
    sim, scene = tripod(angle=-1.0, rotation="polar")
    turn_to(sim, [-1.0] * SERVOS)
    return sim, scene


def test_equal_angles_do_not_tilt(rested):
    """A third of a turn and a mirror map scene and mesh to themselves, so the plate stays level on the axis."""
    sim, scene = rested
    middle, slope = plate(sim, scene)
    assert np.abs(middle[:2]).max() < 1e-5 and np.abs(slope).max() < 1e-6
    assert sim.joint_force.std() < 1e-7 and sim.status.tolist() == [Status.OK]


def test_joints_carry_the_weight(rested):
    """The bases hold all that stands on them: the vertical reactions are the weight of silicone, arms and plate."""
    sim, scene = rested
    reaction = sim.joint_reaction[0, list(scene.motors), 2].sum()
    assert float(reaction) == pytest.approx((0.032 + 3 * 0.01 + 1e-6) * G, rel=1e-6)


def test_torque_is_the_derivative_of_the_energy(rested):
    """Virtual work: between equilibria sum_i tau_i d theta_i = dE, elastic and gravitational; Simpson's rule, O(d^4).

    Servo 0 turns by +-0.02 rad, then all by as much.
    """
    sim, _ = rested
    for moved in ([1.0, 0.0, 0.0], [1.0, 1.0, 1.0]):
        step = 0.02 * torch.tensor(moved, dtype=torch.float64)
        energies, powers = [], []
        for share in (-1.0, 0.0, 1.0):
            turn_to(sim, -1.0 + share * step, steps=2)
            energies.append(float(sim.energy()))
            powers.append(float(sim.joint_force[0] @ step))
        work = (powers[0] + 4.0 * powers[1] + powers[2]) / 3.0
        assert abs(work) > 1e-5  # J
        assert energies[2] - energies[0] == pytest.approx(work, rel=1e-3)
    turn_to(sim, [-1.0] * SERVOS)
