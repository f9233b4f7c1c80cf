"""What the laws of solids cost: steps of the trunk's mesh with every law, in turns.

    softwarp bench laws                              # one world on one core, 64 on all
    softwarp bench laws --worlds 4096 --device cuda:0 --json laws.json

The trunk hangs by its base and eight cables pull. Laws take turns within every repetition, so that what else the
machine does falls on all of them; ratios are medians over repetitions of the time over that of ``large`` in the same
one. On one core it is processor time, which others' work lengthens less.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import warp as wp

import softwarp
from softwarp.envs.scenes import trunk as scene

from . import trunk
from .timing import limited_cores, machine, save

YOUNGS, NU = 450.0e3, 0.45
SHEAR = YOUNGS / (2.0 * (1.0 + NU))
LAWS: dict[str, Callable[[], Any]] = {
    "large": lambda: softwarp.Corotational(YOUNGS, NU, method="large"),
    "warped": lambda: softwarp.Corotational(YOUNGS, NU, method="warped"),
    "polar": lambda: softwarp.Corotational(YOUNGS, NU, method="polar"),
    "St. Venant-Kirchhoff": lambda: softwarp.StVenantKirchhoff(YOUNGS, NU),
    "neo-Hookean": lambda: softwarp.NeoHookean(YOUNGS, NU),
    "stable neo-Hookean": lambda: softwarp.StableNeoHookean(YOUNGS, NU),
    "Yeoh": lambda: softwarp.Yeoh.with_nu(NU, c10=0.5 * SHEAR, c20=1.0e3),
    "Mooney-Rivlin": lambda: softwarp.MooneyRivlin.with_nu(NU, c10=0.35 * SHEAR, c01=0.15 * SHEAR),
    "Ogden, one term": lambda: softwarp.Ogden.with_nu(NU, mu_1=SHEAR, alpha_1=2.5),
    "Ogden, three terms": lambda: softwarp.Ogden.with_nu(
        NU, mu_1=0.75 * SHEAR, alpha_1=1.3, mu_2=0.15 * SHEAR, alpha_2=5.0, mu_3=0.1 * SHEAR, alpha_3=-2.0
    ),
}
DRIVEN = 20  # steps before the first repetition


def build(law: str, worlds: int, device: str, precision: str) -> softwarp.Simulation:
    """The trunk of one law, bent by its cables."""
    builder = softwarp.ModelBuilder(gravity=(0.0, -9.81, 0.0))
    usual = scene.Corotational
    scene.Corotational = lambda *_, **__: LAWS[law]()  # type: ignore[misc,assignment]
    try:
        scene.build_trunk_scene(scene.TrunkSceneConfig(), builder)
    finally:
        scene.Corotational = usual  # type: ignore[misc]
    sim = softwarp.Simulation(builder.finalize(worlds, device, precision))
    for step in range(DRIVEN):
        trunk.drive(sim, step)
        sim.step()
    return sim


def measure(
    worlds: int, device: str, precision: str, repeats: int, steps: int, clock: Callable[[], float]
) -> list[dict[str, Any]]:
    """Records of all laws: median time of a step [ms] and its ratio to that of ``large``."""
    sims = {law: build(law, worlds, device, precision) for law in LAWS}
    times: dict[str, list[float]] = {law: [] for law in LAWS}
    for _ in range(repeats):
        for law, sim in sims.items():
            begin = clock()
            sim.step(steps)
            wp.synchronize_device(sim.device)
            times[law].append(1e3 * (clock() - begin) / steps)
    failed = {law: int((sim.status != 0).sum()) for law, sim in sims.items()}
    return [
        {
            "law": law,
            "worlds": worlds,
            "ms_per_step": statistics.median(taken),
            "world_steps_per_s": 1e3 * worlds / statistics.median(taken),
            "ratio": statistics.median(a / b for a, b in zip(taken, times["large"], strict=True)),
            "failed_worlds": failed[law],
        }
        for law, taken in times.items()
    ]


def main(arguments: Sequence[str]) -> int:
    """Time all laws and print them."""
    parser = argparse.ArgumentParser(
        prog="softwarp bench laws", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 64])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--precision", choices=("float32", "float64"), default="float32")
    parser.add_argument("--cores", type=int, help="of the CPU to use; one for one world, else all")
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the records")
    args = parser.parse_args(arguments)
    records = []
    for worlds in args.worlds:
        with limited_cores(args.cores or (1 if worlds == 1 else None)) as cores:
            steps = max(2, 40 // worlds)
            clock = time.process_time if cores == 1 and args.device == "cpu" else time.perf_counter
            for record in measure(worlds, args.device, args.precision, args.repeats, steps, clock):
                print(
                    f"{record['law']:22s} {worlds:5d} worlds: {record['ms_per_step']:8.3f} ms a step, "
                    f"{record['world_steps_per_s']:9.0f} world-steps/s, {record['ratio']:5.2f} x large"
                )
                records.append(record | machine(args.device, cores))
    save(records, args.json)
    return 1 if any(record["failed_worlds"] for record in records) else 0
