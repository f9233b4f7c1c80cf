"""The trunk with all eight cables driven at once: the Trunk environment's scene as a bare simulation."""

from __future__ import annotations

from typing import Any

import torch

import softwarp
from softwarp.envs.scenes.trunk import TrunkSceneConfig, build_trunk_scene


def build(worlds: int, device: str, precision: str, mesh: str = "medium", **options: Any) -> softwarp.Simulation:
    """The scene with a mesh of SofaGym's resolution (674 nodes), or ``coarse`` or ``fine``."""
    builder = softwarp.ModelBuilder(gravity=(0.0, -9.81, 0.0))
    build_trunk_scene(TrunkSceneConfig(mesh=mesh), builder)
    return softwarp.Simulation(builder.finalize(worlds, device, precision), **options)  # type: ignore[arg-type]


def drive(sim: softwarp.Simulation, step: int) -> None:
    """Slow sines on all cables around a common pull, different in every world."""
    count = sim.num_worlds
    phase = torch.arange(count, device=sim.time.device)[:, None] * 0.1 + torch.arange(8, device=sim.time.device) * 0.8
    wave = 0.004 + 0.003 * torch.sin(phase + 0.02 * step)
    sim.control.cable_displacement[:] = wave.to(sim.control.cable_displacement.dtype)


def notes(sim: softwarp.Simulation) -> dict[str, float]:
    """What shows that the cables pull."""
    return {"mean_tension_N": float(sim.cable_tension.mean())}
