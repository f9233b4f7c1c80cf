"""Options of the scene ``scenes/cart_pole.py`` and of the task ``tasks/cart_pole.py``."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from softwarp.envs.options import (
    Count,
    Duration,
    Force,
    Gravity,
    HalfAngle,
    Length,
    Mass,
    Place,
    Positive,
    Sizes,
    Spread,
    check_choice,
    check_options,
)
from softwarp.envs.options.base import EnvConfig

ACTION_KINDS = ("discrete", "continuous")


@dataclass(kw_only=True)
class CartPoleSceneConfig:
    """Options of the scene; the defaults are SofaGym's, with the pole's true moment of inertia."""

    cart_size: Sizes = (0.10, 0.06, 0.06)  # m
    cart_mass: Mass = 1.0  # kg
    pole_size: Sizes = (0.02, 0.02, 0.25)  # m, upright
    pole_mass: Mass = 0.1  # kg
    hinge_height: Place = 0.01  # m, above the cart's middle
    hinge_distance: Length = 0.11  # m, from the hinge to the pole's centre
    gravity: Gravity = (0.0, 0.0, -9.81)  # m/s^2

    def __post_init__(self) -> None:
        """Refuse impossible values."""
        check_options(self)

    @property
    def pole_offset(self) -> float:
        """How far before the cart's middle the pole hangs [m]; it clears the cart's front by 3 mm."""
        return 0.5 * (self.cart_size[1] + self.pole_size[1]) + 0.003


@dataclass(kw_only=True)
class CartPoleConfig(CartPoleSceneConfig, EnvConfig):
    """Options of the CartPole environment."""

    dt: Duration = 0.001  # s
    action_repeat: Count = 10
    max_episode_steps: Count = 80
    settle: bool = False  # upright is no rest to settle in
    action_kind: str = "discrete"  # "discrete" or "continuous"
    force: Force = 50.0  # N, towards +x for action 0; negative turns actions around
    max_angle: Positive = math.radians(12.0)  # rad
    max_x: Length = 0.74  # m, end of the rails; SofaGym's cart may run beyond
    start_x: Spread = 0.0005  # m, all starts are drawn from +- these
    start_v: Spread = 0.0005  # m/s
    start_angle: HalfAngle = 0.05  # rad
    start_spin: Spread = 0.05  # rad/s

    def __post_init__(self) -> None:
        """Check names and ranges."""
        CartPoleSceneConfig.__post_init__(self)
        EnvConfig.__post_init__(self)
        check_choice(self, "action_kind", ACTION_KINDS)
        if self.force == 0.0:
            raise ValueError(f"CartPoleConfig: force must be finite and not 0, got {self.force!r}")

    @classmethod
    def classic(cls, **options: Any) -> CartPoleConfig:
        """Measures, starts and limits of Gymnasium's CartPole-v1; 20 ms per action, 500 actions."""
        measures: dict[str, Any] = {
            "dt": 0.002,
            "max_episode_steps": 500,
            "cart_size": (0.5, 0.3, 0.3),
            "pole_size": (0.02, 0.02, 1.0),
            "hinge_height": 0.0,
            "hinge_distance": 0.5,
            "gravity": (0.0, 0.0, -9.8),
            "force": -10.0,
            "max_x": 2.4,
            "start_x": 0.05,
            "start_v": 0.05,
        }
        return cls(**(measures | options))
