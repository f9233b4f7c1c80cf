"""Hand-written policies for trunk and cup: keep still, look up which commands led near the goal, take hold first."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from softwarp.policies.baselines.scripted import Policy

NEIGHBOURS = 8
NEAR = 0.002  # m, added to distances so that a pose that was seen itself does not weigh all

# Of a cup on the table. Displacements [m] that lay the trunk round it, long cables +y, -x, -y, +x, then short ones.
WRAP = (0.010, -0.040, 0.0, 0.044, 0.004, -0.020, 0.0, 0.014)
LEADER = 3  # cable whose displacement tells how far the wrapping has come
AHEAD = {"discrete": 0.12}  # part of the way by which the wish is ahead of the cables; else:
SLOWLY = 0.025
SQUEEZE = (0.0035, 0.0021, 0.0007, 0.0035, 0.0028, 0.0021, 0.0014, 0.0014)  # m, beyond what was looked up
TAUT = 0.1  # N, of a cable
HELD = 1.0  # N of all contacts, from which the cup counts as held; or, with less,
LIFTED, ROUND = 0.002, 0.9  # m above the start, where so much of the way round it has been come
RATE = 0.4  # of a whole action, at which a held cup is moved
THERE = 0.005  # m of what is missing, axis included, from which on it is left where it is
GAIN, REACH = 1.5, 0.010  # how far beyond the goal to aim, in parts of what is missing, of which so much counts [m]


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
    if env.is_open:
        return _take_and_carry(env, act)
    look_up = _Table(env)

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        seen = act.decode(tensordict["observation"])
        return tensordict.set("action", act.towards(look_up(look_up.goal(seen)), seen["command"]))

    return policy


def _take_and_carry(env: Any, act: _Mover) -> Policy:
    """Lay the trunk round the standing cup, squeeze, and go to the commands of the table, corrected by what is missing.

    The trunk gets hold of the cup a little elsewhere than in the grasp that the table is of, so the same commands leave
    the cup some millimetres off: the goal that is looked up lies beyond the true one by as much and half again.
    """
    look_up = _Table(env)
    ahead = AHEAD.get(act.kind, SLOWLY)

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        seen = act.decode(tensordict["observation"])
        command = seen["command"]
        wrap, squeeze = command.new_tensor(WRAP), command.new_tensor(SQUEEZE)
        come = (command[..., LEADER : LEADER + 1] / WRAP[LEADER]).clamp(0.0, 1.0)
        missing = torch.cat((seen["error"], look_up.lever * seen["turn"]), dim=-1)
        length = missing.norm(dim=-1, keepdim=True).clamp(min=1.0e-9)
        aim = look_up.goal(seen) + GAIN * missing * (REACH / length).clamp(max=1.0)
        change = look_up(aim) + squeeze - command
        if act.kind != "discrete":
            change = change * (RATE * act.step / change.abs().amax(dim=-1, keepdim=True).clamp(min=1e-9)).clamp(max=1.0)
        change = change * (length > THERE)
        is_held = (seen["grip"] > HELD) | ((seen["tip"][..., 1:2] > LIFTED) & (come > ROUND))
        lay = wrap * (come + ahead).clamp(max=1.0) - command
        if act.kind == "discrete":  # one cable at a time: let out those alone that hold back
            lay = lay.masked_fill((lay < 0.0) & (seen["tension"] < TAUT), 0.0)
        return tensordict.set("action", act.towards(command + torch.where(is_held, change, lay), command))

    return policy


class _Table:
    """Commands under which the cup was seen near a pose: the mean of the nearest ones."""

    def __init__(self, env: Any) -> None:
        poses, self.commands, self.lever = env.seen_poses, env.seen_commands, env.config.axis_lever
        self.table = torch.cat((poses[:, :3] - env.start_tip.cpu(), self.lever * poses[:, 3:]), dim=1)  # m

    def goal(self, seen: dict[str, Tensor]) -> Tensor:
        """The goal's place, less that of the start, and its axis [m], shape (..., 6)."""
        return torch.cat((seen["goal"], self.lever * seen["goal_axis"]), dim=-1)

    def __call__(self, pose: Tensor) -> Tensor:
        """Displacements [m], shape (..., cable)."""
        way, row = torch.cdist(pose, self.table.to(pose)).topk(min(NEIGHBOURS, len(self.table)), largest=False)
        weight = (way + NEAR) ** -2
        weight = weight / weight.sum(dim=-1, keepdim=True)
        wish: Tensor = (weight[..., None] * self.commands.to(pose)[row]).sum(dim=-2)
        return wish


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
