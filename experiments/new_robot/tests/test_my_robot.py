"""The environment keeps the contracts of TorchRL and Gymnasium, and the robot moves as it should."""

import gymnasium
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from torchrl.envs.utils import check_env_specs

import softwarp as sw

from my_robot import MyRobot, MyRobotConfig
from my_robot.task import proportional

sw.register("MyRobot", MyRobot)  # known already once the package is installed


@pytest.fixture(scope="module")
def env():
    return sw.make("MyRobot", num_worlds=4, seed=0)


def test_contracts(env):
    check_env_specs(env)
    check_env(gymnasium.make("softwarp/MyRobot-v0").unwrapped, skip_render_check=True)


def test_pulling_the_upper_cable_raises_the_end(env):
    data = env.reset()
    action = torch.tensor([[1.0], [1.0], [-1.0], [-1.0]])  # the upper cable in two worlds, the lower in the others
    for _ in range(10):
        data = env.step(data.set("action", action))["next"]
    raised = env.raised()[:, 0]
    assert (raised[:2] > 0.01).all() and (raised[2:] < -0.01).all()


def test_hand_written_policy_comes_near(env):
    rollout = env.rollout(MyRobotConfig().max_episode_steps, proportional(env), break_when_any_done=False)
    assert rollout["next", "distance"][:, -1].max() < 0.004
