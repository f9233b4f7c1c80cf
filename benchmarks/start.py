"""Time from starting Python to the end of the first step, with an empty and with a warm kernel cache.

    python benchmarks/start.py --worlds 64

A new process for every figure; the medians of the warm runs are reported, the cold one is run once.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SCRIPT = """
import sys
import warp as wp
wp.config.log_level = wp.LOG_WARNING
wp.config.kernel_cache_dir = sys.argv[1]
import softwarp
from softwarp.envs.trunk_scene import TrunkSceneConfig, build_trunk_scene
builder = softwarp.ModelBuilder(gravity=(0.0, -9.81, 0.0))
build_trunk_scene(TrunkSceneConfig(), builder)
sim = softwarp.Simulation(builder.finalize(int(sys.argv[2]), sys.argv[3]))
sim.step()
assert int(sim.status.max()) == 0
"""


def seconds(cache: str, worlds: int, device: str) -> float:
    """Wall time of a process that imports softwarp, builds the trunk and takes one step."""
    start = time.perf_counter()
    subprocess.run([sys.executable, "-c", SCRIPT, cache, str(worlds), device], check=True)
    return time.perf_counter() - start


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", type=Path, default=None)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as cache:
        cold = seconds(cache, args.worlds, args.device)
        warm = statistics.median(seconds(cache, args.worlds, args.device) for _ in range(args.repeats))
    print(
        f"{args.worlds} worlds on {args.device}: first step after {warm:.1f} s, with an empty kernel cache {cold:.1f} s"
    )
    if args.json:
        args.json.write_text(json.dumps({"worlds": args.worlds, "device": args.device, "warm_s": warm, "cold_s": cold}))


if __name__ == "__main__":
    main()
