"""The learning baselines: tasks x algorithms x seeds, learning curves and a table beside SofaGym's statements.

    softwarp baselines FOLDER                      # SofaGym's networks and budgets: days of computing
    softwarp baselines FOLDER --setting fast       # many worlds: hours
    softwarp baselines FOLDER --setting small      # a test of everything, minutes

Every run is a ``softwarp train`` in a folder of its own, ``FOLDER/<task>/<algorithm>/seed_<k>``. Started again, the
command goes on where it stopped: finished runs are kept, begun ones resumed. ``curves.csv``, ``curves.png``,
``table.csv`` and ``table.md`` are written from what there is.
"""

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from softwarp import notices, processes
from softwarp.advice import nearest
from softwarp.envs import registry
from softwarp.io.atomic import writing
from softwarp.training.checkpoints import CheckpointFolder

from .baselines_report import write_report
from .config import TrainConfig, compose

ALGORITHMS = ("ppo", "sac", "ppo_avec", "sac_avec")
TASKS = {"cartstem": "CartStem", "cartstemcontact": "CartStemContact", "catchtheobject": "CatchTheObject"}
PPO_ONLY = ("cartstem",)  # discrete actions: SofaGym trains it with PPO alone
SMALL_BUDGET = (
    *("total_steps=1500", "num_worlds=8", "network=mlp", "network.hidden=[32,32]"),
    *("evaluations=3", "evaluation_episodes=5", "checkpoint_seconds=5"),
)
SMALL = {"ppo": ("algo.horizon=16", "algo.minibatches=2"), "sac": ("algo.batch=64", "algo.update_ratio=0.05")}
POLL = 0.2  # s between looks at the running processes


@dataclass(frozen=True)
class Cell:
    """One run."""

    root: Path
    task: str
    algorithm: str
    seed: int

    @property
    def folder(self) -> Path:
        """Run folder."""
        task = self.task if self.task in TASKS else registry.spec(self.task).file_name
        return self.root / task / self.algorithm / f"seed_{self.seed}"

    @property
    def env(self) -> str:
        """An environment as ``env=`` takes it."""
        return self.task if ":" in self.task else registry.spec(self.task).file_name

    def overrides(self, setting: str) -> list[str]:
        """What ``softwarp train`` is told."""
        base = self.algorithm.removesuffix("_avec")
        preset = f"paper/{self.task}_{self.algorithm}" if setting != "fast" else f"fast/{self.task}_{base}"
        chosen = [f"experiment={preset}"] if self.task in TASKS else [f"env={self.env}"]
        if self.task not in TASKS and setting != "fast":
            chosen.append(f"algo={self.algorithm}")
        told = [*chosen, f"seed={self.seed}", f"out={self.folder}", "logger=csv", "logger.picture=false"]
        told += ["evaluation_deterministic=false", "evaluate_start=true", "keep_checkpoints=1"]
        if setting == "fast":
            told += [f"algo={self.algorithm}", "evaluation_episodes=64", "evaluations=20"]
        if setting == "small":
            told += [*SMALL_BUDGET, *SMALL[base]]
        return told

    def steps(self) -> int | None:
        """Environment steps at the newest checkpoint; None if there is none."""
        return max(CheckpointFolder(self.folder / "checkpoints", keep=1).steps(), default=None)


def cells(root: Path, tasks: Sequence[str], algorithms: Sequence[str], seeds: Sequence[int]) -> Iterator[Cell]:
    """All runs, seed by seed, so that a stop leaves something of everything."""
    for seed in seeds:
        for task in tasks:
            for algorithm in algorithms:
                if not (task in PPO_ONLY and algorithm.startswith("sac")):
                    yield Cell(root, task, algorithm, seed)


def run_all(wanted: Sequence[Cell], setting: str, jobs: int, extra: Sequence[str]) -> list[Cell]:
    """Train what is not trained yet, ``jobs`` runs side by side, each with one thread.

    Returns:
        The runs that failed; what they printed is in ``train.log`` of their folder.
    """
    budgets: dict[tuple[str, str], int] = {}
    waiting, running, failed = list(wanted), {}, []  # type: ignore[var-annotated]
    previous = signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))  # ends as an interrupt does
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                cell = waiting.pop(0)
                overrides = [*cell.overrides(setting), *extra]
                key = (cell.task, cell.algorithm)
                if key not in budgets:
                    budgets[key] = compose("train", TrainConfig, overrides).total_steps
                steps = cell.steps()
                if steps is not None and steps >= budgets[key]:
                    continue
                note(f"{cell.folder}: {'starts' if steps is None else 'goes on'} ({len(waiting)} waiting)")
                running[cell] = start(cell, overrides)
            for cell, process in list(running.items()):
                if process.poll() is not None:
                    del running[cell]
                    if process.returncode != 0:
                        failed.append(cell)
                        note(f"{cell.folder}: failed with code {process.returncode}, see train.log there")
            if running:
                told = ", ".join(f"{cell.folder.relative_to(cell.root)} {cell.steps() or 0:,}" for cell in running)
                notices.progress("training", f"{len(waiting)} runs waiting; environment steps saved: {told}")
            time.sleep(POLL)
    finally:
        notices.progress_ends()
        signal.signal(signal.SIGTERM, previous)
        for process in running.values():  # on an interrupt: every run saves and ends
            process.terminate()
        for process in running.values():
            process.wait()
    return failed


def start(cell: Cell, overrides: list[str]) -> subprocess.Popen[bytes]:
    """A process that trains one run, or goes on with it; it saves and ends when this one is gone."""
    command = [sys.executable, "-m", "softwarp", "train"]
    command += overrides if cell.steps() is None else ["--resume", str(cell.folder)]
    environment = os.environ | {"OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "1")}
    printed = cell.folder / "train.log"
    with writing(printed):
        cell.folder.mkdir(parents=True, exist_ok=True)
        log = printed.open("ab")
    with log:
        return subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, **processes.child_options(environment))


def note(text: str) -> None:
    """A line about the progress of the whole."""
    with contextlib.suppress(OSError):  # a full disk below a redirection: the folders tell the same
        sys.stderr.write(f"{time.strftime('%H:%M:%S')}  {text}\n")
        sys.stderr.flush()


def main(argv: Sequence[str] | None = None) -> int:
    """Train and report; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="softwarp baselines", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--setting", choices=("paper", "fast", "small"), default="paper")
    told = f"{', '.join(TASKS)}, or environments such as my_module:MyRobot, with settings given by --set"
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), metavar="TASK", help=told)
    parser.add_argument("--algorithms", nargs="+", choices=ALGORITHMS, default=list(ALGORITHMS))
    parser.add_argument("--seeds", type=int, default=6, help="how many, 0, 10, 20, ... as SofaGym; default 6")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="runs side by side")
    parser.add_argument("--report-only", action="store_true", help="train nothing, draw what there is")
    parser.add_argument("--set", nargs="+", default=[], metavar="key=value", help="further settings of every run")
    args = parser.parse_args(argv)
    for name in ("seeds", "jobs"):
        if getattr(args, name) < 1:
            parser.error(f"--{name} must be at least 1, got {getattr(args, name)}")
    for task in args.tasks:
        if task not in TASKS and ":" not in task and task not in registry.names():
            raise ValueError(f"--tasks: there is no {task!r}; {nearest(task, [*TASKS, *registry.names()])}")
    wanted = list(cells(args.folder, args.tasks, args.algorithms, [10 * k for k in range(args.seeds)]))
    failed = [] if args.report_only else run_all(wanted, args.setting, args.jobs, args.set)
    runs: dict[tuple[str, str], list[Path]] = {}
    for cell in wanted:
        runs.setdefault((cell.task, cell.algorithm), []).append(cell.folder)
    print(write_report(args.folder, runs))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
