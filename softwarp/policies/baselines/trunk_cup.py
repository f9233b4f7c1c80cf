"""Hand-written policies for trunk and cup: keep still, look up which commands led near the goal, take hold first."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from softwarp.policies.baselines.scripted import Policy

NEIGHBOURS = 8
NEAR = 0.002  # m, added to distances so that a pose that was seen itself does not weigh all
FITTED = 32  # poses round a goal to which commands are fitted linearly
RIDGE = 0.002  # m, length of a way in a direction that no pose shows for which commands are left alone
CLOSE, CLOSE_AT_REST = 0.010, 0.030  # m from the goal, within which what is left is corrected
REST = 0.005  # m/s
GENTLE = 0.006  # m of it at most; larger corrections shake the cup off
GAIN = 0.25  # part of it in an action; the trunk takes some actions to follow

# Of a cup on the table. Displacements [m] that lay the trunk round it, long cables +y, -x, -y, +x, then short ones.
WRAP = (0.010, -0.040, 0.0, 0.044, 0.004, -0.020, 0.0, 0.014)
LEADER = 3  # cable whose displacement tells how far the wrapping has come
AHEAD = {"discrete": 0.12}  # part of the way by which the wish is ahead of the cables; else:
SLOWLY = 0.025
SQUEEZE = (0.014, 0.0084, 0.0028, 0.014, 0.0112, 0.0084, 0.0056, 0.0056)  # m, beyond what was looked up
TAUT = 0.1  # N, of a cable
HELD, LIFTED = 0.05, 0.002  # N of all contacts, or m above the start, from which the cup counts as held
ROUND = 0.97  # where so much of the way round it has been come
RATE = 0.4  # of a whole action, at which a held cup is moved
THERE = 0.005  # m of what is missing, axis included, from which on it is left where it is
CALM = 0.02  # m/s, slower than which a cup is corrected by what is missing
BEYOND, REACH = 1.5, 0.010  # how far beyond the goal to aim, in parts of what is missing, of which so much counts [m]


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
    act, memory = _Mover(env), _Seen(env)
    if env.is_open:
        return _take_and_carry(act, memory)

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        seen = act.decode(tensordict["observation"])
        wish = memory.commands_at(memory.pose(seen["goal"], seen["goal_axis"]))
        return tensordict.set("action", act.towards(wish, seen["command"]))

    return policy


def trunk_cup_servo(env: Any) -> Policy:
    """Look the commands up, and near the goal correct what is left of the way.

    By how much commands change with the pose is fitted to those of the training poses round the goal: linear least
    squares, weighted by the distance.

    Args:
        env: A TrunkCup, bare or transformed, with ``observation="compact"``.

    Raises:
        ValueError: If it observes something else.
    """
    act, memory = _Mover(env), _Seen(env)
    if env.is_open:
        return _take_and_carry(act, memory)

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        seen = act.decode(tensordict["observation"])
        goal = memory.pose(seen["goal"], seen["goal_axis"])
        left = goal - memory.pose(seen["tip"], seen["axis"])
        far = torch.linalg.vector_norm(left, dim=-1, keepdim=True)
        left = left * (GENTLE / far.clamp_min(GENTLE))
        correction = (memory.slope_at(goal) @ left[..., None]).squeeze(-1)
        is_slow = torch.linalg.vector_norm(seen["tip_v"], dim=-1, keepdim=True) < REST
        is_close = far < torch.where(is_slow, CLOSE_AT_REST, CLOSE)
        wish = torch.where(is_close, seen["command"] + GAIN * correction, memory.commands_at(goal))
        return tensordict.set("action", act.towards(wish, seen["command"]))

    return policy


def _take_and_carry(act: _Mover, memory: _Seen) -> Policy:
    """Lay the trunk round the standing cup, squeeze, and go to the commands of the table, corrected by what is missing.

    The trunk gets hold of the cup elsewhere than in the grasp that the table is of, so the same commands leave the cup
    millimetres off. On the way, the goal that is looked up lies beyond the true one by as much and half again; near it,
    what is missing changes the commands by the slope of the table, action after action.
    """
    ahead = AHEAD.get(act.kind, SLOWLY)

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        seen = act.decode(tensordict["observation"])
        command = seen["command"]
        wrap, squeeze = command.new_tensor(WRAP), command.new_tensor(SQUEEZE)
        come = (command[..., LEADER : LEADER + 1] / WRAP[LEADER]).clamp(0.0, 1.0)
        missing = torch.cat((seen["error"], memory.lever * seen["turn"]), dim=-1)
        length = missing.norm(dim=-1, keepdim=True).clamp(min=1.0e-9)
        goal = memory.pose(seen["goal"], seen["goal_axis"])
        aim = goal + BEYOND * missing * (REACH / length).clamp(max=1.0)
        change = memory.commands_at(aim) + squeeze - command
        left = missing * (GENTLE / length).clamp(max=1.0)
        correction = GAIN * (memory.slope_at(goal) @ left[..., None]).squeeze(-1)
        slow = torch.linalg.vector_norm(seen["tip_v"], dim=-1, keepdim=True) < CALM
        change = torch.where((length < CLOSE_AT_REST) & slow, correction, change)
        if act.kind != "discrete":
            change = change * (RATE * act.step / change.abs().amax(dim=-1, keepdim=True).clamp(min=1e-9)).clamp(max=1.0)
        change = change * (length > THERE)
        is_held = ((seen["grip"] > HELD) | (seen["tip"][..., 1:2] > LIFTED)) & (come > ROUND)
        lay = wrap * (come + ahead).clamp(max=1.0) - command
        if act.kind == "discrete":  # one cable at a time: let out those alone that hold back
            lay = lay.masked_fill((lay < 0.0) & (seen["tension"] < TAUT), 0.0)
        return tensordict.set("action", act.towards(command + torch.where(is_held, change, lay), command))

    return policy


class _Seen:
    """Commands and the poses at rest to which they led; a pose is a place and an axis, all in metres."""

    def __init__(self, env: Any) -> None:
        self.lever = env.config.axis_lever
        poses, self.commands = env.seen_poses.to(env.device), env.seen_commands.to(env.device)
        self.poses = self.pose(poses[:, :3] - env.start_tip.to(poses), poses[:, 3:])

    def pose(self, place: Tensor, axis: Tensor) -> Tensor:
        """Place [m] and axis as one vector, (..., 6)."""
        return torch.cat((place, self.lever * axis), dim=-1)

    def _near(self, goal: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Rows of the nearest poses, and weights with the sum 1, (..., count)."""
        way, row = torch.cdist(goal, self.poses).topk(min(count, len(self.poses)), largest=False)
        weight = (way + NEAR) ** -2
        return row, weight / weight.sum(dim=-1, keepdim=True)

    def commands_at(self, goal: Tensor) -> Tensor:
        """Mean of the commands of the nearest poses [m], (..., 8)."""
        row, weight = self._near(goal, NEIGHBOURS)
        mean: Tensor = (weight[..., None] * self.commands[row]).sum(dim=-2)
        return mean

    def slope_at(self, goal: Tensor) -> Tensor:
        """Change of the commands with the pose, (..., 8, 6)."""
        row, weight = self._near(goal, FITTED)
        poses, commands = self.poses[row], self.commands[row]
        poses = poses - (weight[..., None] * poses).sum(dim=-2, keepdim=True)
        commands = commands - (weight[..., None] * commands).sum(dim=-2, keepdim=True)
        weighted = (weight[..., None] * poses).mT
        square = weighted @ poses + RIDGE**2 * torch.eye(6, device=goal.device)
        slope: Tensor = torch.linalg.solve(square, weighted @ commands).mT
        return slope


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
