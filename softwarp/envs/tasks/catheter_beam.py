"""CatheterBeam: a catheter, a guide and a coil are pushed and turned through a forking vessel to an outlet.

Scene        scenes/catheter_beam.py: three instruments of 1.3 m in an aorta of 13 mm with seven outlets a metre away,
             or in random anatomies, friction 0.1, no gravity; 10 Hz control, 10 sub-steps of 10 ms
Action       continuous: (6,) in [-1, 1], for coil, guide and catheter: insertion per 25 mm (negative withdraws), turn
                         per 0.6 rad
             discrete:   12 choices, four for each of them: 0 insert, 1 turn, 2 turn back, 3 withdraw
Observation  compact: (40,): lengths that are out (3,) [m]; sines, then cosines of the turns (6,); tip / 0.5 m; unit
                      vectors of the line's end, of the vessel there towards the goal, and of the way that the guide's
                      hook bends to (9,); goal - tip / 0.5 m; way left [m]; places 15, 30 and 60 mm ahead on the way to
                      the goal, less the tip / 50 mm (9,); way to the next fork, or goal / 50 mm; unit vector across it
                      from the other branches to the one to take (3,); 1 where the way leads on, -1 where it leads
                      back; 1 where the end of the vessel is near; with ``observe_force`` one more: largest sum of the
                      wall's forces in the action / ``force_scale``
             local:   (32,): the same, without turns, tip and hook, and vectors in a frame in which every anatomy
                      looks alike: the way that the guide's hook bends to, the normal of its plane and the line's
                      tangent, where the arc begins; then how far the tip is off the centre line / 10 mm (3,), and the
                      radius of the lumen there / 10 mm
             paper:   (12,): lengths [mm], turns [rad], tip [mm], goal [mm]
Wall force   ``wall_force`` (2,) beside the observation, in N: the sum of the sizes of all forces on the wall, the
             largest in the action, and the largest in the episode so far
Start        the catheter 1 mm out of the port, the others at it; each begins to turn to an angle that is drawn
Goal         the middle of an outlet's lumen, drawn
Reward       shaped: progress: way_prev - way along the vessel / 50 mm; reached +5; effort -0.01 mean(a^2); force
                     -force_penalty (largest sum of wall forces in the action - force_limit) [N]
             paper:  -distance [mm], 500 at success
Ends         terminated on success (``end_on_success``), with ``end_on_force`` at too much force, and when the tip has
             left the vessel behind an outlet; truncated after 120 actions
Success      the tip came within 5 mm of the goal during the action; ``distance`` is its least one

Instruments are counted from the innermost, the coil; SofaGym counts from the catheter. The tip is that of the one which
is out farthest. Nothing is pushed farther where the vessel ends, 4 cm behind its outlets; no instrument
leads the next one by more than ``leads``, as thin ones crumple and are then drawn along. The guide's end is an arc
that the catheter straightens when it is pushed over it: the hand-written policy goes round a fork with the guide alone,
its arc turned to the branch, and brings the catheter after it. It reaches every outlet, in 21 of 21 episodes, three for
each (under a limit of swings of 0.3 rad); the wall bears at most 0.3 N in the median episode, 5 N in the worst.
Planned by MPPI (``softwarp plan env=catheter_beam planner=mppi``), each of the seven is reached in 10 of 10 episodes
after 41 to 66 actions; the wall bears 0.50 N at most; by CEM 7 of 7 in 7 of 7 (docs/planning.md). A clone of the
hand-written policy from 24 random anatomies (``experiment=fast/catheterbeam_random``) met 117 of 128 goals in 16 unseen
ones and 64 of 64 in the arch (docs/learning.md). Inverse control of
the tip (control/tubes.py) is not offered: led by places 15, 30 or 60 mm ahead on the way it brought none of seven
worlds to an outlet in 120 actions; most stayed in the first 40 cm.

A line that crumples in a fork snaps over and crosses the lumen within a step. Contacts are therefore measured where the
step leads to, and the step mended, up to three times, and a step swings no segment by more than 0.5 rad. Pushed inwards
at full speed and turned at random, 16 worlds did not fail in 1440 actions, and the middle of a line was up to 9 mm deep
in the wall; without the limit 3 mm, but 8 actions failed, and nodes went by up to 1.1 m in a step. Of a million
world-steps of random actions and a million in which each action stays at one end of its range (4096 worlds, an H200)
none failed, 8000 looks at each saw the line nowhere in the wall, and five actions of the latter had more contacts than
there is room for; without the limit 2 failed, and one in 8000 looks saw the line in the wall. float32 is 1.8 times as
fast there, 130 000 world-steps/s of 4096 worlds.

All figures above but those of planners are from before steps were taken again.

A metre of all three at once, pushed and turned all the time in a vessel of 12 mm, is the limit. What a step lengthens
segments by there presses the wall, and friction holds the line until it folds; so worlds whose lines swing by more than
0.1 rad in a step take it again by Newton's method, one step in a hundred. Of 0.67 million random actions, 6.7 million
world-steps (4096 worlds on a GPU, 19 000 world-steps/s), none failed then, and the middle of a line was in the wall, at
most 1.2 mm deep, in less than one of a thousand looks. Of three seeds of four worlds each none is in the wall in 150
actions, which bears 0.6 N at most, and 0.01 N in the median action. Without, lines fold and are in the wall for 24
actions, with 106 N, and steps take up to twice as long. Which lines a fork throws is decided by rounding: with 0.05
rad, two of five seeds had a tip in the wall at the end of one action, 0.2 and 6 mm deep. The hand-written policy takes
4 % more time with 0.05 rad, insertion by random actions with 0.1 rad 1.6 times as much.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from softwarp.builder import ModelBuilder
from softwarp.envs import randomization, rewards, sums
from softwarp.envs.options.catheter_beam import COIL, GUIDE, CatheterBeamConfig
from softwarp.envs.options.catheter_beam import OBSERVATION_KINDS as OBSERVATION_KINDS
from softwarp.envs.options.tubes import ACTION_KINDS as ACTION_KINDS
from softwarp.envs.options.tubes import REWARD_KINDS as REWARD_KINDS
from softwarp.envs.options.tubes import TUBES
from softwarp.envs.scenes.catheter_beam import (
    CONTACT_CAPACITY,
    VIEWED_FROM,
    CatheterScene,
    build_catheter_scene,
)
from softwarp.envs.tasks.tubes import TubeTask
from softwarp.envs.vessel_ways import VesselWays
from softwarp.model.handles import Telescope

REPEAT_SWING = 0.1  # rad, of a segment, which lengthens it by a 200th
PLACE, NEAR, ASIDE = 0.5, 0.05, 0.01  # m worth 1 in an observation
AHEAD = (0.015, 0.030, 0.060)  # m, how far ahead the places are that are seen
ROOM = 0.005  # m, where nothing is pushed on before the vessel's end
END = 0.030  # m, from which the end of the vessel is near
REACHED = 500.0  # SofaGym's reward at success
Layout = tuple[tuple[str, int, float], ...]  # name, entries, what is worth 1
COMPACT: Layout = (
    ("length", 3, 1.0),
    ("sin", 3, 1.0),
    ("cos", 3, 1.0),
    ("tip", 3, PLACE),
    ("direction", 3, 1.0),
    ("along", 3, 1.0),
    ("hook", 3, 1.0),
    ("to_goal", 3, PLACE),
    ("way", 1, 1.0),
    ("ahead", 9, NEAR),
    ("to_fork", 1, NEAR),
    ("side", 3, 1.0),
    ("on", 1, 1.0),
    ("ends", 1, 1.0),
)
ABSOLUTE = ("sin", "cos", "tip", "hook")  # what nothing local tells
LOCAL: Layout = (
    *(entry for entry in COMPACT if entry[0] not in ABSOLUTE),
    ("aside", 3, ASIDE),
    ("radius", 1, ASIDE),
)
LAYOUTS = {"compact": COMPACT, "local": LOCAL}
TURNED = ("direction", "along", "to_goal", "ahead", "side", "aside")  # vectors, which "local" has in the hook's frame
LIMIT, PAPER_LIMIT = 4.0, 2.0e3
_MILLIMETRE = 1.0e-3  # m

_STREAM_GOAL, _STREAM_ANATOMY, _STREAM_START = range(3)


class CatheterBeam(TubeTask):
    """See the table at the top of this file."""

    config: CatheterBeamConfig
    tube_names = ("coil", "guide", "catheter")
    scene: CatheterScene
    reward_range = (-1.0, 1.0)
    sweep_tolerance = 1.0e-6  # of extents of the scene: a micrometre, finer than anything seen here
    viewed_from = VIEWED_FROM
    goal_radius = 0.005

    @property
    def repeat_swing(self) -> float:
        """Lines are long and vessels narrow: what a step lengthens segments by would press the wall."""
        return REPEAT_SWING

    @property
    def gravity(self) -> tuple[float, float, float]:
        """Acceleration of the scene [m/s^2]."""
        return self.config.gravity

    @property
    def contact_capacity(self) -> int:
        """Nearly all of the line may touch, half of it anew where a step ends."""
        return max(CONTACT_CAPACITY, 2 * self.config.segments)

    @property
    def telescope(self) -> Telescope:
        """The instruments."""
        return self.scene.instruments

    @property
    def most_lengths(self) -> tuple[float, ...]:
        """Their lengths [m]."""
        return self.config.lengths

    def build_scene(self, builder: ModelBuilder) -> None:
        """Vessel and instruments."""
        self.scene = build_catheter_scene(self.config, builder, self.config.first_lengths)

    def setup(self) -> None:
        """Allocate goals, anatomies and ways."""
        super().setup()
        self.ways = VesselWays(self.scene.trees, AHEAD, self.device)
        self.anatomy = self.add_world_state("anatomy", dtype=torch.int64)
        self.outlet = self.add_world_state("outlet", dtype=torch.int64)
        self.way = self.add_world_state("way")  # m, left
        self.nearest = self.add_world_state("nearest")  # m, of tip and goal in the action so far
        self._offset = torch.tensor(self.scene.offsets, dtype=torch.float64, device=self.device)
        self._rest = self.sim.frame_pose[:1].clone()
        self._nodes_end = self._nodes.stop - 1
        self._worlds = torch.arange(self.num_worlds, device=self.device)
        kind = self.config.observation
        is_paper = kind == "paper"
        size = 12 if is_paper else sum(size for _, size, _ in LAYOUTS[kind]) + int(self.config.observe_force)
        self._limit = torch.full((size,), PAPER_LIMIT if is_paper else LIMIT, device=self.device)

    def reset_worlds(self, mask: Tensor) -> None:
        """Draw anatomy and outlet; instruments as at the start."""
        if len(self.scene.trees) > 1:
            u = self.draw(_STREAM_ANATOMY, 1)[:, 0]
            drawn = (u * len(self.scene.trees)).long().clamp_max(len(self.scene.trees) - 1)
            torch.where(mask, drawn, self.anatomy, out=self.anatomy)
            poses = self._rest.repeat(self.num_worlds, 1, 1)
            poses[:, self.scene.wall, 0] = -self._offset[self.anatomy].to(poses.dtype)
            self.place_frames(poses, mask)
        if self.config.outlet is not None:
            outlet = torch.full_like(self.outlet, self.config.outlet)
        else:
            u = self.draw(_STREAM_GOAL, 1)[:, 0]
            outlet = (u * self.ways.outlets).long().clamp_max(self.ways.outlets - 1)
        torch.where(mask, outlet, self.outlet, out=self.outlet)
        super().reset_worlds(mask)
        turn = self.config.start_turn
        angle = randomization.in_range(self.draw(_STREAM_START, TUBES), (-turn, turn))
        torch.where(mask[:, None], angle, self.angle, out=self.angle)
        self._tell(self.length, self.angle)
        place = self.tip()
        torch.where(mask, sums.length_of(self.goal - place), self.nearest, out=self.nearest)
        torch.where(mask, self._way_left(), self.way, out=self.way)

    def draw_goals(self) -> Tensor:
        """Middle of the outlet."""
        return self.ways.goals[self.anatomy, self.outlet]

    # Actions

    def apply_action(self, action: Tensor, substep: int) -> None:
        """Move lengths and turns; keep how near the tip has come to the goal."""
        if substep == 0:
            self.nearest.fill_(torch.inf)
        torch.fmin(self.nearest, self._apart(), out=self.nearest)
        super().apply_action(action, substep)

    def _set_command(self, action: Tensor) -> None:
        """Lengths and angles after this action; at the vessel's end no length grows beyond the tip's."""
        super()._set_command(action)
        out = self.sim.tube_length.to(torch.float32)
        room = self.ways.room_left(self.anatomy, self.ways.locate(self.anatomy, self.tip())) - ROOM
        most = out.amax(dim=1) + room.clamp_min(0.0)
        torch.minimum(self.length, most[:, None], out=self.length)
        for inner in (GUIDE, COIL):  # thin ones crumple where nothing around them holds them
            longest = self.length[:, inner + 1] + self.config.leads[inner]
            self.length[:, inner] = torch.minimum(self.length[:, inner], longest)

    # What is seen and measured

    def tip(self) -> Tensor:
        """Where the line ends [m], shape (world, 3)."""
        return self.sim.rod_x[:, self._nodes_end].to(torch.float32)

    def hook(self) -> Tensor:
        """Unit vector to which the guide's arc bends where it begins, (world, 3)."""
        return self.hook_frame()[:, 0]

    def hook_frame(self) -> Tensor:
        """Where the guide's arc begins: the way that it bends to, the normal of its plane, the line's tangent.

        Returns:
            Rows of a rotation (the second one is tangent times bend), (world, 3, 3).
        """
        length, angle = self.sim.tube_length, self.sim.tube_angle
        most, carrier = length.max(dim=1)
        between = (angle[:, GUIDE] - angle[self._worlds, carrier]).to(torch.float32)
        pieces = self.config.segments
        straight = (length[:, GUIDE] - self.config.guide_end).clamp_min(0.0) / most.clamp_min(1.0e-9)
        node = self._nodes.start + (pieces * straight).to(torch.int64).clamp_max(pieces)
        x, y, z, w = self.sim.rod_q[self._worlds, node].to(torch.float32).unbind(dim=1)
        d1 = torch.stack((1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + z * w), 2.0 * (x * z - y * w)), dim=1)
        d2 = torch.stack((2.0 * (x * y - z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + x * w)), dim=1)
        d3 = torch.stack((2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y)), dim=1)
        cos, sin = between.cos()[:, None], between.sin()[:, None]
        return torch.stack((cos * d1 + sin * d2, cos * d2 - sin * d1, d3), dim=1)

    def _apart(self) -> Tensor:
        """Tip and goal now [m]."""
        return sums.length_of(self.goal - self.tip())

    def _way_left(self) -> Tensor:
        """Way from the tip to the goal along the vessel [m]."""
        located = self.ways.locate(self.anatomy, self.tip())
        return self.ways.remaining(self.anatomy, self.outlet, located)

    def measure_distance(self) -> Tensor:
        """Least distance of tip and goal within the action [m]."""
        return torch.minimum(self.nearest, self._apart())

    def is_terminated(self, distance: Tensor) -> Tensor:
        """The tip is out of the vessel behind an outlet, or the force is too large where that ends an episode."""
        return super().is_terminated(distance) | self.is_out()

    def is_out(self) -> Tensor:
        """Whether the tip has left the vessel behind an outlet, bool (world,)."""
        located = self.ways.locate(self.anatomy, self.tip())
        return self.ways.room_left(self.anatomy, located) < -0.9 * self.ways.half_step

    def reward_terms(self, action: Tensor, distance: Tensor) -> dict[str, Tensor]:
        """See the table at the top."""
        config, terms, success = self.config, {}, self.is_success(distance).float()
        self.note_force()
        torch.fmin(self.least_distance, distance, out=self.least_distance)
        way = self._way_left()
        before = self.way.clone()
        self.way.copy_(way)
        if config.reward == "paper":
            terms["distance"] = torch.where(success > 0.0, REACHED, -distance / _MILLIMETRE)
        else:
            terms["progress"] = rewards.progress(before, way, config.progress_scale)
            terms["reached"] = config.reach_bonus * success
            if self.action_size:
                terms["effort"] = config.effort_weight * rewards.effort(action.clamp(-1.0, 1.0))
        if config.force_penalty > 0.0:
            terms["force"] = -config.force_penalty * (self.force - config.force_limit).clamp_min(0.0)
        return terms

    def observation_bounds(self) -> dict[str, tuple[Tensor, Tensor]]:
        """The same symmetric limit for every entry; forces are not negative."""
        none = torch.zeros_like(self._most_force)
        return {"observation": (-self._limit, self._limit), "wall_force": (none, self._most_force)}

    def observe(self) -> dict[str, Tensor]:
        """The kind that was asked for, and the forces on the wall."""
        length, angle = (x.to(torch.float32) for x in (self.sim.tube_length, self.sim.tube_angle))
        force = self.note_force()
        if self.config.observation == "paper":
            paper = (length / _MILLIMETRE, angle, self.tip() / _MILLIMETRE, self.goal / _MILLIMETRE)
            return {"observation": torch.cat(paper, dim=1), "wall_force": force}
        found = self._measured(length, angle)
        if self.config.observation == "local":
            frame = self.hook_frame()
            for name in TURNED:
                x, y, z = found[name][..., None].unbind(dim=2)  # (world, vector, 1) each
                found[name] = x * frame[:, None, :, 0] + y * frame[:, None, :, 1] + z * frame[:, None, :, 2]
        parts = [found[name].flatten(1) / scale for name, _, scale in LAYOUTS[self.config.observation]]
        if self.config.observe_force:
            parts.append(force[:, :1] / self.config.force_scale)
        return {"observation": torch.cat(parts, dim=1), "wall_force": force}

    def _measured(self, length: Tensor, angle: Tensor) -> dict[str, Tensor]:
        """What compact and local observations are of, by name, in SI units and world axes."""
        vessel, outlet, ways, tip = self.anatomy, self.outlet, self.ways, self.tip()
        located = ways.locate(vessel, tip)
        to_fork, side = ways.next_fork(vessel, outlet, located)
        return {
            "length": length,
            "sin": angle.sin(),
            "cos": angle.cos(),
            "tip": tip,
            "direction": self.direction()[:, None],
            "along": ways.along(vessel, outlet, located)[:, None],
            "hook": self.hook(),
            "to_goal": (self.goal - tip)[:, None],
            "way": ways.remaining(vessel, outlet, located)[:, None],
            "ahead": ways.look_ahead(vessel, outlet, located) - tip[:, None],
            "to_fork": to_fork[:, None],
            "side": side[:, None],
            "on": ways.leads_on(vessel, outlet, located)[:, None],
            "ends": (ways.room_left(vessel, located) < END).to(torch.float32)[:, None],
            "aside": ways.aside(vessel, located, tip)[:, None],
            "radius": ways.radius[vessel, located[0]][:, None],
        }

    def decode(self, observation: Tensor) -> dict[str, Tensor]:
        """What compact and local observations tell, in m, by name, (..., k) each, ``hook`` in both.

        Raises:
            ValueError: If observations are the paper's, which hold neither directions nor ways.
        """
        if self.config.observation == "paper":
            raise ValueError(
                "CatheterBeam: decode needs observation='compact' or 'local'; the paper's holds no directions"
            )
        layout = LAYOUTS[self.config.observation]
        sizes = [size for _, size, _ in layout]
        parts = observation[..., : sum(sizes)].split(sizes, dim=-1)
        told = {name: scale * part for (name, _, scale), part in zip(layout, parts, strict=True)}
        if "hook" not in told:
            told["hook"] = torch.tensor((1.0, 0.0, 0.0)).to(observation).expand_as(told["side"])
        return told

    def shown_region(self) -> NDArray[np.float64]:
        """Where the vessel comes [m]."""
        points = np.concatenate([tree.points for tree in self.scene.trees])
        return np.stack([points.min(axis=0), points.max(axis=0)])

    def shown_goals(self) -> Tensor:
        """All outlets of the first anatomy."""
        return self.ways.goals[0]
