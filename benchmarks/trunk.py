"""Speed of the trunk: milliseconds per step of one world, world-steps/s of many, and where the time goes.

    python benchmarks/trunk.py --worlds 1 64 --mesh medium
    python benchmarks/trunk.py --worlds 4096 --device cuda:0 --stages

All eight cables are driven at once. A figure is the median over repetitions; the spread is given beside it. ``--mesh``
also takes a mesh file (with ``--scale``). Prints a table; ``--json`` writes the records with commit and machine.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import subprocess
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import torch
import warp as wp

import softwarp
from softwarp.envs.trunk_scene import TrunkSceneConfig, build_trunk_scene

STAGES = (
    "load",
    "scale",
    "measure_rows",
    "command",
    "forces",
    "tangent",
    "right_hand_side",
    "solve",
    "move",
    "commit",
)
SOLVER_STAGES = ("factor", "forward", "backward")


def build(mesh: str, scale: float, worlds: int, device: str, precision: str, **options: Any) -> softwarp.Simulation:
    """The Trunk environment's scene as a bare simulation."""
    builder = softwarp.ModelBuilder(gravity=(0.0, -9.81, 0.0))
    build_trunk_scene(TrunkSceneConfig(mesh=mesh, mesh_scale=scale), builder)
    return softwarp.Simulation(builder.finalize(worlds, device, precision), **options)  # type: ignore[arg-type]


def drive(sim: softwarp.Simulation, step: int) -> None:
    """Slow sines on all cables around a common pull, different in every world."""
    count = sim.num_worlds
    phase = torch.arange(count, device=sim.time.device)[:, None] * 0.1 + torch.arange(8, device=sim.time.device) * 0.8
    wave = 0.004 + 0.003 * torch.sin(phase + 0.02 * step)
    sim.control.cable_displacement[:] = wave.to(sim.control.cable_displacement.dtype)


def synchronize(device: str) -> None:
    """Wait for the GPU."""
    wp.synchronize_device(device)


def measure(sim: softwarp.Simulation, steps: int, repeats: int) -> dict[str, Any]:
    """Median seconds per step over ``repeats`` runs of ``steps``, after a warm-up that compiles and captures."""
    start = time.perf_counter()
    drive(sim, 0)
    sim.step()
    synchronize(sim.device)
    first = time.perf_counter() - start
    for step in range(5):
        drive(sim, step)
        sim.step()
    samples = []
    for repeat in range(repeats):
        drive(sim, 10 + repeat)
        synchronize(sim.device)
        start = time.perf_counter()
        for _ in range(steps):
            sim.step()
        synchronize(sim.device)
        samples.append((time.perf_counter() - start) / steps)
    median = statistics.median(samples)
    return {
        "ms_per_step": 1e3 * median,
        "ms_min": 1e3 * min(samples),
        "ms_max": 1e3 * max(samples),
        "world_steps_per_s": sim.num_worlds / median,
        "first_step_s": first,
        "failed_worlds": int((sim.status >= softwarp.Status.NONFINITE).sum()),
        "mean_tension_N": float(sim.cable_tension.mean()),
    }


def measure_stages(sim: softwarp.Simulation, steps: int) -> dict[str, float]:
    """Milliseconds per stage of an uncaptured step of the first shard, each stage waited for."""
    system = sim._systems[0]
    total: dict[str, float] = defaultdict(float)

    def timed(owner: Any, name: str, prefix: str) -> None:
        method = getattr(owner, name)

        def run(*args: Any, **kwargs: Any) -> Any:
            synchronize(sim.device)
            start = time.perf_counter()
            result = method(*args, **kwargs)
            synchronize(sim.device)
            total[prefix + name] += time.perf_counter() - start
            return result

        setattr(owner, name, run)

    for name in STAGES:
        timed(system, name, "")
    for name in SOLVER_STAGES:
        timed(system.linear, name, "solve.")
    for _ in range(steps):
        sim._steppers[0].step()
    for owner, names in ((system, STAGES), (system.linear, SOLVER_STAGES)):
        for name in names:
            delattr(owner, name)
    worlds = system.world_count
    return {name: 1e6 * seconds / steps / worlds for name, seconds in sorted(total.items(), key=lambda item: -item[1])}


def machine(device: str) -> dict[str, Any]:
    """Commit, processor and device of a record."""
    root = Path(__file__).resolve().parent
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=root, capture_output=True, text=True, check=False
    )
    return {
        "commit": commit.stdout.strip() or "unknown",
        "device": wp.get_device(device).name,
        "processor": platform.processor() or platform.machine(),
        "warp": wp.config.version,
    }


def main() -> None:
    """Measure, print and record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 64])
    parser.add_argument("--mesh", default="medium")
    parser.add_argument("--scale", type=float, default=1.0, help="metres per unit of a mesh file")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--precision", default="float32", choices=["float32", "float64"])
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--path", default="auto", choices=["auto", "scalar", "lanes"])
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--stages", action="store_true", help="also time the stages, in microseconds per world-step")
    parser.add_argument("--json", type=Path, default=None)
    args = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    records = []
    for worlds in args.worlds:
        sim = build(
            args.mesh, args.scale, worlds, args.device, args.precision, solver_path=args.path, threads=args.threads
        )
        record = {"worlds": worlds, "mesh": args.mesh, "nodes": sim.model.node_count, "tets": sim.model.tet_count}
        record |= measure(sim, args.steps, args.repeats)
        print(
            f"{worlds:6d} worlds, {record['nodes']} nodes: {record['ms_per_step']:9.3f} ms/step "
            f"({record['ms_min']:.3f} .. {record['ms_max']:.3f}), {record['world_steps_per_s']:10.0f} world-steps/s, "
            f"failed {record['failed_worlds']}, first step {record['first_step_s']:.1f} s",
            flush=True,
        )
        if args.stages:
            record["stages_us"] = measure_stages(sim, 5)
            for name, value in record["stages_us"].items():
                print(f"         {name:18s} {value:9.2f} us per world-step")
        records.append(record | machine(args.device))
    if args.json:
        args.json.write_text(json.dumps(records, indent=1))


if __name__ == "__main__":
    main()
