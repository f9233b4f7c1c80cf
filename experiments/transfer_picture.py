"""Plan and replay side by side: the ball's two paths in the maze, and the servo angles that make the second."""

from __future__ import annotations

from typing import Any

import numpy as np

from softwarp.io.atomic import atomic_path

from .transfer_replays import Transfer

PLANNED, REPLAYED, OTHERS = "#1f5fa8", "#c8501e", "#b9b9b9"
MILLI = 1.0e3


def draw(result: Transfer, path: str) -> None:
    """Write the picture.

    Args:
        result: A transfer; places of three coordinates are shown by the two that vary most.
        path: File, whose ending chooses the format.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    planned, replayed = MILLI * result.trace.places, MILLI * result.nominal.places[:, 0]
    shown = np.sort(np.argsort(np.ptp(planned, axis=0))[-2:])
    figure, (left, middle, right) = pyplot.subplots(1, 3, figsize=(13.5, 4.6), width_ratios=(1.0, 1.0, 1.15))
    for axes, title in ((left, "plan"), (middle, "replay on the tripod" if _is_maze(result) else "replay")):
        axes.set_title(title)
        axes.set_aspect("equal")
        axes.set_xlabel(f"{'xyz'[shown[0]]} [mm]")
        _walls(axes, result)
    left.set_ylabel(f"{'xyz'[shown[1]]} [mm]")
    left.plot(*planned[:, shown].T, color=PLANNED, linewidth=1.6)
    if "open" in result.replays:
        for world in range(min(16, result.replays["open"].places.shape[1])):
            middle.plot(*(MILLI * result.replays["open"].places[:, world, shown]).T, color=OTHERS, linewidth=0.6)
    middle.plot(*planned[:, shown].T, color=PLANNED, linewidth=0.9)
    middle.plot(*replayed[: len(planned), shown].T, color=REPLAYED, linewidth=1.6)
    goal = result.trace.options.get("goal_place")
    for axes in (left, middle):
        axes.plot(*planned[0, shown], marker="o", color="black", markersize=4)
        if goal is not None:
            axes.plot(MILLI * goal[0], MILLI * goal[1], marker="*", color="#2e8b2e", markersize=12)
    file = result.file
    right.plot(file.times, file.values, linewidth=1.4)
    right.legend(file.names, fontsize="small")
    right.set_title("commands")
    right.set_xlabel("time [s]")
    right.set_ylabel(f"[{file.channels[0].unit}]")
    figure.tight_layout()
    with atomic_path(path) as scratch:
        figure.savefig(scratch, dpi=110)
    pyplot.close(figure)


def _is_maze(result: Transfer) -> bool:
    return "maze" in result.trace.options


def _walls(axes: Any, result: Transfer) -> None:
    """Walls of the maze from above, where there is one."""
    if not _is_maze(result):
        return
    from matplotlib.collections import PolyCollection

    from softwarp.envs.options.simple_maze import SimpleMazeConfig

    names = SimpleMazeConfig.__dataclass_fields__
    maze = SimpleMazeConfig(**{k: v for k, v in result.trace.options.items() if k in names}).make_maze(0)
    surface = maze.surface()
    corners = surface.nodes[surface.triangles]
    tops = corners[(corners[:, :, 2] > 0.5 * maze.height).all(axis=1)]
    axes.add_collection(PolyCollection(MILLI * tops[:, :, :2], facecolor="#8a8f98", edgecolor="none"))
    x, y = (0.5 * MILLI * extent for extent in maze.size[:2])
    axes.set_xlim(-x, x)
    axes.set_ylim(-y, y)
