"""Outputs of all worlds that follow from positions: markers, points and lengths of cables."""

from __future__ import annotations

from typing import Any

import warp as wp

from softwarp.kernels.algebra.lanes import variant
from softwarp.kernels.step import transfer
from softwarp.model.model import Model
from softwarp.model.state import State


def update_outputs(model: Model, state: State, *, world_fastest: bool) -> None:
    """Write markers and cables of a state where its nodes and frames are.

    Args:
        model: Scene.
        state: All worlds.
        world_fastest: Whether worlds lie side by side in memory, as on a GPU.
    """
    m, s = model, state
    scalar = variant("cuda" if world_fastest else "scalar", m.precision)
    k = transfer.kernels(scalar)

    def launch(kernel: Any, items: int, inputs: list[Any], outputs: list[Any]) -> None:
        if items:
            dim = scalar.dim(m.num_worlds, items)
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=m.device)

    marker = [m.marker_node, m.marker_weight, m.marker_anchor, False]
    launch(k.embed, m.marker_count, [*marker, s.node_x], [s.marker_x])
    launch(k.embed, m.marker_count, [*marker, s.node_v], [s.marker_v])
    if m.frames is not None:
        inputs = [m.marker_frame, m.marker_local, s.frame_pose, s.frame_twist]
        launch(k.embed_in_frames, m.marker_count, inputs, [s.marker_x, s.marker_v])
    inputs = [m.point_node, m.point_weight, m.point_anchor, True, s.node_x]
    launch(k.embed, m.point_count, inputs, [s.cable_x])
    inputs = [m.cable_point_start_device, m.cable_rest_length, m.cable_closing_length, s.cable_x]
    launch(k.cable_lengths, m.cable_count, inputs, [s.cable_length, s.cable_displacement])
