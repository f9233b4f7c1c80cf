"""How far from the origin positions are told well enough. Derivation and measurements: docs/theory/implicit_euler.md.

A coordinate x is a multiple of eps |x|, or of half that, so what is learned from differences of positions (strains,
gaps, motions within a step) gets worse with the distance from the origin. A part of size l is resolved where
eps |x| <= l / STEPS. Sizes are edges of soft bodies, segments of rods and sides of rigid bodies.
"""

from __future__ import annotations

import numpy as np

STEPS = 512  # positions that can be told from each other along a part's size, at least


def resolved_sizes(precision: str) -> float:
    """Distance from the origin up to which a part is resolved, in sizes of the part.

    Args:
        precision: ``float32``, which gives 16384, or ``float64``.
    """
    return 1.0 / (STEPS * float(np.finfo(precision).eps))


def spacing(distance: float, precision: str) -> float:
    """Distance [m] of neighbouring coordinates at a distance [m] from the origin."""
    return float(np.spacing(np.dtype(precision).type(distance)))
