"""Every task under its hand-written policy, one picture each, on one sheet.

    python -m experiments.task_sheet tasks.png
    python -m experiments.task_sheet docs/images/bubble_motion.png --task BubbleMotion --seed 12

Tasks that have no such policy yet are shown at their start. With ``--task`` it is one episode of a task, action by
action from its start.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torchrl.envs.utils import step_mdp

from softwarp.envs import registry
from softwarp.policies.baselines.table import RULES, rule
from softwarp.render import contact_sheet, write_png

SEED = 3
MOMENT = {"Trunk": 60, "CartStem": 30, "CartStemContact": 12, "CatchTheObject": 6, "CartPole": 20, "StemPendulum": 12}
MOMENT |= {
    "Diamond": 20,
    "BubbleMotion": 2,
    "Gripper": 26,
    "TrunkCup": 40,
    "SimpleMaze": 2,
    "Maze": 40,
    "CatheterBeam": 60,
    "ConcentricTubeRobot": 20,
}


@torch.no_grad()
def pictures_of(name: str, actions: int, width: int, seed: int = SEED) -> list[NDArray[np.uint8]]:
    """World 0 of a task at its start and after each action of its policy, up to the episode's end."""
    size = {"render_width": width, "render_height": 3 * width // 4}
    env = registry.make(name, num_worlds=1, seed=seed, **size)
    now = env.reset()
    shown: list[NDArray[np.uint8]] = [env.render()[0]]
    if name in RULES:
        policy = rule(env, name)
        for _ in range(actions):
            now = step_mdp(env.step(policy(now)))
            shown.append(env.render()[0])
            if bool(now["done"].any()):
                break
    return shown


def main() -> None:
    """Write the sheet."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("file", type=Path)
    parser.add_argument("--width", type=int, default=320, help="of a picture [pixels]")
    parser.add_argument("--columns", type=int, default=3)
    parser.add_argument("--task", help="show an episode of this one")
    parser.add_argument("--actions", type=int, default=8, help="of such an episode")
    parser.add_argument("--seed", type=int, default=SEED)
    given = parser.parse_args()
    if given.task is not None:
        shown = pictures_of(given.task, given.actions, given.width, given.seed)
        write_png(given.file, contact_sheet(shown, given.columns))
        return
    names = registry.names()
    pictures = [pictures_of(name, MOMENT.get(name, 0), given.width, given.seed)[-1] for name in names]
    write_png(given.file, contact_sheet(pictures, given.columns, names))


if __name__ == "__main__":
    main()
