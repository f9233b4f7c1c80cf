"""Converged ways of the Diamond's top under commanded lengths of cables, whose ends pull at patches of the elbows.

    python assets/diamond/commanded.py truth   # 40 min on one core, 4 GB: renews commanded.csv
    python assets/diamond/commanded.py test    # 30 s: errors of the robot's variants

A solid gives way without bound under a point that is pulled, so that a length commanded to a cable which ends in one
has no converged answer. Here it ends in a patch, as large on every mesh: the outer face of an elbow between three rows
of a leg's sections, 17 mm high. A cable pulls evenly at all of it, its length is that from the anchor to the mean of
the patch, and each is the other's work conjugate. So truth needs no cables: half of the body is pulled by tractions of
given tension, their directions found by iterating, and the mean's way tells the command. None of this was fitted.
"""

from __future__ import annotations

import sys
from pathlib import Path

import coarsen
import numpy as np
import torch
from numpy.typing import NDArray

import softwarp
from softwarp.envs.options.diamond import DiamondSceneConfig
from softwarp.envs.scenes.diamond import build_diamond_scene

Floats = NDArray[np.float64]
TABLE = Path(__file__).parent / "commanded.csv"
COLUMNS = [f"tension_{side}" for side in ("east", "west", "north_south")]
COLUMNS += [f"command_{side}" for side in ("east", "west", "north_south")] + ["top_x", "top_y", "top_z"]
ANCHORS = np.array([[0.010, 0.0, 0.030], [-0.010, 0.0, 0.030], [0.0, 0.010, 0.030]])  # m, of cables east, west, north
ORDER = ("north_south", "west", "north_south", "east")  # of the robot's cables
FINE, SWEEPS = (2, 3), (5, 3)  # times the coarse mesh's cells along every edge, and solutions until directions hold
GROUP = 3  # loads at once, for the sake of memory
SLACK = 0.001  # m, less than this below its length a slack cable is commanded to


def read() -> tuple[Floats, Floats, Floats]:
    """Tensions [N] and commands [m] of the cables east, west and both others, (load, 3), and the top's ways [m]."""
    table = np.loadtxt(TABLE, delimiter=",", skiprows=1).reshape(-1, 9)
    return table[:, :3], 1e-3 * table[:, 3:6], 1e-3 * table[:, 6:]


def ways(cells: int, tensions: Floats, directions: Floats | None, sweeps: int) -> tuple[Floats, Floats, Floats]:
    """Ways of the top and of the patches' means [m], and directions of cables, under tensions (load, 3) [N]."""
    half = coarsen.Half(cells, np.column_stack([np.zeros((len(tensions), 2)), tensions]))
    rest = half.patch_means()
    directions = _towards(ANCHORS - rest) if directions is None else directions
    rate, before = np.ones(len(tensions)), None
    for sweep in range(sweeps):
        pull = tensions[:, :, None] / coarsen.outer_area() * directions
        half.sim.control.traction[:] = torch.tensor(pull)
        if not half.sim.solve_static().converged.all():
            raise RuntimeError("a load has no equilibrium")
        off = _towards(ANCHORS - half.patch_means()) - directions
        own = (off * (tensions > 0.0)[:, :, None]).reshape(len(tensions), -1)
        print(f"{cells} times the cells: directions change by {np.abs(own).max():.1e}", flush=True)
        if sweep == sweeps - 1:
            break
        if before is not None:  # Aitken's acceleration
            change = own - before
            share = (before * change).sum(axis=1) / np.maximum(np.square(change).sum(axis=1), 1e-30)
            rate = np.clip(-rate * share, 0.3, 2.5)
        before, directions = own, directions + rate[:, None, None] * off
    return half.sim.marker_x[:, 0].numpy() - half.start[0], half.patch_means() - rest, directions + off


def renew() -> None:
    """Find the limit of two meshes for all tensions in the table."""
    tensions = read()[0]
    tops, moved, directions = [], [], None
    for cells, sweeps in zip(FINE, SWEEPS, strict=True):
        groups = [slice(i, i + GROUP) for i in range(0, len(tensions), GROUP)]
        parts = [ways(cells, tensions[g], None if directions is None else directions[g], sweeps) for g in groups]
        top, mean, directions = (np.concatenate([part[k] for part in parts]) for k in range(3))
        tops.append(top)
        moved.append(mean)
    share = FINE[0] ** 2 / (FINE[1] ** 2 - FINE[0] ** 2)
    rest = coarsen.Half(1, np.zeros((1, 5))).patch_means()
    lengths = [np.linalg.norm(ANCHORS - rest, axis=1) - np.linalg.norm(ANCHORS - rest - m, axis=2) for m in moved]
    limits = [fine + share * (fine - coarse) for coarse, fine in (lengths, tops)]
    table = np.column_stack([tensions, 1e3 * limits[0], 1e3 * limits[1]])
    np.savetxt(TABLE, table, "%.5g", ",", header=",".join(COLUMNS), comments="")


def _towards(way: Floats) -> Floats:
    return np.asarray(way / np.linalg.norm(way, axis=-1, keepdims=True))


def errors(config: DiamondSceneConfig) -> Floats:
    """How far off the top of a robot is under the table's commands, per way of the top."""
    tensions, commands, truth = read()
    commands = np.where(tensions > 0.0, commands, commands - SLACK)
    builder = softwarp.ModelBuilder(gravity=config.gravity)
    scene = build_diamond_scene(config, builder)
    sim = softwarp.Simulation(builder.finalize(len(commands), "cpu", "float64"))
    sim.params.cable_min_displacement[:] = -0.01  # a few truths are let out by tenths of a millimetre
    sim.params.cable_max_displacement[:] = 0.04
    start = sim.marker_x[0, scene.effector].numpy().copy()
    column = [COLUMNS.index(f"command_{side}") - 3 for side in ORDER]
    sim.control.cable_displacement[:] = torch.tensor(commands[:, column])
    if not sim.solve_static().converged.all():
        raise RuntimeError("a command has no equilibrium")
    off = sim.marker_x[:, scene.effector].numpy() - start - truth
    return np.asarray(np.linalg.norm(off, axis=1) / np.linalg.norm(truth, axis=1))


def test() -> None:
    """Print errors of the robot's variants."""
    print(f"ways of the top: {(1e3 * np.linalg.norm(read()[2], axis=1)).round(1).tolist()} mm")
    accurate = {"fidelity": "accurate"}
    points = dict(DiamondSceneConfig.ACCURATE) | {"cable_ends": "points"}
    for name, options in (("default", {}), ("accurate", accurate), ("accurate, but for points", points)):
        print(f"{name}: off by {(100.0 * errors(DiamondSceneConfig(**options))).round(2).tolist()} %", flush=True)


if __name__ == "__main__":
    {"truth": renew, "test": test}[sys.argv[1]]()
