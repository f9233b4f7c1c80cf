"""Cart, stem and obstacles: bring the stem's tip to a place that can be reached only by leaning on an obstacle.

Scene        scenes/cart_stem_contact.py: a cart moved at up to 2 cm/s carries a stiff stem between two diamond-shaped
             obstacles, friction 0.8; 3.3 Hz control, 30 sub-steps of 10 ms
Action       absolute:   (1,) in [-1, 1], place for the cart to go to, per max_move
             continuous: (1,) in [-1, 1], speed of the cart per 2 cm/s
             discrete:   7 choices, from left to right at 1, 1/5, 1/25 of that speed, hold, and 1/25, 1/5, 1
Observation  scaled: 7 numbers of order 1: cart x, tip x, obstacles' x, goal x [5 cm], goal x - tip x [2 cm], the same
             as e / (|e| + 3 mm), which still tells millimetres apart
             paper:  cart x, tip x, obstacles' x, their half sizes (3,), goal x [cm]
Start        obstacles at x in [-6, -4] and [4, 6] cm, the cart anywhere from which the upright stem touches neither
Goal         tip x, for either obstacle with probability 1/2: from its centre to 3.5 cm towards the middle
Reward       -min(|tip x - goal x|, max_move) / max_move, in [-1, 0]
Ends         at success, and on a failed world; truncated after 30 actions (9 s)
Success      |tip x - goal x| < 1.5 mm

The cart keeps within max_move, 1 cm beyond the centre of the farther obstacle, on either side. The stem is stopped by
an obstacle 2.9 cm before its centre, so most goals lie behind: the cart has to drive *away* from such a goal until the
opposite obstacle bends the stem back over it. What moves the tip towards the goal at every moment, as local inverse
control does, gets stuck at the near obstacle. With more ``sections`` the stem is straight beyond the contact, and the
deepest goals are out of its reach.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from softwarp.builder import ModelBuilder, Precision
from softwarp.envs import randomization
from softwarp.envs.base import SoftEnv
from softwarp.envs.options.cart_stem_contact import ACTION_KINDS as ACTION_KINDS
from softwarp.envs.options.cart_stem_contact import GOAL_KINDS as GOAL_KINDS
from softwarp.envs.options.cart_stem_contact import OBSERVATION_KINDS as OBSERVATION_KINDS
from softwarp.envs.options.cart_stem_contact import CartStemContactConfig
from softwarp.envs.scenes.cart_stem_contact import (
    CartStemContactScene,
    build_cart_stem_contact_scene,
)
from softwarp.simulation import Simulation

DISCRETE_SPEEDS = (-1.0, -0.2, -0.04, 0.0, 0.04, 0.2, 1.0)  # per max_speed
SCALES = (0.05, 0.05, 0.05, 0.05, 0.05, 0.02)  # m worth 1: cart, tip, two obstacles, goal, error
FINE_ERROR = 0.003  # m
SCALED_LIMIT = 10.0
PAPER_LIMIT = 50.0  # cm
BENCHMARK = (-0.05, 0.05, 0.0, 0.045)  # m: obstacles, cart, and a goal behind the right obstacle

_STREAM_START = 0
_CENTIMETRE = 0.01  # m
_GOAL_HEIGHT = 0.20  # m, where pictures show the goal


class CartStemContact(SoftEnv):
    """See the table at the top of this file."""

    config: CartStemContactConfig
    scene: CartStemContactScene
    holds_commands = True
    viewed_from = (0.0, -0.99, 0.15)
    reward_range = (-1.0, 0.0)
    goal_axes = "x"  # for inverse control
    steering: ClassVar[dict[str, Any]] = {"share": 1.0}  # likewise: the stem is stiff, the cart slow

    @property
    def gravity(self) -> tuple[float, float, float]:
        """Acceleration of the scene [m/s^2]."""
        return self.config.gravity

    @property
    def contact_capacity(self) -> int:
        """Two or three pieces of the stem touch at a time."""
        return 8

    def build_scene(self, builder: ModelBuilder) -> None:
        """Cart, stem, obstacles."""
        self.scene = build_cart_stem_contact_scene(self.config, builder)

    def setup(self) -> None:
        """Allocate goals and take views into the simulation."""
        sim, config, scene = self.sim, self.config, self.scene
        self.goal_x = self.add_world_state("goal_x")
        self.obstacles = self.add_world_state("obstacles", 2)
        self.max_move = self.add_world_state("max_move")
        self._cart_x, self._tip_x = sim.body_pose[:, scene.cart, 0], sim.rod_x[:, -1, 0]
        self._velocity = sim.control.body_velocity[:, scene.cart, 0]
        self._rest = sim.frame_pose[:1].clone()
        stands = torch.ones(self._rest.shape[1], dtype=self._rest.dtype, device=self.device)
        stands[list(scene.obstacles)] = 0.0
        self._moves_with_cart = stands  # 1 for frames that stand on the cart, (frame,)
        limit = PAPER_LIMIT if config.observation == "paper" else SCALED_LIMIT
        self._limit = torch.full((8 if config.observation == "paper" else 7,), limit, device=self.device)
        self._scale = 1.0 / torch.tensor(SCALES, device=self.device)
        self._choices = torch.tensor(DISCRETE_SPEEDS, device=self.device)
        half = 0.5 * torch.tensor(config.obstacle_size, device=self.device)
        self._half_sizes = half.expand(self.num_worlds, 3)
        self._twin: Simulation | None = None

    def reset_worlds(self, mask: Tensor) -> None:
        """Draw obstacles, cart and goal."""
        u = self.draw(_STREAM_START, 5)
        if self.config.goals == "benchmark":
            left, right, cart, goal = (u.new_full((self.num_worlds,), x) for x in BENCHMARK)
        else:
            left = -randomization.in_range(u[:, 0], self.config.obstacle_x)
            right = randomization.in_range(u[:, 1], self.config.obstacle_x)
            low, high = left + self.config.clearance, right - self.config.clearance
            cart = low + (high - low) * u[:, 2]
            goal = self._draw_goal(u[:, 3:], left, right)
        torch.where(mask[:, None], torch.stack((left, right), dim=1), self.obstacles, out=self.obstacles)
        torch.where(mask, goal, self.goal_x, out=self.goal_x)
        limit = torch.maximum((left - _CENTIMETRE).abs(), right + _CENTIMETRE)
        torch.where(mask, limit, self.max_move, out=self.max_move)

        poses = self._rest.repeat(self.num_worlds, 1, 1)
        poses[:, :, 0] += cart[:, None] * self._moves_with_cart
        for obstacle, x in zip(self.scene.obstacles, (left, right), strict=True):
            poses[:, obstacle, 0] = x
        self.place_frames(poses, mask)

    def _draw_goal(self, u: Tensor, left: Tensor, right: Tensor) -> Tensor:
        """Tip places [m] at the left or right obstacle, from uniform numbers (world, 2)."""
        config = self.config
        depth = {
            "random": (0.0, config.goal_depth),
            "behind": (0.0, min(config.reach, config.goal_depth)),
            "open": (config.reach, config.goal_depth),
        }[config.goals]
        inwards = randomization.in_range(u[:, 1], depth)
        return torch.where(u[:, 0] < 0.5, left + inwards, right - inwards)

    def is_behind(self) -> Tensor:
        """Whether the goal is one that the upright stem cannot reach, bool (world,)."""
        near = torch.minimum(self.goal_x - self.obstacles[:, 0], self.obstacles[:, 1] - self.goal_x)
        return near < self.config.reach

    @property
    def action_size(self) -> int:
        """One place or speed."""
        return 0 if self.config.action_kind == "discrete" else 1

    @property
    def action_count(self) -> int:
        """Seven speeds."""
        return len(DISCRETE_SPEEDS) if self.config.action_kind == "discrete" else 0

    def action_names(self) -> Sequence[str]:
        """The cart's place or speed."""
        if self.action_count:
            return [f"{speed:g} of the largest speed" for speed in DISCRETE_SPEEDS]
        return ("place",) if self.config.action_kind == "absolute" else ("speed",)

    def apply_action(self, action: Tensor, substep: int) -> None:
        """Move the cart at a constant speed, never beyond its limits."""
        speed = self.config.max_speed
        if self.config.action_kind == "absolute":
            target = action[:, 0].clamp(-1.0, 1.0) * self.max_move
        else:
            share = self._choices[action] if self.action_count else action[:, 0].clamp(-1.0, 1.0)
            target = self._cart_x + share * speed * self.control_dt
            target = torch.minimum(torch.maximum(target, -self.max_move), self.max_move)
        self._velocity.copy_(((target - self._cart_x) / self.control_dt).clamp(-speed, speed))

    def action_for(self, command: Tensor) -> Tensor:
        """The action that takes the cart nearest to a place [m], shape (world, 1); for inverse control."""
        place = command[:, 0].to(torch.float32)
        if self.config.action_kind == "absolute":
            return (place / self.max_move).clamp(-1.0, 1.0)[:, None]
        share = (place - self._cart_x) / (self.config.max_speed * self.control_dt)
        if self.config.action_kind == "continuous":
            return share.clamp(-1.0, 1.0)[:, None]
        return (share[:, None] - self._choices).abs().argmin(dim=1)

    @property
    def tip_markers(self) -> tuple[int, ...]:
        """Marker of ``steered()`` that is to come to the goal."""
        return (0,)

    def steered(self) -> Simulation:
        """A twin whose cart has a motor, in the present state; the cart itself moves as told, without any effort."""
        if self._twin is None:
            builder = ModelBuilder(gravity=self.gravity)
            scene = build_cart_stem_contact_scene(self.config, builder, motor=True)
            builder.add_marker(scene.tip, (0.0, 0.0, self.config.length))
            precision = cast("Precision", self.config.precision)
            near = 2 * self.config.sections * self.config.contact_pieces  # all of the stem, in an action of 0.3 s
            model = builder.finalize(self.num_worlds, str(self.device), precision, near)
            self._twin = Simulation(model, self.config.dt)
        sim, own = self._twin, self.sim
        sim.frame_pose.copy_(own.frame_pose)
        sim.frame_twist.copy_(own.frame_twist)
        for view in (sim.held_pose, sim.seen_pose, sim.control.body_pose):
            view.copy_(own.frame_pose[:, : sim.model.rigid_count])
        sim.refresh()
        return sim

    def observation_bounds(self) -> dict[str, tuple[Tensor, Tensor]]:
        """The same symmetric limit for every entry."""
        return {"observation": (-self._limit, self._limit)}

    def observe(self) -> dict[str, Tensor]:
        """The kind that was asked for."""
        cart, tip = self._cart_x.float(), self._tip_x.float()
        left, right = self.obstacles.unbind(dim=1)
        if self.config.observation == "paper":
            parts = (torch.stack((cart, tip, left, right), dim=1), self._half_sizes, self.goal_x[:, None])
            return {"observation": torch.cat(parts, dim=1) / _CENTIMETRE}
        error = self.goal_x - tip
        scaled = torch.stack((cart, tip, left, right, self.goal_x, error), dim=1) * self._scale
        return {"observation": torch.cat((scaled, (error / (error.abs() + FINE_ERROR))[:, None]), dim=1)}

    def decode(self, observation: Tensor) -> Tensor:
        """Cart x, tip x, obstacles' x, goal x [m], of observations of either kind, shape (..., 5)."""
        if self.config.observation == "paper":
            return observation[..., [0, 1, 2, 3, 7]] * _CENTIMETRE
        return observation[..., :5] / self._scale[:5]

    def measure_distance(self) -> Tensor:
        """Tip beside the goal [m]."""
        return (self._tip_x.float() - self.goal_x).abs()

    def is_success(self, distance: Tensor) -> Tensor:
        """Within the tolerance."""
        return distance < self.config.success_tolerance

    def reward_terms(self, action: Tensor, distance: Tensor) -> dict[str, Tensor]:
        """See the table at the top."""
        return {"distance": -torch.minimum(distance, self.max_move) / self.max_move.clamp_min(_CENTIMETRE)}

    def goal_points(self) -> Tensor:
        """The goal at a fixed height, for pictures and files [m], (world, 3)."""
        zero = torch.zeros_like(self.goal_x)
        return torch.stack((self.goal_x, zero, zero + _GOAL_HEIGHT), dim=1)

    def shown_region(self) -> NDArray[np.float64]:
        """Everything, the cart on the floor [m]."""
        config = self.config
        x, low = config.obstacle_x[1] + config.half_diagonal, -0.5 * config.cart_size[2]
        y = 0.5 * config.cart_size[1]  # towards the eye
        return np.array([(-x, -y, low), (x, -y, low), (0.0, 0.0, config.length + config.radius)])
