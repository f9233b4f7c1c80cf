"""Trunk reach: a cable-driven silicone trunk, sagging under gravity, brings its tip to a point.

Scene        scenes/trunk.py: 8 displacement-controlled cables that only pull; 20 Hz control, 5 sub-steps of 10 ms
Action       continuous: (8,) in [-1, 1], change of the commanded displacements, +-5 mm per action
             absolute:   (8,) in [-1, 1], displacements from slackest to shortest, approached by 5 mm per action
             discrete:   16 choices, 0-7 shorten and 8-15 lengthen that cable by 5 mm
Observation  compact: 40 numbers of order 1, see ``COMPACT``
             paper:   66 raw metres: 21 stations (mean of the long cables' points), then the goal
Goal         workspace: a point that the tip was seen to reach, jittered by 2 mm;  list: one of ``goal_list``
Reward       shaped: progress (d_prev - d) / 10 mm;  precision 1 / (1 + (d / 10 mm)^2);  effort -0.01 mean(a^2)
             paper:  min(sqrt(max((d_prev - d) / d_prev, 0)), 1)
Ends         terminated on a failed world, and on success if ``end_on_success``; truncated after 250 actions (12.5 s)
Success      tip within 5 mm of the goal (``success_tolerance``; 1 mm is SofaGym's and the strict level)

By default an episode does not end at success: the agent has to hold the tip there, and the last distance tells how well
it does. Commands are clamped to the cables' limits and never more than ``max_slack`` looser than the cable, so that
pulling takes effect within one action. ``TrunkConfig.paper`` sets all options to SofaGym's behaviour.

The elements are SOFA's linear tetrahedra with SOFA's rotation: parity, which costs truth, as they are too stiff. With
``fidelity="accurate"``, quadratic ones on a round mesh whose grooves bend as converged ones do, the trunk takes 1.1 to
1.5 times the time of a step, and the tip without cables hangs 169 mm low under its weight instead of 140 mm (converged:
170 mm). A policy for a real trunk needs these elements or a modulus that is fitted to it. Goals are those that the
default trunk reaches; inverse control meets 88 % of them with the accurate one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from softwarp.builder import ModelBuilder
from softwarp.envs import randomization, rewards
from softwarp.envs.gradients import Seen
from softwarp.envs.options.trunk import TrunkConfig
from softwarp.envs.scenes.trunk import (
    LONG_CABLES,
    SHORT_CABLES,
    STATIONS,
    TrunkScene,
    build_trunk_scene,
)
from softwarp.envs.sums import length_of, mean_of
from softwarp.envs.tasks.cable_reach import ACTION_KINDS as ACTION_KINDS
from softwarp.envs.tasks.cable_reach import (
    COMPACT_LIMIT,
    FreeReach,
    compact_layout,
    compact_scale,
    reachable_file,
)

CABLES = LONG_CABLES + SHORT_CABLES

# Compact observation: name, entries, divisor to order 1.
COMPACT = (
    ("tip", 3, 0.1),  # m
    ("tip_v", 3, 0.5),  # m/s
    ("goal", 3, 0.1),  # m
    ("error", 3, 0.05),  # m, goal - tip
    ("fine_error", 3, 1.0),  # error / (|error| + 10 mm): a direction that still tells millimetres apart
    ("command", 8, 0.05),  # m, commanded displacements
    ("tension", 8, 10.0),  # N
    ("stations", 9, 0.1),  # m, three points along the axis
)
COMPACT_STATIONS = (5, 10, 15)
FINE_ERROR = 0.010  # m
PAPER_LIMIT = 0.5  # m
PAPER_GOAL_OFFSET = (0.0, -0.1, 0.1)  # m, SofaGym adds its marker's start to the goal that it observes

_STREAM_YOUNGS, _STREAM_DAMPING, _STREAM_GRAVITY = range(1, 4)


class Trunk(FreeReach):
    """See the table at the top of this file."""

    config: TrunkConfig
    scene: TrunkScene
    viewed_from = (0.74, 0.24, 0.63)  # from the side and a little above, y is up

    # Of ``InverseController``: cables compress the trunk beyond what it bears under imposed tensions; 2 % of its size.
    steering: ClassVar[dict[str, Any]] = {"settle": 0.003, "max_step": 0.004}  # m

    @property
    def gravity(self) -> tuple[float, float, float]:
        """Acceleration of the scene [m/s^2]."""
        return self.config.gravity

    def build_scene(self, builder: ModelBuilder) -> None:
        """Trunk, clamp, cables, tip markers."""
        self.scene = build_trunk_scene(self.config, builder)

    def displacement_limits(self) -> tuple[Tensor, Tensor]:
        """Those of the long cables, then those of the short ones."""

        def per_cable(limits: tuple[float, float]) -> Tensor:
            return torch.tensor([limits[0]] * LONG_CABLES + [limits[1]] * SHORT_CABLES)

        return per_cable(self.config.min_displacement), per_cable(self.config.max_displacement)

    def choices(self) -> list[tuple[int, float]]:
        """Shorten one cable, then lengthen one."""
        return [(cable, sign) for sign in (1.0, -1.0) for cable in range(CABLES)]

    def goal_table(self) -> Tensor:
        """The list, or points that the tip was seen at."""
        return self.listed_or_reachable(reachable_points())

    def setup(self) -> None:
        """Allocate goals, commands and constants."""
        super().setup()
        config, device = self.config, self.device
        self._long_points = slice(0, LONG_CABLES * STATIONS)
        self._stations = torch.tensor(COMPACT_STATIONS, device=device)
        self._goal_shift = torch.tensor(PAPER_GOAL_OFFSET if config.goal_offset else (0.0, 0.0, 0.0), device=device)
        self._nominal_rayleigh = torch.tensor(config.rayleigh, device=device)
        self._scale = compact_scale(COMPACT).to(device)
        self.observation_layout, self.length_scale = observation_layout(config.observation)

    def reset_worlds(self, mask: Tensor) -> None:
        """New goal, zero commands, new parameters."""
        super().reset_worlds(mask)
        self._randomize(mask[:, None])

    def _randomize(self, chosen: Tensor) -> None:
        """Draw the parameters that have a range."""
        config, params = self.config, self.sim.params

        def assign(target: Tensor, value: Tensor) -> None:
            target.copy_(torch.where(chosen, value.to(target.dtype), target))

        if config.youngs_range is not None:
            assign(params.youngs, randomization.in_range(self.draw(_STREAM_YOUNGS, 1), config.youngs_range))
        if config.damping_range is not None:
            factor = randomization.in_range(self.draw(_STREAM_DAMPING, 1), config.damping_range)
            assign(params.rayleigh_mass, factor * self._nominal_rayleigh[0])
            assign(params.rayleigh_stiffness, factor * self._nominal_rayleigh[1])
        if config.gravity_tilt > 0.0:
            u = self.draw(_STREAM_GRAVITY, 2)
            direction = randomization.direction_in_cone(u, config.gravity, config.gravity_tilt)
            assign(params.gravity, float(np.linalg.norm(config.gravity)) * direction)

    @property
    def tip_markers(self) -> tuple[int, ...]:
        """Markers whose mean is to come to the goal."""
        return self.scene.tip_markers

    def tip_from(self, seen: Seen) -> Tensor:
        """Mean of the long cables' ends [m], shape (world, 3)."""
        return mean_of(seen.marker_x)

    def stations(self) -> Tensor:
        """Points along the axis, mean of the long cables' points [m], shape (world, 21, 3)."""
        return self._stations_from(self.sim).to(torch.float32)

    def _stations_from(self, seen: Seen) -> Tensor:
        points = seen.cable_x[:, self._long_points].unflatten(1, (LONG_CABLES, STATIONS))
        mean: Tensor = mean_of(points)
        return mean

    def observation_bounds(self) -> dict[str, tuple[Tensor, Tensor]]:
        """The same symmetric limit for every entry."""
        if self.config.observation == "paper":
            high = torch.full((3 * STATIONS + 3,), PAPER_LIMIT)
        else:
            high = torch.full((self._scale.shape[0],), COMPACT_LIMIT)
        return {"observation": (-high, high)}

    def observation_from(self, seen: Seen, held: Mapping[str, Tensor]) -> Tensor:
        """The kind that was asked for."""
        goal = held["goal"] + self._goal_shift
        real = goal.dtype
        stations = self._stations_from(seen).to(real)
        if self.config.observation == "paper":
            return torch.cat((stations.flatten(1), goal), dim=1)
        tip = self.tip_from(seen).to(real)
        error = goal - tip
        parts = (
            tip,
            mean_of(seen.marker_v),
            goal,
            error,
            error / (length_of(error)[:, None] + FINE_ERROR),
            held["command"],
            seen.cable_tension,
            stations[:, self._stations].flatten(1),
        )
        return torch.cat(parts, dim=1).to(real) * self._scale

    def reward_terms(self, action: Tensor, distance: Tensor) -> dict[str, Tensor]:
        """See the table at the top."""
        if self.config.reward == "paper":
            return {"relative_progress": rewards.relative_progress(self.distance, distance)}
        return super().reward_terms(action, distance)

    def shown_region(self) -> NDArray[np.float64] | None:
        """The trunk at rest beside its goals, which lie wherever the tip comes [m]."""
        return None if self.config.goals == "list" else np.asarray(self.sim.model.node_rest, dtype=np.float64)


def observation_layout(kind: str) -> tuple[dict[str, slice], float]:
    """Where each quantity stands in an observation, and metres per unit of its ``tip`` and ``goal``."""
    if kind == "paper":
        end = 3 * STATIONS
        return {"stations": slice(0, end), "tip": slice(end - 3, end), "goal": slice(end, end + 3)}, 1.0
    return compact_layout(COMPACT)


def reachable_points() -> np.ndarray:
    """Tip positions [m], float32 (point, 3); made by assets/trunk/reachable.py with the default scene."""
    return reachable_file("trunk_reachable.npz")
