"""Fits COARSE_STIFFNESS of softwarp/meshing/diamond_geometry.py: numerical coarsening of the Diamond.

    python assets/diamond/coarsen.py truth   # 30 min, 4 GB: renews converged.csv
    python assets/diamond/coarsen.py fit     # 1 min: factors, and errors of the top

Quadratic elements on the coarse mesh are stiffer than converged ones, here more, there less: most in the upper half of
a leg. Factors of the modulus at four rows of a leg's sections make up for it. They are fitted to ways of the top and of
elbows under the loads that are marked as such, and tested under the others, which are larger, smaller and mixed. Loads
are gravity and pulls at the outer faces of elbows towards the cables' anchors, spread evenly over two rows, since there
is no limit under a point. All are symmetric about y = 0: half of the body is enough.

Reference: Kharevych, Mullen, Owhadi, Desbrun (2009), Numerical coarsening of inhomogeneous elastic materials.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

import softwarp
from softwarp import meshing
from softwarp.envs.options.diamond import DiamondSceneConfig
from softwarp.envs.scenes.diamond import EFFECTOR
from softwarp.meshing import diamond_geometry

Floats = NDArray[np.float64]
TABLE = Path(__file__).parent / "converged.csv"
HEADER = "fitted,gravity_x,gravity_z,east,west,north_south," + ",".join(
    f"{point}_{axis}" for point in ("top", "east", "west", "north") for axis in "xyz"
)
SIDES = ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0))  # east, west, north
PULL = np.array([-0.087, -0.015]) / np.hypot(0.087, 0.015)  # along the side's axis and up, from elbow to anchor
FINE = (2, 3)  # as many times the coarse mesh's cells along every edge
ORDER = 2  # in which ways converge
WEIGHT = (1.0, 0.3, 0.3, 0.3)  # of errors of top and elbows
GROUP = 5  # loads at once, for the sake of memory
ITERATIONS, STEP, DAMPING, LARGEST = 6, 0.02, 1e-3, 0.3  # of the fit


class Half:
    """The half of the body with y above 0, in float64.

    Args:
        cells: As many times those of the coarse mesh.
        loads: Gravity along x and z [m/s^2], pulls at the elbows east, west and both others [N], (load, 5).
    """

    def __init__(self, cells: int, loads: Floats) -> None:
        config = DiamondSceneConfig()
        diamond_geometry.DETAILS["part"] = (cells, 2 * cells, cells)
        whole = meshing.diamond("part")
        kept = whole.nodes[whole.tets].mean(axis=1)[:, 1] > 0.0
        used, tets = np.unique(whole.tets[kept], return_inverse=True)
        self.places = diamond_geometry.diamond_places("part")[kept]
        builder = softwarp.ModelBuilder()
        law = softwarp.Corotational(config.youngs, config.nu, method="warped")
        tets = tets.reshape(-1, 4)
        body = builder.add_tets(whole.nodes[used], tets, material=law, element="p2", total_mass=0.5 * config.total_mass)
        x = builder.bodies[body].mesh.nodes
        held = (np.abs(x[:, :2]) <= config.base_half + 1e-9).all(axis=1) & (x[:, 2] <= 0.01)
        builder.fix(body, nodes=np.flatnonzero(held))
        builder.fix(body, nodes=np.flatnonzero(~held & (np.abs(x[:, 1]) < 1e-9)), axes="y")
        builder.add_marker(body, EFFECTOR, tolerance=0.006)
        for side in SIDES:
            builder.add_traction(body, where=_outer(side))
            builder.add_marker(body, (0.0925 * side[0], 0.0925 * side[1], 0.045))
        self.patches = [(traction.node, traction.share) for traction in builder.scene.tractions]
        self.sim = softwarp.Simulation(builder.finalize(len(loads), "cpu", "float64"))
        assert self.sim.model.quadratic is not None
        self.weights = self.sim.model.quadratic.point_volume.numpy()
        self._unweighted = self.weights.copy()
        self.start = self.sim.marker_x[0].numpy().copy()
        self.sim.params.gravity.copy_(torch.tensor([(x, 0.0, z) for x, z in loads[:, :2]]))
        for i, side in enumerate(SIDES):
            pull = np.array([PULL[0] * side[0], PULL[0] * side[1], PULL[1]])
            self.sim.control.traction[:, i] = torch.tensor(loads[:, 2 + i, None] / outer_area() * pull)

    def ways(self, stiffness: Floats | None = None) -> Floats:
        """Of top and elbows [m], (load, 4, 3), with factors of the modulus, (tet,)."""
        factors = 1.0 if stiffness is None else np.repeat(stiffness, 4)
        self.weights[:] = self._unweighted * factors
        if not self.sim.solve_static().converged.all():
            raise RuntimeError("a load has no equilibrium")
        return np.asarray(self.sim.marker_x.numpy() - self.start)

    def patch_means(self) -> Floats:
        """Mean places of the faces that are pulled, of whole elbows [m], (load, 3, 3)."""
        x = self.sim.node_x.numpy()
        found = np.stack([share @ x[:, node] / share.sum() for node, share in self.patches], axis=1)
        found[:, :2, 1] = 0.0  # the other half is the mirror image
        return np.asarray(found)


def _outer(side: Sequence[float]) -> Callable[[Floats], NDArray[np.bool_]]:
    """Which middles of faces lie outside on a side's elbow, rather than on its flanks or in the plane y = 0."""
    along, across = np.array(side), np.array([-side[1], side[0]])

    def where(middle: Floats) -> NDArray[np.bool_]:
        off = np.abs(middle[:, :2] @ across)
        is_near = (middle[:, 2] > 0.0385) & (middle[:, 2] < 0.056) & (middle[:, :2] @ along > 0.0905)
        return np.asarray(is_near & (off < 0.009) & (off > 1e-6))

    return where


def outer_area() -> float:
    """Of the faces that are pulled at a whole elbow [m^2]."""
    rows = np.array(diamond_geometry.SECTIONS)[diamond_geometry.PATCH_ROWS]
    lengths = np.hypot(*np.diff(rows[:, 2:4], axis=0).T)
    return float((lengths * (rows[1:, 4] + rows[:-1, 4])).sum())


def read() -> tuple[NDArray[np.bool_], Floats, Floats]:
    """Which loads are fitted, the loads, (load, 5), and converged ways of top and elbows [m], (load, 4, 3)."""
    table = np.loadtxt(TABLE, delimiter=",", skiprows=1)
    return table[:, 0] > 0.5, table[:, 1:6], 1e-3 * table[:, 6:].reshape(-1, 4, 3)


def renew() -> None:
    """Find converged ways of all loads in the table: the limit of the two finest meshes."""
    fitted, loads, _ = read()
    found = []
    for cells in FINE:
        groups = [loads[i : i + GROUP] for i in range(0, len(loads), GROUP)]
        found.append(np.concatenate([Half(cells, group).ways() for group in groups]))
    share = FINE[0] ** ORDER / (FINE[1] ** ORDER - FINE[0] ** ORDER)
    limit = 1e3 * (found[1] + share * (found[1] - found[0])).reshape(-1, 12)
    np.savetxt(TABLE, np.column_stack([fitted, loads, limit]), "%.4g", ",", header=HEADER, comments="")


def fit() -> None:
    """Levenberg's method on logarithms of the factors, from 1; then errors under all loads."""
    fitted, loads, truth = read()
    extent = np.linalg.norm(truth[:, 0], axis=1)
    rows = np.array(diamond_geometry.COARSE_STIFFNESS[0])
    half, log = Half(1, loads[fitted]), np.zeros(len(rows))

    def residual(log: Floats) -> Floats:
        off = half.ways(_factors(half, rows, log)) - truth[fitted]
        return np.asarray((off / extent[fitted, None, None] * np.array(WEIGHT)[:, None]).ravel())

    for _ in range(ITERATIONS):
        now = residual(log)
        slopes = np.array([(residual(log + STEP * unit) - now) / STEP for unit in np.eye(len(rows))])
        change = np.linalg.solve(slopes @ slopes.T + DAMPING * np.eye(len(rows)), slopes @ now)
        log = log - np.clip(change, -LARGEST, LARGEST)
        print(f"{np.exp(log).round(3).tolist()}, before it {np.square(now).sum():.6f}", flush=True)
    half = Half(1, loads)
    off = 100.0 * np.linalg.norm((half.ways(_factors(half, rows, log)) - truth)[:, 0], axis=1) / extent
    for name, chosen in (("fitted", fitted), ("others", ~fitted)):
        print(f"the top is off by {off[chosen].round(1).tolist()} % under {name}", flush=True)


def _factors(half: Half, rows: Floats, log: Floats) -> Floats:
    return np.interp(half.places, rows, np.exp(log))


if __name__ == "__main__":
    {"truth": renew, "fit": fit}[sys.argv[1]]()
