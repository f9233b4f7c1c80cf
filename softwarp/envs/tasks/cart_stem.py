"""Cart and stem: keep a heavy sphere on a flexible stem above the cart that carries it.

Scene        scenes/cart_stem.py: a 160 kg cart on rails, a massless stem of one section, 0.75 kg at its tip; 10 Hz
             control, 10 sub-steps of 10 ms
Action       discrete:   0 pushes the cart with +10 N along x, 1 with -10 N
             continuous: (1,) in [-1, 1], force per 10 N
Observation  scaled: cart x / 0.2 m, (tip x - cart x) / 0.02 m, cart v / 0.1 m/s, (tip v - cart v) / 0.02 m/s
             paper:  cart x, tip x [cm], cart v, tip v [cm/s]
Start        cart x uniform in +-5 cm, the stem bent by a uniform curvature in +-0.12 1/m (tip up to 3.7 mm aside)
Reward       paper:  1 per step;  shaped: 1 - 0.5 (offset / 5 cm)^2 - 0.1 (cart x / 40 cm)^2
Ends         terminated when the tip is more than 5 cm beside the cart, or the cart more than 40 cm from the middle;
             truncated after 80 actions (8 s)
Success      80 actions survived, return 80; ``distance`` is |tip x - cart x|

The tip's weight, 7.36 N, is above the 6.36 N under which the stem buckles, so upright is unstable: left alone it falls
with a rate of 0.69 1/s, slowly because of its damping. Ten newtons save it from up to 10 mm beside the cart, no more.

SofaGym kicks the stem by a rest curvature in the first sub-step, drawn from a global generator; here the curvature that
this gives, up to 0.24 1/m, is drawn itself. The default takes half of that range: of the whole, 7 % of the starts are
lost whatever the forces, as the cart runs out of rails before it has caught the sphere (linear programming on the
linearised system). ``CartStemConfig.paper`` keeps the range; ``CartStemConfig.hard`` is a rod of eight sections with
mass and a tenth of the damping.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from softwarp.builder import ModelBuilder
from softwarp.envs import randomization
from softwarp.envs.base import SoftEnv
from softwarp.envs.options.cart_stem import ACTION_KINDS as ACTION_KINDS
from softwarp.envs.options.cart_stem import OBSERVATION_KINDS as OBSERVATION_KINDS
from softwarp.envs.options.cart_stem import REWARD_KINDS as REWARD_KINDS
from softwarp.envs.options.cart_stem import CartStemConfig
from softwarp.envs.scenes.cart_stem import CartStemScene, arc_poses, build_cart_stem_scene

SCALES = (0.2, 0.02, 0.1, 0.02)  # m, m, m/s, m/s worth 1 in a scaled observation
SCALED_LIMIT = 10.0
PAPER_LIMIT = 100.0  # cm, cm/s

_STREAM_START = 0
_CENTIMETRE = 0.01  # m


class CartStem(SoftEnv):
    """See the table at the top of this file."""

    config: CartStemConfig
    scene: CartStemScene
    holds_commands = True
    viewed_from = (0.0, -0.99, 0.15)
    reward_range = (0.0, 1.0)

    @property
    def gravity(self) -> tuple[float, float, float]:
        """Acceleration of the scene [m/s^2]."""
        return self.config.gravity

    def build_scene(self, builder: ModelBuilder) -> None:
        """Cart, stem, sphere."""
        self.scene = build_cart_stem_scene(self.config, builder)

    def setup(self) -> None:
        """Views into the simulation and constants."""
        sim, config = self.sim, self.config
        cart = self.scene.cart
        self._cart_x, self._cart_v = sim.body_pose[:, cart, 0], sim.body_twist[:, cart, 0]
        self._tip_x, self._tip_v = sim.rod_x[:, -1, 0], sim.rod_v[:, -1, 0]
        self._push = sim.control.body_force[:, cart, 0]
        # Frames are cart, sphere, then the stem's nodes.
        s = torch.linspace(0.0, config.length, config.sections + 1, dtype=torch.float64, device=self.device)
        self._arc_length = torch.cat((s.new_tensor([0.0, config.length]), s))
        limit = PAPER_LIMIT if config.observation == "paper" else SCALED_LIMIT
        self._limit = torch.full((4,), limit, device=self.device)
        self._scale = 1.0 / torch.tensor(SCALES, device=self.device)

    def reset_worlds(self, mask: Tensor) -> None:
        """Place the cart and bend the stem."""
        config = self.config
        x, k = config.start_x, config.start_curvature
        u = self.draw(_STREAM_START, 2).double()
        cart_x, curvature = randomization.in_range(u[:, 0], (-x, x)), randomization.in_range(u[:, 1], (-k, k))
        self.place_frames(arc_poses(cart_x, curvature, self._arc_length), mask)

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
        if self.action_count:
            self._push.copy_((1 - 2 * action) * self.config.force)
        else:
            self._push.copy_(action[:, 0].clamp(-1.0, 1.0) * self.config.force)

    def observation_bounds(self) -> dict[str, tuple[Tensor, Tensor]]:
        """The same symmetric limit for every entry."""
        return {"observation": (-self._limit, self._limit)}

    def observe(self) -> dict[str, Tensor]:
        """The kind that was asked for."""
        x, v = self._cart_x, self._cart_v
        if self.config.observation == "paper":
            return {"observation": torch.stack((x, self._tip_x, v, self._tip_v), dim=1).float() / _CENTIMETRE}
        parts = torch.stack((x, self._tip_x - x, v, self._tip_v - v), dim=1)
        return {"observation": parts.float() * self._scale}

    def decode(self, observation: Tensor) -> Tensor:
        """Cart x, offset of the tip [m], their speeds [m/s], of observations of either kind, shape (..., 4)."""
        if self.config.observation == "scaled":
            return observation / self._scale
        x, tip, v, tip_v = (_CENTIMETRE * observation).unbind(dim=-1)
        return torch.stack((x, tip - x, v, tip_v - v), dim=-1)

    def measure_distance(self) -> Tensor:
        """Tip beside the cart [m]."""
        return (self._tip_x - self._cart_x).abs().float()

    def is_terminated(self, distance: Tensor) -> Tensor:
        """The sphere has fallen or the cart has left its rails."""
        return (distance > self.config.max_offset) | (self._cart_x.abs() > self.config.max_x)

    def is_success(self, distance: Tensor) -> Tensor:
        """As many actions survived as the options say, whoever keeps the limit of an episode."""
        return (self.step_count >= self.config.max_episode_steps) & ~self.is_terminated(distance)

    def reward_terms(self, action: Tensor, distance: Tensor) -> dict[str, Tensor]:
        """See the table at the top."""
        terms = {"alive": torch.ones_like(distance)}
        if self.config.reward == "shaped":
            terms["upright"] = -0.5 * (distance / self.config.max_offset).square()
            terms["centred"] = -0.1 * (self._cart_x.float() / self.config.max_x).square()
        return terms

    def shown_region(self) -> NDArray[np.float64]:
        """What stands on the rails, and as much of these as leaves it tall [m]; the floor lies below them."""
        config = self.config
        low, top = -0.5 * config.cart_size[2], config.length + config.sphere_radius
        x = min(config.max_x + 0.5 * config.cart_size[0], top - low)
        return np.array([(-x, 0.0, low), (x, 0.0, low), (0.0, 0.0, top)])
