"""Many training runs: side by side on this machine, or over the machines of a Ray cluster.

Either way each run is a ``softwarp train`` in a folder of its own. Started again, what is complete is kept and what was
begun goes on. Runs end with the command that asked for them, even by kill -9; a run whose worker or machine is lost is
begun again elsewhere, from its last checkpoint.
"""

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softwarp import notices, processes
from softwarp.jobs import POLL, Job, finish, start

RETRIES = 5  # times that a run is begun again whose worker was lost


@dataclass(frozen=True)
class Cluster:
    """Where runs are spread by Ray.

    Attributes:
        address: Of the cluster; "local" starts one on this machine, "auto" is the one that this machine belongs to.
        workers: Runs side by side, at most; 0: as many as fit.
        cores: Of each run.
        gpus: Of each run, also a part of one.
    """

    address: str = "local"
    workers: int = 0
    cores: float = 1.0
    gpus: float = 0.0


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options that say where runs are made."""
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="runs side by side, at most")
    told = "spread the runs by Ray: over the cluster at ADDRESS (auto: this machine's), or over local processes"
    parser.add_argument("--ray", nargs="?", const="local", metavar="ADDRESS", help=told)
    parser.add_argument("--cores", type=float, default=1.0, help="of each run, for Ray")
    parser.add_argument("--gpus", type=float, default=0.0, help="of each run, also a part of one, for Ray")


def run(wanted: Sequence[Job], args: argparse.Namespace) -> list[Job]:
    """Train what is not complete, as the options say.

    Returns:
        The runs that failed; what they printed is in ``train.log`` of their folder.
    """
    if args.ray is None:
        return run_here(wanted, args.jobs)
    is_local = args.ray == "local"
    return run_on_ray(wanted, Cluster(args.ray, args.jobs if is_local else 0, args.cores, args.gpus))


def run_here(wanted: Sequence[Job], jobs: int) -> list[Job]:
    """Train what is not complete, ``jobs`` runs side by side, each with one thread; returns those that failed."""
    waiting, failed = list(wanted), []
    running: dict[Job, subprocess.Popen[bytes]] = {}
    with ending_by_signal():
        try:
            while waiting or running:
                while waiting and len(running) < jobs:
                    job = waiting.pop(0)
                    if job.is_done:
                        continue
                    note(f"{job.folder}: {'starts' if job.steps is None else 'goes on'} ({len(waiting)} waiting)")
                    running[job] = start(job)
                for job, process in list(running.items()):
                    if process.poll() is not None:
                        del running[job]
                        if process.returncode != 0:
                            failed.append(job)
                            note(f"{job.folder}: failed with code {process.returncode}, see train.log there")
                if running:
                    show(list(running), len(waiting))
                time.sleep(POLL)
        finally:
            notices.progress_ends()
            for process in running.values():  # on an interrupt: every run saves and ends
                process.terminate()
            for process in running.values():
                process.wait()
    return failed


def run_on_ray(wanted: Sequence[Job], cluster: Cluster) -> list[Job]:
    """Train what is not complete as tasks of a Ray cluster, which sees the runs' folders; returns those that failed.

    Raises:
        ImportError: If Ray is not installed.
        ConnectionError: If there is no cluster at the address.
    """
    try:
        import ray
    except ImportError as error:
        raise ImportError("--ray needs Ray: pip install 'softwarp[ray]'") from error
    begun: dict[Any, Job] = {}
    failed = []
    waiting = [Job(job.folder.resolve(), job.overrides, job.total_steps) for job in wanted if not job.is_done]
    if not waiting:
        return []
    root = str(Path(processes.__file__).resolve().parents[1])  # of a checkout, which workers of this machine find so
    paths = os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH", ""))))
    local = {"num_cpus": cluster.workers * cluster.cores} if cluster.address == "local" else {}
    variables = {"PYTHONPATH": paths, "OMP_NUM_THREADS": str(max(1, int(cluster.cores)))}
    with ending_by_signal():
        try:
            ray.init(
                cluster.address,
                runtime_env={"env_vars": variables},
                include_dashboard=False if local else None,
                log_to_driver=False,
                logging_level="error",
                **local,
            )
            task = ray.remote(num_cpus=cluster.cores, num_gpus=cluster.gpus, max_retries=RETRIES)(finish)
            begun = {task.remote(job): job for job in waiting}
            note(f"{len(begun)} runs on Ray ({cluster.address}), {ray.cluster_resources().get('CPU', 0):g} cores there")
            while begun:
                done, _ = ray.wait(list(begun), timeout=1.0)
                for reference in done:
                    job = begun.pop(reference)
                    try:
                        code = ray.get(reference)
                    except ray.exceptions.RayError as error:
                        code = str(error).strip().splitlines()[0] or type(error).__name__
                    if code != 0:
                        failed.append(job)
                        note(f"{job.folder}: failed ({code}), see train.log there")
                show([job for job in begun.values() if job.folder.is_dir()], len(begun))
        finally:
            notices.progress_ends()
            ray.shutdown()  # which ends the tasks, and these their runs
    return failed


def show(running: Sequence[Job], waiting: int) -> None:
    """How far the runs are."""
    shared = os.path.commonpath([job.folder.parent for job in running]) if running else ""
    told = ", ".join(f"{job.folder.relative_to(shared)} {job.steps or 0:,}" for job in running[:8])
    notices.progress("training", f"{waiting} runs waiting; environment steps saved: {told}")


@contextmanager
def ending_by_signal() -> Iterator[None]:
    """Meanwhile SIGTERM ends this process as an interrupt does."""
    previous = signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)


def note(text: str) -> None:
    """A line about the progress of the whole."""
    with contextlib.suppress(OSError):  # a full disk below a redirection: the folders tell the same
        sys.stderr.write(f"{time.strftime('%H:%M:%S')}  {text}\n")
        sys.stderr.flush()
