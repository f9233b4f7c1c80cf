"""Which linear element does not lock, and what does it cost? A study in NumPy, at small strain.

    softwarp bench locking                       # minutes; the page of softwarp bench accuracy shows the result

Linear tetrahedra are too stiff in bending (*shear*: one strain per element) and as nu -> 1/2 (*volumetric*: one
constraint per element, and more elements than unknowns). Cures average strain over *domains* of several tetrahedra:
strain with the shear modulus over one kind of domain, dilatation with Lame's first constant over another.

=============  ==================  ==================  ===============================================================
element        shear over          dilatation over     reference
=============  ==================  ==================  ===============================================================
p1             tetrahedron         tetrahedron
average        tetrahedron         node                average nodal pressure: Bonet, Burton (1998)
patch          tetrahedron         patch of eight      F-bar patch: de Souza Neto, Pires, Owen (2005)
mini           tetrahedron         (pressure unknown)  Arnold, Brezzi, Fortin (1984), bubble condensed
face           face                face                Nguyen-Thoi, Liu, Lam, Zhang (2009)
edge           edge                edge                Liu, Nguyen-Thoi, Lam (2009)
node           node                node                nodal integration: Dohrmann et al. (2000)
edge, node     edge                node                selective: Liu, Nguyen-Thoi (2010)
edge, patch    edge                patch of eight      the two best cures together
=============  ==================  ==================  ===============================================================

Cost is what a step pays for with a direct solver: blocks of L and operations of the factorisation (``plan.ordering``
on the element's own pattern), and operations to assemble the tangent.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from softwarp import meshing
from softwarp.meshing.quadratic import EDGES, gradient_weights
from softwarp.plan import ordering

from . import cantilever
from .timing import save

RESULTS = Path(__file__).resolve().parent / "results" / "accuracy" / "locking.json"
PATCH = 8  # tetrahedra
LAW = 1500  # operations for stress and tangent of one domain
DOMAINS: dict[str, tuple[str, str]] = {
    "p1": ("tet", "tet"),
    "average": ("tet", "node"),
    "patch": ("tet", "patch"),
    "face": ("face", "face"),
    "edge": ("edge", "edge"),
    "node": ("node", "node"),
    "edge, node": ("edge", "node"),
    "edge, patch": ("edge", "patch"),
    "edge, patch of 4": ("edge", "patch of 4"),
    "edge, patch of 12": ("edge", "patch of 12"),
}
ELEMENTS = (*DOMAINS, "mini", "p2")
Matrix = Any


@dataclass(frozen=True)
class Problem:
    """A linear problem: mesh, moduli [Pa], clamp, load per volume or per area of a face, and what is read."""

    name: str
    mesh: meshing.TetMesh
    mu: float
    lam: float
    fixed: Callable[[np.ndarray], np.ndarray]
    weight: tuple[float, float, float]  # N/m^3, or N/m^2 on ``face``
    read: Callable[[np.ndarray, np.ndarray], float]
    face: Callable[[np.ndarray], np.ndarray] | None = None


def main(arguments: Sequence[str]) -> int:
    """Measure all elements on all problems."""
    parser = argparse.ArgumentParser(
        prog="softwarp bench locking", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, default=RESULTS, metavar="FILE", help="records")
    args = parser.parse_args(arguments)
    records: list[dict[str, Any]] = []
    for title, fine, problems in studies():
        exact, _ = solve(fine, "p2")
        for problem in problems:
            for element in ELEMENTS:
                value, domains = solve(problem, element)
                price = cost(problem, element, domains)
                record = {
                    "study": title,
                    "mesh": problem.name,
                    "element": element,
                    "error": value / exact - 1.0,
                } | price
                records.append(record)
                print(
                    f"{title:22s} {problem.name:10s} {element:17s} {100 * record['error']:7.1f} %  "
                    f"{price['unknowns']:6d} unknowns, L {price['blocks']:7d}, factor {price['factor_mflop']:7.2f}, "
                    f"assembly {price['assembly_mflop']:6.2f} Mflop",
                    flush=True,
                )
    save(records, args.json)
    return 0


def studies() -> list[tuple[str, Problem, list[Problem]]]:
    """Title, problem for the right answer, and meshes: the cantilever, Cook's membrane, the trunk under its weight."""
    result = []
    for nu in (0.0, 0.45, 0.499):
        beams = [_cantilever(cells, nu) for cells in ((30, 6, 6), (10, 2, 2), (20, 4, 4))]
        result.append((f"cantilever, nu {nu:g}", beams[0], beams[1:]))
    for nu in (0.3, 0.499):
        panels = [_cook(n, nu) for n in (16, 4, 8)]
        result.append((f"Cook, nu {nu:g}", panels[0], panels[1:]))
    trunks = [_trunk(name) for name in ("fine", "coarse", "medium")]
    return [*result, ("trunk, nu 0.45", trunks[0], trunks[1:])]


def _lame(youngs: float, nu: float) -> tuple[float, float]:
    return youngs / (2.0 * (1.0 + nu)), youngs * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))


def _clamped(nodes: np.ndarray) -> np.ndarray:
    return np.asarray(nodes[:, 0] < 1e-9)


def _cantilever(cells: tuple[int, int, int], nu: float) -> Problem:
    weight = (0.0, 0.0, -cantilever.DENSITY * cantilever.GRAVITY)

    def read(nodes: np.ndarray, u: np.ndarray) -> float:
        return -float(u[nodes[:, 0] > cantilever.SIZE[0] - 1e-9, 2].mean())

    moduli = _lame(cantilever.YOUNGS, nu)
    return Problem(str(cells), cantilever.mesh(cells), *moduli, _clamped, weight, read)


def _cook(n: int, nu: float) -> Problem:
    unit = meshing.box((1.0, 1.0, 1.0), (n, n, n // 4))
    xi, eta, zeta = unit.nodes.T
    nodes = np.stack([48.0 * xi, 44.0 * xi + eta * (44.0 * (1.0 - xi) + 16.0 * xi), 10.0 * zeta], axis=1)
    mesh = meshing.TetMesh(nodes, unit.tets)

    def read(nodes: np.ndarray, u: np.ndarray) -> float:
        return float(u[np.argmin(np.abs(nodes - [48.0, 60.0, 0.0]).sum(axis=1)), 1])

    def face(nodes: np.ndarray) -> np.ndarray:
        return np.asarray(np.abs(nodes[:, 0] - 48.0) < 1e-9)

    return Problem(f"({n}, {n}, {n // 4})", mesh, *_lame(240.565, nu), _clamped, (0.0, 6.25, 0.0), read, face)


def _trunk(name: str) -> Problem:
    mesh = meshing.trunk(name)

    def fixed(nodes: np.ndarray) -> np.ndarray:
        return np.asarray(nodes[:, 2] <= 0.020 + 1e-9)

    def read(nodes: np.ndarray, u: np.ndarray) -> float:
        return -float(u[nodes[:, 2] > nodes[:, 2].max() - 1e-6, 1].mean())

    return Problem(name, mesh, *_lame(450.0e3, 0.45), fixed, (0.0, -0.042 / mesh.volume * 9.81, 0.0), read)


def solve(problem: Problem, element: str) -> tuple[float, list[Matrix]]:
    """What is read of the solution, and the nodes of all domains."""
    nodes, elements = discretised(problem, element)
    held = np.repeat(problem.fixed(nodes), 3)
    force = (load(nodes, elements, problem)[:, None] * problem.weight).ravel()
    free = np.flatnonzero(~held)
    if element == "mini":
        matrix, domains = mini(problem), [_incidence(elements)]
        free, force = np.append(free, np.arange(held.size, matrix.shape[0])), np.append(force, np.zeros(len(nodes)))
    elif element == "p2":
        matrix, domains = quadratic(nodes, elements, problem)
    else:
        matrix, domains = averaged(problem, *DOMAINS[element])
    u = np.zeros(matrix.shape[0])
    u[free] = spsolve(matrix.tocsc()[free][:, free], force[free])
    return problem.read(nodes, u[: held.size].reshape(-1, 3)), domains


def discretised(problem: Problem, element: str) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and their numbers in every element."""
    if element != "p2":
        return problem.mesh.nodes, problem.mesh.tets
    mesh = meshing.elevate(problem.mesh)
    return mesh.nodes, mesh.elements


def load(nodes: np.ndarray, elements: np.ndarray, problem: Problem) -> np.ndarray:
    """Integral of every shape function over the volume [m^3], or over the loaded face [m^2]."""
    count, size = len(nodes), elements.shape[1]
    corner = nodes[elements[:, :4]]
    if problem.face is None:
        volume = np.linalg.det(corner[:, 1:] - corner[:, :1]) / 6.0
        share = np.full(4, 0.25) if size == 4 else np.repeat([-1 / 20, 1 / 5], [4, 6])
        return np.bincount(elements.ravel(), np.outer(volume, share).ravel(), minlength=count)
    total = np.zeros(count)
    on = problem.face(nodes)
    for face in itertools.combinations(range(4), 3):
        hit = elements[on[elements[:, face]].all(axis=1)]
        a, b, c = (nodes[hit[:, k]] for k in face)
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        edges = [4 + i for i, ends in enumerate(EDGES.tolist()) if set(ends) <= set(face)]
        total += np.bincount(hit[:, face if size == 4 else edges].ravel(), np.repeat(area / 3.0, 3), minlength=count)
    return total


def strain(tets: np.ndarray, gradient: np.ndarray, count: int) -> Matrix:
    """Rows xx yy zz xy yz zx of every element from nodal displacements; ``gradient`` (element, node, 3)."""
    parts = [(0, 0, 0), (1, 1, 1), (2, 2, 2), (3, 0, 1), (3, 1, 0), (4, 1, 2), (4, 2, 1), (5, 0, 2), (5, 2, 0)]
    e = np.arange(len(tets))[:, None]
    rows = [np.broadcast_to(6 * e + row, tets.shape).ravel() for row, _, _ in parts]
    cols = [(3 * tets + component).ravel() for _, component, _ in parts]
    values = [gradient[:, :, axis].ravel() for _, _, axis in parts]
    where = (np.concatenate(rows), np.concatenate(cols))
    return sparse.csr_array((np.concatenate(values), where), shape=(6 * len(tets), 3 * count))


TRACE = np.array([[1.0, 1.0, 1.0, 0.0, 0.0, 0.0]])
SHEAR = np.diag([2.0, 2.0, 2.0, 1.0, 1.0, 1.0])


def averaged(problem: Problem, shear: str, dilatation: str) -> tuple[Matrix, list[Matrix]]:
    """Stiffness with mu e:e and lam (tr e)^2 / 2 of strains averaged over domains; the nodes of every domain."""
    nodes, tets = problem.mesh.nodes, problem.mesh.tets
    gradient, volume, _ = meshing.tets.rest_geometry(nodes, tets)
    inner = gradient.reshape(-1, 3, 3)
    B = strain(tets, np.concatenate([-inner.sum(axis=1, keepdims=True), inner], axis=1), len(nodes))
    D = sparse.kron(sparse.eye_array(len(tets)), TRACE).tocsr() @ B
    matrix, domains = 0.0, {}
    for kind, rows, size, law in ((shear, B, 6, problem.mu * SHEAR), (dilatation, D, 1, np.array([[problem.lam]]))):
        member = membership(kind, tets) * volume
        total = np.asarray(member.sum(axis=1)).ravel()
        mean = sparse.kron(sparse.diags_array(1.0 / total) @ member, sparse.eye_array(size)).tocsr() @ rows
        matrix = matrix + mean.T @ sparse.kron(sparse.diags_array(total), law) @ mean
        domains[kind] = member @ _incidence(tets)
    return matrix, list(domains.values())


def membership(kind: str, tets: np.ndarray) -> Matrix:
    """Share of every tetrahedron in every domain, (domain, tet)."""
    every = np.arange(len(tets))
    if kind.startswith("patch"):
        size = PATCH if kind == "patch" else int(kind.split()[-1])
        return sparse.csr_array((np.ones(len(tets)), (patches(tets, size), every)))
    corners = {"node": 1, "edge": 2, "face": 3, "tet": 4}[kind]
    subsets = list(itertools.combinations(range(4), corners))
    keys = np.concatenate([np.sort(tets[:, subset], axis=1) for subset in subsets])
    domain = np.unique(keys, axis=0, return_inverse=True)[1].ravel()
    share = np.full(domain.size, 1.0 / len(subsets))
    return sparse.csr_array((share, (domain, np.tile(every, len(subsets)))))


def patches(tets: np.ndarray, size: int) -> np.ndarray:
    """Patch of every tetrahedron: each grows across faces by whatever shares most nodes with it, up to ``size``."""
    faces = np.sort(np.concatenate([np.delete(tets, k, axis=1) for k in range(4)]), axis=1)
    owner = np.tile(np.arange(len(tets)), 4)
    order = np.lexsort(faces.T)
    twin = np.flatnonzero((faces[order[1:]] == faces[order[:-1]]).all(axis=1))
    beside: list[list[int]] = [[] for _ in tets]
    for a, b in zip(owner[order[twin]].tolist(), owner[order[twin + 1]].tolist(), strict=True):
        beside[a].append(b)
        beside[b].append(a)
    corner = [set(tet) for tet in tets.tolist()]
    patch = np.full(len(tets), -1)
    for seed in range(len(tets)):
        if patch[seed] >= 0:
            continue
        number, members, nodes = patch.max() + 1, [seed], set(corner[seed])
        patch[seed] = number
        while len(members) < size:
            around = sorted({n for member in members for n in beside[member] if patch[n] < 0})
            if not around:
                break
            best = max(around, key=lambda n: len(corner[n] & nodes))
            patch[best] = number
            members.append(best)
            nodes |= corner[best]
    sizes = np.bincount(patch)
    for tet in np.flatnonzero(sizes[patch] <= size // 3):  # what is left over joins the smallest patch beside it
        around = [patch[n] for n in beside[tet] if patch[n] != patch[tet]]
        if around and sizes[patch[tet]] <= size // 3:
            sizes[patch[tet]] -= 1
            patch[tet] = min(around, key=lambda n: sizes[n])
            sizes[patch[tet]] += 1
    return np.asarray(np.unique(patch, return_inverse=True)[1])


def quadratic(nodes: np.ndarray, elements: np.ndarray, problem: Problem) -> tuple[Matrix, list[Matrix]]:
    """Stiffness of ten-node elements, four points each."""
    corner = nodes[elements[:, :4]]
    edges = corner[:, 1:] - corner[:, :1]
    inner = np.linalg.inv(edges).transpose(0, 2, 1)
    of_l = np.concatenate([-inner.sum(axis=1, keepdims=True), inner], axis=1)
    volume = np.linalg.det(edges) / 24.0
    law = problem.mu * SHEAR + problem.lam * TRACE.T @ TRACE
    matrix = 0.0
    for weights in gradient_weights():
        B = strain(elements, np.einsum("ka,ekc->eac", weights, of_l), len(nodes))
        matrix = matrix + B.T @ sparse.kron(sparse.diags_array(volume), law) @ B
    return matrix, 4 * [_incidence(elements)]


def mini(problem: Problem) -> Matrix:
    """Displacements with a bubble in every element, which is condensed, and nodal pressures: [[K, G'], [G, -C]]."""
    nodes, tets, mu = problem.mesh.nodes, problem.mesh.tets, problem.mu
    gradient, volume, _ = meshing.tets.rest_geometry(nodes, tets)
    inner = gradient.reshape(-1, 3, 3)
    g = np.concatenate([-inner.sum(axis=1, keepdims=True), inner], axis=1)
    B = strain(tets, g, len(nodes))
    K = B.T @ sparse.kron(sparse.diags_array(volume), mu * SHEAR) @ B
    trace = sparse.kron(sparse.eye_array(len(tets)), TRACE).tocsr() @ B
    G = (0.25 * _incidence(tets)).T @ sparse.diags_array(volume) @ trace
    # Bubble 256 L1 L2 L3 L4: its integral, and that of grad b grad b' = 4 (256^2 6 V / 9!) sum of grad L grad L'
    bubble, slope = 256.0 * 6.0 / 5040.0 * volume, 256.0**2 * 24.0 / 362880.0 * volume
    S = slope[:, None, None] * np.einsum("tai,taj->tij", g, g)
    stiff = mu * (np.trace(S, axis1=1, axis2=2)[:, None, None] * np.eye(3) + S)
    h = -g * bubble[:, None, None]
    C = np.einsum("tai,tij,tbj->tab", h, np.linalg.inv(stiff), h)
    C += (volume / 20.0 / max(problem.lam, 1e-9 * mu))[:, None, None] * (np.ones((4, 4)) + np.eye(4))
    where = (np.repeat(tets, 4, axis=1).ravel(), np.tile(tets, (1, 4)).ravel())
    return sparse.block_array([[K, G.T], [G, -sparse.csr_array((C.ravel(), where), shape=(len(nodes), len(nodes)))]])


def _incidence(elements: np.ndarray) -> Matrix:
    """1 where an element has a node, (element, node)."""
    rows = np.repeat(np.arange(len(elements)), elements.shape[1])
    return sparse.csr_array((np.ones(elements.size), (rows, elements.ravel())))


def cost(problem: Problem, element: str, domains: list[Matrix]) -> dict[str, Any]:
    """Unknowns, blocks of A and L, and million operations to factorise and to assemble.

    A domain with n nodes costs its law, 162 n operations for C : grad N and 54 per pair of nodes, besides what both
    moduli of one domain share.
    """
    nodes, _ = discretised(problem, element)
    fixed = problem.fixed(nodes)
    number = np.cumsum(~fixed) - 1
    pairs, assembly = set(), 0.0
    for domain in domains:
        n = np.diff((domain != 0).tocsr().indptr)
        assembly += float((LAW + 162.0 * n + 27.0 * n * (n + 1)).sum())
        ones = (domain != 0).astype(np.float64)
        joined = sparse.coo_array(sparse.triu(ones.T @ ones, 1))
        pairs |= {
            (int(number[a]), int(number[b]))
            for a, b in zip(joined.row, joined.col, strict=True)
            if not (fixed[a] or fixed[b])
        }
    found = ordering.analyze(np.array(sorted(pairs), dtype=np.int32), int((~fixed).sum()), nodes[~fixed])
    return {
        "unknowns": 3 * int((~fixed).sum()),
        "a_blocks": len(pairs) + found.size,
        "blocks": found.block_count,
        "factor_mflop": found.flops / 1e6,
        "assembly_mflop": assembly / 1e6,
    }
