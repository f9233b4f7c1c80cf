"""Options of the scene ``scenes/stem_pendulum.py`` and of the task ``tasks/stem_pendulum.py``."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from softwarp.envs.options import (
    AngleRange,
    Count,
    Density,
    Duration,
    Fraction,
    Gravity,
    Length,
    Modulus,
    Pieces,
    Positive,
    Rayleigh,
    RodPoissonRatio,
    check_choice,
    check_options,
)
from softwarp.envs.options.base import EnvConfig

OBSERVATION_KINDS = ("state", "paper")


@dataclass(kw_only=True)
class PendulumConfig:
    """Options of the rod; the defaults are SofaGym's."""

    segments: Pieces = 10
    length: Length = 0.10  # m
    radius: Length = 0.02  # m
    youngs: Modulus = 300.0e3  # Pa
    nu: RodPoissonRatio = 0.4
    density: Density = 1.0e4  # kg/m^3
    rayleigh: Rayleigh = (0.0, 0.0)  # 1/s on mass, s on stiffness
    root_stiffness: Positive = 0.03  # N m/rad towards the angle at the start
    gravity: Gravity = (0.0, 0.0, -9.81)  # m/s^2

    def __post_init__(self) -> None:
        """Refuse impossible values."""
        check_options(self)
        if self.density == 0.0:
            raise ValueError(f"{type(self).__name__}: density must be positive, got {self.density!r}")


@dataclass(kw_only=True)
class StemPendulumConfig(PendulumConfig, EnvConfig):
    """Options of the StemPendulum environment."""

    dt: Duration = 0.005  # [R] s; SofaGym's 0.01 damps a swing by 70 % per period
    action_repeat: Count = 20
    max_episode_steps: Count = 50
    settle: bool = False  # the start is no rest
    observation: str = "state"  # [R] "state" or "paper", which has two values for one pose and hides speeds and spring
    max_torque: Positive = 0.25  # [R] N m; SofaGym's is 0.05
    start_angle: AngleRange = (-math.pi, math.pi)  # rad, range of starts, 0 upright
    success_height: Fraction = 0.9  # of the length

    def __post_init__(self) -> None:
        """Check names and ranges."""
        PendulumConfig.__post_init__(self)
        EnvConfig.__post_init__(self)
        check_choice(self, "observation", OBSERVATION_KINDS)
        low, high = self.start_angle
        if not -math.pi <= low <= high <= math.pi:
            raise ValueError(f"StemPendulumConfig: start_angle must lie in [-pi, pi], got {self.start_angle}")

    @classmethod
    def paper(cls, **options: Any) -> StemPendulumConfig:
        """SofaGym's time step, motor and observation; torques are reached exactly."""
        faithful: dict[str, Any] = {
            "dt": 0.01,
            "action_repeat": 10,
            "observation": "paper",
            "max_torque": 0.05,
            "failure_penalty": 0.0,
        }
        return cls(**(faithful | options))
