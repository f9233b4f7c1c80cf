"""Learning curves and table of ``softwarp baselines``, from the evaluation tables of its runs.

Curves are means over seeds of the return of the test episodes, with 95 % bootstrap intervals. A run has reached 90 % of
the best when its return has come 90 % of the way from the untrained policy's (not a cloned one's) to the highest mean
return of any algorithm on the task.
"""

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp.io.atomic import atomic_path, write_text
from softwarp.training.logs import read_csv

Array = NDArray[np.float64]
POINTS = 101  # of the common axis of environment steps
RESAMPLES = 2000
REACHED = 0.9  # of the way from the untrained to the best
PAPER = {
    ("cartstem", "ppo"): "solved (return 80), 18 h for 6 seeds",
    ("cartstem", "ppo_avec"): "solved (return 80), 6 h for 6 seeds",
    ("cartstemcontact", "ppo"): "oscillates, does not solve",
    ("cartstemcontact", "sac"): "best of the four",
    ("cartstemcontact", "sac_avec"): "1.5 below SAC",
    ("catchtheobject", "ppo"): "about -3",
    ("catchtheobject", "sac"): "about -3",
    ("catchtheobject", "ppo_avec"): "about -3",
    ("catchtheobject", "sac_avec"): "about -4, still rising",
    **{(task, name): "about 190, discounted" for task in ("gripper", "gripper_pull") for name in ("ppo", "ppo_lstm")},
}
PAPER_TIMES = "SofaGym needed about 19 h for all of CartStemContact and 23 h for all of CatchTheObject, on 40 cores."
COLUMNS = ("task", "algorithm", "seeds", "steps", "final return", "low", "high", "success", "steps to 90 %")
COLUMNS += ("reached", "minutes per seed", "SofaGym")
Runs = dict[tuple[str, str], list[Path]]


@dataclass(frozen=True)
class Curves:
    """Evaluations of one algorithm on one task, on a common axis."""

    steps: Array  # (point,)
    returns: Array  # (seed, point)
    success: Array  # (seed,) at the end
    seconds: Array  # (seed,) of training, evaluations included

    @property
    def mean(self) -> Array:
        """Mean over seeds, (point,)."""
        mean: Array = self.returns.mean(axis=0)
        return mean


def load_curves(folders: list[Path]) -> Curves | None:
    """Curves of the runs that have been evaluated at least twice; None if there is none.

    Runs of different length are cut to the shortest.
    """
    needed = ("steps", "return", "success", "seconds")
    tables = [rows for folder in folders if len(rows := read_csv(folder / "evaluation.csv", needed)) >= 2]
    if not tables:
        return None
    end = min(rows[-1]["steps"] for rows in tables)
    steps = np.linspace(0.0, end, POINTS)
    returns = [np.interp(steps, [row["steps"] for row in rows], [row["return"] for row in rows]) for rows in tables]
    last = [rows[-1] for rows in tables]
    success, seconds = (np.array([row[name] for row in last]) for name in ("success", "seconds"))
    return Curves(steps, np.array(returns), success, seconds)


def bootstrap(samples: Array, *, seed: int = 0) -> tuple[Array, Array]:
    """95 % interval of the mean over the first axis, by drawing seeds again and again."""
    rng = np.random.default_rng(seed)
    drawn = rng.integers(len(samples), size=(RESAMPLES, len(samples)))
    low, high = np.quantile(samples[drawn].mean(axis=1), [0.025, 0.975], axis=0)
    return low, high


def steps_to(curves: Curves, start: float, best: float) -> Array:
    """First step at which each seed has come 90 % of the way from ``start`` to ``best``; inf where it never has."""
    goal = start + REACHED * (best - start)
    hits = curves.returns >= goal
    return np.where(hits.any(axis=1), curves.steps[hits.argmax(axis=1)], np.inf)


def rows_of(runs: Runs) -> tuple[list[dict[str, Any]], dict[tuple[str, str], Curves]]:
    """Rows of the table, and the curves."""
    curves = {key: found for key, folders in runs.items() if (found := load_curves(folders)) is not None}
    rows = []
    for (task, algorithm), here in curves.items():
        peers = [other for (name, _), other in curves.items() if name == task]
        fresh = [found for (name, kind), found in curves.items() if name == task and not kind.endswith("cloned")]
        start = float(np.mean([other.mean[0] for other in fresh or peers]))
        best = max(float(other.mean.max()) for other in peers)
        tail = here.returns[:, -POINTS // 10 :].mean(axis=1)  # the last tenth: single evaluations are noisy
        low, high = bootstrap(tail[:, None])
        reached = steps_to(here, start, best)
        values = (
            *(task, algorithm, len(tail), int(here.steps[-1]), float(tail.mean()), float(low[0]), float(high[0])),
            *(float(here.success.mean()), float(np.median(reached)), int(np.isfinite(reached).sum())),
            *(float(here.seconds.mean()) / 60.0, PAPER.get((task, algorithm), "")),
        )
        rows.append(dict(zip(COLUMNS, values, strict=True)))
    return rows, curves


def write_report(folder: Path, runs: Runs) -> str:
    """Write ``curves.csv``, ``curves.png``, ``table.csv`` and ``table.md``; returns the table as text."""
    rows, curves = rows_of(runs)
    if not rows:
        return f"{folder}: no run has been evaluated yet"
    with atomic_path(folder / "curves.csv") as scratch, scratch.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("task", "algorithm", "steps", "return", "low", "high", "seeds"))
        for (task, algorithm), here in curves.items():
            low, high = bootstrap(here.returns)
            for point in zip(here.steps, here.mean, low, high, strict=True):
                writer.writerow((task, algorithm, *(f"{number:.9g}" for number in point), len(here.returns)))
    with atomic_path(folder / "table.csv") as scratch, scratch.open("w", newline="") as file:
        table = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
    text = markdown(rows)
    write_text(folder / "table.md", text)
    draw(curves, folder / "curves.png")
    return text


def markdown(rows: list[dict[str, Any]]) -> str:
    """The table for a reader."""
    lines = [
        "| task | algorithm | seeds | final return (95 %) | success | steps to 90 % of the best | minutes | SofaGym |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        steps, success = row["steps to 90 %"], 100.0 * row["success"]
        told = f"{steps:,.0f}" if np.isfinite(steps) else "not reached"
        lines.append(
            f"| {row['task']} | {row['algorithm']} | {row['seeds']} "
            f"| {row['final return']:.2f} ({row['low']:.2f} to {row['high']:.2f}) | {success:.0f} % "
            f"| {told} ({row['reached']} of {row['seeds']}) | {row['minutes per seed']:.1f} | {row['SofaGym']} |"
        )
    told = [PAPER_TIMES, ""] if any(row["task"] in ("cartstemcontact", "catchtheobject") for row in rows) else []
    return "\n".join([*lines, "", *told])


def draw(curves: dict[tuple[str, str], Curves], path: Path) -> None:
    """A panel per task, a line per algorithm, its interval as a band."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter

    tasks = list(dict.fromkeys(task for task, _ in curves))
    colours = {name: f"C{i}" for i, name in enumerate(sorted({algorithm for _, algorithm in curves}))}
    figure = Figure(figsize=(4.4 * len(tasks), 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    panels = dict(zip(tasks, figure.subplots(1, len(tasks), squeeze=False)[0], strict=True))
    for (task, algorithm), here in curves.items():
        low, high = bootstrap(here.returns)
        label = f"{algorithm.upper().replace('_', '-')} ({len(here.returns)})"
        panels[task].plot(here.steps, here.mean, color=colours[algorithm], label=label)
        panels[task].fill_between(here.steps, low, high, color=colours[algorithm], alpha=0.2, linewidth=0)
    for task, panel in panels.items():
        panel.set(title=task, xlabel="environment steps", ylabel="return of test episodes")
        panel.xaxis.set_major_formatter(EngFormatter(sep=""))
        panel.grid(alpha=0.3)
        panel.legend(fontsize="small")
    with atomic_path(path) as scratch:
        figure.savefig(scratch, dpi=150)
