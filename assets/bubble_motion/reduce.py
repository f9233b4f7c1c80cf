"""Makes softwarp/envs/bubble_motion_modes.npz, the modes of BubbleMotion with fidelity="accurate", and tests them.

    python assets/bubble_motion/reduce.py OUT.npz [--modes 60] [--contact-modes 30] [--tolerance 0.02]

Eight boards of quadratic elements have chambers filled at random under a rolling ball, then each chamber alone. The
board is its own image under quarter turns and mirrors, and so is what is learned: every state counts with its images.
About half an hour on one core, most of it for the motion, which ``--motion FILE`` keeps for other numbers of modes.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from softwarp import reduction
from softwarp.envs import registry
from softwarp.envs.options.bubble_motion import BubbleMotionConfig
from softwarp.reduction.motion import Watch

WORLDS, STRONGEST = 8, 400e3  # Pa
OPTIONS = {**BubbleMotionConfig.ACCURATE, "max_pressure": STRONGEST, "settle": False, "end_on_success": False}
ALONE = (4, 4, 0, 1, 2, 3, 5, 7)  # chamber that a world fills by itself


def commands(targets: int, seed: int) -> torch.Tensor:
    """Shares of the largest pressure, (target, world, 9): some empty, some full, the others between."""
    draws = torch.Generator().manual_seed(seed)
    share = torch.rand(targets, WORLDS, 9, generator=draws)
    kind = torch.rand(targets, WORLDS, 9, generator=draws)
    return torch.where(kind < 0.45, 0.0, torch.where(kind < 0.6, 1.0, share))


@torch.no_grad()
def record(targets: int, steps: int, seed: int) -> reduction.Motion:
    """Boards under pressures that go from target to target, a state every two steps; last each chamber by itself."""
    env = registry.make(
        "BubbleMotion", num_worlds=WORLDS, seed=seed, dt=0.02, action_repeat=steps, max_episode_steps=10_000, **OPTIONS
    )
    env.reset()
    watch, told = Watch(env.sim), commands(targets, seed)
    alone = torch.zeros(2, WORLDS, 9)
    alone[1, torch.arange(WORLDS), list(ALONE)] = 1.0
    for number, share in enumerate(torch.cat([told, alone])):
        begun = time.perf_counter()
        for substep in range(steps):
            env.apply_action(2.0 * share - 1.0, substep)
            env.sim.step()
            if substep % 2 == 1:
                watch.look()
        took, failed = time.perf_counter() - begun, int((env.sim.status > 2).sum())
        print(f"target {number + 1} of {targets + 2}: {took:.1f} s, {failed} worlds failed", flush=True)
    return watch.finish()


def turned(motion: reduction.Motion, rest: NDArray[np.float64]) -> reduction.Motion:
    """Every state, and its images by quarter turns."""
    parts = [motion]
    for quarter in range(1, 4):
        angle = 0.5 * np.pi * quarter
        c, s = np.round(np.cos(angle)), np.round(np.sin(angle))
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        apart, source = cKDTree(rest).query(rest @ turn)  # node that comes to this one
        if apart.max() > 1e-9:
            raise ValueError("the mesh is not its own image by quarter turns")
        assert motion.touch is not None
        moved, touch = ((x[:, source] @ turn.T).astype(np.float32) for x in (motion.positions, motion.touch))
        parts.append(reduction.Motion(moved, motion.travel, touch))
    return parts[0].joined(*parts[1:])


def main() -> None:
    """Record, train, save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--modes", type=int, default=60)
    parser.add_argument("--contact-modes", type=int, default=30)
    parser.add_argument("--tolerance", type=float, default=0.02)
    parser.add_argument("--states", type=int, default=64)
    parser.add_argument("--targets", type=int, default=16)
    parser.add_argument("--steps", type=int, default=10, help="from target to target")
    parser.add_argument("--norm", choices=["mass", "step"], default="step")
    parser.add_argument("--most", type=int, default=300, help="states of the motion that count, each with its images")
    parser.add_argument("--motion", type=Path, help="file that the motion is kept in, or read from where it is there")
    parser.add_argument("--seed", type=int, default=7)
    given = parser.parse_args()
    if given.motion is not None and given.motion.exists():
        with np.load(given.motion) as file:
            travel = dict(zip(file["names"].tolist(), file["travel"].tolist(), strict=True))
            motion = reduction.Motion(file["positions"], travel, file["touch"])
    else:
        motion = record(given.targets, given.steps, given.seed)
        if given.motion is not None:
            names, travel = list(motion.travel), list(motion.travel.values())
            parts = {"positions": motion.positions, "touch": motion.touch, "names": names, "travel": travel}
            np.savez(given.motion, **parts)
    exact = registry.make("BubbleMotion", num_worlds=1, precision="float64", **OPTIONS)
    motion = turned(motion.chosen(given.most, given.seed), exact.sim.model.node_rest[: motion.positions.shape[1]])
    small = reduction.train(
        exact.sim,
        motion,
        modes=given.modes,
        contact_modes=given.contact_modes,
        norm=given.norm,
        mirrored=True,
        element_tolerance=given.tolerance,
        states=given.states,
        seed=given.seed,
    )
    print(small.told(), {key: value for key, value in small.report.items() if key != "amplitudes"})
    small.save(given.out, compact=True, resolution=1e-6)  # of floors that rise by 6 mm


if __name__ == "__main__":
    sys.exit(main())
