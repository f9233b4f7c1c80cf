"""Options of the scene ``scenes/maze.py`` and of the task ``tasks/maze.py``."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from softwarp.envs.options import Angle, Count, Mass, Places, Positive, PositiveRange, check_choice
from softwarp.envs.options.simple_maze import SimpleMazeConfig, SimpleMazeSceneConfig
from softwarp.envs.options.tripod import TripodSceneConfig

ACTION_KINDS = ("continuous", "tilt", "discrete")


@dataclass(kw_only=True)
class MazeSceneConfig(TripodSceneConfig, SimpleMazeSceneConfig):
    """Options of the scene."""

    angle: Angle = -1.0  # [R] rad, of all servos at the start: a tutorial's height for tilting; SofaGym's is -1.4965
    maze_mass: Mass = 0.010  # [R] kg, 9 cm^3 of a printed plastic; SofaGym's has none
    maze_offset: Places = (
        0.0,
        0.0,
    )  # [R] m, of the maze's middle from the axis; SofaGym's is (1.5, 1.5) mm

    def __post_init__(self) -> None:
        """Refuse impossible values."""
        SimpleMazeSceneConfig.__post_init__(self)
        TripodSceneConfig.__post_init__(self)


@dataclass(kw_only=True)
class MazeConfig(MazeSceneConfig, SimpleMazeConfig):
    """Options of the Maze environment."""

    action_repeat: Count = 5
    max_episode_steps: Count = 250
    settle: bool = True
    action_kind: str = "tilt"  # "tilt" (towards x and y), "continuous" (changes of three angles) or "discrete" (six)
    action_step: Positive = 0.1  # [R] rad, largest change of an angle per action; SofaGym's is 0.5
    youngs_range: PositiveRange | None = None  # Pa, drawn per world at reset
    mu_range: PositiveRange | None = None  # friction, likewise
    ball_mass_range: PositiveRange | None = None  # kg, likewise

    def __post_init__(self) -> None:
        """Check names and places."""
        kind, self.action_kind = self.action_kind, "continuous"  # those of SimpleMaze are others
        try:
            SimpleMazeConfig.__post_init__(self)
        finally:
            self.action_kind = kind
        MazeSceneConfig.__post_init__(self)
        if self.action_kind not in ACTION_KINDS:
            check_choice(self, "action_kind", ACTION_KINDS)

    @classmethod
    def paper(cls, **options: Any) -> MazeConfig:
        """SofaGym's behaviour, except that every action has exactly 5 sub-steps and that legs and floor are solids.

        Its servos of any strength and speed that start at -1.4965 rad, its half radians per action, its maze without
        mass that stands 1.5 mm beside the axis, its raw observation and its reward are all kept.
        """
        faithful: dict[str, Any] = {
            "action_kind": "discrete",
            "action_step": 0.5,
            "observation": "paper",
            "reward": "paper",
            "settle": False,
            "angle": -1.4965,
            "min_angle": -1.5,
            "max_angle": 1.5,
            "max_speed": math.inf,
            "max_torque": math.inf,
            "maze_mass": 1.0e-6,
            "maze_offset": (0.0015, 0.0015),
            "contact_distance": 2.0e-4,
            "failure_penalty": 0.0,
        }
        return cls(**(faithful | options))
