"""Inverse control of the tripod: tilts and heights to servo angles, their limits and rates, and paths."""

import math

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp.control import Outcome, TargetPath, TiltController, follow
from softwarp.envs.options.tripod import TripodSceneConfig
from softwarp.envs.scenes.tripod import build_tripod_scene, set_up

PERIOD, SUBSTEPS = 0.05, 5
WORK = -1.0  # rad, equal angles in the middle of the servos' range: the plate is 46 mm high


def tripod(num_worlds=1, **options):
    """The tripod at rest with its plate level, and its control."""
    config = TripodSceneConfig(**({"angle": WORK} | options))
    builder = sw.ModelBuilder(gravity=config.gravity)
    scene = build_tripod_scene(config, builder)
    sim = sw.Simulation(builder.finalize(num_worlds), 0.01)
    set_up(sim, scene, config)
    sim.step(60)
    return sim, TiltController(sim, scene.plate, scene.middle, period=PERIOD, share=0.7), config


def normals(tilts):
    """Normals of plates that are turned by rotation vectors in the horizontal plane [rad], (world, 3)."""
    angle = tilts.norm(dim=1, keepdim=True)
    axis = tilts / angle
    level = torch.stack((axis[:, 1], -axis[:, 0]), dim=1)  # axis x z
    return torch.cat((level * angle.sin(), angle.cos()), dim=1)


def test_tilts_and_heights_are_reached():
    """16 at random, up to 0.3 rad and +-5 mm: within 1 mrad and 0.02 mm after a second, at rest, as it is told."""
    sim, steering, config = tripod(16)
    draw = torch.rand((16, 3), generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    wished = normals(0.3 * draw[:, :1] * torch.stack([(6.28 * draw[:, 1]).cos(), (6.28 * draw[:, 1]).sin()], dim=1))
    height = 0.043 + 0.010 * (draw[:, 2] - 0.5)
    targets = torch.cat((wished, height[:, None]), dim=1)
    for _ in range(20):
        solution = steering.solve(targets)
        sim.step(SUBSTEPS)
    tilt = torch.linalg.cross(steering.normal(), wished).norm(dim=1)
    assert tilt.max() < 1e-3 and (steering.height() - height).abs().max() < 2e-5
    assert (solution.outcome == Outcome.REACHED).all()
    assert sim.node_v.abs().max() < 2e-3
    low, high = config.min_angle, config.max_angle
    assert ((sim.joint_position > low) & (sim.joint_position < high)).all()


def test_level_needs_equal_angles():
    """A level plate at a height has one answer, which symmetry makes equal: that of the angles it was measured at."""
    sim, steering, _ = tripod()
    height = float(steering.height())
    sim.control.joint_target[:] = torch.tensor([[WORK + 0.3, WORK - 0.2, WORK - 0.1]])
    sim.step(60)
    assert 1.0 - float(steering.normal()[0, 2]) > 5e-3
    targets = torch.tensor([[0.0, 0.0, 1.0, height]])
    for _ in range(20):
        steering.solve(targets)
        sim.step(SUBSTEPS)
    np.testing.assert_allclose(sim.joint_position[0], WORK, atol=5e-3)


def test_limits_and_rates():
    """No command leaves the limits or outruns the servos, and a tilt of a radian is told to be out of reach."""
    sim, steering, config = tripod(max_speed=2.0)
    targets = torch.tensor([[math.sin(1.0), 0.0, math.cos(1.0), 0.043]])
    before, outcomes = steering.controller.present(), []
    for _ in range(60):
        solution = steering.solve(targets)
        outcomes.append(int(solution.outcome[0]))
        assert (solution.command - before).abs().max() <= 2.0 * PERIOD + 1e-6
        before = solution.command.clone()
        sim.step(SUBSTEPS)
    low, high = config.min_angle, config.max_angle
    assert before.min() >= low - 1e-6 and before.max() <= high + 1e-6
    assert outcomes[0] == Outcome.MOVING and outcomes[-1] == Outcome.UNREACHABLE
    assert sim.joint_force.abs().max() <= config.max_torque * (1.0 + 1e-5)
    assert float(steering.normal()[0, 0]) > 0.2  # as far as it goes


def test_paths_are_followed_and_can_be_played_again():
    """A circle of 0.2 rad in 4 s, 10 mrad late at most at its end; the same commands give the same motion."""
    times = np.linspace(0.0, 4.0, 81)
    turn = 2.0 * math.pi * times / 4.0
    lift = np.full_like(times, 0.044)
    path = TargetPath(times, np.column_stack([0.2 * np.cos(turn), 0.2 * np.sin(turn), np.ones_like(times), lift]))
    sim, steering, _ = tripod()
    follow(steering, TargetPath([0.0], path.targets[:1]), settle=1.0)
    start = sim.snapshot()
    followed = follow(steering, path)
    end = steering.normal()[0].clone()
    np.testing.assert_allclose(end / end[2], [0.2, 0.0, 1.0], atol=1e-2)
    assert followed.commands.shape == (81, 1, 3) and followed.unreached.max() == 0.0
    np.testing.assert_allclose(followed.times, times, atol=1e-9)
    fresh, again, _ = tripod()
    fresh.restore(start)
    for row, following in zip(followed.commands, followed.commands[1:], strict=False):
        for step in range(SUBSTEPS):
            again.controller.write(torch.from_numpy(row + (following - row) * (step + 1) / SUBSTEPS))
            fresh.step()
    np.testing.assert_allclose(again.normal()[0], end, atol=1e-5)


def test_mistakes_are_told():
    """Targets of another shape, paths whose times do not rise, periods that are no number of steps."""
    sim, steering, _ = tripod()
    with pytest.raises(ValueError, match=r"targets must have shape \(1, 4\), normal and height, got \(1, 3\)"):
        steering.solve(torch.zeros((1, 3)))
    with pytest.raises(ValueError, match="times must rise from 0"):
        TargetPath([0.0, 0.0], np.zeros((2, 4)))
    odd = TiltController(sim, steering.frame, steering.marker, period=0.013)
    with pytest.raises(ValueError, match=r"a whole number of steps of 0.01 s, got 0.013 s"):
        follow(odd, TargetPath([0.0], [[0.0, 0.0, 1.0, 0.043]]))
