"""Gripper: a hand with two soft fingers grasps an object on the floor, lifts it to a height and holds it there.

Scene        scenes/gripper.py: two silicone fingers of 20 MPa with a cable each, on a hand that is driven exactly; an
             object of 40 mm and 0.1 kg (a soft cube of 400 kPa; a rigid cube, ball, capsule or figurine) on a floor,
             friction 0.8; 20 Hz control, 5 sub-steps of 10 ms
Action       continuous (5,) in [-1, 1]: change of the hand's x, y by 5 mm, z by 10 mm up or 5 mm down, yaw by
             0.15 rad, and of both cables by 5 mm at most; cables="each" (6,): one entry per cable
             discrete (8): up, down, +x, -x, +y, -y, both cables shorter, both cables longer, by the same steps
Observation  pose (39,): hand x, y, z, sine and cosine of its yaw, object from the hand, the object's first two axes,
             its velocity, its height, fingertips from the object, cables, tensions, goal from the object; squashed, as
             d / (|d| + 5 mm), object beside the hand, and goal from the object; goal
             nodes (54,): instead of axes and velocity the eight corners of the object's box from its middle
             paper (31,): corners, cables, mean of the fingertips, goal;  touch=True adds (14,): pressures of the eight
             cavities, forces of the object on both fingers
Goal         heights: the middle of the object at z in 60 to 160 mm;  list: one of ``goal_heights``;  places: at a point
Start        hand above the floor, open, at x = y = 0; object at x in +-20 mm, y in +-30 mm, turned by +-0.6 rad
Reward       dense: lift 1 - d / d0, at least -1;  hold 1 where d <= 3 mm;  approach -0.2 of 0.1 m from fingertips to
             object beyond 20 mm, at most -0.4
             paper: progress (d_prev - d) / 20 mm in [0, 1];  goal 1 where d <= 3 mm
Ends         truncated after 250 actions (12.5 s); with the paper's options terminated at the goal
Success      d <= 3 mm, d the difference in height, for places the distance

A pull (``pull``, in parts of the object's weight) is drawn anew every action: a force within a cone about the downward
direction, and a moment (``pull_turn``). The dense reward is at most 2 in a step: 183.8 in 250 steps discounted by 0.99.

SofaGym's hand does not travel: springs at its base pull it back to the start. Ours is moved exactly, by as much as its
speed allows. Its gravity is a thousandth of ours, its cube an empty shell, its fingertip a node of the base.
``GripperConfig.paper`` has its actions, its cube's mass, its observation and its reward.

The fingers' linear tetrahedra are too stiff: under small forces their tips go a fifth of the way of converged ones.
With ``fidelity="accurate"``, bricks with fitted moduli, they are within 1.4 % of it, and under commanded cables within
1.9 % (by default 17 to 22 %), in the same time; tensions of a closed hand are then up to 24 % too large.

The size of an object is that of its surface plus ``object_growth``, by which it reaches farther on all sides, edges
rounded: worlds share the geometry and differ in that distance. Masses, moduli and friction differ at will.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from softwarp.builder import ModelBuilder
from softwarp.envs import randomization
from softwarp.envs.base import SoftEnv
from softwarp.envs.options.gripper import ACTION_KINDS as ACTION_KINDS
from softwarp.envs.options.gripper import GOAL_KINDS as GOAL_KINDS
from softwarp.envs.options.gripper import OBJECTS as OBJECTS
from softwarp.envs.options.gripper import OBSERVATION_KINDS as OBSERVATION_KINDS
from softwarp.envs.options.gripper import REWARD_KINDS as REWARD_KINDS
from softwarp.envs.options.gripper import GripperConfig
from softwarp.envs.scenes.gripper import ALARM, CAPACITY, GripperScene, build_gripper_scene, object_shape
from softwarp.envs.sums import in_order, length_of
from softwarp.render import Camera

POSE = (  # name, entries, divisor to order 1
    ("hand", 3, 0.1),
    ("yaw", 2, 1.0),
    ("object", 3, 0.1),
    ("axes", 6, 1.0),
    ("velocity", 3, 0.2),
    ("height", 1, 0.1),
    ("tips", 6, 0.1),
    ("cables", 2, 0.025),
    ("tensions", 2, 200.0),
    ("error", 3, 0.1),
    ("aside", 2, 1.0),
    ("fine", 3, 1.0),
    ("goal", 3, 0.1),
)
NODES = (*POSE[:3], ("corners", 24, 0.05), *POSE[5:])
PAPER = (("corners", 24, 0.1), ("cables", 1, 0.0125), ("tip", 3, 0.1), ("goal", 3, 0.1))
TOUCH = (("pressures", 8, 1000.0), ("forces", 6, 10.0))
LIMIT = 10.0  # of observations
FINE = 0.005  # m, at which a squashed way is 1 / 2
PROGRESS = 0.020  # m, worth 1 with the paper's reward
APPROACH = (0.020, 0.1, 2.0)  # m where it costs nothing, m worth 1, the most that it counts
CHOICES = ((2, 1.0), (2, -1.0), (0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0), (4, 1.0), (4, -1.0))  # command and sign
SIGNS = np.array([[i, j, k] for k in (-1.0, 1.0) for j in (-1.0, 1.0) for i in (-1.0, 1.0)])  # of a box's corners

_GOAL, _PLACE, _MASS, _YOUNGS, _GROWTH, _MU, _PULL = range(7)  # streams of random numbers
_EPISODE = 1 << 20  # numbers of an episode's actions


class Gripper(SoftEnv):
    """See the table at the top of this file."""

    config: GripperConfig
    scene: GripperScene

    @property
    def gravity(self) -> tuple[float, float, float]:
        """Acceleration of the scene [m/s^2]."""
        return self.config.gravity

    def build_scene(self, builder: ModelBuilder) -> None:
        """Hand, fingers, floor, object."""
        self.scene = build_gripper_scene(self.config, builder)

    @property
    def contact_capacity(self) -> int:
        """Room for both fingers on the object and for the object on the floor; finer skins touch at more points."""
        finer = {"coarse": 1, "medium": 3, "fine": 6}[self.config.mesh] * (2 if self.config.element == "p2" else 1)
        cells = self.config.object_cells if self.scene.is_soft else 0
        return CAPACITY[self.config.object] * finer + (cells + 1) ** 2

    def setup(self) -> None:
        """Allocate commands, goals, masses and constants."""
        config, device, scene, sim = self.config, self.device, self.scene, self.sim
        w = config.approach_weight * APPROACH[2]
        self.reward_range = (0.0, 2.0) if config.reward == "paper" else (-1.0 - w, 2.0)
        self.command = self.add_world_state("command", 6)  # hand x, y, z [m], yaw [rad], cables [m]
        self.goal = self.add_world_state("goal", 3)  # m
        self.first_distance = self.add_world_state("first_distance")  # m
        self.mass = self.add_world_state("mass")  # kg, of the object
        self._start = torch.zeros_like(self.command)
        self._change = torch.zeros_like(self.command)
        self._ramp = torch.zeros_like(self.command)
        pull = config.max_displacement
        ranges = (config.hand_x, config.hand_y, config.hand_z, config.hand_yaw, (0.0, pull), (0.0, pull))
        self._low, self._high = torch.tensor(ranges, device=device).T.contiguous()
        self._first = torch.tensor((0.0, 0.0, config.hand_start, 0.0, 0.0, 0.0), device=device)
        steps = (config.move_step, config.move_step, 1.0, config.yaw_step, config.cable_step, config.cable_step)
        self._steps = torch.tensor(steps, device=device)
        self._choices = torch.tensor(_choices(config), device=device)
        self._heights = torch.tensor(config.goal_heights, device=device)
        self._pairs = torch.tensor(scene.object_pairs, device=device)
        self._tips = torch.tensor(scene.tips, device=device)
        self._scale = _scale(self.layout, self.config.touch).to(device)
        if scene.is_soft:
            first, last = sim.model.body_node_start[scene.object : scene.object + 2]
            self._nodes = slice(int(first), int(last))
            self._rest = sim.node_x[:1, self._nodes].clone()  # at rest, where every episode begins
            n = config.object_cells
            corner = [(n * i, n * j, n * k) for k in (0, 1) for j in (0, 1) for i in (0, 1)]
            numbers = [int(first) + i + (n + 1) * (j + (n + 1) * k) for i, j, k in corner]
            self._corners = torch.tensor(numbers, device=device)
            # Equal masses at r about their middle take a moment M as the forces M x r / (2/3 sum r^2), if isotropic.
            away = self._rest[0] - self._rest[0].mean(dim=0)
            self._spread = (2.0 / 3.0) * float(away.square().sum())
        else:
            self._rest = sim.body_pose[:1, scene.object].clone()
            low, high = object_shape(config.object, config.object_size).bounds
            box = 0.5 * (low + high) + 0.5 * (high - low) * SIGNS
            self._corners = torch.as_tensor(box, dtype=torch.float32, device=device)

    @property
    def layout(self) -> Sequence[tuple[str, int, float]]:
        """Names, entries and divisors of the observation, without touch."""
        return {"pose": POSE, "nodes": NODES, "paper": PAPER}[self.config.observation]

    def reset_worlds(self, mask: Tensor) -> None:
        """New object, place and goal; the hand at its start."""
        config, place = self.config, self.draw(_PLACE, 3)
        torch.where(mask[:, None], self._first, self.command, out=self.command)
        growth = self._draw_parameters(mask)
        x = randomization.in_range(place[:, 0], config.object_x)
        y = randomization.in_range(place[:, 1], config.object_y)
        yaw = randomization.in_range(place[:, 2], config.object_yaw)
        self._place_object(torch.stack((x, y, growth), dim=1), yaw, mask)
        where, u = self.object_position(), self.draw(_GOAL, 3)
        if config.goals == "places":
            spans = (config.goal_x, config.goal_y, config.goal_z)
            goal = torch.stack([randomization.in_range(u[:, i], span) for i, span in enumerate(spans)], dim=1)
        else:
            height = randomization.in_range(u[:, 2], config.goal_z)
            if config.goals == "list":
                row = (u[:, 2] * len(self._heights)).to(torch.int64).clamp_(max=len(self._heights) - 1)
                height = self._heights[row]
            goal = torch.stack((where[:, 0], where[:, 1], height), dim=1)
        torch.where(mask[:, None], goal, self.goal, out=self.goal)
        torch.where(mask, self.measure_distance(), self.first_distance, out=self.first_distance)

    def _draw_parameters(self, mask: Tensor) -> Tensor:
        """Mass, modulus, friction and growth of the object; the growth [m], (world,)."""
        config, params = self.config, self.sim.params

        def drawn(stream: int, bounds: tuple[float, float]) -> Tensor:
            return randomization.in_range(self.draw(stream, 1)[:, 0], bounds)

        def put(target: Tensor, value: Tensor) -> None:
            chosen, value = mask, value.to(target.dtype)
            if target.dim() == 2:
                chosen, value = mask[:, None], value[:, None].expand_as(target)
            target.copy_(torch.where(chosen, value, target))

        mass, thing = drawn(_MASS, config.object_mass), self.scene.object
        put(self.mass, mass)
        if self.scene.is_soft:
            put(params.density[:, thing], mass / config.object_size**3)
            put(params.youngs[:, thing], drawn(_YOUNGS, config.object_youngs))
        else:
            put(params.body_mass[:, thing], mass)
        growth, mu = drawn(_GROWTH, config.object_growth), drawn(_MU, config.mu)
        for pair in self.scene.object_pairs:
            put(params.pair_mu[:, pair], mu)
            put(params.pair_contact_distance[:, pair], growth + config.contact_distance)
            put(params.pair_alarm_distance[:, pair], growth + (config.contact_distance + ALARM))
        return growth

    def _place_object(self, shift: Tensor, yaw: Tensor, mask: Tensor) -> None:
        """Start the object of some worlds at rest, shifted [m], (world, 3), and turned about z [rad], (world,)."""
        if not self.scene.is_soft:
            poses, half = self.sim.frame_pose.clone(), 0.5 * yaw
            x, y, z, a, b, c, d = self._rest[0].unbind()
            sin, cos = half.sin(), half.cos()
            parts = (x + shift[:, 0], y + shift[:, 1], z + shift[:, 2])
            turn = (cos * a - sin * b, cos * b + sin * a, cos * c + sin * d, cos * d - sin * c)
            poses[:, self.scene.object] = torch.stack((*parts, *turn), dim=1).to(poses.dtype)
            self.place_frames(poses, mask)
            return
        x, y, z = self._rest.unbind(dim=2)
        cos, sin = yaw.cos()[:, None], yaw.sin()[:, None]
        parts = (cos * x - sin * y + shift[:, :1], sin * x + cos * y + shift[:, 1:2], z + shift[:, 2:])
        nodes = torch.stack(parts, dim=2)
        for view in (self.sim.node_x[:, self._nodes], self.sim.good_x[:, self._nodes]):
            view.copy_(torch.where(mask[:, None, None], nodes.to(view.dtype), view))

    @property
    def action_size(self) -> int:
        """Hand x, y, z, yaw, and the cables."""
        return 0 if self.config.action_kind == "discrete" else 5 + (self.config.cables == "each")

    @property
    def action_count(self) -> int:
        """SofaGym's eight."""
        return len(CHOICES) if self.config.action_kind == "discrete" else 0

    def action_names(self) -> Sequence[str]:
        """Motions of the hand, and the cables."""
        if self.action_count:
            return ("up", "down", "+x", "-x", "+y", "-y", "shorten cables", "lengthen cables")
        each = self.config.cables == "each"
        return ("x", "y", "z", "yaw", *(self.sim.model.cable_names if each else ("cables",)))

    def apply_action(self, action: Tensor, substep: int) -> None:
        """Move hand and cables to their new commands in equal parts; pull at the object."""
        if substep == 0:
            self._start.copy_(self.command)
            self._set_command(action)
            torch.sub(self.command, self._start, out=self._change)
            if self.config.pull or self.config.pull_turn:
                self._pull()
        if substep == self.action_repeat - 1:
            self._ramp.copy_(self.command)
        else:
            torch.add(self._start, self._change, alpha=(substep + 1) / self.action_repeat, out=self._ramp)
        control, half = self.sim.control, 0.5 * self._ramp[:, 3]
        pose = control.body_pose[:, self.scene.hand]
        pose[:, :3].copy_(self._ramp[:, :3])
        pose[:, 5].copy_(half.sin())
        pose[:, 6].copy_(half.cos())
        control.cable_displacement.copy_(self._ramp[:, 4:])

    def _set_command(self, action: Tensor) -> None:
        """Where hand and cables are to be at the end of this action."""
        config = self.config
        if config.action_kind == "discrete":
            self.command += self._choices[action]
        else:
            a = action.clamp(-1.0, 1.0)
            a = a if config.cables == "each" else torch.cat((a, a[:, 4:]), dim=1)
            vertical = torch.where(a[:, 2:3] > 0.0, a[:, 2:3] * config.up_step, a[:, 2:3] * config.down_step)
            self.command += torch.cat((a[:, :2], vertical, a[:, 3:]), dim=1) * self._steps
        torch.fmax(self.command, self._low, out=self.command)  # fmax: a NaN changes nothing
        torch.fmin(self.command, self._high, out=self.command)

    def _pull(self) -> None:
        """A force and a moment on the object, drawn for this action."""
        config, control = self.config, self.sim.control
        number = self._episode * _EPISODE + self.step_count
        u = randomization.uniform(self._seeds, self._streams, number, _PULL, 6)
        g = math.sqrt(sum(part**2 for part in config.gravity))
        weight = (self.mass * g)[:, None]
        down = randomization.direction_in_cone(u[:, :2], (0.0, 0.0, -1.0), config.pull_cone)
        force = weight * (config.pull * u[:, 2:3]) * down
        moment = weight * (0.5 * config.object_size * config.pull_turn) * (2.0 * u[:, 3:] - 1.0)
        if not self.scene.is_soft:
            target = control.body_force[:, self.scene.object]
            target.copy_(torch.cat((force, moment), dim=1))
            return
        nodes = self.sim.node_x[:, self._nodes].to(torch.float32)
        away = nodes - self.object_position()[:, None]
        turn = torch.linalg.cross(moment[:, None].expand_as(away), away) / self._spread
        target = control.node_force[:, self._nodes]
        target.copy_(force[:, None] / nodes.shape[1] + turn)

    def corners(self) -> Tensor:
        """Corners of the object's box [m], shape (world, 8, 3)."""
        if self.scene.is_soft:
            return self.sim.node_x[:, self._corners].to(torch.float32)
        ex, ey, ez = self.object_axes()
        x, y, z = (self._corners[None, :, k, None] for k in range(3))
        return self.object_position()[:, None] + x * ex[:, None] + y * ey[:, None] + z * ez[:, None]

    def object_position(self) -> Tensor:
        """Middle of the object [m], shape (world, 3)."""
        if self.scene.is_soft:
            return 0.125 * in_order(self.corners().unbind(dim=1))
        return self.sim.body_pose[:, self.scene.object, :3].to(torch.float32)

    def object_velocity(self) -> Tensor:
        """Its velocity [m/s], shape (world, 3)."""
        if self.scene.is_soft:
            return 0.125 * in_order(self.sim.node_v[:, self._corners].to(torch.float32).unbind(dim=1))
        return self.sim.body_twist[:, self.scene.object, :3].to(torch.float32)

    def object_axes(self) -> tuple[Tensor, Tensor, Tensor]:
        """Its axes, unit vectors, shape (world, 3) each."""
        if not self.scene.is_soft:
            x, y, z, w = self.sim.body_pose[:, self.scene.object, 3:].to(torch.float32).unbind(dim=1)
            ex = torch.stack((1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + z * w), 2.0 * (x * z - y * w)), dim=1)
            ey = torch.stack((2.0 * (x * y - z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + x * w)), dim=1)
        else:
            corner = self.corners().unbind(dim=1)
            ex = _unit(in_order(corner[1::2]) - in_order(corner[0::2]))
            ey = in_order(c for i, c in enumerate(corner) if i & 2) - in_order(
                c for i, c in enumerate(corner) if not i & 2
            )
            ey = _unit(ey - in_order((ex * ey).unbind(dim=1))[:, None] * ex)
        return ex, ey, torch.linalg.cross(ex, ey)

    def tips(self) -> Tensor:
        """Ends of the fingers [m], shape (world, 2, 3)."""
        return self.sim.marker_x[:, self._tips].to(torch.float32)

    def finger_forces(self) -> Tensor:
        """Forces of the object on the fingers [N], shape (world, 2, 3)."""
        return self.sim.pair_force[:, list(self.scene.holds)].to(torch.float32)

    def observation_bounds(self) -> dict[str, tuple[Tensor, Tensor]]:
        """The same symmetric limit for every entry."""
        high = torch.full_like(self._scale, LIMIT)
        return {"observation": (-high, high)}

    def observe(self) -> dict[str, Tensor]:
        """The kind that was asked for."""
        parts = self._paper_parts() if self.config.observation == "paper" else self._parts()
        if self.config.touch:
            pressures = self.sim.cavity_pressure[:, list(self.scene.cavities)]
            parts += [pressures.to(torch.float32), self.finger_forces().flatten(1)]
        return {"observation": torch.cat(parts, dim=1).to(torch.float32) * self._scale}

    def _parts(self) -> list[Tensor]:
        middle, pose = self.object_position(), self.sim.body_pose[:, self.scene.hand].to(torch.float32)
        hand, sin, cos = pose[:, :3], pose[:, 5], pose[:, 6]
        yaw = torch.stack((2.0 * sin * cos, cos * cos - sin * sin), dim=1)
        if self.config.observation == "nodes":
            shape = [(self.corners() - middle[:, None]).flatten(1)]
        else:
            shape = [*self.object_axes()[:2], self.object_velocity()]
        error = self._error(middle)
        return [
            hand,
            yaw,
            middle - hand,
            *shape,
            middle[:, 2:],
            (self.tips() - middle[:, None]).flatten(1),
            self.sim.control.cable_displacement,
            self.sim.cable_tension,
            error,
            _squashed((middle - hand)[:, :2]),
            _squashed(error),
            self.goal,
        ]

    def _paper_parts(self) -> list[Tensor]:
        cable = self.sim.control.cable_displacement[:, :1].to(torch.float32) - 0.5 * self._high[4:5]
        tips = self.tips()
        return [self.corners().flatten(1), cable, 0.5 * (tips[:, 0] + tips[:, 1]), self.goal]

    def decode(self, observation: Tensor) -> dict[str, Tensor]:
        """Quantities in SI units by name, (..., entries) each, from observations of kind "pose" or "nodes"."""
        values = observation / self._scale
        result, start = {}, 0
        for name, size, _ in self.layout:
            result[name] = values[..., start : start + size]
            start += size
        return result

    def _error(self, middle: Tensor) -> Tensor:
        """From the object to the goal [m], shape (world, 3); for heights upwards only."""
        error = self.goal - middle
        if self.config.goals != "places":
            error = torch.cat((torch.zeros_like(error[:, :2]), error[:, 2:]), dim=1)
        return error

    def measure_distance(self) -> Tensor:
        """Object to goal [m]."""
        return length_of(self._error(self.object_position()))

    def is_success(self, distance: Tensor) -> Tensor:
        """Within the tolerance."""
        return distance <= self.config.success_tolerance

    def reward_terms(self, action: Tensor, distance: Tensor) -> dict[str, Tensor]:
        """See the table at the top."""
        hold = self.is_success(distance).float()
        if self.config.reward == "paper":
            return {"progress": ((self.distance - distance) / PROGRESS).clamp(0.0, 1.0), "goal": hold}
        near, scale, most = APPROACH
        tips = self.tips()
        way = length_of(0.5 * (tips[:, 0] + tips[:, 1]) - self.object_position())
        lift = 1.0 - distance / self.first_distance.clamp_min(self.config.success_tolerance)
        approach = ((way - near) / scale).clamp(0.0, most) * -self.config.approach_weight
        return {"lift": lift.clamp(-1.0, 1.0), "hold": hold, "approach": approach}

    def camera(self) -> Camera:
        """From the front, a little from above."""
        return Camera(eye=(0.16, -0.86, 0.30), target=(0.0, 0.0, 0.125), up=(0.0, 0.0, 1.0), fov=24.0)

    def shown_region(self) -> NDArray[np.float64]:
        """Where hand and object come."""
        reach, top = 0.12, self.config.hand_z[1] + 0.04
        return np.array([[-reach, 0.0, 0.0], [reach, 0.0, 0.0], [0.0, 0.0, top]])


def _choices(config: GripperConfig) -> NDArray[np.float32]:
    """Change of the commands by every discrete action, shape (8, 6)."""
    move, cable = config.move_step, config.cable_step
    table = np.zeros((len(CHOICES), 6), dtype=np.float32)
    for row, (column, sign) in zip(table, CHOICES, strict=True):
        vertical = config.up_step if sign > 0.0 else config.down_step
        row[column] = sign * {2: vertical, 4: cable}.get(column, move)
        row[5] = row[4]
    return table


def _scale(layout: Sequence[tuple[str, int, float]], touch: bool) -> Tensor:
    """Factor of every entry of an observation."""
    entries = [*layout, *(TOUCH if touch else ())]
    return torch.cat([torch.full((size,), 1.0 / divisor) for _, size, divisor in entries])


def _squashed(way: Tensor) -> Tensor:
    """Ways [m] as numbers in (-1, 1) that tell small ones apart."""
    return way / (way.abs() + FINE)


def _unit(vector: Tensor) -> Tensor:
    """Directions of vectors, shape (world, 3)."""
    return vector / length_of(vector)[:, None].clamp_min(1.0e-9)
