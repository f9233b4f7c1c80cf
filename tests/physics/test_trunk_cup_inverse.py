"""Inverse control of the cup's place and axis through the grasp: contacts, with friction, are rows of the problem."""

import math

import torch

from softwarp.control import InverseController, PointEffector
from softwarp.envs import registry
from softwarp.envs.tasks.trunk_cup import TrunkCup, reachable_poses
from softwarp.meshing.cup_geometry import HEIGHT

WORLDS = 8


def test_cup_comes_to_place_and_axis() -> None:
    """Two points of the cup, the middles of bottom and rim, have a target each, none of which is met at the start.

    Six of eight poses come within 5 mm and 10 degrees in six seconds, the median within 3 mm and 3 degrees.
    """
    env = registry.make("TrunkCup", num_worlds=WORLDS, seed=0)
    assert isinstance(env, TrunkCup)
    env.reset()
    pose = torch.from_numpy(reachable_poses()[0][:WORLDS])
    place, axis = pose[:, :3], pose[:, 3:]
    env.goal.copy_(place)
    env.goal_axis.copy_(axis)
    assert not bool(env.is_success(env.measure_distance()).any())
    effectors = [PointEffector(env.scene.bottom_markers), PointEffector(env.scene.rim_markers)]
    controller = InverseController(env.sim, effectors, period=env.control_dt, **env.steering)
    targets = torch.stack((place - 0.5 * HEIGHT * axis, place + 0.5 * HEIGHT * axis), dim=1)
    for _ in range(round(6.0 / env.control_dt)):
        controller.solve(targets)
        env.sim.step(env.action_repeat)
    distance = env.measure_distance()
    assert not bool(env.is_dropped().any())
    assert int(env.is_success(distance).sum()) >= 6
    assert float(distance.median()) < 0.003 and math.degrees(float(env.angle().median())) < 3.0
