"""A hand-written policy for the diamond: pull all cables to rise, and the ones on the far side to move there."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from softwarp.meshing.trunk_geometry import CABLE_SIDES
from softwarp.policies.baselines.scripted import Policy

LIFT = 1.5  # m of rise per m by which all four cables are shortened, measured in the middle of the region
PUSH = 0.8  # m sideways, away from a cable's side, per m by which it is shortened and the opposite one let go

GAIN = 0.2  # part of the way asked for in one action; the body swings, and more would excite it


def diamond_baseline(env: Any) -> Policy:
    """The policy for one Diamond environment, from its observations alone.

    Commands change by part of what would bring the top to the goal if it moved in proportion to them, with the ratios
    of the middle of its region. Discrete actions move the one cable that is furthest from its wish; they are too coarse
    to hold still, and the top swings on.

    Args:
        env: A Diamond, bare or transformed, with compact observations; its layout of observations is read once.

    Raises:
        ValueError: If actions are absolute displacements or observations do not hold the goal.
    """
    layout, scale, kind = env.observation_layout, env.length_scale, env.config.action_kind
    if kind == "absolute" or "goal" not in layout:
        raise ValueError(
            "diamond baseline: needs action_kind='continuous' or 'discrete' and observation='compact', got "
            f"action_kind={kind!r} and observation={env.config.observation!r}"
        )
    tip, goal, step = layout["tip"], layout["goal"], env.config.action_step
    sides = torch.tensor(CABLE_SIDES)

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        observation = tensordict["observation"]
        error = scale * (observation[..., goal] - observation[..., tip])
        pull: Tensor = error[..., 2:] / LIFT - error[..., :2] @ sides.to(observation).T / (2.0 * PUSH)
        if kind == "discrete":
            action = torch.stack((pull, -pull), dim=-1).flatten(-2).argmax(dim=-1)
        else:
            action = (GAIN * pull / step).clamp(-1.0, 1.0)
        return tensordict.set("action", action)

    return policy
