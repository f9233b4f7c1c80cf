"""Inverse control of the cup's place and axis through the grasp: contacts, with friction, are rows of the problem."""

import math

import pytest
import torch

from softwarp.control import InverseController, PointEffector
from softwarp.envs import registry
from softwarp.envs.tasks.trunk_cup import reachable_poses
from softwarp.meshing.cup_geometry import HEIGHT

ENERGY = 0.01  # prefers small tensions: with less, opposite cables pull against each other ever more


def steered(row: int, seconds: float = 4.0) -> tuple[float, float]:
    """Distance [mm] and angle [degree] to a pose of the table after some time of control at 20 Hz."""
    env = registry.make("TrunkCup", num_worlds=1, seed=0, solver_path="scalar")
    env.reset()
    pose = torch.from_numpy(reachable_poses()[0][row])
    place, axis = pose[:3], pose[3:]
    env.goal.copy_(place)
    env.goal_axis.copy_(axis)
    assert not bool(env.is_success(env.measure_distance()))
    effectors = [PointEffector(env.scene.bottom_markers), PointEffector(env.scene.rim_markers)]
    controller = InverseController(env.sim, effectors, period=env.control_dt, max_step=0.004, energy=ENERGY)
    targets = torch.stack((place - 0.5 * HEIGHT * axis, place + 0.5 * HEIGHT * axis))[None]
    for _ in range(round(seconds / env.control_dt)):
        controller.solve(targets)
        for _ in range(env.action_repeat):
            env.sim.step()
    assert not bool(env.is_dropped())
    return 1000.0 * float(env.measure_distance()), math.degrees(float(env.angle()))


@pytest.mark.parametrize("row", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
def test_cup_comes_to_place_and_axis(row):
    """Within 5 mm and 10 degrees: two points of the cup, the middles of bottom and rim, have a target each."""
    distance, angle = steered(row)
    assert distance < 5.0 and angle < 10.0
