"""A hand-written policy for Maze: tilt the maze along the shortest way, and brake the ball before it turns."""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import TensorDictBase

from softwarp.policies.baselines.scripted import Policy

STIFFNESS, DAMPING = 9.0, 1.0  # tilt [rad] per m to the next place, and per m/s of the ball
NEAREST = 0.004  # m, for which a place that is nearer counts, so that the ball does not stop before it
LEVER = 1.6  # rad of a servo per rad of tilt along its leg
LEGS = tuple(math.radians(90.0 + 120.0 * servo) for servo in range(3))  # direction of a leg from above


def tripod_maze_baseline(env: Any) -> Policy:
    """The policy for Maze, from its observations alone.

    Tilts pull towards the next place where the way turns, less what the ball's velocity asks for. Where actions are
    angles, those that would tilt the maze so, were they in proportion, are approached; a choice moves the servo that is
    farthest from its wish.

    Args:
        env: A Maze, bare or transformed, with observations of its state.

    Raises:
        ValueError: If observations are the paper's, which hold no velocity.
    """
    env.decode(torch.zeros(1, 25))  # refuses what cannot be read
    config = env.config
    most, kind, step, home = config.max_tilt, config.action_kind, config.action_step, config.angle
    legs = torch.tensor([(math.cos(angle), math.sin(angle)) for angle in LEGS])

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        seen = env.decode(tensordict["observation"])
        way = seen["first"]
        length = torch.linalg.vector_norm(way, dim=-1, keepdim=True)
        way = way * (NEAREST / length.clamp_min(1.0e-6)).clamp_min(1.0)
        tilt = (STIFFNESS * way - DAMPING * seen["ball_v"]).clamp(-most, most)
        if kind == "tilt":
            return tensordict.set("action", tilt / most)
        change = home - LEVER * tilt @ legs.to(tilt).T - seen["command"]
        if kind == "continuous":
            return tensordict.set("action", (change / step).clamp(-1.0, 1.0))
        score = torch.cat((change, -change), dim=-1)
        if "action_mask" in tensordict.keys():  # noqa: SIM118 (a TensorDict is no dictionary)
            score = score.masked_fill(~tensordict["action_mask"], -math.inf)
        return tensordict.set("action", score.argmax(dim=-1))

    return policy
