"""A hand-written policy for SimpleMaze: tilt the maze along the shortest way."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase

from softwarp.policies.baselines.scripted import Policy

STIFFNESS, DAMPING = 9.0, 0.9  # tilt [rad] per m to the next place, and per m/s of the ball
AHEAD = 0.3  # weight of the place after the next
LOOK = 0.2  # s, the way is that from where the ball will be then


def maze_baseline(env: Any) -> Policy:
    """The policy for SimpleMaze, from its observations alone.

    Continuous actions tilt towards the next place where the way turns, less what the ball's velocity asks for. Of the
    discrete tilts, each of which pulls along both axes, the legal one counts that points best along the next stretch
    and the one after.

    Args:
        env: A SimpleMaze, bare or transformed, with observations of its state.

    Raises:
        ValueError: If observations are the paper's, which hold no velocity.
    """
    env.decode(torch.zeros(1, 19))  # refuses what cannot be read
    most, kind = env.config.max_tilt, env.config.action_kind
    tilts = torch.tensor(env.tilts)

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        seen = env.decode(tensordict["observation"])
        if kind == "continuous":
            wanted = STIFFNESS * seen["first"] - DAMPING * seen["ball_v"]
            return tensordict.set("action", (wanted / most).clamp(-1.0, 1.0))
        after = seen["second"] - seen["first"]
        way = seen["first"] + AHEAD * after - LOOK * seen["ball_v"]
        score = way @ tilts.to(way).T
        if "action_mask" in tensordict.keys():  # noqa: SIM118 (a TensorDict is no dictionary)
            score = score.masked_fill(~tensordict["action_mask"], float("-inf"))
        return tensordict.set("action", score.argmax(dim=-1))

    return policy
