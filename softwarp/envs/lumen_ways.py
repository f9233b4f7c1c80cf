"""How far a point is along the centre line of a lumen, for all worlds at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from softwarp.envs import sums
from softwarp.meshing import Lumen

POINTS = 200  # of each line


class LumenWays:
    """Centre lines of lumina, of which each world follows one: the ways to the outlets of a vessel, for example.

    Args:
        lumens: Ways, each from the inlet on.
        device: Of all tensors.
        points: That each line is cut into.
    """

    def __init__(self, lumens: Sequence[Lumen], device: torch.device, points: int = POINTS) -> None:
        lines = np.stack([lumen.resampled(points).points for lumen in lumens]).astype(np.float32)
        self.lines = torch.as_tensor(lines, device=device)  # (way, point, 3)
        self.start, self.step = self.lines[:, :-1].contiguous(), self.lines.diff(dim=1)
        length = torch.linalg.vector_norm(self.step, dim=-1)
        self.arc = torch.cat((torch.zeros_like(length[:, :1]), length.cumsum(dim=1)), dim=1)  # m, (way, point)
        self.length = self.arc[:, -1].contiguous()  # m, (way,)
        self._piece, self._square = length, length.square()

    def along(self, points: Tensor, way: Tensor) -> tuple[Tensor, Tensor]:
        """Length of the line up to the place nearest to points, and how far away it is [m], (world,) each.

        Args:
            points: [m], (world, 3).
            way: Number of the line of each world, int64 (world,).
        """
        start, step = self.start[way], self.step[way]
        between = points[:, None].to(start.dtype) - start
        t = (sums.in_order((between * step).unbind(dim=-1)) / self._square[way]).clamp(0.0, 1.0)
        away, nearest = sums.length_of(between - t[..., None] * step).min(dim=1)
        at = nearest[:, None]
        arc = self.arc[way].gather(1, at) + t.gather(1, at) * self._piece[way].gather(1, at)
        return arc[:, 0], away
