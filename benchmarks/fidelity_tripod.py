"""Where the Tripod rests on meshes of quadratic elements, finer and finer: truth of ``bench fidelity``.

    python -m benchmarks.fidelity_tripod          # 10 min on a quiet core, 7 GB

Meshes have 1, 2 and 3 times as many cells along every edge as "coarse"; the finest bears the first load alone, which
tells the order of convergence. It is below 2, as strains have no bound where legs are held and meet: with it the first
two meshes tell the limits of all loads. The last two tell that of the first one, by order 2, within 0.3 %.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
from scipy.optimize import brentq

from softwarp import meshing
from softwarp.envs.options.tripod import TripodSceneConfig
from softwarp.envs.scenes.tripod import HEIGHT
from softwarp.meshing import tripod_geometry

from .fidelity_robots import SOLID, TRIPOD_LOADS, Floats, hang_tripod

COARSE = np.array(tripod_geometry.DETAILS["coarse"])


def ways(cells: int, loads: Sequence[Sequence[float]]) -> Floats:
    """Ways of a point of the hole's rim [m] under loads [m/s^2] with as many times the cells, (load, 3)."""
    tripod_geometry.DETAILS["limit"] = tuple(cells * COARSE)
    mesh = meshing.tripod("limit")
    placed = meshing.TetMesh(mesh.nodes + np.array([0.0, 0.0, HEIGHT]), mesh.tets, mesh.name)
    places, start = hang_tripod(placed, TripodSceneConfig(**SOLID), loads)
    return places - start


def main() -> None:
    """Print ways and their limits [mm]."""
    found = []
    for cells, loads in ((1, TRIPOD_LOADS), (2, TRIPOD_LOADS), (3, TRIPOD_LOADS[:1])):
        begin = time.perf_counter()
        found.append(1e3 * ways(cells, loads))
        print(f"{cells}: {found[-1].round(4).tolist()} mm, {time.perf_counter() - begin:.0f} s", flush=True)
    first, second, third = (float(way[0, 2]) for way in found)
    steps = (second - first) / (third - second)
    order = float(brentq(lambda p: (1.0 - 2.0**-p) / (2.0**-p - 3.0**-p) - steps, 0.5, 4.0))
    limit = found[1] + (found[1] - found[0]) / (2.0**order - 1.0)
    print(f"order {order:.2f}: {limit.round(2).tolist()} mm; by order 2 {third + 0.8 * (third - second):.2f} mm")


if __name__ == "__main__":
    main()
