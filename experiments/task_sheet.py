"""Every task under its hand-written policy, one picture each, on one sheet.

    python -m experiments.task_sheet tasks.png
    python -m experiments.task_sheet docs/images/bubble_motion.png --task BubbleMotion --seed 12
    python -m experiments.task_sheet catheter_beam.gif --task CatheterBeam --actions 120 --near 0.06 --every 2
    python -m experiments.task_sheet multi_gait_reduced.gif --task MultiGaitReduced --between 10

Tasks that have no such policy yet are shown at their start. With ``--task`` it is one episode of a task, action by
action from its start, on a sheet or as a film. With ``--near`` the camera follows the robot's tip, and shows what is
within so many metres of it: a thin line in a vessel a metre long is hardly seen in a picture of the whole. Actions that
take long are shown by several pictures each with ``--between``.
"""

import argparse
import itertools
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torchrl.envs.utils import step_mdp

from softwarp.envs import registry
from softwarp.policies.baselines.table import RULES, rule
from softwarp.render import Camera, RayCaster, contact_sheet, write_png, write_video

SEED = 3
FRAMES_PER_SECOND = 12.5  # of films
MOMENT = {"Trunk": 60, "CartStem": 30, "CartStemContact": 12, "CatchTheObject": 6, "CartPole": 20, "StemPendulum": 12}
MOMENT |= {
    "Diamond": 20,
    "BubbleMotion": 2,
    "Gripper": 26,
    "TrunkCup": 40,
    "SimpleMaze": 2,
    "Maze": 40,
    "ConcentricTubeRobot": 20,
    "CatheterBeam": 60,
}


LAG = 0.6  # of its distance that a camera which follows stays behind in an action
OCTAHEDRON = np.concatenate([np.eye(3), -np.eye(3)])


@torch.no_grad()
def pictures_near(name: str, actions: int, width: int, seed: int, near: float) -> list[NDArray[np.uint8]]:
    """World 0 as ``pictures_of``, but within ``near`` [m] of the robot's tip, which the camera follows."""
    env = registry.make(name, num_worlds=1, seed=seed)
    now, policy, shown = env.reset(), rule(env, name), []
    seen = {"goal_radius": env.goal_radius, "towards": env.viewed_from}
    caster = RayCaster.for_model(env.sim.model, width=width, height=3 * width // 4, **seen)
    middle = env.tip()[0].cpu().numpy().astype(np.float64)
    for step in range(actions + 1):
        tip = env.tip()[0].cpu().numpy()
        middle = LAG * middle + (1.0 - LAG) * tip
        around = middle + near * OCTAHEDRON
        caster.look_from(Camera.seeing(around, towards=env.viewed_from, aspect=caster.width / caster.height))
        shown.append(caster.draw(env.sim, goals=env.goal_points())[0])
        if step == actions or bool(now["done"].any()):
            break
        now = step_mdp(env.step(policy(now)))
    return shown


@torch.no_grad()
def pictures_of(name: str, actions: int, width: int, seed: int = SEED, between: int = 1) -> list[NDArray[np.uint8]]:
    """World 0 of a task at its start and after each action of its policy, up to the episode's end.

    Args:
        name: Of the task.
        actions: How many, at most.
        width: Of a picture [pixels].
        seed: Of the episode.
        between: Pictures of each action.
    """
    size = {"render_width": width, "render_height": 3 * width // 4}
    env = registry.make(name, num_worlds=1, seed=seed, **size)
    now = env.reset()
    shown: list[NDArray[np.uint8]] = [env.render()[0]]
    if name in RULES:
        policy = rule(env, name)
        every, passed = max(1, round(env.control_dt / (float(env.sim.dt) * between))), itertools.count(1)

        def look() -> None:
            if next(passed) % every == 0:
                shown.append(env.render()[0])

        env.watcher = look
        for _ in range(actions):
            now = step_mdp(env.step(policy(now)))
            if bool(now["done"].any()):
                break
        env.watcher = None
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
    parser.add_argument("--near", type=float, help="follow the tip of the robot [m]")
    parser.add_argument("--between", type=int, default=1, help="pictures of an action")
    parser.add_argument("--every", type=int, default=1, help="leave out actions of a film between these")
    given = parser.parse_args()
    if given.task is not None:
        settings = (given.task, given.actions, given.width, given.seed)
        shown = pictures_of(*settings, given.between) if given.near is None else pictures_near(*settings, given.near)
        if given.file.suffix == ".gif":
            write_video(given.file, shown[:: given.every], FRAMES_PER_SECOND / given.every)
        else:
            write_png(given.file, contact_sheet(shown, given.columns))
        return
    names = registry.names()
    pictures = [pictures_of(name, MOMENT.get(name, 0), given.width, given.seed)[-1] for name in names]
    write_png(given.file, contact_sheet(pictures, given.columns, names))


if __name__ == "__main__":
    main()
