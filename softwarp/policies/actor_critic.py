"""PPO's policy: a stochastic actor and a state value, built from an environment's specs.

Each has a network of its own, or, with ``network.shared``, one layer on hidden layers that both have in common.

Continuous actions  a = center + half * clip(u, -1, 1),  u ~ N(mean(s), diag(std^2)), std independent of the state;
                    log-probabilities are those of u, so clipping at the limits never distorts them.
Discrete actions    a ~ Categorical(logits(s)).
"""

import math

import torch
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor, nn
from torch.distributions import Categorical, Distribution
from torchrl.modules import IndependentNormal

from softwarp.policies.normalization import RunningNormalizer
from softwarp.policies.policy import ACTIVATIONS, NetworkConfig, Policy, Spaces, mlp

MIN_LOG_STD, MAX_LOG_STD = math.log(0.02), math.log(2.0)  # of u; half the action's range is 1


class GaussianHead(nn.Module):
    """Mean from the network, standard deviation of its own: features to (loc, scale)."""

    def __init__(self, body: nn.Module, size: int, initial_std: float) -> None:
        super().__init__()
        self.body = body
        self.log_std = nn.Parameter(torch.full((size,), math.log(initial_std)))

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation, both shape (..., action)."""
        loc = self.body(features)
        return loc, self.log_std.clamp(MIN_LOG_STD, MAX_LOG_STD).exp().expand_as(loc)


class ActorCritic(Policy):
    """A policy and its value estimate.

    ``actor`` and ``critic`` are TensorDict modules on *features*, as TorchRL's losses take them.
    """

    kind = "actor_critic"

    def __init__(self, spaces: Spaces, config: NetworkConfig) -> None:
        super().__init__(spaces, config)
        self.value_norm = RunningNormalizer(1, clip=math.inf, floor=1e-3)
        activation = ACTIVATIONS[config.activation]
        sizes = [self.seen_size, *config.hidden]
        if config.shared:
            self.shared = nn.Sequential(mlp(sizes, activation, last_gain=math.sqrt(2.0)), activation())
            sizes = sizes[-1:]
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

    def head(self, features: Tensor) -> Distribution:
        """Distribution of u (continuous) or of the choice (discrete) for features (..., feature)."""
        parameters = self.actor[0].module(features)
        if self.spaces.is_discrete:
            return Categorical(logits=parameters)
        normal: Distribution = IndependentNormal(*parameters)
        return normal

    def greedy(self, features: Tensor) -> Tensor:
        """The most probable choice, or the mean."""
        parameters = self.actor[0].module(features)
        best: Tensor = parameters.argmax(dim=-1) if self.spaces.is_discrete else parameters[0]
        return best

    def explore(self, features: Tensor) -> dict[str, Tensor]:
        """A draw and its log-probability."""
        distribution = self.head(features)
        sample = distribution.sample()
        return {"action": sample, "action_log_prob": distribution.log_prob(sample)}

    def value(self, observation: Tensor, memory: Tensor | None = None) -> Tensor:
        """Expected discounted return, shape (..., 1)."""
        return self.value_norm.inverse(self.critic.module(self.features(observation, memory)[0]))
