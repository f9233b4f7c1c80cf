"""Trunk reach: a cable-driven silicone trunk, sagging under gravity, brings its tip to a point.

Scene        trunk_scene.py: 8 displacement-controlled cables that only pull; 20 Hz control, 5 sub-steps of 10 ms
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
quadratic ones between the same nodes (``element="p2", rotation="polar"``, 26 times the time of a step) the tip hangs
154 mm low under its weight instead of 140 mm (10 %), the same 20 mm of a lateral cable lead to a place 25 mm away (12 %
of the way), and the cable pulls with 0.35 N instead of 0.9 N. A policy for a real trunk needs these elements or a
modulus that is fitted to it.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from importlib import resources
from typing import Any

import numpy as np
import torch
from torch import Tensor

from softwarp.builder import ModelBuilder
from softwarp.envs import randomization, rewards
from softwarp.envs.base import EnvConfig, SoftEnv, check_choice
from softwarp.envs.trunk_scene import (
    LONG_CABLES,
    SHORT_CABLES,
    STATIONS,
    TrunkScene,
    TrunkSceneConfig,
    build_trunk_scene,
)

CABLES = LONG_CABLES + SHORT_CABLES
ACTION_KINDS = ("continuous", "absolute", "discrete")
OBSERVATION_KINDS = ("compact", "paper")
GOAL_KINDS = ("workspace", "list")
GOAL_SPLITS = ("train", "eval", "all")
REWARD_KINDS = ("shaped", "paper")

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
COMPACT_LIMIT = 10.0
COMPACT_STATIONS = (5, 10, 15)
FINE_ERROR = 0.010  # m
PAPER_LIMIT = 0.5  # m
PAPER_GOAL_OFFSET = (0.0, -0.1, 0.1)  # m, SofaGym adds its marker's start to the goal that it observes

_STREAM_GOAL, _STREAM_YOUNGS, _STREAM_DAMPING, _STREAM_GRAVITY = range(4)
_TRAIN_FRACTION = 0.8


@dataclass(kw_only=True)
class TrunkConfig(TrunkSceneConfig, EnvConfig):
    """Options of the Trunk environment."""

    action_kind: str = "continuous"  # "continuous", "absolute" or "discrete"
    action_step: float = 0.005  # m, largest change of a commanded displacement per action
    clamp_commands: bool = True  # keep commands within the cables' limits and slack; SofaGym lets them wind up
    max_slack: float = 0.005  # m, how much looser than the cable its command may be
    observation: str = "compact"  # "compact" or "paper"
    goal_offset: bool = False  # observe the goal displaced by ``PAPER_GOAL_OFFSET``, as SofaGym does
    goals: str = "workspace"  # "workspace" or "list"
    goal_list: list[list[float]] = field(default_factory=lambda: [[0.040, 0.040, 0.100], [-0.010, 0.020, 0.080]])  # m
    goal_split: str = "train"  # "train", "eval" or "all" points of the workspace; the first two are disjoint
    goal_jitter: float = 0.002  # m, uniform on each axis
    reward: str = "shaped"  # "shaped" or "paper"
    progress_scale: float = 0.010  # m of progress worth 1
    precision_scale: float = 0.010  # m at which precision is worth half its weight
    precision_weight: float = 1.0
    effort_weight: float = 0.01
    success_tolerance: float = 0.005  # m
    youngs_range: tuple[float, float] | None = None  # Pa, drawn per world at reset
    damping_range: tuple[float, float] | None = None  # factor on both Rayleigh coefficients, drawn per world at reset
    gravity_tilt: float = 0.0  # rad, gravity's direction is drawn from a cone of this half angle at reset

    def __post_init__(self) -> None:
        """Check names and ranges."""
        TrunkSceneConfig.__post_init__(self)
        EnvConfig.__post_init__(self)
        check_choice(self, "action_kind", ACTION_KINDS)
        check_choice(self, "observation", OBSERVATION_KINDS)
        check_choice(self, "goals", GOAL_KINDS)
        check_choice(self, "goal_split", GOAL_SPLITS)
        check_choice(self, "reward", REWARD_KINDS)
        self.goal_list = [[float(x) for x in point] for point in self.goal_list]
        if not self.goal_list or any(len(point) != 3 for point in self.goal_list):
            raise ValueError(f"TrunkConfig: goal_list must hold points (x, y, z) in metres, got {self.goal_list}")
        for name in ("youngs_range", "damping_range"):
            bounds = getattr(self, name)
            if bounds is not None:
                setattr(self, name, tuple(bounds))
                if not 0.0 < bounds[0] <= bounds[1]:
                    raise ValueError(f"TrunkConfig: {name} must be (low, high) with 0 < low <= high, got {bounds}")

    @classmethod
    def paper(cls, **options: Any) -> TrunkConfig:
        """SofaGym's behaviour, except that every action has exactly 5 sub-steps and episodes end after 250 actions."""
        faithful: dict[str, Any] = {
            "action_kind": "discrete",
            "observation": "paper",
            "goals": "list",
            "goal_offset": True,
            "reward": "paper",
            "settle": False,
            "clamp_commands": False,
            "cable_angle": 1.57,
            "success_tolerance": 0.001,
            "end_on_success": True,
            "failure_penalty": 0.0,
        }
        return cls(**(faithful | options))


class Trunk(SoftEnv):
    """See the table at the top of this file."""

    config: TrunkConfig
    scene: TrunkScene

    @property
    def gravity(self) -> tuple[float, float, float]:
        """Acceleration of the scene [m/s^2]."""
        return self.config.gravity

    def build_scene(self, builder: ModelBuilder) -> None:
        """Trunk, clamp, cables, tip markers."""
        self.scene = build_trunk_scene(self.config, builder)

    def setup(self) -> None:
        """Allocate goals, commands and constants."""
        config, device = self.config, self.device
        self.goal = self.add_world_state("goal", 3)
        self.command = self.add_world_state("command", CABLES)
        self._start = torch.zeros_like(self.command)
        self._change = torch.zeros_like(self.command)
        self._ramp = torch.zeros_like(self.command)

        def per_cable(limits: tuple[float, float]) -> Tensor:
            return torch.tensor([limits[0]] * LONG_CABLES + [limits[1]] * SHORT_CABLES, device=device)

        self._low, self._high = per_cable(config.min_displacement), per_cable(config.max_displacement)
        unit = torch.eye(CABLES, device=device)
        self._choices = config.action_step * torch.cat((unit, -unit))
        self._long_points = slice(0, LONG_CABLES * STATIONS)
        self._stations = torch.tensor(COMPACT_STATIONS, device=device)
        self._goal_shift = torch.tensor(PAPER_GOAL_OFFSET if config.goal_offset else (0.0, 0.0, 0.0), device=device)
        self._goal_table = self._load_goals().to(device)
        self._nominal_rayleigh = torch.tensor(config.rayleigh, device=device)
        self._scale = torch.cat([torch.full((size,), 1.0 / divisor) for _, size, divisor in COMPACT]).to(device)
        self.observation_layout, self.length_scale = observation_layout(config.observation)

    def _load_goals(self) -> Tensor:
        """Candidate goals [m], shape (goal, 3)."""
        if self.config.goals == "list":
            return torch.tensor(self.config.goal_list, dtype=torch.float32)
        table = reachable_points()
        cut = int(_TRAIN_FRACTION * len(table))
        rows = {"train": table[:cut], "eval": table[cut:], "all": table}[self.config.goal_split]
        return torch.from_numpy(rows.copy())

    def reset_worlds(self, mask: Tensor) -> None:
        """New goal, zero commands, new parameters."""
        chosen = mask[:, None]
        self.command.masked_fill_(chosen, 0.0)
        u = self.draw(_STREAM_GOAL, 4)
        count = len(self._goal_table)
        row = (u[:, 0] * count).to(torch.int64).clamp_(max=count - 1)  # the product may round up to count
        goal = self._goal_table[row]
        if self.config.goals == "workspace":
            goal = goal + self.config.goal_jitter * (2.0 * u[:, 1:] - 1.0)
        torch.where(chosen, goal, self.goal, out=self.goal)
        self._randomize(chosen)

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
    def action_size(self) -> int:
        """One number per cable."""
        return 0 if self.config.action_kind == "discrete" else CABLES

    @property
    def action_count(self) -> int:
        """Shorten or lengthen one cable."""
        return 2 * CABLES if self.config.action_kind == "discrete" else 0

    def apply_action(self, action: Tensor, substep: int) -> None:
        """Move the commanded displacements to their new values in equal parts."""
        if substep == 0:
            self._start.copy_(self.command)
            self._set_command(action)
            torch.sub(self.command, self._start, out=self._change)
        if substep == self.action_repeat - 1:
            self.sim.control.cable_displacement.copy_(self.command)
        else:
            torch.add(self._start, self._change, alpha=(substep + 1) / self.action_repeat, out=self._ramp)
            self.sim.control.cable_displacement.copy_(self._ramp)

    def _set_command(self, action: Tensor) -> None:
        """Displacements [m] to be reached at the end of this action."""
        config = self.config
        if config.action_kind == "discrete":
            self.command += self._choices[action]
        elif config.action_kind == "continuous":
            self.command += config.action_step * action.clamp(-1.0, 1.0)
        else:
            target = torch.lerp(self._low, self._high, 0.5 * (action.clamp(-1.0, 1.0) + 1.0))
            self.command += (target - self.command).clamp(-config.action_step, config.action_step)
        if config.clamp_commands:
            # A slack cable would ignore pulling until its command has caught up with it.
            loosest = self.sim.cable_displacement.to(self.command.dtype) - config.max_slack
            torch.fmax(self.command, torch.fmax(loosest, self._low), out=self.command)  # fmax: a NaN changes nothing
            torch.minimum(self.command, self._high, out=self.command)

    @property
    def tip_markers(self) -> tuple[int, ...]:
        """Markers whose mean is to come to the goal."""
        return self.scene.tip_markers

    def action_for(self, command: Tensor) -> Tensor:
        """The action that takes the commanded displacements nearest to ``command`` [m], shape (world, cable).

        A discrete action moves the cable that is farthest from its wish.
        """
        wish = command.to(self.command)
        change = (wish - self.command) / self.config.action_step
        if self.config.action_kind == "discrete":
            return torch.cat((change, -change), dim=-1).argmax(dim=-1)
        if self.config.action_kind == "absolute":
            return (2.0 * (wish - self._low) / (self._high - self._low) - 1.0).clamp(-1.0, 1.0)
        return change.clamp(-1.0, 1.0)

    def tip(self) -> Tensor:
        """Mean of the long cables' ends [m], shape (world, 3)."""
        return self.sim.marker_x.mean(dim=1).to(torch.float32)

    def stations(self) -> Tensor:
        """Points along the axis, mean of the long cables' points [m], shape (world, 21, 3)."""
        points = self.sim.cable_x[:, self._long_points].unflatten(1, (LONG_CABLES, STATIONS))
        mean: Tensor = points.mean(dim=1).to(torch.float32)
        return mean

    def observation_bounds(self) -> dict[str, tuple[Tensor, Tensor]]:
        """The same symmetric limit for every entry."""
        if self.config.observation == "paper":
            high = torch.full((3 * STATIONS + 3,), PAPER_LIMIT)
        else:
            high = torch.full((self._scale.shape[0],), COMPACT_LIMIT)
        return {"observation": (-high, high)}

    def observe(self) -> dict[str, Tensor]:
        """The kind that was asked for."""
        goal = self.goal + self._goal_shift
        stations = self.stations()
        if self.config.observation == "paper":
            return {"observation": torch.cat((stations.flatten(1), goal), dim=1)}
        tip = self.tip()
        error = goal - tip
        parts = (
            tip,
            self.sim.marker_v.mean(dim=1),
            goal,
            error,
            error / (error.norm(dim=-1, keepdim=True) + FINE_ERROR),
            self.command,
            self.sim.cable_tension,
            stations[:, self._stations].flatten(1),
        )
        return {"observation": torch.cat(parts, dim=1).to(torch.float32) * self._scale}

    def measure_distance(self) -> Tensor:
        """Tip to goal [m]."""
        distance: Tensor = torch.linalg.vector_norm(self.goal - self.tip(), dim=-1)
        return distance

    def is_success(self, distance: Tensor) -> Tensor:
        """Within the tolerance."""
        return distance <= self.config.success_tolerance

    def reward_terms(self, action: Tensor, distance: Tensor) -> dict[str, Tensor]:
        """See the table at the top."""
        config = self.config
        if config.reward == "paper":
            return {"relative_progress": rewards.relative_progress(self.distance, distance)}
        terms = {
            "progress": rewards.progress(self.distance, distance, config.progress_scale),
            "precision": config.precision_weight * rewards.cauchy(distance, config.precision_scale),
        }
        if self.action_size:
            terms["effort"] = config.effort_weight * rewards.effort(action.clamp(-1.0, 1.0))
        return terms

    def camera(self) -> Any:
        """From the side and a little above, with y up."""
        from softwarp.render import Camera

        return Camera(eye=(0.33, 0.07, 0.36), target=(0.0, -0.035, 0.08), up=(0.0, 1.0, 0.0), fov=31.0)


def observation_layout(kind: str) -> tuple[dict[str, slice], float]:
    """Where each quantity stands in an observation, and metres per unit of its ``tip`` and ``goal``."""
    if kind == "paper":
        end = 3 * STATIONS
        return {"stations": slice(0, end), "tip": slice(end - 3, end), "goal": slice(end, end + 3)}, 1.0
    layout, start = {}, 0
    for name, size, _ in COMPACT:
        layout[name] = slice(start, start + size)
        start += size
    return layout, next(divisor for name, _, divisor in COMPACT if name == "tip")


@functools.cache
def reachable_points() -> np.ndarray:
    """Tip positions [m] seen in equilibrium under random commands, float32 (point, 3), in random order.

    Made by assets/trunk/reachable.py with the default scene.
    """
    with resources.files("softwarp.envs").joinpath("trunk_reachable.npz").open("rb") as file:
        return np.asarray(np.load(file)["tip"], dtype=np.float32)
