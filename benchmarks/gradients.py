"""A cantilever whose motion is differentiated: time of forward and backward passes, and a motion that is found again.

    softwarp bench gradients
    softwarp bench gradients --law neo_hookean --worlds 1 64 --precision float32
    softwarp bench gradients --device cuda:0 --worlds 1024 4096

The cantilever of DiffPD (Du et al. 2021): 17 x 5 x 5 nodes, 0.32 x 0.08 x 0.08 m, E 1e7 Pa, nu 0.45, 5000 kg/m^3, 100
steps of 10 ms. Told are milliseconds per step of all worlds without and with kept factors, where a GPU has room for
these, and gradients per second: passes there and back through all steps, one for each world. Then one world looks, by
L-BFGS on the gradient, for the 1200 start velocities of another whose motion it is shown: told is the loss, the sum
over nodes and steps of squared distances [m^2] times the number that makes it 219.8 at the start, and the time.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
import warp as wp

import softwarp as sw
from softwarp import meshing
from softwarp.gradients import Rollout

from .timing import limited_cores, machine, save

DT, STEPS = 0.01, 100  # s
SIZE, CELLS = (0.32, 0.08, 0.08), (16, 4, 4)  # m
YOUNGS, NU, DENSITY = 1e7, 0.45, 5000.0  # Pa, -, kg/m^3
SHARE = 0.6  # of a GPU's free memory that kept factors may take
START = 219.8  # loss before the search
LAWS = {
    "large": lambda: sw.Corotational(YOUNGS, NU, method="large"),
    "warped": lambda: sw.Corotational(YOUNGS, NU),
    "neo_hookean": lambda: sw.NeoHookean(YOUNGS, NU),
    "st_venant_kirchhoff": lambda: sw.StVenantKirchhoff(YOUNGS, NU),
}


def build(law: str, worlds: int, device: str, precision: str, **options: Any) -> sw.Simulation:
    """The cantilever, held at x = 0."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    beam = builder.add_tets(meshing.box(SIZE, CELLS), material=LAWS[law](), density=DENSITY)
    builder.fix(beam, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)))
    model = builder.finalize(worlds, device, precision)  # type: ignore[arg-type]
    return sw.Simulation(model, dt=DT, **options)


def time_passes(rollout: Rollout, sim: sw.Simulation, repeats: int, *, factors: bool) -> dict[str, float]:
    """Median milliseconds per step of the passes, of all worlds."""
    velocity = torch.zeros_like(sim.node_v, requires_grad=True)
    samples = []
    for _ in range(repeats + 3):  # kernels compile, then graphs are recorded, then memory is touched
        wp.synchronize_device(sim.device)
        begin = time.perf_counter()
        states = rollout({"node_v": velocity}, steps=STEPS, factors=factors)
        loss = states.node_x[-1].square().sum()
        wp.synchronize_device(sim.device)
        middle = time.perf_counter()
        loss.backward()
        wp.synchronize_device(sim.device)
        samples.append((middle - begin, time.perf_counter() - middle))
    forward, backward = (sorted(times)[repeats // 2] * 1e3 / STEPS for times in zip(*samples[3:], strict=True))
    return {"forward_ms": forward, "backward_ms": backward}


def find_motion(rollout: Rollout, sim: sw.Simulation, iterations: int) -> dict[str, float]:
    """Start velocities from a motion, by L-BFGS."""
    x = sim.node_x.detach() / torch.tensor(SIZE).to(sim.node_x)
    shape = torch.stack([0.0 * x[..., 0], x[..., 0] ** 2, torch.sin(3.0 * x[..., 0])], dim=-1)
    with torch.no_grad():
        shown = rollout({"node_v": shape}, steps=STEPS).node_x
    velocity = torch.zeros_like(shape, requires_grad=True)
    optimizer = torch.optim.LBFGS(
        [velocity], max_iter=iterations, history_size=20, line_search_fn="strong_wolfe", tolerance_change=0.0
    )
    losses: list[float] = []
    weight = torch.ones((), dtype=shape.dtype, device=shape.device)

    def closure() -> torch.Tensor:
        optimizer.zero_grad()
        states = rollout({"node_v": velocity}, steps=STEPS, factors=True)
        error = (states.node_x - shown).square().sum()
        if not losses:
            weight.copy_(START / error.detach())
        loss: torch.Tensor = weight * error
        loss.backward()
        losses.append(float(loss.detach()))
        return loss

    begin = time.perf_counter()
    optimizer.step(closure)
    taken = time.perf_counter() - begin
    return {"loss_start": losses[0], "loss": min(losses), "evaluations": float(len(losses)), "seconds": taken}


def run(law: str, worlds: int, device: str, precision: str, args: argparse.Namespace) -> dict[str, Any]:
    """Times, and for one world the search."""
    sim = build(law, worlds, device, precision, threads=args.cores)
    rollout = Rollout(sim)
    record: dict[str, Any] = {"case": "gradients", "law": law, "worlds": worlds, "precision": precision}
    room = torch.cuda.mem_get_info()[0] if device.startswith("cuda") else float("inf")
    kept = STEPS * rollout.solution_bytes < SHARE * room
    for name, factors in (("solved", False), ("kept", True))[: 1 + kept]:
        times = time_passes(rollout, sim, args.repeats, factors=factors)
        record |= {f"{name}_{key}": value for key, value in times.items()}
    best = min(
        sum(record[f"{name}_{way}_ms"] for way in ("forward", "backward")) for name in ("solved", "kept")[: 1 + kept]
    )
    record["gradients_per_second"] = 1e3 * worlds / (STEPS * best)
    record["mb_per_kept_step"] = rollout.solution_bytes / worlds / 1e6
    if worlds == 1 and args.iterations:
        record |= find_motion(rollout, sim, args.iterations)
    return record


def main(arguments: Sequence[str] | None = None) -> int:
    """Time every number of worlds."""
    parser = argparse.ArgumentParser(
        prog="softwarp bench gradients", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--worlds", type=int, nargs="+", default=[1])
    parser.add_argument("--law", nargs="+", default=["large"], choices=list(LAWS))
    parser.add_argument("--device", default="cpu", help="Warp device")
    parser.add_argument("--precision", default="float32", choices=["float32", "float64"])
    parser.add_argument("--cores", type=int, help="cores of a CPU to run on")
    parser.add_argument("--repeats", type=int, default=5, help="passes that are timed")
    parser.add_argument("--iterations", type=int, default=60, help="of the search; 0 leaves it out")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers here")
    args = parser.parse_args(arguments)
    records = []
    with limited_cores(args.cores) as cores:
        for law in args.law:
            for worlds in args.worlds:
                record = machine(args.device, cores) | run(law, worlds, args.device, args.precision, args)
                records.append(record)
                kept = "no room"
                if "kept_forward_ms" in record:
                    kept = f"{record['kept_forward_ms']:.3f} and {record['kept_backward_ms']:.3f}"
                print(
                    f"{law}, {worlds} worlds: forward {record['solved_forward_ms']:.3f} ms a step, backward "
                    f"{record['solved_backward_ms']:.3f}; with factors kept, {record['mb_per_kept_step']:.2f} MB a "
                    f"step and world: {kept}; {record['gradients_per_second']:.1f} gradients a second",
                    flush=True,
                )
                if "loss" in record:
                    print(
                        f"  loss {record['loss_start']:.1f} -> {record['loss']:.2e} in {record['evaluations']:.0f} "
                        f"evaluations, {record['seconds']:.1f} s",
                        flush=True,
                    )
                save(records, args.json)
    return 0
