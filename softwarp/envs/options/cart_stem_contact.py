"""Options of the scene ``scenes/cart_stem_contact.py`` and of the task ``tasks/cart_stem_contact.py``."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from softwarp.envs.options import (
    Count,
    Distance,
    Length,
    LengthRange,
    Modulus,
    NotNegative,
    Pieces,
    Sizes,
    Speed,
    check_choice,
)
from softwarp.envs.options.base import EnvConfig
from softwarp.envs.options.cart_stem import StemConfig

ACTION_KINDS = ("absolute", "continuous", "discrete")
OBSERVATION_KINDS = ("scaled", "paper")
GOAL_KINDS = ("random", "behind", "open", "benchmark")


@dataclass(kw_only=True)
class CartStemContactSceneConfig(StemConfig):
    """Options of the scene; the defaults are SofaGym's."""

    youngs: Modulus = 10.0e9  # Pa
    skin: Length = 0.001  # m, radius of the stem for contact and pictures
    contact_pieces: Pieces = 20  # straight pieces per section that contact sees
    mu: NotNegative = 0.8  # friction of stem and obstacles
    obstacle_size: Sizes = (0.04, 0.02, 0.04)  # m, before the turn
    obstacle_height: Length = 0.12  # m, of the obstacles' centres
    max_speed: Speed = 0.02  # m/s, of the cart

    @property
    def half_diagonal(self) -> float:
        """From an obstacle's centre to its edge [m]."""
        return (self.obstacle_size[0] + self.obstacle_size[2]) / (2.0 * math.sqrt(2.0))


@dataclass(kw_only=True)
class CartStemContactConfig(CartStemContactSceneConfig, EnvConfig):
    """Options of the CartStemContact environment."""

    action_repeat: Count = 30
    max_episode_steps: Count = 30
    settle: bool = False  # the upright stem is at rest
    end_on_success: bool = True
    action_kind: str = "absolute"  # "absolute", "continuous" or "discrete"
    observation: str = "scaled"  # "scaled" or "paper"
    goals: str = "random"  # "random"; "behind" or "open": only those; "benchmark": one case, behind the right obstacle
    success_tolerance: Length = 0.0015  # m
    obstacle_x: LengthRange = (0.04, 0.06)  # m, distances of the obstacles from the middle are drawn from this
    goal_depth: Distance = 0.035  # m, goals reach from an obstacle's centre so far towards the middle
    clearance: Length = 0.03  # m, least distance of the cart's start from an obstacle's centre

    def __post_init__(self) -> None:
        """Check names and ranges."""
        CartStemContactSceneConfig.__post_init__(self)
        EnvConfig.__post_init__(self)
        check_choice(self, "action_kind", ACTION_KINDS)
        check_choice(self, "observation", OBSERVATION_KINDS)
        check_choice(self, "goals", GOAL_KINDS)
        if not 0.0 < self.clearance < self.obstacle_x[0] <= self.obstacle_x[1]:
            raise ValueError(
                "CartStemContactConfig: obstacle_x must be (low, high) with clearance < low <= high, got "
                f"{self.obstacle_x} and clearance {self.clearance!r}"
            )
        if self.clearance <= self.reach:
            raise ValueError(
                f"CartStemContactConfig: clearance must be more than {self.reach:.4g} m, at which the stem touches an "
                f"obstacle, got {self.clearance!r}"
            )
        if self.goal_depth <= self.reach and self.goals == "open":
            raise ValueError(f"CartStemContactConfig: goal_depth must be more than {self.reach:.4g} m for open goals")

    @property
    def reach(self) -> float:
        """How near to an obstacle's centre the upright stem can come [m]."""
        return self.half_diagonal + self.skin

    @classmethod
    def paper(cls, **options: Any) -> CartStemContactConfig:
        """SofaGym's observation and round stem."""
        faithful: dict[str, Any] = {"observation": "paper", "flatness": 1.0, "failure_penalty": 0.0}
        return cls(**(faithful | options))
