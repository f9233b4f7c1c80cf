"""Closed triangulated surfaces, their edges and rings, and thin triangles: cavities and membranes. Lengths in metres.

The volume inside triangles (a, b, c) that are counter-clockwise from outside is V = 1/6 sum a . (b x c).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp import checks
from softwarp.meshing.tets import FloatArray, IntArray, MeshError, _check_arrays, _corners, boundary, mesh_arrays

FLAT = 1e-9  # |V| / area^(3/2) below which a closed surface counts as empty; 0.094 for a sphere
SLIVER = 1e-8  # 2 area / (longest edge)^2 below which a triangle counts as a line; 0.87 for an equilateral one
ROUNDING = 1e-9  # product of weights that the tangent of a chamber leaves out


def check_closed(vertices: ArrayLike, triangles: ArrayLike, *, name: str = "surface") -> IntArray:
    """Refuse a surface that encloses no volume, and return its triangles outward.

    A surface that is consistent but inward as a whole is turned over; one whose triangles disagree is refused, because
    its volume would be wrong without a sign of it. Several separate parts are allowed if all have the same orientation.

    Args:
        vertices: Positions [m], shape (vertex, 3).
        triangles: Corners, shape (tri, 3), integer.
        name: What messages call the surface.

    Returns:
        The triangles, counter-clockwise from outside, shape (tri, 3), in the given order.

    Raises:
        MeshError: On a wrong shape, an unused vertex, an edge that is open, that more than two triangles share, or
            whose two triangles disagree about the outside, parts of opposite orientation, or no volume. The message
            gives the edge's vertices with their positions.
    """
    x, t = _check_arrays(vertices, triangles, 3, "triangle", name)
    x = x.astype(np.float64)
    unused = np.flatnonzero(np.bincount(t.reshape(-1), minlength=len(x)) == 0)
    if unused.size:
        raise MeshError(
            f"surface {name!r}: {unused.size} of {len(x)} vertices belong to no triangle (first: {unused[0]}); drop "
            f"them with meshing.compact(vertices, triangles)"
        )
    _check_edges(x, t, name)
    part = surface_parts(t)
    volume = np.bincount(part, _cone_volumes(x, t))
    area = np.bincount(part, triangle_areas(x, t))
    empty = np.flatnonzero(np.abs(volume) < FLAT * area**1.5)
    if empty.size:
        first = int(np.flatnonzero(part == empty[0])[0])
        raise MeshError(
            f"surface {name!r}: the part with triangle {first} encloses no volume ({volume[empty[0]]:.3g} m^3 in "
            f"{area[empty[0]]:.3g} m^2); a chamber needs a volume at rest, so draw it slightly open"
        )
    if volume.min() < 0.0 < volume.max():
        wrong, right = (int(np.flatnonzero(part == i)[0]) for i in (volume.argmin(), volume.argmax()))
        raise MeshError(
            f"surface {name!r}: the part with triangle {wrong} is inward ({volume.min():.3g} m^3), the part with "
            f"triangle {right} outward ({volume.max():.3g} m^3); turn one over with triangles[:, ::-1], or make "
            f"separate chambers of them"
        )
    outward = t[:, ::-1] if volume[0] < 0.0 else t
    return np.ascontiguousarray(outward, dtype=np.int32)


def _check_edges(x: FloatArray, t: NDArray[Any], name: str) -> None:
    """Refuse open, branching and badly oriented edges."""
    start, end = t.reshape(-1).astype(np.int64), np.roll(t, -1, axis=1).reshape(-1).astype(np.int64)
    key = np.minimum(start, end) * len(x) + np.maximum(start, end)
    _, inverse, count = np.unique(key, return_inverse=True, return_counts=True)
    shared = count[inverse.reshape(-1)]

    def edge(half: int) -> str:
        a, b = int(start[half]), int(end[half])
        return f"edge {a}-{b} from {_text(x[a])} to {_text(x[b])} m"

    opened = np.flatnonzero(shared == 1)
    if opened.size:
        raise MeshError(
            f"surface {name!r} is open: {edge(opened[0])} belongs to triangle {opened[0] // 3} only ({opened.size} "
            f"such edges); close the hole, and join coincident vertices with meshing.weld(vertices, triangles)"
        )
    branching = np.flatnonzero(shared > 2)
    if branching.size:
        users = np.flatnonzero(key == key[branching[0]]) // 3
        raise MeshError(
            f"surface {name!r} is not a manifold: {edge(branching[0])} belongs to {users.size} triangles "
            f"{users.tolist()}, and exactly two are needed; delete inner walls and repeated triangles"
        )
    order = np.argsort(key, kind="stable")
    first, second = order[0::2], order[1::2]
    clash = np.flatnonzero(start[first] == start[second])
    if clash.size:
        pair = min(zip(first[clash], second[clash], strict=True))
        raise MeshError(
            f"surface {name!r} is badly oriented: triangles {pair[0] // 3} and {pair[1] // 3} run along "
            f"{edge(pair[0])} in the same direction ({clash.size} such edges), so one of them is inward; use "
            f"meshing.orient_surface(triangles)"
        )


def surface_volume(vertices: ArrayLike, triangles: ArrayLike) -> float:
    """Volume [m^3] inside a closed surface, positive where its triangles are outward."""
    return float(_cone_volumes(*mesh_arrays(vertices, triangles, 3)).sum())


def _cone_volumes(x: FloatArray, t: NDArray[Any]) -> FloatArray:
    """Signed volumes [m^3] between the triangles and the first vertex, shape (tri,)."""
    a, b, c = np.moveaxis((x - x[t[0, 0]])[t], 1, 0)
    return np.asarray(np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0)


def triangle_areas(vertices: ArrayLike, triangles: ArrayLike) -> FloatArray:
    """Area of every triangle [m^2], shape (tri,)."""
    x, t = mesh_arrays(vertices, triangles, 3)
    corner = x[t]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    return np.asarray(0.5 * np.linalg.norm(normal, axis=1))


def winding(point: FloatArray, corner: FloatArray) -> float:
    """How often closed triangles go around a point: their solid angle (van Oosterom and Strackee, 1983) over 4 pi."""
    a, b, c = np.moveaxis(corner - point, 1, 0)
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    ab, bc, ca = (np.einsum("ij,ij->i", u, v) for u, v in ((a, b), (b, c), (c, a)))
    half = np.arctan2(np.einsum("ij,ij->i", a, np.cross(b, c)), la * lb * lc + ab * lc + bc * la + ca * lb)
    return float(half.sum() / (2.0 * np.pi))


def mean_edge(points: ArrayLike, triangles: ArrayLike) -> float:
    """Mean length of the sides of triangles [m], those between two of them twice."""
    corner = np.asarray(points)[np.asarray(triangles)]
    return float(np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).mean())


def surface_parts(triangles: ArrayLike) -> IntArray:
    """Number of the connected part of every triangle, shape (tri,); parts are numbered as they appear."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    t = np.asarray(triangles)
    count = int(t.max()) + 1
    joined = (np.concatenate([t[:, 0], t[:, 1]]), np.concatenate([t[:, 1], t[:, 2]]))
    label = connected_components(coo_array((np.ones(2 * len(t), dtype=bool), joined), shape=(count, count)), False)[1]
    found, index, inverse = np.unique(label[t[:, 0]], return_index=True, return_inverse=True)
    rank = np.empty(found.size, dtype=np.int32)
    rank[np.argsort(index)] = np.arange(found.size, dtype=np.int32)
    return rank[inverse.reshape(-1)]


def orient_surface(triangles: ArrayLike) -> IntArray:
    """Triangles turned over where needed, so that each agrees with the first one of its part, shape (tri, 3).

    Raises:
        MeshError: If an edge belongs to more than two triangles, or if there is no orientation (a Moebius strip).
    """
    t = _corners(triangles, 3)
    start, end = t.reshape(-1).astype(np.int64), np.roll(t, -1, axis=1).reshape(-1).astype(np.int64)
    key = np.minimum(start, end) * (int(t.max()) + 1) + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    run = np.flatnonzero(np.concatenate([[True], np.diff(key[order]) > 0, [True]]))
    if np.diff(run).max() > 2:
        worst = order[run[int(np.diff(run).argmax())]]
        raise MeshError(
            f"edge {start[worst]}-{end[worst]} belongs to more than two triangles, which cannot be oriented; delete "
            f"inner walls and repeated triangles"
        )
    paired = run[:-1][np.diff(run) == 2]
    neighbours: list[list[tuple[int, bool]]] = [[] for _ in t]
    for one, other in zip(order[paired], order[paired + 1], strict=True):
        same = bool(start[one] == start[other])
        neighbours[one // 3].append((int(other // 3), same))
        neighbours[other // 3].append((int(one // 3), same))
    turned = np.full(len(t), -1, dtype=np.int8)
    for seed in range(len(t)):
        if turned[seed] >= 0:
            continue
        turned[seed] = 0
        front = [seed]
        while front:
            here = front.pop()
            for there, same in neighbours[here]:
                wanted = turned[here] ^ int(same)
                if turned[there] < 0:
                    turned[there] = wanted
                    front.append(there)
                elif turned[there] != wanted:
                    raise MeshError(f"triangles {here} and {there} cannot be oriented alike: the surface has one side")
    t[turned == 1] = t[turned == 1][:, ::-1]
    return t


def voids(nodes: ArrayLike, tets: ArrayLike) -> list[IntArray]:
    """Closed chambers inside a tetrahedral mesh: for each the triangles around it, outward from the chamber's air.

    Args:
        nodes: Positions [m], shape (node, 3).
        tets: Corners, shape (tet, 4), positive volume.

    Returns:
        One array (tri, 3) of node indices per chamber, in the order of the tetrahedra; empty for a body without any.

    Raises:
        MeshError: For other shapes and types, corners that are not among the nodes, and tetrahedra that overlap.
    """
    x, t = mesh_arrays(nodes, tets, 4)
    skin = boundary(t, "mesh")[0]
    part = surface_parts(skin)
    pieces = [skin[part == i][:, ::-1] for i in range(int(part.max()) + 1)]
    return [np.ascontiguousarray(piece) for piece in pieces if surface_volume(x, piece) > 0.0]


def surface_rings(triangles: ArrayLike, count: int) -> tuple[IntArray, IntArray]:
    """For every vertex a the other corners (b, c) of its triangles (a, b, c).

    Args:
        triangles: Corners, shape (tri, 3).
        count: Number of vertices.

    Returns:
        start (count + 1,) and ring (entry, 2): vertex a has the pairs ``ring[start[a] : start[a + 1]]``.
    """
    t = np.asarray(triangles)
    vertex = t.reshape(-1)
    others = np.stack([np.roll(t, -1, axis=1).reshape(-1), np.roll(t, -2, axis=1).reshape(-1)], axis=1)
    order = np.argsort(vertex, kind="stable")
    start = np.searchsorted(vertex[order], np.arange(count + 1))
    return start.astype(np.int32), others[order].astype(np.int32)


def surface_edges(triangles: ArrayLike) -> tuple[IntArray, IntArray]:
    """Edges of a closed oriented surface and the corners beside them.

    Returns:
        ends (edge, 2): i, j; opposite (edge, 2): k, l of the triangles (i, j, k) and (j, i, l) that share the edge. The
        volume has d2V/dx_i dx_j = [x_l - x_k]x / 6 and no other second derivatives.
    """
    t = np.asarray(triangles)
    start, end = t.reshape(-1).astype(np.int64), np.roll(t, -1, axis=1).reshape(-1).astype(np.int64)
    third = np.roll(t, -2, axis=1).reshape(-1)
    span = int(t.max()) + 1
    forward, backward = np.flatnonzero(start < end), np.flatnonzero(start > end)
    forward = forward[np.argsort(start[forward] * span + end[forward])]
    backward = backward[np.argsort(end[backward] * span + start[backward])]
    ends = np.stack([start[forward], end[forward]], axis=1)
    return ends.astype(np.int32), np.stack([third[forward], third[backward]], axis=1).astype(np.int32)


def edge_couplings(
    ends: ArrayLike, point_node: ArrayLike, point_weight: ArrayLike
) -> tuple[IntArray, IntArray, IntArray, FloatArray]:
    """Which nodes the tangent of a chamber ties together.

    With s the vector of an edge from ``edge_stiffness`` of ``kernels.rows.cavity``, the tangent's block of nodes m and
    n is the sum of weight [s]x over the entries (edge, m, n); the block of n and m is its transpose.

    Args:
        ends: Points of every edge, shape (edge, 2).
        point_node: Nodes that carry the points, -1 for none, shape (point, 4).
        point_weight: Their weights, shape (point, 4).

    Returns:
        edge, m, n and weight of every entry; each pair of nodes appears once per edge, with m > n.
    """
    end = np.asarray(ends)
    node, weight = np.asarray(point_node), np.asarray(point_weight, dtype=np.float64)
    weight = np.where(node >= 0, weight, 0.0)
    first, second = end[:, 0], end[:, 1]
    m, n = np.repeat(node[first], 4, axis=1), np.tile(node[second], (1, 4))
    product = (weight[first][:, :, None] * weight[second][:, None, :]).reshape(len(end), 16)
    edge = np.broadcast_to(np.arange(len(end))[:, None], m.shape)
    keep = (m >= 0) & (n >= 0) & (m != n) & (np.abs(product) > ROUNDING)
    edge, m, n, product = edge[keep], m[keep].astype(np.int64), n[keep].astype(np.int64), product[keep]
    product = np.where(m > n, product, -product)  # [s]x turns its sign where the nodes change places
    m, n = np.maximum(m, n), np.minimum(m, n)
    span = int(node.max()) + 1
    key, inverse = np.unique((edge * span + m) * span + n, return_inverse=True)
    total = np.bincount(inverse.reshape(-1), product, minlength=key.size)
    pair = key % (span * span)
    columns = (key // (span * span), pair // span, pair % span)
    used = np.abs(total) > ROUNDING
    i, j, k = (column[used].astype(np.int32) for column in columns)
    return i, j, k, total[used].astype(np.float64)


@dataclass(frozen=True, eq=False)
class MembraneGeometry:
    """Rest geometry of thin triangles.

    Attributes:
        triangles: Corners, shape (tri, 3), int32.
        gradient: Shape gradients of corners 1 and 2 in the rest plane [1/m], shape (tri, 4): g1x, g1y, g2x, g2y.
        area: Rest areas [m^2], shape (tri,).
        thickness: Thicknesses [m], shape (tri,).
        volume: area times thickness [m^3], shape (tri,).
        node_volume: A third of the volumes around every node [m^3], shape (node,), for its mass.
    """

    triangles: IntArray
    gradient: FloatArray
    area: FloatArray
    thickness: FloatArray
    volume: FloatArray
    node_volume: FloatArray


def membrane_geometry(
    nodes: ArrayLike, triangles: ArrayLike, thickness: ArrayLike, *, name: str = "membrane"
) -> MembraneGeometry:
    """Rest geometry of the triangles of a membrane that is glued to nodes; the given shape is stress-free.

    Args:
        nodes: Positions [m], shape (node, 3).
        triangles: Corners, shape (tri, 3); the orientation is of no importance.
        thickness: Thickness [m], one or one per triangle.
        name: What messages call the membrane.

    Raises:
        MeshError: On a wrong shape, a thickness that is not positive, or a triangle without area.
    """
    x, t = _check_arrays(nodes, triangles, 3, "triangle", name)
    thick = _thicknesses(thickness, len(t), name)
    corner = x.astype(np.float64)[t]
    e1, e2 = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    area = triangle_areas(x, t)
    longest = np.linalg.norm(np.stack([e1, e2, e2 - e1]), axis=2).max(axis=0)
    flat = np.flatnonzero(2.0 * area < SLIVER * longest**2)
    if flat.size:
        raise MeshError(
            f"membrane {name!r}: triangle {flat[0]} has no area ({area[flat[0]]:.3g} m^2 on an edge of "
            f"{longest[flat[0]]:.3g} m); delete or remesh it"
        )
    length = np.linalg.norm(e1, axis=1)
    along = np.einsum("ij,ij->i", e1, e2) / length
    height = 2.0 * area / length
    zero = np.zeros(len(t))  # corners at (0, 0), (length, 0), (along, height)
    gradient = np.stack([1.0 / length, -along / (length * height), zero, 1.0 / height], axis=1)
    volume = area * thick
    node_volume = np.bincount(t.reshape(-1), np.repeat(volume / 3.0, 3), minlength=len(x))
    return MembraneGeometry(
        triangles=np.ascontiguousarray(t, dtype=np.int32),
        gradient=gradient,
        area=area,
        thickness=thick,
        volume=volume,
        node_volume=node_volume.astype(np.float64),
    )


def _thicknesses(thickness: ArrayLike, count: int, name: str) -> FloatArray:
    """One positive thickness per triangle."""
    thick = checks.as_array(thickness)
    if thick.dtype.kind not in "fiu":
        raise MeshError(checks.refusal(f"membrane {name!r}: thickness", "be a number or one per triangle", thickness))
    thick = thick.astype(np.float64)
    if thick.shape not in ((), (count,)):
        raise MeshError(
            f"membrane {name!r}: thickness must be one number or one per triangle ({count}), got shape {thick.shape}"
        )
    thick = np.broadcast_to(thick, count).copy()
    bad = np.flatnonzero(~(np.isfinite(thick) & (thick > checks.SMALLEST) & (thick <= checks.FARTHEST)))
    if bad.size:
        raise MeshError(
            f"membrane {name!r}: the thickness of triangle {bad[0]} is {thick[bad[0]]:g} m; give a positive length"
        )
    return thick


def _text(x: FloatArray) -> str:
    return "(" + ", ".join(f"{value:.6g}" for value in x) + ")"
