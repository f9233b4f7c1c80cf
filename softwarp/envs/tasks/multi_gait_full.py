"""MultiGait, full order: a flat pneumatic quadruped crawls over a floor, and turns where its chambers act apart.

Scene        scenes/multi_gait.py: a silicone body of 70 kPa with five chambers on a stiff skin, friction 0.7; 60
             sub-steps of 10 ms per action
Action       discrete:   symmetric: 6 choices, 0-2 fill the centre, both rear, both front legs, 3-5 empty them
                         each: 10 choices, 0-4 fill centre, front left, front right, rear left, rear right, 5-9 empty
             continuous: (3,) or (5,) in [-1, 1] -> volumes added to the same chambers, 0 to the largest
             A volume moves by 1/15 of the largest per sub-step until it is there, then it is held.
Observation  (68,): 5 volumes added / largest; 5 pressures / 50 kPa; 17 points of the base, from their mean, less their
             places at rest, in the robot's frame / 10 mm; velocity of their mean in that frame / 50 mm/s; place of the
             mean / 50 mm; heading / 0.5 rad; what is left to turn / 0.5 rad
Start        at rest on the floor, no air added, heading 0
Goal         forward: the line x = 0.2 m;  headings: a heading in +-0.35 rad
Reward       forward: centimetres won along +x (progress), or max(0, .) of them (paper);  headings: heading won / 10
             degrees;  sideways -``drift_weight`` per cm, with forward
Ends         truncated after 6 actions (3.6 s)
Success      forward: past the line;  headings: within 10 degrees

A filled comb of chambers lengthens the upper side of the body, and the skin keeps the lower one from following: the
middle arches up, legs press their ends to the floor. The robot looks along +x, left is +y. The hand-written gait,
that of SofaGym's paper, fills rear, centre and front, then empties them in the same order. Left and right chambers
apart turn the robot, which SofaGym's six actions cannot: with headings the hand-written policy fills leg after leg,
each for half of a cycle, a wave that goes round the body and turns it on the spot, the coarse mesh by
3.6 degrees in three cycles of four continuous actions: headings want tens of ``max_episode_steps``.

SofaGym's mesh has its front legs at small x, and its reward counts the way along its +x; here the gait leads to where
the front legs are, so our x and y are its negative ones.

A cycle of the gait, six actions, wins 2.8 mm on the coarse mesh. Of the material hangs much: walls stretch to more
than twice their length, where a corotational law, SofaGym's, is too stiff to arch the legs and turns elements inside
out, which then hold the robot bent; with ``law="corotational"`` a cycle wins 1.1 mm on the coarse mesh, 0.8 mm with
the options of ``MultiGaitFullConfig.paper`` on the fine one. The paper tells 3.56 for its full model and 3.24 for its
reduced one; it calls them cm, but its code counts millimetres, and no robot of 135 mm that arches by 9 mm wins
centimetres in six actions. With the corotational law the direction hangs on little: its rotation "large", which depends
on how nodes are numbered, lets the coarse mesh creep the other way.

No other six actions from rest lead farther: of all 4096 sequences (``python -m experiments.gait_search``) the
hand-written gait goes farthest, 2.80 mm on the reduced and on the full coarse mesh, before 2.74 (reduced) and 2.64 mm
(full), where the paper's learned gait went 1.39 and 1.74 times as far as this one. Longer walks leave little room. Of
12 and 18 actions the best that were found fill centre and front once, work with the rear legs, and empty all at the
end, which counts once: 6.9 and 10.5 instead of 5.6 and 8.5 mm (reduced).

``distance`` is the way to the line, or with headings the way of a leg's end round the middle that is left to turn.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from softwarp.builder import ModelBuilder
from softwarp.envs import randomization
from softwarp.envs.base import SoftEnv
from softwarp.envs.options.multi_gait_full import ACTION_KINDS as ACTION_KINDS
from softwarp.envs.options.multi_gait_full import MultiGaitFullConfig
from softwarp.envs.scenes.multi_gait import AXIS_ENDS, MultiGaitScene, build_multi_gait_scene
from softwarp.envs.sums import in_order, mean_of
from softwarp.meshing.quadruped_geometry import CHAMBERS, HEIGHT
from softwarp.render import Camera

ARM = 0.068  # m, from the robot's middle to a leg's end along x
PRESSURE, SHAPE, SPEED, PLACE, TURN = 50.0e3, 0.010, 0.05, 0.05, 0.5  # Pa, m, m/s, m, rad worth 1 in an observation
LIMIT = 10.0  # of observations
CENTIMETRE = 0.01  # m
CONTACTS = 96  # of a world: the points of the skin below, and of the sides' lower edge
_POINTS = 17
LAYOUT: tuple[tuple[str, int, float], ...] = (
    ("share", 5, 1.0),
    ("pressure", 5, PRESSURE),
    ("shape", 3 * _POINTS, SHAPE),
    ("velocity", 3, SPEED),
    ("place", 2, PLACE),
    ("heading", 1, TURN),
    ("turn", 1, TURN),
)
_GROUPS = ((0,), (3, 4), (1, 2))  # chambers of centre, rear legs, front legs
_STREAM_GOAL = 0


class MultiGaitFull(SoftEnv):
    """See the table at the top of this file."""

    config: MultiGaitFullConfig
    scene: MultiGaitScene
    viewed_from = (-0.3, -0.9, 0.6)
    sweep_tolerance = 1.0e-6  # of extents of the scene: a micrometre; a tenth of it leads a gait no nearer to float64's

    @property
    def gravity(self) -> tuple[float, float, float]:
        """Acceleration of the scene [m/s^2]."""
        return self.config.gravity

    @property
    def layout(self) -> tuple[tuple[str, int, float], ...]:
        """Parts of an observation: name, entries, what counts as 1."""
        return LAYOUT

    @property
    def turns(self) -> bool:
        """Towards headings."""
        return self.config.goals == "headings"

    @property
    def contact_capacity(self) -> int:
        """Room for every point of the skin's lower side."""
        return max(CONTACTS, round(CONTACTS * (0.011 / self.config.contact_spacing) ** 2))

    def build_scene(self, builder: ModelBuilder) -> None:
        """Robot and floor."""
        self.scene = build_multi_gait_scene(self.config, builder)

    def setup(self) -> None:
        """Commands of all actions, ways of an action, the resting shape."""
        config, sim, device = self.config, self.sim, self.device
        self.reward_range = (-2.0, 2.0)
        real = sim.node_x.dtype
        self.growth = self.add_world_state("growth", len(CHAMBERS))  # m^3, commanded
        self.goal = self.add_world_state("goal")  # rad, heading
        self._nodes = torch.tensor(self.scene.tracked, device=device)
        self._chambers = torch.tensor(self.scene.chambers, device=device)
        self._rest_volume = sim.control.cavity_volume[0, self._chambers]
        largest = [config.max_growth_centre] + [config.max_growth_leg] * (len(CHAMBERS) - 1)
        self._largest = torch.tensor(largest, device=device)
        self._share = torch.tensor(_shares(config), dtype=torch.float32, device=device)
        self._groups = torch.tensor(_groups(config), device=device)
        self._start = torch.zeros_like(self.growth)
        self._target = torch.zeros_like(self.growth)
        step = torch.arange(1, config.action_repeat + 1, dtype=torch.float32, device=device)
        self._reach = (step / config.ramp).clamp_max(1.0)
        self._scale = torch.cat([torch.full((size,), 1.0 / scale, device=device) for _, size, scale in self.layout])
        self._limit = torch.full_like(self._scale, LIMIT)
        self._real = real
        points = sim.node_x[:1, self._nodes].to(torch.float32)
        self._rest = self._in_frame(points - mean_of(points)[:, None], _direction(points))

    def reset_worlds(self, mask: Tensor) -> None:
        """No air added; draw a heading."""
        self.growth.masked_fill_(mask[:, None], 0.0)
        if self.config.goals == "headings":
            drawn = randomization.in_range(self.draw(_STREAM_GOAL, 1), self.config.goal_headings)[:, 0]
            torch.where(mask, drawn, self.goal, out=self.goal)

    @property
    def _command_count(self) -> int:
        return len(CHAMBERS) if self.config.chambers == "each" else len(_GROUPS)

    @property
    def action_size(self) -> int:
        """A volume for every chamber or group of chambers."""
        return self._command_count if self.config.action_kind == "continuous" else 0

    @property
    def action_count(self) -> int:
        """Fill or empty one of them."""
        return 2 * self._command_count if self.config.action_kind == "discrete" else 0

    def action_names(self) -> Sequence[str]:
        """Chambers, or groups of them."""
        names = [name.replace("_", " ") for name in CHAMBERS]
        if self.config.chambers != "each":
            names = ["centre", "rear", "front"]  # as _GROUPS
        return [f"{change} {name}" for change in ("fill", "empty") for name in names] if self.action_count else names

    def apply_action(self, action: Tensor, substep: int) -> None:
        """Move the volumes towards what the action asks for."""
        if substep == 0:
            self._start.copy_(self.growth)
            torch.mul(self._shares_of(action), self._largest, out=self._target)
        way = self._target - self._start
        most = self._largest * self._reach[substep]
        self.growth.copy_(self._start + torch.maximum(torch.minimum(way, most), -most))
        command = self.sim.control.cavity_volume
        command.copy_(self._rest_volume + self.growth.to(command.dtype))

    def _shares_of(self, action: Tensor) -> Tensor:
        """How full chambers are to be, in their largest growth, shape (world, 5)."""
        if self.config.action_kind == "continuous":
            return 0.5 * (action.clamp(-1.0, 1.0) + 1.0)[:, self._groups]
        fill = self._share[action]
        return torch.where(fill < 0.0, self._start / self._largest, fill)

    def points(self) -> Tensor:
        """Tracked points of the base [m], shape (world, 17, 3)."""
        return self.sim.node_x[:, self._nodes].to(torch.float32)

    def position(self) -> Tensor:
        """Their mean, where the robot is [m], shape (world, 3)."""
        return mean_of(self.points())

    def heading(self) -> Tensor:
        """Turn of the body's axis about z [rad], 0 along +x, shape (world,)."""
        way = _direction(self.points())
        return torch.atan2(way[:, 1], way[:, 0])

    def left_to_turn(self) -> Tensor:
        """From the heading to the one that is asked for [rad], within half a turn, shape (world,)."""
        left = self.goal - self.heading()
        return torch.atan2(torch.sin(left), torch.cos(left))

    def pressures(self) -> Tensor:
        """Gauge pressures of the chambers [Pa], shape (world, 5)."""
        return self.sim.cavity_pressure[:, self._chambers].to(torch.float32)

    def _in_frame(self, vectors: Tensor, way: Tensor) -> Tensor:
        """Vectors (world, n, 3) in axes that turn about z with the heading."""
        cos, sin = way[:, :1], way[:, 1:]
        x, y, z = vectors.unbind(dim=2)
        return torch.stack((cos * x + sin * y, cos * y - sin * x, z), dim=2)

    def observation_bounds(self) -> dict[str, tuple[Tensor, Tensor]]:
        """The same symmetric limit for every entry."""
        return {"observation": (-self._limit, self._limit)}

    def observe(self) -> dict[str, Tensor]:
        """See the table at the top."""
        points, way = self.points(), _direction(self.points())
        place = mean_of(points)
        shape = self._in_frame(points - place[:, None], way) - self._rest
        velocity = mean_of(self.sim.node_v[:, self._nodes].to(torch.float32))
        parts = (
            self.growth / self._largest,
            self.pressures(),
            shape.flatten(1),
            self._in_frame(velocity[:, None], way)[:, 0],
            place[:, :2],
            torch.atan2(way[:, 1:], way[:, :1]),
            self.left_to_turn()[:, None] if self.config.goals == "headings" else torch.zeros_like(place[:, :1]),
        )
        return {"observation": torch.cat(parts, dim=1) * self._scale}

    def decode(self, observation: Tensor) -> dict[str, Tensor]:
        """Quantities in SI units by the names of ``layout``, (..., entries) each; "share" is of the largest volumes."""
        values = observation / self._scale.to(observation.device)
        result, start = {}, 0
        for name, size, _ in self.layout:
            result[name] = values[..., start : start + size]
            start += size
        return result

    def measure_distance(self) -> Tensor:
        """To the line [m], or the way of a leg's end that is left to turn."""
        if self.config.goals == "headings":
            return ARM * self.left_to_turn().abs()
        left: Tensor = (self.config.goal_distance - self.position()[:, 0]).clamp_min(0.0)
        return left

    def is_success(self, distance: Tensor) -> Tensor:
        """Past the line, or turned."""
        if self.config.goals == "headings":
            return distance <= ARM * self.config.heading_tolerance
        return distance <= 0.0

    def reward_terms(self, action: Tensor, distance: Tensor) -> dict[str, Tensor]:
        """See the table at the top."""
        is_turn = self.config.goals == "headings"
        won = (self.distance - distance) / (ARM * self.config.heading_scale if is_turn else CENTIMETRE)
        terms = {"progress": won.clamp_min(0.0) if self.config.reward == "paper" else won}
        if self.config.drift_weight:
            terms["sideways"] = -self.config.drift_weight / CENTIMETRE * self.position()[:, 1].abs()
        return terms

    def camera(self) -> Camera:
        """From the side, with room for a few gait cycles."""
        return Camera(eye=(-0.02, -0.36, 0.17), target=(0.02, 0.0, 0.008), fov=28.0)

    def shown_region(self) -> NDArray[np.float64]:
        """The robot and the way before it."""
        return np.array([[-ARM, -0.03, 0.0], [ARM + 0.04, 0.03, HEIGHT]])


def _direction(points: Tensor) -> Tensor:
    """Unit vector from the rear to the front end of the body's axis, seen from above, shape (world, 2)."""
    way = points[:, AXIS_ENDS[1], :2] - points[:, AXIS_ENDS[0], :2]
    x, y = way.unbind(dim=1)
    length = in_order((x * x, y * y)).sqrt().clamp_min(1.0e-9)
    return way / length[:, None]


def _groups(config: MultiGaitFullConfig) -> list[int]:
    """Command of every chamber."""
    if config.chambers == "each":
        return list(range(len(CHAMBERS)))
    return [next(k for k, group in enumerate(_GROUPS) if chamber in group) for chamber in range(len(CHAMBERS))]


def _shares(config: MultiGaitFullConfig) -> list[list[float]]:
    """How full every choice makes the chambers, -1 for those that it leaves as they are."""
    group = _groups(config)
    count = max(group) + 1
    return [[fill if own == k else -1.0 for own in group] for fill in (1.0, 0.0) for k in range(count)]
