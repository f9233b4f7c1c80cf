"""Options of the scene ``scenes/catch_the_object.py`` and of the task ``tasks/catch_the_object.py``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from softwarp.envs.options import (
    Count,
    Damping,
    Density,
    Distance,
    Gravity,
    Length,
    Mass,
    Modulus,
    NotNegative,
    PlaceRange,
    PoissonRatio,
    Positive,
    Rayleigh,
    Speed,
    Wait,
    check_choice,
    check_options,
)
from softwarp.envs.options.base import EnvConfig

RESOLUTIONS = ("coarse", "medium", "fine")
GAP = 0.030  # m, between the fronts
REWARD_KINDS = ("outcome", "paper")
MISS_KINDS = ("below", "far")
CART_POINTS = ("centre", "corner")


@dataclass(kw_only=True)
class CatchSceneConfig:
    """Options of the scene; the defaults are SofaGym's, with pads that have mass."""

    mesh: str = "coarse"  # "coarse" (SofaGym's resolution and stiffness), "medium" or "fine"
    youngs: Modulus = 3.0e6  # Pa
    nu: PoissonRatio = 0.3
    element: str = "p1"  # "p1" (SOFA's linear tetrahedra, too stiff) or "p2" (quadratic ones between the same nodes)
    rotation: str = "large"  # "large" (SOFA's) or "polar"
    density: Density = 1070.0  # [R] kg/m^3 of the pads, silicone's; 0 for SofaGym's pads without mass
    rayleigh: Rayleigh = (0.0, 0.0)  # 1/s on mass, s on stiffness, of the pads
    ball_mass: Mass = 1.0  # kg
    ball_radius: Length = 0.010  # m
    ball_damping: Damping = 5.0  # 1/s, drag: the ball falls with at most 1.96 m/s
    mu: NotNegative = 0.8  # friction of the ball with pads and cart
    contact_distance: Distance = 0.001  # m, surfaces rest that far apart
    gravity: Gravity = (0.0, 0.0, -9.81)  # m/s^2

    def __post_init__(self) -> None:
        """Refuse impossible values."""
        check_options(self)
        check_choice(self, "mesh", RESOLUTIONS)
        check_choice(self, "element", ("p1", "p2"))
        check_choice(self, "rotation", ("large", "polar", "warped"))
        if self.ball_radius + self.contact_distance >= 0.5 * GAP:
            raise ValueError(
                f"{type(self).__name__}: ball_radius + contact_distance must be less than {0.5 * GAP:g} m, half "
                f"the gap between the pads, got {self.ball_radius!r} + {self.contact_distance!r}"
            )


@dataclass(kw_only=True)
class CatchTheObjectConfig(CatchSceneConfig, EnvConfig):
    """Options of the CatchTheObject environment."""

    action_repeat: Count = 10
    max_episode_steps: Count = 30
    max_pressure: Positive = 300.0e3  # [R] Pa; SofaGym's is 150e3, with a chamber that pushes the pad forwards as well
    ball_height: PlaceRange = (0.20, 0.27)  # m, range of starts
    cart_start: PlaceRange = (-0.10, 0.10)  # m, range of starts of its middle
    cart_range: PlaceRange = (-0.10, 0.10)  # [R] m, where its middle turns; SofaGym's is -0.10 to 0.16
    cart_speed: Speed = 0.30  # m/s
    cart_wait: Wait = 0.26  # s at both ends; the paper's text has 2.5
    random_direction: bool = True  # [R] of the cart at the start; else -x, as in SofaGym
    cart_point: str = "centre"  # [R] observed: "centre" of the cart or its "corner" at low x
    reward: str = "outcome"  # [R] "outcome" or "paper"
    catch_bonus: NotNegative = 10.0  # with reward="outcome"
    miss_cost: NotNegative = 5.0  # with reward="outcome"
    miss: str = "below"  # [R] missed when the ball is "below" the cart's bottom, or "far": also farther than 0.2879 m
    success_tolerance: Length = 0.025  # m

    def __post_init__(self) -> None:
        """Check names and ranges."""
        CatchSceneConfig.__post_init__(self)
        EnvConfig.__post_init__(self)
        check_choice(self, "reward", REWARD_KINDS)
        check_choice(self, "miss", MISS_KINDS)
        check_choice(self, "cart_point", CART_POINTS)
        (start_low, start_high), (low, high) = self.cart_start, self.cart_range
        if not low <= start_low <= start_high <= high or low == high:
            raise ValueError(
                f"CatchTheObjectConfig: cart_start {self.cart_start} must lie within cart_range {self.cart_range}, "
                "which must not be empty"
            )

    @classmethod
    def paper(cls, **options: Any) -> CatchTheObjectConfig:
        """SofaGym's behaviour, except for its chamber and that every action has exactly 10 sub-steps."""
        faithful: dict[str, Any] = {
            "density": 0.0,
            "max_pressure": 150.0e3,
            "cart_range": (-0.10, 0.16),
            "random_direction": False,
            "cart_point": "corner",
            "reward": "paper",
            "miss": "far",
            "settle": False,
            "failure_penalty": 0.0,
        }
        return cls(**(faithful | options))
