"""A simulator of point masses with the attributes that SoftEnv uses, and a small task on it.

Each world is a point that walks towards its commanded position. A command beyond 100 m makes a world fail: it is rolled
back and reports NONFINITE, as the real simulator does. ``corrupt`` makes it return NaN without noticing.
"""

from dataclasses import dataclass, field
from types import SimpleNamespace

import torch
from torch import Tensor

from softwarp.envs import rewards
from softwarp.envs.base import EnvConfig, SoftEnv
from softwarp.snapshot import Snapshot


class FakeSimulation:
    def __init__(self, num_worlds: int, dt: float) -> None:
        self.num_worlds, self.dt, self.steps, self.revision = num_worlds, dt, 0, 0
        self.x, self.initial = torch.zeros(num_worlds, 2), torch.zeros(num_worlds, 2)
        self.status = torch.zeros(num_worlds, dtype=torch.int32)
        self.time = torch.zeros(num_worlds)
        self.control = SimpleNamespace(target=torch.zeros(num_worlds, 2))
        self.params = SimpleNamespace(cable_min_tension=torch.zeros(num_worlds, 0))
        self.corrupt = torch.zeros(num_worlds, dtype=torch.bool)
        self.node_v = torch.zeros(num_worlds, 1, 3)
        self.frame_pose, self.frame_twist = torch.zeros(num_worlds, 0, 7), torch.zeros(num_worlds, 0, 6)
        self.mode_v = torch.zeros(num_worlds, 0)
        self.inverted_count = torch.zeros(num_worlds, dtype=torch.int32)
        self.contact_overflow = torch.zeros(num_worlds, dtype=torch.int32)

    def step(self) -> None:
        self.steps += 1
        failed = self.control.target.abs().amax(dim=1) > 100.0
        moved = self.x + 0.2 * (self.control.target - self.x)
        self.x = torch.where(failed[:, None], self.x, moved)
        self.x[self.corrupt] = torch.nan
        self.status = failed.to(torch.int32) * 3

    def reset(self, mask: Tensor | None) -> None:
        mask = torch.ones(self.num_worlds, dtype=torch.bool) if mask is None else mask
        self.x[mask] = self.initial[mask]
        self.control.target[mask] = 0.0
        self.status[mask] = 0
        self.corrupt[mask] = False

    @property
    def node_x(self) -> Tensor:
        """The point, as the only node."""
        return self.x[:, None]

    def refresh(self) -> None:
        """Called for the state at rest: it settles at once, at the place where gravity would take it."""
        self.x.fill_(0.25)

    def set_initial(self) -> None:
        self.initial = self.x.clone()

    def snapshot(self, worlds: list[int] | None = None) -> Snapshot:
        worlds = list(range(self.num_worlds)) if worlds is None else worlds
        return Snapshot("fake", "float32", {"x": self.x[worlds], "target": self.control.target[worlds]})

    def restore(self, snapshot: Snapshot, worlds: list[int]) -> None:
        self.x[worlds], self.control.target[worlds] = snapshot.arrays["x"], snapshot.arrays["target"]


@dataclass(kw_only=True)
class PointConfig(EnvConfig):
    max_episode_steps: int = 8
    action_repeat: int = 3
    discrete: bool = False
    limits: list[float] = field(default_factory=lambda: [-2.0, 2.0])
    edge: float = 50.0  # m, a world ends beyond it


class PointEnv(SoftEnv):
    config: PointConfig

    def make_simulation(self, num_worlds):
        return FakeSimulation(num_worlds, self.config.dt)

    def build_scene(self, builder):
        raise AssertionError("the fake needs no scene")

    def setup(self):
        self.goal = self.add_world_state("goal", 2)
        self.seen_substeps = []

    @property
    def action_size(self):
        return 0 if self.config.discrete else 2

    @property
    def action_count(self):
        return 4 if self.config.discrete else 0

    def apply_action(self, action, substep):
        self.seen_substeps.append(substep)
        if self.config.discrete:
            action = torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])[action]
        self.sim.control.target.copy_(action)

    def observation_bounds(self):
        low, high = self.config.limits
        return {"observation": (torch.full((4,), low), torch.full((4,), high))}

    def observe(self):
        return {"observation": torch.cat((self.sim.x, self.goal), dim=1)}

    def measure_distance(self):
        return (self.sim.x - self.goal).norm(dim=1)

    def is_success(self, distance):
        return distance < 0.1

    def is_terminated(self, distance):
        return self.sim.x.abs().amax(dim=1) > self.config.edge

    def reset_worlds(self, mask):
        torch.where(mask[:, None], self.draw(0, 2), self.goal, out=self.goal)

    def reward_terms(self, action, distance):
        return {
            "progress": rewards.progress(self.distance, distance, 1.0),
            "precision": rewards.gaussian(distance, 0.1),
        }
