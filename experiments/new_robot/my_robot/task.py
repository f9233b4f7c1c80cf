"""My robot's task: bring the free end to a height.

Scene        scene.py: a bar of 120 x 20 x 20 mm along x under gravity; 20 Hz control, 5 sub-steps of 10 ms
Action       (1,) in [-1, 1]: above 0 the upper cable is pulled by up to 15 mm, below 0 the lower one
Observation  height of the end above its rest / 30 mm, its speed / 0.3 m/s, the goal / 30 mm
Goal         a height within 25 mm of rest, drawn at every reset
Reward       near: 1 / (1 + (d / 3 mm)^2), d the distance to the goal
Ends         terminated on a failed world; truncated after 50 actions (2.5 s)
Success      d below 2 mm
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor

import softwarp as sw
from softwarp.envs import EnvConfig, SoftEnv, rewards
from softwarp.envs.options import Count, Length, PlaceRange

from my_robot.scene import MyRobotSceneConfig, build_my_robot

HEIGHT, SPEED = 0.03, 0.3  # m, m/s: scales of observations


@dataclass(kw_only=True)
class MyRobotConfig(MyRobotSceneConfig, EnvConfig):
    """Options of the environment."""

    max_episode_steps: Count = 50
    goal_range: PlaceRange = (-0.025, 0.025)  # m, heights drawn at reset
    tolerance: Length = 0.002  # m, distance that counts as success


def proportional(env: Any) -> Callable[[TensorDictBase], TensorDictBase]:
    """A hand-written policy to compare with: all of a cable's pull moves the end by some 30 mm, half of it by half."""

    def policy(data: TensorDictBase) -> TensorDictBase:
        return data.set("action", data["observation"][..., 2:].clamp(-1.0, 1.0))  # the goal / 30 mm

    return policy


class MyRobot(SoftEnv):
    """All worlds step together: tensors have the world first."""

    config: MyRobotConfig
    policies: ClassVar = {"scripted": proportional}

    def build_scene(self, builder: sw.ModelBuilder) -> None:
        """Called once, when the simulation is made."""
        self.tip = build_my_robot(self.config, builder)

    def setup(self) -> None:
        """The simulation exists and has come to rest."""
        self.goal = self.add_world_state("goal", 1)  # m; saved and restored by snapshots
        self.rest = self.sim.marker_x[:, self.tip].clone()  # m, (world, 3)

    @property
    def action_size(self) -> int:
        """One number for both cables."""
        return 1

    def apply_action(self, action: Tensor, substep: int) -> None:
        """Commands for the next sub-step [m]."""
        pull = self.config.pull * action.clamp(-1.0, 1.0)
        self.sim.control.cable_displacement.copy_(torch.cat((pull, -pull), dim=1).clamp_min(0.0))

    def reset_worlds(self, mask: Tensor) -> None:
        """A new goal where the mask holds."""
        low, high = self.config.goal_range
        goal = low + (high - low) * self.draw(stream=0, count=1)
        self.goal.copy_(torch.where(mask[:, None], goal, self.goal))

    def raised(self) -> Tensor:
        """Height of the end above its rest [m], shape (world, 1)."""
        return (self.sim.marker_x[:, self.tip] - self.rest)[:, 2:]

    def goal_points(self) -> Tensor:
        """Where pictures show the goal [m], shape (world, 3)."""
        return torch.cat((self.rest[:, :2], self.rest[:, 2:] + self.goal), dim=1)

    def observation_bounds(self) -> dict[str, tuple[Tensor, Tensor]]:
        """Limits of what ``observe`` gives."""
        return {"observation": (torch.full((3,), -10.0), torch.full((3,), 10.0))}

    def observe(self) -> dict[str, Tensor]:
        """What the policy sees, of order 1."""
        speed = self.sim.marker_v[:, self.tip, 2:]
        return {"observation": torch.cat((self.raised() / HEIGHT, speed / SPEED, self.goal / HEIGHT), dim=1)}

    def measure_distance(self) -> Tensor:
        """Distance to the goal [m], shape (world,)."""
        return (self.raised() - self.goal).abs()[:, 0]

    def is_success(self, distance: Tensor) -> Tensor:
        """Whether the goal is met."""
        return distance < self.config.tolerance

    def reward_terms(self, action: Tensor, distance: Tensor) -> dict[str, Tensor]:
        """Terms of the reward, logged one by one and added."""
        return {"near": rewards.cauchy(distance, 0.003)}
