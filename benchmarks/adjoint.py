"""What gradients through a step cost beside the step: adjoint and forward mode of the trunk, in plain steps.

    softwarp bench adjoint
    softwarp bench adjoint --worlds 1 8 --cores 1
    softwarp bench adjoint --device cuda:0 --worlds 1024

The trunk of 674 nodes, in float32, moves for some steps under tensions that change. Told are milliseconds of a plain
step of all worlds, and in times of that: a step whose factor is kept; the adjoint of a step whose factor is kept, and
of one that is solved again, without gradients by parameters and with them; a step with forward mode along one
direction, and each further one. All are measured in turns and told as medians, on a CPU of the time that the process
had, which other processes do not add to.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
import warp as wp

import softwarp as sw
from softwarp.gradients import Rollout, jvp

from .timing import limited_cores, machine, save

STEPS = 20
DIRECTIONS = 5  # of the second run of forward mode
PARAMETERS = ("youngs", "density")  # whose gradients are asked for, where some are


class Trunk:
    """Passes through the steps of some trunks.

    Args:
        worlds: How many.
        device: Warp device.
        mesh: Of the trunk.
    """

    def __init__(self, worlds: int, device: str, mesh: str) -> None:
        own: dict[str, Any] = {"mesh": mesh} if mesh else {}
        self.sim = sw.make("Trunk", num_worlds=worlds, seed=0, device=device, **own).sim
        self.rollout = Rollout(self.sim)
        control = self.sim.control
        held = {"cable_displacement": control.cable_displacement, "cable_tension": control.cable_tension}
        shares = torch.linspace(0.0, 1.0, STEPS, device=control.cable_tension.device)
        self.controls = {
            name: value + shares.reshape(-1, 1, 1) * (0.01 if name == "cable_displacement" else 0.5)
            for name, value in held.items()
        }
        self.parameters = {name: getattr(self.sim.params, name).clone() for name in PARAMETERS}
        self.clock = time.process_time if self.sim.device.startswith("cpu") else time.perf_counter

    def timed(self, run: Callable[[], Any]) -> tuple[float, Any]:
        """Seconds of one function, and what it returns."""
        wp.synchronize_device(self.sim.device)
        begin = self.clock()
        found = run()
        wp.synchronize_device(self.sim.device)
        return self.clock() - begin, found

    def plain(self) -> dict[str, float]:
        """Steps that nobody differentiates."""
        with torch.no_grad():
            return {"plain": self.timed(lambda: self.rollout(controls=self.controls))[0]}

    def backward(self, *, factors: bool, parameters: bool) -> dict[str, float]:
        """Both passes of reverse mode."""
        controls = {name: value.clone().requires_grad_() for name, value in self.controls.items()}
        held = {name: value.clone().requires_grad_() for name, value in self.parameters.items()} if parameters else {}
        forward, states = self.timed(lambda: self.rollout(None, controls, held, factors=factors))
        loss = states.node_x.square().sum()
        back, _ = self.timed(loss.backward)
        name = f"adjoint {'kept' if factors else 'solved'}{' parameters' if parameters else ''}"
        return {name: back} | ({"kept": forward} if factors and not parameters else {})

    def forward(self, directions: int) -> dict[str, float]:
        """Forward mode along some directions of the parameters."""
        along = {
            "parameters": {name: value.expand(directions, *value.shape) for name, value in self.parameters.items()}
        }
        return {f"forward {directions}": self.timed(lambda: jvp(self.rollout, along, controls=self.controls))[0]}


def run(worlds: int, device: str, mesh: str, repeats: int) -> dict[str, Any]:
    """Medians of all passes, measured in turns."""
    trunk = Trunk(worlds, device, mesh)
    samples: dict[str, list[float]] = {}
    for repeat in range(repeats + 3):  # kernels compile, then graphs are recorded, then memory is touched
        found = trunk.plain()
        for factors in (True, False):
            for parameters in (False, True):
                found |= trunk.backward(factors=factors, parameters=parameters)
        found |= trunk.forward(1) | trunk.forward(DIRECTIONS)
        if repeat >= 3:
            for name, seconds in found.items():
                samples.setdefault(name, []).append(seconds)
    ratios = {
        name: statistics.median(a / b for a, b in zip(times, samples["plain"], strict=True))
        for name, times in samples.items()
    }
    more = (ratios[f"forward {DIRECTIONS}"] - ratios["forward 1"]) / (DIRECTIONS - 1)
    return {
        "case": "adjoint",
        "worlds": worlds,
        "mesh": mesh,
        "plain_ms": 1e3 * statistics.median(samples["plain"]) / STEPS,
        "further_direction": more,
        "mb_per_kept_step": trunk.rollout.solution_bytes / worlds / 1e6,
        **{name.replace(" ", "_"): ratio for name, ratio in ratios.items()},
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Time every number of worlds."""
    parser = argparse.ArgumentParser(
        prog="softwarp bench adjoint", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--worlds", type=int, nargs="+", default=[1])
    parser.add_argument("--device", default="cpu", help="Warp device")
    parser.add_argument("--mesh", default="", help="of the trunk; its own where left out")
    parser.add_argument("--cores", type=int, default=1, help="cores of a CPU to run on")
    parser.add_argument("--repeats", type=int, default=7, help="passes that are timed")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers here")
    args = parser.parse_args(arguments)
    records = []
    with limited_cores(args.cores) as cores:
        for worlds in args.worlds:
            record = machine(args.device, cores) | run(worlds, args.device, args.mesh, args.repeats)
            records.append(record)
            print(
                f"{worlds} worlds: plain step {record['plain_ms']:.2f} ms; kept {record['kept']:.2f}; adjoint, kept "
                f"{record['adjoint_kept']:.2f}, with parameters {record['adjoint_kept_parameters']:.2f}; solved again "
                f"{record['adjoint_solved']:.2f}, {record['adjoint_solved_parameters']:.2f}; forward mode "
                f"{record['forward_1']:.2f}, and {record['further_direction']:.2f} a direction more",
                flush=True,
            )
            save(records, args.json)
    return 0
