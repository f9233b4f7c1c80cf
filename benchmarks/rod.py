"""A rod of 20 segments with a tip mass, clamped at its lower end and pushed sideways at its middle.

On two cores 256 worlds have to reach 100 000 world-steps/s, and one world 50 times real time at a time step of 10 ms.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

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


def notes(sim: softwarp.Simulation) -> dict[str, float]:
    """What shows that the rod is pushed."""
    return {"mean_deflection_m": float(sim.rod_x[:, -1, 0].abs().mean())}
