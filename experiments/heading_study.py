"""The quadruped turned to headings: the hand-written wave and learned policies, on the reduced and the full model.

    python -m experiments.heading_study                         # the hand-written wave alone
    python -m experiments.heading_study RUN ... --device cuda:0 # beside trained policies
    python -m experiments.heading_study RUN ... --models reduced --actions 60 --json headings.json

``softwarp train experiment=fast/multigaitturning`` trains a policy, on MultiGaitReduced. It takes its most likely
actions here, from rest, on either model, which has the options that it was trained with.
"""

import argparse
import dataclasses
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from softwarp import notices
from softwarp.envs import registry
from softwarp.io.atomic import prove_writable, write_text
from softwarp.model.codes import Status
from softwarp.policies.baselines.multi_gait import multi_gait_baseline

from .config import TrainConfig, compose
from .eval import check_fit, load_run
from .gait_search import ROBOTS, SEED

HAND = "hand-written"
PRESET = "fast/multigaitturning"
LARGEST = 20.0  # degrees, of the headings that are asked for


@dataclass(frozen=True)
class Turn:
    """One policy on one model, all headings side by side.

    Attributes:
        policy: Which.
        robot: "reduced" or "full".
        left: What is left to turn after every action, from the start on, a list per heading [degree].
        way: Of the robot's middle from its start at the end, per heading [mm].
        failed: Whether a simulation failed, per heading.
    """

    policy: str
    robot: str
    left: list[list[float]]
    way: list[float]
    failed: list[bool]

    def arrivals(self, tolerance: float) -> list[int | None]:
        """Actions after which each heading stays within a tolerance [degree]; None if it does not at the end."""
        found: list[int | None] = []
        for left in self.left:
            outside = [number for number, value in enumerate(left) if abs(value) > tolerance]
            first = outside[-1] + 1 if outside else 0
            found.append(first if first < len(left) else None)
        return found


@torch.no_grad()
def turn(name: str, robot: str, env: Any, policy: Callable[..., Any], headings: Tensor, actions: int) -> Turn:
    """Let a policy turn a robot to all headings at once, a world each.

    Args:
        name: Of the policy, kept.
        robot: "reduced" or "full", kept.
        env: Its environment, goals="headings", with as many worlds as there are headings and longer episodes.
        policy: Writes "action" into what it is given.
        headings: To which [rad], shape (world,).
        actions: How many.
    """
    state = env.reset()
    env.goal.copy_(headings)
    start, state = env.position().clone(), state.update(env.observe())
    left, failed = [env.left_to_turn().rad2deg()], torch.zeros_like(headings, dtype=torch.bool)
    for number in range(actions):
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            chosen = policy(TensorDict(state.exclude("action"), batch_size=env.batch_size))["action"]
        state = env.step(state.exclude("next").set("action", chosen))["next"]
        failed |= state["world_status"][:, 0] >= Status.NONFINITE
        left.append(env.left_to_turn().rad2deg())
        notices.progress(f"{name}, {robot} model", f"action {number + 1} of {actions}")
    notices.progress_ends()
    way = 1e3 * torch.linalg.vector_norm((env.position() - start)[:, :2], dim=1)
    return Turn(name, robot, torch.stack(left, dim=1).tolist(), way.tolist(), failed.tolist())


def environment(robot: str, options: dict[str, Any], worlds: int, actions: int, device: str) -> Any:
    """A robot with those of the options that it has, whose episodes are longer than the actions."""
    kind = registry.spec(ROBOTS[robot]).config_class()
    known = {field.name for field in dataclasses.fields(kind)}
    own = {key: value for key, value in options.items() if key in known} | {"max_episode_steps": actions + 1}
    return registry.make(ROBOTS[robot], num_worlds=worlds, device=device, seed=SEED, **own)


def table(turns: Sequence[Turn], tolerance: float) -> str:
    """A line for each policy and model."""
    lines = [
        f"| policy | model | headings within {tolerance:g} degrees | after actions (median, last) | "
        "left at the end, mean [degree] | way [mm] | failed |",
        "|---|---|---|---|---|---|---|",
    ]
    for each in turns:
        arrivals = sorted(number for number in each.arrivals(tolerance) if number is not None)
        when = f"{arrivals[len(arrivals) // 2]}, {arrivals[-1]}" if arrivals else "-"
        ends = [abs(left[-1]) for left in each.left]
        cells = [
            *(each.policy, each.robot, f"{len(arrivals)} of {len(ends)}", when, f"{sum(ends) / len(ends):.1f}"),
            *(f"{sum(each.way) / len(each.way):.1f}", str(sum(each.failed))),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> list[Turn]:
    """Turn with all policies on all models and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", metavar="RUN", help="folders of trained policies")
    parser.add_argument("--models", nargs="+", choices=list(ROBOTS), default=list(ROBOTS))
    parser.add_argument("--actions", type=int, default=60)
    parser.add_argument("--headings", type=int, default=8, help=f"how many, evenly from -{LARGEST:g} to {LARGEST:g}")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--json", default="", help="file to write")
    given = parser.parse_args(argv)
    for name, least in (("actions", 1), ("headings", 2)):
        if getattr(given, name) < least:
            parser.error(f"--{name} must be at least {least}, got {getattr(given, name)}")
    if given.json:
        prove_writable(given.json)
    trained = {path: load_run(path, device=given.device, overrides=[]) for path in given.runs}
    usual = compose("train", TrainConfig, [f"experiment={PRESET}"]).env
    headings = torch.linspace(-math.radians(LARGEST), math.radians(LARGEST), given.headings, device=given.device)
    turns, tolerance = [], 10.0
    for robot in given.models:
        for path, run in {HAND: None, **trained}.items():
            options = usual if run is None else run.config.env
            env = environment(robot, options, given.headings, given.actions, given.device)
            policy = multi_gait_baseline(env) if run is None else check_fit(run, env)
            turns.append(turn(path, robot, env, policy, headings, given.actions))
            tolerance = math.degrees(env.config.heading_tolerance)
    print(table(turns, round(tolerance, 2)))
    if given.json:
        write_text(given.json, json.dumps([asdict(each) for each in turns], indent=1) + "\n")
    return turns


if __name__ == "__main__":
    with notices.telling():
        main()
