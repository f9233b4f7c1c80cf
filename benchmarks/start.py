"""Time from starting Python to the end of the first step, with an empty and with a warm kernel cache.

    softwarp bench start --worlds 64
    softwarp bench start --scenes contact --worlds 1 --modules 8
    softwarp bench start --commands

A new process for every figure; the medians of the warm runs are reported, the cold one is run once. Processor seconds
stand beside the time that passed, which other processes lengthen. ``--modules`` also lists the modules that took
longest to compile; ``softwarp warm`` compiles ahead of time. A scene has to take its first step within 60 s with an
empty cache and 5 s with a warm one, and ``import softwarp`` has to take less than 1 s.

``--commands`` measures what a user meets first instead: seconds until help is printed, a mistyped setting told,
``import softwarp`` and an environment's first step done, and the demo's first line there.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
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
ENV_STEP = """
import sys
import softwarp
env = softwarp.make("Trunk", num_worlds=int(sys.argv[1]), seed=0)
env.step(env.rand_action(env.reset()))
"""
COMMAND = "import sys; from softwarp import cli; sys.exit(cli.main(sys.argv[1:]))"
MISTAKE = ("train", "env=trunk", "algo.learning_rte=1")
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


def run(program: str, *arguments: str, cache: str | None = None, code: int = 0) -> Process:
    """Run a Python program to its end, with a folder for kernels of its own, and an exit code that it must have."""
    command = [sys.executable, "-c", program, *arguments]
    start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = os.environ | ({"WARP_CACHE_PATH": cache} if cache else {})
    streams: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    done = subprocess.run(command, check=False, env=environment, text=True, **streams)
    if done.returncode != code:
        raise subprocess.CalledProcessError(done.returncode, command)
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


def run_until_told(program: str, *arguments: str) -> Process:
    """Run a Python program until it has written its first line to standard output; it is ended then."""
    command = [sys.executable, "-c", program, *arguments]
    start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert process.stdout is not None
    told, wall = process.stdout.readline(), time.perf_counter() - start
    process.kill()
    process.communicate()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if not told:
        raise RuntimeError(f"{' '.join(arguments)} ended without a word")
    return Process(wall, after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime, told)


def commands(worlds: int, repeats: int) -> dict[str, dict[str, float]]:
    """What a user meets first: least and median seconds and least processor seconds; printed as they come."""
    with tempfile.TemporaryDirectory() as folder:
        step = f"first step of Trunk, {worlds} worlds"
        parts: dict[str, tuple[int, Callable[[], Process]]] = {
            "softwarp --help": (repeats, lambda: run(COMMAND, "--help")),
            "softwarp " + " ".join(MISTAKE): (repeats, lambda: run(COMMAND, *MISTAKE, code=2)),
            IMPORT: (repeats, lambda: run(IMPORT)),
            f"{step}, empty cache": (1, lambda: run(ENV_STEP, str(worlds), cache=folder)),
            step: (repeats, lambda: run(ENV_STEP, str(worlds), cache=folder)),
            "softwarp demo, first line": (repeats, lambda: run_until_told(COMMAND, "demo", folder)),
        }
        found = {}
        for name, (count, measure) in parts.items():
            done = [measure() for _ in range(count)]
            wall = [one.wall for one in done]
            told = {"least_s": min(wall), "median_s": statistics.median(wall)}
            found[name] = told | {"processor_s": min(one.processor for one in done)}
            print(f"| {name} | " + " | ".join(f"{seconds:.1f}" for seconds in found[name].values()) + " |", flush=True)
    return found


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
    parser.add_argument("--commands", action="store_true", help="what a user meets first, instead of scenes")
    parser.add_argument("--json", type=Path, default=None)
    args = parser.parse_args(arguments)
    about = machine(args.device)
    if args.commands:
        found = commands(args.worlds, args.repeats)
        if args.json:
            write_text(args.json, json.dumps(about | found, indent=1))
        return 0
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
