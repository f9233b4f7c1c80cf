"""Weak scaling of training over ranks: environment steps per second where every rank has as many worlds.

    softwarp bench ranks --device cuda                      # Trunk, 4096 worlds on each of 1, 2, 4, 8 GPUs
    softwarp bench ranks --ranks 1 2 --worlds 64            # gloo between processes on a CPU
    softwarp bench ranks --device cuda --set env=gripper    # settings as for softwarp train

For each number of ranks the launcher of ``softwarp train distributed.ranks=N`` starts them; they make ``--warm-up``
updates (a rollout and what is learned from it), then at least ``--updates`` more, for ``--seconds``. PPO takes all its
epochs (``algo.target_kl=0``), so that all do the same work. What ranks exchange is timed alone: the all-reduce of the
gradients, and a number told from host to host, which is what a vote costs where nobody is late. On CPUs every rank is
kept to its share of the cores, also where there is one: its share of the largest number. docs/scale.md has the model
that the constants go into.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
import warp as wp

from softwarp import cli
from softwarp.envs import registry
from softwarp.io.atomic import write_text
from softwarp.training import ranks as company
from softwarp.training.algorithms import make_algorithm
from softwarp.training.options import DistributedConfig

from .timing import machine

EXCHANGES = 50  # of which the median is told
WORLDS = {"cpu": 64, "cuda": 4096}


def main(arguments: Sequence[str]) -> int:
    """Measure every number of ranks, or one rank of them; print and record."""
    args = parse(arguments)
    if args.worker is not None:
        return work(args)
    kind = "cuda" if args.device.startswith("cuda") else "cpu"
    most = torch.cuda.device_count() if kind == "cuda" else len(os.sched_getaffinity(0))
    counts = args.ranks or [count for count in (1, 2, 4, 8) if count <= most]
    if max(counts) > most and kind == "cuda":
        raise ValueError(f"--ranks {max(counts)}: this machine has {most} GPUs")
    records: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for count in counts:
            out = Path(folder) / f"{count}.json"
            told = [*arguments, "--worker", str(out), "--share", str(max(counts))]
            code = cli.experiment("launch").launch(["bench", "ranks", *told], DistributedConfig(ranks=count))
            if code:
                return int(code)
            record = json.loads(out.read_text(encoding="utf-8"))
            base = records[0] if records else record
            of_rank = [part["env_steps_per_s"] / part["ranks"] for part in (record, base)]
            record["efficiency"] = of_rank[0] / of_rank[1]
            records.append(record)
            print(sentence(record), file=sys.stderr, flush=True)
            if args.json is not None:
                write_text(args.json, json.dumps(records, indent=1) + "\n")
    print(json.dumps({"machine": machine(args.device), "ranks": [rounded(record) for record in records]}))
    return 0


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Options."""
    parser = argparse.ArgumentParser(
        prog="softwarp bench ranks", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--ranks", type=int, nargs="+", help="numbers of them, the first of which is compared with")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--worlds", type=int, help=f"of each rank; {WORLDS['cpu']} on a CPU, {WORLDS['cuda']} on a GPU")
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="settings as for softwarp train")
    parser.add_argument("--warm-up", type=int, default=2, help="updates before the timed ones")
    parser.add_argument("--updates", type=int, default=3, help="timed updates, at least")
    parser.add_argument("--seconds", type=float, default=20.0, help="of timed updates, at least")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the records there")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--share", type=int, default=1, help=argparse.SUPPRESS)
    args = parser.parse_args(arguments)
    for name in ("warm_up", "updates"):
        if getattr(args, name) < 1:
            parser.error(f"--{name.replace('_', '-')} must be at least 1, got {getattr(args, name)}")
    return args


def work(args: argparse.Namespace) -> int:
    """One rank: train, time, and on rank 0 write the record."""
    ranks = company.join()
    device = registry.check_device(company.own_device(args.device))
    is_cuda = device.startswith("cuda")
    if not is_cuda:
        keep_to_share(ranks.local, args.share)
    experiment = cli.experiment("config")
    worlds = args.worlds or WORLDS["cuda" if is_cuda else "cpu"]
    whole = [] if any(text.startswith("algo=") for text in args.set) else ["algo.target_kl=0"]
    overrides = ["env=trunk", "algo=ppo", *whole, *args.set, f"num_worlds={worlds}"]
    config = experiment.compose("train", experiment.TrainConfig, overrides)
    seed = ranks.seed(config.seed)
    torch.manual_seed(seed)
    name, env_config = experiment.make_env_config(config.env)
    start = time.perf_counter()
    env = registry.make(name, num_worlds=worlds, device=device, seed=seed, config=env_config)
    algorithm = make_algorithm(env, config.network, config.algo, ranks)
    algorithm.feel(lambda: ranks.vote(0) and None)  # as the training loop does after every step
    for _ in range(args.warm_up):
        algorithm.update(0.0)
    while algorithm.rollout.steps < getattr(config.algo, "warmup_steps", 0):
        algorithm.update(0.0)
    wp.synchronize_device(device)
    warm = time.perf_counter() - start
    counted = Counted(ranks)
    algorithm.ranks = counted
    rollouts, lessons, failed = [], [], int(algorithm.rollout.failures)
    begin = time.perf_counter()
    while ranks.told(len(lessons) < args.updates or time.perf_counter() - begin < args.seconds):
        first = time.perf_counter()
        data = algorithm.collect()
        wp.synchronize_device(device)
        middle = time.perf_counter()
        algorithm.learn(data)
        wp.synchronize_device(device)
        rollouts.append(middle - first)
        lessons.append(time.perf_counter() - middle)
    slowest = ranks.gather(torch.tensor([rollouts, lessons], device=device, dtype=torch.float64)).cpu()
    both = [float(part) for part in slowest.sum(1).amax(0)]
    steps = worlds * config.algo.horizon * ranks.size
    record = {
        "env": name,
        "algo": config.algo.name,
        "ranks": ranks.size,
        "worlds": worlds,
        "horizon": config.algo.horizon,
        "updates": len(lessons),
        "env_steps_per_s": steps / statistics.median(both),
        "env_steps_per_s_range": [steps / max(both), steps / min(both)],
        "rollout_s": statistics.median(rollouts),
        "learn_s": statistics.median(lessons),
        "rollout_spread": float(slowest[:, 0].amax(0).sub(slowest[:, 0].amin(0)).median()),
        "reduces_per_update": counted.calls / len(lessons),
        "bytes_per_update": counted.bytes / len(lessons),
        "reduce_us": exchange_us(lambda: ranks.average([counted.example(device)]), device),
        "told_us": exchange_us(lambda: ranks.told(0.0), device),
        "warm_up_s": warm,
        "failed_worlds": int(ranks.gather(algorithm.rollout.failures - failed).sum()),
    }
    if is_cuda:
        free, whole = torch.cuda.mem_get_info(device)
        record["memory_GB"] = (whole - free) / 1e9
    if ranks.is_first:
        write_text(args.worker, json.dumps(record))
    ranks.close()
    return 0


class Counted(company.Ranks):
    """Ranks whose averages of gradients are counted."""

    def __init__(self, ranks: company.Ranks) -> None:
        self.ranks = ranks
        self.rank, self.size, self.local = ranks.rank, ranks.size, ranks.local
        self.calls = self.bytes = self.largest = 0
        for name in ("gather", "mean", "mean_and_spread", "vote", "most", "told"):
            setattr(self, name, getattr(ranks, name))

    def average(self, parts: Sequence[torch.Tensor]) -> None:
        """Average and count."""
        size = sum(part.numel() for part in parts)
        self.calls += 1
        self.bytes += 4 * size
        self.largest = max(self.largest, size)
        self.ranks.average(parts)

    def example(self, device: str) -> torch.Tensor:
        """Numbers as many as in a gradient."""
        return torch.zeros(max(self.largest, 1), device=device)


def exchange_us(exchange: Callable[[], object], device: str) -> float:
    """Median microseconds of an exchange, each waited for."""
    samples = []
    for _ in range(EXCHANGES):
        wp.synchronize_device(device)
        start = time.perf_counter()
        exchange()
        wp.synchronize_device(device)
        samples.append(time.perf_counter() - start)
    return 1e6 * statistics.median(samples)


def keep_to_share(local: int, share: int) -> None:
    """Keep this process to one of ``share`` equal parts of the cores, where there are as many."""
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) >= share:
        own = cores[local * len(cores) // share : (local + 1) * len(cores) // share]
        os.sched_setaffinity(0, own)
        torch.set_num_threads(len(own))


def rounded(record: dict[str, Any]) -> dict[str, Any]:
    """Four digits of every number."""

    def short(value: Any) -> Any:
        if isinstance(value, list):
            return [short(part) for part in value]
        return float(f"{value:.4g}") if isinstance(value, float) else value

    return {key: short(value) for key, value in record.items()}


def sentence(record: dict[str, Any]) -> str:
    """A record in a line."""
    speed = f"{record['env_steps_per_s']:,.0f} env-steps/s"
    return (
        f"{record['env']}, {record['ranks']} x {record['worlds']} worlds: {speed}, "
        f"{100.0 * record['efficiency']:.1f} % of linear; rollout {record['rollout_s']:.2f} s, learning "
        f"{record['learn_s']:.2f} s, {record['reduces_per_update']:.0f} all-reduces of {record['reduce_us']:.0f} us"
    )
