"""Rollouts written straight into preallocated tensors, with automatic reset of finished worlds.

A rollout of T steps in B worlds is one TensorDict of shape (B, T) over storage laid out (T, B, ...): each step writes
one contiguous row. The observation stored under ``next`` is the one the step led to, before any reset, so that a value
can be bootstrapped from it; the next row starts from the observation after the reset. ``memory`` is that of a recurrent
policy before the step (cleared where an episode begins), under ``next`` the one after it.

A ``SoftEnv`` takes a step and the resets after it in one call, and nothing is read back before the end of a rollout: a
GPU always has its next step to do.
"""

from collections import deque
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import step_mdp

from softwarp import interop
from softwarp.envs.base import SoftEnv
from softwarp.envs.snapshot import EnvSnapshot
from softwarp.model.codes import Status
from softwarp.model.memory import require
from softwarp.policies.normalization import RunningNormalizer
from softwarp.policies.policy import Policy
from softwarp.training.ranks import ALONE, Ranks

EPISODE_FIELDS = ("return", "length", "success", "distance")  # distance [m]; NaN where the environment has none
REWARD_FLOOR = 1e-4  # smallest standard deviation of discounted returns that rewards are divided by

Pulse = Callable[[], None]  # called between two steps; what it raises leaves the work at a place to go on from


def nothing() -> None:
    """A pulse that nobody feels."""


Explore = Callable[[Tensor], dict[str, Tensor]]  # features to ``action`` in the policy's units, and more


class Rollout:
    """Runs a policy in all worlds of an environment and remembers where each world is in its episode."""

    def __init__(
        self,
        env: Any,
        policy: Policy,
        horizon: int,
        *,
        gamma: float = 0.99,
        stagger: bool = True,
        ranks: Ranks = ALONE,
    ) -> None:
        """Reset all worlds and allocate.

        Args:
            env: TorchRL environment of batch size (B,).
            policy: Draws the actions.
            horizon: Steps per world and rollout, T.
            gamma: Discount of the returns whose spread is the scale of rewards.
            stagger: Cut the first episode of each world at a random length, so that resets are spread over time and
                a rollout sees all phases of an episode.
            ranks: That have as many worlds each; steps, the scale of rewards and statistics are those of all.
        """
        self.env, self.policy, self.horizon, self.gamma = env, policy, horizon, gamma
        self.device = torch.device(env.device or "cpu")
        (self.worlds,) = env.batch_size
        self.ranks = ranks
        self.step_count = torch.zeros(self.worlds, dtype=torch.int64, device=self.device)
        self.step_limit = torch.full((self.worlds,), torch.iinfo(torch.int64).max, device=self.device)
        limit = getattr(env, "max_episode_steps", None)
        if stagger and limit:
            self.step_limit = torch.randint(1, limit + 1, (self.worlds,)).to(self.device)
        self.is_cut = self.step_limit < (limit or 0)  # this world's episode will end early: left out of the statistics
        self.running_return = torch.zeros(self.worlds, device=self.device)
        self.discounted = torch.zeros(self.worlds, device=self.device)  # sum of rewards, those long past discounted
        self.return_norm = RunningNormalizer(1).to(self.device)
        self.memory = policy.start(self.worlds)
        self.steps = 0  # taken so far, summed over worlds and ranks; those of whole rollouts
        self.taken = 0  # steps of the present rollout in each world
        self.failures = torch.zeros((), dtype=torch.int64, device=self.device)  # worlds that failed so far
        self.pulse: Pulse = nothing
        self.episodes: deque[tuple[float, ...]] = deque(maxlen=100)  # of the last episodes, as EPISODE_FIELDS
        self.now: TensorDictBase = env.reset()
        self.buffer = self._allocate()
        self._returns = torch.zeros((horizon, self.worlds), device=self.device)
        self._ended = torch.zeros((horizon, self.worlds), dtype=torch.bool, device=self.device)
        self._ends = torch.zeros(
            (horizon, self.worlds, len(EPISODE_FIELDS)), device=self.device
        )  # where episodes ended

    @torch.no_grad()
    def _allocate(self) -> TensorDict:
        """Storage (T, B, ...) of one rollout; MemoryError if it does not fit on the device."""
        shape = (self.horizon, self.worlds)
        observation = self.now["observation"]
        features, _ = self.policy.features(observation, self.memory)
        rows = {"observation": observation, **self.policy.explore(features)}
        flags = torch.zeros((self.worlds, 1), dtype=torch.bool, device=self.device)
        after = {"observation": observation, "reward": observation[..., :1], "terminated": flags, "done": flags}
        if self.policy.memory is not None:
            rows["memory"] = after["memory"] = self.memory
        ends = self.worlds * (5 + 4 * len(EPISODE_FIELDS))  # bytes of what is noted of episodes
        needed = self.horizon * (ends + sum(part.nbytes for part in (*rows.values(), *after.values())))
        require(needed, self.device, "a rollout", self.horizon, "steps of every world", interop.empty_cache)

        def storage(parts: dict[str, Tensor]) -> dict[str, Tensor]:
            return {key: part.new_zeros((self.horizon, *part.shape)) for key, part in parts.items()}

        return TensorDict({**storage(rows), "next": TensorDict(storage(after), shape)}, shape)

    @torch.no_grad()
    def collect(self, explore: Explore | None = None) -> TensorDictBase:
        """Run T steps; the returned TensorDict (B, T) is overwritten by the next call.

        After every step ``pulse`` is called. If it raises, the next call goes on from there.

        Args:
            explore: Draws actions instead of the policy.
        """
        explore = explore or self.policy.explore
        for t in range(self.taken, self.horizon):
            row = self.buffer[t]
            features, memory = self.policy.features(self.now["observation"], self.memory)
            sample = explore(features)
            row["observation"].copy_(self.now["observation"])
            for key, part in sample.items():
                row[key].copy_(part)

            after, now = self._advance(self.policy.to_env(sample["action"]))
            if self.policy.memory is not None:
                row["memory"].copy_(self.memory)
                row["next", "memory"].copy_(memory)
            self.discounted.mul_(self.gamma).add_(after["reward"].squeeze(-1))
            self._returns[t] = self.discounted
            self._end_episodes(t, after)
            self.memory = memory * ~after["done"]
            for key in ("observation", "reward", "terminated", "done"):
                row["next"][key].copy_(after[key])
            self.now = now
            self.taken = t + 1
            self.pulse()
        self.taken = 0
        self.episodes.extend(tuple(episode) for episode in self._ends[self._ended].tolist())
        if isinstance(self.env, SoftEnv):
            self.env.raise_refused_actions()
        self.return_norm.update(self._returns, self.ranks.gather)
        self.steps += self.horizon * self.worlds * self.ranks.size
        return self.buffer.transpose(0, 1)

    @property
    def steps_begun(self) -> int:
        """Steps of the present rollout, summed over worlds and ranks."""
        begun: int = self.taken * self.worlds * self.ranks.size
        return begun

    @property
    def reward_scale(self) -> Tensor:
        """One over the standard deviation of discounted returns seen so far."""
        spread: Tensor = self.return_norm.var.sqrt().clamp_min(REWARD_FLOOR).float()
        return 1.0 / spread

    def _advance(self, action: Tensor) -> tuple[TensorDictBase, TensorDictBase]:
        """Step, cut staggered episodes (as truncated), reset what ended.

        Returns:
            Where the step led, and what the next step starts from.
        """
        cut = self.step_count + 1 >= self.step_limit
        if isinstance(self.env, SoftEnv):
            return self.env.step_and_reset(action, cut)
        stepped = self.env.step(self.now.set("action", action))
        after = stepped["next"]
        after["truncated"] = after["truncated"] | (cut.unsqueeze(-1) & ~after["done"])
        after["done"] = after["done"] | cut.unsqueeze(-1)
        return after, self.env.maybe_reset(step_mdp(stepped))

    def _end_episodes(self, t: int, after: TensorDictBase) -> None:
        """Note the episodes that ended with step ``t`` and count from 0 in their worlds."""
        self.step_count += 1
        self.running_return += after["reward"].squeeze(-1)
        done = after["done"].squeeze(-1)
        if "world_status" in after:
            self.failures += (after["world_status"] >= Status.NONFINITE).sum()
        missing = torch.full((self.worlds, 1), torch.nan, device=self.device)
        columns = (self.running_return, self.step_count, after.get("success", missing), after.get("distance", missing))
        torch.stack([column.reshape(-1).float() for column in columns], dim=-1, out=self._ends[t])
        torch.logical_and(done, ~self.is_cut, out=self._ended[t])
        for counter in (self.step_count, self.running_return, self.discounted):
            counter.masked_fill_(done, 0)
        self.step_limit.masked_fill_(done, torch.iinfo(torch.int64).max)
        self.is_cut.masked_fill_(done, False)

    def statistics(self) -> dict[str, float]:
        """Mean return, length and success rate and the median final distance [m] of each rank's last 100 episodes."""
        table = torch.full((self.episodes.maxlen or 0, 1 + len(EPISODE_FIELDS)), -1.0, dtype=torch.float64)
        if self.episodes:
            table[: len(self.episodes)] = torch.tensor([(1.0, *episode) for episode in self.episodes]).double()
        rows = self.ranks.gather(table).flatten(0, 1)
        rows = rows[rows[:, 0] > 0.0, 1:]
        if not len(rows):
            return {}
        columns = rows.unbind(-1)
        named = dict(zip(EPISODE_FIELDS, columns, strict=True))
        result = {key: float(named[key].mean()) for key in ("return", "length", "success")}
        result["distance"] = float(named["distance"].quantile(0.5))
        return {key: number for key, number in result.items() if number == number}

    def state_dict(self) -> dict[str, Any]:
        """All that is needed to continue, the environment's own state included."""
        tensors = ("step_count", "step_limit", "is_cut", "running_return", "discounted", "memory")
        return {
            "env": pack_snapshot(self.env.snapshot()),
            "now": self.now.clone().to_dict(),
            **{name: getattr(self, name).clone() for name in tensors},
            "return_norm": self.return_norm.state_dict(),
            "steps": self.steps,
            "episodes": [list(episode) for episode in self.episodes],
            "begun": self._begun(),
        }

    def _begun(self) -> dict[str, Any]:
        """What there is of the present rollout; empty between two of them."""
        if self.taken == 0:
            return {}
        rows = slice(self.taken)
        parts = {name: getattr(self, f"_{name}")[rows].clone() for name in ("returns", "ended", "ends")}
        return {"buffer": self.buffer[rows].clone().to_dict(), **parts}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where :meth:`state_dict` was taken."""
        self.env.restore(unpack_snapshot(state["env"]))
        self.now = TensorDict(state["now"], self.env.batch_size, device=self.device)
        for name in ("step_count", "step_limit", "is_cut", "running_return", "discounted", "memory"):
            getattr(self, name).copy_(state[name])
        self.return_norm.load_state_dict(state["return_norm"])
        self.steps = state["steps"]
        self.episodes = deque((tuple(episode) for episode in state["episodes"]), maxlen=100)
        begun = state.get("begun")  # in files of versions before, which stopped between rollouts, there is none
        self.taken = len(begun["returns"]) if begun else 0
        if begun:
            rows = slice(self.taken)
            self.buffer[rows].update_(TensorDict(begun["buffer"], (self.taken, self.worlds), device=self.device))
            for name in ("returns", "ended", "ends"):
                getattr(self, f"_{name}")[rows].copy_(begun[name])


def pack_snapshot(snapshot: Any) -> dict[str, Any]:
    """An environment's snapshot as plain values and tensors; one that is plain already stays as it is."""
    return snapshot.state_dict() if isinstance(snapshot, EnvSnapshot) else dict(snapshot)


def unpack_snapshot(packed: dict[str, Any]) -> Any:
    """Undo :func:`pack_snapshot`."""
    if packed.keys() == {"env", "sim", "tensors"}:
        return EnvSnapshot.from_state_dict(packed)
    return packed
