"""The learning baselines: tasks x algorithms x seeds, learning curves and a table beside SofaGym's statements.

    softwarp baselines FOLDER                      # SofaGym's networks and budgets: days of computing
    softwarp baselines FOLDER --setting fast       # many worlds: hours
    softwarp baselines FOLDER --setting small      # a test of everything, minutes
    softwarp baselines FOLDER --setting fast --ray auto          # over the machines of a Ray cluster
    softwarp baselines FOLDER --setting fast --tasks gripper --set device=cuda:0 --jobs 2

The last one is figures 3 and 4 of its paper: Gripper with and without random pull (``gripper_pull``), with and without
memory (``_lstm``) and cloning of the hand-written policy (``_cloned``), whose demonstrations it records first.

Every run is a ``softwarp train`` in a folder of its own, ``FOLDER/<task>/<algorithm>/seed_<k>``. Started again, the
command goes on where it stopped: finished runs are kept, begun ones resumed. ``curves.csv``, ``curves.png``,
``table.csv`` and ``table.md`` are written from what there is.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from softwarp.advice import nearest
from softwarp.envs import registry
from softwarp.jobs import Job, launch
from softwarp.training.checkpoints import CheckpointFolder

from . import baselines_grasp as grasp
from . import pool
from .baselines_report import write_report
from .config import TrainConfig, compose
from .verbs import folder_name

ALGORITHMS = ("ppo", "sac", "ppo_avec", "sac_avec")
TASKS = {"cartstem": "CartStem", "cartstemcontact": "CartStemContact", "catchtheobject": "CatchTheObject"}
KNOWN = (*TASKS, *grasp.TASKS)
PPO_ONLY = ("cartstem",)  # discrete actions: SofaGym trains it with PPO alone
SMALL_BUDGET = (
    *("total_steps=1500", "num_worlds=8", "network=mlp", "network.hidden=[32,32]"),
    *("evaluations=3", "evaluation_episodes=5", "checkpoint_seconds=5"),
)
SMALL = {"ppo": ("algo.horizon=16", "algo.minibatches=2"), "sac": ("algo.batch=64", "algo.update_ratio=0.05")}


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
        task = self.task if self.task in KNOWN else registry.spec(self.task).file_name
        return self.root / task / self.algorithm / f"seed_{self.seed}"

    @property
    def demonstrations(self) -> Path:
        """What is cloned, by all seeds."""
        return self.root / self.task / "demonstrations.npz"

    @property
    def is_cloned(self) -> bool:
        """Whether it needs demonstrations."""
        return self.task in grasp.TASKS and self.algorithm.endswith("cloned")

    @property
    def env(self) -> str:
        """An environment as ``env=`` takes it."""
        return self.task if ":" in self.task else registry.spec(self.task).file_name

    def overrides(self, setting: str) -> list[str]:
        """What ``softwarp train`` is told."""
        if self.task in grasp.TASKS:
            chosen = grasp.overrides(self.task, self.algorithm, setting, self.demonstrations)
            return [*chosen, *self._kept(), *(("evaluation_episodes=64",) if setting == "fast" else ())]
        base = self.algorithm.removesuffix("_avec")
        preset = f"paper/{self.task}_{self.algorithm}" if setting != "fast" else f"fast/{self.task}_{base}"
        chosen = [f"experiment={preset}"] if self.task in TASKS else [f"env={self.env}"]
        if self.task not in TASKS and setting != "fast":
            chosen.append(f"algo={self.algorithm}")
        told = [*chosen, *self._kept()]
        if setting == "fast":
            told += [f"algo={self.algorithm}", "evaluation_episodes=64", "evaluations=20"]
        if setting == "small":
            told += [*SMALL_BUDGET, *SMALL[base]]
        return told

    def _kept(self) -> list[str]:
        """Seed and folder, and what the report needs."""
        told = [f"seed={self.seed}", f"out={self.folder}", "logger=csv", "logger.picture=false"]
        return [*told, "evaluation_deterministic=false", "evaluate_start=true", "keep_checkpoints=1"]

    def steps(self) -> int | None:
        """Environment steps at the newest checkpoint; None if there is none."""
        return max(CheckpointFolder(self.folder / "checkpoints", keep=1).steps(), default=None)


def algorithms_of(task: str) -> tuple[str, ...]:
    """Those that a task is compared with."""
    if task in grasp.TASKS:
        return grasp.ALGORITHMS
    return tuple(name for name in ALGORITHMS if not (task in PPO_ONLY and name.startswith("sac")))


def cells(root: Path, tasks: Sequence[str], algorithms: Sequence[str], seeds: Sequence[int]) -> Iterator[Cell]:
    """All runs, seed by seed, so that a stop leaves something of everything."""
    for seed in seeds:
        for task in tasks:
            for algorithm in algorithms:
                if algorithm in algorithms_of(task):
                    yield Cell(root, task, algorithm, seed)


def record_all(wanted: Sequence[Cell], setting: str, extra: Sequence[str]) -> None:
    """Record the demonstrations that are not there yet; cells that would clone them fail without, and tell why."""
    for path, cell in {cell.demonstrations: cell for cell in wanted if cell.is_cloned}.items():
        if path.is_file():
            continue
        pool.note(f"{path}: recorded, before it is cloned")
        told = [*cell.overrides(setting), *extra]
        process = launch("record", grasp.recording(told, setting, path), path.with_suffix(".log"))
        try:
            process.wait()
        finally:
            process.terminate()
            process.wait()
        if process.returncode != 0:
            pool.note(f"{path}: failed with code {process.returncode}, see {path.with_suffix('.log').name} there")


def jobs_of(wanted: Sequence[Cell], setting: str, extra: Sequence[str]) -> list[Job]:
    """The runs with their settings and budgets."""
    budgets: dict[tuple[str, str], int] = {}
    found = []
    for cell in wanted:
        overrides = [*cell.overrides(setting), *extra]
        key = (cell.task, cell.algorithm)
        if key not in budgets:
            budgets[key] = compose("train", TrainConfig, overrides).total_steps
        found.append(Job(cell.folder, tuple(overrides), budgets[key]))
    return found


def main(argv: Sequence[str] | None = None) -> int:
    """Train and report; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="softwarp baselines", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=folder_name)
    parser.add_argument("--setting", choices=("paper", "fast", "small"), default="paper")
    told = (
        f"{', '.join(KNOWN)} (gripper: both), or environments such as my_module:MyRobot, with settings given by --set"
    )
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), metavar="TASK", help=told)
    every = tuple(dict.fromkeys((*ALGORITHMS, *grasp.ALGORITHMS)))
    told = f"of Gripper {', '.join(grasp.ALGORITHMS)}; of the others {', '.join(ALGORITHMS)}; all without"
    parser.add_argument("--algorithms", nargs="+", choices=every, default=list(every), metavar="NAME", help=told)
    parser.add_argument("--seeds", type=int, default=6, help="how many, 0, 10, 20, ... as SofaGym; default 6")
    parser.add_argument("--report-only", action="store_true", help="train nothing, draw what there is")
    parser.add_argument("--set", nargs="+", default=[], metavar="key=value", help="further settings of every run")
    pool.add_options(parser)
    args = parser.parse_args(argv)
    for name in ("seeds", "jobs"):
        if getattr(args, name) < 1:
            parser.error(f"--{name} must be at least 1, got {getattr(args, name)}")
    for task in args.tasks:
        if task not in KNOWN and ":" not in task and task not in registry.names():
            raise ValueError(f"--tasks: there is no {task!r}; {nearest(task, [*KNOWN, *registry.names()])}")
    tasks = dict.fromkeys(name for task in args.tasks for name in (grasp.TASKS if task == "gripper" else (task,)))
    if args.ray is not None:  # for workers in other folders
        args.folder = args.folder.resolve()
    wanted = list(cells(args.folder, list(tasks), args.algorithms, [10 * k for k in range(args.seeds)]))
    if not wanted:
        parser.error(f"--algorithms: none of {', '.join(args.algorithms)} is compared on {', '.join(tasks)}")
    failed: list[Job] = []
    if not args.report_only:
        with pool.ending_by_signal():
            record_all([cell for cell in wanted if cell.steps() is None], args.setting, args.set)
        failed = pool.run(jobs_of(wanted, args.setting, args.set), args)
    runs: dict[tuple[str, str], list[Path]] = {}
    for cell in wanted:
        runs.setdefault((cell.task, cell.algorithm), []).append(cell.folder)
    print(write_report(args.folder, runs))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
