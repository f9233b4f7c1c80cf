"""CartStemContact by goal region: what a direct approach reaches, what leaning on an obstacle does, what was learned.

    python -m experiments.goal_regions [RUN ...] --episodes 512 --json regions.json

Goals are sorted by how far inwards of their obstacle's centre they lie. Up to the obstacle's edge (and the stem's skin)
the upright stem cannot get there, so those are reached by bending it at the other obstacle, or not at all.
"""

import argparse
import functools
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from softwarp.envs import registry
from softwarp.io.atomic import prove_writable, write_text
from softwarp.policies.baselines import scripted
from softwarp.policies.baselines.table import rule
from softwarp.policies.policy import Spaces
from softwarp.training.evaluation import run_episodes

from .config import make_env_config
from .eval import check_fit, load_run

NAME = "CartStemContact"
SHARES = (0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0)  # of the way from an obstacle's centre to the reach of the upright stem
PolicyOf = Callable[[Any], scripted.Policy]


@dataclass(frozen=True)
class Row:
    """One policy's episodes by region: success rates, mean returns, numbers of episodes, and all together last."""

    success: list[float | None]
    returns: list[float | None]
    episodes: list[int]


def bounds(config: Any) -> list[float]:
    """Borders of the regions [m], inwards of an obstacle's centre; goals beyond the last border but one are open."""
    return [share * config.reach for share in SHARES] + [config.goal_depth]


def run(policy_of: PolicyOf, options: dict[str, Any], *, episodes: int, seed: int) -> Row:
    """Whole episodes of a policy, the same goals for each."""
    env: Any = registry.make(NAME, num_worlds=episodes, seed=seed, **options)
    starts: list[Tensor] = []

    def remember(data: TensorDictBase) -> None:
        if not starts:
            starts.append(env.decode(data["observation"]).clone())

    outcome = run_episodes(env, policy_of(env), seed=seed, episodes=episodes, on_step=remember)
    _, _, left, right, goal = starts[0].unbind(dim=1)
    depth = torch.minimum(goal - left, right - goal)
    region = torch.bucketize(depth, torch.tensor(bounds(env.config)[1:-1]))
    masks = [region == index for index in range(len(SHARES))] + [torch.ones_like(region, dtype=torch.bool)]
    return Row(
        [mean(outcome.success[mask]) for mask in masks],
        [mean(outcome.returns[mask]) for mask in masks],
        [int(mask.sum()) for mask in masks],
    )


def mean(values: Tensor) -> float | None:
    """None of no values."""
    return float(values.float().mean()) if len(values) else None


def table(rows: dict[str, Row], config: Any) -> str:
    """Success rates and returns as aligned text."""
    edges = [1e3 * bound for bound in bounds(config)]
    names = [f"{low:.0f}-{high:.0f} mm" for low, high in pairwise(edges)]
    names[-1] += " (open)"
    lines = [["success [%], return", *names, "all"]]
    for name, row in rows.items():
        cells = zip(row.success, row.returns, strict=True)
        lines.append([name, *("-" if s is None or r is None else f"{100.0 * s:.0f}, {r:.2f}" for s, r in cells)])
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in lines)


def main(argv: Sequence[str] | None = None) -> dict[str, Row]:
    """Run all policies and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", help="folders of trained runs, each with its own settings")
    parser.add_argument("--episodes", type=int, default=512)
    parser.add_argument("--seed", type=int, default=2_000_003, help="of starts and goals")
    parser.add_argument("--json", default="", help="file to write")
    args = parser.parse_args(argv)
    if args.episodes < 1:
        parser.error(f"--episodes must be at least 1, got {args.episodes}")
    if args.json:
        prove_writable(args.json)
    rows = {}
    plain = {"action_kind": "continuous"}
    for kind in ("direct", "scripted"):
        rows[kind] = run(functools.partial(rule, name=NAME, kind=kind), plain, episodes=args.episodes, seed=args.seed)
    rows["random"] = run(lambda env: scripted.random(Spaces.of(env)), plain, episodes=args.episodes, seed=args.seed)
    for path in args.runs:
        trained = load_run(path, device="cpu", overrides=[])
        name, config = make_env_config(trained.config.env)
        if name != NAME:
            raise ValueError(f"{path}: was trained on {name}; goal regions are those of {NAME}")
        options = {"config": config}
        rows[path] = run(functools.partial(check_fit, trained), options, episodes=args.episodes, seed=args.seed)
    print(table(rows, registry.spec(NAME).config_class()()))
    if args.json:
        write_text(args.json, json.dumps({name: vars(row) for name, row in rows.items()}, indent=2) + "\n")
    return rows


if __name__ == "__main__":
    main()
