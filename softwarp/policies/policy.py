"""What all trained policies share: spaces, network settings, observation scaling, memory and how they act.

Observations        scaled by running statistics (``observation_norm``) that are saved with the networks.
Features            what actor and critic see: the scaled observation and, with ``recurrent`` units, an LSTM's output;
                    where they share their hidden layers, what these make of it.
Memory              (h, c) of the LSTM side by side, shape (..., 2 * recurrent); zeros at the start of an episode.
"""

import math
from abc import abstractmethod
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.distributions import Distribution
from torchrl.envs.utils import ExplorationType, exploration_type

from softwarp.policies.normalization import RunningNormalizer
from softwarp.policies.options import NetworkConfig as NetworkConfig

ACTIVATIONS: dict[str, type[nn.Module]] = {"elu": nn.ELU, "relu": nn.ReLU, "silu": nn.SiLU, "tanh": nn.Tanh}


@dataclass(frozen=True)
class Spaces:
    """What a policy must know of an environment: sizes and limits of one world's observation and action."""

    observation_size: int
    action_size: int  # numbers of a continuous action, or choices of a discrete one
    low: tuple[float, ...] = ()  # limits of a continuous action; empty: the action is discrete
    high: tuple[float, ...] = ()
    is_one_hot: bool = False  # a discrete action is a row of zeros and a one instead of an index

    @property
    def is_discrete(self) -> bool:
        """Whether an action is one choice out of ``action_size``."""
        return not self.low

    @classmethod
    def of(cls, env: Any) -> "Spaces":
        """Read the spaces of a TorchRL environment with keys ``observation`` and ``action``.

        Raises:
            ValueError: If an action is neither a bounded vector nor a single choice.
        """
        from torchrl.data import Bounded, OneHot
        from torchrl.data import Categorical as Choice

        observation_size = env.observation_spec["observation"].shape[-1]
        spec = env.action_spec_unbatched
        if isinstance(spec, OneHot):
            return cls(observation_size, spec.shape[-1], is_one_hot=True)
        if isinstance(spec, Choice) and spec.shape == torch.Size([]):
            return cls(observation_size, spec.n)
        if isinstance(spec, Bounded) and len(spec.shape) == 1:
            low, high = spec.space.low.tolist(), spec.space.high.tolist()
            if all(math.isfinite(limit) for limit in (*low, *high)):
                return cls(observation_size, spec.shape[0], tuple(low), tuple(high))
        raise ValueError(f"action spec {spec}: must be a Bounded vector with finite limits or one choice")


def mlp(sizes: list[int], activation: type[nn.Module], last_gain: float) -> nn.Sequential:
    """Fully connected layers with orthogonal weights, gain sqrt(2) inside and ``last_gain`` at the end."""
    layers: list[nn.Module] = []
    for i, (inputs, outputs) in enumerate(pairwise(sizes)):
        is_last = i == len(sizes) - 2
        linear = nn.Linear(inputs, outputs)
        nn.init.orthogonal_(linear.weight, last_gain if is_last else math.sqrt(2.0))
        nn.init.zeros_(linear.bias)
        layers += [linear] if is_last else [linear, activation()]
    return nn.Sequential(*layers)


class Memory(nn.Module):
    """An LSTM that is told where episodes begin."""

    def __init__(self, inputs: int, units: int) -> None:
        super().__init__()
        self.cell = nn.LSTMCell(inputs, units)

    def forward(self, inputs: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """One step: output (..., units) and the new memory (..., 2 * units)."""
        h, c = memory.flatten(0, -2).chunk(2, dim=-1)
        h, c = self.cell(inputs.flatten(0, -2), (h, c))
        batch = inputs.shape[:-1]
        return h.unflatten(0, batch), torch.cat((h, c), dim=-1).unflatten(0, batch)

    def run(self, inputs: Tensor, memory: Tensor, is_first: Tensor | None = None) -> Tensor:
        """Outputs (B, T, units) along sequences.

        Args:
            inputs: Shape (B, T, size).
            memory: Before the first step, shape (B, 2 * units).
            is_first: Where an episode begins and memory is cleared, bool (B, T); None: nowhere, which is much faster.
        """
        if is_first is None:
            begin = [part.unsqueeze(0).contiguous() for part in memory.chunk(2, dim=-1)]
            cell = self.cell
            weights = [cell.weight_ih, cell.weight_hh, cell.bias_ih, cell.bias_hh]
            whole: Tensor = torch.lstm(inputs, begin, weights, True, 1, 0.0, self.training, False, True)[0]
            return whole
        outputs = []
        for now, begins in zip(inputs.unbind(1), is_first.unbind(1), strict=True):
            output, memory = self(now, memory * ~begins.unsqueeze(-1))
            outputs.append(output)
        return torch.stack(outputs, dim=1)


class Policy(TensorDictModuleBase):
    """A policy for one pair of spaces; ``head`` and its networks are the subclass's.

    ``actor`` is a TensorDict module on *features*, as TorchRL's losses take it. ``act``, ``distribution`` and the call
    itself take observations as the environment gives them.
    """

    kind: ClassVar[str]  # by which a checkpoint names the class
    in_keys: ClassVar[list[str]] = ["observation"]  # by which TorchRL's collectors know a policy
    out_keys: ClassVar[list[str]] = ["action"]
    actor: Any
    low: Tensor
    high: Tensor

    def __init__(self, spaces: Spaces, config: NetworkConfig) -> None:
        super().__init__()
        self.spaces = spaces
        self.config = config
        self.observation_norm = RunningNormalizer(spaces.observation_size)
        self.register_buffer("low", torch.tensor(spaces.low), persistent=False)
        self.register_buffer("high", torch.tensor(spaces.high), persistent=False)
        self.memory = Memory(spaces.observation_size, config.recurrent) if config.recurrent else None
        self.shared: nn.Module | None = None  # layers that actor and critic have in common

    @property
    def feature_size(self) -> int:
        """Numbers that actor and critic see."""
        return self.config.hidden[-1] if self.config.shared else self.seen_size

    @property
    def seen_size(self) -> int:
        """Numbers of the scaled observation and the memory's output."""
        return self.spaces.observation_size + self.config.recurrent

    @abstractmethod
    def head(self, features: Tensor) -> Distribution:
        """Distribution of the sample that ``to_env`` turns into an action."""

    @abstractmethod
    def greedy(self, features: Tensor) -> Tensor:
        """The most likely sample by operations on tensors alone, which can be exported."""

    @abstractmethod
    def explore(self, features: Tensor) -> dict[str, Tensor]:
        """A random ``action`` in the policy's own units, and what learning must know of it."""

    def start(self, worlds: int) -> Tensor:
        """Memory at the start of an episode, shape (worlds, 2 * recurrent)."""
        return self.low.new_zeros((worlds, 2 * self.config.recurrent), dtype=torch.float32)

    def features(self, observation: Tensor, memory: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Features (..., feature) for observations (..., observation), and the memory after seeing them."""
        scaled = self.observation_norm(observation)
        if memory is None:
            memory = scaled.new_zeros((*scaled.shape[:-1], 2 * self.config.recurrent))
        if self.memory is None:
            return self.digest(scaled), memory
        output, memory = self.memory(scaled, memory)
        return self.digest(torch.cat((scaled, output), dim=-1)), memory

    def features_along(self, scaled: Tensor, memory: Tensor, is_first: Tensor | None = None) -> Tensor:
        """Features (B, T, feature) along sequences of scaled observations (B, T, observation), as ``Memory.run``."""
        assert self.memory is not None
        return self.digest(torch.cat((scaled, self.memory.run(scaled, memory, is_first)), dim=-1))

    def digest(self, seen: Tensor) -> Tensor:
        """Features of scaled observations and the memory's output, side by side: the shared layers, if there are."""
        if self.shared is None:
            return seen
        features: Tensor = self.shared(seen)
        return features

    def distribution(self, observation: Tensor) -> Distribution:
        """Distribution of the sample for observations (..., observation), as if an episode began there."""
        return self.head(self.features(observation)[0])

    def to_env(self, sample: Tensor) -> Tensor:
        """Turn a sample into what the environment takes as action: [-1, 1] to its limits, or a choice."""
        if not self.spaces.is_discrete:
            return self.low + (self.high - self.low) * (sample.clamp(-1.0, 1.0) + 1.0) / 2.0
        if self.spaces.is_one_hot:
            return nn.functional.one_hot(sample, self.spaces.action_size)
        return sample

    def to_sample(self, action: Tensor) -> Tensor:
        """Undo ``to_env``."""
        if not self.spaces.is_discrete:
            return 2.0 * (action - self.low) / (self.high - self.low) - 1.0
        return action.argmax(dim=-1) if self.spaces.is_one_hot else action

    @torch.no_grad()
    def act(self, observation: Tensor, *, deterministic: bool = True) -> Tensor:
        """Action for each world at the start of an episode, or without memory: the most likely one, or a draw."""
        return self._choose(self.distribution(observation), deterministic)

    def most_likely(self, distribution: Distribution) -> Tensor:
        """The sample of a policy that does not explore."""
        mode: Tensor = distribution.mode
        return mode

    def _choose(self, distribution: Distribution, deterministic: bool) -> Tensor:
        return self.to_env(self.most_likely(distribution) if deterministic else distribution.sample())

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` for ``observation``: the policy as TorchRL's rollouts and collectors call it.

        The most likely action, or a draw where TorchRL's exploration type is RANDOM. A recurrent policy also reads and
        writes ``memory``. An episode begins where that is missing, and where ``is_init`` of TorchRL's ``InitTracker``
        says so: in collectors, which reset environments out of the policy's sight, it must be there.
        """
        memory = tensordict.get("memory", None)
        if memory is not None and "is_init" in tensordict:
            memory = memory * ~tensordict["is_init"]
        features, memory = self.features(tensordict["observation"], memory)
        if self.memory is not None:
            tensordict.set("memory", memory)
        deterministic = exploration_type() is not ExplorationType.RANDOM
        return tensordict.set("action", self._choose(self.head(features), deterministic))
