"""Solids given by samples of their signed distance on a regular grid."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp import checks
from softwarp.shapes.base import Features, FloatArray, IntArray, Kind, Shape, Solid, positive
from softwarp.shapes.mesh import Mesh, signed_distance, solid_of

BLOCK = 4.0  # spacings across a cube of points whose nearest triangles are searched together
MARGIN = 3.0  # spacings that a grid made from a mesh reaches beyond it
LARGEST = 2**27  # samples; half a gigabyte in float32
SLOPE = (0.5, 1.5)  # median slope at the surface between which samples count as distances

# The six tetrahedra of a cell (Kuhn): each walks the axes in one order; the odd ones have two corners exchanged.
_PATHS = [
    np.cumsum([[0, 0, 0], *np.eye(3, dtype=int)[list(order)]], axis=0) for order in itertools.permutations(range(3))
]
_TETS = np.array([p if np.linalg.det(p[1:] - p[0]) > 0 else p[[0, 2, 1, 3]] for p in _PATHS])
# Even reorderings of a tetrahedron's corners that put corner i, or the corners i and j, first.
_FIRST = ((0, 1, 2, 3), (1, 0, 3, 2), (2, 3, 0, 1), (3, 2, 1, 0))
_PAIRS = ((0, 1, 2, 3), (0, 2, 3, 1), (0, 3, 1, 2), (1, 2, 0, 3), (1, 3, 2, 0), (2, 3, 0, 1))


@dataclass(frozen=True, eq=False)
class SDF(Shape):
    """Solid where a sampled signed distance is negative; between samples it is trilinear.

    Args:
        values: Signed distance at the nodes [m], shape (nx, ny, nz), positive on the whole border.
        spacing: Distance between neighbouring nodes [m].
        origin: Position of node (0, 0, 0) [m].
        mesh: Surface that the samples were made from; it gives mass, features and pictures. None takes the triangles of
            the zero level, and as features one of their corners per cell.

    Raises:
        ValueError: If the samples are not finite, too few, do not enclose a solid, or are no distances in metres.
    """

    kind = Kind.GRID
    values: FloatArray
    spacing: float
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mesh: Mesh | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "spacing", positive("sdf", "spacing", self.spacing))
        origin = checks.as_array(self.origin)
        if origin.shape != (3,) or origin.dtype.kind not in "fiu" or not np.all(np.isfinite(origin)):
            raise ValueError(f"sdf: origin must be three finite coordinates [m], got {self.origin!r}")
        object.__setattr__(self, "origin", tuple(float(c) for c in origin))
        values = checks.as_array(self.values)
        if values.ndim != 3 or min(values.shape) < 3 or values.dtype.kind not in "fiu":
            raise ValueError(
                f"sdf: values must be numbers of shape (nx, ny, nz), at least 3 along each axis, got {values.dtype} "
                f"{values.shape}"
            )
        values = np.ascontiguousarray(values, dtype=np.float64)
        _check_values(values, self.spacing)
        object.__setattr__(self, "values", values)

    @classmethod
    def from_mesh(
        cls,
        vertices: ArrayLike,
        triangles: ArrayLike,
        spacing: float,
        *,
        margin: float | None = None,
        name: str = "sdf",
    ) -> SDF:
        """Sample the exact distance to a closed surface.

        Args:
            vertices: Positions [m], shape (v, 3).
            triangles: Corners, shape (t, 3), counter-clockwise from outside.
            spacing: Distance between nodes [m]; walls thinner than twice this are lost.
            margin: How far the grid reaches beyond the surface [m]; None takes three spacings.
            name: What messages call the shape.

        Raises:
            MeshError: If the surface is not closed, as for ``Mesh``.
            ValueError: If spacing or margin is not positive, or the grid would have more than 2^27 nodes.
        """
        mesh = Mesh(checks.as_array(vertices), checks.as_array(triangles), name=name)
        spacing = positive(f"sdf {name!r}", "spacing", spacing)
        margin = MARGIN * spacing if margin is None else positive(f"sdf {name!r}", "margin", margin)
        low, high = mesh.bounds
        cells = np.ceil((high - low + 2.0 * margin) / spacing)
        if np.prod(cells + 1.0) > LARGEST:
            raise ValueError(
                f"sdf {name!r}: a spacing of {spacing:g} m makes a grid of {' x '.join(f'{c + 1:.0f}' for c in cells)} "
                f"nodes, more than {LARGEST}; use a spacing of {coarser(high - low + 2.0 * margin):.2g} m or more"
            )
        origin = 0.5 * (low + high) - 0.5 * spacing * cells
        axes = [origin[c] + spacing * np.arange(int(cells[c]) + 1) for c in range(3)]
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        values = signed_distance(mesh, nodes.reshape(-1, 3), BLOCK * spacing).reshape(nodes.shape[:3])
        return cls(values, spacing, (float(origin[0]), float(origin[1]), float(origin[2])), mesh)

    @property
    def size(self) -> tuple[float, float, float]:
        """Extents of the grid [m]."""
        x, y, z = (self.spacing * (n - 1) for n in self.values.shape)
        return (x, y, z)

    def _solid(self) -> Solid:
        return self.mesh._solid() if self.mesh is not None else self._integrals

    @cached_property
    def _integrals(self) -> Solid:
        return solid_of(*self._level)

    @cached_property
    def _level(self) -> tuple[FloatArray, IntArray]:
        """Closed outward triangles of the zero level."""
        vertices, triangles = zero_level(self.values)
        return vertices * self.spacing + np.array(self.origin), triangles

    def distance(self, points: FloatArray) -> FloatArray:
        """Trilinear between samples; continued outside as kernels/collision/shapes.py does."""
        last = np.array(self.values.shape) - 1
        u = (points - np.array(self.origin)) / self.spacing
        inside = np.clip(u, 0.0, last)
        cell = np.minimum(inside.astype(np.int64), last - 1)
        t = inside - cell
        d, g = np.zeros(len(points)), np.zeros((len(points), 3))
        for o in np.ndindex(2, 2, 2):
            corner = self.values[tuple((cell + o).T)]
            sign = 2.0 * np.array(o) - 1.0
            w = (1.0 - np.array(o)) + sign * t
            d += corner * w.prod(axis=1)
            g += (corner[:, None] * sign) * np.stack([w[:, 1] * w[:, 2], w[:, 0] * w[:, 2], w[:, 0] * w[:, 1]], axis=1)
        away = (u - inside) * self.spacing
        n = g / np.maximum(np.linalg.norm(g, axis=1, keepdims=True), np.finfo(np.float64).tiny)
        return np.where(away.any(axis=1), np.linalg.norm(away + d[:, None] * n, axis=1), d)

    def features(self) -> Features:
        """Those of the mesh; without one, for each cell the corner of the zero level nearest to their mean in it."""
        if self.mesh is not None:
            return self.mesh.features()
        vertices = self._level[0]
        cell = np.floor((vertices - np.array(self.origin)) / self.spacing).astype(np.int64)
        _, inverse, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
        inverse = inverse.reshape(-1)
        mean = np.stack([np.bincount(inverse, x) / count for x in vertices.T], axis=1)
        away = np.linalg.norm(vertices - mean[inverse], axis=1)
        order = np.lexsort((away, inverse))
        first = order[np.searchsorted(inverse[order], np.arange(len(count)))]
        return Features.of(vertices[first])

    def surface(self, resolution: int = 32) -> tuple[FloatArray, IntArray]:
        """Triangles of the mesh, or of the zero level."""
        return self.mesh.surface() if self.mesh is not None else self._level


def _check_values(values: FloatArray, spacing: float) -> None:
    """Refuse samples that are not the distance to a solid inside the grid."""
    broken = np.argwhere(~np.isfinite(values))
    if len(broken):
        raise ValueError(f"sdf: {len(broken)} values are not finite (first: node {broken[0].tolist()}); repair them")
    if values.min() >= 0.0:
        raise ValueError(f"sdf: no value is negative (lowest {values.min():g} m), so nothing is solid; check the sign")
    border = np.ones(values.shape, dtype=bool)
    border[1:-1, 1:-1, 1:-1] = False
    cut = np.argwhere(border & (values <= 0.0))
    if len(cut):
        raise ValueError(
            f"sdf: the solid reaches the border of the grid at {len(cut)} nodes (first: node {cut[0].tolist()}, value "
            f"{values[tuple(cut[0])]:g} m); make the grid larger, or change the sign if the outside is negative"
        )
    corners = [
        values[tuple(slice(c, n - 1 + c) for c, n in zip(o, values.shape, strict=True))] for o in np.ndindex(2, 2, 2)
    ]
    crossing = (np.min(corners, axis=0) < 0.0) & (np.max(corners, axis=0) >= 0.0)
    gradient = [sum(v if o[c] else -v for o, v in zip(np.ndindex(2, 2, 2), corners, strict=True)) for c in range(3)]
    slope = float(np.median(np.sqrt(sum(np.square(g) for g in gradient))[crossing])) / (4.0 * spacing)
    if not SLOPE[0] < slope < SLOPE[1]:
        raise ValueError(
            f"sdf: across the surface the values change by {slope:.3g} m per metre, a distance by 1; give values and "
            f"spacing in metres, and distances rather than occupancy"
        )


def coarser(extent: FloatArray) -> float:
    """Spacing at which a grid over the extent has about as many nodes as are allowed."""
    return float(np.cbrt(np.prod(extent) / LARGEST)) * 1.05


def zero_level(values: FloatArray) -> tuple[FloatArray, IntArray]:
    """Closed outward triangles around negative samples, by marching tetrahedra; lengths in spacings.

    Args:
        values: Samples, shape (nx, ny, nz), positive on the border; those at zero count as outside.

    Returns:
        Vertices, shape (v, 3), one on every edge of a tetrahedron that changes sign, and corners, shape (t, 3).
    """
    shape = np.array(values.shape)
    inside = values < 0.0
    views = [inside[tuple(slice(c, n - 1 + c) for c, n in zip(o, shape, strict=True))] for o in np.ndindex(2, 2, 2)]
    count = np.sum(views, axis=0)
    cells = np.argwhere((count > 0) & (count < 8))
    corner = (cells[:, None, None] + _TETS[None]).reshape(-1, 4, 3)
    tet = np.ravel_multi_index(tuple(np.moveaxis(corner, -1, 0)), values.shape)
    solid = inside.reshape(-1)[tet]

    pieces: list[NDArray[Any]] = []  # triangles whose corners are tetrahedron edges, shape (., 3, 2)
    for i, order in enumerate(_FIRST):
        lone = [k == i for k in range(4)]
        for pattern, flip in ((lone, False), ([not k for k in lone], True)):
            a, b, c, d = tet[(solid == pattern).all(axis=1)][:, order].T
            pieces.append(_stack([(a, b), (a, d), (a, c)] if flip else [(a, b), (a, c), (a, d)]))
    for order in _PAIRS:
        pattern = [k in order[:2] for k in range(4)]
        a, b, c, d = tet[(solid == pattern).all(axis=1)][:, order].T
        pieces += [_stack([(a, c), (a, d), (b, d)]), _stack([(a, c), (b, d), (b, c)])]

    edges = np.sort(np.concatenate(pieces).reshape(-1, 2), axis=1)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    start, end = (np.stack(np.unravel_index(n, values.shape), axis=1).astype(np.float64) for n in unique.T)
    f, g = values.reshape(-1)[unique].T
    t = np.clip(f / (f - g), 1e-6, 1.0 - 1e-6)  # keeps corners apart where a sample is zero
    return start + t[:, None] * (end - start), inverse.reshape(-1, 3).astype(np.int32)


def _stack(edges: list[tuple[NDArray[Any], NDArray[Any]]]) -> NDArray[Any]:
    """Three edges of several tetrahedra as triangles, shape (n, 3, 2)."""
    return np.stack([np.stack(edge, axis=1) for edge in edges], axis=1)
