"""SAC's policy: an actor that is random by design, and the architecture of its Q-functions.

Continuous actions  a = center + half * tanh(u),  u ~ N(mean(s), diag(std(s)^2)).
Discrete actions    a ~ Categorical(logits(s)).
The Q-functions themselves belong to the algorithm: a trained policy acts without them.
"""

from typing import cast

import torch
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor, nn
from torch.distributions import Categorical, Distribution
from torchrl.modules import TanhNormal

from softwarp.policies.policy import ACTIVATIONS, NetworkConfig, Policy, Spaces, mlp

LOG_STD_BOUNDS = (-5.0, 2.0)  # of u before the tanh


class StateStdHead(nn.Module):
    """Mean and standard deviation from one network: features to (loc, scale)."""

    def __init__(self, body: nn.Module) -> None:
        super().__init__()
        self.body = body

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation, both shape (..., action)."""
        loc, raw = self.body(features).chunk(2, dim=-1)
        low, high = LOG_STD_BOUNDS
        return loc, (low + 0.5 * (high - low) * (torch.tanh(raw) + 1.0)).exp()


class StateActionValue(nn.Module):
    """Q(s, a) as a network of both."""

    def __init__(self, body: nn.Module) -> None:
        super().__init__()
        self.body = body

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        """Shape (..., 1)."""
        value: Tensor = self.body(torch.cat((features, action), dim=-1))
        return value


class SoftActor(Policy):
    """The actor of SAC.

    Raises:
        ValueError: If the settings ask for a memory, which SAC's replay does not keep, or for layers that actor and
            critic share.
    """

    kind = "soft_actor"

    def __init__(self, spaces: Spaces, config: NetworkConfig) -> None:
        if config.recurrent:
            raise ValueError("network.recurrent: SAC replays single steps and has no memory; set 0, or use algo=ppo")
        if config.shared:
            raise ValueError("network.shared: SAC's critics have networks of their own; set false, or use algo=ppo")
        super().__init__(spaces, config)
        outputs = spaces.action_size if spaces.is_discrete else 2 * spaces.action_size
        body: nn.Module = mlp([self.feature_size, *config.hidden, outputs], ACTIVATIONS[config.activation], 0.01)
        body = body if spaces.is_discrete else StateStdHead(body)
        keys = ["logits"] if spaces.is_discrete else ["loc", "scale"]
        self.actor = ProbabilisticTensorDictSequential(
            TensorDictModule(body, in_keys=["observation"], out_keys=keys),
            ProbabilisticTensorDictModule(
                in_keys=keys,
                out_keys=["action"],
                distribution_class=Categorical if spaces.is_discrete else TanhNormal,
                return_log_prob=True,
            ),
        )

    def head(self, features: Tensor) -> Distribution:
        """Distribution of tanh(u) (continuous) or of the choice (discrete) for features (..., feature)."""
        parameters = self.actor[0].module(features)
        if self.spaces.is_discrete:
            return Categorical(logits=parameters)
        squashed: Distribution = TanhNormal(*parameters)
        return squashed

    def greedy(self, features: Tensor) -> Tensor:
        """The most probable choice, or the tanh of the mean."""
        parameters = self.actor[0].module(features)
        best: Tensor = parameters.argmax(dim=-1) if self.spaces.is_discrete else torch.tanh(parameters[0])
        return best

    def most_likely(self, distribution: Distribution) -> Tensor:
        """The most probable choice, or the tanh of the mean."""
        if self.spaces.is_discrete:
            return super().most_likely(distribution)
        middle: Tensor = cast(TanhNormal, distribution).deterministic_sample
        return middle

    def explore(self, features: Tensor) -> dict[str, Tensor]:
        """A draw."""
        return {"action": self.head(features).sample()}

    def explore_uniformly(self, features: Tensor) -> dict[str, Tensor]:
        """An action that knows nothing, for the first steps of a run."""
        batch = features.shape[:-1]
        if self.spaces.is_discrete:
            return {"action": torch.randint(self.spaces.action_size, batch, device=features.device)}
        return {"action": 2.0 * torch.rand((*batch, self.spaces.action_size), device=features.device) - 1.0}

    def make_critic(self) -> TensorDictModule:
        """A fresh Q-function: of state and action, or of the state with a value for each choice."""
        activation, spaces = ACTIVATIONS[self.config.activation], self.spaces
        if spaces.is_discrete:
            body = mlp([self.feature_size, *self.config.hidden, spaces.action_size], activation, 1.0)
            return TensorDictModule(body, in_keys=["observation"], out_keys=["action_value"])
        body = mlp([self.feature_size + spaces.action_size, *self.config.hidden, 1], activation, 1.0)
        return TensorDictModule(
            StateActionValue(body), in_keys=["observation", "action"], out_keys=["state_action_value"]
        )
