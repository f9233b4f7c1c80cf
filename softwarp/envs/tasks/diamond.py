"""Diamond reach: a hollow silicone body with four legs, each pulled by a cable, brings its top to a point.

Scene        scenes/diamond.py: 4 displacement-controlled cables that only pull; 20 Hz control, 5 sub-steps of 10 ms
Action       continuous: (4,) in [-1, 1], change of the commanded displacements, +-5 mm per action
             absolute:   (4,) in [-1, 1], displacements from slackest to shortest, approached by 5 mm per action
             discrete:   8 choices, 2 k shortens and 2 k + 1 lengthens cable k by 5 mm
Observation  compact: 35 numbers of order 1, see ``COMPACT``
             paper:   18 raw metres: top, four elbows, a point 10 mm below the top; the goal is not among them
Goal         workspace: a point that the top was seen to reach, jittered by 1 mm
             box:       uniform in +-30 mm along x and y and from 125 to 145 mm in height, often out of reach
             list:      one of ``goal_list``
Reward       shaped: progress (d_prev - d) / 10 mm;  precision 1 / (1 + (d / 5 mm)^2);  effort -0.01 mean(a^2)
             paper:  min(3 sqrt(max((d_best - d) / d_best, 0)), 1) with the episode's least distance so far, d_best
Ends         terminated on a failed world, and on success if ``end_on_success``; truncated after 50 actions (2.5 s)
Success      top within 5 mm of the goal (``success_tolerance``)

By default an episode does not end at success: the agent has to hold the top there, and the last distance tells how well
it does. Commands are clamped to the cables' limits and never more than ``max_slack`` looser than the cable.
``DiamondConfig.paper`` sets all options to SofaGym's behaviour.

The elements are SOFA's linear tetrahedra with SOFA's rotation: parity, which costs truth, as they are too stiff. With
quadratic ones between the same nodes (``element="p2", rotation="polar"``, 55 times the time of a step) 20 mm of one
cable lead to a place 1.4 mm away (7 % of the way) and take 0.9 N instead of 2.2 N: shapes that cables impose come out
nearly right, forces do not. ``fidelity="accurate"`` takes quadratic elements on the coarse mesh, as many nodes, with
moduli along the legs that make up for what these elements are still too stiff: the top is within 1.9 % of converged
ways under weights and pulls of all sizes up to those of 25 mm of all cables, where the default is 35 to 65 % off under
weights, at 1.2 to 1.4 times the time of a step. The same 20 mm take 0.9 N. Goals are those that the default body
reaches. Its cables end in patches of the elbows, 17 mm high, as points that cables pull at sink in the deeper the finer
a mesh is: so the top is within 2 % of converged ways under commanded lengths too, where the default is 1.4 to 16 % off.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from softwarp.builder import ModelBuilder
from softwarp.envs import randomization, rewards
from softwarp.envs.gradients import Seen
from softwarp.envs.options.diamond import DiamondConfig
from softwarp.envs.scenes.diamond import CABLES, DiamondScene, build_diamond_scene
from softwarp.envs.sums import length_of
from softwarp.envs.tasks.cable_reach import ACTION_KINDS as ACTION_KINDS
from softwarp.envs.tasks.cable_reach import (
    COMPACT_LIMIT,
    STREAM_GOAL,
    FreeReach,
    compact_layout,
    compact_scale,
    reachable_file,
)
from softwarp.render.camera import box_corners

# Compact observation: name, entries, divisor to order 1. Positions are relative to ``MIDDLE``.
COMPACT = (
    ("tip", 3, 0.03),  # m
    ("tip_v", 3, 0.2),  # m/s
    ("goal", 3, 0.03),  # m
    ("error", 3, 0.03),  # m, goal - tip
    ("fine_error", 3, 1.0),  # error / (|error| + 5 mm): a direction that still tells millimetres apart
    ("command", 4, 0.025),  # m, commanded displacements
    ("tension", 4, 2.0),  # N
    ("elbows", 12, 0.02),  # m, their displacements from rest
)
MIDDLE = (0.0, 0.0, 0.135)  # m, of the region that the top can reach
FINE_ERROR = 0.005  # m
PAPER_LIMIT = 0.5  # m
PAPER_GAIN = 3.0  # of SofaGym's reward
GOAL_BOX = ((-0.030, -0.030, 0.125), (0.030, 0.030, 0.145))  # m

_STREAM_YOUNGS = 1


class Diamond(FreeReach):
    """See the table at the top of this file."""

    config: DiamondConfig
    scene: DiamondScene
    viewed_from = (0.73, -0.59, 0.33)  # from a corner, a little above the elbows

    @property
    def gravity(self) -> tuple[float, float, float]:
        """Acceleration of the scene [m/s^2]."""
        return self.config.gravity

    def build_scene(self, builder: ModelBuilder) -> None:
        """Body, base, cables, markers."""
        self.scene = build_diamond_scene(self.config, builder)

    def displacement_limits(self) -> tuple[Tensor, Tensor]:
        """The same of all cables."""
        config = self.config
        return torch.full((CABLES,), config.min_displacement), torch.full((CABLES,), config.max_displacement)

    def choices(self) -> list[tuple[int, float]]:
        """Shorten and lengthen one cable after the other."""
        return [(cable, sign) for cable in range(CABLES) for sign in (1.0, -1.0)]

    def goal_table(self) -> Tensor:
        """The list, or points that the top was seen at; none for a box."""
        return torch.zeros((0, 3)) if self.config.goals == "box" else self.listed_or_reachable(reachable_points())

    def setup(self) -> None:
        """Allocate goals, commands and constants."""
        super().setup()
        config, device = self.config, self.device
        self.best = self.add_world_state("best")  # m, least distance of the episode
        self._first_command = torch.tensor(config.start_displacement, device=device)
        self._middle = torch.tensor(MIDDLE, device=device)
        self._elbows = torch.tensor(self.scene.markers[1 : 1 + CABLES], device=device)
        self._rest_elbows = self.sim.marker_x[:1, self._elbows].to(torch.float32).clone()
        self._box = torch.tensor(GOAL_BOX, device=device)
        self._scale = compact_scale(COMPACT).to(device)
        self.observation_layout, self.length_scale = observation_layout(config.observation)

    def draw_goals(self) -> Tensor:
        """Goals [m] of the running episodes, shape (world, 3)."""
        if self.config.goals == "box":
            return torch.lerp(self._box[0], self._box[1], self.draw(STREAM_GOAL, 4)[:, 1:])
        return super().draw_goals()

    def reset_worlds(self, mask: Tensor) -> None:
        """New goal, first commands, new parameters."""
        super().reset_worlds(mask)
        torch.where(mask, self.measure_distance(), self.best, out=self.best)
        if self.config.youngs_range is not None:
            youngs = randomization.in_range(self.draw(_STREAM_YOUNGS, 1), self.config.youngs_range)
            target = self.sim.params.youngs
            target.copy_(torch.where(mask[:, None], youngs.to(target.dtype), target))

    @property
    def tip_markers(self) -> tuple[int, ...]:
        """Markers whose mean is to come to the goal."""
        return (self.scene.effector,)

    def tip_from(self, seen: Seen) -> Tensor:
        """The top [m], shape (world, 3)."""
        return seen.marker_x[:, self.scene.effector]

    def observation_bounds(self) -> dict[str, tuple[Tensor, Tensor]]:
        """The same symmetric limit for every entry."""
        if self.config.observation == "paper":
            high = torch.full((3 * len(self.scene.markers),), PAPER_LIMIT)
        else:
            high = torch.full((self._scale.shape[0],), COMPACT_LIMIT)
        return {"observation": (-high, high)}

    def observation_from(self, seen: Seen, held: Mapping[str, Tensor]) -> Tensor:
        """The kind that was asked for."""
        goal = held["goal"]
        real = goal.dtype
        points = seen.marker_x.to(real)
        if self.config.observation == "paper":
            return points.flatten(1)
        tip = self.tip_from(seen).to(real)
        error = goal - tip
        parts = (
            tip - self._middle,
            seen.marker_v[:, self.scene.effector],
            goal - self._middle,
            error,
            error / (length_of(error)[:, None] + FINE_ERROR),
            held["command"],
            seen.cable_tension,
            (points[:, self._elbows] - self._rest_elbows).flatten(1),
        )
        return torch.cat(parts, dim=1).to(real) * self._scale

    def reward_terms(self, action: Tensor, distance: Tensor) -> dict[str, Tensor]:
        """See the table at the top."""
        best = self.best.clone()
        torch.fmin(best, distance, out=self.best)  # fmin: a world that failed keeps its best
        if self.config.reward == "paper":
            return {"best_progress": (PAPER_GAIN * rewards.relative_progress(best, distance)).clamp_max(1.0)}
        return super().reward_terms(action, distance)

    def shown_region(self) -> NDArray[np.float64]:
        """The robot, whose closed frame leans by little [m]."""
        return np.asarray(self.sim.model.node_rest, dtype=np.float64)

    def shown_goals(self) -> Tensor:
        """All goals that episodes may have, those of a box by its corners."""
        return torch.from_numpy(box_corners(GOAL_BOX)) if self.config.goals == "box" else super().shown_goals()


def observation_layout(kind: str) -> tuple[dict[str, slice], float]:
    """Where each quantity stands in an observation, and metres per unit of its ``tip`` and ``goal``."""
    if kind == "paper":
        return {"tip": slice(0, 3), "elbows": slice(3, 15), "below": slice(15, 18)}, 1.0
    return compact_layout(COMPACT)


def reachable_points() -> np.ndarray:
    """Positions of the top [m], float32 (point, 3); made by assets/diamond/reachable.py with the default scene."""
    return reachable_file("diamond_reachable.npz")
