"""Stem pendulum: swing a soft rod up and keep it upright, by a weak motor at its root.

Scene        scenes/stem_pendulum.py: a rod of 10 cm and 1.26 kg with E = 300 kPa; 10 Hz control, 20 sub-steps of 5 ms
Action       (1,) in [-1, 1] -> torque at the root, +-0.25 N m, reached in 20 equal increments
Observation  state: cos and sin of the root, its speed / 30 rad/s, tip x, z / L, tip vx, vz / 3 m/s, torque and the
                    moment of the spring, both / max torque
             paper: quaternion z and w of the root, its speed / 30 rad/s, tip x and z / L
Start        straight and at rest at any angle; a spring of 0.03 N m/rad pulls the root back to it
Reward       height: -d / (2 L), d from the tip to the point L above the root, in [-1, 0]
Ends         never before truncation after 50 actions (5 s)
Success      the tip has been above 0.9 L on average over the last 10 actions

Gravity turns the level rod with 0.62 N m. SofaGym's motor has 0.05 N m, with which the start decides: it cannot swing
the rod up from below, as the damping of backward Euler eats what it adds. ``StemPendulumConfig.paper`` keeps it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from softwarp.builder import ModelBuilder
from softwarp.envs import randomization
from softwarp.envs.base import SoftEnv
from softwarp.envs.options.stem_pendulum import OBSERVATION_KINDS as OBSERVATION_KINDS
from softwarp.envs.options.stem_pendulum import StemPendulumConfig
from softwarp.envs.scenes.stem_pendulum import PendulumScene, build_pendulum_scene, straight_poses
from softwarp.envs.sums import length_of, mean_of

SPIN, SPEED = 30.0, 3.0  # rad/s, m/s worth 1 in an observation
LIMIT = 2.0  # of observations
AVERAGED = 10  # actions over which success looks at the tip's height

_STREAM_ANGLE = 0


class StemPendulum(SoftEnv):
    """See the table at the top of this file."""

    config: StemPendulumConfig
    scene: PendulumScene
    viewed_from = (0.0, -0.99, 0.15)
    reward_range = (-1.0, 0.0)

    @property
    def gravity(self) -> tuple[float, float, float]:
        """Acceleration of the scene [m/s^2]."""
        return self.config.gravity

    def build_scene(self, builder: ModelBuilder) -> None:
        """Rod and hinge."""
        self.scene = build_pendulum_scene(self.config, builder)

    def setup(self) -> None:
        """Views into the simulation, torque, past heights, constants."""
        config, sim, device = self.config, self.sim, self.device
        hinge = self.scene.hinge
        self._angle, self._spin = sim.joint_position[:, hinge], sim.joint_velocity[:, hinge]
        self._reference, self._target = sim.joint_reference[:, hinge], sim.control.joint_target[:, hinge]
        self._motor = sim.control.joint_force[:, hinge]
        self._tip, self._tip_v = sim.rod_x[:, -1], sim.rod_v[:, -1]
        self.torque = self.add_world_state("torque", dtype=self._motor.dtype)  # N m, commanded
        self.heights = self.add_world_state("heights", AVERAGED)  # m, of the tip after the last actions, in a ring
        self._ramp = torch.zeros((self.num_worlds, config.action_repeat), dtype=self._motor.dtype, device=device)
        self._share = torch.arange(1, config.action_repeat + 1, dtype=self._motor.dtype, device=device)
        self._share /= config.action_repeat
        self._arc_length = torch.linspace(0.0, config.length, config.segments + 1, dtype=torch.float64, device=device)
        self._top = torch.tensor((0.0, 0.0, config.length), dtype=self._tip.dtype, device=device)
        self._slots = torch.arange(AVERAGED, device=device)
        self._limit = torch.full((9 if config.observation == "state" else 5,), LIMIT, device=device)

    def reset_worlds(self, mask: Tensor) -> None:
        """Turn the rod to its start, where its spring is at rest."""
        angle = randomization.in_range(self.draw(_STREAM_ANGLE, 1)[:, 0].double(), self.config.start_angle)
        mask = self.place_frames(straight_poses(angle, self._arc_length), mask)
        for view in (self._angle, self._reference, self._target):
            view.copy_(torch.where(mask, angle.to(view.dtype), view))
        self.torque.masked_fill_(mask, 0.0)
        self.heights.masked_fill_(mask[:, None], -self.config.length)

    @property
    def action_size(self) -> int:
        """One torque."""
        return 1

    def action_names(self) -> Sequence[str]:
        """Of the motor."""
        return ("torque",)

    def apply_action(self, action: Tensor, substep: int) -> None:
        """Move the torque towards what the action asks for."""
        if substep == 0:
            target = self.config.max_torque * action.clamp(-1.0, 1.0).to(self.torque.dtype)
            start = self.torque[:, None]
            torch.add(start, (target - start) * self._share, out=self._ramp)
            self.torque.copy_(target[:, 0])
        self._motor.copy_(self._ramp[:, substep])

    def observation_bounds(self) -> dict[str, tuple[Tensor, Tensor]]:
        """The same symmetric limit for every entry."""
        return {"observation": (-self._limit, self._limit)}

    def observe(self) -> dict[str, Tensor]:
        """The kind that was asked for."""
        length = self.config.length
        spin, x, z = self._spin / SPIN, self._tip[:, 0] / length, self._tip[:, 2] / length
        if self.config.observation == "paper":
            half = 0.5 * (self._angle + 0.5 * math.pi)  # SofaGym's angle is 0 where the rod points along +x
            parts: tuple[Tensor, ...] = (half.sin(), half.cos(), spin, x, z)
        else:
            vx, vz = self._tip_v[:, 0] / SPEED, self._tip_v[:, 2] / SPEED
            torque = self.torque / self.config.max_torque
            spring = self.config.root_stiffness / self.config.max_torque * (self._target - self._angle)
            parts = (self._angle.cos(), self._angle.sin(), spin, x, z, vx, vz, torque, spring)
        return {"observation": torch.stack(parts, dim=1).float()}

    def measure_distance(self) -> Tensor:
        """Tip to the point a rod's length above the root [m]."""
        return length_of(self._tip - self._top).float()

    def is_success(self, distance: Tensor) -> Tensor:
        """High on average, for as long as success looks back."""
        enough: Tensor = mean_of(self.heights) > self.config.success_height * self.config.length
        return enough

    def reward_terms(self, action: Tensor, distance: Tensor) -> dict[str, Tensor]:
        """See the table at the top; the tip's height is noted on the way."""
        now = self._slots == (self.step_count % AVERAGED)[:, None]
        torch.where(now, self._tip[:, 2:].float(), self.heights, out=self.heights)
        return {"height": distance / (-2.0 * self.config.length)}

    def decode(self, observation: Tensor) -> Tensor:
        """Angle of the tip [rad], 0 upright, its speed [rad/s], torque and spring / max torque, shape (..., 4)."""
        if self.config.observation != "state":
            raise ValueError(f"decode needs observation='state', this StemPendulum has {self.config.observation!r}")
        x, z = observation[..., 3], observation[..., 4]
        vx, vz = (SPEED / self.config.length) * observation[..., 5], (SPEED / self.config.length) * observation[..., 6]
        spin = (x * vz - z * vx) / (x.square() + z.square())
        return torch.stack((torch.atan2(-x, z), spin, observation[..., 7], observation[..., 8]), dim=-1)

    def goal_points(self) -> Tensor:
        """Where the tip should be, for pictures [m], (world, 3)."""
        return self._top.expand(self.num_worlds, 3)

    def shown_region(self) -> NDArray[np.float64]:
        """The disc that the rod can reach [m]."""
        reach, turn = self.config.length + self.config.radius, np.linspace(0.0, 2.0 * np.pi, 24)
        return reach * np.stack([np.cos(turn), np.zeros_like(turn), np.sin(turn)], axis=1)
