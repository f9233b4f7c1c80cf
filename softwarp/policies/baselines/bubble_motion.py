"""A hand-written policy for BubbleMotion: tilt the floor, high behind the ball and low before it."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from softwarp.meshing.board_geometry import PITCH, chamber_centres
from softwarp.policies.baselines.scripted import Policy

LEVEL = 75.6e3  # Pa, at which a chamber carries the ball as high as the walls do
TILT = 1.05e6  # Pa from a chamber to the next along the way
BRAKE = 0.182  # s, the way is that to the goal less what the ball rolls in this time
AHEAD = 0.066  # s, after which the ball is looked at
FULL_WAY = 0.051  # m, from which on the floor is tilted as far as it can be
LEAST = 0.08  # part of it that it is tilted by at least
PUSH = 1.8e-3  # m along the way, where a ball at rest is taken to be
SLOW = 0.016  # m/s, well above which a ball is taken to be where it is
_SMALLEST = 1.0e-9  # m


def bubble_baseline(env: Any) -> Policy:
    """The policy for BubbleMotion, from its observations alone.

    Pressures are a plane that falls along the way to go, cut off at both ends: chambers behind the ball are full, those
    before it empty, and one that the ball is on lifts it as soon as it has passed the middle. A ball at rest is looked
    for a little ahead, so that one in the very middle of a chamber or between two starts to roll. Discrete actions fill
    the one near the ball that should be fullest, if any. Constants are from a search by cross-entropy over 13 x 8192
    episodes; in 8192 others 95.8 % reach their goals.

    Args:
        env: A BubbleMotion, bare or transformed, with observations of its state.

    Raises:
        ValueError: If observations are the paper's, which hold no velocity.
    """
    env.decode(torch.zeros(1, 19))  # refuses what cannot be read
    largest, kind = env.config.max_pressure, env.config.action_kind
    centres = torch.tensor(chamber_centres(), dtype=torch.float32)

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        seen = env.decode(tensordict["observation"])
        velocity = seen["ball_v"]
        way = seen["goal"] - seen["ball"] - (AHEAD + BRAKE) * velocity
        length = torch.linalg.vector_norm(way, dim=-1, keepdim=True)
        along = way / length.clamp_min(_SMALLEST)
        resting = (-(velocity / SLOW).square().sum(dim=-1, keepdim=True)).exp()
        at = seen["ball"] + AHEAD * velocity + PUSH * resting * along
        slope = along * (length / FULL_WAY).clamp(LEAST, 1.0)
        before = ((centres.to(way) - at[..., None, :]) * slope[..., None, :]).sum(dim=-1)
        wanted: Tensor = (LEVEL - 2.0 * TILT * before / PITCH).clamp(0.0, largest)
        if kind == "discrete":
            near = (-((centres.to(way) - at[..., None, :]) / PITCH).square().sum(dim=-1)).exp()
            none = torch.zeros_like(near[..., :1])
            return tensordict.set("action", torch.cat(((wanted - LEVEL) * near, none), dim=-1).argmax(dim=-1))
        return tensordict.set("action", 2.0 * wanted / largest - 1.0)

    return policy
