"""Hand-written policies for the carts: linear feedback that balances, and a direct approach that gets stuck."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from softwarp.policies.baselines.scripted import Policy

STEM_GAINS = (0.005, 1.0, 0.04, 0.2)  # m per unit of cart x [m], offset [m], cart speed [m/s], offset's speed [m/s]
FULL_FORCE = 0.0005  # m, weighted offset from which the cart is pushed with all force
BENT = 0.001  # m, offset of the tip from which the stem must be touching an obstacle
BENT_GAIN = 3.5  # how much farther than the cart, and the other way, the tip of a leaning stem moves
STEM_CONTACT_SPEEDS = (
    -1.0,
    -0.2,
    -0.04,
    0.0,
    0.04,
    0.2,
    1.0,
)  # of discrete actions of the task
POLE_GAINS = (10.0, 15.0, 150.0, 25.0)  # N per unit of cart x [m], its speed [m/s], angle [rad], its speed [rad/s]
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
    share: Tensor = force.clamp(-1.0, 1.0)[..., None]
    return share


def cart_pole_feedback(env: Any) -> Policy:
    """Push the cart towards the side to which the pole leans, or soon will.

    Args:
        env: A CartPole, bare or transformed.
    """
    gains = torch.tensor(POLE_GAINS)
    direction = 1.0 if env.config.force > 0.0 else -1.0

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        state = tensordict["observation"]
        force = state @ gains.to(state) / abs(env.config.force)
        return tensordict.set("action", _pushed(env, direction * force))

    return policy


def stem_contact_direct(env: Any) -> Policy:
    """Move the cart whichever way brings the tip nearer to its goal now, as local inverse control does.

    The tip follows the cart while the stem is straight and goes the other way while an obstacle bends it. So the cart
    drives towards a goal behind an obstacle until the stem touches it, and stays there: either way would take the tip
    farther from the goal.

    Args:
        env: A CartStemContact, bare or transformed.
    """

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        cart, tip, left, right, goal = env.decode(tensordict["observation"]).unbind(dim=-1)
        reach = env.config.reach
        straight = torch.minimum(torch.maximum(goal, left + reach), right - reach) - cart
        way = torch.where((tip - cart).abs() > BENT, (tip - goal) / BENT_GAIN, straight)
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
    kind, step = env.config.action_kind, env.config.max_speed * env.control_dt
    if kind == "discrete":
        choices = torch.tensor(STEM_CONTACT_SPEEDS, device=way.device) * step
        nearest: Tensor = (way[..., None] - choices).abs().argmin(dim=-1)
        return nearest
    share: Tensor = (cart + way) / (outermost + 0.01) if kind == "absolute" else way / step
    return share.clamp(-1.0, 1.0)[..., None]
