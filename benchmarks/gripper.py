"""Whole grasp episodes of Gripper under its hand-written policy: time of a step, and contacts, by phase.

    python -m benchmarks.gripper --worlds 1 64 --cores 1 --json grasp.json

An episode's first 70 actions take the hand down to the object, close it, and lift; in those that follow it holds.
Times are of a simulation step, sub-step by sub-step of the environment without its policy.
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from softwarp.envs import registry
from softwarp.policies.baselines.table import rule

from .timing import limited_cores, machine, measure_stages, save

PHASES = {"down": (0, 18), "close": (18, 24), "lift": (24, 40), "hold": (40, 70)}  # actions


def episode(worlds: int, device: str, stages: bool, **options: Any) -> dict[str, Any]:
    """One episode in some worlds: record of times [ms], contacts and success."""
    env = registry.make("Gripper", num_worlds=worlds, device=device, seed=1, **options)
    policy, now = rule(env, "Gripper"), env.reset()
    env.step(policy(now))  # compiles
    now = env.reset()
    wall, contacts = [], []
    with torch.no_grad():
        for _ in range(max(end for _, end in PHASES.values())):
            action = policy(now)
            begin = time.perf_counter()
            now = env.step(action)["next"]
            wall.append(1e3 * (time.perf_counter() - begin) / env.action_repeat)
            contacts.append(env.sim.contact_count.float().mean().item())
    record: dict[str, Any] = {
        "worlds": worlds,
        "nodes": env.sim.model.node_count,
        "ms_per_step": statistics.fmean(wall),
        "ms_p95": float(np.percentile(wall, 95)),
        "world_steps_per_s": 1e3 * worlds / statistics.fmean(wall),
        "contacts": statistics.fmean(contacts),
        "contacts_max": max(contacts),
        "overflow": int(env.sim.contact_overflow.max()),
        "success": float(now["success"].float().mean()),
    }
    for name, (begin_at, end) in PHASES.items():
        record[f"ms_{name}"] = statistics.fmean(wall[begin_at:end])
        record[f"contacts_{name}"] = statistics.fmean(contacts[begin_at:end])
    if stages:
        record["stages_us"] = measure_stages(env.sim, 10)
    return record


def main() -> None:
    """Time episodes and print them."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 64])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--cores", type=int, help="of the CPU to use; all without")
    parser.add_argument("--objects", nargs="+", default=["soft_cube", "cube"])
    parser.add_argument("--fingers", nargs="+", default=["cavities", "plain"])
    parser.add_argument("--stages", action="store_true", help="also the stages of a step in the closed hand")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    records = []
    with limited_cores(given.cores) as cores:
        for worlds in given.worlds:
            for finger in given.fingers:
                for thing in given.objects:
                    record = episode(worlds, given.device, given.stages, object=thing, finger=finger)
                    record |= {"scene": f"grasp, {finger} fingers, {thing}"} | machine(given.device, cores)
                    records.append(record)
                    show(record)
    save(records, given.json)


def show(record: dict[str, Any]) -> None:
    """One record on two lines, its stages below."""
    times = f"{record['ms_per_step']:.2f} ms a step (p95 {record['ms_p95']:.2f})"
    contacts = f"contacts {record['contacts']:.1f} (at most {record['contacts_max']:.0f})"
    print(
        f"{record['scene']:36s} {record['worlds']:5d} worlds, {record['nodes']} nodes: {times}, "
        f"{record['world_steps_per_s']:.0f} world-steps/s, {contacts}, success {record['success']:.2f}",
        flush=True,
    )
    phases = (f"{name} {record[f'ms_{name}']:.2f} ms, {record[f'contacts_{name}']:.0f} contacts" for name in PHASES)
    print("         " + ";  ".join(phases), flush=True)
    for name, value in list(record.get("stages_us", {}).items())[:10]:
        print(f"         {name:22s} {value:9.1f} us per world-step")


if __name__ == "__main__":
    main()
