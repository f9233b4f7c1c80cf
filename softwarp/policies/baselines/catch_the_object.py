"""A hand-written policy for CatchTheObject: hold the ball, wait for the cart, let go ahead of it."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from softwarp.policies.baselines.scripted import Policy

HOLD = 135.0e3  # Pa, a little more than the 100 kPa under which the ball slips through, so that it is free at once
LEAD = 0.0525  # m, from cart to ball when the pads should open: its way while the ball gets free and falls
WINDOW = 0.0155  # m, half of the cart's way in an action, and a little: one action of a passage falls into it
STILL = 0.1  # m/s, a ball slower than this is held
FALLING = 0.14  # m, height below which the ball is on its way


def catch_baseline(env: Any) -> Policy:
    """The policy for CatchTheObject, from its observations alone.

    Args:
        env: A CatchTheObject, bare or transformed.
    """
    hold = 2.0 * min(HOLD / env.config.max_pressure, 1.0) - 1.0

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        height, speed, cart, direction, _ = env.decode(tensordict["observation"]).unbind(dim=-1)
        is_due = (direction * cart + LEAD).abs() <= WINDOW
        let_go: Tensor = (is_due & (speed.abs() < STILL)) | (height < FALLING)
        action = torch.where(let_go & (height < FALLING + 0.03), -1.0, hold)
        return tensordict.set("action", action.to(height.dtype)[..., None])

    return policy
