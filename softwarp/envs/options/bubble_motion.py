"""Options of the scene ``scenes/bubble_motion.py`` and of the task ``tasks/bubble_motion.py``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from softwarp.envs.options import (
    Count,
    Density,
    Distance,
    Gravity,
    Length,
    Looks,
    Mass,
    Modulus,
    NotNegative,
    PlaceRange,
    Places,
    PoissonRatio,
    Positive,
    Pressure,
    Rayleigh,
    check_choice,
    check_options,
)
from softwarp.envs.options.base import EnvConfig
from softwarp.envs.options.fidelity import FidelityConfig

RESOLUTIONS = ("coarse", "medium", "fine", "graded")
ACTION_KINDS = ("continuous", "discrete")
OBSERVATION_KINDS = ("state", "paper")
REWARD_KINDS = ("shaped", "paper")
RECESS_HALF = 0.040  # m, half width of the floor
RIM_TOP, FLOOR = 0.030, 0.010  # m, heights
_ROUNDING = 1.0e-9  # m
ACCURATE_SKIN, ACCURATE_NU = 0.006, 0.3  # m, 1: of the board that modes come with softwarp for
THICKEST_SKIN = 0.007  # m, which leaves chambers of half a millimetre


@dataclass(kw_only=True)
class BubbleSceneConfig(FidelityConfig):
    """Options of the scene."""

    mesh: str = "coarse"  # "coarse" (about SofaGym's nodes), "medium", "fine", or "graded": narrower beside walls
    skin: Length = 0.006  # [R] m, floor over the chambers; SofaGym's is 0.001, which 400 kPa would burst
    youngs: Modulus = 3.0e6  # Pa
    nu: PoissonRatio = 0.3
    element: str = "p1"  # "p1" (SOFA's linear tetrahedra, too stiff) or "p2" (quadratic ones between the same nodes)
    rotation: str = "large"  # "large" (SOFA's) or "polar"
    density: Density = 1100.0  # [R] kg/m^3 of the board, silicone's; 0 for SofaGym's board without mass
    rayleigh: Rayleigh = (0.0, 0.0)  # 1/s on mass, s on stiffness, of the board
    ball_mass: Mass = 2.0  # kg
    ball_radius: Length = 0.010  # m
    ball_inertia: Positive | None = None  # [R] kg m^2; None for the true 2/5 m r^2, SofaGym's is 2e-4
    mu: NotNegative = 0.8  # friction of the ball with floor and rim
    contact_distance: Distance = 0.0  # [R] m, surfaces rest that far apart; SofaGym's is 0.001
    gravity: Gravity = (0.0, 0.0, -9.81)  # m/s^2

    ACCURATE: ClassVar[Mapping[str, Any]] = {"mesh": "graded", "element": "p2", "rotation": "polar"}

    def __post_init__(self) -> None:
        """Refuse impossible values."""
        check_options(self)
        self.take_fidelity()
        if self.fidelity == "accurate" and (self.skin, self.nu) != (ACCURATE_SKIN, ACCURATE_NU):
            raise ValueError(
                f"{type(self).__name__}: fidelity='accurate' has modes for skin={ACCURATE_SKIN:g} and "
                f"nu={ACCURATE_NU:g}, got {self.skin!r} and {self.nu!r}; leave fidelity out and take mesh='graded', "
                "element='p2', rotation='polar', the same board node by node"
            )
        check_choice(self, "mesh", RESOLUTIONS)
        check_choice(self, "element", ("p1", "p2"))
        check_choice(self, "rotation", ("large", "polar", "warped"))
        if self.skin > THICKEST_SKIN:
            raise ValueError(
                f"{type(self).__name__}: skin must be at most {THICKEST_SKIN:g} m, which leaves chambers of half a "
                f"millimetre, got {self.skin!r}"
            )
        if self.reach <= 0.0:
            raise ValueError(
                f"{type(self).__name__}: ball_radius + contact_distance must be less than {RECESS_HALF:g} m, half the "
                f"floor's width, got {self.ball_radius!r} + {self.contact_distance!r}"
            )

    @property
    def reach(self) -> float:
        """How far from the middle the rim lets the ball's centre come, along x and along y [m]."""
        return RECESS_HALF - self.ball_radius - self.contact_distance

    @property
    def rest_height(self) -> float:
        """Height of the ball's centre on the flat floor [m]."""
        return FLOOR + self.ball_radius + self.contact_distance


@dataclass(kw_only=True)
class BubbleMotionConfig(BubbleSceneConfig, EnvConfig):
    """Options of the BubbleMotion environment."""

    action_repeat: Count = 20
    max_episode_steps: Count = 20
    end_on_success: bool = True
    action_kind: str = "continuous"  # "continuous", or "discrete": one chamber alone, or none
    max_pressure: Pressure = 300.0e3  # [R] Pa; SofaGym's is 400e3 under a floor that bulges a little less
    observation: str = "state"  # "state" or "paper"
    start_range: PlaceRange = (-0.030, 0.030)  # [R] m, of the ball's x and y; SofaGym's is -0.010 to 0.030
    start_drop: Distance = 0.001  # [R] m that the ball falls; SofaGym's is 0.03
    goal: Places | None = None  # m, always this one; None draws it
    goal_range: PlaceRange = (-0.030, 0.030)  # [R] m, of the goal's x and y; SofaGym's is -0.040 to 0.040
    goals_beyond_reach: bool = False  # [R] let goals lie where the rim keeps the ball away, as SofaGym does
    least_way: Distance = 0.015  # [R] m, from start to goal; SofaGym's is 0
    reward: str = "shaped"  # [R] "shaped" or "paper"
    reach_bonus: NotNegative = 5.0  # with reward="shaped"
    least_scale: Length = 0.010  # [R] m, with reward="paper" that divides by the way; SofaGym has no limit
    success_tolerance: Length = 0.006  # m
    contact_passes: Looks | None = None  # looks at contacts where a step leads to; at most 1 for gradients

    def __post_init__(self) -> None:
        """Check names and ranges."""
        BubbleSceneConfig.__post_init__(self)
        EnvConfig.__post_init__(self)
        check_choice(self, "action_kind", ACTION_KINDS)
        check_choice(self, "observation", OBSERVATION_KINDS)
        check_choice(self, "reward", REWARD_KINDS)
        self._check_places()

    def _check_places(self) -> None:
        """Starts on the floor, goals where the ball can be, and far enough from each other."""
        limits = f"within +-{self.reach:.4g} m, where the rim stops the ball"
        if max(map(abs, self.start_range)) > self.reach + _ROUNDING:
            raise ValueError(f"BubbleMotionConfig: start_range must lie {limits}, got {self.start_range}")
        name, places = ("goal_range", self.goal_range) if self.goal is None else ("goal", self.goal)
        if not self.goals_beyond_reach and max(map(abs, places)) > self.reach + _ROUNDING:
            raise ValueError(
                f"BubbleMotionConfig: {name} must lie {limits}, got {places}; goals_beyond_reach=True lets goals lie "
                "where the ball cannot come"
            )
        (low, high), (first, last) = self.goal_range, self.start_range
        # From the middle of the starts the far corner of the goals is nearest.
        middle = min(max(0.5 * (low + high), first), last)
        farthest = math.sqrt(2.0) * max(middle - low, high - middle)
        if self.goal is None and self.least_way > farthest:
            raise ValueError(
                f"BubbleMotionConfig: least_way must be at most {farthest:.4g} m, so that every start has a "
                f"goal, got {self.least_way!r}"
            )

    @classmethod
    def paper(cls, **options: Any) -> BubbleMotionConfig:
        """SofaGym's behaviour, except for the floor's thickness, a round ball, and exactly 20 sub-steps per action."""
        faithful: dict[str, Any] = {
            "density": 0.0,
            "ball_inertia": 2.0e-4,
            "contact_distance": 0.001,
            "max_pressure": 400.0e3,
            "observation": "paper",
            "start_range": (-0.010, 0.029),
            "start_drop": 0.029,
            "goal_range": (-0.040, 0.040),
            "goals_beyond_reach": True,
            "least_way": 0.0,
            "reward": "paper",
            "least_scale": 1.0e-6,
            "settle": False,
            "failure_penalty": 0.0,
        }
        return cls(**(faithful | options))
