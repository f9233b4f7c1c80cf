"""Whole environment steps with resets: as one CUDA graph, and launched part by part.

    softwarp bench capture --device cuda:0
    softwarp bench capture --tasks CartStem --worlds 64 1024 --json capture.json

Every step takes the same action. Beside the time of a step stands the time that the host is busy with it.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
import warp as wp

from softwarp.envs import registry

from .timing import machine, save

TASKS = ("Trunk", "CartStem", "CatchTheObject")
WARM_UP = 3  # steps, which compile and record
REPEATS = 5


def measure(task: str, worlds: int, device: str, *, capture: bool, steps: int) -> dict[str, Any]:
    """Milliseconds of ``step_and_reset``, and those of them in which the host is busy: medians of a few samples."""
    env = registry.make(task, num_worlds=worlds, device=device, seed=1, capture=capture)
    torch.manual_seed(0)
    action = env.action_spec.rand()
    for _ in range(WARM_UP):
        env.step_and_reset(action)
    whole, host = [], []
    for _ in range(REPEATS):
        wp.synchronize_device(device)
        start = time.perf_counter()
        for _ in range(steps):
            env.step_and_reset(action)
        host.append(time.perf_counter() - start)
        wp.synchronize_device(device)
        whole.append(time.perf_counter() - start)
    about = {"task": task, "worlds": worlds, "capture": capture}
    times = {"ms_per_step": statistics.median(whole), "host_ms": statistics.median(host)}
    return about | {name: 1e3 * seconds / steps for name, seconds in times.items()}


def main(arguments: Sequence[str]) -> int:
    """Measure, print and record; a CPU has no graphs of environments, only the parts."""
    parser = argparse.ArgumentParser(
        prog="softwarp bench capture", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=registry.names(), metavar="TASK")
    parser.add_argument("--worlds", type=int, nargs="+", default=[64, 4096])
    parser.add_argument("--device", default="cuda:0" if wp.get_cuda_device_count() else "cpu")
    parser.add_argument("--steps", type=int, default=20, help="of each sample")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args(arguments)
    if args.steps < 1:
        parser.error(f"--steps must be at least 1, got {args.steps}")
    ways = (False,) if wp.get_device(args.device).is_cpu else (False, True)
    records: list[dict[str, Any]] = []
    for task in args.tasks:
        for worlds in args.worlds:
            for capture in ways:
                record = measure(task, worlds, args.device, capture=capture, steps=args.steps) | machine(args.device)
                print(
                    f"{task:16s} {worlds:6d} worlds, {'one graph' if capture else 'parts':9s}: "
                    f"{record['ms_per_step']:8.3f} ms per step, host {record['host_ms']:8.3f} ms",
                    flush=True,
                )
                records.append(record)
                save(records, args.json)
    return 0
