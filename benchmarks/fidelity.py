"""What a robot's fidelity costs and brings: meshes and elements, their time and their distance from truth.

    softwarp bench fidelity                                # the trunk; one world on one core, 64 on all
    softwarp bench fidelity --robots Tripod CatchTheObject
    softwarp bench fidelity --worlds 4096 --device cuda:0

Truth is the static shape of the finest affordable quadratic elements, in float64 under loads of fidelity_robots.py; for
the trunk it is ``meshing.round_trunk("fine")``, whose grooves bend as converged ones do, for the Diamond the limit of
four meshes (fidelity_truth.py). The error is the distance of
the point that is looked at over its way from the unloaded shape. Times are of steps of the whole scene in which
actuators move, variants in turns; ratios are medians over repetitions of the time over that of the default in the same
one.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

import softwarp

from .fidelity_robots import ROBOTS, Options, Robot
from .timing import limited_cores, machine, save

DRIVEN = 20  # steps before the first repetition


def build(robot: Robot, options: Options, worlds: int, device: str) -> softwarp.Simulation:
    """The scene of a variant, moved by its actuators."""
    builder = softwarp.ModelBuilder(gravity=robot.gravity)
    robot.scene(options, builder)
    sim = softwarp.Simulation(builder.finalize(worlds, device))
    for step in range(DRIVEN):
        robot.drive(sim, step)
        sim.step()
    return sim


def measured_errors(name: str) -> dict[str, list[float]]:
    """Distances from truth of all variants of a robot [%], printed as they are found."""
    robot, errors = ROBOTS[name], {}
    if isinstance(robot.truth, np.ndarray):
        _, start = robot.rest(robot.variants["default"])
        truth = start + robot.truth
    else:
        truth, start = robot.rest(robot.truth)
    way = np.linalg.norm(truth - start, axis=1)
    for variant, options in robot.variants.items():
        errors[variant] = (100.0 * np.linalg.norm(robot.rest(options)[0] - truth, axis=1) / way).round(1).tolist()
        told = ", ".join(f"{error:.1f}" for error in errors[variant])
        print(f"{name:14s} {variant:10s} off by {told} %", flush=True)
    return errors


def measure(robot: Robot, worlds: int, device: str, repeats: int) -> list[dict[str, Any]]:
    """Records of all variants: median time of a step [ms] and its ratio to that of the default."""
    sims = {name: build(robot, options, worlds, device) for name, options in robot.variants.items()}
    times: dict[str, list[float]] = {name: [] for name in robot.variants}
    steps = max(2, 40 // worlds)
    for _ in range(repeats):
        for name, sim in sims.items():
            begin = time.perf_counter()
            sim.step(steps)
            wp.synchronize_device(sim.device)
            times[name].append(1e3 * (time.perf_counter() - begin) / steps)
    return [
        {
            "variant": name,
            "worlds": worlds,
            "nodes": sims[name].model.node_count,
            "ms_per_step": statistics.median(taken),
            "world_steps_per_s": 1e3 * worlds / statistics.median(taken),
            "ratio": statistics.median(a / b for a, b in zip(taken, times["default"], strict=True)),
            "failed_worlds": int((sims[name].status > 0).sum()),
        }
        for name, taken in times.items()
    ]


def main(arguments: Sequence[str]) -> int:
    """Compare variants and print them."""
    parser = argparse.ArgumentParser(
        prog="softwarp bench fidelity", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, default=["Trunk"])
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 64])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--cores", type=int, help="of the CPU to use; one for one world, else all")
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--no-statics", action="store_true", help="times only; truth takes some minutes")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the records")
    args = parser.parse_args(arguments)
    records = []
    for name in args.robots:
        errors = {} if args.no_statics else measured_errors(name)
        for worlds in args.worlds:
            with limited_cores(args.cores or (1 if worlds == 1 else None)) as cores:
                for record in measure(ROBOTS[name], worlds, args.device, args.repeats):
                    print(
                        f"{name:14s} {record['variant']:10s} {record['nodes']:5d} nodes {worlds:5d} worlds: "
                        f"{record['ms_per_step']:8.3f} ms a step, {record['world_steps_per_s']:9.0f} world-steps/s, "
                        f"{record['ratio']:5.2f} x default",
                        flush=True,
                    )
                    told = {"robot": name, "errors_percent": errors.get(record["variant"])}
                    records.append(record | told | machine(args.device, cores))
    save(records, args.json)
    return 1 if any(record["failed_worlds"] for record in records) else 0
