"""Elements by name, integrals over them, and solids whose exact answer is known. SI units.

``p1`` has four nodes and ``p2`` ten: corners, then the middles of the edges 01, 02, 03, 12, 13, 23.
"""

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.integrate import solve_bvp

from softwarp import meshing
from tests import cases

ELEMENTS = ("p1", "p2")
_EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
_FACES = ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3))
_FACE_MIDDLES = tuple(tuple(4 + _EDGES.index(pair) for pair in itertools.combinations(face, 2)) for face in _FACES)


def elevated(mesh: meshing.TetMesh, element: str):
    """The mesh for an element: itself, or with the nodes that quadratic elements add."""
    return meshing.elevate(mesh) if element == "p2" else mesh


def corners_of(mesh) -> np.ndarray:
    """Nodes of every element, (element, 4 or 10)."""
    return mesh.tets if isinstance(mesh, meshing.TetMesh) else mesh.elements


def traction(mesh, on: np.ndarray, force: tuple[float, float, float]) -> np.ndarray:
    """A dead total ``force`` [N] spread evenly over the flat face with the nodes ``on``, (node, 3).

    The integral of a shape function over a triangle is a third of its area for the corners of a linear one; of a
    quadratic one it is a third for the middles of its edges and 0 for the corners.
    """
    if isinstance(mesh, meshing.TetMesh):
        return cases.traction(mesh, on, force)
    weight = np.zeros(len(mesh.nodes))
    for face, middles in zip(_FACES, _FACE_MIDDLES, strict=True):
        hit = mesh.elements[on[mesh.elements[:, face]].all(axis=1)]
        a, b, c = (mesh.nodes[hit[:, k]] for k in face)
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        np.add.at(weight, hit[:, middles].ravel(), np.repeat(area / 3.0, 3))
    return np.outer(weight / weight.sum(), force)


def quadrature(n: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Barycentric points (p, 4) and weights (p,) with sum 1: the Gauss rule of ``n``^3 points of a folded cube."""
    place, share = np.polynomial.legendre.leggauss(n)
    u, v, w = (grid.ravel() for grid in np.meshgrid(*3 * [0.5 * (place + 1.0)], indexing="ij"))
    a, b, c = (grid.ravel() for grid in np.meshgrid(*3 * [0.5 * share], indexing="ij"))
    points = np.stack([u * v * w, u * v * (1.0 - w), u * (1.0 - v), 1.0 - u], axis=1)
    return points, 6.0 * a * b * c * u * u * v


def shapes(points: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """N_a (p, count) and dN_a / dL_k (p, 4, count) at barycentric points, of straight elements with 4 or 10 nodes."""
    if count == 4:
        return points, np.broadcast_to(np.eye(4), (len(points), 4, 4))
    i, j = np.array(_EDGES).T
    N = np.concatenate([points * (2.0 * points - 1.0), 4.0 * points[:, i] * points[:, j]], axis=1)
    D = np.zeros((len(points), 4, 10))
    D[:, np.arange(4), np.arange(4)] = 4.0 * points - 1.0
    edge = np.arange(6)
    D[:, i, 4 + edge], D[:, j, 4 + edge] = 4.0 * points[:, j], 4.0 * points[:, i]
    return N, D


class Field:
    """Values and gradients of nodal vectors at the quadrature points of all elements of a mesh with straight edges."""

    def __init__(self, mesh, n: int = 4) -> None:
        self.elements = corners_of(mesh)
        corner = mesh.nodes[self.elements[:, :4]]
        points, weights = quadrature(n)
        edges = corner[:, 1:] - corner[:, :1]
        inner = np.linalg.inv(edges).transpose(0, 2, 1)
        self.barycentric = np.concatenate([-inner.sum(axis=1, keepdims=True), inner], axis=1)  # grad L_k
        self.shape, self.slope = shapes(points, self.elements.shape[1])
        self.weight = np.linalg.det(edges)[:, None] / 6.0 * weights  # [m^3]
        self.place = np.einsum("pk,ekc->epc", points, corner)  # [m]
        self.node_count = len(mesh.nodes)

    def values(self, nodal: np.ndarray) -> np.ndarray:
        """sum_a N_a v_a, (element, point, 3)."""
        return np.einsum("pa,eac->epc", self.shape, nodal[self.elements], optimize=True)

    def gradients(self, nodal: np.ndarray) -> np.ndarray:
        """dv_i / dX_j, (element, point, 3, 3)."""
        by_point = np.einsum("pka,eai->epki", self.slope, nodal[self.elements], optimize=True)
        return np.einsum("epki,ekj->epij", by_point, self.barycentric, optimize=True)

    def load(self, density: np.ndarray) -> np.ndarray:
        """Integral of N_a b over the solid: nodal forces [N] of a force per volume (element, point, 3)."""
        share = np.einsum("pa,ep,epc->eac", self.shape, self.weight, density, optimize=True)
        force = np.zeros((self.node_count, 3))
        np.add.at(force, self.elements, share)
        return force

    def norm(self, density: np.ndarray) -> float:
        """Square root of the integral of |density|^2."""
        square = (density**2).reshape(*self.weight.shape, -1).sum(axis=2)
        return float(np.sqrt((self.weight * square).sum()))


AMPLITUDE = 0.05  # m


def manufactured(X: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """u = A (sin pi X sin pi Y sin pi Z, sin 2 pi X sin pi Y sin pi Z / 2, 0), its gradient and second derivatives.

    Shapes (..., 3), (..., 3, 3) and (..., 3, 3, 3) with u_i,j and u_i,jk.
    """
    derivative: tuple[Callable[[np.ndarray], np.ndarray], ...] = (np.sin, np.cos, lambda t: -np.sin(t))
    u, gradient = np.zeros(X.shape), np.zeros((*X.shape, 3))
    second = np.zeros((*X.shape, 3, 3))
    for i, (factor, waves) in enumerate(((AMPLITUDE, (1, 1, 1)), (0.5 * AMPLITUDE, (2, 1, 1)))):
        k = np.pi * np.array(waves)

        def term(orders: list[int], factor: float = factor, k: np.ndarray = k) -> np.ndarray:
            parts = [k[c] ** n * derivative[n](k[c] * X[..., c]) for c, n in enumerate(orders)]
            return factor * parts[0] * parts[1] * parts[2]

        u[..., i] = term([0, 0, 0])
        for j in range(3):
            first = [int(c == j) for c in range(3)]
            gradient[..., i, j] = term(first)
            for m in range(3):
                second[..., i, j, m] = term([first[c] + int(c == m) for c in range(3)])
    return u, gradient, second


def manufactured_force(X: np.ndarray, mu: float, lam: float) -> np.ndarray:
    """Body force [N/m^3] that makes ``manufactured`` the equilibrium of ``nh_log``: b = -Div P.

    P = mu F + (lam ln J - mu) F^-T, with G = F^-1: (ln J),j = G_lk F_kl,j and G_ji,m = -G_jk F_kl,m G_li.
    """
    _, gradient, second = manufactured(X)
    F = np.eye(3) + gradient
    G = np.linalg.inv(F)
    log_j = np.log(np.linalg.det(F))
    slope = np.einsum("...lk,...klj->...j", G, second)
    change = -np.einsum("...jk,...klj,...li->...i", G, second, G)
    divergence = mu * np.einsum("...ijj->...i", second) + lam * np.einsum("...j,...ji->...i", slope, G)
    return -(divergence + (lam * log_j - mu)[..., None] * change)


def manufactured_errors(element: str, n: int) -> np.ndarray:
    """L2 errors of displacement and gradient for ``nh_log``, E = 1 Pa, nu = 0.3, from its body force."""
    mesh = elevated(meshing.box((1.0, 1.0, 1.0), (n, n, n)), element)
    field, (mu, lam) = Field(mesh), cases.lame(1.0, 0.3)
    walls = (np.abs(mesh.nodes * (mesh.nodes - 1.0)) < 1e-9).any(axis=1)
    case = cases.body(mesh, "nh_log", 1.0, 0.3, fixed=walls)
    case.load(field.load(manufactured_force(field.place, mu, lam)))
    assert bool(case.sim.solve_static(tolerance=1e-9).converged.all())
    u, gradient, _ = manufactured(field.place)
    found = case.displacements()
    return np.array([field.norm(field.values(found) - u), field.norm(field.gradients(found) - gradient)])


def exact_sphere(nu: float, pressure: float) -> tuple[float, float]:
    """Radial displacements [mm] of both walls of the sphere, ``nh_log``, E = 1e5 Pa, by (P_r)' + 2 (P_r - P_t) / R = 0.

    P_r = mu (a - 1/a) + lam ln J / a with a = r', P_t alike with b = r / R; P_r(A) = -p (r / A)^2, P_r(B) = 0.
    """
    inner_radius, outer_radius = 0.01, 0.02
    mu, lam = cases.lame(1.0e5, nu)

    def radial_stress(R, y):
        a, b = y[1], y[0] / R
        return mu * (a - 1.0 / a) + lam * np.log(a * b * b) / a

    def slope(R, y):
        a, b = y[1], y[0] / R
        log_j = np.log(a * b * b)
        hoop = mu * (b - 1.0 / b) + lam * log_j / b
        by_a = mu * (1.0 + 1.0 / a**2) + lam * (1.0 - log_j) / a**2
        by_b = 2.0 * lam / (a * b)
        return np.stack([a, -(2.0 / R * (radial_stress(R, y) - hoop) + by_b * (a - b) / R) / by_a])

    def ends(inner, outer):
        loaded = radial_stress(inner_radius, inner) + pressure * (inner[0] / inner_radius) ** 2
        return np.array([loaded, radial_stress(outer_radius, outer)]) / mu

    R = np.linspace(inner_radius, outer_radius, 101)
    grown = (R**3 + 2.0 * inner_radius**3 * 0.2) ** (1.0 / 3.0)
    solution = solve_bvp(slope, ends, R, np.stack([grown, (R / grown) ** 2]), tol=1e-9, max_nodes=20000)
    assert solution.success, solution.message
    return 1e3 * (solution.y[0, 0] - inner_radius), 1e3 * (solution.y[0, -1] - outer_radius)


def cook(element: str, law: str, cells: tuple[int, int, int], nu: float = 0.3, **options: Any) -> cases.Case:
    """Cook's membrane (catalogue 2.3): a tapered panel, clamped at x = 0, dead shear load 1000 on x = 48."""
    unit = meshing.box((1.0, 1.0, 1.0), cells)
    xi, eta, zeta = unit.nodes.T
    nodes = np.stack([48.0 * xi, 44.0 * xi + eta * (44.0 * (1.0 - xi) + 16.0 * xi), 10.0 * zeta], axis=1)
    mesh = elevated(meshing.TetMesh(nodes, unit.tets), element)
    case = cases.body(mesh, law, 240.565, nu, fixed=cases.on_plane(mesh, 0, 0.0), **options)
    case.load(traction(mesh, cases.on_plane(mesh, 0, 48.0), (0.0, 1000.0, 0.0)))
    return case


def loaded_beam(element: str, law: str, cells: tuple[int, int, int], nu: float = 0.3, **options: Any) -> cases.Case:
    """The cantilever of catalogue 2.1: 1.0 x 0.1 x 0.1 m, E = 1 MPa, clamped at x = 0, dead end load 25 N."""
    mesh = elevated(meshing.box((1.0, 0.1, 0.1), cells), element)
    case = cases.body(mesh, law, 1e6, nu, fixed=cases.on_plane(mesh, 0, 0.0), **options)
    case.load(traction(mesh, cases.on_plane(mesh, 0, 1.0), (0.0, 0.0, -25.0)))
    return case
