"""A soft finger pressed on a sliding rigid cube, and the same finger without contact.

A finger of 657 nodes, clamped at its base, is pressed with a pad under its end on a cube that slides to and fro across
it with friction, in every world at another speed; about twenty contacts carry force.
A step with contact takes about 1.4 times the time of the same scene without the contact pair, which
``python -m benchmarks.contact --json FILE`` measures: both on one core in turns, in processor time.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

import softwarp
from softwarp import meshing

from .timing import limited_cores, machine, save

CELL = 0.005  # m
PRESSURE = 6.0  # N, on the top of the finger above the pad
WARM_UP = 60  # steps until the finger lies on the cube


def finger() -> meshing.TetMesh:
    """A bar of 20 x 4 x 5 cells with a pad of 8 x 2 x 1 cells below its end: 657 nodes."""
    bar = meshing.box((20 * CELL, 4 * CELL, 5 * CELL), (20, 4, 5))
    pad = meshing.box((8 * CELL, 2 * CELL, CELL), (8, 2, 1))
    nodes = np.vstack([bar.nodes, pad.nodes + [11 * CELL, CELL, -CELL]])
    return meshing.TetMesh(*meshing.weld(nodes, np.vstack([bar.tets, pad.tets + len(bar.nodes)])), "finger")


def build(worlds: int, device: str, precision: str, contact: bool = True, **options: Any) -> softwarp.Simulation:
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


def notes(sim: softwarp.Simulation) -> dict[str, float]:
    """Contacts per world, and those that carry force."""
    if sim.model.contact is None:
        return {}
    carrying = (sim.contact_load.norm(dim=2) > 0.0).sum(dim=1).float().mean()
    return {"contacts": float(sim.contact_count.float().mean()), "active_contacts": float(carrying)}


def compare(worlds: int, repeats: int, steps: int) -> dict[str, Any]:
    """Median quotient of the processor times of steps with and without contact, in turns: others' work hits both."""
    sims = {name: build(worlds, "cpu", "float32", contact=name == "contact") for name in ("contact", "free")}
    samples: dict[str, list[float]] = {name: [] for name in sims}
    for sim in sims.values():
        for step in range(WARM_UP):
            drive(sim, step)
            sim.step()
    for repeat in range(repeats):
        for name, sim in sims.items():
            drive(sim, repeat)
            start = time.process_time()
            for _ in range(steps):
                sim.step()
            samples[name].append((time.process_time() - start) / steps)
    times = statistics.median(touching / free for touching, free in zip(*samples.values(), strict=True))
    return {"case": "contact beside free", "worlds": worlds, "times_free": times, **notes(sims["contact"])}


def main() -> None:
    """Compare for one world and for many, on one core."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 64])
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the records")
    args = parser.parse_args()
    records = []
    with limited_cores(1) as cores:
        for worlds in args.worlds:
            record = compare(worlds, args.repeats, steps=max(3, 20 // worlds)) | machine("cpu", cores)
            print(f"{worlds} worlds: {record['times_free']:.2f} times the free step")
            records.append(record)
    save(records, args.json)


if __name__ == "__main__":
    main()
