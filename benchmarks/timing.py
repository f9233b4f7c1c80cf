"""What the benchmarks share: the time of steps and of their stages, memory, and the record of a machine."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import statistics
import subprocess
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
import warp as wp

import softwarp
from softwarp.io.atomic import write_text
from softwarp.threads import begin

SYSTEM_STAGES = (
    "load",
    "scale",
    "measure_rows",
    "command",
    "find_contacts",
    "forces",
    "tangent",
    "right_hand_side",
    "solve",
    "move",
    "commit",
)
LINEAR_STAGES = ("factor", "forward", "backward")
RESPONSE_STAGES = ("sides", "delassus", "gaps", "solve", "add_change", "add_forces")
PACKAGES = ("softwarp", "warp-lang", "torch", "numpy")
Drive = Callable[[int], None]


def measure(sim: softwarp.Simulation, drive: Drive, steps: int, repeats: int, warm_up: int = 5) -> dict[str, Any]:
    """Median seconds per step over ``repeats`` runs of ``steps``, after a warm-up that compiles and captures."""
    start = time.perf_counter()
    drive(0)
    sim.step()
    wp.synchronize_device(sim.device)
    first = time.perf_counter() - start
    for step in range(warm_up):
        drive(step)
        sim.step()
    samples = []
    for repeat in range(repeats):
        drive(warm_up + 5 + repeat)
        wp.synchronize_device(sim.device)
        start = time.perf_counter()
        for _ in range(steps):
            sim.step()
        wp.synchronize_device(sim.device)
        samples.append((time.perf_counter() - start) / steps)
    return summary(samples, sim.num_worlds) | {
        "first_step_s": first,
        "failed_worlds": int((sim.status >= softwarp.Status.NONFINITE).sum()),
    }


def summary(samples: Sequence[float], worlds: int) -> dict[str, float]:
    """Median, best and worst of seconds per step, and the world-steps per second of the median."""
    median = statistics.median(samples)
    return {
        "ms_per_step": 1e3 * median,
        "ms_min": 1e3 * min(samples),
        "ms_max": 1e3 * max(samples),
        "world_steps_per_s": worlds / median,
    }


def measure_stages(sim: softwarp.Simulation, steps: int) -> dict[str, float]:
    """Microseconds per world and stage of an uncaptured step of the first shard, each stage waited for.

    A stage counts what it calls: ``solve`` contains ``solve.factor``. Starting kernels one by one costs about 10 us
    each, which a recorded step saves; so look at the stages of many worlds.
    """
    system = sim._systems[0]
    parts: list[tuple[Any, str, Iterable[str]]] = [
        (system, "", SYSTEM_STAGES),
        (system.linear, "solve.", LINEAR_STAGES),
    ]
    if system.multipliers.response is not None:
        parts.append((system.multipliers.response, "contact.", RESPONSE_STAGES))
    total: dict[str, float] = defaultdict(float)

    def timed(owner: Any, name: str, prefix: str) -> None:
        method = getattr(owner, name)

        def run(*args: Any, **kwargs: Any) -> Any:
            wp.synchronize_device(sim.device)
            start = time.perf_counter()
            result = method(*args, **kwargs)
            wp.synchronize_device(sim.device)
            total[prefix + name] += time.perf_counter() - start
            return result

        setattr(owner, name, run)

    for owner, prefix, names in parts:
        for name in names:
            timed(owner, name, prefix)
    for _ in range(steps):
        sim._steppers[0].step()
    for owner, _, names in parts:
        for name in names:
            delattr(owner, name)
    share = 1e6 / steps / system.world_count
    return {name: share * seconds for name, seconds in sorted(total.items(), key=lambda item: -item[1])}


def array_bytes(root: object) -> int:
    """Bytes of all Warp arrays that an object of ours holds, directly or through others.

    For a ``Simulation`` that is all its memory on the device, except for what Torch keeps for ``reset``.
    """
    owned: dict[int, int] = {}
    seen: set[int] = set()
    waiting = [root]
    while waiting:
        item = waiting.pop()
        if id(item) in seen:
            continue
        seen.add(id(item))
        if isinstance(item, wp.array):
            if item.deleter is not None:  # views belong to another array, which they lead to
                owned[item.ptr] = item.capacity
            waiting += vars(item).values()
        elif isinstance(item, dict):
            waiting += item.values()
        elif isinstance(item, list | tuple | set):
            waiting += item
        elif type(item).__module__.partition(".")[0] in ("softwarp", "types") and hasattr(item, "__dict__"):
            waiting += vars(item).values()
    return sum(owned.values())


@contextlib.contextmanager
def limited_cores(count: int | None) -> Iterator[int]:
    """Run on so many cores of those that this process may use, and tell how many; None takes all.

    Threads that are started inside stay on them.

    Raises:
        ValueError: If there are not so many.
    """
    if not hasattr(os, "sched_setaffinity"):
        if count is not None:
            raise ValueError(f"cores={count}: this system cannot keep a process on some cores; leave cores out")
        yield os.cpu_count() or 1
        return
    usable, threads = os.sched_getaffinity(0), torch.get_num_threads()
    wanted = len(usable) if count is None else count
    if not 1 <= wanted <= len(usable):
        raise ValueError(f"cores={count}: this process may use {len(usable)}; choose from 1 to {len(usable)}")
    try:
        os.sched_setaffinity(0, sorted(usable)[:wanted])
        torch.set_num_threads(min(threads, wanted))
        yield wanted
    finally:
        os.sched_setaffinity(0, usable)
        torch.set_num_threads(threads)


def machine(device: str, cores: int | None = None) -> dict[str, Any]:
    """Commit, versions, processor and device of a record; ``cores`` is how many of a CPU were used."""
    root = Path(__file__).resolve().parent
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=root, capture_output=True, text=True, check=False
    )
    begin()
    name, processor = wp.get_device(device).name, processor_name()
    used = f", {cores} core{'s' if cores != 1 else ''}" if cores is not None else ""
    return {
        "commit": commit.stdout.strip() or "unknown",
        "device": name,
        "processor": processor,
        "hardware": processor + used if wp.get_device(device).is_cpu else name,
        "python": platform.python_version(),
        "versions": {package: _version(package) for package in PACKAGES},
    }


def processor_name() -> str:
    """What the processor calls itself."""
    path = Path("/proc/cpuinfo")
    if path.is_file():
        for line in path.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "from source"


def show(record: dict[str, Any], note: str = "") -> None:
    """One record on one line, its stages below."""
    memory = f", {record['memory_mb_per_world']:.2f} MB/world" if "memory_mb_per_world" in record else ""
    print(
        f"{record['scene']:34s} {record['worlds']:6d} worlds, {record['nodes']:5d} nodes: "
        f"{record['ms_per_step']:9.3f} ms/step ({record['ms_min']:.3f} .. {record['ms_max']:.3f}), "
        f"{record['world_steps_per_s']:10.0f} world-steps/s{memory}, failed {record['failed_worlds']}, "
        f"first step {record['first_step_s']:.1f} s{note}",
        flush=True,
    )
    for name, value in record.get("stages_us", {}).items():
        print(f"         {name:22s} {value:9.2f} us per world-step")


def save(records: list[dict[str, Any]], path: Path | None) -> None:
    """Write records as JSON, if there is a path."""
    if path is not None:
        write_text(path, json.dumps(records, indent=1))
