"""What the benchmarks share: the time of steps and of their stages, and the record of a machine."""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import subprocess
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import warp as wp

import softwarp

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
Drive = Callable[[softwarp.Simulation, int], None]


def arguments(description: str | None, worlds: Sequence[int], steps: int) -> argparse.ArgumentParser:
    """Options that all benchmarks of a scene take."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, nargs="+", default=list(worlds))
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--precision", default="float32", choices=["float32", "float64"])
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--path", default="auto", choices=["auto", "scalar", "lanes"])
    parser.add_argument("--steps", type=int, default=steps)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--stages", action="store_true", help="also time the stages, in microseconds per world-step")
    parser.add_argument("--json", type=Path, default=None)
    return parser


def measure(sim: softwarp.Simulation, drive: Drive, steps: int, repeats: int, warm_up: int = 5) -> dict[str, Any]:
    """Median seconds per step over ``repeats`` runs of ``steps``, after a warm-up that compiles and captures."""
    start = time.perf_counter()
    drive(sim, 0)
    sim.step()
    wp.synchronize_device(sim.device)
    first = time.perf_counter() - start
    for step in range(warm_up):
        drive(sim, step)
        sim.step()
    samples = []
    for repeat in range(repeats):
        drive(sim, warm_up + 5 + repeat)
        wp.synchronize_device(sim.device)
        start = time.perf_counter()
        for _ in range(steps):
            sim.step()
        wp.synchronize_device(sim.device)
        samples.append((time.perf_counter() - start) / steps)
    median = statistics.median(samples)
    return {
        "ms_per_step": 1e3 * median,
        "ms_min": 1e3 * min(samples),
        "ms_max": 1e3 * max(samples),
        "world_steps_per_s": sim.num_worlds / median,
        "first_step_s": first,
        "failed_worlds": int((sim.status >= softwarp.Status.NONFINITE).sum()),
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
    if system.response is not None:
        parts.append((system.response, "contact.", RESPONSE_STAGES))
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


def machine(device: str) -> dict[str, Any]:
    """Commit, processor and device of a record."""
    root = Path(__file__).resolve().parent
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=root, capture_output=True, text=True, check=False
    )
    return {
        "commit": commit.stdout.strip() or "unknown",
        "device": wp.get_device(device).name,
        "processor": platform.processor() or platform.machine(),
        "warp": wp.config.version,
    }


def show(record: dict[str, Any], note: str = "") -> None:
    """One record on one line, its stages below."""
    print(
        f"{record['worlds']:6d} worlds, {record['nodes']} nodes: {record['ms_per_step']:9.3f} ms/step "
        f"({record['ms_min']:.3f} .. {record['ms_max']:.3f}), {record['world_steps_per_s']:10.0f} world-steps/s, "
        f"failed {record['failed_worlds']}, first step {record['first_step_s']:.1f} s{note}",
        flush=True,
    )
    for name, value in record.get("stages_us", {}).items():
        print(f"         {name:22s} {value:9.2f} us per world-step")


def save(records: list[dict[str, Any]], path: Path | None) -> None:
    """Write records as JSON, if there is a path."""
    if path is not None:
        path.write_text(json.dumps(records, indent=1), encoding="utf-8")
