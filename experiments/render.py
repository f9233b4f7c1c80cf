"""``softwarp render``: a trained policy at work, as a video (.mp4, .gif) or a sheet of pictures (.png)."""

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDictBase

from softwarp.envs.options import Count, Pixels
from softwarp.io.atomic import prove_writable
from softwarp.ranges import Seed, check_fields
from softwarp.training.evaluation import run_episodes

from .config import compose
from .eval import TrainedRun, check_fit, load_run, split
from .train import held_out_env

SUFFIXES = (".mp4", ".gif", ".png")
Frames = NDArray[np.uint8]  # (frame, height, width, 3)


@dataclass
class RenderConfig:
    """Settings of ``softwarp render``."""

    run: str = ""  # run folder or checkpoint
    out: str = ""  # file to write: .mp4, .gif or .png
    worlds: Count = 1  # shown side by side, each with a goal of its own
    width: Pixels = 480  # pixels of one world
    height: Pixels = 360
    frames: Count = 6  # on a .png sheet
    contacts: bool = False  # show contact points and forces
    inversions: bool = True  # mark elements that are inside out
    seed: Seed = 2_000_003  # of the goals
    device: str = "cpu"

    def __post_init__(self) -> None:
        """Refuse values of a wrong type."""
        check_fields(self, "render")


def main(arguments: list[str], given: dict[str, Any]) -> int:
    """Render as the overrides say; returns the exit code.

    Args:
        arguments: Hydra overrides of RenderConfig, and of the run's environment (``env.youngs=300e3``).
        given: Fields of RenderConfig from the command line, taken literally.
    """
    env_overrides, overrides = split(arguments)
    config: RenderConfig = dataclasses.replace(compose("render", RenderConfig, overrides), **given)
    suffix = Path(config.out).suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"out={config.out}: a picture needs one of the endings {', '.join(SUFFIXES)}")
    prove_writable(config.out)
    run = load_run(config.run, device=config.device, overrides=env_overrides)
    frames, period = film(run, config)
    write(frames, config.out, fps=round(1.0 / period), count=config.frames)
    print(f"{config.out}: {len(frames)} frames rendered")
    return 0


def film(run: TrainedRun, config: RenderConfig) -> tuple[Frames, float]:
    """Pictures of one episode, and the time between them [s]."""
    size = {"render_width": config.width, "render_height": config.height}
    sized = dataclasses.replace(run.config, env={**run.config.env, **size})
    env = held_out_env(sized, num_worlds=config.worlds)
    frames = []

    def look(_: TensorDictBase) -> None:
        frames.append(tile(env.render(contacts=config.contacts, inversions=config.inversions)))

    run_episodes(env, check_fit(run, env), seed=config.seed, on_step=look)
    return np.stack(frames), env.control_dt


def tile(pictures: Frames) -> Frames:
    """Pictures (world, height, width, 3) in a nearly square grid; free places stay white."""
    count, height, width, _ = pictures.shape
    columns = math.ceil(math.sqrt(count))
    rows = math.ceil(count / columns)
    grid = np.full((rows * columns, height, width, 3), 255, np.uint8)
    grid[:count] = pictures
    return grid.reshape(rows, columns, height, width, 3).swapaxes(1, 2).reshape(rows * height, columns * width, 3)


def write(frames: Frames, path: str, *, fps: int, count: int) -> None:
    """A video, or ``count`` of the frames, evenly spaced and row by row, for a .png."""
    from softwarp.render import write_png, write_video

    if Path(path).suffix.lower() == ".png":
        chosen = np.linspace(0, len(frames) - 1, min(count, len(frames))).round().astype(int)
        write_png(path, tile(frames[chosen]))
    else:
        write_video(path, frames, fps)
