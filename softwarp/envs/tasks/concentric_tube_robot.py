"""Concentric tube robot: three pre-curved tubes, one in the other, bring their tip to a point in a nasal passage.

Scene        scenes/concentric_tube_robot.py: tubes out of a port at the nostril, inside contact with the wall of the
             passage, friction 0.1; 10 Hz control, 10 sub-steps of 10 ms
Action       continuous: (6,) in [-1, 1]: insertion and turn of each tube, from the innermost, up to 10, 8, 6.7 mm and
                         0.33, 0.27, 0.22 rad per action
             discrete:   12 choices, four for each tube: 4 k inserts by those lengths, 4 k + 1 and 4 k + 2 turn by those
                         angles to and fro, 4 k + 3 withdraws by 3.5, 2.8, 2.3 mm
Observation  compact: 30 numbers of order 1, see ``COMPACT``; ``observe_force`` adds the wall force
             paper:   12 raw numbers: lengths [m], angles [rad], tip [m], goal [m]
             beside it ``wall_force``: the sum of the sizes of all forces on the wall [N], the largest in the action and
             the largest in the episode
Goal         workspace: a tip of tubes that are clear of the wall over their whole length (tube_goals.py)
             box:       SofaGym's: x = 0, y from -20 to 30 mm, z from |y| to |y| + 30 mm, often outside the lumen
             list:      one of ``goal_list``
Reward       shaped: progress (d_prev - d) / 5 mm;  precision 1 / (1 + (d / 2 mm)^2);  effort -0.01 mean(a^2);
                     force -force_penalty (largest wall force - force_limit) where there is a limit
             paper:  min(3 sqrt(max((d_best - d) / d_best, 0)), 1) with the episode's least distance so far, d_best
Ends         terminated on a failed world, on success if ``end_on_success``, beyond ``force_limit`` if ``end_on_force``;
             truncated after 50 actions (5 s)
Success      tip within 1 mm of the goal (``success_tolerance``; SofaGym's is 3 mm)

By default an episode does not end at success: the agent has to hold the tip there. No tube reaches farther than those
within it: one that is withdrawn takes those outside along. The passage is generated (``anatomy`` is the seed of a
random one, of all worlds), or ``vessel`` names a mesh file. SofaGym's tubes are rigid in torsion, and these all but
rigid, with G J = 20 E I; with ``windup=True`` they twist, and strongly curved ones snap. The little that they twist
each other moves some tips by 7 mm, and takes a second to come to rest. The hand-written policy knows that
(tube_torsion.py): of all 200 unseen goals it comes within 3 mm of every one, meets 196 within 1 mm at some time and
holds 188 at the end (with a table of other goals alone, 198, 188 and 181; where it took tubes for rigid, 90 % and 81 %
of 128); of 1000 others (goal_seed=1) 96 % and 93 %, 99 % within 3 mm, and the wall bears 0.5 N at most. Inverse control
(``policy=inverse``, control/tubes.py) linearises the line where it is, contacts included, and needs no table: it holds
195 of these 200 at the end, half within 0.04 mm, and all within 1.5 mm: where it stalls it draws back, turns, and
starts over. Planned (``softwarp plan env=concentric_tube_robot planner=opd``), 100 of 100 goals are met within 3 mm.

PPO (experiment=fast/concentrictuberobot) learns it from nothing, every motion and all of the feedback, with
action_power=2: of 1000 goals that it never saw (goal_seed=1) it holds 99.5 % within 1 mm at the end, 99.7 % within 3
mm, 0.06 mm in the median and 0.64 mm at the 99th percentile; of the 200 goals 99.5 %. The wall bears 0.07 N in the
median episode and 0.38 N at most. That is seed 0, 5.0 million steps in 400 s in 1024 worlds on an H200 (14 000
steps/s); after 1.3 million and 102 s it was 97.5 % of the 200. Seeds 1 and 2, which shared such a GPU and had 1.5
million steps each, hold 99.4 and 96.5 % of the 1000, with 0.46 N at most. What it had lacked was neither sight nor
reward, but the size of its own noise, and updates. A tenth of a full action moves each tube by a millimetre, and on the
closed form of the tubes a policy that begins with that little noise gets stuck; actions that move by their squares go
as far where they are large and are fine where they are small. Without them 4096 worlds held 60 % of the 1000 after 42
updates (2.8 million steps, 142 s), and earlier runs of 62 small updates 12 %.

Tubes that snap cross the lumen within a step. Contacts are therefore measured where the step leads to, again as long as
that moves the line: measured once, it was 4.3 mm deep in the wall in 60 000 world-steps of extreme actions. Of a
million actions each, ten million world-steps, that are random, extreme or lean inwards (4096 worlds on a GPU) none
failed, one had more contacts than there is room for, and the line was never in the wall.
"""

from __future__ import annotations

import functools
import math
from importlib import resources
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from softwarp.builder import ModelBuilder
from softwarp.envs import sums
from softwarp.envs.options.concentric_tube_robot import ConcentricTubeRobotConfig
from softwarp.envs.options.tubes import TUBES
from softwarp.envs.scenes.concentric_tube_robot import (
    CONTACT_CAPACITY,
    VIEWED_FROM,
    ConcentricTubeScene,
    build_concentric_tubes,
    line_of,
    twisted_line_of,
    vessel_of,
)
from softwarp.envs.tasks.cable_reach import split_part
from softwarp.envs.tasks.tubes import ACTION_KINDS as ACTION_KINDS
from softwarp.envs.tasks.tubes import TubeTask
from softwarp.envs.tube_goals import GoalTable, goal_table
from softwarp.model.handles import Telescope
from softwarp.render import Camera
from softwarp.render.camera import box_corners

# Compact observation: name, entries, divisor to order 1.
COMPACT = (
    ("length", 3, 0.05),  # m, commanded
    ("sin", 3, 1.0),  # of the commanded angles
    ("cos", 3, 1.0),
    ("angle", 3, 3.0),  # rad, commanded
    ("tip", 3, 0.03),  # m
    ("direction", 3, 1.0),  # of the line at its end
    ("goal", 3, 0.03),  # m
    ("error", 3, 0.02),  # m, goal - tip
    ("fine_error", 3, 1.0),  # error / (|error| + 2 mm): a direction that still tells millimetres apart
    ("tip_v", 3, 0.1),  # m/s
)
SIZE = sum(size for _, size, _ in COMPACT)
FINE_ERROR = 0.002  # m
LIMIT, PAPER_LIMIT = 10.0, 1.0e3
GOAL_BOX = ((-0.020, 0.030), 0.030)  # m, range of y, and of z above |y|
VIEW = 35.0  # degrees, of pictures
STREAM_GOAL = 0
GOAL_FILE = "concentric_tube_goals.npz"
DECISIVE = (  # options that goals of the workspace depend on
    *("vessel", "vessel_scale", "anatomy", "spacing", "wall", "straight", "curved", "curve_radius", "radius"),
    *("inner_radius", "youngs", "curved_youngs", "contact_radius", "max_length"),
    *("goal_turn", "goal_depth", "goal_margin", "goal_count", "goal_seed"),
)


class ConcentricTubeRobot(TubeTask):
    """See the table at the top of this file."""

    config: ConcentricTubeRobotConfig
    scene: ConcentricTubeScene
    viewed_from = VIEWED_FROM
    goal_radius = 0.0012

    @property
    def gravity(self) -> tuple[float, float, float]:
        """Acceleration of the scene [m/s^2]."""
        return self.config.gravity

    def build_scene(self, builder: ModelBuilder) -> None:
        """Tubes and wall."""
        self.scene = build_concentric_tubes(self.config, builder)

    @property
    def contact_capacity(self) -> int:
        """Room for what the line can touch at the same time."""
        return CONTACT_CAPACITY

    @property
    def telescope(self) -> Telescope:
        """The tubes."""
        return self.scene.tubes

    @property
    def most_lengths(self) -> tuple[float, ...]:
        """How far each tube may be pushed out [m]."""
        return self.config.max_length

    def setup(self) -> None:
        """Allocate goals, commands and constants."""
        self.line, self.twisted_line = line_of(self.config), twisted_line_of(self.config)
        goals = self._goals()
        self.goals = GoalTable(*(part.to(self.device) for part in (goals.tip, goals.length, goals.angle)))
        super().setup()
        divisors = [torch.full((size,), 1.0 / divisor) for _, size, divisor in COMPACT]
        self._scale = torch.cat(divisors).to(self.device)
        self._box = torch.tensor([*GOAL_BOX[0], GOAL_BOX[1]]).tolist()

    def _goals(self) -> GoalTable:
        """The list, the corners of the box, or the part of the workspace that ``goal_split`` names."""
        config = self.config
        if config.goals != "workspace":
            places = torch.tensor(config.goal_list) if config.goals == "list" else _box_goals()
            unknown = torch.zeros((len(places), TUBES))
            return GoalTable(places, unknown, unknown)
        table = workspace_goals(config)
        parts = (split_part(part.numpy(), config.goal_split) for part in (table.tip, table.length, table.angle))
        return GoalTable(*(torch.from_numpy(part.copy()) for part in parts))

    def draw_goals(self) -> Tensor:
        """Goals [m] of the running episodes, shape (world, 3)."""
        u = self.draw(STREAM_GOAL, 2)
        if self.config.goals == "box":
            low, high, above = self._box
            y = low + (high - low) * u[:, 0]
            return torch.stack((torch.zeros_like(y), y, y.abs() + above * u[:, 1]), dim=1)
        count = len(self.goals.tip)
        return self.goals.tip[(u[:, 0] * count).to(torch.int64).clamp_(max=count - 1)]

    # What is seen

    def observation_bounds(self) -> dict[str, tuple[Tensor, Tensor]]:
        """The same symmetric limit for every entry; forces are not negative."""
        if self.config.observation == "paper":
            high = torch.full((4 * TUBES,), PAPER_LIMIT)
        else:
            high = torch.full((SIZE + int(self.config.observe_force),), LIMIT)
        return {"observation": (-high, high), "wall_force": (torch.zeros_like(self._most_force), self._most_force)}

    def observe(self) -> dict[str, Tensor]:
        """The kind that was asked for, and the forces on the wall."""
        tip, force = self.tip(), self.note_force()
        if self.config.observation == "paper":
            return {"observation": torch.cat((self.length, self.angle, tip, self.goal), dim=1), "wall_force": force}
        error = self.goal - tip
        parts = (
            self.length,
            self.angle.sin(),
            self.angle.cos(),
            self.angle,
            tip,
            self.direction(),
            self.goal,
            error,
            error / (sums.length_of(error)[:, None] + FINE_ERROR),
            self.sim.rod_v[:, self._nodes][:, -1].to(torch.float32),
        )
        seen = torch.cat(parts, dim=1) * self._scale
        if self.config.observe_force:
            seen = torch.cat((seen, force[:, :1] / self.config.force_scale), dim=1)
        return {"observation": seen, "wall_force": force}

    def decode(self, observation: Tensor) -> dict[str, Tensor]:
        """Commanded lengths [m] and angles [rad], tip and goal [m], (..., 3) each, of observations of either kind.

        Compact ones also tell the tip's velocity [m/s].
        """
        if self.config.observation == "paper":
            names = ("length", "angle", "tip", "goal")
            return {name: observation[..., TUBES * k : TUBES * k + TUBES] for k, name in enumerate(names)}
        found, start = {}, 0
        for name, size, divisor in COMPACT:
            found[name] = divisor * observation[..., start : start + size]
            start += size
        return {name: found[name] for name in ("length", "angle", "tip", "goal", "tip_v")}

    # For inverse control: control/tubes.py

    @property
    def steering(self) -> dict[str, Any]:
        """Options of ``TubeController`` that suit the task."""
        config = self.config
        nested = ((0.0, math.inf),) * (TUBES - 1)
        return {
            "tip": 0,
            "insertion": config.insert_step,
            "turning": config.turn_step,
            "most": config.max_length,
            "leads": nested if config.nested else None,
            "force_limit": config.force_limit,
        }

    def goal_points(self) -> Tensor:
        """Goals [m], (world, 3)."""
        return self.goal

    # What another robot can follow: planning/tracing.py

    target_kind = "point"

    def plan_target(self) -> Tensor:
        """Where the tip is [m], (world, 3)."""
        return self.tip()

    def tracked(self) -> Tensor:
        """The tip [m], (world, 3)."""
        return self.tip()

    def task_options(self, world: int) -> dict[str, Any]:
        """The goal of a world."""
        return {"goals": "list", "goal_list": [self.goal[world].tolist()]}

    # Pictures

    def shown_goals(self) -> Tensor:
        """Places of all goals that episodes may have."""
        return self.goals.tip

    def camera(self) -> Camera:
        """From the side, with the whole passage in sight."""
        low, high = self.shown_region()
        middle, towards = 0.5 * (low + high), np.array(VIEWED_FROM)
        away = 0.5 * np.linalg.norm(high - low) / np.sin(np.radians(0.5 * VIEW))
        x, y, z = (float(c) for c in middle + away * towards / np.linalg.norm(towards))
        u, v, w = (float(c) for c in middle)
        return Camera(eye=(x, y, z), target=(u, v, w), fov=VIEW)

    def shown_region(self) -> NDArray[np.float64]:
        """The passage."""
        inner = self.scene.vessel.inner
        points = self.scene.vessel.bounds if inner is None else inner[0]
        return np.stack([points.min(axis=0), points.max(axis=0)])


def workspace_goals(config: ConcentricTubeRobotConfig) -> GoalTable:
    """All goals of the workspace of a scene: those of the default one from a file, others sought."""
    default = ConcentricTubeRobotConfig()
    if all(getattr(config, name) == getattr(default, name) for name in DECISIVE):
        return stored_goals()
    return sought_goals(config)


def sought_goals(config: ConcentricTubeRobotConfig) -> GoalTable:
    """Goals that the closed form leads to, which takes some seconds the first time."""
    return goal_table(
        vessel_of(config),
        line_of(config),
        config.max_length,
        clear=config.contact_radius + config.goal_margin,
        turn=config.goal_turn,
        depth=config.goal_depth,
        count=config.goal_count,
        seed=config.goal_seed,
    )


@functools.cache
def stored_goals() -> GoalTable:
    """Goals of the default scene, made by assets/nasal/goals.py."""
    with resources.files("softwarp.envs").joinpath(GOAL_FILE).open("rb") as file:
        data = np.load(file)
        return GoalTable(*(torch.from_numpy(data[name].astype(np.float32)) for name in ("tip", "length", "angle")))


def _box_goals() -> Tensor:
    """Corners of SofaGym's goals [m]."""
    (low, high), above = GOAL_BOX
    region = np.array([[0.0, low, 0.0], [0.0, high, max(-low, high) + above]])
    return torch.as_tensor(box_corners(region), dtype=torch.float32)
