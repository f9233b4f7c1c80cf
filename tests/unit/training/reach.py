"""A point that moves by its action towards a goal: an environment with softwarp's keys that needs no simulator."""

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

STEP = 0.05  # m per unit of action
SUCCESS = 0.03  # m


class PointReach(EnvBase):
    """Reach a goal in the square [-0.2, 0.2]^2 m; reward is minus the distance [m] times 10."""

    batch_locked = True

    def __init__(
        self,
        num_worlds: int = 16,
        *,
        seed: int = 0,
        discrete: bool = False,
        max_episode_steps: int = 20,
        terminate: bool = True,
    ) -> None:
        super().__init__(device="cpu", batch_size=[num_worlds])
        n = num_worlds
        self.discrete, self.max_episode_steps, self.terminate = discrete, max_episode_steps, terminate
        self.generator = torch.Generator().manual_seed(seed)
        self.position = torch.zeros(n, 2)
        self.goal = torch.zeros(n, 2)
        self.steps = torch.zeros(n, dtype=torch.int64)
        info = {"success": Binary(1, (n, 1), dtype=torch.bool), "distance": Unbounded((n, 1))}
        self.observation_spec = Composite(observation=Unbounded((n, 4)), **info, shape=(n,))
        self.action_spec = Categorical(5, (n,)) if discrete else Bounded(-1.0, 1.0, (n, 2))
        self.reward_spec = Unbounded((n, 1))
        flags = {key: Binary(1, (n, 1), dtype=torch.bool) for key in ("done", "terminated", "truncated")}
        self.full_done_spec = Composite(**flags, shape=(n,))

    def _observe(self) -> dict[str, torch.Tensor]:
        distance = (self.goal - self.position).norm(dim=-1, keepdim=True)
        return {
            "observation": torch.cat([self.position, self.goal], dim=-1),
            "distance": distance,
            "success": distance < SUCCESS,
        }

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: Any) -> TensorDictBase:
        mask = torch.ones(self.batch_size, dtype=torch.bool)
        if tensordict is not None and "_reset" in tensordict:
            mask = tensordict["_reset"].reshape(self.batch_size)
        goal = torch.rand((*self.batch_size, 2), generator=self.generator) * 0.4 - 0.2
        self.goal[mask] = goal[mask]
        self.position[mask] = 0.0
        self.steps[mask] = 0
        no = torch.zeros((*self.batch_size, 1), dtype=torch.bool)
        flags = {key: no.clone() for key in ("done", "terminated", "truncated")}
        return TensorDict({**self._observe(), **flags}, self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict["action"]
        if self.discrete:
            action = torch.tensor([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])[action]
        assert action.abs().max() <= 1.0
        self.position = self.position + STEP * action
        self.steps = self.steps + 1
        observed = self._observe()
        terminated = observed["success"] & self.terminate
        truncated = (self.steps >= self.max_episode_steps).unsqueeze(-1)
        flags = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
        return TensorDict({**observed, "reward": -10.0 * observed["distance"], **flags}, self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        self.generator.manual_seed(seed or 0)

    def snapshot(self) -> dict[str, torch.Tensor]:
        """Everything that later steps and resets depend on."""
        return {
            "position": self.position.clone(),
            "goal": self.goal.clone(),
            "steps": self.steps.clone(),
            "generator": self.generator.get_state(),
        }

    def restore(self, snapshot: dict[str, torch.Tensor]) -> None:
        """Return to a snapshot."""
        self.position, self.goal, self.steps = (snapshot[key].clone() for key in ("position", "goal", "steps"))
        self.generator.set_state(snapshot["generator"])


class HiddenGoal(PointReach):
    """The goal is shown at the first step of an episode only."""

    def _observe(self) -> dict[str, torch.Tensor]:
        told = super()._observe()
        seen = (self.steps == 0)[:, None]
        told["observation"] = torch.where(seen, told["observation"], told["observation"] * torch.tensor([1, 1, 0, 0]))
        return told
