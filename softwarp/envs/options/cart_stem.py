"""Options of the scene ``scenes/cart_stem.py`` and of the task ``tasks/cart_stem.py``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from softwarp.envs.options import (
    Count,
    Damping,
    Density,
    Gravity,
    Length,
    Mass,
    Modulus,
    Pieces,
    Positive,
    Rayleigh,
    RodPoissonRatio,
    Sizes,
    Spread,
    check_choice,
    check_options,
)
from softwarp.envs.options.base import EnvConfig

ACTION_KINDS = ("discrete", "continuous")
OBSERVATION_KINDS = ("scaled", "paper")
REWARD_KINDS = ("paper", "shaped")


@dataclass(kw_only=True)
class StemConfig:
    """Options of cart and stem; the defaults are SofaGym's CartStem."""

    sections: Pieces = 1  # pieces of constant curvature
    length: Length = 0.25  # m
    radius: Length = 0.005  # m
    youngs: Modulus = 270.0e6  # Pa
    nu: RodPoissonRatio = 0.45
    density: Density = 0.0  # kg/m^3 of the stem; SofaGym's has no mass, silicone has 1100
    rayleigh: Rayleigh = (0.1, 0.2)  # 1/s on mass, s on stiffness
    flatness: Positive = 16.0  # [R] bending stiffness out of the plane per stiffness in it; 1 is round, may tip over
    gravity: Gravity = (0.0, 0.0, -9.81)  # m/s^2
    cart_size: Sizes = (0.10, 0.04, 0.04)  # m

    def __post_init__(self) -> None:
        """Refuse impossible values."""
        check_options(self)


@dataclass(kw_only=True)
class CartStemSceneConfig(StemConfig):
    """Options of the scene in which the cart is pushed."""

    cart_mass: Mass = 160.0  # kg
    sphere_mass: Mass = 0.75  # kg
    sphere_damping: Damping = 0.1  # 1/s, on its mass
    sphere_radius: Length = 0.0158  # m; gives the moment of inertia of SofaGym's sphere, 0.75 kg cm^2


@dataclass(kw_only=True)
class CartStemConfig(CartStemSceneConfig, EnvConfig):
    """Options of the CartStem environment."""

    action_repeat: Count = 10
    max_episode_steps: Count = 80
    settle: bool = False  # upright is no rest to settle in
    action_kind: str = "discrete"  # "discrete" or "continuous"
    observation: str = "scaled"  # "scaled" or "paper"
    reward: str = "paper"  # "paper" or "shaped"
    force: Positive = 10.0  # N
    start_x: Spread = 0.05  # m, cart positions are drawn from +- this
    start_curvature: Spread = 0.12  # [R] 1/m, curvatures are drawn from +- this; SofaGym's kick gives up to 0.24
    max_offset: Length = 0.05  # m, beside the cart
    max_x: Length = 0.40  # m, of the cart

    def __post_init__(self) -> None:
        """Check names and ranges."""
        CartStemSceneConfig.__post_init__(self)
        EnvConfig.__post_init__(self)
        check_choice(self, "action_kind", ACTION_KINDS)
        check_choice(self, "observation", OBSERVATION_KINDS)
        check_choice(self, "reward", REWARD_KINDS)

    @classmethod
    def paper(cls, **options: Any) -> CartStemConfig:
        """SofaGym's observation, round stem and range of starts."""
        faithful: dict[str, Any] = {
            "observation": "paper",
            "flatness": 1.0,
            "start_curvature": 0.24,
            "failure_penalty": 0.0,
        }
        return cls(**(faithful | options))

    @classmethod
    def hard(cls, **options: Any) -> CartStemConfig:
        """A rod of eight sections with silicone's density, which falls five times as fast."""
        harder: dict[str, Any] = {
            "sections": 8,
            "density": 1100.0,
            "rayleigh": (0.1, 0.02),
            "start_curvature": 0.10,
        }
        return cls(**(harder | options))
