"""Ways along lumina in a batch are those of each lumen alone."""

from __future__ import annotations

import numpy as np
import torch

from softwarp.envs.lumen_ways import LumenWays
from softwarp.meshing import Lumen


def test_ways_of_worlds_are_those_of_their_lumen() -> None:
    """Each world follows its own line."""
    lumens = [
        Lumen(np.array([(0.0, 0.0, 0.0), (0.0, 0.0, 0.05)]), np.array(0.003)),
        Lumen(np.array([(0.0, 0.0, 0.0), (0.0, 0.03, 0.03), (0.0, 0.06, 0.03)]), np.array(0.003)),
    ]
    rng = np.random.default_rng(0)
    points, way = rng.uniform(0.0, 0.05, (20, 3)), np.arange(20) % 2
    arc, away = LumenWays(lumens, torch.device("cpu")).along(torch.as_tensor(points), torch.as_tensor(way))
    for k, (point, number) in enumerate(zip(points, way, strict=True)):
        own = lumens[number].resampled(200).along(point)
        np.testing.assert_allclose([float(arc[k]), float(away[k])], [own[0][0], own[1][0]], atol=1e-6)
