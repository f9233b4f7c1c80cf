"""Maze: a soft tripod on three servo arms carries a maze and tilts it so that a ball rolls to a goal.

Scene        scenes/maze.py: a silicone tripod with three servos, a maze of 60 x 60 mm on it, a ball of 4 mm; 20 Hz
             control, 5 sub-steps of 10 ms
Action       tilt:       (2,) in [-1, 1] -> how far the maze is to be tilted down towards +x and +y / max_tilt; the
                         servos go to the angles that hold it so at rest, by 0.1 rad per action at most
             continuous: (3,) in [-1, 1], changes of the servos' angles, +-0.1 rad per action
             discrete:   6 choices, 0-2 raise and 3-5 lower the angle of that servo by 0.1 rad
Observation  state: (25,), in the maze's frame: the 19 of SimpleMaze with the measured tilt, then the three angles
             less the first one / 1 rad and the three commanded ones likewise
             paper: (9,) raw metres, world: ball, a corner of the maze's floor, goal
Start        tripod at rest, ball at rest near the middle of the maze; in random mazes in the middle of any cell
Goal         one of four corners, or anywhere on the middles of the corridors
Reward       progress: way_prev - way in cells of the maze, on the shortest way; reached +5; lost -5
             paper:    1 where more of the way is done than ever before, else the share that is done
Ends         terminated on success (``end_on_success``), and if the ball leaves the maze; truncated after 250 actions
Success      the ball came within 5 mm of the goal during the action; ``distance`` is its least one

Servo angles are 0 in the flat state and negative where an arm leans outwards. They change in equal parts over the
sub-steps of an action, within the servos' limits, speed and torque. ``MazeConfig.paper`` sets SofaGym's behaviour.

Tilting moves the plate sideways as well, by 7 mm for 0.2 rad, and the ball stays behind: tilts that come too fast throw
it back. The hand-written policy tilts along the shortest way; it reached the corner of the serpentine in 16 of 16
episodes with each kind of action, within 60 to 170 actions. Plans of SimpleMaze become servo commands by ``softwarp
transfer`` (docs/transfer.md).

The elements are SOFA's linear tetrahedra in one layer, which are too stiff: at equal angles of -1.4965 rad the plate
stands 26.2 mm high instead of 21.1 (quadratic elements between the same nodes), at -1 rad 45.9 instead of 42.9. With
``fidelity="accurate"``, one layer of hexahedra that bend as walls do, the tripod sinks under its weight as far as
converged elements let it, to 2 %, where the default lacks three quarters; a step takes 1.2 to 1.3 times the time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from softwarp.builder import ModelBuilder
from softwarp.envs import randomization
from softwarp.envs.options.maze import ACTION_KINDS as ACTION_KINDS
from softwarp.envs.options.maze import MazeConfig
from softwarp.envs.options.tripod import SERVOS
from softwarp.envs.scenes.maze import CONTACT_CAPACITY, TripodMazeScene, build_tripod_maze_scene
from softwarp.envs.scenes.tripod import set_up
from softwarp.envs.sums import length_of
from softwarp.envs.tasks.simple_maze import LIMIT, SimpleMaze, turned_to
from softwarp.envs.tilt_table import TiltTable
from softwarp.render import Camera
from softwarp.simulation import Simulation

PAPER_LIMIT = 0.5  # m

_STREAM_YOUNGS, _STREAM_FRICTION, _STREAM_MASS = range(3, 6)


class Maze(SimpleMaze):
    """See the table at the top of this file."""

    config: MazeConfig
    scene: TripodMazeScene  # type: ignore[assignment]

    def build_scene(self, builder: ModelBuilder) -> None:
        """Tripod, servos, maze, ball."""
        self.scene = build_tripod_maze_scene(self.config, builder)

    @property
    def contact_capacity(self) -> int:
        """Room for what the ball can touch at the same time."""
        return CONTACT_CAPACITY

    def make_simulation(self, num_worlds: int) -> Simulation:
        """As ever, but the legs are bent, and the ball hovers until episodes start, so that the tripod can settle."""
        sim = super().make_simulation(num_worlds)
        self.hold_up(sim, self.scene.ball, self.config.ball_mass)
        set_up(sim, self.scene.tripod, self.config)
        sim.time.zero_()
        sim.set_initial()
        return sim

    def setup(self) -> None:
        """Drop what held the ball; commands, limits, and for tilts the angles that hold them."""
        config, sim, scene, device = self.config, self.sim, self.scene, self.device
        sim.control.body_force.zero_()
        sim.set_initial()
        self._rest = sim.frame_pose[:1].clone()
        self.command = self.add_world_state("command", SERVOS)  # rad
        super().setup()
        motors = torch.tensor(scene.tripod.motors, device=device)
        self._angles = sim.joint_position[:, motors[0] : motors[-1] + 1]
        self._target = sim.control.joint_target[:, motors[0] : motors[-1] + 1]
        self._home = torch.full((SERVOS,), config.angle, device=device)
        self._from = torch.zeros_like(self.command)
        unit = torch.eye(SERVOS, device=device)
        self._choices = config.action_step * torch.cat((unit, -unit))
        self._up = torch.tensor([0.0, 0.0, 1.0], device=device)
        self._corner = torch.tensor((*(-half for half in self._half.tolist()), -config.floor), device=device)
        self._table = TiltTable.of(self) if config.action_kind == "tilt" else None
        self._limit = torch.full((9 if config.observation == "paper" else 25,), LIMIT, device=device)
        if config.observation == "paper":
            self._limit.fill_(PAPER_LIMIT)
        if config.reward == "paper":
            self.whole_way = self.add_world_state("whole_way")  # m, from start to goal

    def reset_worlds(self, mask: Tensor) -> None:
        """The ball on the maze where it rests, a goal, new parameters."""
        torch.where(mask[:, None], self._home, self.command, out=self.command)
        super().reset_worlds(mask)
        if self.config.reward == "paper":
            torch.where(mask, self.way, self.whole_way, out=self.whole_way)
        self._randomize(mask)

    def place_ball(self, place: Tensor, mask: Tensor) -> None:
        """Put the ball on the floor of the resting maze at places in its plane [m], (world, 2)."""
        self._lay(place, mask, self._rest[:, self.scene.maze].expand(self.num_worlds, -1))

    def lay_ball(self, place: Tensor) -> None:
        """Lay the ball of all worlds at rest on the floor as it stands now, at places in its plane [m], (world, 2)."""
        self._lay(place, self._all, self._pose)
        self.sim.frame_twist[:, self.scene.ball] = 0.0
        self.sim.good_twist[:, self.scene.ball] = 0.0

    def _lay(self, place: Tensor, mask: Tensor, pose: Tensor) -> None:
        height = torch.full_like(place[:, :1], self.config.rest_height)
        local = torch.cat((place, height), dim=1).to(pose.dtype)
        poses = self.sim.frame_pose.clone()
        poses[:, self.scene.ball, :3] = pose[:, :3] + turned_to(pose[:, 3:], local)
        self.place_frames(poses, mask)

    def _randomize(self, mask: Tensor) -> None:
        """Draw the parameters that have a range."""
        config, params = self.config, self.sim.params

        def assign(target: Tensor, stream: int, limits: tuple[float, float]) -> None:
            value = randomization.in_range(self.draw(stream, 1)[:, 0], limits)
            target.copy_(torch.where(mask, value.to(target.dtype), target))

        if config.youngs_range is not None:
            assign(params.youngs[:, self.scene.tripod.body], _STREAM_YOUNGS, config.youngs_range)
        if config.mu_range is not None:
            assign(params.pair_mu[:, 0], _STREAM_FRICTION, config.mu_range)
        if config.ball_mass_range is not None:
            assign(params.body_mass[:, self.scene.ball], _STREAM_MASS, config.ball_mass_range)

    # Actions

    @property
    def action_size(self) -> int:
        """Two tilts or three angles."""
        return {"tilt": 2, "continuous": SERVOS, "discrete": 0}[self.config.action_kind]

    @property
    def action_count(self) -> int:
        """Raise or lower one angle."""
        return 2 * SERVOS if self.config.action_kind == "discrete" else 0

    def action_mask(self) -> Tensor | None:
        """Choices that do not ask for an angle outside the servo's limits."""
        if self.config.action_kind != "discrete":
            return None
        asked = self.command[:, None] + self._choices
        legal: Tensor = ((asked >= self.config.min_angle) & (asked <= self.config.max_angle)).all(dim=2)
        return legal

    def action_names(self) -> Sequence[str]:
        """Tilts or servos."""
        servos = [f"servo {number}" for number in range(SERVOS)]
        if self.action_count:
            return [f"{change} {servo}" for change in ("raise", "lower") for servo in servos]
        return ("tilt to +x", "tilt to +y") if self.config.action_kind == "tilt" else servos

    def apply_action(self, action: Tensor, substep: int) -> None:
        """Move the angles to their new commands in equal parts."""
        self._follow_ball(substep)
        if substep == 0:
            self._from.copy_(self.command)
            self._set_command(action)
        share = (substep + 1) / self.action_repeat
        self._target.copy_(torch.lerp(self._from, self.command, share))

    def _set_command(self, action: Tensor) -> None:
        """Angles [rad] to be reached at the end of this action; a choice outside the limits changes nothing."""
        config = self.config
        if config.action_kind == "discrete":
            asked = self.command + self._choices[action]
            inside = ((asked >= config.min_angle) & (asked <= config.max_angle)).all(dim=1, keepdim=True)
            torch.where(inside, asked, self.command, out=self.command)
            return
        if config.action_kind == "continuous":
            asked = self.command + config.action_step * action.clamp(-1.0, 1.0)
        else:
            assert self._table is not None
            asked = self._table.angles(action.clamp(-1.0, 1.0) * config.max_tilt)
            asked = self.command + (asked - self.command).clamp(-config.action_step, config.action_step)
        self.command.copy_(asked.clamp(config.min_angle, config.max_angle))

    # Who follows a plan, and what follows from one: control/, planning/tracing.py

    # Of inverse control: where targets are out of reach, more would swing; the ball weighs nothing against the legs.
    steering: ClassVar[dict[str, Any]] = {"share": 0.7, "contact": False}

    @property
    def plate(self) -> int:
        """The body whose normal inverse control steers."""
        return int(self.scene.maze)

    @property
    def plate_marker(self) -> int:
        """The point whose height it steers."""
        return self.scene.tripod.middle

    def plan_target(self) -> Tensor:
        """Where the floor's normal points, (world, 3)."""
        return turned_to(self._pose[:, 3:].float(), self._up.expand(self.num_worlds, 3))

    # What is seen and measured

    def seen_tilt(self) -> Tensor:
        """How far the maze is tilted down towards x and y [rad], (world, 2): direction and length of one turn."""
        normal = self.plan_target()
        level = length_of(normal[:, :2])[:, None]
        tilt: Tensor = torch.atan2(level, normal[:, 2:]) * normal[:, :2] / level.clamp_min(1.0e-9)
        return tilt

    def reward_terms(self, action: Tensor, distance: Tensor) -> dict[str, Tensor]:
        """See the table at the top."""
        if self.config.reward != "paper":
            return super().reward_terms(action, distance)
        least = self.least_way.clone()
        super().reward_terms(action, distance)  # measures the way
        done = 1.0 - self.way / self.whole_way.clamp_min(self.ways.pitch)
        return {"progress": torch.where(self.way < least, torch.ones_like(done), done.clamp(0.0, 1.0))}

    def observe(self) -> dict[str, Tensor]:
        """See the table at the top."""
        if self.config.observation == "paper":
            pose = self._pose.float()
            corner = pose[:, :3] + turned_to(pose[:, 3:], self._corner.expand(self.num_worlds, 3))
            return {"observation": torch.cat((self._ball.float(), corner, self.goal_points()), dim=1)}
        seen = super().observe()["observation"]
        angles = (self._angles.float() - self._home, self.command - self._home)
        return {"observation": torch.cat((seen, *angles), dim=1)}

    def decode(self, observation: Tensor) -> dict[str, Tensor]:
        """As SimpleMaze's, and the angles and their commands [rad], (..., 3) each."""
        seen = super().decode(observation)
        angles = observation[..., 19:] + self._home.repeat(2).to(observation)
        return seen | {"angles": angles[..., :SERVOS], "command": angles[..., SERVOS:]}

    def camera(self) -> Camera:
        """From above, a little from the front: servos in sight, and the ball behind walls."""
        return Camera(eye=(0.045, -0.115, 0.215), target=(0.0, 0.0, 0.025), fov=31.0)

    def shown_region(self) -> NDArray[np.float64]:
        """Tripod and maze."""
        return np.array([[-0.06, -0.06, -0.02], [0.06, 0.06, 0.06]])
