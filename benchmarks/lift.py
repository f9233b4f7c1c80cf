"""Two rigid jaws lift a soft cube by friction: whole episodes, timed, with what came of them.

    softwarp bench lift
    softwarp bench lift --device cuda:0 --worlds 1024 2048 4096 8192 --json lift.json

A silicone cube of 216 nodes lies on a floor. Two boxes close on it, lift it by 100 mm, hold it and shake it sideways;
worlds differ in friction and modulus. An environment step has two sub-steps of 10 ms. The cube touches with a skin of
three cells an edge instead of five. Told are speed, the cubes that hang where they should in the end, the deepest
penetration of jaws and floor as a share of the edge, and failed worlds.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

import softwarp as sw
from softwarp import meshing

from .timing import limited_cores, machine, save

EDGE = 0.04  # m
CELLS, SKIN = 5, 3
DT, SUBSTEPS = 0.01, 2
CLOSE, LIFT, SHAKE, HOLD = 20, 40, 20, 10  # environment steps
SQUEEZE = 0.12  # of the edge, that the jaws come nearer than the cube is wide
HEIGHT = 0.1  # m
CAPACITY = 96


def build(worlds: int, device: str, **options: Any) -> sw.Simulation:
    """Floor, cube and open jaws; parameters drawn per world."""
    builder = sw.ModelBuilder()
    floor = builder.add_rigid(sw.Plane(), kinematic=True)
    mesh = meshing.box((EDGE,) * 3, (CELLS,) * 3)
    skin = meshing.box((EDGE,) * 3, (SKIN,) * 3)
    corner = meshing.tet_surface(skin.tets)
    used, triangles = np.unique(corner, return_inverse=True)
    lift = np.array([-EDGE / 2, -EDGE / 2, 1e-4])
    cube = builder.add_tets(
        meshing.TetMesh(mesh.nodes + lift, mesh.tets),
        material=sw.Corotational(2e5, 0.45, method="large"),
        density=1070.0,
        rayleigh=(0.1, 0.02),
        contact_surface=(skin.nodes[used] + lift, triangles.reshape(-1, 3)),
    )
    for side in (-1.0, 1.0):
        pose = (side * (EDGE / 2 + 0.012), 0.0, 0.024)
        jaw = builder.add_rigid(sw.Box((0.01, 0.05, 0.046)), kinematic=True, pose=pose)
        builder.add_contact(cube, jaw, mu=0.8)
    builder.add_contact(cube, floor, mu=0.5)
    builder.add_marker(cube, (0.0, 0.0, EDGE / 2))
    model = builder.finalize(worlds, device, contact_capacity=CAPACITY)
    sim = sw.Simulation(model, dt=DT, **options)
    draw = torch.as_tensor(np.random.default_rng(0).random((worlds, 3)), dtype=torch.float32, device=sim.time.device)
    sim.params.youngs[:, 0] *= 0.7 + 0.6 * draw[:, 0]
    sim.params.pair_mu[:, :2] *= (0.7 + 0.6 * draw[:, 1])[:, None]
    return sim


def command(sim: sw.Simulation, step: int) -> None:
    """Velocities of the jaws in an environment step."""
    velocity = sim.control.body_velocity
    velocity.zero_()
    period = DT * SUBSTEPS
    if step < CLOSE:
        speed = (0.007 + 0.5 * SQUEEZE * EDGE) / (CLOSE * period)
        velocity[:, 1, 0], velocity[:, 2, 0] = speed, -speed
    elif step < CLOSE + LIFT:
        velocity[:, 1:3, 2] = HEIGHT / (LIFT * period)
    elif step < CLOSE + LIFT + SHAKE:
        velocity[:, 1:3, 1] = 0.1 if (step - CLOSE - LIFT) // 5 % 2 == 0 else -0.1


def episode(sim: sw.Simulation, *, watch: bool) -> float:
    """Seconds of an episode from the initial state; ``watch`` returns the deepest penetration [m] instead."""
    sim.reset()
    sim.contact_overflow.zero_()
    deepest = torch.zeros((), device=sim.time.device)
    wp.synchronize_device(sim.device)
    start = time.perf_counter()
    for step in range(CLOSE + LIFT + SHAKE + HOLD):
        command(sim, step)
        sim.step(SUBSTEPS)
        if watch:
            deepest = torch.maximum(deepest, -sim.contact_gap.min())
    wp.synchronize_device(sim.device)
    return float(deepest) if watch else time.perf_counter() - start


def run(worlds: int, device: str, repeats: int) -> dict[str, Any]:
    """Speed of whole episodes, and how they ended."""
    sim = build(worlds, device)
    depth = episode(sim, watch=True)  # compiles and captures as well
    times = sorted(episode(sim, watch=False) for _ in range(repeats))
    steps = CLOSE + LIFT + SHAKE + HOLD
    rise = sim.marker_x[:, 0, 2] - EDGE / 2
    median = times[len(times) // 2]
    return {
        "case": "lift",
        "worlds": worlds,
        "env_steps_per_s": worlds * steps / median,
        "env_steps_per_s_best": worlds * steps / times[0],
        "lifted": float(((rise - HEIGHT).abs() < 0.1 * EDGE).float().mean()),
        "penetration": depth / EDGE,
        "failed": int((sim.status >= sw.Status.NONFINITE).sum()),
        "overflowed": int((sim.contact_overflow > 0).sum()),
        "contacts": float(sim.contact_count.float().mean()),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Time every number of worlds."""
    parser = argparse.ArgumentParser(prog="softwarp bench lift", description=main.__doc__)
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 64])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the records")
    args = parser.parse_args(arguments)
    records = []
    with limited_cores(None) as cores:
        for worlds in args.worlds:
            record = run(worlds, args.device, args.repeats) | machine(args.device, cores)
            print(
                f"{worlds} worlds: {record['env_steps_per_s']:.0f} environment steps/s, {100 * record['lifted']:.1f} % "
                f"lifted, penetration {100 * record['penetration']:.2f} % of the edge, {record['contacts']:.0f} "
                f"contacts, {record['failed']} failed, {record['overflowed']} overflowed"
            )
            records.append(record)
    save(records, args.json)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
