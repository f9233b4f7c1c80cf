"""A hand-written policy for CatheterBeam: turn the guide's hook towards the way, push, and draw back out of wrong branches."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from softwarp.envs.options.catheter_beam import CATHETER, COIL, GUIDE
from softwarp.policies.baselines.scripted import Policy

LOOK = 2  # which of the places ahead the hook is turned to
BEHIND_COIL, BEHIND_CATHETER = 0.10, 0.06  # m, by which coil and catheter stay behind the guide
ASIDE = 0.004  # m, of the place ahead beside the line's end, from which turning matters
ALIGNED = 0.5  # rad, error of the hook with which the guide is pushed at full speed
SLOW = 0.0  # share of an insertion while the hook turns
DEBUG=False
BACK = -0.3  # cosine of the line's end and the way from which the tip is in a wrong branch


def catheter_baseline(env: Any) -> Policy:
    """The policy for CatheterBeam, from its observations alone.

    Args:
        env: A CatheterBeam, bare or transformed, with compact observations.

    Raises:
        ValueError: If observations are the paper's, which hold no directions.
    """
    env.decode(torch.zeros(1, 35))  # refuses what cannot be read
    config = env.config
    insert, turn = torch.tensor(config.insert_step), torch.tensor(config.turn_step)

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        seen = env.decode(tensordict["observation"])
        wish = _wish(seen)
        share = torch.stack((wish[..., 0, :] / insert.to(wish), wish[..., 1, :] / turn.to(wish)), dim=-1)
        share = share.clamp(-1.0, 1.0)  # (..., instrument, insertion and turn)
        if config.action_kind == "continuous":
            return tensordict.set("action", share.flatten(-2))
        return tensordict.set("action", _most_urgent(share))

    return policy


def _wish(seen: dict[str, Tensor]) -> Tensor:
    """Changes of lengths [m] and angles [rad] that are wanted, (..., 2, instrument)."""
    length, along = seen["length"], seen["along"]
    places = seen["ahead"].unflatten(-1, (3, 3))
    aside = places[..., LOOK, :] - places[..., 0, :]  # how the centre line turns, wherever the tip lies in the lumen
    aside = aside - (aside * along).sum(dim=-1, keepdim=True) * along
    hook = seen["hook"] - (seen["hook"] * along).sum(dim=-1, keepdim=True) * along
    error = torch.atan2((torch.linalg.cross(hook, aside) * along).sum(dim=-1), (hook * aside).sum(dim=-1))
    matters = torch.linalg.vector_norm(aside, dim=-1) > ASIDE
    error = torch.where(matters, error, 0.0)
    is_wrong = (seen["direction"] * along).sum(dim=-1) < BACK
    push = torch.where(error.abs() > ALIGNED, SLOW, 1.0)
    push = torch.where(is_wrong, -1.0, push)
    guide = length[..., GUIDE] + push
    wish = torch.zeros((*length.shape[:-1], 2, 3), dtype=length.dtype, device=length.device)
    wish[..., 0, GUIDE] = push
    wish[..., 0, COIL] = length[..., GUIDE] - BEHIND_COIL - length[..., COIL]
    wish[..., 0, CATHETER] = length[..., GUIDE] - BEHIND_CATHETER - length[..., CATHETER]
    if DEBUG: print(error.numpy().round(2), hook[0].numpy().round(2), aside[0].numpy().round(3), along[0])
    wish[..., 1, GUIDE] = error
    del guide
    return wish


def _most_urgent(share: Tensor) -> Tensor:
    """The discrete action nearest to what is wanted most: turns before insertions."""
    insertion, turning = share.unbind(dim=-1)
    score = torch.stack((insertion, 2.0 * turning, -2.0 * turning, -insertion), dim=-1).flatten(-2)
    choice: Tensor = score.argmax(dim=-1)
    return choice
