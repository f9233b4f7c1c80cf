"""Speed of the trunk: milliseconds per step of one world, world-steps/s of many, and where the time goes.

    python benchmarks/trunk.py --worlds 1 64 --mesh medium
    python benchmarks/trunk.py --worlds 4096 --device cuda:0 --stages

All eight cables are driven at once. A figure is the median over repetitions; the spread is given beside it. ``--mesh``
also takes a mesh file (with ``--scale``). Prints a table; ``--json`` writes the records with commit and machine.
"""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from timing import arguments, machine, measure, measure_stages, save, show

import softwarp
from softwarp.envs.trunk_scene import TrunkSceneConfig, build_trunk_scene


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


def main() -> None:
    """Measure, print and record."""
    parser = arguments(__doc__, worlds=(1, 64), steps=20)
    parser.add_argument("--mesh", default="medium")
    parser.add_argument("--scale", type=float, default=1.0, help="metres per unit of a mesh file")
    args = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    records = []
    for worlds in args.worlds:
        sim = build(
            args.mesh, args.scale, worlds, args.device, args.precision, solver_path=args.path, threads=args.threads
        )
        record = {"worlds": worlds, "mesh": args.mesh, "nodes": sim.model.node_count, "tets": sim.model.tet_count}
        record |= measure(sim, drive, args.steps, args.repeats)
        record["mean_tension_N"] = float(sim.cable_tension.mean())
        if args.stages:
            record["stages_us"] = measure_stages(sim, 5)
        show(record)
        records.append(record | machine(args.device))
    save(records, args.json)


if __name__ == "__main__":
    main()
