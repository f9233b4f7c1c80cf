"""A channel like a nasal passage: from a nostril at the origin up and back to the choana, tall and narrow in between.

Measures [m] taken from the nasal cavity of SofaGym's ConcentricTubeRobot; source: assets/nasal/README.md.
The passage is one lumen with elliptical sections, without the turbinates that divide a real one.
"""

from __future__ import annotations

import numpy as np

from softwarp import checks
from softwarp.meshing.lumen import Lumen
from softwarp.meshing.tets import MeshError

# Places of the centre line, and semi-axes across (x) and upright there.
PLACES = ((0.0, 0.0, -6.0), (0.0, 0.0, 3.0), (0.0, 4.0, 20.0), (0.0, 17.0, 41.0), (0.0, 38.0, 57.0), (0.0, 58.0, 66.0))
SEMI_AXES = ((4.0, 5.0), (4.5, 5.5), (6.5, 11.0), (7.5, 14.0), (7.5, 12.5), (6.5, 9.0))
NOSTRIL, CHOANA = (0.0, 0.0, 0.0), (0.0, 0.058, 0.066)
SPACING = 2.0e-3  # between sections
SHIFT = np.array([0.0, 0.0, 2.0e-3, 4.0e-3, 4.0e-3, 3.0e-3])  # of places of random passages, at most, on each axis
WIDTH = 0.15  # by which semi-axes of random passages differ, at most
NARROWEST = 2.0e-3  # semi-axis that instruments still pass


def nasal_passage(seed: int | None = None, *, scale: float = 1.0, variation: float = 1.0) -> Lumen:
    """The passage, or one of a random anatomy; its first section lies 6 mm outside the nostril.

    Args:
        seed: Of a random anatomy: places and semi-axes are shifted, the straight vestibule apart. None gives the
            standard one.
        scale: Size relative to the standard one.
        variation: How much random anatomies differ, 1 for up to 4 mm of place and 15 % of width.

    Raises:
        MeshError: If the passage becomes narrower than 2 mm of semi-axis.
    """
    scale = checks.number(scale, "nasal passage: scale", above=0.0)
    variation = checks.number(variation, "nasal passage: variation", low=0.0, high=3.0)
    places, axes = 1.0e-3 * np.array(PLACES), 1.0e-3 * np.array(SEMI_AXES)
    name = "nasal passage"
    if seed is not None:
        rng = np.random.default_rng(checks.seed(seed))
        places = places + variation * SHIFT[:, None] * rng.uniform(-1.0, 1.0, places.shape)
        axes = axes * (1.0 + variation * WIDTH * rng.uniform(-1.0, 1.0, axes.shape))
        name = f"nasal passage {seed}"
    if scale * axes.min() < NARROWEST:
        raise MeshError(
            f"{name}: a semi-axis of {1e3 * scale * axes.min():.2g} mm is too narrow, at least {1e3 * NARROWEST:g} mm "
            "are needed; take another seed, a larger scale or less variation"
        )
    return Lumen.through(scale * places, scale * axes, SPACING, name=name)
