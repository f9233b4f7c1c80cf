"""The tentacle's residuals as a function that torch differentiates: rods that settle, markers on stems, a turned base.

What ``real_tentacle.Tentacle.markers`` does with NumPy, for ``softwarp identify tentacle --method gradient``. Poses are
a ``gradients.Equilibrium`` that starts from those before; modulus, and gravity in the axes of the base, are its
parameters.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from softwarp.gradients import Equilibrium
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


def power(q: Tensor, t: Tensor) -> Tensor:
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
    """

    def __init__(self, tentacle: Any, places: Sequence[float], stems: Floats) -> None:
        self.stems = torch.as_tensor(stems)
        self.tentacle, self.names = tentacle, tentacle.worlds.space.names
        last, share = zip(*(tentacle.between(place) for place in places), strict=True)
        self.last, self.share = torch.tensor(last), torch.tensor(share)[:, None]
        self.weights = torch.tensor([tentacle.cubic(t) for t in share])[:, None]  # (marker, 1, point)
        self.equilibrium = Equilibrium(tentacle.sim, warm=True)

    def __call__(self, values: Tensor) -> Tensor:
        """From parameters, (pose, parameter)."""
        column = {name: values[:, place] for place, name in enumerate(self.names)}
        none = torch.zeros_like(values[:, 0])
        base = base_turn(*(column.get(name, none) for name in ("roll", "pitch", "yaw")))
        down = torch.tensor([0.0, 0.0, -9.81], dtype=values.dtype)
        gravity = turned(inverse(base), down)
        pose = self.equilibrium(
            controls={"cable_tension": self.tentacle.tension},
            parameters={"rod_youngs": column["youngs"][:, None], "gravity": gravity},
        )
        x, q = pose.rod_x.to(values), pose.rod_q.to(values)
        places, frames = self._at(x, q)
        along = torch.stack([column.get(f"marker {number + 1}", none) for number in range(len(self.stems))], dim=-1)
        stems = self.stems.to(values) + along[..., None] * torch.tensor([0.0, 0.0, 1.0], dtype=values.dtype)
        return 1e3 * turned(base[:, None].expand_as(frames), places + turned(frames, stems)).flatten(1)

    def _at(self, x: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
        """As of ``Tentacle.at``, of all markers: (pose, marker, 3) and (pose, marker, 4)."""
        first, last = q[:, self.last - 1], q[:, self.last]
        begin, end = x[:, self.last - 1], x[:, self.last]
        axis = torch.tensor([0.0, 0.0, 1.0], dtype=x.dtype)
        length = (end - begin).norm(dim=-1, keepdim=True)
        tangents = [length * turned(frame, axis) for frame in (first, last)]
        points = torch.stack([begin, tangents[0], end, tangents[1]], dim=-1)
        between = product(inverse(first), last)
        between = torch.where(between[..., 3:] < 0.0, -between, between)
        return (points * self.weights.to(x)).sum(dim=-1), product(first, power(between, self.share.to(x)))


def residuals(markers: Markers, target: Floats) -> Differentiable:
    """Model minus measurement, with gradients.

    Args:
        markers: Model.
        target: Measured markers [mm], (pose, marker, 3).
    """
    told = torch.as_tensor(target).flatten(1)
    return Differentiable(lambda values: markers(values) - told, experiments=len(target), batched=True)
