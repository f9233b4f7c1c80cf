"""Actor and critic networks built from an environment's specs.

Continuous actions  a = center + half * clip(u, -1, 1),  u ~ N(mean(s), diag(std^2)), std independent of the state;
                    log-probabilities are those of u, so clipping at the limits never distorts them.
Discrete actions    a ~ Categorical(logits(s)).
Observations        scaled by running statistics (``observation_norm``) that are saved with the networks.
"""

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor, nn
from torch.distributions import Categorical, Distribution
from torchrl.modules import IndependentNormal

from softwarp.policies.normalization import RunningNormalizer

ACTIVATIONS: dict[str, type[nn.Module]] = {"elu": nn.ELU, "relu": nn.ReLU, "silu": nn.SiLU, "tanh": nn.Tanh}
MIN_LOG_STD, MAX_LOG_STD = math.log(0.02), math.log(2.0)  # of u; half the action's range is 1


@dataclass
class NetworkConfig:
    """Shape of the networks."""

    hidden: list[int] = field(default_factory=lambda: [128, 128])  # units of each hidden layer
    activation: str = "elu"  # elu, relu, silu or tanh
    initial_std: float = 0.4  # of a continuous action, half its range being 1

    def __post_init__(self) -> None:
        """Refuse what cannot be built."""
        if self.activation not in ACTIVATIONS:
            valid = ", ".join(ACTIVATIONS)
            raise ValueError(f"network.activation: {self.activation!r} is unknown; choose from {valid}")
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"network.hidden: needs layers of at least 1 unit each, got {list(self.hidden)}")
        if not 0.02 <= self.initial_std <= 2.0:
            raise ValueError(f"network.initial_std: must lie in [0.02, 2], got {self.initial_std:g}")


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


class GaussianHead(nn.Module):
    """Mean from the network, standard deviation of its own: observation to (loc, scale)."""

    def __init__(self, body: nn.Module, size: int, initial_std: float) -> None:
        super().__init__()
        self.body = body
        self.log_std = nn.Parameter(torch.full((size,), math.log(initial_std)))

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation, both shape (..., action)."""
        loc = self.body(observation)
        return loc, self.log_std.clamp(MIN_LOG_STD, MAX_LOG_STD).exp().expand_as(loc)


class ActorCritic(nn.Module):
    """A policy and its value estimate, each with its own network.

    ``actor`` and ``critic`` are TensorDict modules on *scaled* observations, as TorchRL's losses take them. All other
    methods take observations as the environment gives them.
    """

    low: Tensor
    high: Tensor

    def __init__(self, spaces: Spaces, config: NetworkConfig) -> None:
        super().__init__()
        self.spaces = spaces
        self.config = config
        self.observation_norm = RunningNormalizer(spaces.observation_size)
        self.value_norm = RunningNormalizer(1, clip=math.inf, floor=1e-3)
        self.register_buffer("low", torch.tensor(spaces.low), persistent=False)
        self.register_buffer("high", torch.tensor(spaces.high), persistent=False)

        activation = ACTIVATIONS[config.activation]
        sizes = [spaces.observation_size, *config.hidden]
        body: nn.Module = mlp([*sizes, spaces.action_size], activation, last_gain=0.01)
        if not spaces.is_discrete:
            body = GaussianHead(body, spaces.action_size, config.initial_std)
        keys = ["logits"] if spaces.is_discrete else ["loc", "scale"]
        self.actor = ProbabilisticTensorDictSequential(
            TensorDictModule(body, in_keys=["observation"], out_keys=keys),
            ProbabilisticTensorDictModule(
                in_keys=keys,
                out_keys=["action"],
                distribution_class=Categorical if spaces.is_discrete else IndependentNormal,
                return_log_prob=True,
            ),
        )
        values = mlp([*sizes, 1], activation, last_gain=1.0)
        self.critic = TensorDictModule(values, in_keys=["observation"], out_keys=["state_value"])

    def distribution(self, observation: Tensor) -> Distribution:
        """Distribution of u (continuous) or of the choice (discrete) for observations (..., observation)."""
        parameters = self.actor[0].module(self.observation_norm(observation))
        if self.spaces.is_discrete:
            return Categorical(logits=parameters)
        normal: Distribution = IndependentNormal(*parameters)
        return normal

    def value(self, observation: Tensor) -> Tensor:
        """Expected discounted return, shape (..., 1)."""
        return self.value_norm.inverse(self.critic.module(self.observation_norm(observation)))

    def to_env(self, sample: Tensor) -> Tensor:
        """Turn u or a choice into what the environment takes as action."""
        if not self.spaces.is_discrete:
            return self.low + (self.high - self.low) * (sample.clamp(-1.0, 1.0) + 1.0) / 2.0
        if self.spaces.is_one_hot:
            return nn.functional.one_hot(sample, self.spaces.action_size)
        return sample

    @torch.no_grad()
    def act(self, observation: Tensor, *, deterministic: bool = True) -> Tensor:
        """Action for each world: the most likely one, or a random draw."""
        distribution = self.distribution(observation)
        return self.to_env(distribution.mode if deterministic else distribution.sample())

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the deterministic ``action`` for ``observation``: the policy as TorchRL's rollouts call it."""
        return tensordict.set("action", self.act(tensordict["observation"]))
