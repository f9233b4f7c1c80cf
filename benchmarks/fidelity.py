"""What a robot's fidelity costs and brings: the trunk's meshes and elements, their time and their distance from truth.

    softwarp bench fidelity                                # one world on one core, 64 on all
    softwarp bench fidelity --worlds 4096 --device cuda:0

Truth is the static shape of ``meshing.round_trunk("fine")``, whose grooves bend as converged ones do, in float64 under
weights that sag, tilt, lift and compress it. The error is the distance of tips over the tip's way from the unloaded
shape. Times are of steps in which cables move, variants in turns; ratios are medians over repetitions of the time over
that of the default in the same one.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

import softwarp
from softwarp.envs.options.trunk import TrunkSceneConfig
from softwarp.envs.scenes.trunk import build_trunk_scene, trunk_mesh
from softwarp.meshing.trunk_geometry import LENGTH

from . import trunk
from .timing import limited_cores, machine, save

VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "warped": {"rotation": "warped", "lumping": "volume"},
    "fine": {"mesh": "fine", "rotation": "warped", "lumping": "volume"},
    "accurate": {"fidelity": "accurate"},
}
TRUTH = {"mesh": "round fine", "element": "p2", "rotation": "warped"}
GRAVITY = ((0.0, -9.81, 0.0), (0.0, -2.0, 0.0), (0.0, 5.0, 5.0), (5.0, -5.0, 7.0), (-7.0, 0.0, 5.0))  # m/s^2
DRIVEN = 20  # steps before the first repetition


def tips(options: dict[str, Any]) -> NDArray[np.float64]:
    """Where the tip rests without cables under each of ``GRAVITY`` [m], (case, 3)."""
    config = TrunkSceneConfig(**options)
    builder = softwarp.ModelBuilder()
    body = builder.add_tets(
        trunk_mesh(config),
        material=softwarp.Corotational(config.youngs, config.nu, method=config.rotation),  # type: ignore[arg-type]
        element=config.element,  # type: ignore[arg-type]
        total_mass=config.total_mass,
        lumping=config.lumping if config.element == "p1" else "volume",  # type: ignore[arg-type]
    )
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1.0, 1.0, config.fixed_length + 1.0e-9)))
    builder.add_marker(body, (0.0, 0.0, LENGTH))
    sim = softwarp.Simulation(builder.finalize(len(GRAVITY), "cpu", "float64"))
    sim.params.gravity.copy_(torch.tensor(GRAVITY))
    sim.solve_static()
    return np.asarray(sim.marker_x[:, 0])


def build(options: dict[str, Any], worlds: int, device: str) -> softwarp.Simulation:
    """The trunk of a variant, bent by its cables."""
    builder = softwarp.ModelBuilder(gravity=(0.0, -9.81, 0.0))
    build_trunk_scene(TrunkSceneConfig(**options), builder)
    sim = softwarp.Simulation(builder.finalize(worlds, device))
    for step in range(DRIVEN):
        trunk.drive(sim, step)
        sim.step()
    return sim


def measure(worlds: int, device: str, repeats: int) -> list[dict[str, Any]]:
    """Records of all variants: median time of a step [ms] and its ratio to that of the default."""
    sims = {name: build(options, worlds, device) for name, options in VARIANTS.items()}
    times: dict[str, list[float]] = {name: [] for name in VARIANTS}
    steps = max(2, 40 // worlds)
    for _ in range(repeats):
        for name, sim in sims.items():
            begin = time.perf_counter()
            sim.step(steps)
            wp.synchronize_device(sim.device)
            times[name].append(1e3 * (time.perf_counter() - begin) / steps)
    return [
        {
            "variant": name,
            "worlds": worlds,
            "nodes": sims[name].model.node_count,
            "ms_per_step": statistics.median(taken),
            "world_steps_per_s": 1e3 * worlds / statistics.median(taken),
            "ratio": statistics.median(a / b for a, b in zip(taken, times["default"], strict=True)),
            "failed_worlds": int((sims[name].status > 0).sum()),
        }
        for name, taken in times.items()
    ]


def main(arguments: Sequence[str]) -> int:
    """Compare variants and print them."""
    parser = argparse.ArgumentParser(
        prog="softwarp bench fidelity", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 64])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--cores", type=int, help="of the CPU to use; one for one world, else all")
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--no-statics", action="store_true", help="times only; truth takes some minutes")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the records")
    args = parser.parse_args(arguments)
    errors: dict[str, list[float]] = {}
    if not args.no_statics:
        truth = tips(TRUTH)
        way = np.linalg.norm(truth - [0.0, 0.0, LENGTH], axis=1)
        for name, options in VARIANTS.items():
            errors[name] = (100.0 * np.linalg.norm(tips(options) - truth, axis=1) / way).round(1).tolist()
            print(f"{name:10s} tips off by {', '.join(f'{error:.1f}' for error in errors[name])} %", flush=True)
    records = []
    for worlds in args.worlds:
        with limited_cores(args.cores or (1 if worlds == 1 else None)) as cores:
            for record in measure(worlds, args.device, args.repeats):
                print(
                    f"{record['variant']:10s} {record['nodes']:5d} nodes {worlds:5d} worlds: "
                    f"{record['ms_per_step']:8.3f} ms a step, {record['world_steps_per_s']:9.0f} world-steps/s, "
                    f"{record['ratio']:5.2f} x default"
                )
                told = {"errors_percent": errors.get(record["variant"])}
                records.append(record | told | machine(args.device, cores))
    save(records, args.json)
    return 1 if any(record["failed_worlds"] for record in records) else 0
