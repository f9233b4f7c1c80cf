"""``softwarp render``: an episode as a video (.mp4, .gif) or a sheet of pictures (.png)."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp.io.trajectory import Trajectory
from softwarp.render.replay import render_trajectory

from . import shown
from .verbs import RenderConfig

Frames = NDArray[np.uint8]  # (frame, height, width, 3)


def main(arguments: list[str], given: dict[str, Any]) -> int:
    """Render as the overrides say; returns the exit code.

    Args:
        arguments: Hydra overrides of RenderConfig, and of the run's environment (``env.youngs=300e3``).
        given: Fields of RenderConfig from the command line, taken literally.
    """
    config = shown.settings("render", arguments, given)
    env, trajectory = shown.record(config, arguments, stress=config.stress)
    print(f"{config.out}: {draw(env, trajectory, config)} frames rendered")
    return 0


def draw(env: Any, trajectory: Trajectory, config: RenderConfig) -> int:
    """Write the film, or ``config.frames`` of its pictures, evenly spaced, on a sheet; returns how many were drawn.

    Args:
        env: What was recorded, for its camera; None for a recording of which no more is known.
        trajectory: The motion.
        config: Settings.
    """
    from softwarp.render import write_png, write_video

    is_sheet = Path(config.out).suffix.lower() == ".png"
    count = trajectory.frame_count
    chosen = np.linspace(0, count - 1, min(config.frames, count)).round().astype(int) if is_sheet else None
    pictures = render_trajectory(
        trajectory,
        frames=chosen,
        width=config.width,
        height=config.height,
        camera=env.camera() if env else None,
        towards=env.viewed_from if env else None,
        contacts=config.contacts,
        inversions=config.inversions,
        stress=config.stress,
        samples=16 if is_sheet else 4,
    )
    if is_sheet:
        write_png(config.out, tile(pictures))
    else:
        write_video(config.out, pictures, round(1.0 / env.control_dt if env else trajectory.frame_rate))
    return len(pictures)


def tile(pictures: Frames) -> Frames:
    """Pictures (picture, height, width, 3) in a nearly square grid; free places stay white."""
    count, height, width, _ = pictures.shape
    columns = math.ceil(math.sqrt(count))
    rows = math.ceil(count / columns)
    grid = np.full((rows * columns, height, width, 3), 255, np.uint8)
    grid[:count] = pictures
    return grid.reshape(rows, columns, height, width, 3).swapaxes(1, 2).reshape(rows * height, columns * width, 3)
