"""Run the benchmarks of this folder: ``python benchmarks/run.py [--filter NAME] [--device cuda:0] [--json FOLDER]``.

Each benchmark is a file of its own with its own options; this runner gives them their defaults, or those for a GPU, and
collects their records.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
CPU = {
    "trunk": ["--worlds", "1", "64", "--stages"],
    "rod": ["--worlds", "1", "256", "--stages"],
    "contact": ["--worlds", "1", "64", "--stages"],
    "start": [],
}
CUDA = {
    "trunk": ["--worlds", "64", "1024", "4096", "--stages"],
    "rod": ["--worlds", "64", "1024", "4096", "--stages"],
    "contact": ["--worlds", "64", "1024", "4096", "--stages"],
    "start": ["--worlds", "1024"],
}


def main() -> int:
    """Run the chosen benchmarks one after the other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--filter", default="", help="run the benchmarks whose name contains this")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--json", type=Path, default=None, help="folder for the records")
    args = parser.parse_args()
    plans = CUDA if args.device.startswith("cuda") else CPU
    chosen = [name for name in plans if args.filter in name]
    if not chosen:
        parser.error(f"no benchmark matches {args.filter!r}; there are {', '.join(plans)}")
    failures = 0
    for name in chosen:
        command = [sys.executable, str(HERE / f"{name}.py"), "--device", args.device, *plans[name]]
        if args.json is not None:
            args.json.mkdir(parents=True, exist_ok=True)
            command += ["--json", str(args.json / f"{name}_{args.device.replace(':', '')}.json")]
        print(f"{name}:", flush=True)
        failures += subprocess.run(command, check=False).returncode != 0
    return 1 if failures else 0


if __name__ == "__main__":
    raise SystemExit(main())
