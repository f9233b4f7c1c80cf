"""Quadratic tetrahedra: six more nodes on the edges of a linear one. Theory: docs/theory/quadratic.md.

Nodes of an element: corners 0 to 3, then the middles of the edges 01, 02, 03, 12, 13, 23. With the barycentric
coordinates L_k the shape functions are L_k (2 L_k - 1) at corners and 4 L_k L_m between them. A mesh keeps its node
numbers when it is elevated; the new nodes follow. Everything that needs a shape rather than an element (surfaces,
embedded points, pictures) uses the eight linear tetrahedra between the ten nodes.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp import checks
from softwarp.meshing.tets import (
    EDGES,
    FloatArray,
    IntArray,
    MeshError,
    TetMesh,
    _check_arrays,
    boundary,
    check_tets,
    tet_volumes,
)

NODES = 10
LEAST_PART = 0.2  # of the straight element's volume per unit of L, below which edges are drawn back
ROUNDS = 5  # of halving
INNER = 0.5  # size of a tetrahedron at a Gauss point per that of the element, whose corners lie inside it
POINTS = 4  # Gauss points of an element, point q near corner q; they integrate polynomials of degree 2
# A vertex in the middle m of a quadratic edge from a to b stands at (4 m - (a + b) / 2) / 3. Four flat triangles then
# enclose the volume, and carry the pressure, of the curved face between six nodes (docs/theory/cavity.md).
MIDDLE_WEIGHTS = np.array([4.0 / 3.0, -1.0 / 6.0, -1.0 / 6.0])
NEAR, FAR = (5.0 + 3.0 * np.sqrt(5.0)) / 20.0, (5.0 - np.sqrt(5.0)) / 20.0  # L_q and the other L at point q

# Linear tetrahedra at the corners, and around each of the three diagonals of the octahedron between them.
_AT_CORNERS = ((0, 4, 5, 6), (4, 1, 7, 8), (5, 7, 2, 9), (6, 8, 9, 3))
_AROUND_DIAGONALS = (
    ((4, 9, 5, 6), (4, 9, 6, 8), (4, 9, 8, 7), (4, 9, 7, 5)),
    ((5, 8, 6, 4), (5, 8, 9, 6), (5, 8, 7, 9), (5, 8, 4, 7)),
    ((6, 7, 4, 5), (6, 7, 5, 9), (6, 7, 9, 8), (6, 7, 8, 4)),
)


@dataclass(frozen=True, eq=False)
class QuadraticMesh:
    """A solid of quadratic tetrahedra, checked on construction.

    Args:
        nodes: Positions [m], shape (node, 3), float64; corners and edge nodes.
        elements: Nodes of every element, shape (element, 10), int32.
        name: What messages call it.

    Raises:
        MeshError: If an array is broken, an edge node is not shared by the elements around its edge, or an edge node
            is so far from the middle of its edge that the element folds.
    """

    nodes: FloatArray
    elements: IntArray
    name: str = "mesh"

    def __post_init__(self) -> None:
        nodes, elements = checks.as_array(self.nodes), checks.as_array(self.elements)
        if elements.ndim != 2 or elements.shape[1] != NODES or not np.issubdtype(elements.dtype, np.integer):
            raise MeshError(
                f"mesh {self.name!r}: quadratic elements must be integers of shape (element, 10), got "
                f"{elements.dtype} {elements.shape}; elevate a linear mesh with meshing.elevate"
            )
        _check_arrays(nodes, elements, NODES, "element", self.name)
        object.__setattr__(self, "nodes", np.ascontiguousarray(nodes, dtype=np.float64))
        object.__setattr__(self, "elements", np.ascontiguousarray(elements, dtype=np.int32))
        check_tets(self.nodes, split(self.nodes, self.elements), name=self.name)
        self._check_edges()
        folded = np.flatnonzero((jacobians(self.nodes, self.elements) <= 0.0).any(axis=1))
        if folded.size:
            raise MeshError(
                f"mesh {self.name!r}: element {folded[0]} folds where its edges curve; move its edge nodes "
                f"{self.elements[folded[0], 4:].tolist()} nearer to the middles of their edges"
            )

    def _check_edges(self) -> None:
        """One node per edge, one edge per node."""
        ends = np.sort(self.elements[:, EDGES], axis=2).reshape(-1, 2)
        middle = self.elements[:, 4:].ravel()
        pairs = np.unique(np.column_stack([ends, middle]), axis=0)
        for columns, what in ((pairs[:, :2], "edge"), (pairs[:, 2:], "edge node")):
            found, first, count = np.unique(columns, axis=0, return_index=True, return_counts=True)
            if (count > 1).any():
                worst = pairs[first[count > 1][0]]
                raise MeshError(
                    f"mesh {self.name!r}: {what} {found[count > 1][0].tolist()} is joined inconsistently (edge "
                    f"{worst[:2].tolist()}, edge node {worst[2]}); every edge needs one node of its own"
                )
        if np.isin(middle, self.elements[:, :4]).any():
            both = int(middle[np.isin(middle, self.elements[:, :4])][0])
            raise MeshError(f"mesh {self.name!r}: node {both} is a corner and an edge node; give the edge its own node")

    @property
    def volume(self) -> float:
        """Volume of the solid [m^3], curved edges included."""
        return float(shape_products(self.nodes, self.elements).sum())

    @property
    def tets(self) -> IntArray:
        """Never available: the elements have ten nodes.

        Raises:
            MeshError: Always, with the ways to use the mesh.
        """
        raise MeshError(
            f"mesh {self.name!r} has {len(self.elements)} quadratic elements of ten nodes; pass it to add_tets as it "
            f"is, or take linear() for eight linear tetrahedra per element"
        )

    def linear(self) -> TetMesh:
        """The same nodes with eight linear tetrahedra for each element, element after element."""
        return TetMesh(self.nodes, split(self.nodes, self.elements), self.name)


def elevate(
    nodes: ArrayLike | TetMesh,
    tets: ArrayLike | None = None,
    *,
    project: Callable[[FloatArray], FloatArray] | None = None,
    straighten: bool = False,
    name: str = "mesh",
) -> QuadraticMesh:
    """A quadratic mesh from a linear one: a node in the middle of every edge, after the nodes that there are.

    Args:
        nodes: Positions [m], shape (node, 3), or a ``TetMesh``.
        tets: Corners with positive volume, shape (tet, 4); omitted for a ``TetMesh``.
        project: Moves edge nodes of the surface, positions (n, 3) to positions (n, 3), onto the curved surface that the
            mesh stands for; None leaves all edges straight.
        straighten: Whether edges of an element that would fold are drawn back, at worst until they are straight; else
            it is refused.
        name: What messages call the mesh.

    Raises:
        MeshError: If the mesh is broken, or projected nodes fold an element.
    """
    if isinstance(nodes, TetMesh):
        x, t, name = nodes.nodes, nodes.tets, nodes.name
    elif tets is None:
        raise MeshError(f"mesh {name!r}: tets are missing; pass nodes and tets, or a TetMesh")
    else:
        check_tets(nodes, tets, name=name)
        x, t = np.asarray(nodes, dtype=np.float64), np.asarray(tets)
    ends = np.sort(t[:, EDGES], axis=2).reshape(-1, 2).astype(np.int64)
    key, inverse = np.unique(ends[:, 0] * len(x) + ends[:, 1], return_inverse=True)
    middles = 0.5 * (x[key // len(x)] + x[key % len(x)])
    if project is not None:
        corner = np.sort(boundary(t, name)[0].astype(np.int64), axis=1)
        outer = np.unique(np.concatenate([corner[:, i] * len(x) + corner[:, j] for i, j in ((0, 1), (0, 2), (1, 2))]))
        on_surface = np.searchsorted(key, outer)
        middles[on_surface] = np.asarray(project(middles[on_surface]), dtype=np.float64)
    elements = np.concatenate([t, len(x) + inverse.reshape(-1, 6)], axis=1)
    if straighten:
        middles = _straightened(x, middles, 0.5 * (x[key // len(x)] + x[key % len(x)]), elements)
    return QuadraticMesh(np.concatenate([x, middles]), elements.astype(np.int32), name)


def _straightened(x: FloatArray, curved: FloatArray, straight: FloatArray, elements: NDArray[Any]) -> FloatArray:
    """Edge nodes drawn back from ``curved`` to ``straight`` by halves where an element, or a piece, is too small."""
    part = np.ones(len(curved))
    for round_ in range(ROUNDS + 1):
        middles = straight + part[:, None] * (curved - straight)
        nodes = np.concatenate([x, middles])
        whole = 6.0 * tet_volumes(x, elements[:, :4])
        pieces = 48.0 * tet_volumes(nodes, split(nodes, elements)).reshape(-1, 8)
        least = np.minimum(jacobians(nodes, elements).min(axis=1), pieces.min(axis=1))
        bad = np.unique(elements[least < LEAST_PART * whole, 4:]) - len(x)
        bad = bad[part[bad] > 0.0]
        if not bad.size:
            break
        part[bad] *= 0.5 if round_ < ROUNDS - 1 else 0.0
    return np.asarray(middles)


def split(nodes: ArrayLike, elements: ArrayLike) -> IntArray:
    """Eight linear tetrahedra per element between its ten nodes, shape (8 element, 4).

    Faces fall into four triangles each, alike from both sides. The octahedron inside is cut around its shortest
    diagonal.
    """
    x, t = np.asarray(nodes, dtype=np.float64), np.asarray(elements)
    ends = np.array([pieces[0][:2] for pieces in _AROUND_DIAGONALS])
    length = np.linalg.norm(x[t[:, ends[:, 0]]] - x[t[:, ends[:, 1]]], axis=2)
    choice = np.argmin(length * (1.0 + 1e-9 * np.arange(3)), axis=1)  # equal lengths: the first
    local = np.concatenate([np.array(_AT_CORNERS)[None].repeat(len(t), 0), np.array(_AROUND_DIAGONALS)[choice]], axis=1)
    return np.take_along_axis(t[:, None, :], local, axis=2).reshape(-1, 4).astype(np.int32)


def surface_middles(elements: ArrayLike, vertex_node: ArrayLike, triangles: ArrayLike) -> IntArray:
    """Which vertices of a surface are edge nodes between two other ones, shape (vertex, 3).

    Args:
        elements: Nodes of every element, shape (element, 10).
        vertex_node: Node under every vertex, -1 for none, shape (vertex,).
        triangles: Corners of the surface, shape (tri, 3).

    Returns:
        Edge node and the ends of its edge where the surface runs along both halves of the edge, else -1.
    """
    t, under, tri = np.asarray(elements), np.asarray(vertex_node), np.asarray(triangles)
    result = np.full((len(under), 3), -1, dtype=np.int32)
    edge = np.concatenate([t[:, [4 + number, *ends]] for number, ends in enumerate(EDGES.tolist())])
    ends_of = dict(zip(edge[:, 0].tolist(), edge[:, 1:].tolist(), strict=True))
    sides = np.sort(under[np.concatenate([tri[:, [0, 1]], tri[:, [1, 2]], tri[:, [2, 0]]])], axis=1)
    joined = set(map(tuple, sides.tolist()))
    for vertex, node in enumerate(under.tolist()):
        ends = ends_of.get(node, [])
        if ends and all((min(node, end), max(node, end)) in joined for end in ends):
            result[vertex] = [node, *ends]
    return result


def point_corners(values: ArrayLike, elements: ArrayLike) -> FloatArray:
    """The linear tetrahedron that stands for an element at each of its Gauss points, shape (element, 4, 4, 3).

    Its corner k at a point is y_k = (4 L_k - 1) x_k + sum over m of 4 L_m x_km, the derivative of the position by L_k,
    so that sum y_k grad L_k' is the deformation gradient there.
    """
    x = np.asarray(values, dtype=np.float64)[np.asarray(elements)]
    return np.asarray(np.einsum("qka,eac->eqkc", gradient_weights(), x))


def gradient_weights() -> FloatArray:
    """dN_a / dL_k at every Gauss point, shape (4 points, 4 corners, 10 nodes)."""
    L = np.full((POINTS, 4), FAR) + (NEAR - FAR) * np.eye(4)
    return np.stack([_derivatives(point) for point in L])


def corner_weights() -> FloatArray:
    """As ``gradient_weights``, less twice the place of the Gauss point: of a straight element these are its corners.

    The rows sum up to 1, so that a tetrahedron of ``point_corners`` moves where the element does. Its shape and what
    forces do to it are the same.
    """
    L = np.full((POINTS, 4), FAR) + (NEAR - FAR) * np.eye(4)
    return gradient_weights() - 2.0 * np.stack([_shapes(point) for point in L])[:, None]


def inner_weights() -> FloatArray:
    """As ``corner_weights``, of a tetrahedron of half the size around the Gauss point: points inside the element."""
    L = np.full((POINTS, 4), FAR) + (NEAR - FAR) * np.eye(4)
    whole = corner_weights()
    around = whole - whole.mean(axis=1, keepdims=True)
    return np.asarray(INNER * around + np.stack([_shapes(point) for point in L])[:, None])


def _derivatives(L: FloatArray) -> FloatArray:
    """dN_a / dL_k, shape (4, 10)."""
    D = np.zeros((4, NODES))
    D[np.arange(4), np.arange(4)] = 4.0 * L - 1.0
    for a, (k, m) in enumerate(EDGES):
        D[k, 4 + a], D[m, 4 + a] = 4.0 * L[m], 4.0 * L[k]
    return D


def jacobians(nodes: ArrayLike, elements: ArrayLike) -> FloatArray:
    """Six times the volume per unit of L at corners, edge nodes and Gauss points, shape (element, 14)."""
    L = [*np.eye(4), *(0.5 * np.eye(4)[EDGES].sum(axis=1)), *(np.full((4, 4), FAR) + (NEAR - FAR) * np.eye(4))]
    return _determinants(nodes, elements, np.stack([_derivatives(point) for point in L]))


def _determinants(nodes: ArrayLike, elements: ArrayLike, derivatives: FloatArray) -> FloatArray:
    x = np.asarray(nodes, dtype=np.float64)[np.asarray(elements)]
    y = np.einsum("qka,eac->eqkc", derivatives, x)
    return np.asarray(np.linalg.det(y[:, :, 1:] - y[:, :, :1]))


def shape_products(nodes: ArrayLike, elements: ArrayLike) -> FloatArray:
    """Integrals of N_a N_b over every element [m^3], shape (element, 10, 10): consistent mass per density."""
    x, t = np.asarray(nodes, dtype=np.float64), np.asarray(elements)
    unit = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    unit = np.concatenate([unit, 0.5 * unit[EDGES].sum(axis=1)])
    products = 6.0 * tet_volumes(x, t[:, :4])[:, None, None] * _integrate(unit, np.arange(NODES)[None])
    bend = np.abs(x[t[:, 4:]] - 0.5 * x[t[:, EDGES]].sum(axis=2)).max(axis=(1, 2))
    is_curved = bend > 1e-12 * np.ptp(x, axis=0).max()
    for part in np.array_split(np.flatnonzero(is_curved), 1 + int(is_curved.sum()) // 1000):
        products[part] = _integrate(x, t[part])
    return np.asarray(products)


def _integrate(nodes: FloatArray, elements: NDArray[Any]) -> FloatArray:
    """``shape_products`` by numerical integration."""
    place, share = np.polynomial.legendre.leggauss(6)
    place, share = 0.5 * (place + 1.0), 0.5 * share
    rule = []  # the unit cube folded into the tetrahedron; exact for the degree 7 of curved elements
    for (u, a), (v, b), (w, c) in itertools.product(zip(place, share, strict=True), repeat=3):
        L = np.array([u * v * w, u * v * (1.0 - w), u * (1.0 - v), 1.0 - u])
        rule.append((L, a * b * c * u * u * v))
    shapes = np.stack([_shapes(L) for L, _ in rule])
    products = np.einsum("p,pa,pb->pab", [weight for _, weight in rule], shapes, shapes)
    scale = _determinants(nodes, elements, np.stack([_derivatives(L) for L, _ in rule]))
    return np.asarray(np.einsum("ep,pab->eab", scale, products, optimize=True))


def _shapes(L: FloatArray) -> FloatArray:
    """N_a, shape (10,)."""
    return np.concatenate([L * (2.0 * L - 1.0), 4.0 * L[EDGES[:, 0]] * L[EDGES[:, 1]]])


def lumped(products: FloatArray) -> NDArray[np.float64]:
    """Positive nodal volumes [m^3], shape (element, 10): diagonals scaled to the element's volume (HRZ).

    Sums of rows are no masses: those of corners are negative.
    """
    diagonal = np.einsum("eaa->ea", products)
    return np.asarray(diagonal * (products.sum(axis=(1, 2)) / diagonal.sum(axis=1))[:, None])


def face_middles(elements: ArrayLike, triangles: ArrayLike) -> IntArray:
    """Edge nodes 01, 12, 20 of faces given by their corners, shape (tri, 3).

    Args:
        elements: Nodes of every element, shape (element, 10).
        triangles: Corners of faces of these elements, shape (tri, 3).

    Raises:
        MeshError: If a side of a triangle is no edge of an element; the message names it.
    """
    t, tri = np.asarray(elements), np.asarray(triangles)
    span = int(max(t.max(), tri.max())) + 1
    key, first = np.unique(_edge_keys(t[:, EDGES], span).ravel(), return_index=True)
    sides = np.stack([tri[:, [0, 1]], tri[:, [1, 2]], tri[:, [2, 0]]], axis=1)
    wanted = _edge_keys(sides, span)
    at = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
    if (key[at] != wanted).any():
        a, b = sides[key[at] != wanted][0].tolist()
        raise MeshError(f"a triangle has the side {a}-{b}, which is no edge of an element; take corners of its faces")
    return np.asarray(t[:, 4:].ravel()[first[at]], dtype=np.int32)


def _edge_keys(ends: NDArray[Any], span: int) -> NDArray[np.int64]:
    """One number per edge, whatever the order of its ends, (..., 2) -> (...)."""
    low, high = np.moveaxis(np.sort(ends, axis=-1).astype(np.int64), -1, 0)
    return np.asarray(low * span + high)


def face_shares(
    nodes: ArrayLike, triangles: ArrayLike, middles: ArrayLike | None = None
) -> tuple[IntArray, FloatArray]:
    """Integrals of the shape functions of all nodes of some faces over these [m^2]: what a load per area gives a node.

    Args:
        nodes: Positions [m], shape (node, 3).
        triangles: Corners of the faces, shape (tri, 3).
        middles: Edge nodes 01, 12, 20 of quadratic faces, which may be curved, shape (tri, 3); None for linear ones.

    Returns:
        Nodes in ascending order, shape (n,), and their integrals, shape (n,). Corners of a flat quadratic face get
        nothing, its edge nodes a third of its area each.
    """
    x, tri = np.asarray(nodes, dtype=np.float64), np.asarray(triangles)
    if middles is None:
        a, b, c = (x[tri[:, k]] for k in range(3))
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        held, value = tri, np.repeat(area[:, None] / 3.0, 3, axis=1)
    else:
        held = np.concatenate([tri, np.asarray(middles)], axis=1)
        value = _integrate_faces(x[held])
    node, place = np.unique(held, return_inverse=True)
    return node.astype(np.int32), np.bincount(place.ravel(), value.ravel(), minlength=len(node)).astype(np.float64)


def _integrate_faces(x: FloatArray) -> FloatArray:
    """Integrals of the six shape functions over curved faces [m^2], (tri, 6, 3) -> (tri, 6)."""
    place, share = np.polynomial.legendre.leggauss(5)
    place, share = 0.5 * (place + 1.0), 0.5 * share
    value = np.zeros(x.shape[:2])
    for (u, a), (v, b) in itertools.product(zip(place, share, strict=True), repeat=2):
        L = np.array([u * v, u * (1.0 - v), 1.0 - u])  # the unit square folded into the triangle
        around = L[[1, 2, 0]]
        shapes = np.concatenate([L * (2.0 * L - 1.0), 4.0 * L * around])
        by_L = np.zeros((3, 6))
        by_L[np.arange(3), np.arange(3)] = 4.0 * L - 1.0
        by_L[np.arange(3), 3 + np.arange(3)] = 4.0 * around
        by_L[[1, 2, 0], 3 + np.arange(3)] = 4.0 * L
        d0, d1, d2 = np.einsum("kn,tnc->ktc", by_L, x)
        value += (a * b * u * np.linalg.norm(np.cross(d1 - d0, d2 - d0), axis=1))[:, None] * shapes
    return value
