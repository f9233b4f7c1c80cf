"""Material damping from what a ring-down shows."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from softwarp import checks


def rayleigh(first: tuple[float, float], second: tuple[float, float]) -> tuple[float, float]:
    """Rayleigh factors that give two modes their damping ratios: zeta = alpha / (2 omega) + beta omega / 2.

    A ring-down with the ratio of successive peaks r has zeta = d / sqrt(4 pi^2 + d^2), d = ln(1/r). Backward Euler adds
    omega h / 2 of its own: ``Modes.damping`` tells both.

    Args:
        first: Frequency [Hz] and damping ratio, part of the critical damping, of one mode.
        second: Those of another mode; between the two the ratio is smaller, outside larger.

    Returns:
        alpha [1/s] on mass and beta [s] on stiffness, as ``add_tets(rayleigh=)`` takes them.

    Raises:
        ValueError: For a frequency or ratio that is not positive, equal frequencies, or ratios so different that one
            factor would be negative.
    """
    rows, ratios = [], []
    for name, mode in (("first", first), ("second", second)):
        if not isinstance(mode, Sequence) or isinstance(mode, str) or len(mode) != 2:
            raise ValueError(checks.refusal(f"rayleigh: {name}", "be a frequency [Hz] and a damping ratio", mode))
        omega = 2.0 * math.pi * checks.number(mode[0], f"rayleigh: frequency of the {name} mode [Hz]", above=0.0)
        ratios.append(checks.number(mode[1], f"rayleigh: damping ratio of the {name} mode", above=0.0, below=1.0))
        rows.append((0.5 / omega, 0.5 * omega))
    low, high = sorted((first[0], second[0]))
    if high - low <= 1.0e-6 * high:
        raise ValueError(f"rayleigh: the modes must differ in frequency, got {first[0]:g} and {second[0]:g} Hz")
    alpha, beta = (float(value) for value in np.linalg.solve(np.array(rows), np.array(ratios)))
    if min(alpha, beta) < 0.0:
        name = "mass" if alpha < 0.0 else "stiffness"
        near = low / high
        raise ValueError(
            f"rayleigh: damping ratios {ratios[0]:g} at {first[0]:g} Hz and {ratios[1]:g} at {second[0]:g} Hz need a "
            f"negative factor of {name}; the larger may be at most {1.0 / near:.3g} times the smaller for these "
            f"frequencies"
        )
    return alpha, beta
