"""Cost of contact: a soft finger pressed on a sliding rigid cube, against the same finger without contact.

    python benchmarks/contact.py --worlds 1 64 --stages
    python benchmarks/contact.py --worlds 64 1024 4096 --device cuda:0 --stages

A finger of 657 nodes, clamped at its base, is pressed with a pad under its end on a cube that slides to and fro across
it with friction, in every world at another speed; about twenty contacts carry force.
A step with contact has to take less than twice the time of the same scene without the contact pair. ``--stages`` also
times detection (``find_contacts``), half-solved sides, W, sweeps (``contact.solve``) and the rest of the step.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
import warp as wp
from timing import arguments, machine, measure, measure_stages, save, show

import softwarp
from softwarp import meshing

CELL = 0.005  # m
PRESSURE = 6.0  # N, on the top of the finger above the pad
WARM_UP = 60


def finger() -> meshing.TetMesh:
    """A bar of 20 x 4 x 5 cells with a pad of 8 x 2 x 1 cells below its end: 657 nodes."""
    bar = meshing.box((20 * CELL, 4 * CELL, 5 * CELL), (20, 4, 5))
    pad = meshing.box((8 * CELL, 2 * CELL, CELL), (8, 2, 1))
    nodes = np.vstack([bar.nodes, pad.nodes + [11 * CELL, CELL, -CELL]])
    return meshing.TetMesh(*meshing.weld(nodes, np.vstack([bar.tets, pad.tets + len(bar.nodes)])), "finger")


def build(worlds: int, device: str, precision: str, contact: bool, **options: Any) -> softwarp.Simulation:
    """Finger above a cube that it does not touch yet; without ``contact`` nothing presses it down."""
    builder = softwarp.ModelBuilder()
    soft = builder.add_tets(
        finger(), material=softwarp.Corotational(5e5, 0.45, method="large"), density=1100.0, rayleigh=(0.1, 0.01)
    )
    builder.fix(soft, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)))
    edge = 6.6 * CELL
    below = (15 * CELL, 2 * CELL, -CELL - 0.5 * edge - 2e-4)
    cube = builder.add_rigid(softwarp.Box((edge, edge, edge)), kinematic=True, pose=below)
    if contact:
        builder.add_contact(soft, cube, mu=0.5)
        x = builder.bodies[soft].mesh.nodes
        above = (x[:, 2] > 4.5 * CELL) & (x[:, 0] > 10.5 * CELL) & (x[:, 0] < 19.5 * CELL)
        builder.add_point_load(soft, np.flatnonzero(above), (0.0, 0.0, -PRESSURE))
    return softwarp.Simulation(builder.finalize(worlds, device, precision), **options)  # type: ignore[arg-type]


def drive(sim: softwarp.Simulation, step: int) -> None:
    """The cube slides across the finger, forth in even and back in odd steps of the benchmark."""
    speed = 0.004 * (1.0 + 0.5 * torch.arange(sim.num_worlds, device=sim.time.device) / sim.num_worlds)
    velocity = sim.control.body_velocity
    velocity[:, 0, 1] = (math.copysign(1.0, 0.5 - step % 2) * speed).to(velocity.dtype)


def main() -> None:
    """Measure, print and record."""
    args = arguments(__doc__, worlds=(1, 64), steps=20).parse_args()
    wp.config.log_level = wp.LOG_WARNING
    records = []
    for worlds in args.worlds:
        options = {"solver_path": args.path, "threads": args.threads}
        free = measure(
            build(worlds, args.device, args.precision, False, **options), drive, args.steps, args.repeats, WARM_UP
        )
        sim = build(worlds, args.device, args.precision, True, **options)
        record: dict[str, Any] = {"worlds": worlds, "nodes": sim.model.node_count, "scene": "finger on a cube, contact"}
        record |= measure(sim, drive, args.steps, args.repeats, WARM_UP)
        record["free_ms_per_step"] = free["ms_per_step"]
        record["times_free_cost"] = record["ms_per_step"] / free["ms_per_step"]
        record["contacts"] = float(sim.contact_count.float().mean())
        record["active_contacts"] = float((sim.contact_load.norm(dim=2) > 0.0).sum(dim=1).float().mean())
        if args.stages:
            record["stages_us"] = measure_stages(sim, 5)
        note = f", {record['active_contacts']:.0f} of {record['contacts']:.0f} contacts carry"
        show(record, f"{note}, {record['times_free_cost']:.2f} times the cost without contact")
        records.append(record | machine(args.device))
    save(records, args.json)


if __name__ == "__main__":
    main()
