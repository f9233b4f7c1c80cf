"""How far every element is from the right answer, by unknowns and by time; writes ``docs/accuracy.md``.

    softwarp bench accuracy                       # measure all, a quarter of an hour, then pictures and page
    softwarp bench accuracy --filter cook         # measure some again, keep the other records
    softwarp bench accuracy --page                # pictures and page from the records that there are

One world on one core. The static solve is in float64 and starts from rest; the step of 10 ms is in float32, timed while
the solid swings. Times are medians of processor time, which other programs on the machine change little.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import softwarp

from . import accuracy_page
from .solids import ROOT, Cells, Problem, problems, sagging, test_scenes
from .timing import limited_cores, machine, save

RESULTS = Path(__file__).resolve().parent / "results" / "accuracy" / "solids.json"
Record = dict[str, Any]
STEPS, FINE = (2e-3, 1e-3, 5e-4, 2.5e-4), 3.125e-5  # s


def main(arguments: Sequence[str]) -> int:
    """Measure what is asked for, then write the page."""
    parser = argparse.ArgumentParser(
        prog="softwarp bench accuracy", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--filter", default="", metavar="TEXT", help="only problems that have TEXT in their name")
    parser.add_argument("--page", action="store_true", help="measure nothing")
    parser.add_argument("--json", type=Path, default=RESULTS, metavar="FILE", help="records")
    parser.add_argument("--docs", type=Path, default=ROOT / "docs", metavar="FOLDER", help="for the page and pictures")
    args = parser.parse_args(arguments)
    records = json.loads(args.json.read_text(encoding="utf-8")) if args.json.is_file() else []
    known = problems()
    choices = [*(problem.name for problem in known), *ORDERS]
    names = [name for name in choices if args.filter in name]
    if not names:
        raise ValueError(f"no problem matches {args.filter!r}; there are {', '.join(choices)}")
    for name in [] if args.page else names:
        with limited_cores(1):
            found = ORDERS[name]() if name in ORDERS else measure_problem(next(p for p in known if p.name == name))
        records = [record for record in records if record["problem"] != name] + found
        save(records, args.json)
    accuracy_page.write(known, records, args.docs)
    return 0


def measure_problem(problem: Problem) -> list[Record]:
    """One record per element and mesh."""
    records = [measure_solid(problem, element, cells) for element, meshes in problem.cells.items() for cells in meshes]
    if problem.name == "cantilever":
        records.insert(0, measure_solid(problem, "p1", (20, 4, 4), graded=False))
    return records


def measure_solid(problem: Problem, element: str, cells: Cells, **choice: Any) -> Record:
    """Answer, error, unknowns and times of one mesh."""
    solid = problem.build(element, cells, **choice)
    model = solid.sim.model
    record: Record = {"problem": problem.name, "element": element, "cells": cells, **choice}
    record |= {"unknowns": int(np.asarray(model.dof_free.numpy()).sum()), "blocks": model.symbolic.block_count}
    record |= {"mflop": model.symbolic.flops / 1e6, "converged": solid.settle()}
    record |= {"value": solid.value(), "error": solid.value() / problem.exact - 1.0}
    record |= {"static_s": _median(solid.settle, 5, 5.0)}
    swinging = problem.build(element, cells, precision="float32", dt=0.01, newton_iterations=1, **choice).sim
    swinging.step(3)
    record |= {"ms_per_step": 1e3 * _median(swinging.step, 30, 3.0)} | machine("cpu", 1)
    print(
        f"{problem.name} {element} {cells}: {record['unknowns']} unknowns, {record['value']:.4f} {problem.unit}, "
        f"{100 * record['error']:.2f} %, static {record['static_s']:.2f} s, step {record['ms_per_step']:.2f} ms",
        flush=True,
    )
    return record


def _median(run: Callable[[], object], most: int, budget: float) -> float:
    """Median processor time [s] of up to ``most`` runs that start within a budget [s]; other programs do not count."""
    samples: list[float] = []
    while len(samples) < most and sum(samples) < budget:
        start = time.process_time()
        run()
        samples.append(time.process_time() - start)
    return statistics.median(samples)


def orders_in_h() -> list[Record]:
    """Errors of displacement and gradient of the manufactured solution."""
    scenes, _ = test_scenes()
    records = []
    for element, counts in (("p1", (4, 8, 16)), ("p2", (2, 4, 8))):
        for n in counts:
            errors = scenes.manufactured_errors(element, n)
            found = [float(error) for error in errors]
            records.append({"problem": "orders_space", "element": element, "cells": n, "errors": found})
            print(records[-1], flush=True)
    return records


def orders_in_dt() -> list[Record]:
    """Error of the cantilever's shape 0.08 s after it was let go, against much shorter steps, by length of the step."""
    records = []
    for iterations in (1, 8):
        shapes: dict[float, np.ndarray] = {}
        for dt in (*STEPS, FINE):
            options = {"dt": dt, "newton_iterations": iterations}
            sim: softwarp.Simulation = sagging("p2", (6, 1, 1), **options).sim
            sim.step(round(0.08 / dt))
            shapes[dt] = sim.node_x[0].double().numpy().copy()
        fine = shapes.pop(FINE)
        for dt, shape in shapes.items():
            error = float(np.abs(shape - fine).max())
            records.append({"problem": "orders_time", "iterations": iterations, "dt": dt, "fine": FINE, "error": error})
            print(records[-1], flush=True)
    return records


ORDERS = {"orders_space": orders_in_h, "orders_time": orders_in_dt}
