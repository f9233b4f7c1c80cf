"""Diamond reach: a hollow silicone body with four legs, each pulled by a cable, brings its top to a point.

Scene        diamond_scene.py: 4 displacement-controlled cables that only pull; 20 Hz control, 5 sub-steps of 10 ms
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
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field
from importlib import resources
from typing import Any

import numpy as np
import torch
from torch import Tensor

from softwarp.builder import ModelBuilder
from softwarp.envs import randomization, rewards
from softwarp.envs.base import EnvConfig, SoftEnv, check_choice
from softwarp.envs.diamond_scene import CABLES, DiamondScene, DiamondSceneConfig, build_diamond_scene

ACTION_KINDS = ("continuous", "absolute", "discrete")
OBSERVATION_KINDS = ("compact", "paper")
GOAL_KINDS = ("workspace", "box", "list")
GOAL_SPLITS = ("train", "eval", "all")
REWARD_KINDS = ("shaped", "paper")

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
COMPACT_LIMIT = 10.0
MIDDLE = (0.0, 0.0, 0.135)  # m, of the region that the top can reach
FINE_ERROR = 0.005  # m
PAPER_LIMIT = 0.5  # m
PAPER_GAIN = 3.0  # of SofaGym's reward
GOAL_BOX = ((-0.030, -0.030, 0.125), (0.030, 0.030, 0.145))  # m

_STREAM_GOAL, _STREAM_YOUNGS = range(2)
_TRAIN_FRACTION = 0.8


@dataclass(kw_only=True)
class DiamondConfig(DiamondSceneConfig, EnvConfig):
    """Options of the Diamond environment."""

    max_episode_steps: int = 50
    action_kind: str = "continuous"  # "continuous", "absolute" or "discrete"
    action_step: float = 0.005  # m, largest change of a commanded displacement per action
    clamp_commands: bool = True  # keep commands within the cables' limits and slack; SofaGym lets them wind up
    max_slack: float = 0.005  # m, how much looser than the cable its command may be
    start_displacement: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)  # m, commands at the start
    observation: str = "compact"  # "compact" or "paper"
    goals: str = "workspace"  # "workspace", "box" or "list"
    goal_list: list[list[float]] = field(default_factory=lambda: [[0.0, 0.0, 0.140], [0.010, -0.010, 0.135]])  # m
    goal_split: str = "train"  # "train", "eval" or "all" points of the workspace; the first two are disjoint
    goal_jitter: float = 0.001  # m, uniform on each axis
    reward: str = "shaped"  # "shaped" or "paper"
    progress_scale: float = 0.010  # m of progress worth 1
    precision_scale: float = 0.005  # m at which precision is worth half its weight
    precision_weight: float = 1.0
    effort_weight: float = 0.01
    success_tolerance: float = 0.005  # m
    youngs_range: tuple[float, float] | None = None  # Pa, drawn per world at reset

    def __post_init__(self) -> None:
        """Check names and ranges."""
        DiamondSceneConfig.__post_init__(self)
        EnvConfig.__post_init__(self)
        check_choice(self, "action_kind", ACTION_KINDS)
        check_choice(self, "observation", OBSERVATION_KINDS)
        check_choice(self, "goals", GOAL_KINDS)
        check_choice(self, "goal_split", GOAL_SPLITS)
        check_choice(self, "reward", REWARD_KINDS)
        self.goal_list = [[float(x) for x in point] for point in self.goal_list]
        if not self.goal_list or any(len(point) != 3 for point in self.goal_list):
            raise ValueError(f"DiamondConfig: goal_list must hold points (x, y, z) in metres, got {self.goal_list}")
        self.start_displacement = tuple(float(x) for x in self.start_displacement)
        if len(self.start_displacement) != CABLES:
            raise ValueError(
                f"DiamondConfig: start_displacement must hold {CABLES} lengths in metres, got {self.start_displacement}"
            )
        if self.action_kind == "absolute" and not math.isfinite(self.max_displacement - self.min_displacement):
            raise ValueError(
                "DiamondConfig: absolute actions need finite displacement limits, got "
                f"{self.min_displacement} and {self.max_displacement}; set them or choose action_kind='continuous'"
            )
        if self.youngs_range is not None:
            low, high = self.youngs_range
            self.youngs_range = (low, high)
            if not 0.0 < low <= high:
                raise ValueError(
                    f"DiamondConfig: youngs_range must be (low, high) with 0 < low <= high, got {low, high}"
                )

    @classmethod
    def paper(cls, **options: Any) -> DiamondConfig:
        """SofaGym's behaviour, except that every action has exactly 5 sub-steps and episodes end after 50 actions.

        Its action step of 6.25 mm, its north cable that starts 20 mm short, and cables that also push are all kept.
        """
        faithful: dict[str, Any] = {
            "action_kind": "discrete",
            "action_step": 0.00625,
            "observation": "paper",
            "goals": "box",
            "reward": "paper",
            "settle": False,
            "clamp_commands": False,
            "start_displacement": (0.020, 0.0, 0.0, 0.0),
            "base_half": 0.015,
            "min_tension": -math.inf,
            "min_displacement": -math.inf,
            "max_displacement": math.inf,
            "max_rate": math.inf,
            "end_on_success": True,
            "failure_penalty": 0.0,
        }
        return cls(**(faithful | options))


class Diamond(SoftEnv):
    """See the table at the top of this file."""

    config: DiamondConfig
    scene: DiamondScene

    @property
    def gravity(self) -> tuple[float, float, float]:
        """Acceleration of the scene [m/s^2]."""
        return self.config.gravity

    def build_scene(self, builder: ModelBuilder) -> None:
        """Body, base, cables, markers."""
        self.scene = build_diamond_scene(self.config, builder)

    def setup(self) -> None:
        """Allocate goals, commands and constants."""
        config, device = self.config, self.device
        self.goal = self.add_world_state("goal", 3)
        self.command = self.add_world_state("command", CABLES)
        self.best = self.add_world_state("best")  # m, least distance of the episode
        self._start = torch.zeros_like(self.command)
        self._change = torch.zeros_like(self.command)
        self._ramp = torch.zeros_like(self.command)
        self._first_command = torch.tensor(config.start_displacement, device=device)
        self._low = torch.full((CABLES,), config.min_displacement, device=device)
        self._high = torch.full((CABLES,), config.max_displacement, device=device)
        unit = torch.eye(CABLES, device=device)
        self._choices = config.action_step * torch.stack((unit, -unit), dim=1).flatten(0, 1)
        self._middle = torch.tensor(MIDDLE, device=device)
        self._elbows = list(self.scene.markers[1 : 1 + CABLES])
        self._rest_elbows = self.sim.marker_x[:1, self._elbows].to(torch.float32).clone()
        self._box = torch.tensor(GOAL_BOX, device=device)
        self._goal_table = self._load_goals().to(device)
        self._scale = torch.cat([torch.full((size,), 1.0 / divisor) for _, size, divisor in COMPACT]).to(device)
        self.observation_layout, self.length_scale = observation_layout(config.observation)

    def _load_goals(self) -> Tensor:
        """Candidate goals [m], shape (goal, 3); none for a box."""
        if self.config.goals == "list":
            return torch.tensor(self.config.goal_list, dtype=torch.float32)
        if self.config.goals == "box":
            return torch.zeros((0, 3))
        table = reachable_points()
        cut = int(_TRAIN_FRACTION * len(table))
        rows = {"train": table[:cut], "eval": table[cut:], "all": table}[self.config.goal_split]
        return torch.from_numpy(rows.copy())

    def _draw_goals(self) -> Tensor:
        """Goals [m] of the running episodes, shape (world, 3)."""
        u = self.draw(_STREAM_GOAL, 4)
        if self.config.goals == "box":
            return torch.lerp(self._box[0], self._box[1], u[:, 1:])
        count = len(self._goal_table)
        row = (u[:, 0] * count).to(torch.int64).clamp_(max=count - 1)  # the product may round up to count
        goal = self._goal_table[row]
        if self.config.goals == "workspace":
            goal = goal + self.config.goal_jitter * (2.0 * u[:, 1:] - 1.0)
        return goal

    def reset_worlds(self, mask: Tensor) -> None:
        """New goal, first commands, new parameters."""
        chosen = mask[:, None]
        torch.where(chosen, self._first_command, self.command, out=self.command)
        torch.where(chosen, self._draw_goals(), self.goal, out=self.goal)
        torch.where(mask, self.measure_distance(), self.best, out=self.best)
        if self.config.youngs_range is not None:
            youngs = randomization.in_range(self.draw(_STREAM_YOUNGS, 1), self.config.youngs_range)
            target = self.sim.params.youngs
            target.copy_(torch.where(chosen, youngs.to(target.dtype), target))

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
        return (self.scene.effector,)

    def action_for(self, command: Tensor) -> Tensor:
        """The action that takes the commanded displacements nearest to ``command`` [m], shape (world, cable).

        A discrete action moves the cable that is farthest from its wish.
        """
        wish = command.to(self.command)
        change = (wish - self.command) / self.config.action_step
        if self.config.action_kind == "discrete":
            return torch.stack((change, -change), dim=-1).flatten(1).argmax(dim=-1)
        if self.config.action_kind == "absolute":
            return (2.0 * (wish - self._low) / (self._high - self._low) - 1.0).clamp(-1.0, 1.0)
        return change.clamp(-1.0, 1.0)

    def tip(self) -> Tensor:
        """The top [m], shape (world, 3)."""
        return self.sim.marker_x[:, self.scene.effector].to(torch.float32)

    def observation_bounds(self) -> dict[str, tuple[Tensor, Tensor]]:
        """The same symmetric limit for every entry."""
        if self.config.observation == "paper":
            high = torch.full((3 * len(self.scene.markers),), PAPER_LIMIT)
        else:
            high = torch.full((self._scale.shape[0],), COMPACT_LIMIT)
        return {"observation": (-high, high)}

    def observe(self) -> dict[str, Tensor]:
        """The kind that was asked for."""
        points = self.sim.marker_x.to(torch.float32)
        if self.config.observation == "paper":
            return {"observation": points.flatten(1)}
        tip = self.tip()
        error = self.goal - tip
        parts = (
            tip - self._middle,
            self.sim.marker_v[:, self.scene.effector],
            self.goal - self._middle,
            error,
            error / (error.norm(dim=-1, keepdim=True) + FINE_ERROR),
            self.command,
            self.sim.cable_tension,
            (points[:, self._elbows] - self._rest_elbows).flatten(1),
        )
        return {"observation": torch.cat(parts, dim=1).to(torch.float32) * self._scale}

    def measure_distance(self) -> Tensor:
        """Top to goal [m]."""
        distance: Tensor = torch.linalg.vector_norm(self.goal - self.tip(), dim=-1)
        return distance

    def is_success(self, distance: Tensor) -> Tensor:
        """Within the tolerance."""
        return distance <= self.config.success_tolerance

    def reward_terms(self, action: Tensor, distance: Tensor) -> dict[str, Tensor]:
        """See the table at the top."""
        config = self.config
        best = self.best.clone()
        torch.fmin(best, distance, out=self.best)  # fmin: a world that failed keeps its best
        if config.reward == "paper":
            return {"best_progress": (PAPER_GAIN * rewards.relative_progress(best, distance)).clamp_max(1.0)}
        terms = {
            "progress": rewards.progress(self.distance, distance, config.progress_scale),
            "precision": config.precision_weight * rewards.cauchy(distance, config.precision_scale),
        }
        if self.action_size:
            terms["effort"] = config.effort_weight * rewards.effort(action.clamp(-1.0, 1.0))
        return terms

    def camera(self) -> Any:
        """From a corner, a little above the elbows."""
        from softwarp.render import Camera

        return Camera(eye=(0.36, -0.29, 0.21), target=(0.0, 0.0, 0.047), up=(0.0, 0.0, 1.0), fov=31.0)


def observation_layout(kind: str) -> tuple[dict[str, slice], float]:
    """Where each quantity stands in an observation, and metres per unit of its ``tip`` and ``goal``."""
    if kind == "paper":
        return {"tip": slice(0, 3), "elbows": slice(3, 15), "below": slice(15, 18)}, 1.0
    layout, start = {}, 0
    for name, size, _ in COMPACT:
        layout[name] = slice(start, start + size)
        start += size
    return layout, next(divisor for name, _, divisor in COMPACT if name == "tip")


@functools.cache
def reachable_points() -> np.ndarray:
    """Positions of the top [m] seen in equilibrium under random commands, float32 (point, 3), in random order.

    Made by assets/diamond/reachable.py with the default scene.
    """
    with resources.files("softwarp.envs").joinpath("diamond_reachable.npz").open("rb") as file:
        return np.asarray(np.load(file)["tip"], dtype=np.float32)
