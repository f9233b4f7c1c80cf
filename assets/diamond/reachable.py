"""Make the table of reachable positions of the top from which the Diamond environment draws its goals.

    python assets/diamond/reachable.py --out softwarp/envs/diamond_reachable.npz

Random commands between 0 and 25 mm are applied to many worlds of the default scene and held for 1.5 seconds; tops at
rest are kept. Points are thinned to at most a few per cube of 4 mm, so that often-visited regions do not crowd out the
rest, and stored in random order: the first 80 % are training goals, the others evaluation goals. Takes some minutes on
two cores.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from softwarp.envs.scenes.diamond import CABLES
from softwarp.envs.tasks.diamond import Diamond, DiamondConfig

DT = 0.02  # s
HOLD_SECONDS = 1.5  # cables reach their commands within 0.25 s
RESTING = 0.002  # m/s, speed of the top below which a world counts as at rest
CUBE = 0.004  # m, edge of the cubes for thinning
PER_CUBE = 2
SINGLE = 0.3  # part of the commands in which one or two cables are slack


def random_commands(worlds: int, largest: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """Displacements [m], shape (world, 4); uniform, some cables left alone in part of the worlds."""
    command = largest * rng.uniform(size=(worlds, CABLES))
    idle = (rng.uniform(size=(worlds, 1)) < SINGLE) & (rng.uniform(size=(worlds, CABLES)) < 0.5)
    command[idle] = 0.0
    return command.astype(np.float32)


def collect(env: Diamond, rounds: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Tops at rest [m], shape (point, 3)."""
    sim, tops = env.sim, []
    env.reset()
    for number in range(rounds):
        command = random_commands(env.num_worlds, env.config.max_displacement, rng)
        sim.control.cable_displacement.copy_(torch.from_numpy(command))
        for _ in range(round(HOLD_SECONDS / DT)):
            sim.step()
        at_rest = sim.marker_v[:, env.scene.effector].norm(dim=-1) < RESTING
        tops.append(env.tip()[at_rest].double().cpu().numpy())
        sim.reset(~at_rest)
        print(f"round {number + 1} of {rounds}: {len(tops[-1])} of {env.num_worlds} worlds at rest", flush=True)
    return np.concatenate(tops)


def thin(points: NDArray[np.float64], count: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """At most ``count`` points in random order, at most ``PER_CUBE`` in a cube."""
    cubes: dict[tuple[int, ...], int] = {}
    kept = []
    for point in points[rng.permutation(len(points))]:
        cube = tuple(np.floor(point / CUBE).astype(int))
        cubes[cube] = cubes.get(cube, 0) + 1
        if cubes[cube] <= PER_CUBE:
            kept.append(point)
    distinct = np.unique(np.round(np.array(kept), 5).astype(np.float32), axis=0)
    return distinct[rng.permutation(len(distinct))[:count]]


def main() -> None:
    """Run the simulation and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("softwarp/envs/diamond_reachable.npz"))
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--rounds", type=int, default=24)
    parser.add_argument("--points", type=int, default=1000)
    parser.add_argument("--mesh", default="medium")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    config = DiamondConfig(mesh=args.mesh, dt=DT, goals="list")
    env = Diamond(config, num_worlds=args.worlds, device=args.device, seed=args.seed)
    points = thin(collect(env, args.rounds, rng), args.points, rng)
    np.savez_compressed(args.out, tip=points)
    print(f"{len(points)} points, box {points.min(axis=0)} to {points.max(axis=0)} m, {args.out.stat().st_size} bytes")


if __name__ == "__main__":
    main()
