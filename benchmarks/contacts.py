"""Time of a step by the number of its contacts: a soft pad under a rigid plate, pressed by punches of different width.

    softwarp bench contacts
    softwarp bench contacts --worlds 1 64 --json contacts.json
    softwarp bench contacts --device cuda:0 --worlds 64 1024

The pad has 23 x 23 x 4 nodes, of which the upper layer is held. A box is pressed into it from below by a twentieth of
its thickness and slides to and fro, so that 9 to 529 nodes, and edges of the box, lie on it with friction. The mesh is
the same for all punches: what grows is the work for contacts alone.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import softwarp as sw
from softwarp import meshing

from .timing import limited_cores, machine, measure, measure_stages, save

CELLS = 22
CELL = 0.004  # m
LAYERS = 3
DEPTH = 0.05  # of the pad's thickness
WARM_UP = 30
COUNTS = (9, 36, 100, 225, 529)  # contacts


def build(contacts: int, worlds: int, device: str, precision: str = "float32", **options: Any) -> sw.Simulation:
    """The pad above a punch that a square of so many nodes is pressed by."""
    side, thickness = CELLS * CELL, LAYERS * CELL
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    material = sw.Corotational(2e5, 0.45, method="large")
    pad = builder.add_tets(
        meshing.box((side, side, thickness), (CELLS, CELLS, LAYERS)),
        material=material,
        density=1100.0,
        rayleigh=(0.1, 0.01),
    )
    builder.fix(pad, box=((-1.0, -1.0, thickness - 1e-6), (1.0, 1.0, 1.0)))
    edge = (math.isqrt(contacts) - 0.5) * CELL
    middle = 0.5 * side if math.isqrt(contacts) % 2 else 0.5 * (side + CELL)
    end, way = DEPTH * thickness - 0.5 * side, 2.0 * DEPTH * thickness
    punch = builder.add_rigid(sw.Box((edge, edge, side)), kinematic=True, pose=(middle, middle, end - way))
    builder.add_contact(pad, punch, mu=0.5)
    sim = sw.Simulation(builder.finalize(worlds, device, precision, 2 * contacts + 16), dt=0.01, **options)
    for step in range(WARM_UP):
        sim.control.body_pose[:, punch, 2] = end - way * max(0.0, 1.0 - (step + 1) / (WARM_UP - 5))
        sim.step()
    return sim


def drive(sim: sw.Simulation, step: int) -> None:
    """The punch slides to and fro."""
    sim.control.body_velocity[:, 0, 0] = math.copysign(0.002, 0.5 - step % 2)


def run(contacts: int, worlds: int, device: str, repeats: int, steps: int) -> dict[str, Any]:
    """Median time of a step, its stages, and the contacts that it had."""
    sim = build(contacts, worlds, device)
    record: dict[str, Any] = {"case": "contacts", "asked": contacts, "worlds": worlds}
    record |= measure(sim, lambda step: drive(sim, step), steps, repeats)
    record |= {"contacts": float(sim.contact_count.float().mean()), "residual": float(sim.residual.max())}
    if device == "cpu":
        record["stages_ms"] = measure_stages(sim, steps)
    return record


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure every number of contacts in every number of worlds."""
    parser = argparse.ArgumentParser(prog="softwarp bench contacts", description=main.__doc__)
    parser.add_argument("--contacts", type=int, nargs="+", default=list(COUNTS), help="squares of whole numbers")
    parser.add_argument("--worlds", type=int, nargs="+", default=[1])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--steps", type=int, default=5)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the records")
    args = parser.parse_args(arguments)
    records = []
    with limited_cores(1 if args.device == "cpu" else None) as cores:
        for worlds in args.worlds:
            for contacts in args.contacts:
                record = run(contacts, worlds, args.device, args.repeats, args.steps) | machine(args.device, cores)
                speed = record["world_steps_per_s"]
                print(
                    f"{worlds} worlds, {record['contacts']:.0f} contacts: {record['ms_per_step']:.2f} ms a step, "
                    f"{speed:.0f} world-steps/s, residual {record['residual']:.1e} m"
                )
                records.append(record)
    save(records, args.json)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
