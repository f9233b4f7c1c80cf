"""Hand-written policies for the carts: linear feedback that balances, and a direct approach that gets stuck."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import torch
from tensordict import TensorDictBase
from torch import Tensor

Policy: TypeAlias = Callable[[TensorDictBase], TensorDictBase]  # reads "observation", writes "action"

STEM_GAINS = (0.005, 1.0, 0.04, 0.2)  # m per unit of cart x [m], offset [m], cart speed [m/s], offset's speed [m/s]
FULL_FORCE = 0.0005  # m, weighted offset from which the cart is pushed with all force
BENT = 0.001  # m, offset of the tip from which the stem must be touching an obstacle
BENT_GAIN = 3.5  # how much farther than the cart, and the other way, the tip of a leaning stem moves
STEM_CONTACT_SPEEDS = (-1.0, -0.2, -0.04, 0.0, 0.04, 0.2, 1.0)  # of discrete actions, as in envs/cart_stem_contact.py
FULL_STEP = 1.0  # m, more than the cart can move in an action


def cart_stem_feedback(env: Any) -> Policy:
    """Push the cart towards the side on which the sphere is, or soon will be.

    Linear in the state and saturated; discrete actions take the sign of the force alone. The cart's own place and speed
    count little, just enough to keep it on its rails.

    Args:
        env: A CartStem, bare or transformed.
    """
    gains = torch.tensor(STEM_GAINS)

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        state = env.decode(tensordict["observation"])
        return tensordict.set("action", _pushed(env, state @ gains.to(state) / FULL_FORCE))

    return policy


def _pushed(env: Any, force: Tensor) -> Tensor:
    """Action for a force towards +x, 1 being all that there is."""
    if env.config.action_kind == "discrete":
        return (force < 0.0).to(torch.int64)
    return force.clamp(-1.0, 1.0)[..., None]


def stem_contact_direct(env: Any) -> Policy:
    """Move the cart whichever way brings the tip nearer to its goal now, as local inverse control does.

    The tip follows the cart while the stem is straight and goes the other way while an obstacle bends it. Knowing that,
    the cart drives towards a goal behind an obstacle until the stem touches it, and stays there: either way would take
    the tip farther from the goal.

    Args:
        env: A CartStemContact, bare or transformed.
    """

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        cart, tip, left, right, goal = env.decode(tensordict["observation"]).unbind(dim=-1)
        error = goal - tip
        is_bent = (tip - cart).abs() > BENT
        way = torch.where(is_bent, -error / BENT_GAIN, error)
        return tensordict.set("action", _driven(env, cart, way, torch.maximum(-left, right)))

    return policy


def stem_contact_lean(env: Any) -> Policy:
    """Lean the stem on the obstacle opposite to the goal if the goal lies behind the near one; else go there directly.

    Args:
        env: A CartStemContact, bare or transformed.
    """

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        cart, tip, left, right, goal = env.decode(tensordict["observation"]).unbind(dim=-1)
        error = goal - tip
        is_left = goal - left < right - goal
        behind = torch.minimum(goal - left, right - goal) < env.config.reach
        is_bent = (tip - cart).abs() > BENT
        towards_other = torch.where(is_left, 1.0, -1.0) * FULL_STEP
        lean = torch.where(is_bent, -error / BENT_GAIN, towards_other)
        way = torch.where(behind, lean, error)
        return tensordict.set("action", _driven(env, cart, way, torch.maximum(-left, right)))

    return policy


def _driven(env: Any, cart: Tensor, way: Tensor, outermost: Tensor) -> Tensor:
    """Action that moves the cart a way [m] during one action; obstacles' outermost place gives its limits [m]."""
    kind = env.config.action_kind
    if kind == "absolute":
        return ((cart + way) / (outermost + 0.01)).clamp(-1.0, 1.0)[..., None]
    step = env.config.max_speed * env.control_dt
    if kind == "continuous":
        return (way / step).clamp(-1.0, 1.0)[..., None]
    choices = torch.tensor(STEM_CONTACT_SPEEDS, device=way.device) * step
    return (way[..., None] - choices).abs().argmin(dim=-1)
