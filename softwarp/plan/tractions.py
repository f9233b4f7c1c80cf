"""From tractions of a scene to the nodes that they pull at. Host only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softwarp.model.tractions import TractionModel
from softwarp.plan.structure import lists
from softwarp.scene.parts import Scene

IntArray = NDArray[np.int32]


def traction_model(scene: Scene, node_start: IntArray) -> TractionModel | None:
    """All tractions; None without any."""
    if not scene.tractions:
        return None
    specs = scene.tractions
    node = np.concatenate([t.node + node_start[t.body] for t in specs])
    number = np.repeat(np.arange(len(specs)), [len(t.node) for t in specs])
    loaded, place = np.unique(node, return_inverse=True)
    start, order = lists(place, np.arange(len(node)), len(loaded))
    return TractionModel(
        names=tuple(t.name for t in specs),
        body=np.array([t.body for t in specs], dtype=np.int32),
        area=np.array([t.share.sum() for t in specs]),
        start=np.stack([t.value for t in specs]),
        loaded_node=loaded,
        entry_start=start,
        entry_traction=number[order],
        entry_share=np.concatenate([t.share for t in specs])[order],
    )
