"""Scenes of rigid bodies that several tests share. SI units."""

from collections.abc import Sequence
from typing import Any

import torch

import softwarp as sw


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
