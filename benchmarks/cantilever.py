"""The silicone cantilever that simulators are compared on: 525 nodes, 1600 linear tetrahedra, bent by its weight.

0.195 x 0.025 x 0.025 m, clamped at x = 0, in 20 x 4 x 4 cells of five tetrahedra; E 450 kPa, Poisson's ratio 0.45,
density 1100 kg/m^3, gravity 9.81 m/s^2. Converged elements sag by 73.4 mm at the tip, linear ones on these cells by
59.4 mm (St. Venant-Kirchhoff): they lock.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import softwarp
from softwarp import meshing

SIZE = (0.195, 0.025, 0.025)  # m
CELLS = (20, 4, 4)
YOUNGS = 450.0e3  # Pa
NU = 0.45
DENSITY = 1100.0  # kg/m^3
GRAVITY = 9.81  # m/s^2
DAMPING = 0.01  # s, Rayleigh's on stiffness; it changes the way to rest, not the rest
DT = 0.01  # s
CONVERGED = 0.0734  # m, sag of the tip with elements that do not lock; extrapolated, see solids.py
LINEAR = 0.0594  # m, of linear tetrahedra on these cells

# Corners of a cell are numbered by the bits x + 2 y + 4 z. Neighbours are mirror images, so that diagonals meet.
_EVEN = ((0, 1, 2, 4), (3, 1, 7, 2), (5, 1, 4, 7), (6, 2, 7, 4), (1, 2, 4, 7))
_ODD = ((1, 0, 5, 3), (2, 0, 3, 6), (4, 0, 6, 5), (7, 3, 5, 6), (0, 3, 5, 6))


def mesh(cells: tuple[int, int, int] = CELLS) -> meshing.TetMesh:
    """Cells of five tetrahedra, the middle one turned in every other cell."""
    nodes = meshing.box(SIZE, cells).nodes
    across, up = cells[0] + 1, (cells[0] + 1) * (cells[1] + 1)
    tets = []
    for k, j, i in np.ndindex(cells[2], cells[1], cells[0]):
        corner = [i + (b & 1) + across * (j + (b >> 1 & 1)) + up * (k + (b >> 2)) for b in range(8)]
        tets += [[corner[c] for c in tet] for tet in (_ODD if (i + j + k) % 2 else _EVEN)]
    return meshing.TetMesh(nodes, meshing.orient(nodes, np.array(tets)), "cantilever")


def build(
    worlds: int, device: str, precision: str, cells: tuple[int, int, int] = CELLS, **options: Any
) -> softwarp.Simulation:
    """The cantilever, straight at the start."""
    builder = softwarp.ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
    material = softwarp.Corotational(YOUNGS, NU, method="large")
    body = builder.add_tets(mesh(cells), material=material, density=DENSITY, rayleigh=(0.0, DAMPING))
    builder.fix(body, nodes=clamped(builder.bodies[body].mesh.nodes))
    return softwarp.Simulation(builder.finalize(worlds, device, precision), dt=DT, **options)  # type: ignore[arg-type]


def drive(sim: softwarp.Simulation, step: int) -> None:
    """Let go of the straight beam from time to time, so that it is timed while it swings."""
    if step % 5 == 0:
        sim.reset()


def clamped(nodes: np.ndarray) -> np.ndarray:
    """Indices of the nodes that hold the beam."""
    return np.flatnonzero(nodes[:, 0] < 1e-6)


def masses(solid: meshing.TetMesh) -> np.ndarray:
    """Mass of each node [kg]: a quarter of those of the tetrahedra around it."""
    share = 0.25 * DENSITY * meshing.tet_volumes(solid.nodes, solid.tets)
    return np.bincount(solid.tets.ravel(), weights=np.repeat(share, 4), minlength=len(solid.nodes))


def sag(start: np.ndarray, nodes: np.ndarray) -> float:
    """How far the end of the beam came down [m], the mean over its nodes."""
    tip = start[:, 0] > SIZE[0] - 1e-6
    return float(np.mean(start[tip, 2] - nodes[tip, 2]))
