"""Options of the scene ``scenes/trunk_cup.py`` and of the task ``tasks/trunk_cup.py``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from softwarp.envs.options import (
    Distance,
    HalfAngle,
    Length,
    Mass,
    Modulus,
    NotNegative,
    Pieces,
    Place,
    PoissonRatio,
    Positive,
    PositiveRange,
    Rayleigh,
    Share,
    check_choice,
    check_options,
)
from softwarp.envs.options.cable_reach import CableReachConfig
from softwarp.envs.options.trunk import TrunkSceneConfig

CUP_RESOLUTIONS = ("coarse", "medium", "fine")
STARTS = ("wrapped", "open")
LOWEST_TABLE, HIGHEST_TABLE = -0.080, -0.050  # m


@dataclass(kw_only=True)
class TrunkCupSceneConfig(TrunkSceneConfig):
    """Options of the scene; materials and friction are SofaGym's TrunkCup's, the trunk is the coarse one."""

    mesh: str = "coarse"  # of the trunk: "coarse", "medium", "fine", or a mesh file
    youngs: Modulus = 600.0e3  # Pa
    nu: PoissonRatio = 0.3
    cup_mesh: str = "coarse"  # "coarse", "medium" or "fine"
    cup_youngs: Modulus = 1.0e6  # Pa
    cup_nu: PoissonRatio = 0.3
    cup_mass: Mass = 0.0024  # kg; silicone would have 0.030, which the grasp holds as well
    cup_rayleigh: Rayleigh = (0.1, 0.01)  # [R] 1/s on mass, s on stiffness; SofaGym's cup has no damping
    mu: NotNegative = 0.8  # friction between trunk and cup
    skin_corners: Pieces = 8  # of the trunk's skin for contact, around
    contact_distance: Distance = 0.0005  # m, surfaces rest that far apart
    alarm_distance: Distance = 0.0007  # [R] m, from where contacts are looked at; SofaGym has 0.002
    start: str = "wrapped"  # or "open": the cup stands on a table beside the trunk, which has yet to take hold of it
    table_height: Place = (
        -0.068
    )  # m, y of the table, with start="open": a little lower than the grasp lets the cup hang
    table_mu: NotNegative = 0.2  # friction of the table with trunk and cup

    ACCURATE: ClassVar[Mapping[str, Any]] = {}  # the saved grasp is of one mesh

    def __post_init__(self) -> None:
        """Refuse impossible values."""
        TrunkSceneConfig.__post_init__(self)
        check_options(self)
        check_choice(self, "cup_mesh", CUP_RESOLUTIONS)
        check_choice(self, "start", STARTS)
        if not LOWEST_TABLE <= self.table_height <= HIGHEST_TABLE:
            raise ValueError(
                f"{type(self).__name__}: table_height must lie in [{LOWEST_TABLE:g}, {HIGHEST_TABLE:g}] m, where the "
                f"trunk gets round a cup that stands on it, got {self.table_height:g}"
            )
        if self.skin_corners < 4:
            raise ValueError(
                f"{type(self).__name__}: skin_corners must be at least 4, got {self.skin_corners}; 8 is enough"
            )
        if self.alarm_distance < self.contact_distance:
            raise ValueError(
                f"{type(self).__name__}: alarm_distance must be at least contact_distance ({self.contact_distance:g} "
                f"m), got {self.alarm_distance!r}"
            )


@dataclass(kw_only=True)
class TrunkCupConfig(TrunkCupSceneConfig, CableReachConfig):
    """Options of the TrunkCup environment."""

    goal_list: list[list[Place]] = field(default_factory=lambda: [[0.040, 0.040, 0.100], [-0.010, 0.020, 0.080]])  # m
    goal_jitter: Distance = 0.001  # m, uniform on each axis
    axis_tolerance: HalfAngle = 0.17453292519943295  # rad, 10 degrees; pi asks for the position alone
    axis_lever: Length = 0.0286  # m that a radian is worth: 10 degrees are 5 mm
    goal_repeat: Share = 0.0  # probability of the same goal anew after an episode whose last action began off it
    drop_distance: Length = 0.080  # m between cup and trunk from which the cup counts as dropped
    drop_penalty: NotNegative = 5.0  # taken from the reward of the action in which the cup is dropped
    grip_weight: NotNegative = 0.0  # taken where the contacts' loads add up to nothing, less up to ``firm_grip``
    firm_grip: Positive = 0.5  # N of all contacts, from which on nothing is taken; the cup weighs 0.024 N
    start_jitter: Distance = 0.003  # m, uniform in x and z, of the cup on the table, with start="open"
    carry_weight: NotNegative = 0.1  # with start="open": reward of an action at whose end the trunk carries the cup
    cup_mass_range: PositiveRange | None = None  # kg, drawn per world at reset
    mu_range: PositiveRange | None = None  # friction, drawn per world at reset

    def __post_init__(self) -> None:
        """Check names and ranges."""
        TrunkCupSceneConfig.__post_init__(self)
        CableReachConfig.__post_init__(self)

    @classmethod
    def paper(cls, **options: Any) -> TrunkCupConfig:
        """SofaGym's behaviour as far as one can want it: its goals, observation and reward, which know no axis.

        Its cables also push and have no limits, its gravity has two digits swapped. Its wrapped state, the springs that
        stiffen its trunk, and its full boundaries in contact are not here: episodes start in our grasp.
        """
        faithful: dict[str, Any] = {
            "gravity": (0.0, -9.18, 0.0),
            "min_tension": float("-inf"),
            "action_kind": "discrete",
            "observation": "paper",
            "goals": "list",
            "reward": "paper",
            "axis_tolerance": 3.141592653589793,
            "success_tolerance": 0.003,
            "end_on_success": True,
            "clamp_commands": False,
            "alarm_distance": 0.002,
            "settle": False,  # cables that push do not come to rest within a micrometre
            "failure_penalty": 0.0,
            "drop_penalty": 0.0,
        }
        return cls(**(faithful | options))
