"""What frames carry of quadratic elements, and the blocks of A that it enters. Host only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softwarp.meshing.quadratic import NODES
from softwarp.model.codes import Side
from softwarp.plan.frames import FrameLayout
from softwarp.plan.structure import Structure, lists

IntArray = NDArray[np.int32]
KIND = "quadraticlarge"


@dataclass(frozen=True)
class GripLists:
    """Under the names that ``FrameModel`` declares; a grip is what one frame carries of one element."""

    grip_start: IntArray
    grip_corner: IntArray
    grip_item: IntArray
    gripped_block: IntArray
    gripped_start: IntArray
    gripped_entry: IntArray  # (entry, 3)


def grip_lists(found: Structure, frames: FrameLayout, nodes: IntArray) -> GripLists:
    """Grips, and for every block of A that they enter its elements with the codes of both sides.

    Args:
        found: Structure of the linear system.
        frames: Frames of the scene.
        nodes: Nodes of quadratic elements, (element, 10).
    """
    if KIND not in found.lists:
        none = np.zeros(0, dtype=np.int32)
        return GripLists(np.zeros(1, np.int32), none, none, none, np.zeros(1, np.int32), none.reshape(0, 3))
    blocks, item = found.lists[KIND].carried, found.slots.item
    element, pair = np.divmod(blocks.entry[:, 0].astype(np.int64), NODES * NODES)
    used = np.unique(element)
    row, corner = np.nonzero(item[nodes[used]] >= 0)
    carried = item[nodes[used[row], corner]]
    owner = used[row] * frames.count + frames.carried_frame[carried]
    grips, number = np.unique(owner, return_inverse=True)
    start, order = lists(number, np.arange(len(owner)), len(grips))

    def side(local: NDArray[np.int64], is_turned: NDArray[np.bool_]) -> NDArray[np.int64]:
        held = item[nodes[element, local]]
        grip = np.searchsorted(grips, element * frames.count + frames.carried_frame[np.maximum(held, 0)])
        of_grip = 4 * grip + np.where(is_turned, Side.ROTATION, Side.TRANSLATION)
        codes: NDArray[np.int64] = np.where(held < 0, 4 * (NODES * element + local) + Side.NODE, of_grip)
        return codes

    a, b = np.divmod(pair, NODES)
    left, right = side(a, blocks.entry[:, 1] >= 0), side(b, blocks.entry[:, 2] >= 0)
    place = np.repeat(np.arange(len(blocks.target)), np.diff(blocks.start))
    _, first = np.unique(place * (len(nodes) + 1) + element, return_index=True)  # one entry for an element in a block
    return GripLists(
        grip_start=start,
        grip_corner=(NODES * used[row] + corner)[order].astype(np.int32),
        grip_item=carried[order].astype(np.int32),
        gripped_block=blocks.target,
        gripped_start=np.searchsorted(place[first], np.arange(len(blocks.target) + 1)).astype(np.int32),
        gripped_entry=np.stack([element, left, right], axis=1)[first].astype(np.int32),
    )
