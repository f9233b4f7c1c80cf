"""A training run as a command of its own: begun, gone on with where it stopped, and ended with who asked for it.

Sweeps are made of these (experiments/pool.py), in processes of this machine or of others: all that a job needs is this
package, its settings and a folder that its machine can write to.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from softwarp import processes
from softwarp.io.atomic import writing
from softwarp.training.checkpoints import CheckpointError, CheckpointFolder, hold

PATIENCE = 120.0  # s that a job waits for one of before, whose machine lost its parent, to save and end
POLL = 0.2  # s between two looks


@dataclass(frozen=True)
class Job:
    """One run.

    Attributes:
        folder: Of the run.
        overrides: What ``softwarp train`` is told, ``out=`` included.
        total_steps: Environment steps at which it is complete.
    """

    folder: Path
    overrides: tuple[str, ...]
    total_steps: int

    @property
    def steps(self) -> int | None:
        """Environment steps at the newest checkpoint; None if there is none."""
        return max(CheckpointFolder(self.folder / "checkpoints", keep=1).steps(), default=None)

    @property
    def is_done(self) -> bool:
        """Whether nothing is left to train."""
        steps = self.steps
        return steps is not None and steps >= self.total_steps


def start(job: Job) -> subprocess.Popen[bytes]:
    """A process that trains a run, or goes on with it; it saves and ends when this one is gone."""
    told = job.overrides if job.steps is None else ("--resume", str(job.folder))
    return launch("train", told, job.folder / "train.log")


def launch(verb: str, told: Sequence[str], printed: Path) -> subprocess.Popen[bytes]:
    """A ``softwarp`` command that ends when this one is gone; what it prints goes to a file."""
    environment = os.environ | {"OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "1")}
    with writing(printed):
        printed.parent.mkdir(parents=True, exist_ok=True)
        log = printed.open("ab")
    with log:
        command = [sys.executable, "-m", "softwarp", verb, *told]
        return subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, **processes.child_options(environment))


def finish(job: Job) -> int:
    """Train a run to its end, also one whose last process is about to end; returns the exit code.

    Called again after a worker was lost, it waits for what that worker left behind, then goes on from its checkpoint.
    """
    wait_until_free(job.folder)
    if job.is_done:
        return 0
    process = start(job)
    try:
        return process.wait()
    finally:
        process.terminate()
        process.wait()


def wait_until_free(folder: Path, patience: float = PATIENCE) -> None:
    """Return when no process trains in a run folder any more, or after ``patience`` [s]."""
    end = time.monotonic() + patience
    while folder.is_dir() and time.monotonic() < end:
        try:
            with hold(folder):
                return
        except CheckpointError:
            time.sleep(POLL)
