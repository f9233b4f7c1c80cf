"""Demonstrations: what a policy saw and did, recorded in whole episodes and kept in a NumPy archive.

File (.npz)     format text; env text, JSON of name and options; observation (step, k) float32;
                action (step, k) float32 or (step,) int64, as the environment takes it; episode (step,) int64;
                returns, success and final distance of each episode, (episode,)
"""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from softwarp.io.atomic import atomic_path
from softwarp.io.bounded import DamagedFileError, parse_json, read_arrays
from softwarp.policies.baselines.scripted import random
from softwarp.policies.policy import Spaces
from softwarp.training.evaluation import Episodes, run_episodes

FORMAT = "softwarp demonstrations 1"
SAME = ("name", "observation", "action_kind")  # of the environment: what gives observations and actions their meaning
_OUTCOMES = ("returns", "success", "distance")


class DemonstrationError(ValueError):
    """A file that holds no demonstrations, or ones that do not fit."""


@dataclass(frozen=True)
class Demonstrations:
    """Steps of whole episodes, one row each."""

    observation: Tensor  # (step, k) float32
    action: Tensor  # (step, k) float32 or (step,) int64, as the environment takes it
    episode: Tensor  # (step,) int64, number of the episode
    returns: Tensor  # (episode,)
    success: Tensor  # (episode,) bool, at the last step
    distance: Tensor  # (episode,) m, at the last step; NaN where the environment measures none
    env: dict[str, Any]  # name and options

    def __len__(self) -> int:
        return len(self.observation)

    def extended(self, more: "Demonstrations") -> "Demonstrations":
        """These and then those of ``more``, whose episodes get the numbers that follow."""

        def both(name: str) -> Tensor:
            return torch.cat([getattr(self, name), getattr(more, name)])

        joined: dict[str, Any] = {name: both(name) for name in ("observation", "action", *_OUTCOMES)}
        joined["episode"] = torch.cat([self.episode, more.episode + len(self.returns)])
        return replace(self, **joined)

    def save(self, path: Path) -> None:
        """Write the archive."""
        arrays: dict[str, Any] = {key: value.numpy() for key, value in vars(self).items() if isinstance(value, Tensor)}
        arrays |= {"format": np.array(FORMAT), "env": np.array(json.dumps(self.env))}
        with atomic_path(path) as scratch, scratch.open("wb") as file:
            np.savez_compressed(file, **arrays)

    @classmethod
    def load(cls, path: Path) -> "Demonstrations":
        """Read an archive.

        Raises:
            DemonstrationError: If the file is missing or holds something else.
        """
        if not path.is_file():
            raise DemonstrationError(f"demonstrations {path}: no such file; softwarp record makes one")
        try:
            held = read_arrays(path)
        except DamagedFileError as error:
            raise DemonstrationError(f"demonstrations {path}: not an archive of arrays ({error})") from error
        if str(held.pop("format", "")) != FORMAT:
            raise DemonstrationError(f"demonstrations {path}: not written by softwarp record")
        try:
            env = parse_json(str(held.pop("env", "")))
        except DamagedFileError:
            env = None
        if not isinstance(env, dict):
            raise DemonstrationError(f"demonstrations {path}: they do not tell of which environment; record them anew")
        _check_arrays(path, held)
        return cls(env=env, **{key: torch.from_numpy(value) for key, value in held.items()})

    def check_env(self, settings: dict[str, Any]) -> None:
        """Raise DemonstrationError unless they are of the environment with these settings; its physics may differ."""
        for key in SAME:
            held, wanted = self.env.get(key), settings.get(key)
            if None not in (held, wanted) and held != wanted:
                raise DemonstrationError(
                    f"demonstrations: recorded with {key}={held}, which does not fit {key}={wanted}; record them with "
                    "the same environment"
                )

    def check_fit(self, spaces: Spaces) -> None:
        """Raise DemonstrationError unless observations and actions are of these spaces."""
        size = self.observation.shape[-1]
        is_choice = self.action.ndim == 1 or self.action.dtype == torch.int64
        if size != spaces.observation_size or is_choice != spaces.is_discrete:
            kind = "choices" if is_choice else "vectors"
            raise DemonstrationError(
                f"demonstrations of {self.env.get('name')}: {size} numbers per observation and actions that are {kind} "
                f"do not fit {spaces}; record them with the same options of the environment"
            )


def _check_arrays(path: Path, held: dict[str, np.ndarray]) -> None:
    """Raise DemonstrationError unless the arrays are those of ``Demonstrations``, of one length, and finite."""
    wanted = ("observation", "action", "episode", *_OUTCOMES)
    wrong = set(wanted) ^ set(held)
    if wrong:
        what = "lack" if wrong & set(wanted) else "hold besides"
        raise DemonstrationError(f"demonstrations {path}: they {what} {', '.join(sorted(wrong))}; record them anew")
    steps, episodes = len(np.atleast_1d(held["observation"])), len(np.atleast_1d(held["returns"]))
    for name, array in held.items():
        count, axes = (episodes if name in _OUTCOMES else steps), {"observation": (2,), "action": (1, 2)}
        if array.ndim not in axes.get(name, (1,)) or len(array) != count or array.dtype.kind not in "fiub":
            raise DemonstrationError(
                f"demonstrations {path}: {name} must be numbers with {count} rows, got {array.dtype} {array.shape}"
            )
        if name != "distance" and not np.isfinite(array).all():
            row = int(np.argwhere(~np.isfinite(array))[0][0])
            raise DemonstrationError(f"demonstrations {path}: {name} is not finite in row {row}; record them anew")


def record(
    env: Any,
    policy: Callable[[TensorDictBase], TensorDictBase],
    *,
    episodes: int,
    seed: int,
    noise: float = 0.0,
    settings: dict[str, Any] | None = None,
    actor: Callable[[TensorDictBase], TensorDictBase] | None = None,
) -> Demonstrations:
    """Run whole episodes and keep what the policy saw and would do.

    Args:
        env: TorchRL environment of batch size (world,).
        policy: The demonstrator: reads ``observation``, writes ``action``.
        episodes: How many.
        seed: Of starts, goals and noise.
        noise: Part of the steps at which a random action is carried out instead; what is kept is the demonstrator's,
            so that a learner also sees how to come back.
        settings: Name and options of the environment, kept in the file.
        actor: Policy whose actions are carried out, if not the demonstrator's: it is shown what to do where it gets.
    """
    at_random = random(Spaces.of(env), seed + 1)  # from other numbers than those that choose when to stray
    generator = torch.Generator().manual_seed(seed)
    rows: list[tuple[Tensor, Tensor, Tensor]] = []
    batches: list[Episodes] = []

    def watched(tensordict: TensorDictBase) -> TensorDictBase:
        observation = tensordict["observation"].clone()
        action = policy(tensordict.copy())["action"].clone()
        carried_out = action if actor is None else actor(tensordict)["action"]
        strays = torch.rand(observation.shape[0], generator=generator).to(observation.device) < noise
        stray = at_random(tensordict.select("observation"))["action"]
        carried_out = torch.where(strays.reshape(-1, *[1] * (action.ndim - 1)), stray, carried_out)
        rows.append((observation.cpu(), action.cpu(), torch.arange(len(action))))
        return tensordict.set("action", carried_out)

    (worlds,) = env.batch_size
    kept = []
    for batch in range(-(-episodes // worlds)):
        rows.clear()
        batches.append(run_episodes(env, watched, seed=seed + batch))
        observation, action, world = (torch.stack(column) for column in zip(*rows, strict=True))  # (T, world, ...)
        lasts = torch.arange(len(world))[:, None] < batches[-1].lengths
        kept.append((observation[lasts], action[lasts], (world + batch * worlds)[lasts]))
    observation, action, episode = (torch.cat(column) for column in zip(*kept, strict=True))
    order = episode.argsort(stable=True)  # episodes one after the other, steps in their order
    order = order[episode[order] < episodes]
    outcomes = {name: torch.cat([getattr(batch, name) for batch in batches])[:episodes] for name in _OUTCOMES}
    return Demonstrations(observation[order], action[order], episode[order], **outcomes, env=settings or {})
