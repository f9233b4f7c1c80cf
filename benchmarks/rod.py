"""Speed of a rod with a tip mass: world-steps/s of many worlds, and how much faster than real time one of them runs.

    python benchmarks/rod.py --worlds 1 256
    python benchmarks/rod.py --worlds 4096 --device cuda:0 --stages

A rod of 20 segments, clamped at its lower end, carries a ball on its tip and is pushed sideways at its middle, in every
world with another force. On two cores 256 worlds have to reach 100 000 world-steps/s, and one world 50 times real time
at a time step of 10 ms.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp
from timing import arguments, machine, measure, measure_stages, save, show

import softwarp

SEGMENTS = 20
DT = 0.01  # s


def build(worlds: int, device: str, precision: str, **options: Any) -> softwarp.Simulation:
    """The rod, upright in gravity."""
    builder = softwarp.ModelBuilder()
    points = np.linspace((0.0, 0.0, 0.0), (0.0, 0.0, 0.2), SEGMENTS + 1)
    rod = builder.add_rod(points, radius=0.005, youngs=1e7, nu=0.45, density=1200.0)
    builder.fix(rod, nodes=[0])
    ball = builder.add_rigid(softwarp.Sphere(0.01), mass=0.02, pose=points[-1])
    builder.attach(ball, to=rod, node=-1)
    return softwarp.Simulation(builder.finalize(worlds, device, precision), dt=DT, **options)  # type: ignore[arg-type]


def drive(sim: softwarp.Simulation, step: int) -> None:
    """A slow sine on the force at the middle of the rod, different in every world."""
    phase = torch.arange(sim.num_worlds, device=sim.time.device) * 0.1
    sim.control.rod_force[:, SEGMENTS // 2, 0] = 0.01 * torch.sin(phase + 0.2 * step).to(sim.control.rod_force.dtype)


def main() -> None:
    """Measure, print and record."""
    args = arguments(__doc__, worlds=(1, 256), steps=200).parse_args()
    wp.config.log_level = wp.LOG_WARNING
    records = []
    for worlds in args.worlds:
        sim = build(worlds, args.device, args.precision, solver_path=args.path, threads=args.threads)
        record: dict[str, Any] = {"worlds": worlds, "nodes": SEGMENTS + 1, "scene": "rod of 20 segments, tip mass"}
        record |= measure(sim, drive, args.steps, args.repeats)
        record["times_real_time"] = 1e3 * DT / record["ms_per_step"]
        record["mean_deflection_m"] = float(sim.rod_x[:, -1, 0].abs().mean())
        if args.stages:
            record["stages_us"] = measure_stages(sim, 5)
        show(record, f", {record['times_real_time']:.0f} times real time")
        records.append(record | machine(args.device))
    save(records, args.json)


if __name__ == "__main__":
    main()
