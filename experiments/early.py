"""Mistakes in a command that are told before Torch is loaded, which takes seconds; others are told later."""

from pathlib import Path
from typing import Any

from softwarp import checks, processes

from . import verbs
from .config import ConfigError, TrainConfig, compose

HYDRA_FLAGS = ("-m", "--multirun", "-c", "--cfg", "-i", "--info", "-p", "--package", "--resolve", "--hydra-help")


def train(arguments: list[str], resume: str | None) -> None:
    """Look at the settings of a new run, or for the run to go on with.

    Raises:
        ConfigError: Naming what is wrong.
    """
    if processes.is_follower():  # the first rank looks, and it alone needs the files
        return
    given = [text.removeprefix("resume=") for text in arguments if text.startswith("resume=")]
    if given or resume is not None:
        path = Path(given[-1] if given else str(resume))
        if not path.exists():
            raise ConfigError(f"run {path}: no such folder or checkpoint; softwarp list shows the runs here")
        overrides = [text for text in arguments if not text.startswith("resume=")]
        verbs.check_of_run(str(path), overrides)
        devices = [text.removeprefix("device=") for text in overrides if text.startswith("device=")]
        verbs.check_device(devices[-1] if devices else "cpu")
    elif not any(text.split("=")[0] in HYDRA_FLAGS for text in arguments):
        config = compose("train", TrainConfig, arguments)
        if config.cloning.rounds:
            verbs.check_policy(config.cloning.demonstrator, config.env)
        verbs.check_device(config.device)


def evaluate(arguments: list[str], given: dict[str, Any]) -> None:
    """Look at the settings, the run and the file to be written."""
    verbs.evaluation(arguments, given)


def film(verb: str, arguments: list[str], given: dict[str, Any]) -> None:
    """Look at the settings, at what is to be shown and at the file to be written."""
    verbs.film(verb, arguments, given)


def view(arguments: list[str], path: str) -> None:
    """Look at the settings, and whether there is what is to be shown."""
    if path:
        verbs.playing(path, arguments)
    else:
        verbs.viewing(arguments)


def record(arguments: list[str], given: dict[str, Any]) -> None:
    """Look at the settings and at the file to be written."""
    verbs.recording(arguments, given)


def reduce(arguments: list[str], given: dict[str, Any]) -> None:
    """Look at the settings and at the file to be written."""
    verbs.reducing(arguments, given)


def plan(arguments: list[str], replay: str | None) -> None:
    """Look at the settings and the files to be written, or at the plan to be carried out."""
    if replay is None:
        verbs.planning(arguments)
    else:
        verbs.replaying(replay, arguments)


def transfer(plan: str, arguments: list[str]) -> None:
    """Look at the settings, the plan and the files to be written."""
    verbs.transferring(plan, arguments)


def policy(verb: str, run: str, out: str | None) -> None:
    """Look at the run or exported file, and at the file to be written.

    Raises:
        ConfigError: Naming what is not there.
        ValueError: For another ending.
    """
    if out is not None:
        checks.choice(Path(out).suffix, "ending of the file", verbs.ENDINGS["policy export"])
    if verb == "time" and Path(run).suffix in verbs.ENDINGS["policy export"] and Path(run).is_file():
        return
    verbs.require_run(run)


def demo(out: str, minutes: float | None, overrides: list[str]) -> None:
    """Look at the settings, and give a sign of life.

    Raises:
        ConfigError: Naming what is wrong.
    """
    if minutes is not None:
        overrides = [*overrides, f"time_limit={60.0 * minutes}"]
    if not any((Path(out) / "run" / "checkpoints").glob("step_*.pt")):
        verbs.check_device(compose("train", TrainConfig, ["experiment=demo", *overrides]).device)
    print(f"softwarp demo: everything goes to {out}; loading PyTorch", flush=True)
