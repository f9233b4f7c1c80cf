"""A hand-written policy for Gripper: over the object, down, close, lift; again from the start if the object fell.

One phase passes into the next over a range of what decides about it, not at a threshold: so a network can learn it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from softwarp.policies.baselines.scripted import Policy

# Cable [m] at which the closing fingers are so far [m] from the middle, and how far below the hand [m] they hold then.
TOUCHING = {
    "cavities": (
        (0.000, 0.0591, 0.0723),
        (0.004, 0.0450, 0.0712),
        (0.008, 0.0318, 0.0674),
        (0.012, 0.0203, 0.0611),
        (0.016, 0.0106, 0.0530),
        (0.020, 0.0032, 0.0434),
    ),
    "plain": (
        (0.000, 0.0587, 0.0723),
        (0.004, 0.0420, 0.0716),
        (0.008, 0.0267, 0.0669),
        (0.012, 0.0138, 0.0593),
        (0.016, 0.0039, 0.0495),
        (0.018, 0.0028, 0.0451),
    ),
}
SQUEEZE = {"cavities": 0.0045, "plain": 0.0075}  # m of cable beyond touching, in proportion to the fingers' stiffness
WAIST = 0.62  # width where the fingers hold the figurine, in widths of its foot
OVER = (0.002, 0.006)  # m beside the object, up to which and from which on the hand is and is not over it
PARALLEL = (0.05, 0.15)  # rad, likewise, of its turn
HELD = (0.085, 0.095)  # m below the hand, where the object is and is not between the fingers
BETWEEN = (0.020, 0.028)  # m beside it, likewise
LOW = (0.0005, 0.003)  # m above the height for closing
OPEN = (0.002, 0.006)  # m of cable
CLOSING = (0.35, 0.6)  # of a firm grasp, where fingers open again, and close, whatever the height
CLOSED = (0.0006, 0.003)  # m of cable short of a firm grasp
FINE = 0.0005  # m of cable, of height


def gripper_baseline(env: Any) -> Policy:
    """The policy for Gripper with ``observation="pose"``, from its observations alone.

    Args:
        env: A Gripper, bare or transformed.

    Raises:
        ValueError: If the environment observes something else.
    """
    config = env.config
    if config.observation != "pose":
        raise ValueError(
            f"the scripted policy of Gripper reads observation='pose', got {config.observation!r}; make the "
            "environment with observation='pose'"
        )
    steps = (config.move_step, config.move_step, config.up_step, config.yaw_step, config.cable_step)
    is_discrete = config.action_kind == "discrete"
    grip, low = _grasp(config)
    if is_discrete:  # whole steps of a choice
        grip = min(math.ceil(grip / config.cable_step) * config.cable_step, config.max_displacement)
    over = (0.5 * config.move_step, 0.5 * config.move_step + FINE) if is_discrete else OVER
    at_height = (0.5 * config.down_step, 0.5 * config.down_step + FINE) if is_discrete else LOW

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        told = env.decode(tensordict["observation"])
        hand, thing, error = told["hand"], told["object"], told["error"]
        cable = 0.5 * (told["cables"][..., 0] + told["cables"][..., 1])
        turn = torch.zeros_like(cable) if is_discrete else _turn(told, config.object)
        beside = thing[..., :2].abs().amax(dim=-1)
        is_over = _within(beside, over) * _within(turn.abs(), PARALLEL)
        is_between = _within(-thing[..., 2], HELD) * _within(beside, BETWEEN)
        is_low, is_open = _within(hand[..., 2] - low, at_height), _within(cable, OPEN)
        is_closing = 1.0 - _within(cable, (CLOSING[0] * grip, CLOSING[1] * grip))
        closes = is_between * torch.maximum(is_low * is_over, is_closing)
        lifts = is_between * _within(grip - cable, CLOSED)
        sinks = (1.0 - lifts) * torch.maximum(is_over * is_open, closes)
        free = 1.0 - closes
        wish = torch.stack(
            (
                free * thing[..., 0] + lifts * error[..., 0],
                free * thing[..., 1] + lifts * error[..., 1],
                sinks * (low - hand[..., 2]) + lifts * error[..., 2],
                free * turn,
                closes * grip - cable,
            ),
            dim=-1,
        )
        if is_discrete:
            return tensordict.set("action", _choice(wish, steps, hand[..., 0] < 0.0))
        scale = wish.new_tensor(steps)
        scaled = torch.where(wish < 0.0, wish / _lowered(scale, config.down_step), wish / scale).clamp(-1.0, 1.0)
        if config.cables == "each":
            scaled = torch.cat((scaled, scaled[..., 4:]), dim=-1)
        return tensordict.set("action", scaled)

    return policy


def _within(value: Tensor, bounds: tuple[float, float]) -> Tensor:
    """1 up to the first bound, 0 from the second on, linear between them."""
    return ((bounds[1] - value) / (bounds[1] - bounds[0])).clamp(0.0, 1.0)


def _grasp(config: Any) -> tuple[float, float]:
    """Cable [m] with which the fingers hold the object, and height [m] from which they meet its middle."""
    width = 0.5 * (config.width[0] + config.width[1]) * (WAIST if config.object == "figurine" else 1.0)
    touching, far, below = np.array(TOUCHING[config.finger]).T[:, ::-1]
    pull = float(np.interp(0.5 * width, far, touching)) + SQUEEZE[config.finger]
    height = 0.5 * config.object_size + float(np.interp(0.5 * width, far, below))
    return min(pull, config.max_displacement), max(height, config.hand_z[0])


def _turn(told: dict[str, Tensor], kind: str) -> Tensor:
    """How far the hand should turn [rad] to hold the object by parallel faces."""
    if kind in ("sphere", "figurine"):
        return torch.zeros_like(told["height"][..., 0])
    ex, ey = told["axes"][..., :3], told["axes"][..., 3:]
    if kind == "capsule":  # across its axis, however far it has rolled
        along = torch.linalg.cross(ex, ey)
        angle, period = torch.atan2(-along[..., 0], along[..., 1]), math.pi
    else:
        angle, period = torch.atan2(ex[..., 1], ex[..., 0]), 0.5 * math.pi
    away = angle - torch.atan2(told["yaw"][..., 0], told["yaw"][..., 1])
    return away - period * torch.round(away / period)


def _lowered(scale: Tensor, down_step: float) -> Tensor:
    """Steps of an action with that of a way down."""
    return torch.cat((scale[:2], scale.new_tensor((down_step,)), scale[3:]))


def _choice(wish: Tensor, steps: tuple[float, ...], is_left: Tensor) -> Tensor:
    """The choice that does most of a wish; the hand moves to and fro where nothing is wished, as no choice rests."""
    x, y, z, _, cable = wish.unbind(dim=-1)
    wishes = torch.stack((z, -z, x, -x, y, -y, cable, -cable), dim=-1)
    least = wish.new_tensor((0.0025, 0.0025, *[0.5 * steps[0]] * 4, *[0.5 * steps[4]] * 2))
    size = wishes / (least + 1.0e-6)
    return torch.where((size > 1.0).any(dim=-1), size.argmax(dim=-1), torch.where(is_left, 2, 3))
