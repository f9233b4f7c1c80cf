"""Make the table of goals of the default ConcentricTubeRobot.

    python assets/nasal/goals.py --out softwarp/envs/concentric_tube_goals.npz

Goals are tips of tubes whose whole line, by the closed form without loads, is clear of the wall; see
softwarp/envs/tube_goals.py. They stand in random order: the first 80 % are training goals, the others evaluation goals.
Takes half a minute. Other anatomies and tubes get theirs when an environment is made.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from softwarp.envs.options.concentric_tube_robot import ConcentricTubeRobotConfig
from softwarp.envs.tasks.concentric_tube_robot import sought_goals


def main() -> None:
    """Seek the goals and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("softwarp/envs/concentric_tube_goals.npz"))
    args = parser.parse_args()
    goals = sought_goals(ConcentricTubeRobotConfig())
    tip = np.round(goals.tip.numpy(), 7)
    np.savez_compressed(args.out, tip=tip, length=goals.length.numpy(), angle=goals.angle.numpy())
    low, high = 1e3 * tip.min(axis=0), 1e3 * tip.max(axis=0)
    print(f"{len(tip)} goals, box {low.round(1)} to {high.round(1)} mm, {args.out.stat().st_size} bytes")


if __name__ == "__main__":
    main()
