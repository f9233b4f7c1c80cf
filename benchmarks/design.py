"""A finger whose chamber is shaped by gradient: how much farther it bends at equal pressure, and on a finer mesh.

    softwarp bench design

A bar of 80 x 20 x 20 mm, held at one end, with a closed chamber of 60 mm. Three numbers shape the chamber: heights of
its floor and roof and half its width; its walls stay at least 1.5 mm thick. Gradients of the deflection of the tip by
the rest positions of all nodes (``gradients.Equilibrium`` with ``rest``) become those by the three numbers; ascent goes
on until the tip is ``--times`` as far as at first. Both shapes are then compared on a mesh of half the edge.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

import softwarp as sw
from softwarp import meshing
from softwarp.gradients import Equilibrium

from .timing import save

SIZE = (0.08, 0.02, 0.02)  # m
YOUNGS, NU, DENSITY = 1e5, 0.45, 1000.0  # Pa, -, kg/m^3
PRESSURE = 2.5e4  # Pa
START = (0.0100, 0.0150, 0.0030)  # m: floor, roof, half width
LOW, HIGH, THINNEST = (0.0015, 0.0060, 0.0020), (0.0140, 0.0185, 0.0085), 0.003  # m; the last of the chamber
STEP = 2e-4  # m, of the ascent


def shaped(grid: torch.Tensor, shape: torch.Tensor) -> torch.Tensor:
    """Rest positions from those of a bar with the chamber's walls at 1/4 and 3/4 of the width, 1/2 and 3/4 high."""
    width, height = SIZE[1], SIZE[2]
    floor, roof, half = shape
    y, z = grid[:, 1] / width, grid[:, 2] / height
    side = (y - 0.5).abs()
    out = torch.where(side <= 0.25, side / 0.25 * half, half + (side - 0.25) / 0.25 * (0.5 * width - half))
    low = z / 0.5 * floor
    middle = floor + (z - 0.5) / 0.25 * (roof - floor)
    high = roof + (z - 0.75) / 0.25 * (height - roof)
    up = torch.where(z <= 0.5, low, torch.where(z <= 0.75, middle, high))
    return torch.stack([grid[:, 0], 0.5 * width + torch.sign(y - 0.5) * out, up], dim=1)


class Finger:
    """A mesh of the bar without its chamber.

    Args:
        cells: Cells along the chamber's height; the bar has 16 and 4 times as many along its length and width.
    """

    def __init__(self, cells: int) -> None:
        bar = meshing.box(SIZE, (16 * cells, 4 * cells, 4 * cells))
        centre = bar.nodes[bar.tets].mean(axis=1) / SIZE
        hollow = ((centre > (0.125, 0.25, 0.5)) & (centre < (0.875, 0.75, 0.75))).all(axis=1)
        nodes, self.tets = meshing.compact(bar.nodes, bar.tets[~hollow])
        self.grid = torch.tensor(nodes)
        inner = meshing.TetMesh(*meshing.compact(bar.nodes, bar.tets[hollow]))
        skin, self.wall = meshing.compact(inner.nodes, inner.surface())
        self.wall_nodes = torch.cdist(torch.tensor(skin), self.grid).argmin(dim=1).numpy()

    def deflection(self, shape: torch.Tensor) -> torch.Tensor:
        """How far the tip bends downwards [m]; differentiable by the shape."""
        x = shaped(self.grid, shape)
        nodes = x.detach().numpy()
        builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        mesh = meshing.TetMesh(nodes, self.tets)
        body = builder.add_tets(mesh, material=sw.NeoHookean(YOUNGS, NU), density=DENSITY)
        builder.fix(body, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)))
        builder.add_cavity(body, nodes[self.wall_nodes], self.wall)
        sim = sw.Simulation(builder.finalize(num_worlds=1, precision="float64"))
        sim.control.cavity_pressure[...] = PRESSURE
        pose = Equilibrium(sim, rest=True)(parameters={"rest_x": x})
        tip = self.grid[:, 0] > SIZE[0] - 1e-9
        down: torch.Tensor = (x[tip, 2] - pose.node_x[0, tip, 2]).mean()
        return down


def optimise(finger: Finger, times: float, most: int) -> dict[str, Any]:
    """Ascend until the tip bends ``times`` as far."""
    shape = torch.tensor(START, dtype=torch.float64, requires_grad=True)
    low, high = torch.tensor(LOW), torch.tensor(HIGH)
    found: list[float] = []
    begin = time.perf_counter()
    while True:
        way = finger.deflection(shape)
        found.append(float(way.detach()))
        if found[-1] >= times * found[0] or len(found) > most:
            break
        (slope,) = torch.autograd.grad(way, shape)
        with torch.no_grad():
            shape += STEP * slope / slope.abs().max()
            shape.clamp_(low, high)
            shape[1].clamp_(min=float(shape[0]) + THINNEST)
    taken = time.perf_counter() - begin
    ways = {"start": found[0], "end": found[-1]}
    return {"shape": shape.detach().tolist(), **ways, "solves": len(found), "seconds": taken}


def main(arguments: Sequence[str] | None = None) -> int:
    """Shape the chamber, and look at it on a finer mesh."""
    parser = argparse.ArgumentParser(
        prog="softwarp bench design", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--times", type=float, default=2.0, help="how much farther the tip shall bend")
    parser.add_argument("--most", type=int, default=60, help="steps of the ascent, at most")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers here")
    args = parser.parse_args(arguments)
    record = {"case": "design"} | optimise(Finger(1), args.times, args.most)
    floor, roof, half = (1e3 * value for value in record["shape"])
    told = f"chamber {floor:.2f} to {roof:.2f} mm high, {2.0 * half:.2f} mm wide"
    print(f"{told} after {record['solves']} solves", flush=True)
    print(f"  tip {1e3 * record['start']:.3f} -> {1e3 * record['end']:.3f} mm, {record['seconds']:.1f} s", flush=True)
    fine = Finger(2)
    with torch.no_grad():
        ways = [float(fine.deflection(torch.tensor(shape, dtype=torch.float64))) for shape in (START, record["shape"])]
    record |= {"fine_start": ways[0], "fine_end": ways[1]}
    told = f"  on half the edge {1e3 * ways[0]:.3f} -> {1e3 * ways[1]:.3f} mm"
    print(f"{told}, {ways[1] / ways[0]:.2f} times", flush=True)
    save([record], args.json)
    return 0
