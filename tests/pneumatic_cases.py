"""Bodies with air chambers of the validation catalogue, sections 3.1 and 3.3: meshes, chamber surfaces, supports.

Symmetric pieces (an octant of a sphere, a quarter of a cylinder) have a chamber that is closed by triangles in the
planes of symmetry. Their pressure acts only along directions that are held there. The corners on the axis belong to
no mesh node: they stand still, ``vertex_node`` is -1.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

import softwarp as sw
from softwarp import meshing
from tests.cases import material

BENDER_CELL = 0.005  # m
BENDER_TIP = (0.06, 0.01, 0.0)  # m, where the catalogue reads the displacement


@dataclass
class PneumaticCase:
    """A solid with one chamber.

    Attributes:
        mesh: The solid; of quadratic elements the linear tets between their nodes.
        vertices: Corners of the chamber's surface [m], (vertex, 3).
        triangles: The closed surface, outward from the air, (tri, 3), indices of ``vertices``.
        vertex_node: Mesh node of every vertex, -1 where it is fixed in space, (vertex,).
        fixed: Displacements that are held, bool (node, 3).
        inner, outer: Nodes of the wall inside and outside, (n,), where radial displacements are averaged.
    """

    mesh: meshing.TetMesh
    vertices: np.ndarray
    triangles: np.ndarray
    vertex_node: np.ndarray
    fixed: np.ndarray
    inner: np.ndarray
    outer: np.ndarray
    quadratic: Any = None  # the ``QuadraticMesh``, if the solid is one

    @property
    def point_node(self) -> np.ndarray:
        """Carriers of the vertices, (vertex, 4), -1 for none."""
        return np.stack([self.vertex_node, *[np.full_like(self.vertex_node, -1)] * 3], axis=1)

    @property
    def point_weight(self) -> np.ndarray:
        """Weights of the carriers, (vertex, 4)."""
        weight = np.zeros((len(self.vertices), 4))
        weight[:, 0] = self.vertex_node >= 0
        return weight

    @property
    def point_anchor(self) -> np.ndarray:
        """Positions of the vertices that are fixed in space [m], zero for the others, (vertex, 3)."""
        return np.where(self.vertex_node[:, None] < 0, self.vertices, 0.0)


def sphere_octant(
    n: int, nr: int, inner: float = 0.01, outer: float = 0.02, *, element: str = "p1", curved: bool = False
) -> PneumaticCase:
    """Octant of a thick sphere of radii ``inner`` and ``outer`` [m] in x, y, z >= 0 (catalogue 3.1).

    ``n`` edges along each arc, ``nr`` layers; node = direction + directions * layer. With ``element="p2"`` there are
    nodes in the middles of edges, on the spheres where ``curved``.
    """
    grid = [(i, j) for i in range(n + 1) for j in range(n + 1 - i)]
    number = {key: index for index, key in enumerate(grid)}
    direction = np.array([(i, j, n - i - j) for i, j in grid], dtype=np.float64)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    flat = []
    for i, j in grid:
        if i + j < n:
            flat.append([number[i, j], number[i + 1, j], number[i, j + 1]])
        if i + j < n - 1:
            flat.append([number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]])
    radius = inner + (outer - inner) * np.arange(nr + 1) / nr
    nodes = (radius[:, None, None] * direction).reshape(-1, 3)
    count = len(grid)
    tets = []
    for layer in range(nr):
        for triangle in flat:
            a0, b0, c0 = np.sort(triangle) + count * layer
            a1, b1, c1 = a0 + count, b0 + count, c0 + count
            tets += [[a0, b0, c0, c1], [a0, b0, b1, c1], [a0, a1, b1, c1]]
    arcs = [
        [number[0, j] for j in range(n + 1)],
        [number[i, 0] for i in range(n + 1)],
        [number[i, n - i] for i in range(n + 1)],
    ]
    mesh = meshing.TetMesh(nodes, meshing.orient(nodes, tets), f"sphere octant ({n}, {nr})")
    if element == "p2":
        return _quadratic_octant(mesh, flat, arcs, count, (inner, outer), curved)
    closing = [[count, a, b] for arc in arcs for a, b in pairwise(arc)]
    wall = np.arange(count)
    vertex_node, held = np.append(wall, -1), nodes == 0.0
    return _case(mesh, flat + closing, vertex_node, np.zeros((1, 3)), held, wall, wall + count * nr)


def _quadratic_octant(mesh, flat, arcs, count, radii, curved) -> PneumaticCase:
    """The octant with edge nodes; every triangle of the chamber falls into the four between its six nodes."""
    sagitta = 1.01 * radii[1] * (1.0 - np.cos(np.pi / 4.0 / (len(arcs[0]) - 1)))

    def project(x):
        r = np.linalg.norm(x, axis=1, keepdims=True)
        for radius in radii if curved else ():
            x = np.where(np.abs(r - radius) < sagitta, x * (radius / r), x)
        return x

    solid = meshing.elevate(mesh, project=project)
    middle = {}
    for number, (i, j) in enumerate(((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))):
        ends = np.sort(solid.elements[:, [i, j]], axis=1)
        middle |= dict(zip(map(tuple, ends.tolist()), solid.elements[:, 4 + number].tolist(), strict=True))

    def between(a, b):
        return middle[min(a, b), max(a, b)]

    triangles = []
    for a, b, c in flat:
        ab, bc, ca = between(a, b), between(b, c), between(c, a)
        triangles += [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
    rims = [[pair for a, b in pairwise(arc) for pair in ((a, between(a, b)), (between(a, b), b))] for arc in arcs]
    wall, corners = np.unique(triangles, return_inverse=True)
    vertex = dict(zip(wall.tolist(), range(wall.size), strict=True))
    closing = [[wall.size, vertex[a], vertex[b]] for rim in rims for a, b in rim]
    shift = len(mesh.nodes) - count  # from a corner of the inner wall to that of the outer one
    far = {(a + shift, b + shift) for tri in flat for a, b in pairwise([*sorted(tri), min(tri)])}
    outer = {a for pair in far for a in pair} | {between(a, b) for a, b in far}
    return _case(
        solid.linear(),
        corners.reshape(-1, 3).tolist() + closing,
        np.append(wall, -1),
        np.zeros((1, 3)),
        solid.nodes == 0.0,
        wall,
        np.array(sorted(outer)),
        solid,
    )


def cylinder_quarter(
    nr: int, nt: int, nz: int, inner: float = 0.01, outer: float = 0.02, height: float = 0.01
) -> PneumaticCase:
    """Quarter of a thick cylinder of ``nr`` x ``nt`` x ``nz`` cells in plane strain, axis z, x, y >= 0 (3.1)."""
    unit = meshing.box((1.0, 1.0, 1.0), (nr, nt, nz))
    k, j, i = (index.ravel() for index in np.indices((nz + 1, nt + 1, nr + 1)))
    radius, angle = inner + (outer - inner) * i / nr, 0.5 * np.pi * j / nt
    x, y = np.where(j == nt, 0.0, radius * np.cos(angle)), radius * np.sin(angle)
    mesh = meshing.TetMesh(np.stack([x, y, height * k / nz], axis=1), unit.tets, f"cylinder ({nr}, {nt}, {nz})")
    fixed = np.stack([j == nt, j == 0, (k == 0) | (k == nz)], axis=1)

    wall = np.flatnonzero(i == 0)  # (nt + 1) (nz + 1) nodes, angle fastest
    vertex = np.full(len(mesh.nodes), -1)
    vertex[wall] = np.arange(wall.size)
    skin = vertex[mesh.surface()]
    triangles = skin[(skin >= 0).all(axis=1)].tolist()
    grid = np.arange(wall.size).reshape(nz + 1, nt + 1)
    bottom, top = wall.size, wall.size + 1
    for axis, rim in ((bottom, grid[0]), (top, grid[-1])):
        triangles += [[axis, a, b] for a, b in pairwise(rim)]
    for line in (grid[:, 0], grid[:, -1]):
        triangles += [[bottom, a, b] for a, b in pairwise(line)] + [[bottom, line[-1], top]]
    axis_points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, height]])
    return _case(mesh, triangles, np.concatenate([wall, [-1, -1]]), axis_points, fixed, wall, np.flatnonzero(i == nr))


def bender(refine: int = 1) -> PneumaticCase:
    """Block of 12 x 4 x 4 cells of 5 mm with an eccentric inner chamber of 10 x 2 x 1 cells, clamped at x = 0 (3.3).

    ``refine`` splits every cell into ``refine``^3.
    """
    cells = np.array([12, 4, 4]) * refine
    block = meshing.box(cells * (BENDER_CELL / refine), cells.tolist())
    k, j, i = (index.ravel() // refine for index in np.indices(cells[::-1]))
    removed = (i >= 1) & (i < 11) & (j >= 1) & (j < 3) & (k == 2)
    nodes, tets = meshing.compact(block.nodes, block.tets[np.repeat(~removed, 6)])
    mesh = meshing.TetMesh(nodes, tets, f"pneumatic bender, refined {refine}")
    (around,) = meshing.voids(mesh.nodes, mesh.tets)
    wall, triangles = np.unique(around, return_inverse=True)
    fixed = np.repeat(mesh.nodes[:, :1] < 1e-9, 3, axis=1)
    surface = np.setdiff1d(mesh.surface(), wall)
    return _case(mesh, triangles.reshape(-1, 3), wall, np.zeros((0, 3)), fixed, wall, surface)


def _case(mesh, triangles, vertex_node, anchors, fixed, inner, outer, quadratic=None) -> PneumaticCase:
    """Orient and check the surface; ``anchors`` are the positions of the last vertices, which have no node."""
    vertices = np.vstack([mesh.nodes[vertex_node[vertex_node >= 0]], anchors])
    closed = meshing.check_closed(vertices, meshing.orient_surface(triangles), name=f"chamber of {mesh.name}")
    return PneumaticCase(mesh, vertices, closed, np.asarray(vertex_node), fixed, inner, outer, quadratic)


def builder_of(
    case: PneumaticCase,
    law: str,
    youngs: float,
    nu: float,
    *,
    density: float = 1000.0,
    rayleigh: tuple[float, float] = (0.0, 0.0),
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    **chamber: Any,
) -> sw.ModelBuilder:
    """The case in a scene of its own, body 0 with chamber 0; further options go to ``add_cavity``."""
    builder = sw.ModelBuilder(gravity=gravity)
    solid = case.mesh if case.quadratic is None else case.quadratic
    body = builder.add_tets(solid, material=material(law, youngs, nu), density=density, rayleigh=rayleigh)
    for axis, name in enumerate("xyz"):
        held = np.flatnonzero(case.fixed[:, axis])
        if held.size:
            builder.fix(body, nodes=held, axes=name)
    builder.add_cavity(body, case.vertices, case.triangles, anchored=np.flatnonzero(case.vertex_node < 0), **chamber)
    return builder


def statics(builder: sw.ModelBuilder, num_worlds: int = 1, precision: str = "float64", **options: Any) -> sw.Simulation:
    """A simulation whose steps of 1000 s each end in equilibrium."""
    options = {"dt": 1.0e3, "newton_iterations": 60, **options}
    return sw.Simulation(builder.finalize(num_worlds=num_worlds, precision=precision), **options)


def settle(sim: sw.Simulation) -> None:
    """One step of ``statics``, from rest to rest."""
    sim.node_v.zero_()
    sim.step()
    sim.node_v.zero_()
    assert (sim.status == sw.Status.OK).all(), f"no equilibrium: status {sim.status.flatten().tolist()}"


def radial(case: PneumaticCase, sim: sw.Simulation, nodes: np.ndarray, axes: int = 3) -> float:
    """Mean displacement [m] of some nodes along their rest direction from the origin, or with ``axes`` = 2 from z."""
    rest = case.mesh.nodes[nodes, :axes]
    moved = sim.node_x[0, nodes, :axes].double().numpy() - rest
    return float(((moved * rest).sum(axis=1) / np.linalg.norm(rest, axis=1)).mean())
