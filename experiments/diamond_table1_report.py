"""Table and picture of ``experiments.diamond_table1``."""

import csv
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from softwarp.io.atomic import atomic_path, write_text

PAPER = {"QP": (13.24, 3.93), "OPD": (3.13, 38.24)}  # SofaGym's table 1: mean error [mm], mean time [s]
OTHER_SCENE = "OPD/SofaGym"  # whose cables also push, so that it reaches more
PAPER[OTHER_SCENE] = PAPER["OPD"]
LEFT_OUT = ("count", "control time [s]", "SofaGym: error [mm]", "SofaGym: time [s]")  # of the table on a page
REACHED = 0.5  # mm
COLUMNS = (
    *("method", "targets", "count", "mean error [mm]", "worst error [mm]", "within 0.5 mm [%]", "mean excess [mm]"),
    *("told [%]", "time [s]", "processor time [s]", "control time [s]", "robot time [s]", "model steps"),
    *("SofaGym: error [mm]", "SofaGym: time [s]"),
)
_DRAWN = 1e-6  # m, least error that the picture tells from none
SHOWN = ("QP", "OPD")  # whose ends the picture shows in space


@dataclass(frozen=True, kw_only=True)
class Trial:
    """A method's way to one target.

    Attributes:
        target, end: Where the top was to come, and where it was at the end [m].
        error: Their distance [m].
        seconds: Computing time, the simulation of the robot itself included.
        processor_seconds: The same as the processor counts it; other work on the machine does not lengthen it.
        control_seconds: Part of ``seconds`` for decisions.
        simulated_seconds: Time that passed for the robot.
        outcome: What the method says of its target, "" if it does not.
        model_steps: Actions that a planner tried.
        least: Least distance [m] that long inverse control found; 0 for reachable targets, and where it is not known.
    """

    target: list[float]
    end: list[float]
    error: float
    seconds: float
    processor_seconds: float
    control_seconds: float
    simulated_seconds: float
    outcome: str
    model_steps: int = 0
    method: str = ""
    is_reachable: bool = True
    least: float = 0.0


def rows(trials: list[Trial]) -> list[dict[str, Any]]:
    """One row for each method and kind of target, in the order of the trials; keys are ``COLUMNS``."""
    kinds = list(dict.fromkeys((trial.method, trial.is_reachable) for trial in trials))
    return [_row([trial for trial in trials if (trial.method, trial.is_reachable) == kind]) for kind in kinds]


def _row(trials: list[Trial]) -> dict[str, Any]:
    first = trials[0]
    error = 1e3 * np.array([trial.error for trial in trials])
    excess = error - 1e3 * np.array([trial.least for trial in trials])
    right = "REACHED" if first.is_reachable else "UNREACHABLE"
    tells = any(trial.outcome == right for trial in trials)
    paper = PAPER.get(first.method, ("", ""))

    def mean(name: str) -> float:
        return float(np.mean([getattr(trial, name) for trial in trials]))

    values = (
        first.method,
        "reachable" if first.is_reachable else "unreachable",
        len(trials),
        float(error.mean()),
        float(error.max()),
        100.0 * float((error < REACHED).mean()) if first.is_reachable else "",
        float(excess.mean()) if any(trial.least for trial in trials) else "",
        100.0 * float(np.mean([trial.outcome == right for trial in trials])) if tells else "",
        *(mean(name) for name in ("seconds", "processor_seconds", "control_seconds", "simulated_seconds")),
        round(mean("model_steps")) or "",
        *paper,
    )
    return dict(zip(COLUMNS, values, strict=True))


def cell(value: Any) -> str:
    """A value as text, small ones with one digit that counts."""
    if not isinstance(value, float):
        return str(value)
    return f"{value:.1g}" if 0.0 < abs(value) < 0.05 else f"{value:.3g}" if abs(value) >= 100.0 else f"{value:.2f}"


def markdown(table: list[dict[str, Any]]) -> str:
    """The table for a page, with fewer columns."""
    told = [name for name in COLUMNS if name not in LEFT_OUT]
    lines = ["| " + " | ".join([*told, "SofaGym"]) + " |", "|" + "---|" * (len(told) + 1)]
    for row in table:
        paper = "{} mm, {} s".format(*PAPER[row["method"]]) if row["method"] in PAPER else ""
        lines.append("| " + " | ".join([*(cell(row[name]) for name in told), paper]) + " |")
    return "\n".join(lines) + "\n"


def write_report(folder: Path, trials: list[Trial], mesh: str) -> str:
    """Write ``table.csv``, ``table.md``, ``table1.json`` and ``table1.png``; returns the table as text."""
    table = rows(trials)
    with atomic_path(folder / "table.csv") as scratch, scratch.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(table)
    text = markdown(table)
    write_text(folder / "table.md", text)
    told = {"mesh": mesh, "rows": table, "trials": [asdict(trial) for trial in trials]}
    write_text(folder / "table1.json", json.dumps(told, indent=1) + "\n")
    with atomic_path(folder / "table1.png") as scratch:
        draw(scratch, trials)
    return text


def draw(file: Path, trials: list[Trial]) -> None:
    """Targets in space with the ends of two methods, and the errors of all."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure = plt.figure(figsize=(11.0, 4.6), layout="constrained")
    space = figure.add_subplot(1, 2, 1, projection="3d")
    names = list(dict.fromkeys(trial.method for trial in trials))
    colours = {name: f"C{index}" for index, name in enumerate(names)}
    for is_reachable, mark, label in ((True, "o", "reachable target"), (False, "^", "unreachable target")):
        some = [trial.target for trial in trials if trial.method == names[0] and trial.is_reachable == is_reachable]
        if some:
            space.scatter(*(1e3 * np.array(some)).T, marker=mark, color="0.3", s=18, label=label)
    for name in [name for name in names if name in SHOWN]:
        for index, trial in enumerate(trial for trial in trials if trial.method == name):
            line = 1e3 * np.array([trial.target, trial.end])
            space.plot(
                *line.T, color=colours[name], linewidth=1.2, label=f"to the end of {name}" if not index else None
            )
    space.set(xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]")
    space.legend(fontsize=8)
    errors = figure.add_subplot(1, 2, 2)
    for index, name in enumerate(names):
        for is_reachable, mark, shift in ((True, "o", -0.12), (False, "^", 0.12)):
            own = [trial for trial in trials if trial.method == name and trial.is_reachable == is_reachable]
            beyond = [1e3 * max(trial.error - trial.least, _DRAWN) for trial in own]
            errors.scatter([index + shift] * len(beyond), beyond, marker=mark, color=colours[name], s=18, alpha=0.7)
        if name in PAPER:
            errors.hlines(PAPER[name][0], index - 0.3, index + 0.3, color=colours[name], linestyle="--")
    errors.set_yscale("log")
    errors.set_xticks(range(len(names)), names)
    errors.set_ylabel("error beyond the least known [mm]; dashed: paper")
    errors.grid(alpha=0.3, axis="y")
    figure.savefig(file, dpi=80)
    plt.close(figure)
