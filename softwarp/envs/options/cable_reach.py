"""Options of tasks in which cables bring a point to a goal."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from softwarp.envs.options import Distance, Length, NotNegative, Place, PositiveRange, check_choice
from softwarp.envs.options.base import EnvConfig

ACTION_KINDS = ("continuous", "absolute", "discrete")
OBSERVATION_KINDS = ("compact", "paper")
GOAL_SPLITS = ("train", "eval", "all")
REWARD_KINDS = ("shaped", "paper")


@dataclass(kw_only=True)
class CableReachConfig(EnvConfig):
    """Options of every such task; subclasses set the defaults that fit their robot."""

    action_kind: str = "continuous"  # "continuous", "absolute" or "discrete"
    action_step: Length = 0.005  # m, largest change of a commanded displacement per action
    clamp_commands: bool = True  # keep commands within the cables' limits and slack; SofaGym lets them wind up
    max_slack: Distance = 0.005  # m, how much looser than the cable its command may be
    observation: str = "compact"  # "compact" or "paper"
    goals: str = "workspace"  # "workspace", "list", or what the task has besides
    goal_list: list[list[Place]] = field(default_factory=list)  # m
    goal_split: str = "train"  # "train", "eval" or "all" points of the workspace; the first two are disjoint
    goal_jitter: Distance = 0.002  # m, uniform on each axis
    reward: str = "shaped"  # "shaped" or "paper"
    progress_scale: Length = 0.010  # m of progress worth 1
    precision_scale: Length = 0.010  # m at which precision is worth half its weight
    precision_weight: NotNegative = 1.0
    effort_weight: NotNegative = 0.01
    success_tolerance: Distance = 0.005  # m
    youngs_range: PositiveRange | None = None  # Pa, drawn per world at reset

    GOAL_KINDS: ClassVar[tuple[str, ...]] = ("workspace", "list")

    def __post_init__(self) -> None:
        """Check names and ranges."""
        EnvConfig.__post_init__(self)
        check_choice(self, "action_kind", ACTION_KINDS)
        check_choice(self, "observation", OBSERVATION_KINDS)
        check_choice(self, "goals", self.GOAL_KINDS)
        check_choice(self, "goal_split", GOAL_SPLITS)
        check_choice(self, "reward", REWARD_KINDS)
        self.goal_list = [[float(x) for x in point] for point in self.goal_list]
        is_point = [len(point) == 3 for point in self.goal_list]
        if not is_point or not all(is_point):
            raise ValueError(
                f"{type(self).__name__}: goal_list must hold points (x, y, z) in metres, got {self.goal_list}"
            )
