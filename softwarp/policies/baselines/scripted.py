"""Baselines without learning: what a trained policy has to beat."""

from collections.abc import Callable
from typing import TypeAlias

import torch
from tensordict import TensorDictBase

from softwarp.policies.policy import Spaces

Policy: TypeAlias = Callable[[TensorDictBase], TensorDictBase]  # reads "observation", writes "action"


def nothing(spaces: Spaces) -> Policy:
    """Always the zero action.

    Raises:
        ValueError: If the action is a choice, of which none means "hold still", or if zero is outside its limits.
    """
    if spaces.is_discrete:
        count = spaces.action_size
        raise ValueError(f"doing nothing: none of the {count} discrete actions holds still; use continuous actions")
    if min(spaces.high) < 0.0 or max(spaces.low) > 0.0:
        raise ValueError(f"doing nothing: zero lies outside the action limits {spaces.low} to {spaces.high}")

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        observation = tensordict["observation"]
        return tensordict.set("action", observation.new_zeros((*observation.shape[:-1], spaces.action_size)))

    return policy


def random(spaces: Spaces, seed: int = 0) -> Policy:
    """Uniformly random actions; the same seed gives the same sequence."""
    generator = torch.Generator().manual_seed(seed)
    low, high = torch.tensor(spaces.low), torch.tensor(spaces.high)

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        observation = tensordict["observation"]
        batch = observation.shape[:-1]
        if spaces.is_discrete:
            action = torch.randint(spaces.action_size, batch, generator=generator)
            action = torch.nn.functional.one_hot(action, spaces.action_size) if spaces.is_one_hot else action
        else:
            action = low + (high - low) * torch.rand((*batch, spaces.action_size), generator=generator)
        return tensordict.set("action", action.to(observation.device))

    return policy
