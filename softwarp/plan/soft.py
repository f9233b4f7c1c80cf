"""Soft bodies, their cables and markers, body after body. Host only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from softwarp.meshing.tets import rest_geometry
from softwarp.model.codes import SHORTEST
from softwarp.model.quadratic import QuadraticLayout
from softwarp.plan.frames import FrameLayout, guide_points
from softwarp.plan.quadratic import quadratic_layout
from softwarp.scene.parts import Rod

if TYPE_CHECKING:
    from softwarp.builder import ModelBuilder

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]
Arrays = dict[str, NDArray[Any]]


@dataclass
class SoftLayout:
    """Nodes and elements of all soft bodies. The last nodes are guides: waypoints of cables on rods and rigid bodies.

    Points are embedded in ``carriers``: the linear tets, or those between the nodes of quadratic elements.
    """

    nodes: FloatArray  # (node, 3)
    carriers: IntArray  # (carrier, 4)
    carrier_start: IntArray  # (body + 1,)
    node_start: IntArray  # (body + 1,)
    tets: IntArray  # (tet, 4) linear elements
    tet_body: IntArray
    node_body: IntArray
    fixed: NDArray[np.bool_]
    locked: NDArray[np.bool_]  # (node, 3)
    laws: NDArray[Any]  # kernel law of every tet
    gradient: FloatArray
    volume: FloatArray
    frame: FloatArray
    node_volume: FloatArray
    node_load: FloatArray
    quadratic: QuadraticLayout


def soft_layout(builder: ModelBuilder) -> SoftLayout:
    """Number nodes and elements body after body."""
    bodies, guides = builder.bodies, guide_points(builder)
    node_start = np.concatenate([[0], np.cumsum([len(b.mesh.nodes) for b in bodies])]).astype(np.int32)
    carrier_start = np.concatenate([[0], np.cumsum([len(b.mesh.tets) for b in bodies])]).astype(np.int32)
    nodes = stacked([*(b.mesh.nodes for b in bodies), guides], (0, 3), np.float64)
    carriers = stacked([b.mesh.tets + s for b, s in zip(bodies, node_start[:-1], strict=True)], (0, 4), np.int32)
    carrier_body = np.repeat(np.arange(len(bodies)), np.diff(carrier_start)).astype(np.int32)
    is_element = np.array([b.elements is None for b in bodies], dtype=bool)[carrier_body]
    tets, tet_body = carriers[is_element], carrier_body[is_element]
    gradient, volume, frame = rest_geometry(nodes, tets)
    quadratic = quadratic_layout(builder, node_start)
    volumes = [_lumped_volume(b, volume[tet_body == i]) for i, b in enumerate(bodies)]
    end = (0, len(guides))
    node_volume = np.pad(stacked(volumes, (0,), np.float64), end)
    node_volume += np.bincount(quadratic.nodes.ravel(), quadratic.lumped.ravel(), minlength=len(nodes))
    return SoftLayout(
        nodes=nodes,
        carriers=carriers,
        carrier_start=carrier_start,
        node_start=node_start,
        tets=tets,
        tet_body=tet_body,
        node_body=np.pad(np.repeat(np.arange(len(bodies)), np.diff(node_start)), end).astype(np.int32),
        fixed=np.pad(stacked([b.fixed for b in bodies], (0,), bool), end),
        locked=np.pad(stacked([b.locked for b in bodies], (0, 3), bool), (end, (0, 0))),
        laws=np.array([b.material.kernel_law for b in bodies], dtype=object)[tet_body],
        gradient=gradient,
        volume=volume,
        frame=frame,
        node_volume=node_volume,
        node_load=np.pad(stacked([b.load for b in bodies], (0, 3), np.float64), (end, (0, 0))),
        quadratic=quadratic,
    )


def _lumped_volume(body: Any, volume: FloatArray) -> FloatArray:
    count = len(body.mesh.nodes)
    if body.elements is not None:
        return np.zeros(count)  # quadratic elements bring theirs
    if body.lumping == "uniform":
        return np.full(count, volume.sum() / count)
    shares = np.bincount(body.mesh.tets.ravel(), np.repeat(volume / 4.0, 4), minlength=count)
    return shares.astype(np.float64)


def stacked(parts: list[NDArray[Any]], empty: tuple[int, ...], dtype: Any) -> NDArray[Any]:
    """Parts one after the other, or an array of shape ``empty`` without any."""
    return np.concatenate([np.empty(empty, dtype=dtype), *parts]).astype(dtype)


def cables(builder: ModelBuilder, soft: SoftLayout) -> tuple[dict[str, Any], dict[str, Any]]:
    """Points and rest lengths of all cables; guides are the last nodes, in the order of their waypoints."""
    starts, nodes, weights, anchors, rest = [0], [], [], [], []
    guide = int(soft.node_start[-1])
    for cable in builder.cables:
        path = cable.waypoints
        if cable.pull_point is not None:
            path = np.vstack([cable.pull_point, path])
            nodes.append(np.full((1, 4), -1))
            weights.append(np.zeros((1, 4)))
            anchors.append(cable.pull_point[None])
        corners, shares = np.full((len(cable.waypoints), 4), -1), cable.weights.copy()
        for i, (part, tet) in enumerate(zip(cable.carriers, cable.tets, strict=True)):
            if tet >= 0:
                corners[i] = soft.carriers[soft.carrier_start[part] + tet]
            else:
                corners[i, 0], shares[i, 0], guide = guide, 1.0, guide + 1
        nodes.append(corners)
        weights.append(shares)
        anchors.append(np.zeros((len(corners), 3)))
        starts.append(starts[-1] + len(path))
        rest.append(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    empty = not builder.cables
    point_node = np.empty((0, 4), dtype=np.int32) if empty else np.concatenate(nodes).astype(np.int32)
    point_weight = np.empty((0, 4)) if empty else np.concatenate(weights)
    cable_starts = np.array(starts, dtype=np.int32)

    count = len(builder.cables)
    pairs = [(i, j) for i in range(count) for j in range(i, count)]
    force = np.array([c.force_control for c in builder.cables], dtype=bool)
    host = {"cable_starts": cable_starts, "cable_force_controlled": force, "cable_rest": np.array(rest)}
    device = {
        "cable_point_start_device": cable_starts,
        "cable_rest_length": np.array(rest, dtype=np.float64),
        "cable_closing_length": np.array([max(c.closing_length, SHORTEST) for c in builder.cables], dtype=np.float64),
        "cable_force_control": force.astype(np.int32),
        "point_cable": np.repeat(np.arange(len(builder.cables), dtype=np.int32), np.diff(cable_starts)),
        "point_node": point_node,
        "point_weight": point_weight,
        "point_anchor": np.empty((0, 3)) if empty else np.concatenate(anchors),
        "delassus_pair": np.array(pairs, dtype=np.int32).reshape(-1, 2),
    }
    return host, device


def markers(builder: ModelBuilder, soft: SoftLayout) -> tuple[IntArray, FloatArray]:
    """Nodes that carry markers, -1 for none, and their weights."""
    weights = np.array([m.weights for m in builder.markers], dtype=np.float64).reshape(-1, 4)
    node = np.full((len(builder.markers), 4), -1, dtype=np.int32)
    for i, marker in enumerate(builder.markers):
        if marker.frame is None:
            node[i] = soft.carriers[soft.carrier_start[marker.body] + marker.tet]
    return node, weights


def marker_frames(builder: ModelBuilder, frames: FrameLayout | None) -> dict[str, NDArray[Any]]:
    """Frames that carry markers, -1 for none, and their places in them."""
    frame = np.full(len(builder.markers), -1, dtype=np.int32)
    for i, marker in enumerate(builder.markers):
        if marker.frame is not None and frames is not None:
            part, node = marker.frame
            is_rod = isinstance(part, Rod)
            frame[i] = frames.rigid_count + frames.rod_start[part] + node if is_rod else int(part)
    local = np.array([marker.local for marker in builder.markers], dtype=np.float64).reshape(-1, 3)
    return {"marker_frame": frame, "marker_local": local}
