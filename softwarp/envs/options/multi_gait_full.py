"""Options of the scene ``scenes/multi_gait.py`` and of the task ``tasks/multi_gait_full.py``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from softwarp.envs.options import (
    Count,
    Distance,
    Gravity,
    HalfAngle,
    Length,
    Mass,
    Modulus,
    NotNegative,
    PoissonRatio,
    Positive,
    Rayleigh,
    check_choice,
    check_options,
)
from softwarp.envs.options.base import EnvConfig
from softwarp.ranges import Range

RESOLUTIONS = ("coarse", "fine")
LAWS = ("neo_hookean", "stable_neo_hookean", "corotational")
ACTION_KINDS = ("discrete", "continuous")
CHAMBER_KINDS = ("symmetric", "each")
GOAL_KINDS = ("forward", "headings")
REWARD_KINDS = ("progress", "paper")
LARGEST_GROWTH = 5.0e-6  # m^3, beyond which the chambers' roofs would burst

Growth = Annotated[float, Range(above=0.0, high=LARGEST_GROWTH)]  # m^3, of a chamber
Headings = Annotated[tuple[float, float], Range(low=-3.1, high=3.1, rising=True)]  # rad


@dataclass(kw_only=True)
class MultiGaitSceneConfig:
    """Options of the scene."""

    mesh: str = "coarse"  # "coarse" (3182 nodes) or "fine" (15 377 nodes, SofaGym's 15 787)
    youngs: Modulus = 70.0e3  # Pa
    nu: PoissonRatio = 0.05
    law: str = "neo_hookean"  # or "stable_neo_hookean", or "corotational" (SofaGym's), which turns elements inside out
    rotation: str = "warped"  # of the corotational law: "warped", "polar", or "large" (SOFA's)
    body_mass: Mass = 0.035  # kg
    lumping: str = "volume"  # [R] mass of the nodes by "volume" or "uniform" (SofaGym's)
    base_youngs: Modulus = 5.0e6  # Pa, of the skin under the base, which hardly stretches
    base_nu: PoissonRatio = 0.49
    base_thickness: Length = 0.001  # m
    rayleigh: Rayleigh = (0.1, 0.1)  # 1/s on mass, s on stiffness
    mu: NotNegative = 0.7  # friction on the floor
    contact_distance: Distance = 0.0005  # m, the base rests that far above the floor
    alarm_distance: Distance = 0.0025  # m, from which on points of the base are looked at
    contact_spacing: Length = 0.011  # m, of the points of the skin that touches; 118 points
    gravity: Gravity = (0.0, 0.0, -9.81)  # m/s^2

    def __post_init__(self) -> None:
        """Refuse impossible values."""
        check_options(self)
        check_choice(self, "mesh", RESOLUTIONS)
        check_choice(self, "law", LAWS)
        check_choice(self, "rotation", ("large", "polar", "warped"))
        check_choice(self, "lumping", ("volume", "uniform"))
        label = type(self).__name__
        if self.alarm_distance < self.contact_distance:
            raise ValueError(
                f"{label}: alarm_distance must be at least contact_distance ({self.contact_distance:g} m), got "
                f"{self.alarm_distance!r}"
            )
        if not 0.002 <= self.contact_spacing <= 0.03:
            raise ValueError(
                f"{label}: contact_spacing must lie in [0.002, 0.03] m, which gives 2600 to 40 points, got "
                f"{self.contact_spacing!r}"
            )


@dataclass(kw_only=True)
class MultiGaitFullConfig(MultiGaitSceneConfig, EnvConfig):
    """Options of the MultiGaitFull environment."""

    action_repeat: Count = 60
    max_episode_steps: Count = 6
    action_kind: str = "discrete"  # "discrete": fill or empty a group of chambers; "continuous": volumes of all of them
    chambers: str = "symmetric"  # "symmetric" (centre, both rear, both front) or "each" (five apart, for turning)
    max_growth_centre: Growth = 2.0e-6  # m^3 added to the centre's 0.507e-6 m^3
    max_growth_leg: Growth = 1.5e-6  # m^3 added to each leg's 0.280e-6 or 0.350e-6 m^3
    ramp: Count = 15  # sub-steps in which a chamber is filled or emptied; exactly, SofaGym's rounding refused some
    goals: str = "forward"  # "forward" along +x, or "headings": turn until the body points along a drawn direction
    goal_distance: Length = 0.2  # m, where the line is that goals="forward" leads to
    goal_headings: Headings = (-0.35, 0.35)  # rad, of which goals="headings" draws, positive to the left of +x
    heading_tolerance: HalfAngle = 0.1745  # rad, 10 degrees
    reward: str = "progress"  # [R] "progress", which charges slip backwards, or "paper", max(0, .)
    heading_scale: Positive = 0.1745  # rad of heading won that are worth a reward of 1
    drift_weight: NotNegative = 0.0  # taken from the reward per cm of way sideways

    def __post_init__(self) -> None:
        """Check names and ranges."""
        MultiGaitSceneConfig.__post_init__(self)
        EnvConfig.__post_init__(self)
        choices = {
            "action_kind": ACTION_KINDS,
            "chambers": CHAMBER_KINDS,
            "goals": GOAL_KINDS,
            "reward": REWARD_KINDS,
        }
        for name, known in choices.items():
            check_choice(self, name, known)
        if self.ramp > self.action_repeat:
            raise ValueError(
                f"MultiGaitFullConfig: ramp must be at most action_repeat ({self.action_repeat}), so that an action "
                f"can fill a chamber, got {self.ramp!r}"
            )
        if self.goals == "headings" and self.chambers != "each":
            raise ValueError(
                f"MultiGaitFullConfig: goals='headings' needs chambers='each', as left and right chambers that are "
                f"filled alike cannot turn the robot, got chambers={self.chambers!r}"
            )

    @classmethod
    def paper(cls, **options: Any) -> MultiGaitFullConfig:
        """SofaGym's scene, on the fine mesh, and its reward in cm; exactly 60 sub-steps and full ramps per action."""
        faithful: dict[str, Any] = {
            "mesh": "fine",
            "law": "corotational",
            "rotation": "large",
            "lumping": "uniform",
            "reward": "paper",
            "settle": False,
            "failure_penalty": 0.0,
        }
        return cls(**(faithful | options))
