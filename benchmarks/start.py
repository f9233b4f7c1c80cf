"""Time from starting Python to the end of the first step, with an empty and with a warm kernel cache.

    softwarp bench start --worlds 64
    softwarp bench start --scenes contact --worlds 1 --modules 8

A new process for every figure; the medians of the warm runs are reported, the cold one is run once. Processor seconds
stand beside the time that passed, which other processes lengthen. ``--modules`` also lists the modules that took
longest to compile; ``softwarp warm`` compiles ahead of time. A scene has to take its first step within 60 s with an
empty cache and 5 s with a warm one, and ``import softwarp`` has to take less than 1 s.
"""

from __future__ import annotations

import argparse
import json
import re
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softwarp.io.atomic import write_text

from .timing import machine

SCENES = ("trunk", "rod", "contact")
IMPORT = "import softwarp"
FIRST_STEP = """
import logging, sys
import warp as wp
wp.config.kernel_cache_dir = sys.argv[1]
scene, worlds, device = sys.argv[2], int(sys.argv[3]), sys.argv[4]
from softwarp import cli
sim = cli.script("benchmarks", scene).build(worlds, device, "float32")
logging.getLogger("softwarp").setLevel(logging.INFO)  # a line for every module
sim.step()
assert int(sim.status.max()) == 0
"""
COMPILED = re.compile(r"Module softwarp\.kernels\.(\S+) .* took ([\d.]+) ms +\(compiled\)")


@dataclass(frozen=True, order=True)
class Process:
    """A finished Python process: time that passed, processor time, and what it told [s]."""

    wall: float
    processor: float
    output: str

    def __str__(self) -> str:
        """Both times."""
        return f"{self.wall:.2f} s ({self.processor:.2f} s of processor)"


def run(program: str, *arguments: str) -> Process:
    """Run a Python program to its end."""
    command = [sys.executable, "-c", program, *arguments]
    start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    processor = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    return Process(wall, processor, done.stdout)


def median(program: str, *arguments: str, repeats: int) -> Process:
    """The run of median length."""
    return statistics.median_low([run(program, *arguments) for _ in range(repeats)])


def compiled(process: Process) -> dict[str, float]:
    """Compile times of Warp modules that a process tells of [s], the longest first."""
    modules = {name: float(ms) / 1e3 for name, ms in COMPILED.findall(process.output)}
    return dict(sorted(modules.items(), key=lambda item: -item[1]))


def main(arguments: Sequence[str]) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        prog="softwarp bench start", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=SCENES)
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--modules", type=int, default=0, help="modules to list, the slowest to compile first")
    parser.add_argument("--json", type=Path, default=None)
    args = parser.parse_args(arguments)
    about = machine(args.device)
    imported = median(IMPORT, repeats=args.repeats)
    print(f"import softwarp: {imported}", flush=True)
    records: list[dict[str, Any]] = []
    for scene in args.scenes:
        with tempfile.TemporaryDirectory() as cache:
            inputs = (FIRST_STEP, cache, scene, str(args.worlds), args.device)
            cold = run(*inputs)
            warm = median(*inputs, repeats=args.repeats)
        modules = compiled(cold)
        print(
            f"{scene:8s} {args.worlds} worlds on {args.device}: first step after {warm}, with an empty kernel "
            f"cache {cold}; {len(modules)} modules compiled in {sum(modules.values()):.1f} s",
            flush=True,
        )
        for name, seconds in list(modules.items())[: args.modules]:
            print(f"         {name:40s} {seconds:6.2f} s")
        record = {
            "scene": scene,
            "worlds": args.worlds,
            "device": args.device,
            "warm_s": warm.wall,
            "cold_s": cold.wall,
        }
        record |= {"warm_processor_s": warm.processor, "cold_processor_s": cold.processor}
        record |= {"import_s": imported.wall, "import_processor_s": imported.processor, "modules_s": modules}
        records.append(about | record)
        if args.json:
            write_text(args.json, json.dumps(records, indent=1))
    return 0
