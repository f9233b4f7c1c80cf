"""``softwarp train``: train a policy, or go on with a run that was stopped."""

import dataclasses
import datetime
import functools
import json
import logging
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack
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
from softwarp.training import ranks as company
from softwarp.training.algorithms import ALGORITHMS, make_algorithm
from softwarp.training.checkpoints import CheckpointError, CheckpointFolder, hold, load, take_over
from softwarp.training.cloning import clone, correct
from softwarp.training.curve import draw_learning_curve
from softwarp.training.demonstrations import Demonstrations
from softwarp.training.evaluation import run_episodes
from softwarp.training.logs import clock
from softwarp.training.loop import Outcome, describe_evaluation, portion, train
from softwarp.training.ranks import ALONE, RankLost, Ranks

from . import config as settings
from .catalogue import CONFIG_DIR
from .config import ConfigError, TrainConfig, compose, make_env_config, to_plain
from .early import HYDRA_FLAGS
from .launch import launch
from .record import demonstrator

OPEN = ("distributed", "device", "out")  # settings in which a run that is started again may differ


def main(arguments: list[str], *, resume: str | None = None, one_job: Callable[[DictConfig], int] | None = None) -> int:
    """Train as the overrides say.

    Args:
        arguments: Hydra overrides and flags, for example ``["env=trunk", "seed=1"]`` or ``["-m", "seed=0,1,2"]``.
        resume: Run folder or training checkpoint to go on with; ``resume=...`` among the arguments does the same.
        one_job: What calls ``job`` in a sweep, from a module that launchers find elsewhere too; None: ``job`` itself.

    Returns:
        Exit code: 0 when the run is complete, 128 + the signal's number when a signal stopped it.
    """
    given = [text for text in arguments if text.startswith("resume=")]
    overrides = [text for text in arguments if text not in given]
    resume = given[-1].removeprefix("resume=") if given else resume
    is_sweep = any(text.split("=")[0] in HYDRA_FLAGS for text in overrides)
    if company.are_asked():
        if is_sweep:
            raise ConfigError("a sweep starts a process for each of its runs: start it without torchrun")
        return _train_together(None if resume is None else Path(resume), overrides)
    if resume is not None:
        return _resume(Path(resume), overrides)
    if is_sweep:
        return _through_hydra(overrides, one_job or job)
    config = compose("train", TrainConfig, overrides)
    if config.distributed.ranks > 1:
        folder = _new_folder(config)
        return launch(["train", *overrides, f"out={folder}"], config.distributed)
    return run(config)


def run(config: TrainConfig) -> int:
    """Start a new run in this process.

    Raises:
        ConfigError: If it asks for several.
    """
    if config.distributed.ranks > 1:
        raise ConfigError("distributed.ranks: a run of a sweep has one process; leave it at 1")
    config.device = registry.check_device(config.device)
    registry.check_num_worlds(config.num_worlds)
    folder = _new_folder(config)
    with hold(folder):
        _describe(config, folder)
        return _train(config, folder, None)


def _describe(config: TrainConfig, folder: Path) -> None:
    """Write what a run is, before it begins."""
    with atomic_path(folder / "config.yaml") as scratch:
        OmegaConf.save(OmegaConf.create(to_plain(config)), scratch)
    write_text(folder / "run.json", json.dumps(_provenance(config), indent=2) + "\n")


def _resume(path: Path, overrides: list[str]) -> int:
    """Go on with a run from its newest whole checkpoint, or from the one named."""
    with ExitStack() as held:
        folder, content = _saved(path, held)
        config = settings.restore(content["config"], overrides)
        if config.distributed.ranks == 1:
            return _train(config, folder, content)
    return launch(["train", f"--resume={path}", *overrides], config.distributed)


def _saved(path: Path, held: ExitStack) -> tuple[Path, dict[str, Any]]:
    """Folder of a run, kept for this process, and its newest whole checkpoint, or the one named."""
    if path.is_file() and path.resolve().parent.name != "checkpoints":
        kind = load(path)["kind"]
        place = "holds a policy only" if kind == "policy" else "lies in no run folder"
        raise CheckpointError(f"{path}: {place}; name the run folder or a checkpoint RUN/checkpoints/step_*.pt in it")
    if not path.exists():
        raise CheckpointError(f"run {path}: no such folder or checkpoint; softwarp list shows the runs here")
    folder = path.resolve().parent.parent if path.is_file() else path
    held.enter_context(hold(folder))
    checkpoints = CheckpointFolder(folder / "checkpoints", keep=1)
    checkpoints.sweep()
    return folder, load(path) if path.is_file() else checkpoints.load_latest()


def _train_together(path: Path | None, overrides: list[str]) -> int:
    """Train as one of the processes that torchrun has started."""
    ranks = company.join()
    if not ranks.is_first:
        logging.getLogger("softwarp").setLevel(logging.ERROR)
    folder = None
    try:
        with ExitStack() as held:
            plain, name, resume = _agree(path, overrides, ranks, held)
            folder, config = Path(name), settings.restore(plain, [])
            if config.distributed.pin and config.device == "cpu":
                company.pin()
            config.device = registry.check_device(company.own_device(config.device))
            code = _train(config, folder, resume, ranks)
            ranks.close()
            return code
    except RankLost as error:
        if ranks.rank <= 1:  # one of those that are left is enough to tell
            told = "" if folder is None else f"; {way_on(folder)}"
            print(f"softwarp train: {error}{told}", file=sys.stderr, flush=True)
        sys.stdout.flush()
        os._exit(1)  # without waiting for what GPUs still have to exchange


def _agree(
    path: Path | None, overrides: list[str], ranks: Ranks, held: ExitStack
) -> tuple[dict[str, Any], str, dict[str, Any] | None]:
    """Settings and folder of a run, and what this rank goes on with; rank 0 looks at the files.

    A run that is started again with the same settings goes on, as it must where torchrun restarts its processes.
    """
    told: dict[str, Any] = {}
    content = None
    try:
        if ranks.is_first:
            folder, config, content = _begin(path, overrides, held)
            if os.environ["LOCAL_WORLD_SIZE"] == os.environ["WORLD_SIZE"]:  # then --resume starts as many again
                config.distributed.ranks = ranks.size
            if content is None:
                _describe(config, folder)
            told = {"config": to_plain(config), "folder": str(folder), "goes_on": content is not None}
    finally:
        told = ranks.share(told)
    if not told:  # rank 0 tells why
        raise SystemExit(2)
    own = ALGORITHMS[told["config"]["algo"]["name"]][1].own
    return told["config"], told["folder"], portion(content, ranks, own) if told["goes_on"] else None


def _begin(path: Path | None, overrides: list[str], held: ExitStack) -> tuple[Path, TrainConfig, dict[str, Any] | None]:
    """Folder and settings of a run of several ranks, and the checkpoint that it goes on with."""
    if path is not None:
        folder, content = _saved(path, held)
        return folder, settings.restore(content["config"], overrides), content
    config = compose("train", TrainConfig, overrides)
    registry.check_num_worlds(config.num_worlds)
    if config.out is None and int(os.environ.get("TORCHELASTIC_MAX_RESTARTS", "0")) > 0:
        raise ConfigError("--max-restarts: name the run's folder, out=FOLDER, so that a restart finds it")
    content = _begun(config, held)
    if content is not None:
        return Path(str(config.out)), config, content
    folder = _new_folder(config)
    held.enter_context(hold(folder))
    return folder, config, None


def _begun(config: TrainConfig, held: ExitStack) -> dict[str, Any] | None:
    """Checkpoint of a run with these settings in their own folder, which is kept for this process; None without one."""
    if config.out is None or not CheckpointFolder(Path(config.out) / "checkpoints", keep=1).files():
        return None
    with ExitStack() as tried:
        folder, content = _saved(Path(config.out), tried)
        saved, given = content["config"], to_plain(config)
        if not all(saved.get(key) == given[key] for key in given if key not in OPEN):
            return None
        held.push(tried.pop_all())
    print(f"going on with {folder}, from step {content['counters']['steps']:,}", file=sys.stderr, flush=True)
    return content


def _train(config: TrainConfig, folder: Path, resume: dict[str, Any] | None, ranks: Ranks = ALONE) -> int:
    """Make environments and algorithm, train, tell how it went."""
    seed = ranks.seed(config.seed)
    torch.manual_seed(seed)
    name, env_config = make_env_config(config.env)
    if config.logger.progress and ranks.is_first:
        note = f"making {config.num_worlds} worlds of {name} on {config.device}; the first time, kernels are compiled"
        print(note, file=sys.stderr, flush=True)
    env = registry.make(name, num_worlds=config.num_worlds, device=config.device, seed=seed, config=env_config)
    algorithm = make_algorithm(env, config.network, config.algo, ranks)
    plain = to_plain(config)
    knows = config.cloning.is_asked or config.warm_start is not None
    algorithm.policy.observation_norm.is_frozen = resume is not None and knows
    if resume is None and config.warm_start is not None:
        take_over(algorithm.policy, Path(config.warm_start))
    if resume is None and config.cloning.is_asked:
        begin = time.monotonic()
        _clone(config, env, name, algorithm.policy, ranks)
        left = ranks.told(max(config.time_limit - (time.monotonic() - begin), 1.0e-3))
        config = dataclasses.replace(config, time_limit=left)
    judged = held_out_env(config, num_worlds=config.evaluation_episodes) if ranks.is_first else None
    evaluate = functools.partial(
        run_episodes, judged, seed=config.evaluation_seed, deterministic=config.evaluation_deterministic
    )
    try:
        outcome = train(algorithm, evaluate, folder, config, logger=config.logger, settings=plain, resume=resume)
        is_told = ranks.is_first and outcome.signal is None  # Matplotlib takes seconds, which nobody wants to wait for
        if config.logger.picture and is_told:
            draw_learning_curve(folder, folder / "curve.png")
    except WriteError as error:
        raise error.and_then(way_on(folder)) from error
    if ranks.is_first:
        _report(outcome, folder)
    return 0 if outcome.signal is None else 128 + outcome.signal


def _clone(config: TrainConfig, env: Any, name: str, policy: Policy, ranks: Ranks) -> None:
    """Clone a demonstrator, as ``cloning`` says, and tell how well."""
    shown = None
    if config.cloning.path is not None:
        shown = Demonstrations.load(Path(config.cloning.path))
        shown.check_env(config.env)
    fits: Iterable[dict[str, float]]
    if config.cloning.rounds == 0 and shown is not None:
        fits = [clone(policy, shown, config.cloning, ranks)]
    else:
        shows = demonstrator(env, name, config.cloning.demonstrator)
        seed, limit = ranks.seed(config.seed), config.time_limit
        fits = correct(policy, shown, env, shows, config.cloning, seed=seed, limit=limit, ranks=ranks)
    for turn, fit in enumerate(fits):
        told = ", ".join(f"{key} {value:.4g}" for key, value in fit.items())
        source = config.cloning.path or config.cloning.demonstrator
        which = f", round {turn} of {config.cloning.rounds}" if config.cloning.rounds else ""
        if ranks.is_first:
            print(f"cloned {source}{which}: {told}", file=sys.stderr, flush=True)


def held_out_env(config: TrainConfig, *, num_worlds: int) -> Any:
    """The environment of a run with goals that training does not see."""
    options = dict(config.env)
    if "goal_split" in options:
        options["goal_split"] = "eval"
    if "goal_repeat" in options:
        options["goal_repeat"] = 0.0
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


def _provenance(config: TrainConfig) -> dict[str, Any]:
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
    device = config.device
    hardware = torch.cuda.get_device_name(device) if device.startswith("cuda") else "cpu"
    return {
        "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "command": sys.argv,
        "ranks": config.distributed.ranks,
        "commit": commit,
        "device": {"name": device, "hardware": hardware, "torch_threads": torch.get_num_threads()},
        "versions": {"python": sys.version.split()[0], **versions},
    }


def _through_hydra(arguments: list[str], job: Callable[[DictConfig], int]) -> int:
    """Hand sweeps and Hydra's own flags to Hydra; each job of a sweep is one run in the job's folder."""
    _codes.clear()
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
    return max(_codes, default=0)


_codes: list[int] = []  # of the jobs of a sweep that ran in this process


def job(composed: DictConfig) -> int:
    """One run of a Hydra sweep, in this process or where its launcher brought it; returns the exit code.

    A job that is started again, in the same ``hydra.sweep.dir`` or because its machine was taken away, goes on.
    """
    from hydra.core.hydra_config import HydraConfig

    config = settings.to_object(composed)
    config.out = config.out or HydraConfig.get().runtime.output_dir
    with ExitStack() as held:
        content = _begun(config, held)
        if content is None:
            code = run(config)
        elif content["counters"]["steps"] >= config.total_steps:
            code = 0
        else:
            config.device = registry.check_device(config.device)
            code = _train(config, Path(config.out), content)
    _codes.append(code)
    return code
