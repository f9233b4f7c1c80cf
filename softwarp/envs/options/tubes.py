"""Options of tasks in which three tubes or wires, one in the other, bring the innermost tip to a goal."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from softwarp.envs.options import Count, Distance, HighLimit, Length, NotNegative, Sizes, check_choice
from softwarp.envs.options.base import EnvConfig
from softwarp.ranges import Range

TUBES = 3
ACTION_KINDS = ("continuous", "discrete")
OBSERVATION_KINDS = ("compact", "paper")
REWARD_KINDS = ("shaped", "paper")

Turns = Annotated[tuple[float, float, float], Range(low=1.0e-6, high=6.3)]  # rad
Power = Annotated[float, Range(low=1.0, high=10.0)]
Lengths = Annotated[tuple[float, float, float], Range(low=0.0, high=1.0e3)]  # m


@dataclass(kw_only=True)
class TubesConfig(EnvConfig):
    """Options of every such task; lists go from the innermost instrument to the outermost."""

    action_repeat: Count = 10
    max_episode_steps: Count = 50
    settle: bool = False  # nothing has been pushed out yet
    action_kind: str = "continuous"  # "continuous" (insertion and turn of each tube) or "discrete" (12 choices)
    insert_step: Sizes = (0.010, 0.008, 0.0067)  # m, largest insertion per action
    withdraw_step: Sizes = (0.0035, 0.0028, 0.0023)  # m, a discrete withdrawal; continuous ones go up to insert_step
    turn_step: Turns = (1.0 / 3.0, 0.267, 0.222)  # rad, largest turn per action
    action_power: Power = 1.0  # p of continuous actions a, which move by |a|^p; above 1 small ones are finer
    first_lengths: Lengths = (0.001, 0.0, 0.0)  # m out of the port at the start
    nested: bool = True  # whether no tube reaches farther than those within it; SofaGym's may
    observation: str = "compact"  # "compact" or "paper"
    observe_force: bool = False  # whether the compact observation tells the sum of wall forces
    force_scale: NotNegative = 1.0  # N worth 1 in an observation
    force_limit: HighLimit = math.inf  # N, sum of wall forces that costs nothing
    force_penalty: NotNegative = 0.0  # taken from the reward of an action per N above the limit
    end_on_force: bool = False  # terminate where the sum of wall forces exceeds the limit
    max_insertion_force: HighLimit = math.inf  # N, with which the wall may press tubes back before their feed slips
    reward: str = "shaped"  # "shaped" or "paper"
    progress_scale: Length = 0.005  # m of progress worth 1
    precision_scale: Length = 0.002  # m at which precision is worth half its weight
    precision_weight: NotNegative = 1.0
    effort_weight: NotNegative = 0.01
    success_tolerance: Distance = 0.001  # m

    def __post_init__(self) -> None:
        """Check names and ranges."""
        EnvConfig.__post_init__(self)
        check_choice(self, "action_kind", ACTION_KINDS)
        check_choice(self, "observation", self.observation_kinds)
        check_choice(self, "reward", REWARD_KINDS)
        name = type(self).__name__
        if not self.force_limit > 0.0:
            raise ValueError(f"{name}: force_limit must be positive, inf for none, got {self.force_limit!r} N")
        if not self.max_insertion_force > 0.0:
            told = f"got {self.max_insertion_force!r} N"
            raise ValueError(f"{name}: max_insertion_force must be positive, inf for any, {told}")
        if self.force_scale <= 0.0:
            raise ValueError(f"{name}: force_scale must be positive, got {self.force_scale!r} N")
        if math.isinf(self.force_limit) and self.force_penalty > 0.0:
            raise ValueError(f"{name}: force_penalty needs a finite force_limit, in N, got {self.force_limit!r}")
        if self.nested and list(self.first_lengths) != sorted(self.first_lengths, reverse=True):
            raise ValueError(
                f"{name}: nested tubes need first_lengths that do not rise from the innermost tube to the outermost, "
                f"got {self.first_lengths!r}; take {tuple(sorted(self.first_lengths, reverse=True))!r}, or nested=False"
            )

    @property
    def observation_kinds(self) -> tuple[str, ...]:
        """What ``observation`` may be."""
        return OBSERVATION_KINDS

    def check_reach(self, key: str, most: tuple[float, ...]) -> None:
        """Refuse tubes that are out farther at the start, or move farther in an action, than they may come out.

        Args:
            key: Option that tells how far.
            most: Its value [m].
        """
        for option in ("first_lengths", "insert_step", "withdraw_step"):
            for tube, (value, reach) in enumerate(zip(getattr(self, option), most, strict=True)):
                if value > reach:
                    raise ValueError(
                        f"{type(self).__name__}: {option} of tube {tube} must be at most {key}[{tube}], {reach:g} m, "
                        f"got {value!r}"
                    )
