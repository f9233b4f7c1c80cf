"""The tentacle's residuals as a function that torch differentiates: rods that settle, markers on stems, a turned base.

What ``real_tentacle.Tentacle.markers`` does with NumPy, for ``softwarp identify tentacle --method gradient``. Steps to
rest are a ``gradients.Rollout``; modulus, and gravity in the axes of the base, are its parameters.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from softwarp.gradients import Rollout
from softwarp.identification import Differentiable

Floats = NDArray[np.float64]

SMALL = 1.0e-12  # below which the half angle of a turn has the series of its sine


def product(a: Tensor, b: Tensor) -> Tensor:
    """Quaternion a after b, (..., 4), x y z w."""
    u, v, s, t = a[..., :3], b[..., :3], a[..., 3:], b[..., 3:]
    return torch.cat([s * v + t * u + torch.linalg.cross(u, v), s * t - (u * v).sum(-1, keepdim=True)], dim=-1)


def inverse(q: Tensor) -> Tensor:
    """The turn back."""
    return torch.cat([-q[..., :3], q[..., 3:]], dim=-1)


def turned(q: Tensor, v: Tensor) -> Tensor:
    """A vector turned by a quaternion."""
    twice = 2.0 * torch.linalg.cross(q[..., :3], v.expand_as(q[..., :3]))
    return v + q[..., 3:] * twice + torch.linalg.cross(q[..., :3], twice)


def power(q: Tensor, t: float) -> Tensor:
    """A part t of a turn by less than half a circle."""
    sine = q[..., :3].square().sum(-1, keepdim=True).clamp_min(SMALL**2).sqrt()
    half = torch.atan2(sine, q[..., 3:])
    return torch.cat([q[..., :3] * (torch.sin(t * half) / sine), torch.cos(t * half)], dim=-1)


def base_turn(roll: Tensor, pitch: Tensor, yaw: Tensor) -> Tensor:
    """Turns about the fixed axes x, y and z, one after the other, (..., 4)."""
    found = None
    for axis, angle in enumerate((roll, pitch, yaw)):
        parts = [torch.zeros_like(angle)] * 3 + [torch.cos(0.5 * angle)]
        parts[axis] = torch.sin(0.5 * angle)
        one = torch.stack(parts, dim=-1)
        found = one if found is None else product(one, found)
    assert found is not None
    return found


class Markers:
    """Settled markers in the frame of the motion capture, (pose, marker * 3) [mm], with gradients.

    Args:
        tentacle: A ``real_tentacle.Tentacle`` of a single candidate.
        places: Arc lengths of markers [m].
        stems: From the middle of the section to markers, in its axes [m], (marker, 3).
        steps: To rest.
    """

    def __init__(self, tentacle: Any, places: Sequence[float], stems: Floats, steps: int) -> None:
        self.places, self.stems, self.steps = places, torch.as_tensor(stems), steps
        self.tentacle, self.names = tentacle, tentacle.worlds.space.names
        self.rollout = Rollout(tentacle.sim)

    def __call__(self, values: Tensor) -> Tensor:
        """From parameters, (pose, parameter)."""
        column = {name: values[:, place] for place, name in enumerate(self.names)}
        none = torch.zeros_like(values[:, 0])
        base = base_turn(*(column.get(name, none) for name in ("roll", "pitch", "yaw")))
        down = torch.tensor([0.0, 0.0, -9.81], dtype=values.dtype)
        gravity = turned(inverse(base), down)
        states = self.rollout(
            controls={"cable_tension": self.tentacle.tension},
            parameters={"rod_youngs": column["youngs"][:, None], "gravity": gravity},
            steps=self.steps,
            factors=True,
        )
        x, q = states.rod_x[-1].to(values), states.rod_q[-1].to(values)
        found = []
        for number, arc in enumerate(self.places):
            place, frame = self._at(arc, x, q)
            stem = self.stems[number].to(values) + torch.stack(
                [none, none, column.get(f"marker {number + 1}", none)], dim=-1
            )
            found.append(turned(base, place + turned(frame, stem)))
        return 1e3 * torch.stack(found, dim=1).flatten(1)

    def _at(self, arc: float, x: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
        """As of ``Tentacle.at``."""
        i, t = self.tentacle.between(arc)
        first, last = q[:, i - 1], q[:, i]
        length = (x[:, i] - x[:, i - 1]).norm(dim=-1, keepdim=True)
        axis = torch.tensor([0.0, 0.0, 1.0], dtype=x.dtype)
        tangents = [length * turned(frame, axis) for frame in (first, last)]
        weights = self.tentacle.cubic(t)
        points = (x[:, i - 1], tangents[0], x[:, i], tangents[1])
        line = torch.stack([weight * point for weight, point in zip(weights, points, strict=True)]).sum(dim=0)
        between = product(inverse(first), last)
        between = torch.where(between[..., 3:] < 0.0, -between, between)
        return line, product(first, power(between, t))


def residuals(markers: Markers, target: Floats) -> Differentiable:
    """Model minus measurement, with gradients.

    Args:
        markers: Model.
        target: Measured markers [mm], (pose, marker, 3).
    """
    told = torch.as_tensor(target).flatten(1)
    return Differentiable(lambda values: markers(values) - told, experiments=len(target))
