"""Transitions for offline learning, and Minari's data sets. Minari itself is the extra ``minari``.

A data set holds what was done and what came of it; its observations are those of ``gymnasium.make``. Demonstrations
hold what a demonstrator would have done, and no rewards but their sum.
"""

import copy
import json
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from softwarp import checks
from softwarp.envs import registry
from softwarp.policies.baselines.scripted import random
from softwarp.policies.policy import Spaces
from softwarp.training.demonstrations import DemonstrationError, Demonstrations

_ENV = "softwarp"  # key of the environment's name and options in an episode's options


@dataclass(frozen=True)
class Transitions:
    """Steps of whole episodes, one row each, episodes one after the other."""

    observation: Tensor  # (step, k) float32, before the action
    action: Tensor  # (step, a) float32 or (step,) int64, as carried out
    reward: Tensor  # (step,) float32
    after: Tensor  # (step, k) float32, observation after the action
    terminated: Tensor  # (step,) bool
    truncated: Tensor  # (step,) bool
    success: Tensor  # (step,) bool, after the action
    distance: Tensor  # (step,) m, after the action; NaN where the environment measures none
    episode: Tensor  # (step,) int64, number of the episode
    env: dict[str, Any]  # name and options

    def __len__(self) -> int:
        return len(self.observation)

    def tensordict(self) -> TensorDict:
        """The rows as TorchRL's losses and replay buffers take them, batch size (step,)."""
        flags = {"terminated": self.terminated[:, None], "truncated": self.truncated[:, None]}
        flags["done"] = flags["terminated"] | flags["truncated"]
        after = {"observation": self.after, "reward": self.reward[:, None], **flags}
        return TensorDict({"observation": self.observation, "action": self.action, "next": after}, [len(self)])

    def demonstrations(self) -> Demonstrations:
        """The same episodes as demonstrations; the demonstrator's actions are taken to be those carried out."""
        _, counts = self.episode.unique_consecutive(return_counts=True)
        lasts = counts.cumsum(0) - 1
        number = torch.repeat_interleave(torch.arange(len(counts)), counts)
        returns = torch.zeros(len(counts)).index_add_(0, number, self.reward)
        outcome = (returns, self.success[lasts], self.distance[lasts])
        return Demonstrations(self.observation, self.action, number, *outcome, env=self.env)

    @classmethod
    def of(cls, shown: Demonstrations) -> "Transitions":
        """Demonstrations as far as they go: an episode's return stands at its last step, whose end is a truncation."""
        is_last = torch.cat((shown.episode[1:] != shown.episode[:-1], torch.tensor([True])))
        after = torch.where(is_last[:, None], shown.observation, shown.observation.roll(-1, dims=0))
        _, number = shown.episode.unique_consecutive(return_inverse=True)
        no = torch.zeros_like(is_last)
        reward = torch.where(is_last, shown.returns[number].float(), 0.0)
        distance = torch.where(is_last, shown.distance[number].float(), torch.nan)
        flags = (no, is_last, is_last & shown.success[number])
        return cls(shown.observation, shown.action, reward, after, *flags, distance, shown.episode, shown.env)


def record_transitions(
    env: Any,
    policy: Callable[[TensorDictBase], TensorDictBase],
    *,
    episodes: int,
    seed: int,
    noise: float = 0.0,
    settings: dict[str, Any] | None = None,
) -> Transitions:
    """Run whole episodes and keep what was done and what came of it.

    Args:
        env: TorchRL environment of batch size (world,) with ``max_episode_steps``.
        policy: Reads ``observation``, writes ``action``.
        episodes: How many.
        seed: Of starts, goals and noise.
        noise: Part of the steps at which a random action is carried out instead, so that data cover more.
        settings: Name and options of the environment.
    """
    at_random = random(Spaces.of(env), seed + 1)
    generator = torch.Generator().manual_seed(seed)
    (worlds,) = env.batch_size

    def straying(tensordict: TensorDictBase) -> TensorDictBase:
        action = policy(tensordict)["action"]
        strays = (torch.rand(worlds, generator=generator) < noise).to(action.device)
        stray = at_random(tensordict.select("observation"))["action"]
        return tensordict.set("action", torch.where(strays.reshape(-1, *[1] * (action.ndim - 1)), stray, action))

    kept = []
    for batch in range(-(-episodes // worlds)):
        env.set_seed(seed + batch)
        with torch.no_grad():
            rows = env.rollout(env.max_episode_steps, straying, break_when_any_done=False).cpu()
        done = rows["next", "done"].squeeze(-1).long()
        lasts = done.cumsum(dim=1) - done == 0  # up to the first end, (world, step)
        number = torch.arange(worlds)[:, None].expand_as(lasts) + batch * worlds
        lasts &= number < episodes
        kept.append(_rows(rows[lasts]) | {"episode": number[lasts]})
    joined = {key: torch.cat([part[key] for part in kept]) for key in kept[0]}
    return Transitions(**joined, env=settings or {})


def _rows(rows: TensorDictBase) -> dict[str, Tensor]:
    after = rows["next"]
    found = {"observation": rows["observation"], "action": rows["action"], "after": after["observation"]}
    for name in ("reward", "terminated", "truncated", "success", "distance"):
        found[name] = after[name].reshape(len(rows))
    return found


def to_minari(data: Transitions | Demonstrations, name: str, *, description: str | None = None) -> Any:
    """Write a Minari data set; Minari keeps those in its own folder, ``MINARI_DATASETS_PATH`` or the user's.

    Args:
        data: Episodes; demonstrations are taken as ``Transitions.of`` does.
        name: Minari's, for example ``softwarp/trunk/scripted-v0``.
        description: In words.

    Returns:
        The data set, a ``minari.MinariDataset``, from which ``recover_environment`` makes the environment again.

    Raises:
        ImportError: If Minari is not installed.
        ValueError: If Minari refuses the name, or holds one of this name.
    """
    minari = _minari()
    from minari.data_collector import EpisodeBuffer

    held = Transitions.of(data) if isinstance(data, Demonstrations) else data
    buffers = []
    _, counts = held.episode.unique_consecutive(return_counts=True)
    parts = {key: value.split(counts.tolist()) for key, value in vars(held).items() if isinstance(value, Tensor)}
    for i in range(len(counts)):
        part = {key: value[i].numpy() for key, value in parts.items()}
        buffers.append(
            EpisodeBuffer(
                id=i,
                options={_ENV: json.dumps(held.env)},
                observations=np.concatenate((part["observation"], part["after"][-1:])),
                actions=part["action"],
                rewards=part["reward"].tolist(),
                terminations=part["terminated"].tolist(),
                truncations=part["truncated"].tolist(),
                infos={key: np.concatenate((part[key][:1], part[key])) for key in ("success", "distance")},
            )
        )
    spec = _gymnasium_spec(held.env)
    about = {"env": spec, "eval_env": spec, "description": description, "requirements": ["softwarp"]}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that no author is named, who is to name himself
        return minari.create_dataset_from_buffers(name, buffers, **about)


def from_minari(name: str) -> Transitions:
    """Read a Minari data set of one of softwarp's environments.

    Raises:
        DemonstrationError: If there is none of this name here, or it is of another environment.
        ImportError: If Minari is not installed.
    """
    minari = _minari()
    try:
        dataset = minari.load_dataset(name)
    except (FileNotFoundError, OSError, ValueError) as error:
        raise DemonstrationError(f"data set {name}: Minari does not have it here ({error})") from error
    spec = dataset.spec.env_spec
    if spec is None or not spec.id.startswith("softwarp/"):
        raise DemonstrationError(f"data set {name}: recorded in {spec and spec.id}, which is none of softwarp's")
    columns: dict[str, list[Any]] = {}
    for number, episode in enumerate(dataset.iterate_episodes()):
        infos = episode.infos or {}
        steps = len(episode.rewards)
        row = {"observation": episode.observations[:-1], "after": episode.observations[1:], "action": episode.actions}
        row |= {"reward": np.asarray(episode.rewards, dtype=np.float32), "episode": np.full(steps, number)}
        row |= {"terminated": episode.terminations, "truncated": episode.truncations}
        row["success"] = infos.get("success", np.zeros(steps + 1, dtype=bool))[1:]
        row["distance"] = infos.get("distance", np.full(steps + 1, np.nan))[1:]
        for key, value in row.items():
            columns.setdefault(key, []).append(np.asarray(value))
    joined = {key: torch.from_numpy(np.concatenate(value)) for key, value in columns.items()}
    return Transitions(**joined, env={key: value for key, value in spec.kwargs.items() if key != "render_mode"})


def _gymnasium_spec(env: dict[str, Any]) -> Any:
    """Gymnasium's spec that makes the environment with its options."""
    import gymnasium

    import softwarp.gym  # noqa: F401 - registers the ids

    checks.choice(env.get("name", ""), "data set: environment", registry.names())
    spec = copy.deepcopy(gymnasium.spec(registry.spec(env["name"]).gym_id))
    spec.kwargs |= env
    spec.max_episode_steps = env.get("max_episode_steps", spec.max_episode_steps)
    return spec


def _minari() -> Any:
    try:
        import minari
    except ImportError as error:
        raise ImportError("data sets of Minari need the extra minari: pip install 'softwarp[minari]'") from error
    return minari
