"""Pictures of plans: the search tree or the progress of a planner of sequences, and the way to the goal."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from softwarp.io.atomic import atomic_path
from softwarp.planning.plans import Plan

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SIZE = (11.0, 4.2)  # inch
_PLAN = "#d1495b"
_MUTED = "#8d99ae"


def draw(plan: Plan, path: str | os.PathLike[str]) -> None:
    """Write a picture of a plan, .png, .svg or .pdf.

    Left the tree, a line per node from its parent, coloured by the lower bound of its value (or, for planners of
    sequences, the values of the rounds), that of the first search if several were made on the way; right the distance
    to the goal along all branches and along the way.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=_SIZE, layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    if plan.tree is None:
        _draw_rounds(left, plan.history)
        searched = "values of the sampled sequences"
    else:
        _draw_tree(figure, left, plan.tree, int(plan.planner.get("hold", 1)))
        searched = f"tree of the first search, {plan.tree['nodes']:,} nodes"
    cost = f"{plan.cost['expansions']:.0f} expansions, {plan.cost['seconds']:.1f} s"
    left.set_title(f"{searched}: {cost}", fontsize=10)
    _draw_distance(right, plan)
    outcome = f"goal {'met' if plan.success else 'not met'} after {len(plan.steps)} steps"
    figure.suptitle(f"{plan.planner.get('name', 'planner')} on {plan.env['name']}: {outcome}", fontsize=11)
    with atomic_path(path) as scratch:
        figure.savefig(scratch, dpi=100)


def layout(parent: list[int]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Heights of nodes, shape (node,): leaves are evenly spaced, others stand in the middle of their children."""
    count = len(parent)
    children: list[list[int]] = [[] for _ in range(count)]
    for node, above in enumerate(parent):
        if above >= 0:
            children[above].append(node)
    height = np.zeros(count)
    leaves = 0
    stack = [0]
    order: list[int] = []
    while stack:
        node = stack.pop()
        order.append(node)
        if not children[node]:
            height[node], leaves = leaves, leaves + 1
        stack.extend(reversed(children[node]))
    for node in reversed(order):
        if children[node]:
            height[node] = 0.5 * (height[children[node][0]] + height[children[node][-1]])
    return height / max(leaves - 1, 1)


def steps_of(tree: dict[str, Any], hold: int, strides: list[int]) -> list[int]:
    """Environment steps from the root to each node; of the root's actions an equal part has each stride."""
    choices = max((max(tree["action"]) + 1) // len(strides), 1)
    steps = [0]
    for parent, action in zip(tree["parent"][1:], tree["action"][1:], strict=True):
        steps.append(steps[parent] + hold * strides[min(action // choices, len(strides) - 1)])
    return steps


def _draw_tree(figure: Any, axes: Axes, tree: dict[str, Any], hold: int) -> None:
    from matplotlib.collections import LineCollection
    from matplotlib.ticker import MaxNLocator

    height, depth = layout(tree["parent"]), np.array(tree["depth"])
    parent, value = np.array(tree["parent"]), np.array(tree["value"])
    nodes = np.flatnonzero(parent >= 0)
    places = np.stack((depth, height), axis=1)
    ends = np.stack((places[parent[nodes]], places[nodes]), axis=1)
    # Value per depth grows with depth: show how good a node is among its peers, its value over the best one there.
    best = np.zeros(depth.max() + 1)
    np.maximum.at(best, depth, value)
    share = value[nodes] / np.maximum(best[depth[nodes]], 1e-12)
    lines = LineCollection(list(ends), array=share, cmap="viridis", linewidths=_width(len(nodes)))
    lines.set_clim(0.0, 1.0)
    axes.add_collection(lines)
    line = [0, *tree["plan"]]
    axes.plot(depth[line], height[line], color=_PLAN, linewidth=1.6, label="plan")
    met = [node for node in nodes if tree["success"][node]]
    if met:
        axes.scatter(depth[met], height[met], s=14, color=_PLAN, zorder=3, label=f"goal met ({len(met)})")
    axes.autoscale()
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set(xlabel=f"actions of the plan ({hold} steps each)" if hold > 1 else "actions of the plan", yticks=[])
    figure.colorbar(lines, ax=axes, label="value / best at this depth", shrink=0.8)
    axes.legend(loc="upper left", fontsize=8)


def _width(count: int) -> float:
    return float(np.clip(60.0 / max(count, 1), 0.15, 1.2))


def _draw_rounds(axes: Axes, history: list[dict[str, float]]) -> None:
    from matplotlib.ticker import MaxNLocator

    rounds = np.arange(1, len(history) + 1)
    for name, label, color in (
        ("round_mean", "mean of the round", _MUTED),
        ("best", "best so far", _PLAN),
    ):
        axes.plot(rounds, [entry[name] for entry in history], marker="o", markersize=3, color=color, label=label)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set(xlabel="round", ylabel="discounted value", xlim=(0.0, len(history) + 1.0))
    axes.legend(fontsize=8)


def _draw_distance(axes: Axes, plan: Plan) -> None:
    """Distance to the goal [mm] over environment steps: all nodes of the tree, and the plan."""
    from matplotlib.ticker import MaxNLocator

    hold = int(plan.planner.get("hold", 1))
    if plan.tree is not None:
        after = steps_of(plan.tree, hold, plan.planner.get("strides", [1]))
        told = [(d, s) for d, s in zip(after, plan.tree["distance"], strict=True) if s is not None]
        if told:
            steps, distance = np.array(told).T
            axes.scatter(steps, 1e3 * distance, s=2, color=_MUTED, alpha=0.4, label="nodes of the tree")
    first = float(plan.start.tensors["distance"])
    way = [first, *(step.distance for step in plan.steps)]
    axes.plot(range(len(way)), 1e3 * np.array(way), color=_PLAN, marker="o", markersize=3, label="plan")
    axes.set(xlabel="environment steps", ylabel="distance to the goal [mm]")
    axes.set_ylim(bottom=0.0)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_title("distance to the goal", fontsize=10)
    axes.legend(fontsize=8)
