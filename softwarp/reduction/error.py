"""How far a reduced model goes from the full one under the same commands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from softwarp import checks, notices
from softwarp.model.model import Model
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


def shared_nodes(full: Model, reduced: Model) -> torch.Tensor:
    """Numbers of the full model's nodes among those of the reduced one, (node,).

    Behind its own nodes a reduced body of quadratic elements has corners of the tets at its Gauss points.

    Raises:
        ValueError: If a body has fewer nodes in the reduced model, or other nodes.
    """
    ours, theirs = (model.body_node_start for model in (full, reduced))
    if len(ours) != len(theirs) or (np.diff(ours) > np.diff(theirs)).any():
        raise ValueError(
            f"deviation: the models must have the same nodes, got {full.node_count} and {reduced.node_count}"
        )
    spans = [np.arange(count) + first for count, first in zip(np.diff(ours), theirs[:-1], strict=True)]
    guides = np.arange(full.node_count - int(ours[-1])) + int(theirs[-1])
    found = np.concatenate([*spans, guides])
    if not np.array_equal(full.node_rest, reduced.node_rest[found]):
        raise ValueError("deviation: the models must have the same nodes at rest")
    return torch.as_tensor(found)


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
    if full.num_worlds != reduced.num_worlds:
        raise ValueError(
            f"deviation: the models must have as many worlds, got {full.num_worlds} and {reduced.num_worlds}"
        )
    same = shared_nodes(full.model, reduced.model)
    start = full.node_x.clone()
    rows = []
    for step in range(steps):
        drive(full, step)
        other(reduced, step)
        full.step()
        reduced.step()
        apart = (full.node_x - reduced.node_x[:, same]).norm(dim=-1)
        rows.append(torch.stack([apart.mean(), apart.max(), (full.node_x - start).norm(dim=-1).mean()]))
        notices.progress("comparing models", f"step {step + 1} of {steps}")
    notices.progress_ends()
    table = torch.stack(rows).double().cpu()
    return Deviation(table[:, 0], table[:, 1], table[:, 2])
