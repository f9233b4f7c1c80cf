"""Tetrahedral meshes: boxes, checks, repairs, surfaces and quality.

Lengths in metres. A tetrahedron (a, b, c, d) has positive volume det[b - a, c - a, d - a] / 6.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp import checks
from softwarp.checks import FARTHEST

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int32]

# Corners of the four faces of a positive tetrahedron, each outward (counter-clockwise from outside).
_FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])

DEGENERATE = 1e-8  # 6 V / (longest edge)^3 below which a tetrahedron counts as flat; 0.7 for a regular one
NEAREST = 1e-9  # m, least extent of a mesh
MOST_CELLS = 100_000_000  # of a generated box
COINCIDENT = 1e-9  # distance between two nodes, relative to the size of the mesh, below which they are one


class MeshError(ValueError):
    """A mesh that cannot be used; the message names the mesh, the entry and the remedy."""


@dataclass(frozen=True, eq=False)
class TetMesh:
    """A solid of linear tetrahedra, checked on construction.

    Args:
        nodes: Positions [m], shape (node, 3), float64.
        tets: Corners, shape (tet, 4), int32, positive volume.
        name: What messages call it.

    Raises:
        MeshError: If ``check_tets`` refuses the arrays.
    """

    nodes: FloatArray
    tets: IntArray
    name: str = "mesh"

    def __post_init__(self) -> None:
        check_tets(self.nodes, self.tets, name=self.name)
        object.__setattr__(self, "nodes", np.ascontiguousarray(self.nodes, dtype=np.float64))
        object.__setattr__(self, "tets", np.ascontiguousarray(self.tets, dtype=np.int32))

    @property
    def tet_volumes(self) -> FloatArray:
        """Volume of every tetrahedron [m^3], shape (tet,)."""
        return tet_volumes(self.nodes, self.tets)

    @property
    def volume(self) -> float:
        """Volume of the solid [m^3]."""
        return float(self.tet_volumes.sum())

    @property
    def bounds(self) -> FloatArray:
        """Lowest and highest corner of the bounding box [m], shape (2, 3)."""
        return bounding_box(self.nodes)

    def surface(self) -> IntArray:
        """Boundary triangles, outward, corners indexing ``nodes``, shape (tri, 3)."""
        return tet_surface(self.tets)


@dataclass(frozen=True, eq=False)
class SurfaceMesh:
    """Triangles without a volume mesh: good for pictures and colliders, not for a soft body.

    Args:
        nodes: Positions [m], shape (node, 3), float64.
        triangles: Corners, shape (tri, 3), int32.
        name: What messages call it.

    Raises:
        MeshError: If positions are not finite or a triangle names a missing node.
    """

    nodes: FloatArray
    triangles: IntArray
    name: str = "surface"

    def __post_init__(self) -> None:
        nodes, triangles = _check_arrays(self.nodes, self.triangles, 3, "triangle", self.name)
        object.__setattr__(self, "nodes", np.ascontiguousarray(nodes, dtype=np.float64))
        object.__setattr__(self, "triangles", np.ascontiguousarray(triangles, dtype=np.int32))

    @property
    def tets(self) -> IntArray:
        """Never available: a surface has no tetrahedra.

        Raises:
            MeshError: Always, with the way to get them.
        """
        raise MeshError(
            f"mesh {self.name!r} is a surface of {len(self.triangles)} triangles and has no tetrahedra; fill it with "
            f"softwarp's mesher, meshing.tetrahedralize(surface, edge_length=...)"
        )

    @property
    def bounds(self) -> FloatArray:
        """Lowest and highest corner of the bounding box [m], shape (2, 3)."""
        return bounding_box(self.nodes)


def box(size: Sequence[float], cells: Sequence[int], *, name: str = "box") -> TetMesh:
    """A box from the origin to ``size``, each cell cut into six tetrahedra (Kuhn).

    Node ``i + (nx + 1) (j + (ny + 1) k)`` lies at ``(i Lx / nx, j Ly / ny, k Lz / nz)``. The six share the diagonal
    from the lowest to the highest corner of the cell: one per order in which the three axes are walked.

    Args:
        size: Edge lengths (Lx, Ly, Lz) [m].
        cells: Cells along each axis (nx, ny, nz).
        name: What messages call the mesh.

    Returns:
        (nx + 1)(ny + 1)(nz + 1) nodes and 6 nx ny nz tetrahedra, cell by cell with x fastest.

    Raises:
        MeshError: If a length or a count is not positive.
    """
    need = "be three positive lengths in metres"
    try:
        length = checks.array(size, f"mesh {name!r}: size", (3,), above=0.0, high=FARTHEST, need=need)
        need = f"be three integers of at least 1, together at most {MOST_CELLS} cells"
        count = checks.integers(cells, f"mesh {name!r}: cells", (3,), low=1, need=need).astype(np.int64)
    except ValueError as error:
        raise MeshError(str(error)) from None
    if math.prod(count.tolist()) > MOST_CELLS:
        raise MeshError(checks.refusal(f"mesh {name!r}: cells", need, cells))

    axes = [np.arange(n + 1) * (extent / n) for n, extent in zip(count, length, strict=True)]
    z, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    nodes = np.stack([x, y, z], axis=-1).reshape(-1, 3)

    stride = np.array([1, count[0] + 1, (count[0] + 1) * (count[1] + 1)])
    k, j, i = np.meshgrid(*(np.arange(n) for n in count[::-1]), indexing="ij")
    lowest = (i * stride[0] + j * stride[1] + k * stride[2]).reshape(-1)
    offsets = []
    for p, q, r in itertools.permutations(range(3)):
        path = [0, stride[p], stride[p] + stride[q], stride.sum()]
        if (q - p) * (r - q) * (r - p) < 0:  # odd: walk the two middle corners the other way round
            path[1], path[2] = path[2], path[1]
        offsets.append(path)
    tets = lowest[:, None, None] + np.array(offsets)[None]
    return TetMesh(nodes, tets.reshape(-1, 4).astype(np.int32), name)


def tet_volumes(nodes: ArrayLike, tets: ArrayLike) -> FloatArray:
    """Signed volume of every tetrahedron [m^3], shape (tet,)."""
    nodes, tets = mesh_arrays(nodes, tets, 4)
    x = nodes[tets]
    e = x[:, 1:] - x[:, :1]
    return np.asarray(np.einsum("ij,ij->i", e[:, 0], np.cross(e[:, 1], e[:, 2])) / 6.0)


def rest_geometry(nodes: FloatArray, tets: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Shape gradients of corners 1 to 3 (tet, 9), volumes (tet,) and rest frames by rows (tet, 9)."""
    x = nodes[tets].reshape(-1, 4, 3)
    edges = x[:, 1:] - x[:, :1]  # rows are edges
    volume = np.linalg.det(edges) / 6.0
    gradient = np.linalg.inv(edges).transpose(0, 2, 1)  # row b is grad N_b
    e1 = edges[:, 0] / np.linalg.norm(edges[:, 0], axis=1, keepdims=True)
    e3 = np.cross(e1, edges[:, 1])
    e3 /= np.linalg.norm(e3, axis=1, keepdims=True)
    frame = np.stack([e1, np.cross(e3, e1), e3], axis=2)  # columns are axes
    return (
        gradient.reshape(-1, 9).astype(np.float64),
        np.asarray(volume),
        np.asarray(frame.reshape(-1, 9), dtype=np.float64),
    )


def check_tets(nodes: ArrayLike, tets: ArrayLike, *, name: str = "mesh") -> None:
    """Refuse tetrahedra on which a simulation would fail or lie.

    Args:
        nodes: Positions [m], shape (node, 3).
        tets: Corners, shape (tet, 4), integer.
        name: What messages call the mesh.

    Raises:
        MeshError: On a wrong shape or type, no tetrahedra, positions that are not finite, corners out of range,
            repeated corners, repeated tetrahedra, coincident or unused nodes, flat or inverted tetrahedra, or a face
            shared by more than two.
    """
    x, t = _check_arrays(nodes, tets, 4, "tetrahedron", name)
    _check_members(x, t, "tetrahedron", "tets", name)
    _check_volumes(x, t, name)
    boundary(t, name)


def _check_members(x: FloatArray, t: NDArray[Any], kind: str, called: str, name: str) -> None:
    """Nodes that no element has, nodes at one place, and elements that are there twice."""
    unused = np.flatnonzero(np.bincount(t.reshape(-1), minlength=len(x)) == 0)
    if unused.size:
        raise MeshError(
            f"mesh {name!r}: {unused.size} of {len(x)} nodes belong to no {kind} (first: {_first(unused)}) and "
            f"would move freely; drop them with meshing.compact(nodes, {called})"
        )
    first, second = _coincident_pairs(x)
    if first.size:
        raise MeshError(
            f"mesh {name!r}: {first.size} nodes coincide with another (first: {first[0]} and {second[0]} at "
            f"{x[first[0]].tolist()} m); the parts beside them are not joined. Weld them in the mesher, or with "
            f"meshing.weld(nodes, {called})"
        )
    _, index, inverse = np.unique(np.sort(t, axis=1), axis=0, return_index=True, return_inverse=True)
    repeated = np.flatnonzero(index[inverse.reshape(-1)] != np.arange(len(t)))
    if repeated.size:
        raise MeshError(
            f"mesh {name!r}: {repeated.size} {kind} rows repeat the corners of another (first: {_first(repeated)}); "
            f"delete the copies"
        )


def _check_arrays(
    nodes: ArrayLike, elements: ArrayLike, corners: int, kind: str, name: str
) -> tuple[FloatArray, NDArray[Any]]:
    """Shapes, types, ranges and repeated corners; returns both as arrays."""
    x, t = checks.as_array(nodes), checks.as_array(elements)
    if x.ndim != 2 or x.shape[1] != 3 or x.dtype.kind not in "fiu":
        raise MeshError(f"mesh {name!r}: nodes must be numbers of shape (node, 3) [m], got {x.dtype} {x.shape}")
    if t.size == 0:
        raise MeshError(f"mesh {name!r}: holds no {kind}; at least one is needed")
    if t.ndim != 2 or t.shape[1] != corners:
        raise MeshError(f"mesh {name!r}: corners must have shape ({kind}, {corners}), got {t.shape}")
    if not np.issubdtype(t.dtype, np.integer):
        raise MeshError(f"mesh {name!r}: corners must be integers, got {t.dtype}; convert with .astype(numpy.int32)")
    x = x.astype(np.float64)
    broken = np.flatnonzero(~np.isfinite(x).all(axis=1))
    if broken.size:
        raise MeshError(f"mesh {name!r}: {broken.size} nodes are not finite (first: {_first(broken)}); repair them")
    extent = float(np.ptp(x, axis=0).max()) if len(x) else 0.0
    if np.abs(x).max(initial=0.0) > FARTHEST or 0.0 < extent < NEAREST:
        raise MeshError(
            f"mesh {name!r}: nodes must lie within {FARTHEST:g} m of the origin and span {NEAREST:g} m at least, got "
            f"coordinates up to {np.abs(x).max():.3g} m and an extent of {extent:.3g} m; scale the mesh to metres"
        )
    outside = np.flatnonzero(((t < 0) | (t >= len(x))).any(axis=1))
    if outside.size:
        raise MeshError(
            f"mesh {name!r}: {outside.size} of {len(t)} {kind} rows name a missing node (first: row {outside[0]}, "
            f"corners {t[outside[0]].tolist()}); corners count from 0 to {len(x) - 1}"
        )
    rows = np.sort(t, axis=1)
    pinched = np.flatnonzero((rows[:, 1:] == rows[:, :-1]).any(axis=1))
    if pinched.size:
        raise MeshError(
            f"mesh {name!r}: {pinched.size} {kind} rows name a node twice (first: {_first(pinched)}); delete them"
        )
    return x, t


def _check_volumes(x: FloatArray, t: NDArray[Any], name: str) -> None:
    """Refuse flat and inverted tetrahedra."""
    volume = tet_volumes(x, t)
    corner = x[t]
    longest = np.linalg.norm(corner[:, EDGES[:, 0]] - corner[:, EDGES[:, 1]], axis=2).max(axis=1)
    flat = np.flatnonzero(6.0 * np.abs(volume) < DEGENERATE * longest**3)
    if flat.size:
        raise MeshError(
            f"mesh {name!r}: {flat.size} of {len(t)} tetrahedra are flat (first: {_first(flat)}; volume of tetrahedron "
            f"{flat[0]}: {volume[flat[0]]:.3g} m^3 on an edge of {longest[flat[0]]:.3g} m); remesh with a quality limit"
        )
    inverted = np.flatnonzero(volume < 0.0)
    if inverted.size:
        raise MeshError(
            f"mesh {name!r}: {inverted.size} of {len(t)} tetrahedra are inverted, that is of negative volume (first: "
            f"{_first(inverted)}); exchange two corners of each with tets = meshing.orient(nodes, tets), or read the "
            f"file with orient=True"
        )


def _corners(elements: ArrayLike, columns: int | None = None) -> IntArray:
    """Corners of elements as 32-bit integers of their own.

    Raises:
        MeshError: If they are no integers that these can hold, or not ``columns`` to an element.
    """
    try:
        return checks.integers(elements, "corners", (None, columns))
    except ValueError as error:
        raise MeshError(str(error)) from None


def mesh_arrays(nodes: ArrayLike, elements: ArrayLike, columns: int | None = None) -> tuple[FloatArray, IntArray]:
    """Nodes (node, 3) and corners (element, columns), before anything is made of them.

    Raises:
        MeshError: For no nodes or elements, other shapes and types, and corners that are not among the nodes.
    """
    t = _corners(elements, columns)
    x = checks.as_array(nodes)
    if x.dtype.kind not in "fiu" or x.ndim != 2 or x.shape[1] != 3 or not len(x):
        raise MeshError(checks.refusal("nodes [m]", "be numbers in shape (node, 3)", nodes))
    if not t.size or t.max() >= len(x):
        need = f"hold at least one element, and numbers of the {len(x)} nodes alone"
        raise MeshError(checks.refusal("corners", need, elements))
    return x.astype(np.float64, copy=False), t


def orient(nodes: ArrayLike, tets: ArrayLike) -> IntArray:
    """Corners with the last two exchanged wherever the volume is negative, shape (tet, 4)."""
    fixed = _corners(tets, 4)
    inverted = tet_volumes(nodes, fixed) < 0.0
    fixed[inverted] = fixed[inverted][:, [0, 1, 3, 2]]
    return fixed


def compact(nodes: ArrayLike, tets: ArrayLike) -> tuple[FloatArray, IntArray]:
    """Drop the nodes that no tetrahedron uses; the others keep their order.

    Args:
        nodes: Positions [m], shape (node, 3).
        tets: Corners of tetrahedra, or of triangles and other elements, shape (element, n).

    Raises:
        MeshError: For other shapes and types, and corners that are not among the nodes.
    """
    x, t = mesh_arrays(nodes, tets)
    used = np.bincount(t.reshape(-1), minlength=len(x)) > 0
    renumbered = np.cumsum(used) - 1
    return x[used], renumbered[t].astype(np.int32)


def weld(nodes: ArrayLike, tets: ArrayLike) -> tuple[FloatArray, IntArray]:
    """Join nodes that coincide within rounding: each takes the number of the first of them, which stays in place.

    Args:
        nodes: Positions [m], shape (node, 3).
        tets: Corners of tetrahedra, or of triangles and other elements, shape (element, n).

    Raises:
        MeshError: For other shapes and types, and corners that are not among the nodes.
    """
    x, t = mesh_arrays(nodes, tets)
    keep = np.arange(len(x))
    first, second = _coincident_pairs(x)
    while not np.array_equal(keep[first], keep[second]):
        lowest = np.minimum(keep[first], keep[second])
        np.minimum.at(keep, first, lowest)
        np.minimum.at(keep, second, lowest)
    return compact(x, keep[t])


def tet_surface(tets: ArrayLike) -> IntArray:
    """Boundary triangles of a tetrahedral mesh, outward where the tetrahedra are positive.

    Args:
        tets: Corners, shape (tet, 4), positive volume.

    Returns:
        Corners of the faces that belong to one tetrahedron only, shape (tri, 3), in the order of the tetrahedra.

    Raises:
        MeshError: If three or more tetrahedra share a face, and for other shapes and types.
    """
    return boundary(_corners(tets, 4), "mesh")[0]


def boundary(t: NDArray[Any], name: str) -> tuple[IntArray, IntArray]:
    """Outward boundary triangles, shape (tri, 3), and the tetrahedron behind each, shape (tri,)."""
    faces = t[:, _FACES].reshape(-1, 3)
    low, middle, high = np.sort(faces, axis=1).astype(np.int64).T
    span = int(t.max()) + 1
    _, inverse, count = np.unique((low * span + middle) * span + high, return_inverse=True, return_counts=True)
    shared = count[inverse.reshape(-1)]
    if shared.max() > 2:
        worst = int(shared.argmax())
        raise MeshError(
            f"mesh {name!r}: face {faces[worst].tolist()} belongs to {shared[worst]} tetrahedra, more than two: they "
            f"overlap; delete the surplus ones or remesh"
        )
    free = np.flatnonzero(shared == 1)
    return faces[free].astype(np.int32), (free // 4).astype(np.int32)


def radius_ratio(nodes: ArrayLike, tets: ArrayLike) -> FloatArray:
    """Shape quality 3 (inscribed radius) / (circumscribed radius): 1 for a regular tetrahedron, 0 for a flat one."""
    nodes, tets = mesh_arrays(nodes, tets, 4)
    x = nodes[tets]
    a, b, c = np.moveaxis(x[:, 1:] - x[:, :1], 1, 0)
    bc, ca, ab = np.cross(b, c), np.cross(c, a), np.cross(a, b)
    six_volume = np.abs(np.einsum("ij,ij->i", a, bc))
    area = sum(np.linalg.norm(n, axis=1) for n in (bc, ca, ab, bc + ca + ab)) / 2.0
    square = [np.einsum("ij,ij->i", v, v)[:, None] for v in (a, b, c)]
    circum = np.linalg.norm(square[0] * bc + square[1] * ca + square[2] * ab, axis=1) / (2.0 * six_volume)
    return np.asarray(3.0 * (six_volume / (2.0 * area)) / circum)


def min_dihedral(nodes: ArrayLike, tets: ArrayLike) -> FloatArray:
    """Smallest angle between two faces of every tetrahedron [degree], shape (tet,); 70.5 for a regular one."""
    nodes, tets = mesh_arrays(nodes, tets, 4)
    x = nodes[tets]
    corner = x[:, _FACES]
    normal = np.cross(corner[:, :, 1] - corner[:, :, 0], corner[:, :, 2] - corner[:, :, 0])
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    cosine = [-np.einsum("ij,ij->i", normal[:, i], normal[:, j]) for i, j in EDGES]
    return np.asarray(np.degrees(np.arccos(np.clip(np.max(cosine, axis=0), -1.0, 1.0))))


def _coincident_pairs(x: FloatArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of nodes closer than rounding: found as neighbours on two grids shifted by half a cell."""
    low, high = bounding_box(x)
    cell = max(float(np.linalg.norm(high - low)) * COINCIDENT, np.finfo(np.float64).tiny)
    pairs = []
    for shift in (0.0, 0.5):
        key = np.floor((x - low) / cell + shift).astype(np.int64)
        order = np.lexsort(key.T)
        same = (key[order][1:] == key[order][:-1]).all(axis=1)
        pairs.append(np.sort(np.stack([order[:-1][same], order[1:][same]], axis=1), axis=1))
    first, second = np.unique(np.concatenate(pairs), axis=0).T
    return first, second


def bounding_box(x: FloatArray) -> FloatArray:
    """Lowest and highest corner [m], shape (2, 3)."""
    return np.stack([x.min(axis=0), x.max(axis=0)])


def _first(ids: NDArray[Any], count: int = 5) -> str:
    shown = ", ".join(str(i) for i in ids[:count])
    return f"{shown}, ..." if len(ids) > count else shown
