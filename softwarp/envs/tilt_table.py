"""Servo angles that hold a tripod's plate at tilts, at rest and at the height at which it starts: a table.

A twin of the scene has one world per tilt of a square grid. All of them take Newton steps with the derivative of the
level plate, theta += J^-1 (wished - measured), and come to rest after each. Between the tilts of the grid angles are
bilinear. Tables are kept for scenes that are equal in all their options.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from torch import Tensor

from softwarp.envs.options.maze import MazeSceneConfig
from softwarp.envs.options.tripod import SERVOS
from softwarp.envs.sums import length_of

SIDE = 5  # tilts of the grid towards x and y each
NUDGE = 0.02  # rad, of one servo for the derivative
ROUNDS = 8  # Newton steps
REST = 0.4  # s between them
MOST_ERROR = 0.01  # rad and cm by which the best angles may miss a tilt and a height

_KEPT: dict[Any, Tensor] = {}


class TiltTable:
    """Angles for tilts.

    Args:
        angles: Of the servos [rad], (tilt towards x, tilt towards y, servo), both tilts rising from -most to most.
        most: Largest tilt [rad].
    """

    def __init__(self, angles: Tensor, most: float) -> None:
        self._table = angles.flatten(0, 1)
        self._side, self._most = len(angles), most
        self._stride = torch.tensor([self._side, 1], device=angles.device)

    @classmethod
    def of(cls, env: Any) -> TiltTable:
        """The table of the scene of a Maze.

        Raises:
            ValueError: If the servos cannot hold the largest tilts.
        """
        fields = [field.name for field in dataclasses.fields(MazeSceneConfig)]
        key = (*(str(getattr(env.config, name)) for name in fields), env.config.dt, env.config.newton_iterations)
        if key not in _KEPT:
            _KEPT[key] = _measured(env).cpu()
        return cls(_KEPT[key].to(env.device), env.config.max_tilt)

    def angles(self, tilt: Tensor) -> Tensor:
        """Angles [rad] that hold tilts down towards x and y [rad], (world, 2) -> (world, 3)."""
        place = (0.5 * (tilt / self._most + 1.0) * (self._side - 1)).clamp(0.0, self._side - 1.0)
        low = place.floor().clamp(max=self._side - 2.0)
        share = place - low
        first = (low.long() * self._stride).sum(dim=1)
        x, y = share[:, :1], share[:, 1:]
        near = torch.lerp(self._table[first], self._table[first + 1], y)
        far = torch.lerp(self._table[first + self._side], self._table[first + self._side + 1], y)
        return torch.lerp(near, far, x)


def _measured(env: Any) -> Tensor:
    """Angles (SIDE, SIDE, 3) of the worlds of a Maze's twin."""
    config, scene = env.config, env.scene.tripod
    sim = env.make_simulation(SIDE * SIDE)
    motors, steps = list(scene.motors), round(REST / config.dt)
    line = torch.linspace(-config.max_tilt, config.max_tilt, SIDE, dtype=torch.float64)
    wished = torch.cartesian_prod(line, line).to(env.device)

    def rest(angles: Tensor) -> Tensor:
        """Tilt [rad] and height [cm] at rest, float64 (world, 3)."""
        start = sim.control.joint_target[:, motors].clone()
        for step in range(steps):
            share = min(1.0, 2.0 * (step + 1) / steps)
            sim.control.joint_target[:, motors] = torch.lerp(start, angles.to(start), share)
            sim.step()
        x, y, z, w = sim.frame_pose[:, scene.plate, 3:].double().unbind(dim=1)
        level = torch.stack((2.0 * (x * z + y * w), 2.0 * (y * z - x * w)), dim=1)
        length = length_of(level)[:, None]
        angle = torch.atan2(length, 1.0 - 2.0 * (x * x + y * y)[:, None])
        height = 100.0 * sim.marker_x[:, scene.middle, 2:].double()
        return torch.cat((angle * level / length.clamp_min(1.0e-12), height), dim=1)

    home = torch.full((SIDE * SIDE, SERVOS), config.angle, dtype=torch.float64, device=env.device)
    level = rest(home)
    nudged = home.clone()
    nudged[:SERVOS] += NUDGE * torch.eye(SERVOS, dtype=torch.float64, device=env.device)
    inverse, singular = torch.linalg.inv_ex((rest(nudged)[:SERVOS] - level[:SERVOS]) / NUDGE)  # rows: servo
    if int(singular):
        raise ValueError(
            f"{type(config).__name__}: the servos do not tilt the maze: turned by {NUDGE:g} rad each from "
            f"angle={config.angle:g} rad they leave it as it was; look at max_speed, max_torque, max_angle and "
            "advance, or lighten what they carry"
        )
    targets = torch.cat((wished, level[:, 2:]), dim=1)
    angles, found = home, level
    for _ in range(ROUNDS):
        angles = (angles + (targets - found) @ inverse).clamp(config.min_angle, config.max_angle)
        found = rest(angles)
    missed = float((targets - found).abs().max())
    if not missed <= MOST_ERROR:
        raise ValueError(
            f"{type(config).__name__}: the servos do not hold tilts of max_tilt={config.max_tilt:g} rad from "
            f"angle={config.angle:g} rad: some are missed by {missed:.3g} rad; tilt less, or start nearer to -1 rad"
        )
    return angles.reshape(SIDE, SIDE, SERVOS).float()
