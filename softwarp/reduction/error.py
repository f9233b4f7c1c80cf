"""How far a reduced model goes from the full one under the same commands."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from softwarp import checks, notices
from softwarp.reduction.motion import Drive
from softwarp.simulation import Simulation


@dataclass(frozen=True)
class Deviation:
    """Distances between two models over time.

    Attributes:
        mean: Mean distance of nodes, over worlds, (step,) [m].
        worst: Largest distance of a node in any world, (step,) [m].
        travel: Mean way of nodes from the start in the first model, (step,) [m].
    """

    mean: torch.Tensor
    worst: torch.Tensor
    travel: torch.Tensor

    @property
    def relative(self) -> float:
        """Mean distance at the end per mean way."""
        return float(self.mean[-1] / self.travel[-1].clamp(min=1e-300))


def deviation(full: Simulation, reduced: Simulation, drive: Drive, other: Drive, steps: int) -> Deviation:
    """Run two simulations of as many worlds beside each other.

    Args:
        full: The full model.
        reduced: The same scene, reduced.
        drive: Commands of the first one.
        other: The same commands for the second one.
        steps: Steps to take.

    Raises:
        ValueError: If the scenes have different nodes or worlds.
    """
    checks.count(steps, "steps")
    if full.node_x.shape != reduced.node_x.shape:
        raise ValueError(
            f"deviation: the models must have the same worlds and nodes, got {tuple(full.node_x.shape[:2])} and "
            f"{tuple(reduced.node_x.shape[:2])}"
        )
    start = full.node_x.clone()
    rows = []
    for step in range(steps):
        drive(full, step)
        other(reduced, step)
        full.step()
        reduced.step()
        apart = (full.node_x - reduced.node_x).norm(dim=-1)
        rows.append(torch.stack([apart.mean(), apart.max(), (full.node_x - start).norm(dim=-1).mean()]))
        notices.progress("comparing models", f"step {step + 1} of {steps}")
    notices.progress_ends()
    table = torch.stack(rows).double().cpu()
    return Deviation(table[:, 0], table[:, 1], table[:, 2])
