"""From telescopes of a scene to their constants, and the refusal of what they cannot carry. Host only."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp.model.handles import Rod
from softwarp.model.telescopes import TelescopeModel
from softwarp.plan.frames import FrameLayout
from softwarp.scene.parts import Scene

IntArray = NDArray[np.int32]


def check_telescopes(scene: Scene) -> None:
    """Refuse cables and joints on telescopes, and parts anywhere but at their tips: other nodes slide along them.

    Raises:
        ValueError: The message names the telescope and what it cannot carry.
    """
    names = {number: scene.rods[number].name for number, _ in scene.telescopes}
    if not names:
        return
    for cable in scene.cables:
        for part in (part for part, _ in cable.guides if isinstance(part, Rod) and int(part) in names):
            raise ValueError(
                f"cable {cable.name!r} runs along telescope {names[int(part)]!r}, whose nodes slide along its tubes; "
                "lay cables along rods and soft bodies"
            )
    for joint in scene.joints:
        for side in (joint.parent, joint.child):
            if side is not None and isinstance(side[0], Rod) and int(side[0]) in names:
                raise ValueError(
                    f"joint {joint.name!r} holds telescope {names[int(side[0])]!r}, whose nodes slide along its tubes; "
                    "attach a rigid body to its last node and join that"
                )
    for weld in scene.welds:
        if weld.kind == "rod" and weld.part in names:
            raise ValueError(f"telescope {names[weld.part]!r} is held by its port and cannot be attached to anything")
        if weld.to_rod and weld.to in names:
            last = len(scene.rods[weld.to].geometry.positions) - 1
            if (np.asarray(weld.to_node) != last).any():
                raise ValueError(
                    f"telescope {names[weld.to]!r} carries parts at its last node only ({last}, or -1): the others "
                    f"slide along its tubes; got node {int(np.asarray(weld.to_node).flat[0])}"
                )


def telescope_model(scene: Scene, frames: FrameLayout | None, master_dof: NDArray[Any]) -> TelescopeModel | None:
    """All telescopes; None without any.

    Args:
        scene: Scene.
        frames: Its frames.
        master_dof: Dofs of translation and rotation of every frame's master, shape (2 frame,).
    """
    if frames is None or not scene.telescopes:
        return None
    rods = np.array([number for number, _ in scene.telescopes], dtype=np.int32)
    specs = [spec for _, spec in scene.telescopes]
    pieces = np.array([len(scene.rods[rod].geometry.length) for rod in rods], dtype=np.int32)
    tubes = np.array([spec.table.count for spec in specs], dtype=np.int32)
    base = frames.rigid_count + frames.rod_start[rods]
    first_tube = np.concatenate([[0], np.cumsum(tubes)]).astype(np.int32)
    first_node = np.concatenate([[0], np.cumsum(pieces + 1)]).astype(np.int32)
    first_windup = np.concatenate([[0], np.cumsum(tubes * (pieces + 1))]).astype(np.int32)
    owned = frames.rigid_count + frames.rod_count
    is_piece = np.isin(frames.segment_rod, rods)
    sections = [spec.table.section_start for spec in specs]
    section_first = np.concatenate([[0], np.cumsum([start[-1] for start in sections])])
    windup = [
        np.repeat(spec.angles - spec.angles[int(np.argmax(spec.lengths))], n + 1)
        for spec, n in zip(specs, pieces, strict=True)
    ]

    def joined(values: list[NDArray[Any]]) -> NDArray[Any]:
        return np.concatenate([np.asarray(value).reshape(-1) for value in values])

    return TelescopeModel(
        rod=rods,
        tube_start=first_tube,
        start_length=joined([spec.lengths for spec in specs]),
        start_angle=joined([spec.angles for spec in specs]),
        start_base=np.array([spec.angles[int(np.argmax(spec.lengths))] for spec in specs]),
        start_windup=joined(windup),
        outer_radius=joined([spec.table.radius for spec in specs]),
        first_tube=first_tube,
        base_frame=base,
        base_dof=np.stack([master_dof[2 * base], master_dof[2 * base + 1]], axis=1).reshape(-1),
        pieces=pieces,
        first_windup=first_windup[:-1],
        first_owner=owned + first_node[:-1],
        floor=np.array([spec.floor for spec in specs]),
        hidden_twists=np.array([spec.windup for spec in specs], dtype=np.int32),
        port=joined([spec.port for spec in specs]),
        node_telescope=np.repeat(np.arange(len(rods)), pieces + 1),
        node_place=joined([np.arange(n + 1) for n in pieces]),
        piece_telescope=np.repeat(np.arange(len(rods)), pieces),
        piece_place=joined([np.arange(n) for n in pieces]),
        piece_segment=np.flatnonzero(is_piece),
        plain_segment=np.flatnonzero(~is_piece),
        tube_telescope=np.repeat(np.arange(len(rods)), tubes),
        tube_whole=joined([spec.table.length for spec in specs]),
        tube_area=joined([spec.table.area for spec in specs]),
        section_start=np.concatenate(
            [*(start[:-1] + first for start, first in zip(sections, section_first, strict=False)), section_first[-1:]]
        ).astype(np.int32),
        section_end=joined([spec.table.section_end for spec in specs]),
        section_ratio=joined([spec.table.section_ratio for spec in specs]),
        section_curvature=joined([spec.table.curvature for spec in specs]),
    )
