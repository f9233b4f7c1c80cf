"""Every state that a few actions can lead the quadruped to, simulated once; policies then learn from memory.

The robot starts from rest, the same every time, and nothing is drawn: an episode is known by its actions. Four of six
actions differ in any state (``gait_search.moves``), so that six actions lead to 5 460 states. PPO visits each some
twenty times; here a visit costs nothing, and observations and rewards are those of the environment.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from softwarp import notices
from softwarp.planning.env_model import EnvModel

from .gait_search import GROUPS, moves

CENTIMETRE = 0.01  # m


@dataclass(frozen=True)
class Memory:
    """States from rest on, which is number 0.

    Attributes:
        observation: Of every state, (state, entry).
        way: Along x from the start [m], (state,).
        after: State that an action leads to, (state, action); -1 from the last ones on.
        actions: Of an episode.
    """

    observation: Tensor
    way: Tensor
    after: Tensor
    actions: int


def remember(model: EnvModel, first: Tensor, actions: int) -> Memory:
    """Simulate all states.

    Args:
        model: Of a MultiGaitReduced or MultiGaitFull with discrete actions, started at rest.
        first: Observation at the start, (entry,).
        actions: Of an episode; 6 make 5 460 states, each more four times as many.
    """
    front, full = np.array([model.root]), np.array([0])
    observations, distances = [first[None].cpu()], [np.array([np.nan])]
    after = np.full((1, 2 * GROUPS), -1)
    begin, known = 0, 1  # number of the first state of the front, and of all
    for depth in range(actions):
        tried = [(k, *move) for k in range(len(front)) for move in moves(int(full[k]))]
        origin, action, following = (np.array(column) for column in zip(*tried, strict=True))
        names = []
        for chosen in np.array_split(np.arange(len(tried)), -(-len(tried) // model.worlds)):
            told = model.step_many(front[origin[chosen]], action[chosen])
            names.append(told.states)
            distances.append(told.distance)
            observations.append(model.pool.observe()["observation"][: len(chosen)].cpu().clone())
            notices.progress("states", f"{known + sum(map(len, names))} after {depth + 1} of {actions} actions")
        numbers = known + np.arange(len(tried))
        after = np.concatenate((after, np.full((len(tried), 2 * GROUPS), -1)))
        after[begin + origin, action] = numbers
        for k, wait in enumerate(range(len(moves(0)) - 1, len(tried), len(moves(0)))):
            row = after[begin + k]
            row[row < 0] = numbers[wait]  # fill what is full, empty what is empty
        front, full, begin, known = np.concatenate(names), following, known, known + len(tried)
    notices.progress_ends()
    distance = np.concatenate(distances)
    distance[0] = distance[len(moves(0))]  # after waiting at rest
    way = torch.as_tensor(distance[0] - distance, dtype=torch.float32)
    return Memory(torch.cat(observations), way, torch.as_tensor(after), actions)


class Remembered(EnvBase):
    """Episodes from memory: centimetres won along x are the reward, and the number of actions is the limit.

    Args:
        memory: States.
        num_worlds: Worlds.
    """

    batch_locked = True

    def __init__(self, memory: Memory, num_worlds: int) -> None:
        super().__init__(device="cpu", batch_size=[num_worlds])
        n = num_worlds
        self.memory, self.num_worlds, self.max_episode_steps = memory, n, memory.actions
        self.state, self.steps = torch.zeros(n, dtype=torch.int64), torch.zeros(n, dtype=torch.int64)
        entries = memory.observation.shape[1]
        info = {"success": Binary(1, (n, 1), dtype=torch.bool), "distance": Unbounded((n, 1))}
        self.observation_spec = Composite(observation=Unbounded((n, entries)), **info, shape=(n,))
        self.action_spec = Categorical(memory.after.shape[1], (n,))
        self.reward_spec = Unbounded((n, 1))
        flags = {key: Binary(1, (n, 1), dtype=torch.bool) for key in ("done", "terminated", "truncated")}
        self.full_done_spec = Composite(**flags, shape=(n,))

    def _observed(self) -> dict[str, Tensor]:
        no = torch.zeros((self.num_worlds, 1), dtype=torch.bool)
        way = self.memory.way[self.state, None]
        return {"observation": self.memory.observation[self.state], "success": no, "distance": -way}

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: Any) -> TensorDictBase:
        mask = torch.ones(self.num_worlds, dtype=torch.bool)
        if tensordict is not None and "_reset" in tensordict:
            mask = tensordict["_reset"].reshape(self.num_worlds)
        self.state = torch.where(mask, 0, self.state)
        self.steps = torch.where(mask, 0, self.steps)
        return TensorDict({**self._observed(), **self._ends(torch.zeros_like(mask))}, self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        before = self.memory.way[self.state]
        self.state = self.memory.after[self.state, tensordict["action"]]
        self.steps = self.steps + 1
        reward = (self.memory.way[self.state] - before)[:, None] / CENTIMETRE
        ends = self._ends(self.steps >= self.max_episode_steps)
        return TensorDict({**self._observed(), "reward": reward, **ends}, self.batch_size)

    def _ends(self, over: Tensor) -> dict[str, Tensor]:
        over = over[:, None]
        return {"done": over, "truncated": over.clone(), "terminated": torch.zeros_like(over)}

    def _set_seed(self, seed: int | None) -> None:
        """Nothing is drawn."""

    def snapshot(self) -> dict[str, Tensor]:
        """Everything that later steps depend on."""
        return {"state": self.state.clone(), "steps": self.steps.clone()}

    def restore(self, snapshot: dict[str, Tensor]) -> None:
        """Return to a snapshot."""
        self.state, self.steps = snapshot["state"].clone(), snapshot["steps"].clone()
