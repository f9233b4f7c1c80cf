"""Hand-written policies for the carts: linear feedback that balances, and a direct approach that gets stuck."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import torch
from tensordict import TensorDictBase
from torch import Tensor

Policy: TypeAlias = Callable[[TensorDictBase], TensorDictBase]  # reads "observation", writes "action"

STEM_GAINS = (0.005, 1.0, 0.04, 0.2)  # m per unit of cart x [m], offset [m], cart speed [m/s], offset's speed [m/s]
FULL_FORCE = 0.0005  # m, weighted offset from which the cart is pushed with all force


def cart_stem_feedback(env: Any) -> Policy:
    """Push the cart towards the side on which the sphere is, or soon will be.

    Linear in the state and saturated; discrete actions take the sign of the force alone. The cart's own place and speed
    count little, just enough to keep it on its rails.

    Args:
        env: A CartStem, bare or transformed.
    """
    gains = torch.tensor(STEM_GAINS)

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        state = env.decode(tensordict["observation"])
        return tensordict.set("action", _pushed(env, state @ gains.to(state) / FULL_FORCE))

    return policy


def _pushed(env: Any, force: Tensor) -> Tensor:
    """Action for a force towards +x, 1 being all that there is."""
    if env.config.action_kind == "discrete":
        return (force < 0.0).to(torch.int64)
    return force.clamp(-1.0, 1.0)[..., None]
