"""The table of hand-written policies: environment -> names and functions that make the policy for one environment.

Each takes the environment, bare or transformed, and gives a policy that works from observations alone. ``scripted`` is
the best one known; ``direct`` does at every moment what brings the effector nearer, as local inverse control does.
Classes of other packages hold theirs as ``policies``.
"""

from collections.abc import Callable
from typing import Any

from softwarp.policies.baselines.bubble_motion import bubble_baseline
from softwarp.policies.baselines.cart import (
    cart_pole_feedback,
    cart_stem_feedback,
    stem_contact_direct,
    stem_contact_lean,
)
from softwarp.policies.baselines.catch_the_object import catch_baseline
from softwarp.policies.baselines.catheter_beam import catheter_baseline
from softwarp.policies.baselines.concentric_tubes import tube_baseline
from softwarp.policies.baselines.diamond import diamond_baseline
from softwarp.policies.baselines.gripper import gripper_baseline
from softwarp.policies.baselines.maze import tripod_maze_baseline
from softwarp.policies.baselines.multi_gait import multi_gait_baseline
from softwarp.policies.baselines.names import unknown_rule
from softwarp.policies.baselines.scripted import Policy
from softwarp.policies.baselines.simple_maze import maze_baseline
from softwarp.policies.baselines.stem_pendulum import pendulum_baseline
from softwarp.policies.baselines.trunk import trunk_baseline
from softwarp.policies.baselines.trunk_cup import trunk_cup_hold, trunk_cup_lookup, trunk_cup_servo

RULES: dict[str, dict[str, Callable[[Any], Policy]]] = {
    "Trunk": {"scripted": trunk_baseline},
    "CartStem": {"scripted": cart_stem_feedback},
    "CartStemContact": {"scripted": stem_contact_lean, "direct": stem_contact_direct},
    "CatchTheObject": {"scripted": catch_baseline},
    "CartPole": {"scripted": cart_pole_feedback},
    "StemPendulum": {"scripted": pendulum_baseline},
    "Gripper": {"scripted": gripper_baseline},
    "Diamond": {"scripted": diamond_baseline},
    "BubbleMotion": {"scripted": bubble_baseline},
    "TrunkCup": {"scripted": trunk_cup_servo, "lookup": trunk_cup_lookup, "hold": trunk_cup_hold},
    "SimpleMaze": {"scripted": maze_baseline},
    "Maze": {"scripted": tripod_maze_baseline},
    "CatheterBeam": {"scripted": catheter_baseline},
    "ConcentricTubeRobot": {"scripted": tube_baseline},
    "MultiGaitFull": {"scripted": multi_gait_baseline},
    "MultiGaitReduced": {"scripted": multi_gait_baseline},
}


def rule(env: Any, name: str, kind: str = "scripted") -> Policy:
    """The hand-written policy ``kind`` for the environment ``name``.

    Raises:
        ValueError: If there is none; the message lists those that there are.
    """
    rules = RULES.get(name) or getattr(env, "policies", {})
    if kind not in rules:
        raise ValueError(unknown_rule(name, kind, rules))
    return rules[kind](env)
