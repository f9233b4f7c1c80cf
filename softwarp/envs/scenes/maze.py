"""A maze on a soft tripod, and a ball in it. Scene only; task: ``tasks/maze.py``.

Frame: that of ``scenes/tripod.py``, z up, three servos below. The maze is the tripod's plate: one rigid body, whose
frame is that of ``scenes/simple_maze.py``, the middle of the floor's upper side.

Reference: SofaGym, Maze scene. ``MazeConfig.paper`` lists what differs by default.
"""

from __future__ import annotations

from dataclasses import dataclass

from softwarp import shapes
from softwarp.builder import ModelBuilder
from softwarp.envs.options.maze import MazeSceneConfig
from softwarp.envs.scenes.simple_maze import maze_shape
from softwarp.envs.scenes.tripod import HEIGHT, TripodScene, build_tripod_scene
from softwarp.meshing import Maze
from softwarp.scene import RigidBody

GAP = 0.0015  # m, between the tripod's upper face and the maze
AWAY = 0.2  # m, height at which the ball waits until the tripod is at rest
CONTACT_CAPACITY = 8  # per world: what a ball touches at the same time, and comes near to


@dataclass(frozen=True)
class TripodMazeScene:
    """Ids of what was added to the builder, and the mazes."""

    ball: RigidBody
    maze: RigidBody
    mazes: tuple[Maze, ...]
    tripod: TripodScene


def build_tripod_maze_scene(config: MazeSceneConfig, builder: ModelBuilder) -> TripodMazeScene:
    """Add the flat tripod, its servos, the maze on it and a ball far above to a builder."""
    mazes = tuple(config.make_maze(number) for number in range(config.mazes))
    solids = [maze_shape(maze) for maze in mazes]
    shape = solids[0] if len(solids) == 1 else shapes.OneOf(solids, name="mazes")
    ball = builder.add_rigid(
        shapes.Sphere(config.ball_radius), mass=config.ball_mass, pose=(0.0, 0.0, AWAY), name="ball"
    )
    x, y = config.maze_offset
    plate = {"shape": shape, "mass": config.maze_mass, "pose": (x, y, HEIGHT + GAP + config.floor)}
    tripod = build_tripod_scene(config, builder, plate)
    builder.add_contact(ball, tripod.plate, mu=config.mu, contact_distance=config.contact_distance)
    return TripodMazeScene(ball, tripod.plate, mazes, tripod)
