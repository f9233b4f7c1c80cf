"""Every task under its hand-written policy, one picture each, on one sheet.

    python -m experiments.task_sheet tasks.png

Tasks that have no such policy yet are shown at their start.
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
MOMENT |= {"Diamond": 20, "TrunkCup": 40}


@torch.no_grad()
def picture(name: str, actions: int, width: int) -> NDArray[np.uint8]:
    """World 0 of a task after some actions of its policy, or at the episode's end."""
    size = {"render_width": width, "render_height": 3 * width // 4}
    env = registry.make(name, num_worlds=1, seed=SEED, **size)
    now = env.reset()
    if name in RULES:
        policy = rule(env, name)
        for _ in range(actions):
            stepped = env.step(policy(now))
            now = step_mdp(stepped)
            if bool(now["done"].any()):
                break
    shown: NDArray[np.uint8] = env.render()[0]
    return shown


def main() -> None:
    """Write the sheet."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("file", type=Path)
    parser.add_argument("--width", type=int, default=320, help="of a picture [pixels]")
    parser.add_argument("--columns", type=int, default=3)
    given = parser.parse_args()
    names = registry.names()
    pictures = [picture(name, MOMENT.get(name, 0), given.width) for name in names]
    write_png(given.file, contact_sheet(pictures, given.columns, names))


if __name__ == "__main__":
    main()
