"""Whole episodes of robots that touch what they move, under their hand-written policies: time of a step, and contacts.

    softwarp bench episodes --env Gripper --options object=cube --worlds 1 64 --cores 1
    softwarp bench episodes --device cuda:0 --worlds 4096 --json episodes.json

Times are of a simulation step, sub-step by sub-step of the environment with its observation and reward, without the
policy; those of the quarters of an episode tell free motion from grasps. Numbers of worlds are compared with the first
of them: how many times its throughput they have.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp
import yaml

from softwarp.envs import registry
from softwarp.policies.baselines.table import rule

from .timing import limited_cores, machine, measure_stages, save

LENGTH = {
    "Gripper": 70,
    "TrunkCup": 100,
    "BubbleMotion": 100,
    "SimpleMaze": 60,
    "Maze": 100,
    "CatheterBeam": 100,
}  # actions
QUARTERS = 4


def episode(name: str, worlds: int, device: str, stages: bool, options: dict[str, Any]) -> dict[str, Any]:
    """One episode in some worlds: record of times [ms], contacts and success."""
    env = registry.make(name, num_worlds=worlds, device=device, seed=1, **options)
    policy, now = rule(env, name), env.reset()
    env.step(policy(now))  # compiles
    now = env.reset()
    wall, contacts = [], []
    met = now["success"] & False
    with torch.no_grad():
        for _ in range(LENGTH[name]):
            action = policy(now)
            wp.synchronize_device(env.sim.device)
            begin = time.perf_counter()
            now = env.step(action)["next"]
            wp.synchronize_device(env.sim.device)
            wall.append(1e3 * (time.perf_counter() - begin) / env.action_repeat)
            contacts.append(env.sim.contact_count.float().mean().item())
            met |= now["success"]
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
        "met": float(met.float().mean()),
        "ms_quarters": [float(part.mean()) for part in np.array_split(wall, QUARTERS)],
        "contacts_quarters": [float(part.mean()) for part in np.array_split(contacts, QUARTERS)],
    }
    if stages:
        record["stages_us"] = measure_stages(env.sim, 10)
    return record


def main(arguments: Sequence[str] | None = None) -> int:
    """Time episodes and print them."""
    parser = argparse.ArgumentParser(prog="softwarp bench episodes", description=__doc__.partition("\n")[0])
    parser.add_argument("--env", nargs="+", default=list(LENGTH), choices=list(LENGTH))
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 64])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--cores", type=int, help="of the CPU to use; all without")
    parser.add_argument("--options", nargs="*", default=[], metavar="KEY=VALUE", help="of the environments")
    parser.add_argument("--stages", action="store_true", help="also the stages of a step at the end of the episode")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args(arguments)
    options = {key: yaml.safe_load(value) for key, _, value in (pair.partition("=") for pair in given.options)}
    records = []
    with limited_cores(given.cores) as cores:
        for name in given.env:
            for worlds in given.worlds:
                record = episode(name, worlds, given.device, given.stages, options)
                record |= {"scene": " ".join([name, *given.options])} | machine(given.device, cores)
                if worlds == given.worlds[0]:
                    alone = record["world_steps_per_s"]
                record["times_first"] = record["world_steps_per_s"] / alone
                records.append(record)
                show(record)
                if len(given.worlds) > 1:
                    print(f"    {record['times_first']:.2f} times the throughput of {given.worlds[0]}", flush=True)
    save(records, given.json)
    return 0


def show(record: dict[str, Any]) -> None:
    """One record on two lines, its stages below."""
    times = f"{record['ms_per_step']:.3f} ms a step (p95 {record['ms_p95']:.3f})"
    contacts = f"contacts {record['contacts']:.1f} (at most {record['contacts_max']:.0f})"
    print(
        f"{record['scene']:24s} {record['worlds']:5d} worlds, {record['nodes']} nodes: {times}, "
        f"{record['world_steps_per_s']:.0f} world-steps/s, {contacts}, success {record['success']:.2f}, "
        f"in some action {record['met']:.2f}",
        flush=True,
    )
    quarters = zip(record["ms_quarters"], record["contacts_quarters"], strict=True)
    print("    by quarter: " + "; ".join(f"{ms:.3f} ms, {count:.0f} contacts" for ms, count in quarters), flush=True)
    for name, value in list(record.get("stages_us", {}).items())[:10]:
        print(f"    {name:22s} {value:9.1f} us per world-step")


if __name__ == "__main__":
    raise SystemExit(main())
