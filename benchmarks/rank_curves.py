"""Learning curves against wall clock of one training on 1, 2, ... ranks: the same worlds in all, divided among them.

    softwarp bench rank_curves runs/curves --device cuda                       # Trunk, 1024 worlds on 1, 2, 4 GPUs
    softwarp bench rank_curves runs/curves --ranks 1 2 --worlds 32 --set env=cart_stem total_steps=60_000
    softwarp bench rank_curves runs/curves --report-only --picture curves.png  # draw what there is

Every run is a ``softwarp train`` of its own in ``FOLDER/ranks_<n>/seed_<k>``, with the same settings and budget of
environment steps: N ranks have ``--worlds`` / N worlds each, so that every update is made of as many transitions, and
what differs is the time that it takes. That is strong scaling: the parts become small, and the time that a step takes
whatever its number of worlds stays. Where a machine has room, runs of several seeds stand side by side, each on GPUs of
its own. ``seconds`` are those of the run's own tables: training and evaluation, compiling left out.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from softwarp import processes
from softwarp.io.atomic import atomic_path, write_text
from softwarp.training.logs import read_csv

from .timing import machine

SETTINGS = ("env=trunk", "algo=ppo", "algo.minibatches=16", "total_steps=1_600_000", "evaluations=8")
KEPT = ("logger=csv", "logger.picture=false", "evaluate_start=true", "keep_checkpoints=1")
KEYS = ("seconds", "steps", "return", "success", "distance")  # of an evaluation, as far as there are
TAIL = 3  # evaluations at the end that make the final quality: single ones are noisy


def main(arguments: Sequence[str]) -> int:
    """Train what is not there yet; print and record the curves."""
    parser = argparse.ArgumentParser(
        prog="softwarp bench rank_curves", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--ranks", type=int, nargs="+", help="numbers of them; 1, 2, 4 as far as there is room")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--worlds", type=int, default=1024, help="of all ranks together")
    parser.add_argument("--seeds", type=int, default=1, help="how many, 0, 1, ...")
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="settings as for softwarp train")
    parser.add_argument("--report-only", action="store_true", help="train nothing")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the curves there")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw the curves there")
    args = parser.parse_args(arguments)
    most = torch.cuda.device_count() if args.device.startswith("cuda") else len(os.sched_getaffinity(0))
    counts = args.ranks or [count for count in (1, 2, 4) if count <= most]
    for count in counts:
        if args.worlds % count:
            parser.error(f"--worlds {args.worlds} cannot be divided among {count} ranks")
        if args.device.startswith("cuda") and count > most:
            parser.error(f"--ranks {count}: this machine has {most} GPUs")
        if not args.report_only:
            train(args, count, most)
    records = [record_of(args.folder, count, args.worlds) for count in counts]
    text = json.dumps({"machine": machine(args.device), "settings": told(args), "curves": records}, indent=1)
    if args.json is not None:
        write_text(args.json, text + "\n")
    if args.picture is not None:
        draw(records, args.picture)
    print("\n".join(sentence(record, records[0]) for record in records))
    return 0


def told(args: argparse.Namespace) -> list[str]:
    """Settings of all runs."""
    given = {text.partition("=")[0] for text in args.set}
    return [*(text for text in SETTINGS if text.partition("=")[0] not in given), *args.set]


def train(args: argparse.Namespace, count: int, most: int) -> None:
    """The runs of a number of ranks, as many side by side as there are GPUs for; on a CPU one after the other.

    Raises:
        ChildProcessError: If one fails; what it printed is in ``train.log`` of its folder.
    """
    is_cuda = args.device.startswith("cuda")
    waiting = [seed for seed in range(args.seeds) if not is_done(folder_of(args.folder, count, seed))]
    room = max(1, most // count) if is_cuda else 1
    while waiting:
        begun = []
        for place, seed in enumerate(waiting[:room]):
            folder = folder_of(args.folder, count, seed)
            folder.mkdir(parents=True, exist_ok=True)
            shares = [f"num_worlds={args.worlds // count}", f"distributed.ranks={count}"]
            command = ["train", *told(args), *KEPT, *shares, f"device={args.device}", f"seed={seed}", f"out={folder}"]
            environment = dict(os.environ)
            if is_cuda:
                gpus = os.environ.get("CUDA_VISIBLE_DEVICES", ",".join(map(str, range(most)))).split(",")
                environment["CUDA_VISIBLE_DEVICES"] = ",".join(gpus[place * count : (place + 1) * count])
            with (folder / "train.log").open("ab") as log:
                options = processes.child_options(environment)
                words = [sys.executable, "-m", "softwarp", *command]
                begun.append((folder, subprocess.Popen(words, stdout=log, stderr=subprocess.STDOUT, **options)))
        for folder, process in begun:
            if process.wait():
                raise ChildProcessError(f"{folder}: the run ended with code {process.returncode}, see train.log there")
        waiting = waiting[room:]


def folder_of(root: Path, count: int, seed: int) -> Path:
    """Run folder."""
    return root / f"ranks_{count}" / f"seed_{seed}"


def is_done(folder: Path) -> bool:
    """Whether a run has told its end."""
    log = folder / "train.log"
    return log.is_file() and "run folder:" in log.read_text(encoding="utf-8")


def record_of(root: Path, count: int, worlds: int) -> dict[str, Any]:
    """Curves of all seeds of a number of ranks, and what they end with."""
    runs = []
    for folder in sorted((root / f"ranks_{count}").glob("seed_*")):
        rows = read_csv(folder / "evaluation.csv", ("steps", "seconds", "return", "success"))
        if rows:
            runs.append((rows, read_csv(folder / "progress.csv", ("seconds", "steps_per_second"))))
    if not runs:
        raise ValueError(f"{root}: no run of {count} ranks has been evaluated; run without --report-only first")
    curves = [{key: [row[key] for row in rows] for key in KEYS if key in rows[0]} for rows, _ in runs]
    keys = [key for key in KEYS[2:] if key in curves[0]]
    return {
        "ranks": count,
        "worlds_of_a_rank": worlds // count,
        "steps_per_second": [float(np.median([row["steps_per_second"] for row in rows])) for _, rows in runs],
        "seconds": [curve["seconds"][-1] for curve in curves],
        "steps": [curve["steps"][-1] for curve in curves],
        "final": {key: [final(curve[key]) for curve in curves] for key in keys},
        "runs": curves,
    }


def final(values: Sequence[float]) -> float:
    """Mean of the last evaluations, that of the untrained policy left out."""
    return float(np.mean(values[1:][-TAIL:] or values))


def sentence(record: dict[str, Any], base: dict[str, Any]) -> str:
    """A record in a line."""
    faster = np.mean(record["steps_per_second"]) / np.mean(base["steps_per_second"])
    quality = ", ".join(f"{key} {np.mean(values):.4g}" for key, values in record["final"].items())
    took = f"{np.mean(record['seconds']):.0f} s for {np.mean(record['steps']):,.0f} steps"
    return (
        f"{record['ranks']} x {record['worlds_of_a_rank']} worlds: {np.mean(record['steps_per_second']):,.0f} "
        f"env-steps/s ({faster:.2f} times the first), {took}; at the end {quality}"
    )


def draw(records: list[dict[str, Any]], path: Path) -> None:
    """Success, and the distance where there is one, against seconds: a line per run, a colour per number of ranks."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = {"success": "success", "distance": "median final distance [m]"}
    panels = {key: label for key, label in panels.items() if key in records[0]["runs"][0]} | {"return": "return"}
    figure = Figure(figsize=(4.2 * len(panels), 3.3), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (key, label) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True):
        for colour, record in enumerate(records):
            for k, run in enumerate(record["runs"]):
                name = f"{record['ranks']} x {record['worlds_of_a_rank']} worlds" if k == 0 else None
                axes.plot(run["seconds"], run[key], color=f"C{colour}", marker="o", markersize=3, label=name)
        axes.set(xlabel="wall clock [s]", ylabel=label)
        axes.grid(alpha=0.3)
        if key == "distance":
            axes.set_yscale("log")
        axes.legend(fontsize="small")
    with atomic_path(path) as scratch:
        figure.savefig(scratch, dpi=150)
