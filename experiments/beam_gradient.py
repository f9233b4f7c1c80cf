"""The loaded beam by gradient: how it hangs and rings down as a function of torch tensors.

Equilibria with and without a pull are those of ``gradients.Equilibrium``, the ring-down is a ``gradients.Rollout`` from
between both, at rest. Peaks are the vertices of parabolas through three samples, which move with these.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from softwarp.gradients import Equilibrium, Rollout
from softwarp.identification import Differentiable

Floats = NDArray[np.float64]

AFTER = 6  # steps


class Ring:
    """Markers of the beam at rest, and the one that rings, for one candidate.

    Args:
        beam: ``real_beam.Beam`` with one candidate: a world for each load.
        places: Of markers, from the middle of the end [m], (marker, 3).
        peaks: First lower peaks from rest, one per load, negative [mm].
        which: Marker that rings.
        counts: Lower peaks of every load that are looked at.
        steps: Of the ring-down, at most: once these peaks have been seen, it ends ``AFTER`` steps behind the last.
        limits: ``side`` of the beam [m], ``gravity`` [m/s^2], ``pull`` [N] and ``higher``, as of ``real_beam``.
    """

    def __init__(
        self,
        beam: Any,
        places: Floats,
        peaks: Floats,
        which: int,
        counts: list[int],
        steps: int,
        limits: dict[str, float],
    ) -> None:
        self.beam, self.which, self.counts, self.limits = beam, which, counts, limits
        self.most = self.steps = steps
        self.equilibrium = Equilibrium(beam.sim, warm=True)
        self.rollout = Rollout(beam.sim)
        like = beam.sim.node_x
        self.places, self.peaks = torch.as_tensor(places).to(like), torch.as_tensor(peaks).to(like)
        self.load = torch.as_tensor(beam.loads).to(like)

    def markers(self, pose: torch.Tensor) -> torch.Tensor:
        """How far markers are below their places on the straight beam [mm], (..., marker), from poses of the plate."""
        x, y, z, w = pose[..., 3:].unbind(dim=-1)
        turned = torch.stack([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)], dim=-1)
        return 1.0e3 * (pose[..., 2:3] - 0.5 * self.limits["side"] + turned @ self.places.T - self.places[:, 2])

    def __call__(self, values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Markers at rest [mm], (load, marker), and the one that rings from rest on [mm], (load, time).

        Args:
            values: Parameters of ``real_beam``, (load, parameter).
        """
        youngs, offset, ratio, time = values.to(self.load).unbind(dim=1)
        none = torch.zeros_like(self.load)
        torque = -offset * self.load * self.limits["gravity"]

        def wrench(pull: float) -> torch.Tensor:
            return torch.stack([none, none, none + pull, torque, none, none], dim=1)[:, None]

        modulus = {"youngs": youngs[:, None]}
        still, high = (self.equilibrium({"body_force": wrench(pull)}, modulus) for pull in (0.0, self.limits["pull"]))
        rest = self.markers(still.body_pose[:, 0])
        risen = self.markers(high.body_pose[:, 0]) - rest
        share = (-self.limits["higher"] * self.peaks / risen[:, self.which])[:, None, None]
        x = still.node_x + share * (high.node_x - still.node_x)
        pose = still.body_pose + share * (high.body_pose - still.body_pose)
        turn = pose[..., 3:] / pose[..., 3:].norm(dim=-1, keepdim=True)
        pose = torch.cat([pose[..., :3], turn], dim=-1)
        parameters = {**modulus, "relaxation_ratio": ratio[:, None], "relaxation_time": time[:, None]}
        start, controls = {"node_x": x, "body_pose": pose}, {"body_force": wrench(0.0)}
        motion = pose.new_zeros((len(pose), 0))
        for steps in dict.fromkeys((self.steps, self.most)):
            moved = self.rollout(start, controls, parameters, steps=steps)
            poses = torch.cat([pose[None], moved.body_pose])[:, :, 0]
            motion = (self.markers(poses)[..., self.which] - rest[:, self.which]).T
            found = [minima(each) for each in motion]
            if all(len(at) >= count for at, count in zip(found, self.counts, strict=True)):
                last = max(int(at[count - 1]) for at, count in zip(found, self.counts, strict=True))
                self.steps = min(last + AFTER, self.most)
                break
        return rest, motion


def minima(positions: torch.Tensor) -> torch.Tensor:
    """Samples that are lower than those beside them, (minimum,)."""
    x = positions.detach()
    return ((x[1:-1] <= x[:-2]) & (x[1:-1] < x[2:])).nonzero().flatten() + 1


def lower_peaks(positions: torch.Tensor, step: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Times [s] and heights of the minima of a motion, by parabolas through three samples, (peak,)."""
    number = minima(positions)
    below, here, above = positions[number - 1], positions[number], positions[number + 1]
    shift = 0.5 * (below - above) / (below - 2.0 * here + above)
    return (number + shift) * step, here - 0.25 * (below - above) * shift


def residuals(ring: Ring, told: Callable[[int, Any], torch.Tensor]) -> Differentiable:
    """Residuals of all loads.

    Args:
        ring: Simulates them.
        told: Number of a load, and its markers at rest and motion, to differences in units of what they may be.
    """

    def model(values: torch.Tensor) -> torch.Tensor:
        rest, motion = ring(values)
        return torch.stack([told(number, found) for number, found in enumerate(zip(rest, motion, strict=True))])

    return Differentiable(model, len(ring.load))
