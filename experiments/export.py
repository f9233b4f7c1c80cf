"""``softwarp export``: a trained policy at work, as a USD scene or as a recorded trajectory."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tensordict import TensorDictBase

from softwarp.io.atomic import prove_writable
from softwarp.io.trajectory import Recorder, Trajectory
from softwarp.ranges import Seed, check_fields
from softwarp.training.evaluation import run_episodes

from .config import compose
from .eval import TrainedRun, check_fit, load_run, split
from .train import held_out_env

SUFFIXES = (".usdc", ".usda", ".usdz", ".npz")


@dataclass
class ExportConfig:
    """Settings of ``softwarp export``."""

    run: str = ""  # run folder or checkpoint
    out: str = ""  # file to write: .usdc, .usda, .usdz, or .npz for the trajectory itself
    worlds: int = 1  # each with a goal of its own
    stress: bool = True  # record von Mises stress for the colours
    contacts: bool = False  # contact points and forces
    seed: Seed = 2_000_003  # of the goals
    device: str = "cpu"

    def __post_init__(self) -> None:
        """Refuse values of a wrong type."""
        check_fields(self, "export")


def main(arguments: list[str], given: dict[str, Any]) -> int:
    """Export as the overrides say; returns the exit code.

    Args:
        arguments: Hydra overrides of ExportConfig, and of the run's environment (``env.youngs=300e3``).
        given: Fields of ExportConfig from the command line, taken literally.
    """
    env_overrides, overrides = split(arguments)
    config: ExportConfig = dataclasses.replace(compose("export", ExportConfig, overrides), **given)
    suffix = Path(config.out).suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"out={config.out}: a scene needs one of the endings {', '.join(SUFFIXES)}")
    if config.worlds < 1:
        raise ValueError(f"worlds: must be at least 1, got {config.worlds}")
    prove_writable(config.out)
    run = load_run(config.run, device=config.device, overrides=env_overrides)
    write(record(run, config), config.out)
    print(f"{config.out}: written")
    return 0


def record(run: TrainedRun, config: ExportConfig) -> Trajectory:
    """One episode, a frame per action."""
    env = held_out_env(run.config, num_worlds=config.worlds)
    recorder = Recorder(env.sim, worlds=list(range(config.worlds)), stress=config.stress, contacts=config.contacts)
    frame = 0

    def look(_: TensorDictBase) -> None:
        nonlocal frame
        recorder.capture(goal=env.goal_points(), time=frame * env.control_dt)
        frame += 1

    run_episodes(env, check_fit(run, env), seed=config.seed, on_step=look)
    return recorder.finish()


def write(trajectory: Trajectory, path: str) -> None:
    """A USD scene, or the trajectory itself for .npz."""
    if Path(path).suffix.lower() == ".npz":
        trajectory.save(path)
        return
    from softwarp.io.usd import export_usd

    export_usd(trajectory, path)
