"""From chambers and membranes of a scene to their arrays. Host only."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp import meshing
from softwarp.meshing.quadratic import MIDDLE_WEIGHTS
from softwarp.model.cavities import CavityModel, MembraneModel
from softwarp.model.codes import CAVITY_CONTROLS, TURNED
from softwarp.plan.structure import Elements, Points, Structure, block_of, lists
from softwarp.scene.parts import Scene

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]
NEGLIGIBLE = 1e-12  # weights below it come from rounding and would only add entries to H


@dataclass(frozen=True)
class CavityPoints:
    """Surface points of all chambers before the elimination order is known."""

    starts: IntArray  # (cavity + 1,)
    points: Points


def cavity_points(scene: Scene, node_start: IntArray, carrier_start: IntArray, carriers: IntArray) -> CavityPoints:
    """Ranges of the surface points of every chamber, and the nodes that carry them."""
    starts, nodes, weights, anchors = [0], [], [], []
    for cavity in scene.cavities:
        count = len(cavity.vertices)
        carrier = np.full((count, 4), -1, dtype=np.int32)
        weight = np.where(np.abs(cavity.weights) < NEGLIGIBLE, 0.0, cavity.weights)
        inside = cavity.tets >= 0
        carrier[inside] = carriers[carrier_start[cavity.body] + cavity.tets[inside]]
        middle = cavity.middles[:, 0] >= 0
        carrier[middle, :3] = node_start[cavity.body] + cavity.middles[middle]
        weight[middle, :3], weight[middle, 3] = MIDDLE_WEIGHTS, 0.0
        nodes.append(np.where(weight != 0.0, carrier, -1))
        weights.append(weight)
        anchors.append(np.where(inside[:, None], 0.0, cavity.vertices))
        starts.append(starts[-1] + count)
    return CavityPoints(
        starts=np.array(starts, dtype=np.int32),
        points=Points(
            np.concatenate([np.empty((0, 4), dtype=np.int32), *nodes]).astype(np.int32),
            np.concatenate([np.empty((0, 4)), *weights]),
            np.concatenate([np.empty((0, 3)), *anchors]),
        ),
    )


def cavity_model(scene: Scene, chambers: CavityPoints, first_point: int, found: Structure) -> CavityModel | None:
    """All chambers, whose points count on from ``first_point``; None without any."""
    if not scene.cavities:
        return None
    starts = chambers.starts
    triangles = [c.triangles + s for c, s in zip(scene.cavities, starts[:-1], strict=True)]
    tri = np.concatenate([np.empty((0, 3), dtype=np.int32), *triangles]).astype(np.int32)
    ring_start, ring = meshing.surface_rings(tri, int(starts[-1]))
    ends, opposite = meshing.surface_edges(tri)
    cavity_of_point = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    rest_volume = np.array([meshing.surface_volume(c.vertices, c.triangles) for c in scene.cavities])
    laws = [scene.bodies[c.body].material.kernel_law for c in scene.cavities]
    has_tangent = np.array([law not in TURNED for law in laws])[cavity_of_point[ends[:, 0]]]
    coupling_start, coupling_edge, coupling_weight = _couplings(ends, has_tangent, chambers.points, found)
    return CavityModel(
        body=np.array([c.body for c in scene.cavities], dtype=np.int32),
        starts=starts,
        triangles=tri,
        tri_cavity=cavity_of_point[tri[:, 0]].astype(np.int32),
        rest_volume=rest_volume,
        cavity_point_start=first_point + starts,
        cavity_area=np.array([meshing.triangle_areas(c.vertices, c.triangles).sum() for c in scene.cavities]),
        cavity_rest_volume=rest_volume,
        point_cavity=cavity_of_point,
        cavity_control=np.array([CAVITY_CONTROLS.index(c.control) for c in scene.cavities]),
        ring_start=ring_start,
        point_ring=first_point + ring,
        cavity_tri_start=np.concatenate([[0], np.cumsum([len(c.triangles) for c in scene.cavities])]),
        cavity_tri=first_point + tri,
        edge_cavity=cavity_of_point[ends[:, 0]],
        edge_opposite=first_point + opposite,
        coupling_start=coupling_start,
        coupling_edge=coupling_edge,
        coupling_weight=coupling_weight,
    )


def _couplings(
    ends: IntArray, has_tangent: NDArray[np.bool_], points: Points, found: Structure
) -> tuple[IntArray, NDArray[Any], FloatArray]:
    """Ranges, edges and weights: what of the tangents of edges every block of A receives.

    Chambers of ``large`` bodies have none: their tangent lacks the geometric stiffness that it goes together with.
    Pairs of nodes that no element ties together, which an embedded surface can have, are left out: their part of the
    tangent would cost fill, and equilibria do not depend on it.
    """
    symbolic, slots = found.symbolic, found.slots
    edge, m, n, weight = meshing.edge_couplings(ends, points.point_node, points.point_weight)
    i, j = slots.unknown[m], slots.unknown[n]
    weight = np.where(i >= j, weight, -weight)
    i, j = np.maximum(i, j), np.minimum(i, j)
    stored = set(zip(symbolic.a_row.tolist(), symbolic.a_col.tolist(), strict=True))
    keep = np.array([a >= 0 and b >= 0 and a != b and (a, b) in stored for a, b in zip(i, j, strict=True)], dtype=bool)
    keep &= has_tangent[edge]
    block = block_of(symbolic, i[keep], j[keep])
    start, order = lists(block, np.arange(block.size), len(symbolic.a_row))
    return start, edge[keep][order], weight[keep][order]


def tied_nodes(chambers: CavityModel, first_point: int, points: Points) -> IntArray:
    """Pairs of nodes that the pressures of chambers tie together, (tie, 2)."""
    ends, _ = meshing.surface_edges(chambers.triangles)
    _, m, n, _ = meshing.edge_couplings(ends, points.point_node[first_point:], points.point_weight[first_point:])
    return np.unique(np.stack([m, n], axis=1), axis=0).astype(np.int32)


def with_tangent(chambers: CavityModel, first_point: int, points: Points, found: Structure) -> CavityModel:
    """The same chambers in a structure with room for the tangent of all their edges."""
    ends, _ = meshing.surface_edges(chambers.triangles)
    rows = slice(first_point, None)
    own = Points(points.point_node[rows], points.point_weight[rows], points.point_anchor[rows])
    start, edge, weight = _couplings(ends, np.ones(len(ends), dtype=bool), own, found)
    return replace(chambers, coupling_start=start, coupling_edge=edge, coupling_weight=weight)


@dataclass(frozen=True)
class MembraneLayout:
    """Triangles of all membranes before the elimination order is known."""

    triangles: IntArray  # (tri, 3) nodes
    member: IntArray  # (tri,) membrane
    body: IntArray  # (membrane,)
    gradient: FloatArray  # (tri, 4) [1/m]
    volume: FloatArray  # (tri,) [m^3]
    node_volume: FloatArray  # (node,) that they add to the body's [m^3]


def membrane_layout(scene: Scene, node_start: IntArray) -> MembraneLayout:
    """Number the triangles membrane after membrane."""
    tri, gradient, volume, member = [], [], [], []
    added = np.zeros(int(node_start[-1]))
    for number, spec in enumerate(scene.membranes):
        body = scene.bodies[spec.body]
        g = meshing.membrane_geometry(body.mesh.nodes, spec.triangles, spec.thickness, name=spec.name)
        weight = np.ones(len(g.triangles)) if body.reduction is None else body.reduction.membrane_weight[spec.name]
        counts = weight > 0.0
        tri.append(g.triangles[counts] + node_start[spec.body])
        gradient.append(g.gradient[counts])
        volume.append((g.volume * weight)[counts])
        member.append(np.full(int(counts.sum()), number))
        share = g.node_volume * (spec.density / body.density)
        added[node_start[spec.body] : node_start[spec.body + 1]] += share
    return MembraneLayout(
        triangles=np.concatenate([np.empty((0, 3), dtype=np.int32), *tri]).astype(np.int32),
        member=np.concatenate([np.empty(0, dtype=np.int32), *member]).astype(np.int32),
        body=np.array([m.body for m in scene.membranes], dtype=np.int32),
        gradient=np.concatenate([np.empty((0, 4)), *gradient]),
        volume=np.concatenate([np.empty(0), *volume]),
        node_volume=added,
    )


def membrane_elements(layout: MembraneLayout) -> list[Elements]:
    """Triangles as elements with a fourth corner that is none; nothing without any."""
    if len(layout.triangles) == 0:
        return []
    corners = np.pad(layout.triangles, ((0, 0), (0, 1)), constant_values=-1)
    return [Elements("membrane", corners, np.arange(len(corners)))]


def membrane_model(scene: Scene, layout: MembraneLayout, found: Structure) -> MembraneModel | None:
    """All membranes; None without any."""
    if not scene.membranes:
        return None
    lists_of = found.lists["membrane"]
    return MembraneModel(
        names=tuple(m.name for m in scene.membranes),
        body=layout.body,
        triangles=layout.triangles,
        tri_node=layout.triangles,
        tri_membrane=layout.member,
        tri_gradient=layout.gradient,
        tri_volume=layout.volume,
        element_body=layout.body[layout.member],
        membrane_entry_start=lists_of.start,
        membrane_entry=lists_of.entry,
        carried_block=lists_of.carried.target,
        carried_start=lists_of.carried.start,
        carried_entry=lists_of.carried.entry,
        carried_weight=lists_of.carried.weight,
        held_node=lists_of.held.target,
        held_start=lists_of.held.start,
        held_entry=lists_of.held.entry,
        held_weight=lists_of.held.weight,
    )
