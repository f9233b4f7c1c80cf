"""The line that tubes take together without loads and without torsion, for many lengths and angles at once.

Each tube is straight up to a curved end. Where tubes overlap, the curvature is sum(E I k) / sum(E I), with the
curvature k of each turned by its angle (Webster and Jones, 2010, section 5); the line is a row of arcs.
``scene/composite.py`` has the same for one line of any tubes, and docs/theory/telescope.md how loads change it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

_SMALL = 1.0e-12


@dataclass(frozen=True, eq=False)
class TubeLine:
    """Tubes with straight bodies and curved ends, innermost first; all tensors (tube,).

    Attributes:
        curved: Length of the curved end [m].
        curvature: Its stress-free curvature [1/m]; at angle 0 it bends towards +y.
        stiffness: Bending stiffness of the straight part [N m^2].
        curved_stiffness: The same of the curved end.
    """

    curved: Tensor
    curvature: Tensor
    stiffness: Tensor
    curved_stiffness: Tensor

    def points(self, lengths: Tensor, angles: Tensor, pieces: int = 0) -> tuple[Tensor, Tensor]:
        """Points of lines that leave the origin along +z.

        Args:
            lengths: Deployed lengths [m], (k, tube).
            angles: At the base [rad], (k, tube).
            pieces: Equal pieces of a line, at whose ends there are points besides those where a tube or its straight
                part ends.

        Returns:
            Distances along the line [m], (k, m), rising, and positions [m], (k, m, 3).
        """
        whole = lengths.amax(dim=1, keepdim=True)
        share = torch.linspace(0.0, 1.0, pieces + 2 if pieces else 2, dtype=lengths.dtype, device=lengths.device)
        begins = lengths - self.curved
        stops = torch.cat((whole * share, begins.clamp_min(0.0), lengths), dim=1).sort(dim=1).values
        middle, step = 0.5 * (stops[:, 1:] + stops[:, :-1]), stops.diff(dim=1)
        place = middle[..., None]
        is_curved = place > begins[:, None]
        weight = torch.where(is_curved, self.curved_stiffness, self.stiffness) * (place < lengths[:, None])
        bend = torch.where(is_curved, weight * self.curvature, torch.zeros_like(weight))
        stiff = weight.sum(dim=-1).clamp_min(_SMALL)
        # A tube at angle a bends towards (-sin a, cos a): curvature (-cos a, -sin a) about x and y.
        along_x = -(bend * angles.cos()[:, None]).sum(dim=-1) / stiff
        along_y = -(bend * angles.sin()[:, None]).sum(dim=-1) / stiff
        turn = torch.stack((along_x * step, along_y * step), dim=-1)
        return stops, chained(turn, step)

    def tip(self, lengths: Tensor, angles: Tensor) -> Tensor:
        """Where the innermost tubes end [m], (k, 3)."""
        stops, points = self.points(lengths, angles)
        nearest = (stops - lengths[:, :1]).abs().argmin(dim=1)
        return points[torch.arange(len(points), device=points.device), nearest]

    def to(self, device: torch.device, dtype: torch.dtype) -> TubeLine:
        """The same on a device."""
        parts = (self.curved, self.curvature, self.stiffness, self.curved_stiffness)
        return TubeLine(*(part.to(device=device, dtype=dtype) for part in parts))


def chained(turn: Tensor, step: Tensor) -> Tensor:
    """Ends of arcs that follow each other from the origin on, which leave it along +z.

    Args:
        turn: Of each arc about the x and y axes of the frame at its start [rad], (k, m, 2).
        step: Their lengths [m], (k, m).

    Returns:
        Positions [m], (k, m + 1, 3), the origin first.
    """
    tx, ty = turn.unbind(dim=-1)
    size = torch.sqrt(tx * tx + ty * ty)
    is_straight = size < 1.0e-6
    safe = torch.where(is_straight, torch.ones_like(size), size)
    half = torch.where(is_straight, torch.full_like(size, 0.5), (0.5 * safe).sin() / safe)
    b = torch.where(is_straight, torch.full_like(size, 0.5), (1.0 - safe.cos()) / safe.square())
    c = torch.where(is_straight, torch.full_like(size, 1.0 / 6.0), (safe - safe.sin()) / safe**3)
    # Of an arc: ahead + b turn x ahead + c turn x (turn x ahead), and its quaternion.
    way = torch.stack((b * ty * step, -b * tx * step, step - c * size.square() * step), dim=-1)
    arc = torch.stack((half * tx, half * ty, (0.5 * size).cos()), dim=-1)
    zero = torch.zeros_like(step[:, 0])
    x, q, points = [zero] * 3, (zero, zero, zero, torch.ones_like(zero)), [torch.zeros_like(way[:, 0])]
    for j in range(way.shape[1]):
        x = [a + d for a, d in zip(x, _turned(q, way[:, j].unbind(-1)), strict=True)]
        q = _followed(q, arc[:, j].unbind(-1))
        points.append(torch.stack(x, dim=-1))
    return torch.stack(points, dim=1)


def _turned(q: Sequence[Tensor], v: Sequence[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Vectors of frames of orientation q, by components."""
    (x, y, z, w), (a, b, c) = q, v
    t = (2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a))
    return (
        a + w * t[0] + y * t[2] - z * t[1],
        b + w * t[1] + z * t[0] - x * t[2],
        c + w * t[2] + x * t[1] - y * t[0],
    )


def _followed(q: Sequence[Tensor], step: Sequence[Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Quaternions q followed by ones (a, b, 0, c) in their frames."""
    (x, y, z, w), (a, b, c) = q, step
    return (w * a + x * c - z * b, w * b + y * c + z * a, z * c + x * b - y * a, w * c - x * a - y * b)
