"""Searches along gradients through motions: a beam that is routed to a point, a bouncing ball whose material is found.

    softwarp bench searches
    softwarp bench searches routing --cores 1 --json searches.json

Two problems of DiffPD (Du et al. 2021), with our actuators and bodies where theirs are not to be had.

``routing``: a beam of 0.1 x 0.1 x 0.8 m, 825 nodes, E 5e5 Pa, nu 0.45, held at one end, without gravity, has 16
cables, four in each quarter of its length, whose tensions are constant over 100 steps of 10 ms: a corner of its far end
is to be at a point then. The loss is the squared distance over twice the square of a cell, 25 mm, as there, which they
bring to 0.121. Eight starts are a batch, which Adam follows; told are losses and seconds of all of them together.

``ball``: a ball of 0.2 m is thrown on a floor, 125 steps of 4 ms; log E and log nu are to be found from its motion, E
2e6 Pa and nu 0.4, from E 1e7 Pa and nu 0.45. The loss, squared distances of nodes over all steps, is scaled to
theirs at the start, 1616, which they bring to 11.6. Losses of long motions with impacts change their slope where nodes
land a step later, those of short ones hardly: ``lengthening`` fits the first fifth of the motion, until the ball has
landed, and from there longer and longer parts of it. ``survey`` steps a batch of candidates all over the box, without
gradients, and follows the gradient of the whole motion from the best of them. The search over the whole motion from the
start at once is told beside it, with gradients and without, by differences and by evolution.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import softwarp as sw
from softwarp import meshing
from softwarp.gradients import Rollout
from softwarp.identification import Differentiable, Parameter, Worlds, fit

from .timing import limited_cores, machine, save

Floats = NDArray[np.float64]

CELL, TARGET = 0.025, (0.2, 0.2, 0.45)  # m
MOST = 1000.0  # N, of a cable
RATE = 0.03  # of Adam, for tensions as shares of the most
RADIUS, CELLS = 0.1, 6  # m, and of the ball along an edge of the cube that it is made of
BEFORE = {"routing": 0.121, "ball": 11.6}  # losses that the source tells
BALL_START = 1616.0
HORIZONS, EVERY = (25, 50, 75, 100, 125), 5  # steps, until the ball has landed first; steps between kept states
CANDIDATES, FOLLOWED = 64, 3  # of the survey: worlds, and how many of them gradients are followed from
TRUE = {"youngs": 2e6, "nu": 0.4}
PARAMETERS = [
    Parameter("youngs", 1e6, 1e7, scale="log", unit="Pa", target="youngs", start=0.99e7, step=0.005),
    Parameter("nu", 0.2, 0.45, scale="log", target="nu", start=0.446, step=0.005),
]


def routing(args: argparse.Namespace) -> dict[str, Any]:
    """Constant tensions that bring a corner to the target, from several starts at once."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    mesh = meshing.box((0.1, 0.1, 0.8), args.cells)
    beam = builder.add_tets(mesh, material=sw.Corotational(5e5, 0.45), density=1e3)
    builder.fix(beam, box=((-1.0, -1.0, -1.0), (1.0, 1.0, 1e-6)))
    for x in (0.025, 0.075):
        for y in (0.025, 0.075):
            for quarter in range(4):
                heights = 0.2 * quarter + np.linspace(0.0, 0.2, 5)
                builder.add_cable(beam, [(x, y, float(z)) for z in heights], control="force")
    tip = builder.add_marker(beam, (0.1, 0.1, 0.8))
    sim = sw.Simulation(builder.finalize(args.starts, precision=args.precision), dt=0.01, threads=args.cores)
    rollout, target = Rollout(sim), torch.tensor(TARGET).to(sim.node_x)
    drawn = np.random.default_rng(1).uniform(0.0, 0.4, (args.starts, sim.model.cable_count))
    share = torch.tensor(drawn).to(sim.node_x).requires_grad_()
    optimizer = torch.optim.Adam([share], lr=RATE)
    losses, times = [], []
    for _ in range(args.iterations):
        optimizer.zero_grad()
        begin = time.perf_counter()
        states = rollout(controls={"cable_tension": MOST * share}, steps=100, factors=True)
        loss = (states.marker_x[-1, :, tip] - target).square().sum(dim=-1) / (2.0 * CELL**2)
        middle = time.perf_counter()
        loss.sum().backward()
        times.append((middle - begin, time.perf_counter() - middle))
        losses.append(loss.detach())
        optimizer.step()
        share.data.clamp_(0.0, 1.0)
    forward, backward = np.median(times, axis=0)
    found = torch.stack(losses)
    reached = (found.amin(dim=1) <= BEFORE["routing"]).nonzero().flatten()
    return {
        "case": "routing",
        "starts": args.starts,
        "loss_start": float(found[0].median()),
        "loss": float(found.min()),
        "median_loss": float(found.amin(dim=0).median()),
        "evaluations": len(losses),
        "evaluations_to_published": int(reached[0]) + 1 if len(reached) else None,
        "seconds": float(np.sum(times)),
        "forward_s": float(forward),
        "backward_s": float(backward),
    }


def ball(worlds: int, precision: str, cores: int | None) -> sw.Simulation:
    """A ball above a floor, thrown."""
    cube = meshing.box((2.0, 2.0, 2.0), (CELLS, CELLS, CELLS))
    away = cube.nodes - 1.0
    largest, length = np.abs(away).max(axis=1, keepdims=True), np.linalg.norm(away, axis=1, keepdims=True)
    nodes = RADIUS * away * largest / np.maximum(length, 1e-12) + (0.0, 0.0, RADIUS + 0.07)
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    mesh = meshing.TetMesh(nodes, cube.tets)
    body = builder.add_tets(mesh, material=sw.Corotational(**TRUE), density=1e3)
    floor = builder.add_rigid(sw.Plane(), kinematic=True, name="floor")
    builder.add_contact(body, floor, mu=1.0)
    sim = sw.Simulation(builder.finalize(worlds, precision=precision), dt=0.004, threads=cores)  # type: ignore[arg-type]
    sim.node_v[...] = sim.node_v.new_tensor((1.5, 0.5, -1.0))
    return sim


def survey(args: argparse.Namespace, shown: torch.Tensor) -> list[list[Parameter]]:
    """Starts of fits: the best of a batch of candidates that fill the box evenly (Sobol's sequence)."""
    sim = ball(CANDIDATES, args.precision, args.cores)
    share = torch.quasirandom.SobolEngine(len(PARAMETERS), scramble=True, seed=1).draw(CANDIDATES).double()
    low, high = (torch.tensor([getattr(p, name) for p in PARAMETERS]).double().log() for name in ("low", "high"))
    values = (low + share * (high - low)).exp()
    for column, parameter in enumerate(PARAMETERS):
        getattr(sim.params, parameter.name)[...] = values[:, column : column + 1].to(sim.node_x)
    loss = torch.zeros(CANDIDATES, dtype=torch.float64)
    for place in range(HORIZONS[-1] // EVERY):
        sim.step(EVERY)
        loss += (sim.node_x.double() - shown[:, place]).square().sum(dim=(1, 2))
    best = loss.argsort()[:FOLLOWED].tolist()
    return [
        [replace(each, start=float(value)) for each, value in zip(PARAMETERS, values[world], strict=True)]
        for world in best
    ]


def find_ball(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Modulus and Poisson's ratio from the motion, with and without gradients, a record for every way."""
    steps, kept = HORIZONS[-1], HORIZONS[-1] // EVERY
    sim, many = ball(1, args.precision, args.cores), ball(5, args.precision, args.cores)
    rollout, worlds, start = Rollout(sim), Worlds(many, PARAMETERS), many.snapshot()

    def motion(values: torch.Tensor, steps: int = steps) -> torch.Tensor:
        parameters = {"youngs": values[:, :1], "nu": values[:, 1:]}
        found = rollout(parameters=parameters, steps=steps, factors=True).node_x
        return found[EVERY - 1 :: EVERY].movedim(1, 0).double()

    with torch.no_grad():
        shown = motion(torch.tensor([list(TRUE.values())]))
        first = motion(torch.tensor([[p.start for p in PARAMETERS]]))
    scale = float(torch.sqrt(2.0 * BALL_START / (first - shown).square().sum()))

    def residuals(values: Floats) -> Floats:
        many.restore(start)
        worlds.write(values)
        found = []
        for _ in range(kept):
            many.step(EVERY)
            found.append(many.node_x.double().numpy().copy())
        return worlds.gather(scale * (np.stack(found, axis=1) - shown.numpy()))

    def beginning(steps: int) -> Differentiable:
        return Differentiable(lambda values: scale * (motion(values, steps) - shown[:, : steps // EVERY]))

    begin, starts, evaluations = time.perf_counter(), PARAMETERS, 0
    for horizon in HORIZONS:
        found = fit(starts, beginning(horizon), tolerance=1e-5, max_iterations=args.iterations, method="gradient")
        starts = [replace(each, start=found.values[each.name]) for each in PARAMETERS]
        evaluations += found.evaluations
    record = {"case": "ball", "way": "lengthening", "loss_start": BALL_START, "evaluations": evaluations}
    loss = 0.5 * float(np.sum(found.residuals**2))
    yield record | {"loss": loss, "seconds": time.perf_counter() - begin} | found.values

    begin, evaluations = time.perf_counter(), CANDIDATES
    fits = [
        fit(starts, beginning(steps), tolerance=1e-5, max_iterations=args.iterations, method="gradient")
        for starts in survey(args, shown)
    ]
    evaluations += sum(each.evaluations for each in fits)
    found = min(fits, key=lambda each: float(np.sum(each.residuals**2)))
    record = {"case": "ball", "way": "survey", "loss_start": BALL_START, "evaluations": evaluations}
    loss = 0.5 * float(np.sum(found.residuals**2))
    yield record | {"loss": loss, "seconds": time.perf_counter() - begin} | found.values

    model = beginning(steps)
    ways: dict[str, tuple[Any, dict[str, Any]]] = {
        "gradient": (model, {"method": "gradient"}),
        "differences": (residuals, {"batch": 5}),
        "evolution": (residuals, {"batch": 5, "method": "evolution", "generations": args.generations}),
    }
    for name, (given, options) in ways.items():
        if name == "evolution" and not args.generations:
            continue
        found = fit(PARAMETERS, given, tolerance=1e-5, max_iterations=args.iterations, **options)
        loss = 0.5 * float(np.sum(found.residuals**2))
        record = {"case": "ball", "way": name, "loss_start": BALL_START, "loss": loss, "seconds": found.seconds}
        yield record | {"evaluations": found.evaluations} | found.values


def main(arguments: Sequence[str] | None = None) -> int:
    """Search."""
    parser = argparse.ArgumentParser(
        prog="softwarp bench searches", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("case", nargs="*", default=list(BEFORE), metavar="CASE", help=f"of {', '.join(BEFORE)}")
    parser.add_argument("--precision", default="float32", choices=["float32", "float64"])
    parser.add_argument("--cores", type=int, help="cores to run on")
    parser.add_argument("--iterations", type=int, default=200, help="of Adam, and of fits at most")
    parser.add_argument("--starts", type=int, default=8, help="of the routing")
    parser.add_argument("--cells", type=int, nargs=3, default=(4, 4, 32), help="of its beam")
    parser.add_argument("--generations", type=int, default=20, help="of the evolution; 0 leaves it out")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers here")
    args = parser.parse_args(arguments)
    cases: dict[str, Callable[[], Iterable[dict[str, Any]]]] = {
        "routing": lambda: [routing(args)],
        "ball": lambda: find_ball(args),
    }
    for case in args.case:
        if case not in cases:
            raise ValueError(f"there is no case {case!r}; there are {', '.join(cases)}")
    records = []
    with limited_cores(args.cores) as cores:
        for case in args.case:
            for found in cases[case]():
                records.append(machine("cpu", cores) | {"precision": args.precision} | found)
                told = [f"{key} {value:.4g}" for key, value in found.items() if isinstance(value, (int, float))]
                print(f"{case} {found.get('way', '')}: {', '.join(told)}; published loss {BEFORE[case]}", flush=True)
                save(records, args.json)
    return 0
