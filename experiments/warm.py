"""``softwarp warm``: compile the kernels of environments ahead of time, into Warp's cache.

Compiled kernels are kept by the content of their source, so a cache that is copied to machines of the same kind (into a
container image, to the nodes of a cluster) saves them the compiler: point ``WARP_CACHE_PATH`` to it there. A CPU's
kernels are compiled for its instruction set, a GPU's for its compute capability.
"""

import argparse
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import active_children, get_context
from pathlib import Path

import warp as wp

from softwarp.envs import registry
from softwarp.processes import serve_parent
from softwarp.threads import begin

WORLDS = {"cpu": (1, 8), "cuda": (1,)}  # one world and eight lanes on a CPU; a GPU has one kind of kernels


def main(arguments: Sequence[str], work: Callable[..., float]) -> int:
    """Compile and tell how long each environment took; ``work`` is ``compile_for`` under a name that processes find."""
    parser = argparse.ArgumentParser(
        prog="softwarp warm", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="ENVIRONMENT", help="for example Trunk; all of them if left out")
    parser.add_argument("--device", default="cpu", help="Warp device")
    parser.add_argument("--cache", type=Path, metavar="FOLDER", help="cache to fill, instead of Warp's own")
    parser.add_argument("--jobs", type=int, help="processes at a time; as many as cores if left out")
    args = parser.parse_args(arguments)
    names = [registry.spec(name).name for name in args.names] or registry.names()
    begin()
    kind = "cpu" if wp.get_device(args.device).is_cpu else "cuda"
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    jobs = cores if args.jobs is None else args.jobs
    if jobs < 1:
        raise ValueError(f"--jobs must be at least 1, got {args.jobs}")
    folder = str(args.cache.resolve()) if args.cache else None
    start = time.perf_counter()
    spawn = get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=spawn, initializer=serve_parent) as pool:
        running = {pool.submit(work, name, args.device, WORLDS[kind], folder): name for name in names}
        try:
            for done in as_completed(running):
                print(f"{running[done]:<22}{done.result():6.1f} s", flush=True)
        except KeyboardInterrupt:
            for process in active_children():  # in the middle of a kernel, which the next run compiles again
                process.terminate()
            raise
    where = folder or wp.config.kernel_cache_dir
    print(f"{'all together':<22}{time.perf_counter() - start:6.1f} s; kernels are in {where}")
    return 0


def compile_for(name: str, device: str, worlds: Sequence[int], folder: str | None) -> float:
    """Seconds until an environment has taken two steps with each number of worlds; runs in a process of its own.

    ``folder`` is a cache other than Warp's own, to which Warp appends its version: that of this process has it already.
    """
    if folder is not None:
        wp.config.kernel_cache_dir = folder
    start = time.perf_counter()
    for count in worlds:
        env = registry.make(name, num_worlds=count, device=device, seed=0)
        data = env.reset()
        for _ in range(2):
            _, data = env.step_and_maybe_reset(env.rand_action(data))
    return time.perf_counter() - start
