"""Options of the scene ``scenes/simple_maze.py`` and of the task ``tasks/simple_maze.py``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from softwarp.envs.options import (
    Count,
    Distance,
    Further,
    Gravity,
    Length,
    Mass,
    NotNegative,
    Places,
    Positive,
    check_choice,
    check_options,
)
from softwarp.envs.options.base import EnvConfig
from softwarp.meshing import Maze, random_maze, serpentine
from softwarp.meshing.maze_geometry import CELLS, CORRIDOR, FLOOR, HEIGHT, WALL
from softwarp.ranges import Seed

MAZE_KINDS = ("serpentine", "random")
ACTION_KINDS = ("discrete", "continuous")
OBSERVATION_KINDS = ("state", "paper")
REWARD_KINDS = ("progress", "paper")
GOAL_KINDS = ("corner", "any")
START = (-0.0003, -0.0035)  # m, of the ball in the serpentine, as in SofaGym's
MOST_MAZES = 4096


@dataclass(kw_only=True)
class SimpleMazeSceneConfig:
    """Options of the scene."""

    maze: str = "serpentine"  # "serpentine" (SofaGym's, 8 x 8 cells) or "random"
    columns: Count = CELLS  # cells of random mazes along x
    rows: Count = CELLS  # and along y
    maze_seed: Seed = 0  # of the first random maze; the next one has the next seed
    mazes: Count = 1  # random mazes, of which every episode of a world has one
    loops: Further = 0  # walls of a random maze that are opened again, each of which closes a ring
    corridor: Length = CORRIDOR  # m, width of the corridors
    wall: Length = WALL  # m, thickness of the walls
    wall_height: Length = HEIGHT  # m, over the floor
    floor: Length = FLOOR  # m, thickness of the floor; SofaGym's has none
    ball_radius: Length = 0.002  # m
    ball_mass: Mass = 1.0e-4  # kg
    mu: NotNegative = 0.2  # [R] friction of the ball, which rolls; SofaGym's is 1e-4, with which it slides
    contact_distance: Distance = 0.0  # [R] m, surfaces rest that far apart; SofaGym's is 1e-4
    max_tilt: Positive = 0.2  # rad, about the axes x and y each
    tilt_rate: Positive = 4.0  # [R] rad/s, largest angular speed of the maze; SofaGym's turns within the action
    gravity: Gravity = (0.0, 0.0, -9.81)  # [R] m/s^2; SofaGym's is a tenth of it

    def __post_init__(self) -> None:
        """Refuse impossible values, and balls that do not fit."""
        check_options(self)
        name = type(self).__name__
        check_choice(self, "maze", MAZE_KINDS)
        if self.max_tilt > 1.0:
            raise ValueError(f"{name}: max_tilt must be at most 1 rad, got {self.max_tilt!r}")
        if self.mazes > MOST_MAZES:
            raise ValueError(f"{name}: mazes must be at most {MOST_MAZES}, got {self.mazes!r}")
        if self.maze == "serpentine" and self.mazes != 1:
            raise ValueError(f"{name}: there is one serpentine, mazes must be 1, got {self.mazes!r}; set maze='random'")
        if not 2.0 * self.rest_height < self.corridor:
            raise ValueError(
                f"{name}: ball_radius + contact_distance must be less than {0.5 * self.corridor:g} m, half of corridor,"
                f" got {self.ball_radius!r} + {self.contact_distance!r}; take a smaller ball or a wider corridor"
            )
        try:
            self.make_maze(0)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None

    def make_maze(self, number: int) -> Maze:
        """One of the mazes."""
        measures = {"corridor": self.corridor, "wall": self.wall, "height": self.wall_height, "floor": self.floor}
        if self.maze == "serpentine":
            return serpentine(**measures)
        return random_maze(self.columns, self.rows, seed=self.maze_seed + number, loops=self.loops, **measures)

    @property
    def rest_height(self) -> float:
        """Height of the ball's middle over the level floor [m]."""
        return self.ball_radius + self.contact_distance


@dataclass(kw_only=True)
class SimpleMazeConfig(SimpleMazeSceneConfig, EnvConfig):
    """Options of the SimpleMaze environment."""

    action_repeat: Count = 50  # [R] the ball rolls for 0.5 s; 200 let it settle, as the paper's protocol does
    max_episode_steps: Count = 50
    settle: bool = False  # the ball starts at rest on the floor
    end_on_success: bool = True
    action_kind: str = "discrete"  # "discrete" (four tilts) or "continuous" (a tilt about each axis)
    mask_opposite: bool = True  # whether the tilt opposite to the last one is no legal discrete action
    observation: str = "state"  # "state" or "paper"
    goal: str = "corner"  # "corner" (one of four) or "any" (anywhere on the middles of the corridors)
    goal_place: Places | None = None  # m, always this one; None draws it
    start: Places | None = None  # m, always this one; None: SofaGym's in the serpentine, else drawn
    least_way: Distance = 0.015  # m, from a drawn start or goal to the other along the corridors
    reward: str = "progress"  # [R] "progress" or "paper"
    reach_bonus: NotNegative = 5.0  # with reward="progress"
    success_tolerance: Length = 0.005  # m, how near the ball must come at any time; SofaGym's is 0.010

    def __post_init__(self) -> None:
        """Check names and places."""
        SimpleMazeSceneConfig.__post_init__(self)
        EnvConfig.__post_init__(self)
        check_choice(self, "action_kind", ACTION_KINDS)
        check_choice(self, "observation", OBSERVATION_KINDS)
        check_choice(self, "goal", GOAL_KINDS)
        check_choice(self, "reward", REWARD_KINDS)
        self._check_places()

    def _check_places(self) -> None:
        """Goals and starts in corridors, goals that cannot be met through a wall."""
        name = type(self).__name__
        apart = self.wall + 0.5 * self.corridor + self.ball_radius
        if self.success_tolerance >= apart:
            raise ValueError(
                f"{name}: success_tolerance must be less than {apart:.4g} m, or the goal is met from behind a wall, "
                f"got {self.success_tolerance!r}"
            )
        mazes = [self.make_maze(number) for number in range(self.mazes)]
        places = {option: getattr(self, option) for option in ("goal_place", "start")}
        for option, place in places.items():
            for maze in mazes if place is not None else ():
                try:
                    maze.cell_of(place)
                except ValueError as error:
                    raise ValueError(f"{name}: {option}: {error}") from None
        maze = mazes[0]
        if self.start is not None:
            away = [abs(x - c) for x, c in zip(self.start, maze.centres[maze.cell_of(self.start)], strict=True)]
            room = 0.5 * self.corridor - self.rest_height
            if min(away) > room + 1.0e-9:
                raise ValueError(
                    f"{name}: start must leave the ball free of the walls, within {room:.4g} m of a corridor's "
                    f"middle, got {self.start!r}"
                )
        farthest = float(maze.steps.max(axis=1).min()) * maze.pitch
        if self.least_way > 0.5 * farthest:
            raise ValueError(
                f"{name}: least_way must be at most {0.5 * farthest:.4g} m, so that every start has a goal, got "
                f"{self.least_way!r}"
            )

    @classmethod
    def paper(cls, **options: Any) -> SimpleMazeConfig:
        """The paper's protocol: 2 s per action, so that the ball settles, SofaGym's reward and observation."""
        faithful: dict[str, Any] = {
            "action_repeat": 200,
            "observation": "paper",
            "reward": "paper",
            "failure_penalty": 0.0,
        }
        return cls(**(faithful | options))
