"""A hand-written policy for BubbleMotion: tilt the floor, high behind the ball and low before it."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from softwarp.meshing.board_geometry import PITCH, chamber_centres
from softwarp.policies.baselines.scripted import Policy

LEVEL = 73.4e3  # Pa, at which a chamber carries the ball as high as the walls do
TILT = 1.095e6  # Pa from a chamber to the next along the way
BRAKE = 0.163  # s, the way is that to the goal less what the ball rolls in this time
PAST = 0.019  # s more of it for what rolls past the goal instead of towards it
AHEAD = 0.0705  # s, after which the ball is looked at
GAIN = 0.0165  # m/s that a full chamber, a pitch away, adds to the ball until new pressures act
FULL_WAY = 0.057  # m, from which on the floor is tilted as far as it can be
LEAST = 0.067  # part of it that it is tilted by at least
PUSH = 1.6e-3  # m along the way, where a ball at rest is taken to be
SLOW = 0.0156  # m/s, well above which a ball is taken to be where it is
BORDER = 0.0266  # m from the middle, beyond which a ball at rest may be jammed between a chamber and the rim
INWARD = 3.14  # parts of what it is beyond, by which its way leads inwards
EDGE = 0.033  # m from the middle, no farther than which the ball is taken to be
_SMALLEST = 1.0e-9  # m


def bubble_baseline(env: Any) -> Policy:
    """The policy for BubbleMotion, from its observations alone.

    Pressures are a plane that falls along the way to go, cut off at both ends: chambers behind the ball are full, those
    before it empty, and one that the ball is on lifts it as soon as it has passed the middle. A ball at rest is looked
    for a little ahead, so that one in the very middle of a chamber or between two starts to roll. One at rest beside
    the rim is held there by friction while a chamber presses on it, so its way leads inwards first. Discrete actions
    fill the one near the ball that should be fullest, if any. Constants are from a search by cross-entropy over
    5 x 8192 episodes; of 3 x 8192 others 96.9 % reach their goals.

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
        ball, centre = seen["ball"], centres.to(seen["ball"])
        off = (ball[..., None, :] - centre) / PITCH
        lifts = seen["pressure"] / largest * torch.exp(-0.5 * off.square().sum(dim=-1))
        velocity = seen["ball_v"] + GAIN * (lifts[..., None] * off).sum(dim=-2)
        to_goal = seen["goal"] - ball
        sight = to_goal / torch.linalg.vector_norm(to_goal, dim=-1, keepdim=True).clamp_min(_SMALLEST)
        past = velocity - (velocity * sight).sum(dim=-1, keepdim=True) * sight
        resting = torch.exp(-(velocity / SLOW).square().sum(dim=-1, keepdim=True))
        beyond = (ball.abs() - BORDER).clamp_min(0.0) * ball.sign()
        way = to_goal - (AHEAD + BRAKE) * velocity - PAST * past - INWARD * resting * beyond
        length = torch.linalg.vector_norm(way, dim=-1, keepdim=True)
        along = way / length.clamp_min(_SMALLEST)
        at = (ball + AHEAD * velocity).clamp(-EDGE, EDGE) + PUSH * resting * along
        slope = along * (length / FULL_WAY).clamp(LEAST, 1.0)
        before = ((centre - at[..., None, :]) * slope[..., None, :]).sum(dim=-1)
        wanted: Tensor = (LEVEL - 2.0 * TILT * before / PITCH).clamp(0.0, largest)
        if kind == "discrete":
            near = torch.exp(-((centre - at[..., None, :]) / PITCH).square().sum(dim=-1))
            none = torch.zeros_like(near[..., :1])
            return tensordict.set("action", torch.cat(((wanted - LEVEL) * near, none), dim=-1).argmax(dim=-1))
        return tensordict.set("action", 2.0 * wanted / largest - 1.0)

    return policy
