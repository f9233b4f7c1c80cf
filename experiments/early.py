"""Mistakes in a command that are told before Torch is loaded, which takes seconds; others are told later."""

from pathlib import Path

from .config import ConfigError, TrainConfig, compose

HYDRA_FLAGS = ("-m", "--multirun", "-c", "--cfg", "-i", "--info", "-p", "--package", "--resolve", "--hydra-help")
ENDINGS = {"render": (".mp4", ".gif", ".png"), "export": (".usdc", ".usda", ".usdz", ".npz")}  # of what is written


def train(arguments: list[str], resume: str | None) -> None:
    """Look at the settings of a new run, or for the run to go on with.

    Raises:
        ConfigError: Naming what is wrong.
    """
    given = [text.removeprefix("resume=") for text in arguments if text.startswith("resume=")]
    if given or resume is not None:
        path = Path(given[-1] if given else str(resume))
        if not path.exists():
            raise ConfigError(f"run {path}: no such folder or checkpoint; softwarp list shows the runs here")
    elif not any(text.split("=")[0] in HYDRA_FLAGS for text in arguments):
        compose("train", TrainConfig, arguments)


def require_run(path: str) -> None:
    """Refuse a run that is not there.

    Raises:
        ConfigError: Naming it.
    """
    if path and not Path(path).exists():
        raise ConfigError(f"run {path}: no such folder or checkpoint")


def film(verb: str, out: str, run: str) -> None:
    """Look at the names of the file to be written and of what is to be shown.

    Raises:
        ConfigError: Naming what is wrong.
    """
    check_ending(verb, out)
    require_run(run)


def check_ending(verb: str, out: str) -> None:
    """Refuse a file of a kind that a verb does not write.

    Raises:
        ConfigError: Naming those that it does.
    """
    if Path(out).suffix.lower() not in ENDINGS[verb]:
        raise ConfigError(f"out={out}: {verb} writes files with one of the endings {', '.join(ENDINGS[verb])}")


def demo(out: str, minutes: float | None, overrides: list[str]) -> None:
    """Look at the settings, and give a sign of life.

    Raises:
        ConfigError: Naming what is wrong.
    """
    if minutes is not None:
        overrides = [*overrides, f"time_limit={60.0 * minutes}"]
    if not any((Path(out) / "run" / "checkpoints").glob("step_*.pt")):
        compose("train", TrainConfig, ["experiment=demo", *overrides])
    print(f"softwarp demo: everything goes to {out}; loading PyTorch", flush=True)
