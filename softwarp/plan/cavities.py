"""From chambers and membranes of the builder to their arrays. Host only."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from softwarp import meshing
from softwarp.model.codes import CAVITY_CONTROLS, TURNED
from softwarp.plan.structure import Slots, block_of, lists

if TYPE_CHECKING:
    from softwarp.builder import ModelBuilder

IntArray = NDArray[np.int32]
FloatArray = NDArray[np.float64]
Arrays = dict[str, NDArray[Any]]
# A vertex in the middle m of a quadratic edge from a to b stands at (4 m - (a + b) / 2) / 3. Four flat triangles then
# enclose the volume, and carry the pressure, of the curved face between six nodes (docs/theory/cavity.md).
MIDDLE_WEIGHTS = np.array([4.0 / 3.0, -1.0 / 6.0, -1.0 / 6.0])
NEGLIGIBLE = 1e-12  # weights below it come from rounding and would only add entries to H


def cavity_points(builder: ModelBuilder, tet_start: IntArray, tets: IntArray) -> tuple[IntArray, Arrays]:
    """Ranges of the surface points of every chamber, and the nodes that carry them."""
    starts, nodes, weights, anchors = [0], [], [], []
    for cavity in builder.cavities:
        count = len(cavity.vertices)
        carrier = np.full((count, 4), -1, dtype=np.int32)
        weight = np.where(np.abs(cavity.weights) < NEGLIGIBLE, 0.0, cavity.weights)
        inside = cavity.tets >= 0
        carrier[inside] = tets[tet_start[cavity.body] + cavity.tets[inside]]
        middle = cavity.middles[:, 0] >= 0
        first = sum(len(spec.fixed) for spec in builder.bodies[: cavity.body])
        carrier[middle, :3] = first + cavity.middles[middle]
        weight[middle, :3], weight[middle, 3] = MIDDLE_WEIGHTS, 0.0
        nodes.append(np.where(weight != 0.0, carrier, -1))
        weights.append(weight)
        anchors.append(np.where(inside[:, None], 0.0, cavity.vertices))
        starts.append(starts[-1] + count)
    points = {
        "point_node": np.concatenate([np.empty((0, 4), dtype=np.int32), *nodes]).astype(np.int32),
        "point_weight": np.concatenate([np.empty((0, 4)), *weights]),
        "point_anchor": np.concatenate([np.empty((0, 3)), *anchors]),
    }
    return np.array(starts, dtype=np.int32), points


def cavity_arrays(
    builder: ModelBuilder, starts: IntArray, points: Arrays, first_point: int, symbolic: Any, slots: Slots
) -> tuple[dict[str, Any], Arrays]:
    """Host and device arrays of all chambers; ``points`` are theirs alone."""
    triangles = [c.triangles + s for c, s in zip(builder.cavities, starts[:-1], strict=True)]
    tri = np.concatenate([np.empty((0, 3), dtype=np.int32), *triangles]).astype(np.int32)
    ring_start, ring = meshing.surface_rings(tri, int(starts[-1]))
    ends, opposite = meshing.surface_edges(tri)
    cavity_of_point = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    rest_volume = np.array([meshing.surface_volume(c.vertices, c.triangles) for c in builder.cavities])
    host = {
        "body": np.array([c.body for c in builder.cavities], dtype=np.int32),
        "starts": starts,
        "triangles": tri,
        "tri_cavity": cavity_of_point[tri[:, 0]].astype(np.int32),
        "rest_volume": rest_volume,
    }
    laws = [builder.bodies[c.body].material.kernel_law for c in builder.cavities]
    has_tangent = np.array([law not in TURNED for law in laws])[cavity_of_point[ends[:, 0]]]
    device = {
        "cavity_point_start": first_point + starts,
        "cavity_area": np.array([meshing.triangle_areas(c.vertices, c.triangles).sum() for c in builder.cavities]),
        "cavity_rest_volume": rest_volume,
        "point_cavity": cavity_of_point,
        "cavity_control": np.array([CAVITY_CONTROLS.index(c.control) for c in builder.cavities]),
        "ring_start": ring_start,
        "point_ring": first_point + ring,
        "edge_cavity": cavity_of_point[ends[:, 0]],
        "edge_opposite": first_point + opposite,
        **_couplings(ends, has_tangent, points, symbolic, slots),
    }
    return host, device


def _couplings(ends: IntArray, has_tangent: NDArray[np.bool_], points: Arrays, symbolic: Any, slots: Slots) -> Arrays:
    """Blocks of A that receive an edge's tangent.

    Chambers of ``large`` bodies have none: their tangent lacks the geometric stiffness that it goes together with.
    Pairs of nodes that no element ties together, which an embedded surface can have, are left out: their part of the
    tangent would cost fill, and equilibria do not depend on it.
    """
    edge, m, n, weight = meshing.edge_couplings(ends, points["point_node"], points["point_weight"])
    i, j = slots.unknown[m], slots.unknown[n]
    weight = np.where(i >= j, weight, -weight)
    i, j = np.maximum(i, j), np.minimum(i, j)
    stored = set(zip(symbolic.a_row.tolist(), symbolic.a_col.tolist(), strict=True))
    keep = np.array([a >= 0 and b >= 0 and a != b and (a, b) in stored for a, b in zip(i, j, strict=True)], dtype=bool)
    keep &= has_tangent[edge]
    block = block_of(symbolic, i[keep], j[keep])
    start, order = lists(block, np.arange(block.size), len(symbolic.a_row))
    return {"coupling_start": start, "coupling_edge": edge[keep][order], "coupling_weight": weight[keep][order]}


def membrane_arrays(builder: ModelBuilder, node_start: IntArray) -> tuple[dict[str, Any], Arrays, FloatArray]:
    """Host and device arrays of all membranes, and the volume that they add to every node."""
    count = int(node_start[-1])
    tri, gradient, volume, member = [], [], [], []
    added = np.zeros(count)
    for number, spec in enumerate(builder.membranes):
        body = builder.bodies[spec.body]
        g = meshing.membrane_geometry(body.mesh.nodes, spec.triangles, spec.thickness, name=spec.name)
        tri.append(g.triangles + node_start[spec.body])
        gradient.append(g.gradient)
        volume.append(g.volume)
        member.append(np.full(len(g.triangles), number))
        share = g.node_volume * (spec.density / body.density)
        added[node_start[spec.body] : node_start[spec.body + 1]] += share
    bodies = np.array([m.body for m in builder.membranes], dtype=np.int32)
    triangles = np.concatenate([np.empty((0, 3), dtype=np.int32), *tri]).astype(np.int32)
    of_tri = np.concatenate([np.empty(0, dtype=np.int32), *member]).astype(np.int32)
    host = {"names": tuple(m.name for m in builder.membranes), "body": bodies, "triangles": triangles}
    device = {
        "tri_node": triangles,
        "tri_membrane": of_tri,
        "tri_gradient": np.concatenate([np.empty((0, 4)), *gradient]),
        "tri_volume": np.concatenate([np.empty(0), *volume]),
        "element_body": bodies[of_tri],
    }
    return host, device, added
