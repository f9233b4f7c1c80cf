"""The segment's residuals as a function that torch differentiates, for ``softwarp identify segment --method gradient``.

Every pressure is a world, and so is the segment that hangs without pressure. Poses are a ``gradients.Equilibrium`` in
float64, which starts from those of the candidate before; the first ones climb from pressure to pressure.
"""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from softwarp import notices
from softwarp.gradients import Equilibrium
from softwarp.identification import Differentiable

Floats = NDArray[np.float64]

TOLERANCE = 1.0e-7  # of a pose: extents of the scene that are left to go, or relative imbalance
NEAR = 1.0e-3  # the same of poses that others start from


class Displacements:
    """How far the bottom's centre has moved from where it hangs without pressure, with gradients.

    Args:
        segments: A ``real_segment.Segment`` with a world for every pressure and one besides, in float64.
        single: One with a single world, which finds the first poses.
        pressures: Rising [Pa], shape (pressure,).
    """

    def __init__(self, segments: Any, single: Any, pressures: Floats) -> None:
        self.segments, self.single = segments, single
        self.equilibrium = Equilibrium(segments.sim, warm=True)
        self.pressure = torch.as_tensor(np.concatenate([[0.0], pressures]))[:, None]
        self.tip = torch.as_tensor(segments.tip)
        self.is_started = False

    def __call__(self, values: Tensor) -> Tensor:
        """From parameters, (1, parameter), to displacements [mm], (1, pressure)."""
        if not self.is_started:
            self._climb(values.detach().numpy())
        notices.progress("identification", f"one candidate at {len(self.pressure) - 1} pressures")
        sim = self.segments.sim
        stiffness = (values[:, 1:] * self.segments.spacing).expand(sim.num_worlds, sim.model.cable_count)
        pose = self.equilibrium(
            {"cavity_pressure": self.pressure},
            {"youngs": values[:, :1].expand(sim.num_worlds, 1), "cable_stiffness": stiffness},
            tolerance=TOLERANCE,
        )
        place = pose.node_x[:, self.tip].mean(dim=1)
        return 1e3 * (place[1:] - place[:1]).norm(dim=1)[None]

    def _climb(self, values: Floats) -> None:
        """Poses near those of the first candidate, from pressure to pressure."""
        sim = self.segments.sim
        self.single.write(values)
        climb = Equilibrium(self.single.sim, warm=True)
        for world, pressure in enumerate(self.pressure):
            pose = climb({"cavity_pressure": pressure}, tolerance=NEAR)
            for name in ("node_x", "cable_tension", "cavity_pressure"):
                getattr(sim, name)[world] = getattr(pose, name)[0]
        self.is_started = True


def residuals(displacements: Displacements, measured: Floats) -> Differentiable:
    """Model minus measurement [mm], with gradients.

    Args:
        displacements: Model.
        measured: Shape (pressure,).
    """
    told = torch.as_tensor(measured)[None]
    return Differentiable(lambda values: displacements(values) - told)
