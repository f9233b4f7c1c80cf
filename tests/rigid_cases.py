"""Scenes of rigid bodies that several tests share. SI units."""

import math
from collections.abc import Sequence
from typing import Any

import torch

import softwarp as sw

G = 9.81  # m/s^2
ALONG_X = (0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5))  # turns z to x


def spinning(
    inertia: Sequence[float],
    spin: Sequence[float],
    *,
    dt: float,
    gravity: Sequence[float] = (0.0, 0.0, 0.0),
    precision: str = "float64",
    iterations: int = 1,
    **body: Any,
) -> sw.Simulation:
    """One body of 1 kg with principal moments [kg m^2], turning."""
    builder = sw.ModelBuilder(gravity=gravity)
    velocity = (*body.pop("speed", (0.0, 0.0, 0.0)), *spin)
    builder.add_rigid(**({"mass": 1.0} | body), inertia=inertia, velocity=velocity)
    return sw.Simulation(builder.finalize(precision=precision), dt=dt, newton_iterations=iterations)


def vector(*values: float) -> torch.Tensor:
    """Numbers as a tensor in float64."""
    return torch.tensor(values, dtype=torch.float64)


def run(sim: sw.Simulation, time: float) -> None:
    """Steps of a time [s], none of which may fail."""
    for _ in range(round(time / sim.dt)):
        sim.step()
    assert sim.status.tolist() == [sw.Status.OK] * sim.num_worlds
