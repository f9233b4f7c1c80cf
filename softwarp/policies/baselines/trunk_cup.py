"""Hand-written policies for the trunk that holds a cup: keep still, or look up which commands led near the goal."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from softwarp.policies.baselines.scripted import Policy

NEIGHBOURS = 8
NEAR = 0.002  # m, added to distances so that a pose that was seen itself does not weigh all


def trunk_cup_hold(env: Any) -> Policy:
    """Leave the cables at the lengths of the start, whatever the goal.

    Discrete actions cannot do nothing: every second one takes back what the one before did.

    Args:
        env: A TrunkCup, bare or transformed, with ``observation="compact"``.

    Raises:
        ValueError: If it observes something else.
    """
    act = _Mover(env)

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        seen = act.decode(tensordict["observation"])
        return tensordict.set("action", act.towards(seen["command"] - seen["change"], seen["command"]))

    return policy


def trunk_cup_lookup(env: Any) -> Policy:
    """Go to the commands under which the cup was seen at rest near the goal's pose.

    Commands are the mean of those of the nearest training poses, weighted by the inverse square of their distance. What
    has been seen is all that it knows: it corrects nothing that is left at the end.

    Args:
        env: A TrunkCup, bare or transformed, with ``observation="compact"``.

    Raises:
        ValueError: If it observes something else.
    """
    act = _Mover(env)
    poses, commands, lever = env.seen_poses, env.seen_commands, env.config.axis_lever
    table = torch.cat((poses[:, :3] - env.start_tip.to(poses), lever * poses[:, 3:]), dim=1)  # m

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        seen = act.decode(tensordict["observation"])
        goal = torch.cat((seen["goal"], lever * seen["goal_axis"]), dim=-1)
        way, row = torch.cdist(goal, table.to(goal)).topk(min(NEIGHBOURS, len(table)), largest=False)
        weight = (way + NEAR) ** -2
        weight = weight / weight.sum(dim=-1, keepdim=True)
        wish = (weight[..., None] * commands.to(goal)[row]).sum(dim=-2)
        return tensordict.set("action", act.towards(wish, seen["command"]))

    return policy


class _Mover:
    """Observations in their units, and the actions that take cables from where they are to where they should be."""

    def __init__(self, env: Any) -> None:
        config = env.config
        if config.observation != "compact":
            raise ValueError(
                "trunk and cup baseline: it reads commands and the cup's axis, which observation='paper' leaves out; "
                "make the environment with observation='compact'"
            )
        self.decode = env.decode
        self.kind, self.step = config.action_kind, config.action_step
        self.low, self.high = env.displacement_limits()

    def towards(self, wish: Tensor, command: Tensor) -> Tensor:
        """The action for wished and present displacements [m], (..., cable)."""
        change = (wish - command) / self.step
        if self.kind == "discrete":
            return torch.cat((change, -change), dim=-1).argmax(dim=-1)
        if self.kind == "absolute":
            low, high = self.low.to(wish), self.high.to(wish)
            change = 2.0 * (wish - low) / (high - low) - 1.0
        action: Tensor = change.clamp(-1.0, 1.0)
        return action
