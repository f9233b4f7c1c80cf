"""A hand-written policy for CatheterBeam: turn the guide's hook to a branch, push, draw back out of wrong branches."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from softwarp.policies.baselines.scripted import Policy

COIL, GUIDE, CATHETER = range(3)  # as options, actions and observations order them
BEHIND_COIL = 0.10  # m, by which the coil stays behind the guide
COAXIAL, HOOKED = 0.002, 0.030  # m, by which the catheter is behind the guide: to straighten its hook, and to free it
CAUGHT_UP = 0.012  # m, from which on the guide waits for the catheter
TURN_AT, NEAR_FORK, WAIT_AT, AT_FORK = 0.15, 0.06, 0.035, 0.015  # m before a fork, see the policy
ALIGNED = 0.7  # rad, error of the hook with which the guide is pushed on
GAIN = 0.6  # share of that error that an action takes back; friction lets the tip lag behind
FIRST = (0.3, 1.0, 0.9)  # weights of the instruments' insertions where only one can be moved at a time
GENTLE = 0.010  # m, by which the guide is pushed near a fork
SLOW = 0.008  # m, by which the tip is drawn back while its hook turns at a fork


def catheter_baseline(env: Any) -> Policy:
    """The policy for CatheterBeam, from its observations alone.

    Args:
        env: A CatheterBeam, bare or transformed, with compact or local observations.

    Raises:
        ValueError: If observations are the paper's, which hold no directions.
    """
    env.decode(torch.zeros(1, *env.observation_spec["observation"].shape[1:]))  # refuses what cannot be read
    config = env.config
    insert, turn = torch.tensor(config.insert_step), torch.tensor(config.turn_step)

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        seen = env.decode(tensordict["observation"])
        wish = _wish(seen)
        share = torch.stack((wish[..., 0, :] / insert.to(wish), wish[..., 1, :] / turn.to(wish)), dim=-1)
        share = share.clamp(-1.0, 1.0)  # (..., instrument, insertion and turn)
        if config.action_kind == "continuous":
            return tensordict.set("action", env.action_of(share.flatten(-2)))
        return tensordict.set("action", _most_urgent(share))

    return policy


def _wish(seen: dict[str, Tensor]) -> Tensor:
    """Changes of lengths [m] and angles [rad] that are wanted, (..., 2, instrument)."""
    length, along, side, to_fork = seen["length"], seen["along"], seen["side"], seen["to_fork"][..., 0]
    hook = seen["hook"]
    error = torch.atan2((torch.linalg.cross(hook, side) * along).sum(dim=-1), (hook * side).sum(dim=-1))
    is_wrong = seen["on"][..., 0] < 0.0  # the way leads back out of this branch
    error = torch.where(is_wrong, -error, error)  # along looks back there
    is_fork = side.abs().sum(dim=-1) > 0.0
    turns = (to_fork < NEAR_FORK) & is_fork
    error = torch.where((to_fork < TURN_AT) & is_fork, error, 0.0)
    waits = (error.abs() > ALIGNED) & (to_fork < WAIT_AT)
    guide = length[..., GUIDE]
    is_alone = guide - length[..., CATHETER] > CAUGHT_UP
    push = torch.where(turns | is_alone, GENTLE, 1.0)
    push = torch.where(waits, torch.where(to_fork < AT_FORK, -SLOW, 0.0), push)
    push = torch.where(is_wrong, -1.0, push)
    behind = torch.where(turns, HOOKED, COAXIAL)
    wish = torch.zeros((*error.shape, 2, 3), dtype=length.dtype, device=length.device)
    wish[..., 0, GUIDE] = push
    wish[..., 0, COIL] = (guide - BEHIND_COIL).clamp_min(0.0) - length[..., COIL]
    wish[..., 0, CATHETER] = (guide - behind).clamp_min(0.0) - length[..., CATHETER]
    wish[..., 1, GUIDE] = GAIN * error
    return wish


def _most_urgent(share: Tensor) -> Tensor:
    """The discrete action nearest to what is wanted most: turns before insertions, of the guide first."""
    insertion, turning = share.unbind(dim=-1)
    insertion, turning = insertion * torch.tensor(FIRST).to(insertion), 2.0 * turning
    score = torch.stack((insertion, turning, -turning, -insertion), dim=-1).flatten(-2)
    choice: Tensor = score.argmax(dim=-1)
    return choice
