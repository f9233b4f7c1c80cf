"""``softwarp train distributed.ranks=N``: torchrun's launcher on this machine, whose ranks run the same command.

    softwarp train env=trunk distributed.ranks=4 device=cuda
    torchrun --nproc-per-node=4 -m softwarp train env=trunk device=cuda     # the same

When a rank dies the launcher ends the others, and starts all again ``distributed.restarts`` times; they go on with the
last checkpoint. A signal is passed on to all of them.
"""

import logging
import os
import sys
import uuid
from collections.abc import Sequence
from pathlib import Path

from softwarp import processes
from softwarp.training.options import DistributedConfig

GRACE = 0.1  # s between two looks of the launcher at its ranks


def launch(arguments: Sequence[str], asked: DistributedConfig) -> int:
    """Run ``softwarp`` with some arguments as several processes; returns the exit code."""
    from torch.distributed.elastic.multiprocessing.api import DefaultLogsSpecs, SignalException
    from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
    from torch.distributed.launcher.api import LaunchConfig, elastic_launch

    processes.launches_ranks()
    logging.getLogger("torch.distributed.elastic").setLevel(logging.CRITICAL)  # the ranks tell what failed
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, cores // asked.ranks)))
    root = str(Path(processes.__file__).resolve().parents[1])
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH", ""))))
    config = LaunchConfig(
        min_nodes=1,
        max_nodes=1,
        nproc_per_node=asked.ranks,
        run_id=uuid.uuid4().hex,
        rdzv_backend="c10d",
        rdzv_endpoint="localhost:0",
        max_restarts=asked.restarts,
        monitor_interval=GRACE,
        logs_specs=DefaultLogsSpecs(),
    )
    try:
        elastic_launch(config, sys.executable)("-m", "softwarp", *arguments)
    except SignalException as error:
        return 128 + int(error.sigval)
    except ChildFailedError as error:
        _, failure = error.get_first_failure()
        if failure.exitcode < 0:
            told = f"rank {failure.local_rank} was ended by signal {-failure.exitcode}"
            print(f"softwarp {arguments[0]}: {told}; the others ended too", file=sys.stderr, flush=True)
            return 128 - int(failure.exitcode)
        return int(failure.exitcode)
    return 0
