"""What ``StaticResult`` says of worlds that found no equilibrium: what moves, and the way out."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from softwarp.model.codes import StaticReason
from softwarp.model.model import Model

WAYS_OUT = {
    StaticReason.CONVERGED: "",
    StaticReason.ROUNDING: "",
    StaticReason.ITERATION_LIMIT: "still on its way: call solve_static again, or raise max_iterations",
    StaticReason.TIME_LIMIT: "still on its way: call solve_static again, or raise max_seconds",
    StaticReason.NO_EQUILIBRIUM: (
        "no stable equilibrium was found near the way from the start to these loads and commands: apply them in parts, "
        "ask for less, or step through time"
    ),
    StaticReason.NOT_FINITE: "no step is short enough: a load, a command or a parameter is not finite, or huge",
    StaticReason.CONTACT_OVERFLOW: "contacts found no place: raise contact_capacity in finalize",
}


def parts(model: Model) -> list[tuple[str, str, slice]]:
    """Name of every soft body, rigid body and rod, the view of the state where it lies, and its items there."""
    starts = model.body_node_start.tolist()
    found = [(name, "node_x", slice(*starts[i : i + 2])) for i, name in enumerate(model.body_names)]
    found += [(name, "frame_pose", slice(i, i + 1)) for i, name in enumerate(model.rigid_names)]
    for rod, name in enumerate(model.rod_names):
        nodes = model.rod_nodes(rod)
        found.append((name, "frame_pose", slice(model.rigid_count + nodes.start, model.rigid_count + nodes.stop)))
    return found


def departure(model: Model, start: Mapping[str, NDArray[np.float64]], end: Mapping[str, NDArray[np.float64]]) -> str:
    """Which part of a world has gone farthest, where to, and what would hold it.

    Args:
        model: Scene.
        start: ``node_x`` and ``frame_pose`` of the world before, (node, 3) and (frame, 7).
        end: The same by now.
    """
    ways = []
    for name, view, items in parts(model):
        way = (end[view][items, :3] - start[view][items, :3]).mean(axis=0)
        ways.append((float(np.linalg.norm(way)), name, way))
    size, name, way = max(ways, key=lambda entry: entry[0])
    told = ", ".join(f"{value:.2g}" for value in np.round(way / max(size, 1e-300), 2) + 0.0)
    return (
        f"{name!r} moves away along ({told}) without end, as nothing holds it against its loads: fix nodes of it, "
        "attach or join it to what stands, add a contact pair with what it can rest on, or balance its loads"
    )


def advice(reason: StaticReason, departed: str | None) -> str:
    """What is said of a world; nothing of one in equilibrium."""
    return WAYS_OUT[reason] if departed is None else departed
