"""Trained policies as functions of an observation: ``softwarp.load_policy("runs/...")``."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from softwarp import checks
from softwarp.policies.policy import Spaces
from softwarp.training import checkpoints

KEY = "observation"


def load_policy(
    run: str | os.PathLike[str], *, device: str = "cpu", deterministic: bool = True, seed: int | None = None
) -> LoadedPolicy:
    """A trained policy, ready to be called.

    Args:
        run: Run folder (its best policy is taken) or checkpoint file.
        device: Where its networks compute.
        deterministic: Choose the most likely action; False draws one.
        seed: Of the draws; None takes one from the operating system.

    Raises:
        CheckpointError: If there is no policy to read.
        ValueError: If an argument is not valid.
    """
    checks.flag(deterministic, "load_policy: deterministic")
    content = checkpoints.load_policy(Path(run))
    policy = checkpoints.build_policy(content).to(device)
    steps = content["steps"] if content["kind"] == "policy" else content["counters"]["steps"]
    return LoadedPolicy(policy, dict(content["config"].get("env", {})), int(steps), deterministic, seed)


class LoadedPolicy(TensorDictModuleBase):
    """A trained policy that takes observations as the environment gives them, one or a batch.

    | called with                                        | returns                                                   |
    |----------------------------------------------------|-----------------------------------------------------------|
    | NumPy array or list (k,) or (n, k)                 | NumPy action (a,) or (n, a); of choices () or (n,), int64 |
    | tensor of these shapes                             | the same as a tensor                                      |
    | mapping with such an ``observation``               | the action, as above                                      |
    | TensorDict with ``observation``, as TorchRL's are  | that TensorDict, ``action`` added                         |

    A recurrent policy remembers what it was shown since ``reset``; a TensorDict carries its memory itself, under
    ``memory``, as TorchRL's rollouts ask for.

    Attributes:
        network: The networks, a ``softwarp.policies.policy.Policy``.
        spaces: Sizes and limits of its observations and actions.
        env: Name and options of the environment it was trained in; ``softwarp.make(**policy.env)`` makes that.
        steps: Environment steps that it was trained for.
    """

    in_keys: ClassVar[list[str]] = [KEY]  # by which TorchRL's rollouts and collectors know a policy
    out_keys: ClassVar[list[str]] = ["action"]

    def __init__(
        self,
        network: Any,
        env: dict[str, Any],
        steps: int = 0,
        deterministic: bool = True,
        seed: int | None = None,
    ) -> None:
        super().__init__()
        self.network, self.env, self.steps, self.deterministic = network, env, steps, deterministic
        self.spaces: Spaces = network.spaces
        self._generator = torch.Generator()
        if seed is None:
            self._generator.seed()
        else:
            self._generator.manual_seed(checks.seed(seed, "load_policy: seed"))
        self._memory: Tensor | None = None

    def __repr__(self) -> str:
        return f"LoadedPolicy({self.env.get('name', 'unknown environment')}, {self.spaces}, {self.steps} steps)"

    @property
    def is_recurrent(self) -> bool:
        """Whether it remembers; then ``reset`` has to be told of every new episode."""
        return self.network.memory is not None

    def reset(self, mask: Any = None) -> None:
        """Forget what was shown, in all rows or where ``mask``, bool (n,), holds: episodes begin there."""
        if mask is None or self._memory is None:
            self._memory = None
            return
        chosen = torch.as_tensor(mask, dtype=torch.bool)
        if chosen.shape != self._memory.shape[:1]:
            raise ValueError(checks.refusal("reset: mask", f"be bool of shape ({len(self._memory)},)", mask))
        self._memory = self._memory * ~chosen[:, None].to(self._memory.device)

    @torch.no_grad()
    def forward(self, observation: Any) -> Any:
        """The action for an observation.

        Raises:
            ValueError: If it has another size than the policy was trained with, is not finite, or comes in another
                number of rows than a memory has.
        """
        if isinstance(observation, TensorDictBase):
            with self._seeded(), set_exploration_type(self._exploration):
                return self.network(observation)
        if isinstance(observation, Mapping):
            if KEY not in observation:
                raise ValueError(f"policy: needs {KEY!r}, got {', '.join(map(str, observation))}")
            observation = observation[KEY]
        action = self._act(self._rows(observation))
        action = action if np.ndim(observation) > 1 else action[0]
        return action if isinstance(observation, Tensor) else action.cpu().numpy()

    @property
    def _exploration(self) -> ExplorationType:
        return ExplorationType.DETERMINISTIC if self.deterministic else ExplorationType.RANDOM

    def _rows(self, observation: Any) -> Tensor:
        """Observations as rows on the policy's device, (n, k) float32."""
        size = self.spaces.observation_size
        told = observation if isinstance(observation, Tensor) else np.asarray(observation)
        if told.ndim not in (1, 2) or told.shape[-1] != size:
            need = f"have shape ({size},) or (n, {size})"
            raise ValueError(checks.refusal("policy: observation", need, tuple(told.shape)))
        rows = torch.as_tensor(told, dtype=torch.float32, device=self.network.low.device).reshape(-1, size)
        if not bool(torch.isfinite(rows).all()):
            row, entry = (int(i) for i in torch.nonzero(~torch.isfinite(rows))[0])
            raise ValueError(f"policy: observation must be finite; row {row} has {rows[row, entry]:g} at {entry}")
        return rows

    def _act(self, rows: Tensor) -> Tensor:
        if self._memory is not None and len(self._memory) != len(rows):
            raise ValueError(f"policy: remembers {len(self._memory)} rows, got {len(rows)}; call reset() first")
        features, memory = self.network.features(rows, self._memory)
        self._memory = memory if self.is_recurrent else None
        with self._seeded():
            sample = self.network.greedy(features) if self.deterministic else self.network.head(features).sample()
        action: Tensor = self.network.to_env(sample)
        return action

    @contextmanager
    def _seeded(self) -> Iterator[None]:
        """Draws of Torch come from this policy's own seed meanwhile, and go on as before after it."""
        if self.deterministic:
            yield
            return
        device = self.network.low.device
        with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
            torch.manual_seed(int(torch.randint(2**62, (), generator=self._generator)))
            yield
