"""Make the table of poses that the wrapped cup can be brought to; the TrunkCup environment draws its goals from it.

    python assets/trunk_cup/reachable.py --out softwarp/envs/trunk_cup_reachable.npz

In every round all worlds start in the grasp. Random changes of the cables' lengths are approached at the speed of the
actions and held for 1.5 seconds. Poses at rest are kept where the cup still hangs on the trunk and no element is inside
out, with the commands that led there. Rows that would be met at the start are left out, the others thinned to a few per
cube of 4 mm and 15 degrees, and stored in random order: the first 80 % are training goals, the others evaluation goals.
On two cores a round of 32 worlds takes a minute; ``--earlier`` adds to a table, best with another ``--seed``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from softwarp.envs.options.trunk_cup import TrunkCupConfig
from softwarp.envs.tasks.trunk_cup import CABLES, TrunkCup

DT = 0.01  # s
SPEED = 0.1  # m/s, of the cables
HOLD_SECONDS = 1.5
RESTING = 0.002  # m/s, speed of the cup below which a world counts as at rest
LARGEST = (0.018, 0.009)  # m, change of long and short cables
CUBE, TURN = 0.004, 0.26  # m and length of a difference of axes, of the cells for thinning
PER_CELL = 6


def random_changes(worlds: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Changes of displacements [m], (world, 8): most of them pull one side and let the other go."""
    change = np.zeros((worlds, CABLES))
    for columns, largest in ((slice(0, 4), LARGEST[0]), (slice(4, 8), LARGEST[1])):
        both = rng.uniform(-1.0, 1.0, (worlds, 2))  # along +y and -x
        each = np.concatenate((both, -both), axis=1) + 0.4 * rng.uniform(-1.0, 1.0, (worlds, 4))
        change[:, columns] = largest * each * rng.uniform(0.4, 1.0, (worlds, 1))
    return change.astype(np.float32)


def collect(env: TrunkCup, rounds: int, rng: np.random.Generator) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Poses (pose, 6) and commands [m] (pose, 8) at rest."""
    sim, poses, commands = env.sim, [], []
    low, high = env.displacement_limits()
    for number in range(rounds):
        sim.reset()
        start = sim.control.cable_displacement.clone()
        goal = start + torch.from_numpy(random_changes(env.num_worlds, rng)).to(start)
        goal = goal.clamp(low.to(start), high.to(start))
        for step in range(round(2.0 * max(LARGEST) / (SPEED * DT))):
            change = (goal - start).clamp(-(step + 1) * SPEED * DT, (step + 1) * SPEED * DT)
            sim.control.cable_displacement.copy_(start + change)
            sim.step()
        for _ in range(round(HOLD_SECONDS / DT)):
            sim.step()
        at_rest = sim.marker_v.norm(dim=-1).amax(dim=1) < RESTING
        kept = at_rest & ~env.is_dropped() & (sim.inverted_count == 0) & (sim.status == 0)
        poses.append(torch.cat((env.tip(), env.axis()), dim=1)[kept].cpu().numpy())
        commands.append(sim.control.cable_displacement[kept].float().cpu().numpy())
        lost = int(env.is_dropped().sum())
        moving = int((~at_rest).sum())
        print(
            f"round {number + 1} of {rounds}: {len(poses[-1])} of {env.num_worlds} kept, {lost} dropped, {moving} "
            f"moving, up to {int(sim.contact_count.max())} contacts, overflow {int(sim.contact_overflow.max())}",
            flush=True,
        )
    return np.concatenate(poses), np.concatenate(commands)


def is_far(env: TrunkCup, poses: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Whether a pose is not met at the start, (pose,)."""
    place, axis = env.start_tip[0].cpu().numpy(), env.start_axis[0].cpu().numpy()
    way, cosine = np.linalg.norm(poses[:, :3] - place, axis=1), poses[:, 3:] @ axis
    return np.asarray((way > env.config.success_tolerance) | (cosine < np.cos(env.config.axis_tolerance)))


def thin(poses: NDArray[np.float32], count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Rows in random order, at most ``PER_CELL`` in a cell."""
    cells: dict[tuple[int, ...], int] = {}
    kept = []
    for row in rng.permutation(len(poses)):
        cell = tuple(np.floor(poses[row] / (*[CUBE] * 3, *[TURN] * 3)).astype(int))
        cells[cell] = cells.get(cell, 0) + 1
        if cells[cell] <= PER_CELL:
            kept.append(row)
    return np.array(kept[:count])


def main() -> None:
    """Run the simulation and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("softwarp/envs/trunk_cup_reachable.npz"))
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--earlier", type=Path, help="a table to add to")
    parser.add_argument("--poses", type=int, default=3000)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    env = TrunkCup(TrunkCupConfig(dt=DT, goals="list"), num_worlds=args.worlds, device=args.device, seed=args.seed)
    poses, commands = collect(env, args.rounds, rng)
    if args.earlier:
        with np.load(args.earlier) as held:
            poses, commands = (np.concatenate(both) for both in ((poses, held["pose"]), (commands, held["command"])))
    far = is_far(env, poses)
    poses, commands = poses[far], commands[far]
    rows = thin(poses, args.poses, rng)
    poses, commands = poses[rows], commands[rows]
    np.savez_compressed(args.out, pose=poses, command=commands)
    way = np.linalg.norm(poses[:, :3] - env.start_tip[0].cpu().numpy(), axis=1)
    print(f"{len(poses)} poses, box {poses.min(axis=0)} to {poses.max(axis=0)}")
    print(f"median way from the start {np.median(way):.4f} m, {args.out.stat().st_size} bytes")


if __name__ == "__main__":
    main()
