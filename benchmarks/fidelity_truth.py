"""Where the top of the Diamond rests on meshes of quadratic elements, finer and finer: truth of ``bench fidelity``.

    python -m benchmarks.fidelity_truth          # 10 min on a quiet core, 6 GB

Loads that lie in a plane of symmetry need half of the body, those along its axis a quarter. Meshes have 1, 2, 3 and 4
times as many cells along every edge as "coarse". Ways of the top converge with the square of the cells' size, so that
the last two tell the limit; the two before them tell the same within 0.1 %.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import softwarp
from softwarp import meshing
from softwarp.envs.options.diamond import DiamondSceneConfig
from softwarp.envs.scenes.diamond import EFFECTOR
from softwarp.meshing import diamond_geometry

Floats = NDArray[np.float64]
ORDER = 2
AXIAL = ((0.0, 0.0, -5.0), (0.0, 0.0, 10.0))  # m/s^2
SIDE = ((5.0, 0.0, 0.0),)
OBLIQUE = ((2.5 * np.sqrt(2.0), 0.0, -2.5),)  # in axes that are turned by 45 degrees about z


def ways(cells: int, loads: Sequence[Sequence[float]], part: int, angle: float = 0.0) -> Floats:
    """Ways of the top [m] under loads [m/s^2], (load, 3).

    Args:
        cells: As many times those of the coarse mesh.
        loads: In axes that are turned about z.
        part: 4 for the quarter with x and y above 0 of the turned body, 2 for the half with y above 0.
        angle: By which axes are turned [rad].
    """
    config = DiamondSceneConfig()
    nodes, tets = _part(cells, part, angle)
    builder = softwarp.ModelBuilder()
    law = softwarp.Corotational(config.youngs, config.nu, method="warped")
    body = builder.add_tets(nodes, tets, material=law, element="p2", total_mass=config.total_mass / part)
    x = builder.bodies[body].mesh.nodes
    placed, half = x @ turned(angle), config.base_half + 1e-9
    held = (np.abs(placed[:, :2]) <= half).all(axis=1) & (x[:, 2] <= 0.01)
    builder.fix(body, nodes=np.flatnonzero(held))
    for axis in range(2 - part // 2, 2):
        builder.fix(body, nodes=np.flatnonzero(~held & (np.abs(x[:, axis]) < 1e-9)), axes="xy"[axis])
    builder.add_marker(body, EFFECTOR, tolerance=0.006)
    sim = softwarp.Simulation(builder.finalize(len(loads), "cpu", "float64"))
    sim.params.gravity.copy_(torch.tensor(loads))
    start = sim.marker_x[0, 0].numpy().copy()
    if not sim.solve_static().converged.all():
        raise RuntimeError(f"{cells} cells: a load has no equilibrium")
    return np.asarray(sim.marker_x[:, 0].numpy() - start)


def turned(angle: float) -> Floats:
    """Rows in turned axes times this are rows in the body's."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _part(cells: int, part: int, angle: float) -> tuple[Floats, NDArray[Any]]:
    """Nodes in turned axes and tets of a half or a quarter."""
    diamond_geometry.DETAILS["part"] = (cells, 2 * cells, cells)
    mesh = meshing.diamond("part")
    x = mesh.nodes @ turned(angle).T
    kept = (x[mesh.tets].mean(axis=1)[:, 2 - part // 2 : 2] > 0.0).all(axis=1)
    used, tets = np.unique(mesh.tets[kept], return_inverse=True)
    return x[used], tets.reshape(-1, 4)


def main() -> None:
    """Print ways and their limits [mm]."""
    for name, loads, part, angle, most in (
        ("along the axis", AXIAL, 4, 0.0, 4),
        ("sideways", SIDE, 2, 0.0, 3),
        ("obliquely", OBLIQUE, 2, 0.25 * np.pi, 3),
    ):
        found: list[Floats] = []
        for cells in range(1, most + 1):
            begin = time.perf_counter()
            found.append(1e3 * ways(cells, loads, part, angle) @ turned(angle))
            print(f"{name}, {cells}: {found[-1].round(3).tolist()} mm, {time.perf_counter() - begin:.0f} s", flush=True)
        share = (1.0 / most) ** ORDER / ((1.0 / (most - 1)) ** ORDER - (1.0 / most) ** ORDER)
        print(f"{name}: {(found[-1] + share * (found[-1] - found[-2])).round(2).tolist()} mm", flush=True)


if __name__ == "__main__":
    main()
