"""What an environment asks of its worlds after a step or a reset: finite numbers, upright elements."""

from __future__ import annotations

import torch
from torch import Tensor

from softwarp.simulation import Simulation


def is_finite_state(sim: Simulation) -> Tensor:
    """Worlds whose positions and velocities are finite, bool (world,)."""
    parts = (sim.node_x, sim.node_v, sim.frame_pose, sim.frame_twist)
    return torch.isfinite(torch.stack([part.sum(dim=(1, 2)) for part in parts]).sum(dim=0))


def is_inverted(sim: Simulation) -> Tensor:
    """Worlds with elements inside out where the last step led to, bool (world,)."""
    count: Tensor = sim.inverted_count
    return count > 0


def inversion_term(sim: Simulation, penalty: float) -> dict[str, Tensor]:
    """The reward term that takes ``penalty`` from worlds with elements inside out; none where the penalty is 0."""
    return {"inversion": -penalty * is_inverted(sim).to(torch.float32)} if penalty > 0.0 else {}
