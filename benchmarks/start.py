"""Time from starting Python to the end of the first step, with an empty and with a warm kernel cache.

    softwarp bench start --worlds 64
    softwarp bench start --scenes contact --worlds 1 --modules 8

A new process for every figure; the medians of the warm runs are reported, the cold one is run once. ``--modules`` also
lists the modules that took longest to compile. A scene has to take its first step within 60 s with an empty cache and
5 s with a warm one, and ``import softwarp`` has to take less than 1 s.
"""

from __future__ import annotations

import argparse
import json
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .timing import machine

SCENES = ("trunk", "rod", "contact")
IMPORT = "import softwarp"
FIRST_STEP = """
import sys
import warp as wp
wp.config.kernel_cache_dir = sys.argv[1]
scene, worlds, device = sys.argv[2], int(sys.argv[3]), sys.argv[4]
from softwarp import cli
sim = cli.script("benchmarks", scene).build(worlds, device, "float32")
wp.config.log_level = wp.LOG_INFO
sim.step()
assert int(sim.status.max()) == 0
"""
COMPILED = re.compile(r"Module softwarp\.kernels\.(\S+) .* took ([\d.]+) ms +\(compiled\)")


def run(program: str, *arguments: str) -> tuple[float, dict[str, float]]:
    """Wall time of a Python process, and the compile times of Warp modules that it tells of [s]."""
    command = [sys.executable, "-c", program, *arguments]
    start = time.perf_counter()
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    seconds = time.perf_counter() - start
    modules = {name: float(ms) / 1e3 for name, ms in COMPILED.findall(done.stdout)}
    return seconds, dict(sorted(modules.items(), key=lambda item: -item[1]))


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
    imported = statistics.median(run(IMPORT)[0] for _ in range(args.repeats))
    print(f"import softwarp: {imported:.2f} s", flush=True)
    records: list[dict[str, Any]] = []
    for scene in args.scenes:
        with tempfile.TemporaryDirectory() as cache:
            inputs = (FIRST_STEP, cache, scene, str(args.worlds), args.device)
            cold, modules = run(*inputs)
            warm = statistics.median(run(*inputs)[0] for _ in range(args.repeats))
        print(
            f"{scene:8s} {args.worlds} worlds on {args.device}: first step after {warm:.1f} s, with an empty kernel "
            f"cache {cold:.1f} s; {len(modules)} modules compiled in {sum(modules.values()):.1f} s",
            flush=True,
        )
        for name, seconds in list(modules.items())[: args.modules]:
            print(f"         {name:40s} {seconds:6.2f} s")
        record = {"scene": scene, "worlds": args.worlds, "device": args.device, "warm_s": warm, "cold_s": cold}
        records.append(about | record | {"import_s": imported, "modules_s": modules})
        if args.json:
            args.json.write_text(json.dumps(records, indent=1), encoding="utf-8")
    return 0
