"""From cables and markers of a scene to their points. Host only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softwarp.model.codes import SHORTEST
from softwarp.model.handles import Rod
from softwarp.plan.frames import FrameLayout
from softwarp.plan.soft import SoftLayout
from softwarp.plan.structure import Points
from softwarp.scene.parts import CableSpec, Scene

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class CableArrays:
    """Arrays of all cables, under the names that ``Model`` declares."""

    cable_starts: IntArray
    cable_force_controlled: NDArray[np.bool_]
    cable_elastic: NDArray[np.bool_]
    cable_rest: FloatArray
    cable_point_start_device: IntArray
    cable_rest_length: FloatArray
    cable_closing_length: FloatArray
    cable_force_control: IntArray
    point_cable: IntArray
    delassus_pair: IntArray


@dataclass(frozen=True)
class MarkerArrays:
    """Arrays of all markers, under the names that ``Model`` declares."""

    marker_node: IntArray
    marker_weight: FloatArray
    marker_frame: IntArray
    marker_local: FloatArray
    marker_anchor: FloatArray


def cable_points(scene: Scene, soft: SoftLayout) -> Points:
    """Points of all cables; guides are the last nodes, in the order of their waypoints."""
    nodes, weights, anchors = [np.empty((0, 4), dtype=np.int32)], [np.empty((0, 4))], [np.empty((0, 3))]
    guide = int(soft.node_start[-1])
    for cable in scene.cables:
        if cable.pull_point is not None:
            nodes.append(np.full((1, 4), -1, dtype=np.int32))
            weights.append(np.zeros((1, 4)))
            anchors.append(cable.pull_point[None])
        corners, shares = np.full((len(cable.waypoints), 4), -1, dtype=np.int32), cable.weights.copy()
        for i, (part, tet) in enumerate(zip(cable.carriers, cable.tets, strict=True)):
            if i in cable.patches:
                corners[i, : len(cable.patches[i])] = soft.node_start[part] + cable.patches[i]
            elif tet >= 0:
                corners[i] = soft.carriers[soft.carrier_start[part] + tet]
            else:
                corners[i, 0], shares[i, 0], guide = guide, 1.0, guide + 1
        nodes.append(corners)
        weights.append(shares)
        anchors.append(np.zeros((len(corners), 3)))
    return Points(np.concatenate(nodes), np.concatenate(weights), np.concatenate(anchors))


def cable_arrays(scene: Scene) -> CableArrays:
    """Ranges of points, lengths and kinds of control of all cables."""
    paths = [_path(cable) for cable in scene.cables]
    starts = np.concatenate([[0], np.cumsum([len(path) for path in paths])]).astype(np.int32)
    rest = np.array([np.linalg.norm(np.diff(path, axis=0), axis=1).sum() for path in paths], dtype=np.float64)
    force = np.array([cable.force_control for cable in scene.cables], dtype=bool)
    count = len(scene.cables)
    pairs = [(i, j) for i in range(count) for j in range(i, count)]
    closing = np.array([max(cable.closing_length, SHORTEST) for cable in scene.cables], dtype=np.float64)
    return CableArrays(
        cable_starts=starts,
        cable_force_controlled=force,
        cable_elastic=np.array([cable.is_elastic for cable in scene.cables], dtype=bool),
        cable_rest=rest,
        cable_point_start_device=starts,
        cable_rest_length=rest,
        cable_closing_length=closing,
        cable_force_control=force.astype(np.int32),
        point_cable=np.repeat(np.arange(count, dtype=np.int32), np.diff(starts)),
        delassus_pair=np.array(pairs, dtype=np.int32).reshape(-1, 2),
    )


def _path(cable: CableSpec) -> FloatArray:
    """All points of a cable at rest [m], the pull point first."""
    return cable.waypoints if cable.pull_point is None else np.vstack([cable.pull_point, cable.waypoints])


def marker_arrays(scene: Scene, soft: SoftLayout, frames: FrameLayout | None) -> MarkerArrays:
    """Nodes or frames that carry markers, -1 for none, and their weights or places."""
    count = len(scene.markers)
    node, frame = np.full((count, 4), -1, dtype=np.int32), np.full(count, -1, dtype=np.int32)
    for i, marker in enumerate(scene.markers):
        if marker.frame is None:
            node[i] = soft.carriers[soft.carrier_start[marker.body] + marker.tet]
        elif frames is not None:
            part, rod_node = marker.frame
            is_rod = isinstance(part, Rod)
            frame[i] = frames.rigid_count + frames.rod_start[part] + rod_node if is_rod else int(part)
    return MarkerArrays(
        marker_node=node,
        marker_weight=np.array([m.weights for m in scene.markers], dtype=np.float64).reshape(-1, 4),
        marker_frame=frame,
        marker_local=np.array([m.local for m in scene.markers], dtype=np.float64).reshape(-1, 3),
        marker_anchor=np.zeros((count, 3)),
    )
