"""Cart and pole: the rigid classic, keep a hinged pole upright by pushing its cart.

Scene        scenes/cart_pole.py: 1 kg on rails, a pole of 0.1 kg hinged to it; 100 Hz control, 10 sub-steps of 1 ms
Action       discrete:   0 pushes the cart with +50 N along x, 1 with -50 N
             continuous: (1,) in [-1, 1], force per 50 N
Observation  cart x [m], cart v [m/s], angle of the pole [rad], its angular speed [rad/s]
Start        cart within 0.5 mm and 0.5 mm/s of rest in the middle, the pole within 0.05 rad and 0.05 rad/s
Reward       1 per step
Ends         terminated when the pole leans by more than 12 degrees or the cart is more than 74 cm from the middle;
             truncated after 80 actions (0.8 s)
Success      all actions survived; ``distance`` is how far the pole's centre is beside its hinge

SofaGym observes sin(angle / 2) as the angle, so that its limit of 12 degrees is one of 24, gives the pole a fiftieth of
its moment of inertia, and starts with the pole off its hinge; none of this is repeated here. ``CartPoleConfig.classic``
has the measures of Gymnasium's CartPole-v1, in which 0 pushes towards -x.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from softwarp.builder import ModelBuilder
from softwarp.envs.base import SoftEnv
from softwarp.envs.options.cart_pole import ACTION_KINDS as ACTION_KINDS
from softwarp.envs.options.cart_pole import CartPoleConfig
from softwarp.envs.scenes.cart_pole import CartPoleScene, build_cart_pole_scene

LIMITS = (10.0, 100.0, math.pi, 1000.0)  # m, m/s, rad, rad/s, bounds of observations

_STREAM_START = 0


class CartPole(SoftEnv):
    """See the table at the top of this file."""

    config: CartPoleConfig
    scene: CartPoleScene
    holds_commands = True
    viewed_from = (0.0, -0.99, 0.15)
    reward_range = (0.0, 1.0)

    @property
    def gravity(self) -> tuple[float, float, float]:
        """Acceleration of the scene [m/s^2]."""
        return self.config.gravity

    def build_scene(self, builder: ModelBuilder) -> None:
        """Cart, pole, hinge."""
        self.scene = build_cart_pole_scene(self.config, builder)

    def setup(self) -> None:
        """Views into the simulation and constants."""
        sim, config, scene = self.sim, self.config, self.scene
        pose, twist = sim.body_pose, sim.body_twist
        self._cart_x, self._cart_v = pose[:, scene.cart, 0], twist[:, scene.cart, 0]
        self._turn, self._spin = pose[:, scene.pole, 3:], twist[:, scene.pole, 4]
        self._push = sim.control.body_force[:, scene.cart, 0]
        self._rest = sim.frame_pose[:1].clone()
        spread = (config.start_x, config.start_v, config.start_angle, config.start_spin)
        self._spread = torch.tensor(spread, device=self.device)
        self._limit = torch.tensor(LIMITS, device=self.device)

    def reset_worlds(self, mask: Tensor) -> None:
        """Place cart and pole, in motion, so that they agree at the hinge."""
        u = self.draw(_STREAM_START, 4)
        x, v, angle, spin = (self._spread * (2.0 * u - 1.0)).double().unbind(dim=1)
        d, cart, pole = self.config.hinge_distance, self.scene.cart, self.scene.pole
        poses = self._rest.double().repeat(self.num_worlds, 1, 1)
        poses[:, cart, 0] = x
        poses[:, pole, 0] = x + d * angle.sin()
        poses[:, pole, 2] = self.config.hinge_height + d * angle.cos()
        poses[:, pole, 4], poses[:, pole, 6] = (0.5 * angle).sin(), (0.5 * angle).cos()
        twists = poses.new_zeros((self.num_worlds, poses.shape[1], 6))
        twists[:, cart, 0] = v
        twists[:, pole, 0] = v + d * spin * angle.cos()
        twists[:, pole, 2] = -d * spin * angle.sin()
        twists[:, pole, 4] = spin
        self.place_frames(poses, mask, twists)

    @property
    def action_size(self) -> int:
        """One force."""
        return 0 if self.config.action_kind == "discrete" else 1

    @property
    def action_count(self) -> int:
        """Push right or left."""
        return 2 if self.config.action_kind == "discrete" else 0

    def action_names(self) -> Sequence[str]:
        """Forces."""
        return ("push to +x", "push to -x") if self.action_count else ("force along x",)

    def apply_action(self, action: Tensor, substep: int) -> None:
        """Push the cart; the force holds for the whole action."""
        share = (1 - 2 * action) if self.action_count else action[:, 0].clamp(-1.0, 1.0)
        self._push.copy_(share * self.config.force)

    def observation_bounds(self) -> dict[str, tuple[Tensor, Tensor]]:
        """Finite limits far outside those of the task."""
        return {"observation": (-self._limit, self._limit)}

    def angle(self) -> Tensor:
        """Lean of the pole towards +x [rad], shape (world,)."""
        return 2.0 * torch.atan2(self._turn[:, 1], self._turn[:, 3])

    def observe(self) -> dict[str, Tensor]:
        """The state."""
        parts = (self._cart_x, self._cart_v, self.angle(), self._spin)
        return {"observation": torch.stack(parts, dim=1).float()}

    def measure_distance(self) -> Tensor:
        """Pole's centre beside its hinge [m]."""
        return self.config.hinge_distance * self.angle().float().sin().abs()

    def is_terminated(self, distance: Tensor) -> Tensor:
        """The pole has fallen or the cart has left its rails."""
        return (self.angle().abs() > self.config.max_angle) | (self._cart_x.abs() > self.config.max_x)

    def is_success(self, distance: Tensor) -> Tensor:
        """As many actions survived as the options say, whoever keeps the limit of an episode."""
        return (self.step_count >= self.config.max_episode_steps) & ~self.is_terminated(distance)

    def reward_terms(self, action: Tensor, distance: Tensor) -> dict[str, Tensor]:
        """One per step."""
        return {"alive": torch.ones_like(distance)}

    def shown_region(self) -> NDArray[np.float64]:
        """What stands on the rails, and as much of these as leaves it tall [m]; the floor lies below them."""
        config, low = self.config, -0.5 * self.config.cart_size[2]
        top = config.hinge_height + config.hinge_distance + 0.5 * config.pole_size[2]
        x = min(config.max_x + 0.5 * config.cart_size[0], top - low)
        return np.array([(-x, 0.0, low), (x, 0.0, low), (0.0, 0.0, top)])
