"""Trunk and cup: a trunk that is wrapped round a soft cup brings the cup to a place and its axis to a direction.

Scene        scenes/trunk_cup.py: 8 displacement-controlled cables that only pull, friction 0.8; 20 Hz control, 5
             sub-steps of 10 ms
Action       continuous: (8,) in [-1, 1], change of the commanded displacements, +-5 mm per action
             absolute:   (8,) in [-1, 1], displacements from slackest to shortest, approached by 5 mm per action
             discrete:   16 choices, 0-7 shorten and 8-15 lengthen that cable by 5 mm
Observation  compact: 64 numbers of order 1, see ``COMPACT``
             paper:   66 raw metres: 21 stations (mean of the long cables' points), then the goal
Start        wrapped: the trunk holds the cup, at rest
             open: the cup stands on a table, at a place drawn within 3 mm, the trunk lies straight beside it
Goal         workspace: a pose in which the grasp was seen to hold the cup, its place jittered by 1 mm; with
             ``goal_repeat`` the one before anew, where it was not met
             list: one of ``goal_list``, with the axis of the start
Reward       shaped: progress (e_prev - e) / 10 mm, e = sqrt(d^2 + (28.6 mm * angle)^2);
             precision 1 / (1 + (e / 10 mm)^2);  effort -0.01 mean(a^2);  drop -5;  start="open": carry +0.1 of the
             share of the cup's weight that the trunk carries;  ``grip_weight``: grip, down to its negative where the
             contacts' loads add up to less than ``firm_grip``
             paper:  |start - goal|_2 - |cup - goal|_1 in millimetres;  success +1
Ends         terminated on a failed world, when the cup is dropped, and on success if ``end_on_success``; truncated
             after 250 actions (12.5 s)
Success      cup within 5 mm of its place and 10 degrees of its axis;  reward="paper": |cup - goal|_1 <= 3 mm

The cup's position is the middle of its axis, from the middle of the bottom to that of the rim; ``distance`` is that of
positions. It counts as dropped where it is farther than 80 mm from every station of the trunk: held, it is 40 mm away.

SofaGym neither observes the cup nor asks for its axis, and its goals are the Trunk's, of which nobody knows whether the
grasp can reach them. Here goals are poses at rest that random commands led to from the start (assets/trunk_cup/
reachable.py), so each can be reached without letting go of the cup. How the grasp slips depends on the way, so the same
commands may lead to poses that differ by millimetres; taking hold anew is not asked for.

``start="open"`` asks for more: the trunk has to be laid round the cup first. Goals are those of the above in which the
edge of the cup's bottom clears the table, which is a little lower than the grasp lets the cup hang. The cup is lost,
and the episode over, when it lies: its middle less than 0.4 of its height above the table. Letting go is no failure.

Hand-written policies: ``scripted`` looks up which commands led near the goal; at the end of 5 s it meets 77 % of 64
evaluation goals, half of them within 1.1 mm, and loses 3 %; of 256 training goals 80 % in 2.5 s. ``hold`` keeps the
cables as they are and meets none, since goals that the start would meet are not in the table. ``inverse`` steers the
middles of bottom and rim, so place and axis, with the contacts of the grasp in its program, and keeps a grip of 0.5 N:
of the first 96 poses of the table it met 78 after 6 s, medians of batches of 24 were 1.1 to 2.6 mm, and lost no cup.
Without the grip it met as many, but a cup was lost in eight worlds by themselves. Discrete, by 5 mm of one cable at a
time, ``scripted`` brings half to within 13.3 mm, meets 12 % and loses 17 %. With ``start="open"``, it lays the trunk
round the cup, squeezes, lifts and carries: of 64 evaluation episodes (``softwarp eval env=trunk_cup env.start=open
policy=scripted episodes=64``) it meets 33 % and loses 2 %; half end within 9.4 mm. To do better, or to regrasp, is an
open task.

The trunk is the coarse one, whose stiffness is near that of the medium one. Linear tetrahedra are too stiff: tasks/
trunk.py tells by how much.
"""

from __future__ import annotations

import functools
from importlib import resources
from typing import Any

import numpy as np
import torch
from torch import Tensor

from softwarp.builder import ModelBuilder
from softwarp.envs import randomization, rewards
from softwarp.envs.options.trunk_cup import TrunkCupConfig
from softwarp.envs.rest import NotAtRestError
from softwarp.envs.scenes.trunk import LONG_CABLES, SHORT_CABLES, STATIONS
from softwarp.envs.scenes.trunk_cup import TrunkCupScene, build_trunk_cup_scene, place_grasp, wrapped
from softwarp.envs.sums import in_order, length_of, mean_of
from softwarp.envs.tasks.cable_reach import ACTION_KINDS as ACTION_KINDS
from softwarp.envs.tasks.cable_reach import (
    COMPACT_LIMIT,
    STREAM_GOAL,
    CableReach,
    compact_layout,
    compact_scale,
    split_part,
)
from softwarp.meshing.cup_geometry import BOTTOM_RADIUS, HEIGHT
from softwarp.render import Camera
from softwarp.simulation import Simulation
from softwarp.solvers.inverse.grip import Grip

CABLES = LONG_CABLES + SHORT_CABLES
CONTACT_CAPACITY = 160
GRIP = 0.5  # N of all contacts, which inverse control keeps; twenty times the cup's weight

# Compact observation: name, entries, divisor to order 1.
COMPACT = (
    ("tip", 3, 0.05),  # m, position of the cup less that of the start
    ("axis", 3, 1.0),  # of the cup
    ("tip_v", 3, 0.5),  # m/s, of the cup
    ("goal", 3, 0.05),  # m, less the start's position
    ("goal_axis", 3, 1.0),
    ("error", 3, 0.05),  # m, goal - position
    ("fine_error", 3, 1.0),  # error / (|error| + 10 mm): a direction that still tells millimetres apart
    ("turn", 3, 1.0),  # goal axis - axis
    ("fine_turn", 3, 1.0),  # turn / (|turn| + 0.35)
    ("command", 8, 0.05),  # m, commanded displacements
    ("change", 8, 0.01),  # m, commanded displacements less those of the start
    ("tension", 8, 10.0),  # N
    ("stations", 12, 0.1),  # m, four points along the trunk
    ("grip", 1, 5.0),  # N, sum of the loads of all contacts
)
COMPACT_STATIONS = (5, 10, 15, 20)
FINE_ERROR, FINE_TURN = 0.010, 0.35  # m, length of a difference of axes
PAPER_LIMIT = 0.5  # m
MILLIMETRE = 0.001
CLEARANCE = 0.002  # m, of the cup's bottom above the table in goals of start="open"
LYING = 0.4  # heights of the cup above the table below which its middle is when it was knocked over; standing: 0.5

_STREAM_YOUNGS, _STREAM_MASS, _STREAM_FRICTION, _STREAM_PLACE, _STREAM_REPEAT = range(1, 6)


class TrunkCup(CableReach):
    """See the table at the top of this file."""

    config: TrunkCupConfig
    scene: TrunkCupScene

    @property
    def gravity(self) -> tuple[float, float, float]:
        """Acceleration of the scene [m/s^2]."""
        return self.config.gravity

    @property
    def contact_capacity(self) -> int:
        """Twice as many as a firm grasp has, for eight corners to a rim."""
        return CONTACT_CAPACITY * -(-self.config.skin_corners // 8)

    @property
    def steering(self) -> dict[str, Any]:
        """Of ``InverseController``.

        m that a grasp follows without slipping. With less weight of the tensions, opposite cables pull against each
        other ever more, until the cup is lost; a grip keeps that weight from letting the cup go, which weighs 0.024 N.
        """
        return {"max_step": 0.004, "energy": 0.03, "grip": Grip(self.scene.hold, least=GRIP)}

    def build_scene(self, builder: ModelBuilder) -> None:
        """Trunk, clamp, cables, cup."""
        self.scene = build_trunk_cup_scene(self.config, builder)

    def make_simulation(self, num_worlds: int) -> Simulation:
        """As ever, but the trunk holds the cup where it is to."""
        sim = super().make_simulation(num_worlds)
        if not self.is_open:
            place_grasp(sim, self.scene, wrapped())
        return sim

    @property
    def is_open(self) -> bool:
        """Whether the cup stands on a table at the start."""
        return self.config.start == "open"

    def _settle(self) -> None:
        try:
            super()._settle()
        except NotAtRestError as error:
            raise ValueError(self._lost()) from error

    def _lost(self) -> str:
        config = self.config
        return (
            f"TrunkCup: the grasp does not hold this cup (cup_mass={config.cup_mass:g} kg, mu={config.mu:g}, "
            f"gravity={config.gravity}); take a lighter one, more friction, or the materials of the defaults"
        )

    def displacement_limits(self) -> tuple[Tensor, Tensor]:
        """Those of the long cables, then those of the short ones."""
        low, high = self.config.min_displacement, self.config.max_displacement
        count = [LONG_CABLES, SHORT_CABLES]
        return tuple(torch.tensor(limits).repeat_interleave(torch.tensor(count)) for limits in (low, high))  # type: ignore[return-value]

    def choices(self) -> list[tuple[int, float]]:
        """Shorten one cable, then lengthen one."""
        return [(cable, sign) for sign in (1.0, -1.0) for cable in range(CABLES)]

    def goal_table(self) -> Tensor:
        """Places and axes of the list, or those that the cup was seen in, (goal, 6)."""
        if self.config.goals == "list":
            places = torch.tensor(self.config.goal_list, dtype=torch.float32)
            return torch.cat((places, self.start_axis.cpu().expand_as(places)), dim=1)
        poses = torch.from_numpy(split_part(reachable_poses()[0], self.config.goal_split).copy())
        return poses[self._hangs_free(poses)] if self.is_open else poses

    def _hangs_free(self, poses: Tensor) -> Tensor:
        """Whether the edge of the cup's bottom is above the table in these poses, bool (pose,)."""
        sine = (1.0 - poses[:, 4].square()).clamp(min=0.0).sqrt()
        lowest = poses[:, 1] - 0.5 * HEIGHT * poses[:, 4] - BOTTOM_RADIUS * sine
        return lowest > self.config.table_height + CLEARANCE

    @property
    def seen_poses(self) -> Tensor:
        """Position [m] and axis of the cup at rest, those kept for evaluation left out, (pose, 6)."""
        return torch.from_numpy(split_part(reachable_poses()[0], "train").copy())

    @property
    def seen_commands(self) -> Tensor:
        """Displacements of the cables [m] that led to ``seen_poses``, (pose, 8)."""
        return torch.from_numpy(split_part(reachable_poses()[1], "train").copy())

    def setup(self) -> None:
        """Allocate goals, commands and constants."""
        config, device = self.config, self.device
        self.reward_range = (-1.0 - config.drop_penalty - config.grip_weight, 1.0 + config.carry_weight * self.is_open)
        self._bottom = torch.tensor(self.scene.bottom_markers, device=device)
        self._rim = torch.tensor(self.scene.rim_markers, device=device)
        self._long_points = slice(0, LONG_CABLES * STATIONS)
        self._stations = torch.tensor(COMPACT_STATIONS, device=device)
        self.start_tip, self.start_axis = self.tip()[:1].clone(), self.axis()[:1].clone()
        if bool(self.is_dropped().any()):
            raise ValueError(self._lost())
        super().setup()
        if not self.is_open:
            self._first_command = torch.tensor(wrapped().command, dtype=torch.float32, device=device)
        elif not len(self._goal_table):
            raise ValueError(
                f"TrunkCup: with table_height={config.table_height:g} m every goal would have the cup in the table; "
                "lower it"
            )
        first, last = self.sim.model.body_node_start[self.scene.cup : self.scene.cup + 2]
        self._cup_nodes = slice(int(first), int(last))
        self._cup_start = self.sim.node_x[:1, self._cup_nodes].clone()
        markers = self.tip_markers
        assert markers == tuple(range(markers[0], markers[-1] + 1))
        self._cup_markers = slice(markers[0], markers[-1] + 1)
        self._marks_start = self.sim.marker_x[:1, self._cup_markers].clone()
        g = float(torch.tensor(config.gravity).norm())
        self._weight = max(config.cup_mass * g, 1.0e-6)  # N, by which carrying is measured
        self.goal_axis = self.add_world_state("goal_axis", 3)
        # m, at the start of an action; of a past episode it is state where goals are repeated
        self._error_before = torch.zeros(self.num_worlds, device=device)
        if config.goal_repeat:
            self._error_before = self.add_world_state("error_before")
        self._cup_density = self.sim.params.density[:1, self.scene.cup].clone()
        self._scale = compact_scale(COMPACT).to(device)
        self.observation_layout, self.length_scale = observation_layout(config.observation)

    def reset_worlds(self, mask: Tensor) -> None:
        """New goal, first commands, new parameters."""
        chosen = mask[:, None]
        torch.where(chosen, self._first_command, self.command, out=self.command)
        u = self.draw(STREAM_GOAL, 4)
        count = len(self._goal_table)
        pose = self._goal_table[(u[:, 0] * count).to(torch.int64).clamp_(max=count - 1)]
        place = pose[:, :3]
        if self.config.goals == "workspace":
            place = place + self.config.goal_jitter * (2.0 * u[:, 1:] - 1.0)
        fresh = chosen & ~self._again()[:, None] if self.config.goal_repeat else chosen
        torch.where(fresh, place, self.goal, out=self.goal)
        torch.where(fresh, pose[:, 3:], self.goal_axis, out=self.goal_axis)
        if self.is_open:
            self._place_cup(mask)
        self._randomize(mask)

    def _again(self) -> Tensor:
        """Worlds that keep the goal of the episode before, which it was away from: bool (world,)."""
        missed = (self._episode > 0) & (self._error_before > self.config.success_tolerance)
        return missed & (self.draw(_STREAM_REPEAT, 1)[:, 0] < self.config.goal_repeat)

    def _place_cup(self, mask: Tensor) -> None:
        """Shift the standing cup of some worlds on the table."""
        u = self.config.start_jitter * (2.0 * self.draw(_STREAM_PLACE, 2) - 1.0)
        shift = torch.stack((u[:, 0], torch.zeros_like(u[:, 0]), u[:, 1]), dim=1)
        placed = self._cup_start + shift[:, None].to(self._cup_start.dtype)
        for view in (self.sim.node_x[:, self._cup_nodes], self.sim.good_x[:, self._cup_nodes]):
            view.copy_(torch.where(mask[:, None, None], placed, view))
        marks = self.sim.marker_x[:, self._cup_markers]
        marks.copy_(torch.where(mask[:, None, None], self._marks_start + shift[:, None].to(marks.dtype), marks))

    def _randomize(self, mask: Tensor) -> None:
        """Draw the parameters that have a range."""
        config, params, cup = self.config, self.sim.params, self.scene.cup

        def assign(target: Tensor, value: Tensor) -> None:
            target.copy_(torch.where(mask, value.to(target.dtype), target))

        if config.youngs_range is not None:
            youngs = randomization.in_range(self.draw(_STREAM_YOUNGS, 1), config.youngs_range)
            assign(params.youngs[:, self.scene.trunk.body], youngs[:, 0])
        if config.cup_mass_range is not None:
            mass = randomization.in_range(self.draw(_STREAM_MASS, 1), config.cup_mass_range)
            assign(params.density[:, cup], self._cup_density * mass[:, 0] / config.cup_mass)
        if config.mu_range is not None:
            mu = randomization.in_range(self.draw(_STREAM_FRICTION, 1), config.mu_range)
            assign(params.pair_mu[:, 0], mu[:, 0])

    @property
    def tip_markers(self) -> tuple[int, ...]:
        """Markers whose mean is the cup's position."""
        return self.scene.bottom_markers + self.scene.rim_markers

    def tip(self) -> Tensor:
        """The cup's position, the middle of its axis [m], shape (world, 3)."""
        x = self.sim.marker_x
        middle: Tensor = 0.5 * (mean_of(x[:, self._bottom]) + mean_of(x[:, self._rim]))
        return middle.to(torch.float32)

    def axis(self) -> Tensor:
        """Direction of the cup's axis from bottom to rim, a unit vector, shape (world, 3)."""
        x = self.sim.marker_x
        along = mean_of(x[:, self._rim]) - mean_of(x[:, self._bottom])
        return (along / length_of(along)[:, None].clamp_min(1.0e-12)).to(torch.float32)

    @property
    def point_markers(self) -> tuple[tuple[int, ...], ...]:
        """Markers whose means are the middles of bottom and rim; for inverse control, which so steers the axis too."""
        return (self.scene.bottom_markers, self.scene.rim_markers)

    def point_goals(self) -> Tensor:
        """Where the middles of bottom and rim are to come [m], shape (world, 2, 3)."""
        half = 0.5 * HEIGHT * self.goal_axis
        return torch.stack((self.goal - half, self.goal + half), dim=1)

    def angle(self) -> Tensor:
        """Angle between the cup's axis and the goal's [rad], shape (world,)."""
        half = 0.5 * length_of(self.axis() - self.goal_axis)
        return 2.0 * torch.asin(half.clamp(max=1.0))

    def pose_error(self) -> Tensor:
        """Distance of positions and, in metres, angle of axes together [m], shape (world,)."""
        return torch.hypot(self.measure_distance(), self.config.axis_lever * self.angle())

    def stations(self) -> Tensor:
        """Points along the trunk's axis, mean of the long cables' points [m], shape (world, 21, 3)."""
        points = self.sim.cable_x[:, self._long_points].unflatten(1, (LONG_CABLES, STATIONS))
        mean: Tensor = mean_of(points).to(torch.float32)
        return mean

    def is_dropped(self) -> Tensor:
        """Whether the cup is far from all of the trunk, or knocked over on the table, bool (world,)."""
        if self.is_open:
            return self.tip()[:, 1] < self.config.table_height + LYING * HEIGHT
        way = length_of(self.stations() - self.tip()[:, None])
        dropped: Tensor = way.amin(dim=1) > self.config.drop_distance
        return dropped

    def grip(self) -> Tensor:
        """Sum of the loads of all contacts [N], shape (world,)."""
        return in_order(length_of(self.sim.contact_load).unbind(dim=1)).to(torch.float32)

    def carried(self) -> Tensor:
        """Share of the cup's weight that the trunk carries, at most 1, shape (world,)."""
        force = self.sim.pair_force[:, self.scene.hold, 1].abs() / self._weight
        return force.clamp(max=1.0).to(torch.float32)

    def apply_action(self, action: Tensor, substep: int) -> None:
        """Move the commanded displacements to their new values in equal parts."""
        if substep == 0:
            self._error_before.copy_(self.pose_error())
        super().apply_action(action, substep)

    def is_success(self, distance: Tensor) -> Tensor:
        """Position and axis within their tolerances."""
        if self.config.reward == "paper":
            distance = in_order((self.tip() - self.goal).abs().unbind(dim=1))
        return (distance <= self.config.success_tolerance) & (self.angle() <= self.config.axis_tolerance)

    def is_terminated(self, distance: Tensor) -> Tensor:
        """The cup is dropped."""
        return self.is_dropped()

    def reward_terms(self, action: Tensor, distance: Tensor) -> dict[str, Tensor]:
        """See the table at the top."""
        config = self.config
        if config.reward == "paper":
            way = length_of(self.start_tip - self.goal)
            left = in_order((self.tip() - self.goal).abs().unbind(dim=1))
            return {"way": (way - left) / MILLIMETRE, "success": self.is_success(distance).float()}
        error = self.pose_error()
        terms = {
            "progress": rewards.progress(self._error_before, error, config.progress_scale),
            "precision": config.precision_weight * rewards.cauchy(error, config.precision_scale),
            "drop": -config.drop_penalty * self.is_dropped().float(),
        }
        if self.is_open:
            terms["carry"] = config.carry_weight * self.carried()
        if config.grip_weight:
            terms["grip"] = config.grip_weight * ((self.grip() / config.firm_grip).clamp(max=1.0) - 1.0)
        if self.action_size:
            terms["effort"] = config.effort_weight * rewards.effort(action.clamp(-1.0, 1.0))
        return terms

    def observation_bounds(self) -> dict[str, tuple[Tensor, Tensor]]:
        """The same symmetric limit for every entry."""
        if self.config.observation == "paper":
            high = torch.full((3 * STATIONS + 3,), PAPER_LIMIT)
        else:
            high = torch.full((self._scale.shape[0],), COMPACT_LIMIT)
        return {"observation": (-high, high)}

    def observe(self) -> dict[str, Tensor]:
        """The kind that was asked for."""
        stations = self.stations()
        if self.config.observation == "paper":
            return {"observation": torch.cat((stations.flatten(1), self.goal), dim=1)}
        tip, axis = self.tip(), self.axis()
        error, turn = self.goal - tip, self.goal_axis - axis
        parts = (
            tip - self.start_tip,
            axis,
            mean_of(self.sim.marker_v),
            self.goal - self.start_tip,
            self.goal_axis,
            error,
            error / (length_of(error)[:, None] + FINE_ERROR),
            turn,
            turn / (length_of(turn)[:, None] + FINE_TURN),
            self.command,
            self.command - self._first_command,
            self.sim.cable_tension,
            stations[:, self._stations].flatten(1),
            self.grip()[:, None],
        )
        return {"observation": torch.cat(parts, dim=1).to(torch.float32) * self._scale}

    def decode(self, observation: Tensor) -> dict[str, Tensor]:
        """The parts of a compact observation in their units, shape (..., entries) each."""
        parts = observation / self._scale.to(observation)
        return {name: parts[..., place] for name, place in self.observation_layout.items()}

    def camera(self) -> Camera:
        """From in front of the tip and above, with y up."""
        return Camera(eye=(0.30, 0.16, 0.30), target=(0.03, -0.02, 0.03), up=(0.0, 1.0, 0.0), fov=23.0)


def observation_layout(kind: str) -> tuple[dict[str, slice], float]:
    """Where each quantity stands in an observation, and metres per unit of its ``tip`` and ``goal``."""
    if kind == "paper":
        end = 3 * STATIONS
        return {"stations": slice(0, end), "goal": slice(end, end + 3)}, 1.0
    return compact_layout(COMPACT)


@functools.cache
def reachable_poses() -> tuple[np.ndarray, np.ndarray]:
    """Poses at rest of the held cup, and the commands that led there; made by assets/trunk_cup/reachable.py.

    Returns:
        Position [m] and axis, float32 (pose, 6), and displacements of the cables [m], float32 (pose, 8).
    """
    with resources.files("softwarp.envs").joinpath("trunk_cup_reachable.npz").open("rb") as file:
        held = np.load(file)
        return np.asarray(held["pose"], dtype=np.float32), np.asarray(held["command"], dtype=np.float32)
