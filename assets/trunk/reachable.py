"""Make the table of reachable tip positions from which the Trunk environment draws its goals.

    python assets/trunk/reachable.py --out softwarp/envs/trunk_reachable.npz

Random commands are applied to many worlds of the default scene and held for two seconds. Tips at rest are kept, unless
the trunk is folded so sharply that an element is turned inside out, or crushed until two points of a cable are nearer
than its closing length; all other worlds start anew. Rows are thinned to at most a few per cube of 6 mm, so that
often-visited regions do not crowd out the rest, and stored in random order: the first 80 % are training goals, the
others evaluation goals. Takes about ten minutes on two cores.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from softwarp.envs.tasks.trunk import Trunk, TrunkConfig
from softwarp.meshing.trunk_geometry import CABLE_SIDES

DT = 0.02  # s
HOLD_SECONDS = 2.0  # cables reach their commands within 0.5 s, most worlds rest after 1.5 s
RESTING = 0.010  # m/s, tip speed below which a world counts as at rest
CUBE = 0.006  # m, edge of the cubes for thinning
PER_CUBE = 3
UPWARD = 0.4  # part of the commands that bend upwards


def random_commands(worlds: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Displacements [m], shape (world, 8): a bend of the whole trunk, one of its lower half, and some common pull.

    Gravity keeps most bends low, so part of them is drawn around upwards, +y.
    """
    sides = np.array(CABLE_SIDES)
    command = np.zeros((worlds, 8))
    up = rng.uniform(size=worlds) < UPWARD
    for columns, largest in ((slice(0, 4), 0.042), (slice(4, 8), 0.020)):
        angle = rng.uniform(0.0, 2.0 * math.pi, worlds)
        angle[up] = rng.normal(0.5 * math.pi, 0.7, up.sum())
        amplitude = largest * rng.uniform(0.0, 1.0, worlds)
        direction = np.stack((np.cos(angle), np.sin(angle)), axis=1)
        common = 0.2 * largest * rng.uniform(-1.0, 1.0, worlds)
        command[:, columns] = amplitude[:, None] * (direction @ sides.T) + common[:, None]
    return command.astype(np.float32)


def collect(env: Trunk, rounds: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Tips at rest [m], shape (point, 3)."""
    sim, tips = env.sim, []
    env.reset()
    for number in range(rounds):
        sim.control.cable_displacement.copy_(torch.from_numpy(random_commands(env.num_worlds, rng)))
        for _ in range(round(HOLD_SECONDS / DT)):
            sim.step()
        at_rest = sim.marker_v.mean(dim=1).norm(dim=-1) < RESTING
        kept = at_rest & ~inverted(env) & ~crushed(env)
        tips.append(env.tip()[kept].double().cpu().numpy())
        sim.reset(~kept)
        print(f"round {number + 1} of {rounds}: {len(tips[-1])} of {env.num_worlds} worlds kept", flush=True)
    return np.concatenate(tips)


def inverted(env: Trunk) -> torch.Tensor:
    """Whether a world has an element of negative volume, bool (world,)."""
    corners = env.sim.node_x[:, torch.as_tensor(env.sim.model.tet_corners, dtype=torch.int64, device=env.device)]
    volume: torch.Tensor = torch.linalg.det(corners[:, :, 1:] - corners[:, :, :1])
    return (volume <= 0.0).any(dim=1)


def crushed(env: Trunk) -> torch.Tensor:
    """Whether a segment of a cable is shorter than its closing length, bool (world,)."""
    length = env.sim.cable_x.diff(dim=1).norm(dim=-1)
    between = torch.as_tensor(env.sim.model.cable_starts[1:-1] - 1, dtype=torch.int64, device=env.device)
    length[:, between] = math.inf  # from the end of a cable to the start of the next
    return (length < env.config.closing_length).any(dim=1)


def thin(points: NDArray[np.float64], count: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """At most ``count`` points in random order, at most ``PER_CUBE`` in a cube."""
    points = points[rng.permutation(len(points))]
    cubes: dict[tuple[int, ...], int] = {}
    kept = []
    for point in points:
        cube = tuple(np.floor(point / CUBE).astype(int))
        cubes[cube] = cubes.get(cube, 0) + 1
        if cubes[cube] <= PER_CUBE:
            kept.append(point)
    distinct = np.unique(np.round(np.array(kept), 5).astype(np.float32), axis=0)
    return distinct[rng.permutation(len(distinct))[:count]]


def main() -> None:
    """Run the simulation and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("softwarp/envs/trunk_reachable.npz"))
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--rounds", type=int, default=200)
    parser.add_argument("--points", type=int, default=4500)
    parser.add_argument("--mesh", default="medium")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    config = TrunkConfig(mesh=args.mesh, dt=DT, goals="list")
    env = Trunk(config, num_worlds=args.worlds, device=args.device, seed=args.seed)
    points = thin(collect(env, args.rounds, rng), args.points, rng)
    np.savez_compressed(args.out, tip=points)
    print(f"{len(points)} points, box {points.min(axis=0)} to {points.max(axis=0)} m, {args.out.stat().st_size} bytes")


if __name__ == "__main__":
    main()
