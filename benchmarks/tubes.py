"""Three concentric tubes find their way through a bent vessel: whole episodes in contact, timed, and their outcome.

    softwarp bench tubes
    softwarp bench tubes --device cuda:0 --worlds 1024 4096 --precision float32

Three tubes with curved ends, of 40 segments together, come out of a port into a vessel of 5 mm radius that bends by a
radian, with friction 0.1. Every 10 steps of 10 ms each tube gets a new speed at random: in the mean they go in for
three quarters of an episode and out for the last one, and turn to and fro. Told are speed, contacts, the least
clearance of the centre line, the share of worlds whose line has left the vessel, the largest sum of wall forces, and
failed worlds.
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
from softwarp.shapes import Vessel

from .timing import limited_cores, machine, save

DT, HELD, ACTIONS = 0.01, 10, 80  # s, steps of an action, actions of an episode
BEND, RADIUS = 0.06, 0.005  # m
SEGMENTS, CAPACITY = 40, 24
FARTHEST = (0.075, 0.05, 0.03)  # m
SPEED, SPIN = 0.02, 2.0  # m/s, rad/s


def vessel(spacing: float = 5e-4) -> Vessel:
    """A straight inlet and a bend of a radian."""
    a = np.linspace(0.0, 1.0, 40)
    bend = np.stack([0.0 * a, BEND * (1.0 - np.cos(a)), BEND * np.sin(a)], axis=1)
    inlet = np.array([(0.0, 0.0, z) for z in np.linspace(-0.02, 0.0, 5)[:-1]])
    end = np.array([0.0, np.sin(1.0), np.cos(1.0)])
    return Vessel.from_tubes([(np.concatenate([inlet, bend, bend[-1] + 0.03 * end[None]]), RADIUS)], spacing)


def build(worlds: int, device: str, precision: str, **options: Any) -> sw.Simulation:
    """Tubes, port and vessel."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    wall = builder.add_rigid(vessel(), kinematic=True)
    tubes = [
        sw.Tube([sw.TubeSection(0.2), sw.TubeSection(length, (-k, 0.0, 0.0))], radius=r, inner_radius=inner)
        for length, k, r, inner in ((0.04, 30.0, 4e-4, 0.0), (0.03, 20.0, 7e-4, 5e-4), (0.02, 12.0, 1e-3, 8e-4))
    ]
    rods: dict[str, Any] = {"segments": SEGMENTS, "rayleigh": (0.1, 0.01), "windup": False}
    telescope = builder.add_telescope(tubes, port=(0.0, 0.0, -0.015), contact_radius=4e-4, **rods)
    builder.add_contact(telescope, wall, mu=0.1)
    model = builder.finalize(worlds, device, precision, contact_capacity=CAPACITY)  # type: ignore[arg-type]
    return sw.Simulation(model, dt=DT, **options)


class Driver:
    """Random speeds of the tubes, the same in every episode."""

    def __init__(self, sim: sw.Simulation) -> None:
        self.sim, like = sim, sim.control.tube_length
        draw = torch.as_tensor(np.random.default_rng(0).uniform(-1.0, 1.0, (ACTIONS, *like.shape, 2)))
        self.draw = draw.to(like)
        self.farthest = torch.tensor(FARTHEST).to(like)

    def act(self, number: int) -> None:
        """Move the wanted lengths and angles by what an action does."""
        control, way = self.sim.control, DT * HELD
        lean = 0.3 if number < 0.75 * ACTIONS else -0.7
        length = control.tube_length + (self.draw[number, ..., 0] + lean) * SPEED * way
        control.tube_length.copy_(torch.minimum(length.clamp_min(0.0), self.farthest))
        control.tube_angle.add_(self.draw[number, ..., 1] * SPIN * way)


def episode(sim: sw.Simulation, driver: Driver, watch: dict[str, float] | None = None) -> float:
    """Seconds of an episode from the initial state; ``watch`` receives extremes instead."""
    sim.reset()
    for view in (sim.control.tube_length, sim.control.tube_angle):
        view.zero_()
    sim.contact_overflow.zero_()
    wall = vessel()
    wp.synchronize_device(sim.device)
    start = time.perf_counter()
    for number in range(ACTIONS):
        driver.act(number)
        sim.step(HELD)
        if watch is not None:
            used = sim.contact_pair >= 0
            force = (torch.linalg.vector_norm(sim.contact_load, dim=-1) * used).sum(dim=1)
            line = sim.rod_x[: min(256, sim.num_worlds)].double().cpu().numpy()
            clear = wall.clearance(line.reshape(-1, 3)).reshape(line.shape[:2]).min(axis=1)
            watch["force"] = max(watch.get("force", 0.0), float(force.max()))
            watch["clearance"] = min(watch.get("clearance", 1.0), float(clear.min()))
            watch["left"] = max(watch.get("left", 0.0), float((clear < 0.0).mean()))
            watch["failed"] = max(watch.get("failed", 0.0), float((sim.status >= sw.Status.NONFINITE).sum()))
            watch["contacts"] = watch.get("contacts", 0.0) + float(used.sum(dim=1).float().mean()) / ACTIONS
    wp.synchronize_device(sim.device)
    return time.perf_counter() - start


def run(worlds: int, device: str, precision: str, repeats: int) -> dict[str, Any]:
    """Speed of whole episodes, and what came of them."""
    sim = build(worlds, device, precision)
    driver, watch = Driver(sim), {}
    episode(sim, driver, watch)  # compiles and captures as well
    times = sorted(episode(sim, driver) for _ in range(repeats))
    steps, median = ACTIONS * HELD, times[len(times) // 2]
    return {
        "case": "tubes",
        "worlds": worlds,
        "precision": precision,
        "ms_per_step": 1e3 * median / steps,
        "world_steps_per_s": worlds * steps / median,
        "world_steps_per_s_best": worlds * steps / times[0],
        "overflowed": int((sim.contact_overflow > 0).sum()),
        **watch,
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Time every number of worlds."""
    parser = argparse.ArgumentParser(
        prog="softwarp bench tubes", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 64])
    parser.add_argument("--device", default="cpu", help="Warp device")
    parser.add_argument("--precision", default="float64", choices=["float32", "float64"])
    parser.add_argument("--cores", type=int, help="cores of a CPU to run on")
    parser.add_argument("--repeats", type=int, default=3, help="episodes that are timed")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers here")
    args = parser.parse_args(arguments)
    records = []
    with limited_cores(args.cores) as cores:
        for worlds in args.worlds:
            record = machine(args.device, cores) | run(worlds, args.device, args.precision, args.repeats)
            records.append(record)
            print(
                f"{worlds:6d} worlds: {record['ms_per_step']:8.3f} ms a step, {record['world_steps_per_s']:10.0f} "
                f"world-steps/s, {record['contacts']:.1f} contacts, clearance {1e3 * record['clearance']:.2f} mm, "
                f"{100.0 * record['left']:.1f} % left the vessel, wall force {record['force']:.2f} N, "
                f"{record['failed']:.0f} failed",
                flush=True,
            )
            save(records, args.json)
    return 1 if any(record["failed"] for record in records) else 0
