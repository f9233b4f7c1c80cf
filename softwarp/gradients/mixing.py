"""Fixed points of many worlds, each led on by what its own last steps have in common.

A step that is nearly Newton's comes nearer by a constant factor, or, where the exact tangent is far from that of the
step in a few directions, goes away in these alone. With the points x, where they lead, g, and f = g - x, the next
point is the combination of the last g whose f would be least: D. G. Anderson, *Iterative procedures for nonlinear
integral equations*, J. ACM 12 (1965); H. F. Walker, P. Ni, SIAM J. Numer. Anal. 49 (2011).
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
DEPTH = 8  # steps that are combined


class Mixing:
    """Steps of some worlds, on the host and one by one, so that none changes a bit of another.

    Args:
        worlds: How many.
    """

    def __init__(self, worlds: int) -> None:
        self._past: list[list[tuple[FloatArray, FloatArray]]] = [[] for _ in range(worlds)]

    def next(self, before: torch.Tensor, after: torch.Tensor, going: torch.Tensor) -> torch.Tensor:
        """From where to take the next step.

        Args:
            before: Where the last one began, (world, row).
            after: Where it led, likewise.
            going: Worlds that it is asked for, (world,); others go on from where the last one led.
        """
        result = after.clone()
        for world in going.nonzero().flatten().tolist():
            x, g = (each[world].double().cpu().numpy() for each in (before, after))
            past = self._past[world]
            past.append((g, g - x))
            del past[: -DEPTH - 1]
            if len(past) > 1:
                result[world] = torch.as_tensor(_mixed(past)).to(result)
        return result


def _mixed(past: list[tuple[FloatArray, FloatArray]]) -> FloatArray:
    led, ways = (np.stack(each) for each in zip(*past, strict=True))
    slopes = np.diff(ways, axis=0).T
    sizes = np.maximum(np.linalg.norm(slopes, axis=0), np.finfo(np.float64).tiny)
    shares = np.linalg.lstsq(slopes / sizes, ways[-1], rcond=1e-10)[0] / sizes
    return np.asarray(led[-1] - np.diff(led, axis=0).T @ shares)
