"""The learning curve of a run as a picture, drawn from its tables."""

from pathlib import Path
from typing import Any

from softwarp.io.atomic import atomic_path
from softwarp.training.logs import read_csv

Rows = list[dict[str, float]]


def draw_learning_curve(folder: Path, path: Path) -> None:
    """Draw return, success and final distance against environment steps.

    Args:
        folder: Run folder with ``progress.csv`` and, if there was one, ``evaluation.csv``.
        path: Picture to write, for example ``curve.png``.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter, MaxNLocator

    progress, evaluation = read_csv(folder / "progress.csv"), read_csv(folder / "evaluation.csv")
    panels = [("return", "return per episode", 1.0), ("success", "success [%]", 100.0)]
    if any("distance" in row for row in progress + evaluation):
        panels.append(("distance", "final distance [mm]", 1e3))
    figure = Figure(figsize=(4.0 * len(panels), 3.2), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (key, label, factor) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        _draw_panel(axes, progress, evaluation, key, factor)
        axes.set(xlabel="environment steps", ylabel=label)
        axes.set_ylim(bottom=0.0 if key == "distance" else None)
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small")
    figure.suptitle(folder.resolve().name, fontsize="medium")
    with atomic_path(path) as scratch:
        figure.savefig(scratch, dpi=150)


def _draw_panel(axes: Any, progress: Rows, evaluation: Rows, key: str, factor: float) -> None:
    """Training as a line, evaluations as points; for distances the middle half as a band."""
    told = [row for row in progress if key in row]
    axes.plot([row["steps"] for row in told], [factor * row[key] for row in told], color="0.6", label="training")
    seen = [row for row in evaluation if key in row]
    steps = [row["steps"] for row in seen]
    axes.plot(steps, [factor * row[key] for row in seen], "o-", color="C0", markersize=4, label="held-out goals")
    if key == "distance":
        low, high = ([factor * row[f"distance_{name}"] for row in seen] for name in ("p25", "p75"))
        axes.fill_between(steps, low, high, color="C0", alpha=0.2, label="quartiles")
