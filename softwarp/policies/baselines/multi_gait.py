"""A hand-written policy for MultiGaitFull: the gait of SofaGym's paper."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase

from softwarp.policies.baselines.scripted import Policy

GAIT = (1, 0, 2, 4, 3, 5)  # fill rear, centre, front, then empty them in the same order
# Next action for what is full, 1 for the centre + 2 for the rear + 4 for the front legs; two of the eight are none of
# the gait's, and are led back to it.
NEXT = (1, 3, 0, 2, 5, 3, 0, 4)
_GROUPS = ((0,), (3, 4), (1, 2))  # chambers of centre, rear, front


def multi_gait_baseline(env: Any) -> Policy:
    """Fill the rear legs, the centre, the front legs, then empty them in the same order, from observations alone.

    Args:
        env: A MultiGaitFull, bare or transformed, with chambers="symmetric".

    Raises:
        ValueError: If its chambers are commanded one by one.
    """
    config = env.config
    if config.chambers != "symmetric":
        raise ValueError(
            f"the scripted policy of MultiGaitFull fills left and right alike, which needs chambers='symmetric', got "
            f"{config.chambers!r}"
        )
    kind = config.action_kind

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        share = env.decode(tensordict["observation"])["share"]
        full = torch.stack([share[..., group[0]] > 0.5 for group in _GROUPS], dim=-1).long()
        code = full[..., 0] + 2 * full[..., 1] + 4 * full[..., 2]
        choice = torch.tensor(NEXT, device=share.device)[code]
        if kind == "discrete":
            return tensordict.set("action", choice)
        group, fills = (choice % 3)[..., None], (choice < 3).long()[..., None]
        full = full.scatter(-1, group, fills)
        return tensordict.set("action", 2.0 * full.to(share.dtype) - 1.0)

    return policy
