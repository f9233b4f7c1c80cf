"""A ball in a maze that is tilted. Scene only; task: ``tasks/simple_maze.py``.

Frame: the middle of the floor's upper side is the origin, about which the maze turns; z is up while it is level. The
maze is a kinematic body; the ball is a rigid sphere that rolls.

Reference: SofaGym, scene of SimpleMaze.
"""

from __future__ import annotations

from dataclasses import dataclass

from softwarp import shapes
from softwarp.builder import ModelBuilder
from softwarp.envs.options.simple_maze import SimpleMazeSceneConfig
from softwarp.meshing import Maze
from softwarp.scene import RigidBody

CONTACT_CAPACITY = 8  # per world


@dataclass(frozen=True)
class MazeScene:
    """Ids of what was added to the builder, and the mazes."""

    ball: RigidBody
    maze: RigidBody
    mazes: tuple[Maze, ...]


def build_maze_scene(config: SimpleMazeSceneConfig, builder: ModelBuilder, *, start: tuple[float, float]) -> MazeScene:
    """Add the maze and its ball to a builder.

    Args:
        config: Options.
        builder: What the scene is added to.
        start: Start of the ball's middle in the plane [m].
    """
    mazes = tuple(config.make_maze(number) for number in range(config.mazes))
    pose = (*start, config.rest_height)
    ball = builder.add_rigid(shapes.Sphere(config.ball_radius), mass=config.ball_mass, pose=pose, name="ball")
    solids = [maze_shape(maze) for maze in mazes]
    shape = solids[0] if len(solids) == 1 else shapes.OneOf(solids, name="mazes")
    maze = builder.add_rigid(shape, kinematic=True, max_spin=config.tilt_rate, name="maze")
    builder.add_contact(ball, maze, mu=config.mu, contact_distance=config.contact_distance)
    return MazeScene(ball, maze, mazes)


def maze_shape(maze: Maze) -> shapes.Mesh:
    """Floor and walls as a rigid shape."""
    surface = maze.surface()
    return shapes.Mesh(surface.nodes, surface.triangles, convex=False, name=maze.name)
