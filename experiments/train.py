"""``softwarp train``: train a policy, or go on with a run that was stopped."""

import dataclasses
import datetime
import functools
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path
from typing import Any

import hydra
import torch
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from softwarp.envs import registry
from softwarp.io.atomic import WriteError, atomic_path, write_text
from softwarp.policies.policy import Policy
from softwarp.training.algorithms import make_algorithm
from softwarp.training.checkpoints import CheckpointError, CheckpointFolder, hold, load
from softwarp.training.cloning import clone, correct
from softwarp.training.curve import draw_learning_curve
from softwarp.training.demonstrations import Demonstrations
from softwarp.training.evaluation import run_episodes
from softwarp.training.logs import clock
from softwarp.training.loop import Outcome, describe_evaluation, train

from . import config as settings
from .catalogue import CONFIG_DIR
from .config import ConfigError, TrainConfig, compose, make_env_config, to_plain
from .early import HYDRA_FLAGS
from .record import demonstrator


def main(arguments: list[str], *, resume: str | None = None) -> int:
    """Train as the overrides say.

    Args:
        arguments: Hydra overrides and flags, for example ``["env=trunk", "seed=1"]`` or ``["-m", "seed=0,1,2"]``.
        resume: Run folder or training checkpoint to go on with; ``resume=...`` among the arguments does the same.

    Returns:
        Exit code: 0 when the run is complete, 128 + the signal's number when a signal stopped it.
    """
    given = [text for text in arguments if text.startswith("resume=")]
    overrides = [text for text in arguments if text not in given]
    resume = given[-1].removeprefix("resume=") if given else resume
    if resume is not None:
        return _resume(Path(resume), overrides)
    if any(text.split("=")[0] in HYDRA_FLAGS for text in overrides):
        return _through_hydra(overrides)
    return run(compose("train", TrainConfig, overrides))


def run(config: TrainConfig) -> int:
    """Start a new run."""
    config.device = registry.check_device(config.device)
    registry.check_num_worlds(config.num_worlds)
    folder = _new_folder(config)
    with hold(folder):
        with atomic_path(folder / "config.yaml") as scratch:
            OmegaConf.save(OmegaConf.create(to_plain(config)), scratch)
        write_text(folder / "run.json", json.dumps(_provenance(config.device), indent=2) + "\n")
        return _train(config, folder, None)


def _resume(path: Path, overrides: list[str]) -> int:
    """Go on with a run from its newest whole checkpoint, or from the one named."""
    if path.is_file() and path.resolve().parent.name != "checkpoints":
        kind = load(path)["kind"]
        place = "holds a policy only" if kind == "policy" else "lies in no run folder"
        raise CheckpointError(f"{path}: {place}; name the run folder or a checkpoint RUN/checkpoints/step_*.pt in it")
    if not path.exists():
        raise CheckpointError(f"run {path}: no such folder or checkpoint; softwarp list shows the runs here")
    folder = path.resolve().parent.parent if path.is_file() else path
    with hold(folder):
        checkpoints = CheckpointFolder(folder / "checkpoints", keep=1)
        checkpoints.sweep()
        content = load(path) if path.is_file() else checkpoints.load_latest()
        return _train(settings.restore(content["config"], overrides), folder, content)


def _train(config: TrainConfig, folder: Path, resume: dict[str, Any] | None) -> int:
    """Make environments and algorithm, train, tell how it went."""
    torch.manual_seed(config.seed)
    name, env_config = make_env_config(config.env)
    if config.logger.progress:
        note = f"making {config.num_worlds} worlds of {name} on {config.device}; the first time, kernels are compiled"
        print(note, file=sys.stderr, flush=True)
    env = registry.make(name, num_worlds=config.num_worlds, device=config.device, seed=config.seed, config=env_config)
    algorithm = make_algorithm(env, config.network, config.algo)
    plain = to_plain(config)
    algorithm.policy.observation_norm.is_frozen = resume is not None and config.cloning.is_asked
    if resume is None and config.cloning.is_asked:
        begin = time.monotonic()
        _clone(config, env, name, algorithm.policy)
        left = max(config.time_limit - (time.monotonic() - begin), 1.0e-3)
        config = dataclasses.replace(config, time_limit=left)
    evaluate = functools.partial(
        run_episodes,
        held_out_env(config, num_worlds=config.evaluation_episodes),
        seed=config.evaluation_seed,
        deterministic=config.evaluation_deterministic,
    )
    try:
        outcome = train(algorithm, evaluate, folder, config, logger=config.logger, settings=plain, resume=resume)
        if config.logger.picture and outcome.signal is None:  # Matplotlib takes seconds, which nobody wants to wait for
            draw_learning_curve(folder, folder / "curve.png")
    except WriteError as error:
        raise error.and_then(way_on(folder)) from error
    _report(outcome, folder)
    return 0 if outcome.signal is None else 128 + outcome.signal


def _clone(config: TrainConfig, env: Any, name: str, policy: Policy) -> None:
    """Clone a demonstrator, as ``cloning`` says, and tell how well."""
    shown = None
    if config.cloning.path is not None:
        shown = Demonstrations.load(Path(config.cloning.path))
        shown.check_env(config.env)
    fits: Iterable[dict[str, float]]
    if config.cloning.rounds == 0 and shown is not None:
        fits = [clone(policy, shown, config.cloning)]
    else:
        shows = demonstrator(env, name, config.cloning.demonstrator)
        fits = correct(policy, shown, env, shows, config.cloning, seed=config.seed, limit=config.time_limit)
    for turn, fit in enumerate(fits):
        told = ", ".join(f"{key} {value:.4g}" for key, value in fit.items())
        source = config.cloning.path or config.cloning.demonstrator
        which = f", round {turn} of {config.cloning.rounds}" if config.cloning.rounds else ""
        print(f"cloned {source}{which}: {told}", file=sys.stderr, flush=True)


def held_out_env(config: TrainConfig, *, num_worlds: int) -> Any:
    """The environment of a run with goals that training does not see."""
    options = dict(config.env)
    if "goal_split" in options:
        options["goal_split"] = "eval"
    name, env_config = make_env_config(options)
    return registry.make(
        name, num_worlds=num_worlds, device=config.device, seed=config.evaluation_seed, config=env_config
    )


def way_on(folder: Path) -> str:
    """What is kept of a run that could not write, and how it is continued."""
    saved = CheckpointFolder(folder / "checkpoints", keep=1).steps()
    if not saved:
        return "nothing was learned yet, start the run anew"
    return f"the run is saved up to step {saved[-1]:,}, then go on with: softwarp train --resume {folder}"


def _report(outcome: Outcome, folder: Path) -> None:
    counters = outcome.counters
    begun = f" and {outcome.begun:,} of a rollout that was begun," if outcome.begun else ""
    print(f"{counters.steps:,} steps{begun} in {clock(counters.seconds)}")
    if outcome.evaluation:
        print(f"last evaluation: {describe_evaluation(outcome.evaluation)}")
    if outcome.signal is None:
        print(f"run folder: {folder}\nnext: softwarp eval {folder} --baselines")
    else:
        print(f"stopped by a signal, nothing lost; go on with: softwarp train --resume {folder}")


def _new_folder(config: TrainConfig) -> Path:
    """An empty run folder.

    Raises:
        ConfigError: If it holds a run already.
        OSError: If it cannot be made or written to.
    """
    if config.out is not None:
        folder = Path(config.out)
        if (folder / "best.pt").exists() or CheckpointFolder(folder / "checkpoints", keep=1).files():
            raise ConfigError(f"out={folder}: holds a run already; --resume {folder} goes on, or choose another folder")
    else:
        stamp = datetime.datetime.now().strftime("%Y-%m-%d_%H-%M-%S_%f")
        folder = Path("runs") / f"{registry.spec(config.env['name']).file_name}_{config.algo.name}_{stamp}"
    write_text(folder / "run.json", "{}\n")  # makes the folder and proves that it can be written to
    return folder


def _provenance(device: str) -> dict[str, Any]:
    """Where the run comes from: versions, commit, device, command, time."""
    packages = ("softwarp", "torch", "torchrl", "tensordict", "warp-lang", "numpy")
    versions = {}
    for package in packages:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = "not installed (running from source)"
    root, commit = Path(__file__).resolve().parents[1], None
    if (root / ".git").exists() and shutil.which("git"):
        git = ["git", "-C", str(root), "rev-parse", "HEAD"]
        commit = subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip() or None
    hardware = torch.cuda.get_device_name(device) if device.startswith("cuda") else "cpu"
    return {
        "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "command": sys.argv,
        "commit": commit,
        "device": {"name": device, "hardware": hardware, "torch_threads": torch.get_num_threads()},
        "versions": {"python": sys.version.split()[0], **versions},
    }


def _through_hydra(arguments: list[str]) -> int:
    """Hand sweeps and Hydra's own flags to Hydra; each job of a sweep is one run in the job's folder."""
    from hydra.core.hydra_config import HydraConfig

    codes = []

    def job(composed: DictConfig) -> None:
        config = settings.to_object(composed)
        config.out = config.out or HydraConfig.get().runtime.output_dir
        codes.append(run(config))

    sys.argv = ["softwarp train", *settings.with_own_environments(arguments), *settings.search_path()]
    settings.register({"train": TrainConfig})
    os.environ["HYDRA_FULL_ERROR"] = "1"  # errors come here instead of being printed with their way through Hydra
    sweep = hydra.main(version_base="1.3", config_path=str(CONFIG_DIR), config_name="train")(job)
    try:
        sweep()
    except WriteError:
        raise
    except OSError as error:
        if error.filename is None:
            raise
        raise WriteError.of(Path(error.filename), error) from error  # a folder of the sweep
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(str(error).strip()) from error
    return max(codes, default=0)
