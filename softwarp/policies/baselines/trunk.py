"""A hand-written policy for the trunk: pull the cables on the goal's side, let go those on the other."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from softwarp.meshing.trunk_geometry import CABLE_SIDES
from softwarp.policies.baselines.scripted import Policy

FULL_PULL = 0.020  # m, sideways distance to the goal from which a cable is moved at full speed


def trunk_baseline(env: Any) -> Policy:
    """The policy for one Trunk environment, from its observations alone.

    Every cable is moved in proportion to how far the goal lies on its side of the tip. Discrete actions move the one
    cable for which that is furthest. Nothing is known of gravity, of stiffness, or of what a bend does to the tip's
    height, so it ends centimetres away where the trunk is bent far.

    Args:
        env: A Trunk, bare or transformed; its layout of observations is read once.

    Raises:
        ValueError: If the environment takes absolute displacements, for which there is no such rule.
    """
    layout, scale, kind = env.observation_layout, env.length_scale, env.config.action_kind
    if kind == "absolute":
        raise ValueError(
            "trunk baseline: cables are moved step by step; make the environment with action_kind='continuous'"
        )
    tip, goal = layout["tip"], layout["goal"]
    sides = torch.tensor(CABLE_SIDES * 2)  # of the long cables, then of the short ones

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        observation = tensordict["observation"]
        sideways = scale * (observation[..., goal] - observation[..., tip])[..., :2]
        pull: Tensor = sideways @ sides.to(observation).T / FULL_PULL
        if kind == "discrete":
            action = torch.cat((pull, -pull), dim=-1).argmax(dim=-1)
        else:
            action = pull.clamp(-1.0, 1.0)
        return tensordict.set("action", action)

    return policy
