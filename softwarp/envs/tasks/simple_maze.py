"""Simple maze: a maze is tilted so that a ball rolls through its corridors to a goal.

Scene        scenes/simple_maze.py: a maze of 60 x 60 mm that turns about two axes, a ball of 4 mm; 2 Hz control, 50
             sub-steps of 10 ms; ``SimpleMazeConfig.paper`` has 200, in which the ball comes to rest
Action       discrete:   4 tilts, down towards 0 (+x, +y), 1 (-x, +y), 2 (+x, -y), 3 (-x, -y), by ``max_tilt`` about
                         either axis; ``action_mask`` leaves out the one opposite to the last
             continuous: (2,) in [-1, 1] -> how far it is tilted down towards +x and +y / max_tilt
Observation  state: (19,), in the maze's frame: ball x, y / 30 mm; its velocity / 0.2 m/s; tilt down towards x, y /
             max_tilt; goal x, y / 30 mm; goal - ball / 30 mm; way left / 0.2 m; next two places where the way turns, or
             the goal, less ball / 15 mm; sides of the ball's cell that are open (east, north, west, south)
             paper: (13,): ball x, y, z / 30 mm, pose of the maze (position / 30 mm, quaternion), goal / 30 mm, world
             frame
Start        ball at rest near the middle, level maze; in random mazes in the middle of any cell
Goal         one of four corners, or anywhere on the middles of the corridors
Reward       progress: way_prev - way in cells of the maze, on the shortest way; reached +5; lost -5
             paper:    1 where the way left is shorter than ever before, or the goal is met, else 0
Ends         terminated on success (``end_on_success``), and if the ball leaves the maze; truncated after 50 actions
Success      the ball came within 5 mm of the goal during the action; ``distance`` is its least one

Random mazes (``maze="random"``) are perfect: there is one way between any two cells, unless ``loops`` opens more. The
hand-written policy tilts the maze along the shortest way.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from softwarp.builder import ModelBuilder
from softwarp.envs import rewards
from softwarp.envs.base import SoftEnv
from softwarp.envs.maze_ways import MazeWays
from softwarp.envs.options.simple_maze import ACTION_KINDS as ACTION_KINDS
from softwarp.envs.options.simple_maze import OBSERVATION_KINDS as OBSERVATION_KINDS
from softwarp.envs.options.simple_maze import REWARD_KINDS as REWARD_KINDS
from softwarp.envs.options.simple_maze import START, SimpleMazeConfig, SimpleMazeSceneConfig
from softwarp.envs.scenes.simple_maze import CONTACT_CAPACITY, MazeScene, build_maze_scene
from softwarp.envs.sums import length_of
from softwarp.render import Camera

PLACE, NEAR, WAY, SPEED = 0.030, 0.015, 0.2, 0.2  # m, m, m, m/s worth 1 in an observation
TILTS = ((1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0))  # towards x and y, of the discrete actions
LOST = 5.0  # reward that a lost ball costs
LIMIT = 4.0  # of observations
_NONE = -1  # no last action
_OWN = ("gravity", "tilt_rate", "contact_distance")  # options that say how it is simulated, not what the task is
_CANDIDATES = 8  # goals drawn, of which the first that is far enough counts

_STREAM_START, _STREAM_GOAL, _STREAM_MAZE = range(3)


class SimpleMaze(SoftEnv):
    """See the table at the top of this file."""

    config: SimpleMazeConfig
    scene: MazeScene
    tilts = TILTS
    goal_radius = 0.0012

    @property
    def gravity(self) -> tuple[float, float, float]:
        """Acceleration of the scene [m/s^2]."""
        return self.config.gravity

    def build_scene(self, builder: ModelBuilder) -> None:
        """Maze and ball."""
        start = self.config.start
        if start is None:
            first = self.config.make_maze(0).centres[0]
            start = START if self.config.maze == "serpentine" else (float(first[0]), float(first[1]))
        self.scene = build_maze_scene(self.config, builder, start=start)

    @property
    def contact_capacity(self) -> int:
        """Room for what the ball can touch at the same time."""
        return CONTACT_CAPACITY

    def setup(self) -> None:
        """Allocate goals, tilts and what progress is measured by; tables of the ways through the mazes."""
        config, sim, device = self.config, self.sim, self.device
        self.reward_range = (0.0, 1.0)  # of a step: a cell of progress, or more
        self.ways = MazeWays(self.scene.mazes, device)
        self.goal = self.add_world_state("goal", 3)  # m, in the maze's frame
        self.maze = self.add_world_state("maze", dtype=torch.int64)  # number
        self.goal_cell = self.add_world_state("goal_cell", dtype=torch.int64)
        self.goal_side = self.add_world_state("goal_side", dtype=torch.int64)
        self.goal_along = self.add_world_state("goal_along")  # m
        self.tilt = self.add_world_state("tilt", 2)  # rad, commanded, down towards x and y
        self.last_action = self.add_world_state("last_action", dtype=torch.int64)
        self.way = self.add_world_state("way")  # m, left
        self.least_way = self.add_world_state("least_way")  # m, least so far
        self.nearest = self.add_world_state("nearest")  # m, least distance within the action
        self._passed: list[Tensor] = []  # poses of all bodies before the sub-steps of an action
        self._ball, self._ball_v = sim.body_pose[:, self.scene.ball, :3], sim.body_twist[:, self.scene.ball, :3]
        self._pose, self._twist = sim.body_pose[:, self.scene.maze], sim.body_twist[:, self.scene.maze]
        self._command = sim.control.body_pose[:, self.scene.maze, 3:]
        self._tilts = config.max_tilt * torch.tensor(TILTS, device=device)
        self._legal = torch.ones((5, 4), dtype=torch.bool, device=device)  # after actions 0 to 3, and none
        if config.mask_opposite:
            for action in range(4):
                self._legal[action, 3 - action] = False
        corners = [maze.corners() for maze in self.scene.mazes]
        self._corners = torch.tensor(np.array(corners), device=device)
        self._fixed = [None if place is None else self._located(place) for place in (config.start, config.goal_place)]
        if config.start is None and config.maze == "serpentine":
            self._fixed[0] = self._located(START)
        self._start = torch.tensor(config.start or START, device=device)
        self._half = torch.tensor([0.5 * extent for extent in self.scene.mazes[0].size[:2]], device=device)
        size = 13 if config.observation == "paper" else 19
        self._limit = torch.full((size,), LIMIT, device=device)

    def _located(self, place: tuple[float, float]) -> tuple[Tensor, Tensor, Tensor]:
        """Cell, side and distance of the nearest place on a middle, in every maze, (maze,) each."""
        found = [maze.on_middle(place) for maze in self.scene.mazes]
        cell, side = (torch.tensor([entry[k] for entry in found], device=self.device) for k in range(2))
        return cell, side, torch.tensor([entry[2] for entry in found], dtype=torch.float32, device=self.device)

    # Episodes

    def reset_worlds(self, mask: Tensor) -> None:
        """Level the maze, place the ball, draw a goal."""
        maze = (self.draw(_STREAM_MAZE, 1)[:, 0] * len(self.scene.mazes)).long().clamp_max(len(self.scene.mazes) - 1)
        start, place = self._draw_start(maze)
        cell, side, along = self._draw_goal(maze, start)
        goal = self.ways.place_on(cell, side, along)
        torch.where(mask[:, None], goal, self.goal[:, :2], out=self.goal[:, :2])
        self.goal[:, 2].masked_fill_(mask, self.config.rest_height)
        for held, drawn in (
            (self.maze, maze),
            (self.goal_cell, cell),
            (self.goal_side, side),
            (self.goal_along, along),
        ):
            torch.where(mask, drawn, held, out=held)
        self.tilt.masked_fill_(mask[:, None], 0.0)
        self.last_action.masked_fill_(mask, _NONE)
        choice = self.sim.params.body_choice
        if choice.shape[1]:
            torch.where(mask[:, None], maze[:, None].to(choice.dtype), choice, out=choice)
        self.place_ball(place, mask)
        way = self.ways.remaining(maze, place, cell, side, along)
        for held in (self.way, self.least_way):
            torch.where(mask, way, held, out=held)
        torch.where(mask, length_of(place - goal), self.nearest, out=self.nearest)

    def place_ball(self, place: Tensor, mask: Tensor) -> None:
        """Put the ball on the floor at places in its plane [m], (world, 2)."""
        poses = self.sim.frame_pose.clone()
        poses[:, self.scene.ball, :2] = place.to(poses.dtype)
        self.place_frames(poses, mask)

    def _draw_start(self, maze: Tensor) -> tuple[Tensor, Tensor]:
        """Cell and place of the ball's start."""
        fixed = self._fixed[0]
        if fixed is not None:
            return fixed[0][maze], self._start.expand(self.num_worlds, 2)
        cell = (self.draw(_STREAM_START, 1)[:, 0] * self.ways.cells).long().clamp_max(self.ways.cells - 1)
        return cell, self.ways.centres[cell]

    def _draw_goal(self, maze: Tensor, start: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """A goal that is far enough from the start: cell, side and distance from the cell's middle."""
        fixed, ways = self._fixed[1], self.ways
        if fixed is not None:
            return fixed[0][maze], fixed[1][maze], fixed[2][maze]
        u = self.draw(_STREAM_GOAL, 3 * _CANDIDATES).unflatten(1, (3, _CANDIDATES))
        if self.config.goal == "corner":
            cells = self._corners[maze].gather(1, (4.0 * u[:, 0]).long().clamp_max(3))
        else:
            cells = (u[:, 0] * ways.cells).long().clamp_max(ways.cells - 1)
        steps = ways.steps_between(maze, start[:, None].expand_as(cells), cells)
        is_far = steps * ways.pitch >= self.config.least_way + ways.pitch
        first = torch.where(is_far.any(dim=1), is_far.to(torch.int8).argmax(dim=1), steps.argmax(dim=1))[:, None]
        cell = cells.gather(1, first)[:, 0]
        side, along = torch.zeros_like(cell), torch.zeros_like(u[:, 0, 0])
        if self.config.goal == "any":
            side = (4.0 * u[:, 1].gather(1, first)[:, 0]).long().clamp_max(3)
            is_open = ways.neighbours[maze, cell, side] >= 0
            along = torch.where(is_open, 0.5 * ways.pitch * u[:, 2].gather(1, first)[:, 0], along)
        return cell, side, along

    # Actions

    @property
    def action_size(self) -> int:
        """A tilt towards x and one towards y."""
        return 0 if self.config.action_kind == "discrete" else 2

    @property
    def action_count(self) -> int:
        """The four tilts."""
        return len(TILTS) if self.config.action_kind == "discrete" else 0

    def action_mask(self) -> Tensor | None:
        """All but the tilt opposite to the last one."""
        return None if self.config.action_kind == "continuous" else self._legal[self.last_action]

    def action_names(self) -> Sequence[str]:
        """Tilts."""
        if not self.action_count:
            return ("tilt to +x", "tilt to +y")
        return [f"tilt to {'+' if x > 0.0 else '-'}x, {'+' if y > 0.0 else '-'}y" for x, y in TILTS]

    def apply_action(self, action: Tensor, substep: int) -> None:
        """Tell the maze how to lie; it turns there as fast as it may."""
        self._follow_ball(substep)
        if substep:
            return
        if self.config.action_kind == "discrete":
            self.last_action.copy_(action)
            self.tilt.copy_(self._tilts[action])
        else:
            self.tilt.copy_(action.clamp(-1.0, 1.0) * self.config.max_tilt)
        self._command.copy_(turned(self.tilt))

    # What another robot can follow: planning/tracing.py

    target_kind = "normal"

    def plan_target(self) -> Tensor:
        """Where the floor's normal is told to point, (world, 3)."""
        up = torch.zeros_like(self.goal)
        up[:, 2] = 1.0
        return turned_to(turned(self.tilt), up)

    def tracked(self) -> Tensor:
        """The ball in the plane of the floor [m], (world, 2)."""
        return self.ball_place()[0][:, :2]

    def put(self, place: Tensor, velocity: Tensor, tilt: Tensor) -> None:
        """Put ball and maze of all worlds elsewhere; the ball rolls.

        Args:
            place: Of the ball in the plane of the floor [m], (world, 2).
            velocity: Of the ball in the maze's frame [m/s], (world, 2).
            tilt: Of the maze, down towards x and y [rad], (world, 2).
        """
        poses, q, zero = self.sim.frame_pose.clone(), turned(tilt), torch.zeros_like(place[:, :1])
        twists = torch.zeros_like(self.sim.frame_twist)
        height = zero + self.config.rest_height
        poses[:, self.scene.maze, 3:] = q.to(poses.dtype)
        poses[:, self.scene.ball, :3] = turned_to(q, torch.cat((place, height), dim=1)).to(poses.dtype)
        v = torch.cat((velocity, zero), dim=1)
        spin = torch.stack((-velocity[:, 1], velocity[:, 0]), dim=1) / self.config.ball_radius  # normal x v / r
        spin = torch.cat((spin, zero), dim=1)
        twists[:, self.scene.ball] = torch.cat((turned_to(q, v), turned_to(q, spin)), dim=1).to(twists.dtype)
        self.place_frames(poses, torch.ones_like(self._all), twists)
        self.tilt.copy_(tilt)
        self._command.copy_(q)
        for held in (self.way, self.least_way):
            held.copy_(self.ways.remaining(self.maze, place, self.goal_cell, self.goal_side, self.goal_along))
        self.nearest.copy_(self._distance())

    def task_options(self, world: int) -> dict[str, Any]:
        """Maze, ball, start and goal of a world."""
        names = [field.name for field in dataclasses.fields(SimpleMazeSceneConfig) if field.name not in _OWN]
        options: dict[str, Any] = {name: getattr(self.config, name) for name in (*names, "success_tolerance")}
        if self.config.maze == "random":
            options |= {"maze_seed": self.config.maze_seed + int(self.maze[world]), "mazes": 1}
        start, goal = ([round(x, 7) for x in places[world].tolist()] for places in (self.tracked(), self.goal[:, :2]))
        return options | {"start": tuple(start), "goal_place": tuple(goal)}

    # What is seen and measured

    def ball_place(self) -> tuple[Tensor, Tensor]:
        """Place [m] and velocity [m/s] of the ball in the maze's frame, (world, 3) each."""
        q, away = self._pose[:, 3:], self._ball - self._pose[:, :3]
        v = self._ball_v - self._twist[:, :3] - torch.linalg.cross(self._twist[:, 3:], away)
        place, velocity = turned_back(q, torch.stack((away, v))).float()
        return place, velocity

    def seen_tilt(self) -> Tensor:
        """The tilt that observations tell, down towards x and y [rad], (world, 2)."""
        return self.tilt

    def _follow_ball(self, substep: int) -> None:
        """Keep where the ball is before each sub-step; at the last one, how near to the goal it has come so far."""
        if substep == 0:
            self._passed.clear()
        self._passed.append(self.sim.body_pose.clone())
        if substep == self.action_repeat - 1:
            torch.amin(self._distance(torch.stack(self._passed)), dim=0, out=self.nearest)

    def _distance(self, poses: Tensor | None = None) -> Tensor:
        """Ball to goal in the plane of the floor [m], (..., world), now or where bodies have ``poses``."""
        poses = self.sim.body_pose if poses is None else poses
        ball, maze = poses[..., self.scene.ball, :3], poses[..., self.scene.maze, :]
        place = turned_back(maze[..., 3:], ball - maze[..., :3])[..., :2].float()
        return length_of(place - self.goal[:, :2])

    def measure_distance(self) -> Tensor:
        """Least distance of ball and goal within the action, in the plane of the floor [m]."""
        return torch.minimum(self.nearest, self._distance())

    def is_success(self, distance: Tensor) -> Tensor:
        """The ball has come to the goal."""
        return distance <= self.config.success_tolerance

    def is_terminated(self, distance: Tensor) -> Tensor:
        """The ball has left the maze."""
        return self._is_lost(self.ball_place()[0])

    def _is_lost(self, place: Tensor) -> Tensor:
        is_outside = (place[:, :2].abs() > self._half).any(dim=1)
        low, high = 0.0, self.config.wall_height + 4.0 * self.config.ball_radius
        return is_outside | (place[:, 2] < low) | (place[:, 2] > high)

    def reward_terms(self, action: Tensor, distance: Tensor) -> dict[str, Tensor]:
        """See the table at the top."""
        place, success = self.ball_place()[0], self.is_success(distance).float()
        way = self.ways.remaining(self.maze, place[:, :2], self.goal_cell, self.goal_side, self.goal_along)
        before, least = self.way.clone(), self.least_way.clone()
        self.way.copy_(way)
        torch.minimum(least, way, out=self.least_way)
        if self.config.reward == "paper":
            return {"progress": torch.maximum((way < least).float(), success)}
        return {
            "progress": rewards.progress(before, way, self.ways.pitch),
            "reached": self.config.reach_bonus * success,
            "lost": -LOST * self._is_lost(place).float(),
        }

    def observation_bounds(self) -> dict[str, tuple[Tensor, Tensor]]:
        """The same symmetric limit for every entry."""
        return {"observation": (-self._limit, self._limit)}

    def observe(self) -> dict[str, Tensor]:
        """See the table at the top."""
        if self.config.observation == "paper":
            pose = self._pose.float()
            goal = pose[:, :3] + turned_to(pose[:, 3:], self.goal)
            seen = (self._ball.float() / PLACE, pose[:, :3] / PLACE, pose[:, 3:], goal / PLACE)
            return {"observation": torch.cat(seen, dim=1)}
        place, v = (values[:, :2] for values in self.ball_place())
        way_to = (self.goal_cell, self.goal_side, self.goal_along)
        first, second = self.ways.waypoints(self.maze, place, *way_to)
        parts = (
            place / PLACE,
            v / SPEED,
            self.seen_tilt() / self.config.max_tilt,
            self.goal[:, :2] / PLACE,
            (self.goal[:, :2] - place) / PLACE,
            self.ways.remaining(self.maze, place, *way_to)[:, None] / WAY,
            (first - place) / NEAR,
            (second - place) / NEAR,
            self.ways.openings(self.maze, place).float(),
        )
        return {"observation": torch.cat(parts, dim=1)}

    def decode(self, observation: Tensor) -> dict[str, Tensor]:
        """Ball [m], its velocity [m/s], tilt [rad], and the next two places less ball [m], (..., 2) each.

        Raises:
            ValueError: If observations are the paper's, which do not hold the velocity.
        """
        if self.config.observation == "paper":
            raise ValueError("SimpleMaze: decode needs observation='state'; the paper's holds no velocity")
        return {
            "ball": PLACE * observation[..., :2],
            "ball_v": SPEED * observation[..., 2:4],
            "tilt": self.config.max_tilt * observation[..., 4:6],
            "first": NEAR * observation[..., 11:13],
            "second": NEAR * observation[..., 13:15],
        }

    def goal_points(self) -> Tensor:
        """Goals in the world's frame [m]."""
        pose = self._pose.float()
        return pose[:, :3] + turned_to(pose[:, 3:], self.goal)

    def camera(self) -> Camera:
        """From above, a little from the front."""
        x, y = (float(extent) for extent in self._half)
        reach = 2.0 * max(x, y)
        return Camera(eye=(0.0, -0.28 * reach, 1.62 * reach), target=(0.0, -0.01 * reach, 0.0), fov=42.0)

    def shown_region(self) -> NDArray[np.float64]:
        """Where the maze comes."""
        x, y = (float(extent) for extent in self._half)
        lowest = -self.config.floor - (x + y) * math.sin(self.config.max_tilt)
        return np.array([[-x, -y, lowest], [x, y, self.config.wall_height]])


def turned(tilt: Tensor) -> Tensor:
    """Quaternions (x, y, z, w) of a turn about the axis across the way down, (world, 2) [rad] -> (world, 4).

    Tilted down towards x by a, a plane has turned about y by a; towards y by b, about x by -b.
    """
    axis = torch.stack((-tilt[:, 1], tilt[:, 0]), dim=1)
    half = 0.5 * length_of(axis)[:, None]
    return torch.cat((0.5 * torch.sinc(half / torch.pi) * axis, torch.zeros_like(half), half.cos()), dim=1)


def turned_to(q: Tensor, v: Tensor) -> Tensor:
    """Vectors of a frame of orientation q in world axes, (world, 4), (world, 3)."""
    t = 2.0 * torch.linalg.cross(q[:, :3], v)
    result: Tensor = v + q[:, 3:] * t + torch.linalg.cross(q[:, :3], t)
    return result


def turned_back(q: Tensor, v: Tensor) -> Tensor:
    """Vectors (..., 3) of the world in the axes of frames of orientation q, (..., 4)."""
    axis = q[..., :3].expand_as(v)
    t = 2.0 * torch.linalg.cross(v, axis)
    result: Tensor = v + q[..., 3:] * t + torch.linalg.cross(t, axis)
    return result
