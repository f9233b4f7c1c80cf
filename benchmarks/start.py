"""Time from starting Python to the end of the first step, with an empty and with a warm kernel cache.

    python benchmarks/start.py --worlds 64
    python benchmarks/start.py --scenes contact --worlds 1 --modules 8

A new process for every figure; the medians of the warm runs are reported, the cold one is run once. ``--modules`` also
lists the modules that took longest to compile.
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
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
SCENES = {
    "trunk": ("trunk", "'medium', 1.0, worlds, device, 'float32'"),
    "rod": ("rod", "worlds, device, 'float32'"),
    "contact": ("contact", "worlds, device, 'float32', True"),
}
SCRIPT = """
import sys
import warp as wp
wp.config.kernel_cache_dir = sys.argv[1]
worlds, device = int(sys.argv[2]), sys.argv[3]
from {file} import build
sim = build({arguments})
sim.step()
assert int(sim.status.max()) == 0
"""
COMPILED = re.compile(r"Module softwarp\.kernels\.(\S+) .* took ([\d.]+) ms +\(compiled\)")


def run(scene: str, cache: str, worlds: int, device: str) -> tuple[float, dict[str, float]]:
    """Wall time of a process that imports softwarp, builds a scene and takes one step; compile times of modules [s]."""
    file, arguments = SCENES[scene]
    script = SCRIPT.format(file=file, arguments=arguments)
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", script, cache, str(worlds), device],
        check=True,
        cwd=HERE,
        stdout=subprocess.PIPE,
        text=True,
    )
    seconds = time.perf_counter() - start
    modules = {name: float(ms) / 1e3 for name, ms in COMPILED.findall(done.stdout)}
    return seconds, dict(sorted(modules.items(), key=lambda item: -item[1]))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--modules", type=int, default=0, help="modules to list, the slowest to compile first")
    parser.add_argument("--json", type=Path, default=None)
    args = parser.parse_args()
    records: list[dict[str, Any]] = []
    for scene in args.scenes:
        with tempfile.TemporaryDirectory() as cache:
            cold, modules = run(scene, cache, args.worlds, args.device)
            warm = statistics.median(run(scene, cache, args.worlds, args.device)[0] for _ in range(args.repeats))
        print(
            f"{scene:8s} {args.worlds} worlds on {args.device}: first step after {warm:.1f} s, with an empty kernel "
            f"cache {cold:.1f} s; {len(modules)} modules compiled in {sum(modules.values()):.1f} s",
            flush=True,
        )
        for name, seconds in list(modules.items())[: args.modules]:
            print(f"         {name:40s} {seconds:6.2f} s")
        record = {"scene": scene, "worlds": args.worlds, "device": args.device, "warm_s": warm, "cold_s": cold}
        records.append(record | {"modules_s": modules})
    if args.json:
        args.json.write_text(json.dumps(records, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
