"""The learning of SofaGym's figures 3 and 4: Gripper with and without random pull, memory, and cloning.

Both panels have the same four curves: PPO whose actor and critic share their layers, the same after cloning the
hand-written policy, and both with an LSTM of 128 units. Demonstrations are recorded once per panel, with as many
worlds as a run trains in, and kept beside its runs.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from softwarp.envs import registry

from .config import TrainConfig, compose

TASKS: dict[str, tuple[str, ...]] = {  # panels, with what sets them apart
    "gripper": (),
    "gripper_pull": ("env.pull=0.5", "env.pull_turn=0.25"),  # up to half the object's weight, drawn every action
}
ALGORITHMS = ("ppo", "ppo_cloned", "ppo_lstm", "ppo_lstm_cloned")
UNITS = 128  # of the LSTM

NOISE = 0.1  # part of a demonstration's actions that are random
EPISODES = {"paper": 100, "fast": 512, "small": 6}  # demonstrated
CLONING = {
    "paper": ("cloning.epochs=3000", "cloning.patience=300"),
    "fast": ("cloning.epochs=100", "cloning.batch=2048"),
    "small": ("cloning.epochs=5",),
}
AFTERWARDS = ("network.initial_std=0.1", "algo.warmup_updates=4", "algo.learning_rate=1e-4")  # PPO after cloning
SMALL = (
    *("env.finger=plain", "env.object=cube", "env.max_episode_steps=12", "num_worlds=4", "network.hidden=[32,32]"),
    *("algo.horizon=12", "algo.minibatches=2", "total_steps=144", "evaluations=2", "evaluation_episodes=4"),
    "checkpoint_seconds=5",
)


def overrides(task: str, algorithm: str, setting: str, demonstrations: Path) -> list[str]:
    """What ``softwarp train`` is told of one curve, but for seed and folder."""
    told = [f"experiment={'fast' if setting == 'fast' else 'paper'}/gripper_ppo", *TASKS[task]]
    told += SMALL if setting == "small" else ()
    if "lstm" in algorithm:
        told.append(f"network.recurrent={UNITS}")
    if algorithm.endswith("cloned"):
        told += [f"cloning.path={demonstrations}", *CLONING[setting], *AFTERWARDS]
    return told


def recording(told: Sequence[str], setting: str, demonstrations: Path) -> list[str]:
    """Arguments of ``softwarp record`` for the demonstrations of a run that is told this."""
    config: TrainConfig = compose("train", TrainConfig, list(told))
    name, episodes = config.env["name"], EPISODES[setting]
    usual = compose("train", TrainConfig, [f"env={registry.spec(name).file_name}"]).env
    changed = [f"env.{key}={_text(value)}" for key, value in config.env.items() if value != usual[key]]
    worlds = min(config.num_worlds, episodes)
    asked = [f"episodes={episodes}", f"num_worlds={worlds}", f"noise={NOISE}", f"device={config.device}"]
    return [str(demonstrations), f"env={registry.spec(name).file_name}", *changed, *asked]


def _text(value: Any) -> str:
    """A value as Hydra reads it."""
    if isinstance(value, list | tuple):
        return f"[{','.join(map(_text, value))}]"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return repr(value) if isinstance(value, float) else str(value)
