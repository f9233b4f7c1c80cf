"""A hand-written policy for BubbleMotion: tilt the floor, high behind the ball and low before it."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from softwarp.meshing.board_geometry import PITCH, chamber_centres
from softwarp.policies.baselines.scripted import Policy

LEVEL = 79.0e3  # Pa, at which a chamber carries the ball as high as the walls do
TILT = 840.0e3  # Pa from a chamber to the next along the way
BRAKE = 0.177  # s, the way is that to the goal less what the ball rolls in this time
AHEAD = 0.041  # s, after which the ball is looked at
FULL_WAY = 0.047  # m, from which on the floor is tilted as far as it can be
_SMALLEST = 1.0e-9  # m


def bubble_baseline(env: Any) -> Policy:
    """The policy for BubbleMotion, from its observations alone.

    Pressures are a plane that falls along the way to go, cut off at both ends: chambers behind the ball are full, those
    before it empty, and one that the ball is on lifts it as soon as it has passed the middle. Discrete actions fill
    the one near the ball that should be fullest, if any.

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
        at = seen["ball"] + AHEAD * seen["ball_v"]
        way = seen["goal"] - at - BRAKE * seen["ball_v"]
        length = torch.linalg.vector_norm(way, dim=-1, keepdim=True)
        slope = way / torch.maximum(length, way.new_tensor(_SMALLEST)) * (length / FULL_WAY).clamp_max(1.0)
        before = ((centres.to(way) - at[..., None, :]) * slope[..., None, :]).sum(dim=-1)
        wanted: Tensor = (LEVEL - 2.0 * TILT * before / PITCH).clamp(0.0, largest)
        if kind == "discrete":
            near = (-((centres.to(way) - at[..., None, :]) / PITCH).square().sum(dim=-1)).exp()
            none = torch.zeros_like(near[..., :1])
            return tensordict.set("action", torch.cat(((wanted - LEVEL) * near, none), dim=-1).argmax(dim=-1))
        return tensordict.set("action", 2.0 * wanted / largest - 1.0)

    return policy
