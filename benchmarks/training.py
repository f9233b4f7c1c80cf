"""Throughput of whole training runs: environment, policy and update together, and the share of each.

    softwarp bench training
    softwarp bench training --worlds 4096 --device cuda:0 --json training.json
    softwarp bench training --presets fast/cartstem --set algo.minibatches=8

Takes the fast preset of every task, with its own number of worlds unless told otherwise, makes a few updates (a rollout
and what is learned from it), then times ``--updates`` more. The shares come from further updates in which every part is
waited for: the simulation, the rest of the environment (observation, reward, reset), the policy with the bookkeeping
of the rollout, and the update.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
import warp as wp

from softwarp import cli
from softwarp.envs import registry
from softwarp.io.atomic import write_text
from softwarp.training.algorithms import make_algorithm

from .timing import machine

PRESETS = ("fast/cartstem", "fast/cartstemcontact", "fast/catchtheobject")
WARM_UP = 2  # updates, the first of which compile and record


class Parts:
    """Seconds spent in methods of objects, each call waited for."""

    def __init__(self, device: str) -> None:
        self.device = device
        self.seconds: dict[str, float] = {}

    def watch(self, owner: Any, method: str, part: str) -> None:
        """Count the time of a method from now on."""
        original: Callable[..., Any] = getattr(owner, method)
        self.seconds.setdefault(part, 0.0)

        def run(*args: Any, **kwargs: Any) -> Any:
            wp.synchronize_device(self.device)
            start = time.perf_counter()
            result = original(*args, **kwargs)
            wp.synchronize_device(self.device)
            self.seconds[part] += time.perf_counter() - start
            return result

        setattr(owner, method, run)


def shares(algorithm: Any, env: Any, device: str, updates: int) -> dict[str, float]:
    """What parts of the time of an update go where.

    A captured step cannot be taken apart: the simulation in it is timed in steps that are launched part by part.
    """
    parts, simulated = Parts(device), Parts(device)
    parts.watch(env, "step_and_reset", "environment")
    parts.watch(algorithm, "collect", "rollout")
    parts.watch(algorithm, "learn", "update")
    for _ in range(updates):
        algorithm.update(0.0)
    seconds = dict(parts.seconds)
    env.captures.are_on = False
    simulated.watch(env.sim, "step", "simulation")
    for _ in range(updates):
        algorithm.update(0.0)
    simulation = simulated.seconds["simulation"]
    total = seconds["rollout"] + seconds["update"]
    return {
        "simulation": simulation / total,
        "rest of the environment": (seconds["environment"] - simulation) / total,
        "policy": (seconds["rollout"] - seconds["environment"]) / total,
        "update": seconds["update"] / total,
    }


def measure(preset: str, settings: list[str], worlds: int | None, device: str, updates: int) -> dict[str, Any]:
    """Environment steps per second and shares of one preset."""
    overrides = [f"experiment={preset}", f"device={device}", *settings]
    if worlds is not None:
        overrides.append(f"num_worlds={worlds}")
    experiment = cli.experiment("config")
    config = experiment.compose("train", experiment.TrainConfig, overrides)
    torch.manual_seed(0)
    name, env_config = experiment.make_env_config(config.env)
    env = registry.make(name, num_worlds=config.num_worlds, device=device, seed=0, config=env_config)
    algorithm = make_algorithm(env, config.network, config.algo)
    rollout = algorithm.rollout
    start = time.perf_counter()
    for _ in range(WARM_UP):
        algorithm.update(0.0)
    warm_up = getattr(config.algo, "warmup_steps", 0)
    while rollout.steps < warm_up:  # random actions, nothing learned
        algorithm.update(0.0)
    wp.synchronize_device(device)
    warm = time.perf_counter() - start
    samples = []
    for _ in range(updates):
        start = time.perf_counter()
        algorithm.update(0.0)
        wp.synchronize_device(device)
        samples.append(time.perf_counter() - start)
    per_update = config.num_worlds * config.algo.horizon
    record = {
        "scene": f"training {name}, {config.algo.name}",
        "preset": preset,
        "worlds": config.num_worlds,
        "horizon": config.algo.horizon,
        "substeps": env.action_repeat,
        "env_steps_per_s": per_update / statistics.median(samples),
        "warm_up_s": warm,
        "failed_worlds": int((env.sim.status >= 3).sum()),
    }
    record["shares"] = shares(algorithm, env, device, max(2, updates // 2))
    return record


def main(arguments: Sequence[str]) -> int:
    """Measure, print and record."""
    parser = argparse.ArgumentParser(
        prog="softwarp bench training", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--presets", nargs="+", default=list(PRESETS), help="names below hydra_configs/experiment")
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="settings as for softwarp train")
    parser.add_argument("--worlds", type=int, default=None)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--updates", type=int, default=5)
    parser.add_argument("--json", type=Path, default=None)
    args = parser.parse_args(arguments)
    records = []
    for preset in args.presets:
        record = measure(preset, args.set, args.worlds, args.device, args.updates) | machine(args.device)
        shares = ", ".join(f"{name} {100.0 * share:.0f} %" for name, share in record["shares"].items())
        print(
            f"{record['scene']:32s} {record['worlds']:6d} worlds: {record['env_steps_per_s']:9.0f} env-steps/s of "
            f"{record['substeps']} sub-steps; {shares}",
            flush=True,
        )
        records.append(record)
        if args.json is not None:
            write_text(args.json, json.dumps(records, indent=1))
    return 0
