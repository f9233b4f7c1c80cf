"""Time of inverse control: one call of the controller, and the simulation of the period between two calls.

    python -m benchmarks.inverse
    python -m benchmarks.inverse --tasks Diamond --worlds 4096 --device cuda:0 --json inverse.json

Every world has a target of its own, seen in equilibrium; after a warm-up the periods are timed one by one. Records tell
how far the tips are from their targets at the end, so that a speed is that of a controller that works.
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

from softwarp.control import InversePolicy, Outcome
from softwarp.envs import registry

from .timing import array_bytes, machine, save

TASKS = ("Diamond", "Trunk")
WORLDS = {"cpu": (1, 32), "cuda": (1, 64, 4096)}


def measure(task: str, worlds: int, device: str, periods: int, warm_up: int) -> dict[str, Any]:
    """One record: medians of the times [ms], control calls and simulated steps per second of all worlds together."""
    env = registry.make(task, num_worlds=worlds, device=device, seed=0, goal_split="all", goal_jitter=0.0)
    env.reset()
    controller = InversePolicy(env).controller
    control, simulation = [], []
    for period in range(warm_up + periods):
        wp.synchronize_device(device)
        begin = time.perf_counter()
        solution = controller.solve(env.goal)
        wp.synchronize_device(device)
        middle = time.perf_counter()
        env.sim.step(env.action_repeat)
        wp.synchronize_device(device)
        if period >= warm_up:
            control.append(1e3 * (middle - begin))
            simulation.append(1e3 * (time.perf_counter() - middle))
    distance = (controller.positions()[:, 0].to(torch.float64) - env.goal).norm(dim=-1)
    solve, steps = statistics.median(control), statistics.median(simulation)
    return {
        "task": task,
        "worlds": worlds,
        "nodes": env.sim.model.node_count,
        "control_ms": solve,
        "simulation_ms": steps,
        "period_ms": 1e3 * env.control_dt,
        "calls_per_s": 1e3 * worlds / solve,
        "controlled_steps_per_s": 1e3 * worlds * env.action_repeat / (solve + steps),
        "real_time": worlds * 1e3 * env.control_dt / (solve + steps),
        "median_distance_mm": 1e3 * float(distance.quantile(0.5)),
        "within_half_mm": float((distance < 0.5e-3).double().mean()),
        "failed_worlds": int((solution.outcome == Outcome.FAILED).sum()),
        "control_mb_per_world": array_bytes(controller._systems) / worlds / 1e6,
        **machine(device),
    }


def show(record: dict[str, Any]) -> None:
    """One record on one line."""
    print(
        f"{record['task']:8s} {record['worlds']:6d} worlds: control {record['control_ms']:9.3f} ms, "
        f"{record['calls_per_s']:9.0f} calls/s; with simulation {record['controlled_steps_per_s']:9.0f} world-steps/s, "
        f"{record['real_time']:.3g} times real time; {100.0 * record['within_half_mm']:.0f}% within 0.5 mm, "
        f"failed {record['failed_worlds']}",
        flush=True,
    )


def main(arguments: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Run and print; returns the records."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--worlds", nargs="+", type=int)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--periods", type=int, default=20)
    parser.add_argument("--warm-up", type=int, default=40, help="periods before those that are timed")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args(arguments)
    counts = given.worlds or WORLDS["cpu" if wp.get_device(given.device).is_cpu else "cuda"]
    records = []
    for task in given.tasks:
        for worlds in counts:
            records.append(measure(task, worlds, given.device, given.periods, given.warm_up))
            show(records[-1])
    save(records, given.json)
    return records


if __name__ == "__main__":
    main()
